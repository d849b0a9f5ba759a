"""Reader of RINEX 2, 3 and 4 navigation files: broadcast orbits, clocks and ionosphere."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime
from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError
from railfix.core.files import LENIENT, BrokenLines, FilePath, Paths, path_names, read_text_lines
from railfix.gnss.navigation import Navigation
from railfix.io.file_kind import wrong_kind
from railfix.io.rinex.header import VERSION, read_version
from railfix.io.rinex.navigation_records import (
    RawRecord,
    first_fault,
    glonass_records,
    kepler_records,
    list_fields,
    number,
)

#: Constellation letter for each name in IONOSPHERIC CORR (RINEX 3.05, table A5).
_ION_LETTER: Final = {"GPS": "G", "BDS": "C", "QZS": "J"}


@dataclass
class NavigationContent:
    """Records and header values of one or several navigation files."""

    broken_lines: BrokenLines
    records: list[RawRecord] = field(default_factory=list)
    #: Eight Klobuchar coefficients (four alpha, four beta) for each constellation letter.
    klobuchar: dict[str, list[float]] = field(default_factory=dict)
    leap_seconds: int | None = None
    skipped: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    seen: set[tuple[object, ...]] = field(default_factory=set)

    def add(self, record: RawRecord) -> None:
        """Add a record, or count it if it is a duplicate. Files joined from several receivers contain duplicates."""
        key = (record.satellite, record.epoch, record.message, *record.numbers)
        if key in self.seen:
            self.skipped["duplicate"] += 1
            return
        self.seen.add(key)
        self.records.append(record)

    def reject(self, error: InputFileError) -> None:
        """Raise the error of a malformed record, or, with ``broken_lines="count"``, count and note it."""
        if self.broken_lines == "stop":
            raise InputFileError(error.path, f"{error.message}; {LENIENT}", line=error.line)
        self.drop("broken", error)

    def drop(self, reason: str, error: InputFileError) -> None:
        """Count and note a record that is not used."""
        self.skipped[reason] += 1
        self.notes.append(f"skipped: {error}")

    def keep_ionosphere(self, letter: str, half: str, values: list[float]) -> None:
        """Store four Klobuchar coefficients ("A" alpha, "B" beta), unless non-zero coefficients are already stored."""
        stored = self.klobuchar.setdefault(letter, [0.0] * 8)
        part = slice(0, 4) if half == "A" else slice(4, 8)
        if not any(stored[part]):
            stored[part] = [0.0 if np.isnan(v) else v for v in values]

    def klobuchar_sets(self) -> dict[str, Floats]:
        """Return the coefficients by constellation. Sets of zeros, which mean "not received", are omitted and noted."""
        received = {}
        for letter, values in self.klobuchar.items():
            if any(values):
                received[letter] = np.array(values)
            else:
                self.notes.append(f"ionosphere: the coefficients for {letter} are all zero, so they were not received")
        return received


def read_header(path: FilePath, lines: list[str], content: NavigationContent) -> tuple[float, str, int]:
    """Read a navigation header into `content`. Return version, file type letter and index of the line after the header.

    Raise InputFileError if the header has an invalid number or no END OF HEADER.
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
    kind = first[20:21].upper()
    if first[60:80].strip() != VERSION or kind not in _FILE_SYSTEMS:
        raise wrong_kind(path, "a RINEX navigation file")
    return read_version(path, first), kind


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


#: Minimum and maximum number of lines of a record with its epoch line, for each constellation (RINEX 2.11, tables A4
#: and A11; 3.05, tables A6 to A16). GLONASS records have a fifth line since RINEX 3.05; its flags are not used.
_LINES: Final = {"G": (8, 8), "J": (8, 8), "E": (8, 8), "C": (8, 8), "R": (4, 5)}
#: Minimum and maximum number of lines of each message that RINEX 4 introduced (4.02, tables A10, A11, A18 to A20).
_LINES_4: Final = {"CNAV": (9, 9), "CNV1": (10, 10), "CNV2": (10, 10), "CNV3": (9, 9)}
#: RINEX 4 names of the messages that are read, for each constellation.
_MESSAGES: Final = {
    "G": ("LNAV", "CNAV", "CNV2"), "J": ("LNAV", "CNAV", "CNV2"), "E": ("INAV", "FNAV"),
    "C": ("D1", "D2", "CNV1", "CNV2", "CNV3"), "R": ("FDMA",),
}  # fmt: skip
#: Constellation of satellites written without a letter, for each file type (RINEX 2.11, 2.12, 3.00).
_FILE_SYSTEMS: Final = {"N": "G", "G": "R", "H": "S", "E": "E", "L": "E", "J": "J"}
_SKIPPED: Final = ("S", "I")  #: Constellations whose records are skipped and counted: SBAS, NavIC.
_WIDTH: Final = 19  #: Width of a number [characters].
#: Record title (RINEX 4.02, table A7), such as ``> EPH G01 LNAV``. Time offsets (STO) may lack the satellite number.
_TITLE: Final = re.compile(r"> *([A-Z]{3}) +([A-Z](?:[ \d]\d)?) *(\S*)")


