"""A release can be checked: its commit, and two builds with one hash."""

from __future__ import annotations

import json
import os
import runpy
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement

from conftest import ROOT
from public_names import KEPT, public_names
from python_matrix import PROJECT, interpreter, supported_versions
from railfix.core.files import read_commit
from reproducible_build import built_twice


def git(folder: Path, *words: str) -> str:
    who = ["-c", "user.name=A", "-c", "user.email=a@example.org"]
    return subprocess.run(
        ["git", "-C", folder, *who, *words], capture_output=True, text=True, check=True
    ).stdout.strip()


def test_the_commit_of_a_checkout_is_what_git_says(tmp_path: Path) -> None:
    root, other = tmp_path / "root", tmp_path / "other"
    root.mkdir()
    assert read_commit(root) == ""
    git(root, "init", "-q")
    assert read_commit(root) == ""  # a branch without a commit
    git(root, "commit", "-q", "--allow-empty", "-m", "one")
    first = git(root, "rev-parse", "HEAD")
    assert read_commit(root) == first
    git(root, "worktree", "add", "-q", "-b", "area/side", str(other))
    git(other, "commit", "-q", "--allow-empty", "-m", "two")
    assert read_commit(other) == git(other, "rev-parse", "HEAD") != first
    git(root, "pack-refs", "--all")
    git(other, "pack-refs", "--all")
    assert (read_commit(root), read_commit(other)) == (first, git(other, "rev-parse", "HEAD"))
    git(root, "checkout", "-q", "--detach")
    assert read_commit(root) == first


def commit_in_build(root: Path, *, version: str = "standard", target: str = "wheel") -> dict[str, str]:
    """What the build hook would pack in a folder, as texts by their places."""
    hook_class = runpy.run_path(str(ROOT / ".ci" / "hatch_build.py"))["CommitHook"]
    hook = hook_class(str(root), {}, None, None, str(root / "dist"), target)
    data: dict[str, Any] = {"force_include": {}}
    hook.initialize(version, data)
    packed = {place: Path(path).read_text() for path, place in data["force_include"].items()}
    hook.finalize(version, data, "")
    assert not hook.folder.exists()
    return packed


def test_a_build_packs_the_commit_and_goes_on_without_git(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert commit_in_build(tmp_path) == {}
    git(tmp_path, "init", "-q")
    git(tmp_path, "commit", "-q", "--allow-empty", "-m", "one")
    commit = git(tmp_path, "rev-parse", "HEAD")
    assert commit_in_build(tmp_path) == {"railfix/_commit.txt": f"{commit}\n"}
    assert commit_in_build(tmp_path, target="sdist") == {".ci/commit.txt": f"{commit}\n"}
    assert commit_in_build(tmp_path, version="editable") == {}
    (tmp_path / "new").touch()
    assert commit_in_build(tmp_path) == {"railfix/_commit.txt": f"{commit}+changed\n"}
    monkeypatch.setenv("PATH", str(tmp_path))
    assert commit_in_build(tmp_path) == {}
    (tmp_path / ".ci").mkdir()
    (tmp_path / ".ci" / "commit.txt").write_text("of the archive\n")
    assert commit_in_build(tmp_path) == {"railfix/_commit.txt": "of the archive\n"}


@pytest.mark.slow
@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="a source archive has no commit to build from")
def test_two_builds_have_one_hash_and_know_their_commit(tmp_path: Path) -> None:
    hashes = built_twice(tmp_path)
    assert sorted(len(found) for found in hashes.values()) == [2, 3]  # one more wheel, from the source archive
    assert all(len(set(found)) == 1 for found in hashes.values()), hashes
    (wheel,) = (tmp_path / "0").glob("*.whl")
    install = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "-q",
        "--no-index",
        "--no-deps",
        "--target",
        str(tmp_path / "site"),
    ]
    subprocess.run([*install, str(wheel)], check=True)
    surroundings = os.environ | {"PYTHONPATH": str(tmp_path / "site"), "PATH": ""}  # no git
    command = [sys.executable, "-m", "railfix", "--version"]
    said = subprocess.run(command, cwd=tmp_path, env=surroundings, capture_output=True, text=True, check=True).stdout
    changed = "+changed" if git(ROOT, "status", "--porcelain") else ""
    assert said == f"railfix {version('railfix')} (commit {git(ROOT, 'rev-parse', 'HEAD')}{changed})\n"


