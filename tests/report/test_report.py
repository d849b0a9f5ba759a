"""The report as a file: what it holds, that it says what is absent, that nothing in it is fetched or unescaped."""

from __future__ import annotations

import base64
import json
import re
import shutil
from contextlib import nullcontext
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from railfix.cli import app
from railfix.core.errors import InputFileError
from railfix.core.tables import number, share
from railfix.evaluate import Evaluation
from railfix.evaluate.tables import error_tables, group_tables, level_tables, select_evaluation
from railfix.pipeline.config import parse_config
from railfix.report import read_runs, report_page, write_report
from railfix.report.charts_page import pack_array, read_background, script_json
from railfix.report.figures import NO_LEVELS, NO_OBSERVATIONS, NO_REFERENCE, NO_TIMES
from railfix.report.runs import ReportedRun
from railfix.run import RunOptions, RunSummary, run_files
from railfix.run.verdict import judge_run
from railfix.simulate.demonstration import demo_files, demo_inputs, demo_truth
from report_page import Page, fetched

pytestmark = pytest.mark.requirement("D3")

RUNNER = CliRunner(env={"COLUMNS": "150", "TERM": "dumb", "NO_COLOR": "1"})
STRANGE = "a<b>&'run'"


@pytest.fixture(scope="module")
def summary(tmp_path_factory: pytest.TempPathFactory) -> RunSummary:
    """The first 20 s of the demonstration, in a folder whose name is no HTML."""
    first = pl.read_csv(demo_truth(), try_parse_dates=True)["time_gpst"][0]
    asked = {"preset": "p1", "raim": {"false_alarm": 0.01}, "antenna_pair": {"clocks": "median"}}
    options = RunOptions(observations="write", chunk_epochs=70, end=first + timedelta(seconds=20))
    out = tmp_path_factory.mktemp("run") / STRANGE
    return run_files(demo_inputs(), parse_config({"filter": "off", **asked}), out=out, options=options, asked=asked)


@pytest.fixture(scope="module")
def folder(summary: RunSummary) -> Path:
    return summary.files["run.json"].parent


@pytest.fixture(scope="module")
def judged(folder: Path) -> tuple[tuple[ReportedRun, ...], Evaluation]:
    runs, evaluation = read_runs([folder], [demo_truth()])
    assert evaluation is not None
    return runs, evaluation


@pytest.fixture(scope="module")
def evaluation(judged: tuple[tuple[ReportedRun, ...], Evaluation]) -> Evaluation:
    return judged[1]


@pytest.fixture(scope="module")
def document(judged: tuple[tuple[ReportedRun, ...], Evaluation]) -> str:
    return report_page(*judged)


@pytest.fixture(scope="module")
def unjudged(folder: Path) -> str:
    """The page without a reference."""
    runs, evaluation = read_runs([folder])
    assert evaluation is None
    return report_page(runs, evaluation)


@pytest.fixture(scope="module")
def page(document: str) -> Page:
    return Page(document)


def unpacked(text: str) -> np.ndarray:
    """Arrays of the page, by the letter that they begin with."""
    return np.frombuffer(base64.b64decode(text[1:]), dtype={"f": "<f4", "h": "<u2", "i": "<u4"}[text[0]])


def chart(page: Page, name: str, at: int = 0) -> dict[str, Any]:
    """Numbers behind a picture."""
    overview = {"plan", "error-chainage", "levels-chainage"} & {name}  # the first stands at the top of the page
    figure = [found for found in page.figures if found["data-name"] == name][at + bool(overview)]
    loaded: dict[str, Any] = json.loads(page.text[figure["data-chart"]])
    return loaded


def layer_of(values: dict[str, Any], label: str) -> dict[str, Any]:
    return next(layer for layer in values["layers"] if layer["label"] == label)


