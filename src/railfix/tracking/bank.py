"""Level of the filtered position by solution separation over a bank of sub-filters.

Each sub-filter runs the same recursion without one satellite, one constellation or one sensor, from its own beginning:
a fault of that source, however long it has lasted and whatever it has left in the state, is not in it. With the place
s and its standard deviation sigma, and those of the sub-filters::

    level = max(K0 sigma, max over b of |s - s_b| + K1 sigma_b)

K0 spends the risk on noise without a fault, K1 that on a fault of one source with its prior probability (the
hypotheses of R. G. Brown and P. W. McBurney, 1988, over a filter instead of an epoch). The separation bounds the error,
it is no test: robust filters can settle in different modes without a fault.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import ndtri

from railfix.core.arrays import Floats, Masks, Strings
from railfix.tracking.hypotheses import begin
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.predict import predicted
from railfix.tracking.robust import applied, first_weights, prior_of, robust_update
from railfix.tracking.rows import Kind, Rows
from railfix.tracking.state import CLOCKS, SATELLITES, Bank, Unknown

#: Sensors by the kind of their rows.
SENSORS: Final = {Kind.WHEEL: "wheel", Kind.RADAR: "radar", Kind.FORCE: "force", Kind.PLACE: "place"}
#: Share of a way that a source without codes may be wrong by: a worn or wrongly entered wheel.
SCALE_BOUND: Final = 0.02


def factors(limits: TrackingLimits) -> tuple[float, float]:
    """Sigmas without a fault and beside the separation, K0 and K1.

    Half of the risk of an hour goes to each, over so many independent errors an hour, on both sides.
    """
    risk = 0.5 * limits.level_risk_per_hour / limits.level_samples_per_hour
    return float(-ndtri(0.5 * risk)), float(-ndtri(min(0.5 * risk / limits.level_fault_prior, 0.5)))


def levelled(
    bank: Bank,
    rows: Rows,
    best: int,
    before: tuple[Floats, Floats],
    stepped: Masks,
    satellite: Strings,
    new: frozenset[str],
    line: Line,
    dt: float,
    limits: TrackingLimits,
    map_scale: float,
) -> Bank:
    """The bank after an epoch.

    Parameters
    ----------
    bank : Bank
        After the epoch before.
    rows : Rows
        About the mean of the most probable hypothesis, clocks near the epoch's.
    best : int
        Its row.
    before : tuple of ndarray, shapes (N,), (N, N)
        Its mean and covariance before the update.
    stepped : ndarray of bool, shape (N,)
        Clocks that begin anew.
    satellite : ndarray of str, shape (M,)
        Of each row, empty for sensors.
    new : frozenset of str
        Satellites that the filter meets for the first time.
    line : Line
    dt : float [s]
    limits : TrackingLimits
    map_scale : float
    """
    mean, covariance = before
    if len(bank.without):
        means, covariances = predicted(bank.mean, bank.covariance, line, dt, limits, map_scale)
    else:
        means, covariances = bank.mean, bank.covariance
    names = _sources(rows, satellite)
    # One that its own measurements contradict has settled somewhere else and begins anew.
    kept = [
        k
        for k, name in enumerate(bank.without)
        if (name in names or name in CLOCKS or name in SENSORS.values()) and bank.weak_s[k] < limits.lost_motion_s
    ]
    added = [name for name in names if name not in {bank.without[k] for k in kept}]
    copies = [name in new and len(bank.without) > 0 for name in added]
    weak = np.concatenate([bank.weak_s[kept], np.zeros(len(added))])
    fresh = begin(
        np.full(len(added), mean[Unknown.PLACE]),
        np.full(len(added), limits.start_sigma_m),
        len(mean) - SATELLITES,
        line,
        limits,
    )
    for k, copy in enumerate(copies):
        if copy:
            fresh[0][k], fresh[1][k] = mean, covariance
    means = np.concatenate([means[kept], fresh[0]])
    covariances = np.concatenate([covariances[kept], fresh[1]])
    without = (*(bank.without[k] for k in kept), *added)
    if not without:
        return Bank(without=without, mean=means, covariance=covariances, weak_s=weak)
    for unknown in np.flatnonzero(stepped):
        means[:, unknown] = mean[unknown]
        covariances[:, unknown, :] = covariances[:, :, unknown] = 0.0
        covariances[:, unknown, unknown] = covariance[unknown, unknown]
    means[:, Unknown.CODE_CLOCK] = mean[Unknown.CODE_CLOCK]
    combine, design = rows.combine[best : best + 1], rows.design[best : best + 1]
    value = rows.value[best] - (design @ (combine @ (means - mean)[..., None]))[..., 0]
    own = replace(rows, combine=combine, design=design, value=value)
    use = np.stack([~_of(name, rows, satellite) for name in without])
    degrees = limits.degrees_of_freedom
    prior = prior_of(own, covariances)
    weight = first_weights(own, prior, degrees)
    update = robust_update(own, prior, weight, degrees=degrees, passes=limits.level_passes, use=use)
    weak = np.where(_contradicted(rows, update.weight, use, limits), weak + dt, 0.0)
    means, covariances = applied(means, covariances, prior, update)
    return Bank(without=without, mean=means, covariance=covariances, weak_s=weak)


def _contradicted(rows: Rows, weight: Floats, use: Masks, limits: TrackingLimits) -> Masks:
    """Whether the mean weight of codes, or of Dopplers and phases, is that of a lost track, shape (B,)."""
    found = np.zeros(len(weight), dtype=np.bool_)
    for part, least in ((rows.codes, limits.lost_code_weight), (rows.motion, limits.lost_motion_weight)):
        count = use[:, part].sum(axis=1)
        found |= (count > 0) & (np.where(use[:, part], weight[:, part], 0.0).sum(axis=1) < least * count)
    return found


def _sources(rows: Rows, satellite: Strings) -> list[str]:
    """Satellites with a code, constellations where there are several, and sensors of an epoch."""
    codes = satellite[rows.codes]
    names = [str(name) for name in dict.fromkeys(codes.tolist())]
    letters = [letter for letter in CLOCKS if any(_clock(name) == letter for name in names)]
    sensors = [name for kind, name in SENSORS.items() if (rows.kind == kind).any()]
    return [*names, *(letters if len(letters) > 1 else []), *sensors]


def _clock(satellite: str) -> str:
    return "G" if satellite[:1] in ("J", "S") else satellite[:1]


def _of(name: str, rows: Rows, satellite: Strings) -> Masks:
    """Rows of a source."""
    if name in SENSORS.values():
        return np.asarray(rows.kind == next(kind for kind, text in SENSORS.items() if text == name))
    if name in CLOCKS:
        return np.array([_clock(str(other)) == name for other in satellite], dtype=np.bool_)
    return np.asarray(satellite == name)


def level_m(bank: Bank, place_m: float, sigma_m: float, limits: TrackingLimits) -> tuple[float, float, float]:
    """Level, its part by noise and the largest separation [m]; infinite without a sub-filter."""
    noise, fault = factors(limits)
    if not bank.without:
        return float("inf"), noise * sigma_m, float("nan")
    apart = np.abs(bank.mean[:, Unknown.PLACE] - place_m)
    sigma = np.sqrt(bank.covariance[:, Unknown.PLACE, Unknown.PLACE])
    level = max(noise * sigma_m, float((apart + fault * sigma).max()))
    return level, noise * sigma_m, float(apart.max())
