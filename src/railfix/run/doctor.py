"""Inspect files before a run: kind, span and place of each, what does not fit together, and the command to run."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, RailfixError
from railfix.core.geodesy import geodetic_from_ecef
from railfix.gnss.observations import Observations
from railfix.io import read_any_positions
from railfix.io.logs import read_navigation, scan_observations
from railfix.pipeline.config import Config
from railfix.run.checks import RECORD_REACH, navigation_span
from railfix.track.read import read_track
from railfix.track.track import ANOTHER_PLACE_M
from railfix.track.vehicle import read_vehicle

Kind = Literal["observations", "navigation", "track", "vehicle", "settings", "positions", "unknown"]
_KINDS: Final[tuple[Kind, ...]] = ("observations", "navigation", "positions", "track", "vehicle", "settings")
_SECOND: Final = np.timedelta64(1, "s")


@dataclass(frozen=True, kw_only=True)
class FileFinding:
    """What one file is: kind, facts in words, span in GPS time and place (ECEF, shape (3,) [m]) where it has them."""

    path: Path
    kind: Kind
    facts: tuple[str, ...]
    span: tuple[np.datetime64, np.datetime64] | None = None
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
    for kind in _KINDS:
        if (path.suffix.lower() == ".toml") != (kind in ("vehicle", "settings")):
            continue
        try:
            return _READERS[kind](path)
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
    log = read_any_positions(path)
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


_READERS: Final = {
    "observations": _observations,
    "navigation": _navigation,
    "track": _track,
    "positions": _positions,
    "vehicle": _vehicle,
    "settings": _settings,
}


def _place_facts(ecef_m: Floats) -> tuple[str, ...]:
    if not np.isfinite(ecef_m).all():
        return ()
    latitude, longitude, height = (float(value) for value in geodetic_from_ecef(ecef_m))
    return (f"near latitude {latitude:.4f}, longitude {longitude:.4f}, height {height:.0f} m",)


def _of(findings: Sequence[FileFinding], kind: Kind) -> list[FileFinding]:
    return [finding for finding in findings if finding.kind == kind]


def _problems(findings: Sequence[FileFinding]) -> list[str]:
    """Return what does not fit together, and what is missing for a run, a sentence each."""
    problems = [f"{finding.path}: is of no kind that railfix reads" for finding in _of(findings, "unknown")]
    logs, navigation, tracks = (_of(findings, kind) for kind in ("observations", "navigation", "track"))
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
        if spans and all(
            log.span[1] < first - RECORD_REACH or log.span[0] > last + RECORD_REACH for first, last in spans
        ):
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
        if max(one[0], two[0]) > min(one[1], two[1]):
            problems.append(f"{logs[0].path} and {logs[1].path}: have no time in common")
    return problems


def _command(findings: Sequence[FileFinding]) -> str:
    """Return the command of a run, blank where a file for it is missing."""
    logs, navigation, tracks = (_of(findings, kind) for kind in ("observations", "navigation", "track"))
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
        words += [word for finding in _of(findings, kind)[:1] for word in (option, str(finding.path))]
    return shlex.join([*words, "--out", "results"])
