"""Header of a RINEX observation file, and header records among the epochs."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError
from railfix.core.files import LENIENT, ByteStream, FilePath
from railfix.gnss.observations import ObservationHeader
from railfix.io.file_kind import wrong_kind
from railfix.io.rinex.observations_epochs import FaultLog
from railfix.io.rinex.observations_lines import SYSTEMS, SignalColumn, assign_columns

#: Time systems that are valid in TIME OF FIRST OBS.
TIME_SYSTEMS: Final = ("GPS", "GLO", "GAL", "BDT", "QZS", "IRN", "UTC")
#: Time system of a file whose header names none, for each constellation letter of a file.
_DEFAULT_TIME: Final = {"G": "GPS", "R": "GLO", "E": "GAL", "C": "BDT", "J": "QZS", "I": "IRN", "S": "GPS", "M": "GPS"}
ALL: Final = ""  #: Key of the RINEX 2 observation types in `RinexHeader.types`; they apply to all constellations.
_MAX_HEADER_BYTES: Final = 4 << 20  #: A file without END OF HEADER in this number of bytes is rejected.
VERSION: Final = "RINEX VERSION / TYPE"  #: Label of the first record of a header.
#: For each other name of a time system that some programs write, the name in RINEX.
_OTHER_NAMES: Final = {"GPST": "GPS", "BDS": "BDT", "GLONASS": "GLO", "GALILEO": "GAL", "QZSS": "QZS"}


@dataclass(frozen=True, kw_only=True)
class RinexHeader:
    """Header contents of an observation file."""

    version: float
    system: str  #: Constellation letter of the file; "M" if it may have several constellations.
    time_system: str = "GPS"
    #: Declared observation types for each constellation letter; in a RINEX 2 file, only for the key `ALL`.
    types: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    #: Scale factor (SYS / SCALE FACTOR) for each constellation letter and observation type; 1 if absent.
    scale: Mapping[tuple[str, str], float] = field(default_factory=dict)
    #: Part of the header that becomes `Observations.header`.
    public: ObservationHeader = field(default_factory=ObservationHeader)

    @property
    def reading(self) -> tuple[object, ...]:
        """Return the header contents that determine how the epochs are read."""
        return self.version, self.system, self.time_system, self.types, self.scale

    def get_types(self, system: str) -> tuple[str, ...] | None:
        """Return the declared observation types of a constellation, or None if the header declares none for it."""
        return self.types.get(ALL if self.version < 3.0 else system)

    def columns(self, system: str) -> tuple[SignalColumn, ...]:
        """Return the observation columns in a constellation's satellite lines."""
        return assign_columns(self.get_types(system) or (), system=system, version=self.version, scale=self.scale)


def read_header_bytes(stream: ByteStream) -> tuple[list[str], bytes]:
    """Return the header lines of an observation file, and the bytes that were read beyond the header.

    Raise InputFileError if the file is not a RINEX observation file, or if END OF HEADER is missing.
    """
    data = b""
    found = -1
    while found < 0:
        block = stream.read(1 << 16)
        data += block
        if len(data) >= 80 or not block:
            first = data[:200].decode("latin-1").split("\n")[0]
            if first[60:].strip() != VERSION or first[20:21].upper() != "O":
                raise wrong_kind(stream.path, "a RINEX observation file")
        found = data.find(b"END OF HEADER")
        if found < 0 and (not block or len(data) > _MAX_HEADER_BYTES):
            message = "the header has no END OF HEADER; the file is cut short or is no RINEX observation file"
            raise InputFileError(stream.path, message)
    end = data.find(b"\n", found)
    end = len(data) if end < 0 else end + 1
    lines = [line.rstrip("\r") for line in data[:end].decode("latin-1").removesuffix("\n").split("\n")]
    return lines, data[end:]


