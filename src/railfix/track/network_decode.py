"""Probability of each track at each position of a log, if the positions have a common error.

The model is a hidden Markov model (Newson & Krumm 2009, doi:10.1145/1653771.1653818). A state of the model is a mapped
or unmapped track near the position, and a value of the common error. The common error is a first-order Gauss-Markov
process in each of the directions east, north and up, on a lattice (Ehrenfest's urn; Kac 1947, doi:10.2307/2304386). The
remaining error of each position has heavy tails (Student's t) and a correlation time `correlation_s`; the log
likelihood of a position is weighted with the fraction of this time that the position represents. An unmapped track is
anywhere, or it is parallel to the nearest track at a constant distance (`SHIFTS_M`) and clear of all other tracks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from railfix.core.array_functions import cheapest_path
from railfix.core.arrays import Floats, Indices, Masks, read_only
from railfix.track.network import CLEARANCE_M, UNMAPPED_PRIOR, Candidates, Network

#: Negative logarithm of the likelihood of a position on an unmapped track that is parallel to no track, relative to a
#: position exactly on a mapped track.
_UNMAPPED_COST: Final = 5.0
#: Distances of a parallel unmapped track to the right of the nearest mapped track [m].
SHIFTS_M: Final = np.concatenate([np.arange(-15.0, -2.0, 2.0), np.arange(3.0, 16.0, 2.0)])
#: Prior probability of each of `SHIFTS_M`, inversely proportional to the distance, because most parallel tracks are
#: near.
_SHARES: Final = 1.0 / np.abs(SHIFTS_M) / (1.0 / np.abs(SHIFTS_M)).sum()
#: Probability per position that the distance of a parallel unmapped track changes to an adjacent value of `SHIFTS_M`.
_DRIFTS: Final = 1e-3
_SHIFT_STEP_M: Final = 2.0  #: Spacing of `SHIFTS_M` on either side [m].
_FREEDOM: Final = 8.0  #: Degrees of freedom of Student's t for position errors.
# Negative logarithms of transition probabilities per position. These values imply that a train is on unmapped track for
# the fraction `UNMAPPED_PRIOR` of the time, in periods of a quarter of an hour. A change of track by way of unmapped
# track is as improbable as a change between unconnected tracks.
_JUMP_COST: Final = 17.0  #: Transition from a mapped track to an unconnected mapped track.
_LEAVE_COST: Final = 12.0  #: Transition from a mapped track to an unmapped track that is parallel to no track.
_ENTER_COST: Final = 5.0  #: Transition to a mapped track from an unmapped track that is parallel to no track.
_LEAVE_BESIDE_COST: Final = 10.0  #: Transition from a mapped track to a parallel unmapped track.
_ENTER_BESIDE_COST: Final = 7.0  #: Transition from a parallel unmapped track to a mapped track.
#: Negative logarithm of the probability of passing an open end, where the map ends.
_OPEN_COST: Final = 2.0
#: A position is off the map if it is more than this number of its standard deviations beyond an open end.
_BEYOND_SIGMAS: Final = 5.0
#: The distance of `_BEYOND_SIGMAS` standard deviations is at least the first and at most the second value [m].
_BEYOND_M: Final = (CLEARANCE_M, 10.0)
_ROUNDED_M: Final = 1e-6
#: A transition is possible if the path exceeds the straight distance between two positions by at most this length [m]
#: plus `_SLACK_SHARE` times the straight distance. In bends, the path is longer than the straight distance.
_SLACK_M: Final = 30.0
#: Fraction of the straight distance; see `_SLACK_M`.
_SLACK_SHARE: Final = 0.2
#: A transition over joints is half as likely if its path is longer than the straight distance by this length [m].
_PASSING_M: Final = 5.0
#: Cost of a change of track in the returned sequence; each pair of successive positions on correct tracks gains 1.
_CHANGE: Final = 0.5
#: Cost of a change of track at a joint; smaller, because a short track in a switch has only one or two positions.
_CHANGE_AT_JOINT: Final = 0.05
_AT_JOINT: Final = 0.01  #: Changes of track that are at least this probable count as changes at a joint.
COMMON_S: Final = 600.0  #: Correlation time of the common error [s].
#: Number of balls in the urn of a horizontal axis. The common error has one more value per axis than the urn has balls.
_BALLS: Final = 12
_BALLS_UP: Final = 8  #: Number of balls in the urn of the vertical axis.
_BLOCK: Final = 1024  #: Number of positions whose probabilities are in memory at once, if heights are not used.


@dataclass(frozen=True, kw_only=True)
class Residuals:
    """Residuals of n positions with up to m candidate tracks each; S is the number of `SHIFTS_M`."""

    across: Floats  #: Unit vector to the right of the track, east and north, shape (n, m, 2).
    offset_m: Floats  #: Distance of the position to the right of the track, shape (n, m); infinite without a candidate.
    beyond_m: Floats  #: Distance beyond an end of the track, shape (n, m): negative at the start, 0 between ends.
    above_m: Floats  #: Height of the position above the expected antenna height, shape (n, m); NaN without a height.
    #: Whether an unmapped track at a distance `SHIFTS_M` from the nearest track is clear of all tracks, shape (n, S).
    clear: Masks
    #: Distance from the previous position's nearest track to the nearest track, positive to the right, shape (n,).
    moved_m: Floats
    #: Whether the nearest track and the previous position's nearest track have opposite directions, shape (n,).
    turned: Masks
    sigma_m: Floats  #: Standard deviation of a position per horizontal axis, shape (n,).
    sigma_up_m: Floats  #: Standard deviation of the height, shape (n,).
    weight: Floats  #: Fraction of the correlation time that a position represents, shape (n,).
    seconds: Floats  #: Time since the previous position, shape (n,).
    common_m: float  #: Standard deviation of the common error per horizontal axis.
    common_up_m: float  #: Standard deviation of the common height error; 0 if heights are not used.


class Transitions:
    """Transition probabilities between the states of successive positions."""

    def __init__(self, network: Network, candidates: Candidates, step_m: Floats, residuals: Residuals) -> None:
        self._network, self._step = network, step_m
        self._track, self._place = candidates.track, candidates.chainage_m
        self._clear, self._moved, self._turned = residuals.clear, residuals.moved_m, residuals.turned
        self._reach = (1.0 + _SLACK_SHARE) * step_m + _SLACK_M
        #: Cached path lengths: the key is a track and one of its ends; the value is the search limit and the path
        #: lengths from this end to `graph` nodes within the limit [m].
        self._ways: dict[tuple[int, int], tuple[float, dict[int, float]]] = {}
        self._rest = np.where(self._track >= 0, network.length_m[self._track], np.nan) - self._place
        to_end = np.fmin(self._place, self._rest)
        #: Whether the train can reach an end of the track from the position before a transition, shape (n - 1, m).
        self._leaves = to_end[:-1] <= self._reach[:, None]
        #: Whether the train can reach, from an end of the track, the position after a transition, shape (n - 1, m).
        self._enters = to_end[1:] <= self._reach[:, None]
        ends = np.array([[(t, e) not in network.passages for e in (0, 1)] for t in range(len(network.tracks))])
        at_end = ends[self._track] & (np.stack([self._place, self._rest], axis=-1) <= _ROUNDED_M)
        beyond = np.abs(residuals.beyond_m) / np.clip(_BEYOND_SIGMAS * residuals.sigma_m, *_BEYOND_M)[:, None]
        opens = at_end.any(axis=2) & (beyond > 1.0)
        self._same = (self._track[:-1, :, None] == self._track[1:, None, :]) & (self._track[:-1, :, None] >= 0)
        #: Whether the train leaves the track over an open end, because the next position is beyond that end; shape (n -
        #: 1, m).
        self._left = (self._same & opens[1:, None, :]).any(axis=2)
        #: Whether the train enters the track over an open end, because the previous position is beyond that end.
        self._entered = (self._same & opens[:-1, :, None]).any(axis=1)
        # errors are assumed not to change by metres in one step, so they do not explain one position beyond the end
        stays = np.where(opens, np.exp(-_student((_BEYOND_SIGMAS * beyond) ** 2)), 1.0)
        #: Likelihoods of remaining on a track, if only the previous or only the next position is beyond an open end.
        self._stays = np.where(self._left, 1.0, stays[:-1]), np.where(self._entered, 1.0, stays[1:])

    @property
    def changes(self) -> Masks:
        """Whether each transition changes the track (unmapped is one track), shape (n - 1, m + 1, m + 1)."""
        state = np.column_stack([np.where(self._track < 0, -2, self._track), np.full(len(self._track), -1)])
        return np.asarray(state[:-1, :, None] != state[1:, None, :])

    def __call__(self, k: int) -> Floats:
        """Return the transition probabilities from position k (row) to k + 1 (column), shape (m + S + 1, m + S + 1).

        The states are the m candidates, the S parallel unmapped tracks, and any other unmapped track.
        """
        m, free, same = self._track.shape[1], self._clear[k + 1] * _SHARES, self._same[k]
        share = np.full((m + len(SHIFTS_M) + 1, m + len(SHIFTS_M) + 1), np.exp(-_LEAVE_COST))
        left, entered = self._left[k], self._entered[k]
        share[:m, -1] = np.where(left, np.exp(-_OPEN_COST), np.exp(-_LEAVE_COST))
        share[-1, :m] = np.where(entered, np.exp(-_OPEN_COST), np.exp(-_ENTER_COST))
        share[-1, -1] = 1.0
        # A log begins on unmapped track with the probability `UNMAPPED_PRIOR`. The transition to unmapped track over an
        # open end has the same factor, so that a run off the map and its reverse are equally probable.
        share[:, m:-1] = np.exp(-_LEAVE_BESIDE_COST) * free
        share[:m, m:-1][left] = UNMAPPED_PRIOR * np.exp(-_OPEN_COST) * free
        share[m:-1, :m] = np.where(entered, np.exp(-_OPEN_COST), np.exp(-_ENTER_BESIDE_COST))
        share[:m, :m] = np.where(same, 1.0, np.exp(-_JUMP_COST))
        share[m:-1, m:-1] = _shifted(float(self._moved[k + 1]), bool(self._turned[k + 1]))
        # an unmapped track can be parallel to a mapped track on a part of its length
        share[-1, m:-1], share[m:-1, -1] = UNMAPPED_PRIOR * free, UNMAPPED_PRIOR * np.exp(-_ENTER_COST)
        for i, j in np.argwhere(self._leaves[k][:, None] & self._enters[k] & ~same).tolist():
            way = self._way(k, i, j)
            if way <= self._reach[k]:
                share[i, j] = 1.0 / (1.0 + ((way - self._step[k]) / _PASSING_M) ** 2)
        share /= share.sum(axis=1, keepdims=True)
        share[:m, :m] *= np.where(same, self._stays[0][k][:, None] * self._stays[1][k], 1.0)
        return share

    def _way(self, k: int, i: int, j: int) -> float:
        """Return the path length from candidate i at position k to candidate j at position k + 1 [m].

        The path leads through track ends. Its length is infinite beyond the search limit.
        """
        a, b, reach = int(self._track[k, i]), int(self._track[k + 1, j]), float(self._reach[k])
        least = np.inf
        for end, rest in enumerate((float(self._place[k, i]), float(self._rest[k, i]))):
            if rest > reach:
                continue
            ways = self._from(a, end, reach)
            for entry, into in enumerate((float(self._place[k + 1, j]), float(self._rest[k + 1, j]))):
                least = min(least, rest + ways.get(4 * b + 2 * entry, np.inf) + into)
        return least

    def _from(self, track: int, end: int, reach_m: float) -> dict[int, float]:
        import networkx as nx

        searched, ways = self._ways.get((track, end), (-1.0, {}))
        node = 4 * track + 2 * end + 1
        if searched < reach_m and node in self._network.graph:
            ways = dict(nx.single_source_dijkstra_path_length(self._network.graph, node, cutoff=reach_m))
            self._ways[track, end] = (reach_m, ways)
        return ways


def _shifted(moved_m: float, turned: bool) -> Floats:
    """Return relative transition probabilities between `SHIFTS_M`, from row to column, shape (S, S).

    The reference track of the columns is `moved_m` to the right of the reference track of the rows. The two reference
    tracks have opposite directions if `turned` is True.
    """
    place = (SHIFTS_M - moved_m) * (-1.0 if turned else 1.0)
    apart = np.abs(place[:, None] - SHIFTS_M)
    nearest = apart == apart.min(axis=1, keepdims=True)
    drifted = _DRIFTS * (apart <= apart.min(axis=1, keepdims=True) + _SHIFT_STEP_M)
    # a track at no known shift is the reference track itself, or too far from it
    known = apart.min(axis=1, keepdims=True) <= _SHIFT_STEP_M
    return np.asarray(np.where(nearest, 1.0, drifted) * known)


@lru_cache(maxsize=256)
def _urn(balls: int, seconds: float) -> tuple[Floats, Floats]:
    """Return the equilibrium probabilities of an urn's states, and the transition matrix over `seconds`."""
    change = 0.5 * (1.0 - np.exp(-seconds / COMMON_S))
    passages = [
        np.convolve(_binomial(inside, 1.0 - change), _binomial(balls - inside, change)) for inside in range(balls + 1)
    ]
    return read_only(_binomial(balls, 0.5)), read_only(np.array(passages))


