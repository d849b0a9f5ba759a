"""Files that users reported, through every command that reads them: a table of what each command makes of it.

Usage: ``python tests/studies/reported_cases.py [WORD] [--table]``; the files are those of ``shared/data/cases`` beside
the checkout. `WORD` restricts the rows to those that contain it; ``--table`` prints the table of ``docs/formats.md``.
"""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from railfix.cli import app
from railfix.core.geodesy import geodetic_from_ecef

#: Where the antenna of base.rnx is (ECEF) [m].
STATION_ECEF_M = np.array([3516213.4380, 781859.8595, 5246037.9660])
#: Commands that read a log of observations; ``{log}``, ``{nav}``, ``{line}`` and ``{out}`` are replaced.
LOG_COMMANDS = {
    "locate": "locate --log {log} --nav {nav} --out {out}/place.pos --overwrite",
    "convert": "convert {log} --out {out}/log.obs --overwrite",
    "run": "run --front {log} --nav {nav} --track {line} --set filter=off --out {out}/run --overwrite",
    "which-track": "which-track --front {log} --nav {nav} --map {line}",
    "doctor": "doctor {log} {nav} {line}",
}
#: The recording on the line of the newcomers' maps.
_RUN = "kinematic/japan_mosaic_2021265_with_GEONET3034"
#: Commands that read a track map, with the options that state its heights.
MAP_COMMANDS = {
    "check": "map check {map} {heights}",
    "network": "map network {map} {heights}",
    "doctor": "doctor {map}",
    "route": "map route {map} {heights} --out {out}/route.csv --overwrite",
    "match": f"map match {{map}} {{heights}} --log {_RUN}/rtklib_rtk_ref_l1_GE.pos --out {{out}}/m.csv --overwrite",
    "run": f"run --front {_RUN}/SEPT265G.21O --nav {_RUN}/SEPT2650.21P --track {{map}} {{heights}} --out {{out}}/run "
    "--overwrite",
}


@dataclass(frozen=True)
class Row:
    """One file through one command: exit code, and an expression that the output contains."""

    file: str
    command: str
    words: str
    exit_code: int | tuple[int, ...]
    expected: str


def _log_rows() -> Iterator[Row]:
    epochs = {
        "base.rnx": 8, "code-1km-off-G18.rnx": 8, "code-200m-off-G16.rnx": 8, "comment-in-data.rnx": 8,
        "two-files-joined.rnx": 8, "cut-last-line.rnx": 7, "time-system-one-column-off.rnx": 8,
    }  # fmt: skip
    notes = {
        "cut-last-line.rnx": "file ends in the middle of an epoch",
        "two-files-joined.rnx": "a further header begins here",
        "time-system-one-column-off.rnx": "TIME OF FIRST OBS is not in its columns",
    }
    for name, n in epochs.items():
        note = notes.get(name, "")
        for command, words in LOG_COMMANDS.items():
            texts = {
                "locate": f"{n} epochs, {n} positions.*{note}",
                "convert": rf"{n} epochs, RINEX 3.*{note}",
                "run": f"a position in {n} of {n} epochs.*{note}",
                "which-track": f"track: undecided.*{note}",
                "doctor": f"the files fit together.*{n} epochs.*{note}",
            }
            yield Row(name, command, words.replace("{log}", "reports/" + name), 0, texts[command])


def _navigation_rows() -> Iterator[Row]:
    rejected = {
        "orbit-one-galileo.nav": r"1 record of Galileo rejected \(E03\)",
        "orbit-all-galileo.nav": "9 records of Galileo rejected",
        "galileo-type-E.nav": "",
    }
    for name, text in rejected.items():
        for command in ("locate", "run", "which-track", "doctor"):
            words = LOG_COMMANDS[command].replace("{log}", "reports/base.rnx").replace("{nav}", "reports/" + name)
            found = {
                "locate": "8 positions", "run": "a position in 8 of 8", "which-track": "track: undecided",
                "doctor": "the files fit together",
            }  # fmt: skip
            yield Row(name, command, words, 0, f"{found[command]}.*{text}")
    yield Row("galileo-type-E.nav", "doctor", "doctor reports/galileo-type-E.nav", 5, "9 ephemerides: E 9")
    for command, code in (("locate", 3), ("run", 3), ("which-track", 3), ("doctor", 5)):
        words = LOG_COMMANDS[command].replace("{log}", "reports/base.rnx")
        words = words.replace("{nav}", "reports/glonass-xyz-equal.nav")
        yield Row("glonass-xyz-equal.nav", command, words, code, "3 records of GLONASS rejected .R03, R04, R10")


