"""Every hypothesis of the level against least squares of what it leaves: prior, threshold and bias, sigma."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import protection_oracle
import raim_cases
import raim_oracle as oracle
from railfix import kernels
from railfix.integrity.protection import RiskBudget, protection_level
from railfix.integrity.protection.solution_separation import Asked, Errors, MapDeviation, RangeBounds
from railfix.integrity.raim import linear_model
from railfix.positioning.range_arrays import UNTIED_M, Ranges

pytestmark = pytest.mark.requirement("C2")

Array = NDArray[Any]
Tails = tuple[Array, Array, Array, Array, Array]

ARC = np.array([731.0, 250.0, 1800.0])
SYSTEMS = {
    "GGGG": None,
    "GGGGGEEE": None,
    "GGGEEC": None,
    "GGGGEEEECCC": None,
    "GGGGEE": (0.0, 1.0),
    "GGGEECC": (0.0, 0.5, UNTIED_M),
    "GGGEEECCC": (0.0, 2.0, 0.7),
}


def recorded(ranges: Ranges, systems: str, arc_m: Array, **options: Any) -> tuple[Errors, Asked, Tails]:
    """Return what the level of one epoch asks of its hypotheses, and their tails."""
    original, calls = kernels.hypotheses.tails_of_hypotheses, []

    def record(model: Any, errors: Errors, asked: Asked) -> Tails:
        calls.append((errors, asked, original(model, errors, asked)))
        return calls[-1][2]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels.hypotheses, "tails_of_hypotheses", record)
        protection_level(linear_model(ranges, raim_cases.LINE, arc_m), list(systems), **options)
    (call,) = calls
    return call


def solved_with_and_without_map(
    ranges: Ranges, arc_m: float, errors: Errors
) -> tuple[protection_oracle.Resolved, protection_oracle.Resolved]:
    """Return an epoch as it is, and with what was seen of the antenna's place instead of the map, or nothing."""
    case, scale = oracle.problem_on_line(ranges, 0, arc_m, raim_cases.LINE), float(errors.scale[0])
    n = len(case.channels)
    least = errors.least_sigma_m[0] if errors.least_sigma_m.shape[1] else None
    design, observed = case.design / scale, case.observed / scale
    # the information is R^T R: rows R take the place of those of the map, in the units of their columns
    information = errors.map_information[0]
    rows = np.linalg.cholesky(information).T if information.any() else np.zeros((2, 2))
    design[n : n + 2] = 0.0
    design[n : n + 2, 1:3] = rows * case.scale_of[1:3]
    observed[n : n + 2] = rows @ errors.map_seen_m[0]
    free = replace(case, design=design, observed=observed, sigma_m=case.sigma_m * scale)
    return protection_oracle.Resolved(case, scale, least), protection_oracle.Resolved(free, 1.0, least)


def expected_tail(
    with_map: protection_oracle.Resolved,
    solved: protection_oracle.Resolved,
    members: tuple[int, ...],
    errors: Errors,
    k_alarm: float,
) -> tuple[float, float]:
    """Return what the position without some satellites is away at most, noise apart, and its sigma; infinite: none."""
    case, answer = solved.case, solved.without(members)
    if not answer.determined:
        return 0.0, np.inf
    n, of_ranges = len(case.channels), 0.0
    if errors.bias_m.shape[1]:
        of_ranges = float(np.abs(answer.operator[:n]) @ (errors.bias_m[0, case.channels] / case.sigma_m))
    if solved is not with_map:  # the distance is known: it counts whole
        return abs(answer.place_m - with_map.all.place_m) + of_ranges, answer.sigma_m
    of_map = float(answer.operator[n : n + 2] @ (errors.map_bias_m[0] / case.scale_of[1:3]))
    return k_alarm * solved.apart(answer)[1] + of_ranges + abs(of_map), answer.sigma_m


