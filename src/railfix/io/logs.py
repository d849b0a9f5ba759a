"""Readers of observations and navigation records; the kind of each file is recognised by its content."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypedDict, Unpack, get_args

import numpy as np

from railfix.core.arrays import join_rows
from railfix.core.errors import InputFileError, MismatchError
from railfix.core.files import BrokenLines, Paths, Reader, path_names
from railfix.core.timescale import gps_time
from railfix.gnss.joined_observations import concatenate
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.gnss.plausible_records import plausible_navigation
from railfix.io import rinex
from railfix.io.epoch_order import EpochOrder, FileEpochs
from railfix.io.file_kind import find_kind
from railfix.io.mate import mate_table, read_mate_observations
from railfix.io.rinex.observations import (
    DEFAULT_EPOCHS,
    check_one_run,
    in_pieces,
    of_channels,
    with_break_at_gap,
    without_empty_channels,
)

Time = np.datetime64 | str | None


def read_observations(
    path: Paths,
    *,
    broken_lines: BrokenLines = "stop",
    systems: Iterable[str] | None = None,
    start: Time = None,
    end: Time = None,
    date: Time = None,
    reader: Reader = "railfix",
) -> Observations:
    """Read the observations of one receiver from RINEX files, receiver logs or EGNSS MATE tables.

    Parameters
    ----------
    path : path or sequence of path
        RINEX observation files, receiver logs (UBX, SBF, RTCM 3) or EGNSS MATE tables S_GNSS_SAT, plain or compressed.
        Other messages in a receiver log are skipped. Several files must be of one kind, and are read in order of time.
    broken_lines : {"stop", "count"}
        With "stop", a malformed RINEX line raises InputFileError. With "count", the values or epochs that the line
        affects are skipped and counted. Malformed messages in a receiver log are always skipped and counted.
    systems : iterable of str, optional
        Letters of the constellations to read, all by default.
    start, end : datetime64 or str, optional
        Time span to read, GPS time; epochs at `end` or later are excluded.
    date : datetime64 or str, optional
        Date of the log, correct to half a week. It is required for RTCM 3 logs without ephemerides, because RTCM 3
        observations have no week number.
    reader : {"railfix", "georinex"}
        "georinex" reads RINEX files with georinex, an independent reader, for comparison. georinex is slower, and does
        not count malformed lines. It ignores events, scale factors, and loss-of-lock indicators of bands other than 1
        and 2.

    Raises
    ------
    InputFileError
        A file cannot be read, or has no observations that can be dated.
    MismatchError
        No epoch lies between `start` and `end`, the files are of different kinds, or `reader` is "georinex" and a file
        is a receiver log.
    """
    pieces = scan_observations(
        path, broken_lines=broken_lines, systems=systems, start=start, end=end, date=date, epochs=1 << 62, reader=reader
    )
    return concatenate(list(pieces))


def _by_georinex(
    paths: list[str], systems: list[str] | None, start: np.datetime64 | None, end: np.datetime64 | None
) -> list[Observations]:
    """Read RINEX files with georinex, and return their observations in order of time without overlaps."""
    import georinex

    from railfix.io.georinex_layout import observations_from_xarray

    parts: list[Observations] = []
    for name in paths:
        if find_kind(name) == "receiver":
            raise MismatchError(f"{name} is a receiver log, but georinex reads RINEX only; leave out reader (--reader)")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # caused by georinex's use of xarray, not by the file
            try:
                part = observations_from_xarray(georinex.load(Path(name), useindicators=True))
            except (ValueError, LookupError, OSError) as error:
                raise InputFileError(name, f"georinex cannot read it: {error or type(error).__name__}") from error
        parts.append(_of_systems(part, systems)[start:end])
    parts = sorted((part for part in parts if len(part)), key=lambda part: part.time[0])
    if not parts:
        raise MismatchError(f"{', '.join(paths)}: no epoch lies in the requested time span")
    joined = [parts[0]]
    for part in parts[1:]:
        rest = part[int(np.searchsorted(part.time, joined[-1].time[-1], side="right")) :]
        joined += [with_break_at_gap(joined[-1], rest)] if len(rest) else []
    return joined


class _Selection(TypedDict, total=False):
    """Common arguments of `read_observations` and `scan_observations`."""

    broken_lines: BrokenLines
    systems: Iterable[str] | None
    start: Time
    end: Time
    date: Time


def scan_observations(
    path: Paths,
    *,
    epochs: int = DEFAULT_EPOCHS,
    progress: Callable[[float], None] | None = None,
    reader: Reader = "railfix",
    **selection: Unpack[_Selection],
) -> Iterator[Observations]:
    """Return an iterator over the observations of one receiver in pieces of at most `epochs` epochs.

    The first piece has fewer epochs, so that processing begins early. The arguments `broken_lines`, `systems`, `start`,
    `end` and `date`, and the errors raised, are as in `read_observations`. `progress` is called with the fraction of
    the files that has been read. With georinex, all files are read before the first piece is returned.
    """
    if reader not in get_args(Reader):
        raise ValueError(f"reader is {reader!r}, 'railfix' or 'georinex' was expected")
    paths, systems, date = path_names(path), selection.get("systems"), _instant(selection.get("date"))
    letters = None if systems is None else list(systems)
    start, end = (_instant(time) for time in (selection.get("start"), selection.get("end")))
    if reader == "georinex":
        return in_pieces(iter(_by_georinex(paths, letters, start, end)), epochs)
    if any(mate_table(p) == "S_GNSS_SAT" for p in paths):
        return _mate_pieces(paths, letters, (start, end), epochs)
    receiver = [find_kind(p) == "receiver" for p in paths]
    if not any(receiver):
        return rinex.scan_observations(
            paths, epochs=epochs, broken_lines=selection.get("broken_lines", "stop"), systems=letters, start=start,
            end=end, progress=progress,
        )  # fmt: skip
    if not all(receiver):
        raise MismatchError(
            f"{paths[receiver.index(False)]} is a RINEX file and {paths[receiver.index(True)]} a receiver log; "
            "all files of an antenna must be of one kind"
        )
    return in_pieces(_receiver_runs(paths, letters, (start, end, date), progress), epochs)


def _mate_pieces(
    paths: list[str],
    systems: list[str] | None,
    limits: tuple[np.datetime64 | None, np.datetime64 | None],
    epochs: int,
) -> Iterator[Observations]:
    """Return the observations of EGNSS MATE tables S_GNSS_SAT in order of time, in pieces."""
    if others := [path for path in paths if mate_table(path) != "S_GNSS_SAT"]:
        raise MismatchError(f"{others[0]} is not a table S_GNSS_SAT; all files of an antenna must be of one kind")
    tables = sorted((read_mate_observations(path) for path in paths), key=lambda part: part.time[0])
    pieces = list(in_pieces((_of_systems(part[slice(*limits)], systems) for part in tables), epochs))
    if not any(len(piece) for piece in pieces):
        raise MismatchError(f"{', '.join(paths)}: no epoch lies in the requested time span")
    return iter(pieces)


def _instant(time: Time) -> np.datetime64 | None:
    return None if time is None else gps_time(time)


def _receiver_runs(
    paths: list[str],
    systems: list[str] | None,
    limits: tuple[np.datetime64 | None, np.datetime64 | None, np.datetime64 | None],
    progress: Callable[[float], None] | None,
) -> Iterator[Observations]:
    """Yield the observations of all receiver logs in blocks, in order of time, for the requested systems and times."""
    from railfix.io.receiver.log import scan_receiver_log

    start, end, date = limits
    ordered = _in_order(paths, date)
    found = 0

    def of_files() -> Iterator[FileEpochs]:
        last: Observations | None = None
        for k, path in enumerate(ordered):

            def share(part: float, k: int = k) -> None:
                if progress is not None:
                    progress((k + part) / len(paths))

            joint = k > 0
            for run in scan_receiver_log(path, date=date, progress=share):
                part = replace(_of_systems(run, systems)[start:end], skipped=run.skipped)
                if joint and len(part):
                    part, joint = with_break_at_gap(last, part), False
                last = part if len(part) else last
                yield path, part, np.zeros(len(part), dtype=np.int64)

    for part in EpochOrder("count").ordered(of_files()):
        found += len(part)
        yield part
    if not found:
        raise MismatchError(f"{', '.join(paths)}: no epoch lies in the requested time span")


def _in_order(paths: list[str], date: np.datetime64 | None) -> list[str]:
    if len(paths) == 1:
        return paths
    from railfix.io.receiver.log import scan_receiver_log

    firsts = [next(run.time[0] for run in scan_receiver_log(p, date=date) if len(run)) for p in paths]
    check_one_run(paths, firsts)
    return [paths[k] for k in np.argsort(np.array(firsts), kind="stable")]


def _of_systems(run: Observations, letters: list[str] | None) -> Observations:
    """Return the observations of the constellations `letters`; None means all constellations."""
    return run if letters is None else without_empty_channels(of_channels(run, np.isin(run.system, letters)))


def read_navigation(paths: Paths, *, broken_lines: BrokenLines = "stop", date: Time = None) -> Navigation:
    """Read the navigation records in RINEX navigation files and receiver logs, in any combination.

    Records whose orbit is implausible for their constellation are rejected, counted and described in the notes.

    Parameters
    ----------
    paths : path or sequence of path
    broken_lines : {"stop", "count"}
        With "stop", a malformed record raises InputFileError. With "count", a malformed record is skipped, counted in
        `Navigation.skipped` and described in `Navigation.notes`.
    date : datetime64 or str, optional
        Date of the logs, correct to half a week. It is required for RTCM 3 logs whose records have no full date.

    Raises
    ------
    InputFileError
        A file cannot be read, or there is no usable record.
    """
    names = path_names(paths)
    receiver = [find_kind(name) == "receiver" for name in names]
    parts = []
    if not all(receiver):
        files = [name for name, is_log in zip(names, receiver, strict=True) if not is_log]
        parts.append(rinex.read_navigation(files, broken_lines=broken_lines))
    if any(receiver):
        from railfix.io.receiver.log import read_receiver_navigation

        logs = [name for name, is_log in zip(names, receiver, strict=True) if is_log]
        parts.append(read_receiver_navigation(logs, date=_instant(date)))
    joined = parts[0] if len(parts) == 1 else _join(parts)
    navigation = plausible_navigation(joined)
    if len(joined.kepler) + len(joined.glonass) and not len(navigation.kepler) + len(navigation.glonass):
        raise InputFileError(", ".join(names), f"has no usable record; {'; '.join(navigation.notes)}")
    return navigation


def _join(parts: list[Navigation]) -> Navigation:
    """Join navigation data. Klobuchar coefficients and leap seconds are taken from the first part that has them."""
    return Navigation(
        kepler=join_rows([part.kepler for part in parts]),
        glonass=join_rows([part.glonass for part in parts]),
        klobuchar={letter: value for part in reversed(parts) for letter, value in part.klobuchar.items()},
        leap_seconds=next((part.leap_seconds for part in parts if part.leap_seconds is not None), None),
        skipped=dict(sum((Counter(part.skipped) for part in parts), Counter())),
        notes=tuple(note for part in parts for note in part.notes),
        sources=tuple(source for part in parts for source in part.sources),
    )