def _binomial(count: int, share: float) -> Floats:
    values = np.ones(1)
    for _ in range(count):
        values = np.convolve(values, [1.0 - share, share])
    return values


class _CommonError:
    """Lattice of C common errors in plan and U in height; `first` are the initial probabilities, shape (C, U)."""

    def __init__(self, residuals: Residuals) -> None:
        self._balls_up = _BALLS_UP if residuals.common_up_m > 0.0 else 0
        steps = _places(_BALLS, residuals.common_m)
        self.plan_m = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
        self.up_m = _places(self._balls_up, residuals.common_up_m)
        plan = _urn(_BALLS, 0.0)[0]
        self.first = np.outer(np.outer(plan, plan), _urn(self._balls_up, 0.0)[0])

    def later(self, share: Floats, seconds: float) -> Floats:
        """Return the probabilities of lattice points after a number of seconds, shape (..., C, U)."""
        return self._through(share, _urn(_BALLS, seconds)[1].T, _urn(self._balls_up, seconds)[1].T)

    def earlier(self, value: Floats, seconds: float) -> Floats:
        """Return the expectation of `value`, given the lattice point a number of seconds earlier, shape (..., C, U)."""
        return self._through(value, _urn(_BALLS, seconds)[1], _urn(self._balls_up, seconds)[1])

    def _through(self, values: Floats, plan: Floats, up: Floats) -> Floats:
        """Return values multiplied by the transition matrix of each axis in turn.

        The product with one large matrix would be slower, because it would wait for threads.
        """
        axis, heights = len(plan), len(up)
        east = np.matmul(plan, values.reshape(-1, axis, axis * heights))
        north = np.matmul(plan, east.reshape(-1, axis, axis, heights))
        return np.asarray((north @ up.T if heights > 1 else north).reshape(values.shape))


