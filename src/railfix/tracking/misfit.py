"""How well the map's lengths fit: learnt from codes that keep asking for another place.

Phases and Dopplers give the way run on the earth. Where the map's lengths are wrong, the place on the map drifts
away from the codes, epoch by epoch in the same direction, each time by less than a code's error. The innovations of a
consistent filter are white (R. K. Mehra, On the identification of variances and adaptive Kalman filtering, 1970,
doi:10.1109/TAC.1970.1099422): a mean over many epochs that is far from zero tells of the drift, and the error of
lengths along the map is raised until it is gone.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.monitors import STEP_SIGMAS
from railfix.tracking.robust import Prior
from railfix.tracking.rows import Rows
from railfix.tracking.state import TrackState, Unknown

#: Fewer codes of an epoch do not tell a shift from clocks.
CODES: Final = 4
#: A single epoch counts with at most so many standard deviations; beyond `railfix.tracking.monitors.STEP_SIGMAS` it is
#: a step of all codes and tells nothing of the map.
CLIPPED: Final = 3.0
MOST_SIGMAS: Final = 20.0
#: Time constant of learning [s], and the largest logarithm: beyond 1.6 m in the square root of a metre nothing changes.
LEARNT_S: Final = 5.0
LARGEST: Final = 8.0


def code_shift(rows: Rows, prior: Prior, weight: Floats, best: int) -> float:
    """Shift of the place that the codes of an epoch ask for, over its standard deviation; 0 with too few codes.

    The score of the innovations against a shift: standard normal and white over epochs where the model holds.

    Parameters
    ----------
    rows : Rows
    prior : Prior
    weight : ndarray, shape (H, M)
        First weights.
    best : int
        Hypothesis.
    """
    codes = rows.codes
    if codes.stop < CODES:
        return 0.0
    design = prior.design[best, codes]
    noise = rows.variance[codes] / np.minimum(weight[best, codes], 1.0)
    spread = design @ prior.covariance[best] @ design.T
    spread[np.diag_indices_from(spread)] += noise
    along = rows.design[best, codes] @ rows.combine[best, :, Unknown.PLACE]
    solved = np.linalg.solve(spread, np.stack([rows.value[best, codes], along], axis=1))
    score, information = along @ solved
    return float(np.clip(score / np.sqrt(information), -MOST_SIGMAS, MOST_SIGMAS)) if information > 0.0 else 0.0


def learn_map(state: TrackState, shift: float, dt: float, limits: TrackingLimits) -> None:
    """Take an epoch's shift into the running mean, and raise or lower the error of the map's lengths."""
    dt = min(dt, 1.0)
    share = 1.0 - np.exp(-dt / limits.map_misfit_s)
    mean, variance = state.code_shift
    shift = 0.0 if abs(shift) > STEP_SIGMAS else float(np.clip(shift, -CLIPPED, CLIPPED))
    mean, variance = (1.0 - share) * mean + share * shift, (1.0 - share) ** 2 * variance + share**2
    state.code_shift = (float(mean), float(variance))
    beyond = abs(mean) / (np.sqrt(variance) * limits.map_misfit_sigmas)
    scale = state.map_log_scale * np.exp(-dt / limits.map_misfit_kept_s)
    if beyond > 1.0:
        scale += 2.0 * np.log(beyond) * dt / LEARNT_S
    state.map_log_scale = float(min(scale, LARGEST))
