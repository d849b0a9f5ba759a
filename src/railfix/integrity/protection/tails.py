"""The level at which Gaussian tails of many hypotheses together keep within a risk."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np
from scipy.special import ndtr

from railfix.core.arrays import Codes, Floats, Indices
from railfix.integrity.protection.risk import one_sided_k
from railfix.kernels import compiled_by

#: Share of the level, up to which a step is exact to a millionth of it: the last one.
_CLOSE: Final = 5e-4
#: Steps at most; a level that they do not come close to stays at the lowest one found within the risk.
_STEPS: Final = 60
#: From this step on every other one halves the bracket: steps between two points would go on for ever.
_HALVING: Final = 8
#: Share of the risk that is left over.
_AIM: Final = 0.002
#: Share of the largest part within which two hypotheses ask for the same: the first is named.
_ALIKE: Final = 1e-9
_TINY: Final = float(np.finfo(np.float64).tiny)
_ROOT_TWO_PI: Final = math.sqrt(2.0 * math.pi)
#: Q(x) is the density at x over ``(1 - a) x + a sqrt(x^2 + b)`` to 0.3 %, x >= 0 (Borjesson and Sundberg 1979).
_MILLS: Final = (0.339, 5.510)


@compiled_by("level")
def solve_level(
    offset_m: Floats, sigma_m: Floats, weight: Floats, bounds: Indices, share: Floats, reserved: Floats
) -> tuple[Floats, Codes, Floats, Floats, Indices]:
    """Find the level at which the tails of all hypotheses keep within the risk: ``weight Q((L - offset)/sigma)`` each.

    What nothing bounds goes into the risk with its whole weight; the rest of it is for what is checked. The largest
    part is a level within the risk, as the parts have shares of it. From there it is lowered as far as the sum of the
    tails allows, to 0.998 of the risk.

    Parameters
    ----------
    offset_m, sigma_m, weight : ndarray, shape (T, K)
        Hypotheses, kind after kind; `sigma_m` is infinite where nothing bounds a fault, `weight` 0 for none.
    bounds : ndarray of int, shape (kinds + 1,)
        First hypothesis of each kind, and K.
    share : ndarray, shape (T, kinds)
        Risk that each kind may use.
    reserved : ndarray, shape (T,)
        Risk taken off their sum beforehand.

    Returns
    -------
    level_m : ndarray, shape (T,) [m]
    spender : ndarray of int8, shape (T,)
        The kind that uses up most of the risk at that level.
    part_m, k : ndarray, shape (T, kinds)
        The largest ``offset + k sigma`` of a kind; 0 where its hypotheses fit into its share unchecked, then k is -inf.
    worst : ndarray of int, shape (T, kinds)
        The hypothesis that asks for it, counted within its kind; -1: none.
    """
    kinds = [slice(a, b) for a, b in pairwise(bounds.tolist())]
    unbounded = np.isinf(sigma_m)
    checked, sigma = weight, sigma_m
    if unbounded.any():
        checked, sigma = np.where(unbounded, 0.0, weight), np.where(unbounded, 1.0, sigma_m)
    total, whole = (np.stack([each[:, kind].sum(axis=1) for kind in kinds], axis=1) for each in (checked, weight))
    left = share - (whole - total)
    needed = whole > share
    k = np.where(needed, one_sided_k(left / np.where(total > 0.0, total, np.inf)), -np.inf)
    k = np.where((left > 0.0) & (total == 0.0), -np.inf, k)
    part, worst = np.zeros(k.shape), np.full(k.shape, -1, dtype=np.intp)
    for number, kind in enumerate(kinds):
        if kind.start == kind.stop:
            continue
        used = np.isfinite(k[:, number])
        each = offset_m[:, kind] + np.where(used, k[:, number], 0.0)[:, None] * sigma[:, kind]
        each[~((checked[:, kind] > 0.0) & used[:, None])] = -np.inf
        spent = needed[:, number] & (left[:, number] <= 0.0)
        if spent.any():
            culprits = unbounded[:, kind] & (weight[:, kind] > 0.0)
            culprits = np.where(culprits.any(axis=1, keepdims=True), culprits, weight[:, kind] > 0.0)
            each[spent[:, None] & culprits] = np.inf
        largest = each.max(axis=1)
        part[:, number] = np.maximum(largest, 0.0)
        alike = largest - _ALIKE * np.where(np.isfinite(largest), np.abs(largest), 0.0)
        worst[:, number] = np.where(largest > -np.inf, np.argmax(each >= alike[:, None], axis=1), -1)
    level, spender = part.max(axis=1), np.zeros(len(part), dtype=np.int8)
    allowed = left.sum(axis=1) - reserved
    rows = np.flatnonzero(np.isfinite(level) & (allowed > 0.0))
    tails = offset_m[rows], 1.0 / sigma[rows], checked[rows]
    level[rows], spender[rows] = _root(level[rows], *tails, kinds, (1.0 - _AIM) * allowed[rows])
    return level, spender, part, k, worst


def _root(
    highest: Floats, offset: Floats, inverse: Floats, weight: Floats, kinds: Sequence[slice], aim: Floats
) -> tuple[Floats, Codes]:
    """Levels up to `highest` at which the sum of the tails is `aim`, and the kind that uses most of it.

    Newton's method on the logarithm of the sum, to second order: the error of a step goes with its third power. The
    first one, from the highest level, is taken with approximate tails. A step that leaves the bracket halves it, and
    after some steps every other one does.
    """
    level, spender = highest.copy(), np.zeros(len(highest), dtype=np.int8)
    rows, here, below, above = np.arange(len(highest)), highest, np.zeros(len(highest)), highest
    for number in range(_STEPS):
        if not len(rows):
            break
        z = offset - here[:, None]
        z *= inverse
        bell = np.exp(-0.5 * z * z)
        bell *= weight
        if number:
            tail = ndtr(z)
            tail *= weight
        else:
            x = np.maximum(-z, 0.0)
            tail = bell / (_ROOT_TWO_PI * ((1.0 - _MILLS[0]) * x + _MILLS[0] * np.sqrt(x * x + _MILLS[1])))
        parts = np.stack([tail[:, kind].sum(axis=1) for kind in kinds], axis=1)
        total = np.maximum(parts.sum(axis=1), _TINY)
        bell *= inverse
        slope = bell.sum(axis=1) / (_ROOT_TWO_PI * total)
        bell *= inverse
        bend = -np.einsum("tk,tk->t", bell, z) / (_ROOT_TWO_PI * total) - slope**2
        excess = np.log(total / aim)
        steepest = slope + np.sqrt(np.maximum(slope**2 - 2.0 * bend * excess, 0.0))
        following = np.minimum(here + 2.0 * excess / np.maximum(steepest, _TINY), highest)
        if number:
            spender[rows] = np.argmax(parts, axis=1)
            below, above = np.where(excess > 0.0, here, below), np.where(excess > 0.0, above, here)
        close = (number > 0) & (np.abs(following - here) <= _CLOSE * here)
        inside = (following >= below) & (following <= above) & ((number < _HALVING) | (number % 2 == 0))
        following = np.where(
            inside, following, np.where(close, np.clip(following, below, above), (below + above) / 2.0)
        )
        level[rows] = np.where(close, following, above)
        going = ~close
        if going.all():
            here = following
            continue
        rows, here, below, above = rows[going], following[going], below[going], above[going]
        highest, aim = highest[going], aim[going]
        offset, inverse, weight = offset[going], inverse[going], weight[going]
    return level, spender
