"""The first lines of `run` and `evaluate`: at most five, with the figures of the tables, the worst first."""

from __future__ import annotations

import re

import polars as pl
import pytest
from typer.testing import CliRunner

from bad_inputs import Desk, desk_in
from railfix.cli import app
from railfix.cli.console import verdict_of_evaluation
from railfix.evaluate import RunAndReference, evaluate_runs

RUNNER = CliRunner(env={"COLUMNS": "80", "TERM": "dumb", "NO_COLOR": "1"})
pytestmark = pytest.mark.requirement("G4")


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Desk:
    return desk_in(tmp_path_factory.mktemp("desk"))


def first_lines(desk: Desk, command: str) -> list[str]:
    """Lines before the first blank one."""
    result = RUNNER.invoke(app, desk.words(command))
    assert result.exit_code == 0, result.output
    return result.stdout.split("\n\n")[0].splitlines()


def test_a_run_says_first_where_how_good_and_how_sure(desk: Desk) -> None:
    lines = first_lines(
        desk,
        "run --front {desk}/front.obs --rear {desk}/rear.obs --nav {desk}/brdc.nav --track {desk}/line.csv "
        "--vehicle {desk}/train.toml --out {desk}/new",
    )
    assert [line.split(":")[0] for line in lines] == ["front", "rear", "in doubt", "next"]
    train = pl.read_parquet(desk.folder / "new" / "train.parquet").filter(antenna="front")
    placed = train.drop_nulls("chainage_m")
    assert f"a position in {len(placed):,} of {len(train):,} epochs" in lines[0]
    assert f"chainage {placed['chainage_m'].min():.0f} to {placed['chainage_m'].max():.0f} m" in lines[0]
    assert f"largest {placed['along_sigma_m'].max():.1f} m" in lines[0]
    single = pl.read_parquet(desk.folder / "new" / "positions.parquet").filter(pl.col("status") != "no_observation")
    failed = int((single["status"] != "ok").sum())
    assert f"{failed:,} of {len(single):,} single epochs" in lines[2]
    assert lines[3].endswith(f"railfix report {desk.folder}/new --out report.html")


@pytest.mark.slow
def test_an_evaluation_says_the_worst_first_in_five_lines(desk: Desk) -> None:
    command = "evaluate {desk}/results --reference {desk}/truth.csv"
    lines = first_lines(desk, command)
    assert 1 < len(lines) <= 5
    p95 = [float(found[1]) for line in lines if (found := re.search(r"([\d.]+) m for 95 %", line))]
    assert p95 == sorted(p95, reverse=True)
    assert (
        lines[-1] == f"next: railfix report {desk.folder}/results --reference {desk.folder}/truth.csv --out report.html"
    )


def test_a_sigma_that_is_too_small_is_said(desk: Desk) -> None:
    """Errors of a hundred times the stated sigma, in more runs than there are lines."""
    pairs = [RunAndReference(run=desk.folder / "results", reference=desk.folder / "truth.csv")]
    evaluation = evaluate_runs(pairs)
    assert all("sigma fits the errors" in line for line in verdict_of_evaluation(evaluation)[:-1])
    worse = evaluation.figures.with_columns(pl.col("normalised_p95") * 100.0)
    more = pl.concat([worse.with_columns(run=pl.lit(f"{k}")) for k in range(6)])
    object.__setattr__(evaluation, "figures", more)
    lines = verdict_of_evaluation(evaluation)
    assert len(lines) == 5
    assert "too small for the errors" in lines[0]
    assert re.fullmatch(r"and \d+ better ones, in the tables below", lines[3])
