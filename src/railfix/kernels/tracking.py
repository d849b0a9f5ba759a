"""Compiled recursion of `railfix.tracking.filter`: ordinary epochs one after the other, hypotheses side by side.

The same equations as in numpy, over the unknowns that are in use (compact ones, in the order S, V, A, ... below) and
seven that last an epoch. Starts, gaps, searches and epochs without a measurement are left to numpy: `advance` returns
at such an epoch.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from railfix.core.arrays import Codes, Floats, Indices, Integers, Masks
from railfix.core.constants import EARTH_ROTATION_RATE, SPEED_OF_LIGHT
from railfix.kernels.compiling import kernel

_TURN = EARTH_ROTATION_RATE / SPEED_OF_LIGHT
#: Compact unknowns that are always there: place, speed, acceleration, drift, error of the map to the right and up,
#: error of the speed by Dopplers, displacement of the codes.
_S, _V, _A, _D, _RIGHT, _UP, _W, _Z = 0, 1, 2, 3, 4, 5, 6, 7
#: Unknowns of one epoch, after the compact ones: place and speed before, clock of the phases, displacement of the map
#: to the right, up and along, clock of the codes.
_OLD_S, _OLD_V, _PHASE, _STEP_RIGHT, _STEP_UP, _STEP_ALONG, _CODE = 0, 1, 2, 3, 4, 5, 6
_EPOCH = 7
#: Combinations of phases and Dopplers after the clock of the codes.
_WAY, _CLOCK, _Q_RIGHT, _Q_UP, _SPEED, _DRIFT = 1, 2, 3, 4, 5, 6
_MOTION = 7
_SENSORS = 4
_WHEEL_ROW, _RADAR_ROW, _FORCE_ROW, _PLACE_ROW = 0, 1, 2, 3


class Epochs(NamedTuple):
    """T prepared epochs of K channels (`railfix.tracking.chunk.Chunk`) and sensors.

    `left` marks epochs that numpy has to do (after long gaps, with ranges to ground units); `singer` is the row of
    `step` and `noise` of each interval; columns of `sensor` and `sensor_sigma`: wheel, radar, force, place, NaN
    without a measurement.
    """

    time_s: Floats
    interval_s: Floats
    left: Masks
    singer: Indices
    step: Floats
    noise: Floats
    slot: Indices
    offset: Indices
    sat_ecef_m: Floats
    sat_velocity_mps: Floats
    before_ecef_m: Floats
    measured: Floats
    has: Masks
    variance: Floats
    code_sigma_m: Floats
    fresh: Masks
    remembered: Masks
    sensor: Floats
    sensor_sigma: Floats
    unsigned: bool


class Course(NamedTuple):
    """`railfix.tracking.line.Line`, with the arc lengths of the middles of segments."""

    arc_m: Floats
    ecef_m: Floats
    axes: Floats
    segment: Floats
    middle_m: Floats
    gradient: Floats
    sigma_plan_m: float
    sigma_height_m: float
    start_m: float
    end_m: float


class Numbers(NamedTuple):
    """Settings and constants of the filter, by the names that they have there."""

    degrees: tuple[float, float]
    passes: int
    code_correlation_s: float
    code_correlation_m: float
    slow_code_m: float
    slow_code_s: float
    doppler_error_mps: float
    doppler_error_share: float
    doppler_correlation_s: float
    phase_walk_m: float
    clock_walk_mps: float
    offset_walk_m: float
    map_roughness_m: float
    map_correlation_m: float
    map_scale_m: float
    map_misfit_sigmas: float
    map_misfit_s: float
    map_misfit_kept_s: float
    misfit_codes: int
    misfit_clipped: float
    misfit_learnt_s: float
    misfit_largest: float
    map_absolute_m: float
    map_branch_m: float
    decided_travel_m: float
    least_probability: float
    most_hypotheses: int
    start_sigma_m: float
    gap_s: float
    lost_motion_weight: float
    lost_motion_s: float
    lost_code_weight: float
    lost_code_s: float
    expired_sigma_m: float
    least_step_m2: float
    code_clock_sigma_m: float
    wheel_walk: float
    force_walk_mps2: float
    radar_walk: float
    stepped: float
    unknown_clock: float
    scale_s: float
    least_scale: float
    largest_scale: float
    doubtful: float
    freedom_place: float
    freedom_speed: float
    moved_m: float
    relinearised: int
    sensor_floor: float
    direction_mps: float
    chord_m: float
    gravity_mps2: float
    switch: float
    most_odds: float
    level_passes: int
    level_risk: float
    level_k: float
    precision_m: float
    rounds: int
    scale_bound: float
    joined: float
    decided: float
    tracking: int
    several: int
    coasting: int
    expired: int


class Active(NamedTuple):
    """Compact unknowns that are in use: `full` is the place of each in the state, the others where to find them.

    -1 where there is none; `satellite` and `offset` are by slot and by clock.
    """

    full: Indices
    wheel: int
    force: int
    radar: int
    offset: Indices
    satellite: Indices


class Memory(NamedTuple):
    """State that is read and written: compact means and covariances, and `scalars` (`_HYPOTHESES` and following)."""

    mean: Floats
    covariance: Floats
    log_probability: Floats
    origin_m: Floats
    offset_known: Masks
    scalars: Floats


class Subfilters(NamedTuple):
    """Sub-filters of the level by their source (`railfix.tracking.bank`): satellites by slot, clocks, sensors.

    None of them where levels are off. `running` marks those that there are; `prior` is the probability of a fault of
    each source, 0 where it needs no sub-filter, `k` the sigmas that follow from it; `begun` has the variances of the
    compact unknowns and those of an epoch that one begins with; `clock` is that of each satellite.
    """

    running: Masks
    mean: Floats
    covariance: Floats
    weak_s: Floats
    prior: Floats
    k: Floats
    begun: Floats
    clock: Indices


class Work(NamedTuple):
    """Work space of an epoch; the last row of each array belongs to sub-filters and second starts."""

    mean: Floats
    spread: Floats
    design: Floats
    value: Floats
    sensed: Floats
    cross: Floats
    root: Floats
    own: Floats
    information: Floats
    after: Floats
    change: Floats
    weight: Floats
    residual: Floats
    fitted: Floats
    new_mean: Floats
    new_covariance: Floats
    system: Floats
    factor: Floats
    lower: Floats
    right: Floats
    ordered: Floats
    gain: Floats
    less: Floats
    rows: Floats
    kept: Floats
    place: Integers
    share: Floats
    point: Floats
    axes: Floats
    bend: Floats


_HYPOTHESES, _WEAK_MOTION, _WEAK_CODE, _SCALE_DOPPLER, _SCALE_PHASE, _UNAIDED, _DIRECTION, _MEASURED = range(8)
_SHIFT, _SHIFT_VARIANCE, _MAP_SCALE = 8, 9, 10


class Answers(NamedTuple):
    """Arrays of `railfix.tracking.result.Tracked` that are written."""

    status: Codes
    arc_m: Floats
    sigma_m: Floats
    speed_mps: Floats
    speed_sigma_mps: Floats
    acceleration_mps2: Floats
    probability: Floats
    hypotheses: Integers
    code_weight: Floats
    motion_weight: Floats
    wheel_scale: Floats
    force_offset_mps2: Floats
    radar_scale: Floats
    map_scale: Floats
    level_m: Floats
    level_noise_m: Floats
    separation_m: Floats
    amount_m: Floats
    used: Integers
    innovation: Floats
    sensed: Floats
    weight: Floats


# fmt: off
@kernel
def _at(
    arc_m: Floats, ecef_m: Floats, vertex_axes: Floats, segment: Floats, arc: float, point: Floats, p: int, axes: Floats
) -> None:
    """Point and axes of the line at an arc length."""
    low, high = 1, len(arc_m) - 1
    while low < high:
        half = (low + high) // 2
        if arc_m[half] <= arc:
            low = half + 1
        else:
            high = half
    i = low - 1
    along = arc - arc_m[i]
    share = min(max(along / (arc_m[i + 1] - arc_m[i]), 0.0), 1.0)
    for k in range(3):
        point[p, k] = ecef_m[i, k] + along * segment[i, k]
        square = 0.0
        for c in range(3):
            axes[p, k, c] = (1.0 - share) * vertex_axes[i, k, c] + share * vertex_axes[i + 1, k, c]
            square += axes[p, k, c] * axes[p, k, c]
        square = math.sqrt(square)
        for c in range(3):
            axes[p, k, c] /= square


@kernel
def _ends(course: Course, now: float, before: float, point: Floats, axes: Floats, bend: Floats) -> None:
    """Points and axes now and at the epoch before, and the change of the tangent between to the right and up."""
    for end in range(2):
        arc = now if end == 0 else before
        _at(course.arc_m, course.ecef_m, course.axes, course.segment, arc, point, end, axes)
    for k in range(2):
        bend[k] = 0.0
        for c in range(3):
            bend[k] += (axes[0, 0, c] - axes[1, 0, c]) * axes[0, k + 1, c]


@kernel
def _roughened(spread: Floats, n: int, start_sigma_m: float, bend: Floats, h: int) -> None:
    """Add what the line bends by where the place is uncertain to the displacements across."""
    length = spread[h, n + _STEP_ALONG, n + _STEP_ALONG] - 1e-8
    vague = min(spread[h, _S, _S] - length, start_sigma_m**2)
    spread[h, n + _STEP_RIGHT, n + _STEP_RIGHT] += vague * bend[0] ** 2
    spread[h, n + _STEP_UP, n + _STEP_UP] += vague * bend[1] ** 2


@kernel
def _onto_line(mean: Floats, covariance: Floats, n: int, first_m: float, last_m: float, reach_m: float, h: int) -> None:
    """Put a place a little beyond an end of the line on it (`railfix.tracking.hypotheses.on_the_line`)."""
    excess = min(max(mean[h, _S], first_m), last_m) - mean[h, _S]
    variance = covariance[h, _S, _S]
    if abs(excess) > 2.0 * math.sqrt(variance) and abs(excess) <= reach_m:
        for c in range(n):
            mean[h, c] += covariance[h, c, _S] / variance * excess


@kernel
def _restart(spread: Floats, unknown: int, variance: float, h: int) -> None:
    """Make an unknown independent of all else."""
    for c in range(spread.shape[1]):
        spread[h, unknown, c] = 0.0
        spread[h, c, unknown] = 0.0
    spread[h, unknown, unknown] = variance


@kernel
def _gradient(middle_m: Floats, gradient: Floats, arc: float) -> float:
    """Gradient of the line, linear between the middles of segments."""
    low, high = 0, len(middle_m)
    while low < high:
        half = (low + high) // 2
        if middle_m[half] <= arc:
            low = half + 1
        else:
            high = half
    if low == 0:
        return float(gradient[0])
    if low == len(middle_m):
        return float(gradient[low - 1])
    share = (arc - middle_m[low - 1]) / (middle_m[low] - middle_m[low - 1])
    return float((1.0 - share) * gradient[low - 1] + share * gradient[low])


@kernel
def _inverse(matrix: Floats, m: int, size: int, factor: Floats, lower: Floats, result: Floats, to: int) -> float:
    """Write the inverse of a symmetric matrix (its upper half is read) by Cholesky; return log det of the matrix."""
    log_determinant = 0.0
    for i in range(size):
        for j in range(i, size):
            factor[i, j] = matrix[m, i, j]
    for k in range(size):
        pivot = math.sqrt(max(factor[k, k], 1e-300))
        log_determinant += math.log(pivot)
        for j in range(k, size):
            factor[k, j] /= pivot
        for i in range(k + 1, size):
            share = factor[k, i]
            for j in range(i, size):
                factor[i, j] -= share * factor[k, j]
    for k in range(size):
        pivot = 1.0 / factor[k, k]
        for i in range(k):
            lower[k, i] = 0.0
        for j in range(k):
            share = factor[j, k] * pivot
            for i in range(j + 1):
                lower[k, i] -= share * lower[j, i]
        lower[k, k] = pivot
        for i in range(k + 1):
            result[to, k, i] = 0.0
    # result = lower' lower, its lower half first
    for k in range(size):
        for i in range(k + 1):
            share = lower[k, i]
            for j in range(i + 1):
                result[to, i, j] += share * lower[k, j]
    for i in range(size):
        for j in range(i):
            result[to, j, i] = result[to, i, j]
    return 2.0 * log_determinant


@kernel
def _median(values: Floats, h: int, first: int, size: int, ordered: Floats) -> float:
    for i in range(size):
        value = values[h, first + i]
        j = i
        while j > 0 and ordered[j - 1] > value:
            ordered[j] = ordered[j - 1]
            j -= 1
        ordered[j] = value
    if size % 2:
        return float(ordered[size // 2])
    return float(0.5 * (ordered[size // 2 - 1] + ordered[size // 2]))


@kernel
def _predict(
    dt: float, steps: Floats, noises: Floats, singer: int, course: Course, numbers: Numbers, active: Active,
    mean: Floats, covariance: Floats, after: Floats, spread: Floats, rows: Floats, kept: Floats, h: int,
    to: int, map_log_scale: float
) -> None:
    """Write mean and covariance of the compact unknowns and of those of the epoch."""
    n = mean.shape[1]
    speed = abs(mean[h, _V])
    travel = speed * dt
    map_kept = math.exp(-travel / numbers.map_absolute_m)
    code_kept = math.exp(-dt / numbers.code_correlation_s - travel / numbers.code_correlation_m)
    doppler_kept = math.exp(-dt / numbers.doppler_correlation_s)
    slow_kept = math.exp(-dt / numbers.slow_code_s)
    for i in range(n):
        kept[i] = 1.0
    kept[_RIGHT] = kept[_UP] = map_kept
    kept[_W], kept[_Z] = doppler_kept, slow_kept
    for i in active.satellite:
        if i >= 0:
            kept[i] = code_kept
    for i in range(3, n):
        for j in range(n):
            rows[i, j] = kept[i] * covariance[h, i, j]
    for i in range(3):
        for j in range(n):
            rows[i, j] = (
                steps[singer, i, 0] * covariance[h, 0, j]
                + steps[singer, i, 1] * covariance[h, 1, j]
                + steps[singer, i, 2] * covariance[h, 2, j]
            )
    for j in range(n):
        rows[n + _OLD_S, j] = covariance[h, _S, j]
        rows[n + _OLD_V, j] = covariance[h, _V, j]
        rows[n + _PHASE, j] = dt * covariance[h, _D, j]
    for i in range(n + 3):
        for j in range(3, n):
            spread[to, i, j] = kept[j] * rows[i, j]
        for j in range(3):
            spread[to, i, j] = (
                steps[singer, j, 0] * rows[i, 0] + steps[singer, j, 1] * rows[i, 1] + steps[singer, j, 2] * rows[i, 2]
            )
        spread[to, i, n + _OLD_S] = rows[i, _S]
        spread[to, i, n + _OLD_V] = rows[i, _V]
        spread[to, i, n + _PHASE] = dt * rows[i, _D]
        for j in range(n + 3, n + _EPOCH):
            spread[to, i, j] = 0.0
            spread[to, j, i] = 0.0
    for i in range(n + 3, n + _EPOCH):
        for j in range(n + 3, n + _EPOCH):
            spread[to, i, j] = 0.0
    for i in range(3):
        for j in range(3):
            spread[to, i, j] += noises[singer, i, j]
    spread[to, _S, _S] += numbers.least_step_m2
    spread[to, _V, _V] += numbers.least_step_m2
    walk = numbers.clock_walk_mps**2
    spread[to, _D, _D] += walk * dt
    spread[to, n + _PHASE, n + _PHASE] += walk * dt**3 / 3.0 + 1e-6
    spread[to, n + _PHASE, _D] += walk * dt**2 / 2.0
    spread[to, _D, n + _PHASE] += walk * dt**2 / 2.0
    spread[to, _RIGHT, _RIGHT] += course.sigma_plan_m**2 * (1.0 - map_kept**2)
    spread[to, _UP, _UP] += course.sigma_height_m**2 * (1.0 - map_kept**2)
    spread[to, _Z, _Z] += numbers.slow_code_m**2 * (1.0 - slow_kept**2)
    lasting = numbers.doppler_error_mps + numbers.doppler_error_share * speed
    spread[to, _W, _W] += lasting**2 * (1.0 - doppler_kept**2)
    if active.wheel >= 0:
        spread[to, active.wheel, active.wheel] += numbers.wheel_walk**2 * dt
    if active.force >= 0:
        spread[to, active.force, active.force] += numbers.force_walk_mps2**2 * dt
    if active.radar >= 0:
        spread[to, active.radar, active.radar] += numbers.radar_walk**2 * dt
    for i in active.offset:
        if i >= 0:
            spread[to, i, i] += numbers.offset_walk_m**2 * dt
    for i in active.satellite:
        if i >= 0:
            spread[to, i, i] += 1.0 - code_kept**2
    for i in range(3, n):
        after[to, i] = kept[i] * mean[h, i]
    for i in range(3):
        after[to, i] = (
            steps[singer, i, 0] * mean[h, 0] + steps[singer, i, 1] * mean[h, 1] + steps[singer, i, 2] * mean[h, 2]
        )
    after[to, n + _OLD_S], after[to, n + _OLD_V], after[to, n + _PHASE] = mean[h, _S], mean[h, _V], dt * mean[h, _D]
    for i in range(n + 3, n + _EPOCH):
        after[to, i] = 0.0
    rough = 2.0 * numbers.map_roughness_m**2 * (1.0 - math.exp(-travel / numbers.map_correlation_m)) + 1e-8
    spread[to, n + _STEP_RIGHT, n + _STEP_RIGHT] = rough
    spread[to, n + _STEP_UP, n + _STEP_UP] = rough
    # The way on the map is the way run less the error of the length: what codes see of it, phases do not.
    length = numbers.map_scale_m**2 * math.exp(map_log_scale) * travel + numbers.phase_walk_m**2 * dt
    spread[to, _S, _S] += length
    spread[to, n + _STEP_ALONG, n + _STEP_ALONG] = length + 1e-8
    spread[to, _S, n + _STEP_ALONG] = spread[to, n + _STEP_ALONG, _S] = -length
    spread[to, n + _CODE, n + _CODE] = numbers.code_clock_sigma_m**2


@kernel
def _equations(
    epochs: Epochs, t: int, course: Course, active: Active, numbers: Numbers, mean: Floats, now: float, before: float,
    codes: Indices, phases: Indices, dopplers: Indices, counts: Indices, sensors: Indices, direction: float,
    sight: Floats, design: Floats, value: Floats, sensed: Floats, bend: Floats, point: Floats, axes: Floats, h: int
) -> None:
    """Write the equations of an epoch about a place.

    `design` has three coefficients on the axes for each code, four for each phase (way, clock, right, up) and Doppler
    (right, up, speed, drift). `sensed` has for each sensor the coefficients of S, old S, V, old V, of its own
    unknown and of the displacement along the map. `bend` gets the change of the tangent since the epoch before to the
    right and up.
    """
    n, dt = mean.shape[1] - _EPOCH, epochs.interval_s[t]
    nc, nph, nd, ns = counts[0], counts[1], counts[2], counts[3]
    _ends(course, now, before, point, axes, bend)
    moved, moved_before = mean[h, _S] - now, mean[h, n + _OLD_S] - before
    for k in range(epochs.has.shape[2]):
        if epochs.has[0, t, k] or epochs.has[1, t, k] or epochs.has[2, t, k]:
            dx = epochs.sat_ecef_m[t, k, 0] - point[0, 0]
            dy = epochs.sat_ecef_m[t, k, 1] - point[0, 1]
            dz = epochs.sat_ecef_m[t, k, 2] - point[0, 2]
            distance = math.sqrt(dx * dx + dy * dy + dz * dz)
            ux, uy, uz = dx / distance, dy / distance, dz / distance
            sight[k, 0] = distance + _TURN * (
                epochs.sat_ecef_m[t, k, 0] * point[0, 1] - epochs.sat_ecef_m[t, k, 1] * point[0, 0]
            )
            sight[k, 1], sight[k, 2], sight[k, 3] = ux, uy, uz
            for c in range(3):
                sight[k, 4 + c] = ux * axes[0, c, 0] + uy * axes[0, c, 1] + uz * axes[0, c, 2]
    for i in range(nc):
        k = codes[i]
        design[h, i, 0], design[h, i, 1], design[h, i, 2] = -sight[k, 4], -sight[k, 5], -sight[k, 6]
        rest = (
            design[h, i, 0] * (moved + mean[h, _Z]) + design[h, i, 1] * mean[h, _RIGHT] + design[h, i, 2] * mean[h, _UP]
        )
        rest += mean[h, active.offset[epochs.offset[k]]] + mean[h, n + _CODE]
        rest += epochs.code_sigma_m[t, k] * mean[h, active.satellite[epochs.slot[k]]]
        value[h, i] = epochs.measured[0, t, k] - sight[k, 0] - rest
    if nph:
        cx, cy, cz = point[0, 0] - point[1, 0], point[0, 1] - point[1, 1], point[0, 2] - point[1, 2]
        length = math.sqrt(cx * cx + cy * cy + cz * cz)
        if length > numbers.chord_m:
            sign = (1.0 if now >= before else -1.0) / length
            cx, cy, cz = sign * cx, sign * cy, sign * cz
        else:
            cx, cy, cz = axes[0, 0, 0], axes[0, 0, 1], axes[0, 0, 2]
        for j in range(nph):
            i, k = nc + j, phases[j]
            dx = epochs.before_ecef_m[t, k, 0] - point[1, 0]
            dy = epochs.before_ecef_m[t, k, 1] - point[1, 1]
            dz = epochs.before_ecef_m[t, k, 2] - point[1, 2]
            distance = math.sqrt(dx * dx + dy * dy + dz * dz) + _TURN * (
                epochs.before_ecef_m[t, k, 0] * point[1, 1] - epochs.before_ecef_m[t, k, 1] * point[1, 0]
            )
            gradient = -(sight[k, 1] * cx + sight[k, 2] * cy + sight[k, 3] * cz)
            design[h, i, 0], design[h, i, 1], design[h, i, 2], design[h, i, 3] = (
                gradient,
                1.0,
                -sight[k, 5],
                -sight[k, 6],
            )
            computed = sight[k, 0] - distance + gradient * (moved - moved_before)
            value[h, i] = epochs.measured[1, t, k] - computed - mean[h, n + _PHASE]
    for j in range(nd):
        i, k = nc + nph + j, dopplers[j]
        sx, sy = epochs.sat_ecef_m[t, k, 0], epochs.sat_ecef_m[t, k, 1]
        vx, vy, vz = (
            epochs.sat_velocity_mps[t, k, 0],
            epochs.sat_velocity_mps[t, k, 1],
            epochs.sat_velocity_mps[t, k, 2],
        )
        moving = sight[k, 1] * vx + sight[k, 2] * vy + sight[k, 3] * vz + _TURN * (vx * point[0, 1] - vy * point[0, 0])
        stretch = 1.0 + moving / SPEED_OF_LIGHT
        slope = (-sight[k, 4] + _TURN * (sx * axes[0, 0, 1] - sy * axes[0, 0, 0])) / stretch
        design[h, i, 0], design[h, i, 1], design[h, i, 2], design[h, i, 3] = (
            -sight[k, 5] / dt,
            -sight[k, 6] / dt,
            slope,
            1.0,
        )
        value[h, i] = epochs.measured[2, t, k] - (moving / stretch + slope * (mean[h, _V] + mean[h, _W]) + mean[h, _D])
    for j in range(ns):
        i, kind = nc + nph + nd + j, sensors[j]
        measured = epochs.sensor[t, kind]
        for c in range(6):
            sensed[h, j, c] = 0.0
        if kind in (_WHEEL_ROW, _RADAR_ROW):
            if kind == _WHEEL_ROW and epochs.unsigned:
                speed = mean[h, _V]
                measured *= math.copysign(1.0, speed) if abs(speed) > numbers.direction_mps else direction
            own = active.wheel if kind == _WHEEL_ROW else active.radar
            sensed[h, j, 0], sensed[h, j, 1], sensed[h, j, 4], sensed[h, j, 5] = 1.0, -1.0, -measured, 1.0
            value[h, i] = measured * (1.0 + mean[h, own]) - (mean[h, _S] - mean[h, n + _OLD_S])
        elif kind == _FORCE_ROW:
            slope = _gradient(course.middle_m, course.gradient, 0.5 * (mean[h, _S] + mean[h, n + _OLD_S]))
            gravity = numbers.gravity_mps2 * slope / math.sqrt(1.0 + slope**2)
            sensed[h, j, 2], sensed[h, j, 3], sensed[h, j, 4] = 1.0 / dt, -1.0 / dt, 1.0
            value[h, i] = measured - (mean[h, _V] - mean[h, n + _OLD_V]) / dt - gravity - mean[h, active.force]
        else:
            sensed[h, j, 0] = 1.0
            value[h, i] = measured - mean[h, _S]


@kernel
def _combine(
    offset: Indices, slot: Indices, code_sigma_m: Floats, t: int, active: Active, floor: float, spread: Floats,
    codes: Indices, counts: Indices, sensors: Indices, design: Floats, sensed: Floats, variance: Floats, cross: Floats,
    root: Floats, own: Floats, place: Indices, share: Floats, h: int
) -> None:
    """Write the covariance of the combinations with the unknowns and with each other, in their standard deviations.

    `place` and `share` are work space: the unknowns of each combination and their coefficients.
    """
    nc, ns = counts[0], counts[3]
    width = spread.shape[1]
    n = width - _EPOCH
    size = nc + _MOTION + ns
    for i in range(size):
        for k in range(6):
            place[i, k], share[i, k] = 0, 0.0
    for i in range(nc):
        k = codes[i]
        place[i, 0], share[i, 0] = _S, design[h, i, 0]
        place[i, 1], share[i, 1] = _Z, design[h, i, 0]
        place[i, 2], share[i, 2] = _RIGHT, design[h, i, 1]
        place[i, 3], share[i, 3] = _UP, design[h, i, 2]
        place[i, 4], share[i, 4] = active.offset[offset[k]], 1.0
        place[i, 5], share[i, 5] = active.satellite[slot[k]], code_sigma_m[t, k]
    place[nc, 0], share[nc, 0] = n + _CODE, 1.0
    place[nc + _WAY, 0], share[nc + _WAY, 0] = _S, 1.0
    place[nc + _WAY, 1], share[nc + _WAY, 1] = n + _OLD_S, -1.0
    place[nc + _WAY, 2], share[nc + _WAY, 2] = n + _STEP_ALONG, 1.0
    place[nc + _CLOCK, 0], share[nc + _CLOCK, 0] = n + _PHASE, 1.0
    place[nc + _Q_RIGHT, 0], share[nc + _Q_RIGHT, 0] = n + _STEP_RIGHT, 1.0
    place[nc + _Q_UP, 0], share[nc + _Q_UP, 0] = n + _STEP_UP, 1.0
    place[nc + _SPEED, 0], share[nc + _SPEED, 0] = _V, 1.0
    place[nc + _SPEED, 1], share[nc + _SPEED, 1] = _W, 1.0
    place[nc + _DRIFT, 0], share[nc + _DRIFT, 0] = _D, 1.0
    for j in range(ns):
        i = nc + _MOTION + j
        place[i, 0], share[i, 0] = _S, sensed[h, j, 0]
        place[i, 1], share[i, 1] = n + _OLD_S, sensed[h, j, 1]
        place[i, 2], share[i, 2] = _V, sensed[h, j, 2]
        place[i, 3], share[i, 3] = n + _OLD_V, sensed[h, j, 3]
        if sensors[j] == _WHEEL_ROW:
            place[i, 4] = active.wheel
        elif sensors[j] == _RADAR_ROW:
            place[i, 4] = active.radar
        elif sensors[j] == _FORCE_ROW:
            place[i, 4] = active.force
        share[i, 4] = sensed[h, j, 4]
        place[i, 5], share[i, 5] = n + _STEP_ALONG, sensed[h, j, 5]
    for i in range(size):
        for c in range(width):
            cross[h, i, c] = 0.0
        for k in range(6):
            coefficient = share[i, k]
            if coefficient != 0.0:
                row = place[i, k]
                for c in range(width):
                    cross[h, i, c] += coefficient * spread[h, row, c]
    for i in range(size):
        for j in range(i, size):
            total = 0.0
            for k in range(6):
                total += share[j, k] * cross[h, i, place[j, k]]
            own[h, i, j] = total
    rows = nc + counts[1] + counts[2]
    for j in range(ns):
        own[h, nc + _MOTION + j, nc + _MOTION + j] += floor * variance[rows + j]
    for i in range(size):
        root[h, i] = math.sqrt(own[h, i, i])
    for i in range(size):
        for j in range(i + 1, size):
            own[h, i, j] /= root[h, i] * root[h, j]
            own[h, j, i] = own[h, i, j]
        own[h, i, i] = 1.0
        for c in range(width):
            cross[h, i, c] /= root[h, i]


@kernel
def _weight(square: float, late: bool, degrees: tuple[float, float]) -> float:
    """Weight of a measurement by its square over its variance: `railfix.tracking.robust.Tails`."""
    own = degrees[1] if late else degrees[0]
    return (degrees[0] + 1.0) / degrees[0] * own / (own + square)


@kernel
def _first_weights(
    counts: Indices, design: Floats, value: Floats, variance: Floats, root: Floats, own: Floats,
    degrees: tuple[float, float], freedom_place: float, freedom_speed: float, sensed: Floats, weight: Floats,
    ordered: Floats, h: int, to: int
) -> None:
    """Weights from innovations, without what clocks take up."""
    nc, nph, nd, ns = counts[0], counts[1], counts[2], counts[3]
    part = np.zeros(4)
    first = 0
    for kind in range(3):
        size = counts[kind]
        if size == 0:
            continue
        middle = _median(value, h, first, size, ordered)
        for i in range(first, first + size):
            if kind == 0:
                spread = root[h, i] * root[h, i] + design[h, i, 0] ** 2 * freedom_place
            else:
                base = nc + _WAY if kind == 1 else nc + _Q_RIGHT
                for c in range(4):
                    part[c] = design[h, i, c] * root[h, base + c]
                part[1 if kind == 1 else 3] = 0.0
                spread = 0.0
                for c in range(4):
                    for e in range(4):
                        spread += part[c] * own[h, base + c, base + e] * part[e]
                spread += design[h, i, 0] ** 2 * freedom_place if kind == 1 else design[h, i, 2] ** 2 * freedom_speed
            away = value[h, i] - middle
            weight[to, i] = _weight(away * away / (spread + variance[i]), away > 0.0 and kind == 0, degrees)
        first += size
    for j in range(ns):
        i = nc + nph + nd + j
        spread = (
            root[h, nc + _MOTION + j] ** 2 + sensed[h, j, 0] ** 2 * freedom_place + sensed[h, j, 2] ** 2 * freedom_speed
        )
        weight[to, i] = _weight(value[h, i] * value[h, i] / (spread + variance[i]), False, degrees)


@kernel
def _rounds(
    counts: Indices, design: Floats, value: Floats, variance: Floats, root: Floats, information: Floats,
    degrees: tuple[float, float], passes: int, change: Floats, after: Floats, weight: Floats, residual: Floats,
    spread: Floats, system: Floats, factor: Floats, lower: Floats, right: Floats, h: int, by: int, to: int
) -> float:
    """Rounds of reweighting; return log det of the covariance of the combinations after the epoch."""
    nc, nph, nd, ns = counts[0], counts[1], counts[2], counts[3]
    size, rows = nc + _MOTION + ns, nc + nph + nd
    log_determinant = 0.0
    clock = root[h, nc]
    part = np.empty(4)
    for turn in range(passes):
        for i in range(size):
            right[i] = 0.0
            for j in range(i, size):
                system[to, i, j] = information[by, i, j]
        for i in range(nc):
            w = weight[to, i] / variance[i]
            a = root[h, i] * w
            system[to, i, i] += a * root[h, i]
            system[to, i, nc] += a * clock
            system[to, nc, nc] += w * clock * clock
            right[i] += a * value[h, i]
            right[nc] += w * clock * value[h, i]
        for i in range(nc, rows):
            base = nc + _WAY if i < nc + nph else nc + _Q_RIGHT
            w = weight[to, i] / variance[i]
            for c in range(4):
                part[c] = design[h, i, c] * root[h, base + c]
            for c in range(4):
                a = w * part[c]
                right[base + c] += a * value[h, i]
                for e in range(c, 4):
                    system[to, base + c, base + e] += a * part[e]
        for j in range(ns):
            i, k = rows + j, nc + _MOTION + j
            a = root[h, k] * weight[to, i] / variance[i]
            system[to, k, k] += a * root[h, k]
            right[k] += a * value[h, i]
        log_determinant = -_inverse(system, to, size, factor, lower, after, to)
        for i in range(size):
            total = 0.0
            for j in range(size):
                total += after[to, i, j] * right[j]
            change[to, i] = total
        for i in range(nc):
            residual[to, i] = value[h, i] - root[h, i] * change[to, i] - clock * change[to, nc]
            spread[to, i] = (
                root[h, i] * root[h, i] * after[to, i, i]
                + 2.0 * root[h, i] * clock * after[to, i, nc]
                + clock * clock * after[to, nc, nc]
            )
        for i in range(nc, rows):
            base = nc + _WAY if i < nc + nph else nc + _Q_RIGHT
            fitted, square = 0.0, 0.0
            for c in range(4):
                part[c] = design[h, i, c] * root[h, base + c]
                fitted += part[c] * change[to, base + c]
            for c in range(4):
                for e in range(4):
                    square += part[c] * part[e] * after[to, base + c, base + e]
            residual[to, i] = value[h, i] - fitted
            spread[to, i] = square
        for j in range(ns):
            i, k = rows + j, nc + _MOTION + j
            residual[to, i] = value[h, i] - root[h, k] * change[to, k]
            spread[to, i] = root[h, k] * root[h, k] * after[to, k, k]
        if turn < passes - 1:
            for i in range(rows + ns):
                square = (residual[to, i] ** 2 + spread[to, i]) / variance[i]
                weight[to, i] = _weight(square, residual[to, i] > 0.0 and i < nc, degrees)
    return log_determinant


@kernel
def _code_shift(
    nc: int, design: Floats, value: Floats, variance: Floats, root: Floats, own: Floats, weight: Floats, clipped: float,
    h: int, system: Floats, factor: Floats, lower: Floats, inverse: Floats
) -> float:
    """Shift of the place that the codes ask for over its standard deviation (`railfix.tracking.misfit`)."""
    clock = root[h, nc]
    for i in range(nc):
        for j in range(i, nc):
            system[h, i, j] = (
                root[h, i] * root[h, j] * own[h, i, j]
                + clock * (root[h, i] * own[h, i, nc] + root[h, j] * own[h, j, nc])
                + clock * clock
            )
        system[h, i, i] += variance[i] / min(weight[h, i], 1.0)
    _inverse(system, h, nc, factor, lower, inverse, h)
    score, information = 0.0, 0.0
    for i in range(nc):
        for j in range(nc):
            part = design[h, i, 0] * inverse[h, i, j]
            score += part * value[h, j]
            information += part * design[h, j, 0]
    if not information > 0.0:
        return 0.0
    return float(min(max(score / math.sqrt(information), -clipped), clipped))


@kernel
def _learn_map(scalars: Floats, shift: float, dt: float, numbers: Numbers) -> None:
    """Take an epoch's shift into the running mean, and raise or lower the error of the map's lengths."""
    dt = min(dt, 1.0)
    share = 1.0 - math.exp(-dt / numbers.map_misfit_s)
    mean = (1.0 - share) * scalars[_SHIFT] + share * shift
    variance = (1.0 - share) ** 2 * scalars[_SHIFT_VARIANCE] + share**2
    scalars[_SHIFT], scalars[_SHIFT_VARIANCE] = mean, variance
    beyond = abs(mean) / (math.sqrt(variance) * numbers.map_misfit_sigmas)
    scale = scalars[_MAP_SCALE] * math.exp(-dt / numbers.map_misfit_kept_s)
    if beyond > 1.0:
        scale += 2.0 * math.log(beyond) * dt / numbers.misfit_learnt_s
    scalars[_MAP_SCALE] = min(scale, numbers.misfit_largest)


@kernel
def _evidence(
    rows: int, nc: int, size: int, residual: Floats, variance: Floats, change: Floats, information: Floats,
    log_after: float, log_before: float, degrees: tuple[float, float], h: int, to: int
) -> float:
    usual, late = degrees
    fit = 0.0
    for i in range(rows):
        own = late if i < nc and residual[to, i] > 0.0 else usual
        fit += own * math.log1p(residual[to, i] ** 2 / (own * variance[i]))
    away = 0.0
    for i in range(size):
        total = 0.0
        for j in range(size):
            total += information[h, i, j] * change[to, j]
        away += change[to, i] * total
    return float(-0.5 * (usual + 1.0) / usual * fit - 0.5 * away + 0.5 * (log_after - log_before))


@kernel
def _apply(
    size: int, n: int, mean: Floats, spread: Floats, cross: Floats, own: Floats, information: Floats, after: Floats,
    change: Floats, gain: Floats, less: Floats, new_mean: Floats, new_covariance: Floats, h: int
) -> None:
    """Write mean and covariance of the compact unknowns after the epoch, and behind them the mean of the old place."""
    for i in range(size):
        for c in range(n + 1):
            gain[i, c] = 0.0
        for j in range(size):
            share = information[h, i, j]
            for c in range(n + 1):
                gain[i, c] += share * cross[h, j, c]
    for i in range(size):
        for c in range(n):
            less[i, c] = 0.0
        for j in range(size):
            share = own[h, i, j] - after[h, i, j]
            for c in range(n):
                less[i, c] += share * gain[j, c]
    for c in range(n + 1):
        new_mean[h, c] = mean[h, c]
    for i in range(size):
        for c in range(n + 1):
            new_mean[h, c] += gain[i, c] * change[h, i]
    for c in range(n):
        for e in range(c + 1):
            new_covariance[h, c, e] = spread[h, c, e]
    for i in range(size):
        for c in range(n):
            share = gain[i, c]
            for e in range(c + 1):
                new_covariance[h, c, e] -= share * less[i, e]
    for c in range(n):
        for e in range(c):
            new_covariance[h, e, c] = new_covariance[h, c, e]


@kernel
def _log_sum(values: Floats, size: int) -> float:
    largest = values[0]
    for i in range(1, size):
        largest = max(largest, values[i])
    total = 0.0
    for i in range(size):
        total += math.exp(values[i] - largest)
    return float(largest + math.log(total))


@kernel
def _most_probable(values: Floats, size: int, switch: float) -> int:
    best = 0
    for i in range(1, size):
        if values[i] > values[best]:
            best = i
    return best if values[best] > values[0] + math.log(switch) else 0


@kernel
def _surviving(
    mean: Floats, covariance: Floats, log_probability: Floats, origin: Floats, count: int, numbers: Numbers,
    work_mean: Floats, work_covariance: Floats, work: Floats, ranked: Indices, kept: Indices
) -> int:
    """Order the hypotheses, join twins, drop the improbable; return how many are left."""
    n = mean.shape[1]
    first = _most_probable(log_probability, count, numbers.switch)
    ranked[0] = first
    for k in range(count):
        if k == first:
            continue
        j = k if k > first else k + 1
        while j > 1 and log_probability[ranked[j - 1]] < log_probability[k]:
            ranked[j] = ranked[j - 1]
            j -= 1
        ranked[j] = k
    size = 0
    for k in range(count):
        work[0, k], work[1, k] = log_probability[k], origin[k]
    for r in range(count):
        k, twin = ranked[r], -1
        for j in range(size):
            other = kept[j]
            reach = max(2.0, math.sqrt(covariance[k, _S, _S]) + math.sqrt(covariance[other, _S, _S]))
            if abs(mean[k, _S] - mean[other, _S]) < reach:
                twin = other
                break
        if twin < 0:
            kept[size] = k
            size += 1
        else:
            one, two = max(work[0, twin], work[0, k]), min(work[0, twin], work[0, k])
            work[0, twin] = one + math.log1p(math.exp(two - one))
    size = min(size, numbers.most_hypotheses)
    for j in range(size):
        log_probability[j] = work[0, kept[j]]
    total = _log_sum(log_probability, size)
    for j in range(size):
        log_probability[j] -= total
    if abs(mean[kept[0], _S] - origin[kept[0]]) >= numbers.decided_travel_m:
        alive = 0
        for j in range(size):
            if log_probability[j] > math.log(numbers.least_probability):
                kept[alive], log_probability[alive] = kept[j], log_probability[j]
                alive += 1
        size = alive
        total = _log_sum(log_probability, size)
        for j in range(size):
            log_probability[j] -= total
    for j in range(size):
        k = kept[j]
        origin[j] = work[1, k]
        for c in range(n):
            work_mean[j, c] = mean[k, c]
            for e in range(n):
                work_covariance[j, c, e] = covariance[k, c, e]
    for j in range(size):
        for c in range(n):
            mean[j, c] = work_mean[j, c]
            for e in range(n):
                covariance[j, c, e] = work_covariance[j, c, e]
    return size


@kernel
def _sensor_values(active: Active, work: Work, gnss: int, ns: int, sensors: Indices, best: int, h: int) -> None:
    """Take over the equations of the sensors, about another mean, `work.mean[h]`."""
    mean, sensed = work.mean, work.sensed
    n = mean.shape[1] - _EPOCH
    place, speed = mean[h, _S] - mean[best, _S], mean[h, _V] - mean[best, _V]
    old, old_speed = mean[h, n + _OLD_S] - mean[best, n + _OLD_S], mean[h, n + _OLD_V] - mean[best, n + _OLD_V]
    for j in range(ns):
        i, kind = gnss + j, sensors[j]
        own = 0.0
        if kind == _WHEEL_ROW:
            own = mean[h, active.wheel] - mean[best, active.wheel]
        elif kind == _RADAR_ROW:
            own = mean[h, active.radar] - mean[best, active.radar]
        elif kind == _FORCE_ROW:
            own = mean[h, active.force] - mean[best, active.force]
        for c in range(6):
            sensed[h, j, c] = sensed[best, j, c]
        work.value[h, i] = work.value[best, i] - (
            sensed[best, j, 0] * place + sensed[best, j, 1] * old + sensed[best, j, 2] * speed
            + sensed[best, j, 3] * old_speed + sensed[best, j, 4] * own
        )


@kernel
def _subfilters(
    epochs: Epochs, t: int, course: Course, numbers: Numbers, active: Active, bank: Subfilters, work: Work,
    variance: Floats, counts: Indices, codes: Indices, phases: Indices, dopplers: Indices, sensors: Indices,
    sight: Floats, anew: Masks, best: int, h: int, map_log_scale: float
) -> None:
    """Do an epoch of all sub-filters (`railfix.tracking.bank.levelled`); `best` has the equations, `h` is free."""
    mean, spread = work.mean, work.spread
    width = mean.shape[1]
    n = width - _EPOCH
    nc, nph, nd, ns = counts[0], counts[1], counts[2], counts[3]
    gnss, size, dt = nc + nph + nd, nc + _MOTION + ns, epochs.interval_s[t]
    slots, sources = len(active.satellite), len(bank.running)
    clocks = sources - _SENSORS - slots
    source = np.zeros(sources, dtype=np.bool_)
    several = 0
    for i in range(nc):
        clock = slots + epochs.offset[codes[i]]
        several += not source[clock]
        source[clock] = True
    for k in range(clocks):
        source[slots + k] = source[slots + k] and several > 1
    for k in range(epochs.has.shape[2]):
        if epochs.has[0, t, k] or epochs.has[1, t, k] or epochs.has[2, t, k]:
            source[epochs.slot[k]] = True
    for j in range(ns):
        source[slots + clocks + sensors[j]] = True
    met = np.zeros(sources, dtype=np.bool_)
    for k in range(slots):
        if epochs.remembered[t, k]:
            met[slots + bank.clock[k]] = True
            source[k] = source[k] or best > 0
    before = False
    for b in range(sources):
        before = before or bank.running[b]
    before = before and not best
    masked = np.empty(len(variance))
    for b in range(sources):
        satellite = b < slots
        if best or (satellite and not epochs.remembered[t, b]):
            bank.running[b] = False
        if bank.running[b] and bank.weak_s[b] >= numbers.lost_motion_s:
            bank.running[b], met[b] = False, True
        if bank.running[b]:
            _predict(
                dt, epochs.step, epochs.noise, epochs.singer[t], course, numbers, active, bank.mean, bank.covariance,
                mean, spread, work.rows, work.kept, b, h, map_log_scale,
            )
            _ends(course, mean[h, _S], mean[h, n + _OLD_S], work.point, work.axes, work.bend)
            _roughened(spread, n, numbers.start_sigma_m, work.bend, h)
            sigma = math.sqrt(spread[h, _S, _S])
            near = abs(mean[h, _S] - mean[best, _S]) < numbers.joined * sigma
            near = near and sigma < (1.0 + numbers.joined) * math.sqrt(spread[best, _S, _S])
            if near and satellite and not source[b]:
                bank.running[b] = False
                continue
        elif source[b] and bank.prior[b] > 0.0:
            bank.running[b], bank.weak_s[b] = True, 0.0
            copied = before and not met[b]
            for c in range(width):
                mean[h, c] = mean[best, c] if copied else 0.0
                for e in range(width):
                    spread[h, c, e] = spread[best, c, e] if copied else 0.0
                if not copied:
                    spread[h, c, c] = bank.begun[c]
            if not copied:
                mean[h, _S] = mean[h, n + _OLD_S] = mean[best, _S]
        else:
            continue
        for kind in range(2):
            if anew[best, kind]:
                unknown = n + _PHASE if kind == 0 else _D
                mean[h, unknown] = mean[best, unknown]
                _restart(spread, unknown, numbers.unknown_clock**2, h)
        mean[h, n + _CODE] = mean[best, n + _CODE]
        for i in range(gnss):
            k = codes[i] if i < nc else (phases[i - nc] if i < nc + nph else dopplers[i - nc - nph])
            own = epochs.slot[k] if satellite else slots + epochs.offset[k]
            masked[i] = math.inf if own == b else variance[i]
        for j in range(ns):
            masked[gnss + j] = math.inf if slots + clocks + sensors[j] == b else variance[gnss + j]
        _equations(
            epochs, t, course, active, numbers, mean, mean[h, _S], mean[h, n + _OLD_S], codes, phases, dopplers, counts,
            sensors, 1.0, sight, work.design, work.value, work.sensed, work.bend, work.point, work.axes, h
        )
        _sensor_values(active, work, gnss, ns, sensors, best, h)
        _combine(
            epochs.offset, epochs.slot, epochs.code_sigma_m, t, active, numbers.sensor_floor, spread, codes, counts,
            sensors, work.design, work.sensed, variance, work.cross, work.root, work.own, work.place, work.share, h
        )
        _inverse(work.own, h, size, work.factor, work.lower, work.information, h)
        _first_weights(
            counts, work.design, work.value, masked, work.root, work.own, numbers.degrees, 0.0, 0.0, work.sensed,
            work.weight, work.ordered, h, h,
        )
        _rounds(
            counts, work.design, work.value, masked, work.root, work.information, numbers.degrees,
            numbers.level_passes, work.change, work.after, work.weight, work.residual, work.fitted, work.system,
            work.factor, work.lower, work.right, h, h, h,
        )
        weak = False
        for part in range(2):
            first, last = (0, nc) if part == 0 else (nc, gnss)
            total, used = 0.0, 0
            for i in range(first, last):
                if masked[i] < math.inf:
                    total += work.weight[h, i]
                    used += 1
            least = numbers.lost_code_weight if part == 0 else numbers.lost_motion_weight
            weak = weak or (used > 0 and total < least * used)
        bank.weak_s[b] = bank.weak_s[b] + dt if weak else 0.0
        _apply(
            size, n, mean, spread, work.cross, work.own, work.information, work.after, work.change, work.gain,
            work.less, work.new_mean, work.new_covariance, h,
        )
        _onto_line(work.new_mean, work.new_covariance, n, course.start_m, course.end_m, numbers.start_sigma_m, h)
        for c in range(n):
            bank.mean[b, c] = work.new_mean[h, c]
            for e in range(n):
                bank.covariance[b, c, e] = work.new_covariance[h, c, e]


@kernel
def _level(place: float, sigma: float, bank: Subfilters, numbers: Numbers, answers: Answers, t: int) -> float:
    """Return the level of a place, write its parts (`railfix.tracking.bank.level_m`)."""
    noise, apart = numbers.level_k * sigma, math.nan
    level, contradicted = noise, False
    for b in range(len(bank.running)):
        if bank.running[b]:
            contradicted = contradicted or bank.weak_s[b] > 0.0
            away = abs(bank.mean[b, _S] - place)
            apart = away if math.isnan(apart) else max(apart, away)
            level = max(level, away + bank.k[b] * math.sqrt(bank.covariance[b, _S, _S]))
    answers.level_noise_m[t], answers.separation_m[t] = noise, apart
    if math.isnan(apart) or contradicted:
        return math.inf
    for _ in range(numbers.rounds):
        away = level / sigma
        spent = math.erfc(away / math.sqrt(2.0))
        slope = 2.0 * math.exp(-0.5 * away * away) / sigma
        for b in range(len(bank.running)):
            if bank.running[b]:
                own = math.sqrt(bank.covariance[b, _S, _S])
                for side in (-1.0, 1.0):
                    away = (level + side * abs(bank.mean[b, _S] - place)) / own
                    spent += bank.prior[b] * 0.5 * math.erfc(away / math.sqrt(2.0))
                    slope += bank.prior[b] * math.exp(-0.5 * away * away) / own
        slope /= math.sqrt(2.0 * math.pi)
        step = spent / slope * math.log(spent / numbers.level_risk)
        level += step
        if abs(step) < numbers.precision_m:
            break
    return level


@kernel
def _finish(
    t: int, best: int, aided: bool, measured: bool, dt: float, numbers: Numbers, active: Active, memory: Memory,
    bank: Subfilters, answers: Answers, work_mean: Floats, work_covariance: Floats, work: Floats, ranked: Indices,
    kept: Indices
) -> None:
    """End an epoch: direction, way without codes, hypotheses to go on with; write its answer."""
    scalars = memory.scalars
    count = int(scalars[_HYPOTHESES])
    speed = memory.mean[best, _V]
    if abs(speed) > numbers.direction_mps:
        scalars[_DIRECTION] = math.copysign(1.0, speed)
    scalars[_UNAIDED] = 0.0 if aided else scalars[_UNAIDED] + abs(speed) * dt
    if count > 1:
        count = _surviving(
            memory.mean, memory.covariance, memory.log_probability, memory.origin_m, count, numbers, work_mean,
            work_covariance, work, ranked, kept,
        )
        scalars[_HYPOTHESES] = count
    probability = math.exp(memory.log_probability[0])
    sigma = math.sqrt(memory.covariance[0, _S, _S])
    answers.hypotheses[t], answers.probability[t] = count, probability
    if sigma > numbers.expired_sigma_m:
        answers.status[t] = numbers.expired
        return
    answers.arc_m[t], answers.sigma_m[t] = memory.mean[0, _S], sigma
    answers.speed_mps[t] = memory.mean[0, _V]
    answers.speed_sigma_mps[t] = math.sqrt(memory.covariance[0, _V, _V])
    answers.acceleration_mps2[t] = memory.mean[0, _A]
    if active.wheel >= 0:
        answers.wheel_scale[t] = memory.mean[0, active.wheel]
    if active.force >= 0:
        answers.force_offset_mps2[t] = memory.mean[0, active.force]
    if active.radar >= 0:
        answers.radar_scale[t] = memory.mean[0, active.radar]
    answers.map_scale[t] = math.exp(0.5 * scalars[_MAP_SCALE])
    if len(bank.running):
        level = _level(memory.mean[0, _S], sigma, bank, numbers, answers, t)
        # Contradicted by its measurements the track itself is in doubt, which no sub-filter beside it bounds.
        doubtful = answers.code_weight[t] < numbers.lost_code_weight
        if doubtful or answers.motion_weight[t] < numbers.lost_motion_weight:
            level = math.inf
        answers.level_m[t] = level
        answers.amount_m[t] = max(level, numbers.scale_bound * scalars[_UNAIDED])
    if measured:
        answers.status[t] = numbers.tracking if probability >= numbers.decided else numbers.several
    else:
        answers.status[t] = numbers.coasting


@kernel
def advance(
    epochs: Epochs, course: Course, numbers: Numbers, active: Active, memory: Memory, bank: Subfilters,
    answers: Answers, first: int, last: int
) -> int:
    """Do epochs from `first` on; return the first that is left to numpy, or `last`."""
    scalars = memory.scalars
    channels = epochs.has.shape[2]
    n = memory.mean.shape[1]
    width = n + _EPOCH
    largest, most_rows = channels + _MOTION + _SENSORS, 3 * channels + _SENSORS
    room = len(memory.log_probability)
    mean, spread = np.empty((room + 1, width)), np.empty((room + 1, width, width))
    design, value = np.empty((room + 1, most_rows, 4)), np.empty((room + 1, most_rows))
    innovation = np.empty((room, most_rows))
    sensed, variance = np.empty((room + 1, _SENSORS, 6)), np.empty(most_rows)
    cross, root = np.empty((room + 1, largest, width)), np.empty((room + 1, largest))
    own, information = np.empty((room + 1, largest, largest)), np.empty((room + 1, largest, largest))
    after, change = np.empty((room + 1, largest, largest)), np.empty((room + 1, largest))
    weight, residual = np.empty((room + 1, most_rows)), np.empty((room + 1, most_rows))
    fitted = np.empty((room + 1, most_rows))
    new_mean, new_covariance = np.empty((room + 1, n + 1)), np.empty((room + 1, n, n))
    log_after, log_before, evidence = np.empty(room), np.empty(room), np.empty(room)
    now, before = np.empty(room), np.empty(room)
    system = np.empty((room + 1, largest, largest))
    factor, lower = np.empty((largest, largest)), np.empty((largest, largest))
    right, ordered = np.empty(largest), np.empty(most_rows)
    gain, less = np.empty((largest, n + 1)), np.empty((largest, n))
    rows_work, kept = np.empty((width, n)), np.empty(n)
    place, share = np.empty((largest, 6), dtype=np.int64), np.empty((largest, 6))
    sight, bend = np.empty((channels, 7)), np.empty(2)
    codes, phases = np.empty(channels, dtype=np.int64), np.empty(channels, dtype=np.int64)
    dopplers, sensors = np.empty(channels, dtype=np.int64), np.empty(_SENSORS, dtype=np.int64)
    counts = np.zeros(4, dtype=np.int64)
    points, axes = np.empty((room, 3)), np.empty((room, 3, 3))
    point, two_axes = np.empty((2, 3)), np.empty((2, 3, 3))
    work, ranked, kept_ones = np.empty((2, room)), np.empty(room, dtype=np.int64), np.empty(room, dtype=np.int64)
    anew = np.zeros((room, 2), dtype=np.bool_)
    shared = Work(
        mean, spread, design, value, sensed, cross, root, own, information, after, change, weight, residual, fitted,
        new_mean, new_covariance, system, factor, lower, right, ordered, gain, less, rows_work, kept, place, share,
        point, two_axes, bend,
    )
    degrees, passes = numbers.degrees, numbers.passes

    done = first
    for t in range(first, last):
        count = int(scalars[_HYPOTHESES])
        if epochs.left[t]:
            break
        if scalars[_WEAK_MOTION] >= numbers.lost_motion_s or scalars[_WEAK_CODE] >= numbers.lost_code_s:
            break
        if scalars[_WEAK_MOTION] > 0.0 and count <= numbers.most_hypotheses // 2:
            break
        # Beyond an end of a closed line numpy lets places go on where it closes.
        beyond = False
        for h in range(count):
            beyond = beyond or (memory.mean[h, _S] < course.arc_m[0] and course.start_m == -math.inf)
            beyond = beyond or (memory.mean[h, _S] > course.arc_m[-1] and course.end_m == math.inf)
        if beyond:
            break
        for kind in range(4):
            counts[kind] = 0
        known = True
        for k in range(channels):
            if epochs.has[0, t, k]:
                known = known and memory.offset_known[epochs.offset[k]]
                codes[counts[0]] = k
                counts[0] += 1
            if epochs.has[1, t, k]:
                phases[counts[1]] = k
                counts[1] += 1
            if epochs.has[2, t, k]:
                dopplers[counts[2]] = k
                counts[2] += 1
        # After a gap numpy seeks places, if there are codes to seek them with.
        if not known or (counts[0] > 0 and epochs.time_s[t] - scalars[_MEASURED] > numbers.gap_s):
            break
        nc, nph, nd = counts[0], counts[1], counts[2]
        gnss = nc + nph + nd
        for i in range(epochs.fresh.shape[1]):
            if epochs.fresh[t, i]:
                k = active.satellite[i]
                for h in range(count):
                    memory.mean[h, k] = 0.0
                    _restart(memory.covariance, k, 1.0, h)
                for b in range(len(bank.running)):
                    if bank.running[b]:
                        bank.mean[b, k] = 0.0
                        _restart(bank.covariance, k, 1.0, b)
        for h in range(count):
            _predict(
                epochs.interval_s[t], epochs.step, epochs.noise, epochs.singer[t], course, numbers, active, memory.mean,
                memory.covariance, mean, spread, rows_work, kept, h, h, scalars[_MAP_SCALE],
            )
        for kind in range(_SENSORS):
            if not math.isfinite(epochs.sensor[t, kind]):
                continue
            if kind == _WHEEL_ROW and epochs.unsigned and scalars[_DIRECTION] == 0.0:
                known = True
                for h in range(count):
                    known = known and abs(mean[h, _V]) > numbers.direction_mps
                if not known:
                    continue
            sensors[counts[3]] = kind
            counts[3] += 1
        ns = counts[3]
        rows, size = gnss + ns, nc + _MOTION + ns
        if rows == 0:
            for h in range(count):
                for c in range(n):
                    memory.mean[h, c] = mean[h, c]
                    for e in range(n):
                        memory.covariance[h, c, e] = spread[h, c, e]
            for b in range(len(bank.running)):
                if bank.running[b]:
                    _predict(
                        epochs.interval_s[t], epochs.step, epochs.noise, epochs.singer[t], course, numbers, active,
                        bank.mean, bank.covariance, mean, spread, rows_work, kept, b, room, scalars[_MAP_SCALE],
                    )
                    for c in range(n):
                        bank.mean[b, c] = mean[room, c]
                        for e in range(n):
                            bank.covariance[b, c, e] = spread[room, c, e]
            best = _most_probable(memory.log_probability, count, numbers.switch)
            _finish(
                t, best, False, False, epochs.interval_s[t], numbers, active, memory, bank, answers, new_mean,
                new_covariance, work, ranked, kept_ones,
            )
            done = t + 1
            continue
        for i in range(nc):
            variance[i] = epochs.variance[0, t, codes[i]]
        for i in range(nph):
            variance[nc + i] = epochs.variance[1, t, phases[i]] * math.exp(scalars[_SCALE_PHASE])
        for i in range(nd):
            variance[nc + nph + i] = epochs.variance[2, t, dopplers[i]] * math.exp(scalars[_SCALE_DOPPLER])
        for j in range(ns):
            variance[gnss + j] = epochs.sensor_sigma[t, sensors[j]] ** 2

        doubtful, shift, map_scale = False, 0.0, scalars[_MAP_SCALE]
        going = _most_probable(memory.log_probability, count, numbers.switch)
        for h in range(count):
            now[h], before[h] = mean[h, _S], mean[h, n + _OLD_S]
            _equations(
                epochs, t, course, active, numbers, mean, now[h], before[h], codes, phases, dopplers, counts, sensors,
                scalars[_DIRECTION], sight, design, value, sensed, bend, point, two_axes, h
            )
            _roughened(spread, n, numbers.start_sigma_m, bend, h)
            anew[h, 0] = anew[h, 1] = False
            begin, end = 0, nc
            for kind in range(3):
                if end > begin:
                    middle = _median(value, h, begin, end - begin, ordered)
                    unknown = n + _CODE if kind == 0 else (n + _PHASE if kind == 1 else _D)
                    own_variance = spread[h, unknown, unknown]
                    stepped = own_variance > numbers.unknown_clock**2
                    stepped = stepped or abs(middle) > numbers.stepped * math.sqrt(own_variance + 0.25)
                    if kind == 0 or stepped:
                        mean[h, unknown] += middle
                        for i in range(begin, end):
                            value[h, i] -= middle
                    if kind > 0 and stepped:
                        _restart(spread, unknown, numbers.unknown_clock**2, h)
                        anew[h, kind - 1] = True
                begin, end = end, nc + nph if kind == 0 else gnss
            for i in range(rows):
                innovation[h, i] = value[h, i]
            _combine(
                epochs.offset, epochs.slot, epochs.code_sigma_m, t, active, numbers.sensor_floor, spread, codes, counts,
                sensors, design, sensed, variance, cross, root, own, place, share, h
            )
            log_before[h] = _inverse(own, h, size, factor, lower, information, h)
            _first_weights(counts, design, value, variance, root, own, degrees, 0.0, 0.0, sensed, weight, ordered, h, h)
            if h == going and nc >= numbers.misfit_codes:
                shift = _code_shift(
                    nc, design, value, variance, root, own, weight, numbers.misfit_clipped, h, system, factor, lower,
                    after,
                )
            log_after[h] = _rounds(
                counts, design, value, variance, root, information, degrees, passes, change, after, weight, residual,
                fitted, system, factor, lower, right, h, h, h,
            )
            total = 0.0
            for i in range(nc):
                total += weight[h, i]
            doubtful = doubtful or (nc > 0 and total / nc < numbers.doubtful)
            total = 0.0
            for i in range(nc, gnss):
                total += weight[h, i]
            doubtful = doubtful or (gnss > nc and total / (gnss - nc) < numbers.doubtful)
        if doubtful:
            for h in range(count):
                # The second start, with place and speed set free.
                for i in range(size):
                    for j in range(i, size):
                        own[room, i, j] = own[h, i, j]
                for kind in range(2):
                    for i in range(size):
                        coefficient = 0.0
                        if kind == 0:
                            if i < nc:
                                coefficient = design[h, i, 0]
                            elif i == nc + _WAY:
                                coefficient = 1.0
                            elif i >= nc + _MOTION:
                                coefficient = sensed[h, i - nc - _MOTION, 0]
                        elif i == nc + _SPEED:
                            coefficient = 1.0
                        elif i >= nc + _MOTION:
                            coefficient = sensed[h, i - nc - _MOTION, 2]
                        right[i] = coefficient / root[h, i]
                    freedom = numbers.freedom_place if kind == 0 else numbers.freedom_speed
                    for i in range(size):
                        for j in range(i, size):
                            own[room, i, j] += freedom * right[i] * right[j]
                _inverse(own, room, size, factor, lower, information, room)
                _first_weights(
                    counts, design, value, variance, root, own, degrees, numbers.freedom_place, numbers.freedom_speed,
                    sensed, weight, ordered, h, room,
                )
                _rounds(
                    counts, design, value, variance, root, information, degrees, passes, change, after, weight,
                    residual, fitted, system, factor, lower, right, h, room, room,
                )
                log_other = _rounds(
                    counts, design, value, variance, root, information, degrees, passes, change, after, weight,
                    residual, fitted, system, factor, lower, right, h, h, room,
                )
                one = _evidence(
                    rows, nc, size, residual, variance, change, information, log_after[h], log_before[h], degrees, h, h
                )
                two = _evidence(
                    rows, nc, size, residual, variance, change, information, log_other, log_before[h], degrees, h, room
                )
                if two > one:
                    log_after[h] = log_other
                    for i in range(size):
                        change[h, i] = change[room, i]
                        for j in range(size):
                            after[h, i, j] = after[room, i, j]
                    for i in range(rows):
                        weight[h, i], residual[h, i] = weight[room, i], residual[room, i]
                        fitted[h, i] = fitted[room, i]
        for h in range(count):
            _apply(
                size, n, mean, spread, cross, own, information, after, change, gain, less, new_mean, new_covariance, h
            )
        for _ in range(numbers.relinearised):
            furthest = 0.0
            for h in range(count):
                furthest = max(furthest, abs(new_mean[h, _S] - now[h]))
            if furthest < numbers.moved_m:
                break
            for h in range(count):
                now[h], before[h] = new_mean[h, _S], new_mean[h, n]
                _equations(
                    epochs, t, course, active, numbers, mean, now[h], before[h], codes, phases, dopplers, counts,
                    sensors, scalars[_DIRECTION], sight, design, value, sensed, bend, point, two_axes, h,
                )
                _combine(
                    epochs.offset, epochs.slot, epochs.code_sigma_m, t, active, numbers.sensor_floor, spread, codes,
                    counts, sensors, design, sensed, variance, cross, root, own, place, share, h,
                )
                log_before[h] = _inverse(own, h, size, factor, lower, information, h)
                log_after[h] = _rounds(
                    counts, design, value, variance, root, information, degrees, passes, change, after, weight,
                    residual, fitted, system, factor, lower, right, h, h, h,
                )
                _apply(
                    size, n, mean, spread, cross, own, information, after, change, gain, less, new_mean,
                    new_covariance, h,
                )
        if count > 1:
            best = 0
            for h in range(count):
                if memory.log_probability[h] > memory.log_probability[best]:
                    best = h
                evidence[h] = _evidence(
                    rows, nc, size, residual, variance, change, information, log_after[h], log_before[h], degrees, h, h
                )
                _at(course.arc_m, course.ecef_m, course.axes, course.segment, new_mean[h, _S], points, h, axes)
            for h in range(count):
                square = 0.0
                for c in range(3):
                    square += (points[h, c] - points[best, c]) ** 2
                part = square / (square + numbers.map_branch_m**2)
                odds = memory.log_probability[h] - memory.log_probability[best]
                most = numbers.most_odds * square / numbers.map_branch_m**2
                after_odds = odds + part * (evidence[h] - evidence[best])
                right[h] = min(max(after_odds, min(odds, -most)), max(odds, most))
            total = _log_sum(right, count)
            for h in range(count):
                memory.log_probability[h] = right[h] - total
        for h in range(count):
            _onto_line(new_mean, new_covariance, n, course.start_m, course.end_m, numbers.start_sigma_m, h)
            for c in range(n):
                memory.mean[h, c] = new_mean[h, c]
                for e in range(n):
                    memory.covariance[h, c, e] = new_covariance[h, c, e]
        scalars[_MEASURED] = epochs.time_s[t]
        best = _most_probable(memory.log_probability, count, numbers.switch)

        # What is learnt of the measurements.
        dt = epochs.interval_s[t]
        share_new = 1.0 - math.exp(-min(dt, 1.0) / numbers.scale_s)
        for kind in range(2):
            begin = nc if kind == 1 else nc + nph
            end_row = nc + nph if kind == 1 else gnss
            scalar = _SCALE_PHASE if kind == 1 else _SCALE_DOPPLER
            if end_row - begin > 3:
                total = 0.0
                for i in range(begin, end_row):
                    total += weight[best, i] * (residual[best, i] ** 2 + fitted[best, i]) / variance[i]
                scalars[scalar] += share_new * math.log(total / (end_row - begin))
            scalars[scalar] = min(max(scalars[scalar], numbers.least_scale), numbers.largest_scale)
        code, motion = math.nan, math.nan
        if nc:
            code = 0.0
            for i in range(nc):
                code += weight[best, i] / nc
        if gnss > nc:
            motion = 0.0
            for i in range(nc, gnss):
                motion += weight[best, i] / (gnss - nc)
        scalars[_WEAK_MOTION] = scalars[_WEAK_MOTION] + dt if motion < numbers.lost_motion_weight else 0.0
        scalars[_WEAK_CODE] = scalars[_WEAK_CODE] + dt if code < numbers.lost_code_weight else 0.0
        _learn_map(scalars, 0.0 if best else shift, dt, numbers)
        answers.code_weight[t], answers.motion_weight[t] = code, motion
        for i in range(gnss):
            kind = 0 if i < nc else (1 if i < nc + nph else 2)
            k = codes[i] if kind == 0 else (phases[i - nc] if kind == 1 else dopplers[i - nc - nph])
            answers.innovation[t, kind, k] = innovation[best, i]
            answers.weight[t, kind, k] = weight[best, i]
            answers.used[t, kind] += weight[best, i] > 0.5
        for j in range(ns):
            answers.used[t, 3 + sensors[j]] += weight[best, gnss + j] > 0.5
            answers.sensed[t, sensors[j]] = innovation[best, gnss + j]

        if len(bank.running):
            _subfilters(
                epochs, t, course, numbers, active, bank, shared, variance, counts, codes, phases, dopplers, sensors,
                sight, anew, best, room, map_scale,
            )
        _finish(
            t, best, nc > 0, True, dt, numbers, active, memory, bank, answers, new_mean, new_covariance, work, ranked,
            kept_ones,
        )
        done = t + 1
    return done
