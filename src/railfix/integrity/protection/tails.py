"""The level at which Gaussian tails of many hypotheses together keep within a risk."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from scipy.special import ndtr

from railfix.core.arrays import Codes, Floats, Indices
from railfix.kernels import compiled_by

#: Evaluations of the sum in a round; epochs that have not come close after it go on.
_STEPS: Final = 4
_ROUNDS: Final = 4
#: Share of the level that the next step would move it by, below which it has come close.
_CLOSE: Final = 1e-3
#: Share of the risk that is left over, so that the last steps end within it from either side.
_AIM: Final = 0.002
_TINY: Final = float(np.finfo(np.float64).tiny)
_ROOT_TWO_PI: Final = math.sqrt(2.0 * math.pi)


@dataclass(frozen=True)
class Tails:
    """Hypotheses of one kind: T epochs by K, each with the tail ``weight Q((L - offset)/sigma)`` over a level L."""

    offset_m: Floats
    sigma_m: Floats
    weight: Floats  # 0: none


def least_level(above_m: Floats, kinds: list[Tails], allowed: Floats) -> tuple[Floats, Codes]:
    """Lower a level that keeps within the risk as far as it goes.

    Newton's method on the logarithm of the sum, which is concave for one Gaussian tail: from above the steps
    stay above. For a sum they may not, and come back; a step that leaves the bracket halves it. The lowest
    level that was found within the risk is returned: the answer may be a little too high, never too low.

    Parameters
    ----------
    above_m : ndarray, shape (T,) [m]
        Levels within the risk; what is not finite is returned as it is.
    kinds : list of Tails
    allowed : ndarray, shape (T,)
        Risk.

    Returns
    -------
    level_m : ndarray, shape (T,) [m]
    spender : ndarray of int8, shape (T,)
        The kind that uses up most of the risk at that level.
    """
    bounds = np.cumsum([0, *(kind.weight.shape[1] for kind in kinds)])
    offset = np.concatenate([kind.offset_m for kind in kinds], axis=1)
    inverse = 1.0 / np.concatenate([kind.sigma_m for kind in kinds], axis=1)
    weight = np.concatenate([kind.weight for kind in kinds], axis=1)
    return lowered(np.ascontiguousarray(above_m), offset, inverse, weight, bounds, np.ascontiguousarray(allowed))


@compiled_by("level")
def lowered(
    above_m: Floats, offset_m: Floats, inverse: Floats, weight: Floats, bounds: Indices, allowed: Floats
) -> tuple[Floats, Codes]:
    """Lower levels as `least_level` does; arrays in C order.

    Parameters
    ----------
    above_m, allowed : ndarray, shape (T,)
    offset_m, inverse, weight : ndarray, shape (T, K)
        Of all tails; `inverse` is 1/sigma [1/m].
    bounds : ndarray of int
        First tail of each kind, and K.
    """
    level, spender = above_m.copy(), np.zeros(len(above_m), dtype=np.int8)
    rows = np.flatnonzero(np.isfinite(above_m) & (allowed > 0))
    here, below = above_m[rows], np.zeros(len(rows))
    for _ in range(_ROUNDS):
        if not len(rows):
            break
        tails = offset_m[rows], inverse[rows], weight[rows]
        found = _descend(level[rows], spender[rows], below, here, *tails, bounds, allowed[rows])
        level[rows], spender[rows], below, here = found
        going = np.abs(here - level[rows]) > _CLOSE * level[rows]
        rows, below, here = rows[going], below[going], here[going]
    return level, spender


def _descend(
    level: Floats,
    spender: Codes,
    below: Floats,
    here: Floats,
    offset: Floats,
    inverse: Floats,
    weight: Floats,
    bounds: Indices,
    limit: Floats,
) -> tuple[Floats, Codes, Floats, Floats]:
    """A round of steps: the lowest level within the risk, its spender, the highest beyond it, and where to go on."""
    density_weight = weight * inverse / _ROOT_TWO_PI
    aim = limit * (1.0 - _AIM)
    parts = np.empty((len(level), len(bounds) - 1))
    for _ in range(_STEPS):
        z = (offset - here[:, None]) * inverse
        tail = ndtr(z)
        for k, (a, b) in enumerate(pairwise(bounds)):
            parts[:, k] = np.einsum("tk,tk->t", weight[:, a:b], tail[:, a:b])
        total = np.maximum(parts.sum(axis=1), _TINY)
        within = total <= limit
        better = within & (here <= level)
        level = np.where(better, here, level)
        spender = np.where(better, np.argmax(parts, axis=1), spender).astype(np.int8)
        z *= z
        z *= -0.5
        density = np.einsum("tk,tk->t", density_weight, np.exp(z, out=z))
        below = np.where(within, below, np.maximum(below, here))
        here = here + np.log(total / aim) * total / np.maximum(density, _TINY)
        here = np.where((here >= below) & (here <= level), here, (below + level) / 2.0)
    return level, spender, below, here
