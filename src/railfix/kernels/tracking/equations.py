r"""Measurement equations of one epoch, linearised at each hypothesis, and their combinations.

With u the unit vector from receiver to satellite, e the tangent, c and h the axes to the right and up::

    code    P = range(s + z) - u.c m_c - u.h m_h + b + o_g + sigma x_i + noise
    Doppler r = A + slope (v + w) - u.(c q_c + h q_h) / dt + d + noise
    phase   change L = range_k(s) - range_{k-1}(s') - u.(g q_a + c q_c + h q_h) + B + noise
    wheel   W (1 + k) = s - s', radar alike;  force f = (v - v') / dt + g sin(gradient) + beta;  place = s
    balise  place = s - age v + age^2 a / 2;  range R = |unit - antenna(s - age v, m_c, m_h)|

s' and v' are those of the epoch before, x_i the satellite's correlated error in units of its sigma, o_g the offset
of its constellation's code clock, w the time-correlated error of Dopplers, z that of
the codes' place over minutes, m the map's error, q the error of the map's displacement over the epoch. The
gradient g of the phase's change is one for both ends: the direction of the chord. With a gradient for each end the
phases would measure absolute place from the bend of the line, more sharply than the line is known.

The rows depend on few combinations y of the unknowns: one for each code, the clock of the codes, six for all phases and
Dopplers, one for each sensor. Rounds of reweighting need the covariance of y alone (`railfix.kernels.tracking.update`).
"""

from __future__ import annotations

import math

from railfix.core.constants import GRAVITY_MPS2, SPEED_OF_LIGHT
from railfix.kernels.compiling import borrowing
from railfix.kernels.sight import TURN, sight
from railfix.kernels.tracking.constants import (
    CHORD_M,
    DIRECTION_MPS,
    SENSOR_FLOOR,
    UNKNOWN_FLOOR,
)
from railfix.kernels.tracking.course import find_ends, gradient_at, nearest_to, on_course, point_at
from railfix.kernels.tracking.layout import (
    ACCELERATION,
    ARC,
    C_CLOCK,
    C_DRIFT,
    C_RIGHT,
    C_SPEED,
    C_UP,
    C_WAY,
    CODE_CLOCK,
    CODE_PLACE,
    COMBINED,
    DOPPLER_SPEED,
    DRIFT,
    FORCE_ROW,
    MAP_LENGTH_ERROR,
    OF_EPOCH,
    PHASE_CLOCK,
    PLACE_ROW,
    PREVIOUS_ARC,
    PREVIOUS_SPEED,
    RADAR_ROW,
    RANGE_ROW,
    RIGHT,
    SPEED,
    STEP_RIGHT,
    STEP_UP,
    UP,
    WHEEL_ROW,
    Active,
    Epochs,
    LineArrays,
    Rows,
    Work,
)


