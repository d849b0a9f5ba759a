"""RAIM by deleting rows and solving again: one column a clock, one row a prior."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from pyproj import Transformer
from scipy.stats import chi2

from railfix.integrity.raim import Outcome, RaimLimits
from railfix.positioning.range_arrays import Ranges
from railfix.track.trajectory import Trajectory

#: Standard deviations of inter-system biases from which on nothing is known of them [m].
UNTIED_M: Final = 1e6
#: The earth's rotation [rad/s] and the speed of light [m/s] (IS-GPS-200, 20.3.3.4.3).
ROTATION_RADPS, LIGHT_MPS = 7.2921151467e-5, 299_792_458.0
_GEODETIC: Final = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)


def east_north_up(ecef_m: np.ndarray) -> np.ndarray:
    """Return the unit vectors to the east, to the north and up at a place."""
    longitude, latitude, _ = _GEODETIC.transform(*ecef_m)
    (c, s), (cl, sl) = ((np.cos(x), np.sin(x)) for x in np.radians([latitude, longitude]))
    return np.array([[-sl, cl, 0.0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])


def range_on_turning_earth(sat_ecef_m: np.ndarray, place_ecef_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distances in the frame of reception, to first order of the rotation, and the unit vectors of sight."""
    apart = sat_ecef_m - place_ecef_m
    distance = np.linalg.norm(apart, axis=-1)
    turned = sat_ecef_m[..., 0] * place_ecef_m[..., 1] - sat_ecef_m[..., 1] * place_ecef_m[..., 0]
    return distance + ROTATION_RADPS / LIGHT_MPS * turned, apart / distance[..., None]


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
    distance, los = range_on_turning_earth(ranges.sat_ecef_m[t, channels], place)
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


def problem_on_line(ranges: Ranges, t: int, arc_m: float, line: Trajectory) -> Problem:
    """Along the section at an arc length, to the right and up unknown, the last two with the priors of the map."""
    length = np.linalg.norm(np.diff(line.ecef_m, axis=0), axis=1)
    begin = np.concatenate([[0.0], np.cumsum(length)])
    section = int(np.clip(np.searchsorted(begin, arc_m, side="right") - 1, 0, len(length) - 1))
    first, second = line.ecef_m[section : section + 2]
    along = (second - first) / length[section]
    up = east_north_up(0.5 * (first + second))[2]
    right = np.cross(along, up)
    axes = np.stack([along, right / np.linalg.norm(right), up])
    prior = (np.inf, line.sigma_plan_m, line.sigma_height_m)
    return problem(ranges, t, first + (arc_m - begin[section]) * along, axes, prior)


def problem_in_space(ranges: Ranges, t: int, place_ecef_m: np.ndarray) -> Problem:
    """East, north and up unknown."""
    return problem(ranges, t, place_ecef_m, east_north_up(place_ecef_m), (np.inf,) * 3)


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
