"""Inputs of a report: results folders of runs, and the errors of runs with a reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import polars as pl
import polars.selectors as cs

from railfix.core.errors import InputFileError, RailfixError, SettingsError
from railfix.core.tables import reading_table
from railfix.evaluate import Evaluation, EvaluationOptions, RunAndReference, evaluate_runs
from railfix.evaluate.evaluation import EvaluatedRun, short_names
from railfix.evaluate.evaluation_inputs import (
    NO_MORE,
    POSITIONS_TABLE,
    RunFolder,
    list_position_tables,
    read_run,
    read_table,
)
from railfix.evaluate.place import read_run_track
from railfix.pipeline.config import Config
from railfix.ranges.cn0_curve import Cn0Curve
from railfix.ranges.cn0_curve_file import read_cn0_curve
from railfix.screens import SCREENS
from railfix.track import Track

_OBSERVATIONS: Final = "observations.parquet"
_NEEDED: Final = {"time_gpst", "antenna", "satellite", "signal", "reason", "elevation_deg", "azimuth_deg", "cn0_dbhz"}
#: Columns of the table ``positions`` that the report reads in addition to the required columns.
_POSITIONS: Final = cs.contains("protection_level", "protection_status", "protection_cause", "_fault") | cs.by_name(
    "kilometrage_m", "n_rejected", "raim_statistic", "raim_threshold", "raim_level_m", "protection_kind",
    *(column.name for screen in SCREENS for column in screen.columns if column.table == "positions"),
    require_all=False,
)  # fmt: skip
#: Columns of the table ``train`` (filter) that the report reads.
_TRAIN: Final = ("time_gpst", "antenna", "x_m", "y_m", "z_m", "along_sigma_m")
#: Columns of the table of errors that the report reads.
_ERRORS: Final = (
    "time_gpst", "antenna", "status", "observed", "in_reference", "reference_good", "chainage_m", "environment",
    "n_used", "positioned", "conventional_positioned", "error_m", "conventional_error_m", "along_sigma_m",
    "interval_m", "conventional_interval_m",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ReportedRun:
    """Run with the data for its part of the report."""

    name: str  #: Name of the folder, with as many parent folders as needed to distinguish the runs.
    folder: RunFolder
    config: Config  #: Settings that the run used.
    observations: pl.LazyFrame | None  #: Table of observations; None if the run wrote none.
    #: Errors and protection levels per epoch (columns of `railfix.evaluate.EPOCH_COLUMNS`): `errors` of the
    #: single-epoch positions, `filtered` of the filter along the track. Both are None without a reference; `filtered`
    #: is also None if the filter was off.
    errors: pl.DataFrame | None
    filtered: pl.DataFrame | None
    train: pl.DataFrame | None  #: Times, positions and sigmas of the filter; None if the filter was off.
    reference: str  #: Path of the reference; "" if there is none.
    conventional: Path | None  #: Folder of another run whose conventional positions are shown; None for this run's own.
    track: Track | None  #: Track of the run; None if its files cannot be read.
    curve: Cn0Curve | None  #: C/N0 curve of the run; None if the run used no curve, or the curve cannot be read.
    notes: tuple[str, ...]  #: Notes of the report on the run, in addition to the notes of the run itself.

    def name_in(self, evaluation: Evaluation, table: str = POSITIONS_TABLE) -> str:
        """Return the name of a position table of this run in an evaluation; "" if the evaluation lacks the table."""
        mine = (run for run in evaluation.runs if run.path.resolve() == self.folder.path.resolve())
        return next((run.name for run in mine if run.table == table), "")

    @property
    def record(self) -> Mapping[str, Any]:
        """Content of ``run.json``."""
        return self.folder.record

    def get_positions(self, antenna: str) -> pl.DataFrame:
        """Return the single-epoch positions of one antenna in order of time."""
        return self.folder.positions.filter(antenna=antenna)

    def get_errors(self, antenna: str) -> pl.DataFrame | None:
        """Return the errors of the single-epoch positions of one antenna; None without a reference."""
        return None if self.errors is None else self.errors.filter(antenna=antenna)

    def filter_rows(self, antenna: str) -> pl.DataFrame | None:
        """Return the errors of the filter for one antenna; None without a reference, or if the filter was off."""
        return None if self.filtered is None else self.filtered.filter(antenna=antenna)

    def get_train(self, antenna: str) -> pl.DataFrame | None:
        """Return the positions of the filter for one antenna; None if the filter was off."""
        return None if self.train is None else self.train.filter(antenna=antenna)


def get_figures(
    evaluation: Evaluation, run: ReportedRun, antenna: str, position: str, table: str = POSITIONS_TABLE
) -> dict[str, Any]:
    """Return the figures of merit of one antenna and kind of position; an empty dictionary if there are none."""
    name = run.name_in(evaluation, table)
    rows = evaluation.figures.filter(grouping="all", epochs_of="own", run=name, antenna=antenna, position=position)
    return rows.row(0, named=True) if len(rows) == 1 else {}


def read_runs(
    paths: Sequence[Path],
    references: Sequence[Path] = (),
    *,
    conventional: Sequence[Path] = (),
    options: EvaluationOptions | None = None,
) -> tuple[tuple[ReportedRun, ...], Evaluation | None]:
    """Read runs, and evaluate them if there are references; without references the evaluation is None.

    `references` is empty, or has one reference for all runs, or one for each run in order. `conventional` is empty, or
    has, for each run in order, another run on the same log whose conventional positions are shown instead; for the
    unscreened positions of paper P1, a run with only the elevation and C/N0 screens. The table of epochs in the
    evaluation is empty; the report takes the values of the epochs from the returned runs instead.

    Raise InputFileError if a file is missing or malformed. Raise MismatchError if a reference does not match the run.
    Raise SettingsError if there is no run, the number of references or conventional runs is wrong, or a run is given
    twice.
    """
    if not paths:
        raise SettingsError("no run to report on; give the folders written by railfix run")
    if len(references) not in (0, 1, len(paths)):
        raise SettingsError(
            f"{len(references)} references for {len(paths)} runs; give one for all runs, or one for each in order"
        )
    if len(conventional) not in (0, len(paths)):
        raise SettingsError(f"{len(conventional)} conventional runs for {len(paths)} runs; give one for each, or none")
    resolved = [path.resolve() for path in paths]
    if len(set(resolved)) < len(resolved):
        twice = next(path for path in resolved if resolved.count(path) > 1)
        raise SettingsError(f"{twice}: the run is given twice; give each run once")
    beside: Sequence[Path | None] = conventional or [None] * len(paths)
    evaluation = None
    if references:
        each = references if len(references) == len(paths) else [references[0]] * len(paths)
        evaluation = evaluate_runs(
            [
                RunAndReference(run=path, reference=reference, table=table, conventional=other)
                for path, reference, other in zip(paths, each, beside, strict=True)
                for table in list_position_tables(path) or [POSITIONS_TABLE]
            ],
            options=options,
        )
    evaluated: dict[tuple[Path, str], tuple[EvaluatedRun, pl.DataFrame]] = {}
    if evaluation is not None:
        for run in evaluation.runs:
            used = evaluation.epochs.lazy().filter(run=run.name)
            epochs = used.select(*_ERRORS, cs.contains("protection_level", "protection_status")).collect()
            evaluated[run.path.resolve(), run.table] = run, epochs
        evaluation = replace(evaluation, epochs=evaluation.epochs.clear())
    reported = tuple(
        _report(
            name,
            read_run(path, conventional=other, columns=_POSITIONS),
            {table: evaluated[own, table] for table in list_position_tables(path) if (own, table) in evaluated},
            other,
        )
        for name, path, own, other in zip(short_names(resolved), paths, resolved, beside, strict=True)
    )
    return reported, evaluation


def _report(
    name: str, folder: RunFolder, evaluated: Mapping[str, tuple[EvaluatedRun, pl.DataFrame]], conventional: Path | None
) -> ReportedRun:
    config = folder.config
    curve, notes = _curve(folder, config)
    track, track_notes = _track(folder)
    notes += track_notes
    facts, errors = evaluated.get(POSITIONS_TABLE, (None, None))
    if facts is not None:
        notes += facts.notes
    train = "train" in list_position_tables(folder.path)
    return ReportedRun(
        name=name,
        folder=folder,
        config=config,
        observations=_observations(folder.path / _OBSERVATIONS),
        errors=errors,
        filtered=evaluated["train"][1] if "train" in evaluated else None,
        train=read_table(folder.path, "train", columns=NO_MORE)[1].select(_TRAIN) if train else None,
        reference="" if facts is None else facts.reference,
        conventional=conventional,
        track=track,
        curve=curve,
        notes=notes,
    )


def _observations(path: Path) -> pl.LazyFrame | None:
    if not path.is_file():
        return None
    with reading_table(path):
        table = pl.scan_parquet(path)
        columns = set(table.collect_schema())
    if missing := sorted(_NEEDED - columns):
        raise InputFileError(path, f"has no column {missing[0]}; run railfix run again with this version")
    return table


def _curve(folder: RunFolder, config: Config) -> tuple[Cn0Curve | None, tuple[str, ...]]:
    """Return the C/N0 curve that the run used, and a note if the curve cannot be read."""
    if config.cn0_curve is None:
        return None, ()
    path = next(iter(folder.input_paths("cn0_curve")), Path(config.cn0_curve))
    try:
        return read_cn0_curve(path), ()
    except RailfixError as error:
        return None, (f"the C/N0 curve over elevation that the run used is not drawn: {error}",)


def _track(folder: RunFolder) -> tuple[Track | None, tuple[str, ...]]:
    """Return the track of the run, and a note if the track cannot be read."""
    try:
        return read_run_track(folder), ()
    except RailfixError as error:
        return None, (f"the line is drawn through the positions, because the track cannot be read: {error}",)
