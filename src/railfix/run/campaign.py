"""Positioning of the logs of many runs by one command. After an interruption, the same command resumes the work.

The results folder of a run is named by the campaign's fields, such as ``runs/train=A/day=2024-03-05``. The tables of
all runs therefore form one hive-partitioned data set, which ``pl.scan_parquet(out / "runs/**/positions.parquet")``
reads.
"""

from __future__ import annotations

import re
import signal
import time as clock
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, as_completed
from dataclasses import dataclass, replace
from multiprocessing import parent_process
from pathlib import Path
from typing import Any, Final, Protocol

import polars as pl

from railfix.core.errors import InputFileError, MismatchError, OutputError, RailfixError, RailfixWarning, SettingsError
from railfix.core.settings import Settings
from railfix.core.settings_files import load_settings
from railfix.core.staged_files import write_whole
from railfix.pipeline.config import Config, load_config
from railfix.run.driver import run_files
from railfix.run.inputs import LogReading, RunInputs, RunOptions
from railfix.run.output import check_folder
from railfix.run.processor_setup import with_measured_priors
from railfix.run.record import read_record

#: Regular expression of a field in a pattern, such as ``{day}``.
_FIELD: Final = re.compile(r"\{(\w+)\}")


class Campaign(Settings):
    """Files of a campaign, specified by patterns with fields in braces. Paths are relative to the campaign file.

    A run uses the files whose fields have the same values as the fields of its front log. For example,
    ``nav/{day}.nav*`` selects the navigation files of the run's day, and ``{line}/track.csv`` the track of the run's
    line. A pattern that has neither fields nor ``*`` names one file that all runs use.
    """

    #: Pattern of the logs of the front antenna, such as ``logs/{train}/{day}/front.obs*``. Logs whose fields have the
    #: same values belong to one run; several files of one antenna are joined in the order of their names.
    front: str
    nav: str  #: Pattern of navigation files.
    track: tuple[str, ...]  #: Patterns of the files of the track, which are joined to a route in this order.
    rear: str = ""  #: Pattern of the logs of the rear antenna; may be empty.
    sp3: str = ""  #: Pattern of the files with precise orbits; may be empty.
    vehicle: str = ""  #: Pattern of the vehicle file; may be empty.
    tachometer: str = ""  #: Pattern of the table of tachometer pulses; may be empty.
    inertial: str = ""  #: Pattern of the table of the inertial unit; may be empty.
    radar: str = ""  #: Pattern of the table of radar speeds; may be empty.
    reference: str = ""  #: Pattern of reference trajectories for the errors on the campaign page; may be empty.
    config: Path | None = None  #: Settings file of all runs; None for the default settings.
    options: RunOptions = RunOptions()  #: Options of all runs.


#: Names of the patterns that may match several files per run.
_MANY: Final = ("front", "rear", "nav", "sp3")
#: Names of the patterns that may match only one file per run.
_ONE: Final = ("vehicle", "tachometer", "inertial", "radar", "reference")


@dataclass(frozen=True, kw_only=True)
class CampaignRun:
    """One run of a campaign."""

    fields: Mapping[str, str]  #: Value of each field, in the order of the fields in the pattern `front`.
    inputs: RunInputs
    config: Config
    options: RunOptions
    out: Path  #: Results folder.
    reference: Path | None = None  #: File of the reference trajectory; None if there is none.

    @property
    def done(self) -> bool:
        """Whether the results folder already has results for the inputs, settings and options of this run."""
        try:
            record = read_record(self.out)
            record.check_inputs()
            same = record.inputs.paths == self.inputs.with_settings(self.config).paths
            same = same and record.options.replaced(overwrite=self.options.overwrite) == self.options
            return same and record.record.get("settings_used") == self.config.as_dict()
        except (InputFileError, MismatchError):
            return False


class CampaignProgress(Protocol):
    """Callback for the progress of a campaign."""

    def __call__(self, *, done: int, kept: int, failed: int, total: int, left_s: float) -> None:
        """Report the numbers of finished, kept, failed and all runs, and the estimated remaining time [s].

        Kept runs have results from an earlier call; they are included in the finished runs.
        """


