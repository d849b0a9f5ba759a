"""Pictures of the screens of a run, from its files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from railfix.cli import app
from railfix.pipeline.config import parse_config
from railfix.report.plots import screens
from railfix.run import RunOptions, RunSummary, run_files
from railfix.screens import ScreenPicture
from railfix.simulate.demonstration import demo_inputs

pytestmark = pytest.mark.requirement("B7")

RUNNER = CliRunner(env={"COLUMNS": "150", "TERM": "dumb", "NO_COLOR": "1"})
SCREENS = ["elevation", "cn0_floor", "doppler", "antenna_pair", "raim", "protection_level", "antenna_spacing"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunSummary:
    config = parse_config(
        {
            "filter": "off",
            "preset": "p1",
            "antenna_pair": {"clocks": "median"},
            "antenna_spacing": {"limit_m": 1.0},
            "raim": {"fixed_limit_m2": 20.0},
        }
    )
    options = RunOptions(observations="write", chunk_epochs=700)
    return run_files(demo_inputs(), config, out=tmp_path_factory.mktemp("run") / "out", options=options)


@pytest.fixture(scope="module")
def folder(run: RunSummary) -> Path:
    return run.files["run.json"].parent


def drawn(monkeypatch: pytest.MonkeyPatch, folder: Path, out: Path) -> dict[str, tuple[ScreenPicture, np.ndarray]]:
    """What goes into each picture, without drawing it."""
    seen: dict[str, tuple[ScreenPicture, np.ndarray]] = {}

    def keep(path: Path, picture: ScreenPicture, time: np.ndarray, chainage_m: np.ndarray) -> Path:
        assert len(time) == len(chainage_m) == len(picture.metric)
        seen[path.stem] = (picture, chainage_m)
        return path

    monkeypatch.setattr(screens, "draw_screen", keep)
    screens.draw_run_screens(folder, out)
    return seen


def test_pictures_hold_what_the_run_counted(
    run: RunSummary, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = drawn(monkeypatch, folder, tmp_path / "pics")
    assert list(seen) == [f"{antenna}_{name}" for antenna in ("front", "rear") for name in SCREENS]
    rows = pl.read_parquet(run.files["observations.parquet"])
    positions = pl.read_parquet(run.files["positions.parquet"])
    for antenna, tally in run.tally.antennas.items():
        mine = rows.filter(pl.col("antenna") == antenna)
        for screen in ("doppler", "antenna_pair"):
            picture, chainage = seen[f"{antenna}_{screen}"]
            text = mine["reason_text"].str.split("+").list.contains(screen)
            assert np.count_nonzero(picture.reject) == text.sum() >= tally.only_reason[screen] > 0
            assert np.count_nonzero(np.isfinite(picture.metric)) == mine[f"metric_{screen}_m"].is_not_null().sum()
            beyond = np.abs(picture.metric) > np.broadcast_to(picture.limit, picture.metric.shape)
            np.testing.assert_array_equal(beyond, picture.reject)
            has = positions.filter(pl.col("chainage_m").is_not_null(), pl.col("antenna") == antenna)
            assert np.count_nonzero(np.isfinite(chainage)) == mine["time_gpst"].is_in(has["time_gpst"].implode()).sum()
        spacing, _ = seen[f"{antenna}_antenna_spacing"]
        disagree = tally.status["antennas_disagree"]
        assert np.count_nonzero(spacing.reject) >= disagree > 0
        raim, _ = seen[f"{antenna}_raim"]
        outcome = positions.filter(pl.col("antenna") == antenna)["raim_outcome"].cast(pl.String)
        # neither passed nor beyond a test: a statistic at or over its threshold, and nothing else
        detected = ~outcome.is_in(["passed", "untestable"])
        np.testing.assert_array_equal(raim.reject[:, 0], detected.to_numpy())
        assert 0 < detected.sum() < tally.positioned
        assert (outcome == "untestable").sum() >= tally.epochs - tally.observed


@pytest.mark.slow
def test_the_command_writes_pictures(run: RunSummary, folder: Path, tmp_path: Path) -> None:
    small = tmp_path / "small"
    small.mkdir()
    for name in ("positions", "observations"):
        table = pl.read_parquet(run.files[f"{name}.parquet"])
        first = table["time_gpst"].min()
        table.filter(pl.col("antenna") == "front", pl.col("time_gpst") < first + pl.duration(seconds=2)).write_parquet(
            small / f"{name}.parquet"
        )
    (small / "run.json").write_text((folder / "run.json").read_text())
    result = RUNNER.invoke(app, ["plot-screens", str(small), "--out", str(tmp_path / "pics")])
    assert result.exit_code == 0, result.output
    written = sorted(path.name for path in (tmp_path / "pics").iterdir())
    assert written == sorted(f"front_{name}.png" for name in SCREENS)
    assert all((tmp_path / "pics" / name).read_bytes().startswith(b"\x89PNG") for name in written)
    assert all(name in result.output for name in written)


@pytest.mark.parametrize("lack", ["run.json", "positions.parquet", "observations.parquet"])
def test_a_folder_without_its_files(folder: Path, tmp_path: Path, lack: str) -> None:
    for name in ("run.json", "positions.parquet", "observations.parquet"):
        if name != lack:
            (tmp_path / name).write_bytes((folder / name).read_bytes())
    result = RUNNER.invoke(app, ["plot-screens", str(tmp_path), "--out", str(tmp_path / "pics")])
    assert result.exit_code == 3
    assert lack in result.output
    assert ("--observations" in result.output) == (lack == "observations.parquet")
    assert not (tmp_path / "pics").exists()


@pytest.mark.parametrize("broken", ["{", "{}", '{"settings_used": 3}', '{"settings_used": {"colour": "red"}}'])
def test_a_record_that_is_none(folder: Path, tmp_path: Path, broken: str) -> None:
    for name in ("positions.parquet", "observations.parquet"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    (tmp_path / "run.json").write_text(broken)
    result = RUNNER.invoke(app, ["plot-screens", str(tmp_path), "--out", str(tmp_path / "pics")])
    assert result.exit_code in (3, 4)
    assert "run.json" in result.output
    assert "Traceback" not in result.output


def test_tables_of_another_version_are_told(folder: Path, tmp_path: Path) -> None:
    for name in ("run.json", "positions.parquet"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    pl.read_parquet(folder / "observations.parquet").drop("metric_doppler_m").write_parquet(
        tmp_path / "observations.parquet"
    )
    result = RUNNER.invoke(app, ["plot-screens", str(tmp_path), "--out", str(tmp_path / "pics")])
    assert result.exit_code == 3
    assert "metric_doppler_m" in result.output


def test_pictures_that_cannot_be_written(folder: Path, tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.write_text("")
    result = RUNNER.invoke(app, ["plot-screens", str(folder), "--out", str(taken)])
    assert result.exit_code == 8
    assert json.loads((folder / "run.json").read_text())
