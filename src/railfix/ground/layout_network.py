"""Layout of the interlocking from the network map: a single line with passing loops found in its tracks."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from railfix.core.arrays import Floats
from railfix.core.errors import MismatchError
from railfix.ground.layout import Layout, LoopStation
from railfix.track.network import Network

#: Distance between centrelines from which two tracks are clear of each other [m].
CLEAR_M: Final = 3.5
#: Largest difference of the lengths of two tracks of a station [m]: both have the chainage of the line.
LENGTHS_M: Final = 20.0
#: Spacing of the points at which tracks are compared [m].
_STEP_M: Final = 2.0


@dataclass(frozen=True, kw_only=True)
class NetworkLayout:
    """Layout, and the tracks of the network that it stands for.

    Attributes
    ----------
    layout : Layout
        Chainage from the line's first end along the single line and track 1 of each station.
    tracks : tuple of (str, ...)
        Names of the tracks of the line in order: one of the single line, track 1 and track 2 of a station.
    """

    layout: Layout
    tracks: tuple[tuple[str, ...], ...]


def layout_of(network: Network, *, drive: Literal["left", "right"] = "left") -> NetworkLayout:
    """Return the layout of a network that is one single line with passing loops.

    A station is a pair of tracks between the same two switches; single line lies between stations and beyond the outer
    ones. Points reach from the switch to where the two tracks are `CLEAR_M` apart. Trains of rising chainage pass a
    station on the side on which they drive: their track is track 1. MismatchError: when the network is something else:
    several lines, branches, stations of three tracks, loops of unequal length.
    """
    ends = _nodes(network)
    at: dict[int, list[int]] = defaultdict(list)
    for track, (first, last) in enumerate(ends):
        at[first].append(track)
        at[last].append(track)
    outer = sorted(node for node, tracks in at.items() if len(tracks) == 1)
    if len(outer) != 2:
        raise MismatchError(f"the network has {len(outer)} open ends; a single line with passing loops has two")
    node, done, here = outer[0], set[int](), 0.0
    stations: list[LoopStation] = []
    order: list[tuple[str, ...]] = []
    while ahead := [track for track in at[node] if track not in done]:
        done.update(ahead)
        fars = {ends[track][1] if ends[track][0] == node else ends[track][0] for track in ahead}
        names = tuple(network.names[track] for track in ahead)
        if len(ahead) > 2 or len(fars) != 1:
            raise MismatchError(
                f"tracks {', '.join(names)} leave one point and do not meet at the next: no passing loop"
            )
        far = fars.pop()
        lines = [_points_m(network, track, backward=ends[track][0] != node) for track in ahead]
        if len(ahead) == 2:
            # positive: the second lies on the right of the first
            if (_side(*lines) > 0.0) != (drive == "left"):
                ahead, names, lines = ahead[::-1], names[::-1], lines[::-1]
            stations.append(_station(names, [float(network.length_m[track]) for track in ahead], lines, here))
        here += float(network.length_m[ahead[0]])
        order.append(names)
        node = far
    if len(done) < len(ends):
        raise MismatchError(f"{len(ends) - len(done)} tracks are not part of the line that begins at an open end")
    if len(stations) < 2:
        raise MismatchError(f"the line has {len(stations)} passing loops; the interlocking needs two stations or more")
    return NetworkLayout(layout=Layout(stations=tuple(stations)), tracks=tuple(order))


def _station(names: tuple[str, ...], lengths_m: list[float], lines: list[Floats], begin_m: float) -> LoopStation:
    """The station of two tracks, track 1 first, from a chainage on."""
    if abs(lengths_m[0] - lengths_m[1]) > LENGTHS_M:
        raise MismatchError(
            f"tracks {names[0]} and {names[1]} are {lengths_m[0]:.0f} and {lengths_m[1]:.0f} m long; at most "
            f"{LENGTHS_M:g} m of difference were expected"
        )
    points = max(_clear_after_m(*lines), _clear_after_m(*(line[::-1] for line in lines)))
    return LoopStation(name=names[0], begin_m=begin_m, end_m=begin_m + lengths_m[0], points_m=round(points + 0.5, 1))


def _nodes(network: Network) -> list[tuple[int, int]]:
    """Return the point at which each track begins and ends, by numbers: ends that are linked are one point."""
    count = 2 * len(network.tracks)
    first = [2 * link.first + link.first_end for link in network.links]
    second = [2 * link.second + link.second_end for link in network.links]
    linked = coo_array((np.ones(len(first)), (first, second)), shape=(count, count))
    _, point = connected_components(linked, directed=False)
    return [(int(begin), int(end)) for begin, end in point.reshape(-1, 2)]


def _points_m(network: Network, track: int, *, backward: bool) -> Floats:
    """Return points along a track from one end, `_STEP_M` apart, shape (P, 3) ECEF [m]."""
    rows = slice(int(network.first_point[track]), int(network.first_point[track + 1]))
    chainage, points = network.chainage_m[rows], network.points_m[rows]
    along = np.append(np.arange(0.0, chainage[-1], _STEP_M), chainage[-1])
    line = np.stack([np.interp(along, chainage, points[:, k]) for k in range(3)], axis=1)
    return line[::-1] if backward else line


def _side(first: Floats, second: Floats) -> float:
    """Return on which side of the first line the middle of the second lies, positive to its right [m]."""
    middle = len(first) // 2
    ahead = first[middle + 1] - first[middle - 1]
    right = np.cross(ahead / np.linalg.norm(ahead), first[middle] / np.linalg.norm(first[middle]))
    nearest = second[cKDTree(second).query(first[middle])[1]]
    return float((nearest - first[middle]) @ right)


def _clear_after_m(first: Floats, second: Floats) -> float:
    """Return the length from the common end to where the lines are `CLEAR_M` apart [m]; MismatchError when nowhere."""
    distance, _ = cKDTree(second).query(first)
    clear = np.flatnonzero(np.asarray(distance) >= CLEAR_M)
    if not len(clear):
        raise MismatchError(f"two tracks of a station are nowhere {CLEAR_M:g} m apart")
    return float(clear[0]) * _STEP_M
