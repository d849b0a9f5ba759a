"""Prediction of the state over an interval without measurements."""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.state import FRESH, OFFSETS, SATELLITES, Unknown

#: Of the clock of the codes about the median of an epoch [m].
CODE_CLOCK_SIGMA_M: Final = 1e3
#: Random walks of the sensors' scales and offset in the square root of a second. A wheel of a car wandered over 2 %
#: within half a minute at bends; an accelerometer's offset follows its temperature.
WHEEL_WALK: Final = 5e-4
FORCE_WALK_MPS2: Final = 1e-3
RADAR_WALK: Final = 2e-4
#: Least variance of a step of the place [m2], keeps matrices regular.
_LEAST_STEP_M2: Final = 1e-6


def singer_step(dt: float, sigma_mps2: float, tau_s: float) -> tuple[Floats, Floats]:
    """Transition of place, speed and acceleration, and the covariance of its noise, shapes (3, 3).

    Acceleration as a first-order Gauss-Markov process (R. A. Singer, 1970, doi:10.1109/TAES.1970.310128), the noise
    by Van Loan's integral in the limit of white jerk for short steps.
    """
    x = dt / tau_s
    once, twice = np.exp(-x), np.exp(-2.0 * x)
    step = np.array([[1.0, dt, tau_s**2 * (x - 1.0 + once)], [0.0, 1.0, tau_s * (1.0 - once)], [0.0, 0.0, once]])
    density = 2.0 * sigma_mps2**2 / tau_s
    if x < 0.1:
        noise = np.array(
            [[dt**5 / 20, dt**4 / 8, dt**3 / 6], [dt**4 / 8, dt**3 / 3, dt**2 / 2], [dt**3 / 6, dt**2 / 2, dt]]
        )
    else:
        a = tau_s**5 * (1.0 - twice + 2.0 * x + 2.0 * x**3 / 3.0 - 2.0 * x**2 - 4.0 * x * once)
        b = tau_s**4 * (twice + 1.0 - 2.0 * once + 2.0 * x * once - 2.0 * x + x**2)
        c = tau_s**3 * (1.0 - twice - 2.0 * x * once)
        d = tau_s**3 * (4.0 * once - 3.0 - twice + 2.0 * x)
        e = tau_s**2 * (twice + 1.0 - 2.0 * once)
        noise = 0.5 * np.array([[a, b, c], [b, d, e], [c, e, tau_s * (1.0 - twice)]])
    return step, density * noise


