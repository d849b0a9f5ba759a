"""SBF blocks, written here from a UBX log's values and read back; RTKLIB reads the same from them."""

from __future__ import annotations

import binascii
import gzip
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest

import railfix
from railfix.core.timescale import to_week
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.io import read_positions
from railfix.io.receiver import sbf, ubx
from railfix.io.receiver.framing import Subframes, find_frames, sbas_frames
from railfix.io.receiver.log import StreamState, decode
from railfix.io.receiver.measurements import join_measurements
from railfix.live.stream import ReceiverState, receive_bytes
from railfix.ranges.sbas import from_receiver
from railfix.simulate import sbas_stream as stream

pytestmark = pytest.mark.requirement("A8")

LIGHT = 299_792_458.0
CARRIER = {"G1C": 1575.42e6, "G2L": 1227.60e6, "C2I": 1561.098e6, "E1C": 1575.42e6}
NUMBER = {"G1C": 0, "G2L": 3, "E1C": 17, "C2I": 28}
FIRST_SVID = {"G": 0, "E": 70, "C": 140}
EPOCHS = 40
NAMES = ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz")


def block(kind: int, payload: bytes) -> bytes:
    """A block with its header and CRC."""
    payload += b"\0" * (-len(payload) % 4)
    body = struct.pack("<HH", kind, 8 + len(payload)) + payload
    return b"$@" + struct.pack("<H", binascii.crc_hqx(body, 0)) + body


def carrier(phase: float, code_m: float, frequency: float) -> tuple[int, int]:
    """CarrierMSB and CarrierLSB: the phase less the code in cycles, in thousandths; -128 and 0 for none."""
    if not np.isfinite(phase):
        return -128, 0
    value = round((phase - code_m * frequency / LIGHT) * 1000.0)
    return (value >> 16, value & 0xFFFF) if -128 << 16 < value < 128 << 16 else (-128, 0)


def meas_epoch(observations: Observations, epoch: int) -> bytes:
    """One MeasEpoch: the first signal of a satellite in a sub-block of type 1, others of type 2."""
    rows: dict[str, list[tuple[str, list[float]]]] = {}
    for m, (name, signal) in enumerate(zip(observations.satellite.tolist(), observations.signal.tolist(), strict=True)):
        values = [float(getattr(observations, n)[epoch, m]) for n in NAMES]
        if name[0] + signal in NUMBER and np.isfinite(values[0]) and np.isfinite(values[2]):
            rows.setdefault(name, []).append((name[0] + signal, values))
    content = b""
    for name, signals in rows.items():
        key, (code, phase, doppler, cn0) = signals[0]
        whole = round(code * 1000.0)
        msb, lsb = carrier(phase, whole * 1e-3, CARRIER[key])
        svid, rate = FIRST_SVID[name[0]] + int(name[1:]), round(doppler * 1e4)
        head = (1, NUMBER[key], svid, whole >> 32, whole & 0xFFFFFFFF, rate, lsb, msb, round((cn0 - 10) * 4))
        content += struct.pack("<BBBBIiHbBHBB", *head, epoch + 1, 0, len(signals) - 1)
        for other, (code2, phase2, doppler2, cn02) in signals[1:]:
            offset = round((code2 - whole * 1e-3) * 1000.0)
            msb, lsb = carrier(phase2, (whole + offset) * 1e-3, CARRIER[other])
            difference = round((doppler2 - rate * 1e-4 * CARRIER[other] / CARRIER[key]) * 1e4)
            offsets = (offset >> 16 & 7) | (difference >> 16 & 31) << 3
            level = round((cn02 - 10) * 4)
            values2 = (NUMBER[other], epoch + 1, level, offsets, msb, 0, offset & 0xFFFF, lsb, difference & 0xFFFF)
            content += struct.pack("<BBBBbBHHH", *values2)
    week, second = to_week(observations.time[epoch])
    head_bytes = struct.pack("<IHBBBBBB", round(float(second) * 1000), int(week), len(rows), 20, 12, 0, 0, 0)
    return block(4027, head_bytes + content)


@pytest.fixture(scope="module")
def logged(recordings: Path) -> Observations:
    return railfix.read_observations(recordings / "live" / "F9T-L2-5min.ubx.gz")[:EPOCHS]


def written(logged: Observations, folder: Path) -> Path:
    path = folder / "log.sbf"
    path.write_bytes(b"".join(meas_epoch(logged, k) for k in range(EPOCHS)))
    return path


def in_common(ours: Observations, theirs: Observations, name: str) -> tuple[np.ndarray, np.ndarray]:
    mine = {c: k for k, c in enumerate(zip(ours.satellite.tolist(), ours.signal.tolist(), strict=True))}
    others = {c: k for k, c in enumerate(zip(theirs.satellite.tolist(), theirs.signal.tolist(), strict=True))}
    both = [c for c in mine if c in others]
    return getattr(ours, name)[:, [mine[c] for c in both]], getattr(theirs, name)[:, [others[c] for c in both]]


