"""Integrity risk of a protection level, and its allocation to fault hypotheses.

Integrity is specified per hour, a level is computed per epoch: the risk of the hour is divided
by the number of independent samples in it. The risk of an epoch is divided among the hypotheses:
no fault, one, two, and more where these are likely; the whole probability of the rest is taken off beforehand.
P1 2.4 sets out from 1e-7 an hour (RTCA DO-229D).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Annotated, Final, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator
from scipy.special import ndtri

from railfix.core.arrays import Floats
from railfix.core.settings import Settings

#: RTCA DO-229D appendix J, horizontal, precision approach: one dimension, 2e-9 an approach.
K_H_PA: Final = 6.0
#: RTCA DO-229D appendix J, horizontal, en route to non-precision approach: two dimensions (Rayleigh), 5e-9 a sample.
K_H_NPA: Final = 6.18
#: RTCA DO-229D appendix J, vertical: one dimension, two-sided 1e-7.
K_V: Final = 5.33

#: Probability that a satellite is faulty at a time: 1e-5 an hour for an hour for GPS, 3e-5 for Galileo (EU-U.S.
#: Working Group C, ARAIM Technical Subgroup, Milestone 3 report, and the Galileo service definition after it); the
#: others as Galileo, for want of a commitment that is as old.
SATELLITE_PRIOR: Final[Mapping[str, float]] = MappingProxyType(
    {"G": 1e-5, "J": 3e-5, "E": 3e-5, "C": 3e-5, "R": 3e-5, "S": 3e-5, "I": 3e-5}
)
#: Prior of one reflection off a side of the track that the largest data set supports: 2 of 30 943 blocks of 30 s of 70
#: simulated hours in a city, 95 % (docs/integrity-campaign.md); recordings, which are shorter, support 1e-2.
SUPPORTED_SIDE_PRIOR: Final = 1.3e-5
#: Exclusions after which a level is still given (P1 2.3(4) excludes up to two satellites).
MOST_EXCLUDED: Final = 2
#: Faulty satellites at a time that can be hypotheses of a level.
MOST_TOGETHER: Final = 4


def k_factor(risk: float) -> float:
    """Sigmas that an error in one dimension exceeds, on either side, with this probability.

    Two-sided, along a line: 1e-7 gives 5.33, 1e-8 gives 5.73. Not the Rayleigh factor of a
    horizontal position.

    Parameters
    ----------
    risk : float
        Of one sample, both sides together.
    """
    if not 0.0 < risk <= 1.0:
        raise ValueError(f"a risk is a probability above 0, at most 1, got {risk}")
    return float(-ndtri(risk / 2.0))


def one_sided_k(probability: Floats) -> Floats:
    """Sigmas that noise exceeds on one side with this probability; -inf from 1 on, inf at 0 and below."""
    return np.asarray(-ndtri(np.clip(probability, 0.0, 1.0)))


#: A probability below 1.
Probability = Annotated[float, Field(ge=0, lt=1)]


class RiskBudget(Settings):
    """Integrity risk, its shares, and the probabilities of faults."""

    #: Probability that the error exceeds the level without a warning; P1 2.4: 1e-7 an hour.
    risk_per_hour: float = Field(default=1e-7, gt=0, lt=1)
    #: Independent samples in an hour: 3600 s over the correlation time of the errors. 360 takes 10 s: multipath of a
    #: moving train changes within seconds, that of a standing one within tens of seconds, SBAS corrections within
    #: minutes (DO-229D appendix J counts 10 samples an hour). More samples are the safe side; from 10 to 3600 the
    #: fault-free K grows by 0.9.
    samples_per_hour: float = Field(default=360.0, gt=0, allow_inf_nan=False)
    #: Shares of the risk of an epoch; together at most 1. They decide the three parts, from the largest of which the
    #: level is lowered until all tails together use their sum; a share twice as large lowers a K of 6 by 0.1, one of 3
    #: by 0.2: thirds.
    fault_free_share: float = Field(default=1.0 / 3.0, gt=0)
    one_fault_share: float = Field(default=1.0 / 3.0, gt=0)
    two_fault_share: float = Field(default=1.0 / 3.0, gt=0)
    #: Of the risk, for faults that are not hypotheses: where they are likelier, further ones become hypotheses, up to
    #: four satellites at a time and three shared faults (constellation, side, map).
    unchecked_share: float = Field(default=0.3, gt=0, lt=1)
    #: Of the risk, for epochs with one, and as much again with two satellites excluded.
    exclusion_share: float = Field(default=0.1, ge=0, lt=0.5)
    #: Probability in an epoch that noise alone makes the separations inconsistent; P4: 1e-3.
    false_alarm: float = Field(default=1e-3, gt=0, lt=1)
    #: Probability that a satellite is faulty, by constellation: its own signal.
    satellite_prior: dict[str, Probability] = Field(default_factory=lambda: dict(SATELLITE_PRIOR))
    #: The same of a fault by local causes, on top of that: multipath, interference. An assumption until measured on the
    #: line (P1 7).
    local_prior: float = Field(default=1e-5, ge=0, lt=1)
    #: Probability that the map is wrong by more than its stated error: the next track, heights without the geoid,
    #: another reference frame. An assumption; 0: no such hypothesis.
    map_prior: float = Field(default=1e-4, ge=0, lt=1)
    #: Probability that low satellites of one side of the track are faulty together: `SUPPORTED_SIDE_PRIOR`. No data
    #: supports a smaller one, and every output of the levels then says so; 0: no such hypothesis.
    side_prior: float = Field(default=SUPPORTED_SIDE_PRIOR, ge=0, lt=1)
    #: Elevation up to which satellites count as low: of a wall as high as it is away.
    side_elevation_deg: float = Field(default=45.0, gt=0, le=90.0)
    #: Whether the priors were measured on this line (``railfix error-model``). Levels of assumed priors are called
    #: indicative in every output: they carry no risk an hour. "measured" needs `local_prior` and `side_prior` to be
    #: given.
    priors: Literal["assumed", "measured"] = "assumed"
    #: Probability of a fault that many satellites of a constellation share; a constellation that is not named has none,
    #: and the level does not cover one.
    constellation_prior: dict[str, Probability] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _shares_up_to_one(self) -> Self:
        shares = (self.fault_free_share, self.one_fault_share, self.two_fault_share)
        if sum(shares) > 1.0 + 1e-12:
            raise ValueError(f"the three shares must add up to 1 at most, got {shares}")
        return self

    @model_validator(mode="after")
    def _measured_priors_are_given(self) -> Self:
        missing = [name for name in ("local_prior", "side_prior") if name not in self.model_fields_set]
        if self.priors == "measured" and missing:
            raise ValueError(
                f"priors are measured, but {' and '.join(missing)} not given: state what railfix error-model prints, "
                "or leave priors assumed (levels are called indicative)"
            )
        return self

    @property
    def risk_per_sample(self) -> float:
        """Risk of an epoch, exclusions and unchecked faults included."""
        return self.risk_per_hour / self.samples_per_hour

    @property
    def sample_k(self) -> float:
        """K of a level without fault hypotheses: the whole risk of a sample, two-sided."""
        return k_factor(self.risk_per_sample)

    def prior(self, systems: Sequence[str]) -> Floats:
        """Fault probability of each channel, shape (M,): of the satellite and of what is around the antenna.

        Raises
        ------
        ValueError
            Where a constellation has no prior.
        """
        unknown = sorted(set(systems) - set(self.satellite_prior))
        if unknown:
            raise ValueError(f"satellite_prior has no value for constellation {unknown[0]!r}: add one")
        return np.array([self.satellite_prior[s] + self.local_prior for s in systems], dtype=np.float64)

    def sample_risk(self, n_used: ArrayLike, n_excluded: ArrayLike, beyond: ArrayLike = 0.0) -> Floats:
        """Return the risk of an epoch in the set that is left after exclusions, any shape.

        More faults than are checked are taken off once. Every set that exclusion could have left is a way
        to fail, so the share of the risk for e exclusions is divided by the number of sets of e among all
        satellites. 0 beyond `MOST_EXCLUDED`, and where nothing is left.

        Parameters
        ----------
        n_used : array_like of int
            Satellites left.
        n_excluded : array_like of int
            Satellites that fault detection took out.
        beyond : array_like
            Probability of more faults than are checked, among all satellites.
        """
        used, out = np.asarray(n_used, dtype=np.float64), np.asarray(n_excluded, dtype=np.int64)
        if (out < 0).any():
            raise ValueError("n_excluded is a count, got a negative one")
        each = [
            np.full(used.shape, 1.0 - 2.0 * self.exclusion_share),
            self.exclusion_share / (used + 1.0),
            self.exclusion_share / ((used + 2.0) * (used + 1.0) / 2.0),
        ]
        left = np.maximum(self.risk_per_sample - np.asarray(beyond, dtype=np.float64), 0.0)
        return np.asarray(left * np.select([out == e for e in range(len(each))], each, 0.0))


def pair_sum(prior: Floats) -> Floats:
    """Sum over pairs of the product of their priors, shape (T, M) to (T,)."""
    return set_sums(prior, 2)[:, 2]


def set_sums(prior: Floats, most: int) -> Floats:
    """Sums over sets of 0, 1, ..., `most` faults of the product of their priors, shape (T, M) to (T, most + 1).

    Bounds of the probability of as many faults or more (Newton's identities).
    """
    power, powers = prior, []
    for _ in range(most):
        powers.append(power.sum(axis=1))
        power = power * prior
    sums = [np.ones(len(prior))]
    for size in range(1, most + 1):
        total = sum((-1.0) ** j * sums[size - 1 - j] * powers[j] for j in range(size))
        sums.append(np.maximum(total / size, 0.0))
    return np.stack(sums, axis=1)
