"""Measurement equations of one epoch for one Gaussian, linearised at its mean.

docs/filter-equations.md has the equations of the rows of H and A. The equation of a carrier-phase change uses the
direction of the chord at both ends of the interval. With the tangent at each end, the phases would determine the
absolute position from the bends of the line, more accurately than the line is known.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.constants import GRAVITY_MPS2, SPEED_OF_LIGHT
from railfix.kernels.compiling import inner
from railfix.kernels.sight import TURN, sight
from railfix.kernels.tracking import constants
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.layout import Given, Record, Rows
from railfix.kernels.tracking.line import gradient_at, nearest_arc, wrap_arc, write_point
from railfix.kernels.tracking.update import Equations, find_quantity


class Geometry(NamedTuple):
    """Points and lines of sight at which the equations of an epoch are linearised."""

    point: Floats  #: Position at this epoch, ECEF [m]; shape (3,).
    axes: Floats  #: Tangent, right and up at this epoch's position; shape (3, 3).
    before: Floats  #: Position at the previous epoch, ECEF [m]; shape (3,).
    #: Unit vector of the displacement since the previous epoch, or tangent if shorter than `CHORD_M`; shape (3,).
    chord: Floats
    distance: Floats  #: Distance to the satellite of each channel with measurements [m]; shape (K,).
    sight: Floats  #: Unit vectors to the satellites, ECEF; shape (K, 3).
    along: Floats  #: Components of `sight` along `axes`; shape (K, 3).


#: Unknowns s, s' and d_t. The distance travelled since the previous epoch is s - s' + d_t.
DISTANCE = (ix.ARC, ix.PREVIOUS_ARC, ix.MAP_LENGTH_ERROR)
#: Pairs of a motion quantity and the single unknown that it equals.
OWN_UNKNOWNS = (
    (ix.M_CLOCK, ix.PHASE_CLOCK), (ix.M_RIGHT, ix.STEP_RIGHT), (ix.M_UP, ix.STEP_UP), (ix.M_DRIFT, ix.DRIFT),
)  # fmt: skip


@inner
def new_equations(rows: Rows) -> Equations:
    """Allocate the equations of an epoch's measurements."""
    size = rows.code.stop + ix.MOTION + rows.sensor.stop - rows.sensor.start
    count = len(rows.variance)
    return Equations(
        np.zeros((size, ix.TERMS), dtype=np.intp),
        np.zeros((size, ix.TERMS)),
        np.zeros((count, ix.MOTION)),
        np.zeros(count),
    )


@inner
def linearise(
    given: Given, t: int, rows: Rows, x: Floats, at: tuple[float, float], wheel_sign: float, equations: Equations
) -> None:
    """Write an epoch's equations, linearised at the arc lengths `at` [m] of this epoch and of the previous epoch.

    The innovations refer to the mean x, and are linear in the difference between x and `at`. `wheel_sign` is the result
    of `find_wheel_sign`.
    """
    geometry = _compute_geometry(given, t, at)
    _write_codes(given, t, rows, x, geometry, x[ix.ARC] - at[0], equations)
    motion = _write_motion_quantities(rows.code.stop, x, at, equations)
    _write_phases(given, t, rows, geometry, motion, equations)
    _write_dopplers(given, t, rows, geometry, motion, equations)
    _write_sensors(given, t, rows, x, wheel_sign, equations)


@inner
def find_wheel_sign(x: Floats, direction: float) -> float:
    """Return the sign of an unsigned wheel distance: the sign of the speed, or `direction` if the speed is low."""
    return math.copysign(1.0, x[ix.SPEED]) if abs(x[ix.SPEED]) > constants.DIRECTION_MPS else direction


