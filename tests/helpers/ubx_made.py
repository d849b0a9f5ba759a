"""UBX logs written from observations and SBAS messages, for tests of receiver streams."""

from __future__ import annotations

import struct

import numpy as np

from railfix.core.timescale import to_week
from railfix.gnss.observations import Observations
from railfix.ranges.sbas import SbasMessages

GNSS = {"G": 0, "S": 1, "E": 2, "C": 3, "J": 5}


def frame(kind: int, payload: bytes) -> bytes:
    """A UBX message with its checksum."""
    body = struct.pack(">H", kind) + struct.pack("<H", len(payload)) + payload
    a = b = 0
    for value in body:
        a = (a + value) & 255
        b = (b + a) & 255
    return b"\xb5\x62" + body + bytes((a, b))


def rawx(observations: Observations, epoch: int) -> bytes:
    """RXM-RAWX of one epoch: the first L1 signal of each satellite with a code."""
    rows, done = b"", set()
    for m, (name, signal) in enumerate(zip(observations.satellite.tolist(), observations.signal.tolist(), strict=True)):
        code = float(observations.code_m[epoch, m])
        if name[0] not in GNSS or name in done or signal not in ("1C", "2I") or not np.isfinite(code):
            continue
        done.add(name)
        phase, doppler, cn0 = (
            float(getattr(observations, n)[epoch, m]) for n in ("phase_cycles", "doppler_hz", "cn0_dbhz")
        )
        tracking = 1 | (6 if np.isfinite(phase) else 0)
        rows += struct.pack(
            "<ddfBBBBHBBBBBx", code, np.nan_to_num(phase), np.nan_to_num(doppler), GNSS[name[0]],
            int(name[1:]) + (100 if name[0] == "S" else 0), 0, 0, 64_000, int(np.nan_to_num(cn0)), 1, 1, 1, tracking,
        )  # fmt: skip
    week, second = to_week(observations.time[epoch])
    head = struct.pack("<dHbBBBH", float(second), int(week), 18, len(rows) // 32, 1, 1, 0)
    return frame(0x0215, head + rows)


def sfrbx_sbas(messages: SbasMessages, row: int) -> bytes:
    """RXM-SFRBX of one SBAS message."""
    words = messages.bits[row].view(">u4").astype("<u4").tobytes()
    return frame(0x0213, struct.pack("<BBBBBBBB", 1, int(messages.prn[row]), 0, 0, 8, 0, 2, 0) + words)


def log_of(observations: Observations, messages: SbasMessages | None = None) -> bytes:
    """A log: every epoch, and after it the SBAS messages that end before the next one."""
    parts = []
    for k in range(len(observations)):
        parts.append(rawx(observations, k))
        if messages is not None:
            after = observations.time[k]
            until = observations.time[k + 1] if k + 1 < len(observations) else after + np.timedelta64(1, "s")
            parts += [
                sfrbx_sbas(messages, row) for row in np.flatnonzero((messages.time >= after) & (messages.time < until))
            ]
    return b"".join(parts)
