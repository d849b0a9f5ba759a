"""Charts: what goes into them by hand-worked cases, what thinning keeps, and that each can be drawn."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import polars as pl
import pytest
from matplotlib import pyplot
from matplotlib.figure import Figure

from chart_tables import START, errors_table, observations_table, positions_table, times
from railfix.integrity.stanford import stanford as sorted_epochs
from railfix.report import plots
from railfix.report.plots.chart import Cells, Chart, Marks, Points, extremes, nice_step, one_per_cell, spread

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