@inner
def _compute_geometry(given: Given, t: int, at: tuple[float, float]) -> Geometry:
    """Return points and lines of sight at the arc lengths `at` [m] of this epoch and of the previous epoch."""
    point, axes, before, unused = np.empty(3), np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    write_point(given.vertex, given.line[0], at[0], point, axes)
    write_point(given.vertex, given.line[0], at[1], before, unused)
    chord, length = point - before, math.sqrt(((point - before) ** 2).sum())
    chord = chord * math.copysign(1.0 / length, at[0] - at[1]) if length > constants.CHORD_M else axes[0].copy()
    channels = given.channel.shape[1]
    distance, sights, along = np.empty(channels), np.empty((channels, 3)), np.empty((channels, 3))
    for k in range(channels):
        channel = given.channel[t, k]
        if channel.has[ix.CODE] or channel.has[ix.PHASE] or channel.has[ix.DOPPLER]:
            sat = channel.sat_ecef_m
            distance[k], ux, uy, uz = sight(sat[0], sat[1], sat[2], point[0], point[1], point[2])
            sights[k, 0], sights[k, 1], sights[k, 2] = ux, uy, uz
            for c in range(3):
                along[k, c] = ux * axes[c, 0] + uy * axes[c, 1] + uz * axes[c, 2]
    return Geometry(point, axes, before, chord, distance, sights, along)


@inner
def _write_motion_quantities(first: int, x: Floats, at: tuple[float, float], equations: Equations) -> Floats:
    """Write the six motion quantities, from index `first` on; return their values at the mean, shape (6,).

    The returned distance is the distance travelled minus the difference of the two arc lengths `at`. It includes the
    map's length error, because phases measure the distance travelled, not the distance on the map.
    """
    unknown, coefficient, motion = equations.unknown, equations.coefficient, np.empty(ix.MOTION)
    unknown[first + ix.M_DISTANCE, :3], coefficient[first + ix.M_DISTANCE, :3] = DISTANCE, (1.0, -1.0, 1.0)
    unknown[first + ix.M_SPEED, :2], coefficient[first + ix.M_SPEED, :2] = (ix.SPEED, ix.DOPPLER_SPEED), (1.0, 1.0)
    for q, i in OWN_UNKNOWNS:
        unknown[first + q, 0], coefficient[first + q, 0], motion[q] = i, 1.0, x[i]
    motion[ix.M_DISTANCE] = x[ix.ARC] - at[0] - (x[ix.PREVIOUS_ARC] - at[1]) + x[ix.MAP_LENGTH_ERROR]
    motion[ix.M_SPEED] = x[ix.SPEED] + x[ix.DOPPLER_SPEED]
    return motion


@inner
def _write_codes(
    given: Given, t: int, rows: Rows, x: Floats, geometry: Geometry, moved: float, equations: Equations
) -> None:
    """Write each code as row and quantity of equal index; the mean is `moved` [m] ahead of the point in `geometry`."""
    unknown, coefficient = equations.unknown, equations.coefficient
    for j in range(rows.code.start, rows.code.stop):
        k = rows.channel[j]
        channel = given.channel[t, k]
        along, right, up = -geometry.along[k, 0], -geometry.along[k, 1], -geometry.along[k, 2]
        sigma = channel.code_sigma_m
        offset, code_error = ix.OFFSETS + channel.clock, ix.SATELLITES + channel.satellite
        unknown[j, 0], coefficient[j, 0] = ix.ARC, along
        unknown[j, 1], coefficient[j, 1] = ix.SLOW_CODE, along
        unknown[j, 2], coefficient[j, 2] = ix.MAP_RIGHT, right
        unknown[j, 3], coefficient[j, 3] = ix.MAP_UP, up
        unknown[j, 4], coefficient[j, 4] = offset, 1.0
        unknown[j, 5], coefficient[j, 5] = code_error, sigma
        unknown[j, ix.CLOCK_TERM], coefficient[j, ix.CLOCK_TERM] = ix.CODE_CLOCK, 1.0
        predicted = along * (moved + x[ix.SLOW_CODE]) + right * x[ix.MAP_RIGHT] + up * x[ix.MAP_UP]
        predicted += x[offset] + x[ix.CODE_CLOCK] + sigma * x[code_error]
        equations.value[j] = channel.measured[ix.CODE] - geometry.distance[k] - predicted


@inner
def _write_motion_value(value: float, j: int, motion: Floats, equations: Equations) -> None:
    """Write the innovation of a phase or Doppler from the values `motion` of the motion quantities."""
    for a in range(ix.MOTION):
        value -= equations.design[j, a] * motion[a]
    equations.value[j] = value


