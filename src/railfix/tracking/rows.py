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
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers, Masks
from railfix.core.constants import EARTH_ROTATION_RATE, SPEED_OF_LIGHT
from railfix.core.geodesy import range_with_rotation
from railfix.tracking.epochs import SensorEpochs
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.state import OFFSETS, SATELLITES, Unknown

_TURN: Final = EARTH_ROTATION_RATE / SPEED_OF_LIGHT
#: Standard gravity, enough for the share of it along a gradient [m/s2].
_GRAVITY_MPS2: Final = 9.80665
#: Slower than this a speed does not tell the direction [m/s].
DIRECTION_MPS: Final = 0.5
#: Shorter than this the tangent is the direction of a displacement [m].
_CHORD_M: Final = 0.5


class Kind(IntEnum):
    """Kind of a measurement."""

    CODE = 0
    PHASE = 1
    DOPPLER = 2
    WHEEL = 3
    RADAR = 4
    FORCE = 5
    PLACE = 6


@dataclass(frozen=True, kw_only=True)
class Channels:
    """GNSS measurements of one epoch: K channels that have any.

    Attributes
    ----------
    slot : ndarray of int, shape (K,)
        Place of the satellite's error among the satellites of the state.
    offset : ndarray of int, shape (K,)
        Place of its code clock in `state.CLOCKS`.
    sat_ecef_m, sat_velocity_mps, before_ecef_m : ndarray, shape (K, 3)
    code_m, code_sigma_m, rate_mps, cn0_dbhz, phase_change_m : ndarray, shape (K,)
        NaN where there is none.
    column : ndarray of int, shape (K,)
        Channel of the epochs given.
    """

    slot: Indices
    offset: Indices
    sat_ecef_m: Floats
    sat_velocity_mps: Floats
    before_ecef_m: Floats
    code_m: Floats
    code_sigma_m: Floats
    rate_mps: Floats
    cn0_dbhz: Floats
    phase_change_m: Floats
    column: Indices


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Linearised measurements of one epoch, M rows for each of H hypotheses.

    Attributes
    ----------
    design : ndarray, shape (H, M, N)
    value : ndarray, shape (H, M)
        Measured less computed at the mean, for changes from the mean.
    variance : ndarray, shape (M,)
    kind : ndarray of int, shape (M,)
    column : ndarray of int, shape (M,)
        Channel of GNSS measurements, -1 for sensors.
    """

    design: Floats
    value: Floats
    variance: Floats
    kind: Integers
    column: Indices

    def of(self, kinds: tuple[Kind, ...]) -> Masks:
        """Rows of some kinds, shape (M,)."""
        return np.asarray(np.logical_or.reduce([self.kind == kind for kind in kinds]), dtype=np.bool_)

    @property
    def common(self) -> tuple[Masks, Masks, Masks]:
        """Rows of codes, phases and Dopplers."""
        return self.kind == Kind.CODE, self.kind == Kind.PHASE, self.kind == Kind.DOPPLER


def noise_of(channels: Channels, dt: float, limits: TrackingLimits, scale: tuple[float, float]) -> tuple[Floats, ...]:
    """Variances of white errors of codes, phases' changes and Dopplers, each shape (K,)."""
    cn0 = np.where(np.isnan(channels.cn0_dbhz), 45.0, np.minimum(channels.cn0_dbhz, 50.0))
    weak = 10.0 ** ((45.0 - cn0) / 10.0)
    code = (limits.code_white_share * channels.code_sigma_m) ** 2 / min(dt, 1.0)
    phase = (limits.phase_floor_m**2 + limits.phase_zenith_m**2 * weak) * np.exp(scale[1])
    doppler = (limits.doppler_floor_mps**2 + limits.doppler_zenith_mps**2 * weak) * np.exp(scale[0])
    return code, phase, doppler