def _position_rows() -> Iterator[Row]:
    expected = {
        "one-2d-fix.nmea": ("12 positions", "1 of 12 fixes have no height"),
        "separation-zero.nmea": ("12 positions", r"separation is 0 in every fix, but the geoid is 50 m"),
        "date-one-day-back.csv": ("8 positions", "line 6: the time goes back by 86,399"),
    }
    line = "reports/line.geojson --height-datum ellipsoidal"
    for name, (count, note) in expected.items():
        yield Row(
            name, "match", f"map match {line} --log reports/{name} --out {{out}}/matched.csv --overwrite", 0,
            f"{count}.* 0 with a probability below 0.9.*{note}",
        )  # fmt: skip
        yield Row(name, "doctor", f"doctor reports/{name}", 5, f"positions.*{count}.*{note}")
        made = f"map from-positions reports/{name} --out {{out}}/made.csv --overwrite"
        backward = name.startswith("date")
        text = "line 6: the time is before that of the preceding position; sort them" if backward else note
        yield Row(name, "from-positions", made, 3 if backward else 0, text)
        along = f"map route {line} --positions reports/{name} --out {{out}}/r.csv --overwrite"
        yield Row(name, "route", along, 0, f"route: T1.*{note}")
        fixed = f"reference --rtk reports/{name} --track {line} --out {{out}}/reference --overwrite"
        # heights that lack the geoid's 50 m are off the line
        good, of_12 = (7, "12 off_height") if name.startswith("sep") else (0, r"\d+ positions, (8|11) good fixes")
        yield Row(name, "reference", fixed, good, f"{of_12}.*{note.replace('1 of 12 fixes have no height', '')}")


def _map_rows() -> Iterator[Row]:
    heights = "--height-datum ellipsoidal"
    read = {
        "null-geometry.geojson": (heights, "10 points", "1 feature 1 without geometry"),
        "zero-length-line.xml": (heights, "points, 890", ""),  # 889.776 m on the grid
        "easting-first.xml": (heights, "points, 890", "easting before northing"),
        "wgs84-egm96.fgb": ("", "12 points", "EGM96"),
    }
    elsewhere = {
        "match": (5, "the map lies 8,?[68]49 km from where"),
        "run": (5, "the track lies 8,?[68][45]. km from"),
    }
    for name, (given, text, note) in read.items():
        words = {"{map}": "reports/" + name, "{heights}": given}
        found = {
            "check": (0, f"{text}.*{note}"), "network": (0, f"1 tracks.*{note}"), "doctor": (5, f"{text}.*{note}"),
            "route": (0, f"{text}.*{note}"), **elsewhere,
        }  # fmt: skip
        for command, (code, expected) in found.items():
            yield _map_row(name, command, words, code, expected)
    flat, grid = (3, "the coordinates have no height"), (4, "nl_nsgi_nlgeo2018.tif, not installed .projsync")
    without = {
        "check": flat, "network": (0, "1 tracks"), "doctor": (5, "without heights"), "route": flat, "run": flat,
        "match": elsewhere["match"],
    }  # fmt: skip
    refused = {
        "zero-heights.geojson": (heights, without),
        "easting-first-no-profile.xml": (heights, without),
        "rd-nap.fgb": ("", dict.fromkeys(without, grid) | {"doctor": (5, "nl_nsgi_nlgeo2018.tif")}),
        "way-of-one-node.osm": (
            "",
            without | {
                "network": (0, "2 tracks.*way/3"), "doctor": (5, "8 points, 708 m.*way/3"),
                "route": (4, "the map has 2 tracks; give --tracks, --via or --positions"),
            },
        ),
    }  # fmt: skip
    for name, (given, rows) in refused.items():
        for command, (code, text) in rows.items():
            yield _map_row(name, command, {"{map}": "reports/" + name, "{heights}": given}, code, text)
    route = "map route reports/easting-first-no-profile.xml --tracks A --heights reports/heights-by-chainage.csv"
    yield Row("heights-by-chainage.csv", "route", f"{route} {heights} --out {{out}}/e.csv", 0, r"890\.1 m")
    made = "map from-positions reports/heights-by-chainage.csv --out {out}/h.csv"
    yield Row("heights-by-chainage.csv", "from-positions", made, 3, "no columns latitude_deg, longitude_deg, height_m")
    yield from _newcomer_rows()


def _newcomer_rows() -> Iterator[Row]:
    """Maps as people have them of the line of a recording, through every command that takes a map, `run` among them."""
    same = {
        "check": (6, "253 points, 1,473.9 m"), "doctor": (5, "253 points, 1,474 m"), "network": (0, "1 tracks, 1.5 km"),
        "route": (0, "253 points, 1,473.9 m"), "match": (0, r"360 positions, 360 on a track \(100.0%\)"),
        "run": (0, "a position in 360 of 360 epochs"),
    }  # fmt: skip
    in_feet = same | {  # heights in feet make slopes steeper
        "check": (6, "253 points, 1,474.3 m"), "route": (0, "253 points, 1,474.3 m"),
        "run": (7, "are the heights of the map in feet"),
    }  # fmt: skip
    order = (3, "turns by more than 90 degrees at 162 of 253 points, which are not in the order of the line")
    shuffled = dict.fromkeys(same, order) | {"check": (6, "direction turns by 17"), "doctor": (5, order[1])}
    maps = {
        "line.kml": same, "names.csv": same, "simple.csv": same, "bom.csv": same, "feet2.csv": in_feet,
        "shuf.csv": shuffled,
    }  # fmt: skip
    for name, expected in maps.items():
        stated = name in ("bom.csv", "feet2.csv", "shuf.csv")
        words = {"{map}": "newcomer/" + name, "{heights}": "" if stated else "--height-datum ellipsoidal"}
        for command, (code, text) in expected.items():
            yield _map_row(name, command, words, code, text)


