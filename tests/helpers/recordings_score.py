"""Runs of the real recordings with one setting for all, and their scores."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import recordings_truth
from railfix.core.constants import CLOCK_GROUP
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.core.timescale import timedelta
from railfix.evaluate import Score, along_track_error, interpolate_reference, score, straight_distance
from railfix.integrity.raim import Outcome as RaimOutcome
from railfix.integrity.raim import exclude, linear_model
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import Config, parse_config
from railfix.pipeline.results import AntennaResult
from railfix.positioning.igg3_fit import map_information, robust_fit
from railfix.positioning.inter_system import OffsetState, tie_clocks
from railfix.positioning.noise_windows import Windows
from railfix.positioning.normal_equations import Constrained, point_position, position_on_line
from railfix.positioning.range_arrays import Ranges, without
from railfix.positioning.receiver_noise import NoiseState, epoch_sigma_m, noise_scale
from railfix.positioning.search_index import SearchIndex
from railfix.positioning.section_search import find_section
from railfix.ranges.channels import clock_groups
from railfix.ranges.range_sigma import code_sigma_m
from railfix.run.processor_setup import make_processor
from railfix.track import Track, from_positions
from railfix.track.trajectory import Trajectory

#: Settings of the tables: the elevation mask of 15 deg is common to all.
TABLES = {
    "health and elevation only": parse_config(
        {"filter": "off", "screens": ["elevation"], "elevation": {"mask_deg": 15.0}}
    ),
    "all screens, failed checks kept": parse_config({"filter": "off", "elevation": {"mask_deg": 15.0}}),
    "strict": parse_config({"filter": "off", "preset": "strict", "elevation": {"mask_deg": 15.0}}),
}
#: Screens of health and elevation only.
SETTINGS = TABLES["health and elevation only"]


@dataclass(frozen=True)
class Outcome:
    """One recording's run."""

    name: str
    constrained: Score
    conventional: Score
    error_m: np.ndarray
    result: AntennaResult | None
    trajectory: Trajectory
    ranges: Ranges | None = None
    straight: Score | None = None


def trajectory_of(time: np.ndarray, ecef_m: np.ndarray) -> Trajectory:
    """The map made from the reference, 5 m, standing still removed."""
    return Trajectory.from_antenna_path(from_positions(time, ecef_m, spacing_m=5.0))


def run_rinex(
    name: str, observations: Path, navigation: list[Path], truth: tuple[np.ndarray, np.ndarray], config: Config
) -> Outcome:
    time, ecef = truth
    trajectory = trajectory_of(time, ecef)
    processor = make_processor(config, read_navigation(navigation), {"front": trajectory})
    result, _ = processor.process({"front": read_observations(observations)})
    antenna = result.antennas["front"]
    reference = interpolate_reference(antenna.time, time, ecef)
    return outcome(name, antenna, reference, trajectory)


def outcome(name: str, antenna: AntennaResult, reference: np.ndarray, trajectory: Trajectory) -> Outcome:
    observed = np.isfinite(reference[:, 0]) & np.any((antenna.reason & 1) == 0, axis=1)
    error = along_track_error(antenna.arc_m, reference, trajectory)
    other = along_track_error(antenna.conventional_arc_m, reference, trajectory)
    straight = score(straight_distance(antenna.arc_m, reference, trajectory), observed)
    return Outcome(name, score(error, observed), score(other, observed), error, antenna, trajectory, straight=straight)


def urbannav_f9p(data: Path, config: Config = SETTINGS) -> Outcome:
    folder = data / "kinematic" / "urbannav_tst"
    obs = folder / "20210517.light-urban.tste.ublox.f9p.obs"
    return run_rinex(
        "urbannav_tst F9P", obs, [folder / "hksc137c.nav"], recordings_truth.urbannav_truth(folder), config
    )


def urbannav_m8t(data: Path, config: Config = SETTINGS) -> Outcome:
    folder = data / "kinematic" / "urbannav_tst"
    obs = folder / "20210517.light-urban.tste.ublox.m8t.GC.obs"
    return run_rinex(
        "urbannav_tst M8T", obs, [folder / "hksc137c.nav"], recordings_truth.urbannav_truth(folder), config
    )


