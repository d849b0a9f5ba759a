"""Position logs; parsers of RTKLIB ``.pos`` files and of CSV files with named columns."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np
import polars as pl

from railfix.core.arrays import Datetimes, Floats, Integers
from railfix.core.errors import InputFileError, SettingsError
from railfix.core.files import LENIENT, BrokenLines, FilePath, read_text
from railfix.core.geodesy import ecef_from_geodetic, geodetic_from_ecef
from railfix.core.notebook import NotebookTable
from railfix.core.settings import misspelt
from railfix.core.timescale import SECONDS_PER_WEEK, from_week, timedelta, utc_to_gpst
from railfix.core.utc import gpst_to_utc
from railfix.io.named_columns import NamedColumns, fails, parse_named_columns, with_usual_names

SIGMA_COLUMNS: Final = ("sigma_north_m", "sigma_east_m", "sigma_up_m")  #: Columns of standard deviations in a CSV log.
#: Columns of a CSV log. Times are in GPS time, UTC, Unix time, or GPS week and seconds; positions are geodetic or ECEF.
CSV_COLUMNS: Final = (
    "time_gpst", "time_utc", "unix_s", "week", "tow_s", "latitude_deg", "longitude_deg", "height_m", "x_m", "y_m",
    "z_m", "quality", "ratio", *SIGMA_COLUMNS,
)  # fmt: skip
#: Other columns that a position table may have; they are read from `PositionLog.table`.
OTHER_COLUMNS: Final = ("antenna", "chainage_m", "speed_mps", "sigma_m", "source", "environment")
#: Unix times above this (near the end of 2099) are rejected, because they are probably in milliseconds [s].
_LAST_UNIX_S: Final = 4.1e9
_GEODETIC: Final = ("latitude_deg", "longitude_deg", "height_m")
_CARTESIAN: Final = ("x_m", "y_m", "z_m")


@dataclass(frozen=True, kw_only=True, repr=False)
class PositionLog(NotebookTable):
    """Positions of a log, n rows, in file order unless `railfix.io.positions.read_positions` sorted them by time."""

    path: str
    time: Datetimes  #: GPS time of each row; NaT where the log has no time, shape (n,).
    ecef_m: Floats  #: ECEF position; NaN where a row has no position or no height, shape (n, 3).
    #: RTKLIB quality number (manual 2.4.2, B.1): 1 fix, 2 float, 3 SBAS, 4 DGPS, 5 single, 6 PPP; shape (n,). The
    #: number is -1 where the log has no quality. A CSV log may have other numbers.
    quality: Integers
    sigma_m: Floats  #: Standard deviations of the position north, east and up; NaN where absent, shape (n, 3).
    line: Integers  #: Line number of each row in the file, shape (n,).
    notes: tuple[str, ...] = ()
    ratio: Floats | None = None  #: Ratio of the ambiguity test, shape (n,); None if the log has no ratios.
    #: Latitude and longitude of all rows, shape (n, 2); None if `ecef_m` suffices, because all positions have heights.
    plan_deg: Floats | None = None
    antennas: tuple[str, ...] = ()  #: Names in the column ``antenna``; empty if there is no such column.
    table: NamedColumns | None = None  #: All columns of a CSV or RTKLIB log; None for logs of other kinds.

    @property
    def geodetic(self) -> tuple[Floats, Floats, Floats]:
        """Latitude, longitude [deg] and ellipsoidal height [m], shape (n,) each; NaN where absent."""
        latitude, longitude, height = geodetic_from_ecef(self.ecef_m)
        if self.plan_deg is None:
            return latitude, longitude, height
        return self.plan_deg[:, 0], self.plan_deg[:, 1], height

    def __len__(self) -> int:
        return len(self.ecef_m)

    @property
    def has_quality(self) -> bool:
        """Whether any row has a quality."""
        return bool((self.quality >= 0).any())


#: A log with more than this number of malformed lines is rejected.
_MOST_BROKEN: Final = 200
Parsed = TypeVar("Parsed")


def skip_broken(
    path: FilePath, parse: Callable[[list[str]], Parsed], *, broken_lines: BrokenLines
) -> tuple[Parsed, tuple[str, ...]]:
    """Parse the lines of a log; return the result, and a note on each skipped line.

    With "count", malformed lines after the first line of data are skipped. With "stop", only an incomplete last line is
    skipped, because a power cut may leave one. Raise InputFileError for a malformed line that is not skipped, or if
    more than `_MOST_BROKEN` lines are malformed.
    """
    text = read_text(path)
    lines = text.splitlines()
    cut = len(lines) if not text.endswith(("\n", "\r")) else None
    first = next((number for number, line in enumerate(lines, start=1) if line.strip() and line[0] not in "#%"), 0)
    notes: list[str] = []
    while True:
        try:
            return parse(lines), tuple(notes)
        except InputFileError as error:
            if error.line is None or error.line <= first or not lines[error.line - 1].strip():
                raise
            if broken_lines == "stop" and error.line != cut:
                raise InputFileError(path, f"{error.message}; {LENIENT}", line=error.line) from None
            if len(notes) == _MOST_BROKEN:
                raise InputFileError(path, f"more than {_MOST_BROKEN} lines cannot be read; last: {error}") from None
            notes.append(f"{error}; the line was skipped")
            lines[error.line - 1] = ""


def parse_csv_positions(lines: list[str], path: FilePath, columns: Mapping[str, str]) -> PositionLog:
    """Parse the positions in a table with named columns; `columns` is as in `read_positions`."""
    table = rename_columns(parse_named_columns(lines, path), columns, known=(*CSV_COLUMNS, *OTHER_COLUMNS))
    return positions_of_table(table)


def positions_of_table(table: NamedColumns) -> PositionLog:
    """Return the positions in a table. It may lack the columns of heights, standard deviations, times and quality.

    Raise InputFileError if the table has no position columns or no rows, or if a value is not a number or out of range.
    """
    path = table.path
    cartesian = all(name in table for name in _CARTESIAN)
    table = table if cartesian else with_usual_names(table, _GEODETIC)
    close = misspelt(table.cells, CSV_COLUMNS)
    absent = {right: wrong for wrong, right in close.items() if right not in table}
    geodetic = all(name in table for name in _GEODETIC[:2])
    for name in _GEODETIC if geodetic else (*_GEODETIC, *_CARTESIAN):
        if name in absent and not cartesian:
            raise table.header_error(f"column {absent[name]!r} is unknown; did you mean {name!r}?")
    if not geodetic and not cartesian:
        raise table.header_error(
            "no columns latitude_deg, longitude_deg, height_m (ellipsoidal) or x_m, y_m, z_m (ECEF); the columns are "
            f"{', '.join(table.cells)} (to read columns with other names, give columns, or --column latitude_deg=NAME)"
        )
    if not len(table):
        raise InputFileError(path, "there is no position below the header")
    names = _CARTESIAN if cartesian else _GEODETIC
    values = np.stack([numbers_or_nan(table, name) for name in names], axis=-1)
    if not cartesian and (outside := np.abs(values[:, 0]) > 90.0).any():
        row = int(np.argmax(outside))
        raise table.error(row, f"latitude_deg {values[row, 0]:g} is over 90; are latitude and longitude swapped?")
    flat = not cartesian and bool((np.isfinite(values[:, :2]).all(axis=1) & np.isnan(values[:, 2])).any())
    quality = table.numbers("quality", blank=-1.0) if "quality" in table else np.full(len(table), -1.0)
    notes: tuple[str, ...] = ()
    if (height := table.usual.get("height_m")) is not None:
        notes = (f"{path}: the column {height!r} is taken as heights above the ellipsoid, in metres",)
    return PositionLog(
        path=str(path),
        time=positions_times(table),
        ecef_m=values if cartesian else ecef_from_geodetic(*values.T),
        quality=np.where(np.isfinite(quality), quality, -1.0).astype(np.int64),
        sigma_m=np.stack([numbers_or_nan(table, name) for name in SIGMA_COLUMNS], axis=-1),
        line=table.line,
        notes=notes,
        ratio=numbers_or_nan(table, "ratio") if "ratio" in table else None,
        plan_deg=values[:, :2] if flat else None,
        antennas=tuple(table.cells["antenna"].unique().sort().to_list()) if "antenna" in table else (),
        table=table,
    )


def numbers_or_nan(table: NamedColumns, name: str) -> Floats:
    """Parse a column as numbers. Blank cells are NaN; all rows are NaN if the table has no such column."""
    return table.numbers(name, blank=np.nan) if name in table else np.full(len(table), np.nan)


def qualities_in_words(log: PositionLog) -> str:
    """Return the number of rows of each quality as a string: "1155 of quality 2, 3 of quality 5"."""
    numbers, counts = np.unique(log.quality, return_counts=True)
    return ", ".join(f"{count} of quality {number}" for number, count in zip(numbers, counts, strict=True))


def column_names(pairs: Iterable[str]) -> dict[str, str]:
    """Parse strings ``NAME=COLUMN``; return a mapping from railfix's column names to the column names of the file.

    Raise SettingsError for a string that does not have this form.
    """
    columns: dict[str, str] = {}
    for pair in pairs:
        ours, equals, theirs = pair.partition("=")
        if not equals or not ours.strip() or not theirs.strip():
            raise SettingsError(f"--column {pair!r}: expected NAME=COLUMN, for example latitude_deg=Lat")
        columns[ours.strip()] = theirs.strip()
    return columns


def rename_columns(table: NamedColumns, columns: Mapping[str, str], *, known: Collection[str]) -> NamedColumns:
    """Return the table with the columns in `columns` copied under railfix's names (`columns` as in `read_positions`).

    Raise SettingsError if railfix's name of a column is not in `known`, and InputFileError if the table lacks a column.
    """
    if unknown := sorted(set(columns) - set(known)):
        raise SettingsError(f"{table.path}: column {unknown[0]!r} is unknown; expected one of {', '.join(known)}")
    cells = dict(table.cells)
    for ours, theirs in columns.items():
        if theirs not in table.cells:
            message = f"there is no column {theirs!r} (given for {ours}); the columns are {', '.join(table.cells)}"
            raise table.header_error(message)
        cells[ours] = table.cells[theirs]
    return replace(table, cells=cells)


def positions_times(table: NamedColumns) -> Datetimes:
    """Return GPS time from ``time_gpst``, ``time_utc``, ``unix_s``, or ``week`` and ``tow_s``; NaT where missing."""
    if "time_gpst" in table:
        return _column_of_times(table, "time_gpst")
    if "time_utc" in table:
        return utc_to_gpst(_column_of_times(table, "time_utc"))
    if "unix_s" in table:
        unix = table.numbers("unix_s", blank=np.nan)
        wrong = np.isfinite(unix) & ((unix < 0.0) | (unix > _LAST_UNIX_S))
        if wrong.any():
            row = int(np.argmax(wrong))
            raise table.error(
                row, f"unix_s {unix[row]:g} is not a number of seconds since 1970; is it in milliseconds?"
            )
        whole = np.floor(np.nan_to_num(unix))
        since = whole.astype("timedelta64[s]") + timedelta(np.nan_to_num(unix) - whole)
        return utc_to_gpst(np.where(np.isnan(unix), np.datetime64("NaT"), np.datetime64("1970-01-01", "ns") + since))
    time = np.full(len(table), np.datetime64("NaT", "ns"))
    if "week" in table and "tow_s" in table:
        week, seconds = table.numbers("week", blank=np.nan), table.numbers("tow_s", blank=np.nan)
        known = np.isfinite(week) & np.isfinite(seconds)
        wrong = known & ((week != np.floor(week)) | (week < 0) | (seconds < 0) | (seconds > SECONDS_PER_WEEK))
        if wrong.any():
            row = int(np.argmax(wrong))
            what = f"week {week[row]:g} and tow_s {seconds[row]:g}"
            raise table.error(row, f"{what} are not a GPS week and a time of week (0 to {SECONDS_PER_WEEK} s)")
        time[known] = from_week(week[known].astype(np.int64), seconds[known])
    return time


def _column_of_times(table: NamedColumns, name: str) -> Datetimes:
    """Parse a column of ISO 8601 times. Dates may have slashes; times in UTC may end in Z or +00:00."""
    cells = [cell.replace("/", "-") for cell in table.cells[name].to_list()]
    if table.separator != ",":
        cells = [cell.replace(",", ".") for cell in cells]
    if name == "time_utc":
        cells = [cell.removesuffix("Z").removesuffix("+00:00").strip() for cell in cells]
    for row, cell in enumerate(cells):
        if cell.endswith("Z") or "+" in cell:
            expected = "UTC" if name == "time_utc" else "GPS time without one"
            hint = (
                "" if name == "time_utc" else f"; for UTC, name the column time_utc, or give --column time_utc={name}"
            )
            raise table.error(row, f"{name} '{cell}' has a time zone; {expected} was expected{hint}")
    try:
        return _times([cell or "NaT" for cell in cells])
    except ValueError:
        row = next(i for i, cell in enumerate(cells) if fails(_times, [cell or "NaT"]))
        raise table.error(row, f"{name} '{cells[row]}' is not an ISO 8601 time such as 2021-09-22T06:30:00.2") from None


def _times(texts: list[str]) -> Datetimes:
    """Parse ISO 8601 times; raise `ValueError` for any other text and for a time with a time zone."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        try:
            return np.array(texts, dtype="datetime64[ns]")
        except UserWarning as warning:
            raise ValueError(str(warning)) from None