def test_errors_in_the_page_are_those_of_the_positions(page: Page, folder: Path) -> None:
    truth = pl.read_csv(demo_truth(), schema_overrides={"time_gpst": pl.Datetime("ns")})
    rows = pl.read_parquet(folder / "positions.parquet").with_columns(pl.col("antenna").cast(pl.String))
    rows = rows.join(truth.select("time_gpst", "antenna", true_m="chainage_m"), on=["time_gpst", "antenna"])
    for at, antenna in enumerate(("front", "rear")):
        all_rows = rows.filter(antenna=antenna).sort("time_gpst")
        ok = pl.col("status") == "ok"
        for label, column, kept in (
            ("single epochs", "chainage_m", ok),
            ("single epochs, failed a check", "chainage_m", ~ok),
            ("conventional", "conventional_chainage_m", pl.lit(value=True)),
        ):
            mine = all_rows.filter(kept)
            if not mine[column].count():
                continue
            expected = (mine[column] - mine["true_m"]).drop_nulls().to_numpy()
            over_time = layer_of(chart(page, "error-time", at), label)
            np.testing.assert_allclose(unpacked(over_time["y"]), expected, atol=1e-3)
            over_chainage = layer_of(chart(page, "error-chainage", at), label)
            place = mine.filter(pl.col(column).is_not_null())["true_m"].to_numpy()
            np.testing.assert_allclose(unpacked(over_chainage["x"]), place, atol=1e-3)


def test_the_sky_in_the_page_is_that_of_the_observations(page: Page, folder: Path) -> None:
    sky = chart(page, "sky")
    first = unpacked(sky["first"])
    k = len(first) // 2
    time = np.datetime64(0, "ns") + np.timedelta64(round((sky["start"] + float(unpacked(sky["epoch"])[k])) * 1e3), "ms")
    rows = pl.read_parquet(folder / "observations.parquet").filter(
        pl.col("antenna").cast(pl.String) == "front", pl.col("time_gpst") == pl.lit(time)
    )
    inside = slice(int(first[k]), int(first[k + 1]))
    names = [sky["names"][i] for i in unpacked(sky["satellite"])[inside]]
    assert sorted(names) == sorted(rows["satellite"].to_list())
    for at, name in enumerate(names, start=inside.start):
        (row,) = rows.filter(satellite=name).to_dicts()
        assert unpacked(sky["elevation"])[at] / 100.0 == pytest.approx(row["elevation_deg"], abs=0.006)
        assert unpacked(sky["azimuth"])[at] / 100.0 == pytest.approx(row["azimuth_deg"] % 360.0, abs=0.006)
        assert unpacked(sky["cn0"])[at] / 100.0 == pytest.approx(row["cn0_dbhz"], abs=0.006)
        assert row["reason_text"].split("+")[0] == sky["reasons"][unpacked(sky["reason"])[at]]


def test_every_picture_of_the_paper_is_there(page: Page) -> None:
    names = [figure["data-name"] for figure in page.figures]
    both = ("error-time", "interval-chainage", "interval-distribution", "satellites", "sky")
    assert all(names.count(name) == 2 for name in both)
    assert names[:2] == ["plan", "error-chainage"]
    assert names.count("plan") == names.count("error-chainage") == 3  # the first antenna at the top, too
    assert names.count("error-ranges") == names.count("processing-time") == 1
    assert names.count("cn0-g-1c") == 2
    # doppler, antenna pair, RAIM, its level, spacing, elevation and C/N0 floor, each over time and over chainage
    assert names.count("time") == names.count("chainage") >= 12
    assert len({figure["data-chart"] for figure in page.figures}) == len(names)
    for figure in page.figures:
        assert json.loads(page.text[figure["data-chart"]])
        assert figure.get("data-sky", "sky0-0") in {found.get("id") for found in page.figures}


def test_the_head_tells_what_was_run(document: str, folder: Path) -> None:
    record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    for entry in record["inputs"]:
        assert entry["sha256"] in document
    assert record["versions"]["numpy"] in document
    assert '<th scope="row">raim.false_alarm</th><td>0.01</td><td>0.01</td>' in document
    settings = document.split("<summary>Settings given and used")[1].split("</details>")[0]
    assert settings.count("<tr class=asked>") == 3
    facts = record["antennas"]["front"]
    for reason, count in facts["observations_rejected_by_first_reason"].items():
        assert f'<th scope="row">  {reason}</th><td class="n">{count:,}</td>' in document
    assert f"{100 * facts['positioning_rate']:.2f} %" in document
    for note in record["notes"]:
        assert note in document


