"""The report in a browser: no error of its script, every picture drawn, no network, legible in print."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections import Counter
from datetime import timedelta
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from railfix.evaluate import EvaluationOptions, RunAndReference, evaluate_runs
from railfix.report import read_runs, report_page, write_report
from railfix.run import RunOptions, run_files
from railfix.simulate.demonstration import demo_inputs, demo_truth
from report_page import Page, browser, opened, run_browser, timing_ms, visited

pytestmark = [pytest.mark.requirement("D3"), pytest.mark.skipif(browser() is None, reason="no chromium is installed")]

#: Charts whose points belong to epochs, drawn so far, and the ranges of their axes.
RANGES = """() => Object.fromEntries([...document.querySelectorAll("figure[data-drawn]")].filter(f => f.plot.div).map(
    (f, k) => [f.dataset.name + k, [f.plot.range("xaxis"), f.plot.range("yaxis")]]))"""
#: Opens the folded parts and draws every chart.
DRAW_ALL = """() => { document.querySelectorAll("details").forEach(part => { part.open = true; });
    document.querySelectorAll("figure[data-chart]").forEach(figure => figure.plot.draw()); }"""

#: Opens what is folded and says which tables are wider than the page.
WIDE = """
<script>
(function () {
  for (const folded of document.querySelectorAll("details")) folded.open = true;
  const said = document.createElement("div"), boxes = [...document.querySelectorAll(".scroll")];
  said.id = "wide";
  said.dataset.tables = boxes.length;
  said.dataset.window = window.innerWidth;
  said.dataset.over = boxes.filter(box => box.scrollWidth > box.clientWidth)
    .map(box => box.scrollWidth + " " + box.textContent.slice(0, 40)).join("; ");
  document.body.append(said);
})();
</script></body>"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    first = pl.read_csv(demo_truth(), try_parse_dates=True)["time_gpst"][0]
    options = RunOptions(observations="write", chunk_epochs=70, end=first + timedelta(seconds=20))
    folder = tmp_path_factory.mktemp("browser")
    run_files(demo_inputs(), out=folder / "run", options=options)
    return write_report([folder / "run"], folder / "report.html", references=[demo_truth()])


def test_it_opens_with_its_first_pictures_and_without_an_error(page: Path) -> None:
    document = opened(page)
    read = Page(document)
    assert read.text.get("railfix-errors", "") == ""
    drawn = [figure for figure in read.figures if "data-drawn" in figure]
    assert 0 < len(drawn) < len(read.figures)
    assert all(int(figure["data-drawn"]) > 0 for figure in drawn)
    found = timing_ms(document)
    assert found["drawn"] > 0.0
    assert found["load"] > 0.0


@pytest.mark.slow
def test_every_picture_is_drawn_in_a_window_that_holds_them_all(page: Path) -> None:
    copy = page.with_name("open.html")
    copy.write_text(page.read_text(encoding="utf-8").replace("<details", "<details open"), encoding="utf-8")
    read = Page(opened(copy, height=40_000))
    assert read.text.get("railfix-errors", "") == ""
    assert {figure["data-name"]: int(figure.get("data-drawn", 0)) > 0 for figure in read.figures} == {
        figure["data-name"]: True for figure in read.figures
    }
    assert len(read.figures) > 30


def centre_of(shown: Any, name: str, x: float, y: float) -> tuple[float, float]:
    """Pixel of a point of a chart, from the ranges of its axes and the margins of its drawing."""
    place = shown.evaluate(
        """([name, x, y]) => { const f = document.querySelector(`figure[data-name=${name}]`), p = f.plot, d = p.div;
        const r = d.getBoundingClientRect(), m = d.layout.margin;
        const [x0, x1] = p.range("xaxis"), [y0, y1] = p.range("yaxis");
        return [r.left + m.l + (x - x0) / (x1 - x0) * (r.width - m.l - m.r),
            r.bottom - m.b - (y - y0) / (y1 - y0) * (r.height - m.t - m.b)]; }""",
        [name, x, y],
    )
    return place[0], place[1]


