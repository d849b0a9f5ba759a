"""Local faults on a line: ranges beyond a bound in sigmas of the protection level; their rate, sides and places."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.special import betaincinv

from railfix.core.arrays import Integers, Masks
from railfix.ranges.error_model.fit import ErrorSamples
from railfix.ranges.error_model.model import FaultRate

#: Blocks of one satellite are numbered by time and satellite (`ErrorSamples.block`): satellites a block of time.
_SATELLITES: Final = 1_000_000


def fault_rate(
    samples: ErrorSamples, *, beyond_sigma: float = 5.0, confidence: float = 0.95, side_elevation_deg: float = 45.0
) -> FaultRate:
    """Measure the rate of local faults among the ranges that passed every screen, singly and by sides of the track.

    Parameters
    ----------
    samples : ErrorSamples
    beyond_sigma : float
    confidence : float
        Of the upper bounds.
    side_elevation_deg : float [deg]
        Elevation up to which satellites count as low, as `RiskBudget.side_elevation_deg`.
    """
    used = samples.used & np.isfinite(samples.error_m) & np.isfinite(samples.sigma_m)
    faulty = used & (np.abs(samples.error_m) > beyond_sigma * samples.sigma_m)
    every, bad = np.unique(samples.block[used]), np.unique(samples.block[faulty])
    ranges, count = int(used.sum()), int(faulty.sum())
    # Within a faulty block only a part of the ranges is faulty; without one, one range of a block would be.
    part = (count / ranges) / (len(bad) / len(every)) if len(bad) else 1.0
    upper = _upper(len(bad), len(every), confidence)
    low = used & (samples.elevation_deg < side_elevation_deg)
    sides, side_faults = (_sides_of_two(samples, which) for which in (low, low & faulty))
    return FaultRate(
        beyond_sigma=beyond_sigma,
        ranges=ranges,
        faulty=count,
        blocks=len(every),
        faulty_blocks=len(bad),
        prior=count / ranges if ranges else 0.0,
        upper=min(1.0, part * upper),
        together=_together(every, bad),
        side_blocks=sides,
        side_faulty_blocks=side_faults,
        side_upper=min(1.0, part * _upper(side_faults, sides, confidence)),
    )


def _upper(hits: int, trials: int, confidence: float) -> float:
    """Upper end of the one-sided interval of a probability (Clopper and Pearson)."""
    return float(betaincinv(hits + 1, trials - hits, confidence)) if trials > hits else 1.0


def _sides_of_two(samples: ErrorSamples, which: Masks) -> int:
    """Blocks of time with two satellites or more on a side of the track among some samples, each side for itself."""
    right = np.sin(np.radians(samples.relative_azimuth_deg[which])) > 0.0
    one = np.unique(np.stack([right.astype(np.int64), samples.block[which]], axis=1), axis=0)
    _, satellites = np.unique(np.stack([one[:, 0], one[:, 1] // _SATELLITES], axis=1), axis=0, return_counts=True)
    return int(np.count_nonzero(satellites >= 2))


def faulty_stretches(
    samples: ErrorSamples, *, length_m: float = 100.0, beyond_sigma: float = 5.0, confidence: float = 0.95
) -> tuple[tuple[float, float], ...]:
    """Stretches of the line where local faults are more frequent than on the whole line.

    A stretch is one whose share of faulty blocks is, at the lower end of its interval (Clopper and Pearson), above the
    share of the line at the upper end of its own. Where that holds, no prior of the line bounds the local faults:
    there the settings leave the train without a level (`Config.no_level_m`).

    Parameters
    ----------
    samples : ErrorSamples
    length_m : float [m]
    beyond_sigma, confidence : float
        As `fault_rate`; one-sided.

    Returns
    -------
    tuple of (float, float) [m]
        Chainages from and to; neighbouring stretches are joined.
    """
    used = samples.used & np.isfinite(samples.error_m) & np.isfinite(samples.sigma_m) & np.isfinite(samples.chainage_m)
    faulty = used & (np.abs(samples.error_m) > beyond_sigma * samples.sigma_m)
    if not faulty.any():
        return ()
    part = np.floor(samples.chainage_m[used] / length_m).astype(np.int64)
    pairs, number = np.unique(np.stack([part, samples.block[used]], axis=1), axis=0, return_inverse=True)
    bad = np.zeros(len(pairs), dtype=bool)
    bad[number.ravel()[faulty[used]]] = True
    places, of = np.unique(pairs[:, 0], return_inverse=True)
    blocks, hits = np.bincount(of), np.bincount(of, weights=bad)
    upper = betaincinv(bad.sum() + 1, max(len(bad) - bad.sum(), 1), confidence)
    lower = np.where(hits > 0, betaincinv(np.maximum(hits, 1), blocks - hits + 1, 1.0 - confidence), 0.0)
    marked = places[lower > upper]
    edges = np.flatnonzero(np.diff(marked, prepend=marked[:1] - 2, append=marked[-1:] + 2) > 1)
    return tuple(
        (float(marked[first] * length_m), float((marked[end - 1] + 1) * length_m))
        for first, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
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
