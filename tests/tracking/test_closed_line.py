"""A line that closes on itself: the filter goes round (requirement E5)."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import synthetic
from railfix.core.files import fingerprint
from railfix.core.geodesy import ecef_from_geodetic, enu_axes
from railfix.core.timescale import timedelta
from railfix.evaluate import evaluate_run
from railfix.io.reference_log import AntennaReference
from railfix.pipeline.filter_result import Replay
from railfix.pipeline.outage_gate import ReturnState, gated_codes
from railfix.pipeline.sensor_epochs import SensorLimits
from railfix.pipeline.smoothed_track import smooth
from railfix.positioning.normal_equations import point_position, position_on_line
from railfix.positioning.search_index import SearchIndex
from railfix.positioning.section_search import SectionLimits, find_section
from railfix.run.inputs import TrackReading
from railfix.run.sources import open_line
from railfix.simulate.scenario_file import load_recipe
from railfix.track import Track, write_track_csv
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import Vehicle, antenna_trajectory
from railfix.tracking import Kind, Line, SensorEpochs, TrackingLimits, TrackStatus, track
from sensed_ride import UNIT, Ride, made
from tracking_cases import LATITUDE, LONGITUDE, START, bent_line, part, ride, wheel, without_epochs

RADIUS_M = 400.0
POINTS = 250


def ring(laps: float, *, apart_m: float = 0.0, backward: bool = False) -> Trajectory:
    """A circle, walked so many times; `apart_m` further out after each lap."""
    turn = np.arange(0.0, laps + 1e-9, 1.0 / POINTS)
    angle = 2.0 * np.pi * turn * (-1.0 if backward else 1.0)
    radius = RADIUS_M + apart_m * turn
    axes = enu_axes(np.array(LATITUDE), np.array(LONGITUDE))
    flat = radius[:, None] * (np.sin(angle)[:, None] * axes[0] + np.cos(angle)[:, None] * axes[1])
    return Trajectory.from_antenna_path(Track.from_ecef(ecef_from_geodetic(LATITUDE, LONGITUDE, 40.0) + flat))


def test_where_a_line_closes() -> None:
    closed = Line(ring(1.0))
    length = closed.arc_m[-1]
    # The end is the start; both lie on the other's vertex, of which no segment ends there.
    assert closed.joins_m == pytest.approx((length, 0.0), abs=1e-3)
    overlapping = Line(ring(1.2))
    assert overlapping.joins_m == pytest.approx((length, 0.2 * length), abs=0.5)
    np.testing.assert_allclose(
        overlapping.round_m(np.array([-5.0, 10.0, 1.2 * length + 5.0])), [length, 0.0, -length], atol=0.5
    )


@pytest.mark.parametrize("line", [bent_line(), ring(0.9), ring(1.0, apart_m=4.0)], ids=["bent", "gap", "4 m beside"])
def test_open_lines_do_not_close(line: Trajectory) -> None:
    assert np.isnan(Line(line).joins_m).all()
    whole = Line(line).records[1][0]
    assert (whole["start_m"], whole["end_m"]) == pytest.approx((0.0, line.arc_m[-1]))


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("backward", [False, True], ids=["rising", "falling"])
def test_the_filter_goes_round(backward: bool) -> None:
    closed, laps = ring(1.0), ring(3.0, backward=backward)
    length = closed.arc_m[-1]
    case = ride(300, trajectory=laps, start_m=100.0, noise=1.0)
    found, _ = track(case.epochs, Line(closed))
    true = np.mod(-case.arc_m if backward else case.arc_m, length)
    error = np.mod(found.arc_m - true + 0.5 * length, length) - 0.5 * length
    assert case.arc_m[-1] > 1.5 * length
    assert np.abs(error[30:]).max() < 3.0
    assert ((found.arc_m[30:] > -5.0) & (found.arc_m[30:] < length + 5.0)).all()
    assert (found.status[30:] == TrackStatus.TRACKING).all()


def round_the_ring(found_m: np.ndarray, true_m: np.ndarray, length_m: float) -> np.ndarray:
    """Difference of places the short way round."""
    return np.asarray(np.mod(found_m - true_m + 0.5 * length_m, length_m) - 0.5 * length_m)


@pytest.mark.requirement("E5")
def test_beyond_the_end_the_ring_goes_on() -> None:
    line, laps = Line(ring(1.0)), Line(ring(3.0))
    length = float(line.arc_m[-1])
    arc = np.array([-0.4, 0.3, 1.001, 1.2, 2.7]) * length
    for given, expected in zip(line.at(arc), laps.at(np.mod(arc, length)), strict=True):
        np.testing.assert_allclose(given, expected, atol=2e-3)
    both = np.array([3.0, length - 3.0])
    np.testing.assert_allclose(line.nearest_m(both, np.array(length)), [length + 3.0, length - 3.0])
    np.testing.assert_allclose(
        line.nearest_m(both, np.array(2.0 * length + 5.0)), [2.0 * length + 3.0, 2.0 * length - 3.0]
    )
    open_line = Line(bent_line())
    into_itself, last = Line(bent_line()), float(open_line.arc_m[-1])
    into_itself.__dict__["joins_m"] = (np.nan, 200.0)  # its end goes on at 200 m
    either = np.array([last - 3.0, 203.0])
    np.testing.assert_allclose(into_itself.nearest_m(either, np.array(last + 5.0)), [last - 3.0, last + 3.0])
    np.testing.assert_allclose(into_itself.nearest_m(either, np.array(202.0)), [last - 3.0, 203.0])
    np.testing.assert_array_equal(open_line.nearest_m(np.array([3.0]), np.array(5000.0)), [3.0])


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("kind", ["no sensor", "wheel", "nothing logged"])
def test_an_outage_across_the_join_changes_nothing(kind: str) -> None:
    """The places are those on a map of two laps, which has no join there."""
    closed, laps = ring(1.0), ring(2.0)
    length = float(closed.arc_m[-1])
    case = ride(85, trajectory=laps, start_m=length - 400.0, noise=1.0)
    cross = int(np.argmax(case.arc_m > length))
    out = np.zeros(len(case.epochs), dtype=bool)
    epochs, sensors = case.epochs, None
    if kind == "nothing logged":  # 24 s: places are sought again, on both sides of the join
        kept = np.flatnonzero(np.abs(np.arange(len(epochs)) - cross) >= 12)
        epochs = part(epochs, kept)
        joined = epochs.phase_joined.copy()
        joined[np.argmax(kept > cross)] = False
        epochs = replace(epochs, phase_joined=joined)
        true = case.arc_m[kept]
    else:
        out[cross - 8 : cross + 8] = True
        epochs, true = without_epochs(epochs, out), case.arc_m
        sensors = wheel(case) if kind == "wheel" else None
    found, _ = track(epochs, Line(closed), sensors=sensors)
    same, _ = track(epochs, Line(laps), sensors=sensors)
    np.testing.assert_allclose(round_the_ring(found.arc_m, same.arc_m, length)[30:], 0.0, atol=0.05)
    assert set(found.status[30:].tolist()) <= {TrackStatus.TRACKING, TrackStatus.COASTING, TrackStatus.DOUBTFUL}
    assert np.abs(round_the_ring(found.arc_m, true, length)[~out[: len(true)]][30:]).max() < 1.0


@pytest.mark.requirement("E5")
def test_smoothed_places_go_round() -> None:
    closed, laps = ring(1.0), ring(2.0)
    length = float(closed.arc_m[-1])
    case = ride(60, trajectory=laps, start_m=length - 250.0, noise=1.0)
    both = smooth([Replay(epochs=case.epochs, sensors=SensorEpochs(), before=None)], Line(closed), TrackingLimits())
    assert case.arc_m[-1] > length + 100.0
    assert (both.arc_m >= 0.0).all()
    assert (both.arc_m <= length).all()
    assert np.abs(round_the_ring(both.arc_m, case.arc_m, length)).max() < 1.0


@pytest.mark.requirement("E5")
def test_codes_that_come_back_beyond_the_join_count() -> None:
    line = Line(ring(1.0))
    length = float(line.arc_m[-1])
    time = START + timedelta(np.arange(8.0))
    observed = np.arange(8) >= 3
    state = ReturnState(time=time[0], place_m=length - 20.0, sigma_m=1.0)
    place = np.mod(length - 20.0 + 10.0 * np.arange(1, 9), length)
    refused, _ = gated_codes(
        time, observed, np.full(8, 10.0), place, np.ones(8), state, line, SensorLimits(return_sigmas=4.0, return_s=60.0)
    )
    np.testing.assert_array_equal(np.flatnonzero(refused), [3, 4])


@pytest.mark.requirement("A2")
def test_a_vehicle_on_a_ring_has_closed_paths() -> None:
    axes = enu_axes(np.array(LATITUDE), np.array(LONGITUDE))
    angle = np.linspace(0.0, 2.0 * np.pi, POINTS + 1)
    flat = 200.0 * (np.sin(angle)[:, None] * axes[0] + np.cos(angle)[:, None] * axes[1])
    map_of_ring = Track.from_ecef(ecef_from_geodetic(LATITUDE, LONGITUDE, 40.0) + flat)
    vehicle = Vehicle.model_validate(
        {"bogie_distance_m": 13.8, "antennas": {"front": {"along_m": 9.1, "across_m": 0.25, "up_m": 3.95}}}
    )
    path = antenna_trajectory(map_of_ring, vehicle)
    assert np.isfinite(path.joins_m).all()
    assert path.turn_m == pytest.approx(path.arc_m[-1], abs=0.01)
    np.testing.assert_allclose(path.ecef_m[-1], path.ecef_m[0], atol=0.01)
    np.testing.assert_allclose(path.body_chainage_m[[0, -1]], map_of_ring.chainage_m[[0, -1]], atol=1e-6)


@pytest.mark.requirement("A3")
@pytest.mark.slow
def test_single_epochs_at_the_join_are_placed_and_have_one_place() -> None:
    """Points of the map 20 m apart, and a start on the other side of the join."""
    angle = np.linspace(0.0, 2.0 * np.pi, POINTS + 1)
    circle = 800.0 * np.stack([np.sin(angle), np.cos(angle), 0.0 * angle], axis=1)
    closed = Trajectory.from_antenna_path(Track.from_ecef(synthetic.enu_to_ecef(circle)))
    length = float(closed.arc_m[-1])
    true = np.array([length - 8.0, 8.0, 0.0, 1500.0])
    ranges = synthetic.ranges(closed, true, sigma_m=0.0)
    for start in (0, len(closed) - 1):
        found = position_on_line(ranges.take(np.arange(3)), closed, np.full(3, start))
        np.testing.assert_allclose(round_the_ring(found.arc_m, true[:3], length), 0.0, atol=1e-3)
        np.testing.assert_allclose(found.overshoot_m, 0.0, atol=1e-3)
    noisy = synthetic.ranges(closed, true, sigma_m=5.0)
    point = point_position(noisy, closed.ecef_m[:4])
    assert (find_section(noisy, SearchIndex(closed), point).excess > SectionLimits().threshold).all()


@pytest.fixture(scope="module")
def ring_ride() -> Ride:
    """One and a half times round, a tunnel over the quarter at which the map begins and ends, the wheel slips in it."""
    scenario = load_recipe("demo").scenario()
    lap = 2.0 * np.pi * 150.0
    tunnel, slip = (1.25 * lap - 75.0, 1.25 * lap + 75.0), {"start_s": 97.0, "end_s": 99.0, "ratio": 0.25}
    return made(
        scenario.replaced(
            duration_s=110.0,
            rate_hz=2.0,
            line=scenario.line.replaced(
                kind="elements",
                elements=({"kind": "curve", "length_m": 1.5 * lap, "radius_m": 150.0, "cant_m": 0.05},),
                gradients=tuple({"from_m": 0.5 * k * lap, "permille": 8.0 * (-1.0) ** k} for k in range(3)),
                length_m=1.5 * lap,
                curve_spacing_m=lap / 400.0,
            ),
            environment=scenario.environment.replaced(
                sections=({"from_m": tunnel[0], "to_m": tunnel[1], "kind": "tunnel"},)
            ),
            run=scenario.run.replaced(cruise_mps=15.0),
            sensors={
                "tachometer": {"jitter_s": 2e-6, "lowest_mps": 0.3, "slips": [slip]},
                "inertial": UNIT,
                "radar": {},
            },
        )
    )


@pytest.mark.slow
@pytest.mark.requirement("E5")
@pytest.mark.parametrize("sensors", [("wheel", "force"), ("radar",), ("wheel", "force", "feature")])
def test_sensors_carry_round_the_join_of_a_ring(sensors: tuple[str, ...], ring_ride: Ride) -> None:
    whole = ring_ride.simulation.line.track()
    lap = 2.0 * np.pi * 150.0
    first, last = (int(np.argmin(np.abs(whole.chainage_m - turn * lap))) for turn in (0.25, 1.25))
    found = ring_ride.run(
        track=Track.from_ecef(whole.ecef_m[first : last + 1]), filter_sources=("code", "phase", "doppler", *sensors)
    )
    error = round_the_ring(found.chainage_m, ring_ride.chainage_m - whole.chainage_m[first], lap)
    known = np.isfinite(ring_ride.observations.code_m).any(axis=1)
    inside = ~known & (ring_ride.time_s > 60.0)
    assert (found.chainage_m[inside] < 60.0).any()
    assert (found.chainage_m[inside] > lap - 60.0).any()
    assert np.abs(error[inside]).max() < 1.5
    assert np.abs(error[ring_ride.time_s > 30.0]).max() < 2.5
    # codes count again 1.5 s after the tunnel
    after = np.flatnonzero(known & (ring_ride.time_s > ring_ride.time_s[inside][-1] + 2.0))
    assert (found.tracked.used[after, Kind.CODE] > 0).all()


@pytest.mark.requirement("D2")
def test_errors_across_the_join_are_the_short_way_round_by_both_methods(tmp_path: Path) -> None:
    """The train is 3 m behind the join, the run says 4 m after it, and the other way about; then 700 m wrong."""
    closed = ring(1.0)
    length = float(closed.arc_m[-1])
    true = np.array([length - 3.0, 2.0, 500.0, 100.0])
    answer = np.array([4.0, length - 5.0, 501.0, 800.0])
    table = {
        "time_gpst": START + np.arange(4) * np.timedelta64(1, "s"), "antenna": ["front"] * 4, "status": ["ok"] * 4,
        "along_sigma_m": np.ones(4), "n_used": [8] * 4, "chainage_m": answer, "conventional_chainage_m": answer,
    }  # fmt: skip
    for prefix in ("", "conventional_"):
        table |= {f"{prefix}{axis}_m": closed.at_arc(answer)[:, k] for k, axis in enumerate("xyz")}
    pl.DataFrame(table).write_parquet(tmp_path / "positions.parquet")
    track_file = tmp_path / "ring.csv"
    write_track_csv(Track.from_ecef(closed.ecef_m), track_file)
    opened = open_line((track_file,), None, antennas=("front",), reading=TrackReading(cache="skip"))
    assert any(note.startswith("the line is closed with a length of 2513") for note in opened.notes)
    assert opened.turns_m["front"] == pytest.approx(length, abs=0.01)
    record = {"inputs": [fingerprint("track", track_file)], "settings_used": {}, "line": opened.facts}
    (tmp_path / "run.json").write_text(json.dumps(record))
    for chainage, method in ((true, "chainage"), (true * np.nan, "trajectory")):
        reference = AntennaReference(
            time=np.asarray(table["time_gpst"]), ecef_m=closed.at_arc(true), chainage_m=chainage,
            speed_mps=np.ones(4), sigma_m=np.full(4, 0.1), environment=np.full(4, ""), source=np.full(4, ""),
        )  # fmt: skip
        found = evaluate_run(tmp_path, {"front": reference})
        assert found.runs[0].method["front"] == method
        error = found.epochs["error_m"].to_numpy()
        assert error[:3] == pytest.approx([7.0, -7.0, 1.0], abs=0.05)
        assert error[3] > 500.0
        told = "in its shorter direction" if method == "chainage" else "2 of 4 errors were measured to the"
        assert any(told in note for note in found.runs[0].notes), found.runs[0].notes