def compare_hypotheses(ranges: Ranges, systems: str, arc_m: Array, **options: Any) -> Counter[str]:
    """Compare all kinds of hypotheses of one epoch, and count them."""
    errors, asked, (channel, offset, sigma, weight, separation) = recorded(ranges, systems, arc_m, **options)
    with_map, free = solved_with_and_without_map(ranges, arc_m[0], errors)
    used, edge = set(with_map.case.channels.tolist()), 100.0 * with_map.all.sigma_m
    compared: Counter[str] = Counter()
    largest = 0.0
    for base, first in enumerate(asked.first.tolist()):
        solved = free if asked.wrong_map[base] else with_map
        group = set(np.flatnonzero(asked.members[0, base]).tolist()) & used
        for size in range(asked.order[0, base] + 1):
            for k, more in enumerate(combinations(channel[0].tolist(), size)):
                at, kind = first[size] + k, f"{'map ' * (solved is free)}{'shared ' * bool(group)}{size}"
                prior = np.prod([asked.prior[0, c] * (c in used - group) for c in more])
                of_noise = 2.0 if at == 0 else 1.0  # noise passes on either side
                assert weight[0, at] == pytest.approx(of_noise * asked.shared_prior[0, base] * prior, rel=1e-12)
                if not prior:
                    continue
                members = (*sorted(group), *more)
                away, deviation = expected_tail(with_map, solved, members, errors, asked.k_false_alarm[0])
                if not np.isfinite(deviation):
                    assert sigma[0, at] > edge, (kind, members)  # infinite, or too large for a level
                    compared["undetermined"] += 1
                elif deviation < (20.0 if solved is free else edge):  # else at the edge of what is determined
                    rel = 1e-3 if solved is free else 1e-5
                    assert sigma[0, at] == pytest.approx(deviation, rel=rel), (kind, members)
                    # a threshold is of the difference of two variances, which keeps half of the digits
                    assert offset[0, at] == pytest.approx(away, rel=rel, abs=1e-4), (kind, members)
                    compared[kind] += 1
                    distance, apart = solved.apart(solved.without(members))
                    if solved is with_map and apart > 1e-3:
                        largest = max(largest, abs(distance) / (asked.k_false_alarm[0] * apart))
    assert separation[0] == pytest.approx(largest, rel=1e-4, abs=1e-9)
    return compared


@pytest.mark.parametrize("systems", SYSTEMS)
@pytest.mark.parametrize("by_range", [False, True])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_every_hypothesis_equals_solving_without_its_satellites(systems: str, by_range: bool, seed: int) -> None:
    """Satellites, constellations, sides of the track, a wrong map, these together; noise scales, biases, overbounds."""
    rng, n, epochs = np.random.default_rng(seed), len(systems), len(ARC)
    ranges = raim_cases.made(ARC, systems, seed=seed, tie_sigma_m=SYSTEMS[systems], faults_m={1: 9.0, n - 1: 2.0})
    missing = (rng.random(ranges.weight.shape) < 0.1) & (n > 6)
    ranges = replace(ranges, weight=np.where(missing, 0.0, ranges.weight))
    known = np.tile(np.array([[0.25, 0.02], [0.02, 0.04]]), (epochs, 1, 1)) * np.array([1.0, 1.0, 0.0])[:, None, None]
    risk = RiskBudget(risk_per_hour=1e-3, local_prior=4e-3, side_prior=1e-3, constellation_prior={"E": 1e-7, "C": 1e-6})
    scale, excluded = np.array([1.0, 0.5, 3.0]), np.array([0, 1, 2])
    bias_m, seen_m, sides = rng.normal(size=(epochs, 2)), rng.normal(0.0, 5.0, (epochs, 2)), rng.random((epochs, 2, n))
    bounds = rng.uniform(0.0, 20.0, (epochs, n)), rng.uniform(0.0, 1.0, (epochs, n))

    def options(rows: list[int]) -> dict[str, Any]:
        return {
            "risk": risk,
            "scale": scale[rows],
            "map_error": MapDeviation(bias_m[rows], (seen_m[rows], known[rows])),
            "sides": sides[rows] > 0.6,
            "n_excluded": excluded[rows],
            "overbound": RangeBounds(*(bound[rows] for bound in bounds)) if by_range else None,
        }

    compared: Counter[str] = Counter()
    whole = protection_level(linear_model(ranges, raim_cases.LINE, ARC), list(systems), **options([0, 1, 2]))
    for t in range(epochs):
        one = ranges.take(np.array([t]))
        compared += compare_hypotheses(one, systems, ARC[[t]], **options([t]))
        alone = protection_level(linear_model(one, raim_cases.LINE, ARC[[t]]), list(systems), **options([t]))
        assert whole.level_m[t] == pytest.approx(alone.level_m[0], rel=1e-9, nan_ok=True)
    assert {"0", "1", "2"} <= set(compared)
    if n > 6:
        assert {"shared 0", "shared 1", "map 0", "map 1"} <= set(compared), compared


