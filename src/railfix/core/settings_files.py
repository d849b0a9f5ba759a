"""Settings and model files in TOML."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import tomli_w

from railfix.core.errors import InputFileError, SettingsError
from railfix.core.settings import Model, Settings, validate
from railfix.core.staged_files import FilePath, check_path, write_whole


def read_toml(path: FilePath, *, what: str) -> dict[str, Any]:
    """Read the values of a TOML file; `what` names the expected kind of file in messages ("a vehicle file").

    Raise InputFileError if the file is missing, unreadable, not UTF-8, or not TOML, and SettingsError if `path` is not
    a path.
    """
    check_path(path, what=f"the path of {what}")
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputFileError(path, f"cannot be read as {what} ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputFileError(path, f"is not a text file; {what} is TOML in UTF-8") from None
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputFileError(path, f"is not valid TOML ({error}); {what} was expected") from None


def load_settings(model: type[Model], path: FilePath, *, what: str = "a settings file") -> Model:
    """Read settings from a TOML file; raise the errors of `read_toml` and `validate`."""
    return validate(model, read_toml(path, what=what), source=str(path))


def write_toml(path: FilePath, values: Mapping[str, Any], *, what: str = "file", comment: str = "") -> None:
    """Write values as TOML below an optional comment; raise OutputError if the file cannot be written."""
    head = "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    write_whole(path, head + tomli_w.dumps(dict(values)), what=what)


ModelFile = TypeVar("ModelFile", bound=Settings)


def read_model_file(model: type[ModelFile], path: FilePath, *, what: str, format_name: str, command: str) -> ModelFile:
    """Read a TOML model file whose entry `format` is `format_name`.

    Raise InputFileError if the file is of another format or version, or has an invalid entry. `what` names the kind of
    file, and `command` names the command that creates such files.
    """
    values = read_toml(path, what=what)
    written = values.get("format")
    if written != format_name:
        name = format_name.rsplit(" ", 1)[0]
        if isinstance(written, str) and written.startswith(f"{name} "):
            problem = (
                f"is {what} of format '{written}', but this version reads '{format_name}'; make it again with {command}"
            )
        else:
            problem = f"is not {what}: format = '{format_name}' was expected; make one with {command}"
        raise InputFileError(path, problem)
    try:
        return validate(model, values, source=str(path))
    except SettingsError as error:
        raise InputFileError(path, str(error).removeprefix(f"{path}: ").replace("setting ", "entry ", 1)) from None
