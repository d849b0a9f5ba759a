"""Preparation of epochs for the recursion: quantities that do not depend on positions, for all epochs of a chunk."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices, Masks, Strings
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.core.timescale import seconds
from railfix.kernels.tracking import constants
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.layout import CHANNEL, EPOCH, Records
from railfix.motion.singer import singer_steps
from railfix.tracking.epochs import GnssEpochs, Previous
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.state import TrackState

#: Minimum interval between epochs [s]; shorter intervals are set to it, because the interval is a divisor.
_SHORTEST_S: Final = 1e-3
#: Longest interval over which the filter continues [s]; the filter restarts after a longer interval.
_APART_S: Final = 3600.0
#: Minimum number of phases or Dopplers from which velocity and clock drift can be computed.
_MOTION: Final = 4
#: Index of each clock in `ix.CLOCKS`.
_OFFSETS: Final = {letter: k for k, letter in enumerate(ix.CLOCKS)}
#: Number of code correlation times after which the error of an unobserved satellite is dropped from the state.
FORGOTTEN: Final = 3.0


@dataclass(frozen=True, kw_only=True)
class Chunk:
    """Inputs of the recursion for T epochs of K channels, with S satellite errors in the state."""

    time: Datetimes  #: Time of each epoch, shape (T,).
    satellite: Strings  #: Satellite of each channel, shape (K,).
    epoch: Records  #: Records `railfix.kernels.tracking.layout.EPOCH`, shape (T,).
    channel: Records  #: Records `railfix.kernels.tracking.layout.CHANNEL`, shape (T, K).
    off_map: Masks  #: True where the train is away from the line, shape (T,).
    fresh: Masks  #: True where a satellite error is initialised at the epoch, shape (T, S).
    within_memory: Masks  #: True where a satellite error continues from an earlier epoch, shape (T, S).


def prepare_chunk(epochs: GnssEpochs, state: TrackState, limits: TrackingLimits) -> Chunk:
    """Return the epochs as a chunk, and add the errors of newly observed satellites to the unknowns of the state."""
    state.origin = epochs.time[0] if np.isnat(state.origin) else state.origin
    phase, before = _previous(epochs.channel, state.previous)
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
        gap[:1] = 1.0
    apart = gap > _APART_S
    interval = np.maximum(gap, _SHORTEST_S)
    interval[apart] = 1.0

    any_kind = np.asarray(has.any(axis=0), dtype=np.bool_)
    slot = _with_satellites(state, epochs.satellite, np.asarray(any_kind.any(axis=0)))
    seen = np.full((len(epochs) + 1, len(state.satellite)), np.datetime64("NaT", "ns"), dtype="datetime64[ns]")
    seen[0] = state.seen
    used = (slot >= 0).nonzero()[0]
    present = np.zeros((len(epochs), len(state.satellite)), dtype=np.bool_)
    np.logical_or.at(present.T, slot[used], any_kind[:, used].T)  # a satellite may have several channels
    seen[1:] = np.where(present, epochs.time[:, None], seen[1:])
    seen = np.fmax.accumulate(seen, axis=0)
    kept = seconds(earlier[:, None] - seen[:-1]) <= FORGOTTEN * constants.CODE_CORRELATION_S
    state.seen = seen[-1]

    variance = _compute_variance(epochs.cn0_dbhz, epochs.code_sigma_m, limits)
    epoch = np.zeros(len(epochs), dtype=EPOCH)
    epoch["time_s"], epoch["interval_s"], epoch["velocity_mps"] = seconds(epochs.time - state.origin), interval, np.nan
    for dt in np.unique(interval).tolist():
        step, noise = compute_singer_step(dt, limits.acceleration_mps2, limits.acceleration_s)
        epoch["step"][interval == dt], epoch["noise"][interval == dt] = step, noise
    epoch["begins"], epoch["coded"] = apart | epochs.off_map, has[0].any(axis=1)
    epoch["motion_measured"] = has[1:].sum(axis=2).max(axis=0) >= _MOTION
    channel = np.zeros(epochs.code_m.shape, dtype=CHANNEL)
    channel["satellite"], channel["clock"] = slot, [_OFFSETS[letter] for letter in epochs.clock.tolist()]
    channel["sat_ecef_m"], channel["sat_velocity_mps"] = epochs.sat_ecef_m, epochs.sat_velocity_mps
    channel["before_ecef_m"], channel["code_sigma_m"] = before, epochs.code_sigma_m
    for name, values in (("measured", measured), ("has", has), ("variance", variance)):
        channel[name] = np.moveaxis(values, 0, -1)
    epoch["tilt_scale"] = 1.0 if epochs.tilt_scale is None else epochs.tilt_scale
    if epochs.near_ecef_m is not None:
        _write_velocities(epoch, channel, epochs.near_ecef_m)
    return Chunk(
        time=epochs.time, satellite=epochs.satellite, epoch=epoch, channel=channel, off_map=epochs.off_map,
        fresh=present & ~kept, within_memory=kept,
    )  # fmt: skip


def _compute_variance(cn0_dbhz: Floats, code_sigma_m: Floats, limits: TrackingLimits) -> Floats:
    """Return the white-error variances of codes, phase changes and Dopplers, shape (3, T, K)."""
    cn0 = np.where(np.isnan(cn0_dbhz), 45.0, np.minimum(cn0_dbhz, 50.0))
    weak = 10.0 ** ((45.0 - cn0) / 10.0)
    return np.array(
        [
            (limits.code_white_share * code_sigma_m) ** 2,
            limits.phase_floor_m**2 + limits.phase_zenith_m**2 * weak,
            limits.doppler_floor_mps**2 + limits.doppler_zenith_mps**2 * weak,
        ]
    )


@lru_cache(maxsize=64)
def compute_singer_step(dt: float, sigma_mps2: float, tau_s: float) -> tuple[Floats, Floats]:
    """Compute transition matrix and process noise of Singer's model for one interval, shapes (3, 3)."""
    step, noise = singer_steps(np.array([dt]), sigma_mps2, tau_s)
    return step[0], noise[0]


