"""Gauss-Markov processes as functions of time, independent of the chunks in which they are evaluated.

The exact process is drawn at nodes, a small part of the correlation time apart, and interpolated by
cubics through four nodes each (Catmull and Rom 1974), so that it has a rate of change too. The
interpolation's loss of variance (less than 1 %) is put back on the average.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import lfilter

from railfix.core.arrays import Floats

#: Nodes in one correlation time.
_NODES_A_TIME: Final = 32
#: Least number of nodes before the start of the run, and least room before and after it [s]: a receiver's
#: clock bias puts instants outside.
_BEFORE: Final = 3
_ROOM_S: Final = (0.1, 1.0)


def satellite_key(satellite: str) -> tuple[int, int]:
    """Two numbers that identify a satellite in seeds, so that its errors do not depend on other satellites."""
    return ord(satellite[0]), int(satellite[1:])


class Interpolated:
    """Columns given at even nodes, as functions of time with a continuous rate.

    `nodes`, shape (K, C), are the values at ``(k - nodes_before(spacing_s)) * spacing_s``.
    """

    def __init__(self, nodes: Floats, spacing_s: float) -> None:
        self._nodes = nodes
        self._spacing_s = spacing_s
        self._before = nodes_before(spacing_s)

    def _place(self, time_s: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """The four nodes about each time, shape (T, C), and the share of the cell, shape (T, 1)."""
        place = np.asarray(time_s, dtype=np.float64) / self._spacing_s + self._before
        cell = np.floor(place).astype(np.intp)
        if cell.size and (cell.min() < 1 or cell.max() > len(self._nodes) - 3):
            raise ValueError("a time is outside of the run that the errors were made for")
        a, b, c, d = (self._nodes[cell + k] for k in (-1, 0, 1, 2))
        return a, b, c, d, (place - cell)[:, None]

    def at(self, time_s: Floats) -> Floats:
        """Values, shape (T, C), at seconds after the start, shape (T,); ValueError far outside of the run."""
        a, b, c, d, u = self._place(time_s)
        return np.asarray(b + u / 2.0 * ((c - a) + u * (2.0 * a - 5.0 * b + 4.0 * c - d + u * (3.0 * (b - c) + d - a))))

    def rate(self, time_s: Floats) -> Floats:
        """Rates of change a second, shape (T, C)."""
        a, b, c, d, u = self._place(time_s)
        slope = (c - a) + u * (2.0 * (2.0 * a - 5.0 * b + 4.0 * c - d) + 3.0 * u * (3.0 * (b - c) + d - a))
        return np.asarray(slope / 2.0 / self._spacing_s)


def nodes_before(spacing_s: float) -> int:
    """Nodes before second 0."""
    return max(_BEFORE, int(np.ceil(_ROOM_S[0] / spacing_s)) + 1)


def node_count(duration_s: float, spacing_s: float) -> int:
    """Nodes that a run of a duration needs, with the room before and after it."""
    return nodes_before(spacing_s) + int(np.ceil((duration_s + _ROOM_S[1]) / spacing_s)) + 4


class GaussMarkov(Interpolated):
    """Independent Gauss-Markov processes, one a column, each with its own key as seed.

    They can be asked for from 0 to `duration_s`; a longer run begins with the same values.
    """

    def __init__(self, keys: Sequence[Sequence[int]], *, sigma: float, time_s: float, duration_s: float) -> None:
        spacing = time_s / _NODES_A_TIME
        rho = float(np.exp(-1.0 / _NODES_A_TIME))
        count = node_count(duration_s, spacing)
        white = np.stack([np.random.default_rng(list(key)).standard_normal(count) for key in keys], axis=1)
        white[1:] *= np.sqrt(1.0 - rho**2)
        nodes = sigma / _interpolate_sigma(rho) * np.asarray(lfilter([1.0], [1.0, -rho], white, axis=0))
        super().__init__(nodes, spacing)


def _interpolate_sigma(rho: float) -> float:
    """Standard deviation between nodes, root mean square, of a process of standard deviation 1."""
    u = (np.arange(200) + 0.5) / 200.0
    weight = 0.5 * np.stack(
        [-u + 2 * u**2 - u**3, 2 - 5 * u**2 + 3 * u**3, u + 4 * u**2 - 3 * u**3, -(u**2) + u**3], axis=-1
    )
    lag = np.abs(np.subtract.outer(np.arange(4), np.arange(4)))
    return float(np.sqrt(np.einsum("ni,ij,nj->n", weight, rho**lag, weight).mean()))


class ClockWalk(Interpolated):
    """Variation of a receiver's clock [m]: random walks of bias and drift with nodes at the epochs, 0 at the start.

    `walk` in m / sqrt(s), `frequency_walk` in m/s / sqrt(s).
    """

    def __init__(
        self, key: Sequence[int], *, walk: float, frequency_walk: float, interval_s: float, duration_s: float
    ) -> None:
        count = node_count(duration_s, interval_s)
        white = np.random.default_rng(list(key)).standard_normal((count, 2)) * np.sqrt(interval_s)
        start = nodes_before(interval_s)
        drift = np.cumsum(frequency_walk * white[:, 0])
        bias = np.cumsum(walk * white[:, 1])
        drift, bias = drift - drift[start], bias - bias[start]
        # The trapezoid rule: the drift goes evenly from node to node.
        turned = np.concatenate([[0.0], np.cumsum((drift[1:] + drift[:-1]) / 2.0)]) * interval_s
        bias = bias + turned - turned[start]
        super().__init__(bias[:, None], interval_s)


#: Number of cosines of one function.
_COSINES: Final = 64


@dataclass(frozen=True, kw_only=True)
class RandomFunction:
    """Realisation of a stationary Gaussian function."""

    amplitude: float  #: Of each cosine.
    #: Radians per unit of the variable, and radians; shape (W,).
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
