"""Receivers' own indicators of jamming and spoofing: against pyubx2 and pysbf2, in logs and live."""

from __future__ import annotations

import gzip
import struct
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from pysbf2 import SBFReader
from pyubx2 import UBXReader

import pipeline_cases
from railfix.io.receiver.framing import find_frames
from railfix.io.receiver.log import Indicators, StreamState, decode, indicators_at
from railfix.io.receiver.measurements import join_observations
from railfix.live.stream import ReceiverState, receive_bytes
from ubx_made import frame, rawx

NONE = Indicators()


def last_of(data: bytes) -> tuple[int, float]:
    """Alarm and gain after some bytes."""
    frames = find_frames(np.frombuffer(data, dtype=np.uint8))
    alarm, gain, _ = indicators_at(frames, np.array([len(data)]), NONE)
    return int(alarm[0]), float(gain[0])


def mon_rf(*states: int, gain: int = 4000) -> bytes:
    blocks = b"".join(
        struct.pack("<BBBB8xHHBbBbB3x", k, state, 2, 1, 90, gain + k, 12, 0, 0, 0, 0) for k, state in enumerate(states)
    )
    return frame(0x0A38, struct.pack("<BBxx", 0, len(states)) + blocks)


def mon_hw(state: int, gain: int = 5200) -> bytes:
    return frame(0x0A09, bytes(16) + struct.pack("<HHBBB", 90, gain, 2, 1, state << 2) + bytes(37))


def sec_sig(version: int, jamming: int, spoofing: int, *, on: int = 1) -> bytes:
    if version == 1:
        return frame(0x2709, struct.pack("<B3xB3xB3x", 1, on | jamming << 1, on | spoofing << 1))
    return frame(0x2709, struct.pack("<BBxB", 2, on | jamming << 1 | on << 3 | spoofing << 4, 0))


def crc16(data: bytes) -> int:
    value = 0
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ 0x1021 if value & 0x8000 else value << 1) & 0xFFFF
    return value


def sbf(number: int, body: bytes) -> bytes:
    body += bytes(-len(body) % 4)
    rest = struct.pack("<HH", number, 8 + len(body)) + body
    return b"$@" + struct.pack("<H", crc16(rest)) + rest


def rf_status(modes: list[int], flags: int) -> bytes:
    bands = b"".join(struct.pack("<IHBx", 1_575_420_000, 500, mode | 1 << 6) for mode in modes)
    return sbf(4092, struct.pack("<IHBBB3x", 1000, 2200, len(modes), 8, flags) + bands)


def receiver_status(gain: int) -> bytes:
    head = struct.pack("<IHBBIIIBBBB", 1000, 2200, 20, 0, 500, 0, 0, 2, 4, 0, 0)
    return sbf(4014, head + struct.pack("<BbBB", 0, gain, 100, 0) + struct.pack("<BbBB", 1, 30, 100, 0))


@pytest.mark.requirement("B8")
@pytest.mark.parametrize("state", range(4))
def test_u_blox_indicators_are_those_of_pyubx2(state: int) -> None:
    data = mon_rf(1, state) + mon_hw(state) + sec_sig(1, state, state) + sec_sig(2, state, state)
    parsed = [message for _, message in UBXReader(BytesIO(data))]
    assert [m.identity for m in parsed] == ["MON-RF", "MON-HW", "SEC-SIG", "SEC-SIG"]
    assert parsed[0].jammingState_02 == parsed[1].jammingState == parsed[2].jammingState == state
    assert parsed[3].jammingState == parsed[3].spoofingState == parsed[2].spoofingState == state
    seen = int(state == 3)
    assert last_of(mon_rf(1, state)) == (seen, parsed[0].agcCnt_01)
    assert last_of(mon_hw(state)) == (seen, parsed[1].agcCnt)
    for version in (1, 2):
        assert last_of(sec_sig(version, state, state))[0] == 3 * seen
        assert last_of(sec_sig(version, state, state, on=0))[0] == 0, "detection is off"


