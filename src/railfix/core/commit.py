"""Commit of the source that runs, for versions in print and in records."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Final

from railfix import __version__

#: Written into wheels and source archives by their build (``.ci/hatch_build.py``), never in a checkout.
FROM_BUILD: Final = Path(__file__).parents[1] / "_commit.txt"


@cache
def source_commit() -> str:
    """Return the commit of the source, "unknown" where neither the build nor a checkout has it.

    "+changed" follows where files were not as committed when the package was built. For a checkout
    (``pip install -e``) git's files are read; changes since its commit are not seen.
    """
    if FROM_BUILD.is_file():
        return FROM_BUILD.read_text(encoding="ascii").strip()
    return read_commit(Path(__file__).parents[3]) or "unknown"


def version_text() -> str:
    """Return version and commit in one line."""
    return f"railfix {__version__} (commit {source_commit()})"


def read_commit(root: Path) -> str:
    """Return the commit that is checked out in a folder (or a further work tree), from git's files; "" without any."""
    git = root / ".git"
    if git.is_file():
        git = root / git.read_text(encoding="utf-8").removeprefix("gitdir:").strip()
    head = _first_line(git / "HEAD")
    if not head.startswith("ref: "):
        return head
    branch = head.removeprefix("ref: ")
    common = git / _first_line(git / "commondir")
    packed = common / "packed-refs"
    lines = packed.read_text(encoding="utf-8").splitlines() if packed.is_file() else []
    return _first_line(common / branch) or next((line.split()[0] for line in lines if line.endswith(f" {branch}")), "")


def _first_line(path: Path) -> str:
    return path.read_text(encoding="utf-8").partition("\n")[0].strip() if path.is_file() else ""
