"""Read the folder of a run: a table of positions, ``run.json``, and the present paths of the input files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl
import polars.selectors as cs
from polars.exceptions import PolarsError

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, MismatchError
from railfix.core.reasons import Status
from railfix.pipeline.level_stage import KINDS
from railfix.run.record import RunRecord, read_parquet, read_record, reading_table

#: Columns that every table of positions has.
NEEDED: Final = ("time_gpst", "antenna", "status", "chainage_m", "along_sigma_m", "x_m", "y_m", "z_m")
#: No columns beside those that every table has.
NO_MORE: Final = ~cs.all()
#: Columns of the conventional position.
CONVENTIONAL: Final = ("conventional_chainage_m", "conventional_x_m", "conventional_y_m", "conventional_z_m")
#: Table of single-epoch positions. Another table of the same run, such as ``train``, takes `SINGLE_EPOCH` from it.
POSITIONS_TABLE: Final = "positions"
TABLES: Final = (POSITIONS_TABLE, "train")
SINGLE_EPOCH: Final = ("n_used", *CONVENTIONAL)
#: Kind of protection levels where neither positions nor ``run.json`` name it.
UNKNOWN_KIND: Final = "unknown"
_KEYS: Final = ("time_gpst", "antenna")
_ENDINGS: Final = (".parquet", ".csv")


@dataclass(frozen=True, kw_only=True)
class RunFolder(RunRecord):
    """Results of a run, with one of its tables of positions."""

    positions_path: Path  #: The Parquet file of the table, or its CSV file where that is absent.
    #: One row per epoch and antenna, see `railfix.pipeline.result_columns.POSITION_COLUMNS`; ``observed`` tells whether
    #: the antenna has observations.
    positions: pl.DataFrame
    table: str = POSITIONS_TABLE  #: Name of the table: "positions" for the single-epoch positions.

    @property
    def antennas(self) -> list[str]:
        """Names in the order of the rows."""
        return [str(name) for name in self.positions["antenna"].unique(maintain_order=True)]

    @property
    def chainage_of(self) -> Mapping[str, str]:
        """Reference point of the chainage, by antenna."""
        return dict(self._line.get("chainage_of") or {})

    def turn_m(self, antenna: str) -> float:
        """Once round a closed line by the chainage of an antenna [m]; infinite for others, and where no run says it."""
        turn = (self._line.get("turn_m") or {}).get(antenna)
        return float("inf") if turn is None else float(turn)

    @property
    def line_name(self) -> str:
        """Name of the track."""
        return str((self._line.get("track") or {}).get("name") or "unnamed line")

    @property
    def track_facts(self) -> Mapping[str, Any]:
        """Facts on the track that the run used."""
        return dict(self._line.get("track") or {})

    @property
    def tracks(self) -> list[Path]:
        """Files of the track: that in the folder where the run moved, joined or raised it, else its inputs."""
        name = self.track_facts.get("file")
        return [self.path / str(name)] if name else self.located("track")

    @property
    def settings(self) -> dict[str, Any]:
        """Settings in force and kinds of input, by dotted name."""
        flat = flattened(self.record.get("settings_used") or {})
        kinds = {str(entry["input"]) for entry in self.entries}
        return flat | {f"input {kind}": "given" for kind in sorted(kinds - {"front", "nav", "track", "config"})}

    @property
    def protection(self) -> Mapping[str, Any]:
        """Assumptions of the protection levels; empty without levels."""
        assumptions = self.record.get("protection")
        return assumptions if isinstance(assumptions, Mapping) else {}

    @property
    def level_kind(self) -> str | None:
        """Kind of the levels, `UNKNOWN_KIND` where not recorded, None without; InputFileError for several."""
        level = "protection_level_m"
        if level not in self.positions.columns or self.positions[level].null_count() == len(self.positions):
            return self._kind if self.protection and self.table == POSITIONS_TABLE else None
        return self._kind

    @property
    def _kind(self) -> str:
        if self.table != POSITIONS_TABLE:
            return self.table
        named = {self.protection.get("kind")}
        if "protection_kind" in self.positions.columns:
            named |= set(self.positions["protection_kind"].cast(pl.String).unique())
        known = [kind for kind in KINDS if kind in named]
        if len(known) > 1:
            raise InputFileError(
                self.positions_path,
                f"protection_kind is {' and '.join(known)} in the positions and run.json; one kind per run expected",
            )
        return known[0] if known else UNKNOWN_KIND

    @property
    def alarm_limit_m(self) -> float | None:
        """Alarm limit of the run [m]; InputFileError where it is not a positive number."""
        limit = self.protection.get("alarm_limit_m")
        if limit is None:
            return None
        if isinstance(limit, bool) or not isinstance(limit, int | float) or not 0.0 < limit < float("inf"):
            raise InputFileError(
                self.path / "run.json", f"protection.alarm_limit_m is {limit!r}; a positive number was expected"
            )
        return float(limit)

    def column_of(self, name: str) -> str:
        """Name of a column of the positions in tables of several runs: levels are prefixed with their kind."""
        return f"{self.level_kind}_{name}" if name.startswith("protection_") and self.level_kind else name

    @property
    def _line(self) -> Mapping[str, Any]:
        return self.record.get("line") or {}


def flattened(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted name; lists as text."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat |= flattened(value, f"{name}.")
        else:
            flat[name] = " ".join(str(v) for v in value) if isinstance(value, list | tuple) else value
    return flat


def tables_of(path: Path) -> list[str]:
    """Names of the tables of positions in the folder of a run, the single-epoch positions first."""
    return [name for name in TABLES if any((path / f"{name}{end}").is_file() for end in _ENDINGS)]


def read_run(
    path: Path, *, table: str = POSITIONS_TABLE, conventional: Path | None = None, columns: cs.Selector | None = None
) -> RunFolder:
    """Read the folder that `railfix run` wrote.

    A `table` other than "positions" takes the satellites used and the conventional position from the single-epoch
    positions of the same time and antenna. `conventional`: see `railfix.evaluate.RunAndReference`; `columns`: those to
    read beside those that every table of positions has, all without. InputFileError: no such folder, or its files are
    not what they should be. MismatchError: `conventional` is a run on another log.
    """
    record = read_record(path).record
    needed = (*NEEDED, *SINGLE_EPOCH) if table == POSITIONS_TABLE else NEEDED
    file, rows = read_table(path, table, needed, columns)
    if table == POSITIONS_TABLE:
        rows = rows.with_columns(observed=pl.col("status") != Status.NO_OBSERVATION.text)
    else:
        single = read_run(path, columns=NO_MORE).positions
        added = [name for name in (*SINGLE_EPOCH, "observed") if name not in rows.columns]
        rows = rows.join(single.select(*_KEYS, *added), on=_KEYS, how="left", maintain_order="left")
        rows = rows.with_columns(pl.col("observed").fill_null(value=False))
    if conventional is not None:
        other = read_run(conventional, columns=NO_MORE)
        _check_same_log(path, record, conventional, other.record)
        unscreened = other.positions.select(*_KEYS, *CONVENTIONAL)
        rows = rows.drop(CONVENTIONAL).join(unscreened, on=_KEYS, how="left", maintain_order="left")
    return RunFolder(path=path, positions_path=file, positions=rows, record=record, table=table)


def _check_same_log(path: Path, record: Mapping[str, Any], other: Path, of_other: Mapping[str, Any]) -> None:
    logs = [
        sorted(str(entry.get("sha256")) for entry in entries.get("inputs", ()) if entry["input"] in ("front", "rear"))
        for entries in (record, of_other)
    ]
    if logs[0] != logs[1]:
        raise MismatchError(f"{other}: is not a run on the log of {path}; give one whose observations are the same")


def read_table(
    path: Path, name: str, needed: Sequence[str] = NEEDED, columns: cs.Selector | None = None
) -> tuple[Path, pl.DataFrame]:
    """Return the file and the rows of one table of a run, in order of time.

    `needed` are the columns that it must have, `columns` those to read beside them, all without. InputFileError: the
    table is absent, lacks a column, has no rows, or an antenna twice at one time.
    """
    file = next((path / f"{name}{end}" for end in _ENDINGS if (path / f"{name}{end}").is_file()), None)
    if file is None:
        raise InputFileError(path, f"holds neither {name}.parquet nor {name}.csv; name a folder of railfix run")
    rows = _table(file, None if columns is None else cs.by_name(*needed, require_all=False) | columns)
    missing = [column for column in needed if column not in rows.columns]
    if missing:
        raise InputFileError(file, f"has no column {missing[0]}; expected the {name} of railfix run")
    if not len(rows):
        raise InputFileError(file, "has no rows; there is nothing to evaluate")
    rows = rows if rows["time_gpst"].is_sorted() else rows.sort("time_gpst", maintain_order=True)
    times = rows.select("antenna", "time_gpst")
    for antenna in times["antenna"].unique():
        if (np.diff(times.filter(antenna=antenna)["time_gpst"].to_numpy()) == np.timedelta64(0, "ns")).any():
            raise InputFileError(file, "has an antenna twice at one time; expected one row per epoch and antenna")
    return file, rows


def _table(file: Path, columns: cs.Selector | None) -> pl.DataFrame:
    if file.suffix == ".parquet":
        table = read_parquet(file, columns=columns)
    else:
        with reading_table(file):
            table = pl.read_csv(file, schema_overrides={"time_gpst": pl.Datetime("ns")}, infer_schema_length=None)
            table = table if columns is None else table.select(columns)
    numbers = [
        name
        for name, kind in table.schema.items()
        if kind != pl.Float64 and (name.endswith("_m") or name in ("n_used", "n_rejected"))
    ]
    try:
        return table.with_columns(
            pl.col(numbers).cast(pl.Float64),
            pl.col("antenna", "status").cast(pl.String),
            pl.col("time_gpst").cast(pl.Datetime("ns")),
        )
    except PolarsError as error:
        raise InputFileError(file, f"is not a table of positions ({str(error).splitlines()[0]})") from error


def floats(table: pl.DataFrame, name: str) -> Floats:
    """A column as numbers, NaN where it is null or the table has no such column."""
    if name not in table.columns:
        return np.full(len(table), np.nan)
    return table[name].cast(pl.Float64).fill_null(float("nan")).to_numpy()
