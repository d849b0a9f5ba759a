"""Networks of tracks read from map files, and connected as the files state it or by their ends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from os import PathLike
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError
from railfix.core.files import ending, read_text
from railfix.track.geojson_file import RELATION
from railfix.track.network import Link, Network, end_points
from railfix.track.read import read_segments
from railfix.track.route import MapReading, Segment, first_gap, orient
from railfix.track.vector_file import read_layers
from railfix.track.xml_files import FORMATS as RDF_FORMATS
from railfix.track.xml_files import Relation, read_railml_relations, read_rinf_relations

#: Ends nearer than this are one point, where the file states no connection [m].
TOLERANCE_M: Final = 0.5
#: Largest change of direction between two tracks that a train passes [rad]; the legs of a switch differ by about pi.
_LARGEST_TURN_RAD: Final = np.radians(60.0)


def read_network(
    paths: Sequence[str | PathLike[str]],
    reading: MapReading | None = None,
    *,
    tolerance_m: float = TOLERANCE_M,
) -> Network:
    """Read a network of tracks from map files, as `railfix.track.read_track` reads them; repeated points are kept.

    Where the files state no connections, ends nearer than the tolerance are one point, and a track on which the end of
    another lies is divided there. InputFileError, SettingsError.
    """
    of_file = replace(reading or MapReading(), duplicates="keep")
    tracks = [track for path in paths for track in read_segments(path, of_file)]
    return network_of(tracks, paths, tolerance_m=tolerance_m)


def network_of(
    tracks: list[Segment], paths: Sequence[str | PathLike[str]], *, tolerance_m: float = TOLERANCE_M
) -> Network:
    """Connect tracks to a network: as their files state it, else by their ends; see `read_network`."""
    relations = [relation for path in paths for relation in _relations(path)]
    if relations:
        return _of_relations(tracks, relations, str(paths[0]))
    network, cuts = _divide(Network(tracks=tuple(tracks), links=()), tolerance_m)
    note = f"connections from ends within {tolerance_m:g} m; {cuts} tracks divided where the end of another meets them"
    return network.connected(links_of_ends(network, tolerance_m=tolerance_m), note)


def _relations(path: str | PathLike[str]) -> list[Relation]:
    """Connections that a file states, empty where it states none."""
    if ending(path) in (".xml", ".railml"):
        return read_railml_relations(path)
    if ending(path) in RDF_FORMATS:
        return read_rinf_relations(path)
    if ending(path) not in (".geojson", ".json", ".gpkg", ".fgb"):
        return []
    if "json" in ending(path) and RELATION not in read_text(path):
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
                    name=str(stated.get("id", "")),
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
    links = tuple(
        Link(
            first=number[r.first],
            first_end=r.first_end,
            second=number[r.second],
            second_end=r.second_end,
            navigable=r.navigable,
        )
        for r in known
    )
    note = f"connections as {len(known)} net relations of the file state them"
    if len(known) < len(relations):
        note += f"; {len(relations) - len(known)} relations name a track that it does not have"
    return Network(tracks=tuple(tracks), links=links, notes=(note,))


def links_of_ends(network: Network, *, tolerance_m: float = TOLERANCE_M) -> tuple[Link, ...]:
    """Connections of ends that lie within a tolerance; navigable where the direction changes by less than 60 deg."""
    ends, outward = end_points(network)
    pairs = cKDTree(ends.reshape(-1, 3)).query_pairs(tolerance_m, output_type="ndarray")
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    a, b = pairs.T
    facing = np.einsum("ij,ij->i", outward.reshape(-1, 3)[a], outward.reshape(-1, 3)[b])
    navigable = (facing < -np.cos(_LARGEST_TURN_RAD)) & (a // 2 != b // 2)
    return tuple(
        Link(first=i // 2, first_end=i % 2, second=j // 2, second_end=j % 2, navigable=n)
        for i, j, n in zip(a.tolist(), b.tolist(), navigable.tolist(), strict=True)
    )


def is_route(segments: Sequence[Segment]) -> bool:
    """Whether segments join to one route in their order: ends meet, and no train would have to turn back."""
    if first_gap(segments) is not None:
        return False
    _, outward = end_points(Network(tracks=tuple(orient(segments)), links=()))
    return bool((np.einsum("ij,ij->i", outward[:-1, 1], outward[1:, 0]) < -np.cos(_LARGEST_TURN_RAD)).all())


def _divide(whole: Network, tolerance_m: float) -> tuple[Network, int]:
    """Tracks divided at inner points on which the end of another track lies, and how many were divided."""
    tracks = whole.tracks
    latitude = np.array([[t.latitude_deg[0], t.latitude_deg[-1]] for t in tracks]).ravel()
    longitude = np.array([[t.longitude_deg[0], t.longitude_deg[-1]] for t in tracks]).ravel()
    near = whole.near(latitude, longitude, within_m=tolerance_m)
    cuts: dict[int, list[float]] = {}
    for end, column in zip(*np.nonzero(near.track >= 0), strict=True):
        other, place = int(near.track[end, column]), float(near.chainage_m[end, column])
        if other != end // 2 and tolerance_m < place < whole.length_m[other] - tolerance_m:
            cuts.setdefault(other, []).append(place)
    if not cuts:
        return whole, 0
    parts: list[Segment] = []
    for k, track in enumerate(tracks):
        if k not in cuts:
            parts.append(track)
            continue
        way = whole.chainage_m[whole.first_point[k] : whole.first_point[k + 1]]
        places = sorted(cuts[k])
        places = [p for i, p in enumerate(places) if i == 0 or p - places[i - 1] > tolerance_m]
        bounds = [0.0, *places, float(way[-1])]
        for number, (low, high) in enumerate(pairwise(bounds), start=1):
            parts.append(_part(track, way, low, high, number))
    return Network(tracks=tuple(parts), links=()), len(cuts)


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
