"""Generated networks of tracks: stations with loops along lines, switches with their legs; a town's grid of streets.

``python tests/helpers/network_made.py 10 1000 100000`` prints memory and time per position on networks of that many km,
``python tests/helpers/network_made.py town`` those of a town of 20,000 tracks, read from an OSM XML file.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from pyproj import CRS, Transformer

from railfix.core.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.track.network import Link, Network
from railfix.track.network_match import PlanLog, match
from railfix.track.network_read import read_network
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


#: Streets of a town are a grid of crossings, a track from each to the next, drawn with a point every 30 m.
_BLOCK_M, _PIECES, _CROSSINGS = 150.0, 5, 100


def write_town(path: Path) -> None:
    """Write the ways between the crossings of a town, each of them a track, as OSM XML."""
    nodes: dict[tuple[int, int], int] = {}
    ways = []
    for i in range(_CROSSINGS):
        for j in range(_CROSSINGS):
            for di, dj in ((1, 0), (0, 1)):
                at = [(_PIECES * i + k * di, _PIECES * j + k * dj) for k in range(_PIECES + 1)]
                ways.append([nodes.setdefault(place, len(nodes) + 1) for place in at])
    latitude, longitude = to_degrees(*np.array([*nodes]).T * (_BLOCK_M / _PIECES))
    with path.open("w") as file:
        file.write("<osm version='0.6'>\n")
        for number, lat, lon in zip(nodes.values(), latitude.tolist(), longitude.tolist(), strict=True):
            file.write(f'<node id="{number}" lat="{lat:.9f}" lon="{lon:.9f}"/>\n')
        for number, refs in enumerate(ways, start=1):
            inside = "".join(f'<nd ref="{ref}"/>' for ref in refs)
            file.write(f'<way id="{number}">{inside}<tag k="railway" v="tram"/></way>\n')
        file.write("</osm>\n")


def run_in_town(seconds: int) -> PlanLog:
    """Positions each second at 10 m/s along a street of the town."""
    error = lasting_errors(seconds, rng=np.random.default_rng(1), sigma_m=1.5)
    along = np.arange(seconds) * 10.0 % (_BLOCK_M * _CROSSINGS)
    return log_at(*to_degrees(along + error[:, 0], 50 * _BLOCK_M + error[:, 1]), 1.5)


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


def main() -> None:
    for text in sys.argv[1:]:
        begin = time.process_time()
        if text == "town":
            with tempfile.TemporaryDirectory() as folder:
                write_town(Path(folder) / "town.osm")
                begin = time.process_time()
                network, log = read_network([Path(folder) / "town.osm"]), run_in_town(1000)
        else:
            network = made_network(float(text))
            log, on = made_run(network, [0, 2, 3], rng=np.random.default_rng(1), sigma_m=0.8)
        network.near(log.latitude_deg[:1], log.longitude_deg[:1])
        _ = network.graph
        built = time.process_time() - begin
        begin = time.process_time()
        network.near(log.latitude_deg, log.longitude_deg)
        searched = time.process_time() - begin
        begin = time.process_time()
        matched = match(network, log)
        spent = time.process_time() - begin
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        right = np.abs(matched.offset_m) < 5.0 if text == "town" else matched.track == on
        print(
            f"{network.length_m.sum() / 1e3:.0f} km, {len(network.tracks)} tracks: built in {built:.1f} s, "
            f"search {1e6 * searched / len(right):.0f} us, match {1e6 * spent / len(right):.0f} us a position, "
            f"{right.mean():.3f} on the right track{' (within 5 m)' * (text == 'town')}, peak memory {memory:.0f} MB"
        )


if __name__ == "__main__":
    main()
