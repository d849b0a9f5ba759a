"""The verdict of `run` and `evaluate`: few lines, the figures of the tables and of the report, the worst first."""

from __future__ import annotations

import json
import re
from pathlib import Path

import polars as pl
import pytest
from typer.testing import CliRunner

from bad_inputs import Desk, desk_in
from railfix.cli import app
from railfix.cli.console import join_antennas, verdict_of_evaluation
from railfix.evaluate import RunAndReference, evaluate_runs
from railfix.run.record import read_record
from railfix.run.verdict import AntennaVerdict, PositionFigures, judge_run

RUNNER = CliRunner(env={"COLUMNS": "80", "TERM": "dumb", "NO_COLOR": "1"})
pytestmark = pytest.mark.requirement("G4")


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Desk:
    return desk_in(tmp_path_factory.mktemp("desk"))


def printed(desk: Desk, command: str) -> list[str]:
    """Lines that a command prints."""
    result = RUNNER.invoke(app, desk.words(command))
    assert result.exit_code == 0, result.output
    return result.stdout.splitlines()


def first_lines(desk: Desk, command: str) -> list[str]:
    """Lines before the first blank one."""
    lines = printed(desk, command)
    return lines[: lines.index("")]


RUN = (
    "run --front {desk}/front.obs --rear {desk}/rear.obs --nav {desk}/brdc.nav --track {desk}/line.csv "
    "--vehicle {desk}/train.toml --out {desk}/new"
)


@pytest.fixture(scope="module")
def lines(desk: Desk) -> list[str]:
    return printed(desk, RUN)


def test_a_run_says_where_how_good_and_how_sure_in_twelve_lines(desk: Desk, lines: list[str]) -> None:
    assert len(lines) <= 12
    heads = [line.split(":")[0] for line in lines]
    assert heads[:4] == ["front", "rear", "single epochs", "filter along the track"]
    assert heads[-2:] == ["results", "next"]
    train = pl.read_parquet(desk.folder / "new" / "train.parquet").filter(antenna="front")
    placed = train.drop_nulls("chainage_m")
    level = placed["protection_level_m"].filter(placed["protection_level_m"].is_finite())
    assert f"a position in {len(placed):,} of {len(train):,} epochs" in lines[0]
    assert f"chainage {placed['chainage_m'].min():.0f} to {placed['chainage_m'].max():.0f} m" in lines[0]
    assert f"{placed['along_sigma_m'].max():.1f} m at most" in lines[0]
    assert f"indicative protection level {level.quantile(0.5):.1f} m at the median" in lines[0]
    single = pl.read_parquet(desk.folder / "new" / "positions.parquet").filter(pl.col("status") != "no_observation")
    passed = int((single["status"] == "ok").sum())
    assert f"{passed:,} of {len(single):,} with observations" in lines[2]
    assert lines[-1].endswith(f"railfix report {desk.folder}/new --out report.html")


def test_each_figure_is_the_same_on_the_terminal_in_python_in_json_and_on_the_report(
    desk: Desk, lines: list[str], tmp_path: Path
) -> None:
    """Every card of the report has the name and value of the verdict, and the terminal states the same value."""
    verdict = judge_run(read_record(desk.folder / "new").record)
    printed(desk, f"report {{desk}}/new --out {tmp_path}/report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    keys = page[page.index('<dl class="keys">') : page.index("</dl>")]
    cards = re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>(?:<dd class=\"single\">single epochs (.*?)</dd>)?", keys)
    again = json.loads(json.dumps(verdict.as_dict()))["antennas"][0]
    kinds = {kind: PositionFigures(**again.pop(kind)) for kind in ("filter", "single_epochs")}
    assert cards == list(AntennaVerdict(**again, **kinds).figures()) == list(verdict.antennas[0].figures())
    positions, _, sigma, level = (value for _, value, _ in cards)
    assert f"a position in {positions} epochs" in lines[0]
    assert f"; sigma {sigma} at" in lines[0]
    assert f"; {cards[3][0].split(',')[0]} {level} at" in lines[0]
    passed = {kind: sum(getattr(of, kind).passed for of in verdict.antennas) for kind in kinds}
    assert f"single epochs: {passed['single_epochs']:,} of" in lines[2]
    assert sum(int(n) for n in re.findall(r"(\d+) epochs (?:tracking|coasting)", lines[3])) == passed["filter"]
    assert all(value != single for name, value, single in cards if name.endswith("median"))


def test_notes_that_do_not_fit_are_counted_and_shown_on_request(desk: Desk, lines: list[str]) -> None:
    notes = read_record(desk.folder / "new").record["notes"]
    shown = [line for line in lines if line.startswith("note: ")]
    joined = join_antennas(notes)
    more = len(joined) - len(shown)
    assert (f"{more} more note" in "\n".join(lines)) == (more > 0)
    verbose = printed(desk, RUN.replace("{desk}/new", "{desk}/verbose") + " --verbose")
    assert [line for line in verbose if line.startswith("note: ")] == [f"note: {note}" for note in joined]
    assert "Filter along the track (train.csv)" in verbose


def test_notes_on_two_antennas_are_joined() -> None:
    notes = ["front: a", "x: y", "rear: a", "rear: b"]
    assert join_antennas(notes) == ["front and rear: a", "x: y", "rear: b"]


@pytest.mark.slow
def test_an_evaluation_says_the_filter_and_the_worst_first_in_five_lines(desk: Desk) -> None:
    command = "evaluate {desk}/results --reference {desk}/truth.csv"
    lines = first_lines(desk, command)
    assert 1 < len(lines) <= 5
    filtered = [line for line in lines[:-1] if "filter along the track" in line]
    assert lines[: len(filtered)] == filtered
    for kind in (filtered, lines[len(filtered) : -1]):
        p95 = [float(found[1]) for line in kind if (found := re.search(r"([\d.]+) m for 95 %", line))]
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
    assert re.fullmatch(r"and \d+ more: see the tables below", lines[3])


# -- for scripts ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "path", "value"),
    [
        (RUN.replace("{desk}/new", "{out}"), ("antennas", 0, "filter", "epochs"), 200),
        ("locate --log {desk}/front.obs --nav {desk}/brdc.nav --out {desk}/p.pos --overwrite", ("positions",), 200),
        ("evaluate {desk}/results --reference {desk}/truth.csv", ("antennas", 0, "position"), "constrained"),
        ("doctor {desk}/front.obs {desk}/brdc.nav {desk}/line.csv", ("files", 1, "kind"), "navigation"),
    ],
)
@pytest.mark.requirement("S3")
def test_json_is_one_line_with_the_verdict(
    desk: Desk, command: str, path: tuple[str | int, ...], value: object
) -> None:
    lines = printed(desk, f"{command} --json")
    assert len(lines) == 1
    found = json.loads(lines[0])
    for key in path:
        found = found[key]
    assert found == value
