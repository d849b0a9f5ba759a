"""Position search from the codes of one epoch: at the start, after gaps and after a loss of track."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.core.geodesy import range_with_rotation
from railfix.kernels.tracking import constants
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.layout import Records
from railfix.tracking.chunk import Chunk
from railfix.tracking.limits import Tails, TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.state import ANY_SPEED, HYPOTHESIS, TrackState

#: Largest spacing of the points at which the line is searched [m]. A Gaussian of `START_SIGMA_M` covers the positions
#: between two points, and the code variance includes the distance to the nearest point.
_SPACING_M: Final = 15.0
#: Minimum number of redundant codes for a search. If only one code is redundant, a wrong position can fit all codes.
REDUNDANT: Final = 2
#: A position becomes a hypothesis only if its log likelihood is within this difference of the maximum.
_WORSE: Final = 25.0
_ANY_SPEED_MPS: Final = 50.0  #: Prior standard deviation of the speed [m/s]; no train is faster than twice this speed.
_ANY_DRIFT_MPS: Final = 1e3  #: Prior standard deviation of the clock drift [m/s].
_FIRST_STEP_M: Final = 1.0  #: Prior sigma of the map's displacement error at the first epoch [m].
WHEEL_PRIOR: Final = 0.02  #: Prior standard deviation of the wheel's scale-factor error.
FORCE_PRIOR_MPS2: Final = 0.1  #: Prior standard deviation of the accelerometer offset, including the mounting.
RADAR_PRIOR: Final = 0.02  #: Prior standard deviation of the radar's scale-factor error.
_BESIDE_STEPS: Final = np.array([-2.0, -1.0, 1.0, 2.0])  #: Distances to neighbouring hypotheses, in units of `BEND_M`.
_BESIDE: Final = len(_BESIDE_STEPS)  #: Number of neighbouring hypotheses per hypothesis.
_BEND_SPEED_MPS: Final = 10.0  #: Increase of the speed sigma of neighbouring hypotheses, in quadrature [m/s].
#: Total probability of the neighbours of a hypothesis, as a fraction of this hypothesis's probability.
_BESIDE_SHARE: Final = 0.01
#: Unknowns that a new hypothesis copies from a lost track. Other unknowns are affected by the error of the lost track.
_KEPT: Final = np.array([ix.WHEEL, ix.FORCE_OFFSET, ix.RADAR])


def places(chunk: Chunk, epoch: int, line: Line, limits: TrackingLimits) -> Floats:
    """Return the arc lengths [m] that are consistent with the codes of an epoch, the most likely first, shape (C,).

    The positions are maxima, more than `start_separation_m` apart, of the likelihood with Student's t errors. With
    fewer than `REDUNDANT` redundant codes, no position is returned.
    """
    channel = chunk.channel[epoch]
    has = channel["has"][:, ix.CODE] != 0
    groups = [has & (channel["clock"] == g) for g in range(len(ix.CLOCKS))]
    groups = [group for group in groups if group.sum() > 1]
    if sum(int(group.sum()) - 1 for group in groups) < 1 + REDUNDANT:
        return np.empty(0)
    # the points are independent of the vertices, so that a sparse map is searched without gaps
    arc = np.linspace(line.arc_m[0], line.arc_m[-1], 1 + int(np.ceil((line.arc_m[-1] - line.arc_m[0]) / _SPACING_M)))
    points, _ = line.at(arc)
    likelihood = np.zeros(len(arc))
    tails = Tails(limits.degrees_of_freedom, limits.late_degrees_of_freedom)
    for group in groups:
        distance, _ = range_with_rotation(channel["sat_ecef_m"][group], points[:, None, :])
        residual = channel["measured"][group, ix.CODE] - distance
        variance = (1.0 + limits.code_white_share**2) * channel["code_sigma_m"][group] ** 2 + _SPACING_M**2 / 12.0
        clock = np.median(residual, axis=1, keepdims=True)
        for _ in range(constants.PASSES):
            away = residual - clock
            weight = tails.weight(away, away**2 / variance) / variance
            clock = (weight * residual).sum(axis=1, keepdims=True) / weight.sum(axis=1, keepdims=True)
        away = residual - clock
        likelihood += tails.log_density(away, away**2 / variance).sum(axis=1)
    order = np.argsort(-likelihood, kind="stable")
    order = order[likelihood[order] > likelihood[order[0]] - _WORSE]
    chosen: list[int] = []
    for candidate in order.tolist():
        apart = np.abs(line.nearest_m(arc[chosen], arc[candidate]) - arc[candidate])
        if (apart > limits.start_separation_m).all():
            chosen.append(candidate)
        if len(chosen) == limits.most_hypotheses:
            break
    return arc[chosen]


def begin(
    arc_m: Floats, satellites: int, line: Line, limits: TrackingLimits, *, sigma_m: float = constants.START_SIGMA_M,
    known: tuple[Floats, Floats] | None = None,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Return means, shape (H, N), and covariances, shape (H, N, N), of new hypotheses at `arc_m` [m], shape (H,).

    `satellites` is the number of satellite errors in the state. `known` are the mean and covariance of a lost track;
    their sensor errors are kept. Clocks and satellite errors are reset.
    """
    width = ix.SATELLITES + satellites
    mean = np.zeros((len(arc_m), width))
    mean[:, ix.ARC] = mean[:, ix.PREVIOUS_ARC] = arc_m
    variance = np.ones((len(arc_m), width))
    variance[:, ix.ARC] = variance[:, ix.PREVIOUS_ARC] = sigma_m**2
    variance[:, ix.SPEED] = variance[:, ix.PREVIOUS_SPEED] = _ANY_SPEED_MPS**2
    variance[:, ix.ACCELERATION] = limits.acceleration_mps2**2
    variance[:, ix.DRIFT] = _ANY_DRIFT_MPS**2
    variance[:, ix.MAP_RIGHT] = line.sigma_plan_m**2
    variance[:, ix.MAP_UP] = line.sigma_height_m**2
    # before the first epoch no position is known, and the map displacement since then is almost unknown
    variance[:, [ix.STEP_RIGHT, ix.STEP_UP, ix.MAP_LENGTH_ERROR]] = _FIRST_STEP_M**2
    variance[:, ix.SLOW_CODE] = limits.slow_code_m**2
    variance[:, ix.DOPPLER_SPEED] = constants.DOPPLER_ERROR_MPS**2
    variance[:, ix.WHEEL] = WHEEL_PRIOR**2
    variance[:, ix.FORCE_OFFSET] = FORCE_PRIOR_MPS2**2
    variance[:, ix.RADAR] = RADAR_PRIOR**2
    variance[:, ix.OFFSETS : ix.SATELLITES] = constants.OFFSET_PRIOR_M**2
    covariance = np.zeros((len(arc_m), width, width))
    diagonal = np.arange(width)
    covariance[:, diagonal, diagonal] = variance
    covariance[:, ix.CODE_CLOCK, ix.CODE_CLOCK] = constants.CODE_CLOCK_SIGMA_M**2
    covariance[:, ix.PHASE_CLOCK, ix.PHASE_CLOCK] = constants.CODE_CLOCK_SIGMA_M**2
    if known is not None:
        mean[:, _KEPT] = known[0][_KEPT]
        covariance[:, _KEPT[:, None], _KEPT] = known[1][_KEPT[:, None], _KEPT]
    return mean, covariance


