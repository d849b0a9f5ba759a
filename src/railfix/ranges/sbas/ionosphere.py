"""Ionospheric grid of one GEO, and slant delays from the grid (DO-229D, A.4.4.9, A.4.4.10 and A.4.5.2)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, Floats, Indices, Integers, Masks
from railfix.core.timescale import seconds, timedelta
from railfix.ranges.sbas.decode import decode, grid_delays
from railfix.ranges.sbas.limits import SbasLimits
from railfix.ranges.sbas.messages import SbasMessages
from railfix.ranges.sbas.satellites import degradation_row
from railfix.ranges.sbas.standard import GIVE_VARIANCE_M2, STOP_S, IonosphereDelays, IonosphereState, first_that_holds
from railfix.ranges.sbas.tables import SatelliteTables, Series, Stops

Answer = TypeVar("Answer", bound=np.generic)

BANDS: Final = 11  #: Number of bands of the ionospheric grid.
BITS: Final = 201  #: Number of bits of the mask of a band.
BLOCK: Final = 15  #: Number of grid points in one message of type 26.
#: Number of columns of the 5-degree raster on which grid points are numbered, starting at 180 degrees west.
COLUMNS: Final = 72
ROWS: Final = 37  #: Number of rows of the 5-degree raster, starting at 90 degrees south.

_SHORT: Final = tuple(range(-55, 60, 5))
_LONG: Final = (-75, -65, *_SHORT, 65, 75)


def _band(band: int) -> list[tuple[int, int]]:
    """Return the latitude and longitude of the points of a band in the order of their bits (DO-229D, table A-14)."""
    if band <= 8:
        west = -180 + 40 * band
        points = []
        for column in range(8):
            longitude = west + 5 * column
            latitudes: tuple[int, ...] = _SHORT if longitude % 10 else _LONG
            if longitude % 90 == 0:
                latitudes = (*_LONG, 85)
            elif (longitude - 40) % 90 == 0:
                latitudes = (-85, *_LONG)
            points += [(latitude, longitude) for latitude in latitudes]
        return points
    sign = 1 if band == 9 else -1
    points = [(60 * sign, longitude) for longitude in range(-180, 180, 5)]
    for latitude in (65, 70, 75):
        points += [(latitude * sign, longitude) for longitude in range(-180, 180, 10)]
    return points + [(85 * sign, longitude) for longitude in range(-180 if sign > 0 else -170, 180, 30)]


def point_number(latitude_deg: NDArray[np.generic], longitude_deg: NDArray[np.generic]) -> Integers:
    """Return the raster numbers of grid points; coordinates are multiples of 5 degrees, longitudes modulo 360."""
    row = np.rint((np.asarray(latitude_deg, dtype=np.float64) + 90.0) / 5.0).astype(np.int64)
    column = np.rint((np.asarray(longitude_deg, dtype=np.float64) + 180.0) / 5.0).astype(np.int64) % COLUMNS
    return row * COLUMNS + column


def _layout() -> tuple[Integers, Integers]:
    """Return the grid point of each bit of each band (-1: none), and up to two bits of each grid point (-1: no bit)."""
    point = np.full((BANDS, BITS), -1, dtype=np.int64)
    cells = np.full((ROWS * COLUMNS, 2), -1, dtype=np.int64)
    for band in range(BANDS):
        coordinates = np.array(_band(band))
        number = point_number(coordinates[:, 0], coordinates[:, 1])
        point[band, : len(number)] = number
        for bit, of_bit in enumerate(number.tolist()):
            free = 0 if cells[of_bit, 0] < 0 else 1
            cells[of_bit, free] = band * BITS + bit
    return point, cells


POINT_OF_BIT, CELLS_OF_POINT = _layout()


class GridTables:
    """Grid masks and delays by point and time, and the time spans in which masks and delays are constant.

    For each grid point, `delays` has the vertical `delay_m` (NaN for "do not use"), `givei`, and the `issue` of the
    mask (4 * band + IODI). `unused` counts the delays for which no mask of the same issue was known.
    """

    def __init__(self, messages: SbasMessages, limits: SbasLimits, stops: Stops) -> None:
        self.unused: Counter[str] = Counter()
        self._stops = stops
        timeouts = [limits.timeout_s(kind) for kind in ("grid_mask", "grid_delay", "degradation")]
        self.spans = Spans(messages.time, [*timeouts, STOP_S])
        self._mask_limit = limits.timeout_s("grid_mask")
        masks = decode(messages, 18)
        known = masks["band"] < BANDS
        time, band, mask = messages.time[masks["row"][known]], masks["band"][known], masks["mask"][known] != 0
        cell = (band[:, None] * BITS + np.arange(BITS)).ravel()
        self._by_cell = Series.of(cell, np.repeat(time, BITS), {"member": mask.ravel()})
        self._by_issue = Series.of(band * 4 + masks["iodi"][known], time, {"mask": mask})
        self.delays = self._delays(messages)

    def _delays(self, messages: SbasMessages) -> Series:
        """Return delays by point; the k-th delay of block b belongs to point 15 b + k of the mask of the same issue."""
        decoded = grid_delays(messages)
        kept = np.flatnonzero(decoded["band"] < BANDS)
        time, issue = messages.time[decoded["row"][kept]], 4 * decoded["band"][kept] + decoded["iodi"][kept]
        fits = self.mask_active(issue, time)
        self.unused["grid delays without a mask of their IODI"] += int((~fits).sum()) * BLOCK
        kept, time, issue = kept[fits], time[fits], issue[fits]
        masks = self._by_issue["mask"]
        rank = np.full(masks.shape, -1, dtype=np.int64)
        row, bit = np.nonzero(masks)
        rank[row, np.arange(len(row)) - np.searchsorted(row, row)] = bit
        place = decoded["block"][kept][:, None] * BLOCK + np.arange(BLOCK)
        mask = self._by_issue.newest(issue, time)
        bits = np.where(place < BITS, rank[mask[:, None], np.minimum(place, BITS - 1)], -1)
        band = decoded["band"][kept]
        point = np.where(bits >= 0, POINT_OF_BIT[band[:, None], np.maximum(bits, 0)], -1)
        columns = {name: decoded[name][kept].ravel() for name in ("delay_m", "givei")}
        return Series.of(point.ravel(), np.repeat(time, BLOCK), {**columns, "issue": np.repeat(issue, BLOCK)})

    def mask_active(self, issue: Integers, time: Datetimes) -> Masks:
        """Return whether the mask of a band and issue (4 * band + IODI) is known and has not timed out."""
        row = self._by_issue.newest(issue, time)
        return self._by_issue.in_force(row, time, self._stops.last(time), self._mask_limit)

    def in_mask(self, point: Integers, time: Datetimes) -> Masks:
        """Return True for points in the newest mask of one of their bands, provided that the mask is in force."""
        inside, stop = np.zeros(np.broadcast_shapes(point.shape, time.shape), dtype=bool), self._stops.last(time)
        for cell in np.moveaxis(CELLS_OF_POINT[point], -1, 0):
            row = self._by_cell.newest(cell, time)
            inside |= self._by_cell["member"][row] & self._by_cell.in_force(row, time, stop, self._mask_limit)
        return inside


class Spans:
    """Time spans in which no value of the grid changes; each ends at the next reception or time-out of a message."""

    def __init__(self, time: Datetimes, timeouts_s: Sequence[float]) -> None:
        ends = [time, *(time + timedelta(np.asarray(float(seconds))) for seconds in timeouts_s)]
        self._edges = np.unique(np.concatenate(ends)) if len(time) else time

    def number(self, time: Datetimes) -> Integers:
        """Return the number of the span that contains each instant; an instant at an edge has a separate number."""
        before = np.searchsorted(self._edges, time, side="left")
        return np.asarray(before + np.searchsorted(self._edges, time, side="right"), dtype=np.int64)


def distinct_lookups(span: Integers, point: Integers, points: int) -> tuple[Indices, Indices]:
    """Group rows with equal span (M,) and points (M, 4); return the first row of each group, and each row's group.

    The number of a point is at least -1 and less than `points`.
    """
    # Successive rows of a span share a number; if the span occurs again later, it may get a different number.
    key = np.cumsum(np.r_[False, span[1:] != span[:-1]])[: len(span)].astype(np.int64)
    pairs = (point[:, ::2] + 1) * (points + 1) + point[:, 1::2] + 1
    # After two of the four points are encoded, keys are renumbered, so that they stay small for logs of any length.
    _, key = np.unique(key * (points + 1) ** 2 + pairs[:, 0], return_inverse=True)
    _, first, which = np.unique(key * (points + 1) ** 2 + pairs[:, 1], return_index=True, return_inverse=True)
    return first, which


def look_up(
    answer: Callable[[Integers, Datetimes], NDArray[Answer]],
    span: Integers,
    point: Integers,
    time: Datetimes,
    points: int,
) -> NDArray[Answer]:
    """Return the result of `answer` for the four points and the time of each row, shape (M, ...).

    `answer` is called once for all rows of one span that have the same points.
    """
    first, which = distinct_lookups(span, point, points)
    return np.asarray(answer(point[first], time[first])[which])


EARTH_RADIUS_KM: Final = 6378.1363  #: Radius of the Earth (DO-229D, A.4.4.10.1).
LAYER_HEIGHT_KM: Final = 350.0  #: Height of the ionospheric layer (DO-229D, A.4.4.10.1).
_POLAR_DEG: Final = 75.0
_GIVE_VARIANCE: Final = np.array([*GIVE_VARIANCE_M2, np.nan])
_NOT_MONITORED: Final = 15
_NO_POINT: Final = -1


def pierce_point(
    latitude_deg: Floats, longitude_deg: Floats, elevation_deg: Floats, azimuth_deg: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return pierce points in the ionospheric layer [deg] and obliquity factors, (T, K); NaN below the horizon."""
    elevation, azimuth = np.radians(np.where(elevation_deg > 0.0, elevation_deg, np.nan)), np.radians(azimuth_deg)
    own_latitude, own_longitude = np.radians(latitude_deg)[:, None], np.radians(longitude_deg)[:, None]
    ratio = EARTH_RADIUS_KM / (EARTH_RADIUS_KM + LAYER_HEIGHT_KM) * np.cos(elevation)
    angle = np.pi / 2.0 - elevation - np.arcsin(ratio)
    latitude = np.arcsin(np.sin(own_latitude) * np.cos(angle) + np.cos(own_latitude) * np.sin(angle) * np.cos(azimuth))
    aside = np.arcsin(np.clip(np.sin(angle) * np.sin(azimuth) / np.cos(latitude), -1.0, 1.0))
    north = np.tan(angle) * np.cos(azimuth)
    over_pole = ((latitude_deg[:, None] > 70.0) & (north > np.tan(np.pi / 2.0 - own_latitude))) | (
        (latitude_deg[:, None] < -70.0) & (-north > np.tan(np.pi / 2.0 + own_latitude))
    )
    longitude = own_longitude + np.where(over_pole, np.pi - aside, aside)
    return np.degrees(latitude), (np.degrees(longitude) + 180.0) % 360.0 - 180.0, 1.0 / np.sqrt(1.0 - ratio**2)


