"""Charts of the signals: C/N0 over elevation (P1 figure 3), and sky plots."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
import polars as pl

from railfix.core.arrays import Datetimes, Floats, Integers
from railfix.core.reason_names import first_reason, reason_names
from railfix.core.reasons import Reason
from railfix.ranges.cn0_curve import KINDS, Cn0Curve, Cn0Mean, satellite_kind
from railfix.report.plots.chart import (
    BLACK,
    BLUE,
    GREY,
    PURPLE,
    RED,
    Cells,
    Chart,
    Curve,
    Layer,
    Points,
    SkyEpochs,
    find_start,
    floats,
    since,
    words,
)
from railfix.screens import Cn0Limits

#: Edges of the cells of elevation [deg] and C/N0 [dB-Hz] in which samples are counted.
_ELEVATION_EDGES: Final = np.arange(0.0, 91.0, 1.0)
_CN0_EDGES: Final = np.arange(10.0, 60.5, 0.5)
#: The mean C/N0 is drawn for intervals of elevation that have at least this number of samples.
_LEAST: Final = 10
#: Maximum number of epochs of a sky plot.
SKY_EPOCHS: Final = 2000
#: Columns of the observations that the charts use.
CN0_COLUMNS: Final = ("satellite", "signal", "reason", "elevation_deg", "cn0_dbhz")
SKY_COLUMNS: Final = ("time_gpst", *CN0_COLUMNS, "azimuth_deg")


def cn0_over_elevation(
    observations: pl.DataFrame | pl.LazyFrame,
    *,
    limits: Cn0Limits | None = None,
    curve: Cn0Curve | None = None,
    mask_deg: float | None = None,
) -> list[Chart]:
    """Return a chart of C/N0 over elevation for each constellation and signal (P1 figure 3).

    The chart has the mean, the thresholds of the C/N0 screen (`limits`), and the elevation mask. The mean is taken from
    `curve` if `curve` has the signal; otherwise it is computed from the observations.
    """
    taken = observations.lazy().filter(
        pl.col("reason") & int(Reason.OTHER_SIGNAL_TAKEN) == 0,
        pl.col("cn0_dbhz").is_finite(),
        pl.col("elevation_deg") >= 0.0,
    )
    counted = taken.group_by(
        "satellite", "signal", across=_cell("elevation_deg", _ELEVATION_EDGES), up=_cell("cn0_dbhz", _CN0_EDGES)
    ).agg(count=pl.len().cast(pl.Int64), total=pl.col("cn0_dbhz").sum())
    cells_of = counted.collect()
    kinds = {satellite: satellite_kind(satellite) for satellite in cells_of["satellite"].unique()}
    cells_of = cells_of.with_columns(kind=pl.col("satellite").replace_strict(kinds, return_dtype=pl.String))
    of_signal = cells_of.group_by("kind", "signal").agg(pl.col("count").sum())
    charts = []
    for kind, signal, size in of_signal.sort("count", "kind", "signal", descending=[True, False, False]).iter_rows():
        mine = cells_of.filter(kind=kind, signal=signal)
        lines = tuple(_lines(mine, kind, signal, limits, curve, mask_deg))
        counts = np.zeros((len(_ELEVATION_EDGES) - 1, len(_CN0_EDGES) - 1), dtype=np.int64)
        drawn = mine.filter(pl.col("up").is_between(0, counts.shape[1] - 1), pl.col("across") < len(counts))
        np.add.at(counts, (drawn["across"].to_numpy(), drawn["up"].to_numpy()), drawn["count"].to_numpy())
        caption = f"{size:,} observations; darker cells have more observations."
        charts.append(_cn0_chart(kind, signal, counts, lines, title="C/N0 over elevation: ", caption=caption))
    return charts


def open_sky_chart(mean: Cn0Mean, elevation_deg: Floats, cn0_dbhz: Floats, limits: Cn0Limits) -> Chart:
    """Return a chart of the open-sky samples of one constellation and signal, with their mean and the thresholds."""
    counts = np.histogram2d(elevation_deg, cn0_dbhz, bins=[_ELEVATION_EDGES, _CN0_EDGES])[0].astype(np.int64)
    return _cn0_chart(mean.kind, mean.signal, counts, (*_open_sky(mean, limits), *_floor(limits)))


def _cn0_chart(
    kind: str, signal: str, counts: Integers, lines: Sequence[Layer], *, title: str = "", caption: str = ""
) -> Chart:
    cells = Cells(label="observations", colour=BLACK, x_edges=_ELEVATION_EDGES, y_edges=_CN0_EDGES, counts=counts)
    return Chart(
        name=f"cn0-{kind}-{signal}".lower(),
        title=f"{title}{KINDS.get(kind, kind)}, {signal}",
        caption=caption,
        x_label="elevation [deg]",
        y_label="C/N0 [dB-Hz]",
        layers=(cells, *lines),
        x_range=(0.0, 90.0),
        y_range=(10.0, 60.0),
        width="half",
    )


def _cell(column: str, edges: Floats) -> pl.Expr:
    """Return the index of the cell that contains each value of a column.

    The edges are equidistant. The last edge belongs to the last cell.
    """
    width, last = float(edges[1] - edges[0]), float(edges[-1])
    number = ((pl.col(column) - float(edges[0])) / width).floor().cast(pl.Int64)
    return pl.when(pl.col(column) == last).then(len(edges) - 2).otherwise(number)


def _lines(
    cells: pl.DataFrame,
    kind: str,
    signal: str,
    limits: Cn0Limits | None,
    curve: Cn0Curve | None,
    mask_deg: float | None,
) -> Iterator[Layer]:
    mean = next((m for m in curve.means if (m.kind, m.signal) == (kind, signal)), None) if curve else None
    yield from _compute_mean(cells) if mean is None else _open_sky(mean, limits)
    yield from _floor(limits)
    if mask_deg is not None:
        edge = np.full(2, mask_deg)
        yield Curve(label=f"mask {mask_deg:g} deg", colour=GREY, x=edge, y=np.array([10.0, 60.0]), dash="dotted")


def _open_sky(mean: Cn0Mean, limits: Cn0Limits | None) -> Iterator[Layer]:
    """Yield the mean of a C/N0 curve (open sky), and the threshold below it if the screen has one."""
    at = np.linspace(0.0, 90.0, 181)
    level = mean.at(at)
    yield Curve(label="mean of the open sky", colour=BLUE, x=at, y=level, width=2.0)
    if limits is not None and limits.deficit_dbhz is not None:
        label = f"{limits.deficit_dbhz:g} dB below"
        yield Curve(label=label, colour=RED, x=at, y=level - limits.deficit_dbhz, width=2.0, dash="dashed")


def _floor(limits: Cn0Limits | None) -> Iterator[Layer]:
    if limits is not None and limits.floor_dbhz is not None:
        floor, whole = np.full(2, limits.floor_dbhz), np.array([0.0, 90.0])
        yield Curve(label=f"floor {limits.floor_dbhz:g} dB-Hz", colour=PURPLE, x=whole, y=floor, dash="dotted")


def _compute_mean(cells: pl.DataFrame) -> Iterator[Layer]:
    piece = np.minimum(cells["across"].to_numpy() // 5, 17)
    count = np.bincount(piece, weights=cells["count"].to_numpy(), minlength=18)
    total = np.bincount(piece, weights=cells["total"].to_numpy(), minlength=18)
    mean = np.where(count >= _LEAST, total / np.maximum(count, 1), np.nan)
    middle = np.arange(2.5, 90.0, 5.0)
    yield Curve(label="mean of this run", colour=BLUE, x=middle, y=mean, width=2.0)
    yield Points(label="mean of this run", colour=BLUE, x=middle, y=mean, size=6.0)


def sky_epochs(
    observations: pl.DataFrame | pl.LazyFrame,
    *,
    wanted: Datetimes | None = None,
    epochs: int = SKY_EPOCHS,
    title: str = "Sky",
) -> SkyEpochs:
    """Return the satellites that one antenna has in view at some epochs, for sky plots.

    At most `epochs` epochs are returned: up to half of them are from `wanted`, and the rest are evenly spaced. Each
    satellite has one row per epoch, with the signal that was selected for positioning.
    """
    rows = observations.lazy().filter(pl.col("elevation_deg") >= 0.0, pl.col("azimuth_deg").is_not_null())
    times = rows.select(pl.col("time_gpst").unique().sort()).collect()["time_gpst"]
    if len(times) > epochs:
        extra = pl.Series([] if wanted is None else wanted[: epochs // 2], dtype=times.dtype).unique()
        extra = extra.filter(extra.is_in(times.implode()))
        even = times.gather(np.unique(np.linspace(0, len(times) - 1, epochs - len(extra)).astype(np.int64)))
        kept = pl.concat([even, extra]).unique().sort()
        rows = rows.filter(pl.col("time_gpst").is_in(kept.implode()))
    else:
        kept = times
    other = (pl.col("reason") & int(Reason.OTHER_SIGNAL_TAKEN)) != 0
    known = (
        rows.collect()
        .with_columns(aside=other)
        .sort("time_gpst", "satellite", "aside", maintain_order=True)
        .unique(["time_gpst", "satellite"], keep="first", maintain_order=True)
    )
    start = find_start(known) if len(known) else np.datetime64(0, "ns")
    seconds = since(known, start)
    epoch, first = np.unique(seconds, return_index=True)
    names = reason_names() | {0: "used"}
    reason = first_reason(known["reason"].to_numpy())
    return SkyEpochs(
        name="sky",
        title=title,
        caption=f"{len(kept):,} of {len(times):,} epochs are in this page."
        if len(kept) < len(times)
        else f"All {len(times):,} epochs are in this page.",
        start=start,
        epoch_s=epoch,
        first=np.append(first, len(known)).astype(np.int64),
        satellite=words(known, "satellite"),
        signal=words(known, "signal"),
        azimuth_deg=floats(known, "azimuth_deg"),
        elevation_deg=floats(known, "elevation_deg"),
        cn0_dbhz=floats(known, "cn0_dbhz"),
        reason=np.array([names[int(r)] for r in reason], dtype=np.str_),
    )