#: Total probability of new positions if the velocity contradicts the position; low, because the map may be wrong.
_ELSEWHERE: Final = 0.01


@dataclass(frozen=True, kw_only=True)
class SplitHypothesis:
    """Narrow hypothesis that was split from a wide hypothesis."""

    parent: int  #: Index of the wide hypothesis before the split.
    #: Mean and covariance of the wide hypothesis, shapes (N,) and (N, N).
    mean: Floats
    covariance: Floats
    place_m: float  #: Arc length of the narrow hypothesis; its standard deviation is `START_SIGMA_M`.


class Sought(NamedTuple):
    """Result of the position search before an epoch."""

    lost: bool  #: True if the search followed a loss of track.
    parent: Indices  #: For each hypothesis, its index at the previous epoch, shape (H,); -1 if it is new.
    #: For each hypothesis, the split that produced it, or None. The list is None if no hypothesis was split.
    splits: list[SplitHypothesis | None] | None


#: Means (H, N), covariances (H, N, N) and records (H,) of H hypotheses.
_Part: TypeAlias = tuple[Floats, Floats, Records]


def _new_records(log_probability: Floats, origin_m: Floats, log_code: Floats | float = 0.0) -> Records:
    """Return the `HYPOTHESIS` records of new hypotheses, shape (H,)."""
    records = np.zeros(len(origin_m), dtype=HYPOTHESIS)
    records["log_probability"], records["origin_m"], records["log_code"] = log_probability, origin_m, log_code
    return records