def test_figures_of_merit_are_the_evaluations(document: str, evaluation: Evaluation) -> None:
    for antenna in ("front", "rear"):
        largest = evaluation.figure("max_m", antenna=antenna)
        conventional = evaluation.figure("p95_m", antenna=antenna, position="conventional")
        assert f'<td class="n">{largest:.2f}</td>' in document
        assert f'<td class="n">{conventional:.2f}</td>' in document
    assert NO_REFERENCE not in document


def test_the_terminal_and_the_page_show_the_same_tables(document: str, evaluation: Evaluation, folder: Path) -> None:
    """Every cell of the evaluation of single epochs: in the page, and what `railfix evaluate` prints."""
    words = ["evaluate", str(folder), "--reference", str(demo_truth()), "--table", "positions"]
    printed = RUNNER.invoke(app, words, env={"COLUMNS": "500"}).output
    part = select_evaluation(evaluation, folder.name)
    tables = [*error_tables(part), *group_tables(part), *level_tables(part, worst=20)]
    names = ["figures-of-merit", "intervals", "stanford-separation", "above-level-separation"]
    assert set(names) <= {table.name for table in tables}
    for table in tables:
        assert (f'<table data-name="{table.name}">' in document) == bool(table.rows)
        for row in table.rows:
            cells = [f'{mark}">{cell}</td>' for mark, cell in zip(["n"] * len(row), row, strict=True)]
            assert [k for k in table.numeric if cells[k] not in document] == []
            if table.name == "figures-of-merit" and row[0] != "all":
                assert " ".join(row).translate(str.maketrans("−–", "--")) in " ".join(printed.split())


def test_nothing_is_fetched_and_nothing_unescaped(document: str, page: Page) -> None:
    assert fetched(document) == []
    assert not [tag for tag, _ in page.elements if tag in ("link", "img", "iframe", "object", "embed", "base")]
    policy = next(found for tag, found in page.elements if tag == "meta" and "http-equiv" in found)
    assert policy["content"].startswith("default-src 'none'")
    assert STRANGE not in document
    assert "a&lt;b&gt;&amp;" in document
    assert "b" not in {tag for tag, _ in page.elements}


@pytest.mark.requirement("C4")
def test_the_protection_level_has_its_section(document: str, page: Page, evaluation: Evaluation, folder: Path) -> None:
    names = [figure["data-name"] for figure in page.figures]
    assert names.count("stanford") == 4  # usable and all, of two antennas
    assert names.count("levels") == names.count("levels-chainage") == 2
    table = evaluation.integrity["separation"].stanford.filter(grouping="all", own_limit=True)
    regions = ("nominal", "misleading", "hazardously_misleading", "unavailable", "unavailable_misleading")
    order = [(antenna, levels_of) for antenna in ("front", "rear") for levels_of in ("usable", "all")]
    for at, (antenna, levels_of) in enumerate(order):
        (row,) = table.filter(antenna=antenna, levels_of=levels_of).iter_rows(named=True)
        values = chart(page, "stanford", at)
        marks = next(layer for layer in values["layers"] if layer["kind"] == "marks")
        counted = [int(words.split("\n")[-1].replace(",", "")) for words in marks["words"]]
        assert counted == [row[name] for name in regions]
        cells = next(layer for layer in values["layers"] if layer["kind"] == "cells")
        assert unpacked(cells["n"]).sum() == row["judged"]
        assert f'<td>{levels_of}</td><td class="n">20 (own)</td><td class="n">{row["epochs"]:,}</td>' in document
    told = json.loads((folder / "run.json").read_text(encoding="utf-8"))["protection"]
    assert f"<td>{told['risk_per_hour']:.4g}</td>" in document
    assert f"<td>{told['k_of_whole_risk']:.4g} sigma, two-sided</td>" in document
    assert told["sigmas"].split("'")[0] in document


