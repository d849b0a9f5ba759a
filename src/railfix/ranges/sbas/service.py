"""Where sigma UDRE holds: the regions of message type 27 (DO-229D, A.4.4.13)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Integers, Masks
from railfix.core.timescale import seconds
from railfix.ranges.sbas.decode_service import Service, service
from railfix.ranges.sbas.limits import SERVICE_FACTOR, SbasLimits
from railfix.ranges.sbas.log import SbasLog

_FACTOR = np.array(SERVICE_FACTOR)


@dataclass(frozen=True, kw_only=True)
class PlaceFactor:
    """Factor on sigma UDRE (T,), NaN where the GEO sends no type 27, or (`incomplete`) not all of a set."""

    factor: Floats
    incomplete: Masks


class ServiceTable:
    """Messages of type 27 of one GEO."""

    def __init__(self, log: SbasLog, limits: SbasLimits) -> None:
        self.values: Service = service(log)
        self.time = log.time[self.values.row]
        self._limit = limits.timeout_s("service")

    def factor(self, limits: SbasLimits, time: Datetimes, latitude_deg: Floats, longitude_deg: Floats) -> PlaceFactor:
        """Factor at places; the newest complete set of messages of one issue counts.

        Inside several regions the one of the highest priority counts, of equal ones the smallest
        factor; outside all, the factor outside.
        """
        factor, incomplete = np.full(len(time), np.nan), np.zeros(len(time), dtype=bool)
        newest = np.searchsorted(self.time, time, side="right") - 1
        for last in np.unique(newest[newest >= 0]).tolist():
            at = np.flatnonzero(newest == last)
            at = at[seconds(time[at] - self.time[last]) <= self._limit]
            rows = self._complete(last)
            if rows is None:
                incomplete[at] = limits.incomplete == "refuse"
                factor[at] = np.nan if limits.incomplete == "refuse" else 1.0
            else:
                factor[at] = self._of_set(rows, latitude_deg[at], longitude_deg[at])
        return PlaceFactor(factor=factor, incomplete=incomplete)

    def _complete(self, last: int) -> Integers | None:
        """Rows of the newest complete set at or before a row; None without one."""
        values = self.values
        young = np.flatnonzero(seconds(self.time[last] - self.time[: last + 1]) <= self._limit)
        for row in young[::-1].tolist():
            of_issue = young[(values.issue[young] == values.issue[row]) & (young <= row)]
            numbers, place = np.unique(values.message[of_issue][::-1], return_index=True)
            if len(numbers) == values.messages[row]:
                return np.asarray(of_issue[::-1][place], dtype=np.int64)
        return None

    def _of_set(self, rows: Integers, latitude_deg: Floats, longitude_deg: Floats) -> Floats:
        values = self.values
        best = np.full(len(latitude_deg), -1)
        factor = np.full(len(latitude_deg), _FACTOR[values.outside[rows[0]]])
        for row in rows.tolist():
            for region in range(int(values.regions[row])):
                inside = _inside(values, row, region, latitude_deg, longitude_deg)
                priority, here = int(values.priority[row]), _FACTOR[values.inside[row]]
                better = inside & ((priority > best) | ((priority == best) & (here < factor)))
                factor[better], best[better] = here, priority
        return factor


def _inside(values: Service, row: int, region: int, latitude_deg: Floats, longitude_deg: Floats) -> Masks:
    """Whether places lie in a region: the rectangle of two corners, or its half at (latitude 1, longitude 2)."""
    height = values.latitude_1_deg[row, region] - values.latitude_2_deg[row, region]
    width = _turn(values.longitude_2_deg[row, region] - values.longitude_1_deg[row, region])
    if height == 0.0 or width == 0.0:
        return np.zeros(len(latitude_deg), dtype=bool)
    up = (latitude_deg - values.latitude_2_deg[row, region]) / height
    along = _turn(longitude_deg - values.longitude_1_deg[row, region]) / width
    inside = (up >= 0.0) & (up <= 1.0) & (along >= 0.0) & (along <= 1.0)
    return np.asarray(inside if values.square[row, region] else inside & (up + along >= 1.0))


def _turn(angle_deg: Floats | np.float64) -> Floats:
    return np.asarray((angle_deg + 180.0) % 360.0 - 180.0)
