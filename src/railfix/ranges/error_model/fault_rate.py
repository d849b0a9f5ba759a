"""Rate of local faults on a line: ranges beyond a bound in sigmas of the protection level, with confidence."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.special import betaincinv

from railfix.core.arrays import Integers
from railfix.ranges.error_model.fit import ErrorSamples
from railfix.ranges.error_model.model import FaultRate

#: Blocks of one satellite are numbered by time and satellite (`ErrorSamples.block`): satellites a block of time.
_SATELLITES: Final = 1_000_000


def fault_rate(samples: ErrorSamples, *, beyond_sigma: float = 5.0, confidence: float = 0.95) -> FaultRate:
    """Measure the rate of local faults among the ranges that passed every screen.

    Parameters
    ----------
    samples : ErrorSamples
    beyond_sigma : float
    confidence : float
        Of the upper bound.
    """
    used = samples.used & np.isfinite(samples.error_m) & np.isfinite(samples.sigma_m)
    faulty = used & (np.abs(samples.error_m) > beyond_sigma * samples.sigma_m)
    every, bad = np.unique(samples.block[used]), np.unique(samples.block[faulty])
    ranges, count = int(used.sum()), int(faulty.sum())
    # Within a faulty block only a part of the ranges is faulty; without one, one range of a block would be.
    part = (count / ranges) / (len(bad) / len(every)) if len(bad) else 1.0
    upper = float(betaincinv(len(bad) + 1, len(every) - len(bad), confidence)) if len(every) > len(bad) else 1.0
    return FaultRate(
        beyond_sigma=beyond_sigma,
        ranges=ranges,
        faulty=count,
        blocks=len(every),
        faulty_blocks=len(bad),
        prior=count / ranges if ranges else 0.0,
        upper=min(1.0, part * upper),
        together=_together(every, bad),
    )


def _together(every: Integers, bad: Integers) -> float:
    """Blocks of time with two faulty satellites or more, over the number that independent satellites would give."""
    if not len(bad):
        return 0.0
    times, satellites = np.unique(every // _SATELLITES, return_counts=True)
    faulty = np.zeros(len(times), dtype=np.int64)
    np.add.at(faulty, np.searchsorted(times, bad // _SATELLITES), 1)
    rate = len(bad) / len(every)
    alone = (1.0 - rate) ** satellites + satellites * rate * (1.0 - rate) ** (satellites - 1)
    return float(np.count_nonzero(faulty >= 2) / np.maximum((1.0 - alone).sum(), 1e-12))
