"""Checks that the inputs of a run match each other, and that the run has positions."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import Final, Literal

import numpy as np

from railfix.core.arrays import Datetimes
from railfix.core.errors import MismatchError, NoPositionError
from railfix.core.timescale import timedelta
from railfix.gnss.navigation import Navigation
from railfix.motion.samples import SensorSamples
from railfix.pipeline.received import MessageCorrections
from railfix.ranges.base_station import LONGEST_AGE_S, LONGEST_KM
from railfix.run.processor_setup import BaseLog
from railfix.run.sources import Log
from railfix.run.tally import AntennaTally, Tally
from railfix.track.track import ANOTHER_PLACE_M
from railfix.track.trajectory import Trajectory

_SECOND: Final = np.timedelta64(1, "s")
#: A run stops if each antenna has at least this number of conventional positions, all of them farther from the line
#: than `ANOTHER_PLACE_M`.
ENOUGH_TO_STOP: Final = 10
#: Navigation records and sensor samples farther in time than this from a log are assumed to be of another day.
ANOTHER_DAY: Final = np.timedelta64(24, "h")
#: Sensors with samples only at events. They have no samples while the train is at rest, or passes neither a balise nor
#: a ground unit.
_OF_EVENTS: Final = ("tachometer", "ranging", "balises")
#: A navigation record is assumed to be usable at epochs at most this far from its reference time (BeiDou: 6 h,
#: `gnss.orbits.prepared_records.VALIDITY_S`).
RECORD_REACH: Final = np.timedelta64(6, "h")


#: First and last time of a log, or of messages or navigation records.
Span = tuple[np.datetime64, np.datetime64]


def navigation_times(navigation: Navigation) -> Datetimes:
    """Return the reference times of all navigation records and precise orbits, in ascending order."""
    times = [navigation.kepler.toe, navigation.glonass.toe]
    if navigation.precise is not None:
        times.append(navigation.precise.time)
    known = np.concatenate(times)
    return np.sort(known[~np.isnat(known)])


def navigation_span(navigation: Navigation) -> Span | None:
    """Return the first and last of the `navigation_times`, or None if there are no records."""
    times = navigation_times(navigation)
    return (times[0], times[-1]) if len(times) else None


def check_each_file(navigation: Navigation, log: Log) -> None:
    """For a log in several files, raise MismatchError if a file begins more than a day from all navigation records."""
    times = navigation_times(navigation)
    for path, first in log.first_epochs() if len(times) else ():
        if np.abs(times - first).min() > ANOTHER_DAY:
            raise MismatchError(
                f"{path}: begins at {str(first)[:16]} (GPS time), more than a day from all navigation records; add "
                "the navigation file of that day"
            )


def _spans(tally: Tally) -> dict[str, Span]:
    """Return the times of each antenna's first and last epoch."""
    return {n: (a.first, a.last) for n, a in tally.antennas.items() if a.first is not None and a.last is not None}


def spans_apart(one: Span, other: Span, *, reach: np.timedelta64 = _SECOND * 0) -> bool:
    """Return whether two spans have no common time; `one` is extended by `reach` at both ends. False for NaT."""
    return bool(one[0] - reach > other[1] or one[1] + reach < other[0])


def check_same_day(navigation: Navigation, tally: Tally, *, reach: np.timedelta64 = ANOTHER_DAY) -> None:
    """Raise MismatchError if, for lack of navigation records within `reach` of a log, no pseudorange was used."""
    if any(antenna.used for antenna in tally.antennas.values()):
        return
    span = navigation_span(navigation)
    for name, of_log in _spans(tally).items():
        if not tally.antennas[name].unrecorded:
            continue
        if span is None:
            files = ", ".join(navigation.sources) or "the navigation files"
            raise MismatchError(f"{files}: no record of any satellite in the {name} log; give its navigation file")
        if spans_apart(of_log, span, reach=reach):
            raise MismatchError(
                f"{', '.join(navigation.sources)}: navigation records of {_period(*span)} do not cover the {name} "
                f"log of {_period(*of_log)} (GPS time); give the navigation file of that day"
            )


def check_same_place(tally: Tally, *, antennas: Literal["all", "any"] = "any") -> None:
    """Raise MismatchError if all conventional positions are farther than `ANOTHER_PLACE_M` from the line.

    With "all" (during a run), the error is raised if every antenna has at least `ENOUGH_TO_STOP` positions, all far
    from the line. With "any" (after a run), one antenna with positions that are all far from the line suffices.
    """
    enough = ENOUGH_TO_STOP if antennas == "all" else 1
    elsewhere = [
        name
        for name, antenna in tally.antennas.items()
        if antenna.conventional >= enough and antenna.conventional_nearest_m > ANOTHER_PLACE_M
    ]
    if antennas == "any" or len(elsewhere) == len(tally.antennas):
        for name in elsewhere:
            antenna = tally.antennas[name]
            raise MismatchError(
                f"the track lies {antenna.conventional_nearest_m / 1000:.0f} km from where the {name} log was "
                "recorded; give the track of that line, and check the order of latitude and longitude"
            )


