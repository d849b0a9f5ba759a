"""Find a run's route through a network of tracks, and fill gaps in its log along the shortest route."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import fsum
from typing import Literal

import numpy as np

from railfix.core.arrays import Floats, Indices
from railfix.core.errors import MismatchError
from railfix.core.geodesy import ecef_from_geodetic
from railfix.track.network import Network
from railfix.track.network_match import Matched, PlanLog

#: Rows to be filled: rows without a position ("gaps"), or in addition rows with positions off the map ("off-map").
Rows = Literal["gaps", "off-map"]
#: Rows with positions off the map are not filled if the length of the route differs by more than this from the distance
#: travelled according to the positions, or if a route's open end is farther than this from a track [m].
_DRIFT_M = 500.0
_STEPS = 15  #: Length of the median filter for steps between positions, which suppresses jumps.


@dataclass(frozen=True, kw_only=True)
class Filled:
    """Positions of all rows of a log on a network, shapes (n,)."""

    track: Indices  #: Index of the track; -1 if the row has no position and was not filled.
    chainage_m: Floats  #: Chainage on the track.
    #: Upper bound of the distance between the train and a filled position, provided that the train is on the route. It
    #: is infinite before the first and after the last known position, and NaN in rows that were not filled.
    bound_m: Floats


def fill_gaps(network: Network, matched: Matched, log: PlanLog, *, rows_to_fill: Rows = "gaps") -> Filled:
    """Fill rows without a usable position along the shortest route between known positions.

    The speed between known positions is assumed to be constant. If `rows_to_fill` is "off-map" and there are positions
    off the map, the steps between these positions replace this assumption.
    """
    filled = Filled(
        track=matched.track.copy(), chainage_m=matched.chainage_m.copy(), bound_m=np.full(len(matched.track), np.nan)
    )
    travelled = _distance_m(log)
    known = np.flatnonzero(matched.track >= 0)
    for first, last in pairwise(known):
        drifting = not np.isnan(matched.probability[first + 1 : last]).all()
        if last == first + 1 or (rows_to_fill == "gaps" and drifting):
            continue
        legs = _fill_legs(network, *_place(matched, first), *_place(matched, last))
        rows = np.arange(first, last + 1)
        at = travelled[rows]
        if not drifting or np.isnan(at).any():
            no_time = np.isnat(log.time[rows]).any()
            at = rows.astype(float) if no_time else (log.time[rows] - log.time[first]) / np.timedelta64(1, "ns")
        elif legs is not None and _excess_m(legs, at) > _DRIFT_M:
            continue
        if legs is not None:
            _put_on(filled, legs, rows[1:-1], at)
    if rows_to_fill == "off-map" and len(known):
        _fill_before(network, matched, log, travelled, np.arange(known[0], -1, -1), filled)
        _fill_before(network, matched, log, travelled, np.arange(known[-1], len(matched.track)), filled)
    return filled


def _fill_before(
    network: Network, matched: Matched, log: PlanLog, travelled_m: Floats, rows: Indices, filled: Filled
) -> None:
    """In `filled`, fill the rows before the first or after the last known position.

    The first of the `rows` has the known position. `rows` are filled up to the first row without a position.
    """
    rows = rows[: np.argmin([*np.isfinite(travelled_m[rows]), False])]
    if len(rows) < 2:
        return
    outer, way = rows[-1:], np.abs(travelled_m[rows] - travelled_m[rows[0]])
    near = network.near(log.latitude_deg[outer], log.longitude_deg[outer], within_m=_DRIFT_M)
    best, route = 2.0 * _DRIFT_M, None
    for track, chainage, offset in zip(near.track[0], near.chainage_m[0], near.offset_m[0], strict=True):
        legs = None if track < 0 else _fill_legs(network, *_place(matched, rows[0]), int(track), float(chainage))
        if legs is not None:
            cost = abs(offset) + _excess_m(legs, way)
            best, route = (cost, legs) if cost < best else (best, route)
    if route is not None:
        _put_on(filled, route, rows[1:], way, ends_known=False)


def _excess_m(legs: tuple[Indices, Floats, Floats], way_m: Floats) -> float:
    """Return the absolute difference between the length of a route and the distance travelled [m]."""
    return abs(float(np.abs(legs[2] - legs[1]).sum()) - float(way_m[-1] - way_m[0]))


def _place(matched: Matched, row: int | np.intp) -> tuple[int, float]:
    return int(matched.track[row]), float(matched.chainage_m[row])


def _distance_m(log: PlanLog) -> Floats:
    """Return the distance travelled at each row, shape (n,) [m]; NaN without a position.

    The distance is the sum of the steps between positions, filtered by a median over `_STEPS` steps to suppress jumps.
    """
    from scipy.ndimage import median_filter

    ecef = ecef_from_geodetic(log.latitude_deg, log.longitude_deg, np.zeros(len(log.time)))
    step = np.linalg.norm(np.diff(ecef, axis=0), axis=1)
    speed = median_filter(np.nan_to_num(step), _STEPS, mode="nearest")
    travelled = np.concatenate([[0.0], np.cumsum(speed)])
    return np.where(np.isfinite(ecef[:, 0]), travelled, np.nan)


def _put_on(
    filled: Filled, legs: tuple[Indices, Floats, Floats], rows: Indices, at: Floats, *, ends_known: bool = True
) -> None:
    """Distribute rows along a route in proportion to the increase of `at`, and set their positions in `filled`.

    The first and last values of `at` are at the start and end of the route. `ends_known` is true if the train's
    position is known at both ends of the route; otherwise the bound is infinite.
    """
    numbers, enter, leave = legs
    share = (at - at[0]) / (at[-1] - at[0]) if at[-1] > at[0] else np.full(len(at), 0.5)
    share = share[1 : len(rows) + 1]
    ends = np.cumsum(np.abs(leave - enter))
    way = share * ends[-1]
    leg = np.minimum(np.searchsorted(ends, way), len(ends) - 1)
    filled.track[rows] = numbers[leg]
    filled.chainage_m[rows] = leave[leg] - np.sign(leave - enter)[leg] * (ends[leg] - way)
    filled.bound_m[rows] = np.maximum(way, ends[-1] - way) if ends_known else np.inf


def _fill_legs(
    network: Network, first: int, from_m: float, last: int, to_m: float
) -> tuple[Indices, Floats, Floats] | None:
    """Return the tracks of the shortest route between two positions, and the first and last chainages on each track
    [m].

    A position is a track index and a chainage [m]. The result is None if there is no route.
    """
    if first == last:
        return np.array([first]), np.array([from_m]), np.array([to_m])
    length = network.length_m
    begun = {4 * first + 1: (from_m, [4 * first + 1]), 4 * first + 3: (length[first] - from_m, [4 * first + 3])}
    ended = [
        (so_far + (to_m if entry == 4 * last else length[last] - to_m), nodes)
        for entry, (so_far, nodes) in network.extend_routes(begun, last).items()
    ]
    if not ended:
        return None
    begin, *entered = min(ended)[1]
    left = [begin, *(node ^ 3 for node in entered[:-1])]
    enter, leave = ([0.0 if node % 4 < 2 else float(length[node // 4]) for node in nodes] for nodes in (entered, left))
    numbers = [first, *(node // 4 for node in entered)]
    return np.array(numbers), np.array([from_m, *enter]), np.array([*leave, to_m])


def find_route(network: Network, matched: Matched, path: str = "the log") -> tuple[list[int], list[int]]:
    """Return the indices of the tracks that a run passed, in order of travel, and of other tracks with positions.

    Each track is in the route once. The other tracks cannot be joined to the route. Raise MismatchError if no position
    lies on a track; the message states the log and the location of the positions.
    """
    seen = matched.track[matched.track >= 0]
    if not len(seen):
        raise MismatchError(f"{path}: no position lies on a track of the network{_beside(network, matched)}")
    passed = [int(t) for t in seen[np.concatenate([[True], np.diff(seen) != 0])]]
    share = {t: float(matched.probabilities[matched.candidates.track == t].sum()) for t in set(passed)}
    routes = [network.route_over(passed)]
    if routes[0] is None:
        # there is no route if the train turned back, the map has a gap, or positions were matched to a track that was
        # not passed
        routes = [_choose_route(network, order, share) for order in (passed, passed[::-1])]
    once = [part for route in routes if route is not None for part in _once(network, route)]
    # `fsum` gives equal sums for a route and its reverse, because its result does not depend on the order
    route = max(once, key=lambda leg: fsum(share.get(t, 0.0) for t in leg))
    return route, [t for t in dict.fromkeys(passed) if t not in route]


def left_out_note(network: Network, left_out: Sequence[int]) -> str:
    """Return the note on the tracks that cannot be joined to the route of a run; see `find_route`."""
    beside = ", ".join(network.names[k] for k in left_out)
    return f"{beside} cannot be joined to the route: the train turned back there, or the map has a gap"


def _beside(network: Network, matched: Matched) -> str:
    """Return the end of the message that no position is on a track: the distance of the positions from a track."""
    track, offset = matched.candidates.track[:, 0], matched.candidates.offset_m[:, 0]
    near = track >= 0
    if not near.any():
        return "; check whether the map is of this region, and its CRS is right"
    most = int(np.bincount(track[near]).argmax())
    away = float(np.median(offset[track == most]))
    side = "right" if away > 0.0 else "left"
    where = f"{abs(away):.1f} m {side} of {network.names[most]}"
    return f": the positions lie {where}; their track is missing from the map, or the map is displaced"


def _once(network: Network, route: list[int]) -> list[list[int]]:
    """Split a route into the longest parts that pass no joint twice.

    A part may end at a joint that it has passed before.
    """
    joints = _joints(network, route)
    parts: list[list[int]] = []
    last = 0
    for start in range(len(route)):
        end = start + 1
        while end < len(route) and joints[end] not in joints[start:end]:
            end += 1
        if end > last:
            parts.append(route[start:end])
            last = end
    return parts


def _joints(network: Network, route: list[int]) -> list[int]:
    """Return the joint before each track of a route, and the joint after the last track."""
    joint, entry = network.joints, 0
    found: list[int] = []
    for track, after in pairwise([*route, route[-1]]):
        ends = [e for e in (0, 1) if joint[track, e] in joint[after]]
        if not found:
            entry = 1 - ends[0]
            found.append(int(joint[track, entry]))
        found.append(int(joint[track, 1 - entry]))
        entry = 0 if joint[after, 0] == found[-1] else 1
    return found


def _choose_route(network: Network, passed: list[int], share: Mapping[int, float]) -> list[int]:
    """Return a route over the most probable tracks, in the order in which the run first passed them.

    The tracks are tried in descending order of probability. A track is left out if no route joins it to the tracks kept
    so far.
    """
    rest, kept = sorted(share, key=lambda track: -share[track]), list[int]()

    def is_none(count: int) -> int:
        wanted = {*kept, *rest[:count]}
        return int(network.route_over([t for t in dict.fromkeys(passed) if t in wanted]) is None)

    while rest:
        count = bisect_left(range(1, len(rest) + 1), 1, key=is_none)
        kept += rest[:count]
        rest = rest[count + 1 :]
    return network.shortest_route([t for t in dict.fromkeys(passed) if t in kept])
