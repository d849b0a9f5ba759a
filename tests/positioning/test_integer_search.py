"""Integer least squares against every integer vector of a box, and against a known one of many unknowns."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from railfix.positioning.standstill_phase import IntegerSearch

pytestmark = pytest.mark.requirement("E6")


@pytest.mark.parametrize("seed", [*range(15), *(pytest.param(s, marks=pytest.mark.slow) for s in range(15, 40))])
def test_nearest_vectors_are_those_of_a_full_search(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 5))
    mixed = rng.normal(size=(n, 3)) * rng.uniform(0.3, 2.0)
    covariance = mixed @ mixed.T + np.eye(n) * rng.uniform(0.01, 0.1)
    cycles = rng.normal(size=n) * 3.0
    integers, squares = IntegerSearch(covariance).nearest(cycles, 4)
    box = np.array(list(itertools.product(range(-7, 8), repeat=n))) + np.round(cycles)
    left = box - cycles
    every = np.einsum("ij,jk,ik->i", left, np.linalg.inv(covariance), left)
    best = np.argsort(every)[: len(squares)]
    assert squares == pytest.approx(every[best], rel=1e-6)
    assert np.array_equal(integers, box[best])
    assert len(squares) == 4 or every[np.argsort(every)[len(squares)]] > squares[0] + 40.0
    below = float(squares[0]) * 0.99
    assert len(IntegerSearch(covariance).nearest(cycles, 4, below=below)[1]) == 0


def test_thirty_correlated_unknowns_are_found() -> None:
    """Double differences of a place known to a metre: the real vector is cycles off, the integers are found."""
    rng = np.random.default_rng(1)
    away = rng.normal(size=(30, 3))
    covariance = 25.0 * away @ away.T + 0.003 * np.eye(30)
    truth = rng.integers(-50, 50, 30)
    cycles = truth + away @ rng.normal(0.0, 5.0, 3) + rng.normal(0.0, 0.05, 30)
    assert np.abs(cycles - truth).max() > 3.0
    assert np.array_equal(IntegerSearch(covariance).nearest(cycles, 1)[0][0], truth)
