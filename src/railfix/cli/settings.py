"""Settings from the command line: a preset, a file, single settings, screens on and off."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, Literal

from railfix.core.errors import SettingsError
from railfix.core.settings import INPUTS, Settings, option, read_toml
from railfix.pipeline.config import PRESETS, SCREEN_NAMES, Config, parse_config
from railfix.run.processor import with_measured_priors


class Choices(Settings):
    """Settings of a run as the command line gives them; later fields override earlier ones."""

    preset: str | None = option(
        "Base preset; other settings override it: default; strict, fewer positions of higher integrity; p1, the "
        "limits of the paper that the screens are from, for geodetic receivers at 10 Hz.",
        None,
        metavar="NAME",
    )
    config: Path | None = option("Settings file; defaults where it is silent.", None, metavar="TOML")
    setting: tuple[str, ...] = option(
        "One setting, overriding the file's: --set elevation.mask_deg=15; may be repeated.",
        (),
        name="--set",
        metavar="KEY=VALUE",
    )
    screens: str | None = option(
        "Screens that are on, of elevation, cn0, doppler, antenna_pair, raim, antenna_spacing; or none.",
        None,
        metavar="NAME,NAME",
    )
    without: tuple[str, ...] = option("Switch one screen off; may be repeated.", (), metavar="NAME")
    filter: Literal["track", "off"] | None = option(
        "Filter along the track over all epochs, into train.csv and train.parquet: track (the default) or off.",
        None,
    )
    cn0_curve: Path | None = option(
        "Mean C/N0 over elevation of antenna and receiver, from railfix cn0-curve.", None, metavar="TOML"
    )
    error_model: Path | None = option(
        "Pseudorange errors of this line for weights and protection level, from railfix error-model.",
        None,
        metavar="TOML",
    )
    sbas: tuple[Path, ...] = option(
        "Log of SBAS messages (RTKLIB .sbs, EMS, RINEX 2 B, UBX, SBF), or the word stream for those in the receivers' "
        "own logs and streams; their corrections replace the models, and satellites without a valid one are rejected.",
        (),
        metavar="FILE",
        panel=INPUTS,
    )


def settings_of(choices: Choices) -> tuple[Config, dict[str, Any]]:
    """Return the settings of the file, overridden by those of the command line; and those that were given.

    Raises
    ------
    SettingsError
        A setting is misspelt, out of range, or not written as KEY=VALUE; a screen or preset is unknown.
    InputFileError
        The file cannot be read.
    """
    values: dict[str, Any] = {}
    source = "command line"
    if choices.config is not None:
        values = read_toml(choices.config, what="a configuration file")
        parse_config(values, source=str(choices.config))
    if choices.preset is not None:
        values["preset"] = _preset(choices.preset)
    check_set_once(choices.setting)
    for text in choices.setting:
        if choices.preset is not None and text.partition("=")[0].strip() == "preset":
            raise SettingsError(f"the preset is given twice (--preset {choices.preset} and --set {text}); give it once")
        set_value(values, text)
        source = "--set"
    if choices.screens is not None:
        values["screens"] = [] if choices.screens.strip() == "none" else _screens("--screens", choices.screens)
    if choices.filter is not None:
        values["filter"] = choices.filter
    if choices.cn0_curve is not None:
        values["cn0_curve"] = str(choices.cn0_curve)
    if choices.error_model is not None:
        values["error_model"] = str(choices.error_model)
    if choices.sbas:
        words = [str(path) for path in choices.sbas]
        values["sbas"] = "stream" if words == ["stream"] else words
    if choices.without:
        dropped = [name for text in choices.without for name in _screens("--without", text)]
        values["screens"] = [name for name in parse_config(values, source=source).screens if name not in dropped]
    return with_measured_priors(parse_config(values, source=source)), values


def _preset(name: str) -> str:
    if name not in PRESETS:
        raise SettingsError(f"--preset {name}: unknown preset; known are {', '.join(PRESETS)}")
    return name


def _screens(option: str, text: str) -> list[str]:
    """Names of screens, with commas between them."""
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in SCREEN_NAMES:
            raise SettingsError(f"{option} {text}: unknown screen {name!r}; known are {', '.join(SCREEN_NAMES)}")
    if len(set(names)) != len(names):
        raise SettingsError(f"{option} {text}: name each screen once")
    return names


def check_set_once(settings: tuple[str, ...]) -> None:
    """Raise SettingsError where one setting is given twice."""
    keys = [text.partition("=")[0].strip() for text in settings]
    if repeated := [key for key in keys if keys.count(key) > 1]:
        raise SettingsError(f"--set {repeated[0]} is given {keys.count(repeated[0])} times; give it once")


def set_value(values: dict[str, Any], text: str) -> None:
    """Put one KEY=VALUE into nested settings; the value is TOML, or a bare word."""
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
