"""Weighted pseudoranges, the input of the positioning stages.

`weighted_ranges` checks its arguments. The stages and the compiled functions do not check them again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Floats, Indices, Integers, Masks, RowArrays, Strings, kernel_array
from railfix.core.constants import CLOCK_GROUP
from railfix.core.notebook import NotebookTable
from railfix.ranges.channels import PLAUSIBLE_CODE_M, clock_groups
from railfix.ranges.corrected import ORBITS_M, is_orbit, is_pseudorange

UNTIED_M: Final = 1e6  #: Sigma of an unknown inter-system bias [m].


@dataclass(frozen=True, kw_only=True, repr=False)
class InterSystemBiases(RowArrays, NotebookTable):
    """Known offsets between the receiver clocks of the constellations."""

    #: Receiver clock of each group minus the common clock, shape (T, G); any finite value where unknown.
    offset_m: Floats
    sigma_m: Floats  #: Standard deviation of `offset_m`, shape (T, G); `UNTIED_M` where unknown.


class RangeArrays(NamedTuple):
    """Arrays of `Ranges` for the compiled functions (`kernel_array`): T epochs, M channels, G groups."""

    sat_ecef_m: Floats  # (T, M, 3)
    code_m: Floats  # (T, M)
    weight: Floats  # (T, M)
    starts: Indices  # (G,) first channel of each group
    offset_m: Floats  # (T, G), see `InterSystemBiases`; (0, G) without ties
    sigma_m: Floats  # (T, G), see `InterSystemBiases`; (0, G) without ties

    @property
    def tied(self) -> bool:
        """True if inter-system biases tie the clocks."""
        return len(self.offset_m) == len(self.code_m)

    @property
    def clock(self) -> Indices:
        """Group index of each channel, shape (M,)."""
        return self.starts.searchsorted(np.arange(self.code_m.shape[1]), side="right") - 1

    def take(self, epochs: Masks | Indices | slice) -> RangeArrays:
        """Return the arrays of selected epochs."""
        ties = (self.offset_m[epochs], self.sigma_m[epochs]) if self.tied else (self.offset_m, self.sigma_m)
        arrays = (self.sat_ecef_m[epochs], self.code_m[epochs], self.weight[epochs], *ties)
        sat_ecef_m, code_m, weight, *known = map(kernel_array, arrays)
        return RangeArrays(sat_ecef_m, code_m, weight, self.starts, *known)


@dataclass(frozen=True, kw_only=True)
class Ranges:
    """Corrected and weighted pseudoranges of an antenna, T epochs by M channels."""

    sat_ecef_m: Floats  #: ECEF satellite positions at transmission, shape (T, M, 3); any finite value if unused.
    code_m: Floats  #: Corrected pseudoranges, shape (T, M); any finite value for unused ranges.
    weight: Floats  #: Weights 1/sigma^2, shape (T, M) [1/m^2]; 0 for unused ranges.
    groups: tuple[slice, ...]  #: Adjacent channels of each receiver clock, one slice per clock.
    ties: InterSystemBiases | None = None  #: Known inter-system biases; None for separate clocks.

    def __len__(self) -> int:
        return len(self.code_m)

    def take(self, epochs: Masks | Indices) -> Ranges:
        """Return the ranges of selected epochs."""
        return Ranges(
            sat_ecef_m=self.sat_ecef_m[epochs], code_m=self.code_m[epochs], weight=self.weight[epochs],
            groups=self.groups, ties=None if self.ties is None else self.ties.take(epochs),
        )  # fmt: skip

    @cached_property
    def arrays(self) -> RangeArrays:
        """Arrays of the ranges for the compiled functions."""
        ties = np.empty((2, 0, len(self.groups))) if self.ties is None else (self.ties.offset_m, self.ties.sigma_m)
        arrays = (self.sat_ecef_m, self.code_m, self.weight, *ties)
        sat_ecef_m, code_m, weight, *known = map(kernel_array, arrays)
        return RangeArrays(sat_ecef_m, code_m, weight, self.starts, *known)

    @cached_property
    def n_used(self) -> Integers:
        """Number of used ranges, shape (T,)."""
        return np.asarray((self.weight > 0).sum(axis=1), dtype=np.int64)

    @cached_property
    def starts(self) -> Indices:
        """Index of the first channel of each group, shape (G,)."""
        return np.array([group.start for group in self.groups], dtype=np.intp)

    @cached_property
    def n_clocks(self) -> Integers:
        """Number of clocks with at least one used range, shape (T,). All tied clocks together count as one clock."""
        seen = np.add.reduceat(self.weight, self.starts, axis=1) > 0
        if self.ties is None:
            return np.asarray(seen.sum(axis=1), dtype=np.int64)
        tied = self.ties.sigma_m < UNTIED_M
        return np.asarray((seen & ~tied).sum(axis=1) + (seen & tied).any(axis=1), dtype=np.int64)

    @property
    def redundancy(self) -> Integers:
        """Redundancy on the line, used ranges minus clocks minus 1, shape (T,); can be negative."""
        return np.asarray(self.n_used - self.n_clocks - 1, dtype=np.int64)

    @property
    def space_redundancy(self) -> Integers:
        """Redundancy of a 3-D position, used ranges minus clocks minus 3, shape (T,); can be negative."""
        return np.asarray(self.n_used - self.n_clocks - 3, dtype=np.int64)


#: Arbitrary finite satellite position of unused ranges [m].
FILLER_SATELLITE_M: Final = (2.6e7, 0.0, 0.0)


def weighted_ranges(
    sat_ecef_m: ArrayLike, code_m: ArrayLike, sigma_m: ArrayLike, clock: Sequence[str] | Strings
) -> Ranges:
    """Return ranges with the weights ``1/sigma^2`` (P1 2.2(3)), or 0 where code, sigma or satellite is NaN.

    Parameters
    ----------
    sat_ecef_m : array_like, shape (T, M, 3) [m]
        Satellite positions at the times of transmission, ECEF.
    code_m, sigma_m : array_like, shape (T, M) [m]
        Corrected pseudoranges and their standard deviations; NaN for unused codes.
    clock : sequence of str, length M
        Letter of the constellation or receiver clock of each channel. Channels of one clock must be adjacent.

    Raises
    ------
    ValueError
        Shapes do not match, an array is not numeric or has single precision, a standard deviation is not positive, a
        code or satellite position is impossible, or a letter denotes no constellation.
    """
    code = _check_floats("code_m", code_m, 2)
    sigma = _check_floats("sigma_m", sigma_m, 2)
    satellite = _check_floats("sat_ecef_m", sat_ecef_m, 3)
    if sigma.shape != code.shape:
        raise ValueError(f"sigma_m has shape {sigma.shape}, but code_m has {code.shape}")
    if satellite.shape != (*code.shape, 3):
        raise ValueError(f"sat_ecef_m has shape {satellite.shape}, expected {(*code.shape, 3)}: x, y, z of each code")
    if len(clock) != code.shape[1]:
        raise ValueError(f"clock names {len(clock)} channels, code_m has {code.shape[1]}")
    if unknown := [str(letter) for letter in clock if str(letter) not in CLOCK_GROUP]:
        raise ValueError(
            f"clock names {unknown[0]!r}, which is not a constellation; known are {', '.join(CLOCK_GROUP)}"
        )
    if (sigma <= 0.0).any():
        raise ValueError(f"sigma_m has {np.nanmin(sigma):g} m; a standard deviation is positive, NaN where unknown")
    used = np.isfinite(code) & np.isfinite(sigma) & np.isfinite(satellite).all(axis=-1)
    if (wrong := used & ~is_pseudorange(code)).any():
        raise ValueError(
            f"code_m has {code[wrong][0]:.0f} m; a pseudorange lies between {PLAUSIBLE_CODE_M[0]:.0f} and "
            f"{PLAUSIBLE_CODE_M[1]:.0f} m, NaN where there is none"
        )
    if (wrong := used & ~is_orbit(satellite)).any():
        raise ValueError(
            f"sat_ecef_m has a satellite {np.linalg.norm(satellite[wrong][0]):.0f} m from the centre of the Earth, "
            f"expected {ORBITS_M[0]:.0f} to {ORBITS_M[1]:.0f} m; positions are Earth-fixed, in metres"
        )
    return Ranges(
        sat_ecef_m=kernel_array(np.where(used[..., None], satellite, FILLER_SATELLITE_M)),
        code_m=kernel_array(np.where(used, code, 0.0)),
        weight=kernel_array(np.where(used, 1.0 / sigma**2, 0.0)),
        groups=clock_groups(clock),
    )


def _check_floats(name: str, values: ArrayLike, axes: int) -> Floats:
    """Return values in double precision; raise ValueError for an unsuitable type or number of axes."""
    array = np.asarray(values)
    if array.dtype.kind not in "fiu" or (array.dtype.kind == "f" and array.dtype.itemsize < 8):
        raise ValueError(
            f"{name} has elements of type {array.dtype}, expected float64: single precision rounds to metres"
        )
    if array.ndim != axes:
        expected = "(T, M)" if axes == 2 else "(T, M, 3)"
        raise ValueError(f"{name} has shape {array.shape}, expected {expected}: epochs by channels")
    return np.asarray(array, dtype=np.float64)


def without(ranges: Ranges, dropped: Masks) -> Ranges:
    """Return the ranges after setting the weights of `dropped` ranges to 0."""
    return replace(ranges, weight=np.where(dropped, 0.0, ranges.weight))
