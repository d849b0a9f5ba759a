"""Clocks near an epoch's before its update, and what is learnt of the measurements after it."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Masks
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.robust import Update, mean_weight
from railfix.tracking.rows import Channels, Kind, Rows
from railfix.tracking.state import OFFSETS, TrackState, Unknown

#: A clock whose median innovation is beyond this many standard deviations has stepped.
_STEPPED: Final = 5.0
#: Time over which the scales of Dopplers and phases are learnt [s].
_SCALE_S: Final = 60.0
#: The scales' variances stay within these logarithms.
_SCALE_RANGE: Final = (-1.5, 3.0)
#: Standard deviation of the clock of phases and its drift after a step [m, m/s].
_UNKNOWN_CLOCK: Final = 100.0


def clocks_of_epoch(
    rows: Rows, channels: Channels, mean: Floats, covariance: Floats, known: Masks
) -> tuple[Floats, Floats, Masks]:
    """Means with clocks near this epoch's: those of the codes always, those of phases and Dopplers after a step."""
    mean, covariance, known = mean.copy(), covariance.copy(), known.copy()
    codes, phases, dopplers = rows.common
    if codes.any():
        offset = np.zeros(int(rows.column.max()) + 1, dtype=np.intp)
        offset[channels.column] = channels.offset
        group = offset[rows.column[codes]]
        value = rows.value[:, codes]
        if not known.any():
            known[group[0]] = True
            covariance[:, OFFSETS + group[0], OFFSETS + group[0]] = 1e-4
        old = known[group]
        if not old.any():
            known[group[0]] = True
            old = known[group]
        clock = np.median(value[:, old], axis=1)
        mean[:, Unknown.CODE_CLOCK] += clock
        for new in np.unique(group[~old]).tolist():
            mean[:, OFFSETS + new] += np.median(value[:, group == new], axis=1) - clock
            known[new] = True
    for mask, unknown, sigma in ((phases, Unknown.PHASE_CLOCK, 100.0), (dopplers, Unknown.DRIFT, 100.0)):
        if not mask.any():
            continue
        median = np.median(rows.value[:, mask], axis=1)
        spread = covariance[:, unknown, unknown]
        stepped = np.abs(median) > _STEPPED * np.sqrt(spread + 0.25)
        stepped |= spread > sigma**2
        if stepped.any():
            at = np.flatnonzero(stepped)
            mean[at, unknown] += median[at]
            covariance[at, unknown, :] = 0.0
            covariance[at, :, unknown] = 0.0
            covariance[at, unknown, unknown] = sigma**2
    return mean, covariance, known


def weighed(state: TrackState, rows: Rows, update: Update, best: int, dt: float, limits: TrackingLimits) -> TrackState:
    """The state with how long weights have been low, and the scales of Dopplers and phases."""
    weight = update.weight[best]
    motion = mean_weight(rows, weight, (Kind.PHASE, Kind.DOPPLER))
    code = mean_weight(rows, weight, (Kind.CODE,))
    gain = 1.0 - np.exp(-min(dt, 1.0) / _SCALE_S)
    scales = []
    for kind, old in zip((Kind.DOPPLER, Kind.PHASE), state.log_scale, strict=True):
        mask = rows.kind == kind
        if mask.sum() > 3:
            square = (update.residual[best, mask] ** 2 + update.spread[best, mask]) / rows.variance[mask]
            old = old + gain * float(np.log(np.mean(weight[mask] * square)))
        scales.append(float(np.clip(old, *_SCALE_RANGE)))
    return replace(
        state,
        weak_motion_s=state.weak_motion_s + dt if motion < limits.lost_motion_weight else 0.0,
        weak_code_s=state.weak_code_s + dt if code < limits.lost_code_weight else 0.0,
        log_scale=(scales[0], scales[1]),
    )
