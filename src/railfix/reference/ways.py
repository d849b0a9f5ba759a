"""Distance travelled from Doppler speeds, and the instants of a reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices
from railfix.core.timescale import seconds, timedelta

#: Tags that differ by no more belong to one instant [ns].
SAME_INSTANT_NS: Final = 20_000_000
#: Speeds further apart leave the distance between them unknown [s], with this variance [m2].
LONGEST_STEP_S: Final = 2.5
UNKNOWN_M2: Final = 1e8


@dataclass(frozen=True, kw_only=True)
class Speeds:
    """Speeds of one antenna along its path; only instants at which there is one, rising in time."""

    time: Datetimes
    speed_mps: Floats
    sigma_mps: Floats

    def way(self, time: Datetimes) -> tuple[Floats, Floats]:
        """Return the distance travelled (trapezoidal rule) [m] and its variance by white noise [m2]; NaN outside."""
        if len(self.time) < 2:
            return np.full(len(time), np.nan), np.full(len(time), np.nan)
        known, at = seconds(self.time - self.time[0]), seconds(time - self.time[0])
        step = np.diff(known)
        way = np.cumsum(step * (self.speed_mps[1:] + self.speed_mps[:-1]) / 2.0)
        white = step**2 * (self.sigma_mps[1:] ** 2 + self.sigma_mps[:-1] ** 2) / 2.0
        variance = np.cumsum(np.where(step > LONGEST_STEP_S, UNKNOWN_M2, white))
        ways = [np.interp(at, known, np.append(0.0, v), left=np.nan, right=np.nan) for v in (way, variance)]
        return ways[0], ways[1]


def fused(time: Datetimes, sources: Sequence[Speeds]) -> tuple[Floats, Floats]:
    """Combine speeds of all sources, weighted by their variances, shapes (N,); NaN where there is none."""
    weight, total = np.zeros(len(time)), np.zeros(len(time))
    for source in sources:
        at = nearest(time, source.time)
        rows = np.flatnonzero(at >= 0)
        w = source.sigma_mps[rows] ** -2.0
        np.add.at(weight, at[rows], w)
        np.add.at(total, at[rows], w * source.speed_mps[rows])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(weight > 0, total / weight, np.nan), np.where(weight > 0, weight**-0.5, np.nan)


def nearest(time: Datetimes, wanted: Datetimes) -> Indices:
    """Return the row of `time` at each wanted instant within `SAME_INSTANT_NS`; -1 where there is none."""
    if not len(time):
        return np.full(len(wanted), -1, dtype=np.intp)
    have, want = time.astype(np.int64), wanted.astype(np.int64)
    after = np.clip(np.searchsorted(have, want), 0, len(have) - 1)
    before = np.maximum(after - 1, 0)
    row = np.where(np.abs(have[before] - want) <= np.abs(have[after] - want), before, after)
    return np.where(np.abs(have[row] - want) <= SAME_INSTANT_NS, row, -1).astype(np.intp)


def instants(rows: Datetimes, others: Sequence[Datetimes]) -> Datetimes:
    """Return the instants of a reference: rows of the position log, receiver epochs, regular steps elsewhere.

    The rows, at least two, rise strictly; other instants within `SAME_INSTANT_NS` of a row are that row. From the first
    row to the last no step is longer than one and a half of the rows' usual one.
    """
    merged = rows
    for other in others:
        new = other[(other > rows[0]) & (other < rows[-1])]
        merged = np.union1d(merged, new[nearest(merged, new) < 0])
    usual = float(np.median(seconds(np.diff(rows))))
    step = seconds(np.diff(merged))
    pieces = np.where(step > 1.5 * usual, np.ceil(step / usual - 1e-6), 1.0).astype(np.int64)
    first = np.repeat(np.arange(len(step)), pieces)
    number = np.arange(len(first)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    filled = merged[first] + timedelta(step[first] * number / pieces[first])
    return np.append(filled, merged[-1])
