"""Charts of positions on the line: plan (P1 figure 6), positioning intervals (P1 figure 12), used satellites."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
import polars as pl

from railfix.core.arrays import Floats, Masks
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.core.notebook import plural
from railfix.core.reasons import Status
from railfix.report.plots.chart import (
    BLACK,
    CONSTRAINED,
    CONVENTIONAL,
    CYCLE,
    FILTERED,
    GREY,
    ORDERED,
    Bars,
    Chart,
    Curve,
    Layer,
    Marks,
    Points,
    find_start,
    floats,
    nice_step,
    one_per_cell,
    points,
    since,
    thin_points,
    words,
)
from railfix.track import Track

ECEF: Final = ("x_m", "y_m", "z_m")
#: Limits between the classes of the absolute error [m].
ERROR_CLASSES: Final = (1.0, 2.0, 5.0, 10.0)
#: Limits between the classes of the protection level [m].
LEVEL_CLASSES: Final = (5.0, 10.0, 20.0, 40.0)
#: Distance by which the line is drawn beyond the first and the last position [m].
_BEYOND_M: Final = 30.0
_TRACK_PIECES: Final = 1500
_MARKS: Final = 12


def plan(
    positions: pl.DataFrame,
    *,
    error_m: Floats | None = None,
    level_m: Floats | None = None,
    filtered: pl.DataFrame | None = None,
    track: Track | None = None,
    tunnels_m: Sequence[tuple[float, float]] = (),
    background: Sequence[Floats] = (),
    title: str = "Plan of the line",
) -> Chart:
    """Return a plan of the line and the positions of one antenna, with marks of the kilometrage (P1 figure 6).

    Positions are coloured by `error_m`, otherwise by `level_m`, both of shape (rows,); if neither is given, by status.
    If `filtered` is given, filter positions are drawn at epochs without a single-epoch position. If `track` is not
    given, the line is drawn through the positions. `tunnels_m` has the first and last chainage of each tunnel.
    `background` has lines that are drawn below, each as longitude and latitude of shape (P, 2) [deg]. The chart is
    empty if there is no position.
    """
    ecef, conventional = points(positions, *ECEF), points(positions, *(f"conventional_{name}" for name in ECEF))
    has = np.isfinite(ecef[:, 0])
    chart = partial(Chart, name="plan", title=title, x_label="east [m]", y_label="north [m]", equal=True)
    if not has.any():
        return chart(caption="", layers=())
    frame = LocalFrame.around(ecef[has])
    here, there = frame.plane(ecef), frame.plane(conventional)
    low, high = here[has].min(axis=0), here[has].max(axis=0)
    margin = max(0.25 * float((high - low).max()), 50.0)
    near = ((there > low - margin) & (there < high + margin)).all(axis=1)
    cell = float((high - low).max()) / 3000.0 or 0.01
    kept = np.flatnonzero(near)[one_per_cell(there[near, 0], there[near, 1], cell=cell)]
    layers: list[Layer] = [*_background(background, frame, low - margin, high + margin)]
    layers += _line(track, frame, floats(positions, "chainage_m")[has], here[has], tunnels_m)
    if len(kept):
        layers.append(Points(label="conventional", colour=GREY, shape="cross", x=there[kept, 0], y=there[kept, 1]))
    shown, total = len(kept), int(near.sum())
    epoch = since(positions, find_start(positions))
    classes, coloured = _classes(positions, error_m, level_m)
    for label, colour, mask in classes:
        rows = np.flatnonzero(has & mask)
        kept = rows[one_per_cell(here[rows, 0], here[rows, 1], cell=cell)]
        shown, total = shown + len(kept), total + len(rows)
        if len(kept):
            x, y = here[kept].T
            layers.append(
                Points(label=f"{label} ({len(rows):,})", colour=colour, x=x, y=y, size=4.0, epoch_s=epoch[kept])
            )
    if filtered is not None:
        layers += _filter_points(positions.filter(pl.Series(has)), filtered, frame, cell, find_start(positions))
    layers.append(_kilometrage(positions.filter(pl.Series(has)), here[has]))
    thinned = "" if shown == total else f" Positions too close to distinguish are drawn once ({shown:,} in all)."
    outside = int(np.isfinite(there[:, 0]).sum() - near.sum())
    far = f" Outside the plan: {plural(outside, 'conventional position')}." if outside else ""
    return chart(
        caption=f"Single-epoch positions, coloured by {coloured}; conventional positions in grey.{far} Origin at "
        f"latitude and longitude {frame.latitude_deg:.5f}, {frame.longitude_deg:.5f}.{thinned}",
        layers=tuple(layers),
    )


def _filter_points(
    placed: pl.DataFrame, filtered: pl.DataFrame, frame: LocalFrame, cell: float, start: np.datetime64
) -> Iterator[Points]:
    """Yield the positions of the filter at epochs that are not in `placed`, if there are any."""
    alone = filtered.join(placed, on="time_gpst", how="anti").filter(pl.col("x_m").is_not_null())
    if len(alone):
        place = frame.plane(points(alone, *ECEF))
        kept = one_per_cell(place[:, 0], place[:, 1], cell=cell)
        label = f"filter positions at epochs without a single-epoch position ({len(alone):,})"
        epoch = since(alone, start)[kept]
        yield Points(label=label, colour=FILTERED, x=place[kept, 0], y=place[kept, 1], size=4.0, epoch_s=epoch)


@dataclass(frozen=True, kw_only=True)
class LocalFrame:
    """Local frame with axes east, north and up at a point."""

    origin_ecef_m: Floats  #: Shape (3,).
    axes: Floats  #: ECEF unit vectors: rows east, north and up, shape (3, 3).
    latitude_deg: float
    longitude_deg: float
    height_m: float

    @classmethod
    def around(cls, ecef_m: Floats) -> LocalFrame:
        """Return the frame with its origin at the mean of points, shape (P, 3), ECEF [m]."""
        origin = ecef_m.mean(axis=0)
        latitude, longitude, height = (float(value) for value in geodetic_from_ecef(origin))
        axes = enu_axes(latitude, longitude)
        return cls(origin_ecef_m=origin, axes=axes, latitude_deg=latitude, longitude_deg=longitude, height_m=height)

    @classmethod
    def at(cls, latitude_deg: float, longitude_deg: float) -> LocalFrame:
        """Return the frame at a point on the ellipsoid, given by latitude and longitude in degrees."""
        origin, axes = ecef_from_geodetic(latitude_deg, longitude_deg, 0.0), enu_axes(latitude_deg, longitude_deg)
        return cls(
            origin_ecef_m=origin, axes=axes, latitude_deg=latitude_deg, longitude_deg=longitude_deg, height_m=0.0
        )

    def plane(self, ecef_m: Floats) -> Floats:
        """Return the east and north coordinates of points in ECEF, shape (P, 2) [m]."""
        return np.asarray((ecef_m - self.origin_ecef_m) @ self.axes[:2].T)

    def to_plane(self, latitude_deg: Floats, longitude_deg: Floats) -> Floats:
        """Return east and north coordinates of geodetic points [deg] at the height of the origin, shape (P, 2) [m]."""
        return self.plane(ecef_from_geodetic(latitude_deg, longitude_deg, np.full(len(latitude_deg), self.height_m)))


def _background(lines: Sequence[Floats], frame: LocalFrame, low: Floats, high: Floats) -> Iterator[Layer]:
    """Yield the part of the background lines inside a box as one layer; `low` and `high` are corners of the box."""
    parts: list[Floats] = []
    gap = np.full((1, 2), np.nan)
    for line in lines:
        plane = frame.to_plane(line[:, 1], line[:, 0])
        inside = np.asarray(((plane > low) & (plane < high)).all(axis=1))
        # points next to a point inside the box are kept, so that lines reach the edge of the box
        kept = inside | np.append(inside[1:], False) | np.append(False, inside[:-1])
        if inside.any():
            parts += [np.where(kept[:, None], plane, np.nan), gap]
    if parts:
        x, y = np.concatenate(parts).T
        yield Curve(label="background", colour="#a5b3a0", x=x, y=y, width=1.0)


def _line(
    track: Track | None, frame: LocalFrame, chainage_m: Floats, here: Floats, tunnels_m: Sequence[tuple[float, float]]
) -> Iterator[Curve]:
    """Yield the line from `_BEYOND_M` before the first to `_BEYOND_M` after the last position, and the tunnels of the
    line.
    """
    if track is None:
        yield _line_of_positions(here, chainage_m)
        return
    along = track.chainage_m
    place = frame.plane(track.ecef_m)

    def piece(first: float, last: float) -> tuple[Floats, Floats]:
        inside = along[(along > first) & (along < last)]
        at = np.concatenate([[first], inside[:: max(len(inside) // _TRACK_PIECES, 1)], [last]])
        return np.interp(at, along, place[:, 0]), np.interp(at, along, place[:, 1])

    x, y = piece(float(chainage_m.min()) - _BEYOND_M, float(chainage_m.max()) + _BEYOND_M)
    yield Curve(label="line", colour="#9a9a9a", x=x, y=y, width=4.0)
    for number, (first, last) in enumerate(tunnels_m):
        x, y = piece(first, last)
        yield Curve(label="" if number else "tunnel", colour=BLACK, x=x, y=y, width=4.0, dash="dotted")


def _classes(
    positions: pl.DataFrame, error_m: Floats | None, level_m: Floats | None
) -> tuple[list[tuple[str, str, Masks]], str]:
    """Return label, colour and mask of each class of positions, and the name of the quantity that is classified."""
    if error_m is not None:
        return size_classes(np.abs(error_m), ERROR_CLASSES, "error", "no reference"), "the size of their error"
    if level_m is not None:
        return size_classes(level_m, LEVEL_CLASSES, "level", "no level"), "their protection level"
    status = words(positions, "status")
    present = [s.text for s in Status if (status == s.text).any()]
    return [(name, CYCLE[i % len(CYCLE)], status == name) for i, name in enumerate(present)], "their status"


def size_classes(size: Floats, edges: Sequence[float], quantity: str, unknown: str) -> list[tuple[str, str, Masks]]:
    """Return label, colour and mask of each class: first NaN values, then values between consecutive `edges` [m]."""
    classes = [(unknown, BLACK, np.isnan(size))]
    for low, high, colour in zip((0.0, *edges), (*edges, np.inf), ORDERED, strict=True):
        label = f"{quantity} {low:g} to {high:g} m" if np.isfinite(high) else f"{quantity} {low:g} m and more"
        classes.append((label, colour, (size >= low) & ((size < high) | np.isinf(high))))
    return classes


def _line_of_positions(here: Floats, chainage_m: Floats) -> Curve:
    """Return a line through one position per short piece of chainage, with breaks at wide gaps."""
    order = np.argsort(chainage_m, kind="stable")
    chainage, place = chainage_m[order], here[order]
    width = max(float(np.ptp(chainage)) / _TRACK_PIECES, 0.5)
    first = np.flatnonzero(np.r_[True, np.diff(np.floor(chainage / width)) > 0])
    x, y, at = place[first, 0], place[first, 1], chainage[first]
    gap = np.flatnonzero(np.diff(at) > 20 * width + 50.0) + 1
    return Curve(label="line", colour="#9a9a9a", x=np.insert(x, gap, np.nan), y=np.insert(y, gap, np.nan), width=4.0)


def _kilometrage(positions: pl.DataFrame, here: Floats) -> Marks:
    """Return about a dozen marks at round values of the kilometrage, or of the chainage if there is no kilometrage."""
    along = floats(positions, "kilometrage_m")
    label = "kilometrage"
    if not np.isfinite(along).any():
        along, label = floats(positions, "chainage_m"), "chainage"
    low, high = float(np.nanmin(along)), float(np.nanmax(along))
    step = nice_step((high - low) / _MARKS)
    found_x, found_y, texts = [], [], []
    for mark in np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step:
        row = int(np.nanargmin(np.abs(along - mark)))
        if abs(along[row] - mark) <= 0.2 * step:
            found_x.append(here[row, 0])
            found_y.append(here[row, 1])
            texts.append(f"{mark:,.0f} m" if step < 1000 else f"{mark / 1000:g} km")
    return Marks(label=label, colour=BLACK, x=np.array(found_x), y=np.array(found_y), words=tuple(texts))


def interval(table: pl.DataFrame, prefix: str = "") -> tuple[Floats, Floats]:
    """Return the chainage of positions and the distance from the previous position [m].

    `prefix` is the beginning of the column names. If the table has a column of intervals, distances are taken from it,
    without positions at standstill. Otherwise distances are differences of chainage, including positions at standstill.
    """
    if f"{prefix}interval_m" in table.columns:
        chainage, distance = floats(table, "chainage_m"), floats(table, f"{prefix}interval_m")
        moved = distance > 0.0
        return chainage[moved], distance[moved]
    chainage = floats(table, f"{prefix}chainage_m")
    at = chainage[np.isfinite(chainage)]
    return at[1:], np.abs(np.diff(at))


_FIXES: Final = (("conventional", "conventional_", CONVENTIONAL, "square"), ("single epochs", "", CONSTRAINED, "dot"))


def interval_over_chainage(table: pl.DataFrame) -> Chart:
    """Return a chart of the distance from the previous position over chainage (P1 figure 12); see `interval`."""
    intervals = {label: interval(table, prefix) for label, prefix, _, _ in _FIXES}
    layers, thinned = thin_points(
        Points(label=label, colour=colour, shape=shape, x=intervals[label][0], y=intervals[label][1])  # type: ignore[arg-type]
        for label, _, colour, shape in _FIXES
    )
    longest = [f"{label} {distance.max():.2f} m" for label, (_, distance) in intervals.items() if len(distance)]
    return Chart(
        name="interval-chainage",
        title="Positioning interval",
        caption=f"Distance along the line between consecutive positions. {_by(table)} "
        + (f"Longest: {', '.join(longest)}.{thinned}" if longest else "There are none."),
        x_label="chainage [m]",
        y_label="distance from the previous position [m]",
        layers=tuple(layers),
        width="half",
    )


def interval_distribution(table: pl.DataFrame) -> Chart:
    """Return a histogram of the distance from the previous position (P1 figure 12); see `interval`."""
    distances = {label: interval(table, prefix)[1] for label, prefix, _, _ in _FIXES}
    largest = max((float(y.max()) for y in distances.values() if len(y)), default=1.0)
    step = nice_step(max(largest, 1e-3) / 40.0)
    edges = np.arange(0.0, largest + 2.0 * step, step)
    layers = []
    for side, (label, _, colour, _) in enumerate(_FIXES):
        counts, _ = np.histogram(distances[label], bins=edges)
        left = edges[:-1] + 0.5 * side * step
        layers.append(
            Bars(label=label, colour=colour, left=left, right=left + 0.5 * step, height=counts.astype(np.float64))
        )
    return Chart(
        name="interval-distribution",
        title="Positioning interval, distribution",
        caption=f"Number of positions by distance from the previous position, in classes of {step:g} m. {_by(table)}",
        x_label="distance from the previous position [m]",
        y_label="positions",
        layers=tuple(layers),
        y_scale="log",
        width="half",
    )


def _by(table: pl.DataFrame) -> str:
    if "interval_m" in table.columns:
        return "Distances between positions are measured along the reference; positions at standstill are omitted."
    return "Without a reference, the distances are computed from the positions and include their noise."


def satellites_over_time(positions: pl.DataFrame) -> Chart:
    """Return a chart of the numbers of used and rejected satellites at each epoch of one antenna."""
    start = find_start(positions)
    x = since(positions, start)
    columns = (("rejected", "n_rejected", CONVENTIONAL), ("used", "n_used", CONSTRAINED))
    layers, thinned = thin_points(
        Points(label=label, colour=colour, x=x, y=floats(positions, column), epoch_s=x)
        for label, column, colour in columns
    )
    return Chart(
        name="satellites",
        title="Satellites",
        caption=f"Numbers of satellites with a pseudorange.{thinned}",
        x_label="GPS time",
        y_label="satellites",
        layers=tuple(layers),
        start=start,
    )
