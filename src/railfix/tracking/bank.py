"""Level of the filtered position by solution separation over a bank of sub-filters.

Each sub-filter runs the same recursion without one satellite, one constellation or one sensor, from its own beginning:
a fault of that source, however long it has lasted and whatever it has left in the state, is not in it. With the place
s and its standard deviation sigma, those of the sub-filters, Q the upper tail of the normal distribution and p_b the
probability that source b is faulty or was so recently that the filter still remembers it, the level L solves::

    2 Q(L / sigma) + sum over b of p_b [Q((L - |s - s_b|) / sigma_b) + Q((L + |s - s_b|) / sigma_b)] = risk

of an independent error. Every hypothesis thus spends what it needs instead of an equal share (the hypotheses of
R. G. Brown and P. W. McBurney, 1988, the allocation of J. Blanch et al., 2013, doi:10.1109/TAES.2013.6494396, over a
filter instead of an epoch). The separation bounds the error, it is no test: robust filters can settle in different
modes without a fault.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import Final

import numpy as np
from scipy.special import ndtr, ndtri

from railfix.core.arrays import Floats, Masks, Strings
from railfix.tracking.branches import begin, on_the_line
from railfix.tracking.chunk import FORGOTTEN, Chunk
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.predict import predicted
from railfix.tracking.robust import applied, first_weights, prior_of, robust_update
from railfix.tracking.rows import MOTION, Kind, Rows, SensorRows, rows_of
from railfix.tracking.state import CLOCKS, SATELLITES, Bank, Unknown

#: Sensors by the kind of their rows.
SENSORS: Final = {kind: kind.name.lower() for kind in Kind if kind >= Kind.WHEEL}
#: Share of a way that a source without codes may be wrong by: a worn or wrongly entered wheel.
SCALE_BOUND: Final = 0.02
_PLACES: Final = [Unknown.PLACE, Unknown.BEFORE]
#: How long a fault common to a constellation lasts until users are told [s] (ARAIM milestone 3 report: an hour).
CONSTELLATION_FAULT_S: Final = 3600.0
#: Sources whose probabilities add up to less than this share of the risk need no sub-filter, if there are so many.
SPARED: Final = 0.1
MOST_SOURCES: Final = 64
#: Risk of the bound on the speed over that of the level.
SPEED_SHARE: Final = 0.01
#: A source that is not measured needs no sub-filter once it has left the filter: place and standard deviation differ
#: by less than this share of the standard deviation.
JOINED: Final = 0.05
#: Newton's steps for the level end when one is smaller than this [m].
PRECISION_M: Final = 1e-7
ROUNDS: Final = 60


class SourceKind(IntEnum):
    """Kind of a source of measurements that has a sub-filter, in the order of `Budget.prior`."""

    SATELLITE = 0
    CONSTELLATION = 1
    SENSOR = 2
    MOTION = 3
    MAP = 4


#: Sources beside satellites, constellations and sensors: all Dopplers, all phases, the map.
OTHERS: Final = ("doppler", "phase", "map")


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Risk of an independent error and probabilities of faults, with the factors that follow from them.

    Attributes
    ----------
    risk : float
    k : float
        Sigmas that noise without a fault exceeds with the risk, on either side.
    prior : tuple of float
        Probability that a source of each `SourceKind` is faulty or still remembered; 0 needs no sub-filter.
    k_fault : tuple of float
        Sigmas that noise exceeds on one side with the risk over that probability: what a sub-filter asks for at least.
    k_speed : float
    k_speed_fault : tuple of float
        The same of the bound on the speed, which has `SPEED_SHARE` of the risk on top, in equal parts for all sources.
    """

    risk: float
    k: float
    prior: tuple[float, ...]
    k_fault: tuple[float, ...]
    k_speed: float
    k_speed_fault: tuple[float, ...]


