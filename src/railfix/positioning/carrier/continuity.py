"""Detection of phase jumps on a known line, and numbering of phase arcs.

Between two epochs, the unknowns are the distance moved along the line and the clock change. Every satellite beyond two
allows a check of the phases with an accuracy of about a centimetre. Where the phase changes are inconsistent, the
channels with the largest residuals are rejected one by one until the remaining channels agree. An arc number is unique
in a run; it contains the satellite, the signal and the count of the channel's arcs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, Indices, Integers, Masks, Strings, read_only
from railfix.core.geodesy import range_with_rotation
from railfix.core.settings import Settings
from railfix.core.timescale import seconds
from railfix.track.trajectory import Trajectory

#: Number of low bits of an arc number, which contain the count of arcs. The high bits contain the channel code.
COUNT_BITS: Final = 23
NO_ARC: Final = -1  #: Arc number where there is no phase.

ChannelKeys = tuple[tuple[str, str], ...]  #: Satellite and signal of each channel.


@dataclass(frozen=True, kw_only=True)
class ArcState:
    """Number of arcs that each channel has had so far, by `channel_code`."""

    count: Mapping[int, int] = field(default_factory=dict)


def channel_code(satellite: str, signal: str) -> int:
    """Return the letters of a channel, such as satellite ``G05`` and signal ``1C``, as a number."""
    return int.from_bytes(f"{satellite:<3.3}{signal:<2.2}".encode("ascii"), "big")


def channel_keys(satellite: Strings, signal: Strings) -> ChannelKeys:
    """Return the satellite and signal of each channel."""
    return tuple(zip(satellite.tolist(), signal.tolist(), strict=True))


def rows_before(before: ChannelKeys, now: ChannelKeys) -> Indices:
    """Return each channel's index in `before`, shape (M,); -1 for new channels."""
    row = {key: i for i, key in enumerate(before)}
    return np.array([row.get(key, -1) for key in now], dtype=np.intp)


def number_arcs(
    slip: Masks, has_phase: Masks, satellite: Strings, signal: Strings, state: ArcState | None = None
) -> tuple[Integers, ArcState]:
    """Return the arc number of each phase.

    Parameters
    ----------
    slip : ndarray of bool, shape (T, M)
        True where arcs begin.
    has_phase : ndarray of bool, shape (T, M)
    satellite, signal : ndarray of str, shape (M,)
    state : ArcState, optional

    Returns
    -------
    ndarray of int64, shape (T, M)
        Arc numbers; `NO_ARC` where there is no phase.
    ArcState
    """
    before = dict(state.count) if state else {}
    codes = [channel_code(*key) for key in channel_keys(satellite, signal)]
    first = np.array([before.get(code, 0) for code in codes], dtype=np.int64)
    count = first + np.cumsum(slip & has_phase, axis=0, dtype=np.int64)
    names = np.array(codes, dtype=np.int64) << COUNT_BITS
    if len(count):
        before.update({code: int(c) for code, c in zip(codes, count[-1], strict=True)})
    return np.where(has_phase, names + count, NO_ARC), ArcState(count=before)


def last_arcs(satellite: Strings, signal: Strings, state: ArcState | None) -> Integers:
    """Return the number of each channel's last arc, shape (M,); `NO_ARC` for channels without an arc."""
    count = {} if state is None else state.count
    codes = [channel_code(*key) for key in channel_keys(satellite, signal)]
    return np.array([(code << COUNT_BITS) + count[code] if code in count else NO_ARC for code in codes], dtype=np.int64)


def decode_channel(arc_id: Integers) -> Integers:
    """Return the channel code contained in each arc number."""
    return np.asarray(arc_id >> COUNT_BITS)


class ContinuityLimits(Settings):
    """Limits of the phase jump test."""

    phase_m: float = Field(default=0.012, gt=0)  #: Constant part of the standard deviation of a phase change.
    #: Part, proportional to the interval, of the standard deviation of a phase change (satellite clocks, delays).
    drift_mps: float = Field(default=0.008, gt=0)
    #: Constant part of the standard deviation of lateral and vertical motion, due to errors of map points.
    aside_m: float = Field(default=0.02, gt=0)
    #: Standard deviation of lateral motion due to direction errors, as a fraction of the distance moved. On a curve of
    #: 300 m radius, a position error of 5 m corresponds to a direction error of 0.017 rad.
    across_share: float = Field(default=0.02, gt=0)
    #: Standard deviation of vertical motion due to gradient errors, as a fraction of the distance moved. On a vertical
    #: curve of 2000 m radius, a position error of 5 m is a gradient error of 0.0025 rad.
    up_share: float = Field(default=0.003, gt=0)
    sigmas: float = Field(default=4.5, gt=0)  #: Phase changes with a residual above this many sigmas are rejected.
    #: Largest number of channels rejected at an epoch. If more channels disagree, all tested channels start new arcs.
    max_rejected: int = Field(default=8, ge=0)
    max_gap_s: float = Field(default=31.0, gt=0)  #: Phase changes over longer intervals are not tested.


