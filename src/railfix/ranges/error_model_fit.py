"""Fit of an error model to samples: statistics of bins, pooled where samples are few, and rate of local faults.

A normal distribution shifted by +b bounds the upper half of the errors, and a normal distribution shifted by -b bounds
the lower half (CDF overbounding, B. DeCleene, ION GPS 2000). The shifted distributions also bound sums of independent
errors, if the distribution of the errors is symmetric and unimodal after the shift (the two-step method of J. Blanch,
T. Walter, P. Enge, 2019, doi:10.1109/TAES.2018.2876583). Neither property can be proven from samples.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy
from pydantic import Field

from railfix.core.arrays import Floats, Integers, Masks
from railfix.core.options import option
from railfix.core.settings import Settings
from railfix.ranges.error_model import POOLED, BinStatistics, ErrorBins, ErrorModel, FaultRate

TAIL_SCORE: Final = 1.0  #: Samples beyond this standard score determine sigma.


def gaussian_overbound(error_m: Floats) -> tuple[float, float]:
    """Return bias and sigma [m] of two normal distributions, shifted by +bias and -bias, that bound a sample (n,).

    Counted from either end, the k-th of n samples is the quantile of probability ``k / (n + 1)``. With the absolute
    value of the median as bias, sigma is the least value that bounds both tails (beyond one standard score). With this
    sigma, the bias is increased until it bounds all samples. Beyond the largest sample the bound is a normal
    extrapolation. Raises ValueError for fewer than three samples, or if a sample is not finite.
    """
    if len(error_m) < 3 or not np.isfinite(error_m).all():
        raise ValueError("an overbound needs at least three samples, all finite")
    ordered = np.sort(error_m)
    score = scipy.special.ndtri(np.arange(1, len(ordered) + 1) / (len(ordered) + 1.0))
    half = score >= 0.0
    # Distances outward from zero; the lower half is mirrored.
    score, sizes = score[half], (ordered[half], -ordered[::-1][half])
    center = abs(float(np.median(ordered)))
    tail = score >= min(TAIL_SCORE, float(score[-1]))
    sigma = max(0.0, *(float(np.max((size[tail] - center) / score[tail])) for size in sizes))
    bias = max(center, *(float(np.max(size - sigma * score)) for size in sizes))
    return bias, sigma


class ErrorModelFit(Settings):
    """Settings of the fit of an error model."""

    bins: ErrorBins = Field(default_factory=ErrorBins)
    #: Number of independent blocks below which a bin uses the samples of a wider set of bins. The largest of 30 normal
    #: errors is about two standard deviations from the mean, so that 30 blocks include the beginning of the tail.
    least_blocks: int = option(
        "Bins with fewer blocks (30 s of one satellite) use samples of more bins.", 30, metavar="N", ge=1
    )
    #: Length of the blocks into which a satellite's samples are divided [s]. Errors are correlated over tens of seconds
    #: while a train is at rest.
    block_s: float = Field(default=30.0, gt=0.0)


@dataclass(frozen=True, kw_only=True)
class ErrorSamples:
    """Errors of individual pseudoranges, n samples."""

    error_m: Floats  #: Error of the pseudorange, shape (n,).
    elevation_deg: Floats  #: Elevation of the satellite, shape (n,).
    relative_azimuth_deg: Floats  #: Azimuth of the satellite, clockwise from the car's front, shape (n,).
    cn0_dbhz: Floats  #: Carrier-to-noise density, shape (n,).
    #: Number of the sample's block, shape (n,). A block has the samples of one satellite in a time interval; their
    #: errors are correlated.
    block: Integers
    used: Masks  #: True for samples that passed every screen, shape (n,).
    sigma_m: Floats  #: Sigma that the run's protection level assumes for the range, shape (n,).
    chainage_m: Floats  #: Chainage of the train; NaN where unknown; shape (n,).


def fit_bins(samples: ErrorSamples, which: Masks, fit: ErrorModelFit) -> BinStatistics:
    """Return the statistics of all bins, computed from the samples for which `which`, shape (n,), is true.

    A bin with fewer blocks than `ErrorModelFit.least_blocks` uses the samples of a wider set of bins, the first of the
    following sets with enough blocks: all azimuths at the bin's elevation and C/N0; all azimuths and C/N0 at the bin's
    elevation; all azimuths and elevations at the bin's C/N0; all samples.
    """
    bins = fit.bins
    kept = which & np.isfinite(samples.error_m)
    index = bins.index(samples.elevation_deg, samples.relative_azimuth_deg, samples.cn0_dbhz)
    kept &= index >= 0
    error, block, index = samples.error_m[kept], samples.block[kept], index[kept]
    size = int(np.prod(bins.shape))
    count = np.bincount(index, minlength=size)
    blocks = np.bincount(np.unique(np.stack([index, block]), axis=1)[0], minlength=size)  # distinct blocks of each bin
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


def _members(shape: tuple[int, int, int]) -> tuple[Integers, ...]:
    """Return, for each pooling level, the index of the set to which each bin belongs."""
    e, _, c = (part.ravel() for part in np.indices(shape))
    own = np.arange(e.size)
    return own, e * shape[2] + c, e, c, np.zeros(e.size, dtype=np.int64)


def _figures(error: Floats) -> tuple[float, float, float, float]:
    if len(error) < 3:
        return (float("nan"),) * 4
    return float(error.mean()), float(error.std(ddof=1)), *gaussian_overbound(error)


_SIDES: Final = {1: ("all round",), 2: ("ahead", "behind"), 4: ("ahead", "right", "behind", "left")}


def summary(model: ErrorModel) -> Iterator[tuple[str, ...]]:
    """Yield the rows of a table: one for each elevation interval, each azimuth sector and each C/N0 interval.

    A row has a name, and count, bias, sigma and overbound before and after the screens. Bias and sigma are combined
    from the bins of the row with the counts as weights. The overbound is stated as the smallest and the largest
    bounding sigma of these bins.
    """
    bins = model.bins
    width = 360.0 / bins.sectors
    names = (
        [f"elevation {a:g}-{b:g}" for a, b in zip(bins.elevation_deg[:-1], bins.elevation_deg[1:], strict=True)],
        list(_SIDES.get(bins.sectors, tuple(f"azimuth {k * width:g} deg" for k in range(bins.sectors)))),
        [f"C/N0 {a:g}-{b:g}" for a, b in zip(bins.cn0_dbhz[:-1], bins.cn0_dbhz[1:], strict=True)],
    )
    for axis, labels in enumerate(names):
        for k, name in enumerate(labels):
            yield name, *_cells(model.before, axis, k), *_cells(model.after, axis, k)


def _cells(statistics: BinStatistics, axis: int, k: int) -> tuple[str, str, str, str]:
    count = np.take(statistics.count, k, axis=axis)
    total, has = int(count.sum()), count > 0
    if total == 0:
        return "0", "-", "-", "-"
    bias, sigma, bound = (
        np.take(getattr(statistics, name), k, axis=axis)[has] for name in ("bias_m", "sigma_m", "bound_sigma_m")
    )
    share = count[has] / total
    mean = float(np.nansum(share * bias))
    spread = float(np.sqrt(np.nansum(share * (sigma**2 + (bias - mean) ** 2))))
    return f"{total:,}", f"{mean:+.2f}", f"{spread:.2f}", f"{np.nanmin(bound):.1f}-{np.nanmax(bound):.1f}"


_BEYOND_SIGMA: Final = 5.0  #: A range is faulty if its error exceeds this multiple of its sigma.
_CONFIDENCE: Final = 0.95  #: Confidence level of the bounds of fault rates.
#: Satellites below this elevation [deg] count as low; the limit equals `RiskBudget.side_elevation_deg`.
_SIDE_ELEVATION_DEG: Final = 45.0
#: Length of the parts of the line that are compared with the whole line [m].
_STRETCH_M: Final = 100.0
#: The number of a block is the index of the time interval times this value, plus the index of the satellite
#: (`ErrorSamples.block`).
_SATELLITES: Final = 1_000_000


def fault_rate(samples: ErrorSamples) -> FaultRate:
    """Return the rates of local faults of single ranges, and of simultaneous faults on one side of the track.

    Only ranges that passed every screen are counted.
    """
    used = samples.used & np.isfinite(samples.error_m) & np.isfinite(samples.sigma_m)
    faulty = used & (np.abs(samples.error_m) > _BEYOND_SIGMA * samples.sigma_m)
    every, bad = np.unique(samples.block[used]), np.unique(samples.block[faulty])
    ranges, count = int(used.sum()), int(faulty.sum())
    # fraction of faulty ranges in a faulty block; 1 without a faulty block
    part = (count / ranges) / (len(bad) / len(every)) if len(bad) else 1.0
    upper = _upper(len(bad), len(every))
    low = used & (samples.elevation_deg < _SIDE_ELEVATION_DEG)
    sides, side_faults = (_sides_of_two(samples, which) for which in (low, low & faulty))
    return FaultRate(
        beyond_sigma=_BEYOND_SIGMA,
        ranges=ranges,
        faulty=count,
        blocks=len(every),
        faulty_blocks=len(bad),
        prior=count / ranges if ranges else 0.0,
        upper=min(1.0, part * upper),
        together=_together(every, bad),
        side_blocks=sides,
        side_faulty_blocks=side_faults,
        side_upper=min(1.0, part * _upper(side_faults, sides)),
    )


def _upper(hits: int, trials: int) -> float:
    """Return the upper end of the one-sided 95 % interval of a probability (Clopper and Pearson); 1 without trials."""
    return float(scipy.special.betaincinv(hits + 1, trials - hits, _CONFIDENCE)) if trials > hits else 1.0


def _sides_of_two(samples: ErrorSamples, which: Masks) -> int:
    """Count, in the samples `which`, intervals with two or more satellites on one side; each side counts separately."""
    right = np.sin(np.radians(samples.relative_azimuth_deg[which])) > 0.0
    one = np.unique(np.stack([right.astype(np.int64), samples.block[which]], axis=1), axis=0)
    _, satellites = np.unique(np.stack([one[:, 0], one[:, 1] // _SATELLITES], axis=1), axis=0, return_counts=True)
    return int(np.count_nonzero(satellites >= 2))


def faulty_stretches(samples: ErrorSamples) -> tuple[tuple[float, float], ...]:
    """Return start and end chainages [m] of stretches with more frequent local faults than the line as a whole.

    A stretch is reported if the lower limit (Clopper and Pearson, one-sided) of the fraction of faulty blocks on the
    stretch exceeds the upper limit of this fraction on the whole line; neighbouring stretches are joined. The prior of
    the line does not bound local faults on these stretches; the setting `Config.no_level_m` suppresses the protection
    levels there.
    """
    used = samples.used & np.isfinite(samples.error_m) & np.isfinite(samples.sigma_m) & np.isfinite(samples.chainage_m)
    faulty = used & (np.abs(samples.error_m) > _BEYOND_SIGMA * samples.sigma_m)
    if not faulty.any():
        return ()
    part = np.floor(samples.chainage_m[used] / _STRETCH_M).astype(np.int64)
    pairs, number = np.unique(np.stack([part, samples.block[used]], axis=1), axis=0, return_inverse=True)
    bad = np.zeros(len(pairs), dtype=bool)
    bad[number.ravel()[faulty[used]]] = True
    places, of = np.unique(pairs[:, 0], return_inverse=True)
    blocks, hits = np.bincount(of), np.bincount(of, weights=bad)
    upper = scipy.special.betaincinv(bad.sum() + 1, max(len(bad) - bad.sum(), 1), _CONFIDENCE)
    lower = np.where(hits > 0, scipy.special.betaincinv(np.maximum(hits, 1), blocks - hits + 1, 1.0 - _CONFIDENCE), 0.0)
    marked = places[lower > upper]
    edges = np.flatnonzero(np.diff(marked, prepend=marked[:1] - 2, append=marked[-1:] + 2) > 1)
    return tuple(
        (float(marked[first] * _STRETCH_M), float((marked[end - 1] + 1) * _STRETCH_M))
        for first, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
    )


def _together(every: Integers, bad: Integers) -> float:
    """Return the ratio of observed to expected intervals with two or more faulty satellites; 0 without faults."""
    if not len(bad):
        return 0.0
    times, satellites = np.unique(every // _SATELLITES, return_counts=True)
    faulty = np.zeros(len(times), dtype=np.int64)
    np.add.at(faulty, np.searchsorted(times, bad // _SATELLITES), 1)
    rate = len(bad) / len(every)
    alone = (1.0 - rate) ** satellites + satellites * rate * (1.0 - rate) ** (satellites - 1)
    return float(np.count_nonzero(faulty >= 2) / np.maximum((1.0 - alone).sum(), 1e-12))
