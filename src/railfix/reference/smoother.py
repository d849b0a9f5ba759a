"""Smooth the distance between fixes, all sensors weighted by their variances, and assemble the reference.

Unknown at each instant are place, speed, and one slow error for each kind of sensor: of the Doppler speed, the
difference and scale of the wheel's distance, the accelerometer's offset. A forward-backward smoother (`chain`) shares
the closing error of a gap in proportion to what each part may have contributed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices, places_in_groups
from railfix.core.timescale import nearest_rows, seconds, timedelta
from railfix.io.reference_log import AntennaReference
from railfix.motion.chain import Chain, singer_steps
from railfix.reference.fixes import ACCELERATION_BIAS_MPS2, MOTION_MPS2, MOTION_S, Fixes, ReferenceSettings
from railfix.track.trajectory import Trajectory

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


SAME_INSTANT_NS: Final = 20_000_000  #: Tags that differ by no more belong to one instant [ns].


def instants(rows: Datetimes, others: Sequence[Datetimes]) -> Datetimes:
    """Return the instants of a reference: rows of the log, receiver epochs, regular steps elsewhere."""
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
    """Estimate position and speed at every instant from all measurements, at least one fix among them."""
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
        chain = _with_offset(chain, unknowns, np.diff(t))
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
    chain = _with_prior(chain, unknowns.speed, _ANY_SPEED_MPS)
    chain = _with_prior(chain, unknowns.acceleration, MOTION_MPS2)
    turn, noise = singer_steps(dt, MOTION_MPS2, MOTION_S)
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
    chain = _with_prior(chain, unknowns.doppler, settings.doppler_bias_mps)
    chain = _with_walk(chain, unknowns.doppler, kept, 1.0 / (variance * (1.0 - kept**2)))
    row = _one(unknowns, unknowns.speed) + _one(unknowns, unknowns.doppler)
    weight = relief * evidence.doppler_sigma_mps[seen] ** -2.0
    return chain.with_observations(seen, row, evidence.doppler_mps[seen], weight)


def _with_wheel(
    chain: Chain, unknowns: _Unknowns, evidence: Evidence, dt: Floats, nominal: Floats, settings: ReferenceSettings
) -> Chain:
    """Reading = position + difference; the difference changes with distance by the scale error, and by slip."""
    if unknowns.difference < 0:
        return chain
    read = np.flatnonzero(np.isfinite(evidence.wheel_m))
    distance = np.diff(evidence.wheel_m)
    known = np.isfinite(distance)
    distance = np.where(known, distance, 0.0)
    row = _one(unknowns, unknowns.place) + _one(unknowns, unknowns.difference)
    start = evidence.wheel_m[read[0]] - nominal[read[0]]
    weight = np.full(len(read), max(evidence.wheel_sigma_m, _LEAST_READING_M) ** -2)
    chain = chain.with_observations(read, row, evidence.wheel_m[read] - start - nominal[read], weight)
    chain = _with_prior(chain, unknowns.difference, _ANY_DISTANCE_M)
    chain = _with_prior(chain, unknowns.scale, settings.wheel_scale)
    before, after = np.zeros((2, len(distance), 1, unknowns.count))
    after[:, 0, unknowns.difference], before[:, 0, unknowns.difference] = 1.0, -1.0
    before[:, 0, unknowns.scale] = -distance
    variance = np.where(known, settings.slip_m**2 * np.abs(distance) + _LEAST_STEP_M**2, _ANY_DISTANCE_M**2)
    chain = chain.with_steps(before, after, np.zeros((len(distance), 1)), (1.0 / variance)[:, None, None])
    return _with_walk(chain, unknowns.scale, np.ones(len(dt)), 1.0 / (_SCALE_DRIFT**2 * dt))


def _with_offset(chain: Chain, unknowns: _Unknowns, dt: Floats) -> Chain:
    """Add the accelerometer's offset, a random walk."""
    if unknowns.offset >= 0:
        chain = _with_prior(chain, unknowns.offset, ACCELERATION_BIAS_MPS2)
        chain = _with_walk(chain, unknowns.offset, np.ones(len(dt)), 1.0 / (_OFFSET_DRIFT_MPS2**2 * dt))
    return chain


