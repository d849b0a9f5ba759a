"""Read observations, ephemerides, interference indicators and positions from receiver logs (UBX, RTCM 3, SBF).

Sources: u-blox interface descriptions F9 HPG 1.32 (UBX-22008968), sections 3.14.5 (MON-RF), 3.14.2 (MON-HW), and X20
HPG 2.00 (SEC-SIG 1 and 2, SEC-SIGLOG); Septentrio mosaic-X5 reference guide 4.14, 4.2.14 (RFStatus, ReceiverStatus).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from railfix.core.arrays import Bytes, Datetimes, Floats, Integers
from railfix.core.errors import InputFileError, MismatchError
from railfix.core.files import FilePath, open_stream
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.io.position_log import PositionLog
from railfix.io.receiver import rtcm, sbf, ubx
from railfix.io.receiver.ephemerides import (
    Assembled,
    Unfinished,
    assemble_navigation,
    assemble_records,
    assemble_rtcm,
    merge_records,
)
from railfix.io.receiver.framing import Frames, SbasFrames, find_frames, join_subframes, sbas_frames
from railfix.io.receiver.measurements import Measurements, Tracking, join_observations, no_measurements

MON_RF: Final = 0x0A38
MON_HW: Final = 0x0A09
SEC_SIG: Final = 0x2709
SEC_SIGLOG: Final = 0x2710
RF_STATUS: Final = 4092
RECEIVER_STATUS: Final = 4014

JAMMING, SPOOFING = 1, 2  #: Bits of `Observations.receiver_alarm`.
#: Lowest u-blox state that sets an alarm (jamming critical, spoofing affirmed). State 2 (jamming warning, spoofing
#: indicated) sets no alarm, because it was sent in 571 of the 581 s of a recording without interference.
_CERTAIN: Final = 3
_NOT_MITIGATED: Final = 8  #: Value of the mode in Septentrio RFStatus for interference that is not mitigated.
_MON_HW_BYTES: Final = 60
_BLOCK: Final = 24  #: Size of each block in u-blox MON-RF [bytes]; the header before the blocks has four bytes.
_BANDS, _FRONT_ENDS = 12, 24  #: Offset of the first sub-block in the payload of RFStatus and of ReceiverStatus [bytes].
_NO_GAIN: Final = -128
_EVENT: Final = 8  #: Size of each event in u-blox SEC-SIGLOG [bytes].
_TRIGGERED_S: Final = 10  #: Duration of the alarm that a single-trigger event of SEC-SIGLOG sets [s].
_SIMULATED: Final = 0  #: SEC-SIGLOG detection type "simulated signal"; no other type sets an alarm.


@dataclass(frozen=True, kw_only=True)
class Indicators:
    """Latest interference indicators of a receiver."""

    alarm: Mapping[int, int] = field(default_factory=dict)  #: Alarm bits in the latest message of each kind.
    gain: float = np.nan  #: Front-end gain in the receiver's unit; NaN until a gain has been received.


def indicators_at(frames: Frames, places: Integers, before: Indicators) -> tuple[Bytes, Floats, Indicators]:
    """Return the alarm bits and the gain at ascending offsets `places`, shape (T,) each, and the latest indicators."""
    found = sorted(_messages(frames))
    alarm, gain = dict(before.alarm), before.gain
    alarms, gains = np.zeros(len(places), dtype=np.uint8), np.full(len(places), np.nan)
    ends = np.searchsorted([place for place, *_ in found], places) if found else np.zeros(len(places), dtype=int)
    done = 0
    for epoch, end in enumerate([*ends.tolist(), len(found)]):
        for _, kind, bits, own_gain in found[done:end]:
            alarm[kind] = bits
            gain = gain if np.isnan(own_gain) else own_gain
        done = max(done, end)
        if epoch < len(places):
            alarms[epoch], gains[epoch] = np.bitwise_or.reduce([0, *alarm.values()]), gain
    return alarms, gains, Indicators(alarm=alarm, gain=gain)


def _messages(frames: Frames) -> Iterator[tuple[int, int, int, float]]:
    """Yield the offset in the stream, kind, alarm bits and gain of each valid interference message."""
    readers = {
        ("ubx", MON_RF): _mon_rf,
        ("ubx", MON_HW): _mon_hw,
        ("ubx", SEC_SIG): _sec_sig,
        ("ubx", SEC_SIGLOG): _sec_siglog,
        ("sbf", RF_STATUS): _rf_status,
        ("sbf", RECEIVER_STATUS): _receiver_status,
    }
    for (protocol, kind), read in readers.items():
        for k in frames.of(protocol, kind).tolist():
            values = read(frames.data[frames.start[k] : frames.end[k]])
            if values is not None:
                yield int(frames.frame_start[k]), kind, *values


def _mon_rf(data: Bytes) -> tuple[int, float] | None:
    """Return the jamming bit, set if any band is jammed, and the first band's gain, or None for a malformed message."""
    if len(data) < 4 + _BLOCK or len(data) != 4 + _BLOCK * int(data[1]):
        return None
    blocks = data[4:].reshape(-1, _BLOCK)
    jammed = bool(((blocks[:, 1] & 3) >= _CERTAIN).any())
    return JAMMING * jammed, float(blocks[0, 14]) + 256.0 * float(blocks[0, 15])


