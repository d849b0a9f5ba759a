"""Reader of RINEX 2, 3 and 4 observation files of one receiver.

With ``broken_lines="stop"``, a malformed line raises `InputFileError`. With "count", the part that the line makes
unreadable (a record, a satellite, an epoch or the rest of the file) is skipped, counted and described in
`Observations.problems`. A header error that affects how epochs are read is always raised.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, get_args

import numpy as np

from railfix.core.arrays import Masks
from railfix.core.errors import InputFileError, MismatchError
from railfix.core.files import LENIENT, BrokenLines, ByteStream, FilePath, Paths, open_stream, path_names
from railfix.core.timescale import bdt_to_gpst, gps_time, utc_to_gpst
from railfix.gnss.joined_observations import channels_with_data, concatenate
from railfix.gnss.observations import Observations
from railfix.io.epoch_order import EpochOrder, FileEpochs
from railfix.io.rinex.header import VERSION, RinexHeader, apply_records, parse_header, read_header_bytes
from railfix.io.rinex.observations_decode import PADDING, decode, lines_per_satellite
from railfix.io.rinex.observations_epochs import (
    CYCLE_SLIPS,
    EXTERNAL_EVENTS,
    FURTHER_HEADERS,
    FaultLog,
    find_epochs,
)
from railfix.io.rinex.observations_lines import SYSTEMS, EpochHeads, Lines, split_lines

#: Bytes of text that are decoded at a time: many lines for efficient array operations, but few for the cache.
BLOCK_BYTES: Final = 4 << 20
#: A file with a longer line is rejected [bytes]. Lines of zero bytes from a failing recorder are shorter.
_MAX_LINE_BYTES: Final = 8 << 20
_BLANKS: Final = b" " * PADDING
#: Functions that convert time systems to GPS time; times in other systems are taken as GPS time.
_TO_GPST: Final = {"GLO": utc_to_gpst, "UTC": utc_to_gpst, "BDT": bdt_to_gpst}
_BEFORE_ALL: Final = np.iinfo(np.int64).min


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Part of a log to read, and treatment of malformed lines."""

    broken_lines: BrokenLines = "stop"
    systems: frozenset[str] | None = None  #: Letters of the constellations to read; None means all.
    start_ns: int = _BEFORE_ALL  #: Epochs before this time are skipped, GPS time since 1970 [ns].
    end_ns: int = int(np.iinfo(np.int64).max)  #: Epochs at or after this time are skipped, GPS time since 1970 [ns].


class BlockReader:
    """Reader of one observation file in file order.

    `epochs` is the number of epochs read so far, `share` the fraction of the file read, and `last_ns` the median time
    of the last block [ns]. An incomplete record at the end of the file is skipped with a note.
    """

    def __init__(self, path: FilePath, selection: Selection, *, block_bytes: int = BLOCK_BYTES) -> None:
        self.path = str(path)
        self.last_ns = _BEFORE_ALL
        self.epochs = 0
        self.share = 0.0
        self._selection = selection
        self._block_bytes = block_bytes
        self._log = FaultLog(self.path, broken_lines=selection.broken_lines)
        self._break = False

    def blocks(self) -> Generator[FileEpochs]:
        """Yield runs of consecutive epochs in file order; a run may be empty."""
        with open_stream(self.path) as stream:
            head, rest = read_header_bytes(stream)
            header = parse_header(self.path, head, log=self._log)
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
                if at_end and len(lines):
                    self._log.last_line = int(lines.number[np.flatnonzero(lines.length)[-1:]].max(initial=0))
                used = 0
                while used < len(lines):
                    piece, header, taken = self._part(lines[used:], header, at_end=at_end)
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
                raise InputFileError(self.path, f"{error.message}; {LENIENT}") from None
            self._log.note(f"{error}; the data before this place were read")
            return b"", True
        return block, not block

    def _part(self, lines: Lines, header: RinexHeader, *, at_end: bool) -> tuple[FileEpochs, RinexHeader, int]:
        """Read the epochs up to the end of `lines`, or up to header records that change how epochs are read.

        Return the epochs, the header that applies after them, and the number of lines read.
        """
        trial = self._log.fresh()
        table, taken = self._find(lines, header, at_end=at_end, log=trial)
        after = header
        for k in np.flatnonzero((table.flag >= 2) & (table.flag <= 5)).tolist():
            if table.flag[k] == 5:
                self._log.count(EXTERNAL_EVENTS, 1)
                continue
            first, count = int(table.line[k]) + 1, int(table.count[k])
            after = self._event(lines[first : first + count], after)
            if after.reading != header.reading:
                taken = first + count  # only the lines before the change are decoded now
                trial = self._log.fresh()
                table, _ = self._find(lines[:taken], header, at_end=True, log=trial)
                break
        self._log.absorb(trial)
        return self._observations(lines, table, header), after, taken

    def _find(self, lines: Lines, header: RinexHeader, *, at_end: bool, log: FaultLog) -> tuple[EpochHeads, int]:
        each = lines_per_satellite(header)
        return find_epochs(lines, version=header.version, lines_per_satellite=each, at_end=at_end, log=log)

    def _event(self, lines: Lines, header: RinexHeader) -> RinexHeader:
        records = [lines.text(i) for i in range(len(lines))]
        number = int(lines.number[0]) if records else 0
        if records and records[0][60:80].strip() == VERSION:
            self._log.count(FURTHER_HEADERS, 1)
            further = parse_header(self.path, records, first_line=number, log=self._log)
            if (further.version < 3.0) != (header.version < 3.0):
                what = f"a header of RINEX {further.version:g} begins here, but the file has RINEX {header.version:g}"
                raise InputFileError(self.path, f"{what}; divide the file at this line", line=number)
            if further.reading != header.reading:
                self._log.remark(f"{self.path}, line {number}: another header begins here, for the epochs after it")
            return further
        return apply_records(self.path, header, records, first_line=number, log=self._log)

    def _observations(self, lines: Lines, table: EpochHeads, header: RinexHeader) -> FileEpochs:
        self._log.count(CYCLE_SLIPS, int((table.flag == 6).sum()))
        breaks = np.cumsum((table.flag >= 1) & (table.flag <= 3)) + int(self._break)
        seen = (table.flag == 0) | (table.flag == 1)
        epochs, breaks_at = table[seen], breaks[seen]
        time_ns = epochs.time_ns
        if header.time_system in _TO_GPST:
            time_ns = _TO_GPST[header.time_system](time_ns.astype("datetime64[ns]")).astype(np.int64)
        self.epochs += len(time_ns)
        if len(time_ns):
            self.last_ns = int(np.median(time_ns))  # median, because single time tags may be wrong
        kept = (time_ns >= self._selection.start_ns) & (time_ns < self._selection.end_ns)
        epochs, breaks_at, time_ns = epochs[kept], breaks_at[kept], time_ns[kept]
        before = np.diff(breaks_at, prepend=0) > 0
        total = int(breaks[-1]) if len(breaks) else int(self._break)
        self._break = total > (int(breaks_at[-1]) if len(breaks_at) else 0)
        dense = decode(lines, epochs, header=header, systems=self._selection.systems, log=self._log)
        self._log.settle()
        problems, problem_count, skipped = self._log.take()
        observations = Observations(
            time=time_ns.astype("datetime64[ns]"),
            **dense,
            break_before=before,
            header=header.public,
            problems=problems,
            problem_count=problem_count,
            skipped=skipped,
        )
        return self.path, observations, lines.number[epochs.line]