def test_a_click_shows_the_satellites_beside_the_chart_and_keys_go_on(page: Path) -> None:
    with visited(page, viewport={"width": 1400, "height": 900}) as shown:
        chart = shown.locator("figure[data-name=error-chainage]").first
        where = shown.evaluate(
            """() => { const p = document.querySelector("figure[data-name=error-chainage]").plot;
            const l = p.chart.layers.filter(l => l.label === "filter along the track")[0], i = 40;
            return [l.x[i], p.chart.y_scale === "symlog" ? NaN : l.y[i], p.chart.epoch0 + l.epoch[i]]; }"""
        )
        shown.mouse.click(*centre_of(shown, "error-chainage", where[0], where[1]))
        panel = shown.locator(".skyplot.docked")
        panel.wait_for(state="visible")
        # the chart makes room, and stays in sight beside the panel
        shown.locator("body.with-panel").wait_for()
        boxes = chart.bounding_box(), panel.bounding_box()
        assert boxes[0] is not None
        assert boxes[1] is not None
        assert boxes[0]["x"] + boxes[0]["width"] <= boxes[1]["x"]
        assert boxes[0]["y"] < 900
        first = panel.locator("output").inner_text()
        assert "signals used" in first
        assert panel.locator("tbody tr").count() > 5
        panel.locator(".after").click()
        second = panel.locator("output").inner_text()
        assert second != first
        assert panel.locator("output").get_attribute("aria-live") == "polite"
        chart.locator(".plot").focus()
        shown.keyboard.press("ArrowLeft")
        assert panel.locator("output").inner_text() == first
        shown.keyboard.press("Escape")
        assert shown.locator(".skyplot.docked").count() == 0
        shown.keyboard.press("Enter")
        panel.wait_for(state="visible")


def test_zooming_a_chart_restricts_the_plan_and_the_other_charts(page: Path) -> None:
    with visited(page, viewport={"width": 1400, "height": 900}) as shown:
        before = shown.evaluate(RANGES)
        plan, chart = (next(key for key in before if key.startswith(name)) for name in ("plan", "error-chainage"))
        (low, high), (bottom, top) = before[chart]
        third = (high - low) / 3.0
        start = centre_of(shown, "error-chainage", low + third, bottom + 0.2 * (top - bottom))
        end = centre_of(shown, "error-chainage", high - third, bottom + 0.8 * (top - bottom))
        shown.mouse.move(*start)
        shown.mouse.down()
        shown.mouse.move(*end, steps=4)
        shown.mouse.up()
        shown.wait_for_function("document.querySelector('figure[data-name=plan]').plot.zoomed")
        after = shown.evaluate(RANGES)
        assert after[chart][0] == pytest.approx([low + third, high - third], abs=0.03 * (high - low))
        # the plan shows the stretch whose chainage was chosen: by a length near it, and no more
        width = max(after[plan][k][1] - after[plan][k][0] for k in (0, 1))
        assert width < 0.75 * max(before[plan][k][1] - before[plan][k][0] for k in (0, 1))
        shown.locator("figure[data-name=error-chainage] .plot").first.focus()
        shown.keyboard.press("0")
        shown.wait_for_function("!document.querySelector('figure[data-name=plan]').plot.zoomed")
        whole = shown.evaluate(RANGES)
        assert whole[plan] == [pytest.approx(axis, rel=1e-3, abs=1e-3) for axis in before[plan]]


@pytest.mark.slow
def test_every_chart_shows_its_numbers_and_zooms_by_keys(page: Path) -> None:
    with visited(page, viewport={"width": 1400, "height": 900}) as shown:
        shown.evaluate(DRAW_ALL)
        spans = shown.evaluate(
            """() => [...document.querySelectorAll("figure[data-chart]")].filter(f => f.plot.div).map(f => {
            const before = f.plot.range("xaxis"); f.plot.following = true;
            f.plot.scale(0.5, 0); const after = f.plot.range("xaxis");
            return [f.dataset.name, Number(f.dataset.drawn), (after[1] - after[0]) / (before[1] - before[0])]; })"""
        )
        assert len(spans) > 25
        assert all(drawn > 0 for _, drawn, _ in spans)
        assert all(ratio == pytest.approx(0.5, abs=0.01) for _, _, ratio in spans)


