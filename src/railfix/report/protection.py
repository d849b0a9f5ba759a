"""Tables of the report on protection levels: what they rest on, what they bounded, where they did not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import polars as pl

from railfix.evaluate import Evaluation, EvaluationOptions, Integrity
from railfix.evaluate.integrity import LEVELS_OF, positions_diagram
from railfix.evaluate.run_folder import floats
from railfix.report.html import absent, number, share, table
from railfix.report.runs import ReportedRun
from railfix.report.tables import level_widths, name_in

#: Epochs beyond their level that are listed.
WORST: Final = 20
NO_LEVELS: Final = "The run worked out no protection levels (protection is off, or its railfix had none)."
_KINDS: Final = {
    "sbas": "the integrity of an SBAS; hypotheses of faults of the surroundings of the antenna",
    "separation": "of solutions without one or two satellites; hypotheses of faults of satellites and of the "
    "surroundings of the antenna",
}
_LEVELS: Final = {"usable": "usable", "all": "all"}
_EXPLAINED: Final = (
    "Usable levels: where the status is ok and no alarm was raised; every other position counts as without a "
    "bound. All: every finite level, whatever the verdict on it."
)
_REGIONS: Final = {
    "nominal": "nominal",
    "misleading": "misleading",
    "hazardously_misleading": "hazard. misl.",
    "unavailable": "unavailable",
    "unavailable_misleading": "unavail. misl.",
    "no_position": "no position",
}


def protection(run: ReportedRun, evaluation: Evaluation | None) -> str:
    """Everything on the levels of a run, except its pictures."""
    if run.folder.level_kind is None:
        return absent(NO_LEVELS)
    parts = [rests_on(run)]
    if evaluation is None:
        return "\n".join([*parts, _availability(run)])
    name = name_in(evaluation, run)
    found = evaluation.integrity[run.folder.level_kind]
    parts += [_counts(found, name), _environments(found, name), level_widths(evaluation, name)]
    return "\n".join([*parts, _worst(found, name, run)])


def rests_on(run: ReportedRun) -> str:
    """What the levels of a run rest on."""
    told: Mapping[str, Any] = run.record.get("protection") or {}
    kind = run.folder.level_kind or ""
    model = run.config.error_model
    sigmas = f"error model {model}" if model is not None else str(told.get("sigmas", "not told"))
    priors = told.get("satellite_prior")
    rows = [
        ("kind", f"{kind}: {_KINDS.get(kind, 'not told by run.json')}"),
        ("errors without a fault", sigmas),
        ("alarm limit", _value(told.get("alarm_limit_m"), " m")),
        ("risk per hour", _value(told.get("risk_per_hour"))),
        ("independent samples per hour", _value(told.get("samples_per_hour"))),
        ("risk per sample", _value(told.get("risk_per_sample"))),
        ("K of the whole risk", _value(told.get("k_of_whole_risk"), " sigma, two-sided")),
        ("prior of a satellite's own fault", _priors(priors)),
        ("prior of a fault of the surroundings", _value(told.get("local_prior"))),
        ("false alarms", _value(told.get("false_alarm"))),
    ]
    return table(["", "what the level rests on"], rows)


def _priors(priors: Any) -> str:
    """Priors by constellation, those that are alike together."""
    if not isinstance(priors, Mapping):
        return "not told"
    alike: dict[str, list[str]] = {}
    for system, value in priors.items():
        alike.setdefault(_value(value), []).append(str(system))
    return "; ".join(f"{value} ({' '.join(systems)})" for value, systems in alike.items())


def _value(value: Any, unit: str = "") -> str:
    return "not told" if not isinstance(value, int | float) else f"{value:.4g}{unit}"


def _counts(found: Integrity, name: str) -> str:
    rows = found.stanford.filter(pl.col("run") == name, pl.col("grouping") == "all", pl.col("antenna") != "all")
    return _table(
        "antenna", rows, f"Levels against errors: epochs of each region of the Stanford diagram. {_EXPLAINED}"
    )


def _environments(found: Integrity, name: str) -> str:
    rows = found.stanford.filter(
        pl.col("run") == name, pl.col("grouping") == "environment", "own_limit", pl.col("antenna") != "all"
    )
    if rows["group"].n_unique() < 2:
        return ""
    inside = _table("environment", rows.sort("antenna", maintain_order=True), "At the alarm limit of the run.")
    return f"<details><summary>Protection level by environment</summary>{inside}</details>"


def _table(first: str, rows: pl.DataFrame, caption: str) -> str:
    grouped = first == "environment"
    shown = [*_REGIONS, *(["unjudged"] if rows["unjudged"].sum() else [])]
    head = [first, "levels", "limit, m", "epochs", *(_REGIONS.get(name, name) for name in shown), "available"]
    head += [] if grouped else ["15 s", "60 s"]
    cells = []
    for row in rows.iter_rows(named=True):
        line = [
            f"{row['group']}, {row['antenna']}" if grouped else str(row["antenna"]),
            _LEVELS[row["levels_of"]],
            f"{row['alarm_limit_m']:g}{' (own)' if row['own_limit'] and not grouped else ''}",
            number(row["epochs"], 0),
            *(number(row[name], 0) for name in shown),
            share(row["availability"]),
        ]
        cells.append(line if grouped else [*line, share(row["continuity_15_s"]), share(row["continuity_60_s"])])
    told = "available: of all epochs, tunnels included"
    told += "" if grouped else "; 15 s, 60 s: windows that begin available and stay so"
    right = range(2, len(head))
    asked = [k for k, row in enumerate(rows.iter_rows(named=True)) if row["own_limit"] and not grouped]
    return table(head, cells, caption=f"{caption} {told[0].upper()}{told[1:]}.", right=right, asked=asked)


def _worst(found: Integrity, name: str, run: ReportedRun) -> str:
    """The epochs whose error is furthest over the level."""
    kind = run.folder.level_kind
    beyond = found.beyond.filter(pl.col("run") == name)
    if not len(beyond):
        return "<p>No error is over its level, usable or not.</p>"
    usable = int(beyond["usable"].sum())
    head = "time|antenna|chainage|environment|error|level|parts|set by|verdict|status|satellites|usable".split("|")
    rows = []
    for row in beyond.head(WORST).iter_rows(named=True):
        parts = (row[f"{kind}_{part}"] for part in ("fault_free_m", "one_fault_m", "two_faults_m"))
        rows.append(
            [
                row["time_gpst"].isoformat(sep=" ", timespec="milliseconds"),
                str(row["antenna"]),
                number(row["chainage_m"], 0),
                str(row["environment"]),
                number(row["error_m"]),
                number(row[f"{kind}_level_m"]),
                " / ".join(number(part, 1) for part in parts),
                _word(row[f"{kind}_cause"]),
                _word(row[f"{kind}_status"]),
                _word(row["status"]),
                number(row["n_used"], 0),
                "yes" if row["usable"] else "no",
            ]
        )
    caption = (
        f"Errors over their level: {len(beyond):,}, of them {usable:,} usable"
        f"{f'; the {WORST} furthest over it' if len(beyond) > WORST else ''}. Metres; parts: without a fault, "
        "one fault, two faults"
    )
    return table(head, rows, caption=caption, right=[2, 4, 5, 6, 10])


def _word(value: str | None) -> str:
    return (value or "not told").replace("_", " ")


def _availability(run: ReportedRun) -> str:
    """Without a reference: how wide the levels are, and how often they serve."""
    options = EvaluationOptions()
    limits = sorted({*options.alarm_limits_m, run.folder.alarm_limit_m or run.config.alarm_limit_m})
    return table(
        ["antenna", "levels", "limit, m", "epochs", "finite", "p50", "p95", "available", "15 s", "60 s"],
        _rows_available(run, limits, options),
        caption=f"Availability of all epochs, and windows that begin available and stay so. {_EXPLAINED} Without a "
        "reference no level is judged. Levels in metres",
        right=range(2, 10),
    )


def _rows_available(run: ReportedRun, limits: Sequence[float], options: EvaluationOptions) -> Iterator[list[str]]:
    for antenna in run.folder.antennas:
        positions = run.positions_of(antenna)
        level = floats(positions, "protection_level_m")
        finite = level[np.isfinite(level)]
        middle = np.percentile(finite, [50.0, 95.0]) if len(finite) else np.full(2, np.nan)
        for levels_of in LEVELS_OF:
            for limit in limits:
                found = positions_diagram(positions, alarm_limit_m=limit, levels_of=levels_of, options=options)
                yield [
                    antenna,
                    _LEVELS[levels_of],
                    f"{limit:g}",
                    number(len(positions), 0),
                    number(len(finite), 0),
                    *(number(float(value)) for value in middle),
                    share(found.available_rate),
                    *(share(window.probability) for window in found.continuity),
                ]
