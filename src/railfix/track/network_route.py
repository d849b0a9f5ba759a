"""The route of a run through a network of tracks, from the tracks on which its positions lie."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from railfix.track.network import Network
from railfix.track.network_match import Matched


def route_of(network: Network, matched: Matched) -> tuple[list[int], list[int]]:
    """Tracks that a run passed, in the order of travel, and those that it may have passed but no route can join to
    them.

    Gaps are filled with the shortest way over navigable connections. A train that runs back over tracks it has passed
    stays on the same route, as one does that goes round several times: each track is passed once, and a closed route
    ends where it began. Where it runs back over others, the map has a gap, or positions jump to a track beside, the
    less probable ones are left out. The route is empty where no position is on a track.
    """
    seen = matched.track[matched.track >= 0]
    if not len(seen):
        return [], []
    passed = [int(t) for t in seen[np.concatenate([[True], np.diff(seen) != 0])]]
    share = {t: float(matched.probabilities[matched.candidates.track == t].sum()) for t in set(passed)}
    routes = [network.route_over(passed)]
    if routes[0] is None:
        # the train turned back, the map has a gap, or positions lay on a track that was not passed
        routes = [*_legs(network, passed), *(_most_of(network, order, share) for order in (passed, passed[::-1]))]
    once = [part for route in routes if route is not None for part in _once(network, route)]
    route = max(once, key=lambda leg: sum(share.get(t, 0.0) for t in leg))
    return route, [t for t in dict.fromkeys(passed) if t not in route]


def _once(network: Network, route: list[int]) -> list[list[int]]:
    """The longest parts of a route that come to no joint a second time but at their end."""
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
    """The joint before each track of a route, and the one after the last: ends that links bring together."""
    rows = np.array([(2 * x.first + x.first_end, 2 * x.second + x.second_end) for x in network.links], dtype=np.intp)
    a, b = rows.reshape(-1, 2).T
    count = 2 * len(network.tracks)
    _, joint = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(count, count)), directed=False)
    entry = 0
    found: list[int] = []
    for track, after in pairwise([*route, route[-1]]):
        ends = [e for e in (0, 1) if joint[2 * track + e] in (joint[2 * after], joint[2 * after + 1])]
        if not found:
            entry = 1 - ends[0]
            found.append(int(joint[2 * track + entry]))
        found.append(int(joint[2 * track + 1 - entry]))
        entry = 0 if joint[2 * after] == found[-1] else 1
    return found


def _legs(network: Network, passed: list[int]) -> list[list[int]]:
    """The longest parts of a sequence of tracks that are a route."""
    legs: list[list[int]] = []
    start = 0
    while start < len(passed):
        rest = passed[start:]
        # the longest prefix that is a route: every prefix of one is
        count = bisect_left(range(2, len(rest) + 1), 1, key=partial(_ends_a_leg, network, rest)) + 1
        legs.append(network.shortest_route(rest[:count]))
        if count == len(rest):
            break
        start += max(count - 1, 1)
    return legs


def _most_of(network: Network, passed: list[int], share: Mapping[int, float]) -> list[int]:
    """A route over the most probable tracks, in the order in which each first comes: every part of one is a route."""
    rest, kept = sorted(share, key=lambda track: -share[track]), list[int]()

    def is_none(count: int) -> int:
        wanted = {*kept, *rest[:count]}
        return int(network.route_over([t for t in dict.fromkeys(passed) if t in wanted]) is None)

    while rest:
        count = bisect_left(range(1, len(rest) + 1), 1, key=is_none)
        kept += rest[:count]
        rest = rest[count + 1 :]
    return network.shortest_route([t for t in dict.fromkeys(passed) if t in kept])


def _ends_a_leg(network: Network, passed: list[int], count: int) -> int:
    """1 where no route leads over the first tracks, else 0."""
    return int(network.route_over(passed[:count]) is None)
