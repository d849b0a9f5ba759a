"""Examination of files before a run: kind and content of each file, missing files, and the `railfix run` command."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, RailfixError, SettingsError
from railfix.core.files import LENIENT
from railfix.core.geodesy import ecef_from_geodetic, geodetic_from_ecef
from railfix.gnss.observations import ObservationHeader
from railfix.io.file_kind import KIND_WORDS, MAPS, POSITIONS, FileKind, find_kind, has_times, read_column_names
from railfix.io.logs import read_navigation, scan_observations
from railfix.io.mate import mate_table
from railfix.io.positions import read_positions
from railfix.io.sp3 import read_sp3
from railfix.pipeline.config import Config
from railfix.ranges.sbas.files import read_sbas
from railfix.run.checks import RECORD_REACH, Span, navigation_span, spans_apart
from railfix.run.doctor_models import MODEL_KINDS, ModelKind, find_model_kind, model_options, read_model_facts
from railfix.run.doctor_tables import PAIRS, TABLE_KINDS, TableKind, find_table_kind, read_table_facts, sensor_options
from railfix.track.network_read import connect_network, is_route
from railfix.track.quality import check_track, error_note
from railfix.track.read import read_segments
from railfix.track.route import NO_HEIGHTS, MapReading, check_order, join
from railfix.track.track import ANOTHER_PLACE_M
from railfix.track.vehicle import read_vehicle

_SECOND: Final = np.timedelta64(1, "s")
_MOST_NOTES: Final = 5  #: Maximum number of notes shown for one file.
Kind = (
    Literal["observations", "navigation", "orbits", "sbas", "track", "vehicle", "settings", "positions", "unknown"]
    | TableKind
    | ModelKind
)


@dataclass(frozen=True, kw_only=True)
class FileFinding:
    """Kind, content, time span and problems of one file."""

    path: Path
    kind: Kind
    facts: tuple[str, ...]  #: Short descriptions of the content, shown to the user.
    span: Span | None = None  #: First and last time of the content, GPS time; None if unknown.
    place_ecef_m: Floats | None = None  #: A position on the track or run, ECEF, shape (3,) [m]; None if unknown.
    #: First and last reference time of the ephemerides in the file, or None if the file has no ephemerides.
    ephemerides: Span | None = None
    options: tuple[str, ...] = ()  #: Command-line options that are needed to read the file.
    problems: tuple[str, ...] = ()  #: Sentences on faults of the file itself.


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """Result of the examination of files."""

    findings: tuple[FileFinding, ...]
    problems: tuple[str, ...]  #: Sentences on faults, mismatches and missing files.
    command: str  #: Command that positions the logs, or "" if a required file is missing.

    def as_dict(self) -> dict[str, Any]:
        """Return the diagnosis as plain values for JSON."""
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


def examine_files(paths: Sequence[Path], *, date: np.datetime64 | None = None) -> Diagnosis:
    """Examine each file, and compare the files with each other.

    `date` is a time within half a week of the logs; it is required for logs that do not state the week. Raise
    InputFileError if a path does not exist, is a folder, or occurs twice.
    """
    for path in paths:
        if path.is_dir():
            raise InputFileError(path, "is a folder; give the files in it")
        if not path.is_file():
            raise InputFileError(path, "there is no such file; check the name")
        if sum(path.samefile(other) for other in paths if other.exists()) > 1:
            raise InputFileError(path, "is given twice; give each file once")
    findings = tuple(_examine(path, date) for path in paths)
    problems = tuple(_problems(findings))
    return Diagnosis(findings=findings, problems=problems, command=_command(findings, date))


def _examine(path: Path, date: np.datetime64 | None) -> FileFinding:
    """Return the properties of a file.

    The readers of all kinds that the content suggests are tried until one accepts the file. If no reader accepts the
    file, the first error is returned as the file's problem.
    """
    errors, kinds = list[str](), _find_kinds(path)
    for kind in kinds:
        try:
            return _DATED[kind](path, date) if kind in _DATED else _READERS[kind](path)
        except RailfixError as error:
            errors.append(str(error))
            if "--date" in str(error):  # the kind is right, but its reader requires the date
                return FileFinding(path=path, kind=kind, facts=(), problems=(errors[-1],))
    kind = "unknown" if len(kinds) > 1 else kinds[0]
    return FileFinding(path=path, kind=kind, facts=(), problems=(errors[0],))


def _find_kinds(path: Path) -> tuple[Kind, ...]:
    """Return the possible kinds of a file, the most likely first."""
    kind = find_kind(path)
    if kind in ("table", "parquet", "mate") and (table := find_table_kind(path)) is not None:
        return ("unknown",) if table == "other" else (table,)
    if kind in ("table", "gpx"):
        without: tuple[Kind, ...] = ("track",) if kind == "table" else ("positions", "track")
        return ("positions",) if has_times(path) else without
    if kind == "mate":
        return ("observations",) if mate_table(path) == "S_GNSS_SAT" else ("track",)
    if kind == "toml" and (model := find_model_kind(path)) is not None:
        return (model,)
    return _KINDS.get(kind, ("unknown",))


#: Columns of track maps and position logs, for messages.
_PLACES: Final = "track maps have latitude_deg, longitude_deg; position logs have times and these two or x_m, y_m, z_m"


def _unknown(path: Path) -> FileFinding:
    if (kind := find_kind(path)) == "table":
        columns = ", ".join(read_column_names(path)[:_MOST_NOTES])
        raise InputFileError(
            path, f"not recognised: no command reads a table with its columns ({columns}, ...); {_PLACES}"
        )
    raise InputFileError(path, f"not recognised: it is {KIND_WORDS[kind]}, and no command reads it")


def _observations(path: Path, date: np.datetime64 | None) -> FileFinding:
    """Return the properties of an observation log. The log is read in pieces to save memory."""
    header: ObservationHeader | None = None
    times, channels = [np.empty(0, dtype="datetime64[ns]")], set[tuple[str, str]]()
    broken, notes = Counter[str](), list[str]()
    for piece in scan_observations(path, broken_lines="count", date=date):
        broken.update({what: n for what, n in piece.skipped.items() if what.startswith(("broken", "epochs out of"))})
        notes += piece.problems
        header = piece.header if header is None and len(piece) else header
        times.append(piece.time)
        channels |= {*zip(piece.satellite.tolist(), piece.signal.tolist(), strict=True)}
    if header is None:
        raise InputFileError(path, "has no epoch with observations")
    time = np.concatenate(times)
    between = np.diff(time) / _SECOND if len(time) > 1 else np.array([np.nan])
    systems = Counter(satellite[0] for satellite in {satellite for satellite, _ in channels})
    signals = sorted({f"{satellite[0]} {signal}" for satellite, signal in channels})
    facts = [
        f"{len(time):,} epochs, one every {np.median(between):g} s, the longest gap {between.max():g} s",
        "satellites: " + ", ".join(f"{letter} {count}" for letter, count in sorted(systems.items())),
        f"signals: {', '.join(signals)}",
    ]
    words = [word for word in (header.receiver, header.antenna) if word]
    facts += [f"receiver and antenna: {', '.join(words)}"] if words else []
    facts += [f"note: {note.removeprefix(f'{path}, ')}" for note in notes[:_MOST_NOTES]]
    place = header.approximate_ecef_m
    own = _own_ephemerides(path, date)
    if own is not None:
        facts.append(f"{own[0]:,} ephemerides in the log")
    return FileFinding(
        path=path,
        kind="observations",
        facts=(*facts, *_place_facts(place)),
        span=(time[0], time[-1]),
        place_ecef_m=place if np.isfinite(place).all() else None,
        ephemerides=None if own is None else own[1],
        options=("--lenient",) if broken and _needs_lenient(path, date) else (),
    )


def _needs_lenient(path: Path, date: np.datetime64 | None) -> bool:
    """Return whether the file can be read only with the option --lenient."""
    try:
        for _ in scan_observations(path, date=date):
            pass
    except InputFileError:
        return True
    return False


def _own_ephemerides(path: Path, date: np.datetime64 | None) -> tuple[int, Span] | None:
    """Return the number of ephemerides in a receiver log, and the span of their times; None without ephemerides."""
    if find_kind(path) != "receiver":
        return None
    try:
        navigation = read_navigation([path], date=date)
    except InputFileError:  # a log without navigation records is no fault
        return None
    span = navigation_span(navigation)
    return None if span is None else (len(navigation.kepler) + len(navigation.glonass), span)


def _navigation(path: Path, date: np.datetime64 | None) -> FileFinding:
    navigation = read_navigation([path], broken_lines="count", date=date)
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
    """Return the properties of a track map. The map may be a route or a network, and may lack heights."""
    options, problems, datum = tuple[str, ...](), tuple[str, ...](), ""
    try:
        segments = read_segments(path, MapReading())
    except (InputFileError, SettingsError) as error:
        if "--height-datum" not in str(error) and "height datum" not in str(error):
            raise
        # In KML, absolute altitudes are above the EGM96 geoid (OGC KML 2.3, 13.9).
        kml = path.suffix.lower() in (".kml", ".kmz")
        datum = "orthometric" if kml else "ellipsoidal"
        segments = read_segments(path, MapReading(height_datum="ellipsoidal"))  # the checks do not need a geoid
        options = ("--height-datum", datum, *(("--geoid", "egm96") if kml else ()))
        problems = (
            f"{path}: does not state its height datum; the command takes the heights as {datum}"
            f"{', as KML defines them' if kml else ''}; to change this, give --height-datum and --geoid",
        )
    facts = []
    if any(segment.height_datum == NO_HEIGHTS for segment in segments):
        options = (*options, "--heights", "log")
        facts.append("without heights: the heights of the log's own positions are used (--heights log)")
        segments = [replace(segment, height_m=np.zeros(len(segment.height_m))) for segment in segments]
    else:
        heights = np.concatenate([segment.height_m for segment in segments])
        datum = datum or ", ".join(dict.fromkeys(segment.height_datum for segment in segments))
        facts.append(f"{datum} heights from {heights.min():.1f} to {heights.max():.1f} m")
    try:
        check_order(segments)
    except InputFileError as error:
        problems += (str(error),)
    if is_route(segments):
        track = join(segments)
        points, length = len(track), float(track.chainage_m[-1] - track.chainage_m[0])
        problems += tuple(f"{path}: {note}" for note in error_note(check_track(track)))
    else:
        network = connect_network(segments, [path])
        points, length = sum(len(part.height_m) for part in segments), float(network.length_m.sum())
        facts.append(f"a network of {len(network.tracks)} tracks, in which a run finds the route")
    middle = segments[len(segments) // 2]
    row = len(middle.height_m) // 2
    place = ecef_from_geodetic(middle.latitude_deg[row], middle.longitude_deg[row], middle.height_m[row])
    facts = [f"{points:,} points, {length:,.0f} m", *facts, f"frame {middle.frame}"]
    notes = [f"note: {note}" for note in dict.fromkeys(note for part in segments for note in part.notes)]
    return FileFinding(
        path=path, kind="track", facts=(*facts, *_place_facts(place), *notes[:_MOST_NOTES]), place_ecef_m=place,
        options=options, problems=problems,
    )  # fmt: skip


def _positions(path: Path, date: np.datetime64 | None) -> FileFinding:
    options: tuple[str, ...] = ()
    try:
        log = read_positions(path, date=date, heights="optional", antennas="several")
    except InputFileError as error:
        if LENIENT not in str(error):
            raise
        log = read_positions(path, broken_lines="count", date=date, heights="optional", antennas="several")
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


def _table(path: Path, kind: TableKind) -> FileFinding:
    phrase, span = read_table_facts(path, kind)
    return FileFinding(path=path, kind=kind, facts=(phrase,), span=span)


def _model(path: Path, kind: ModelKind) -> FileFinding:
    return FileFinding(path=path, kind=kind, facts=(read_model_facts(path, kind),))


def _orbits(path: Path) -> FileFinding:
    orbits = read_sp3(path)
    step = float(np.median(np.diff(orbits.time)) / _SECOND)
    facts = (
        f"{len(orbits.satellite)} satellites, one position every {step:g} s",
        *(f"note: {n}" for n in orbits.notes),
    )
    return FileFinding(path=path, kind="orbits", facts=facts, span=(orbits.time[0], orbits.time[-1]))


def _sbas(path: Path) -> FileFinding:
    messages = read_sbas(path, broken_lines="count")
    facts = (f"{len(messages):,} messages of PRN {', '.join(map(str, np.unique(messages.prn)))}",)
    return FileFinding(path=path, kind="sbas", facts=facts, span=(messages.time.min(), messages.time.max()))


#: For each file format, the kinds of input that it may contain.
_KINDS: Final[dict[FileKind, tuple[Kind, ...]]] = {
    "observations": ("observations",),
    "navigation": ("navigation",),
    "sp3": ("orbits",),
    "sbas": ("sbas",),
    "receiver": ("observations", "navigation", "positions"),
    "toml": ("vehicle", "settings"),
    **{kind: ("track",) for kind in MAPS if kind not in POSITIONS},
    **dict.fromkeys(("nmea", "novatel", "rtklib"), ("positions",)),
}
#: Reader of each kind of input that is read with the path and the date of the log.
_DATED: Final[dict[Kind, Callable[[Path, np.datetime64 | None], FileFinding]]] = {
    "observations": _observations,
    "navigation": _navigation,
    "positions": _positions,
}
#: Reader of each kind of input that is read with the path only.
_READERS: Final[dict[Kind, Callable[[Path], FileFinding]]] = {
    "track": _track,
    "orbits": _orbits,
    "sbas": _sbas,
    "unknown": _unknown,
    "vehicle": _vehicle,
    "settings": _settings,
    **{kind: partial(_table, kind=kind) for kind in TABLE_KINDS},
    **{kind: partial(_model, kind=kind) for kind in MODEL_KINDS},
}


def _place_facts(ecef_m: Floats) -> tuple[str, ...]:
    if not np.isfinite(ecef_m).all():
        return ()
    latitude, longitude, height = (float(value) for value in geodetic_from_ecef(ecef_m))
    return (f"near latitude {latitude:.4f}, longitude {longitude:.4f}, height {round(height)} m",)


def _filter(findings: Sequence[FileFinding], kind: Kind) -> list[FileFinding]:
    return [finding for finding in findings if finding.kind == kind]


def _problems(findings: Sequence[FileFinding]) -> list[str]:
    """Return sentences on faults in files, on missing files that a run requires, and on mismatches between files."""
    problems = [problem for finding in findings for problem in finding.problems]
    logs, tracks = (_filter(findings, kind) for kind in ("observations", "track"))
    readable = [log for log in logs if log.span is not None]
    navigation = [finding for finding in findings if finding.ephemerides is not None or finding.kind == "navigation"]
    if not logs:
        problems.append("no log of observations: give a RINEX observation file or a receiver's log")
    if not navigation and logs:
        problems.append("no navigation file: give the broadcast ephemerides of the day")
    if not tracks and logs:
        problems.append("no track map: railfix map survey creates one from runs over the line")
    if len(logs) > 2:
        problems.append("there are more than two logs: give the files of one run")
    for log in readable:
        assert log.span is not None
        spans = [finding.ephemerides for finding in navigation if finding.ephemerides is not None]
        if spans and all(spans_apart(log.span, span, reach=RECORD_REACH) for span in spans):
            problems.append(
                f"{log.path}: no ephemeris covers the time of the log; give the navigation file of "
                f"{str(log.span[0])[:10]}"
            )
        for other in tracks:
            if log.place_ecef_m is not None and other.place_ecef_m is not None:
                apart = float(np.linalg.norm(log.place_ecef_m - other.place_ecef_m))
                if apart > ANOTHER_PLACE_M:
                    problems.append(
                        f"{other.path}: lies {apart / 1000:,.0f} km from the position in the header of {log.path}"
                    )
    for table in (finding for finding in findings if finding.kind in TABLE_KINDS):
        other_kind = next((kind for of, kind in PAIRS.items() if of == table.kind), None)
        if logs and other_kind and not _filter(findings, other_kind) and table.kind != "list of balises":
            problems.append(f"{table.path}: a run also needs the {other_kind.replace('_', ' ')}; give both tables")
        if (
            readable
            and table.span is not None
            and all(spans_apart(table.span, log.span) for log in readable if log.span)
        ):
            problems.append(f"{table.path}: has no time in common with the logs")
    if len(readable) == 2:
        one, two = (log.span for log in readable)
        assert one is not None
        assert two is not None
        if spans_apart(one, two):
            problems.append(f"{logs[0].path} and {logs[1].path}: have no time in common")
    return problems


def _command(findings: Sequence[FileFinding], date: np.datetime64 | None) -> str:
    """Return the command that positions the logs with these files, or "" if a required file is missing."""
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
    options: dict[Kind, tuple[str, int]] = {
        "orbits": ("--sp3", len(findings)), "sbas": ("--sbas", len(findings)), "vehicle": ("--vehicle", 1),
        "settings": ("--config", 1),
    }  # fmt: skip
    for kind, (option, most) in options.items():
        words += [word for finding in _filter(findings, kind)[:most] for word in (option, str(finding.path))]
    readable = (finding for finding in findings if finding.facts)
    words += model_options({finding.kind: finding.path for finding in readable if finding.kind in MODEL_KINDS})
    words += sensor_options({finding.kind: finding.path for finding in findings if finding.kind in TABLE_KINDS})
    heights = [str(finding.path) for finding in _filter(findings, "heights")] or ["log"]
    options_of_files = dict.fromkeys(word for finding in findings for word in finding.options)
    words += [heights[0] if word == "log" else word for word in options_of_files]
    words += [] if date is None else ["--date", str(date.astype("datetime64[s]"))]
    return shlex.join([*words, "--out", "results"])
