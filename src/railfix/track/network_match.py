"""Positions of a run on a network of tracks: the track of each, and how probable it is.

A hidden Markov model over the log (Newson & Krumm 2009, doi:10.1145/1653771.1653818): a state is a track near the
position or none of them; the likelihood is that of the distance in plan; a train changes to another track only over
navigable connections whose way fits the distance run. Errors of neighbouring positions are common to them, so each
position counts for the share of the correlation time that it covers.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from os import PathLike
from typing import Any, Final, Unpack

import numpy as np
from scipy.spatial import cKDTree

from railfix.core.arrays import Datetimes, Floats, Indices
from railfix.core.errors import InputFileError, MismatchError
from railfix.core.files import ending
from railfix.core.geodesy import ecef_from_geodetic, geodetic_from_ecef
from railfix.io.named_columns import read_named_columns
from railfix.io.nmea import read_any_positions
from railfix.io.position_log import positions_times, renamed
from railfix.track.crs import kind_of_frame
from railfix.track.frames import FrameShift, MapMotion, in_map_frame
from railfix.track.network import Candidates, Network
from railfix.track.track import ANOTHER_PLACE_M, SIGMA_PLAN_M

#: Negative logarithm of the likelihood of a position on a track that the map does not have, beside one at distance 0.
_UNMAPPED_COST: Final = 12.0
#: Cost of passing from one track to another without a connection, and of leaving or entering the map.
_JUMP_COST: Final = 18.0
_LEAVE_COST: Final = 6.0
#: Standard deviation of the distance of a position from its track where its log states none [m].
SIGMA_M: Final = 2.0
#: Way by which the connection between two places may exceed their straight distance [m], and its share of it: a bend
#: between two positions, as in a tunnel.
_SLACK_M: Final = 30.0
_SLACK_SHARE: Final = 0.2


@dataclass(frozen=True, kw_only=True)
class PlanLog:
    """Positions in plan, n rows.

    Attributes
    ----------
    path : str
    time : ndarray of datetime64[ns], shape (n,)
        NaT where the log has none.
    latitude_deg, longitude_deg : ndarray, shape (n,)
        NaN where a row has no position.
    sigma_m : ndarray, shape (n,) [m]
        Standard deviation of one horizontal axis; NaN where the log has none.
    """

    path: str
    time: Datetimes
    latitude_deg: Floats
    longitude_deg: Floats
    sigma_m: Floats

    def in_frame_of(self, network: Network, **motion: Unpack[MapMotion]) -> tuple[PlanLog, FrameShift]:
        """The positions, which are in the frame of the satellites, in that of the network.

        MismatchError: when there is no position, no time of the log in a network whose frame moves, or the network is
        of another region. SettingsError: as for `railfix.track.frames.points_at`.
        """
        _check_region(network, self)
        times = self.time[~np.isnat(self.time)]
        if not len(times) and kind_of_frame(network.frame) not in ("wgs84", "older datum"):
            raise MismatchError(
                f"{self.path}: has no times, which the shift to the frame of the map needs; give positions in the "
                "frame of the map (--same-frame)"
            )
        time = np.sort(times)[len(times) // 2] if len(times) else np.datetime64("now", "ns")
        ecef = ecef_from_geodetic(self.latitude_deg, self.longitude_deg, np.zeros(len(self.latitude_deg)))
        moved, shift = in_map_frame(ecef, network.frame, time, named=network.named, **motion)
        latitude, longitude, _ = geodetic_from_ecef(moved)
        return replace(self, latitude_deg=latitude, longitude_deg=longitude), shift


def _check_region(network: Network, log: PlanLog) -> None:
    """Raise MismatchError where every position lies further than `ANOTHER_PLACE_M` from the network."""
    known = np.isfinite(log.latitude_deg) & np.isfinite(log.longitude_deg)
    if not known.any():
        return
    latitude, longitude, tree = log.latitude_deg[known], log.longitude_deg[known], cKDTree(network.points_m)
    zeros = np.zeros(len(latitude))
    apart = float(np.min(tree.query(ecef_from_geodetic(latitude, longitude, zeros))[0]))
    if apart <= ANOTHER_PLACE_M:
        return
    turned = ecef_from_geodetic(np.clip(longitude, -90.0, 90.0), latitude, zeros)
    swapped = float(np.min(tree.query(turned)[0])) <= ANOTHER_PLACE_M
    what = (
        "latitude and longitude are swapped in one of them" if swapped else "is it the map of that line, its CRS right?"
    )
    raise MismatchError(f"{log.path}: the map lies {apart / 1000.0:.0f} km from where the log was recorded; {what}")


@dataclass(frozen=True, kw_only=True)
class Matched:
    """Positions on a network, n rows.

    Attributes
    ----------
    track : ndarray of int, shape (n,)
        The most probable sequence; -1 where no track of the map fits, and where there is no position.
    chainage_m, offset_m : ndarray, shape (n,)
        On that track, and distance in plan, positive to its right; NaN without a track.
    probability : ndarray, shape (n,)
        Of that track given the whole log; NaN where there is no position.
    candidates : Candidates
    probabilities : ndarray, shape (n, m)
        Of each candidate; the rest to 1 is that of no mapped track. NaN where there is no position.
    """

    track: Indices
    chainage_m: Floats
    offset_m: Floats
    probability: Floats
    candidates: Candidates
    probabilities: Floats


def read_plan_positions(path: str | PathLike[str], *, columns: Mapping[str, str] | None = None) -> PlanLog:
    """Read positions in plan: any log of positions, or a CSV of latitude and longitude without heights.

    The columns of a CSV are given by their names in railfix (``latitude_deg``, ``longitude_deg``, ``time_gpst``).
    InputFileError: when the file is not a log of positions.
    """
    if ending(path) == ".csv":
        table = renamed(read_named_columns(path), dict(columns or {}))
        if "latitude_deg" in table and "longitude_deg" in table:
            return PlanLog(
                path=str(path),
                time=positions_times(table),
                latitude_deg=table.numbers("latitude_deg", blank=np.nan),
                longitude_deg=table.numbers("longitude_deg", blank=np.nan),
                sigma_m=np.full(len(table), np.nan),
            )
    elif columns:
        raise InputFileError(path, "columns can be renamed in a .csv file only")
    log = read_any_positions(path)
    latitude, longitude, _ = geodetic_from_ecef(log.ecef_m)
    sigma = np.sqrt((log.sigma_m[:, :2] ** 2).mean(axis=1))
    return PlanLog(path=str(path), time=log.time, latitude_deg=latitude, longitude_deg=longitude, sigma_m=sigma)


def match(
    network: Network,
    log: PlanLog,
    *,
    sigma_m: float | None = None,
    within_m: float = 30.0,
    correlation_s: float = 20.0,
) -> Matched:
    """Match positions of a run to the tracks of a network.

    Parameters
    ----------
    log : PlanLog
        In the order of travel, in the frame of the network.
    sigma_m : float, optional [m]
        Standard deviation of the distance between position and track, map included; by default that of the log
        with `SIGMA_PLAN_M` of the map, and `SIGMA_M` where the log has none.
    within_m : float [m]
        Farthest track considered.
    correlation_s : float [s]
        Time over which position errors persist.

    Raises
    ------
    MismatchError
        There is no position.
    """
    given = np.flatnonzero(np.isfinite(log.latitude_deg))
    if not len(given):
        raise MismatchError(f"{log.path}: has no position")
    latitude, longitude = log.latitude_deg[given], log.longitude_deg[given]
    candidates = network.near(latitude, longitude, within_m=within_m)
    n, m = candidates.track.shape
    point = ecef_from_geodetic(latitude, longitude, np.zeros(n))
    step = np.linalg.norm(np.diff(point, axis=0), axis=1)
    seconds = np.diff(log.time[given]) / np.timedelta64(1, "s")
    weight = np.concatenate([[1.0], np.clip(np.where(np.isfinite(seconds), seconds, 0.4) / correlation_s, 1e-3, 1.0)])
    known = candidates.track >= 0
    sigma = np.full(n, sigma_m) if sigma_m is not None else np.hypot(log.sigma_m[given], SIGMA_PLAN_M)
    sigma = np.where(np.isfinite(sigma), sigma, SIGMA_M)[:, None]
    cost = np.full((n, m + 1), np.inf)
    cost[:, :m] = np.where(known, 0.5 * (np.where(known, candidates.offset_m, 0.0) / sigma) ** 2, np.inf)
    cost[:, m] = _UNMAPPED_COST
    path, gamma = _decode(cost * weight[:, None], _Transitions(network, candidates, step))
    rows, mapped = np.arange(n), path < m
    column = np.minimum(path, m - 1)
    found = Matched(
        track=np.where(mapped, candidates.track[rows, column], -1),
        chainage_m=np.where(mapped, candidates.chainage_m[rows, column], np.nan),
        offset_m=np.where(mapped, candidates.offset_m[rows, column], np.nan),
        probability=gamma[rows, path],
        candidates=candidates,
        probabilities=gamma[:, :m],
    )
    return found if n == len(log.time) else _spread(found, given, len(log.time))


def _spread(matched: Matched, rows: Indices, count: int) -> Matched:
    """Matched positions put on their rows of a log, the others without."""

    def over(values: Any, empty: float) -> Any:
        full = np.full((count, *values.shape[1:]), empty, dtype=values.dtype)
        full[rows] = values
        return full

    near = matched.candidates
    return Matched(
        track=over(matched.track, -1),
        chainage_m=over(matched.chainage_m, np.nan),
        offset_m=over(matched.offset_m, np.nan),
        probability=over(matched.probability, np.nan),
        candidates=Candidates(
            track=over(near.track, -1), chainage_m=over(near.chainage_m, np.nan), offset_m=over(near.offset_m, np.inf)
        ),
        probabilities=over(matched.probabilities, np.nan),
    )


class _Transitions:
    """Cost of each passage from the candidates of an epoch to those of the next."""

    def __init__(self, network: Network, candidates: Candidates, step_m: Floats) -> None:
        self._network = network
        self._track, self._place = candidates.track, candidates.chainage_m
        self._reach = (1.0 + _SLACK_SHARE) * step_m + _SLACK_M
        #: Ways from an end of a track to the ends of others, and how far they were looked for.
        self._ways: dict[tuple[int, int], tuple[float, dict[int, float]]] = {}
        self._rest = np.where(self._track >= 0, network.length_m[self._track], np.nan) - self._place
        to_end = np.fmin(self._place, self._rest)
        #: Whether an end of the track is within reach, before and after each passage, shapes (n - 1, m).
        self._leaves = to_end[:-1] <= self._reach[:, None]
        self._enters = to_end[1:] <= self._reach[:, None]

    def __call__(self, k: int) -> Floats:
        """Costs from epoch k to k + 1, shape (m + 1, m + 1)."""
        before, after = self._track[k], self._track[k + 1]
        m = len(before)
        same = (before[:, None] == after) & (before[:, None] >= 0)
        cost = np.full((m + 1, m + 1), _LEAVE_COST)
        cost[m, m] = 0.0
        cost[:m, :m] = np.where(same, 0.0, _JUMP_COST)
        for i, j in np.argwhere(self._leaves[k][:, None] & self._enters[k] & ~same).tolist():
            if self._connected(k, i, j):
                cost[i, j] = 0.0
        return cost

    def _connected(self, k: int, i: int, j: int) -> bool:
        """Whether a train can have run from one place to the other in the distance between two positions."""
        a, b, reach = int(self._track[k, i]), int(self._track[k + 1, j]), float(self._reach[k])
        for end, rest in enumerate((float(self._place[k, i]), float(self._rest[k, i]))):
            if rest > reach:
                continue
            ways = self._from(a, end, reach)
            for entry, into in enumerate((float(self._place[k + 1, j]), float(self._rest[k + 1, j]))):
                if rest + ways.get(4 * b + 2 * entry, np.inf) + into <= reach:
                    return True
        return False

    def _from(self, track: int, end: int, reach_m: float) -> dict[int, float]:
        import networkx as nx

        searched, ways = self._ways.get((track, end), (-1.0, {}))
        node = 4 * track + 2 * end + 1
        if searched < reach_m and node in self._network.graph:
            ways = dict(nx.single_source_dijkstra_path_length(self._network.graph, node, cutoff=reach_m))
            self._ways[track, end] = (reach_m, ways)
        return ways


def _decode(cost: Floats, moves: _Transitions) -> tuple[Indices, Floats]:
    """Most probable sequence of states (Viterbi) and the probability of each state (forward, backward)."""
    n, states = cost.shape
    best, back = cost[0].copy(), np.zeros((n, states), dtype=np.intp)
    forward = np.zeros((n, states))
    forward[0] = _normal(np.exp(-(cost[0] - cost[0].min())))
    passages = []
    for k in range(1, n):
        move = moves(k - 1)
        passages.append(np.exp(-move))
        total = best[:, None] + move
        back[k] = np.argmin(total, axis=0)
        best = total[back[k], np.arange(states)] + cost[k]
        forward[k] = _normal((forward[k - 1] @ passages[-1]) * np.exp(-(cost[k] - cost[k].min())))
    backward = np.ones((n, states))
    for k in range(n - 2, -1, -1):
        backward[k] = _normal(passages[k] @ (np.exp(-(cost[k + 1] - cost[k + 1].min())) * backward[k + 1]))
    gamma = forward * backward
    path = np.zeros(n, dtype=np.intp)
    path[-1] = int(np.argmin(best))
    for k in range(n - 1, 0, -1):
        path[k - 1] = back[k, path[k]]
    return path, gamma / gamma.sum(axis=1, keepdims=True)


def _normal(weights: Floats) -> Floats:
    return np.asarray(weights / weights.sum())


def route_of(network: Network, matched: Matched) -> tuple[list[int], list[int]]:
    """Tracks that a run passed, in the order of travel, and those that it may have passed but no route can join to
    them.

    Gaps are filled with the shortest way over navigable connections. A train that runs back over tracks it has
    passed stays on the same route; where it runs back over others, the map has a gap, or positions jump to a track
    beside, the less probable ones are left out. The route is empty where no position is on a track.
    """
    seen = matched.track[matched.track >= 0]
    if not len(seen):
        return [], []
    passed = [int(t) for t in seen[np.concatenate([[True], np.diff(seen) != 0])]]
    if (route := network.route_over(passed)) is not None:
        return route, []
    share = {t: float(matched.probabilities[matched.candidates.track == t].sum()) for t in set(passed)}
    # the train turned back, the map has a gap, or positions lay on a track that was not passed
    routes = [*_legs(network, passed), *(_most_of(network, order, share) for order in (passed, passed[::-1]))]
    route = max(routes, key=lambda leg: sum(share.get(t, 0.0) for t in set(leg)))
    return route, [t for t in dict.fromkeys(passed) if t not in route]


def _legs(network: Network, passed: list[int]) -> list[list[int]]:
    """The longest parts of a sequence of tracks that are a route."""
    legs: list[list[int]] = []
    start = 0
    while start < len(passed):
        rest = passed[start:]
        # the longest prefix that is a route: every prefix of one is
        count = bisect_left(range(2, len(rest) + 1), 1, key=partial(_ends_a_leg, network, rest)) + 1
        legs.append(network.shortest_route(rest[:count]))
        if count == len(rest):
            break
        start += max(count - 1, 1)
    return legs


def _most_of(network: Network, passed: list[int], share: Mapping[int, float]) -> list[int]:
    """A route over the most probable tracks, in the order in which each first comes: every part of one is a route."""
    rest, kept = sorted(share, key=lambda track: -share[track]), list[int]()

    def is_none(count: int) -> int:
        wanted = {*kept, *rest[:count]}
        return int(network.route_over([t for t in dict.fromkeys(passed) if t in wanted]) is None)

    while rest:
        count = bisect_left(range(1, len(rest) + 1), 1, key=is_none)
        kept += rest[:count]
        rest = rest[count + 1 :]
    return network.shortest_route([t for t in dict.fromkeys(passed) if t in kept])


def _ends_a_leg(network: Network, passed: list[int], count: int) -> int:
    """1 where no route leads over the first tracks, else 0."""
    return int(network.route_over(passed[:count]) is None)
