"""P4's experiment on recorded stations: a reference station played as a train on a straight line.

Run ``python tests/studies/p4_experiment.py [folder]`` with the recordings beside the checkout: prints the
tables of tests/references/results/p4-experiment.txt, and writes the picture p4-experiment.png into the folder where
one is given.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

import paths
from railfix.core.arrays import Floats, Masks
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.evaluate import along_track_error
from railfix.gnss.observations import Observations
from railfix.integrity.raim import Outcome, RaimLimits
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import parse_config
from railfix.pipeline.results import AntennaResult
from railfix.run.processor_setup import make_processor
from railfix.track import Track
from railfix.track.trajectory import Trajectory

#: P4's table: its station (Otsu 2), first and last point of the line [m], ECEF.
P4_POINTS_M: Final = np.array(
    [
        [-3.7593338022e6, 3.6422632533e6, 3.6324507784e6],
        [-3.759511635946152e6, 3.641169858205933e6, 3.633360184989581e6],
        [-3.759150546602499e6, 3.643364066615054e6, 3.631538990822185e6],
    ]
)


def p4_line(points_m: Floats = P4_POINTS_M) -> tuple[float, float, float, float]:
    """Length of P4's line, place of its station along it, to the right of it [m], and azimuth of the line [deg]."""
    station, first, last = points_m
    length = float(np.linalg.norm(last - first))
    direction = (last - first) / length
    along = float((station - first) @ direction)
    latitude, longitude, _ = geodetic_from_ecef(station)
    axes = enu_axes(latitude, longitude)
    east, north, _ = axes @ direction
    aside = axes @ (station - first - along * direction)
    right = float(aside @ np.array([north, -east, 0.0]) / np.hypot(east, north))
    return length, along, right, float(np.degrees(np.arctan2(east, north)) % 360.0)


LENGTH_M, ALONG_M, BESIDE_M, AZIMUTH_DEG = p4_line()
#: Alarm limit: a car length.
ALARM_LIMIT_M: Final = RaimLimits().alarm_limit_m
#: How far right of the line, and what the map says of itself across (None: its 0.30 m).
LINES: Final = ((0.0, None), (BESIDE_M, abs(BESIDE_M)), (BESIDE_M, None))


@dataclass(frozen=True)
class Station:
    """Observations of a station, every n-th epoch, and its ephemerides."""

    name: str
    observations: str
    navigation: str
    every: int
    systems: tuple[str, ...] = ("G", "J", "E", "C")


_ESBC: Final = (
    "ESBC_2020177/ESBC00DNK_R_20201770000_01D_30S_MO.crx.gz",
    "ESBC_2020177/ESBC00DNK_R_20201770000_01D_MN.rnx.gz",
)
STATIONS: Final = (
    Station("GEONET 0759", "rtklib_geonet2005/07590920.05o", "rtklib_geonet2005/07590920.05n", 1),
    Station("GEONET 3040", "rtklib_geonet2005/30400920.05o", "rtklib_geonet2005/30400920.05n", 1),
    Station("ESBC", *_ESBC, 10),
    Station("ESBC, GPS", *_ESBC, 1, ("G",)),
)


def line_between(first_ecef_m: Floats, last_ecef_m: Floats, *, spacing_m: float = 5.0) -> Trajectory:
    """The straight line between two points, a point every 5 m, its height changing evenly."""
    length = float(np.linalg.norm(last_ecef_m - first_ecef_m))
    share = np.linspace(0.0, 1.0, round(length / spacing_m) + 1)
    latitude, longitude, _ = geodetic_from_ecef(first_ecef_m + share[:, None] * (last_ecef_m - first_ecef_m))
    heights = geodetic_from_ecef(np.stack([first_ecef_m, last_ecef_m]))[2]
    height = heights[0] + share * (heights[1] - heights[0])
    return Trajectory.from_antenna_path(Track.from_ecef(ecef_from_geodetic(latitude, longitude, height)))


def two_points(station_ecef_m: Floats, beside_m: float) -> tuple[Floats, Floats]:
    """First and last point of the line that the station is `beside_m` to the right of, at its height."""
    latitude, longitude, height = geodetic_from_ecef(station_ecef_m)
    axes = enu_axes(latitude, longitude)
    bearing = np.radians(AZIMUTH_DEG)
    along = np.sin(bearing) * axes[0] + np.cos(bearing) * axes[1]
    right = np.cos(bearing) * axes[0] - np.sin(bearing) * axes[1]
    ends = station_ecef_m - beside_m * right + np.array([[-ALONG_M], [LENGTH_M - ALONG_M]]) * along
    lat, lon, _ = geodetic_from_ecef(ends)
    first, last = ecef_from_geodetic(lat, lon, np.full(2, float(height)))
    return first, last


@dataclass(frozen=True)
class Day:
    """One station on one line by epoch: errors along it, east and north, those of 3-D least squares, and RAIM."""

    observations: Observations
    result: AntennaResult
    along_m: Floats
    east_north_m: Floats
    least_squares_m: Floats

    @property
    def tested(self) -> Masks:
        return self.result.raim.outcome != Outcome.UNTESTABLE

    @property
    def located(self) -> Masks:
        return np.isfinite(self.along_m)


