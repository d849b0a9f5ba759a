"""The file of an error model: TOML with the bins, the conditions, and one array of numbers a column.

::

    format = "railfix error model 2"
    covers = "local"

    [bins]
    elevation_deg = [0.0, 15.0, 30.0, 45.0, 60.0, 90.0]
    sectors = 4
    cn0_dbhz = [0.0, 30.0, 35.0, 40.0, 45.0, 60.0]

    [conditions]
    systems = ["G", "E"]
    codes = "raw"
    ...

    [before]
    count = [12, ...]
    bias_m = [1.25, ...]

The bins are in the order of elevation, then sector, then C/N0. `pooled` counts into `model.POOLED`. Files of
version 1, which described their conditions by a sentence, are rejected: make them anew.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field

from railfix.core.errors import InputFileError
from railfix.core.files import FilePath
from railfix.core.settings import Settings, write_toml
from railfix.ranges.error_model.model import (
    POOLED,
    BinStatistics,
    Conditions,
    ErrorBins,
    ErrorModel,
    ErrorModelSource,
    FaultRate,
)
from railfix.ranges.model_file import read_model_file

FORMAT: Final = "railfix error model 2"
_COLUMNS: Final = tuple(item.name for item in fields(BinStatistics))
_COUNTS: Final = ("count", "blocks", "pooled")
_Count = Annotated[int, Field(ge=0)]


class _Columns(Settings):
    """`BinStatistics` as columns, one number a bin; NaN where a bin has none."""

    count: tuple[_Count, ...]
    blocks: tuple[_Count, ...]
    bias_m: tuple[float, ...]
    sigma_m: tuple[float, ...]
    bound_bias_m: tuple[float, ...]
    bound_sigma_m: tuple[float, ...]
    pooled: tuple[Annotated[int, Field(ge=0, lt=len(POOLED))], ...]


class _ErrorModelFile(Settings):
    """Content of the file."""

    format: Literal["railfix error model 2"]
    covers: Literal["local", "satellite_and_atmosphere"]
    bins: ErrorBins
    conditions: Conditions | None = None
    source: ErrorModelSource = Field(default_factory=ErrorModelSource)
    faults: FaultRate | None = None
    before: _Columns
    after: _Columns


def write_error_model(model: ErrorModel, path: FilePath) -> None:
    """Write a model; the file appears whole or not at all.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    file = _ErrorModelFile(
        format=FORMAT,
        covers=model.covers,
        bins=model.bins,
        conditions=model.conditions,
        source=model.source,
        faults=model.faults,
        before=_columns(model.before),
        after=_columns(model.after),
    )
    comment = "Errors of corrected pseudoranges by elevation, azimuth from the car's front, and C/N0."
    write_toml(path, file.model_dump(exclude_none=True), what="error model", comment=comment)


def _columns(statistics: BinStatistics) -> _Columns:
    """Columns to the millimetre."""
    return _Columns(**{name: tuple(np.round(getattr(statistics, name).ravel(), 3).tolist()) for name in _COLUMNS})


def read_error_model(path: FilePath) -> ErrorModel:
    """Read a model.

    Raises
    ------
    InputFileError
        The file is missing, unreadable, no error model, of version 1, or an entry of it is missing or out of range.
    """
    file = read_model_file(
        _ErrorModelFile, path, what="an error model", format_name=FORMAT, command="railfix error-model"
    )
    return ErrorModel(
        bins=file.bins,
        before=_statistics(path, "before", file.before, file.bins),
        after=_statistics(path, "after", file.after, file.bins),
        covers=file.covers,
        conditions=file.conditions,
        source=file.source,
        faults=file.faults,
    )


def _statistics(path: FilePath, name: str, columns: _Columns, bins: ErrorBins) -> BinStatistics:
    arrays = {}
    for column in _COLUMNS:
        values = np.array(getattr(columns, column), dtype=np.int64 if column in _COUNTS else np.float64)
        if len(values) != np.prod(bins.shape):
            raise InputFileError(
                path, f"entry {name}.{column}: {np.prod(bins.shape)} values were expected, one a bin, got {len(values)}"
            )
        if column not in ("bias_m", *_COUNTS) and (values < 0.0).any():
            raise InputFileError(path, f"entry {name}.{column}: must not be negative, got {np.nanmin(values)}")
        arrays[column] = values.reshape(bins.shape)
    return BinStatistics(**arrays)  # type: ignore[arg-type]
