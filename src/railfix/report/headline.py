"""Top of the page: one sentence on the run, five key figures, and the comparison with the conventional position."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import polars as pl

from railfix.core.arrays import Floats
from railfix.core.tables import number, share
from railfix.evaluate import Evaluation
from railfix.evaluate.accuracy import PASSED
from railfix.evaluate.evaluation_inputs import floats
from railfix.report.runs import ReportedRun, get_figures
from railfix.run.record import level_basis
from railfix.run.verdict import judge_run


@dataclass(frozen=True, kw_only=True)
class KeyFigure:
    """A figure of single epochs with its name, the filter's figure, and the conventional one or a remark."""

    name: str
    value: str
    filtered: str = ""
    beside: str = ""


@dataclass(frozen=True, kw_only=True)
class Headline:
    """Verdict, five key figures with their basis, and remarks on one antenna of a run."""

    verdict: str
    figures: tuple[KeyFigure, ...]
    compared: str
    remarks: tuple[str, ...]


def headline(run: ReportedRun, antenna: str, evaluation: Evaluation | None) -> Headline:
    """Return the verdict and key figures of one antenna, against the reference where there is one."""
    errors = run.get_errors(antenna)
    if evaluation is not None and errors is not None:
        compared = _compare(errors)
        if len(compared.on_map_m):
            return _with_errors(run, antenna, evaluation, compared)
    return _without_errors(run, antenna)


@dataclass(frozen=True, kw_only=True)
class _Compared:
    """Positions that passed every check compared with the conventional ones of the same epochs."""

    #: Error sizes, shape (N,).
    on_map_m: Floats
    conventional_m: Floats
    epochs: pl.DataFrame  #: Of the N epochs.
    #: Fraction of the epochs with observations that have such a position.
    rate: float
    conventional_rate: float
    marked_m: Floats  #: Error sizes of the positions that failed a check.
    statuses: list[str]  #: Their statuses.


def _compare(errors: pl.DataFrame) -> _Compared:
    spanned = errors.filter("in_reference").with_columns(passed=pl.col("positioned") & pl.col("status").is_in(PASSED))
    observed = spanned.filter("observed")
    both = spanned.filter("passed", "conventional_positioned", "reference_good")
    marked = spanned.filter(~pl.col("passed"), "positioned", "reference_good")
    return _Compared(
        on_map_m=np.abs(floats(both, "error_m")),
        conventional_m=np.abs(floats(both, "conventional_error_m")),
        epochs=both,
        rate=float(np.mean(observed["passed"].to_numpy())) if len(observed) else np.nan,
        conventional_rate=float(np.mean(observed["conventional_positioned"].to_numpy())) if len(observed) else np.nan,
        marked_m=np.abs(floats(marked, "error_m")),
        statuses=marked["status"].unique(maintain_order=True).to_list(),
    )


def _with_errors(run: ReportedRun, antenna: str, evaluation: Evaluation, compared: _Compared) -> Headline:
    (middle, wide), (other_middle, other_wide) = (
        np.percentile(size, [50.0, 95.0]) for size in (compared.on_map_m, compared.conventional_m)
    )
    worst, other_worst = float(compared.on_map_m.max()), float(compared.conventional_m.max())
    filtered = _filter_errors(run, antenna)
    whose = "Single epochs have" if filtered else "The train has"
    verdict = (
        f"{whose} a position on the line that passed every check in {share(compared.rate, 1)} of the epochs with "
        f"satellite signals; 95 % of these errors are below {number(float(wide), 1)} m, and the largest is "
        f"{number(worst, 1)} m (conventional: {number(float(other_wide), 1)} m and {number(other_worst, 1)} m)."
    )
    if filtered:
        verdict = (
            f"The filter along the track has a position in {share(filtered['rate'], 1)} of all epochs, including those "
            f"without satellites; 95 % of its errors are below {number(filtered['p95'], 1)} m, and the largest is "
            f"{number(filtered['max'], 1)} m. {verdict}"
        )
    lengths = (
        ("median error", "p50", middle, other_middle),
        ("95 % of errors within", "p95", wide, other_wide),
        ("largest error", "max", worst, other_worst),
    )
    figures = [
        KeyFigure(
            name=name,
            value=number(float(value), 2, " m"),
            filtered=number(filtered[key], 2, " m") if filtered else "",
            beside=number(float(beside), 2, " m"),
        )
        for name, key, value, beside in lengths
    ]
    rates = share(compared.rate, 1), share(compared.conventional_rate, 1)
    of_filter = f"{share(filtered['rate'], 1)} of all" if filtered else ""
    figures.append(KeyFigure(name="epochs with a position", value=rates[0], filtered=of_filter, beside=rates[1]))
    own = get_figures(evaluation, run, antenna, "constrained_ok")
    return Headline(
        verdict=verdict,
        figures=(
            *(replace(figure, beside=f"conventional {figure.beside}") for figure in figures),
            _integrity_figure(run, antenna, evaluation, own),
        ),
        compared=_alike(run, compared, filtered),
        remarks=(
            *(_longest_outage(run, antenna, evaluation) if filtered else ()),
            *_larger_error(compared),
            *_describe_marked(compared),
        ),
    )