@pytest.mark.requirement("C4")
def test_errors_over_their_level_are_listed(folder: Path, tmp_path: Path) -> None:
    mine = tmp_path / "run"
    shutil.copytree(folder, mine)
    positions = pl.read_parquet(mine / "positions.parquet").with_columns(protection_level_m=pl.lit(0.3))
    positions.write_parquet(mine / "positions.parquet")
    (mine / "positions.csv").unlink()
    runs, evaluation = read_runs([mine], [demo_truth()])
    document = report_page(runs, evaluation)
    truth = pl.read_csv(demo_truth(), schema_overrides={"time_gpst": pl.Datetime("ns")})
    rows = positions.with_columns(pl.col("antenna").cast(pl.String)).join(
        truth.select("time_gpst", "antenna", true_m="chainage_m"), on=["time_gpst", "antenna"]
    )
    over = rows.filter((pl.col("chainage_m") - pl.col("true_m")).abs() > 0.3)
    usable = over.filter(
        pl.col("status").cast(pl.String) == "ok", pl.col("protection_status").cast(pl.String) != "alarm"
    )
    assert len(over) > 20
    assert (
        f"Errors above the level (single epochs, separation): {len(over):,}, of which {len(usable):,} at a usable "
        "level; the 20 largest" in document
    )
    listed = document.split("Errors above the level (single epochs, separation)")[1].split("</table>")[0]
    assert listed.count("<tr>") == 1 + 20
    worst = over.select(size=(pl.col("chainage_m") - pl.col("true_m")).abs()).max().item()
    assert f"{worst:.2f}</td>" in listed.split("<tr>")[2]


@pytest.mark.requirement("C4")
def test_levels_without_a_reference_and_runs_without_levels(folder: Path, unjudged: str, tmp_path: Path) -> None:
    names = [figure["data-name"] for figure in Page(unjudged).figures]
    assert (names.count("levels"), names.count("levels-chainage")) == (2, 3)
    assert "stanford" not in names
    positions = pl.read_parquet(folder / "positions.parquet").filter(pl.col("antenna").cast(pl.String) == "front")
    within = positions.filter(
        pl.col("status").cast(pl.String) == "ok",
        pl.col("protection_status").cast(pl.String) != "alarm",
        pl.col("protection_level_m") <= 20.0,
    )
    section = unjudged.split("<summary>Protection level</summary>")[1].split("</details>")[0]
    row = next(line for line in section.split("<tr>") if "front" in line and "usable" in line and ">20<" in line)
    assert f"{100 * len(within) / len(positions):.2f} %" in row
    shutil.copy(folder / "run.json", tmp_path)
    record = json.loads((tmp_path / "run.json").read_text(encoding="utf-8"))
    record["protection"] = {}
    (tmp_path / "run.json").write_text(json.dumps(record), encoding="utf-8")
    columns = [name for name in positions.columns if name.startswith("protection_")]
    positions.drop(columns, "raim_level_m").write_parquet(tmp_path / "positions.parquet")
    runs, evaluation = read_runs([tmp_path], [demo_truth()])
    bare = report_page(runs, evaluation)
    assert NO_LEVELS in bare
    assert not {"levels", "stanford"} & {figure["data-name"] for figure in Page(bare).figures}


def cards_of(page: str) -> dict[str, tuple[str, str, str]]:
    """Key figures of the first run by name: the value, that of single epochs below it, and the remark."""
    keys = page[page.index('<dl class="keys">') : page.index("</dl>")]
    each = r"<dt>(.*?)</dt><dd>(.*?)</dd>(?:<dd class=.single.>single epochs (.*?)</dd>)?<dd class=.beside.>(.*?)</dd>"
    return {name: (value, single, beside) for name, value, single, beside in re.findall(each, keys)}