def _join(state: TrackState, parts: list[_Part]) -> None:
    """Replace the hypotheses of the state by those of all `parts`, and normalise their probabilities to a sum of 1."""
    state.mean, state.covariance, state.hypothesis = (np.concatenate(items) for items in zip(*parts, strict=True))
    state.hypothesis["log_probability"] -= np.logaddexp.reduce(state.hypothesis["log_probability"])


def seek(state: TrackState, chunk: Chunk, epoch: int, line: Line, limits: TrackingLimits, reasons: int) -> Sought:
    """Search for positions at an epoch, and add hypotheses to the state predicted to this epoch.

    `reasons` are bits of `kernels.tracking.index` (`LOST_TRACK` and following), ignored if there is no hypothesis.
    """
    if not state.hypotheses:
        arc = places(chunk, epoch, line, limits)
        state.mean, state.covariance = begin(arc, len(state.satellite), line, limits)
        state.hypothesis = _new_records(np.full(len(arc), -np.log(max(len(arc), 1))), arc)
        _start_branches(state)
        return Sought(lost=False, parent=np.full(len(arc), -1), splits=None)
    parent, lost = np.arange(state.hypotheses), bool(reasons & ix.LOST_TRACK)
    wide = state.covariance[:, ix.ARC, ix.ARC] > constants.START_SIGMA_M**2
    if not (lost or (reasons & ix.GAP and wide.any())):
        added = _try_beside(state, line, limits) if reasons & ix.CONTRADICTED else 0
        return Sought(lost=False, parent=np.append(parent, np.full(added, -1)), splits=None)
    arc = places(chunk, epoch, line, limits)
    if not len(arc):
        return Sought(lost=lost, parent=parent, splits=None)
    weak = state.monitors.weak_motion_s >= constants.LOST_MOTION_S
    weak = lost and (weak or state.monitors.weak_code_s >= constants.LOST_CODE_S)
    of_now = state.mean, state.covariance, state.hypothesis
    if lost:
        parts, splits = ([] if weak else [of_now]) + [_begin_elsewhere(state, arc, line, limits, weak=weak)], None
    else:
        inside, splits = _split_wide(state, arc, wide, line)
        parts = [of_now, *inside]
    _join(state, parts)
    parent = np.full(state.hypotheses, -1)
    if splits is not None:
        parent = np.array([k if item is None else item.parent for k, item in enumerate(splits)])
    _reset_monitors(state, lost=lost, weak=weak)
    return Sought(lost=lost, parent=parent, splits=splits)


def _start_branches(state: TrackState) -> None:
    """Reset the evidence of the hypotheses, and the time and distance since their start."""
    state.hypothesis["log_least"], state.hypothesis["log_recent"] = state.hypothesis["log_probability"], 0.0
    state.monitors = replace(state.monitors, branch_s=0.0, branch_m=0.0)


def _reset_monitors(state: TrackState, *, lost: bool, weak: bool) -> None:
    """Reset the monitors that refer to earlier positions, and withhold protection levels if weights were low."""
    _start_branches(state)
    hold = state.monitors.level_hold_s
    if lost and state.monitors.weak_code_s >= constants.LOST_CODE_S:
        # Codes have contradicted the position propagated by motion, so that codes alone determine the next position.
        hold = max(hold, constants.STEP_HOLD_S)
    if weak:
        hold = max(hold, constants.LEVEL_START_S)
    state.monitors = replace(
        state.monitors, level_hold_s=hold, weak_motion_s=0.0, weak_code_s=0.0, contradiction=0.0, code_shift=0.0,
        code_shift_variance=0.0, least_speed_mps=ANY_SPEED[0], most_speed_mps=ANY_SPEED[1], coded_s=-np.inf,
    )  # fmt: skip


