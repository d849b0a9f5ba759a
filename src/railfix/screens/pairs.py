"""Pairs of epochs and channels of two antennas, and medians over the channels of a clock."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Floats, Indices, Integers, Strings, read_only
from railfix.core.constants import CLOCK_GROUP
from railfix.screens.base import AntennaRanges, PairedEpochs, Screened
from railfix.track.trajectory import Trajectory


def pair_epochs(time_front: ArrayLike, time_rear: ArrayLike, *, tolerance_s: float) -> tuple[Indices, Indices]:
    """Return the epochs of two receivers that belong together.

    Parameters
    ----------
    time_front, time_rear : array_like of datetime64[ns], shapes (F,), (R,)
        Rising.
    tolerance_s : float [s]
        Largest difference of the tags.

    Returns
    -------
    index_front, index_rear : ndarray of int, shape (P,)
        Each epoch is in one pair at most: with the nearest of the other that has it nearest too.
    """
    front = np.asarray(time_front, dtype="datetime64[ns]").astype(np.int64)
    rear = np.asarray(time_rear, dtype="datetime64[ns]").astype(np.int64)
    if not len(front) or not len(rear):
        return np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)
    to_rear, to_front = _nearest(front, rear), _nearest(rear, front)
    at = np.arange(len(front))
    mutual = to_front[to_rear] == at
    close = np.abs(front - rear[to_rear]) <= round(tolerance_s * 1e9)
    index = np.flatnonzero(mutual & close)
    return index, to_rear[index]


def _nearest(values: Integers, among: Integers) -> Indices:
    """Return the index of the nearest of rising numbers, the earlier of two equally near."""
    after = np.clip(np.searchsorted(among, values), 1, max(len(among) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(among) - 1)
    return np.where(np.abs(values - among[before]) <= np.abs(among[after] - values), before, after)


def pair_channels(
    satellite_front: Strings, signal_front: Strings, satellite_rear: Strings, signal_rear: Strings
) -> tuple[Indices, Indices]:
    """Return the channels of the same satellite and signal at both receivers, in the order of the front one's."""
    if satellite_front is satellite_rear and signal_front is signal_rear:  # epochs of both are rows of the same arrays
        every = np.arange(len(satellite_front))
        return every, every
    rear = {key: m for m, key in enumerate(zip(satellite_rear.tolist(), signal_rear.tolist(), strict=True))}
    keys = enumerate(zip(satellite_front.tolist(), signal_front.tolist(), strict=True))
    pairs = [(m, rear[key]) for m, key in keys if key in rear]
    both = np.array(pairs, dtype=np.intp).reshape(-1, 2)
    return both[:, 0], both[:, 1]


def on_pairs(screened: Screened, shape: tuple[int, ...], epochs: Indices, channels: Indices) -> Screened:
    """Return a verdict on pairs of epochs and channels laid on one antenna's own, of shape `shape`."""
    metric, reject = np.full(shape, np.nan), np.zeros(shape, dtype=bool)
    where = np.ix_(epochs, channels) if len(shape) > 1 else epochs
    metric[where], reject[where] = screened.metric, screened.reject
    return Screened(metric=metric, reject=reject)


def pair_antennas(
    front: AntennaRanges,
    rear: AntennaRanges,
    front_anchor_ecef_m: Floats,
    front_path: Trajectory,
    rear_path: Trajectory,
    *,
    tolerance_s: float,
) -> PairedEpochs:
    """Return the epochs of two antennas matched by their time tags, with the places of both on the line."""
    at_front, at_rear = pair_epochs(front.time, rear.time, tolerance_s=tolerance_s)
    front_arc, _ = front_path.nearest(front_anchor_ecef_m[at_front])
    rear_arc = rear_path.arc_of_body(front_path.body_at(front_arc))
    return PairedEpochs(
        front_epoch=at_front,
        rear_epoch=at_rear,
        front_ecef_m=front_path.at_arc(front_arc),
        rear_ecef_m=rear_path.at_arc(rear_arc),
        along_m=front_path.chainage_at(front_arc) - rear_path.chainage_at(rear_arc),
    )


def row_median(values: Floats) -> Floats:
    """Median of each row over what is not NaN, shape (T, 1); NaN where nothing is."""
    if not values.shape[1]:
        return np.full((len(values), 1), np.nan)
    alike = np.zeros(values.shape[1], dtype=np.intp)
    return medians_of_clocks(np.ascontiguousarray(values), alike, alike, 0)[:, :1]


def clock_medians(values: Floats, satellite: Strings, *, least: int = 0) -> Floats:
    """Median over the channels of one clock, at each channel (T, M); NaN below `least` satellites."""
    return medians_of_clocks(np.ascontiguousarray(values), *_number(tuple(satellite.tolist())), least)


@lru_cache(maxsize=256)
def _number(satellites: tuple[str, ...]) -> tuple[Indices, Indices]:
    """Receiver clock and satellite of each channel as numbers, shape (M,) each."""
    clock = np.unique([CLOCK_GROUP[name[0]] for name in satellites], return_inverse=True)[1]
    number = np.unique(list(satellites), return_inverse=True)[1]
    return read_only(clock.astype(np.intp)), read_only(number.astype(np.intp))


def medians_of_clocks(values: Floats, clock: Indices, satellite: Indices, least: int) -> Floats:
    """Compute `clock_medians`; clocks and satellites as numbers from 0 on, arrays in C order."""
    result = np.full(values.shape, np.nan)
    for one in range(int(clock.max(initial=-1)) + 1):
        columns = np.flatnonzero(clock == one)
        part = values[:, columns]
        ordered = np.sort(part, axis=1)  # NaN last
        count = np.count_nonzero(~np.isnan(part), axis=1)[:, None]
        low = np.take_along_axis(ordered, np.maximum((count - 1) // 2, 0), axis=1)
        high = np.take_along_axis(ordered, np.minimum(count // 2, len(columns) - 1), axis=1)
        enough = count > 0
        if least:
            # small counts are exact as floats, which are multiplied in blocks
            member = (satellite[columns, None] == np.unique(satellite[columns])).astype(np.float32)
            seen = np.isfinite(part).astype(np.float32) @ member > 0
            enough = enough & (np.count_nonzero(seen, axis=1)[:, None] >= least)
        result[:, columns] = np.where(enough, (low + high) / 2.0, np.nan)
    return result
