r"""Measurement equations of one epoch, linearised at each hypothesis.

With u the unit vector from receiver to satellite, e the tangent, c and h the axes to the right and up::

    code    P = range(s + z) - u.c m_c - u.h m_h + b + o_g + sigma x_i + noise
    Doppler r = A + slope (v + w) - u.(c q_c + h q_h) / dt + d + noise
    phase   change L = range_k(s) - range_{k-1}(s') - u.(g q_a + c q_c + h q_h) + B + noise
    wheel   W (1 + k) = s - s', radar alike;  force f = (v - v') / dt + g sin(gradient) + beta;  place = s

s' and v' are those of the epoch before, x_i the satellite's correlated error in units of its sigma, o_g the offset
of its constellation's code clock, w the time-correlated error of Dopplers, z that of
the codes' place over minutes, m the map's error, q the error of the map's displacement over the epoch. The
gradient g of the phase's change is one for both ends: the direction of the chord. With a gradient for each end the
phases would measure absolute place from the bend of the line, more sharply than the line is known.

The rows depend on few combinations y of the unknowns: one for each code, the clock of the codes, six for all phases and
Dopplers (`MOTION`), one for each sensor. Rounds of reweighting need the covariance of y alone (`robust`).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers
from railfix.core.constants import EARTH_ROTATION_RATE, GRAVITY_MPS2, SPEED_OF_LIGHT
from railfix.core.geodesy import range_with_rotation
from railfix.tracking.chunk import Chunk
from railfix.tracking.epochs import RangeEpochs, SensorEpochs
from railfix.tracking.line import Line
from railfix.tracking.state import OFFSETS, SATELLITES, Unknown

_TURN: Final = EARTH_ROTATION_RATE / SPEED_OF_LIGHT
#: Slower than this ranges to ground units are not used [m/s].
_STILL_MPS: Final = 0.3
#: Slower than this a speed does not tell the direction [m/s]: four sigmas of what a wheel of one hertz leaves of it.
DIRECTION_MPS: Final = 1.0
#: Shorter than this the tangent is the direction of a displacement [m].
CHORD_M: Final = 0.5


class Kind(IntEnum):
    """Kind of a measurement."""

    CODE = 0
    PHASE = 1
    DOPPLER = 2
    WHEEL = 3
    RADAR = 4
    FORCE = 5
    PLACE = 6  # by a feature of the line
    RANGE = 7  # to a ground unit


_KINDS: Final = np.array([Kind.CODE, Kind.PHASE, Kind.DOPPLER], dtype=np.int64)
#: Combinations that phases and Dopplers depend on: way since the epoch before, clock of the phases, error of the map's
#: displacement to the right and up, speed by Dopplers, drift.
MOTION: Final = 6


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Linearised measurements of one epoch, M rows for each of H hypotheses.

    Attributes
    ----------
    combine : ndarray, shape (H, D, N)
        Combinations y of the unknowns, ``y = combine x``.
    design : ndarray, shape (H, M, D)
        Of the rows over the combinations.
    value : ndarray, shape (H, M)
        Measured less computed at the mean, for changes from the mean.
    variance : ndarray, shape (M,)
    kind : ndarray of int, shape (M,)
        In rising order.
    column : ndarray of int, shape (M,)
        Channel of GNSS measurements, -1 for sensors.
    bounds : tuple of int
        Rows of codes, phases and Dopplers end before these.
    """

    combine: Floats
    design: Floats
    value: Floats
    variance: Floats
    kind: Integers
    column: Indices
    bounds: tuple[int, int, int]

    @property
    def codes(self) -> slice:
        """Rows of codes."""
        return slice(0, self.bounds[0])

    @property
    def motion(self) -> slice:
        """Rows of phases and Dopplers."""
        return slice(self.bounds[0], self.bounds[2])

    @property
    def common(self) -> tuple[slice, slice, slice]:
        """Rows of codes, phases and Dopplers: those of a kind share a clock."""
        first, second, third = self.bounds
        return slice(0, first), slice(first, second), slice(second, third)


