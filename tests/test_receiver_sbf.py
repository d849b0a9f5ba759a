"""SBF MeasEpoch blocks, written here from a UBX log's values and read back; RTKLIB reads the same from them."""

from __future__ import annotations

import binascii
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest

import railfix
from railfix.core.timescale import to_week
from railfix.gnss.observations import Observations
from railfix.io import rinex

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
    ours, theirs = railfix.read_observations(log), rinex.read_observations(target)
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
