"""Cases of ``railfix benchmark`` from the recordings beside the checkout, and the page of their results.

``python tests/studies/benchmark_cases.py CASES`` makes a folder of each recording: log, navigation, ground truth, and
the map made from it (5 m, standing still removed). ``railfix demo --real --out CASES`` adds the
held-out case. ``python tests/studies/benchmark_cases.py CASES --page OUT`` runs the benchmark into OUT and writes
``docs/benchmarks.md``.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any, Final

import paths
import belief_campaign
import recordings_truth
from railfix.evaluate.cases import write_case
from railfix.track import from_positions
from railfix.track.point_files import write_track_csv

PAGE: Final = paths.ROOT / "docs" / "benchmarks.md"
#: Heading of the section of the page that is written.
HEADING: Final = "## Recordings: railfix, RTKLIB and 3-D positions"
#: What is known of each recording.
ABOUT: Final[dict[str, dict[str, Any]]] = tomllib.loads(
    (paths.ROOT / "tests" / "references" / "recordings.toml").read_text(encoding="utf-8")
)
_TEXT: Final = """{heading}

`{command}` on {date}, commit `{commit}`: cars with a satellite receiver,
the map made from the ground truth, every setting at its default. [How to](how-to.md#compare-with-other-programs).

- Errors are in metres along the line; *wrong*: errors above 50 m. *Over level*: without an alarm, where railfix had
  raised an alarm or a doubt, and hazardously misleading.
- Performance features of EN 16803-1: availability (rate, level in limit), accuracy (errors, wrong, error/sigma),
  integrity (over level), continuity (15 s), TTFF (first).
- *RTKLIB* is the single point of `rnx2rtkp` with the same mask and constellations, moved to the nearest point of the
  line; *3-D* is railfix's conventional position. OUT/benchmark.md has straight distances too.
- *Held out*: used by no test and in no choice of settings (`railfix demo --real --out CASES`);
  the other recordings were seen during development.

{table}{notes}"""
#: Columns of the page: head, and the columns of benchmark.md whose cells it joins.
_COLUMNS: Final = (
    ("rate %", (3,)),
    ("p50, p95, largest", (4, 5, 6)),
    ("wrong", (10,)),
    ("error/sigma p95", (11,)),
    ("over level", (12, 13, 14)),
    ("level in limit, 15 s %", (15, 16)),
    ("first s", (17,)),
)
_POSITIONS: Final = {"filter": "filter", "epochs": "single epochs", "3-D": "3-D", "RTKLIB": "RTKLIB"}


def page_table(table: str) -> str:
    """Table of the page from that of ``benchmark.md``: fewer columns, cells joined, a case and its epochs once."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[3:]]
    heads = ["case", "position", *(head for head, _ in _COLUMNS)]
    lines, before = [heads, ["---"] * len(heads)], ""
    for row in rows:
        case = f"{row[0]}, {row[2]} epochs" if row[0] != before else ""
        position = next(name for key, name in _POSITIONS.items() if key in row[1])
        cells = ([row[k] for k in columns] for _, columns in _COLUMNS)
        lines.append([case, position, *("" if {*cell} == {"-"} else ", ".join(cell) for cell in cells)])
        before = row[0]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def make_cases(folder: Path) -> None:
    """Write a case of every recording beside the checkout."""
    for name, recording in belief_campaign.recordings(paths.DATA).items():
        case = folder / name
        case.mkdir(parents=True, exist_ok=True)
        for path in (recording.log, *recording.nav):
            shutil.copyfile(path, case / path.name)
        time, ecef = recording.truth()
        recordings_truth.write_truth_csv((time, ecef), case / "truth.csv")
        write_track_csv(from_positions(time, ecef, spacing_m=5.0), case / "track.csv")
        files = {"front": [recording.log.name], "nav": [path.name for path in recording.nav]}
        files |= {"track": ["track.csv"], "truth": "truth.csv"}
        write_case(case, {**ABOUT[name], "held_out": False, "files": files})


def write_page(cases: Path, out: Path) -> None:
    """Run the benchmark and write the page of its results."""
    subprocess.run([sys.executable, "-m", "railfix", "benchmark", cases, "--out", out, "--workers", "1"], check=True)
    record = json.loads((out / "benchmark.json").read_text())
    told = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=paths.ROOT)
    text = _TEXT.format(
        heading=HEADING,
        command="python tests/studies/benchmark_cases.py CASES --page OUT",
        date=record["date"][:10],
        commit=told.stdout.strip(),
        table=page_table((out / "benchmark.md").read_text()),
        notes="".join(f"\n- {note}" for note in record["notes"]),
    )
    before, _, after = PAGE.read_text(encoding="utf-8").partition(HEADING)
    rest = re.split(r"^(?=## )", after, maxsplit=1, flags=re.MULTILINE)[1:]
    PAGE.write_text(before + "\n".join([text.rstrip() + "\n", *rest]), encoding="utf-8")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--page", type=Path, metavar="OUT", help="run the benchmark and write the page")
    args = parser.parse_args()
    if args.page is None:
        make_cases(args.cases)
    else:
        write_page(args.cases, args.page)
    return 0


if __name__ == "__main__":
    sys.exit(main())
