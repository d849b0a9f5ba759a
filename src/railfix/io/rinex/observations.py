"""Observation files of one receiver, RINEX 2, 3 and 4, as `Observations`.

A log is one file or several; several are put in order of their first epochs and joined. Reading in
pieces and reading at once run through the same code: the pieces concatenated are the log.

A broken line stops the reading with an `InputFileError` that names file and line
(``broken_lines="stop"``), or is skipped, counted and described in `Observations.problems`
(``broken_lines="count"``):

========================================================= =======================================
broken                                                    skipped with "count"
========================================================= =======================================
epoch line; number of lines that follow it                the epoch
time tag not after the one before, or ahead of all after  the epoch
last epoch incomplete; compressed data end early          the epoch; the rest of the file
satellite name; a field; a line too long; a satellite     the satellite in this epoch
twice, or of a constellation without announced types
header record that does not change how the file is read   the record
========================================================= =======================================

An error in the header that changes how the file is read is always raised.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from typing import Final, get_args

import numpy as np

from railfix.core.arrays import Masks
from railfix.core.errors import InputFileError, MismatchError
from railfix.core.files import BrokenLines, Paths, listed
from railfix.gnss.observations import Observations, channels_with_data, concatenate
from railfix.io.rinex.observations_blocks import BlockReader, Selection
from railfix.io.rinex.observations_lines import SYSTEMS

#: Default number of epochs of a piece.
DEFAULT_EPOCHS: Final = 3600
_PEEK_BYTES: Final = 1 << 16
#: A step between files is a gap when it is longer than this many intervals.
_GAP_INTERVALS: Final = 1.5


def read_observations(
    path: Paths,
    *,
    broken_lines: BrokenLines = "stop",
    systems: Iterable[str] | None = None,
    start: np.datetime64 | str | None = None,
    end: np.datetime64 | str | None = None,
) -> Observations:
    """Read the observation file or files of one receiver.

    Parameters
    ----------
    path : path-like or sequence of path-like
        RINEX 2.10 to 2.12, 3.00 to 3.05, 4.00 to 4.02; plain, ``.gz``, ``.Z``, Hatanaka (CRX) plain
        or in one of these, recognised by content. Several files are sorted by time and joined.
    broken_lines : {"stop", "count"}
        Treatment of broken lines, see above.
    systems : iterable of str, optional
        Constellation letters to read ("GEJ"); all by default.
    start, end : datetime64 or ISO 8601 str, optional
        Epochs from `start` up to, not including, `end`, GPS time.

    Returns
    -------
    Observations
        Channels with at least one observation. 0.000 and blank are absent (NaN).

    Raises
    ------
    InputFileError
        The file cannot be read, is of another kind, or has no epochs; with "stop" any broken line.
    MismatchError
        No epoch lies between `start` and `end`.

    Notes
    -----
    Use `scan_observations` for logs that do not fit into memory.
    """
    selection = _selection(broken_lines=broken_lines, systems=systems, start=start, end=end)
    return concatenate(list(_runs(listed(path), selection)))


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
    """Read the observation file or files of one receiver piece by piece; the other arguments are as
    `read_observations`.

    Parameters
    ----------
    epochs : int
        Epochs of a piece; the last may have fewer.
    progress : callable, optional
        Called repeatedly with the fraction of the files that has been read, 0 to 1.

    Yields
    ------
    Observations
        Each piece has the channels that occur in it; concatenated they are the log. Memory is that of a piece and one
        block of text.

    Raises
    ------
    InputFileError, MismatchError
        As `read_observations`, when the faulty line is reached.
    """
    if epochs < 1:
        raise ValueError(f"a piece has at least one epoch, epochs={epochs} was asked for")
    selection = _selection(broken_lines=broken_lines, systems=systems, start=start, end=end)
    return in_pieces(_runs(listed(path), selection, progress), epochs)


def _selection(
    *,
    broken_lines: BrokenLines,
    systems: Iterable[str] | None,
    start: np.datetime64 | str | None,
    end: np.datetime64 | str | None,
) -> Selection:
    if broken_lines not in get_args(BrokenLines):
        raise ValueError(f"broken_lines is '{broken_lines}', 'stop' or 'count' was expected")
    letters = None if systems is None else frozenset(systems)
    if letters is not None and (not letters or not letters <= set(SYSTEMS)):
        raise ValueError(f"systems is {sorted(letters)}, letters of {SYSTEMS} were expected")
    limits = {}
    for name, time in (("start_ns", start), ("end_ns", end)):
        if time is not None:
            limits[name] = int(np.asarray(time, dtype="datetime64[ns]").astype(np.int64))
    return Selection(broken_lines=broken_lines, systems=letters, **limits)


def _runs(
    paths: list[str], selection: Selection, progress: Callable[[float], None] | None = None
) -> Iterator[Observations]:
    """Yield runs of epochs of all files in order of time; at least one run and one epoch in total."""
    paths = paths if len(paths) == 1 else _in_order_of_time(paths, selection)
    last: Observations | None = None
    reader: BlockReader | None = None
    epochs = 0
    for k, path in enumerate(paths):
        before, reader = (
            reader,
            BlockReader(path, selection, **({} if reader is None else {"after_ns": reader.last_ns})),
        )
        joint = before is not None and before.epochs > 0
        for run in reader.blocks():
            if joint and len(run):
                run = with_break_at_gap(last, run)
                joint = False
            epochs += len(run)
            last = run if len(run) else last
            if progress is not None:
                progress((k + reader.share) / len(paths))
            yield run
        if not reader.epochs and selection.broken_lines == "stop":
            raise InputFileError(path, "has a header but no epochs; the recording is empty or cut short")
    if reader is not None and not epochs:
        if not reader.epochs:
            raise InputFileError(reader.path, "has no usable epoch; broken_lines='stop' shows the first fault")
        begin, end = _first_time(paths[0], selection), np.datetime64(reader.last_ns, "ns")
        what = f"is of {str(begin)[:19]} to {str(end)[:19]}"
        if begin > end or reader.last_ns >= selection.end_ns:
            what = f"begins at {str(begin)[:19]}"
        raise MismatchError(
            f"{', '.join(paths)}: no epoch lies in the time span from start to end; the log {what} (GPS time)"
        )


def _in_order_of_time(paths: list[str], selection: Selection) -> list[str]:
    firsts = [_first_time(path, selection) for path in paths]
    return [paths[k] for k in np.argsort(np.array(firsts), kind="stable")]


def _first_time(path: str, selection: Selection) -> np.datetime64:
    """Time of the first epoch of a file whatever the selected span, NaT without any."""
    peek = replace(selection, broken_lines="count", systems=None, start_ns=Selection.start_ns, end_ns=Selection.end_ns)
    with closing(BlockReader(path, peek, block_bytes=_PEEK_BYTES).blocks()) as runs:
        return next((run.time[0] for run in runs if len(run)), np.datetime64("NaT", "ns"))


def with_break_at_gap(last: Observations | None, run: Observations) -> Observations:
    """Set `break_before` at the first epoch of a further file, unless it follows at the interval of the log."""
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
    """Yield pieces of equal length from runs; problems belong to the piece being collected."""
    waiting: list[Observations] = []
    length = 0
    for run in runs:
        waiting.append(run)
        length += len(run)
        if length > epochs:
            joined = concatenate(waiting)
            rest = (length - 1) // epochs * epochs  # keep the last piece: faults at the end of the file belong to it
            for k, first in enumerate(range(0, rest, epochs)):
                piece = without_empty_channels(joined[first : first + epochs])
                yield _with_problems(piece, joined) if k == 0 else piece
            waiting, length = [without_empty_channels(joined[rest:])], length - rest
    yield without_empty_channels(concatenate(waiting))


def _with_problems(piece: Observations, source: Observations) -> Observations:
    return replace(piece, problems=source.problems, problem_count=source.problem_count, skipped=source.skipped)


def without_empty_channels(observations: Observations) -> Observations:
    """Drop the channels that have neither an observation nor a loss-of-lock digit."""
    arrays = ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz")
    used = channels_with_data([getattr(observations, name) for name in arrays], observations.loss_of_lock)
    return observations if used.all() else of_channels(observations, used)


def of_channels(observations: Observations, kept: Masks) -> Observations:
    """Some of the channels, shape (M,)."""
    arrays = ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock")
    return replace(
        observations,
        satellite=observations.satellite[kept],
        signal=observations.signal[kept],
        **{name: getattr(observations, name)[:, kept] for name in arrays},
    )
