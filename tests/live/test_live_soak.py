"""A long live session: no message missing, memory flat."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from live_soak import soak
from railfix.ranges.sbas.standard import OLDEST_S

pytestmark = pytest.mark.requirement("A8")


@pytest.mark.slow
@pytest.mark.parametrize("sbas", [False, True])
def test_a_long_session(tmp_path: Path, sbas: bool) -> None:
    """A day (with SBAS three hours): every epoch has its message, memory after the first hours does not grow."""
    hours, rate = (3.0 if sbas else 24.0), 0.2
    left = soak(tmp_path, hours=hours, rate_hz=rate, sbas=sbas)
    assert left["sequence"] == list(range(1, left["epochs"] + 1))
    assert left["tracking"] > 0.8
    # one a second; of three hours those of the last twenty minutes, masks of the last forty, which later epochs can
    # use, and those of the service, which hold for a day and come every half minute or more seldom
    assert left["sbas_messages"] < 1.15 * OLDEST_S + 120.0 * hours
    memory = left["memory_mb"]
    if not sbas:
        half = len(memory) // 2
        growth = np.polyfit(np.arange(len(memory) - half), memory[half:], 1)[0]
        assert growth < 1.0  # MB an hour
        assert max(memory[half:]) - memory[5] < 30.0
