r"""Measurement equations of one epoch, linearised at one Gaussian: the rows of H.

With u the unit vector from receiver to satellite, e the tangent, c and h the axes to the right and up::

    code    rho = range(s + n) - u.c m_c - u.h m_h + b + o_g + sigma x_i + noise
    Doppler rate = A + slope (v + w) - u.(c q_c + h q_h) / dt + f + noise
    phase   change = range_k(s) - range_{k-1}(s') - u.(g q_a + c q_c + h q_h) + B + noise
    wheel   W (1 + k) = s - s' + q_a, radar alike;  force F = (v - v') / dt + g sin(gradient) + beta;  place = s
    balise  place = s - age v + age^2 a / 2;  range = |unit - antenna(s - age v, m_c, m_h)|

s' and v' are those of the epoch before, x_i the satellite's correlated error in units of its sigma, o_g the offset
of its constellation's code clock, w the time-correlated error of Dopplers, n the slow error of the codes, m the map's
error, q the error of the map's displacement over the epoch (along, right, up: q_a, q_c, q_h), A the satellite's part of
the range rate, slope what the speed adds to it, W the distance by the wheel, k its scale-factor error, beta the offset
of the accelerometer. The phase's change has one direction g for both ends, that of the chord. With a direction
for each end the phases would measure absolute place from the bend of the line, more sharply than the line is known.
"""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.constants import GRAVITY_MPS2, SPEED_OF_LIGHT
from railfix.kernels.compiling import inner
from railfix.kernels.sight import TURN, sight
from railfix.kernels.tracking import constants
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.layout import Given, Rows
from railfix.kernels.tracking.line import gradient_at, nearest_arc, wrap_arc, write_point
from railfix.kernels.tracking.update import Equations

#: Unknowns of the distance run since the epoch before: s - s' + q_a.
DISTANCE = (ix.ARC, ix.PREVIOUS_ARC, ix.MAP_LENGTH_ERROR)


@inner
def new_equations(rows: Rows) -> Equations:
    """Return equations of an epoch's measurements, to be written."""
    size = rows.code.stop + ix.MOTION + rows.sensor.stop - rows.sensor.start
    count = rows.sensor.stop
    return Equations(
        np.zeros((size, ix.TERMS), dtype=np.intp),
        np.zeros((size, ix.TERMS)),
        np.zeros((count, ix.MOTION)),
        np.zeros(count),
    )


@inner
def linearise(
    given: Given, t: int, rows: Rows, x: Floats, at: tuple[float, float], direction: float, equations: Equations
) -> None:
    """Write the equations of an epoch about the arc lengths `at`: now and at the epoch before [m].

    The innovations are those of the mean x: what x is away from `at` is added to first order. `direction` is the sign
    of the last speed with one.
    """
    vertex, line = given.vertex, given.line[0]
    point, axes, before, unused = np.empty(3), np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    write_point(vertex, line, at[0], point, axes)
    write_point(vertex, line, at[1], before, unused)
    seen = _compute_sights(given, t, point, axes)
    _write_codes(given, t, rows, x, seen, x[ix.ARC] - at[0], equations)
    motion = _write_motion_quantities(rows.code.stop, x, at, equations)
    _write_phases(given, t, rows, motion, seen, before, _compute_chord(point, before, axes, at), equations)
    _write_dopplers(given, t, rows, motion, seen, point, axes, equations)
    _write_sensors(given, t, rows, x, direction, equations)


@inner
def _compute_sights(given: Given, t: int, point: Floats, axes: Floats) -> Floats:
    """Return range, unit vector to the satellite and its components on the axes of each channel.

    Shape (K, 7): column 0 the range [m], 1 to 3 the unit vector (ECEF), 4 to 6 its components along the tangent, to the
    right and up. Rows of channels without a measurement are not written.
    """
    channels = given.channel.shape[1]
    seen = np.empty((channels, 7))
    for k in range(channels):
        channel = given.channel[t, k]
        if channel.has[ix.CODE] or channel.has[ix.PHASE] or channel.has[ix.DOPPLER]:
            sat = channel.sat_ecef_m
            distance, ux, uy, uz = sight(sat[0], sat[1], sat[2], point[0], point[1], point[2])
            seen[k, 0], seen[k, 1], seen[k, 2], seen[k, 3] = distance, ux, uy, uz
            for c in range(3):
                seen[k, 4 + c] = ux * axes[c, 0] + uy * axes[c, 1] + uz * axes[c, 2]
    return seen


@inner
def _compute_chord(point: Floats, before: Floats, axes: Floats, at: tuple[float, float]) -> tuple[float, float, float]:
    """Return the direction of the displacement since the epoch before; that of the tangent near rest."""
    cx, cy, cz = point[0] - before[0], point[1] - before[1], point[2] - before[2]
    length = math.sqrt(cx * cx + cy * cy + cz * cz)
    if length > constants.CHORD_M:
        sign = (1.0 if at[0] >= at[1] else -1.0) / length
        return sign * cx, sign * cy, sign * cz
    return axes[0, 0], axes[0, 1], axes[0, 2]


