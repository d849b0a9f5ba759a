"""A run that was done, from its folder: what it read and how, checked to be the same still."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import datetime
from pathlib import Path
from typing import Any

from railfix.core.errors import InputFileError, MismatchError
from railfix.core.files import file_sha256
from railfix.pipeline.config import Config, parse_config
from railfix.run.driver import RunOptions
from railfix.run.inputs import RunInputs
from railfix.run.sources import TrackReading


@dataclass(frozen=True, kw_only=True)
class PastRun:
    """What a folder written by `run_files` says of itself.

    Attributes
    ----------
    folder : Path
    record : mapping
        ``run.json``.
    inputs : RunInputs
    config : Config
        Settings that were used.
    options : RunOptions
    """

    folder: Path
    record: Mapping[str, Any]
    inputs: RunInputs
    config: Config
    options: RunOptions

    def check_inputs(self) -> None:
        """See that the input files are there and the same.

        Raises
        ------
        InputFileError
            One is missing.
        MismatchError
            One has changed since the run.
        """
        self.inputs.check()
        hashes = {entry["path"]: entry["sha256"] for entry in self.record["inputs"]}
        for name, path in self.inputs.named():
            if file_sha256(path) != hashes[str(path)]:
                raise MismatchError(
                    f"{path}: has changed since the run in {self.folder} read it as --{name}; repeat the run"
                )


def past_run(folder: Path) -> PastRun:
    """Read what a run was.

    Parameters
    ----------
    folder : Path
        With ``run.json``; paths in it that are not absolute count from the present folder, as they did then.

    Returns
    -------
    PastRun

    Raises
    ------
    InputFileError
        There is no run, or not one that this version wrote.
    """
    path = folder / "run.json"
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputFileError(path, f"cannot be read ({error.strerror}); name a folder that railfix run wrote") from None
    except ValueError as error:
        raise InputFileError(path, f"is no JSON: {error}") from None
    needed = {"inputs", "settings_used", "options"}
    if not isinstance(record, dict) or needed - set(record):
        missing = ", ".join(sorted(needed - set(record))) if isinstance(record, dict) else "everything"
        raise InputFileError(path, f"lacks {missing}; it was not written by this version, repeat the run")
    return PastRun(
        folder=folder,
        record=record,
        inputs=_inputs(record),
        config=parse_config(dict(record["settings_used"]), source=str(path)),
        options=_options(path, record["options"]),
    )


def _options(path: Path, table: Mapping[str, Any]) -> RunOptions:
    known, of_track = {item.name for item in fields(RunOptions)}, {item.name for item in fields(TrackReading)}
    if set(table) != known or set(table["track"]) != of_track:
        raise InputFileError(path, "has other options than this version writes; repeat the run")
    when = {name: None if table[name] is None else datetime.fromisoformat(table[name]) for name in ("start", "end")}
    return RunOptions(**(dict(table) | when | {"track": TrackReading(**table["track"])}))


def _inputs(record: Mapping[str, Any]) -> RunInputs:
    listed: dict[str, list[Path]] = {}
    for entry in record["inputs"]:
        listed.setdefault(entry["input"], []).append(Path(entry["path"]))
    values: dict[str, Any] = {}
    for item in fields(RunInputs):
        paths = listed.get(item.name, [])
        many = item.name in ("front", "rear", "nav", "sp3", "track", "sbas")
        values[item.name] = tuple(paths) if many else (paths[0] if paths else None)
    return RunInputs(**values)
