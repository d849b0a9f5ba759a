"""Reader of one observation file in blocks of text, each of which gives a run of epochs."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Integers, Masks
from railfix.core.errors import InputFileError
from railfix.core.files import BrokenLines, ByteStream, FilePath, open_stream
from railfix.core.timescale import bdt_to_gpst, utc_to_gpst
from railfix.gnss.observations import Observations
from railfix.io.rinex.header import RinexHeader, apply_records, parse_header, read_header_bytes
from railfix.io.rinex.observations_decode import PADDING, decode, lines_per_satellite
from railfix.io.rinex.observations_epochs import (
    CYCLE_SLIPS,
    DUPLICATES,
    EXTERNAL_EVENTS,
    EpochHeads,
    FaultLog,
    find_epochs,
)
from railfix.io.rinex.observations_lines import Lines, split_lines

#: Bytes of text read at a time: large enough for array operations, small enough for the processor's cache.
BLOCK_BYTES: Final = 4 << 20
#: A longer line is no RINEX, not even one that a failing recorder filled with zeros.
_MAX_LINE_BYTES: Final = 8 << 20
_BLANKS: Final = b" " * PADDING
_BEFORE_ALL: Final = np.iinfo(np.int64).min


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Selection of constellations and time span, and treatment of broken lines.

    `systems` are letters, None for all; time tags are from `start_ns` up to, not including, `end_ns`, since 1970 in GPS
    time.
    """

    broken_lines: BrokenLines = "stop"
    systems: frozenset[str] | None = None
    start_ns: int = _BEFORE_ALL
    end_ns: int = int(np.iinfo(np.int64).max)