def read_navigation(paths: Paths, *, broken_lines: BrokenLines = "stop") -> Navigation:
    """Read all records of one or several navigation files, plain or compressed.

    With "count", a malformed record is counted in `skipped` and described in `notes`. Raise InputFileError if a file is
    missing or is not a navigation file, if no file has a usable record, or, with "stop", if a record is malformed.
    """
    files = path_names(paths)
    content = NavigationContent(broken_lines=broken_lines)
    for path in files:
        _read_file(path, content)
    if not content.records:
        first = next((f"; {note}" for note in content.notes if note.startswith("skipped: ")), "")
        names = ", ".join(files)
        raise InputFileError(names, f"has no usable GPS, QZSS, Galileo, BeiDou or GLONASS record{first}")
    return Navigation(
        kepler=kepler_records([r for r in content.records if r.system != "R"]),
        glonass=glonass_records([r for r in content.records if r.system == "R"]),
        klobuchar=content.klobuchar_sets(),
        leap_seconds=content.leap_seconds,
        skipped=dict(content.skipped),
        notes=tuple(dict.fromkeys(content.notes)),
        sources=tuple(files),
    )


@dataclass(frozen=True)
class _Block:
    """Lines of one record."""

    line: int  #: Line number of the record's first line in the file.
    name: str  #: Satellite name as written in the file.
    message: str  #: Message name as in the record's title; blank before RINEX 4, which has no titles.
    text: list[str]  #: Lines of the record, without a title.
    last: bool = False  #: Whether the record is the last of the file; the last record may be incomplete.


def _read_file(path: FilePath, content: NavigationContent) -> None:
    lines = read_text_lines(path)
    version, kind, begin = read_header(path, lines, content)
    if not any(line.strip() for line in lines[begin:]):
        raise InputFileError(path, "has a header but no record, so it is cut short; give the complete file")
    blocks = _blocks_4(path, lines, begin, content) if version >= 4.0 else _blocks(path, lines, begin, version, kind)
    for block in blocks:
        try:
            record = _record(path, block, version, content)
        except InputFileError as error:
            if block.last and "lines," in error.message:
                content.drop("records cut short by the end of the file", error)
            else:
                content.reject(error)
            continue
        if record is not None:
            content.add(record)


def _blocks(path: FilePath, lines: list[str], begin: int, version: float, kind: str) -> Iterator[_Block]:
    """Yield the records of a version 2 or 3 file. All lines of a record except the first begin with blanks."""
    starts = [i for i in range(begin, len(lines)) if lines[i][:3].strip()]
    _reject_stray(path, lines, begin, starts)
    letter = _FILE_SYSTEMS[kind] if version < 3.0 else ""
    for start, end in zip(starts, [*starts, len(lines)][1:], strict=True):
        text = lines[start]
        name = letter + text[:2] if letter and not text[:1].isalpha() else text[:3]
        yield _Block(start + 1, name, "", lines[start:end], end == len(lines))


def _reject_stray(path: FilePath, lines: list[str], begin: int, starts: list[int]) -> None:
    for i in range(begin, starts[0] if starts else len(lines)):
        if lines[i].strip():
            raise InputFileError(path, f"{lines[i].strip()!r} comes before the first record", line=i + 1)


def _blocks_4(path: FilePath, lines: list[str], begin: int, content: NavigationContent) -> Iterator[_Block]:
    """Yield the ephemerides of a version 4 file. Ionosphere records go to `content`; other records are counted."""
    starts = [i for i in range(begin, len(lines)) if lines[i].startswith(">")]
    _reject_stray(path, lines, begin, starts)
    for start, end in zip(starts, [*starts, len(lines)][1:], strict=True):
        title = _TITLE.match(lines[start])
        text = lines[start + 1 : end]
        try:
            if title is None:
                what = f"{lines[start].strip()!r} is not a title such as '> EPH G01 LNAV' (type, satellite, message)"
                raise InputFileError(path, what, line=start + 1)
            kind, name, message = title.groups()
            if kind == "EPH":
                yield _Block(start + 2, name, message, text, end == len(lines))
            elif kind == "ION":
                _ionosphere_4(path, name[0], message, text, start + 2, content)
            else:
                content.skipped[kind] += 1
        except InputFileError as error:
            content.reject(error)


