"""Selection of an epoch's measurements, variances of the measurements, and start of the clocks."""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Floats, Masks
from railfix.kernels.compiling import inner
from railfix.kernels.tracking import constants
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.adaptation import is_faulty
from railfix.kernels.tracking.layout import Given, Rows, State
from railfix.kernels.tracking.model import restart
from railfix.kernels.tracking.update import Equations, median

TIE_S = 1e-6  #: Times that differ by less than this count as equal [s], because they are rounded.


@inner
def _code_interval_s(given: Given, t: int, state: State) -> float:
    """Return the interval [s] that the codes represent: 0 if they are not used, the epoch's interval if there are none.

    Codes are not used if phases or Dopplers propagate the position and codes have been used within `code_period_s`.
    """
    epoch, period = given.epoch[t], given.parameters[0].code_period_s
    dt, since = epoch.interval_s, epoch.time_s - state.monitors[0].coded_s
    if not epoch.coded:
        return float(dt)
    if epoch.motion_measured and since < period - 0.5 * dt - TIE_S:
        return 0.0
    return float(min(max(since, dt), max(period, dt)))


@inner
def _is_sensor_used(given: Given, t: int, column: int, state: State) -> bool:
    """Return True if a sensor is used: unsigned distances require a known direction, and ranges a minimum speed."""
    sensor, monitors = given.sensor[t, column], state.monitors[0]
    used = math.isfinite(sensor.value) and (
        column < ix.RANGE_COLUMN or abs(state.x[0, ix.SPEED]) >= constants.STILL_MPS
    )
    if column == ix.WHEEL_COLUMN and sensor.unsigned and monitors.direction == 0.0:
        for h in range(monitors.hypotheses):
            used = used and abs(state.x[h, ix.SPEED]) > constants.DIRECTION_MPS
    return used


@inner
def choose_measurements(given: Given, t: int, state: State) -> Rows:
    """Return the measurements of an epoch: codes, then phase changes, Dopplers and sensors."""
    channels, sensors, monitors = given.channel.shape[1], given.sensor.shape[1], state.monitors[0]
    most = 3 * channels + sensors
    channel, variance = np.empty(most, dtype=np.intp), np.empty(most)
    left_out, ends, size = np.zeros(most, dtype=np.bool_), np.zeros(3, dtype=np.intp), 0
    code_s = _code_interval_s(given, t, state)
    scale = 1.0, math.exp(monitors.log_phase_scale), math.exp(monitors.log_doppler_scale)
    for kind in range(3):
        for k in range(channels):
            record = given.channel[t, k]
            if not record.has[kind] or (kind == ix.CODE and code_s == 0.0):
                continue
            channel[size], variance[size] = k, record.variance[kind] * scale[kind]
            if kind == ix.CODE:
                variance[size] /= min(code_s, 1.0)
                known = not given.fresh[t, record.satellite]
                if known and is_faulty(state.code_bias[record.satellite]):
                    left_out[size] = True
                    variance[size] *= constants.BIAS_INFLATED
            size += 1
        ends[kind] = size
    for column in range(sensors):
        if _is_sensor_used(given, t, column, state):
            channel[size], variance[size] = column, given.sensor[t, column].sigma ** 2
            size += 1
    return Rows(
        slice(0, ends[0]), slice(ends[0], ends[1]), slice(ends[1], ends[2]), slice(ends[2], size), channel[:size],
        variance[:size], left_out[:size], code_s, given.parameters[0].degrees_of_freedom,
        given.parameters[0].late_degrees_of_freedom,
    )  # fmt: skip


@inner
def start_clocks(
    given: Given, t: int, rows: Rows, offset_known: Masks, x: Floats, P: Floats, equations: Equations, restarted: Masks
) -> None:
    """Initialise the clocks of an epoch in a predicted Gaussian, and subtract the clock changes from the innovations.

    The median innovation of codes is added to the code clock. If the phase clock is unknown or has stepped, the
    median innovation of phases is added to it; likewise Dopplers and drift. `restarted`, shape (N,), marks restarts.
    """
    if rows.code.stop > 0:
        first = ix.OFFSETS + given.channel[t, rows.channel[0]].clock
        restarted[first] = _start_code_clocks(given, t, rows, offset_known, x, P, equations)
    for kind in (ix.PHASE, ix.DOPPLER):
        own = rows.phase if kind == ix.PHASE else rows.doppler
        if own.stop == own.start:
            continue
        away, unknown = median(equations.value[own]), ix.PHASE_CLOCK if kind == ix.PHASE else ix.DRIFT
        variance = P[unknown, unknown]
        if variance > constants.UNKNOWN_CLOCK**2 or abs(away) > constants.STEPPED * math.sqrt(variance + 0.25):
            x[unknown] += away
            equations.value[own] -= away
            restart(P, unknown, constants.UNKNOWN_CLOCK**2)
            restarted[unknown] = True


@inner
def _start_code_clocks(
    given: Given, t: int, rows: Rows, known: Masks, x: Floats, P: Floats, equations: Equations
) -> bool:
    """Add the median code innovation to the code clock, and median innovations of new constellations to clock offsets.

    At the first epoch, the first constellation defines the code clock. Return True at the first epoch.
    """
    codes, value = rows.code.stop, equations.value
    clock_of = given.channel[t]["clock"][rows.channel[:codes]]
    first, begins = clock_of[0], not known.any()
    if begins:
        P[ix.OFFSETS + first, ix.OFFSETS + first] = constants.FIRST_OFFSET_M2
    settled = known.copy()
    if not known[clock_of].any():
        settled[:], settled[first] = False, True
    clock = median(value[:codes][settled[clock_of]])
    x[ix.CODE_CLOCK] += clock
    for g in range(ix.CLOCK_COUNT):
        away, own = clock, clock_of == g
        if not settled[g] and own.any():
            away = median(value[:codes][own])
            x[ix.OFFSETS + g] += away - clock
        for j in range(codes):
            value[j] -= away if own[j] else 0.0
    return bool(begins)
