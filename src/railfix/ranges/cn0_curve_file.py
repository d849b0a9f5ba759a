"""TOML files of the mean C/N0 as a function of elevation."""

from __future__ import annotations

from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field, field_validator

from railfix.core.errors import InputFileError
from railfix.core.settings import Settings
from railfix.core.settings_files import read_model_file, write_toml
from railfix.core.staged_files import FilePath
from railfix.ranges.cn0_curve import KINDS, Cn0Curve, Cn0CurveSource, Cn0Mean

__all__ = ["FORMAT", "read_cn0_curve", "write_cn0_curve"]

FORMAT: Final = "railfix C/N0 curve 1"
#: Number of decimals written for each column of a curve.
_DIGITS: Final = {"elevation_deg": 3, "mean_dbhz": 2, "spread_db": 2, "count": 0}


def _number(low: float, high: float) -> object:
    return Field(ge=low, le=high, strict=True, allow_inf_nan=False)


class _Curve(Settings):
    """Curve in the file, with the columns of `Cn0Mean`."""

    kind: str
    signal: str = Field(min_length=2, max_length=2)
    elevation_deg: tuple[Annotated[float, _number(0.0, 90.0)], ...]
    mean_dbhz: tuple[Annotated[float, _number(0.0, 100.0)], ...]
    spread_db: tuple[Annotated[float, _number(0.0, 50.0)], ...]
    count: tuple[Annotated[int, Field(ge=1, strict=True)], ...]

    @field_validator("kind")
    @classmethod
    def _known_kind(cls, value: str) -> str:
        if value not in KINDS:
            raise ValueError(f"one of {', '.join(KINDS)} was expected")
        return value


class _CurveFile(Settings):
    """Content of the file of a C/N0 curve."""

    format: Literal["railfix C/N0 curve 1"]
    source: Cn0CurveSource
    curve: tuple[_Curve, ...] = Field(min_length=1)


def write_cn0_curve(curve: Cn0Curve, path: FilePath) -> None:
    """Write a curve atomically; raise OutputError if the file cannot be written."""
    curves = [
        {
            "kind": mean.kind,
            "signal": mean.signal,
            **{name: np.round(getattr(mean, name), digits).tolist() for name, digits in _DIGITS.items()},
        }
        for mean in curve.means
    ]
    comment = "Mean C/N0 by elevation, measured under open sky; valid for this antenna and receiver only."
    source = {**curve.source.model_dump(), "position_ecef_m": np.round(curve.source.position_ecef_m, 3).tolist()}
    values = {"format": FORMAT, "source": source, "curve": curves}
    write_toml(path, values, what="curve", comment=comment)


def read_cn0_curve(path: FilePath) -> Cn0Curve:
    """Read a C/N0 curve from its file.

    Raises InputFileError if the file is missing, unreadable or not a C/N0 curve, or if an entry is unknown, missing or
    out of range.
    """
    file = read_model_file(_CurveFile, path, what="a C/N0 curve", format_name=FORMAT, command="railfix cn0-curve")
    means = tuple(
        _mean(path, curve, f"curve {i + 1} ({curve.kind} {curve.signal})") for i, curve in enumerate(file.curve)
    )
    try:
        return Cn0Curve(means=means, source=file.source)
    except ValueError as error:
        raise InputFileError(path, f"{error}; each combination of kind and signal must occur once") from None


def _mean(path: FilePath, curve: _Curve, where: str) -> Cn0Mean:
    columns = {name: np.array(getattr(curve, name)) for name in _DIGITS}
    if len({len(values) for values in columns.values()}) != 1:
        raise InputFileError(path, f"{where}: {', '.join(_DIGITS)} must have the same number of values")
    try:
        return Cn0Mean(kind=curve.kind, signal=curve.signal, **columns)
    except ValueError as error:
        raise InputFileError(path, f"{where}: {error}") from None
