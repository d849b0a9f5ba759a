"""A screen is added by one file and one line: the two blocks of docs/screens.md, put into a copy of the package."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import polars as pl
import pytest

from conftest import ROOT
from railfix.core.reasons import Reason, reason_names, reason_text, screen_reason
from railfix.pipeline.config import SCREEN_NAMES, Config
from railfix.screens import SCREENS

DEMO = ROOT / "data" / "demo"


def test_names_files_and_settings_are_one() -> None:
    assert tuple(screen.name for screen in SCREENS) == SCREEN_NAMES
    for screen in SCREENS:
        assert type(screen).__module__ == f"railfix.screens.{screen.name}"
        assert getattr(Config(), screen.name) == screen.limits


def test_reasons_of_added_screens_have_bits_of_their_own() -> None:
    assert screen_reason("doppler") is Reason.DOPPLER
    added = screen_reason("test_of_reasons")
    assert screen_reason("test_of_reasons") == added
    assert int(added) > max(int(reason) for reason in Reason)
    assert reason_names()[int(added)] == "test_of_reasons"
    assert reason_text(added | Reason.DOPPLER) == "doppler+test_of_reasons"


@pytest.mark.requirement("B7")
def test_a_screen_is_one_file_and_one_line(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "screens.md").read_text(encoding="utf-8").split("## Adding a screen")[1]
    file, line = re.findall(r"```(?:python|text)\n(.*?)```", text, flags=re.DOTALL)[:2]
    assert line.count("\n") == 1
    package = tmp_path / "src" / "railfix"
    shutil.copytree(ROOT / "src" / "railfix", package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / "screens" / "large_sigma.py").write_text(file, encoding="utf-8")
    registry = package / "screens" / "registry.py"
    registry.write_text(registry.read_text().replace('    "raim",\n', f'{line}    "raim",\n'), encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "src"), "COLUMNS": "120"}

    def railfix(*words: object) -> None:
        command = [sys.executable, "-m", "railfix", *map(str, words)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=tmp_path)
        assert done.returncode == 0, done.stdout + done.stderr

    railfix(
        "run", "--front", DEMO / "front.crx.gz", "--nav", DEMO / "nav.rnx.gz", "--track", DEMO / "track.csv",
        "--end", "2024-03-05T03:10:30", "--set", "large_sigma.limit_m=3", "--observations", "--out", tmp_path / "out",
    )  # fmt: skip
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["settings_used"]["large_sigma"] == {"limit_m": 3.0}
    assert record["settings_used"]["screens"][3:5] == ["antenna_pair", "large_sigma"]
    rows = pl.read_parquet(tmp_path / "out" / "observations.parquet")
    judged = rows.filter(pl.col("metric_large_sigma_m").is_not_null())
    rejected = judged["reason_text"].str.contains("large_sigma")
    assert 0 < rejected.sum() < len(judged)
    assert (rejected == (judged["metric_large_sigma_m"] > 3.0)).all()
    counts = next(v for k, v in record["antennas"]["front"].items() if re.match("observations.*by_one_reason_alone", k))
    assert counts["large_sigma"] > 0
    railfix("plot-screens", tmp_path / "out", "--out", tmp_path / "pictures")
    assert (tmp_path / "pictures" / "front_large_sigma.png").stat().st_size > 1000
