"""Files that users reported, each through every command that reads it (``python tests/studies/reported_cases.py``)."""

from __future__ import annotations

from pathlib import Path

import pytest

from reported_cases import Row, list_rows, run_row, station_error_m

pytestmark = pytest.mark.requirement("A6", "G5")


@pytest.mark.filterwarnings("default")
@pytest.mark.every(6)
@pytest.mark.parametrize("row", list_rows(), ids=lambda row: f"{row.file}-{row.command}")
def test_every_command_makes_the_right_of_a_reported_file(row: Row, recordings: Path, tmp_path: Path) -> None:
    right, code, text = run_row(row, recordings / "cases", tmp_path)
    assert right, f"exit code {code}: {text}"
    if row.command == "locate" and not code:
        assert station_error_m(tmp_path / "place.pos") < 10.0  # with five satellites of GPS 7.6 m (RTKLIB: 13 m)
