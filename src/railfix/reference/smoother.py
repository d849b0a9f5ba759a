"""Smooth the distance between fixes: all sensors weighted by their variances, closed on the fixes.

The unknowns of each instant are the place along the track, the speed, and one slow error for each
kind of sensor: the lasting part of the Doppler speed's error, the difference and the scale of the
wheel's distance, the accelerometer's offset. A forward-backward smoother over the whole run
(`chain`) then shares the closing error of a gap back over it, in proportion to what each part of it
may have contributed, and its standard deviation grows from both ends to the middle. Which sensor
counts for how much is not chosen: their variances say so at every instant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices
from railfix.core.timescale import seconds
from railfix.motion.chain import Chain, singer_steps
from railfix.reference.settings import ReferenceSettings

#: Standard deviations of what nothing is known of: speed [m/s], difference of the wheel's distance [m].
_ANY_SPEED_MPS: Final = 100.0
_ANY_DISTANCE_M: Final = 1e4
#: Doppler speeds beyond this many standard deviations weigh less (P. J. Huber, 1964), in this many rounds.
_HUBER: Final = 2.0
_ROUNDS: Final = 4
#: Drift of the wheel's scale [1 per square root of s] and of the accelerometer's offset [m/s2 per square root of s].
_SCALE_DRIFT: Final = 3e-6
_OFFSET_DRIFT_MPS2: Final = 1e-3
#: Least standard deviations: of a reading of the wheel [m], of its difference over a step [m].
_LEAST_READING_M: Final = 1e-3
_LEAST_STEP_M: Final = 1e-4


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Measurements along one antenna's path at N instants; NaN where there is none."""

    time: Datetimes  #: Rising, steps of at most some seconds; shape (N,).
    #: Arc length of good fixes, shape (N,).
    fix_m: Floats
    fix_sigma_m: Floats
    #: Shape (N,).
    doppler_mps: Floats
    doppler_sigma_mps: Floats
    wheel_m: Floats  #: Cumulated distance of the wheel along rising chainage, from any start; shape (N,).
    wheel_sigma_m: float  #: Of one reading: half a pulse and the like.
    acceleration_mps2: Floats  #: Mean of each step along rising chainage, without gravity; shape (N - 1,).


@dataclass(frozen=True, kw_only=True)
class SmoothedReference:
    """Position and speed at every instant."""

    #: Shape (N,).
    arc_m: Floats
    sigma_m: Floats
    #: Shape (N,).
    speed_mps: Floats
    speed_sigma_mps: Floats
    wheel_scale: Floats  #: Share that the wheel's distance is too long by; NaN without a wheel; shape (N,).


class _Unknowns:
    """Column of each unknown."""

    def __init__(self, evidence: Evidence) -> None:
        self.place, self.speed, self.acceleration, self.count = 0, 1, 2, 3
        self.doppler = self._next(np.isfinite(evidence.doppler_mps).any())
        self.difference = self._next(np.isfinite(evidence.wheel_m).any())
        self.scale = self._next(self.difference >= 0)
        self.offset = self._next(np.isfinite(evidence.acceleration_mps2).any())

    def _next(self, present: object) -> int:
        if not present:
            return -1
        self.count += 1
        return self.count - 1


def smooth(evidence: Evidence, settings: ReferenceSettings) -> SmoothedReference:
    """Estimate position and speed at every instant from all measurements together, at least one fix among them.

    `doppler_bias_mps` and `slip_m` of the settings are those of the log, where it tells them.
    """
    t = seconds(evidence.time - evidence.time[0])
    fixed = np.flatnonzero(np.isfinite(evidence.fix_m))
    nominal = np.interp(t, t[fixed], evidence.fix_m[fixed])
    unknowns = _Unknowns(evidence)
    seen = np.flatnonzero(np.isfinite(evidence.doppler_mps))
    relief = np.ones(len(seen))
    for _ in range(_ROUNDS if len(seen) else 1):
        chain = Chain.empty(len(t), unknowns.count)
        chain = _with_motion(chain, unknowns, evidence, np.diff(t), np.diff(nominal), settings)
        row = _one(unknowns, unknowns.place)
        chain = chain.with_observations(
            fixed, row, (evidence.fix_m - nominal)[fixed], evidence.fix_sigma_m[fixed] ** -2.0
        )
        chain = _with_doppler(chain, unknowns, evidence, np.diff(t), seen, relief, settings)
        chain = _with_wheel(chain, unknowns, evidence, np.diff(t), nominal, settings)
        chain = _with_offset(chain, unknowns, np.diff(t), settings)
        value, covariance = chain.solve()
        if len(seen):
            left = np.abs(evidence.doppler_mps - value[:, unknowns.speed] - value[:, unknowns.doppler])[seen]
            relief = np.minimum(1.0, _HUBER * evidence.doppler_sigma_mps[seen] / np.maximum(left, 1e-12))
    spread = np.sqrt(np.maximum(np.einsum("kii->ki", covariance), 0.0))
    return SmoothedReference(
        arc_m=nominal + value[:, unknowns.place],
        sigma_m=spread[:, unknowns.place],
        speed_mps=value[:, unknowns.speed],
        speed_sigma_mps=spread[:, unknowns.speed],
        wheel_scale=value[:, unknowns.scale] if unknowns.scale >= 0 else np.full(len(t), np.nan),
    )


