"""Virtual balises and the check by a batch in a run of the demonstration."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from railfix.pipeline.config import Config
from railfix.pipeline.tables import PASSING_COLUMNS
from railfix.run import RunOptions, run_files
from railfix.run.batch_check import BATCH_COLUMNS
from railfix.simulate.demonstration import demo_inputs


@pytest.mark.slow
@pytest.mark.requirement("E7")
def test_a_run_writes_passings_and_the_places_of_the_batch(tmp_path: Path) -> None:
    (tmp_path / "virtual.csv").write_text("balise,chainage_m\nV1,150\nV2,250\n")
    options = RunOptions(end=datetime(2024, 3, 5, 3, 11), check="batch")
    inputs = demo_inputs().replaced(virtual_balises=tmp_path / "virtual.csv", rear=())
    run = run_files(inputs, Config(filter="track"), out=tmp_path / "out", options=options)
    passings = pl.read_parquet(run.files["passings.parquet"])
    assert passings.columns == list(PASSING_COLUMNS)
    assert passings["balise"].to_list() == ["V1", "V2"]
    assert (passings["earliest_gpst"] < passings["time_gpst"]).all()
    assert (passings["time_gpst"] < passings["latest_gpst"]).all()
    train = pl.read_parquet(run.files["train.parquet"])
    both = train.select("chainage_m", *BATCH_COLUMNS).drop_nulls()
    assert 50 < len(both) <= 61
    assert np.abs(both["chainage_m"] - both["batch_chainage_m"]).max() < 10.0
    (note,) = (note for note in run.notes if "batch check" in note)
    assert "filter and batch agree at all" in note
