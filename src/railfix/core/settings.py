"""Base classes of settings and messages as frozen pydantic models, and messages for invalid values."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any, Final, Self, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError, ValidationInfo, field_validator

from railfix.core.errors import SettingsError
from railfix.core.notebook import html_table


def misspelt(names: Iterable[str], known: Iterable[str]) -> dict[str, str]:
    """Return the unknown names that resemble a known name, as a mapping to the most similar known name.

    Examples
    --------
    >>> misspelt(["lattitude_deg", "remark"], ["latitude_deg", "height_m"])
    {'lattitude_deg': 'latitude_deg'}
    """
    known = list(known)
    close = {
        name: difflib.get_close_matches(name.lower().replace(" ", "_"), known, n=1, cutoff=0.75)
        for name in names
        if name not in known
    }
    return {name: matches[0] for name, matches in close.items() if matches}


class Checked(BaseModel):
    """Base of settings and messages: frozen models that are validated on construction and reject unknown names."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)

    if not TYPE_CHECKING:  # type checkers use the signature that follows from the fields

        def __init__(self, **values: Any) -> None:
            try:
                super().__init__(**values)
            except ValidationError as error:
                raise SettingsError(f"{type(self).__name__}: {first_fault(type(self), error)}") from None

        __init__.__pydantic_base_init__ = True  # with it, pydantic skips this method for values from a file

        def __setattr__(self, name: str, value: Any) -> None:
            raise SettingsError(
                f"{type(self).__name__} cannot be changed; make another object: settings.replaced({name}={value!r})"
            )

        def __delattr__(self, name: str) -> None:
            raise SettingsError(f"{type(self).__name__} cannot be changed; replaced() returns a copy with other values")

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """Yield the settings that differ from their defaults; a default may depend on earlier settings."""
        values = {name: getattr(self, name) for name in type(self).model_fields}
        for name, field in type(self).model_fields.items():
            value = values[name]
            if field.is_required() or value != field.get_default(call_default_factory=True, validated_data=values):
                yield name, value

    def _repr_html_(self) -> str:
        rows = [{"setting": str(name), "value": repr(value)} for name, value in self.__repr_args__()]
        of = f"{len(rows)} of {len(type(self).model_fields)} settings differ from their defaults"
        return html_table(rows, caption=f"{type(self).__name__}: {of}")

    def replaced(self, **changes: Any) -> Self:
        """Return a copy with some settings changed; raise SettingsError if a value is out of range or a name is
        unknown.
        """
        values = {name: getattr(self, name) for name in type(self).model_fields}
        return type(self)(**{**values, **changes})


class Settings(Checked):
    """Base of all settings, which users write in files and on the command line."""

    @field_validator("*", mode="before")
    @classmethod
    def _as_written(cls, value: Any, info: ValidationInfo) -> Any:
        """Reject a boolean for a number (pydantic would accept it as 1 or 0); accept a path or a string for a list.

        The items in a string are separated by commas, as in ``systems=G,E``.
        """
        if not isinstance(value, (bool, str, Path)):
            return value
        kind = cls.model_fields[str(info.field_name)].annotation
        if isinstance(value, bool):
            if is_number(kind):
                raise ValueError("a number was expected")
        elif get_origin(kind) is tuple:
            return (value,) if isinstance(value, Path) else tuple(filter(None, map(str.strip, value.split(","))))
        return value


def is_number(kind: Any) -> bool:
    """Return whether a type is a number type, or the union of a number type and None; bool is no number type."""
    parts = [get_args(part)[0] if get_origin(part) is Annotated else part for part in (kind, *get_args(kind))]
    return bool not in parts and (int in parts or float in parts)


Model = TypeVar("Model", bound=BaseModel)
INPUTS: Final = "Inputs"  #: Help-text heading of the options that name input files.


def validate(model: type[Model], values: Mapping[str, Any], *, source: str) -> Model:
    """Validate plain values as settings.

    Raise SettingsError, which names the `source` (a path, or "--set"), if a value is invalid.
    """
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        raise SettingsError(f"{source}: {first_fault(model, error)}") from None


def first_fault(model: type[BaseModel], error: ValidationError) -> str:
    """Describe the first fault: a setting and its expected value, or an unknown name and the known names."""
    # an unknown name is reported first, because it may be the misspelt name of a setting that is reported as missing
    first = min(error.errors(), key=lambda fault: fault["type"] != "extra_forbidden")
    where = ".".join(str(part) for part in first["loc"] if part != "[key]")
    if first["type"] == "extra_forbidden":
        known = sorted(_fields_at(model, first["loc"][:-1]))
        close = [*misspelt([str(first["loc"][-1])], known).values()] or _in_groups(model, str(first["loc"][-1]))
        hint = "".join(f"; did you mean {name!r}?" for name in close)
        names = f"; known are {', '.join(known)}" if known else ""
        return f"unknown setting {where}{names}{hint}"
    if first["type"] == "missing":
        return f"setting {where} is missing"
    message = first["msg"].removeprefix("Value error, ").replace("a valid tuple", "a list")
    given = "" if isinstance(first["input"], (Mapping, BaseModel)) else f", got {first['input']!r}"
    return f"{f'setting {where}: ' if where else ''}{message}{given}"


def _in_groups(model: type[BaseModel], name: str) -> list[str]:
    """Return ``[group.name]`` if exactly one group of a model has a setting of this name; otherwise an empty list."""
    groups = {key: field.annotation for key, field in model.model_fields.items()}
    found = [
        f"{key}.{name}"
        for key, kind in groups.items()
        if isinstance(kind, type) and issubclass(kind, BaseModel) and name in kind.model_fields
    ]
    return found if len(found) == 1 else []


def _fields_at(model: type[BaseModel], location: tuple[int | str, ...]) -> set[str]:
    """Return the names of the settings in the group at a location of a nested model; empty if there is no group."""
    kind: Any = model
    for part in location:
        if get_origin(kind) is dict:
            kind = get_args(kind)[1]
        elif get_origin(kind) in (tuple, list) and isinstance(part, int):
            kind = get_args(kind)[0]
        elif isinstance(kind, type) and issubclass(kind, BaseModel) and part in kind.model_fields:
            kind = kind.model_fields[str(part)].annotation
        else:
            return set()
        present = [member for member in get_args(kind) if member is not NoneType]
        if NoneType in get_args(kind) and len(present) == 1:
            kind = present[0]
    return set(kind.model_fields) if isinstance(kind, type) and issubclass(kind, BaseModel) else set()