@lru_cache(maxsize=8)
def budget(limits: TrackingLimits) -> Budget:
    """Return the risk of an independent error, and the probabilities of faults of the sources.

    The filter remembers a source for as long as its errors stay in the state, `FORGOTTEN` correlation times after a
    fault that lasts for one independent error, or `CONSTELLATION_FAULT_S` for one of a constellation.
    """
    risk = limits.level_risk_per_hour / limits.level_samples_per_hour
    remembered_s = FORGOTTEN * limits.code_correlation_s
    local = 1.0 + remembered_s * limits.level_samples_per_hour / 3600.0
    exposed = [
        min(local * limits.level_fault_prior, 1.0),
        min((1.0 + remembered_s / CONSTELLATION_FAULT_S) * limits.level_constellation_prior, 1.0),
        min(local * limits.level_sensor_prior, 1.0),
        min(local * limits.level_motion_prior, 1.0),
        min(local * limits.level_map_prior, 1.0),
    ]
    kept = [prior if MOST_SOURCES * prior > SPARED * risk else 0.0 for prior in exposed]
    risk -= MOST_SOURCES * sum(prior for prior, monitored in zip(exposed, kept, strict=True) if not monitored)
    of_speed = SPEED_SHARE * risk / (MOST_SOURCES + 1)

    def sigmas(share: float) -> tuple[float, ...]:
        return tuple(float(-ndtri(min(share / prior, 0.5))) if prior else 0.0 for prior in kept)

    return Budget(
        risk=risk,
        k=float(-ndtri(0.5 * risk)),
        prior=tuple(kept),
        k_fault=sigmas(risk),
        k_speed=float(-ndtri(0.5 * of_speed)),
        k_speed_fault=sigmas(of_speed),
    )


