"""Files of several runs to one surveyed map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, MismatchError
from railfix.core.files import BrokenLines, ending
from railfix.core.geodesy import geodetic_from_ecef
from railfix.gnss.navigation import Navigation
from railfix.io.logs import read_navigation
from railfix.io.nmea import read_any_positions
from railfix.io.receiver.framing import head_of, is_receiver_log
from railfix.pipeline.config import Config
from railfix.pipeline.received import known_from_start
from railfix.pipeline.survey_signals import survey_run
from railfix.run.options import LogReading
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

    Raises
    ------
    InputFileError
        A file is not what it should be, or has too few positions.
    MismatchError
        The runs lie apart, or have no line in common.
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
