"""Demonstration of the ground side, and its page in a browser."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import socket
import ssl
import subprocess
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from starlette.applications import Starlette
from starlette.responses import HTMLResponse, StreamingResponse
from starlette.routing import Route

from railfix.ground import web
from railfix.ground.demo import FAULT_S, run_demo
from railfix.ground.keys import write_keys
from railfix.ground.web import MOST_WRONG, SESSION_S, PageServer, Sessions, page_app
from report_page import _OPTIONS, Page, browser, fetched

if TYPE_CHECKING:
    from playwright.sync_api import Page as BrowserPage

pytestmark = [pytest.mark.requirement(row) for row in ("F1", "F2", "F3", "F4", "F5")]
needs_browser = pytest.mark.skipif(browser() is None, reason="no chromium is installed")


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], dict[str, Any]]:
    """Figures of the demonstration, and the last state of its page."""
    states: list[dict[str, Any]] = []

    async def keep(url: str) -> None:
        text = await asyncio.to_thread(lambda: urllib.request.urlopen(url + "state").read())
        states.append(json.loads(text))

    picture = tmp_path_factory.mktemp("demo") / "coverage.png"
    work = run_demo(speed=25.0, password="secret", keep=keep, picture=picture)
    figures = asyncio.run(asyncio.wait_for(work, 300.0))  # a busy machine
    assert picture.stat().st_size > 10_000
    return figures, states[0]


def test_the_story_of_the_demonstration(demo: tuple[dict[str, Any], dict[str, Any]]) -> None:
    figures, state = demo
    assert figures["invariants broken"] == {}
    assert figures["routes set"] == 4
    assert figures["cause"] == "satellites_or_jamming"
    assert 0.0 < figures["suspended and stop ordered [s]"] - FAULT_S <= 6.0
    assert figures["both trains at rest [s]"] > figures["suspended and stop ordered [s]"] + 10.0  # they were running
    assert 0.7 * figures["reports sent"] < figures["reports used"] <= figures["reports sent"]
    assert figures["times that a position was simulated"] >= 1
    assert state["monitor"]["stopped"]
    log = state["log"]
    order = [k for k, line in enumerate(log) if line.endswith(("suspend satellite positioning", "triangle: stop"))]
    assert [log[k].split(": ")[-1] for k in order] == ["stop", "suspend satellite positioning"]  # newest first
    assert any("reports again" in line for line in log)


@contextmanager
def served(app: Starlette, certificate: tuple[Path, Path] | None = None) -> Iterator[str]:
    """Address of an application that is served in a thread."""
    started, end, urls = threading.Event(), threading.Event(), []

    async def work() -> None:
        server = PageServer(app, certificate=certificate)
        await server.start()
        urls.append(server.url)
        started.set()
        while not end.is_set():
            await asyncio.sleep(0.02)
        await server.stop()

    thread = threading.Thread(target=lambda: asyncio.run(work()))
    thread.start()
    assert started.wait(10.0)
    try:
        yield urls[0]
    finally:
        end.set()
        thread.join(10.0)


def browse(url: str, *options: str) -> str:
    program = browser()
    assert program is not None
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as home:
        rules = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"
        command = [program, *_OPTIONS, rules, f"--user-data-dir={home}", *options, url]
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=60.0, check=False, env={**os.environ, "HOME": home}
        )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@contextmanager
def window() -> Iterator[BrowserPage]:
    """A page in a window of the browser, for clicks, keys and its clock."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        opened = started.chromium.launch(executable_path=browser(), args=["--no-sandbox"])
        shown = opened.new_page()
        shown.set_default_timeout(60_000)  # a busy machine
        yield shown
        opened.close()


@needs_browser
def test_the_page_shows_trains_intervals_links_and_the_stop(
    demo: tuple[dict[str, Any], dict[str, Any]], tmp_path: Path
) -> None:
    _, state = demo
    hostile = {**state, "log": ["</script><b id='hostile'>x</b>", *state["log"]]}
    shown = [hostile]
    with served(page_app(lambda: shown[0], {}, sessions=Sessions(password="secret"))) as url:
        document = browse(url, "--window-size=1250,1200", "--dump-dom")
        shown[0] = state
        picture = Path(os.environ.get("RAILFIX_SCREENSHOTS", tmp_path)) / "ground.png"
        browse(url, "--window-size=1100,1150", f"--screenshot={picture}")
    page = Page(document)
    assert page.text.get("railfix-errors", "") == ""
    assert "STOP: satellites or jamming" in page.text["alarm"]
    classes = [found.get("class") for _, found in page.elements]
    assert classes.count("train") == 2
    assert classes.count("occupied") >= 2
    assert "hostile" not in [found.get("id") for _, found in page.elements]
    assert document.count("<li>") == len(hostile["log"])
    assert fetched(document) == []
    assert picture.stat().st_size > 10_000


