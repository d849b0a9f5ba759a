"""The traceability table: which test proves which row of the requirements.

The rows stand here in the project's own words; the tests name the row they prove with
``@pytest.mark.requirement("A7")``, on a function, a class, or a whole file (``pytestmark``).
``python tests/studies/traceability.py`` writes ``docs/traceability.md``; a test holds that it is up to date.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import paths

TABLE: Final = paths.ROOT / "docs" / "traceability.md"

#: Rows of the requirements: heading, then row and what it asks for.
ROWS: Final[dict[str, dict[str, str]]] = {
    "Positioning on the track map": {
        "A1": "3-D track map from several formats, with curve attributes, height datum, routes and a quality report",
        "A2": "path of the roof antenna from two bogie centres and the cant, or straight from good positions",
        "A3": "section search without the receiver clock; ambiguous places are reported",
        "A4": "one-dimensional constrained least squares: place along the section and receiver clocks",
        "A5": "carrier phase beside code in the constrained model",
        "A6": "conventional position (3-D single point, nearest point of the trajectory) as the yardstick",
        "A7": "RINEX 2, 3, 4 observations and navigation of five systems, plain or packed, and SP3",
        "A8": "live epoch processor at 10 Hz with the code of the batch; receiver streams in, messages out",
        "A9": "reference frames and epochs of maps: ETRS89, JGD2011, NAD83(2011), GDA2020, ITRF",
        "A10": "network of tracks with switches; routes over it; positions that name their track",
    },
    "Multipath screens": {
        "B0": "elevation mask, satellite health, age of the ephemeris",
        "B1": "C/N0 against its mean over elevation, and an absolute floor",
        "B2": "change of the pseudorange against the Doppler",
        "B3": "pseudoranges of two antennas against their spacing",
        "B4": "fault detection and exclusion of up to two satellites",
        "B5": "positions of two antennas against their spacing along the track",
        "B6": "chi-square RAIM with detectable bias, slope and protection level",
        "B7": "every rejected observation and every epoch without a position has its reason; the reasons add up",
    },
    "Integrity": {
        "C1": "SBAS messages and corrections",
        "C2": "protection level along the track with a railway error model",
        "C3": "model of the residual multipath and receiver noise from recorded runs",
        "C4": "Stanford diagram on the along-track axis",
        "C6": "level of the filter on every branch, and under a wrong map, wrong Dopplers, phases and codes",
    },
    "Truth and evaluation": {
        "D1": "reference position from RTK, axle pulses, Doppler and acceleration",
        "D2": "figures of merit: signed along-track error, positioning rate, positioning interval",
        "D3": "one report with the pictures of any run, for a browser",
        "D4": "simulator of a train on a track with cant, two antennas and satellites; RINEX and ground truth",
    },
    "On-board sensors": {
        "E1": "pitch, slip and slide, low speed and rolling from inertial sensor and tachometer",
        "E2": "tachometer speed from pulse intervals",
        "E3": "absolute position from gradient and curvature of the line",
        "E4": "millimetre-wave speed and ranging",
        "E5": "one along-track filter that bridges tunnels",
        "E6": "the track a train stands on at start-up, as a probability",
    },
    "Ground side": {
        "F1": "reference triangle of receivers: circles, shape, cause, stop command",
        "F2": "control centre: position reports, timeout, simulated running, resynchronisation",
        "F3": "redundant encrypted links with fail-over",
        "F4": "running intervals: no two occupied ones ever overlap",
        "F5": "routes: position reports set and lock points and signals",
        "F6": "train integrity, length and plausibility of reports; stop of one train and its neighbours",
    },
    "Scale and use": {
        "G1": "campaigns: hundreds of logs on many cores or machines, resumable, one table of results",
        "G2": "notebooks: stages and results as arrays, polars, pandas, xarray; pictures at hand",
    },
}


def _marked_rows(nodes: list[ast.expr]) -> set[str]:
    """Rows named by ``pytest.mark.requirement("A1", ...)`` among expressions."""
    rows: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.List | ast.Tuple):
            rows |= _marked_rows(node.elts)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "pytest.mark.requirement":
            rows |= {str(a.value) for a in node.args if isinstance(a, ast.Constant)}
    return rows


def marked_tests(path: Path) -> Iterator[tuple[str, str]]:
    """Pairs of row and test id of one test file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    of_file: set[str] = set()
    for node in tree.body:
        if isinstance(node, ast.Assign) and any(ast.unparse(t) == "pytestmark" for t in node.targets):
            of_file |= _marked_rows([node.value])

    def walk(body: list[ast.stmt], rows: set[str], prefix: str) -> Iterator[tuple[str, str]]:
        for node in body:
            if isinstance(node, ast.ClassDef) and node.name.startswith("Test"):
                yield from walk(node.body, rows | _marked_rows(node.decorator_list), f"{prefix}{node.name}::")
            elif isinstance(node, ast.FunctionDef) and node.name.startswith("test"):
                for row in sorted(rows | _marked_rows(node.decorator_list)):
                    yield row, f"{prefix}{node.name}"

    yield from walk(tree.body, of_file, f"{path.name}::")


def proofs() -> dict[str, list[str]]:
    """Tests that prove each row, by row."""
    found: dict[str, list[str]] = {}
    for path in sorted((paths.ROOT / "tests").rglob("test_*.py")):
        for row, test in marked_tests(path):
            found.setdefault(row, []).append(test)
    return found


def _cell(tests: list[str]) -> str:
    """Tests by file, or that there are none."""
    names: dict[str, list[str]] = {}
    for test in sorted(set(tests)):
        file, _, name = test.partition("::")
        names.setdefault(file, []).append(name.removeprefix("test_").replace("_", " "))
    return "<br>".join(f"`{file}`: {', '.join(of)}" for file, of in names.items()) or "**open**"


def table() -> str:
    """The document as Markdown."""
    proven = proofs()
    known = {row for rows in ROWS.values() for row in rows}
    unknown = sorted(set(proven) - known)
    if unknown:
        raise ValueError(f"tests name rows that do not exist: {', '.join(unknown)}")
    lines = [
        "# Traceability",
        "",
        "Which test proves which requirement. Written by `python tests/studies/traceability.py` from the markers",
        '`@pytest.mark.requirement("A7")` of the tests (their names without `test_`); a row without a test is open.',
    ]
    for heading, rows in ROWS.items():
        lines += ["", f"## {heading}", "", "| row | requirement | tests |", "|---|---|---|"]
        for row, text in rows.items():
            tests = proven.get(row, [])
            lines.append(f"| {row} | {text} | {_cell(tests)} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Write the table."""
    TABLE.write_text(table(), encoding="utf-8")
    sys.stdout.write(f"{TABLE}: {len(proofs())} rows have tests\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
