"""Errors drawn against the protection level: noise alone, and one and two faults of the size that hurts most.

Geometries are drawn (satellites, constellations, heading of the track, map error); their levels come from
the code under test. The errors do not: every position, with all satellites and without each subset, is an
operator from its own normal matrix with a column a clock and a row a prior, applied to drawn noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Final

import numpy as np
from scipy.special import ndtr
from scipy.stats import poisson

import paths  # noqa: F401
import raim_cases
import synthetic
from railfix.core.geodesy import range_with_rotation
from railfix.integrity.protection import ProtectionLevel, RiskBudget, protection_level
from railfix.integrity.raim import LinearModel, Outcome, RaimLimits, exclude, linear_model
from railfix.integrity.raim.position_model import compact
from railfix.positioning.range_arrays import Ranges
from railfix.ranges.channels import clock_groups
from railfix.track.trajectory import Trajectory

#: Ten of each of three clocks to choose from.
SYSTEMS: Final = "G" * 10 + "E" * 10 + "C" * 10
MOST_USED: Final = 20
MAP_SIGMA_M: Final = (0.05, 0.3, 2.0)
#: Parts of the level at which the test must fail, so that it is known to see something.
SHRUNK: Final = (0.9, 0.8)
#: Fault sizes, over the one that is worst by the two tails of the position and of its own test.
AROUND: Final = (0.85, 1.0, 1.15)


def _budget(risk: float, prior: float) -> RiskBudget:
    return RiskBudget(
        risk_per_hour=risk,
        samples_per_hour=1.0,
        exclusion_share=0.0,
        satellite_prior=dict.fromkeys("GEC", prior),
        local_prior=0.0,
    )


#: Risks that drawing can resolve, with priors that leave a small probability to one and to two faults alike.
BUDGETS: Final = {
    "1e-3, prior 8e-3": _budget(1e-3, 8e-3),
    "1e-4, prior 3.8e-3": _budget(1e-4, 3.8e-3),
    "1e-5, prior 1.7e-3": _budget(1e-5, 1.7e-3),
}


#: The defaults, all constellations alike.
HOURLY: Final = RiskBudget(satellite_prior=dict.fromkeys("GEC", 3e-5), exclusion_share=0.0)


@dataclass(frozen=True)
class Geometries:
    """T geometries of n places, K subsets (none, each single, each pair)."""

    level: ProtectionLevel
    members: np.ndarray  # (K, 2) places, -1 where none
    operator: np.ndarray  # (T, K, n + 2) metres for each whitened row: ranges, then the map
    projector: np.ndarray  # (T, n, n) of the residuals of the ranges
    used: np.ndarray  # (T, n + 1); the last is always there

    def __len__(self) -> int:
        return len(self.operator)

    @property
    def sigma_m(self) -> np.ndarray:
        """Of each position, shape (T, K)."""
        return np.sqrt((self.operator**2).sum(axis=2))

    @property
    def separation_sigma_m(self) -> np.ndarray:
        return np.sqrt(((self.operator - self.operator[:, :1]) ** 2).sum(axis=2))

    @property
    def asked(self) -> np.ndarray:
        """Subsets whose separation the level tests, shape (T, K): in use, and pairs where they are asked for."""
        one, two = self.members.T
        there = self.used[:, one] & self.used[:, two]
        there[:, two >= 0] &= np.isfinite(self.level.k_two_faults)[:, None]
        there &= self.separation_sigma_m > 1e-9 * self.sigma_m[:, :1]  # NaN: not determined, not tested
        there[:, 0] = False
        return there

    @property
    def part_m(self) -> np.ndarray:
        """The level that each subset's own part of the risk and noise ask for, shape (T, K)."""
        alone, got = self.members[:, 1] < 0, self.level
        own = np.where(alone, got.one_fault_m[:, None], got.two_fault_m[:, None])
        return np.maximum(np.where(self.members[:, 0] < 0, 0.0, own), got.fault_free_m[:, None])


