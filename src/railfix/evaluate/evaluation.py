"""Evaluation of one run or of several runs against reference trajectories."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import polars as pl
import polars.selectors as cs

from railfix.core.errors import InputFileError, MismatchError, SettingsError, check_type
from railfix.core.files import fingerprint
from railfix.core.notebook import NotebookTable
from railfix.evaluate.accuracy import ALL, KEYS, USED, figures_by
from railfix.evaluate.epoch_table import antenna_epochs, below
from railfix.evaluate.evaluation_inputs import (
    NO_MORE,
    POSITIONS_TABLE,
    TABLES,
    UNKNOWN_KIND,
    EvaluationOptions,
    RunFolder,
    read_run,
)
from railfix.evaluate.integrity import Integrity, Level, judge_levels
from railfix.evaluate.intervals import branch_table, interval_table, level_table, outage_table
from railfix.evaluate.place import TrackFiles
from railfix.io.reference_log import AntennaReference, read_reference
from railfix.io.sections import read_sections

#: File names under which a reference is searched for in the folder of a run's log.
BESIDE_THE_LOG: Final = ("truth.csv", "truth.csv.gz", "reference.csv", "reference.csv.gz")
#: Columns read from a table of positions, if present, in addition to the columns that every table must have.
_COLUMNS: Final = cs.by_name("branch_probability", "sources", require_all=False) | cs.contains("protection_")
_FACTS: Final = ("speed_from", "outside", "step_s")
#: Offset between the block numbers of successive runs, so that each block number is unique.
_BLOCKS_APART: Final = 10**9

Reference = Path | Mapping[str, AntennaReference] | None


@dataclass(frozen=True, kw_only=True)
class RunAndReference:
    """Table of positions of a run, and the reference trajectory of the run."""

    run: Path  #: Folder that `railfix run` wrote.
    #: Reference file, or reference trajectories by antenna. If None, the folder of the run's log must have a file with
    #: one of the names `BESIDE_THE_LOG`.
    reference: Reference = None
    configuration: str | None = None  #: Name of the configuration; if None, a name is made from the settings.
    table: str = POSITIONS_TABLE  #: Table of positions (`railfix.evaluate.evaluation_inputs.list_position_tables`).
    #: Folder of another run on the same log; its conventional positions replace those of `run`. In the comparison of
    #: paper P1, the other run uses only the elevation and C/N0 screens.
    conventional: Path | None = None


@dataclass(frozen=True, kw_only=True)
class EvaluatedRun:
    """Evaluated run: its names in the tables, the reference, the methods and the inputs."""

    name: str
    configuration: str
    line: str
    path: Path
    table: str  #: Name of the table of positions that was evaluated.
    reference: str  #: File of the reference, or "given" for arrays.
    method: Mapping[str, str]  #: Method by which the errors of each antenna were computed: "chainage" or "trajectory".
    speed_from: Mapping[str, str]  #: Source of the speed by antenna: "reference" or "places".
    outside: Mapping[str, int]  #: Number of epochs of the log that the reference does not cover, by antenna.
    step_s: Mapping[str, float]  #: Median interval between the epochs of the log, by antenna.
    protection: Mapping[str, Any]  #: Basis of the protection levels, from ``run.json``.
    settings: Mapping[str, Any]
    inputs: tuple[Mapping[str, Any], ...]  #: Files that were read, with size and hash.
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, repr=False)
class Evaluation(NotebookTable):
    """Evaluation of runs against reference trajectories."""

    runs: tuple[EvaluatedRun, ...]
    epochs: pl.DataFrame  #: One row per epoch, antenna and run: `EPOCH_COLUMNS`, then protection levels.
    figures: pl.DataFrame  #: Error statistics of every grouping: `FIGURE_COLUMNS`.
    intervals: pl.DataFrame  #: Intervals between positions: `INTERVAL_COLUMNS`.
    #: Statistics of the protection levels: `LEVEL_COLUMNS`; None if no run has a protection level.
    levels: pl.DataFrame | None
    integrity: Mapping[str, Integrity]  #: Comparison of protection levels with errors, by kind of protection level.
    #: Stretches without satellites: `OUTAGE_COLUMNS`; None without a table of the filter along the track.
    outages: pl.DataFrame | None
    #: Statistics of the branch probabilities: `BRANCH_COLUMNS`; None without a table of the filter along the track.
    branches: pl.DataFrame | None
    options: EvaluationOptions
    inputs: tuple[Mapping[str, Any], ...] = ()  #: Files of all runs, with size and hash.

    def figure(self, name: str, **where: str) -> Any:
        """Return the value in column `name` of one row of `figures`; `where` selects the row by values of columns.

        The defaults are `grouping` "all", `epochs_of` "own" and `position` "constrained". Raise LookupError unless
        exactly one row has these values.
        """
        chosen = {"grouping": ALL, "epochs_of": "own", "position": "constrained"} | where
        rows = self.figures.filter(*(pl.col(key) == value for key, value in chosen.items()))
        if len(rows) != 1:
            words = rows.select(pl.selectors.string())
            several = {key: words[key].unique().sort().to_list() for key in words.columns if words[key].n_unique() > 1}
            raise LookupError(
                f"{len(rows)} rows of figures have {chosen}, expected 1{f'; give one of {several}' if several else ''}"
            )
        return rows[name].item()


def evaluate_run(
    run: Path | str,
    reference: Reference | str = None,
    *,
    sections: Path | None = None,
    files: TrackFiles | None = None,
    options: EvaluationOptions | None = None,
) -> Evaluation:
    """Evaluate one run against its reference trajectory; parameters and errors are as for `evaluate_runs`."""
    place = Path(reference) if isinstance(reference, str) else reference
    item = RunAndReference(run=Path(run), reference=place)
    return evaluate_runs([item], sections=sections, files=files, options=options)


def evaluate_runs(
    runs: Sequence[RunAndReference],
    *,
    sections: Path | None = None,
    files: TrackFiles | None = None,
    options: EvaluationOptions | None = None,
) -> Evaluation:
    """Evaluate runs against their reference trajectories.

    `sections` is a CSV file of the environment by chainage (``from_m,to_m,environment``), used where a reference does
    not state the environment. `files` replaces the track and the vehicle that ``run.json`` names.

    Raise InputFileError if a file is missing or has unexpected content; raise MismatchError if a run and its reference
    do not overlap in time, or the errors cannot be computed as requested; raise SettingsError if no run is given, or a
    run is given twice.
    """
    options, files = options or EvaluationOptions(), files or TrackFiles()
    if not runs:
        raise SettingsError("no run to evaluate; give the folders that railfix run wrote")
    for item in runs:
        check_type(item, RunAndReference, "run to evaluate")
    counts = Counter((item.run.resolve(), item.table) for item in runs)
    twice = [path for (path, _), count in counts.items() if count > 1]
    if twice:
        raise SettingsError(f"{twice[0]}: the run is given twice; give each run once")
    read: dict[tuple[Path, tuple[str, ...]], Mapping[str, AntennaReference]] = {}
    parts = [_evaluate(item, read, sections=sections, files=files, options=options) for item in runs]
    read.clear()
    evaluated = _name_runs([run for run, _, _ in parts])
    levels = {run.name: level for run, (_, _, level) in zip(evaluated, parts, strict=True) if level is not None}
    tables = [
        table.with_columns(
            run=pl.lit(run.name),
            configuration=pl.lit(run.configuration),
            line=pl.lit(run.line),
            block=pl.col("block") + number * _BLOCKS_APART,
        )
        for number, (run, (_, own, _)) in enumerate(zip(evaluated, parts, strict=True))
        for table in own
    ]
    del parts
    epochs = below(tables)
    del tables
    return Evaluation(
        runs=tuple(evaluated),
        epochs=epochs,
        figures=_figures(epochs, options),
        intervals=_intervals(epochs),
        levels=level_table(epochs, list(KEYS)),
        integrity=judge_levels(epochs, levels, options),
        outages=outage_table(epochs),
        branches=branch_table(epochs),
        options=options,
        inputs=tuple({entry["path"]: entry for run in evaluated for entry in run.inputs}.values()),
    )


def _evaluate(
    item: RunAndReference,
    read: dict[tuple[Path, tuple[str, ...]], Mapping[str, AntennaReference]],
    *,
    sections: Path | None,
    files: TrackFiles,
    options: EvaluationOptions,
) -> tuple[EvaluatedRun, list[pl.DataFrame], Level | None]:
    """Evaluate a run; return the unnamed run, the epochs of its antennas, and the kind and alarm limit of its levels.

    References that are read from files are kept in `read`, so that several runs share them.
    """
    folder = read_run(item.run, table=item.table, conventional=item.conventional, columns=_COLUMNS)
    kind = folder.level_kind if "protection_level_m" in folder.positions.columns else None
    inputs = [fingerprint("positions", folder.positions_path), fingerprint("record", folder.path / "run.json")]
    notes = []
    if item.conventional is not None:
        notes.append(f"the conventional positions are taken from {item.conventional}")
        inputs.append(fingerprint("conventional", read_run(item.conventional, columns=NO_MORE).positions_path))
    references, path = _references(item, folder, read, options)
    if path is not None:
        notes += [f"the reference was found next to the log: {path}"] if item.reference is None else []
        inputs.append(fingerprint("reference", path))
    stretches = None
    if sections is not None:
        stretches = read_sections(sections)
        inputs.append(fingerprint("sections", sections))
    antennas = {
        name: antenna_epochs(folder, name, references[name], sections=stretches, files=files, options=options)
        for name in folder.antennas
    }
    used = dict.fromkeys(pair for antenna in antennas.values() for pair in antenna.errors.files)
    entries = [fingerprint(kind, path) for kind, path in used]
    recorded = {entry["sha256"] for entry in folder.record.get("inputs", ())}
    notes += [
        f"{entry['path']}: is not identical to the {entry['input']} file of the run, but gives the same positions"
        for entry in entries
        if entry["sha256"] not in recorded
    ]
    if stretches is not None:
        notes += [
            f"{name}: for {antenna.from_sections} of {int(antenna.table['in_reference'].sum())} epochs, the reference "
            "states no environment; it is taken from the sections"
            for name, antenna in antennas.items()
        ]
    if folder.level_kind == UNKNOWN_KIND:
        notes.append("run.json does not state the basis of the protection levels; their kind is unknown")
    stated = folder.table != POSITIONS_TABLE or "protection_status" in folder.positions.columns
    if folder.level_kind is not None and not stated:
        notes.append("the run has no protection_status: a level counts as usable if the position has status ok")
    notes += [note for antenna in antennas.values() for note in antenna.errors.notes]
    facts = {fact: {name: getattr(antenna, fact) for name, antenna in antennas.items()} for fact in _FACTS}
    run = EvaluatedRun(
        name="",
        configuration=item.configuration or "",
        line=folder.line_name,
        path=folder.path,
        table=folder.table,
        reference="given" if path is None else str(path),
        method={name: antenna.errors.method for name, antenna in antennas.items()},
        **facts,
        protection=folder.protection,
        settings=folder.settings,
        inputs=tuple(inputs + entries),
        notes=tuple(dict.fromkeys(notes)),
    )
    level = None if kind is None else (kind, folder.alarm_limit_m)
    return run, [antenna.table for antenna in antennas.values()], level


def _references(
    item: RunAndReference,
    folder: RunFolder,
    read: dict[tuple[Path, tuple[str, ...]], Mapping[str, AntennaReference]],
    options: EvaluationOptions,
) -> tuple[Mapping[str, AntennaReference], Path | None]:
    """Return the references of a run by antenna, and the path of their file; None as path if arrays were given.

    The content of a file is kept in `read` for further runs. Raise MismatchError if an antenna has no reference, or the
    file is a table of the run itself.
    """
    if isinstance(item.reference, Mapping):
        if missing := [name for name in folder.antennas if name not in item.reference]:
            raise MismatchError(f"{folder.path}: the given references do not include the {missing[0]} antenna; add it")
        return item.reference, None
    path = item.reference or reference_beside(folder)
    if path.resolve().parent == item.run.resolve() and path.name.split(".")[0] in TABLES:
        raise MismatchError(f"{path}: is a table of the run itself; give a reference from an independent measurement")
    key = path, tuple(folder.antennas)
    if key not in read:
        reading = options.columns.arguments
        read[key] = read_reference(path, folder.antennas, quality=options.reference_quality, **reading)
    return read[key], path


def reference_beside(run: RunFolder) -> Path:
    """Return the path of the reference (`BESIDE_THE_LOG`) in the folder of the front antenna's log.

    Raise InputFileError unless the folder has exactly one such file.
    """
    logs = run.input_paths("front")
    if not logs:
        raise InputFileError(run.path / "run.json", "names no log of the front antenna; give the reference file")
    folder = logs[0].parent
    paths = [folder / name for name in BESIDE_THE_LOG if (folder / name).is_file()]
    if not paths:
        raise InputFileError(
            folder, f"has no reference ({', '.join(BESIDE_THE_LOG)}) next to the log of {run.path}; name the file"
        )
    if len(paths) > 1:
        names = " and ".join(path.name for path in paths)
        raise InputFileError(folder, f"has {names} next to the log of {run.path}; name the file to use")
    return paths[0]


def configurations(settings: Sequence[Mapping[str, Any]], given: Sequence[str]) -> list[str]:
    """Return a name for each run's settings: the given label, or the preset and the settings that differ between runs.

    The name of a single run consists of the preset and the screens.
    """
    keys = dict.fromkeys(key for run_settings in settings for key in run_settings)
    differ = [
        key for key in keys if key != "preset" and len({str(run_settings.get(key)) for run_settings in settings}) > 1
    ]
    if len(settings) == 1:
        differ = ["screens"]
    names = []
    for run_settings, label in zip(settings, given, strict=True):
        parts = [f"{key}: {run_settings[key] if run_settings.get(key) not in (None, '') else 'none'}" for key in differ]
        names.append(label or "; ".join([str(run_settings.get("preset", "unknown preset")), *parts]))
    return names


def _name_runs(runs: Sequence[EvaluatedRun]) -> list[EvaluatedRun]:
    """Return the runs with configurations and short distinct names, in which the table name `positions` is omitted."""
    settings = [dict(run.settings) | {"table": run.table} for run in runs]
    labels = configurations(settings, [run.configuration for run in runs])
    ends = ["" if run.table == POSITIONS_TABLE else f" ({run.table})" for run in runs]
    names = zip(short_names([run.path for run in runs]), ends, strict=True)
    return [
        replace(run, name=name + end, configuration=label)
        for run, (name, end), label in zip(runs, names, labels, strict=True)
    ]


def short_names(paths: Sequence[Path]) -> list[str]:
    """Return the names of folders, with as many parent folders as needed to distinguish them."""
    parts = [path.resolve().parts for path in paths]
    depth = 1
    while len({part[-depth:] for part in parts}) < len(set(parts)):
        depth += 1
    return ["/".join(part[-depth:]) for part in parts]


def _figures(epochs: pl.DataFrame, options: EvaluationOptions) -> pl.DataFrame:
    """Return the error statistics by grouping, for each run and (if there are several) each configuration."""
    epochs = epochs.select(*KEYS, *USED)
    groupings = ("all", "section", "environment", "speed", "satellites", "signals", "status")
    tables = [figures_by(_parts(epochs, "run", ()), groupings, options)]
    if epochs["run"].n_unique() > 1:
        pooled = _parts(epochs, "configuration", ("run", "line"))
        tables.append(figures_by(pooled, ("configuration", "environment", "speed"), options))
        tables.append(figures_by(_parts(epochs, "configuration", ("run",)), ("line",), options))
    return pl.concat(tables)


def _parts(epochs: pl.DataFrame, by: str, as_one: Sequence[str]) -> Iterator[pl.DataFrame]:
    """Yield, for each value in the column `by`, the rows with this value; the columns `as_one` are set to `ALL`.

    If there are two antennas, yield the rows of each value a second time, with `ALL` in the column ``antenna``.
    """
    for keys in (as_one, (*as_one, "antenna"))[: epochs["antenna"].n_unique()]:
        for value in epochs[by].unique(maintain_order=True):
            yield epochs.filter(pl.col(by) == value).with_columns(pl.lit(ALL).alias(key) for key in keys)


def _intervals(epochs: pl.DataFrame) -> pl.DataFrame:
    """Return, for each run and (if there are several runs) each configuration, the intervals by antenna."""
    table = interval_table(epochs, list(KEYS))
    if epochs["run"].n_unique() < 2:
        return table
    pooled = interval_table(epochs, ["configuration", "antenna"])
    return pl.concat([table, pooled.with_columns(run=pl.lit(ALL), line=pl.lit(ALL)).select(table.columns)])
