"""The batch on the shipped run: files, rows, counts, provenance; the same whatever the chunks."""

from __future__ import annotations

import hashlib
import json
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from polars.testing import assert_frame_equal

from broken_bench import EPOCHS, Bench, bench_in
from railfix.core.errors import MismatchError, NoPositionError
from railfix.core.files import source_commit
from railfix.core.reason_names import reason_text
from railfix.core.reasons import CHECK_FAILED, POSITIONED, Reason, Status
from railfix.evaluate import evaluate_run
from railfix.io import read_navigation, read_observations, scan_observations
from railfix.pipeline.config import Config
from railfix.pipeline.result_columns import OBSERVATION_COLUMNS, POSITION_COLUMNS
from railfix.pipeline.result_tables import TRAIN_COLUMNS, observations_table, positions_table, to_xarray, train_table
from railfix.pipeline.results import Result
from railfix.run import RunInputs, RunOptions, RunSummary, run_files
from railfix.run.processor_setup import make_processor
from railfix.simulate.demonstration import demo_inputs, demo_truth
from railfix.track import read_track
from railfix.track.vehicle import antenna_trajectory, read_vehicle


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return bench_in(tmp_path_factory.mktemp("bench"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> RunSummary:
    out = tmp_path_factory.mktemp("whole") / "results"
    return run_files(demo_inputs(), out=out, options=RunOptions(observations="write"))


@pytest.fixture(scope="module")
def record(whole: RunSummary) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads(whole.files["run.json"].read_text())
    return loaded


@pytest.fixture(scope="module")
def result() -> Result:
    inputs = demo_inputs()
    assert inputs.vehicle is not None
    observations = {"front": read_observations(inputs.front)[:50], "rear": read_observations(inputs.rear)[:50]}
    track, vehicle = read_track(inputs.track), read_vehicle(inputs.vehicle)
    trajectories = {
        "front": antenna_trajectory(track, vehicle, "front"),
        "rear": antenna_trajectory(track, vehicle, "rear"),
    }
    return make_processor(Config(), read_navigation(inputs.nav), trajectories).process(observations)[0]


def inputs_of(bench: Bench) -> RunInputs:
    return RunInputs(
        front=(bench.front,), rear=(bench.rear,), nav=(bench.nav,), track=(bench.track,), vehicle=bench.vehicle
    )


def test_one_row_an_epoch_and_antenna_in_order(whole: RunSummary) -> None:
    rows = pl.read_parquet(whole.files["positions.parquet"])
    assert rows.columns == list(POSITION_COLUMNS)
    assert rows.height == 4000
    assert rows["time_gpst"].dtype == pl.Datetime("ns")
    assert rows["time_gpst"].is_sorted()
    assert rows["antenna"].to_list() == ["front", "rear"] * 2000


def test_the_csv_file_holds_the_same_rows(whole: RunSummary) -> None:
    exact = pl.read_parquet(whole.files["positions.parquet"])
    text = whole.files["positions.csv"].read_text().splitlines()
    assert text[1].startswith("2024-03-05T03:10:00.000000000,front,ok,")
    rows = pl.read_csv(whole.files["positions.csv"], schema_overrides={"time_gpst": pl.Datetime("ns")})
    assert rows.columns == exact.columns
    for name in ("time_gpst", "antenna", "n_used", "n_rejected"):
        assert rows[name].to_list() == exact[name].to_list()
    for name, kind in exact.schema.items():
        if kind == pl.Float64:
            limit = 0.51e-9 if name.endswith("_deg") else 0.51e-4
            assert ((rows[name].cast(pl.Float64) - exact[name]).abs().max() or 0.0) <= limit


def test_pandas_reads_the_csv_file_without_help(whole: RunSummary) -> None:
    pandas = pytest.importorskip("pandas")
    frame = pandas.read_csv(whole.files["positions.csv"], parse_dates=["time_gpst"])
    assert frame.shape == (4000, len(POSITION_COLUMNS))
    assert str(frame.time_gpst.dtype).startswith("datetime64")


@pytest.mark.requirement("B7")
def test_every_observation_has_a_row_and_the_reasons_add_up(whole: RunSummary, record: dict[str, Any]) -> None:
    rows = pl.read_parquet(whole.files["observations.parquet"])
    assert rows.columns == list(OBSERVATION_COLUMNS)
    inputs = demo_inputs()
    for name, paths in inputs.logs.items():
        codes = int(np.isfinite(read_observations(paths).code_m).sum())
        mine = rows.filter(pl.col("antenna") == name)
        told = record["antennas"][name]
        assert mine.height == codes == told["observations"]
        assert told["observations_used"] + sum(told["observations_rejected_by_first_reason"].values()) == codes
        alone = told["observations_rejected_by_one_reason_alone"]
        for reason, count in alone.items():
            assert mine.filter(pl.col("reason_text") == reason).height == count
        assert sum(told["status"].values()) == told["epochs"] == 2000
    texts = rows.select("reason", "reason_text").unique().rows()
    assert all(reason_text(reason) == text for reason, text in texts)


@pytest.mark.requirement("B7")
def test_used_satellites_agree_between_the_two_tables(whole: RunSummary) -> None:
    positions = pl.read_parquet(whole.files["positions.parquet"])
    observations = pl.read_parquet(whole.files["observations.parquet"])
    used = observations.filter(pl.col("reason") == 0).group_by("time_gpst", "antenna").len("used")
    joined = positions.join(used, on=["time_gpst", "antenna"], how="left")
    assert joined.filter(pl.col("n_used") != pl.col("used").fill_null(0)).height == 0


def test_the_record_names_what_was_read(record: dict[str, Any]) -> None:
    inputs = demo_inputs()
    named = {(item["input"], item["path"]): item for item in record["inputs"]}
    assert set(named) == {(name, str(path)) for name, path in inputs.files_by_name()}
    for (_, path), item in named.items():
        content = Path(path).read_bytes()
        assert item["bytes"] == len(content)
        assert item["sha256"] == hashlib.sha256(content).hexdigest()
    assert record["versions"]["railfix"]
    assert record["versions"]["commit"] == source_commit()
    assert record["versions"]["numpy"] == np.__version__
    assert record["settings_used"] == Config().as_dict()
    positioned = sum(antenna["epochs_with_position"] for antenna in record["antennas"].values())
    observed = sum(antenna["epochs_with_observations"] for antenna in record["antennas"].values())
    assert record["positioning_rate"] == positioned / observed
    assert 0.98 < record["positioning_rate"] <= 1.0
    assert record["line"]["vehicle"]["bogie_distance_m"] == 13.8
    assert record["line"]["track"]["points"] == 189


def test_the_parquet_files_carry_their_provenance(whole: RunSummary, record: dict[str, Any]) -> None:
    footer = pl.read_parquet_metadata(whole.files["positions.parquet"])
    assert footer["railfix"] == record["versions"]["railfix"]
    assert all(item["sha256"] in footer["inputs"] for item in record["inputs"])


def test_settings_asked_for_stand_beside_those_used(bench: Bench, tmp_path: Path) -> None:
    config = Config.model_validate({"elevation": {"mask_deg": 15.0}})
    summary = run_files(inputs_of(bench), config, out=tmp_path / "out", asked={"elevation": {"mask_deg": 15.0}})
    record = json.loads(summary.files["run.json"].read_text())
    assert record["settings_asked"] == {"elevation": {"mask_deg": 15.0}}
    assert record["settings_used"]["elevation"]["mask_deg"] == 15.0
    assert record["settings_used"]["min_satellites"] == 3


def test_without_a_vehicle_the_output_says_so(bench: Bench, tmp_path: Path) -> None:
    inputs = RunInputs(front=(bench.front,), nav=(bench.nav,), track=(bench.track,))
    summary = run_files(inputs, out=tmp_path / "out")
    record = json.loads(summary.files["run.json"].read_text())
    assert any("no vehicle file: the track is assumed to be the antenna's own path" in note for note in record["notes"])
    assert record["line"]["vehicle"] is None


@pytest.mark.parametrize("epochs", [7, 1, 1000])
@pytest.mark.every(3)
def test_the_results_do_not_depend_on_the_chunks(
    bench: Bench, tmp_path: Path, epochs: int, request: pytest.FixtureRequest
) -> None:
    inputs = demo_inputs() if epochs == 1000 else inputs_of(bench)
    end = datetime(2024, 3, 5, 3, 10, 4) if epochs == 1 else None
    options = RunOptions(chunk_epochs=epochs, observations="write", end=end)
    cut = run_files(inputs, out=tmp_path / "cut", options=options)
    if epochs == 1000:
        reference: RunSummary = request.getfixturevalue("whole")
    else:
        reference = run_files(inputs, out=tmp_path / "one", options=RunOptions(observations="write", end=end))
    for name, keys in (("positions.parquet", []), ("observations.parquet", ["time_gpst", "antenna", "satellite"])):
        left, right = (pl.read_parquet(s.files[name]) for s in (cut, reference))
        left, right = (t.sort(keys, maintain_order=True) if keys else t for t in (left, right))
        assert_frame_equal(left, right, rel_tol=0, abs_tol=1e-6)


def test_several_files_of_one_log_are_joined(bench: Bench, tmp_path: Path) -> None:
    lines = bench.front.read_text().splitlines(keepends=True)
    starts = [i for i, line in enumerate(lines) if line.startswith(">")]
    head, middle = "".join(lines[: starts[0]]), starts[EPOCHS // 2]
    one, two = tmp_path / "one.obs", tmp_path / "two.obs"
    one.write_text(head + "".join(lines[starts[0] : middle]))
    two.write_text(head + "".join(lines[middle:]))
    common = {"nav": (bench.nav,), "track": (bench.track,)}
    joined = run_files(RunInputs(front=(one, two), **common), out=tmp_path / "joined")
    single = run_files(RunInputs(front=(bench.front,), **common), out=tmp_path / "single")
    assert_frame_equal(*(pl.read_parquet(s.files["positions.parquet"]) for s in (joined, single)))


def test_a_part_of_the_log(bench: Bench, tmp_path: Path) -> None:
    options = RunOptions(start=datetime(2024, 3, 5, 3, 10, 1), end=datetime(2024, 3, 5, 3, 10, 2))
    summary = run_files(inputs_of(bench), out=tmp_path / "out", options=options)
    rows = pl.read_parquet(summary.files["positions.parquet"])
    assert rows["time_gpst"].unique().len() == 10
    assert str(rows["time_gpst"].min()) == "2024-03-05 03:10:01"


def test_antennas_that_overlap_in_part_are_both_kept(bench: Bench, tmp_path: Path) -> None:
    lines = bench.rear.read_text().splitlines(keepends=True)
    starts = [i for i, line in enumerate(lines) if line.startswith(">")]
    rear = tmp_path / "rear.obs"
    rear.write_text("".join(lines[: starts[0]] + lines[starts[EPOCHS - 5] :]))
    inputs = RunInputs(
        front=(bench.front,), rear=(rear,), nav=(bench.nav,), track=(bench.track,), vehicle=bench.vehicle
    )
    summary = run_files(inputs, out=tmp_path / "out", options=RunOptions(chunk_epochs=4))
    rows = pl.read_parquet(summary.files["positions.parquet"])
    assert dict(rows["antenna"].value_counts().rows()) == {"front": EPOCHS, "rear": 5}
    assert rows["time_gpst"].is_sorted()


def test_epochs_without_a_position_keep_their_row(bench: Bench, tmp_path: Path) -> None:
    lines = bench.front.read_text().splitlines(keepends=True)
    starts = [i for i, line in enumerate(lines) if line.startswith(">")]
    at = starts[10]
    kept = [f"{lines[at][:32]}  2{lines[at][35:]}", *lines[at + 1 : at + 3]]
    front = tmp_path / "front.obs"
    front.write_text("".join(lines[:at] + kept + lines[starts[11] :]))
    inputs = RunInputs(front=(front,), nav=(bench.nav,), track=(bench.track,))
    summary = run_files(inputs, out=tmp_path / "out")
    rows = pl.read_parquet(summary.files["positions.parquet"])
    assert rows.height == EPOCHS
    row = rows.row(10, named=True)
    assert row["status"] == Status.TOO_FEW_SATELLITES.text
    assert all(row[name] is None for name in ("chainage_m", "along_sigma_m", "latitude_deg", "x_m"))
    assert summary.tally.antennas["front"].positioned == EPOCHS - 1
    assert ",too_few_satellites,,,," in summary.files["positions.csv"].read_text()


def test_errors_of_the_inputs_have_their_classes(bench: Bench, tmp_path: Path) -> None:
    with pytest.raises(NoPositionError, match="too_few_satellites"):
        run_files(inputs_of(bench), Config(filter="off", min_satellites=40), out=tmp_path / "out")
    late = RunOptions(start=datetime(2031, 1, 1))
    with pytest.raises(MismatchError, match="time span"):
        run_files(inputs_of(bench), out=tmp_path / "out", options=late)
    assert not (tmp_path / "out").exists()


def test_progress_is_told(bench: Bench, tmp_path: Path) -> None:
    told: list[tuple[int, float]] = []
    run_files(
        inputs_of(bench),
        out=tmp_path / "out",
        options=RunOptions(chunk_epochs=10),
        progress=lambda *, epochs, fraction: told.append((epochs, fraction)),
    )
    assert [epochs for epochs, _ in told] == [4, 24, 44, 60]  # the first chunk is short
    assert all(0.0 < fraction <= 1.0 for _, fraction in told)
    assert told[-1][1] == 1.0


@pytest.mark.parametrize("kind", ["plain", "gz", "crx", "crx.gz"])
def test_the_share_of_a_packed_log_grows(whole: RunSummary, tmp_path: Path, kind: str) -> None:
    """Progress needs to know how far the reading is, whatever the packing."""
    import gzip

    import hatanaka

    assert whole
    packed = gzip.decompress(demo_inputs().front[0].read_bytes())
    content = {"plain": hatanaka.decompress, "gz": lambda c: gzip.compress(hatanaka.decompress(c))}.get(kind, bytes)(
        packed
    )
    path = tmp_path / f"front.{kind}"
    path.write_bytes(gzip.compress(content) if kind == "crx.gz" else content)
    shares: list[float] = []
    for _ in scan_observations(path, epochs=100, progress=shares.append):
        pass
    assert shares == sorted(shares)
    assert 0.0 < shares[0] <= shares[-1] == 1.0


def test_tables_hold_the_arrays(result: Result) -> None:
    positions = positions_table(result)
    for name, antenna in result.antennas.items():
        mine = positions.filter(pl.col("antenna") == name)
        np.testing.assert_array_equal(mine["chainage_m"].to_numpy(), antenna.chainage_m)
        np.testing.assert_array_equal(mine["y_m"].to_numpy(), antenna.ecef_m[:, 1])
        np.testing.assert_array_equal(mine["conventional_z_m"].to_numpy(), antenna.point.ecef_m[:, 2])
        np.testing.assert_array_equal(mine["time_gpst"].to_numpy(), antenna.time)
    rows = observations_table(result).filter(antenna="rear", satellite="G01")
    rear = result.antennas["rear"]
    (channel,) = np.flatnonzero(rear.satellite == "G01")
    np.testing.assert_array_equal(rows["residual_m"].to_numpy(), rear.residual_m[:, channel])


def test_xarray_has_named_axes(result: Result) -> None:
    pytest.importorskip("xarray")
    front = result.antennas["front"]
    data = to_xarray(front, attributes={"antenna": "front"})
    assert dict(data.sizes) == {"time": 50, "channel": len(front.satellite), "xyz": 3}
    np.testing.assert_array_equal(data.residual_m.values, front.residual_m)
    assert data.attrs == {"antenna": "front"}
    used = data.reason.where(data.satellite == "G02", drop=True)
    assert (used.values == float(Reason.UNHEALTHY)).all()


def test_xarray_has_every_column_with_unit_and_meaning(result: Result) -> None:
    pytest.importorskip("xarray")
    front = result.antennas["front"]
    data = to_xarray(front, result.fusion["front"])
    tables = {"": (POSITION_COLUMNS, positions_table(result)), "filter_": (TRAIN_COLUMNS, train_table(result))}
    for prefix, (columns, table) in tables.items():
        for name, column in columns.items():
            if name in ("time_gpst", "antenna"):
                continue
            assert data[prefix + name].attrs == {"units": column.unit, "long_name": column.meaning}
            expected = table.filter(antenna="front")[name]
            if expected.dtype == pl.Float64:
                expected = expected.fill_null(np.nan)
            elif not expected.dtype.is_integer() and expected.dtype != pl.Boolean:
                expected = expected.fill_null("")
            np.testing.assert_array_equal(data[prefix + name].values, expected.to_numpy(), err_msg=prefix + name)
    assert "filter_status" not in to_xarray(front)
    rows = observations_table(result).filter(pl.col("antenna") == "front", pl.col("satellite") == "G01")
    (channel,) = np.flatnonzero(front.satellite == "G01")
    for name in ("reason", "metric_doppler_m", "raim_own_error_m", "sigma_m", "weight_code"):
        values = rows[name].cast(pl.Float64).fill_null(np.nan).to_numpy()
        np.testing.assert_array_equal(data[name].values[:, channel], values, err_msg=name)
    assert data.protection_level_m.attrs["units"] == "m"
    assert data.elevation_deg.attrs["units"] == "deg"


def test_the_demo_is_as_good_as_its_errors_allow(whole: RunSummary) -> None:
    """Satellites and air are metres off in the made town, so the mean is; what a tunnel takes is no position."""
    evaluation = evaluate_run(whole.files["run.json"].parent, demo_truth())
    for antenna in ("front", "rear"):
        assert evaluation.figure("rate", antenna=antenna) > 0.98
        assert 0.90 < evaluation.figure("rate_of_run", antenna=antenna) < 0.95
        assert abs(evaluation.figure("mean_m", antenna=antenna)) < 1.0
        assert evaluation.figure("p95_m", antenna=antenna) < 2.2
        ok = evaluation.figure("max_m", antenna=antenna, position="constrained_ok")
        assert ok < 5.0
        assert ok <= evaluation.figure("max_m", antenna=antenna)


def test_positions_are_those_of_the_statuses(whole: RunSummary) -> None:
    rows = pl.read_parquet(whole.files["positions.parquet"])
    words = [status.text for status in POSITIONED]
    has = rows["status"].cast(pl.String).is_in(words)
    assert (rows["chainage_m"].is_not_null() == has).all()


def test_positions_that_failed_a_check_do_not_count_when_they_are_dropped(tmp_path: Path) -> None:
    strict = Config.model_validate({"failed_checks": "drop", "raim": {"false_alarm": 0.2, "max_excluded": 0}})
    summary = run_files(demo_inputs(), strict, out=tmp_path / "out")
    rows = pl.read_parquet(summary.files["positions.parquet"]).filter(antenna="front")
    front = summary.tally.antennas["front"]
    assert front.status["inconsistent"] > 10
    dropped = [rows.filter(pl.col("status").cast(pl.String) == s.text).height for s in CHECK_FAILED]
    without = sum(dropped) + sum(front.status[s] for s in ("no_observation", "too_few_satellites", "unobservable"))
    assert front.positioned == rows["chainage_m"].count() == 2000 - without


@pytest.mark.requirement("C2")
@pytest.mark.slow
def test_a_run_says_what_speaks_against_its_levels(whole: RunSummary, tmp_path: Path) -> None:
    """Faults that RAIM excludes are likelier than the level takes them to be; and a budget too small gives none."""
    assert any("RAIM has excluded" in note and "see risk.local_prior" in note for note in whole.notes)
    small = Config.model_validate({"risk": {"local_prior": 0.02}, "protection": "on"})
    summary = run_files(demo_inputs(), small, out=tmp_path / "out")
    assert summary.record["antennas"]["front"]["protection_level"]["without_budget"] > 1000
    assert any("epochs have no protection level" in note for note in summary.notes)
    assert not any("RAIM has excluded" in note for note in summary.notes)
