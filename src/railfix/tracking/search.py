"""Places sought at the start, after gaps and when lost, before an epoch's update."""

from __future__ import annotations

import numpy as np

from railfix.core.timescale import seconds
from railfix.tracking.branches import BESIDE_AFTER_S, begin, beside, places, split
from railfix.tracking.chunk import Chunk
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.monitors import ACROSS_DOUBT, ACROSS_LOST, ACROSS_TAKEN, ELSEWHERE, STEP_HELD_S
from railfix.tracking.predict import predicted
from railfix.tracking.state import ANY_SPEED, Narrowed, TrackState, Unknown


def seek(state: TrackState, chunk: Chunk, epoch: int, line: Line, limits: TrackingLimits) -> bool:
    """Predict the state, and seek places at the start, after a gap and when lost; return whether it is lost."""
    satellites = len(state.satellite)
    if not state.hypotheses:
        arc, sigma = places(chunk, epoch, line, limits)
        state.mean, state.covariance = begin(arc, sigma, satellites, line, limits)
        state.log_probability, state.origin_m = np.full(len(arc), -np.log(max(len(arc), 1))), arc
        state.log_code, state.branch_s, state.branch_m = np.zeros(len(arc)), 0.0, 0.0
        state.log_least = state.log_probability
        state.parent, state.narrowed = np.full(len(arc), -1), None
        return False
    mean, covariance = predicted(state.mean, state.covariance, line, chunk.interval_s[epoch], limits, state.map_scale)
    state.mean, state.covariance = mean, covariance
    state.parent, state.narrowed = np.arange(len(mean)), None
    weak = state.weak_motion_s >= limits.lost_motion_s or state.weak_code_s >= limits.lost_code_s
    lost = weak or state.across >= ACROSS_LOST
    gap = bool(seconds(chunk.time[epoch] - state.measured) > limits.gap_s)
    wide = covariance[:, Unknown.PLACE, Unknown.PLACE] > limits.start_sigma_m**2
    if not (lost or (gap and wide.any())):
        if state.weak_motion_s >= BESIDE_AFTER_S or state.across >= ACROSS_DOUBT:
            _try_beside(state, limits)
        return False
    arc, sigma = places(chunk, epoch, line, limits)
    if not len(arc):
        return lost
    parts = [(mean, covariance, state.log_probability, state.origin_m, state.log_code)]
    narrowed: list[Narrowed | None] = [None] * len(mean)
    for one in np.flatnonzero(wide) if not lost else []:
        reach = 5.0 * np.sqrt(covariance[one, Unknown.PLACE, Unknown.PLACE])
        there = line.nearest_m(arc, mean[one, Unknown.PLACE])
        near = np.abs(there - mean[one, Unknown.PLACE]) < reach
        if near.any():
            new = split(mean[one], covariance[one], float(state.log_probability[one]), there[near], sigma[near])
            parts.append((*new, there[near], np.full(int(near.sum()), state.log_code[one])))
            narrowed += [
                Narrowed(parent=int(one), mean=mean[one], covariance=covariance[one], place_m=at, sigma_m=wide_m)
                for at, wide_m in zip(there[near].tolist(), sigma[near].tolist(), strict=True)
            ]
    if lost:
        best = int(np.argmax(state.log_probability))
        going = mean[best : best + 1, Unknown.PLACE] if weak else mean[:, Unknown.PLACE]
        there = line.nearest_m(arc[:, None], going)
        arc = arc[(np.abs(there - going) > limits.start_separation_m).all(axis=1)]
        # The old place goes on too, free to be pulled to where the codes are; where the velocity alone contradicts it,
        # the hypotheses go on as they are.
        arc = np.concatenate([going, arc]) if weak else arc
        sigma = np.full(len(arc), limits.start_sigma_m)
        fresh = begin(arc, sigma, satellites, line, limits, known=(mean[best], covariance[best]))
        elsewhere = 1.0 if weak or state.across >= ACROSS_TAKEN else ELSEWHERE
        share = np.full(len(arc), np.log(elsewhere / max(len(arc), 1)))
        parts = [] if weak else parts
        parts.append((*fresh, share, arc, np.zeros(len(arc))))
    together = [np.concatenate(items) for items in zip(*parts, strict=True)]
    state.mean, state.covariance, state.origin_m = together[0], together[1], together[3]
    state.log_probability = together[2] - np.logaddexp.reduce(together[2])
    state.log_code, state.branch_s, state.branch_m = together[4], 0.0, 0.0
    state.log_least = state.log_probability
    state.parent = np.full(state.hypotheses, -1)
    if not lost:
        state.parent = np.array([k if item is None else item.parent for k, item in enumerate(narrowed)])
        state.narrowed = narrowed
    state.coded = np.datetime64("NaT", "ns")
    if lost and state.weak_code_s >= limits.lost_code_s:
        # Codes have contradicted the place that motion carried: the next place is theirs alone.
        state.withheld_s = max(state.withheld_s, STEP_HELD_S)
    if weak:
        state.withheld_s = max(state.withheld_s, limits.level_start_s)
    state.weak_motion_s = state.weak_code_s = state.across = 0.0
    state.code_shift, state.speed_range_mps = (0.0, 0.0), ANY_SPEED
    return lost


def _try_beside(state: TrackState, limits: TrackingLimits) -> None:
    """Add hypotheses beside the best one, whose motion was contradicted at the epoch before."""
    if state.hypotheses > limits.most_hypotheses // 2:
        return
    best = int(np.argmax(state.log_probability))
    mean, covariance, share = beside(state.mean[best], state.covariance[best], limits)
    log_probability = np.concatenate([state.log_probability, state.log_probability[best] + share])
    state.mean = np.concatenate([state.mean, mean])
    state.covariance = np.concatenate([state.covariance, covariance])
    state.log_probability = log_probability - np.logaddexp.reduce(log_probability)
    state.log_least = np.concatenate([state.log_least, np.zeros(len(mean))])
    state.log_code = np.concatenate([state.log_code, np.full(len(mean), state.log_code[best])])
    state.origin_m = np.concatenate([state.origin_m, mean[:, Unknown.PLACE]])
    state.parent = np.concatenate([state.parent, np.full(len(mean), -1)])
