"""Match the positions of a run to the tracks of a network, and compute the probability of each track."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Unpack

import numpy as np
import scipy

from railfix.core.arrays import Datetimes, Floats, Indices, Masks, RowArrays, take_rows
from railfix.core.errors import MismatchError, NoPositionError
from railfix.core.files import BrokenLines, FilePath
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.io.position_log import PositionLog
from railfix.io.positions import read_positions
from railfix.track.crs import kind_of_frame
from railfix.track.frames import FrameShift, MapMotion, in_map_frame
from railfix.track.network import ANTENNA_SIGMA_M, ANTENNA_UP_M, CLEARANCE_M, Candidates, Network
from railfix.track.network_decode import SHIFTS_M, Residuals, Transitions, decode
from railfix.track.track import ANOTHER_PLACE_M

#: Standard deviation of distances from the track, if it is neither stated in the log nor can be estimated [m].
SIGMA_M: Final = 4.0
_LEAST_SIGMA_M: Final = 1.0  #: Smaller estimates of the positions' standard deviation are replaced by this [m].
#: Sigma is estimated from positions whose second nearest track is farther than the nearest one by more than this [m].
_ALONE_M: Final = 15.0
#: Positions count as off the track if their median distance, scaled to a standard deviation, exceeds both this value
#: [m] and `_BESIDE` times the position noise.
_LARGEST_LEVEL_M: Final = 5.0
_BESIDE: Final = 3.0  #: Multiple of the position noise; see `_LARGEST_LEVEL_M`.
_ENOUGH: Final = 30  #: Minimum number of positions to estimate the standard deviation.
#: Upper bound of the standard deviation of the common error of all positions (satellites, atmosphere, map) [m].
_COMMON_M: Final = 2.0
#: Ratio of the common error's standard deviation to the stated standard deviation of the positions.
_COMMON_SHARE: Final = 0.7
_BEST: Final = 0.1  #: Quantile of the stated standard deviations that is multiplied by `_COMMON_SHARE`.
_WITHIN_M: Final = 30.0  #: Minimum search distance for tracks [m].
_WITHIN_SIGMAS: Final = 5.0  #: Search distance for tracks, in standard deviations of the position.
_FARTHEST_M: Final = 100.0  #: Maximum search distance for tracks [m].
_FAR: Final = 6.0  #: The search distance is multiplied by this for positions without a near track.
#: Positions without a candidate are rejected if the adjacent positions with candidates are at most this time apart [s].
_WRONG_S: Final = 60.0
_MOST_FAR: Final = 8  #: Largest number of candidate tracks for a position without a near track.
#: Values in `Candidates` for missing tracks.
_NO_TRACK: Final = {"track": -1, "chainage_m": np.nan, "offset_m": np.inf}
#: Values in `Matched` for a position that was not matched.
_NO_MATCH: Final = {"track": -1, **dict.fromkeys(("chainage_m", "offset_m", "probability", "probabilities"), np.nan)}
_NORMAL_MEDIAN: Final = 0.6745  #: Median of the absolute value of a standard normal variable.
_ROUNDED_M: Final = 0.1  #: The distance of unmapped from mapped tracks may be smaller than `CLEARANCE_M` by this [m].
_STEP_S: Final = 0.4  #: Time step assumed where times are missing or decrease [s].
_MOST_TRACKS: Final = 16  #: Largest number of candidate tracks for a position.
#: Heights are used if the candidate tracks of a position differ in height by more than this value [m].
_APART_UP_M: Final = 1.0


@dataclass(frozen=True, kw_only=True)
class PlanLog(RowArrays):
    """Positions of a log in plan, shape (n,) each; unknown values are NaN or NaT."""

    path: str
    time: Datetimes
    latitude_deg: Floats
    longitude_deg: Floats
    sigma_m: Floats  #: Standard deviation of a position per horizontal axis.
    height_m: Floats | None = None  #: Height of the antenna; None if the log has no heights.
    sigma_up_m: Floats | None = None  #: Standard deviation of the height; None if unknown.
    antenna_up_m: float | None = None  #: Height of the antenna above the rails; None if unknown.
    notes: tuple[str, ...] = ()

    def transform_to(self, network: Network, **motion: Unpack[MapMotion]) -> tuple[PlanLog, FrameShift]:
        """Transform the positions from the satellites' frame to the map's frame, and describe the shift.

        Raise MismatchError if the log is far from the network, or if the transformation depends on time and the log has
        no times.
        """
        _check_region(network, self)
        times = self.time[~np.isnat(self.time)]
        if not len(times) and kind_of_frame(network.frame) not in ("wgs84", "older datum"):
            raise MismatchError(
                f"{self.path}: has no times, but the shift to the frame of the map depends on the time; provide "
                "positions in the frame of the map (--same-frame)"
            )
        time = np.sort(times)[len(times) // 2] if len(times) else np.datetime64("now", "ns")
        known = np.zeros(len(self.latitude_deg)) if self.height_m is None else self.height_m
        height = np.nan_to_num(known)
        ecef = ecef_from_geodetic(self.latitude_deg, self.longitude_deg, height)
        moved, shift = in_map_frame(ecef, network.frame, time, named=network.named, **motion)
        latitude, longitude, up = geodetic_from_ecef(moved)
        height_m = None if self.height_m is None else np.where(np.isfinite(self.height_m), up, np.nan)
        return replace(self, latitude_deg=latitude, longitude_deg=longitude, height_m=height_m), shift


def _check_region(network: Network, log: PlanLog) -> None:
    """Raise MismatchError if all positions are farther than `ANOTHER_PLACE_M` from the network."""
    known = np.isfinite(log.latitude_deg) & np.isfinite(log.longitude_deg)
    if not known.any():
        return
    latitude, longitude = log.latitude_deg[known], log.longitude_deg[known]
    tree = scipy.spatial.cKDTree(network.points_m)
    zeros = np.zeros(len(latitude))
    apart = float(np.min(tree.query(ecef_from_geodetic(latitude, longitude, zeros))[0]))
    if apart <= ANOTHER_PLACE_M:
        return
    turned = ecef_from_geodetic(np.clip(longitude, -90.0, 90.0), latitude, zeros)
    swapped = float(np.min(tree.query(turned)[0])) <= ANOTHER_PLACE_M
    what = (
        "latitude and longitude are swapped in the map or the log"
        if swapped
        else "check whether the map is of this line, and its CRS is right"
    )
    raise MismatchError(f"{log.path}: the map is {apart / 1000.0:.0f} km away from the positions of the log; {what}")


@dataclass(frozen=True, kw_only=True)
class Matched:
    """Positions of a log matched to the tracks of a network, n rows; arrays have shape (n,) unless stated otherwise."""

    track: Indices  #: Track in the best sequence of tracks; -1 if the position is on no track of the network.
    chainage_m: Floats  #: Chainage on the track.
    offset_m: Floats  #: Distance from the track in plan, positive to the right.
    #: Probability of `track` given the whole log; NaN without a position, or for a position rejected as wrong.
    probability: Floats
    candidates: Candidates  #: Tracks near each position.
    #: Probability of each candidate, shape (n, m). The sum over a row is 1 minus the probability of an unmapped track.
    probabilities: Floats
    notes: tuple[str, ...] = ()  #: Notes on assumptions about the log.

    def take(self, rows: Indices) -> Matched:
        """Return the matched positions of selected rows."""
        return replace(take_rows(self, rows), candidates=self.candidates.take(rows))


def read_plan_positions(
    path: FilePath,
    *,
    columns: Mapping[str, str] | None = None,
    broken_lines: BrokenLines = "stop",
    date: np.datetime64 | None = None,
) -> PlanLog:
    """Read positions in plan, heights and sigmas from a position log (`railfix.io.read_positions`)."""
    return plan_log(read_positions(path, broken_lines=broken_lines, date=date, columns=columns, heights="optional"))


def plan_log(log: PositionLog, *, antenna_up_m: float | None = None) -> PlanLog:
    """Convert a position log to `PlanLog`; the sigma in plan is the root mean square of the east and north sigmas."""
    latitude, longitude, height = log.geodetic
    return PlanLog(
        path=log.path,
        time=log.time,
        latitude_deg=latitude,
        longitude_deg=longitude,
        sigma_m=np.sqrt((log.sigma_m[:, :2] ** 2).mean(axis=1)),
        height_m=height if np.isfinite(height).any() else None,
        sigma_up_m=log.sigma_m[:, 2],
        antenna_up_m=antenna_up_m,
        notes=log.notes,
    )


def match(
    network: Network,
    log: PlanLog,
    *,
    sigma_m: float | None = None,
    within_m: float | None = None,
    correlation_s: float = 20.0,
) -> Matched:
    """Match positions of a run to the tracks of a network.

    Parameters
    ----------
    network : Network
    log : PlanLog
        Positions in the order of travel, in the frame of the network.
    sigma_m : float, optional [m]
        Standard deviation of a position's distance from the track; by default as stated in the log, or estimated.
    within_m : float, optional [m]
        Largest distance of a position from its track; by default five standard deviations, limited to 30 m to 100 m.
    correlation_s : float [s]
        Correlation time of the position errors.

    Raises
    ------
    NoPositionError
        The log has no position.
    """
    given = np.flatnonzero(np.isfinite(log.latitude_deg))
    if not len(given):
        raise NoPositionError(f"{log.path}: has no position")
    sigma, notes = _sigma(network, log, given, sigma_m)
    if within_m is None:
        within_m = float(np.clip(_WITHIN_SIGMAS * np.quantile(sigma, 1.0 - _BEST), _WITHIN_M, _FARTHEST_M))
    candidates = _candidates(network, log.latitude_deg[given], log.longitude_deg[given], within_m)
    lost = _is_wrong(candidates, log.time[given])
    given, sigma = given[~lost], sigma[~lost]
    candidates = candidates.take(~lost)
    most = candidates.track.shape[1]
    point = ecef_from_geodetic(log.latitude_deg[given], log.longitude_deg[given], np.zeros(len(given)))
    step = np.linalg.norm(np.diff(point, axis=0), axis=1)
    residuals = _residuals(network, log, given, candidates, point, sigma, correlation_s)
    if sigma_m is None and np.isfinite(log.sigma_m[given]).any():
        residuals = replace(residuals, sigma_m=sigma * _scale(residuals, candidates.track, correlation_s))
    path, gamma = decode(residuals, Transitions(network, candidates, step, residuals))
    rows, mapped = np.arange(len(given)), path < most
    column = np.minimum(path, most - 1)
    found = Matched(
        track=np.where(mapped, candidates.track[rows, column], -1),
        chainage_m=np.where(mapped, candidates.chainage_m[rows, column], np.nan),
        offset_m=np.where(mapped, candidates.offset_m[rows, column], np.nan),
        probability=gamma[rows, path],
        candidates=candidates,
        probabilities=gamma[:, :most],
        notes=(*notes, *_time_notes(log, given)),
    )
    return found if len(given) == len(log.time) else _spread(found, given, len(log.time))


def _sigma(network: Network, log: PlanLog, given: Indices, sigma_m: float | None) -> tuple[Floats, tuple[str, ...]]:
    """Return the standard deviation of each position's distance from the track [m], and notes on assumed values."""
    if sigma_m is not None:
        return np.full(len(given), sigma_m), ()
    stated = np.isfinite(log.sigma_m[given])
    sigma = np.hypot(log.sigma_m[given], network.sigma_plan_m)
    if stated.all():
        return sigma, ()
    estimate, how = _estimate_sigma(network, log, given[~stated])
    note = f"{log.path}: {int((~stated).sum())} positions have no sigma, {estimate:.1f} m is assumed{how} (--sigma)"
    return np.where(stated, sigma, estimate), (note,)


