"""Tables of what noise scale, clock offsets, sigmas, maps and priors do to positions and levels.

``python tests/studies/integrity_tables.py PART`` with the recordings beside the checkout prints a part of
``docs/level-results.md``: faults, maps, sigmas, starts, priors, together, sides, ahead, late, ionosphere,
coefficients.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import polars as pl

import paths
import recordings_truth
from integrity_recordings import ranges_of
from railfix.core.arrays import Floats, Masks
from railfix.core.constants import FREQUENCY_L1
from railfix.core.geodesy import elevation_azimuth, geodetic_from_ecef, range_with_rotation
from railfix.core.reasons import Status
from railfix.core.timescale import seconds
from railfix.evaluate import along_track_error, interpolate_reference
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.integrity.protection import LevelStatus, RiskBudget
from railfix.integrity.protection.risk import set_sums
from railfix.integrity.raim import linear_model
from railfix.io import read_navigation, read_observations
from railfix.kernels.tracking.constants import AHEAD
from railfix.pipeline.config import Config, parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.results import AntennaResult
from railfix.positioning.igg3_fit import map_information
from railfix.positioning.normal_equations import normal_equations
from railfix.positioning.range_arrays import Ranges
from railfix.ranges.atmosphere import TYPICAL_KLOBUCHAR, klobuchar_delay_m
from railfix.simulate.demonstration import demo_files
from railfix.track import read_track
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import antenna_trajectory, read_vehicle
from railfix.tracking.limits import Tails
from recordings_score import smartloc, trajectory_of

DATA: Final = paths.ROOT.parent / "shared" / "data" / "kinematic"
SETTINGS: Final = parse_config({"filter": "off", "elevation": {"mask_deg": 15.0}})
SIZES_M: Final = (20.0, 50.0, 100.0)
#: Offsets of the map: right of the line and up [m].
OFFSETS_M: Final = ((0, 0), (5, 0), (10, 0), (20, 0), (50, 0), (200, 0), (2000, 0), (0, 10), (0, 20), (0, 37))
#: Priors of local faults that cities ask for (docs/level-results.md).
LOCAL_PRIORS: Final = (1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4)
#: Navigation files with Klobuchar coefficients of other days, beside `DATA`.
COEFFICIENT_FILES: Final = (
    "static/rtklib_geonet2005/07590920.05n",
    "static/ESBC_2020177/ESBC00DNK_R_20201770000_01D_MN.rnx.gz",
    "kinematic/gsdc_pixel5_a/hour1180.21n",
    "kinematic/japan_mosaic_2021265_with_GEONET3034/SEPT2650.21P",
    "dual/mosaic_x2_99cm/base.nav",
)
_NORMAL_MEDIAN: Final = 0.6745


class Reweighting(NamedTuple):
    """Student's t in single epochs: degrees of freedom; least redundancy; of satellites up to an elevation."""

    tails: Tails
    redundancy: int = 1
    elevation_deg: float = 90.0

    @property
    def text(self) -> str:
        return f"{self.tails.usual:g}, {self.tails.late:g} {self.redundancy:11d} {self.elevation_deg:10.0f}"


#: As of late codes for both sides; heavier for late codes, 4 and 1 as in the filter; with redundancy that tells late
#: codes from early ones; of satellites up to 45 deg, which walls as high as they are away reflect; both.
REWEIGHTINGS: Final = (
    None,
    *(Reweighting(Tails(4.0, late)) for late in (4.0, 3.0, 2.0, 1.0)),
    *(Reweighting(Tails(4.0, 1.0), redundancy) for redundancy in (5, 8)),
    Reweighting(Tails(4.0, 1.0), 1, 45.0),
    Reweighting(Tails(4.0, 1.0), 5, 45.0),
)


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