@dataclass(frozen=True, kw_only=True)
class ContinuityState:
    """Phases, satellite positions and position on the line at the last epoch of a chunk."""

    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    channels: ChannelKeys = ()
    phase_m: Floats = field(default_factory=lambda: np.empty(0))  #: Corrected phase, shape (M,); NaN if unused.
    sat_ecef_m: Floats = field(default_factory=lambda: np.empty((0, 3)))  #: Satellite positions, shape (M, 3).
    arc_m: float = float("nan")


@dataclass(frozen=True, kw_only=True)
class TrackJumps:
    """Test results of phase changes since the previous epoch, T epochs by M channels."""

    jump: Masks  #: True where the phase change is inconsistent and a new arc begins, shape (T, M).
    metric_m: Floats  #: Residual of the phase change in the fit of the kept channels, shape (T, M); NaN if untested.
    judged: Masks  #: True where the phase change is tested, shape (T, M).
    moved_m: Floats  #: Distance moved along the line since the previous epoch, shape (T,); NaN if unknown.
    moved_sigma_m: Floats  #: Standard deviation of `moved_m`, shape (T,); NaN if unknown.


class TrackedPhases(NamedTuple):
    """Phases of T epochs by M channels."""

    phase_m: Floats  #: Corrected phases (`observation_model.corrected_phase_m`), shape (T, M); NaN if unused.
    sat_ecef_m: Floats  #: Satellite positions at the transmission times of the phases, shape (T, M, 3).
    slip: Masks  #: True where a slip is already known, so that the phase is not tested, shape (T, M).


def track_jumps(
    time: Datetimes,
    satellite: Strings,
    signal: Strings,
    phases: TrackedPhases,
    trajectory: Trajectory,
    arc_m: Floats,
    state: ContinuityState | None = None,
    *,
    limits: ContinuityLimits | None = None,
) -> tuple[TrackJumps, ContinuityState]:
    """Find phase changes inconsistent with the other phase changes and the line; compute the distance moved.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    satellite, signal : ndarray of str, shape (M,)
    phases : TrackedPhases
    trajectory : Trajectory
    arc_m : ndarray, shape (T,) [m]
        Positions from codes alone, accurate to a few metres. Epochs with NaN are not used.
    state : ContinuityState, optional
    limits : ContinuityLimits, optional

    Returns
    -------
    TrackJumps
    ContinuityState
    """
    limits, state, (phase_m, sat_ecef_m, slip) = limits or ContinuityLimits(), state or ContinuityState(), phases
    channels = channel_keys(satellite, signal)
    rows = rows_before(state.channels, channels)
    last_phase = np.append(state.phase_m, np.nan)[rows]
    last_sat = np.append(state.sat_ecef_m, np.full((1, 3), np.nan), axis=0)[rows]
    phase = np.concatenate([last_phase[None], phase_m])
    sats = np.concatenate([last_sat[None], sat_ecef_m])
    arc = np.r_[state.arc_m, arc_m]
    dt = seconds(np.diff(np.concatenate([np.asarray([state.time], dtype="datetime64[ns]"), time])))
    able = np.isfinite(arc[1:]) & np.isfinite(arc[:-1]) & (dt <= limits.max_gap_s)
    judged = able[:, None] & ~slip & np.isfinite(phase[1:]) & np.isfinite(phase[:-1])

    section, along = trajectory.segment_at(np.where(np.isfinite(arc), arc, 0.0))
    where = trajectory.ecef_m[section] + along[:, None] * trajectory.tangent[section]
    distance, los = range_with_rotation(sats, where[:, None, :])
    axes = trajectory.get_axes(section)
    change = np.diff(phase - distance, axis=0)
    way = np.diff(arc)
    design = np.concatenate([-np.matmul(los[1:], axes[1:].swapaxes(1, 2)), np.ones((*change.shape, 1))], axis=-1)
    sigma = np.hypot(limits.phase_m, limits.drift_mps * np.where(able, dt, 0.0))
    share = np.array([limits.across_share, limits.up_share])
    aside = np.hypot(limits.aside_m, share * np.where(able, way, 0.0)[:, None])
    kept, residual, step, variance, decided = _reject_jumps(design, change, judged, sigma, aside, limits)
    jump = judged & ~(kept & decided[:, None])
    known = able & decided & np.isfinite(variance)
    after = state
    if len(time):
        after = ContinuityState(
            time=time[-1],
            channels=channels,
            phase_m=read_only(phase_m[-1].copy()),
            sat_ecef_m=read_only(sat_ecef_m[-1].copy()),
            arc_m=float(arc_m[-1]),
        )
    jumps = TrackJumps(
        jump=jump,
        metric_m=np.where(judged, residual, np.nan),
        judged=judged,
        moved_m=np.where(known, way + step, np.nan),
        moved_sigma_m=np.where(known, np.sqrt(np.where(known, variance, 1.0)), np.nan),
    )
    return jumps, after


