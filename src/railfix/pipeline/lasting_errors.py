"""Satellites whose codes are wrong for a minute: found by the mean of their residuals, and left out.

RAIM looks at single epochs: an error of twice the noise passes most of them, and for as long as it lasts it raises the
noise that RAIM tests with. Noise and reflections come and go, a clock record that is wrong, or a reflection off a wall
that a train stands before, keeps its sign. The mean of the residuals over a minute, each clipped, tells one from the
other. The worst satellite is left out, then the worst of the rest, whose residuals are then those without the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Masks, Strings
from railfix.integrity.raim import LinearModel
from railfix.pipeline.config import Config
from railfix.pipeline.corrected_ranges import CorrectedRanges, without
from railfix.pipeline.solve import Place, line_model, redundancy_of, solved_again
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.forgetting import LastingErrorState, ages, decayed_sums, steps_s
from railfix.positioning.normal_equations import Ranges
from railfix.positioning.section_search import SearchIndex

#: Below this share of its own error in its residual a range tells nothing of it.
_LEAST_REDUNDANCY: Final = 0.1
#: Degrees of freedom that are left, so that the rest is still checked.
_LEAST_FREEDOM: Final = 2


def lasting_errors(
    corrected: CorrectedRanges,
    ranges: Ranges,
    antennas: AntennaRows,
    place: Place,
    noise: Floats,
    config: Config,
    states: Sequence[LastingErrorState],
) -> tuple[Ranges, Place, Masks, list[LastingErrorState]]:
    """Return what is left without satellites that are wrong for long.

    Returns
    -------
    ranges, place
        Without them.
    left_out : ndarray of bool, shape (T, K)
    states : list of LastingErrorState

    Parameters
    ----------
    corrected : CorrectedRanges
        T epochs by K channels.
    ranges : Ranges
        Of them.
    place : Place
        Positions from these ranges.
    noise : ndarray, shape (T,)
        Noise scale of the receiver.
    states : sequence of LastingErrorState
        By antenna.
    """
    limits, time = config.lasting_errors, corrected.time
    channel = np.char.add(corrected.channels.satellite, corrected.channels.signal)
    left_out = np.zeros(ranges.code_m.shape, dtype=np.bool_)
    if "raim" not in config.screens or not limits.most_satellites:
        return ranges, place, left_out, list(states)
    least = {"window_s": limits.memory_s, "least_epochs": limits.memory_s}
    age = antennas.apart(lambda _, rows, state: ages(time[rows], state.time, state.age, **least), states)
    sums: list[list[Floats]] = [[] for _ in states]
    for turn in range(limits.most_satellites):
        error = _own_errors(line_model(ranges, antennas, place.constrained), noise, limits.clipped)

        def mean_error(
            _: SearchIndex, rows: slice, of_antenna: Floats, state: LastingErrorState, values: Floats = error,
            turn: int = turn,
        ) -> tuple[Floats, Floats]:  # fmt: skip
            share = np.minimum(steps_s(time[rows], state.time), 1.0) / limits.memory_s
            start = _arrange(state.sums[:, turn : turn + 1], state.channel, channel).sum(axis=1)
            return decayed_sums(of_antenna, share[:, None] * values[rows], start, state.age)

        mean, after = antennas.each_with_state(mean_error, age, states)
        for k, new in enumerate(after):
            sums[k].append(new)
        worst = np.abs(np.where(ranges.weight > 0, mean, 0.0)).argmax(axis=1) if len(channel) else np.zeros(0, int)
        found = np.zeros_like(left_out)
        if len(channel):
            rows = np.arange(len(worst))
            found[rows, worst] = np.abs(mean[rows, worst]) > limits.share
            found &= ranges.weight > 0
            found &= (redundancy_of(without(ranges, found)) >= _LEAST_FREEDOM)[:, None]
        left_out |= found
        if found.any():
            ranges = without(ranges, found)
            for index, epochs in antennas.split(np.flatnonzero(found.any(axis=1))):
                place = solved_again(ranges, index, place, epochs, config)
    after_states = [
        replace(
            state,
            time=time[rows][-1],
            age=float(own[-1]),
            channel=channel,
            sums=np.stack(new, axis=1),
        )
        if len(time[rows])
        else state
        for rows, own, new, state in zip(antennas.parts, age, sums, states, strict=True)
    ]
    return ranges, place, left_out, after_states


def _own_errors(model: LinearModel, noise: Floats, clipped: float) -> Floats:
    """Return the residuals over their standard deviations, clipped, over `clipped`; 0 where nothing checks a range."""
    checked = model.redundancy > _LEAST_REDUNDANCY
    own = np.where(checked, model.residual / np.sqrt(np.where(checked, model.redundancy, 1.0)), 0.0)
    own = np.nan_to_num(own) / np.maximum(noise, 1.0)[:, None]
    return np.asarray(np.clip(own, -clipped, clipped) / clipped)


def _arrange(sums: Floats, of_channel: Strings, channel: Strings) -> Floats:
    """Return sums by channel, in rows, for other channels: 0 for new ones; those that are gone are forgotten."""
    start = np.zeros((len(channel), sums.shape[1]))
    _, here, there = np.intersect1d(channel, of_channel, return_indices=True)
    start[here] = sums[there]
    return start