def gnss_rows(
    channels: Channels, line: Line, mean: Floats, point: Floats, dt: float, noise: tuple[Floats, ...]
) -> Rows:
    """Rows of codes, phases and Dopplers.

    Parameters
    ----------
    channels : Channels
    line : Line
    mean : ndarray, shape (H, N)
        About which changes are counted.
    point : ndarray, shape (H, 2) [m]
        Arc lengths, now and at the epoch before, at which the equations are linearised.
    dt : float [s]
        Since the epoch before; 1 for the first.
    noise : tuple of ndarray, shape (K,)
        `noise_of`.
    """
    count, width = mean.shape
    ecef, axes = line.at(point[:, 0])
    before, _ = line.at(point[:, 1])
    distance, sight = range_with_rotation(channels.sat_ecef_m, ecef[:, None, :])
    on_axes = sight @ np.swapaxes(axes, 1, 2)  # (H, K, 3): u.e, u.c, u.h
    moved = mean[:, [Unknown.PLACE, Unknown.BEFORE]] - point
    designs, values, variances, kinds, columns = [], [], [], [], []

    has = np.flatnonzero(np.isfinite(channels.code_m) & np.isfinite(channels.code_sigma_m))
    if len(has):
        design = np.zeros((count, len(has), width))
        rows = np.arange(len(has))
        design[:, :, Unknown.PLACE] = design[:, :, Unknown.CODE_PLACE] = -on_axes[:, has, 0]
        design[:, :, Unknown.MAP_RIGHT] = -on_axes[:, has, 1]
        design[:, :, Unknown.MAP_UP] = -on_axes[:, has, 2]
        design[:, :, Unknown.CODE_CLOCK] = 1.0
        design[:, rows, OFFSETS + channels.offset[has]] = 1.0
        design[:, rows, SATELLITES + channels.slot[has]] = channels.code_sigma_m[has]
        computed = distance[:, has] - on_axes[:, has, 0] * moved[:, :1]
        rest = (design[:, :, Unknown.MAP_RIGHT :] @ mean[:, Unknown.MAP_RIGHT :, None])[..., 0]
        designs.append(design)
        values.append(channels.code_m[has] - computed - rest)
        variances.append(noise[0][has])
        kinds.append(np.full(len(has), int(Kind.CODE)))
        columns.append(channels.column[has])

    has = np.flatnonzero(np.isfinite(channels.phase_change_m))
    if len(has):
        old, _ = range_with_rotation(channels.before_ecef_m[has], before[:, None, :])
        chord = ecef - before
        length = np.sqrt((chord * chord).sum(axis=1))
        sign = np.where(point[:, 0] >= point[:, 1], 1.0, -1.0)
        straight = np.where(length > _CHORD_M, sign / np.maximum(length, _CHORD_M), 0.0)[:, None] * chord
        along = np.where((length > _CHORD_M)[:, None], straight, axes[:, 0])
        gradient = -(sight[:, has] @ along[:, :, None])[..., 0]
        design = np.zeros((count, len(has), width))
        design[:, :, Unknown.PLACE], design[:, :, Unknown.BEFORE] = gradient, -gradient
        design[:, :, Unknown.PHASE_CLOCK] = 1.0
        design[:, :, Unknown.STEP_RIGHT] = -on_axes[:, has, 1]
        design[:, :, Unknown.STEP_UP] = -on_axes[:, has, 2]
        design[:, :, Unknown.STEP_ALONG] = gradient
        computed = distance[:, has] - old + gradient * (moved[:, :1] - moved[:, 1:])
        designs.append(design)
        values.append(channels.phase_change_m[has] - computed - mean[:, Unknown.PHASE_CLOCK, None])
        variances.append(noise[1][has])
        kinds.append(np.full(len(has), int(Kind.PHASE)))
        columns.append(channels.column[has])

    has = np.flatnonzero(np.isfinite(channels.rate_mps))
    if len(has):
        sat, velocity = channels.sat_ecef_m[has], channels.sat_velocity_mps[has]
        moving = (sight[:, has] * velocity).sum(axis=-1)
        moving += _TURN * (velocity[:, 0] * ecef[:, 1:2] - velocity[:, 1] * ecef[:, :1])
        tangent = axes[:, 0]
        stretch = 1.0 + moving / SPEED_OF_LIGHT
        slope = (-on_axes[:, has, 0] + _TURN * (sat[:, 0] * tangent[:, 1:2] - sat[:, 1] * tangent[:, :1])) / stretch
        design = np.zeros((count, len(has), width))
        design[:, :, Unknown.SPEED], design[:, :, Unknown.DRIFT] = slope, 1.0
        design[:, :, Unknown.DOPPLER_SPEED] = slope
        design[:, :, Unknown.STEP_RIGHT] = -on_axes[:, has, 1] / dt
        design[:, :, Unknown.STEP_UP] = -on_axes[:, has, 2] / dt
        speed = mean[:, Unknown.SPEED, None] + mean[:, Unknown.DOPPLER_SPEED, None]
        computed = moving / stretch + slope * speed + mean[:, Unknown.DRIFT, None]
        designs.append(design)
        values.append(channels.rate_mps[has] - computed)
        variances.append(noise[2][has])
        kinds.append(np.full(len(has), int(Kind.DOPPLER)))
        columns.append(channels.column[has])

    if not designs:
        return Rows(
            design=np.empty((count, 0, width)),
            value=np.empty((count, 0)),
            variance=np.empty(0),
            kind=np.empty(0, dtype=np.int64),
            column=np.empty(0, dtype=np.intp),
        )
    return Rows(
        design=np.concatenate(designs, axis=1),
        value=np.concatenate(values, axis=1),
        variance=np.concatenate(variances),
        kind=np.concatenate(kinds),
        column=np.concatenate(columns),
    )


