"""Inputs of a run: the line with the antenna trajectories, and the logs in chunks of equal time spans."""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np

from railfix.core.errors import MismatchError, SettingsError
from railfix.core.reasons import Status
from railfix.gnss.joined_observations import concatenate
from railfix.gnss.observations import Observations
from railfix.io.logs import scan_observations
from railfix.pipeline.along_track import mark_doubtful
from railfix.pipeline.config import Config
from railfix.pipeline.level_stage import apply_verdicts
from railfix.pipeline.results import Result
from railfix.run.inputs import OF_LOG, Antenna, LogReading, TrackReading
from railfix.run.prepared import PreparedLines, compute_key, track_key
from railfix.run.route import RouteOfLog
from railfix.track import Track
from railfix.track.frames import FrameShift, track_at
from railfix.track.read import check_heights, read_segments, track_of_segments
from railfix.track.route import check_order
from railfix.track.track import HEIGHTS_M
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import Vehicle, antenna_trajectory, read_vehicle
from railfix.tracking.result import TrackStatus, is_bounded

if TYPE_CHECKING:
    from railfix.run.route import LogPositions, RouteOfLog


#: A track that is shorter than this is rejected [m].
_SHORTEST_M: Final = 1.0
#: File name of the run's track in the results folder. The file exists only if the track differs from the input files.
TRACK_FILE: Final = "track.csv"


@dataclass(frozen=True, kw_only=True)
class OpenedLine:
    """Line of a run with the trajectory of each antenna."""

    track: Track
    vehicle: Vehicle | None
    trajectories: dict[str, Trajectory]  #: Trajectory by antenna.
    #: Transformation of the track to the satellites' reference frame; None if no time was specified.
    frame: FrameShift | None = None
    #: Route that was found from the log in a network of tracks; None if the files are a single route.
    route: RouteOfLog | None = None
    #: Whether the track is exactly as in its files: no route of a network, no heights from another source, and no
    #: transformation to another frame.
    from_file: bool = True
    preparing: tuple[str, ...] = ()  #: Notes on the cache of prepared lines.

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the map, the vehicle and the trajectories, without repetitions."""
        notes = [note for trajectory in self.trajectories.values() for note in trajectory.notes]
        notes += [*self.track.provenance.notes, *(self.frame.notes if self.frame else ()), *self.preparing]
        if turns := [turn for turn in self.turns_m.values() if np.isfinite(turn)]:
            notes.append(
                f"the line is closed with a length of {turns[0]:.1f} m: chainages that differ by this length are the "
                "same position"
            )
        return tuple(dict.fromkeys([*(self.route.notes if self.route else ()), *notes]))

    @property
    def turns_m(self) -> dict[str, float]:
        """Length of a closed line by antenna, in the antenna's chainage [m]; infinite if the line is not closed."""
        turns = {}
        for name, path in self.trajectories.items():
            before, after = path.chainage_at(np.array(path.joins_m))
            turn = np.fmin(path.chainage_m[-1] - after, before - path.chainage_m[0])
            turns[name] = float(np.nan_to_num(turn, nan=np.inf))
        return turns

    @property
    def facts(self) -> dict[str, Any]:
        """Plain values of the line for JSON."""
        track, provenance = self.track, self.track.provenance
        return {
            "track": {
                "name": track.name,
                "points": len(track),
                "length_m": round(float(track.chainage_m[-1]), 3),
                "sections": list(track.sections),
                "sigma_plan_m": track.sigma_plan_m,
                "sigma_height_m": track.sigma_height_m,
                "crs": provenance.crs,
                "frame": None if self.frame is None else self.frame.facts,
                "height_datum_asked": provenance.height_datum_asked,
                "height_datum_used": provenance.height_datum_used,
                "geoid": provenance.geoid,
                "file": "" if self.from_file else TRACK_FILE,
            },
            "route": None if self.route is None else self.route.facts,
            "vehicle": None if self.vehicle is None else self.vehicle.model_dump(mode="json"),
            "turn_m": {name: turn for name, turn in self.turns_m.items() if np.isfinite(turn)},
            "chainage_of": {name: trajectory.reference for name, trajectory in self.trajectories.items()},
        }


