"""Positions that receivers computed themselves, from their logs: UBX NAV-PVT and NAV-HPPOSLLH, SBF PVT blocks."""

from __future__ import annotations

import numpy as np

from railfix.core.errors import InputFileError
from railfix.core.files import FilePath, open_stream
from railfix.io.position_log import PositionLog
from railfix.io.receiver import sbf, ubx
from railfix.io.receiver.framing import find_frames

_BLOCK_BYTES = 1 << 22


def read_receiver_positions(path: FilePath, *, date: np.datetime64 | None = None) -> PositionLog:
    """Positions in a receiver's log, plain or packed, as the receiver computed them; `line` counts the positions.

    SBF PVTGeodetic, or PVTCartesian without it; UBX NAV-HPPOSLLH, or NAV-PVT without it. Qualities as RTKLIB counts
    them. `date` is some time within half a week, for UBX logs without a NAV-PVT that has a date. InputFileError: the
    log has no position, or none that can be dated.
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
