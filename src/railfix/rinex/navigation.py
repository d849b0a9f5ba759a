"""RINEX navigation files of versions 2, 3 and 4: broadcast orbits, clocks and ionosphere.

GPS, QZSS, Galileo, BeiDou and GLONASS records in the messages that carry the classic parameters
(LNAV, I/NAV, F/NAV, D1, D2, FDMA) are read; everything else is passed over and counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from os import PathLike
from typing import Final, Literal

import numpy as np

from railfix.errors import InputFileError
from railfix.files import read_text_lines
from railfix.navigation import Navigation
from railfix.rinex.navigation_records import RawRecord, glonass_records, kepler_records

FilePath = str | PathLike[str]

#: Lines of a record, the epoch line included, by constellation (RINEX 2.11 tables A4 and A11; 3.05 table A6 to A16).
_LINES: Final = {"G": 8, "J": 8, "E": 8, "C": 8, "I": 8, "R": 4, "S": 4}
#: Classic messages by constellation as RINEX 4 names them.
_MESSAGES: Final = {"G": ("LNAV",), "J": ("LNAV",), "E": ("INAV", "FNAV"), "C": ("D1", "D2"), "R": ("FDMA",)}
_ION_LETTER: Final = {"GPS": "G", "BDS": "C", "QZS": "J"}
#: Navigation messages hold ten to forty numbers in fields of this width.
_WIDTH: Final = 19


@dataclass
class _Reading:
    """What has been gathered from one or several files."""

    records: list[RawRecord] = field(default_factory=list)
    klobuchar: dict[str, list[float]] = field(default_factory=dict)
    leap_seconds: int | None = None
    passed_over: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    seen: set[tuple[object, ...]] = field(default_factory=set)


def read_navigation(
    paths: FilePath | Sequence[FilePath],
    *,
    on_error: Literal["strict", "lenient"] = "strict",
) -> Navigation:
    """All records of one or several navigation files.

    Parameters
    ----------
    paths : path or sequence of paths
        Plain, gzip, compress.
    on_error : {"strict", "lenient"}
        A broken record stops the reading, or is counted in `passed_over` and named in `notes`.

    Returns
    -------
    Navigation

    Raises
    ------
    InputFileError
        A file is missing, is no navigation file, or (strict) a record is broken; or no file holds
        a usable record.
    """
    files = [paths] if isinstance(paths, (str, PathLike)) else list(paths)
    if not files:
        raise ValueError("at least one navigation file is needed")
    reading = _Reading()
    for path in files:
        _read_file(path, reading, lenient=on_error == "lenient")
    if not reading.records:
        names = ", ".join(str(p) for p in files)
        raise InputFileError(names, "has no usable GPS, QZSS, Galileo, BeiDou or GLONASS record")
    klobuchar = {}
    for letter, values in reading.klobuchar.items():
        if any(values):
            klobuchar[letter] = np.array(values)
        else:
            reading.notes.append(f"ionosphere: the coefficients for {letter} are all zero, that is, not received")
    return Navigation(
        kepler=kepler_records([r for r in reading.records if r.system != "R"]),
        glonass=glonass_records([r for r in reading.records if r.system == "R"]),
        klobuchar=klobuchar,
        leap_seconds=reading.leap_seconds,
        passed_over=dict(reading.passed_over),
        notes=tuple(dict.fromkeys(reading.notes)),
        sources=tuple(str(p) for p in files),
    )


def _read_file(path: FilePath, reading: _Reading, *, lenient: bool) -> None:
    lines = read_text_lines(path)
    version, kind, begin = _read_header(path, lines, reading)
    if not any(line.strip() for line in lines[begin:]):
        raise InputFileError(path, "has a header but no record; the file is cut short, give the whole one")
    blocks: Iterable[_Block]
    if version < 3.0:
        blocks = _blocks_2(path, lines, begin, kind)
    elif version < 4.0:
        blocks = _blocks_3(path, lines, begin)
    else:
        blocks = _blocks_4(path, lines, begin, reading)
    for block in blocks:
        expected = _LINES.get(block.system)
        if block.system not in _MESSAGES:
            reading.passed_over[block.system if expected else f"unknown {block.system!r}"] += 1
            continue
        if block.message and block.message not in _MESSAGES[block.system]:
            reading.passed_over[f"{block.system} {block.message}"] += 1
            continue
        try:
            record = _parse(path, block, version)
        except InputFileError as error:
            if not lenient:
                raise
            reading.passed_over["broken"] += 1
            reading.notes.append(f"passed over: {error}")
            continue
        key = (record.satellite, record.epoch, block.message, tuple(record.numbers))
        if key in reading.seen:
            reading.passed_over["duplicate"] += 1
            continue
        reading.seen.add(key)
        reading.records.append(record)


def _read_header(path: FilePath, lines: list[str], reading: _Reading) -> tuple[float, str, int]:
    """Version, file type letter and first line after the header."""
    first = lines[0] if lines else ""
    if first[60:80].strip() != "RINEX VERSION / TYPE":
        raise InputFileError(path, "is no RINEX file: its first line lacks 'RINEX VERSION / TYPE'", line=1)
    try:
        version = float(first[:9])
    except ValueError:
        raise InputFileError(path, f"RINEX version {first[:9].strip()!r} is no number", line=1) from None
    kind = first[20:21].upper()
    if kind == "O":
        raise InputFileError(path, "is a RINEX observation file, a navigation file was expected", line=1)
    if kind not in ("N", "G", "H") and not (kind == "E" and version >= 3.0):
        raise InputFileError(path, f"is RINEX of type {kind!r}, a navigation file (N) was expected", line=1)
    if not 2.0 <= version < 5.0:
        raise InputFileError(path, f"RINEX version {version:g} is not read; 2, 3 and 4 are", line=1)
    for number, line in enumerate(lines):
        label = line[60:80].strip()
        if label == "END OF HEADER":
            return version, kind, number + 1
        try:
            _header_line(line, label, reading)
        except ValueError:
            raise InputFileError(
                path, f"header record {label} holds no number where one is due", line=number + 1
            ) from None
    raise InputFileError(path, "has no END OF HEADER; the file is cut or no RINEX navigation file")


def _header_line(line: str, label: str, reading: _Reading) -> None:
    if label == "LEAP SECONDS" and line[:6].strip():
        reading.leap_seconds = int(line[:6])
    elif label in ("ION ALPHA", "ION BETA"):
        _keep_ion("G", "AB"[label == "ION BETA"], [_number(line[2 + 12 * i : 14 + 12 * i]) for i in range(4)], reading)
    elif label == "IONOSPHERIC CORR" and line[:3] in _ION_LETTER and line[3] in "AB":
        values = [_number(line[5 + 12 * i : 17 + 12 * i]) for i in range(4)]
        _keep_ion(_ION_LETTER[line[:3]], line[3], values, reading)
    elif label == "IONOSPHERIC CORR":
        reading.passed_over[f"ionosphere {line[:4].strip()}"] += 1


def _keep_ion(letter: str, half: str, values: list[float], reading: _Reading) -> None:
    """Keep four coefficients; the first set of a constellation that is not all zero stays."""
    stored = reading.klobuchar.setdefault(letter, [0.0] * 8)
    part = slice(0, 4) if half == "A" else slice(4, 8)
    if not any(stored[part]):
        stored[part] = [0.0 if np.isnan(v) else v for v in values]


def _number(text: str) -> float:
    """One FORTRAN number; blank is NaN."""
    text = text.strip()
    return float(text.replace("D", "E").replace("d", "e")) if text else float("nan")


@dataclass(frozen=True)
class _Block:
    """Lines of one record: satellite, message (empty before RINEX 4), first line's number, column of the numbers."""

    system: str
    satellite: str
    message: str
    line: int
    text: list[str]