def gsdc(data: Path, config: Config = SETTINGS) -> Outcome:
    folder = data / "kinematic" / "gsdc_pixel5_a"
    truth = recordings_truth.gsdc_truth(folder)
    return run_rinex("gsdc_pixel5_a", folder / "Pixel5_a.21o", [folder / "hour1180.21n"], truth, config)


def japan(data: Path, config: Config = SETTINGS) -> Outcome:
    folder = data / "kinematic" / "japan_mosaic_2021265_with_GEONET3034"
    truth = recordings_truth.japan_truth(folder)
    return run_rinex("japan_mosaic", folder / "SEPT265G.21O", [folder / "SEPT2650.21P"], truth, config)


def straight_line(station_ecef_m: np.ndarray, azimuth_deg: float, *, half_m: float = 1000.0) -> Trajectory:
    """A level line of 2 km through a station, points every 5 m, off the station's own vertex."""
    along = np.arange(-half_m, half_m + 1.0, 5.0) + 2.3
    latitude, longitude, height = geodetic_from_ecef(station_ecef_m)
    axes = enu_axes(latitude, longitude)
    bearing = np.radians(azimuth_deg)
    points = station_ecef_m + along[:, None] * (np.sin(bearing) * axes[0] + np.cos(bearing) * axes[1])
    lat, lon, _ = geodetic_from_ecef(points)
    # Level: the tangent plane leaves the ellipsoid by 8 cm at 1 km.
    return Trajectory.from_antenna_path(
        Track.from_ecef(ecef_from_geodetic(lat, lon, np.full(len(along), float(height))))
    )


def geonet(data: Path, station: str, azimuth_deg: float, config: Config = SETTINGS) -> Outcome:
    folder = data / "static" / "rtklib_geonet2005"
    observations = read_observations(folder / f"{station}0920.05o")
    place = observations.header.approximate_ecef_m
    trajectory = straight_line(place, azimuth_deg)
    navigation = read_navigation([folder / f"{station}0920.05n"])
    processor = make_processor(config, navigation, {"front": trajectory})
    result, _ = processor.process({"front": observations})
    antenna = result.antennas["front"]
    reference = np.broadcast_to(place, (len(antenna), 3))
    return outcome(f"geonet2005 {station} az {azimuth_deg:.0f}", antenna, reference, trajectory)


@dataclass(frozen=True)
class SmartlocLog:
    """Ranges as recorded: satellite clock and atmosphere applied, Earth rotation not."""

    time: np.ndarray
    satellite: np.ndarray
    code_m: np.ndarray
    sat_ecef_m: np.ndarray
    elevation_deg: np.ndarray
    cn0_dbhz: np.ndarray


def smartloc_ranges(folder: Path) -> SmartlocLog:
    """The text log as (epoch, satellite) arrays, satellites of one clock side by side."""
    letters = {1: "G", 16: "J", 8: "E", 32: "C", 4: "R"}
    rows = []
    with (folder / "Berlin_Potsdamer_Platz_Input.txt").open(encoding="ascii") as lines:
        for line in lines:
            kind, *numbers = line.split()
            if kind == "pseudorange3" and int(float(numbers[7])) in letters:
                rows.append([float(x) for x in numbers[:10]])
    table = np.array(rows)
    names = np.array([f"{letters[int(s)]}{int(n):02d}" for n, s in table[:, 6:8]])
    satellite, column = np.unique(names, return_inverse=True)
    stamp, row = np.unique(table[:, 0], return_inverse=True)
    grid = np.full((len(stamp), len(satellite), 6), np.nan)
    grid[row, column] = table[:, [1, 3, 4, 5, 8, 9]]
    return SmartlocLog(
        time=recordings_truth.SMARTLOC_START + timedelta(stamp),
        satellite=satellite,
        code_m=grid[..., 0],
        sat_ecef_m=grid[..., 1:4],
        elevation_deg=grid[..., 4],
        cn0_dbhz=grid[..., 5],
    )


