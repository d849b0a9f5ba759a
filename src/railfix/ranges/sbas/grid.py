"""The ionospheric grid: its points, and the delays that one GEO sends for them (DO-229D, A.4.4.9 and A.4.4.10)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, Indices, Integers, Masks
from railfix.core.timescale import seconds, timedelta
from railfix.ranges.sbas.decode import decode, grid_delays
from railfix.ranges.sbas.messages import SbasMessages
from railfix.ranges.sbas.standard import STOP_S, SbasLimits
from railfix.ranges.sbas.tables import Series, Stops

Answer = TypeVar("Answer", bound=np.generic)

#: Bands, bits of a mask, points of one message of type 26.
BANDS: Final = 11
BITS: Final = 201
BLOCK: Final = 15
#: Grid points are numbered on a raster of 5 degrees from 90 south, 180 west.
COLUMNS: Final = 72
ROWS: Final = 37

_SHORT: Final = tuple(range(-55, 60, 5))
_LONG: Final = (-75, -65, *_SHORT, 65, 75)


def _band(band: int) -> list[tuple[int, int]]:
    """Latitude and longitude of the points of a band in the order of their bits (DO-229D, table A-14)."""
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
    """Number of grid points; coordinates are multiples of 5 degrees, longitudes of any turn."""
    row = np.rint((np.asarray(latitude_deg, dtype=np.float64) + 90.0) / 5.0).astype(np.int64)
    column = np.rint((np.asarray(longitude_deg, dtype=np.float64) + 180.0) / 5.0).astype(np.int64) % COLUMNS
    return row * COLUMNS + column


def _layout() -> tuple[Integers, Integers]:
    """Point of each bit of each band (-1 without), and the up to two (band, bit) cells of each point (-1)."""
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
    """Masks and delays of the grid by point and time.

    Attributes
    ----------
    delays : Series
        By grid point: `delay_m`, vertical, NaN for do not use; `givei`; `issue` of the mask (4 band + IODI).
    spans : Spans
        In which nothing about the grid changes.
    unused : Counter of str
        Delays that no mask fits.
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
        """Delays by point: the k-th of a block belongs to the k-th point of the mask of its issue."""
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

    def _active(self, table: Series, row: Integers, time: Datetimes) -> Masks:
        received = table.received(row)
        in_time = seconds(time - received) <= self._mask_limit
        return np.asarray((row >= 0) & in_time & (received > self._stops.last(time)))

    def mask_active(self, issue: Integers, time: Datetimes) -> Masks:
        """Whether the mask of a band and issue (4 band + IODI) is known and not timed out."""
        return self._active(self._by_issue, self._by_issue.newest(issue, time), time)

    def in_mask(self, point: Integers, time: Datetimes) -> Masks:
        """Whether points are in the newest mask of a band of theirs that has not timed out."""
        inside = np.zeros(np.broadcast_shapes(point.shape, time.shape), dtype=bool)
        for cell in np.moveaxis(CELLS_OF_POINT[point], -1, 0):
            row = self._by_cell.newest(cell, time)
            inside |= self._by_cell["member"][row] & self._active(self._by_cell, row, time)
        return inside


class Spans:
    """Spans of time between receptions and time-outs, in which no value of the grid changes.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (N,)
        Reception of all messages.
    timeouts_s : sequence of float
    """

    def __init__(self, time: Datetimes, timeouts_s: Sequence[float]) -> None:
        ends = [time, *(time + timedelta(np.asarray(float(seconds))) for seconds in timeouts_s)]
        self._edges = np.unique(np.concatenate(ends)) if len(time) else time

    def number(self, time: Datetimes) -> Integers:
        """Number of the span of instants; an instant that is an edge has a number of its own."""
        before = np.searchsorted(self._edges, time, side="left")
        return np.asarray(before + np.searchsorted(self._edges, time, side="right"), dtype=np.int64)


def distinct_lookups(span: Integers, point: Integers, points: int) -> tuple[Indices, Indices]:
    """First row of each different combination of span and four points, and the combination of each row.

    Parameters
    ----------
    span : ndarray of int, shape (M,)
    point : ndarray of int, shape (M, 4)
        From -1 to below `points`.

    Returns
    -------
    first : ndarray of int, shape (U,)
    which : ndarray of int, shape (M,)
    """
    # Runs of one span have one number; that a span has two where it comes twice does no harm.
    key = np.cumsum(np.r_[False, span[1:] != span[:-1]])[: len(span)].astype(np.int64)
    pairs = (point[:, ::2] + 1) * (points + 1) + point[:, 1::2] + 1
    # Numbered anew half-way, so that the keys stay small however long the log is.
    _, key = np.unique(key * (points + 1) ** 2 + pairs[:, 0], return_inverse=True)
    _, first, which = np.unique(key * (points + 1) ** 2 + pairs[:, 1], return_index=True, return_inverse=True)
    return first, which


def looked_up(
    answer: Callable[[Integers, Datetimes], NDArray[Answer]],
    span: Integers,
    point: Integers,
    time: Datetimes,
    points: int,
) -> NDArray[Answer]:
    """Value of `answer` at four points and an instant, computed once for each span: shape (M, ...)."""
    first, which = distinct_lookups(span, point, points)
    return np.asarray(answer(point[first], time[first])[which])
