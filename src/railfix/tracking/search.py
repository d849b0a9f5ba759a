"""Places sought at the start, after gaps and when lost, before an epoch's update."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.core.geodesy import range_with_rotation
from railfix.core.timescale import seconds
from railfix.kernels.tracking import constants
from railfix.kernels.tracking.index import CODE
from railfix.tracking.chunk import Chunk
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.state import ANY_SPEED, CLOCKS, OFFSETS, SATELLITES, StateIndex, TrackState

#: The line is searched at points this far apart at most; a Gaussian of `START_SIGMA_M` covers what lies between, and
#: codes count with the error that a place between two points makes [m].
_SPACING_M: Final = 15.0
#: Codes beyond place and clocks that places are sought with: with one alone a wrong place fits as well.
REDUNDANT: Final = 2
#: Places whose logarithm of likelihood is this far below the best are not begun with.
_WORSE: Final = 25.0
#: Standard deviation of an unknown speed: no train is faster than twice this [m/s].
_ANY_SPEED_MPS: Final = 50.0
_ANY_DRIFT_MPS: Final = 1e3
#: Priors of the sensors: a wheel worn or entered wrongly by 2 %, an accelerometer's offset and mounting, a radar's
#: angle.
WHEEL_PRIOR: Final = 0.02
FORCE_PRIOR_MPS2: Final = 0.1
RADAR_PRIOR: Final = 0.02
#: Places beside in `BEND_M`, how many, standard deviation of their speed [m/s], and share of probability that they get.
_BESIDE_STEPS: Final = np.array([-2.0, -1.0, 1.0, 2.0])
_BESIDE: Final = len(_BESIDE_STEPS)
_BEND_SPEED_MPS: Final = 10.0
_BESIDE_SHARE: Final = 0.01
#: What a new hypothesis takes over from a lost track: its error has gone into everything else.
_KEPT: Final = np.array([StateIndex.WHEEL, StateIndex.FORCE_OFFSET, StateIndex.RADAR])


def places(chunk: Chunk, epoch: int, line: Line, limits: TrackingLimits) -> tuple[Floats, Floats]:
    """Return the places along the line that the codes of an epoch are consistent with.

    Returns
    -------
    arc_m : ndarray, shape (C,) [m]
        Local maxima of the likelihood with Student's t errors, the best first; empty with fewer than `REDUNDANT`
        codes beyond the unknowns.
    sigma_m : ndarray, shape (C,) [m]
        `START_SIGMA_M` for each.
    """
    channel = chunk.channel[epoch]
    has = channel["has"][:, CODE] != 0
    groups = [has & (channel["clock"] == g) for g in range(len(CLOCKS))]
    groups = [group for group in groups if group.sum() > 1]
    if sum(int(group.sum()) - 1 for group in groups) < 1 + REDUNDANT:
        return np.empty(0), np.empty(0)
    # between the vertices too: a map with few of them would be searched with gaps
    arc = np.linspace(line.arc_m[0], line.arc_m[-1], 1 + int(np.ceil((line.arc_m[-1] - line.arc_m[0]) / _SPACING_M)))
    points, _ = line.at(arc)
    likelihood = np.zeros(len(arc))
    tails = limits.tails
    for group in groups:
        distance, _ = range_with_rotation(channel["sat_ecef_m"][group], points[:, None, :])
        residual = channel["measured"][group, CODE] - distance
        variance = (1.0 + limits.code_white_share**2) * channel["code_sigma_m"][group] ** 2 + _SPACING_M**2 / 12.0
        clock = np.median(residual, axis=1, keepdims=True)
        for _ in range(constants.PASSES):
            away = residual - clock
            weight = tails.weight(away, away**2 / variance, away.shape[1]) / variance
            clock = (weight * residual).sum(axis=1, keepdims=True) / weight.sum(axis=1, keepdims=True)
        away = residual - clock
        likelihood += tails.log_density(away, away**2 / variance, away.shape[1]).sum(axis=1)
    order = np.argsort(-likelihood, kind="stable")
    order = order[likelihood[order] > likelihood[order[0]] - _WORSE]
    chosen: list[int] = []
    for candidate in order.tolist():
        apart = np.abs(line.nearest_m(arc[chosen], arc[candidate]) - arc[candidate])
        if (apart > limits.start_separation_m).all():
            chosen.append(candidate)
        if len(chosen) == limits.most_hypotheses:
            break
    sigma = np.full(len(chosen), constants.START_SIGMA_M)
    return arc[chosen], sigma


def begin(
    arc_m: Floats,
    sigma_m: Floats,
    satellites: int,
    line: Line,
    limits: TrackingLimits,
    *,
    known: tuple[Floats, Floats] | None = None,
) -> tuple[Floats, Floats]:
    """Return the mean and covariance of new hypotheses at places, shapes (H, N) and (H, N, N).

    Parameters
    ----------
    arc_m, sigma_m : ndarray, shape (H,) [m]
    satellites : int
        Errors of satellites in the state.
    line : Line
    limits : TrackingLimits
    known : tuple of ndarray, shapes (N,) and (N, N), optional
        Mean and covariance of a lost track: what it knew of the sensors is kept, clocks and satellites restart.
    """
    width = SATELLITES + satellites
    mean = np.zeros((len(arc_m), width))
    mean[:, StateIndex.ARC] = mean[:, StateIndex.PREVIOUS_ARC] = arc_m
    variance = np.ones((len(arc_m), width))
    variance[:, StateIndex.ARC] = variance[:, StateIndex.PREVIOUS_ARC] = sigma_m**2
    variance[:, StateIndex.SPEED] = variance[:, StateIndex.PREVIOUS_SPEED] = _ANY_SPEED_MPS**2
    variance[:, StateIndex.ACCELERATION] = limits.acceleration_mps2**2
    variance[:, StateIndex.DRIFT] = _ANY_DRIFT_MPS**2
    variance[:, StateIndex.MAP_RIGHT] = line.sigma_plan_m**2
    variance[:, StateIndex.MAP_UP] = line.sigma_height_m**2
    variance[:, StateIndex.SLOW_CODE] = limits.slow_code_m**2
    variance[:, StateIndex.DOPPLER_SPEED] = constants.DOPPLER_ERROR_MPS**2
    variance[:, StateIndex.WHEEL] = WHEEL_PRIOR**2
    variance[:, StateIndex.FORCE_OFFSET] = FORCE_PRIOR_MPS2**2
    variance[:, StateIndex.RADAR] = RADAR_PRIOR**2
    variance[:, OFFSETS:SATELLITES] = constants.OFFSET_PRIOR_M**2
    covariance = np.zeros((len(arc_m), width, width))
    diagonal = np.arange(width)
    covariance[:, diagonal, diagonal] = variance
    covariance[:, StateIndex.CODE_CLOCK, StateIndex.CODE_CLOCK] = constants.CODE_CLOCK_SIGMA_M**2
    covariance[:, StateIndex.PHASE_CLOCK, StateIndex.PHASE_CLOCK] = constants.CODE_CLOCK_SIGMA_M**2
    if known is not None:
        mean[:, _KEPT] = known[0][_KEPT]
        covariance[:, _KEPT[:, None], _KEPT] = known[1][_KEPT[:, None], _KEPT]
    return mean, covariance


def split(
    mean: Floats, covariance: Floats, log_probability: float, arc_m: Floats, sigma_m: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return narrower hypotheses within a wide one, about places; probabilities by its density there.

    Parameters
    ----------
    mean, covariance : ndarray, shapes (N,), (N, N)
        The wide hypothesis.
    log_probability : float
    arc_m, sigma_m : ndarray, shape (C,) [m]
    """
    place = StateIndex.ARC
    wide = covariance[place, place]
    gain = covariance[:, place] / wide
    means = mean + gain * (arc_m - mean[place])[:, None]
    narrower = covariance - np.outer(gain, gain) * wide
    covariances = narrower + np.outer(gain, gain) * (sigma_m**2)[:, None, None]
    log_weight = -0.5 * (arc_m - mean[place]) ** 2 / wide + np.log(sigma_m)
    return means, covariances, log_probability + log_weight - np.logaddexp.reduce(log_weight)


