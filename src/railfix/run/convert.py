"""Receiver logs as RINEX files."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from railfix.core.settings import Settings
from railfix.gnss.observations import ObservationHeader
from railfix.io.logs import read_navigation, scan_observations
from railfix.io.rinex import write_navigation, write_observations
from railfix.run.options import LogReading
from railfix.run.output import Overwrite, check_output_file


class Conversion(Settings):
    """What is converted, and to what.

    Attributes
    ----------
    logs : tuple of Path
        Of one receiver.
    out, nav_out : Path or None
        RINEX observation and navigation file to write.
    rinex : {"3", "4"}
        Version 3.04 or 4.02.
    reading : LogReading
    """

    logs: tuple[Path, ...]
    out: Path | None = None
    nav_out: Path | None = None
    rinex: Literal["3", "4"] = "3"
    reading: LogReading = Field(default_factory=LogReading)


def convert_logs(conversion: Conversion, *, overwrite: Overwrite = "refuse") -> list[str]:
    """Write RINEX files and return what was written and what was passed over, a line each.

    Raises
    ------
    InputFileError
        A log cannot be read or holds nothing of what is asked for.
    OutputError
        A file exists already, is an input, or cannot be written.
    """
    for target in (conversion.out, conversion.nav_out):
        if target is not None:
            check_output_file(target, overwrite=overwrite, inputs=conversion.logs)
    date = conversion.reading.instant
    version: Literal["3.04", "4.02"] = "3.04" if conversion.rinex == "3" else "4.02"
    lines: list[str] = []
    if conversion.out is not None:
        header, epochs, skipped = _scanned(conversion.logs, date)
        pieces = (piece for piece in scan_observations(conversion.logs, date=date) if len(piece))
        observables = {
            system: [kind + signal for signal in signals for kind in "CLDS"]
            for system, signals in header.signals.items()
        }
        write_observations(pieces, conversion.out, version=version, observables=observables, header=header)
        lines.append(f"wrote {conversion.out}: {epochs:,} epochs, RINEX {version}")
        lines += [f"passed over: {count:,} {what}" for what, count in sorted(skipped.items())]
    if conversion.nav_out is not None:
        navigation = read_navigation(conversion.logs, date=date)
        write_navigation(navigation, conversion.nav_out, version=version)
        records = len(navigation.kepler) + len(navigation.glonass)
        lines.append(f"wrote {conversion.nav_out}: {records:,} ephemerides, RINEX {version}")
        lines += [f"passed over: {count:,} {what}" for what, count in sorted(navigation.skipped.items())]
    return lines


def _scanned(logs: tuple[Path, ...], date: np.datetime64 | None) -> tuple[ObservationHeader, int, Counter[str]]:
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
