"""The demonstration with other versions of the dependencies: ``python tests/studies/dependency_versions.py lowest``.

``lowest`` installs the lowest version of each direct dependency that ``pyproject.toml`` allows, ``newest`` the newest
of everything, ``prerelease`` that with a release candidate of numba where there is one. Each is installed by uv into an
environment of its own, ``railfix demo`` runs there and here, and the tables of results are compared: text by text, or
by how far numbers differ. The exit code is 1 where one cannot be installed, fails, or differs by more than `MOST`.
``--python 3.13`` takes another Python. It needs uv and a package index.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

import polars as pl
from polars import selectors

import paths

RESOLUTIONS: Final = {
    "lowest": ["--resolution", "lowest-direct"],
    "newest": ["--upgrade"],
    "prerelease": ["--upgrade", "--prerelease", "if-necessary-or-explicit", "numba>=0.61.0rc1"],
}
#: Tables of the demonstration.
TABLES: Final = ("positions.csv", "train.csv")
#: Numbers may differ by this much of their unit: the tables are rounded to 0.1 mm and less.
MOST: Final = 1e-3


def compare(one: Path, other: Path) -> tuple[float, str]:
    """Return the largest difference of the tables of two runs, and a sentence; infinite where they differ in kind."""
    largest, different = 0.0, []
    for name in TABLES:
        first, second = one / name, other / name
        if first.read_bytes() == second.read_bytes():
            continue
        tables = [pl.read_csv(file, infer_schema_length=None) for file in (first, second)]
        if tables[0].schema != tables[1].schema or len(tables[0]) != len(tables[1]):
            return float("inf"), f"{name} has other columns or rows"
        texts = [table.select(~selectors.numeric()) for table in tables]
        if not texts[0].equals(texts[1]):
            return float("inf"), f"{name} has other words"
        numbers = [table.select(selectors.numeric().cast(pl.Float64)) for table in tables]
        if not numbers[0].null_count().equals(numbers[1].null_count()):
            return float("inf"), f"{name} has other absent numbers"
        apart = float(((numbers[0] - numbers[1]).select(pl.all().abs().max())).max_horizontal().fill_null(0.0).max())
        largest = max(largest, apart)
        different.append(f"{name} by at most {apart:g}")
    return largest, "differs: " + ", ".join(different) if different else "equal, text by text"


def demonstrate(python: Path, folder: Path) -> Path:
    """Run ``railfix demo`` in a folder, and return its results."""
    folder.mkdir()
    command = [str(python), "-m", "railfix", "demo", "--out", str(folder / "demo")]
    subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    return folder / "demo"


def install(folder: Path, how: str, version: str, source: str) -> Path:
    """Install railfix from `source` with a choice of versions, and return the interpreter."""
    python = folder / "venv" / "bin" / "python"
    subprocess.run(
        ["uv", "venv", "-q", "-p", version, str(folder / "venv")], check=True, capture_output=True, text=True
    )
    command = ["uv", "pip", "install", "-q", "-p", str(python), *RESOLUTIONS[how], source]
    subprocess.run(command, check=True, capture_output=True, text=True)
    return python


def versions(python: Path) -> str:
    """Return the main packages of an environment with their versions."""
    program = (
        "import importlib.metadata as m, platform; print('Python', platform.python_version(), *[f'{n} {m.version(n)}' "
        "for n in 'numpy scipy numba polars pydantic pyproj georinex xarray pandas filterpy japan-geoid'.split()])"
    )
    return subprocess.run([python, "-c", program], capture_output=True, text=True, check=True).stdout.strip()


def main() -> int:
    """Install and run each choice, and print a line for it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("how", nargs="+", choices=RESOLUTIONS)
    parser.add_argument("--python", default=f"{sys.version_info[0]}.{sys.version_info[1]}", metavar="VERSION")
    parser.add_argument("--source", default=str(paths.ROOT), help="folder, archive or wheel to install")
    chosen = parser.parse_args()
    failed = False
    with tempfile.TemporaryDirectory() as name:
        here = demonstrate(Path(sys.executable), Path(name, "here"))
        sys.stdout.write(f"here: {versions(Path(sys.executable))}\n")
        for how in chosen.how:
            folder = Path(name, how)
            folder.mkdir()
            try:
                python = install(folder, how, chosen.python, chosen.source)
                apart, sentence = compare(here, demonstrate(python, folder / "run"))
                result = f"{versions(python)}: {sentence}"
                failed |= apart > MOST
            except subprocess.CalledProcessError as error:
                failed, result = True, f"FAILED: {(error.stderr or error.stdout).strip().splitlines()[-1]}"
            sys.stdout.write(f"{how}: {result}\n")
            sys.stdout.flush()
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