def test_values_come_back(logged: Observations, tmp_path: Path) -> None:
    read = railfix.read_observations(written(logged, tmp_path))
    assert np.array_equal(read.time, logged.time)
    assert {(s[0], g) for s, g in zip(read.satellite.tolist(), read.signal.tolist(), strict=True)} == {
        ("G", "1C"), ("G", "2L"), ("C", "2I"), ("E", "1C")
    }  # fmt: skip
    for name, tolerance in zip(NAMES, (0.00051, 0.00051, 0.00006, 0.126), strict=True):
        a, b = in_common(read, logged, name)
        assert np.isfinite(a).sum() > 1_000
        assert np.nanmax(np.abs(a - b)) < tolerance, name


def test_rtklib_reads_the_same(logged: Observations, tmp_path: Path) -> None:
    """Values that both have; RTKLIB 2.4.3 keeps phases marked "do not use", and scales the C/N0 of B1I wrongly."""
    program = shutil.which("convbin")
    if program is None:
        pytest.skip("convbin (Debian package rtklib) is not installed")
    log, target = written(logged, tmp_path), tmp_path / "log.obs"
    words = [program, "-r", "sbf", "-od", "-os", "-f", "5", "-v", "3.04", "-o", str(target), str(log)]
    subprocess.run(words, capture_output=True, check=True, timeout=60)
    ours, theirs = railfix.read_observations(log), railfix.read_observations(target)
    assert len(ours) == len(theirs) == EPOCHS
    for name, tolerance in (("code_m", 0.00051), ("phase_cycles", 0.00051), ("doppler_hz", 0.00062)):
        a, b = in_common(ours, theirs, name)
        assert np.isfinite(a).sum() > 1_000
        assert not (np.isfinite(a) & ~np.isfinite(b)).any(), name
        assert np.nanmax(np.abs(a - b)) < tolerance, name


def test_damaged_blocks_are_skipped(logged: Observations, tmp_path: Path) -> None:
    path = written(logged, tmp_path)
    data = bytearray(path.read_bytes())
    data[200] ^= 16
    path.write_bytes(bytes(data) + meas_epoch(logged, 0)[:50])
    read = railfix.read_observations(path)
    assert len(read) == EPOCHS - 1
    assert read.skipped["bytes outside messages"] > 50


# --- navigation pages ---------------------------------------------------------

#: Block and source of a page by constellation and UBX signal; Galileo is E1-B and E5b.
PAGE = {
    ("G", 0): (4017, 0),
    ("J", 0): (4066, 6),
    ("E", 1): (4023, 17),
    ("E", 5): (4023, 21),
    ("C", 0): (4047, 28),
    ("R", 0): (4026, 8),
    ("S", sbf.SBAS_L5): (4021, 25),
    ("S", 0): (4020, 24),
}
SVID = {"G": 0, "E": 70, "C": 140, "J": 180, "R": 37, "S": 100}


def page(subframes: Subframes, row: int, time: np.datetime64, *, passed: int = 1) -> bytes:
    """A navigation page with the bits of a subframe that UBX has."""
    name, words = str(subframes.satellite[row]), subframes.words[row]
    kind, source = PAGE[name[0], int(subframes.signal[row])]
    bits = np.unpackbits(words.astype(">u4").view(np.uint8)).reshape(10, 32)
    if name[0] == "E":  # the even page's six tail bits and the padding left out
        pages = bits.reshape(-1)
        bits = np.concatenate([pages[:114], pages[128:248], np.zeros(22, np.uint8)])
    elif name[0] == "C":
        bits = np.concatenate([bits[:, 2:].reshape(-1), np.zeros(20, np.uint8)])
    length = 3 if name[0] == "R" else 8 if name[0] in "ES" else 10
    content = np.packbits(bits.reshape(-1)[: 32 * length]).view(">u4").astype("<u4").tobytes()
    week, second = to_week(time)
    channel = int(subframes.glonass_channel[row]) + 8 if name[0] == "R" else 0
    head = (round(float(second) * 1000), int(week), SVID[name[0]] + int(name[1:]), passed, 0, source, channel, 0)
    return block(kind, struct.pack("<IHBBBBBB", *head) + content)


def cold_start(recordings: Path) -> np.ndarray:
    path = recordings / "live" / "16dBatt_no_interference_coldstart.ubx.gz"
    return np.frombuffer(gzip.decompress(path.read_bytes()), np.uint8)