def _write_velocities(epoch: Records, channel: Records, near_ecef_m: Floats) -> None:
    """Compute the antenna velocities without use of the line, and write them to the records `epoch`."""
    from railfix.kernels.tracking.velocity import write_velocities

    latitude, longitude, _ = geodetic_from_ecef(np.where(np.isfinite(near_ecef_m), near_ecef_m, 1e6))
    up = np.ascontiguousarray(enu_axes(latitude, longitude)[:, 2])
    write_velocities(epoch, channel, np.array(near_ecef_m), up)


def finish_chunk(chunk: Chunk, epochs: GnssEpochs, state: TrackState) -> None:
    """Store the last phases, and drop the errors of satellites not observed for `FORGOTTEN` correlation times."""
    phase = np.where(np.isfinite(epochs.phase_m[-1]), epochs.phase_m[-1], np.nan)
    state.previous = Previous(channel=epochs.channel, sat_ecef_m=epochs.sat_ecef_m[-1], phase_m=phase)
    kept = seconds(chunk.time[-1] - state.seen) <= FORGOTTEN * constants.CODE_CORRELATION_S
    if not kept.all():
        state.rearrange(kept.nonzero()[0], ())


def _previous(channels: Strings, previous: Previous | None) -> tuple[Floats, Floats]:
    """Return phases and satellite positions of the last epoch before the chunk, in channel order; NaN if missing."""
    if previous is not None and np.array_equal(channels, previous.channel):
        return previous.phase_m, previous.sat_ecef_m
    size = len(channels)
    phase, sat = np.full(size, np.nan), np.full((size, 3), np.nan)
    if previous is not None:
        _, here, there = np.intersect1d(channels, previous.channel, return_indices=True)
        phase[here], sat[here] = previous.phase_m[there], previous.sat_ecef_m[there]
    return phase, sat


def _with_satellites(state: TrackState, satellite: Strings, measured: Masks) -> Indices:
    """Add an unknown for each new satellite; return each channel's satellite index, -1 for unobserved channels."""
    place = {name: k for k, name in enumerate(state.satellite.tolist())}
    names = satellite.tolist()
    new = [name for name in dict.fromkeys(satellite[measured].tolist()) if name not in place]
    if new:
        state.rearrange(np.arange(len(state.satellite)), tuple(new))
        place |= {name: len(place) + k for k, name in enumerate(new)}
    slot = [place[name] if there else -1 for name, there in zip(names, measured.tolist(), strict=True)]
    return np.array(slot, dtype=np.intp)