#: Default number of epochs in a piece of the observations.
DEFAULT_EPOCHS: Final = 3600
_PEEK_BYTES: Final = 1 << 16
_FIRST_PART: Final = 5  #: Ratio of the number of epochs in a piece to the number in the first piece.
_GAP_INTERVALS: Final = 1.5  #: A time between two files that exceeds this number of observation intervals is a gap.


def scan_observations(
    path: Paths,
    *,
    epochs: int = DEFAULT_EPOCHS,
    broken_lines: BrokenLines = "stop",
    systems: Iterable[str] | None = None,
    start: np.datetime64 | str | None = None,
    end: np.datetime64 | str | None = None,
    progress: Callable[[float], None] | None = None,
) -> Iterator[Observations]:
    """Return an iterator over the observations of one receiver in pieces of at most `epochs` epochs.

    Arguments that are not described here are as in `railfix.read_observations`. The first piece is shorter
    (`in_pieces`). Each piece has only the channels that occur in it. At any time, only one piece and one block of text
    are in memory. `progress` is called with the fraction of the files that has been read, 0 to 1.
    """
    if epochs < 1:
        raise ValueError(f"epochs is {epochs}; at least 1 was expected")
    if broken_lines not in get_args(BrokenLines):
        raise ValueError(f"broken_lines is '{broken_lines}', 'stop' or 'count' was expected")
    letters = None if systems is None else frozenset(systems)
    if letters is not None and (not letters or not letters <= set(SYSTEMS)):
        raise ValueError(f"systems is {sorted(letters)}, letters of {SYSTEMS} were expected")
    limits = {"start_ns": start, "end_ns": end}
    limits_ns = {name: int(gps_time(time).astype(np.int64)) for name, time in limits.items() if time is not None}
    selection = Selection(broken_lines=broken_lines, systems=letters, **limits_ns)
    return in_pieces(_runs(path_names(path), selection, progress), epochs)


