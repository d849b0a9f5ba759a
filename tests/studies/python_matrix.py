"""A wheel in an environment of its own for each Python, 3.11 to 3.14: ``python tests/studies/python_matrix.py WHEEL``.

For each version that the machine has (on ``PATH``, or of pyenv) the wheel is installed with its dependencies, its
version printed and ``railfix demo`` run; with ``--tests`` the tests of a folder run too, with the extra ``test``.
Versions that are absent are named. It needs a package index.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import paths

PROJECT: Final = tomllib.loads((paths.ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
_CLASSIFIER: Final = "Programming Language :: Python :: 3."


def supported_versions() -> list[str]:
    """Return the versions of Python that the package names, "3.11" first."""
    minors = [line.removeprefix(_CLASSIFIER) for line in PROJECT["classifiers"] if line.startswith(_CLASSIFIER)]
    return [f"3.{minor}" for minor in sorted(minors, key=int)]


def interpreter(version: str, folders: Sequence[Path]) -> Path | None:
    """Return the first program ``pythonX.Y`` in folders that runs and is of that version; None where there is none."""
    for path in (folder / f"python{version}" for folder in folders):
        if path.is_file() and _said(path, "-c", "import sys; print('%d.%d' % sys.version_info[:2])") == version:
            return path
    return None


def folders_of_interpreters() -> list[Path]:
    """Return the folders of the search path and those of pyenv's versions."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"), "versions")
    return [Path(name) for name in os.environ["PATH"].split(os.pathsep)] + sorted(pyenv.glob("*/bin"))


def run_with(python: Path, wheel: Path, tests: Sequence[str]) -> str:
    """Install the wheel for one interpreter, run it, and return what came of it in one line."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        own = folder / "venv" / "bin" / "python"
        asked = f"{wheel.resolve()}[test]" if tests else str(wheel.resolve())
        steps = {
            "environment": [str(python), "-m", "venv", str(folder / "venv")],
            "installation": [str(own), "-m", "pip", "install", "-q", asked],
            "version": [str(own), "-m", "railfix", "--version"],
            "demo": [str(own), "-m", "railfix", "demo"],
            **({"tests": [str(own), "-m", "pytest", "-q", *tests]} if tests else {}),
        }
        last = {}
        for step, command in steps.items():
            place = paths.ROOT if step == "tests" else folder
            done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
            last[step] = (done.stdout.strip() or "-").splitlines()[-1]
            if done.returncode:
                return f"{step} FAILED: {(done.stderr or done.stdout).strip().splitlines()[-1]}"
        return f"{last['version']}, demo runs" + (f", tests: {last['tests']}" if tests else "")


def _said(program: Path, *words: str) -> str:
    return subprocess.run([program, *words], capture_output=True, text=True, check=False).stdout.strip()


def main() -> int:
    """Run every version and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--tests", nargs="+", default=(), help="tests to run, such as tests/track")
    chosen = parser.parse_args()
    failed = False
    for version in supported_versions():
        python = interpreter(version, folders_of_interpreters())
        result = run_with(python, chosen.wheel, chosen.tests) if python else "absent"
        failed |= "FAILED" in result
        sys.stdout.write(f"{version}: {result}\n")
        sys.stdout.flush()
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