def parse_header(path: str, lines: Sequence[str], *, log: FaultLog, first_line: int = 1) -> RinexHeader:
    """Parse the header `lines` of an observation file; `first_line` is the line number of the first line.

    `log` receives notes on misaligned and on skipped records. Raise InputFileError if the header cannot be used.
    """
    version = read_version(path, lines[0])
    system = lines[0][40:41].strip().upper() or ("G" if version < 3.0 else "M")
    if system not in SYSTEMS + "M":
        raise InputFileError(path, f"satellite system '{system}' is none of {', '.join(SYSTEMS)} or M", line=first_line)
    start = RinexHeader(
        version=version, system=system, time_system=_DEFAULT_TIME[system], public=ObservationHeader(version=version)
    )
    header = apply_records(path, start, lines[1:], first_line=first_line + 1, log=log)
    if not header.types:
        label = "# / TYPES OF OBSERV" if version < 3.0 else "SYS / # / OBS TYPES"
        raise InputFileError(path, f"the header has no {label} record; the observation types are unknown")
    return header


def read_version(path: FilePath, line: str) -> float:
    """Return the RINEX version in the first line of a file. Raise InputFileError if the version is not supported."""
    try:
        version = float(line[:9])
    except ValueError as error:
        raise InputFileError(path, f"RINEX version '{line[:9].strip()}' is not a number", line=1) from error
    if not 2.0 <= version < 5.0:
        message = f"RINEX version {version:.2f} is not supported; expected 2.10 to 2.12, 3.00 to 3.05 or 4.00 to 4.02"
        raise InputFileError(path, message, line=1)
    return version


def apply_records(
    path: str, header: RinexHeader, lines: Sequence[str], *, first_line: int, log: FaultLog
) -> RinexHeader:
    """Return the header updated with the records `lines`; `first_line` is the line number of the first record."""
    reader = _HeaderRecords(path, header, log)
    for number, line in enumerate(lines, start=first_line):
        reader.read(line, number)
    return reader.finish()


