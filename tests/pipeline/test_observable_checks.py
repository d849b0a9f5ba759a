"""Signs and units of Dopplers and phases: the factor by which they follow the satellites."""

from __future__ import annotations

import numpy as np
import pytest

from railfix.pipeline.observable_checks import rate_factor

#: Range rates of four Galileo satellites of a simulated hour [m/s].
EXPECTED = np.array([[-368.5, -56.0, -447.1, 141.8]])
#: What a receiver clock adds to each [m/s].
CLOCK = 58.0


@pytest.mark.requirement("B8")
def test_one_slip_among_four_satellites_gives_no_factor() -> None:
    """A slip of 32 m within 0.1 s once made "0.42 times what the satellites' motion gives" of right phases."""
    observed = EXPECTED + CLOCK
    assert rate_factor(observed, EXPECTED) == pytest.approx(1.0)
    observed[0, 0] += 324.0
    assert np.isnan(rate_factor(observed, EXPECTED)).all()


@pytest.mark.requirement("B8")
@pytest.mark.parametrize("unit", [-1.0, 0.19, -0.25])
def test_one_slip_among_seven_satellites_hides_no_wrong_unit(unit: float) -> None:
    expected = np.array([[-368.5, -56.0, -447.1, 141.8, 512.0, -610.0, 260.0]])
    observed = unit * expected + CLOCK
    observed[0, 2] += 30.0
    # Each epoch has a factor of its own.
    factors = rate_factor(np.vstack([observed, expected]), np.vstack([expected, expected]))
    np.testing.assert_allclose(factors, [unit, 1.0], atol=0.02)
