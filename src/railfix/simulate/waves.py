"""Smooth random functions of one variable: sums of cosines of drawn frequencies, the same however they are asked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Floats

#: Cosines of one function.
_WAVES: Final = 64


@dataclass(frozen=True, kw_only=True)
class Waves:
    """One drawn function.

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
        """Correlation exp(-d^2 / (2 correlation^2)): frequencies drawn from its spectrum."""
        return cls._of(rng, sigma, rng.normal(0.0, 1.0 / correlation, _WAVES))

    @classmethod
    def narrow(cls, rng: np.random.Generator, *, sigma: float, period: float) -> Self:
        """Swinging about one period, frequencies within some fifteen percent."""
        return cls._of(rng, sigma, 2.0 * np.pi / period * (1.0 + 0.15 * rng.normal(0.0, 1.0, _WAVES)))

    @classmethod
    def _of(cls, rng: np.random.Generator, sigma: float, frequency: Floats) -> Self:
        phase = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
        return cls(amplitude=sigma * float(np.sqrt(2.0 / _WAVES)), frequency=frequency, phase=phase)

    def at(self, x: ArrayLike) -> Floats:
        """Values at places or times, same shape as `x`."""
        where = np.asarray(x, dtype=np.float64)
        if self.amplitude == 0.0:
            return np.zeros(where.shape)
        total = np.zeros(where.shape)
        for frequency, phase in zip(self.frequency, self.phase, strict=True):
            total += np.cos(frequency * where + phase)
        return self.amplitude * total
