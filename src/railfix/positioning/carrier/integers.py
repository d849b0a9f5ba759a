"""Integer ambiguities along a line: fixed where the risk that they are wrong is bounded.

Beside a base station the differences of ambiguities of one signal are whole cycles. On a line a place has one unknown
and the error of the map, so that phases of two or three satellites tell integers apart where a place in space takes
five. Which integers are right is decided by Bayes' rule: each vector with the density of the float ambiguities around
it, against all other vectors and against phases that are no whole cycles (multipath, half cycles), of which the prior
probability is `PhaseLimits.no_integer_prior` and the density uniform. LAMBDA (`railfix.positioning.standstill_phase`)
finds the vectors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers
from railfix.positioning.standstill_phase import IntegerSearch

#: Vectors compared.
_VECTORS: Final = 12
#: Shares of the differences, those of the strongest phases, that are tried one after the other.
_SHARES: Final = (1.0, 0.75, 0.5)


@dataclass(frozen=True, kw_only=True)
class IntegerChannels:
    """Which channels have ambiguities that differ by whole cycles."""

    wavelength_m: Floats  #: Shape (M,).
    group: Integers  #: The same for channels of one clock and signal; -1 for those without integers; shape (M,).


@dataclass(frozen=True, kw_only=True)
class Fixed:
    """Ambiguities of A arcs with those differences fixed that are certain enough."""

    value_m: Floats  #: Ambiguities, and their responses to a map 1 m off across and in height; shape (A, 3).
    covariance_m2: Floats  #: Of noise alone, shape (A, A).
    count: int  #: Differences fixed; 0: the float ambiguities are returned.
    #: Probability that one of them is wrong, or of the best ones where none is fixed; NaN without any difference.
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
    """Fix differences of float ambiguities to whole cycles.

    Parameters
    ----------
    value_m : ndarray, shape (A, 3) [m]
        Float ambiguities, and their responses to a map 1 m off across and in height.
    covariance_m2 : ndarray, shape (A, A) [m^2]
        Of noise alone.
    strength : ndarray, shape (A,)
        Weight of each phase: the strongest of a group is what the others are differenced with.
    channels : IntegerChannels
        Of the A arcs.
    map_sigma_m : tuple of float
        Standard deviation of the map across and in height [m].
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
        fixed = _fix(
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
    """Return arcs and those that they are differenced with, the strongest first."""
    first, second = [], []
    for each in np.unique(group[group >= 0]).tolist():
        own = np.flatnonzero(group == each)
        own = own[np.argsort(-strength[own], kind="stable")]
        first += own[1:].tolist()
        second += [int(own[0])] * (len(own) - 1)
    order = np.argsort(-strength[first], kind="stable") if first else np.empty(0, dtype=np.intp)
    return np.array(first, dtype=np.intp)[order], np.array(second, dtype=np.intp)[order]


def _fix(
    ambiguities: tuple[Floats, Floats],
    pairs: tuple[Indices, Indices],
    wavelength_m: Floats,
    map_sigma_m: Floats,
    no_integer_prior: float,
) -> Fixed | None:
    """Fix all differences of some pairs to the most probable integers; None where their covariance is singular."""
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
    # A density of one a cycle: phases that are no whole cycles.
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
