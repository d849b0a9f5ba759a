"""Settings of an evaluation."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Final, Literal, TypeVar

from pydantic import AfterValidator, Field

from railfix.core.settings import INPUTS, Settings, option
from railfix.evaluate.bracket import LARGEST_GAP_S
from railfix.run.options import ColumnNames

Method = Literal["chainage", "trajectory"]

#: Windows of continuity [s]: 15 s is that of an approach in aviation, a minute the run from one station to the next.
WINDOWS_S: Final = (15.0, 60.0)


Number = TypeVar("Number", int, float)


def _rising(edges: tuple[Number, ...]) -> tuple[Number, ...]:
    """The edges themselves; ValueError where they do not rise."""
    if any(high <= low for low, high in pairwise(edges)):
        raise ValueError("rising numbers expected")
    return edges


Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
RisingEdges = Annotated[tuple[Positive, ...], Field(min_length=1), AfterValidator(_rising)]
RisingCounts = Annotated[tuple[Annotated[int, Field(gt=0)], ...], Field(min_length=1), AfterValidator(_rising)]


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
    """Settings of an evaluation; the options of `railfix evaluate` say what most are.

    Attributes
    ----------
    satellite_edges : tuple
        Limits between the classes of satellites used.
    over_m : tuple of float [m]
        Error sizes; the share of errors above each is counted.
    block_s : float [s]
        Length of the blocks of time that are resampled for confidence limits.
    replicates : int
        Number of resamples.
    confidence : float
        Probability of the confidence limits, between 0 and 1.
    """

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
    satellite_edges: RisingCounts = (4, 5, 6, 7, 8, 10, 12, 15, 20)
    over_m: RisingEdges = (5.0, 10.0, 20.0, 50.0)
    alarm_limits_m: tuple[Positive, ...] = option(
        "Alarm limits that protection levels are compared with, besides the run's own.",
        (10.0, 20.0, 40.0),
        name="--alarm-limit",
        metavar="M,...",
    )
    block_s: Positive = 60.0
    replicates: int = Field(default=1000, ge=1)
    seed: int = option("Seed of the random numbers of the confidence limits.", 0, metavar="N", ge=0)
    confidence: float = Field(default=0.95, gt=0.0, lt=1.0)