def _places(balls: int, sigma_m: float) -> Floats:
    """Return the values of the common error for the states of an urn, shape (balls + 1,) [m]."""
    return np.asarray((np.arange(balls + 1) - balls / 2.0) * (2.0 * sigma_m / np.sqrt(max(balls, 1))))


def _student(square: Floats) -> Floats:
    """Return the negative log likelihood (Student's t) of squared normalised errors, relative to an error of 0."""
    return np.asarray(0.5 * (_FREEDOM + 1.0) * np.log1p(square / _FREEDOM))


def _likelihood(residuals: Residuals, lattice: _CommonError, k: int) -> Floats:
    """Return the likelihood of position k given each state, up to a common factor, shape (m + S + 1, C, U)."""
    m, offset = residuals.offset_m.shape[1], residuals.offset_m[k]
    known = np.flatnonzero(np.isfinite(offset))
    across, beyond = residuals.across[k, known], residuals.beyond_m[k, known, None]
    off_track = offset[known, None] - across @ lattice.plan_m.T
    square = off_track**2
    if beyond.any():
        # the common error may explain a part of the distance beyond the end of the track; only the rest is a residual
        along = np.stack([-across[:, 1], across[:, 0]], axis=-1) @ lattice.plan_m.T
        square += np.where(beyond != 0.0, np.maximum(np.abs(beyond) - np.sign(beyond) * along, 0.0), 0.0) ** 2
    cost = np.full((m + len(SHIFTS_M) + 1, *lattice.first.shape), np.inf)
    cost[-1] = _UNMAPPED_COST
    cost[known] = _student(square / residuals.sigma_m[k] ** 2)[..., None]
    # an unmapped track can cross mapped tracks, but does not coincide with them
    cost[m:-1] = np.where(residuals.clear[k], 0.0, _UNMAPPED_COST)[:, None, None]
    if len(known):
        cost[m:-1] += _student(((off_track[:1] - SHIFTS_M[:, None]) / residuals.sigma_m[k]) ** 2)[..., None]
    if len(lattice.up_m) > 1:
        above = (residuals.above_m[k, known, None] - lattice.up_m) / residuals.sigma_up_m[k]
        of_height = np.where(np.isnan(above), 0.0, _student(above**2))[:, None]
        cost[known] += of_height
        cost[m:-1] += of_height[:1] if len(known) else 0.0
    return np.asarray(np.exp(-residuals.weight[k] * (cost - cost.min())))


