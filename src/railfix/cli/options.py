"""Command-line options made from `Settings` models, where each is declared once."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import date, datetime
from functools import wraps
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import typer
from pydantic import ValidationError

from railfix.core.errors import SettingsError
from railfix.core.settings import Settings
from railfix.run.output import FileKind, Overwrite, check_output_file

_DAY: Final = "%Y-%m-%d"
_TIMES: Final = ["%Y-%m-%dT%H:%M:%S", "%Y-%m-%dT%H:%M:%S.%f", _DAY]

Model = TypeVar("Model", bound=Settings)

OutOption = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results; made where absent.")]
OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", rich_help_panel="Choices", help="Replace results that are already there.")
]
LenientOption = Annotated[
    bool,
    typer.Option(
        "--lenient",
        rich_help_panel="Choices",
        help="Count broken lines of the input files and continue, instead of stopping.",
    ),
]


def overwriting(asked: bool) -> Overwrite:
    """What `OverwriteOption` asks for."""
    return "replace" if asked else "refuse"


def check_outputs(*outputs: tuple[Path | None, FileKind], overwrite: bool, inputs: Iterable[Path | None]) -> list[Path]:
    """Raise where a file cannot or must not be written (`check_output_file`); return those that are asked for."""
    asked = [(path, kind) for path, kind in outputs if path is not None]
    read = [path for path in inputs if path is not None]
    for path, kind in asked:
        others = [other for other, _ in asked if other is not path]
        check_output_file(path, overwrite=overwriting(overwrite), inputs=[*read, *others], kind=kind)
    return [path for path, _ in asked]


@dataclass(frozen=True)
class Without:
    """Fields of a model that a command has no option for."""

    names: tuple[str, ...]

    def __init__(self, *names: str) -> None:
        object.__setattr__(self, "names", names)


@dataclass(frozen=True, kw_only=True)
class _Option:
    """One option: the field of a model (`path` leads to it) and the parameter of the command."""

    path: tuple[str, ...]
    parameter: inspect.Parameter
    default: Any
    switch: tuple[str, ...] = ()
    numbers: bool = False

    @property
    def name(self) -> str:
        """As the user writes it."""
        info = get_args(self.parameter.annotation)[1]
        return str(info.default)


def from_models(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command whose parameters that are `Settings` models are replaced by an option per field.

    Fields without `railfix.core.settings.option` get none, nor do those named by `Without`; fields that are
    models are replaced in turn. Two models may share an option: each receives its value.
    """
    hints = get_type_hints(command, include_extras=True)
    parameters: dict[str, inspect.Parameter] = {}
    models: dict[str, tuple[type[Settings], list[_Option]]] = {}
    for name, parameter in inspect.signature(command).parameters.items():
        hint = hints[name]
        model, without = (get_args(hint)[0], get_args(hint)[1:]) if get_origin(hint) is Annotated else (hint, ())
        if not (isinstance(model, type) and issubclass(model, Settings)):
            parameters[name] = parameter.replace(annotation=hint, kind=inspect.Parameter.KEYWORD_ONLY)
            continue
        excluded = [left for item in without if isinstance(item, Without) for left in item.names]
        models[name] = (model, _options(model, excluded))
        parameters |= {option.parameter.name: option.parameter for option in models[name][1]}

    @wraps(command)
    def expanded(**values: Any) -> None:
        built = {name: _built(model, options, values) for name, (model, options) in models.items()}
        used = {option.parameter.name for _, options in models.values() for option in options}
        command(**{name: value for name, value in values.items() if name not in used}, **built)

    # typer takes both the signature and the annotations
    expanded.__signature__ = inspect.Signature(list(parameters.values()))  # type: ignore[attr-defined]
    expanded.__annotations__ = {name: parameter.annotation for name, parameter in parameters.items()}
    del expanded.__wrapped__
    return expanded