def read_campaign(path: Path, out: Path) -> list[CampaignRun]:
    """Read a campaign file. Return its runs with their input files, and with their results folders below `out`.

    Raise InputFileError if no log matches the pattern `front`. Raise SettingsError if a setting is misspelt, if `front`
    has no field, if a pattern is invalid or has a field that `front` lacks, or if several files of a run match a
    pattern that may match only one.
    """
    campaign = load_settings(Campaign, path, what="a campaign file")
    folder, out = path.absolute().parent, out.absolute()
    patterns = {name: getattr(campaign, name) for name in (*_MANY, *_ONE)}
    patterns |= {f"track {k}": pattern for k, pattern in enumerate(campaign.track)}
    fields = _FIELD.findall(campaign.front)
    if not fields:
        raise SettingsError(f"{path}: front = {campaign.front!r} has no field such as {{day}} that names a run")
    for name, pattern in patterns.items():
        _check_pattern(path, name, pattern)
        if other := sorted(set(_FIELD.findall(pattern)) - set(fields)):
            raise SettingsError(f"{path}: {name} has the field {other[0]}, which front lacks")
    found = {name: _find(folder, pattern) for name, pattern in patterns.items()}
    keys = list(dict.fromkeys(tuple(values[name] for name in fields) for _, values in found["front"]))
    if not keys:
        raise InputFileError(path, f"no file matches front = {campaign.front!r}; check the pattern")
    config = Config() if campaign.config is None else with_measured_priors(load_config(folder / campaign.config))
    runs = []
    for key in keys:
        values = dict(zip(fields, key, strict=True))
        files = {
            name: tuple(path for path, own in listed if all(values[field] == value for field, value in own.items()))
            for name, listed in found.items()
        }
        for name in _ONE:
            if len(files[name]) > 1:
                raise SettingsError(f"{path}: {name} has {len(files[name])} files for {values}; one was expected")
        of_run: dict[str, Any] = {name: files[name] for name in _MANY}
        of_run |= {name: next(iter(files[name]), None) for name in _ONE}
        reference = of_run.pop("reference")
        inputs = RunInputs(
            **of_run,
            track=tuple(file for k in range(len(campaign.track)) for file in files[f"track {k}"]),
            config=None if campaign.config is None else folder / campaign.config,
        )
        place = out.joinpath("runs", *(f"{name}={value}" for name, value in values.items()))
        run = CampaignRun(
            fields=values, inputs=inputs, config=config, options=campaign.options, out=place, reference=reference
        )
        runs.append(run)
    return runs


def run_campaign(
    path: Path,
    *,
    out: Path,
    executor: Executor,
    reading: LogReading | None = None,
    progress: CampaignProgress | None = None,
    lost: tuple[type[Exception], ...] = (BrokenExecutor,),
) -> pl.DataFrame:
    """Position all logs of a campaign file. Write a table with one row per run to ``campaign.csv``, and return it.

    Runs that already have results for the same inputs, settings and options are not repeated, so the same call
    continues an interrupted campaign. The columns of the table are the fields, `status` ("done", "failed"), `error`
    (message of a failed run), `epochs`, `positioning_rate`, `ok_rate`, `wall_s`, `reference` and `folder` (below
    `out`).

    `reading`, if it differs from the default, replaces the reading options in the campaign file. `executor` is a
    `concurrent.futures.Executor`; its workers must have access to the same files. `lost` are the exceptions by which
    the executor reports that a worker process has ended.
    """
    runs = read_campaign(path, out)
    if reading not in (None, LogReading()):
        runs = [replace(run, options=run.options.replaced(logs=reading)) for run in runs]
    return position_runs(runs, out=out, executor=executor, progress=progress, lost=lost)


def position_runs(
    runs: Sequence[CampaignRun],
    *,
    out: Path,
    executor: Executor,
    progress: CampaignProgress | None = None,
    lost: tuple[type[Exception], ...] = (BrokenExecutor,),
) -> pl.DataFrame:
    """Position runs whose results folders are below ``out / "runs"``. Parameters and result are as in `run_campaign`.

    Raise OutputError if `out` is not empty and not the folder of a campaign.
    """
    if out.is_dir() and any(out.iterdir()) and not (out / "runs").is_dir():
        raise OutputError(f"{out}: the folder is not empty and not the folder of a campaign; give another folder")
    began, results, kept = clock.perf_counter(), {}, 0
    (out / "runs").mkdir(parents=True, exist_ok=True)
    first = sorted(range(len(runs)), key=lambda number: not (runs[number].out / "run.json").exists())
    futures = {executor.submit(position_or_end, runs[number]): number for number in first}
    for count, future in enumerate(as_completed(futures), start=1):
        number, is_kept = futures[future], False
        try:
            results[number], is_kept = future.result()
        except lost as error:
            gone = f"its worker process has ended ({type(error).__name__}), perhaps for lack of memory"
            results[number] = _row(runs[number], status="failed", error=f"{gone}; run the command again")
        results[number]["folder"] = str(runs[number].out.relative_to(out.absolute()))
        kept += is_kept
        if progress is not None and (not is_kept or count == len(runs)):
            failed = sum(row["status"] == "failed" for row in results.values())
            left = (clock.perf_counter() - began) / max(count - kept, 1) * (len(runs) - count)
            progress(done=count, kept=kept, failed=failed, total=len(runs), left_s=left)
    table = pl.DataFrame([results[number] for number in range(len(runs))], infer_schema_length=None)
    write_whole(out / "campaign.csv", table.write_csv(), what="table of the campaign")
    return table


