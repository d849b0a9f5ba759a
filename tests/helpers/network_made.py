"""Generated networks of tracks: stations with loops along lines, switches with their legs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pyproj import CRS, Transformer

from railfix.core.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.track.network import Link, Network
from railfix.track.network_match import PlanLog
from railfix.track.route import ATTRIBUTES, NO_HEIGHTS, Segment
from railfix.track.track import UNNAMED, Track
from railfix.track.trajectory import Trajectory

#: A unit of 2 km: the main track to a switch, two parallel tracks 3.6 m apart over 1 km, the main track again.
UNIT_M = 2000.0
SPACING_M = 3.6
_RAMP_M = 60.0


def segment(name: str, latitude: np.ndarray, longitude: np.ndarray) -> Segment:
    return Segment(
        source=name,
        file="made",
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=np.full(len(latitude), np.nan),
        crs=UNNAMED,
        height_datum=NO_HEIGHTS,
        geoid="",
        metadata={"name": name},
        **{key: np.full(len(latitude), np.nan) for key in ATTRIBUTES},
    )


def to_degrees(east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Plain degrees of a local grid about 50 N, 5 E: a scale per axis, the same for all points."""
    axes = enu_axes(50.0, 5.0)
    origin = ecef_from_geodetic(50.0, 5.0, 0.0)
    metre_lat = geodetic_from_ecef(origin + axes[1])[0] - 50.0
    metre_lon = geodetic_from_ecef(origin + axes[0])[1] - 5.0
    return 50.0 + north * metre_lat, 5.0 + east * metre_lon


def made_network(length_km: float, *, line_km: float = 200.0) -> Network:
    """Lines beside each other, 500 m apart, each of units of `UNIT_M`; about `length_km` of track."""
    units = max(1, round(length_km * 1e3 / (UNIT_M + 1120.0)))
    per_line = max(1, round(line_km * 1e3 / UNIT_M))
    tracks, links = [], []
    plain = np.linspace(0.0, 440.0, 23)
    loop = np.linspace(0.0, 1120.0, 57)
    bend = np.clip(np.minimum(loop, 1120.0 - loop) / _RAMP_M, 0.0, 1.0)
    aside = SPACING_M * (3.0 * bend**2 - 2.0 * bend**3)
    for unit in range(units):
        line, at = divmod(unit, per_line)
        east, north = at * UNIT_M, line * 500.0
        for name, x, y in (
            ("a", plain, 0.0 * plain),
            ("1", 440.0 + loop, 0.0 * loop),
            ("2", 440.0 + loop, aside),
            ("b", 1560.0 + plain, 0.0 * plain),
        ):
            tracks.append(segment(f"{unit}{name}", *to_degrees(east + x, north + y)))
        k = 4 * unit
        for a, ea, b, eb in ((k, 1, k + 1, 0), (k, 1, k + 2, 0), (k + 1, 1, k + 3, 0), (k + 2, 1, k + 3, 0)):
            links.append(Link(first=a, first_end=ea, second=b, second_end=eb))
        links.append(Link(first=k + 1, first_end=0, second=k + 2, second_end=0, navigable=False))
        if at:
            links.append(Link(first=k - 1, first_end=1, second=k, second_end=0))
    return Network(tracks=tuple(tracks), links=tuple(links))


def made_run(
    network: Network, route: list[int], *, rng: np.random.Generator, sigma_m: float, step_m: float = 10.0
) -> tuple[PlanLog, np.ndarray]:
    """Positions each second along a route with errors that persist for 30 s, and the track of each."""
    latitude, longitude, truth = [], [], []
    for k in route:
        track = network.tracks[k]
        way = network.chainage_m[network.first_point[k] : network.first_point[k + 1]]
        place = np.arange(step_m / 2, way[-1], step_m)
        latitude.append(np.interp(place, way, track.latitude_deg))
        longitude.append(np.interp(place, way, track.longitude_deg))
        truth.append(np.full(len(place), k))
    lat, lon, on = np.concatenate(latitude), np.concatenate(longitude), np.concatenate(truth)
    north, east = to_degrees(*lasting_errors(len(lat), rng=rng, sigma_m=sigma_m).T)
    return log_at(lat + north - 50.0, lon + east - 5.0), on


def lasting_errors(count: int, *, rng: np.random.Generator, sigma_m: float) -> np.ndarray:
    """Errors of each second, east and north, that persist for 30 s, shape (count, 2) [m]."""
    keep = np.exp(-1.0 / 30.0)
    error = rng.normal(0.0, sigma_m, (count, 2))
    for i in range(1, count):
        error[i] = keep * error[i - 1] + np.sqrt(1.0 - keep**2) * error[i]
    return error


def log_at(
    latitude_deg: np.ndarray, longitude_deg: np.ndarray, sigma_m: float = np.nan, *, step_s: float = 1.0, **more: object
) -> PlanLog:
    """Positions each second, or step, all with one standard deviation; `more` are further fields of a log."""
    steps = np.arange(len(latitude_deg)) * round(1000 * step_s)
    return PlanLog(
        path="made",
        time=np.datetime64("2024-01-01T00:00:00", "ns") + steps * np.timedelta64(1, "ms"),
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        sigma_m=np.full(len(latitude_deg), sigma_m),
        **more,  # type: ignore[arg-type]
    )


def write_stations(
    path: Path, track: Track, *, crs: str = "EPSG:4326", loops_m: list[tuple[float, float]], aside_m: float
) -> None:
    """A GeoPackage of a line with loops beside it: tracks "line 0", "main 0", "loop 0", "line 1", ..., 3-D."""
    import pyogrio
    import shapely

    line = Trajectory.from_antenna_path(track)
    bounds = [b for loop in loops_m for b in loop]
    places = np.unique(np.concatenate([track.chainage_m, bounds]))
    points = line.at_arc(places)
    right = line.across[line.segment_at(places)[0]]
    to_map = Transformer.from_crs("EPSG:4979", CRS(crs).to_3d(), always_xy=True)
    parts: dict[str, np.ndarray] = {}
    start = 0
    for k, loop in enumerate(loops_m):
        first, last = np.searchsorted(places, loop)
        ramp = np.clip(np.minimum(places - loop[0], loop[1] - places) / _RAMP_M, 0.0, 1.0)
        aside = points + (aside_m * (3.0 * ramp**2 - 2.0 * ramp**3))[:, None] * right
        parts[f"line {k}"] = points[start : first + 1]
        parts[f"main {k}"], parts[f"loop {k}"] = points[first : last + 1], aside[first : last + 1]
        start = last
    parts[f"line {len(loops_m)}"] = points[start:]
    shapes = []
    for own in parts.values():
        latitude, longitude, height = geodetic_from_ecef(own)
        shapes.append(shapely.LineString(np.stack(to_map.transform(longitude, latitude, height), axis=-1)))
    pyogrio.raw.write(
        path,
        np.array([shapely.to_wkb(shape) for shape in shapes]),
        [np.array([*parts], dtype=object)],
        ["name"],
        geometry_type="LineString Z",
        crs=crs,
    )
