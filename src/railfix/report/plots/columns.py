"""Columns of the tables as arrays."""

from __future__ import annotations

import numpy as np
import polars as pl

from railfix.core.arrays import Floats, Strings
from railfix.core.timescale import seconds
from railfix.evaluate.run_folder import floats

__all__ = ["floats", "nice_step", "points", "since", "start_of", "words"]


def points(table: pl.DataFrame, *names: str) -> Floats:
    """Columns side by side, shape (rows, columns)."""
    return np.stack([floats(table, name) for name in names], axis=1)


def words(table: pl.DataFrame, name: str) -> Strings:
    """A text column, blank where it is null."""
    return np.array(table[name].cast(pl.String).fill_null("").to_numpy(), dtype=np.str_)


def start_of(table: pl.DataFrame) -> np.datetime64:
    """Earliest time of a table; ValueError where it is empty."""
    if not len(table):
        raise ValueError("the table has no rows")
    return np.datetime64(table["time_gpst"].to_numpy().min(), "ns")


def since(table: pl.DataFrame, start: np.datetime64) -> Floats:
    """Times of a table since a start [s]."""
    return seconds(table["time_gpst"].to_numpy().astype("datetime64[ns]") - start)


def nice_step(rough: float) -> float:
    """1, 2 or 5 times a power of ten, at least `rough`."""
    power = 10.0 ** np.floor(np.log10(max(rough, 1e-9)))
    return float(next(power * k for k in (1.0, 2.0, 5.0, 10.0) if power * k >= rough * (1.0 - 1e-9)))
