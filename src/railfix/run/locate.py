"""3-D positions without a map, survey of a map from several runs, and line features measured by runs (P2, 2.3)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl

from railfix.core.arrays import Floats, join_rows
from railfix.core.errors import InputFileError, MismatchError, NoPositionError
from railfix.core.geodesy import geodetic_from_ecef
from railfix.core.staged_files import write_whole
from railfix.core.tables import reading_table
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.io.file_kind import POSITIONS, find_kind, wrong_kind
from railfix.io.logs import read_navigation
from railfix.io.positions import read_positions
from railfix.motion.features import BASE_M, STEP_M, Feature, LineSeries, Quantity, map_features
from railfix.pipeline.channel_book import ChannelBook
from railfix.pipeline.config import Config
from railfix.pipeline.received import Received, known_from_start
from railfix.pipeline.without_map import Located, NoPosition, locate, survey_run
from railfix.run.checks import check_each_file
from railfix.run.inputs import NAVIGATION, InputFiles, LogReading, input_option
from railfix.run.sources import Log
from railfix.track.heights import egm96_heights
from railfix.track.survey.line import Survey, survey_line
from railfix.track.survey.runs import SurveyLimits, SurveyRun, run_of_log
from railfix.track.track import ANOTHER_PLACE_M
from railfix.track.trajectory import Trajectory


class LocateInputs(InputFiles):
    """Input files of `railfix locate`."""

    own_navigation = ("log",)
    log: tuple[Path, ...] = input_option("Observations of one receiver: RINEX, UBX, SBF, RTCM 3.", metavar="OBS")
    nav: tuple[Path, ...] = input_option(NAVIGATION, (), metavar="NAV")


@dataclass(frozen=True, kw_only=True)
class LocateSummary:
    """Summary of `railfix locate`."""

    epochs: int  #: Number of epochs.
    positions: int  #: Number of epochs with a position.
    sigma_m: tuple[float, float, float]  #: Medians of the positions' standard deviations north, east and up [m].
    notes: tuple[str, ...]


def locate_files(
    inputs: LocateInputs, config: Config, *, out: Path, reading: LogReading | None = None
) -> LocateSummary:
    """Compute the 3-D positions of a log, and write them to an RTKLIB solution file with quality 5 (single).

    Raise NoPositionError if no epoch has a position. Raise OutputError if the file cannot be written.
    """
    inputs.check_files()
    reading = reading or LogReading()
    navigation = read_navigation(inputs.nav, **reading.arguments)
    received = known_from_start(config, navigation=navigation)
    log = Log(paths=inputs.log, chunk_epochs=_CHUNK_EPOCHS, reading=reading)
    check_each_file(navigation, log)
    book = ChannelBook(config)
    parts = [locate(part, received, config, book) for part in log.parts()]
    located = join_rows(parts)
    reasons = reasons_text(located)
    if not np.isfinite(located.ecef_m).any():
        if (located.no_position == int(NoPosition.NO_RECORD)).any():
            reasons += "; check that the navigation files are from the day of the log"
        message = f"{inputs.log[0]}: no epoch has a position: {reasons}"
        raise NoPositionError("; ".join([message, *navigation.notes]))
    write_whole(out, solution_text(located))
    known = np.isfinite(located.ecef_m[:, 0])
    north, east, up = np.median(located.sigma_m[known], axis=0).tolist()
    return LocateSummary(
        epochs=len(known),
        positions=int(known.sum()),
        sigma_m=(north, east, up),
        notes=(
            *navigation.notes, *received.notes, *log.problems,
            *([f"epochs without a position: {reasons}"] if reasons else []),
        ),
    )  # fmt: skip


def reasons_text(located: Located) -> str:
    """Return, as text, the number of epochs without a position by reason, or "" if every epoch has a position."""
    found = Counter(located.no_position.tolist())
    return ", ".join(f"{count} {NoPosition(reason).text}" for reason, count in sorted(found.items()) if reason)


def solution_text(located: Located) -> str:
    """Return the text of an RTKLIB solution file with GPS time, geodetic coordinates and standard deviations.

    An epoch without a position is written as a comment line with the time and the reason.
    """
    lines = [
        "% program   : railfix locate",
        "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)",
        "%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  "
        "sdeu(m)  sdun(m) age(s)  ratio",
    ]
    stamps = np.datetime_as_string(located.time, unit="ms")
    columns = (located.n_used, located.no_position, located.sigma_m)
    rows: Any = zip(stamps, *geodetic_from_ecef(located.ecef_m), *columns, strict=True)
    for stamp, lat, lon, up, count, reason, (north, east, vertical) in rows:
        day, clock = str(stamp).replace("-", "/").split("T")
        if reason:
            lines.append(f"% {day} {clock} no position: {NoPosition(int(reason)).text}")
            continue
        lines.append(
            f"{day} {clock} {lat:14.9f} {lon:14.9f} {up:10.4f} {5:3d} {count:3d} {north:8.4f} {east:8.4f} "
            f"{vertical:8.4f} {0.0:8.4f} {0.0:8.4f} {0.0:8.4f} {0.0:6.2f} {0.0:6.1f}"
        )
    return "\n".join(lines) + "\n"


#: Number of epochs that are positioned together.
_CHUNK_EPOCHS: Final = 3000
#: Number of epochs that `likely_cause` tests.
_EPOCHS: Final = 5
#: A position is taken to be on the line if its horizontal distance from the line is less than this [m].
_ON_LINE_M: Final = 150.0
#: A height difference between positions and line is not attributed to range errors if it exceeds this [m].
_HEIGHT_M: Final = 30.0
#: GPS time minus UTC since 2017 [s].
_LEAP_S: Final = 18
#: GPS time minus BeiDou time [s].
_BEIDOU_S: Final = 14
#: Largest time-zone shift that is tested [h].
_HOURS: Final = 14
_FEET: Final = 0.3048
#: A cause is not reported if the offset that it would produce differs by this or more from the positions' offset [m].
_CAUSE_M: Final = 15.0
#: A wrong height datum is considered as a cause only if the geoid is farther than this from the ellipsoid [m].
_GEOID_M: Final = 10.0


def likely_cause(observations: Observations, received: Received, config: Config, line: Trajectory) -> str:
    """Return a clause on the likely cause of positions off the line, or "" if no cause was found.

    Conventional positions of a few epochs are compared with the line in plan and in height. If they are not on the line
    in plan, the comparison is repeated with time tags shifted by leap seconds and whole hours.
    """
    step = max(len(observations) // _EPOCHS, 1)
    few = observations[: step * _EPOCHS : step]
    as_tagged = _offset_m(few, received, config, line)
    if as_tagged is not None and as_tagged[0] < _ON_LINE_M:
        return _cause_in_height(*as_tagged[1:])
    for shift_s in _shifts_s():
        shifted = replace(few, time=few.time + np.timedelta64(shift_s, "s"))
        offset = _offset_m(shifted, received, config, line)
        if offset is not None and offset[0] < _ON_LINE_M:
            return (
                f"with time tags {_duration(abs(shift_s))} {'later' if shift_s > 0 else 'earlier'} the positions lie "
                "on the line; the tags may be UTC or local time, or the time system in the log's header may be wrong"
            )
    if as_tagged is None:
        return ""
    return f"the positions lie {as_tagged[0]:,.0f} m from the line; check whether this is the right track"


def _shifts_s() -> Iterator[int]:
    """Yield the time-tag shifts that common mistakes cause [s]: first wrong time scales, then time zones."""
    for seconds in (_LEAP_S, _BEIDOU_S):
        yield from (seconds, -seconds)
    for hours in range(1, _HOURS + 1):
        for sign in (-1, 1):
            yield from (sign * hours * 3600, sign * hours * 3600 + _LEAP_S, sign * hours * 3600 - _LEAP_S)


def _offset_m(
    observations: Observations, received: Received, config: Config, line: Trajectory
) -> tuple[float, float, float, float] | None:
    """Return horizontal and vertical offset of the median position from the line, and line and geoid height [m].

    Return None if no epoch has a position.
    """
    ecef: Floats = locate(observations, received, config, ChannelBook(config)).ecef_m
    if not np.isfinite(ecef[:, 0]).any():
        return None
    place = np.nanmedian(ecef, axis=0)
    arc, _ = line.nearest(place[None])
    latitude, longitude, height = (float(value) for value in geodetic_from_ecef(place))
    geoid = float(egm96_heights(np.array([latitude]), np.array([longitude]))[0])
    of_line = float(geodetic_from_ecef(line.at_arc(arc)[0])[2])
    # The position is moved to the height of the line, so that wrong line heights do not change the offset in plan.
    level = place * (1.0 + (of_line - height) / float(np.linalg.norm(place)))
    return float(line.nearest(level[None])[1][0]), height - of_line, of_line, geoid


def _cause_in_height(above_m: float, of_line_m: float, geoid_m: float) -> str:
    """Return a clause on the height offset and the unit or datum that may explain it, or "" if the offset is small."""
    apart = f"the positions lie {abs(above_m):.0f} m {'above' if above_m > 0.0 else 'below'} the line"
    if abs(of_line_m * _FEET - of_line_m - above_m) < min(abs(above_m) / 4.0, _CAUSE_M) and abs(above_m) > _HEIGHT_M:
        return f"{apart}; the heights of the map may be in feet"
    for offset_m, advice in ((geoid_m, _AS_ORTHOMETRIC), (-geoid_m, _AS_ELLIPSOIDAL)):
        if abs(geoid_m) > _GEOID_M and abs(above_m - offset_m) < min(abs(geoid_m) / 2.0, _CAUSE_M):
            side = "above" if geoid_m > 0.0 else "below"
            return f"{apart}, and the geoid {abs(geoid_m):.0f} m {side} the ellipsoid; {advice}"
    return f"{apart}; check the datum and the unit of the map's heights" if abs(above_m) > _HEIGHT_M else ""


#: Advice for a map whose heights were probably read with the wrong datum.
_AS_ORTHOMETRIC: Final = (
    "the heights of the map seem to be above the geoid, not the ellipsoid: give --height-datum orthometric --geoid "
    "egm96, or in a CSV file name their column elevation_m and give --geoid egm96"
)
_AS_ELLIPSOIDAL: Final = (
    "the heights of the map seem to be above the ellipsoid already: give --height-datum ellipsoidal, or in a CSV file "
    "name their column height_m"
)


def _duration(seconds: int) -> str:
    hours, rest = divmod(seconds + _LEAP_S, 3600)
    rest -= _LEAP_S
    return " ".join([*([f"{hours} h"] if hours else []), *([f"{rest:+d} s" if hours else f"{rest} s"] if rest else [])])


@dataclass(frozen=True, kw_only=True)
class Surveyed:
    """Survey of a line, with the runs and notes on the files."""

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
) -> Surveyed:
    """Survey a line from position logs and observation logs.

    Raise InputFileError if a file is missing, occurs twice, or is neither a position log nor an observation log, or if
    an observation log has no navigation file. Raise MismatchError if the runs are far apart or have no line in common.
    """
    for path in (*paths, *nav):
        if not path.is_file():
            raise InputFileError(path, "no such file; give files of positions and logs of observations")
    twice = {path for path in paths if sum(path.samefile(other) for other in paths) > 1}
    if twice:
        raise InputFileError(min(twice), "is given twice; give each run once")
    reading = reading or LogReading()
    runs: list[SurveyRun] = []
    notes: list[str] = []
    of_nav: Navigation | None = None
    for path in paths:
        try:
            kind = find_kind(path)
            if kind in POSITIONS and kind != "receiver":
                of_file = columns if kind == "table" else None
                log = read_positions(path, columns=of_file, **reading.arguments)
                notes += log.notes
                runs.append(run_of_log(log, limits))
                continue
            if kind not in ("observations", "receiver", "mate"):
                raise wrong_kind(path, "a log of positions or observations")
            own = not nav and kind == "receiver"
            if not nav and not own:
                message = "is a log of observations, which needs navigation files: give --nav"
                raise InputFileError(path, message)
            of_nav = (
                read_navigation((path,), **reading.arguments)
                if own
                else of_nav or read_navigation(tuple(nav), **reading.arguments)
            )
            received = known_from_start(config, navigation=of_nav)
            observed = Log(paths=(path,), chunk_epochs=_CHUNK_EPOCHS, reading=reading)
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
    """Raise MismatchError if a run is farther than `ANOTHER_PLACE_M` from the first run."""
    places: list[Floats] = [np.nanmedian(run.ecef_m, axis=0) for run in runs]
    for run, place in zip(runs, places, strict=True):
        distance = float(np.linalg.norm(place - places[0]))
        if distance > ANOTHER_PLACE_M:
            latitude, longitude, _ = geodetic_from_ecef(place)
            raise MismatchError(
                f"{run.name} lies at {latitude:.3f}, {longitude:.3f}, {distance / 1e3:,.0f} km from {runs[0].name}; "
                "give runs over one line"
            )


#: Columns of ``train.parquet`` with measured line properties: chainage [m], gradient [permille], curvature [1/m].
_COLUMNS: Final = ("measured_chainage_m", "measured_gradient_permille", "measured_curvature_1pm")
#: A change of gradient or curvature is a feature if it is at least this many standard deviations.
_SIGMAS: Final = 5.0
#: Features are sought only where a mean is computed from at least this number of values.
_LEAST_VALUES: Final = 3
#: Number of iterations in which `centre_features` centres its window on a change.
_CENTRED: Final = 5
#: Measured values are omitted within this time before and after a detected wheel slip. Values before the detection are
#: omitted because the slip already affects the gradient.
_BEFORE_SLIP: Final = np.timedelta64(1500, "ms")


def read_measured(folder: Path) -> pl.DataFrame:
    """Read the line properties that a run has measured (`_COLUMNS`), in order of chainage.

    Only the first antenna's rows are returned. Raise InputFileError if the folder has no filter results, or if the run
    had no tachometer or no inertial unit.
    """
    path = folder / "train.parquet"
    with reading_table(path, "has no measured properties of the line ({}); give a folder written by railfix run"):
        table = pl.read_parquet(path, columns=["time_gpst", "antenna", "motion", *_COLUMNS])
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
    """Feature detected in the combined values of all runs."""

    feature: Feature  #: Feature; its `arc_m` is a chainage.
    places_m: Floats  #: Chainage of the feature in each of the R runs in which it is also detected, shape (R,) [m].
    map_m: float  #: Chainage of the feature in the map [m], NaN if the map lacks the feature.


def find_features(runs: Sequence[pl.DataFrame], of_map: Sequence[Feature] = ()) -> list[MeasuredFeature]:
    """Return the features detected in the combined values of all runs (see `read_measured`), in order of chainage.

    `of_map` are the map features with which the detected features are compared.
    """
    alone = [_features(run) for run in runs]
    found = []
    for feature in _features(pl.concat(runs).sort(_COLUMNS[0])):
        places = [place for each in alone if np.isfinite(place := _nearest(feature, each))]
        at_map = _nearest(feature, of_map)
        found.append(MeasuredFeature(feature=feature, places_m=np.array(places), map_m=at_map))
    return found


def _nearest(feature: Feature, others: Sequence[Feature]) -> float:
    """Return the chainage [m] of the nearest feature in `others` with the same quantity and sign of change, or NaN."""
    alike = [f.arc_m for f in others if f.quantity == feature.quantity and f.change * feature.change > 0.0]
    near = [at for at in alike if abs(at - feature.arc_m) < 2.0 * BASE_M]
    return min(near, key=lambda at: abs(at - feature.arc_m), default=float("nan"))


def _features(rows: pl.DataFrame) -> list[Feature]:
    """Return the features in `rows` (ordered by chainage). Each section with enough values is searched separately."""
    at = rows[_COLUMNS[0]].to_numpy()
    grid = np.arange(np.ceil(at[0]), np.floor(at[-1]), STEP_M)
    first = np.searchsorted(at, grid - 0.5 * BASE_M)
    last = np.searchsorted(at, grid + 0.5 * BASE_M)
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
        found += centre_features(map_features(series, least=least), series)
    return found


def centre_features(features: Sequence[Feature], series: LineSeries) -> list[Feature]:
    """Return the features, each moved to the centre of its change of gradient or curvature.

    On a long transition, noise shifts the detected position, but hardly affects the centre of the change.
    """
    lag = max(round(BASE_M / STEP_M), 1)
    found = []
    for feature in features:
        values = series.of(feature.quantity)
        change = np.zeros(len(values))
        change[lag:-lag] = (values[2 * lag :] - values[: -2 * lag]) * np.sign(feature.change)
        over, middle = np.maximum(change - 0.5 * abs(feature.change), 0.0), feature.arc_m
        for _ in range(_CENTRED):
            weight = np.where(np.abs(series.arc_m - middle) <= 2.0 * BASE_M, over, 0.0)
            middle = float((weight * series.arc_m).sum() / weight.sum())
        found.append(replace(feature, arc_m=middle))
    return found


def _means(values: Floats, first: np.ndarray, last: np.ndarray) -> tuple[Floats, Floats]:
    """Return the means of ``values[first:last]``, and the standard deviations of the means."""
    count = np.maximum(last - first, 1)
    middle = values - values.mean()
    sums, squares = (np.concatenate([[0.0], np.cumsum(each)]) for each in (middle, middle**2))
    mean = (sums[last] - sums[first]) / count
    spread = np.maximum((squares[last] - squares[first]) / count - mean**2, 0.0)
    return mean + values.mean(), np.sqrt(spread / np.maximum(count - 1, 1))