def open_line(
    track: tuple[Path, ...],
    vehicle: Path | None,
    *,
    antennas: tuple[Antenna, ...],
    reading: TrackReading,
    heights: Path | None = None,
    at: np.datetime64 | None = None,
    log: LogPositions | None = None,
) -> OpenedLine:
    """Read the track and the vehicle, and compute the trajectory of each antenna.

    With a time `at`, the track is transformed to the satellites' reference frame at that time (`railfix.track.frames`).
    Without `at`, coordinates remain in the map's frame. A single file whose tracks do not join to one route is a
    network; its route is found from `log`. If `heights` is `OF_LOG`, a map without heights gets the heights of the
    positions of `log`. Raise a RailfixError (`railfix.core.errors`) if a file or the route is unusable.
    """
    prepared = PreparedLines(use=reading.cache == "use")
    key = compute_key("line", *track, heights, *vars(reading.of_map).values(), reading.height_sigma)
    centreline, route = None if heights == OF_LOG else prepared.track(key), None
    if centreline is None:
        centreline, route = _read_line(track, reading, heights=heights, log=log)
        if route is None and heights != OF_LOG:
            prepared.keep_track(key, centreline)
    _check_extent(track, centreline)
    shift, moved = None, centreline
    if at is not None:
        moved, shift = track_at(centreline, at, **reading.motion)
    paths = _paths(moved, vehicle, antennas, reading, prepared)
    return OpenedLine(
        track=moved,
        vehicle=paths[0],
        trajectories=paths[1],
        frame=shift,
        route=route,
        from_file=route is None and heights is None and moved is centreline,
        preparing=tuple(prepared.notes),
    )


def _check_extent(files: tuple[Path, ...], track: Track) -> None:
    """Raise MismatchError if the track is shorter than `_SHORTEST_M`, or if its heights are impossible."""
    if (length := float(track.chainage_m[-1] - track.chainage_m[0])) < _SHORTEST_M:
        raise MismatchError(f"{', '.join(map(str, files))}: is {length:g} m long; give the track of a line")
    low, high = float(np.nanmin(track.height_m)), float(np.nanmax(track.height_m))
    if low < HEIGHTS_M[0] or high > HEIGHTS_M[1]:
        raise MismatchError(
            f"{', '.join(map(str, files))}: has heights from {low:,.0f} to {high:,.0f} m; expected metres between "
            f"{HEIGHTS_M[0]:,.0f} and {HEIGHTS_M[1]:,.0f}; they may be in millimetres"
        )


def _read_line(
    track: tuple[Path, ...], reading: TrackReading, *, heights: Path | None, log: LogPositions | None
) -> tuple[Track, RouteOfLog | None]:
    """Read the track. If the file is a network, also find the route; otherwise the route is None."""
    if not track:
        raise SettingsError("no track map was given; give it with --track")
    segments = [segment for path in track for segment in read_segments(path, reading.of_map)]
    options: dict[str, Any] = {
        "geoid": reading.geoid, "height_datum": reading.height_datum, "sigma_height_m": reading.height_sigma
    }  # fmt: skip
    check_heights(segments, heights, **options)
    check_order(segments)
    route = None
    if len(track) == 1 and len(segments) > 1:
        from railfix.track.network_read import connect_network, is_route

        if not is_route(segments):
            if log is None:
                raise MismatchError(
                    f"{track[0]}: has {len(segments)} tracks that do not join to one route; make a map of one route by "
                    "'railfix map route'"
                )
            route = log.route(connect_network(segments, track))
            segments = [route.network.tracks[k] for k in route.tracks]
    if heights == OF_LOG and log is None:
        raise SettingsError("--heights log: only railfix run can use the heights of the log; give a file here")
    centreline = track_of_segments(
        segments,
        heights=log.positions if heights == OF_LOG and log is not None else heights,
        name=None if route is None else track[0].stem,
        **options,
    )
    return centreline, route


def _paths(
    track: Track, vehicle: Path | None, antennas: tuple[Antenna, ...], reading: TrackReading, prepared: PreparedLines
) -> tuple[Vehicle | None, dict[str, Trajectory]]:
    """Return the vehicle and the trajectory of each antenna. Without a vehicle, the trajectory is the track."""
    if vehicle is None:
        if reading.reference != "antenna":
            raise SettingsError(
                f"the chainage of {reading.reference} was requested; give the vehicle file (--vehicle) that it requires"
            )
        return None, dict.fromkeys(antennas, Trajectory.from_antenna_path(track))
    body = read_vehicle(vehicle)
    of_track = track_key(track)
    paths: dict[str, Trajectory] = {}
    for name in antennas:
        key = compute_key("path", of_track, body.model_dump_json(), name, reading.reference)
        path = prepared.path(key)
        if path is None:
            path = antenna_trajectory(track, body, name, reference=reading.reference)
            prepared.keep_path(key, path)
        paths[name] = path
    return body, paths


