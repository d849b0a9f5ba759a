"""ARAIM: multiple-hypothesis solution separation with an integrity support message, along the track and in 3-D.

The EU-U.S. Working Group C published the algorithm (milestone 3 report, annex A; ADD 3.0). For each fault mode k, the
position is computed without the satellites of the mode. The gain matrix is `S_k = (G' W_k G)^-1 G' W_k`, with weights W
from the integrity sigmas. For the position component q,

- the variance is `sigma_k^2 = [(G' W_k G)^-1]_qq`, and the bias is `b_k = sum_i |S_k,qi| b_i`;
- the threshold is `T_k = K_fa sqrt(sum_i (S_k,qi - S_0,qi)^2 sigma_acc,i^2)` with the accuracy sigmas;
- the level L satisfies
  `2 Q((L - b_0) / sigma_0) + sum_k p_k Q((L - T_k - b_k) / sigma_k) = PHMI_q (1 - P_unmonitored / PHMI)`.

A map adds two observations (Wenz 2024), the lateral and the vertical offset from the track, with the map sigmas. If the
map is wrong, both observations are faulty. With a map, the component q is the position along the track.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final, NamedTuple, Protocol

import numpy as np
import scipy
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, Integers, Masks, join_rows
from railfix.core.notebook import NotebookTable
from railfix.core.settings import Settings
from railfix.integrity.protection.risk import one_sided_k, set_sums

#: Number of bisections for a level. They reduce an interval of 1e4 m to less than 0.1 micrometres.
_HALVINGS: Final = 48
_LONGEST_M: Final = 1e4
_BLOCK_SIZE: Final = 4_000_000  #: Largest number of array elements in a block of epochs.
#: A matrix is singular if its determinant is below this fraction of the product of its diagonal.
_SINGULAR: Final = 1e-12


class AraimBudget(Settings):
    """Allocation of integrity and continuity risk.

    The defaults are the LPV-200 values of ADD 3.0. Along the track, the vertical values are used.
    """

    #: Probability of hazardously misleading information per approach or sample, for each position component.
    phmi_along: float = Field(default=9.8e-8, gt=0, lt=1)
    phmi_vertical: float = Field(default=9.8e-8, gt=0, lt=1)
    phmi_horizontal: float = Field(default=2e-9, gt=0, lt=1)
    #: Probability that noise alone makes the solution separations exceed their thresholds, for each component.
    false_alarm_along: float = Field(default=3.9e-6, gt=0, lt=1)
    false_alarm_vertical: float = Field(default=3.9e-6, gt=0, lt=1)
    false_alarm_horizontal: float = Field(default=9e-8, gt=0, lt=1)
    #: Largest total probability of faults that no mode covers. The number of simultaneous faults in a mode is
    #: increased, up to `most_faults`, until this limit is met.
    unmonitored: float = Field(default=8e-8, gt=0, lt=1)
    most_faults: int = Field(default=2, ge=1, le=3)  #: Largest number of simultaneous faults in a mode.
    map_prior: float = Field(default=1e-4, ge=0, lt=1)  #: Prior probability of a wrong map; 0 omits this mode.


@dataclass(frozen=True, kw_only=True)
class AraimGeometry:
    """N observations at each of T epochs: ranges and, with a map, two map constraints."""

    #: Partial derivatives of each observation with respect to the P unknowns (position, then one clock per
    #: constellation), shape (T, N, P). Values of unused observations are ignored.
    design: Floats
    sigma_int_m: Floats  #: Integrity standard deviations, shape (T, N); NaN for unused observations.
    sigma_acc_m: Floats  #: Accuracy standard deviations, shape (T, N); NaN for unused observations.
    bias_m: Floats  #: Largest nominal bias of each observation, shape (T, N).
    prior: Floats  #: Prior probability of a fault of each single observation, shape (N,).
    together: Masks  #: True for observations that each constellation or map fault affects, shape (C, N).
    together_prior: Floats  #: Prior probability of each constellation or map fault, shape (C,).

    @property
    def used(self) -> Masks:
        """True for observations that have both standard deviations, shape (T, N)."""
        return np.asarray(np.isfinite(self.sigma_int_m) & np.isfinite(self.sigma_acc_m))


@dataclass(frozen=True, kw_only=True)
class AraimLevels:
    """Protection levels of T epochs for Q position components."""

    #: Protection levels, shape (T, Q); NaN without a position. A level is infinite if it would exceed 10 km or if the
    #: probability of unmonitored faults exceeds the risk.
    level_m: Floats
    sigma_int_m: Floats  #: Integrity standard deviations of the position from all observations, shape (T, Q).
    #: Standard deviations, for accuracy, of the position that is computed from all observations; shape (T, Q).
    sigma_acc_m: Floats
    modes: Integers  #: Number of fault modes, shape (T,).
    unmonitored: Floats  #: Probability of faults that no mode covers or that prevent a position, shape (T,).


@dataclass(frozen=True, kw_only=True, repr=False)
class AraimResult(NotebookTable):
    """ARAIM protection levels of T epochs; NaN where there is no position."""

    along: AraimLevels  #: Level along the track, with the map as a constraint.
    space: AraimLevels  #: Levels to the east, to the north and upwards, without the map.

    @property
    def horizontal_m(self) -> Floats:
        """Horizontal protection level of the 3-D position, shape (T,) [m]."""
        return np.asarray(np.hypot(self.space.level_m[:, 0], self.space.level_m[:, 1]))


def araim_levels(
    geometry: AraimGeometry, phmi: Sequence[float], false_alarm: Sequence[float], budget: AraimBudget
) -> AraimLevels:
    """Compute the protection levels of the first Q unknowns; `phmi` and `false_alarm` have Q values each."""
    epochs, count = geometry.sigma_int_m.shape
    events = np.concatenate([np.eye(count, dtype=bool), geometry.together])  # single faults, then common faults; (E, N)
    sets = [list(s) for size in range(1, budget.most_faults + 1) for s in combinations(range(len(events)), size)]
    masks = np.array([events[s].any(axis=0) for s in sets], dtype=bool).reshape(len(sets), count)
    size = np.array([len(s) for s in sets])
    block = max(1, _BLOCK_SIZE // max(1, (len(sets) + 1) * count * geometry.design.shape[2]))
    parts = []
    for first in range(0, max(epochs, 1), block):
        rows = slice(first, first + block)
        parts.append(_block(geometry, rows, sets, masks, size, np.array([phmi, false_alarm]), budget))
    return join_rows(parts)


def _block(
    geometry: AraimGeometry,
    rows: slice,
    sets: list[list[int]],
    masks: Masks,
    size: Integers,
    risks: Floats,
    budget: AraimBudget,
) -> AraimLevels:
    """Compute the levels of a block of epochs."""
    used = geometry.used[rows]
    design = np.where(used[..., None], geometry.design[rows], 0.0)
    components = risks.shape[1]
    prior = _event_priors(geometry, used)
    probability = np.stack([prior[:, s].prod(axis=1) for s in sets], axis=1) if sets else np.zeros((len(used), 0))
    order, beyond = _order(prior, budget)
    probability = np.where(size[None, :] <= order[:, None], probability, 0.0)
    out = np.concatenate([np.zeros((1, masks.shape[1]), dtype=bool), masks])
    kept = used[:, None, :] & ~out
    weight = np.where(kept, 1.0 / np.where(used, geometry.sigma_int_m[rows], 1.0)[:, None] ** 2, 0.0)
    gain, sigma = _gains(design, weight, components)
    acc = np.where(used, geometry.sigma_acc_m[rows], 0.0)[:, None, None]
    bias = (np.abs(gain) * np.where(used, geometry.bias_m[rows], 0.0)[:, None, None]).sum(axis=3)
    apart = np.sqrt(((gain - gain[:, :1]) ** 2 * acc**2).sum(axis=3))
    lost = np.asarray(~np.isfinite(sigma[:, 1:]).all(axis=2))
    beyond = beyond + np.where(lost, probability, 0.0).sum(axis=1)
    probability = np.where(lost, 0.0, probability)
    modes = np.count_nonzero(probability, axis=1)
    k = one_sided_k(risks[1] / (2.0 * np.maximum(modes, 1)[:, None]))
    offset = np.concatenate(
        [bias[:, :1], np.where(lost[..., None], 0.0, bias[:, 1:] + k[:, None] * apart[:, 1:])], axis=1
    )
    weights = np.concatenate([np.full((len(used), 1), 2.0), probability], axis=1)
    total = budget.phmi_along if components == 1 else budget.phmi_vertical + budget.phmi_horizontal
    asked = risks[0] * np.maximum(1.0 - beyond / total, 0.0)[:, None]
    level = _solve(offset, np.where(np.isfinite(sigma), sigma, 1.0), weights, asked)
    known = np.isfinite(sigma[:, 0])
    return AraimLevels(
        level_m=np.where(known, np.where(asked > 0.0, level, np.inf), np.nan),
        sigma_int_m=np.where(known, sigma[:, 0], np.nan),
        sigma_acc_m=np.where(known, np.sqrt((gain[:, 0] ** 2 * acc[:, 0] ** 2).sum(axis=2)), np.nan),
        modes=modes,
        unmonitored=beyond,
    )


def _event_priors(geometry: AraimGeometry, used: Masks) -> Floats:
    """Return the probability of each event, shape (T, E); 0 where no observation of the event is used."""
    alone = np.where(used, geometry.prior, 0.0)
    some = (used[:, None] & geometry.together).any(axis=2)
    return np.concatenate([alone, np.where(some, geometry.together_prior, 0.0)], axis=1)


def _order(prior: Floats, budget: AraimBudget) -> tuple[Integers, Floats]:
    """Return the largest number of events in a mode, and an upper bound on the probability of more events."""
    more = set_sums(prior, budget.most_faults + 1)[:, 2:]
    enough = more <= budget.unmonitored
    order = np.where(enough.any(axis=1), np.argmax(enough, axis=1) + 1, budget.most_faults)
    return order, more[np.arange(len(more)), order - 1]


def _gains(design: Floats, weight: Floats, components: int) -> tuple[Floats, Floats]:
    """Return the gains S (T, F, Q, N) and the sigmas (T, F, Q) of each mode; without a position, sigmas are NaN."""
    normal = np.einsum("tnp,tfn,tnr->tfpr", design, weight, design, optimize=True)
    diagonal = np.diagonal(normal, axis1=2, axis2=3)
    # a clock without observations is treated as known
    free = diagonal > 0.0
    normal = normal + np.where(free, 0.0, 1.0)[..., None] * np.eye(design.shape[2])
    scale = np.sqrt(np.where(free, diagonal, 1.0))
    scaled = normal / scale[..., None] / scale[..., None, :]
    regular = (np.linalg.det(scaled) > _SINGULAR) & free[..., :components].all(axis=2)
    inverse = np.linalg.inv(np.where(regular[..., None, None], scaled, np.eye(design.shape[2])))
    covariance = inverse / scale[..., None] / scale[..., None, :]
    gain = np.einsum("tfqp,tnp,tfn->tfqn", covariance[:, :, :components], design, weight, optimize=True)
    variance = np.diagonal(covariance, axis1=2, axis2=3)[..., :components]
    return np.where(regular[..., None, None], gain, 0.0), np.where(regular[..., None], np.sqrt(variance), np.nan)


def _solve(offset: Floats, sigma: Floats, weight: Floats, risk: Floats) -> Floats:
    """Return the levels (T, Q) at which the tail probabilities of F modes add up to `risk`; infinite above 10 km."""
    low, high = np.zeros(risk.shape), np.full(risk.shape, _LONGEST_M)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        spent = (weight[..., None] * scipy.special.ndtr((offset - middle[:, None]) / sigma)).sum(axis=1)
        over = spent > risk
        low, high = np.where(over, middle, low), np.where(over, high, middle)
    return np.where(high >= _LONGEST_M, np.inf, high)


class SupportArrays(NamedTuple):
    """Integrity support of each channel, shape (M,), and fault probability of each constellation letter."""

    sigma_ura_m: Floats
    sigma_ure_m: Floats
    bias_m: Floats
    prior: Floats
    constellation_prior: dict[str, float]


class SatelliteSupport(Protocol):
    """Interface of integrity support, implemented by `support_message.IntegritySupport`."""

    def holds(self, time: Datetimes) -> Masks:
        """Return True for epochs at which the support is valid, shape (T,)."""

    def notes(self, time: Datetimes) -> tuple[str, ...]:
        """Return notes on the validity of the support at the given epochs."""

    def arrays(self, satellites: Sequence[str]) -> SupportArrays:
        """Return the support of each channel's satellite ("G07"); NaN for satellites without support."""
