"""The report in a browser: no error of its script, every picture drawn, no network, legible in print."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections import Counter
from datetime import timedelta
from pathlib import Path

import polars as pl
import pytest

from railfix.evaluate import EvaluationOptions, RunAndReference, evaluate_runs
from railfix.report import read_runs, report_page, write_report
from railfix.run import RunOptions, run_files
from railfix.simulate.demonstration import demo_inputs, demo_truth
from report_page import Page, browser, opened, run_browser, timing_ms

pytestmark = [
    pytest.mark.requirement("D3"),
    pytest.mark.skipif(browser() is None, reason="no chromium is installed"),
]

#: Goes through every picture: draws it, points at it, enlarges it, shows all again, hides a layer and clicks.
EXERCISE = """
<script>
(function () {
  const said = document.createElement("div");
  said.id = "exercise";
  document.body.append(said);
  let tips = 0, skies = 0, zooms = 0;
  const fire = (canvas, kind, x, y) => {
    const place = canvas.getBoundingClientRect();
    canvas.dispatchEvent(new PointerEvent(kind, { clientX: place.left + x, clientY: place.top + y, button: 0,
      pointerType: "mouse", pointerId: 1, bubbles: true }));
  };
  for (const figure of document.querySelectorAll("figure[data-chart]")) {
    const plot = figure.plot, canvas = figure.querySelector("canvas");
    plot.draw();
    if (figure.classList.contains("skyplot")) {
      const slider = figure.querySelector("input");
      slider.value = slider.max;
      slider.dispatchEvent(new Event("input"));
      continue;
    }
    const layer = plot.chart.layers.filter(l => l.kind === "points" && l.x.length).pop();
    const i = layer ? Math.floor(layer.x.length / 2) : 0;
    const x = layer ? plot.box.px(layer.x[i]) : 200, y = layer ? plot.box.py(layer.y[i]) : 100;
    fire(canvas, "pointermove", x, y);
    if (!figure.querySelector(".tip").hidden) tips++;
    const sky = document.getElementById(figure.dataset.sky || "none");
    const before = sky ? sky.querySelector("output").textContent : "";
    fire(canvas, "pointerdown", x, y);
    fire(canvas, "pointerup", x, y);
    if (sky && sky.querySelector("output").textContent !== before) skies++;
    const whole = plot.box.x.slice();
    const left = plot.box.left + 30, top = plot.box.top + 20;
    fire(canvas, "pointerdown", left, top);
    fire(canvas, "pointermove", left + 80, top + 50);
    fire(canvas, "pointerup", left + 80, top + 50);
    if (plot.box.x[0] > whole[0] && plot.box.x[1] < whole[1]) zooms++;
    canvas.dispatchEvent(new MouseEvent("dblclick"));
    if (plot.box.x[0] !== whole[0]) zooms -= 1000;
    for (const key of ["+", "ArrowRight", "-", "0"]) canvas.dispatchEvent(new KeyboardEvent("keydown", { key }));
    const button = figure.querySelector(".legend button");
    button.click();
    button.click();
  }
  said.dataset.tips = tips;
  said.dataset.skies = skies;
  said.dataset.zooms = zooms;
})();
</script></body>"""

#: Zooms one chart and notes which others follow; takes the CSV of every table.
TOGETHER = """
<script>
(function () {
  const said = document.createElement("div");
  said.id = "together";
  document.body.append(said);
  const start = figure => figure.plot.chart.start || 0;
  const span = figure => figure.plot.box.x.map(v => (v + start(figure)).toFixed(2)).join(" ");
  for (const figure of document.querySelectorAll("figure[data-chart]")) figure.plot.draw();
  const timed = [...document.querySelectorAll('figure[data-zoom="run0-time"]')], first = timed[1].plot;
  const middle = (first.box.x[0] + first.box.x[1]) / 2;
  first.zoom({ x: [middle, middle + 5], y: first.box.y });
  said.dataset.timed = timed.length;
  said.dataset.spans = new Set(timed.map(span)).size;
  first.zoom(null);
  said.dataset.back = timed.filter(figure => figure.plot.view).length;
  // The text is taken where the file is made: to read it back takes a promise, which may come after the page is dumped.
  const texts = [], taken = [], Made = Blob;
  window.Blob = function (parts, options) { texts.push(parts.join("")); return new Made(parts, options); };
  URL.createObjectURL = () => "#";
  HTMLAnchorElement.prototype.click = function () { taken.push(this.download); };
  document.querySelectorAll("button.download").forEach(button => button.click());
  said.dataset.files = taken.join(" ");
  const at = taken.indexOf("figures-of-merit.csv");
  said.dataset.csv = texts[at];
})();
</script></body>"""

#: Shows a page in a frame as wide as a telephone and notes what is wider.
NARROW = """<!DOCTYPE html><html><body>
<iframe id="phone" style="width:390px;height:3000px;border:0" src="PAGE"></iframe><script>
document.getElementById("phone").addEventListener("load", function () {
  const inner = this.contentDocument, said = document.createElement("div");
  inner.querySelectorAll("details").forEach(part => { part.open = true; });
  for (const figure of inner.querySelectorAll("figure[data-chart]")) figure.plot.draw();
  said.id = "narrow";
  said.dataset.window = this.contentWindow.innerWidth;
  said.dataset.page = inner.documentElement.scrollWidth;
  const wide = e => !e.closest(".scroll") && e.getBoundingClientRect().right > 391;
  said.dataset.over = [...inner.querySelectorAll("body *")].filter(wide)
    .map(e => e.tagName + "." + e.className).join(" ");
  said.dataset.errors = inner.getElementById("railfix-errors").textContent;
  document.body.append(said);
});
</script></body></html>"""

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


@pytest.mark.slow
def test_pictures_can_be_pointed_at_enlarged_and_clicked(page: Path, tmp_path: Path) -> None:
    copy = tmp_path / "exercise.html"
    copy.write_text(page.read_text(encoding="utf-8").replace("</body>", EXERCISE), encoding="utf-8")
    read = Page(opened(copy))
    assert read.text.get("railfix-errors", "") == ""
    said = read.by_id("exercise")
    charts = [figure for figure in read.figures if "skyplot" not in figure["class"]]
    linked = [figure for figure in charts if "data-sky" in figure]
    with_points = [figure for figure in charts if figure["data-name"] not in ("error-ranges", "stanford")]
    with_points = [f for f in with_points if f["data-name"] != "interval-distribution"]
    assert int(said["data-tips"]) >= len(with_points) > 20
    assert int(said["data-zooms"]) == len(charts)
    # the first click on each antenna's sky leaves its first epoch, later ones may meet the one that is shown
    assert 2 <= int(said["data-skies"]) <= len(linked)


@pytest.mark.slow
def test_charts_zoom_together_and_tables_can_be_downloaded(page: Path, tmp_path: Path) -> None:
    copy = tmp_path / "together.html"
    copy.write_text(page.read_text(encoding="utf-8").replace("</body>", TOGETHER), encoding="utf-8")
    read = Page(opened(copy))
    assert read.text.get("railfix-errors", "") == ""
    said = read.by_id("together")
    assert int(said["data-timed"]) > 10
    assert (said["data-spans"], said["data-back"]) == ("1", "0")
    assert {"summary.csv", "settings.csv", "inputs.csv", "epochs.csv"} <= set(said["data-files"].split())
    rows = pl.read_csv(said["data-csv"].encode(), infer_schema_length=0)
    assert rows["antenna"].unique(maintain_order=True).to_list()[:2] == ["front", "rear"]
    assert rows["max"].cast(pl.Float64).min() > 0.0


@pytest.mark.slow
def test_nothing_is_wider_than_a_telephone(page: Path) -> None:
    frame = page.with_name("frame.html")
    frame.write_text(NARROW.replace("PAGE", page.name), encoding="utf-8")
    said = Page(run_browser(frame, "--window-size=1000,3000", "--allow-file-access-from-files", "--dump-dom")).by_id(
        "narrow"
    )
    assert (said["data-window"], said["data-page"]) == ("390", "390")
    assert (said["data-over"], said["data-errors"]) == ("", "")


@pytest.mark.slow
def test_a_dark_page_is_dark(page: Path, tmp_path: Path) -> None:
    """The charts follow the preference of the reader, and print stays light."""
    probe = """<script>
    const said = document.createElement("div"), figure = document.querySelector("figure[data-chart]");
    figure.plot.draw();
    said.id = "dark";
    said.dataset.chart = figure.querySelector("canvas").getContext("2d").getImageData(2, 2, 1, 1).data.join(" ");
    said.dataset.page = getComputedStyle(document.body).backgroundColor;
    document.body.append(said);</script></body>"""
    copy = tmp_path / "dark.html"
    copy.write_text(page.read_text(encoding="utf-8").replace("</body>", probe), encoding="utf-8")
    seen = {
        name: Page(run_browser(copy, "--window-size=1280,900", "--dump-dom", *options)).by_id("dark")
        for name, options in (("light", ()), ("dark", ("--blink-settings=preferredColorScheme=0",)))
    }
    assert (seen["light"]["data-chart"], seen["light"]["data-page"]) == ("255 255 255 255", "rgb(255, 255, 255)")
    assert (seen["dark"]["data-chart"], seen["dark"]["data-page"]) == ("20 24 28 255", "rgb(20, 24, 28)")


@pytest.mark.slow
def test_tables_fit_a_window_of_1300_pixels(tmp_path: Path) -> None:
    """With limits of confidence, and the names of demo and antennas; nothing has to be scrolled sideways."""
    out = tmp_path / "run"
    run_files(demo_inputs(), out=out)
    runs, _ = read_runs([out])
    with_limits = EvaluationOptions(block_s=20.0)
    evaluation = evaluate_runs([RunAndReference(run=out, reference=demo_truth())], options=with_limits)
    document = report_page(runs, evaluation)
    assert "Limits of 95 % confidence, from blocks of 20 s" in document
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
    for words in ("Figures of merit", "Settings asked for and used", "min_satellites", "SHA-256", "rear antenna"):
        assert words in text
    # what is written along the axes of the pictures is text on paper too: every one is there
    read = Page(page.read_text(encoding="utf-8"))
    charts = [json.loads(read.text[f["data-chart"]]) for f in read.figures if "skyplot" not in f["class"]]
    labels = Counter(values["x_label"] for values in charts)
    assert labels["GPS time"] > 10
    for label, count in labels.items():
        assert text.count(f"{label}, 2024-03-05" if label == "GPS time" else label) >= count, label
    assert "A4" in told("pdfinfo", str(paper)).split("Page size:")[1].splitlines()[0]