def _integrity_figure(run: ReportedRun, antenna: str, evaluation: Evaluation, own: Mapping[str, Any]) -> KeyFigure:
    """Return the median protection level with errors above it, or the stated sigma without levels."""
    kind = run.folder.level_kind
    if kind is None or evaluation.levels is None or kind not in evaluation.integrity:
        return KeyFigure(
            name="stated sigma, median",
            value=number(own.get("along_sigma_p50_m"), 2, " m"),
            beside=f"95 % of errors within {number(own.get('normalised_p95'), 1)} sigma",
        )
    levels = evaluation.levels.filter(
        run=run.name_in(evaluation), antenna=antenna, position="constrained_ok", level=f"{kind}_protection_level_m"
    )
    beyond = evaluation.integrity[kind].beyond.filter(pl.col("usable"), run=run.name_in(evaluation), antenna=antenna)
    median = levels["level_p50_m"].item() if len(levels) == 1 else None
    above, filtered = f"{len(beyond):,}", ""
    if "train" in evaluation.integrity and (name := run.name_in(evaluation, "train")):
        along = "train_protection_level_m"
        of_filter = evaluation.levels.filter(run=name, antenna=antenna, position="constrained_ok", level=along)
        filtered = number(of_filter["level_p50_m"].item(), 1, " m") if len(of_filter) == 1 else ""
        over = evaluation.integrity["train"].beyond.filter(pl.col("usable"), run=name, antenna=antenna)
        above += f", filtered {len(over):,}"
    return KeyFigure(
        name=f"{level_basis(run.record)} level, median",
        value=number(median, 1, " m"),
        filtered=filtered,
        beside=f"usable errors above their level: {above}",
    )


def _filter_errors(run: ReportedRun, antenna: str) -> dict[str, float]:
    """Return the error sizes and rate of the filter along the track over all its epochs; empty without it."""
    table = run.filter_rows(antenna)
    known = pl.DataFrame() if table is None else table.filter("positioned", "reference_good")
    if table is None or not len(known):
        return {}
    p50, p95, largest = np.percentile(np.abs(floats(known, "error_m")), [50.0, 95.0, 100.0]).tolist()
    rate = len(table.filter("in_reference", "positioned")) / max(len(table.filter("in_reference")), 1)
    return {"p50": p50, "p95": p95, "max": largest, "rate": rate}


def _longest_outage(run: ReportedRun, antenna: str, evaluation: Evaluation) -> Iterator[str]:
    """Yield a sentence on the filter in the longest stretch without satellites."""
    if evaluation.outages is not None:
        passed = evaluation.outages.filter(run=run.name_in(evaluation, "train"), antenna=antenna)
        for row in passed.sort("travelled_m", descending=True, nulls_last=True).head(1).iter_rows(named=True):
            yield (
                f"The longest of {len(passed)} stretches without satellites ({row['environment']}, "
                f"{number(row['duration_s'], 1)} s and {number(row['travelled_m'], 0)} m, carried by "
                f"{row['carried_by'].replace('+', ' and ') or 'dead reckoning'}) is passed with at most "
                f"{number(row['outage_max_m'], 2)} m of error, {number(row['end_error_m'], 2)} m at its end with a "
                f"stated sigma of {number(row['end_sigma_m'], 1)} m."
            )


def _alike(run: ReportedRun, compared: _Compared, filtered: Mapping[str, float]) -> str:
    ranges = "unscreened ranges, as in P1" if run.conventional is not None else "the same screened ranges"
    large = "Large: the filter along the track, at all epochs. Single epochs" if filtered else "Large"
    return (
        f"Errors along the line. {large}: positions on the map, each epoch by itself, that passed every check. "
        f"Conventional: 3-D single point from {ranges}, moved to the nearest point of the line, at the same "
        f"{len(compared.on_map_m):,} epochs."
    )


def _larger_error(compared: _Compared) -> list[str]:
    """Return a sentence on the largest error on the map where it exceeds the conventional one."""
    if compared.on_map_m.max() <= compared.conventional_m.max():
        return []
    at = int(np.argmax(compared.on_map_m))
    worst = compared.epochs.row(at, named=True)
    return [
        f"The largest error on the map exceeds the conventional one: {number(float(compared.on_map_m[at]), 1)} m at "
        f"chainage {number(worst['chainage_m'], 0)} m (environment: {worst['environment']}), from "
        f"{number(worst['n_used'], 0)} satellites left after the screens, with a stated sigma of "
        f"{number(worst['along_sigma_m'], 1)} m; the conventional position of that epoch, from "
        f"all satellites, is {number(float(compared.conventional_m[at]), 1)} m off."
    ]


def _describe_marked(compared: _Compared) -> list[str]:
    if not len(compared.marked_m):
        return []
    statuses = ", ".join(status.replace("_", " ") for status in compared.statuses)
    return [
        f"{len(compared.marked_m):,} further positions failed a check and carry its status ({statuses}); their largest "
        f"error is {number(float(compared.marked_m.max()), 1)} m. They are drawn, but not counted above."
    ]


def _without_errors(run: ReportedRun, antenna: str) -> Headline:
    found = next((each for each in judge_run(run.record).antennas if each.antenna == antenna), None)
    if found is None or not found.leading.positions or found.leading.sigma_p95_m is None:
        text = "No epoch has a position on the line."
    else:
        rate = share(found.leading.positions / found.leading.epochs, 1)
        epochs = "epochs, including those without satellites," if found.filter else "epochs with observations"
        text = (
            f"The train has a position on its line in {rate} of {epochs}; the stated standard deviation is at most "
            f"{number(found.leading.sigma_p95_m, 1)} m for 95 % of these."
        )
    figures = () if found is None else tuple(
        KeyFigure(name=name, value=single or value, filtered=value if single else "")
        for name, value, single in found.figures()
    )  # fmt: skip
    return Headline(
        verdict=text,
        figures=figures,
        compared="Errors are not known without a reference (--reference).",
        remarks=(),
    )
