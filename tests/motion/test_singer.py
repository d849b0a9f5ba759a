"""Singer's model of motion against the integral that defines it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from railfix.motion.chain import singer_steps

SHARES = np.geomspace(1e-6, 10.0, 57)


def van_loan(dt: float, sigma_mps2: float, tau_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition and noise by one matrix exponential (C. F. Van Loan, 1978), with the step as unit of time."""
    dynamics = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -dt / tau_s]])
    white = np.diag([0.0, 0.0, 1.0])
    powers = expm(np.block([[-dynamics, white], [np.zeros((3, 3)), dynamics.T]]))
    step = powers[3:, 3:].T
    noise = step @ powers[:3, 3:]
    unit = np.array([1.0, 1.0 / dt, 1.0 / dt**2])
    density = 2.0 * sigma_mps2**2 / tau_s * dt**5
    return step * unit[:, None] / unit, noise * density * np.outer(unit, unit)


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("tau_s", [0.3, 2.0, 120.0])
def test_transition_and_noise_are_the_integrals_of_the_model(tau_s: float) -> None:
    dt = SHARES * tau_s
    step, noise = singer_steps(dt, 0.7, tau_s)
    for k in range(len(dt)):
        whole_step, whole_noise = van_loan(dt[k], 0.7, tau_s)
        np.testing.assert_allclose(step[k], whole_step, rtol=1e-9)
        np.testing.assert_allclose(noise[k], whole_noise, rtol=1e-9)


@pytest.mark.requirement("E5")
def test_two_steps_are_one_of_their_length() -> None:
    dt = np.array([0.04, 0.9, 0.94])
    (one, two, both), (noise_one, noise_two, noise_both) = singer_steps(dt, 0.4, 2.0)
    np.testing.assert_allclose(two @ one, both, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(two @ noise_one @ two.T + noise_two, noise_both, rtol=1e-12)
