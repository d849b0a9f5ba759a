"""A page in a browser without a screen: what it becomes, how long it takes, what it prints."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from html.parser import HTMLParser
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from plotly.offline import get_plotlyjs

if TYPE_CHECKING:
    from playwright.sync_api import Page as BrowserPage

#: Elements without an end.
_VOID: Final = ("meta", "input", "br", "img", "link", "hr")
BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome")
#: Nothing is fetched, nothing of the user's own is read, and no name is resolved.
_OPTIONS: Final = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --hide-scrollbars --no-pdf-header-footer"
).split()


def browser() -> str | None:
    """Path of a browser, None where there is none."""
    return next((found for name in BROWSERS if (found := shutil.which(name))), None)


def run_browser(page: Path, *options: str, timeout_s: float = 180.0) -> str:
    """What the browser writes to its standard output."""
    program = browser()
    assert program is not None
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as home:
        command = [program, *_OPTIONS, "--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={home}", *options]
        done = subprocess.run(
            [*command, page.resolve().as_uri()],
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
            env={**os.environ, "HOME": home},
        )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@contextmanager
def visited(page: Path, **options: Any) -> Iterator[BrowserPage]:
    """A page in a window of the browser, for real clicks and keys; `options` are those of a page of Playwright.

    An error of a script of the page fails the test.
    """
    from playwright.sync_api import sync_playwright

    errors: list[str] = []
    with sync_playwright() as started:
        window = started.chromium.launch(executable_path=browser(), args=["--no-sandbox"])
        shown = window.new_page(**options)
        shown.on("pageerror", lambda error: errors.append(str(error)))
        shown.set_default_timeout(180_000)  # a busy machine
        shown.goto(page.resolve().as_uri())
        shown.wait_for_function("document.getElementById('railfix-timing').dataset.load !== undefined")
        yield shown
        errors.append(shown.inner_text("#railfix-errors"))
        window.close()
    assert [error for error in errors if error] == []


def opened(page: Path, *, height: int = 1000) -> str:
    """The page's document after it was loaded in a window of that height."""
    return run_browser(page, f"--window-size=1250,{height}", "--dump-dom")


class Page(HTMLParser):
    """Elements of a document: tag, attributes, and the text inside each."""

    def __init__(self, document: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.text: dict[str, str] = {}
        self._in: list[str] = []
        self.feed(document.replace(get_plotlyjs(), ""))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note the element."""
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in _VOID:
            self._in.append(dict(attrs).get("id") or "")

    def handle_endtag(self, tag: str) -> None:
        """Leave it."""
        if self._in and tag not in _VOID:
            self._in.pop()

    def handle_data(self, data: str) -> None:
        """Keep the text of elements with an id."""
        if self._in and self._in[-1]:
            self.text[self._in[-1]] = self.text.get(self._in[-1], "") + data

    def by_id(self, name: str) -> dict[str, str]:
        """Attributes of one element."""
        return next(found for _, found in self.elements if found.get("id") == name)

    @property
    def figures(self) -> list[dict[str, str]]:
        """Attributes of the pictures."""
        return [found for tag, found in self.elements if tag == "figure"]


def timing_ms(document: str) -> dict[str, float]:
    """When the page was loaded, and when the first pictures were drawn, since it was asked for [ms]."""
    found: dict[str, Any] = Page(document).by_id("railfix-timing")
    return {key.removeprefix("data-"): float(value) for key, value in found.items() if key.startswith("data-")}


def fetched(document: str) -> list[str]:
    """Addresses that a document would fetch something from; links in the library of the charts are not followed."""
    document = document.replace(get_plotlyjs(), "")
    wanted = re.findall(r"""(?:src|href|action|data|poster)\s*=\s*["']?([^"'\s>]+)""", document)
    wanted += re.findall(r"""url\(\s*["']?([^"')]+)""", document)
    wanted += re.findall(r"""@import\s+["']([^"']+)""", document)
    return [address for address in wanted if re.match(r"(?:[a-z]+:)?//|https?:|ftp:|wss?:", address)]