def _map_row(name: str, command: str, words: dict[str, str], code: int, text: str) -> Row:
    line = MAP_COMMANDS[command]
    for old, new in words.items():
        line = line.replace(old, new)
    return Row(name, command, line, code, text)


def _frame_and_network_rows() -> Iterator[Row]:
    """Older datums by a named operation; the same rows as CSV and .pos; heights, cant, topology and features."""
    heights = "--height-datum ellipsoidal"
    datums = {
        "ed50_bergen": "ED50 to WGS 84 .7.' .accuracy 7 m", "ed50_rome": "ED50 to WGS 84 .1.' .accuracy 10 m",
        "s42_83_prague": r"1942.83. to WGS 84 .5.' .accuracy 5 m", "agd66_nsw": "AGD66 to WGS 84 .13.' .accuracy 3 m",
        "s42_83_budapest": "1942.83. to WGS 84 .3.' .accuracy 4 m",
    }  # fmt: skip
    for name, operation in datums.items():
        for command, code in (("check", 0), ("network", 0), ("doctor", 5)):
            words = {"{map}": f"maps/{name}.geojson", "{heights}": heights}
            yield _map_row(f"{name}.geojson", command, words, code, operation)
    matches = {
        ("ed50_two_lines", "ed50_log.csv"): "0 with a probability below 0.9.*accuracy 10 m.*10.0 m is taken",
        **dict.fromkeys([("par", "s8.csv"), ("par", "s8.pos")], "200 with a probability below 0.9"),
        **dict.fromkeys([("lev", f"{log}.{kind}") for log in ("h0", "h4") for kind in ("csv", "pos")],
                        "200 on a track.* 0 with a probability below 0.9"),
    }  # fmt: skip
    for (name, log), text in matches.items():
        words = f"map match maps/{name}.geojson {heights} --log maps/{log} --out {{out}}/m.csv --overwrite"
        yield Row(log, "match", words, 0, text)
    yield Row("signedcant.csv", "check", "map check maps/signedcant.csv", 6, "cant")
    yield Row(
        "osm_layer.osm", "network", "map network maps/osm_layer.osm", 0, "2 tracks.* 0 switches.*2 separate parts"
    )
    yield Row("slip.osm", "network", "map network maps/slip.osm", 0, "4 tracks.* 4 switches.*1 separate part")
    for name in ("features_5m.csv", "features_20m.csv"):  # radii of 1,500 m, no change of curvature by 1/1000 m
        yield Row(name, "features", f"map features maps/{name} --out {{out}}/f.csv --overwrite", 0, r"\b0 features")


def _receiver_rows() -> Iterator[Row]:
    log = "reports/three-epochs.rtcm3"
    words = f"convert {log} --out {{out}}/q.rnx --nav-out {{out}}/q.nav --overwrite"
    yield Row("three-epochs.rtcm3", "convert", words, 0, "4 epochs.*8 ephemerides")
    contradicted = "its ephemerides are of 2024-08-18, the date given .--date. is 2024-06-01"
    yield Row("three-epochs.rtcm3", "convert --date", f"{words} --date 2024-06-01", 5, contradicted)
    located = f"locate --log {log} --out {{out}}/r.pos --overwrite"
    yield Row("three-epochs.rtcm3", "locate", located, 7, "2 no valid and healthy navigation record")
    yield Row("three-epochs.rtcm3", "doctor", f"doctor {log}", 5, "2024-08-18 21:14:25.*8 ephemerides inside")
    which = f"which-track --front {log} --nav {log} --map {{line}}"
    yield Row("three-epochs.rtcm3", "which-track", which, 7, "the log has no position")
    ran = f"run --front {log} --track {{line}} --out {{out}}/run --overwrite"
    yield Row("three-epochs.rtcm3", "run", ran, 7, "a position in 0 of 4 epochs")


def list_rows() -> list[Row]:
    """Return all rows."""
    return [
        *_log_rows(),
        *_navigation_rows(),
        *_position_rows(),
        *_map_rows(),
        *_frame_and_network_rows(),
        *_receiver_rows(),
    ]


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
    for word in row.words.replace("{nav}", "reports/base.nav").split():
        word = word.replace("{out}", str(out)).replace("{line}", str(line))
        folder = cases.parent if word.startswith("kinematic/") else cases
        words.append(str(folder / word) if re.match("(reports|newcomer|maps|kinematic)/", word) else word)
    result = CliRunner(env={"COLUMNS": "500"}).invoke(app, words)
    text = " ".join(f"{result.stdout} {result.stderr}".split())
    codes = (row.exit_code,) if isinstance(row.exit_code, int) else row.exit_code
    broken = result.exception is not None and not isinstance(result.exception, SystemExit)
    right = not broken and result.exit_code in codes and re.search(row.expected, text) is not None
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
