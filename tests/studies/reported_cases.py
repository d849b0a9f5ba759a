"""Files that users reported, through every command that reads them: a table of what each command makes of it.

Usage: ``python tests/studies/reported_cases.py [WORD] [--table]``; the files are those of ``shared/data/cases`` beside
the checkout. `WORD` restricts the rows to those that contain it; ``--table`` prints the table of ``docs/formats.md``.
"""

from __future__ import annotations

import re
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from railfix.cli import app
from railfix.core.geodesy import geodetic_from_ecef

#: Where the antenna of base.rnx is (ECEF) [m].
STATION_ECEF_M = np.array([3516213.4380, 781859.8595, 5246037.9660])
#: Command lines by kind of file, and what has to come of each file.
CASES = tomllib.loads((Path(__file__).parents[1] / "references" / "reported_cases.toml").read_text(encoding="utf-8"))


@dataclass(frozen=True)
class Row:
    """One file through one command: exit code, and an expression that the output contains."""

    file: str
    command: str
    words: str
    exit_code: int
    expected: str


def list_rows() -> list[Row]:
    """Return all rows."""
    rows = []
    for case in CASES["cases"]:
        for file in case["files"]:
            for command, code, expected, *own in case["rows"]:
                words = own[0] if own else CASES["commands"][case["kind"]][command]
                rows.append(Row(Path(file).name, command, words.replace("{file}", file), code, expected))
    return rows


def write_line(path: Path) -> Path:
    """Write a track map of 400 m through the station of base.rnx."""
    latitude, longitude, height = (float(value) for value in geodetic_from_ecef(STATION_ECEF_M))
    rows = [f"{latitude:.9f},{longitude + k * 1e-4:.9f},{height:.3f}" for k in range(-32, 33)]
    path.write_text("# sigma_plan_m: 0.3\nlatitude_deg,longitude_deg,height_m\n" + "\n".join(rows) + "\n")
    return path


def run_row(row: Row, cases: Path, out: Path) -> tuple[bool, int, str]:
    """Run one row: whether it is as expected, the exit code, and what was printed, in one line."""
    line = write_line(out / "line.csv")
    words = []
    for word in row.words.split():
        word = word.replace("{out}", str(out)).replace("{line}", str(line))
        folder = cases.parent if word.startswith("kinematic/") else cases
        words.append(str(folder / word) if re.match("(reports|newcomer|maps|kinematic)/", word) else word)
    result = CliRunner(env={"COLUMNS": "500"}).invoke(app, words)
    text = " ".join(f"{result.stdout} {result.stderr}".split())
    broken = result.exception is not None and not isinstance(result.exception, SystemExit)
    right = not broken and result.exit_code == row.exit_code and re.search(row.expected, text) is not None
    return right, result.exit_code, f"{result.exception!r}" if broken else text


def station_error_m(path: Path) -> float:
    """Return the largest distance of positions in a file from the station of base.rnx [m]."""
    from railfix.io.positions import read_positions

    return float(np.linalg.norm(read_positions(path).ecef_m - STATION_ECEF_M, axis=1).max())


def print_table(rows: list[tuple[Row, bool, int]]) -> None:
    """Print the exit code of each file by command, and in bold those that are not right."""
    commands = list(dict.fromkeys(row.command for row, _, _ in rows))
    print("| file | " + " | ".join(commands) + " |")
    print("| --- |" + " ---: |" * len(commands))
    for file in dict.fromkeys(row.file for row, _, _ in rows):
        codes = {row.command: str(code) if right else f"**{code}**" for row, right, code in rows if row.file == file}
        print(f"| `{file}` | " + " | ".join(codes.get(command, "") for command in commands) + " |")


def main() -> None:
    cases = Path(__file__).resolve().parents[3] / "shared" / "data" / "cases"
    wanted = next((word for word in sys.argv[1:] if not word.startswith("-")), "")
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for row in list_rows():
            if wanted not in f"{row.file} {row.command}":
                continue
            right, code, text = run_row(row, cases, Path(folder))
            found.append((row, right, code))
            if "--table" in sys.argv:
                continue
            located = row.command == "locate" and not code
            error = f"{station_error_m(Path(folder) / 'place.pos'):5.1f} m off" if located else ""
            print(f"{'right' if right else 'WRONG'}  {row.file:32} {row.command:16} rc {code}  {error}")
            if not right:
                print(f"       expected {row.exit_code} {row.expected}\n       printed {text[:600]}")
    if "--table" in sys.argv:
        print_table(found)
    print(f"{len(found)} rows, {sum(not right for _, right, _ in found)} wrong", file=sys.stderr)


if __name__ == "__main__":
    main()