def triangle_weights(x: Floats, y: Floats, missing: int) -> Floats:
    """Return the weights of the corners SW, NW, SE and NE of a cell if one corner is missing, shape (..., 4).

    Outside the triangle of the three remaining corners, one weight is negative.
    """
    zero = np.zeros_like(x)
    weights = {
        0: (zero, 1.0 - x, 1.0 - y, x + y - 1.0),
        1: (1.0 - x, zero, x - y, y),
        2: (1.0 - y, y - x, zero, x),
        3: (1.0 - x - y, y, x, zero),
    }
    return np.stack(weights[missing], axis=-1)


def _square_weights(x: Floats, y: Floats) -> Floats:
    return np.stack([(1.0 - x) * (1.0 - y), (1.0 - x) * y, x * (1.0 - y), x * y], axis=-1)


def _cells(latitude: Floats, longitude: Floats) -> Iterator[Callable[[Indices], tuple[Floats, ...]]]:
    """Yield, in the order of A.4.4.10.2, functions that return south-west corners and sizes of the cells to try."""

    def small(at: Indices) -> tuple[Floats, ...]:
        lat, lon = latitude[at], longitude[at]
        width = np.where(np.abs(lat) >= 60.0, 10.0, 5.0)
        return np.floor(lat / 5.0) * 5.0, np.floor(lon / width) * width, np.full(lat.shape, 5.0), width

    def large(at: Indices, a: float, b: float) -> tuple[Floats, ...]:
        ten = np.full(len(at), 10.0)
        south, west = np.floor((latitude[at] - a) / 10.0) * 10.0 + a, np.floor((longitude[at] - b) / 10.0) * 10.0 + b
        return south, west, ten, ten

    yield small
    for b in (0.0, 5.0):
        for a in (0.0, 5.0):
            yield partial(large, a=a, b=b)


