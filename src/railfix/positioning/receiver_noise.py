"""Receiver noise scale, single-epoch sigma, robust clocks at a known position, and offsets between receiver clocks.

Two scales are estimated from earlier epochs, as root mean squares with exponential forgetting: the robust one, from the
ranges of each epoch that agree with each other, for the RAIM test, which does not influence it; and the stated one,
from the ranges that RAIM accepted, for every sigma and level. Epochs that RAIM did not resolve, and epochs off the map,
teach neither of them.

Robust fits are iteratively reweighted least squares with the IGG-III weights (Yang, Song and Xu, Journal of Geodesy 76,
2002) and the median of the absolute residuals as scale: no noise level is assumed.

The offsets of the constellations' clocks are stable to a metre over hours. Once one is known, a single satellite of a
constellation contributes, and every satellite is checked against all others. It is estimated from earlier epochs only,
so that results do not depend on chunks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import scipy
from pydantic import Field

from railfix import kernels
from railfix.core.arrays import Datetimes, Floats, Indices, Integers, Masks, Strings, kernel_array
from railfix.core.epoch_rows import EVERY
from railfix.core.settings import Settings
from railfix.positioning.antenna_rows import AntennaRows, Line
from railfix.positioning.noise_windows import Dated, Windows, correlated_sums
from railfix.positioning.normal_equations import Constrained, SinglePoint
from railfix.positioning.range_arrays import UNTIED_M, InterSystemBiases, Ranges
from railfix.track.trajectory import Trajectory


class LastingErrorLimits(Settings):
    """When a satellite is wrong for long."""

    #: Time constant of the mean of the residuals: a minute, as reflections on a train that moves last less.
    memory_s: float = Field(default=60.0, gt=0)
    #: Limit of a residual in standard deviations: of the weights, or of the receiver's noise where that is larger.
    clipped: float = Field(default=2.0, gt=0)
    #: Mean from which on a satellite is left out, over `clipped`. On recordings in cities without a fault the largest
    #: is 0.59, but for satellites seen by reflection alone; 20 m on one satellite reach it after 75 to 115 s.
    share: float = Field(default=0.62, gt=0, le=1)
    most_satellites: int = Field(default=2, ge=0, le=4)  #: Satellites left out at a time; 0: none.


@dataclass(frozen=True, kw_only=True)
class LastingErrorState:
    """Means of the residuals after the last epoch."""

    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    age: float = 0.0  #: [windows].
    channel: Strings = field(default_factory=lambda: np.empty(0, dtype="<U6"))  #: Satellite and signal, shape (S,).
    #: Sums behind the noise of the ranges, those in error included (`NoiseState`); shape (2,).
    noise: Floats = field(default_factory=lambda: np.zeros(2))
    #: In turn: mean square of the residuals of all ranges, without the worst satellite, and so on; shape (S, P).
    sums: Floats = field(default_factory=lambda: np.empty((0, 0)))


_NORMAL_MEDIAN: Final = 0.6745  #: Median of the absolute value of a standard normal variable.


class RobustFitLimits(Settings):
    """Limits of the robust fit."""

    keep: float = Field(default=1.5, gt=0)  #: Residuals up to this many scales have full weight.
    reject: float = Field(default=4.0, gt=0)  #: Residuals from this many scales on have no weight.
    #: Reweightings. On the demonstration with 20 m on one satellite the fifth one changes no verdict.
    iterations: int = Field(default=5, ge=1)


@dataclass(frozen=True, kw_only=True)
class RobustFit:
    """Ranges that agree with each other, T epochs by M channels."""

    kept: Masks  #: Used ranges whose residual is below `RobustFitLimits.reject` scales, shape (T, M).
    #: Weighted sum of squared residuals of the kept ranges over their freedom; NaN without any; shape (T,).
    variance: Floats
    freedom: Integers  #: Redundancy of the kept ranges over clocks and position unknowns, shape (T,).


def map_information(trajectory: Trajectory, section: Indices) -> Floats:
    """Return the inverse covariance of positions across and above a line, ECEF, shape (T, 3, 3) [1/m^2]."""
    return compute_information(trajectory.get_axes(section), trajectory.sigma_plan_m, trajectory.sigma_height_m)


def compute_information(axes: Floats, sigma_plan_m: float, sigma_height_m: float) -> Floats:
    """Return it in the axes of the line there, shape (T, 3, 3), and the sigmas of its map."""
    across, up = axes[:, 1], axes[:, 2]
    return np.asarray(
        across[:, :, None] * across[:, None, :] / sigma_plan_m**2 + up[:, :, None] * up[:, None, :] / sigma_height_m**2
    )


def robust_fit(
    ranges: Ranges, place_ecef_m: Floats, *, information: Floats | None = None, limits: RobustFitLimits | None = None
) -> RobustFit:
    """Fit each epoch with IGG-III weights around the solution of the plain fit, shape (T, 3); steps from it are linear.

    `information`, shape (T, 3, 3) [1/m^2]: known beforehand (`map_information`: one unknown is left); none: three.
    """
    limits = limits or RobustFitLimits()
    used = ranges.weight > 0
    if not used.shape[1]:
        nothing = np.zeros(len(ranges), dtype=np.int64)
        return RobustFit(kept=used, variance=np.full(len(ranges), np.nan), freedom=nothing)
    freedom = ranges.n_used - ranges.n_clocks - (3 if information is None else 1)
    kept, wsse, solved = kernels.robust.reweight_ranges(
        ranges.arrays, kernel_array(place_ecef_m),
        kernel_array(np.empty((0, 3, 3)) if information is None else information),
        np.sqrt(ranges.n_used / np.maximum(freedom, 1)) / _NORMAL_MEDIAN, limits.keep, limits.reject,
        limits.iterations,
    )  # fmt: skip
    left = np.asarray(kept.sum(axis=1) - (ranges.n_used - freedom), dtype=np.int64)
    some = (left > 0) & solved
    return RobustFit(
        kept=kept, variance=np.where(some, wsse / np.maximum(left, 1), np.nan), freedom=np.where(some, left, 0)
    )


def robust_on_line(
    ranges: Ranges,
    line: Line,
    position: Constrained,
    *,
    near_ecef_m: Floats | None = None,
    limits: RobustFitLimits | None = None,
) -> RobustFit:
    """Fit the ranges at positions on the line, or where these are missing at approximate positions, shape (T, 3)."""
    antennas, arc = AntennaRows.on(line), position.arc_m
    if near_ecef_m is None:
        near_ecef_m = antennas.each(lambda index, rows: index.middle_ecef_m[None].repeat(len(arc[rows]), axis=0))
    at = np.where(np.isfinite(arc)[:, None], antennas.at_arc(arc), near_ecef_m)
    axes = antennas.get_axes(np.maximum(position.section, 0))
    information = compute_information(axes, antennas.sigma_plan_m, antennas.sigma_height_m)
    return robust_fit(ranges, at, information=information, limits=limits)


#: Student's t is evaluated at no more than this many degrees of freedom.
_MOST_FREEDOM: Final = 128


class NoiseScaleLimits(Settings):
    """Estimation of a receiver's noise scale."""

    #: Time constant of forgetting. Errors of codes stay alike for about 20 s (correlation 0.6 after 10 s on
    #: recordings): five such times are independent enough for a mean, and short enough that a street or a station left
    #: behind is forgotten before the next one.
    window_s: float = Field(default=100.0, gt=0)
    #: Redundant ranges that a scale of 1 counts for: two or three epochs. Infinite keeps the scale at 1.
    prior: float = Field(default=20.0, gt=0)
    least_epochs: float = Field(default=20.0, ge=1)  #: Epochs that the window spans at least, gaps left out.
    #: Degrees of freedom of the scale from epoch to epoch: the noise of single epochs varies more than chi-square
    #: predicts, so the variance stated for an epoch combines that of its window, counted this many times, with that of
    #: its own residuals. 4 is also the Student t of code errors on recordings.
    spread: float = Field(default=4.0, gt=0)


