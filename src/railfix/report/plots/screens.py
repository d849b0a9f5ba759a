"""Charts of the screens: metrics with their limits, and the C/N0 curve (P1 figure 3)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, Floats, Masks
from railfix.core.errors import InputFileError, OutputError
from railfix.core.reasons import Reason
from railfix.core.timescale import seconds
from railfix.pipeline.config import Config
from railfix.ranges.cn0_curve import Cn0Curve
from railfix.ranges.cn0_curve_fit import Cn0Samples
from railfix.report.plots.chart import (
    BLACK,
    RED,
    Chart,
    Curve,
    Layer,
    Points,
    counts_sentence,
    extremes,
    floats,
    nice_step,
    spread,
)
from railfix.report.plots.draw import draw_chart, save_figure
from railfix.report.plots.signals import open_sky_chart
from railfix.report.runs import read_runs
from railfix.screens import SCREENS, Cn0Limits, ScreenPicture

_KEPT: Final = "#2f86b8"
_COLUMNS: Final = 4
#: Number of rows of a `ScreenPicture` that are processed together.
_BLOCK: Final = 100_000
#: Maximum number of points in the curve that shows a limit.
_LINE_POINTS: Final = 1500


def draw_screen(
    path: str | PathLike[str], picture: ScreenPicture, time: Datetimes, chainage_m: Floats | None = None
) -> Path:
    """Write a picture of a metric and its limit over T times and, if given, over chainage [m]; return the path.

    The file is PNG or SVG. Raise OutputError if it cannot be written.
    """
    from matplotlib.figure import Figure

    charts = [screen_over_time(picture, time)]
    if chainage_m is not None:
        charts.append(screen_over_chainage(picture, chainage_m))
    figure = Figure(figsize=(12, 4.2 * len(charts)), layout="constrained")
    for axes, chart in zip(np.ravel(figure.subplots(len(charts), 1)), charts, strict=True):
        draw_chart(chart, axes)
    return save_figure(figure, path)


def screen_over_time(picture: ScreenPicture, time: Datetimes, *, epoch: NDArray[np.integer] | None = None) -> Chart:
    """Return a chart of a metric with its limit over time.

    The picture has T rows. Without `epoch`, `time` has the time of each row, shape (T,). With `epoch`, `time` has the
    times of E epochs, and `epoch` is the index of the epoch of each row, shape (T,).
    """
    start = time.min() if len(time) else np.datetime64(0, "ns")
    return _screen(picture, seconds(time - start), epoch, start)


def screen_over_chainage(
    picture: ScreenPicture, chainage_m: Floats, *, epoch: NDArray[np.integer] | None = None
) -> Chart:
    """Return the chart of `screen_over_time` over chainage [m], shape (T,), or (E,) if `epoch` is given."""
    return _screen(picture, chainage_m, epoch, None)


_WEIGHS: Final = (
    'The screen increases the sigma of suspect values instead of rejecting them (setting verdict = "weigh").'
)


def _screen(picture: ScreenPicture, x: Floats, epoch: NDArray[np.integer] | None, start: np.datetime64 | None) -> Chart:
    """Return a chart of the metric over the time since `start`, or over chainage if `start` is None."""
    judged = int(np.count_nonzero(np.isfinite(picture.metric)))
    rejected = int(np.count_nonzero(picture.reject))
    share = f"{100 * rejected / judged:.2f} %" if judged else "none"
    weighs = picture.weighs and not rejected
    outcome = "none rejected" if weighs else f"{rejected:,} rejected ({share})"
    kept = "tested" if weighs else "passed"
    layers: list[Layer] = []
    shown = total = 0
    for reject, colour, label in ((False, _KEPT, kept), (True, RED, "rejected")):
        parts = []
        for along, metric, rejects, _ in _blocks(picture, x, epoch):
            mask = rejects == reject
            along, metric = along[mask], metric[mask]
            total += int(np.count_nonzero(np.isfinite(along + metric)))
            rows = spread(along, metric)
            parts.append((along[rows], metric[rows]))
        along, metric = _join(parts)
        rows = spread(along, metric)
        shown += len(rows)
        layers.append(Points(label=label, colour=colour, x=along[rows], y=metric[rows], epoch_s=None))
    limits = [_tightest(*(values[np.isfinite(limit)] for values in (along, limit))) for along, _, _, limit in
              _blocks(picture, x, epoch)]  # fmt: skip
    at, least = _tightest(*_join(limits))
    edges = [(float(np.nanmin(limit)), float(np.nanmax(limit))) for _, _, _, limit in _blocks(picture, x, epoch)
             if np.isfinite(limit).any()]  # fmt: skip
    finite = bool(edges)
    same = not finite or min(low for low, _ in edges) == max(high for _, high in edges)
    rows = extremes(at, least, points=_LINE_POINTS)
    for sign in {"both": (1.0, -1.0), "above": (1.0,), "below": (1.0,)}[picture.sides]:
        label = "limit" if sign > 0 else ""
        layers.append(Curve(label=label, colour=BLACK, x=at[rows], y=sign * least[rows], width=1.0))
    scale: dict[str, Any] = {}
    if finite and picture.sides != "below" and judged:
        top = 6.0 * float(np.median(least)) if len(least) else 0.0
        if top > 0.0 and max(float(np.nanmax(picture.metric)), -float(np.nanmin(picture.metric))) > top:
            scale = {"y_scale": "symlog", "y_linear": nice_step(top / 2.0)}
    return Chart(
        name="chainage" if start is None else "time",
        title=f"{picture.title}: {judged:,} tested, {outcome}",
        caption=(
            (_WEIGHS if weighs else "")
            + ("" if same else " The line is the tightest limit of each epoch.")
            + counts_sentence(shown, total)
        ).strip(),
        x_label="chainage [m]" if start is None else "GPS time",
        y_label=picture.label,
        layers=tuple(layers),
        start=start,
        width="half",
        **scale,
    )


def _blocks(
    picture: ScreenPicture, x: Floats, epoch: NDArray[np.integer] | None
) -> Iterator[tuple[Floats, Floats, Masks, Floats]]:
    """Yield flat arrays of x, metric, rejection and limit for blocks of `_BLOCK` rows, which need little memory."""
    limit = np.broadcast_to(picture.limit, picture.metric.shape)
    for first in range(0, len(picture.metric), _BLOCK):
        rows = slice(first, first + _BLOCK)
        metric = picture.metric[rows].astype(np.float64)
        where = np.broadcast_to((x[rows] if epoch is None else x[epoch[rows]])[:, None], metric.shape)
        yield where.ravel(), metric.ravel(), picture.reject[rows].ravel(), limit[rows].astype(np.float64).ravel()


def _join(parts: list[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
    """Concatenate pairs of arrays."""
    if not parts:
        return np.empty(0), np.empty(0)
    return np.concatenate([x for x, _ in parts]), np.concatenate([y for _, y in parts])


def _tightest(x: Floats, limit: Floats) -> tuple[Floats, Floats]:
    """Return the distinct values of x in ascending order, and the smallest limit at each value."""
    known = np.isfinite(x)
    x, limit = x[known], limit[known]
    order = np.argsort(x, kind="stable")
    first = np.flatnonzero(np.diff(x[order], prepend=np.nan) != 0.0)
    if not len(first):
        return np.empty(0), np.empty(0)
    return x[order][first], np.minimum.reduceat(limit[order], first)


def draw_cn0_curve(path: str | PathLike[str], curve: Cn0Curve, samples: Cn0Samples) -> Path:
    """Write a picture of C/N0, mean and threshold over elevation (P1 figure 3), and return the path.

    The picture has one panel per constellation and signal. Raise OutputError if the file cannot be written.
    """
    from matplotlib.figure import Figure

    charts = [open_sky_chart(mean, *samples.of(mean.kind, mean.signal), Cn0Limits()) for mean in curve.means]
    columns = min(_COLUMNS, len(charts))
    rows = -(-len(charts) // columns)
    figure = Figure(figsize=(4.5 * columns, 3.5 * rows), layout="constrained")
    source = curve.source
    figure.suptitle(f"{source.antenna or 'antenna not named'}, {source.receiver or 'receiver not named'}")
    panels = np.ravel(figure.subplots(rows, columns, sharex=True, sharey=True))
    for axes, chart in zip(panels, charts, strict=False):
        draw_chart(chart, axes)
    for axes in panels[len(charts) :]:
        axes.set_visible(False)
    return save_figure(figure, path)


@dataclass(frozen=True, kw_only=True)
class _ScreenRows:
    """Positions and observations of one antenna; each column of the observations is read only when it is drawn."""

    positions: pl.DataFrame
    observations: pl.LazyFrame
    epoch: NDArray[np.int32]

    def channels(self, column: str) -> Floats:
        """Return one column of the observations in single precision, shape (N, 1); NaN for absent values."""
        values = pl.col(column).cast(pl.Float32).fill_null(float("nan"))
        return self.observations.select(values).collect()[column].to_numpy()[:, None]

    def rejected(self, reason: Reason) -> Masks:
        """Return True for observations that have a rejection reason, shape (N, 1)."""
        flags = self.observations.select((pl.col("reason") & int(reason)) != 0).collect()
        return flags["reason"].to_numpy()[:, None]

    def epochs(self, column: str) -> Floats:
        """Return one column of the positions, shape (T, 1); NaN for absent values."""
        return floats(self.positions, column)[:, None]


def draw_run_screens(run: Path, out: Path) -> list[Path]:
    """Write one picture per screen and antenna, such as ``front_doppler.png``, into the folder `out`; return the paths.

    A screen that tested no values has no picture. Raise InputFileError if `run` is not a results folder, or the run
    wrote no observations (``railfix run --observations``). Raise OutputError if the folder or a file cannot be written.
    """
    (reported,), _ = read_runs([run])
    if reported.observations is None:
        raise InputFileError(
            run / "observations.parquet",
            "there is no such file; expected the folder of railfix run; run again with --observations",
        )
    missing = missing_columns(reported.folder.positions, reported.observations)
    if missing:
        raise InputFileError(run, f"the tables lack {', '.join(missing)}; run again with this version of railfix")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: the folder cannot be created ({error.strerror})") from None
    return [
        draw_screen(out / f"{screen.antenna}_{screen.name}.png", screen.picture, screen.time, screen.chainage_m)
        for screen in list_screens(reported.config, reported.folder.positions, reported.observations)
    ]


def missing_columns(positions: pl.DataFrame, observations: pl.LazyFrame) -> list[str]:
    """Return the sorted names of the columns that the charts need, but the tables (of old versions) lack."""
    columns = [column for screen in SCREENS for column in screen.columns]
    missing = {"raim_statistic", *(c.name for c in columns if c.table == "positions")} - set(positions.columns)
    missing |= {c.name for c in columns if c.table == "observations"} - set(observations.collect_schema())
    return sorted(missing)


@dataclass(frozen=True, kw_only=True)
class RunScreen:
    """Result of one screen of a run for one antenna."""

    antenna: str  #: ``front`` or ``rear``.
    name: str  #: Name of the plot of the screen, such as ``doppler``.
    picture: ScreenPicture  #: Metric and limit of the screen, with T rows (epochs or observations).
    epoch: NDArray[np.int32] | None  #: Index of the epoch of each row, shape (T,); None if there is one row per epoch.
    epoch_time: Datetimes  #: Time of each epoch, shape (E,).
    epoch_chainage_m: Floats  #: Chainage of the position of each epoch, shape (E,); NaN without a position.

    @property
    def time(self) -> Datetimes:
        """Time of each row of the picture, shape (T,)."""
        return self.epoch_time if self.epoch is None else self.epoch_time[self.epoch]

    @property
    def chainage_m(self) -> Floats:
        """Chainage of each row of the picture, shape (T,) [m]."""
        return self.epoch_chainage_m if self.epoch is None else self.epoch_chainage_m[self.epoch]


def list_screens(config: Config, positions: pl.DataFrame, observations: pl.LazyFrame) -> Iterator[RunScreen]:
    """Yield, for each antenna, the screens that tested any value, and the protection level.

    `config` has the settings of the run.
    """
    antennas = positions["antenna"].unique(maintain_order=True).to_list()
    for antenna in antennas:
        mine = positions.filter(pl.col("antenna") == antenna) if len(antennas) > 1 else positions
        seen = observations.filter(pl.col("antenna") == antenna)
        time, chainage = mine["time_gpst"].to_numpy(), floats(mine, "chainage_m")
        seen_at = seen.select("time_gpst").collect()["time_gpst"].to_numpy()
        epoch = np.searchsorted(time, seen_at).astype(np.int32)
        del seen_at
        rows = _ScreenRows(positions=mine, observations=seen, epoch=epoch)
        for name, picture in _pictures(antenna, rows, config):
            if np.isfinite(picture.metric).any():
                yield RunScreen(
                    antenna=antenna,
                    name=name,
                    picture=picture,
                    epoch=epoch if len(picture.metric) == len(epoch) else None,
                    epoch_time=time,
                    epoch_chainage_m=chainage,
                )


def _pictures(antenna: str, rows: _ScreenRows, config: Config) -> Iterator[tuple[str, ScreenPicture]]:
    """Yield the name and the picture of each active screen, and of the protection level if the run has levels."""
    for screen in SCREENS:
        if screen.name in config.screens:
            for name, picture in screen.pictures(rows, getattr(config, screen.name)):
                weighs = getattr(getattr(config, screen.name), "verdict", "reject") == "weigh"
                yield name, replace(picture, title=f"{antenna}: {picture.title}", weighs=weighs)
        if screen.name == "raim" and config.protection == "on":
            level = rows.epochs("protection_level_m")
            level = np.where(np.isfinite(level), level, np.nan)
            yield (
                "protection_level",
                ScreenPicture(
                    title=f"{antenna}: finite protection levels along the line against the alarm limit",
                    label="protection level [m]",
                    metric=level,
                    reject=level > config.alarm_limit_m,
                    limit=config.alarm_limit_m,
                    sides="above",
                ),
            )