def sbf_of_ubx(data: np.ndarray, observations: Observations) -> bytes:
    """The log as SBF: a MeasEpoch for each RXM-RAWX, a page for each RXM-SFRBX, in the same order."""
    frames = find_frames(data)
    subframes = ubx.sfrbx_subframes(frames)
    epochs_at = frames.frame_start[frames.of("ubx", ubx.RXM_RAWX)]
    parts = [(int(at), meas_epoch(observations, k)) for k, at in enumerate(epochs_at[: len(observations)].tolist())]
    for row in range(len(subframes)):
        if (subframes.satellite[row][:1], int(subframes.signal[row])) in PAGE:
            before = int(np.searchsorted(epochs_at, subframes.order[row])) - 1
            time = observations.time[min(max(before, 0), len(observations) - 1)]
            parts.append((int(subframes.order[row]), page(subframes, row, time)))
    return b"".join(part for _, part in sorted(parts, key=lambda item: item[0]))


@pytest.fixture(scope="module")
def cold(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Navigation]:
    """The cold start as SBF, and the ephemerides of the UBX log."""
    data = cold_start(recordings)
    source, path = tmp_path_factory.mktemp("cold") / "log.ubx", tmp_path_factory.mktemp("sbf") / "log.sbf"
    source.write_bytes(data.tobytes())
    path.write_bytes(sbf_of_ubx(data, railfix.read_observations(source)))
    return path, railfix.read_navigation(source)


def by_satellite(navigation: Navigation) -> dict[tuple[str, np.datetime64, float], dict[str, object]]:
    records = navigation.kepler
    names = records.__dataclass_fields__
    return {
        (str(records.satellite[k]), records.toe[k], float(records.iode[k])): {
            name: getattr(records, name)[k] for name in names
        }
        for k in range(len(records))
    }


def test_ephemerides_of_pages_are_those_of_ubx(cold: tuple[Path, Navigation]) -> None:
    """GPS and Galileo, field by field: the same subframes in both formats."""
    path, expected = cold
    ours, theirs = by_satellite(railfix.read_navigation(path)), by_satellite(expected)
    assert set(ours) == set(theirs)
    assert {key[0][0] for key in ours} == {"G", "E"}
    assert len(ours) >= 28
    for key, record in theirs.items():
        for name, value in record.items():
            np.testing.assert_array_equal(ours[key][name], value, err_msg=f"{key} {name}")


@pytest.mark.parametrize("letter", ["G", "J", "E", "C", "R", "S"])
def test_words_of_a_page_are_those_of_ubx(letter: str) -> None:
    """Random bits of every constellation there and back; a page whose CRC failed is left out and counted."""
    rng = np.random.default_rng(ord(letter))
    count = 20
    used = {"G": 10 * [30], "J": 10 * [30], "E": 3 * [32] + [24] + 3 * [32] + [24], "C": 10 * [30], "R": [32, 32, 21]}
    lengths = used.get(letter, 7 * [32] + [26])
    words = np.zeros((count, 10), dtype=np.uint32)
    left = letter in "ERS"  # bits stand at the left of a word there
    for k, length in enumerate(lengths):
        words[:, k] = rng.integers(0, 1 << length, count, dtype=np.uint64) << (32 - length if left else 0)
    if letter == "E":
        words[:, 3] &= np.uint32(0xFFFFC000)  # the tail of the even page, which SBF leaves out
    signal = np.array([key[1] for key in PAGE if key[0] == letter], dtype=np.int64)
    numbers = np.arange(count) % (5 if letter == "J" else 20) + (20 if letter == "S" else 1)
    sent = Subframes(
        satellite=np.array([f"{letter}{k:02d}" for k in numbers.tolist()]),
        signal=signal[np.arange(count) % len(signal)],
        glonass_channel=np.arange(count) % 14 - 7,
        words=words,
        order=np.arange(count),
    )
    time = np.datetime64("2025-05-23T13:59:00", "ns")
    data = b"".join(page(sent, k, time, passed=int(k != 7)) for k in range(count))
    read = sbf.navigation_subframes(find_frames(np.frombuffer(data, np.uint8)))
    kept = np.arange(count) != 7
    assert read.satellite.tolist() == sent.satellite[kept].tolist()
    assert read.signal.tolist() == sent.signal[kept].tolist()
    assert np.array_equal(read.words, words[kept])
    assert letter != "R" or read.glonass_channel.tolist() == sent.glonass_channel[kept].tolist()
    assert read.skipped == {"SBF navigation pages without valid CRC": 1}