@dataclass(frozen=True, kw_only=True)
class SensorRows:
    """Rows of the sensors: S rows for each of H hypotheses, over the unknowns themselves.

    Attributes
    ----------
    design : ndarray, shape (H, S, N)
    value : ndarray, shape (H, S)
    variance : ndarray, shape (S,)
    kind : ndarray of int, shape (S,)
    """

    design: Floats
    value: Floats
    variance: Floats
    kind: Integers


def rows_of(
    chunk: Chunk,
    epoch: int,
    line: Line,
    mean: Floats,
    point: Floats,
    scale: tuple[float, float],
    sensors: SensorRows | None,
) -> Rows:
    """Rows of one epoch.

    Parameters
    ----------
    chunk : Chunk
    epoch : int
    line : Line
    mean : ndarray, shape (H, N)
        About which changes are counted.
    point : ndarray, shape (H, 2) [m]
        Arc lengths, now and at the epoch before, at which the equations are linearised.
    scale : tuple of float
        Logarithms of what the variances of Dopplers and phases are multiplied by.
    sensors : SensorRows or None
    """
    count, width = mean.shape
    dt = chunk.interval_s[epoch]
    has = chunk.has[:, epoch]
    code, phase, doppler = (np.flatnonzero(mask) for mask in has)
    bounds = (len(code), len(code) + len(phase), len(code) + len(phase) + len(doppler))
    extra = 0 if sensors is None else len(sensors.variance)
    clock, way = len(code), len(code) + 1
    combine = np.zeros((count, way + MOTION + extra, width))
    design = np.zeros((count, bounds[2] + extra, way + MOTION + extra))
    value = np.empty((count, bounds[2] + extra))

    ends, axes = line.at(point.T.reshape(-1))
    ecef, before, axes = ends[:count], ends[count:], axes[:count]
    sat = chunk.sat_ecef_m[epoch]
    distance, sight = range_with_rotation(sat, ecef[:, None, :])
    on_axes = sight @ np.swapaxes(axes, 1, 2)  # (H, K, 3): u.e, u.c, u.h
    moved = mean[:, [Unknown.PLACE, Unknown.BEFORE]] - point

    at = np.arange(len(code))
    combine[:, at, Unknown.PLACE] = combine[:, at, Unknown.CODE_PLACE] = -on_axes[:, code, 0]
    combine[:, at, Unknown.MAP_RIGHT] = -on_axes[:, code, 1]
    combine[:, at, Unknown.MAP_UP] = -on_axes[:, code, 2]
    combine[:, at, OFFSETS + chunk.offset[code]] = 1.0
    combine[:, at, SATELLITES + chunk.slot[code]] = chunk.code_sigma_m[epoch, code]
    combine[:, clock, Unknown.CODE_CLOCK] = 1.0
    design[:, at, at] = 1.0
    design[:, at, clock] = 1.0
    linear = mean.copy()
    linear[:, Unknown.PLACE] = moved[:, 0]
    linear = (combine[:, : len(code)] @ linear[..., None])[..., 0] + mean[:, Unknown.CODE_CLOCK, None]
    value[:, : len(code)] = chunk.measured[0, epoch, code] - distance[:, code] - linear

    combine[:, way, Unknown.PLACE] = combine[:, way, Unknown.STEP_ALONG] = 1.0
    combine[:, way, Unknown.BEFORE] = -1.0
    for k, unknown in enumerate((Unknown.PHASE_CLOCK, Unknown.STEP_RIGHT, Unknown.STEP_UP, Unknown.SPEED), start=1):
        combine[:, way + k, unknown] = 1.0
    combine[:, way + 4, Unknown.DOPPLER_SPEED] = 1.0
    combine[:, way + 5, Unknown.DRIFT] = 1.0
    if len(phase):
        part = slice(bounds[0], bounds[1])
        old, _ = range_with_rotation(chunk.before_ecef_m[epoch, phase], before[:, None, :])
        chord = ecef - before
        length = np.sqrt((chord * chord).sum(axis=1))
        sign = np.where(point[:, 0] >= point[:, 1], 1.0, -1.0)
        straight = np.where(length > CHORD_M, sign / np.maximum(length, CHORD_M), 0.0)[:, None] * chord
        along = np.where((length > CHORD_M)[:, None], straight, axes[:, 0])
        gradient = -(sight[:, phase] @ along[:, :, None])[..., 0]
        design[:, part, way] = gradient
        design[:, part, way + 1] = 1.0
        design[:, part, way + 2 : way + 4] = -on_axes[:, phase, 1:]
        computed = distance[:, phase] - old + gradient * (moved[:, :1] - moved[:, 1:])
        value[:, part] = chunk.measured[1, epoch, phase] - computed - mean[:, Unknown.PHASE_CLOCK, None]
    if len(doppler):
        part = slice(bounds[1], bounds[2])
        sat, velocity = sat[doppler], chunk.sat_velocity_mps[epoch, doppler]
        moving = (sight[:, doppler] * velocity).sum(axis=-1)
        moving += _TURN * (velocity[:, 0] * ecef[:, 1:2] - velocity[:, 1] * ecef[:, :1])
        tangent = axes[:, 0]
        stretch = 1.0 + moving / SPEED_OF_LIGHT
        slope = (-on_axes[:, doppler, 0] + _TURN * (sat[:, 0] * tangent[:, 1:2] - sat[:, 1] * tangent[:, :1])) / stretch
        design[:, part, way + 2 : way + 4] = -on_axes[:, doppler, 1:] / dt
        design[:, part, way + 4] = slope
        design[:, part, way + 5] = 1.0
        speed = mean[:, Unknown.SPEED, None] + mean[:, Unknown.DOPPLER_SPEED, None]
        computed = moving / stretch + slope * speed + mean[:, Unknown.DRIFT, None]
        value[:, part] = chunk.measured[2, epoch, doppler] - computed
    variance = chunk.variance[:, epoch]
    variances = [variance[0, code], variance[1, phase] * np.exp(scale[1]), variance[2, doppler] * np.exp(scale[0])]
    kinds = [_KINDS.repeat([len(code), len(phase), len(doppler)])]
    if sensors is not None:
        at = np.arange(extra)
        combine[:, way + MOTION :] = sensors.design
        design[:, bounds[2] + at, way + MOTION + at] = 1.0
        value[:, bounds[2] :] = sensors.value
        variances.append(sensors.variance)
        kinds.append(sensors.kind)
    return Rows(
        combine=combine,
        design=design,
        value=value,
        variance=np.concatenate(variances),
        kind=np.concatenate(kinds),
        column=np.concatenate([code, phase, doppler, np.full(extra, -1, dtype=np.intp)]),
        bounds=bounds,
    )


