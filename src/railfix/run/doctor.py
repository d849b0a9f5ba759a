"""Files examined before a run: what each is, what is inside, what is missing, and the command to run."""

from __future__ import annotations

import codecs
import shlex
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, RailfixError, SettingsError
from railfix.core.files import LENIENT, ending
from railfix.core.geodesy import geodetic_from_ecef
from railfix.gnss.observations import Observations
from railfix.io.logs import read_navigation, scan_observations
from railfix.io.positions import header_line, position_kind, read_positions
from railfix.io.receiver.framing import is_receiver_log, read_head
from railfix.pipeline.config import Config
from railfix.run.checks import RECORD_REACH, Span, navigation_span, spans_apart
from railfix.track.quality import check_track, error_note
from railfix.track.read import read_track
from railfix.track.track import ANOTHER_PLACE_M
from railfix.track.vector_file import ENDINGS as VECTOR_ENDINGS
from railfix.track.vehicle import read_vehicle

_SECOND: Final = np.timedelta64(1, "s")
_MOST_NOTES: Final = 5  #: Notes on one file that are shown.
#: Endings of track maps in other forms than tables.
MAP_ENDINGS: Final = (*VECTOR_ENDINGS, ".geojson", ".json", ".ifc", ".xml", ".landxml", ".railml")

#: Words in the header of a table of positions that one of a track map has not.
_OF_POSITIONS: Final = ("time", "unix", "tow", "quality", "sigma_north", "antenna")

Kind = Literal["observations", "navigation", "track", "vehicle", "settings", "positions", "unknown"]


@dataclass(frozen=True, kw_only=True)
class FileFinding:
    """What one file is: kind, facts in words, span in GPS time and place (ECEF, shape (3,) [m]) where it has them."""

    path: Path
    kind: Kind
    facts: tuple[str, ...]
    span: Span | None = None
    place_ecef_m: Floats | None = None
    ephemerides: Span | None = None  #: Reference times of the ephemerides in the file; None without any.
    options: tuple[str, ...] = ()  #: Options that a command needs to read the file.
    problems: tuple[str, ...] = ()  #: What is wrong with the file alone, a sentence each.


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """Findings on each file, what does not fit together or is missing, and the command to run (blank: none)."""

    findings: tuple[FileFinding, ...]
    problems: tuple[str, ...]
    command: str

    def as_dict(self) -> dict[str, Any]:
        """Return the plain values for JSON."""
        return {
            "files": [
                {
                    "path": str(finding.path),
                    "kind": finding.kind,
                    "first": None if finding.span is None else str(finding.span[0]),
                    "last": None if finding.span is None else str(finding.span[1]),
                    "facts": list(finding.facts),
                    "options": list(finding.options),
                }
                for finding in self.findings
            ],
            "problems": list(self.problems),
            "command": self.command,
        }


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
    """Return what a file is: its content decides the kind, and the reader of that kind says what is wrong with it."""
    kinds = _find_kinds(path)
    errors: list[str] = []
    for kind in kinds:
        try:
            return _READERS[kind](path)
        except RailfixError as error:
            errors.append(str(error))
            if "--date" in str(error):  # the kind is known, the date is not
                return FileFinding(path=path, kind=kind, facts=(), problems=(errors[-1],))
    if len(kinds) == 1:
        return FileFinding(path=path, kind=kinds[0], facts=(), problems=(errors[0],))
    return FileFinding(path=path, kind="unknown", facts=tuple(errors))


def _find_kinds(path: Path) -> list[Kind]:
    """Return the kinds that a file can be of by its first bytes and its ending, the likely one first."""
    if path.suffix.lower() == ".toml":
        return ["vehicle", "settings"]
    if ending(path) in MAP_ENDINGS:
        return ["positions", "track"] if ending(path) == ".gpx" else ["track"]
    head = read_head(path).removeprefix(codecs.BOM_UTF8)
    first = head.decode("latin-1").split("\n")[0]
    if first[60:80].strip() == "RINEX VERSION / TYPE":
        return ["observations" if first[20:21].upper() == "O" else "navigation"]
    if is_receiver_log(head):
        return ["observations", "navigation", "positions"]
    kind = position_kind(path)
    if kind in ("nmea", "novatel", "rtklib"):
        return ["positions"]
    if kind == "csv":
        names = header_line(head).lower()
        return ["positions"] if any(word in names for word in _OF_POSITIONS) else ["track"]
    return [*_READERS]