class _HeaderRecords:
    """Reader that applies header records to a copy of a header. Records that are not in columns are split at spaces."""

    def __init__(self, path: str, header: RinexHeader, log: FaultLog) -> None:
        self._path = path
        self._header = header
        self._log = log
        self._line = 0
        self._types = dict(header.types)
        self._scale = dict(header.scale)
        self._channels = dict(header.public.glonass_channel)
        self._changes: dict[str, Any] = {}
        self._declared: dict[str, tuple[int, int]] = {}
        self._current = ALL
        self._fresh: set[str] = set()
        self._scaling: tuple[str, float, int] | None = None

    def read(self, line: str, number: int) -> None:
        """Read one header record; `number` is its line number."""
        self._line = number
        label = line[60:80].strip()
        text = f"{line[:60]:<60}"
        if label in _LAYOUT:
            _LAYOUT[label](self, text)
        elif label in _VALUES:
            name, read = _VALUES[label]
            try:
                self._changes[name] = read(text)
            except ValueError:
                self._changes |= self._by_words(name, label, text)

    def _by_words(self, name: str, label: str, text: str) -> dict[str, Any]:
        """Return the value of a record whose fields are not in their columns, by field name; fields are split at
        spaces.

        With ``broken_lines="stop"``, an unreadable record is an error; with "count", it is noted and skipped.
        """
        read = _BY_WORDS.get(label)
        try:
            if read is not None:
                value = read(text.split())
                self._remark(label)
                return {name: value}
        except (ValueError, IndexError):
            pass
        message = f"{label}: '{text.strip()}' cannot be read as the numbers expected"
        if self._log.stops:
            raise self._fail(f"{message}; {LENIENT}")
        self._log.note(f"{self._path}, line {self._line}: {message}; the record was skipped")
        return {}

    def _remark(self, label: str) -> None:
        read = "is not in its columns; its fields were separated at spaces"
        self._log.remark(f"{self._path}, line {self._line}: {label} {read}")

    def finish(self) -> RinexHeader:
        """Return the header with all records applied."""
        for system, (count, line) in self._declared.items():
            listed = len(self._types[system])
            if listed != count:
                of = f"of {system} " if system else ""
                message = f"{count} observation types {of}are declared, but {listed} are listed"
                raise InputFileError(self._path, message, line=line)
        changes = dict(self._changes)
        time_system = str(changes.pop("time_system", self._header.time_system))
        header = replace(self._header, types=self._types, scale=self._scale, time_system=time_system)
        public = replace(header.public, signals=_signals(header), glonass_channel=self._channels, **changes)
        return replace(header, public=public)

    def _fail(self, message: str) -> InputFileError:
        return InputFileError(self._path, message, line=self._line)

    def _count(self, text: str, what: str) -> int:
        if not text.strip().isdecimal():
            raise self._fail(f"{what}: the number of types '{text.strip()}' is not a whole number")
        return int(text)

    def types_2(self, text: str) -> None:
        """Read a record # / TYPES OF OBSERV."""
        if text[:6].strip():
            self._declared[ALL] = (self._count(text[:6], "# / TYPES OF OBSERV"), self._line)
            self._types[ALL] = ()
        elif ALL not in self._declared:
            raise self._fail("# / TYPES OF OBSERV: the number of types is missing")
        names = [text[k : k + 6].strip() for k in range(6, 60, 6)]
        self._extend(ALL, names, text[6:].split(), "# / TYPES OF OBSERV", r"[CPLDSTX][0-9A-D]")

    def types_3(self, text: str) -> None:
        """Read a record SYS / # / OBS TYPES."""
        words = text.split()
        beside = re.match(r" +[A-Z] +\d+ ", text)
        if text[0] != " " or beside:
            letter, count = (words[0], words[1]) if beside else (text[0], text[3:6])
            words = words[2:] if words[0] == letter else words[1:]
            self._current = letter
            self._declared[letter] = (self._count(count, "SYS / # / OBS TYPES"), self._line)
            self._types[letter] = ()
        elif self._current not in self._declared:
            raise self._fail("SYS / # / OBS TYPES: the constellation letter is missing")
        names = words if beside else [text[k : k + 3].strip() for k in range(7, 59, 4)]
        self._extend(self._current, names, words, "SYS / # / OBS TYPES", r"[CLDSXI][0-9][A-Z]?")
        if beside:
            self._remark("SYS / # / OBS TYPES")

    def _extend(self, system: str, names: list[str], words: list[str], label: str, pattern: str) -> None:
        names = [name for name in names if name]
        wrong = [name for name in names if not re.fullmatch(pattern, name)]
        if wrong:
            if not words or not all(re.fullmatch(pattern, word) for word in words):
                raise self._fail(f"'{wrong[0]}' is not an observation type")
            names = words
            self._remark(label)
        self._types[system] += tuple(names)

    def scale_factor(self, text: str) -> None:
        """Read a record SYS / SCALE FACTOR."""
        if re.match(r" +[A-Z] +\d+( |$)", text):
            self._remark("SYS / SCALE FACTOR")
            text = f"{text.lstrip():<60}"
        names = [text[k : k + 3].strip() for k in range(11, 59, 4)]
        names = [name for name in names if name]
        if text[0] != " ":
            factor, count = text[2:6].strip(), text[8:10].strip()
            if factor.lstrip("0") not in ("1", "10", "100", "1000"):
                words = text.split()
                factor, count, names = (*words[1:3], words[3:]) if len(words) > 2 else (*words[1:2], "", [])  # type: ignore[assignment]
                if factor.lstrip("0") not in ("1", "10", "100", "1000"):
                    raise self._fail(f"SYS / SCALE FACTOR: '{text[2:6].strip()}' is none of 1, 10, 100, 1000")
                self._remark("SYS / SCALE FACTOR")
            if count.strip("0"):
                self._scaling = (text[0], float(factor), self._count(count, "SYS / SCALE FACTOR"))
            else:
                names = list(self._types.get(text[0], ()))
                self._scaling = (text[0], float(factor), len(names))
        if self._scaling is None:
            raise self._fail("SYS / SCALE FACTOR: the constellation letter is missing")
        system, scale, left = self._scaling
        if len(names) != min(left, 12) and text[8:10].strip("0 "):
            raise self._fail(
                f"SYS / SCALE FACTOR: {min(left, 12)} observation types were expected, but {len(names)} are listed"
            )
        for name in names:
            self._scale[system, name] = scale
        self._scaling = (system, scale, left - len(names))

    def time_of_first(self, text: str) -> None:
        """Read the time system in TIME OF FIRST OBS. The time itself is not used."""
        name = text[48:51].strip()
        if name and name not in TIME_SYSTEMS:
            word = text.split()[-1]
            if (found := _OTHER_NAMES.get(word.upper(), word.upper())) not in TIME_SYSTEMS:
                raise self._fail(f"TIME OF FIRST OBS: time system '{name}' is none of {', '.join(TIME_SYSTEMS)}")
            name = found
            self._remark("TIME OF FIRST OBS")
        if name:
            self._changes["time_system"] = name

    def strength_unit(self, text: str) -> None:
        """Check SIGNAL STRENGTH UNIT; raise InputFileError if the unit is not DBHZ."""
        unit = text[:20].strip().upper()
        if unit not in ("DBHZ", ""):
            raise self._fail(f"SIGNAL STRENGTH UNIT: the unit is '{unit}'; DBHZ was expected")

    def glonass_slots(self, text: str) -> None:
        """Read a record GLONASS SLOT / FRQ #."""
        for satellite, channel in re.findall(r"R([ \d]\d)\s+([+-]?\d+)", text[3:]):
            self._channels[f"R{int(satellite):02d}"] = int(channel)