PHONE = """<!DOCTYPE html><iframe id="phone" style="width:390px;height:3000px;border:0" src="/"></iframe><script>
document.getElementById("phone").addEventListener("load", function () {
  const inner = this.contentDocument, note = document.createElement("div");
  note.id = "narrow";
  note.dataset.page = inner.documentElement.scrollWidth;
  const wide = e => !e.closest(".scroll") && e.getBoundingClientRect().right > 391;
  note.dataset.over = [...inner.querySelectorAll("body *")].filter(wide).map(e => e.tagName + e.id).join(" ");
  note.dataset.errors = inner.getElementById("railfix-errors").textContent;
  document.body.append(note);
});</script>"""


@pytest.mark.slow
@needs_browser
def test_nothing_is_wider_than_a_telephone(demo: tuple[dict[str, Any], dict[str, Any]]) -> None:
    app = page_app(lambda: demo[1], {}, sessions=Sessions(password="secret"))
    app.router.routes.append(Route("/phone", lambda _: HTMLResponse(PHONE)))
    with served(app) as url:
        note = Page(browse(url + "phone", "--window-size=1000,3000", "--dump-dom")).by_id("narrow")
    assert (note["data-page"], note["data-over"], note["data-errors"]) == ("390", "", "")


@needs_browser
def test_the_page_connects_again_and_shows_newer_states(demo: tuple[dict[str, Any], dict[str, Any]]) -> None:
    """Each connection ends after one event; the third says that the run is done."""
    states = [{**demo[1], "done": False, "now": 1000.0 + k} for k in range(3)]
    states[2]["done"] = True
    connections: list[int] = []

    def events(_: Any) -> StreamingResponse:
        k = min(len(connections), 2)
        connections.append(k)
        return StreamingResponse(
            iter([f"retry: 50\ndata: {json.dumps(states[k])}\n\n"]), media_type="text/event-stream"
        )

    app = page_app(lambda: states[0], {}, sessions=Sessions(password="secret"))
    app.router.routes[:] = [route for route in app.router.routes if getattr(route, "path", "") != "/events"]
    app.router.routes.append(Route("/events", events))
    with served(app) as url:
        page = Page(browse(url, "--virtual-time-budget=20000", "--dump-dom"))
    assert connections == [0, 1, 2]
    assert "Time 1002 s." in page.text["clock"]
    assert page.text.get("railfix-errors", "") == ""


class Browser:
    """Requests to a page, with the cookie it has set."""

    def __init__(self, url: str) -> None:
        self.url, self.cookie = url, ""

    def post(self, address: str, values: object = None, *, kind: str = "application/json") -> tuple[int, str | None]:
        data = json.dumps({} if values is None else values).encode()
        headers = {"Content-Type": kind, "Cookie": self.cookie}
        request = urllib.request.Request(self.url + address, data=data, headers=headers, method="POST")
        try:
            answer = urllib.request.urlopen(request)
        except urllib.error.HTTPError as error:
            answer = error
        with answer:
            cookie = answer.headers.get("Set-Cookie")
            if cookie is not None:
                assert {"HttpOnly", "SameSite=strict"} <= set(cookie.split("; "))
                self.cookie = cookie.split(";")[0]
            return answer.status, json.load(answer)["refused"]


