"""Places from changes of gradient and curvature, on a line with known ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from scipy.integrate import cumulative_simpson
from typer.testing import CliRunner

from railfix.cli import app
from railfix.core.geodesy import ecef_from_geodetic, enu_axes
from railfix.motion.features import LineSeries, LocatedFeature, line_series, locate, map_features
from railfix.simulate.demonstration import demo_inputs
from railfix.track import Track
from railfix.track.curves import curved_line

NOISE = (2e-4, 1e-4)
#: Way between P2's points A to D (table 1) [m].
POINTS = np.cumsum([300.0, 62.65, 361.32, 375.22])


def _line(*, repeated: bool = False) -> LineSeries:
    """Gradient changes at P2's points; with `repeated` twice the same change 40 m apart."""
    arc = np.arange(0.0, 1500.0, 1.0)
    points = np.array([500.0, 540.0]) if repeated else POINTS
    changes = [0.01, 0.01] if repeated else [0.012, -0.02, 0.015, -0.010]
    gradient = sum(c / (1.0 + np.exp(-(arc - p) / 3.0)) for p, c in zip(points, changes, strict=True))
    if repeated:
        gradient = 0.01 / (1.0 + np.exp(-(arc - 500.0) / 3.0)) - 0.01 / (1.0 + np.exp(-(arc - 520.0) / 3.0))
        gradient += 0.01 / (1.0 + np.exp(-(arc - 540.0) / 3.0)) - 0.01 / (1.0 + np.exp(-(arc - 560.0) / 3.0))
    curvature = np.where(arc > 900.0, 1.0 / 800.0, 0.0)
    return LineSeries(arc_m=arc, gradient=gradient, curvature_1pm=curvature)


def _measured(line: LineSeries, place: float, seed: int, *, half: float = 60.0, bias: float = 0.004) -> LineSeries:
    random = np.random.default_rng(seed)
    way = np.arange(-half, half + 0.5, 1.0)
    return LineSeries(
        arc_m=way,
        gradient=np.interp(place + way, line.arc_m, line.gradient) + bias + NOISE[0] * random.normal(size=len(way)),
        curvature_1pm=np.interp(place + way, line.arc_m, line.curvature_1pm) + NOISE[1] * random.normal(size=len(way)),
    )


def _locate(line: LineSeries, place: float, predicted: float, seed: int, **more: object) -> LocatedFeature:
    return locate(
        _measured(line, place, seed),
        line,
        predicted,
        8.0,
        quantity="gradient",
        noise=NOISE,
        **more,  # type: ignore[arg-type]
    )


@pytest.mark.requirement("E3")
def test_gaps_between_the_points_repeat_as_in_table_1() -> None:
    line = _line()
    runs = []
    for seed in (1, 2):
        found = [_locate(line, p, p + 5.0, 10 * seed + k) for k, p in enumerate(POINTS)]
        assert all(f.verdict == "accepted" for f in found), found
        runs.append(np.array([f.arc_m for f in found]))
    pairs = [(0, 1), (1, 2), (2, 3), (1, 3), (0, 3)]
    differences = [(runs[0][b] - runs[0][a]) - (runs[1][b] - runs[1][a]) for a, b in pairs]
    assert np.abs(differences).max() < 0.5
    assert np.sqrt(np.mean(np.square(differences))) < 0.25


@pytest.mark.requirement("E3")
def test_two_equal_features_in_the_window_are_refused() -> None:
    line = _line(repeated=True)
    measured = _measured(line, 510.0, 3, half=15.0)
    found = locate(measured, line, 530.0, 12.0, quantity="gradient", noise=NOISE)
    assert found.verdict == "ambiguous"


@pytest.mark.requirement("E3")
@pytest.mark.parametrize("share", [-1.05, -0.95, 0.95, 1.05])
@pytest.mark.parametrize(("earlier_m", "way_m"), [(0.0, 1.0), (0.7, 1.0), (3.0, 400.0), (0.0, 900.0)])
def test_the_gap_to_the_last_feature_agrees_within_three_sigmas(earlier_m: float, way_m: float, share: float) -> None:
    """Of this position, of the earlier one and of the distance by wheel, of 2 permille; each is the largest once."""
    line = _line()
    free = _locate(line, POINTS[2], POINTS[2], 5)
    allowed = 3.0 * np.sqrt(free.sigma_m**2 + earlier_m**2 + (2e-3 * way_m) ** 2)
    last = (free.arc_m - way_m - share * allowed, earlier_m, way_m)
    found = _locate(line, POINTS[2], POINTS[2], 5, last=last)
    refused = ("none", "distance from the last feature disagrees with the wheel distance")
    assert (found.verdict, found.reason) == (("accepted", "") if abs(share) < 1.0 else refused)