# --- RTKLIB ------------------------------------------------------------------

#: railfix's name for each column name of RTKLIB's solutions.
_OF_RTKLIB: Final = {
    "latitude": "latitude_deg", "longitude": "longitude_deg", "height": "height_m", "x-ecef": "x_m", "y-ecef": "y_m",
    "z-ecef": "z_m", "Q": "quality", "sdn": "sigma_north_m", "sde": "sigma_east_m", "sdu": "sigma_up_m",
}  # fmt: skip


def parse_rtklib_positions(lines: list[str], path: FilePath) -> PositionLog:
    """Parse RTKLIB's solution format (manual 2.4.2, B.1); raise InputFileError for baselines or geoid heights."""
    scale, names = _rtklib_header(path, [line for line in lines if line.startswith("%")])
    rows = [(i, line) for i, line in enumerate(lines, start=1) if line.strip() and not line.startswith("%")]
    if not rows:
        raise InputFileError(path, "there is no position below the header")
    fields = [line.replace(",", " ").replace(";", " ").split() for _, line in rows]
    sexagesimal = "(d'" in names[0]
    least = max(9 + 1 if sexagesimal else 5 + 1, len(fields[0]))
    for (number, _), row in zip(rows, fields, strict=True):
        if len(row) < least:
            message = f"{len(row)} fields; expected time, coordinates, quality and as many fields as in the first row"
            raise InputFileError(path, message, line=number)
    columns = [pl.Series(column, dtype=pl.String) for column in zip(*(row[:least] for row in fields), strict=True)]
    calendar = "/" in fields[0][0]
    if calendar:
        name = "time_gpst" if scale == "GPST" else "time_utc"
        cells = {name: columns[0] + "T" + columns[1]}
    else:
        cells = {"week": columns[0], "tow_s": columns[1]}
    if sexagesimal:
        names = [*"abcdef", *names[2:]]
    cells |= {_OF_RTKLIB.get(name := n.split("(")[0], name): c for n, c in zip(names, columns[2:], strict=False)}
    line = np.array([number for number, _ in rows], dtype=np.int64)
    table = NamedColumns(path=str(path), metadata={}, header_line=0, line=line, cells=cells)
    if sexagesimal:
        for column, parts in (("latitude_deg", "abc"), ("longitude_deg", "def")):
            degrees, minutes, seconds = (table.numbers(part) for part in parts)
            sign = np.where(np.signbit(degrees), -1.0, 1.0)
            cells[column] = pl.Series(map(repr, (sign * (abs(degrees) + minutes / 60.0 + seconds / 3600.0)).tolist()))
    log = positions_of_table(table)
    if scale == "GPST":
        return log
    time = log.time if calendar else utc_to_gpst(log.time)
    if scale == "JST":
        time = utc_to_gpst(gpst_to_utc(time) - timedelta(9 * 3600.0))
    return replace(log, time=time, notes=(*log.notes, f"{path}: times converted from {scale} to GPS time"))


def _rtklib_header(path: FilePath, header: list[str]) -> tuple[str, list[str]]:
    """Read the time scale and the names of the columns after the time."""
    for line in header:
        if "lat/lon/height=" in line and "geodetic" in line.split("lat/lon/height=")[1].split(",")[0]:
            raise InputFileError(path, "the heights are above the geoid; write the file with out-height=ellipsoidal")
    for line in header:
        names = line[1:].replace(",", " ").replace(";", " ").split()
        if names[:1] and names[0] in ("GPST", "UTC", "JST"):
            if any("baseline" in name for name in names):
                raise InputFileError(
                    path, "these are baselines (e/n/u); write the file with out-solformat=llh or out-solformat=xyz"
                )
            if len(names) < 5 or not (names[1].startswith("latitude") or names[1].startswith("x-ecef")):
                break
            return names[0], names[1:]
    raise InputFileError(
        path,
        "there is no RTKLIB header line such as '%  GPST  latitude(deg) longitude(deg)  height(m)  Q ...'; write the "
        ".pos file with out-outhead=on",
    )