def start_rows() -> Iterator[str]:
    """Estimators of the scale of one epoch against each other."""
    yield "demonstration, line fit of single epochs; scale with one satellite in turn too long, over that without"
    yield f"{'estimator':24s}     clean" + "".join(f"{f'{size} m: median':>17s}   worst" for size in (10, 20, 100))
    case = cases()["demo"]
    clean = case.solved(parse_config({"filter": "off", "screens": ["elevation"]}))
    has = np.flatnonzero(np.isfinite(clean.fix.constrained.arc_m))[::20]
    columns = clean.columns
    used = (clean.reason[has][:, columns] == 0) & np.isfinite(clean.sigma_m[has][:, columns])
    ranges = Ranges(
        sat_ecef_m=np.where(used[..., None], clean.corrected.satellites.position_ecef_m[has], 2.6e7),
        code_m=np.where(used, clean.corrected_code_m[has][:, columns], 0.0),
        weight=np.where(used, 1.0 / np.where(used, clean.sigma_m[has][:, columns], 1.0) ** 2, 0.0),
        groups=(slice(0, len(columns)),),
    )
    # One clock: the offsets between constellations are taken out as the run knows them.
    systems = np.array([name[0] for name in clean.satellite[columns].tolist()])
    offset = np.zeros(used.shape)
    for g, letter in enumerate(clean.corrected.channels.clocks):
        mine = np.isin(systems, ["G", "J"] if letter == "G" else [letter])
        offset[:, mine] = clean.ties.offset_m[has][:, g, None]
    ranges = replace(ranges, code_m=np.where(used, ranges.code_m - offset, 0.0))
    arc = clean.fix.constrained.arc_m[has]
    place = case.trajectory.at_arc(arc)
    prior = map_information(case.trajectory, np.maximum(clean.fix.constrained.section[has], 0))
    for name, estimate in ESTIMATORS.items():
        base = estimate(ranges, place, prior)
        known = base > 0.0  # not where too few ranges are left to agree
        cells = [f"{np.median(base[known]):9.2f}"]
        for size in (10.0, 20.0, 100.0):
            ratios = []
            for channel in np.flatnonzero(used.mean(axis=0) > 0.2).tolist():
                code = ranges.code_m.copy()
                code[:, channel] += np.where(used[:, channel], size, 0.0)
                raised = estimate(replace(ranges, code_m=code), place, prior)
                ratios.append(float(np.median(raised[known] / base[known])))
            cells.append(f"{np.median(ratios):16.2f} {max(ratios):7.2f}")
        yield f"{name:24s} {' '.join(cells)}"


def _scale(ranges: Ranges, place: Floats, prior: Floats, weight: Callable[[Floats], Floats] | None) -> Floats:
    """Scale of each epoch: the median of the residuals without reweighting, else of what keeps its weight."""
    used = ranges.weight > 0
    factor, freedom = used.astype(float), np.maximum(ranges.n_used - 2, 1)
    distance, los = range_with_rotation(ranges.sat_ecef_m, place[:, None, :])
    for _ in range(1 if weight is None else 5):
        equations = normal_equations(replace(ranges, weight=ranges.weight * factor), place)
        step = np.einsum("tij,tj->ti", np.linalg.inv(equations.matrix + prior), equations.vector)
        clock = equations.clock_m[:, 0] - np.einsum("ti,ti->t", step, equations.clock_slope[:, :, 0])
        residual = ranges.code_m - distance + np.einsum("tmi,ti->tm", los, step) - clock[:, None]
        size = np.where(used, np.abs(residual) * np.sqrt(ranges.weight), np.nan)
        scale = np.nanmedian(size, axis=1) / _NORMAL_MEDIAN * np.sqrt(ranges.n_used / freedom)
        if weight is None:
            return np.asarray(scale)
        factor = np.where(used, weight(np.nan_to_num(size / np.maximum(scale, 0.05)[:, None])), 0.0)
    kept = factor > 0
    squares = np.where(kept, np.nan_to_num(size) ** 2 * np.minimum(factor, 1.0), 0.0).sum(axis=1)
    return np.asarray(np.sqrt(squares / np.maximum(factor.sum(axis=1) - 2.0, 1.0)))


def _igg3(keep: float, reject: float) -> Callable[[Floats], Floats]:
    def weight(size: Floats) -> Floats:
        decline = keep / np.maximum(size, 1e-9) * ((reject - size) / (reject - keep)) ** 2
        return np.where(size <= keep, 1.0, np.where(size < reject, decline, 0.0))

    return weight


#: Estimators of the scale of one epoch, by the name of their row.
ESTIMATORS: Final[dict[str, Callable[[Ranges, Floats, Floats], Floats]]] = {
    "root mean square": lambda r, p, m: _root_mean_square(r, p, m),
    "median (MAD)": lambda r, p, m: _scale(r, p, m, None),
    "Huber 1.5": lambda r, p, m: _scale(r, p, m, lambda u: np.where(u <= 1.5, 1.0, 1.5 / np.maximum(u, 1e-9))),
    "IGG-III 1.5, 4": lambda r, p, m: _scale(r, p, m, _igg3(1.5, 4.0)),
    "IGG-III 1, 3": lambda r, p, m: _scale(r, p, m, _igg3(1.0, 3.0)),
    "IGG-III 2, 8.5": lambda r, p, m: _scale(r, p, m, _igg3(2.0, 8.5)),
}


