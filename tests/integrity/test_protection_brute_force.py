"""Errors drawn against the level. The long version with 1e7 epochs a case is slow; the table is in the documents."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import poisson

from protection_brute_force import (
    BUDGETS,
    HOURLY,
    OFTEN,
    SHRUNK,
    Count,
    Weighted,
    analytic,
    excluding,
    simulate,
    summed_levels,
    whole_risk,
)

pytestmark = pytest.mark.requirement("C2")

NOISE = "no fault, K sigma alone"


def check(counts: dict[str, Count]) -> None:
    """No case beyond what chance reaches at the allowed rate; and the same test on a shrunk level fails."""
    for kind, c in counts.items():
        assert c.found <= c.most, f"{kind}: {c.found} of {c.draws}, allowed {c.allowed:.1f}, chance reaches {c.most}"
    # Noise alone is exact: not fewer either.
    noise = counts[NOISE]
    assert poisson.cdf(noise.found, noise.allowed) > 1e-4
    for kind in ("one fault", "two faults"):
        assert max(c.shrunk[SHRUNK.index(0.8)] / c.most for name, c in counts.items() if name.startswith(kind)) > 1.0
    assert noise.shrunk[SHRUNK.index(0.9)] > noise.most


@pytest.mark.parametrize("name", list(BUDGETS)[:2])
def test_drawn_errors_keep_within_the_level(name):
    check(simulate(150, 800, 3, BUDGETS[name]))


@pytest.mark.slow
@pytest.mark.parametrize("name", list(BUDGETS))
def test_ten_million_drawn_errors_keep_within_the_level(name):
    counts = simulate(2400, 5000, 17, BUDGETS[name])
    assert counts[NOISE].draws > 1e7
    check(counts)


def test_tails_at_the_risk_of_an_hour():
    """1e-7 cannot be drawn; the Gaussian probabilities of all hypotheses at their worst sizes can be added up."""
    total = analytic(250, 29, HOURLY)
    assert total.geometries > 200
    assert total.largest <= 1.0
    assert analytic(250, 29, HOURLY, 0.9).median > 1.0


def test_level_is_where_the_tails_are_the_risk():
    over_level, over_parts = summed_levels(250, 29, HOURLY).T
    assert over_level.max() <= 1.0 + 1e-9
    assert over_level.min() > 0.998
    assert np.median(over_parts) < 0.9  # what the sum saves against the largest of the parts


def check_whole(got: Weighted) -> None:
    assert got.share() + 4.0 * got.spread <= 1.0
    assert got.share(1 + SHRUNK.index(0.8)) > 1.0


@pytest.mark.slow
def test_all_hypotheses_together_keep_within_the_risk():
    check_whole(whole_risk(200, 800, 3, BUDGETS["1e-5, prior 1.7e-3"]))


@pytest.mark.slow
@pytest.mark.parametrize("name", list(BUDGETS)[1:])
def test_ten_million_epochs_of_all_hypotheses_keep_within_the_risk(name):
    got = whole_risk(2400, 5000, 23, BUDGETS[name])
    assert got.epochs > 1e7
    check_whole(got)


@pytest.mark.slow
def test_exclusion_at_work_keeps_within_the_risk():
    got = excluding(6000, 5, OFTEN)
    assert got.excluded[1] > 1000
    assert got.risk(got.misled) + 3.0 * np.sum(got.probability / got.draws) <= OFTEN.risk_per_sample
    assert got.risk(got.careless) > OFTEN.risk_per_sample  # a level that knows of no faults does not
