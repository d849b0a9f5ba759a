"""Smooth positions between fixes with sensors weighted by inverse variances, and assemble the reference.

The states at each instant are position, speed and acceleration, and slowly varying errors of the sensors: the error of
the Doppler speed, the difference between wheel distance and position, the wheel's scale error, and the accelerometer's
offset. A forward-backward smoother distributes the closing error over a gap in proportion to the variances of the
measurements.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from filterpy.kalman import KalmanFilter

from railfix.core.arrays import Datetimes, Floats, Indices, places_in_groups
from railfix.core.nearest_times import nearest_rows
from railfix.core.timescale import seconds, timedelta
from railfix.io.reference_log import AntennaReference
from railfix.motion.singer import singer_steps
from railfix.reference.fixes import ACCELERATION_BIAS_MPS2, MOTION_MPS2, MOTION_S, Fixes, ReferenceSettings
from railfix.track.trajectory import Trajectory

_ANY_SPEED_MPS: Final = 100.0  #: Standard deviation of the initial speed, which is unknown [m/s].
#: Standard deviation of the initial position, and of the difference between wheel distance and position, both of which
#: are unknown [m].
_ANY_DISTANCE_M: Final = 1e4
#: Doppler speeds with a residual above this number of standard deviations are down-weighted (P. J. Huber, 1964).
_HUBER: Final = 2.0
_ROUNDS: Final = 4  #: Number of rounds of smoothing and down-weighting.
_SCALE_DRIFT: Final = 3e-6  #: Random-walk density of the wheel's scale error [1 per square root of s].
_OFFSET_DRIFT_MPS2: Final = 1e-3  #: Random-walk density of the accelerometer's offset [m/s2 per square root of s].
_LEAST_READING_M: Final = 1e-3  #: Smaller standard deviations of a wheel reading are raised to this value [m].
_LEAST_STEP_M: Final = 1e-4  #: Standard deviation that is added to the process noise of every step [m].


SAME_INSTANT_NS: Final = 20_000_000  #: Time tags belong to one instant if they differ by at most this value [ns].


def instants(rows: Datetimes, others: Sequence[Datetimes]) -> Datetimes:
    """Return the instants of a reference: the times of the log's rows, receiver epochs, and regular steps in gaps."""
    merged = rows
    for other in others:
        new = other[(other > rows[0]) & (other < rows[-1])]
        merged = np.union1d(merged, new[nearest_rows(merged, new, within_ns=SAME_INSTANT_NS) < 0])
    usual = float(np.median(seconds(np.diff(rows))))
    step = seconds(np.diff(merged))
    pieces = np.where(step > 1.5 * usual, np.ceil(step / usual - 1e-6), 1.0).astype(np.int64)
    first, number = places_in_groups(pieces)
    filled = merged[first] + timedelta(step[first] * number / pieces[first])
    return np.append(filled, merged[-1])


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Measurements along one antenna's path at N instants; NaN where missing."""

    time: Datetimes  #: Times of the instants, shape (N,); they increase by a few seconds at most.
    fix_m: Floats  #: Arc length of good fixes, shape (N,).
    fix_sigma_m: Floats  #: Standard deviation of `fix_m`, shape (N,).
    doppler_mps: Floats  #: Speed along the path from Dopplers, shape (N,).
    doppler_sigma_mps: Floats  #: Standard deviation of `doppler_mps`, shape (N,).
    wheel_m: Floats  #: Cumulative wheel distance along rising chainage, from an arbitrary origin, shape (N,).
    wheel_sigma_m: float  #: Standard deviation of one reading of the wheel's distance.
    acceleration_mps2: Floats  #: Mean acceleration along the path in each step, without gravity, shape (N - 1,).


@dataclass(frozen=True, kw_only=True)
class SmoothedReference:
    """Position and speed at every instant."""

    arc_m: Floats  #: Arc length, shape (N,).
    sigma_m: Floats  #: Standard deviation of the arc length, shape (N,).
    speed_mps: Floats  #: Speed along the path, shape (N,).
    speed_sigma_mps: Floats  #: Standard deviation of the speed, shape (N,).
    #: Scale error of the wheel, positive if the wheel's distance is too long; NaN without a wheel; shape (N,).
    wheel_scale: Floats