def drawn(count: int, seed: int, map_sigma_m: float) -> tuple[Ranges, Trajectory, np.ndarray]:
    """Ranges without error of 4 to 20 satellites of one to three constellations, on a line that runs every way."""
    rng = np.random.default_rng(seed)
    line = replace(
        synthetic.line(2000.0, curvature=1 / 50.0), sigma_plan_m=map_sigma_m, sigma_height_m=2.0 * map_sigma_m
    )
    arc = rng.uniform(50.0, 1800.0, count)
    azimuth, elevation = rng.uniform(0.0, 2 * np.pi, (count, 30)), np.radians(rng.uniform(10.0, 88.0, (count, 30)))
    los = np.stack(
        [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)], axis=-1
    )
    sat = synthetic.enu_to_ecef(los * 2.3e7)
    order = rng.random((count, 30))
    order[:, 10:] += (rng.integers(1, 4, count) < 2)[:, None] * 10.0  # one constellation
    order[:, 20:] += (rng.integers(1, 4, count) < 3)[:, None] * 10.0
    number = rng.integers(4, MOST_USED + 1, count)
    chosen = (order.argsort(axis=1).argsort(axis=1) < number[:, None]) & (order < 5.0)
    weight = chosen / rng.uniform(0.5, 3.0, (count, 30)) ** 2
    code = synthetic.travelled_range(sat, line.at_arc(arc)[:, None, :])
    return Ranges(sat_ecef_m=sat, code_m=code, weight=weight, groups=clock_groups(list(SYSTEMS))), line, arc


