"""Figures of merit of a series of errors, and their confidence limits.

Errors of a train are correlated over tens of seconds, so that epochs are not independent samples; blocks
of a minute nearly are.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import nan
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Integers, Masks

#: Distance on the map from which on an answer is in the wrong place [m].
WRONG_PLACE_M = 50.0


@dataclass(frozen=True, kw_only=True)
class Score:
    """Figures of merit of a run."""

    epochs: int  #: Epochs with observations inside the time of the reference.
    positions: int  #: Those with coordinates.
    rate: float  #: positions / epochs.
    #: Of the signed error.
    mean_m: float
    std_m: float
    #: Of the absolute error.
    p50_m: float
    p95_m: float
    max_m: float
    wrong_place: float  #: Share of the positions more than `WRONG_PLACE_M` from the reference.


def score(error_m: Floats, observed: Masks) -> Score:
    """Figures of merit from signed errors, NaN where there is no position, at the epochs that are observed.

    Raises
    ------
    ValueError
        No epoch is observed.
    """
    if not observed.any():
        raise ValueError("no epoch with observations lies inside the time of the reference")
    values = error_m[observed & np.isfinite(error_m)]
    size = np.abs(values) if len(values) else np.array([np.nan])
    return Score(
        epochs=int(observed.sum()),
        positions=len(values),
        rate=len(values) / int(observed.sum()),
        mean_m=float(values.mean()) if len(values) else float("nan"),
        std_m=float(values.std()) if len(values) else float("nan"),
        p50_m=float(np.median(size)),
        p95_m=float(np.percentile(size, 95)),
        max_m=float(size.max()),
        wrong_place=float(np.mean(size > WRONG_PLACE_M)),
    )


#: Fewest blocks for confidence limits.
FEWEST_BLOCKS: Final = 5
#: Number of values at which the cumulative counts are evaluated at a time.
_NODES: Final = 400


#: Figures with limits, as columns: lower and upper limit; the last two are of the error size over its sigma.
LIMITS: Final = ("mean{}_m", "rate{}", "p95{}_m", "normalised_p68{}", "normalised_p95{}")
LIMIT_COLUMNS: Final = tuple(name.format(end) for name in LIMITS for end in ("_low", "_high"))


def block_limits(
    error_m: Floats,
    sigma_m: Floats,
    observed: Masks,
    positioned: Masks,
    block: Integers,
    *,
    replicates: int,
    seed: int,
    confidence: float,
) -> dict[str, float]:
    """Percentile limits of mean, rate and percentiles (`LIMIT_COLUMNS`) and number of blocks, by resampling blocks.

    Blocks are drawn with replacement, as many as the data has. A percentile of a resample is the smallest value that
    the given share of its values do not exceed. The limits are NaN with fewer than `FEWEST_BLOCKS` blocks.

    Parameters
    ----------
    error_m, sigma_m : ndarray, shape (T,) [m]
        NaN where there is no error, where the standard deviation of the position is not known.
    observed, positioned : ndarray of bool, shape (T,)
    block : ndarray of int, shape (T,)
    replicates, seed : int
    confidence : float
    """
    names, member = np.unique(block, return_inverse=True)
    blocks = len(names)
    if blocks < FEWEST_BLOCKS:
        return {"blocks": blocks, **dict.fromkeys(LIMIT_COLUMNS, nan)}
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
            return nan, nan
        low, high = np.percentile(values, [tail, 100.0 - tail])
        return float(low), float(high)

    def of_percentile(values: Floats, share: float) -> tuple[float, float]:
        known = np.isfinite(values)
        counts = sums(known.astype(np.float64))
        return limits(_percentiles(values[known], member[known], times, counts, share=share))

    with np.errstate(invalid="ignore", divide="ignore"):
        mean = sums(np.where(has, error_m, 0.0)) / errors
        rate = sums((positioned & observed).astype(np.float64)) / sums(observed.astype(np.float64))
    size = np.abs(error_m)
    ends = (
        *limits(mean),
        *limits(rate),
        *of_percentile(size, 0.95),
        *of_percentile(size / sigma_m, 0.68),
        *of_percentile(size / sigma_m, 0.95),
    )
    return {"blocks": blocks, **dict(zip(LIMIT_COLUMNS, ends, strict=True))}


def _percentiles(size: Floats, member: Integers, times: Floats, errors: Floats, *, share: float) -> Floats:
    """Percentile of each resample, shape (replicates,); NaN where a resample has no value.

    Values are counted at nodes, then at finer nodes in the range of the percentiles of all resamples, until every
    value of that range is a node.
    """
    found = np.full(len(times), np.nan)
    drawn = errors > 0
    if not drawn.any():
        return found
    values, rank = np.unique(size, return_inverse=True)
    # a tolerance, so that 0.95 of 20 errors is the nineteenth
    wanted = (share * errors[drawn] - 1e-9)[:, None]
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
