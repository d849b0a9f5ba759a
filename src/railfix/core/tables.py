"""Tables for the terminal and HTML pages, and errors raised while table files are read."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from os import PathLike
from typing import Any, ClassVar, Final

import polars as pl
from polars.exceptions import PanicException, PolarsError

from railfix.core.errors import InputFileError


@contextmanager
def reading_table(
    path: str | PathLike[str], message: str = "cannot be read as a table ({}); run railfix run again"
) -> Iterator[None]:
    """Convert to `InputFileError` the errors that occur in the with-block while a table is read.

    The placeholder ``{}`` of `message` is replaced by the reason.
    """
    try:
        yield
    except (PolarsError, PanicException, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputFileError(path, message.format(reason)) from None


def number(value: float | None, digits: int = 2, unit: str = "", *, sign: str = "") -> str:
    """Format a number with thousands separators, `digits` decimals and the unit; an en dash for NaN or None."""
    if value is None or value != value:
        return "–"
    return f"{round(value, digits) + 0.0:{sign},.{digits}f}{unit}".replace("-", "−")


def digits(places: int, value: float | None) -> str:
    """Format a number with `places` decimals and without thousands separators; empty for None."""
    return "" if value is None else f"{value:.{places}f}"


def share(part: float | None, digits: int = 2) -> str:
    """Format a fraction in per cent; an en dash for NaN or None."""
    return "–" if part is None or part != part else f"{100.0 * part:.{digits}f} %"


def percent(part: float | None) -> str:
    """Format a fraction in per cent without the sign ``%``, for a column whose header has the sign."""
    return share(part).removesuffix(" %")


count: Final = partial(number, digits=0)  #: Format a number without decimals.
signed: Final = partial(number, sign="+")  #: Format a number with its sign.


@dataclass(frozen=True, kw_only=True)
class Table:
    """Table with row names in the first column; an HTML page offers it for download as a CSV file called `name`."""

    kind: ClassVar[str] = "table"
    name: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    numeric: Sequence[int] = ()  #: Indices of the columns with numbers.
    code: Sequence[int] = ()  #: Indices of the columns with code.
    marked: Sequence[int] = ()  #: Indices of the highlighted rows.
    #: Address of a page about each row, "" for a row without a page; the sequence is empty if no row has a page.
    links: Sequence[str] = ()
    boxed: bool = False  #: Whether a terminal draws a frame around the table.


def plain_table(
    head: Sequence[str], rows: Sequence[Sequence[str]], caption: str = "", *, texts: int = 1, boxed: bool = False
) -> Table:
    """Return a table without a name, for the terminal; the first `texts` columns contain text, the others numbers."""
    return Table(name="", head=head, rows=rows, caption=caption, numeric=range(texts, len(head)), boxed=boxed)


#: Column of a table: its header, the name of the data frame's column, and the function that formats a value.
Column = tuple[str, str, Callable[[Any], str]]


def listing(
    name: str, rows: pl.DataFrame, columns: Sequence[Column], caption: str = "", *, marked: Sequence[int] = ()
) -> Table:
    """Return a table with the rows of a data frame; a column counts as numeric unless its format is `str`."""
    return Table(
        name=name,
        head=[head for head, _, _ in columns],
        rows=[[form(row[column]) for _, column, form in columns] for row in rows.iter_rows(named=True)],
        caption=caption,
        numeric=[k for k, (_, _, form) in enumerate(columns) if form is not str],
        marked=marked,
    )
