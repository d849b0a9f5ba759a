"""Detection of satellites with persistent code errors from the time average of their clipped residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, Masks, Strings, copy_with
from railfix.core.channel_state import join_channels
from railfix.core.settings import Settings
from railfix.integrity.raim import LinearModel, linear_model
from railfix.integrity.raim.position_model import update_model
from railfix.positioning.antenna_rows import AntennaRows, Line
from railfix.positioning.line_fix import FixLimits, LineFix, refit_epochs
from railfix.positioning.noise_windows import Windows
from railfix.positioning.range_arrays import Ranges, without

#: Ranges with a smaller redundancy number (fraction of a range error that appears in the residual) are not tested.
_LEAST_REDUNDANCY: Final = 0.1
_FORGOTTEN: Final = 1e-12  #: Channels whose mean residuals are all smaller are dropped from the state.
#: Degrees of freedom that must remain after a rejection, so that the remaining ranges can still be tested.
_LEAST_FREEDOM: Final = 2


class LastingErrorLimits(Settings):
    """Limits of the test for persistent range errors."""

    #: Time constant of the mean residual. By default 60 s: reflections on a moving train last less than a minute.
    memory_s: float = Field(default=60.0, gt=0)
    #: Residuals are clipped at this many sigmas; the sigma is from the weights or, if larger, from the receiver noise.
    clipped: float = Field(default=2.0, gt=0)
    #: Mean residual, as a fraction of `clipped`, above which a satellite is rejected. On fault-free city recordings,
    #: the largest mean is 0.59, except for satellites received by reflection only. If one satellite has an error of 20
    #: m, its mean exceeds the limit after 75 to 115 s.
    share: float = Field(default=0.62, gt=0, le=1)
    #: Largest number of satellites rejected at an epoch; 0 disables the test.
    most_satellites: int = Field(default=2, ge=0, le=4)


@dataclass(frozen=True, kw_only=True)
class LastingErrorState:
    """Mean residuals of one antenna at the end of a chunk."""

    #: Time of the last epoch, NaT before the first.
    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    age: float = 0.0  #: Age of the means at the last epoch, in multiples of `memory_s`.
    channel: Strings = field(default_factory=lambda: np.empty(0, dtype="<U6"))  #: Satellite and signal, shape (S,).
    #: Sums (`NoiseState`) from which the noise scale of all ranges, including faulty ranges, is computed; shape (2,).
    noise: Floats = field(default_factory=lambda: np.zeros(2))
    #: Mean residuals as fractions of `clipped`, shape (S, P); column p is the mean after rejecting p satellites.
    sums: Floats = field(default_factory=lambda: np.empty((0, 0)))


class BiasLimits(NamedTuple):
    """Limits of the test for persistent errors, and of positions computed after a rejection."""

    lasting: LastingErrorLimits = LastingErrorLimits()
    fix: FixLimits = FixLimits()


class PersistentBiases(NamedTuple):
    """Positions of T epochs, computed without the satellites that have persistent errors."""

    fix: LineFix
    model: LinearModel  #: Linear model of the positions.
    rejected: Masks  #: True for channels with a persistent error, shape (T, K).


def reject_persistent_biases(
    time: Datetimes,
    channel: Strings,
    ranges: Ranges,
    line: Line,
    fix: LineFix,
    noise: Floats,
    states: Sequence[LastingErrorState],
    limits: BiasLimits,
) -> tuple[Ranges, PersistentBiases, list[LastingErrorState]]:
    """Reject satellites with persistent code errors; return the remaining ranges, new positions and new states.

    A range error of twice the noise sigma passes the single-epoch test of P4. The clipped residuals are therefore
    averaged over time. The satellite with the largest mean is rejected first. Then the positions are computed again,
    and the next satellite is chosen from the new residuals.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    channel : ndarray of str, shape (K,)
        Satellite and signal of each channel.
    ranges, line, fix
        As for `exclude_faults`.
    noise : ndarray, shape (T,)
        Noise scale of the receiver at each epoch; values below 1 count as 1.
    states : sequence of LastingErrorState
        State of each antenna after the previous chunk; `LastingErrorState()` at the start.
    limits : BiasLimits
        No satellite is rejected if `LastingErrorLimits.most_satellites` is 0.
    """
    antennas, (lasting, fix_limits) = AntennaRows.on(line), limits
    model = linear_model(ranges, antennas, fix.constrained.arc_m, section=fix.constrained.section)
    left_out = np.zeros(ranges.code_m.shape, dtype=np.bool_)
    if not lasting.most_satellites:
        return ranges, PersistentBiases(fix, model, left_out), list(states)
    windows = Windows.of(
        time, antennas.parts, [(state.time, state.age) for state in states],
        window_s=lasting.memory_s, least_epochs=lasting.memory_s,
    )  # fmt: skip
    share = np.minimum(windows.step_s, 1.0)[:, None] / lasting.memory_s
    joined = join_channels(channel, [state.channel for state in states], [_is_remembered(state) for state in states])
    sums = np.zeros((lasting.most_satellites, len(states), len(joined.channel)))
    for k, state in enumerate(states):
        sums[: state.sums.shape[1], k] = joined.arrange(state.sums.T, 0.0, k)
    error = _own_errors(model, noise, lasting.clipped)
    for turn in range(lasting.most_satellites):
        mean, sums[turn] = windows.sums(joined.widen(share * error, 0.0), sums[turn])
        found = _find_worst(mean[:, : joined.present], ranges.weight > 0, lasting.share)
        if not found.any():
            continue
        found &= (without(ranges, found).redundancy >= _LEAST_FREEDOM)[:, None]
        left_out |= found
        if found.any():
            ranges = without(ranges, found)
            solved = np.flatnonzero(found.any(axis=1))
            fix = refit_epochs(ranges, antennas, fix, solved, fix_limits)
            model = update_model(model, ranges, antennas, fix.constrained, solved)
            error = _own_errors(model, noise, lasting.clipped)
    after_states = [
        copy_with(state, time=when, age=age, channel=joined.channel, sums=sums[:, k].T) if len(time[rows]) else state
        for k, (rows, state, (when, age)) in enumerate(zip(antennas.parts, states, windows.last, strict=True))
    ]
    return ranges, PersistentBiases(fix, model, left_out), after_states


def _find_worst(mean: Floats, used: Masks, share: float) -> Masks:
    """Return a mask (T, K) of each epoch's used range with the largest absolute mean, if this mean exceeds `share`."""
    found = np.zeros_like(used)
    if mean.shape[1]:
        rows, worst = np.arange(len(mean)), np.abs(np.where(used, mean, 0.0)).argmax(axis=1)
        found[rows, worst] = np.abs(mean[rows, worst]) > share
    return found & used


def _is_remembered(state: LastingErrorState) -> Masks:
    """Return the mask of channels whose means are kept, shape (S,)."""
    return np.asarray((np.abs(state.sums) > _FORGOTTEN).any(axis=1))


def _own_errors(model: LinearModel, noise: Floats, clipped: float) -> Floats:
    """Return normalised residuals, clipped and divided by `clipped`, shape (T, K); 0 for ranges that are not tested."""
    checked = model.redundancy > _LEAST_REDUNDANCY
    own = np.where(checked, model.residual / np.sqrt(np.where(checked, model.redundancy, 1.0)), 0.0)
    own = np.where(np.isnan(own), 0.0, own) / np.maximum(noise, 1.0)[:, None]
    return np.asarray(np.minimum(np.maximum(own, -clipped), clipped) / clipped)
