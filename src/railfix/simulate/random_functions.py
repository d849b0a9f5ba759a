"""Smooth random functions of one variable: sums of cosines with random frequencies and phases."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Floats

#: Number of cosines of one function.
_COSINES: Final = 64


@dataclass(frozen=True, kw_only=True)
class RandomFunction:
    """Realisation of a stationary Gaussian function.

    Attributes
    ----------
    amplitude : float
        Of each cosine.
    frequency, phase : ndarray, shape (W,)
        Radians per unit of the variable, and radians.
    """

    amplitude: float
    frequency: Floats
    phase: Floats

    @classmethod
    def smooth(cls, rng: np.random.Generator, *, sigma: float, correlation: float) -> Self:
        """Function with the correlation exp(-d^2 / (2 correlation^2))."""
        return cls._of(rng, sigma, rng.normal(0.0, 1.0 / correlation, _COSINES))

    @classmethod
    def periodic(cls, rng: np.random.Generator, *, sigma: float, period: float) -> Self:
        """Oscillation about one period, with a relative bandwidth of 15 percent."""
        return cls._of(rng, sigma, 2.0 * np.pi / period * (1.0 + 0.15 * rng.normal(0.0, 1.0, _COSINES)))

    @classmethod
    def _of(cls, rng: np.random.Generator, sigma: float, frequency: Floats) -> Self:
        phase = rng.uniform(0.0, 2.0 * np.pi, _COSINES)
        return cls(amplitude=sigma * float(np.sqrt(2.0 / _COSINES)), frequency=frequency, phase=phase)

    def at(self, x: ArrayLike) -> Floats:
        """Values at positions or times, same shape as `x`."""
        where = np.asarray(x, dtype=np.float64)
        if self.amplitude == 0.0:
            return np.zeros(where.shape)
        total = np.zeros(where.shape)
        for frequency, phase in zip(self.frequency, self.phase, strict=True):
            total += np.cos(frequency * where + phase)
        return self.amplitude * total
