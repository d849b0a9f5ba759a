"""Columns of the result tables: name, unit, meaning, source of the values and decimals, each stated once.

Tables of positions, observations and the filter (polars, Parquet, CSV), arrays with named axes (xarray) and the
reference document are made from the same `Column` objects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Generic, TypeVar

import numpy as np
import polars as pl
from numpy.typing import NDArray

from railfix.core.arrays import Floats

Source = TypeVar("Source")
#: Unit by the last part of a name.
UNITS: Final[Mapping[str, str]] = {
    "m": "m", "mm": "mm", "mps": "m/s", "mps2": "m/s^2", "deg": "deg", "dbhz": "dB-Hz", "permille": "permille",
    "1pm": "1/m", "s": "s", "db": "dB",
}  # fmt: skip
#: Decimals of a number in CSV files, 0.1 mm for lengths, and of an angle.
DECIMALS: Final = 4
DECIMALS_DEG: Final = 9


@dataclass(frozen=True)
class Column(Generic[Source]):
    """One column."""

    name: str  #: Ends with the unit where there is one: ``along_sigma_m``.
    meaning: str
    #: Values from the source of a table: an array with epochs on axis 0, one value for all rows, or None where the
    #: source has none. Words are given by their number.
    values: Callable[[Source], NDArray[Any] | str | None]

    dtype: pl.DataType = field(default=pl.Float64(), kw_only=True)
    words: tuple[str, ...] = field(default=(), kw_only=True)  #: Words that the numbers stand for.

    @property
    def unit(self) -> str:
        """Unit of the values; empty for words, counts and ratios."""
        return UNITS.get(self.name.rsplit("_", 1)[-1], "") if self.dtype == pl.Float64 and not self.words else ""

    @property
    def decimals(self) -> int:
        """Decimals of a number in CSV files."""
        return decimals(self.name)

    @property
    def polars_type(self) -> pl.DataType:
        """Type of the column in a table."""
        return pl.Enum(self.words) if self.words else self.dtype

    def series(self, values: NDArray[Any] | str | None, rows: int) -> pl.Series:
        """Return values as a column of a table; NaN as null."""
        kind = self.polars_type
        if values is None or isinstance(values, str):
            return pl.Series(values=[values], dtype=kind).new_from_index(0, rows)
        if self.words:
            return pl.Series(values=self.words, dtype=kind).gather(pl.Series(values=values.astype(np.uint32)))
        if self.dtype == pl.Float64:
            return float_column(values)
        return pl.Series(values=values.tolist() if values.dtype.kind == "U" else np.array(values), dtype=kind)

    def array(self, values: NDArray[Any] | str | None, shape: tuple[int, ...]) -> NDArray[Any]:
        """Return values as an array of a given shape: words as text, absent numbers as NaN, absent words blank."""
        if values is None or isinstance(values, str):
            absent = "" if self.words or self.dtype == pl.String else np.nan
            return np.full(shape, absent if values is None else values)
        return np.array(self.words)[values] if self.words else np.asarray(values)


def decimals(name: str) -> int:
    """Return the decimals that a number of a column gets in CSV files."""
    return DECIMALS_DEG if UNITS.get(name.rsplit("_", 1)[-1]) == "deg" else DECIMALS


def by_name(columns: Iterable[Column[Source]]) -> dict[str, Column[Source]]:
    """Return columns by their name, in order."""
    return {column.name: column for column in columns}


def float_column(values: Floats) -> pl.Series:
    """Return a column of floats, NaN as null."""
    return pl.Series(values=np.ascontiguousarray(values, dtype=np.float64), nan_to_null=True)


def table_of(columns: Mapping[str, Column[Source]], source: Source, rows: int, **given: str) -> pl.DataFrame:
    """Return a table of columns with one row an epoch; `given` has the value of columns that the source has not."""
    return pl.DataFrame(
        {name: column.series(given.get(name, column.values(source)), rows) for name, column in columns.items()}
    )
