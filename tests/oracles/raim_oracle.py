"""Made cases for RAIM, and RAIM by deleting rows and solving again: one column a clock, one row a prior."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.stats import chi2

import synthetic
from railfix.core.geodesy import enu_axes, geodetic_from_ecef, range_with_rotation
from railfix.integrity.raim import LinearModel, Outcome, RaimLimits, linear_model
from railfix.integrity.raim.position_model import _model
from railfix.positioning.normal_equations import Constrained, point_position, position_on_line
from railfix.positioning.range_arrays import UNTIED_M, InterSystemBiases, Ranges
from railfix.ranges.channels import clock_groups
from railfix.track import Track
from railfix.track.trajectory import Trajectory

#: Offsets of the clocks that made cases have [m].
CLOCK_OFFSET_M = (0.0, 12.0, -30.0, 5.0)


def point_model(ranges: Ranges, ecef_m: np.ndarray) -> LinearModel:
    """3-D positions: east, north and up unknown, the horizontal ones wanted (P4's horizontal form)."""
    latitude, longitude, _ = geodetic_from_ecef(ecef_m)
    return _model(ranges, ecef_m, enu_axes(latitude, longitude), np.zeros((3, 3)), unknowns=3)


def straight(length_m: float = 2000.0) -> Trajectory:
    """A line to the north-east, points every 20 m."""
    s = np.arange(0.0, length_m + 1.0, 20.0)
    return Trajectory.from_antenna_path(
        Track.from_ecef(synthetic.enu_to_ecef(np.stack([0.6 * s, 0.8 * s, 0.002 * s], axis=1)))
    )


LINE = straight()


def made(
    arc_m: np.ndarray,
    systems: str,
    *,
    seed: int,
    faults_m: Mapping[int, float] | None = None,
    tie_sigma_m: tuple[float, ...] | None = None,
    noise: float = 1.0,
    sat_ecef_m: np.ndarray | None = None,
    sigma_m: np.ndarray | None = None,
) -> Ranges:
    """Ranges with just the noise, the map error and the clock offsets that the model assumes, read-only."""
    rng = np.random.default_rng(seed)
    shape = (len(arc_m), len(systems))
    sat = synthetic.satellites(rng, *shape[:1], systems) if sat_ecef_m is None else sat_ecef_m
    sigma = rng.uniform(0.5, 3.0, shape) if sigma_m is None else np.broadcast_to(sigma_m, shape)
    groups = clock_groups(list(systems))
    section = LINE.segment_at(arc_m)[0]
    place = LINE.at_arc(arc_m)
    place = place + rng.normal(0.0, LINE.sigma_plan_m, (len(arc_m), 1)) * LINE.across[section]
    place = place + rng.normal(0.0, LINE.sigma_height_m, (len(arc_m), 1)) * LINE.up[section]
    code = synthetic.travelled_range(sat, place[:, None, :]) + 3.0e4 + noise * sigma * rng.normal(size=shape)
    ties = None
    if tie_sigma_m is not None:
        tie_sigma = np.broadcast_to(np.array(tie_sigma_m[: len(groups)]), (len(arc_m), len(groups)))
        offset = np.broadcast_to(np.array(CLOCK_OFFSET_M[: len(groups)]), tie_sigma.shape)
        ties = InterSystemBiases(offset_m=offset, sigma_m=tie_sigma)
        drawn = offset + np.minimum(tie_sigma, 100.0) * rng.normal(size=tie_sigma.shape)
    else:
        drawn = np.broadcast_to(np.array(CLOCK_OFFSET_M[: len(groups)]), (len(arc_m), len(groups)))
    for g, group in enumerate(groups):
        code[:, group] += drawn[:, g, None]
    for channel, size in (faults_m or {}).items():
        code[:, channel] += size
    weight = 1.0 / sigma**2
    for array in (sat, code, weight):
        array.flags.writeable = False
    return Ranges(sat_ecef_m=sat, code_m=code, weight=weight, groups=groups, ties=ties)


def only(ranges: Ranges, channels: list[int]) -> Ranges:
    """Weight left to some channels."""
    weight = np.zeros_like(ranges.weight)
    weight[:, channels] = ranges.weight[:, channels]
    weight.flags.writeable = False
    return Ranges(
        sat_ecef_m=ranges.sat_ecef_m, code_m=ranges.code_m, weight=weight, groups=ranges.groups, ties=ranges.ties
    )


def solved(ranges: Ranges, arc_m: np.ndarray) -> tuple[Constrained, LinearModel]:
    """Position on the line, started near the truth, and its model."""
    got = position_on_line(ranges, LINE, np.argmin(np.abs(LINE.arc_m - arc_m[:, None]), axis=1))
    return got, linear_model(ranges, LINE, got.arc_m, section=got.section)


def in_space(ranges: Ranges) -> LinearModel:
    """Model of the 3-D position."""
    point = point_position(ranges, np.broadcast_to(LINE.ecef_m[0], (len(ranges), 3)))
    return point_model(ranges, point.ecef_m)


@dataclass(frozen=True)
class Problem:
    """One epoch as rows and columns: whitened ranges first, then one row a prior."""

    design: np.ndarray
    observed: np.ndarray
    sigma_m: np.ndarray
    channels: np.ndarray
    scale_of: np.ndarray  # metres that one unit of each column stands for
    interest: int
    freedom: int

    def solve(self, without: tuple[int, ...] = ()) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Place (first three columns) [m], cofactors, whitened residuals of all rows, those left out included."""
        keep = ~np.isin(np.arange(len(self.observed)), np.flatnonzero(np.isin(self.channels, without)))
        design, observed = self.design[keep], self.observed[keep]
        x, *_ = np.linalg.lstsq(design, observed, rcond=None)
        inverse = np.linalg.pinv(design, rcond=1e-12)
        cofactors = inverse @ inverse.T
        return x * self.scale_of, cofactors, self.observed - self.design @ x

    def statistic(self, without: tuple[int, ...], mode: str, scale: float) -> float:
        """WSSE (chi-square mode) or unweighted sum of squares of the rest."""
        _, _, residual = self.solve(without)
        out = np.isin(self.channels, without)
        ranges = ~out[: len(self.channels)]
        if mode == "fixed":
            return float(((residual[: len(self.channels)] * self.sigma_m)[ranges] ** 2).sum())
        return float((np.delete(residual, np.flatnonzero(out)) ** 2).sum()) / scale**2

    def rank_without(self, without: tuple[int, ...]) -> int:
        """Rank of what is left; a prior of an untied clock tells nothing."""
        untied = len(self.channels) + np.flatnonzero(
            (np.abs(self.design[len(self.channels) :]) @ self.scale_of) >= UNTIED_M
        )
        left_out = [*np.flatnonzero(np.isin(self.channels, without)), *untied]
        keep = np.delete(np.arange(len(self.observed)), left_out)
        return int(np.linalg.matrix_rank(self.design[keep], tol=1e-7))


def problem(ranges: Ranges, t: int, place: np.ndarray, axes: np.ndarray, prior_sigma: tuple[float, ...]) -> Problem:
    """Rows and columns of one epoch; `prior_sigma` of the three axes, infinite where unknown."""
    channels = np.flatnonzero(ranges.weight[t] > 0)
    sigma = 1.0 / np.sqrt(ranges.weight[t, channels])
    distance, los = range_with_rotation(ranges.sat_ecef_m[t, channels], place)
    clock = np.array([next(i for i, s in enumerate(ranges.groups) if s.start <= c < s.stop) for c in channels])
    seen = np.unique(clock)
    observed = ranges.code_m[t, channels] - distance
    columns, scale, priors = [], [], []
    for axis, prior in zip(axes, prior_sigma, strict=True):
        unit = prior if np.isfinite(prior) else 1.0
        columns.append(-los @ axis * unit)
        scale.append(unit)
        priors.append(np.isfinite(prior))
    if ranges.ties is None:
        clocks = [(clock == g).astype(float) for g in seen]
        columns, scale, priors = columns + clocks, scale + [1.0] * len(seen), priors + [False] * len(seen)
        n_clocks = len(seen)
    else:
        observed = observed - ranges.ties.offset_m[t, clock]
        columns, scale, priors = [*columns, np.ones(len(channels))], [*scale, 1.0], [*priors, False]
        tied = ranges.ties.sigma_m[t] < UNTIED_M
        for g in seen:
            unit = ranges.ties.sigma_m[t, g]
            columns.append((clock == g) * unit)
            scale.append(unit)
            priors.append(True)
        n_clocks = int((~tied[seen]).sum() + tied[seen].any())
    observed = observed - observed.mean()
    design = np.stack(columns, axis=1) / sigma[:, None]
    extra = np.eye(len(columns))[np.array(priors)]
    return Problem(
        design=np.concatenate([design, extra]),
        observed=np.concatenate([observed / sigma, np.zeros(len(extra))]),
        sigma_m=sigma,
        channels=channels,
        scale_of=np.array(scale),
        interest=1 if np.isfinite(prior_sigma[1]) else 2,
        freedom=len(channels) - n_clocks - (1 if np.isfinite(prior_sigma[1]) else 3),
    )


def problem_on_line(ranges: Ranges, t: int, arc_m: float) -> Problem:
    section = int(LINE.segment_at(np.array([arc_m]))[0][0])
    axes = np.stack([LINE.tangent[section], LINE.across[section], LINE.up[section]])
    prior = (np.inf, LINE.sigma_plan_m, LINE.sigma_height_m)
    return problem(ranges, t, LINE.at_arc(np.array([arc_m]))[0], axes, prior)


def problem_in_space(ranges: Ranges, t: int, place_ecef_m: np.ndarray) -> Problem:
    latitude, longitude, _ = geodetic_from_ecef(place_ecef_m)
    return problem(ranges, t, place_ecef_m, enu_axes(latitude, longitude), (np.inf,) * 3)


@dataclass(frozen=True)
class Candidate:
    members: tuple[int, ...]
    statistic: float
    wsse: float
    own_m: tuple[float, ...]
    move_m: np.ndarray


def candidates(case: Problem, size: int, limits: RaimLimits, scale: float) -> Iterator[Candidate]:
    """Subsets of one size that may be excluded, by the rule as written, each solved again."""
    limit = chi2.isf(limits.false_alarm, case.freedom - size) if limits.mode == "chi_square" else limits.fixed_limit_m2
    full = case.rank_without(())
    start, _, _ = case.solve()
    for members in combinations(case.channels, size):
        if case.rank_without(members) < full:
            continue  # what is left does not tell their errors
        statistic = case.statistic(members, limits.mode, scale)
        place, cofactors, residual = case.solve(members)
        rows = [int(np.flatnonzero(case.channels == m)[0]) for m in members]
        own = residual[rows]
        if limits.mode == "chi_square":
            variance = 1.0 + np.einsum("ij,jk,ik->i", case.design[rows], cofactors, case.design[rows])
            big = own**2 > chi2.isf(limits.false_alarm, 1) * variance * scale**2
        else:
            big = (own * case.sigma_m[rows]) ** 2 > limits.fixed_limit_m2
        if statistic < limit and big.all():
            yield Candidate(
                tuple(int(m) for m in members),
                statistic,
                case.statistic(members, "chi_square", scale),
                tuple(own * case.sigma_m[rows]),
                (place - start)[: case.interest],
            )


def exclusion_by_trying(case: Problem, limits: RaimLimits, scale: float) -> tuple[Outcome, list[Candidate]]:
    """The rule of `exclude`, one epoch, as plainly as it can be written; the best subset, and its equals."""
    if case.freedom < 1:
        return Outcome.UNTESTABLE, []
    limit = chi2.isf(limits.false_alarm, case.freedom) if limits.mode == "chi_square" else limits.fixed_limit_m2
    if case.statistic((), limits.mode, scale) < limit:
        return Outcome.PASSED, []
    for size in range(1, limits.max_excluded + 1):
        if case.freedom - size < limits.min_redundancy:
            break
        found = sorted(candidates(case, size, limits, scale), key=lambda c: c.statistic)
        if found:
            best, *others = found
            rivals = [c for c in others if c.wsse - best.wsse <= limits.separation + 1e-6]
            rivals = [c for c in rivals if np.linalg.norm(c.move_m - best.move_m) >= limits.same_position_m]
            accepted = Outcome.EXCLUDED_ONE if size == 1 else Outcome.EXCLUDED_TWO
            equals = [c for c in others if c.statistic - best.statistic < 1e-6]
            return (Outcome.INSEPARABLE if rivals else accepted), [best, *equals]
    return Outcome.UNRESOLVED, []
