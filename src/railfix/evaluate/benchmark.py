"""Evaluate railfix with one configuration, and other programs such as RTKLIB, on all cases in a folder."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from concurrent.futures import BrokenExecutor, Executor
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl

from railfix import __version__
from railfix.core.arrays import Datetimes, Indices
from railfix.core.errors import MismatchError, RailfixError
from railfix.core.files import fingerprint, read_bytes
from railfix.core.geodesy import sigma_along
from railfix.core.nearest_times import nearest_rows
from railfix.core.reasons import Status
from railfix.core.staged_files import write_whole
from railfix.core.timescale import seconds
from railfix.evaluate.accuracy import ALL, FIGURE_COLUMNS, has_position
from railfix.evaluate.cases import Case, check_not_fitted, read_cases
from railfix.evaluate.evaluation import EvaluatedRun, Evaluation, RunAndReference, evaluate_runs
from railfix.evaluate.evaluation_inputs import CONVENTIONAL, POSITIONS_TABLE, floats, list_position_tables, read_run
from railfix.evaluate.integrity import STANFORD_COLUMNS
from railfix.evaluate.place import TrackFiles, find_trajectory
from railfix.io.file_kind import find_kind
from railfix.io.position_log import PositionLog
from railfix.io.positions import read_positions
from railfix.pipeline.config import Config
from railfix.run.campaign import CampaignProgress, CampaignRun, position_runs
from railfix.run.inputs import Antenna, RunInputs
from railfix.run.output import OutputFolder
from railfix.track.trajectory import Trajectory

#: Name of the row with RTKLIB's single-point positions.
RTKLIB_SINGLE: Final = "RTKLIB single point"
#: RTKLIB's program that computes single-point positions (Debian package rtklib).
RTKLIB_PROGRAM: Final = "rnx2rtkp"
#: A position belongs to an epoch only if their time difference is at most this fraction of the median interval of the
#: epochs.
_NEAR: Final = 0.4
_LONGEST_S: Final = 600.0  #: Time after which RTKLIB is stopped [s].
#: Bit of each constellation in RTKLIB's option pos1-navsys.
_SYSTEMS: Final = {"G": 1, "R": 4, "E": 8, "J": 16, "C": 32}


def rows_at_epochs(time: Datetimes, found: Datetimes) -> Indices:
    """Return the row of a log for each epoch, shape (T,); -1 for epochs without a row.

    `time` has the times of the epochs, and `found` the times of the log. A row belongs to the nearest epoch if the time
    difference is less than 0.4 of the median interval of the epochs. If several rows belong to an epoch, the nearest is
    returned. With fewer than two epochs, no epoch has a row.
    """
    rows = np.full(len(time), -1, dtype=np.intp)
    known = np.flatnonzero(~np.isnat(found))
    if len(time) < 2:
        return rows
    near_ns = math.ceil(_NEAR * np.median(np.diff(time).astype(np.int64))) - 1
    index = nearest_rows(time, found[known], within_ns=near_ns)
    near = np.flatnonzero(index >= 0)
    away = np.abs(found[known[near]] - time[index[near]])
    nearest = near[np.argsort(-away, kind="stable")]  # sorted, so that the nearest row is written last
    rows[index[nearest]] = known[nearest]
    return rows


def table_of_positions(log: PositionLog, epochs: pl.DataFrame, trajectory: Trajectory) -> pl.DataFrame:
    """Return another program's positions, moved to the nearest point of the line, as a positions table of a run.

    The table has one row per epoch in `epochs`; epochs without a position have the status no_convergence, or
    no_observation if railfix has no observation either.
    """
    time = epochs["time_gpst"].to_numpy()
    row = rows_at_epochs(time, log.time)
    has = row >= 0
    ecef = np.where(has[:, None], log.ecef_m[row], np.nan)
    arc, _ = trajectory.nearest(ecef)
    sigma = np.where(has[:, None], log.sigma_m[row][:, [1, 0, 2]], np.nan)
    along = sigma_along(sigma, ecef, trajectory.tangent[trajectory.segment_at(arc)[0]])
    here = trajectory.at_arc(arc)
    silent = epochs["status"] == Status.NO_OBSERVATION.text
    without = np.where(silent.to_numpy(), Status.NO_OBSERVATION.text, Status.NO_CONVERGENCE.text)
    table = pl.DataFrame(
        {
            "time_gpst": np.where(has, log.time[row], time),
            "antenna": epochs["antenna"],
            "status": np.where(np.isfinite(arc), Status.OK.text, without),
            "chainage_m": trajectory.chainage_at(arc),
            "along_sigma_m": along,
            **{name: here[:, axis] for axis, name in enumerate(("x_m", "y_m", "z_m"))},
        },
        nan_to_null=True,
    )
    absent = [pl.lit(None, pl.Float64).alias(name) for name in ("n_used", *CONVENTIONAL)]
    return table.with_columns(absent)


def write_program_run(log: PositionLog, run: Path, out: Path, antenna: Antenna) -> None:
    """Write another program's positions to `out`, in the format of a run; `run` is railfix's run on the same log.

    Raise MismatchError if the run has fewer than two epochs of the antenna, or the log has no position at these epochs.
    """
    own = read_run(run)
    epochs = own.positions.filter(pl.col("antenna") == antenna)
    if len(epochs) < 2:
        raise MismatchError(
            f"{log.path}: has positions of the {antenna} antenna, but the run has fewer than two epochs of it"
        )
    places = np.stack([floats(epochs, name) for name in ("x_m", "y_m", "z_m")], axis=1)
    trajectory, _, _ = find_trajectory(own, antenna, floats(epochs, "chainage_m"), places, TrackFiles())
    table = table_of_positions(log, epochs, trajectory)
    if table["chainage_m"].null_count() == len(table):
        raise MismatchError(f"{log.path}: has no position at the epochs of {run}; give positions of the same run")
    line: dict[str, Any] = own.part("line")
    if name := own.track_facts.get("file"):
        line = {**line, "track": {**own.track_facts, "file": str((run / str(name)).absolute())}}
    kept = [
        {**entry, "path": str(path.absolute())}
        for kind in ("track", "vehicle")
        for entry, path in zip((e for e in own.entries if e["input"] == kind), own.input_paths(kind), strict=True)
    ]
    with OutputFolder(out, overwrite="replace", inputs=[Path(log.path)]) as folder:
        folder.append_parquet("positions.parquet", table)
        record = {"railfix": __version__, "inputs": [*kept, fingerprint("positions", Path(log.path))], "line": line}
        folder.write_json("run.json", record)
        folder.commit({"railfix": __version__})


def write_rtklib_single_point(inputs: RunInputs, config: Config, out: Path) -> str | None:
    """Write RTKLIB's single-point positions of the front antenna to `out`; return None, or the reason for a failure.

    The elevation mask and the constellations are taken from `config`.
    """
    program = shutil.which(RTKLIB_PROGRAM)
    if program is None:
        return f"RTKLIB is left out: {RTKLIB_PROGRAM} (Debian package rtklib) is not installed"
    if any(find_kind(path) == "receiver" for path in inputs.front):
        return "RTKLIB is left out: the log is not RINEX (railfix convert writes it as RINEX)"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files = [*_unpack(inputs.front, folder, "obs"), *_unpack(inputs.nav, folder, "nav")]
        (folder / "single.conf").write_text(
            f"pos1-posmode=single\npos1-frequency=l1\npos1-elmask={config.elevation.mask_deg:g}\npos1-ionoopt=brdc\n"
            f"pos1-tropopt=saas\npos1-sateph=brdc\npos1-navsys={sum(_SYSTEMS[name] for name in config.systems)}\n"
            "out-solformat=xyz\nout-timesys=gpst\nout-timeform=hms\nout-timendec=6\n"
        )
        command = [program, "-k", str(folder / "single.conf"), "-o", str(out), *map(str, files)]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=_LONGEST_S)
        except (subprocess.SubprocessError, OSError) as error:
            return f"RTKLIB is left out: {RTKLIB_PROGRAM} failed ({type(error).__name__})"
    if not out.is_file() or all(line.startswith("%") for line in out.read_text().splitlines()):
        return f"RTKLIB is left out: {RTKLIB_PROGRAM} found no position"
    return None


def _unpack(paths: Sequence[Path], folder: Path, kind: str) -> list[Path]:
    """Write uncompressed copies of files, which RTKLIB requires, into a folder; return the paths of the copies."""
    unpacked = {folder / f"{number}.{kind}": path for number, path in enumerate(paths)}
    for target, path in unpacked.items():
        target.write_bytes(read_bytes(path))
    return list(unpacked)


#: Rows of railfix in the table: name, table of positions and kind of position.
_OWN: Final = (
    ("railfix filter", "train", "constrained"),
    ("railfix single epochs", POSITIONS_TABLE, "constrained"),
    ("railfix 3-D single point", POSITIONS_TABLE, "conventional"),
)
_OF_FIGURES: Final = (
    "observed", "rate", "p50_m", "p95_m", "max_m", "distance_p50_m", "distance_p95_m", "distance_max_m",
    "wrong_places", "normalised_p95",
)  # fmt: skip
_OF_STANFORD: Final = (
    "alarm_limit_m", "judged", "nominal", "misleading", "hazardously_misleading", "unavailable",
    "unavailable_misleading", "availability", "continuity_15_s",
)  # fmt: skip
#: Columns of the table with their meaning; the error statistics are those of `railfix evaluate`.
BENCHMARK_COLUMNS: Final[dict[str, str]] = {
    "case": "name of the folder of the case",
    "held_out": "whether the case is reserved: no test reads it and no setting was chosen with it",
    "position": "positions that are evaluated; positions of other programs are moved to the nearest point of the line",
    "antenna": "`front` or `rear`; `all` where both are combined",
    **{name: FIGURE_COLUMNS[name] for name in _OF_FIGURES},
    "time_to_first_s": "time from the first epoch with observations to the first position",
    "over_level": "number of errors above a usable protection level (no alarm, and a status with a bounded error)",
    "over_level_alarm": "number of errors above the protection level where the level is unusable (alarm or status)",
    **{name: f"{STANFORD_COLUMNS[name]} (levels `usable`, alarm limit of the run)" for name in _OF_STANFORD},
    "error": "reason for a missing result",
}
#: Columns of the printed table: column, header, performance feature of EN 16803-1, decimals, factor.
_SHOWN: Final = (
    ("observed", "epochs", "", 0, 1),
    ("rate", "rate %", "Availability", 1, 100),
    ("p50_m", "along p50", "Accuracy", 2, 1),
    ("p95_m", "p95", "Accuracy", 2, 1),
    ("max_m", "max", "Accuracy", 1, 1),
    ("distance_p50_m", "straight p50", "Accuracy", 2, 1),
    ("distance_p95_m", "p95", "Accuracy", 2, 1),
    ("distance_max_m", "max", "Accuracy", 1, 1),
    ("wrong_places", "wrong places", "Accuracy", 0, 1),
    ("normalised_p95", "error/sigma p95", "Accuracy", 2, 1),
    ("over_level", "over level", "Integrity", 0, 1),
    ("over_level_alarm", "with alarm", "Integrity", 0, 1),
    ("hazardously_misleading", "hazardous", "Integrity", 0, 1),
    ("availability", "level in limit %", "Availability", 1, 100),
    ("continuity_15_s", "15 s %", "Continuity", 1, 100),
    ("time_to_first_s", "first s", "TTFF", 1, 1),
)


def run_benchmark(
    folder: Path,
    config: Config,
    *,
    out: Path,
    executor: Executor,
    progress: CampaignProgress | None = None,
    lost: tuple[type[Exception], ...] = (BrokenExecutor,),
) -> tuple[pl.DataFrame, tuple[str, ...]]:
    """Run the cases of a folder with one configuration, evaluate railfix and the other programs, and write the tables.

    Return the table (`BENCHMARK_COLUMNS`) and notes. The row of a failed case states the reason for the failure in
    ``error``. Raise InputFileError if a file has a wrong hash, MismatchError if settings were derived from a held-out
    case.
    """
    cases = read_cases(folder)
    check_not_fitted(config, cases)
    for case in cases:
        case.check_hashes()
    runs = [
        CampaignRun(
            fields={"case": case.name},
            inputs=case.inputs,
            config=config,
            options=case.content.options,
            out=out.absolute() / "runs" / f"case={case.name}",
        )
        for case in cases
    ]
    done = position_runs(runs, out=out, executor=executor, progress=progress, lost=lost)
    rows: list[dict[str, Any]] = []
    notes: list[str] = []
    for case, run, result in zip(cases, runs, done.iter_rows(named=True), strict=True):
        try:
            if result["error"] is not None:
                raise RailfixError(result["error"])
            found, more = _judge(case, run, out.absolute() / "programs" / f"case={case.name}")
        except RailfixError as error:
            found, more = [{"error": " ".join(str(error).split())}], []
        rows += [{"case": case.name, "held_out": case.content.held_out, **row} for row in found]
        notes += [f"{case.name}: {note}" for note in more]
    table = pl.DataFrame(
        [{name: row.get(name) for name in BENCHMARK_COLUMNS} for row in rows], infer_schema_length=None
    )
    _write(table, notes, cases, config, out)
    return table, tuple(notes)


def _judge(case: Case, run: CampaignRun, out: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """Evaluate railfix and the other programs on one case; return the rows of the table, and notes."""
    tables = list_position_tables(run.out)
    items = [RunAndReference(run=run.out, reference=case.truth, configuration=name, table=name) for name in tables]
    others, notes = _programs(case, run, out)
    items += [RunAndReference(run=path, reference=case.truth, configuration=name) for name, path in others.items()]
    evaluation = evaluate_runs(items, options=case.content.evaluation)
    by_name = {found.configuration: found for found in evaluation.runs}
    rows = [_row(evaluation, by_name[table], name, kind) for name, table, kind in _OWN if table in tables]
    return rows + [_row(evaluation, by_name[name], name, "constrained") for name in others], notes


def _programs(case: Case, run: CampaignRun, out: Path) -> tuple[dict[str, Path], list[str]]:
    """Write each other program's positions into a folder in the format of a run; return the folders, and notes."""
    out.mkdir(parents=True, exist_ok=True)
    notes: list[str] = []
    single = out / "rtklib-single.pos"
    note = write_rtklib_single_point(case.inputs, run.config, single)
    logs: dict[str, tuple[PositionLog, Antenna]] = {} if note else {RTKLIB_SINGLE: (read_positions(single), "front")}
    notes += [note] if note else []
    for name, other in case.content.positions.items():
        reading = other.columns.arguments
        logs[name] = read_positions(case.folder.absolute() / other.file, **reading), other.antenna
    folders = {name: out / re.sub(r"[^\w.-]+", "_", name) for name in logs}
    for name, (log, antenna) in logs.items():
        write_program_run(log, run.out, folders[name], antenna)
        notes += [f"{name}: {text}" for text in log.notes]
    return folders, notes


