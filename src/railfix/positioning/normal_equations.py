"""Normal equations of ranges with the receiver clocks eliminated: a 3 x 3 system in the place alone.

Subtracting the weighted mean of a constellation's satellites from its residuals and design rows is the same as solving
for that clock (the Schur complement of the clock block). Where the offsets between the clocks are known to some sigma
(`ClockTies`), each mean, less its offset, is one more observation of a common clock, eliminated in the same way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from railfix import kernels
from railfix.core.arrays import Floats, Indices, Integers, Masks, Strings
from railfix.core.constants import CLOCK_GROUP

UNTIED_M: Final = 1e6  #: Sigma of an offset between clocks of which nothing is known [m].


@dataclass(frozen=True, kw_only=True)
class ClockTies:
    """Known offsets between the receiver clocks of the constellations."""

    #: Receiver clock of each group less a clock common to all; any finite value where unknown; shape (T, G).
    offset_m: Floats
    sigma_m: Floats  #: Its standard deviation; `UNTIED_M` where nothing is known; shape (T, G).

    def take(self, epochs: Masks | Indices) -> ClockTies:
        """The ties of some epochs, by mask or index."""
        return ClockTies(offset_m=self.offset_m[epochs], sigma_m=self.sigma_m[epochs])


class RangeArrays(NamedTuple):
    """Arrays of `Ranges` in C order, as compiled functions take them: T epochs, M channels, G groups."""

    sat_ecef_m: Floats  # (T, M, 3)
    code_m: Floats  # (T, M)
    weight: Floats  # (T, M)
    starts: Indices  # (G,) first channel of each group
    offset_m: Floats  # (T, G), of `ClockTies`; (0, G) without ties
    sigma_m: Floats  # likewise

    @property
    def tied(self) -> bool:
        """Whether anything is known of the offsets between the clocks."""
        return len(self.offset_m) == len(self.code_m)

    @property
    def clock(self) -> Indices:
        """Group of each channel."""
        return np.repeat(np.arange(len(self.starts)), np.diff(np.append(self.starts, self.code_m.shape[1])))

    def take(self, epochs: Masks | Indices | slice) -> RangeArrays:
        """The arrays of some epochs."""
        ties = (self.offset_m[epochs], self.sigma_m[epochs]) if self.tied else (self.offset_m, self.sigma_m)
        return RangeArrays(self.sat_ecef_m[epochs], self.code_m[epochs], self.weight[epochs], self.starts, *ties)


@dataclass(frozen=True, kw_only=True)
class Ranges:
    """Corrected pseudoranges of an antenna, ready to be fitted: T epochs by M channels."""

    sat_ecef_m: Floats  #: Satellites in ECEF at transmit time; any finite value where the weight is 0; shape (T, M, 3).
    code_m: Floats  #: Corrected pseudorange; any finite value where the weight is 0; shape (T, M).
    weight: Floats  #: 1/sigma^2, 0 for what is not used; shape (T, M) [1/m^2].
    groups: tuple[slice, ...]  #: Channels that share one receiver clock stand side by side; one slice a clock.
    ties: ClockTies | None = None  #: Known offsets between these clocks; None: none.

    def __len__(self) -> int:
        return len(self.code_m)

    def take(self, epochs: Masks | Indices) -> Ranges:
        """The ranges of some epochs, by mask or index."""
        return Ranges(
            sat_ecef_m=self.sat_ecef_m[epochs],
            code_m=self.code_m[epochs],
            weight=self.weight[epochs],
            groups=self.groups,
            ties=None if self.ties is None else self.ties.take(epochs),
        )

    @cached_property
    def arrays(self) -> RangeArrays:
        """The same as plain arrays."""
        ties = np.empty((2, 0, len(self.groups))) if self.ties is None else (self.ties.offset_m, self.ties.sigma_m)
        sat_ecef_m, code_m, weight, *known = (
            np.ascontiguousarray(array, dtype=np.float64)
            for array in (self.sat_ecef_m, self.code_m, self.weight, *ties)
        )
        return RangeArrays(sat_ecef_m, code_m, weight, self.starts, *known)

    @cached_property
    def n_used(self) -> Integers:
        """Channels with weight, shape (T,)."""
        return np.asarray((self.weight > 0).sum(axis=1), dtype=np.int64)

    @cached_property
    def starts(self) -> Indices:
        """First channel of each group."""
        return np.array([group.start for group in self.groups], dtype=np.intp)

    @cached_property
    def n_clocks(self) -> Integers:
        """Clocks to be found from at least one channel, those tied to each other counted as one, shape (T,)."""
        seen = np.add.reduceat(self.weight, self.starts, axis=1) > 0
        if self.ties is None:
            return np.asarray(seen.sum(axis=1), dtype=np.int64)
        tied = self.ties.sigma_m < UNTIED_M
        return np.asarray((seen & ~tied).sum(axis=1) + (seen & tied).any(axis=1), dtype=np.int64)


@dataclass(frozen=True, kw_only=True)
class NormalEquations:
    """Fit of ranges around a place, the clocks eliminated."""

    matrix: Floats  #: Normal matrix of the place in ECEF, shape (T, 3, 3) [1/m^2].
    vector: Floats  #: Right-hand side: the step that lowers `wsse` most is ``matrix^-1 vector``; shape (T, 3) [1/m].
    wsse: Floats  #: Weighted sum of squared residuals at the place itself, shape (T,).
    clock_m: Floats  #: Receiver clock of each group at the place; NaN where the group has no satellite; shape (T, G).
    residual_m: Floats  #: Code - range - clock; 0 where the weight is 0; shape (T, M).
    clock_slope: Floats  #: Decrease of `clock_m` by a step from the place, per metre of each axis; shape (T, 3, G).
    design: Floats  #: Decrease of `residual_m` by a step from the place, per metre of each axis; shape (T, 3, M).


def clock_groups(system: Sequence[str] | Strings) -> tuple[slice, ...]:
    """Return slices of channels that share a receiver clock; ValueError where they are not side by side."""
    clocks = [CLOCK_GROUP[str(letter)] for letter in system]
    starts = [i for i, clock in enumerate(clocks) if i == 0 or clock != clocks[i - 1]]
    if len({clocks[i] for i in starts}) != len(starts):
        raise ValueError(f"channels of one clock must stand side by side, got {clocks}")
    return tuple(slice(a, b) for a, b in pairwise([*starts, len(clocks)]))


def normal_equations(ranges: Ranges, place_ecef_m: Floats) -> NormalEquations:
    """Return the normal equations of `ranges` linearised at one place an epoch, shape (T, 3) [m]."""
    system, means, rows, seen = kernels.ranges.reduced_equations(
        ranges.arrays, np.ascontiguousarray(place_ecef_m, dtype=np.float64)
    )
    return NormalEquations(
        matrix=system[:, :3, :3],
        vector=system[:, :3, 3],
        wsse=system[:, 3, 3],
        clock_m=np.where(seen, means[:, 3], np.nan),
        residual_m=rows[:, 3],
        clock_slope=means[:, :3],
        design=rows[:, :3],
    )


def fit(ranges: Ranges, place_ecef_m: Floats, epochs: Indices | None = None) -> Floats:
    """Weighted sum of squared residuals at places, the clocks eliminated.

    The ``q`` of the section search: `normal_equations(...).wsse` without the derivatives.

    Parameters
    ----------
    ranges : Ranges
        T epochs.
    place_ecef_m : ndarray, shape (n, 3) [m]
    epochs : ndarray of int, shape (n,), optional
        Epoch of each place; by default one place an epoch, in order.

    Returns
    -------
    ndarray, shape (n,)
    """
    place = np.ascontiguousarray(place_ecef_m, dtype=np.float64)
    return kernels.ranges.misfits(ranges.arrays, place, np.arange(len(ranges)) if epochs is None else epochs)


def inverse_3x3(matrix: Floats) -> Floats:
    """Invert symmetric 3 x 3 matrices by cofactors; NaN where the scaled determinant is below 1e-12."""
    a, b, c = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 0, 2]
    d, e, f = matrix[..., 1, 1], matrix[..., 1, 2], matrix[..., 2, 2]
    cofactors = np.empty(matrix.shape)
    cofactors[..., 0, 0] = d * f - e * e
    cofactors[..., 1, 1] = a * f - c * c
    cofactors[..., 2, 2] = a * d - b * b
    cofactors[..., 0, 1] = cofactors[..., 1, 0] = c * e - b * f
    cofactors[..., 0, 2] = cofactors[..., 2, 0] = b * e - c * d
    cofactors[..., 1, 2] = cofactors[..., 2, 1] = b * c - a * e
    determinant = a * cofactors[..., 0, 0] + b * cofactors[..., 0, 1] + c * cofactors[..., 0, 2]
    regular = determinant > 1e-12 * ((a + d + f) / 3.0) ** 3
    determinant = np.where(regular, determinant, np.nan)
    return cofactors / determinant[..., None, None]
