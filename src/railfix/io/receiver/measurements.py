"""Measurements and navigation records decoded from receiver messages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Bytes, Datetimes, Floats, Indices, Integers, Masks, Strings, join_rows
from railfix.core.nearest_times import nearest_day, nearest_week
from railfix.core.timescale import from_week, to_week
from railfix.core.utc import gpst_to_utc
from railfix.gnss.joined_observations import signals_by_system
from railfix.gnss.observations import ObservationHeader, Observations
from railfix.io.receiver import nav_messages
from railfix.io.receiver.nav_messages import Values
from railfix.io.rinex.navigation_records import RawRecord, list_fields

#: RINEX loss-of-lock bits: bit 0 for a cycle slip since the previous epoch, bit 1 for a half-cycle ambiguity.
_SLIP, _HALF_CYCLE = 1, 2


@dataclass(frozen=True, kw_only=True)
class Measurements:
    """Measurements of a log, N rows in T epochs."""

    time: Datetimes  #: Time tags in the order of the stream, shape (T,).
    epoch: Indices  #: Index in `time` of each measurement, shape (N,).
    #: Satellite and signal of each measurement, shape (N,). A name is blank if RINEX has none for the satellite or
    #: signal; such measurements are counted but not used.
    satellite: Strings
    signal: Strings
    #: Measured values, shape (N,); NaN where the receiver sent no value or declared it invalid.
    code_m: Floats
    phase_cycles: Floats
    doppler_hz: Floats
    cn0_dbhz: Floats
    lock_s: Floats  #: Lock time: lower bound of the time for which the phase has been continuous, shape (N,).
    half_cycle: Masks  #: Whether a half-cycle ambiguity of the phase is unresolved, shape (N,).
    polarity: Integers  #: Phase polarity, shape (N,); if it changes, the phase has jumped by half a cycle.
    glonass_channel: Integers  #: GLONASS frequency channel, shape (N,); unknown if outside -7 to 6.
    leap_seconds: int | None = None
    receiver: str = ""
    skipped: Mapping[str, int] = field(default_factory=dict)
    #: `Observations.receiver_alarm` and `Observations.front_end_gain` by epoch, shape (T,); each None if not sent.
    alarm: Bytes | None = None
    gain: Floats | None = None


@dataclass(frozen=True, kw_only=True)
class Tracking:
    """State of phase tracking after a piece of a log."""

    last: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))  #: Time of the last epoch.
    #: Lock time [s] and polarity of the last phase measurement of each channel ("G051C": satellite and signal).
    lock: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def join_observations(measurements: Measurements, tracking: Tracking | None = None) -> tuple[Observations, Tracking]:
    """Return the measurements as observations with sorted channels, and the new tracking state.

    Epochs that are not later than all preceding epochs are skipped and counted.
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
        "epochs that are not later than the previous epoch": int(np.count_nonzero(~rising)),
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
    """Return the values at the accepted epochs. If `values` is None, every value is `absent`."""
    kind = np.float64 if np.isnan(absent) else np.uint8
    return np.full(int(rising.sum()), absent, dtype=kind) if values is None else values[rising]


def _tracking_after(
    observations: Observations, tracking: Tracking, channels: Strings, lock_s: Floats, polarity: Floats
) -> Tracking:
    """Return the tracking state after a piece, with the last lock time and polarity of each channel."""
    rows = np.where(np.isnan(lock_s), -1, np.arange(len(lock_s))[:, None]).max(axis=0)
    seen = np.flatnonzero(rows >= 0)
    lock = {str(channels[k]): (float(lock_s[rows[k], k]), float(polarity[rows[k], k])) for k in seen.tolist()}
    last = observations.time[-1] if len(observations) else tracking.last
    return Tracking(last=last, lock={**tracking.lock, **lock})


def rising_epochs(time: Datetimes, after: np.datetime64 | None = None) -> Masks:
    """Return whether each epoch is later than all preceding epochs and later than the time `after`, shape (T,)."""
    ns = time.astype(np.int64)
    floor = np.iinfo(np.int64).min if after is None else int(after.astype("datetime64[ns]").astype(np.int64))
    before = np.concatenate([[floor], np.maximum(np.maximum.accumulate(ns), floor)[:-1]]) if len(ns) else ns
    return np.asarray(ns > before)


def slips(lock_s: Floats, polarity: Floats) -> Masks:
    """Return whether each phase is discontinuous, shape (T, M).

    A phase is discontinuous if the lock time is 0 or has decreased, or if the polarity has changed.

    Lock time and polarity are NaN where there is no phase.
    """
    present = ~np.isnan(lock_s)
    epochs = np.where(present, np.arange(len(lock_s))[:, None], -1)
    last = np.concatenate([np.full((1, lock_s.shape[1]), -1), np.maximum.accumulate(epochs, axis=0)[:-1]])
    columns = np.arange(lock_s.shape[1])
    has = present & (last >= 0)
    before, polar = lock_s[last, columns], polarity[last, columns]
    return np.asarray((present & (lock_s == 0.0)) | (has & ((lock_s < before) | (polarity != polar))))