@borrowing
def write_equations(
    epochs: Epochs,
    t: int,
    line: LineArrays,
    active: Active,
    rows: Rows,
    direction: float,
    work: Work,
    h: int,
) -> None:
    """Write the equations of an epoch about the places `work.now[h]` and `work.before[h]`.

    `design` has three coefficients on the axes for each code, four for each phase (distance, clock, right, up) and
    Doppler (right, up, speed, drift). `sensed` has for each sensor the coefficients of the place and the place before,
    the speed and the speed before, of its own unknown (of a place the acceleration) and of the displacement along the
    map; of a range the second and the fourth are of the error of the map to the right and up.
    """
    mean, seen, design, value, sensed = work.mean, work.sight, work.design, work.value, work.sensed
    codes, phases, dopplers, sensors, point, axes = (
        rows.codes,
        rows.phases,
        rows.dopplers,
        rows.sensors,
        work.point,
        work.axes,
    )
    n, dt = mean.shape[1] - OF_EPOCH, epochs.interval_s[t]
    nc, nph, nd, ns = rows.counts[0], rows.counts[1], rows.counts[2], rows.counts[3]
    now, before = work.now[h], work.before[h]
    find_ends(line, now, before, work)
    moved, moved_before = mean[h, ARC] - now, mean[h, n + PREVIOUS_ARC] - before
    for k in range(epochs.has.shape[2]):
        if epochs.has[0, t, k] or epochs.has[1, t, k] or epochs.has[2, t, k]:
            sat = epochs.sat_ecef_m
            distance, ux, uy, uz = sight(
                sat[t, k, 0], sat[t, k, 1], sat[t, k, 2], point[0, 0], point[0, 1], point[0, 2]
            )
            seen[k, 0], seen[k, 1], seen[k, 2], seen[k, 3] = distance, ux, uy, uz
            for c in range(3):
                seen[k, 4 + c] = ux * axes[0, c, 0] + uy * axes[0, c, 1] + uz * axes[0, c, 2]
    for i in range(nc):
        k = codes[i]
        design[h, i, 0], design[h, i, 1], design[h, i, 2] = -seen[k, 4], -seen[k, 5], -seen[k, 6]
        rest = (
            design[h, i, 0] * (moved + mean[h, CODE_PLACE])
            + design[h, i, 1] * mean[h, RIGHT]
            + design[h, i, 2] * mean[h, UP]
        )
        rest += mean[h, active.offset[epochs.offset[k]]] + mean[h, n + CODE_CLOCK]
        rest += epochs.code_sigma_m[t, k] * mean[h, active.satellite[epochs.slot[k]]]
        value[h, i] = epochs.measured[0, t, k] - seen[k, 0] - rest
    if nph:
        cx, cy, cz = point[0, 0] - point[1, 0], point[0, 1] - point[1, 1], point[0, 2] - point[1, 2]
        length = math.sqrt(cx * cx + cy * cy + cz * cz)
        if length > CHORD_M:
            sign = (1.0 if now >= before else -1.0) / length
            cx, cy, cz = sign * cx, sign * cy, sign * cz
        else:
            cx, cy, cz = axes[0, 0, 0], axes[0, 0, 1], axes[0, 0, 2]
        for j in range(nph):
            i, k = nc + j, phases[j]
            sat = epochs.before_ecef_m
            distance = sight(sat[t, k, 0], sat[t, k, 1], sat[t, k, 2], point[1, 0], point[1, 1], point[1, 2])[0]
            gradient = -(seen[k, 1] * cx + seen[k, 2] * cy + seen[k, 3] * cz)
            design[h, i, 0], design[h, i, 1], design[h, i, 2], design[h, i, 3] = (
                gradient,
                1.0,
                -seen[k, 5],
                -seen[k, 6],
            )
            computed = seen[k, 0] - distance + gradient * (moved - moved_before)
            value[h, i] = epochs.measured[1, t, k] - computed - mean[h, n + PHASE_CLOCK]
    for j in range(nd):
        i, k = nc + nph + j, dopplers[j]
        sx, sy = epochs.sat_ecef_m[t, k, 0], epochs.sat_ecef_m[t, k, 1]
        vx, vy, vz = (
            epochs.sat_velocity_mps[t, k, 0],
            epochs.sat_velocity_mps[t, k, 1],
            epochs.sat_velocity_mps[t, k, 2],
        )
        moving = seen[k, 1] * vx + seen[k, 2] * vy + seen[k, 3] * vz + TURN * (vx * point[0, 1] - vy * point[0, 0])
        stretch = 1.0 + moving / SPEED_OF_LIGHT
        slope = (-seen[k, 4] + TURN * (sx * axes[0, 0, 1] - sy * axes[0, 0, 0])) / stretch
        design[h, i, 0], design[h, i, 1], design[h, i, 2], design[h, i, 3] = (
            -seen[k, 5] / dt,
            -seen[k, 6] / dt,
            slope,
            1.0,
        )
        value[h, i] = epochs.measured[2, t, k] - (
            moving / stretch + slope * (mean[h, SPEED] + mean[h, DOPPLER_SPEED]) + mean[h, DRIFT]
        )
    for j in range(ns):
        i, kind = nc + nph + nd + j, sensors[j]
        measured = epochs.sensor[t, kind]
        for c in range(6):
            sensed[h, j, c] = 0.0
        if kind in (WHEEL_ROW, RADAR_ROW):
            if kind == WHEEL_ROW and epochs.unsigned:
                speed = mean[h, SPEED]
                measured *= math.copysign(1.0, speed) if abs(speed) > DIRECTION_MPS else direction
            own = active.wheel if kind == WHEEL_ROW else active.radar
            sensed[h, j, 0], sensed[h, j, 1], sensed[h, j, 4], sensed[h, j, 5] = 1.0, -1.0, -measured, 1.0
            value[h, i] = measured * (1.0 + mean[h, own]) - (mean[h, ARC] - mean[h, n + PREVIOUS_ARC])
        elif kind == FORCE_ROW:
            slope = gradient_at(line, 0.5 * (mean[h, ARC] + mean[h, n + PREVIOUS_ARC]))
            gravity = GRAVITY_MPS2 * slope / math.sqrt(1.0 + slope**2)
            sensed[h, j, 2], sensed[h, j, 3], sensed[h, j, 4] = 1.0 / dt, -1.0 / dt, 1.0
            value[h, i] = (
                measured - (mean[h, SPEED] - mean[h, n + PREVIOUS_SPEED]) / dt - gravity - mean[h, active.force]
            )
        elif kind < RANGE_ROW:
            age = epochs.sensor_age_s[t, kind - PLACE_ROW]
            sensed[h, j, 0], sensed[h, j, 2], sensed[h, j, 4] = 1.0, -age, 0.5 * age**2
            there = nearest_to(line, on_course(line, measured), mean[h, ARC])
            value[h, i] = there - mean[h, ARC] + age * mean[h, SPEED] - 0.5 * age**2 * mean[h, ACCELERATION]
        else:
            value[h, i] = measured - _write_range(epochs, t, line, kind - RANGE_ROW, work, h, j)