def _mon_hw(data: Bytes) -> tuple[int, float] | None:
    """Return the jamming bit and the gain (receivers up to the M8 generation), or None for a malformed message."""
    if len(data) != _MON_HW_BYTES:
        return None
    return JAMMING * ((int(data[22]) >> 2 & 3) >= _CERTAIN), float(data[18]) + 256.0 * float(data[19])


def _sec_sig(data: Bytes) -> tuple[int, float] | None:
    """Return the jamming and spoofing bits, or None for an unknown version. A bit is 0 where the detection is off."""
    if len(data) >= 12 and data[0] == 1:
        jamming, spoofing = int(data[4]), int(data[8])
    elif len(data) >= 4 and data[0] == 2:
        jamming, spoofing = int(data[1]), int(data[1]) >> 3
    else:
        return None
    bits = JAMMING * (jamming & 1 == 1 and (jamming >> 1 & 3) >= _CERTAIN)
    return bits | SPOOFING * (spoofing & 1 == 1 and (spoofing >> 1 & 7) >= _CERTAIN), np.nan


def _sec_siglog(data: Bytes) -> tuple[int, float] | None:
    """Return the spoofing bit. It is set while a simulated signal lasts, and for 10 s after a single-trigger event.

    Events of abnormal signals, inconsistent inertial data and abrupt changes are ignored, because tunnels cause them.
    Jamming events are ignored, because they already report warnings. Return None for a malformed message.
    """
    if len(data) < 8 or len(data) != 8 + _EVENT * int(data[1]):
        return None
    events = data[8:].reshape(-1, _EVENT)
    simulated = events[events[:, 4] == _SIMULATED]
    elapsed, kind = min(((int(e[:4].view("<u4")[0]), int(e[5])) for e in simulated), default=(0, 1))
    return SPOOFING * (kind == 0 or (kind == 2 and elapsed <= _TRIGGERED_S)), np.nan


def _rf_status(data: Bytes) -> tuple[int, float] | None:
    """Return the jamming bit (interference not mitigated) and the spoofing bit (misleading or unauthentic signal)."""
    if len(data) < _BANDS:
        return None
    count, size, flags = int(data[6]), int(data[7]), int(data[8])
    if size < 7 or len(data) < _BANDS + count * size:
        return None
    modes = data[_BANDS : _BANDS + count * size].reshape(count, size)[:, 6] & 15
    return JAMMING * bool((modes == _NOT_MITIGATED).any()) | SPOOFING * (flags & 3 != 0), np.nan