def _row(evaluation: Evaluation, run: EvaluatedRun, name: str, kind: str) -> dict[str, Any]:
    """Return the table row of one kind of position of one run; two antennas are combined."""
    figures = evaluation.figures.filter(run=run.name, grouping=ALL, epochs_of="own", position=kind)
    antenna = ALL if ALL in figures["antenna"] else figures["antenna"][0]
    row = figures.filter(antenna=antenna).row(0, named=True)
    found: dict[str, Any] = {"position": name, "antenna": antenna, **{column: row[column] for column in _OF_FIGURES}}
    found["time_to_first_s"] = _time_to_first(evaluation.epochs.filter(run=run.name), kind)
    for levels in evaluation.integrity.values() if kind == "constrained" else ():
        of_run = levels.stanford.filter(run=run.name, antenna=antenna, grouping=ALL, own_limit=True)
        counts = {row["levels_of"]: row for row in of_run.iter_rows(named=True)}
        if counts:
            usable = counts["usable"]
            found |= {column: usable[column] for column in _OF_STANFORD}
            found["over_level"] = usable["beyond"]
            found["over_level_alarm"] = counts["all"]["beyond"] - usable["beyond"]
    return found


def _time_to_first(epochs: pl.DataFrame, kind: str) -> float | None:
    """Return the time from the first epoch with observations to the first position [s]; None without a position."""
    observed, placed = (
        epochs.filter(mask)["time_gpst"].to_numpy() for mask in (pl.col("observed"), has_position(kind))
    )
    return float(seconds(placed.min() - observed.min())) if len(observed) and len(placed) else None


