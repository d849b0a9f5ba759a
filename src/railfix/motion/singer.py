"""Singer model: motion with a time-correlated acceleration."""

from __future__ import annotations

import numpy as np
import scipy

from railfix.core.arrays import Floats


def singer_steps(dt: Floats, sigma_mps2: float, tau_s: float) -> tuple[Floats, Floats]:
    """Compute transition matrices and process noise covariances of position, speed and acceleration, shape (K, 3, 3).

    The acceleration is a first-order Gauss-Markov process (R. A. Singer 1970, doi:10.1109/TAES.1970.310128) with the
    standard deviation `sigma_mps2` [m/s2] and the time constant `tau_s` [s]. `dt` [s] are the time steps, shape (K,).
    The process is discretised with a matrix exponential (C. F. Van Loan 1978, doi:10.1109/TAC.1978.1101743). A step
    longer than `tau_s` is composed of equal shorter steps, because a matrix exponential loses digits in long steps.
    """
    halvings = np.ceil(np.log2(np.maximum(dt / tau_s, 1.0))).astype(np.int64)
    part = dt / 2.0**halvings
    system = np.zeros((len(dt), 6, 6))
    system[:, 0, 1] = system[:, 1, 2] = -1.0
    system[:, 2, 2] = part / tau_s
    system[:, 3:, 3:] = -np.swapaxes(system[:, :3, :3], 1, 2)
    system[:, 2, 5] = 2.0 * sigma_mps2**2 * part / tau_s
    exponential = scipy.linalg.expm(system)
    unit = part[:, None] ** np.array([2.0, 1.0, 0.0])
    step = np.swapaxes(exponential[:, 3:, 3:], 1, 2)
    noise = step @ exponential[:, :3, 3:] * unit[:, :, None] * unit[:, None, :]
    step = step * unit[:, :, None] / unit[:, None, :]
    for k in range(int(halvings.max(initial=0))):
        longer = halvings > k
        turn = step[longer]
        noise[longer] += turn @ noise[longer] @ np.swapaxes(turn, 1, 2)
        step[longer] = turn @ turn
    return step, 0.5 * (noise + np.swapaxes(noise, 1, 2))
