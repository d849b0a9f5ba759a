"""Where each antenna really was, from a log of positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from railfix.errors import InputFileError
from railfix.named_columns import read_named_columns
from railfix.position_log import read_positions
from railfix.track_map.from_positions import usable_rows

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Truth:
    """Places of one antenna, R instants.

    Attributes
    ----------
    time : ndarray of datetime64[ns], shape (R,)
        Rising, GPS time.
    ecef_m : ndarray, shape (R, 3) [m]
    """

    time: NDArray[np.datetime64]
    ecef_m: Floats


def read_truth(path: Path, antennas: Sequence[str]) -> dict[str, Truth]:
    """Read a log of positions as the truth of one antenna, or of several by its column ``antenna``.

    Parameters
    ----------
    path : Path
        CSV or RTKLIB's format (`position_log.read_positions`); where it tells quality, 1 (fix) alone counts.
    antennas : sequence of str
        Those that are run.

    Returns
    -------
    dict of str to Truth
        Of every antenna.

    Raises
    ------
    InputFileError
        No log of positions, no times, or nothing that says which antenna's they are.
    """
    log = read_positions(path)
    usable = usable_rows(log) & np.isfinite(log.ecef_m).all(axis=1) & ~np.isnat(log.time)
    owner = np.full(len(log), antennas[0])
    named = _antenna_column(path)
    if named is not None:
        owner = np.array(named)
    elif len(antennas) > 1:
        raise InputFileError(path, f"a column antenna ({', '.join(antennas)}) is needed for the truth of two antennas")
    truths = {}
    for name in antennas:
        rows = np.flatnonzero(usable & (owner == name))
        if len(rows) < 2:
            raise InputFileError(path, f"fewer than two positions with a time for the antenna {name}")
        time, first = np.unique(log.time[rows], return_index=True)
        truths[name] = Truth(time=time, ecef_m=log.ecef_m[rows[first]])
    return truths


def _antenna_column(path: Path) -> list[str] | None:
    if path.suffix.lower() != ".csv":
        return None
    return read_named_columns(path).cells.get("antenna")
