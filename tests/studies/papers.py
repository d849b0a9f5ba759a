"""Table of the items of the five papers, and where they are read differently.

``python tests/studies/papers.py`` writes docs/papers.md from ``tests/references/papers.toml`` and the kept outputs of
the studies; a test holds that it is up to date, that what each item names exists, and that its test does.
"""

from __future__ import annotations

import importlib
import re
import sys
import tomllib
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

from typer import Context
from typer.main import get_group

import paths
from p1_page import SINGLE, figures
from railfix.cli import app

TABLE: Final = paths.ROOT / "docs" / "papers.md"
CHAPTER: Final = re.compile(r"^[\d.()]+(, [\d.()]+)*(?= )|^[\d.]+(?=, table)")
DATA: Final[dict[str, Any]] = tomllib.loads(
    (paths.ROOT / "tests" / "references" / "papers.toml").read_text(encoding="utf-8")
)


def named(where: str) -> object:
    """The module, function or class of a dotted name; AttributeError or ImportError where there is none."""
    module, rest = where, ""
    while module:
        try:
            found: object = importlib.import_module(module)
        except ModuleNotFoundError:
            module, _, last = module.rpartition(".")
            rest = f"{last}.{rest}" if rest else last
            continue
        for name in filter(None, rest.split(".")):
            found = getattr(found, name)
        return found
    raise ImportError(where)


PROGRAM: Final = get_group(app)


@cache
def tests() -> frozenset[str]:
    """All tests as file::function."""
    found = set()
    for path in (paths.ROOT / "tests").rglob("test_*.py"):
        found |= {f"{path.name}::{name}" for name in re.findall(r"def (test_\w+)", path.read_text(encoding="utf-8"))}
    return frozenset(found)


def problems() -> list[str]:
    """What the data name and is not there."""
    wrong = []
    for item in DATA["item"]:
        try:
            named(item["where"])
        except (ImportError, AttributeError):
            wrong.append(f"{item['what']}: there is no {item['where']}")
        for command in re.findall(r"railfix ([\w-]+)", item["by"]):
            if command not in PROGRAM.list_commands(Context(PROGRAM)):
                wrong.append(f"{item['what']}: there is no command {command}")
        if "test" in item and item["test"] not in tests():
            wrong.append(f"{item['what']}: there is no test {item['test']}")
    return wrong


def document() -> str:
    """The document as Markdown."""
    lines = [
        "# The five papers, item by item",
        "",
        "Each entry of this page is an item of a paper, with the number of its chapter. *Paper* is the value or the",
        "rule in the paper, and *railfix* is the result of railfix. *Provided by* is a railfix command, Python alone,",
        "or a study in `tests/studies`; the function is in brackets. An item without a test is open.",
        "`python tests/studies/papers.py` writes this page from `tests/references/papers.toml`.",
    ]
    for paper, title in DATA["papers"].items():
        lines += ["", f"## {paper}: {title}", ""]
        for item in (item for item in DATA["item"] if item["paper"] == paper):
            lines.append("- " + CHAPTER.sub(r"**\g<0>**", item["what"]))
            values = {"Paper": item.get("asked"), "railfix": reached(item)}
            lines += [f"  - {name}: {value}" for name, value in values.items() if value]
            lines.append(f"  - Provided by: {item['by']} (`{item['where']}`)")
            lines.append(f"  - Test: `{item['test']}`" if "test" in item else "  - Test: **open**")
    lines += ["", "## Where we read the papers differently", ""]
    for found in DATA["difference"]:
        why = [f"  - Reason: {found['why']}"] if found["why"] else []
        lines += [f"- **{found['paper']}**", f"  - Paper: {found['says']}", f"  - railfix: {found['here']}", *why]
    return "\n".join(lines) + "\n"


def reached(item: dict[str, Any]) -> str:
    """Figure reached; one that begins with @ is taken from a kept output."""
    text: str = item.get("reached", "")
    return FIGURES[text]() if text.startswith("@") else text


def _largest() -> str:
    cells = [f"{figures('corrected', 'all data', f'G       {name}, SBAS')[8]} m ({name})" for name in SINGLE]
    galileo = figures("commercial", "ways without tunnels", "G+J+E   p1 ")[8]
    filtered = [figures("filtered", "ways without tunnels", f"{systems:7s} filter ")[8] for systems in ("G+J", "G+J+E")]
    return (
        f"{', '.join(cells)}; without tunnels, {galileo} m for `p1` with Galileo, and {filtered[0]} m (G+J) and "
        f"{filtered[1]} m (G+J+E) for the filter along the track"
    )


def _rate() -> str:
    rows = {name: figures("corrected", "ways without tunnels", f"G       {name}, SBAS") for name in SINGLE}
    return ", ".join(f"{row[0]} % ({name})" for name, row in rows.items())


def _table_4(*names: str) -> str:
    rows = [figures("test-line", "table 4", f"{name} ") for name in names]
    rates, errors = (" and ".join(row[0] for row in rows), " and ".join(f"{row[1]} / {row[2]} m" for row in rows))
    return f"rate {rates} %; mean / standard deviation {errors}"


def _figure_7() -> str:
    cells = figures("test-line", "figure 7", "all ")
    return f"the mean error is {cells[6]} m; it is {cells[0]} m for conventional positions and {cells[3]} m for RTKLIB"


def _seeds() -> str:
    under = {way: figures("seeds", "lines", f"G+J    {way} ")[-3:] for way in ("strict", "RTKLIB")}
    strict, rtklib = " ".join(under["strict"]), under["RTKLIB"][0]
    return f"with `strict` (G+J), {strict} lines have no error over 10 m; with RTKLIB, {rtklib} lines"


def _p4() -> str:
    text = (paths.ROOT / "tests" / "references" / "results" / "p4-experiment.txt").read_text(encoding="utf-8")
    cells = next(line for line in text.splitlines() if line.startswith("ESBC, GPS       0.0")).split()
    return f"the p95 is {cells[9]} m east and {cells[12]} m north; with least squares, {cells[-2]} and {cells[-1]} m"


#: Figures that kept outputs hold.
FIGURES: Final[dict[str, Callable[[], str]]] = {
    "@largest": _largest,
    "@rate": _rate,
    "@figure7": _figure_7,
    "@table4": partial(_table_4, "G", "G+J"),
    "@saif": partial(_table_4, "G with L1-SAIF"),
    "@seeds": _seeds,
    "@p4": _p4,
}


def main() -> int:
    """Write the document."""
    if wrong := problems():
        print("\n".join(wrong), file=sys.stderr)
        return 1
    Path(TABLE).write_text(document(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