def _name(path: FilePath, line: int, text: str, system: str = "") -> str:
    letter = text[0] if text[:1].isalpha() else system
    digits = text[1:3] if text[:1].isalpha() else text[:2]
    if not digits.strip().isdigit():
        raise InputFileError(path, f"{text[:3]!r} is no satellite", line=line)
    return f"{letter}{int(digits):02d}"


def _blocks_2(path: FilePath, lines: list[str], begin: int, kind: str) -> Iterator[_Block]:
    default = {"N": "G", "G": "R", "H": "S"}[kind]
    starts = [i for i in range(begin, len(lines)) if lines[i][:3].strip()]
    yield from _cut(path, lines, starts, default)


def _blocks_3(path: FilePath, lines: list[str], begin: int) -> Iterator[_Block]:
    starts = [i for i in range(begin, len(lines)) if lines[i][:1].isalpha()]
    yield from _cut(path, lines, starts, "")


def _cut(path: FilePath, lines: list[str], starts: list[int], default: str) -> Iterator[_Block]:
    for start, end in zip(starts, [*starts, len(lines)][1:], strict=True):
        name = _name(path, start + 1, lines[start], default)
        text = lines[start:end]
        while text and not text[-1].strip():
            text.pop()
        yield _Block(name[0], name, "", start + 1, text)


