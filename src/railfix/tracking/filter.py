"""The filter along the track: epochs in, places along the trajectory and the state for the next epochs out."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Integers
from railfix.core.timescale import seconds
from railfix.tracking.bank import levelled
from railfix.tracking.clocks import clocks_of_epoch, weighed
from railfix.tracking.epochs import GnssEpochs, Previous, SensorEpochs
from railfix.tracking.hypotheses import most_probable, on_the_line, surviving, with_map_error
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.predict import predicted
from railfix.tracking.result import Tracked, write_place, write_rows
from railfix.tracking.robust import Update, better_mode, first_weights, robust_update
from railfix.tracking.rows import DIRECTION_MPS, Channels, Kind, Rows, gnss_rows, joined, noise_of, sensor_rows
from railfix.tracking.search import sought, with_satellites
from railfix.tracking.state import CLOCKS, Bank, TrackState, Unknown

#: Mean weight of measurements under which another start of the reweighting is tried, and of which kinds.
_DOUBTFUL: Final = 0.7
_MODES: Final = ((Kind.CODE,), (Kind.PHASE, Kind.DOPPLER))
#: Variances of place, speed and acceleration added for that start [m2, m2/s2, m2/s4].
_FREEDOM: Final = np.array([30.0**2, 10.0**2, 3.0**2])
#: The equations are made again when a place has moved by more than this [m]: 26 000 km away a range bends by 2 cm
#: over 1 km, the line by 1 m over 20 m in its sharpest curves.
_MOVED_M: Final = 2.0
_RELINEARISED: Final = 4
#: Shortest interval between epochs [s].
_SHORTEST_S: Final = 1e-3
#: Two epochs further apart than this have nothing to do with each other [s].
_APART_S: Final = 3600.0


def track(
    epochs: GnssEpochs,
    line: Line,
    state: TrackState | None = None,
    *,
    limits: TrackingLimits | None = None,
    sensors: SensorEpochs | None = None,
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

    Returns
    -------
    Tracked
    TrackState
        Epochs one by one with the state handed on give the same numbers as all at once.
    """
    limits, sensors = limits or TrackingLimits(), sensors or SensorEpochs()
    state = state or TrackState.empty()
    result = Tracked.empty(epochs.time, len(epochs.satellite))
    before = _before(epochs, state.previous)
    offset = np.array([CLOCKS.index(str(letter)) for letter in epochs.clock], dtype=np.intp)
    for epoch in range(len(epochs)):
        state = _step(epochs, epoch, before, offset, line, state, limits, sensors, result)
        has_phase = np.isfinite(epochs.phase_m[epoch])
        before = np.where(has_phase, epochs.phase_m[epoch], np.nan), epochs.sat_ecef_m[epoch]
    if len(epochs):
        previous = Previous(time=epochs.time[-1], satellite=epochs.satellite, sat_ecef_m=before[1], phase_m=before[0])
        state = replace(state, previous=previous)
    return result, state


def _before(epochs: GnssEpochs, previous: Previous | None) -> tuple[Floats, Floats]:
    """Phase and satellites of the epoch before the first, in the order of the channels."""
    size = len(epochs.satellite)
    phase, sat = np.full(size, np.nan), np.full((size, 3), np.nan)
    if previous is not None:
        place = {str(name): k for k, name in enumerate(previous.satellite)}
        for column, name in enumerate(epochs.satellite):
            if str(name) in place:
                phase[column] = previous.phase_m[place[str(name)]]
                sat[column] = previous.sat_ecef_m[place[str(name)]]
    return phase, sat


