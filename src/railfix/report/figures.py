"""Charts of a run, ordered as on the page, reasons for missing charts, and tables of the protection levels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import polars as pl

from railfix.core.arrays import Datetimes, Floats
from railfix.core.errors import InputFileError
from railfix.core.tables import Table, number, share
from railfix.evaluate import Evaluation, EvaluationOptions
from railfix.evaluate.evaluation_inputs import floats
from railfix.evaluate.integrity import LEVELS_OF, epochs_diagram, level_name, positions_diagram
from railfix.evaluate.tables import level_tables, select_evaluation
from railfix.pipeline.level_stage import prior_basis_text
from railfix.report.charts_page import Absent, Block, Group, Sentence
from railfix.report.plots.campaign import processing_time
from railfix.report.plots.chart import Chart, find_start
from railfix.report.plots.errors import (
    error_over_chainage,
    error_over_time,
    good_errors,
    levels_over_chainage,
    levels_over_time,
    stanford,
)
from railfix.report.plots.line import interval_distribution, interval_over_chainage, plan, satellites_over_time
from railfix.report.plots.screens import list_screens, missing_columns, screen_over_chainage, screen_over_time
from railfix.report.plots.signals import CN0_COLUMNS, SKY_COLUMNS, SKY_EPOCHS, cn0_over_elevation, sky_epochs
from railfix.report.runs import ReportedRun

#: At most this number of epochs with an error above the protection level is listed.
WORST: Final = 20
NO_LEVELS: Final = "The run has no protection levels (protection is off)."
_KINDS: Final = {
    "sbas": "SBAS covers satellite faults; fault hypotheses: local faults (multipath)",
    "separation": "solution separation; fault hypotheses: satellite faults and local faults",
}
_EXPLAINED: Final = (
    "In rows of usable levels, the level counts as infinite if the status of the position is not ok or an alarm is "
    "active. In rows of all levels, every finite level is counted, whatever the status"
)


def protection(run: ReportedRun, evaluation: Evaluation | None) -> list[Block]:
    """Return the tables on the protection levels of a run."""
    kind = run.folder.level_kind
    if kind is None:
        return [Absent(NO_LEVELS)]
    if evaluation is None:
        return [_assumptions(run, kind), _availability(run)]
    tables: list[Block] = [_assumptions(run, kind)]
    for name, of in ((run.name_in(evaluation), ""), (run.name_in(evaluation, "train"), "filter-")):
        found = level_tables(select_evaluation(evaluation, name), worst=WORST) if name else []
        tables += [replace(t, name=f"{of}{t.name}") if t.rows else Sentence(f"{t.caption}.") for t in found]
    return tables


def _assumptions(run: ReportedRun, kind: str) -> Table:
    stated: Mapping[str, Any] = run.record.get("protection") or {}
    model = run.config.error_model
    sigmas = f"error model {model}" if model is not None else str(stated.get("sigmas", "not recorded"))
    rows = [
        ("kind", f"{kind}: {_KINDS.get(kind, 'not recorded')}"),
        ("basis of the priors", prior_basis_text(stated)),
        ("fault-free errors", sigmas),
        ("alarm limit", _value(stated.get("alarm_limit_m"), " m")),
        ("risk per hour", _value(stated.get("risk_per_hour"))),
        ("independent samples per hour", _value(stated.get("samples_per_hour"))),
        ("risk per sample", _value(stated.get("risk_per_sample"))),
        ("K factor of the whole risk", _value(stated.get("k_of_whole_risk"), " sigma, two-sided")),
        ("prior of a satellite fault", _priors(stated.get("satellite_prior"))),
        ("prior of a local fault", _value(stated.get("local_prior"))),
        ("prior of faults on one side of the track", _value(stated.get("side_prior"))),
        ("prior of a wrong map", _value(stated.get("map_prior"))),
        ("probability of a false alarm", _value(stated.get("false_alarm"))),
    ]
    return Table(name="assumptions", head=["", "assumption of the protection level"], rows=rows)


def _priors(priors: Any) -> str:
    """Return fault priors as text: each distinct value, followed by the constellations to which it applies."""
    if not isinstance(priors, Mapping):
        return "not recorded"
    alike: dict[str, list[str]] = {}
    for system, value in priors.items():
        alike.setdefault(_value(value), []).append(str(system))
    return "; ".join(f"{value} ({' '.join(systems)})" for value, systems in alike.items())


def _value(value: Any, unit: str = "") -> str:
    return "not recorded" if not isinstance(value, int | float) else f"{value:.4g}{unit}"


def _availability(run: ReportedRun) -> Table:
    """Return a table of percentiles and availability of the protection levels of a run without a reference."""
    options = EvaluationOptions()
    limits = sorted({*options.alarm_limits_m, run.folder.alarm_limit_m or run.config.alarm_limit_m})
    return Table(
        name="availability",
        head=["antenna", "levels", "limit, m", "epochs", "finite", "p50", "p95", "available", "15 s", "60 s"],
        rows=list(_rows_available(run, limits, options)),
        caption="Fraction of all epochs that have an available level. Of the windows of 15 s and 60 s that begin with "
        f"an available level, fraction in which the level stays available. {_EXPLAINED}. Levels are in metres; "
        "without a reference they are not compared with errors",
        numeric=range(2, 10),
    )


def _rows_available(run: ReportedRun, limits: Sequence[float], options: EvaluationOptions) -> Iterator[list[str]]:
    for antenna in run.folder.antennas:
        positions = run.get_positions(antenna)
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


#: For each kind of position, the sky plot includes this number of epochs with the largest errors.
_WORST: Final = 200
NO_REFERENCE: Final = (
    "No reference was given (--reference), so there are no errors, figures of merit or Stanford diagrams. "
    "Distances travelled are computed between consecutive positions."
)
NO_OBSERVATIONS: Final = (
    "The run wrote no observations (railfix run --observations), so there are no charts of the sky, of C/N0 and of "
    "the screens."
)
NO_TIMES: Final = "run.json has no processing times, so there is no chart of processing times."


def overview(run: ReportedRun, antenna: str, background: Sequence[Floats] = ()) -> Group:
    """Return the plan of the line and a chart over chainage for one antenna.

    The chart over chainage shows errors. Without a reference it shows protection levels or, if there are none,
    distances between consecutive positions.
    """
    positions, errors = run.get_positions(antenna), run.get_errors(antenna)
    if errors is not None:
        beside = error_over_chainage(errors, filtered=run.filter_rows(antenna))
    else:
        beside = levels_over_chainage(positions, _alarm_limit(run))
        beside = interval_over_chainage(positions) if beside.empty else beside
    charts = _keep(_plan(run, antenna, background), beside)
    return Group(title="", charts=charts, start=find_start(positions))


def _plan(run: ReportedRun, antenna: str, background: Sequence[Floats]) -> Chart:
    """Return the plan with positions coloured by error or, if there are none, by protection level or by status."""
    positions, errors = run.get_positions(antenna), run.get_errors(antenna)
    level = floats(positions, "protection_level_m")
    return plan(
        positions,
        error_m=None if errors is None else _align(positions, errors),
        level_m=level if np.isfinite(level).any() else None,
        filtered=run.get_train(antenna),
        track=run.track,
        tunnels_m=_tunnels(errors),
        background=background,
        title=f"Plan of the line, {antenna} antenna",
    )


def antenna_groups(
    run: ReportedRun, antenna: str, *, sky: int = SKY_EPOCHS, background: Sequence[Floats] = ()
) -> Iterator[Group]:
    """Yield the charts of one antenna; `sky` is the maximum number of epochs of the sky plot.

    `background` is as for `railfix.report.report_page`.
    """
    positions, errors = run.get_positions(antenna), run.get_errors(antenna)
    start = find_start(positions)
    yield Group(title="The line", charts=_keep(_plan(run, antenna, background)), start=start)
    if errors is not None:
        filtered = run.filter_rows(antenna)
        over = _keep(error_over_time(errors, filtered=filtered), error_over_chainage(errors, filtered=filtered))
        yield Group(title="Errors", charts=over, start=find_start(errors))
    else:
        yield Group(title="Errors", charts=(), start=start, absent=(NO_REFERENCE,))
    limit = _alarm_limit(run)
    levels = _keep(levels_over_time(positions, limit), levels_over_chainage(positions, limit))
    if levels and errors is not None:
        levels = _keep(*_stanford(run, antenna, errors, limit)) + levels
    absent = () if levels else (NO_LEVELS,)
    yield Group(title="Protection level", charts=levels, start=start, absent=absent)
    table = positions if errors is None else errors
    charts = (interval_over_chainage(table), interval_distribution(table), satellites_over_time(positions))
    yield Group(title="Positioning interval and satellites", charts=_keep(*charts), start=start)
    if run.observations is None:
        yield Group(title="Signals", charts=(), start=start, absent=(NO_OBSERVATIONS,))
        return
    observations = run.observations.filter(pl.col("antenna") == antenna)
    in_view = sky_epochs(
        observations.select(SKY_COLUMNS), wanted=_worst(errors), epochs=sky, title=f"Sky over the {antenna} antenna"
    )
    yield Group(title="Sky", charts=() if in_view.empty else (in_view,), start=start)
    curves = cn0_over_elevation(
        observations.select(CN0_COLUMNS),
        limits=run.config.cn0 if "cn0" in run.config.screens else None,
        curve=run.curve,
        mask_deg=run.config.elevation.mask_deg if "elevation" in run.config.screens else None,
    )
    absent = () if curves else ("No observation has both an elevation and a C/N0, so there is no chart of C/N0.",)
    yield Group(title="C/N0 over elevation", charts=_keep(*curves), start=start, absent=absent)
    yield _screens(run, antenna, positions, observations, start)


def _alarm_limit(run: ReportedRun) -> float:
    return run.folder.alarm_limit_m or run.config.alarm_limit_m


def _screens(
    run: ReportedRun, antenna: str, positions: pl.DataFrame, observations: pl.LazyFrame, start: np.datetime64
) -> Group:
    if missing := missing_columns(positions, observations):
        reason = f"The tables lack {', '.join(missing)}, so there are no charts of the screens; run again."
        return Group(title="Screens", charts=(), start=start, absent=(reason,))
    charts: list[Chart] = []
    for screen in list_screens(run.config, positions, observations):
        charts.append(screen_over_time(screen.picture, screen.epoch_time, epoch=screen.epoch))
        charts.append(screen_over_chainage(screen.picture, screen.epoch_chainage_m, epoch=screen.epoch))
    absent = () if charts else (f"No active screen of the {antenna} antenna tested anything.",)
    return Group(title="Screens: each metric against its limit", charts=_keep(*charts), start=start, absent=absent)


def run_group(run: ReportedRun) -> Group:
    """Return the chart of processing time, which refers to all antennas of a run together."""
    chunks = run.record.get("chunks") or {}
    start = find_start(run.folder.positions)
    if not all(chunks.get(name) for name in ("first_epoch_gpst", "epochs", "positioning_s")):
        return Group(title="Processing time", charts=(), start=start, absent=(NO_TIMES,))
    try:
        chart = processing_time(chunks)
    except (ValueError, TypeError) as error:
        path = run.folder.path / "run.json"
        raise InputFileError(path, f"has chunks that are not times and numbers ({error}); repeat the run") from None
    return Group(title="Processing time", charts=(chart,), start=start)


def _keep(*charts: Chart) -> tuple[Chart, ...]:
    return tuple(chart for chart in charts if not chart.empty)


def _stanford(run: ReportedRun, antenna: str, errors: pl.DataFrame, limit_m: float) -> Iterator[Chart]:
    """Yield Stanford diagrams: usable and all levels of single epochs, and usable levels of the filter."""
    kind, filtered, options = run.folder.level_kind, run.filter_rows(antenna), EvaluationOptions()
    if kind is None:
        return
    for levels_of, words in zip(LEVELS_OF, ("usable levels", "all levels"), strict=True):
        diagram = epochs_diagram(errors, kind, alarm_limit_m=limit_m, levels_of=levels_of, options=options)
        yield stanford(diagram, title=f"Stanford diagram, {words} ({kind})")
    if filtered is not None and level_name("train") in filtered.columns:
        diagram = epochs_diagram(filtered, "train", alarm_limit_m=limit_m, levels_of="usable", options=options)
        yield stanford(diagram, title="Stanford diagram, usable levels (filter along the track)")


def _align(positions: pl.DataFrame, errors: pl.DataFrame) -> Floats:
    """Return the error of each position, shape (rows,) [m]; NaN if the table has no error of a position."""
    known = errors.select("time_gpst", error_m=pl.Series(good_errors(errors, "error_m"), nan_to_null=True))
    joined = positions.select("time_gpst").join(known, on="time_gpst", how="left", maintain_order="left")
    return floats(joined, "error_m")


def _worst(errors: pl.DataFrame | None) -> Datetimes | None:
    """Return the epochs with the largest errors of constrained and of conventional positions; None without errors."""
    if errors is None:
        return None
    times = errors["time_gpst"].to_numpy()
    worst = []
    for column in ("error_m", "conventional_error_m"):
        size = np.nan_to_num(np.abs(floats(errors, column)), nan=-1.0)
        worst.append(times[np.argsort(-size, kind="stable")[:_WORST]])
    return np.concatenate(worst)


def _tunnels(errors: pl.DataFrame | None) -> list[tuple[float, float]]:
    """Return first and last chainage [m] of each tunnel: at least two consecutive epochs with the environment
    ``tunnel``.
    """
    if errors is None:
        return []
    known = errors.filter(pl.col("chainage_m").is_not_null()).sort("chainage_m")
    inside = (known["environment"] == "tunnel").to_numpy()
    edges = np.flatnonzero(np.diff(inside.astype(np.int8), prepend=0, append=0))
    chainage = known["chainage_m"].to_numpy()
    pairs = zip(edges[::2], edges[1::2], strict=True)
    return [(float(chainage[first]), float(chainage[last - 1])) for first, last in pairs if last - first > 1]