def operators(ranges: Ranges, line: Trajectory, arc: np.ndarray, members: np.ndarray, place: np.ndarray):
    """Positions along the line as operators on the rows, each from its own normal matrix."""
    at = np.arange(len(arc))[:, None]
    section = line.segment_at(arc)[0]
    axes = np.stack([line.tangent[section], line.across[section], line.up[section]], axis=1)
    _, los = range_with_rotation(ranges.sat_ecef_m, line.at_arc(arc)[:, None, :])
    root = np.sqrt(ranges.weight)[at, place]
    clock = (place[..., None] // 10 == np.arange(3)).astype(float)
    rows = np.concatenate([-(los @ axes.swapaxes(1, 2))[at, place], clock], axis=2) * root[..., None]
    map_rows = np.zeros((len(arc), 2, 6))
    map_rows[:, 0, 1], map_rows[:, 1, 2] = 1.0 / line.sigma_plan_m, 1.0 / line.sigma_height_m
    rows = np.concatenate([rows, map_rows], axis=1)
    outer = rows[..., :, None] * rows[..., None, :]
    normal = np.repeat(outer.sum(axis=1)[:, None], len(members), axis=1)
    kept = np.ones((len(members), rows.shape[1]), dtype=bool)
    for side in (0, 1):
        has = members[:, side] >= 0
        normal[:, has] -= outer[:, members[has, side]]
        kept[has, members[has, side]] = False
    lone = np.abs(np.einsum("tkii->tki", normal)) < 1e-9
    normal += np.eye(6) * lone[..., None]  # clocks without satellites
    unit = 1.0 / np.sqrt(np.einsum("tkii->tki", normal))
    outer_unit = unit[..., :, None] * unit[..., None, :]
    singular = np.abs(np.linalg.det(normal * outer_unit)) < 1e-9
    inverse = np.linalg.inv(np.where(singular[..., None, None], np.eye(6), normal * outer_unit)) * outer_unit
    inverse[singular] = np.nan
    operator = np.matmul(inverse[:, :, 0], rows.swapaxes(1, 2)) * kept
    n = place.shape[1]
    projector = np.eye(n) - rows[:, :n] @ inverse[:, 0] @ rows[:, :n].swapaxes(1, 2)
    return operator, projector, root > 0


def geometries(count: int, seed: int, risk: RiskBudget) -> Iterator[Geometries]:
    """Those whose level is finite, in pieces of a few hundred."""
    pairs = np.array(list(combinations(range(MOST_USED), 2)))
    singles = np.stack([np.arange(MOST_USED), np.full(MOST_USED, -1)], axis=1)
    members = np.concatenate([[[-1, -1]], singles, pairs])
    for piece, first in enumerate(range(0, count, 250)):
        ranges, line, arc = drawn(min(250, count - first), seed * 1000 + piece, MAP_SIGMA_M[piece % len(MAP_SIGMA_M)])
        level = protection_level(linear_model(ranges, line, arc), list(SYSTEMS), risk=risk)
        good = np.isfinite(level.level_m) & np.isfinite(level.k_two_faults) & (level.level_m < 300.0)
        ranges, arc = ranges.take(np.flatnonzero(good)), arc[good]
        level = ProtectionLevel(**{name: getattr(level, name)[good] for name in ProtectionLevel.__dataclass_fields__})
        place = np.argsort(ranges.weight == 0, axis=1, kind="stable")[:, :MOST_USED]
        operator, projector, used = operators(ranges, line, arc, members, place)
        padded = np.concatenate([used, np.ones((len(used), 1), dtype=bool)], axis=1)  # place -1: always there
        yield Geometries(level=level, members=members, operator=operator, projector=projector, used=padded)


def worst_sizes(some: Geometries, level_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Largest probability over fault sizes that one's own test passes and a level (T, K) is exceeded; the movement.

    The noise of the position is independent of that of its distance to any without some satellites. 1 where the
    rest does not determine a position: nothing tests.
    """
    sigma, apart = some.sigma_m[:, :1, None], some.separation_sigma_m[..., None]
    limit = some.level.k_false_alarm[:, None, None] * apart
    level = level_m[..., None]
    moved = limit * np.linspace(0.0, 1.6, 41)
    tails = ndtr((moved - level) / sigma) + ndtr((-moved - level) / sigma)
    wide = np.where(apart > 1e-9 * sigma, apart, 1.0)
    passed = ndtr((limit - moved) / wide) - ndtr((-limit - moved) / wide)
    chance = np.where(apart > 1e-9 * sigma, tails * passed, 2.0 * ndtr(-level / sigma))
    best = np.argmax(np.nan_to_num(chance), axis=2)[..., None]
    chance[np.isnan(apart[..., 0])] = 1.0
    return np.take_along_axis(chance, best, 2)[..., 0], np.take_along_axis(moved, best, 2)[..., 0]


@dataclass
class Count:
    """Drawn epochs of one kind."""

    draws: int = 0
    allowed: float = 0.0
    found: int = 0
    shrunk: tuple[int, ...] = (0,) * len(SHRUNK)

    @property
    def most(self) -> int:
        """What chance reaches once in 10 000 runs of as many epochs at the allowed rate."""
        return int(poisson.isf(1e-4, self.allowed))

    def add(self, draws: int, allowed: float, errors: np.ndarray, level: float) -> None:
        self.draws += draws
        self.allowed += draws * allowed
        self.found += int(np.count_nonzero(errors > level))
        self.shrunk = tuple(
            s + int(np.count_nonzero(errors > f * level)) for s, f in zip(self.shrunk, SHRUNK, strict=True)
        )


def hidden_fault(some: Geometries, t: int, subset: int) -> np.ndarray:
    """Error of the subset's rows that moves the position by 1 m and shows least in the residuals, shape (n + 2,)."""
    places = [m for m in some.members[subset] if m >= 0]
    gain = some.operator[t, 0, places]
    direction = np.linalg.lstsq(some.projector[t][np.ix_(places, places)], gain, rcond=1e-9)[0]
    fault = np.zeros(some.operator.shape[2])
    fault[places] = direction / (gain @ direction)
    return fault


def simulate(count: int, draws: int, seed: int, risk: RiskBudget) -> dict[str, Count]:
    """Draw noise in each geometry: alone, and with the worst one and two faults; against each part of the level."""
    rng = np.random.default_rng(seed)
    names = ["no fault, K sigma alone", "false alarms"]
    names += [f"{kind}, {around:.2f} of worst size" for kind in ("one fault", "two faults") for around in AROUND]
    counts = {name: Count() for name in names}
    part = risk.one_fault_share  # all three alike
    for some in geometries(count, seed, risk):
        part_m = some.part_m
        chance, moved = worst_sizes(some, part_m)
        asked, limits_m = some.asked, some.level.k_false_alarm[:, None] * some.separation_sigma_m
        sigma, two = some.sigma_m[:, 0], some.members[:, 1] >= 0
        one = ~two & (some.members[:, 0] >= 0)
        risk_of_part = part * (risk.risk_per_sample - some.level.unchecked_risk)
        for t in range(len(some)):
            noise = rng.standard_normal((draws, some.operator.shape[2]))
            base = noise @ some.operator[t, 0]
            counts["no fault, K sigma alone"].add(
                draws, float(risk_of_part[t]), np.abs(base), float(some.level.fault_free_m[t])
            )
            tested = np.flatnonzero(asked[t])
            apart = some.operator[t, tested] - some.operator[t, 0]
            limit = limits_m[t, tested]
            few = np.abs(noise[: draws // 10] @ apart.T) / limit
            counts["false alarms"].add(len(few), risk.false_alarm, few.max(axis=1), 1.0)
            for kind, which, k in (
                ("one fault", one, some.level.k_one_fault[t]),
                ("two faults", two, some.level.k_two_faults[t]),
            ):
                worst = int(np.argmax(np.where(asked[t] & which, chance[t], -1.0)))
                level, shape = float(part_m[t, worst]), hidden_fault(some, t, worst)
                own = some.operator[t, worst] - some.operator[t, 0]
                own_limit = limits_m[t, worst]
                allowed = float(ndtr(-k) + ndtr(-level / sigma[t]))
                for around in AROUND:
                    size = around * moved[t, worst]
                    error = base + size
                    over = np.flatnonzero(np.abs(error) > min(SHRUNK) * level)
                    over = over[np.abs(noise[over] @ own + size * (shape @ own)) <= own_limit]
                    seen = np.abs((noise[over] + size * shape) @ apart.T) > limit
                    hidden = np.abs(error[over[~seen.any(axis=1)]])
                    counts[f"{kind}, {around:.2f} of worst size"].add(draws, allowed, hidden, level)
    return counts


@dataclass
class Weighted:
    """Risk found by drawing hypotheses more often than they are, each found epoch with its weight."""

    epochs: int = 0
    allowed: float = 0.0  # sum over epochs
    found: np.ndarray = field(default_factory=lambda: np.zeros(1 + len(SHRUNK)))
    squares: np.ndarray = field(default_factory=lambda: np.zeros(1 + len(SHRUNK)))

    def share(self, which: int = 0) -> float:
        """Risk over what is allowed; `which` counts the shrunk levels."""
        return float(self.found[which] / self.allowed)

    @property
    def spread(self) -> float:
        """Standard deviation of `share`."""
        return float(np.sqrt(self.squares[0]) / self.allowed)


def whole_risk(count: int, draws: int, seed: int, risk: RiskBudget) -> Weighted:
    """All hypotheses together against the level: no fault, each single, each pair at the size that is its worst.

    Each epoch draws one hypothesis with a probability in proportion to what it may contribute.
    """
    rng = np.random.default_rng(seed)
    result = Weighted()
    prior = risk.prior(["G"])[0]
    for some in geometries(count, seed, risk):
        level_m = np.broadcast_to(some.level.level_m[:, None], some.part_m.shape)
        chance, moved = worst_sizes(some, level_m)
        there = some.used[:, some.members[:, 0]] & some.used[:, some.members[:, 1]]
        single = some.members[:, 1] < 0
        weight = there * np.where(some.members[:, 0] < 0, 1.0, np.where(single, prior, prior**2))
        limits_m, asked = some.level.k_false_alarm[:, None] * some.separation_sigma_m, some.asked
        for t in range(len(some)):
            result.epochs += draws
            result.allowed += draws * float(risk.risk_per_sample - some.level.unchecked_risk[t])
            likely = weight[t] * (chance[t] + 1e-9)
            likely /= likely.sum()
            picks = rng.multinomial(draws, likely)
            tested = np.flatnonzero(asked[t])
            apart, limit = some.operator[t, tested] - some.operator[t, 0], limits_m[t, tested]
            for k in np.flatnonzero(picks):
                noise = rng.standard_normal((picks[k], some.operator.shape[2]))
                worth = weight[t, k] / likely[k]
                if np.isnan(some.operator[t, k, 0]):  # nothing checks it: counted whole
                    found = np.full(1 + len(SHRUNK), float(picks[k]))
                else:
                    shape = hidden_fault(some, t, k) * moved[t, k] if k else np.zeros(noise.shape[1])
                    error = noise @ some.operator[t, 0] + (moved[t, k] if k else 0.0)
                    over = np.flatnonzero(np.abs(error) > min(SHRUNK) * some.level.level_m[t])
                    quiet = ~(np.abs((noise[over] + shape) @ apart.T) > limit).any(axis=1)
                    size = np.abs(error[over[quiet]])
                    found = np.array(
                        [np.count_nonzero(size > f * some.level.level_m[t]) for f in (1.0, *SHRUNK)], dtype=float
                    )
                result.found += worth * found
                result.squares += worth**2 * found
    return result


@dataclass(frozen=True)
class Total:
    """Risk of geometries over what it may be: all hypotheses at their worst sizes, Gaussian tails."""

    geometries: int
    median: float
    largest: float


def analytic(count: int, seed: int, risk: RiskBudget, factor: float = 1.0) -> Total:
    """Sum over all hypotheses of prior times worst probability, over the risk of a sample less what is unchecked.

    Each hypothesis is tried against its own test alone: all tests together find more.
    """
    ratios = []
    prior = risk.prior(["G"])[0]
    for some in geometries(count, seed, risk):
        chance, _ = worst_sizes(some, factor * np.broadcast_to(some.level.level_m[:, None], some.part_m.shape))
        there = some.used[:, some.members[:, 0]] & some.used[:, some.members[:, 1]]
        weight = np.where(some.members[:, 0] < 0, 1.0, np.where(some.members[:, 1] < 0, prior, prior**2))
        spent = (there * chance * weight).sum(axis=1)
        allowed = (1.0 - 2.0 * risk.exclusion_share) * (risk.risk_per_sample - some.level.unchecked_risk)
        ratios.append(spent / allowed)
    together = np.concatenate(ratios)
    return Total(len(together), float(np.median(together)), float(together.max()))


def summed_levels(count: int, seed: int, risk: RiskBudget) -> np.ndarray:
    """Level where all tails together are the risk, found by halving, over the product's and its parts', (T, 2)."""
    ratios = []
    prior = risk.prior(["G"])[0]
    for some in geometries(count, seed, risk):
        there = some.used[:, some.members[:, 0]] & some.used[:, some.members[:, 1]]
        weight = there * np.where(some.members[:, 0] < 0, 2.0, np.where(some.members[:, 1] < 0, prior, prior**2))
        whole = np.isfinite(some.sigma_m) | ~there  # every hypothesis is checked
        good = whole.all(axis=1)
        sigma = np.where(there, some.sigma_m, 1.0)[good]
        limit = some.level.k_false_alarm[good, None] * np.where(there, some.separation_sigma_m, 0.0)[good]
        allowed = (1.0 - 2.0 * risk.exclusion_share) * (risk.risk_per_sample - some.level.unchecked_risk[good])
        low, high = np.zeros(good.sum()), some.level.level_m[good].copy()
        for _ in range(50):
            middle = (low + high) / 2.0
            over = (weight[good] * ndtr((limit - middle[:, None]) / sigma)).sum(axis=1) > allowed
            low, high = np.where(over, middle, low), np.where(over, high, middle)
        parts = np.maximum(some.level.fault_free_m, np.maximum(some.level.one_fault_m, some.level.two_fault_m))[good]
        ratios.append(np.stack([high / some.level.level_m[good], high / parts], axis=1))
    return np.concatenate(ratios)


@dataclass(frozen=True)
class Excluding:
    """Epochs with exclusion at work, by number of faults."""

    draws: np.ndarray
    misled: np.ndarray  # error over the level, no warning
    careless: np.ndarray  # the same, with the level of no fault hypotheses
    excluded: np.ndarray
    probability: np.ndarray

    def risk(self, misled: np.ndarray) -> float:
        return float((self.probability * misled / self.draws).sum())


def least_shown(model: LinearModel, faulty: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """Errors of two faulty channels in the proportion that shows least for what it moves, the larger kept as drawn."""
    parts, at = compact(model), np.arange(len(model))[:, None]
    pair = np.argsort(~faulty, axis=1, kind="stable")[:, :2]
    normal = parts.projector[at[..., None], pair[:, :, None], pair[:, None, :]]
    shape = np.linalg.solve(normal, parts.gain_m[at, pair])[..., 0]
    shape /= np.abs(shape).max(axis=1, keepdims=True)
    largest = np.abs(size_m[at, pair] / model.sigma_m[at, pair]).max(axis=1, keepdims=True)
    result = np.zeros_like(size_m)
    result[at, pair] = shape * largest * model.sigma_m[at, pair]
    return result


def excluding(draws: int, seed: int, risk: RiskBudget, systems: str = "GGGGGGEEEEE") -> Excluding:
    """Faults up to 15 sigma at their priors; ranges tested, satellites excluded, the level of the rest.

    Strata of 0, 1, 2 and 3 faults, weighted with their probabilities; two in the proportion that shows least.
    """
    rng = np.random.default_rng(seed)
    n, prior = len(systems), risk.prior(["G"])[0]
    result = np.zeros((4, 4))
    for faults in range(4):
        arc = rng.uniform(100.0, 1900.0, draws)
        ranges = raim_cases.made(arc, systems, seed=seed + faults)
        faulty = rng.random((draws, n)).argsort(axis=1).argsort(axis=1) < faults
        size = rng.uniform(2.0, 15.0, (draws, n)) * rng.choice([-1.0, 1.0], (draws, n)) / np.sqrt(ranges.weight)
        if faults == 2:
            size = least_shown(linear_model(ranges, raim_cases.LINE, arc), faulty, size)
        ranges = replace(ranges, code_m=ranges.code_m + faulty * size)
        model = linear_model(ranges, raim_cases.LINE, arc)
        found = exclude(model, limits=RaimLimits())
        rest: LinearModel = linear_model(
            replace(ranges, weight=np.where(found.excluded, 0.0, ranges.weight)), raim_cases.LINE, arc
        )
        out = found.excluded.sum(axis=1)
        got = protection_level(rest, list(systems), risk=risk, n_excluded=out)
        told = np.isin(found.outcome, [Outcome.INSEPARABLE, Outcome.UNRESOLVED])
        error = np.abs(rest.step_m[:, 0])
        result[faults] = [
            draws,
            np.count_nonzero((error > got.level_m) & got.consistent & ~told),
            np.count_nonzero((error > got.fault_free_m) & ~told),
            np.count_nonzero(out),
        ]
    chance = np.array([(1 - prior) ** n, n * prior, n * (n - 1) / 2 * prior**2, n * (n - 1) * (n - 2) / 6 * prior**3])
    return Excluding(result[:, 0], result[:, 1], result[:, 2], result[:, 3], chance)


#: Faults often enough that exclusion at work shows what it risks.
OFTEN: Final = RiskBudget(
    risk_per_hour=2e-3,
    samples_per_hour=1.0,
    exclusion_share=0.1,
    satellite_prior=dict.fromkeys("GEC", 0.02),
    local_prior=0.0,
)
