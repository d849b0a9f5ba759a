"""Inputs of an evaluation: settings, and the folder of a run with its tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
import polars as pl
import polars.selectors as cs
from polars.exceptions import PolarsError
from pydantic import AfterValidator, Field

from railfix.core.arrays import Floats, Strings
from railfix.core.errors import InputFileError, MismatchError
from railfix.core.options import option
from railfix.core.reasons import Status
from railfix.core.settings import INPUTS, Settings
from railfix.core.tables import reading_table
from railfix.pipeline.level_stage import KINDS
from railfix.run.inputs import ColumnNames
from railfix.run.record import RunRecord, read_parquet, read_record

#: Columns that every table of positions must have.
NEEDED: Final = ("time_gpst", "antenna", "status", "chainage_m", "along_sigma_m", "x_m", "y_m", "z_m")
#: Selector of no further column: only the columns `NEEDED` are read.
NO_MORE: Final = ~cs.all()
#: Columns of the conventional position.
CONVENTIONAL: Final = ("conventional_chainage_m", "conventional_x_m", "conventional_y_m", "conventional_z_m")
#: Name of the table of single-epoch positions; its columns `SINGLE_EPOCH` are added to the filter's table ``train``.
POSITIONS_TABLE: Final = "positions"
TABLES: Final = (POSITIONS_TABLE, "train")
SINGLE_EPOCH: Final = ("n_used", *CONVENTIONAL)
#: Kind of protection levels if neither the positions nor ``run.json`` state it.
UNKNOWN_KIND: Final = "unknown"
_KEYS: Final = ("time_gpst", "antenna")
_ENDINGS: Final = (".parquet", ".csv")


@dataclass(frozen=True, kw_only=True)
class RunFolder(RunRecord):
    """Record of a run, with one of its tables of positions."""

    positions_path: Path  #: Parquet file of the table, or its CSV file if there is no Parquet file.
    #: One row per epoch and antenna, see `railfix.pipeline.result_columns.POSITION_COLUMNS`; ``observed`` is true where
    #: the antenna has observations.
    positions: pl.DataFrame
    table: str = POSITIONS_TABLE  #: Name of the table: "positions" (single epochs) or "train" (filter).

    @property
    def antennas(self) -> list[str]:
        """Names of the antennas in the order of their first rows."""
        return [str(name) for name in self.positions["antenna"].unique(maintain_order=True)]

    @property
    def chainage_of(self) -> Mapping[str, str]:
        """Point of the train to which each antenna's chainage refers, such as "antenna"; empty if not recorded."""
        return dict(self._line.get("chainage_of") or {})

    def turn_m(self, antenna: str) -> float:
        """Return the length of a closed line, measured in an antenna's chainage [m]; infinity for an open or unrecorded
        line.
        """
        turn = (self._line.get("turn_m") or {}).get(antenna)
        return float("inf") if turn is None else float(turn)

    @property
    def line_name(self) -> str:
        """Name of the track, or "unnamed line"."""
        return str(self.track_facts.get("name") or "unnamed line")

    @property
    def track_facts(self) -> Mapping[str, Any]:
        """Entry of ``run.json`` on the track that the run used; empty if not recorded."""
        return dict(self._line.get("track") or {})

    @property
    def track_options(self) -> Mapping[str, Any]:
        """Options with which the run read its track, such as ``height_datum``; empty if not recorded."""
        return dict((self.record.get("options") or {}).get("track") or {})

    @property
    def tracks(self) -> list[Path]:
        """Files of the track: ``track.csv`` of the folder if the run changed the track, otherwise the input files."""
        name = self.track_facts.get("file")
        return [self.path / str(name)] if name else self.input_paths("track")

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that the run used, by dotted name, and one entry for each optional kind of input that it used."""
        flat = flat_settings(self.record.get("settings_used") or {})
        kinds = {str(entry["input"]) for entry in self.entries}
        return flat | {f"input {kind}": "given" for kind in sorted(kinds - {"front", "nav", "track", "config"})}

    @property
    def protection(self) -> Mapping[str, Any]:
        """Assumptions of the protection levels; empty if the run has no protection levels."""
        assumptions = self.record.get("protection")
        return assumptions if isinstance(assumptions, Mapping) else {}

    @property
    def level_kind(self) -> str | None:
        """Kind of the protection levels; `UNKNOWN_KIND` if it is not recorded, None if there are no protection levels.

        Raise InputFileError if positions and ``run.json`` state different kinds.
        """
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
        """Alarm limit of the run [m], None if not recorded; raise InputFileError if it is not a positive number."""
        limit = self.protection.get("alarm_limit_m")
        if limit is None:
            return None
        if isinstance(limit, bool) or not isinstance(limit, int | float) or not 0.0 < limit < float("inf"):
            raise InputFileError(
                self.path / "run.json", f"protection.alarm_limit_m is {limit!r}; a positive number was expected"
            )
        return float(limit)

    def prefix_column(self, name: str) -> str:
        """Return a column's name in tables of several runs; columns of protection levels have their kind as prefix."""
        return f"{self.level_kind}_{name}" if name.startswith("protection_") and self.level_kind else name

    @property
    def _line(self) -> Mapping[str, Any]:
        return self.record.get("line") or {}


