"""Tables for terminal and HTML, and errors of reading tables."""

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
    """Raise errors of reading a table, also of a lazy one, as `InputFileError` with the reason in its message."""
    try:
        yield
    except (PolarsError, PanicException, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputFileError(path, message.format(reason)) from None


def number(value: float | None, digits: int = 2, unit: str = "", *, sign: str = "") -> str:
    """Return a number with thousands separators; an en dash for NaN or None."""
    if value is None or value != value:
        return "–"
    return f"{round(value, digits) + 0.0:{sign},.{digits}f}{unit}".replace("-", "−")


def digits(places: int, value: float | None) -> str:
    """Return a number without separators; blank for None."""
    return "" if value is None else f"{value:.{places}f}"


def share(part: float | None, digits: int = 2) -> str:
    """Return a fraction in per cent."""
    return "–" if part is None or part != part else f"{100.0 * part:.{digits}f} %"


def percent(part: float | None) -> str:
    """Return a fraction in per cent, for a column whose header has the sign."""
    return share(part).removesuffix(" %")


#: A whole number, and a number that always has its sign.
count: Final = partial(number, digits=0)
signed: Final = partial(number, sign="+")


@dataclass(frozen=True, kw_only=True)
class Table:
    """Table whose first column names the rows; a page has a link to it as a CSV file of this name."""

    kind: ClassVar[str] = "table"
    name: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    #: Columns of numbers, of code.
    numeric: Sequence[int] = ()
    code: Sequence[int] = ()
    marked: Sequence[int] = ()  #: Highlighted rows.
    links: Sequence[str] = ()  #: Address of the page on each row, blank without one; empty where no row has one.
    boxed: bool = False  #: Whether a terminal draws a frame around it.


def plain_table(
    head: Sequence[str], rows: Sequence[Sequence[str]], caption: str = "", *, texts: int = 1, boxed: bool = False
) -> Table:
    """Return a table that is printed alone; all columns but the first `texts` are numbers."""
    return Table(name="", head=head, rows=rows, caption=caption, numeric=range(texts, len(head)), boxed=boxed)


Column = tuple[str, str, Callable[[Any], str]]  #: Header, source column and format of a table column.


def listing(
    name: str, rows: pl.DataFrame, columns: Sequence[Column], caption: str = "", *, marked: Sequence[int] = ()
) -> Table:
    """Return a table of the rows of a frame; columns of formats other than `str` are numbers."""
    return Table(
        name=name,
        head=[head for head, _, _ in columns],
        rows=[[form(row[column]) for _, column, form in columns] for row in rows.iter_rows(named=True)],
        caption=caption,
        numeric=[k for k, (_, _, form) in enumerate(columns) if form is not str],
        marked=marked,
    )
