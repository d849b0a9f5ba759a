"""3-D positions from several constellations whose receiver clocks are tied by inter-system biases.

An inter-system bias is the difference between the receiver clocks of two constellations. It is stable to a metre over
hours. Once it is known, even a single satellite of a constellation contributes to the position and is tested by the
other constellations. Biases are estimated from earlier epochs only, so that results do not depend on the division of a
log into chunks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, Masks, channel_sums, patch_rows
from railfix.core.epoch_rows import EVERY
from railfix.core.settings import Settings
from railfix.positioning.gross_errors import gross_alone
from railfix.positioning.igg3_fit import RobustFitLimits, robust_fit
from railfix.positioning.noise_windows import Dated, correlated_sums
from railfix.positioning.normal_equations import SinglePoint, SinglePointLimits, point_position
from railfix.positioning.range_arrays import UNTIED_M, InterSystemBiases, Ranges, without


class ClockOffsetLimits(Settings):
    """Limits of the estimation of inter-system biases."""

    #: Standard deviation of a bias about its mean; 1.0 m on an urban recording (Galileo, BeiDou). With infinity, every
    #: constellation has a separate clock.
    stability_m: float = Field(default=1.0, gt=0, allow_inf_nan=True)
    #: Epochs within this time are one sample, because errors at standstill are correlated over tens of seconds.
    correlation_s: float = Field(default=30.0, gt=0)
    #: Time constant of exponential forgetting. With the default, the effect of a receiver restart or of an undetected
    #: error decays within half an hour.
    window_s: float = Field(default=1800.0, gt=0)


@dataclass(frozen=True, kw_only=True)
class OffsetState:
    """Inter-system biases estimated so far, by clock letter."""

    information: Mapping[str, float] = field(default_factory=dict)  #: Inverse variance of a bias [1/m^2].
    moment: Mapping[str, float] = field(default_factory=dict)  #: Information times bias [1/m].
    #: Time of the last epoch, NaT before the first.
    last: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    age: float = 0.0  #: Time from the start of the log to the last epoch, in window lengths (`noise_windows`).

    def sums(self, letters: Sequence[str]) -> Floats:
        """Return `information` of G clocks, followed by their `moment`, shape (2 G,); 0 for clocks without a bias."""
        of_each = (self.information, self.moment)
        return np.array([values.get(letter, 0.0) for values in of_each for letter in letters], dtype=np.float64)

    def later(self, letters: Sequence[str], sums: Floats, last: Dated) -> OffsetState:
        """Return the state after epoch `last`, in which the sums of `letters` are replaced by `sums`."""
        count = len(letters)
        return OffsetState(
            information={**self.information, **dict(zip(letters, sums[:count], strict=True))},
            moment={**self.moment, **dict(zip(letters, sums[count:], strict=True))},
            last=last[0],
            age=last[1],
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
) -> tuple[InterSystemBiases, list[OffsetState]]:
    """Estimate inter-system biases at each epoch from earlier epochs (P1 3.3); return the biases and the new states.

    `ranges` are ranges that agree with each other. `free` are the positions computed from them with a separate clock
    for each constellation. `clocks` are the letters of the clocks. `parts` are the rows of each receiver; `states` has
    one item per receiver.
    """
    limits = limits or ClockOffsetLimits()
    epochs = len(time)
    offset, sigma = np.zeros((epochs, len(clocks))), np.full((epochs, len(clocks)), UNTIED_M)
    freedom = np.maximum(ranges.space_redundancy, 1)
    misfit = np.maximum(1.0, free.wsse / freedom)
    others = [g for g, letter in enumerate(clocks) if letter != reference]
    letters = [clocks[g] for g in others]
    sample = np.zeros((epochs, 2 * len(others)))
    if reference in clocks:
        base = [clocks.index(reference)]
        sigma[:, base] = 0.0
        used = ranges.weight > 0
        total = np.stack([channel_sums(ranges.weight[:, group]) for group in ranges.groups], axis=1)
        total = np.maximum(total, 1e-12)
        two = np.add.reduceat(used, ranges.starts, axis=1, dtype=np.intp) >= 2
        known = np.isfinite(free.wsse) & (ranges.space_redundancy > 0)
        usable = two[:, others] & two[:, base] & known[:, None]
        variance = misfit[:, None] * (1.0 / total[:, others] + 1.0 / total[:, base])
        weight = np.where(usable, 1.0 / variance, 0.0)
        difference = np.where(usable, free.clock_m[:, others] - free.clock_m[:, base], 0.0)
        sample = np.concatenate([weight, weight * difference], axis=1)
    before, _, sums, last = correlated_sums(
        time, sample, np.array([state.sums(letters) for state in states]), parts,
        [(state.last, state.age) for state in states], window_s=limits.window_s, correlation_s=limits.correlation_s,
    )  # fmt: skip
    after = [state.later(letters, *ended) for state, *ended in zip(states, sums, last, strict=True)]
    of_information, of_moment = before[:, : len(others)], before[:, len(others) :]
    has = of_information > 0.0
    safe = np.where(has, of_information, 1.0)
    offset[:, others] = np.where(has, of_moment / safe, 0.0)
    spread = np.sqrt(limits.stability_m**2 + 1.0 / safe)
    sigma[:, others] = np.where(has & (spread < UNTIED_M), spread, UNTIED_M)
    return InterSystemBiases(offset_m=offset, sigma_m=sigma), after


class PointPositions(NamedTuple):
    """3-D positions of T epochs and the inter-system biases."""

    point: SinglePoint  #: Least-squares position with one clock per constellation.
    tied: SinglePoint  #: Least-squares position with clocks tied by known biases.
    free: SinglePoint  #: Position with one clock per constellation, from the ranges that agree with each other.
    disagreeing: Masks  #: True for used ranges that disagree with the position `free`, shape (T, K).
    ties: InterSystemBiases
    #: True for the only range of a clock if it contradicts the known bias by more than `GROSS_M`, shape (T, K).
    gross: Masks


class TieLimits(NamedTuple):
    """Limits of the 3-D positions, of their robust fit, and of the inter-system biases."""

    single_point: SinglePointLimits = SinglePointLimits()
    robust_fit: RobustFitLimits = RobustFitLimits()
    clock_offsets: ClockOffsetLimits = ClockOffsetLimits()


def tie_constellations(
    time: Datetimes,
    clocks: tuple[str, ...],
    ranges: Ranges,
    near_ecef_m: ArrayLike,
    states: Sequence[OffsetState] = (OffsetState(),),
    *,
    reference: str | None = None,
    parts: Sequence[slice] = (EVERY,),
    limits: TieLimits | None = None,
) -> tuple[Ranges, PointPositions, list[OffsetState]]:
    """Return ranges tied by known inter-system biases, 3-D positions (P1 5), and the new states.

    Each additional constellation requires one satellite to estimate its clock, unless the bias of this clock is known
    to a metre. Biases are estimated from ranges that agree with each other, and averaged over earlier epochs.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    clocks : tuple of str
        Letter of each receiver clock (`Channels.clocks`).
    ranges : Ranges
        Returned by `weighted_ranges`.
    near_ecef_m : array_like, shape (3,) or (T, 3) [m]
        Approximate positions.
    states : sequence of OffsetState
        State of each receiver after the previous chunk.
    reference : str, optional
        Letter of the reference clock of all biases; by default the GPS clock or, if GPS is not used, the first clock.
    parts : sequence of slice
        Epochs of each receiver.
    limits : TieLimits, optional
    """
    limits = limits or TieLimits()
    near = np.broadcast_to(np.asarray(near_ecef_m, dtype=np.float64), (len(ranges), 3))
    point = point_position(ranges, near, limits=limits.single_point)
    start = np.where(np.isnan(point.ecef_m), near, point.ecef_m)
    agreeing, free, disagreeing = _agreeing(ranges, point, start, limits)
    reference = reference or ("G" if "G" in clocks else clocks[0] if clocks else "G")
    ties, after = tie_clocks(
        time, clocks, reference, agreeing, free, states, parts=parts, limits=limits.clock_offsets
    )  # fmt: skip
    alone = gross_alone(ranges.weight, ranges.groups, point.clock_m, ties)
    if alone.any():
        ranges = without(ranges, alone)
    tied, tied_ranges = point, ranges
    if len(ranges.groups) > 1:
        tied_ranges = replace(ranges, ties=ties)
        tied = _tie(tied_ranges, ties, point, start, limits.single_point)
    return tied_ranges, PointPositions(point, tied, free, disagreeing, ties, alone), after


def _tie(
    ranges: Ranges, ties: InterSystemBiases, point: SinglePoint, start_ecef_m: Floats, limits: SinglePointLimits
) -> SinglePoint:
    """Return 3-D positions with tied clocks; epochs without a known bias have separate clocks."""
    rows = ((ties.sigma_m < UNTIED_M).sum(axis=1) > 1).nonzero()[0]
    if not len(rows):
        return point
    if len(rows) == len(ranges):
        return point_position(ranges, start_ecef_m, limits=limits)
    return patch_rows(point, rows, point_position(ranges.take(rows), start_ecef_m[rows], limits=limits))


def _agreeing(
    ranges: Ranges, point: SinglePoint, start_ecef_m: Floats, limits: TieLimits
) -> tuple[Ranges, SinglePoint, Masks]:
    """Return the ranges that agree on a 3-D position, this position, and a mask of the ranges that disagree with it."""
    dropped = (ranges.weight > 0) & ~robust_fit(ranges, start_ecef_m, limits=limits.robust_fit).kept
    changed = np.flatnonzero(dropped.any(axis=1))
    if not len(changed):
        return ranges, point, dropped
    agreeing = without(ranges, dropped)
    again = point_position(agreeing.take(changed), start_ecef_m[changed], limits=limits.single_point)
    return agreeing, patch_rows(point, changed, again), dropped