def _receiver_status(data: Bytes) -> tuple[int, float] | None:
    """Return 0 (no alarm) and the first front end's gain [dB], NaN if unavailable, or None for a malformed block."""
    if len(data) < _FRONT_ENDS or int(data[20]) < 1 or len(data) < _FRONT_ENDS + int(data[21]):
        return None
    gain = int(data[_FRONT_ENDS + 1 : _FRONT_ENDS + 2].view(np.int8)[0])
    return 0, np.nan if gain == _NO_GAIN else float(gain)


_BLOCK_BYTES = 1 << 22


def read_receiver_positions(path: FilePath, *, date: np.datetime64 | None = None) -> PositionLog:
    """Read a receiver's positions. A UBX log without dated NAV-PVT requires a `date` within half a week of the log."""
    parts = []
    near = np.datetime64("NaT", "ns") if date is None else date.astype("datetime64[ns]")
    undated, rest = 0, b""
    with open_stream(path, content="bytes") as stream:
        while True:
            block = stream.read(_BLOCK_BYTES)
            frames = find_frames(np.frombuffer(rest + block, dtype=np.uint8), at_end=not block)
            rest = frames.data[frames.consumed :].tobytes()
            day = ubx.find_date(frames)
            near = near if np.isnat(day) else day
            of_ubx = ubx.positions(frames, near)
            undated += len(frames.of("ubx", ubx.NAV_HPPOSLLH, ubx.NAV_PVT)) if np.isnat(near) else 0
            parts += [part for part in (sbf.positions(frames), of_ubx) if len(part["time"])]
            if not block:
                break
    if not parts:
        why = (
            "its positions (UBX) have no date, and the log has no NAV-PVT with a date; give a date (date, --date)"
            if undated
            else "contains no position of the receiver (UBX NAV-PVT or NAV-HPPOSLLH, SBF PVTGeodetic or PVTCartesian)"
        )
        raise InputFileError(path, why)
    columns: dict[str, Any] = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return PositionLog(path=str(path), line=np.arange(1, len(columns["time"]) + 1), **columns)


#: Kinds of messages that contain observations.
_RAWX: Final = "UBX RXM-RAWX"
_MEAS_EPOCH: Final = "SBF MeasEpoch"
_MSM: Final = "RTCM 3 MSM"


@dataclass(frozen=True, kw_only=True)
class LogPiece:
    """Decoded block of a receiver log."""

    measurements: Measurements
    ephemerides: Assembled
    sbas: SbasFrames
    station: tuple[float, float, float] | None = None  #: Base station's position, ECEF [m]; None if unknown.
    skipped_bytes: int = 0  #: Number of processed bytes that belong to no valid frame.
    bad_checksums: int = 0
    bytes: int = 0  #: Number of processed bytes.


@dataclass(frozen=True, kw_only=True)
class StreamState:
    """Decoder state after a block of a stream."""

    rest: bytes = b""  #: Bytes that are not yet processed: an incomplete frame or epoch.
    subframes: Unfinished = field(default_factory=Unfinished)
    messages: Unfinished = field(default_factory=Unfinished)
    #: Time of the last epoch. Before the first epoch, any time within half a week of the stream, or NaT if unknown.
    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    glonass_channels: Mapping[int, int] = field(default_factory=dict)
    observed: bool = False  #: Whether dated UBX or SBF measurements have been decoded.
    kind: str = ""  #: Kind of observation message that is used; blank before the first epoch.
    clock: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))  #: Latest time in any message.
    indicators: Indicators = field(default_factory=Indicators)
    station: tuple[float, float, float] | None = None  #: `LogPiece.station`.


