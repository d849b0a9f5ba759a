"""A screen is added by one file and one line: the two blocks of docs/screens.md, put into a copy of the package."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from conftest import ROOT
from pipeline_cases import clean_observations, processor
from railfix.core.errors import NoPositionError
from railfix.core.reasons import Reason, Status, reason_names, reason_text, screen_reason
from railfix.io.rinex import read_observations, write_observations
from railfix.pipeline.config import SCREEN_NAMES, Config, parse_config
from railfix.run import RunInputs, run_files
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
    shutil.copytree(ROOT / "src" / "railfix", package, ignore=shutil.ignore_patterns("*.nbi", "*.nbc"))
    (package / "screens" / "large_sigma.py").write_text(file, encoding="utf-8")
    registry = package / "screens" / "registry.py"
    registry.write_text(registry.read_text().replace('    "raim",\n', f'{line}    "raim",\n'), encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "src"), "COLUMNS": "120"}
    environment["RAILFIX_KERNELS"] = "numpy"  # compiled code belongs to its files: a copy would be compiled again

    def railfix(*words: object) -> None:
        command = [sys.executable, "-m", "railfix", *map(str, words)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=tmp_path)
        assert done.returncode == 0, done.stdout + done.stderr

    railfix(
        "run", "--front", DEMO / "front.crx.gz", "--nav", DEMO / "nav.rnx.gz", "--track", DEMO / "track.csv",
        "--end", "2024-03-05T03:10:10", "--set", "large_sigma.limit_m=3", "--observations", "--out", tmp_path / "out",
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


@pytest.mark.requirement("B7")
def test_a_note_says_where_a_screen_cannot_judge(tmp_path: Path) -> None:
    """One antenna and a log without Doppler: the screens of two antennas and of the Doppler are named in the notes."""
    log = read_observations(DEMO / "front.crx.gz")[:100]
    silent = replace(log, doppler_hz=np.full_like(log.doppler_hz, np.nan))
    write_observations(silent, tmp_path / "front.rnx")
    inputs = RunInputs(front=(tmp_path / "front.rnx",), nav=(DEMO / "nav.rnx.gz",), track=(DEMO / "track.csv",))
    notes = run_files(inputs, out=tmp_path / "out").notes
    assert any("screen doppler has judged nothing; it needs the Doppler" in note for note in notes)
    for name in ("antenna_pair", "antenna_spacing"):
        assert any(f"screen {name}: inactive; it needs two antennas" in note for note in notes)
    assert not any("screen elevation" in note for note in notes)


@pytest.mark.requirement("B7")
def test_a_log_without_the_systems_asked_for_is_one_sentence(tmp_path: Path) -> None:
    inputs = RunInputs(front=(DEMO / "front.crx.gz",), nav=(DEMO / "nav.rnx.gz",), track=(DEMO / "track.csv",))
    with pytest.raises(NoPositionError, match="system_not_selected") as caught:
        run_files(inputs, parse_config({"systems": ["C"]}), out=tmp_path / "out")
    assert caught.value.exit_code == 7
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("carrier", ["off", "smoothed", "float"])
def test_epochs_without_any_channel_have_a_status(carrier: str) -> None:
    """A receiver that has lost every satellite, then finds them again."""
    log = clean_observations()["front"]
    nothing = np.zeros((5, 0))
    empty = replace(
        log[100:105], satellite=log.satellite[:0], signal=log.signal[:0], code_m=nothing, phase_cycles=nothing,
        doppler_hz=nothing, cn0_dbhz=nothing, loss_of_lock=nothing.astype(np.uint8),
    )  # fmt: skip
    live = processor({"carrier": carrier})
    result, state = live.process({"front": empty})
    assert (result.antennas["front"].status == Status.NO_OBSERVATION).all()
    later, _ = live.process({"front": log[105:110]}, state)
    assert np.isfinite(later.antennas["front"].chainage_m).all()