def sensor_rows(
    sensors: SensorEpochs, epoch: int, line: Line, mean: Floats, dt: float, direction: float
) -> SensorRows | None:
    """Rows of the sensors at one epoch, None without any.

    `direction` is the sign of the last speed with a direction, 0 before: an unsigned way takes it where the speed is
    near 0, for a train that stood goes on.
    """
    state = {unknown: mean[:, unknown] for unknown in Unknown}
    moved = state[Unknown.PLACE] - state[Unknown.BEFORE]
    listed: list[tuple[dict[Unknown, Any], Floats, float, Kind]] = []
    coefficients: dict[Unknown, Any]
    for way, sigma, scale, kind in (
        (sensors.wheel_m, sensors.wheel_sigma_m, Unknown.WHEEL, Kind.WHEEL),
        (sensors.radar_m, sensors.radar_sigma_m, Unknown.RADAR, Kind.RADAR),
    ):
        if way is not None and sigma is not None and np.isfinite(way[epoch]):
            unsigned = kind is Kind.WHEEL and sensors.wheel_sign == "unknown"
            speed = state[Unknown.SPEED]
            sign = (
                np.where(np.abs(speed) > DIRECTION_MPS, np.sign(speed), direction) if unsigned else np.ones(len(mean))
            )
            if not sign.all():
                continue
            signed = float(way[epoch]) * sign
            value = signed * (1.0 + state[scale]) - moved
            coefficients = {Unknown.PLACE: 1.0, Unknown.BEFORE: -1.0, Unknown.STEP_ALONG: 1.0, scale: -signed}
            listed.append((coefficients, value, float(sigma[epoch]), kind))
    force, sigma = sensors.force_mps2, sensors.force_sigma_mps2
    if force is not None and sigma is not None and np.isfinite(force[epoch]):
        slope = line.gradient_at(0.5 * (state[Unknown.PLACE] + state[Unknown.BEFORE]))
        gravity = GRAVITY_MPS2 * slope / np.sqrt(1.0 + slope**2)
        gained = (state[Unknown.SPEED] - state[Unknown.SPEED_BEFORE]) / dt
        value = force[epoch] - gained - gravity - state[Unknown.FORCE_OFFSET]
        coefficients = {Unknown.SPEED: 1.0 / dt, Unknown.SPEED_BEFORE: -1.0 / dt, Unknown.FORCE_OFFSET: 1.0}
        listed.append((coefficients, value, float(sigma[epoch]), Kind.FORCE))
    place, sigma = sensors.place_m, sensors.place_sigma_m
    if place is not None and sigma is not None and np.isfinite(place[epoch]):
        there = line.nearest_m(place[epoch] + line.round_m(place[epoch]), state[Unknown.PLACE])
        listed.append(({Unknown.PLACE: 1.0}, there - state[Unknown.PLACE], float(sigma[epoch]), Kind.PLACE))
    if sensors.ranges is not None:
        listed += _range_rows(sensors.ranges, epoch, line, mean)
    if not listed:
        return None
    design = np.zeros((len(mean), len(listed), mean.shape[1]))
    for row, (coefficients, _, _, _) in enumerate(listed):
        for column, coefficient in coefficients.items():
            design[:, row, column] = coefficient
    return SensorRows(
        design=design,
        value=np.stack([value for _, value, _, _ in listed], axis=1),
        variance=np.array([sigma**2 for _, _, sigma, _ in listed]),
        kind=np.array([int(kind) for _, _, _, kind in listed]),
    )