class _States:
    """Index of each state in the state vector; -1 for states that are not estimated, because no measurement requires
    them.

    The states are position, speed and acceleration of the train; with Dopplers, the time-correlated error of the
    Doppler speed; with a wheel, the difference between wheel distance and position, and the wheel's scale error; with
    an accelerometer, the accelerometer's offset, and the speed at the previous instant.
    """

    def __init__(self, evidence: Evidence) -> None:
        self.place, self.speed, self.acceleration, self.count = 0, 1, 2, 3
        self.doppler = self._next(np.isfinite(evidence.doppler_mps).any())
        self.difference = self._next(np.isfinite(evidence.wheel_m).any())
        self.scale = self._next(self.difference >= 0)
        self.offset = self._next(np.isfinite(evidence.acceleration_mps2).any())
        self.speed_before = self._next(self.offset >= 0)

    def _next(self, present: object) -> int:
        if not present:
            return -1
        self.count += 1
        return self.count - 1


def smooth(evidence: Evidence, settings: ReferenceSettings) -> SmoothedReference:
    """Estimate position and speed at every instant from all measurements, which include at least one fix.

    A Kalman filter runs forward and a Rauch-Tung-Striebel smoother backward (`filterpy.kalman.KalmanFilter`). Doppler
    speeds are weighted by Huber's function of their residuals, in `_ROUNDS` rounds.
    """
    states = _States(evidence)
    dt = seconds(np.diff(evidence.time))
    origin_m = float(evidence.fix_m[np.isfinite(evidence.fix_m)][0])
    transition, noise = _motion(states, evidence, dt, settings)
    value, variance, design = _measurements(states, evidence, dt, origin_m, settings)
    has_doppler, relief = np.isfinite(evidence.doppler_mps), np.ones(len(evidence.time))
    for _ in range(_ROUNDS if has_doppler.any() else 1):
        weighed = variance.copy()
        weighed[:, _DOPPLER] /= relief
        mean, spread = _filter_and_smooth(states, settings, (transition, noise), (value, weighed, design))
        if has_doppler.any():
            left = np.abs(evidence.doppler_mps - mean[:, states.speed] - mean[:, states.doppler])
            relief = np.fmin(1.0, _HUBER * evidence.doppler_sigma_mps / np.maximum(left, 1e-12))
    sigma = np.sqrt(np.maximum(np.einsum("kii->ki", spread), 0.0))
    return SmoothedReference(
        arc_m=origin_m + mean[:, states.place],
        sigma_m=sigma[:, states.place],
        speed_mps=mean[:, states.speed],
        speed_sigma_mps=sigma[:, states.speed],
        wheel_scale=mean[:, states.scale] if states.scale >= 0 else np.full(len(mean), np.nan),
    )


def _filter_and_smooth(
    states: _States,
    settings: ReferenceSettings,
    motion: tuple[Floats, Floats],
    measured: tuple[Floats, Floats, Floats],
) -> tuple[Floats, Floats]:
    """Return means (N, n) and covariances (N, n, n) of the states given all measurements."""
    (transition, noise), (value, variance, design) = motion, measured
    count, known = len(value), np.isfinite(value)
    kalman = KalmanFilter(dim_x=states.count, dim_z=value.shape[1])
    kalman.x, kalman.P = np.zeros(states.count), np.diag(_first_sigmas(states, settings) ** 2)
    means, covariances = np.empty((count, states.count)), np.empty((count, states.count, states.count))
    for k in range(count):
        if k:
            kalman.predict(F=transition[k], Q=noise[k])
        has = known[k]
        if has.any():
            kalman.update(value[k, has], R=np.diag(variance[k, has]), H=design[k, has])
        means[k], covariances[k] = kalman.x, kalman.P
    smoothed, spread, _, _ = kalman.rts_smoother(means, covariances, transition, noise)
    return np.asarray(smoothed), np.asarray(spread)


