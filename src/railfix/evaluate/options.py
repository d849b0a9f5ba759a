"""Settings of an evaluation, and sections of the line by chainage with what surrounds the train there."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import AfterValidator, Field

from railfix.core.arrays import Floats, Strings
from railfix.core.errors import InputFileError
from railfix.core.settings import INPUTS, Settings, option
from railfix.io.named_columns import read_named_columns
from railfix.run.inputs import ColumnNames

Method = Literal["chainage", "trajectory"]

#: Longest gap of a reference that is interpolated over [s].
LARGEST_GAP_S: Final = 2.5
#: Windows of continuity [s]: 15 s is that of an approach in aviation, a minute the run from one station to the next.
WINDOWS_S: Final = (15.0, 60.0)


def _rising(edges: tuple[float, ...]) -> tuple[float, ...]:
    """The edges themselves; ValueError where they do not rise."""
    if any(high <= low for low, high in pairwise(edges)):
        raise ValueError("rising numbers expected")
    return edges


Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
RisingEdges = Annotated[tuple[Positive, ...], Field(min_length=1), AfterValidator(_rising)]


class EvaluationInputs(Settings):
    """Files of an evaluation beside the runs, and the names of the runs."""

    reference: tuple[str, ...] = option(
        "Reference positions (reference.csv, truth.csv, .gz, RTKLIB), one for all runs or one for each in order; "
        "`auto`: truth.csv or reference.csv beside the log of each run.",
        metavar="FILE",
        panel=INPUTS,
    )
    table: tuple[str, ...] = option(
        "Table of positions: `positions` (single epochs) or `train` (filter along the track); may be repeated. By "
        "default every table of the run.",
        (),
        metavar="NAME",
        panel=INPUTS,
    )
    conventional: Path | None = option(
        "Another run on the same log, whose conventional positions are compared with: one with `--screens elevation` "
        "gives unscreened ones, as in P1.",
        None,
        metavar="RUN",
        panel=INPUTS,
    )
    sections: Path | None = option(
        "Environment by chainage (from_m,to_m,environment), where the reference has none.",
        None,
        metavar="CSV",
        panel=INPUTS,
    )
    label: tuple[str, ...] = option(
        "Name of the configuration of each run, once for each in order; from the settings by default.",
        (),
        metavar="TEXT",
    )


class EvaluationOptions(Settings):
    """Settings of an evaluation; the options of `railfix evaluate` say what most are."""

    method: Literal["auto", "chainage", "trajectory"] = option(
        "Errors as differences of chainage, or along the trajectory from the reference position.", "auto"
    )
    reference_sigma_m: Positive = option(
        "Largest standard deviation of a reference position that is used.", 0.5, name="--reference-sigma", metavar="M"
    )
    reference_quality: tuple[int, ...] = option(
        "Quality numbers of the reference positions that are used, where the log has them (RTKLIB: 1 fix, 2 float, 5 "
        "single).",
        (1,),
        name="--reference-quality",
        metavar="Q,...",
    )
    columns: ColumnNames = Field(default_factory=ColumnNames)
    reference_gap_s: Positive = option(
        "Longest gap of the reference that is interpolated over.", LARGEST_GAP_S, name="--reference-gap", metavar="S"
    )
    standing_mps: Positive = option(
        "The train is at standstill below this speed.", 0.3, name="--standing", metavar="M/S"
    )
    section_m: Positive = option("Length of the sections of the line.", 1000.0, name="--section-length", metavar="M")
    speed_edges_kmh: RisingEdges = option(
        "Limits between the speed classes.", (20.0, 60.0, 100.0), name="--speed-classes", metavar="KMH,..."
    )
    over_m: RisingEdges = (5.0, 10.0, 20.0, 50.0)  #: Error sizes; the share of errors above each is counted.
    alarm_limits_m: tuple[Positive, ...] = option(
        "Alarm limits that protection levels are compared with, besides the run's own.",
        (10.0, 20.0, 40.0),
        name="--alarm-limit",
        metavar="M,...",
    )
    block_s: Positive = 60.0  #: Length of the blocks of time that are resampled for confidence limits.
    replicates: int = Field(default=1000, ge=1)  #: Number of resamples.
    seed: int = option("Seed of the random numbers of the confidence limits.", 0, metavar="N", ge=0)
    confidence: float = Field(default=0.95, gt=0.0, lt=1.0)  #: Probability of the confidence limits, between 0 and 1.


@dataclass(frozen=True, kw_only=True)
class Sections:
    """S stretches of the line, rising, none over another."""

    path: Path
    #: Chainage; the end belongs to the next one; shape (S,).
    from_m: Floats
    to_m: Floats

    environment: tuple[str, ...]

    def at(self, chainage_m: Floats) -> Strings:
        """Environment at chainages, shape (T,); blank outside every section and for NaN."""
        words = np.array([*self.environment, ""])
        index = np.searchsorted(self.from_m, chainage_m, side="right") - 1
        safe = np.maximum(index, 0)
        last = (safe == len(self.to_m) - 1) & (chainage_m == self.to_m[-1])
        inside = (index >= 0) & ((chainage_m < self.to_m[safe]) | last)
        return np.asarray(words[np.where(inside, safe, len(words) - 1)])


def read_sections(path: Path) -> Sections:
    """Read ``from_m,to_m,environment``; InputFileError for a section without length or name, or inside another."""
    table = read_named_columns(path)
    for name in ("from_m", "to_m", "environment"):
        if name not in table:
            raise InputFileError(
                path, f"has no column {name}; from_m, to_m and environment are needed", line=table.header_line
            )
    if not len(table):
        raise InputFileError(path, "has no section below the header")
    first, last = table.numbers("from_m"), table.numbers("to_m")
    for row, name in enumerate(table.cells["environment"]):
        if not name:
            raise table.error(row, "the environment is empty; expected a word such as open or tunnel")
        if not first[row] < last[row]:
            raise table.error(row, f"from_m {first[row]:g} is not below to_m {last[row]:g}; mend the section")
    order = np.argsort(first, kind="stable")
    over = np.flatnonzero(first[order][1:] < last[order][:-1] - 1e-6)
    if len(over):
        row = int(order[over[0] + 1])
        raise table.error(row, f"the section from {first[row]:g} m begins inside another one; make them disjoint")
    return Sections(
        path=path, from_m=first[order], to_m=last[order], environment=tuple(table.cells["environment"].gather(order))
    )