@dataclass(kw_only=True)
class Log:
    """Log of one antenna in one or several files, which is read in pieces."""

    paths: tuple[Path, ...]
    chunk_epochs: int  #: Maximum number of epochs of a piece.
    reading: LogReading = field(default_factory=LogReading)
    start: datetime | None = None  #: GPS time from which epochs are read; None without a limit.
    end: datetime | None = None  #: GPS time before which epochs are read; None without a limit.
    share: float = 0.0  #: Fraction of the files that has been read, 0 to 1.
    problems: list[str] = field(default_factory=list)  #: Sentences on malformed and skipped parts of the log.
    skipped: Counter[str] = field(default_factory=Counter)  #: Numbers of skipped items by kind.

    def parts(self) -> Generator[Observations]:
        """Yield the log in pieces, in order of time. Errors are raised as in `railfix.io.logs.scan_observations`."""
        pieces = scan_observations(
            self.paths,
            epochs=self.chunk_epochs,
            start=None if self.start is None else np.datetime64(self.start, "ns"),
            end=None if self.end is None else np.datetime64(self.end, "ns"),
            progress=self._read_to,
            **self.reading.of_observations,
        )
        for piece in pieces:
            self.problems += piece.problems
            self.skipped.update(piece.skipped)
            if len(piece):
                yield piece

    def first_epochs(self) -> Iterator[tuple[Path, np.datetime64]]:
        """Yield the path and the first selected epoch of each file, or nothing if the log is a single file."""
        for path in self.paths if len(self.paths) > 1 else ():
            alone = replace(self, paths=(path,), problems=[], skipped=Counter(), chunk_epochs=1)
            with suppress(MismatchError), closing(alone.parts()) as parts:
                yield from ((path, part.time[0]) for part in islice(parts, 1))

    def _read_to(self, share: float) -> None:
        self.share = share


Item = TypeVar("Item")
#: Time tags of two receivers that differ by at most this are taken to be of the same instant [ns].
SAME_INSTANT_NS: Final = 20_000_000


def align_logs(logs: Mapping[str, Iterator[Observations]]) -> Iterator[dict[str, Observations]]:
    """Yield chunks of observations that cover the same time span for every antenna.

    Each antenna has its own epochs, and may have none in a span. One part of each log is read at a time. A chunk ends
    at the earliest end of these parts; later epochs of other parts are in the next chunk. Epochs of the same instant
    whose time tags differ slightly (`SAME_INSTANT_NS`) are in the same chunk.
    """
    live = dict(logs)
    waiting: dict[str, Observations] = {}
    spacing: dict[str, int] = {}

    def read(name: str) -> None:
        part = next(live[name], None)
        if part is None:
            del live[name]
            return
        if len(part) > 1:
            spacing[name] = int(np.median(np.diff(part.time).astype(np.int64)))
        rest = waiting.get(name)
        waiting[name] = concatenate([rest, part]) if rest is not None and len(rest) else part

    while True:
        for name in list(live):
            if not len(waiting.get(name, ())):
                read(name)
        if not any(map(len, waiting.values())):
            return
        cut = {name: len(part) for name, part in waiting.items()}
        if live:
            slack = min(SAME_INSTANT_NS, *(spacing.get(name, 0) // 2 for name in live))
            horizon = min(waiting[name].time[-1] for name in live) + np.timedelta64(slack, "ns")
            cut = {name: int(np.searchsorted(part.time, horizon, side="right")) for name, part in waiting.items()}
        yield {name: part[: cut[name]] for name, part in waiting.items()}
        # A short remainder is joined with the next part, because it would split every following chunk.
        short = [n for n in live if 0 < len(waiting[n]) - cut[n] < len(waiting[n]) // 2]
        waiting = {name: part[cut[name] :] for name, part in waiting.items()}
        for name in short:
            read(name)


def read_ahead(items: Iterator[Item]) -> Iterator[Item]:
    """Yield the items of an iterator while another thread computes the next item. The items must not be None."""
    with ThreadPoolExecutor(max_workers=1) as reader:
        coming = reader.submit(next, items, None)
        while (item := coming.result()) is not None:
            coming = reader.submit(next, items, None)
            yield item


def without_beside(result: Result, route: RouteOfLog, config: Config) -> Result:
    """Return the results with doubtful statuses and infinite protection levels where the track is uncertain.

    The track is uncertain if the probability of other tracks exceeds `Config.track_risk` (`RouteOfLog.is_uncertain`).
    """
    antennas, fusion = dict(result.antennas), dict(result.fusion)
    for name, single in antennas.items():
        beside = route.is_uncertain(single.time, single.chainage_m, risk=config.track_risk)
        status = np.where(beside & (single.status == Status.OK), np.int8(Status.MAP_OFFSET), single.status)
        protection = single.protection
        if protection is not None:
            has = np.isfinite(single.chainage_m)
            level = replace(protection.level, level_m=np.where(beside & has, np.inf, protection.level.level_m))
            protection = apply_verdicts(replace(protection, level=level), status, has, single.chainage_m, config)
        antennas[name] = replace(single, status=status, protection=protection)
    for name, filtered in fusion.items():
        tracked = filtered.tracked
        beside = route.is_uncertain(tracked.time, filtered.chainage_m, risk=config.track_risk)
        beside &= is_bounded(tracked.status)
        fusion[name] = replace(filtered, tracked=mark_doubtful(tracked, beside, TrackStatus.MAP_OFFSET))
    return replace(result, antennas=antennas, fusion=fusion)
