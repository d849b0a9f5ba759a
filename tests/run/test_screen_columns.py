"""What the screens measured, in the tables of results: RAIM's verdict on each epoch, every metric of each channel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from railfix.core.reasons import CHECK_FAILED, Status
from railfix.integrity.raim import Outcome, threshold
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import parse_config
from railfix.pipeline.result_columns import OBSERVATION_COLUMNS, POSITION_COLUMNS
from railfix.pipeline.result_tables import observations_table, positions_table
from railfix.pipeline.results import Result
from railfix.ranges.cn0_curve_file import read_cn0_curve
from railfix.run.processor_setup import make_processor
from railfix.run.sources import TrackReading, open_line
from railfix.simulate.demonstration import demo_inputs

pytestmark = [pytest.mark.requirement("B7"), pytest.mark.requirement("B6")]

METRICS = [name for name in OBSERVATION_COLUMNS if name.startswith(("metric_", "limit_", "raim_"))]
#: Twenty seconds between houses.
PART = slice(250, 450)
#: Tight enough that each screen and RAIM have something to say.
TIGHT: dict[str, object] = {
    "doppler": {"hold_s": 0.0, "verdict": "reject"},
    "raim": {"false_alarm": 0.2},
    "antenna_spacing": {"limit_m": 1.0},
    "antenna_pair": {"limit_m": 3.0, "verdict": "reject"},
    "raim_protection": "on",
}


def result_of(settings: dict[str, object]) -> Result:
    inputs = demo_inputs()
    line = open_line(inputs.track, inputs.vehicle, antennas=("front", "rear"), reading=TrackReading())
    processor = make_processor(parse_config(settings), read_navigation(inputs.nav), line.trajectories)
    return processor.process({name: read_observations(paths)[PART] for name, paths in inputs.logs.items()})[0]


@pytest.fixture(scope="module")
def result() -> Result:
    return result_of(TIGHT)


def column(table: pl.DataFrame, name: str) -> np.ndarray:
    return table[name].cast(pl.Float64).fill_null(float("nan")).to_numpy()


def test_raim_of_each_epoch(result: Result) -> None:
    positions = positions_table(result)
    assert positions.columns == list(POSITION_COLUMNS)
    for name, antenna in result.antennas.items():
        mine = positions.filter(antenna=name)
        statistic, limit = column(mine, "raim_statistic"), column(mine, "raim_threshold")
        outcome = mine["raim_outcome"].cast(pl.String).to_numpy()
        assert set(outcome) >= {"passed", "excluded_one"}
        np.testing.assert_array_equal(outcome == "passed", statistic < limit)
        assert set(limit) <= set(threshold(np.arange(1, 40), limits=parse_config(TIGHT).raim))
        excluded = {"passed": 0, "excluded_one": 1, "excluded_two": 2, "inseparable": 0, "unresolved": 0}
        counted = antenna.raim.excluded.sum(axis=1)
        # what came out of one mind only to contradict itself at another place keeps its exclusions
        kept = outcome != "unresolved"
        np.testing.assert_array_equal(counted[kept], [excluded[word] for word in outcome[kept]])


def test_protection_level_is_known_where_no_fault_is_left(result: Result) -> None:
    positions = positions_table(result)
    level = column(positions, "raim_level_m")
    faulty = positions["raim_outcome"].cast(pl.String).is_in(["inseparable", "unresolved"]).to_numpy()
    assert faulty.any()
    np.testing.assert_array_equal(np.isnan(level), faulty)
    # a level is noise (3.29 sigma at a risk of 0.001) and a fault on top; satellites and atmosphere are no part of P4's
    for antenna in result.antennas.values():
        known = np.isfinite(antenna.raim.protection_level_m)
        noise = antenna.noise_scale * antenna.fix.constrained.exact_map_sigma_m
        assert (antenna.raim.protection_level_m[known] > 3.29 * noise[known]).all()


def test_dropped_positions_have_no_level() -> None:
    dropped = result_of({**TIGHT, "failed_checks": "drop"})
    for antenna in dropped.antennas.values():
        failed = np.isin(antenna.status, [s.value for s in CHECK_FAILED])
        assert (antenna.status == Status.ANTENNAS_DISAGREE).any()
        assert np.isnan(antenna.raim.protection_level_m[failed]).all()
        assert np.isnan(antenna.chainage_m[failed]).all()


def test_the_protection_level_can_be_left_out(result: Result) -> None:
    off = result_of({**TIGHT, "raim_protection": "off"})
    for name, antenna in off.antennas.items():
        assert np.isnan(antenna.raim.protection_level_m).all()
        np.testing.assert_array_equal(antenna.chainage_m, result.antennas[name].chainage_m)


def test_without_raim_nothing_is_said() -> None:
    off = result_of({"screens": ["elevation"]})
    positions, observations = positions_table(off), observations_table(off)
    assert set(positions["raim_outcome"].cast(pl.String)) == {Outcome.UNTESTABLE.name.lower()}
    assert positions["raim_level_m"].null_count() == positions.height
    assert positions["metric_antenna_spacing_m"].null_count() == positions.height
    assert all(observations[name].null_count() == observations.height for name in METRICS)


def test_spacing_of_the_two_positions(result: Result) -> None:
    positions = positions_table(result)
    front, rear = (positions.filter(antenna=name) for name in ("front", "rear"))
    apart = column(front, "chainage_m") - column(rear, "chainage_m")
    for mine in (front, rear):
        np.testing.assert_allclose(column(mine, "metric_antenna_spacing_m"), apart - 18.2, atol=0.05)


def test_every_metric_stands_at_its_satellite(result: Result) -> None:
    rows = observations_table(result)
    assert rows.columns == list(OBSERVATION_COLUMNS)
    for name, antenna in result.antennas.items():
        mine = rows.filter(antenna=name)
        for k, channel in enumerate(antenna.columns):
            of_satellite = mine.filter(satellite=antenna.satellite[channel], signal=antenna.signal[channel])
            at = np.searchsorted(antenna.time, of_satellite["time_gpst"].to_numpy())
            for screen, told in (("doppler", "metric_doppler_m"), ("antenna_pair", "metric_antenna_pair_m")):
                np.testing.assert_array_equal(column(of_satellite, told), antenna.screens[screen].metric[at, k])
            np.testing.assert_array_equal(column(of_satellite, "raim_own_error_m"), antenna.raim.own_error_m[at, k])
        refused = mine["reason_text"].str.contains("doppler").to_numpy()
        beyond = np.abs(column(mine, "metric_doppler_m")) > column(mine, "limit_doppler_m")
        assert beyond.any()
        np.testing.assert_array_equal(refused, beyond)
        own = mine.filter(pl.col("reason_text").str.contains("fault_excluded"))
        assert own.height > 0
        at = np.searchsorted(antenna.time, own["time_gpst"].to_numpy())
        named = antenna.raim.outcome[at] != Outcome.UNRESOLVED
        assert named.any()
        np.testing.assert_array_equal(own["raim_own_error_m"].is_not_null().to_numpy(), named)


def test_deficit_against_the_curve(tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from railfix.cli import app

    inputs = demo_inputs()
    curve = f"{tmp_path}/curve.toml"
    words = ["cn0-curve", str(inputs.front[0]), "--nav", str(inputs.nav[0]), "--out", curve]
    made = CliRunner().invoke(app, words)
    assert made.exit_code == 0, made.output
    rows = observations_table(result_of({"cn0_curve": curve, "screens": ["cn0"]}))
    front = rows.filter(antenna="front", satellite="G01")
    elevation, cn0 = column(front, "elevation_deg"), column(front, "cn0_dbhz")
    mean = read_cn0_curve(curve).mean_dbhz(
        elevation[:, None], satellite=np.array(["G01"]), signal=np.array([front["signal"][0]])
    )
    deficit = column(front, "metric_cn0_deficit_dbhz")
    assert np.isfinite(deficit).any()
    np.testing.assert_allclose(deficit, mean[:, 0] - cn0, atol=1e-9)
