"""Likelihood of a position at standstill, from double-differenced carrier phases of the train and a base station.

The double differences have integer ambiguities that are constant at standstill. Along a track, integers fit the phases
of all satellites only near the true position (P1 2.5). Each satellite's phase has a constant error, which does not
average out. The integers are found by LAMBDA: decorrelation and a search in a shrinking ellipsoid (Teunissen 1995,
doi:10.1007/BF00863419; Chang, Yang & Zhou 2005, doi:10.1007/s00190-005-0004-x).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy

from railfix.core.arrays import Floats, Integers

#: Integer vectors are omitted if their weighted square exceeds the smallest weighted square by more than this. Their
#: likelihood relative to the best vector is below exp(-20).
_WITHIN: Final = 40.0
_ROUNDING: Final = 1e-9  #: Unknowns are exchanged only if a conditional variance decreases by more than this fraction.


class IntegerSearch:
    """Search for integer vectors near real vectors with a covariance of shape (n, n) [cycle^2]."""

    def __init__(self, covariance: Floats) -> None:
        # unit lower triangular L and variances d with covariance = L' diag(d) L
        upper = np.linalg.cholesky(covariance[::-1, ::-1])[::-1, ::-1].T
        diagonal = np.diag(upper)
        #: Transformed unknowns are `transform.T @ N`; their covariance is `lower.T @ diag(variance) @ lower`.
        self._transform, self._lower, self._variance = _decorrelate(upper / diagonal[:, None], diagonal**2)
        self._back = np.round(np.linalg.inv(self._transform)).astype(np.int64)

    def nearest(self, cycles: Floats, count: int, *, below: float = np.inf) -> tuple[Integers, Floats]:
        """Return up to `count` integer vectors N, nearest first, and their squares ``(N - c)' inv(Q) (N - c)``.

        Vectors with squares of `below` or more are omitted. Shapes are (m, n) and (m,).
        """
        integers, squares = _search(cycles @ self._transform, self._lower, self._variance, count, below)
        return integers @ self._back, squares


def _decorrelate(lower: Floats, variance: Floats) -> tuple[Integers, Floats, Floats]:
    """Return the integer transformation that nearly decorrelates the unknowns, and the new factors L and d."""
    n = len(variance)
    lower, variance, transform = lower.copy(), variance.copy(), np.eye(n, dtype=np.int64)
    rounded_to = n - 2
    k = n - 2
    while k >= 0:
        if k <= rounded_to:
            for i in range(k + 1, n):
                step = round(float(lower[i, k]))
                if step:
                    lower[i:, k] -= step * lower[i:, i]
                    transform[:, k] -= step * transform[:, i]
        new = variance[k] + lower[k + 1, k] ** 2 * variance[k + 1]
        if new < variance[k + 1] * (1.0 - _ROUNDING):
            _exchange(lower, variance, transform, k, float(new))
            rounded_to, k = k, n - 2
        else:
            k -= 1
    return transform, lower, variance


def _exchange(lower: Floats, variance: Floats, transform: Integers, k: int, new: float) -> None:
    """Exchange the unknowns k and k + 1 in place; `new` is the conditional variance of k + 1 after the exchange."""
    share, slope = variance[k] / new, variance[k + 1] * lower[k + 1, k] / new
    variance[k], variance[k + 1] = share * variance[k + 1], new
    above, below = lower[k, :k].copy(), lower[k + 1, :k].copy()
    lower[k, :k] = below - lower[k + 1, k] * above
    lower[k + 1, :k] = share * above + slope * below
    lower[k + 1, k] = slope
    lower[k + 2 :, [k, k + 1]] = lower[k + 2 :, [k + 1, k]]
    transform[:, [k, k + 1]] = transform[:, [k + 1, k]]


def _search(cycles: Floats, lower: Floats, variance: Floats, count: int, below: float) -> tuple[Integers, Floats]:
    """Return the nearest integer vectors of decorrelated unknowns, found by depth-first search."""
    n = len(variance)
    # Python floats are faster here than arrays of one element
    start, weight = cycles.tolist(), (1.0 / variance).tolist()
    conditional, chosen, steps, sums = [0.0] * n, [0.0] * n, [0.0] * n, [0.0] * (n + 1)
    shifts = np.zeros((n + 1, n))
    found: list[tuple[float, list[float]]] = []
    limit, k, descending = below, n - 1, True
    while True:
        if descending:
            conditional[k] = start[k] + float(shifts[k + 1, k])
            chosen[k] = float(round(conditional[k]))
            steps[k] = 1.0 if conditional[k] >= chosen[k] else -1.0
        miss = conditional[k] - chosen[k]
        square = sums[k + 1] + miss * miss * weight[k]
        if square < limit and k > 0:
            sums[k] = square
            np.subtract(shifts[k + 1, :k], miss * lower[k, :k], out=shifts[k, :k])
            k, descending = k - 1, True
            continue
        if square < limit:
            found.append((square, chosen.copy()))
            found.sort()
            del found[count:]
            limit = min(found[-1][0] if len(found) == count else below, found[0][0] + _WITHIN)
        else:
            k += 1
            if k == n:
                break
        # the next nearest integer of this unknown
        chosen[k] += steps[k]
        steps[k] = -steps[k] - (1.0 if steps[k] > 0.0 else -1.0)
        descending = False
    kept = [item for item in found if item[0] <= limit]
    integers = np.array([vector for _, vector in kept]).reshape(-1, n).astype(np.int64)
    return integers, np.array([square for square, _ in kept])


#: Largest number of integer vectors over which a likelihood is summed.
_VECTORS: Final = 20
#: Integer vectors are omitted if log(likelihood / likelihood of uniform phases) is below this value.
_NEGLIGIBLE: Final = -5.0


@dataclass(frozen=True, kw_only=True)
class MeanPhases:
    """Mean double differences of one antenna's carrier phases, for n satellite pairs."""

    difference_m: Floats  #: Observed minus computed double difference at the origin, modulo the wavelength, shape (n,).
    away: Floats  #: Derivatives of the double differences with respect to the position (east, north, up), shape (n, 3).
    wavelength_m: Floats  #: Carrier wavelength of each pair, shape (n,).
    covariance_m2: Floats  #: Covariance of `difference_m`, shape (n, n).


