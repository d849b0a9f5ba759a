"""Campaigns: many logs positioned side by side, resumable, each with its own results folder.

The folders are named by the fields of the campaign (``runs/train=A/day=2024-03-05``), so that all tables
together are one hive-partitioned data set: ``pl.scan_parquet(out / "runs/**/positions.parquet")``.
"""

from __future__ import annotations

import re
import time as clock
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import polars as pl

from railfix.core.errors import InputFileError, MismatchError, OutputError, RailfixError, SettingsError
from railfix.core.files import write_whole
from railfix.core.settings import Settings, load_settings
from railfix.pipeline.config import Config, load_config
from railfix.run.driver import run_files
from railfix.run.folder import read_record
from railfix.run.inputs import RunInputs
from railfix.run.options import RunOptions
from railfix.run.output import check_folder

#: A field in a pattern: ``{day}``.
_FIELD: Final = re.compile(r"\{(\w+)\}")


class Campaign(Settings):
    """Files of a campaign; patterns are relative to its file and have fields in braces.

    Attributes
    ----------
    front, rear : str
        Patterns of the logs: ``logs/{train}/{day}/front.obs*``. Logs with the same fields are one run; several files
        of one antenna are joined in the order of their names. `rear` may be empty.
    nav, sp3 : str
        Patterns of navigation and precise orbit files. Fields that a pattern shares with `front` must agree:
        ``nav/{day}.nav*`` gives each run the files of its day. `sp3` may be empty.
    track : tuple of Path
    vehicle, config : Path or None
    options : RunOptions
        Of every run; each is one process, unless they say otherwise.
    """

    front: str
    nav: str
    track: tuple[Path, ...]
    rear: str = ""
    sp3: str = ""
    vehicle: Path | None = None
    config: Path | None = None
    options: RunOptions = RunOptions()


@dataclass(frozen=True, kw_only=True)
class CampaignRun:
    """One run of a campaign.

    Attributes
    ----------
    fields : mapping of str to str
        Values of the fields, in the order of the pattern of the front antenna.
    inputs : RunInputs
    config : Config
    options : RunOptions
    out : Path
    """

    fields: Mapping[str, str]
    inputs: RunInputs
    config: Config
    options: RunOptions
    out: Path

    @property
    def done(self) -> bool:
        """Whether the results are there, of the same inputs and settings."""
        try:
            record = read_record(self.out)
            record.check_inputs()
            same = record.inputs.paths == self.inputs.with_settings(self.config).paths
            return same and record.record.get("settings_used") == self.config.as_dict()
        except (InputFileError, MismatchError):
            return False


class CampaignProgress(Protocol):
    """Callback for the progress of a campaign."""

    def __call__(self, *, done: int, failed: int, total: int, left_s: float) -> None:
        """Runs done, failed and in total, and the estimated time left [s]."""


def read_campaign(path: Path, out: Path) -> list[CampaignRun]:
    """Read a campaign file and find the files of each run.

    Raises
    ------
    InputFileError
        The file cannot be read, or no log matches its pattern.
    SettingsError
        A setting is misspelt, or a pattern has no field or one that the logs of the front antenna lack.
    """
    campaign = load_settings(Campaign, path, what="a campaign file")
    folder = path.parent
    found = {name: _found(folder, getattr(campaign, name)) for name in ("front", "rear", "nav", "sp3")}
    fields = _FIELD.findall(campaign.front)
    if not fields:
        raise SettingsError(f"{path}: front = {campaign.front!r} has no field such as {{day}} that names a run")
    for name in ("rear", "nav", "sp3"):
        if other := sorted(set(_FIELD.findall(getattr(campaign, name))) - set(fields)):
            raise SettingsError(f"{path}: {name} has the field {other[0]}, which front has not")
    keys = list(dict.fromkeys(tuple(values[name] for name in fields) for _, values in found["front"]))
    if not keys:
        raise InputFileError(path, f"no file matches front = {campaign.front!r}; check the pattern")
    config = Config() if campaign.config is None else load_config(folder / campaign.config)
    runs = []
    for key in keys:
        values = dict(zip(fields, key, strict=True))
        files = {name: tuple(_matching(found[name], values)) for name in found}
        inputs = RunInputs(
            front=files["front"],
            rear=files["rear"],
            nav=files["nav"],
            sp3=files["sp3"],
            track=tuple(folder / track for track in campaign.track),
            vehicle=None if campaign.vehicle is None else folder / campaign.vehicle,
            config=None if campaign.config is None else folder / campaign.config,
        )
        place = out.joinpath("runs", *(f"{name}={value}" for name, value in values.items()))
        runs.append(CampaignRun(fields=values, inputs=inputs, config=config, options=campaign.options, out=place))
    return runs