def play(data: Path, station: Station, beside_m: float, map_sigma_m: float | None) -> Day:
    """The station as a train that stands on the line; the pipeline with its mask and RAIM."""
    folder = data / "static"
    observations = read_observations(folder / station.observations)[:: station.every]
    place = observations.header.approximate_ecef_m
    trajectory = line_between(*two_points(place, beside_m))
    config = parse_config(
        {
            "filter": "off",
            "systems": list(station.systems),
            "screens": ["elevation", "raim"],
            "elevation": {"mask_deg": 15.0},
            "map_plan_sigma_m": map_sigma_m,
            "raim_protection": "on",
        }
    )
    processor = make_processor(config, read_navigation([folder / station.navigation]), {"front": trajectory})
    result = processor.process({"front": observations})[0].antennas["front"]
    reference = np.broadcast_to(place, (len(result), 3))
    latitude, longitude, _ = geodetic_from_ecef(place)
    axes = enu_axes(latitude, longitude)[:2].T
    along = along_track_error(result.arc_m, reference, trajectory)
    on_line, in_space = (result.ecef_m - place) @ axes, (result.point.ecef_m - place) @ axes
    return Day(observations, result, along, on_line, in_space)


def _percentiles(values: Floats) -> str:
    good = np.abs(values[np.isfinite(values)])
    return " ".join(f"{value:6.2f}" for value in (np.median(good), np.quantile(good, 0.95), good.max()))


def row(day: Day) -> str:
    """Errors, RAIM and levels of a day in one line."""
    raim, located = day.result.raim, day.located
    alarms = np.count_nonzero(raim.statistic[day.tested] >= raim.threshold[day.tested])
    level = raim.protection_level_m[located & np.isfinite(raim.protection_level_m)]
    error = np.abs(day.along_m[located & np.isfinite(raim.protection_level_m)])
    return (
        f"{np.count_nonzero(located):5d} {_percentiles(day.along_m)} "
        f"{_percentiles(day.east_north_m[:, 0])} {_percentiles(day.east_north_m[:, 1])} "
        f"{day.result.noise_scale[-1]:5.2f} {alarms:5d} "
        f"{np.median(level):6.2f} {level.max():7.2f} {np.count_nonzero(level > ALARM_LIMIT_M):5d} "
        f"{np.count_nonzero(error > level):5d} "
        + " ".join(f"{value:6.2f}" for value in np.nanquantile(np.abs(day.least_squares_m), 0.95, axis=0))
    )


HEAD: Final = (
    "                                           along [m]             east [m]            north [m]"
    "  noise  over     level [m]   over over  3-D p95 [m]\n"
    "station      beside map [m] epochs   p50    p95    max    p50    p95    max    p50    p95    max"
    "  scale T_D    p50     max   20 m level   east  north"
)


def hours(day: Day, *, step_h: int) -> Iterator[str]:
    """The day in pieces: east and north error, T against T_D, protection level."""
    hour = (day.result.time - day.result.time[0].astype("datetime64[D]")) / np.timedelta64(1, "h")
    raim = day.result.raim
    root, limit = np.sqrt(raim.statistic), np.sqrt(raim.threshold)
    yield "hours   sats   east [m]  north [m]  T p50  T max  T_D p50  over  level p50  level max"
    for first in range(0, 24, step_h):
        part = (hour >= first) & (hour < first + step_h) & day.located
        if not part.any():
            continue
        level = raim.protection_level_m[part]
        east, north = np.median(day.east_north_m[part], axis=0)
        yield (
            f"{first:02d}-{first + step_h:02d}  {np.median(day.result.n_used[part]):5.0f} {east:10.2f} {north:10.2f} "
            f"{np.median(root[part]):6.2f} {root[part].max():6.2f} {np.median(limit[part]):8.2f} "
            f"{np.count_nonzero(root[part] >= limit[part]):5d} {np.nanmedian(level):10.2f} {np.nanmax(level):10.2f}"
        )


def report(data: Path) -> Iterator[str]:
    """All that is printed, line by line; the last station's day on the line through it by three hours."""
    yield from HEAD.splitlines()
    for station in STATIONS:
        for beside, sigma in LINES:
            day = play(data, station, beside, sigma)
            yield f"{station.name:12s} {abs(beside):6.1f} {0.3 if sigma is None else sigma:7.1f} {row(day)}"
    yield ""
    beside = abs(BESIDE_M)
    yield f"{STATIONS[-1].name}, line {beside:.1f} m beside, map error {beside:.1f} m"
    yield from hours(play(data, STATIONS[-1], *LINES[1]), step_h=3)


def draw(day: Day, path: Path) -> None:
    """East and north error, T against T_D, protection level against the alarm limit, over the day."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 8.0), layout="constrained")
    errors, statistic, level = figure.subplots(3, 1, sharex=True)
    hour = (day.result.time - day.result.time[0].astype("datetime64[D]")) / np.timedelta64(1, "h")
    errors.plot(hour, day.east_north_m[:, 0], ".", label="east")
    errors.plot(hour, day.east_north_m[:, 1], ".", label="north")
    errors.set_ylabel("error [m]")
    raim = day.result.raim
    statistic.plot(hour, np.sqrt(raim.statistic), ".", label="T")
    statistic.plot(hour, np.sqrt(raim.threshold), "-", label="T_D")
    statistic.set_ylabel("test statistic")
    level.semilogy(hour, np.abs(day.along_m), ".", label="error along the line")
    level.semilogy(hour, raim.protection_level_m, "-", label="protection level")
    level.axhline(ALARM_LIMIT_M, color="#c1272d", label="alarm limit")
    level.set_ylabel("[m]")
    level.set_xlabel("hours of the day, GPS time")
    for panel in (errors, statistic, level):
        panel.legend(loc="upper right")
        panel.grid(alpha=0.3)
    figure.savefig(path, dpi=120)


def main() -> int:
    data = paths.DATA
    if not data.is_dir():
        print(f"the real recordings are not at {data}", file=sys.stderr)
        return 1
    for line in report(data):
        print(line)
    if len(sys.argv) > 1:
        draw(play(data, STATIONS[-1], *LINES[1]), Path(sys.argv[1]) / "p4-experiment.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