def _choose(
    grid: GridTables, time: Datetimes, span: Integers, latitude: Floats, longitude: Floats
) -> tuple[Integers, Floats, Floats]:
    """Return the corners of the grid cell (M, 4) and the relative position x, y in the cell (M,) of points below 75 deg
    latitude. Corners are -1 where a corner is unused.
    """
    point = np.full((len(latitude), 4), _NO_POINT, dtype=np.int64)
    x, y = np.zeros((2, len(latitude)))
    open_ = np.isfinite(latitude) & (np.abs(latitude) < _POLAR_DEG)
    for cell in _cells(latitude, longitude):
        at = np.flatnonzero(open_)
        if not len(at):
            break
        s, w, h, b = cell(at)
        corners = np.stack(
            [point_number(s, w), point_number(s + h, w), point_number(s, w + b), point_number(s + h, w + b)], axis=1
        )
        inside = look_up(
            lambda points, when: grid.in_mask(points, when[:, None]), span[at], corners, time[at], ROWS * COLUMNS
        )
        u, v = (longitude[at] - w) / b, (latitude[at] - s) / h
        inside_cell = np.asarray(inside.all(axis=1))
        for missing in range(4):
            three = np.flatnonzero((inside.sum(axis=1) == 3) & ~inside[:, missing])
            if len(three):
                inside_cell[three] |= (triangle_weights(u[three], v[three], missing) >= 0.0).all(axis=1)
        chosen = at[inside_cell]
        point[chosen] = np.where(inside, corners, _NO_POINT)[inside_cell]
        x[chosen], y[chosen] = u[inside_cell], v[inside_cell]
        open_[chosen] = False
    return point, x, y


