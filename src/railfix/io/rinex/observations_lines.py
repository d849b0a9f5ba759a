"""Split text into lines, parse epoch lines, and find the signals of RINEX observation types.

In RINEX 3 and 4, an observation type names the signal ("C1C" is the code of "1C"). In RINEX 2, a type names only the
band (RINEX 2.11, table A1; RINEX 3.05, tables 4 to 11). L1, D1 and S1 are assigned to the signal of C1, or to the
signal of P1 if only P1 is declared. L2, D2 and S2 are assigned to the signal of P2, or to the signal of C2 if only C2
is declared. The BeiDou signals 1I and 1Q, and 1X in RINEX 3.02, are read as 2I, 2Q and 2X, because B1 is band 1 in
RINEX 3.02.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix import kernels
from railfix.core.arrays import Bytes, Integers, Masks, take_rows

_BLANK: Final = ord(" ")
_ZERO: Final = ord("0")


@dataclass(frozen=True)
class Lines:
    """Lines of a block of text."""

    data: Bytes  #: Text of the block, followed by blanks, because fixed columns may extend beyond the last line.
    start: Integers  #: Offset of each line in `data`, shape (n,).
    length: Integers  #: Length of each line without the line end (LF or CR LF), shape (n,).
    stop: Integers  #: Offset in `data` of the first character after each line and its LF, shape (n,).
    number: Integers  #: Line number of each line in the decompressed file, from 1; shape (n,).

    def __len__(self) -> int:
        return len(self.start)

    def text(self, line: int) -> str:
        """Return one line as text."""
        first = int(self.start[line])
        return self.data[first : first + int(self.length[line])].tobytes().decode("latin-1")

    def columns(self, lines: Integers, width: int) -> Bytes:
        """Return the first `width` characters of each line, shape (n, width), blank beyond the end of the line."""
        items = np.ndarray((len(self.data) - width + 1,), dtype=f"V{width}", buffer=self.data, strides=(1,))
        text: Bytes = items[self.start[lines]].view(np.uint8).reshape(len(lines), width)
        short = np.flatnonzero(self.length[lines] < width)
        if len(short):
            beyond = np.arange(width) >= self.length[lines[short], None]
            text[short] = np.where(beyond, _BLANK, text[short])
        return text

    def __getitem__(self, some: slice) -> Lines:
        """Return some of the lines."""
        return Lines(self.data, self.start[some], self.length[some], self.stop[some], self.number[some])


def split_lines(text: bytes, *, first_number: int, keep_blank: bool) -> Lines:
    """Split a block, which ends with `PADDING` blanks, into lines. `keep_blank` keeps empty lines (RINEX 2)."""
    data = np.frombuffer(text, dtype=np.uint8)
    end = kernels.reading.line_ends(data)
    start = np.concatenate([np.zeros(min(len(end), 1), dtype=np.int64), end[:-1] + 1])
    length = end - start
    length -= (length > 0) & (data[end - 1] == ord("\r"))
    number = np.arange(first_number, first_number + len(end))
    lines = Lines(data, start, length, end + 1, number)
    if keep_blank or length.all():
        return lines
    kept = length > 0
    return Lines(data, start[kept], length[kept], end[kept] + 1, number[kept])


@dataclass(frozen=True)
class EpochHeads:
    """Epoch lines and events of a block, n rows."""

    line: Integers  #: Index in `Lines` of the epoch line, shape (n,).
    flag: Integers  #: Epoch flag; -1 if it cannot be read, shape (n,).
    count: Integers  #: Number of satellites, or of header records of an event; -1 if it cannot be read, shape (n,).
    time_ns: Integers  #: Epoch since 1970 in the file's time system [ns]; 0 for events and invalid lines, shape (n,).
    flaw: Integers  #: Fault of the epoch line, as an index into `FLAWS`; 0 if the line is valid, shape (n,).

    def __len__(self) -> int:
        return len(self.line)

    def __getitem__(self, which: slice | Masks | Integers) -> EpochHeads:
        return take_rows(self, which)


FLAWS: Final = (
    "",
    "the epoch line is shorter than {width} characters",
    "the epoch flag '{flag}' is not in 0 to 6",
    "the number of satellites '{count}' is not a number",
    "the fields of the epoch line are not in their columns",
    "the year is not a number",
    "the month is not in 1 to 12",
    "the day does not exist in its month",
    "the hour is not in 0 to 23",
    "the minute is not in 0 to 59",
    "the seconds are not at least 0 and below 60",
)
_SHORT, _FLAG, _COUNT, _PLACES = 1, 2, 3, 4


def epoch_width(version: float) -> int:
    """Return the number of characters in an epoch line up to the end of the number of satellites."""
    return 35 if version >= 3.0 else 32


def read_epoch_lines(lines: Lines, which: Integers, *, version: float) -> EpochHeads:
    """Parse epoch lines of RINEX 2 (years of two digits), 3 and 4. An event may have no time."""
    width = epoch_width(version)
    text = np.ascontiguousarray(lines.columns(which, width).T)  # one row per column of the file
    at = width - 35
    flag, flag_ok = _number(text[31 + at : 32 + at])
    count, count_ok = _number(_right_aligned(text[32 + at : 35 + at]))
    year_from = 2 if version >= 3.0 else 1
    year, year_ok = _number(text[year_from : 6 + at])
    if version < 3.0:
        year = year + np.where(year >= 80, 1900, 2000)
    parts = [_number(text[first + at : first + at + 2]) for first in (7, 10, 13, 16, 19)]
    (month, month_ok), (day, day_ok), (hour, hour_ok), (minute, minute_ok), (second, second_ok) = parts
    fraction, fraction_ok = _fraction(text[22 + at : 29 + at])
    gaps = [first + at for first in (6, 9, 12, 15, 18, 29, 30)] + [0 if version < 3.0 else 1]
    placed = (text[gaps] == _BLANK).all(axis=0) & (text[21 + at] == ord("."))
    month_ok &= (month >= 1) & (month <= 12)
    months = (year - 1970) * 12 + np.where(month_ok, month, 1) - 1
    first_day = months.astype("M8[M]").astype("M8[D]").astype(np.int64)
    next_month = (months + 1).astype("M8[M]").astype("M8[D]").astype(np.int64)
    day_ok &= (day >= 1) & (day <= next_month - first_day)
    flag_ok &= flag <= 6
    event = flag_ok & (flag >= 2) & (flag <= 5)
    checks = (
        lines.length[which] >= width,
        flag_ok,
        count_ok,
        placed | event,
        (year_ok & (year > 1969) & (year < 2200)) | event,
        month_ok | event,
        day_ok | event,
        (hour_ok & (hour < 24)) | event,
        (minute_ok & (minute < 60)) | event,
        (second_ok & fraction_ok & (second < 60)) | event,
    )
    flaw = np.zeros(len(which), dtype=np.int64)
    for code, fine in reversed(list(enumerate(checks, start=1))):
        flaw[~fine] = code
    seconds = ((first_day + day - 1) * 24 + hour) * 3600 + minute * 60 + second
    time_ns = np.where((flaw == 0) & ~event, seconds * 1_000_000_000 + fraction * 100, 0)
    known = flaw != _SHORT
    return EpochHeads(which, np.where(flag_ok & known, flag, -1), np.where(count_ok & known, count, -1), time_ns, flaw)


def flaw_text(lines: Lines, line: int, flaw: int, *, version: float) -> str:
    """Return a description of the fault in an epoch line."""
    width = epoch_width(version)
    text = f"{lines.text(line):<{width}}"
    message = FLAWS[flaw].format(width=width, flag=text[width - 4], count=text[width - 3 : width])
    return f"{message} ('{text[:width].rstrip()}')"


def _right_aligned(text: Bytes) -> Bytes:
    """Right-align fields of three characters, because some programs write blanks after a count."""
    for _ in range(2):
        text = np.where(text[-1] == _BLANK, np.roll(text, 1, axis=0), text)
    return text


def _number(text: Bytes) -> tuple[Integers, Masks]:
    """Parse right-aligned digits, shape (width, n). Return n numbers and whether each is valid."""
    digits = text - np.uint8(_ZERO)
    is_digit, blank = digits <= 9, text == _BLANK
    fine = (is_digit | blank).all(axis=0) & is_digit[-1] & ~(is_digit[:-1] & blank[1:]).any(axis=0)
    return np.where(fine, _value(digits, is_digit), 0), fine


def _fraction(text: Bytes) -> tuple[Integers, Masks]:
    """Parse left-aligned decimals, shape (width, n), as integers in units of the last decimal."""
    _, fine = _number(text[::-1])
    return _value(text - np.uint8(_ZERO), text != _BLANK), fine


def _value(digits: Bytes, counted: Masks) -> Integers:
    """Return the numbers formed by the digits, shape (n,). Digits that are not `counted` are taken as 0."""
    value = np.zeros(digits.shape[1], dtype=np.int64)
    for row, here in zip(digits, counted, strict=True):
        value = 10 * value + np.where(here, row, 0)
    return value


def event_line(lines: Lines, line: int) -> tuple[int, int] | None:
    """Return the flag and the count of a RINEX 2 event line without a time, or None for another line."""
    text = f"{lines.text(line):<32}"
    flag, count = text[28], text[29:32].strip()
    if text[:26].strip() or flag not in "2345" or not count.isdecimal():
        return None
    return int(flag), int(count)


SYSTEMS: Final = "CEGIJRS"  #: Letters of the constellations that RINEX defines.
#: Field of `Observations` for each first letter of an observation type.
KINDS: Final = {"C": "code_m", "L": "phase_cycles", "D": "doppler_hz", "S": "cn0_dbhz"}

#: Signal of each RINEX 2 code observation, for each constellation.
_CODES_2: Final[dict[str, dict[str, str]]] = {
    "G": {"C1": "1C", "P1": "1W", "C2": "2X", "P2": "2W", "C5": "5X", "CA": "1C", "CB": "1X", "CC": "2X"},
    "R": {"C1": "1C", "P1": "1P", "C2": "2C", "P2": "2P", "CA": "1C", "CD": "2C"},
    "E": {"C1": "1X", "C5": "5X", "C6": "6X", "C7": "7X", "C8": "8X"},
    "C": {"C1": "2I", "P1": "2I", "C2": "2I", "P2": "2I", "C5": "5X", "C6": "6I", "C7": "7I", "C8": "8X"},
    "J": {"C1": "1C", "C2": "2X", "C5": "5X", "C6": "6X", "CA": "1C", "CB": "1X", "CC": "2X"},
    "S": {"C1": "1C", "C5": "5X", "CA": "1C"},
    "I": {"C5": "5A", "C9": "9A"},
}
#: Codes of each RINEX 2 band. Phase, Doppler and C/N0 are assigned to the signal of the first code that is declared.
_OWNERS_2: Final[dict[str, tuple[str, ...]]] = {"1": ("C1", "P1"), "2": ("P2", "C2")}


@dataclass(frozen=True)
class SignalColumn:
    """Column of one observation type in satellite lines."""

    index: int  #: Index of the column among the declared observation types.
    name: str  #: Observation type as declared in the header, such as "C1C".
    kind: int  #: Index in `KINDS` of the kind of observation.
    signal: str  #: Signal of the observation type, such as "1C".
    divisor: float  #: Scale factor (SYS / SCALE FACTOR) by which the values are divided.


def find_signal(name: str, *, system: str, version: float, declared: Sequence[str]) -> str | None:
    """Return the signal of the observation type `name` ("C1C", "P2"), or None for other types ("X1", "T1")."""
    if version >= 3.0:
        if name[0] not in KINDS:
            return None
        signal = name[1:].strip()
        if system == "C" and (signal in ("1I", "1Q") or (signal == "1X" and round(version, 2) == 3.02)):
            return "2" + signal[1:]
        return signal
    kind, band = name[0], name[1]
    codes = _CODES_2.get(system, {})
    if kind in "CP":
        return codes.get(name)
    if kind not in KINDS:
        return None
    for owner in _OWNERS_2.get(band, ()):
        if owner in declared and owner in codes:
            return codes[owner]
    return codes.get(_OWNERS_2.get(band, ("C" + band,))[0])


def assign_columns(
    declared: Sequence[str], *, system: str, version: float, scale: Mapping[tuple[str, str], float]
) -> tuple[SignalColumn, ...]:
    """Return the columns of a constellation. If several types have the same signal and kind, only the first is kept."""
    columns: dict[tuple[int, str], SignalColumn] = {}
    for index, name in enumerate(declared):
        signal = find_signal(name, system=system, version=version, declared=declared)
        if signal is None:
            continue
        kind = [*KINDS].index("C" if version < 3.0 and name[0] == "P" else name[0])
        divisor = scale.get((system, name), 1.0)
        columns.setdefault((kind, signal), SignalColumn(index, name, kind, signal, divisor))
    return tuple(columns.values())