def flat_settings(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings by dotted name; a list becomes text with spaces between its elements."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat |= flat_settings(value, f"{name}.")
        else:
            flat[name] = " ".join(str(v) for v in value) if isinstance(value, list | tuple) else value
    return flat


def list_position_tables(path: Path) -> list[str]:
    """Return the names of the tables of positions in the folder of a run, the single-epoch positions first."""
    return [name for name in TABLES if any((path / f"{name}{end}").is_file() for end in _ENDINGS)]


def read_run(
    path: Path, *, table: str = POSITIONS_TABLE, conventional: Path | None = None, columns: cs.Selector | None = None
) -> RunFolder:
    """Read the record and one table of positions from a folder that `railfix run` wrote.

    `columns` selects columns in addition to the required columns; by default all columns are read. `conventional` is
    the folder of another run on the same log; its conventional positions replace the run's own.

    Raise InputFileError if a file is missing or the table is not as expected, MismatchError if `conventional` is
    a run on another log.
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
        of_run, of_other = (_log_hashes(entries) for entries in (record, other.record))
        if of_run != of_other:
            raise MismatchError(
                f"{conventional}: is not a run on the log of {path}; give a run with the same observations"
            )
        unscreened = other.positions.select(*_KEYS, *CONVENTIONAL)
        rows = rows.drop(CONVENTIONAL).join(unscreened, on=_KEYS, how="left", maintain_order="left")
    return RunFolder(path=path, positions_path=file, positions=rows, record=record, table=table)


def _log_hashes(record: Mapping[str, Any]) -> list[str]:
    logs = [entry for entry in record.get("inputs", ()) if entry["input"] in ("front", "rear")]
    return sorted(str(entry.get("sha256")) for entry in logs)


def read_table(
    path: Path, name: str, needed: Sequence[str] = NEEDED, columns: cs.Selector | None = None
) -> tuple[Path, pl.DataFrame]:
    """Read one table of a run; return its file and its rows in order of time.

    Raise InputFileError if the file or a `needed` column is missing, if there are no rows, or if an antenna has several
    rows at the same time.
    """
    file = next((path / f"{name}{end}" for end in _ENDINGS if (path / f"{name}{end}").is_file()), None)
    if file is None:
        raise InputFileError(path, f"contains neither {name}.parquet nor {name}.csv; give a folder of railfix run")
    rows = _table(file, None if columns is None else cs.by_name(*needed, require_all=False) | columns)
    missing = [column for column in needed if column not in rows.columns]
    if missing:
        raise InputFileError(file, f"has no column {missing[0]}; expected the table {name} that railfix run wrote")
    if not len(rows):
        raise InputFileError(file, "has no rows; there is nothing to evaluate")
    rows = rows if rows["time_gpst"].is_sorted() else rows.sort("time_gpst", maintain_order=True)
    if rows.select("antenna", "time_gpst").drop_nulls().is_duplicated().any():
        raise InputFileError(file, "has two rows of one antenna at one epoch; expected one row per epoch and antenna")
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
    """Return a column as numbers; NaN where the column is null, and everywhere if the table lacks the column."""
    if name not in table.columns:
        return np.full(len(table), np.nan)
    return table[name].cast(pl.Float64).fill_null(float("nan")).to_numpy()


def words(table: pl.DataFrame, name: str) -> Strings:
    """Return a column as text; blank where the column is null, and everywhere if the table lacks the column."""
    if name not in table.columns:
        return np.full(len(table), "")
    return np.array(table[name].cast(pl.String).fill_null("").to_numpy(), dtype=np.str_)


Method = Literal["chainage", "trajectory"]

#: The reference is interpolated between two of its positions if they are at most this time apart [s].
LARGEST_GAP_S: Final = 2.5
#: Durations of the windows for continuity [s]: 15 s is used for an approach in aviation, 60 s for a journey between two
#: stations.
WINDOWS_S: Final = (15.0, 60.0)


def _rising(edges: tuple[float, ...]) -> tuple[float, ...]:
    """Return the edges unchanged; raise ValueError if they do not increase strictly."""
    if any(high <= low for low, high in pairwise(edges)):
        raise ValueError("rising numbers expected")
    return edges


Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
RisingEdges = Annotated[tuple[Positive, ...], Field(min_length=1), AfterValidator(_rising)]


class EvaluationInputs(Settings):
    """Files of an evaluation, other than the folders of the runs, and names of the configurations."""

    reference: tuple[str, ...] = option(
        "File of reference positions (reference.csv, truth.csv, .gz, RTKLIB), one for all runs, or one for each run "
        "in order; `auto` uses truth.csv or reference.csv in the folder of each run's log.",
        metavar="FILE",
        panel=INPUTS,
    )
    table: tuple[str, ...] = option(
        "Table of positions: `positions` (single epochs) or `train` (filter along the track); may be repeated. By "
        "default, every table of the run is evaluated.",
        (),
        metavar="NAME",
        panel=INPUTS,
    )
    conventional: Path | None = option(
        "Folder of another run on the same log; its conventional positions replace those of the run. A run with "
        "`--screens elevation` provides unscreened positions, as in paper P1.",
        None,
        metavar="RUN",
        panel=INPUTS,
    )
    sections: Path | None = option(
        "CSV file of the environment by chainage (from_m,to_m,environment), used where the reference states none.",
        None,
        metavar="CSV",
        panel=INPUTS,
    )
    label: tuple[str, ...] = option(
        "Name of a run's configuration; repeat the option for each run in order. By default made from the settings.",
        (),
        metavar="TEXT",
    )


class EvaluationOptions(Settings):
    """Settings of an evaluation."""

    method: Literal["auto", "chainage", "trajectory"] = option(
        "Computation of the errors: chainage (differences of chainage), trajectory (along the trajectory from the "
        "reference position), or auto (chainage where run and reference share a map).",
        "auto",
    )
    reference_sigma_m: Positive = option(
        "Reference positions with a larger standard deviation are not used.", 0.5, name="--reference-sigma", metavar="M"
    )
    reference_quality: tuple[int, ...] = option(
        "Quality numbers of the reference positions to use, if the log has quality numbers (RTKLIB: 1 fix, 2 float, "
        "5 single).",
        (1,),
        name="--reference-quality",
        metavar="Q,...",
    )
    columns: ColumnNames = Field(default_factory=ColumnNames)
    reference_gap_s: Positive = option(
        "The reference is not interpolated in longer gaps.", LARGEST_GAP_S, name="--reference-gap", metavar="S"
    )
    standing_mps: Positive = option(
        "Speed below which the train counts as stationary.", 0.3, name="--standing", metavar="M/S"
    )
    section_m: Positive = option("Length of the sections of the line.", 1000.0, name="--section-length", metavar="M")
    speed_edges_kmh: RisingEdges = option(
        "Limits between the speed classes.", (20.0, 60.0, 100.0), name="--speed-classes", metavar="KMH,..."
    )
    alarm_limits_m: tuple[Positive, ...] = option(
        "Alarm limits with which protection levels are compared, in addition to the alarm limit of the run.",
        (10.0, 20.0, 40.0),
        name="--alarm-limit",
        metavar="M,...",
    )
    block_s: Positive = 60.0  #: Length of the time blocks that are resampled for confidence limits.
    replicates: int = Field(default=1000, ge=1)  #: Number of bootstrap samples for the confidence limits.
    seed: int = option("Seed of the random numbers of the confidence limits.", 0, metavar="N", ge=0)
    confidence: float = Field(default=0.95, gt=0.0, lt=1.0)  #: Confidence level of the limits, between 0 and 1.
