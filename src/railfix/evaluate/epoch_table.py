"""Table of the evaluated epochs: position, reference and error, one row per epoch and antenna."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import polars as pl

from railfix.core.arrays import Datetimes, Floats, Indices, Masks, Strings, places_in_groups
from railfix.core.errors import MismatchError
from railfix.core.timescale import seconds
from railfix.evaluate.evaluation_inputs import EvaluationOptions, RunFolder, floats
from railfix.evaluate.integrity import PARTS, STATED
from railfix.evaluate.place import Answers, PlaceErrors, TrackFiles, bracket, compute_errors
from railfix.io.reference_log import AntennaReference
from railfix.io.sections import Sections

#: Status of an epoch that is missing in the log.
NOT_LOGGED: Final = "not_logged"
#: Environment of epochs for which neither the reference nor the sections state an environment.
UNKNOWN: Final = "unknown"

#: Columns of the table of epochs, with their unit and meaning.
EPOCH_COLUMNS: Final[dict[str, str]] = {
    "run": "name of the run",
    "configuration": "settings of the run",
    "line": "name of the track",
    "time_gpst": "time tag of the receiver, GPS time",
    "antenna": "`front` or `rear`",
    "status": "status of the epoch; `not_logged` for epochs missing in the log",
    "observed": "whether the antenna has observations",
    "in_reference": "whether the reference trajectory covers the epoch",
    "reference_good": "whether the reference is accurate enough; true if it states no accuracy",
    "chainage_m": "chainage of the reference",
    "speed_mps": "speed of the reference, unsigned; computed from the reference positions if no speed is stated",
    "moved_m": "distance travelled since the first epoch with a reference",
    "environment": "environment stated by the reference, else by the sections, else `unknown`",
    "reference_sigma_m": "standard deviation of the reference along the track",
    "reference_source": "source of the reference position",
    "n_used": "number of satellites used",
    "positioned": "whether there is a position computed with the map",
    "conventional_positioned": "whether there is a 3-D single point",
    "error_m": "error of the position computed with the map, + toward the end of the line",
    "conventional_error_m": "error of the trajectory point nearest to the 3-D single point position, + toward the end "
    "of the line",
    "distance_m": "straight distance (3-D) from the position computed with the map to the reference",
    "along_sigma_m": "standard deviation along the line, as stated by the run",
    "branch_probability": "probability of the branch (only in rows of the filter along the track)",
    "sources": "measurements that the filter used",
    "interval_m": "distance travelled since the previous position",
    "gap_s": "time since the previous position",
    "conventional_interval_m": "distance travelled since the previous conventional position",
    "conventional_gap_s": "time since the previous conventional position",
    "block": "index of the time block within the run, for confidence limits",
}

#: Expression that is true for rows of the filter's table, the only table with branch probabilities.
OF_FILTER: Final = pl.col("branch_probability").is_not_null().any().over("run")


@dataclass(frozen=True, kw_only=True)
class AntennaEpochs:
    """Evaluated epochs of one antenna."""

    #: `EPOCH_COLUMNS` without run, configuration and line; then the protection levels with their parts.
    table: pl.DataFrame

    errors: PlaceErrors
    speed_from: str  #: Source of the speed: "reference", or "places" if computed from positions of the reference.
    outside: int  #: Number of epochs of the log that the reference does not cover.
    step_s: float  #: Median interval between the epochs of the log; NaN with fewer than two epochs.
    from_sections: int  #: Number of epochs with a reference at which the environment is taken from the sections.


def level_columns(table: pl.DataFrame) -> list[str]:
    """Return the names of a table's protection-level columns."""
    return [name for name in table.columns if "protection_level" in name and name.endswith("_m")]


def protection_columns(table: pl.DataFrame) -> list[str]:
    """Return the names of a table's protection-level columns, then the columns of their parts, causes and statuses."""
    levels = level_columns(table)
    endings = [f"_protection_{name}" for name in (*PARTS, *STATED)]
    return levels + [name for name in table.columns if name.endswith(tuple(endings))]


def below(tables: Sequence[pl.DataFrame]) -> pl.DataFrame:
    """Concatenate tables of epochs; if a table lacks a column, its rows have null in this column.

    The columns are removed from the given tables one by one, to save memory.
    """
    schema = {name: kind for table in tables for name, kind in table.schema.items()}
    lengths = [len(table) for table in tables]
    columns = []
    for name in (*EPOCH_COLUMNS, *protection_columns(pl.DataFrame(schema=schema))):
        parts = [
            table.drop_in_place(name) if name in table.columns else pl.Series(name, dtype=schema[name]).clear(rows)
            for table, rows in zip(tables, lengths, strict=True)
        ]
        columns.append(pl.concat(parts, rechunk=False))
    return pl.DataFrame(columns)


