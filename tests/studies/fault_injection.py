"""Faults of known size put into clean recorded ranges: what RAIM detects, and whom it blames.

Run ``python tests/studies/fault_injection.py`` with the recordings beside the checkout for the tables of
tests/references/results/fault-injection.txt.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Final

import numpy as np
from scipy.stats import ncx2

import paths
import recordings_truth
from railfix.core.arrays import Floats, Indices, Masks
from railfix.core.geodesy import ecef_from_geodetic
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.integrity.raim import (
    LinearModel,
    RaimLimits,
    detect,
    exclude,
    linear_model,
    noncentrality,
    reliability,
    threshold,
)
from railfix.integrity.raim.position_model import compact
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import Config, parse_config
from railfix.pipeline.results import AntennaResult
from railfix.positioning.normal_equations import position_on_line
from railfix.positioning.range_arrays import Ranges
from railfix.ranges.channels import clock_groups
from railfix.run.processor_setup import make_processor
from railfix.track.trajectory import Trajectory
from recordings_score import straight_line, trajectory_of

#: Sizes of the faults [m].
SIZES_M: Final = (2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0)
#: No screen but the mask: the ranges as recorded.
UNSCREENED: Final = parse_config({"filter": "off", "screens": ["elevation"], "elevation": {"mask_deg": 15.0}})
#: The chain with RAIM.
WITH_RAIM: Final = parse_config({"filter": "off", "screens": ["elevation", "raim"], "elevation": {"mask_deg": 15.0}})
LIMITS: Final = RaimLimits()
#: Epochs solved together.
_BLOCK: Final = 20_000


@dataclass(frozen=True)
class Recording:
    """A log under open sky and the line that its antenna is on."""

    observations: Observations
    navigation: Navigation
    trajectory: Trajectory


def esbc(data: Path) -> Recording:
    """24 h, every 5 minutes, on a line to the north-east."""
    folder = data / "static" / "ESBC_2020177"
    observations = read_observations(folder / "ESBC00DNK_R_20201770000_01D_30S_MO.crx.gz")[::10]
    navigation = read_navigation([folder / "ESBC00DNK_R_20201770000_01D_MN.rnx.gz"])
    return Recording(observations, navigation, straight_line(observations.header.approximate_ecef_m, 45.0))


def japan(data: Path) -> Recording:
    """A car, 6 minutes at 1 Hz, every 5 s."""
    folder = next((data / "kinematic").glob("japan_mosaic*"))
    trajectory = trajectory_of(*recordings_truth.japan_truth(folder))
    observations = read_observations(folder / "SEPT265G.21O")[::5]
    return Recording(observations, read_navigation([folder / "SEPT2650.21P"]), trajectory)


def mosaic(data: Path) -> Recording:
    """The rover of two antennas on a roof, 5 minutes at 1 Hz, every 5 s, on a line to the east."""
    folder = data / "dual" / "mosaic_x2_99cm"
    latitude, longitude, height = (float(cell) for cell in (folder / "rover_position.txt").read_text().split())
    place = np.asarray(ecef_from_geodetic(latitude, longitude, height))
    observations = read_observations(folder / "rover.obs")[::5]
    return Recording(observations, read_navigation([folder / "base.nav"]), straight_line(place, 90.0))


RECORDINGS: Final[dict[str, Callable[[Path], Recording]]] = {"ESBC": esbc, "japan_mosaic": japan, "mosaic_x2": mosaic}


def run(recording: Recording, config: Config, bias_m: Floats | None = None) -> AntennaResult:
    """The pipeline on a recording, `bias_m` (shape of the codes) added to its codes."""
    observations = recording.observations
    if bias_m is not None:
        observations = replace(observations, code_m=observations.code_m + bias_m)
    processor = make_processor(config, recording.navigation, {"front": recording.trajectory})
    return processor.process({"front": observations})[0].antennas["front"]


@dataclass(frozen=True)
class Clean:
    """Ranges of T epochs by M channels as the pipeline prepared them, solved, with their noise scale.

    Of these `calm` are the epochs that pass without a fault put in: only they are clean. The scale is
    one number for the recording, the median of the pipeline's own, found from the residuals as recorded.
    """

    ranges: Ranges
    trajectory: Trajectory
    vertex: Indices
    model: LinearModel
    scale: float
    calm: Masks

    @property
    def used(self) -> Masks:
        return self.model.used

    def faulty(self, epochs: Indices, error_m: Floats) -> LinearModel:
        """Solved again at `epochs` (n,), with `error_m` (n, M) added to the codes."""
        part = self.ranges.take(epochs)
        part = replace(part, code_m=part.code_m + error_m)
        got = position_on_line(part, self.trajectory, self.vertex[epochs])
        return linear_model(part, self.trajectory, got.arc_m, section=got.section)

    def in_noise(self, generator: np.random.Generator) -> Clean:
        """The same geometry with codes that fit the line but for Gaussian noise of the weights times the scale."""
        weight = self.ranges.weight
        sigma = self.scale / np.sqrt(np.where(weight > 0, weight, np.inf))
        noise = generator.standard_normal(weight.shape) * sigma
        free = replace(self.ranges, ties=None)
        residual = solved(free, self.trajectory, self.vertex, self.scale).model.residual_m
        ranges = replace(free, code_m=free.code_m - residual + noise)
        return replace(solved(ranges, self.trajectory, self.vertex, self.scale), calm=np.ones(len(weight), dtype=bool))


def solved(ranges: Ranges, trajectory: Trajectory, vertex: Indices, scale: float) -> Clean:
    got = position_on_line(ranges, trajectory, vertex)
    model = linear_model(ranges, trajectory, got.arc_m, section=got.section)
    found = detect(model.wsse, model.residual_m, model.freedom, limits=LIMITS, scale=scale)
    return Clean(ranges, trajectory, vertex, model, scale, found.testable & ~found.detected)


def clean(recording: Recording) -> Clean:
    """What the pipeline solves, captured; epochs without a position left out."""
    result = run(recording, UNSCREENED)
    columns = result.columns
    used = result.reason[:, columns] == 0
    trajectory = recording.trajectory
    ranges = Ranges(
        sat_ecef_m=np.where(used[..., None], result.corrected.satellites.position_ecef_m, 2.6e7),
        code_m=np.where(used, result.corrected_code_m[:, columns], 0.0),
        weight=np.where(used, 1.0 / result.sigma_m[:, columns] ** 2, 0.0),
        groups=clock_groups([str(s)[0] for s in result.satellite[columns]]),
        ties=result.ties,
    )
    located = np.flatnonzero(np.isfinite(result.fix.constrained.arc_m))
    arc = result.fix.constrained.arc_m[located]
    vertex = np.argmin(np.abs(trajectory.arc_m - arc[:, None]), axis=1)
    return solved(ranges.take(located), trajectory, vertex, float(np.median(result.noise_scale[located])))


@dataclass(frozen=True)
class Count:
    """Faulty epochs, and what became of them.

    `expected` is what the non-central chi-square distribution says of `detected`. `right` are epochs
    in which just the faulty satellites were left out, `partly` those in which one of two was and no
    other; `wrong` are those in which a satellite without a fault was left out, whatever else was.
    """

    epochs: int
    detected: int
    expected: float
    right: int
    partly: int
    wrong: int

    def row(self) -> str:
        n = max(self.epochs, 1)
        shares = (self.detected, self.expected, self.right, self.partly, self.wrong)
        return f"{self.epochs:7d} " + " ".join(f"{100.0 * share / n:9.2f}" for share in shares)


def total(counts: list[Count]) -> Count:
    return Count(*(sum(getattr(c, name) for c in counts) for name in Count.__dataclass_fields__))


def fault_statistic(model: LinearModel, error_m: Floats, scale: float) -> Floats:
    """Noncentrality that errors of ranges (T, M) give the statistic: ``f^T S f``, of one ``b^2 r_ii / sigma^2``."""
    parts = compact(model)
    fault = np.take_along_axis(error_m * model.root_weight, parts.channel, axis=1) / scale
    return np.asarray(np.einsum("ti,tij,tj->t", fault, parts.projector, fault))


def power(model: LinearModel, error_m: Floats, scale: float) -> Floats:
    """Probability that the errors are detected, shape (T,)."""
    freedom = np.maximum(model.freedom, 1)
    limit = threshold(freedom, limits=LIMITS)
    return np.asarray(ncx2.sf(limit, freedom, fault_statistic(model, error_m, scale)))


def injected(case: Clean, epochs: Indices, error_m: Floats) -> tuple[Count, Masks]:
    """Count of epochs (n,) with errors (n, M), and which of them were right."""
    found: list[Count] = []
    told: list[Masks] = []
    for first in range(0, len(epochs), _BLOCK):
        at, error = epochs[first : first + _BLOCK], error_m[first : first + _BLOCK]
        got = exclude(case.faulty(at, error), limits=LIMITS, scale=case.scale)
        guilty = error != 0.0
        right = (got.excluded == guilty).all(axis=1)
        wrong = (got.excluded & ~guilty).any(axis=1)
        partly = got.excluded.any(axis=1) & ~right & ~wrong
        found.append(
            Count(
                len(at),
                int(got.detection.detected.sum()),
                float(power(case.model.take(at), error, case.scale).sum()),
                int(right.sum()),
                int(partly.sum()),
                int(wrong.sum()),
            )
        )
        told.append(right)
    return total(found), np.concatenate([np.empty(0, dtype=bool), *told])


def one_by_one(case: Clean, size_m: Floats | float, *, least_redundancy: int = 2) -> tuple[Indices, Floats]:
    """Every satellite in turn wrong by `size_m` ((T,) or a number), in every epoch that it is used in.

    Epochs need a degree of freedom for the test and another one for the rest after an exclusion.
    """
    epochs, channels = np.nonzero(case.used & (case.calm & (case.model.freedom >= least_redundancy))[:, None])
    error = np.zeros((len(epochs), case.used.shape[1]))
    error[np.arange(len(epochs)), channels] = np.broadcast_to(size_m, len(case.model))[epochs]
    return epochs, error


def two_by_two(
    case: Clean, size_m: Floats, *, every: int = 1, least_redundancy: int = 3
) -> Iterator[tuple[tuple[int, int], Indices, Floats]]:
    """Every pair in turn wrong by `size_m` (T, M), of one sign and of two by turns, in every n-th epoch."""
    chosen = case.calm & (np.arange(len(case.model)) % every == 0) & (case.model.freedom >= least_redundancy)
    for k, pair in enumerate(combinations(np.flatnonzero(case.used.any(axis=0)).tolist(), 2)):
        epochs = np.flatnonzero(chosen & case.used[:, pair].all(axis=1))
        if not len(epochs):
            continue
        error = np.zeros((len(epochs), case.used.shape[1]))
        error[:, pair[0]] = size_m[epochs, pair[0]]
        error[:, pair[1]] = size_m[epochs, pair[1]] * (1 if k % 2 else -1)
        yield pair, epochs, error


def steps(case: Clean, size_m: float) -> Count:
    """One satellite wrong by the same in all epochs."""
    return injected(case, *one_by_one(case, size_m))[0]


def ramps(case: Clean, size_m: float) -> Count:
    """One satellite, its error growing from 0 over the run to `size_m`."""
    grown = size_m * np.arange(1, len(case.model) + 1) / len(case.model)
    return injected(case, *one_by_one(case, grown))[0]


def pair_steps(case: Clean, size_m: float, *, every: int) -> Count:
    """Two satellites wrong by the same size."""
    parts = list(two_by_two(case, np.full(case.used.shape, size_m), every=every))
    epochs = np.concatenate([e for _, e, _ in parts])
    return injected(case, epochs, np.concatenate([error for _, _, error in parts]))[0]


def pair_ramps(case: Clean, size_m: float, *, every: int) -> Count:
    """Two satellites, their errors growing from 0 over the run."""
    grown = size_m * np.arange(1, len(case.model) + 1) / len(case.model)
    parts = list(two_by_two(case, np.broadcast_to(grown[:, None], case.used.shape), every=every))
    epochs = np.concatenate([e for _, e, _ in parts])
    return injected(case, epochs, np.concatenate([error for _, _, error in parts]))[0]


def left_by_others(model: LinearModel, pair: tuple[int, int], error_m: Floats, scale: float) -> tuple[Floats, Floats]:
    """Noncentrality that the faults of a pair leave when the best one, and the best other pair, is left out, (T,)."""
    parts = compact(model)
    projector = parts.projector
    fault = np.take_along_axis(error_m * model.root_weight, parts.channel, axis=1) / scale
    shown = np.einsum("tij,tj->ti", projector, fault)
    whole = np.einsum("ti,ti->t", fault, shown)
    share = np.einsum("tii->ti", projector)
    checked = parts.used & (share > 1e-9)
    singles = np.where(checked, shown**2 / np.where(checked, share, 1.0), -np.inf).max(axis=1)
    i, j = np.triu_indices(projector.shape[1], 1)
    a, b, c = share[:, i], projector[:, i, j], share[:, j]
    determinant = a * c - b**2
    regular = checked[:, i] & checked[:, j] & (determinant > 1e-9 * a * c)
    own = (parts.channel[:, i] == min(pair)) & (parts.channel[:, j] == max(pair))
    x, y = shown[:, i], shown[:, j]
    drop = (c * x**2 - 2.0 * b * x * y + a * y**2) / np.where(regular, determinant, 1.0)
    pairs = np.where(regular & ~own, drop, -np.inf).max(axis=1)
    return whole - singles, whole - pairs


@dataclass(frozen=True)
class Pairs:
    """Two faults of three times their minimal detectable bias: where theory tells them apart, and elsewhere."""

    separable: Count
    other: Count


def detectable_pairs(case: Clean, *, factor: float = 3.0, every: int = 1) -> Pairs:
    """Pairs of faults over their detectable bias.

    Separable: any other pair left out leaves a noncentrality over the separation threshold, and any
    single one more than the test misses with its stated probability (one goes before two).
    """
    bias = reliability(case.model, limits=LIMITS, scale=case.scale).minimal_detectable_bias_m
    size = factor * np.where(np.isfinite(bias), bias, 0.0)
    epochs, errors, tells = [], [], []
    for pair, at, error in two_by_two(case, size, every=every):
        model = case.model.take(at)
        after_one, after_two = left_by_others(model, pair, error, case.scale)
        told = after_two > LIMITS.separation
        told &= after_one > noncentrality(np.maximum(model.freedom - 1, 1), limits=LIMITS)
        both = np.count_nonzero(error, axis=1) == 2
        epochs.append(at[both])
        errors.append(error[both])
        tells.append(told[both])
    at, error, tell = np.concatenate(epochs), np.concatenate(errors), np.concatenate(tells)
    return Pairs(injected(case, at[tell], error[tell])[0], injected(case, at[~tell], error[~tell])[0])


HEAD: Final = "             epochs detected % theory %   right %  partly %   wrong %"


def tables(data: Path) -> Iterator[str]:
    """All tables, line by line."""
    for name, read in RECORDINGS.items():
        case = clean(read(data))
        satellites = case.used.sum(axis=1)
        yield (
            f"{name}: {len(case.model)} epochs, {satellites.min()} to {satellites.max()} satellites, "
            f"noise scale {case.scale:.2f}, {int((~case.calm).sum())} epochs fail without a fault and are left out"
        )
        every = max(1, len(case.model) // 24)
        yield HEAD
        for title, count in (("step", steps), ("ramp", ramps)):
            for size in SIZES_M:
                yield f"{title} {size:5.0f} m {count(case, size).row()}"
        for title, two in (("two st.", pair_steps), ("two ra.", pair_ramps)):
            for size in SIZES_M:
                yield f"{title}{size:4.0f} m {two(case, size, every=every).row()}"
        pairs = detectable_pairs(case, every=every)
        yield f"3 MDB apart {pairs.separable.row()}"
        yield f"3 MDB other {pairs.other.row()}"
        yield ""


def main() -> int:
    data = paths.DATA
    if not data.is_dir():
        print(f"the real recordings are not at {data}", file=sys.stderr)
        return 1
    for line in tables(data):
        print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
