"""Every page in a browser: no serious fault of accessibility, no overflow, print; the time of a click."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from conftest import ROOT
from long_run import long_run
from network_made import made_network
from railfix.cli import app
from railfix.ground.demo import run_demo
from railfix.pipeline.config import Config
from railfix.report import write_report
from railfix.report.campaign import report_campaign, write_campaign_page
from railfix.report.charts_page import write_network_page
from railfix.report.explain import explain_epoch, write_explanation
from railfix.run import RunOptions, run_files
from railfix.simulate.demonstration import demo_inputs, demo_truth
from railfix.track.network_read import check_network
from report_page import browser
from test_campaign_page import campaign

pytestmark = [
    pytest.mark.requirement("D3"),
    pytest.mark.slow,
    pytest.mark.skipif(browser() is None, reason="no chromium is installed"),
]
PAGES = ("report", "runs", "explain", "campaign", "network", "service", "centre", "site")
#: Grades of a fault of accessibility, by axe, that no page may have.
GRAVE = ("serious", "critical")


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A file of each kind of page."""
    folder = tmp_path_factory.mktemp("pages")
    out = {name: folder / f"{name}.html" for name in PAGES}
    run_files(demo_inputs(), out=folder / "run", options=RunOptions(observations="write"))
    run_files(demo_inputs(), Config(filter="off"), out=folder / "unfiltered")
    write_report([folder / "run"], out["report"], references=[demo_truth()])
    write_report([folder / "run", folder / "unfiltered"], out["runs"], references=[demo_truth()])
    write_explanation(explain_epoch(folder / "run", "03:12:30"), out["explain"])
    write_campaign_page(report_campaign(campaign(folder, judged=True), folder), out["campaign"], title="runs")
    net = made_network(10.0)
    write_network_page(net, check_network(net), out["network"])
    served = CliRunner().invoke(app, ["map", "service", str(folder / "run"), "--page", str(out["service"])])
    assert served.exit_code == 0, served.output
    out["centre"].write_text(asyncio.run(centre_page()), encoding="utf-8")
    out["site"] = site(folder)
    return out


async def centre_page() -> str:
    """Page of the centre at the end of the demonstration of the ground side."""
    pages: list[str] = []

    async def keep(url: str) -> None:
        pages.append(await asyncio.to_thread(lambda: urllib.request.urlopen(url).read().decode()))

    await run_demo(speed=25.0, password="secret", keep=keep)
    return pages[0]


def site(folder: Path) -> Path:
    """Home page of the documentation, without the pages of the interface and the gallery's results."""
    pytest.importorskip("pydata_sphinx_theme")
    plain = ["-D", "extensions=myst_parser,sphinx_design,sphinx.ext.autodoc"]
    plain += ["-D", "exclude_patterns=_templates,gallery,api*,auto_examples"]
    command = [sys.executable, "-m", "sphinx", "-b", "html", "-q", *plain, "-d", str(folder / "trees")]
    subprocess.run([*command, str(ROOT / "docs"), str(folder / "site")], capture_output=True, check=True)
    return folder / "site" / "index.html"


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """The browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        opened = started.chromium.launch(executable_path=browser(), args=["--no-sandbox"])
        yield opened
        opened.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1400, 390])
@pytest.mark.parametrize("name", PAGES)
def test_pages_can_be_read_by_everyone_at_every_width(
    pages: dict[str, Path], chromium: Any, name: str, width: int, scheme: str
) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe is not installed")
    context = chromium.new_context(viewport={"width": width, "height": 850}, color_scheme=scheme, bypass_csp=True)
    shown, errors = context.new_page(), list[str]()
    shown.on("pageerror", lambda error: errors.append(str(error)))
    shown.set_default_timeout(180_000)  # a busy machine
    shown.goto(pages[name].resolve().as_uri())
    shown.evaluate("() => document.querySelectorAll('details').forEach(part => { part.open = true; })")
    found = axe.Axe().run(shown, options={"resultTypes": ["violations"]}).response["violations"]
    assert [fault["id"] for fault in found if fault["impact"] in GRAVE] == []
    assert shown.evaluate("document.documentElement.scrollWidth") == width
    assert errors == []
    assert width == 390 or shown.pdf().startswith(b"%PDF")
    context.close()


def test_a_fault_of_accessibility_would_be_found(pages: dict[str, Path], chromium: Any) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe is not installed")
    context = chromium.new_context(bypass_csp=True)
    shown = context.new_page()
    shown.goto(pages["explain"].resolve().as_uri())
    shown.evaluate("() => document.querySelector('h1').style.color = '#eee'")
    found = axe.Axe().run(shown).response["violations"]
    assert "color-contrast" in [fault["id"] for fault in found if fault["impact"] in GRAVE]
    context.close()


#: Notes the time from the end of each click and from each key until the window has drawn the panel [ms].
WATCH = """() => { window.times = []; window.said = []; const watch = async event => { const began = event.timeStamp;
    await new Promise(done => requestAnimationFrame(() => setTimeout(done)));
    times.push(performance.now() - began); said.push(document.querySelector(".skyplot.docked output").textContent); };
    addEventListener("mouseup", watch, true); addEventListener("keydown", watch, true); }"""
#: Pixel of a point of the filter, by its fraction of the points of the chart.
POINT = """(div, share) => { const p = div.parentNode.plot, r = div.getBoundingClientRect(), a = div._fullLayout,
    l = p.chart.layers.find(l => l.label === "filter along the track"), i = Math.floor(share * l.x.length),
    t = p.traces()[p.layers.indexOf(l)];
    return [r.left + a.margin.l + a.xaxis.c2p(t.x[i]), r.top + a.margin.t + a.yaxis.c2p(t.y[i])]; }"""


def test_a_click_answers_within_100_ms_on_an_hour_at_10_hz(tmp_path: Path, chromium: Any) -> None:
    run, truth = long_run(tmp_path, 36_000)
    page = write_report([run], tmp_path / "hour.html", references=[truth])
    shown = chromium.new_page(viewport={"width": 1400, "height": 900})
    shown.set_default_timeout(180_000)
    shown.goto(page.resolve().as_uri())
    shown.wait_for_timeout(3_000)  # the first charts are drawn
    shown.evaluate(WATCH)
    chart = shown.locator("figure[data-name=error-chainage] .plot").first
    for k in range(20):
        shown.mouse.click(*chart.evaluate(POINT, (k + 0.5) / 20))
        shown.wait_for_timeout(3_000 if k == 0 else 700)  # the charts have made room for the panel; no double click
    chart.focus()
    for _ in range(20):
        shown.keyboard.press("ArrowRight")
        shown.wait_for_timeout(100)
    times, said, load = shown.evaluate("[times, said, +document.getElementById('railfix-timing').dataset.load]")
    kinds = {"first click": times[:1], "clicks": times[1:20], "keys": times[20:]}
    found = {name: (round(float(np.median(t)), 1), round(max(t), 1)) for name, t in kinds.items()}
    print(json.dumps({"MB": round(page.stat().st_size / 1e6, 2), "load ms": load, "median and largest ms": found}))
    assert len(set(said)) > 15, "clicks and keys choose other epochs"
    assert times[0] < max(100.0, 3.0 * np.median(times[1:20])), "a busy machine slows all of them"
    assert np.median(times[1:20]) < 100.0
    assert np.median(times[20:]) < 100.0
    shown.close()
