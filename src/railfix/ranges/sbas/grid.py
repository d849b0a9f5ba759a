"""The ionospheric grid: where its points are, and what one GEO says about them (DO-229D, A.4.4.9 and A.4.4.10)."""

from __future__ import annotations

from collections import Counter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, Integers, Masks
from railfix.core.timescale import seconds
from railfix.ranges.sbas.decode import grid_delays, grid_masks
from railfix.ranges.sbas.limits import STOP_S, SbasLimits
from railfix.ranges.sbas.log import SbasLog
from railfix.ranges.sbas.spans import Spans
from railfix.ranges.sbas.tables import LONG_AGO, Stops
from railfix.ranges.sbas.timeline import Timeline, series_order

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
    delay_m : ndarray, shape (n,) [m]
        Vertical, NaN for do not use.
    givei : ndarray of int, shape (n,)
    time : ndarray of datetime64[ns], shape (n,)
    newest : Timeline
        Of points.
    spans : Spans
        In which nothing about the grid changes.
    """

    def __init__(self, log: SbasLog, limits: SbasLimits, stops: Stops) -> None:
        self.unused: Counter[str] = Counter()
        self._stops = stops
        timeouts = [limits.timeout_s(what) for what in ("grid_mask", "grid_delay", "degradation")]
        self.spans = Spans(log.time, [*timeouts, STOP_S])
        self._mask_limit = limits.timeout_s("grid_mask")
        masks = grid_masks(log)
        known = np.flatnonzero(masks.band < BANDS)
        time, band, mask = log.time[masks.row[known]], masks.band[known], masks.mask[known]
        cell = (band[:, None] * BITS + np.arange(BITS)).ravel()
        cell_time = np.repeat(time, BITS)
        order = series_order(cell, cell_time)
        self._member, self._member_time = mask.ravel()[order], cell_time[order]
        self._by_cell = Timeline(cell[order], self._member_time)
        issue = band * 4 + masks.iodi[known]
        order = series_order(issue, time)
        self._mask_time = time[order]
        self._by_issue = Timeline(issue[order], self._mask_time)
        self._fill(log, mask[order])

    def _fill(self, log: SbasLog, masks: Masks) -> None:
        """Delays by point: the k-th of a block belongs to the k-th point of the mask of its issue."""
        decoded = grid_delays(log)
        kept = np.flatnonzero(decoded.band < BANDS)
        band, time = decoded.band[kept], log.time[decoded.row[kept]]
        issue = band * 4 + decoded.iodi[kept]
        mask = self._by_issue.newest(issue, time)
        fits = self.mask_active(issue, time)
        self.unused["grid delays without a mask of their IODI"] += int((~fits).sum()) * BLOCK
        kept, band, time, issue, mask = kept[fits], band[fits], time[fits], issue[fits], mask[fits]
        rank = np.full((len(masks), BITS), -1, dtype=np.int64)
        row, bit = np.nonzero(masks)
        rank[row, np.arange(len(row)) - np.searchsorted(row, row)] = bit
        place = decoded.block[kept][:, None] * BLOCK + np.arange(BLOCK)
        bits = np.where(place < BITS, rank[mask[:, None], np.minimum(place, BITS - 1)], -1) if len(mask) else place
        point = np.where(bits >= 0, POINT_OF_BIT[band[:, None], np.maximum(bits, 0)], -1).ravel()
        used = np.flatnonzero(point >= 0)
        when = np.repeat(time, BLOCK)
        order = used[series_order(point[used], when[used])]
        self.point, self.time = point[order], when[order]
        self.delay_m = decoded.delay_m[kept].ravel()[order]
        self.givei = decoded.givei[kept].ravel()[order]
        self.issue = np.repeat(issue, BLOCK)[order]
        self.newest = Timeline(self.point, self.time)

    def mask_active(self, issue: Integers, time: Datetimes) -> Masks:
        """Whether the mask of a band and issue (4 band + IODI) is known and not timed out."""
        row = self._by_issue.newest(issue, time)
        if not len(self._mask_time):
            return np.zeros(row.shape, dtype=bool)
        received = np.where(row >= 0, self._mask_time[row], LONG_AGO)
        return (row >= 0) & (seconds(time - received) <= self._mask_limit) & (received > self._stops.last(time))

    def in_mask(self, point: Integers, time: Datetimes) -> Masks:
        """Whether points are in the newest mask of a band of theirs that has not timed out."""
        found = np.zeros(np.broadcast_shapes(point.shape, time.shape), dtype=bool)
        if not len(self._member):
            return found
        for cell in np.moveaxis(CELLS_OF_POINT[point], -1, 0):
            row = self._by_cell.newest(cell, time)
            received = np.where(row >= 0, self._member_time[row], LONG_AGO)
            fresh = (seconds(time - received) <= self._mask_limit) & (received > self._stops.last(time))
            found |= (row >= 0) & self._member[row] & fresh
        return found
