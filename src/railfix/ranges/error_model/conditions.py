"""Conditions under which an error model holds, compared field by field."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from railfix.core.settings import Settings


class Conditions(Settings):
    """Settings of a run that the errors of its corrected pseudoranges depend on.

    Attributes
    ----------
    systems : tuple of str
        Letters of the constellations.
    signals : dict of str to tuple of str
        Signals of each constellation in order of preference.
    screens : tuple of str
        Active screens.
    elevation_mask_deg : float [deg]
    codes : {"raw", "smoothed"}
        Pseudoranges as received, or smoothed by the carrier phase.
    ionosphere, troposphere : str
        Models of the delays: "klobuchar", "saastamoinen", "off", or "sbas".
    """

    systems: tuple[str, ...]
    signals: dict[str, tuple[str, ...]]
    screens: tuple[str, ...]
    elevation_mask_deg: float = Field(ge=0.0, lt=90.0)
    codes: Literal["raw", "smoothed"]
    ionosphere: Literal["klobuchar", "off", "sbas"]
    troposphere: Literal["saastamoinen", "off", "sbas"]


def condition_differences(
    first: Conditions, second: Conditions, *, names: tuple[str, str] = ("model", "run")
) -> tuple[str, ...]:
    """Fields in which two conditions differ, one text each: "codes: model raw, run smoothed".

    The order of screens and constellations does not count; that of signals, which is a preference, does.
    """
    differences = []
    for field in Conditions.model_fields:
        values = [getattr(conditions, field) for conditions in (first, second)]
        compared = [sorted(value) if field in ("systems", "screens") else value for value in values]
        if compared[0] != compared[1]:
            texts = (f"{name} {_text(value)}" for name, value in zip(names, values, strict=True))
            differences.append(f"{field.removesuffix('_deg').replace('_', ' ')}: {', '.join(texts)}")
    return tuple(differences)


def _text(value: object) -> str:
    if isinstance(value, Mapping):
        return " ".join(f"{key}:{'/'.join(part)}" for key, part in sorted(value.items())) or "none"
    if isinstance(value, tuple):
        return " ".join(value) or "none"
    return f"{value:g} deg" if isinstance(value, float) else str(value)
