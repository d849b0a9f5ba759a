"""Positions of one antenna: section search, constrained fix, exclusion of faults, conventional position.

The checks of the conventional position are those of single-point programs (RTKLIB: `valsol` of pntpos.c). A position
that fails one keeps its coordinates. Satellites whose codes are wrong for a minute are found by the mean of their
clipped residuals over it: RAIM looks at single epochs, which an error of twice the noise passes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import lru_cache
from typing import Final

import numpy as np

from railfix import kernels
from railfix.core.arrays import Codes, Floats, Indices, Integers, Masks, copy_with, kernel_array, patch_rows
from railfix.core.channel_state import join_channels
from railfix.integrity.raim import (
    Exclusion,
    LinearModel,
    Outcome,
    RaimLimits,
    constrained_model,
    detect,
    exclude,
    reliability,
    worst_channel,
)
from railfix.integrity.raim.model import model_on_line
from railfix.pipeline.config import Config
from railfix.pipeline.corrected_ranges import CorrectedRanges, without
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.noise_scale import LastingErrorState
from railfix.positioning.normal_equations import (
    Constrained,
    Ranges,
    SinglePoint,
    SinglePointLimits,
    constrained_on_lines,
    single_point,
)
from railfix.positioning.section_search import SearchIndex, Section, search_lines
from railfix.positioning.windows import Windows


@dataclass(frozen=True, kw_only=True)
class RaimResult:
    """Detection and exclusion of T epochs."""

    outcome: Codes  #: `raim.Outcome`, shape (T,).
    #: Before any exclusion; in noise variances, or in m^2 with the fixed limit; shape (T,).
    statistic: Floats
    threshold: Floats
    excluded: Masks  #: Shape (T, K).
    own_error_m: Floats  #: Error of the channels named as faulty against all others; NaN elsewhere; shape (T, K).
    #: `raim.reliability` of the remaining ranges; infinite where a fault of one of them cannot be detected, NaN where
    #: there is no position, where a fault is left in it, or where the level or RAIM is off; shape (T,).
    protection_level_m: Floats

    @property
    def faulty(self) -> Masks:
        """Epochs with a fault left in the position, shape (T,)."""
        return np.asarray((self.outcome == int(Outcome.INSEPARABLE)) | (self.outcome == int(Outcome.UNRESOLVED)))


@dataclass(frozen=True, kw_only=True)
class Place:
    """Positions of one antenna from one set of ranges, T epochs."""

    point: SinglePoint  #: 3-D position without the map.
    section: Section  #: Best-fitting vertex of the trajectory.
    constrained: Constrained  #: Position on the line.


def place_on_line(ranges: Ranges, index: SearchIndex, point: SinglePoint, config: Config) -> Place:
    """Return section and position on the line of the epochs that have `Config.min_satellites`."""
    return place_on_lines(ranges, AntennaRows.of(index), point, config)


def place_on_lines(ranges: Ranges, antennas: AntennaRows, point: SinglePoint, config: Config) -> Place:
    """Return the same of the epochs of several antennas."""
    lines = [(index.trajectory, rows) for index, rows in zip(antennas.indices, antennas.parts, strict=True)]
    section = search_lines(ranges, zip(antennas.indices, antennas.parts, strict=True), point, limits=config.section)
    vertex = np.where(ranges.n_used >= config.min_satellites, section.vertex, -1)
    constrained = constrained_on_lines(ranges, lines, vertex, limits=config.constrained)
    return Place(point=point, section=section, constrained=constrained)


def solve_again(ranges: Ranges, index: SearchIndex, place: Place, epochs: Indices, config: Config) -> Place:
    """Solve some epochs of one antenna again, from other ranges; return the positions of all."""
    part = ranges.take(epochs)
    point = single_point(part, place.point.ecef_m[epochs], limits=config.single_point)
    solved = place_on_line(part, index, point, config)
    return Place(
        point=patch_rows(place.point, epochs, solved.point),
        section=patch_rows(place.section, epochs, solved.section),
        constrained=patch_rows(place.constrained, epochs, solved.constrained),
    )


def line_model(ranges: Ranges, antennas: AntennaRows, constrained: Constrained) -> LinearModel:
    """Return the model of positions on the line (`constrained_model`); NaN in the epochs without one."""
    section = np.maximum(constrained.section, 0)
    place = antennas.at_arc(constrained.arc_m)
    return model_on_line(ranges, place, antennas.get_axes(section), antennas.sigma_plan_m, antennas.sigma_height_m)


def model_again(
    model: LinearModel, ranges: Ranges, antennas: AntennaRows, constrained: Constrained, epochs: Indices
) -> LinearModel:
    """Return the model with that of some rising epochs made again, from other ranges and places."""
    for index, own in antennas.split(epochs):
        arc, section = constrained.arc_m[own], np.maximum(constrained.section[own], 0)
        model = model.patch(own, constrained_model(ranges.take(own), index.trajectory, arc, section=section))
    return model


def count_redundancy(ranges: Ranges) -> Integers:
    """Return the number of ranges beyond the clocks and the distance along the line, shape (T,)."""
    return np.asarray(ranges.n_used - ranges.n_clocks - 1, dtype=np.int64)


class PointStatus(IntEnum):
    """Result of the validation of a conventional position."""

    #: Both checks passed; residuals without a redundant range pass.
    VALID = 0
    #: There is no position.
    NO_POSITION = 1
    #: The residuals exceed what noise explains.
    RESIDUALS = 2
    #: The dilution of precision is over its limit.
    DILUTION = 3


@lru_cache
def _of_residuals(limits: SinglePointLimits) -> RaimLimits:
    return RaimLimits(false_alarm=limits.false_alarm)


def validate_point(point: SinglePoint, ranges: Ranges, noise_scale: Floats, *, limits: SinglePointLimits) -> Codes:
    """Return the `PointStatus` of each position, every constellation with a clock of its own, shape (T,).

    `noise_scale`: standard deviation of this receiver's ranges over the sigmas of the weights, shape (T,).
    """
    test = detect(
        point.wsse, point.residual_m, ranges.n_used - ranges.n_clocks - 3, scale=noise_scale,
        limits=_of_residuals(limits),
    )  # fmt: skip
    located = np.asarray(np.isfinite(point.ecef_m).all(axis=1))
    over = ~(position_dilution(ranges, point.ecef_m) <= limits.dilution_limit)
    status = np.where(over, int(PointStatus.DILUTION), int(PointStatus.VALID))
    status = np.where(test.detected, int(PointStatus.RESIDUALS), status)
    return np.where(located, status, int(PointStatus.NO_POSITION)).astype(np.int8)


def position_dilution(ranges: Ranges, ecef_m: Floats) -> Floats:
    """Return the position dilution of precision, every constellation with a clock of its own, shape (T,).

    Root of the trace of the position's covariance for ranges of unit sigma; NaN where the geometry is singular.
    """
    return kernels.ranges.dilutions(ranges.arrays, kernel_array(ecef_m))


def fault_free(
    ranges: Ranges,
    antennas: AntennaRows,
    place: Place,
    model: LinearModel,
    scale: Floats,
    agreeing: Masks,
    config: Config,
) -> tuple[Ranges, Place, RaimResult]:
    """Return ranges and positions without the satellites that RAIM excludes, and its verdict on each epoch.

    Of two satellites that disagree with the rest, the rest can be the faulty ones: a pair of which the robust fit of
    the epoch keeps a range (`agreeing`, shape (T, K)) is not believed. Where a fault stays unresolved, the position is
    that of the ranges that the robust fit keeps; its status says that a check has failed. `model` is that of the
    positions; `scale`: noise scale of the receiver, shape (T,). Without "raim" among the screens nothing is tested.
    """
    limits, constrained = config.raim, place.constrained
    test = detect(constrained.wsse, constrained.residual_m, count_redundancy(ranges), limits=limits, scale=scale)
    on = "raim" in config.screens
    raim = RaimResult(
        outcome=np.where(test.testable & on, int(Outcome.PASSED), int(Outcome.UNTESTABLE)).astype(np.int8),
        statistic=test.statistic, threshold=test.threshold, excluded=np.zeros(ranges.code_m.shape, dtype=bool),
        own_error_m=np.full(ranges.code_m.shape, np.nan), protection_level_m=np.full(len(ranges), np.nan),
    )  # fmt: skip
    failing = (test.detected & on).nonzero()[0]
    if not len(failing):
        return ranges, place, raim
    exclusion = exclude(model.take(failing), limits=limits, scale=scale[failing])
    _put(raim, failing, exclusion)
    for index, epochs in antennas.split(failing[exclusion.outcome == Outcome.UNRESOLVED]):
        second = _second_attempt(ranges, index, place, epochs, model.take(epochs), scale, config)
        _put(raim, epochs, second, np.flatnonzero(second.excluded.any(axis=1)))
    if limits.mode == "chi_square":
        _by_robust_fit(raim, ranges, agreeing, failing, limits.min_redundancy)
    changed = failing[raim.excluded[failing].any(axis=1)]
    if not len(changed):
        return ranges, place, raim
    ranges = without(ranges, raim.excluded)
    for index, epochs in antennas.split(changed):
        place = solve_again(ranges, index, place, epochs, config)
    # Without the fault another section can fit best: the remaining ranges must be consistent there, too.
    recheck = detect(
        place.constrained.wsse[changed], place.constrained.residual_m[changed], count_redundancy(ranges)[changed],
        limits=limits, scale=scale[changed],
    )  # fmt: skip
    raim.outcome[changed[recheck.detected]] = Outcome.UNRESOLVED
    return ranges, place, raim


def _put(raim: RaimResult, epochs: Indices, exclusion: Exclusion, rows: Indices | slice = slice(None)) -> None:
    """Write some rows of an exclusion of `epochs` into a result."""
    at = epochs[rows]
    for name in ("outcome", "excluded", "own_error_m"):
        getattr(raim, name)[at] = getattr(exclusion, name)[rows]


def _by_robust_fit(raim: RaimResult, ranges: Ranges, agreeing: Masks, failing: Indices, min_redundancy: int) -> None:
    """Exclude the ranges that the robust fit rejects where no exclusion is believed."""
    pair = raim.outcome[failing] == Outcome.EXCLUDED_TWO
    contradicted = pair & (raim.excluded[failing] & agreeing[failing]).any(axis=1)
    unresolved = contradicted | (raim.outcome[failing] == Outcome.UNRESOLVED)
    epochs = failing[unresolved]
    if not len(epochs):
        return
    rejected = (ranges.weight[epochs] > 0) & ~agreeing[epochs]
    rest = without(ranges.take(epochs), rejected)
    raim.outcome[epochs], raim.own_error_m[epochs] = Outcome.UNRESOLVED, np.nan
    raim.excluded[epochs] = rejected & (count_redundancy(rest) >= min_redundancy)[:, None]


def _second_attempt(
    ranges: Ranges, index: SearchIndex, place: Place, epochs: Indices, model: LinearModel, scale: Floats, config: Config
) -> Exclusion:
    """Return the exclusion of unresolved epochs, linearised at their position without the worst satellite.

    A large fault on a curve moves the position to a part of the line with another direction, where the
    linear model does not hold for the true position.
    """
    worst = np.zeros((len(epochs), ranges.code_m.shape[1]), dtype=bool)
    worst[np.arange(len(epochs)), worst_channel(model)] = True
    all_ranges = ranges.take(epochs)
    part = without(all_ranges, worst)
    point = single_point(part, place.point.ecef_m[epochs], limits=config.single_point)
    solved = place_on_line(part, index, point, config).constrained
    there = constrained_model(all_ranges, index.trajectory, solved.arc_m, section=solved.section)
    return exclude(there, limits=config.raim, scale=scale[epochs])


def with_p4_level(raim: RaimResult, model: LinearModel, scale: Floats, config: Config) -> RaimResult:
    """Return the RAIM result with P4's protection level, where no fault is left in the position."""
    level = reliability(model, limits=config.raim, scale=scale).protection_level_m
    return replace(raim, protection_level_m=np.where(raim.faulty, np.nan, level))


