"""The quality report: each fault is found where it is, and nothing else is."""

from __future__ import annotations

import numpy as np
import pytest

from railfix.core.arrays import Floats
from railfix.core.errors import SettingsError
from railfix.core.geodesy import ecef_from_geodetic, enu_axes
from railfix.track import Finding, MapLimits, Track, check_track

ORIGIN = (35.0, 139.0, 50.0)


def track_of(east: Floats, north: Floats, up: Floats | float = 0.0, **attributes: object) -> Track:
    enu = np.stack(np.broadcast_arrays(east, north, up), axis=-1)
    ecef = ecef_from_geodetic(*ORIGIN) + enu @ enu_axes(*ORIGIN[:2])
    return _with(Track.from_ecef(ecef), **attributes)


def _with(track: Track, **attributes: object) -> Track:
    return Track.from_geodetic(track.latitude_deg, track.longitude_deg, track.height_m, **attributes)  # type: ignore[arg-type]


def arc(radius: float, chord: float, points: int = 12) -> tuple[Floats, Floats]:
    """Points of a circle to the right whose chords have exactly the given length."""
    angle = 2.0 * np.arcsin(chord / (2.0 * radius)) * np.arange(points)
    return radius * (1.0 - np.cos(angle)), radius * np.sin(angle)


def kinds(track: Track, limits: MapLimits | None = None) -> dict[str, Finding]:
    return {finding.kind: finding for finding in check_track(track, limits=limits).findings}


@pytest.mark.requirement("A1")
@pytest.mark.parametrize("told", [True, False], ids=["radius given", "circle through the points"])
@pytest.mark.parametrize(("deviation", "flagged"), [(0.2999, False), (0.3001, True)])
@pytest.mark.parametrize("chord", [8.0, 20.0, 40.0])
def test_mid_chord_deviation_is_flagged_exactly_at_its_limit(
    told: bool, deviation: float, flagged: bool, chord: float
) -> None:
    radius = chord**2 / (8.0 * deviation)
    limits = MapLimits(least_radius_m=10.0)
    attributes = {"radius_m": np.full(12, radius)} if told else {}
    track = track_of(*arc(radius, chord), **attributes)
    quality = check_track(track, limits=limits)
    found = [finding for finding in quality.findings if finding.kind == "mid-chord"]
    assert bool(found) == flagged
    np.testing.assert_allclose(quality.geometry.mid_chord_m, deviation, rtol=1e-4)
    if found:
        assert found[0].severity == "error"
        assert (found[0].first, found[0].last) == (0, 11)
        assert found[0].value == pytest.approx(deviation, rel=1e-4)


@pytest.mark.requirement("A1")
@pytest.mark.parametrize(
    ("radius", "chord", "flagged"),
    [(27.0, 8.0, False), (26.0, 8.0, True), (300.0, 8.0, False), (160.0, 20.0, True), (160.0, 19.0, False)],
)
def test_the_papers_spacings(radius: float, chord: float, flagged: bool) -> None:
    """8 m on a radius of 27 m is 0.30 m from the arc, 20 m on 160 m is 0.31 m."""
    assert ("mid-chord" in kinds(track_of(*arc(radius, chord)))) == flagged


def test_a_good_line_has_no_findings() -> None:
    straight = np.arange(-200.0, 0.0, 20.0)
    east, north = arc(300.0, 5.0, 30)
    track = track_of(
        np.concatenate([0.0 * straight, east]),
        np.concatenate([straight, north]),
        0.01 * np.arange(40.0),
        radius_m=np.concatenate([np.full(10, np.inf), np.full(30, 300.0)]),
        cant_m=np.concatenate([np.zeros(10), np.full(30, 0.05)]),
    )
    track = _with(
        track, radius_m=track.radius_m, cant_m=track.cant_m, kilometrage_m=5000.0 - np.round(track.chainage_m)
    )
    assert check_track(track).findings == ()


def _line(points: int = 41, spacing: float = 5.0) -> tuple[Floats, Floats, Floats]:
    north = spacing * np.arange(points)
    return np.zeros(points), north, np.zeros(points)


def test_duplicates_and_near_duplicates() -> None:
    east, north, up = _line()
    north[11] = north[10]
    north[21] = north[20] + 0.05
    found = check_track(track_of(east, north, up)).findings
    assert [(f.kind, f.severity, f.first, f.last) for f in found] == [
        ("duplicate", "warning", 10, 11),
        ("near duplicate", "warning", 20, 21),
    ]
    assert found[1].value == pytest.approx(0.05, abs=1e-6)


def test_long_spacing() -> None:
    east, north, up = _line()
    north[20:] += 50.0
    found = kinds(track_of(east, north, up))["spacing"]
    assert (found.first, found.last, found.severity) == (19, 20, "warning")
    assert found.value == pytest.approx(55.0)
    north[20:] -= 5.01
    assert kinds(track_of(east, north, up)) == {}


