"""Transition of the unknowns over an interval: the motion's for the recursion, that of all of them for the smoother."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from railfix.core.arrays import Floats
from railfix.motion.singer import singer_steps
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.state import FRESH, SATELLITES, StateIndex


def singer_step(dt: float, sigma_mps2: float, tau_s: float) -> tuple[Floats, Floats]:
    """`railfix.motion.singer.singer_steps` of one interval, shapes (3, 3)."""
    step, noise = singer_steps(np.array([dt]), sigma_mps2, tau_s)
    return step[0], noise[0]


singer = lru_cache(maxsize=64)(singer_step)


def _keep(mean: Floats, dt: float, limits: TrackingLimits) -> Floats:
    """Share of each unknown that is left after an interval, shape (H, N)."""
    travel = np.abs(mean[:, StateIndex.SPEED]) * dt
    kept = np.ones(mean.shape)
    kept[:, FRESH] = 0.0
    kept[:, StateIndex.MAP_RIGHT] = kept[:, StateIndex.MAP_UP] = np.exp(-travel / limits.map_absolute_m)
    kept[:, StateIndex.DOPPLER_SPEED] = np.exp(-dt / limits.doppler_correlation_s)
    kept[:, StateIndex.CODE_PLACE] = np.exp(-dt / limits.slow_code_s)
    kept[:, SATELLITES:] = np.exp(-dt / limits.code_correlation_s - travel / limits.code_correlation_m)[:, None]
    return kept


def transition(mean: Floats, dt: float, limits: TrackingLimits) -> Floats:
    """Transition of all unknowns over an interval from a state, shape (N, N); `mean` has shape (N,)."""
    step, _ = singer(dt, limits.acceleration_mps2, limits.acceleration_s)
    return np.asarray(_move(np.eye(len(mean))[None], _keep(mean[None], dt, limits), step, dt)[0])


def _move(rows: Floats, kept: Floats, step: Floats, dt: float) -> Floats:
    """The transition times a matrix, shape (H, N, ...)."""
    moved = rows * kept[:, :, None]
    moved[:, :3] = step @ rows[:, :3]
    moved[:, StateIndex.PREVIOUS_ARC] = rows[:, StateIndex.ARC]
    moved[:, StateIndex.PREVIOUS_SPEED] = rows[:, StateIndex.SPEED]
    moved[:, StateIndex.PHASE_CLOCK] = dt * rows[:, StateIndex.DRIFT]
    return moved
