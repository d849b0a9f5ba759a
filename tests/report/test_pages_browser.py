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
    plain = [
        "-D",
        "extensions=myst_parser,sphinx_design,sphinx.ext.autodoc",
        "-D",
        "exclude_patterns=_templates,gallery,api*,auto_examples",
    ]
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


@pytest.mark.parametrize("name", PAGES)
def test_pages_print(pages: dict[str, Path], chromium: Any, name: str) -> None:
    shown = chromium.new_page()
    shown.goto(pages[name].resolve().as_uri())
    assert shown.pdf().startswith(b"%PDF")
    shown.close()


#: The first choice of an epoch, then clicks on the button for the next one: time until the window has drawn each [ms].
DRAWN = "await new Promise(done => requestAnimationFrame(() => setTimeout(done)));"
FIRST = f"""async plot => {{ const began = performance.now();
    plot.dispatchEvent(new KeyboardEvent("keydown", {{ key: "Enter", bubbles: true }}));
    {DRAWN}
    return performance.now() - began; }}"""
CLICKS = f"""async () => {{ const times = [], button = document.querySelector(".skyplot.docked .after");
    for (let k = 0; k < 20; k++) {{ const began = performance.now(); button.click();
        {DRAWN}
        times.push(performance.now() - began); }}
    return times; }}"""


def test_a_click_answers_within_100_ms_on_an_hour_at_10_hz(tmp_path: Path, chromium: Any) -> None:
    run, truth = long_run(tmp_path, 36_000)
    page = write_report([run], tmp_path / "hour.html", references=[truth])
    shown = chromium.new_page(viewport={"width": 1400, "height": 900})
    shown.set_default_timeout(180_000)
    shown.goto(page.resolve().as_uri())
    shown.wait_for_timeout(3_000)  # the first charts are drawn
    first = shown.locator("figure[data-name=error-chainage] .plot").first.evaluate(FIRST)
    shown.locator(".skyplot.docked").wait_for(state="visible")
    shown.wait_for_timeout(3_000)  # the charts have made room for the panel
    times = shown.evaluate(CLICKS)
    print(json.dumps({"first ms": round(first, 1), "click ms": [round(t, 1) for t in times]}))
    assert np.median(times) < 100.0
    assert first < max(100.0, 3.0 * np.median(times)), "a busy machine slows all of them"
    shown.close()