def decode(data: bytes, state: StreamState, *, at_end: bool = False) -> tuple[LogPiece, StreamState]:
    """Decode a block of bytes, which need not end at a message boundary. Return the decoded piece and the new state."""
    buffer = np.frombuffer(state.rest + data, dtype=np.uint8)
    frames = find_frames(buffer, at_end=at_end)
    if not at_end:
        unfinished = rtcm.find_unfinished_epoch(frames)
        if unfinished is not None:  # an incomplete epoch is kept for the next block
            frames = replace(find_frames(buffer[:unfinished]), data=buffer)
    channels = rtcm.glonass_channels(frames, state.glonass_channels)
    msm, msm_places = rtcm.msm_measurements(frames, state.time, channels)
    own = {_RAWX: ubx.rawx_measurements(frames)}
    if len(_places(frames, _MEAS_EPOCH)):
        own[_MEAS_EPOCH] = sbf.meas_epoch_measurements(frames)
    kind = state.kind or _first_kind(frames, own, msm_places)
    native = kind if kind in own else max(own, key=lambda name: len(own[name].time))
    raw = own[native]
    measurements = {**own, _MSM: msm}.get(kind, no_measurements(""))
    unused = _of_other_kinds(frames, kind) if kind else {**raw.skipped, **msm.skipped}
    measurements = replace(measurements, skipped={**measurements.skipped, **unused, **_of_old_kinds(frames)})
    places = msm_places if kind == _MSM else _places(frames, native)
    epochs_at = places[len(places) - len(measurements.time) :]
    alarm, gain, indicators = indicators_at(frames, epochs_at, state.indicators)
    measurements = replace(measurements, alarm=alarm, gain=gain)
    dated = _date(frames, raw, _places(frames, native), observed=state.observed)
    records, sbas, subframes, messages = _navigation(frames, dated, _Dated(msm_places, msm.time), state)
    last = measurements.time[-1] if len(measurements.time) else state.time
    station = rtcm.station_ecef_m(frames) or state.station
    piece = LogPiece(
        station=station,
        measurements=measurements,
        ephemerides=records,
        sbas=sbas,
        skipped_bytes=frames.skipped_bytes,
        bad_checksums=frames.bad_checksums,
        bytes=frames.consumed,
    )
    rest = buffer[frames.consumed :].tobytes()
    after = StreamState(
        rest=rest,
        subframes=subframes,
        messages=messages,
        time=last,
        glonass_channels=channels.latest(),
        observed=state.observed or len(raw.time) > 0,
        kind=kind,
        clock=dated.times[-1] if len(dated.times) else state.clock,
        indicators=indicators,
        station=station,
    )
    return piece, after


def _of_old_kinds(frames: Frames) -> dict[str, int]:
    """Return the number of observation messages of each unsupported kind (RTCM 3 other than MSM4 to 7, UBX RXM-RAW)."""
    small = (start + n for start in range(1070, 1140, 10) for n in (1, 2, 3))
    kinds = (*range(1001, 1005), *range(1009, 1013), *small)
    counts = {f"RTCM {kind}": len(frames.of("rtcm3", kind)) for kind in kinds}
    counts["UBX RXM-RAW"] = len(frames.of("ubx", ubx.RXM_RAW))
    return {what: number for what, number in counts.items() if number}


def _places(frames: Frames, kind: str) -> Integers:
    """Return the offsets in the stream of the observation messages of one kind."""
    chosen = {
        _RAWX: frames.of("ubx", ubx.RXM_RAWX),
        _MEAS_EPOCH: frames.of("sbf", sbf.MEAS_EPOCH),
        _MSM: frames.of("rtcm3", *rtcm.MSM_NUMBERS),
    }[kind]
    return frames.frame_start[chosen]


def _first_kind(frames: Frames, own: Mapping[str, Measurements], msm_places: Integers) -> str:
    """Return the kind of the first dated observations, or "". Other kinds are not used; they repeat the same data."""
    begins = {kind: _places(frames, kind)[-len(part.time)] for kind, part in own.items() if len(part.time)}
    if len(msm_places):
        begins[_MSM] = msm_places[0]
    return min(begins, key=lambda kind: int(begins[kind]), default="")


