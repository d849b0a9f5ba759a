"""Clocks near an epoch's before its update, and what is learnt of the measurements after it."""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.robust import Update, mean_weight, median
from railfix.tracking.rows import Rows
from railfix.tracking.state import OFFSETS, TrackState, Unknown

#: A clock whose median innovation is beyond this many standard deviations has stepped.
STEPPED: Final = 5.0
#: Time over which the scales of Dopplers and phases are learnt [s].
SCALE_S: Final = 60.0
#: The scales' variances stay within these logarithms.
SCALE_RANGE: Final = (-1.5, 3.0)
#: Shares of an interval by which the counters of doubt in motion and in codes fall at an epoch without doubt.
MOTION_LEAK: Final = 0.5
CODE_LEAK: Final = 1.0
#: Standard deviation of the clock of phases and its drift after a step [m, m/s].
UNKNOWN_CLOCK: Final = 100.0


def clocks_of_epoch(
    rows: Rows, offset: Indices, mean: Floats, covariance: Floats, known: Masks
) -> tuple[Floats, Floats, Masks]:
    """Means with clocks near this epoch's: those of the codes always, those of phases and Dopplers after a step.

    Parameters
    ----------
    rows : Rows
    offset : ndarray of int, shape (K,)
        Code clock of each channel.
    mean, covariance : ndarray, shapes (H, N), (H, N, N)
    known : ndarray of bool, shape (len(CLOCKS),)
        Clocks that have had a code.
    """
    mean = mean.copy()
    codes, phases, dopplers = rows.common
    if codes.stop:
        group = offset[rows.column[codes]]
        value = rows.value[:, codes]
        old = known[group]
        if not old.all():
            known = known.copy()
            if not known.any():
                covariance = covariance.copy()
                covariance[:, OFFSETS + group[0], OFFSETS + group[0]] = 1e-4
            if not old.any():
                known[group[0]] = True
                old = known[group]
        clock = median(value[:, old])
        mean[:, Unknown.CODE_CLOCK] += clock
        for new in np.unique(group[~old]).tolist() if not old.all() else ():
            mean[:, OFFSETS + new] += median(value[:, group == new]) - clock
            known[new] = True
    for part, unknown in ((phases, Unknown.PHASE_CLOCK), (dopplers, Unknown.DRIFT)):
        if part.stop == part.start:
            continue
        middle = median(rows.value[:, part])
        spread = covariance[:, unknown, unknown]
        stepped = np.abs(middle) > STEPPED * np.sqrt(spread + 0.25)
        stepped |= spread > UNKNOWN_CLOCK**2
        if stepped.any():
            at = np.flatnonzero(stepped)
            mean[at, unknown] += middle[at]
            covariance = covariance.copy()
            covariance[at, unknown, :] = 0.0
            covariance[at, :, unknown] = 0.0
            covariance[at, unknown, unknown] = UNKNOWN_CLOCK**2
    return mean, covariance, known


def learn(
    state: TrackState, rows: Rows, update: Update, best: int, dt: float, code_s: float, limits: TrackingLimits
) -> None:
    """Count how long mean weights of the best hypothesis have been low; learn the scales of Dopplers and phases.

    `code_s` is the time that the epoch's codes stand for.
    """
    gain = 1.0 - np.exp(-min(dt, 1.0) / SCALE_S)
    scales = []
    for part, old in zip((rows.common[2], rows.common[1]), state.log_scale, strict=True):
        if part.stop - part.start > 3:
            square = (update.residual[best, part] ** 2 + update.spread[best, part]) / rows.variance[part]
            old = old + gain * float(np.log(np.mean(update.weight[best, part] * square)))
        scales.append(min(max(old, SCALE_RANGE[0]), SCALE_RANGE[1]))
    motion = mean_weight(update.weight, rows.motion)[best]
    code = mean_weight(update.weight, rows.codes)[best]
    # Leaky counters: weights that alternate about the limit are a contradiction as well.
    weak = motion < limits.lost_motion_weight
    state.weak_motion_s = state.weak_motion_s + dt if weak else max(state.weak_motion_s - MOTION_LEAK * dt, 0.0)
    if code_s > 0.0:
        weak = code < limits.lost_code_weight
        state.weak_code_s = state.weak_code_s + code_s if weak else max(state.weak_code_s - CODE_LEAK * code_s, 0.0)
    state.log_scale = (scales[0], scales[1])
