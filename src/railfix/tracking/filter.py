"""The filter along the track: epochs in, places along the trajectory and the state for the next epochs out."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import Final

import numpy as np

from railfix import kernels
from railfix.core.arrays import Floats
from railfix.tracking.bank import levelled, predict_bank
from railfix.tracking.branches import (
    LEAST_RISE,
    MOTION_SATELLITES,
    TAKEOVER,
    TAKEOVER_AFTER_S,
    judged,
    most_probable,
    on_the_line,
    surviving,
)
from railfix.tracking.chunk import Chunk, code_interval_s, leave, prepared
from railfix.tracking.clocks import clocks_of_epoch, learn
from railfix.tracking.compiled import Compiled
from railfix.tracking.epochs import GnssEpochs, SensorEpochs
from railfix.tracking.faulty import FREED_M, FREED_SIGMAS, INFLATED, is_faulty, update_bias
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.misfit import code_shift, learn_map
from railfix.tracking.monitors import ACROSS_TAKEN, contradiction, watch
from railfix.tracking.possible_speed import possible, widen
from railfix.tracking.result import Tracked, TrackStatus, write_place, write_rows
from railfix.tracking.robust import (
    DOUBTFUL,
    FREEDOM,
    MOVED_M,
    RELINEARISED,
    applied,
    better_mode,
    first_weights,
    log_evidence,
    motion_evidence,
    prior_of,
    robust_update,
)
from railfix.tracking.rows import DIRECTION_MPS, Rows, rows_of, sensor_rows
from railfix.tracking.search import seek
from railfix.tracking.smoother import Step
from railfix.tracking.state import SATELLITES, Bank, TrackState, Unknown, begun_anew

_PLACES: Final = [Unknown.PLACE, Unknown.BEFORE]


def track(
    epochs: GnssEpochs,
    line: Line,
    state: TrackState | None = None,
    *,
    limits: TrackingLimits | None = None,
    sensors: SensorEpochs | None = None,
    levels: bool = False,
    trace: list[Step] | None = None,
) -> tuple[Tracked, TrackState]:
    """Places along the trajectory, each from its own and earlier epochs.

    Parameters
    ----------
    epochs : GnssEpochs
        T epochs in rising time; those without any measurement are predicted.
    line : Line
    state : TrackState, optional
        Left by the epochs before; None at the start.
    limits : TrackingLimits, optional
    sensors : SensorEpochs, optional
    levels : bool
        Whether a bank of sub-filters gives a level at every epoch (`railfix.tracking.levels`: at a lower rate).
    trace : list of Step, optional
        Gets what the smoother needs of each epoch (`railfix.tracking.smoother`); all epochs are then done by numpy.

    Returns
    -------
    Tracked
    TrackState
        Epochs one by one with the state handed on give the same numbers as all at once.
    """
    limits, sensors = limits or TrackingLimits(), sensors or SensorEpochs()
    state = TrackState.empty() if state is None else copy(state)
    result = Tracked.empty(epochs.time, len(epochs.satellite))
    if len(epochs):
        chunk = prepared(epochs, state, limits)
        anew = np.asarray(chunk.fresh.any(axis=1))
        fast = None
        if kernels.CHOSEN == "numba" and trace is None:
            fast = Compiled(chunk, line, sensors, limits, result, levels=levels)
        epoch = 0
        while epoch < len(epochs):
            done = epoch if fast is None else fast.advance(state, epoch)
            if done == epoch:
                _step(chunk, epoch, line, state, limits, sensors, result, bool(anew[epoch]), levels, trace)
                done += 1
            epoch = done
        leave(chunk, epochs, state, limits)
    np.add(result.arc_m, line.round_m(result.arc_m), out=result.arc_m)
    return result, state


def _step(
    chunk: Chunk,
    epoch: int,
    line: Line,
    state: TrackState,
    limits: TrackingLimits,
    sensors: SensorEpochs,
    result: Tracked,
    anew: bool,
    levels: bool,
    trace: list[Step] | None,
) -> None:
    """One epoch: changes the state, writes its row of the result."""
    dt = float(chunk.interval_s[epoch])
    if chunk.apart[epoch] or chunk.off_map[epoch]:
        state.forget()
    if chunk.off_map[epoch]:
        state.time, result.status[epoch] = chunk.time[epoch], TrackStatus.OFF_MAP
        if trace is not None:
            trace.append(Step(dt=dt, cut=np.zeros(state.mean.shape, dtype=np.bool_), satellite=state.satellite))
        return
    if anew:
        fresh = np.flatnonzero(chunk.fresh[epoch])
        state.code_bias = np.where(chunk.fresh[epoch], 0.0, state.code_bias)
        state.mean, state.covariance = begun_anew(state.mean, state.covariance, SATELLITES + fresh)
        if state.bank is not None:
            means, covariances = begun_anew(state.bank.mean, state.bank.covariance, SATELLITES + fresh)
            state.bank = replace(state.bank, mean=means, covariance=covariances)
    state.go_round(line)
    lost = seek(state, chunk, epoch, line, limits)
    state.time = chunk.time[epoch]
    step = Step(dt=dt, cut=np.zeros(state.mean.shape, dtype=np.bool_), satellite=state.satellite)
    step.narrowed, state.narrowed = state.narrowed, None
    step.cut[:, SATELLITES + np.flatnonzero(chunk.fresh[epoch])] = True
    if not state.hypotheses:
        if trace is not None:
            trace.append(step)
        return
    code_s = code_interval_s(chunk, epoch, state.coded, limits)
    if code_s > 0.0:
        faulty = is_faulty(state.code_bias, chunk.slot) & chunk.has[0, epoch]
        chunk.variance[0, epoch] *= np.where(faulty, INFLATED, 1.0) / min(code_s, 1.0)
        result.faulty[epoch] = faulty
    else:
        chunk.has[0, epoch] = False
    mean = state.mean
    sensed = sensor_rows(sensors, epoch, line, mean, dt, state.direction)
    rows = rows_of(chunk, epoch, line, mean, mean[:, _PLACES], state.log_scale, sensed)
    widen(state, dt, limits)
    measured = len(rows.variance) > 0
    if measured:
        measured = _measure(chunk, epoch, rows, line, state, limits, sensors, result, code_s, lost, levels, step)
    if not measured:
        state.withheld_s = max(state.withheld_s - dt, 0.0)
    if not measured and state.bank is not None:
        means, covariances = predict_bank(state.bank, line, dt, limits, state.map_scale)
        state.bank = replace(state.bank, mean=means, covariance=covariances)
    speed = float(state.mean[most_probable(state.log_probability), Unknown.SPEED])
    if abs(speed) > DIRECTION_MPS:
        state.direction = float(np.sign(speed))
    state.unaided_m = 0.0 if measured and rows.bounds[0] else state.unaided_m + abs(speed) * dt
    state.branch_s, state.branch_m = state.branch_s + dt, state.branch_m + abs(speed) * dt
    state.log_least = np.minimum(state.log_least + LEAST_RISE * dt, state.log_probability)
    if state.hypotheses > 1:
        chosen, probability = surviving(state.mean, state.covariance, state.log_probability, state.origin_m, limits)
        state.mean, state.covariance = state.mean[chosen], state.covariance[chosen]
        state.log_probability, state.origin_m = probability, state.origin_m[chosen]
        state.parent, state.log_code = state.parent[chosen], state.log_code[chosen]
        state.log_least = state.log_least[chosen]
        step.choose(chosen)
    if state.branch_s > TAKEOVER_AFTER_S and state.log_least[0] < TAKEOVER:
        state.across = ACROSS_TAKEN
    if trace is not None:
        step.mean, step.covariance, step.parent = state.mean, state.covariance, state.parent
        trace.append(step)
    write_place(result, epoch, state, line, dt, measured=measured, lost=lost, limits=limits)


def _measure(
    chunk: Chunk,
    epoch: int,
    rows: Rows,
    line: Line,
    state: TrackState,
    limits: TrackingLimits,
    sensors: SensorEpochs,
    result: Tracked,
    code_s: float,
    lost: bool,
    levels: bool,
    step: Step,
) -> bool:
    """Update the state by the rows of an epoch; return False where no train can do what they say."""
    dt = float(chunk.interval_s[epoch])
    before, predicted_covariance = state.mean, state.covariance
    mean, covariance, offset_known = clocks_of_epoch(
        rows, chunk.offset, before, predicted_covariance, state.offset_known
    )
    value = rows.value - (rows.design @ (rows.combine @ (mean - before)[..., None]))[..., 0]
    rows = replace(rows, value=value)
    prior = prior_of(rows, covariance)
    tails, passes = limits.tails, limits.passes
    weight = first_weights(rows, prior, tails)
    shift = code_shift(rows, prior, weight, most_probable(state.log_probability))
    update = robust_update(rows, prior, weight, tails=tails, passes=passes)
    doubtful = min(_least(update.weight[:, part]) for part in (rows.codes, rows.motion)) < DOUBTFUL
    if doubtful:
        update = better_mode(rows, prior, update, FREEDOM, tails=tails, passes=passes)
    after = applied(mean, covariance, prior, update)
    settled, point = rows, mean[:, _PLACES]
    for _ in range(RELINEARISED):
        places = after[0][:, _PLACES]
        if np.abs(places[:, 0] - point[:, 0]).max() < MOVED_M:
            break
        point = places
        sensed = sensor_rows(sensors, epoch, line, mean, dt, state.direction)
        settled = rows_of(chunk, epoch, line, mean, point, state.log_scale, sensed)
        prior = prior_of(settled, covariance)
        update = robust_update(settled, prior, update.weight, tails=tails, passes=passes)
        after = applied(mean, covariance, prior, update)
    satellites = max(part.stop - part.start for part in rows.common[1:])
    trusted = not 0 < satellites < limits.trusted_satellites or len(rows.variance) > rows.bounds[2]
    if state.hypotheses == 1 and not possible(state, after[0][0], after[1][0], trusted=trusted):
        state.weak_motion_s += dt
        widen(state, dt, limits, refused=True)
        write_rows(result, epoch, rows, rows.value[0], np.zeros_like(update.weight[0]))
        return False
    state.offset_known = offset_known
    if state.hypotheses > 1:
        evidence = log_evidence(settled, prior, update, tails)
        motion = motion_evidence(settled, prior, update, tails=tails, passes=passes)
        code = evidence - motion
        if not tells_motion(rows):
            motion = np.zeros_like(motion)
        if rows.bounds[0] < MOTION_SATELLITES:
            code = np.zeros_like(code)
        places = line.at(after[0][:, Unknown.PLACE])[0]
        log_probability, state.log_code = judged(
            state.log_probability, state.log_code, motion, code, places, state.branch_s, state.branch_m,
            dt, limits,
        )  # fmt: skip
        state.log_probability = log_probability - np.logaddexp.reduce(log_probability)
    step.cut |= np.diagonal(covariance, axis1=1, axis2=2) != np.diagonal(predicted_covariance, axis1=1, axis2=2)
    step.updated = (covariance, settled.combine / prior.root[:, :, None], prior.information, update)
    state.mean, state.covariance = on_the_line(*after, line, limits), after[1]
    pushed = np.abs(state.mean[:, Unknown.PLACE] - after[0][:, Unknown.PLACE])
    state.measured = chunk.time[epoch]
    if rows.bounds[0]:
        state.coded = chunk.time[epoch]
    best = most_probable(state.log_probability)
    if levels:
        bank = Bank.empty(mean.shape[1]) if state.bank is None or lost or best else state.bank
        stepped = np.diagonal(covariance[best]) != np.diagonal(predicted_covariance[best])
        named = np.append(chunk.satellite, "")[rows.column]  # column -1: no satellite's, as of a place
        remembered = frozenset(state.satellite[chunk.remembered[epoch]].tolist())
        own = (mean[best], covariance[best])
        scale, map_scale = state.log_scale, state.map_scale
        state.bank = levelled(
            bank, settled, best, own, stepped, named, remembered, chunk, epoch, scale, line, limits, map_scale
        )
    learn(state, rows, update, best, dt, code_s, limits)
    learn_map(state, 0.0 if best else shift, code_s, limits)
    velocity, spread, age_s = (
        values[epoch] for values in (chunk.velocity_mps, chunk.velocity_covariance, chunk.velocity_age_s)
    )
    square = contradiction(velocity, spread, float(age_s), state.mean[best], state.covariance[best], line)
    watch(state, square, 0.0 if best else shift, float(pushed[best]), dt, code_s, limits)
    if rows.bounds[0]:
        channel = rows.column[rows.codes]
        sigma = chunk.code_sigma_m[epoch, channel] * np.sqrt(1.0 + limits.code_white_share**2)
        value = rows.value[best, rows.codes]
        state.code_bias, found = update_bias(state.code_bias, chunk.slot[channel], value, sigma, code_s)
        if found and abs(shift) < FREED_SIGMAS:
            state.covariance = _freed(state.covariance)
            if state.bank is not None:
                state.bank = replace(state.bank, covariance=_freed(state.bank.covariance))
    write_rows(result, epoch, rows, rows.value[best], update.weight[best])
    return True


def _freed(covariance: Floats) -> Floats:
    """Covariances with a place that a faulty satellite may have led away, shape (H, N, N)."""
    freed = covariance.copy()
    freed[:, Unknown.PLACE, Unknown.PLACE] += FREED_M**2
    return freed


def tells_motion(rows: Rows) -> bool:
    """Whether an epoch's motion tells branches apart: enough satellites, or a sensor."""
    satellites = max(part.stop - part.start for part in rows.common[1:])
    return satellites >= MOTION_SATELLITES or len(rows.variance) > rows.bounds[2]


def _least(weight: Floats) -> float:
    """Least mean weight over the hypotheses, infinite without a row."""
    return float(weight.mean(axis=1).min()) if weight.shape[1] else float("inf")
