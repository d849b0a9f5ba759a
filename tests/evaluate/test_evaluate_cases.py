"""Evaluation of made-up runs whose figures can be worked out by hand."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

import synthetic
from conftest import ROOT
from railfix.cli import app
from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.settings import validate
from railfix.core.timescale import timedelta
from railfix.evaluate import (
    BEYOND_COLUMNS,
    EPOCH_COLUMNS,
    FIGURE_COLUMNS,
    INTERVAL_COLUMNS,
    LEVEL_COLUMNS,
    STANFORD_COLUMNS,
    EvaluationOptions,
    RunAndReference,
    TrackFiles,
    evaluate_run,
    evaluate_runs,
)
from railfix.evaluate.accuracy import block_limits
from railfix.evaluate.epoch_table import distance_travelled, with_missing
from railfix.evaluate.evaluation_inputs import list_position_tables
from railfix.evaluate.intervals import BRANCH_COLUMNS, OUTAGE_COLUMNS
from railfix.io.reference_log import AntennaReference
from railfix.io.sections import read_sections
from railfix.run import run_files
from railfix.simulate.demonstration import demo_inputs
from railfix.track import Track, read_track, write_track_csv
from run_made import LINE, START, at, reference, write_reference, write_run

pytestmark = pytest.mark.requirement("D2")


def limits_of(found: dict[str, float], name: str) -> tuple[float, float]:
    """Lower and upper limit of one figure."""
    return found[name.format("_low")], found[name.format("_high")]


def test_errors_and_rates_by_hand(tmp_path: Path):
    """Six epochs of which one has no position, one a gross error, one a reference that is too bad."""
    time, place = np.arange(6.0), np.arange(100.0, 160.0, 10.0)
    answer = place + np.array([1.0, -2.0, np.nan, 3.0, 60.0, 100.0])
    sigma = np.array([0.1, 0.1, 0.1, 0.1, 0.1, 0.6])
    status = ["ok", "ok", "too_few_satellites", "uncertain", "ok", "ok"]
    run = write_run(tmp_path / "run", time, answer, status=status, conventional=place + np.array([5.0] * 5 + [np.nan]))
    found = evaluate_run(run, reference(time, place, sigma_m=sigma))
    expected = {"epochs": 6, "observed": 6, "positions": 5, "left_out": 1, "errors": 4, "wrong_places": 1}
    assert {name: found.figure(name) for name in expected} == expected
    assert found.figure("rate") == pytest.approx(5 / 6)
    assert found.figure("mean_m") == pytest.approx(15.5, abs=1e-6)
    assert found.figure("std_m") == pytest.approx(np.std([1.0, -2.0, 3.0, 60.0]), abs=1e-6)
    assert found.figure("rms_m") == pytest.approx(np.sqrt((1 + 4 + 9 + 3600) / 4), abs=1e-6)
    assert found.figure("p50_m") == pytest.approx(2.5, abs=1e-6)
    assert found.figure("lowest_m") == pytest.approx(-2.0, abs=1e-6)
    assert found.figure("max_m") == pytest.approx(60.0, abs=1e-6)
    assert found.figure("max_at_chainage_m") == pytest.approx(140.0, abs=1e-6)
    assert found.figure("max_at_time") == (START + np.timedelta64(4, "s")).astype("datetime64[us]").item()
    assert [found.figure(f"over_{limit}_m") for limit in (5, 10, 20, 50)] == [0.25] * 4
    assert found.figure("over_1_sigma") == pytest.approx(0.5)  # 3 and 60 over 2; the 2.0 is not over it
    assert found.figure("normalised_mean") == pytest.approx(15.5 / 2, abs=1e-6)
    assert found.figure("positions", position="constrained_ok") == 4
    assert found.figure("rate", position="constrained_ok") == pytest.approx(4 / 6)
    assert found.figure("positions", epochs_of="common") == 4
    assert found.figure("mean_m", position="conventional", epochs_of="common") == pytest.approx(5.0, abs=1e-6)
    assert found.figure("positions", position="conventional") == 5
    assert found.figure("over_1_sigma", position="conventional") is None
    statuses = found.figures.filter(grouping="status", position="constrained", epochs_of="own")
    assert dict(zip(statuses["group"], statuses["errors"], strict=True)) == {
        "ok": 3,
        "too_few_satellites": 0,
        "uncertain": 1,
    }
    assert statuses.filter(group="too_few_satellites")["mean_m"].item() is None


def test_another_table_of_the_same_run_stands_beside_the_positions(tmp_path: Path):
    """The filter has a position in the tunnel, where no satellite is observed, and a sigma of its own."""
    time, place = np.arange(10.0), 100.0 + 10.0 * np.arange(10.0)
    tunnel = (time >= 4) & (time < 7)
    answer = np.where(tunnel, np.nan, place + 3.0)
    status = np.where(tunnel, "no_observation", "ok").tolist()
    run = write_run(tmp_path / "run", time, answer, status=status, conventional=np.where(tunnel, np.nan, place + 8.0))
    train = pl.read_parquet(run / "positions.parquet").select("time_gpst", "antenna")
    places = at(place + 1.0)
    train = train.with_columns(
        status=pl.Series(np.where(tunnel, "coasting", "tracking")),
        chainage_m=pl.Series(place + 1.0),
        along_sigma_m=pl.Series(np.full(10, 0.5)),
        protection_level_m=pl.Series(np.full(10, 6.0)),
        branch_probability=pl.Series(np.where(time < 2, 0.95, 0.9995)),
        sources=pl.Series(np.where(tunnel, "wheel+force", "code+doppler")),
        **{f"{axis}_m": pl.Series(places[:, i]) for i, axis in enumerate("xyz")},
    )
    train.write_csv(run / "train.csv")
    assert list_position_tables(run) == ["positions", "train"]
    truth = reference(time, place)
    both = [RunAndReference(run=run, reference=truth, table=name) for name in ("positions", "train")]
    found = evaluate_runs(both)
    single, tracked = {"run": "run"}, {"run": "run (train)"}
    assert (found.figure("positions", **single), found.figure("positions", **tracked)) == (7, 10)
    assert (found.figure("rate", **single), found.figure("rate", **tracked)) == (1.0, 1.0)
    assert (found.figure("rate_of_run", **single), found.figure("rate_of_run", **tracked)) == (0.7, 1.0)
    assert found.figure("max_m", **single) == pytest.approx(3.0, abs=1e-6)
    assert found.figure("max_m", **tracked) == pytest.approx(1.0, abs=1e-6)
    assert found.figure("distance_p95_m", **tracked) == pytest.approx(1.0, abs=1e-6)
    assert found.figure("normalised_p68", **single) == pytest.approx(1.5, abs=1e-6)
    assert found.figure("normalised_p95", **tracked) == pytest.approx(2.0, abs=1e-6)
    assert found.figure("positions", position="constrained_ok", **tracked) == 7
    assert found.figure("mean_m", position="conventional", **tracked) == pytest.approx(8.0, abs=1e-6)
    assert set(found.integrity) == {"train"}
    usable = found.integrity["train"].stanford.filter(levels_of="usable", alarm_limit_m=10.0, grouping="all")
    assert usable["nominal"].item() == 10  # tracking and coasting state a bound
    assert found.figure("positions", grouping="signals", group="without satellites", **tracked) == 3
    assert found.figure("positions", grouping="signals", group="without satellites", **single) == 0
    assert found.outages is not None
    (outage,) = found.outages.to_dicts()
    assert (outage["run"], outage["epochs"], outage["positions"]) == ("run (train)", 3, 3)
    assert (outage["duration_s"], outage["carried_by"]) == (3.0, "wheel+force")
    assert outage["travelled_m"] == pytest.approx(30.0, abs=1e-6)
    assert outage["outage_max_m"] == pytest.approx(1.0, abs=1e-6)
    assert outage["largest_normalised"] == pytest.approx(2.0, abs=1e-6)
    assert found.branches is not None
    classes = {row["probability"]: row for row in found.branches.to_dicts()}
    assert {name: row["judged"] for name, row in classes.items()} == {"0.9 to 0.99": 2, "0.999 to 1": 8, "all": 10}
    assert classes["all"]["probability_mean"] == pytest.approx(0.9896)
    assert classes["all"]["right_share"] == 1.0
    assert found.runs[0].configuration != found.runs[1].configuration
    result = CliRunner().invoke(app, ["evaluate", str(run), "--reference", "auto"])
    assert result.exit_code == 3  # no log to look for a reference beside; both tables were asked for


def test_an_outage_by_hand(tmp_path: Path):
    """Six epochs without a satellite from 04 on; the reference is too bad at 06, the last has no position."""
    time, place = np.arange(14.0), 100.0 + 10.0 * np.arange(14.0)
    tunnel = (time >= 4) & (time < 10)
    error = np.array([0.0] * 4 + [1.0, -2.0, 50.0, 3.0, -4.0, np.nan] + [0.0] * 4)
    sigma = np.array([0.5] * 4 + [1.0, 1.5, 2.0, 2.5, 3.0, 3.5] + [0.5] * 4)
    answer = np.where(tunnel, np.nan, place)
    status = np.where(tunnel, "no_observation", "ok").tolist()
    run = write_run(tmp_path / "run", time, answer, status=status)
    places = at(place + error)
    pl.read_parquet(run / "positions.parquet").select("time_gpst", "antenna").with_columns(
        status=pl.Series(np.where(tunnel, "coasting", "tracking")),
        chainage_m=pl.Series(place + error, nan_to_null=True),
        along_sigma_m=pl.Series(sigma),
        branch_probability=pl.Series(np.full(14, 0.9995)),
        sources=pl.Series(np.where(tunnel, "wheel", "code")),
        **{f"{axis}_m": pl.Series(places[:, i], nan_to_null=True) for i, axis in enumerate("xyz")},
    ).write_parquet(run / "train.parquet")
    truth = reference(time, place, sigma_m=np.where(time == 6.0, 5.0, 0.1))
    found = evaluate_runs([RunAndReference(run=run, reference=truth, table=name) for name in ("positions", "train")])
    assert found.outages is not None
    (outage,) = found.outages.to_dicts()
    assert outage["begin_gpst"] == (START + np.timedelta64(4, "s")).astype("datetime64[us]").item()
    assert (outage["duration_s"], outage["epochs"], outage["positions"]) == (6.0, 6, 5)
    expected = {"p50": 2.5, "p95": np.percentile([1.0, 2.0, 3.0, 4.0], 95.0), "max": 4.0}
    assert {name: outage[f"outage_{name}_m"] for name in expected} == pytest.approx(expected, abs=1e-6)
    assert outage["end_error_m"] == pytest.approx(-4.0, abs=1e-6)
    assert outage["end_sigma_m"] == 3.0
    assert outage["largest_normalised"] == pytest.approx(4.0 / 3.0, abs=1e-6)


def test_percentiles_of_gaps_and_levels_by_hand(tmp_path: Path):
    """Positions at 20 of 101 epochs with ever longer gaps; levels of 1 to 20 m."""
    time, place = np.arange(101.0), 100.0 + 10.0 * np.arange(101.0)
    has = np.zeros(101, dtype=bool)
    instants = np.cumsum([0, *range(1, 13)])
    has[instants] = True
    level = np.full(101, np.nan)
    level[instants] = np.arange(1.0, 14.0)
    run = write_run(tmp_path / "run", time, np.where(has, place, np.nan), along_protection_level_m=level)
    found = evaluate_run(run, reference(time, place))
    row = found.intervals.filter(position="constrained").row(0, named=True)
    gaps = np.arange(1.0, 13.0)
    for name, scale in (("gap_{}_s", 1.0), ("interval_{}_m", 10.0)):
        for percent in (50, 95):
            expected = scale * np.percentile(gaps, percent)
            assert row[name.format(f"p{percent}")] == pytest.approx(expected, abs=1e-6), (name, percent)
    assert found.levels is not None
    levels = found.levels.filter(position="constrained").row(0, named=True)
    assert (levels["level_p50_m"], levels["level_p95_m"]) == pytest.approx((7.0, 12.4))


def test_the_conventional_position_of_another_run_on_the_same_log(tmp_path: Path):
    time, place = np.arange(6.0), np.arange(100.0, 160.0, 10.0)
    run = write_run(tmp_path / "run", time, place + 1.0, conventional=np.where(time < 2, np.nan, place + 2.0))
    other = write_run(tmp_path / "unscreened", time, place, conventional=place + 9.0)
    item = RunAndReference(run=run, reference=reference(time, place), conventional=other)
    found = evaluate_runs([item])
    assert found.figure("mean_m") == pytest.approx(1.0, abs=1e-6)
    assert found.figure("positions", position="conventional") == 6
    assert found.figure("mean_m", position="conventional") == pytest.approx(9.0, abs=1e-6)
    record = json.loads((other / "run.json").read_text())
    record["inputs"] = [{"input": "front", "path": "other.obs", "bytes": 1, "sha256": "0"}]
    (other / "run.json").write_text(json.dumps(record))
    with pytest.raises(MismatchError, match="is not a run on the log of"):
        evaluate_runs([item])


def test_accepted_qualities_of_the_reference(tmp_path: Path):
    """Of six rows every second one is a float solution: used when asked for."""
    time, place = np.arange(6.0), np.arange(100.0, 160.0, 10.0)
    run, truth = write_run(tmp_path / "run", time, place), reference(time, place)["front"]
    rows = pl.DataFrame({"time_gpst": truth.time, "chainage_m": place, "quality": [1, 2] * 3}).with_columns(
        pl.Series(name, column) for name, column in zip(("x_m", "y_m", "z_m"), truth.ecef_m.T, strict=True)
    )
    rows.write_csv(tmp_path / "rtk.csv")
    words = ["evaluate", str(run), "--reference", str(tmp_path / "rtk.csv"), "--reference-gap", "0.5"]
    words += ["--method", "chainage", "--out", str(tmp_path / "out"), "--overwrite"]
    for more, positions in (([], 3), (["--reference-quality", "1,2"], 6)):
        result = CliRunner().invoke(app, [*words, *more])
        assert result.exit_code == 0, result.output
        errors = pl.read_parquet(tmp_path / "out" / "errors.parquet")
        assert errors["error_m"].is_not_null().sum() == positions


@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize("method", ["chainage", "trajectory"])
def test_the_sign_does_not_turn_with_the_train(tmp_path: Path, direction: float, method: str):
    """An answer 3 m nearer the end of the line is +3 m, running up or down."""
    time = np.arange(20.0)
    place = 1000.0 + direction * 20.0 * time
    track = tmp_path / "line.csv"
    write_track_csv(LINE, track)
    run = write_run(tmp_path / "run", time, place + 3.0, track=track)
    found = evaluate_run(run, reference(time, place), options=EvaluationOptions(method=method))
    assert found.figure("mean_m") == pytest.approx(3.0, abs=2e-3)
    assert found.figure("std_m") == pytest.approx(0.0, abs=2e-3)
    assert found.epochs["speed_mps"].to_numpy() == pytest.approx(20.0, abs=1e-6)
    assert found.intervals.filter(position="constrained")["interval_max_m"].item() == pytest.approx(20.0, abs=1e-6)


def test_a_tunnel_without_epochs_counts_in_the_rate_of_the_run(tmp_path: Path):
    """1 Hz at 20 m/s: 10 epochs, 30 s of tunnel that the log skips, 10 epochs."""
    time = np.concatenate([np.arange(10.0), np.arange(40.0, 50.0)])
    whole = np.arange(50.0)
    environment = np.where((whole >= 10) & (whole < 40), "tunnel", "open")
    run = write_run(tmp_path / "run", time, 20.0 * time)
    found = evaluate_run(run, reference(whole, 20.0 * whole, environment=environment))
    assert found.figure("rate") == 1.0
    assert found.figure("rate_of_run") == pytest.approx(20 / 50)
    tunnel = {"grouping": "environment", "group": "tunnel"}
    assert (found.figure("epochs", **tunnel), found.figure("observed", **tunnel)) == (30, 0)
    assert found.figure("rate", **tunnel) is None
    assert found.figure("rate_of_run", **tunnel) == 0.0
    assert found.figure("rate_of_run", grouping="environment", group="open") == 1.0
    gap = found.intervals.filter(position="constrained").row(0, named=True)
    assert gap["interval_max_m"] == pytest.approx(31 * 20.0, abs=1e-6)
    assert gap["gap_max_s"] == pytest.approx(31.0)
    assert gap["interval_max_chainage_m"] == pytest.approx(180.0, abs=1e-6)
    assert gap["interval_max_from"] == found.epochs["time_gpst"][9]
    assert gap["interval_p50_m"] == pytest.approx(20.0, abs=1e-6)
    assert found.epochs.filter(status="not_logged").height == 30


def test_the_reference_that_is_missing_in_the_tunnel_is_not_the_run_s_fault(tmp_path: Path):
    """Epochs outside the reference count nowhere; the distance run over its gap is kept."""
    time = np.arange(50.0)
    known = np.concatenate([np.arange(10.0), np.arange(40.0, 50.0)])
    answer = np.where((time >= 9.5) & (time < 39.5), np.nan, 20.0 * time)
    found = evaluate_run(write_run(tmp_path / "run", time, answer), reference(known, 20.0 * known))
    assert found.runs[0].outside == {"front": 30}
    assert found.figure("epochs") == 20
    assert found.figure("rate_of_run") == 1.0
    assert found.intervals.filter(position="constrained")["interval_max_m"].item() == pytest.approx(620.0, abs=1e-6)
    fixed = evaluate_run(write_run(tmp_path / "fixed", time, 20.0 * time), reference(known, 20.0 * known))
    table = fixed.epochs.filter(pl.col("time_gpst") == START + np.timedelta64(25, "s"))
    assert table["interval_m"].item() == pytest.approx(20.0, abs=1e-6)
    assert table["in_reference"].item() is False
    row = fixed.intervals.filter(position="constrained").row(0, named=True)
    assert (row["intervals"], row["gap_max_s"]) == (49, pytest.approx(1.0))
    assert row["interval_max_m"] == pytest.approx(20.0, abs=1e-6)


def test_gaps_outside_the_reference_do_not_count(tmp_path: Path):
    """Positions before the reference begins and after it ends, some of them 7 s apart."""
    time = np.concatenate([[0.0, 7.0], np.arange(8.0, 20.0), [27.0, 34.0]])
    known = np.arange(8.0, 20.0)
    found = evaluate_run(write_run(tmp_path / "run", time, 20.0 * time), reference(known, 20.0 * known))
    rows = found.epochs.filter(pl.col("gap_s").is_not_null())
    assert rows["gap_s"].to_list() == pytest.approx([1.0] * 11)
    assert rows["time_gpst"].to_numpy().tolist() == (START + timedelta(known[1:])).tolist()
    assert found.intervals.filter(position="constrained")["gap_max_s"].item() == pytest.approx(1.0)


def test_standing_is_no_interval_and_turning_is_one(tmp_path: Path):
    """Runs 5 s up at 10 m/s, stands 10 s with a reference that trembles, runs back without a position at the turn."""
    time = np.arange(21.0)
    place = np.concatenate([100.0 + 10.0 * np.arange(6), np.full(10, 150.0), 150.0 - 10.0 * np.arange(1, 6)])
    place[6:15] += np.tile([0.05, -0.05, 0.02], 3)
    answer = place.copy()
    answer[[3, 4, 5]] = np.nan
    found = evaluate_run(write_run(tmp_path / "run", time, answer), reference(time, place))
    row = found.intervals.filter(position="constrained").row(0, named=True)
    assert row["standing"] == 9
    assert row["intervals"] == 2 + 1 + 5
    assert row["interval_max_m"] == pytest.approx(30.0, abs=1e-6)
    assert row["gap_max_s"] == pytest.approx(4.0)
    speeds = found.figures.filter(grouping="speed", position="constrained", epochs_of="own")
    assert dict(zip(speeds["group"], speeds["epochs"], strict=True))["standing"] == 9


def test_distance_over_a_turn_between_two_positions_is_the_way_and_not_the_displacement():
    time = START + timedelta(np.arange(5.0))
    chainage = np.array([0.0, 10.0, 20.0, 10.0, 0.0])
    moved = distance_travelled(
        time, np.abs(np.diff(chainage)), np.ones(5, dtype=bool), np.full(5, np.nan), options=EvaluationOptions()
    )
    assert moved == pytest.approx([0.0, 10.0, 20.0, 30.0, 40.0])
    told = np.array([0.0, 0.1, 0.1, 0.1, 0.0])  # the reference says that it stands
    moved = distance_travelled(time, np.full(4, 0.4), np.ones(5, dtype=bool), told, options=EvaluationOptions())
    assert moved == pytest.approx(np.zeros(5))


def test_epochs_are_put_in_at_the_step_of_the_log():
    """Tags off the whole second stay as they are; a gap of three steps gets two."""
    time = START + timedelta(np.array([0.0, 1.003, 1.998, 3.0, 6.0, 7.0]))
    whole, logged, step = with_missing(time)
    assert step == pytest.approx(1.0, abs=0.01)
    assert logged.tolist() == [True, True, True, True, False, False, True, True]
    assert (whole[~logged] == START + timedelta(np.array([4.0, 5.0]))).all()
    assert (whole[logged] == time).all()
    alone, logged, step = with_missing(time[:1])
    assert (len(alone), logged.all(), np.isnan(step)) == (1, True, True)


def test_limits_by_blocks_by_hand():
    """Six blocks of which one is without a position: the mean is drawn from five values, the rate from six."""
    block = np.repeat(np.arange(6), 10)
    error = np.repeat([1.0, 1.0, 1.0, 1.0, 1.0, np.nan], 10)
    has = np.isfinite(error)
    arguments = {"replicates": 2000, "seed": 3, "confidence": 0.95}
    found = block_limits(error, np.full(60, 2.0), np.ones(60, dtype=bool), has, block, **arguments)
    assert found["blocks"] == 6
    assert limits_of(found, "mean{}_m") == limits_of(found, "p95{}_m") == (1.0, 1.0)
    assert limits_of(found, "normalised_p68{}") == limits_of(found, "normalised_p95{}") == (0.5, 0.5)
    # The number of draws of the empty block is binomial (6, 1/6): P(0) = 0.335, P(at least 3) = 0.062,
    # P(at least 4) = 0.0087; so the upper limit is 1 and the lower one 1/2.
    assert limits_of(found, "rate{}") == (pytest.approx(0.5), 1.0)
    few = block_limits(error[:40], np.ones(40), np.ones(40, dtype=bool), has[:40], block[:40], **arguments)
    assert few.pop("blocks") == 4
    assert np.isnan([*few.values()]).all()


def test_limits_widen_with_errors_that_stay():
    """The same errors, once independent and once the same for a minute: the mean is known ten times worse."""
    rng = np.random.default_rng(1)
    block = np.repeat(np.arange(40), 100)
    seen = np.ones(4000, dtype=bool)
    arguments = {"replicates": 1000, "seed": 0, "confidence": 0.95}
    free = block_limits(rng.normal(size=4000), np.ones(4000), seen, seen, block, **arguments)
    stuck = block_limits(np.repeat(rng.normal(size=40), 100), np.ones(4000), seen, seen, block, **arguments)
    width = [high - low for low, high in (limits_of(found, "mean{}_m") for found in (free, stuck))]
    assert width[0] == pytest.approx(2 * 1.96 / np.sqrt(4000), rel=0.3)
    assert width[1] == pytest.approx(2 * 1.96 / np.sqrt(40), rel=0.3)


def test_percentiles_of_the_draws_are_exact_with_many_errors():
    """Over the number of nodes, against the draws made one by one."""
    rng = np.random.default_rng(5)
    error, block = rng.standard_cauchy(9000), rng.integers(0, 7, 9000)
    seen = np.ones(9000, dtype=bool)
    sigma = rng.uniform(0.5, 2.0, 9000)
    found = block_limits(error, sigma, seen, seen, block, replicates=50, seed=2, confidence=0.9)
    draws, ratios = [], []
    for drawn in np.random.default_rng(2).integers(0, 7, (50, 7)):
        values = np.concatenate([np.abs(error[block == b]) for b in drawn])
        draws.append(np.quantile(values, 0.95, method="inverted_cdf"))
        values = np.concatenate([np.abs(error[block == b]) / sigma[block == b] for b in drawn])
        ratios.append(np.quantile(values, 0.68, method="inverted_cdf"))
    assert limits_of(found, "normalised_p68{}") == pytest.approx(tuple(np.percentile(ratios, [5.0, 95.0])), abs=1e-9)
    assert limits_of(found, "p95{}_m") == pytest.approx(tuple(np.percentile(draws, [5.0, 95.0])), abs=1e-9)


def test_chainage_is_not_taken_where_it_is_not_the_same(tmp_path: Path):
    """Another zero, another point of the vehicle, none at all: along the trajectory, and said; or refused."""
    time = np.arange(20.0)
    place = 500.0 + 20.0 * time
    track = tmp_path / "line.csv"
    write_track_csv(LINE, track)
    run = write_run(tmp_path / "run", time, place + 3.0, track=track)
    centre = write_run(tmp_path / "centre", time, place + 3.0, track=track, chainage_of="centre")
    moved = {"front": replace(reference(time, place)["front"], chainage_m=place + 100.0)}
    some = {"front": replace(reference(time, place)["front"], chainage_m=np.where(time < 3, np.nan, place))}
    for folder, known, told in (
        (run, moved, "not on the same map (median difference 94.0 m"),
        (run, some, "no chainage at 3 of 20"),
        (centre, reference(time, place), "refers to the centre"),
    ):
        found = evaluate_run(folder, known)
        assert found.runs[0].method == {"front": "trajectory"}
        assert any(told in note for note in found.runs[0].notes)
        assert found.figure("mean_m") == pytest.approx(3.0, abs=2e-3)
        assert found.epochs["chainage_m"].to_numpy() == pytest.approx(place, abs=2e-3)
        with pytest.raises(MismatchError, match="use the trajectory instead"):
            evaluate_run(folder, known, options=EvaluationOptions(method="chainage"))


def test_another_track_is_refused(tmp_path: Path):
    time = np.arange(20.0)
    place = 500.0 + 20.0 * time
    track, other = tmp_path / "line.csv", tmp_path / "other.csv"
    write_track_csv(LINE, track)
    shifted = synthetic.enu_to_ecef(np.stack([np.arange(0, 2001, 10.0), np.full(201, 4.0), np.zeros(201)], axis=1))
    write_track_csv(Track.from_ecef(shifted), other)
    run = write_run(tmp_path / "run", time, place, track=track)
    along = EvaluationOptions(method="trajectory")
    known = reference(time, place)
    with pytest.raises(MismatchError, match=r"other\.csv: is not the track of .* up to 4\.0"):
        evaluate_run(run, known, options=along, files=TrackFiles(track=(other,)))
    with pytest.raises(MismatchError, match=r"other\.csv: is not the track"):
        evaluate_run(run, known, files=TrackFiles(track=(other,)))
    moved = tmp_path / "moved.csv"
    track.rename(moved)
    with pytest.raises(InputFileError, match="no longer there; give it with --track"):
        evaluate_run(run, known, options=along)
    found = evaluate_run(run, known, options=along, files=TrackFiles(track=(moved,)))
    assert found.figure("max_m") < 2e-3
    assert read_track(moved).chainage_m[-1] == pytest.approx(2000.0, abs=0.01)
    moved.write_text("# note: the same with a remark\n" + moved.read_text())
    found = evaluate_run(run, known, options=along, files=TrackFiles(track=(moved,)))
    assert any("not identical to" in note for note in found.runs[0].notes)


def test_sections_tell_the_environment_where_the_reference_does_not(tmp_path: Path):
    file = tmp_path / "sections.csv"
    file.write_text("from_m,to_m,environment\n0,100,open\n100,200,cutting\n300,400,station\n")
    at_places = read_sections(file).at(np.array([0.0, 99.9, 100.0, 250.0, 300.0, 400.0, 400.1, np.nan]))
    assert at_places.tolist() == ["open", "open", "cutting", "", "station", "station", "", ""]
    time = np.arange(5.0)
    place = np.array([50.0, 99.0, 150.0, 250.0, 350.0])
    run = write_run(tmp_path / "run", time, place)
    told = np.array(["", "depot", "", "", ""])
    found = evaluate_run(run, reference(time, place, environment=told), sections=file)
    assert found.epochs["environment"].to_list() == ["open", "depot", "cutting", "unknown", "station"]
    assert any("for 3 of 5 epochs, the reference" in note for note in found.runs[0].notes)
    for text, line in (("0,100,open\n50,80,cutting\n", 3), ("5,5,open\n", 2), ("0,9,\n", 2)):
        file.write_text("from_m,to_m,environment\n" + text)
        with pytest.raises(InputFileError, match=f"line {line}"):
            read_sections(file)


def test_protection_levels_by_hand(tmp_path: Path):
    time, place = np.arange(5.0), 100.0 + 10.0 * np.arange(5)
    answer = place + np.array([1.0, 4.0, -4.0, 1.0, np.nan])
    level = np.array([3.0, 3.0, np.inf, 12.0, np.nan])
    run = write_run(tmp_path / "run", time, answer, along_protection_level_m=level)
    found = evaluate_run(run, reference(time, place))
    row = found.levels.filter(position="constrained").row(0, named=True)
    assert row["level"] == "along_protection_level_m"
    counts = ("observed", "positions", "infinite", "with_level", "errors", "over_level")
    assert [row[name] for name in counts] == [5, 4, 1, 3, 3, 1]
    assert row["level_share"] == pytest.approx(3 / 5)
    assert found.integrity == {}
    # in a tunnel the filter has levels where nothing was observed
    status = ["ok", "ok", "ok", "no_observation", "ok"]
    seen = write_run(tmp_path / "seen", time, answer, status=status, along_protection_level_m=level)
    row = evaluate_run(seen, reference(time, place)).levels.filter(position="constrained").row(0, named=True)
    assert (row["observed"], row["with_level"], row["level_share"]) == (4, 3, pytest.approx(2 / 4))
    bare = evaluate_run(write_run(tmp_path / "bare", time, answer), reference(time, place))
    assert bare.levels is None


def campaign(folder: Path) -> list[RunAndReference]:
    """Two days of GPS and of GPS with QZSS, 100 epochs each, errors of 2 and 1 m and of 4 and 3 m."""
    time = np.arange(100.0)
    place = 100.0 + 10.0 * time
    runs = []
    for systems, errors in (("G", (2.0, 4.0)), ("GJ", (1.0, 3.0))):
        for day, error in enumerate(errors):
            settings = {"preset": "p1", "systems": list(systems), "screens": ["elevation"], "noise": {"floor": 1.0}}
            run = write_run(folder / f"day{day}" / systems, time, place + error, settings=settings)
            runs.append(RunAndReference(run=run, reference=reference(time, place)))
    return runs


def test_a_campaign_by_configuration(tmp_path: Path):
    found = evaluate_runs(campaign(tmp_path))
    assert [run.name for run in found.runs] == ["day0/G", "day1/G", "day0/GJ", "day1/GJ"]
    assert {run.configuration for run in found.runs} == {"p1; systems: G", "p1; systems: G J"}
    for group, mean, lowest, highest in (("p1; systems: G", 3.0, 2.0, 4.0), ("p1; systems: G J", 2.0, 1.0, 3.0)):
        where = {"grouping": "configuration", "group": group}
        assert found.figure("errors", **where) == 200
        assert found.figure("mean_m", **where) == pytest.approx(mean, abs=1e-6)
        assert found.figure("std_m", **where) == pytest.approx(1.0, abs=1e-6)
        assert found.figure("lowest_m", **where) == pytest.approx(lowest, abs=1e-6)
        assert found.figure("highest_m", **where) == pytest.approx(highest, abs=1e-6)
    for grouping, group in (("line", "straight"), ("environment", "unknown"), ("speed", "20 to 60 km/h")):
        where = {"grouping": grouping, "group": group, "run": "all", "configuration": "p1; systems: G J"}
        assert found.figure("epochs", **where) == 200
        assert found.figure("mean_m", **where) == pytest.approx(2.0, abs=1e-6)
    # Nothing is told of different configurations together: they may be of one log.
    assert found.figures.filter(run="all", configuration="all").is_empty()
    assert found.figure("mean_m", run="day1/G") == pytest.approx(4.0, abs=1e-6)
    # Blocks of different runs are different blocks, though they have the same times.
    assert found.figure("blocks", grouping="configuration", group="p1; systems: G") == 4
    pooled = found.intervals.filter(run="all", configuration="p1; systems: G", position="constrained")
    assert pooled["intervals"].item() == 198  # nothing from one run to the next
    assert pooled["interval_max_m"].item() == pytest.approx(10.0, abs=1e-6)
    named = evaluate_runs(
        [replace(run, configuration=f"set {i // 2}") for i, run in enumerate(campaign(tmp_path / "b"))]
    )
    assert found.figure("mean_m", grouping="configuration", group="p1; systems: G") == named.figure(
        "mean_m", grouping="configuration", group="set 0"
    )
    with pytest.raises(SettingsError, match="given twice"):
        evaluate_runs(campaign(tmp_path / "c")[:1] * 2)
    with pytest.raises(LookupError, match="8 rows"):
        found.figure("mean_m", grouping="section")


@pytest.mark.slow
def test_a_hundred_thousand_epochs(tmp_path: Path):
    """As many as the source paper evaluated, 145 km at 10 Hz: every epoch counts, the limits are told."""
    time = np.arange(100_240) * 0.1
    place = 1000.0 + 900.0 * np.sin(time / 900.0)
    error = np.random.default_rng(0).normal(0.5, 2.0, len(time))
    run = write_run(tmp_path / "run", time, place + error)
    found = evaluate_run(run, reference(time, place))
    assert found.figure("errors") == 100_240
    assert found.figure("mean_m") == pytest.approx(0.5, abs=4 * 2.0 / np.sqrt(100_240))
    assert found.figure("blocks") == 168
    assert found.figure("mean_low_m") < 0.5 < found.figure("mean_high_m")
    assert found.intervals.filter(position="constrained")["interval_max_m"].item() == pytest.approx(0.1, abs=1e-3)


def test_the_command_writes_every_table(tmp_path: Path):
    runs = campaign(tmp_path / "runs")[:2]
    arguments = ["evaluate", *(str(run.run) for run in runs), "--out", str(tmp_path / "out")]
    for number, run in enumerate(runs):
        file = tmp_path / f"reference{number}.csv"
        write_reference(file, run.reference)  # type: ignore[arg-type]
        arguments += ["--reference", str(file)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "By configuration, runs combined" in result.output
    assert re.search(r"\d more tables: --verbose", result.output)
    assert "By speed" not in result.output
    assert "By speed" in CliRunner().invoke(app, [*arguments, "--verbose", "--overwrite"]).output
    written = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert {entry["input"] for entry in written["inputs"]} == {"positions", "record", "reference"}
    for entry in written["inputs"]:
        assert entry["sha256"] == hashlib.sha256(Path(entry["path"]).read_bytes()).hexdigest()
    tables = pl.read_csv(tmp_path / "out" / "tables.csv")
    assert set(written["columns"]["figures"]) - set(tables.columns) == set()
    assert len(written["figures"]) == len(tables)
    epochs = pl.read_parquet(tmp_path / "out" / "errors.parquet")
    assert set(epochs.columns) == set(written["columns"]["epochs"])
    assert len(epochs) == 200
    again = CliRunner().invoke(app, arguments)
    assert again.exit_code == 8
    assert CliRunner().invoke(app, [*arguments, "--overwrite"]).exit_code == 0


@pytest.mark.parametrize(
    ("change", "code", "told"),
    [
        (["--reference", "absent.csv"], 3, "absent.csv"),
        (
            ["--reference", "{reference}", "--reference", "{reference}"],
            4,
            "2 references for 1 runs; give one for all runs",
        ),
        (["--reference", "{reference}", "--label", "a", "--label", "b"], 4, "2 labels for 1 runs"),
        (["--reference", "{late}"], 5, "no time in common"),
        (["--reference", "{reference}", "--speed-classes", "20,x"], 4, "--speed-classes"),
        (["--reference", "{reference}", "--speed-classes", "60,20"], 4, "--speed-classes: rising numbers expected"),
        (["--reference", "{reference}", "--section-length", "0"], 4, "--section-length: Input should be greater"),
        (["--reference", "{reference}", "--sections", "absent.csv"], 3, "absent.csv"),
        (["--reference", "{reference}", "--method", "trajectory"], 3, "names no track"),
        (["--reference", "auto"], 3, "names no log of the front antenna"),
        (["--reference", "{reference}", "--out", "{reference}"], 8, "expected a folder"),
        ([], 2, "--reference"),
        (["--reference", "{reference}", "--method", "guess"], 2, "--method"),
    ],
)
def test_errors_of_the_command(tmp_path: Path, change: list[str], code: int, told: str):
    time = np.arange(5.0)
    run = write_run(tmp_path / "run", time, 10.0 * time)
    files = {"reference": tmp_path / "reference.csv", "late": tmp_path / "late.csv"}
    write_reference(files["reference"], reference(time, 10.0 * time))
    write_reference(files["late"], reference(time + 1e5, 10.0 * time))
    arguments = [part.format(**files) for part in change]
    result = CliRunner().invoke(app, ["evaluate", str(run), *arguments])
    assert result.exit_code == code, result.output
    assert told in " ".join(result.output.split())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["late.csv", "reference.csv", "run"]


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda run: (run / "run.json").unlink(), r"run\.json: there is no such file"),
        (lambda run: (run / "run.json").write_text("{"), r"run\.json: is not valid JSON"),
        (lambda run: (run / "positions.parquet").unlink(), "contains neither positions.parquet nor positions.csv"),
        (lambda run: (run / "positions.parquet").write_bytes(b"PAR1"), "cannot be read as a table"),
        (
            lambda run: (
                pl.read_parquet(run / "positions.parquet").drop("n_used").write_parquet(run / "positions.parquet")
            ),
            "has no column n_used",
        ),
        (
            lambda run: pl.concat([pl.read_parquet(run / "positions.parquet")] * 2).write_parquet(
                run / "positions.parquet"
            ),
            "two rows of one antenna at one epoch",
        ),
    ],
)
def test_a_spoilt_run_is_one_sentence(tmp_path: Path, spoil, told: str):
    time = np.arange(5.0)
    run = write_run(tmp_path / "run", time, 10.0 * time)
    spoil(run)
    with pytest.raises(InputFileError, match=told):
        evaluate_run(run, reference(time, 10.0 * time))


def test_the_reference_beside_the_log_must_be_the_only_one(tmp_path: Path):
    time = np.arange(5.0)
    run = write_run(tmp_path / "run", time, 10.0 * time)
    log = tmp_path / "logs" / "front.obs"
    log.parent.mkdir()
    log.touch()
    record = json.loads((run / "run.json").read_text())
    record["inputs"] = [{"input": "front", "path": str(log), "bytes": 0, "sha256": ""}]
    (run / "run.json").write_text(json.dumps(record))
    with pytest.raises(InputFileError, match="has no reference"):
        evaluate_run(run)
    write_reference(log.parent / "reference.csv", reference(time, 10.0 * time))
    found = evaluate_run(run)
    assert found.figure("max_m") < 1e-3
    assert any("found next to the log" in note for note in found.runs[0].notes)
    write_reference(log.parent / "truth.csv", reference(time, 10.0 * time))
    with pytest.raises(InputFileError, match=r"truth\.csv and reference\.csv"):
        evaluate_run(run)


def test_the_document_names_every_column():
    text = (ROOT / "docs" / "columns.md").read_text()
    every = (EPOCH_COLUMNS, FIGURE_COLUMNS, INTERVAL_COLUMNS, LEVEL_COLUMNS, STANFORD_COLUMNS, BEYOND_COLUMNS)
    every += (OUTAGE_COLUMNS, BRANCH_COLUMNS)
    for columns in every:
        for name, meaning in columns.items():
            assert re.search(rf"^- .*`{name}`.*: {re.escape(meaning)}$", text, re.MULTILINE)


def rows_of_document(columns: int) -> list[list[str]]:
    """Cells of the rows of docs/evaluation.md that begin with the front antenna, numbers without their units."""
    lines = (ROOT / "docs" / "evaluation.md").read_text().splitlines()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if line.startswith("| front |")]
    return [[cell.replace(",", "").removesuffix(" %") for cell in row] for row in rows if len(row) == columns]


@pytest.mark.slow
def test_the_document_shows_what_the_demonstration_gives(tmp_path: Path):
    run_files(demo_inputs(), out=tmp_path / "run")
    found = evaluate_run(tmp_path / "run")
    names = {"on the map": "constrained", "on the map ok": "constrained_ok", "conventional": "conventional"}
    figures = ("mean_m", "std_m", "p50_m", "p95_m", "max_m")
    rows = rows_of_document(8)
    assert [row[1] for row in rows] == list(names)
    for row, position in zip(rows, names.values(), strict=True):
        rate = found.figure("rate", antenna="front", position=position)
        assert float(row[2]) == pytest.approx(100 * rate, abs=0.1)  # two epochs of 2000
        expected = [found.figure(figure, antenna="front", position=position) for figure in figures]
        # what other processors and versions of numpy may move, in metres
        assert [float(cell) for cell in row[3:]] == pytest.approx(expected, abs=0.02)


@pytest.mark.requirement("C4")
@pytest.mark.slow
def test_the_document_shows_the_levels_of_the_demonstration(tmp_path: Path):
    run_files(demo_inputs(), out=tmp_path / "run")
    table = evaluate_run(tmp_path / "run").integrity["separation"].stanford.filter(grouping="all", own_limit=True)
    counts = ("epochs", "nominal", "misleading", "hazardously_misleading", "unavailable", "no_position")
    rows = rows_of_document(9)
    assert [row[1] for row in rows] == ["usable", "all"]
    for row in rows:
        (mine,) = table.filter(antenna="front", levels_of=row[1]).iter_rows(named=True)
        assert [int(cell) for cell in row[2:8]] == pytest.approx([mine[name] for name in counts], abs=3)
        assert float(row[8]) == pytest.approx(100 * mine["availability"], abs=0.15)
        assert mine["misleading"] == mine["hazardously_misleading"] == mine["unavailable_misleading"] == 0


def levelled_run(folder: Path, kind: str = "sbas") -> tuple[Path, dict[str, AntennaReference]]:
    """Eight epochs: one of each region at 12 m, two that the run does not vouch for, one without a position."""
    time, place = np.arange(8.0), 100.0 + 10.0 * np.arange(8)
    error = np.array([1.0, -4.0, 13.0, 5.0, 16.0, 9.0, -9.0, np.nan])
    columns = {
        "protection_level_m": np.array([3.0, 3.0, 12.0, 13.0, 15.0, 2.0, 4.0, np.nan]),
        "protection_fault_free_m": np.full(8, 2.0),
        "protection_one_fault_m": np.full(8, 3.5),
        "protection_status": np.array(["available"] * 5 + ["unavailable", "alarm", "unavailable"]),
        "protection_cause": np.array(["one_fault"] * 7 + ["no_position"]),
    }
    status = ["ok"] * 5 + ["ambiguous", "ok", "unobservable"]
    run = write_run(folder, time, place + error, status=status, **columns)
    record = json.loads((run / "run.json").read_text())
    record["protection"] = {"kind": kind, "alarm_limit_m": 12.0, "sigmas": "made up"}
    (run / "run.json").write_text(json.dumps(record))
    return run, reference(time, place, environment=np.array(["open"] * 4 + ["urban"] * 4))


@pytest.mark.requirement("C4")
def test_stanford_counts_by_hand(tmp_path: Path):
    run, truth = levelled_run(tmp_path / "run")
    found = evaluate_run(run, truth, options=EvaluationOptions(alarm_limits_m=(14.0,)))
    assert list(found.integrity) == ["sbas"]
    whole = found.integrity["sbas"].stanford.filter(grouping="all")
    assert whole.select("levels_of", "alarm_limit_m", "own_limit").rows() == [
        ("usable", 12.0, True),
        ("usable", 14.0, False),
        ("all", 12.0, True),
        ("all", 14.0, False),
    ]
    regions = [
        *("nominal", "misleading", "hazardously_misleading", "unavailable", "unavailable_misleading", "no_position")
    ]
    assert whole.select(regions).rows() == [
        (1, 1, 1, 3, 1, 1),  # the ambiguous one and the alarm are unavailable
        (2, 2, 0, 2, 1, 1),
        (1, 3, 1, 1, 1, 1),  # by levels alone they mislead
        (2, 4, 0, 0, 1, 1),
    ]
    assert whole["available"].to_list() == [3, 4, 5, 6]
    assert whole["availability"].to_list() == [3 / 8, 4 / 8, 5 / 8, 6 / 8]
    assert whole["beyond"].to_list() == [3, 3, 5, 5]
    urban = found.integrity["sbas"].stanford.filter(group="urban", levels_of="all", alarm_limit_m=12.0)
    assert urban.select(regions).row(0) == (0, 2, 0, 0, 1, 1)
    beyond = found.integrity["sbas"].beyond
    assert (beyond["error_m"].abs() - beyond["sbas_level_m"]).to_list() == pytest.approx([7, 5, 1, 1, 1], abs=1e-6)
    assert beyond["usable"].to_list()[:2] == [False, False]
    assert beyond["usable"].sum() == 3
    assert beyond["chainage_m"].to_list()[:2] == pytest.approx([150.0, 160.0], abs=1e-6)
    assert beyond["environment"].to_list()[:2] == ["urban", "urban"]
    assert beyond["sbas_one_fault_m"].to_list() == [3.5] * 5
    assert beyond["sbas_two_faults_m"].null_count() == 5  # the run has no such column
    assert beyond["sbas_cause"].to_list() == ["one_fault"] * 5


@pytest.mark.requirement("C4")
def test_levels_of_two_kinds_stay_apart(tmp_path: Path):
    runs = []
    for name, kind in (("a", "sbas"), ("b", "separation"), ("c", "separation")):
        run, truth = levelled_run(tmp_path / name, kind)
        runs.append(RunAndReference(run=run, reference=truth, configuration=kind))
    time, place = np.arange(8.0), 100.0 + 10.0 * np.arange(8)
    bare = write_run(tmp_path / "bare", time, place)
    runs.append(RunAndReference(run=bare, reference=reference(time, place), configuration="none"))
    found = evaluate_runs(runs)
    assert list(found.integrity) == ["sbas", "separation"]
    sbas, separation = (
        found.integrity[kind].stanford.filter(grouping="all", levels_of="all", alarm_limit_m=12.0)
        for kind in ("sbas", "separation")
    )
    assert sbas["run"].to_list() == ["a"]
    assert separation.select("run", "epochs", "misleading").rows() == [("b", 8, 3), ("c", 8, 3), ("all", 16, 6)]
    assert len(found.integrity["separation"].beyond) == 10
    levels = {"sbas_protection_level_m", "separation_protection_level_m"}
    assert levels <= set(found.epochs.columns)
    assert found.epochs.filter(run="a")["separation_protection_level_m"].null_count() == 8
    assert set(found.levels["level"]) == levels


@pytest.mark.requirement("C4")
def test_levels_go_into_files_named_by_what_they_rest_on(tmp_path: Path):
    run, truth = levelled_run(tmp_path / "run")
    write_reference(tmp_path / "truth.csv", truth)
    out = tmp_path / "out"
    arguments = ["evaluate", str(run), "--reference", str(tmp_path / "truth.csv"), "--out", str(out)]
    result = CliRunner().invoke(app, [*arguments, "--alarm-limit", "5", "--alarm-limit", "30"])
    assert result.exit_code == 0, result.output
    assert "Errors above the level (single epochs, sbas): 5, of which 3 at a usable level" in result.output
    assert re.search(r"one_fault +unavailable +ambiguous +no +150 +\+9\.00 +2\.00", result.output)
    counts = pl.read_csv(out / "stanford_sbas.csv").filter(grouping="all")
    assert counts["alarm_limit_m"].to_list() == [5.0, 12.0, 30.0] * 2
    beyond = pl.read_csv(out / "beyond_sbas.csv")
    assert len(beyond) == 5
    assert beyond.columns == [name.replace("KIND", "sbas") for name in BEYOND_COLUMNS]
    record = json.loads((out / "evaluation.json").read_text())
    assert record["beyond_counts"] == {"sbas": 5}
    assert len(record["beyond_sbas"]) == 5
    assert len(record["stanford_sbas"]) == 18  # two choices of levels, three limits, the whole and two environments
    assert record["options"]["alarm_limits_m"] == [5.0, 30.0]
    assert record["runs"][0]["protection"]["kind"] == "sbas"


@pytest.mark.requirement("C4")
def test_levels_whose_kind_is_not_told(tmp_path: Path):
    run, truth = levelled_run(tmp_path / "run")
    record = json.loads((run / "run.json").read_text())
    for told in ({}, {"kind": "../../x", "alarm_limit_m": 20.0}):
        (run / "run.json").write_text(json.dumps(record | {"protection": told}))
        found = evaluate_run(run, truth)
        assert list(found.integrity) == ["unknown"]
        assert any("does not state the basis of the protection levels" in note for note in found.runs[0].notes)
    positions = pl.read_parquet(run / "positions.parquet").with_columns(protection_kind=pl.lit("separation"))
    positions.write_parquet(run / "positions.parquet")
    (run / "run.json").write_text(json.dumps(record | {"protection": {}}))
    assert list(evaluate_run(run, truth).integrity) == ["separation"]
    (run / "run.json").write_text(json.dumps(record))
    with pytest.raises(InputFileError, match="sbas and separation"):
        evaluate_run(run, truth)
    positions.drop("protection_kind").write_parquet(run / "positions.parquet")
    for wrong in (0.0, -1.0, "20", True):
        (run / "run.json").write_text(json.dumps(record | {"protection": {"kind": "sbas", "alarm_limit_m": wrong}}))
        with pytest.raises(InputFileError, match="alarm_limit_m"):
            evaluate_run(run, truth)
    with pytest.raises(SettingsError, match="alarm_limits_m"):
        validate(EvaluationOptions, {"alarm_limits_m": (10.0, float("inf"))}, source="test")