def test_a_public_name_that_is_gone_is_in_the_changes() -> None:
    changes = (ROOT / "docs" / "changes.md").read_text(encoding="utf-8")
    gone = set(KEPT.read_text(encoding="utf-8").splitlines()) - set(public_names())
    missing = sorted(name for name in gone if name.removeprefix("railfix.") not in changes)
    assert missing == [], "docs/changes.md does not say what became of them"


def test_recipe_and_citation_are_those_of_the_package() -> None:
    recipe = yaml.safe_load((ROOT / ".ci" / "conda" / "recipe.yaml").read_text(encoding="utf-8"))
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert recipe["context"]["version"] == citation["version"] == version("railfix")
    assert "doi" not in citation
    python, *needed = recipe["requirements"]["run"]
    assert python == f"python {PROJECT['requires-python']}"
    renamed = {"matplotlib-base": "matplotlib"}  # the part without a window system
    found = [Requirement(" ".join([renamed.get(name, name), *more])) for name, *more in map(str.split, needed)]
    # conda installs what older Pythons need beside newer ones too
    assert found == [Requirement(text.partition(";")[0]) for text in PROJECT["dependencies"]]


def test_the_container_installs_the_wheel_and_runs_as_a_user() -> None:
    text = (ROOT / ".ci" / "Containerfile").read_text(encoding="utf-8")
    lines = [line.split(maxsplit=1) for line in text.splitlines() if line and not line.startswith("#")]
    assert [word for word, _ in lines] == "ARG FROM COPY RUN RUN USER WORKDIR ENTRYPOINT CMD".split()
    values = dict(lines)
    assert values["ARG"].removeprefix("PYTHON=") in supported_versions()
    assert values["USER"] == "railfix"
    assert json.loads(values["ENTRYPOINT"]) == ["railfix"]


def test_interpreters_are_those_that_run(tmp_path: Path) -> None:
    assert supported_versions() == ["3.11", "3.12", "3.13", "3.14"]
    own = ".".join(map(str, sys.version_info[:2]))
    (tmp_path / f"python{own}").symlink_to(sys.executable)
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / f"python{own}").write_text("#!/bin/sh\nexit 127\n")
    (broken / f"python{own}").chmod(0o755)
    (tmp_path / "python3.99").symlink_to(sys.executable)  # another version than its name says
    assert interpreter(own, [broken, tmp_path]) == tmp_path / f"python{own}"
    assert interpreter("3.99", [tmp_path]) is None


@pytest.mark.parametrize("failing", ["", "pytest", "ruff", "mypy"])
def test_the_checks_fail_exactly_where_one_of_them_does(failing: str, tmp_path: Path) -> None:
    programs = tmp_path / "programs"
    for path in (tmp_path / ".ci", programs):
        path.mkdir()
    for name in ("rnx2rtkp", "chromium", "pdftotext", "mosquitto", "python"):
        (programs / name).write_text(f'#!/bin/sh\necho "ran $*"\n[ "$2" != "{failing}" ]\n', encoding="utf-8")
        (programs / name).chmod(0o755)
    (tmp_path / "README.md").write_text(
        "<!-- test command -->\n```sh\n"
        "mkdir -p .venv/bin && cp programs/python .venv/bin && .venv/bin/python -m pytest\n```\n",
        encoding="utf-8",
    )
    shutil.copy(ROOT / ".ci" / "run", tmp_path / ".ci")
    path = f"{programs}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run([tmp_path / ".ci" / "run"], capture_output=True, text=True, env=os.environ | {"PATH": path})
    assert done.returncode == bool(failing), done.stdout + done.stderr
    assert failing or done.stdout.splitlines()[-1] == "ran -m mypy"