def with_missing(time: Datetimes) -> tuple[Datetimes, Masks, float]:
    """Return all epochs of a log including missing epochs, the mask of logged epochs, and the median interval [s].

    Epochs are missing where an interval is longer than 1.5 times the median interval; the missing epochs are spread
    evenly over this interval. With fewer than two epochs, the median interval is NaN.
    """
    if len(time) < 2:
        return time, np.ones(len(time), dtype=np.bool_), float("nan")
    gap = seconds(np.diff(time))
    step = float(np.median(gap))
    more = np.where(gap > 1.5 * step, np.round(gap / step).astype(np.int64) - 1, 0)
    left, number = places_in_groups(more)
    share = (number + 1) / (more[left] + 1)
    put_in = time[left] + (share * (time[left + 1] - time[left]).astype(np.float64)).astype("timedelta64[ns]")
    whole = np.concatenate([time, put_in])
    order = np.argsort(whole, kind="stable")
    return whole[order], (np.arange(len(whole)) < len(time))[order], step


def distance_travelled(
    time: Datetimes, step_m: Floats, known: Masks, speed_mps: Floats, *, options: EvaluationOptions
) -> Floats:
    """Return the distance travelled since the first known reference position, shape (T,) [m].

    `step_m` has the distances between successive known positions. Steps at a speed below `options.standing_mps` are not
    counted. Over gaps, the distance is interpolated in time. The result is NaN before the first and after the last
    known position.
    """
    at = np.flatnonzero(known)
    moved = np.full(len(time), np.nan)
    if not len(at):
        return moved
    duration = seconds(np.diff(time[at]))
    stated = np.abs(speed_mps[at])
    mean = (stated[1:] + stated[:-1]) / 2.0
    speed = np.where(np.isfinite(mean) & (duration <= options.reference_gap_s), mean, step_m / duration)
    total = np.concatenate([[0.0], np.cumsum(np.where(speed >= options.standing_mps, step_m, 0.0))])
    clock = seconds(time - time[at[0]])
    return np.asarray(np.interp(clock, clock[at], total, left=np.nan, right=np.nan), dtype=np.float64)


def since_last(values: Floats, has: Masks) -> Floats:
    """Return the increase of a quantity since the previous row at which the mask `has` is true, shape (T,).

    The increase is NaN where the mask is false, at the first row where it is true, and where the quantity is NaN.
    """
    grown = np.full(len(values), np.nan)
    at = np.flatnonzero(has & np.isfinite(values))
    grown[at[1:]] = np.diff(values[at])
    return grown


