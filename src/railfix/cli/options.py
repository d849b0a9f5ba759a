"""Conversion of `Settings` models to command-line options, and of the given options to settings."""

from __future__ import annotations

import inspect
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, date, datetime
from functools import wraps
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import typer
from pydantic import ValidationError

from railfix.core.errors import SettingsError
from railfix.core.options import option
from railfix.core.settings import INPUTS, Settings
from railfix.core.settings_files import read_toml
from railfix.core.timescale import utc_to_gpst
from railfix.pipeline.config import PRESETS, SCREEN_NAMES, Config, parse_config
from railfix.run.output import FileKind, Overwrite, check_output_file
from railfix.run.processor_setup import with_measured_priors

_DAY: Final = "%Y-%m-%d"

Model = TypeVar("Model", bound=Settings)

OutOption = Annotated[
    Path, typer.Option("--out", metavar="DIR", help="Folder for the results; it is created if it does not exist.")
]
OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", rich_help_panel="Choices", help="Replace existing results.")
]
VerboseOption = Annotated[
    bool,
    typer.Option("--verbose", rich_help_panel="Choices", help="Print all notes and tables."),
]
JsonOption = Annotated[
    bool, typer.Option("--json", rich_help_panel="Choices", help="Print the results as one line of JSON.")
]


def overwriting(asked: bool) -> Overwrite:
    """Return "replace" if `--overwrite` is given, otherwise "refuse"."""
    return "replace" if asked else "refuse"


def check_outputs(*outputs: tuple[Path | None, FileKind], overwrite: bool, inputs: Iterable[Path | None]) -> list[Path]:
    """Return the paths that are not None; raise the errors of `check_output_file` if a file must not be written."""
    asked = [(path, kind) for path, kind in outputs if path is not None]
    read = [path for path in inputs if path is not None]
    for path, kind in asked:
        others = [other for other, _ in asked if other is not path]
        check_output_file(path, overwrite=overwriting(overwrite), inputs=[*read, *others], kind=kind)
    return [path for path, _ in asked]


class Without:
    """Annotation that names the fields of a model for which a command has no option."""

    def __init__(self, *names: str) -> None:
        self.names = names


@dataclass(frozen=True, kw_only=True)
class _Option:
    """Option of a command: the command's parameter, and the names of the nested fields that lead to the value in a
    model.
    """

    path: tuple[str, ...]
    parameter: inspect.Parameter
    default: Any
    switch: tuple[str, ...] = ()
    numbers: bool = False

    @property
    def name(self) -> str:
        """Name of the option on the command line, such as ``--out``."""
        info = get_args(self.parameter.annotation)[1]
        return str(info.default)