def smartloc_chain(
    time: np.ndarray, ranges: Ranges, trajectory: Trajectory, start_ecef_m: np.ndarray, config: Config
) -> np.ndarray:
    """The rooms in the order of the pipeline, on ranges that have no ephemerides; arcs, NaN where dropped."""
    index = SearchIndex(trajectory)
    middle = trajectory.ecef_m.mean(axis=0)

    def place(part: Ranges) -> Constrained:
        began = np.where(np.isnan(start_ecef_m), middle, start_ecef_m)
        vertex = find_section(part, index, point_position(part, began), limits=config.section).vertex
        return position_on_line(part, trajectory, np.where(part.n_used >= config.min_satellites, vertex, -1))

    got = place(ranges)
    known = np.isfinite(got.arc_m)
    at = np.where(known[:, None], trajectory.at_arc(np.where(known, got.arc_m, 0.0)), middle)
    agreeing = robust_fit(ranges, at, information=map_information(trajectory, np.maximum(got.section, 0)))
    new, limits = NoiseState(), config.noise_scale
    windows = Windows.of(
        time, (slice(None),), [(new.time, new.age)], window_s=limits.window_s, least_epochs=limits.least_epochs
    )
    wsse, one = agreeing.variance * agreeing.freedom, np.ones(len(time))
    scale, _ = noise_scale(windows, wsse, agreeing.freedom, known, one, new.robust[None], limits=limits)
    failed = np.zeros(len(ranges), dtype=bool)
    if "raim" in config.screens:
        model = linear_model(ranges, trajectory, got.arc_m, section=got.section)
        exclusion = exclude(model, limits=config.raim, scale=scale)
        failed = np.isin(exclusion.outcome, [RaimOutcome.INSEPARABLE, RaimOutcome.UNRESOLVED])
        ranges = without(ranges, exclusion.excluded)
        got = place(ranges)
    redundancy = ranges.n_used - ranges.n_clocks - 1
    failed |= epoch_sigma_m(redundancy, got.wsse, got.exact_map_sigma_m, scale) > config.largest_sigma_m
    arc = np.where(got.dilution <= config.dilution_limit, got.arc_m, np.nan)
    return np.where(failed & (config.failed_checks == "drop"), np.nan, arc)


def smartloc(data: Path, config: Config = SETTINGS) -> Outcome:
    """No RINEX: ranges, satellites, elevations and C/N0 go straight into the array functions."""
    log = smartloc_ranges(data / "kinematic" / "smartloc_berlin")
    time, ecef = recordings_truth.smartloc_truth(data / "kinematic" / "smartloc_berlin")
    trajectory = trajectory_of(time, ecef)
    used = log.elevation_deg >= config.elevation.mask_deg
    sigma = code_sigma_m(log.cn0_dbhz, log.elevation_deg, noise=config.noise)
    used &= np.isfinite(log.code_m) & np.isfinite(sigma)
    ranges = Ranges(
        sat_ecef_m=np.where(used[..., None], log.sat_ecef_m, 2.6e7),
        code_m=np.where(used, log.code_m, 0.0),
        weight=np.where(used, 1.0 / sigma**2, 0.0),
        groups=clock_groups([str(s)[0] for s in log.satellite]),
    )
    start = np.broadcast_to(trajectory.ecef_m.mean(axis=0), (len(ranges), 3))
    point = point_position(ranges, start)
    clocks = tuple(CLOCK_GROUP[str(log.satellite[group.start])[0]] for group in ranges.groups)
    ties, _ = tie_clocks(log.time, clocks, "G", ranges, point, [OffsetState()], limits=config.clock_offsets)
    ranges = replace(ranges, ties=ties)
    arc = smartloc_chain(log.time, ranges, trajectory, point.ecef_m, config)
    reference = interpolate_reference(log.time, time, ecef)
    observed = np.isfinite(reference[:, 0]) & np.isfinite(log.code_m).any(axis=1)
    nearest, _ = trajectory.nearest(point.ecef_m)
    error = along_track_error(arc, reference, trajectory)
    return Outcome(
        "smartloc_berlin",
        score(error, observed),
        score(along_track_error(nearest, reference, trajectory), observed),
        error,
        None,
        trajectory,
        ranges,
        score(straight_distance(arc, reference, trajectory), observed),
    )


RECORDINGS: dict[str, Callable[[Path, Config], Outcome]] = {
    "urbannav_f9p": urbannav_f9p,
    "urbannav_m8t": urbannav_m8t,
    "gsdc": gsdc,
    "smartloc": smartloc,
    "japan": japan,
}