class BlockReader:
    """Reader of one file from beginning to end.

    `after_ns`: time tags must be later than this one (of the file before).

    Attributes
    ----------
    last_ns : int
        Last time tag read, selected or not.
    epochs : int
        Number of epochs in order that were read, selected or not.
    share : float
        Fraction of the file that has been read, 0 to 1.
    """

    def __init__(
        self, path: FilePath, selection: Selection, *, after_ns: int = _BEFORE_ALL, block_bytes: int = BLOCK_BYTES
    ) -> None:
        self.path = str(path)
        self.last_ns = after_ns
        self.epochs = 0
        self.share = 0.0
        self._after_ns = after_ns
        self._selection = selection
        self._block_bytes = block_bytes
        self._log = FaultLog(self.path, broken_lines=selection.broken_lines)
        self._break = False

    def blocks(self) -> Generator[Observations]:
        """Yield runs of epochs in the order of the file; a run may be empty."""
        with open_stream(self.path) as stream:
            head, rest = read_header_bytes(stream)
            notes: list[str] | None = None if self._log.stops else []
            header = parse_header(self.path, head, notes=notes)
            for note in notes or ():
                self._log.note(note)
            number = len(head) + 1
            at_end = False
            while not at_end and self.last_ns < self._selection.end_ns:
                block, at_end = self._read(stream)
                last = b"\n" if at_end and not rest.endswith(b"\n") else b""
                text = b"".join((rest, block, last, _BLANKS))
                if len(text) - (text.rfind(b"\n") + 1) > _MAX_LINE_BYTES:
                    message = f"the line is longer than {_MAX_LINE_BYTES} characters; this is no RINEX file"
                    raise InputFileError(self.path, message, line=number + text.count(b"\n"))
                lines = split_lines(text, first_number=number, keep_blank=header.version < 3.0)
                used = 0
                while used < len(lines):
                    part = lines[used:]
                    piece, header, taken = self._part(part, header, at_end=at_end)
                    yield piece
                    used += taken
                    if not taken:
                        break
                stop = 0
                if used:
                    number, stop = int(lines.number[used - 1]) + 1, int(lines.stop[used - 1])
                rest = text[stop : -len(_BLANKS)]

    def _read(self, stream: ByteStream) -> tuple[bytes, bool]:
        try:
            block = stream.read(self._block_bytes)
            self.share = stream.share
        except InputFileError as error:
            if self._log.stops:
                raise
            self._log.note(f"{error}; the data before it were read")
            return b"", True
        return block, not block

    def _part(self, lines: Lines, header: RinexHeader, *, at_end: bool) -> tuple[Observations, RinexHeader, int]:
        """Read the epochs up to the end of the lines, or to a change of the observation types."""
        trial = self._log.fresh()
        table, taken = self._find(lines, header, at_end=at_end, log=trial)
        after = header
        for k in np.flatnonzero((table.flag >= 2) & (table.flag <= 5)).tolist():
            if table.flag[k] == 5:
                self._log.count(EXTERNAL_EVENTS, 1)
                continue
            first, count = int(table.line[k]) + 1, int(table.count[k])
            after = self._event(lines[first : first + count], after)
            if after.types != header.types or after.scale != header.scale:
                taken = first + count  # the lines after it have other types: decode those before it again
                trial = self._log.fresh()
                table, _ = self._find(lines[:taken], header, at_end=True, log=trial)
                break
        self._log.absorb(trial)
        piece = self._observations(lines, table, header)
        return piece, after, taken

    def _find(self, lines: Lines, header: RinexHeader, *, at_end: bool, log: FaultLog) -> tuple[EpochHeads, int]:
        each = lines_per_satellite(header)
        return find_epochs(lines, version=header.version, lines_per_satellite=each, at_end=at_end, log=log)

    def _event(self, lines: Lines, header: RinexHeader) -> RinexHeader:
        records = [lines.text(i) for i in range(len(lines))]
        notes: list[str] | None = None if self._log.stops else []
        number = int(lines.number[0]) if records else 0
        changed = apply_records(self.path, header, records, first_line=number, notes=notes)
        for note in notes or ():
            self._log.note(note)
        return changed

    def _observations(self, lines: Lines, table: EpochHeads, header: RinexHeader) -> Observations:
        self._log.count(CYCLE_SLIPS, int((table.flag == 6).sum()))
        breaks = np.cumsum((table.flag >= 1) & (table.flag <= 3)) + int(self._break)
        seen = (table.flag == 0) | (table.flag == 1)
        epochs, breaks_at = table[seen], breaks[seen]
        time_ns = _gps_time_ns(epochs.time_ns, header.time_system)
        kept = self._in_order(lines, epochs, time_ns)
        inside = (time_ns >= self._selection.start_ns) & (time_ns < self._selection.end_ns)
        kept &= inside
        epochs, breaks_at, time_ns = epochs[kept], breaks_at[kept], time_ns[kept]
        before = np.diff(breaks_at, prepend=0) > 0
        total = int(breaks[-1]) if len(breaks) else int(self._break)
        self._break = total > (int(breaks_at[-1]) if len(breaks_at) else 0)
        dense = decode(lines, epochs, header=header, systems=self._selection.systems, log=self._log)
        self._log.settle()
        problems, problem_count, skipped = self._log.take()
        return Observations(
            time=time_ns.astype("datetime64[ns]"),
            satellite=dense.satellite,
            signal=dense.signal,
            code_m=dense.kinds[0],
            phase_cycles=dense.kinds[1],
            doppler_hz=dense.kinds[2],
            cn0_dbhz=dense.kinds[3],
            loss_of_lock=dense.lock,
            break_before=before,
            header=header.public,
            problems=problems,
            problem_count=problem_count,
            skipped=skipped,
        )

    def _in_order(self, lines: Lines, epochs: EpochHeads, time_ns: Integers) -> Masks:
        """Flag the epochs whose time tags rise; of an outlier ahead of its successors only the outlier is dropped."""
        if not len(time_ns):
            return np.zeros(0, dtype=np.bool_)
        ahead = np.zeros(len(time_ns), dtype=np.bool_)
        if len(time_ns) > 2:
            before = np.concatenate([[self.last_ns], time_ns[:-3]])
            this, following, next_but_one = time_ns[:-2], time_ns[1:-1], time_ns[2:]
            rising = (before < following) & (following < next_but_one)
            ahead[:-2] = (this > next_but_one) & rising
        considered = np.where(ahead, _BEFORE_ALL, time_ns)
        highest = np.maximum.accumulate(np.concatenate([[self.last_ns], considered]))
        late = time_ns <= highest[:-1]
        wrong = late | ahead

        def message(i: int) -> str:
            k = int(np.flatnonzero(wrong)[i])
            tag = np.datetime64(int(time_ns[k]), "ns")
            if ahead[k]:
                return f"the time tag {tag} is later than those of the epochs after it"
            other = np.datetime64(int(highest[k]), "ns")
            where = " of the file before" if highest[k] == self._after_ns else ""
            return f"the time tag {tag} is not later than {other}{where}"

        self._log.faults(DUPLICATES, lines.number[epochs.line[wrong]], message)
        self.last_ns = int(highest[-1])
        self.epochs += int((~wrong).sum())
        return ~wrong


def _gps_time_ns(time_ns: Integers, time_system: str) -> Integers:
    time = time_ns.astype("datetime64[ns]")
    if time_system in ("GLO", "UTC"):
        return utc_to_gpst(time).astype(np.int64)
    if time_system == "BDT":
        return bdt_to_gpst(time).astype(np.int64)
    return time_ns
