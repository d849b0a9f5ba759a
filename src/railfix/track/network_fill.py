"""Places on a network between known ones: tunnels and gaps of a log, filled by the shortest connected route."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices, Masks
from railfix.track.network import Network
from railfix.track.network_match import Matched

#: Rows between known places that are filled: those without position, or also those whose positions lie off the map.
Rows = Literal["gaps", "off-map"]


@dataclass(frozen=True, kw_only=True)
class Filled:
    """Places of all positions, shapes (n,).

    Attributes
    ----------
    track : ndarray of int
        -1 where no route joins the known places before and after, or one of them is missing.
    chainage_m : ndarray
    bound_m : ndarray
        Farthest that a train on this route, which does not turn back, can be from the filled place [m]; NaN where the
        place was known.
    """

    track: Indices
    chainage_m: Floats
    bound_m: Floats

    @property
    def filled(self) -> Masks:
        """Rows that were filled."""
        return np.isfinite(self.bound_m)


def fill_gaps(network: Network, matched: Matched, time: Datetimes, *, rows_to_fill: Rows = "gaps") -> Filled:
    """Fill rows without usable position between known places: shortest route, even speed (by rows without times).

    A gap with positions that lie off the map is left as it is, as the train may have left the map there; unless
    `rows_to_fill` is "off-map", as in a tunnel, where positions drift.
    """
    track, chainage = matched.track.copy(), matched.chainage_m.copy()
    bound = np.full(len(track), np.nan)
    known = np.flatnonzero(track >= 0)
    for i in np.flatnonzero(np.diff(known) > 1):
        first, last = known[i], known[i + 1]
        if rows_to_fill == "gaps" and not np.isnan(matched.probability[first + 1 : last]).all():
            continue
        legs = _legs(network, int(track[first]), chainage[first], int(track[last]), chainage[last])
        if legs is None:
            continue
        rows = np.arange(first, last + 1)
        at = rows.astype(float) if np.isnat(time[rows]).any() else (time[rows] - time[first]) / np.timedelta64(1, "ns")
        share = (at[1:-1] - at[0]) / (at[-1] - at[0]) if at[-1] > at[0] else np.full(len(rows) - 2, 0.5)
        numbers, enter, leave = legs
        ends = np.cumsum(np.abs(leave - enter))
        way = share * ends[-1]
        leg = np.minimum(np.searchsorted(ends, way), len(ends) - 1)
        inner = rows[1:-1]
        track[inner] = numbers[leg]
        chainage[inner] = leave[leg] - np.sign(leave - enter)[leg] * (ends[leg] - way)
        bound[inner] = np.maximum(way, ends[-1] - way)
    return Filled(track=track, chainage_m=chainage, bound_m=bound)


def _legs(network: Network, first: int, from_m: float, last: int, to_m: float) -> tuple[Indices, Floats, Floats] | None:
    """Tracks of the shortest route between two places, and the chainages where each is entered and left."""
    if first == last:
        return np.array([first]), np.array([from_m]), np.array([to_m])
    length = network.length_m
    best, nodes = np.inf, list[int]()
    for end, before in ((0, from_m), (1, length[first] - from_m)):
        ways, paths = network.ways_from(4 * first + 2 * end + 1, last)
        for entry, after in ((0, to_m), (1, length[last] - to_m)):
            node = 4 * last + 2 * entry
            if node in ways and before + ways[node] + after < best:
                best, nodes = before + ways[node] + after, paths[node]
    if not nodes:
        return None
    # nodes alternate: left, entered, left, ..., entered
    place = [0.0 if node % 4 < 2 else float(length[node // 4]) for node in nodes]
    numbers = [first, *(node // 4 for node in nodes[1::2])]
    return np.array(numbers), np.array([from_m, *place[1::2]]), np.array([*place[0::2], to_m])
