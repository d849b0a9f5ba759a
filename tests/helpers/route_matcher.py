"""Positions on a network by the shortest routes between neighbouring ones: another matcher beside railfix's.

Its states are the nearest points of all tracks near a position; the cost of a sequence is that of the distances and of
how far the shortest routes between its points differ from the straight distances (Newson & Krumm 2009,
doi:10.1145/1653771.1653818), by networkx over places written out here. It keeps no probability, no common error and no
track that the map does not have.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import networkx as nx
import numpy as np

from railfix.track.network import Network
from railfix.track.network_match import PlanLog

#: Farthest track looked at, standard deviation of a position, and scale of a route's excess over the straight [m].
WITHIN_M, SIGMA_M, EXCESS_M = 100.0, 2.0, 5.0
#: Cost of a step that no route makes, and metres from the line of positions that count no more.
NO_ROUTE, LARGEST = 200.0, 12.0


class RouteMatcher:
    """Shortest routes between places on the tracks of a network."""

    def __init__(self, network: Network) -> None:
        self.length = network.length_m
        graph: nx.DiGraph = nx.DiGraph()
        for t, length in enumerate(self.length.tolist()):
            graph.add_edge((t, 0, "in"), (t, 1, "out"), weight=length)
            graph.add_edge((t, 1, "in"), (t, 0, "out"), weight=length)
        for link in (link for link in network.links if link.navigable):
            a, b = (link.first, link.first_end), (link.second, link.second_end)
            graph.add_edge((*a, "out"), (*b, "in"), weight=0.0)
            graph.add_edge((*b, "out"), (*a, "in"), weight=0.0)
        self.ways = cache(
            lambda node: nx.single_source_dijkstra_path_length(graph, node, cutoff=3000.0, weight="weight")
        )

    def way(self, first: int, from_m: float, last: int, to_m: float) -> float:
        """Length of the shortest route without turning back; infinite where there is none within 3 km."""
        if first == last:
            return abs(to_m - from_m)
        best = np.inf
        for end, before in ((0, from_m), (1, self.length[first] - from_m)):
            ways = self.ways((first, end, "out"))
            for entry, after in ((0, to_m), (1, self.length[last] - to_m)):
                best = min(best, before + ways.get((last, entry, "in"), np.inf) + after)
        return best


def matched_track(network: Network, log: PlanLog) -> tuple[np.ndarray, np.ndarray]:
    """Track and distance from it of each position by the cheapest sequence; -1 and infinite where no track is near."""
    matcher = RouteMatcher(network)
    near = network.near(log.latitude_deg, log.longitude_deg, within_m=WITHIN_M, most=8)
    points, _, _ = network.course_on(np.maximum(near.track, 0).ravel(), np.nan_to_num(near.chainage_m).ravel())
    points = points.reshape(*near.track.shape, 3)
    rows = np.flatnonzero(near.track[:, 0] >= 0)
    cost = np.minimum(np.abs(near.offset_m) / SIGMA_M, LARGEST) ** 2 / 2.0
    cost[near.track < 0] = np.inf
    total, back = cost[rows[0]], []
    for i, j in pairwise(rows):
        step = np.full((near.track.shape[1],) * 2, NO_ROUTE)
        for a, b in np.argwhere((near.track[i] >= 0)[:, None] & (near.track[j] >= 0)):
            way = matcher.way(near.track[i, a], near.chainage_m[i, a], near.track[j, b], near.chainage_m[j, b])
            straight = float(np.linalg.norm(points[j, b] - points[i, a]))
            step[a, b] = min(abs(way - straight) / EXCESS_M, NO_ROUTE)
        back.append(np.argmin(total[:, None] + step, axis=0))
        total = np.min(total[:, None] + step, axis=0) + cost[j]
    column = np.zeros(len(rows), dtype=int)
    column[-1] = int(np.argmin(total))
    for k in range(len(back) - 1, -1, -1):
        column[k] = back[k][column[k + 1]]
    track, offset = np.full(len(log.time), -1), np.full(len(log.time), np.inf)
    track[rows], offset[rows] = near.track[rows, column], near.offset_m[rows, column]
    return track, offset
