"""Tables of what noise scale, clock offsets, sigmas, maps and priors do to positions and levels.

``python tests/studies/integrity_tables.py PART`` with the recordings beside the checkout prints a part of
``docs/level-results.md``: faults, maps, sigmas, priors, sides, ahead.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl

import paths
import recordings_truth
from railfix.core.arrays import Floats, Masks
from railfix.core.reasons import Status
from railfix.core.timescale import seconds
from railfix.evaluate import along_track_error, interpolate_reference
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.integrity.protection import LevelStatus, RiskBudget
from railfix.io import read_navigation, read_observations
from railfix.kernels.tracking.constants import AHEAD
from railfix.pipeline.config import Config, parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.results import AntennaResult
from railfix.simulate.demonstration import demo_files
from railfix.track import read_track
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import antenna_trajectory, read_vehicle
from recordings_score import trajectory_of

DATA: Final = paths.ROOT.parent / "shared" / "data" / "kinematic"
SETTINGS: Final = parse_config({"filter": "off", "elevation": {"mask_deg": 15.0}})
SIZES_M: Final = (20.0, 50.0, 100.0)
#: Offsets of the map: right of the line and up [m].
OFFSETS_M: Final = ((0, 0), (5, 0), (10, 0), (20, 0), (50, 0), (200, 0), (2000, 0), (0, 10), (0, 20), (0, 37))
#: Priors of local faults that cities ask for (docs/level-results.md).
LOCAL_PRIORS: Final = (1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4)


@dataclass(frozen=True)
class Case:
    """A log, its line, and the reference position at each epoch (NaN where there is none)."""

    observations: Observations
    navigation: Navigation
    trajectory: Trajectory
    reference_ecef_m: Floats

    def solved(
        self, config: Config = SETTINGS, *, bias_m: Floats | None = None, line: Trajectory | None = None
    ) -> AntennaResult:
        """The front antenna's result, something added to its codes, on its own or another line."""
        observations = self.observations
        if bias_m is not None:
            observations = replace(observations, code_m=observations.code_m + bias_m)
        processor = EpochProcessor(config, {"front": line or self.trajectory}, navigation=self.navigation)
        return processor.process({"front": observations})[0].antennas["front"]

    def errors(self, result: AntennaResult) -> tuple[Floats, Floats]:
        """Distance to the reference's point of the line, straight and along the line, shape (T,) each [m]."""
        known = np.isfinite(self.reference_ecef_m[:, 0])
        arc, _ = self.trajectory.nearest(np.nan_to_num(self.reference_ecef_m))
        point = self.trajectory.at_arc(np.where(known, arc, np.nan))
        straight = np.linalg.norm(self.trajectory.at_arc(result.arc_m) - point, axis=1)
        along = np.abs(along_track_error(result.arc_m, self.reference_ecef_m, self.trajectory))
        return np.where(known, straight, np.nan), along


def demonstration() -> Case:
    files = demo_files()
    line = antenna_trajectory(read_track(files["track"]), read_vehicle(files["vehicle"]), "front")
    truth = pl.read_csv(files["truth"]).filter(pl.col("antenna") == "front")
    reference = truth.select("x_m", "y_m", "z_m").to_numpy()
    return Case(read_observations(files["front"]), read_navigation(files["nav"]), line, reference)


def recording(folder: str, log: str, navigation: str, truth: Callable[[Path], recordings_truth.Truth]) -> Case:
    time, ecef = truth(DATA / folder)
    observations = read_observations(DATA / folder / log)
    reference = interpolate_reference(observations.time, time, ecef)
    return Case(observations, read_navigation([DATA / folder / navigation]), trajectory_of(time, ecef), reference)