def test_every_card_has_the_figure_of_the_evaluation_and_of_the_verdict(folder: Path, tmp_path: Path) -> None:
    """Conventional positions are those of unscreened ranges where such a run is given."""
    first = pl.read_csv(demo_truth(), try_parse_dates=True)["time_gpst"][0]
    config = parse_config({"filter": "off", "screens": ["elevation"]})
    run_files(demo_inputs(), config, out=tmp_path / "unscreened", options=RunOptions(end=first + timedelta(seconds=20)))
    run_files(demo_inputs(), out=tmp_path / "run", options=RunOptions(end=first + timedelta(seconds=20)))
    for mine in (folder, tmp_path / "run"):
        runs, evaluation = read_runs([mine], [demo_truth()], conventional=[tmp_path / "unscreened"])
        assert evaluation is not None
        page = report_page(runs, evaluation)
        assert "unscreened ranges, as in paper P1" in page
        cards = cards_of(page)
        assert len(cards) == 5
        name, train = (runs[0].name_in(evaluation, table) for table in ("positions", "train"))
        assert bool(train) == (mine != folder)
        own = {"run": name, "antenna": "front"}
        leading = {**own, "run": train, "position": "constrained"} if train else {**own, "position": "constrained_ok"}
        for name, key in (("median error", "p50_m"), ("95 % of errors within", "p95_m"), ("largest error", "max_m")):
            value = evaluation.figure(key, **leading)
            single = evaluation.figure(key, **own, position="constrained_ok")
            other = evaluation.figure(key, **own, position="conventional")
            expected = f"{value:.2f} m", f"{single:.2f} m" if train else "", f"conventional {other:.2f} m"
            assert cards.pop(name) == expected
        verdict = judge_run(runs[0].record).antennas[0]
        figures = {name: (value, single) for name, value, single in verdict.figures()}
        assert {name: figures[name] for name in cards} == {name: card[:2] for name, card in cards.items()}
        assert len(cards) == 2
    # without a single epoch that passed, the cards have the errors of the filter
    table = pl.read_parquet(tmp_path / "run" / "positions.parquet").with_columns(status=pl.lit("uncertain"))
    table.write_parquet(tmp_path / "run" / "positions.parquet")
    assert cards_of(report_page(*read_runs([tmp_path / "run"], [demo_truth()])))["largest error"][1] == "–"


def test_a_larger_error_on_the_map_is_explained(folder: Path, tmp_path: Path) -> None:
    mine = tmp_path / "run"
    shutil.copytree(folder, mine)
    table = pl.read_parquet(mine / "positions.parquet").with_row_index("row")
    row = table.filter(pl.col("antenna") == "front", pl.col("conventional_chainage_m").is_not_null())["row"][50]
    moved = pl.when(pl.col("row") == row).then(pl.col("chainage_m") + 99.0).otherwise(pl.col("chainage_m"))
    for status, sentence in (
        ("ok", ", exceeds the largest error of conventional positions, "),
        ("inconsistent", "further positions failed a check (status: "),
    ):
        marked = pl.when(pl.col("row") == row).then(pl.lit(status)).otherwise(pl.col("status").cast(pl.String))
        table.with_columns(chainage_m=moved, status=marked).drop("row").write_parquet(mine / "positions.parquet")
        document = report_page(*read_runs([mine], [demo_truth()]))
        top = document.split('<section class="overview"')[1].split("</section>")[0]
        assert sentence in top
        (largest,) = re.findall(r"largest error</dt><dd>([0-9.]+) m", top)
        assert (float(largest) > 90.0) == (status == "ok")


def test_a_background_is_drawn_below_the_plan(folder: Path, tmp_path: Path) -> None:
    streets = tmp_path / "streets.geojson"
    positions = pl.read_parquet(folder / "positions.parquet", columns=["longitude_deg", "latitude_deg"])
    line = {"type": "LineString", "coordinates": [[135.44, 35.04], positions.drop_nulls().row(0), [135.46, 35.06]]}
    streets.write_text(json.dumps({"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": line}]}))
    arguments = ["report", str(folder), "--background", str(streets), "--out", str(tmp_path / "page.html")]
    assert RUNNER.invoke(app, arguments).exit_code == 0
    page = Page((tmp_path / "page.html").read_text(encoding="utf-8"))
    assert len(unpacked(layer_of(chart(page, "plan", -1), "background")["x"])) > 0
    for wrong in ("{", '{"type": "Topology"}', '{"type": "LineString", "coordinates": [[1e6, 2e6], [1e6, 2e6]]}', "[]"):
        streets.write_text(wrong)
        result = RUNNER.invoke(app, [*arguments, "--overwrite"])
        assert result.exit_code == 3, result.output
        assert "JSON" in result.output or "WGS 84" in result.output


