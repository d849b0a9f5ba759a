"""``railfix explain``: what a satellite does to the position, which epoch is meant, what is said of it."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from railfix.cli import app
from railfix.core.errors import MismatchError, SettingsError
from railfix.core.reasons import Status
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import parse_config
from railfix.report.explain import FILTER_STATUS, SINGLE_STATUS, explain_epoch
from railfix.run import RunOptions, run_files
from railfix.run.processor_setup import make_processor
from railfix.simulate.demonstration import demo_inputs, demo_truth
from railfix.track import read_track
from railfix.track.vehicle import antenna_trajectory, read_vehicle
from railfix.tracking import TrackStatus

RUNNER = CliRunner(env={"COLUMNS": "200", "TERM": "dumb", "NO_COLOR": "1"})
pytestmark = pytest.mark.requirement("G4")


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty seconds of the demonstration, on a map with heights above the geoid, which only the options name."""
    out = tmp_path_factory.mktemp("explained") / "results"
    first = pl.read_csv(demo_truth(), try_parse_dates=True)["time_gpst"][0]
    points = pl.read_csv(demo_inputs().track[0], comment_prefix="#").rename({"height_m": "elevation_m"})
    points.with_columns(pl.col("elevation_m") - 36.415).write_csv(out.parent / "line.csv")
    options = RunOptions(observations="write", end=first + timedelta(seconds=20), track={"geoid": "egm96"})
    inputs = demo_inputs().model_copy(update={"track": (out.parent / "line.csv",)})
    run_files(inputs, parse_config({"filter": "track"}), out=out, options=options)
    return out


def test_the_position_without_a_satellite_is_that_of_solving_again(tmp_path: Path) -> None:
    """The first epoch of one antenna, on which none before it and no other antenna has a bearing."""
    inputs = demo_inputs()
    assert inputs.vehicle is not None
    path = antenna_trajectory(read_track(inputs.track), read_vehicle(inputs.vehicle), "front")
    log, navigation = read_observations(inputs.front)[:1], read_navigation(inputs.nav)
    config = parse_config({"filter": "off"})
    end = log.time[0].astype("datetime64[ms]").item() + timedelta(seconds=1)
    options = RunOptions(observations="write", end=end)
    run_files(inputs.model_copy(update={"rear": ()}), config, out=tmp_path / "front", options=options)

    def place(left: np.ndarray) -> float:
        part = replace(log, code_m=np.where(left, np.nan, log.code_m))
        result, _ = make_processor(config, navigation, {"front": path}).process({"front": part})
        return float(result.antennas["front"].arc_m[0])

    found = explain_epoch(tmp_path / "front", str(log.time[0])[:23])
    assert found.time == log.time[0]
    moved = found.satellites.filter(pl.col("without_shift_m").is_not_null())
    assert len(moved) == found.single["n_used"] >= 8
    shape, everything = log.code_m.shape, place(np.zeros(log.code_m.shape, dtype=bool))
    exact = [place(np.broadcast_to(log.satellite == name, shape)) - everything for name in moved["satellite"]]
    np.testing.assert_allclose(moved["without_shift_m"].to_numpy(), exact, atol=0.05)
    assert np.abs(exact).max() > 0.3, "nothing to be seen"
    left_out = found.satellites.filter(pl.col("reason_text") != "used")
    assert len(left_out)
    assert left_out["without_shift_m"].null_count() == len(left_out)


def test_every_status_has_its_words() -> None:
    assert set(SINGLE_STATUS) == {status.text for status in Status}
    assert set(FILTER_STATUS) == {status.text for status in TrackStatus}


def test_the_nearest_epoch_is_meant_and_another_time_is_refused(results: Path) -> None:
    times = pl.read_parquet(results / "positions.parquet").filter(antenna="rear")["time_gpst"].to_numpy()
    clock = str(times[7] + np.timedelta64(30, "ms"))[11:23]
    found = explain_epoch(results, clock, antenna="rear")
    assert (found.antenna, found.time) == ("rear", times[7])
    assert found.track["antenna"] == found.single["antenna"] == "rear"
    with pytest.raises(MismatchError, match="no epoch within a minute of 23:59:00; it goes from 2024-03-05"):
        explain_epoch(results, "23:59:00")
    for wrong in ("noon", "03:10:05Z", "2024-03-05 03:10:05+09:00"):
        with pytest.raises(SettingsError, match=f"time is '{re.escape(wrong)}', expected hh:mm:ss"):
            explain_epoch(results, wrong)
    with pytest.raises(SettingsError, match="antenna is 'middle', the run has front and rear"):
        explain_epoch(results, clock, antenna="middle")


def test_the_command_prints_and_writes_the_epoch(results: Path, tmp_path: Path) -> None:
    time = str(pl.read_parquet(results / "train.parquet")["time_gpst"].to_numpy()[-1])
    page = tmp_path / "epoch.html"
    arguments = ["explain", str(results), "--at", time[11:19], "--html", str(page)]
    done = RUNNER.invoke(app, arguments)
    assert done.exit_code == 0, done.output
    for words in (
        "filter: chainage",
        "filter's level:",
        "single epoch's level:",
        "largest effect: without",
        "elevation_mask",
    ):
        assert words in done.output
    text = page.read_text()
    rows = text.count('<tr><th scope="row">') - 10  # ten of the epoch beside those of the satellites
    assert text.count("<circle class=") - 3 == rows > 8
    assert text.count('class="asked" aria-current="true"') == 1
    assert RUNNER.invoke(app, arguments).exit_code == 8, "the page was there already"
    (results / "observations.parquet").rename(tmp_path / "observations.parquet")
    done = RUNNER.invoke(app, arguments[:4])
    assert done.exit_code == 3
    assert "repeat the run with --observations" in done.output
