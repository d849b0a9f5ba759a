"""Quality of a network of tracks: gaps, dead ends, kinks at connections, tracks too near to each other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import networkx as nx
import numpy as np
from scipy.spatial import cKDTree

from railfix.track.network import Network, end_points

#: Ends nearer than this without a connection are a gap [m].
_GAP_M: Final = 5.0
#: Connected ends farther apart than this do not meet [m].
_JOINT_M: Final = 0.5
#: Largest change of direction over a navigable connection [deg]; a switch of 1:4.5 turns 12.5 deg over its length.
_KINK_DEG: Final = 15.0
#: Least spacing of tracks beside each other [m]: less leaves no clearance between vehicles.
_LEAST_SPACING_M: Final = 2.5
#: Tracks may be nearer than that within this way of their ends, where a switch brings them together [m].
_SWITCH_M: Final = 80.0
#: Least way over which tracks run too near to each other to count [m].
_LEAST_WAY_M: Final = 10.0


@dataclass(frozen=True, kw_only=True)
class NetworkFinding:
    """A fault of a network: kind, tracks, place and a sentence."""

    kind: str
    tracks: tuple[str, ...]
    latitude_deg: float
    longitude_deg: float
    sentence: str


@dataclass(frozen=True, kw_only=True)
class NetworkQuality:
    """Counts and faults of a network.

    Attributes
    ----------
    tracks, switches, ends, parts : int
        Tracks; ends from which two or more tracks can be reached; ends without a navigable connection; parts that
        no connection joins.
    length_m : float
    findings : tuple of NetworkFinding
    """

    tracks: int
    switches: int
    ends: int
    parts: int
    length_m: float
    findings: tuple[NetworkFinding, ...]


def check_network(network: Network) -> NetworkQuality:
    """Check the connections of a network and the distances between its tracks."""
    joined: nx.Graph[int] = nx.Graph()
    joined.add_nodes_from(range(len(network.tracks)))
    joined.add_edges_from((link.first, link.second) for link in network.links)
    passages: dict[tuple[int, int], set[tuple[int, int]]] = {}
    for link in network.links:
        if link.navigable:
            a, b = (link.first, link.first_end), (link.second, link.second_end)
            passages.setdefault(a, set()).add(b)
            passages.setdefault(b, set()).add(a)
    loose = [(t, e) for t in range(len(network.tracks)) for e in (0, 1) if (t, e) not in passages]
    findings = [*_gaps(network, loose), *_joints(network), *_too_near(network)]
    return NetworkQuality(
        tracks=len(network.tracks),
        switches=sum(len(others) > 1 for others in passages.values()),
        ends=len(loose),
        parts=nx.number_connected_components(joined),
        length_m=float(network.length_m.sum()),
        findings=tuple(findings),
    )


def _place(network: Network, track: int, end: int) -> dict[str, float]:
    segment = network.tracks[track]
    k = -end  # 0 is the first point, -1 the last
    return {"latitude_deg": float(segment.latitude_deg[k]), "longitude_deg": float(segment.longitude_deg[k])}


def _gaps(network: Network, loose: list[tuple[int, int]]) -> Iterator[NetworkFinding]:
    """Ends without a connection near another such end, or that turn into nothing."""
    if not loose:
        return
    ends, outward = end_points(network)
    points = np.array([ends[t, e] for t, e in loose])
    facing = np.array([outward[t, e] for t, e in loose])
    # two tracks that end beside each other point the same way
    near = [(a, b) for a, b in cKDTree(points).query_pairs(_GAP_M) if facing[a] @ facing[b] < 0.0]
    for a, b in sorted(near):
        (t, e), (u, _) = loose[a], loose[b]
        gap = float(np.linalg.norm(points[a] - points[b]))
        names = (network.names[t], network.names[u])
        yield NetworkFinding(
            kind="gap",
            tracks=names,
            **_place(network, t, e),
            sentence=f"{names[0]} and {names[1]} end {gap:.2f} m apart without a navigable connection",
        )
    paired = {k for pair in near for k in pair}
    for k, (t, e) in enumerate(loose):
        if k not in paired:
            name = network.names[t]
            yield NetworkFinding(
                kind="dead end", tracks=(name,), **_place(network, t, e), sentence=f"{name} ends without a connection"
            )


def _joints(network: Network) -> Iterator[NetworkFinding]:
    """Connections whose ends do not meet, and navigable ones with a kink."""
    ends, outward = end_points(network)
    for link in network.links:
        first, second = (link.first, link.first_end), (link.second, link.second_end)
        names = (network.names[link.first], network.names[link.second])
        gap = float(np.linalg.norm(ends[first] - ends[second]))
        if gap > _JOINT_M:
            yield NetworkFinding(
                kind="joint",
                tracks=names,
                **_place(network, *first),
                sentence=f"the connected ends of {names[0]} and {names[1]} are {gap:.2f} m apart",
            )
        turn = 180.0 - np.degrees(np.arccos(np.clip(outward[first] @ outward[second], -1.0, 1.0)))
        if link.navigable and turn > _KINK_DEG:
            yield NetworkFinding(
                kind="kink",
                tracks=names,
                **_place(network, *first),
                sentence=f"the direction changes by {turn:.0f} deg from {names[0]} to {names[1]}",
            )


def _too_near(network: Network) -> Iterator[NetworkFinding]:
    """Pairs of tracks nearer than vehicles' clearance away from their ends."""
    latitude = np.concatenate([t.latitude_deg for t in network.tracks])
    longitude = np.concatenate([t.longitude_deg for t in network.tracks])
    track = np.repeat(np.arange(len(network.tracks)), np.diff(network.first_point))
    inner = (network.chainage_m > _SWITCH_M) & (network.chainage_m < network.length_m[track] - _SWITCH_M)
    rows = np.flatnonzero(inner)
    near = network.near(latitude[rows], longitude[rows], within_m=_LEAST_SPACING_M)
    other = (near.track >= 0) & (near.track != track[rows, None])
    place = np.where(other, near.chainage_m, 0.0)
    other &= (place > _SWITCH_M) & (place < network.length_m[np.where(other, near.track, 0)] - _SWITCH_M)
    pairs: dict[tuple[int, int], list[tuple[int, float]]] = {}
    for row, column in zip(*np.nonzero(other), strict=True):
        key = (int(track[rows[row]]), int(near.track[row, column]))
        pairs.setdefault(key, []).append((int(rows[row]), abs(float(near.offset_m[row, column]))))
    for (a, b), points in sorted(pairs.items()):
        places = network.chainage_m[[k for k, _ in points]]
        if a < b and places.max() - places.min() >= _LEAST_WAY_M:
            names = (network.names[a], network.names[b])
            yield NetworkFinding(
                kind="too near",
                tracks=names,
                latitude_deg=float(latitude[points[0][0]]),
                longitude_deg=float(longitude[points[0][0]]),
                sentence=f"{names[0]} and {names[1]} are {min(d for _, d in points):.2f} m apart over "
                f"{places.max() - places.min():.0f} m away from their ends; the same track twice, or a crossing?",
            )