@inner
def _write_motion_quantities(first: int, x: Floats, at: tuple[float, float], equations: Equations) -> Floats:
    """Write the six quantities of phases and Dopplers, from quantity `first` on; return those of the mean, shape (6,).

    Of the distance it is what the mean is away from the points at the arc lengths `at`. The error of a length of the
    map belongs to it: phases measure the distance run, not that on the map.
    """
    unknown, coefficient, motion = equations.unknown, equations.coefficient, np.empty(ix.MOTION)
    unknown[first + ix.M_DISTANCE, :3], coefficient[first + ix.M_DISTANCE, :3] = DISTANCE, (1.0, -1.0, 1.0)
    unknown[first + ix.M_SPEED, :2], coefficient[first + ix.M_SPEED, :2] = (ix.SPEED, ix.DOPPLER_SPEED), (1.0, 1.0)
    for q, i in (
        (ix.M_CLOCK, ix.PHASE_CLOCK),
        (ix.M_RIGHT, ix.STEP_RIGHT),
        (ix.M_UP, ix.STEP_UP),
        (ix.M_DRIFT, ix.DRIFT),
    ):
        unknown[first + q, 0], coefficient[first + q, 0], motion[q] = i, 1.0, x[i]
    motion[ix.M_DISTANCE] = x[ix.ARC] - at[0] - (x[ix.PREVIOUS_ARC] - at[1]) + x[ix.MAP_LENGTH_ERROR]
    motion[ix.M_SPEED] = x[ix.SPEED] + x[ix.DOPPLER_SPEED]
    return motion


@inner
def _write_codes(given: Given, t: int, rows: Rows, x: Floats, seen: Floats, moved: float, equations: Equations) -> None:
    """Write the codes, each a row and a quantity of the same index.

    `seen` is that of `_compute_sights`; `moved` is the mean's arc length less that of the point [m].
    """
    unknown, coefficient = equations.unknown, equations.coefficient
    for j in range(rows.code.start, rows.code.stop):
        k = rows.channel[j]
        channel = given.channel[t, k]
        along, right, up, sigma = -seen[k, 4], -seen[k, 5], -seen[k, 6], channel.code_sigma_m
        offset, satellite = ix.OFFSETS + channel.clock, ix.SATELLITES + channel.satellite
        unknown[j, 0], coefficient[j, 0] = ix.ARC, along
        unknown[j, 1], coefficient[j, 1] = ix.SLOW_CODE, along
        unknown[j, 2], coefficient[j, 2] = ix.MAP_RIGHT, right
        unknown[j, 3], coefficient[j, 3] = ix.MAP_UP, up
        unknown[j, 4], coefficient[j, 4] = offset, 1.0
        unknown[j, 5], coefficient[j, 5] = satellite, sigma
        unknown[j, ix.CLOCK_TERM], coefficient[j, ix.CLOCK_TERM] = ix.CODE_CLOCK, 1.0
        predicted = along * (moved + x[ix.SLOW_CODE]) + right * x[ix.MAP_RIGHT] + up * x[ix.MAP_UP]
        predicted += x[offset] + x[ix.CODE_CLOCK] + sigma * x[satellite]
        equations.value[j] = channel.measured[ix.CODE] - seen[k, 0] - predicted


@inner
def _write_motion_value(value: float, j: int, motion: Floats, equations: Equations) -> None:
    """Write the innovation of a phase or Doppler: a value less what the motion of the mean explains."""
    for a in range(ix.MOTION):
        value -= equations.design[j, a] * motion[a]
    equations.value[j] = value


@inner
def _write_phases(
    given: Given,
    t: int,
    rows: Rows,
    motion: Floats,
    seen: Floats,
    before: Floats,
    chord: tuple[float, float, float],
    equations: Equations,
) -> None:
    """Write the changes of the phases.

    `motion` is that of `_write_motion_quantities`, `seen` that of `_compute_sights`, `before` the point at the epoch
    before [m], shape (3,), `chord` the direction from there.
    """
    design, (cx, cy, cz) = equations.design, chord
    for j in range(rows.phase.start, rows.phase.stop):
        k = rows.channel[j]
        channel = given.channel[t, k]
        sat = channel.before_ecef_m
        distance = sight(sat[0], sat[1], sat[2], before[0], before[1], before[2])[0]
        gradient = -(seen[k, 1] * cx + seen[k, 2] * cy + seen[k, 3] * cz)
        design[j, ix.M_DISTANCE], design[j, ix.M_CLOCK] = gradient, 1.0
        design[j, ix.M_RIGHT], design[j, ix.M_UP] = -seen[k, 5], -seen[k, 6]
        _write_motion_value(channel.measured[ix.PHASE] - (seen[k, 0] - distance), j, motion, equations)