def beside(mean: Floats, covariance: Floats, limits: TrackingLimits) -> tuple[Floats, Floats, Floats]:
    """Mean, covariance and logarithm of the share of hypotheses a little before and after one, its speed unknown.

    Where a line turns back within some tens of metres, Dopplers fit one leg run forward and the other run backward
    alike, and a step of the estimate over the bend is none of the equations linearised before it. Contradicted by its
    motion, the place beyond the bend must be tried.

    Parameters
    ----------
    mean, covariance : ndarray, shapes (N,), (N, N)
    limits : TrackingLimits
    """
    steps = constants.BEND_M * _BESIDE_STEPS
    gain = np.zeros(len(mean))
    gain[[StateIndex.ARC, StateIndex.PREVIOUS_ARC]] = 1.0
    means = mean + gain * steps[:, None]
    wider = covariance + np.outer(gain, gain) * (0.5 * constants.BEND_M) ** 2
    for unknown, sigma in ((StateIndex.SPEED, _BEND_SPEED_MPS), (StateIndex.ACCELERATION, limits.acceleration_mps2)):
        wider[unknown, unknown] += sigma**2
    covariances = np.repeat(wider[None], len(steps), axis=0)
    return means, covariances, np.full(len(steps), np.log(_BESIDE_SHARE / len(steps)))