@pytest.mark.parametrize(
    "point", [(180.0, 90.0), (-180.0, -90.0), (180.5, 0.0), (-180.5, 0.0), (0.0, 90.5), (0.0, -90.5)]
)
def test_a_background_is_in_degrees(tmp_path: Path, point: tuple[float, float]) -> None:
    path = tmp_path / "streets.geojson"
    path.write_text(json.dumps({"type": "LineString", "coordinates": [[1.0, 2.0], point]}))
    inside = abs(point[0]) <= 180.0 and abs(point[1]) <= 90.0
    with nullcontext() if inside else pytest.raises(InputFileError, match="WGS 84"):
        assert read_background(path)[0].tolist() == [[1.0, 2.0], [*point]]


def test_the_filter_along_the_track_stands_beside_the_positions(folder: Path, tmp_path: Path) -> None:
    mine = tmp_path / "run"
    shutil.copytree(folder, mine)
    columns = "time_gpst antenna status chainage_m along_sigma_m x_m y_m z_m protection_level_m".split()
    train = pl.read_parquet(mine / "positions.parquet").select(columns).with_columns(status=pl.lit("tracking"))
    train.write_parquet(mine / "train.parquet")
    runs, evaluation = read_runs([mine], [demo_truth()])
    document = report_page(runs, evaluation)
    values = chart(Page(document), "error-chainage")
    on_map, filtered = (unpacked(layer_of(values, name)["y"]) for name in ("single epochs", "filter along the track"))
    np.testing.assert_allclose(filtered, on_map, atol=1e-6)
    assert evaluation is not None
    largest = evaluation.figure("max_m", run="run (train)", antenna="front")
    assert "The filter along the track has a position in" in document
    assert "errors are below" in document
    assert f"and the largest is {largest:.1f} m. " in document
    assert f"<dd>{largest:.2f} m</dd>" in document
    assert evaluation.levels is not None
    level = evaluation.levels.filter(run="run (train)", antenna="front", position="constrained_ok")[
        "level_p50_m"
    ].item()
    beyond = len(evaluation.integrity["train"].beyond.filter(pl.col("usable"), antenna="front"))
    assert f"<dd>{level:.1f} m</dd>" in document
    assert f">errors above usable levels: filter {beyond:,}, single" in document
    assert "Stanford diagram, usable levels (filter along the track)" in document
    assert "filter-stanford-train" in document


def test_hostile_words_stay_words(folder: Path, unjudged: str, tmp_path: Path) -> None:
    attack = "</script><script>alert(1)</script><!--"
    mine = tmp_path / "run"
    shutil.copytree(folder, mine)
    record = json.loads((mine / "run.json").read_text(encoding="utf-8"))
    record["notes"] = [attack]
    record["command"] = ["railfix", attack]
    record["line"]["track"]["name"] = attack
    record["inputs"][0]["path"] = attack
    (mine / "run.json").write_text(json.dumps(record), encoding="utf-8")
    observations = pl.read_parquet(mine / "observations.parquet").with_columns(signal=pl.lit(attack))
    observations.write_parquet(mine / "observations.parquet")
    runs, _ = read_runs([mine])
    document = report_page(runs, None, title=attack)
    assert "alert(1)</script>" not in document
    assert "<!--" not in document
    assert document.count("<script") == unjudged.count("<script") - 2 * _signals_lost(folder)
    assert document.count("&lt;script&gt;alert(1)") >= 5


def _signals_lost(folder: Path) -> int:
    """Pictures of C/N0 over elevation that become one where a kind of satellite has one signal only."""
    rows = pl.read_parquet(folder / "observations.parquet").with_columns(kind=pl.col("satellite").str.head(1))
    kinds = rows.filter(pl.col("cn0_dbhz").is_not_null())
    return kinds.select("kind", "signal").unique().height - kinds["kind"].n_unique()


def test_without_a_reference_the_page_says_so(unjudged: str) -> None:
    names = {figure["data-name"] for figure in Page(unjudged).figures}
    assert NO_REFERENCE in unjudged
    assert not {"error-time", "error-chainage", "error-ranges", "stanford"} & names
    assert {"plan", "interval-chainage", "sky"} <= names
    assert "Figures of merit" not in unjudged


