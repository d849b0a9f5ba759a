"""Velocity of the antenna without the line, by changes of the carrier phase or by Dopplers.

Least squares of velocity and clock with Student's t errors, all epochs at once, for a train that climbs at most some
per cent. Where the velocity points across the line, the place, the strand or the map is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Masks
from railfix.core.constants import EARTH_ROTATION_RATE, SPEED_OF_LIGHT
from railfix.core.geodesy import enu_axes, geodetic_from_ecef, range_with_rotation
from railfix.motion.singer import singer_steps

_TURN: Final = EARTH_ROTATION_RATE / SPEED_OF_LIGHT


@dataclass(frozen=True, kw_only=True)
class Velocity:
    """Velocities of T epochs, NaN where there is none."""

    velocity_mps: Floats  #: ECEF; shape (T, 3).
    covariance: Floats  #: By the white errors of the measurements, larger where the residuals are; shape (T, 3, 3).
    age_s: Floats  #: How long before the epoch they hold: half of the interval by phases, 0 by Dopplers; shape (T,).


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
    dt = interval_s[:, None]
    up = enu_axes(*geodetic_from_ecef(near)[:2])[:, 2]
    velocity, covariance = _fit(-sight, (measured[1] - distance + previous) / dt, variance[1] / dt**2, has[1], up)
    phase = np.asarray(np.isfinite(velocity[:, 0]))
    other = (~phase).nonzero()[0]
    if len(other):
        sat, receiver, sight = sat[other], receiver[other], sight[other]
        motion = np.where(np.isnan(sat_velocity_mps[other]), 0.0, sat_velocity_mps[other])
        moving = (sight * motion).sum(axis=-1)
        moving += _TURN * (motion[..., 0] * receiver[..., 1] - motion[..., 1] * receiver[..., 0])
        stretch = 1.0 + moving / SPEED_OF_LIGHT
        gradient = -sight
        gradient[..., 1] += _TURN * sat[..., 0]
        gradient[..., 0] -= _TURN * sat[..., 1]
        rate = measured[2, other] - moving / stretch
        velocity[other], covariance[other] = _fit(
            gradient / stretch[..., None], rate, variance[2, other], has[2, other], up[other]
        )
    return Velocity(
        velocity_mps=np.where(known[:, None], velocity, np.nan),
        covariance=covariance,
        age_s=np.where(phase, 0.5 * interval_s, 0.0),
    )


def _fit(gradient: Floats, value: Floats, variance: Floats, has: Masks, up: Floats) -> tuple[Floats, Floats]:
    """Fit velocities to arrays in C order, so that the kernel is compiled for one kind of them."""
    from railfix.kernels.tracking.velocity import fitted_velocities

    return fitted_velocities(
        np.ascontiguousarray(gradient), np.ascontiguousarray(value), np.ascontiguousarray(variance),
        np.ascontiguousarray(has), np.ascontiguousarray(up),
    )  # fmt: skip


def singer_step(dt: float, sigma_mps2: float, tau_s: float) -> tuple[Floats, Floats]:
    """`railfix.motion.singer.singer_steps` of one interval, shapes (3, 3)."""
    step, noise = singer_steps(np.array([dt]), sigma_mps2, tau_s)
    return step[0], noise[0]


singer = lru_cache(maxsize=64)(singer_step)