def _estimate_sigma(network: Network, log: PlanLog, rows: Indices) -> tuple[float, str]:
    """Estimate the standard deviation of distances from a track [m], and describe in a clause how it was obtained.

    Only positions near a single track are used. If two tracks are parallel, an error cannot be distinguished from a
    position on the second track.
    """
    latitude, longitude = log.latitude_deg[rows], log.longitude_deg[rows]
    near = network.near(latitude, longitude, within_m=_FARTHEST_M, most=2)
    first, second = np.abs(near.offset_m[:, 0]), np.abs(near.offset_m[:, -1])
    alone = np.isfinite(first) & (second > first + _ALONE_M) if near.offset_m.shape[1] > 1 else np.isfinite(first)
    if alone.sum() < _ENOUGH:
        return SIGMA_M, ", because too few of them are near a single track"
    own = near.offset_m[alone, 0]
    level, noise = (float(np.median(np.abs(v))) / _NORMAL_MEDIAN for v in (own, np.diff(own) / np.sqrt(2.0)))
    if level > max(_LARGEST_LEVEL_M, _BESIDE * noise):
        return max(noise, SIGMA_M / 2.0), ", because the positions are not on the tracks"
    return max(level, _LEAST_SIGMA_M, network.sigma_plan_m), ", from the distances of positions near a single track"


