"""Virtual balises in a run of the demonstration."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import polars as pl
import pytest
from typer.testing import CliRunner

from railfix import read_observations, write_observations
from railfix.cli import app
from railfix.pipeline.config import Config
from railfix.pipeline.result_tables import PASSING_COLUMNS
from railfix.run import RunOptions, run_files
from railfix.simulate.demonstration import demo_files, demo_inputs


@pytest.mark.slow
@pytest.mark.requirement("E7")
def test_a_run_writes_the_passings_of_virtual_balises(tmp_path: Path) -> None:
    (tmp_path / "virtual.csv").write_text("balise,chainage_m\nV1,150\nV2,250\n")
    options = RunOptions(end=datetime(2024, 3, 5, 3, 11))
    inputs = demo_inputs().replaced(virtual_balises=tmp_path / "virtual.csv", rear=())
    run = run_files(inputs, Config(filter="track"), out=tmp_path / "out", options=options)
    passings = pl.read_parquet(run.files["passings.parquet"])
    assert passings.columns == list(PASSING_COLUMNS)
    assert passings["balise"].to_list() == ["V1", "V2"]
    assert (passings["earliest_gpst"] < passings["time_gpst"]).all()
    assert (passings["time_gpst"] < passings["latest_gpst"]).all()


@pytest.mark.requirement("A8", "E7")
def test_no_passings_are_the_same_empty_tables_of_a_log_and_of_a_session(tmp_path: Path) -> None:
    (tmp_path / "virtual.csv").write_text("balise,chainage_m\nV1,700\n")
    files, log = demo_files(), tmp_path / "front.rnx"
    write_observations(read_observations(files["front"])[:20], log)
    words = ["--front", log, *(word for name in ("nav", "track", "vehicle") for word in (f"--{name}", files[name]))]
    for command in ("run", "live"):
        told = ["--virtual-balises", tmp_path / "virtual.csv", "--out", tmp_path / command]
        done = CliRunner().invoke(app, [command, *map(str, [*words, *told])])
        assert done.exit_code == 0, done.output
    names = sorted({path.name for path in (tmp_path / "run").iterdir()} - {"run.json"})
    assert names == sorted(path.name for path in (tmp_path / "live").iterdir())
    assert (tmp_path / "run" / "passings.csv").read_bytes() == (tmp_path / "live" / "passings.csv").read_bytes()
