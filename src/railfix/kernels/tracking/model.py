"""Process model of filter, sub-filters and smoother: transition F and process noise Q between epochs.

docs/filter-equations.md tabulates F and Q. Without redundant measurements, the standard deviation of the speed grows,
and consistent reflections from one wall can then cause a wrong speed. `narrow_speed_range` limits this error.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from railfix.core.arrays import Floats, Indices
from railfix.kernels.compiling import inner
from railfix.kernels.tracking import constants
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.layout import Given, Record, Rows
from railfix.kernels.tracking.line import write_point
from railfix.kernels.tracking.update import add_row

#: Least variances of the map's displacement error and of the phase clock [m2], so that covariances are regular.
_LEAST_M2 = 1e-8
_LEAST_CLOCK_M2 = 1e-6


class Transition(NamedTuple):
    """Transition F in sparse form, with ``F[i, unknown[i, k]] = coefficient[i, k]``; fields have shape (N, 3)."""

    unknown: Indices
    coefficient: Floats


@inner
def identity(unknowns: int) -> Transition:
    """Return the identity transition."""
    unknown, coefficient = np.zeros((unknowns, 3), dtype=np.intp), np.zeros((unknowns, 3))
    unknown[:, 0], coefficient[:, 0] = np.arange(unknowns), 1.0
    return Transition(unknown, coefficient)


@inner
def compute_transition(speed: float, epoch: Record, unknowns: int) -> Transition:
    """Return the transition F to an epoch for a given speed [m/s]."""
    dt, travel = epoch.interval_s, abs(speed) * epoch.interval_s
    unknown, coefficient = identity(unknowns)
    for i in range(3):
        for k in range(3):
            unknown[i, k], coefficient[i, k] = k, epoch.step[i, k]
    unknown[ix.PREVIOUS_ARC, 0], unknown[ix.PREVIOUS_SPEED, 0] = ix.ARC, ix.SPEED
    unknown[ix.PHASE_CLOCK, 0], coefficient[ix.PHASE_CLOCK, 0] = ix.DRIFT, dt
    for i in ix.PER_EPOCH:
        coefficient[i, 0] = 0.0
    coefficient[ix.MAP_RIGHT, 0] = coefficient[ix.MAP_UP, 0] = math.exp(-travel / constants.MAP_ABSOLUTE_M)
    coefficient[ix.DOPPLER_SPEED, 0] = math.exp(-dt / constants.DOPPLER_CORRELATION_S)
    coefficient[ix.SLOW_CODE, 0] = math.exp(-dt / constants.SLOW_CODE_S)
    kept = math.exp(-dt / constants.CODE_CORRELATION_S - travel / constants.CODE_CORRELATION_M)
    for i in range(ix.SATELLITES, unknowns):
        coefficient[i, 0] = kept
    return Transition(unknown, coefficient)


@inner
def _multiply(F: Transition, matrix: Floats, product: Floats) -> None:
    """Write ``(F matrix)'``, shape (N, N)."""
    row = np.empty(matrix.shape[1])
    for i in range(len(matrix)):
        row[:] = 0.0
        for k in range(3):
            if F.coefficient[i, k] != 0.0:
                add_row(row, F.coefficient[i, k], matrix, F.unknown[i, k])
        for j in range(len(row)):
            product[j, i] = row[j]


@inner
def carry(F: Transition, x: Floats, P: Floats, scratch: Floats) -> None:
    """Propagate a Gaussian in place: ``x = F x``, ``P = F P F'``. `scratch`, shape (N, N), is overwritten."""
    before = x.copy()
    for i in range(len(x)):
        x[i] = 0.0
        for k in range(3):
            x[i] += F.coefficient[i, k] * before[F.unknown[i, k]]
    _multiply(F, P, scratch)  # (F P)' = P F'
    _multiply(F, scratch, P)  # (F P F')' = F P F'


@inner
def predict(
    given: Given, t: int, x: Floats, P: Floats, map_log_variance: float, wrong_map_m: float, scratch: Floats
) -> None:
    """Predict a Gaussian to epoch t, in place: ``x = F x``, ``P = F P F' + Q``.

    `map_log_variance` is the field of `Monitors`. `wrong_map_m` is an additional standard deviation of the map [m].
    `scratch`, shape (N, N), is overwritten.
    """
    epoch, speed = given.epoch[t], x[ix.SPEED]
    F = compute_transition(speed, epoch, len(x))
    carry(F, x, P, scratch)
    _add_noise(epoch, given.line[0], given.parameters[0], speed, (map_log_variance, wrong_map_m), F, P)


