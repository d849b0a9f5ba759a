"""Charts of the screens: each metric against its limit, and the C/N0 curve (P1 figure 3)."""

from __future__ import annotations

from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, Floats, Masks
from railfix.core.timescale import seconds
from railfix.ranges.cn0_curve import Cn0Curve, Cn0Samples
from railfix.report.plots.chart import BLACK, RED, Chart, Curve, Layer, Points
from railfix.report.plots.columns import nice_step
from railfix.report.plots.draw import draw_chart, save_figure
from railfix.report.plots.signals import open_sky_chart
from railfix.report.plots.thinning import counts_sentence, extremes, spread
from railfix.screens import Cn0Limits, ScreenPicture

_KEPT: Final = "#2f86b8"
_COLUMNS: Final = 4
#: Rows of a picture that are looked at together.
_BLOCK: Final = 100_000
#: Points of the line of a limit: two a pixel of a wide chart.
_LINE_POINTS: Final = 1500


def draw_screen(
    path: str | PathLike[str], picture: ScreenPicture, time: Datetimes, chainage_m: Floats | None = None
) -> Path:
    """Draw a metric against its limit over T times, and over chainage [m] where it is known, as a PNG file.

    Raises
    ------
    OutputError
        The file cannot be written.
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
    """Chart of a metric against its limit over time.

    Parameters
    ----------
    picture : ScreenPicture
    time : ndarray of datetime64[ns], shape (T,), or (E,) with `epoch`
    epoch : ndarray of int, shape (T,), optional
        Epoch of each row of the picture, where `time` is that of E epochs.
    """
    start = time.min() if len(time) else np.datetime64(0, "ns")
    return _screen(picture, seconds(time - start), epoch, name="time", x_label="GPS time", start=start)


def screen_over_chainage(
    picture: ScreenPicture, chainage_m: Floats, *, epoch: NDArray[np.integer] | None = None
) -> Chart:
    """The same over the chainage, shape (T,), or (E,) with `epoch` [m]; see `screen_over_time`."""
    return _screen(picture, chainage_m, epoch, name="chainage", x_label="chainage [m]", start=None)


def _screen(
    picture: ScreenPicture,
    x: Floats,
    epoch: NDArray[np.integer] | None,
    *,
    name: str,
    x_label: str,
    start: np.datetime64 | None,
) -> Chart:
    judged = int(np.count_nonzero(np.isfinite(picture.metric)))
    rejected = int(np.count_nonzero(picture.reject))
    share = f"{100 * rejected / judged:.2f} %" if judged else "none"
    layers: list[Layer] = []
    shown = total = 0
    for reject, colour, label in ((False, _KEPT, "passed"), (True, RED, "rejected")):
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
        name=name,
        title=f"{picture.title}: {judged:,} tested, {rejected:,} rejected ({share})",
        caption=(("" if same else "Line: the tightest limit of each epoch.") + counts_sentence(shown, total)).strip(),
        x_label=x_label,
        y_label=picture.label,
        layers=tuple(layers),
        start=start,
        width="half",
        **scale,
    )


def _blocks(
    picture: ScreenPicture, x: Floats, epoch: NDArray[np.integer] | None
) -> Iterator[tuple[Floats, Floats, Masks, Floats]]:
    """Give x, metric, reject and limit of a picture, `_BLOCK` rows at a time, flat: long runs need little memory."""
    limit = np.broadcast_to(picture.limit, picture.metric.shape)
    for first in range(0, len(picture.metric), _BLOCK):
        rows = slice(first, first + _BLOCK)
        metric = picture.metric[rows].astype(np.float64)
        where = np.broadcast_to((x[rows] if epoch is None else x[epoch[rows]])[:, None], metric.shape)
        yield where.ravel(), metric.ravel(), picture.reject[rows].ravel(), limit[rows].astype(np.float64).ravel()


def _join(parts: list[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
    """Pairs of arrays end to end."""
    if not parts:
        return np.empty(0), np.empty(0)
    return np.concatenate([x for x, _ in parts]), np.concatenate([y for _, y in parts])


def _tightest(x: Floats, limit: Floats) -> tuple[Floats, Floats]:
    """Smallest limit at each distinct x, in rising order of x."""
    known = np.isfinite(x)
    x, limit = x[known], limit[known]
    order = np.argsort(x, kind="stable")
    first = np.flatnonzero(np.diff(x[order], prepend=np.nan) != 0.0)
    if not len(first):
        return np.empty(0), np.empty(0)
    return x[order][first], np.minimum.reduceat(limit[order], first)


def draw_cn0_curve(
    path: str | PathLike[str], curve: Cn0Curve, samples: Cn0Samples, *, limits: Cn0Limits | None = None
) -> Path:
    """Draw C/N0 over elevation with mean and threshold, a panel a constellation and signal (P1 figure 3), as PNG.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    from matplotlib.figure import Figure

    charts = [open_sky_chart(mean, *samples.of(mean.kind, mean.signal), limits or Cn0Limits()) for mean in curve.means]
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