def _blocks_4(path: FilePath, lines: list[str], begin: int, reading: _Reading) -> Iterator[_Block]:
    starts = [i for i in range(begin, len(lines)) if lines[i].startswith(">")]
    for start, end in zip(starts, [*starts, len(lines)][1:], strict=True):
        parts = lines[start].split()
        if len(parts) < 4:
            raise InputFileError(path, "a '>' line must name record type, satellite and message", line=start + 1)
        kind, satellite, message = parts[1:4]
        if kind == "ION":
            _ion_4(path, satellite[0], message, lines[start + 1 : end], start + 2, reading)
        elif kind == "EPH":
            name = _name(path, start + 1, satellite)
            yield _Block(name[0], name, message, start + 2, [x for x in lines[start + 1 : end] if x.strip()])
        else:
            reading.passed_over[kind] += 1


def _ion_4(path: FilePath, letter: str, message: str, text: list[str], line: int, reading: _Reading) -> None:
    if letter not in "GCJ" or message not in ("LNAV", "D1D2") or len(text) < 3:
        reading.passed_over[f"ION {letter} {message}"] += 1
        return
    try:
        values = _fields(text[0], 23, 3) + _fields(text[1], 4, 4) + _fields(text[2], 4, 1)
    except ValueError:
        raise InputFileError(path, "ionosphere record holds no number where one is due", line=line) from None
    _keep_ion(letter, "A", values[:4], reading)
    _keep_ion(letter, "B", values[4:], reading)


def _fields(line: str, begin: int, count: int) -> list[float]:
    return [_number(line[begin + _WIDTH * i : begin + _WIDTH * (i + 1)]) for i in range(count)]


def _parse(path: FilePath, block: _Block, version: float) -> RawRecord:
    """Epoch and numbers of one record."""
    first, needed = block.text[0] if block.text else "", _LINES[block.system]
    if len(block.text) < needed:
        lost = f"record of {block.satellite} has {len(block.text)} lines, {needed} are due"
        raise InputFileError(path, f"{lost}; the file is cut or damaged", line=block.line)
    column = 22 if version < 3.0 else 23
    try:
        epoch = _epoch_2(first) if version < 3.0 else _epoch_3(first)
    except ValueError:
        what = f"epoch {first[3:column].strip()!r} of {block.satellite} is no date and time"
        raise InputFileError(path, what, line=block.line) from None
    numbers: list[float] = []
    for i, line in enumerate(block.text[:needed]):
        try:
            numbers += _fields(line, column, 3) if i == 0 else _fields(line, column - 19, 4)
        except ValueError:
            what = f"record of {block.satellite}: a field is no number in {line.strip()!r}"
            raise InputFileError(path, what, line=block.line + i) from None
    return RawRecord(block.system, block.satellite, block.message, epoch, numbers, version, str(path), block.line)


def _epoch_2(line: str) -> np.datetime64:
    year = int(line[2:5])
    year += 1900 if 80 <= year < 100 else 2000 if year < 80 else 0
    return _instant(year, line[5:8], line[8:11], line[11:14], line[14:17], line[17:22])


def _epoch_3(line: str) -> np.datetime64:
    return _instant(int(line[4:8]), line[8:11], line[11:14], line[14:17], line[17:20], line[20:23])


def _instant(year: int, month: str, day: str, hour: str, minute: str, second: str) -> np.datetime64:
    minute_start = np.datetime64(f"{year:04d}-{int(month):02d}-{int(day):02d}T{int(hour):02d}:{int(minute):02d}")
    return minute_start + np.timedelta64(round(float(second) * 1e9), "ns")
