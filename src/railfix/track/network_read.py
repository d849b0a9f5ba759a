"""Read networks of tracks from map files, connect tracks, and check networks for gaps, dead ends and kinks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import Final

import networkx as nx
import numpy as np
from scipy.spatial import cKDTree

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError
from railfix.core.files import FilePath, ending, read_text
from railfix.io.file_kind import find_kind
from railfix.track.network import Link, Network, end_points
from railfix.track.point_files import RELATION
from railfix.track.read import read_segments
from railfix.track.route import MapReading, Segment, check_order, first_gap, orient
from railfix.track.vector_file import CROSSING, read_layers
from railfix.track.xml_files import Relation, read_railml_relations, read_rinf_relations

TOLERANCE_M: Final = 0.5  #: Ends closer than this are connected if the file states no connections [m].
#: A train can pass a connection if the direction changes by less than this [rad]. From one leg of a switch to the other
#: leg, the direction would change by about pi.
_LARGEST_TURN_RAD: Final = np.radians(60.0)


def read_network(
    paths: Sequence[FilePath], reading: MapReading | None = None, *, tolerance_m: float = TOLERANCE_M
) -> Network:
    """Read a network of tracks from map files.

    Tracks are connected as the files state. Without such statements, tracks are connected where two ends, or an end and
    another track, are within `tolerance_m`. Raise InputFileError or SettingsError as `railfix.track.read_track` does.
    """
    tracks = [track for path in paths for track in read_segments(path, reading or MapReading())]
    check_order(tracks)
    return connect_network(tracks, paths, tolerance_m=tolerance_m)


def connect_network(tracks: list[Segment], paths: Sequence[FilePath], *, tolerance_m: float = TOLERANCE_M) -> Network:
    """Connect tracks to a network, as their files state, or where their ends meet; see `read_network`."""
    relations = [relation for path in paths for relation in _relations(path)]
    if relations:
        return _of_relations(tracks, relations, str(paths[0]))
    if all(track.nodes for track in tracks):
        return _of_nodes(tracks)
    whole = Network(tracks=tuple(tracks), links=())
    cuts = _places_of_ends(whole, tolerance_m)
    network, _ = _divide(whole, cuts)
    note = f"tracks are connected at ends within {tolerance_m:g} m; {len(cuts)} tracks are divided where other "
    note += "tracks end"
    if packed := [path for path in paths if ending(path) == ".pbf"]:
        note += (
            f"; {packed[0]} is read without node ids; to keep them, convert it: 'osmium cat FILE.osm.pbf -o FILE.osm'"
        )
    return network.connect(links_of_ends(network, tolerance_m=tolerance_m), note)


def _of_nodes(tracks: list[Segment]) -> Network:
    """Connect OpenStreetMap ways at the nodes that they share; ways are divided at shared inner nodes."""
    used = Counter(node for track in tracks for node in track.nodes)
    inner = [[i for i, node in enumerate(t.nodes[1:-1], start=1) if used[node] > 1] for t in tracks]
    whole = Network(tracks=tuple(tracks), links=())
    network, way_of_part = _divide(
        whole, {k: [float(whole.chainage_m[whole.first_point[k] + i]) for i in at] for k, at in enumerate(inner) if at}
    )
    bounds = [pair for t, at in zip(tracks, inner, strict=True) for pair in pairwise([0, *at, len(t.nodes) - 1])]
    ends: dict[str, list[tuple[int, int]]] = {}
    for k, (low, high) in enumerate(bounds):
        for end, at_node in enumerate((low, high)):
            ends.setdefault(tracks[way_of_part[k]].nodes[at_node], []).append((k, end))
    _, outward = end_points(network)
    links = []
    for node, meeting in ends.items():
        for (a, first), (b, second) in combinations(meeting, 2):
            ahead = float(outward[a, first] @ outward[b, second]) < -np.cos(_LARGEST_TURN_RAD)
            crosses = node.startswith(CROSSING) and way_of_part[a] != way_of_part[b]
            navigable = ahead and a != b and not crosses
            links.append(Link(first=a, first_end=first, second=b, second_end=second, navigable=navigable))
    note = f"tracks are connected at the nodes that ways share; {sum(map(bool, inner))} ways are divided at inner nodes"
    return network.connect(tuple(links), note)


def _relations(path: FilePath) -> list[Relation]:
    """Return the connections that a file states; an empty list if the file states none."""
    kind = find_kind(path)
    if kind == "xml":
        return read_railml_relations(path)
    if kind == "rdf":
        return read_rinf_relations(path)
    if kind not in ("geojson", "gpkg", "fgb") or (kind == "geojson" and RELATION not in read_text(path)):
        return []
    relations = []
    for _, rows, _ in read_layers(path, geometry="none"):
        for row in rows:
            stated = {key: value for key, value in row.items() if value is not None and value == value}
            if RELATION not in stated:
                continue
            if missing := [key for key in ("netelementB", "positionOnA", "positionOnB") if key not in stated]:
                raise InputFileError(path, f"net relation {stated.get('id', '')!r} has no {', '.join(missing)}")
            relations.append(
                Relation(
                    first=str(stated[RELATION]),
                    second=str(stated["netelementB"]),
                    first_end=int(stated["positionOnA"]),
                    second_end=int(stated["positionOnB"]),
                    navigable=str(stated.get("navigability") or "both").lower() != "none",
                )
            )
    return relations


def _of_relations(tracks: list[Segment], relations: list[Relation], path: str) -> Network:
    number = {track.metadata.get("name"): k for k, track in enumerate(tracks)}
    known = [r for r in relations if r.first in number and r.second in number]
    if not known:
        raise InputFileError(path, f"none of its {len(relations)} net relations names a track of the file")
    links = tuple(Link(**{**vars(r), "first": number[r.first], "second": number[r.second]}) for r in known)
    note = f"tracks are connected by {len(known)} net relations of the file"
    if len(known) < len(relations):
        note += f"; {len(relations) - len(known)} relations name a track that is not in the file"
    return Network(tracks=tuple(tracks), links=links, notes=(note,))


def links_of_ends(network: Network, *, tolerance_m: float = TOLERANCE_M) -> tuple[Link, ...]:
    """Return connections between all ends that are within `tolerance_m` of each other.

    A connection is navigable if the direction changes by less than 60 deg. Ends on different levels are not connected.
    """
    ends, outward = end_points(network)
    pairs = cKDTree(ends.reshape(-1, 3)).query_pairs(tolerance_m, output_type="ndarray")
    level = np.array([track.metadata.get("level", "") for track in network.tracks])
    # ends of a bridge and a tunnel that meet in plan are not connected; a track on the ground is connected to both
    apart = (level[pairs[:, 0] // 2] != level[pairs[:, 1] // 2]) & (level[pairs // 2] != "").all(axis=1)
    pairs = pairs[~apart]
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    a, b = pairs.T
    facing = np.einsum("ij,ij->i", outward.reshape(-1, 3)[a], outward.reshape(-1, 3)[b])
    navigable = (facing < -np.cos(_LARGEST_TURN_RAD)) & (a // 2 != b // 2)
    return tuple(
        Link(first=i // 2, first_end=i % 2, second=j // 2, second_end=j % 2, navigable=n)
        for i, j, n in zip(a.tolist(), b.tolist(), navigable.tolist(), strict=True)
    )


def is_route(segments: Sequence[Segment]) -> bool:
    """Return whether consecutive segments meet at their ends without a reversal of direction."""
    if first_gap(segments) is not None:
        return False
    _, outward = end_points(Network(tracks=tuple(orient(segments)), links=()))
    return bool((np.einsum("ij,ij->i", outward[:-1, 1], outward[1:, 0]) < -np.cos(_LARGEST_TURN_RAD)).all())


def _places_of_ends(whole: Network, tolerance_m: float) -> dict[int, list[float]]:
    """For each track index, return the ascending chainages [m] at which other tracks end within `tolerance_m`."""
    tracks = whole.tracks
    latitude = np.array([[t.latitude_deg[0], t.latitude_deg[-1]] for t in tracks]).ravel()
    longitude = np.array([[t.longitude_deg[0], t.longitude_deg[-1]] for t in tracks]).ravel()
    near = whole.near(latitude, longitude, within_m=tolerance_m)
    cuts: dict[int, list[float]] = {}
    for end, column in zip(*np.nonzero(near.track >= 0), strict=True):
        other, place = int(near.track[end, column]), float(near.chainage_m[end, column])
        levels = {tracks[k].metadata.get("level", "") for k in (other, end // 2)} - {""}
        if other != end // 2 and len(levels) < 2 and tolerance_m < place < whole.length_m[other] - tolerance_m:
            cuts.setdefault(other, []).append(place)
    return {
        k: [p for i, p in enumerate(sorted(at)) if i == 0 or p - sorted(at)[i - 1] > tolerance_m]
        for k, at in cuts.items()
    }


def _divide(whole: Network, places: Mapping[int, Sequence[float]]) -> tuple[Network, list[int]]:
    """Divide tracks at chainages [m], and return the network of parts and the original track index of each part."""
    parts: list[tuple[Segment, int]] = []
    for k, track in enumerate(whole.tracks):
        way = whole.chainage_m[whole.first_point[k] : whole.first_point[k + 1]]
        bounds = pairwise([0.0, *places.get(k, ()), float(way[-1])])
        parts += [
            (_part(track, way, low, high, number) if k in places else track, k)
            for number, (low, high) in enumerate(bounds, start=1)
        ]
    return Network(tracks=tuple(part for part, _ in parts), links=()), [k for _, k in parts]


def _part(track: Segment, way: Floats, low: float, high: float, number: int) -> Segment:
    inside = (way > low + 1e-6) & (way < high - 1e-6)
    place = np.concatenate([[low], way[inside], [high]])
    columns = {
        name: np.interp(place, way, getattr(track, name))
        for name in ("latitude_deg", "longitude_deg", "height_m", "kilometrage_m", "cant_m", "gradient_permille")
    }
    nearest = np.clip(np.searchsorted(way, place), 0, len(way) - 1)
    name = f"{track.metadata.get('name', track.source)}/{number}"
    return replace(
        track,
        **columns,
        radius_m=track.radius_m[nearest],
        source=f"{track.file} ({name})",
        metadata=track.metadata | {"name": name},
    )


#: Two unconnected ends are reported as a gap in one track if they are closer to each other than this [m].
_GAP_M: Final = 5.0
#: Connected ends are reported as a joint that does not meet if they are farther apart than this [m].
_JOINT_M: Final = 0.5
#: Navigable connections that turn by more than this are reported as kinks [deg]; a 1:4.5 switch turns by 12.5 deg.
_KINK_DEG: Final = 15.0
#: Tracks with a smaller spacing are reported, because vehicles on them cannot pass each other [m].
_LEAST_SPACING_M: Final = 2.5
#: The spacing of tracks is not checked within this distance of their ends, because tracks join in switches [m].
_SWITCH_M: Final = 80.0
_LEAST_WAY_M: Final = 10.0  #: Tracks that are too near each other over less than this length are not reported [m].


@dataclass(frozen=True, kw_only=True)
class NetworkFinding:
    """Fault of a network: kind, names of the tracks, location, and description."""

    kind: str
    tracks: tuple[str, ...]
    latitude_deg: float
    longitude_deg: float
    sentence: str


@dataclass(frozen=True, kw_only=True)
class NetworkQuality:
    """Size and faults of a network."""

    tracks: int  #: Number of tracks.
    switches: int  #: Number of track ends from which a train can pass to several tracks.
    ends: int  #: Number of track ends without a navigable connection.
    parts: int  #: Number of parts of the network between which there is no connection.
    length_m: float  #: Total length of the tracks.
    findings: tuple[NetworkFinding, ...]  #: Faults of the network, beginning with the kinds in `FAULTS`.


#: Kinds of findings that are errors of the network; these findings are listed first.
FAULTS: Final = ("gap", "joint", "kink")


def check_network(network: Network) -> NetworkQuality:
    """Check the connections of a network and the distances between its tracks."""
    joined: nx.Graph[int] = nx.Graph()
    joined.add_nodes_from(range(len(network.tracks)))
    joined.add_edges_from((link.first, link.second) for link in network.links)
    loose = [(t, e) for t in range(len(network.tracks)) for e in (0, 1) if (t, e) not in network.passages]
    findings = [*_gaps(network, loose), *_joints(network), *_too_near(network)]
    findings.sort(key=lambda finding: finding.kind not in FAULTS)
    return NetworkQuality(
        tracks=len(network.tracks),
        switches=sum(len(others) > 1 for others in network.passages.values()),
        ends=len(loose),
        parts=nx.number_connected_components(joined),
        length_m=float(network.length_m.sum()),
        findings=tuple(findings),
    )


def _finding(network: Network, kind: str, tracks: Sequence[int], point: int, sentence: str) -> NetworkFinding:
    """Create a finding at a point of the first track; {0} and {1} in the sentence are replaced by track names."""
    names, segment = tuple(network.names[track] for track in tracks), network.tracks[tracks[0]]
    return NetworkFinding(
        kind=kind,
        tracks=names,
        latitude_deg=float(segment.latitude_deg[point]),
        longitude_deg=float(segment.longitude_deg[point]),
        sentence=sentence.format(*names),
    )


def _gaps(network: Network, loose: list[tuple[int, int]]) -> Iterator[NetworkFinding]:
    """Yield gaps between two unconnected ends, and the remaining unconnected ends as dead ends."""
    if not loose:
        return
    ends, outward = end_points(network)
    points = np.array([ends[t, e] for t, e in loose])
    facing = np.array([outward[t, e] for t, e in loose])
    # the outward directions of the two ends at a gap are opposite
    near = [(a, b) for a, b in cKDTree(points).query_pairs(_GAP_M) if facing[a] @ facing[b] < 0.0]
    for a, b in sorted(near):
        (t, e), (u, _) = loose[a], loose[b]
        gap = float(np.linalg.norm(points[a] - points[b]))
        yield _finding(
            network, "gap", (t, u), -e, f"{{0}} and {{1}} end {gap:.2f} m apart without a navigable connection"
        )
    paired = {k for pair in near for k in pair}
    for k, (t, e) in enumerate(loose):
        if k not in paired:
            yield _finding(network, "dead end", (t,), -e, "{0} ends without a connection")


def _joints(network: Network) -> Iterator[NetworkFinding]:
    """Yield connections of ends that do not meet, and navigable connections with a kink."""
    ends, outward = end_points(network)
    for link in network.links:
        first, second, tracks = (link.first, link.first_end), (link.second, link.second_end), (link.first, link.second)
        gap = float(np.linalg.norm(ends[first] - ends[second]))
        if gap > _JOINT_M:
            sentence = f"the connected ends of {{0}} and {{1}} are {gap:.2f} m apart"
            yield _finding(network, "joint", tracks, -link.first_end, sentence)
        turn = 180.0 - np.degrees(np.arccos(np.clip(outward[first] @ outward[second], -1.0, 1.0)))
        if link.navigable and turn > _KINK_DEG:
            sentence = f"the direction changes by {turn:.0f} deg from {{0}} to {{1}}"
            yield _finding(network, "kink", tracks, -link.first_end, sentence)


def _too_near(network: Network) -> Iterator[NetworkFinding]:
    """Yield pairs of tracks with a spacing below `_LEAST_SPACING_M`, except near their ends."""
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
            sentence = (
                f"{{0}} and {{1}} are {min(d for _, d in points):.2f} m apart on "
                f"{places.max() - places.min():.0f} m of their length; check whether a track is in the map twice"
            )
            yield _finding(network, "too near", (a, b), points[0][0] - int(network.first_point[a]), sentence)
