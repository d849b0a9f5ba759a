"""Tables of results as plain values, the same for a terminal and for a page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Final

import polars as pl


def number(value: float | None, digits: int = 2, unit: str = "", *, sign: str = "") -> str:
    """A number with thousands separators; an en dash for NaN or None."""
    if value is None or value != value:
        return "–"
    return f"{round(value, digits) + 0.0:{sign},.{digits}f}{unit}".replace("-", "−")


def share(part: float | None, digits: int = 2) -> str:
    """A share in per cent."""
    return "–" if part is None or part != part else f"{100.0 * part:.{digits}f} %"


def percent(part: float | None) -> str:
    """A share in per cent, for a column whose head has the sign."""
    return share(part).removesuffix(" %")


#: A whole number, and a number that always has its sign.
count: Final = partial(number, digits=0)
signed: Final = partial(number, sign="+")


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table whose first column names the rows; a page offers it as a CSV file of this name.

    Attributes
    ----------
    numeric, code : sequence of int
        Columns of numbers, of code.
    marked : sequence of int
        Rows that stand out.
    links : sequence of str
        Address of the page on each row, blank without one; empty where no row has one.
    """

    kind: ClassVar[str] = "table"
    name: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    numeric: Sequence[int] = ()
    code: Sequence[int] = ()
    marked: Sequence[int] = ()
    links: Sequence[str] = ()


#: Head, column and format of a column of a table.
Column = tuple[str, str, Callable[[Any], str]]


def listing(
    name: str, rows: pl.DataFrame, columns: Sequence[Column], caption: str = "", *, marked: Sequence[int] = ()
) -> Table:
    """A table of rows of a frame; columns of other formats than `str` are numbers."""
    return Table(
        name=name,
        head=[head for head, _, _ in columns],
        rows=[[form(row[column]) for _, column, form in columns] for row in rows.iter_rows(named=True)],
        caption=caption,
        numeric=[k for k, (_, _, form) in enumerate(columns) if form is not str],
        marked=marked,
    )
