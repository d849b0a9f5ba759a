"""The documents for a safety case: what they link exists, and the report has what the tests did."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

from conftest import ROOT
from railfix.core.reasons import Reason, Status
from railfix.tracking import TrackStatus
from verification_report import SAFETY, outcomes, report, safety_rows, verdict

TEXT = SAFETY.read_text(encoding="utf-8")
TESTS = {
    f"{path.name}::{name}"
    for path in sorted((ROOT / "tests").rglob("test_*.py"))
    for name in re.findall(r"^def (test_\w+)\(", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
}


def test_each_hazard_and_condition_has_a_test_that_exists_or_says_that_it_is_not_checked() -> None:
    rows = list(safety_rows(TEXT))
    numbers = [number for number, _, _ in rows]
    assert sorted(numbers) == sorted([f"H{k}" for k in range(1, 34)] + [f"C{k}" for k in range(1, 19)])
    assert [test for _, _, tests in rows for test in tests if test not in TESTS] == []
    without = [number for number, _, tests in rows if not tests]
    assert without == re.findall(r"\| (C\d+) \|[^|]*\| \*\*not checked\*\*", TEXT)


def test_tests_that_the_documents_name_exist() -> None:
    named = {
        name: path.name
        for path in (ROOT / "docs").rglob("*.md")
        for name in re.findall(r"\btest_\w+\.py::test_\w+", path.read_text(encoding="utf-8"))
    }
    assert len(named) > 150
    assert {name: page for name, page in named.items() if name not in TESTS} == {}


def test_statuses_and_reasons_of_the_tables_exist() -> None:
    tables = "\n".join(line for line in TEXT.splitlines() if line.startswith(("|", "- ")))
    named = set(re.findall(r"`([a-z_]+)`", tables))
    known = {s.text for s in Status} | {s.text for s in TrackStatus} | {str(r.name).lower() for r in Reason}
    assert named - known - {"no_input"} == set()
    assert len(named) > 15


def test_the_page_is_short() -> None:
    assert len(TEXT.split()) <= 2400


RESULTS = """<testsuites><testsuite>
<testcase classname="tests.track.test_a" name="test_one[x.y-1]"/>
<testcase classname="tests.track.test_a" name="test_one[2]"><failure/></testcase>
<testcase classname="tests.track.test_a.TestB" name="test_two"><skipped/></testcase>
<testcase classname="test_c" name="test_three"/>
<testcase classname="test_c" name="test_four"><error/></testcase>
</testsuite></testsuites>"""


def test_results_are_counted_by_test(tmp_path: Path) -> None:
    path = tmp_path / "results.xml"
    path.write_text(RESULTS)
    found = outcomes([path])
    assert found == {
        "test_a.py::test_one": Counter(passed=1, failed=1),
        "test_a.py::TestB::test_two": Counter(skipped=1),
        "test_c.py::test_three": Counter(passed=1),
        "test_c.py::test_four": Counter(failed=1),
    }
    assert verdict(["test_c.py::test_three", "test_c.py::test_five"], found) == "shown, 1 passed, 1 not run"
    assert verdict(["test_c.py::test_three", "test_a.py::test_one"], found) == "FAILED, 2 passed, 1 failed"
    assert verdict(["test_a.py::TestB::test_two"], found) == "not shown, 1 skipped"
    assert verdict(["test_c.py::test_four"], found) == "FAILED, 1 failed"
    assert verdict([], found) == "no test"


def test_the_report_has_hazards_and_requirements_with_their_results(tmp_path: Path) -> None:
    path = tmp_path / "results.xml"
    odd, damage = "test_an_odd_map_is_right_or_says_what_is_wrong", "test_damage_gives_no_false_observation"
    path.write_text(
        f'<t><testcase classname="tests.track.test_odd_maps" name="{odd}"><failure/></testcase>'
        f'<testcase classname="tests.io.test_receiver_logs" name="{damage}"/></t>'
    )
    text = report([path], "ranges: 39 of 40 mutants killed")
    assert "| H5 | a map is read incorrectly | FAILED, 1 failed |" in text
    assert "| H11 | damaged input is used as valid data | shown, 1 passed |" in text
    assert re.search(r"^\| A1 \| .* not run \|$", text, flags=re.MULTILINE)
    assert "- ranges: 39 of 40 mutants killed" in text
