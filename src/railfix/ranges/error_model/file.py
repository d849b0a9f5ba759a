"""The file of an error model: TOML that a person can read and check, one row a bin.

::

    format = "railfix error model 1"
    covers = "local"

    [bins]
    elevation_deg = [0.0, 15.0, 30.0, 45.0, 60.0, 90.0]
    sectors = 4
    cn0_dbhz = [0.0, 30.0, 35.0, 40.0, 45.0, 60.0]

    [before]
    columns = ["count", "blocks", "bias_m", "sigma_m", "bound_bias_m", "bound_sigma_m", "pooled"]
    rows = [
      [12, 3, 1.250, 8.112, 1.300, 12.480, 1],
    ]

The rows stand in order of elevation, then sector, then C/N0. `pooled` counts into `model.POOLED`.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator
from dataclasses import fields
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np

from railfix.core.errors import InputFileError
from railfix.core.files import toml_string, write_whole
from railfix.ranges.error_model.model import COVERS, POOLED, BinStatistics, ErrorBins, ErrorModel, ErrorModelSource

FORMAT: Final = "railfix error model 1"
_COLUMNS: Final = tuple(item.name for item in fields(BinStatistics))
_WHOLE: Final = ("count", "blocks", "pooled")
_TEXTS: Final = ("base", "conditions", "start", "end", "railfix_version")


def write_error_model(model: ErrorModel, path: str | PathLike[str]) -> None:
    """Write a model; the file appears whole or not at all.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    write_whole(path, "\n".join(_lines(model)) + "\n", what="error model")


def _lines(model: ErrorModel) -> Iterator[str]:
    source, bins = model.source, model.bins
    yield "# Errors of corrected pseudoranges by elevation, azimuth from the car's front, and C/N0."
    yield f"format = {toml_string(FORMAT)}"
    yield f"covers = {toml_string(model.covers)}"
    yield ""
    yield "[bins]"
    yield f"elevation_deg = {list(bins.elevation_deg)}"
    yield f"sectors = {bins.sectors}"
    yield f"cn0_dbhz = {list(bins.cn0_dbhz)}"
    yield ""
    yield "[source]"
    yield f"runs = [{', '.join(toml_string(run) for run in source.runs)}]"
    for name in _TEXTS:
        yield f"{name} = {toml_string(getattr(source, name))}"
    yield f"epochs = {source.epochs}"
    for name, digest in source.files:
        yield ""
        yield "[[source.file]]"
        yield f"name = {toml_string(name)}"
        yield f"sha256 = {toml_string(digest)}"
    for name in ("before", "after"):
        statistics: BinStatistics = getattr(model, name)
        yield ""
        yield f"[{name}]"
        yield f"columns = {json.dumps(list(_COLUMNS))}"
        yield "rows = ["
        columns = [getattr(statistics, column).ravel().tolist() for column in _COLUMNS]
        for row in zip(*columns, strict=True):
            cells = (_cell(column, value) for column, value in zip(_COLUMNS, row, strict=True))
            yield f"  [{', '.join(cells)}],"
        yield "]"


def _cell(column: str, value: float) -> str:
    return str(int(value)) if column in _WHOLE else "nan" if np.isnan(value) else f"{value:.3f}"


def read_error_model(path: str | PathLike[str]) -> ErrorModel:
    """Read a model.

    Raises
    ------
    InputFileError
        The file is missing, unreadable, no error model, or an entry of it is missing or out of range.
    """
    try:
        values = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputFileError(path, f"cannot be read as an error model ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputFileError(path, "is no text file; an error model is TOML, made by railfix error-model") from None
    except tomllib.TOMLDecodeError as error:
        raise InputFileError(path, f"is no valid TOML, which an error model is: {error}") from None
    if values.get("format") != FORMAT:
        raise InputFileError(
            path, f"is no error model: it must say format = '{FORMAT}'; make one with railfix error-model"
        )
    known = {"format", "covers", "bins", "source", "before", "after"}
    if set(values) != known:
        wrong = sorted(set(values) ^ known)[0]
        raise InputFileError(path, f"must have exactly the entries {', '.join(sorted(known))}; look at {wrong}")
    covers = values["covers"]
    if covers not in COVERS:
        raise InputFileError(path, f"covers is {covers!r}, one of {', '.join(COVERS)} was expected")
    bins = _bins(path, values["bins"])
    return ErrorModel(
        bins=bins,
        before=_statistics(path, values["before"], "before", bins),
        after=_statistics(path, values["after"], "after", bins),
        covers=covers,
        source=_source(path, values["source"]),
    )


def _bins(path: str | PathLike[str], table: Any) -> ErrorBins:
    names = {item.name for item in fields(ErrorBins)}
    if not isinstance(table, dict) or set(table) != names:
        raise InputFileError(path, f"[bins] must have exactly the entries {', '.join(sorted(names))}")
    try:
        return ErrorBins(
            elevation_deg=tuple(float(x) for x in table["elevation_deg"]),
            sectors=int(table["sectors"]),
            cn0_dbhz=tuple(float(x) for x in table["cn0_dbhz"]),
        )
    except (TypeError, ValueError) as error:
        raise InputFileError(path, f"[bins]: {error}") from None


def _statistics(path: str | PathLike[str], table: Any, name: str, bins: ErrorBins) -> BinStatistics:
    if not isinstance(table, dict) or table.get("columns") != list(_COLUMNS):
        raise InputFileError(path, f"[{name}] must have columns = {list(_COLUMNS)}")
    rows, size = table.get("rows"), int(np.prod(bins.shape))
    if not isinstance(rows, list) or len(rows) != size:
        raise InputFileError(path, f"[{name}] must have {size} rows, one a bin")
    for i, row in enumerate(rows):
        numbers = isinstance(row, list) and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in row)
        if not numbers or len(row) != len(_COLUMNS):
            raise InputFileError(path, f"[{name}] row {i + 1} must be {len(_COLUMNS)} numbers, got {row!r}")
    values = np.array(rows, dtype=np.float64).T.reshape(len(_COLUMNS), *bins.shape)
    columns = dict(zip(_COLUMNS, values, strict=True))
    for column in ("sigma_m", "bound_sigma_m", "bound_bias_m", *_WHOLE):
        bad = np.argwhere((columns[column] < 0) | (np.isnan(columns[column]) & (column in _WHOLE)))
        if len(bad):
            row = int(np.ravel_multi_index(tuple(bad[0]), bins.shape)) + 1
            raise InputFileError(path, f"[{name}] row {row}: {column} must not be negative")
    if (columns["pooled"] >= len(POOLED)).any():
        raise InputFileError(path, f"[{name}]: pooled must be below {len(POOLED)}")
    whole = {column: columns[column].astype(np.int64) for column in _WHOLE}
    return BinStatistics(**(columns | whole))  # type: ignore[arg-type]


def _source(path: str | PathLike[str], table: Any) -> ErrorModelSource:
    known = {item.name for item in fields(ErrorModelSource)} - {"files"} | {"file"}
    if not isinstance(table, dict) or set(table) - known:
        raise InputFileError(path, f"[source] may have the entries {', '.join(sorted(known))}")
    try:
        return ErrorModelSource(
            runs=tuple(str(run) for run in table.get("runs", [])),
            epochs=int(table.get("epochs", 0)),
            files=tuple((str(f["name"]), str(f["sha256"])) for f in table.get("file", [])),
            **{name: str(table.get(name, "")) for name in _TEXTS},
        )
    except (TypeError, KeyError, ValueError):
        raise InputFileError(path, "[[source.file]] must have name and sha256, epochs must be a number") from None
