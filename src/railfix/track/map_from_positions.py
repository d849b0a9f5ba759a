"""Track maps from accurate positions of a run, for lines without a map (P1 4.2(1))."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType
from typing import Final

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, Indices, Masks
from railfix.core.errors import InputFileError, NoPositionError
from railfix.core.geodesy import axes_at
from railfix.core.notebook import plural
from railfix.core.settings import Settings
from railfix.core.timescale import seconds
from railfix.io.position_log import PositionLog, qualities_in_words
from railfix.track.track import SIGMA_HEIGHT_M, SIGMA_PLAN_M, Provenance, Track

#: Note in every map made from positions.
ANTENNA_PATH = "the track was made from positions of an antenna: it is that antenna's path, not the centreline"
_TURN: Final = -0.5  #: Cosine of 120 degrees, the change of direction beyond which the path counts as reversed.
#: An outlier is farther from the straight line between its neighbours than three limits. The first limit is this value
#: [m].
_BESIDE_M: Final = 5.0
_BESIDE_MEDIANS: Final = 6.0  #: The second limit for outliers is this multiple of the median distance.
#: The third limit for outliers is the middle ordinate of a curve with this radius [m] between the neighbours.
_LEAST_RADIUS_M: Final = 150.0
_ROUNDS: Final = 20  #: Largest number of searches for outliers. Each search leaves out the outliers found before.
_ENOUGH: Final = 10  #: Minimum number of positions for a search for outliers.
#: Largest acceleration of the train. A position's deviation along the line is reduced by what this acceleration can
#: cause.
_ACCELERATION_MPS2: Final = 2.0
#: The path between the neighbours of a position counts as straight if both neighbours are within this time [s].
_NEAR_S: Final = 2.5
#: The path also counts as straight if its directions before and after the position are nearly parallel to the line
#: between the neighbours. The value is the smallest accepted cosine of the angles to this line.
_STRAIGHT: Final = 0.87
#: Half length of the window over which the displacement is computed to detect standstill [s].
_STANDING_WINDOW_S: Final = 3.0


class ThinningLimits(Settings):
    """Limits for the selection of positions as points of a map."""

    spacing_m: float = Field(default=5.0, gt=0)  #: Smallest distance between consecutive points.
    #: Largest deviation of positions from the chord between two points (P1 4.1(3): 0.30 m). If the deviation is larger,
    #: the farthest position also becomes a point. This limit requires times, to distinguish a bend from noise at
    #: standstill.
    chord_m: float = Field(default=0.30, gt=0)
    #: Horizontal speed below which the antenna counts as stationary. Positions at standstill are dropped, because their
    #: changes are noise or drift. This limit requires times. With 0, all positions are kept.
    standing_mps: float = Field(default=0.2, ge=0)
    #: Distance between consecutive points above which a gap is reported.
    jump_m: float = Field(default=50.0, gt=0)
    gap_m: float = Field(default=2000.0, gt=0)  #: Longest gap that is bridged; a longer gap is an error.
    #: Largest speed of the vehicle. Positions that can be reached only at a higher speed are dropped. If times are
    #: unknown, positions farther than `gap_m` from the adjacent positions are dropped instead.
    speed_mps: float = Field(default=150.0, gt=0)


@dataclass(frozen=True, kw_only=True)
class Thinned:
    """Result of the selection of positions."""

    kept: Indices  #: Rows of the positions that became points of the map, in ascending order, shape (V,).
    dropped: dict[str, int]  #: Number of dropped rows by reason.
    jumps: Indices  #: Indices of points before a gap that exceeds `ThinningLimits.jump_m`, shape (j,).
    jump_m: Floats  #: Length of the gap after each point in `jumps`, shape (j,).
    #: Indices of points at which the path turns by more than 120 degrees, shape (t,). The cause is a reversal or a
    #: wrong position.
    turns: Indices


def stationary(time: Datetimes, ecef_m: Floats, *, speed_mps: float, window_s: float) -> Masks:
    """Return a mask of the rows at which the antenna is stationary, shape (T,).

    A row is stationary if the horizontal displacement, from `window_s` before it to `window_s` after it, is less than
    `speed_mps` times the elapsed time. Times must rise. If a time is NaT, no row is stationary.
    """
    if len(time) < 3 or np.isnat(time).any() or speed_mps == 0.0:
        return np.zeros(len(time), dtype=np.bool_)
    t = seconds(time - time[0])
    first = np.searchsorted(t, t - window_s - 1e-6, side="left")
    last = np.searchsorted(t, t + window_s + 1e-6, side="right") - 1
    moved = np.einsum("tij,tj->ti", axes_at(ecef_m), ecef_m[last] - ecef_m[first])
    distance = np.hypot(moved[:, 0], moved[:, 1])
    # the data must cover at least half of the window
    known = t[last] - t[first] >= window_s
    return np.asarray(known & (distance < speed_mps * (t[last] - t[first])))


def thin(
    time: Datetimes, ecef_m: Floats, *, usable: Masks | None = None, limits: ThinningLimits | None = None
) -> Thinned:
    """Select the positions, shape (n, 3) ECEF [m], that become points of a map.

    First, rows are dropped that are NaN, not `usable`, out of reach, outliers, or stationary, so that noise and drift
    at standstill cause no loops. The selected points are at least `ThinningLimits.spacing_m` apart, except in bends
    (`ThinningLimits.chord_m`). The last position is also kept if it is at least a fifth of the spacing beyond the point
    before it.
    """
    limits = limits or ThinningLimits()
    finite = np.isfinite(ecef_m).all(axis=1)
    good = finite if usable is None else finite & usable
    rows = np.flatnonzero(good)
    reachable = _reachable(time[rows], ecef_m[rows], limits)
    rows, out_of_reach = rows[reachable], int(np.count_nonzero(~reachable))
    beside = _outliers(time[rows], ecef_m[rows])
    rows, wrong = rows[~beside], int(np.count_nonzero(beside))
    stands = stationary(time[rows], ecef_m[rows], speed_mps=limits.standing_mps, window_s=_STANDING_WINDOW_S)
    stands = _with_short_moves(ecef_m[rows], stands, limits.spacing_m)
    moving = rows[~stands]
    chosen = _at_spacing(ecef_m[moving], limits.spacing_m)
    steps = np.diff(ecef_m[moving[chosen]], axis=0)
    length = np.linalg.norm(steps, axis=1)
    cosine = np.einsum("vi,vi->v", steps[1:], steps[:-1]) / (length[1:] * length[:-1])
    back = chosen[np.flatnonzero(cosine < _TURN) + 1]
    if not np.isnat(time[moving]).any():
        chosen = _with_bends(ecef_m[moving], chosen, limits.chord_m)
    kept = moving[chosen]
    length = np.linalg.norm(np.diff(ecef_m[kept], axis=0), axis=1)
    jumps = np.flatnonzero(length > limits.jump_m)
    return Thinned(
        kept=kept,
        dropped={
            "without a position": int((~finite).sum()),
            "of insufficient quality": int((finite & ~good).sum()),
            "out of reach of the others": out_of_reach,
            "off the line of their neighbours": wrong,
            "standing still": int(stands.sum()),
            "nearer than the spacing": len(moving) - len(kept),
        },
        jumps=jumps,
        jump_m=length[jumps],
        turns=np.searchsorted(chosen, back),
    )


def _reachable(time: Datetimes, ecef_m: Floats, limits: ThinningLimits) -> Masks:
    """Return a mask of the rows that one vehicle can reach in succession, shape (n,).

    The search starts from the longest part without a jump, and continues towards both ends of the log.
    """
    if len(ecef_m) < 2:
        return np.ones(len(ecef_m), dtype=np.bool_)
    timed = not np.isnat(time).any()

    def possible(first: int, last: int) -> bool:
        distance = float(np.linalg.norm(ecef_m[last] - ecef_m[first]))
        if timed:
            lasted = float(seconds(time[last] - time[first]))
            return distance <= limits.speed_mps * max(lasted, 1.0)
        return distance <= limits.gap_m

    step = np.linalg.norm(np.diff(ecef_m, axis=0), axis=1)
    reach = limits.speed_mps * np.maximum(seconds(np.diff(time)), 1.0) if timed else np.full(len(step), limits.gap_m)
    edges = [0, *(np.flatnonzero(step > reach) + 1).tolist(), len(ecef_m)]
    pieces = list(pairwise(edges))
    longest = max(range(len(pieces)), key=lambda i: pieces[i][1] - pieces[i][0])
    kept = np.zeros(len(ecef_m), dtype=np.bool_)
    low, high = pieces[longest][0], pieces[longest][1] - 1
    kept[low : high + 1] = True
    for first, end in pieces[longest + 1 :]:
        if possible(high, first):
            kept[first:end], high = True, end - 1
    for first, end in reversed(pieces[:longest]):
        if possible(end - 1, low):
            kept[first:end], low = True, first
    return kept


def _outliers(time: Datetimes, ecef_m: Floats) -> Masks:
    """Return a mask of the positions off the straight line between their neighbours, shape (n,).

    The farthest positions are removed first, because they displace the straight lines at the adjacent positions.
    """
    wrong = np.zeros(len(time), dtype=np.bool_)
    if len(time) < _ENOUGH or np.isnat(time).any():
        return wrong
    elapsed = seconds(time - time[0])
    for _ in range(_ROUNDS):
        rows = np.flatnonzero(~wrong)
        if len(rows) < _ENOUGH:
            break
        t, points = elapsed[rows], ecef_m[rows]
        before, after = t[1:-1] - t[:-2], t[2:] - t[1:-1]
        chord, share = points[2:] - points[:-2], before / np.maximum(before + after, 1e-9)
        length = np.maximum(np.linalg.norm(chord, axis=1), 1e-9)
        off = points[1:-1] - points[:-2] - chord * share[:, None]
        along = (off * chord).sum(axis=1) / length
        across = np.sqrt(np.maximum((off**2).sum(axis=1) - along**2, 0.0))
        along = np.maximum(np.abs(along) - 0.5 * _ACCELERATION_MPS2 * before * after, 0.0)
        straight = (np.maximum(before, after) <= _NEAR_S) | _goes_on(points, chord / length[:, None])
        size = np.where(straight, np.hypot(across, along), 0.0)
        of_curve = length**2 / (8.0 * _LEAST_RADIUS_M)
        limit = np.maximum(of_curve, max(_BESIDE_M, _BESIDE_MEDIANS * float(np.median(size))))
        around = np.pad(size, 1)
        farthest = (size > limit) & (size >= around[:-2]) & (size > around[2:])
        if not farthest.any():
            break
        wrong[rows[1:-1][farthest]] = True
    return wrong


def _goes_on(points: Floats, direction: Floats) -> Masks:
    """Return a mask of the inner points at which the path is straight, given the `direction` between both neighbours.

    On each side of a point, its neighbour is joined to the next and to the second next point. One of these two steps
    must be nearly parallel to `direction`; the point of the other step may be an outlier.
    """
    cosine = np.full((2, 2, len(direction)), -1.0)
    for span in (1, 2):
        step = points[span:] - points[:-span]
        step = step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
        inner = slice(span, len(direction))
        cosine[0, span - 1, inner] = (step[: len(direction) - span] * direction[inner]).sum(axis=1)
        inner = slice(0, len(direction) - span)
        cosine[1, span - 1, inner] = (step[2 : 2 + len(direction) - span] * direction[inner]).sum(axis=1)
    return np.asarray(cosine.max(axis=1).min(axis=0) >= _STRAIGHT)


def _with_short_moves(points: Floats, stands: Masks, spacing_m: float) -> Masks:
    """Extend the mask of stationary rows by movements that are shorter than the spacing and between standstills."""
    if not stands.any():
        return stands
    edges = np.flatnonzero(np.diff(stands)) + 1
    result = stands.copy()
    for first, end in pairwise([0, *edges.tolist(), len(stands)]):
        extent = np.linalg.norm(points[first:end] - points[first], axis=1).max()
        result[first:end] |= extent < spacing_m
    return result


def _at_spacing(points: Floats, spacing_m: float) -> Indices:
    """Return the indices of points that are at least the spacing apart.

    The last point is also returned if it is at least a fifth of the spacing beyond the point before it.
    """
    if not len(points):
        return np.zeros(0, dtype=np.intp)
    kept = [0]
    block = 64
    start = 1
    while start < len(points):
        offset = np.linalg.norm(points[start : start + block] - points[kept[-1]], axis=1)
        far = offset >= spacing_m - 1e-6
        if far.any():
            kept.append(start + int(np.argmax(far)))
            start = kept[-1] + 1
        else:
            start += block
    if kept[-1] != len(points) - 1 and len(kept) > 1:
        last, before = points[-1] - points[kept[-1]], points[kept[-1]] - points[kept[-2]]
        if np.linalg.norm(last) >= 0.2 * spacing_m and float(last @ before) > 0:
            kept.append(len(points) - 1)
    return np.array(kept, dtype=np.intp)


def _with_bends(points: Floats, chosen: Indices, chord_m: float) -> Indices:
    """Return the chosen points and, for each chord with points more than `chord_m` away, the farthest point."""
    if len(chosen) < 2:
        return chosen
    piece = np.searchsorted(chosen, np.arange(len(points)), side="right") - 1
    inside = np.flatnonzero((piece >= 0) & (piece < len(chosen) - 1) & ~np.isin(np.arange(len(points)), chosen))
    piece = piece[inside]
    start, step = points[chosen[piece]], points[chosen[piece + 1]] - points[chosen[piece]]
    share = np.einsum("ni,ni->n", points[inside] - start, step) / np.einsum("ni,ni->n", step, step)
    off = np.linalg.norm(points[inside] - start - share[:, None] * step, axis=1)
    # leave out points near an end of the chord, which would cause a kink
    off = np.where((share > 0.2) & (share < 0.8), off, 0.0)
    worst = np.zeros(len(chosen) - 1)
    np.maximum.at(worst, piece, off)
    bends = np.flatnonzero((off > chord_m) & (off == worst[piece]))
    _, first = np.unique(piece[bends], return_index=True)
    return np.sort(np.concatenate([chosen, inside[bends[first]]]))


def from_positions(
    time: Datetimes,
    ecef_m: Floats,
    *,
    spacing_m: float = 5.0,
    usable: Masks | None = None,
    limits: ThinningLimits | None = None,
    name: str = "positions",
    sigma_plan_m: float = SIGMA_PLAN_M,
    sigma_height_m: float = SIGMA_HEIGHT_M,
) -> Track:
    """Create a track from positions, shape (n, 3) ECEF [m], in the order of travel.

    The positions are selected by `thin`. Unknown times are NaT. `usable` is a mask of the rows that may be used.
    `spacing_m` is ignored if `limits` are given. The notes of the track report gaps and reversals, and that the track
    is the path of the antenna. Raise ValueError if fewer than two points remain, or a gap is too long.
    """
    thinned = thin(time, ecef_m, usable=usable, limits=limits or ThinningLimits(spacing_m=spacing_m))
    return create_track(ecef_m, thinned, name=name, sigma_plan_m=sigma_plan_m, sigma_height_m=sigma_height_m)


def create_track(
    ecef_m: Floats,
    thinned: Thinned,
    *,
    name: str = "positions",
    files: tuple[str, ...] = (),
    sigma_plan_m: float = SIGMA_PLAN_M,
    sigma_height_m: float = SIGMA_HEIGHT_M,
    gap_m: float = 2000.0,
    accuracy: str = "",
) -> Track:
    """Create a track from the positions selected by `thin`.

    Raise ValueError if fewer than two points remain, or a gap is longer than `gap_m`.
    """
    if len(thinned.kept) < 2:
        dropped = ", ".join(f"{count} {reason}" for reason, count in thinned.dropped.items() if count)
        dropped = f" ({dropped})" if dropped else ""
        raise ValueError(f"{len(thinned.kept)} of {len(ecef_m)} positions are left, but a track needs two{dropped}")
    notes = [ANTENNA_PATH, *([accuracy] if accuracy else [])]
    if thinned.jump_m.max(initial=0.0) > gap_m:
        raise ValueError(
            f"the positions have a gap of {thinned.jump_m.max():.0f} m; gaps of more than {gap_m:g} m are not bridged "
            "by a straight line; give the positions of one run"
        )
    if len(thinned.jumps):
        notes.append(
            f"{plural(thinned.jumps, 'gap')} between positions bridged by a straight line, "
            f"the longest {thinned.jump_m.max():.0f} m"
        )
    if len(thinned.turns):
        notes.append(
            f"the path turns back at {plural(thinned.turns, 'point')}: where its two legs are side by side, positions "
            "are ambiguous and the filter may follow the wrong leg. Give positions of a run in one direction"
        )
    return Track.from_ecef(
        ecef_m[thinned.kept],
        name=name,
        sigma_plan_m=sigma_plan_m,
        sigma_height_m=sigma_height_m,
        provenance=Provenance(files=files, notes=tuple(notes)),
    )


def usable_rows(log: PositionLog, *, quality: Sequence[int] | None = None, max_sigma_m: float | None = None) -> Masks:
    """Return a mask of the rows of a log with an accepted quality number and standard deviation.

    By default, RTK fixed positions (quality 1) are used. If the log has no quality column, all positions are used.
    Raise InputFileError if the log lacks the column for a given limit, and NoPositionError if no position has an
    accepted quality.
    """
    usable = np.ones(len(log), dtype=np.bool_)
    if quality is not None and not log.has_quality:
        raise InputFileError(log.path, "a quality was given, but the log has no column 'quality'")
    if log.has_quality:
        wanted = (1,) if quality is None else tuple(quality)
        usable &= np.isin(log.quality, wanted)
        if not usable.any():
            accepted = " or ".join(map(str, wanted))
            message = (
                f"no position has quality {accepted}; the log has {qualities_in_words(log)} (--quality accepts others)"
            )
            raise NoPositionError(f"{log.path}: {message}")
    if max_sigma_m is not None:
        if not np.isfinite(log.sigma_m).any():
            raise InputFileError(log.path, "a largest sigma was given, but the log has no standard deviations")
        usable &= log.sigma_m.max(axis=1) <= max_sigma_m
    return usable


#: Standard deviations of positions in plan and in height [m], by RTKLIB quality number. The numbers are 1 RTK fix (with
#: P1's values for a surveyed map), 2 RTK float, 3 SBAS, 4 differential, and 5 single point without corrections.
SIGMA_OF_QUALITY: Final[Mapping[int, tuple[float, float]]] = MappingProxyType(
    {1: (SIGMA_PLAN_M, SIGMA_HEIGHT_M), 2: (0.5, 1.0), 3: (1.5, 3.0), 4: (1.0, 2.0), 5: (3.0, 6.0)}
)


def _accuracy(log: PositionLog, kept: Indices) -> tuple[float, float, str]:
    """Return the standard deviations of a map in plan and height [m], and a note on how they were obtained.

    Each standard deviation is the largest of the log's value, the value for the quality number, and P1's value.
    """
    plan, height = SIGMA_PLAN_M, SIGMA_HEIGHT_M
    stated = log.sigma_m[kept]
    reasons = []
    if np.isfinite(stated).all() and len(stated):
        plan = max(plan, float(np.median(np.hypot(stated[:, 0], stated[:, 1]) / np.sqrt(2.0))))
        height = max(height, float(np.median(stated[:, 2])))
        reasons.append("from the standard deviations of the log")
    if log.has_quality:
        worst = [SIGMA_OF_QUALITY.get(int(q), SIGMA_OF_QUALITY[5]) for q in np.unique(log.quality[kept])]
        plan, height = max([plan, *(w[0] for w in worst)]), max([height, *(w[1] for w in worst)])
        reasons.append("from the quality of the positions")
    basis = " and ".join(reasons) if reasons else "assumed, because the log states neither quality nor sigma"
    return plan, height, f"accuracy of the map {plan:.2f} m in plan, {height:.2f} m in height, {basis}"


def from_position_log(
    log: PositionLog,
    *,
    spacing_m: float = 5.0,
    quality: Sequence[int] | None = None,
    max_sigma_m: float | None = None,
    limits: ThinningLimits | None = None,
    name: str | None = None,
) -> tuple[Track, Thinned]:
    """Create a track from the accurate positions of a log, and return the track and the selection of rows.

    Raise NoPositionError if fewer than two points remain. Raise InputFileError if times decrease, the log lacks the
    column for a given limit, or a gap is too long.
    """
    limits = limits or ThinningLimits(spacing_m=spacing_m)
    usable = usable_rows(log, quality=quality, max_sigma_m=max_sigma_m)
    timed = np.flatnonzero(~np.isnat(log.time))
    back = np.flatnonzero(np.diff(log.time[timed]) < np.timedelta64(0, "ns"))
    if len(back):
        line = int(log.line[timed[back[0] + 1]])
        raise InputFileError(
            log.path, "the time is before the time of the preceding position; sort the positions by time", line=line
        )
    thinned = thin(log.time, log.ecef_m, usable=usable, limits=limits)
    plan, height, accuracy = _accuracy(log, thinned.kept)
    try:
        track = create_track(
            log.ecef_m,
            thinned,
            name=name or "positions",
            files=(log.path,),
            sigma_plan_m=plan,
            sigma_height_m=height,
            gap_m=limits.gap_m,
            accuracy=accuracy,
        )
        return track, thinned
    except ValueError as error:
        if len(thinned.kept) < 2:
            raise NoPositionError(f"{log.path}: {error}") from None
        raise InputFileError(log.path, str(error)) from None
