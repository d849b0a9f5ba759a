"""Observations from the table S_GNSS_SAT of EGNSS MATE."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
import polars as pl

from railfix.core.errors import InputFileError
from railfix.core.mate import read_mate
from railfix.core.timescale import from_week, seconds
from railfix.gnss.observations import ObservationHeader, Observations

#: RINEX code of a signal by constellation, as Septentrio receivers name them (SBF reference guide, signal types).
_CODES: Final[Mapping[str, Mapping[str, str]]] = {
    "G": {"L1CA": "1C", "L1P": "1W", "L1PY": "1W", "L2P": "2W", "L2PY": "2W", "L2C": "2L", "L5": "5Q", "L1C": "1L"},
    "R": {"L1CA": "1C", "G1CA": "1C", "L1P": "1P", "L2CA": "2C", "G2CA": "2C", "L2P": "2P", "L3": "3Q"},
    "E": {
        "E1": "1C", "E1BC": "1C", "L1BC": "1C", "E6": "6C", "E6BC": "6C", "E5A": "5Q", "E5B": "7Q", "E5": "8Q",
        "E5ALTBOC": "8Q",
    },
    "C": {"B1I": "2I", "B2I": "7I", "B3I": "6I", "B1C": "1P", "B2A": "5P", "B2B": "7D"},
    "J": {"L1CA": "1C", "L2C": "2L", "L5": "5Q", "L1C": "1L"},
    "S": {"L1CA": "1C", "L5": "5I"},
}  # fmt: skip
_NEEDED: Final = ("GPS_WEEK", "GPS_TOW", "SAT_ID", "SIGNAL_TYPE", "PSEUDORANGE")
_VALUES: Final = {
    "code_m": "PSEUDORANGE", "phase_cycles": "CARRIER_PHASE", "doppler_hz": "DOPPLER", "cn0_dbhz": "CN0",
}  # fmt: skip


def signal_code(satellite: str, signal: str) -> str:
    """Return the RINEX code of a signal type such as ``GPS_L1CA``, ``E5a`` or ``1C``; blank where it is unknown."""
    name = signal.replace("-", "_").rsplit("_", 1)[-1]
    if len(name) == 2 and name[0].isdigit() and name[1].isalpha():
        return name.upper()
    return _CODES.get(satellite[:1], {}).get(name.upper(), "")


def read_mate_observations(path: str) -> Observations:
    """Read the observations of one antenna; of several devices or antennas those of the one with the most rows.

    InputFileError: the file is no such table, or no row of it is of a known satellite and signal.
    """
    table = read_mate(path, _NEEDED).with_columns(
        pl.col("SAT_ID").cast(pl.String), pl.col("SIGNAL_TYPE").cast(pl.String)
    )
    table, problems = _one_antenna(path, table)
    skipped: Counter[str] = Counter()
    usable = ~(table["ERROR"].cast(pl.Boolean).fill_null(False)) & table["TRACKING_STATUS"].cast(pl.Boolean).fill_null(
        True
    )
    skipped["rows with an error or not tracked"] = len(table) - int(usable.sum())
    pairs = table.select("SAT_ID", "SIGNAL_TYPE").unique()
    codes = pairs.with_columns(
        code=pl.Series(
            [signal_code(*pair) if _is_satellite(pair[0]) else "" for pair in pairs.iter_rows()], dtype=pl.String
        )
    )
    table = table.filter(usable).join(codes, on=["SAT_ID", "SIGNAL_TYPE"], how="left", nulls_equal=True)
    known = table["code"].fill_null("") != ""
    for name, count in table.filter(~known).group_by("SIGNAL_TYPE").len().iter_rows():
        skipped[f"rows of the signal type {name}"] += count
    table = table.filter(known)
    if not len(table):
        raise InputFileError(path, "has no row of a known satellite and signal, such as G05 and L1CA")
    time = from_week(table["GPS_WEEK"].to_numpy(), table["GPS_TOW"].cast(pl.Float64).to_numpy())
    return _as_arrays(table, np.round(time.astype(np.int64), -3), problems, skipped)


def _is_satellite(name: str | None) -> bool:
    return name is not None and len(name) == 3 and name[0] in _CODES and name[1:].isdigit()


def _one_antenna(path: str, table: pl.DataFrame) -> tuple[pl.DataFrame, tuple[str, ...]]:
    counts = table.group_by("DEVICE_ID", "ANTENNA").len().sort("len", descending=True)
    if len(counts) == 1:
        return table, ()
    device, antenna, _ = counts.row(0)
    chosen = table.filter(
        pl.col("DEVICE_ID").eq_missing(pl.lit(device)) & pl.col("ANTENNA").eq_missing(pl.lit(antenna))
    )
    which = f"device {device}, antenna {antenna}"
    return chosen, (f"{path}: has {len(counts)} devices or antennas; {which}, with the most rows, is used",)


def _as_arrays(
    table: pl.DataFrame, time_ns: np.ndarray, problems: tuple[str, ...], skipped: Counter[str]
) -> Observations:
    """Arrays of epochs by channels; of two rows of one signal at one epoch the last."""
    times, row = np.unique(time_ns, return_inverse=True)
    names = table["SAT_ID"] + table["code"]
    channels, column = np.unique(names.to_numpy().astype(np.str_), return_inverse=True)
    values: dict[str, Any] = {}
    for name, source in {**_VALUES, "lock_s": "LOCK_TIME"}.items():
        values[name] = np.full((len(times), len(channels)), np.nan)
        values[name][row, column] = table[source].cast(pl.Float64).fill_null(np.nan).to_numpy()
    time = times.astype("datetime64[ns]")
    lock = values.pop("lock_s")
    # the lock time rises with the time, whole seconds, while the phase goes on
    lost = np.zeros(lock.shape, dtype=np.uint8)
    lost[1:] = lock[1:] < np.fmin(lock[:-1], lock[:-1] + seconds(np.diff(time))[:, None] - 1.0 + 1e-6)
    return Observations(
        time=time,
        satellite=np.array([name[:3] for name in channels.tolist()]),
        signal=np.array([name[3:] for name in channels.tolist()]),
        **values,
        loss_of_lock=lost,
        break_before=np.zeros(len(times), dtype=np.bool_),
        header=ObservationHeader(receiver="EGNSS MATE", marker="S_GNSS_SAT"),
        problems=problems,
        problem_count=len(problems),
        skipped={name: count for name, count in skipped.items() if count},
    )


def scan_mate(paths: list[str], start: np.datetime64 | None, end: np.datetime64 | None) -> Iterator[Observations]:
    """Yield the observations of tables in order of time."""
    parts = sorted((read_mate_observations(path) for path in paths), key=lambda part: part.time[0])
    for part in parts:
        first = 0 if start is None else int(np.searchsorted(part.time, start))
        stop = len(part) if end is None else int(np.searchsorted(part.time, end))
        yield part[first:stop]