def _split_wide(
    state: TrackState, arc_m: Floats, wide: Masks, line: Line
) -> tuple[list[_Part], list[SplitHypothesis | None]]:
    """Return narrow hypotheses at those positions `arc_m` [m] that lie within `wide` hypotheses, and their splits.

    A narrow hypothesis is the wide hypothesis corrected by a position measurement of standard deviation
    `START_SIGMA_M`. Its probability is proportional to the density of the wide hypothesis at the measured position.
    """
    parts: list[_Part] = []
    splits: list[SplitHypothesis | None] = [None] * state.hypotheses
    for h in np.flatnonzero(wide):
        mean, covariance, record = state.mean[h], state.covariance[h], state.hypothesis[h]
        variance = covariance[ix.ARC, ix.ARC]
        there = line.nearest_m(arc_m, mean[ix.ARC])
        away = there - mean[ix.ARC]
        near = np.abs(away) < 5.0 * np.sqrt(variance)
        there, away = there[near], away[near]
        if not len(there):
            continue
        gain = covariance[:, ix.ARC] / variance
        narrower = covariance - np.outer(gain, gain) * (variance - constants.START_SIGMA_M**2)
        log_weight = -0.5 * away**2 / variance
        log_probability = record["log_probability"] + log_weight - np.logaddexp.reduce(log_weight)
        records = _new_records(log_probability, there, record["log_code"])
        parts.append((mean + gain * away[:, None], np.repeat(narrower[None], len(there), axis=0), records))
        splits += [
            SplitHypothesis(parent=int(h), mean=mean, covariance=covariance, place_m=place_m)
            for place_m in there.tolist()
        ]
    return parts, splits


def _begin_elsewhere(state: TrackState, arc: Floats, line: Line, limits: TrackingLimits, *, weak: bool) -> _Part:
    """Return hypotheses at arc lengths `arc` after a loss of track. `weak` is True if low weights caused the loss."""
    log_probability = state.hypothesis["log_probability"]
    best = int(np.argmax(log_probability))
    elsewhere = 1.0 if weak or state.monitors.contradiction >= constants.CONTRADICTION_TAKEN else _ELSEWHERE
    # A hypothesis that is less probable than a new one has drifted away from the position that the codes determine.
    alive = log_probability >= np.log(elsewhere / len(arc))
    going = state.mean[best : best + 1, ix.ARC] if weak else state.mean[alive, ix.ARC]
    there = line.nearest_m(arc[:, None], going)
    arc = arc[(np.abs(there - going) > limits.start_separation_m).all(axis=1)]
    # If the weights were low, a hypothesis also begins at the old position, with a large variance that codes can
    # reduce. If only the velocity contradicts the position, the old hypotheses continue.
    arc = np.concatenate([going, arc]) if weak else arc
    fresh = begin(arc, len(state.satellite), line, limits, known=(state.mean[best], state.covariance[best]))
    return (*fresh, _new_records(np.full(len(arc), np.log(elsewhere / max(len(arc), 1))), arc))


def _try_beside(state: TrackState, line: Line, limits: TrackingLimits) -> int:
    """Add hypotheses a short distance ahead of and behind each hypothesis; return the number of added hypotheses.

    Where a line turns back within some tens of metres, Dopplers fit forward travel before the bend as well as backward
    travel beyond it, and equations linearised before the bend are not valid beyond it. Neighbours are added on every
    lap, because neighbours of the most probable lap alone would make other laps less probable.
    """
    parents: list[int] = []
    room = (limits.most_hypotheses - state.hypotheses) // _BESIDE
    for h in np.argsort(-state.hypothesis["log_probability"], kind="stable").tolist():
        there = line.nearest_m(state.mean[parents, ix.ARC], state.mean[h, ix.ARC])
        if len(parents) < room and (np.abs(there - state.mean[h, ix.ARC]) > limits.start_separation_m).all():
            parents.append(h)
    parts: list[_Part] = [(state.mean, state.covariance, state.hypothesis)]
    places_of_both = np.ix_([ix.ARC, ix.PREVIOUS_ARC], [ix.ARC, ix.PREVIOUS_ARC])
    for h in parents:
        means = np.repeat(state.mean[h][None], _BESIDE, axis=0)
        means[:, [ix.ARC, ix.PREVIOUS_ARC]] += constants.BEND_M * _BESIDE_STEPS[:, None]
        wider, record = state.covariance[h].copy(), state.hypothesis[h]
        wider[places_of_both] += (0.5 * constants.BEND_M) ** 2
        wider[ix.SPEED, ix.SPEED] += _BEND_SPEED_MPS**2
        wider[ix.ACCELERATION, ix.ACCELERATION] += limits.acceleration_mps2**2
        log_probability = np.full(_BESIDE, record["log_probability"] + np.log(_BESIDE_SHARE / _BESIDE))
        records = _new_records(log_probability, means[:, ix.ARC], record["log_code"])
        parts.append((means, np.repeat(wider[None], _BESIDE, axis=0), records))
    _join(state, parts)
    return _BESIDE * len(parents)