@pytest.mark.slow
def test_tables_can_be_downloaded(page: Path, tmp_path: Path) -> None:
    with visited(page, accept_downloads=True) as shown:
        shown.evaluate("() => document.querySelectorAll('details').forEach(part => { part.open = true; })")
        button = shown.locator("div.table:has(table[data-name=figures-of-merit]) button.download").first
        with shown.expect_download() as waiting:
            button.click()
        waiting.value.save_as(tmp_path / "table.csv")
    rows = pl.read_csv(tmp_path / "table.csv", infer_schema_length=0)
    assert rows["antenna"].unique(maintain_order=True).to_list()[:2] == ["front", "rear"]
    assert rows["max"].cast(pl.Float64).min() > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 1400])
def test_nothing_is_wider_than_the_window(page: Path, width: int) -> None:
    wide = """width => [...document.querySelectorAll("body *")].filter(e => !e.closest(".scroll, svg, .modebar") &&
        e.getBoundingClientRect().right > width + 1).map(e => e.tagName + "." + e.className).join(" ")"""
    with visited(page, viewport={"width": width, "height": 844}) as shown:
        shown.evaluate(DRAW_ALL)
        shown.wait_for_timeout(300)
        assert shown.evaluate("document.documentElement.scrollWidth") == width
        assert shown.evaluate(wide, width) == ""


@pytest.mark.slow
@pytest.mark.parametrize(("scheme", "paper"), [("light", "rgb(255, 255, 255)"), ("dark", "rgb(20, 24, 28)")])
def test_charts_follow_the_readers_preference(page: Path, scheme: str, paper: str) -> None:
    with visited(page, color_scheme=scheme) as shown:
        colours = shown.evaluate(
            """() => [getComputedStyle(document.body).backgroundColor,
            getComputedStyle(document.querySelector("figure[data-drawn] .main-svg")).backgroundColor]"""
        )
    assert colours == [paper, paper]


@pytest.mark.slow
def test_tables_fit_a_window_of_1300_pixels(tmp_path: Path) -> None:
    """With limits of confidence, and the names of demo and antennas; nothing has to be scrolled sideways."""
    out = tmp_path / "run"
    run_files(demo_inputs(), out=out)
    runs, _ = read_runs([out])
    with_limits = EvaluationOptions(block_s=20.0)
    evaluation = evaluate_runs([RunAndReference(run=out, reference=demo_truth())], options=with_limits)
    document = report_page(runs, evaluation)
    assert "Confidence limits of 95 %, from blocks of 20 s" in document
    assert "100.00 to 100.00" in document
    page = tmp_path / "wide.html"
    page.write_text(document.replace("</body>", WIDE), encoding="utf-8")
    read = Page(run_browser(page, "--window-size=1300,1000", "--dump-dom"))
    said = read.by_id("wide")
    assert int(said["data-tables"]) > 10
    assert said["data-over"] == ""
    assert said["data-window"] == "1300"


@pytest.mark.slow
def test_an_error_of_the_script_would_be_seen(page: Path, tmp_path: Path) -> None:
    copy = tmp_path / "broken.html"
    broken = "<script>console.error('told'); nowhere();</script></body>"
    copy.write_text(page.read_text(encoding="utf-8").replace("</body>", broken), encoding="utf-8")
    said = Page(opened(copy)).text["railfix-errors"]
    assert "told" in said
    assert "nowhere" in said


@pytest.mark.slow
def test_it_prints_whole(page: Path, tmp_path: Path) -> None:
    paper = tmp_path / "report.pdf"
    run_browser(page, f"--print-to-pdf={paper}")
    assert paper.read_bytes().startswith(b"%PDF")
    assert paper.stat().st_size < 5_000_000
    if shutil.which("pdftotext") is None or shutil.which("pdfinfo") is None:
        pytest.skip("no pdftotext and pdfinfo to look into the printed page")

    def told(*command: str) -> str:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    text = " ".join(told("pdftotext", "-layout", str(paper), "-").split())
    for words in ("Figures of merit", "Settings given and used", "min_satellites", "SHA-256", "rear antenna"):
        assert words in text
    # what is written along the axes of the charts is text on paper too: every one is there
    read = Page(page.read_text(encoding="utf-8"))
    charts = [json.loads(read.text[f["data-chart"]]) for f in read.figures if "skyplot" not in f["class"]]
    labels = Counter(values["x_label"] for values in charts)
    assert labels["GPS time"] > 10
    for label, count in labels.items():
        assert text.count(f"{label}, 2024-03-05" if label == "GPS time" else label) >= count, label
    assert "A4" in told("pdfinfo", str(paper)).split("Page size:")[1].splitlines()[0]