def test_orders_need_a_log_in(demo: tuple[dict[str, Any], dict[str, Any]]) -> None:
    answers, asked = iter(["fixes are healthy for 3 s; a release requires 300 s", None]), []

    def release(_: dict[str, Any], by: str) -> str | None:
        asked.append(f"release by {by}")
        return next(answers)

    def route(values: dict[str, Any], by: str) -> str | None:
        asked.append(f"route {values.get('train')} by {by}")
        return None

    orders, now = {"release": release, "route": route}, [0.0]
    sessions = Sessions(password="secret", clock=lambda: now[0])
    with served(page_app(lambda: demo[1], orders, sessions=sessions)) as url:
        desk, stranger = Browser(url), Browser(url)
        for address in ("orders/release", "orders/route"):
            assert desk.post(address, {"train": 1}) == (403, "log in first")
        for wrong in ("wrong", "", None, 5, "\ud800"):
            assert desk.post("login", {"password": wrong})[0] == 403
        assert desk.post("login", {"password": "secret"}, kind="text/plain")[0] == 403  # as a foreign page would
        assert desk.post("orders/route", {"train": 1})[0] == 403
        assert asked == []
        assert desk.post("login", {"password": "secret"}) == (200, None)
        assert desk.post("orders/release") == (409, "fixes are healthy for 3 s; a release requires 300 s")
        assert desk.post("orders/release") == (200, None)
        assert desk.post("orders/route", {"train": 2}) == (200, None)
        assert desk.post("orders/route", {"train": 2}, kind="text/plain")[0] == 400
        assert desk.post("orders/route", {"train": "2" * 2000})[0] == 400
        assert desk.post("orders/points", {"train": 2})[0] == 404
        assert asked == ["release by operator", "release by operator", "route 2 by operator"]
        stranger.cookie = "railfix-session=guessed"
        assert stranger.post("orders/route", {"train": 2})[0] == 403
        now[0] += SESSION_S + 1.0
        assert desk.post("orders/route", {"train": 2})[0] == 403  # ended by itself
        for _ in range(MOST_WRONG):
            stranger.post("login", {"password": "wrong"})
        assert desk.post("login", {"password": "secret"})[0] == 403  # too many wrong ones
        now[0] += 61.0
        assert desk.post("login", {"password": "secret"})[0] == 200
        assert desk.post("logout") == (200, None)
        assert desk.post("orders/route", {"train": 2})[0] == 403


def test_wrong_passwords_lock_out_their_address_alone() -> None:
    sessions = Sessions(password="secret", clock=lambda: 0.0)
    for _ in range(MOST_WRONG):
        assert sessions.log_in("wrong", "10.0.0.9") is None
    assert sessions.log_in("secret", "10.0.0.9") is None
    assert sessions.log_in("secret", "10.0.0.1") is not None


