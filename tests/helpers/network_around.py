"""Networks around a line that was driven: parallel tracks, loop, fork, viaduct, four tracks, with the way driven known.

A seed chooses the side, the places, and which of four tracks is the one driven. `network_recordings.py` runs the
recordings on them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np

from network_made import segment
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.track import Track
from railfix.track.network import Network
from railfix.track.network_read import links_of_ends
from railfix.track.trajectory import Trajectory

Shape = Literal["parallel 4 m", "parallel 8 m", "loop", "fork", "viaduct", "four tracks"]
SHAPES: Final[tuple[Shape, ...]] = ("parallel 4 m", "parallel 8 m", "loop", "fork", "viaduct", "four tracks")
#: Distance of the loop and of the four tracks from each other, and height of the viaduct above the line [m].
ASIDE_M, ABOVE_M = 4.0, 8.0
#: Length over which the loop leaves the line, and radius and largest distance of the branch [m].
_RAMP_M, _RADIUS_M, _APART_M = 60.0, 500.0, 60.0


@dataclass(frozen=True, kw_only=True)
class Around:
    """Tracks by name, points of shape (n, 3) ECEF [m], and the names of those that were driven."""

    tracks: dict[str, np.ndarray]
    driven: frozenset[str]


def network_around(track: Track, shape: Shape, seed: int) -> Around:
    """The network of a shape around a line."""
    rng = np.random.default_rng(seed)
    line = Trajectory.from_antenna_path(track)
    total = float(line.arc_m[-1])
    places = np.unique(np.concatenate([line.arc_m, np.arange(0.0, total, 5.0)]))
    places = places[np.concatenate([[True], np.diff(places) > 0.01])]
    points, right = line.at_arc(places), line.across[line.segment_at(places)[0]]
    latitude, longitude, _ = geodetic_from_ecef(points)
    up = enu_axes(latitude, longitude)[:, 2]
    side = float(rng.choice([-1.0, 1.0]))

    def aside(metres: np.ndarray | float) -> np.ndarray:
        return np.asarray(points + np.broadcast_to(metres, len(points))[:, None] * side * right)

    if shape in ("parallel 4 m", "parallel 8 m"):
        return Around(
            tracks={"driven": points, "beside": aside(4.0 if shape == "parallel 4 m" else 8.0)},
            driven=frozenset({"driven"}),
        )
    if shape == "viaduct":
        return Around(tracks={"driven": points, "above": points + ABOVE_M * up}, driven=frozenset({"driven"}))
    if shape == "four tracks":
        own = int(rng.integers(4))
        tracks = {f"track {k}": aside(ASIDE_M * (k - own)) for k in range(4)}
        return Around(tracks=tracks, driven=frozenset({f"track {own}"}))
    low, high = total * rng.uniform(0.15, 0.35), total * rng.uniform(0.6, 0.8)
    first, last = np.searchsorted(places, [low, high])
    if shape == "fork":
        along = np.clip(places - places[first], 0.0, None)
        branch = aside(np.minimum(along**2 / (2.0 * _RADIUS_M), _APART_M))
        return Around(
            tracks={"line": points[: first + 1], "ahead": points[first:], "branch": branch[first:]},
            driven=frozenset({"line", "ahead"}),
        )
    ramp = np.clip(np.minimum(places - places[first], places[last] - places) / _RAMP_M, 0.0, 1.0)
    loop = aside(ASIDE_M * (3.0 * ramp**2 - 2.0 * ramp**3))
    part = slice(first, last + 1)
    return Around(
        tracks={"line 0": points[: first + 1], "main": points[part], "loop": loop[part], "line 1": points[last:]},
        driven=frozenset({"line 0", "main", "line 1"}),
    )


def made(around: Around) -> Network:
    """The network, connected by ends."""
    tracks = []
    for name, points in around.tracks.items():
        latitude, longitude, height = geodetic_from_ecef(points)
        tracks.append(replace(segment(name, latitude, longitude), height_m=height, height_datum="ellipsoidal"))
    network = Network(tracks=tuple(tracks), links=())
    return replace(network, links=links_of_ends(network))


def write_network(around: Around, path: Path) -> Path:
    """A GeoPackage of the tracks with ellipsoidal heights."""
    import pyogrio
    import shapely

    shapes = []
    for points in around.tracks.values():
        latitude, longitude, height = geodetic_from_ecef(points)
        shapes.append(shapely.LineString(np.stack([longitude, latitude, height], axis=-1)))
    pyogrio.raw.write(
        path,
        np.array([shapely.to_wkb(shape) for shape in shapes]),
        [np.array([*around.tracks], dtype=object)],
        ["name"],
        geometry_type="LineString Z",
        crs="EPSG:4979",
    )
    return path
