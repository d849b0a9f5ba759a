"""Every column and figure comes from the quantity that it names: results with a number of its own in every place."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import polars as pl
import pytest

from railfix.core.arrays import copy_with
from railfix.core.reasons import Reason, Status
from railfix.core.tables import Table, listing
from railfix.evaluate.tables import _ERRORS
from railfix.io import read_observations, write_observations
from railfix.pipeline.config import Config
from railfix.pipeline.result_tables import observations_table, positions_table, train_table
from railfix.pipeline.results import Result
from railfix.report.figures import _assumptions
from railfix.report.page import budget, summary
from railfix.report.runs import ReportedRun
from railfix.run import RunOptions, RunSummary, run_files
from railfix.run.processor_setup import make_processor
from railfix.run.tally import AntennaTally
from railfix.simulate.demonstration import demo_inputs
from railfix.tracking import Kind
from test_budget import result_of
from test_carrier_stage import demo

#: Columns by the place of their values in `AntennaResult`: an attribute path, a column of an array after a colon.
POSITION_PATHS = {
    **{name: name for name in ("chainage_m", "kilometrage_m", "along_sigma_m", "latitude_deg")},
    "own_sigma_m": "epoch_sigma_m",
    **{name: name for name in ("longitude_deg", "height_m", "n_used", "n_rejected", "noise_scale")},
    **{f"{axis}_m": f"ecef_m:{i}" for i, axis in enumerate("xyz")},
    **{f"conventional_{axis}_m": f"point.ecef_m:{i}" for i, axis in enumerate("xyz")},
    "conventional_chainage_m": "conventional_chainage_m", "conventional_offset_m": "conventional_offset_m",
    "raim_statistic": "raim.statistic", "raim_threshold": "raim.threshold", "raim_level_m": "raim.protection_level_m",
    "protection_level_m": "protection.level.level_m", "protection_fault_free_m": "protection.level.fault_free_m",
    "protection_one_fault_m": "protection.level.one_fault_m",
    "protection_two_faults_m": "protection.level.two_fault_m",
    "protection_k_fault_free": "protection.level.k_fault_free",
    "protection_k_one_fault": "protection.level.k_one_fault",
    "protection_k_two_faults": "protection.level.k_two_faults",
    "protection_separation": "protection.level.separation", "map_offset_across_m": "map_offset.across_m",
    "map_offset_up_m": "map_offset.up_m", "map_detectable_across_m": "map_offset.detectable_m:0",
    "map_detectable_up_m": "map_offset.detectable_m:1", "map_offset_statistic": "map_offset.statistic",
}  # fmt: skip
#: The same of `AlongTrack`; a factor after an asterisk.
TRAIN_PATHS = {
    **{name: name for name in ("chainage_m", "kilometrage_m", "latitude_deg", "longitude_deg", "height_m")},
    **{f"{axis}_m": f"ecef_m:{i}" for i, axis in enumerate("xyz")}, "along_sigma_m": "tracked.sigma_m",
    "branch_probability": "tracked.probability", "protection_level_m": "tracked.level_m",
    "protection_noise_m": "tracked.level_noise_m", "protection_separation_m": "tracked.separation_m",
    "over_reading_m": "tracked.amount_m", "under_reading_m": "tracked.amount_m",
    "measured_chainage_m": "sensed.under_m", "measured_gradient_permille": "sensed.gradient*1000",
    "measured_curvature_1pm": "sensed.curvature_1pm", "measured_cant_mm": "sensed.cant_m*1000",
    "metric_antenna_spacing_m": "spacing_error_m", "innovation_wheel_m": f"tracked.sensed:{Kind.WHEEL - 3}",
    "innovation_radar_m": f"tracked.sensed:{Kind.RADAR - 3}",
    "innovation_force_mps2": f"tracked.sensed:{Kind.FORCE - 3}",
    "innovation_place_m": f"tracked.sensed:{Kind.PLACE - 3}",
    "innovation_range_m": f"tracked.sensed:{Kind.RANGE - 3}",
    **{
        name: f"tracked.{name}"
        for name in ("speed_mps", "speed_sigma_mps", "acceleration_mps2", "hypotheses", "code_weight", "motion_weight")
    }, **{name: f"tracked.{name}" for name in ("wheel_scale", "radar_scale", "force_offset_mps2", "map_scale")},
}  # fmt: skip


def marked(value: Any, random: np.random.Generator) -> Any:
    """A result with another number in every place of its arrays of numbers."""
    if isinstance(value, np.ndarray) and value.dtype == np.float64:
        return random.uniform(1.0, 2.0, value.shape)
    if isinstance(value, np.ndarray) and value.dtype.kind == "i" and value.dtype.itemsize > 1:
        return random.integers(1, 1000, value.shape).astype(value.dtype)
    if is_dataclass(value) and not isinstance(value, type):
        keep = {"columns", "reason", "satellites", "time", "used", "replay", "trajectory", "channels"}
        new = {f.name: marked(getattr(value, f.name), random) for f in fields(value) if f.name not in keep}
        return replace(value, **{name: item for name, item in new.items() if item is not getattr(value, name)})
    return value


def at_path(result: Any, path: str) -> np.ndarray:
    path, _, factor = path.partition("*")
    path, _, column = path.partition(":")
    for name in path.split("."):
        result = getattr(result, name)
    values = result[:, int(column)] if column else result
    return np.asarray(values * float(factor or 1.0))


@pytest.fixture(scope="module")
def result() -> Result:
    """Thirty epochs of the demonstration, a number of its own in every place of the result."""
    observations, navigation, trajectory, _ = demo()
    processor = make_processor(Config(filter="track"), navigation, {"front": trajectory})
    whole, _ = processor.process({"front": observations[:30]})
    random = np.random.default_rng(11)
    return replace(
        whole,
        antennas={name: marked(each, random) for name, each in whole.antennas.items()},
        fusion={name: marked(each, random) for name, each in whole.fusion.items()},
    )


@pytest.mark.requirement("B6")
@pytest.mark.parametrize("column", POSITION_PATHS)
def test_a_column_of_positions_is_the_quantity_that_it_names(result: Result, column: str) -> None:
    expected = at_path(result.antennas["front"], POSITION_PATHS[column])
    np.testing.assert_array_equal(positions_table(result)[column].to_numpy(), expected)


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("column", TRAIN_PATHS)
def test_a_column_of_the_filter_is_the_quantity_that_it_names(result: Result, column: str) -> None:
    expected = at_path(result.fusion["front"], TRAIN_PATHS[column])
    np.testing.assert_array_equal(train_table(result)[column].to_numpy(), expected)


@pytest.mark.requirement("E7")
def test_the_innovation_of_a_balise_is_that_of_either_turn(result: Result) -> None:
    sensed = result.fusion["front"].tracked.sensed
    expected = np.fmax(sensed[:, Kind.BALISE - 3], sensed[:, Kind.NEXT_BALISE - 3])
    np.testing.assert_array_equal(train_table(result)["innovation_balise_m"].to_numpy(), expected)


@pytest.mark.requirement("B7")
def test_a_column_of_observations_is_the_quantity_that_it_names(result: Result) -> None:
    front, tracked = result.antennas["front"], result.fusion["front"].tracked
    table = observations_table(result)
    epoch, channel = np.nonzero((front.reason & Reason.NOT_OBSERVED) == 0)
    for name in ("residual_m", "elevation_deg", "azimuth_deg", "cn0_dbhz", "sigma_m", "corrected_code_m"):
        np.testing.assert_array_equal(table[name].to_numpy(), getattr(front, name)[epoch, channel])
    inner = np.searchsorted(front.columns, channel)
    judged = np.isin(channel, front.columns)
    columns = {
        "innovation_code_m": tracked.innovation[:, Kind.CODE],
        "innovation_phase_m": tracked.innovation[:, Kind.PHASE],
        "innovation_doppler_mps": tracked.innovation[:, Kind.DOPPLER],
        "weight_code": tracked.weight[:, Kind.CODE],
        "raim_own_error_m": front.raim.own_error_m,
    }
    order = np.argsort(front.columns)
    for name, values in columns.items():
        found = table[name].fill_null(np.nan).to_numpy()
        np.testing.assert_array_equal(found[judged], values[epoch, order[np.minimum(inner, len(order) - 1)]][judged])


@pytest.mark.requirement("A5", "B8", "C6")
def test_columns_of_what_few_runs_have_are_the_quantities_that_they_name(result: Result) -> None:
    """ARAIM, integers, interference, two frequencies, the wheel against the satellites."""
    front, track, random = result.antennas["front"], result.fusion["front"], np.random.default_rng(5)
    size = len(front.time)

    def numbers(*shape: int) -> np.ndarray:
        return random.uniform(1.0, 2.0, (size, *shape))

    araim = SimpleNamespace(
        along=SimpleNamespace(level_m=numbers(1)), space=SimpleNamespace(level_m=numbers(3)), horizontal_m=numbers()
    )
    phase = SimpleNamespace(n_fixed=np.arange(size), integer_risk=numbers())
    signs = SimpleNamespace(
        power=SimpleNamespace(fall_db=numbers()), suspicion=np.arange(size) % 3, causes=np.zeros(size, dtype=np.int64)
    )
    names = ("share", "ionosphere_m", "difference_m")
    combined = SimpleNamespace(**{name: numbers(len(front.columns)) for name in names})
    second = SimpleNamespace(cn0_dbhz=numbers(len(front.columns)))
    rare: Any = {"araim": araim, "phase": phase, "interference": signs, "combined": combined}
    rare["corrected"] = copy_with(front.corrected, second=second)
    rare_track: Any = {"wheel": SimpleNamespace(difference_m=numbers())}
    made = replace(
        result, antennas={"front": copy_with(front, **rare)}, fusion={"front": copy_with(track, **rare_track)}
    )
    expected = {
        "araim_level_m": araim.along.level_m[:, 0], "araim_horizontal_m": araim.horizontal_m,
        "araim_vertical_m": araim.space.level_m[:, 2], "integers_fixed": phase.n_fixed,
        "integer_risk_ppm": 1e6 * phase.integer_risk, "cn0_fall_db": signs.power.fall_db,
    }  # fmt: skip
    positions, rows, train = positions_table(made), observations_table(made), train_table(made)
    for name, values in expected.items():
        np.testing.assert_array_equal(positions[name].to_numpy(), values, err_msg=name)
    words = ("none", "jamming_suspected", "spoofing_suspected")
    assert positions["interference"].to_list() == [words[k % 3] for k in range(size)]
    np.testing.assert_array_equal(train["wheel_difference_m"].to_numpy(), rare_track["wheel"].difference_m)
    columns = {
        "second_share": combined.share, "ionosphere_measured_m": combined.ionosphere_m,
        "metric_two_frequencies_m": combined.difference_m, "second_cn0_dbhz": second.cn0_dbhz,
    }  # fmt: skip
    observed = (front.reason & Reason.NOT_OBSERVED) == 0
    for name, values in columns.items():
        full = np.full(front.reason.shape, np.nan)
        full[:, front.columns] = values
        np.testing.assert_array_equal(rows[name].fill_null(np.nan).to_numpy(), full[observed], err_msg=name)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunSummary:
    options = RunOptions(start=datetime(2024, 3, 5, 3, 10, 5), end=datetime(2024, 3, 5, 3, 10, 25))
    return run_files(demo_inputs(), Config(filter="track"), out=tmp_path_factory.mktemp("run") / "run", options=options)


@pytest.mark.requirement("B6")
def test_percentiles_of_the_record_are_those_of_the_rows(run: RunSummary) -> None:
    record = json.loads(run.files["run.json"].read_text())["antennas"]
    for table, facts in (("positions", lambda a: a), ("train", lambda a: a["filter"])):
        rows = pl.read_parquet(run.files[f"{table}.parquet"])
        for antenna in ("front", "rear"):
            mine = rows.filter(antenna=antenna)
            told = facts(record[antenna])
            level = told["protection_level" if table == "positions" else "level"]
            sigma = mine["along_sigma_m"].drop_nulls().to_numpy()
            levels = mine["protection_level_m"].drop_nulls().to_numpy()
            levels = levels[np.isfinite(levels)]
            assert np.percentile(levels, 94.0) > np.percentile(levels, 52.0)
            for told_of, values in ((told["along_sigma_m"], sigma), (level, levels)):
                for percent in (50.0, 95.0):
                    low, high = (np.percentile(values, percent, method=m) for m in ("lower", "higher"))
                    assert low <= told_of[f"p{percent:.0f}_m"] <= high
            assert told["along_sigma_m"]["max_m"] == sigma.max()


@pytest.mark.requirement("B7")
def test_a_reason_alone_is_counted_apart_from_one_among_others() -> None:
    low, weak = int(Reason.ELEVATION_MASK), int(Reason.CN0_FLOOR)
    tally = AntennaTally()
    reasons = [[low, low | weak, weak, 0], [low | weak, weak, 0, 0]]
    tally.add(result_of(reasons, ["G01", "G02", "G03", "G04"], [Status.OK] * 2))
    assert dict(tally.first_reason) == {"elevation_mask": 3, "cn0_floor": 2}
    assert dict(tally.only_reason) == {"elevation_mask": 1, "cn0_floor": 2}
    told = tally.as_dict()
    assert told["observations_rejected_by_first_reason"] == {"elevation_mask": 3, "cn0_floor": 2}
    assert told["observations_rejected_by_one_reason_alone"] == {"elevation_mask": 1, "cn0_floor": 2}


@pytest.mark.requirement("B7")
def test_a_rate_is_of_the_epochs_with_observations_and_ok_of_that_status_alone() -> None:
    tally = AntennaTally()
    statuses = [Status.OK, Status.MAP_OFFSET, Status.MAP_OFFSET, Status.TOO_FEW_SATELLITES, Status.NO_OBSERVATION]
    tally.add(result_of([[0]] * 5, ["G01"], statuses))
    told = tally.as_dict()
    assert (told["epochs"], told["epochs_with_observations"]) == (5, 4)
    assert told["ok_rate"] == 0.25


@pytest.mark.requirement("B6")
def test_span_and_offset_of_the_map_are_of_all_chunks() -> None:
    """Of the map the window that contradicts it most, and the least and the largest that any finds."""
    tally = AntennaTally()
    for k, (statistic, detectable) in enumerate((([1.0, 9.0], [3.0, 5.0]), ([4.0, np.nan], [2.0, np.nan]))):
        chunk: Any = result_of([[0], [0]], ["G01"], [Status.OK] * 2)
        chunk.time += k * np.timedelta64(10, "s")
        ones = {name: np.full(2, 1.0 + k) for name in ("across_m", "up_m", "across_sigma_m", "up_sigma_m")}
        found = np.column_stack([detectable, 2.0 * np.array(detectable)])
        chunk.map_offset = SimpleNamespace(statistic=np.array(statistic), detectable_m=found, **ones)
        tally.add(chunk)
    begin = np.datetime64("2024-01-01", "ns")
    assert (tally.first, tally.last) == (begin, begin + np.timedelta64(11, "s"))
    np.testing.assert_array_equal(tally.map_detectable_m, [[2.0, 4.0], [5.0, 10.0]])
    assert (tally.map_offset.time, tally.map_offset.statistic) == (begin + np.timedelta64(1, "s"), 9.0)
    assert tally.map_offset.across_m == 1.0


@pytest.mark.requirement("D2")
def test_the_report_states_both_rates() -> None:
    facts: Mapping[str, Any] = {
        "epochs": 200, "epochs_with_observations": 100, "epochs_with_position": 90, "status": {"ok": 60},
        "positioning_rate": 0.9, "ok_rate": 0.6, "epochs_with_position_by_status": {"ok": 60, "map_offset": 30},
        "along_sigma_m": {"p50_m": 1.25, "p95_m": 2.75, "max_m": 3.5},
    }  # fmt: skip
    run = cast(
        "ReportedRun",
        SimpleNamespace(
            name="a",
            record={"antennas": {"front": facts}},
            config=Config(filter="off"),
            folder=SimpleNamespace(antennas=("front",)),
        ),
    )
    (row,) = summary([run], None).rows
    assert [str(cell) for cell in row[3:]] == ["200", "90.00 %", "60.00 %", "2.75"]
    tables = [block for block in budget(run) if isinstance(block, Table)]
    epochs = {str(row[0]).strip(): str(row[1]) for row in tables[0].rows}
    assert epochs["positioning rate"] == "90.00 %"
    assert epochs["rate of ok"] == "60.00 %"
    assert [epochs[name] for name in ("epochs", "with observations", "with coordinates")] == ["200", "100", "90"]


@pytest.mark.requirement("D2")
def test_assumptions_of_the_level_have_each_its_own_figure() -> None:
    stated = {
        "risk_per_hour": 1e-7, "samples_per_hour": 360.0, "risk_per_sample": 2.5e-10, "k_of_whole_risk": 6.25,
        "alarm_limit_m": 20.0, "local_prior": 1e-5, "side_prior": 2e-5, "map_prior": 3e-5, "false_alarm": 4e-3,
        "satellite_prior": {"G": 5e-5, "E": 6e-5},
    }  # fmt: skip
    run = cast("ReportedRun", SimpleNamespace(record={"protection": stated}, config=Config()))
    shown = {str(row[0]): str(row[1]) for row in _assumptions(run, "separation").rows}
    assert shown["risk per hour"] == "1e-07"
    assert shown["independent samples per hour"] == "360"
    assert shown["risk per sample"] == "2.5e-10"
    assert shown["K factor of the whole risk"].startswith("6.25 ")
    assert [shown[f"prior of a {name}"] for name in ("local fault", "wrong map")] == ["1e-05", "3e-05"]
    assert shown["prior of faults on one side of the track"] == "2e-05"
    assert shown["prior of a satellite fault"] == "5e-05 (G); 6e-05 (E)"


@pytest.mark.requirement("D2")
def test_a_row_of_merits_has_each_figure_once() -> None:
    names = "counted rate rate_of_run mean_m std_m rms_m p50_m p95_m p99_m max_m max_at_chainage_m wrong_places".split()
    names += ["normalised_rms", "normalised_p95"]
    row = {"position": "on the map", **{name: float(k + 1) for k, name in enumerate(names)}}
    (cells,) = listing("one", pl.DataFrame([row]), _ERRORS).rows
    shares, lengths = [f"{100 * k:.2f}" for k in (2, 3)], [f"{k:.2f}" for k in range(5, 11)]
    assert cells == ["on the map", "1", *shares, "+4.00", *lengths, "11 m", "12", "13.00", "14.00"]


@pytest.mark.requirement("B6")
def test_a_satellite_that_the_filter_left_out_is_named_by_the_run(tmp_path: Path) -> None:
    """Codes of one satellite 60 m too long for all of a log at 1 Hz; single epochs exclude them, the filter learns."""
    inputs = demo_inputs()
    log = read_observations(inputs.front)
    log = log[::10]
    strong = str(log.satellite[np.nan_to_num(log.cn0_dbhz).mean(axis=0).argmax()])
    write_observations(
        replace(log, code_m=log.code_m + np.where(log.satellite == strong, 60.0, 0.0)), tmp_path / "front.rnx"
    )
    faulty = inputs.replaced(front=(tmp_path / "front.rnx",), rear=())
    run = run_files(faulty, Config(), out=tmp_path / "run")
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert any(f"front: the filter left out the codes of {strong} at " in note for note in run.notes), run.notes
    assert strong in record["antennas"]["front"]["satellites_left_out_by_the_filter"]
