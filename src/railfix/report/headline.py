"""Top of the report: a verdict on each run, five key figures, and a comparison with conventional positions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import polars as pl

from railfix.core.tables import number, share
from railfix.evaluate import Evaluation
from railfix.evaluate.accuracy import PASSED
from railfix.evaluate.evaluation_inputs import floats
from railfix.report.runs import ReportedRun, get_figures
from railfix.run.verdict import PASSED as PASSED_CHECKS
from railfix.run.verdict import POSITIONS, judge_run


@dataclass(frozen=True, kw_only=True)
class KeyFigure:
    """Key figure of a run."""

    name: str
    value: str  #: Value for single-epoch positions.
    filtered: str = ""  #: Value for the filter along the track; "" if the filter was off.
    beside: str = ""  #: Value for conventional positions, or a remark on the figure.


@dataclass(frozen=True, kw_only=True)
class Headline:
    """Summary of one antenna of a run."""

    verdict: str  #: Sentences on availability and accuracy.
    figures: tuple[KeyFigure, ...]
    compared: str  #: Sentences that define the kinds of position that the figures compare.
    remarks: tuple[str, ...]  #: Sentences on the longest outage, large errors, and failed checks.


def headline(run: ReportedRun, antenna: str, evaluation: Evaluation | None) -> Headline:
    """Return the headline of one antenna of a run; the key figures include errors if the run has a reference."""
    if evaluation is not None:
        passed = get_figures(evaluation, run, antenna, "constrained_ok")
        filtered = get_figures(evaluation, run, antenna, "constrained", table="train")
        if passed.get("errors") or filtered.get("errors"):
            return _with_errors(run, antenna, evaluation, passed)
    unknown = "--reference" if evaluation is None else "no reference at the times of positions that passed every check"
    return _without_errors(run, antenna, f"Errors are not known without a reference ({unknown}).")


def _with_errors(run: ReportedRun, antenna: str, evaluation: Evaluation, passed: Mapping[str, Any]) -> Headline:
    """Return the headline with errors; `passed` has the figures of the single epochs that passed every check."""
    other = get_figures(evaluation, run, antenna, "conventional")
    filtered = get_figures(evaluation, run, antenna, "constrained", table="train")
    position = "a single-epoch position" if filtered else "the train's position"
    passing = "No single-epoch position with a reference passed every check."
    if passed.get("errors"):
        passing = (
            f"In {share(passed['rate'], 1)} of the epochs with satellite signals, {position} on the line passed every "
            f"check; 95 % of the errors of these positions are below {number(passed['p95_m'], 1)} m, and "
            f"the largest is {number(passed['max_m'], 1)} m (conventional positions: {number(other.get('p95_m'), 1)} m "
            f"and {number(other.get('max_m'), 1)} m)."
        )
    verdict = passing
    if filtered:
        verdict = (
            f"The filter along the track has a position in {share(filtered['rate'], 1)} of all epochs, including those "
            f"without satellites; 95 % of its errors are below {number(filtered['p95_m'], 1)} m, and the largest is "
            f"{number(filtered['max_m'], 1)} m. {passing}"
        )
    texts: dict[str, Callable[[Mapping[str, Any]], str]] = {
        "median error": lambda of: number(of.get("p50_m"), 2, " m"),
        "95 % of errors within": lambda of: number(of.get("p95_m"), 2, " m"),
        "largest error": lambda of: number(of.get("max_m"), 2, " m"),
    }
    figures = [
        KeyFigure(
            name=name, value=text(passed), filtered=text(filtered) if filtered else "",
            beside=f"conventional {text(other)}",
        )
        for name, text in texts.items()
    ]  # fmt: skip
    ranges = "unscreened ranges, as in paper P1" if run.conventional is not None else "the same screened ranges"
    large = (
        "The figures in large type refer to the filter along the track at all epochs. Figures of single epochs"
        if filtered
        else "The figures in large type"
    )
    stated = _verdict_figures(run, antenna)
    level = list(stated.values())[-1]
    return Headline(
        verdict=verdict,
        figures=(*figures, stated[POSITIONS], replace(level, beside=_count_beyond(run, antenna, evaluation, passed))),
        compared=(
            f"All errors are along the line. {large} refer to single-epoch positions on the map that passed every "
            f"check. Conventional positions are 3-D single-point positions from {ranges}, moved to the "
            "nearest point of the line. The table of figures of merit also compares the positions on the map with the "
            "conventional positions at the same epochs."
        ),
        remarks=(
            *(() if passed.get("errors") else (_count_passed(stated),)),
            *(_longest_outage(run, antenna, evaluation) if filtered else ()),
            *_larger_error(passed, other),
            *_describe_marked(run.get_errors(antenna)),
        ),
    )


def _verdict_figures(run: ReportedRun, antenna: str) -> dict[str, KeyFigure]:
    """Return an antenna's key figures by name, from the verdict in ``run.json``; empty if there is no verdict."""
    found = next((each for each in judge_run(run.record).antennas if each.antenna == antenna), None)
    if found is None:
        return {}
    return {
        name: KeyFigure(name=name, value=single or value, filtered=value if single else "")
        for name, value, single in found.figures()
    }


