"""Carrier phases of a train at rest beside a base station: how probable they are for a place known but for its error.

Double differences of the phases have integer ambiguities that stay the same while the train stands. Along a track
the place is known across but for the error of the map, so that the phases of all satellites together have few
unknowns, and integers that fit them exist near the true place alone (P1 2.5: carrier phase gives centimetres, at
rest time may be taken). Each satellite's phase has a constant error, which does not average out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import block_diag
from scipy.special import logsumexp

from railfix.core.arrays import Floats
from railfix.positioning.integer_search import IntegerSearch

#: Integer vectors summed over at most; those that add less than this (logarithm) to uniform phases are left out.
_VECTORS: Final = 20
_NEGLIGIBLE: Final = -5.0


@dataclass(frozen=True, kw_only=True)
class MeanPhases:
    """Mean double differences of the carrier phases of one antenna, n pairs of satellites.

    Attributes
    ----------
    difference_m : ndarray, shape (n,)
        Observed less computed for the origin; differs from a multiple of the wavelength by the place and errors.
    away : ndarray, shape (n, 3)
        Change of it with the place, east, north, up.
    wavelength_m : ndarray, shape (n,)
    covariance_m2 : ndarray, shape (n, n)
    """

    difference_m: Floats
    away: Floats
    wavelength_m: Floats
    covariance_m2: Floats


@dataclass(frozen=True, kw_only=True)
class CodePlace:
    """Place of one antenna by its codes, shape (3,) east, north, up of the origin [m], and its covariance."""

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
    """Logarithm of the density of the phases of all antennas, given their codes, for places of the antennas.

    The phases are within a wavelength, as the integers are unknown; with the probability `fault_prior` they follow
    no model (a slip, half a cycle) and are uniform there.

    Parameters
    ----------
    expected_m : ndarray, shape (U, 3 A)
        Places of the A antennas under each of U hypotheses.
    prior_m2 : ndarray, shape (3 A, 3 A)
        Covariance of the places about those: along the track, of the map, of height.
    codes : sequence of CodePlace, length A
    phases : sequence of MeanPhases, length A
    fault_prior : float

    Returns
    -------
    ndarray, shape (U,)
    """
    measured = np.concatenate([code.place_m for code in codes])
    of_codes = block_diag(*(code.covariance_m2 for code in codes))
    gain = np.linalg.solve(prior_m2 + of_codes, prior_m2).T
    places = expected_m + (measured - expected_m) @ gain.T
    spread = prior_m2 - gain @ prior_m2
    away = block_diag(*(phase.away for phase in phases))
    wavelength = np.concatenate([phase.wavelength_m for phase in phases])
    covariance = block_diag(*(phase.covariance_m2 for phase in phases)) + away @ spread @ away.T
    cycles = (np.concatenate([phase.difference_m for phase in phases]) - places @ away.T) / wavelength
    search = IntegerSearch(covariance / np.outer(wavelength, wavelength))
    constant = np.log1p(-fault_prior) - 0.5 * np.linalg.slogdet(2.0 * np.pi * covariance)[1]
    uniform = uniform_log_likelihood(phases, fault_prior=fault_prior)
    below = 2.0 * (constant - uniform - _NEGLIGIBLE)
    squares = [search.nearest(row, _VECTORS, below=below)[1] for row in cycles]
    return np.array([logsumexp(np.append(constant - 0.5 * square, uniform)) for square in squares])


def uniform_log_likelihood(phases: Sequence[MeanPhases], *, fault_prior: float) -> float:
    """Logarithm of the density of phases that follow no model: a lower bound for every place."""
    return float(np.log(fault_prior) - sum(np.log(phase.wavelength_m).sum() for phase in phases))
