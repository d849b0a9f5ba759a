"""Singer's model of motion against the integral that defines it."""

from __future__ import annotations

import numpy as np
import pytest

from railfix.motion.singer import singer_steps

SHARES = np.geomspace(1e-6, 30.0, 57)
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(60)


def response(x: np.ndarray, tau_s: float) -> np.ndarray:
    """Position, speed and acceleration after `x` time constants since an impulse of the acceleration."""
    return np.stack([tau_s**2 * (x + np.expm1(-x)), -tau_s * np.expm1(-x), np.exp(-x)])


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("tau_s", [0.3, 2.0, 120.0])
def test_transition_and_noise_are_the_integrals_of_the_model(tau_s: float) -> None:
    dt = SHARES * tau_s
    step, noise = singer_steps(dt, 0.7, tau_s)
    for k in range(len(dt)):
        x = 0.5 * SHARES[k] * (_NODES + 1.0)
        f = response(x, tau_s)
        density = 2.0 * 0.7**2 / tau_s
        whole = density * (0.5 * dt[k] * _WEIGHTS * f) @ f.T
        np.testing.assert_allclose(noise[k], whole, rtol=1e-8)
        np.testing.assert_allclose(step[k][:, 2], response(SHARES[k], tau_s), rtol=1e-9)
        np.testing.assert_allclose(step[k][:2, :2], [[1.0, dt[k]], [0.0, 1.0]], rtol=1e-12)
        assert step[k][2, :2].tolist() == [0.0, 0.0]


@pytest.mark.requirement("E5")
def test_two_steps_are_one_of_their_length() -> None:
    dt = np.array([0.04, 0.9, 0.94])
    (one, two, both), (noise_one, noise_two, noise_both) = singer_steps(dt, 0.4, 2.0)
    np.testing.assert_allclose(two @ one, both, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(two @ noise_one @ two.T + noise_two, noise_both, rtol=1e-12)


def test_no_step_is_no_motion() -> None:
    assert singer_steps(np.zeros(0), 0.4, 2.0)[0].shape == (0, 3, 3)
