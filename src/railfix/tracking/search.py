"""The state before an epoch's update: its satellites, and places sought at the start, after gaps and when lost."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks, Strings
from railfix.core.timescale import seconds
from railfix.tracking.hypotheses import begin, beside, places, split
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.predict import predicted
from railfix.tracking.rows import Channels
from railfix.tracking.state import SATELLITES, TrackState, Unknown

#: Satellites unseen for this many correlation times are dropped from the state.
_FORGOTTEN: Final = 3.0


def with_satellites(
    state: TrackState, satellite: Strings, has: Masks, now: np.datetime64, limits: TrackingLimits
) -> TrackState:
    """The state with an error for each satellite that is measured now, without those long unseen."""
    names = satellite[has]
    known = {str(name): k for k, name in enumerate(state.satellite)}
    new = [str(name) for name in dict.fromkeys(names.tolist()) if str(name) not in known]
    seen = state.seen.copy()
    for name in names:
        if str(name) in known:
            seen[known[str(name)]] = now
    kept = seconds(now - seen) <= _FORGOTTEN * limits.code_correlation_s if len(seen) else np.zeros(0, dtype=bool)
    if kept.all() and not new:
        return replace(state, seen=seen)
    index = np.concatenate([np.arange(SATELLITES), SATELLITES + np.flatnonzero(kept)]).astype(np.intp)
    mean, covariance = _rearranged(state.mean, state.covariance, index, len(new))
    bank = state.bank
    if bank is not None:
        parts = _rearranged(bank.mean, bank.covariance, index, len(new))
        bank = replace(bank, mean=parts[0], covariance=parts[1])
    return replace(
        state,
        mean=mean,
        covariance=covariance,
        satellite=np.array([*state.satellite[kept].tolist(), *new]),
        seen=np.concatenate([seen[kept], np.full(len(new), now, dtype="datetime64[ns]")]),
        bank=bank,
    )


def _rearranged(mean: Floats, covariance: Floats, index: Indices, new: int) -> tuple[Floats, Floats]:
    """Gaussians over some of their unknowns and so many new errors of satellites."""
    count, old, width = len(mean), len(index), len(index) + new
    means, covariances = np.zeros((count, width)), np.zeros((count, width, width))
    means[:, :old] = mean[:, index]
    covariances[:, :old, :old] = covariance[:, index[:, None], index]
    diagonal = np.arange(old, width)
    covariances[:, diagonal, diagonal] = 1.0
    return means, covariances


def sought(
    state: TrackState,
    channels: Channels,
    line: Line,
    now: np.datetime64,
    dt: float,
    limits: TrackingLimits,
) -> tuple[TrackState, bool]:
    """The predicted state, with places sought at the start, after a gap and when lost; and whether it is lost."""
    if not state.hypotheses:
        arc, sigma = places(channels, line, limits)
        mean, covariance = begin(arc, sigma, len(state.satellite), line, limits)
        even = np.full(len(arc), -np.log(max(len(arc), 1)))
        return replace(state, mean=mean, covariance=covariance, log_probability=even, origin_m=arc), False
    mean, covariance = predicted(state.mean, state.covariance, line, dt, limits)
    state = replace(state, mean=mean, covariance=covariance)
    lost = state.weak_motion_s >= limits.lost_motion_s or state.weak_code_s >= limits.lost_code_s
    gap = seconds(now - state.measured) > limits.gap_s
    wide = np.sqrt(covariance[:, Unknown.PLACE, Unknown.PLACE]) > limits.start_sigma_m
    if not (lost or (gap and wide.any())):
        return (_tried_beside(state, limits) if state.weak_motion_s > 0.0 else state), False
    arc, sigma = places(channels, line, limits)
    if not len(arc):
        return state, lost
    parts = [(mean, covariance, state.log_probability, state.origin_m)]
    for one in np.flatnonzero(wide) if not lost else []:
        reach = 5.0 * np.sqrt(covariance[one, Unknown.PLACE, Unknown.PLACE])
        near = np.abs(arc - mean[one, Unknown.PLACE]) < reach
        if near.any():
            new = split(mean[one], covariance[one], float(state.log_probability[one]), arc[near], sigma[near])
            parts.append((*new, arc[near]))
    if lost:
        best = int(np.argmax(state.log_probability))
        away = np.abs(arc - mean[best, Unknown.PLACE]) > limits.start_separation_m
        # The old place goes on too, free to be pulled to where the codes are.
        arc = np.concatenate([mean[best : best + 1, Unknown.PLACE], arc[away]])
        sigma = np.full(len(arc), limits.start_sigma_m)
        fresh = begin(arc, sigma, len(state.satellite), line, limits, known=(mean[best], covariance[best]))
        parts = [(*fresh, np.full(len(arc), -np.log(len(arc))), arc)]
    together = [np.concatenate(items) for items in zip(*parts, strict=True)]
    log_probability = together[2] - np.logaddexp.reduce(together[2])
    state = replace(
        state, mean=together[0], covariance=together[1], log_probability=log_probability, origin_m=together[3],
        weak_motion_s=0.0, weak_code_s=0.0,
    )  # fmt: skip
    return state, lost


def _tried_beside(state: TrackState, limits: TrackingLimits) -> TrackState:
    """The state with hypotheses beside its best, whose motion was contradicted at the epoch before."""
    if state.hypotheses > limits.most_hypotheses // 2:
        return state
    best = int(np.argmax(state.log_probability))
    mean, covariance, share = beside(state.mean[best], state.covariance[best], limits)
    log_probability = np.concatenate([state.log_probability, state.log_probability[best] + share])
    return replace(
        state,
        mean=np.concatenate([state.mean, mean]),
        covariance=np.concatenate([state.covariance, covariance]),
        log_probability=log_probability - np.logaddexp.reduce(log_probability),
        origin_m=np.concatenate([state.origin_m, mean[:, Unknown.PLACE]]),
    )