@borrowing
def _write_range(epochs: Epochs, t: int, line: LineArrays, unit: int, work: Work, h: int, j: int) -> float:
    """Write the coefficients of a range to a ground unit; return the range at the mean."""
    mean, sensed, point, axes, lever = work.mean, work.sensed, work.point, work.axes, epochs.lever_m
    age = epochs.sensor_age_s[t, RANGE_ROW - PLACE_ROW + unit]
    point_at(line, mean[h, ARC] - age * mean[h, SPEED] + lever[0], point, axes, 0)
    across, above, square = mean[h, RIGHT] + lever[1], mean[h, UP] + lever[2], 0.0
    along = right = up = 0.0
    for c in range(3):
        away = epochs.range_unit_ecef_m[t, unit, c] - point[0, c] - across * axes[0, 1, c] - above * axes[0, 2, c]
        square += away * away
        along -= away * axes[0, 0, c]
        right -= away * axes[0, 1, c]
        up -= away * axes[0, 2, c]
    distance = math.sqrt(square)
    sensed[h, j, 0], sensed[h, j, 1], sensed[h, j, 3] = along / distance, right / distance, up / distance
    sensed[h, j, 2] = -age * sensed[h, j, 0]
    return distance


@borrowing
def move_sensor_equations(active: Active, rows: Rows, best: int, work: Work, h: int) -> None:
    """Take over the equations of the sensors in row `best`, about another mean, `work.mean[h]`."""
    mean, sensed, sensors = work.mean, work.sensed, rows.sensors
    n, gnss = mean.shape[1] - OF_EPOCH, rows.counts[0] + rows.counts[1] + rows.counts[2]
    place, speed = mean[h, ARC] - mean[best, ARC], mean[h, SPEED] - mean[best, SPEED]
    old, old_speed = (
        mean[h, n + PREVIOUS_ARC] - mean[best, n + PREVIOUS_ARC],
        mean[h, n + PREVIOUS_SPEED] - mean[best, n + PREVIOUS_SPEED],
    )
    across, above = mean[h, RIGHT] - mean[best, RIGHT], mean[h, UP] - mean[best, UP]
    for j in range(rows.counts[3]):
        i, kind = gnss + j, sensors[j]
        own = 0.0
        if kind == WHEEL_ROW:
            own = mean[h, active.wheel] - mean[best, active.wheel]
        elif kind == RADAR_ROW:
            own = mean[h, active.radar] - mean[best, active.radar]
        elif kind == FORCE_ROW:
            own = mean[h, active.force] - mean[best, active.force]
        elif PLACE_ROW <= kind < RANGE_ROW:
            own = mean[h, ACCELERATION] - mean[best, ACCELERATION]
        for c in range(6):
            sensed[h, j, c] = sensed[best, j, c]
        work.value[h, i] = work.value[best, i] - (
            sensed[best, j, 0] * place
            + sensed[best, j, 1] * (across if kind >= RANGE_ROW else old)
            + sensed[best, j, 2] * speed
            + sensed[best, j, 3] * (above if kind >= RANGE_ROW else old_speed)
            + sensed[best, j, 4] * own
        )


