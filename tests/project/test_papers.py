"""The table of the papers' items names functions and tests that exist, and is up to date."""

from __future__ import annotations

import pytest

import papers


def test_what_the_items_name_is_there() -> None:
    assert papers.problems() == []
    assert len(papers.DATA["item"]) >= 60
    with pytest.raises((ImportError, AttributeError)):
        papers.named("railfix.motion.slip.find_nothing")


def test_the_table_is_up_to_date() -> None:
    assert papers.TABLE.read_text(encoding="utf-8") == papers.document(), "run python tests/studies/papers.py"