def _ionosphere_4(
    path: FilePath, letter: str, message: str, text: list[str], line: int, content: NavigationContent
) -> None:
    """Read the Klobuchar coefficients in an ionosphere record (RINEX 4.02, table A34). Other models are counted."""
    if letter not in "GCJ" or message not in ("LNAV", "D1D2"):
        content.skipped[f"ION {letter} {message}"] += 1
        return
    if len(text) < 3:
        raise InputFileError(path, f"ionosphere record has {len(text)} lines, not 3; the file is cut", line=line)
    try:
        fields = [(text[0], 23 + 19 * i) for i in range(3)] + [(text[1], 4 + 19 * i) for i in range(4)] + [(text[2], 4)]
        values = [number(row[column : column + _WIDTH]) for row, column in fields]
    except ValueError:
        raise InputFileError(path, "ionosphere record: a number was expected", line=line) from None
    content.keep_ionosphere(letter, "A", values[:4])
    content.keep_ionosphere(letter, "B", values[4:])


def _record(path: FilePath, block: _Block, version: float, content: NavigationContent) -> RawRecord | None:
    """Read one record. Return None, and count the record, if its constellation or message is skipped."""
    system, digits = block.name[:1], block.name[1:].strip()
    if system not in (*_LINES, *_SKIPPED) or not (digits.isdecimal() and int(digits)):
        raise InputFileError(path, f"{block.name!r} is not a satellite name", line=block.line - (version >= 4.0))
    satellite = f"{system}{int(digits):02d}"
    if system in _SKIPPED or (block.message and block.message not in _MESSAGES[system]):
        content.skipped[f"{system} {block.message}".strip()] += 1
        return None
    fewest, most = _LINES_4.get(block.message, _LINES[system])
    # Blank lines after the record are ignored; more lines with fields than expected are a fault.
    count = next((k for k in range(len(block.text), fewest, -1) if block.text[k - 1].strip()), fewest)
    count = min(count, len(block.text))
    if not fewest <= count <= most:
        fault = "the file is cut or damaged" if count < fewest else "the line that begins the next record is damaged"
        raise InputFileError(
            path, f"record of {satellite} has {count} lines, but {fewest} were expected; {fault}", line=block.line
        )
    first = block.text[0]
    lettered = version >= 3.0 or first[:1].isalpha()  # a letter (as in RINEX 2.12) shifts all columns by one
    try:
        epoch = _instant(first[4:], 4) if version >= 3.0 else _instant(first[2 + lettered :], 3)
    except ValueError:
        what = f"epoch {first[3 : 23 if lettered else 22].strip()!r} of {satellite} is not a date and time"
        raise InputFileError(path, what, line=block.line) from None
    numbers = _numbers(path, block, satellite, shift=19 if lettered else 18)
    record = RawRecord(system, satellite, block.message, epoch, numbers, version)
    fault_at = first_fault(record)
    if fault_at is not None:
        field, message = fault_at
        raise InputFileError(path, f"record of {satellite}: {message}", line=block.line + (field + 1) // 4)
    return record


def _numbers(path: FilePath, block: _Block, satellite: str, *, shift: int) -> list[float]:
    """Parse the numbers of a record in the order of the file; blank numbers are NaN."""
    names = list_fields(satellite[0], block.message)
    numbers: list[float] = []
    for k, name in enumerate(names):
        # The first line has three numbers, after satellite and time; other lines have four numbers.
        row, place = divmod(k + 1, 4)
        text = block.text[row]
        column = shift - 15 + _WIDTH * place
        try:
            numbers.append(number(text[column : column + _WIDTH]))
        except ValueError:
            what = f"record of {satellite}: {name} {text[column : column + _WIDTH].strip()!r} is not a number"
            raise InputFileError(path, what, line=block.line + row) from None
    return numbers


def _instant(text: str, digits: int) -> np.datetime64:
    """Parse a time; its year has `digits` characters (3 in RINEX 2, 4 later). Raise ValueError for an invalid time."""
    year, rest = int(text[:digits]), text[digits:]
    if digits < 4:
        year += 1900 if 80 <= year < 100 else 2000 if year < 80 else 0
    seconds = float(rest[12:15] if digits == 4 else rest[12:17])
    if not (1980 <= year < 2100 and 0.0 <= seconds <= 60.0):
        raise ValueError(year, seconds)
    month, day, hour, minute = (int(rest[at : at + 3]) for at in range(0, 12, 3))
    return np.datetime64(datetime(year, month, day, hour, minute), "ns") + np.timedelta64(round(seconds * 1e9), "ns")
