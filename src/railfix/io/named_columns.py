"""Text tables with named columns, and metadata in comments ``# key: value`` above the header line."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import polars as pl

from railfix.core.arrays import Floats, Indices, Integers, Strings
from railfix.core.errors import InputFileError
from railfix.core.files import FilePath, read_text

_BLOCK: Final = 4096  #: Number of rows that are converted to columns at a time.
_SEPARATORS: Final = (";", "\t", "|")  #: Column separators other than the comma.
#: For each of these column names of railfix, the names that other programs often give to the column. Names are compared
#: without regard to case and punctuation. A height without a unit is in metres.
_USUAL: Final[dict[str, tuple[str, ...]]] = {
    "latitude_deg": ("lat", "latitude", "latdeg", "latitudedegrees", "gpslatitude"),
    "longitude_deg": ("lon", "long", "lng", "longitude", "londeg", "longitudedegrees", "gpslongitude"),
    "height_m": (
        "height", "h", "hgt", "alt", "altitude", "altm", "altitudem", "altitudemeters", "heightmeters", "ele", "elev",
        "elevation", "ellipsoidalheight", "ellipsoidalheightm", "hae",
    ),
}  # fmt: skip
#: Endings of column names that denote units in which railfix reads no column, and the names of these units.
_OTHER_UNITS: Final = {
    "ft": "feet", "feet": "feet", "foot": "feet", "usft": "feet", "mm": "millimetres", "cm": "centimetres",
    "km": "kilometres", "rad": "radians", "gon": "gon", "yd": "yards",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class NamedColumns:
    """Text table with named columns, n rows."""

    path: str
    #: ``# key: value`` comments above the header, keys in lower case; values of a repeated key are joined by "; ".
    metadata: dict[str, str]

    header_line: int  #: Line number of the header line; the first line of the file is 1.
    line: Integers  #: Line number of each row in the file, shape (n,).
    cells: dict[str, pl.Series]  #: Cells of each column, without surrounding blanks.
    separator: str = ","  #: Column separator; if it is not a comma, numbers may have a decimal comma.
    #: For each column that `with_usual_names` has renamed, railfix's name and the name in the file.
    usual: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.line)

    def __contains__(self, name: str) -> bool:
        return name in self.cells

    def take(self, rows: Indices) -> NamedColumns:
        """Return the table of the rows with the indices `rows`, in the order of `rows`."""
        return replace(self, line=self.line[rows], cells={name: cell[rows] for name, cell in self.cells.items()})

    def error(self, row: int, message: str) -> InputFileError:
        """Return an error that names the line of a row."""
        return InputFileError(self.path, message, line=int(self.line[row]))

    def header_error(self, message: str) -> InputFileError:
        """Return an error that names the line of the header."""
        return InputFileError(self.path, message, line=self.header_line)

    def texts(self, name: str, *, absent: str) -> Strings:
        """Return a column as strings, or `absent` in every row if the table has no such column."""
        return np.array(self.cells[name].to_list(), dtype=np.str_) if name in self else np.full(len(self), absent)

    def numbers(self, name: str, *, blank: float | None = None) -> Floats:
        """Parse a column as numbers, shape (n,); raise InputFileError for a cell that is not a finite number.

        If `blank` is None, an empty cell is an error. Otherwise, empty cells are read as `blank`, and cells with
        ``nan`` are accepted. If `blank` is infinite, infinite cells are accepted, too.
        """
        given = self.cells[name].str.len_bytes().to_numpy() > 0
        cells = self.cells[name].to_list()
        if blank is not None:
            cells = [cell or repr(blank) for cell in cells]
        if self.separator != ",":
            cells = [cell.replace(",", ".") if cell.count(",") == 1 else cell for cell in cells]
        try:
            values = np.array(cells, dtype=np.float64)
        except ValueError:
            row = next(i for i, cell in enumerate(cells) if fails(float, cell))
            what = f"'{cells[row]}' is not a number" if cells[row] else "the cell is empty"
            raise self.error(row, f"column {name}: {what}; a number was expected") from None
        bad = given & np.isinf(values) if blank is None or not np.isinf(blank) else np.zeros_like(given)
        bad |= np.isnan(values) & (blank is None)
        if bad.any():
            row = int(np.argmax(bad))
            raise self.error(row, f"column {name}: '{cells[row]}' is not a finite number; remove or correct the row")
        return values


def fails(parse: Callable[[Any], object], text: object) -> bool:
    """Return whether parsing a string raises ValueError."""
    try:
        parse(text)
    except ValueError:
        return True
    return False


def is_named(theirs: str, name: str) -> bool:
    """Return whether the column name `theirs` is railfix's `name`, or another program's usual name for this column."""
    plain = "".join(c for c in theirs.lower() if c.isalnum())
    return plain in _USUAL.get(name, ()) or theirs.lower() == name


def with_usual_names(table: NamedColumns, names: Iterable[str]) -> NamedColumns:
    """Return the table with usual column names ("Latitude", "lon", "alt") replaced by railfix's `names`.

    Raise InputFileError if a column name denotes a unit other than railfix's ("height_ft").
    """
    cells, usual = dict(table.cells), {}
    for name in names:
        if name in cells:
            continue
        word, _, unit = name.rpartition("_")
        for theirs in list(cells):
            plain = "".join(c for c in theirs.lower() if c.isalnum())
            if is_named(theirs, name):
                cells[name] = cells.pop(theirs)
                usual[name] = theirs
                break
            stem, other = next(((plain[: -len(u)], u) for u in _OTHER_UNITS if plain.endswith(u)), ("", ""))
            if stem and (stem in _USUAL.get(name, ()) or stem == word) and other != unit:
                raise table.header_error(
                    f"column {theirs!r} is in {_OTHER_UNITS[other]}; convert its numbers, and name the column {name}"
                )
    return replace(table, cells=cells, usual={**table.usual, **usual})


def read_named_columns(path: FilePath) -> NamedColumns:
    """Read a table with a header line of column names, separated by commas, semicolons, tabs or bars.

    Raise InputFileError if there is no header line, a column name is repeated, or a row does not have one cell for each
    column.
    """
    return parse_named_columns(read_text(path).splitlines(), path)


def parse_named_columns(lines: Iterable[str], path: FilePath) -> NamedColumns:
    """Parse the lines of a file as `read_named_columns` does; `path` is used in messages."""
    metadata: dict[str, str] = {}
    header: list[str] = []
    header_line, separator = 0, ","
    rows: list[list[str]] = []
    blocks: list[pl.DataFrame] = []
    numbers: list[int] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        if line.startswith("#"):
            key, colon, value = line.lstrip("#").partition(":")
            if colon and not header:
                key, value = key.strip().lower(), value.strip()
                metadata[key] = f"{metadata[key]}; {value}" if key in metadata else value
            continue
        if not header and "," not in line:
            separator = next((mark for mark in _SEPARATORS if mark in line), ",")
        try:
            row = next(csv.reader([line], delimiter=separator)) if '"' in line else line.split(separator)
            cells = [cell.strip() for cell in row]
        except csv.Error as error:
            raise InputFileError(path, f"cannot be split into cells ({error})", line=number) from None
        if not header:
            header, header_line = cells, number
            continue
        if len(cells) != len(header):
            _check_header(path, header, header_line)
            message = f"{len(cells)} cells where the header (line {header_line}) has {len(header)} columns"
            raise InputFileError(path, message, line=number)
        rows.append(cells)
        numbers.append(number)
        if len(rows) == _BLOCK:
            blocks.append(_compact(rows, len(header)))
            rows = []
    _check_header(path, header, header_line)
    columns = pl.concat([*blocks, _compact(rows, len(header))]).get_columns()
    return NamedColumns(
        path=str(path),
        metadata=metadata,
        header_line=header_line,
        line=np.array(numbers, dtype=np.int64),
        cells=dict(zip(header, columns, strict=True)),
        separator=separator,
    )


def _compact(rows: list[list[str]], width: int) -> pl.DataFrame:
    """Return rows of cells as columns of text."""
    return pl.DataFrame([pl.Series(str(i), [row[i] for row in rows], dtype=pl.String) for i in range(width)])


def _check_header(path: FilePath, header: list[str], line: int) -> None:
    if not header:
        raise InputFileError(path, "no header line with the names of the columns was found")
    if not any(fails(float, cell) for cell in header):
        raise InputFileError(path, "has numbers where a header line with column names was expected", line=line)
    repeated = sorted({name for name in header if header.count(name) > 1})
    if repeated:
        raise InputFileError(path, f"column {repeated[0]!r} occurs twice in the header", line=line)
