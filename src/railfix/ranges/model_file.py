"""Files of models made from recordings: TOML with a format name, validated as a whole."""

from __future__ import annotations

from typing import TypeVar

from railfix.core.errors import InputFileError, SettingsError
from railfix.core.files import FilePath
from railfix.core.settings import Settings, read_toml, validated

Model = TypeVar("Model", bound=Settings)


def read_model_file(model: type[Model], path: FilePath, *, what: str, format_name: str, command: str) -> Model:
    """Content of a model file.

    Parameters
    ----------
    model : type of Settings
        With a field `format`.
    what : str
        What the file should be, with its article ("an error model").
    format_name : str
        Name and version of the format, the value of `format`.
    command : str
        Command that makes such a file.

    Raises
    ------
    InputFileError
        The file is missing, unreadable, of another format or version, or an entry is unknown, missing or out of
        range.
    """
    values = read_toml(path, what=what)
    written = values.get("format")
    if written != format_name:
        name = format_name.rsplit(" ", 1)[0]
        if isinstance(written, str) and written.startswith(f"{name} "):
            problem = (
                f"is {what} of format '{written}', this version reads '{format_name}'; make it anew with {command}"
            )
        else:
            problem = f"is not {what}: format = '{format_name}' was expected; make one with {command}"
        raise InputFileError(path, problem)
    try:
        return validated(model, values, source=str(path))
    except SettingsError as error:
        raise InputFileError(path, str(error).removeprefix(f"{path}: ").replace("setting ", "entry ", 1)) from None