def antenna_epochs(
    run: RunFolder,
    antenna: str,
    reference: AntennaReference,
    *,
    sections: Sections | None,
    files: TrackFiles,
    options: EvaluationOptions,
) -> AntennaEpochs:
    """Return the epochs of one antenna of a run with their errors.

    Raise MismatchError if run and reference do not overlap in time, and the errors of `compute_errors`.
    """
    mine = run.positions.filter(pl.col("antenna") == antenna)
    time, logged, step_s = with_missing(mine["time_gpst"].to_numpy())
    own = _OwnColumns(mine, np.where(logged, np.cumsum(logged) - 1, len(mine)))
    at = bracket(time, reference.time, largest_gap_s=options.reference_gap_s)
    place, chainage = at.of(reference.ecef_m), at.of(reference.chainage_m)
    if not (at.inside & logged).any():
        spans = [f"({t[0]} to {t[-1]})" for t in (time, reference.time)]
        raise MismatchError(
            f"{run.path}: the {antenna} antenna's epochs {spans[0]} and its reference {spans[1]} (GPS time) have no "
            "time in common; give the reference of this run"
        )
    answers = own.answers(chainage, place)
    errors = compute_errors(run, antenna, answers, method=options.method, files=files)
    known = at.inside & (np.isfinite(chainage) if errors.method == "chainage" else np.isfinite(place[:, 0]))
    along = _steps(chainage if np.isfinite(chainage[known]).all() else place, known)
    stated_speed = at.of(reference.speed_mps)
    moved = distance_travelled(time, along, known, stated_speed, options=options)
    speed = np.where(np.isfinite(stated_speed), np.abs(stated_speed), _own_speed(time, along, known))
    sigma = at.of(reference.sigma_m)
    stated = np.where(known, reference.environment[at.nearest], "")
    environment = _environment(stated, sections, errors.reference_chainage_m)
    columns: dict[str, Any] = {
        "time_gpst": time,
        "antenna": np.full(len(time), antenna),
        "status": own.texts("status").fill_null(NOT_LOGGED),
        "observed": logged & np.append(mine["observed"].to_numpy(), False)[own.rows],
        "in_reference": known,
        "reference_good": known & ~(sigma > options.reference_sigma_m),
        "chainage_m": errors.reference_chainage_m,
        "speed_mps": np.where(known, speed, np.nan),
        "moved_m": moved,
        "environment": environment,
        "reference_sigma_m": sigma,
        "reference_source": np.where(known, reference.source[at.nearest], ""),
        "n_used": own.floats("n_used"),
        "positioned": np.isfinite(answers.chainage_m),
        "conventional_positioned": np.isfinite(answers.conventional_chainage_m),
        "error_m": errors.error_m,
        "conventional_error_m": errors.conventional_error_m,
        "distance_m": errors.distance_m,
        "along_sigma_m": own.floats("along_sigma_m"),
        "branch_probability": own.floats("branch_probability"),
        "sources": own.texts("sources") if "sources" in mine.columns else np.full(len(time), ""),
    }
    columns |= _since_last_position(time, moved, answers)
    since_begin = seconds(time - run.positions["time_gpst"].to_numpy().min())
    columns["block"] = (since_begin // options.block_s).astype(np.int64)
    columns |= _levels(run, own)
    table = pl.DataFrame(columns, nan_to_null=True).with_columns(pl.col("n_used").cast(pl.Int64))
    return AntennaEpochs(
        table=table,
        errors=errors,
        speed_from="reference" if np.isfinite(stated_speed[known]).all() else "places",
        outside=int((logged & ~known).sum()),
        step_s=step_s,
        from_sections=int((known & (stated == "") & (environment != UNKNOWN)).sum()),
    )


class _OwnColumns(NamedTuple):
    """Columns of an antenna's positions, extended to the epochs that are missing in the log."""

    table: pl.DataFrame
    rows: Indices  #: Row index in the table for each epoch; for a missing epoch, the index after the last row.

    def floats(self, name: str) -> Floats:
        """Return a column of numbers, NaN for missing epochs."""
        return np.append(floats(self.table, name), np.nan)[self.rows]

    def texts(self, name: str) -> pl.Series:
        """Return a column of texts, null for missing epochs."""
        texts = self.table[name].cast(pl.String)
        return pl.concat([texts, pl.Series([None], dtype=pl.String)])[self.rows]

    def answers(self, reference_chainage_m: Floats, reference_ecef_m: Floats) -> Answers:
        """Return the positions of the run, NaN for missing epochs, together with the reference positions."""
        return Answers(
            chainage_m=self.floats("chainage_m"),
            conventional_chainage_m=self.floats("conventional_chainage_m"),
            ecef_m=np.stack([self.floats(name) for name in ("x_m", "y_m", "z_m")], axis=1),
            reference_chainage_m=reference_chainage_m,
            reference_ecef_m=reference_ecef_m,
        )


def _since_last_position(time: Datetimes, moved_m: Floats, answers: Answers) -> dict[str, Floats]:
    """Return the distance and time since the previous position, for constrained and for conventional positions.

    Positions in gaps of the reference are included, because `moved_m` is interpolated over the gaps.
    """
    columns, clock = {}, np.where(np.isfinite(moved_m), seconds(time - time[0]), np.nan)
    for prefix, answered in (("", answers.chainage_m), ("conventional_", answers.conventional_chainage_m)):
        columns[f"{prefix}interval_m"] = since_last(moved_m, np.isfinite(answered))
        columns[f"{prefix}gap_s"] = since_last(clock, np.isfinite(answered))
    return columns


def _levels(run: RunFolder, own: _OwnColumns) -> dict[str, Any]:
    """Return the protection levels of a run with their parts, causes and statuses, by prefixed column name."""
    columns: dict[str, Any] = {run.prefix_column(name): own.floats(name) for name in level_columns(own.table)}
    for name in (f"protection_{name}" for name in (*PARTS, *STATED)):
        if name in own.table.columns and run.level_kind is not None:
            columns[run.prefix_column(name)] = own.floats(name) if name.endswith("_m") else own.texts(name)
    return columns


def _steps(values: Floats, known: Masks) -> Floats:
    """Return the distances between successive known positions [m] from chainages (T,) or ECEF positions (T, 3)."""
    step = np.diff(values[known], axis=0)
    return np.abs(step) if step.ndim == 1 else np.asarray(np.linalg.norm(step, axis=1))


def _own_speed(time: Datetimes, step_m: Floats, known: Masks) -> Floats:
    """Return the mean speed over the steps before and after each known position, shape (T,) [m/s]; NaN elsewhere."""
    speed = np.full(len(time), np.nan)
    at = np.flatnonzero(known)
    if len(at) < 2:
        return speed
    duration = seconds(np.diff(time[at]))
    length, elapsed = (
        np.concatenate([[0.0], values]) + np.concatenate([values, [0.0]]) for values in (step_m, duration)
    )
    speed[at] = length / elapsed
    return speed


def _environment(stated: Strings, sections: Sections | None, chainage_m: Floats) -> Strings:
    """Return the environment stated by the reference, else by the sections at the chainage, else `UNKNOWN`."""
    names = stated if sections is None else np.where(stated == "", sections.at(chainage_m), stated)
    return np.where(names == "", UNKNOWN, names)