def _count_beyond(run: ReportedRun, antenna: str, evaluation: Evaluation, passed: Mapping[str, Any]) -> str:
    """Return a text: number of errors above usable levels, or, if there are no levels, the normalised error."""
    kinds = {run.folder.level_kind or "": run.name_in(evaluation), "train": run.name_in(evaluation, "train")}
    counts = [
        f"{'filter' if kind == 'train' else 'single epochs'} {len(found):,}"
        for kind, name in reversed(kinds.items())
        if kind in evaluation.integrity and name
        for found in [evaluation.integrity[kind].beyond.filter(pl.col("usable"), run=name, antenna=antenna)]
    ]
    if not counts:
        return f"95 % of errors within {number(passed.get('normalised_p95'), 1)} sigma"
    return f"errors above usable levels: {', '.join(counts)}"


def _count_passed(stated: Mapping[str, KeyFigure]) -> str:
    """Return a sentence on the number of positions that passed every check."""
    passed = stated[PASSED_CHECKS]
    text = f"{passed.value} single epochs" if not passed.filtered else (
        f"{passed.filtered} epochs of the filter and {passed.value} single epochs"
    )  # fmt: skip
    return f"{text} passed every check."


def _longest_outage(run: ReportedRun, antenna: str, evaluation: Evaluation) -> Iterator[str]:
    """Yield a sentence on the errors of the filter in the longest stretch without satellites, if there is one."""
    if evaluation.outages is not None:
        passed = evaluation.outages.filter(run=run.name_in(evaluation, "train"), antenna=antenna)
        for row in passed.sort("travelled_m", descending=True, nulls_last=True).head(1).iter_rows(named=True):
            yield (
                f"The longest of {len(passed)} stretches without satellites: {row['environment']}, "
                f"{number(row['duration_s'], 1)} s, {number(row['travelled_m'], 0)} m, positions by "
                f"{row['carried_by'].replace('+', ' and ') or 'dead reckoning'}. In it, the error is at most "
                f"{number(row['outage_max_m'], 2)} m; at its end, the error is {number(row['end_error_m'], 2)} m, and "
                f"the stated sigma is {number(row['end_sigma_m'], 1)} m."
            )


def _larger_error(passed: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Return a sentence that the largest error on the map exceeds that of conventional positions; none otherwise."""
    if not other.get("errors") or not passed.get("errors") or passed["max_m"] <= other["max_m"]:
        return []
    return [
        f"The largest error on the map, {number(passed['max_m'], 1)} m at chainage "
        f"{number(passed['max_at_chainage_m'], 0)} m, exceeds the largest error of conventional positions, "
        f"{number(other['max_m'], 1)} m at chainage {number(other['max_at_chainage_m'], 0)} m."
    ]


def _describe_marked(errors: pl.DataFrame | None) -> list[str]:
    """Return sentences on the positions that failed a check; empty if there are none."""
    if errors is None:
        return []
    marked = errors.filter("in_reference", "positioned", "reference_good", ~pl.col("status").is_in(PASSED))
    if not len(marked):
        return []
    statuses = ", ".join(status.replace("_", " ") for status in marked["status"].unique(maintain_order=True))
    largest = number(float(np.abs(floats(marked, "error_m")).max()), 1, " m")
    return [
        f"{len(marked):,} further positions failed a check (status: {statuses}); their "
        "largest "
        f"error is {largest}. The charts show them, but the figures above do not include them."
    ]


def _without_errors(run: ReportedRun, antenna: str, compared: str) -> Headline:
    found = next((each for each in judge_run(run.record).antennas if each.antenna == antenna), None)
    if found is None or not found.leading.positions or found.leading.sigma_p95_m is None:
        text = "No epoch has a position on the line."
    else:
        rate = share(found.leading.positions / found.leading.epochs, 1)
        epochs = "epochs, including those without satellites" if found.filter else "epochs with observations"
        text = (
            f"The train has a position on its line in {rate} of {epochs}; the stated standard deviation is at most "
            f"{number(found.leading.sigma_p95_m, 1)} m for 95 % of these positions."
        )
    return Headline(
        verdict=text,
        figures=tuple(_verdict_figures(run, antenna).values()),
        compared=compared,
        remarks=(),
    )
