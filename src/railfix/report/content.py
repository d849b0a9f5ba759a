"""Content of the page as plain values: tables, sentences, folded parts. The templates turn them into HTML."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Final

import polars as pl


def number(value: float | None, digits: int = 2, unit: str = "") -> str:
    """A number with thousands separators; an en dash for NaN or None."""
    if value is None or value != value:
        return "–"
    return f"{round(value, digits) + 0.0:,.{digits}f}{unit}".replace("-", "−")


def share(part: float | None, digits: int = 2) -> str:
    """A share in per cent."""
    return "–" if part is None or part != part else f"{100.0 * part:.{digits}f} %"


#: A whole number.
count: Final = partial(number, digits=0)


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table whose first column names the rows; the page offers it as a CSV file of this name.

    Attributes
    ----------
    numeric, code : sequence of int
        Columns of numbers, of code.
    marked : sequence of int
        Rows that stand out.
    """

    kind: ClassVar[str] = "table"
    name: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    numeric: Sequence[int] = ()
    code: Sequence[int] = ()
    marked: Sequence[int] = ()


#: Head, column and format of a column of a table.
Column = tuple[str, str, Callable[[Any], str]]


def listing(name: str, rows: pl.DataFrame, columns: Sequence[Column], caption: str = "") -> Table:
    """A table of rows of a frame; columns of other formats than `str` are numbers."""
    return Table(
        name=name,
        head=[head for head, _, _ in columns],
        rows=[[form(row[column]) for _, column, form in columns] for row in rows.iter_rows(named=True)],
        caption=caption,
        numeric=[k for k, (_, _, form) in enumerate(columns) if form is not str],
    )


@dataclass(frozen=True)
class Sentence:
    """A paragraph of text."""

    kind: ClassVar[str] = "sentence"
    text: str


@dataclass(frozen=True)
class Absent:
    """A sentence on content that the page does not have, with the reason."""

    kind: ClassVar[str] = "absent"
    text: str


@dataclass(frozen=True)
class ReportedCommand:
    """A command line."""

    kind: ClassVar[str] = "command"
    text: str


@dataclass(frozen=True)
class Notes:
    """A list of sentences under a heading."""

    kind: ClassVar[str] = "notes"
    title: str
    lines: Sequence[str]


@dataclass(frozen=True)
class Folded:
    """A part that the reader opens."""

    kind: ClassVar[str] = "folded"
    title: str
    blocks: Sequence[Block]


Block = Table | Sentence | Absent | ReportedCommand | Notes | Folded
