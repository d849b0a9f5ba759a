"""RINEX observations read by georinex, an independent reader, in place of railfix's own."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

import railfix
from railfix.cli import app
from railfix.ranges.cn0_curve_file import read_cn0_curve

RUNNER = CliRunner()
#: georinex cuts time tags to 1 us: at 40 m/s the satellites' ranges are the same to a millimetre.
TOLERANCE_M = 2e-3


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The first seconds of the demonstration, plain files."""
    folder, demo = tmp_path_factory.mktemp("reader"), railfix.demo_files()
    log = folder / "front.obs"
    railfix.write_observations(railfix.read_observations(demo["front"])[:30], log)
    return {"log": log, "nav": demo["nav"], "track": demo["track"], "vehicle": demo["vehicle"]}


def call(*words: object) -> str:
    result = RUNNER.invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.requirement("A7", "S2")
def test_a_run_and_positions_by_georinex_are_those_by_our_own_reader(files: dict[str, Path], tmp_path: Path) -> None:
    tables, positions = [], []
    for reader in ("railfix", "georinex"):
        out, pos = tmp_path / reader, tmp_path / f"{reader}.pos"
        asked = ("--reader", reader)
        call("run", "--front", files["log"], "--nav", files["nav"], "--track", files["track"], "--vehicle",
             files["vehicle"], "--out", out, *asked)  # fmt: skip
        tables.append(pl.read_parquet(out / "positions.parquet"))
        assert json.loads((out / "run.json").read_text())["options"]["logs"]["reader"] == reader
        call("locate", "--log", files["log"], "--nav", files["nav"], "--out", pos, *asked)
        positions.append(railfix.read_positions(pos).ecef_m)
    assert len(tables[0]) == len(tables[1]) == 30
    assert tables[0]["n_used"].to_list() == tables[1]["n_used"].to_list()
    chainages = [table["chainage_m"].to_numpy() for table in tables]
    assert np.isfinite(chainages[0]).all()
    np.testing.assert_allclose(*chainages, atol=TOLERANCE_M)
    np.testing.assert_allclose(*positions, atol=TOLERANCE_M)


def test_files_made_by_georinex_are_those_made_by_our_own_reader(files: dict[str, Path], tmp_path: Path) -> None:
    logs, curves = [], []
    for reader in ("railfix", "georinex"):
        log, curve = tmp_path / f"{reader}.obs", tmp_path / f"{reader}.toml"
        call("convert", files["log"], "--out", log, "--reader", reader)
        call("cn0-curve", files["log"], "--nav", files["nav"], "--out", curve, "--reader", reader)
        logs.append(railfix.read_observations(log))
        curves.append([repr(mean) for mean in read_cn0_curve(curve).means])
    np.testing.assert_array_equal(logs[0].code_m, logs[1].code_m)
    assert logs[0].signal.tolist() == logs[1].signal.tolist()
    assert curves[0] == curves[1]


def test_a_receivers_log_is_not_for_georinex(tmp_path: Path, files: dict[str, Path]) -> None:
    log = tmp_path / "log.ubx"
    log.write_bytes(b"\xb5\x62" + bytes(200))
    words = ["locate", "--log", str(log), "--nav", str(files["nav"]), "--out", str(tmp_path / "x.pos")]
    result = RUNNER.invoke(app, [*words, "--reader", "georinex"])
    assert result.exit_code == 5
    assert "georinex reads RINEX" in result.output