@dataclass(frozen=True, kw_only=True)
class NoiseState:
    """Decayed sums behind the noise scales, after the last epoch."""

    #: Of the last epoch; NaT before the first.
    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    age: float = 0.0  #: Of the last epoch [windows].
    #: Weighted sum of squared residuals, and degrees of freedom: of the ranges that the robust fit kept, and of those
    #: that RAIM left; shape (2,).
    robust: Floats = field(default_factory=lambda: np.zeros(2))
    remaining: Floats = field(default_factory=lambda: np.zeros(2))


def noise_scale(
    windows: Windows,
    wsse: Floats,
    freedom: Integers,
    teaching: Masks,
    prior: Floats,
    start: Floats,
    *,
    limits: NoiseScaleLimits,
    least: float = 0.0,
) -> tuple[Floats, Floats]:
    """Scale of the ranges against their weights (T,) by the epochs before, `least` at least; and new sums (A, 2).

    Root mean square of the residuals with forgetting around a prior scale (T,); `start`: sums before (A, 2).
    """
    use = teaching & (freedom > 0) & np.isfinite(wsse)
    values = np.array([np.where(use, wsse, 0.0), np.where(use, freedom, 0)], dtype=np.float64).T
    before, after = windows.sums(values, start)
    if np.isinf(limits.prior):
        return np.maximum(prior, least), after
    scale = np.sqrt((before[:, 0] + limits.prior * prior**2) / (before[:, 1] + limits.prior))
    return np.maximum(scale, least), after


