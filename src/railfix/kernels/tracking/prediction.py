"""Prediction of the unknowns from one epoch to the next, and speeds that a train can have after those measured so far.

Reflections off one wall can agree with each other on a speed and a place that are wrong; with few satellites in view
the measurements do not show it. The speed does: no train goes from 11 m/s to rest in a second.
The prediction's own standard deviation does not, as it grows with every epoch without redundancy.
"""

from __future__ import annotations

import math

from railfix.core.arrays import Floats
from railfix.kernels.compiling import borrowing
from railfix.kernels.tracking.constants import (
    CODE_CLOCK_SIGMA_M,
    FORCE_WALK_MPS2,
    HEIGHT_ROUGHNESS,
    LEAST_STEP_M2,
    RADAR_WALK,
    SPEED_SIGMAS,
    WHEEL_WALK,
)
from railfix.kernels.tracking.layout import (
    ARC,
    CODE_CLOCK,
    CODE_PLACE,
    DOPPLER_SPEED,
    DRIFT,
    HYPOTHESES,
    LEAST_SPEED,
    MAP_LENGTH_ERROR,
    MOST_SPEED,
    OF_EPOCH,
    PHASE_CLOCK,
    PREVIOUS_ARC,
    PREVIOUS_SPEED,
    RIGHT,
    SPEED,
    STEP_RIGHT,
    STEP_UP,
    UP,
    Inputs,
    KernelState,
    Parameters,
    Rows,
    Work,
)


@borrowing
def predict(
    inputs: Inputs,
    t: int,
    mean: Floats,
    covariance: Floats,
    map_log_variance: float,
    map_sigma_m: float,
    work: Work,
    to: int,
) -> None:
    """Predict the compact unknowns of a hypothesis to epoch `t`: row `to` of `work.mean` and `work.spread`."""
    epochs, line, parameters, active = inputs.epochs, inputs.line, inputs.parameters, inputs.active
    after, spread, rows, kept = work.mean, work.spread, work.stepped, work.faded
    dt, step, noise = epochs.interval_s[t], epochs.step[epochs.singer[t]], epochs.noise[epochs.singer[t]]
    n = len(mean)
    speed = abs(mean[SPEED])
    travel = speed * dt
    map_kept = math.exp(-travel / parameters.map_absolute_m)
    code_kept = math.exp(-dt / parameters.code_correlation_s - travel / parameters.code_correlation_m)
    doppler_kept = math.exp(-dt / parameters.doppler_correlation_s)
    slow_kept = math.exp(-dt / parameters.slow_code_s)
    for i in range(n):
        kept[i] = 1.0
    kept[RIGHT] = kept[UP] = map_kept
    kept[DOPPLER_SPEED], kept[CODE_PLACE] = doppler_kept, slow_kept
    for i in active.satellite:
        if i >= 0:
            kept[i] = code_kept
    for i in range(3, n):
        for j in range(n):
            rows[i, j] = kept[i] * covariance[i, j]
    for i in range(3):
        for j in range(n):
            rows[i, j] = step[i, 0] * covariance[0, j] + step[i, 1] * covariance[1, j] + step[i, 2] * covariance[2, j]
    for j in range(n):
        rows[n + PREVIOUS_ARC, j] = covariance[ARC, j]
        rows[n + PREVIOUS_SPEED, j] = covariance[SPEED, j]
        rows[n + PHASE_CLOCK, j] = dt * covariance[DRIFT, j]
    for i in range(n + 3):
        for j in range(3, n):
            spread[to, i, j] = kept[j] * rows[i, j]
        for j in range(3):
            spread[to, i, j] = step[j, 0] * rows[i, 0] + step[j, 1] * rows[i, 1] + step[j, 2] * rows[i, 2]
        spread[to, i, n + PREVIOUS_ARC] = rows[i, ARC]
        spread[to, i, n + PREVIOUS_SPEED] = rows[i, SPEED]
        spread[to, i, n + PHASE_CLOCK] = dt * rows[i, DRIFT]
        for j in range(n + 3, n + OF_EPOCH):
            spread[to, i, j] = 0.0
            spread[to, j, i] = 0.0
    for i in range(n + 3, n + OF_EPOCH):
        for j in range(n + 3, n + OF_EPOCH):
            spread[to, i, j] = 0.0
    for i in range(3):
        for j in range(3):
            spread[to, i, j] += noise[i, j]
    spread[to, ARC, ARC] += LEAST_STEP_M2
    spread[to, SPEED, SPEED] += LEAST_STEP_M2
    walk = parameters.clock_walk_mps**2
    spread[to, DRIFT, DRIFT] += walk * dt
    spread[to, n + PHASE_CLOCK, n + PHASE_CLOCK] += walk * dt**3 / 3.0 + 1e-6
    spread[to, n + PHASE_CLOCK, DRIFT] += walk * dt**2 / 2.0
    spread[to, DRIFT, n + PHASE_CLOCK] += walk * dt**2 / 2.0
    spread[to, RIGHT, RIGHT] += (line.sigma_plan_m**2 + map_sigma_m**2) * (1.0 - map_kept**2)
    spread[to, UP, UP] += (line.sigma_height_m**2 + map_sigma_m**2) * (1.0 - map_kept**2)
    spread[to, CODE_PLACE, CODE_PLACE] += parameters.slow_code_m**2 * (1.0 - slow_kept**2)
    lasting = parameters.doppler_error_mps + parameters.doppler_error_share * speed
    spread[to, DOPPLER_SPEED, DOPPLER_SPEED] += lasting**2 * (1.0 - doppler_kept**2)
    if active.wheel >= 0:
        spread[to, active.wheel, active.wheel] += WHEEL_WALK**2 * dt
    if active.force >= 0:
        spread[to, active.force, active.force] += FORCE_WALK_MPS2**2 * dt
    if active.radar >= 0:
        spread[to, active.radar, active.radar] += RADAR_WALK**2 * dt
    for i in active.offset:
        if i >= 0:
            spread[to, i, i] += parameters.offset_walk_m**2 * dt
    for i in active.satellite:
        if i >= 0:
            spread[to, i, i] += 1.0 - code_kept**2
    for i in range(3, n):
        after[to, i] = kept[i] * mean[i]
    for i in range(3):
        after[to, i] = step[i, 0] * mean[0] + step[i, 1] * mean[1] + step[i, 2] * mean[2]
    after[to, n + PREVIOUS_ARC], after[to, n + PREVIOUS_SPEED], after[to, n + PHASE_CLOCK] = (
        mean[ARC],
        mean[SPEED],
        dt * mean[DRIFT],
    )
    for i in range(n + 3, n + OF_EPOCH):
        after[to, i] = 0.0
    changed = 2.0 * (1.0 - math.exp(-travel / parameters.map_correlation_m))
    across = max(parameters.map_roughness_m, line.sigma_plan_m)
    above = max(parameters.map_roughness_m, HEIGHT_ROUGHNESS * line.sigma_height_m)
    spread[to, n + STEP_RIGHT, n + STEP_RIGHT] = across**2 * changed + 1e-8
    spread[to, n + STEP_UP, n + STEP_UP] = above**2 * changed + 1e-8
    # The distance on the map is the distance run less the error of the length: what codes see of it, phases do not.
    length = parameters.map_scale_m**2 * math.exp(map_log_variance) * travel + parameters.phase_walk_m**2 * dt
    spread[to, ARC, ARC] += length
    spread[to, n + MAP_LENGTH_ERROR, n + MAP_LENGTH_ERROR] = length + 1e-8
    spread[to, ARC, n + MAP_LENGTH_ERROR] = spread[to, n + MAP_LENGTH_ERROR, ARC] = -length
    spread[to, n + CODE_CLOCK, n + CODE_CLOCK] = CODE_CLOCK_SIGMA_M**2


