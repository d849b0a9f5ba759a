"""Errors of one antenna along the line, as differences of chainage or along the trajectory.

The error is the distance along the map from the reference position's nearest point on the map to the evaluated
position. It is positive toward the end of the line (paper P1, section 3.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, Indices, Masks
from railfix.core.errors import InputFileError, MismatchError, RailfixError
from railfix.core.options import option
from railfix.core.settings import INPUTS, Settings
from railfix.core.timescale import seconds
from railfix.evaluate.evaluation_inputs import LARGEST_GAP_S, Method, RunFolder
from railfix.run.inputs import TrackReading
from railfix.track import Track, read_track
from railfix.track.passes import find_segments_near, short_distance_m
from railfix.track.track import ANOTHER_PLACE_M
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import antenna_trajectory, read_vehicle


@dataclass(frozen=True, kw_only=True)
class Bracket:
    """Neighbouring instants of a reference for each of T times; the reference has R instants."""

    #: Index of the reference instant before each time, or of the instant at the time itself; shape (T,).
    left: Indices
    #: Index of the reference instant after each time; equal to `left` if there is an instant at the time; shape (T,).
    right: Indices
    share: Floats  #: Fraction of the interval from left to right that has passed at each time, 0 to 1, shape (T,).
    inside: Masks  #: False before the first instant, after the last instant, and in gaps of the reference; shape (T,).

    def of(self, values: Floats) -> Floats:
        """Return values of the reference, shape (R,) or (R, n), interpolated linearly to the T times; NaN outside."""
        across = (-1, *(1,) * (values.ndim - 1))
        between = values[self.left] + self.share.reshape(across) * (values[self.right] - values[self.left])
        return np.where(self.inside.reshape(across), between, np.nan)

    @property
    def nearest(self) -> Indices:
        """Index of the nearest instant of the reference, shape (T,)."""
        return np.where(self.share <= 0.5, self.left, self.right)


def bracket(time: Datetimes, reference_time: Datetimes, *, largest_gap_s: float = LARGEST_GAP_S) -> Bracket:
    """Return the neighbouring instants of a reference for each time; the reference times must increase.

    Times between two instants that are more than `largest_gap_s` apart are in a gap (`Bracket.inside`). Raise
    ValueError if the reference has fewer than two instants.
    """
    if len(reference_time) < 2:
        raise ValueError(f"reference_time has {len(reference_time)} instants, at least two were expected")
    last = len(reference_time) - 1
    right = np.clip(np.searchsorted(reference_time, time), 1, last)
    left = right - 1
    step = seconds(reference_time[right] - reference_time[left])
    share = seconds(time - reference_time[left]) / step
    at = np.where(time == reference_time[left], left, right)
    exact = time == reference_time[at]
    inside = (share > 0.0) & (share < 1.0) & (step <= largest_gap_s)
    return Bracket(
        left=np.where(exact, at, left),
        right=np.where(exact, at, right),
        share=np.where(exact, 0.0, share),
        inside=inside | exact,
    )


def interpolate_reference(
    time: Datetimes, reference_time: Datetimes, reference_ecef_m: Floats, *, largest_gap_s: float = LARGEST_GAP_S
) -> Floats:
    """Interpolate reference positions, shape (R, 3), linearly to other times, shape (T, 3) [m].

    The reference times must increase. The result is NaN outside the reference and in its gaps, which are intervals
    longer than `largest_gap_s`.
    """
    return bracket(time, reference_time, largest_gap_s=largest_gap_s).of(reference_ecef_m)


def along_track_error(
    arc_m: Floats, reference_ecef_m: Floats, trajectory: Trajectory, *, same_place_m: float = 30.0
) -> Floats:
    """Return the signed error along the line, + toward the end of the line, shape (T,) [m] (P1 3.3).

    The error is the distance along the line from the reference's nearest point on the map to the position. Where the
    map passes the reference more than once (laps, two carriageways of a road), the pass nearest to the position is
    used, because the ranges of one epoch cannot distinguish the passes. Where the line returns near itself (a
    crossing), the straight distance is used if it is shorter. On a line that passes every point once, these rules have
    no effect, except that the error in a curve is the length of the chord.

    Parameters
    ----------
    arc_m : ndarray, shape (T,) [m]
        Arc lengths of the positions on the trajectory; the error is NaN where a position or a reference is NaN.
    reference_ecef_m : ndarray, shape (T, 3) [m]
        Reference positions.
    same_place_m : float [m]
        The map counts as passing a reference position if their distance is at most this.
    """
    error = np.full(len(arc_m), np.nan)
    at = np.flatnonzero(np.isfinite(arc_m) & np.isfinite(reference_ecef_m[:, 0]))
    if not len(at):
        return error
    reference, length = reference_ecef_m[at], trajectory.length_m
    nearest_arc, offset = trajectory.nearest(reference)
    passes = find_segments_near(reference, trajectory, np.maximum(same_place_m, offset))
    passing = passes.lowest & (np.linalg.norm(passes.offset_m, axis=1) <= same_place_m)
    if np.isfinite(trajectory.turn_m):  # the ends of a closed line are not separate passes: the line continues there
        passing &= ~((passes.segment == 0) & (passes.along_m <= 0.0))
        passing &= ~((passes.segment == len(length) - 1) & (passes.along_m >= length[-1]))
    ways = arc_m[at][passes.position] - trajectory.arc_m[passes.segment] - passes.foot_m
    signed = np.concatenate([arc_m[at] - nearest_arc, ways[passing]])
    owner = np.concatenate([np.arange(len(at)), passes.position[passing]])
    signed = short_distance_m(signed, trajectory.turn_m)
    order = np.lexsort((np.abs(signed), owner))
    first = order[np.flatnonzero(np.r_[True, owner[order][1:] != owner[order][:-1]])]
    error[at[owner[first]]] = signed[first]
    straight = np.linalg.norm(trajectory.at_arc(arc_m[at]) - trajectory.at_arc(nearest_arc), axis=1)
    error[at] = np.copysign(np.minimum(np.abs(error[at]), straight), error[at])
    return error


def straight_distance(arc_m: Floats, reference_ecef_m: Floats, trajectory: Trajectory) -> Floats:
    """Return the straight distance (3-D) from positions on the map to the reference's nearest point on the map.

    The distance has shape (T,) [m] and is NaN where the position or the reference, shape (T, 3), is NaN. It does not
    depend on the choice between several passes of the line, and never exceeds the distance along the line.
    """
    distance = np.full(len(arc_m), np.nan)
    rows = np.flatnonzero(np.isfinite(arc_m) & np.isfinite(reference_ecef_m[:, 0]))
    if len(rows):
        nearest, _ = trajectory.nearest(reference_ecef_m[rows])
        distance[rows] = np.linalg.norm(trajectory.at_arc(arc_m[rows]) - trajectory.at_arc(nearest), axis=1)
    return distance


#: Run and reference are assumed to use the same map if the median difference between their distance in chainage and
#: their straight distance is at most this value [m].
SAME_MAP_M: Final = 1.0
#: A position was computed with a trajectory if it is at most this distance away from the trajectory [m].
SAME_TRAJECTORY_M: Final = 0.01
#: Assumed maximum distance along the line between two points of a vehicle [m].
_WITHIN_VEHICLE_M: Final = 45.0
#: An error counts as measured to another pass of the line if d - 2 |error| exceeds this value [m], where d is the
#: distance along the line between the position and the point nearest to the reference.
_ANOTHER_PASS_M: Final = 50.0
#: A chainage beyond an end of the line by at most this distance is regarded as rounded, and accepted [m].
_ROUNDING_M: Final = 1e-3


class TrackFiles(Settings):
    """Files that replace the files of ``run.json``, and options for reading the track other than `reference`."""

    track: tuple[Path, ...] = option(
        "Track map to use instead of the track in run.json.", (), metavar="TRACK", panel=INPUTS
    )
    vehicle: Path | None = option(
        "Vehicle file to use instead of the vehicle in run.json.", None, metavar="TOML", panel=INPUTS
    )
    reading: TrackReading = Field(default_factory=TrackReading)


@dataclass(frozen=True, kw_only=True)
class Answers:
    """Positions of one antenna at T epochs, and the reference at the same epochs."""

    chainage_m: Floats  #: Chainage of the position computed with the map, shape (T,); NaN without a position.
    conventional_chainage_m: Floats  #: Chainage of the conventional position, shape (T,); NaN without a position.
    ecef_m: Floats  #: Position computed with the map, ECEF, shape (T, 3); NaN without a position.
    #: Chainage of the reference, shape (T,); NaN where the reference has no position or no chainage.
    reference_chainage_m: Floats
    reference_ecef_m: Floats  #: Position of the reference, shape (T, 3); NaN where unknown.


@dataclass(frozen=True, kw_only=True)
class PlaceErrors:
    """Errors of one antenna at T epochs; signed errors are + toward the end of the line."""

    method: Method
    error_m: Floats  #: Signed error of the position computed with the map, shape (T,).
    conventional_error_m: Floats  #: Signed error of the conventional position, shape (T,).
    #: Straight distance (3-D) of the position computed with the map, shape (T,): with the method "trajectory", from the
    #: point of the map nearest to the reference; with the method "chainage", from the reference position.
    distance_m: Floats
    #: Chainage of the reference if it has one, else of the point of the map nearest to the reference; shape (T,).
    reference_chainage_m: Floats
    files: tuple[tuple[str, Path], ...] = ()  #: Kind ("track" or "vehicle") and path of each file that was read.
    notes: tuple[str, ...] = ()


def compute_errors(
    run: RunFolder,
    antenna: str,
    answers: Answers,
    *,
    method: Literal["auto", "chainage", "trajectory"],
    files: TrackFiles,
) -> PlaceErrors:
    """Compute the errors of one antenna.

    With the method "auto" the errors are differences of chainage if run and reference share a map (`SAME_MAP_M`),
    otherwise distances along the trajectory. Raise MismatchError if the reference is in another region, the method
    "chainage" is impossible, or the track is not the track of the run; raise InputFileError if a file is missing.
    """
    _check_same_place(run, antenna, answers)
    against, trusted = _against_chainage(run, antenna, answers)
    turn = run.turn_m(antenna)
    if method != "trajectory":
        if against is None:
            if files.track or files.vehicle is not None:
                find_trajectory(
                    run, antenna, answers.chainage_m, answers.ecef_m, files
                )  # raises an error if a given file does not fit the run
            return PlaceErrors(
                method="chainage",
                error_m=short_distance_m(answers.chainage_m - answers.reference_chainage_m, turn),
                conventional_error_m=short_distance_m(
                    answers.conventional_chainage_m - answers.reference_chainage_m, turn
                ),
                distance_m=np.linalg.norm(answers.ecef_m - answers.reference_ecef_m, axis=1),
                reference_chainage_m=answers.reference_chainage_m,
                notes=(f"{antenna}: the line is closed; each error is in its shorter direction",)
                if np.isfinite(turn)
                else (),
            )
        if method == "chainage":
            raise MismatchError(f"{run.path}: {against}; use the trajectory instead (--method trajectory)")
        notes: tuple[str, ...] = (f"{antenna}: errors are along the trajectory, because {against}",)
    else:
        notes = (f"{antenna}: errors are along the trajectory, as requested",)
    trajectory, used, more = find_trajectory(run, antenna, answers.chainage_m, answers.ecef_m, files)
    arc, other = (_arc(trajectory, c) for c in (answers.chainage_m, answers.conventional_chainage_m))
    place = answers.reference_chainage_m
    if not trusted:
        place = trajectory.chainage_at(trajectory.nearest(answers.reference_ecef_m)[0])
    error = along_track_error(arc, answers.reference_ecef_m, trajectory)
    return PlaceErrors(
        method="trajectory",
        error_m=error,
        conventional_error_m=along_track_error(other, answers.reference_ecef_m, trajectory),
        distance_m=straight_distance(arc, answers.reference_ecef_m, trajectory),
        reference_chainage_m=place,
        files=used,
        notes=(*notes, *_note_of_passes(antenna, arc, error, answers, trajectory), *more),
    )


def _check_same_place(run: RunFolder, antenna: str, answers: Answers) -> None:
    """Raise MismatchError if the median distance between reference and positions exceeds `ANOTHER_PLACE_M`."""
    apart = np.linalg.norm(answers.ecef_m - answers.reference_ecef_m, axis=1)
    apart = apart[np.isfinite(apart)]
    if len(apart) and (median := float(np.median(apart))) > ANOTHER_PLACE_M:
        raise MismatchError(
            f"{run.path}: the reference of the {antenna} antenna is {median / 1000:,.0f} km from its "
            "positions; give the reference of this run, and check the order of its coordinates"
        )


def _note_of_passes(
    antenna: str, arc_m: Floats, error_m: Floats, answers: Answers, trajectory: Trajectory
) -> tuple[str, ...]:
    """Return a note on errors that were not measured to the pass of the line nearest to the reference."""
    known = np.isfinite(error_m)
    nearest, _ = trajectory.nearest(answers.reference_ecef_m[known])
    others = int((np.abs(arc_m[known] - nearest) > 2.0 * np.abs(error_m[known]) + _ANOTHER_PASS_M).sum())
    if not others:
        return ()
    return (
        f"{antenna}: the line passes the same point several times; {others} of {int(known.sum())} errors "
        "were measured to the pass nearest to the position, but the train may have been on another pass",
    )


def _against_chainage(run: RunFolder, antenna: str, answers: Answers) -> tuple[str | None, bool]:
    """Return the reason why differences of chainage cannot be used as errors, or None if they can be used.

    Also return whether the chainage of the reference is on the map of the run.
    """
    known = np.isfinite(answers.reference_ecef_m[:, 0])
    with_chainage = np.isfinite(answers.reference_chainage_m)
    if not with_chainage.any():
        return "the reference has no chainage", False
    if (known & ~with_chainage).any():
        count = int((known & ~with_chainage).sum())
        return f"the reference has no chainage at {count} of {int(known.sum())} epochs", False
    point = run.chainage_of.get(antenna, "antenna")
    difference = np.abs(short_distance_m(answers.chainage_m - answers.reference_chainage_m, run.turn_m(antenna)))
    apart = np.linalg.norm(answers.ecef_m - answers.reference_ecef_m, axis=1)
    both = np.isfinite(difference) & np.isfinite(apart)
    off = float(np.median(np.abs(difference - apart)[both])) if both.any() else 0.0
    if off > SAME_MAP_M + (0.0 if point == "antenna" else _WITHIN_VEHICLE_M):
        return f"the chainages of run and reference are not on the same map (median difference {off:.1f} m)", False
    if point != "antenna":
        return f"the chainage of the run refers to the {point}, the chainage of the reference to the antenna", True
    return None, True


def _arc(trajectory: Trajectory, chainage_m: Floats) -> Floats:
    """Return the arc lengths at chainages; chainages beyond an end of the line by less than `_ROUNDING_M` are moved to
    this end.
    """
    first, last = trajectory.chainage_m[0], trajectory.chainage_m[-1]
    near = (chainage_m > first - _ROUNDING_M) & (chainage_m < last + _ROUNDING_M)
    return trajectory.arc_at_chainage(np.where(near, np.clip(chainage_m, first, last), chainage_m))


def find_trajectory(
    run: RunFolder, antenna: str, chainage_m: Floats, ecef_m: Floats, files: TrackFiles
) -> tuple[Trajectory, tuple[tuple[str, Path], ...], tuple[str, ...]]:
    """Return the trajectory on which an antenna's positions are located, the files that were read, and notes.

    Raise InputFileError if a file is missing, MismatchError if a position is farther than `SAME_TRAJECTORY_M` from the
    trajectory.
    """
    tracks = list(files.track) or run.tracks
    vehicles = [files.vehicle] if files.vehicle is not None else run.input_paths("vehicle")
    if not tracks:
        raise InputFileError(run.path / "run.json", "names no track; give it with --track")
    used = (*(("track", path) for path in tracks), *(("vehicle", path) for path in vehicles))
    for kind, path in used:
        if not path.is_file():
            raise InputFileError(path, f"the {kind} of the run is no longer there; give it with --{kind}")
    farthest: list[float] = []
    faults: list[RailfixError] = []
    for crs, datum, geoid in _readings(run, files):
        try:
            track = read_track(tracks, crs=crs, height_datum=datum, geoid=geoid)
            trajectory = _trajectory(run, antenna, track, vehicles)
        except RailfixError as error:
            faults.append(error)
            continue
        arc = _arc(trajectory, chainage_m)
        off = np.linalg.norm(trajectory.at_arc(arc) - ecef_m, axis=1)
        off = np.where(np.isfinite(chainage_m), np.nan_to_num(off, nan=np.inf), 0.0)
        if off.max(initial=0.0) <= SAME_TRAJECTORY_M:
            return trajectory, used, trajectory.notes
        farthest.append(float(off.max()))
    if not farthest:
        raise faults[0]
    distance = f"{min(farthest):.2f} m" if np.isfinite(min(farthest)) else "the length of the line"
    raise MismatchError(
        f"{tracks[0]}: is not the track of {run.path}, whose positions of the {antenna} antenna are up to {distance} "
        "from it; give the --track and --vehicle of the run, and its --crs, --height-datum and --geoid if it had any"
    )


def _readings(run: RunFolder, files: TrackFiles) -> Sequence[tuple[str | None, str | None, str | None]]:
    """Return the sets of options (CRS, height datum, geoid) with which the track is to be read, in order of preference.

    If options are given, they are the only set. Otherwise the sets are the options in ``run.json``, then no options;
    the order is reversed if the run wrote the track that it used.
    """
    given = (files.reading.crs, files.reading.height_datum, files.reading.geoid)
    if any(given):
        return [given]
    facts, options = run.track_facts, run.track_options
    # records of earlier versions have no options, only the names of CRS and height datum that the track states
    source = options or {"crs": facts.get("crs"), "height_datum": facts.get("height_datum_asked")}
    recorded = (source.get("crs") or None, source.get("height_datum") or None, source.get("geoid") or None)
    return [given, recorded] if facts.get("file") else [recorded, given]


def read_run_track(run: RunFolder) -> Track:
    """Read the track that the run used; raise InputFileError if ``run.json`` names no track or a file is missing."""
    if not run.tracks:
        raise InputFileError(run.path / "run.json", "names no track; give it with --track")
    faults: list[RailfixError] = []
    for crs, datum, geoid in _readings(run, TrackFiles()):
        try:
            return read_track(run.tracks, crs=crs, height_datum=datum, geoid=geoid)
        except RailfixError as error:
            faults.append(error)
    raise faults[0]


def _trajectory(run: RunFolder, antenna: str, track: Track, vehicles: Sequence[Path]) -> Trajectory:
    if not vehicles:
        return Trajectory.from_antenna_path(track)
    point = run.chainage_of.get(antenna, "antenna")
    name: Literal["front", "rear"] = "rear" if antenna == "rear" else "front"
    return antenna_trajectory(track, read_vehicle(vehicles[0]), name, reference=point)  # type: ignore[arg-type]