@inner
def _add_noise(
    epoch: Record,
    line: Record,
    parameters: Record,
    speed: float,
    of_map: tuple[float, float],
    F: Transition,
    P: Floats,
) -> None:
    """Add the process noise Q of an interval to P; `of_map` are `map_log_variance` and `wrong_map_m` of `predict`."""
    dt, travel, (map_log_variance, wrong_map_m) = epoch.interval_s, abs(speed) * epoch.interval_s, of_map
    for i in range(3):
        for j in range(3):
            P[i, j] += epoch.noise[i, j]
    P[ix.ARC, ix.ARC] += constants.LEAST_STEP_M2
    P[ix.SPEED, ix.SPEED] += constants.LEAST_STEP_M2
    walk = constants.CLOCK_WALK_MPS**2  # white noise of the drift; the phase clock is the integral of the drift
    P[ix.DRIFT, ix.DRIFT] += walk * dt
    P[ix.PHASE_CLOCK, ix.PHASE_CLOCK] += walk * dt**3 / 3.0 + _LEAST_CLOCK_M2
    P[ix.PHASE_CLOCK, ix.DRIFT] += walk * dt**2 / 2.0
    P[ix.DRIFT, ix.PHASE_CLOCK] += walk * dt**2 / 2.0
    P[ix.CODE_CLOCK, ix.CODE_CLOCK] = constants.CODE_CLOCK_SIGMA_M**2
    # Gauss-Markov processes: sigma^2 (1 - F^2)
    changed = 1.0 - F.coefficient[ix.MAP_RIGHT, 0] ** 2
    P[ix.MAP_RIGHT, ix.MAP_RIGHT] += (line.sigma_plan_m**2 + wrong_map_m**2) * changed
    P[ix.MAP_UP, ix.MAP_UP] += (line.sigma_height_m**2 + wrong_map_m**2) * changed
    P[ix.SLOW_CODE, ix.SLOW_CODE] += parameters.slow_code_m**2 * (1.0 - F.coefficient[ix.SLOW_CODE, 0] ** 2)
    doppler_mps = constants.DOPPLER_ERROR_MPS + constants.DOPPLER_ERROR_SHARE * abs(speed)
    P[ix.DOPPLER_SPEED, ix.DOPPLER_SPEED] += doppler_mps**2 * (1.0 - F.coefficient[ix.DOPPLER_SPEED, 0] ** 2)
    for i in range(ix.SATELLITES, len(P)):
        P[i, i] += 1.0 - F.coefficient[i, 0] ** 2
    # random walks
    P[ix.WHEEL, ix.WHEEL] += constants.WHEEL_WALK**2 * dt
    P[ix.FORCE_OFFSET, ix.FORCE_OFFSET] += constants.FORCE_WALK_MPS2**2 * dt
    P[ix.RADAR, ix.RADAR] += constants.RADAR_WALK**2 * dt
    for i in range(ix.OFFSETS, ix.SATELLITES):
        P[i, i] += constants.OFFSET_WALK_M**2 * dt
    # error of the displacement over the interval according to the map
    changed = 2.0 * (1.0 - math.exp(-travel / constants.MAP_CORRELATION_M))
    across = max(constants.MAP_ROUGHNESS_M, line.sigma_plan_m)
    above = max(constants.MAP_ROUGHNESS_M, constants.HEIGHT_ROUGHNESS * line.sigma_height_m)
    P[ix.STEP_RIGHT, ix.STEP_RIGHT] = across**2 * changed + _LEAST_M2
    P[ix.STEP_UP, ix.STEP_UP] = above**2 * changed + _LEAST_M2
    # The distance on the map is the distance travelled minus the length error; this error affects codes, not phases.
    length = constants.MAP_SCALE_M**2 * math.exp(map_log_variance) * travel + constants.PHASE_WALK_M**2 * dt
    P[ix.ARC, ix.ARC] += length
    P[ix.MAP_LENGTH_ERROR, ix.MAP_LENGTH_ERROR] = length + _LEAST_M2
    P[ix.ARC, ix.MAP_LENGTH_ERROR] = P[ix.MAP_LENGTH_ERROR, ix.ARC] = -length


@inner
def add_bend(given: Given, at: tuple[float, float], P: Floats) -> None:
    """Increase the variances of lateral displacements in a bend, where a position error changes their direction.

    `at` has the arc lengths at this epoch and at the previous epoch [m].
    """
    axes, before, point = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    write_point(given.vertex, given.line[0], at[0], point, axes)
    write_point(given.vertex, given.line[0], at[1], point, before)
    length = P[ix.MAP_LENGTH_ERROR, ix.MAP_LENGTH_ERROR] - _LEAST_M2
    position_variance = min(P[ix.ARC, ix.ARC] - length, constants.START_SIGMA_M**2)
    change = axes[0] - before[0]
    P[ix.STEP_RIGHT, ix.STEP_RIGHT] += position_variance * (change * axes[1]).sum() ** 2
    P[ix.STEP_UP, ix.STEP_UP] += position_variance * (change * axes[2]).sum() ** 2


@inner
def restart(P: Floats, unknown: int, variance: float) -> None:
    """Make an unknown independent of all other unknowns, with a given variance."""
    for c in range(len(P)):
        P[unknown, c] = P[c, unknown] = 0.0
    P[unknown, unknown] = variance


@inner
def narrow_speed_range(parameters: Record, monitors: Record, rows: Rows, speed: float, sigma: float, dt: float) -> bool:
    """Return True if a speed can follow the previous speeds, and narrow the range of possible speeds with it.

    With several hypotheses, the range is unbounded. Speeds outside the range are accepted if they come from at least
    `trusted_satellites` satellites or from codes alone, or if an on-board sensor is used. After a rejected speed, the
    range grows by the speed change of emergency braking, so that braking is followed from the next epoch on. Without a
    measurement, `sigma` is infinite, and the range grows at `service_acceleration_mps2`.
    """
    low, high = -math.inf, math.inf
    if monitors.hypotheses == 1:
        change = parameters.service_acceleration_mps2 * dt
        low, high = monitors.least_speed_mps - change, monitors.most_speed_mps + change
        if sigma < math.inf:
            satellites = max(rows.phase.stop - rows.phase.start, rows.doppler.stop - rows.doppler.start)
            sensed = rows.sensor.stop > rows.sensor.start
            if not 0 < satellites < parameters.trusted_satellites or sensed:
                low, high = -math.inf, math.inf
            reach = constants.SPEED_SIGMAS * sigma
            if speed + reach < low or speed - reach > high:
                change = parameters.level_acceleration_mps2 * dt
                monitors.least_speed_mps, monitors.most_speed_mps = low - change, high + change
                return False
            low, high = max(low, speed - reach), min(high, speed + reach)
    monitors.least_speed_mps, monitors.most_speed_mps = low, high
    return True
