"""Checks that inputs match each other and that a run has positions; files inspected before a run."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Final, Literal

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, MismatchError, NoPositionError, RailfixError
from railfix.core.geodesy import geodetic_from_ecef
from railfix.core.timescale import timedelta
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.io import read_positions
from railfix.io.logs import read_navigation, scan_observations
from railfix.motion.samples import SensorSamples
from railfix.pipeline.config import Config
from railfix.ranges.base_station import LONGEST_AGE_S, LONGEST_KM
from railfix.ranges.sbas import DfmcService, SbasCorrections
from railfix.run.processor import BaseLog
from railfix.run.tally import AntennaTally, Tally
from railfix.track.read import read_track
from railfix.track.track import ANOTHER_PLACE_M
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import read_vehicle

_SECOND: Final = np.timedelta64(1, "s")
#: Conventional positions that must all be so far before a run is stopped early.
ENOUGH_TO_STOP: Final = 10
#: Navigation records further from the log than this are of another day.
ANOTHER_DAY: Final = np.timedelta64(24, "h")
#: Records reach about this far beyond their reference time (Galileo, IODnav of 4 h and its margin).
RECORD_REACH: Final = np.timedelta64(4, "h")


#: First and last time of something.
Span = tuple[np.datetime64, np.datetime64]


def navigation_span(navigation: Navigation) -> Span | None:
    """Return the reference times of the first and the last record; None where there is none."""
    times = [navigation.kepler.toe, navigation.glonass.toe]
    if navigation.precise is not None:
        times.append(navigation.precise.time)
    known = np.concatenate(times)
    known = known[~np.isnat(known)]
    return (known.min(), known.max()) if len(known) else None


def _spans(tally: Tally) -> dict[str, Span]:
    """Return the first and last epoch of the log of each antenna."""
    return {n: (a.first, a.last) for n, a in tally.antennas.items() if a.first is not None and a.last is not None}


def _apart(one: Span, other: Span, *, reach: np.timedelta64 = _SECOND * 0) -> bool:
    """Return whether two spans have no time in common, each reaching further at both ends; False for NaT."""
    return bool(one[0] - reach > other[1] or one[1] + reach < other[0])


def check_same_day(navigation: Navigation, tally: Tally, *, reach: np.timedelta64 = ANOTHER_DAY) -> None:
    """Raise MismatchError where no pseudorange was used and the log lies further than `reach` from every record."""
    if any(antenna.used for antenna in tally.antennas.values()):
        return
    span = navigation_span(navigation)
    for name, of_log in _spans(tally).items():
        if not tally.antennas[name].unrecorded:
            continue
        if span is None:
            files = ", ".join(navigation.sources) or "the navigation files"
            raise MismatchError(f"{files}: no record of any satellite of the {name} log; give its navigation file")
        if _apart(of_log, span, reach=reach):
            raise MismatchError(
                f"{', '.join(navigation.sources)}: navigation records of {_period(*span)} do not reach the {name} "
                f"log of {_period(*of_log)} (GPS time); give the navigation file of that day"
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
    spans = _spans(tally)
    if any(_apart(one, other) for one, other in combinations(spans.values(), 2)):
        spans_text = " and ".join(f"the {n} log covers {_period(*span)}" for n, span in spans.items())
        raise MismatchError(f"{spans_text} (GPS time), expected logs of one run; give logs that overlap")


def check_sbas_time(sbas: SbasCorrections | DfmcService | None, tally: Tally) -> None:
    """Raise MismatchError where not one message of the SBAS was received during a log."""
    for name, span in _spans(tally).items():
        if sbas is not None and _apart(span, sbas.span):
            raise MismatchError(
                f"the SBAS messages of {_period(*sbas.span)} and the {name} log of {_period(*span)} (GPS time) have no "
                "time in common; give those of that day"
            )


def check_sensor_time(sensors: SensorSamples, tally: Tally) -> None:
    """Raise MismatchError where a sensor has not one sample during the logs."""
    spans = list(_spans(tally).values())
    for name, samples in sensors.tables.items():
        if not (spans and len(samples)):
            continue
        of_sensor = samples.time[0], samples.time[-1]
        if all(_apart(span, of_sensor) for span in spans):
            raise MismatchError(
                f"the samples of --{name} of {_period(*of_sensor)} and the logs of {_period(*spans[0])} (GPS time) "
                "have no time in common; give those of that day"
            )


def check_base(base: BaseLog, tally: Tally, trajectories: Mapping[str, Trajectory]) -> None:
    """Raise MismatchError where a base station is too far from the line, or has no epoch in time for a log."""
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
            "have no time in common; give one that overlaps"
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


Kind = Literal["observations", "navigation", "track", "vehicle", "settings", "positions", "unknown"]


@dataclass(frozen=True, kw_only=True)
class FileFinding:
    """What one file is: kind, facts in words, span in GPS time and place (ECEF, shape (3,) [m]) where it has them."""

    path: Path
    kind: Kind
    facts: tuple[str, ...]
    span: Span | None = None
    place_ecef_m: Floats | None = None


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """Findings on each file, what does not fit together or is missing, and the command to run (blank: none)."""

    findings: tuple[FileFinding, ...]
    problems: tuple[str, ...]
    command: str


def examine_files(paths: Sequence[Path]) -> Diagnosis:
    """Read each file as every kind until one fits, and compare them with each other; InputFileError where one is
    missing.
    """
    for path in paths:
        if path.is_dir():
            raise InputFileError(path, "is a folder; name the files in it")
        if not path.is_file():
            raise InputFileError(path, "there is no such file; check the name")
        if sum(path.samefile(other) for other in paths if other.exists()) > 1:
            raise InputFileError(path, "is given twice; name each file once")
    findings = tuple(_examine(path) for path in paths)
    problems = tuple(_problems(findings))
    return Diagnosis(findings=findings, problems=problems, command=_command(findings))


def _examine(path: Path) -> FileFinding:
    """Return what a file is; one that is of no kind has the error of each in its facts."""
    errors: list[str] = []
    for kind, read in _READERS.items():
        if (path.suffix.lower() == ".toml") != (kind in ("vehicle", "settings")):
            continue
        try:
            return read(path)
        except RailfixError as error:
            errors.append(f"no {kind}: {error}")
    return FileFinding(path=path, kind="unknown", facts=tuple(errors))


def _observations(path: Path) -> FileFinding:
    """Read a log piece by piece: the facts of the whole, in the memory of a piece."""
    first: Observations | None = None
    epochs, longest_s, steps = 0, 0.0, []
    satellites: set[str] = set()
    signals: set[str] = set()
    end = np.datetime64("NaT", "ns")
    for piece in scan_observations(path):
        if not len(piece):
            continue
        first = piece if first is None else first
        time = piece.time if np.isnat(end) else np.concatenate([[end], piece.time])
        between = np.diff(time) / _SECOND
        steps.append(float(np.median(between)) if len(between) else np.nan)
        longest_s = max(longest_s, float(between.max(initial=0.0)))
        epochs, end = epochs + len(piece), piece.time[-1]
        satellites |= set(piece.satellite.tolist())
        signals |= {f"{name[0]} {code}" for name, code in zip(piece.satellite, piece.signal, strict=True)}
    if first is None:
        raise InputFileError(path, "has no epoch of observations")
    step = float(np.nanmedian(steps)) if np.isfinite(steps).any() else np.nan
    systems = {letter: sum(name[0] == letter for name in satellites) for letter in sorted({s[0] for s in satellites})}
    facts = [
        f"{epochs:,} epochs, one every {step:g} s, the longest gap {longest_s:g} s",
        "satellites: " + ", ".join(f"{letter} {count}" for letter, count in systems.items()),
        f"signals: {', '.join(sorted(signals))}",
    ]
    place = first.header.approximate_ecef_m
    return FileFinding(
        path=path,
        kind="observations",
        facts=(*facts, *_place_facts(place)),
        span=(first.time[0], end),
        place_ecef_m=place if np.isfinite(place).all() else None,
    )


def _navigation(path: Path) -> FileFinding:
    navigation = read_navigation([path])
    span = navigation_span(navigation)
    if span is None:
        raise InputFileError(path, "has no ephemeris")
    records = len(navigation.kepler) + len(navigation.glonass)
    return FileFinding(path=path, kind="navigation", facts=(f"{records:,} ephemerides",), span=span)


def _track(path: Path) -> FileFinding:
    track = read_track([path])
    length = float(track.chainage_m[-1] - track.chainage_m[0])
    low, high = float(np.min(track.height_m)), float(np.max(track.height_m))
    facts = (
        f"{len(track.height_m):,} points, {length:,.0f} m",
        f"ellipsoidal heights from {low:.1f} to {high:.1f} m, given as {track.provenance.height_datum_used}",
        f"frame {track.provenance.frame}",
    )
    place = track.ecef_m[len(track.ecef_m) // 2]
    return FileFinding(path=path, kind="track", facts=(*facts, *_place_facts(place)), place_ecef_m=place)


def _positions(path: Path) -> FileFinding:
    log = read_positions(path)
    known = log.time[~np.isnat(log.time)]
    if not len(known):
        raise InputFileError(path, "its positions have no time")
    span = (known.min(), known.max())
    place = np.nanmedian(log.ecef_m, axis=0)
    facts = (f"{len(log.time):,} positions", *_place_facts(place))
    return FileFinding(path=path, kind="positions", facts=facts, span=span, place_ecef_m=place)


def _vehicle(path: Path) -> FileFinding:
    vehicle = read_vehicle(path)
    return FileFinding(path=path, kind="vehicle", facts=(f"antennas: {', '.join(vehicle.antennas)}",))


def _settings(path: Path) -> FileFinding:
    from railfix.pipeline.config import load_config

    config, default = load_config(path).as_dict(), Config().as_dict()
    changed = [name for name, value in config.items() if value != default[name]]
    return FileFinding(path=path, kind="settings", facts=(f"changed: {', '.join(changed) or 'nothing'}",))


#: What reads each kind of file, in the order in which a file is tried.
_READERS: Final = {
    "observations": _observations,
    "navigation": _navigation,
    "positions": _positions,
    "track": _track,
    "vehicle": _vehicle,
    "settings": _settings,
}


def _place_facts(ecef_m: Floats) -> tuple[str, ...]:
    if not np.isfinite(ecef_m).all():
        return ()
    latitude, longitude, height = (float(value) for value in geodetic_from_ecef(ecef_m))
    return (f"near latitude {latitude:.4f}, longitude {longitude:.4f}, height {height:.0f} m",)


def _filter(findings: Sequence[FileFinding], kind: Kind) -> list[FileFinding]:
    return [finding for finding in findings if finding.kind == kind]


def _problems(findings: Sequence[FileFinding]) -> list[str]:
    """Return what does not fit together, and what is missing for a run, a sentence each."""
    problems = [f"{finding.path}: is of no kind that railfix reads" for finding in _filter(findings, "unknown")]
    logs, navigation, tracks = (_filter(findings, kind) for kind in ("observations", "navigation", "track"))
    if not logs:
        problems.append("there is no log of observations: give a RINEX observation file or a receiver's log")
    if not navigation and logs:
        problems.append("there is no navigation file: give the broadcast ephemerides of the day")
    if not tracks and logs:
        problems.append("there is no track map: railfix map survey makes one of runs over the line")
    if len(logs) > 2:
        problems.append("there are more than two logs: give the files of one run")
    for log in logs:
        assert log.span is not None
        spans = [finding.span for finding in navigation if finding.span is not None]
        if spans and all(_apart(log.span, span, reach=RECORD_REACH) for span in spans):
            problems.append(
                f"{log.path}: no ephemeris reaches its time; give the navigation file of {str(log.span[0])[:10]}"
            )
        for other in tracks:
            if log.place_ecef_m is not None and other.place_ecef_m is not None:
                apart = float(np.linalg.norm(log.place_ecef_m - other.place_ecef_m))
                if apart > ANOTHER_PLACE_M:
                    problems.append(
                        f"{other.path}: lies {apart / 1000:,.0f} km from the place in the header of {log.path}"
                    )
    if len(logs) == 2:
        one, two = (log.span for log in logs)
        assert one is not None
        assert two is not None
        if _apart(one, two):
            problems.append(f"{logs[0].path} and {logs[1].path}: have no time in common")
    return problems


def _command(findings: Sequence[FileFinding]) -> str:
    """Return the command of a run, blank where a file for it is missing."""
    logs, navigation, tracks = (_filter(findings, kind) for kind in ("observations", "navigation", "track"))
    if not (logs and navigation and tracks) or len(logs) > 2:
        return ""
    logs = sorted(logs, key=lambda log: "rear" in log.path.name.lower())
    words = ["railfix", "run"]
    for option, log in zip(("--front", "--rear"), logs, strict=False):
        words += [option, str(log.path)]
    words += [word for finding in navigation for word in ("--nav", str(finding.path))]
    words += [word for finding in tracks for word in ("--track", str(finding.path))]
    options: dict[Kind, str] = {"vehicle": "--vehicle", "settings": "--config"}
    for kind, option in options.items():
        words += [word for finding in _filter(findings, kind)[:1] for word in (option, str(finding.path))]
    return shlex.join([*words, "--out", "results"])
