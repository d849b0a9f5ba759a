"""Integrity risk of a protection level, and allocation of this risk to fault hypotheses.

The risk per hour (1e-7 in P1 2.4 and RTCA DO-229D) is divided by the number of independent samples in an hour. The risk
of a sample, minus the probability of faults that no hypothesis covers, is allocated to the hypotheses. A hypothesis is
a set of faults: shared faults (of a constellation, of the map, or of the low satellites on one side of the track) and
faults of single satellites. Hypotheses with equal shared faults and equal numbers of single satellites form a class.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from itertools import combinations, groupby
from math import prod
from operator import itemgetter
from types import MappingProxyType
from typing import Annotated, Final, Literal, NamedTuple, Self

import numpy as np
import scipy
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from railfix.core.arrays import Floats, Indices, Integers, Masks, channel_sums
from railfix.core.constants import SUPPORTED_SIDE_PRIOR
from railfix.core.settings import Settings
from railfix.integrity.raim import LinearModel

#: Probability that a satellite is faulty at a given time: 1e-5 for GPS (one-hour faults at a rate of 1e-5 per hour),
#: and 3e-5 for Galileo (EU-U.S. Working Group C, ARAIM Technical Subgroup, Milestone 3 report, and the later Galileo
#: service definition). Other constellations have the Galileo value, because they committed themselves later than GPS.
SATELLITE_PRIOR: Final[Mapping[str, float]] = MappingProxyType(
    {"G": 1e-5, "J": 3e-5, "E": 3e-5, "C": 3e-5, "R": 3e-5, "S": 3e-5, "I": 3e-5}
)
MOST_EXCLUDED: Final = 2  #: With more excluded satellites, the level is infinite (P1 2.3(4)).
MOST_TOGETHER: Final = 4  #: Largest number of faulty single satellites in a hypothesis.


def k_factor(risk: float) -> float:
    """Return the factor K for which a one-dimensional error exceeds K sigma, on either side, with probability `risk`.

    K is 5.33 for a risk of 1e-7. Raise ValueError if the risk is not in (0, 1].
    """
    if not 0.0 < risk <= 1.0:
        raise ValueError(f"a risk is a probability above 0, at most 1, got {risk}")
    return float(-scipy.special.ndtri(risk / 2.0))


def one_sided_k(probability: Floats) -> Floats:
    """Return the one-sided normal quantile of each probability; -inf for 1 and above, inf for 0 and below."""
    return np.asarray(-scipy.special.ndtri(np.clip(probability, 0.0, 1.0)))


Probability = Annotated[float, Field(ge=0, lt=1)]  #: Probability from 0 to below 1.


class RiskBudget(Settings):
    """Integrity risk, its allocation, and the probabilities of faults."""

    #: Probability per hour that the error exceeds the protection level without a warning; 1e-7 in P1 2.4.
    risk_per_hour: float = Field(default=1e-7, gt=0, lt=1)
    #: Number of independent samples in an hour: 3600 s divided by the correlation time of the errors. The default
    #: assumes a correlation time of 10 s. Multipath changes within seconds on a moving train and within tens of seconds
    #: at standstill, SBAS corrections within minutes (DO-229D appendix J: 10 samples per hour). A larger number is
    #: conservative: the fault-free K for 3600 samples is 0.9 larger than for 10 samples.
    samples_per_hour: float = Field(default=360.0, gt=0, allow_inf_nan=False)
    #: Fractions of an epoch's risk for no, one and two faults; their sum is at most 1. A level is computed for each.
    #: The largest level is lowered until the sum of all tail probabilities equals the sum of the three risks. Doubling
    #: a fraction lowers a K of 6 by only 0.1 and a K of 3 by only 0.2, so the defaults are equal.
    fault_free_share: float = Field(default=1.0 / 3.0, gt=0)
    one_fault_share: float = Field(default=1.0 / 3.0, gt=0)
    two_fault_share: float = Field(default=1.0 / 3.0, gt=0)
    #: Fraction of the risk for faults that no hypothesis covers. If these faults are more probable, more faults become
    #: hypotheses, with up to four satellites and three shared faults (constellation, side, map) at the same time.
    unchecked_share: float = Field(default=0.3, gt=0, lt=1)
    #: Fraction of the risk for epochs with one excluded satellite; the fraction for epochs with two is equal.
    exclusion_share: float = Field(default=0.1, ge=0, lt=0.5)
    #: Probability per epoch that noise alone makes the solution separations exceed their thresholds; 1e-3 in P4.
    false_alarm: float = Field(default=1e-3, gt=0, lt=1)
    #: Probability that a satellite is faulty at a given time, for each constellation.
    satellite_prior: dict[str, Probability] = Field(default_factory=lambda: dict(SATELLITE_PRIOR))
    #: Additional probability that a satellite's signal has a local fault (multipath, interference). The default is an
    #: assumption until the probability is measured on the line (P1 7).
    local_prior: float = Field(default=1e-5, ge=0, lt=1)
    #: Probability that the map is wrong by more than its stated error, for example because of a parallel track, heights
    #: without the geoid, or a different reference frame. The default is an assumption. With 0, a wrong map is no
    #: hypothesis.
    map_prior: float = Field(default=1e-4, ge=0, lt=1)
    #: Probability that the low satellites on one side of the track are faulty together. No data support a value below
    #: the default, so every output of protection levels reports a smaller setting. With 0, a faulty side is no
    #: hypothesis.
    side_prior: float = Field(default=SUPPORTED_SIDE_PRIOR, ge=0, lt=1)
    #: Elevation up to which satellites count as low. A wall whose distance equals its height reaches 45 deg.
    side_elevation_deg: float = Field(default=45.0, gt=0, le=90.0)
    #: Sets of satellites that may be faulty together. With "beside", there are two sets: the low satellites left and
    #: right of the track. With "all", as in the filter, the satellites ahead and behind are two more sets. Levels are
    #: up to three times as large, because single-epoch geometry along the track is weak without one set's satellites.
    late_sides: Literal["beside", "all"] = "beside"
    #: Whether the priors were measured on this line (``railfix error-model``). If they are assumed, every output calls
    #: the levels indicative, and no hourly risk is claimed. "measured" requires `local_prior` and `side_prior`.
    priors: Literal["assumed", "measured"] = "assumed"
    #: Probability of a fault common to many satellites, for each constellation. For constellations without a value, the
    #: level does not cover such faults.
    constellation_prior: dict[str, Probability] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _shares_up_to_one(self) -> Self:
        shares = (self.fault_free_share, self.one_fault_share, self.two_fault_share)
        if sum(shares) > 1.0 + 1e-12:
            raise ValueError(f"the sum of the three fractions must not exceed 1, got {shares}")
        return self

    @model_validator(mode="after")
    def _check_measured_priors(self) -> Self:
        missing = [name for name in ("local_prior", "side_prior") if name not in self.model_fields_set]
        if self.priors == "measured" and missing:
            raise ValueError(
                f'priors = "measured" requires {" and ".join(missing)}: set what railfix error-model prints, '
                'or set priors = "assumed" (levels are then called indicative)'
            )
        return self

    @property
    def risk_per_sample(self) -> float:
        """Integrity risk of a sample, including the parts for exclusions and unchecked faults."""
        return self.risk_per_hour / self.samples_per_hour

    @property
    def sample_k(self) -> float:
        """Two-sided factor K of a level without fault hypotheses, to which the whole risk of a sample is allocated."""
        return k_factor(self.risk_per_sample)

    def prior(self, systems: Sequence[str]) -> Floats:
        """Return the fault probability of each channel: the sum of satellite and local prior, shape (M,).

        Raise ValueError if a constellation has no satellite prior.
        """
        unknown = sorted(set(systems) - set(self.satellite_prior))
        if unknown:
            raise ValueError(f"satellite_prior has no value for constellation {unknown[0]!r}: add one")
        return np.array([self.satellite_prior[s] + self.local_prior for s in systems], dtype=np.float64)

    def sample_risk(self, n_used: ArrayLike, n_excluded: ArrayLike, beyond: ArrayLike = 0.0) -> Floats:
        """Return the part of each epoch's integrity risk for the satellites that remain after exclusions.

        `beyond` is the probability of unchecked faults, which is first subtracted from the risk. Any e satellites could
        have been excluded, so the risk for e exclusions is divided by the number of sets of e satellites. The result is
        0 for more than `MOST_EXCLUDED` exclusions, and where `beyond` exceeds the risk.
        """
        used, out = np.asarray(n_used, dtype=np.float64), np.asarray(n_excluded, dtype=np.int64)
        if (out < 0).any():
            raise ValueError("n_excluded must not be negative")
        each = [
            np.full(used.shape, 1.0 - 2.0 * self.exclusion_share),
            self.exclusion_share / (used + 1.0),
            self.exclusion_share / ((used + 2.0) * (used + 1.0) / 2.0),
        ]
        left = np.maximum(self.risk_per_sample - np.asarray(beyond, dtype=np.float64), 0.0)
        return np.asarray(left * np.select([out == e for e in range(len(each))], each, 0.0))


def set_sums(prior: Floats, most: int) -> Floats:
    """Return the probabilities of sets of k = 0 to `most` faults, shape (T, most + 1).

    `prior` has the shape (T, M). Column k is the sum, over all sets of k faults, of the product of their priors; it
    bounds the probability of k or more faults. The sums are computed by Newton's identities.
    """
    power, powers = prior, []
    for _ in range(most):
        powers.append(channel_sums(power))
        power = power * prior
    sums = [np.ones(len(prior))]
    for size in range(1, most + 1):
        total = sum((-1.0) ** j * sums[size - 1 - j] * powers[j] for j in range(size))
        sums.append(np.maximum(total / size, 0.0))
    return np.stack(sums, axis=1)


#: Largest number of shared faults in a hypothesis. The probability of more shared faults is subtracted from the risk.
_MOST_SHARED: Final = 3
FEW: Final = 2  #: Allocations of at most this number of epochs are cached. A live chunk has one epoch per antenna.
REMEMBERED: Final = 512  #: Number of cached allocations. They are used again when obstructed satellites reappear.
_MOST_SETS: Final = 46_376  #: Largest number of hypotheses in a class: all sets of four of 34 satellites.


class Shared(NamedTuple):
    """Simultaneous shared faults."""

    events: tuple[int, ...]  # indices of constellations, then of sides
    wrong_map: bool
    kind: int  # number of faults; two sides count as one fault

    @property
    def size(self) -> int:
        """Number of shared faults, including the map fault."""
        return len(self.events) + self.wrong_map


@dataclass(frozen=True, eq=False)
class Allocation:
    """Allocation of the risk of T epochs; compared by identity."""

    prior: Floats  # (T, M) fault probability of each channel, 0 for unused channels
    groups: tuple[str, ...]  # letters of the C constellations with a `constellation_prior`
    shared: tuple[Shared, ...]  # B sets of shared faults, of which the first is empty
    members: Masks  # (T, B, M) satellites affected by each set of shared faults
    shared_prior: Floats  # (T, B) probability of each set of shared faults; 0 if too few of its satellites are used
    order: Indices  # (T, B) largest number of faulty satellites in addition to each set; -1 if the set is no hypothesis
    beyond: Floats  # (T,) probability of the classes without a hypothesis
    fault_free: Floats  # (T,) risk allocated to the fault-free case
    one: Floats  # (T,) risk allocated to one fault
    two: Floats  # (T,) risk allocated to two faults
    more: Floats  # (T,) risk allocated to three or more faults; 0 where no such hypothesis exists
    reserved: Floats  # (T,) probability of two faulty satellites; 0 where pairs are hypotheses
    k_false_alarm: Floats  # (T,) factor K of the thresholds


def allocate(
    model: LinearModel, systems: Sequence[str], risk: RiskBudget, out: Integers, sides: Masks, *, wrong_map: bool
) -> Allocation:
    """Choose the fault hypotheses of each epoch and divide the risk among them.

    Faults of one satellite, a side, a constellation or the map are hypotheses wherever their prior is positive. So is a
    constellation or map fault together with a faulty satellite. Pairs of satellites are hypotheses where their
    probability exceeds the risk allocated to two faults. The most probable other classes are added until the remaining
    classes are within the risk for unchecked faults. `out`, shape (T,), is the number of excluded satellites. `sides`,
    shape (T, S, M), are the sets of satellites that may be faulty together.
    """
    used = model.used
    sides = sides & used[:, None]
    if len(used) <= FEW:  # live epochs mostly repeat the satellites of the previous epoch
        given = (used.tobytes(), out.tobytes(), sides.tobytes())
        return _of_few_epochs(_Same(risk), tuple(systems), *given, sides.shape[1], wrong_map)
    # Many epochs of a chunk have equal satellites, so the allocation is computed once per set of satellites.
    bits = np.packbits(np.concatenate([used, sides.reshape(len(used), -1)], axis=1), axis=1)
    keys = np.concatenate([bits, np.ascontiguousarray(out)[:, None].view(np.uint8)], axis=1)
    _, first, which = np.unique(keys.view(f"V{keys.shape[1]}")[:, 0], return_index=True, return_inverse=True)
    plan = _allocate(used[first], systems, risk, out[first], sides[first], wrong_map=wrong_map)
    of_epochs = (f.name for f in fields(plan) if f.name not in ("groups", "shared"))
    return replace(plan, **{name: getattr(plan, name)[which] for name in of_epochs})


class _Same:
    """Risk budget compared by identity, so that a cache does not hash its contents."""

    def __init__(self, risk: RiskBudget) -> None:
        self.risk = risk

    def __hash__(self) -> int:
        return id(self.risk)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.risk is self.risk


@lru_cache(maxsize=REMEMBERED)
def _of_few_epochs(
    risk: _Same, systems: tuple[str, ...], used: bytes, out: bytes, sides: bytes, count: int, wrong_map: bool
) -> Allocation:
    """Return the cached allocation of at most `FEW` epochs. Callers must not change its arrays."""
    channels, excluded = len(systems), np.frombuffer(out, dtype=np.int64).copy()
    return _allocate(
        np.frombuffer(used, dtype=bool).reshape(len(excluded), channels).copy(), systems, risk.risk, excluded,
        np.frombuffer(sides, dtype=bool).reshape(len(excluded), count, channels).copy(), wrong_map=wrong_map,
    )  # fmt: skip


def _allocate(
    used: Masks, systems: Sequence[str], risk: RiskBudget, out: Integers, sides: Masks, *, wrong_map: bool
) -> Allocation:
    of_channel = risk.prior(systems)
    prior = used * of_channel
    # Excluded satellites may be faulty, too; each is given the largest prior of all channels.
    everyone = np.concatenate([prior, (np.arange(MOST_EXCLUDED) < out[:, None]) * of_channel.max(initial=0.0)], axis=1)
    letters = [s for s in dict.fromkeys(systems) if risk.constellation_prior.get(s, 0.0) > 0.0]
    of_letter = np.array([[t == s for t in systems] for s in letters], dtype=bool).reshape(len(letters), len(systems))
    members = np.concatenate([used[:, None] & of_letter, sides], axis=1)
    # A constellation fault requires at least one used satellite, a fault of a side at least two.
    nominal = np.array([risk.constellation_prior[s] for s in letters] + [risk.side_prior] * sides.shape[1])
    least = np.array([1] * len(letters) + [2] * sides.shape[1])
    event_prior = nominal * ((members & used[:, None]).sum(axis=2) >= least)
    events = event_prior.any(axis=0).nonzero()[0].tolist()
    of_map = risk.map_prior if wrong_map else 0.0
    shared, within = _fault_sets(tuple(events), len(letters), wrong_map=of_map > 0.0)
    each = np.stack([event_prior[:, s.events].prod(axis=1) * (of_map if s.wrong_map else 1.0) for s in shared], axis=1)
    likely = [prod(nominal[[*s.events]].tolist()) * (of_map if s.wrong_map else 1.0) for s in shared]
    further = np.zeros(len(used))
    if len(events) + wrong_map > _MOST_SHARED:
        of_each = np.concatenate([event_prior, np.full((len(used), 1), of_map)], axis=1)
        further = set_sums(of_each, _MOST_SHARED + 1)[:, -1]
    n = used.sum(axis=1)
    always = [2] + [-1 if s.size > 1 else int(s.wrong_map or s.events[0] < len(letters)) for s in shared[1:]]
    classes = _Classes(each, within, set_sums(everyone, MOST_TOGETHER + 1), further, always)
    order = classes.choose(
        risk.unchecked_share * risk.risk_per_sample, likely, float(of_channel.mean()) if len(of_channel) else 0.0, n
    )
    beyond = classes.rest(order)
    left = risk.sample_risk(n, out, beyond)
    # Hypotheses of three or more faults, if there are any, take a quarter of the risk of each other part.
    more = (order + [s.kind for s in shared] >= 3).any(axis=1, where=order >= 0)
    left = np.where(more, 0.75, 1.0) * left
    parts = [s * left for s in (risk.fault_free_share, risk.one_fault_share, risk.two_fault_share)]
    of_pairs = set_sums(prior, 2)[:, 2]
    pairs = (of_pairs > parts[2]) | (order[:, 0] > 2)
    order[:, 0] = np.where(pairs, order[:, 0], 1)
    mapped = np.array([s.wrong_map for s in shared])
    sizes = np.cumsum(scipy.special.comb(n[:, None], np.arange(MOST_TOGETHER + 1)), axis=1)
    sizes = np.concatenate([sizes, np.zeros((len(n), 1))], axis=1)
    tests = np.where(mapped, 0.0, np.take_along_axis(sizes, order, axis=1)).sum(axis=1) - 1.0
    asked = [0, *(b for b in range(1, len(shared)) if (order[:, b] >= 0).any())]
    return Allocation(
        prior=prior, groups=tuple(letters), shared=tuple(shared[b] for b in asked),
        members=np.stack([members[:, shared[b].events].any(axis=1) for b in asked], axis=1),
        shared_prior=each[:, asked], order=order[:, asked], beyond=beyond, fault_free=parts[0], one=parts[1],
        two=parts[2], more=np.where(more, sum(parts) / 3.0, 0.0), reserved=np.where(pairs, 0.0, of_pairs),
        k_false_alarm=one_sided_k(risk.false_alarm / (2.0 * np.maximum(tests, 1.0))),
    )  # fmt: skip


@lru_cache(maxsize=64)
def _fault_sets(events: tuple[int, ...], constellations: int, *, wrong_map: bool) -> tuple[tuple[Shared, ...], Masks]:
    """Return the B sets of up to three shared faults, sorted by number of faults, and `_Classes.within`."""
    sets = []
    for size in range(_MOST_SHARED + 1):
        for some in combinations([*events, -1] if wrong_map else events, size):
            own = tuple(e for e in some if e >= 0)
            together = max(sum(e >= constellations for e in own) - 1, 0)
            sets.append(Shared(own, -1 in some, size - together))
    sets.sort(key=lambda s: (s.kind, s.size > 1))
    faults = [{*s.events, *([-1] if s.wrong_map else [])} for s in sets]
    within = [[part < whole and len(part) + 1 == len(whole) for part in faults] for whole in faults]
    return tuple(sets), np.array(within)


@dataclass(frozen=True)
class _Classes:
    """Hypothesis classes of T epochs: B sets of shared faults, each with 0 to `MOST_TOGETHER` single satellites."""

    each: Floats  # (T, B) prior of each set of shared faults
    within: Masks  # (B, B) true where the column's set is the row's set without one of its faults
    sums: Floats  # (T, MOST_TOGETHER + 2) `set_sums` of the satellite priors
    further: Floats  # (T,) probability of more than `_MOST_SHARED` shared faults
    least: Sequence[int]  # length B, smallest allowed value of `Allocation.order`

    def _take(self, rows: Indices) -> _Classes:
        return replace(self, each=self.each[rows], sums=self.sums[rows], further=self.further[rows])

    def rest(self, order: Indices) -> Floats:
        """Return the probability of faults that no hypothesis covers, shape (T,).

        The probability of a set of shared faults without a hypothesis already includes all supersets of the set.
        """
        whole = (order < 0) & (self.each > 0.0)
        covered = whole.astype(np.float64) @ self.within.T > 0.0
        each = np.where(covered, 0.0, self.each * np.take_along_axis(self.sums, order + 1, axis=1))
        return np.asarray(each.sum(axis=1) + self.further)

    def choose(self, share: float, likely: Sequence[float], satellite: float, used: Integers) -> Indices:
        """Return `Allocation.order`, shape (T, B): the largest number of satellites left out with each set of shared
        faults.

        The most probable classes are chosen first, until the total probability of the other classes is at most `share`.
        `likely`, length B, are the nominal priors of the sets of shared faults. `satellite` is the mean prior of a
        satellite.
        """
        sizes = np.arange(MOST_TOGETHER + 1)
        feasible = scipy.special.comb(used[:, None], sizes) <= _MOST_SETS
        alone = (self.each[..., None] * self.sums[:, None, :-1] > share) & feasible[:, None]
        order = np.maximum(np.max(np.where(alone, sizes, -1), axis=2), self.least)
        order = np.where(self.each > 0.0, order, -1)
        rows = (self.rest(order) > share).nonzero()[0]
        if not len(rows):
            return np.asarray(order, dtype=np.intp)
        classes = [(-likely[b] * satellite**k, k, b) for b in range(len(likely)) for k in sizes.tolist()]
        for (_, k), alike in groupby(sorted(classes), key=itemgetter(0, 1)):
            if not len(rows):
                break
            which = [b for _, _, b in alike]
            here = (order[rows][:, which] == k - 1) & (self.each[rows][:, which] > 0.0) & feasible[rows, k, None]
            if here.any():
                order[rows[:, None], which] += here
                rows = rows[self._take(rows).rest(order[rows]) > share]
        return np.asarray(order, dtype=np.intp)
