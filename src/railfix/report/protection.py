"""Tables of the report on protection levels: assumptions, Stanford counts, errors above their level."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import polars as pl

from railfix.evaluate import Evaluation, EvaluationOptions, Integrity
from railfix.evaluate.integrity import LEVELS_OF, positions_diagram
from railfix.evaluate.run_folder import floats
from railfix.pipeline.level_stage import prior_basis_text
from railfix.report.content import Absent, Block, Folded, Sentence, Table, number, share
from railfix.report.runs import ReportedRun
from railfix.report.tables import level_sizes

#: Number of listed epochs with an error above the level.
WORST: Final = 20
NO_LEVELS: Final = "The run has no protection levels (protection is off)."
_KINDS: Final = {
    "sbas": "satellite faults are covered by SBAS; hypotheses of local faults (multipath)",
    "separation": "solution separation; hypotheses of satellite and local faults",
}
_EXPLAINED: Final = (
    "Usable levels: status ok and no alarm; every other position counts as having an infinite level. All: every "
    "finite level, whatever its status."
)
_REGIONS: Final = {
    "nominal": "nominal",
    "misleading": "misleading",
    "hazardously_misleading": "hazard. misl.",
    "unavailable": "unavailable",
    "unavailable_misleading": "unavail. misl.",
    "no_position": "no position",
}


def protection(run: ReportedRun, evaluation: Evaluation | None) -> list[Block]:
    """Tables on the protection levels of a run."""
    kind = run.folder.level_kind
    if kind is None:
        return [Absent(NO_LEVELS)]
    if evaluation is None:
        return [_assumptions(run, kind), _availability(run)]
    name = run.name_in(evaluation)
    counts = evaluation.integrity[kind]
    rows = counts.stanford.filter(pl.col("run") == name, pl.col("antenna") != "all")
    caption = f"Levels and errors: epochs in each region of the Stanford diagram. {_EXPLAINED}"
    return [
        _assumptions(run, kind),
        _stanford("antenna", rows.filter(grouping="all"), caption),
        *_environments(rows.filter(pl.col("grouping") == "environment", pl.col("own_limit"))),
        *level_sizes(evaluation, name),
        _worst(counts, name, kind),
        *_of_the_filter(run, evaluation),
    ]


def _of_the_filter(run: ReportedRun, evaluation: Evaluation) -> list[Block]:
    """The same of the levels of the filter along the track; nothing where it has none."""
    name = run.name_in(evaluation, "train")
    if not name or "train" not in evaluation.integrity:
        return []
    counts = evaluation.integrity["train"]
    rows = counts.stanford.filter(pl.col("antenna") != "all", run=name, grouping="all")
    caption = "The same of the filter along the track. Usable levels: status tracking or coasting"
    return [_stanford("antenna", rows, f"{caption}.", of="filter-"), _worst(counts, name, "train", of="filter-")]


def _assumptions(run: ReportedRun, kind: str) -> Table:
    """Assumptions of the levels of a run."""
    stated: Mapping[str, Any] = run.record.get("protection") or {}
    model = run.config.error_model
    sigmas = f"error model {model}" if model is not None else str(stated.get("sigmas", "not recorded"))
    rows = [
        ("kind", f"{kind}: {_KINDS.get(kind, 'not recorded')}"),
        ("standing", prior_basis_text(stated)),
        ("errors without a fault", sigmas),
        ("alarm limit", _value(stated.get("alarm_limit_m"), " m")),
        ("risk per hour", _value(stated.get("risk_per_hour"))),
        ("independent samples per hour", _value(stated.get("samples_per_hour"))),
        ("risk per sample", _value(stated.get("risk_per_sample"))),
        ("K of the whole risk", _value(stated.get("k_of_whole_risk"), " sigma, two-sided")),
        ("prior of a satellite fault", _priors(stated.get("satellite_prior"))),
        ("prior of a local fault", _value(stated.get("local_prior"))),
        ("prior of one side of the track", _value(stated.get("side_prior"))),
        ("prior of a wrong map", _value(stated.get("map_prior"))),
        ("false alarms", _value(stated.get("false_alarm"))),
    ]
    return Table(name="assumptions", head=["", "assumption of the protection level"], rows=rows)


def _priors(priors: Any) -> str:
    """Priors by constellation, equal ones together."""
    if not isinstance(priors, Mapping):
        return "not recorded"
    alike: dict[str, list[str]] = {}
    for system, value in priors.items():
        alike.setdefault(_value(value), []).append(str(system))
    return "; ".join(f"{value} ({' '.join(systems)})" for value, systems in alike.items())


def _value(value: Any, unit: str = "") -> str:
    return "not recorded" if not isinstance(value, int | float) else f"{value:.4g}{unit}"


def _environments(rows: pl.DataFrame) -> list[Block]:
    if rows["group"].n_unique() < 2:
        return []
    table = _stanford("environment", rows.sort("antenna", maintain_order=True), "At the alarm limit of the run.")
    return [Folded("Protection level by environment", [table])]


def _stanford(first: str, rows: pl.DataFrame, caption: str, *, of: str = "") -> Table:
    grouped = first == "environment"
    shown = [*_REGIONS, *(["unjudged"] if rows["unjudged"].sum() else [])]
    head = [first, "levels", "limit, m", "epochs", *(_REGIONS.get(name, name) for name in shown), "available"]
    head += [] if grouped else ["15 s", "60 s"]
    cells = []
    for row in rows.iter_rows(named=True):
        line = [
            f"{row['group']}, {row['antenna']}" if grouped else str(row["antenna"]),
            str(row["levels_of"]),
            f"{row['alarm_limit_m']:g}{' (own)' if row['own_limit'] and not grouped else ''}",
            number(row["epochs"], 0),
            *(number(row[name], 0) for name in shown),
            share(row["availability"]),
        ]
        cells.append(line if grouped else [*line, share(row["continuity_15_s"]), share(row["continuity_60_s"])])
    meaning = "Available: share of all epochs, tunnels included"
    meaning += "" if grouped else "; 15 s, 60 s: share of windows beginning at an available epoch that stay available"
    return Table(
        name=f"{of}stanford-by-{first}",
        head=head,
        rows=cells,
        caption=f"{caption} {meaning}.",
        numeric=range(2, len(head)),
        marked=[k for k, row in enumerate(rows.iter_rows(named=True)) if row["own_limit"] and not grouped],
    )


def _worst(counts: Integrity, name: str, kind: str, *, of: str = "") -> Block:
    """The epochs whose error exceeds the level most."""
    beyond = counts.beyond.filter(pl.col("run") == name)
    if not len(beyond):
        return Sentence(f"No error {'of the filter ' if of else ''}exceeds its level, usable or not.")
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
        f"Errors above their level: {len(beyond):,}, of them {usable:,} usable"
        f"{f'; the {WORST} largest excesses' if len(beyond) > WORST else ''}. Metres; parts: without a fault, "
        "one fault, two faults"
    )
    return Table(name=f"{of}above-level", head=head, rows=rows, caption=caption, numeric=[2, 4, 5, 6, 10])


def _word(value: str | None) -> str:
    return (value or "not recorded").replace("_", " ")


def _availability(run: ReportedRun) -> Table:
    """Percentiles and availability of the levels of a run without a reference."""
    options = EvaluationOptions()
    limits = sorted({*options.alarm_limits_m, run.folder.alarm_limit_m or run.config.alarm_limit_m})
    return Table(
        name="availability",
        head=["antenna", "levels", "limit, m", "epochs", "finite", "p50", "p95", "available", "15 s", "60 s"],
        rows=list(_rows_available(run, limits, options)),
        caption=f"Share of all epochs that are available, and of windows beginning at an available epoch that stay "
        f"available. {_EXPLAINED} Levels in metres; without a reference they are not compared with errors",
        numeric=range(2, 10),
    )


def _rows_available(run: ReportedRun, limits: Sequence[float], options: EvaluationOptions) -> Iterator[list[str]]:
    for antenna in run.folder.antennas:
        positions = run.positions_of(antenna)
        level = floats(positions, "protection_level_m")
        finite = level[np.isfinite(level)]
        middle = np.percentile(finite, [50.0, 95.0]) if len(finite) else np.full(2, np.nan)
        for levels_of in LEVELS_OF:
            for limit in limits:
                diagram = positions_diagram(positions, alarm_limit_m=limit, levels_of=levels_of, options=options)
                yield [
                    antenna,
                    levels_of,
                    f"{limit:g}",
                    number(len(positions), 0),
                    number(len(finite), 0),
                    *(number(float(value)) for value in middle),
                    share(diagram.available_rate),
                    *(share(window.probability) for window in diagram.continuity),
                ]