def _first_sigmas(states: _States, settings: ReferenceSettings) -> Floats:
    """Return the standard deviations of the states at the first instant, where all states have a mean of 0."""
    sigmas = {
        states.place: _ANY_DISTANCE_M,
        states.speed: _ANY_SPEED_MPS,
        states.acceleration: MOTION_MPS2,
        states.doppler: settings.doppler_bias_mps,
        states.difference: _ANY_DISTANCE_M,
        states.scale: settings.wheel_scale,
        states.offset: ACCELERATION_BIAS_MPS2,
        states.speed_before: _ANY_SPEED_MPS,
    }
    return np.array([sigmas[column] for column in range(states.count)])


def _motion(states: _States, evidence: Evidence, dt: Floats, settings: ReferenceSettings) -> tuple[Floats, Floats]:
    """Return the transitions from the previous instant to each instant, and the noise covariances, shapes (N, n, n).

    The states are position, speed and a time-correlated acceleration (Singer's model). The Doppler speed's error is a
    first-order Gauss-Markov process. The difference between wheel distance and position grows by the scale error times
    the distance; slip adds a random change. The wheel's scale error and the accelerometer's offset are random walks.
    """
    count = len(evidence.time)
    transition, noise = np.zeros((2, count, states.count, states.count))
    transition[0] = np.eye(states.count)
    after = slice(1, None)
    transition[after, :3, :3], noise[after, :3, :3] = singer_steps(dt, MOTION_MPS2, MOTION_S)
    noise[after, [0, 1], [0, 1]] += _LEAST_STEP_M**2
    if (d := states.doppler) >= 0:
        kept = np.exp(-dt / settings.doppler_bias_s)
        transition[after, d, d], noise[after, d, d] = kept, settings.doppler_bias_mps**2 * (1.0 - kept**2)
    if (w := states.difference) >= 0:
        distance = np.diff(evidence.wheel_m)
        slip = settings.slip_m**2 * np.abs(distance) + _LEAST_STEP_M**2
        transition[after, w, w], transition[after, w, states.scale] = 1.0, np.nan_to_num(distance)
        noise[after, w, w] = np.where(np.isfinite(distance), slip, _ANY_DISTANCE_M**2)
        transition[after, states.scale, states.scale] = 1.0
        noise[after, states.scale, states.scale] = _SCALE_DRIFT**2 * dt
    if (o := states.offset) >= 0:
        transition[after, o, o], noise[after, o, o] = 1.0, _OFFSET_DRIFT_MPS2**2 * dt
        transition[after, states.speed_before, states.speed] = 1.0
    return transition, noise


#: Columns of `_measurements` by kind of measurement.
_FIX, _DOPPLER, _WHEEL, _ACCELERATION = range(4)


def _measurements(
    states: _States, evidence: Evidence, dt: Floats, origin_m: float, settings: ReferenceSettings
) -> tuple[Floats, Floats, Floats]:
    """Return the measurements (N, 4), NaN where missing; their variances (N, 4); and the design matrices (N, 4, n).

    Fix = position. Doppler speed = speed + error. Wheel distance = position + difference. Mean acceleration over a step
    times its duration = increase of speed + offset times the duration.
    """
    count = len(evidence.time)
    value, variance = np.full((count, 4), np.nan), np.ones((count, 4))
    design = np.zeros((count, 4, states.count))
    value[:, _FIX], variance[:, _FIX] = evidence.fix_m - origin_m, evidence.fix_sigma_m**2
    design[:, _FIX, states.place] = 1.0
    if states.doppler >= 0:
        value[:, _DOPPLER], variance[:, _DOPPLER] = evidence.doppler_mps, evidence.doppler_sigma_mps**2
        design[:, _DOPPLER, [states.speed, states.doppler]] = 1.0
    if states.difference >= 0:
        start_m = float(evidence.wheel_m[np.isfinite(evidence.wheel_m)][0])
        value[:, _WHEEL] = evidence.wheel_m - start_m
        variance[:, _WHEEL] = max(evidence.wheel_sigma_m, _LEAST_READING_M) ** 2
        design[:, _WHEEL, [states.place, states.difference]] = 1.0
    if states.offset >= 0:
        value[1:, _ACCELERATION] = evidence.acceleration_mps2 * dt
        variance[1:, _ACCELERATION] = settings.acceleration_mps2**2 * dt
        design[1:, _ACCELERATION, states.speed], design[1:, _ACCELERATION, states.speed_before] = 1.0, -1.0
        design[1:, _ACCELERATION, states.offset] = dt
    return value, variance, design


