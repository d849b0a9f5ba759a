"""Find the epochs in a block of lines, and record faults."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from railfix.core.arrays import Integers, Masks, join_rows
from railfix.core.errors import InputFileError
from railfix.core.files import LENIENT, BrokenLines
from railfix.gnss.joined_observations import MAX_PROBLEMS, first_problems
from railfix.io.rinex.observations_lines import EpochHeads, Lines, epoch_width, event_line, flaw_text, read_epoch_lines

EPOCHS = "broken epochs"
SATELLITES = "broken satellite lines"
RECORDS = "broken records"
UNKNOWN_SYSTEMS = "satellites of unknown constellations"
NOT_SELECTED = "satellites of constellations not selected"
EXTERNAL_EVENTS = "external events"
CYCLE_SLIPS = "cycle-slip records"
FURTHER_HEADERS = "further headers"
COMMENTS = "lines of comments among the epochs"

_CONSEQUENCE = {
    EPOCHS: "the epoch was skipped",
    SATELLITES: "the satellite was skipped in this epoch",
    RECORDS: "the record was skipped",
}


class FaultLog:
    """Faults of one file. With `broken_lines` "stop", `settle` raises the first fault as an error.

    A fault in the last line is only noted, because this line may be incomplete.
    """

    def __init__(self, path: str, *, broken_lines: BrokenLines) -> None:
        self.path = path
        self.stops = broken_lines == "stop"
        self.last_line = 0  #: Line number of the last line of the file; 0 until this line has been read.
        self.counts: dict[str, int] = {}
        self._messages: list[str] = []
        self._problems = 0
        self._first: tuple[int, str] | None = None

    def count(self, kind: str, number: int) -> None:
        """Count skipped items that are not faults."""
        if number:
            self.counts[kind] = self.counts.get(kind, 0) + number

    def fault(self, kind: str, line: int, message: str) -> None:
        """Record one fault at a 1-based line number."""
        message = "".join(c if c.isprintable() else "?" for c in message)
        self.count(kind, 1)
        self._problems += 1
        if self.stops and line != self.last_line:
            if self._first is None or line < self._first[0]:
                self._first = (line, message)
        elif len(self._messages) < MAX_PROBLEMS:
            self._messages.append(f"{self.path}, line {line}: {message}; {_CONSEQUENCE[kind]}")

    def faults(self, kind: str, lines: Integers, message: Callable[[int], str]) -> None:
        """Record faults of one kind at ascending line numbers. The first few are described by `message(i)`."""
        described = 1 if self.stops else MAX_PROBLEMS
        for i, line in enumerate(lines[:described].tolist()):
            self.fault(kind, line, message(i))
        rest = max(len(lines) - described, 0)
        self.count(kind, rest)
        self._problems += rest

    def note(self, message: str) -> None:
        """Count a malformed header record, and store `message`, which already names file and line."""
        self.count(RECORDS, 1)
        self.remark(message)

    def remark(self, message: str) -> None:
        """Store `message`, with file and line, about a format error that causes no loss of data."""
        self._problems += 1
        if len(self._messages) < MAX_PROBLEMS:
            self._messages.append(message)

    def fresh(self) -> FaultLog:
        """Return an empty log of the same file, for a trial whose faults may be discarded."""
        log = FaultLog(self.path, broken_lines="stop" if self.stops else "count")
        log.last_line = self.last_line
        return log

    def absorb(self, other: FaultLog) -> None:
        """Add the faults of another log of the same file."""
        for kind, number in other.counts.items():
            self.count(kind, number)
        self._problems += other._problems
        self._messages += other._messages[: MAX_PROBLEMS - len(self._messages)]
        if other._first is not None and (self._first is None or other._first < self._first):
            self._first = other._first

    def settle(self) -> None:
        """Raise the file's first fault as InputFileError if `broken_lines` is "stop"."""
        if self.stops and self._first is not None:
            raise InputFileError(self.path, f"{self._first[1]}; {LENIENT}", line=self._first[0])

    def take(self) -> tuple[tuple[str, ...], int, dict[str, int]]:
        """Return the messages, the number of faults and the counts that were added since the last call."""
        taken = (first_problems(self._messages, count=self._problems), self._problems, self.counts)
        self._messages, self._problems, self.counts = [], 0, {}
        return taken