def levelled(
    bank: Bank,
    rows: Rows,
    best: int,
    before: tuple[Floats, Floats],
    stepped: Masks,
    satellite: Strings,
    remembered: frozenset[str],
    chunk: Chunk,
    epoch: int,
    scale: tuple[float, float],
    line: Line,
    limits: TrackingLimits,
    map_scale: float,
) -> Bank:
    """The bank after an epoch.

    Parameters
    ----------
    bank : Bank
        After the epoch before.
    rows : Rows
        Of the filter; those of the sensors are taken over, the others made about the place of each sub-filter: where
        the line bends between the two, the equations of one are none of the other.
    best : int
        Its row.
    before : tuple of ndarray, shapes (N,), (N, N)
        Its mean and covariance before the update.
    stepped : ndarray of bool, shape (N,)
        Clocks that begin anew.
    satellite : ndarray of str, shape (M,)
        Of each row, empty for sensors.
    remembered : frozenset of str
        Satellites measured before the epoch, so recently that their errors are in the state.
    chunk : Chunk
    epoch : int
    scale : tuple of float
        Logarithms of what the variances of Dopplers and phases are multiplied by.
    line : Line
    limits : TrackingLimits
    map_scale : float
    """
    dt = float(chunk.interval_s[epoch])
    mean, covariance = before
    if len(bank.without):
        means, covariances = predict_bank(bank, line, dt, limits, map_scale)
    else:
        means, covariances = bank.mean, bank.covariance
    names = _sources(rows, satellite, limits)
    if not bank.without:  # what the hypothesis has met before is still in it
        names = [*names, *(name for name in sorted(remembered) if name not in names)]
    # One that its own measurements contradict has settled somewhere else and begins anew.
    weak = bank.weak_s >= limits.lost_motion_s
    sigma = np.sqrt(covariances[:, Unknown.PLACE, Unknown.PLACE])
    near = np.abs(means[:, Unknown.PLACE] - mean[Unknown.PLACE]) < JOINED * sigma
    near &= sigma < (1.0 + JOINED) * np.sqrt(covariance[Unknown.PLACE, Unknown.PLACE])
    kept = [
        k
        for k, name in enumerate(bank.without)
        if not weak[k]
        and (kind_of(name) is not SourceKind.SATELLITE or (name in remembered and (name in names or not near[k])))
    ]
    added = [name for name in names if name not in {bank.without[k] for k in kept}]
    # The filter itself is one without a source that it has not met.
    met = {clock_of(name) for name in remembered} | {bank.without[k] for k in np.flatnonzero(weak)}
    copies = [len(bank.without) > 0 and name not in met for name in added]
    weak_s = np.concatenate([bank.weak_s[kept], np.zeros(len(added))])
    fresh = begin(
        np.full(len(added), mean[Unknown.PLACE]),
        np.full(len(added), limits.expired_sigma_m),
        len(mean) - SATELLITES,
        line,
        limits,
    )
    for k, copy in enumerate(copies):
        if copy:
            fresh[0][k], fresh[1][k] = mean, covariance
        if added[k] == "map":
            fresh[1][k][[Unknown.MAP_RIGHT, Unknown.MAP_UP], [Unknown.MAP_RIGHT, Unknown.MAP_UP]] += (
                limits.level_map_m**2
            )
    means = np.concatenate([means[kept], fresh[0]])
    covariances = np.concatenate([covariances[kept], fresh[1]])
    without = (*(bank.without[k] for k in kept), *added)
    if not without:
        return Bank(without=without, mean=means, covariance=covariances, weak_s=weak_s)
    for unknown in np.flatnonzero(stepped):
        means[:, unknown] = mean[unknown]
        covariances[:, unknown, :] = covariances[:, :, unknown] = 0.0
        covariances[:, unknown, unknown] = covariance[unknown, unknown]
    means[:, Unknown.CODE_CLOCK] = mean[Unknown.CODE_CLOCK]
    own = rows_of(chunk, epoch, line, means, means[:, _PLACES], scale, _sensor_rows(rows, best, means - mean))
    use = np.stack([~_of(name, rows, satellite) for name in without])
    prior = prior_of(own, covariances)
    weight = first_weights(own, prior, limits.tails)
    update = robust_update(own, prior, weight, tails=limits.tails, passes=limits.level_passes, use=use)
    weak_s = np.where(_contradicted(rows, update.weight, use, limits), weak_s + dt, 0.0 if rows.bounds[0] else weak_s)
    means, covariances = applied(means, covariances, prior, update)
    means = on_the_line(means, covariances, line, limits)
    return Bank(without=without, mean=means, covariance=covariances, weak_s=weak_s)


def predict_bank(bank: Bank, line: Line, dt: float, limits: TrackingLimits, map_scale: float) -> tuple[Floats, Floats]:
    """Predict all sub-filters; that of the map lets it be wrong by `TrackingLimits.level_map_m`."""
    wrong = np.array([limits.level_map_m if name == "map" else 0.0 for name in bank.without])
    return predicted(bank.mean, bank.covariance, line, dt, limits, map_scale, map_sigma_m=wrong)


def _sensor_rows(rows: Rows, best: int, change: Floats) -> SensorRows | None:
    """Rows of the sensors about means that differ from that of the filter by `change`, shape (B, N)."""
    gnss, first = rows.bounds[2], rows.bounds[0] + 1 + MOTION
    if gnss == len(rows.variance):
        return None
    design = np.repeat(rows.combine[best : best + 1, first:], len(change), axis=0)
    value = rows.value[best, gnss:] - (design @ change[..., None])[..., 0]
    return SensorRows(design=design, value=value, variance=rows.variance[gnss:], kind=rows.kind[gnss:])


def _contradicted(rows: Rows, weight: Floats, use: Masks, limits: TrackingLimits) -> Masks:
    """Whether the mean weight of codes, or of Dopplers and phases, is that of a lost track, shape (B,)."""
    found = np.zeros(len(weight), dtype=np.bool_)
    for part, least in ((rows.codes, limits.lost_code_weight), (rows.motion, limits.lost_motion_weight)):
        count = use[:, part].sum(axis=1)
        found |= (count > 0) & (np.where(use[:, part], weight[:, part], 0.0).sum(axis=1) < least * count)
    return found