def _header(measurements: Measurements, satellite: Strings, signal: Strings) -> ObservationHeader:
    glonass = np.char.startswith(measurements.satellite, "R")
    channel = dict(
        zip(measurements.satellite[glonass].tolist(), measurements.glonass_channel[glonass].tolist(), strict=True)
    )
    return ObservationHeader(
        receiver=measurements.receiver,
        glonass_channel={name: number for name, number in sorted(channel.items()) if -7 <= number <= 6},
        leap_seconds=measurements.leap_seconds,
        signals=signals_by_system(satellite, signal),
    )


def no_measurements(receiver: str) -> Measurements:
    """Return measurements without rows."""
    kinds = {
        **dict.fromkeys(("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "lock_s"), "<f8"),
        "satellite": "<U3", "signal": "<U3", "half_cycle": "?", "polarity": "<i8", "glonass_channel": "<i8",
    }  # fmt: skip
    rows: dict[str, Any] = {name: np.zeros(0, dtype=kind) for name, kind in kinds.items()}
    nothing = np.zeros(0, dtype=np.intp)
    return Measurements(time=nothing.astype("datetime64[ns]"), epoch=nothing, receiver=receiver, **rows)


def join_measurements(parts: Sequence[Measurements]) -> Measurements:
    """Join the measurements of several pieces of a log. Equal time tags in different pieces remain separate epochs."""
    shift = np.cumsum([0, *(len(part.time) for part in parts[:-1])])
    epoch = np.concatenate([part.epoch + k for part, k in zip(parts, shift.tolist(), strict=True)])
    leap = [part.leap_seconds for part in parts if part.leap_seconds is not None]
    return replace(
        join_rows(parts),
        epoch=epoch,
        leap_seconds=leap[-1] if leap else None,
        receiver=next((part.receiver for part in parts if part.receiver), ""),
        skipped=dict(sum((Counter(part.skipped) for part in parts), Counter())),
    )


#: Navigation record, and its issue: the values that distinguish the record from other records of the satellite.
Record = tuple[RawRecord, tuple[float, ...]]

_GALILEO_WEEK_MINUS_GPS: Final = 1024
_BDS_WEEK_MINUS_GPS: Final = 1356
#: Bit of the Galileo data-source word that is set if the clock refers to E5a and E1.
_E5A_CLOCK: Final = 1 << 8
_MOSCOW_S: Final = 3 * 3600.0


def gps_record(satellite: str, values: Values, time: np.datetime64) -> Record:
    """Return the GPS or QZSS record (LNAV 1 to 3, RTCM 1019, 1044). The time of reception `time` resolves the week."""
    week, epoch = _week_and_toc(values, _near_week(values["week"], time), time)
    numbers = {
        **values,
        "data_source": values["codes"],
        "accuracy_m": nav_messages.URA_NOMINAL_M[int(values["accuracy"])],
        "group_delay_2_s": values["iodc"],
        "transmitted": values.get("tow_s", np.nan),
        "fit": (6.0 if values["fit"] else 4.0) if satellite[0] == "G" else values["fit"],
        "week": float(week),
    }
    return _raw(satellite, "LNAV", epoch, numbers), _issue(values, "iodc", "toe_sow_s", "toc_s", "health")


def cnav_record(satellite: str, values: Values) -> Record:
    """Return the GPS or QZSS record from the fields of CNAV messages 10, 11 and 30, which have the full week."""
    sent = from_week(int(values["week"]), values["tow_s"])
    toc = nearest_week(values["toc_s"], sent)
    delays = ("group_delay_1_s", *(f"inter_signal_{k}" for k in range(4)))
    numbers = {
        **values,
        **{name: np.nan if values[name] == nav_messages.CNAV_NO_DELAY_S else values[name] for name in delays},
        "sqrt_a": float(np.sqrt(nav_messages.CNAV_AXIS_M[satellite[0]] + values["delta_a"])),
        "omega_dot": nav_messages.CNAV_OMEGA_DOT + values["delta_omega_dot"],
        "transmitted": values["tow_s"],
        "week": float(int(values["week"]) // 256 * 256 + int(values["week_top"])),
    }
    return _raw(satellite, "CNAV", toc, numbers), _issue(values, "toe_sow_s", "top", "health", "m0", "af0_s")


def bcnav_record(satellite: str, message: str, values: Values) -> Record | None:
    """Return the BeiDou record from the fields of B-CNAV1 or B-CNAV2, which have the full week.

    Return None if the fields belong to a satellite other than `satellite`, or if the orbit type is unknown.
    """
    if int(values["kind"]) not in nav_messages.BCNAV_AXIS_M or f"C{int(values['number']):02d}" != satellite:
        return None
    sent = from_week(int(values["week"]) + _BDS_WEEK_MINUS_GPS, values["tow_s"])
    numbers = {
        **values,
        "sqrt_a": float(np.sqrt(nav_messages.BCNAV_AXIS_M[int(values["kind"])] + values["delta_a"])),
        "transmitted": values["tow_s"],
    }
    issue = _issue(values, "iodc", "toe_sow_s", "toc_s", "health")
    return _raw(satellite, message, nearest_week(values["toc_s"], sent), numbers), issue


def galileo_record(satellite: str, values: Values, time: np.datetime64) -> Record:
    """Return the Galileo record from the fields of I/NAV words 1 to 5, F/NAV pages 1 to 4, RTCM 1046 or RTCM 1045."""
    week, epoch = _week_and_toc(values, int(values["week"]) + _GALILEO_WEEK_MINUS_GPS, time)
    health = 0
    for signal, bit in (("e5b", 6), ("e5a", 3), ("e1b", 0)):  # from high to low bits in the RINEX health word
        if f"{signal}_health" in values:
            health |= int(values[f"{signal}_health"]) << bit + 1 | int(values[f"{signal}_invalid"]) << bit
    numbers = {
        **values,
        "iode": values["iod"],
        "data_source": values["source"],
        "accuracy_m": float(nav_messages.sisa_m(np.asarray(values["accuracy"]))),
        "health": float(health),
        "transmitted": values.get("tow_s", np.nan),
        "week": float(week),
    }
    message = "FNAV" if int(values["source"]) & _E5A_CLOCK else "INAV"
    return _raw(satellite, message, epoch, numbers), (*_issue(values, "iod", "toe_sow_s", "source"), float(health))


def beidou_record(satellite: str, message: str, values: Values, time: np.datetime64) -> Record | None:
    """Return the BeiDou record from the fields of D1, D2 or RTCM 1042, or None for fields of different issues."""
    if values["toc_s"] != values["toe_sow_s"]:  # one issue has one reference time (ICD, 5.2.4.9)
        return None
    week, epoch = _week_and_toc(values, int(values["week"]) + _BDS_WEEK_MINUS_GPS, time)
    numbers = {
        **values,
        "iode": values["aode"],
        "data_source": 0.0,
        "accuracy_m": nav_messages.URA_NOMINAL_M[int(values["accuracy"])],
        "transmitted": values.get("tow_s", np.nan),
        "fit": values["aodc"],
        "week": float(week - _BDS_WEEK_MINUS_GPS),
    }
    return _raw(satellite, message, epoch, numbers), _issue(values, "aode", "aodc", "toe_sow_s", "health")


def glonass_record(satellite: str, values: Values, time: np.datetime64) -> Record:
    """Return the GLONASS record from the fields of strings 1 to 4 or RTCM 1020. The reception time resolves the day."""
    epoch = nearest_day(values["tb_s"] - _MOSCOW_S, gpst_to_utc(time))
    _, message_time = to_week(nearest_day(_frame_s(values), gpst_to_utc(time)))
    numbers = {
        **values,
        "health": float(bool(values["health"]) or bool(values["ln"])),  # B_n and l_n (ICD, 4.4)
        "clock_bias": -values["tau_s"],
        "message_time": float(message_time),
        "frequency_channel": values["channel"],
    }
    issue = (*_issue(values, "tb_s", "health", "ln"), float(epoch.astype(np.int64)))
    return _raw(satellite, "", epoch, numbers), issue


def frame_time(values: Values, time: np.datetime64) -> Datetimes:
    """Return the GPS time of a GLONASS frame's start from string 1. The time of reception `time` resolves the day."""
    utc = gpst_to_utc(time)
    return np.asarray(time + (nearest_day(_frame_s(values), utc) - utc))


def _frame_s(values: Values) -> float:
    return values["hour"] + values["minute"] + values["half_minute"] - _MOSCOW_S


def _week_and_toc(values: Values, week: int, time: np.datetime64) -> tuple[int, Datetimes]:
    """Return the GPS week of toe, and toc as GPS time.

    The broadcast week is the week of transmission, but near the end of a week, toe may be in the next week. RTCM 3 has
    no time of transmission; the time of reception `time` is used instead.
    """
    sent_s = values.get("tow_s", values["toe_sow_s"] if np.isnat(time) else float(to_week(time)[1]))
    sent = from_week(week, sent_s)
    toe = nearest_week(values["toe_sow_s"], sent)
    return int(to_week(toe)[0]), nearest_week(values["toc_s"], sent)


def _issue(values: Values, *names: str) -> tuple[float, ...]:
    return tuple(values[name] for name in names)


def _raw(satellite: str, message: str, epoch: Datetimes | np.datetime64, numbers: Mapping[str, float]) -> RawRecord:
    """Return a record with its numbers in RINEX order; missing numbers are NaN."""
    values = [float(numbers.get(name, np.nan)) for name in list_fields(satellite[0], message)]
    return RawRecord(
        satellite[0], satellite, message, np.asarray(epoch, dtype="datetime64[ns]").reshape(1)[0], values, 3.0
    )


def _near_week(broadcast: float, time: np.datetime64) -> int:
    """Return the full week number that is nearest to `time` and has the ten broadcast bits."""
    week = int(to_week(time)[0])
    return week + (int(broadcast) - week + 512) % 1024 - 512
