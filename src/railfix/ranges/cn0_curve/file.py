"""The file of a C/N0 curve: TOML that a person can read and check.

::

    format = "railfix C/N0 curve 1"

    [source]
    antenna = "NOV703GGG.R2    NONE"
    receiver = "JAVAD TRE_G3T DELTA"
    ...

    [[curve]]
    kind = "G"
    signal = "1C"
    elevation_deg = [2.5, 7.5, 12.5]
    mean_dbhz = [33.10, 36.42, 38.90]
    spread_db = [2.10, 1.71, 1.40]
    count = [812, 1204, 1377]
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import fields
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np

from railfix.core.errors import InputFileError
from railfix.core.files import toml_string, write_whole
from railfix.ranges.cn0_curve.curve import KINDS, Cn0Curve, Cn0CurveSource, Cn0Mean

FORMAT: Final = "railfix C/N0 curve 1"
_COLUMNS: Final = ("elevation_deg", "mean_dbhz", "spread_db", "count")
#: Values that a column may take.
_RANGES: Final = {
    "elevation_deg": (0.0, 90.0),
    "mean_dbhz": (0.0, 100.0),
    "spread_db": (0.0, 50.0),
    "count": (1, 2**53),
}
_TEXTS: Final = ("antenna", "receiver", "marker", "start", "end", "railfix_version")


def write_cn0_curve(curve: Cn0Curve, path: str | PathLike[str]) -> None:
    """Write a curve; the file appears whole or not at all.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    write_whole(path, "\n".join(_lines(curve)) + "\n", what="curve")


def _numbers(values: Iterable[float], digits: int) -> str:
    return "[" + ", ".join(f"{value:.{digits}f}" for value in values) + "]"


def _lines(curve: Cn0Curve) -> Iterable[str]:
    source = curve.source
    yield "# Mean C/N0 over elevation, measured under open sky; belongs to this antenna and receiver only."
    yield f"format = {toml_string(FORMAT)}"
    yield ""
    yield "[source]"
    for name in _TEXTS:
        yield f"{name} = {toml_string(getattr(source, name))}"
    yield f"epochs = {source.epochs}"
    yield f"position_ecef_m = {_numbers(source.position_ecef_m, 3)}"
    for name, digest in source.files:
        yield ""
        yield "[[source.file]]"
        yield f"name = {toml_string(name)}"
        yield f"sha256 = {toml_string(digest)}"
    for mean in curve.means:
        yield ""
        yield f"[[curve]]  # {KINDS.get(mean.kind, mean.kind)}"
        yield f"kind = {toml_string(mean.kind)}"
        yield f"signal = {toml_string(mean.signal)}"
        for name, digits in zip(_COLUMNS, (3, 2, 2, 0), strict=True):
            yield f"{name} = {_numbers(getattr(mean, name), digits)}"


def read_cn0_curve(path: str | PathLike[str]) -> Cn0Curve:
    """Read a curve.

    Raises
    ------
    InputFileError
        The file is missing, unreadable, no curve, or a field of it is missing or out of range.
    """
    try:
        values = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputFileError(path, f"cannot be read as a C/N0 curve ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputFileError(path, "is no text file; a C/N0 curve is TOML, made by railfix cn0-curve") from None
    except tomllib.TOMLDecodeError as error:
        raise InputFileError(path, f"is no valid TOML, which a C/N0 curve is: {error}") from None
    if values.get("format") != FORMAT:
        raise InputFileError(
            path, f"is no C/N0 curve: it must say format = '{FORMAT}'; make one with railfix cn0-curve"
        )
    unknown = sorted(set(values) - {"format", "source", "curve"})
    if unknown:
        raise InputFileError(path, f"has the unknown entry {unknown[0]}; known are format, source, curve")
    tables = values.get("curve")
    if not isinstance(tables, list) or not tables:
        raise InputFileError(path, "has no [[curve]], at least one is expected")
    means = tuple(_mean(path, table, f"curve {i + 1}") for i, table in enumerate(tables))
    source = _source(path, values.get("source"))
    try:
        return Cn0Curve(means=means, source=source)
    except ValueError as error:
        raise InputFileError(path, f"{error}; each kind and signal stands once") from None


def _mean(path: str | PathLike[str], table: Any, where: str) -> Cn0Mean:
    if not isinstance(table, dict) or set(table) != {"kind", "signal", *_COLUMNS}:
        raise InputFileError(path, f"{where} must have exactly the entries kind, signal, {', '.join(_COLUMNS)}")
    kind, signal = table["kind"], table["signal"]
    if kind not in KINDS:
        raise InputFileError(path, f"{where}: kind is {kind!r}, one of {', '.join(KINDS)} was expected")
    if not isinstance(signal, str) or len(signal) != 2:
        raise InputFileError(path, f"{where}: signal is {signal!r}, a RINEX 3 code as '1C' was expected")
    where = f"{where} ({kind} {signal})"
    columns = {name: _column(path, table[name], name, where) for name in _COLUMNS}
    if len({len(values) for values in columns.values()}) != 1:
        raise InputFileError(path, f"{where}: {', '.join(_COLUMNS)} must have the same number of values")
    try:
        return Cn0Mean(
            kind=kind,
            signal=signal,
            elevation_deg=np.array(columns["elevation_deg"], dtype=np.float64),
            mean_dbhz=np.array(columns["mean_dbhz"], dtype=np.float64),
            spread_db=np.array(columns["spread_db"], dtype=np.float64),
            count=np.array(columns["count"], dtype=np.int64),
        )
    except ValueError as error:
        raise InputFileError(path, f"{where}: {error}") from None


def _column(path: str | PathLike[str], values: Any, name: str, where: str) -> list[float]:
    low, high = _RANGES[name]
    kinds = (int,) if name == "count" else (int, float)
    if not isinstance(values, list):
        raise InputFileError(path, f"{where}: {name} must be a list of numbers")
    for value in values:
        if isinstance(value, bool) or not isinstance(value, kinds) or not low <= value <= high:
            raise InputFileError(path, f"{where}: {name} has {value!r}, numbers from {low} to {high} were expected")
    return values


def _source(path: str | PathLike[str], table: Any) -> Cn0CurveSource:
    if not isinstance(table, dict):
        raise InputFileError(path, "has no [source], which says what the curve was made from")
    known = {item.name for item in fields(Cn0CurveSource)} - {"files"} | {"file"}
    unknown = sorted(set(table) - known)
    if unknown:
        raise InputFileError(path, f"[source] has the unknown entry {unknown[0]}; known are {', '.join(sorted(known))}")
    texts = {name: table.get(name, "") for name in _TEXTS}
    epochs, position, files = table.get("epochs", 0), table.get("position_ecef_m", []), table.get("file", [])
    if not all(isinstance(value, str) for value in texts.values()):
        raise InputFileError(path, f"[source]: {', '.join(_TEXTS)} must be texts")
    if isinstance(epochs, bool) or not isinstance(epochs, int) or epochs < 0:
        raise InputFileError(path, f"[source]: epochs is {epochs!r}, a number of epochs was expected")
    if not isinstance(position, list) or not all(isinstance(value, float) for value in position):
        raise InputFileError(path, "[source]: position_ecef_m must be a list of x, y, z in metres")
    try:
        pairs = tuple((str(file["name"]), str(file["sha256"])) for file in files)
    except (TypeError, KeyError):
        raise InputFileError(path, "[[source.file]] must have name and sha256") from None
    return Cn0CurveSource(**texts, epochs=epochs, position_ecef_m=tuple(position), files=pairs)
