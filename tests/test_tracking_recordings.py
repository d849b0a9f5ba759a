"""The filter along the track on the real recordings: one setting, bounds a third above what it reaches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import filter_score
import recordings_score

#: Recording: median, 95th percentile, largest error [m], 95th percentile of error over sigma.
BOUNDS = {
    "m8t": (1.9, 4.6, 22.0, 2.8),
    "f9p": (2.4, 4.8, 22.0, 3.7),
    "pixel": (1.6, 5.5, 32.0, 2.9),
    "japan": (0.6, 1.8, 5.2, 2.1),
}
RUNS = {
    "m8t": recordings_score.urbannav_m8t,
    "f9p": recordings_score.urbannav_f9p,
    "pixel": recordings_score.gsdc,
    "japan": recordings_score.japan,
}


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("name", list(BOUNDS))
def test_errors_of_the_filter_on_a_recording(recordings: Path, name: str) -> None:
    case = filter_score.rinex_case(name, RUNS[name], recordings)
    found = case.run()
    error = case.error(found)[case.observed]
    p50, p95, largest, ratio = BOUNDS[name]
    assert np.isfinite(error).all()
    assert np.median(error) < p50
    assert np.percentile(error, 95) < p95
    assert error.max() < largest
    assert np.percentile(error / found.sigma_m[case.observed], 95) < ratio