def predicted(mean: Floats, covariance: Floats, line: Line, dt: float, limits: TrackingLimits) -> tuple[Floats, Floats]:
    """Mean and covariance after an interval, shapes (H, N) and (H, N, N).

    The clone `Unknown.BEFORE` takes the place, what begins anew at an epoch gets its prior.
    """
    count, width = mean.shape
    step, noise = singer_step(dt, limits.acceleration_mps2, limits.acceleration_s)
    travel = np.abs(mean[:, Unknown.SPEED]) * dt
    move = np.broadcast_to(np.eye(width), (count, width, width)).copy()
    move[:, :3, :3] = step
    move[:, Unknown.BEFORE, :] = 0.0
    move[:, Unknown.BEFORE, Unknown.PLACE] = 1.0
    move[:, Unknown.SPEED_BEFORE, :] = 0.0
    move[:, Unknown.SPEED_BEFORE, Unknown.SPEED] = 1.0
    move[:, Unknown.PHASE_CLOCK, :] = 0.0
    move[:, Unknown.PHASE_CLOCK, Unknown.DRIFT] = dt
    for fresh in FRESH:
        move[:, fresh, fresh] = 0.0
    map_kept = np.exp(-travel / limits.map_absolute_m)
    code_kept = np.exp(-dt / limits.code_correlation_s - travel / limits.code_correlation_m)
    for unknown in (Unknown.MAP_RIGHT, Unknown.MAP_UP):
        move[:, unknown, unknown] = map_kept
    doppler_kept = np.exp(-dt / limits.doppler_correlation_s)
    move[:, Unknown.DOPPLER_SPEED, Unknown.DOPPLER_SPEED] = doppler_kept
    slow_kept = np.exp(-dt / limits.slow_code_s)
    move[:, Unknown.CODE_PLACE, Unknown.CODE_PLACE] = slow_kept
    diagonal = np.arange(SATELLITES, width)
    move[:, diagonal, diagonal] = code_kept[:, None]

    after = (move @ mean[..., None])[..., 0]
    spread = move @ covariance @ np.swapaxes(move, 1, 2)
    spread[:, :3, :3] += noise
    spread[:, Unknown.PLACE, Unknown.PLACE] += _LEAST_STEP_M2
    spread[:, Unknown.SPEED, Unknown.SPEED] += _LEAST_STEP_M2
    walk = limits.clock_walk_mps**2
    spread[:, Unknown.DRIFT, Unknown.DRIFT] += walk * dt
    spread[:, Unknown.PHASE_CLOCK, Unknown.PHASE_CLOCK] += walk * dt**3 / 3.0 + 1e-6
    spread[:, Unknown.PHASE_CLOCK, Unknown.DRIFT] += walk * dt**2 / 2.0
    spread[:, Unknown.DRIFT, Unknown.PHASE_CLOCK] += walk * dt**2 / 2.0
    spread[:, Unknown.MAP_RIGHT, Unknown.MAP_RIGHT] += line.sigma_plan_m**2 * (1.0 - map_kept**2)
    spread[:, Unknown.MAP_UP, Unknown.MAP_UP] += line.sigma_height_m**2 * (1.0 - map_kept**2)
    spread[:, Unknown.CODE_PLACE, Unknown.CODE_PLACE] += limits.slow_code_m**2 * (1.0 - slow_kept**2)
    lasting = limits.doppler_error_mps + limits.doppler_error_share * np.abs(mean[:, Unknown.SPEED])
    spread[:, Unknown.DOPPLER_SPEED, Unknown.DOPPLER_SPEED] += lasting**2 * (1.0 - doppler_kept**2)
    spread[:, Unknown.WHEEL, Unknown.WHEEL] += WHEEL_WALK**2 * dt
    spread[:, Unknown.FORCE_OFFSET, Unknown.FORCE_OFFSET] += FORCE_WALK_MPS2**2 * dt
    spread[:, Unknown.RADAR, Unknown.RADAR] += RADAR_WALK**2 * dt
    offsets = np.arange(OFFSETS, SATELLITES)
    spread[:, offsets, offsets] += limits.offset_walk_m**2 * dt
    spread[:, diagonal, diagonal] += (1.0 - code_kept**2)[:, None]
    for fresh, variance in zip(FRESH, _fresh_variances(after, spread, line, travel, limits), strict=True):
        spread[:, fresh, fresh] = variance
    return after, spread


def _fresh_variances(
    mean: Floats, covariance: Floats, line: Line, travel: Floats, limits: TrackingLimits
) -> tuple[Floats, ...]:
    """Variances of the clock of the codes and of the map's displacement to the right, up and along, (H,) each.

    The displacement's direction is also uncertain by how the line bends where the place is uncertain.
    """
    _, now = line.at(mean[:, Unknown.PLACE])
    _, before = line.at(mean[:, Unknown.BEFORE])
    bend = ((now[:, 0] - before[:, 0])[:, None, :] * now).sum(axis=-1)
    place = np.minimum(covariance[:, Unknown.PLACE, Unknown.PLACE], limits.start_sigma_m**2)
    rough = 2.0 * limits.map_roughness_m**2 * (1.0 - np.exp(-travel / limits.map_correlation_m)) + 1e-8
    return (
        np.full(len(mean), CODE_CLOCK_SIGMA_M**2),
        rough + place * bend[:, 1] ** 2,
        rough + place * bend[:, 2] ** 2,
        limits.map_scale_m**2 * travel + 1e-8,
    )
