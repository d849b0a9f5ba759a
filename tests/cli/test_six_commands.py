"""The session of the how-to's first page, as it stands there, on the recording that it names."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import polars as pl
import pytest
from typer.testing import CliRunner

from railfix.cli import app

RUNNER = CliRunner(env={"COLUMNS": "160", "TERM": "dumb", "NO_COLOR": "1"})
HOW_TO = Path(__file__).parents[2] / "docs" / "how-to.md"


@pytest.mark.requirement("A1")
def test_from_a_log_to_a_report_in_six_commands(
    recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    section = HOW_TO.read_text(encoding="utf-8").split("\n## ")[1]
    commands = re.findall(r"^railfix (.*)$", section, re.MULTILINE)
    assert len(commands) == 6
    (name,) = re.findall(r"`(japan_\w+)`", section)
    for file in (recordings / "kinematic" / name).iterdir():
        shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    told = []
    for command in commands:
        done = RUNNER.invoke(app, shlex.split(command))
        doctors = command.startswith("doctor")  # it finds that there is no map
        assert done.exit_code == (5 if doctors else 0), f"{command}: {done.output}"
        told.append(" ".join(done.output.split()))
    assert "no track map: railfix map survey creates one from runs over the line" in told[0]
    assert "track map: line.csv" in told[1]
    assert (tmp_path / "report.html").stat().st_size > 100_000
    median, p95 = re.findall(r"error is ([\d.]+) m at the median, and at most ([\d.]+) m for 95 %", section)[0]
    assert f"front, filter along the track: error {median} m at the median, {p95} m for 95 % of" in told[3]
    assert "several_branches" in told[4]
    assert "2 positions are possible" in told[4]
    positions = pl.read_parquet(tmp_path / "results" / "train.parquet")
    assert len(positions) == 360