def epoch_variance(scale: Floats, wsse: Floats, redundancy: Integers, *, limits: NoiseScaleLimits) -> Floats:
    """Return the variance of the ranges of each epoch against their weights, shape (T,).

    Posterior mean of a variance that scatters about that of the window with `spread` degrees of freedom (scaled inverse
    chi-square distribution), given the epoch's own residuals.
    """
    freedom = np.where(np.isfinite(wsse), np.maximum(redundancy, 0), 0)
    own = np.where(freedom > 0, np.fmax(wsse, 0.0), 0.0)
    return np.asarray((limits.spread * scale**2 + own) / (limits.spread + freedom))


def epoch_sigma_m(redundancy: Integers, wsse: Floats, sigma_m: Floats, scale: Floats) -> Floats:
    """Return the single-epoch sigma along the line, shape (T,) [m].

    The standard deviation by the weights, times the larger of the receiver's scale and the scale of the epoch's own
    residuals, widened as Student's t where the redundancy is small.
    """
    freedom = np.maximum(redundancy, 1)
    shown = np.sqrt(np.maximum(wsse, 0.0) / freedom)
    widened = scipy.special.stdtrit(np.minimum(freedom, _MOST_FREEDOM), 0.975) / scipy.special.ndtri(0.975)
    return np.asarray(sigma_m * np.maximum(scale, shown) * widened)


#: Huber's tuning constant [sigma]: 95 % efficiency for normal errors.
HUBER: Final = 1.345
_ROUNDS: Final = 10


@dataclass(frozen=True, kw_only=True)
class RobustClock:
    """Clocks of T epochs, G groups, K channels."""

    clock_m: Floats  #: NaN with fewer than `least_ranges` ranges, shape (T, G).
    share: Floats  #: Weight of each channel in its clock estimate; 0 for channels not used; shape (T, K).


def robust_clock(
    residual_m: Floats, sigma_m: Floats, groups: tuple[slice, ...], *, least_ranges: int = 4
) -> RobustClock:
    """Return the receiver clock of each group of channels: Huber-weighted mean of residuals, starting at their median.

    `residual_m`, `sigma_m`, shape (T, K): range errors plus the clock, NaN is ignored; `least_ranges`: fewest ranges
    from which a clock is estimated.
    """
    clock = np.full((len(residual_m), len(groups)), np.nan)
    share = np.zeros(residual_m.shape)
    for g, group in enumerate(groups):
        part, sigma = residual_m[:, group], sigma_m[:, group]
        valid = np.isfinite(part) & np.isfinite(sigma)
        rows = (valid.sum(axis=1) >= least_ranges).nonzero()[0]
        if not len(rows):
            continue
        part, valid = np.where(valid, part, np.nan)[rows], valid[rows]
        root = np.where(valid, 1.0 / np.where(valid, sigma[rows], 1.0), 0.0)
        value = np.nanmedian(part, axis=1)
        residual = np.where(valid, part, 0.0)
        for _ in range(_ROUNDS):
            score = np.abs(residual - value[:, None]) * root
            weight = root**2 * np.minimum(1.0, HUBER / np.maximum(score, 1e-12))
            total = weight.sum(axis=1)
            value = (weight * residual).sum(axis=1) / total
        clock[rows, g] = value
        share[rows, group] = weight / total[:, None]
    return RobustClock(clock_m=clock, share=share)


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
    age: float = 0.0  #: Window of the last epoch [windows].

    def sums(self, letters: Sequence[str]) -> Floats:
        """Return the information of some clocks, then their moments, in one array."""
        of_each = (self.information, self.moment)
        return np.array([values.get(letter, 0.0) for values in of_each for letter in letters], dtype=np.float64)

    def later(self, letters: Sequence[str], sums: Floats, last: Dated) -> OffsetState:
        """Return the state with new sums of some clocks (`sums`); the others are unchanged."""
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
