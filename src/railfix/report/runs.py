"""What a report is made from: folders of runs, and their errors where there is a reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from railfix.core.errors import InputFileError, RailfixError, SettingsError
from railfix.evaluate import Evaluation, RunAndReference, evaluate_runs
from railfix.evaluate.run_folder import RunFolder, read_run
from railfix.pipeline.config import Config
from railfix.ranges.cn0_curve import Cn0Curve, read_cn0_curve
from railfix.run.folder import read_parquet


@dataclass(frozen=True, kw_only=True)
class ReportedRun:
    """One run with all that its part of the report shows.

    Attributes
    ----------
    name : str
        The folder's, with as many of those above it as tell the runs apart.
    folder : RunFolder
    config : Config
        Settings that were in force.
    observations : polars.DataFrame or None
        None where the run wrote none.
    errors : polars.DataFrame or None
        `railfix.evaluate.EPOCH_COLUMNS` of this run; None without a reference.
    reference : str
        The file; empty without.
    curve : Cn0Curve or None
    notes : tuple of str
        What the report itself has to say of the run.
    """

    name: str
    folder: RunFolder
    config: Config
    observations: pl.DataFrame | None
    errors: pl.DataFrame | None
    reference: str
    curve: Cn0Curve | None
    notes: tuple[str, ...]

    @property
    def record(self) -> Mapping[str, Any]:
        """``run.json``."""
        return self.folder.record

    def positions_of(self, antenna: str) -> pl.DataFrame:
        """Rows of one antenna in order of time."""
        return self.folder.positions.filter(pl.col("antenna") == antenna)

    def observations_of(self, antenna: str) -> pl.DataFrame | None:
        """Rows of one antenna, None where the run wrote none."""
        return None if self.observations is None else self.observations.filter(pl.col("antenna") == antenna)

    def errors_of(self, antenna: str) -> pl.DataFrame | None:
        """Rows of one antenna, None without a reference."""
        return None if self.errors is None else self.errors.filter(pl.col("antenna") == antenna)


def read_runs(
    paths: Sequence[Path], references: Sequence[Path] = ()
) -> tuple[tuple[ReportedRun, ...], Evaluation | None]:
    """Read runs, and set them against their references.

    Parameters
    ----------
    paths : sequence of Path
        Folders that `railfix run` wrote.
    references : sequence of Path
        None, one for all runs, or one for each in order.

    Returns
    -------
    tuple of ReportedRun
    Evaluation or None
        None without a reference.

    Raises
    ------
    InputFileError, MismatchError
        A file is not what it should be, or a reference is not that of the run.
    SettingsError
        As many references as runs, or one, were expected; or a run is given twice.
    """
    if not paths:
        raise SettingsError("no run to report on; name the folders that railfix run wrote")
    if len(references) not in (0, 1, len(paths)):
        raise SettingsError(
            f"{len(references)} references for {len(paths)} runs; give one for all runs, or one for each in their order"
        )
    whole = [path.resolve() for path in paths]
    if len(set(whole)) < len(whole):
        again = next(path for path in whole if whole.count(path) > 1)
        raise SettingsError(f"{again}: the run is given twice; give each run once")
    folders = [read_run(path) for path in paths]
    evaluation = None
    if references:
        each = references if len(references) == len(paths) else [references[0]] * len(paths)
        pairs = [RunAndReference(run=run, reference=ref) for run, ref in zip(paths, each, strict=True)]
        evaluation = evaluate_runs(pairs)
    names = _names(whole)
    return tuple(_reported(name, folder, evaluation) for name, folder in zip(names, folders, strict=True)), evaluation


def _reported(name: str, folder: RunFolder, evaluation: Evaluation | None) -> ReportedRun:
    config = folder.config
    curve, notes = _curve(folder, config)
    errors, reference = None, ""
    if evaluation is not None:
        mine = next(run for run in evaluation.runs if run.path.resolve() == folder.path.resolve())
        errors = evaluation.epochs.filter(pl.col("run") == mine.name)
        reference = mine.reference
        notes += mine.notes
    return ReportedRun(
        name=name,
        folder=folder,
        config=config,
        observations=_observations(folder.path / "observations.parquet"),
        errors=errors,
        reference=reference,
        curve=curve,
        notes=notes,
    )


def _observations(path: Path) -> pl.DataFrame | None:
    if not path.is_file():
        return None
    table = read_parquet(path)
    needed = {"time_gpst", "antenna", "satellite", "signal", "reason", "elevation_deg", "azimuth_deg", "cn0_dbhz"}
    if lacking := sorted(needed - set(table.columns)):
        raise InputFileError(path, f"has no column {lacking[0]}; run again with this railfix")
    return table


def _curve(folder: RunFolder, config: Config) -> tuple[Cn0Curve | None, tuple[str, ...]]:
    """The curve that the run used, or a note on why it is not drawn."""
    if config.cn0_curve is None:
        return None, ()
    path = next(iter(folder.located("cn0_curve")), Path(config.cn0_curve))
    try:
        return read_cn0_curve(path), ()
    except RailfixError as error:
        return None, (f"the curve of C/N0 over elevation that the run used is not drawn: {error}",)


def _names(paths: Sequence[Path]) -> list[str]:
    depth = 1
    while len({path.parts[-depth:] for path in paths}) < len(paths):
        depth += 1
    return ["/".join(path.parts[-depth:]) for path in paths]
