"""Specific force and angular rate of an inertial sensor fixed to the body.

The position and the attitude of the body are those of the antennas' truth (bogies on the curve, cant,
gradient, sway); specific force and angular rate are their differences in time, in the frame of the
Earth, with its gravity and its rotation (Groves 2013, 2.3 to 2.5 and 5.2).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from railfix.core.arrays import Floats
from railfix.core.constants import EARTH_ROTATION_RATE
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.core.timescale import timedelta
from railfix.simulate.body import FULL_SPEED_MPS
from railfix.simulate.errors.processes import GaussMarkov, RandomFunction
from railfix.simulate.sensors.settings import InertialSettings

if TYPE_CHECKING:
    from railfix.simulate.signals import Simulation


#: Longest half interval of the differences in time [s].
_HALF_S: Final = 0.02
#: Samples computed at once.
_BLOCK: Final = 50_000
#: Lever arm of the attitude, long so that rounding of positions is negligible [m].
_LEVER_M: Final = 10.0
#: Normal gravity of WGS 84 at the equator [m/s^2], Somigliana's constant, flattening, m, semi-major axis [m].
_GRAVITY: Final = (9.780_325_335_9, 1.931_852_652_41e-3, 1.0 / 298.257_223_563, 3.449_786_506_84e-3, 6_378_137.0)
_ECCENTRICITY_2: Final = 6.694_379_990_14e-3
#: Streams of random numbers: noise, bias drifts, bias walk, vibration.
_NOISE, _ACCEL_DRIFT, _GYRO_DRIFT, _WALK, _VIBRATION = 22, 23, 24, 25, 29


def gravity_mps2(latitude_deg: Floats, height_m: Floats) -> Floats:
    """Normal gravity, centrifugal part included (NIMA TR8350.2, equations 4-1 and 4-3)."""
    equator, k, flattening, m, axis = _GRAVITY
    sine = np.sin(np.radians(latitude_deg)) ** 2
    ground = equator * (1.0 + k * sine) / np.sqrt(1.0 - _ECCENTRICITY_2 * sine)
    rise = 1.0 - 2.0 / axis * (1.0 + flattening + m - 2.0 * flattening * sine) * height_m + 3.0 * height_m**2 / axis**2
    return np.asarray(ground * rise)


def _pose(simulation: Simulation, offset_m: tuple[float, float, float], time_s: Floats) -> tuple[Floats, Floats]:
    """Structures, shape (n, 3) [m], and the axes forward, right, down in its rows, shape (n, 3, 3)."""
    along, across, up = offset_m
    truth, _ = simulation.body_truth(offset_m, time_s)
    aside, _ = simulation.body_truth((along, across + _LEVER_M, up), time_s)
    right = (aside.ecef_m - truth.ecef_m) / _LEVER_M
    return truth.ecef_m, np.stack([truth.forward, right, np.cross(truth.forward, right)], axis=1)


def true_motion(simulation: Simulation, offset_m: tuple[float, float, float], time_s: Floats, half_s: float) -> Floats:
    """Specific force [m/s^2] and angular rate against inertial space [rad/s] in the axes of the body, shape (n, 6).

    Differences over `half_s` before and after: an acceleration is weighted by a triangle of that half
    width, so that sums over samples `half_s` apart give the motion back exactly.
    """
    before, now, after = (_pose(simulation, offset_m, time_s + d) for d in (-half_s, 0.0, half_s))
    place, axes = now
    # Differences of positions first, which keeps the digits.
    acceleration = ((after[0] - place) - (place - before[0])) / half_s**2
    velocity = (after[0] - before[0]) / (2.0 * half_s)
    latitude, longitude, height = geodetic_from_ecef(place)
    up = enu_axes(latitude, longitude)[:, 2]
    earth = np.array([0.0, 0.0, EARTH_ROTATION_RATE])
    force = acceleration + 2.0 * np.cross(earth, velocity) + gravity_mps2(latitude, height)[:, None] * up
    turn = np.einsum("nai,nbi->nab", before[1], after[1])
    sine = 0.5 * np.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], axis=-1
    )
    size = np.linalg.norm(sine, axis=-1, keepdims=True)
    angle = np.where(size > 1e-9, np.arcsin(np.minimum(size, 1.0)) / np.maximum(size, 1e-9), 1.0)
    rate = sine * angle / (2.0 * half_s) + axes @ earth
    return np.concatenate([np.einsum("nai,ni->na", axes, force), rate], axis=1)


def inertial_table(simulation: Simulation, settings: InertialSettings) -> pl.DataFrame:
    """Samples of the inertial sensor, see `railfix.simulate.sensors.tables.COLUMNS`."""
    scenario = simulation.scenario
    time = np.arange(int(scenario.duration_s * settings.rate_hz + 1e-9) + 1) / settings.rate_hz
    offset = (settings.along_m, settings.across_m, settings.up_m)
    half = min(_HALF_S, 1.0 / settings.rate_hz)
    true = np.concatenate(
        [true_motion(simulation, offset, time[k : k + _BLOCK], half) for k in range(0, len(time), _BLOCK)]
    )
    measured = _with_errors(true + _vibration(simulation, settings, time), time, settings, scenario.seed)
    names = ("force_forward_mps2", "force_right_mps2", "force_down_mps2", "roll_rate_radps", "pitch_rate_radps",
             "yaw_rate_radps")  # fmt: skip
    tag = scenario.start + timedelta(time)
    return pl.DataFrame({"time_gpst": tag, **{name: measured[:, k] for k, name in enumerate(names)}})


def _vibration(simulation: Simulation, settings: InertialSettings, time_s: Floats) -> Floats | float:
    """Vibration of the six axes at times, shape (n, 6); 0 where there is none."""
    sigmas = np.repeat([settings.vibration_sigma_mps2, settings.vibration_sigma_radps], 3)
    if not sigmas.any():
        return 0.0
    axes = [
        RandomFunction.periodic(
            np.random.default_rng([simulation.scenario.seed, _VIBRATION, axis]),
            sigma=float(sigma),
            period=1.0 / settings.vibration_hz,
        ).at(time_s)
        for axis, sigma in enumerate(sigmas)
    ]
    size = np.minimum(np.abs(simulation.motion.at(time_s)[1]) / FULL_SPEED_MPS, 1.0)
    return np.asarray(np.stack(axes, axis=1) * size[:, None])


def _with_errors(true: Floats, time_s: Floats, settings: InertialSettings, seed: int) -> Floats:
    """Samples with misalignment, scale errors, biases and drifts, noise, quantisation, applied in this order."""
    turned = Rotation.from_rotvec(settings.misalignment_rad).inv()
    measured = np.concatenate([turned.apply(true[:, :3]), turned.apply(true[:, 3:])], axis=1)
    measured *= 1.0 + np.array([*settings.accel_scale, *settings.gyro_scale])
    measured += [*settings.accel_bias_mps2, *settings.gyro_bias_radps]
    last = float(time_s[-1])
    drifts = (
        (_ACCEL_DRIFT, settings.accel_drift_sigma_mps2, settings.accel_drift_time_s),
        (_GYRO_DRIFT, settings.gyro_drift_sigma_radps, settings.gyro_drift_time_s),
    )
    for k, (stream, sigma, drift_time_s) in enumerate(drifts):
        if sigma > 0.0:
            keys = [(seed, stream, axis) for axis in range(3)]
            drift = GaussMarkov(keys, sigma=sigma, time_s=drift_time_s, duration_s=last)
            measured[:, 3 * k : 3 * k + 3] += drift.at(time_s)
    if settings.gyro_drift_walk_radps_per_sqrt_s > 0.0:
        white = np.random.default_rng([seed, _WALK]).standard_normal((len(time_s) - 1, 3))
        walk = np.cumsum(white * settings.gyro_drift_walk_radps_per_sqrt_s / np.sqrt(settings.rate_hz), axis=0)
        measured[1:, 3:] += walk
    sigma_six = np.repeat([settings.velocity_walk_mps_per_sqrt_s, settings.angle_walk_rad_per_sqrt_s], 3)
    noise = np.random.default_rng([seed, _NOISE]).standard_normal(measured.shape)
    measured += noise * sigma_six * np.sqrt(settings.rate_hz)
    for k, step in enumerate((settings.accel_resolution_mps2, settings.gyro_resolution_radps)):
        if step > 0.0:
            measured[:, 3 * k : 3 * k + 3] = np.rint(measured[:, 3 * k : 3 * k + 3] / step) * step
    return measured
