"""Which charts a run gets, in which order, and why one is not there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import polars as pl

from railfix.core.arrays import Datetimes, Floats
from railfix.core.errors import InputFileError
from railfix.evaluate import EvaluationOptions
from railfix.evaluate.integrity import LEVELS_OF, epochs_diagram
from railfix.report.plots.chart import Chart, SkyEpochs
from railfix.report.plots.columns import floats, start_of
from railfix.report.plots.errors import error_over_chainage, error_over_time, good_errors
from railfix.report.plots.levels import levels_over_chainage, levels_over_time, stanford
from railfix.report.plots.line import interval_distribution, interval_over_chainage, plan, satellites_over_time
from railfix.report.plots.run_screens import screens_of
from railfix.report.plots.screens import screen_over_chainage, screen_over_time
from railfix.report.plots.signals import SKY_EPOCHS, cn0_over_elevation, sky_epochs
from railfix.report.plots.timing import processing_time
from railfix.report.protection import NO_LEVELS
from railfix.report.runs import ReportedRun

#: Largest errors whose epochs are surely among those of the sky.
_WORST: Final = 200
NO_REFERENCE: Final = (
    "No reference was given (--reference), so there are no pictures of errors, no figures of merit and no Stanford "
    "diagram; intervals between positions are those of the positions themselves."
)
NO_OBSERVATIONS: Final = (
    "The run wrote no observations (railfix run --observations), so there are no pictures of the sky, of C/N0 and of "
    "the screens."
)
NO_TIMES: Final = "run.json tells no times of chunks, so there is no picture of the processing time."


@dataclass(frozen=True, kw_only=True)
class Group:
    """Charts under one heading.

    Attributes
    ----------
    title : str
    charts : tuple of Chart or SkyEpochs
    start : datetime64[ns]
        From when `Points.epoch_s` of the charts counts.
    absent : tuple of str
        What is not there, and why.
    """

    title: str
    charts: tuple[Chart | SkyEpochs, ...]
    start: np.datetime64
    absent: tuple[str, ...] = ()


def antenna_groups(run: ReportedRun, antenna: str, *, sky: int = SKY_EPOCHS) -> Iterator[Group]:
    """Charts of one antenna of a run.

    Parameters
    ----------
    run : ReportedRun
    antenna : str
    sky : int
        Epochs of the sky at most.

    Yields
    ------
    Group
    """
    positions, errors, observations = run.positions_of(antenna), run.errors_of(antenna), run.observations_of(antenna)
    start = start_of(positions)
    along = None if errors is None else _aligned(positions, errors)
    yield Group(title="The line", charts=_kept(plan(positions, error_m=along)), start=start)
    if errors is not None:
        over = _kept(error_over_time(errors), error_over_chainage(errors))
        yield Group(title="Errors", charts=over, start=start_of(errors))
    else:
        yield Group(title="Errors", charts=(), start=start, absent=(NO_REFERENCE,))
    limit = run.folder.alarm_limit_m or run.config.alarm_limit_m
    levels = _kept(levels_over_time(positions, limit), levels_over_chainage(positions, limit))
    if levels and errors is not None:
        levels = _kept(*_stanford(run, errors, limit)) + levels
    absent = () if levels else (NO_LEVELS,)
    yield Group(title="Protection level", charts=levels, start=start, absent=absent)
    table = positions if errors is None else errors
    charts = (interval_over_chainage(table), interval_distribution(table), satellites_over_time(positions))
    yield Group(title="Positioning interval and satellites", charts=_kept(*charts), start=start)
    if observations is None:
        yield Group(title="Signals", charts=(), start=start, absent=(NO_OBSERVATIONS,))
        return
    seen = sky_epochs(observations, wanted=_worst(errors), epochs=sky, title=f"Sky over the {antenna} antenna")
    yield Group(title="Sky", charts=() if seen.empty else (seen,), start=start)
    curves = cn0_over_elevation(
        observations,
        limits=run.config.cn0 if "cn0" in run.config.screens else None,
        curve=run.curve,
        mask_deg=run.config.elevation.mask_deg if "elevation" in run.config.screens else None,
    )
    absent = () if curves else ("No observation has both an elevation and a C/N0, so there is no picture of them.",)
    yield Group(title="C/N0 over elevation", charts=_kept(*curves), start=start, absent=absent)
    yield _screens(run, antenna, positions, observations, start)


def _screens(
    run: ReportedRun, antenna: str, positions: pl.DataFrame, observations: pl.DataFrame, start: np.datetime64
) -> Group:
    lacking = {"raim_statistic", "metric_antenna_spacing_m"} - set(positions.columns)
    lacking |= {"metric_doppler_m", "limit_doppler_m", "metric_antenna_pair_m"} - set(observations.columns)
    if lacking:
        why = f"The tables lack {', '.join(sorted(lacking))}, so there are no pictures of the screens; run again."
        return Group(title="Screens", charts=(), start=start, absent=(why,))
    charts: list[Chart] = []
    for screen in screens_of(run.config, positions, observations):
        charts.append(screen_over_time(screen.picture, screen.time))
        charts.append(screen_over_chainage(screen.picture, screen.chainage_m))
    absent = () if charts else (f"No screen of the {antenna} antenna was on that had anything to judge.",)
    return Group(title="Screens: each metric against its limit", charts=_kept(*charts), start=start, absent=absent)


def run_group(run: ReportedRun) -> Group:
    """Charts of a run as a whole."""
    chunks = run.record.get("chunks") or {}
    start = start_of(run.folder.positions)
    if not all(chunks.get(name) for name in ("first_epoch_gpst", "epochs", "positioning_s")):
        return Group(title="Processing time", charts=(), start=start, absent=(NO_TIMES,))
    try:
        chart = processing_time(chunks)
    except (ValueError, TypeError) as error:
        path = run.folder.path / "run.json"
        raise InputFileError(path, f"has chunks that are not times and numbers ({error}); repeat the run") from None
    return Group(title="Processing time", charts=(chart,), start=start)


def _kept(*charts: Chart) -> tuple[Chart, ...]:
    return tuple(chart for chart in charts if not chart.empty)


def _stanford(run: ReportedRun, errors: pl.DataFrame, limit_m: float) -> Iterator[Chart]:
    """The diagram of the levels that the run usable, and of all."""
    kind = run.folder.level_kind
    if kind is None:
        return
    for levels_of, words in zip(LEVELS_OF, ("usable levels", "levels alone"), strict=True):
        diagram = epochs_diagram(errors, kind, alarm_limit_m=limit_m, levels_of=levels_of, options=EvaluationOptions())
        yield stanford(diagram, title=f"Stanford diagram, {words} ({kind})")


def _aligned(positions: pl.DataFrame, errors: pl.DataFrame) -> Floats:
    """Errors row by row of the positions."""
    known = errors.select("time_gpst", error_m=pl.Series(good_errors(errors, "error_m"), nan_to_null=True))
    joined = positions.select("time_gpst").join(known, on="time_gpst", how="left", maintain_order="left")
    return floats(joined, "error_m")


def _worst(errors: pl.DataFrame | None) -> Datetimes | None:
    """Epochs of the largest errors, on the map and conventional."""
    if errors is None:
        return None
    times = errors["time_gpst"].to_numpy()
    found = []
    for column in ("error_m", "conventional_error_m"):
        size = np.nan_to_num(np.abs(floats(errors, column)), nan=-1.0)
        found.append(times[np.argsort(-size, kind="stable")[:_WORST]])
    return np.concatenate(found)
