"""Oracles compute with nothing of the product: they take types of data from it alone."""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path

import pytest

ORACLES = Path(__file__).parents[1] / "oracles"


def find_faults(text: str) -> list[str]:
    """Return the names that a source takes from railfix and that are not types of data."""
    faults = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            faults += [alias.name for alias in node.names if alias.name.partition(".")[0] == "railfix"]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "railfix":
            module = import_module(node.module or "")
            for alias in node.names:
                named = getattr(module, alias.name)
                if not isinstance(named, type) or alias.name.startswith("_"):
                    faults.append(f"{node.module}.{alias.name}")
    return faults


@pytest.mark.requirement("S3")
def test_oracles_import_types_of_data_alone() -> None:
    found = {path.name: faults for path in ORACLES.glob("*.py") if (faults := find_faults(path.read_text("utf-8")))}
    assert found == {}


@pytest.mark.parametrize(
    "line",
    [
        "import railfix.core",
        "from railfix.core.constants import SPEED_OF_LIGHT",
        "from railfix.integrity.raim.position_model import _model",
        "from railfix.core.geodesy import enu_axes",
        "from railfix.positioning import normal_equations",
    ],
)
def test_functions_constants_and_modules_of_the_product_are_found(line: str) -> None:
    assert len(find_faults(line)) == 1
    assert find_faults("from railfix.positioning.range_arrays import Ranges") == []
