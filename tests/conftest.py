"""Fixtures that every test may use."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: Modules whose tests need hardly any of the compiled kernels.
FEW_KERNELS = ("test_ground", "test_navigation", "test_rinex", "test_simulate")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put tests that need few kernels at the middle, where the second of two workers begins.

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
