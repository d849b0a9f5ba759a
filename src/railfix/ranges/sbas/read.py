"""SBAS message files: read, checked, accounted for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import Final

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Bytes, Integers, Masks
from railfix.core.errors import InputFileError
from railfix.core.files import BrokenLines, read_text_lines
from railfix.core.timescale import GPS_EPOCH
from railfix.ranges.sbas.lines import RawMessage, kind_of_file, parse
from railfix.ranges.sbas.log import SbasLog
from railfix.ranges.sbas.parity import ROW_BYTES, carried_parity, message_parity, preamble_number

FilePath = str | PathLike[str]

#: Digits of a message cut after its data: 226 bits, and 6 of the parity or nothing.
_SHORT: Final = 58


@dataclass
class _Gathered:
    """Messages of all files while they are read."""

    raw: list[RawMessage] = field(default_factory=list)
    source: list[int] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)


def read_sbas(paths: FilePath | Sequence[FilePath], *, broken_lines: BrokenLines = "stop") -> SbasLog:
    """SBAS messages of one or several files.

    Parameters
    ----------
    paths : path or sequence of paths
        RTKLIB (.sbs), EGNOS message server (.ems) or RINEX broadcast data (type B), told by their
        content; plain, gzip or compress.
    broken_lines : {"stop", "count"}
        A line that is no message stops the reading, or is counted under "line" in `refused` and
        named in `notes`. A message whose parity or preamble is wrong was damaged on its way: it is
        left out and counted in either case.

    Returns
    -------
    SbasLog
        In the order of reception. Times of RTKLIB and EMS files are taken as the ends of the
        messages, those of RINEX, which are of the first bit, become so by adding 1 s.

    Raises
    ------
    InputFileError
        A file is missing or of another kind, (strict) a line is broken, or no message is left.
    """
    files = [paths] if isinstance(paths, (str, PathLike)) else list(paths)
    if not files:
        raise ValueError("at least one SBAS file is needed")
    gathered = _Gathered()
    for number, path in enumerate(files):
        _read_file(str(path), number, broken_lines, gathered)
    sources = tuple(str(path) for path in files)
    if not gathered.raw:
        raise InputFileError(", ".join(sources), "holds no SBAS message that can be read")
    log = _checked(gathered, sources)
    if not len(log):
        counts = ", ".join(f"{number} by {reason}" for reason, number in sorted(log.refused.items()))
        raise InputFileError(", ".join(sources), f"has no SBAS message left: refused {counts}")
    return log


def _read_file(path: str, number: int, broken_lines: str, gathered: _Gathered) -> None:
    lines = read_text_lines(path)
    broken = 0
    for item in parse(path, kind_of_file(path, lines), lines):
        if isinstance(item, RawMessage):
            gathered.raw.append(item)
            gathered.source.append(number)
        elif broken_lines == "stop":
            raise item
        else:
            broken += 1
            if broken == 1:
                gathered.notes.append(f"{item}; passed over")
    if broken > 1:
        gathered.notes.append(f"{path}: {broken} lines were passed over")
    gathered.refused["line"] += broken


def _checked(gathered: _Gathered, sources: tuple[str, ...]) -> SbasLog:
    """Parity, preamble and order."""
    raw = gathered.raw
    text = "".join(item.digits.ljust(2 * ROW_BYTES, "0")[: 2 * ROW_BYTES] for item in raw)
    bits = np.frombuffer(bytes.fromhex(text), dtype=np.uint8).reshape(-1, ROW_BYTES).copy()
    bits[:, 31] &= 0xC0
    source = np.array(gathered.source, dtype=np.int64)
    carried = _carried_bits(np.array([len(item.digits) for item in raw]), source, bits)
    wrong = _wrong_parity(bits, carried)
    preamble = preamble_number(bits)
    stray = (preamble < 0) & ~wrong
    gathered.refused["parity"] += int(wrong.sum())
    gathered.refused["preamble"] += int(stray.sum())
    since = np.array([item.time_ns for item in raw], dtype=np.int64).astype("timedelta64[ns]")
    log = SbasLog(
        time=np.asarray(GPS_EPOCH + since, dtype="datetime64[ns]"),
        prn=np.array([item.prn for item in raw], dtype=np.int64),
        type=(bits[:, 1] >> 2).astype(np.int64),
        bits=bits,
        parity_bits=carried,
        source=source,
        line=np.array([item.line for item in raw], dtype=np.int64),
        sources=sources,
    )
    kept = log.take(~(wrong | stray))
    kept = kept.take(np.lexsort((kept.prn, kept.time)))
    again = np.zeros(len(kept), dtype=bool)
    again[1:] = (kept.time[1:] == kept.time[:-1]) & (kept.prn[1:] == kept.prn[:-1])
    gathered.refused["duplicate"] += int(again.sum())
    kept = kept.take(~again)
    notes = [*gathered.notes, *_parity_notes(sources, source, carried), *_order_notes(kept)]
    return replace(kept, refused=dict(gathered.refused), notes=tuple(notes))


def _carried_bits(digits: NDArray[np.int_], source: Integers, bits: Bytes) -> Integers:
    """Bits of parity that each message carries: 24 in whole messages, in cut ones 6 or none.

    A cut message ends with 6 bits that some programs fill with zero (RTKLIB) and some leave as
    they came: in a file of the latter most of them are the first of the parity, by chance 1 in 64.
    """
    carried = np.full(len(digits), 24, dtype=np.int64)
    short = digits == _SHORT
    for number in np.unique(source[short]):
        of_file = short & (source == number)
        first_six = message_parity(bits[of_file]) >> 18
        carried[of_file] = 6 if (first_six == bits[of_file, 28] & 0x3F).mean() > 0.5 else 0
    return carried


def _wrong_parity(bits: Bytes, carried: Integers) -> Masks:
    shift = 24 - carried
    return np.asarray((message_parity(bits) >> shift) != (carried_parity(bits) >> shift))


def _parity_notes(sources: tuple[str, ...], source: Integers, carried: Integers) -> list[str]:
    notes = []
    for number, path in enumerate(sources):
        of_file = carried[source == number]
        for count, words in ((0, "no parity"), (6, "6 of 24 bits of parity")):
            messages = int((of_file == count).sum())
            if messages:
                notes.append(
                    f"{path}: {messages} messages carry {words}; "
                    + ("errors of reception cannot be seen" if count == 0 else "1 damaged message in 64 passes")
                )
    return notes


def _order_notes(log: SbasLog) -> list[str]:
    """Preambles follow each other second by second; where they do not, a time tag is wrong."""
    notes = []
    second = log.time.astype("datetime64[s]").astype(np.int64)
    number = preamble_number(log.bits)
    for prn in log.prns:
        of_prn = log.prn == prn
        phase = (number[of_prn] - second[of_prn]) % 3
        counts = np.bincount(phase, minlength=3)
        if counts.max() < counts.sum():
            notes.append(
                f"PRN {prn}: the preambles of {int(counts.sum() - counts.max())} of {int(counts.sum())} messages are "
                "out of turn with their seconds"
            )
    return notes