def from_models(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command in which each parameter that is a `Settings` model is replaced by one option per field.

    Fields that are not declared by `railfix.core.options.option`, and fields named by `Without`, have no option. A
    field that is itself a model is replaced by the options of its fields. An option that two models share sets the
    field in both models.
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
    def run(**values: Any) -> None:
        built = {name: _built(model, options, values) for name, (model, options) in models.items()}
        used = {option.parameter.name for _, options in models.values() for option in options}
        command(**{name: value for name, value in values.items() if name not in used}, **built)

    # typer reads both the signature and the annotations of the function
    run.__signature__ = inspect.Signature(list(parameters.values()))  # type: ignore[attr-defined]
    run.__annotations__ = {name: parameter.annotation for name, parameter in parameters.items()}
    del run.__wrapped__
    return run


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
        helped += f" Separate numbers by commas, or repeat the option{shown}."
    annotation: Any = list[str] if numbers else list[kind] if several else kind  # type: ignore[valid-type]
    if default is None:
        annotation = annotation | None
    info = typer.Option(flag, help=helped, **settings)
    parameter = inspect.Parameter(
        "_".join(path), inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[annotation, info]
    )
    return _Option(path=path, parameter=parameter, default=field.default, switch=switch, numbers=numbers)


def _gps_time(text: str) -> datetime:
    """Return the GPS time that a text states; a time with a time zone is converted.

    Raise BadParameter if the text is not a time.
    """
    try:
        time = datetime.fromisoformat(text.strip().replace("/", "-"))
    except ValueError:
        raise typer.BadParameter(
            f"{text!r} is not a GPS time such as 2026-05-12, 2026-05-12T03:00 or 2026-05-12T03:00:00.5 (a "
            "time with a "
            "zone, such as 2026-05-12T03:00Z, is converted)"
        ) from None
    if time.tzinfo is None:
        return time
    utc = np.datetime64(time.astimezone(UTC).replace(tzinfo=None), "ns")
    gps: datetime = utc_to_gpst(utc).astype("datetime64[us]").item()
    return gps


def _plain_type(annotation: Any) -> tuple[Any, bool]:
    """Return the type of one value of an annotated option, and whether several values are allowed."""
    if get_origin(annotation) is Annotated:
        return _plain_type(get_args(annotation)[0])
    if get_origin(annotation) in (Union, UnionType):
        return _plain_type(next(part for part in get_args(annotation) if part is not NoneType))
    if get_origin(annotation) is tuple:
        return _plain_type(get_args(annotation)[0])[0], True
    return annotation, False


def _built(model: type[Model], options: list[_Option], given: Mapping[str, Any]) -> Model:
    """Return the model with the values given on the command line.

    Raise SettingsError if a value is invalid; if only one option is wrong, the message names it.
    """
    values: dict[str, Any] = {}
    for chosen in options:
        value = given[chosen.parameter.name]
        if value is None or value == []:
            continue
        if chosen.switch:
            value = chosen.switch[int(value)]
        elif chosen.numbers:
            value = tuple(part.strip() for text in value for part in text.split(","))
        if value == chosen.default:
            continue
        place = values
        for group in chosen.path[:-1]:
            place = place.setdefault(group, {})
        place[chosen.path[-1]] = value
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        message = first["msg"].removeprefix("Value error, ")
        names = {own.path: own.name for own in options}
        where = tuple(part for part in first["loc"] if isinstance(part, str))
        if where not in names:
            raise SettingsError(message) from None
        raise SettingsError(f"{names[where]}: {message}, got {first['input']!r}") from None


class Choices(Settings):
    """Settings of a run from the command line. Each field overrides the fields that are declared before it."""

    preset: str | None = option(
        "Base preset, which other settings override: default, strict (fewer positions of higher integrity), or p1 "
        "(limits for geodetic receivers at 10 Hz, from paper P1, which describes the screens).",
        None,
        metavar="NAME",
    )
    config: Path | None = option(
        "Settings file; settings that are missing in the file have default values.", None, metavar="TOML"
    )
    setting: tuple[str, ...] = option(
        "Setting that overrides the settings file, such as --set elevation.mask_deg=15; may be repeated.",
        (),
        name="--set",
        metavar="KEY=VALUE",
    )
    screens: str | None = option(
        "Screens to use: elevation, cn0, doppler, antenna_pair, raim, antenna_spacing, or none.",
        None,
        metavar="NAME,NAME",
    )
    without: tuple[str, ...] = option("Switch one screen off; may be repeated.", (), metavar="NAME")
    filter: Literal["track", "off"] | None = option(
        "Run the filter along the track over all epochs (train.csv, train.parquet): track (default) or off.", None
    )
    cn0_curve: Path | None = option(
        "File written by `railfix cn0-curve`: mean C/N0 of antenna and receiver by satellite elevation.",
        None,
        metavar="TOML",
    )
    error_model: Path | None = option(
        "File written by `railfix error-model`: pseudorange errors on this line, for weights and protection levels.",
        None,
        metavar="TOML",
    )
    sbas: tuple[Path, ...] = option(
        "Log of SBAS messages (RTKLIB .sbs, EMS, RINEX 2 B, UBX, SBF), or the word `stream`, to use the messages in "
        "the receivers' own logs and streams. With this option, ranges are corrected as DO-229D requires, and "
        "satellites without a valid correction are rejected.",
        (),
        metavar="FILE",
        panel=INPUTS,
    )


def resolve_settings(choices: Choices) -> tuple[Config, dict[str, Any]]:
    """Return the resulting settings, and the settings that were given explicitly.

    Options of the command line override the settings file. Raise SettingsError if a setting is unknown, out of range
    or given twice.
    """
    values: dict[str, Any] = {}
    source = "command line"
    if choices.config is not None:
        values = read_toml(choices.config, what="a configuration file")
        parse_config(values, source=str(choices.config))
    if choices.preset is not None:
        if choices.preset not in PRESETS:
            raise SettingsError(f"--preset {choices.preset}: unknown preset; the presets are {', '.join(PRESETS)}")
        values["preset"] = choices.preset
    check_set_once(choices.setting)
    for text in choices.setting:
        if choices.preset is not None and text.partition("=")[0].strip() == "preset":
            raise SettingsError(f"the preset is given twice (--preset {choices.preset} and --set {text}); give it once")
        set_value(values, text)
        source = "--set"
    if choices.screens is not None:
        values["screens"] = [] if choices.screens.strip() == "none" else _screens("--screens", choices.screens)
    for name in ("filter", "cn0_curve", "error_model"):
        if (value := getattr(choices, name)) is not None:
            values[name] = str(value)
    if choices.sbas:
        words = [str(path) for path in choices.sbas]
        values["sbas"] = "stream" if words == ["stream"] else words
    if choices.without:
        dropped = [name for text in choices.without for name in _screens("--without", text)]
        values["screens"] = [name for name in parse_config(values, source=source).screens if name not in dropped]
    return with_measured_priors(parse_config(values, source=source)), values


def _screens(option: str, text: str) -> list[str]:
    """Return the screen names in a comma-separated text; raise SettingsError if a name is unknown or repeated."""
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in SCREEN_NAMES:
            raise SettingsError(f"{option} {text}: unknown screen {name!r}; known are {', '.join(SCREEN_NAMES)}")
    if len(set(names)) != len(names):
        raise SettingsError(f"{option} {text}: name each screen once")
    return names


def check_set_once(settings: tuple[str, ...]) -> None:
    """Raise SettingsError if two KEY=VALUE texts have the same key."""
    keys = [text.partition("=")[0].strip() for text in settings]
    if repeated := [key for key in keys if keys.count(key) > 1]:
        raise SettingsError(f"--set {repeated[0]} is given {keys.count(repeated[0])} times; give it once")


def set_value(values: dict[str, Any], text: str) -> None:
    """Insert one KEY=VALUE into nested settings; a value that is not valid TOML is kept as text.

    Raise SettingsError if the text has no key or no equals sign, or if the key uses a single setting as a group.
    """
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise SettingsError(f"--set {text}: expected KEY=VALUE, for example elevation.mask_deg=15")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value.strip()
    *groups, last = (part.strip() for part in key.split("."))
    place = values
    for group in groups:
        place = place.setdefault(group, {})
        if not isinstance(place, dict):
            raise SettingsError(f"--set {text}: {group} is a single setting, not a group")
    place[last] = parsed
