"""Header of RINEX navigation files, and the content collected from several files."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError
from railfix.core.files import BrokenLines, FilePath
from railfix.io.rinex.navigation_records import RawRecord, number

#: Constellations by the names of IONOSPHERIC CORR (RINEX 3.05, table A5).
_ION_LETTER: Final = {"GPS": "G", "BDS": "C", "QZS": "J"}


@dataclass
class NavigationContent:
    """Records and header content collected from one or several files.

    `klobuchar` has eight coefficients by constellation, as received; `seen` the content of the records, to find
    duplicates.
    """

    broken_lines: BrokenLines
    records: list[RawRecord] = field(default_factory=list)
    klobuchar: dict[str, list[float]] = field(default_factory=dict)
    leap_seconds: int | None = None
    skipped: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    seen: set[tuple[object, ...]] = field(default_factory=set)

    def add(self, record: RawRecord) -> None:
        """Add a record, or count it as a duplicate (joined files of several receivers)."""
        key = (record.satellite, record.epoch, record.message, *record.numbers)
        if key in self.seen:
            self.skipped["duplicate"] += 1
            return
        self.seen.add(key)
        self.records.append(record)

    def reject(self, error: InputFileError) -> None:
        """Raise the error of a broken record, or count and note it."""
        if self.broken_lines == "stop":
            raise error
        self.skipped["broken"] += 1
        self.notes.append(f"skipped: {error}")

    def keep_ionosphere(self, letter: str, half: str, values: list[float]) -> None:
        """Keep four Klobuchar coefficients ("A" alpha, "B" beta): the first set that is not all zero."""
        stored = self.klobuchar.setdefault(letter, [0.0] * 8)
        part = slice(0, 4) if half == "A" else slice(4, 8)
        if not any(stored[part]):
            stored[part] = [0.0 if np.isnan(v) else v for v in values]

    def received_klobuchar(self) -> dict[str, Floats]:
        """Return the coefficients by constellation; all-zero sets, which were not received, are noted."""
        received = {}
        for letter, values in self.klobuchar.items():
            if any(values):
                received[letter] = np.array(values)
            else:
                self.notes.append(f"ionosphere: the coefficients for {letter} are all zero: not received")
        return received


def read_header(path: FilePath, lines: list[str], content: NavigationContent) -> tuple[float, str, int]:
    """Read version, file type letter and index of the first line after the header.

    InputFileError: the file is not a RINEX navigation file of version 2, 3 or 4, or its header is broken.
    """
    version, kind = _version(path, lines[0] if lines else "")
    for i, line in enumerate(lines):
        label = line[60:80].strip()
        if label == "END OF HEADER":
            return version, kind, i + 1
        try:
            _header_line(line, label, content)
        except ValueError:
            raise InputFileError(path, f"header record {label} has an invalid number", line=i + 1) from None
    raise InputFileError(path, "has no END OF HEADER; the file is cut short or not a RINEX navigation file")


def _version(path: FilePath, first: str) -> tuple[float, str]:
    if first[60:80].strip() != "RINEX VERSION / TYPE":
        raise InputFileError(path, "is not a RINEX file: its first line lacks 'RINEX VERSION / TYPE'", line=1)
    try:
        version = float(first[:9])
    except ValueError:
        raise InputFileError(path, f"RINEX version {first[:9].strip()!r} is not a number", line=1) from None
    kind = first[20:21].upper()
    if kind == "O":
        raise InputFileError(
            path, "is a RINEX observation file; give it with --front or --rear (a navigation file was expected)", line=1
        )
    if not 2.0 <= version < 5.0:
        raise InputFileError(path, f"RINEX version {version:g} is not supported; 2, 3 and 4 are", line=1)
    if kind != "N" and not (kind in ("G", "H") and version < 3.0):
        raise InputFileError(path, f"is RINEX of type {kind!r}, a navigation file (N) was expected", line=1)
    return version, kind


def _header_line(line: str, label: str, content: NavigationContent) -> None:
    if label == "LEAP SECONDS" and line[:6].strip():
        content.leap_seconds = int(line[:6])
    elif label in ("ION ALPHA", "ION BETA"):
        values = [number(line[2 + 12 * i : 14 + 12 * i]) for i in range(4)]
        content.keep_ionosphere("G", "B" if label == "ION BETA" else "A", values)
    elif label == "IONOSPHERIC CORR" and line[:3] in _ION_LETTER and line[3] in "AB":
        values = [number(line[5 + 12 * i : 17 + 12 * i]) for i in range(4)]
        content.keep_ionosphere(_ION_LETTER[line[:3]], line[3], values)
    elif label == "IONOSPHERIC CORR":
        content.skipped[f"ionosphere {line[:4].strip()}"] += 1