def _of_other_kinds(frames: Frames, kind: str) -> dict[str, int]:
    """Return the number of observation messages of each unused kind."""
    counts = {other: len(_places(frames, other)) for other in (_RAWX, _MEAS_EPOCH, _MSM) if other != kind}
    return {f"{other} messages not used, because {kind} is used": n for other, n in counts.items() if n}


class _Dated(NamedTuple):
    """Offsets and times of epochs, or of other messages that have a date, in the order of the stream."""

    places: Integers
    times: Datetimes

    def last_before(self, places: Integers, before: np.datetime64) -> Datetimes:
        """Return the time of the last epoch before each offset, or `before` if no epoch precedes the offset."""
        if not len(self.times):
            return np.full(len(places), before, dtype="datetime64[ns]")
        index = np.searchsorted(self.places, places) - 1
        return np.where(index < 0, before, self.times[np.maximum(index, 0)])

    def first_after(self, places: Integers) -> Datetimes:
        """Return the time of the first epoch at or after each offset, or NaT if there is none."""
        times = np.append(self.times, np.datetime64("NaT", "ns"))
        return np.asarray(times[np.searchsorted(self.places, places)])


def _date(frames: Frames, raw: Measurements, epochs_at: Integers, *, observed: bool) -> _Dated:
    """Return the receiver's epochs. Before the first epoch of the stream, times are taken from other dated messages."""
    epochs_at = epochs_at[len(epochs_at) - len(raw.time) :]
    if observed:
        return _Dated(epochs_at, raw.time)
    readings = [ubx.clock_readings(frames), sbf.clock_readings(frames)]
    places, times = (np.concatenate([part[k] for part in readings]) for k in (0, 1))
    order = np.argsort(places, kind="stable")
    if len(epochs_at):
        order = order[places[order] < epochs_at[0]]
    return _Dated(np.concatenate([places[order], epochs_at]), np.concatenate([times[order], raw.time]))


def _navigation(
    frames: Frames, dated: _Dated, msm: _Dated, state: StreamState
) -> tuple[Assembled, SbasFrames, Unfinished, Unfinished]:
    """Return the ephemerides and SBAS messages of a block, and the states for later subframes and RTCM 3 messages."""
    subframes = join_subframes(ubx.sfrbx_subframes(frames), sbf.navigation_subframes(frames))
    received = dated.last_before(subframes.order, state.time if np.isnat(state.clock) else state.clock)
    after = dated.first_after(subframes.order)
    start = dated.first_after(np.zeros(1, dtype=np.int64))[0]
    first, unfinished = assemble_records(subframes, received, state.subframes, after=after, first=start)
    messages = sorted(rtcm.ephemeris_fields(frames))
    places = np.array([place for place, _, _ in messages], dtype=np.int64)
    before = state.clock if np.isnat(state.time) else state.time
    second, issued = assemble_rtcm(
        messages, (msm if len(msm.times) else dated).last_before(places, before), state.messages
    )
    return merge_records([first, second]), sbas_frames(subframes, received), unfinished, issued


def scan_pieces(
    path: FilePath, *, date: np.datetime64 | None = None, progress: Callable[[float], None] | None = None
) -> Iterator[LogPiece]:
    """Yield the pieces of a receiver log.

    `progress` is called with the fraction of the file read. `date` must be within half a week of the log; it resolves
    the week of RTCM 3 logs without ephemerides. Raise MismatchError if the ephemerides contradict the date.
    """
    state = StreamState(time=_week_of_log(path, date))
    with open_stream(path, content="bytes") as stream:
        while True:
            block = stream.read(_BLOCK_BYTES)
            piece, state = decode(block, state, at_end=not block)
            if progress is not None:
                progress(stream.share)
            yield piece
            if not block:
                return


_SAME_WEEK: Final = np.timedelta64(5, "D")  #: A `date` further than this from the ephemerides' time is rejected.


