"""Error model from samples: bins, pooling where they are thin, statistics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats, Integers, Masks
from railfix.core.settings import Settings, option
from railfix.ranges.error_model.model import POOLED, BinStatistics, ErrorBins
from railfix.ranges.error_model.overbound import gaussian_overbound


class ErrorModelFit(Settings):
    """Settings of the fit of an error model.

    Attributes
    ----------
    bins : ErrorBins
    least_blocks : int
        Independent passes below which a bin takes the samples of a wider set of bins. 30: its largest error is then
        about the quantile of 2 standard scores, so that at least the shoulder of the tail was seen.
    block_s : float [s]
        Length of the blocks that a satellite's samples are counted in. Errors are correlated over tens of
        seconds where a train is at rest.
    """

    bins: ErrorBins = Field(default_factory=ErrorBins)
    least_blocks: int = option(
        "Passes of a satellite (30 s blocks) below which a bin takes the values of a wider one.", 30, metavar="N", ge=1
    )
    block_s: float = Field(default=30.0, gt=0.0)


@dataclass(frozen=True, kw_only=True)
class ErrorSamples:
    """Errors of single pseudoranges, n samples.

    Attributes
    ----------
    error_m : ndarray, shape (n,) [m]
    elevation_deg, relative_azimuth_deg, cn0_dbhz : ndarray, shape (n,)
    block : ndarray of int, shape (n,)
        Number of the satellite's block of time: samples of one block are not independent.
    used : ndarray of bool, shape (n,)
        Samples that passed every screen.
    sigma_m : ndarray, shape (n,) [m]
        Standard deviation that the protection level of the run gave the range.
    chainage_m : ndarray, shape (n,) [m]
        Place of the train; NaN where unknown.
    """

    error_m: Floats
    elevation_deg: Floats
    relative_azimuth_deg: Floats
    cn0_dbhz: Floats
    block: Integers
    used: Masks
    sigma_m: Floats
    chainage_m: Floats


def fit_bins(samples: ErrorSamples, which: Masks, fit: ErrorModelFit) -> BinStatistics:
    """Statistics of the bins from some of the samples.

    A bin with fewer blocks than `ErrorModelFit.least_blocks` takes those of all azimuths of its elevation and
    C/N0, then of all C/N0 too, then of all elevations of its C/N0, then all.

    Parameters
    ----------
    samples : ErrorSamples
    which : ndarray of bool, shape (n,)
        Samples to take.
    fit : ErrorModelFit

    Returns
    -------
    BinStatistics
    """
    bins = fit.bins
    kept = which & np.isfinite(samples.error_m)
    index = bins.index(samples.elevation_deg, samples.relative_azimuth_deg, samples.cn0_dbhz)
    kept &= index >= 0
    error, block, index = samples.error_m[kept], samples.block[kept], index[kept]
    size = int(np.prod(bins.shape))
    count = np.bincount(index, minlength=size)
    blocks = _distinct(index, block, size)
    sets = _members(bins.shape)
    figures = np.full((4, size), np.nan)
    pooled = np.full(size, len(POOLED) - 1, dtype=np.int64)
    done: dict[tuple[int, int], tuple[float, ...]] = {}
    order = np.argsort(index, kind="stable")
    start = np.concatenate([[0], np.cumsum(count)])
    for bin_ in range(size):
        for level, member in enumerate(sets):
            key = (level, int(member[bin_]))
            of_set = np.flatnonzero(member == member[bin_])
            enough = len(np.unique(block[_rows(order, start, of_set)])) >= fit.least_blocks
            if not enough and level < len(sets) - 1:
                continue
            if key not in done:
                done[key] = _figures(error[_rows(order, start, of_set)])
            figures[:, bin_], pooled[bin_] = done[key], level
            break
    bias, sigma, bound_bias, bound_sigma = (part.reshape(bins.shape) for part in figures)
    return BinStatistics(
        count=count.reshape(bins.shape),
        blocks=blocks.reshape(bins.shape),
        bias_m=bias,
        sigma_m=sigma,
        bound_bias_m=bound_bias,
        bound_sigma_m=bound_sigma,
        pooled=pooled.reshape(bins.shape),
    )


def _rows(order: Integers, start: Integers, of_set: Integers) -> Integers:
    return np.concatenate([order[start[i] : start[i + 1]] for i in of_set.tolist()])


def _distinct(index: Integers, block: Integers, size: int) -> Integers:
    """Number of different blocks in each bin."""
    pairs = np.unique(np.stack([index, block]), axis=1)
    return np.bincount(pairs[0], minlength=size)


def _members(shape: tuple[int, int, int]) -> tuple[Integers, ...]:
    """For each level of pooling the number of the set that each bin belongs to."""
    e, _, c = (part.ravel() for part in np.indices(shape))
    own = np.arange(e.size)
    return own, e * shape[2] + c, e, c, np.zeros(e.size, dtype=np.int64)


def _figures(error: Floats) -> tuple[float, float, float, float]:
    if len(error) < 3:
        return (float("nan"),) * 4
    bound = gaussian_overbound(error)
    return float(error.mean()), float(error.std(ddof=1)), bound.bias_m, bound.sigma_m
