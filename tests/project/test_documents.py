"""The documents say what the program does: generated ones are up to date, links lead somewhere, examples run."""

from __future__ import annotations

import doctest
import re
import subprocess
from pathlib import Path
from typing import Any

import polars as pl
import pytest

import document_commands
import railfix
from conftest import ROOT
from readme_example import real, shown, without_times
from reference_document import pages
from traceability import TABLE, marked_tests, table

DOCUMENTS = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "data/README.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
]


def test_traceability_is_up_to_date() -> None:
    assert TABLE.read_text(encoding="utf-8") == table(), "run python tests/studies/traceability.py"


def test_reference_is_up_to_date() -> None:
    for path, text in pages().items():
        assert path.read_text(encoding="utf-8") == text, "run python tests/studies/reference_document.py"
    settings = pages()[ROOT / "docs" / "settings.md"]  # whole descriptions, beyond a colon or the first sentence
    for words in ("until the probability is measured on the line", '"drop" also removes the coordinates'):
        assert words in settings


def test_markers_are_found_on_functions_classes_and_files(tmp_path: Path) -> None:
    path = tmp_path / "test_x.py"
    path.write_text(
        "import pytest\n"
        'pytestmark = [pytest.mark.slow, pytest.mark.requirement("A1")]\n'
        "def test_one(): ...\n"
        '@pytest.mark.requirement("A2")\n'
        "class TestTwo:\n"
        '    @pytest.mark.requirement("A3")\n'
        "    def test_three(self): ...\n"
        "def helper(): ...\n"
    )
    three = "test_x.py::TestTwo::test_three"
    assert list(marked_tests(path)) == [("A1", "test_x.py::test_one"), ("A1", three), ("A2", three), ("A3", three)]


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda p: p.name)
def test_links_between_documents_lead_somewhere(path: Path) -> None:
    links = re.findall(r"\]\((?!https?:)([^)#\s]*)(?:#([^)]+))?\)", path.read_text(encoding="utf-8"))
    assert [target for target, _ in links if not (path.parent / target).exists()] == []
    places = [(path.parent / target if target else path, place) for target, place in links if place]
    assert [(str(target), place) for target, place in places if place not in anchors(target)] == []


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda p: p.name)
def test_command_lines_and_options_exist(path: Path) -> None:
    wrong = [text for line in document_commands.shown(path) if (text := document_commands.wrong_with(line))]
    assert [*wrong, *document_commands.wrong_options(path), *document_commands.wrong_scripts(path)] == []


@pytest.mark.parametrize(
    ("words", "whole", "said"),
    [
        ("runs --front a", True, "no command runs"),
        ("map chek a", False, "no command chek"),
        ("run ... --fron a", False, "unknown --fron"),
        ("run ... --set elevation.mask=15", False, "elevation.mask"),
        ("run ... --without dopler", False, "dopler"),
        ("run --front a --track b --out c --chunk x", True, "integer"),
        ("run --front a --track b --nav c", True, "--out"),
        ("run --front a --nav b --track c --out d --chunk 2", True, None),
    ],
)
def test_what_is_wrong_with_a_command_line_is_found(words: str, whole: bool, said: str | None) -> None:
    found = document_commands.wrong_with(document_commands.Shown("here", tuple(words.split()), whole))
    assert (said is None) == (found is None)
    assert said is None or said in str(found)


def anchors(path: Path) -> set[str]:
    """Anchors of the headings of a document."""
    lines = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", line.lower()).replace(" ", "-") for line in lines}


def test_ci_runs_the_command_of_the_readme() -> None:
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (expression,) = re.findall(r"command=\$\((sed .*)\)\n", script)
    found = subprocess.run(["bash", "-c", expression], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert found.strip() in readme
    assert found.count("\n") == 1
    assert "pytest" in found
    assert ".venv" in found


def first_example(page: str) -> tuple[str, str]:
    """The first example of a page, or of the docstring of the package, and the text around it."""
    if page == "help":
        text = str(railfix.__doc__)
        lines = re.findall(r"^(?:>>>|\.\.\.) ?(.*)$", text, re.MULTILINE)
        return "\n".join(lines), text
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0], text


@pytest.mark.requirement("G4")
@pytest.mark.requirement("S3")
@pytest.mark.parametrize("page", ["docs/index.md", "README.md", "help"])
def test_the_first_example_reaches_the_error_beside_it(page: str) -> None:
    code, text = first_example(page)
    names: dict[str, Any] = {}
    exec(code, names)
    train = railfix.train_table(names["result"])
    truth = pl.read_csv(railfix.demo_files()["truth"], schema_overrides={"time_gpst": pl.Datetime("ns")})
    both = train.join(truth, on=["time_gpst", "antenna"], suffix="_true")
    assert len(both) == 2000
    error = float((both["chainage_m"] - both["chainage_m_true"]).abs().median())
    # the same example stands on three pages, beside what it reaches
    assert f"median error of these positions is {error:.2f} m" in " ".join(text.split())
    # what a notebook shows of them: the filter first, then single epochs
    shown_table = names["result"]._repr_html_()
    assert shown_table.index("filter along the track") < shown_table.index("single epochs")
    assert "2,000 epochs tracking or coasting" in shown_table
    assert repr(names["state"]) == "<State: front; with the filter>"
    assert re.match(
        r"<FilterState: 1 place, the most probable at [\d.]+ ± [\d.]+ m>", repr(names["state"].fusion["front"])
    )


def test_the_example_runs_and_prints_what_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (ROOT / "docs" / "example.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```pycon\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)
    assert len(blocks) > 5
    monkeypatch.chdir(tmp_path)
    test = doctest.DocTestParser().get_doctest("\n".join(blocks), {}, "example.md", "docs/example.md", 0)
    report: list[str] = []
    results = doctest.DocTestRunner().run(test, out=report.append)
    assert results.failed == 0, "".join(report)


def test_the_readme_shows_what_the_program_prints() -> None:
    assert without_times(shown()[1]) == without_times(real()), "run python tests/studies/readme_example.py"
