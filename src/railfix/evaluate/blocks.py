"""How far figures can be trusted: blocks of time drawn again and again.

Errors of a train are alike over tens of seconds, so that epochs are no independent draws; blocks
of a minute nearly are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Integers, Masks

#: With fewer blocks than this no limits are told.
FEWEST_BLOCKS: Final = 5
#: Sizes of error at which the draws are counted at a time.
_NODES: Final = 400


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of confidence, NaN where there are fewer than `FEWEST_BLOCKS`.

    Attributes
    ----------
    blocks : int
    mean_m, rate, p95_m : tuple of float
        Lower and upper limit.
    """

    blocks: int
    mean_m: tuple[float, float]
    rate: tuple[float, float]
    p95_m: tuple[float, float]


def block_limits(
    error_m: Floats,
    observed: Masks,
    positioned: Masks,
    block: Integers,
    *,
    replicates: int,
    seed: int,
    confidence: float,
) -> Limits:
    """Percentile limits of mean, rate and 95th percentile, by drawing blocks with replacement.

    Each draw takes as many blocks as there are. The 95th percentile of a draw is the smallest size of
    error that 95 % of its errors do not exceed.

    Parameters
    ----------
    error_m : ndarray, shape (T,) [m]
        NaN where there is no error.
    observed, positioned : ndarray of bool, shape (T,)
    block : ndarray of int, shape (T,)
    replicates, seed : int
    confidence : float
    """
    names, member = np.unique(block, return_inverse=True)
    blocks = len(names)
    none = (float("nan"), float("nan"))
    if blocks < FEWEST_BLOCKS:
        return Limits(blocks=blocks, mean_m=none, rate=none, p95_m=none)
    drawn = np.random.default_rng(seed).integers(0, blocks, (replicates, blocks))
    times = np.zeros((replicates, blocks))
    np.add.at(times, (np.arange(replicates)[:, None], drawn), 1.0)
    has = np.isfinite(error_m)

    def sums(values: Floats) -> Floats:
        return times @ np.bincount(member, weights=values, minlength=blocks)

    errors = sums(has.astype(np.float64))
    tail = 50.0 * (1.0 - confidence)

    def limits(values: Floats) -> tuple[float, float]:
        values = values[np.isfinite(values)]
        if not len(values):
            return none
        low, high = np.percentile(values, [tail, 100.0 - tail])
        return float(low), float(high)

    with np.errstate(invalid="ignore", divide="ignore"):
        mean = sums(np.where(has, error_m, 0.0)) / errors
        rate = sums((positioned & observed).astype(np.float64)) / sums(observed.astype(np.float64))
    return Limits(
        blocks=blocks,
        mean_m=limits(mean),
        rate=limits(rate),
        p95_m=limits(_percentiles(np.abs(error_m[has]), member[has], times, errors)),
    )


def _percentiles(size: Floats, member: Integers, times: Floats, errors: Floats) -> Floats:
    """95th percentile of each draw, shape (replicates,); NaN where a draw has no error.

    Sizes are counted at nodes, and again at finer ones in the range in which the draws' percentiles lie,
    until every size of that range is a node.
    """
    found = np.full(len(times), np.nan)
    drawn = errors > 0
    if not drawn.any():
        return found
    values, rank = np.unique(size, return_inverse=True)
    # a tolerance, that 0.95 of 20 errors is the nineteenth
    wanted = (0.95 * errors[drawn] - 1e-9)[:, None]
    low, high, most = 0, len(values) - 1, _NODES
    while True:
        nodes = np.unique(np.linspace(low, high, min(high - low + 1, most)).round().astype(np.int64))
        here = rank <= high
        cell = member[here] * len(nodes) + np.searchsorted(nodes, rank[here])
        counts = np.bincount(cell, minlength=times.shape[1] * len(nodes)).reshape(-1, len(nodes))
        at = np.argmax(times[drawn] @ np.cumsum(counts, axis=1).astype(np.float64) >= wanted, axis=1)
        if len(nodes) == high - low + 1:
            found[drawn] = values[nodes[at]]
            return found
        before = high - low
        low, high = int(nodes[at.min() - 1]) + 1 if at.min() > 0 else low, int(nodes[at.max()])
        if high - low > before // 2:
            most = high - low + 1
