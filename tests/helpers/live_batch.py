"""Logs with observations dropped at random, and the tables of a log cut into chunks in different ways."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
import polars as pl

from railfix.gnss.observations import Observations
from railfix.live.stream import single_epochs
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.processor_state import State
from railfix.pipeline.result_tables import observations_table, passing_table, positions_table, train_table
from railfix.pipeline.results import Result

TABLES = {
    "positions": (positions_table, ("time_gpst", "antenna")),
    "observations": (observations_table, ("time_gpst", "antenna", "satellite", "signal")),
    "train": (train_table, ("time_gpst", "antenna")),
}


def thinned(log: Observations, share: float, seed: int = 1, away: int = 2) -> Observations:
    """The log without a share of its observations and of its epochs at random, and with satellites that go and come."""
    rng = np.random.default_rng(seed)
    gone = rng.random((len(log), len(log.satellite))) < share
    gone[rng.random(len(log)) < share] = True
    if share:
        for _ in range(away):
            first, channel = rng.integers(len(log)), rng.integers(len(log.satellite))
            gone[first : first + len(log) // 6, channel] = True
    values: dict[str, Any] = {}
    for item in fields(log):
        value = getattr(log, item.name)
        if isinstance(value, np.ndarray) and value.shape == gone.shape:
            blank = np.nan if value.dtype.kind == "f" else np.zeros((), value.dtype)
            values[item.name] = np.where(gone, blank, value)
    return observed(replace(log, **values))


def observed(log: Observations) -> Observations:
    """The log without the epochs in which nothing was observed: no receiver sends them."""
    seen = np.isfinite(log.code_m).any(axis=1) | np.isfinite(log.phase_cycles).any(axis=1)
    arrays = {item.name: getattr(log, item.name) for item in fields(log)}
    own = {
        name: array[seen]
        for name, array in arrays.items()
        if isinstance(array, np.ndarray) and name not in ("satellite", "signal") and array.shape[:1] == seen.shape
    }
    return replace(log, **own)


def chunks_of(logs: Mapping[str, Observations], sizes: Sequence[int]) -> list[dict[str, Observations]]:
    """Chunks that cover some numbers of time tags in turn, with all channels of the log."""
    tags = np.unique(np.concatenate([log.time for log in logs.values()]))
    found, first = [], 0
    while first < len(tags):
        size = sizes[len(found) % len(sizes)]
        end = tags[first + size] if first + size < len(tags) else tags[-1] + np.timedelta64(1, "s")
        chunk = {}
        for name, log in logs.items():
            rows = np.searchsorted(log.time, [tags[first], end])
            chunk[name] = log[int(rows[0]) : int(rows[1])]
        found.append(chunk)
        first += size
    return found


def epochs_of(logs: Mapping[str, Observations]) -> list[dict[str, Observations]]:
    """Single epochs with the channels that are observed in them, as receivers send them."""
    found: dict[int, dict[str, Observations]] = {}
    for name, log in logs.items():
        for epoch in single_epochs(log):
            found.setdefault(int(epoch.time[0].astype(np.int64)), {})[name] = epoch
    return [found[tag] for tag in sorted(found)]


def tables_of(processor: EpochProcessor, chunks: Sequence[Mapping[str, Observations]]) -> dict[str, pl.DataFrame]:
    """All tables of a log that is given in chunks, in the order of their keys."""
    state: State | None = None
    parts: dict[str, list[pl.DataFrame]] = {name: [] for name in (*TABLES, "passings")}
    for chunk in chunks:
        result, state = processor.process(chunk, state)
        _collect(parts, result)
    tables = {name: pl.concat(parts[name]).sort(TABLES[name][1]) for name in TABLES if parts[name]}
    return tables | ({"passings": pl.concat(parts["passings"])} if parts["passings"] else {})


def _collect(parts: dict[str, list[pl.DataFrame]], result: Result) -> None:
    for name, (table_of, _) in TABLES.items():
        table = table_of(result)
        if len(table.columns):
            parts[name].append(table)
    if any(own.passings for own in result.fusion.values()):
        parts["passings"].append(passing_table(result))


def differences(whole: Mapping[str, pl.DataFrame], other: Mapping[str, pl.DataFrame], atol: float) -> dict[str, str]:
    """The columns in which tables differ, with what differs; rows of channels that are not observed do not count.

    Numbers differ by more than `atol`, or 1e-9 of them.
    """
    found: dict[str, str] = {}
    for name, table in whole.items():
        keys = list(TABLES[name][1]) if name in TABLES else []
        theirs = other.get(name)
        if theirs is None:
            found[name] = "no such table"
            continue
        if keys:
            table = table.join(theirs.select(keys), on=keys, how="semi").sort(keys)
            missing = len(theirs) - len(table)
            if missing:
                found[f"{name}: rows"] = f"{missing} rows that the whole log does not have"
        if len(table) != len(theirs):
            found[f"{name}: rows"] = f"{len(table)} and {len(theirs)}"
            continue
        for column in table.columns:
            a, b = table[column], theirs[column]
            if a.dtype.is_float():
                x, y = a.fill_null(np.nan).to_numpy(), b.fill_null(np.nan).to_numpy()
                wrong = ~(np.isclose(x, y, rtol=1e-9, atol=atol, equal_nan=True))
                largest = np.nanmax(np.abs(x[wrong] - y[wrong]), initial=0.0)
                text = f"{int(wrong.sum())} of {len(x)}, by up to {largest:.3g}"
            else:
                wrong = ~(a.eq_missing(b)).to_numpy()
                text = f"{int(wrong.sum())} of {len(a)}"
            if wrong.any():
                row = int(np.argmax(wrong))
                found[f"{name}: {column}"] = f"{text}; first {[table[k][row] for k in keys]}: {a[row]}, {b[row]}"
    return found