def _observations(path: Path) -> FileFinding:
    """Read a log piece by piece: the facts of the whole, in the memory of a piece."""
    first: Observations | None = None
    epochs, longest_s, steps = 0, 0.0, []
    satellites: set[str] = set()
    signals: set[str] = set()
    end = np.datetime64("NaT", "ns")
    broken, notes = Counter[str](), list[str]()
    for piece in scan_observations(path, broken_lines="count"):
        broken.update({what: n for what, n in piece.skipped.items() if what.startswith(("broken", "epochs out of"))})
        notes += piece.problems
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
    header = first.header
    words = [word for word in (header.receiver, header.antenna) if word]
    facts += [f"receiver and antenna: {', '.join(words)}"] if words else []
    facts += [f"note: {note.removeprefix(f'{path}, ')}" for note in notes[:_MOST_NOTES]]
    place = header.approximate_ecef_m
    own = _own_ephemerides(path)
    if own is not None:
        facts.append(f"{own[0]:,} ephemerides inside")
    return FileFinding(
        path=path,
        kind="observations",
        facts=(*facts, *_place_facts(place)),
        span=(first.time[0], end),
        place_ecef_m=place if np.isfinite(place).all() else None,
        ephemerides=None if own is None else own[1],
        options=("--lenient",) if broken and _needs_lenient(path) else (),
    )


def _needs_lenient(path: Path) -> bool:
    """Return whether a reader of the default policy stops at a line of the file."""
    try:
        for _ in scan_observations(path):
            pass
    except InputFileError:
        return True
    return False


def _own_ephemerides(path: Path) -> tuple[int, Span] | None:
    """Return the number and the reference times of the ephemerides in a receiver's log; None without any."""
    if not is_receiver_log(read_head(path)):
        return None
    try:
        navigation = read_navigation([path])
    except InputFileError:  # it has none: observations alone are no fault of a log
        return None
    span = navigation_span(navigation)
    return None if span is None else (len(navigation.kepler) + len(navigation.glonass), span)


def _navigation(path: Path) -> FileFinding:
    navigation = read_navigation([path], broken_lines="count")
    span = navigation_span(navigation)
    if span is None:
        raise InputFileError(path, "has no ephemeris")
    records = len(navigation.kepler) + len(navigation.glonass)
    names = np.concatenate([navigation.kepler.satellite, navigation.glonass.satellite]).astype("<U1")
    of = ", ".join(f"{letter} {int((names == letter).sum())}" for letter in np.unique(names).tolist())
    notes = [f"note: {note}" for note in navigation.notes[:_MOST_NOTES]]
    return FileFinding(
        path=path, kind="navigation", facts=(f"{records:,} ephemerides: {of}", *notes), span=span, ephemerides=span,
        options=("--lenient",) if navigation.skipped.get("broken") else (),
    )  # fmt: skip