def _time_notes(log: PlanLog, given: Indices) -> tuple[str, ...]:
    """Return a note if times in the log decrease."""
    back = np.flatnonzero(np.diff(log.time[given]) < np.timedelta64(0))
    if not len(back):
        return ()
    first = log.time[given[back[0] + 1]]
    return (f"{log.path}: the time decreases at {len(back)} rows, first at {first}; the order of the rows is kept",)


def _candidates(network: Network, latitude_deg: Floats, longitude_deg: Floats, within_m: float) -> Candidates:
    """Find the tracks within a distance of each position, or within a larger distance if no track is near."""
    near = network.near(latitude_deg, longitude_deg, within_m=within_m, most=_MOST_TRACKS)
    far = np.abs(near.offset_m[:, 0]) > min(0.5 * within_m, _WITHIN_M)
    if far.any():
        more = network.near(latitude_deg[far], longitude_deg[far], within_m=_FAR * within_m, most=_MOST_FAR)
        for name, values in vars(near).items():
            values[far, :_MOST_FAR], values[far, _MOST_FAR:] = getattr(more, name), _NO_TRACK[name]
    most = max(int((near.track >= 0).sum(axis=1).max()), 1)
    return Candidates(**{name: values[:, :most] for name, values in vars(near).items()})


def _is_wrong(candidates: Candidates, time: Datetimes) -> Masks:
    """Return a mask of the positions that are rejected because they have no candidate track, shape (n,).

    A position is rejected if the last position with a candidate before it and the first position with a candidate after
    it are at most `_WRONG_S` apart.
    """
    near = np.flatnonzero(candidates.track[:, 0] >= 0)
    if not len(near):
        return np.zeros(len(time), dtype=np.bool_)
    after = np.searchsorted(near, np.arange(len(time)))
    before, after = near[np.maximum(after - 1, 0)], near[np.minimum(after, len(near) - 1)]
    inside = (before < np.arange(len(time))) & (after > np.arange(len(time)))
    return np.asarray(inside & ((time[after] - time[before]) / np.timedelta64(1, "s") <= _WRONG_S))


