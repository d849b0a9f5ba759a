"""The folder of a run, read back: positions, what they were made from, where those files are now."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl
from polars.exceptions import PolarsError

from railfix.core.errors import InputFileError
from railfix.pipeline.protection_levels import KINDS

#: Columns of the positions without which there is nothing to evaluate.
NEEDED: Final = (
    "time_gpst", "antenna", "status", "chainage_m", "along_sigma_m", "x_m", "y_m", "z_m", "n_used",
    "conventional_chainage_m", "conventional_x_m", "conventional_y_m", "conventional_z_m",
)  # fmt: skip


#: Of protection levels whose run does not tell what they rest on.
UNKNOWN_KIND: Final = "unknown"


@dataclass(frozen=True, kw_only=True)
class RunFolder:
    """A run as it was written.

    Attributes
    ----------
    path : Path
    positions_path : Path
        ``positions.parquet``, or ``positions.csv`` where that is absent.
    positions : polars.DataFrame
        One row an epoch and antenna, see `railfix.pipeline.tables.POSITION_COLUMNS`.
    record : mapping
        ``run.json``.
    """

    path: Path
    positions_path: Path
    positions: pl.DataFrame
    record: Mapping[str, Any]

    @property
    def antennas(self) -> list[str]:
        """In the order of the rows."""
        return [str(name) for name in self.positions["antenna"].unique(maintain_order=True)]

    @property
    def chainage_of(self) -> Mapping[str, str]:
        """The point of the vehicle whose chainage is given, by antenna."""
        return dict(self._line.get("chainage_of") or {})

    @property
    def line_name(self) -> str:
        """Name of the track."""
        return str((self._line.get("track") or {}).get("name") or "unnamed line")

    @property
    def track_facts(self) -> Mapping[str, Any]:
        """How the run had read its track."""
        return dict(self._line.get("track") or {})

    @property
    def settings(self) -> dict[str, Any]:
        """Settings in force, and which kinds of input there were, by dotted name."""
        flat = flattened(self.record.get("settings_used") or {})
        kinds = {str(entry["input"]) for entry in self.record.get("inputs", ())}
        return flat | {f"input {kind}": "given" for kind in sorted(kinds - {"front", "nav", "track", "config"})}

    @property
    def protection(self) -> Mapping[str, Any]:
        """What the protection levels rest on; empty where they were off or the run tells nothing."""
        found = self.record.get("protection")
        return found if isinstance(found, Mapping) else {}

    @property
    def level_kind(self) -> str | None:
        """What the protection levels rest on in a word, `UNKNOWN_KIND` where the run does not tell; None without.

        Raises
        ------
        InputFileError
            Positions and record tell different kinds.
        """
        level = "protection_level_m"
        if level not in self.positions.columns or self.positions[level].null_count() == len(self.positions):
            return None if not self.protection else self._kind
        return self._kind

    @property
    def _kind(self) -> str:
        told = {self.protection.get("kind")}
        if "protection_kind" in self.positions.columns:
            told |= set(self.positions["protection_kind"].cast(pl.String).unique())
        known = [kind for kind in KINDS if kind in told]
        if len(known) > 1:
            raise InputFileError(
                self.positions_path,
                f"its protection_kind and that of run.json are both {' and '.join(known)}; expected one kind in a run",
            )
        return known[0] if known else UNKNOWN_KIND

    @property
    def alarm_limit_m(self) -> float | None:
        """Alarm limit of the run [m].

        Raises
        ------
        InputFileError
            It is no positive number.
        """
        limit = self.protection.get("alarm_limit_m")
        if limit is None:
            return None
        if isinstance(limit, bool) or not isinstance(limit, int | float) or not 0.0 < limit < float("inf"):
            raise InputFileError(
                self.path / "run.json", f"protection.alarm_limit_m is {limit!r}; a positive number was expected"
            )
        return float(limit)

    def column_of(self, name: str) -> str:
        """Name of a column of the positions in tables of several runs: levels say what they rest on."""
        return f"{self.level_kind}_{name}" if name.startswith("protection_") and self.level_kind else name

    @property
    def _line(self) -> Mapping[str, Any]:
        return self.record.get("line") or {}

    def inputs(self, kind: str) -> list[Mapping[str, Any]]:
        """Entries of ``run.json`` on one kind of input, in order."""
        return [entry for entry in self.record.get("inputs", ()) if entry["input"] == kind]

    def located(self, kind: str) -> list[Path]:
        """Where the files of one kind of input are now; as recorded where they are not found.

        A relative path was written from another working folder, perhaps: it is looked for there, from
        the run's folder, and from the one above it.
        """
        return [self._locate(Path(entry["path"])) for entry in self.inputs(kind)]

    def _locate(self, path: Path) -> Path:
        places = [path] if path.is_absolute() else [path, self.path / path, self.path.parent / path]
        return next((place for place in places if place.is_file()), path)


def flattened(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted name; lists as words."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat |= flattened(value, f"{name}.")
        else:
            flat[name] = " ".join(str(v) for v in value) if isinstance(value, list | tuple) else value
    return flat


def read_run(path: Path) -> RunFolder:
    """Read the folder that `railfix run` wrote.

    Raises
    ------
    InputFileError
        No such folder, or its files are missing or not what they should be.
    """
    if not path.is_dir():
        what = "is a file" if path.exists() else "there is no such folder"
        raise InputFileError(path, f"{what}, expected the folder that railfix run wrote; name that")
    parquet, text = path / "positions.parquet", path / "positions.csv"
    file = parquet if parquet.is_file() else text
    if not file.is_file():
        raise InputFileError(path, "holds neither positions.parquet nor positions.csv; name a folder of railfix run")
    positions = _positions(file)
    missing = [name for name in NEEDED if name not in positions.columns]
    if missing:
        raise InputFileError(file, f"has no column {missing[0]}; expected the positions of railfix run")
    if not len(positions):
        raise InputFileError(file, "has no rows; there is nothing to evaluate")
    if positions.select(pl.struct("antenna", "time_gpst").is_duplicated().any()).item():
        raise InputFileError(file, "has an antenna twice at one time; expected one row an epoch and antenna")
    return RunFolder(
        path=path,
        positions_path=file,
        positions=positions.sort("time_gpst", maintain_order=True),
        record=_record(path / "run.json"),
    )


def _positions(file: Path) -> pl.DataFrame:
    try:
        if file.suffix == ".parquet":
            table = pl.read_parquet(file)
        else:
            table = pl.read_csv(file, schema_overrides={"time_gpst": pl.Datetime("ns")}, infer_schema_length=None)
    except (PolarsError, OSError) as error:
        told = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputFileError(file, f"cannot be read as a table ({told}); run railfix run again") from error
    numbers = [
        name for name in table.columns if name in NEEDED[3:8] or name.endswith("_m") or name in ("n_used", "n_rejected")
    ]
    try:
        table = table.with_columns(
            pl.col(numbers).cast(pl.Float64),
            pl.col("antenna", "status").cast(pl.String),
            pl.col("time_gpst").cast(pl.Datetime("ns")),
        )
    except PolarsError as error:
        raise InputFileError(file, f"is no table of positions ({str(error).splitlines()[0]})") from error
    return table


def _record(file: Path) -> Mapping[str, Any]:
    try:
        record = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputFileError(file, "there is no such file; railfix run writes it beside the positions") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputFileError(file, f"cannot be read as JSON ({error}); run railfix run again") from error
    if not isinstance(record, dict):
        raise InputFileError(file, "is not the record of a run; expected an object")
    return record


def floats(table: pl.DataFrame, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """A column as numbers, null as NaN."""
    return table[name].cast(pl.Float64).fill_null(float("nan")).to_numpy()