def _with_motion(
    chain: Chain, unknowns: _Unknowns, evidence: Evidence, dt: Floats, moved: Floats, settings: ReferenceSettings
) -> Chain:
    """Position, speed and a time-correlated acceleration (Singer's model), with the accelerometer's measurements."""
    first = np.array([0])
    for unknown, sigma in ((unknowns.speed, _ANY_SPEED_MPS), (unknowns.acceleration, settings.motion_mps2)):
        chain = chain.with_observations(first, _one(unknowns, unknown), np.zeros(1), np.full(1, sigma**-2))
    turn, noise = singer_steps(dt, settings.motion_mps2, settings.motion_s)
    before, after = np.zeros((2, len(dt), 3, unknowns.count))
    before[:, :, :3], after[:, :, :3] = -turn, np.eye(3)
    value = np.zeros((len(dt), 3))
    value[:, 0] = -moved
    noise[:, [0, 1], [0, 1]] += _LEAST_STEP_M**2
    chain = chain.with_steps(before, after, value, np.asarray(np.linalg.inv(noise)))
    measured = np.isfinite(evidence.acceleration_mps2)
    if measured.any():
        before, after = np.zeros((2, len(dt), 1, unknowns.count))
        after[:, 0, unknowns.speed], before[:, 0, unknowns.speed] = 1.0, -1.0
        before[:, 0, unknowns.offset] = dt
        gained = np.where(measured, evidence.acceleration_mps2, 0.0) * dt
        weight = np.where(measured, 1.0 / (settings.acceleration_mps2**2 * dt), 0.0)
        chain = chain.with_steps(before, after, gained[:, None], weight[:, None, None])
    return chain


def _with_doppler(
    chain: Chain,
    unknowns: _Unknowns,
    evidence: Evidence,
    dt: Floats,
    seen: Indices,
    relief: Floats,
    settings: ReferenceSettings,
) -> Chain:
    """Doppler speed = speed + time-correlated error + noise; that error is a first-order Gauss-Markov process."""
    if unknowns.doppler < 0:
        return chain
    kept = np.exp(-dt / settings.doppler_bias_s)
    variance = settings.doppler_bias_mps**2
    chain = chain.with_observations(
        np.array([0]), _one(unknowns, unknowns.doppler), np.zeros(1), np.full(1, 1.0 / variance)
    )
    chain = _with_walk(chain, unknowns.doppler, kept, 1.0 / (variance * (1.0 - kept**2)))
    row = _one(unknowns, unknowns.speed) + _one(unknowns, unknowns.doppler)
    chain = chain.with_observations(
        seen, row, evidence.doppler_mps[seen], relief * evidence.doppler_sigma_mps[seen] ** -2.0
    )
    return chain


def _with_wheel(
    chain: Chain, unknowns: _Unknowns, evidence: Evidence, dt: Floats, nominal: Floats, settings: ReferenceSettings
) -> Chain:
    """Reading = position + difference; the difference changes with distance by the scale error, and by slip."""
    if unknowns.difference < 0:
        return chain
    read = np.flatnonzero(np.isfinite(evidence.wheel_m))
    way = np.diff(evidence.wheel_m)
    known = np.isfinite(way)
    way = np.where(known, way, 0.0)
    row = _one(unknowns, unknowns.place) + _one(unknowns, unknowns.difference)
    start = evidence.wheel_m[read[0]] - nominal[read[0]]
    weight = np.full(len(read), max(evidence.wheel_sigma_m, _LEAST_READING_M) ** -2)
    chain = chain.with_observations(read, row, evidence.wheel_m[read] - start - nominal[read], weight)
    for unknown, sigma in ((unknowns.difference, _ANY_DISTANCE_M), (unknowns.scale, settings.wheel_scale)):
        chain = chain.with_observations(np.array([0]), _one(unknowns, unknown), np.zeros(1), np.full(1, sigma**-2))
    before, after = np.zeros((2, len(way), 1, unknowns.count))
    after[:, 0, unknowns.difference], before[:, 0, unknowns.difference] = 1.0, -1.0
    before[:, 0, unknowns.scale] = -way
    variance = np.where(known, settings.slip_m**2 * np.abs(way) + _LEAST_STEP_M**2, _ANY_DISTANCE_M**2)
    chain = chain.with_steps(before, after, np.zeros((len(way), 1)), (1.0 / variance)[:, None, None])
    chain = _with_walk(chain, unknowns.scale, np.ones(len(dt)), 1.0 / (_SCALE_DRIFT**2 * dt))
    return chain