def _sources(rows: Rows, satellite: Strings, limits: TrackingLimits) -> list[str]:
    """Sources of an epoch that need a sub-filter: satellites, constellations of several, sensors."""
    of_satellite, of_constellation, of_sensor, of_motion, of_map = budget(limits).prior
    names = [str(name) for name in dict.fromkeys(satellite[: rows.bounds[2]].tolist())]
    letters = [letter for letter in CLOCKS if any(clock_of(name) == letter for name in satellite[rows.codes].tolist())]
    sensors = [name for kind, name in SENSORS.items() if (rows.kind == kind).any()]
    return [
        *(names if of_satellite else []),
        *(letters if of_constellation and len(letters) > 1 else []),
        *(sensors if of_sensor else []),
        *(("doppler",) if of_motion and rows.bounds[2] > rows.bounds[1] else ()),
        *(("phase",) if of_motion and rows.bounds[1] > rows.bounds[0] else ()),
        *(("map",) if of_map and rows.bounds[0] else ()),
    ]


def kind_of(name: str) -> SourceKind:
    """Kind of a source: `G12` is a satellite, `G` a constellation, `wheel` a sensor."""
    if name in CLOCKS:
        return SourceKind.CONSTELLATION
    if name in OTHERS:
        return SourceKind.MAP if name == "map" else SourceKind.MOTION
    return SourceKind.SENSOR if name in SENSORS.values() else SourceKind.SATELLITE


def clock_of(satellite: str) -> str:
    """Letter of the clock of a satellite's codes."""
    return "G" if satellite[:1] in ("J", "S") else satellite[:1]


def _of(name: str, rows: Rows, satellite: Strings) -> Masks:
    """Rows of a source; none of the map."""
    if name in OTHERS:
        kind = {"doppler": Kind.DOPPLER, "phase": Kind.PHASE, "map": -1}[name]
        return np.asarray(rows.kind == kind)
    if kind_of(name) is SourceKind.SENSOR:
        return np.asarray(rows.kind == next(kind for kind, text in SENSORS.items() if text == name))
    if kind_of(name) is SourceKind.CONSTELLATION:
        return np.array([clock_of(str(other)) == name for other in satellite], dtype=np.bool_)
    return np.asarray(satellite == name)


@dataclass(frozen=True, kw_only=True)
class Branches:
    """Hypotheses beside the most probable one, B of them.

    Attributes
    ----------
    probability : ndarray, shape (B,)
    apart_m, ground_m : ndarray, shape (B,) [m]
        Distance from its place along the line, and straight.
    sigma_m : ndarray, shape (B,) [m]
    """

    probability: Floats
    apart_m: Floats
    ground_m: Floats
    sigma_m: Floats


@dataclass(frozen=True, kw_only=True)
class Level:
    """Bound of the error of a place [m].

    Attributes
    ----------
    along_m : float
        Along the line; infinite where another place of the line is more probable than the risk.
    ground_m : float
        Of the straight distance, all branches included.
    noise_m : float
        Without faults and branches.
    separation_m : float
        Largest of a sub-filter.
    """

    along_m: float
    ground_m: float
    noise_m: float
    separation_m: float


def uncovered(branches: Branches, limits: TrackingLimits) -> bool:
    """Return whether another place of the line, further away than a bound may reach, is more probable than the risk."""
    far = branches.apart_m > limits.start_separation_m
    return bool(branches.probability[far].sum() > budget(limits).risk)


