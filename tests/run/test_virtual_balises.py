"""Virtual balises in a run of the demonstration."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import polars as pl
import pytest

from railfix.pipeline.config import Config
from railfix.pipeline.result_tables import PASSING_COLUMNS
from railfix.run import RunOptions, run_files
from railfix.simulate.demonstration import demo_inputs


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