@inner
def _write_phases(given: Given, t: int, rows: Rows, geometry: Geometry, motion: Floats, equations: Equations) -> None:
    """Write the phase changes; `motion` is the result of `_write_motion_quantities`."""
    design, before, chord = equations.design, geometry.before, geometry.chord
    for j in range(rows.phase.start, rows.phase.stop):
        k = rows.channel[j]
        channel, u = given.channel[t, k], geometry.sight[k]
        sat = channel.before_ecef_m
        earlier = sight(sat[0], sat[1], sat[2], before[0], before[1], before[2])[0]
        design[j, ix.M_DISTANCE], design[j, ix.M_CLOCK] = -(u[0] * chord[0] + u[1] * chord[1] + u[2] * chord[2]), 1.0
        design[j, ix.M_RIGHT], design[j, ix.M_UP] = -geometry.along[k, 1], -geometry.along[k, 2]
        _write_motion_value(channel.measured[ix.PHASE] - (geometry.distance[k] - earlier), j, motion, equations)


@inner
def _write_dopplers(given: Given, t: int, rows: Rows, geometry: Geometry, motion: Floats, equations: Equations) -> None:
    """Write the Doppler range rates; `motion` is the result of `_write_motion_quantities`."""
    dt, design, tangent, per_velocity = given.epoch[t].interval_s, equations.design, geometry.axes[0], np.empty(3)
    for j in range(rows.doppler.start, rows.doppler.stop):
        k = rows.channel[j]
        rate = write_range_rate(given.channel[t, k], geometry.point, geometry.sight[k], per_velocity)
        per_speed = per_velocity[0] * tangent[0] + per_velocity[1] * tangent[1] + per_velocity[2] * tangent[2]
        design[j, ix.M_RIGHT], design[j, ix.M_UP] = -geometry.along[k, 1] / dt, -geometry.along[k, 2] / dt
        design[j, ix.M_SPEED], design[j, ix.M_DRIFT] = per_speed, 1.0
        _write_motion_value(given.channel[t, k].measured[ix.DOPPLER] - rate, j, motion, equations)


@inner
def write_range_rate(channel: Record, point: Floats, u: Floats, per_velocity: Floats) -> float:
    """Return the satellite's part of the range rate [m/s], and write the rate's derivative by the receiver velocity.

    The rate is ``(A + g . v) / (1 + A / c)``, where A is the satellite's velocity along the unit vector u to the
    satellite, and g is -u. A and g include the Earth's rotation. The derivative `per_velocity` is ``g / (1 + A / c)``.
    All arrays have the shape (3,).
    """
    sat, velocity = channel.sat_ecef_m, channel.sat_velocity_mps
    moving = u[0] * velocity[0] + u[1] * velocity[1] + u[2] * velocity[2]
    moving += TURN * (velocity[0] * point[1] - velocity[1] * point[0])
    stretch = 1.0 + moving / SPEED_OF_LIGHT
    per_velocity[0], per_velocity[1] = (-u[0] - TURN * sat[1]) / stretch, (-u[1] + TURN * sat[0]) / stretch
    per_velocity[2] = -u[2] / stretch
    return float(moving / stretch)


@inner
def _write_sensors(given: Given, t: int, rows: Rows, x: Floats, wheel_sign: float, equations: Equations) -> None:
    """Write the equations of the on-board sensors."""
    dt, vertex, line, value = given.epoch[t].interval_s, given.vertex, given.line[0], equations.value
    for j in range(rows.sensor.start, rows.sensor.stop):
        column, q = rows.channel[j], find_quantity(rows, j)
        sensor, unknown, coefficient = given.sensor[t, column], equations.unknown[q], equations.coefficient[q]
        measured, age = sensor.value, sensor.age_s
        if column in (ix.WHEEL_COLUMN, ix.RADAR_COLUMN):
            measured *= wheel_sign if sensor.unsigned else 1.0
            unknown[:3], coefficient[:3] = DISTANCE, (1.0, -1.0, 1.0)
            unknown[3], coefficient[3] = ix.WHEEL if column == ix.WHEEL_COLUMN else ix.RADAR, -measured
            value[j] = measured * (1.0 + x[unknown[3]]) - (x[ix.ARC] - x[ix.PREVIOUS_ARC] + x[ix.MAP_LENGTH_ERROR])
        elif column == ix.FORCE_COLUMN:
            gradient = gradient_at(vertex, line, 0.5 * (x[ix.ARC] + x[ix.PREVIOUS_ARC]))
            gravity = GRAVITY_MPS2 * gradient / math.sqrt(1.0 + gradient**2)
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
    """Write the equation of a range to a ground unit, and return the predicted range [m]."""
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