#: Probability of other places where the velocity contradicts the one that was sure: the map may be wrong just here.
_ELSEWHERE: Final = 0.01


@dataclass(frozen=True, kw_only=True)
class SplitHypothesis:
    """One of the narrower hypotheses that a wide one was split into."""

    parent: int  #: The wide one.
    #: Mean and covariance of the wide one; shapes (N,), (N, N).
    mean: Floats
    covariance: Floats
    #: Place of the narrower one, and its standard deviation.
    place_m: float
    sigma_m: float


class Sought(NamedTuple):
    """Result of the search before an epoch."""

    lost: bool  #: The track was lost.
    parent: Indices  #: Hypothesis of the epoch before that each one goes on from; -1 where it began; shape (H,).
    splits: list[SplitHypothesis | None] | None  #: Hypotheses that began at this epoch within wider ones.


#: Mean, covariance, logarithm of the probability, arc length at the start and part by codes of some hypotheses.
_Part: TypeAlias = tuple[Floats, Floats, Floats, Floats, Floats]


def seek(state: TrackState, chunk: Chunk, epoch: int, line: Line, limits: TrackingLimits) -> Sought:
    """Seek places at the start, after a gap and when lost; the state is that predicted to the epoch."""
    if not state.hypotheses:
        arc, sigma = places(chunk, epoch, line, limits)
        state.mean, state.covariance = begin(arc, sigma, len(state.satellite), line, limits)
        state.log_probability, state.origin_m = np.full(len(arc), -np.log(max(len(arc), 1))), arc
        state.log_code = np.zeros(len(arc))
        _start_branches(state)
        return Sought(lost=False, parent=np.full(len(arc), -1), splits=None)
    monitors, parent = state.monitors, np.arange(state.hypotheses)
    weak = monitors.weak_motion_s >= constants.LOST_MOTION_S or monitors.weak_code_s >= constants.LOST_CODE_S
    lost = weak or monitors.across >= constants.ACROSS_LOST
    gap = bool(seconds(chunk.time[epoch] - state.measured) > constants.GAP_S)
    wide = state.covariance[:, StateIndex.ARC, StateIndex.ARC] > constants.START_SIGMA_M**2
    if not (lost or (gap and wide.any())):
        contradicted = monitors.weak_motion_s >= constants.BESIDE_AFTER_S or monitors.across >= constants.ACROSS_DOUBT
        contradicted = contradicted or monitors.motion_misfit > 1.0 - constants.MOTION_FIT
        if contradicted and state.measured >= state.time:
            parent = np.append(parent, np.full(_try_beside(state, line, limits), -1))
        return Sought(lost=False, parent=parent, splits=None)
    arc, sigma = places(chunk, epoch, line, limits)
    if not len(arc):
        return Sought(lost=lost, parent=parent, splits=None)
    of_now = state.mean, state.covariance, state.log_probability, state.origin_m, state.log_code
    if lost:
        parts, splits = ([] if weak else [of_now]) + [_begin_elsewhere(state, arc, line, limits, weak=weak)], None
    else:
        inside, splits = _split_wide(state, arc, sigma, wide, line)
        parts = [of_now, *inside]
    state.mean, state.covariance, log_probability, state.origin_m, state.log_code = (
        np.concatenate(items) for items in zip(*parts, strict=True)
    )
    state.log_probability = log_probability - np.logaddexp.reduce(log_probability)
    parent = np.full(state.hypotheses, -1)
    if splits is not None:
        parent = np.array([k if item is None else item.parent for k, item in enumerate(splits)])
    _reset_monitors(state, lost=lost, weak=weak)
    return Sought(lost=lost, parent=parent, splits=splits)


def _start_branches(state: TrackState) -> None:
    """Start the count of time and distance on the branches."""
    state.log_least, state.log_recent = state.log_probability, np.zeros(state.hypotheses)
    state.monitors = replace(state.monitors, branch_s=0.0, branch_m=0.0)


def _reset_monitors(state: TrackState, *, lost: bool, weak: bool) -> None:
    """Reset what contradicted the earlier places, and hold the level back where the track was lost."""
    _start_branches(state)
    hold = state.monitors.level_hold_s
    if lost and state.monitors.weak_code_s >= constants.LOST_CODE_S:
        # Codes have contradicted the place that motion carried: the next place is theirs alone.
        hold = max(hold, constants.STEP_HOLD_S)
    if weak:
        hold = max(hold, constants.LEVEL_START_S)
    state.monitors = replace(
        state.monitors, level_hold_s=hold, weak_motion_s=0.0, weak_code_s=0.0, across=0.0, code_shift=0.0,
        code_shift_variance=0.0, least_speed_mps=ANY_SPEED[0], most_speed_mps=ANY_SPEED[1],
    )  # fmt: skip
    state.coded = np.datetime64("NaT", "ns")