def _reject_jumps(
    design: Floats, change: Floats, judged: Masks, sigma: Floats, aside: Floats, limits: ContinuityLimits
) -> tuple[Masks, Floats, Floats, Floats, Masks]:
    """Reject channels with the largest residuals one by one until the remaining channels agree.

    Return a mask of the kept channels, the residuals of all channels, the step along the line, the variance of the
    step, and a mask of the epochs whose kept channels agree. Without redundancy, all channels are kept.
    """
    design = np.where(judged[..., None], design, 0.0)
    change = np.where(judged, change, 0.0)
    prior = np.zeros((len(change), 4, 4))
    prior[:, 0, 0] = prior[:, 3, 3] = 1e-12
    prior[:, [1, 2], [1, 2]] = aside**-2.0
    fit = _fit(design, change, judged, sigma, prior)
    kept = judged.copy()
    decided = np.ones(len(change), dtype=bool)
    at = np.flatnonzero((fit.size > limits.sigmas).any(axis=1))
    if len(at):
        part = design[at], change[at], sigma[at], prior[at]
        kept[at], decided[at] = _worst_out(*part, judged[at], limits)
        # a channel that was rejected because of another channel's jump is accepted again
        back = judged[at] & (_fit(part[0], part[1], kept[at], part[2], part[3]).size <= limits.sigmas)
        kept[at], again = _worst_out(*part, back, limits)
        decided[at] &= again & (np.count_nonzero(judged[at] & ~kept[at], axis=1) <= limits.max_rejected)
        fit = _fit(design, change, kept, sigma, prior)
    return kept, fit.residual, fit.step, fit.variance, decided


@dataclass(frozen=True)
class _ContinuityFit:
    """Residuals [m], absolute residuals in sigmas, step along the line [m], and variance of the step."""

    residual: Floats
    size: Floats
    step: Floats
    variance: Floats


def _fit(design: Floats, change: Floats, kept: Masks, sigma: Floats, prior: Floats) -> _ContinuityFit:
    """Return the least-squares fit of the kept channels of each epoch."""
    weight = kept / sigma[:, None] ** 2
    inverse = np.linalg.inv(np.matmul((design * weight[..., None]).swapaxes(1, 2), design) + prior)
    right = np.matmul((weight * change)[:, None, :], design)[:, 0]
    x = np.matmul(inverse, right[..., None])[..., 0]
    residual = change - np.matmul(design, x[..., None])[..., 0]
    spread = np.einsum("tmi,tij,tmj->tm", design, inverse, design)
    own = sigma[:, None] ** 2
    # without redundancy, a channel has no residual variance and cannot be tested
    checked = np.where(kept, own - spread, own + spread)
    size = np.where(checked > 0.02 * own, np.abs(residual) / np.sqrt(np.maximum(checked, 1e-12)), 0.0)
    return _ContinuityFit(residual=residual, size=size, step=x[:, 0], variance=inverse[:, 0, 0])


def _worst_out(
    design: Floats, change: Floats, sigma: Floats, prior: Floats, kept: Masks, limits: ContinuityLimits
) -> tuple[Masks, Masks]:
    """Repeatedly reject the largest residual; return masks of kept channels and of epochs whose kept channels agree."""
    kept = kept.copy()
    active = np.arange(len(kept))
    for _ in range(limits.max_rejected + 1):
        fit = _fit(design[active], change[active], kept[active], sigma[active], prior[active])
        size = np.where(kept[active], fit.size, 0.0)
        worst = np.argmax(size, axis=1)
        bad = size[np.arange(len(active)), worst] > limits.sigmas
        kept[active[bad], worst[bad]] = False
        active = active[bad]
        if not len(active):
            break
    decided = np.ones(len(kept), dtype=bool)
    decided[active] = False
    return kept, decided
