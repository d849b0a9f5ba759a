"""Files of several runs to one surveyed map, and features of a line as runs measured them (P2 2.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import polars as pl

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, MismatchError
from railfix.core.files import BrokenLines, ending
from railfix.core.geodesy import geodetic_from_ecef
from railfix.gnss.navigation import Navigation
from railfix.io.logs import read_navigation
from railfix.io.nmea import read_any_positions
from railfix.io.receiver.framing import head_of, is_receiver_log
from railfix.motion.features import Feature, FeatureLimits, LineSeries, Quantity, map_features
from railfix.pipeline.config import Config
from railfix.pipeline.locate import survey_run
from railfix.pipeline.received import known_from_start
from railfix.run.inputs import LogReading
from railfix.run.sources import Log
from railfix.track.survey.line import Survey, survey_line
from railfix.track.survey.runs import SurveyLimits, SurveyRun, run_of_log
from railfix.track.track import ANOTHER_PLACE_M

#: Endings of files of positions; others are logs of observations.
POSITION_ENDINGS: Final = (".pos", ".csv", ".nmea", ".nma", ".gga", ".gpx", ".asc", ".ascii", ".gps")


@dataclass(frozen=True, kw_only=True)
class Surveyed:
    """A survey with its runs, and notes on the files."""

    survey: Survey
    runs: tuple[SurveyRun, ...]
    notes: tuple[str, ...]


def survey_files(
    paths: Sequence[Path],
    nav: Sequence[Path],
    config: Config,
    *,
    limits: SurveyLimits,
    name: str,
    reading: LogReading | None = None,
    columns: Mapping[str, str] | None = None,
    broken_lines: BrokenLines = "stop",
) -> Surveyed:
    """Survey a line from files of positions and logs of observations.

    MismatchError: the runs lie apart, or have no line in common.
    """
    for path in (*paths, *nav):
        if not path.is_file():
            raise InputFileError(path, "no such file; name files of positions and logs of observations")
    twice = {path for path in paths if sum(path.samefile(other) for other in paths) > 1}
    if twice:
        raise InputFileError(min(twice), "is given twice; name each run once")
    date = (reading or LogReading()).instant
    runs: list[SurveyRun] = []
    notes: list[str] = []
    of_nav: Navigation | None = None
    for path in paths:
        try:
            if ending(path) in POSITION_ENDINGS:
                of_file = columns if ending(path) == ".csv" else None
                log = read_any_positions(path, broken_lines=broken_lines, date=date, columns=of_file)
                notes += log.notes
                runs.append(run_of_log(log, limits))
                continue
            own = not nav and is_receiver_log(head_of(path))
            if not nav and not own:
                message = "is a log of observations, which needs navigation files: give --nav"
                raise InputFileError(path, f"{message}; positions are files {', '.join(POSITION_ENDINGS)}")
            of_nav = read_navigation((path,), date=date) if own else of_nav or read_navigation(tuple(nav), date=date)
            received = known_from_start(config, navigation=of_nav)
            observed = Log(paths=(path,), chunk_epochs=3000, broken_lines=broken_lines, date=date)
            runs.append(survey_run(observed.parts(), received, config, limits, name=str(path)))
            notes += [*received.notes, *observed.problems]
            of_nav = None if own else of_nav
        except ValueError as error:
            raise InputFileError(path, str(error)) from None
    _check_together(runs)
    try:
        survey = survey_line(runs, limits=limits, name=name)
    except ValueError as error:
        raise MismatchError(str(error)) from None
    return Surveyed(survey=survey, runs=tuple(runs), notes=tuple(dict.fromkeys(notes)))


def _check_together(runs: Sequence[SurveyRun]) -> None:
    """Raise MismatchError where a run is of another place than the first."""
    places: list[Floats] = [np.nanmedian(run.ecef_m, axis=0) for run in runs]
    for run, place in zip(runs, places, strict=True):
        distance = float(np.linalg.norm(place - places[0]))
        if distance > ANOTHER_PLACE_M:
            latitude, longitude, _ = geodetic_from_ecef(place)
            raise MismatchError(
                f"{run.name} lies at {latitude:.3f}, {longitude:.3f}, {distance / 1e3:,.0f} km from {runs[0].name}; "
                "give runs over one line"
            )


#: Columns of ``train.parquet`` with what a run has measured of the line, and the unit of the second and third.
_COLUMNS: Final = ("measured_chainage_m", "measured_gradient_permille", "measured_curvature_1pm")
#: A change counts when it is so many times its standard deviation, from so many values on either side.
_SIGMAS: Final = 5.0
_LEAST_VALUES: Final = 3
#: Rounds in which the window about a change moves to its middle.
_CENTRED: Final = 5
#: A slip is in the gradient for a while before it is found: what is so near to one is left out.
_BEFORE_SLIP: Final = np.timedelta64(1500, "ms")


def read_measured(folder: Path) -> pl.DataFrame:
    """Read what a run has measured of its line, by chainage; of two antennas the rows of the first.

    InputFileError: the folder has no results of a filter, or these none by wheel and inertial unit.
    """
    path = folder / "train.parquet"
    try:
        table = pl.read_parquet(path, columns=["time_gpst", "antenna", "motion", *_COLUMNS])
    except (OSError, pl.exceptions.PolarsError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputFileError(path, f"has no measured line ({reason}); give a folder of railfix run") from None
    table = table.filter(pl.col("antenna") == pl.col("antenna").first())
    time = table["time_gpst"].to_numpy().astype("datetime64[ns]")
    slips = time[(table["motion"] != "normal").to_numpy()]
    after = np.searchsorted(slips, time + _BEFORE_SLIP)
    before = np.searchsorted(slips, time - _BEFORE_SLIP)
    rows = table.filter(pl.Series(after == before)).select(_COLUMNS).drop_nulls().drop_nans()
    if not len(rows):
        raise InputFileError(
            path, "has no measured gradient and curvature; run with --tachometer (with a direction) and --inertial"
        )
    return rows.sort("measured_chainage_m")


@dataclass(frozen=True, kw_only=True)
class MeasuredFeature:
    """A feature that runs show together."""

    feature: Feature  #: Its `arc_m` is a chainage.
    places_m: Floats  #: Its chainage by each of the runs that show it alone, shape (R,).
    map_m: float  #: Chainage of the same feature of the map; NaN where the map has none.


def measured_features(
    runs: Sequence[pl.DataFrame], of_map: Sequence[Feature] = (), *, limits: FeatureLimits | None = None
) -> list[MeasuredFeature]:
    """Return the features that all runs (`read_measured`) together show, in order; `of_map`: those of the map."""
    limits = limits or FeatureLimits()
    alone = [_features(run, limits) for run in runs]
    found = []
    for feature in _features(pl.concat(runs).sort(_COLUMNS[0]), limits):
        places = [place for each in alone if np.isfinite(place := _nearest(feature, each, limits))]
        at_map = _nearest(feature, of_map, limits)
        found.append(MeasuredFeature(feature=feature, places_m=np.array(places), map_m=at_map))
    return found


def _nearest(feature: Feature, others: Sequence[Feature], limits: FeatureLimits) -> float:
    """Place of the nearest one of the same kind and direction; NaN where there is none near."""
    alike = [f.arc_m for f in others if f.quantity == feature.quantity and f.change * feature.change > 0.0]
    near = [at for at in alike if abs(at - feature.arc_m) < 2.0 * limits.base_m]
    return min(near, key=lambda at: abs(at - feature.arc_m), default=float("nan"))


def _features(rows: pl.DataFrame, limits: FeatureLimits) -> list[Feature]:
    """Features of rows by chainage; stretches without values part them."""
    at = rows[_COLUMNS[0]].to_numpy()
    grid = np.arange(np.ceil(at[0]), np.floor(at[-1]), limits.step_m)
    first = np.searchsorted(at, grid - 0.5 * limits.base_m)
    last = np.searchsorted(at, grid + 0.5 * limits.base_m)
    count = last - first
    gradient, gradient_sigma = _means(rows[_COLUMNS[1]].to_numpy() * 1e-3, first, last)
    curvature, curvature_sigma = _means(rows[_COLUMNS[2]].to_numpy(), first, last)
    enough = count >= _LEAST_VALUES
    edges = np.flatnonzero(np.diff(np.concatenate([[False], enough, [False]]).astype(np.int8)))
    found: list[Feature] = []
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        part = slice(begin, end)
        series = LineSeries(arc_m=grid[part], gradient=gradient[part], curvature_1pm=curvature[part])
        sigma: dict[Quantity, Floats] = {"gradient": gradient_sigma[part], "curvature": curvature_sigma[part]}
        least = {name: _SIGMAS * each for name, each in sigma.items()}
        found += centred(map_features(series, limits=limits, least=least), series, limits)
    return found


def centred(features: Sequence[Feature], series: LineSeries, limits: FeatureLimits) -> list[Feature]:
    """Return features at the middle of their change: that of a transition curve is flat, and noise chooses on it."""
    lag = max(round(limits.base_m / limits.step_m), 1)
    found = []
    for feature in features:
        values = series.of(feature.quantity)
        change = np.zeros(len(values))
        change[lag:-lag] = (values[2 * lag :] - values[: -2 * lag]) * np.sign(feature.change)
        over, middle = np.maximum(change - 0.5 * abs(feature.change), 0.0), feature.arc_m
        for _ in range(_CENTRED):
            weight = np.where(np.abs(series.arc_m - middle) <= 2.0 * limits.base_m, over, 0.0)
            middle = float((weight * series.arc_m).sum() / weight.sum())
        found.append(replace(feature, arc_m=middle))
    return found


def _means(values: Floats, first: np.ndarray, last: np.ndarray) -> tuple[Floats, Floats]:
    """Means of values between indices, and their standard deviations."""
    count = np.maximum(last - first, 1)
    middle = values - values.mean()
    sums, squares = (np.concatenate([[0.0], np.cumsum(each)]) for each in (middle, middle**2))
    mean = (sums[last] - sums[first]) / count
    spread = np.maximum((squares[last] - squares[first]) / count - mean**2, 0.0)
    return mean + values.mean(), np.sqrt(spread / np.maximum(count - 1, 1))