def decode(residuals: Residuals, moves: Transitions) -> tuple[Indices, Floats]:
    """Return the best sequence of tracks, and the probability of each candidate.

    Returns
    -------
    tuple
        Column of each position's candidate in the best sequence, shape (n,); m if the position is on no candidate. The
        best sequence maximises the expected number of successive pairs on correct tracks.

        Probabilities of the candidates and of no track given the whole log, shape (n, m + 1).
    """
    n, m = residuals.offset_m.shape
    lattice, states = _CommonError(residuals), m + len(SHIFTS_M) + 1
    length = _BLOCK // len(lattice.up_m)
    # to save memory, only the first position of each block is stored; each block is recomputed on the backward pass
    firsts: dict[int, Floats | None] = {0: None}
    if n > length:
        firsts |= {k: at.share for k, at in _forward(residuals, moves, lattice, 0, None, n) if k and k % length == 0}
    probability, gains, changes = np.empty((n, m + 1)), np.empty((n - 1, m + 1, m + 1)), moves.changes
    after = expected = np.ones((states, *lattice.first.shape))
    move = np.eye(states)
    none = np.arange(m + 1)  # first state of each group; a group is one candidate, or all unmapped tracks
    for start in reversed(firsts):
        block = [at for _, at in _forward(residuals, moves, lattice, start, firsts[start], min(start + length, n))]
        for k in reversed(range(start, start + len(block))):
            at = block.pop()
            if k < n - 1:
                seconds = float(residuals.seconds[k + 1])
                if k == start + length - 1:
                    move = moves(k)
                pairs = move * (lattice.later(at.share, seconds).reshape(states, -1) @ expected.reshape(states, -1).T)
                share = np.add.reduceat(np.add.reduceat(pairs / pairs.sum(), none, axis=0), none, axis=1)
                cost = np.where(move[: m + 1, : m + 1] < _AT_JOINT, _CHANGE, _CHANGE_AT_JOINT)
                gains[k] = share - np.where(changes[k], cost, 0.0)
                after = (move @ lattice.earlier(expected, seconds).reshape(states, -1)).reshape(after.shape)
                after /= after.max()
            probability[k] = np.add.reduceat((at.share * after).sum(axis=(1, 2)), none)
            expected, move = at.likelihood * after, at.move
    probability /= probability.sum(axis=1, keepdims=True)
    return _sequence(probability, gains), probability


