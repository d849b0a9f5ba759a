"""Precise ephemerides from SP3 files (versions a, c and d)."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import Final

import numpy as np

from railfix.errors import InputFileError
from railfix.files import read_text_lines
from railfix.navigation import PreciseEphemeris
from railfix.timescale import bdt_to_gpst, utc_to_gpst

FilePath = str | PathLike[str]

#: Time systems other than GPS time, by the names that files use.
_TO_GPST: Final = {"UTC": utc_to_gpst, "GLO": utc_to_gpst, "BDT": bdt_to_gpst, "BDS": bdt_to_gpst}
#: Written where a clock is unknown [us].
_NO_CLOCK: Final = 999_999.0


def read_sp3(paths: FilePath | Sequence[FilePath]) -> PreciseEphemeris:
    """Positions and clocks of one or several SP3 files, joined in order of time.

    Parameters
    ----------
    paths : path or sequence of paths
        Plain, gzip, compress.

    Returns
    -------
    PreciseEphemeris
        Where files overlap the first one given for an epoch counts.

    Raises
    ------
    InputFileError
        A file is missing, no SP3 file, in an unknown time system, or broken.
    """
    files = [paths] if isinstance(paths, (str, PathLike)) else list(paths)
    states: dict[tuple[np.datetime64, str], tuple[float, float, float, float]] = {}
    for path in files:
        for key, state in _read_file(path).items():
            states.setdefault(key, state)
    times = np.array(sorted({key[0] for key in states}), dtype="datetime64[ns]")
    satellites = sorted({key[1] for key in states})
    row = {t: i for i, t in enumerate(times.tolist())}
    column = {s: i for i, s in enumerate(satellites)}
    grid = np.full((len(times), len(satellites), 4), np.nan)
    for (time, satellite), state in states.items():
        grid[row[int(time.astype(np.int64))], column[satellite]] = state
    return PreciseEphemeris(
        time=times,
        satellite=np.array(satellites, dtype="<U3"),
        position_ecef_m=grid[..., :3],
        clock_s=grid[..., 3],
        source=", ".join(str(p) for p in files),
    )


def _read_file(path: FilePath) -> dict[tuple[np.datetime64, str], tuple[float, float, float, float]]:
    lines = read_text_lines(path)
    if not lines or lines[0][:2] not in ("#a", "#c", "#d"):
        raise InputFileError(path, "is no SP3 file: its first line must begin with #a, #c or #d", line=1)
    system = _time_system(path, lines)
    found: dict[tuple[np.datetime64, str], tuple[float, float, float, float]] = {}
    time: np.datetime64 | None = None
    for number, line in enumerate(lines, start=1):
        try:
            if line.startswith("*"):
                time = _instant(line, system)
            elif line.startswith("P"):
                if time is None:
                    raise InputFileError(path, "a position stands before the first epoch", line=number)
                letter = line[1] if line[1].isalpha() else "G"
                x, y, z, clock = (float(line[4 + 14 * i : 18 + 14 * i]) for i in range(4))
                absent = x == y == z == 0.0
                place = (np.nan,) * 3 if absent else (x * 1e3, y * 1e3, z * 1e3)
                bias = np.nan if abs(clock) >= _NO_CLOCK else clock * 1e-6
                found[time, f"{letter}{int(line[2:4]):02d}"] = (*place, bias)
        except ValueError:
            raise InputFileError(path, f"{line.strip()!r} holds no number where one is due", line=number) from None
    if not found:
        raise InputFileError(path, "holds no satellite position")
    return found


def _time_system(path: FilePath, lines: list[str]) -> str:
    """Time system of the first %c line; SP3-a has none and is in GPS time."""
    for line in lines:
        if line.startswith("%c"):
            system = line[9:12].strip().upper()
            if system in ("GPS", "GAL", "QZS", "CCC", ""):
                return "GPS"
            if system in _TO_GPST:
                return system
            raise InputFileError(path, f"time system {system!r} is not read; GPS, GAL, QZS, BDT, UTC and GLO are")
    return "GPS"


def _instant(line: str, system: str) -> np.datetime64:
    year, month, day, hour, minute = (int(line[a:b]) for a, b in ((3, 7), (8, 10), (11, 13), (14, 16), (17, 19)))
    minute_start = np.datetime64(f"{year:04d}-{month:02d}-{day:02d}T{hour:02d}:{minute:02d}")
    own = minute_start + np.timedelta64(round(float(line[20:31]) * 1e9), "ns")
    to_gpst = _TO_GPST.get(system)
    return own if to_gpst is None else np.datetime64(to_gpst(own).astype(np.int64).item(), "ns")
