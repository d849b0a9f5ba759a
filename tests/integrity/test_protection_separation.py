"""Every subset left out, one by one against solving again: position, sigma, distance, biases; noise scales, ties."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import protection_oracle
import raim_oracle as oracle
from railfix.integrity.protection import RiskBudget, protection_level
from railfix.integrity.raim import linear_model
from railfix.positioning.range_arrays import UNTIED_M
from separation_oracle import (
    AllInView,
    Separations,
    all_in_view,
    without_group,
    without_map,
)

pytestmark = pytest.mark.requirement("C2")

ARC = np.array([731.0])
#: No least sigma, no bias of the ranges or the map.
EXACT = (np.zeros((1, 0)), np.zeros((1, 0)), np.zeros((1, 2)))
SYSTEMS = [
    ("GGGG", None),
    ("GGGGGEEE", None),
    ("GGGGGGEE", None),
    ("GGGEEC", None),
    ("GGGGEE", (0.0, 1.0)),
    ("GGGEECC", (0.0, 0.5, UNTIED_M)),
    ("GGGEEECCC", (0.0, 2.0, 0.7)),
]


def without(full: AllInView, *sets: tuple[int, ...]) -> Separations:
    """Sets of one size left out of all channels."""
    return without_group(full, None).without(np.array(sets, dtype=np.intp).reshape(len(sets), -1).T)


def compare(
    got: Separations,
    column: int,
    members: tuple[int, ...],
    solved: protection_oracle.Resolved,
    bias_m: np.ndarray,
) -> bool:
    """One subset against least squares of what is left; True where nothing determines the position."""
    case, answer = solved.case, solved.without(members)
    edge = 100.0 * solved.all.sigma_m
    if not answer.determined:
        assert got.sigma_m[0, column] > edge  # infinite, or so large that it gives no level
        return True
    distance, sigma = solved.apart(answer)
    if answer.sigma_m > edge:
        return False  # at the edge of what is determined
    assert got.sigma_m[0, column] == pytest.approx(answer.sigma_m, rel=1e-6)
    # A variance of the distance is a difference: it keeps half the digits.
    assert got.separation_sigma_m[0, column] == pytest.approx(sigma, rel=1e-5, abs=1e-6)
    assert got.moved_m[0, column] == pytest.approx(distance, rel=1e-5, abs=1e-6)
    bias = float((np.abs(answer.operator[: len(case.channels)]) * bias_m[case.channels] / case.sigma_m).sum())
    assert got.bias_m[0, column] == pytest.approx(bias, rel=1e-5, abs=1e-6)
    return False


@given(
    seed=st.integers(0, 2**32 - 1),
    system=st.sampled_from(SYSTEMS),
    scale=st.sampled_from([1.0, 0.5, 3.0]),
    fault=st.floats(-30.0, 30.0),
    least=st.sampled_from([None, 2.0, 20.0]),
)
@settings(max_examples=20)
def test_every_subset_equals_solving_without_it(seed, system, scale, fault, least):
    systems, ties = system
    ranges = oracle.made(ARC, systems, seed=seed, tie_sigma_m=ties, faults_m={1: fault, len(systems) - 1: 2.0})
    model = linear_model(ranges, oracle.LINE, ARC)
    n, bias = len(systems), np.random.default_rng(seed).uniform(0.0, 1.0, len(systems))
    bound = None if least is None else np.random.default_rng(seed + 1).uniform(0.0, least, n)
    solved = protection_oracle.Resolved(oracle.problem_on_line(ranges, 0, ARC[0]), scale, bound)
    if solved.all.sigma_m > 50.0:
        return
    least_sigma = np.zeros((1, 0)) if bound is None else bound[None]
    all_of = all_in_view(model, np.array([scale]), least_sigma, bias[None], np.zeros((1, 2)))
    assert all_of.sigma_m[0] == pytest.approx(solved.all.sigma_m, rel=1e-7)
    for size in range(1, 5):
        sets = list(combinations(range(n), size))[-12:]
        got = without(all_of, *sets)
        for k, some in enumerate(sets):
            compare(got, k, some, solved, bias)
    letters = [tuple(c for c, s in enumerate(systems) if s == letter) for letter in sorted(set(systems))]
    for group in ((0, 2), (1, 2, 3), tuple(range(0, n, 2)), *letters):
        rest = without_group(all_of, np.isin(np.arange(n), group)[None])
        others = [c for c in range(n) if c not in group]
        for size in (0, 1, 2):
            sets = list(combinations(others, size))[:4]
            if sets:
                got = rest.without(np.array(sets, dtype=np.intp).reshape(len(sets), -1).T)
                for k, some in enumerate(sets):
                    compare(got, k, tuple(sorted((*group, *some))), solved, bias)


@given(
    seed=st.integers(0, 2**32 - 1),
    system=st.sampled_from(SYSTEMS[1:]),
    scale=st.sampled_from([1.0, 0.5, 3.0]),
    seen=st.sampled_from([(0.0, 0.0), (4.5, -10.0), (-20.0, 37.0), None]),
)
@example(seed=193, system=SYSTEMS[3], scale=1.0, seen=None)
@settings(max_examples=30)
def test_a_map_left_out_equals_solving_with_what_takes_its_place(seed, system, scale, seen):
    """The offset of the last minutes in place of the map, or nothing; alone and without each satellite."""
    systems, ties = system
    ranges = oracle.made(ARC, systems, seed=seed, tie_sigma_m=ties, faults_m={1: 12.0})
    model = linear_model(ranges, oracle.LINE, ARC)
    case = oracle.problem_on_line(ranges, 0, ARC[0])
    before = protection_oracle.Resolved(case, scale)
    n, sigma = len(systems), np.array([2.0, 5.0])
    design, observed = case.design / scale, case.observed / scale
    # With nothing in place of the map its rows are gone: a prior of any size, however wide, would bound the place.
    design[[n, n + 1], [1, 2]] = 0.0 if seen is None else case.scale_of[1:3] / sigma
    observed[n : n + 2] = np.array(seen or (0.0, 0.0)) / sigma
    solved = protection_oracle.Resolved(replace(case, design=design, observed=observed), 1.0)
    if before.all.sigma_m > 50.0:
        return
    bias = np.random.default_rng(seed).uniform(0.0, 1.0, n)
    information = np.zeros((1, 2, 2)) if seen is None else np.diag(sigma**-2.0)[None]
    full = all_in_view(model, np.array([scale]), np.zeros((1, 0)), bias[None], np.zeros((1, 2)))
    free = without_map(full, model, np.array([seen or (0.0, 0.0)]), information)
    ones, twos = [(c,) for c in range(n)], list(combinations(range(n), 2))
    alone, with_one, with_two = (free.apart(without(free.of_ranges, *sets)) for sets in ([()], ones, twos))
    for got, column, answer in [
        (alone, 0, solved.all),
        *((with_one, c, solved.without((c,))) for c in range(n)),
        *((with_two, k, solved.without(pair)) for k, pair in enumerate(twos)),
    ]:
        if not answer.determined:  # infinite, or by two satellites so large that it gives no level
            assert got.sigma_m[0, column] > (100.0 * before.all.sigma_m if got is with_two else 1e12)
            continue
        if answer.sigma_m > 20.0:
            continue
        effect = float((np.abs(answer.operator[:n]) * bias / (scale * case.sigma_m)).sum())
        assert got.sigma_m[0, column] == pytest.approx(answer.sigma_m, rel=1e-3)
        assert got.bias_m[0, column] == pytest.approx(
            abs(answer.place_m - before.all.place_m) + effect, rel=1e-3, abs=1e-3
        )
        assert got.moved_m[0, column] == got.separation_sigma_m[0, column] == 0.0


@pytest.mark.parametrize("scale", [0.5, 1.0, 3.0])
def test_two_clocks_without_one_of_a_pair_leave_a_direction_free(scale):
    """Three of G, two of E, one of C, without the map: nothing bounds the place without a satellite of G or E.

    E and C tell their own clocks, so G and E give 2 + 1 differences for the three unknowns of the place. Without an E
    the two differences of G leave the cross product n of their rows free: any place along n fits alike. n is nearly
    abeam (0.0016 of it along the line), but any error along the line is possible, and sigma is infinite. A prior of
    10 km across and up gives 10 km times 0.0016, some 16 m, which no observation supports.
    """
    ranges = oracle.made(ARC, "GGGEEC", seed=193, faults_m={1: 12.0})
    model = linear_model(ranges, oracle.LINE, ARC)
    whitened = oracle.problem_on_line(ranges, 0, ARC[0])
    rows = whitened.design[:6, :3] / whitened.scale_of[:3] * whitened.sigma_m[:, None]
    free = np.cross(rows[1] - rows[0], rows[2] - rows[0])
    free /= np.linalg.norm(free)
    assert abs(free[0]) == pytest.approx(0.001557, abs=1e-6)
    full = all_in_view(model, np.array([scale]), *EXACT)
    free_of_map = without_map(full, model, np.zeros((1, 2)), np.zeros((1, 2, 2)))
    ones = [(c,) for c in range(6)]
    alone, with_one = (free_of_map.apart(without(free_of_map.of_ranges, *sets)) for sets in ([()], ones))
    determined = np.linalg.inv(np.stack([rows[1] - rows[0], rows[2] - rows[0], rows[4] - rows[3]]))[0]
    of_range = np.array([-determined[0] - determined[1], determined[0], determined[1], -determined[2], determined[2]])
    assert alone.sigma_m[0, 0] == pytest.approx(scale * np.linalg.norm(of_range * whitened.sigma_m[:5]), rel=1e-6)
    assert with_one.sigma_m[0, :5].tolist() == [np.inf] * 5
    assert with_one.sigma_m[0, 5] == pytest.approx(alone.sigma_m[0, 0], rel=1e-6)  # C tells its clock alone


def test_subsets_that_leave_no_position_are_found():
    """Three of one clock: without two of them one is left."""
    bias = np.zeros(3)
    ranges = oracle.made(ARC, "GGG", seed=4)
    model = linear_model(ranges, oracle.LINE, ARC)
    solved = protection_oracle.Resolved(oracle.problem_on_line(ranges, 0, ARC[0]), 1.0)
    pairs = list(combinations(range(3), 2))
    twos = without(all_in_view(model, np.ones(1), *EXACT), *pairs)
    assert [compare(twos, k, pair, solved, bias) for k, pair in enumerate(pairs)] == [True] * 3


def test_pair_of_a_clock_of_its_own_is_left_out_whole():
    """Each of the two is useless without the other: both gone is the same as one gone."""
    ranges = oracle.made(ARC, "GGGGGGEE", seed=6, faults_m={7: 25.0})
    model = linear_model(ranges, oracle.LINE, ARC)
    all_of = all_in_view(model, np.ones(1), *EXACT)
    pair, one = without(all_of, (6, 7)), without(all_of, *((c,) for c in range(8)))
    assert pair.moved_m[0, 0] == pytest.approx(one.moved_m[0, 6], rel=1e-9)
    assert pair.sigma_m[0, 0] == pytest.approx(one.sigma_m[0, 7], rel=1e-9)
    assert abs(pair.moved_m[0, 0]) > 0.1
    assert np.isfinite(protection_level(model, list("GGGGGGEE")).level_m[0])


def test_excluded_satellites_count_among_those_that_may_be_faulty():
    model = linear_model(oracle.made(ARC, "GGGGGEEEE", seed=5), oracle.LINE, ARC)
    risk = RiskBudget()
    spent = [protection_level(model, list("GGGGGEEEE"), risk=risk, n_excluded=e).unchecked_risk[0] for e in (0, 1, 2)]
    prior = risk.prior(list("GGGGGEEEE"))
    for e, value in enumerate(spent):
        everyone = [*prior, *[prior.max()] * e]
        assert value == pytest.approx(sum(a * b * c for a, b, c in combinations(everyone, 3)), rel=1e-9)
