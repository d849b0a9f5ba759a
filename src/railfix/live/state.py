"""State file from which a restarted session continues; the file is written regularly, and checked before use.

The first line of the file is JSON with the versions, the hashes of map, vehicle and settings, and the length and
SHA-256 of the state. The state follows this line. A state is used only if it is complete and the versions and hashes
agree with the session. The state contains only plain values, arrays and data classes of this package
(`railfix.live.state_values`); reading the file does not execute code from it.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

import railfix
from railfix.core.errors import OutputError
from railfix.core.files import file_sha256, source_commit
from railfix.core.settings import Settings
from railfix.live.engine import EngineState
from railfix.live.state_values import StateFormatError, decode, encode
from railfix.live.stream import ReceiverState

_FORM: Final = "railfix live state 5"


@dataclass(frozen=True, kw_only=True)
class SavedSession:
    """State of a session: the state of the engine and the states of the receivers' streams."""

    engine: EngineState
    streams: Mapping[str, ReceiverState]


@dataclass(frozen=True, kw_only=True)
class Loaded:
    """Outcome of reading a state file."""

    session: SavedSession | None  #: State read from the file; None if the file is not used.
    outcome: str  #: Sentence for the log: whether the file is used, and why not.


def belongs_to(
    files: Mapping[str, Path], settings: Mapping[str, Settings], antennas: tuple[str, ...], *, base: str | None = None
) -> dict[str, Any]:
    """Return the entries of a state file that must agree with the session: versions, antennas, hashes of files and
    settings.

    `base` is the specified position of the base station.
    """
    own = f"{railfix.__version__} ({source_commit()})"
    return {
        "version": f"railfix {own}, numpy {np.__version__}, Python {platform.python_version()}",
        "antennas": list(antennas),
        "position of the base station": base,
        **{name: file_sha256(path) for name, path in files.items()},
        **{
            name: hashlib.sha256(json.dumps(values.model_dump(mode="json"), sort_keys=True).encode()).hexdigest()
            for name, values in settings.items()
        },
    }


def write_state(path: Path, session: SavedSession, under: Mapping[str, Any]) -> None:
    """Write a state file with the entries `under` (see `belongs_to`).

    If the file cannot be written completely, keep the previous file, and raise OutputError.
    """
    content = encode(session)
    head = {"form": _FORM, **under, "bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    part = _part(path)
    try:
        with part.open("wb") as file:
            file.write(json.dumps(head).encode() + b"\n" + content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        with suppress(OSError):
            part.unlink()
        raise OutputError(f"{path}: the state cannot be written ({error.strerror or error})") from None


def check_state_path(path: Path) -> None:
    """Raise OutputError if no state can be written to a path; to be called before the session starts."""
    if path.exists() and not path.is_file():
        raise OutputError(f"{path}: is not a regular file, and no state can be written there; give another file")
    try:
        _part(path).touch()
        _part(path).unlink()
    except OSError as error:
        raise OutputError(f"{path}: no state can be written there ({error.strerror}); give another file") from None


def load_state(path: Path, under: Mapping[str, Any]) -> Loaded:
    """Read a state file; the state is used only if the file's entries agree with `under` (see `belongs_to`).

    Raise OutputError if the file exists but is not a state file, because the session would overwrite it.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return Loaded(session=None, outcome=f"state file {path}: not found; positioning starts without a stored state")
    except OSError as error:
        return _refuse(path, f"cannot be read ({error.strerror})")
    line, _, content = data.partition(b"\n")
    try:
        head = json.loads(line)
    except ValueError:
        head = None
    form = str(head.get("form")) if isinstance(head, dict) else ""
    if data and not form.startswith("railfix live state "):
        raise OutputError(f"{path}: is not a state file of railfix live, but would be overwritten; give another file")
    if form != _FORM:
        return _refuse(path, "is not a state file of this version")
    for name, value in under.items():
        if head.get(name) != value:
            return _refuse(path, f"was made with another {name}")
    if {name for name in head if name not in ("form", "bytes", "sha256")} != set(under):
        return _refuse(path, "was made with other input files")
    if len(content) != head.get("bytes") or hashlib.sha256(content).hexdigest() != head.get("sha256"):
        return _refuse(path, "is damaged or cut off")
    try:
        session = decode(content)
    except StateFormatError as error:
        return _refuse(path, f"contains no state ({error})")
    if not isinstance(session, SavedSession):
        return _refuse(path, "contains no state")
    return Loaded(session=session, outcome=f"state file {path}: used; it agrees with this map, vehicle and settings")


def _part(path: Path) -> Path:
    """Return the path of the temporary file to which a state is written before it replaces the state file."""
    return path.with_name(f".{path.name}.part")


def _refuse(path: Path, why: str) -> Loaded:
    return Loaded(session=None, outcome=f"state file {path}: not used, because it {why}; positioning restarts")
