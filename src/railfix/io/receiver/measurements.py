"""Measurements as receivers send them, a row each, and their grid of epochs by channels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Bytes, Datetimes, Floats, Indices, Integers, Masks, Strings
from railfix.gnss.observations import ObservationHeader, Observations

#: RINEX loss-of-lock bits: lock lost since the epoch before; half-cycle ambiguity possible.
_SLIP, _HALF_CYCLE = 1, 2


@dataclass(frozen=True, kw_only=True)
class Measurements:
    """Measurements of a log, N rows in T epochs."""

    time: Datetimes  #: Time tags in the order of the stream, shape (T,).
    epoch: Indices  #: Epoch of each measurement, shape (N,).
    #: Blank where RINEX has no name for it: not used, counted; shape (N,).
    satellite: Strings
    signal: Strings
    #: NaN where absent or declared invalid by the receiver, shape (N,).
    code_m: Floats
    phase_cycles: Floats
    doppler_hz: Floats
    cn0_dbhz: Floats
    lock_s: Floats  #: Time that the phase has been tracked without a break (at least), shape (N,).
    half_cycle: Masks  #: Half a cycle is unresolved, shape (N,).
    polarity: Integers  #: A change means a jump of half a cycle, shape (N,).
    glonass_channel: Integers  #: Frequency channel where the satellite is of GLONASS, shape (N,).
    leap_seconds: int | None = None
    receiver: str = ""
    skipped: Mapping[str, int] = field(default_factory=dict)
    #: Indicators at each epoch (`Observations.receiver_alarm`, `Observations.front_end_gain`); shape (T,).
    alarm: Bytes | None = None
    gain: Floats | None = None


@dataclass(frozen=True, kw_only=True)
class Tracking:
    """What the epochs so far left: the last one, NaT before the first, and lock time [s] and polarity of the last phase
    of each channel (satellite and signal joined).
    """

    last: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    lock: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def observations_of(measurements: Measurements, tracking: Tracking | None = None) -> tuple[Observations, Tracking]:
    """Observations on the grid of epochs by channels, sorted by satellite, then signal, and the state that they leave.

    An epoch that is not after the one before it (a repeated message, a receiver that was restarted
    with an older time) is passed over and counted.
    """
    tracking = tracking or Tracking()
    rising = rising_epochs(measurements.time, None if np.isnat(tracking.last) else tracking.last)
    known = (measurements.satellite != "") & (measurements.signal != "")
    row = np.cumsum(rising) - 1
    use = known & rising[measurements.epoch]
    names = np.char.add(measurements.satellite[use], measurements.signal[use])
    channels, column = np.unique(names, return_inverse=True)
    shape = (int(rising.sum()), len(channels))
    epoch = row[measurements.epoch[use]]

    def grid(values: Floats) -> Floats:
        array = np.full(shape, np.nan)
        array[epoch, column] = values[use]
        return array

    phase, lock = grid(measurements.phase_cycles), grid(measurements.lock_s)
    half = grid(measurements.half_cycle.astype(np.float64)) == 1.0
    lock, polarity = np.where(np.isnan(phase), np.nan, lock), grid(measurements.polarity.astype(np.float64))
    before = np.array([tracking.lock.get(name, (np.nan, np.nan)) for name in channels.tolist()]).reshape(-1, 2)
    lock, polarity = np.vstack([before[:, 0], lock]), np.vstack([before[:, 1], polarity])
    slipped = slips(lock, polarity)[1:]
    indicator = _SLIP * slipped + _HALF_CYCLE * half
    counts = {
        "epochs not after the one before": int(np.count_nonzero(~rising)),
        "measurements of unknown signals": int(np.count_nonzero(~known)),
    }
    skipped = dict(Counter(measurements.skipped) + Counter(counts))
    satellite, signal = channels.astype("<U3"), np.array([name[3:] for name in channels.tolist()], dtype="<U2")
    observations = Observations(
        time=measurements.time[rising],
        satellite=satellite,
        signal=signal,
        code_m=grid(measurements.code_m),
        phase_cycles=phase,
        doppler_hz=grid(measurements.doppler_hz),
        cn0_dbhz=grid(measurements.cn0_dbhz),
        loss_of_lock=np.where(np.isnan(phase), 0, indicator).astype(np.uint8),
        break_before=np.zeros(shape[0], dtype=bool),
        receiver_alarm=_at_epochs(measurements.alarm, rising, 0),
        front_end_gain=_at_epochs(measurements.gain, rising, np.nan),
        header=_header(measurements, satellite, signal),
        skipped=skipped,
    )
    return observations, _tracking_after(observations, tracking, channels, lock, polarity)


def _at_epochs(values: NDArray[Any] | None, rising: Masks, absent: float) -> NDArray[Any]:
    """Values of the epochs that are kept; those of a log without them."""
    kind = np.float64 if np.isnan(absent) else np.uint8
    return np.full(int(rising.sum()), absent, dtype=kind) if values is None else values[rising]


def _tracking_after(
    observations: Observations, tracking: Tracking, channels: Strings, lock_s: Floats, polarity: Floats
) -> Tracking:
    """State after a piece: of each channel the last lock time and polarity."""
    rows = np.where(np.isnan(lock_s), -1, np.arange(len(lock_s))[:, None]).max(axis=0)
    seen = np.flatnonzero(rows >= 0)
    lock = {str(channels[k]): (float(lock_s[rows[k], k]), float(polarity[rows[k], k])) for k in seen.tolist()}
    last = observations.time[-1] if len(observations) else tracking.last
    return Tracking(last=last, lock={**tracking.lock, **lock})


def rising_epochs(time: Datetimes, after: np.datetime64 | None = None) -> Masks:
    """Epochs later than all before them, shape (T,)."""
    ns = time.astype(np.int64)
    floor = np.iinfo(np.int64).min if after is None else int(after.astype("datetime64[ns]").astype(np.int64))
    before = np.concatenate([[floor], np.maximum(np.maximum.accumulate(ns), floor)[:-1]]) if len(ns) else ns
    return np.asarray(ns > before)


def slips(lock_s: Floats, polarity: Floats) -> Masks:
    """Epochs whose phase is not continuous with the channel's last one, shape (T, M).

    Lock time zero or less than before, or a change of polarity; both are NaN where there is no phase. The first phase
    of a channel counts as continuous unless its lock time is zero.
    """
    present = ~np.isnan(lock_s)
    epochs = np.where(present, np.arange(len(lock_s))[:, None], -1)
    last = np.concatenate([np.full((1, lock_s.shape[1]), -1), np.maximum.accumulate(epochs, axis=0)[:-1]])
    columns = np.arange(lock_s.shape[1])
    has = present & (last >= 0)
    before, polar = lock_s[last, columns], polarity[last, columns]
    return np.asarray((present & (lock_s == 0.0)) | (has & ((lock_s < before) | (polarity != polar))))


def _header(measurements: Measurements, satellite: Strings, signal: Strings) -> ObservationHeader:
    signals: dict[str, set[str]] = {}
    for name, code in zip(satellite.tolist(), signal.tolist(), strict=True):
        signals.setdefault(name[0], set()).add(code)
    glonass = np.char.startswith(measurements.satellite, "R")
    channel = dict(
        zip(measurements.satellite[glonass].tolist(), measurements.glonass_channel[glonass].tolist(), strict=True)
    )
    return ObservationHeader(
        receiver=measurements.receiver,
        glonass_channel={name: number for name, number in sorted(channel.items()) if -7 <= number <= 6},
        leap_seconds=measurements.leap_seconds,
        signals={system: tuple(sorted(codes)) for system, codes in sorted(signals.items())},
    )


def joined(parts: Sequence[Measurements]) -> Measurements:
    """Measurements of several pieces, epochs with equal tags in neighbouring pieces kept apart."""
    if len(parts) == 1:
        return parts[0]
    shift = np.cumsum([0, *(len(part.time) for part in parts[:-1])])
    arrays = "satellite signal code_m phase_cycles doppler_hz cn0_dbhz lock_s half_cycle polarity glonass_channel"
    leap = [part.leap_seconds for part in parts if part.leap_seconds is not None]
    return Measurements(
        time=np.concatenate([part.time for part in parts]),
        epoch=np.concatenate([part.epoch + k for part, k in zip(parts, shift.tolist(), strict=True)]),
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in arrays.split()},
        leap_seconds=leap[-1] if leap else None,
        receiver=next((part.receiver for part in parts if part.receiver), ""),
        skipped=dict(sum((Counter(part.skipped) for part in parts), Counter())),
    )