@dataclass(frozen=True)
class _At:
    """Result of the forward recursion at one position."""

    share: Floats  #: Probabilities of the states given the positions up to this position, shape (m + S + 1, C, U).
    likelihood: Floats  #: Likelihood of the position given each state, shape (m + S + 1, C, U).
    move: Floats  #: Transition probabilities from the previous position, shape (m + S + 1, m + S + 1).


def _forward(
    residuals: Residuals, moves: Transitions, lattice: _CommonError, start: int, first: Floats | None, stop: int
) -> Iterator[tuple[int, _At]]:
    """Yield the forward recursion at each position from `start` up to, not including, `stop`.

    The recursion begins with the state probabilities `first` or, if `first` is None, with the prior.
    """
    m = residuals.offset_m.shape[1]
    states = m + len(SHIFTS_M) + 1
    share, move = first, np.eye(states)
    for k in range(start, stop):
        likelihood = _likelihood(residuals, lattice, k)
        if share is None:
            mapped = np.isfinite(residuals.offset_m[k])
            entered = np.full(states, UNMAPPED_PRIOR * np.exp(-_ENTER_COST))
            entered[:m] = mapped * (1.0 - UNMAPPED_PRIOR) / max(mapped.sum(), 1)
            entered[m:-1] = residuals.clear[k] * UNMAPPED_PRIOR * _SHARES
            share = entered[:, None, None] * lattice.first * likelihood
        elif k > start:
            move = moves(k - 1)
            passed = lattice.later(share, float(residuals.seconds[k]))
            share = (move.T @ passed.reshape(states, -1)).reshape(passed.shape) * likelihood
        share = share / share.sum()
        yield k, _At(share, likelihood, move)


def _sequence(probability: Floats, gains: Floats) -> Indices:
    """Return the column of `probability` at each step, such that the sum of `gains` over the steps is largest."""
    if len(probability) == 1:
        return np.asarray(probability.argmax(axis=1))
    nothing = np.zeros(probability.shape[1])
    return np.array(cheapest_path([nothing] * len(probability), (-gain.T for gain in gains)), dtype=np.intp)
