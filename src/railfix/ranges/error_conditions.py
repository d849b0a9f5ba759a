"""Settings that affect pseudorange errors, and their comparison between a run and an error model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from railfix.core.settings import Settings


class Conditions(Settings):
    """Settings of a run that affect the errors of its corrected pseudoranges."""

    systems: tuple[str, ...]  #: Letters of the constellations.
    signals: dict[str, tuple[str, ...]]  #: Signals of each constellation in order of preference.
    screens: tuple[str, ...]  #: Names of the active screens.
    elevation_mask_deg: float = Field(ge=0.0, lt=90.0)
    codes: Literal["raw", "smoothed"]  #: Pseudoranges are raw or carrier-smoothed.
    #: Sources of the delays; "off": the delays are not corrected.
    ionosphere: Literal["klobuchar", "off", "sbas"]
    troposphere: Literal["saastamoinen", "off", "sbas"]


def condition_differences(
    first: Conditions, second: Conditions, *, names: tuple[str, str] = ("model", "run")
) -> tuple[str, ...]:
    """Return a text such as "codes: model raw, run smoothed" for each field in which `first` and `second` differ.

    The order of screens and constellations does not matter; the order of signals, which is a preference, does.
    """
    differences = []
    for name in Conditions.model_fields:
        values = [getattr(conditions, name) for conditions in (first, second)]
        compared = [sorted(value) if name in ("systems", "screens") else value for value in values]
        if compared[0] != compared[1]:
            texts = (f"{name} {_text(value)}" for name, value in zip(names, values, strict=True))
            differences.append(f"{name.removesuffix('_deg').replace('_', ' ')}: {', '.join(texts)}")
    return tuple(differences)


def _text(value: object) -> str:
    if isinstance(value, Mapping):
        return " ".join(f"{key}:{'/'.join(part)}" for key, part in sorted(value.items())) or "none"
    if isinstance(value, tuple):
        return " ".join(value) or "none"
    return f"{value:g} deg" if isinstance(value, float) else str(value)
