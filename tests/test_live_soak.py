"""A long live session: no message missing, memory flat, expired ephemerides and SBAS messages dropped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from live_soak import soak

pytestmark = pytest.mark.requirement("A8")


def test_expired_records_are_dropped(tmp_path: Path) -> None:
    """Ten hours at one epoch in ten minutes: what is kept is what is valid, and no message is missing."""
    left = soak(tmp_path, hours=10.0, rate_hz=1.0 / 600.0)
    assert left["sequence"] == list(range(1, 61))
    assert left["records"] < 0.6 * left["records_of_the_day"]
    assert left["counts"] == {"paired": 60}


@pytest.mark.slow
@pytest.mark.parametrize("sbas", [False, True])
def test_a_long_session(tmp_path: Path, sbas: bool) -> None:
    """A day (with SBAS two hours): every epoch has its message, memory after the first hours does not grow."""
    hours, rate = (2.0, 1.0) if sbas else (24.0, 0.2)
    left = soak(tmp_path, hours=hours, rate_hz=rate, sbas=sbas)
    assert left["sequence"] == list(range(1, left["epochs"] + 1))
    assert left["tracking"] > 0.8
    assert left["sbas_messages"] < 3000
    memory = left["memory_mb"]
    if not sbas:
        half = len(memory) // 2
        growth = np.polyfit(np.arange(len(memory) - half), memory[half:], 1)[0]
        assert growth < 1.0  # MB an hour
        assert max(memory[half:]) - memory[5] < 30.0