#: Labels of header records. Lines with such a label occur among the epochs if files were concatenated or edited.
LABELS: Final = frozenset(
    (
        "COMMENT", "RINEX VERSION / TYPE", "END OF HEADER", "PGM / RUN BY / DATE", "MARKER NAME", "MARKER NUMBER",
        "MARKER TYPE", "OBSERVER / AGENCY", "REC # / TYPE / VERS", "ANT # / TYPE", "APPROX POSITION XYZ",
        "ANTENNA: DELTA H/E/N", "ANTENNA: DELTA X/Y/Z", "ANTENNA: PHASECENTER", "ANTENNA: B.SIGHT XYZ",
        "ANTENNA: ZERODIR AZI", "ANTENNA: ZERODIR XYZ", "CENTER OF MASS: XYZ", "DOI", "LICENSE OF USE",
        "STATION INFORMATION", "WAVELENGTH FACT L1/2", "# / TYPES OF OBSERV", "SYS / # / OBS TYPES",
        "SIGNAL STRENGTH UNIT", "INTERVAL", "TIME OF FIRST OBS", "TIME OF LAST OBS", "RCV CLOCK OFFS APPL",
        "SYS / DCBS APPLIED", "SYS / PCVS APPLIED", "SYS / SCALE FACTOR", "SYS / PHASE SHIFT", "SYS / PHASE SHIFTS",
        "GLONASS SLOT / FRQ #", "GLONASS COD/PHS/BIS", "GLONASS COD/PHS/BIS#", "LEAP SECONDS", "# OF SATELLITES",
        "PRN / # OF OBS",
    )
)  # fmt: skip
#: An epoch has fewer lines than this, because it has fewer than 1000 satellites.
_MAX_LINES = 1100 * 6
_CUT_EPOCH_LINE = "the file ends in the middle of an epoch line"


def find_epochs(
    lines: Lines, *, version: float, lines_per_satellite: int, at_end: bool, log: FaultLog
) -> tuple[EpochHeads, int]:
    """Return the complete epochs and events in a block, and the number of lines that were read.

    The last epoch, which may be incomplete, is left for the next block, except at the end of the file (`at_end`).
    """
    if version >= 3.0:
        return _find_marked(lines, version=version, at_end=at_end, log=log)
    return _find_unmarked(lines, lines_per_satellite=lines_per_satellite, at_end=at_end, log=log)


def _find_marked(lines: Lines, *, version: float, at_end: bool, log: FaultLog) -> tuple[EpochHeads, int]:
    """Find epochs of RINEX 3 and 4, whose epoch lines begin with ``>``."""
    n = len(lines)
    line = np.flatnonzero(lines.data[lines.start] == ord(">"))
    before = int(line[0]) if len(line) else n
    leading: list[tuple[int, int, int]] = []
    if before and len(line) and all(_is_record(lines, k) for k in range(before)):
        leading = [(-1, 4, before)]
    elif before and (at_end or len(line) or n > _MAX_LINES):
        log.fault(EPOCHS, int(lines.number[0]), _no_epoch(lines, 0, version))
    head = read_epoch_lines(lines, line, version=version)
    if not len(line):
        return head, (n if at_end or n > _MAX_LINES else 0)
    room = np.diff(line, append=n) - 1
    done = n
    waits = not at_end and not (len(line) == 1 and n > _MAX_LINES)
    if waits:
        done = int(line[-1])
        head, room = head[:-1], room[:-1]
    if at_end and len(head) and not room[-1] and lines.length[line[-1]] < epoch_width(version):
        log.fault(EPOCHS, int(lines.number[-1]), _CUT_EPOCH_LINE)
        head, room = head[:-1], room[:-1]
    line, broken = head.line, head.flaw != 0
    log.faults(
        EPOCHS,
        lines.number[line[broken]],
        lambda i: flaw_text(lines, int(line[broken][i]), int(head.flaw[broken][i]), version=version),
    )
    records = _records_after(lines, head, room, log)
    room = room - _counts(records, len(head))
    wrong = ~broken & (head.count != room)
    if at_end and len(line) and wrong[-1] and head.count[-1] > room[-1]:
        wrong[-1] = False
        broken[-1] = True
        log.fault(EPOCHS, int(lines.number[-1]), _truncate(int(head.count[-1]), int(room[-1]), lines, int(line[-1])))
    log.faults(
        EPOCHS,
        lines.number[line[wrong]],
        lambda i: f"the epoch declares {head.count[wrong][i]} lines, but {room[wrong][i]} follow before the next epoch",
    )
    return _with_events(head[~broken & ~wrong], [*leading, *records.values()]), done


