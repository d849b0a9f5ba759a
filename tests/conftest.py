"""Fixtures that every test may use."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: Modules whose tests need few of the compiled kernels, or none.
FEW_KERNELS = (
    "test_documents",
    "test_evaluate_c",
    "test_ground",
    "test_map",
    "test_navigation",
    "test_network",
    "test_orbits",
    "test_r",
    "test_simulate",
)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put tests without kernels at the middle, where the second of two workers begins.

    With ``--dist worksteal`` each worker has a contiguous share of the tests. In a clean checkout the first compiles
    the kernels, for minutes; the second finds them on disk when it needs them.
    """
    apart = [item for item in items if item.path.name.startswith(FEW_KERNELS)]
    others = [item for item in items if not item.path.name.startswith(FEW_KERNELS)]
    middle = len(items) // 2
    items[:] = others[:middle] + apart + others[middle:]


@pytest.fixture(scope="session")
def recordings() -> Path:
    """Folder of the real recordings, beside the checkout; the test is skipped where it is absent."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the real recordings are not beside the checkout ({folder})")
    return folder
