"""Prediction of the state over an interval without measurements."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.motion.singer import singer_steps
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
LEAST_STEP_M2: Final = 1e-6


def singer_step(dt: float, sigma_mps2: float, tau_s: float) -> tuple[Floats, Floats]:
    """`railfix.motion.singer.singer_steps` of one interval, shapes (3, 3)."""
    step, noise = singer_steps(np.array([dt]), sigma_mps2, tau_s)
    return step[0], noise[0]


singer = lru_cache(maxsize=64)(singer_step)


def predicted(
    mean: Floats,
    covariance: Floats,
    line: Line,
    dt: float,
    limits: TrackingLimits,
    map_scale: float,
    *,
    map_sigma_m: Floats | float = 0.0,
) -> tuple[Floats, Floats]:
    """Mean and covariance after an interval, shapes (H, N) and (H, N, N).

    The clones `Unknown.BEFORE` and `Unknown.SPEED_BEFORE` take place and speed, what begins anew at an epoch gets its
    prior. `map_scale` is the factor on `TrackingLimits.map_scale_m`; `map_sigma_m`, shape (H,), an error of the map
    beside its own.
    """
    step, noise = singer(dt, limits.acceleration_mps2, limits.acceleration_s)
    speed = np.abs(mean[:, Unknown.SPEED])
    travel = speed * dt
    kept = _kept(mean, dt, limits)
    map_kept, doppler_kept = kept[:, Unknown.MAP_RIGHT], kept[:, Unknown.DOPPLER_SPEED]
    slow_kept, code_kept = kept[:, Unknown.CODE_PLACE], kept[:, SATELLITES:]

    after = _moved(mean[..., None], kept, step, dt)[..., 0]
    spread = _moved(covariance, kept, step, dt)
    spread = _moved(np.swapaxes(spread, 1, 2), kept, step, dt)
    lasting = limits.doppler_error_mps + limits.doppler_error_share * speed
    walk = limits.clock_walk_mps**2
    added = np.zeros(mean.shape)
    added[:, Unknown.PLACE] = added[:, Unknown.SPEED] = LEAST_STEP_M2
    added[:, Unknown.DRIFT] = walk * dt
    added[:, Unknown.PHASE_CLOCK] = walk * dt**3 / 3.0 + 1e-6
    added[:, Unknown.MAP_RIGHT] = (line.sigma_plan_m**2 + map_sigma_m**2) * (1.0 - map_kept**2)
    added[:, Unknown.MAP_UP] = (line.sigma_height_m**2 + map_sigma_m**2) * (1.0 - map_kept**2)
    added[:, Unknown.CODE_PLACE] = limits.slow_code_m**2 * (1.0 - slow_kept**2)
    added[:, Unknown.DOPPLER_SPEED] = lasting**2 * (1.0 - doppler_kept**2)
    added[:, Unknown.WHEEL] = WHEEL_WALK**2 * dt
    added[:, Unknown.FORCE_OFFSET] = FORCE_WALK_MPS2**2 * dt
    added[:, Unknown.RADAR] = RADAR_WALK**2 * dt
    added[:, OFFSETS:SATELLITES] = limits.offset_walk_m**2 * dt
    added[:, SATELLITES:] = 1.0 - code_kept**2
    length = (limits.map_scale_m * map_scale) ** 2 * travel + limits.phase_walk_m**2 * dt
    place = spread[:, Unknown.PLACE, Unknown.PLACE] + noise[0, 0] + LEAST_STEP_M2
    added[:, FRESH] = _fresh_variances(after, place, length, line, travel, limits)
    added[:, Unknown.PLACE] += length
    diagonal = np.arange(mean.shape[1])
    spread[:, diagonal, diagonal] += added
    spread[:, :3, :3] += noise
    # The way on the map is the way run less the error of the length: what codes see of it, phases do not.
    spread[:, Unknown.PLACE, Unknown.STEP_ALONG] = spread[:, Unknown.STEP_ALONG, Unknown.PLACE] = -length
    spread[:, Unknown.PHASE_CLOCK, Unknown.DRIFT] += walk * dt**2 / 2.0
    spread[:, Unknown.DRIFT, Unknown.PHASE_CLOCK] += walk * dt**2 / 2.0
    return after, spread


def _kept(mean: Floats, dt: float, limits: TrackingLimits) -> Floats:
    """Share of each unknown that is left after an interval, shape (H, N)."""
    travel = np.abs(mean[:, Unknown.SPEED]) * dt
    kept = np.ones(mean.shape)
    kept[:, FRESH] = 0.0
    kept[:, Unknown.MAP_RIGHT] = kept[:, Unknown.MAP_UP] = np.exp(-travel / limits.map_absolute_m)
    kept[:, Unknown.DOPPLER_SPEED] = np.exp(-dt / limits.doppler_correlation_s)
    kept[:, Unknown.CODE_PLACE] = np.exp(-dt / limits.slow_code_s)
    kept[:, SATELLITES:] = np.exp(-dt / limits.code_correlation_s - travel / limits.code_correlation_m)[:, None]
    return kept


def transition(mean: Floats, dt: float, limits: TrackingLimits) -> Floats:
    """Transition of all unknowns over an interval from a state, shape (N, N); `mean` has shape (N,)."""
    step, _ = singer(dt, limits.acceleration_mps2, limits.acceleration_s)
    return np.asarray(_moved(np.eye(len(mean))[None], _kept(mean[None], dt, limits), step, dt)[0])


def _moved(rows: Floats, kept: Floats, step: Floats, dt: float) -> Floats:
    """The transition times a matrix, shape (H, N, ...)."""
    moved = rows * kept[:, :, None]
    moved[:, :3] = step @ rows[:, :3]
    moved[:, Unknown.BEFORE] = rows[:, Unknown.PLACE]
    moved[:, Unknown.SPEED_BEFORE] = rows[:, Unknown.SPEED]
    moved[:, Unknown.PHASE_CLOCK] = dt * rows[:, Unknown.DRIFT]
    return moved


def _fresh_variances(
    mean: Floats, variance: Floats, length: Floats, line: Line, travel: Floats, limits: TrackingLimits
) -> Floats:
    """Variances of the clock of the codes and of the map's displacement to the right, up and along, shape (H, 4).

    The displacement's direction is also uncertain by how the line bends where the place is uncertain, with its
    `variance`; `length` is the variance of the length run.
    """
    count = len(mean)
    _, axes = line.at(np.concatenate([mean[:, Unknown.PLACE], mean[:, Unknown.BEFORE]]))
    bend = ((axes[:count, 0] - axes[count:, 0])[:, None, :] * axes[:count]).sum(axis=-1)
    place = np.minimum(variance, limits.start_sigma_m**2)
    rough = 2.0 * limits.map_roughness_m**2 * (1.0 - np.exp(-travel / limits.map_correlation_m)) + 1e-8
    fresh = np.empty((count, 4))
    fresh[:, 0] = CODE_CLOCK_SIGMA_M**2
    fresh[:, 1:3] = rough[:, None] + place[:, None] * bend[:, 1:] ** 2
    fresh[:, 3] = length + 1e-8
    return fresh