def test_without_observations_and_times_the_page_says_so(folder: Path, tmp_path: Path) -> None:
    shutil.copy(folder / "positions.parquet", tmp_path)
    record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    del record["chunks"]
    (tmp_path / "run.json").write_text(json.dumps(record), encoding="utf-8")
    runs, evaluation = read_runs([tmp_path], [demo_truth()])
    document = report_page(runs, evaluation)
    names = {figure["data-name"] for figure in Page(document).figures}
    assert NO_OBSERVATIONS in document
    assert NO_TIMES in document
    assert not {"sky", "time", "processing-time"} & names
    assert {"error-time", "plan"} <= names


def test_several_runs_have_a_summary_and_a_part_each(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    page = tmp_path / "report.html"
    arguments = ["report", str(folder), str(other), "--reference", str(demo_truth()), "--out", str(page)]
    result = RUNNER.invoke(app, arguments)
    assert result.exit_code == 0, result.output
    document = page.read_text(encoding="utf-8")
    read = Page(document)
    ranges = chart(read, "error-ranges")
    assert len(ranges["layers"][0]["names"]) == 8
    assert ranges["layers"][0]["names"][-1] == "other, rear, conventional"
    names = [layer["label"] for layer in chart(read, "errors-of-runs")["layers"]]
    assert names == [f"{name}, {antenna}" for name in (folder.name, "other") for antenna in ("front", "rear")]
    assert {"run0", "run1", "run0-0", "run1-1"} <= {found.get("id") for _, found in read.elements}
    assert document.count('<th scope="row">other</th>') == 2
    assert [figure["data-name"] for figure in read.figures].count("plan") == 6


def test_the_run_tells_how_long_its_chunks_took(summary: RunSummary, page: Page) -> None:
    record = json.loads(summary.files["run.json"].read_text(encoding="utf-8"))
    chunks = record["chunks"]
    assert sum(chunks["epochs"]) == summary.tally.epochs == 400
    assert len(chunks["epochs"]) == len(chunks["positioning_s"]) == 4  # the first one is short
    assert chunks["first_epoch_gpst"][0] == record["antennas"]["front"]["first_epoch_gpst"]
    assert 0.0 < sum(chunks["positioning_s"]) < record["wall_s"]
    drawn = layer_of(chart(page, "processing-time"), "mean of a chunk")
    expected = 1e3 * np.array(chunks["positioning_s"]) / np.array(chunks["epochs"])
    np.testing.assert_allclose(unpacked(drawn["y"]), expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["{run}", "--out", "{tmp}/none/report.html"], 8, "does not exist"),
        (
            ["{run}", "--out", "{tmp}/report.pdf"],
            8,
            "give a file name that ends in .html or .htm; for a PDF file, print",
        ),
        (["{tmp}/nowhere", "--out", "{tmp}/report.html"], 3, "there is no such folder"),
        (["{tmp}", "--out", "{tmp}/report.html"], 3, "positions"),
        (["{run}", "{run}", "--out", "{tmp}/report.html"], 4, "given twice"),
        (["{run}", "--reference", "{truth}", "--reference", "{truth}", "--out", "{tmp}/report.html"], 4, "references"),
        (["{run}", "--reference", "{tmp}/truth.csv", "--out", "{tmp}/report.html"], 3, "truth.csv"),
        (["{run}"], 2, "--out"),
    ],
)
def test_what_is_wrong_is_told(folder: Path, tmp_path: Path, arguments: list[str], code: int, said: str) -> None:
    words = [a.format(run=folder, tmp=tmp_path, truth=demo_truth()) for a in arguments]
    result = RUNNER.invoke(app, ["report", *words])
    assert result.exit_code == code, result.output
    assert said in result.output
    assert "Traceback" not in result.output
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("broken", ["{", "[]", "{}", '{"settings_used": {"colour": "red"}}'])
def test_a_record_that_is_none(folder: Path, tmp_path: Path, broken: str) -> None:
    shutil.copy(folder / "positions.parquet", tmp_path)
    (tmp_path / "run.json").write_text(broken)
    result = RUNNER.invoke(app, ["report", str(tmp_path), "--out", str(tmp_path / "report.html")])
    assert result.exit_code in (3, 4)
    assert "run.json" in result.output
    assert not (tmp_path / "report.html").exists()


