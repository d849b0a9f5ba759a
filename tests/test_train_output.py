"""Tables of the filter along the track, from a piece of the demonstration."""

from __future__ import annotations

import json
from dataclasses import asdict
from datetime import datetime
from pathlib import Path

import polars as pl
import pytest
from polars.testing import assert_frame_equal
from typer.testing import CliRunner

from railfix.cli import app
from railfix.pipeline.config import Config
from railfix.pipeline.tables import OBSERVATION_COLUMNS
from railfix.pipeline.train_table import TRAIN_COLUMNS
from railfix.run import RunInputs, RunOptions, RunSummary, run_files
from railfix.simulate.demonstration import demo_inputs

SPAN = {"start": datetime(2024, 3, 5, 3, 10, 5), "end": datetime(2024, 3, 5, 3, 10, 13)}


def _run(out: Path, config: Config, chunk: int) -> RunSummary:
    demo = demo_inputs()
    inputs = RunInputs(front=demo.front, rear=demo.rear, nav=demo.nav, track=demo.track, vehicle=demo.vehicle)
    return run_files(inputs, config, out=out, options=RunOptions(observations="write", chunk_epochs=chunk, **SPAN))


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> RunSummary:
    return _run(tmp_path_factory.mktemp("tracked") / "run", Config(filter="track"), 1000)


@pytest.mark.requirement("E5")
def test_one_row_an_epoch_and_antenna_with_all_columns(tracked: RunSummary) -> None:
    train = pl.read_parquet(tracked.files["train.parquet"])
    positions = pl.read_parquet(tracked.files["positions.parquet"])
    assert train.columns == list(TRAIN_COLUMNS)
    assert_frame_equal(train.select("time_gpst", "antenna"), positions.select("time_gpst", "antenna"))
    assert (train["status"] == "tracking").mean() > 0.9
    assert tracked.files["train.csv"].read_text().splitlines()[0] == ",".join(TRAIN_COLUMNS)
    assert train["sources"].str.contains("code").all()


@pytest.mark.requirement("E5")
def test_summary_and_record_count_what_the_table_holds(tracked: RunSummary) -> None:
    train = pl.read_parquet(tracked.files["train.parquet"])
    record = json.loads(tracked.files["run.json"].read_text())
    for antenna in ("front", "rear"):
        mine = train.filter(pl.col("antenna") == antenna)
        found = tracked.tracks[antenna]
        counted = dict(mine.group_by(pl.col("status").cast(pl.String)).len().iter_rows())
        assert {word: count for word, count in found.status.items() if count} == counted
        assert found.along_sigma_m is not None
        assert found.along_sigma_m.max_m == mine["along_sigma_m"].max()
        assert found.along_sigma_m.p50_m == mine["along_sigma_m"].quantile(0.5)
        assert record["antennas"][antenna]["filter"] == asdict(found)


@pytest.mark.requirement("E5")
def test_chunks_change_nothing(tracked: RunSummary, tmp_path: Path) -> None:
    other = _run(tmp_path / "run", Config(filter="track"), 13)
    assert_frame_equal(*(pl.read_parquet(s.files["train.parquet"]) for s in (tracked, other)), abs_tol=1e-9)


@pytest.mark.requirement("E5")
def test_single_epochs_are_the_same_with_and_without(tracked: RunSummary, tmp_path: Path) -> None:
    off = _run(tmp_path / "run", Config(filter="off"), 1000)
    assert "train.csv" not in off.files
    assert_frame_equal(*(pl.read_parquet(s.files["positions.parquet"]) for s in (tracked, off)))


@pytest.mark.requirement("E5")
def test_innovations_are_in_the_table_of_observations(tracked: RunSummary) -> None:
    rows = pl.read_parquet(tracked.files["observations.parquet"])
    assert rows.columns == list(OBSERVATION_COLUMNS)
    used = rows.filter(pl.col("weight_code") > 0.9)
    assert len(used) > 500
    assert used["innovation_code_m"].abs().median() < 5.0
    assert rows["innovation_phase_m"].drop_nulls().abs().median() < 0.1


@pytest.mark.requirement("E5")
@pytest.mark.parametrize(("given", "written"), [((), True), (("--filter", "off"), False)])
def test_the_command_tracks_unless_told_not_to(tmp_path: Path, given: tuple[str, ...], written: bool) -> None:
    demo, out = demo_inputs(), tmp_path / "run"
    words = ["run", "--front", demo.front[0], "--nav", demo.nav[0], "--track", demo.track[0], "--out", out]
    words += ["--end", "2024-03-05T03:10:03", *given]
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    assert (out / "train.csv").exists() is written
    assert ("Filter along the track (train.csv)" in result.output) is written
