"""Reader of precise ephemerides in SP3 files (versions a to d)."""

from __future__ import annotations

from datetime import datetime
from typing import Final

import numpy as np

from railfix.core.errors import InputFileError
from railfix.core.files import FilePath, Paths, path_names, read_text_lines
from railfix.core.timescale import bdt_to_gpst, utc_to_gpst
from railfix.gnss.navigation import PreciseEphemeris
from railfix.gnss.orbits.ephemerides import POINTS
from railfix.gnss.plausible_records import plausible_radius
from railfix.io.file_kind import wrong_kind

#: Time systems that agree with GPS time to nanoseconds. SP3-a files name no time system (""); they are in GPS time.
_GPST: Final = ("GPS", "GAL", "QZS", "CCC", "")
#: Functions that convert times in other time systems of SP3 files to GPS time, by the name of the system.
_TO_GPST: Final = {"UTC": utc_to_gpst, "GLO": utc_to_gpst, "BDT": bdt_to_gpst, "BDS": bdt_to_gpst}
_NO_CLOCK: Final = 999_999.0  #: Clocks of at least this magnitude are unknown [us]; some programs write 0 instead.


def read_sp3(paths: Paths) -> PreciseEphemeris:
    """Read satellite positions and clocks from one or several SP3 files.

    Parameters
    ----------
    paths : path or sequence of paths
        SP3 files, plain or compressed.

    Returns
    -------
    PreciseEphemeris
        Where files overlap, the file given first takes precedence. Positions are NaN where zero or at an implausible
        radius for the constellation. Clocks are NaN where zero or unknown.

    Raises
    ------
    InputFileError
        A file is missing, is not an SP3 file, is in an unknown time system, or is malformed; all files together have
        fewer epochs than the interpolation needs; or all positions are at implausible radii.
    """
    files = path_names(paths)
    epoch, satellite, numbers = zip(*(state for path in files for state in _states(path)), strict=True)
    source = ", ".join(files)
    times, row = np.unique(np.array(epoch, dtype=np.int64), return_inverse=True)
    satellites, column = np.unique(np.array(satellite, dtype="<U3"), return_inverse=True)
    if len(times) < POINTS:
        raise InputFileError(source, f"has {len(times)} epochs, but interpolation of orbits needs at least {POINTS}")
    grid = np.full((len(times), len(satellites), 4), np.nan)
    # Assigned in reverse order, so that the first of several values is kept.
    grid[row[::-1], column[::-1]] = np.array(numbers)[::-1]
    position, clock = grid[..., :3], grid[..., 3]
    known = (position != 0.0).any(axis=-1) & np.isfinite(position).all(axis=-1)
    wrong = ~plausible_radius(satellites, position * 1e3)  # including zeros, which represent missing values
    if known.any() and wrong[known].all():
        radius = float(np.median(np.linalg.norm(position[known], axis=-1)))
        what = f"its satellites are {radius:,.0f} km from the Earth's centre; check whether its positions are in km"
        raise InputFileError(source, what)
    zeros = (clock == 0.0) & known
    counts = {"positions at an implausible radius": int((wrong & known).sum()), "clocks of 0": int(zeros.sum())}
    position[wrong] = np.nan
    clock[(np.abs(clock) >= _NO_CLOCK) | (clock == 0.0)] = np.nan
    return PreciseEphemeris(
        time=times.astype("datetime64[ns]"),
        satellite=satellites,
        position_ecef_m=position * 1e3,
        clock_s=clock * 1e-6,
        source=source,
        notes=tuple(f"{source}: {n:,} {what} left out" for what, n in counts.items() if n),
    )


def _states(path: FilePath) -> list[tuple[int, str, list[float]]]:
    """Read epoch [ns of GPS time since 1970], satellite, x, y, z [km] and clock [us] from each position line."""
    lines = read_text_lines(path)
    if not lines or lines[0][:2] not in ("#a", "#b", "#c", "#d"):
        raise wrong_kind(path, "a file of precise orbits, SP3 (its first line begins with #a, #b, #c or #d)")
    system = _time_system(path, lines)
    epoch: int | None = None
    states: list[tuple[int, str, list[float]]] = []
    for number, line in enumerate(lines, start=1):
        try:
            if line.startswith("*"):
                epoch = _instant(line, system)
            elif line.startswith("P"):
                if epoch is None:
                    raise InputFileError(path, "a position comes before the first epoch", line=number)
                states.append((epoch, _satellite(line[1:4]), _numbers(line)))
        except ValueError:
            what = f"{line.strip()!r} has an invalid satellite, time or number"
            raise InputFileError(path, what, line=number) from None
    if not states:
        raise InputFileError(path, "has no satellite position; if the file is cut short, give the complete file")
    return states


def _satellite(text: str) -> str:
    """Return the satellite name, such as ``G01``. SP3-a omits the letter G, and may have blanks for leading zeros.

    Raise ValueError if the text has no number.
    """
    letter = text[0] if text[:1].isalpha() else "G"
    digits = text[1:].strip()
    if not digits.isdecimal():
        raise ValueError(text)
    return f"{letter}{int(digits):02d}"


def _numbers(line: str) -> list[float]:
    """Parse position [km] and clock [us]; a blank clock is NaN. Raise ValueError if a value is infinite."""
    x, y, z = (float(line[4 + 14 * i : 18 + 14 * i]) for i in range(3))
    text = line[46:60].strip()
    clock = float(text) if text else np.nan
    if np.isinf([x, y, z, clock]).any():
        raise ValueError(line)
    return [x, y, z, clock]


def _time_system(path: FilePath, lines: list[str]) -> str:
    """Return the time system in the first %c line, or "GPS". Raise InputFileError if the time system is unsupported."""
    for number, line in enumerate(lines, start=1):
        if line.startswith("%c"):
            system = line[9:12].strip().upper()
            if system not in _GPST and system not in _TO_GPST:
                what = f"time system {system!r} is not supported; GPS, GAL, QZS, BDT, UTC or GLO was expected"
                raise InputFileError(path, what, line=number)
            return system
    return "GPS"


def _instant(line: str, system: str) -> int:
    """Parse an epoch line as nanoseconds of GPS time since 1970; raise ValueError if the time is invalid."""
    year, month, day, hour, minute = (int(line[a:b]) for a, b in ((3, 7), (8, 10), (11, 13), (14, 16), (17, 19)))
    seconds = float(line[20:31])
    if not (1980 <= year < 2100 and 0.0 <= seconds <= 60.0):
        raise ValueError(line)
    minute_start = np.datetime64(datetime(year, month, day, hour, minute), "ns")
    own = minute_start + np.timedelta64(round(seconds * 1e9), "ns")
    to_gpst = _TO_GPST.get(system)
    return int((own if to_gpst is None else to_gpst(own)).astype(np.int64))