def _options(model: type[Settings], excluded: list[str], path: tuple[str, ...] = ()) -> list[_Option]:
    found: list[_Option] = []
    for name, field in model.model_fields.items():
        if name in excluded:
            continue
        if isinstance(field.annotation, type) and issubclass(field.annotation, Settings):
            found += _options(field.annotation, excluded, (*path, name))
        elif isinstance(field.json_schema_extra, dict) and "panel" in field.json_schema_extra:
            found.append(_option(name, field, (*path, name)))
    return found


def _option(name: str, field: Any, path: tuple[str, ...]) -> _Option:
    extra: dict[str, Any] = field.json_schema_extra
    flag = extra["option"] or f"--{name.replace('_', '-')}"
    words = get_args(field.annotation) if get_origin(field.annotation) is Literal else ()
    switch = tuple(words) if extra["option"] and len(words) == 2 else ()
    kind, several = _plain_type(field.annotation)
    numbers = several and kind in (int, float)
    default: Any = inspect.Parameter.empty if field.is_required() else None
    helped = field.description
    settings: dict[str, Any] = {"metavar": extra["metavar"], "rich_help_panel": extra["panel"]}
    if switch:
        kind, default = bool, False
    elif kind in (date, datetime):
        settings |= {"formats": [_DAY]} if kind is date else {"parser": _gps_time}
        kind = datetime
    elif not several and field.default is not None and not field.is_required():
        default = field.default
    if numbers:
        shown = "" if field.is_required() else f"; {','.join(f'{value:g}' for value in field.default)} by default"
        helped += f" Numbers with commas, or repeated{shown}."
    annotation: Any = list[str] if numbers else list[kind] if several else kind  # type: ignore[valid-type]
    if default is None:
        annotation = annotation | None
    info = typer.Option(flag, help=helped, **settings)
    parameter = inspect.Parameter(
        "_".join(path), inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[annotation, info]
    )
    return _Option(path=path, parameter=parameter, default=field.default, switch=switch, numbers=numbers)


def _gps_time(text: str) -> datetime:
    """Read a time of the command line."""
    for form in _TIMES:
        with suppress(ValueError):
            return datetime.strptime(text, form)
    zone = "; GPS time has no time zone, and UTC is behind it by the leap seconds" if text[-1:] in "Zz" else ""
    raise typer.BadParameter(f"{text!r} is no GPS time such as 2026-05-12 or 2026-05-12T03:00:00.5{zone}")


def _plain_type(annotation: Any) -> tuple[Any, bool]:
    """Return the type of one value, and whether there may be several."""
    if get_origin(annotation) is Annotated:
        return _plain_type(get_args(annotation)[0])
    if get_origin(annotation) in (Union, UnionType):
        return _plain_type(next(part for part in get_args(annotation) if part is not NoneType))
    if get_origin(annotation) is tuple:
        return _plain_type(get_args(annotation)[0])[0], True
    return annotation, False


def _built(model: type[Model], options: list[_Option], given: Mapping[str, Any]) -> Model:
    """Return the model with the values of the command line; SettingsError names the option that is out of range."""
    values: dict[str, Any] = {}
    for option in options:
        value = given[option.parameter.name]
        if value is None or value == []:
            continue
        if option.switch:
            value = option.switch[int(value)]
        elif option.numbers:
            value = tuple(part.strip() for text in value for part in text.split(","))
        elif isinstance(value, datetime) and option.path[-1] == "date":
            value = value.date()
        if value == option.default:
            continue
        place = values
        for group in option.path[:-1]:
            place = place.setdefault(group, {})
        place[option.path[-1]] = value
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        message = first["msg"].removeprefix("Value error, ")
        names = {option.path: option.name for option in options}
        where = tuple(part for part in first["loc"] if isinstance(part, str))
        if where not in names:
            raise SettingsError(message) from None
        raise SettingsError(f"{names[where]}: {message}, got {first['input']!r}") from None
