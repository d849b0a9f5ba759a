"""Epochs prepared for the recursion: what needs no place is computed for all epochs of a chunk at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices, Masks, Strings
from railfix.core.timescale import seconds
from railfix.tracking.epochs import GnssEpochs, Previous
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.state import CLOCKS, TrackState
from railfix.tracking.velocity import compute_velocity

#: Shortest interval between epochs [s].
_SHORTEST_S: Final = 1e-3
#: Two epochs further apart than this have nothing to do with each other [s].
_APART_S: Final = 3600.0
#: Phases or Dopplers of an epoch that give speed and clock drift with redundancy.
_MOTION: Final = 4
#: Place of each clock in `CLOCKS`.
_OFFSETS: Final = {letter: k for k, letter in enumerate(CLOCKS)}
#: Satellites unseen for this many correlation times of codes are dropped from the state.
FORGOTTEN: Final = 3.0


@dataclass(frozen=True, kw_only=True)
class Chunk:
    """T epochs of K channels and S errors of satellites; `has` and `variance` of codes are settled epoch by epoch."""

    time: Datetimes  #: Shape (T,).
    interval_s: Floats  #: Since the epoch before; 1 for the first; shape (T,).
    apart: Masks  #: Epochs so long after the one before that they restart; shape (T,).
    satellite: Strings  #: Shape (K,).
    #: Place of the channel's error among those of the state; -1 for one that is never measured; shape (K,).
    slot: Indices
    offset: Indices  #: Place of its code clock in `CLOCKS`; shape (K,).
    #: Satellites at transmission, and those of the epoch before; shape (T, K, 3).
    sat_ecef_m: Floats
    sat_velocity_mps: Floats
    before_ecef_m: Floats
    #: Code [m], change of the phase since the epoch before [m] and range rate [m/s]; NaN where there is none;
    #: shape (3, T, K).
    measured: Floats
    has: Masks  #: Where `measured` is finite; shape (3, T, K).
    #: Of white errors, before the scales learnt from residuals; of codes the mean over a second; shape (3, T, K).
    variance: Floats
    #: Epochs with phases or Dopplers of at least four satellites: they carry the place on without codes; shape (T,).
    motion_measured: Masks
    code_sigma_m: Floats  #: Of the satellite's correlated code error; shape (T, K).
    fresh: Masks  #: Satellites whose error begins at an epoch; shape (T, S).
    off_map: Masks  #: The train is away from the line; shape (T,).
    remembered: Masks  #: Satellites whose error lasts from before an epoch; shape (T, S).
    #: `velocity.Velocity`; shape (T, 3), (T, 3, 3), (T,).
    velocity_mps: Floats
    velocity_covariance: Floats
    velocity_age_s: Floats


def prepare_chunk(epochs: GnssEpochs, state: TrackState, limits: TrackingLimits) -> Chunk:
    """Return the chunk, and give the state an error for each satellite measured in it."""
    phase, before = _previous(epochs, state.previous)
    phase = np.concatenate([phase[None], epochs.phase_m])
    placed = np.isfinite(epochs.sat_ecef_m).all(axis=2)
    before = np.concatenate([before[None], epochs.sat_ecef_m])[:-1]
    measured = np.array([epochs.code_m, phase[1:] - phase[:-1], epochs.rate_mps])
    has = np.isfinite(measured) & placed
    has[0] &= np.isfinite(epochs.code_sigma_m)
    has[1] &= epochs.phase_joined & np.isfinite(before).all(axis=2)
    has[2] &= np.isfinite(epochs.sat_velocity_mps).all(axis=2)

    earlier = np.concatenate([np.array([state.time]), epochs.time[:-1]])
    gap = seconds(epochs.time - earlier)
    if np.isnat(state.time):
        gap[:1] = 0.0
    apart = gap > _APART_S
    # Two epochs at one instant are a millisecond apart: Dopplers and forces count by the interval.
    interval = np.maximum(gap, _SHORTEST_S)
    interval[apart] = 1.0
    if np.isnat(state.time):
        interval[:1] = 1.0

    any_kind = np.asarray(has.any(axis=0), dtype=np.bool_)
    slot = _with_satellites(state, epochs, np.asarray(any_kind.any(axis=0)))
    seen = np.full((len(epochs) + 1, len(state.satellite)), np.datetime64("NaT", "ns"), dtype="datetime64[ns]")
    seen[0] = state.seen
    used = (slot >= 0).nonzero()[0]
    seen[1:, slot[used]] = np.where(any_kind[:, used], epochs.time[:, None], np.datetime64("NaT", "ns"))
    seen = np.fmax.accumulate(seen, axis=0)
    kept = seconds(earlier[:, None] - seen[:-1]) <= FORGOTTEN * limits.code_correlation_s
    fresh = np.zeros(kept.shape, dtype=np.bool_)
    fresh[:, slot[used]] = any_kind[:, used]
    state.seen = seen[-1]

    cn0 = np.where(np.isnan(epochs.cn0_dbhz), 45.0, np.minimum(epochs.cn0_dbhz, 50.0))
    weak = 10.0 ** ((45.0 - cn0) / 10.0)
    variance = np.array(
        [
            (limits.code_white_share * epochs.code_sigma_m) ** 2,
            limits.phase_floor_m**2 + limits.phase_zenith_m**2 * weak,
            limits.doppler_floor_mps**2 + limits.doppler_zenith_mps**2 * weak,
        ]
    )
    near = np.full((len(epochs), 3), np.nan) if epochs.near_ecef_m is None else epochs.near_ecef_m
    velocity = compute_velocity(
        near, epochs.sat_ecef_m, epochs.sat_velocity_mps, before, measured, has, variance, interval
    )
    return Chunk(
        time=epochs.time, interval_s=interval, apart=apart, satellite=epochs.satellite, slot=slot,
        offset=np.array([_OFFSETS[letter] for letter in epochs.clock.tolist()], dtype=np.intp),
        sat_ecef_m=epochs.sat_ecef_m, sat_velocity_mps=epochs.sat_velocity_mps, before_ecef_m=before,
        measured=measured, has=has, variance=variance,
        motion_measured=np.asarray(has[1:].sum(axis=2).max(axis=0) >= _MOTION), code_sigma_m=epochs.code_sigma_m,
        fresh=fresh & ~kept, off_map=epochs.off_map, remembered=kept, velocity_mps=velocity.velocity_mps,
        velocity_covariance=velocity.covariance, velocity_age_s=velocity.age_s,
    )  # fmt: skip


def finish_chunk(chunk: Chunk, epochs: GnssEpochs, state: TrackState, limits: TrackingLimits) -> None:
    """Make the state ready to be handed on: without satellites long unseen, with the phases of the last epoch."""
    phase = np.where(np.isfinite(epochs.phase_m[-1]), epochs.phase_m[-1], np.nan)
    state.previous = Previous(satellite=epochs.satellite, sat_ecef_m=epochs.sat_ecef_m[-1], phase_m=phase)
    kept = seconds(chunk.time[-1] - state.seen) <= FORGOTTEN * limits.code_correlation_s
    if not kept.all():
        state.rearrange(kept.nonzero()[0], ())


def _previous(epochs: GnssEpochs, previous: Previous | None) -> tuple[Floats, Floats]:
    """Return the phase and satellites of the epoch before the first, in the order of the channels."""
    if previous is not None and epochs.satellite.tolist() == previous.satellite.tolist():
        return previous.phase_m, previous.sat_ecef_m
    size = len(epochs.satellite)
    phase, sat = np.full(size, np.nan), np.full((size, 3), np.nan)
    if previous is not None:
        _, here, there = np.intersect1d(epochs.satellite, previous.satellite, return_indices=True)
        phase[here], sat[here] = previous.phase_m[there], previous.sat_ecef_m[there]
    return phase, sat


def _with_satellites(state: TrackState, epochs: GnssEpochs, measured: Masks) -> Indices:
    """Give the state a place for the error of each satellite measured; return the place of each channel's."""
    place = {name: k for k, name in enumerate(state.satellite.tolist())}
    names = epochs.satellite.tolist()
    new = [name for name in dict.fromkeys(epochs.satellite[measured].tolist()) if name not in place]
    if new:
        state.rearrange(np.arange(len(state.satellite)), tuple(new))
        place |= {name: len(place) + k for k, name in enumerate(new)}
    slot = [place[name] if there else -1 for name, there in zip(names, measured.tolist(), strict=True)]
    return np.array(slot, dtype=np.intp)
