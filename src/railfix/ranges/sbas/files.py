"""Files of SBAS messages: RTKLIB, EGNOS message server (EMS), RINEX broadcast data (type B)."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Bytes, Integers
from railfix.core.errors import InputFileError
from railfix.core.files import BrokenLines, FilePath, path_names, read_text_lines
from railfix.core.timescale import GPS_EPOCH, SECONDS_PER_WEEK
from railfix.io.file_kind import find_kind, wrong_kind
from railfix.io.receiver.framing import SbasFrames
from railfix.io.receiver.log import scan_pieces
from railfix.ranges.sbas.messages import (
    PREAMBLES,
    ROW_BYTES,
    Band,
    SbasMessages,
    carried_parity,
    message_parity,
    message_type,
    preamble_number,
)
from railfix.ranges.sbas.standard import GEO_PRNS

_RTKLIB: Final = re.compile(r"(\d+)\s+(\d+(?:\.\d*)?)\s+(\d+)\s+(\d+)\s*:\s*([0-9A-Fa-f]+)")
_EMS: Final = re.compile(r"(\d+)((?:\s+\d+){5})\s+(\d+(?:\.\d*)?)\s+(\d+)\s+([0-9A-Fa-f]+)")
_RINEX_HEAD: Final = re.compile(r"(\d{1,3})((?:\s+\d+){5})\s+(\d+(?:\.\d*)?)(?:\s+([A-Z]\d)\s+(\d+)\b.*)?")
_RINEX_BYTES: Final = 18
#: RINEX type B states the time of a message's first bit; the message is complete this time later [s].
_RINEX_SHIFT_S: Final = 1.0


@dataclass(frozen=True)
class RawMessage:
    """Message as read from a file; `time_ns` is GPS time since 1980-01-06, `kind` the message type (-1 if absent)."""

    line: int
    time_ns: int
    prn: int
    kind: int
    digits: str


def kind_of_file(path: str, lines: Sequence[str]) -> str:
    """Return the format, "rtklib", "ems" or "rinex", from the first line that is neither empty nor a comment.

    Raises InputFileError for any other format.
    """
    for number, text in enumerate(lines, start=1):
        line = text.strip()
        if not line or line[0] in "#%":
            continue
        if text[60:80].startswith("RINEX VERSION / TYPE"):
            if text[20:21] == "B":
                return "rinex"
            raise wrong_kind(path, "a log of SBAS messages, or RINEX of type B,")
        if _RTKLIB.fullmatch(line):
            return "rtklib"
        if _EMS.fullmatch(line):
            return "ems"
        raise InputFileError(
            path,
            f"{line[:40]!r} is not the first line of an SBAS file; '1481 108093 129 26 : 5369C4...' (RTKLIB), "
            "'120 08 05 26 06 01 33 26 5369C4...' (EMS) or a RINEX header of type B was expected",
            line=number,
        )
    raise InputFileError(path, "contains no SBAS message")


def parse(path: str, kind: str, lines: Sequence[str], band: Band = "L1") -> Iterator[RawMessage | InputFileError]:
    """Yield the messages of a file in their order, and for a malformed message the error that describes it."""
    if kind == "rinex":
        yield from _parse_rinex(path, lines, band)
        return
    for number, text in enumerate(lines, start=1):
        line = text.strip()
        if line and line[0] not in "#%":
            yield (_rtklib if kind == "rtklib" else _ems)(path, number, line, band)


def _rtklib(path: str, number: int, line: str, band: Band) -> RawMessage | InputFileError:
    fields = _RTKLIB.fullmatch(line)
    if fields is None:
        return InputFileError(
            path, f"{line[:40]!r} is not of the form 'week tow prn type : hexadecimal message'", line=number
        )
    week, tow, prn, kind, digits = fields.groups()
    seconds = float(tow)
    if not (0 < int(week) < 10_000 and 0.0 <= seconds < SECONDS_PER_WEEK):
        return InputFileError(path, f"week {week}, time of week {tow} is not a GPS time", line=number)
    time = int(week) * SECONDS_PER_WEEK * 10**9 + round(seconds * 1e9)
    return _check_line(path, RawMessage(number, time, int(prn), int(kind), digits), band)


def _ems(path: str, number: int, line: str, band: Band) -> RawMessage | InputFileError:
    fields = _EMS.fullmatch(line)
    if fields is None:
        return InputFileError(
            path, f"{line[:40]!r} is not of the form 'prn yy mm dd hh mm ss type hexadecimal message'", line=number
        )
    prn, date, second, kind, digits = fields.groups()
    try:
        time = _instant(date, second)
    except ValueError:
        return InputFileError(path, f"{date.strip()} {second} is not a date and time", line=number)
    return _check_line(path, RawMessage(number, time, int(prn), int(kind), digits), band)


def _parse_rinex(path: str, lines: Sequence[str], band: Band) -> Iterator[RawMessage | InputFileError]:
    """Yield the messages of RINEX type B, or an error for each malformed record.

    A record has a line with PRN and epoch, then lines of up to 18 bytes; the first of these lines begins with the
    message type.
    """
    end = next((i for i, text in enumerate(lines) if text[60:].startswith("END OF HEADER")), None)
    if end is None:
        raise InputFileError(path, "the header has no END OF HEADER; the file is incomplete; give the complete file")
    rest = [(i, text) for i, text in enumerate(lines[end + 1 :], start=end + 2) if text.strip()]
    at, broken = 0, False  # after a malformed record or line, all lines up to the next record are skipped
    while at < len(rest):
        number, text = rest[at]
        at += 1
        fields = _RINEX_HEAD.fullmatch(text.strip())
        if fields is None:
            if not broken:
                yield InputFileError(
                    path, f"{text.strip()[:40]!r} is not of the form 'prn yy mm dd hh mm ss'", line=number
                )
            broken = True
            continue
        prn, date, second, sent_on, length = fields.groups()
        count = int(length or 32)
        body = rest[at : at + -(-count // _RINEX_BYTES)]
        digits = "".join("".join(row[7:].split()) for _, row in body)[: 2 * count]
        head = body[0][1][:7].strip() if body else ""
        broken = len(digits) != 2 * count or not (re.fullmatch(r"[0-9A-Fa-f]+", digits) and re.fullmatch(r"\d*", head))
        if broken:
            yield InputFileError(path, f"the record does not have {count} bytes of two hexadecimal digits", line=number)
            continue
        at += len(body)
        if sent_on not in (None, band):
            yield InputFileError(path, f"the message is of band {sent_on}, {band} was expected", line=number)
            continue
        try:
            time = _instant(date, second) + round(_RINEX_SHIFT_S * 1e9)
        except ValueError:
            yield InputFileError(path, f"{date.strip()} {second} is not a date and time", line=number)
            continue
        # Before 2004, the satellite number was the PRN minus 100.
        number_of_geo = int(prn) + (100 if int(prn) < 100 else 0)
        yield _check_line(path, RawMessage(number, time, number_of_geo, int(head or -1), digits), band)


def _check_line(path: str, raw: RawMessage, band: Band) -> RawMessage | InputFileError:
    if raw.prn not in GEO_PRNS:
        return InputFileError(
            path, f"PRN {raw.prn} is not an SBAS PRN; 120 to 158 or 183 to 202 was expected", line=raw.line
        )
    if len(raw.digits) == 250 and set(raw.digits) <= {"0", "1"}:
        digits = f"{int(raw.digits, 2) << 6:064X}"
        return RawMessage(raw.line, raw.time_ns, raw.prn, raw.kind, digits)
    if len(raw.digits) not in (58, 63, 64):
        what = f"the message has {len(raw.digits)} hexadecimal digits; expected 58 (226 bits), or 63 or 64 (250 bits)"
        return InputFileError(path, what, line=raw.line)
    kind = (int(raw.digits[:4], 16) >> (2 if band == "L1" else 6)) & 0x3F
    if raw.kind not in (-1, kind):
        return InputFileError(
            path,
            f"the stated message type is {raw.kind}, but the message on {band} has type {kind} (setting sbas_band)",
            line=raw.line,
        )
    return raw


def _instant(date: str, second: str) -> int:
    """Return a calendar time, given in GPS time, as nanoseconds since the GPS epoch."""
    year, month, day, hour, minute = (int(part) for part in date.split())
    year += 0 if year >= 100 else 1900 if year >= 80 else 2000
    value = float(second)
    if not 0.0 <= value <= 60.0:
        raise ValueError(second)
    start = np.datetime64(f"{year:04d}-{month:02d}-{day:02d}T{hour:02d}:{minute:02d}", "ns")
    return int((start - GPS_EPOCH).astype(np.int64)) + round(value * 1e9)


#: Number of hexadecimal digits of a truncated message: 226 data bits, then 6 bits of parity or zeros.
_SHORT: Final = 58


@dataclass
class _Gathered:
    """Messages collected from all files so far."""

    raw: list[RawMessage] = field(default_factory=list)
    source: list[int] = field(default_factory=list)
    rejected: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)


def read_sbas(
    paths: FilePath | Sequence[FilePath], *, broken_lines: BrokenLines = "stop", band: Band = "L1"
) -> SbasMessages:
    """Read SBAS messages from one or several files.

    Parameters
    ----------
    paths : path or sequence of paths
        RTKLIB (.sbs), EGNOS message server (.ems), RINEX broadcast data (type B) or a receiver's log (UBX with
        RXM-SFRBX of SBAS, SBF with GEORawL1 or GEORawL5), recognised by their content; plain, gzip or compress.
    broken_lines : {"stop", "count"}
        With "stop", a line that is not a message raises an error. With "count", the line is counted under "line" in
        `rejected` and named in `notes`. A message with a wrong parity or preamble is always left out and counted.

    band : {"L1", "L5"}
        Frequency of the messages; messages of other bands have different preambles and are left out.

    Returns
    -------
    SbasMessages
        Messages in the order of reception. Times in RTKLIB and EMS files are assumed to refer to the ends of the
        messages. Times in RINEX refer to the first bit and are increased by 1 s.

    Raises
    ------
    InputFileError
        A file is missing or of another kind, a line is not a message (with "stop"), or no valid message is left.
    """
    sources = tuple(path_names(paths))
    gathered = _Gathered()
    for number, path in enumerate(sources):
        _read_file(path, number, broken_lines, gathered, band)
    if not gathered.raw:
        raise InputFileError(
            ", ".join(sources), f"contains no SBAS message of {band} that can be read (setting sbas_band)"
        )
    log = _check(gathered, sources, band)
    if not len(log):
        counts = ", ".join(f"{number} by {reason}" for reason, number in sorted(log.rejected.items()))
        raise InputFileError(", ".join(sources), f"has no valid SBAS message of {band}; rejected: {counts}")
    return log


def from_receiver(frames: SbasFrames, *, source: str = "receiver", band: Band = "L1") -> SbasMessages:
    """Return SBAS messages forwarded by a receiver, with parity and preamble checked; `source` is named in notes.

    Messages without a time tag are left out and counted under "line".
    """
    gathered = _Gathered()
    _gather_frames(frames, 0, gathered, band)
    return _check(gathered, (source,), band) if gathered.raw else SbasMessages.none()


def _gather_frames(frames: SbasFrames, number: int, gathered: _Gathered, band: Band) -> None:
    dated, here = ~np.isnat(frames.time), frames.on_l5 == (band == "L5")
    gathered.rejected["line"] += int(np.count_nonzero(~dated & here))
    since = (frames.time - GPS_EPOCH).astype(np.int64)
    for row in np.flatnonzero(dated & here).tolist():
        digits = frames.octets[row].tobytes().hex().upper()[:63]
        gathered.raw.append(RawMessage(row + 1, int(since[row]), int(frames.prn[row]), -1, digits))
        gathered.source.append(number)


def _read_file(path: str, number: int, broken_lines: BrokenLines, gathered: _Gathered, band: Band) -> None:
    if find_kind(path) == "receiver":
        for piece in scan_pieces(path):
            _gather_frames(piece.sbas, number, gathered, band)
        return
    lines = read_text_lines(path)
    broken = 0
    for item in parse(path, kind_of_file(path, lines), lines, band):
        if isinstance(item, RawMessage):
            gathered.raw.append(item)
            gathered.source.append(number)
        elif broken_lines == "stop":
            raise item
        else:
            broken += 1
            if broken == 1:
                gathered.notes.append(f"{item}; skipped")
    if broken > 1:
        gathered.notes.append(f"{path}: {broken} lines were skipped")
    gathered.rejected["line"] += broken


def _check(gathered: _Gathered, sources: tuple[str, ...], band: Band) -> SbasMessages:
    """Check parity, preamble and order, and return the messages that are neither damaged nor repeated."""
    raw = gathered.raw
    text = "".join(item.digits.ljust(2 * ROW_BYTES, "0")[: 2 * ROW_BYTES] for item in raw)
    bits = np.frombuffer(bytes.fromhex(text), dtype=np.uint8).reshape(-1, ROW_BYTES).copy()
    bits[:, 31] &= 0xC0
    source = np.array(gathered.source, dtype=np.int64)
    carried = _read_bits(np.array([len(item.digits) for item in raw]), source, bits)
    shift = 24 - carried
    wrong = (message_parity(bits) >> shift) != (carried_parity(bits) >> shift)
    preamble = preamble_number(bits, band)
    stray = (preamble < 0) & ~wrong
    gathered.rejected["parity"] += int(wrong.sum())
    gathered.rejected["preamble"] += int(stray.sum())
    since = np.array([item.time_ns for item in raw], dtype=np.int64).astype("timedelta64[ns]")
    log = SbasMessages(
        time=np.asarray(GPS_EPOCH + since, dtype="datetime64[ns]"),
        prn=np.array([item.prn for item in raw], dtype=np.int64),
        type=message_type(bits, band),
        bits=bits,
        parity_bits=carried,
        source=source,
        line=np.array([item.line for item in raw], dtype=np.int64),
        sources=sources,
        band=band,
    )
    kept = log.take(~(wrong | stray))
    kept = kept.take(np.lexsort((kept.prn, kept.time)))
    repeated = np.zeros(len(kept), dtype=bool)
    repeated[1:] = (kept.time[1:] == kept.time[:-1]) & (kept.prn[1:] == kept.prn[:-1])
    repeated |= kept.repeated()
    gathered.rejected["duplicate"] += int(repeated.sum())
    kept = kept.take(~repeated)
    notes = [*gathered.notes, *_parity_notes(sources, source, carried), *_order_notes(kept)]
    return replace(kept, rejected=dict(gathered.rejected), notes=tuple(notes))


def _read_bits(digits: NDArray[np.int_], source: Integers, bits: Bytes) -> Integers:
    """Return the number of parity bits of each message: 24 in complete messages, 6 or 0 in truncated messages.

    A truncated message ends with 6 bits that RTKLIB sets to zero and other programs keep as received. In files of other
    programs, these bits equal the first bits of the parity in most messages; by chance alone, they would be equal in
    only 1 of 64 messages.
    """
    carried = np.full(len(digits), 24, dtype=np.int64)
    short = digits == _SHORT
    for number in np.unique(source[short]):
        of_file = short & (source == number)
        first_six = message_parity(bits[of_file]) >> 18
        carried[of_file] = 6 if (first_six == bits[of_file, 28] & 0x3F).mean() > 0.5 else 0
    return carried


def _parity_notes(sources: tuple[str, ...], source: Integers, carried: Integers) -> list[str]:
    notes = []
    for number, path in enumerate(sources):
        of_file = carried[source == number]
        for count, words in ((0, "no parity"), (6, "6 of 24 bits of parity")):
            messages = int((of_file == count).sum())
            if messages:
                notes.append(
                    f"{path}: {messages} messages have {words}; "
                    + (
                        "reception errors cannot be detected"
                        if count == 0
                        else "1 of 64 damaged messages is not detected"
                    )
                )
    return notes


def _order_notes(log: SbasMessages) -> list[str]:
    """Return notes on messages whose preamble does not match the second of reception, a sign of wrong time tags."""
    notes = []
    second = log.time.astype("datetime64[s]").astype(np.int64)
    number, turn = preamble_number(log.bits, log.band), len(PREAMBLES[log.band])
    for prn in log.prns:
        of_prn = log.prn == prn
        phase = (number[of_prn] - second[of_prn]) % turn
        counts = np.bincount(phase, minlength=turn)
        if counts.max() < counts.sum():
            notes.append(
                f"PRN {prn}: the preambles of {int(counts.sum() - counts.max())} of {int(counts.sum())} messages do "
                "not match the second of reception"
            )
    return notes