@pytest.mark.requirement("E3")
def test_the_other_quantity_must_fit() -> None:
    line = _line()
    wrong = LineSeries(arc_m=line.arc_m, gradient=line.gradient, curvature_1pm=np.where(line.arc_m > 365.0, 2e-3, 0.0))
    found = locate(_measured(line, POINTS[1], 6), wrong, POINTS[1], 8.0, quantity="gradient", noise=NOISE)
    assert found.verdict == "none"
    assert "curvature" in found.reason


@pytest.mark.requirement("E3")
def test_a_straight_level_line_has_no_features_and_places_nothing() -> None:
    arc = np.arange(0.0, 1000.0, 1.0)
    flat = LineSeries(arc_m=arc, gradient=0.0 * arc, curvature_1pm=0.0 * arc)
    assert map_features(flat) == []
    assert _locate(flat, 500.0, 503.0, 1).verdict == "none"


@pytest.mark.requirement("E3")
@pytest.mark.parametrize("spacing_m", [2.0, 5.0, 10.0, 20.0])
@pytest.mark.parametrize("start_m", [0.0, 3.0, 7.0])
@pytest.mark.parametrize("radii", ["of the map", "none"])
@pytest.mark.parametrize("transition_m", [60.0, 0.01])
def test_features_are_the_same_at_any_spacing_of_the_map(
    spacing_m: float, start_m: float, radii: str, transition_m: float
) -> None:
    """Four transitions to 300 m radius, or curves of 120 m without any, and three vertical curves of 15 to 60 m."""
    middles = np.array([150.0, 330.0, 510.0, 690.0])
    breaks = np.array([0.0, *np.sort([*(middles - transition_m / 2.0), *(middles + transition_m / 2.0)]), 840.0])
    bends = np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0]) / (300.0 if transition_m > 1.0 else 120.0)
    grid = np.linspace(0.0, 840.0, 84_001)
    heading = cumulative_simpson(np.interp(grid, breaks, bends), x=grid, initial=0.0)
    gradient = np.interp(
        grid, [0.0, 195.0, 225.0, 330.0, 345.0, 570.0, 630.0], np.array([2, 2, 12, 12, 4, 4, -11]) / 1e3
    )
    s = np.arange(start_m, 840.0, spacing_m)
    rates = (np.cos(heading), -np.sin(heading), gradient)  # east, north, up: a right curve
    points = np.stack([np.interp(s, grid, cumulative_simpson(rate, x=grid, initial=0.0)) for rate in rates], axis=-1)
    with np.errstate(divide="ignore"):
        radius = 1.0 / np.interp(s, breaks, bends)
    track = Track.from_ecef(
        ecef_from_geodetic(47.0, 8.0, 400.0) + points @ enu_axes(47.0, 8.0),
        cant_m=np.zeros(len(s)), radius_m=radius if radii == "of the map" else np.full(len(s), np.nan),
    )  # fmt: skip
    found = map_features(line_series(curved_line(track)))
    expected = [(150, "c"), (210, "g"), (330, "c"), (337.5, "g"), (510, "c"), (600, "g"), (690, "c")]
    assert [feature.quantity[0] for feature in found] == [kind for _, kind in expected]
    assert [feature.arc_m + start_m for feature in found] == pytest.approx([at for at, _ in expected], abs=3.0)
    assert [np.sign(f.change) for f in found if f.quantity == "curvature"] == [1.0, -1.0, 1.0, -1.0]


@pytest.mark.requirement("E3")
def test_the_command_lists_the_features_of_the_demonstration(tmp_path: Path) -> None:
    out = tmp_path / "features.csv"
    result = CliRunner().invoke(app, ["map", "features", str(demo_inputs().track[0]), "--out", str(out)])
    assert result.exit_code == 0, result.output
    rows = pl.read_csv(out)
    assert rows.columns == ["chainage_m", "quantity", "change"]
    assert len(rows) > 3
    assert (rows["chainage_m"].diff().drop_nulls() >= 0.0).all()