def _scale(residuals: Residuals, track: Indices, correlation_s: float) -> float:
    """Estimate the ratio, at least 1, of actual to stated sigmas from changes of the offset over `correlation_s`."""
    seconds, distance = np.cumsum(residuals.seconds), residuals.offset_m
    rows = np.arange(len(seconds))
    later = np.minimum(np.searchsorted(seconds, seconds + correlation_s), len(rows) - 1)
    same = (track[later] == track[:, :1]) & (track[:, :1] >= 0)
    row = np.flatnonzero(same.any(axis=1) & (later > rows))
    after = later[row]
    change = distance[after, np.argmax(same[row], axis=1)] - distance[row, 0]
    return _median_scale(change / np.hypot(residuals.sigma_m[after], residuals.sigma_m[row]))


def _median_scale(ratio: Floats) -> float:
    """Estimate the standard deviation of normalised values, at least 1, from the median of their absolute values."""
    ratio = np.abs(ratio[np.isfinite(ratio)])
    return max(1.0, float(np.median(ratio)) / _NORMAL_MEDIAN) if len(ratio) else 1.0


def _residuals(
    network: Network,
    log: PlanLog,
    given: Indices,
    candidates: Candidates,
    point_m: Floats,
    sigma_m: Floats,
    correlation_s: float,
) -> Residuals:
    """Compute the residuals of the positions in the rows `given` relative to their candidate tracks."""
    known = candidates.track >= 0
    row = np.nonzero(known)[0]
    track, chainage = candidates.track[known], candidates.chainage_m[known]
    at, ahead, height = network.course_on(track, chainage)
    axes = enu_axes(log.latitude_deg[given], log.longitude_deg[given])[row, :2]
    away, along = ((axes @ vector[..., None])[..., 0] for vector in (point_m[row] - at, ahead))
    right = np.stack([along[:, 1], -along[:, 0]], axis=-1)
    ahead_m = np.einsum("ij,ij->i", away, along)
    outward = np.where(ahead_m > 0.0, chainage >= network.length_m[track] - 1e-6, chainage <= 1e-6)

    def over(values: Floats, empty: float) -> Floats:
        full = np.full((*known.shape, *values.shape[1:]), empty)
        full[known] = values
        return full

    offset = over(np.einsum("ij,ij->i", away, right), np.inf)
    lowered = np.full(len(row), np.nan) if log.height_m is None else log.height_m[given[row]] - height
    above = over(lowered - (ANTENNA_UP_M if log.antenna_up_m is None else log.antenna_up_m), np.nan)
    spread = np.nanmax(above, axis=1, initial=-np.inf) - np.nanmin(above, axis=1, initial=np.inf)
    counts = not np.isnan(network.height_m).any() and bool((spread > _APART_UP_M).any())
    seconds = np.concatenate([[0.0], np.diff(log.time[given]) / np.timedelta64(1, "s")])
    # where the time is missing or decreases, rows are assumed to be `_STEP_S` apart
    seconds = np.round(np.where(seconds >= 0.0, seconds, _STEP_S), 1).astype(np.float64)
    weight = np.clip(seconds / correlation_s, 1e-3, 1.0)
    weight[0] = 1.0
    sigma_up = np.full(len(given), np.nan) if log.sigma_up_m is None else log.sigma_up_m[given]
    sigma_up = np.where(np.isfinite(sigma_up), sigma_up, 2.0 * sigma_m)
    # increase the height sigmas, because reflections bias heights to one side for minutes
    sigma_up = sigma_up * _median_scale(np.nanmin(np.abs(above), axis=1, initial=np.inf) / sigma_up)
    axis, beyond = over(right, 0.0), over(np.where(outward, ahead_m, 0.0), 0.0)
    of_antenna = ANTENNA_SIGMA_M if log.antenna_up_m is None else 0.0
    of_codes = _COMMON_SHARE * float(np.quantile(sigma_up, _BEST))
    return Residuals(
        across=axis,
        offset_m=offset,
        beyond_m=beyond,
        above_m=above,
        **_beside(candidates.track, axis, offset, beyond),
        sigma_m=sigma_m,
        sigma_up_m=sigma_up,
        weight=weight,
        seconds=seconds,
        # includes the error of the map's datum transformation, which is common to all positions
        common_m=float(np.hypot(min(_COMMON_SHARE * np.quantile(sigma_m, _BEST), _COMMON_M), network.datum_plan_m)),
        common_up_m=float(np.linalg.norm([of_codes, of_antenna, network.sigma_height_m])) if counts else 0.0,
    )