def _week_of_log(path: FilePath, date: np.datetime64 | None) -> np.datetime64:
    """Return the time of an RTCM 3 log's first ephemerides. If it has none, return `date`, or NaT if `date` is None."""
    own: np.datetime64 = np.datetime64("NaT", "ns")
    rest = b""
    with open_stream(path, content="bytes") as stream:
        while np.isnat(own) and (block := stream.read(_BLOCK_BYTES)):
            frames = find_frames(np.frombuffer(rest + block, dtype=np.uint8), at_end=False)
            if not len(frames.of("rtcm3")):
                break
            own, rest = rtcm.ephemeris_date(frames, date), frames.data[frames.consumed :].tobytes()
    if date is None or np.isnat(own):
        return own if date is None else date.astype("datetime64[ns]")
    if abs(own - date) > _SAME_WEEK:
        what = f"its ephemerides are of {str(own)[:10]}, but the date given (--date) is {str(date)[:10]}"
        raise MismatchError(f"{path}: {what}; leave the date out, or correct it")
    return own


def at_station(observations: Observations, station: tuple[float, float, float] | None) -> Observations:
    """Return the observations with `station` as the position in the header; unchanged if `station` is None."""
    if station is None:
        return observations
    return replace(observations, header=replace(observations.header, approximate_ecef_m=np.array(station)))


def scan_receiver_log(
    path: FilePath, *, date: np.datetime64 | None = None, progress: Callable[[float], None] | None = None
) -> Iterator[Observations]:
    """Yield the observations of a receiver log in blocks. Raise InputFileError if no observation can be dated."""
    tracking = Tracking()
    epochs = frames_seen = undated = 0
    old: Counter[str] = Counter()
    for piece in scan_pieces(path, date=date, progress=progress):
        observations, tracking = join_observations(piece.measurements, tracking)
        frames_seen += piece.bytes - piece.skipped_bytes
        undated += piece.measurements.skipped.get(rtcm.UNDATED, 0)
        old.update({kind: n for kind, n in piece.measurements.skipped.items() if kind.startswith(("RTCM 1", "UBX"))})
        counts = {"bytes outside messages": piece.skipped_bytes, "messages with a bad checksum": piece.bad_checksums}
        skipped = {**observations.skipped, **{what: n for what, n in counts.items() if n}}
        epochs += len(observations)
        yield replace(at_station(observations, piece.station), skipped=skipped)
    if not frames_seen:
        raise InputFileError(path, "contains no UBX, RTCM 3, SBF or NMEA message with a valid checksum")
    if not epochs:
        why = (
            "its observations (RTCM 3) have no date; give a date (date, --date)"
            if undated
            else "contains no observations (UBX RXM-RAWX, SBF MeasEpoch, RTCM 3 MSM4 to MSM7)"
        )
        if old:
            has = ", ".join(f"{what} ({number})" for what, number in sorted(old.items()))
            why += f"; its messages {has} are not supported: log MSM4 to MSM7, or convert the log to RINEX"
        raise InputFileError(path, why)


def read_receiver_navigation(paths: Iterable[FilePath], *, date: np.datetime64 | None = None) -> Navigation:
    """Read the navigation records of receiver logs. Raise InputFileError if there is no complete and dated record."""
    names = tuple(str(Path(path)) for path in paths)
    parts = [piece.ephemerides for name in names for piece in scan_pieces(name, date=date)]
    whole = merge_records(parts)
    undated = sorted(whole.undated - {record.satellite for record in whole.records})
    why = f"the ephemerides of {', '.join(undated)} have no full date; give a date (--date)" if undated else ""
    if not whole.records:
        kinds = "UBX RXM-SFRBX, SBF raw navigation pages, RTCM 3 1019, 1020, 1042, 1044 to 1046"
        raise InputFileError(", ".join(names), why or f"contains no complete ephemeris ({kinds})")
    navigation = assemble_navigation(whole, sources=names)
    return replace(navigation, notes=(f"{', '.join(names)}: left out, because {why}",)) if undated else navigation