def test_a_request_that_does_not_end_is_ended(
    demo: tuple[dict[str, Any], dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Heads and bodies that come byte by byte; what follows a whole request may wait no longer."""
    monkeypatch.setattr(web, "REQUEST_S", 0.3)
    app = page_app(lambda: demo[1], {}, sessions=Sessions(password="secret"))
    begun = b"POST /login HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: 9\r\n\r\n"
    with served(app) as url:
        host, port = url.split("/")[2].split(":")
        for text in (b"", b"GET / HT", begun, b"GET /state HTTP/1.1\r\nHost: x\r\n\r\nGET"):
            with socket.create_connection((host, int(port)), timeout=5.0) as connection:
                connection.sendall(text)
                answer, begin = b"", time.monotonic()
                while time.monotonic() - begin < 5.0:
                    try:
                        if text not in (b"", begun):
                            connection.sendall(b"x")
                        part = connection.recv(65_536)
                    except (ConnectionError, TimeoutError):
                        break
                    if not part:
                        break
                    answer += part
                assert time.monotonic() - begin < 2.0, text
                assert answer.startswith(b"HTTP/1.1 ") or text in (b"", b"GET / HT")
                assert text != begun or answer.startswith(b"HTTP/1.1 403")


def test_many_half_open_connections_lock_nobody_out() -> None:
    """550 connections that say nothing, of the operator's own address: each of 20 orders is answered."""
    given: list[Any] = []
    app = page_app(lambda: {"done": False}, {"stop": lambda values, by: given.append((values, by))}, sessions=Sessions(
        password="secret", others={"anna": "word"}))  # fmt: skip
    with served(app) as url:
        host, port = url.split("/")[2].split(":")
        browser = Browser(url)
        open_ = [socket.create_connection((host, int(port))) for _ in range(300)]
        assert browser.post("login", {"name": "anna", "password": "word"}) == (200, None)
        for k in range(20):
            open_ += [socket.create_connection((host, int(port))) for _ in range(12)]
            assert browser.post("orders/stop", {"train": k}) == (200, None)
        for connection in open_:
            connection.close()
    assert given == [({"train": k}, "anna") for k in range(20)]


@needs_browser
def test_a_page_without_news_says_within_two_seconds_that_it_is_old(
    demo: tuple[dict[str, Any], dict[str, Any]],
) -> None:
    """The events stop after the first; the centre's loop may hang, or the network. The clock is the page's own."""
    state = {**demo[1], "done": False}

    async def silent() -> AsyncIterator[str]:
        yield f"data: {json.dumps(state)}\n\n"
        await asyncio.sleep(30.0)

    app = page_app(lambda: state, {}, sessions=Sessions(password="secret"))
    app.router.routes[:] = [route for route in app.router.routes if getattr(route, "path", "") != "/events"]
    app.router.routes.append(Route("/events", lambda _: StreamingResponse(silent(), media_type="text/event-stream")))
    with served(app) as url, window() as page:
        page.clock.install(time=0)
        page.clock.pause_at(1000)
        page.goto(url)
        page.wait_for_selector("body[data-shown='2']")  # as it was delivered, and the event
        page.clock.run_for(1400)
        assert not page.is_visible("#stale")
        page.clock.run_for(600)
        assert page.inner_text("#stale").startswith("OUT OF DATE: no data from the centre for 2 s.")
        assert page.get_attribute("body", "class") == "stale"


def test_beyond_loopback_addresses_the_page_is_served_by_tls(
    demo: tuple[dict[str, Any], dict[str, Any]], tmp_path: Path
) -> None:
    write_keys(tmp_path, [1])
    app = page_app(lambda: demo[1], {}, sessions=Sessions(password="secret"))
    context = ssl.create_default_context(cafile=tmp_path / "authority.pem")
    context.check_hostname = False  # the certificate names "centre"
    with served(app, (tmp_path / "centre.pem", tmp_path / "centre.key")) as url:
        assert url.startswith("https://")
        data, headers = json.dumps({"password": "secret"}).encode(), {"Content-Type": "application/json"}
        request = urllib.request.Request(url + "login", data=data, headers=headers, method="POST")
        with urllib.request.urlopen(request, context=context) as answer:
            assert "Secure" in answer.headers["Set-Cookie"].split("; ")
        with pytest.raises(urllib.error.URLError, match="CERTIFICATE_VERIFY_FAILED"):
            urllib.request.urlopen(url)


@needs_browser
def test_orders_in_a_browser(demo: tuple[dict[str, Any], dict[str, Any]]) -> None:
    asked = []

    def route(values: dict[str, Any], by: str) -> str | None:
        asked.append((values, by))
        return "train 1 comes from the opposite direction"

    orders = {"route": route, "release": lambda _, by: None if by == "operator" else f"given by {by}"}
    app = page_app(lambda: demo[1], orders, sessions=Sessions(password="secret"))
    with served(app) as url, window() as page:
        page.goto(url)

        def press(form: str) -> str:
            page.evaluate("document.getElementById('answer').textContent = ''")
            page.click(f"#{form} button >> nth=0")
            return page.wait_for_selector("#answer:not(:empty)").inner_text()

        assert not page.is_visible("#desk")
        page.fill("#password", "wrong")
        assert press("login").startswith("wrong password")
        assert not page.is_visible("#desk")
        page.fill("#password", "secret")
        assert press("login") == "done"
        page.wait_for_selector("#desk", state="visible")
        page.select_option("#train", "2")
        assert press("route") == "train 1 comes from the opposite direction"
        assert press("release") == "done"
        press("logout")
        page.wait_for_selector("#desk", state="hidden")
        assert page.text_content("#railfix-errors") == ""
    assert asked == [({"train": 2}, "operator")]


@pytest.mark.slow
@needs_browser
def test_the_page_on_paper(demo: tuple[dict[str, Any], dict[str, Any]], tmp_path: Path) -> None:
    """At most two pages of A4, with the picture, all tables and the log, without the desk for orders."""
    paper = tmp_path / "page.pdf"
    with served(page_app(lambda: demo[1], {}, sessions=Sessions(password="secret"))) as url:
        browse(url, f"--print-to-pdf={paper}", "--no-pdf-header-footer")
    data = paper.read_bytes()
    assert 1 <= data.count(b"/Type /Page\n") <= 2
    assert len(data) < 1_000_000
    if program := shutil.which("pdftotext"):
        text = subprocess.run([program, paper, "-"], capture_output=True, text=True, check=True).stdout
        for word in ("STOP: satellites or jamming", "Trains", "Links", "Points", "Log", "reports again"):
            assert word in text
        assert "Log in" not in text