def check_same_time(tally: Tally) -> None:
    """Raise MismatchError if the logs of two antennas have no common time."""
    spans = _spans(tally)
    if any(spans_apart(one, other) for one, other in combinations(spans.values(), 2)):
        spans_text = " and ".join(f"the {n} log covers {_period(*span)}" for n, span in spans.items())
        raise MismatchError(f"{spans_text} (GPS time), expected logs of one run; give logs that overlap")


def check_sbas_time(corrections: MessageCorrections | None, tally: Tally) -> None:
    """Raise MismatchError if the SBAS messages and a log have no common time."""
    for name, span in _spans(tally).items():
        if corrections is not None and spans_apart(span, corrections.span):
            raise MismatchError(
                f"the SBAS messages of {_period(*corrections.span)} and the {name} log of {_period(*span)} (GPS time) "
                "have no time in common; give the SBAS messages of the day of the log"
            )


def check_sensor_time(sensors: SensorSamples, tally: Tally) -> tuple[str, ...]:
    """Return a note on each event sensor (`_OF_EVENTS`) whose table and the logs have no time in common.

    Raise MismatchError if the table of a sensor that is not an event sensor and the logs have no time in common, or if
    the table of an event sensor is more than a day from the logs.
    """
    spans, notes = list(_spans(tally).values()), []
    for name, samples in sensors.tables.items():
        if not (spans and len(samples)):
            continue
        of_sensor = samples.time[0], samples.time[-1]
        if not all(spans_apart(span, of_sensor) for span in spans):
            continue
        text = f"the samples of --{name} of {_period(*of_sensor)} and the logs of {_period(*spans[0])} (GPS time) have "
        text += "no time in common"
        reach = ANOTHER_DAY if name in _OF_EVENTS else 0 * ANOTHER_DAY
        if all(spans_apart(span, of_sensor, reach=reach) for span in spans):
            raise MismatchError(f"{text}; give the samples of the day of the logs")
        notes.append(f"{text}; the sensor was not used")
    return tuple(notes)


def check_base(base: BaseLog, tally: Tally, trajectories: Mapping[str, Trajectory]) -> None:
    """Raise MismatchError if a base station is too far from the line, or if its log overlaps no antenna's log."""
    distance = min(np.linalg.norm(own.ecef_m - base.ecef_m, axis=1).min() for own in trajectories.values()) / 1e3
    if distance > LONGEST_KM:
        raise MismatchError(
            f"the base station is {distance:,.0f} km from the line, expected {LONGEST_KM:g} km at most; give its "
            "position (--base-place), or another station"
        )
    first, last = base.span
    spans = list(_spans(tally).values())
    if spans and not any(start - last <= timedelta(np.array(LONGEST_AGE_S)) and first <= end for start, end in spans):
        raise MismatchError(
            f"the log of the base station of {_period(first, last)} and the logs of {_period(*spans[0])} (GPS time) "
            "have no time in common; give a log that overlaps"
        )


def check_whole_run(
    navigation: Navigation,
    tally: Tally,
    *,
    corrections: MessageCorrections | None = None,
    sensors: SensorSamples | None = None,
    causes: Mapping[str, str] | None = None,
) -> tuple[str, ...]:
    """Check the inputs and results of a whole run, and return the notes of `check_sensor_time`.

    `causes` has, for each antenna, the likely cause of missing positions, which the error message states. Raise
    MismatchError if the inputs do not match each other. Raise NoPositionError if the run has no position.
    """
    check_same_time(tally)
    check_same_day(navigation, tally, reach=RECORD_REACH)
    check_same_place(tally)
    check_sbas_time(corrections, tally)
    notes = () if sensors is None else check_sensor_time(sensors, tally)
    check_positions(tally, causes or {})
    return notes


def check_positions(tally: Tally, likely: Mapping[str, str]) -> None:
    """Raise NoPositionError if a run has no position; the message has the most frequent status and rejection reason."""
    if tally.positioned:
        return
    if not tally.epochs:
        raise NoPositionError("no epoch of the logs lies between --start and --end; give other times")
    causes = "; ".join(_why_nothing(name, antenna) for name, antenna in tally.antennas.items() if antenna.epochs)
    causes += "".join(f"; {name}: {cause}" for name, cause in likely.items() if cause)
    raise NoPositionError(f"there is no position: {causes}")


def _why_nothing(name: str, antenna: AntennaTally) -> str:
    status, epochs = antenna.status.most_common(1)[0]
    text = f"{name}: {status} in {epochs} of {antenna.epochs} epochs"
    if antenna.first_reason:
        reason, count = antenna.first_reason.most_common(1)[0]
        text += f", {count} of {antenna.observations} pseudoranges rejected as {reason}"
    return text


def _period(first: np.datetime64, last: np.datetime64) -> str:
    """Return a time span as text, such as ``2021-05-17 02:33 to 03:00``."""
    start, end = (str(t.astype("datetime64[m]")).replace("T", " ") for t in (first, last))
    return f"{start} to {end[11:] if start[:10] == end[:10] else end}"
