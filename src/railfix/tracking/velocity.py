"""Velocity of the antenna without the line, by changes of the carrier phase or by Dopplers.

Least squares of velocity and clock with Student's t errors, all epochs at once, for a train that climbs at most some
per cent. Where the velocity points across the line, the place, the strand or the map is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Masks
from railfix.core.constants import EARTH_ROTATION_RATE, SPEED_OF_LIGHT
from railfix.core.geodesy import enu_axes, geodetic_from_ecef, range_with_rotation

#: Standard deviation of the vertical velocity [m/s].
_CLIMB_MPS: Final = 0.3
#: Loose prior for conditioning: standard deviations of the velocity and the clock [m/s].
_PRIOR_MPS: Final = np.array([1e3, 1e3, 1e3, 1e6])
#: Degrees of freedom of the errors, rounds of reweighting, rows beyond the unknowns that are needed, and least mean
#: weight: with less the measurements do not agree with each other.
_DEGREES: Final = 4.0
_PASSES: Final = 8
_REDUNDANT: Final = 2
_AGREEING: Final = 0.9
_TURN: Final = EARTH_ROTATION_RATE / SPEED_OF_LIGHT


@dataclass(frozen=True, kw_only=True)
class Velocity:
    """Velocities of T epochs, NaN where there is none.

    Attributes
    ----------
    velocity_mps : ndarray, shape (T, 3) [m/s]
        ECEF.
    covariance : ndarray, shape (T, 3, 3)
        By the white errors of the measurements, larger where the residuals are.
    age_s : ndarray, shape (T,) [s]
        How long before the epoch it was so: half of the interval by phases, 0 by Dopplers.
    """

    velocity_mps: Floats
    covariance: Floats
    age_s: Floats


def compute_velocity(
    near_ecef_m: Floats,
    sat_ecef_m: Floats,
    sat_velocity_mps: Floats,
    before_ecef_m: Floats,
    measured: Floats,
    has: Masks,
    variance: Floats,
    interval_s: Floats,
) -> Velocity:
    """Compute velocities by phases, and by Dopplers where phases give none.

    Parameters
    ----------
    near_ecef_m : ndarray, shape (T, 3) [m]
        Position, right to some hundred metres; NaN where there is none.
    sat_ecef_m, sat_velocity_mps, before_ecef_m : ndarray, shape (T, K, 3)
        Satellites at transmission, and those of the epoch before.
    measured, variance : ndarray, shape (3, T, K)
        Code (not used), change of the phase [m] and range rate [m/s], with the variances of their white errors.
    has : ndarray of bool, shape (3, T, K)
    interval_s : ndarray, shape (T,)
    """
    known = np.asarray(np.isfinite(near_ecef_m).all(axis=1))
    near = np.where(known[:, None], near_ecef_m, 1e6)
    receiver = near[:, None, :]
    sat = np.where(np.isfinite(sat_ecef_m), sat_ecef_m, 2.6e7)
    distance, sight = range_with_rotation(sat, receiver)
    previous, _ = range_with_rotation(np.where(has[1][..., None], before_ecef_m, 2.6e7), receiver)
    motion = np.nan_to_num(sat_velocity_mps)
    moving = (sight * motion).sum(axis=-1)
    moving += _TURN * (motion[..., 0] * receiver[..., 1] - motion[..., 1] * receiver[..., 0])
    stretch = 1.0 + moving / SPEED_OF_LIGHT
    gradient = -sight.copy()
    gradient[..., 1] += _TURN * sat[..., 0]
    gradient[..., 0] -= _TURN * sat[..., 1]
    up = enu_axes(*geodetic_from_ecef(near)[:2])[:, 2]
    dt = interval_s[:, None]
    by_phase = _solve(-sight, (measured[1] - distance + previous) / dt, variance[1] / dt**2, has[1], up)
    rate = measured[2] - moving / stretch
    by_doppler = _solve(gradient / stretch[..., None], rate, variance[2], has[2], up)
    phase = np.asarray(np.isfinite(by_phase[0][:, 0]))
    velocity = np.where(phase[:, None], by_phase[0], by_doppler[0])
    return Velocity(
        velocity_mps=np.where(known[:, None], velocity, np.nan),
        covariance=np.where(phase[:, None, None], by_phase[1], by_doppler[1]),
        age_s=np.where(phase, 0.5 * interval_s, 0.0),
    )


def _solve(gradient: Floats, value: Floats, variance: Floats, has: Masks, up: Floats) -> tuple[Floats, Floats]:
    """Velocity and its covariance by rows ``gradient . v + clock``, shapes (T, 3) and (T, 3, 3)."""
    epochs, channels = has.shape
    if not has.any():
        return np.full((epochs, 3), np.nan), np.full((epochs, 3, 3), np.nan)
    value = np.where(has, value, np.nan)
    count = has.sum(axis=1)
    some = np.asarray(count > 0)
    clock = np.zeros(epochs)
    clock[some] = np.nanmedian(value[some], axis=1)
    value = np.where(has, value - clock[:, None], 0.0)
    information = np.where(has, 1.0 / np.where(has, variance, 1.0), 0.0)
    design = np.concatenate([gradient, np.ones((epochs, channels, 1))], axis=2)
    level = np.concatenate([up, np.zeros((epochs, 1))], axis=1)
    prior = np.diag(_PRIOR_MPS**-2.0) + level[:, :, None] * level[:, None, :] / _CLIMB_MPS**2
    weight = np.ones_like(value)
    solved, covariance, square = np.zeros((epochs, 4)), prior, value
    for _ in range(_PASSES):
        scaled = np.swapaxes(design * (weight * information)[..., None], 1, 2)
        covariance = np.linalg.inv(scaled @ design + prior)
        solved = (covariance @ (scaled @ value[..., None]))[..., 0]
        square = (value - (design @ solved[..., None])[..., 0]) ** 2 * information
        weight = (_DEGREES + 1.0) / (_DEGREES + square)
    freedom = count - 3
    size = (weight * square).sum(axis=1) / np.maximum(freedom, 1)
    agreeing = np.where(has, weight, 0.0).sum(axis=1) >= _AGREEING * count
    enough = np.asarray((freedom >= _REDUNDANT) & agreeing)
    spread = covariance[:, :3, :3] * np.maximum(size, 1.0)[:, None, None]
    return np.where(enough[:, None], solved[:, :3], np.nan), np.where(enough[:, None, None], spread, np.nan)