def _beside(track: Indices, across: Floats, offset_m: Floats, beyond_m: Floats) -> dict[str, Any]:
    """Compute the fields of `Residuals` that describe parallel unmapped tracks: `clear`, `moved_m` and `turned`."""
    cosine = np.einsum("nmi,ni->nm", across, across[:, 0])
    offset = np.where(np.isfinite(offset_m), offset_m, 0.0)
    right_m = offset[:, :1] - offset * cosine  # distance of each candidate to the right of the nearest track
    there = np.isfinite(offset_m) & (np.abs(beyond_m) <= CLEARANCE_M)  # the position is not beyond an end of the track
    apart = np.where(there, np.abs(SHIFTS_M[:, None, None] - right_m), np.inf).min(axis=2)
    clear = (apart.T > CLEARANCE_M - _ROUNDED_M) & there[:, :1]
    before = np.concatenate([track[:1, :1], track[:-1, :1]])  # the nearest track of the previous position
    same = (track == before) & (before >= 0)
    rows, column = np.arange(len(track)), same.argmax(axis=1)
    known = same.any(axis=1)
    moved = np.where(known, -right_m[rows, column] * np.sign(cosine[rows, column]), 0.0)
    return {"clear": clear, "moved_m": moved, "turned": known & (cosine[rows, column] < 0.0)}


def _spread(matched: Matched, rows: Indices, count: int) -> Matched:
    """Expand matched positions, which are in `rows` of a log, to all `count` rows; the other rows have no match."""

    def over(values: Any, empty: float) -> Any:
        full = np.full((count, *values.shape[1:]), empty, dtype=values.dtype)
        full[rows] = values
        return full

    own = {name: over(values, _NO_MATCH[name]) for name, values in vars(matched).items() if name in _NO_MATCH}
    near = {name: over(values, _NO_TRACK[name]) for name, values in vars(matched.candidates).items()}
    return Matched(**own, candidates=Candidates(**near), notes=matched.notes)