def _split_wide(
    state: TrackState, arc: Floats, sigma: Floats, wide: Masks, line: Line
) -> tuple[list[_Part], list[SplitHypothesis | None]]:
    """Return narrower hypotheses at places within wide ones, and what each hypothesis was split from."""
    parts: list[_Part] = []
    splits: list[SplitHypothesis | None] = [None] * state.hypotheses
    for one in np.flatnonzero(wide):
        mean, covariance = state.mean[one], state.covariance[one]
        reach = 5.0 * np.sqrt(covariance[StateIndex.ARC, StateIndex.ARC])
        there = line.nearest_m(arc, mean[StateIndex.ARC])
        near = np.abs(there - mean[StateIndex.ARC]) < reach
        if near.any():
            new = split(mean, covariance, float(state.log_probability[one]), there[near], sigma[near])
            parts.append((*new, there[near], np.full(int(near.sum()), state.log_code[one])))
            splits += [
                SplitHypothesis(parent=int(one), mean=mean, covariance=covariance, place_m=at, sigma_m=wide_m)
                for at, wide_m in zip(there[near].tolist(), sigma[near].tolist(), strict=True)
            ]
    return parts, splits


def _begin_elsewhere(state: TrackState, arc: Floats, line: Line, limits: TrackingLimits, *, weak: bool) -> _Part:
    """Return hypotheses at places away from those of a lost track; `weak`: its weights were low for long."""
    best = int(np.argmax(state.log_probability))
    elsewhere = 1.0 if weak or state.monitors.across >= constants.ACROSS_TAKEN else _ELSEWHERE
    # One that is less probable than a new place has drifted from where codes would begin it.
    alive = state.log_probability >= np.log(elsewhere / len(arc))
    going = state.mean[best : best + 1, StateIndex.ARC] if weak else state.mean[alive, StateIndex.ARC]
    there = line.nearest_m(arc[:, None], going)
    arc = arc[(np.abs(there - going) > limits.start_separation_m).all(axis=1)]
    # The old place goes on too, free to be pulled to where the codes are; where the velocity alone contradicts it,
    # the hypotheses go on as they are.
    arc = np.concatenate([going, arc]) if weak else arc
    sigma = np.full(len(arc), constants.START_SIGMA_M)
    known = state.mean[best], state.covariance[best]
    fresh = begin(arc, sigma, len(state.satellite), line, limits, known=known)
    return (*fresh, np.full(len(arc), np.log(elsewhere / max(len(arc), 1))), arc, np.zeros(len(arc)))


def _try_beside(state: TrackState, line: Line, limits: TrackingLimits) -> int:
    """Add hypotheses beside those that are apart, the most probable first; return how many.

    Motion that contradicts the best one contradicts another lap of it alike: without places of its own beside it the
    other lap would lose by them.
    """
    parents: list[int] = []
    room = (limits.most_hypotheses - state.hypotheses) // _BESIDE
    for h in np.argsort(-state.log_probability, kind="stable").tolist():
        there = line.nearest_m(state.mean[parents, StateIndex.ARC], state.mean[h, StateIndex.ARC])
        if len(parents) < room and (np.abs(there - state.mean[h, StateIndex.ARC]) > limits.start_separation_m).all():
            parents.append(h)
    if state.hypotheses > limits.most_hypotheses // 2 or not parents:
        return 0
    parts = [beside(state.mean[h], state.covariance[h], limits) for h in parents]
    mean, covariance, share = (np.concatenate(items) for items in zip(*parts, strict=True))
    parent = np.repeat(parents, _BESIDE)
    log_probability = np.concatenate([state.log_probability, state.log_probability[parent] + share])
    state.mean = np.concatenate([state.mean, mean])
    state.covariance = np.concatenate([state.covariance, covariance])
    state.log_probability = log_probability - np.logaddexp.reduce(log_probability)
    state.log_least = np.concatenate([state.log_least, np.zeros(len(mean))])
    state.log_recent = np.concatenate([state.log_recent, np.zeros(len(mean))])
    state.log_code = np.concatenate([state.log_code, state.log_code[parent]])
    state.origin_m = np.concatenate([state.origin_m, mean[:, StateIndex.ARC]])
    return len(mean)
