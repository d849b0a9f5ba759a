"""Test for a common time-tag error, estimated together with position and receiver clocks.

With wrong time tags, satellite positions are computed for the wrong time. The design column of the time-tag error is
therefore the negative range rate. The alternative hypotheses are faulty codes and a train that is off its map. A
time-tag error is accepted only if it explains the residuals clearly better than both alternatives.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from railfix.core.array_functions import masked_median
from railfix.core.arrays import Datetimes, Floats, Masks
from railfix.core.constants import EARTH_ROTATION_RATE, GM_GPS
from railfix.integrity.interference.range_fits import MotionInputs, clock_columns, fit_epochs, misfit_at

#: Scale of the design column of the time-tag error: order of magnitude of a satellite's range rate [m/s].
_RATE_MPS: Final = 500.0
_TAG_EPOCHS: Final = 10  #: The median time-tag error is computed from at most this number of epochs.
_TAG_LEAST: Final = 3  #: Minimum number of epochs required for the median time-tag error.
_TAG_WINDOW: Final = np.timedelta64(60, "s")  #: Epochs older than this are not used in the median time-tag error.
_STEPS: Final = 6  #: Largest number of iterations of a fit.
_SETTLED_S: Final = 0.05  #: Change of the time-tag error below which the iteration ends [s].
_SETTLED_M: Final = 100.0  #: Change of the position below which the iteration ends [m].
_ROUNDS: Final = 2  #: Number of reweighted fits per iteration.
_FITS_WELL: Final = 3.0  #: Absolute residuals up to this multiple of their median have full weight.
_SHOWN: Final = 3.0  #: Time-tag errors above this many sigmas are fitted again, constrained to the line.
_NEAR_LINE_M: Final = 20.0  #: Standard deviation of the line constraint, lateral and vertical [m].
_LEAST_FREEDOM: Final = 3  #: A time-tag error is rejected if the rows that agree with it have less redundancy.
#: Residuals below this many standard deviations agree with a fit. The cost function clips residuals at this limit.
_AGREES: Final = 5.0
#: A time-tag error is rejected if it reduces the cost by less. The limit exceeds the cost of one clipped residual (25),
#: because a time-tag error can absorb one faulty code.
_CLEARLY_LESS: Final = 36.0
_NORMAL_MEDIAN: Final = 0.6745  #: Median of the absolute value of a standard normal variable.
_ACROSS_AXIS: Final = np.array([1.0, 1.0, 0.0])


class TagErrors(NamedTuple):
    """Time-tag errors at single epochs and their standard deviations, shape (N,) each."""

    time: Datetimes
    error_s: Floats
    sigma_s: Floats


NO_TAGS: Final = TagErrors(np.zeros(0, dtype="datetime64[ns]"), np.zeros(0), np.zeros(0))


class _TagFit(NamedTuple):
    """Positions and time-tag errors fitted at T epochs."""

    error_s: Floats  # (T,), positive for late tags
    sigma_s: Floats  # (T,)
    place_ecef_m: Floats  # (T, 3)
    residual: Floats  # (T, K + 2), absolute, normalised; the last two columns are of the line constraint


def fit_time_tags(inputs: MotionInputs) -> tuple[Floats, Floats]:
    """Return the common time-tag error, positive for late time tags, and its standard deviation, shape (T,) [s].

    The fit includes satellites that were rejected as faulty, because a time-tag error makes satellites appear faulty.
    If the error is significant or the position doubtful, the fit is repeated with the line as a constraint and compared
    with a fit that has no time-tag error and leaves out rejected satellites. If the time-tag error does not explain the
    residuals clearly better, its standard deviation is infinite. Both values are NaN where undetermined.
    """
    near, every = inputs.near_ecef_m, inputs.used | inputs.named
    error, sigma, place, _ = _fit(inputs, every, np.zeros(len(near)), near, tags=True, line=False)
    shown = np.flatnonzero(np.isfinite(error) & (inputs.doubted | (np.abs(error) > _SHOWN * sigma)))
    if len(shown):
        part = inputs.take(shown)
        found = _fit(part, every[shown], error[shown], place[shown], tags=True, line=True)
        other = _fit(part, part.used, np.zeros(len(shown)), near[shown], tags=False, line=True)
        error[shown] = found.error_s
        sigma[shown] = np.where(_explains_more(part, found.residual, other.residual), found.sigma_s, np.inf)
    return error, sigma


def _explains_more(inputs: MotionInputs, with_error: Floats, without: Floats) -> Masks:
    """Return True where a time-tag error explains the residuals clearly better than faulty codes, shape (T,)."""
    every = inputs.used | inputs.named
    rows, clocks = _with_line(every, True), (clock_columns(inputs) * every[..., None]).any(axis=1).sum(axis=1)
    # without redundancy, the accepted ranges fit exactly, and the rejected ranges count as faulty
    without = np.where(np.isnan(without), np.where(_with_line(inputs.named, False), np.inf, 0.0), without)
    # noise scale of the fit with a time-tag error, limited to the range from 1 to the receiver's noise scale
    noise = np.maximum(np.minimum(masked_median(with_error, rows) / _NORMAL_MEDIAN, inputs.noise_scale), 1.0)[:, None]
    before, after = (np.minimum(np.where(rows, each / noise, 0.0), _AGREES) ** 2 for each in (without, with_error))
    freedom = (rows & (after < _AGREES**2)).sum(axis=1) - 4 - clocks
    return np.asarray((freedom >= _LEAST_FREEDOM) & ((before - after).sum(axis=1) > _CLEARLY_LESS))


def _fit(
    inputs: MotionInputs, counted: Masks, late_s: Floats, place_ecef_m: Floats, *, tags: bool, line: bool
) -> _TagFit:
    """Fit positions to the codes in `counted` (T, K), optionally with a time-tag error and a line constraint."""
    rows, late, place = np.arange(len(late_s)), late_s.copy(), place_ecef_m.copy()
    sigma, residual = np.full(len(rows), np.nan), np.full((len(rows), counted.shape[1] + 2), np.nan)
    for _ in range(_STEPS):
        moved = _move_satellites(inputs.take(rows), late[rows])._replace(near_ecef_m=place[rows])
        near, sight, misfit = misfit_at(moved)
        clocks = clock_columns(moved)
        rate = -(sight * moved.sat_velocity_mps).sum(axis=2, keepdims=True) / _RATE_MPS
        columns = -sight, rate * tags, np.broadcast_to(clocks, (len(near), *clocks.shape))
        point, axes = moved.nearest_on_lines() if line else (near, np.zeros((len(near), 2, 3)))
        of_line = np.concatenate([axes, np.zeros((len(near), 2, 1 + clocks.shape[1]))], axis=2)
        step, of_error, left = _fit_robustly(
            np.concatenate([np.concatenate(columns, axis=2), of_line], axis=1),
            np.concatenate([misfit, np.einsum("tij,tj->ti", axes, point - near)], axis=1),
            np.concatenate([1.0 / moved.sigma_m**2, np.full((len(near), 2), _NEAR_LINE_M**-2)], axis=1),
            _with_line(counted[rows], line),
        )  # fmt: skip
        late[rows], place[rows] = late[rows] + step[:, 3] / _RATE_MPS, near + step[:, :3]
        sigma[rows], residual[rows] = of_error / _RATE_MPS, left
        rows = rows[(np.abs(step[:, 3]) > _SETTLED_S * _RATE_MPS) | (np.linalg.norm(step[:, :3], axis=1) > _SETTLED_M)]
        if not len(rows):
            break
    return _TagFit(late, sigma, place, residual)


def _with_line(channels: Masks, line: bool) -> Masks:
    """Append two columns for the line constraint to a channel mask (T, K); return a mask of shape (T, K + 2)."""
    return np.concatenate([channels, np.full((len(channels), 2), line)], axis=1)


def _fit_robustly(design: Floats, value: Floats, weight: Floats, counted: Masks) -> tuple[Floats, Floats, Floats]:
    """Return solutions, standard deviations of the time-tag error, and absolute normalised residuals.

    Only `counted` rows are fitted, and large residuals have lower weights. Residuals are returned for all rows.
    """
    now = full = np.where(counted, weight, 0.0)
    for _ in range(_ROUNDS):
        step, covariance, scale = fit_epochs(design, value, now, least=0)
        left = np.abs(value - (design @ step[..., None])[..., 0]) * np.sqrt(weight)
        typical = masked_median(left, full > 0)[:, None]
        now = full / np.maximum(left / np.maximum(_FITS_WELL * typical, 1.0), 1.0) ** 2
    return step, np.maximum(scale, 1.0) * np.sqrt(covariance[:, 3, 3]), left


def _move_satellites(inputs: MotionInputs, late_s: Floats) -> MotionInputs:
    """Return the inputs with satellite positions and velocities moved back in time by `late_s`, shape (T,)."""
    place, velocity, before = inputs.sat_ecef_m, inputs.sat_velocity_mps, -late_s[:, None, None]
    gravity = -GM_GPS / np.linalg.norm(place, axis=2, keepdims=True) ** 3 + EARTH_ROTATION_RATE**2 * _ACROSS_AXIS
    coriolis = 2.0 * EARTH_ROTATION_RATE * np.stack([velocity[..., 1], -velocity[..., 0], 0.0 * velocity[..., 0]], 2)
    acceleration = gravity * place + coriolis
    return inputs._replace(
        sat_ecef_m=place + velocity * before + 0.5 * acceleration * before**2,
        sat_velocity_mps=velocity + acceleration * before,
    )


def median_tag_error(now: TagErrors, before: TagErrors) -> tuple[Floats, Floats, TagErrors]:
    """Return the median time-tag error, its absolute value in standard deviations, and the errors of the last epochs.

    The standard deviation is the larger of the median of the single epochs' standard deviations and the robust spread
    of the time-tag errors. The median is NaN for fewer than `_TAG_LEAST` epochs.
    """
    tags = TagErrors._make(np.concatenate([a, b]) for a, b in zip(before, now, strict=True))
    lead = TagErrors(np.full(_TAG_EPOCHS - 1, np.datetime64("NaT", "ns")), *np.full((2, _TAG_EPOCHS - 1), np.nan))
    time, error, sigma = (
        np.lib.stride_tricks.sliding_window_view(np.concatenate([a, b]), _TAG_EPOCHS)[len(before.time) :]
        for a, b in zip(lead, tags, strict=True)
    )
    known = (now.time[:, None] - time <= _TAG_WINDOW) & np.isfinite(error)
    known &= known.sum(axis=1, keepdims=True) >= _TAG_LEAST
    median = masked_median(error, known)
    spread = 1.4826 * masked_median(np.abs(error - median[:, None]), known)
    typical = masked_median(sigma, known)
    return (
        median,
        np.abs(median) / np.maximum(typical, spread),
        TagErrors._make(each[1 - _TAG_EPOCHS :] for each in tags),
    )
