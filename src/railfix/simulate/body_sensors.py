"""Pulse times of a tachometer; specific force and angular rate of an inertial sensor fixed to the body.

The inertial quantities are computed by differencing the body's Earth-fixed position and attitude over time; gravity and
Earth rotation are included (Groves 2013, 2.3 to 2.5 and 5.2).
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from railfix.core.arrays import Floats
from railfix.core.constants import EARTH_ROTATION_RATE
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.core.timescale import timedelta
from railfix.simulate.errors import GaussMarkov, RandomFunction
from railfix.simulate.motion import FULL_SPEED_MPS
from railfix.simulate.settings import DrawnSlips, InertialSettings, SlipInterval, TachometerSettings

if TYPE_CHECKING:
    from railfix.simulate.motion import Motion
    from railfix.simulate.signals import Simulation


#: Time step [s]; within a step, the wheel's acceleration is assumed to be constant.
_STEP_S: Final = 0.01
_LOOK_S: Final = 0.1  #: Time step of the search for phases of acceleration and braking [s].
_HARD_MPS2: Final = 0.05  #: Phases with less acceleration or deceleration than this are ignored [m/s^2].
#: Seeds of random streams: phase and jitter, slips, tooth errors, lost and doubled pulses.
_WHEEL, _SLIPS, _TEETH, _MISCOUNT = 20, 21, 30, 31


def wheel_slips(simulation: Simulation, settings: TachometerSettings) -> list[SlipInterval]:
    """Return the slips and slides of the run in order of time, those of the settings and those drawn at random.

    A drawn slip or slide is left out if it overlaps another slip or slide.
    """
    scenario = simulation.scenario
    rng = np.random.default_rng([scenario.seed, _SLIPS])
    slips = list(settings.slips)
    for new in _draw(simulation.motion, scenario.duration_s, settings.drawn_slips, rng):
        if all(new.start_s >= old.end_s or old.start_s >= new.end_s for old in slips):
            slips.append(new)
    return sorted(slips, key=lambda slip: slip.start_s)


def _draw(motion: Motion, duration_s: float, drawn: DrawnSlips, rng: np.random.Generator) -> list[SlipInterval]:
    edges = np.arange(0.0, duration_s + _LOOK_S, _LOOK_S)
    speed = np.abs(motion.at(edges)[1])
    kind = np.sign(np.where(np.abs(np.diff(speed)) > _HARD_MPS2 * _LOOK_S, np.diff(speed), 0.0))
    change = np.flatnonzero(np.diff(kind, prepend=0.0, append=0.0))
    found = []
    for first, last in pairwise(change.tolist()):
        if kind[first] == 0.0:
            continue
        # Random numbers are drawn for every phase, so that the slips of a phase do not depend on slips in other phases.
        chance, size, lasting, place = rng.uniform(size=4)
        if chance >= (drawn.slip_chance if kind[first] > 0.0 else drawn.slide_chance):
            continue
        room = float(edges[last] - edges[first])
        length = min(drawn.duration_s * (0.2 + 0.8 * float(lasting)), room)
        start = float(edges[first]) + float(place) * (room - length)
        ratio = float(kind[first]) * drawn.ratio * (0.2 + 0.8 * float(size))
        found.append(SlipInterval(start_s=start, end_s=start + length, ratio=ratio))
    return found


def slip_ratio(slips: list[SlipInterval], time_s: Floats) -> Floats:
    """Return (wheel speed - train speed) / train speed at times [s]; 0 at times without a slip or slide."""
    ratio = np.zeros(np.shape(time_s))
    for slip in slips:
        part = (time_s - slip.start_s) / (slip.end_s - slip.start_s)
        ratio += np.where((part > 0.0) & (part < 1.0), slip.ratio * np.sin(np.pi * part), 0.0)
    return ratio


def pulse_times_s(
    motion: Motion,
    settings: TachometerSettings,
    slips: list[SlipInterval],
    duration_s: float,
    phase: float,
    *,
    tooth_errors: Floats | None = None,
) -> Floats:
    """Compute the pulse times of a tachometer [s after the start].

    `phase` is the position of the first pulse as a fraction of the pulse spacing, in [0, 1). `tooth_errors` are the
    position errors of the teeth as fractions of the spacing, shape (pulses per turn,).
    """
    # The breakpoints of the motion are also nodes, so that the result without slips is exact.
    corner = motion.time_s[(motion.time_s > 0.0) & (motion.time_s < duration_s)]
    node = np.unique(np.concatenate([np.arange(0.0, duration_s, _STEP_S), corner, [duration_s]]))
    chainage, speed = motion.at(node)
    step = np.diff(node)
    surplus = np.abs(speed) * slip_ratio(slips, node)
    rolled = np.abs(np.diff(chainage)) + (surplus[1:] + surplus[:-1]) / 2.0 * step
    turned = np.concatenate([[0.0], np.cumsum(np.maximum(rolled, 0.0))])
    apart = np.pi * (settings.wheel_diameter_m + settings.diameter_error_m) / settings.pulses_per_turn
    target = apart * np.arange(phase, turned[-1] / apart, 1.0)
    times = _times_at(target, node, turned, np.abs(speed) + surplus)
    if tooth_errors is None:
        return times
    # After a turn of the wheel in either direction, the same tooth is at the sensor again.
    tooth = np.cumsum(np.where(motion.at(times)[1] < 0.0, -1, 1)) % len(tooth_errors)
    moved = np.clip(target + apart * tooth_errors[tooth], 0.0, turned[-1])
    return _times_at(np.sort(moved), node, turned, np.abs(speed) + surplus)


def _times_at(target_m: Floats, node_s: Floats, turned_m: Floats, speed_mps: Floats) -> Floats:
    """Return the times at which the wheel has rolled the given distances, with constant acceleration between nodes."""
    step = np.diff(node_s)
    cell = np.clip(np.searchsorted(turned_m, target_m, side="left") - 1, 0, len(step) - 1)
    # s = v t + a t^2 / 2; a is constant between two nodes and chosen so that the wheel rolls the distance between them.
    start = speed_mps[cell]
    bend = 2.0 * (turned_m[cell + 1] - turned_m[cell] - start * step[cell]) / step[cell] ** 2
    ahead = target_m - turned_m[cell]
    root = np.sqrt(np.maximum(start**2 + 2.0 * bend * ahead, 0.0))
    with np.errstate(invalid="ignore", divide="ignore"):
        since = np.where(ahead > 0.0, 2.0 * ahead / (start + root), 0.0)
    return np.asarray(node_s[cell] + np.minimum(since, step[cell]))


def _miscount(time_s: Floats, settings: TachometerSettings, seed: int) -> Floats:
    """Return the pulse times with random pulses removed, and with random extra pulses inserted between teeth."""
    if not (settings.lost_chance or settings.doubled_chance) or len(time_s) < 2:
        return time_s
    lost, doubled, part = np.random.default_rng([seed, _MISCOUNT]).uniform(size=(3, len(time_s)))
    gap = np.diff(time_s, append=2.0 * time_s[-1] - time_s[-2])
    second = time_s + (0.1 + 0.5 * part) * gap
    kept = lost >= settings.lost_chance
    return np.sort(np.concatenate([time_s[kept], second[kept & (doubled < settings.doubled_chance)]]))


def pulse_table(simulation: Simulation, settings: TachometerSettings) -> pl.DataFrame:
    """Return the pulses of the tachometer, including its errors; for the columns see
    `railfix.simulate.sensor_columns.COLUMNS`.
    """
    scenario = simulation.scenario
    rng = np.random.default_rng([scenario.seed, _WHEEL])
    slips = wheel_slips(simulation, settings)
    teeth = None
    if settings.tooth_sigma > 0.0:
        draw = np.random.default_rng([scenario.seed, _TEETH]).standard_normal(settings.pulses_per_turn)
        teeth = np.clip(settings.tooth_sigma * draw, -0.45, 0.45)
    phase = float(rng.uniform())
    time = pulse_times_s(simulation.motion, settings, slips, scenario.duration_s, phase, tooth_errors=teeth)
    time = _miscount(time, settings, scenario.seed)
    speed = simulation.motion.at(time)[1]
    turning = np.abs(speed) * (1.0 + slip_ratio(slips, time))
    kept = turning >= settings.lowest_mps
    time, direction = time[kept], np.where(speed[kept] < 0.0, -1, 1).astype(np.int8)
    if settings.jitter_s > 0.0:
        time = time + settings.jitter_s * rng.standard_normal(len(time))
        order = np.argsort(time, kind="stable")
        time, direction = time[order], direction[order]
    if settings.resolution_s > 0.0:
        time = np.rint(time / settings.resolution_s) * settings.resolution_s
    tag = scenario.start + timedelta(time)
    return pl.DataFrame(
        {"time_gpst": tag, "pulse": np.arange(1, len(time) + 1, dtype=np.int64), "direction": direction}
    )


def slip_table(simulation: Simulation, settings: TachometerSettings) -> pl.DataFrame:
    """Return the true slips and slides of the wheel; for the columns see `railfix.simulate.sensor_columns.COLUMNS`."""
    scenario = simulation.scenario
    slips = wheel_slips(simulation, settings)
    start = scenario.start + timedelta([slip.start_s for slip in slips])
    end = scenario.start + timedelta([slip.end_s for slip in slips])
    ratio = np.array([slip.ratio for slip in slips], dtype=np.float64)
    return pl.DataFrame({"time_gpst": start, "end_gpst": end, "ratio": ratio})


_HALF_S: Final = 0.02  #: Largest half-width of the interval over which positions and attitudes are differenced [s].
_BLOCK: Final = 50_000  #: Number of samples computed in one step.
#: Length [m] of the lever arm from which the attitude is computed, long enough for rounding of positions to be
#: negligible.
_LEVER_M: Final = 10.0
#: Constants of WGS 84: normal gravity at the equator [m/s^2], Somigliana's constant, flattening, ratio m of centrifugal
#: acceleration to gravity, semi-major axis [m].
_GRAVITY: Final = (9.780_325_335_9, 1.931_852_652_41e-3, 1.0 / 298.257_223_563, 3.449_786_506_84e-3, 6_378_137.0)
_ECCENTRICITY_2: Final = 6.694_379_990_14e-3
#: Seeds of random streams: noise, drifts of accelerometer and gyroscope biases, walk of gyroscope biases, vibration.
_NOISE, _ACCEL_DRIFT, _GYRO_DRIFT, _WALK, _VIBRATION = 22, 23, 24, 25, 29


def gravity_mps2(latitude_deg: Floats, height_m: Floats) -> Floats:
    """Return the normal gravity [m/s^2], including centrifugal acceleration (NIMA TR8350.2, equations 4-1 and 4-3)."""
    equator, k, flattening, m, axis = _GRAVITY
    sine = np.sin(np.radians(latitude_deg)) ** 2
    ground = equator * (1.0 + k * sine) / np.sqrt(1.0 - _ECCENTRICITY_2 * sine)
    rise = 1.0 - 2.0 / axis * (1.0 + flattening + m - 2.0 * flattening * sine) * height_m + 3.0 * height_m**2 / axis**2
    return np.asarray(ground * rise)


def _pose(simulation: Simulation, offset_m: tuple[float, float, float], time_s: Floats) -> tuple[Floats, Floats]:
    """Return ECEF positions of a point of the body, shape (n, 3) [m], and the axes of the body, shape (n, 3, 3).

    The rows of the axes are the unit vectors forward, right and down.
    """
    along, across, up = offset_m
    truth, _ = simulation.body_truth(offset_m, time_s)
    aside, _ = simulation.body_truth((along, across + _LEVER_M, up), time_s)
    right = (aside.ecef_m - truth.ecef_m) / _LEVER_M
    return truth.ecef_m, np.stack([truth.forward, right, np.cross(truth.forward, right)], axis=1)


def true_motion(simulation: Simulation, offset_m: tuple[float, float, float], time_s: Floats, half_s: float) -> Floats:
    """Compute specific force [m/s^2] and angular rate [rad/s] relative to inertial space in body axes, shape (n, 6).

    The quantities are central differences of position and attitude over ``2 half_s``.
    """
    before, now, after = (_pose(simulation, offset_m, time_s + d) for d in (-half_s, 0.0, half_s))
    place, axes = now
    # The two differences of positions are formed before they are subtracted, which avoids cancellation.
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
    """Return the samples of the inertial sensor; for the columns see `railfix.simulate.sensor_columns.COLUMNS`."""
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
    """Return the vibration of the six axes at times, shape (n, 6), or the number 0 if both sigmas are 0."""
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
    """Add the sensor's errors to true values: misalignment, scale errors, biases, drifts, noise and quantisation, in
    this order.
    """
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
