"""The smoother along a chain against dense algebra, a hand-written Kalman smoother, and the Brownian bridge."""

from __future__ import annotations

import numpy as np
import pytest

from railfix.motion.chain import Chain

pytestmark = pytest.mark.requirement("D1")


def random_chain(count: int, unknowns: int, seed: int) -> Chain:
    random = np.random.default_rng(seed)
    chain = Chain.empty(count, unknowns)
    if count > 1:
        step = random.normal(size=(2, count - 1, unknowns, unknowns))
        root = random.normal(size=(count - 1, unknowns, unknowns))
        weight = root @ np.swapaxes(root, 1, 2) + np.eye(unknowns)
        chain = chain.with_steps(step[0], step[1], random.normal(size=(count - 1, unknowns)), weight)
    for _ in range(unknowns):
        rows = np.arange(count)
        chain = chain.with_observations(
            rows, random.normal(size=(count, unknowns)), random.normal(size=count), np.full(count, 0.3)
        )
    return chain


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 13, 64, 101])
@pytest.mark.parametrize("unknowns", [1, 3])
def test_the_chain_is_the_dense_solution(count: int, unknowns: int) -> None:
    chain = random_chain(count, unknowns, seed=count)
    size = count * unknowns
    dense = np.zeros((count, unknowns, count, unknowns))
    for k in range(count):
        dense[k, :, k, :] = chain.diagonal[k]
    for k in range(count - 1):
        dense[k, :, k + 1, :] = chain.upper[k]
        dense[k + 1, :, k, :] = chain.upper[k].T
    inverse = np.linalg.inv(dense.reshape(size, size))
    value, covariance = chain.solve()
    np.testing.assert_allclose(value.ravel(), inverse @ chain.right.ravel(), rtol=1e-7, atol=1e-9)
    expected = inverse.reshape(count, unknowns, count, unknowns)[np.arange(count), :, np.arange(count), :]
    np.testing.assert_allclose(covariance, expected, rtol=1e-7, atol=1e-9)


def test_a_random_walk_between_two_fixes_is_the_brownian_bridge() -> None:
    """The closing error is shared in proportion to the variance, the standard deviation is largest halfway."""
    count, q, closing = 61, 0.04, 3.0
    chain = Chain.empty(count, 1)
    one = np.ones((count - 1, 1, 1))
    chain = chain.with_steps(-one, one, np.full((count - 1, 1), 10.0), one / q)
    ends = np.array([0, count - 1])
    chain = chain.with_observations(ends, np.ones(1), np.array([0.0, 600.0 + closing]), np.full(2, 1e12))
    value, covariance = chain.solve()
    k = np.arange(count)
    np.testing.assert_allclose(value[:, 0], 10.0 * k + closing * k / 60.0, atol=1e-6)
    np.testing.assert_allclose(covariance[:, 0, 0], q * k * (60 - k) / 60.0, atol=1e-6)
    assert np.argmax(covariance[:, 0, 0]) == 30


def test_position_and_speed_as_a_forward_backward_smoother() -> None:
    """Rauch, Tung and Striebel by the book, one instant after the other."""
    random = np.random.default_rng(5)
    count, dt = 40, 0.5
    step = np.array([[1.0, dt], [0.0, 1.0]])
    noise = 0.3 * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
    seen = random.random(count) < 0.4
    seen[[0, -1]] = True
    z = random.normal(size=count) + np.arange(count)
    x, p = np.zeros(2), np.diag([100.0, 100.0])
    before, after = [], []
    for k in range(count):
        if k:
            x, p = step @ x, step @ p @ step.T + noise
        before.append((x, p))
        if seen[k]:
            gain = p[:, 0] / (p[0, 0] + 0.04)
            x, p = x + gain * (z[k] - x[0]), p - np.outer(gain, p[0])
        after.append((x, p))
    smooth = [after[-1]]
    for k in range(count - 2, -1, -1):
        g = after[k][1] @ step.T @ np.linalg.inv(before[k + 1][1])
        x = after[k][0] + g @ (smooth[0][0] - before[k + 1][0])
        smooth.insert(0, (x, after[k][1] + g @ (smooth[0][1] - before[k + 1][1]) @ g.T))
    chain = Chain.empty(count, 2)
    chain = chain.with_steps(
        np.broadcast_to(-step, (count - 1, 2, 2)),
        np.broadcast_to(np.eye(2), (count - 1, 2, 2)),
        np.zeros((count - 1, 2)),
        np.broadcast_to(np.linalg.inv(noise), (count - 1, 2, 2)),
    )
    rows = np.flatnonzero(seen)
    chain = chain.with_observations(rows, np.array([1.0, 0.0]), z[rows], np.full(len(rows), 25.0))
    for i in range(2):
        chain = chain.with_observations(np.array([0]), np.eye(2)[i], np.zeros(1), np.full(1, 0.01))
    value, covariance = chain.solve()
    np.testing.assert_allclose(value, [s[0] for s in smooth], atol=1e-9)
    np.testing.assert_allclose(covariance, [s[1] for s in smooth], atol=1e-9)


def test_a_chain_is_a_value() -> None:
    """Terms come into a copy; the chain before them stays as it was."""
    before = random_chain(5, 2, seed=4)
    parts = [part.copy() for part in (before.diagonal, before.upper, before.right)]
    step = np.ones((4, 2, 2))
    after = before.with_observations(np.array([1, 1]), np.ones(2), np.ones(2), np.ones(2))
    after = after.with_steps(step, step, np.ones((4, 2)), step)
    for part, kept, changed in zip(
        (before.diagonal, before.upper, before.right), parts, (after.diagonal, after.upper, after.right), strict=True
    ):
        np.testing.assert_array_equal(part, kept)
        assert (changed != kept).any()
    assert after.diagonal[1] == pytest.approx(before.diagonal[1] + 2.0 + 8.0)