def _records_after(lines: Lines, head: EpochHeads, room: Integers, log: FaultLog) -> dict[int, tuple[int, int, int]]:
    """Return, by epoch index, the header records that follow an epoch, joined to one event (line, flag, count)."""
    records: dict[int, tuple[int, int, int]] = {}
    for k in np.flatnonzero((head.flaw == 0) & (room > head.count)).tolist():
        first, end = int(head.line[k] + 1 + head.count[k]), int(head.line[k] + 1 + room[k])
        if all(_is_record(lines, line) for line in range(first, end)):
            records[k] = (first - 1, 4, end - first)
            log.count(COMMENTS, sum(_label(lines, line) == "COMMENT" for line in range(first, end)))
    return records


def _counts(records: dict[int, tuple[int, int, int]], epochs: int) -> Integers:
    """Return the number of header record lines after each epoch."""
    counts = np.zeros(epochs, dtype=np.int64)
    for k, (_, _, count) in records.items():
        counts[k] = count
    return counts


def _with_events(epochs: EpochHeads, events: list[tuple[int, int, int]]) -> EpochHeads:
    """Return epochs and events (line, flag, count) in file order."""
    if not events:
        return epochs
    joined = join_rows([epochs, EpochHeads(*np.array([(*event, 0, 0) for event in events], dtype=np.int64).T)])
    return joined[np.argsort(joined.line, kind="stable")]


def _label(lines: Lines, line: int) -> str:
    return lines.text(line)[60:80].strip()


def _is_record(lines: Lines, line: int) -> bool:
    """Return whether a line has the label of a header record."""
    return lines.length[line] > 60 and _label(lines, line) in LABELS


