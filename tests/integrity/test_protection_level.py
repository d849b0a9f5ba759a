"""Level along the track: by hand, and against deleting rows and solving every subset again."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

import protection_oracle
import raim_cases
import raim_oracle as oracle
from railfix.integrity.protection import Cause, LevelStatus, ProtectionLevel, RiskBudget, availability, protection_level
from railfix.integrity.protection.solution_separation import MapDeviation, RangeBounds
from railfix.integrity.raim import LinearModel, linear_model
from raim_cases import point_model

pytestmark = pytest.mark.requirement("C2")

ARC = np.array([731.0])
#: A risk whose parts are all asked for, and leave figures that can be followed.
HAND = RiskBudget(
    risk_per_hour=1e-4,
    samples_per_hour=1.0,
    exclusion_share=0.0,
    false_alarm=0.01,
    satellite_prior={"G": 0.008, "E": 0.006, "C": 0.009},
    local_prior=0.002,
)
#: Direction cosines of the five satellites along the track.
COSINE = (0.8, -0.8, 0.4, -0.4, 0.0)


def hand_model(error_m: tuple[float, ...]) -> LinearModel:
    """Five satellites of one clock, 1 m each, none sees the map error."""
    design = np.zeros((1, 5, 3))
    design[0, :, 0] = COSINE
    return LinearModel(
        root_weight=np.ones((1, 5)),
        clock=np.zeros(5, dtype=np.intp),
        clock_covariance_m2=np.full((1, 1, 1), 0.2),
        design=design,
        covariance_m2=np.diag([1.0 / 1.6, 0.09, 0.36])[None],
        prior=np.diag([0.0, 1.0 / 0.09, 1.0 / 0.36]),
        misfit=np.array([error_m]),
        freedom=np.array([3]),
        interest=1,
    )


def test_case_worked_by_hand():
    """docs/protection-level.md follows these figures."""
    got = protection_level(hand_model((3.0, 0.0, 0.0, 0.0, 0.0)), list("GGGGG"), risk=HAND)
    assert got.sigma_m[0] == pytest.approx(np.sqrt(0.625), abs=1e-12)
    assert got.unchecked_risk[0] == pytest.approx(1e-5, rel=1e-9)  # 10 triples of 0.01^3
    # 9e-5 left, 3e-5 for each part.
    assert got.k_fault_free[0] == pytest.approx(norm.isf(1.5e-5), abs=1e-9)
    assert got.k_one_fault[0] == pytest.approx(norm.isf(6e-4), abs=1e-9)  # 3e-5 over 5 of 0.01
    assert got.k_two_faults[0] == pytest.approx(norm.isf(0.03), abs=1e-9)  # 3e-5 over 10 of 0.0001
    assert got.k_false_alarm[0] == pytest.approx(norm.isf(0.01 / 30), abs=1e-9)
    assert [round(float(k[0]), 3) for k in (got.k_fault_free, got.k_one_fault, got.k_two_faults)] == [
        4.173,
        3.239,
        1.881,
    ]
    # Without satellite 1: 1/0.8 = 1.25 m^2, of which 0.625 is the separation. Without 1 and 2: 1/0.32.
    assert got.fault_free_m[0] == pytest.approx(norm.isf(1.5e-5) * np.sqrt(0.625), abs=1e-9)
    assert got.one_fault_m[0] == pytest.approx(
        norm.isf(0.01 / 30) * np.sqrt(0.625) + norm.isf(6e-4) * np.sqrt(1.25), abs=1e-9
    )
    assert got.two_fault_m[0] == pytest.approx(
        norm.isf(0.01 / 30) * np.sqrt(2.5) + norm.isf(0.03) * np.sqrt(3.125), abs=1e-9
    )
    parts = (got.fault_free_m, got.one_fault_m, got.two_fault_m, got.level_m)
    assert [round(float(part[0]), 2) for part in parts] == [3.30, 6.31, 8.71, 6.45]
    # At the level the tails of all sixteen hypotheses use up the 9e-5 (to the share of it that is left over).
    information = np.array([1.6, 0.8, 0.8, 1.4, 1.4, 1.6, 0.32, 0.32, 0.32, *[11.2 / 15] * 4, 1.28, *[20.8 / 15] * 2])
    weight = np.array([2.0, *[0.01] * 5, *[1e-4] * 10])
    sigma = np.sqrt(1.0 / information)
    threshold = norm.isf(0.01 / 30) * np.sqrt(np.maximum(sigma**2 - 0.625, 0.0))
    spent = weight * norm.sf((got.level_m[0] - threshold) / sigma)
    assert 0.995 * 9e-5 < spent.sum() <= 9e-5
    assert [round(1e5 * float(part.sum()), 1) for part in (spent[:1], spent[1:6], spent[6:])] == [0.0, 0.8, 8.2]
    assert got.worst_one[0] in (0, 1)
    assert tuple(got.worst_two[0]) in ((0, 1), (0, 2), (1, 3))
    assert got.cause[0] == Cause.TWO_FAULTS
    # 3 m on satellite 1 move the position by 0.8 * 3/1.6 = 1.5 m; without it 0: 1.5 m against 3.403 * 0.791 m.
    assert got.consistent[0]
    assert got.separation[0] == pytest.approx(1.5 / (norm.isf(0.01 / 30) * np.sqrt(0.625)), abs=1e-9)
    off = protection_level(hand_model((6.0, 0.0, 0.0, 0.0, 0.0)), list("GGGGG"), risk=HAND)
    assert not off.consistent[0]
    assert off.separation[0] == pytest.approx(2.0 * got.separation[0], abs=1e-9)
    assert availability(off.level_m, 20.0, consistent=off.consistent)[0] == LevelStatus.ALARM


def test_epochs_without_a_position_and_beyond_the_budget_have_no_level():
    arc = np.where(np.arange(8) == 3, np.nan, np.linspace(200.0, 1800.0, 8))
    model = linear_model(raim_cases.made(np.linspace(200.0, 1800.0, 8), "GGGGGGEEEECC", seed=8), raim_cases.LINE, arc)
    got = protection_level(model, list("GGGGGGEEEECC"), n_excluded=np.arange(8) % 4)
    assert np.isnan(got.level_m).tolist() == [t == 3 for t in range(8)]
    assert np.isinf(got.level_m).tolist() == [t == 7 for t in range(8)]
    assert [Cause(got.cause[t]) for t in (3, 7)] == [Cause.NO_POSITION, Cause.BUDGET]
    assert not got.consistent[3]
    assert len(protection_level(model.take(np.zeros(0, dtype=int)), list("GGGGGGEEEECC")).level_m) == 0


def kinds_of_faults(systems: str) -> tuple[LinearModel, dict[str, Any]]:
    """Twelve epochs with every kind of hypothesis: some with sides, pairs of sides, triples, a known map offset."""
    arc, n, rng = np.linspace(200.0, 1800.0, 12), len(systems), np.random.default_rng(4)
    ranges = raim_cases.made(arc, systems, seed=8, faults_m={1: 9.0})
    weight = ranges.weight * (rng.random(ranges.weight.shape) > 0.15)
    model = linear_model(replace(ranges, weight=weight), raim_cases.LINE, arc)
    sides = rng.random((12, 2, n)) > 0.7
    sides[::3] = False
    options: dict[str, Any] = {
        "risk": RiskBudget(
            risk_per_hour=1e-3, local_prior=1e-3, side_prior=1e-3, constellation_prior={"E": 1e-7, "C": 1e-6}
        ),
        "scale": np.linspace(0.6, 2.0, 12),
        "overbound": RangeBounds(rng.uniform(0.0, 4.0, (12, n)), rng.uniform(0.0, 1.0, (12, n))),
        "map_error": MapDeviation(
            rng.normal(size=(12, 2)),
            (
                rng.normal(size=(12, 2)),
                np.tile(np.diag([0.1, 0.01]), (12, 1, 1)) * (rng.random(12) > 0.3)[:, None, None],
            ),
        ),
        "sides": sides,
        "n_excluded": np.arange(12) % 3,
    }
    return model, options


def at(options: dict[str, Any], t: int) -> dict[str, Any]:
    """Options of one epoch."""
    one = {name: value[t : t + 1] for name, value in options.items() if isinstance(value, np.ndarray)}
    bias, seen = options["map_error"]
    error = MapDeviation(bias[t : t + 1], tuple(values[t : t + 1] for values in seen))
    return {
        **options,
        **one,
        "overbound": RangeBounds(*(v[t : t + 1] for v in options["overbound"])),
        "map_error": error,
    }


@pytest.mark.parametrize("systems", ["GGGGEEEECCCR", "GGGGGGGEEEEEECCCC"])
def test_epochs_have_the_same_levels_together_and_alone(systems):
    """Hypotheses that only some epochs of a block ask for have no effect on the others."""
    model, options = kinds_of_faults(systems)
    whole, finite = protection_level(model, list(systems), **options), 0
    for t in range(12):
        alone = protection_level(model.take(np.array([t])), list(systems), **at(options, t))
        for name in ProtectionLevel.__dataclass_fields__:
            mine, own = getattr(whole, name)[t : t + 1], getattr(alone, name)
            if mine.dtype == float:
                np.testing.assert_allclose(mine, own, rtol=1e-9, err_msg=name)
            else:
                np.testing.assert_array_equal(mine, own, err_msg=name)
        finite += int(np.isfinite(whole.level_m[t]))
    assert finite > 2


@pytest.mark.parametrize("systems", ["GGGGEEEECCCR", "GGE", "GGGGEC"])
@pytest.mark.parametrize("factor", [1e-4, 1e5])
def test_levels_have_the_unit_of_the_sigmas(systems, factor):
    """Ranges and map in another unit: the same levels in that unit, and what nothing checks stays so."""
    model, options = kinds_of_faults(systems)
    other = replace(
        model,
        root_weight=model.root_weight / factor,
        clock_covariance_m2=model.clock_covariance_m2 * factor**2,
        design=model.design / factor,
        covariance_m2=model.covariance_m2 * factor**2,
        prior=model.prior / factor**2,
    )
    error = options["map_error"]
    metres = {
        "overbound": RangeBounds(*(factor * values for values in options["overbound"])),
        "map_error": MapDeviation(factor * error.bias_m, (factor * error.seen[0], error.seen[1] / factor**2)),
    }
    one = protection_level(model, list(systems), **options)
    two = protection_level(other, list(systems), **{**options, **metres})
    for name in ("level_m", "fault_free_m", "one_fault_m", "two_fault_m", "sigma_m"):
        np.testing.assert_allclose(getattr(two, name), factor * getattr(one, name), rtol=1e-6, err_msg=name)
    np.testing.assert_allclose(two.separation, one.separation, rtol=1e-6)
    np.testing.assert_array_equal(two.cause, one.cause)


def test_the_worst_hypothesis_is_named_by_its_channels_or_its_constellation():
    few = linear_model(raim_cases.made(ARC, "GGGGGCCEE", seed=5), raim_cases.LINE, ARC)
    of_one = protection_level(few, list("GGGGGCCEE"), risk=RiskBudget(constellation_prior={"C": 1e-12, "E": 1e-12}))
    assert of_one.worst_one[0] >= 0
    assert of_one.worst_constellation[0] == ""
    model = linear_model(raim_cases.made(ARC, "GGGGGEEEEE", seed=5), raim_cases.LINE, ARC)
    many = linear_model(raim_cases.made(ARC, "GGGGGGGEEE", seed=5), raim_cases.LINE, ARC)
    of_all = protection_level(many, list("GGGGGGGEEE"), risk=RiskBudget(constellation_prior={"G": 1e-8}))
    assert (of_all.worst_one[0], of_all.worst_constellation[0]) == (-1, "G")
    rare = RiskBudget(satellite_prior=dict.fromkeys("GE", 1e-8), local_prior=0.0)
    assert protection_level(model, list("GGGGGEEEEE"), risk=rare).worst_two[0].tolist() == [-1, -1]


def test_satellite_that_nothing_checks_makes_the_level_infinite_unless_negligible():
    # Two satellites of one clock fix the position: either fault is invisible.
    ranges = raim_cases.only(raim_cases.made(ARC, "GGGEEE", seed=2), [0, 3])
    model = linear_model(raim_cases.only(raim_cases.made(ARC, "GGGEEE", seed=2), [0, 1]), raim_cases.LINE, ARC)
    got = protection_level(model, list("GGGEEE"))
    assert np.isinf(got.level_m[0])
    assert got.cause[0] == Cause.UNCHECKED
    rare = HAND.replaced(satellite_prior={"G": 1e-7, "E": 1e-7}, local_prior=0.0)
    small = protection_level(model, list("GGGEEE"), risk=rare)
    assert small.level_m[0] <= small.fault_free_m[0] < np.inf
    assert small.level_m[0] > small.sigma_m[0] * norm.isf(1e-4 / 2.0)  # the whole risk spent on noise
    assert small.k_one_fault[0] == -np.inf
    nothing = protection_level(linear_model(ranges, raim_cases.LINE, ARC), list("GGGEEE"))
    assert np.isnan(nothing.level_m[0])


@pytest.mark.parametrize(
    ("systems", "common"),
    [
        ("GGE", 1e-5),  # without either G no position: singles that nothing checks; E is likely, and useless
        ("GGGE", 2e-3),  # without two G no position: pairs that nothing checks, beside likely ones that are
    ],
)
def test_what_nothing_checks_is_taken_off_the_risk(systems, common):
    ranges = raim_cases.made(ARC, systems, seed=4)
    model, case = linear_model(ranges, raim_cases.LINE, ARC), oracle.problem_on_line(ranges, 0, ARC[0], raim_cases.LINE)
    budget = HAND.replaced(satellite_prior={"G": common, "E": 0.3}, local_prior=0.0)
    expected = protection_oracle.level(
        case, dict(enumerate(budget.prior(list(systems)))), risk_per_sample=1e-4, share=1 / 3, false_alarm=0.01
    )
    got = protection_level(model, list(systems), risk=budget)
    assert expected.level_m * (1.0 - 1e-7) <= got.level_m[0] <= 1.003 * expected.level_m < np.inf


def test_excluded_satellites_raise_the_level():
    ranges = raim_cases.made(ARC, "GGGGGEEEE", seed=5)
    model = linear_model(ranges, raim_cases.LINE, ARC)
    levels = [protection_level(model, list("GGGGGEEEE"), n_excluded=e) for e in range(4)]
    assert levels[0].level_m[0] < levels[1].level_m[0] < levels[2].level_m[0] < np.inf
    assert np.isinf(levels[3].level_m[0])
    never = protection_level(model, list("GGGGGEEEE"), risk=RiskBudget(exclusion_share=0.0), n_excluded=1)
    assert never.cause[0] == Cause.BUDGET


def test_constellation_fault_that_nothing_checks():
    """All satellites of one constellation: without it there is no position."""
    model = linear_model(raim_cases.made(ARC, "GGGGGG", seed=5), raim_cases.LINE, ARC)
    got = protection_level(model, list("GGGGGG"), risk=RiskBudget(constellation_prior={"G": 1e-4}))
    assert got.cause[0] == Cause.UNCHECKED_CONSTELLATION
    assert got.worst_constellation[0] == "G"
    # Without the map six satellites of one constellation are enough, five less one are not: a map and a satellite.
    known = (np.zeros((1, 2)), np.zeros((1, 2, 2)))
    few = linear_model(raim_cases.made(ARC, "GGGGG", seed=5), raim_cases.LINE, ARC)
    free = protection_level(
        few, list("GGGGG"), risk=RiskBudget(map_prior=1e-2, local_prior=1e-4), map_error=MapDeviation(seen=known)
    )
    assert free.cause[0] == Cause.UNCHECKED_MAP
    wide = linear_model(raim_cases.made(ARC, "GGGGGEEEEE", seed=5), raim_cases.LINE, ARC)
    priors = RiskBudget(map_prior=1e-2, constellation_prior={"G": 1e-5}, unchecked_share=1e-3)
    four = raim_cases.only(raim_cases.made(ARC, "GGGGGEEEEE", seed=5), [0, 1, 2, 3, 4, 5, 6, 7])
    both = protection_level(
        linear_model(four, raim_cases.LINE, ARC), list("GGGGGEEEEE"), risk=priors, map_error=MapDeviation(seen=known)
    )
    assert both.cause[0] == Cause.UNCHECKED_TOGETHER
    assert np.isfinite(
        protection_level(wide, list("GGGGGEEEEE"), risk=priors, map_error=MapDeviation(seen=known)).level_m[0]
    )
    both = linear_model(raim_cases.made(ARC, "GGGGGGEEEEE", seed=5), raim_cases.LINE, ARC)
    ok = protection_level(both, list("GGGGGGEEEEE"), risk=RiskBudget(constellation_prior={"G": 1e-8}))
    assert np.isfinite(ok.level_m[0])


def test_refusals():
    model = linear_model(raim_cases.made(ARC, "GGGGG", seed=5), raim_cases.LINE, ARC)
    with pytest.raises(ValueError, match="5 channels, got 4"):
        protection_level(model, list("GGGG"))
    with pytest.raises(ValueError, match="constellation 'X'"):
        protection_level(model, list("GGGGX"))
    with pytest.raises(ValueError, match="scale must be positive"):
        protection_level(model, list("GGGGG"), scale=0.0)
    with pytest.raises(ValueError, match="must not be negative"):
        protection_level(model, list("GGGGG"), n_excluded=-1)
    space = point_model(raim_cases.made(ARC, "GGGGG", seed=5), raim_cases.LINE.at_arc(ARC))
    with pytest.raises(ValueError, match="a model of positions on the line"):
        protection_level(space, list("GGGGG"))


def test_status():
    level = np.array([19.0, 20.0, 21.0, np.inf, np.nan, 5.0, np.inf, np.nan])
    consistent = np.array([True, True, True, True, True, False, False, False])
    got = availability(level, 20.0, consistent=consistent)
    assert [LevelStatus(s).name for s in got] == [
        "AVAILABLE",
        "AVAILABLE",
        "UNAVAILABLE",
        "UNAVAILABLE",
        "UNAVAILABLE",
        "ALARM",
        "ALARM",
        "UNAVAILABLE",
    ]
    assert availability(0.5, 0.5) == LevelStatus.AVAILABLE
    with pytest.raises(ValueError, match="positive"):
        availability(level, 0.0)
