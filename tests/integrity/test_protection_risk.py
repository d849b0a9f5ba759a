"""The risk: K against DO-229's constants, probabilities against counting every combination of faults."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from math import comb, prod

import numpy as np
import pytest
from scipy.stats import norm

import raim_cases
from protection_oracle import Event, hypotheses, kind_of, products
from railfix.core.errors import SettingsError
from railfix.integrity.protection import MOST_EXCLUDED, RiskBudget, k_factor
from railfix.integrity.protection.risk import FEW, allocate, set_sums

pytestmark = pytest.mark.requirement("C2")


def test_k_of_a_risk_on_both_sides_of_a_line():
    assert round(k_factor(1e-7), 3) == 5.327
    assert round(k_factor(1e-8), 2) == 5.73
    assert k_factor(1.0) == 0.0
    assert 2.0 * norm.sf(k_factor(3e-9)) == pytest.approx(3e-9, rel=1e-9)
    for risk in (0.0, -1.0, 1.1, np.nan):
        with pytest.raises(ValueError, match="a risk is a probability"):
            k_factor(risk)


def test_k_along_a_line_is_that_of_do_229_in_one_dimension():
    """Appendix J: 5.33 vertical (1e-7), 6.0 horizontal, precision approach (2e-9); 6.18 is of two dimensions."""
    assert round(k_factor(1e-7), 2) == 5.33
    assert round(k_factor(2e-9), 1) == 6.0
    assert k_factor(0.5e-7 / 10.0) < 6.18 - 0.3


def test_risk_of_an_hour_is_divided_among_its_samples():
    assert RiskBudget(risk_per_hour=1e-7, samples_per_hour=10.0).sample_k == pytest.approx(5.7307, abs=1e-4)
    assert RiskBudget().risk_per_sample == pytest.approx(1e-7 / 360)
    grow = RiskBudget(samples_per_hour=3600.0).sample_k - RiskBudget(samples_per_hour=10.0).sample_k
    assert grow == pytest.approx(0.9, abs=0.05)  # as the docstring says


def test_fault_probabilities_bound_what_counting_gives():
    rng = np.random.default_rng(2)
    for n in (1, 2, 3, 6, 9):
        prior = rng.uniform(0.0, 0.05, n)
        exact = np.zeros(n + 1)
        for state in product((0, 1), repeat=n):
            exact[sum(state)] += np.prod(np.where(state, prior, 1.0 - prior))
        assert exact[2:3].sum() <= set_sums(prior[None], 2)[0, 2] + 1e-15
        assert exact[3:].sum() <= set_sums(prior[None], 3)[0, 3] + 1e-15
        assert set_sums(prior[None], 3)[0, 3] <= 1.6 * exact[3:].sum() + 1e-15
    assert set_sums(np.full((1, 20), 2e-5), 3)[0, 3] == pytest.approx(1140 * 8e-15, rel=1e-9)


def test_every_set_that_could_be_left_together_spends_the_risk():
    risk = RiskBudget(exclusion_share=0.2)
    total = 12
    spent = risk.sample_risk(total, 0)
    spent += 12 * risk.sample_risk(total - 1, 1) + 66 * risk.sample_risk(total - 2, 2)
    assert spent == pytest.approx(risk.risk_per_sample, rel=1e-12)
    assert MOST_EXCLUDED == 2
    assert risk.sample_risk(9, 3) == 0.0
    assert risk.sample_risk([9, 9], [0, 1], 1.0).tolist() == [0.0, 0.0]


def test_priors_and_what_they_leave():
    risk = RiskBudget()
    assert risk.prior(list("GE")) == pytest.approx([2e-5, 4e-5])
    with pytest.raises(ValueError, match="constellation 'X'"):
        risk.prior(["X"])


@pytest.mark.parametrize(
    "wrong",
    [
        {"risk_per_hour": 0.0},
        {"risk_per_hour": np.nan},
        {"samples_per_hour": 0.0},
        {"fault_free_share": 0.5},
        {"two_fault_share": 0.0},
        {"exclusion_share": 0.5},
        {"false_alarm": 1.0},
        {"local_prior": -1e-5},
        {"satellite_prior": {"G": 1.0}},
        {"constellation_prior": {"G": np.nan}},
    ],
)
def test_budgets_that_are_refused(wrong):
    with pytest.raises(SettingsError, match=rf"{next(iter(wrong))}|fractions"):
        RiskBudget(**wrong)


def test_measured_priors_are_given():
    """Nothing else takes the word "assumed" from a level; default values do not count as measured."""
    with pytest.raises(SettingsError, match="requires local_prior and side_prior"):
        RiskBudget(priors="measured")
    with pytest.raises(SettingsError, match="requires side_prior"):
        RiskBudget(priors="measured", local_prior=2e-5)
    stated = RiskBudget(priors="measured", local_prior=2e-5, side_prior=3e-6)
    assert stated.replaced(map_prior=0.0).priors == "measured"


@pytest.mark.parametrize("of_side", [1e-7, 1e-4, 1e-3])
@pytest.mark.parametrize("of_constellation", [1e-6, 1e-3])
@pytest.mark.parametrize("wrong_map", [False, True])
@pytest.mark.parametrize("excluded", [0, 2])
@pytest.mark.parametrize("local", [1e-6, 3e-3, 3e-2])
def test_an_epoch_s_risk_is_divided_as_counting_every_set_says(
    local: float, excluded: int, of_constellation: float, of_side: float, *, wrong_map: bool
) -> None:
    """Faults that no hypothesis covers are taken off; the rest is shared; false alarms among all separations."""
    systems = "GGGEEECC"
    ranges = raim_cases.made(np.array([700.0]), systems, seed=3)
    weight = ranges.weight.copy()
    weight[0, 1] = 0.0
    _, model = raim_cases.solved(replace(ranges, weight=weight), np.array([700.0]))
    risk = RiskBudget(
        risk_per_hour=1e-4,
        samples_per_hour=100.0,
        local_prior=local,
        map_prior=1e-5,
        side_prior=of_side,
        constellation_prior={"E": of_constellation, "C": 3e-6, "R": 1e-5},
    )
    # Of the second side one satellite is used: no hypothesis.
    sides = np.zeros((1, 3, len(systems)), dtype=bool)
    sides[0, 0, [0, 2, 3]], sides[0, 1, [1, 4]], sides[0, 2, 5:] = True, True, True
    got = allocate(model, list(systems), risk, np.array([excluded]), sides, wrong_map=wrong_map)
    every = risk.prior(list(systems)).tolist()
    everyone = [p for c, p in enumerate(every) if c != 1]
    used, everyone = everyone, everyone + [max(every)] * excluded
    events = [Event("constellation", of_constellation, (3, 4, 5)), Event("constellation", 3e-6, (6, 7))]
    events += [Event("side", of_side, (0, 2, 3)), Event("side", of_side, (5, 6, 7))]
    events += [Event("map", 1e-5)] if wrong_map else []
    share = risk.unchecked_share * risk.risk_per_sample
    order, beyond = hypotheses(everyone, events, share, float(np.mean(every)))
    assert got.beyond[0] == pytest.approx(beyond, rel=1e-9, abs=0.0)
    assert (beyond <= share) == (local < 3e-2)  # five satellites at a time

    left = float(risk.sample_risk(7, excluded, beyond))
    more = any(k >= 0 and kind_of(shared) + k > 2 for shared, k in order.items())
    left *= 0.75 if more else 1.0
    assert [got.fault_free[0], got.one[0], got.two[0]] == pytest.approx([left / 3.0] * 3, rel=1e-9)
    assert got.more[0] == pytest.approx(left / 3.0 * more, rel=1e-9)
    pairs = order[()] > 2 or products(used, 2) > left / 3.0
    assert got.reserved[0] == pytest.approx(0.0 if pairs else products(used, 2), rel=1e-9)
    place = {0: events[0], 1: events[1], 2: events[2], 4: events[3]}
    expected = {tuple(map(id, s)): k for s, k in order.items() if s and k >= 0}
    found = {
        tuple(id(e) for e in [*map(place.__getitem__, s.events), *events[4 : 4 + s.wrong_map]]): k
        for s, k in zip(got.shared, got.order[0].tolist(), strict=True)
        if s.size
    }
    assert found == expected
    assert got.order[0, 0] == (order[()] if pairs else 1)
    unmapped = [k for s, k in zip(got.shared, got.order[0].tolist(), strict=True) if not s.wrong_map]
    tests = sum(comb(7, k) for most in unmapped for k in range(most + 1)) - 1
    assert got.k_false_alarm[0] == pytest.approx(norm.isf(risk.false_alarm / (2 * tests)), rel=1e-9)
    assert got.groups == ("E", "C")

    # All states counted one by one: what no hypothesis covers is not likelier than what was taken off.
    faults = np.array([1.0])
    for p in everyone:
        faults = np.convolve(faults, [1.0 - p, p])
    open_to_faults = 0.0
    for state in product((False, True), repeat=len(events)):
        shared = tuple(event for event, faulty in zip(events, state, strict=True) if faulty)
        p = prod(e.prior if faulty else 1.0 - e.prior for e, faulty in zip(events, state, strict=True))
        open_to_faults += p * faults[order.get(shared, -1) + 1 :].sum()
    assert open_to_faults <= beyond <= 1.7 * open_to_faults


def test_more_hypotheses_are_asked_for_only_where_the_rest_is_too_likely() -> None:
    """The usual priors: satellites, pairs, sides with one, both sides, a wrong map with one or a side, and no more."""
    systems = "G" * 9 + "E" * 9
    _, model = raim_cases.solved(raim_cases.made(np.array([700.0]), systems, seed=3), np.array([700.0]))
    sides = np.zeros((1, 2, 18), dtype=bool)
    sides[0, 0, :5], sides[0, 1, 9:14] = True, True

    def orders(**priors: object) -> dict[tuple[tuple[int, ...], bool], int]:
        got = allocate(model, list(systems), RiskBudget().replaced(**priors), np.array([0]), sides, wrong_map=True)
        return {(s.events, s.wrong_map): k for s, k in zip(got.shared, got.order[0].tolist(), strict=True)}

    usual = {((), False): 2, ((0,), False): 1, ((1,), False): 1, ((0, 1), False): 0}
    usual |= {((), True): 1, ((0,), True): 0, ((1,), True): 0}
    assert orders() == usual
    assert orders(local_prior=2e-4) == usual | {((), False): 3, ((), True): 2, ((0,), False): 2, ((1,), False): 2}
    assert orders(local_prior=5e-4)[(), False] == 4
    shared = orders(constellation_prior={"E": 1e-5})
    assert shared[(0,), True] == 0, "a constellation and a wrong map"
    assert shared[(0, 1), False] == 0, "a constellation and a side"


@pytest.mark.parametrize("length", [1, FEW, 24])
def test_the_risk_of_an_epoch_is_divided_alike_alone_and_among_others(length: int) -> None:
    """Epochs that differ in the satellites in use, in those excluded, or in the sides alone."""
    systems, count = "GGGGEEEEC", 24
    random = np.random.default_rng(4)
    arc = np.full(count, 700.0)
    ranges = raim_cases.made(arc, systems, seed=3)
    weight = ranges.weight.copy()
    weight[random.random(count) < 0.3, 1] = 0.0
    _, model = raim_cases.solved(replace(ranges, weight=weight), arc)
    out = random.integers(0, 3, count)
    sides = np.zeros((count, 2, len(systems)), dtype=bool)
    sides[:, 0, [0, 2]] = True
    sides[random.random(count) < 0.5, 0, 4] = True
    sides[random.random(count) < 0.5, 1, 5:8] = True
    risk = RiskBudget(local_prior=3e-3, side_prior=1e-4)
    names = "beyond fault_free one two more reserved k_false_alarm".split()
    alone = []
    for t in range(count):
        # a budget of its own, so that nothing is remembered
        got = allocate(model.take(np.array([t])), list(systems), RiskBudget(local_prior=3e-3, side_prior=1e-4),
                       out[[t]], sides[[t]], wrong_map=True)  # fmt: skip
        alone.append([getattr(got, name)[0] for name in names])
    assert len({tuple(row) for row in alone}) > 8
    for first in range(0, count, length):
        rows = np.arange(first, min(first + length, count))
        got = allocate(model.take(rows), list(systems), risk, out[rows], sides[rows], wrong_map=True)
        together = np.stack([getattr(got, name) for name in names], axis=1)
        np.testing.assert_allclose(together, [alone[t] for t in rows], rtol=1e-9)
