"""Phase ambiguities estimated together with positions along the line (P4), and integer fixing.

The unknowns of the epochs (distance and clocks) are eliminated, so that the normal matrix has one row per phase arc.
Integers are fixed where the probability of a wrong integer is small enough. This probability follows from Bayes' rule.
The density of the float ambiguities at one integer vector is compared with the density at all other integer vectors,
and with the uniform density of non-integer phases (multipath, half cycles). `PhaseLimits.no_integer_prior` is the prior
probability of non-integer phases.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, Indices, Integers, Masks
from railfix.core.notebook import NotebookTable
from railfix.core.settings import Settings
from railfix.core.timescale import GPS_EPOCH, seconds
from railfix.positioning.carrier.observation_model import IntegerChannels, Linearised, OwnUnknowns, PhaseClocks, Phases
from railfix.positioning.range_arrays import Ranges
from railfix.positioning.standstill_phase import IntegerSearch
from railfix.track.trajectory import Trajectory

FREE_AMBIGUITY_M: Final = 1e4  #: Prior sigma of ambiguities about their first values; keeps matrices invertible [m].
FORGET_S: Final = 600.0  #: An arc ends if it is not observed for a longer time than this [s].


class PhaseLimits(Settings):
    """Limits of the float ambiguities."""

    clocks: PhaseClocks = "own"  #: Receiver clock of the phases: separate ("own"), or shared with the codes (P4).
    #: [m/sqrt(s)] Random walk of an ambiguity. It covers changes of ionospheric, orbit, satellite clock and multipath
    #: errors of one phase relative to the other phases. Without a random walk, phases that drift by centimetres while
    #: satellites move by hundredths of a radian bias the position by metres. With a code noise of 1 m at 1 Hz, the
    #: default averages over about 100 s. With 0, ambiguities are constant.
    drift_m: float = Field(default=0.01, ge=0)
    hop_s: float = Field(default=10.0, gt=0)  #: Time step of the random walk of the ambiguities.
    #: Correlation time of code errors. Several epochs within this time are no more informative for ambiguities than
    #: one. The variance of the ambiguities is therefore multiplied by correlation time / interval, up to the variance
    #: from codes alone. Positions are unaffected. Use 0 for white noise, for example in simulations.
    correlation_s: float = Field(default=20.0, ge=0)
    #: Number of linearisations, each with a separate state, so that results do not depend on the division into chunks.
    passes: int = Field(default=2, ge=1)
    #: Ambiguities are fixed if the probability of a wrong integer is at most this. Fixing requires a base station.
    integer_risk: float = Field(default=1e-4, gt=0, lt=0.5)
    #: Prior probability that phase ambiguities are not integers (multipath, half cycles).
    no_integer_prior: float = Field(default=1e-2, gt=0, lt=1)
    #: Epochs with a noise sigma along the line above this have no position.
    largest_sigma_m: float = Field(default=1e3, gt=0)


def number_hops(time: Datetimes, limits: PhaseLimits) -> Integers:
    """Return the number of the time step (`hop_s`) that contains each time, shape (T,)."""
    nanoseconds = (time.astype("datetime64[ns]") - GPS_EPOCH).astype(np.int64)
    return np.asarray(nanoseconds // round(limits.hop_s * 1e9), dtype=np.int64)


def count_repeats(time: Datetimes, limits: PhaseLimits) -> Floats:
    """Return the larger of 1 and correlation time / time since the previous epoch, for each epoch, shape (T,)."""
    step = np.append(np.nan, seconds(np.diff(time)))
    with np.errstate(divide="ignore"):
        share = limits.correlation_s / step
    return np.asarray(np.maximum(1.0, np.where(np.isnan(share), 1.0, share)))


@dataclass(frozen=True, kw_only=True)
class ArcAmbiguities:
    """Ambiguities of A phase arcs."""

    arc_id: Integers  #: Number of each arc (`number_arcs`), shape (A,).
    #: Phase minus distance minus clock, shape (A,). It contains whole cycles, phase wind-up and signal delays. With a
    #: separate phase clock, ambiguities are determined except for a common constant. The mean of the corrections to the
    #: ambiguities' first values is therefore set to zero, and the covariance is relative to this mean.
    ambiguity_m: Floats
    covariance_m2: Floats  #: Noise covariance without the map error, shape (A, A).


@dataclass(frozen=True, kw_only=True, repr=False)
class PhasePositions(NotebookTable):
    """Positions along the line from codes and phases, at T epochs; arrays of channels have shape (T, M)."""

    #: Arc length, shape (T,); NaN without an initial position or if `noise_sigma_m` is too large.
    arc_m: Floats
    sigma_m: Floats  #: Standard deviation of `arc_m`, including the map error, shape (T,).
    noise_sigma_m: Floats  #: Standard deviation of `arc_m` due to noise alone, shape (T,).
    clock_m: Floats  #: Receiver clock of each group, shape (T, G); NaN without a position.
    code_residual_m: Floats  #: Observed minus computed code, shape (T, M); NaN if unused.
    phase_residual_m: Floats  #: Observed minus computed phase, shape (T, M); NaN if unused.
    ambiguity_m: Floats  #: Ambiguity of each used phase, as estimated at the epoch, shape (T, M).
    ambiguity_sigma_m: Floats  #: Standard deviation of `ambiguity_m`, shape (T, M).
    n_codes: Integers  #: Number of used codes, shape (T,).
    n_phases: Integers  #: Number of used phases, shape (T,).
    n_fixed: Integers  #: Number of ambiguity differences that are fixed to whole cycles, shape (T,).
    #: Probability that the fixed integers or, if none are fixed, the best candidate integers are wrong, shape (T,); NaN
    #: without candidates.
    integer_risk: Floats
    arcs: ArcAmbiguities | None  #: Arcs that are active after the last epoch; None in pipeline results.

    iterations: int  #: Number of linearisations.


def prepare_start(
    ranges: Ranges, phases: Phases, trajectory: Trajectory, arc_m: Floats
) -> tuple[Ranges, Phases, Floats]:
    """Return ranges, phases and initial positions; epochs without a position have zero weights and arc length 0.

    Raise ValueError if shapes differ or a used phase has no arc.
    """
    shape = ranges.code_m.shape
    if phases.phase_m.shape != shape or phases.weight.shape != shape or phases.arc_id.shape != shape:
        raise ValueError(f"phases have shape {phases.phase_m.shape}, but the ranges have {shape}")
    if np.any((phases.weight > 0) & (phases.arc_id < 0)):
        raise ValueError("a phase with a positive weight has no arc (its arc_id is negative)")
    at = np.isfinite(arc_m)
    if at.all():
        return ranges, phases, np.clip(arc_m, 0.0, trajectory.arc_m[-1])
    without = replace(ranges, weight=np.where(at[:, None], ranges.weight, 0.0))
    silent = replace(phases, weight=np.where(at[:, None], phases.weight, 0.0))
    return without, silent, np.where(at, np.clip(arc_m, 0.0, trajectory.arc_m[-1]), 0.0)


def inverse_of_arcs(matrix: Floats, held: Floats) -> Floats:
    """Return the inverse of normal matrices of ambiguities, shape (..., A, A).

    With a separate phase clock, a constant common to all ambiguities is unobservable. It is chosen so that the mean of
    the ambiguities marked by `held`, shape (..., A), is zero. Ambiguity differences do not depend on this choice.
    """
    size = matrix.shape[-1]
    count = np.maximum(held.sum(axis=-1), 1.0)
    level = np.einsum("...i,...ii->...", held, matrix) / count**2
    full = matrix + level[..., None, None] * held[..., :, None] * held[..., None, :]
    full = full + np.eye(size) * FREE_AMBIGUITY_M**-2.0
    return np.linalg.inv(full).astype(np.float64, copy=False)


def assemble_positions(
    arc_m: Floats,
    started: Masks,
    own: OwnUnknowns,
    lin: Linearised,
    ambiguity: tuple[Floats, Floats],
    arcs: ArcAmbiguities,
    fixes: tuple[Integers, Floats],
    limits: PhaseLimits,
) -> PhasePositions:
    """Return the positions of a segment, NaN where missing; `ambiguity` has values [m] and variances [m^2]."""
    (ambiguity_m, variance_m2), has = ambiguity, started & (own.noise_sigma_m <= limits.largest_sigma_m)
    code, phase = lin.code_weight > 0, lin.phase_weight > 0
    return PhasePositions(
        arc_m=np.where(has, arc_m, np.nan),
        sigma_m=np.where(has, own.sigma_m, np.nan),
        noise_sigma_m=np.where(has, own.noise_sigma_m, np.nan),
        clock_m=np.where(has[:, None], own.clock_m, np.nan),
        code_residual_m=np.where(code & has[:, None], own.code_residual_m, np.nan),
        phase_residual_m=np.where(phase & has[:, None], own.phase_residual_m, np.nan),
        ambiguity_m=np.where(phase, ambiguity_m, np.nan),
        ambiguity_sigma_m=np.where(phase, np.sqrt(np.where(phase, variance_m2, 1.0)), np.nan),
        n_codes=np.count_nonzero(code, axis=1).astype(np.int64),
        n_phases=np.count_nonzero(phase, axis=1).astype(np.int64),
        n_fixed=np.where(has, fixes[0], 0),
        integer_risk=np.where(has, fixes[1], np.nan),
        arcs=arcs,
        iterations=limits.passes,
    )


_VECTORS: Final = 12  #: Number of compared integer vectors.
#: Fractions of the ambiguity differences (strongest phases first) to fix together, in the order of the attempts.
_SHARES: Final = (1.0, 0.75, 0.5)


@dataclass(frozen=True, kw_only=True)
class Fixed:
    """Ambiguities of A arcs after integer fixing."""

    value_m: Floats  #: Ambiguities, and their changes for a map error of 1 m across and in height, shape (A, 3).
    covariance_m2: Floats  #: Noise covariance, shape (A, A).
    count: int  #: Number of fixed differences; 0 for float ambiguities.
    #: Probability that the fixed integers or, if none are fixed, the best candidate integers are wrong; NaN without
    #: candidates.
    risk: float


def fix_integers(
    value_m: Floats,
    covariance_m2: Floats,
    strength: Floats,
    channels: IntegerChannels,
    map_sigma_m: tuple[float, float],
    *,
    largest_risk: float,
    no_integer_prior: float,
) -> Fixed:
    """Fix differences of float ambiguities to whole cycles; if the risk is too large, return the float ambiguities.

    Parameters
    ----------
    value_m : ndarray, shape (A, 3) [m]
        Float ambiguities, and their changes for a map error of 1 m across and in height.
    covariance_m2 : ndarray, shape (A, A) [m^2]
        Noise covariance.
    strength : ndarray, shape (A,)
        Weight of each phase. The phase with the largest weight in a group is the reference of this group.
    channels : IntegerChannels
        Wavelength and group of each arc.
    map_sigma_m : tuple of float
        Standard deviations of the map error across and in height [m].
    largest_risk, no_integer_prior : float
        See `PhaseLimits`.
    """
    first, second = _differences(strength, channels.group)
    best = Fixed(value_m=value_m, covariance_m2=covariance_m2, count=0, risk=float("nan"))
    count = len(first)
    for size in dict.fromkeys(max(2, int(np.ceil(share * count))) for share in _SHARES):
        if size > count:
            break
        kept = slice(0, size)
        fixed = _fix_pairs(
            (value_m, covariance_m2), (first[kept], second[kept]), channels.wavelength_m[first[kept]],
            np.array(map_sigma_m), no_integer_prior,
        )  # fmt: skip
        if fixed is None:
            continue
        if fixed.risk <= largest_risk:
            return fixed
        best = Fixed(value_m=value_m, covariance_m2=covariance_m2, count=0, risk=float(np.fmin(best.risk, fixed.risk)))
    return best


def _differences(strength: Floats, group: Integers) -> tuple[Indices, Indices]:
    """Return pairs of an arc and its group's reference arc, sorted by descending strength of the first arc."""
    first, second = [], []
    for each in np.unique(group[group >= 0]).tolist():
        own = np.flatnonzero(group == each)
        own = own[np.argsort(-strength[own], kind="stable")]
        first += own[1:].tolist()
        second += [int(own[0])] * (len(own) - 1)
    order = np.argsort(-strength[first], kind="stable") if first else np.empty(0, dtype=np.intp)
    return np.array(first, dtype=np.intp)[order], np.array(second, dtype=np.intp)[order]