def _find_unmarked(lines: Lines, *, lines_per_satellite: int, at_end: bool, log: FaultLog) -> tuple[EpochHeads, int]:
    """Find RINEX 2 epochs by the decimal point of the seconds, because other lines have no point in this column."""
    n = len(lines)
    long = np.flatnonzero(lines.length >= epoch_width(2.0))
    likely = long[lines.data[lines.start[long] + 18] == ord(".")]
    head = read_epoch_lines(lines, likely, version=2.0)
    head = head[head.flaw == 0]
    line, event = head.line, (head.flag >= 2) & (head.flag <= 5)
    satellite_lines = np.maximum(-(-head.count // 12), 1) - 1 + head.count * lines_per_satellite
    following = line + 1 + np.where(event, head.count, satellite_lines)
    walk = _Walk(lines, following, event, head, log)
    stop = n
    if not at_end and len(line) and (line[-1] > 0 or n <= _MAX_LINES):
        stop = int(line[-1])
    elif not at_end and not len(line) and n <= _MAX_LINES:
        return head, 0
    return walk.run(stop, at_end=at_end)


class _Walk:
    """Walk through the lines of a RINEX 2 block. Consecutive epochs without lines between them are one step."""

    def __init__(self, lines: Lines, following: Integers, event: Masks, head: EpochHeads, log: FaultLog) -> None:
        self._lines, self._line, self._following, self._event = lines, head.line, following, event
        self._head, self._log = head, log
        self._bound = np.append(head.line[1:], len(lines))[: len(head)]
        self._breaks = np.flatnonzero(following != self._bound)
        self._kept = np.zeros(len(head), dtype=np.bool_)
        self._events: list[tuple[int, int, int]] = []

    def run(self, stop: int, *, at_end: bool) -> tuple[EpochHeads, int]:
        """Walk from line 0 to `stop`; return the epochs and events, and the number of lines that were read."""
        position = 0
        while position < stop:
            k = int(np.searchsorted(self._line, position))
            if k < len(self._line) and self._line[k] == position:
                reached = self._run_of_epochs(k, stop, at_end=at_end)
            else:
                reached = self._other(position, k, at_end=at_end)
            if reached == position:
                break
            position = reached
        return _with_events(self._head[self._kept], self._events), position

    def _run_of_epochs(self, k: int, stop: int, *, at_end: bool) -> int:
        """Keep the epochs from the k-th until one whose lines do not end where the next epoch line begins; return the
        line where the walk continues.
        """
        later = self._breaks[np.searchsorted(self._breaks, k) :]
        last = int(later[0]) if len(later) else len(self._line) - 1
        beyond = int(np.searchsorted(self._line, stop))
        if last >= beyond:
            self._kept[k:beyond] = True
            return stop
        self._kept[k:last] = True
        position, end, bound = int(self._line[last]), int(self._following[last]), int(self._bound[last])
        if end <= bound or (self._event[last] and end <= len(self._lines)):
            self._kept[last] = True
            return end
        if last + 1 == len(self._line):
            if not at_end:
                return position
            needed = end - position - 1
            message = _truncate(needed, len(self._lines) - position - 1, self._lines, position)
            self._log.fault(EPOCHS, int(self._lines.number[-1]), message)
            return len(self._lines)
        message = (
            f"the epoch of {self._head.count[last]} satellites needs {end - position - 1} lines, "
            f"but {bound - position - 1} follow before the next epoch"
        )
        self._log.fault(EPOCHS, int(self._lines.number[position]), message)
        return bound

    def _other(self, position: int, k: int, *, at_end: bool) -> int:
        """Process a line that is not an epoch line: a header record, an event without time, or a malformed line."""
        if _is_record(self._lines, position):
            return self._header_records(position, at_end=at_end)
        event = event_line(self._lines, position)
        if event is not None:
            end = position + 1 + event[1]
            if end <= len(self._lines):
                self._events.append((position, *event))
                return end
            if not at_end:
                return position
            message = _truncate(event[1], len(self._lines) - position - 1, self._lines, position)
            self._log.fault(EPOCHS, int(self._lines.number[-1]), message)
            return len(self._lines)
        rest = self._lines.length[position:]
        if at_end and k == len(self._line) and not rest.any():
            return len(self._lines)
        cut = at_end and len(rest) == 1 and rest[0] < epoch_width(2.0)
        message = _CUT_EPOCH_LINE if cut else _no_epoch(self._lines, position, 2.0)
        self._log.fault(EPOCHS, int(self._lines.number[position]), message)
        return int(self._line[k]) if k < len(self._line) else len(self._lines)

    def _header_records(self, position: int, *, at_end: bool) -> int:
        """Store header records between epochs as one event, and return the line at which the walk continues.

        Records at the end of the block are left for the next block, where more may follow.
        """
        end = position
        while end < len(self._lines) and _is_record(self._lines, end):
            end += 1
        if end == len(self._lines) and not at_end:
            return position
        self._events.append((position - 1, 4, end - position))
        comments = sum(_label(self._lines, line) == "COMMENT" for line in range(position, end))
        self._log.count(COMMENTS, comments)
        return end


def _no_epoch(lines: Lines, line: int, version: float) -> str:
    if version < 3.0 and lines.length[line] >= epoch_width(version):
        head = read_epoch_lines(lines, np.array([line]), version=version)
        if lines.data[lines.start[line] + 18] == ord(".") and head.flaw[0]:
            return flaw_text(lines, line, int(head.flaw[0]), version=version)
    return f"an epoch line was expected, found '{lines.text(line)[:40].rstrip()}'"


def _truncate(needed: int, found: int, lines: Lines, line: int) -> str:
    return (
        f"the file ends in the middle of an epoch: the epoch of line {lines.number[line]} needs {needed} lines, "
        f"but only {found} follow"
    )