@borrowing
def combine(epochs: Epochs, t: int, active: Active, rows: Rows, work: Work, h: int) -> None:
    """Write the covariance of the combinations with the unknowns and with each other, in their standard deviations.

    `unknown` and `share` are the unknowns of each combination and their coefficients, over `root`.
    """
    design, sensed, spread, cross, root, own = work.design, work.sensed, work.spread, work.cross, work.root, work.own
    unknown, share = work.unknown[h], work.share[h]
    nc, ns = rows.counts[0], rows.counts[3]
    width = spread.shape[1]
    n = width - OF_EPOCH
    size = nc + COMBINED + ns
    for i in range(nc):
        k = rows.codes[i]
        unknown[i, 0], share[i, 0] = ARC, design[h, i, 0]
        unknown[i, 1], share[i, 1] = CODE_PLACE, design[h, i, 0]
        unknown[i, 2], share[i, 2] = RIGHT, design[h, i, 1]
        unknown[i, 3], share[i, 3] = UP, design[h, i, 2]
        unknown[i, 4], share[i, 4] = active.offset[epochs.offset[k]], 1.0
        unknown[i, 5], share[i, 5] = active.satellite[epochs.slot[k]], epochs.code_sigma_m[t, k]
    for i in range(nc, size):
        for k in range(6):
            unknown[i, k], share[i, k] = 0, 0.0
    unknown[nc, 0], share[nc, 0] = n + CODE_CLOCK, 1.0
    unknown[nc + C_WAY, 0], share[nc + C_WAY, 0] = ARC, 1.0
    unknown[nc + C_WAY, 1], share[nc + C_WAY, 1] = n + PREVIOUS_ARC, -1.0
    unknown[nc + C_WAY, 2], share[nc + C_WAY, 2] = n + MAP_LENGTH_ERROR, 1.0
    unknown[nc + C_CLOCK, 0], share[nc + C_CLOCK, 0] = n + PHASE_CLOCK, 1.0
    unknown[nc + C_RIGHT, 0], share[nc + C_RIGHT, 0] = n + STEP_RIGHT, 1.0
    unknown[nc + C_UP, 0], share[nc + C_UP, 0] = n + STEP_UP, 1.0
    unknown[nc + C_SPEED, 0], share[nc + C_SPEED, 0] = SPEED, 1.0
    unknown[nc + C_SPEED, 1], share[nc + C_SPEED, 1] = DOPPLER_SPEED, 1.0
    unknown[nc + C_DRIFT, 0], share[nc + C_DRIFT, 0] = DRIFT, 1.0
    for j in range(ns):
        i = nc + COMBINED + j
        unknown[i, 0], share[i, 0] = ARC, sensed[h, j, 0]
        ranged = rows.sensors[j] >= RANGE_ROW
        unknown[i, 1], share[i, 1] = RIGHT if ranged else n + PREVIOUS_ARC, sensed[h, j, 1]
        unknown[i, 2], share[i, 2] = SPEED, sensed[h, j, 2]
        unknown[i, 3], share[i, 3] = UP if ranged else n + PREVIOUS_SPEED, sensed[h, j, 3]
        if rows.sensors[j] == WHEEL_ROW:
            unknown[i, 4] = active.wheel
        elif rows.sensors[j] == RADAR_ROW:
            unknown[i, 4] = active.radar
        elif rows.sensors[j] == FORCE_ROW:
            unknown[i, 4] = active.force
        elif PLACE_ROW <= rows.sensors[j] < RANGE_ROW:
            unknown[i, 4] = ACCELERATION
        share[i, 4] = sensed[h, j, 4]
        unknown[i, 5], share[i, 5] = n + MAP_LENGTH_ERROR, sensed[h, j, 5]
    for i in range(nc):
        offset, satellite = unknown[i, 4], unknown[i, 5]
        along, right, up, sigma = share[i, 0], share[i, 2], share[i, 3], share[i, 5]
        for c in range(width):
            cross[h, i, c] = (
                along * (spread[h, ARC, c] + spread[h, CODE_PLACE, c])
                + right * spread[h, RIGHT, c]
                + up * spread[h, UP, c]
                + spread[h, offset, c]
                + sigma * spread[h, satellite, c]
            )
    for i in range(nc, size):
        for c in range(width):
            cross[h, i, c] = 0.0
        for k in range(6):
            coefficient = share[i, k]
            if coefficient != 0.0:
                row = unknown[i, k]
                for c in range(width):
                    cross[h, i, c] += coefficient * spread[h, row, c]
    gnss = nc + rows.counts[1] + rows.counts[2]
    for i in range(size):
        total = 0.0
        for k in range(6):
            total += share[i, k] * cross[h, i, unknown[i, k]]
        if i >= nc + COMBINED:
            total += SENSOR_FLOOR * work.variance[gnss + i - nc - COMBINED] + UNKNOWN_FLOOR * total
        root[h, i] = math.sqrt(total)
        scale = 1.0 / root[h, i]
        for c in range(width):
            cross[h, i, c] *= scale
        for k in range(6):
            share[i, k] *= scale
    for i in range(size):
        along, right, up = cross[h, i, ARC] + cross[h, i, CODE_PLACE], cross[h, i, RIGHT], cross[h, i, UP]
        for j in range(i + 1, nc):
            own[h, i, j] = own[h, j, i] = (
                share[j, 0] * along
                + share[j, 2] * right
                + share[j, 3] * up
                + share[j, 4] * cross[h, i, unknown[j, 4]]
                + share[j, 5] * cross[h, i, unknown[j, 5]]
            )
        for j in range(max(i + 1, nc), size):
            total = 0.0
            for k in range(3 if j < nc + COMBINED else 6):
                total += share[j, k] * cross[h, i, unknown[j, k]]
            own[h, i, j] = own[h, j, i] = total
        own[h, i, i] = 1.0
