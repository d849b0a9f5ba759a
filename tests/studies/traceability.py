"""The traceability table: what each row of the requirements asks, what is reached, and the tests that prove it.

The rows, in the project's own words, are those of ``tests/references/requirements.toml``, with the three tests that
prove most. Every test that proves a row names it with ``@pytest.mark.requirement("A7")``, on a function, a class, or a
whole file (``pytestmark``). ``python tests/studies/traceability.py`` writes ``docs/traceability.md``; a test holds that
it is up to date.
"""

from __future__ import annotations

import ast
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import paths

TABLE: Final = paths.ROOT / "docs" / "traceability.md"

ROWS: Final[dict[str, dict[str, Any]]] = tomllib.loads(
    (paths.ROOT / "tests" / "references" / "requirements.toml").read_text(encoding="utf-8")
)


def _marked_rows(nodes: list[ast.expr]) -> set[str]:
    """Rows named by ``pytest.mark.requirement("A1", ...)`` among expressions."""
    rows: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.List | ast.Tuple):
            rows |= _marked_rows(node.elts)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "pytest.mark.requirement":
            rows |= {str(a.value) for a in node.args if isinstance(a, ast.Constant)}
    return rows


def marked_tests(path: Path) -> Iterator[tuple[str, str]]:
    """Pairs of row and test id of one test file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    of_file: set[str] = set()
    for node in tree.body:
        if isinstance(node, ast.Assign) and any(ast.unparse(t) == "pytestmark" for t in node.targets):
            of_file |= _marked_rows([node.value])

    def walk(body: list[ast.stmt], rows: set[str], prefix: str) -> Iterator[tuple[str, str]]:
        for node in body:
            if isinstance(node, ast.ClassDef) and node.name.startswith("Test"):
                yield from walk(node.body, rows | _marked_rows(node.decorator_list), f"{prefix}{node.name}::")
            elif isinstance(node, ast.FunctionDef) and node.name.startswith("test"):
                for row in sorted(rows | _marked_rows(node.decorator_list)):
                    yield row, f"{prefix}{node.name}"

    yield from walk(tree.body, of_file, f"{path.name}::")


def proofs() -> dict[str, list[str]]:
    """Tests that prove each row, by row."""
    found: dict[str, list[str]] = {}
    for path in sorted((paths.ROOT / "tests").rglob("test_*.py")):
        for row, test in marked_tests(path):
            found.setdefault(row, []).append(test)
    return found


def _tests(row: str, marked: list[str]) -> list[str]:
    """Lines with the tests that prove most, or that there are none."""
    chosen: list[str] = ROWS[row]["tests"]
    wrong = sorted(set(chosen) - set(marked))
    if wrong:
        raise ValueError(f"requirements.toml, {row}: no test with the marker of the row is named {', '.join(wrong)}")
    return [f"  `{test}`" for test in chosen] or ["  **open**"]


def table() -> str:
    """The document as Markdown."""
    proven = proofs()
    unknown = sorted(set(proven) - set(ROWS))
    if unknown:
        raise ValueError(f"tests name rows that do not exist: {', '.join(unknown)}")
    lines = [
        "# Traceability",
        "",
        "What is asked, its *figure*, what is reached, and the tests that prove most; a row without a test is open.",
        "Written by `python tests/studies/traceability.py` from `tests/references/requirements.toml` and the markers",
        '`@pytest.mark.requirement("A7")` of all tests.',
    ]
    heading = ""
    for row, told in ROWS.items():
        if told["heading"] != heading:
            heading = told["heading"]
            lines += ["", f"## {heading}", ""]
        asked = told["asks"] + (f"; *{told['figure']}*" if "figure" in told else "")
        parts = [asked, *([f"Reached: {told['reached']}"] if "reached" in told else [])]
        lines += [f"- **{row}** {'. '.join(parts)}", *_tests(row, proven.get(row, []))]
    return "\n".join(lines) + "\n"


def main() -> int:
    """Write the table."""
    TABLE.write_text(table(), encoding="utf-8")
    sys.stdout.write(f"{TABLE}: {len(proofs())} rows have tests\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