def heads() -> tuple[list[str], list[str]]:
    """Return the headers of the printed table, and the performance feature of EN 16803-1 of each column."""
    return ["case", "position", *(head for _, head, *_ in _SHOWN)], ["", "", *(name for _, _, name, *_ in _SHOWN)]


def shown_rows(table: pl.DataFrame) -> list[list[str]]:
    """Return the rows of the printed table as text; "-" where a column has no value."""
    return [
        [
            f"{row['case']}{' (held out)' if row['held_out'] else ''}",
            row["position"] or f"failed: {row['error']}",
            *(
                "-" if row[column] is None else f"{factor * row[column]:,.{decimals}f}"
                for column, _, _, decimals, factor in _SHOWN
            ),
        ]
        for row in table.iter_rows(named=True)
    ]


def markdown_table(table: pl.DataFrame) -> str:
    """Return the printed table in Markdown; its first row has the performance features of EN 16803-1."""
    names, features = heads()
    lines = [names, ["---", "---", *["---:"] * len(_SHOWN)], ["EN 16803-1", "", *features[2:]], *shown_rows(table)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _write(table: pl.DataFrame, notes: Sequence[str], cases: Sequence[Case], config: Config, out: Path) -> None:
    """Write the table as CSV, JSON and Markdown into the folder `out`."""
    write_whole(out / "benchmark.csv", table.write_csv(), what="table of the benchmark")
    write_whole(out / "benchmark.md", markdown_table(table), what="table of the benchmark")
    about = {case.name: case.content.model_dump(mode="json", include=_ABOUT) for case in cases}
    record = {
        "railfix": __version__,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "columns": BENCHMARK_COLUMNS,
        "en_16803_1": {column: feature for column, _, feature, *_ in _SHOWN if feature},
        "cases": about,
        "settings_used": config.as_dict(),
        "notes": list(notes),
        "rows": table.to_dicts(),
    }
    write_whole(out / "benchmark.json", json.dumps(record, indent=2, allow_nan=False) + "\n", what="benchmark")


#: Fields of a case that are written into ``benchmark.json``.
_ABOUT: Final = {"held_out", "licence", "fetch", "sha256", "scenario"}