def test_a_record_of_an_earlier_version(folder: Path, tmp_path: Path) -> None:
    """A removed setting that nothing used is left out; any other is one sentence."""
    shutil.copy(folder / "positions.parquet", tmp_path)
    record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    words = ["report", str(tmp_path), "--overwrite", "--out", str(tmp_path / "report.html")]
    for name, code in (("predicted_sigmas", 0), ("colour", 3)):
        record["settings_used"]["section"][name] = 6.0
        (tmp_path / "run.json").write_text(json.dumps(record), encoding="utf-8")
        result = RUNNER.invoke(app, words)
        assert result.exit_code == code, result.output
    assert "run.json: does not fit this version" in " ".join(result.output.split())
    assert "section.colour" in result.output
    assert "repeat the run with this version" in " ".join(result.output.split())


def test_observations_that_are_no_table(folder: Path, tmp_path: Path) -> None:
    for name in ("run.json", "positions.parquet"):
        shutil.copy(folder / name, tmp_path)
    (tmp_path / "observations.parquet").write_text("no table")
    result = RUNNER.invoke(app, ["report", str(tmp_path), "--out", str(tmp_path / "report.html")])
    assert result.exit_code == 3
    assert "observations.parquet" in result.output


def test_an_earlier_page_is_replaced_and_an_error_leaves_it(folder: Path, tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    page.write_text("old")
    assert RUNNER.invoke(app, ["report", str(tmp_path), "--out", str(page), "--overwrite"]).exit_code == 3
    assert page.read_text() == "old"
    assert write_report([str(folder)], str(page)).read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_pieces_of_html() -> None:
    assert script_json({"a": "</script>\u2028"}) == '{"a":"\\u003c/script\\u003e\\u2028"}'
    with pytest.raises(ValueError, match="JSON"):
        script_json({"a": float("nan")})
    np.testing.assert_array_equal(unpacked(pack_array(np.array([1.5, np.nan, -np.inf]))), [1.5, np.nan, -np.inf])
    assert unpacked(pack_array(np.array([0, 70_000]), "i")).tolist() == [0, 70_000]
    assert number(-1234.5) == "−1,234.50"
    assert number(None) == number(float("nan")) == share(None) == "–"


def test_the_demonstration_ends_with_numbers_and_the_page(tmp_path: Path) -> None:
    result = RUNNER.invoke(app, ["demo", "--out", str(tmp_path / "demo")])
    assert result.exit_code == 0, result.output
    lines = result.output.strip().splitlines()
    assert len(lines) <= 8
    assert lines[-1].endswith("report.html")
    # one sentence says how good it is, with the figures of the rows of the filter
    sentence = next(line for line in lines if line.startswith("against the ground truth"))
    truth = pl.read_csv(demo_files()["truth"], schema_overrides={"time_gpst": pl.Datetime("ns")})
    train = pl.read_parquet(tmp_path / "demo" / "train.parquet")
    both = train.join(truth, on=["time_gpst", "antenna"], suffix="_true")
    error = (both["chainage_m"] - both["chainage_m_true"]).abs()
    assert f"errors of {error.median():.1f} m at the median" in sentence
    assert f"{error.max():.1f} m at most over {len(error):,} epochs" in sentence
    assert (error > both["protection_level_m"]).sum() == 0
    assert "none above their protection level; conventional positions" in sentence
    written = sorted(path.name for path in (tmp_path / "demo").iterdir())
    tables = ["observations.parquet", "positions.csv", "positions.parquet"]
    assert written == [*tables, "report.html", "run.json", "train.csv", "train.parquet", "unscreened"]
    page = (tmp_path / "demo" / "report.html").read_text()
    # the level of the filter along the track, not that on the ground, which has a row too
    assert re.search(r"level, median</dt><dd>8\.\d m</dd><dd class=\"single\">single epochs 9\.\d m</dd>", page)
    names = [figure["data-name"] for figure in Page(page).figures]
    assert names.count("error-time") == 2