@inner
def _write_dopplers(
    given: Given, t: int, rows: Rows, motion: Floats, seen: Floats, point: Floats, axes: Floats, equations: Equations
) -> None:
    """Write the range rates by Doppler, with the turning of the earth and the signal's stretching."""
    dt, design = given.epoch[t].interval_s, equations.design
    for j in range(rows.doppler.start, rows.doppler.stop):
        k = rows.channel[j]
        channel = given.channel[t, k]
        sat, velocity = channel.sat_ecef_m, channel.sat_velocity_mps
        moving = seen[k, 1] * velocity[0] + seen[k, 2] * velocity[1] + seen[k, 3] * velocity[2]
        moving += TURN * (velocity[0] * point[1] - velocity[1] * point[0])
        stretch = 1.0 + moving / SPEED_OF_LIGHT
        slope = (-seen[k, 4] + TURN * (sat[0] * axes[0, 1] - sat[1] * axes[0, 0])) / stretch
        design[j, ix.M_RIGHT], design[j, ix.M_UP] = -seen[k, 5] / dt, -seen[k, 6] / dt
        design[j, ix.M_SPEED], design[j, ix.M_DRIFT] = slope, 1.0
        _write_motion_value(channel.measured[ix.DOPPLER] - moving / stretch, j, motion, equations)


@inner
def _write_sensors(given: Given, t: int, rows: Rows, x: Floats, direction: float, equations: Equations) -> None:
    """Write the sensors."""
    dt, vertex, line, value = given.epoch[t].interval_s, given.vertex, given.line[0], equations.value
    for j in range(rows.sensor.start, rows.sensor.stop):
        column, q = rows.channel[j], rows.code.stop + ix.MOTION + j - rows.sensor.start
        sensor, unknown, coefficient = given.sensor[t, column], equations.unknown[q], equations.coefficient[q]
        measured, age = sensor.value, sensor.age_s
        if column in (ix.WHEEL_COLUMN, ix.RADAR_COLUMN):
            if sensor.unsigned:
                measured *= math.copysign(1.0, x[ix.SPEED]) if abs(x[ix.SPEED]) > constants.DIRECTION_MPS else direction
            unknown[:3], coefficient[:3] = DISTANCE, (1.0, -1.0, 1.0)
            unknown[3], coefficient[3] = ix.WHEEL if column == ix.WHEEL_COLUMN else ix.RADAR, -measured
            value[j] = measured * (1.0 + x[unknown[3]]) - (x[ix.ARC] - x[ix.PREVIOUS_ARC] + x[ix.MAP_LENGTH_ERROR])
        elif column == ix.FORCE_COLUMN:
            slope = gradient_at(vertex, line, 0.5 * (x[ix.ARC] + x[ix.PREVIOUS_ARC]))
            gravity = GRAVITY_MPS2 * slope / math.sqrt(1.0 + slope**2)
            unknown[:3], coefficient[:3] = (ix.SPEED, ix.PREVIOUS_SPEED, ix.FORCE_OFFSET), (1.0 / dt, -1.0 / dt, 1.0)
            value[j] = measured - (x[ix.SPEED] - x[ix.PREVIOUS_SPEED]) / dt - gravity - x[ix.FORCE_OFFSET]
        elif column < ix.RANGE_COLUMN:
            unknown[:3], coefficient[:3] = (ix.ARC, ix.SPEED, ix.ACCELERATION), (1.0, -age, 0.5 * age**2)
            there = nearest_arc(vertex, line, wrap_arc(vertex, line, measured), x[ix.ARC])
            value[j] = there - x[ix.ARC] + age * x[ix.SPEED] - 0.5 * age**2 * x[ix.ACCELERATION]
        else:
            value[j] = measured - _write_range(given, t, column, x, q, equations)


@inner
def _write_range(given: Given, t: int, column: int, x: Floats, q: int, equations: Equations) -> float:
    """Write the terms of a range to a ground unit; return the range at the mean [m]."""
    sensor, point, axes = given.sensor[t, column], np.empty(3), np.empty((3, 3))
    age, lever = sensor.age_s, sensor.lever_m
    write_point(given.vertex, given.line[0], x[ix.ARC] - age * x[ix.SPEED] + lever[0], point, axes)
    across, above, square = x[ix.MAP_RIGHT] + lever[1], x[ix.MAP_UP] + lever[2], 0.0
    along = right = up = 0.0
    for c in range(3):
        away = sensor.unit_ecef_m[c] - point[c] - across * axes[1, c] - above * axes[2, c]
        square += away * away
        along -= away * axes[0, c]
        right -= away * axes[1, c]
        up -= away * axes[2, c]
    distance = math.sqrt(square)
    equations.unknown[q, :4] = ix.ARC, ix.SPEED, ix.MAP_RIGHT, ix.MAP_UP
    equations.coefficient[q, :4] = along / distance, -age * along / distance, right / distance, up / distance
    return distance


@inner
def shift_sensors(rows: Rows, x: Floats, other_x: Floats, other: Equations, equations: Equations) -> None:
    """Take over the equations of the sensors, made about another mean."""
    for j in range(rows.sensor.start, rows.sensor.stop):
        q = rows.code.stop + ix.MOTION + j - rows.sensor.start
        value = other.value[j]
        for k in range(ix.TERMS):
            unknown, coefficient = other.unknown[q, k], other.coefficient[q, k]
            equations.unknown[q, k], equations.coefficient[q, k] = unknown, coefficient
            value -= coefficient * (x[unknown] - other_x[unknown])
        equations.value[j] = value