def compute_level(bank: Bank, branches: Branches, place_m: float, sigma_m: float, limits: TrackingLimits) -> Level:
    """Compute the level of a place.

    Infinite without a sub-filter, and where the measurements of one have contradicted it for longer than
    `TrackingLimits.level_doubt_s`: it has settled somewhere else, or began where the fault of its source had led the
    filter, and bounds nothing.

    Parameters
    ----------
    bank : Bank
    branches : Branches
    place_m, sigma_m : float [m]
        Of the filter.
    limits : TrackingLimits
    """
    given = budget(limits)
    noise, infinite = given.k * sigma_m, float("inf")
    if not bank.without:
        return Level(along_m=infinite, ground_m=infinite, noise_m=noise, separation_m=float("nan"))
    apart = np.abs(bank.mean[:, Unknown.PLACE] - place_m)
    sigma = np.sqrt(bank.covariance[:, Unknown.PLACE, Unknown.PLACE])
    which = [kind_of(name) for name in bank.without]
    prior, k = np.array(given.prior)[which], np.array(given.k_fault)[which]
    # From the largest that one hypothesis alone asks for: Newton's steps must not begin where a branch makes it flat.
    start = max(noise, float((apart + k * sigma).max()))
    of_branch = np.sqrt(2.0 * np.log(np.maximum(branches.probability / (2.0 * given.risk), 1.0))) * branches.sigma_m
    along = ground = infinite
    if not (bank.weak_s > limits.level_doubt_s).any():
        centre, spread, prior = np.append(apart, 0.0), np.append(sigma, sigma_m), np.append(prior, 1.0)

        def level(distance_m: Floats) -> float:
            return _solve_level(
                float(np.max(distance_m + of_branch, initial=start)),
                np.append(centre, distance_m),
                np.append(spread, branches.sigma_m),
                np.append(prior, branches.probability),
                given.risk,
            )

        ground = level(branches.ground_m) + _beside_m(bank)
        if not uncovered(branches, limits):
            near = branches.apart_m <= limits.start_separation_m
            along = level(np.where(near, branches.apart_m, 0.0))
    return Level(along_m=along, ground_m=ground, noise_m=noise, separation_m=float(apart.max()))


def _beside_m(bank: Bank) -> float:
    """Displacement of the map across beyond two standard deviations, by the sub-filter that lets it be wrong [m]."""
    if "map" not in bank.without:
        return 0.0
    k, right = bank.without.index("map"), Unknown.MAP_RIGHT
    return max(abs(float(bank.mean[k, right])) - 2.0 * float(np.sqrt(bank.covariance[k, right, right])), 0.0)


def _solve_level(start_m: float, centre: Floats, spread: Floats, prior: Floats, risk: float) -> float:
    """Level at which the hypotheses together have the risk: Newton's steps of its logarithm within a bracket."""
    level, low, high = start_m, 0.0, np.inf
    for _ in range(ROUNDS):
        spent = slope = 0.0
        for side in (-1.0, 1.0):
            away = (level + side * centre) / spread
            spent += float(prior @ ndtr(-away))
            slope += float(prior @ (np.exp(-0.5 * np.minimum(away**2, 1e3)) / spread)) / np.sqrt(2.0 * np.pi)
        low, high = (level, high) if spent > risk else (low, level)
        step = spent / slope * np.log(spent / risk) if spent > 0.0 and slope > 0.0 else -np.inf
        if not low <= level + step <= high:
            step = (0.5 * (low + high) if high < np.inf else 2.0 * level) - level
        level += step
        if abs(step) < PRECISION_M:
            break
    return level


def speed_bound_mps(bank: Bank, speed_mps: float, sigma_mps: float, limits: TrackingLimits) -> float:
    """Bound of the error of the speed [m/s]: what carries the level over the epochs until the next one.

    Parameters
    ----------
    bank : Bank
    speed_mps, sigma_mps : float [m/s]
        Of the filter.
    limits : TrackingLimits
    """
    given = budget(limits)
    k = np.array(given.k_speed_fault)[[kind_of(name) for name in bank.without]]
    apart = np.abs(bank.mean[:, Unknown.SPEED] - speed_mps)
    sigma = np.sqrt(bank.covariance[:, Unknown.SPEED, Unknown.SPEED])
    return float(np.max(apart + k * sigma, initial=given.k_speed * sigma_mps))