@pytest.mark.parametrize("scale", [0.5, 1.0, 3.0])
def test_two_clocks_without_one_of_a_pair_leave_a_direction_free(scale: float) -> None:
    """Three of G, two of E, one of C, without the map: nothing bounds the place without a satellite of G or E.

    E and C tell their own clocks, so G and E give 2 + 1 differences for the three unknowns of the place. Without an E
    the two differences of G leave the cross product n of their rows free: any place along n fits alike. n is nearly
    abeam (0.0016 of it along the line), but any error along the line is possible, and sigma is infinite. A prior of
    10 km across and up gives 10 km times 0.0016, some 16 m, which no observation supports.
    """
    arc = ARC[:1]
    ranges = raim_cases.made(arc, "GGGEEC", seed=193, faults_m={1: 12.0})
    whitened = oracle.problem_on_line(ranges, 0, arc[0], raim_cases.LINE)
    rows = whitened.design[:6, :3] / whitened.scale_of[:3] * whitened.sigma_m[:, None]
    free = np.cross(rows[1] - rows[0], rows[2] - rows[0])
    free /= np.linalg.norm(free)
    assert abs(free[0]) == pytest.approx(0.001557, abs=1e-6)
    unknown = MapDeviation(seen=(np.zeros((1, 2)), np.zeros((1, 2, 2))))
    risk = RiskBudget(risk_per_hour=1e-3, local_prior=4e-3)
    _, asked, (channel, _, sigma, _, _) = recorded(ranges, "GGGEEC", arc, risk=risk, scale=scale, map_error=unknown)
    base = next(b for b in np.flatnonzero(asked.wrong_map) if not asked.members[0, b].any())
    assert asked.order[0, base] >= 1
    assert channel[0].tolist() == list(range(6))
    alone, with_one = sigma[0, asked.first[base, 0]], sigma[0, asked.first[base, 1] + np.arange(6)]
    determined = np.linalg.inv(np.stack([rows[1] - rows[0], rows[2] - rows[0], rows[4] - rows[3]]))[0]
    of_range = np.array([-determined[0] - determined[1], determined[0], determined[1], -determined[2], determined[2]])
    assert alone == pytest.approx(scale * np.linalg.norm(of_range * whitened.sigma_m[:5]), rel=1e-6)
    assert with_one[:5].tolist() == [np.inf] * 5
    assert with_one[5] == pytest.approx(alone, rel=1e-6)  # C tells its clock alone


def test_pair_of_a_clock_of_its_own_is_left_out_whole() -> None:
    """Each of the two is useless without the other: both gone is the same as one gone."""
    ranges = raim_cases.made(ARC[:1], "GGGGGGEE", seed=6, faults_m={7: 25.0})
    _, asked, (_, offset, sigma, _, _) = recorded(
        ranges, "GGGGGGEE", ARC[:1], risk=RiskBudget(risk_per_hour=1e-3, local_prior=4e-3)
    )
    pair = asked.first[0, 2] + list(combinations(range(8), 2)).index((6, 7))
    for one in (asked.first[0, 1] + 6, asked.first[0, 1] + 7):
        assert sigma[0, pair] == pytest.approx(sigma[0, one], rel=1e-9)
        assert offset[0, pair] == pytest.approx(offset[0, one], rel=1e-9)


def test_excluded_satellites_count_among_those_that_may_be_faulty() -> None:
    model = linear_model(raim_cases.made(ARC[:1], "GGGGGEEEE", seed=5), raim_cases.LINE, ARC[:1])
    risk = RiskBudget()
    spent = [protection_level(model, list("GGGGGEEEE"), risk=risk, n_excluded=e).unchecked_risk[0] for e in (0, 1, 2)]
    prior = risk.prior(list("GGGGGEEEE"))
    for e, value in enumerate(spent):
        everyone = [*prior, *[prior.max()] * e]
        assert value == pytest.approx(sum(a * b * c for a, b, c in combinations(everyone, 3)), rel=1e-9)
