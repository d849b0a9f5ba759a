"""Top of the page: one sentence on the run, five key figures, and the comparison with the conventional position."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from railfix.evaluate import Evaluation
from railfix.evaluate.figures import PASSED
from railfix.evaluate.run_folder import floats
from railfix.report.content import number, share
from railfix.report.plots.errors import good_errors
from railfix.report.runs import ReportedRun
from railfix.report.tables import figures_of


@dataclass(frozen=True, kw_only=True)
class KeyFigure:
    """A figure with its name and the conventional one, or a remark."""

    name: str
    value: str
    beside: str = ""


@dataclass(frozen=True, kw_only=True)
class Headline:
    """Verdict, five key figures and remarks on one antenna of a run."""

    verdict: str
    figures: tuple[KeyFigure, ...]
    remarks: tuple[str, ...]


def headline(run: ReportedRun, antenna: str, evaluation: Evaluation | None) -> Headline:
    """Verdict and key figures of one antenna, against the reference where there is one."""
    if evaluation is not None:
        common = {
            kind: figures_of(evaluation, run, antenna, kind, epochs_of="common")
            for kind in ("constrained", "conventional")
        }
        if all(figures.get("errors") for figures in common.values()):
            return _with_errors(run, antenna, evaluation, common["constrained"], common["conventional"])
    return _without_errors(run, antenna)


def _with_errors(
    run: ReportedRun,
    antenna: str,
    evaluation: Evaluation,
    on_map: Mapping[str, Any],
    conventional: Mapping[str, Any],
) -> Headline:
    own = figures_of(evaluation, run, antenna, "constrained")
    own_conventional = figures_of(evaluation, run, antenna, "conventional")
    verdict = (
        f"At {share(own['rate'], 1)} of the epochs with satellite signals the train has a position on its line; 95 % "
        f"of these are within {number(on_map['p95_m'], 1)} m of the true place along the line, and the worst is "
        f"{number(on_map['max_m'], 1)} m off (conventional: {number(conventional['p95_m'], 1)} m and "
        f"{number(conventional['max_m'], 1)} m)."
    )
    figures = [
        KeyFigure(name=name, value=number(on_map[column], 2, " m"), beside=number(conventional[column], 2, " m"))
        for name, column in (("median error", "p50_m"), ("95 % of errors within", "p95_m"), ("largest error", "max_m"))
    ]
    figures.append(
        KeyFigure(
            name="epochs with a position", value=share(own["rate"], 1), beside=share(own_conventional.get("rate"), 1)
        )
    )
    return Headline(
        verdict=verdict,
        figures=(*(_beside(figure) for figure in figures), _integrity_figure(run, antenna, evaluation, own)),
        remarks=(_alike(run, on_map), *_larger_error(run, antenna, on_map, conventional)),
    )


def _beside(figure: KeyFigure) -> KeyFigure:
    return KeyFigure(name=figure.name, value=figure.value, beside=f"conventional {figure.beside}")


def _integrity_figure(run: ReportedRun, antenna: str, evaluation: Evaluation, own: Mapping[str, Any]) -> KeyFigure:
    """Median protection level with errors above it, or the stated sigma without levels."""
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
    return KeyFigure(
        name="protection level, median",
        value=number(median, 1, " m"),
        beside=f"usable errors above their level: {len(beyond):,}",
    )


def _alike(run: ReportedRun, on_map: Mapping[str, Any]) -> str:
    ranges = "unscreened ranges, as in P1" if run.conventional is not None else "the same screened ranges"
    return (
        f"Errors along the line of the {number(on_map['errors'], 0)} epochs at which both positions exist; "
        f"conventional: 3-D single point from {ranges}, moved to the nearest point of the line."
    )


def _larger_error(
    run: ReportedRun, antenna: str, on_map: Mapping[str, Any], conventional: Mapping[str, Any]
) -> list[str]:
    """A sentence on the largest error on the map where it exceeds the conventional one."""
    errors = run.errors_of(antenna)
    if errors is None or on_map["max_m"] <= conventional["max_m"]:
        return []
    size = np.where(errors["conventional_positioned"].to_numpy(), np.abs(good_errors(errors, "error_m")), np.nan)
    worst = errors.row(int(np.nanargmax(size)), named=True)
    passed = size[errors["status"].is_in(PASSED).to_numpy()]
    reason = (
        f"railfix had marked this position as {str(worst['status']).replace('_', ' ')}; positions that passed every "
        f"check are within {number(float(np.nanmax(passed)), 1)} m"
        if worst["status"] not in PASSED and np.isfinite(passed).any()
        else "it passed every check of railfix"
    )
    return [
        f"The largest error on the map exceeds the conventional one: {number(size[int(np.nanargmax(size))], 1)} m at "
        f"chainage {number(worst['chainage_m'], 0)} m ({worst['environment']}), from {number(worst['n_used'], 0)} "
        f"satellites left after the screens, with a stated sigma of {number(worst['along_sigma_m'], 1)} m; {reason}."
    ]


def _without_errors(run: ReportedRun, antenna: str) -> Headline:
    facts: Mapping[str, Any] = (run.record.get("antennas") or {}).get(antenna) or {}
    positions = run.positions_of(antenna)
    observed = positions.filter("observed")
    has = np.isfinite(floats(observed, "chainage_m"))
    passed = has & observed["status"].is_in(PASSED).to_numpy()
    sigma = floats(observed, "along_sigma_m")[has]
    middle, wide = np.percentile(sigma, [50.0, 95.0]) if len(sigma) else (np.nan, np.nan)
    level = floats(observed, "protection_level_m")
    level = level[np.isfinite(level)]
    rate = float(has.mean()) if len(has) else np.nan
    return Headline(
        verdict=(
            f"At {share(rate, 1)} of the epochs with satellite signals the train has a position on its line; railfix "
            f"states a standard deviation of at most {number(float(wide), 1)} m for 95 % of these."
        ),
        figures=(
            KeyFigure(name="epochs with a position", value=share(rate, 1)),
            KeyFigure(name="passed every check", value=share(float(passed.mean()) if len(passed) else np.nan, 1)),
            KeyFigure(name="stated sigma, median", value=number(float(middle), 2, " m")),
            KeyFigure(
                name="protection level, median",
                value=number(float(np.median(level)) if len(level) else np.nan, 1, " m"),
            ),
            KeyFigure(name="epochs", value=number(facts.get("epochs", len(positions)), 0)),
        ),
        remarks=("Without a reference (--reference) errors are not known.",),
    )