def _root_mean_square(ranges: Ranges, place: Floats, prior: Floats) -> Floats:
    equations = normal_equations(ranges, place)
    step = np.einsum("tij,tj->ti", np.linalg.inv(equations.matrix + prior), equations.vector)
    least = equations.wsse - np.einsum("ti,ti->t", step, equations.vector)
    return np.asarray(np.sqrt(np.maximum(least, 0.0) / np.maximum(ranges.n_used - 2, 1)))


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


def class_rows() -> Iterator[str]:
    """Probability of faults together over the risk of a sample, of ten satellites each of G and E, by their priors."""
    kinds = ("three", "four", "map, two", "side, two", "map, side, one", "const., map", "const., two", "const., side")
    yield f"{'prior':20s}" + "".join(f"{kind:>15s}" for kind in kinds)
    for name, settings in prior_settings().items():
        risk = RiskBudget(**settings)
        sums = set_sums(risk.prior(["G"] * 10 + ["E"] * 10)[None], 4)[0]
        one, side, shared = risk.map_prior, 2.0 * risk.side_prior, risk.constellation_prior.get("E", 0.0)
        of_kinds = (sums[3], sums[4], one * sums[2], side * sums[2], one * side * sums[1])
        of_kinds += (shared * one, shared * sums[2], shared * side)
        yield f"{name:20s}" + "".join(f"{value / risk.risk_per_sample:15.2g}" for value in of_kinds)


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


def ionosphere_rows() -> Iterator[str]:
    """Positions and levels with and without Klobuchar's coefficients, and without them under delays twice as large."""
    yield "log    coefficients, delays   vertical [m]   straight p50     p95    max   ratio p95   level median   over"
    for name, case in cases().items():
        bare = replace(case, navigation=replace(case.navigation, klobuchar={}))
        known, place = case.solved(), geodetic_from_ecef(case.trajectory.at_arc(np.zeros(1)))
        latitude, longitude = (np.repeat(value, len(known)) for value in place[:2])
        delay = partial(klobuchar_delay_m, known.time, latitude, longitude)
        coefficients = case.navigation.klobuchar.get("G", TYPICAL_KLOBUCHAR)
        carrier = np.array([FREQUENCY_L1])
        twice = np.nan_to_num(delay(known.elevation_deg, known.azimuth_deg, coefficients, carrier))
        overhead = np.full((len(known), 1), 90.0)
        vertical = float(np.median(delay(overhead, np.zeros_like(overhead), coefficients, carrier)))
        for label, result in (
            ("received, as they were", known),
            ("none, as they were", bare.solved()),
            ("none, twice", bare.solved(bias_m=twice)),
        ):
            straight, along = case.errors(result)
            level, calm = bounds(result)
            sizes = np.percentile(straight[np.isfinite(straight)], (50.0, 95.0, 100.0))
            ratio = along / result.along_sigma_m
            yield (
                f"{name:6s} {label:24s} {vertical:10.1f} {sizes[0]:14.2f} {sizes[1]:7.2f} {sizes[2]:6.1f}"
                f" {np.percentile(ratio[np.isfinite(ratio)], 95.0):11.2f} {np.median(level[np.isfinite(level)]):14.1f}"
                f" {int((calm & (along > level)).sum()):6d}"
            )


