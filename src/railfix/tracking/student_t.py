"""Student's t with heavier tails for codes that come late."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from railfix.core.arrays import Floats


class Tails(NamedTuple):
    """Degrees of freedom of Student's t, which measurement errors follow.

    Attributes
    ----------
    usual : float
    late : float
        Of codes that are longer than expected: a reflected signal comes late, never early, and the way round has no
        typical length. The weight of a small error is the same on both sides.
    """

    usual: float
    late: float

    def degrees(self, residual: Floats, codes: int) -> Floats:
        """Return the degrees of freedom of each row, by the sign of its residual; shapes as for `weight`."""
        degrees = np.full(residual.shape, self.usual)
        degrees[:, :codes][residual[:, :codes] > 0.0] = self.late
        return degrees

    def weight(self, residual: Floats, square: Floats, codes: int) -> Floats:
        """Return the weights of rows, shape (H, M).

        Parameters
        ----------
        residual : ndarray, shape (H, M)
            Only its sign is used; positive: longer than expected.
        square : ndarray, shape (H, M)
            Its mean square over the variance.
        codes : int
            How many rows are of codes; they come first.
        """
        degrees = self.degrees(residual, codes)
        return np.asarray((self.usual + 1.0) / self.usual * degrees / (degrees + square))

    def log_density(self, residual: Floats, square: Floats, codes: int) -> Floats:
        """Return the logarithm of the density whose weights are `weight`, 0 at its maximum; parameters the same."""
        degrees = self.degrees(residual, codes)
        return np.asarray(-0.5 * (self.usual + 1.0) / self.usual * degrees * np.log1p(square / degrees))