def _step(
    epochs: GnssEpochs,
    epoch: int,
    before: tuple[Floats, Floats],
    offset: Integers,
    line: Line,
    state: TrackState,
    limits: TrackingLimits,
    sensors: SensorEpochs,
    result: Tracked,
) -> TrackState:
    """One epoch; writes its row of the result."""
    now = epochs.time[epoch]
    first = bool(np.isnat(state.time))
    # Two epochs at one instant are a millisecond apart: Dopplers and forces count by the interval.
    dt = 1.0 if first else max(float(seconds(now - state.time)), _SHORTEST_S)
    if dt > _APART_S:
        state, first, dt = replace(TrackState.empty(), log_scale=state.log_scale), True, 1.0
    change = epochs.phase_m[epoch] - before[0]
    change = np.where(epochs.phase_joined[epoch], change, np.nan)
    has = np.isfinite(epochs.code_m[epoch]) | np.isfinite(epochs.rate_mps[epoch]) | np.isfinite(change)
    has &= np.isfinite(epochs.sat_ecef_m[epoch, :, 0])
    old = frozenset(state.satellite.tolist())
    state = with_satellites(state, epochs.satellite, has, now, limits)
    slot = {str(name): k for k, name in enumerate(state.satellite)}
    columns = np.flatnonzero(has)
    channels = Channels(
        slot=np.array([slot[str(name)] for name in epochs.satellite[columns]], dtype=np.intp),
        offset=offset[columns],
        sat_ecef_m=epochs.sat_ecef_m[epoch, columns],
        sat_velocity_mps=epochs.sat_velocity_mps[epoch, columns],
        before_ecef_m=before[1][columns],
        code_m=epochs.code_m[epoch, columns],
        code_sigma_m=epochs.code_sigma_m[epoch, columns],
        rate_mps=epochs.rate_mps[epoch, columns],
        cn0_dbhz=epochs.cn0_dbhz[epoch, columns],
        phase_change_m=change[columns],
        column=columns,
    )
    state, lost = sought(state, channels, line, now, dt, limits)
    if not state.hypotheses:
        return replace(state, time=now if first else state.time)
    mean, covariance = state.mean, state.covariance
    noise = noise_of(channels, dt, limits, state.log_scale)
    samples = (sensors, epoch, state.direction)
    rows = _all_rows(channels, samples, line, mean, mean[:, [Unknown.PLACE, Unknown.BEFORE]], dt, noise)
    if rows.value.shape[1]:
        prior = covariance
        shifted, covariance, known = clocks_of_epoch(rows, channels, mean, covariance, state.offset_known)
        moved = (rows.design @ (shifted - mean)[..., None])[..., 0]
        mean, rows = shifted, replace(rows, value=rows.value - moved)
        weight = first_weights(rows, covariance, limits.degrees_of_freedom)
        innovation = rows.value
        update = _settled(rows, weight, channels, samples, line, mean, covariance, dt, noise, limits)
        places = mean[:, Unknown.PLACE] + update.change[:, Unknown.PLACE]
        evidence = with_map_error(update.log_evidence, line.at(places)[0], state.log_probability, limits)
        log_probability = state.log_probability + evidence
        after = on_the_line(mean + update.change, update.covariance, line, limits)
        state = replace(
            state,
            mean=after,
            covariance=update.covariance,
            log_probability=log_probability - np.logaddexp.reduce(log_probability),
            offset_known=known,
            measured=now,
        )
        best = most_probable(state.log_probability)
        if limits.level == "on":
            named = np.where(rows.column >= 0, epochs.satellite[rows.column], "")
            bank = Bank.empty(mean.shape[1]) if state.bank is None or lost or best else state.bank
            stepped = np.diagonal(covariance[best]) != np.diagonal(prior[best])
            new = frozenset(state.satellite.tolist()) - old
            before_update = (mean[best], covariance[best])
            bank = levelled(bank, rows, best, before_update, stepped, named, new, line, dt, limits)
            state = replace(state, bank=bank)
        state = weighed(state, rows, update, best, dt, limits)
        write_rows(result, epoch, rows, innovation[best], update.weight[best])
    elif state.bank is not None:
        means, covariances = predicted(state.bank.mean, state.bank.covariance, line, dt, limits)
        state = replace(state, bank=replace(state.bank, mean=means, covariance=covariances))
    speed = float(state.mean[most_probable(state.log_probability), Unknown.SPEED])
    state = replace(state, direction=float(np.sign(speed)) if abs(speed) > DIRECTION_MPS else state.direction)
    aided = bool((rows.kind == Kind.CODE).any())
    travel = abs(speed) * dt
    state = replace(state, unaided_m=0.0 if aided else state.unaided_m + travel)
    chosen, probability = surviving(state.mean, state.covariance, state.log_probability, state.origin_m, limits)
    state = replace(
        state,
        time=now,
        mean=state.mean[chosen],
        covariance=state.covariance[chosen],
        log_probability=probability,
        origin_m=state.origin_m[chosen],
    )
    write_place(result, epoch, state, measured=rows.value.shape[1] > 0, lost=lost, limits=limits)
    return state


def _all_rows(
    channels: Channels,
    samples: tuple[SensorEpochs, int, float],
    line: Line,
    mean: Floats,
    point: Floats,
    dt: float,
    noise: tuple[Floats, ...],
) -> Rows:
    return joined(
        gnss_rows(channels, line, mean, point, dt, noise),
        sensor_rows(samples[0], samples[1], line, mean, dt, samples[2]),
    )


def _settled(
    rows: Rows,
    weight: Floats,
    channels: Channels,
    samples: tuple[SensorEpochs, int, float],
    line: Line,
    mean: Floats,
    covariance: Floats,
    dt: float,
    noise: tuple[Floats, ...],
    limits: TrackingLimits,
) -> Update:
    """Update about the place that it leads to: the equations are made again where that is some way off."""
    places_of = [Unknown.PLACE, Unknown.BEFORE]
    degrees, passes = limits.degrees_of_freedom, limits.passes
    update = robust_update(rows, covariance, weight, degrees=degrees, passes=passes)
    if min(_least_weight(rows, update, kinds) for kinds in _MODES) < _DOUBTFUL:
        update = better_mode(rows, covariance, update, _FREEDOM, degrees=degrees, passes=passes)
    point = mean[:, places_of]
    for _ in range(_RELINEARISED):
        after = mean[:, places_of] + update.change[:, places_of]
        if np.abs(after[:, 0] - point[:, 0]).max() < _MOVED_M:
            break
        point = after
        rows = _all_rows(channels, samples, line, mean, point, dt, noise)
        update = robust_update(rows, covariance, update.weight, degrees=degrees, passes=passes)
    return update


def _least_weight(rows: Rows, update: Update, kinds: tuple[Kind, ...]) -> float:
    """Least mean weight of some kinds over the hypotheses; infinite without any."""
    mask = rows.of(kinds)
    return float(update.weight[:, mask].mean(axis=1).min()) if mask.any() else float("inf")