@pytest.mark.requirement("B8")
@pytest.mark.parametrize(("modes", "flags", "alarm"), [([2, 1], 0, 0), ([2, 8], 0, 1), ([], 1, 2), ([8], 2, 3)])
def test_septentrio_indicators_are_those_of_pysbf2(modes: list[int], flags: int, alarm: int) -> None:
    data = rf_status(modes, flags) + receiver_status(37)
    status, state = (message for _, message in SBFReader(BytesIO(data)))
    assert (status.identity, status.N, state.identity) == ("RFStatus", len(modes), "ReceiverStatus")
    assert status.Misleading | status.Inauthentic << 1 == flags
    assert [getattr(status, f"Mode_{k + 1:02d}") for k in range(len(modes))] == modes
    assert last_of(data) == (alarm, state.Gain_01)
    assert np.isnan(last_of(receiver_status(-128))[1])


@pytest.mark.requirement("B8")
def test_a_message_counts_from_the_next_epoch_on_in_logs_and_live() -> None:
    """Three epochs; jamming is reported after the first, spoofing after the second, and jamming is over with it."""
    log = pipeline_cases.clean_observations()["front"]
    data = (
        rawx(log, 0) + mon_rf(3) + rawx(log, 10) + mon_rf(0) + sec_sig(2, 1, 3) + rawx(log, 20) + sec_sig(2, 1, 1)
        + rawx(log, 30)
    )  # fmt: skip
    expected = [0, 1, 2, 0]
    piece, _ = decode(data, StreamState(), at_end=True)
    assert join_observations(piece.measurements)[0].receiver_alarm.tolist() == expected
    state, found = ReceiverState(), []
    for k in range(0, len(data), 100):
        for item in receive_bytes(data[k : k + 100], state):
            state = item.after
            found += [int(epoch.receiver_alarm[0]) for epoch in item.epochs]
    assert found == expected


@pytest.mark.requirement("B8")
def test_broken_messages_are_passed_over() -> None:
    for payload in (b"", b"\0\x05\0\0", b"\x02"):
        for kind in (0x0A38, 0x0A09, 0x2709):
            assert last_of(frame(kind, payload))[0] == 0
    assert last_of(sbf(4092, struct.pack("<IHBBB3x", 1000, 2200, 200, 8, 1)))[0] == 0
    assert last_of(sbf(4014, bytes(8)))[0] == 0


@pytest.mark.slow
@pytest.mark.requirement("B8")
def test_a_recorded_stream_has_no_alarm_and_the_gain_of_pyubx2(recordings: Path) -> None:
    data = gzip.decompress((recordings / "live" / "16dBatt_no_interference_coldstart.ubx.gz").read_bytes())
    piece, _ = decode(data, StreamState(), at_end=True)
    log = join_observations(piece.measurements)[0]
    gain, expected = np.nan, []
    for _, message in UBXReader(BytesIO(data), quitonerror=0):
        if message is None:
            continue
        if message.identity == "MON-RF":
            gain = message.agcCnt_01
        elif message.identity == "MON-HW":
            gain = message.agcCnt
        elif message.identity == "RXM-RAWX" and message.numMeas:
            expected.append(gain)
    assert not log.receiver_alarm.any()
    np.testing.assert_array_equal(log.front_end_gain[-500:], expected[-500:])


@pytest.mark.parametrize(
    ("events", "alarm"),
    [
        ([], 0),
        ([(500, 0, 0)], 2),  # a simulated signal since 500 s
        ([(500, 0, 0), (3, 0, 1)], 0),  # and no more for 3 s
        ([(3, 0, 1), (500, 0, 0)], 0),  # whatever the order
        ([(20, 4, 0), (20, 5, 0)], 0),  # jamming: begins with a warning
        ([(20, 5, 0), (10, 0, 0)], 2),
        ([(4, 0, 2)], 2),  # a single trigger, which has no end
        ([(40, 0, 2)], 0),
        ([(1, 1, 0), (1, 2, 0), (1, 3, 0)], 0),  # what tunnels make, too
    ],
)
def test_the_log_of_events_counts_until_an_event_has_ended(events: list[tuple[int, int, int]], alarm: int) -> None:
    body = struct.pack("<BB6x", 1, len(events)) + b"".join(struct.pack("<IBBxx", *event) for event in events)
    data = frame(0x2710, body)
    parsed = UBXReader.parse(data)
    assert [getattr(parsed, f"timeElapsed_{k:02d}") for k in range(1, len(events) + 1)] == [e[0] for e in events]
    assert last_of(data)[0] == alarm
