"""Places sought at the start, after gaps and when lost, before an epoch's update."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from railfix.core.arrays import Floats, Indices
from railfix.core.timescale import seconds
from railfix.kernels.tracking.constants import (
    ACROSS_DOUBT,
    ACROSS_LOST,
    ACROSS_TAKEN,
    BESIDE_AFTER_S,
    MOTION_FIT,
    STEP_HELD_S,
)
from railfix.tracking.branches import begin, beside, places, split
from railfix.tracking.chunk import Chunk
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.state import ANY_SPEED, StateIndex, TrackState

#: Probability of other places where the velocity contradicts the one that was sure: the map may be wrong just here.
_ELSEWHERE: Final = 0.01


@dataclass(frozen=True, kw_only=True)
class SplitHypothesis:
    """One of the narrower hypotheses that a wide one was split into.

    Attributes
    ----------
    parent : int
        The wide one.
    mean, covariance : ndarray, shapes (N,), (N, N)
        Of the wide one.
    place_m, sigma_m : float [m]
        Of the narrower one.
    """

    parent: int
    mean: Floats
    covariance: Floats
    place_m: float
    sigma_m: float


class Sought(NamedTuple):
    """What was sought before an epoch.

    Attributes
    ----------
    lost : bool
        Whether the track was lost.
    parent : ndarray of int, shape (H,)
        Hypothesis of the epoch before that each one goes on from; -1 where it began.
    splits : list of SplitHypothesis or None
        Hypotheses that began at this epoch within wider ones.
    """

    lost: bool
    parent: Indices
    splits: list[SplitHypothesis | None] | None


def seek(state: TrackState, chunk: Chunk, epoch: int, line: Line, limits: TrackingLimits) -> Sought:
    """Seek places at the start, after a gap and when lost; the state is that predicted to the epoch."""
    satellites = len(state.satellite)
    if not state.hypotheses:
        arc, sigma = places(chunk, epoch, line, limits)
        state.mean, state.covariance = begin(arc, sigma, satellites, line, limits)
        state.log_probability, state.origin_m = np.full(len(arc), -np.log(max(len(arc), 1))), arc
        state.log_code, state.branch_s, state.branch_m = np.zeros(len(arc)), 0.0, 0.0
        state.log_least, state.log_recent = state.log_probability, np.zeros(len(arc))
        return Sought(lost=False, parent=np.full(len(arc), -1), splits=None)
    mean, covariance = state.mean, state.covariance
    parent: Indices = np.arange(len(mean))
    weak = state.weak_motion_s >= limits.lost_motion_s or state.weak_code_s >= limits.lost_code_s
    lost = weak or state.across >= ACROSS_LOST
    gap = bool(seconds(chunk.time[epoch] - state.measured) > limits.gap_s)
    wide = covariance[:, StateIndex.ARC, StateIndex.ARC] > limits.start_sigma_m**2
    if not (lost or (gap and wide.any())):
        contradicted = state.weak_motion_s >= BESIDE_AFTER_S or state.across >= ACROSS_DOUBT
        contradicted = contradicted or state.motion_misfit > 1.0 - MOTION_FIT
        if contradicted and state.measured >= state.time:
            parent = np.append(parent, np.full(_try_beside(state, limits), -1))
        return Sought(lost=False, parent=parent, splits=None)
    arc, sigma = places(chunk, epoch, line, limits)
    if not len(arc):
        return Sought(lost=lost, parent=parent, splits=None)
    parts = [(mean, covariance, state.log_probability, state.origin_m, state.log_code)]
    splits: list[SplitHypothesis | None] = [None] * len(mean)
    for one in np.flatnonzero(wide) if not lost else []:
        reach = 5.0 * np.sqrt(covariance[one, StateIndex.ARC, StateIndex.ARC])
        there = line.nearest_m(arc, mean[one, StateIndex.ARC])
        near = np.abs(there - mean[one, StateIndex.ARC]) < reach
        if near.any():
            new = split(mean[one], covariance[one], float(state.log_probability[one]), there[near], sigma[near])
            parts.append((*new, there[near], np.full(int(near.sum()), state.log_code[one])))
            splits += [
                SplitHypothesis(parent=int(one), mean=mean[one], covariance=covariance[one], place_m=at, sigma_m=wide_m)
                for at, wide_m in zip(there[near].tolist(), sigma[near].tolist(), strict=True)
            ]
    if lost:
        best = int(np.argmax(state.log_probability))
        going = mean[best : best + 1, StateIndex.ARC] if weak else mean[:, StateIndex.ARC]
        there = line.nearest_m(arc[:, None], going)
        arc = arc[(np.abs(there - going) > limits.start_separation_m).all(axis=1)]
        # The old place goes on too, free to be pulled to where the codes are; where the velocity alone contradicts it,
        # the hypotheses go on as they are.
        arc = np.concatenate([going, arc]) if weak else arc
        sigma = np.full(len(arc), limits.start_sigma_m)
        fresh = begin(arc, sigma, satellites, line, limits, known=(mean[best], covariance[best]))
        elsewhere = 1.0 if weak or state.across >= ACROSS_TAKEN else _ELSEWHERE
        share = np.full(len(arc), np.log(elsewhere / max(len(arc), 1)))
        parts = [] if weak else parts
        parts.append((*fresh, share, arc, np.zeros(len(arc))))
    together = [np.concatenate(items) for items in zip(*parts, strict=True)]
    state.mean, state.covariance, state.origin_m = together[0], together[1], together[3]
    state.log_probability = together[2] - np.logaddexp.reduce(together[2])
    state.log_code, state.branch_s, state.branch_m = together[4], 0.0, 0.0
    state.log_least, state.log_recent = state.log_probability, np.zeros(len(state.log_probability))
    parent = np.full(state.hypotheses, -1)
    if not lost:
        parent = np.array([k if item is None else item.parent for k, item in enumerate(splits)])
    state.coded = np.datetime64("NaT", "ns")
    if lost and state.weak_code_s >= limits.lost_code_s:
        # Codes have contradicted the place that motion carried: the next place is theirs alone.
        state.withheld_s = max(state.withheld_s, STEP_HELD_S)
    if weak:
        state.withheld_s = max(state.withheld_s, limits.level_start_s)
    state.weak_motion_s = state.weak_code_s = state.across = 0.0
    state.code_shift, state.speed_range_mps = (0.0, 0.0), ANY_SPEED
    return Sought(lost=lost, parent=parent, splits=None if lost else splits)


def _try_beside(state: TrackState, limits: TrackingLimits) -> int:
    """Add hypotheses beside the best one, whose motion was contradicted at the epoch before; return how many."""
    if state.hypotheses > limits.most_hypotheses // 2:
        return 0
    best = int(np.argmax(state.log_probability))
    mean, covariance, share = beside(state.mean[best], state.covariance[best], limits)
    log_probability = np.concatenate([state.log_probability, state.log_probability[best] + share])
    state.mean = np.concatenate([state.mean, mean])
    state.covariance = np.concatenate([state.covariance, covariance])
    state.log_probability = log_probability - np.logaddexp.reduce(log_probability)
    state.log_least = np.concatenate([state.log_least, np.zeros(len(mean))])
    state.log_recent = np.concatenate([state.log_recent, np.zeros(len(mean))])
    state.log_code = np.concatenate([state.log_code, np.full(len(mean), state.log_code[best])])
    state.origin_m = np.concatenate([state.origin_m, mean[:, StateIndex.ARC]])
    return len(mean)
