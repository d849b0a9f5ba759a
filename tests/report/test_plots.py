"""Charts: what goes into them by hand-worked cases, what thinning keeps, and that each can be drawn."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from io import BytesIO
from typing import Any

import numpy as np
import polars as pl
import pytest
from matplotlib import pyplot
from matplotlib.figure import Figure

from chart_tables import START, errors_table, observations_table, positions_table, times
from railfix.core.geodesy import ecef_from_geodetic
from railfix.integrity.stanford import stanford as sorted_epochs
from railfix.report import plots
from railfix.report.plots.chart import (
    Band,
    Bars,
    Cells,
    Chart,
    Curve,
    Marks,
    Points,
    RangeBars,
    SkyEpochs,
    extremes,
    nice_step,
    one_per_cell,
    spread,
)
from railfix.screens import Cn0Limits
from railfix.track import Track

pytestmark = pytest.mark.requirement("D3")


@pytest.fixture
def errors() -> pl.DataFrame:
    return errors_table()


@pytest.fixture
def positions() -> pl.DataFrame:
    return positions_table()


@pytest.fixture
def observations() -> pl.DataFrame:
    return observations_table()


def layer(chart: Chart, kind: type, label: str = "") -> Any:
    """The layer of a kind and, where one is given, a label."""
    (found,) = [one for one in chart.layers if isinstance(one, kind) and label in ("", one.label)]
    return found


def test_errors_are_drawn_where_they_are_known_and_the_reference_is_good(errors: pl.DataFrame) -> None:
    over_time, over_chainage = plots.error_over_time(errors), plots.error_over_chainage(errors)
    assert over_time.start == START
    assert over_chainage.start is None
    for chart, x in ((over_time, [0.0, 1.0, 2.0]), (over_chainage, [10.0, 20.0, 30.0])):
        on_map = layer(chart, Points, "on the map")
        np.testing.assert_array_equal(on_map.x, x)
        np.testing.assert_array_equal(on_map.y, [0.5, -1.0, 2.0])
        np.testing.assert_array_equal(on_map.epoch_s, [0.0, 1.0, 2.0])
        np.testing.assert_array_equal(layer(chart, Points, "conventional").y, [1.5, -3.0, 4.0])
        band = layer(chart, Band)
        known = np.isfinite(band.high)
        np.testing.assert_array_equal(band.high[known], [1.0, 1.1, 1.2, 1.3])
        np.testing.assert_array_equal(band.low, -band.high)
        level = layer(chart, Curve, "± protection level")
        assert set(level.y[np.isfinite(level.y)]) == {5.0, 1.5, 6.0}
    assert "60.0 % of the epochs" in over_time.caption


def test_a_few_huge_errors_do_not_press_the_rest_flat() -> None:
    error = np.concatenate([np.linspace(-2.0, 2.0, 999), [66.0]])
    table = pl.DataFrame({"time_gpst": times(np.arange(1000)), "chainage_m": np.arange(1000.0), "error_m": error})
    chart = plots.error_over_time(table)
    assert chart.y_scale == plots.draw_chart(chart).get_yscale() == "symlog"
    assert chart.y_linear == 2.0
    assert layer(chart, Points, "on the map").y.max() == 66.0
    assert plots.error_over_time(table.head(999)).y_scale == "linear"


def test_ranges_of_runs(errors: pl.DataFrame) -> None:
    chart = plots.error_ranges({"a": errors, "b": errors.with_columns(error_m=pl.lit(None, dtype=pl.Float64))})
    on_map, conventional = layer(chart, RangeBars, "on the map"), layer(chart, RangeBars, "conventional")
    assert on_map.names == ("a, on the map", "a, conventional", "b, on the map", "b, conventional")
    np.testing.assert_array_equal(on_map.low, [-1.0, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(on_map.mid, [0.5, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(on_map.high, [2.0, np.nan, np.nan, np.nan])
    np.testing.assert_allclose(conventional.mid, [np.nan, 2.5 / 3.0, np.nan, 2.5 / 3.0])


@pytest.mark.requirement("D3")
def test_errors_of_several_runs_lie_over_one_chainage(errors: pl.DataFrame) -> None:
    """P1 figure 8: each run in its own colour; where the reference is poor there is no point."""
    chart = plots.errors_of_runs({"morning": errors, "evening": errors.with_columns(error_m=pl.col("error_m") + 1.0)})
    morning, evening = layer(chart, Points, "morning"), layer(chart, Points, "evening")
    np.testing.assert_array_equal(morning.x, evening.x)
    np.testing.assert_allclose(evening.y, morning.y + 1.0)
    has_chainage = errors["chainage_m"].is_not_null() & errors["chainage_m"].is_not_nan()
    good = errors.filter(has_chainage & errors["reference_good"])["error_m"].drop_nulls().drop_nans()
    np.testing.assert_allclose(np.sort(morning.y), np.sort(good.to_numpy()))
    assert morning.colour != evening.colour


def test_stanford_counts_by_hand() -> None:
    error = [1.0, -5.0, 12.0, 3.0, 25.0, np.nan, 1.0]
    level = [4.0, 4.0, 30.0, np.inf, 8.0, 5.0, np.nan]
    chart = plots.stanford(sorted_epochs(times(np.arange(7)), error, level, alarm_limit_m=20.0))
    counts = layer(chart, Cells).counts
    assert counts.sum() == 6
    for part in (
        "6 epochs with an error",
        "nominal 1 (16.667 %)",
        "misleading 1 (",
        "hazardous 1 (",
        "unavailable 3 (50.000 %)",
        "Available: 57.14 % of all epochs",
    ):
        assert part in chart.caption
    # cells of 0.4 m: 1 m under 4 m; infinite levels in the last row, which ends at 40 m
    assert counts[2, 10] == 1
    assert counts[:, -1].sum() == 2
    assert layer(chart, Cells).x_edges[-1] == pytest.approx(40.0)


@pytest.mark.requirement("C4")
def test_stanford_regions_are_written_where_they_are() -> None:
    """The words of each region stand inside it and tell its epochs; the limit may be anywhere."""
    rng = np.random.default_rng(3)
    error, level = rng.exponential(6.0, 500), rng.exponential(12.0, 500)
    for limit in (10.0, 17.0):
        diagram = sorted_epochs(times(np.arange(500)), error, level, alarm_limit_m=limit)
        chart = plots.stanford(diagram)
        marks = layer(chart, Marks)
        assert marks.place == "on"
        expected = {
            "nominal": (error <= level) & (level <= limit),
            "misleading": (level < error) & (error <= limit),
            "hazardously misleading": (level <= limit) & (limit < error),
            "unavailable": (limit < level) & (error <= level),
            "unavailable, misleading": (limit < level) & (level < error),
        }
        told = {}
        for x, y, words in zip(marks.x, marks.y, marks.words, strict=True):
            *name, count = words.split("\n")
            told[" ".join(name)] = int(count)
            # error over x, level over y: the place itself is of that region
            one = sorted_epochs(times(np.arange(1)), [x], [y], alarm_limit_m=limit)
            region = next(r for r, n in one.counts.items() if n)
            assert diagram.counts[region] == int(count)
            assert x < chart.x_range[1]
            assert y < chart.y_range[1]
        assert told == {name: int(mask.sum()) for name, mask in expected.items()}
        assert all(told.values())


def test_levels_over_time(positions: pl.DataFrame) -> None:
    told = positions.with_columns(
        protection_level_m=pl.Series([5.0, np.inf, 7.0, None, 6.0]),
        protection_fault_free_m=pl.Series([4.0, 4.0, 4.0, None, 4.0]),
        protection_two_faults_m=pl.Series([0.0, 0.0, 0.0, None, 0.0]),
        protection_status=pl.Series(["available", "unavailable", "available", "alarm", "available"]),
    )
    chart = plots.levels_over_time(told, 20.0)
    np.testing.assert_array_equal(layer(chart, Points, "level").y, [5.0, 7.0, 6.0])
    np.testing.assert_array_equal(layer(chart, Points, "level").x, [0.0, 2.0, 4.0])
    assert {one.label for one in chart.layers} == {"level", "fault-free part", "alarm limit 20 m"}
    assert "Epochs: available 3, unavailable 1, alarm 1." in chart.caption
    assert "not drawn: 1 infinite level." in chart.caption
    assert plots.levels_over_time(positions, 20.0).empty
    along = plots.levels_over_chainage(told.with_columns(chainage_m=pl.Series([10.0, 20.0, None, 40.0, 50.0])), 20.0)
    np.testing.assert_array_equal(layer(along, Points, "level").y, [5.0, 6.0])
    np.testing.assert_array_equal(layer(along, Points, "level").x, [10.0, 50.0])
    np.testing.assert_array_equal(layer(along, Points, "level").epoch_s, [0.0, 4.0])
    assert along.start is None
    assert plots.levels_over_chainage(positions, 20.0).empty


def test_plan_in_metres(positions: pl.DataFrame) -> None:
    chart = plots.plan(positions)
    assert chart.equal
    good = layer(chart, Points, "ok (4)")
    np.testing.assert_allclose(good.y, [-20.0, -10.0, 10.0, 20.0], atol=0.01)
    np.testing.assert_allclose(good.x, 0.0, atol=0.01)
    np.testing.assert_allclose(layer(chart, Points, "uncertain (1)").y, 0.0, atol=0.01)
    np.testing.assert_allclose(layer(chart, Points, "conventional").x, 5.0, atol=0.01)
    np.testing.assert_allclose(layer(chart, Curve).y, [-20.0, -10.0, 0.0, 10.0, 20.0], atol=0.01)
    marks = layer(plots.plan(positions.with_columns(pl.col("kilometrage_m") + 0.5)), Marks)
    assert marks.words == ("1,010 m", "1,020 m", "1,030 m", "1,040 m"), "every 5 m, where a position is within 1 m"
    np.testing.assert_allclose(marks.y, [-10.0, 0.0, 10.0, 20.0], atol=0.01)
    sized = plots.plan(positions, error_m=np.array([0.1, -1.5, 3.0, np.nan, -80.0]))
    counts = {one.label for one in sized.layers if isinstance(one, Points)}
    assert counts == {
        "conventional", "no reference (1)", "error 0 to 1 m (1)", "error 1 to 2 m (1)",
        "error 2 to 5 m (1)", "error 10 m and more (1)",
    }  # fmt: skip
    nowhere = positions.with_columns(pl.lit(None, dtype=pl.Float64).alias(f"{axis}_m") for axis in "xyz")
    assert plots.plan(nowhere).empty


def test_intervals_of_the_reference_and_of_the_positions(errors: pl.DataFrame, positions: pl.DataFrame) -> None:
    chart = plots.interval_over_chainage(errors)
    np.testing.assert_array_equal(layer(chart, Points, "on the map").x, [20.0, 30.0, 50.0])
    np.testing.assert_array_equal(layer(chart, Points, "on the map").y, [10.0, 10.0, 20.0])
    np.testing.assert_array_equal(layer(chart, Points, "conventional").y, [10.0, 20.0, 10.0])
    alone = plots.interval_over_chainage(positions)
    np.testing.assert_array_equal(layer(alone, Points, "conventional").y, [11.0, 18.0, 11.0])
    assert "Without a reference" in alone.caption
    bars = layer(plots.interval_distribution(errors), Bars, "on the map")
    # classes of 0.5 m; the positions on the map have the right half of each
    filled = bars.height > 0
    assert bars.left[filled].tolist() == [10.25, 20.25]
    assert bars.height[filled].tolist() == [2.0, 1.0]
    assert bars.left[-1] <= 20.75, "the last class ends at most one class after the longest"


def test_time_an_epoch() -> None:
    chunks = {
        "first_epoch_gpst": [str(t) for t in times([0.0, 60.0])],
        "epochs": [100, 50],
        "positioning_s": [0.2, 0.3],
    }
    chart = plots.processing_time(chunks)
    np.testing.assert_allclose(layer(chart, Points).y, [2.0, 6.0])
    np.testing.assert_allclose(layer(chart, Points).x, [0.0, 60.0])
    assert "3.333 ms an epoch" in chart.caption


def test_cn0_over_elevation(observations: pl.DataFrame) -> None:
    charts = plots.cn0_over_elevation(observations, limits=Cn0Limits(floor_dbhz=30.0), mask_deg=20.0)
    assert sorted(chart.title for chart in charts) == [
        "C/N0 over elevation: GPS, 1C",
        "C/N0 over elevation: Galileo, 1C",
    ]
    (gps,) = [chart for chart in charts if "GPS" in chart.title]
    counts = layer(gps, Cells).counts
    assert counts.sum() == counts[40, 70] == 2
    assert {one.label for one in gps.layers} >= {"floor 30 dB-Hz", "mask 20 deg", "observations"}


def test_sky_has_each_satellite_once(observations: pl.DataFrame) -> None:
    sky = plots.sky_epochs(observations)
    assert sky.epoch_s.tolist() == [0.0, 1.0]
    assert sky.first.tolist() == [0, 3, 6]
    rows = slice(0, 3)
    assert dict(zip(sky.satellite[rows].tolist(), sky.signal[rows].tolist(), strict=True)) == {
        "E05": "1C", "G01": "1C", "J02": "1C",
    }  # fmt: skip
    reasons = dict(zip(sky.satellite[rows].tolist(), sky.reason[rows].tolist(), strict=True))
    assert reasons == {"E05": "elevation_mask", "G01": "used", "J02": "used"}
    axes = plots.draw_sky(sky, times(0.8), ax=Figure().subplots(subplot_kw={"projection": "polar"}))
    assert "03:10:01" in axes.get_title()
    assert {text.get_text().split("\n")[0] for text in axes.texts} == {"E05", "G01", "J02"}


def test_sky_is_thinned_and_keeps_the_epochs_that_are_wanted(observations: pl.DataFrame) -> None:
    many = pl.concat([observations.head(4).with_columns(pl.lit(t).alias("time_gpst")) for t in times(np.arange(100.0))])
    sky = plots.sky_epochs(many, epochs=20, wanted=times([33.0, 77.0]))
    assert 18 <= len(sky.epoch_s) <= 20
    assert {0.0, 33.0, 77.0, 99.0} <= set(sky.epoch_s.tolist())
    assert "of 100 epochs" in sky.caption
    nothing = plots.sky_epochs(observations.clear())
    assert nothing.empty
    with pytest.raises(ValueError, match="no satellites"):
        plots.draw_sky(nothing, START)


@pytest.mark.parametrize("thin", [extremes, spread])
def test_thinning_keeps_the_extremes(thin: Callable[..., np.ndarray]) -> None:
    random = np.random.default_rng(7)
    x, y = np.sort(random.uniform(0.0, 1000.0, 50_000)), random.normal(size=50_000)
    y[[123, 40_000]] = [-90.0, 80.0]
    y[::7] = np.nan
    y[[123, 40_000]] = [-90.0, 80.0]
    rows = thin(x, y, points=3000)
    assert len(rows) <= 3000
    assert np.isfinite(y[rows]).all()
    assert (np.diff(rows) > 0).all()
    assert {123, 40_000} <= set(rows.tolist())
    # the largest of every hundredth of the span is among what is left
    for piece in range(100):
        inside = np.flatnonzero((x >= 10.0 * piece) & (x < 10.0 * (piece + 1)) & np.isfinite(y))
        assert y[np.intersect1d(rows, inside)].max() == y[inside].max()
    few = thin(x[:100], y[:100])
    np.testing.assert_array_equal(few, np.flatnonzero(np.isfinite(y[:100])))


def test_thinning_keeps_the_density() -> None:
    """Two populations, 1 : 4, interleaved with the period of the channels: no stripes, no preference."""
    random = np.random.default_rng(9)
    x = np.repeat(np.arange(5000.0), 10)
    y = np.where(random.uniform(size=50_000) < 0.2, random.normal(20.0, 1.0, 50_000), random.normal(0.0, 1.0, 50_000))
    rows = spread(x, y)
    kept = rows[~np.isin(rows, extremes(x, y, points=1200))]
    assert np.mean(y[kept] > 10.0) == pytest.approx(0.2, abs=0.02)
    columns = np.bincount(rows % 10, minlength=10)
    assert columns.max() < 1.2 * columns.min()
    pieces = np.histogram(x[kept], bins=50)[0]
    assert pieces.min() > 0.8 * pieces.mean()


def test_the_line_is_drawn_in_the_tunnel_over_its_background(positions: pl.DataFrame) -> None:
    """The track goes on where there is no position; the background is cut to the surroundings."""
    latitude = 35.0 + np.arange(9) * 5.0 / 110_941.0
    ecef = ecef_from_geodetic(latitude, np.full(9, 135.0), np.full(9, 50.0))
    street = np.array([[135.0001, 34.9999], [135.0001, 35.0005], [136.0, 36.0], [137.0, 36.0]])
    chart = plots.plan(
        positions.filter(pl.col("chainage_m") != 20.0),
        track=Track.from_ecef(ecef),
        tunnels_m=[(15.0, 25.0)],
        background=[street, street + 10.0],
    )
    line, tunnel, below = (layer(chart, Curve, name) for name in ("line", "tunnel", "background"))
    assert np.isfinite(line.y).all()
    assert np.ptp(line.y) == pytest.approx(40.0, abs=0.2)
    np.testing.assert_allclose([tunnel.y[0], tunnel.y[-1]], [-5.0, 5.0], atol=0.1)
    assert np.isfinite(below.x).sum() == 3  # two points inside, and the next, so that the line reaches the edge
    levels = plots.plan(positions, level_m=np.array([3.0, 7.0, 15.0, np.nan, np.inf]))
    labels = {one.label for one in levels.layers if isinstance(one, Points)}
    assert {"level 0 to 5 m (1)", "level 5 to 10 m (1)", "level 40 m and more (1)", "no level (1)"} <= labels


def test_a_sky_needs_polar_axes(observations: pl.DataFrame) -> None:
    with pytest.raises(ValueError, match="polar"):
        plots.draw_sky(plots.sky_epochs(observations), START, ax=Figure().subplots())


@pytest.mark.requirement("S3")
def test_functions_that_plot_take_axes_and_return_them(errors: pl.DataFrame) -> None:
    for name in plots.__all__:
        if name.startswith("plot_"):
            function = getattr(plots, name)
            assert function.__name__ == name
            own = inspect.signature(function)
            assert own.return_annotation == "Axes"
            assert own.parameters["ax"].default is None
            assert "the axes are returned" in function.__doc__
    _, (left, right) = pyplot.subplots(1, 2)
    assert plots.plot_error_over_time(errors, ax=right) is right
    assert right.has_data()
    assert not left.has_data()
    new = plots.plot_error_over_time(errors)
    assert new.figure is not right.figure
    assert new.figure.number in pyplot.get_fignums()  # a notebook shows it
    pyplot.close("all")


def test_one_per_cell_leaves_no_cell_empty() -> None:
    random = np.random.default_rng(8)
    x, y = random.uniform(-5.0, 5.0, (2, 20_000))
    rows = one_per_cell(x, y, cell=1.0, points=150)
    assert 100 <= len(rows) <= 150
    cells = {(int(a), int(b)) for a, b in zip((x[rows] - x.min()) // 1.0, (y[rows] - y.min()) // 1.0, strict=True)}
    assert len(cells) == len(rows) == 100
    assert len(one_per_cell(np.array([np.nan]), np.array([1.0]), cell=1.0)) == 0


@pytest.mark.parametrize(("rough", "nice"), [(0.9, 1.0), (1.0, 1.0), (1.1, 2.0), (23.0, 50.0), (0.03, 0.05)])
def test_nice_steps(rough: float, nice: float) -> None:
    assert nice_step(rough) == pytest.approx(nice)


def test_layers_of_unequal_length_are_refused() -> None:
    with pytest.raises(ValueError, match="lengths"):
        Points(label="a", colour="#000000", x=np.zeros(2), y=np.zeros(3))
    with pytest.raises(ValueError, match="shape"):
        Cells(label="a", colour="#000000", x_edges=np.arange(3.0), y_edges=np.arange(3.0), counts=np.zeros((3, 2), int))


@pytest.mark.slow
def test_every_picture_is_drawn(errors: pl.DataFrame, positions: pl.DataFrame, observations: pl.DataFrame) -> None:
    chunks = {"first_epoch_gpst": [str(START)], "epochs": [100], "positioning_s": [0.2]}
    drawn = [
        plots.plot_plan(positions),
        plots.plot_error_over_time(errors),
        plots.plot_error_over_chainage(errors),
        plots.plot_error_ranges({"run": errors}),
        plots.plot_stanford(sorted_epochs(times([0.0, 1.0]), [1.0, 2.0], [3.0, 4.0], alarm_limit_m=20.0)),
        plots.plot_levels_over_time(positions.with_columns(protection_level_m=5.0), 20.0),
        plots.plot_levels_over_chainage(positions.with_columns(protection_level_m=5.0), 20.0),
        plots.plot_interval_over_chainage(errors),
        plots.plot_interval_distribution(errors),
        plots.plot_satellites_over_time(positions),
        plots.plot_processing_time(chunks),
        *(plots.draw_chart(chart) for chart in plots.cn0_over_elevation(observations)),
    ]
    for axes in drawn:
        assert axes.get_title()
        assert axes.has_data()
        written = BytesIO()
        axes.figure.savefig(written, format="png", dpi=40)
        assert written.getvalue().startswith(b"\x89PNG")
        pyplot.close(axes.figure)


def test_the_axes_of_a_drawing_hold_the_numbers_of_the_chart(errors: pl.DataFrame) -> None:
    axes = plots.plot_error_over_time(errors, ax=Figure().subplots())
    (on_map,) = [line for line in axes.lines if line.get_label() == "on the map"]
    np.testing.assert_array_equal(on_map.get_ydata(), [0.5, -1.0, 2.0])
    np.testing.assert_array_equal(np.asarray(on_map.get_xdata()), times([0.0, 1.0, 2.0]))


def test_sky_epochs_are_of_their_type(observations: pl.DataFrame) -> None:
    sky = plots.sky_epochs(observations)
    assert isinstance(sky, SkyEpochs)
    assert sky.epoch_s.tolist() == [0.0, 1.0]
