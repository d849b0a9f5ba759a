"""Exclusion of persistent and single faults from the ranges of a chunk, and estimation of noise scales."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
import scipy

from railfix.core.arrays import Floats, Masks, copy_with
from railfix.core.reasons import Reason
from railfix.integrity.fault_exclusion import RaimResult, compute_statistic, exclude_faults
from railfix.integrity.persistent_biases import BiasLimits, reject_persistent_biases
from railfix.integrity.raim import LinearModel
from railfix.integrity.raim.position_model import update_model
from railfix.pipeline.config import Config
from railfix.pipeline.processor_state import AntennaState
from railfix.pipeline.range_stage import reject
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.igg3_fit import RobustFit, robust_on_line
from railfix.positioning.line_fix import LineFix
from railfix.positioning.noise_windows import Windows
from railfix.positioning.normal_equations import misfit
from railfix.positioning.range_arrays import Ranges
from railfix.positioning.receiver_noise import NoiseState, noise_scale
from railfix.ranges.corrected import CorrectedRanges

#: Epochs with residual variance / assumed variance above this do not affect the noise scale: (100 sigmas)^2.
_LARGEST_VARIANCE: Final = 1e4


class CheckedPositions(NamedTuple):
    """Positions after the exclusion of faults, T epochs."""

    fix: LineFix
    model: LinearModel  #: Linear model at the positions on the line.
    raim: RaimResult
    scale: Floats  #: Noise scale of the receiver, shape (T,).
    off_map: Masks  #: True at epochs whose ranges contradict the map, shape (T,).
    lasting: Masks  #: True for satellites with persistent errors, shape (T, K).


def check_ranges(
    corrected: CorrectedRanges,
    ranges: Ranges,
    antennas: AntennaRows,
    fix: LineFix,
    config: Config,
    states: Sequence[AntennaState],
) -> tuple[CorrectedRanges, Ranges, CheckedPositions, list[AntennaState]]:
    """Exclude persistent, then single faults; return ranges, positions with noise scales, and each antenna's new state.

    The robust noise scale, which RAIM uses, is estimated from mutually consistent ranges. The reported noise scale is
    estimated from the ranges that remain after RAIM.
    """
    time, near = corrected.time, corrected.near_ecef_m
    on, noises = "raim" in config.screens, [state.noise for state in states]
    learning, least = config.noise_scale, 1.0 if config.sbas else 0.0  # SBAS sigmas are overbounds: scale >= 1
    windows = Windows.of(
        time, antennas.parts, [(noise.time, noise.age) for noise in noises],
        window_s=learning.window_s, least_epochs=learning.least_epochs,
    )  # fmt: skip

    def robust_scale(fitted: RobustFit, usable: Masks, sums: list[Floats]) -> tuple[Floats, Floats]:
        wsse, one = fitted.variance * fitted.freedom, np.ones(len(time))
        return noise_scale(
            windows, wsse, fitted.freedom, usable, one, np.array(sums), limits=learning, least=least
        )  # fmt: skip

    def fit_on_line() -> tuple[RobustFit, Masks]:
        found = robust_on_line(ranges, antennas, fix.constrained, near_ecef_m=near, limits=config.robust_fit)
        arc = fix.constrained.arc_m
        usable = np.isfinite(arc) & ~corrected.unsure & ~(found.variance > _LARGEST_VARIANCE)
        return found, usable & ~contradict_map(ranges, antennas, fix, arc, config)

    on_line, usable = fit_on_line()
    raised, raised_sums = robust_scale(on_line, usable, [state.lasting.noise for state in states])
    limits = config.lasting_errors if on else config.lasting_errors.replaced(most_satellites=0)
    ranges, (fix, model, lasting), lasting_states = reject_persistent_biases(
        time, corrected.channels.names, ranges, antennas, fix, raised, [state.lasting for state in states],
        BiasLimits(limits, config.fix_limits),
    )  # fmt: skip
    if lasting.any():
        corrected = reject(corrected, lasting, Reason.LASTING_ERROR)
        on_line, usable = fit_on_line()
    robust, robust_sums = robust_scale(on_line, usable, [noise.robust for noise in noises])
    if on:
        ranges, fix, raim = exclude_faults(
            ranges, antennas, fix, scale=robust, agreeing=on_line.kept, model=model, limits=config.raim,
            fix_limits=config.fix_limits,
        )  # fmt: skip
        model = update_model(model, ranges, antennas, fix.constrained, np.flatnonzero(raim.excluded.any(axis=1)))
    else:
        raim = compute_statistic(ranges, fix, robust, limits=config.raim)
    off_map = contradict_map(ranges, antennas, fix, fix.constrained.arc_m, config)
    noisy = fix.constrained.wsse > _LARGEST_VARIANCE * np.maximum(ranges.redundancy, 1)
    usable = ~(off_map | raim.faulty | corrected.unsure | noisy) & on
    scale, stated_sums = noise_scale(
        windows, fix.constrained.wsse, ranges.redundancy, usable, robust,
        np.array([noise.remaining for noise in noises]), limits=learning, least=least,
    )  # fmt: skip
    after = [
        copy_with(
            state, noise=NoiseState(time=when, age=age, robust=robust_sums[k], remaining=stated_sums[k]),
            lasting=copy_with(lasting_states[k], noise=raised_sums[k]),
        )
        for k, (state, (when, age)) in enumerate(zip(states, windows.last, strict=True))
    ]  # fmt: skip
    return corrected, ranges, CheckedPositions(fix, model, raim, scale, off_map, lasting), after


@lru_cache
def _chi_square_limit(risk: float, freedom: int) -> float:
    """Return the chi-square quantile that noise exceeds with the probability `risk`."""
    return float(scipy.special.chdtri(freedom, risk))


def contradict_map(ranges: Ranges, antennas: AntennaRows, fix: LineFix, arc: Floats, config: Config) -> Masks:
    """Return the epochs whose ranges contradict the map, or indicate a position beyond an end of the map, shape (T,).

    Ranges contradict the map if the position on the line fits significantly worse than the 3-D position (chi-square
    test with `Config.off_map_risk`). The difference of the weighted sums of squares is divided by the residual variance
    of the 3-D fit, but by at least 1.
    """
    point, constrained = fix.point, fix.constrained
    wsse = constrained.wsse
    if arc is not constrained.arc_m:
        known = np.isfinite(arc)
        position = np.where(known[:, None], antennas.at_arc(arc), 0.0)
        wsse = np.where(known, misfit(ranges, position), np.nan)
    freedom = ranges.space_redundancy
    shown = np.maximum(1.0, point.wsse / np.maximum(freedom, 1))
    lost = (freedom >= 1) & ((wsse - point.wsse) / shown > _chi_square_limit(config.off_map_risk, 2))
    beyond = constrained.overshoot_m > np.maximum(4.0 * constrained.sigma_m, antennas.sigma_plan_m)
    return np.asarray(lost | beyond)