def _with_prior(chain: Chain, unknown: int, sigma: float) -> Chain:
    """Add the expectation 0 of an unknown at the first instant."""
    row = np.eye(chain.right.shape[1])[unknown]
    return chain.with_observations(np.array([0]), row, np.zeros(1), np.full(1, sigma**-2))


def _with_walk(chain: Chain, unknown: int, kept: Floats, weight: Floats) -> Chain:
    """``x_{k+1} = kept x_k`` with noise, for one unknown."""
    before, after = np.zeros((2, len(kept), 1, chain.right.shape[1]))
    after[:, 0, unknown], before[:, 0, unknown] = 1.0, -kept
    return chain.with_steps(before, after, np.zeros((len(kept), 1)), weight[:, None, None])


def _one(unknowns: _Unknowns, unknown: int) -> Floats:
    row = np.zeros(unknowns.count)
    row[unknown] = 1.0
    return row


@dataclass(frozen=True, kw_only=True)
class Closings:
    """Closing errors of a measured distance between fixes, over W windows."""

    error_m: Floats  #: Distance measured less distance between the fixes, shape (W,).
    white_m2: Floats  #: Variance that single readings and the fixes explain, shape (W,) [m2].
    duration_s: Floats  #: Shape (W,).
    distance_m: Floats  #: Shape (W,).

    def __len__(self) -> int:
        return len(self.error_m)

    def excess_m2(self) -> float:
        """Return the variance in excess of the model, from the 80th percentile of the squared errors [m2]."""
        return max(float(np.quantile(self.error_m**2, 0.8)) / _CHI2_80 - float(np.median(self.white_m2)), 0.0)


def closings(
    time: Datetimes, distance_m: Floats, variance_m2: Floats, fix_m: Floats, fix_sigma_m: Floats, *, window_s: float
) -> Closings:
    """Compare a measured distance with that between fixes over windows; `distance_m` and variance up to each fix."""
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
    """Return the sigma of the time-correlated Doppler speed error [m/s] by what noise leaves of the closing errors."""
    if len(misclosures) < WINDOWS:
        return settings.doppler_bias_mps
    tau = settings.doppler_bias_s
    ratio = float(np.median(misclosures.duration_s)) / tau
    gain = 2.0 * tau**2 * (ratio - 1.0 + np.exp(-ratio))
    return float(np.sqrt(max(misclosures.excess_m2() / gain, _LEAST_LASTING_MPS**2)))


def slip_m(misclosures: Closings, settings: ReferenceSettings) -> float:
    """Return the random error of the wheel from the closing errors, its scale taken off [m per square root of m]."""
    moving = np.abs(misclosures.distance_m) > 1.0
    if moving.sum() < WINDOWS:
        return settings.slip_m
    error, distance = misclosures.error_m[moving], misclosures.distance_m[moving]
    error = error - float(np.median(error / distance)) * distance
    excess = float(np.quantile(error**2 / np.abs(distance), 0.8)) / _CHI2_80
    excess -= float(np.median(misclosures.white_m2[moving] / np.abs(distance)))
    return float(np.sqrt(max(excess, _LEAST_SLIP_M**2)))


WINDOWS: Final = 20  #: Windows that an estimate needs.
#: 80th percentile of a squared standard normal variable.
_CHI2_80: Final = 1.6424
_LEAST_LASTING_MPS: Final = 1e-3
_LEAST_SLIP_M: Final = 1e-3


@dataclass(frozen=True, kw_only=True)
class Gap:
    """Gap between two good fixes that are further apart than the log's usual step."""

    start: np.datetime64
    end: np.datetime64
    length_s: float
    bridged: bool


@dataclass(frozen=True, kw_only=True)
class Built:
    """Reference of one antenna, with its fixes and gaps."""

    reference: AntennaReference
    fixes: Fixes  #: Every row of the position log with its reasons for rejection.
    gaps: tuple[Gap, ...]
    #: Instants without a reference by reason: ``before_first_fix``, ``after_last_fix``, ``long_gap``, ``uncertain``.
    left_out: dict[str, int]
    bridged_by: dict[str, int]  #: Bridged instants by the sensors that measured there.
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
    """Return the reference of one antenna: places of fixes, smoothed between; `excess` (G - 1,) in sigmas."""
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
    """Return the bridged instants by the sensors that have a number there, or a second or so from there."""
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


_NEAR_NS: Final = 1_500_000_000  #: Sensors of 1 Hz measure everywhere, up to a missing epoch [ns].