def _choose_polar(grid: GridTables, time: Datetimes, latitude: Floats, longitude: Floats) -> tuple[Integers, Floats]:
    """Beyond 75 deg latitude, return points (M, 4; all -1 if the mask lacks one) and weights (M, 4; then NaN)."""
    north = latitude >= 0.0
    sign = np.where(north, 1.0, -1.0)
    west = np.floor(longitude / 10.0) * 10.0
    # Points at 85 degrees are 30 degrees apart if the GEO sends the polar band, otherwise 90 degrees.
    origin = np.where(north, -180.0, -170.0)
    fine = np.floor((longitude - origin) / 30.0) * 30.0 + origin
    pole = np.stack([point_number(sign * 85.0, fine), point_number(sign * 85.0, fine + 30.0)], axis=1)
    close = grid.in_mask(pole, time[:, None]).all(axis=1)
    coarse_origin = np.where(north, -180.0, -140.0)
    coarse = np.floor((longitude - coarse_origin) / 90.0) * 90.0 + coarse_origin
    step, start = np.where(close, 30.0, 90.0), np.where(close, fine, coarse)
    cap = np.abs(latitude) > 85.0
    low = np.stack([point_number(sign * 75.0, west), point_number(sign * 75.0, west + 10.0)], axis=1)
    high = np.stack([point_number(sign * 85.0, start), point_number(sign * 85.0, start + step)], axis=1)
    # Around the pole: nearest west, second west, nearest east, second east.
    around = np.stack([point_number(sign * 85.0, coarse + turn) for turn in (0.0, -90.0, 90.0, 180.0)], axis=1)
    point = np.where(cap[:, None], around, np.concatenate([low, high], axis=1))
    x, y = (longitude - west) / 10.0, (np.abs(latitude) - 75.0) / 10.0
    u = (longitude - start) / step
    belt = np.stack([(1.0 - y) * (1.0 - x), (1.0 - y) * x, y * (1.0 - u), y * u], axis=1)
    v = (np.abs(latitude) - 85.0) / 10.0
    weights = np.where(cap[:, None], _square_weights((longitude - coarse) / 90.0 * (1.0 - 2.0 * v) + v, v), belt)
    inside_cell = np.asarray(grid.in_mask(point, time[:, None]).all(axis=1))[:, None]
    return np.where(inside_cell, point, _NO_POINT), np.where(inside_cell, weights, np.nan)


