"""The documentation site: examples name what exists, all pages are reached, it builds without a warning."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
import typer.main

from conftest import ROOT
from railfix.cli import app
from railfix.cli.command import load_command

DOCS = ROOT / "docs"
EXAMPLES = sorted((DOCS / "gallery").glob("*.py"))


def missing_names(tree: ast.AST) -> Iterator[str]:
    """Yield the imports, and the attributes of imported modules, that do not exist."""
    modules: dict[str, ModuleType] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                modules[alias.asname or alias.name] = importlib.import_module(alias.name)
        elif isinstance(node, ast.ImportFrom):
            assert node.module
            module = importlib.import_module(node.module)
            for alias in node.names:
                if not hasattr(module, alias.name):
                    try:
                        importlib.import_module(f"{node.module}.{alias.name}")
                    except ModuleNotFoundError:
                        yield f"{node.module}.{alias.name}"
                        continue
                value = getattr(module, alias.name)
                if isinstance(value, ModuleType):
                    modules[alias.asname or alias.name] = value
    for node in ast.walk(tree):
        known = isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in modules
        if known and not hasattr(modules[node.value.id], node.attr):
            yield f"{node.value.id}.{node.attr}"


@pytest.mark.requirement("G2")
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_examples_parse_and_their_names_exist(path: Path) -> None:
    assert list(missing_names(ast.parse(path.read_text(encoding="utf-8")))) == []


def test_there_are_ten_examples() -> None:
    assert len(EXAMPLES) == 10


def test_missing_names_are_found() -> None:
    code = (
        "import railfix\nfrom railfix.report import plots, absent\nrailfix.Config()\nrailfix.read_it()\nplots.plan_it()"
    )
    assert list(missing_names(ast.parse(code))) == ["railfix.report.absent", "railfix.read_it", "plots.plan_it"]


def test_the_site_reaches_every_page() -> None:
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    trees = re.findall(r"^```\{toctree\}\n(.*?)^```$", index, flags=re.MULTILINE | re.DOTALL)
    listed = [line for tree in trees for line in tree.splitlines() if line and not line.startswith(":")]
    pages = [page for folder in (".", "maintain") for page in (DOCS / folder).glob("*.md")]
    names = [page.relative_to(DOCS).with_suffix("").as_posix() for page in pages]
    assert sorted([*listed, "index"]) == sorted([*names, "auto_examples/index"])


def commands() -> Iterator[str]:
    """Yield the commands of the command line, those of groups with the name of the group."""
    program = typer.main.get_command(app)
    for name in program.list_commands(program.make_context("railfix", [], resilient_parsing=True)):
        inner = getattr(load_command(name, program.modules.get(name)), "commands", None)
        yield from (f"{name} {sub}" for sub in inner) if inner else (name,)


def test_pages_of_packages_and_modules_list_their_own_names_alone() -> None:
    listed = re.findall(r"^   (railfix\.[\w.]+)$", (ROOT / "docs" / "api.md").read_text(encoding="utf-8"), flags=re.M)
    assert len(listed) > 20
    assert [name for name in listed if not hasattr(importlib.import_module(name), "__all__")] == []


def test_the_readme_has_every_command() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    table = "\n".join(line for line in readme.splitlines() if line.startswith("| `railfix "))
    listed = sorted(re.findall(r"`railfix ([a-z0-9 -]+)`", table))
    assert listed == sorted(commands())


def test_pictures_of_the_readme_are_small() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    pictures = re.findall(r"!\[[^\]]+\]\((docs/pictures/[^)]+)\)", readme)
    assert pictures
    assert all(0 < (ROOT / picture).stat().st_size < 150_000 for picture in pictures)


@pytest.mark.slow
@pytest.mark.requirement("G2")
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    for package in ("sphinx", "myst_parser", "sphinx_gallery", "sphinx_design", "numpydoc", "pydata_sphinx_theme"):
        pytest.importorskip(package)
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-W",
        "-b",
        "html",
        "-d",
        str(tmp_path / "trees"),
        str(DOCS),
        str(tmp_path / "site"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    examples = tmp_path / "site" / "auto_examples"
    page = (examples / "first_positions.html").read_text(encoding="utf-8")
    assert "single epochs" in page
    assert page.count("sphx-glr-single-img") == 2  # plan and errors
    gallery = (examples / "index.html").read_text(encoding="utf-8")
    assert gallery.count("sphx-glr-thumbcontainer") == len(EXAMPLES)
    api = (tmp_path / "site" / "api" / "railfix.pipeline.EpochProcessor.html").read_text(encoding="utf-8")
    assert "_modules/railfix/pipeline/" in api  # link to the source
