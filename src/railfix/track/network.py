"""Network of tracks: track centrelines, connections of their ends, and routes through the network (P1 4.2(1)).

Connections are stated in the file, or are made between ends that are closer than a tolerance. At a switch, a train can
pass between the stem and either leg, but not between the two legs.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final, cast

import numpy as np
import scipy

from railfix.core.arrays import Floats, Indices, Integers, RowArrays, join_rows, places_in_groups, read_only
from railfix.core.errors import MismatchError, SettingsError
from railfix.core.geodesy import ecef_from_geodetic
from railfix.core.notebook import NotebookTable
from railfix.track.route import Segment, one_frame, sigma_of_files
from railfix.track.track import SIGMA_HEIGHT_M, SIGMA_PLAN_M, UNNAMED, interpolate_kilometrage
from railfix.track.trajectory import NearestOnPolyline, project_on_segments

if TYPE_CHECKING:
    import networkx as nx

UNMAPPED_PRIOR: Final = 0.05  #: Prior probability that the train is on an unmapped track.
CLEARANCE_M: Final = 3.0  #: Minimum distance between the centrelines of two tracks [m].
ANTENNA_UP_M: Final = 2.5  #: Assumed height of an antenna above the rails [m].
#: Standard deviation of the assumed antenna height [m]; some antennas are on bogies, others on roofs.
ANTENNA_SIGMA_M: Final = 1.5
_DIRECTION_M: Final = 10.0  #: Length over which the direction of a track at its end is computed [m].
#: Routes of up to this length are searched first [m]; the whole network is searched if there is no such route.
_NEAR_WAY_M: Final = 5_000.0
_SAMPLE_M: Final = 50.0  #: Largest spacing of the samples in the spatial index [m].
#: Number of nearest samples that are examined first for each position; more samples are examined if these are not
#: enough.
_SAMPLES: Final = 32
_TOGETHER: Final = 256  #: Number of positions processed at once, which limits the memory for nearby samples.
#: Cached properties of `Network` that do not depend on the connections.
_OF_POINTS: Final = ("first_point", "points_m", "chainage_m", "length_m", "height_m", "_way", "_index")
_NAMED: Final = 8  #: Largest number of tracks for which a message lists all names.


@dataclass(frozen=True, kw_only=True)
class Link:
    """Connection between the ends of two tracks; end 0 is the first point of a track, end 1 the last point."""

    first: int  #: Index of the first track.
    first_end: int
    second: int  #: Index of the second track.
    second_end: int
    navigable: bool = True  #: Whether a train can pass from one track to the other without reversing.


@dataclass(frozen=True, kw_only=True)
class Candidates(RowArrays):
    """Up to m tracks near each of n positions, nearest first; shapes (n, m)."""

    track: Indices  #: Index of the track, -1 if there are fewer than m tracks.
    chainage_m: Floats  #: Chainage of the nearest point of the track; NaN without a track.
    offset_m: Floats  #: Distance from the track in plan, positive to the right; infinite without a track.


@dataclass(frozen=True, kw_only=True, repr=False)
class Network(NotebookTable):
    """Tracks between switches or open ends, and the connections of their ends."""

    tracks: tuple[Segment, ...]
    links: tuple[Link, ...]  #: Connections of track ends.
    notes: tuple[str, ...] = ()  #: Notes on how the connections were obtained.

    def connect(self, links: tuple[Link, ...], note: str) -> Network:
        """Return the network with new connections and a note on their source; cached data of the points are kept."""
        network = replace(self, links=links, notes=(note,))
        vars(network).update({name: vars(self)[name] for name in _OF_POINTS if name in vars(self)})
        return network

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the tracks in the file, or the sources of tracks without a name; repeated names are numbered."""
        seen: dict[str, int] = {}
        names = []
        for track in self.tracks:
            name = track.metadata.get("name") or track.source
            seen[name] = seen.get(name, 0) + 1
            names.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
        return tuple(names)

    @cached_property
    def first_point(self) -> Indices:
        """Index in `points_m` of each track's first point, followed by the number of points, shape (tracks + 1,)."""
        return np.concatenate([[0], np.cumsum([len(t.latitude_deg) for t in self.tracks])]).astype(np.intp)

    @cached_property
    def points_m(self) -> Floats:
        """Points of all tracks, reduced to the ellipsoid so that distances are in plan, shape (V, 3) ECEF [m]."""
        latitude = np.concatenate([t.latitude_deg for t in self.tracks])
        longitude = np.concatenate([t.longitude_deg for t in self.tracks])
        return read_only(ecef_from_geodetic(latitude, longitude, np.zeros(len(latitude))))

    @cached_property
    def chainage_m(self) -> Floats:
        """Length on the ellipsoid from the first point of a track to each point of the track, shape (V,) [m]."""
        steps = np.linalg.norm(np.diff(self.points_m, axis=0), axis=1)
        steps[self.first_point[1:-1] - 1] = 0.0
        way = np.concatenate([[0.0], np.cumsum(steps)])
        return read_only(way - np.repeat(way[self.first_point[:-1]], np.diff(self.first_point)))

    @cached_property
    def length_m(self) -> Floats:
        """Length of each track in plan, shape (tracks,) [m]."""
        return read_only(self.chainage_m[self.first_point[1:] - 1])

    @cached_property
    def graph(self) -> nx.DiGraph[int]:
        """Directed graph of train movements, with lengths [m] as weights.

        Node ``4 t + 2 e`` is the entry of track t at end e, and node ``4 t + 2 e + 1`` is the exit at that end.
        """
        import networkx as nx

        graph: nx.DiGraph[int] = nx.DiGraph()
        for t, length in enumerate(self.length_m.tolist()):
            graph.add_edge(4 * t, 4 * t + 3, weight=length)
            graph.add_edge(4 * t + 2, 4 * t + 1, weight=length)
        for link in self.links:
            if link.navigable:
                a, b = 4 * link.first + 2 * link.first_end, 4 * link.second + 2 * link.second_end
                graph.add_edge(a + 1, b, weight=0.0)
                graph.add_edge(b + 1, a, weight=0.0)
        return graph

    @cached_property
    def joints(self) -> Integers:
        """Joint number at each end of each track, shape (tracks, 2); connected ends have the same number."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        count = 2 * len(self.tracks)
        first = [2 * link.first + link.first_end for link in self.links]
        second = [2 * link.second + link.second_end for link in self.links]
        linked = coo_array((np.ones(len(first)), (first, second)), shape=(count, count))
        return connected_components(linked, directed=False)[1].astype(np.int64).reshape(-1, 2)

    @cached_property
    def passages(self) -> dict[tuple[int, int], dict[tuple[int, int], None]]:
        """For each track end, the ends of other tracks to which a train can pass. A track end is the pair of the
        track's index and 0 or 1.
        """
        passages: dict[tuple[int, int], dict[tuple[int, int], None]] = {}
        for link in self.links:
            if link.navigable:
                a, b = (link.first, link.first_end), (link.second, link.second_end)
                passages.setdefault(a, {})[b] = None
                passages.setdefault(b, {})[a] = None
        return passages

    @cached_property
    def height_m(self) -> Floats:
        """Ellipsoidal heights of the points, shape (V,) [m]; NaN where the map has no heights."""
        return read_only(np.concatenate([t.height_m for t in self.tracks]))

    @cached_property
    def _way(self) -> tuple[Floats, Floats]:
        """Chainages of points and of track starts on an axis with all tracks in sequence and gaps of 1 m [m]."""
        before = np.concatenate([[0.0], np.cumsum(self.length_m + 1.0)[:-1]])
        return self.chainage_m + np.repeat(before, np.diff(self.first_point)), before

    def course_on(self, track: Indices, chainage_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the points in plan, track directions and heights at chainages on tracks.

        Points and unit direction vectors are in ECEF, shape (n, 3). Heights have shape (n,). Chainages are limited to
        the track.
        """
        way, before = self._way
        at = before[track] + np.clip(chainage_m, 0.0, self.length_m[track])
        last = self.first_point[track + 1] - 2
        segment = np.clip(np.searchsorted(way, at, side="right") - 1, self.first_point[track], last)
        start, step = self.points_m[segment], self.points_m[segment + 1] - self.points_m[segment]
        length = np.maximum(np.linalg.norm(step, axis=1), 1e-9)
        share = np.clip((at - way[segment]) / length, 0.0, 1.0)
        height = self.height_m[segment] + share * (self.height_m[segment + 1] - self.height_m[segment])
        return start + share[:, None] * step, step / length[:, None], height

    @property
    def frame(self) -> str:
        """Geographic CRS of the coordinates; raises MismatchError if the tracks are in different frames."""
        return one_frame(self.tracks)

    @cached_property
    def sigma_plan_m(self) -> float:
        """Largest standard deviation of a track in plan [m]; the default is from P1 4.1(3)."""
        return sigma_of_files(self.tracks, "sigma_plan_m", SIGMA_PLAN_M)

    @cached_property
    def sigma_height_m(self) -> float:
        """Largest standard deviation of a track's height [m]; the default is from P1 4.1(3)."""
        return sigma_of_files(self.tracks, "sigma_height_m", SIGMA_HEIGHT_M)

    @cached_property
    def datum_plan_m(self) -> float:
        """Largest standard deviation of a track's datum transformation [m], included in `sigma_plan_m`."""
        return max(track.datum_plan_m for track in self.tracks)

    @property
    def named(self) -> bool:
        """Whether all files name their reference frame."""
        return all(track.crs != UNNAMED for track in self.tracks)

    @cached_property
    def _index(self) -> tuple[scipy.spatial.cKDTree, Indices, Indices, float]:
        """k-d tree of samples on all tracks, segment and track of each sample, half the largest sample spacing [m]."""
        steps = np.linalg.norm(np.diff(self.points_m, axis=0), axis=1)
        inner = np.ones(len(steps), dtype=np.bool_)
        inner[self.first_point[1:-1] - 1] = False
        segment = np.flatnonzero(inner & (steps > 0.0))
        pieces = np.maximum(np.ceil(steps[segment] / _SAMPLE_M).astype(np.intp), 1)
        row, piece = places_in_groups(pieces)
        of, share = segment[row], (piece + 0.5) / pieces[row]
        samples = self.points_m[of] + share[:, None] * (self.points_m[of + 1] - self.points_m[of])
        track = np.searchsorted(self.first_point, of, side="right") - 1
        reach = float((steps[segment] / pieces).max(initial=0.0)) / 2.0
        return scipy.spatial.cKDTree(samples, balanced_tree=False), of, track, reach

    def _samples_near(self, points_m: Floats, within_m: float, least: int) -> tuple[Floats, Indices]:
        """Return the distances and indices of all samples near each point; the arrays have at least `least` columns.

        A sample is near if the piece of track that the sample represents can be within `within_m` of the point. The
        distance is infinite in unused columns.
        """
        tree, _, _, reach = self._index
        count, short = max(_SAMPLES, least), np.arange(len(points_m))
        distance, sample = np.full((len(points_m), count), np.inf), np.zeros((len(points_m), count), dtype=np.intp)
        while len(short):
            more = ((0, 0), (0, count - distance.shape[1]))
            distance, sample = np.pad(distance, more, constant_values=np.inf), np.pad(sample, more)
            near = tree.query(points_m[short], k=np.arange(1, count + 1), distance_upper_bound=within_m + reach + 1e-3)
            distance[short], sample[short] = near
            short, count = short[np.isfinite(distance[short, -1])], 4 * count
        return distance, np.where(np.isfinite(distance), sample, 0).astype(np.intp)

    def near(self, latitude_deg: Floats, longitude_deg: Floats, *, within_m: float = 30.0, most: int = 8) -> Candidates:
        """Return up to `most` tracks within a distance `within_m` in plan of each of n positions."""
        parts = [
            self._near(latitude_deg[k : k + _TOGETHER], longitude_deg[k : k + _TOGETHER], within_m, most)
            for k in range(0, max(len(latitude_deg), 1), _TOGETHER)
        ]
        return join_rows(parts)

    def _near(self, latitude_deg: Floats, longitude_deg: Floats, within_m: float, most: int) -> Candidates:
        """Return the result of `near` for at most `_TOGETHER` positions."""
        points = ecef_from_geodetic(latitude_deg, longitude_deg, np.zeros(len(latitude_deg)))
        _, segment, of_track, _ = self._index
        usable = ~np.isnan(points[:, 0])
        distance, sample = self._samples_near(np.where(usable[:, None], points, 0.0), within_m, most)
        present = np.isfinite(distance)
        of, track = segment[sample], np.where(present, of_track[sample], -1)
        start, step = self.points_m[of], self.points_m[of + 1] - self.points_m[of]
        share, offset = project_on_segments(points[:, None], start, step)
        offset = np.where(present & (offset <= within_m), offset, np.inf)
        side = np.einsum("nki,nki->nk", np.cross(step, points[:, None] - start), points[:, None])
        chainage = self.chainage_m[of] + share * np.linalg.norm(step, axis=-1)
        # sort by track, then by distance, so that the first segment of each track is the nearest
        order = np.lexsort((offset, track), axis=-1)
        ordered = np.take_along_axis(track, order, axis=1)
        first = np.ones_like(ordered, dtype=np.bool_)
        first[:, 1:] = ordered[:, 1:] != ordered[:, :-1]
        best = np.where(first, np.take_along_axis(offset, order, axis=1), np.inf)
        picked = np.take_along_axis(order, np.argsort(best, axis=1, kind="stable")[:, :most], axis=1)
        off = np.sort(best, axis=1)[:, :most]
        found = np.isfinite(off)
        sign = np.where(np.take_along_axis(side, picked, axis=1) > 0.0, -1.0, 1.0)
        return Candidates(
            track=np.where(found, np.take_along_axis(track, picked, axis=1), -1).astype(np.intp),
            chainage_m=np.where(found, np.take_along_axis(chainage, picked, axis=1), np.nan),
            offset_m=np.where(found, off * sign, np.inf),
        )

    def place_on(self, track: Indices, latitude_deg: Floats, longitude_deg: Floats) -> tuple[Floats, Floats]:
        """Return the chainages of positions projected on given tracks, and their distances from the tracks in plan [m].

        Both results have shape (n,). They are NaN without a track (-1) or a position (NaN).
        """
        points = ecef_from_geodetic(latitude_deg, longitude_deg, np.zeros(len(latitude_deg)))
        chainage, offset = np.full(len(track), np.nan), np.full(len(track), np.nan)
        for number in np.unique(track[track >= 0]):
            rows = np.flatnonzero((track == number) & np.isfinite(points[:, 0]))
            own = slice(self.first_point[number], self.first_point[number + 1])
            segment, along, offset[rows] = NearestOnPolyline(self.points_m[own])(points[rows])
            chainage[rows] = self.chainage_m[own][segment] + along
        return chainage, offset

    def kilometrage_on(self, track: Indices, chainage_m: Floats) -> Floats:
        """Return the kilometrage at chainages on given tracks, shape (n,) [m]; NaN where the map has no kilometrage."""
        kilometrage = np.full(len(track), np.nan)
        for number in np.unique(track[track >= 0]):
            rows = track == number
            own = slice(self.first_point[number], self.first_point[number + 1])
            marking = self.tracks[number].kilometrage_m
            kilometrage[rows] = interpolate_kilometrage(chainage_m[rows], self.chainage_m[own], marking)
        return kilometrage

    def find_index(self, name: str) -> int:
        """Return the index of the track with a given name or OpenStreetMap way id.

        Raise SettingsError if there is no such track.
        """
        drawn = [k for k, track in enumerate(self.tracks) if "origin" in track.metadata]
        by_id = [k for k in drawn if self.tracks[k].metadata.get("name", "").startswith(f"{name} ")]
        if name not in self.names and len(by_id) == 1:
            return by_id[0]
        if name not in self.names:
            close = [n for n in self.names if name.lower() in n.lower()] or difflib.get_close_matches(name, self.names)
            few = len(self.names) <= _NAMED
            shown = ", ".join(map(repr, self.names if few else close[:3]))
            hint = f"it has {shown}" if few else f"similar: {shown}" if close else f"it has {len(self.names)} tracks"
            raise SettingsError(f"there is no track {name!r} in the network; {hint}")
        return self.names.index(name)

    def extend_routes(
        self, routes: Mapping[int, tuple[float, list[int]]], stop: int
    ) -> dict[int, tuple[float, list[int]]]:
        """Extend routes to the track `stop`, and return the shortest route to each of the track's two entries.

        A route consists of its length [m] and nodes of `graph`: the start node, and the entry of each track. The keys
        of `routes` are the last nodes of the routes, which are exits. The keys of the result are the entries that a
        route reaches.
        """
        import networkx as nx

        reached: dict[int, tuple[float, list[int]]] = {}
        entries = 4 * stop, 4 * stop + 2
        for node, (so_far, route) in routes.items():
            for cutoff in (_NEAR_WAY_M, None):
                length, path = cast(
                    "tuple[dict[int, float], dict[int, list[int]]]",
                    nx.single_source_dijkstra(self.graph, node, cutoff=cutoff),
                )
                if any(entry in length for entry in entries):
                    break
            for entry in entries:
                if entry in length and so_far + length[entry] < reached.get(entry, (np.inf, []))[0]:
                    reached[entry] = so_far + length[entry], route + [n for n in path[entry] if n % 2 == 0]
        return reached

    def shortest_route(self, stops: Sequence[int]) -> list[int]:
        """Return the shortest route that passes given tracks in order, as track indices.

        Raise MismatchError if there is no route.
        """
        route = self.route_over(stops)
        if route is None:
            first = next(stop for k, stop in enumerate(stops, start=1) if self.route_over(stops[:k]) is None)
            raise MismatchError(
                f"track {self.names[first]!r} cannot be reached over navigable connections without turning back"
            )
        return route

    def route_over(self, stops: Sequence[int]) -> list[int] | None:
        """Return the shortest route that passes given tracks in order, as track indices; None without a route."""
        wanted = [stop for k, stop in enumerate(stops) if k == 0 or stop != stops[k - 1]]
        routes = {4 * wanted[0] + end: (0.0, [4 * wanted[0] + end]) for end in (1, 3)}
        for stop in wanted[1:]:
            # a train that enters a track at one end leaves it at the other end
            routes = {entry ^ 3: route for entry, route in self.extend_routes(routes, stop).items()}
        return [node // 4 for node in min(routes.values())[1]] if routes else None


def end_points(network: Network) -> tuple[Floats, Floats]:
    """Return the track ends on the ellipsoid and outward unit vectors at the ends, shape (tracks, 2, 3) each."""
    first, last = network.first_point[:-1], network.first_point[1:] - 1
    place, before = network._way
    inner = np.clip(np.searchsorted(place, before + _DIRECTION_M), first + 1, last)
    outer = np.clip(np.searchsorted(place, before + network.length_m - _DIRECTION_M, side="right") - 1, first, last - 1)
    points = network.points_m
    ends = np.stack([points[first], points[last]], axis=1)
    outward = ends - np.stack([points[inner], points[outer]], axis=1)
    return ends, outward / np.linalg.norm(outward, axis=2, keepdims=True)