def test_sbas_messages_of_l5_are_another_stream() -> None:
    """GEORawL5 beside GEORawL1: each is read for its own frequency alone."""
    bits = np.array([stream.message(63, k) for k in range(3)])
    words = np.zeros((3, 10), dtype=np.uint32)
    words[:, :8] = bits.view(">u4").reshape(3, 8)
    zero = np.zeros(3, dtype=np.int64)
    sent = Subframes(
        satellite=np.full(3, "S36"), signal=zero + sbf.SBAS_L5, glonass_channel=zero, words=words, order=np.arange(3)
    )
    start = np.datetime64("2025-05-23T13:59:00", "ns")
    data = b"".join(page(sent, k, start + np.timedelta64(k, "s")) for k in range(3))
    read = sbf.navigation_subframes(find_frames(np.frombuffer(data, np.uint8)))
    frames = sbas_frames(read, start + np.arange(3).astype("timedelta64[s]"))
    messages = from_receiver(frames, band="L5")
    assert messages.type.tolist() == [63] * 3
    assert np.array_equal(messages.bits, bits)
    assert not len(from_receiver(frames))


@pytest.mark.slow
def test_a_stream_of_sbf_cut_anywhere_is_the_log(cold: tuple[Path, Navigation]) -> None:
    """Epochs and records in the order of the stream, in fragments as a receiver sends them."""
    data = cold[0].read_bytes()[:150_000]
    whole, _ = decode(data, StreamState(), at_end=True)
    rng = np.random.default_rng(4)
    state, epochs, records, place = ReceiverState(), [], [], 0
    known_at_epoch: list[int] = []
    while place < len(data):
        step = int(rng.integers(1, 3000))
        items = list(receive_bytes(data[place : place + step], state))
        state = items[-1].after
        place += step
        for item in items:
            if item.navigation is not None:
                records += item.navigation.kepler.satellite.tolist()
            for epoch in item.epochs:
                epochs.append(epoch.time[0])
                known_at_epoch.append(len(records))
    assert np.array_equal(np.array(epochs), whole.measurements.time)
    assert records == [record.satellite for record in whole.ephemerides.records]
    assert known_at_epoch[0] == 0
    assert len(set(known_at_epoch)) >= 5  # as they became complete, not all at once


@pytest.mark.parametrize(("kind", "name"), [(4007, "PVTGeodetic"), (4006, "PVTCartesian")])
def test_positions_of_the_receiver(tmp_path: Path, kind: int, name: str) -> None:
    """PVT blocks serve as reference positions: RTK with fixed ambiguities has quality 1."""
    latitude, longitude, height = 0.9, -0.04, 100.0
    from railfix.core.geodesy import ecef_from_geodetic

    ecef = ecef_from_geodetic(np.degrees(latitude), np.degrees(longitude), height)
    place = (latitude, longitude, height) if kind == 4007 else tuple(ecef.tolist())
    data = b""
    for k, (mode, error) in enumerate([(4, 0), (5, 0), (1, 0), (6, 0), (10, 0), (0, 1), (4, 3)]):
        head = struct.pack("<IHBB3df", 1000 * k, 2367, mode, error, *place, 47.0)
        data += block(kind, head + bytes(40))
    path = tmp_path / "log.sbf"
    path.write_bytes(data)
    log = read_positions(path)
    assert log.quality.tolist() == [1, 2, 5, 3, 6], name
    assert np.abs(log.ecef_m - ecef).max() < 1e-6
    assert np.diff(log.time).tolist() == [1_000_000_000] * 4


def test_further_antennas_and_scrambled_blocks_are_left_out(logged: Observations, tmp_path: Path) -> None:
    """A receiver with two antennas: the main antenna's measurements alone; encrypted ones are counted."""
    one = bytearray(meas_epoch(logged, 0))
    first = 8 + 12  # header and head of the block
    one[first + 1] |= 1 << 5  # the first satellite is that of the second antenna
    scrambled = bytearray(meas_epoch(logged, 1))
    scrambled[8 + 9] |= 0x80
    data = b"".join(block(4027, bytes(part[8:])) for part in (one, scrambled))
    path = tmp_path / "log.sbf"
    path.write_bytes(data + meas_epoch(logged, 2))
    read = railfix.read_observations(path)
    assert len(read) == 2
    assert read.skipped["scrambled MeasEpoch"] == 1
    assert read.skipped["MeasEpoch measurements of auxiliary antennas"] == 1


def test_blocks_without_measurements_name_no_receiver(logged: Observations) -> None:
    """The first part of a log may hold no MeasEpoch: the receiver's name is that of the first part with one."""
    first, state = decode(
        block(4007, struct.pack("<IHBB3df", 1000, 2367, 4, 0, 0.9, -0.04, 100.0, 47.0) + bytes(40)), StreamState()
    )
    second, _ = decode(meas_epoch(logged, 0), state, at_end=True)
    assert first.measurements.receiver == ""
    assert join_measurements([first.measurements, second.measurements]).receiver == "Septentrio"