_LAYOUT: Final = {
    "# / TYPES OF OBSERV": _HeaderRecords.types_2,
    "SYS / # / OBS TYPES": _HeaderRecords.types_3,
    "SYS / SCALE FACTOR": _HeaderRecords.scale_factor,
    "TIME OF FIRST OBS": _HeaderRecords.time_of_first,
    "SIGNAL STRENGTH UNIT": _HeaderRecords.strength_unit,
    "GLONASS SLOT / FRQ #": _HeaderRecords.glonass_slots,
}


def _three(text: str) -> Floats:
    values = np.array([float(text[k : k + 14]) for k in (0, 14, 28)])
    if not np.isfinite(values).all():
        raise ValueError("not finite")
    return values


def _place(text: str) -> Floats:
    """Return three coordinates, or NaN if all are 0, because zeros mean an unknown position."""
    xyz = _three(text)
    return xyz if xyz.any() else np.full(3, np.nan)


def _interval(text: str) -> float:
    value = float(text[:10])
    return value if value > 0.0 and math.isfinite(value) else math.nan


#: For each record that sets one field of `ObservationHeader`, the field and the function that reads its value.
_VALUES: Final[Mapping[str, tuple[str, Callable[[str], Any]]]] = {
    "APPROX POSITION XYZ": ("approximate_ecef_m", _place),
    "ANTENNA: DELTA H/E/N": ("antenna_delta_hen_m", _three),
    "INTERVAL": ("interval_s", _interval),
    "LEAP SECONDS": ("leap_seconds", lambda text: int(text[:6])),
    "RCV CLOCK OFFS APPL": ("receiver_clock_applied", lambda text: int(text[:6]) == 1),
    "MARKER NAME": ("marker", str.strip),
    "REC # / TYPE / VERS": ("receiver", lambda text: text[20:40].strip()),
    "ANT # / TYPE": ("antenna", lambda text: text[20:40].strip()),
}


#: Functions that read the value of a record of `_VALUES` from its words, if the fields are not in their columns.
_BY_WORDS: Final[Mapping[str, Callable[[Sequence[str]], Any]]] = {
    "APPROX POSITION XYZ": lambda words: _place("".join(f"{word:>14}" for word in words[:3])),
    "ANTENNA: DELTA H/E/N": lambda words: _three("".join(f"{word:>14}" for word in words[:3])),
    "INTERVAL": lambda words: _interval(words[0]),
    "LEAP SECONDS": lambda words: int(words[0]),
}


def _signals(header: RinexHeader) -> dict[str, tuple[str, ...]]:
    if header.version >= 3.0:
        systems = sorted(header.types)
    else:
        systems = list(SYSTEMS) if header.system == "M" else [header.system]
    signals = {s: tuple(sorted({c.signal for c in header.columns(s)})) for s in systems}
    return {system: names for system, names in signals.items() if names}
