"""How fast logs are read, and in how much memory (for the nightly command)."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

pytestmark = [pytest.mark.requirement("A7"), pytest.mark.slow]


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    path = Path(__file__).parents[1] / "benchmarks" / "bench_reading.py"
    spec = importlib.util.spec_from_file_location("bench_reading", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["bench_reading"] = module
    spec.loader.exec_module(module)
    return module


def test_an_hour_at_10_hz_is_read_in_under_a_second(bench: ModuleType, tmp_path: Path) -> None:
    log = tmp_path / "hour.obs"
    bench.write_log(log, hours=1.0)
    assert 86e6 < log.stat().st_size < 88e6
    assert bench.read_with_railfix(log) == 36_000
    own_s = bench.seconds(lambda: bench.read_with_railfix(log), 3)
    assert own_s < 1.0
    if importlib.util.find_spec("pyrtklib5"):
        other_s = bench.seconds(lambda: bench.read_with_pyrtklib5(log), 3)
        assert other_s / own_s >= 1.5


def test_memory_does_not_grow_with_the_log(bench: ModuleType, tmp_path: Path) -> None:
    peaks_mb = []
    for hours in (0.5, 2.0):
        log = tmp_path / "log.obs"
        bench.write_log(log, hours=hours)
        peaks_mb.append(bench.peak_memory_mb(log))
    assert peaks_mb[1] < peaks_mb[0] + 20.0
    assert peaks_mb[1] < 400.0
