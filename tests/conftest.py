"""Fixtures that every test may use."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from railfix.live.warm_up import prepare_kernels

# A busy machine is no failure: examples have no deadline, and slow drawing of data is no error.
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")


ROOT = Path(__file__).resolve().parents[1]


@pytest.hookimpl(tryfirst=True)
def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile all kernels once, on two cores, before the workers begin: each would compile them for itself."""
    options = session.config.option
    if getattr(options, "numprocesses", None) and not options.collectonly:
        prepare_kernels()


@pytest.fixture(scope="session")
def recordings() -> Path:
    """Folder of the real recordings, beside the checkout; the test is skipped where it is absent."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the real recordings are not beside the checkout ({folder})")
    return folder
