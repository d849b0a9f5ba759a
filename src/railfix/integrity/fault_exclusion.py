"""Receiver autonomous integrity monitoring (RAIM): exclude faulty satellites and solve again (P1 2.3(4), P4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Codes, Floats, Indices, Integers, Masks
from railfix.core.notebook import NotebookTable
from railfix.integrity.raim import (
    Detection,
    Exclusion,
    LinearModel,
    Outcome,
    RaimLimits,
    detect,
    exclude,
    linear_model,
    worst_channel,
)
from railfix.positioning.antenna_rows import AntennaRows, Line
from railfix.positioning.igg3_fit import robust_on_line
from railfix.positioning.line_fix import FixLimits, LineFix, fix_on_line, refit_epochs
from railfix.positioning.normal_equations import point_position
from railfix.positioning.range_arrays import Ranges, without
from railfix.positioning.search_index import SearchIndex


@dataclass(frozen=True, kw_only=True, repr=False)
class RaimResult(NotebookTable):
    """Result of fault detection and exclusion at T epochs."""

    outcome: Codes  #: `raim.Outcome`, shape (T,).
    #: Test statistic before any exclusion, shape (T,), in units of the noise variance or, in mode "fixed", in m^2.
    statistic: Floats
    threshold: Floats  #: Threshold of the statistic, shape (T,); NaN where the epoch cannot be tested.
    scale: Floats  #: Noise scale used in the test of the residuals, shape (T,).
    excluded: Masks  #: True for excluded channels, shape (T, K).
    own_error_m: Floats  #: Range error of the faulty channels, shape (T, K); NaN for other channels.
    #: Position protection level from the remaining ranges (`raim.reliability`), shape (T,); infinite where a fault of
    #: one range is undetectable. NaN without a position, with a remaining fault, or if RAIM or this level is off.
    protection_level_m: Floats

    @property
    def faulty(self) -> Masks:
        """True for epochs whose position still contains a detected fault, shape (T,)."""
        return np.asarray((self.outcome == int(Outcome.INSEPARABLE)) | (self.outcome == int(Outcome.UNRESOLVED)))


def compute_statistic(
    ranges: Ranges, fix: LineFix, scale: ArrayLike = 1.0, *, limits: RaimLimits | None = None
) -> RaimResult:
    """Return the statistic of the residuals and its threshold (P4); they are not compared (outcome UNTESTABLE)."""
    return _untested(_detect(fix, ranges.redundancy, scale, limits or RaimLimits()), ranges.weight.shape, scale)


def _untested(found: Detection, shape: tuple[int, ...], scale: ArrayLike) -> RaimResult:
    """Return a result without exclusions, in which every outcome is UNTESTABLE."""
    return RaimResult(
        outcome=np.full(shape[0], int(Outcome.UNTESTABLE), dtype=np.int8), statistic=found.statistic,
        threshold=found.threshold, scale=np.broadcast_to(np.asarray(scale, dtype=np.float64), shape[:1]),
        excluded=np.zeros(shape, dtype=bool), own_error_m=np.full(shape, np.nan),
        protection_level_m=np.full(shape[0], np.nan),
    )  # fmt: skip


def _detect(fix: LineFix, redundancy: Integers, scale: ArrayLike, limits: RaimLimits) -> Detection:
    return detect(fix.constrained.wsse, fix.constrained.residual_m, redundancy, limits=limits, scale=scale)


def exclude_faults(
    ranges: Ranges,
    line: Line,
    fix: LineFix,
    *,
    scale: ArrayLike = 1.0,
    agreeing: Masks | None = None,
    model: LinearModel | None = None,
    limits: RaimLimits | None = None,
    fix_limits: FixLimits | None = None,
) -> tuple[Ranges, LineFix, RaimResult]:
    """Exclude faulty satellites at each epoch; return the remaining ranges, new positions and test results.

    The sum of squared residuals is compared with a chi-square threshold (P4, false-alarm probability 1e-3), or with 100
    m^2 (P1 table 6, mode "fixed"). Every satellite and then every pair is left out in turn (P1 2.3(4), see `exclude`).
    In chi-square mode, a robust fit must confirm the exclusion. If the robust fit keeps a range of a pair, the pair is
    not excluded: other satellites may be faulty. Where the fault remains unresolved, `RaimResult.faulty` is True, and
    the position is computed from the ranges kept by the robust fit.

    Parameters
    ----------
    ranges : Ranges
        Returned by `weighted_ranges`.
    line : Trajectory, SearchIndex or AntennaRows
    fix : LineFix
        Positions computed from these ranges (`fix_on_line`).
    scale : array_like, shape (T,) or ()
        Ratio of the receiver's range standard deviation to the standard deviation assumed in the weights
        (`noise_scale`). Raise ValueError if it is neither positive nor NaN.
    agreeing : ndarray of bool, shape (T, M), optional
        Ranges kept by a robust fit on the line (`robust_fit`), by default computed by this function.
    model : LinearModel, optional
        Linear model of the positions (`linear_model`), by default computed by this function.
    limits, fix_limits : RaimLimits, FixLimits, optional
    """
    antennas, limits, fix_limits = AntennaRows.on(line), limits or RaimLimits(), fix_limits or FixLimits()
    scale = np.broadcast_to(np.asarray(scale, dtype=np.float64), (len(ranges),))
    if not (scale > 0.0).all(where=np.isfinite(scale)):
        raise ValueError("scale must be positive: standard deviation of the ranges divided by the sigma of the weights")
    test = _detect(fix, ranges.redundancy, scale, limits)
    raim = _untested(test, ranges.weight.shape, scale)
    raim.outcome[test.testable] = Outcome.PASSED
    failing = test.detected.nonzero()[0]
    if not len(failing):
        return ranges, fix, raim
    if model is None:
        model = linear_model(ranges, antennas, fix.constrained.arc_m, section=fix.constrained.section)
    if agreeing is None:
        agreeing = robust_on_line(ranges, antennas, fix.constrained).kept
    exclusion = exclude(model.take(failing), limits=limits, scale=scale[failing])
    _put(raim, failing, exclusion)
    for index, epochs in antennas.split(failing[exclusion.outcome == Outcome.UNRESOLVED]):
        second = _second_attempt(ranges, index, fix, epochs, model.take(epochs), scale, limits, fix_limits)
        _put(raim, epochs, second, np.flatnonzero(second.excluded.any(axis=1)))
    if limits.mode == "chi_square":
        _by_robust_fit(raim, ranges, agreeing, failing, limits.min_redundancy)
    changed = failing[raim.excluded[failing].any(axis=1)]
    if not len(changed):
        return ranges, fix, raim
    ranges = without(ranges, raim.excluded)
    fix = refit_epochs(ranges, antennas, fix, changed, fix_limits)
    # The remaining ranges may fit another section of the line best, and must pass the test there too.
    still = _detect(fix, ranges.redundancy, scale, limits).detected[changed]
    raim.outcome[changed[still]] = Outcome.UNRESOLVED
    return ranges, fix, raim


def _put(raim: RaimResult, epochs: Indices, exclusion: Exclusion, rows: Indices | slice = slice(None)) -> None:
    """Copy the rows `rows` of an exclusion into the result; `epochs` has the epoch of each row of the exclusion."""
    at = epochs[rows]
    for name in ("outcome", "excluded", "own_error_m"):
        getattr(raim, name)[at] = getattr(exclusion, name)[rows]


def _by_robust_fit(raim: RaimResult, ranges: Ranges, agreeing: Masks, failing: Indices, min_redundancy: int) -> None:
    """Exclude the ranges rejected by the robust fit if the fault is unresolved or this fit keeps a range of an excluded
    pair.

    No range is excluded where fewer than `min_redundancy` redundant ranges would remain.
    """
    pair = raim.outcome[failing] == Outcome.EXCLUDED_TWO
    contradicted = pair & (raim.excluded[failing] & agreeing[failing]).any(axis=1)
    unresolved = contradicted | (raim.outcome[failing] == Outcome.UNRESOLVED)
    epochs = failing[unresolved]
    if not len(epochs):
        return
    rejected = (ranges.weight[epochs] > 0) & ~agreeing[epochs]
    rest = without(ranges.take(epochs), rejected)
    raim.outcome[epochs], raim.own_error_m[epochs] = Outcome.UNRESOLVED, np.nan
    raim.excluded[epochs] = rejected & (rest.redundancy >= min_redundancy)[:, None]


def _second_attempt(
    ranges: Ranges,
    index: SearchIndex,
    fix: LineFix,
    epochs: Indices,
    model: LinearModel,
    scale: Floats,
    limits: RaimLimits,
    fix_limits: FixLimits,
) -> Exclusion:
    """For epochs with an unresolved fault, repeat the exclusion at the position computed without the worst channel.

    On a curve, a large fault moves the position to a part of the line with a different direction. A model linearised at
    the wrong position is not valid at the true one.
    """
    worst = np.zeros((len(epochs), ranges.code_m.shape[1]), dtype=bool)
    worst[np.arange(len(epochs)), worst_channel(model)] = True
    all_ranges = ranges.take(epochs)
    part = without(all_ranges, worst)
    point = point_position(part, fix.point.ecef_m[epochs], limits=fix_limits.single_point)
    solved = fix_on_line(part, index, point, fix_limits).constrained
    return exclude(
        linear_model(all_ranges, index, solved.arc_m, section=solved.section), limits=limits, scale=scale[epochs]
    )