@pytest.mark.parametrize(("offset", "severity"), [(0.10, None), (0.30, "warning"), (1.0, "error")])
def test_kinks(offset: float, severity: str | None) -> None:
    east, north, up = _line()
    east[20] = offset
    found = list(check_track(track_of(east, north, up), limits=MapLimits(mid_chord_m=9.0)).findings)
    worst = np.degrees(2.0 * np.arctan(offset / 5.0))
    if severity is None:
        assert found == []
    else:
        assert {f.kind for f in found} == {"kink"}
        assert found[0].severity == severity
        assert found[0].value == pytest.approx(worst, rel=1e-3)


def test_breaks_and_reversals_of_the_marking() -> None:
    east, north, up = _line()
    marking = north.copy()
    marking[20:] = 9000.0 - north[20:]
    marking[40] = np.nan
    found = check_track(track_of(east, north, up, kilometrage_m=marking)).findings
    assert [(f.kind, f.first, f.last) for f in found] == [
        ("kilometrage break", 19, 20),
        ("kilometrage reversal", 20, 20),
        ("kilometrage absent", 40, 40),
    ]
    assert {f.severity for f in found} == {"warning"}


def test_steep_segments_and_height_spikes() -> None:
    east, north, up = _line()
    up[20] = 2.0
    found = kinds(track_of(east, north, up))
    assert set(found) == {"height spike", "gradient"}
    assert found["height spike"].severity == "error"
    assert found["height spike"].value == pytest.approx(2.0, abs=1e-3)
    assert kinds(track_of(east, north, 0.059 * north)) == {}
    assert found["gradient"].limit == 60.0


@pytest.mark.parametrize(("told", "flagged"), [(10.0, False), (14.0, False), (16.0, True), (-10.0, True)])
def test_gradient_told_against_the_heights(told: float, flagged: bool) -> None:
    east, north, _ = _line()
    track = track_of(east, north, 0.010 * north, gradient_permille=np.full(41, told))
    assert ("gradient attribute" in kinds(track)) == flagged


def test_one_unknown_gradient_does_not_silence_the_rest() -> None:
    east, north, _ = _line(81)
    told = np.full(81, -10.0)
    told[3] = np.nan
    found = kinds(track_of(east, north, 0.010 * north, gradient_permille=told))["gradient attribute"]
    assert found.last == 80


@pytest.mark.parametrize(("cant", "flagged"), [(0.105, False), (-0.10, False), (0.201, True), (90.0, True)])
def test_cant_out_of_range(cant: float, flagged: bool) -> None:
    track = track_of(*arc(300.0, 5.0), cant_m=np.full(12, cant), radius_m=np.full(12, 300.0))
    found = kinds(track)
    assert ("cant" in found) == flagged
    assert set(found) - {"cant"} == ({"cant side"} if cant < 0.0 else set())


def test_radius_of_the_wrong_side_or_impossible() -> None:
    points = arc(300.0, 5.0, 30)
    assert kinds(track_of(*points, radius_m=np.full(30, -300.0)))["radius side"].severity == "error"
    assert kinds(track_of(*points, radius_m=np.full(30, 300.0))) == {}
    assert "radius" in kinds(track_of(*points, radius_m=np.full(30, 30.0)))


def test_a_reverse_curve_is_no_radius_of_the_wrong_side() -> None:
    """A sharp curve to the left ends 2 m before one to the right, as on a line in Italy."""
    way = np.arange(0.0, 80.0, 1.0)
    radius = np.select([way < 39.0, way < 41.0], [-212.0, np.inf], 380.0)
    heading = np.concatenate([[0.0], np.cumsum(np.diff(way) * (1.0 / radius[1:] + 1.0 / radius[:-1]) / 2.0)])
    east, north = (np.concatenate([[0.0], np.cumsum(f(heading)[:-1])]) for f in (np.sin, np.cos))
    assert kinds(track_of(east, north, radius_m=radius)) == {}
    assert "radius side" in kinds(track_of(east, north, radius_m=-radius))


def test_two_points_are_enough_and_equal_points_are_named() -> None:
    assert check_track(track_of(np.zeros(2), np.array([0.0, 10.0]))).findings == ()
    assert "duplicate" in kinds(track_of(np.zeros(3), np.zeros(3)))


def test_the_report_orders_errors_first_and_tells_the_marking() -> None:
    east, north, up = _line()
    north[11] = north[10] + 0.05
    up[30] += 9.0
    quality = check_track(track_of(east, north, up, kilometrage_m=700.0 + north))
    assert quality.findings == (*quality.errors, *quality.warnings)
    assert "near duplicate" in [f.kind for f in quality.warnings]
    assert quality.errors[0].kilometrage_m == 700.0 + north[29]
    assert quality.errors[0].sentence.startswith("at 145.0 m to 165.")


def test_limits_must_be_positive() -> None:
    with pytest.raises(SettingsError, match="mid_chord_m"):
        MapLimits(mid_chord_m=0.0)
