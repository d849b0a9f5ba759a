"""Broken track maps, vehicles, settings and outputs."""

from __future__ import annotations

import json
import math
import random
from typing import Any

from broken_bench import INPUT, MISMATCH, NOTHING, OUTPUT, SETTING, Bench, broken

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


POINTS = [[135.45, 35.05, 162.0], [135.451, 35.05, 162.0], [135.452, 35.05, 162.0]]


# --- track maps --------------------------------------------------------------------------------


@broken(INPUT, "absent.csv", "no such file")
def track_missing(bench: Bench) -> Options:
    return {"track": bench.folder / "absent.csv"}


@broken(INPUT, "empty.csv", "empty")
def track_empty(bench: Bench) -> Options:
    return {"track": bench.write("empty.csv", "")}


@broken(INPUT, "random.csv")
def track_binary(bench: Bench) -> Options:
    return {"track": bench.write("random.csv", random.Random(3).randbytes(3000))}


@broken(INPUT, "is a RINEX observation file", "a track map (a table")
def track_is_observations(bench: Bench) -> Options:
    return {"track": bench.front}


@broken(INPUT, "obs.csv")
def track_is_observations_under_another_name(bench: Bench) -> Options:
    return {"track": bench.write("obs.csv", bench.front.read_bytes())}


@broken(INPUT, "rtk.pos", "a track map (a table")
def track_is_positions(bench: Bench) -> Options:
    text = "%  GPST  latitude(deg) longitude(deg) height(m) Q ns\n2026/05/12 03:00:00.000 35.0 135.0 100.0 1 9\n"
    return {"track": bench.write("rtk.pos", text)}


@broken(INPUT, "line.csv", "two")
def track_of_one_point(bench: Bench) -> Options:
    head, rows = track_lines(bench)
    return write_track(bench, head, rows[:1])


@broken(INPUT, "line.csv")
def track_without_points(bench: Bench) -> Options:
    head, _ = track_lines(bench)
    return write_track(bench, head, [])


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


@broken(INPUT, "line.csv", "lattitude_deg")
def track_with_a_misspelt_column(bench: Bench) -> Options:
    return {"track": bench.edit(bench.track, "latitude_deg", "lattitude_deg")}


@broken(INPUT, "line.csv", "height_m")
def track_without_heights(bench: Bench) -> Options:
    head, rows = track_lines(bench)
    place = head[-1].split(",").index("height_m")
    head[-1] = ",".join(name for i, name in enumerate(head[-1].split(",")) if i != place)
    return write_track(bench, head, [[cell for i, cell in enumerate(row) if i != place] for row in rows])


@broken(INPUT, "line.csv")
def track_against_the_datum_asked_for(_: Bench) -> Options:
    return {"height_datum": "orthometric"}


@broken(SETTING, "ellipsoidl")
def track_with_a_misspelt_datum(_: Bench) -> Options:
    return {"height_datum": "ellipsoidl"}


@broken(SETTING, "EPSG:123456789")
def track_with_an_unknown_crs(_: Bench) -> Options:
    return {"crs": "EPSG:123456789"}


@broken(SETTING, "centre", "vehicle")
def chainage_of_a_bogie_without_a_vehicle(_: Bench) -> Options:
    return {"reference": "centre"}


@broken(INPUT, "far.csv")
def track_with_a_gap_between_segments(bench: Bench) -> Options:
    head, rows = track_lines(bench)
    far = [[str(float(row[0]) + 0.5), *row[1:]] for row in rows]
    text = "\n".join([*head, *(",".join(row) for row in far)]) + "\n"
    return {"track": [bench.track, bench.write("far.csv", text)]}


@broken(INPUT, "line.geojson")
def track_of_broken_json(bench: Bench) -> Options:
    return {"track": bench.write("line.geojson", '{"type": "Feature", "geometry": {')}


@broken(INPUT, "line.geojson", "Polygon")
def track_of_a_polygon(bench: Bench) -> Options:
    return geojson(bench, {"type": "Polygon", "coordinates": [[*POINTS, POINTS[0]]]}, height_datum="ellipsoidal")


@broken(INPUT, "line.geojson")
def track_without_the_third_coordinate(bench: Bench) -> Options:
    flat = [point[:2] for point in POINTS]
    return geojson(bench, {"type": "LineString", "coordinates": flat}, height_datum="ellipsoidal")


@broken(INPUT, "line.geojson", "height_datum")
def track_without_a_height_datum(bench: Bench) -> Options:
    return geojson(bench, {"type": "LineString", "coordinates": POINTS})


@broken(INPUT, "line.geojson")
def track_with_text_for_coordinates(bench: Bench) -> Options:
    words = [["one", "two", "three"], ["four", "five", "six"]]
    return geojson(bench, {"type": "LineString", "coordinates": words}, height_datum="ellipsoidal")


# --- vehicles ----------------------------------------------------------------------------------


@broken(INPUT, "absent.toml", "no such file")
def vehicle_missing(bench: Bench) -> Options:
    return {"vehicle": bench.folder / "absent.toml"}


@broken(INPUT, "train.toml", "TOML")
def vehicle_no_toml(bench: Bench) -> Options:
    return {"vehicle": bench.write("train.toml", "bogie_distance_m: 14.4\n")}


@broken(INPUT, "line.csv")
def vehicle_is_the_track(bench: Bench) -> Options:
    return {"vehicle": bench.track}


@broken(SETTING, "train.toml", "bogey_distance_m")
def vehicle_with_a_misspelt_key(bench: Bench) -> Options:
    return {"vehicle": bench.edit(bench.vehicle, "bogie_distance_m", "bogey_distance_m")}


