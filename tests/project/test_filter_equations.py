"""Names on the page "The filter in equations": each is one of the code, and each test is there."""

from __future__ import annotations

import re
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "filter-equations.md").read_text(encoding="utf-8")
ROOMS = ("src/railfix/kernels/tracking", "src/railfix/tracking")
#: Words of the page in code's type that are no names of these rooms: indices, other packages, scenarios.
OTHERS = {"i", "g", "tracking", "KalmanFilter", "rts_smoother", "city", "sight"}


def _members(module: Any) -> set[str]:
    """Names of a module, and fields of its classes and records."""
    names = set(vars(module))
    for value in list(vars(module).values()):
        names |= set(getattr(value, "_fields", ()) or ()) | set(getattr(value, "__members__", {}))
        names |= set(getattr(value, "model_fields", {})) if isinstance(value, type) else set()
        names |= {f.name for f in fields(value)} if isinstance(value, type) and is_dataclass(value) else set()
        names |= set(getattr(value, "names", None) or ())
    return names


@pytest.fixture(scope="module")
def known() -> dict[str, set[str]]:
    """Names by module."""
    found = {}
    for room in ROOMS:
        for path in (ROOT / room).glob("*.py"):
            name = ".".join(path.relative_to(ROOT / "src").with_suffix("").parts)
            found[path.stem] = found.get(path.stem, set()) | _members(import_module(name))
    return found


@pytest.mark.requirement("E5")
def test_each_name_on_the_page_is_one_of_the_code(known: dict[str, set[str]]) -> None:
    every = set().union(*known.values(), known, OTHERS)
    unknown = []
    for word in re.findall(r"`([A-Za-z_][A-Za-z_0-9.]*\*?)`", PAGE):
        *module, name = word.split(".")
        names = known.get(module[-1], every) if module else every
        there = any(one.startswith(name[:-1]) for one in names) if name.endswith("*") else name in names
        if not (there or name == "py" or word.startswith("test_")):
            unknown.append(word)
    assert not unknown


@pytest.mark.requirement("E5")
def test_each_test_on_the_page_is_there() -> None:
    found = re.findall(r"`(?:tests/tracking/)?(test_\w+\.py)(?:::(\w+))?`", PAGE)
    assert len(found) > 10
    for file, name in found:
        assert not name or f"def {name}(" in (ROOT / "tests" / "tracking" / file).read_text(encoding="utf-8"), (
            file,
            name,
        )
        assert (ROOT / "tests" / "tracking" / file).exists(), file