def _with_offset(chain: Chain, unknowns: _Unknowns, dt: Floats, settings: ReferenceSettings) -> Chain:
    """The accelerometer's offset, a random walk."""
    if unknowns.offset >= 0:
        prior = np.full(1, settings.acceleration_bias_mps2**-2)
        chain = chain.with_observations(np.array([0]), _one(unknowns, unknowns.offset), np.zeros(1), prior)
        chain = _with_walk(chain, unknowns.offset, np.ones(len(dt)), 1.0 / (_OFFSET_DRIFT_MPS2**2 * dt))
    return chain


def _with_walk(chain: Chain, unknown: int, kept: Floats, weight: Floats) -> Chain:
    """``x_{k+1} = kept x_k`` with noise, for one unknown."""
    before, after = np.zeros((2, len(kept), 1, chain.right.shape[1]))
    after[:, 0, unknown], before[:, 0, unknown] = 1.0, -kept
    chain = chain.with_steps(before, after, np.zeros((len(kept), 1)), weight[:, None, None])
    return chain


def _one(unknowns: _Unknowns, unknown: int) -> Floats:
    row = np.zeros(unknowns.count)
    row[unknown] = 1.0
    return row


@dataclass(frozen=True, kw_only=True)
class Closings:
    """Closing errors of a measured distance between fixes, over W windows."""

    error_m: Floats  #: Way measured less way between the fixes, shape (W,).
    white_m2: Floats  #: Variance that single readings and the fixes explain, shape (W,) [m2].
    duration_s: Floats  #: Shape (W,).
    way_m: Floats  #: Shape (W,).

    def __len__(self) -> int:
        return len(self.error_m)

    def excess_m2(self) -> float:
        """Variance in excess of the model, from the 80th percentile of the squared errors [m2]."""
        return max(float(np.quantile(self.error_m**2, 0.8)) / _CHI2_80 - float(np.median(self.white_m2)), 0.0)


def closings(
    time: Datetimes,
    way_m: Floats,
    variance_m2: Floats,
    fix_m: Floats,
    fix_sigma_m: Floats,
    *,
    window_s: float,
) -> Closings:
    """Compare a measured distance with that between fixes, over windows of about a length.

    `way_m`, `variance_m2`: way up to each fix, and the variance of its white part since the start; NaN where unknown.
    """
    t = seconds(time - time[0])
    end = np.searchsorted(t, t + window_s - 0.5)
    start = np.flatnonzero(end < len(t))
    start = start[t[end[start]] - t[start] <= 1.5 * window_s]
    end = end[start]
    error = (way_m[end] - way_m[start]) - (fix_m[end] - fix_m[start])
    white = variance_m2[end] - variance_m2[start] + fix_sigma_m[end] ** 2 + fix_sigma_m[start] ** 2
    usable = np.isfinite(error) & (white < 1e4)
    start, end = start[usable], end[usable]
    return Closings(
        error_m=error[usable], white_m2=white[usable], duration_s=t[end] - t[start], way_m=fix_m[end] - fix_m[start]
    )


def lasting_error_mps(misclosures: Closings, settings: ReferenceSettings) -> float:
    """Standard deviation of the time-correlated Doppler speed error [m/s], from the closing errors.

    What the noise of single speeds and of the fixes does not explain is the lasting part. That of the settings
    where fewer than `WINDOWS` windows are there.
    """
    if len(misclosures) < WINDOWS:
        return settings.doppler_bias_mps
    tau = settings.doppler_bias_s
    ratio = float(np.median(misclosures.duration_s)) / tau
    gain = 2.0 * tau**2 * (ratio - 1.0 + np.exp(-ratio))
    return float(np.sqrt(max(misclosures.excess_m2() / gain, _LEAST_LASTING_MPS**2)))


def slip_m(misclosures: Closings, settings: ReferenceSettings) -> float:
    """Random error of the wheel [m per square root of m], from the closing errors.

    Its scale is taken off first. That of the settings where fewer than `WINDOWS` windows in motion are there.
    """
    moving = np.abs(misclosures.way_m) > 1.0
    if moving.sum() < WINDOWS:
        return settings.slip_m
    error, way = misclosures.error_m[moving], misclosures.way_m[moving]
    error = error - float(np.median(error / way)) * way
    excess = float(np.quantile(error**2 / np.abs(way), 0.8)) / _CHI2_80
    excess -= float(np.median(misclosures.white_m2[moving] / np.abs(way)))
    return float(np.sqrt(max(excess, _LEAST_SLIP_M**2)))


#: Windows that an estimate needs.
WINDOWS: Final = 20
#: 80th percentile of a squared standard normal variable.
_CHI2_80: Final = 1.6424
_LEAST_LASTING_MPS: Final = 1e-3
_LEAST_SLIP_M: Final = 1e-3