def ionosphere(
    grid: GridTables,
    tables: SatelliteTables,
    limits: SbasLimits,
    time: Datetimes,
    latitude_deg: Floats,
    longitude_deg: Floats,
    elevation_deg: Floats,
    azimuth_deg: Floats,
) -> IonosphereDelays:
    """Return slant delays at epochs; for the arguments see `SbasCorrections.ionosphere`."""
    latitude, longitude, obliquity = pierce_point(latitude_deg, longitude_deg, elevation_deg, azimuth_deg)
    shape = latitude.shape
    t = np.repeat(np.arange(len(time)), shape[1])
    when, at_latitude, at_longitude = time[t], latitude.ravel(), longitude.ravel()
    span = grid.spans.number(time)[t]
    point, x, y = _choose(grid, when, span, at_latitude, at_longitude)
    in_cap = np.isfinite(at_latitude) & (np.abs(at_latitude) >= _POLAR_DEG)
    polar = np.flatnonzero(in_cap)
    polar_weights = np.full((len(when), 4), np.nan)
    if len(polar):
        point[polar], polar_weights[polar] = _choose_polar(grid, when[polar], at_latitude[polar], at_longitude[polar])
    judged = look_up(
        lambda points, then: np.stack(_judge(grid, limits, tables, then, points), axis=-1),
        span, point, when, ROWS * COLUMNS,
    )  # fmt: skip
    row, state = judged[..., 0], judged[..., 1]
    weights, used = _weights(point, state, x, y, polar_weights, in_cap)
    delay, variance, known = _values(grid, limits, tables, time, t, row)
    total = np.where(used[:, None] & (weights > 0.0), weights * delay, 0.0).sum(axis=1)
    spread = np.where(used[:, None] & (weights > 0.0), weights * variance, 0.0).sum(axis=1)
    worst = first_that_holds(
        [
            ((seconds(time - tables.stops.last(time)) < STOP_S)[t], IonosphereState.GEO_STOPPED),
            (~(point >= 0).any(axis=1), IonosphereState.NO_GRID),
            ((state == IonosphereState.DO_NOT_USE).any(axis=1), IonosphereState.DO_NOT_USE),
            (used & ~known, IonosphereState.NO_DEGRADATION),
            (used, IonosphereState.OK),
            ((state == IonosphereState.TIMED_OUT).any(axis=1), IonosphereState.TIMED_OUT),
        ],
        IonosphereState.NOT_MONITORED,
    )
    good = (worst == IonosphereState.OK) | (worst == IonosphereState.NO_DEGRADATION)
    sigma = np.where(worst == IonosphereState.OK, np.sqrt(spread), np.nan)
    return IonosphereDelays(
        state=worst.reshape(shape),
        delay_m=np.where(good, total, np.nan).reshape(shape) * obliquity,
        sigma_uire_m=sigma.reshape(shape) * obliquity,
        latitude_deg=latitude,
        longitude_deg=longitude,
        points=np.where(good, (used[:, None] & (weights > 0.0)).sum(axis=1), 0).reshape(shape),
    )


