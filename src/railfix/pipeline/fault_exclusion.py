"""Detect and exclude faulty satellites, then solve again."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Floats, Indices, Masks
from railfix.integrity.raim import (
    Exclusion,
    LinearModel,
    Outcome,
    constrained_model,
    detect,
    exclude,
    reliability,
    worst_channel,
)
from railfix.pipeline.config import Config
from railfix.pipeline.corrected_ranges import without
from railfix.pipeline.results import RaimResult
from railfix.pipeline.solve import Place, place_on_line, redundancy_of, solved_again
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.normal_equations import Ranges
from railfix.positioning.section_search import SearchIndex
from railfix.positioning.single_point import single_point


def fault_free(
    ranges: Ranges,
    antennas: AntennaRows,
    place: Place,
    scale: Floats,
    agreeing: Masks,
    config: Config,
) -> tuple[Ranges, Place, RaimResult]:
    """Return ranges and positions without the satellites that RAIM excludes, and its verdict on each epoch.

    Of two satellites that disagree with the rest, the rest can be the faulty ones: a pair of which the robust fit of
    the epoch keeps a range is not believed. Where a fault stays unresolved, the position is that of the ranges
    that the robust fit keeps; its status says that a check has failed.

    Parameters
    ----------
    ranges : Ranges
        T epochs by K channels.
    antennas : AntennaRows
    place : Place
        Positions from these ranges.
    scale : ndarray, shape (T,)
        Noise scale of the receiver.
    agreeing : ndarray of bool, shape (T, K)
        Ranges that the robust fit on the line keeps.
    config : Config
        Where "raim" is not among its screens nothing is tested.
    """
    limits, constrained = config.raim, place.constrained
    test = detect(constrained.wsse, constrained.residual_m, redundancy_of(ranges), limits=limits, scale=scale)
    on = "raim" in config.screens
    raim = RaimResult(
        outcome=np.where(test.testable & on, Outcome.PASSED, Outcome.UNTESTABLE).astype(np.int8),
        statistic=test.statistic,
        threshold=test.threshold,
        excluded=np.zeros(ranges.code_m.shape, dtype=bool),
        own_error_m=np.full(ranges.code_m.shape, np.nan),
        protection_level_m=np.full(len(ranges), np.nan),
    )
    for index, failing in antennas.split(np.flatnonzero(test.detected & on)):
        ranges, place, raim = _faults_excluded(ranges, index, place, raim, failing, scale, agreeing, config)
    return ranges, place, raim


def _faults_excluded(
    ranges: Ranges,
    index: SearchIndex,
    place: Place,
    raim: RaimResult,
    failing: Indices,
    scale: Floats,
    agreeing: Masks,
    config: Config,
) -> tuple[Ranges, Place, RaimResult]:
    """Return the same with the failing epochs of one antenna looked into."""
    limits, constrained = config.raim, place.constrained
    arc, section = constrained.arc_m[failing], constrained.section[failing]
    model = constrained_model(ranges.take(failing), index.trajectory, arc, section=section)
    exclusion = exclude(model, limits=limits, scale=scale[failing])
    raim = _with_exclusion(raim, failing, exclusion, np.arange(len(failing)))
    unresolved = np.flatnonzero(exclusion.outcome == Outcome.UNRESOLVED)
    if len(unresolved):
        epochs = failing[unresolved]
        second = _second_attempt(ranges, index, place, epochs, model.take(unresolved), scale, config)
        raim = _with_exclusion(raim, epochs, second, np.flatnonzero(second.excluded.any(axis=1)))
    if limits.mode == "chi_square":
        raim = _by_robust_fit(raim, ranges, agreeing, failing, limits.min_redundancy)
    changed = failing[raim.excluded[failing].any(axis=1)]
    if not len(changed):
        return ranges, place, raim
    ranges = without(ranges, raim.excluded)
    place = solved_again(ranges, index, place, changed, config)
    # Without the fault another section can fit best: the remaining ranges must be consistent there, too.
    recheck = detect(
        place.constrained.wsse[changed],
        place.constrained.residual_m[changed],
        redundancy_of(ranges)[changed],
        limits=limits,
        scale=scale[changed],
    )
    outcome = np.where(recheck.detected, Outcome.UNRESOLVED, raim.outcome[changed])
    return ranges, place, replace(raim, outcome=_put(raim.outcome, changed, outcome))


def _by_robust_fit(
    raim: RaimResult, ranges: Ranges, agreeing: Masks, failing: Indices, min_redundancy: int
) -> RaimResult:
    """Return the result with the ranges that the robust fit rejects excluded where no exclusion is believed."""
    pair = raim.outcome[failing] == Outcome.EXCLUDED_TWO
    contradicted = pair & (raim.excluded[failing] & agreeing[failing]).any(axis=1)
    unresolved = contradicted | (raim.outcome[failing] == Outcome.UNRESOLVED)
    epochs = failing[unresolved]
    if not len(epochs):
        return raim
    rejected = (ranges.weight[epochs] > 0) & ~agreeing[epochs]
    rest = without(ranges.take(epochs), rejected)
    rejected &= (redundancy_of(rest) >= min_redundancy)[:, None]
    return replace(
        raim,
        outcome=_put(raim.outcome, epochs, np.full(len(epochs), Outcome.UNRESOLVED, dtype=np.int8)),
        excluded=_put(raim.excluded, epochs, rejected),
        own_error_m=_put(raim.own_error_m, epochs, np.full(rejected.shape, np.nan)),
    )


def _put(array: NDArray[Any], rows: Indices, values: NDArray[Any]) -> NDArray[Any]:
    """Return a copy of an array with some rows replaced."""
    copy = array.copy()
    copy[rows] = values
    return copy


def _with_exclusion(raim: RaimResult, epochs: Indices, exclusion: Exclusion, rows: Indices) -> RaimResult:
    """Return the result with some rows of an exclusion of `epochs` put in."""
    at = epochs[rows]
    return replace(
        raim,
        outcome=_put(raim.outcome, at, exclusion.outcome[rows]),
        excluded=_put(raim.excluded, at, exclusion.excluded[rows]),
        own_error_m=_put(raim.own_error_m, at, exclusion.own_error_m[rows]),
    )


def _second_attempt(
    ranges: Ranges,
    index: SearchIndex,
    place: Place,
    epochs: Indices,
    model: LinearModel,
    scale: Floats,
    config: Config,
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
