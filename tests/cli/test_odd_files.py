"""Files in odd forms, each through every command that takes such a file: read alike, or refused with one sentence.

``python tests/cli/test_odd_files.py [COUNT] [FIRST]`` prints what became of each.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from typer.testing import CliRunner

from bad_inputs import Desk, desk_in
from odd_files import OddFile, write_odd_file
from railfix.cli import app
from railfix.core.geodesy import geodetic_from_ecef

pytestmark = pytest.mark.requirement("G5")

#: Epochs and rows of the good files.
EPOCHS = 20
#: What doctor calls the files of each kind.
KINDS = {
    "observations": "observations", "navigation": "navigation", "positions": "positions", "nmea": "positions",
    "rtklib": "positions", "gpx": "positions", "track": "track", "kml": "track", "geojson": "track",
}  # fmt: skip


@dataclass(frozen=True)
class Said:
    """What a command said: its exit code, standard output and standard error."""

    code: int
    out: str
    error: str


def say(*words: object) -> Said:
    """Run a command; a traceback is an error of the test."""
    result = CliRunner(env={"COLUMNS": "500"}).invoke(app, [str(word) for word in words])
    assert result.exception is None or isinstance(result.exception, SystemExit), (words, result.exception)
    assert result.exit_code not in (1, 2), (words, result.stderr)
    if result.exit_code and words[0] != "doctor":
        assert result.stderr.startswith("railfix: error: "), (words, result.stderr)
        assert result.stderr.count("\n") == 1, (words, result.stderr)
    return Said(result.exit_code, result.stdout, result.stderr)


def examine(path: Path, *others: Path) -> dict[str, Any]:
    """Return what doctor says of the first of some files, with its problems."""
    said = say("doctor", path, *others, "--json")
    assert said.code in (0, 5)
    found = json.loads(said.out)
    finding: dict[str, Any] = found["files"][0]
    finding["problems"] = [text for text in found["problems"] if str(path) in text]
    return finding


def number(text: str, word: str) -> int:
    """Return the number before a word."""
    return int(text.split(f" {word}")[0].split()[-1].replace(",", ""))


@dataclass(frozen=True)
class Bench:
    """Good files beside an odd one, and a folder for results."""

    desk: Path
    out: Path

    def commands(self, kind: str, path: Path) -> dict[str, list[object]]:
        """Return the commands that take a file of a kind."""
        nav, line, log = (self.desk / name for name in ("brdc.nav", "line.csv", "front.obs"))
        log, nav = (path, nav) if kind == "observations" else (log, path if kind == "navigation" else nav)
        line = path if KINDS[kind] == "track" else line
        run = ["run", "--front", log, "--nav", nav, "--set", "filter=off", "--out", self.out / "r", "--overwrite"]
        locate = ["locate", "--log", log, "--nav", nav, "--out", self.out / "p.pos", "--overwrite", "--json"]
        convert = ["convert", log, "--out", self.out / "c.obs", "--overwrite"]
        positions = path if KINDS[kind] == "positions" else self.desk / "rtk.csv"
        match = ["map", "match", line, "--log", positions, "--out", self.out / "m.csv", "--overwrite"]
        made = ["map", "from-positions", path, "--out", self.out / "f.csv", "--overwrite"]
        written = ["convert", path, "--nav-out", self.out / "c.nav", "--overwrite"]
        maps = {"check": ["map", "check", line], "network": ["map", "network", line], "match": match}
        commands: dict[str, dict[str, list[object]]] = {
            "observations": {"locate": locate, "convert": convert, "run": [*run, "--track", line]},
            "navigation": {"locate": locate, "convert": written, "run": [*run, "--track", line]},
            "positions": {"match": match, "from-positions": made},
            "track": {**maps, "run": [*run, "--track", line]},
        }
        return commands[KINDS[kind]]


def check(kind: str, odd: OddFile, bench: Bench) -> str:
    """Check that the commands agree on a file, and return what they made of it, in a word.

    A file that doctor can use is read by every command with the options that doctor names, to the same number of rows;
    another exit code than 0 needs a problem that doctor has named, too. A file that doctor cannot use is refused by
    every command.
    """
    wanted = KINDS[kind]
    others = [bench.desk / name for name in ("front.obs", "brdc.nav", "line.csv")]
    others.pop({"observations": 0, "navigation": 1, "track": 2}.get(wanted, 0))
    found = examine(odd.path, *others)
    usable = found["kind"] == wanted and found["facts"] != []
    options = found["options"]
    faults = [text for text in found["problems"] if "does not state its height datum" not in text]
    counts: dict[str, int] = {}
    for name, words in bench.commands(kind, odd.path).items():
        if "--lenient" in options:
            strict = say(*words)
            assert strict.code == 3, (name, strict)
            assert "--lenient" in strict.error, (name, strict)
            assert odd.path.name in strict.error, (name, strict)
        of_run = ("--heights", "log") if "--heights" in options else ()
        said = say(*words, *([word for word in options if word not in of_run] if name != "run" else options))
        if not usable:
            assert said.code in (3, 4, 5, 7), (name, said, found)
            assert odd.path.name.split(".")[0] in said.error, (name, said, found)
            continue
        if of_run and name == "check":  # the heights are a part of what is checked
            assert (said.code, "--heights" in said.error) == (3, True), (name, said)
            continue
        # no map is made of positions in no order of time, which doctor notes, nor of those of a train that stands
        unordered = any("the time goes back" in fact for fact in found["facts"]) or "standing still" in said.error
        no_line = name == "from-positions" and said.code in (3, 7) and unordered
        assert said.code == 0 or faults or no_line, (name, said, found)
        assert not (name == "check" and faults) or said.code == 6, (name, said, found)
        if said.code == 0:
            counts |= _count(kind, name, said)
    if "check" in counts:  # which shows the points that the others read once
        counts["check"] -= sum(number(fact, "repeated point") for fact in found["facts"] if "repeated point" in fact)
    if usable:
        counts["doctor"] = int(found["facts"][0].split()[0].replace(",", ""))
        assert len(set(counts.values())) <= 1, counts
    if not usable and "-v" in sys.argv:
        print(kind, odd.forms, found["problems"])
    return "lenient" if "--lenient" in options else "read" if usable else "refused"


def _count(kind: str, name: str, said: Said) -> dict[str, int]:
    """Return the number of epochs, ephemerides, rows or points that a command read, by its name."""
    words = {"convert": "ephemerides" if kind == "navigation" else "epochs", "check": "points"}
    if name in ("run", "network") or (name == "locate" and kind == "navigation"):
        return {}
    if name == "match" and KINDS[kind] == "track":
        return {}
    if name == "locate":
        return {name: json.loads(said.out)["epochs"]}
    return {name: number(said.out, words.get(name, "positions"))}


def write_good_files(desk: Path) -> dict[str, bytes]:
    """Return good files by kind: those of the desk, short."""
    text = (desk / "front.obs").read_text().splitlines(keepends=True)
    starts = [k for k, line in enumerate(text) if line.startswith(">")]
    rows = pl.read_csv(desk / "rtk.csv").gather_every(10).head(EPOCHS)
    latitude, longitude, height = geodetic_from_ecef(rows.select("x_m", "y_m", "z_m").to_numpy())
    table = rows.select("time_gpst", latitude_deg=latitude, longitude_deg=longitude, height_m=height)
    track = [line for line in (desk / "line.csv").read_text().splitlines(keepends=True) if not line.startswith("#")]
    positions = (desk / "rtk.pos").read_text().splitlines(keepends=True)
    return {
        "observations": "".join(text[: starts[EPOCHS]]).encode(),
        "navigation": (desk / "brdc.nav").read_bytes(),
        "positions": table.write_csv().encode(),
        "nmea": "".join(_sentences(table)).encode(),
        "rtklib": "".join(positions[k] for k in (0, *range(1, 10 * EPOCHS, 10))).encode(),
        "gpx": _gpx(table).encode(),
        "track": "".join(track).encode(),
        "kml": _kml(desk / "line.csv").encode(),
        "geojson": (desk / "line.geojson").read_text().replace("[[", "[\n[").replace("], [", "],\n[").encode(),
    }


def _gpx(table: pl.DataFrame) -> str:
    """Return positions as the points of a GPX track, a line each."""
    points = "".join(
        f'<trkpt lat="{latitude:.9f}" lon="{longitude:.9f}"><ele>{height:.3f}</ele><time>{time[:23]}Z</time></trkpt>\n'
        for time, latitude, longitude, height in table.iter_rows()
    )
    head = (
        '<?xml version="1.0"?>\n<gpx version="1.1" creator="t" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
    )
    return f"{head}\n{points}</trkseg></trk></gpx>\n"


def _kml(track: Path) -> str:
    """Return a track map as KML, a line a point."""
    rows = pl.read_csv(track, comment_prefix="#").select("longitude_deg", "latitude_deg", "height_m")
    points = "".join(f"{x:.9f},{y:.9f},{z:.3f}\n" for x, y, z in rows.iter_rows())
    return (
        '<?xml version="1.0"?>\n<kml xmlns="http://www.opengis.net/kml/2.2">\n<Document>\n'
        "<Placemark><name>line</name>\n<LineString><altitudeMode>absolute</altitudeMode><coordinates>\n"
        f"{points}</coordinates></LineString></Placemark>\n</Document></kml>\n"
    )


def _sentences(table: pl.DataFrame) -> list[str]:
    """Return GGA and RMC of each row."""
    lines = []
    for time, latitude, longitude, height in table.iter_rows():
        clock, place = time[11:19].replace(":", "") + ".00", []
        for value, width, sides in ((latitude, 2, "NS"), (longitude, 3, "EW")):
            whole = int(abs(value))
            place.append(f"{whole:0{width}d}{(abs(value) - whole) * 60:010.7f},{sides[value < 0]}")
        for body in (
            f"GPGGA,{clock},{place[0]},{place[1]},4,12,0.8,{height - 37.0:.3f},M,37.000,M,,",
            f"GPRMC,{clock},A,{place[0]},{place[1]},0.0,0.0,{time[8:10]}{time[5:7]}{time[2:4]},,,A",
        ):
            total = 0
            for letter in body.encode():
                total ^= letter
            lines.append(f"${body}*{total:02X}\n")
    return lines


@pytest.fixture(scope="module")
def good_files(good: Desk) -> dict[str, bytes]:
    return write_good_files(good.folder)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [*range(2), *(pytest.param(k, marks=pytest.mark.slow) for k in range(2, 56))])
def test_commands_agree_on_odd_files(
    good: Desk, good_files: dict[str, bytes], kind: str, seed: int, tmp_path: Path
) -> None:
    odd = write_odd_file(kind, good_files[kind], tmp_path / "in", seed)
    check(kind, odd, Bench(good.folder, tmp_path))


def main() -> None:
    count, first = (int(word) for word in (*sys.argv[1:3], *("100", "0")[len(sys.argv) - 1 :]))
    outcomes: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        (folder / "desk").mkdir()
        desk = desk_in(folder / "desk")
        good = write_good_files(desk.folder)
        for seed in range(first, first + count):
            for kind in KINDS:
                odd = write_odd_file(kind, good[kind], folder / f"{kind}-{seed}", seed)
                (folder / "out").mkdir(exist_ok=True)
                try:
                    outcome = check(kind, odd, Bench(desk.folder, folder / "out"))
                except AssertionError as error:
                    outcome = "CONTRADICTION"
                    print(f"{kind} {seed} {', '.join(odd.forms)}: {str(error)[:1500]}", flush=True)
                outcomes[f"{kind}: {outcome}"] += 1
    for what, n in sorted(outcomes.items()):
        print(f"{n:5d} {what}")


if __name__ == "__main__":
    main()