def coefficient_rows() -> Iterator[str]:
    """Vertical delay of the typical coefficients, and of others less that, over latitudes, longitudes and hours."""
    grid = np.meshgrid(np.arange(-60.0, 61.0, 10.0), np.arange(-180.0, 180.0, 30.0), np.arange(24.0))
    latitude, longitude, hour = (axis.ravel() for axis in grid)
    tags = np.datetime64("2020-01-05", "ns") + (hour * 3.6e12).astype("timedelta64[ns]")
    overhead = np.full((len(tags), 1), 90.0)

    def vertical(coefficients: Floats) -> Floats:
        model = partial(klobuchar_delay_m, tags, latitude, longitude, overhead, np.zeros_like(overhead))
        return model(coefficients, np.array([FREQUENCY_L1]))[:, 0]

    typical = vertical(TYPICAL_KLOBUCHAR)
    yield "day          RMS of the delay [m]   RMS less the typical   largest"
    yield f"2004-01-01 {np.sqrt(np.mean(typical**2)):22.2f}"
    for file in COEFFICIENT_FILES:
        navigation = read_navigation([DATA.parent / file])
        delay = vertical(navigation.klobuchar["G"])
        yield (
            f"{navigation.kepler.toe.min().astype('datetime64[D]')} {np.sqrt(np.mean(delay**2)):22.2f}"
            f" {np.sqrt(np.mean((delay - typical) ** 2)):22.2f} {np.abs(delay - typical).max():9.1f}"
        )


def reweighted(
    ranges: Ranges, line: Trajectory, arc: Floats, section: Floats, scale: Floats, how: Reweighting
) -> Floats:
    """Movement along the line by Student's t weights of the residuals, in sigmas of the level, shape (T,) [m]."""
    section = np.maximum(section, 0)
    residual = np.nan_to_num(
        linear_model(ranges, line, arc, section=section).residual / np.maximum(scale, 1.0)[:, None]
    )
    elevation, _ = elevation_azimuth(ranges.sat_ecef_m, line.at_arc(np.nan_to_num(arc)))
    weighed = (elevation <= how.elevation_deg) & (ranges.n_used - ranges.n_clocks - 1 >= how.redundancy)[:, None]
    factor = np.where(weighed, how.tails.weight(residual, residual**2), 1.0)
    weight = ranges.weight * factor
    return np.nan_to_num(linear_model(replace(ranges, weight=weight), line, arc, section=section).step_m[:, 0])


def late_rows() -> Iterator[str]:
    """Single epochs reweighted once with heavier tails for late codes; levels take the movement whole."""
    yield "            degrees of   redundancy  elevation   straight distance [m]     error over sigma  level  over"
    yield "log      freedom, late     at least    up to      p50     p95    max            68 %   95 %  median"
    for name, case in cases().items():
        result = case.solved()
        assert result.protection is not None
        for how in REWEIGHTINGS:
            fixed, movement = result.fix.constrained, np.zeros(len(result))
            if how is not None:
                arc = np.where(np.isfinite(result.arc_m), fixed.arc_m, np.nan)
                movement = reweighted(ranges_of(result), case.trajectory, arc, fixed.section, result.noise_scale, how)
            moved = replace(result, arc_m=np.clip(result.arc_m + movement, 0.0, case.trajectory.arc_m[-1]))
            straight, along = case.errors(moved)
            level = np.where(result.protection.level.consistent, result.protection.level.level_m, np.inf)
            level, known = level + np.abs(movement), np.isfinite(along) & np.isfinite(level)
            ratio = along / result.along_sigma_m
            sizes = np.percentile(straight[np.isfinite(straight)], (50.0, 95.0, 100.0))
            yield (
                _late_row(name, how, sizes)
                + f" {np.percentile(ratio[np.isfinite(ratio)], 68.0):15.2f}"
                + f" {np.percentile(ratio[np.isfinite(ratio)], 95.0):6.2f} {np.median(level[known]):7.1f}"
                + f" {int((along[known] > level[known]).sum()):5d}"
            )
    for how in REWEIGHTINGS:
        found = smartloc(DATA.parent, SETTINGS, None if how is None else partial(reweighted, how=how))
        assert found.straight is not None
        yield _late_row("smartLoc", how, np.array([found.straight.p50_m, found.straight.p95_m, found.straight.max_m]))


def _late_row(name: str, how: Reweighting | None, sizes: Floats) -> str:
    return f"{name:9s}{'-' if how is None else how.text:>36s} {sizes[0]:7.3f} {sizes[1]:7.3f} {sizes[2]:6.1f}"


PARTS: Final[dict[str, Callable[[], Iterator[str]]]] = {
    "faults": fault_rows,
    "maps": map_rows,
    "sigmas": sigma_rows,
    "starts": start_rows,
    "priors": prior_rows,
    "together": class_rows,
    "sides": side_rows,
    "ahead": late_ahead_rows,
    "late": late_rows,
    "ionosphere": ionosphere_rows,
    "coefficients": coefficient_rows,
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
