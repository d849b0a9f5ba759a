"""Examination of TOML files with models or scenarios."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal, get_args

from railfix.core.notebook import plural
from railfix.core.settings_files import read_toml
from railfix.integrity.protection.support_message import FORMAT as SUPPORT_FORMAT
from railfix.integrity.protection.support_message import read_integrity_support
from railfix.ranges.cn0_curve_file import FORMAT as CURVE_FORMAT
from railfix.ranges.cn0_curve_file import read_cn0_curve
from railfix.ranges.error_model import FORMAT as ERROR_FORMAT
from railfix.ranges.error_model import read_error_model

ModelKind = Literal["C/N0 curve", "error model", "integrity support message", "scenario"]
MODEL_KINDS: Final[tuple[ModelKind, ...]] = get_args(ModelKind)
#: Kind of model file for each value of the entry `format` without its version.
_FORMATS: Final[dict[str, ModelKind]] = {
    CURVE_FORMAT.rpartition(" ")[0]: "C/N0 curve",
    ERROR_FORMAT.rpartition(" ")[0]: "error model",
    SUPPORT_FORMAT.rpartition(" ")[0]: "integrity support message",
}
#: Top-level entries that only scenarios and recipes for several scenarios have.
_OF_SCENARIO: Final = {"duration_s", "rate_hz", "line", "run", "runs", "sky", "receiver", "environment", "stations"}
#: Option of `railfix run` that accepts each kind of model file.
_OPTIONS: Final[dict[ModelKind, str]] = {
    "C/N0 curve": "--cn0-curve",
    "error model": "--error-model",
    "integrity support message": "--set integrity_support=",
}


def find_model_kind(path: Path) -> ModelKind | None:
    """Return the kind of a TOML file from its entries, or None for a vehicle or settings file."""
    values = read_toml(path, what="a TOML file")
    name = str(values.get("format", "")).rpartition(" ")[0]
    return _FORMATS.get(name) or ("scenario" if _OF_SCENARIO & values.keys() else None)


def read_model_facts(path: Path, kind: ModelKind) -> str:
    """Return a phrase on the content of a model file. Errors of the model's reader are raised."""
    if kind == "scenario":
        return "input of railfix simulate; a run does not use it"
    if kind == "C/N0 curve":
        means = read_cn0_curve(path).means
        return f"C/N0 over elevation of {', '.join(f'{mean.kind} {mean.signal}' for mean in means)} ({_OPTIONS[kind]})"
    if kind == "error model":
        source = read_error_model(path).source
        return f"range errors of {plural(source.epochs, 'epoch')} ({_OPTIONS[kind]})"
    letters = ", ".join(read_integrity_support(path).constellation)
    return f"constellations {letters} ({_OPTIONS[kind]}FILE)"


def model_options(models: dict[ModelKind, Path]) -> list[str]:
    """Return the options of `railfix run` for model files. Scenarios are omitted, because they have no option."""
    options = {kind: _OPTIONS[kind] for kind in models if kind in _OPTIONS}
    texts = [f"{option}{'' if option.endswith('=') else ' '}{models[kind]}" for kind, option in options.items()]
    return [word for text in texts for word in text.split(" ", maxsplit=1)]
