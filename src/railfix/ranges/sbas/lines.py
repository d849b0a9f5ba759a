"""Lines of SBAS files: RTKLIB, EGNOS message server (EMS), RINEX broadcast data (type B)."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.errors import InputFileError
from railfix.core.timescale import GPS_EPOCH, SECONDS_PER_WEEK
from railfix.ranges.sbas.names import GEO_PRNS

_RTKLIB: Final = re.compile(r"(\d+)\s+(\d+(?:\.\d*)?)\s+(\d+)\s+(\d+)\s*:\s*([0-9A-Fa-f]+)")
_EMS: Final = re.compile(r"(\d+)((?:\s+\d+){5})\s+(\d+(?:\.\d*)?)\s+(\d+)\s+([0-9A-Fa-f]+)")
_RINEX_HEAD: Final = re.compile(r"(\d{1,3})((?:\s+\d+){5})\s+(\d+(?:\.\d*)?)(?:\s+([A-Z]\d)\s+(\d+)\b.*)?")
_RINEX_BYTES: Final = 18
#: Seconds from the first bit, to which RINEX type B refers, to the reception of the whole message.
_RINEX_SHIFT_S: Final = 1.0


@dataclass(frozen=True)
class RawMessage:
    """One message as written: nanoseconds since 1980-01-06 in GPS time, PRN, type (-1 unsaid), hexadecimal digits."""

    line: int
    time_ns: int
    prn: int
    kind: int
    digits: str


def kind_of_file(path: str, lines: Sequence[str]) -> str:
    """Format, told by the first line that says anything: "rtklib", "ems" or "rinex".

    Raises
    ------
    InputFileError
        None of them.
    """
    for number, text in enumerate(lines, start=1):
        line = text.strip()
        if not line or line[0] in "#%":
            continue
        if text[60:80].startswith("RINEX VERSION / TYPE"):
            if text[20:21] == "B":
                return "rinex"
            raise InputFileError(
                path, f"is RINEX of type {text[20:21]!r}, type B (broadcast data) was expected", line=1
            )
        if _RTKLIB.fullmatch(line):
            return "rtklib"
        if _EMS.fullmatch(line):
            return "ems"
        raise InputFileError(
            path,
            f"{line[:40]!r} begins no SBAS file; '1481 108093 129 26 : 5369C4...' (RTKLIB), "
            "'120 08 05 26 06 01 33 26 5369C4...' (EMS) or a RINEX header of type B was expected",
            line=number,
        )
    raise InputFileError(path, "holds no SBAS message")


def parse(path: str, kind: str, lines: Sequence[str]) -> Iterator[RawMessage | InputFileError]:
    """Every message of a file in its order; a broken one as the error that describes it."""
    if kind == "rinex":
        yield from _parse_rinex(path, lines)
        return
    for number, text in enumerate(lines, start=1):
        line = text.strip()
        if line and line[0] not in "#%":
            yield (_rtklib if kind == "rtklib" else _ems)(path, number, line)


def _rtklib(path: str, number: int, line: str) -> RawMessage | InputFileError:
    found = _RTKLIB.fullmatch(line)
    if found is None:
        return InputFileError(path, f"{line[:40]!r} is no 'week tow prn type : hexadecimal message'", line=number)
    week, tow, prn, kind, digits = found.groups()
    seconds = float(tow)
    if not (0 < int(week) < 10_000 and 0.0 <= seconds < SECONDS_PER_WEEK):
        return InputFileError(path, f"week {week}, time of week {tow} is no GPS time", line=number)
    time = int(week) * SECONDS_PER_WEEK * 10**9 + round(seconds * 1e9)
    return _checked(path, RawMessage(number, time, int(prn), int(kind), digits))


def _ems(path: str, number: int, line: str) -> RawMessage | InputFileError:
    found = _EMS.fullmatch(line)
    if found is None:
        return InputFileError(
            path, f"{line[:40]!r} is no 'prn yy mm dd hh mm ss type hexadecimal message'", line=number
        )
    prn, date, second, kind, digits = found.groups()
    try:
        time = _instant(date, second)
    except ValueError:
        return InputFileError(path, f"{date.strip()} {second} is no date and time", line=number)
    return _checked(path, RawMessage(number, time, int(prn), int(kind), digits))


def _parse_rinex(path: str, lines: Sequence[str]) -> Iterator[RawMessage | InputFileError]:
    """Records of RINEX type B: PRN and epoch, then lines of up to 18 bytes, the type before the first."""
    end = next((i for i, text in enumerate(lines) if text[60:].startswith("END OF HEADER")), None)
    if end is None:
        raise InputFileError(path, "the header has no END OF HEADER; the file is cut, give the whole one")
    rest = [(i, text) for i, text in enumerate(lines[end + 1 :], start=end + 2) if text.strip()]
    at = 0
    while at < len(rest):
        number, text = rest[at]
        at += 1
        found = _RINEX_HEAD.fullmatch(text.strip())
        if found is None:
            yield InputFileError(path, f"{text.strip()[:40]!r} is no 'prn yy mm dd hh mm ss'", line=number)
            while at < len(rest) and _RINEX_HEAD.fullmatch(rest[at][1].strip()) is None:
                at += 1
            continue
        prn, date, second, band, length = found.groups()
        count = int(length or 32)
        body = rest[at : at + -(-count // _RINEX_BYTES)]
        digits = "".join("".join(row[7:].split()) for _, row in body)[: 2 * count]
        head = body[0][1][:7].strip() if body else ""
        if len(digits) != 2 * count or not re.fullmatch(r"[0-9A-Fa-f]+", digits) or not re.fullmatch(r"\d*", head):
            yield InputFileError(path, f"the record has no {count} bytes of two hexadecimal digits", line=number)
            while at < len(rest) and _RINEX_HEAD.fullmatch(rest[at][1].strip()) is None:
                at += 1
            continue
        at += len(body)
        if band not in (None, "L1"):
            yield InputFileError(path, f"the message is of band {band}, L1 was expected", line=number)
            continue
        try:
            time = _instant(date, second) + round(_RINEX_SHIFT_S * 1e9)
        except ValueError:
            yield InputFileError(path, f"{date.strip()} {second} is no date and time", line=number)
            continue
        # Before 2004 the satellite number was the PRN less 100.
        whole = int(prn) + (100 if int(prn) < 100 else 0)
        yield _checked(path, RawMessage(number, time, whole, int(head or -1), digits))


def _checked(path: str, raw: RawMessage) -> RawMessage | InputFileError:
    if raw.prn not in GEO_PRNS:
        return InputFileError(
            path, f"PRN {raw.prn} sends no SBAS; 120 to 158 or 183 to 202 was expected", line=raw.line
        )
    if len(raw.digits) == 250 and set(raw.digits) <= {"0", "1"}:
        digits = f"{int(raw.digits, 2) << 6:064X}"
        return RawMessage(raw.line, raw.time_ns, raw.prn, raw.kind, digits)
    if len(raw.digits) not in (58, 63, 64):
        what = (
            f"the message has {len(raw.digits)} hexadecimal digits, 58 (226 bits) or 63 or 64 (250 bits) were expected"
        )
        return InputFileError(path, what, line=raw.line)
    kind = (int(raw.digits[2:4], 16) >> 2) & 0x3F
    if raw.kind not in (-1, kind):
        return InputFileError(path, f"type {raw.kind} is written, the message says {kind}", line=raw.line)
    return raw


def _instant(date: str, second: str) -> int:
    """Nanoseconds since the GPS epoch of a calendar time in GPS time."""
    year, month, day, hour, minute = (int(part) for part in date.split())
    year += 0 if year >= 100 else 1900 if year >= 80 else 2000
    value = float(second)
    if not 0.0 <= value <= 60.0:
        raise ValueError(second)
    start = np.datetime64(f"{year:04d}-{month:02d}-{day:02d}T{hour:02d}:{minute:02d}", "ns")
    return int((start - GPS_EPOCH).astype(np.int64)) + round(value * 1e9)
