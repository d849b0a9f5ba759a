"""The bridged reference of real recordings, half of their fixes taken away: the table of its document, held."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import reference_gaps
from conftest import ROOT
from reference_gaps import Recording, bridged

pytestmark = pytest.mark.requirement("D1")

#: Recording, gap [s]; bounds, a fifth over the table: median, 95th percentile, largest [m], error over its own
#: standard deviation, and the least share given out.
BOUNDS = [
    pytest.param("gsdc", 5, 0.02, 0.19, 3.5, 0.95, 0.97, marks=pytest.mark.slow),
    pytest.param("gsdc", 20, 0.02, 0.61, 5.0, 1.6, 0.94, marks=pytest.mark.slow),
    pytest.param("gsdc", 60, 0.02, 0.90, 5.0, 1.0, 0.75, marks=pytest.mark.slow),
    ("urbannav", 10, 0.11, 0.80, 2.1, 1.5, 0.90),
    pytest.param("urbannav", 30, 0.21, 1.2, 2.7, 1.4, 0.75, marks=pytest.mark.slow),
    ("smartloc", 10, 0.11, 1.4, 1.7, 2.3, 0.95),
    ("smartloc", 60, 0.40, 1.7, 2.0, 2.4, 0.90),
]


@cache
def recording(name: str, data: Path) -> Recording:
    make, _ = reference_gaps.RECORDINGS[name]
    return make(data)


@pytest.mark.parametrize(("name", "length", "p50", "p95", "largest", "ratio", "share"), BOUNDS)
@pytest.mark.every(3)
def test_bridged_places_of_recordings(
    name: str, length: int, p50: float, p95: float, largest: float, ratio: float, share: float, recordings: Path
) -> None:
    run = recording(name, recordings)
    errors = bridged(run, length, reference_gaps.RECORDINGS[name][1])
    size = np.abs(errors.error_m)
    assert len(size) > 250
    assert np.median(size) < p50
    assert np.percentile(size, 95) < p95
    assert size.max() < largest
    assert errors.ratio < ratio
    assert errors.share > share
    yardstick = np.abs(bridged(run, length, "interpolation").error_m)
    assert np.percentile(size, 95) < 0.3 * np.percentile(yardstick, 95)


@pytest.mark.slow
def test_the_kept_table_is_what_the_script_prints(recordings: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert recordings.is_dir()
    assert reference_gaps.main() == 0
    printed = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    text = (ROOT / "tests" / "references" / "results" / "reference-gaps.txt").read_text(encoding="utf-8")
    shown = [line.rstrip() for line in text.splitlines()]
    assert [_words(line) for line in shown[:1]] == [_words(line) for line in printed[:1]]
    assert len(shown) == len(printed) == 49
    assert shown[46:] == printed[46:]
    for a, b in zip(shown[1:46], printed[1:46], strict=True):
        assert _words(a)[:3] == _words(b)[:3]
        ours, theirs = (np.array(_words(line)[3:], dtype=np.float64) for line in (a, b))
        # Another processor may round a sum otherwise, and a satellite more or less go.
        np.testing.assert_allclose(ours, theirs, rtol=0.05, atol=0.02)


def _words(line: str) -> list[str]:
    return line.split()