def _track(path: Path) -> FileFinding:
    options: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    try:
        track = read_track([path])
    except (InputFileError, SettingsError) as error:
        if "--height-datum" not in str(error) and "height datum" not in str(error):
            raise
        track = read_track([path], height_datum="ellipsoidal")
        options = ("--height-datum", "ellipsoidal")
        problems = (
            f"{path}: does not say above what its heights are; give --height-datum ellipsoidal, as in the command, "
            "or orthometric with --geoid",
        )
    problems += tuple(f"{path}: {note}" for note in error_note(check_track(track)))
    length = float(track.chainage_m[-1] - track.chainage_m[0])
    low, high = float(np.min(track.height_m)), float(np.max(track.height_m))
    facts = (
        f"{len(track.height_m):,} points, {length:,.0f} m",
        f"ellipsoidal heights from {low:.1f} to {high:.1f} m, given as {track.provenance.height_datum_used}",
        f"frame {track.provenance.frame}",
    )
    place = track.ecef_m[len(track.ecef_m) // 2]
    return FileFinding(
        path=path, kind="track", facts=(*facts, *_place_facts(place)), place_ecef_m=place, options=options,
        problems=problems,
    )  # fmt: skip


def _positions(path: Path) -> FileFinding:
    options: tuple[str, ...] = ()
    try:
        log = read_positions(path, heights="optional", antennas="several")
    except InputFileError as error:
        if LENIENT not in str(error):
            raise
        log = read_positions(path, broken_lines="count", heights="optional", antennas="several")
        options = ("--lenient",)
    known = log.time[~np.isnat(log.time)]
    span = (known.min(), known.max()) if len(known) else None
    place = np.nanmedian(log.ecef_m, axis=0)
    of = f" of {' and '.join(log.antennas)}" if log.antennas else ""
    of += "" if len(known) else " without time"
    facts = (f"{len(log.time):,} positions{of}", *_place_facts(place), *(f"note: {n}" for n in log.notes[:_MOST_NOTES]))
    return FileFinding(path=path, kind="positions", facts=facts, span=span, place_ecef_m=place, options=options)


def _vehicle(path: Path) -> FileFinding:
    vehicle = read_vehicle(path)
    return FileFinding(path=path, kind="vehicle", facts=(f"antennas: {', '.join(vehicle.antennas)}",))


def _settings(path: Path) -> FileFinding:
    from railfix.pipeline.config import load_config

    config, default = load_config(path).as_dict(), Config().as_dict()
    changed = [name for name, value in config.items() if value != default[name]]
    return FileFinding(path=path, kind="settings", facts=(f"changed: {', '.join(changed) or 'nothing'}",))


#: What reads each kind of file, in the order in which a file is tried.
_READERS: Final[dict[Kind, Callable[[Path], FileFinding]]] = {
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
    problems = [problem for finding in findings for problem in finding.problems]
    problems += [
        f"{finding.path}: not recognised: {finding.facts[0] if finding.facts else 'no reader takes it'}"
        for finding in _filter(findings, "unknown")
    ]
    logs, tracks = (_filter(findings, kind) for kind in ("observations", "track"))
    readable = [log for log in logs if log.span is not None]
    navigation = [finding for finding in findings if finding.ephemerides is not None or finding.kind == "navigation"]
    if not logs:
        problems.append("there is no log of observations: give a RINEX observation file or a receiver's log")
    if not navigation and logs:
        problems.append("there is no navigation file: give the broadcast ephemerides of the day")
    if not tracks and logs:
        problems.append("there is no track map: railfix map survey makes one of runs over the line")
    if len(logs) > 2:
        problems.append("there are more than two logs: give the files of one run")
    for log in readable:
        assert log.span is not None
        spans = [finding.ephemerides for finding in navigation if finding.ephemerides is not None]
        if spans and all(spans_apart(log.span, span, reach=RECORD_REACH) for span in spans):
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
    if len(readable) == 2:
        one, two = (log.span for log in readable)
        assert one is not None
        assert two is not None
        if spans_apart(one, two):
            problems.append(f"{logs[0].path} and {logs[1].path}: have no time in common")
    return problems


def _command(findings: Sequence[FileFinding]) -> str:
    """Return the command of a run, blank where a file for it is missing."""
    logs, tracks = (_filter(findings, kind) for kind in ("observations", "track"))
    logs = [log for log in logs if log.span is not None]
    tracks = [track for track in tracks if track.place_ecef_m is not None]
    navigation = [finding for finding in findings if finding.ephemerides is not None]
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
    words += list(dict.fromkeys(word for finding in findings for word in finding.options))
    return shlex.join([*words, "--out", "results"])