@dataclass(frozen=True, kw_only=True)
class Closings:
    """Closing errors of a sensor over W windows: measured distance minus distance between two fixes."""

    error_m: Floats  #: Measured distance minus distance between the fixes, shape (W,).
    white_m2: Floats  #: Variance due to white noise of the sensor and of the fixes, shape (W,) [m2].
    duration_s: Floats  #: Duration of the window, shape (W,).
    distance_m: Floats  #: Distance between the fixes along rising chainage, shape (W,).

    def __len__(self) -> int:
        return len(self.error_m)

    def excess_m2(self) -> float:
        """Return the variance of the closing errors minus the variance due to white noise, at least 0 [m2].

        The variance of the closing errors is estimated from the 80th percentile of the squared errors.
        """
        return max(float(np.quantile(self.error_m**2, 0.8)) / _CHI2_80 - float(np.median(self.white_m2)), 0.0)


def closings(
    time: Datetimes, distance_m: Floats, variance_m2: Floats, fix_m: Floats, fix_sigma_m: Floats, *, window_s: float
) -> Closings:
    """Return the closing errors of a sensor over windows of `window_s`.

    `distance_m` (measured by the sensor) and `variance_m2` are cumulative up to each fix.
    """
    t = seconds(time - time[0])
    end = np.searchsorted(t, t + window_s - 0.5)
    start = np.flatnonzero(end < len(t))
    start = start[t[end[start]] - t[start] <= 1.5 * window_s]
    end = end[start]
    error = (distance_m[end] - distance_m[start]) - (fix_m[end] - fix_m[start])
    white = variance_m2[end] - variance_m2[start] + fix_sigma_m[end] ** 2 + fix_sigma_m[start] ** 2
    usable = np.isfinite(error) & (white < 1e4)
    start, end = start[usable], end[usable]
    return Closings(
        error_m=error[usable],
        white_m2=white[usable],
        duration_s=t[end] - t[start],
        distance_m=fix_m[end] - fix_m[start],
    )


def lasting_error_mps(misclosures: Closings, settings: ReferenceSettings) -> float:
    """Return the sigma of the time-correlated error of the Doppler speed [m/s], estimated from the closing errors.

    With fewer than `WINDOWS` windows, the setting `doppler_bias_mps` is returned.
    """
    if len(misclosures) < WINDOWS:
        return settings.doppler_bias_mps
    tau = settings.doppler_bias_s
    ratio = float(np.median(misclosures.duration_s)) / tau
    gain = 2.0 * tau**2 * (ratio - 1.0 + np.exp(-ratio))
    return float(np.sqrt(max(misclosures.excess_m2() / gain, _LEAST_LASTING_MPS**2)))


def slip_m(misclosures: Closings, settings: ReferenceSettings) -> float:
    """Estimate the wheel's random error [m per square root of m] from the closing errors, excluding the scale error.

    With fewer than `WINDOWS` windows in motion, the setting `slip_m` is returned.
    """
    moving = np.abs(misclosures.distance_m) > 1.0
    if moving.sum() < WINDOWS:
        return settings.slip_m
    error, distance = misclosures.error_m[moving], misclosures.distance_m[moving]
    error = error - float(np.median(error / distance)) * distance
    excess = float(np.quantile(error**2 / np.abs(distance), 0.8)) / _CHI2_80
    excess -= float(np.median(misclosures.white_m2[moving] / np.abs(distance)))
    return float(np.sqrt(max(excess, _LEAST_SLIP_M**2)))


WINDOWS: Final = 20  #: A quantity is estimated only from at least this number of windows.
#: 80th percentile of a squared standard normal variable.
_CHI2_80: Final = 1.6424
_LEAST_LASTING_MPS: Final = 1e-3
_LEAST_SLIP_M: Final = 1e-3


@dataclass(frozen=True, kw_only=True)
class Gap:
    """Gap between two good fixes that are farther apart than the log's usual step."""

    start: np.datetime64
    end: np.datetime64
    length_s: float
    bridged: bool


