"""Settings as plain tables, and back: frozen dataclasses from what TOML holds, misspelt keys and wrong values refused.

A list of tables becomes a tuple of dataclasses, a table of tables a dict of them; where a setting may
be None the word "none" says so.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from datetime import datetime
from difflib import get_close_matches
from functools import lru_cache
from typing import Any, Final, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import TypeAdapter, ValidationError

from railfix.core.errors import SettingsError

#: Fields that come from Python only.
_NOT_IN_FILES: Final = ("multipath",)


def from_table(kind: type[Any], table: Any, *, where: str, source: str) -> Any:
    """A dataclass from a table.

    Parameters
    ----------
    kind : dataclass
    table : dict
    where : str
        Dotted name of the table, empty at the top.
    source : str
        The file, for messages.

    Raises
    ------
    SettingsError
        A key is unknown, a value is of another kind or out of range, or a setting is missing; the
        message names the file, the key and what was expected.
    """
    if not isinstance(table, Mapping):
        raise SettingsError(f"{source}: {where} must be a table of settings, got {table!r}")
    hints = _hints(kind)
    unknown = sorted(set(table) - set(hints))
    if unknown:
        close = get_close_matches(unknown[0], hints, 1)
        meant = f"; did you mean {close[0]}?" if close else ""
        raise SettingsError(
            f"{source}: unknown setting {_dotted(where, unknown[0])}{meant}; known are {', '.join(sorted(hints))}"
        )
    missing = [item.name for item in fields(kind) if _required(item) and item.name not in table]
    if missing:
        raise SettingsError(f"{source}: {where or 'the file'} lacks the setting {', '.join(missing)}")
    values = {
        name: _value(hints[name], value, where=_dotted(where, name), source=source) for name, value in table.items()
    }
    try:
        return kind(**values)
    except SettingsError as error:
        raise SettingsError(f"{source}: {where + ': ' if where else ''}{error}") from None


def _hints(kind: type[Any]) -> dict[str, Any]:
    hints = get_type_hints(kind)
    return {item.name: hints[item.name] for item in fields(kind) if item.name not in _NOT_IN_FILES}


def _required(item: Field[Any]) -> bool:
    return item.default is MISSING and item.default_factory is MISSING


def _dotted(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name


def _value(hint: Any, value: Any, *, where: str, source: str) -> Any:
    inner = get_args(hint)
    if type(None) in inner:
        (hint,) = (part for part in inner if part is not type(None))
        return None if value == "none" else _value(hint, value, where=where, source=source)
    if is_dataclass(hint):
        return from_table(hint, value, where=where, source=source)  # type: ignore[arg-type]
    if get_origin(hint) is tuple and is_dataclass(inner[0]):
        if not isinstance(value, list):
            raise SettingsError(f"{source}: {where} must be a list of tables, got {value!r}")
        return tuple(_value(inner[0], part, where=f"{where} {k}", source=source) for k, part in enumerate(value, 1))
    if get_origin(hint) is dict and is_dataclass(inner[1]):
        if not isinstance(value, Mapping):
            raise SettingsError(f"{source}: {where} must be a table of tables, got {value!r}")
        return {k: _value(inner[1], v, where=_dotted(where, k), source=source) for k, v in value.items()}
    if hint is np.datetime64:
        return _time(value, where=where, source=source)
    try:
        return _adapter(hint).validate_json(json.dumps(value, default=str), strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        place = "".join(f" {part + 1 if isinstance(part, int) else part}" for part in first["loc"])
        raise SettingsError(f"{source}: {where}{place}: {first['msg']}, got {first['input']!r}") from None


@lru_cache(maxsize=64)
def _adapter(hint: Any) -> TypeAdapter[Any]:
    return TypeAdapter(hint)


def _time(value: Any, *, where: str, source: str) -> np.datetime64:
    try:
        if isinstance(value, datetime):
            if value.tzinfo is not None:
                raise ValueError
            value = value.isoformat()
        if not isinstance(value, str) or not value.strip():
            raise ValueError
        return np.datetime64(value, "ns")
    except ValueError:
        raise SettingsError(
            f"{source}: {where} must be a time as 2024-03-05T03:10:00, GPS time without a zone, got {str(value)!r}"
        ) from None


def to_toml(settings: Any) -> str:
    """Settings as TOML that `from_table` reads back; None where that is the default is left out."""
    lines: list[str] = []
    _write_table(settings, "", lines)
    return "\n".join(lines).strip() + "\n"


def _write_table(settings: Any, where: str, lines: list[str]) -> None:
    later = []
    for item in fields(settings):
        value = getattr(settings, item.name)
        if _left_out(item, settings):
            continue
        if is_dataclass(value):
            later.append((item.name, value))
        elif isinstance(value, tuple) and value and is_dataclass(value[0]):
            lines += [f"{item.name} = [", *(f"    {_plain(part)}," for part in value), "]"]
        else:
            lines.append(f"{item.name} = {_plain(value)}")
    for name, value in later:
        inside = _dotted(where, name)
        lines += ["", f"[{inside}]"]
        _write_table(value, inside, lines)


def _plain(value: Any) -> str:
    """A value of TOML on one line."""
    if is_dataclass(value):
        kept = {item.name: getattr(value, item.name) for item in fields(value) if not _left_out(item, value)}
        return _plain(kept)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {_plain(part)}" for key, part in value.items()) + "}"
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(_plain(part) for part in value) + "]"
    if value is None:
        return '"none"'
    if isinstance(value, np.datetime64):
        whole = value == value.astype("datetime64[us]")
        return str(value.astype("datetime64[us]")) if whole else f'"{value}"'
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    return repr(value)


def _left_out(item: Field[Any], settings: Any) -> bool:
    value = getattr(settings, item.name)
    absent = (value is None and item.default is None) or (isinstance(value, float) and np.isnan(value))
    return item.name in _NOT_IN_FILES or absent