def run_campaign(
    path: Path, *, out: Path, executor: Executor, progress: CampaignProgress | None = None
) -> pl.DataFrame:
    """Position all logs of a campaign and write one row per run to ``campaign.csv``.

    Runs whose results are there, of the same inputs and settings, are not repeated: a campaign that was killed
    goes on where it was. A run that fails is a row with its error.

    Parameters
    ----------
    path : Path
        Campaign file, see `Campaign`.
    out : Path
        Folder for the results; that of an earlier campaign is continued.
    executor : Executor
        Of `concurrent.futures`: processes on this machine, or any other with its interface.
    progress : CampaignProgress, optional

    Returns
    -------
    polars.DataFrame
        The fields, `status` ("done", "failed"), `error`, `epochs`, `positioning_rate`, `ok_rate`, `wall_s`, `folder`.

    Raises
    ------
    InputFileError, SettingsError
        See `read_campaign`.
    OutputError
        The folder has other files in it.
    """
    runs = read_campaign(path, out)
    if out.is_dir() and any(out.iterdir()) and not (out / "runs").is_dir():
        raise OutputError(f"{out}: the folder is not empty, nor that of a campaign; name another one")
    began, results = clock.perf_counter(), {}
    (out / "runs").mkdir(parents=True, exist_ok=True)
    futures = {executor.submit(position_run, run): number for number, run in enumerate(runs)}
    for count, future in enumerate(as_completed(futures), start=1):
        results[futures[future]] = future.result()
        if progress is not None:
            failed = sum(row["status"] == "failed" for row in results.values())
            left = (clock.perf_counter() - began) / count * (len(runs) - count)
            progress(done=count, failed=failed, total=len(runs), left_s=left)
    table = pl.DataFrame([results[number] for number in range(len(runs))], infer_schema_length=None)
    write_whole(out / "campaign.csv", table.write_csv(), what="table of the campaign")
    return table


def position_run(run: CampaignRun) -> dict[str, Any]:
    """Position one run, unless its results are there, and return its row."""
    row: dict[str, Any] = {**run.fields, "status": "done", "error": None, "epochs": None, "positioning_rate": None}
    row |= {"ok_rate": None, "wall_s": None, "folder": str(run.out)}
    try:
        check_folder(run.out, overwrite="replace")
        if not run.done:
            options = run.options.replaced(overwrite="replace", workers=run.options.workers or 1)
            run_files(run.inputs, run.config, out=run.out, options=options)
        record = read_record(run.out).record
    except RailfixError as error:
        return row | {"status": "failed", "error": " ".join(str(error).split())}
    row["epochs"] = sum(antenna["epochs"] for antenna in record["antennas"].values())
    return row | {name: record[name] for name in ("positioning_rate", "ok_rate", "wall_s")}


def _found(folder: Path, pattern: str) -> list[tuple[Path, dict[str, str]]]:
    """Return the files that match a pattern, in order of their names, with the values of its fields."""
    if not pattern:
        return []
    escaped = "".join(_regex(part) for part in re.split(r"(\{\w+\}|\*)", pattern))
    expression = re.compile(escaped)
    found = []
    for path in sorted(folder.glob(_FIELD.sub("*", pattern))):
        match = expression.fullmatch(path.relative_to(folder).as_posix())
        if match:
            found.append((path, match.groupdict()))
    return found


def _regex(part: str) -> str:
    if part == "*":
        return "[^/]*"
    field = _FIELD.fullmatch(part)
    return f"(?P<{field[1]}>[^/]+)" if field else re.escape(part)


def _matching(found: list[tuple[Path, dict[str, str]]], values: Mapping[str, str]) -> Iterator[Path]:
    """Give the files whose fields have these values."""
    for path, fields in found:
        if all(values[name] == value for name, value in fields.items()):
            yield path