def _judge(
    grid: GridTables, limits: SbasLimits, tables: SatelliteTables, time: Datetimes, point: Integers
) -> tuple[Integers, Integers]:
    """Return the row of each corner's newest delay, and each corner's `IonosphereState`, shapes (M, 4)."""
    at, delays = time[:, None], grid.delays
    row = delays.newest(point, at)
    received = delays.received(row)
    late = seconds(at - received) > limits.timeout_s("grid_delay")
    late |= ~grid.mask_active(np.where(row >= 0, delays["issue"][row], -1), at)
    state = first_that_holds(
        [
            (point < 0, IonosphereState.NO_GRID),
            ((row < 0) | (received <= tables.stops.last(time)[:, None]), IonosphereState.NOT_MONITORED),
            (late, IonosphereState.TIMED_OUT),
            (np.isnan(delays["delay_m"][row]), IonosphereState.DO_NOT_USE),
            (delays["givei"][row] == _NOT_MONITORED, IonosphereState.NOT_MONITORED),
        ],
        IonosphereState.OK,
    )
    return row, state


def _weights(
    point: Integers, state: Integers, x: Floats, y: Floats, polar_weights: Floats, polar: Masks
) -> tuple[Floats, Masks]:
    """Return corner weights (M, 4), and a mask (M,) of positions within four good corners or a triangle of three."""
    good = state == IonosphereState.OK
    weights = np.where(polar[:, None], polar_weights, _square_weights(x, y))
    used = good.all(axis=1)
    for missing in range(4):
        at = np.flatnonzero((good.sum(axis=1) == 3) & ~good[:, missing] & ~polar)
        if len(at):
            three = triangle_weights(x[at], y[at], missing)
            fits = (three >= 0.0).all(axis=1)
            weights[at[fits]] = three[fits]
            used[at[fits]] = True
    return weights, used & (point >= 0).any(axis=1)


def _values(
    grid: GridTables, limits: SbasLimits, tables: SatelliteTables, time: Datetimes, t: Integers, row: Integers
) -> tuple[Floats, Floats, Masks]:
    """Return corner delays and variances (M, 4), and a mask (M,) of epochs `t` at which type 10 is in force."""
    newest, in_force = degradation_row(tables, limits, time, tables.stops.last(time))
    of_ten, delays, ten = newest[t], grid.delays, tables.degradation
    variance = _GIVE_VARIANCE[delays["givei"][row]]
    age = seconds(time[t][:, None] - delays.time[row]) + limits.message_s
    step, interval, rate = (ten[f"iono_{name}"][of_ten][:, None] for name in ("step_m", "interval_s", "rate_mps"))
    grown = step * np.floor(age / np.maximum(interval, 1.0)) + rate * age
    squares = (ten["rss_iono"][of_ten] == 1)[:, None]
    total = np.where(squares, variance + grown**2, (np.sqrt(variance) + grown) ** 2)
    return delays["delay_m"][row], total, in_force[t]
