"""Report of a verification: requirements, hazards and conditions, with the results of their tests.

``verification_report.py --results results.xml --mutants mutants.txt --out report.md``: results are those that
``pytest --junitxml=results.xml`` wrote, of one run or of several, mutants what ``mutation.py`` printed. Hazards and
conditions are the tables of ``docs/safety.md``, requirements those of ``docs/traceability.md``.
"""

from __future__ import annotations

import argparse
import platform
import re
import sys
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import paths
from railfix.cli import version_text
from railfix.run.record import package_versions
from traceability import ROWS, proofs

SAFETY: Final = paths.ROOT / "docs" / "safety.md"
#: Test ids, as in tables of documents: test_x.py::test_y.
TEST_ID: Final = re.compile(r"`(test_\w+\.py::[\w:]+)`")


def safety_rows(text: str) -> Iterator[tuple[str, str, list[str]]]:
    """Yield number, first words and test ids of each hazard and condition of a document."""
    for line in text.splitlines():
        if row := re.match(r"\| ([HC]\d+) \| ([^|]+) \|", line):
            yield row[1], row[2].strip(), TEST_ID.findall(line)


def outcomes(files: Sequence[Path]) -> dict[str, Counter[str]]:
    """Return how often each test passed, failed and was skipped, by its id without parameters.

    A test with an error in its preparation has failed.
    """
    counted: dict[str, Counter[str]] = {}
    for case in (case for path in files for case in ElementTree.parse(path).iter("testcase")):
        module, *classes = re.sub(r"^(?:\w+\.)*(?=test_)", "", case.get("classname", "")).split(".")
        name = "::".join([f"{module}.py", *classes, case.get("name", "").partition("[")[0]])
        marks = {child.tag for child in case}
        outcome = "failed" if marks & {"failure", "error"} else "skipped" if "skipped" in marks else "passed"
        counted.setdefault(name, Counter())[outcome] += 1
    return counted


def verdict(tests: Sequence[str], found: Mapping[str, Counter[str]]) -> str:
    """Return what the results of tests show, with their counts."""
    total = sum((found.get(test, Counter()) for test in tests), Counter[str]())
    absent = sum(test not in found for test in tests)
    word = "no test" if not tests else "FAILED" if total["failed"] else "shown" if total["passed"] else "not shown"
    counts = [f"{total[kind]} {kind}" for kind in ("passed", "failed", "skipped") if total[kind]]
    return ", ".join([word, *counts, *([f"{absent} not run"] if absent else [])])


def report(files: Sequence[Path], mutants: str = "") -> str:
    """Return the report as Markdown."""
    found, proven = outcomes(files), proofs()
    versions = ", ".join(f"{name} {number}" for name, number in package_versions().items())
    requirements = [(row, str(told["asks"]), proven.get(row, [])) for row, told in ROWS.items()]
    lines = [
        "# Verification report",
        "",
        f"{version_text()}, Python {platform.python_version()}, {platform.platform()}; {versions}",
        "",
        f"Tests in the results: {len(found)}.",
    ]
    for heading, rows in (("Hazards and conditions", list(safety_rows(SAFETY.read_text(encoding="utf-8")))),
                          ("Requirements", requirements)):  # fmt: skip
        lines += ["", f"## {heading}", "", "| | what | result |", "|---|---|---|"]
        lines += [f"| {row} | {asked} | {verdict(tests, found)} |" for row, asked, tests in rows]
    lines += ["", "## Mutants", "", *(f"- {line}" for line in mutants.splitlines() or ["none were tried"])]
    return "\n".join(lines) + "\n"


def main() -> int:
    """Write the report; 1 where a test of a row failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--results", type=Path, nargs="+", required=True)
    parser.add_argument("--mutants", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    chosen = parser.parse_args()
    text = report(chosen.results, chosen.mutants.read_text(encoding="utf-8") if chosen.mutants else "")
    chosen.out.write_text(text, encoding="utf-8")
    sys.stdout.write(f"{chosen.out}: {text.count('| shown')} rows shown, {text.count('| FAILED')} failed\n")
    return int("| FAILED" in text)


if __name__ == "__main__":
    sys.exit(main())
