"""Broken track maps, vehicles, settings and outputs."""

from __future__ import annotations

import json
import math
import random
from typing import Any

from broken_bench import INPUT, MISMATCH, OUTPUT, Bench, broken

Options = dict[str, Any]


def track_lines(bench: Bench) -> tuple[list[str], list[list[str]]]:
    """Comments with the header line, and the cells of the rows."""
    lines = bench.track.read_text().splitlines()
    at = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    return lines[: at + 1], [line.split(",") for line in lines[at + 1 :]]


def write_track(bench: Bench, head: list[str], rows: list[list[str]]) -> Options:
    bench.track.write_text("\n".join([*head, *(",".join(row) for row in rows)]) + "\n")
    return {"track": bench.track}


def geojson(bench: Bench, geometry: dict[str, Any], **members: Any) -> Options:
    return {"track": bench.write("line.geojson", json.dumps({"type": "Feature", "geometry": geometry} | members))}


# --- track maps --------------------------------------------------------------------------------


@broken(INPUT, "random.csv")
def track_binary(bench: Bench) -> Options:
    return {"track": bench.write("random.csv", random.Random(3).randbytes(3000))}


@broken(INPUT, "obs.csv")
def track_is_observations_under_another_name(bench: Bench) -> Options:
    return {"track": bench.write("obs.csv", bench.front.read_bytes())}


@broken(INPUT, "line.csv", "swapped")
def track_with_degrees_swapped(bench: Bench) -> Options:
    head, rows = track_lines(bench)
    return write_track(bench, head, [[row[1], row[0], *row[2:]] for row in rows])


@broken(INPUT, "line.csv", "radians")
def track_in_radians(bench: Bench) -> Options:
    head, rows = track_lines(bench)
    in_radians = [[repr(math.radians(float(c))) for c in row[:2]] + row[2:] for row in rows]
    return write_track(bench, head, in_radians)


@broken(MISMATCH, "km", "track")
def track_of_another_country(bench: Bench) -> Options:
    head, rows = track_lines(bench)
    return write_track(bench, head, [[row[0], str(float(row[1]) - 120.0), *row[2:]] for row in rows])


@broken(INPUT, "line.csv", "line")
def track_with_nan(bench: Bench) -> Options:
    head, rows = track_lines(bench)
    rows[20][2] = "nan"
    return write_track(bench, head, rows)


@broken(INPUT, "line.csv", "line")
def track_with_an_empty_coordinate(bench: Bench) -> Options:
    head, rows = track_lines(bench)
    rows[20][0] = ""
    return write_track(bench, head, rows)


@broken(INPUT, "line.csv", "line")
def track_with_letters_for_a_number(bench: Bench) -> Options:
    head, rows = track_lines(bench)
    rows[20][1] = "135,45E"
    return write_track(bench, head, rows)


@broken(INPUT, "line.csv", "line")
def track_with_a_short_row(bench: Bench) -> Options:
    head, rows = track_lines(bench)
    rows[20] = rows[20][:2]
    return write_track(bench, head, rows)


@broken(INPUT, "line.csv", "height_m")
def track_without_heights(bench: Bench) -> Options:
    head, rows = track_lines(bench)
    place = head[-1].split(",").index("height_m")
    head[-1] = ",".join(name for i, name in enumerate(head[-1].split(",")) if i != place)
    return write_track(bench, head, [[cell for i, cell in enumerate(row) if i != place] for row in rows])


@broken(INPUT, "far.csv")
def track_with_a_gap_between_segments(bench: Bench) -> Options:
    head, rows = track_lines(bench)
    far = [[str(float(row[0]) + 0.5), *row[1:]] for row in rows]
    text = "\n".join([*head, *(",".join(row) for row in far)]) + "\n"
    return {"track": [bench.track, bench.write("far.csv", text)]}


# --- vehicles ----------------------------------------------------------------------------------


# --- settings ----------------------------------------------------------------------------------


@broken(INPUT, "settings.toml")
def settings_binary(bench: Bench) -> Options:
    return {"config": bench.write("settings.toml", random.Random(4).randbytes(200))}


# --- outputs -----------------------------------------------------------------------------------


@broken(OUTPUT, "results", "--overwrite")
def output_with_results_in_it(bench: Bench) -> Options:
    bench.out.mkdir()
    (bench.out / "run.json").write_text("{}")
    return {}