def _fix_pairs(
    ambiguities: tuple[Floats, Floats],
    pairs: tuple[Indices, Indices],
    wavelength_m: Floats,
    map_sigma_m: Floats,
    no_integer_prior: float,
) -> Fixed | None:
    """Fix the differences of `pairs` to their most probable integers; return None for a singular covariance."""
    value, noise = ambiguities
    rows = np.arange(len(wavelength_m))
    design = np.zeros((len(rows), len(value)))
    design[rows, pairs[0]], design[rows, pairs[1]] = 1.0 / wavelength_m, -1.0 / wavelength_m
    by_map = value[:, 1:] * map_sigma_m
    cross = (noise + by_map @ by_map.T) @ design.T
    covariance = design @ cross
    covariance = 0.5 * (covariance + covariance.T)
    cycles = design @ value[:, 0]
    try:
        integers, squares = IntegerSearch(covariance).nearest(cycles, _VECTORS)
        gain = np.linalg.solve(covariance, cross.T).T
    except np.linalg.LinAlgError:
        return None
    log_density = -0.5 * (squares + np.linalg.slogdet(2.0 * np.pi * covariance)[1])
    peak = max(float(log_density[0]), 0.0)
    weight = (1.0 - no_integer_prior) * np.exp(log_density - peak)
    # non-integer phases have a uniform density of one per cycle
    others = weight[1:].sum() + no_integer_prior * np.exp(-peak)
    step = np.zeros((len(rows), 3))
    step[:, 0] = cycles - integers[0]
    step[:, 1:] = design @ value[:, 1:]
    keep = np.eye(len(value)) - gain @ design
    return Fixed(
        value_m=value - gain @ step,
        covariance_m2=keep @ noise @ keep.T,
        count=len(rows),
        risk=float(others / (weight[0] + others)),
    )
