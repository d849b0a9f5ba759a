"""Fixtures that every test may use."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from bad_inputs import Desk, desk_in
from railfix.evaluate import public_data
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
def good(tmp_path_factory: pytest.TempPathFactory) -> Desk:
    """One good input of every kind, and results of them; a test that changes them does so in a copy."""
    return desk_in(tmp_path_factory.mktemp("desk"))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Make of a test with the mark `every(n)` all cases but each n-th slow ones."""
    seen: Counter[tuple[str, str]] = Counter()
    for item in items:
        mark = item.get_closest_marker("every")
        if mark is None:
            continue
        function = (item.path.as_posix(), item.name.partition("[")[0])
        if seen[function] % mark.args[0]:
            item.add_marker(pytest.mark.slow)
        seen[function] += 1


@pytest.fixture(scope="session")
def recorded(request: pytest.FixtureRequest) -> Callable[[str], Path]:
    """Return a function from the name of a recording to its path: beside the checkout, or after ``public/`` in the
    wheel of the package index; the test is skipped where it is absent.
    """

    def find(name: str) -> Path:
        if not name.startswith("public/"):
            return request.getfixturevalue("recordings") / name
        path = public_data.data_folder() / name.removeprefix("public/")
        if not path.is_file():
            pytest.skip(f"{path} is not there; `{public_data.COMMAND}` brings it")
        return path

    return find


@pytest.fixture(scope="session")
def recordings() -> Path:
    """Folder of the real recordings, beside the checkout; the test is skipped where it is absent."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the real recordings are not beside the checkout ({folder})")
    return folder