@borrowing
def add_bend(parameters: Parameters, work: Work, h: int) -> None:
    """Add what the line bends by where the place is uncertain to the displacements across."""
    spread, bend, n = work.spread, work.bend, work.mean.shape[1] - OF_EPOCH
    length = spread[h, n + MAP_LENGTH_ERROR, n + MAP_LENGTH_ERROR] - 1e-8
    position_variance = min(spread[h, ARC, ARC] - length, parameters.start_sigma_m**2)
    spread[h, n + STEP_RIGHT, n + STEP_RIGHT] += position_variance * bend[0] ** 2
    spread[h, n + STEP_UP, n + STEP_UP] += position_variance * bend[1] ** 2


@borrowing
def possible(parameters: Parameters, state: KernelState, rows: Rows, work: Work, dt: float, measured: bool) -> bool:
    """Return whether the speed after an epoch is possible, and narrow its range to it; no bounds on several branches.

    Enough satellites, or a sensor on board too, are believed whatever the range. Where the speed is not, the range
    grows by emergency braking, so that braking is followed from the next epoch.
    """
    scalars, counts = state.scalars, rows.counts
    low, high = -math.inf, math.inf
    if int(scalars[HYPOTHESES]) == 1:
        change = parameters.service_acceleration_mps2 * dt
        low, high = scalars[LEAST_SPEED] - change, scalars[MOST_SPEED] + change
        if measured:
            satellites = max(counts[1], counts[2])
            if not 0 < satellites < parameters.trusted_satellites or counts[3] > 0:
                low, high = -math.inf, math.inf
            speed = work.new_mean[0, SPEED]
            reach = SPEED_SIGMAS * math.sqrt(work.new_covariance[0, SPEED, SPEED])
            if speed + reach < low or speed - reach > high:
                change = parameters.level_acceleration_mps2 * dt
                scalars[LEAST_SPEED], scalars[MOST_SPEED] = low - change, high + change
                return False
            low, high = max(low, speed - reach), min(high, speed + reach)
    scalars[LEAST_SPEED], scalars[MOST_SPEED] = low, high
    return True