def position_or_end(run: CampaignRun) -> tuple[dict[str, Any], bool]:
    """Return the result of `position_run`. If a worker process is interrupted during the run, end the process at once.

    The incomplete results of the run are removed before the process ends.
    """
    try:
        return position_run(run)
    except SystemExit:
        if parent_process() is None:
            raise
        signal.raise_signal(signal.SIGKILL)
        raise


def position_run(run: CampaignRun) -> tuple[dict[str, Any], bool]:
    """Position a run unless its results exist. Return its row of ``campaign.csv``, and whether the results existed."""
    try:
        check_folder(run.out, overwrite="replace")
        if not (kept := run.done):
            options = run.options.replaced(overwrite="replace")
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RailfixWarning)  # the notes are in the run's record
                run_files(run.inputs, run.config, out=run.out, options=options)
        record = read_record(run.out).record
    except RailfixError as error:
        return _row(run, status="failed", error=" ".join(str(error).split())), False
    epochs = sum(antenna["epochs"] for antenna in record["antennas"].values())
    rates = {name: record[name] for name in ("positioning_rate", "ok_rate", "wall_s")}
    return _row(run, epochs=epochs, **rates), kept


def _row(run: CampaignRun, **values: Any) -> dict[str, Any]:
    absent = dict.fromkeys(("error", "epochs", "positioning_rate", "ok_rate", "wall_s"))
    reference = None if run.reference is None else str(run.reference)
    return {**run.fields, "status": "done", **absent, **values, "reference": reference}


def _find(folder: Path, pattern: str) -> list[tuple[Path, dict[str, str]]]:
    """Return the files that match a pattern, each with the values of its fields, in the order of the file names.

    The path of a pattern with neither fields nor ``*`` is returned even if the file is missing; the run reports this.
    """
    if not pattern:
        return []
    if not _FIELD.search(pattern) and "*" not in pattern:
        return [(folder / pattern, {})]
    given = Path(pattern)
    root = Path(given.anchor) if given.is_absolute() else folder
    relative = given.relative_to(root).as_posix() if given.is_absolute() else pattern
    seen: set[str] = set()
    parts = re.split(r"(\{\w+\}|\*)", relative)
    expression = re.compile("".join(_regex(part, seen) for part in parts))
    found = []
    for path in sorted(root.glob(re.sub(r"\*+", "*", _FIELD.sub("*", relative)))):
        match = expression.fullmatch(path.relative_to(root).as_posix())
        if match:
            found.append((path, match.groupdict()))
    return found


def _regex(part: str, seen: set[str]) -> str:
    """Return the regular expression for a part of a pattern. A field in `seen` must match its first value."""
    if part == "*":
        return "[^/]*"
    field = _FIELD.fullmatch(part)
    if field is None:
        return re.escape(part)
    again = field[1] in seen
    seen.add(field[1])
    return f"(?P={field[1]})" if again else f"(?P<{field[1]}>[^/]+)"


def _check_pattern(path: Path, name: str, pattern: str) -> None:
    """Raise SettingsError if a pattern has adjacent fields, ``**``, or an invalid field name."""
    if re.search(r"\}\{", pattern):
        raise SettingsError(f"{path}: {name} = {pattern!r}: put a character between the two fields: {{a}}_{{b}}")
    if "**" in pattern:
        raise SettingsError(
            f"{path}: {name} = {pattern!r}: ** is not supported; write a * for each folder, such as */*"
        )
    for field in _FIELD.findall(pattern):
        if not field.isidentifier():
            raise SettingsError(f"{path}: {name}: the field {{{field}}} has to begin with a letter")