def _runs(
    paths: list[str], selection: Selection, progress: Callable[[float], None] | None = None
) -> Iterator[Observations]:
    """Yield runs of epochs of all files in order of time.

    Raise InputFileError if no file has a usable epoch. Raise MismatchError if no epoch is selected, or if consecutive
    files begin more than a week apart.
    """
    firsts = [first_time(path) for path in paths] if len(paths) > 1 else []
    if firsts:
        check_one_run(paths, firsts)
        paths = [paths[k] for k in np.argsort(firsts, kind="stable")]
    readers = [BlockReader(path, selection) for path in paths]
    epochs = 0
    for run in EpochOrder(selection.broken_lines).ordered(_of_files(readers, selection, progress)):
        epochs += len(run)
        yield run
    if not epochs:
        last = readers[-1]
        if not any(reader.epochs for reader in readers):
            raise InputFileError(
                last.path, "has no usable epoch; read it with broken_lines='stop' (no --lenient) to see the first fault"
            )
        begin, end = first_time(paths[0]), np.datetime64(max(reader.last_ns for reader in readers), "ns")
        what = f"is from {str(begin)[:19]} to {str(end)[:19]}"
        if begin > end or last.last_ns >= selection.end_ns:
            what = f"begins at {str(begin)[:19]}"
        raise MismatchError(
            f"{', '.join(paths)}: no epoch lies in the time span from start to end; the log {what} (GPS time)"
        )


def _of_files(
    readers: list[BlockReader], selection: Selection, progress: Callable[[float], None] | None
) -> Iterator[FileEpochs]:
    """Yield the runs of consecutive files; `break_before` is set after a gap between two files."""
    last: Observations | None = None
    for k, reader in enumerate(readers):
        joint = last is not None
        for path, epochs, line in reader.blocks():
            if joint and len(epochs):
                epochs, joint = with_break_at_gap(last, epochs), False
            last = epochs if len(epochs) else last
            if progress is not None:
                progress((k + reader.share) / len(readers))
            yield path, epochs, line
        if not reader.epochs and (selection.broken_lines == "stop" or len(readers) == 1):
            raise InputFileError(reader.path, "has a header but no epochs; the recording is empty or cut short")


#: Files are not of one run if the first epochs of two consecutive files are further apart than this.
LONGEST_GAP: Final = np.timedelta64(7, "D")


def check_one_run(paths: Sequence[str], firsts: Sequence[np.datetime64]) -> None:
    """Raise MismatchError if the first epochs of consecutive files are more than a week apart."""
    order = np.argsort(np.array(firsts), kind="stable")
    for before, after in pairwise(order.tolist()):
        if firsts[after] - firsts[before] > LONGEST_GAP:
            days = (firsts[after] - firsts[before]) / np.timedelta64(1, "D")
            raise MismatchError(
                f"{paths[before]} begins at {str(firsts[before])[:19]} and {paths[after]} at {str(firsts[after])[:19]} "
                f"(GPS time), {days:,.0f} days apart; give the files of one run"
            )


def first_time(path: str) -> np.datetime64:
    """Return the time of the first epoch in a file, or NaT if the file has no epochs."""
    with closing(BlockReader(path, Selection(broken_lines="count"), block_bytes=_PEEK_BYTES).blocks()) as runs:
        return next((epochs.time[0] for _, epochs, _ in runs if len(epochs)), np.datetime64("NaT", "ns"))


def with_break_at_gap(last: Observations | None, run: Observations) -> Observations:
    """Return `run`, with `break_before` set at its first epoch if there is a gap of over 1.5 intervals after `last`."""
    if last is None:
        return run
    interval = run.header.interval_s
    if np.isnan(interval) and len(last) > 1:
        interval = float((last.time[-1] - last.time[-2]) / np.timedelta64(1, "s"))
    step = float((run.time[0] - last.time[-1]) / np.timedelta64(1, "s"))
    if step <= _GAP_INTERVALS * interval:
        return run
    before = run.break_before.copy()
    before[0] = True
    return replace(run, break_before=before)


def in_pieces(runs: Iterator[Observations], epochs: int) -> Iterator[Observations]:
    """Divide runs into pieces of `epochs` epochs. The first piece is a fifth as long, so that processing begins early.

    Each problem is reported in the piece that was being collected when the problem was found.
    """
    waiting: list[Observations] = []
    length, size = 0, -(-epochs // _FIRST_PART)
    for run in runs:
        waiting.append(run)
        length += len(run)
        if length <= size:
            continue
        joined, at = concatenate(waiting), 0
        while length > size:  # the last piece is held back, to report problems found at the file's end
            piece = without_empty_channels(joined[at : at + size])
            if at == 0:
                problems, count = joined.problems, joined.problem_count
                piece = replace(piece, problems=problems, problem_count=count, skipped=joined.skipped)
            yield piece
            at, length, size = at + size, length - size, epochs
        waiting = [without_empty_channels(joined[at:])]
    yield without_empty_channels(concatenate(waiting))


def without_empty_channels(observations: Observations) -> Observations:
    """Drop the channels that have no observation and no loss-of-lock digit."""
    arrays = ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz")
    used = channels_with_data([getattr(observations, name) for name in arrays], observations.loss_of_lock)
    return observations if used.all() else of_channels(observations, used)


def of_channels(observations: Observations, kept: Masks) -> Observations:
    """Return the observations of the channels `kept`, shape (M,)."""
    arrays = ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock")
    return replace(
        observations,
        satellite=observations.satellite[kept],
        signal=observations.signal[kept],
        **{name: getattr(observations, name)[:, kept] for name in arrays},
    )
