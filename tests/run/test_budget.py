"""The budget of a run: observations and epochs lost to each reason add up, on file and on screen."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from broken_bench import Bench, bench_in
from railfix.cli import app
from railfix.core.reasons import Reason, Status
from railfix.integrity.point_validation import PointStatus
from railfix.pipeline.config import parse_config
from railfix.pipeline.results import AntennaResult
from railfix.run import RunSummary, run_files
from railfix.run.tally import AntennaTally
from railfix.simulate.demonstration import demo_inputs

pytestmark = pytest.mark.requirement("B7")

RUNNER = CliRunner(env={"COLUMNS": "150", "TERM": "dumb", "NO_COLOR": "1"})


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return bench_in(tmp_path_factory.mktemp("bench"))


@pytest.fixture(scope="module", params=["keep", "drop"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> RunSummary:
    """The demonstration with limits so tight that epochs are lost to several reasons."""
    config = parse_config(
        {
            "min_satellites": 13,
            "failed_checks": request.param,
            "antenna_pair": {"limit_m": 3.0, "verdict": "reject"},
            "antenna_spacing": {"limit_m": 1.0},
            "raim": {"false_alarm": 0.05, "max_excluded": 0},
        }
    )
    return run_files(demo_inputs(), config, out=tmp_path_factory.mktemp("run") / "out")


def record_of(summary: RunSummary) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads(summary.files["run.json"].read_text())
    return loaded


def test_epochs_add_up_to_the_positioning_rate(run: RunSummary) -> None:
    record = record_of(run)
    rows = pl.read_parquet(run.files["positions.parquet"])
    dropped = record["settings_used"]["failed_checks"] == "drop"
    for name, told in record["antennas"].items():
        with_place, without = told["epochs_with_position_by_status"], told["epochs_without_position_by_status"]
        assert sum(with_place.values()) == told["epochs_with_position"]
        assert sum(with_place.values()) + sum(without.values()) == told["epochs"] == 2000
        assert told["epochs_with_position"] / told["epochs_with_observations"] == told["positioning_rate"]
        assert with_place["ok"] / told["epochs_with_observations"] == told["ok_rate"]
        assert Counter(with_place) + Counter(without) == +Counter(told["status"])
        checks = {"inconsistent", "antennas_disagree"}
        assert checks <= set(told["status"])
        assert checks & set(without if not dropped else with_place) == set()
        mine = rows.filter(pl.col("antenna") == name)
        counted = dict(mine.filter(pl.col("chainage_m").is_not_null())["status"].cast(pl.String).value_counts().rows())
        assert counted == with_place
    observed = sum(told["epochs_with_observations"] for told in record["antennas"].values())
    good = sum(told["status"]["ok"] for told in record["antennas"].values())
    assert record["ok_rate"] == good / observed <= record["positioning_rate"] < 1.0
    assert dropped or record["ok_rate"] < record["positioning_rate"]


def test_epochs_with_too_few_satellites_have_their_reason(run: RunSummary) -> None:
    for told in record_of(run)["antennas"].values():
        few = told["status"]["too_few_satellites"]
        first, alone = told["too_few_satellites_by_first_reason"], told["too_few_satellites_by_one_reason_alone"]
        assert sum(first.values()) == few > 20
        assert set(first) >= {"antenna_pair"}
        assert all(0 < count <= few for count in alone.values())


def test_observations_add_up(run: RunSummary) -> None:
    for told in record_of(run)["antennas"].values():
        first = told["observations_rejected_by_first_reason"]
        alone = told["observations_rejected_by_one_reason_alone"]
        assert told["observations_used"] + sum(first.values()) == told["observations"]
        # first of all that applied: what it alone refused is among them
        assert all(count <= first[reason] for reason, count in alone.items())


def result_of(reasons: list[list[int]], satellites: list[str], status: list[Status]) -> AntennaResult:
    """As much of a result as the counts read."""
    epochs = len(reasons)
    return cast(
        "AntennaResult",
        SimpleNamespace(
            time=np.datetime64("2024-01-01", "ns") + np.arange(epochs).astype("timedelta64[s]"),
            status=np.array(status, dtype=np.int8),
            chainage_m=np.where([s == Status.OK for s in status], 1.0, np.nan),
            conventional_offset_m=np.full(epochs, np.nan),
            conventional_status=np.full(epochs, PointStatus.VALID, dtype=np.int8),
            reason=np.array(reasons, dtype=np.int64),
            satellite=np.array(satellites),
            map_offset=SimpleNamespace(statistic=np.full(epochs, np.nan)),
            screens={},
            protection=None,
            interference=None,
        ),
    )


def test_reasons_of_too_few_satellites_by_hand() -> None:
    low, weak, other, absent = Reason.ELEVATION_MASK, Reason.CN0_FLOOR, Reason.OTHER_SIGNAL_TAKEN, Reason.NOT_OBSERVED
    few = Status.TOO_FEW_SATELLITES
    satellites = ["G01", "G02", "G03", "G04", "G04"]
    rows = [
        ([0, 0, low, low, other], few),  # the mask took the third; without the mask four are there
        ([0, weak, low, low, other], few),  # the mask left two; without it alone there are three
        ([0, weak, weak, low, other], few),  # the mask leaves three, the floor one; the floor alone holds two back
        ([0, weak | low, low | weak, low, other], few),  # both hold them: the mask came first, neither alone
        ([0, 0, absent, absent, absent], few),  # nothing but two satellites in sight
        ([0, 0, 0, absent, absent], few),  # three are used; their clocks leave no range for the place
        ([0, 0, 0, low, other], Status.OK),
    ]
    tally = AntennaTally(min_satellites=3)
    tally.add(result_of([r for r, _ in rows], satellites, [s for _, s in rows]))
    assert +tally.short_first == Counter(elevation_mask=3, cn0_floor=1, not_observed=1, used=1)
    assert +tally.short_only == Counter(elevation_mask=2, cn0_floor=1)
    assert tally.status["too_few_satellites"] == 6 == tally.short_first.total()


def test_the_screen_shows_the_budget(bench: Bench, tmp_path: Path) -> None:
    files = ["--front", bench.front, "--rear", bench.rear, "--nav", bench.nav, "--track", bench.track]
    command = ["run", *map(str, files), "--vehicle", str(bench.vehicle), "--out", str(tmp_path / "out"), "--verbose"]
    result = RUNNER.invoke(
        app,
        [
            *command,
            "--set",
            "min_satellites=12",
            "--set",
            "antenna_pair.limit_m=2.5",
            "--set",
            "antenna_pair.verdict=reject",
        ],
    )
    assert result.exit_code == 0, result.output
    told = json.loads((tmp_path / "out" / "run.json").read_text())["antennas"]["front"]
    first = told["too_few_satellites_by_first_reason"]["antenna_pair"]
    alone = told["too_few_satellites_by_one_reason_alone"].get("antenna_pair", 0)
    assert f"by antenna_pair │ {first} ({alone} alone)" in " ".join(result.output.split())
    for words in ("with coordinates", "without coordinates", "positioning rate", "rate of ok", "alone"):
        assert words in result.output