@broken(SETTING, "train.toml", "bogie_distance_m")
def vehicle_with_a_negative_length(bench: Bench) -> Options:
    text = "\n".join(
        "bogie_distance_m = -13.8" if line.startswith("bogie_distance_m") else line
        for line in bench.vehicle.read_text().splitlines()
    )
    return {"vehicle": bench.write("train.toml", text)}


@broken(SETTING, "train.toml", "bogie_distance_m")
def vehicle_with_a_word_for_a_number(bench: Bench) -> Options:
    text = "\n".join(
        'bogie_distance_m = "long"' if line.startswith("bogie_distance_m") else line
        for line in bench.vehicle.read_text().splitlines()
    )
    return {"vehicle": bench.write("train.toml", text)}


@broken(SETTING, "rear")
def vehicle_without_the_rear_antenna(bench: Bench) -> Options:
    text = "bogie_distance_m = 13.8\n[antennas.front]\nalong_m = 9.1\nup_m = 3.95\n"
    return {"vehicle": bench.write("train.toml", text), "rear": bench.rear}


@broken(MISMATCH, "too short")
def vehicle_longer_than_the_track(bench: Bench) -> Options:
    head, rows = track_lines(bench)
    return write_track(bench, head, rows[30:33]) | {"vehicle": bench.vehicle}


# --- settings ----------------------------------------------------------------------------------


@broken(INPUT, "absent.toml", "configuration")
def settings_missing(bench: Bench) -> Options:
    return {"config": bench.folder / "absent.toml"}


@broken(INPUT, "settings.toml", "TOML")
def settings_no_toml(bench: Bench) -> Options:
    return {"config": bench.write("settings.toml", "systems = [G, J\n")}


@broken(INPUT, "settings.toml")
def settings_binary(bench: Bench) -> Options:
    return {"config": bench.write("settings.toml", random.Random(4).randbytes(200))}


@broken(SETTING, "settings.toml", "sytems")
def settings_misspelt(bench: Bench) -> Options:
    return {"config": bench.write("settings.toml", 'sytems = ["G"]\n')}


@broken(SETTING, "settings.toml", "mask")
def settings_misspelt_in_a_group(bench: Bench) -> Options:
    return {"config": bench.write("settings.toml", "[elevation]\nmask = 15\n")}


@broken(SETTING, "settings.toml", "elevation")
def settings_group_given_as_a_number(bench: Bench) -> Options:
    return {"config": bench.write("settings.toml", "elevation = 15\n")}


@broken(SETTING, "settings.toml", "mask_deg")
def settings_out_of_range(bench: Bench) -> Options:
    return {"config": bench.write("settings.toml", "[elevation]\nmask_deg = 120.0\n")}


@broken(SETTING, "settings.toml", "min_satellites")
def settings_of_one_satellite(bench: Bench) -> Options:
    return {"config": bench.write("settings.toml", "min_satellites = 1\n")}


@broken(SETTING, "settings.toml", "min_satellites")
def settings_with_a_word_for_a_number(bench: Bench) -> Options:
    return {"config": bench.write("settings.toml", 'min_satellites = "three"\n')}


@broken(SETTING, "settings.toml", "systems")
def settings_with_an_unknown_constellation(bench: Bench) -> Options:
    return {"config": bench.write("settings.toml", 'systems = ["G", "X"]\n')}


@broken(SETTING, "settings.toml", "systems")
def settings_without_constellations(bench: Bench) -> Options:
    return {"config": bench.write("settings.toml", "systems = []\n")}


@broken(SETTING, "--set", "KEY=VALUE")
def setting_without_a_value(_: Bench) -> Options:
    return {"set": "elevation.mask_deg"}


@broken(SETTING, "elevatoin")
def setting_misspelt(_: Bench) -> Options:
    return {"set": "elevatoin.mask_deg=15"}


@broken(SETTING, "min_satellites")
def setting_of_a_single_one_as_a_group(_: Bench) -> Options:
    return {"set": ["min_satellites=3", "min_satellites.front=4"]}


@broken(SETTING, "off_map_risk")
def setting_out_of_range(_: Bench) -> Options:
    return {"set": "off_map_risk=-5"}


@broken(SETTING, "--start", "--end")
def setting_of_an_end_before_the_start(_: Bench) -> Options:
    return {"start": "2026-05-12T04:00:00", "end": "2026-05-12T03:00:00"}


@broken(NOTHING, "too_few_satellites")
def settings_that_no_epoch_fulfils(_: Bench) -> Options:
    return {"set": "min_satellites=40"}


@broken(NOTHING, "elevation_mask")
def settings_that_refuse_every_satellite(_: Bench) -> Options:
    return {"set": "elevation.mask_deg=89.9"}


# --- outputs -----------------------------------------------------------------------------------


@broken(OUTPUT, "results", "--overwrite")
def output_with_results_in_it(bench: Bench) -> Options:
    bench.out.mkdir()
    (bench.out / "run.json").write_text("{}")
    return {}


@broken(OUTPUT, "results", "folder")
def output_is_a_file(bench: Bench) -> Options:
    return {"out": bench.write("results", "mine")}


@broken(OUTPUT, "below")
def output_below_a_file(bench: Bench) -> Options:
    return {"out": bench.write("notes.txt", "mine") / "below"}


@broken(OUTPUT, "/proc/results")
def output_where_nothing_can_be_made(_: Bench) -> Options:
    return {"out": "/proc/results"}


@broken(OUTPUT, "cannot be written")
def output_with_a_name_too_long(bench: Bench) -> Options:
    return {"out": bench.folder / ("x" * 300)}
