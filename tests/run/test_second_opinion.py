"""Virtual balises and the check by a batch in a run of the demonstration."""

from __future__ import annotations

from dataclasses import fields, replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest

from railfix.pipeline.config import Config
from railfix.pipeline.tables import PASSING_COLUMNS
from railfix.run import RunOptions, run_files
from railfix.run.batch_check import BATCH_COLUMNS, BatchCheck
from railfix.simulate.demonstration import demo_inputs
from railfix.tracking import Tracked
from railfix.tracking.batch import joined_epochs
from tracking_cases import bent_line, part, ride


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


@pytest.mark.requirement("E7")
@pytest.mark.parametrize("cuts", [(), (5,), (13, 27), (10, 20, 30)])
def test_the_batch_has_the_first_epoch_of_each_second_once_however_the_log_is_cut(cuts: tuple[int, ...]) -> None:
    case = ride(4, rate_hz=10.0)
    count = len(case.epochs)
    check, tracked = BatchCheck(trajectory=bent_line()), Tracked.empty(case.epochs.time, 0)
    tracked = replace(tracked, arc_m=case.arc_m, sigma_m=np.full(count, 2.0))
    for first, last in pairwise((0, *cuts, count)):
        own = {f.name: getattr(tracked, f.name)[first:last] for f in fields(Tracked)}
        replay = SimpleNamespace(epochs=part(case.epochs, slice(first, last)))
        given: Any = SimpleNamespace(time=own["time"], replay=(replay,), tracked=Tracked(**own))
        check.take(given)
    seconds = case.epochs.time.astype("datetime64[s]")
    rows = np.flatnonzero(np.diff(seconds.astype(np.int64), prepend=-1) > 0)
    np.testing.assert_array_equal(joined_epochs(check._epochs).time, case.epochs.time[rows])
    np.testing.assert_array_equal(np.concatenate(check._places)[:, 0], case.arc_m[rows])
