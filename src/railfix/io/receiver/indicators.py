"""Receivers' indicators of jamming and spoofing, the gain of their front ends, and the positions they computed.

Sources: u-blox F9 HPG 1.32 interface description (UBX-22008968), 3.14.5 MON-RF, 3.14.2 MON-HW; u-blox X20 HPG 2.00
(SEC-SIG, versions 1 and 2; SEC-SIGLOG); Septentrio mosaic-X5 reference guide 4.14, 4.2.14 (RFStatus, ReceiverStatus).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from railfix.core.arrays import Bytes, Floats, Integers
from railfix.core.errors import InputFileError
from railfix.core.files import FilePath, open_stream
from railfix.io.position_log import PositionLog
from railfix.io.receiver import sbf, ubx
from railfix.io.receiver.framing import Frames, find_frames

MON_RF: Final = 0x0A38
MON_HW: Final = 0x0A09
SEC_SIG: Final = 0x2709
SEC_SIGLOG: Final = 0x2710
RF_STATUS: Final = 4092
RECEIVER_STATUS: Final = 4014

JAMMING, SPOOFING = 1, 2  #: Bits of `Observations.receiver_alarm`.
#: u-blox states that count: jamming is critical, spoofing is affirmed. State 2 (warning, indicated) was sent for 571 of
#: 581 s of a recording without interference.
_CERTAIN: Final = 3
#: Septentrio: a band with interference that is not cancelled.
_NOT_MITIGATED: Final = 8
_MON_HW_BYTES: Final = 60
_BLOCK: Final = 24  #: u-blox: bytes of a block of MON-RF after the four of the head.
#: Septentrio: first block of bands or front ends after the time stamp (6 bytes).
_BANDS, _FRONT_ENDS = 12, 24
_NO_GAIN: Final = -128
#: u-blox SEC-SIGLOG: bytes of an event, kinds of detection that count, and how long a single trigger does [s].
_EVENT: Final = 8
_SIMULATED: Final = 0
_LOGGED_JAMMING: Final = frozenset((4, 5))
_TRIGGERED_S: Final = 10


@dataclass(frozen=True, kw_only=True)
class Indicators:
    """Last indicators of each kind of message so far: alarm bits, and the gain, NaN where none has it."""

    alarm: Mapping[int, int] = field(default_factory=dict)
    gain: float = np.nan


def indicators_at(frames: Frames, places: Integers, before: Indicators) -> tuple[Bytes, Floats, Indicators]:
    """Return alarm bits and gain at rising `places` of the stream, shape (T,) each, and the last indicators of all."""
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
    """Yield place in the stream, kind, alarm bits and gain of each message."""
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
    """Jamming of any band, gain of the first."""
    if len(data) < 4 + _BLOCK or len(data) != 4 + _BLOCK * int(data[1]):
        return None
    blocks = data[4:].reshape(-1, _BLOCK)
    jammed = bool(((blocks[:, 1] & 3) >= _CERTAIN).any())
    return JAMMING * jammed, float(blocks[0, 14]) + 256.0 * float(blocks[0, 15])


def _mon_hw(data: Bytes) -> tuple[int, float] | None:
    """Jamming and gain of receivers up to the M8."""
    if len(data) != _MON_HW_BYTES:
        return None
    return JAMMING * ((int(data[22]) >> 2 & 3) >= _CERTAIN), float(data[18]) + 256.0 * float(data[19])


def _sec_sig(data: Bytes) -> tuple[int, float] | None:
    """Jamming and spoofing, each where its detection is on."""
    if len(data) >= 12 and data[0] == 1:
        jamming, spoofing = int(data[4]), int(data[8])
    elif len(data) >= 4 and data[0] == 2:
        jamming, spoofing = int(data[1]), int(data[1]) >> 3
    else:
        return None
    bits = JAMMING * (jamming & 1 == 1 and (jamming >> 1 & 3) >= _CERTAIN)
    return bits | SPOOFING * (spoofing & 1 == 1 and (spoofing >> 1 & 7) >= _CERTAIN), np.nan


def _sec_siglog(data: Bytes) -> tuple[int, float] | None:
    """Jamming and spoofing that the log has begun and not ended, by the newest event of each kind.

    A simulated signal counts as spoofing, broad and narrow bands as jamming. Abnormal signals, contradictions of an
    inertial unit and abrupt changes do not count: tunnels make them.
    """
    if len(data) < 8 or len(data) != 8 + _EVENT * int(data[1]):
        return None
    newest: dict[int, tuple[int, int]] = {}
    for event in data[8:].reshape(-1, _EVENT):
        elapsed, detection, kind = int(event[:4].view("<u4")[0]), int(event[4]), int(event[5])
        if elapsed < newest.get(detection, (1 << 32, 0))[0]:
            newest[detection] = elapsed, kind
    open_kinds = {d for d, (elapsed, kind) in newest.items() if kind == 0 or (kind == 2 and elapsed <= _TRIGGERED_S)}
    return JAMMING * bool(open_kinds & _LOGGED_JAMMING) | SPOOFING * (_SIMULATED in open_kinds), np.nan


def _rf_status(data: Bytes) -> tuple[int, float] | None:
    """Interference that is not cancelled; signals that mislead or are not authentic."""
    if len(data) < _BANDS:
        return None
    count, size, flags = int(data[6]), int(data[7]), int(data[8])
    if size < 7 or len(data) < _BANDS + count * size:
        return None
    modes = data[_BANDS : _BANDS + count * size].reshape(count, size)[:, 6] & 15
    return JAMMING * bool((modes == _NOT_MITIGATED).any()) | SPOOFING * (flags & 3 != 0), np.nan


def _receiver_status(data: Bytes) -> tuple[int, float] | None:
    """Gain of the first front end [dB]."""
    if len(data) < _FRONT_ENDS or int(data[20]) < 1 or len(data) < _FRONT_ENDS + int(data[21]):
        return None
    gain = int(data[_FRONT_ENDS + 1 : _FRONT_ENDS + 2].view(np.int8)[0])
    return 0, np.nan if gain == _NO_GAIN else float(gain)


_BLOCK_BYTES = 1 << 22


def read_receiver_positions(path: FilePath, *, date: np.datetime64 | None = None) -> PositionLog:
    """Read the positions that a receiver computed from its log, plain or packed; `line` counts the positions.

    SBF PVTGeodetic, or PVTCartesian without it; UBX NAV-HPPOSLLH, or NAV-PVT without it. `date` is some time within
    half a week, for UBX logs without a dated NAV-PVT. InputFileError: the log has no position, or none that can be
    dated.
    """
    parts = []
    near = np.datetime64("NaT", "ns") if date is None else date.astype("datetime64[ns]")
    undated, rest = 0, b""
    with open_stream(path, content="bytes") as stream:
        while True:
            block = stream.read(_BLOCK_BYTES)
            frames = find_frames(np.frombuffer(rest + block, dtype=np.uint8), at_end=not block)
            rest = frames.data[frames.consumed :].tobytes()
            day = ubx.date_of(frames)
            near = near if np.isnat(day) else day
            of_ubx = ubx.positions(frames, near)
            undated += len(frames.of("ubx", ubx.NAV_HPPOSLLH, ubx.NAV_PVT)) if np.isnat(near) else 0
            parts += [part for part in (sbf.positions(frames), of_ubx) if len(part["time"])]
            if not block:
                break
    if not parts:
        why = (
            "its positions (UBX) carry no date, and no NAV-PVT with one is in the log; give one with --date"
            if undated
            else "holds no position of the receiver (UBX NAV-PVT or NAV-HPPOSLLH, SBF PVTGeodetic or PVTCartesian)"
        )
        raise InputFileError(path, why)
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return PositionLog(
        path=str(path),
        time=columns["time"],
        ecef_m=columns["ecef_m"],
        quality=columns["quality"],
        sigma_m=columns["sigma_m"],
        line=np.arange(1, len(columns["time"]) + 1),
    )