@dataclass(frozen=True, kw_only=True)
class Built:
    """Reference trajectory of one antenna, with its fixes and gaps."""

    reference: AntennaReference
    fixes: Fixes  #: Every row of the position log with its reasons for rejection.
    gaps: tuple[Gap, ...]
    #: Number of instants that have no reference, by reason: ``before_first_fix``, ``after_last_fix``, ``long_gap`` or
    #: ``uncertain``.
    left_out: dict[str, int]
    bridged_by: dict[str, int]  #: Number of bridged instants, by the sensors that have measurements there.
    facts: dict[str, Any]  #: Estimated and used parameters, as plain values.


def assemble_reference(
    evidence: Evidence,
    smoothed: SmoothedReference,
    fixes: Fixes,
    excess: Floats,
    *,
    trajectory: Trajectory,
    settings: ReferenceSettings,
    facts: dict[str, Any],
) -> Built:
    """Return one antenna's reference trajectory: fixes, and smoothed positions between the fixes.

    `excess`, shape (G - 1,), has the factors by which standard deviations are increased in the gaps between G good
    fixes.
    """
    time, good = evidence.time, fixes.good
    at = np.flatnonzero(np.isfinite(evidence.fix_m))
    is_fix = np.zeros(len(time), dtype=np.bool_)
    is_fix[at] = True
    after = np.clip(np.searchsorted(at, np.arange(len(time))), 1, len(at) - 1)
    length = seconds(time[at[after]] - time[at[after - 1]])
    t = seconds(time - time[0])
    common = np.interp(t, t[at], evidence.fix_sigma_m[at])
    sigma = np.where(is_fix, common, np.hypot(smoothed.sigma_m * excess[after - 1], common))
    arc = np.where(is_fix, evidence.fix_m, smoothed.arc_m)
    long = ~is_fix & (length > settings.max_gap_s)
    uncertain = ~is_fix & ~long & (sigma > settings.max_sigma_m)
    keep = np.flatnonzero(~long & ~uncertain)
    reference = AntennaReference(
        time=time[keep],
        ecef_m=trajectory.at_arc(arc[keep]),
        chainage_m=trajectory.chainage_at(arc[keep]),
        speed_mps=smoothed.speed_mps[keep],
        sigma_m=sigma[keep],
        source=np.where(is_fix[keep], "rtk", "bridged"),
        environment=np.full(len(keep), ""),
    )
    usual = float(np.median(seconds(np.diff(fixes.time))))
    step = seconds(np.diff(fixes.time[good]))
    gaps = tuple(
        Gap(
            start=fixes.time[good[i]],
            end=fixes.time[good[i + 1]],
            length_s=float(step[i]),
            bridged=bool(step[i] <= settings.max_gap_s),
        )
        for i in np.flatnonzero(step > 1.5 * usual).tolist()
    )
    return Built(
        reference=reference,
        fixes=fixes,
        gaps=gaps,
        left_out={
            "before_first_fix": int((fixes.time < time[0]).sum()),
            "after_last_fix": int((fixes.time > time[-1]).sum()),
            "long_gap": int(long.sum()),
            "uncertain": int(uncertain.sum()),
        },
        bridged_by=_name_bridges(evidence, keep[~is_fix[keep]]),
        facts=facts,
    )


def _name_bridges(evidence: Evidence, rows: Indices) -> dict[str, int]:
    """Return the number of bridged instants, by the combination of sensors that have a measurement within 1.5 s."""
    measured = {
        "doppler": np.isfinite(evidence.doppler_mps),
        "pulses": np.isfinite(evidence.wheel_m),
        "acceleration": np.append(np.isfinite(evidence.acceleration_mps2), np.False_),
    }
    code = np.zeros(len(rows), dtype=np.int64)
    for i, mask in enumerate(measured.values()):
        near = nearest_rows(evidence.time[mask], evidence.time[rows], within_ns=_NEAR_NS) >= 0
        code |= near.astype(np.int64) << i
    counts = {}
    for c in np.unique(code).tolist():
        name = " and ".join(name for i, name in enumerate(measured) if c >> i & 1) or "nothing"
        counts[name] = int((code == c).sum())
    return counts


#: A measurement counts for a bridged instant if it is at most this time away [ns]; the value allows for one missing
#: epoch of a 1 Hz sensor.
_NEAR_NS: Final = 1_500_000_000
