"""Sort the epochs of a receiver by time, merge epochs with equal time tags, and reject epochs with wrong time tags."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Final, TypeAlias

import numpy as np

from railfix.core.arrays import Datetimes, Indices, Integers, Masks
from railfix.core.errors import InputFileError
from railfix.core.files import LENIENT, BrokenLines
from railfix.core.notebook import plural
from railfix.gnss.joined_observations import first_problems, stack_parts
from railfix.gnss.observations import Observations

DUPLICATES: Final = "duplicate epochs"
OUT_OF_ORDER: Final = "epochs out of order"
#: An epoch is rejected if more than this number of epochs earlier in the file have later time tags, or more than this
#: number of epochs further down in the file have earlier time tags.
MOST_PASSED: Final = 20
_HELD: Final = 2 * MOST_PASSED  #: Number of last epochs that are held back until later epochs are read.
#: An epoch is rejected if its time tag is more than this before, or more than this after, both neighbouring tags.
_LONE: Final = np.timedelta64(3600, "s")
_ARRAYS: Final = ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock")


#: Consecutive epochs of a file: the path of the file, the epochs in file order, and the line number of each epoch,
#: shape (T,). Line numbers are 0 for binary files.
FileEpochs: TypeAlias = tuple[str, Observations, Integers]


class EpochOrder:
    """Sorter of the epochs of one log. The sorted epochs are the same however the log is divided into parts."""

    def __init__(self, broken_lines: BrokenLines) -> None:
        self._broken_lines = broken_lines
        self._times: list[Datetimes] = []  # times of all epochs returned so far
        self._counts = {DUPLICATES: 0, "sorted": 0}
        self._first: dict[str, tuple[str, int]] = {}
        self._found: list[str] = []
        self._rejected = 0
        self._break = False

    def ordered(self, runs: Iterable[FileEpochs]) -> Iterator[Observations]:
        """Yield the epochs in parts, in order of time. The last part contains only the notes and counts, no epochs.

        Raise InputFileError if a time tag is wrong and `broken_lines` is "stop".
        """
        waiting: list[FileEpochs] = []  # epochs held back, because epochs later in the file may precede them in time
        for run in runs:
            waiting.append(run)
            if self._rise(epochs.time for _, epochs, _ in waiting):
                while sum(len(epochs) for _, epochs, _ in waiting[1:]) >= _HELD:
                    yield self._hand_on(waiting.pop(0)[1])
            else:
                ready, waiting = self._sort(waiting, final=False)
                yield ready
        if self._rise(epochs.time for _, epochs, _ in waiting):
            yield from (self._hand_on(epochs) for _, epochs, _ in waiting)
        else:
            yield self._sort(waiting, final=True)[0]
        yield self._summary()

    def _rise(self, times: Iterable[Datetimes]) -> bool:
        """Return whether the times of all parts increase strictly, and are later than the last epoch returned."""
        time = np.concatenate([*(time[-1:] for time in self._times[-1:]), *times, np.empty(0, "datetime64[ns]")])
        return bool((np.diff(time) > np.timedelta64(0, "ns")).all())

    def _hand_on(self, part: Observations) -> Observations:
        if not len(part):
            return part
        self._times.append(part.time)
        if self._break:
            before = part.break_before.copy()
            before[0] = True
            part = replace(part, break_before=before)
        self._break = False
        return part

    def _sort(self, runs: Sequence[FileEpochs], *, final: bool) -> tuple[Observations, list[FileEpochs]]:
        """Sort and check the waiting epochs.

        Return the epochs that no epoch further down in the file can precede in time, and a list of the other epochs,
        which must wait, one element per epoch.
        """
        paths, epochs, lines = zip(*runs, strict=True)
        joined, line = stack_parts(list(epochs)), np.concatenate(lines)
        path = np.repeat(paths, [len(each) for each in epochs])
        time = joined.time
        decided = len(time) if final else max(len(time) - _HELD, 0)
        equal = self._handed_on(time)
        fresh = np.flatnonzero(~equal & ~_is_repeated(time))
        passed_by, passes = _passed(time[fresh])
        wrong = np.zeros(len(time), dtype=np.bool_)
        wrong[fresh] = (passed_by > MOST_PASSED) | (passes > MOST_PASSED) | (time[fresh] <= self._last)
        wrong |= ~equal & _is_lone(time)
        wrong[decided:] = False
        self._reject(np.flatnonzero(wrong), time, path, line)
        self._count(DUPLICATES, np.flatnonzero(equal), path, line)
        kept = np.flatnonzero(~wrong & ~equal)
        sorted_rows = np.zeros(len(time), dtype=np.bool_)
        sorted_rows[kept] = _passed(time[kept])[0] > 0
        sorted_rows[decided:] = False
        first, rest = kept[kept < decided], kept[kept >= decided]
        order = first[np.argsort(time[first], kind="stable")]
        repeated = np.zeros(len(order), dtype=np.bool_)
        repeated[1:] = time[order[1:]] == time[order[:-1]]
        sorted_rows[order[repeated]] = False
        self._count(DUPLICATES, order[repeated], path, line)
        self._count("sorted", np.flatnonzero(sorted_rows), path, line)
        merged = _merge(joined, order, repeated)
        order = order[~repeated]
        ready = len(order) if final else max(len(order) - MOST_PASSED, 0)
        waiting = stack_parts([merged[ready:], take_epochs(joined, rest)])
        where = np.concatenate([order[ready:], rest])
        rest_of_runs = [(str(path[k]), waiting[i : i + 1], line[k : k + 1]) for i, k in enumerate(where)]
        return self._hand_on(replace(merged[:ready], **_carried(joined))), rest_of_runs

    @property
    def _last(self) -> np.datetime64:
        return self._times[-1][-1] if self._times else np.datetime64(np.iinfo(np.int64).min + 1, "ns")

    def _handed_on(self, time: Datetimes) -> Masks:
        """Return, for each time tag, whether an epoch with this tag has already been returned."""
        if not self._times:
            return np.zeros(len(time), dtype=np.bool_)
        self._times = [np.concatenate(self._times)]
        known = self._times[0]
        at = np.minimum(np.searchsorted(known, time), len(known) - 1)
        return np.asarray(known[at] == time)

    def _count(self, kind: str, rows: Indices, path: np.ndarray, line: Integers) -> None:
        self._counts[kind] += len(rows)
        if len(rows):
            name, number = self._first.setdefault(kind, (str(path[rows[0]]), int(line[rows[0]])))
            own = line[rows][path[rows] == name]
            self._first[kind] = (name, min(number, int(own.min(initial=number))))

    def _reject(self, rows: Indices, time: Datetimes, path: np.ndarray, line: Integers) -> None:
        for row in rows.tolist():
            what = f"the time tag {str(time[row])[:23]} is out of order by more than {MOST_PASSED} epochs or one hour"
            if self._broken_lines == "stop":
                raise InputFileError(str(path[row]), f"{what}; {LENIENT}", line=int(line[row]) or None)
            self._found.append(f"{_where(str(path[row]), int(line[row]))}: {what}; the epoch was skipped")
        self._rejected += len(rows)
        self._break |= len(rows) > 0

    def _summary(self) -> Observations:
        """Return observations without epochs, with the notes and counts of the whole log."""
        notes = []
        if number := self._counts["sorted"]:
            notes.append(f"{_where(*self._first['sorted'])}: {plural(number, 'epoch')} out of order, sorted by time")
        if number := self._counts[DUPLICATES]:
            notes.append(f"{_where(*self._first[DUPLICATES])}: {plural(number, 'epoch')} with a repeated time tag")
            notes[-1] += ", merged"
        counts = {DUPLICATES: self._counts[DUPLICATES], OUT_OF_ORDER: self._rejected}
        empty = np.zeros((0, 0))
        return Observations(
            time=np.zeros(0, dtype="datetime64[ns]"), satellite=np.zeros(0, dtype="<U3"),
            signal=np.zeros(0, dtype="<U2"), code_m=empty, phase_cycles=empty, doppler_hz=empty, cn0_dbhz=empty,
            loss_of_lock=np.zeros((0, 0), dtype=np.uint8), break_before=np.zeros(0, dtype=np.bool_),
            problems=(*notes, *first_problems(self._found, count=self._rejected)), problem_count=self._rejected,
            skipped={kind: number for kind, number in counts.items() if number},
        )  # fmt: skip


def take_epochs(observations: Observations, rows: Indices) -> Observations:
    """Return the epochs with the indices `rows`, in the order of `rows`; problems and counts are left out."""
    arrays = (*_ARRAYS, "time", "break_before", "receiver_alarm", "front_end_gain")
    values = {name: getattr(observations, name)[rows] for name in arrays}
    return replace(observations, **values, problems=(), problem_count=0, skipped={})


def _carried(joined: Observations) -> dict[str, Any]:
    return {"problems": joined.problems, "problem_count": joined.problem_count, "skipped": joined.skipped}


def _where(path: str, line: int) -> str:
    return f"{path}, line {line}" if line else path


def _passed(time: Datetimes) -> tuple[Integers, Integers]:
    """Return, for each epoch, how many preceding epochs have later tags, and how many following epochs have earlier
    tags.

    Only the nearest 2 * `MOST_PASSED` epochs on each side are compared.
    """
    reach = min(2 * MOST_PASSED, max(len(time) - 1, 0))
    passed_by, passes = np.zeros(len(time), dtype=np.int64), np.zeros(len(time), dtype=np.int64)
    for step in range(1, reach + 1):
        later = time[:-step] > time[step:]
        passed_by[step:] += later
        passes[:-step] += later
    return passed_by, passes


def _is_repeated(time: Datetimes) -> Masks:
    """Return, for each time tag, whether the same tag occurs earlier in the array."""
    repeated = np.ones(len(time), dtype=np.bool_)
    repeated[np.unique(time, return_index=True)[1]] = False
    return repeated


def _is_lone(time: Datetimes) -> Masks:
    """Return, for each time tag, whether it is more than `_LONE` before both neighbours or more than `_LONE` after
    both; False if the neighbours are not in ascending order.
    """
    lone = np.zeros(len(time), dtype=np.bool_)
    before, this, after = time[:-2], time[1:-1], time[2:]
    lone[1:-1] = (before < after) & ((this > after + _LONE) | (this < before - _LONE))
    return lone


def _merge(joined: Observations, order: Indices, repeated: Masks) -> Observations:
    """Return the epochs with indices `order`. Epochs with a repeated tag only add values that the first one lacks."""
    ordered = take_epochs(joined, order)
    if not repeated.any():
        return ordered
    first = np.flatnonzero(~repeated)
    owner = (np.cumsum(~repeated) - 1)[repeated]
    values = {name: getattr(ordered, name)[first].copy() for name in _ARRAYS}
    for name, target in values.items():
        source = getattr(ordered, name)[repeated]
        for k, row in enumerate(owner.tolist()):
            blank = target[row] == 0 if name == "loss_of_lock" else np.isnan(target[row])
            target[row] = np.where(blank, source[k], target[row])
    kept = take_epochs(ordered, first)
    return replace(kept, **values)