def sensor_rows(
    sensors: SensorEpochs, epoch: int, line: Line, mean: Floats, dt: float, direction: float
) -> Rows | None:
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
            coefficients = {Unknown.PLACE: 1.0, Unknown.BEFORE: -1.0, scale: -signed}
            listed.append((coefficients, value, float(sigma[epoch]), kind))
    force, sigma = sensors.force_mps2, sensors.force_sigma_mps2
    if force is not None and sigma is not None and np.isfinite(force[epoch]):
        slope = line.gradient_at(0.5 * (state[Unknown.PLACE] + state[Unknown.BEFORE]))
        gravity = _GRAVITY_MPS2 * slope / np.sqrt(1.0 + slope**2)
        gained = (state[Unknown.SPEED] - state[Unknown.SPEED_BEFORE]) / dt
        value = force[epoch] - gained - gravity - state[Unknown.FORCE_OFFSET]
        coefficients = {Unknown.SPEED: 1.0 / dt, Unknown.SPEED_BEFORE: -1.0 / dt, Unknown.FORCE_OFFSET: 1.0}
        listed.append((coefficients, value, float(sigma[epoch]), Kind.FORCE))
    place, sigma = sensors.place_m, sensors.place_sigma_m
    if place is not None and sigma is not None and np.isfinite(place[epoch]):
        listed.append(({Unknown.PLACE: 1.0}, place[epoch] - state[Unknown.PLACE], float(sigma[epoch]), Kind.PLACE))
    if not listed:
        return None
    design = np.zeros((len(mean), len(listed), mean.shape[1]))
    for row, (coefficients, _, _, _) in enumerate(listed):
        for column, coefficient in coefficients.items():
            design[:, row, column] = coefficient
    return Rows(
        design=design,
        value=np.stack([value for _, value, _, _ in listed], axis=1),
        variance=np.array([sigma**2 for _, _, sigma, _ in listed]),
        kind=np.array([int(kind) for _, _, _, kind in listed]),
        column=np.full(len(listed), -1, dtype=np.intp),
    )


def joined(first: Rows, second: Rows | None) -> Rows:
    """Rows of both."""
    if second is None:
        return first
    return Rows(
        design=np.concatenate([first.design, second.design], axis=1),
        value=np.concatenate([first.value, second.value], axis=1),
        variance=np.concatenate([first.variance, second.variance]),
        kind=np.concatenate([first.kind, second.kind]),
        column=np.concatenate([first.column, second.column]),
    )