def _range_rows(
    ranges: RangeEpochs, epoch: int, line: Line, mean: Floats
) -> list[tuple[dict[Unknown, Any], Floats, float, Kind]]:
    """Ranges to ground units; none while the train stands, for the error of a standing range stays (P2 3.3)."""
    if abs(mean[0, Unknown.SPEED]) < _STILL_MPS:
        return []
    listed: list[tuple[dict[Unknown, Any], Floats, float, Kind]] = []
    for k in np.flatnonzero(np.isfinite(ranges.range_m[epoch])).tolist():
        age = float(ranges.age_s[epoch, k])
        place = mean[:, Unknown.PLACE] - age * mean[:, Unknown.SPEED]
        along, right, up = ranges.lever_m.tolist()
        point, axes = line.at(place + along)
        across = mean[:, Unknown.MAP_RIGHT] + right
        above = mean[:, Unknown.MAP_UP] + up
        sight = ranges.unit_ecef_m[epoch, k] - point - across[:, None] * axes[:, 1] - above[:, None] * axes[:, 2]
        size = np.sqrt((sight * sight).sum(axis=1))
        slopes = -(axes @ (sight / size[:, None])[..., None])[..., 0]
        coefficients = {
            Unknown.PLACE: slopes[:, 0],
            Unknown.SPEED: -age * slopes[:, 0],
            Unknown.MAP_RIGHT: slopes[:, 1],
            Unknown.MAP_UP: slopes[:, 2],
        }
        value = float(ranges.range_m[epoch, k]) - size
        listed.append((coefficients, value, float(ranges.sigma_m[epoch, k]), Kind.RANGE))
    return listed