#: Below this share of its own error in its residual a range shows nothing of it.
_LEAST_REDUNDANCY: Final = 0.1
#: A mean that is smaller is forgotten.
_FORGOTTEN: Final = 1e-12
#: Degrees of freedom that are left, so that the rest is still checked.
_LEAST_FREEDOM: Final = 2


def lasting_errors(
    corrected: CorrectedRanges,
    ranges: Ranges,
    antennas: AntennaRows,
    place: Place,
    noise: Floats,
    config: Config,
    states: Sequence[LastingErrorState],
) -> tuple[Ranges, Place, LinearModel, Masks, list[LastingErrorState]]:
    """Return ranges, positions and model without satellites that are wrong for long, these satellites, and the states.

    The worst satellite is left out, then the worst of the rest, whose residuals are then those without the first.
    `noise` is the noise scale of the receiver, shape (T,); satellites are of shape (T, K), states by antenna.
    """
    limits, time = config.lasting_errors, corrected.time
    channel, model = corrected.channels.names, line_model(ranges, antennas, place.constrained)
    left_out = np.zeros(ranges.code_m.shape, dtype=np.bool_)
    if "raim" not in config.screens or not limits.most_satellites:
        return ranges, place, model, left_out, list(states)
    windows = Windows.of(
        time, antennas.parts, [(state.time, state.age) for state in states],
        window_s=limits.memory_s, least_epochs=limits.memory_s,
    )  # fmt: skip
    share = np.minimum(windows.step_s, 1.0)[:, None] / limits.memory_s
    joined = join_channels(channel, [state.channel for state in states], [_is_remembered(state) for state in states])
    sums = np.zeros((limits.most_satellites, len(states), len(joined.channel)))
    for k, state in enumerate(states):
        sums[: state.sums.shape[1], k] = joined.arrange(state.sums.T, 0.0, k)
    error = _own_errors(model, noise, limits.clipped)
    for turn in range(limits.most_satellites):
        mean, sums[turn] = windows.sums(joined.widen(share * error, 0.0), sums[turn])
        mean = mean[:, : joined.present]
        worst = np.abs(np.where(ranges.weight > 0, mean, 0.0)).argmax(axis=1) if len(channel) else np.zeros(0, int)
        found = np.zeros_like(left_out)
        if len(channel):
            rows = np.arange(len(worst))
            found[rows, worst] = np.abs(mean[rows, worst]) > limits.share
            found &= ranges.weight > 0
        if not found.any():
            continue
        found &= (count_redundancy(without(ranges, found)) >= _LEAST_FREEDOM)[:, None]
        left_out |= found
        if found.any():
            ranges = without(ranges, found)
            solved = np.flatnonzero(found.any(axis=1))
            for index, epochs in antennas.split(solved):
                place = solve_again(ranges, index, place, epochs, config)
            model = model_again(model, ranges, antennas, place.constrained, solved)
            error = _own_errors(model, noise, limits.clipped)
    after_states = [
        copy_with(state, time=when, age=age, channel=joined.channel, sums=sums[:, k].T) if len(time[rows]) else state
        for k, (rows, state, (when, age)) in enumerate(zip(antennas.parts, states, windows.last, strict=True))
    ]
    return ranges, place, model, left_out, after_states


def _is_remembered(state: LastingErrorState) -> Masks:
    """Return the channels whose means are not forgotten, shape (S,)."""
    return np.asarray((np.abs(state.sums) > _FORGOTTEN).any(axis=1))


def _own_errors(model: LinearModel, noise: Floats, clipped: float) -> Floats:
    """Return the residuals over their standard deviations, clipped, over `clipped`; 0 where nothing checks a range."""
    checked = model.redundancy > _LEAST_REDUNDANCY
    own = np.where(checked, model.residual / np.sqrt(np.where(checked, model.redundancy, 1.0)), 0.0)
    own = np.where(np.isnan(own), 0.0, own) / np.maximum(noise, 1.0)[:, None]
    return np.asarray(np.minimum(np.maximum(own, -clipped), clipped) / clipped)
