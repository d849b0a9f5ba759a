"""Settings from the command line: a preset, a file, single settings, screens on and off."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from railfix.core.errors import SettingsError

if TYPE_CHECKING:
    from railfix.pipeline.config import Config

_PANEL = "Choices"

PresetOption = Annotated[
    str | None,
    typer.Option(
        "--preset",
        metavar="NAME",
        rich_help_panel=_PANEL,
        help="Settings that all others stand over: default; strict, certainty before rate; p1, the limits of the "
        "paper that the screens are from, for geodetic receivers at 10 Hz.",
    ),
]
ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", metavar="TOML", rich_help_panel=_PANEL, help="Settings; defaults where not given."),
]
SettingOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        rich_help_panel=_PANEL,
        help="One setting, over the file's: --set elevation.mask_deg=15; may be repeated.",
    ),
]
ScreensOption = Annotated[
    str | None,
    typer.Option(
        "--screens",
        metavar="NAME,NAME",
        rich_help_panel=_PANEL,
        help="The screens that are on, of elevation, cn0, doppler, antenna_pair, raim, antenna_spacing; or none.",
    ),
]
WithoutOption = Annotated[
    list[str] | None,
    typer.Option("--without", metavar="NAME", rich_help_panel=_PANEL, help="Switch one screen off; may be repeated."),
]
CurveOption = Annotated[
    Path | None,
    typer.Option(
        "--cn0-curve",
        metavar="TOML",
        rich_help_panel=_PANEL,
        help="Mean C/N0 over elevation of antenna and receiver, made by railfix cn0-curve.",
    ),
]
SbasOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--sbas",
        metavar="FILE",
        rich_help_panel="Inputs",
        help="Log of SBAS messages (RTKLIB .sbs, EMS, RINEX 2 B); its corrections take the place of the models, and "
        "satellites without a valid one are refused.",
    ),
]
ErrorModelOption = Annotated[
    Path | None,
    typer.Option(
        "--error-model",
        metavar="TOML",
        rich_help_panel=_PANEL,
        help="Errors of the pseudoranges on this line, made by railfix error-model, for weights and protection level.",
    ),
]


@dataclass(frozen=True, kw_only=True)
class Choices:
    """What the command line says about the settings, in the order in which one stands over the other.

    Attributes
    ----------
    config : Path or None
    preset : str or None
        Over the one that the file names.
    setting : sequence of str
        KEY=VALUE.
    screens : str or None
        Names with commas, or "none".
    without : sequence of str
        Screens to switch off.
    cn0_curve, error_model : Path or None
    sbas : sequence of Path
    """

    config: Path | None = None
    preset: str | None = None
    setting: tuple[str, ...] = ()
    screens: str | None = None
    without: tuple[str, ...] = ()
    cn0_curve: Path | None = None
    error_model: Path | None = None
    sbas: tuple[Path, ...] = ()


def settings_of(choices: Choices) -> tuple[Config, dict[str, Any]]:
    """Settings of a file with those of the command line on top.

    Returns
    -------
    Config
    dict
        The settings that were asked for, as opposed to defaults.

    Raises
    ------
    SettingsError
        A setting is misspelt, out of range, or not written as KEY=VALUE; a screen or preset is unknown.
    InputFileError
        The file cannot be read.
    """
    from railfix.core.settings import read_toml
    from railfix.pipeline.config import parse_config

    values: dict[str, Any] = {}
    source = "command line"
    if choices.config is not None:
        values = read_toml(choices.config, what="a configuration file")
        parse_config(values, source=str(choices.config))
    if choices.preset is not None:
        values["preset"] = _preset(choices.preset)
    for text in choices.setting:
        set_value(values, text)
        source = "--set"
    if choices.screens is not None:
        values["screens"] = [] if choices.screens.strip() == "none" else _screens("--screens", choices.screens)
    if choices.cn0_curve is not None:
        values["cn0_curve"] = str(choices.cn0_curve)
    if choices.error_model is not None:
        values["error_model"] = str(choices.error_model)
    if choices.sbas:
        values["sbas"] = [str(path) for path in choices.sbas]
    if choices.without:
        dropped = [name for text in choices.without for name in _screens("--without", text)]
        values["screens"] = [name for name in parse_config(values, source=source).screens if name not in dropped]
    return parse_config(values, source=source), values


def _preset(name: str) -> str:
    from railfix.pipeline.config import PRESETS

    if name not in PRESETS:
        raise SettingsError(f"--preset {name}: unknown preset; known are {', '.join(PRESETS)}")
    return name


def _screens(option: str, text: str) -> list[str]:
    """Names of screens, with commas between them."""
    from railfix.pipeline.config import SCREENS

    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in SCREENS:
            raise SettingsError(f"{option} {text}: unknown screen {name!r}; known are {', '.join(SCREENS)}")
    if len(set(names)) != len(names):
        raise SettingsError(f"{option} {text}: name each screen once")
    return names


def set_value(values: dict[str, Any], text: str) -> None:
    """Put one KEY=VALUE into nested settings; the value is TOML, or a bare word."""
    import tomllib

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
