"""The benchmarks watch functions that there are."""

from __future__ import annotations

import importlib
import sys
from operator import attrgetter
from pathlib import Path

import pytest


@pytest.mark.requirement("A7")
def test_each_stage_of_a_run_that_is_timed_exists(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    for _, module, path in importlib.import_module("bench_stages").STAGES:
        assert callable(attrgetter(path)(importlib.import_module(module)))
    assert sys.modules.pop("bench_stages")
