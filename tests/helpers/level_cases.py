"""Logs with lines and references, on which positions and protection levels are computed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
import polars as pl

import paths
import recordings_truth
from railfix.core.arrays import Floats, Masks
from railfix.evaluate import interpolate_reference
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.integrity.protection import LevelStatus
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import Config, parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.results import AntennaResult
from railfix.simulate.demonstration import demo_files
from railfix.track import read_track
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import antenna_trajectory, read_vehicle
from recordings_score import straight_line, trajectory_of

DATA: Final = paths.ROOT.parent / "shared" / "data" / "kinematic"
SETTINGS: Final = parse_config({"filter": "off", "elevation": {"mask_deg": 15.0}})


@dataclass(frozen=True)
class Case:
    """A log, its line, and the reference position at each epoch (NaN where there is none)."""

    observations: Observations
    navigation: Navigation
    trajectory: Trajectory
    reference_ecef_m: Floats

    def solved(self, config: Config = SETTINGS, *, bias_m: Floats | None = None) -> AntennaResult:
        """The front antenna's result, something added to its codes."""
        observations = self.observations
        if bias_m is not None:
            observations = replace(observations, code_m=observations.code_m + bias_m)
        processor = EpochProcessor(config, {"front": self.trajectory}, navigation=self.navigation)
        return processor.process({"front": observations})[0].antennas["front"]

    def errors_m(self, result: AntennaResult) -> Floats:
        """Straight distance to the reference's point of the line, shape (T,)."""
        known = np.isfinite(self.reference_ecef_m[:, 0])
        arc, _ = self.trajectory.nearest(np.nan_to_num(self.reference_ecef_m))
        point = self.trajectory.at_arc(np.where(known, arc, np.nan))
        straight = np.linalg.norm(self.trajectory.at_arc(result.arc_m) - point, axis=1)
        return np.where(known, straight, np.nan)


def of_files(files: Mapping[str, Path]) -> Case:
    """The front antenna of a simulated run."""
    line = antenna_trajectory(read_track(files["track"]), read_vehicle(files["vehicle"]), "front")
    truth = pl.read_csv(files["truth"]).filter(pl.col("antenna") == "front")
    reference = truth.select("x_m", "y_m", "z_m").to_numpy()
    return Case(read_observations(files["front"]), read_navigation(files["nav"]), line, reference)


def recording(folder: str, log: str, navigation: str, truth: Callable[[Path], recordings_truth.Truth]) -> Case:
    time, ecef = truth(DATA / folder)
    observations = read_observations(DATA / folder / log)
    reference = interpolate_reference(observations.time, time, ecef)
    return Case(observations, read_navigation([DATA / folder / navigation]), trajectory_of(time, ecef), reference)


def station(name: str, azimuth_deg: float) -> Case:
    """A station of GEONET in 2005 on a level line through it."""
    folder = DATA.parent / "static" / "rtklib_geonet2005"
    observations = read_observations(folder / f"{name}0920.05o")
    place = observations.header.approximate_ecef_m
    navigation, reference = read_navigation([folder / f"{name}0920.05n"]), np.tile(place, (len(observations), 1))
    return Case(observations, navigation, straight_line(place, azimuth_deg), reference)


@cache
def cases() -> dict[str, Case]:
    town, truths = "urbannav_tst", recordings_truth
    return {
        "demo": of_files(demo_files()),
        "F9P": recording(town, "20210517.light-urban.tste.ublox.f9p.obs", "hksc137c.nav", truths.urbannav_truth),
        "M8T": recording(town, "20210517.light-urban.tste.ublox.m8t.GC.obs", "hksc137c.nav", truths.urbannav_truth),
        "Pixel": recording("gsdc_pixel5_a", "Pixel5_a.21o", "hour1180.21n", truths.gsdc_truth),
        "Japan": recording("japan_mosaic_2021265_with_GEONET3034", "SEPT265G.21O", "SEPT2650.21P", truths.japan_truth),
    }


def bounds(result: AntennaResult) -> tuple[Floats, Masks]:
    """Levels, infinite where the ranges contradict them; and epochs without an alarm or a doubt."""
    protection = result.protection
    assert protection is not None
    level = np.where(protection.level.consistent, protection.level.level_m, np.inf)
    return level, protection.status != LevelStatus.ALARM
