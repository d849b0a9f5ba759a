"""Checks that inputs match each other, and that a run has positions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal

import numpy as np

from railfix.core.errors import MismatchError, NoPositionError
from railfix.gnss.navigation import Navigation
from railfix.motion.samples import SensorSamples
from railfix.ranges.sbas import DfmcService, SbasCorrections
from railfix.run.tally import AntennaTally, Tally
from railfix.track.track import ANOTHER_PLACE_M

#: Conventional positions that must all be so far before a run is stopped early.
ENOUGH_TO_STOP: Final = 10
#: Navigation records further from the log than this are of another day.
ANOTHER_DAY: Final = np.timedelta64(24, "h")
#: Records reach about this far beyond their reference time (Galileo, IODnav of 4 h and its margin).
RECORD_REACH: Final = np.timedelta64(4, "h")


def navigation_span(navigation: Navigation) -> tuple[np.datetime64, np.datetime64] | None:
    """Reference times of the first and the last record; None where there is none."""
    times = [navigation.kepler.toe, navigation.glonass.toe]
    if navigation.precise is not None:
        times.append(navigation.precise.time)
    known = np.concatenate(times)
    known = known[~np.isnat(known)]
    return (known.min(), known.max()) if len(known) else None


def check_same_day(navigation: Navigation, tally: Tally, *, reach: np.timedelta64 = ANOTHER_DAY) -> None:
    """Raise MismatchError where no pseudorange was used and the log lies further than `reach` from every record."""
    if any(antenna.used for antenna in tally.antennas.values()):
        return
    span = navigation_span(navigation)
    for name, antenna in tally.antennas.items():
        if antenna.first is None or antenna.last is None or not antenna.unrecorded:
            continue
        if span is None:
            files = ", ".join(navigation.sources) or "the navigation files"
            raise MismatchError(f"{files}: no record of any satellite of the {name} log; give its navigation file")
        if antenna.first - reach > span[1] or antenna.last + reach < span[0]:
            raise MismatchError(
                f"{', '.join(navigation.sources)}: navigation records of {_period(*span)} do not reach the {name} "
                f"log of {_period(antenna.first, antenna.last)} (GPS time); give the navigation file of that day"
            )


def check_same_place(tally: Tally, *, antennas: Literal["all", "any"] = "any") -> None:
    """Raise MismatchError where all conventional positions lie further than `ANOTHER_PLACE_M` from the line.

    `antennas`: whether every antenna must be elsewhere (during a run, after a few positions of each), or one is enough
    (at the end).
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
    """Raise MismatchError where the logs of two antennas have no time in common."""
    spans = {n: (a.first, a.last) for n, a in tally.antennas.items() if a.first is not None and a.last is not None}
    if len(spans) < 2:
        return
    latest_start = max(first for first, _ in spans.values())
    earliest_end = min(last for _, last in spans.values())
    if latest_start > earliest_end:
        spans_text = " and ".join(f"the {n} log covers {_period(*span)}" for n, span in spans.items())
        raise MismatchError(f"{spans_text} (GPS time), expected logs of one run; give logs that overlap")


def check_sbas_time(sbas: SbasCorrections | DfmcService | None, tally: Tally) -> None:
    """Raise MismatchError where not one message of the SBAS was received during a log."""
    for name, antenna in tally.antennas.items():
        if sbas is None or antenna.first is None or antenna.last is None:
            continue
        first, last = sbas.span
        if antenna.first > last or antenna.last < first:
            raise MismatchError(
                f"the SBAS messages of {_period(first, last)} and the {name} log of "
                f"{_period(antenna.first, antenna.last)} (GPS time) have no time in common; give those of that day"
            )


def check_sensor_time(sensors: SensorSamples, tally: Tally) -> None:
    """Raise MismatchError where a sensor has not one sample during the logs."""
    spans = [(a.first, a.last) for a in tally.antennas.values() if a.first is not None and a.last is not None]
    for name, samples in sensors.tables.items():
        time = samples.time
        if len(time) and spans and not any(first <= time[-1] and time[0] <= last for first, last in spans):
            raise MismatchError(
                f"the samples of --{name} of {_period(time[0], time[-1])} and the logs of "
                f"{_period(*spans[0])} (GPS time) have no time in common; give those of that day"
            )


def check_whole_run(
    navigation: Navigation,
    tally: Tally,
    *,
    sbas: SbasCorrections | DfmcService | None = None,
    sensors: SensorSamples | None = None,
    causes: Mapping[str, str] | None = None,
) -> None:
    """Raise MismatchError where the inputs of a whole run do not match, NoPositionError where it has no position.

    `causes`: likely causes by antenna, which the error names.
    """
    check_same_time(tally)
    check_same_day(navigation, tally, reach=RECORD_REACH)
    check_same_place(tally)
    check_sbas_time(sbas, tally)
    if sensors is not None:
        check_sensor_time(sensors, tally)
    check_positions(tally, causes or {})


def check_positions(tally: Tally, likely: Mapping[str, str]) -> None:
    """Raise NoPositionError, with the commonest status and reason, where a run has not one position."""
    if tally.positioned:
        return
    if not tally.epochs:
        raise NoPositionError("no epoch between --start and --end; the logs have none there")
    causes = "; ".join(_why_nothing(name, antenna) for name, antenna in tally.antennas.items() if antenna.epochs)
    causes += "".join(f"; {name}: {cause}" for name, cause in likely.items() if cause)
    raise NoPositionError(f"not one position: {causes}")


def _why_nothing(name: str, antenna: AntennaTally) -> str:
    status, epochs = antenna.status.most_common(1)[0]
    text = f"{name}: {status} in {epochs} of {antenna.epochs} epochs"
    if antenna.first_reason:
        reason, count = antenna.first_reason.most_common(1)[0]
        text += f", {count} of {antenna.observations} pseudoranges rejected as {reason}"
    return text


def _period(first: np.datetime64, last: np.datetime64) -> str:
    """``2021-05-17 02:33 to 03:00``."""
    start, end = (str(t.astype("datetime64[m]")).replace("T", " ") for t in (first, last))
    return f"{start} to {end[11:] if start[:10] == end[:10] else end}"
