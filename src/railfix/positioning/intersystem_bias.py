"""Offsets between the receiver clocks of the constellations, stable to a metre over hours, estimated slowly.

Once an offset is known, a single satellite of a constellation contributes, and every satellite is checked against all
others. It is estimated from earlier epochs only, so that results do not depend on chunks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats
from railfix.core.settings import Settings
from railfix.positioning.antenna_rows import EVERY
from railfix.positioning.noise_scale import correlated_sums
from railfix.positioning.normal_equations import UNTIED_M, ClockTies, Ranges, SinglePoint


class ClockOffsetLimits(Settings):
    """Limits of the inter-system biases."""

    #: Standard deviation of an offset about its mean; infinite leaves every constellation its own clock. On an urban
    #: recording the spread was 1.0 m (Galileo, BeiDou).
    stability_m: float = Field(default=1.0, gt=0, allow_inf_nan=True)
    #: Epochs nearer to each other than this are not independent: errors of a standing train are correlated over tens of
    #: seconds.
    correlation_s: float = Field(default=30.0, gt=0)
    #: Time constant of forgetting: offsets are stable to a metre over hours, so half an hour loses nothing, and the
    #: effect of a receiver restart or of an undetected error fades.
    window_s: float = Field(default=1800.0, gt=0)


@dataclass(frozen=True, kw_only=True)
class OffsetState:
    """Offsets estimated so far, by clock letter."""

    information: Mapping[str, float] = field(default_factory=dict)  #: [1/m^2].
    moment: Mapping[str, float] = field(default_factory=dict)  #: Information times offset [1/m].
    #: Time of the last epoch, NaT before the first.
    last: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    age: float = 0.0  #: Of the last epoch [windows].

    def sums(self, letters: Sequence[str]) -> Floats:
        """Return the information of some clocks, then their moments, in one array."""
        of_each = (self.information, self.moment)
        return np.array([values.get(letter, 0.0) for values in of_each for letter in letters], dtype=np.float64)

    def later(self, letters: Sequence[str], sums: Floats, last: np.datetime64, age: float) -> OffsetState:
        """Return the state with new sums of some clocks (`sums`), those of the others as they are."""
        information, moment = (zip(letters, half, strict=True) for half in np.split(sums, 2))
        return OffsetState(
            information={**self.information, **dict(information)},
            moment={**self.moment, **dict(moment)},
            last=last,
            age=age,
        )


def tie_clocks(
    time: Datetimes,
    clocks: tuple[str, ...],
    reference: str,
    ranges: Ranges,
    free: SinglePoint,
    states: Sequence[OffsetState],
    *,
    parts: Sequence[slice] = (EVERY,),
    limits: ClockOffsetLimits | None = None,
) -> tuple[ClockTies, list[OffsetState]]:
    """Return the offsets known at each epoch from the epochs before it, and the new states of the receivers.

    `ranges`: without ties, those that agree with each other alone, with the letter of each of its groups in `clocks`;
    `free`: position with every clock on its own and a redundant range; `parts`: rows of each receiver.
    """
    limits = limits or ClockOffsetLimits()
    epochs = len(time)
    offset, sigma = np.zeros((epochs, len(clocks))), np.full((epochs, len(clocks)), UNTIED_M)
    freedom = np.maximum(ranges.n_used - ranges.n_clocks - 3, 1)
    misfit = np.maximum(1.0, free.wsse / freedom)
    others = [g for g, letter in enumerate(clocks) if letter != reference]
    letters = [clocks[g] for g in others]
    sample = np.zeros((epochs, 2 * len(others)))
    if reference in clocks:
        base = [clocks.index(reference)]
        sigma[:, base] = 0.0
        used = ranges.weight > 0
        total = np.maximum(np.add.reduceat(ranges.weight, ranges.starts, axis=1), 1e-12)
        two = np.add.reduceat(used, ranges.starts, axis=1, dtype=np.intp) >= 2
        known = np.isfinite(free.wsse) & (ranges.n_used - ranges.n_clocks > 3)
        usable = two[:, others] & two[:, base] & known[:, None]
        variance = misfit[:, None] * (1.0 / total[:, others] + 1.0 / total[:, base])
        weight = np.where(usable, 1.0 / variance, 0.0)
        difference = np.where(usable, free.clock_m[:, others] - free.clock_m[:, base], 0.0)
        sample = np.concatenate([weight, weight * difference], axis=1)
    before, after = np.empty(sample.shape), []
    for state, rows in zip(states, parts, strict=True):
        own, when = state.sums(letters), time[rows]
        before[rows], _, sums, age = correlated_sums(
            when, sample[rows], own, state.last, state.age,
            window_s=limits.window_s, correlation_s=limits.correlation_s,
        )  # fmt: skip
        after.append(state.later(letters, sums, when[-1] if len(when) else state.last, age))
    of_information, of_moment = before[:, : len(others)], before[:, len(others) :]
    has = of_information > 0.0
    safe = np.where(has, of_information, 1.0)
    offset[:, others] = np.where(has, of_moment / safe, 0.0)
    spread = np.sqrt(limits.stability_m**2 + 1.0 / safe)
    sigma[:, others] = np.where(has & (spread < UNTIED_M), spread, UNTIED_M)
    return ClockTies(offset_m=offset, sigma_m=sigma), after