@cache
def cases() -> dict[str, Case]:
    town, truths = "urbannav_tst", recordings_truth
    return {
        "demo": demonstration(),
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


def fault_rows() -> Iterator[str]:
    """Each satellite in turn too long by a constant, from the first epoch on and from the middle on."""
    yield "                      median error [m]   largest, ok   excluded   available   over the level, no alarm"
    yield "log    size since     median   worst          [m]          %           %      ok   ambiguous"
    for name, case in cases().items():
        clean = case.solved()
        straight, _ = case.errors(clean)
        level, calm = bounds(clean)
        yield _fault_row(name, "none", "", [(clean, straight, level, calm)])
        used = np.flatnonzero((clean.reason == 0).mean(axis=0) > 0.2)
        for size in SIZES_M:
            for since, start in (("first", 0), ("middle", len(clean) // 2)):
                found = []
                for channel in used.tolist():
                    bias = np.zeros(case.observations.code_m.shape)
                    same = case.observations.satellite == case.observations.satellite[channel]
                    bias[start:, same] = size
                    result = case.solved(bias_m=bias)
                    straight, _ = case.errors(result)
                    straight = np.where(np.arange(len(result)) >= start, straight, np.nan)
                    found.append((result, straight, *bounds(result)))
                yield _fault_row(name, f"{size:g} m", since, found)


def _fault_row(name: str, size: str, since: str, found: list[tuple[AntennaResult, Floats, Floats, Masks]]) -> str:
    medians, largest, excluded, available, over, doubtful = [], 0.0, [], [], 0, 0
    for result, error, level, calm in found:
        judged = np.isfinite(error)
        ok = judged & (result.status == Status.OK)
        medians.append(float(np.median(error[judged])))
        largest = max(largest, float(error[ok].max(initial=0.0)))
        excluded.append(100.0 * float(result.raim.excluded[judged].any(axis=1).mean()))
        assert result.protection is not None
        available.append(100.0 * float((level[judged] <= 20.0).mean()))
        beyond = judged & calm & (error > level)
        over += int(np.count_nonzero(beyond & (result.status == Status.OK)))
        doubtful += int(np.count_nonzero(beyond & (result.status != Status.OK)))
    return (
        f"{name:6s} {size:>5s} {since:8s} {np.median(medians):7.2f} {max(medians):7.2f} {largest:12.1f} "
        f"{np.median(excluded):10.1f} {np.median(available):11.1f} {over:7d} {doubtful:9d}"
    )


def moved(line: Trajectory, across_m: float, up_m: float) -> Trajectory:
    """The line beside and above its place."""
    across = np.concatenate([line.across, line.across[-1:]])
    up = np.concatenate([line.up, line.up[-1:]])
    return replace(line, ecef_m=line.ecef_m + across_m * across + up_m * up)


def map_rows() -> Iterator[str]:
    """The map beside the line and above it: what the status, the statistic and the level say of it."""
    yield "        map off by [m]  % of the epochs with a position                largest  detectable [m]  level [m]"
    yield "log     right     up    ok  ambiguous  off map map offset  other statistic  across   up  median  over ok amb"
    for name, case in cases().items():
        for across, up in OFFSETS_M:
            wrong = replace(case, trajectory=moved(case.trajectory, across, up))
            result = wrong.solved()
            has = np.isfinite(result.chainage_m)
            shares = [
                100.0 * float((result.status[has] == s).mean())
                for s in (Status.OK, Status.AMBIGUOUS, Status.OFF_MAP, Status.MAP_OFFSET)
            ]
            offset = result.map_offset
            known = np.isfinite(offset.statistic).any()
            largest = float(np.nanmax(offset.statistic)) if known else np.nan
            detectable = np.nanmedian(offset.detectable_m, axis=0) if known else [np.nan, np.nan]
            level, calm = bounds(result)
            over = calm & (wrong.errors(result)[0] > level)
            doubtful = result.status == Status.AMBIGUOUS
            yield (
                f"{name:6s} {across:6d} {up:6d} {shares[0]:5.1f} {shares[1]:10.1f} {shares[2]:8.1f} {shares[3]:10.1f} "
                f"{100.0 - sum(shares):6.1f} {largest:9.1f} {detectable[0]:7.1f} {detectable[1]:5.1f} "
                f"{np.nanmedian(level):7.1f} {(over & ~doubtful).sum():7d} {(over & doubtful).sum():4d}"
            )


def sigma_rows() -> Iterator[str]:
    """Errors over the stated sigma: epochs, and the median of blocks of 60 s."""
    yield "                     error over along_sigma_m, along the line       straight        blocks of 60 s"
    yield "log    epochs      p50    p68    p95                       p68    p95     over 2.4 at the median"
    for name, case in cases().items():
        result = case.solved()
        straight, along = case.errors(result)
        known = np.isfinite(straight) & np.isfinite(along)
        ratio, other = along[known] / result.along_sigma_m[known], straight[known] / result.along_sigma_m[known]
        block = (seconds(result.time[known] - result.time[0]) // 60.0).astype(int)
        middles = np.array([np.median(ratio[block == b]) for b in np.unique(block)])
        p50, p68, p95 = np.percentile(ratio, [50, 68, 95])
        q68, q95 = np.percentile(other, [68, 95])
        yield (
            f"{name:6s} {known.sum():6d} {p50:8.2f} {p68:6.2f} {p95:6.2f} {q68:25.2f} {q95:6.2f} "
            f"{(middles > 2.4).sum():10d} of {len(middles)}"
        )


def prior_settings() -> dict[str, dict[str, Any]]:
    """Settings of the risk: priors of local faults, and of a fault of a constellation other than GPS."""
    settings: dict[str, dict[str, Any]] = {f"local {p:g}": {"local_prior": p} for p in LOCAL_PRIORS}
    return settings | {
        f"constellation {p:g}": {"constellation_prior": dict.fromkeys("ECR", p)} for p in (1e-6, 1e-5, 1e-4)
    }


def prior_rows() -> Iterator[str]:
    """Levels of every log by the prior of local faults, and by that of a constellation, of epochs with observations."""
    yield "log    prior                 levels %   median [m]   within 20 m %   40 m %   us an epoch   over"
    for name, case in cases().items():
        for prior, risk in prior_settings().items():
            began = time.process_time()
            result = case.solved(parse_config({"filter": "off", "elevation": {"mask_deg": 15.0}, "risk": risk}))
            spent = time.process_time() - began
            assert result.protection is not None
            of_all = result.protection.level.level_m[result.status != Status.NO_OBSERVATION]
            finite = of_all[np.isfinite(of_all)]
            median = float(np.median(finite)) if len(finite) else np.nan
            within = [100.0 * float((of_all <= limit).mean()) for limit in (20.0, 40.0)]
            level, calm = bounds(result)
            over = int((calm & (case.errors(result)[1] > level)).sum())
            yield (
                f"{name:6s} {prior:20s} {100.0 * len(finite) / len(of_all):9.1f} {median:12.2f} {within[0]:15.1f}"
                f" {within[1]:8.1f} {1e6 * spent / len(of_all):13.0f} {over:6d}"
            )


def side_rows() -> Iterator[str]:
    """Levels of every log by the prior of one reflection off a side of the track, of epochs with observations."""
    yield "log    side_prior   levels %   median [m]   p95 [m]   within 10 m %   20 m %   40 m %   us an epoch   over"
    for name, case in cases().items():
        for prior in (0.0, 1e-8, 1e-7, 1e-6, 1.3e-5, 1e-4, 1e-2):
            began = time.process_time()
            result = case.solved(
                parse_config({"filter": "off", "elevation": {"mask_deg": 15.0}, "risk": {"side_prior": prior}})
            )
            spent = time.process_time() - began
            assert result.protection is not None
            of_all = result.protection.level.level_m[result.status != Status.NO_OBSERVATION]
            finite = of_all[np.isfinite(of_all)]
            median, high = np.percentile(finite, (50.0, 95.0)) if len(finite) else (np.nan, np.nan)
            within = [100.0 * float((of_all <= limit).mean()) for limit in (10.0, 20.0, 40.0)]
            level, calm = bounds(result)
            over = int((calm & (case.errors(result)[1] > level)).sum())
            yield (
                f"{name:6s} {prior:10g} {100.0 * len(finite) / len(of_all):10.1f} {median:12.2f} {high:9.1f}"
                f"{within[0]:16.1f} {within[1]:8.1f} {within[2]:8.1f} {1e6 * spent / len(of_all):13.0f} {over:6d}"
            )


def late_ahead_rows() -> Iterator[str]:
    """Levels with the satellites beside the track as sides, or also those ahead and behind; codes ahead late or not."""
    yield "log    late_sides   codes ahead   levels %   median [m]   largest error [m]   over"
    for name, case in cases().items():
        plain = case.solved()
        section = np.maximum(plain.fix.constrained.section, 0)
        off_heading = np.radians(plain.azimuth_deg - case.trajectory.heading_deg[section][:, None])
        ahead = np.cos(off_heading) * np.cos(np.radians(plain.elevation_deg)) > AHEAD
        for sides in ("beside", "all"):
            for late_m in (0.0, 15.0, 30.0):
                result = case.solved(
                    SETTINGS.model_copy(update={"risk": RiskBudget(late_sides=sides)}), bias_m=late_m * ahead
                )
                level, calm = bounds(result)
                error, known = case.errors(result)[1], np.isfinite(level)
                yield (
                    f"{name:6s} {sides:>10s} {f'{late_m:g} m late':>13s} {100.0 * known.mean():10.1f}"
                    f" {np.median(level[known]):12.2f} {np.nanmax(error[known]):19.1f}"
                    f" {int((calm & (error > level)).sum()):6d}"
                )


PARTS: Final[dict[str, Callable[[], Iterator[str]]]] = {
    "faults": fault_rows,
    "maps": map_rows,
    "sigmas": sigma_rows,
    "priors": prior_rows,
    "sides": side_rows,
    "ahead": late_ahead_rows,
}


def main() -> int:
    """Print one part, or all."""
    if len(sys.argv) != 2 or sys.argv[1] not in PARTS or not DATA.is_dir():
        print(f"give one of {', '.join(PARTS)}; the recordings are expected at {DATA}", file=sys.stderr)
        return 1
    for line in PARTS[sys.argv[1]]():
        print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