@dataclass(frozen=True, kw_only=True)
class CodePlace:
    """Code position of one antenna (east, north and up of the origin), shape (3,) [m], and the position covariance."""

    place_m: Floats
    covariance_m2: Floats


def phase_log_likelihood(
    expected_m: Floats,
    prior_m2: Floats,
    codes: Sequence[CodePlace],
    phases: Sequence[MeanPhases],
    *,
    fault_prior: float,
) -> Floats:
    """Return the log likelihood of U position hypotheses, shape (U,), for the phases of A antennas, given the codes.

    A hypothesis is a position with the mean `expected_m`, shape (U, 3 A), and the covariance `prior_m2`. With the
    probability `fault_prior`, the phases do not follow the model (slip, half cycle) and are uniformly distributed over
    the wavelength.
    """
    measured = np.concatenate([code.place_m for code in codes])
    of_codes = scipy.linalg.block_diag(*(code.covariance_m2 for code in codes))
    gain = np.linalg.solve(prior_m2 + of_codes, prior_m2).T
    places = expected_m + (measured - expected_m) @ gain.T
    spread = prior_m2 - gain @ prior_m2
    away = scipy.linalg.block_diag(*(phase.away for phase in phases))
    wavelength = np.concatenate([phase.wavelength_m for phase in phases])
    covariance = scipy.linalg.block_diag(*(phase.covariance_m2 for phase in phases)) + away @ spread @ away.T
    cycles = (np.concatenate([phase.difference_m for phase in phases]) - places @ away.T) / wavelength
    search = IntegerSearch(covariance / np.outer(wavelength, wavelength))
    constant = np.log1p(-fault_prior) - 0.5 * np.linalg.slogdet(2.0 * np.pi * covariance)[1]
    uniform = uniform_log_likelihood(phases, fault_prior=fault_prior)
    below = 2.0 * (constant - uniform - _NEGLIGIBLE)
    squares = [search.nearest(row, _VECTORS, below=below)[1] for row in cycles]
    return np.array([scipy.special.logsumexp(np.append(constant - 0.5 * square, uniform)) for square in squares])


def uniform_log_likelihood(phases: Sequence[MeanPhases], *, fault_prior: float) -> float:
    """Return the log likelihood of phases that do not follow the model, a lower bound of `phase_log_likelihood`."""
    return float(np.log(fault_prior) - sum(np.log(phase.wavelength_m).sum() for phase in phases))
