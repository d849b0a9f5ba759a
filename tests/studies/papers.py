"""Table of the items of the five papers, and where they are read differently.

``python tests/studies/papers.py`` writes docs/papers.md from ``tests/references/papers.toml`` and the kept outputs of
the studies; a test holds that it is up to date, that what each item names exists, and that its test does.
"""

from __future__ import annotations

import importlib
import re
import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import Any, Final

import paths

TABLE: Final = paths.ROOT / "docs" / "papers.md"
DATA: Final[dict[str, Any]] = tomllib.loads(
    (paths.ROOT / "tests" / "references" / "papers.toml").read_text(encoding="utf-8")
)
RESULTS: Final = paths.ROOT / "tests" / "references" / "results"


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
        if "test" in item and item["test"] not in tests():
            wrong.append(f"{item['what']}: there is no test {item['test']}")
    return wrong


def document() -> str:
    """The document as Markdown."""
    lines = [
        "# The five papers, item by item",
        "",
        "Written by `python tests/studies/papers.py` from `tests/references/papers.toml`. Each item: what is asked and",
        "reached, what does it, and the test; one without a test is open.",
    ]
    for paper, title in DATA["papers"].items():
        lines += ["", f"## {paper}", "", title, ""]
        for item in (item for item in DATA["item"] if item["paper"] == paper):
            figures = {"asked": item.get("asked", ""), "reached": reached(item)}
            text = "; ".join([item["what"], *(f"{name}: {figure}" for name, figure in figures.items() if figure)])
            test = f"`{item['test']}`" if "test" in item else "**open**"
            lines += [f"- {text}", f"  `{item['where']}`", f"  {test}"]
    lines += ["", "## Where we read the papers differently", ""]
    for found in DATA["difference"]:
        why = f" Why: {found['why']}." if found["why"] else ""
        lines.append(f"- **{found['paper']}** {found['says']} Here: {found['here']}{why}")
    return "\n".join(lines) + "\n"


def reached(item: dict[str, Any]) -> str:
    """Figure reached; one that begins with @ is taken from a kept output."""
    text: str = item.get("reached", "")
    return FIGURES[text]() if text.startswith("@") else text


def _row(part: str, heading: str, name: str) -> list[str]:
    """Figures of a way in the table under a heading of a part of P1's experiment."""
    text = (RESULTS / f"p1-{part}.txt").read_text(encoding="utf-8")
    block = text[text.index(heading) :]
    (line,) = [line for line in block.splitlines()[:40] if line.startswith(name)][:1]
    return line.removeprefix(name).split()


def _largest() -> str:
    names = ("conventional", "validated", "RTKLIB", "p1", "strict")
    cells = [f"{name} {_row('corrected', 'all data', f'G       {name}, SBAS')[8]}" for name in names]
    return f"{', '.join(cells)} m ([table](p1-results.md))"


def _rate() -> str:
    names = ("conventional", "validated", "RTKLIB", "p1", "strict")
    cells = [f"{name} {_row('corrected', 'ways without tunnels', f'G       {name}, SBAS')[0]}" for name in names]
    return f"{', '.join(cells)} % ([table](p1-results.md))"


def _saif() -> str:
    text = (RESULTS / "p1-test-line.txt").read_text(encoding="utf-8")
    line = next(line for line in text.splitlines() if line.startswith("G with L1-SAIF"))
    rate, mean, std, *_ = line.removeprefix("G with L1-SAIF").split()
    return f"{rate} %, {mean} / {std} m ([test line](p1-results.md))"


def _p4() -> str:
    text = (paths.ROOT / "docs" / "p4-experiment.md").read_text(encoding="utf-8")
    cells = next(line for line in text.splitlines() if line.startswith("ESBC, GPS       0.0")).split()
    return f"p95 {cells[9]} and {cells[12]} m, least squares {cells[-2]} and {cells[-1]} m ([table](p4-experiment.md))"


#: Figures that kept outputs hold.
FIGURES: Final = {"@largest": _largest, "@rate": _rate, "@saif": _saif, "@p4": _p4}


def main() -> int:
    """Write the document."""
    if wrong := problems():
        print("\n".join(wrong), file=sys.stderr)
        return 1
    Path(TABLE).write_text(document(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
