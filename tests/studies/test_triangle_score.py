"""The table of P3's triangle by its radius is what is drawn."""

from __future__ import annotations

import pytest

import triangle_score
from conftest import ROOT
from test_p4_experiment import assert_same


@pytest.mark.slow
@pytest.mark.requirement("F1")
def test_the_table_is_as_it_was() -> None:
    shown = (ROOT / "tests" / "references" / "results" / "triangle.txt").read_text(encoding="utf-8")
    assert_same(list("\n".join(triangle_score.report()).splitlines()), shown.splitlines())
