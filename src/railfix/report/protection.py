"""Tables of the report on protection levels: assumptions, Stanford counts, errors above their level."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from railfix.core.tables import Table, number, share
from railfix.evaluate import Evaluation, EvaluationOptions
from railfix.evaluate.integrity import LEVELS_OF, positions_diagram
from railfix.evaluate.run_folder import floats
from railfix.evaluate.tables import evaluation_of, level_tables
from railfix.pipeline.level_stage import prior_basis_text
from railfix.report.content import Absent, Block
from railfix.report.runs import ReportedRun

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


def protection(run: ReportedRun, evaluation: Evaluation | None) -> list[Block]:
    """Tables on the protection levels of a run."""
    kind = run.folder.level_kind
    if kind is None:
        return [Absent(NO_LEVELS)]
    if evaluation is None:
        return [_assumptions(run, kind), _availability(run)]
    tables: list[Block] = [_assumptions(run, kind)]
    for name, of in ((run.name_in(evaluation), ""), (run.name_in(evaluation, "train"), "filter-")):
        found = level_tables(evaluation_of(evaluation, name), worst=WORST) if name else []
        tables += [replace(table, name=f"{of}{table.name}") for table in found]
    return tables


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
