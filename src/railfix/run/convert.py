"""Receiver logs as RINEX files."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Literal

import numpy as np

from railfix.core.errors import OutputError
from railfix.gnss.observations import ObservationHeader
from railfix.io.logs import read_navigation, scan_observations
from railfix.io.rinex import write_navigation, write_observations
from railfix.io.rinex.write_navigation import with_written_messages
from railfix.run.options import LogReading
from railfix.run.output import Overwrite, check_output_file


def convert_logs(
    logs: tuple[Path, ...],
    *,
    out: Path | None,
    nav_out: Path | None,
    rinex: Literal["3", "4"] = "3",
    reading: LogReading | None = None,
    overwrite: Overwrite = "refuse",
) -> list[str]:
    """Write RINEX files (version 3.04 or 4.02) of the logs of one receiver; return what was written and passed over.

    InputFileError: a log cannot be read or holds nothing of what is asked for. OutputError: a file exists already, is
    an input, or cannot be written.
    """
    if out is not None and nav_out is not None and out.resolve() == nav_out.resolve():
        raise OutputError(f"{out}: is named by --out and by --nav-out; name another file for one of them")
    for target in (out, nav_out):
        if target is not None:
            check_output_file(target, overwrite=overwrite, inputs=logs)
    date = (reading or LogReading()).instant
    version: Literal["3.04", "4.02"] = "3.04" if rinex == "3" else "4.02"
    lines: list[str] = []
    if out is not None:
        header, epochs, skipped = _scan(logs, date)
        pieces = (piece for piece in scan_observations(logs, date=date) if len(piece))
        observables = {
            system: [kind + signal for signal in signals for kind in "CLDS"]
            for system, signals in header.signals.items()
        }
        write_observations(pieces, out, version=version, observables=observables, header=header)
        lines.append(f"wrote {out}: {epochs:,} epochs, RINEX {version}")
        lines += [f"passed over: {count:,} {what}" for what, count in sorted(skipped.items())]
    if nav_out is not None:
        navigation, left_out = with_written_messages(read_navigation(logs, date=date))
        write_navigation(navigation, nav_out, version=version)
        records = len(navigation.kepler) + len(navigation.glonass)
        lines.append(f"wrote {nav_out}: {records:,} ephemerides, RINEX {version}")
        lines += [
            f"passed over: {count:,} {what}" for what, count in sorted({**navigation.skipped, **left_out}.items())
        ]
    return lines


def _scan(logs: tuple[Path, ...], date: np.datetime64 | None) -> tuple[ObservationHeader, int, Counter[str]]:
    """Header with the signals of the whole log, number of epochs, and what is passed over."""
    signals: dict[str, set[str]] = {}
    channels: dict[str, int] = {}
    header, epochs, skipped = ObservationHeader(), 0, Counter[str]()
    for piece in scan_observations(logs, date=date):
        header = piece.header if not epochs else header
        channels |= piece.header.glonass_channel
        epochs += len(piece)
        skipped.update(piece.skipped)
        for name, signal in zip(piece.satellite.tolist(), piece.signal.tolist(), strict=True):
            signals.setdefault(name[0], set()).add(signal)
    joined = {system: tuple(sorted(codes)) for system, codes in sorted(signals.items())}
    values = {name: getattr(header, name) for name in ObservationHeader.__dataclass_fields__}
    return ObservationHeader(**{**values, "signals": joined, "glonass_channel": channels}), epochs, skipped
