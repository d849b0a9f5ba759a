"""Mistakes of users: files that do not fit, options that make no sense, nonsense that a file states.

Each is what is written into the desk of `bad_inputs`, a command, its exit code and words of its sentence. A file is a
text, or one of the desk with something replaced.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final


@dataclass(frozen=True)
class Edit:
    """A file of the desk in which an expression is replaced, line by line."""

    source: str
    expression: str
    replacement: str | Callable[[re.Match[str]], str]

    def text(self, desk: Path) -> str:
        """Return the text of the edited file; the expression has to be found."""
        text, count = re.subn(self.expression, self.replacement, (desk / self.source).read_text(), flags=re.MULTILINE)
        assert count, f"{self.source} has nothing like {self.expression}"
        return text


def feet(match: re.Match[str]) -> str:
    """Return a point of a map with its height in feet."""
    return f"{match[1]}{float(match[2]) / 0.3048:.4f}{match[3]}"


_LOG: Final = "--front {desk}/front.obs --nav {desk}/brdc.nav"
_RUN: Final = f"run {_LOG} --track {{desk}}/line.csv --out {{out}}"
_TRACK: Final = f"run {_LOG} --track {{desk}}/s.csv --out {{out}}"
_OBS: Final = "run --front {desk}/s.obs --nav {desk}/brdc.nav --track {desk}/line.csv --out {out}"
_VEHICLE: Final = _RUN + " --vehicle {desk}/s.toml"
_EVALUATE: Final = "evaluate {desk}/results --reference {desk}/truth.csv"
_OTHER: Final = "evaluate {desk}/results --reference {desk}/s.csv"
_SECTIONS: Final = _EVALUATE + " --sections {desk}/s.csv"
_EXPLAIN: Final = "explain {desk}/results --at 03:10:05"
_REPORT: Final = "report {desk}/results --out {desk}/s.html"
_MAP: Final = "map from-positions {desk}/s.csv --out {out}.csv"
_WHICH: Final = "which-track --front {desk}/front.obs --nav {desk}/brdc.nav --map {desk}/line.geojson"
_REFERENCE: Final = "reference --rtk {desk}/rtk.csv --track {desk}/line.csv --vehicle {desk}/train.toml --out {out}"
_MODEL: Final = "error-model {desk}/results --reference {desk}/truth.csv --out {out}.toml"
_ABLATE: Final = f"ablate {_LOG} --track {{desk}}/line.csv --out {{out}} --truth {{desk}}/truth.csv"
_COLUMN: Final = " --column time_utc=Moment"
_LIVE: Final = f"live {_LOG} --track {{desk}}/line.csv"
_NETWORK: Final = "map network {desk}/s.geojson"
_CAMPAIGN: Final = "campaign {desk}/s.toml --out {out}"
_HEAD: Final = "latitude_deg,longitude_deg,height_m\n"
_TIMED: Final = "time_gpst,latitude_deg,longitude_deg,height_m\n"
_REST: Final = 'nav = "brdc.nav"\ntrack = ["line.csv"]\n'


def _rows(place: str, first: int = 0, step: int = 1) -> str:
    """Thirty seconds of positions; `k` in `place` is the number of the row."""
    rows = (f"2024-05-01T08:00:{first + step * k:02d},{place.replace('k', f'{k:02d}')}\n" for k in range(30))
    return _TIMED + "".join(rows)


def _feature(geometry: str) -> str:
    features = f'{{"type":"Feature","properties":{{"name":"Track A"}},"geometry":{geometry}}}' if geometry else ""
    return f'{{"type":"FeatureCollection","features":[{features}]}}'


Mistake = tuple[dict[str, str | Edit], str, int, str]
#: By name: the files, the command, its exit code and words of its sentence.
MORE: Final[dict[str, Mistake]] = {
    # -- a run: files given for other ones
    "one_log_twice": ({}, _RUN + " --rear {desk}/front.obs --vehicle {desk}/train.toml", 3, "is given twice"),
    "one_log_in_two_parts": ({}, _RUN + " --front {desk}/front.obs", 3, "is given twice"),
    "one_track_twice": ({}, _RUN + " --track {desk}/line.csv", 3, "is given twice (--track"),
    "navigation_as_log": ({}, _RUN.replace("front.obs", "brdc.nav"), 3, "a RINEX observation file was expected"),
    "table_as_log": ({}, _RUN.replace("front.obs", "truth.csv"), 3, "is a table; a RINEX observation file"),
    "folder_as_log": ({}, _RUN.replace("front.obs", "results"), 3, "is a folder, --front expects a file"),
    "vehicle_as_navigation": ({}, _RUN.replace("brdc.nav", "train.toml"), 3, "is a TOML file; a RINEX navigation"),
    "reference_as_track": ({}, _RUN.replace("line.csv", "truth.csv"), 3, "there is no column 'latitude_deg'"),
    "vehicle_as_curve": ({}, _RUN + " --cn0-curve {desk}/train.toml", 3, "is not a C/N0 curve"),
    "vehicle_as_model": ({}, _RUN + " --error-model {desk}/train.toml", 3, "is not an error model"),
    "vehicle_as_sbas": ({}, _RUN + " --sbas {desk}/train.toml", 3, "begins no SBAS file"),
    "support_missing": ({}, _RUN + " --set integrity_support=no.toml", 3, "check what --set integrity_support names"),
    "base_far_away": (
        {}, _RUN + " --base {desk}/rear.obs --base-place 50,8,100", 5, "km from the line, expected 100 km at most",
    ),
    "place_without_base": ({}, _RUN + " --base-place 35,139,50", 4, "--base-place is given without --base"),
    # -- a run: options
    "end_before_start": (
        {}, _RUN + " --start 2024-03-05T03:10:10 --end 2024-03-05T03:10:05", 4, "give an earlier start",
    ),
    "start_yesterday": ({}, _RUN + " --start yesterday", 2, "is no GPS time such as 2026-05-12"),
    "chunk_of_nothing": ({}, _RUN + " --chunk 0", 4, "--chunk: Input should be greater than or equal to 1"),
    "preset_misspelt": ({}, _RUN + " --preset strikt", 4, "known are default, strict, p1"),
    "screen_misspelt": ({}, _RUN + " --screens elevatoin", 4, "unknown screen 'elevatoin'"),
    "screen_twice": ({}, _RUN + " --screens elevation,elevation", 4, "name each screen once"),
    "filter_on": ({}, _RUN + " --filter on", 2, "is not one of 'track', 'off'"),
    "command_misspelt": ({}, "rnu", 2, "is 'run' meant?"),
    "option_misspelt": ({}, _RUN + " --trak {desk}/line.csv", 2, "No such option: --trak"),
    "setting_without_value": ({}, _RUN + " --set elevation.mask_deg", 4, "expected KEY=VALUE"),
    "setting_unknown": ({}, _RUN + " --set elevation.mask=15", 4, "unknown setting elevation.mask"),
    "setting_for_a_group": ({}, _RUN + " --set elevation=5", 4, "setting elevation"),
    "group_for_a_setting": ({}, _RUN + " --set systems.a=5", 4, "setting systems: Input should be a list"),
    "mask_to_the_zenith": ({}, _RUN + " --set elevation.mask_deg=95", 4, "Input should be less than 90"),
    "mask_of_nan": ({}, _RUN + " --set elevation.mask_deg=nan", 4, "a finite number, got nan"),
    "mask_infinite": ({}, _RUN + " --set elevation.mask_deg=inf", 4, "a finite number, got inf"),
    "constellation_unknown": ({}, _RUN + ' --set systems=["X"]', 4, "'G', 'J', 'E', 'C' or 'R', got 'X'"),
    "constellation_none": ({}, _RUN + " --set systems=[]", 4, "name at least one constellation"),
    "satellite_unknown": ({}, _RUN + ' --set exclude=["G99x"]', 4, "setting exclude.0"),
    "probability_of_two": ({}, _RUN + " --set risk.local_prior=2", 4, "Input should be less than 1, got 2"),
    "alarm_limit_negative": ({}, _RUN + " --set alarm_limit_m=-1", 4, "Input should be greater than 0, got -1"),
    "reference_point_unknown": ({}, _RUN + " --reference middle", 2, "is not one of 'antenna', 'centre'"),
    "centre_without_vehicle": ({}, _RUN + " --reference centre", 4, "which needs a vehicle file"),
    "datum_unknown": ({}, _RUN + " --height-datum sea", 4, "expected 'ellipsoidal' or 'orthometric'"),
    "frame_unknown": ({}, _RUN + " --crs EPSG:999999", 4, "the CRS 'EPSG:999999' is unknown"),
    # -- a vehicle
    "gauge_negative": ({"s.toml": Edit("train.toml", "1.067", "-1")}, _VEHICLE, 4, "setting gauge_m"),
    "antenna_on_a_mast": ({"s.toml": Edit("train.toml", "3.95", "395")}, _VEHICLE, 4, "less than or equal to 8"),
    "antenna_far_away": ({"s.toml": Edit("train.toml", "= 9.1", "= 9100")}, _VEHICLE, 4, "less than or equal to 30"),
    "facing_up": ({"s.toml": Edit("train.toml", '"rising"', '"up"')}, _VEHICLE, 4, "'rising' or 'falling', got 'up'"),
    "antenna_misnamed": ({"s.toml": Edit("train.toml", "s.front", "s.roof")}, _VEHICLE, 4, "'front' or 'rear'"),
    "bogies_in_one": ({"s.toml": Edit("train.toml", "13.8", "0")}, _VEHICLE, 4, "setting bogie_distance_m"),
    "comma_in_a_number": ({"s.toml": Edit("train.toml", "13.8", '"13,8"')}, _VEHICLE, 4, "a valid number, got '13,8'"),
    "key_twice": ({"s.toml": Edit("train.toml", "gauge", "facing = 'up'\ngauge")}, _VEHICLE, 3, "is not valid TOML"),
    # -- a track map
    "degrees_exchanged": ({"s.csv": _HEAD + "135,35,3\n135.1,35,3\n"}, _TRACK, 3, "latitude and longitude swapped?"),
    "another_country": ({"s.csv": Edit("line.csv", r"^35\.", "-45.")}, _TRACK, 5, "km from where the front log was"),
    "radians": ({"s.csv": _HEAD + "0.6,2.3,0\n0.61,2.3,0\n"}, _TRACK, 3, "radians were given, degrees expected"),
    "longitude_too_large": ({"s.csv": _HEAD + "35,400,3\n35.1,400,3\n"}, _TRACK, 3, "longitude_deg 400 is over 360"),
    "coordinate_of_nan": ({"s.csv": _HEAD + "35,135,3\n35.1,nan,3\n"}, _TRACK, 3, "'nan' is not a finite number"),
    "coordinate_missing": ({"s.csv": _HEAD + "35,135,3\n35.1,,3\n"}, _TRACK, 3, "the cell is empty"),
    "decimal_commas": ({"s.csv": _HEAD + "35,1,135,4,3\n"}, _TRACK, 3, "5 cells where the header (line 1) has 3"),
    "heights_missing": (
        {"s.csv": "latitude_deg,longitude_deg\n35,135\n35.1,135\n"}, _TRACK, 3, "neither 'height_m' nor 'elevation_m'",
    ),
    "header_missing": ({"s.csv": "35,135,3\n35.1,135,3\n"}, _TRACK, 3, "numbers where a header line"),
    "points_equal": ({"s.csv": _HEAD + "35,135,3\n" * 3}, _TRACK, 3, "at least two different points"),
    "point_alone": ({"s.csv": _HEAD + "35,135,3\n"}, _TRACK, 3, "a track needs at least two"),
    "line_of_no_length": ({"s.csv": _HEAD + "35,135,3\n35.00000000001,135,3\n"}, _TRACK, 5, "m long; give the track"),
    "datum_contradicts": (
        {"s.csv": Edit("line.csv", "datum: ellipsoidal", "datum: sea level")}, _TRACK, 3, "but the column height_m is",
    ),
    "frame_in_the_file_unknown": ({"s.csv": Edit("line.csv", "EPSG:4979", "EPSG:1")}, _TRACK, 4, "'EPSG:1' is unknown"),
    "geometry_is_a_point": (
        {"s.geojson": _feature('{"type":"Point","coordinates":[8,47]}')}, _NETWORK, 3, "type 'Point'; LineString",
    ),
    "geometry_of_one_point": (
        {"s.geojson": _feature('{"type":"LineString","coordinates":[[8,47]]}')}, _NETWORK, 3, "at least two points",
    ),
    "geometry_of_letters": (
        {"s.geojson": _feature('{"type":"LineString","coordinates":[["a",47],[8,48]]}')}, _NETWORK, 3, "not a number",
    ),
    "geometry_missing": ({"s.geojson": _feature("null")}, _NETWORK, 3, "feature 1 has no geometry"),
    "features_none": ({"s.geojson": _feature("")}, _NETWORK, 3, "has no features"),
    "tolerance_negative": (
        {}, "map network {desk}/line.geojson --tolerance -1", 4, "--tolerance: Input should be greater than 0",
    ),
    "page_as_pdf": ({}, "map network {desk}/line.geojson --page {desk}/s.pdf", 8, "an HTML page is written"),
    "track_misnamed": (
        {"s.geojson": _feature('{"type":"LineString","coordinates":[[8,47,4],[8,47.1,4]]}')},
        "map route {desk}/s.geojson --height-datum ellipsoidal --tracks Trak_A --out {out}.csv", 4,
        "its tracks are 'Track A'",
    ),
    # -- a log
    "an_hour_off": (
        {"s.obs": Edit("front.obs", "^> 2024 03 05 03", "> 2024 03 05 04")}, _OBS, 7,
        "with time tags 1 h earlier its positions lie on the line",
    ),
    "another_day": (
        {"s.obs": Edit("front.obs", "^> 2024 03 05", "> 2024 03 07")}, _OBS, 5, "give the navigation file of that day",
    ),
    "time_system_unknown": (
        {"s.obs": Edit("front.obs", "GPS(?= +TIME OF FIRST)", "XYZ")}, _OBS, 3, "time system 'XYZ' is none of GPS",
    ),
    # -- references
    "reference_missing": ({}, _EVALUATE.replace("truth.csv", "none.csv"), 3, "there is no such file; check the name"),
    "run_is_a_file": ({}, _EVALUATE.replace("results", "results/run.json"), 3, "expected the folder that railfix run"),
    "folder_is_no_run": ({}, "evaluate {desk} --reference {desk}/truth.csv", 3, "railfix run writes it"),
    "two_references": ({}, _EVALUATE + " --reference {desk}/truth.csv", 4, "2 references for 1 runs"),
    "two_labels": ({}, _EVALUATE + " --label a --label b", 4, "2 labels for 1 runs"),
    "reference_of_another_day": (
        {"s.csv": Edit("truth.csv", "^2024-03-05", "2024-03-06")}, _OTHER, 5, "give the reference of this run",
    ),
    "reference_of_another_antenna": ({"s.csv": Edit("truth.csv", "front", "roof")}, _OTHER, 3, "those of rear, roof"),
    "reference_of_another_place": (
        {"s.csv": Edit("truth.csv", "x_m,y_m", "y_m,x_m")}, _OTHER, 5, "check the order of its coordinates",
    ),
    "track_of_another_country": (
        {"s.csv": Edit("line.csv", r"^35\.", "-45.")}, _EVALUATE + " --track {desk}/s.csv", 5, "is not the track of",
    ),
    "reference_in_utc": (
        {"s.csv": Edit("truth.csv", r"^(2024\S+?),", r"\1Z,")}, _OTHER, 3, "GPS time without one was expected",
    ),
    "limit_negative": ({}, _EVALUATE + " --alarm-limit -5", 4, "--alarm-limit: Input should be greater than 0"),
    "limit_in_letters": ({}, _EVALUATE + " --alarm-limit ten", 4, "unable to parse string as a number"),
    "sections_overlap": (
        {"s.csv": "from_m,to_m,environment\n0,500,open\n400,900,city\n"}, _SECTIONS, 3, "begins inside another one",
    ),
    "section_backwards": ({"s.csv": "from_m,to_m,environment\n500,0,open\n"}, _SECTIONS, 3, "500 is not below to_m 0"),
    "section_columns": ({"s.csv": "from,to,environment\n0,500,open\n"}, _SECTIONS, 3, "has no column from_m"),
    "results_into_the_run": ({}, _EVALUATE + " --out {desk}/results", 8, "the folder is not empty"),
    # -- explain, report, export
    "noon": ({}, _EXPLAIN.replace("03:10:05", "noon"), 4, "time is 'noon', expected hh:mm:ss"),
    "time_elsewhere": ({}, _EXPLAIN.replace("03:10:05", "23:00:00"), 5, "it goes from 2024-03-05 03:10:00"),
    "antenna_unknown": ({}, _EXPLAIN + " --antenna roof", 4, "antenna is 'roof', the run has front and rear"),
    "explained_as_pdf": ({}, _EXPLAIN + " --html {desk}/s.pdf", 8, "print the page in a browser"),
    "explained_over_the_run": ({}, _EXPLAIN + " --html {desk}/results/run.json --overwrite", 8, "never overwritten"),
    "exported_as_shape": ({}, "export {desk}/results --out {desk}/s.shp", 8, "a file for maps is written"),
    "report_of_one_run_twice": ({}, _REPORT + " {desk}/results", 4, "the run is given twice"),
    "report_with_two_references": (
        {}, _REPORT + " --reference {desk}/truth.csv --reference {desk}/rtk.csv", 4, "2 references for 1 runs",
    ),
    # -- maps from positions
    "one_position": ({"s.csv": _TIMED + "2024-05-01T08:00:00,48,11,500\n"}, _MAP, 7, "1 of 1 positions left, a track"),
    "standing_still": ({"s.csv": _rows("48,11,500")}, _MAP, 3, "(30 standing still)"),
    "beyond_the_pole": ({"s.csv": _rows("91.k,11,500")}, _MAP, 3, "latitude_deg 91"),
    "time_backwards": (
        {"s.csv": _rows("48.k,11,500", 59, -1).replace("08:00:5", "10:00:5")}, _MAP, 3, "the time is before that of",
    ),
    "positions_in_utc": ({"s.csv": _rows("48.k,11,500").replace(",48", "Z,48")}, _MAP, 3, "carries a time zone"),
    "column_without_name": ({}, _MAP.replace("s.csv", "rtk.csv") + " --column x", 4, "expected NAME=COLUMN"),
    "column_unknown": ({}, _MAP.replace("s.csv", "rtk.csv") + " --column x=y", 4, "column 'x' is unknown"),
    "column_absent": ({}, _MAP.replace("s.csv", "rtk.csv") + " --column x_m=b", 3, "there is no column 'b'"),
    "log_as_positions": ({}, _MAP.replace("s.csv", "front.obs"), 3, "a log of positions"),
    "survey_of_two_countries": (
        {"s.csv": _rows("48.k,11,500")}, "map survey {desk}/rtk.csv {desk}/s.csv --out {out}.csv", 5,
        "give runs over one line",
    ),
    "survey_at_rest": ({}, "map survey {desk}/rtk.csv --out {out}.csv", 5, "positions of a line were expected"),
    "service_limit_negative": ({}, "map service {desk}/results --limit -3", 4, "must be positive"),
    # -- columns under other names, in every reader of references
    "evaluated_column": ({}, _EVALUATE + _COLUMN, 3, "there is no column 'Moment' (given for time_utc)"),
    "reported_column": ({}, _REPORT + " --reference {desk}/truth.csv" + _COLUMN, 3, "there is no column 'Moment'"),
    "modelled_column": ({}, _MODEL + _COLUMN, 3, "there is no column 'Moment'"),
    "ablated_column": ({}, _ABLATE + _COLUMN, 3, "there is no column 'Moment'"),
    "bridged_column": ({}, _REFERENCE + _COLUMN, 3, "there is no column 'Moment'"),
    "surveyed_column": ({}, "map survey {desk}/rtk.csv --out {out}.csv" + _COLUMN, 3, "there is no column 'Moment'"),
    "milliseconds_of_unix": (
        {"s.csv": "unix_s,x_m,y_m,z_m\n1709608182000,1,2,3\n"}, _MAP, 3, "is it in milliseconds?",
    ),
    # -- doctor, convert, locate
    "doctor_of_nothing": ({}, "doctor {desk}/none", 3, "there is no such file; check the name"),
    "doctor_of_a_folder": ({}, "doctor {desk}", 3, "is a folder; name the files in it"),
    "doctor_of_one_file_twice": ({}, "doctor {desk}/front.obs {desk}/front.obs", 3, "is given twice"),
    "table_converted": ({}, "convert {desk}/line.csv --out {out}.obs", 3, "is a table; a RINEX obs"),
    "nothing_converted": ({"s.ubx": ""}, "convert {desk}/s.ubx --out {out}.obs", 3, "is empty"),
    "converted_over_itself": ({}, "convert {desk}/front.obs --out {desk}/front.obs --overwrite", 8, "is an input"),
    "located_from_navigation": (
        {}, "locate --log {desk}/brdc.nav --nav {desk}/brdc.nav --out {out}.pos", 3, "a RINEX observation file was exp",
    ),
    # -- which track
    "risk_of_two": ({}, _WHICH + " --risk 2", 4, "--risk: Input should be less than 0.5"),
    "risk_of_zero": ({}, _WHICH + " --risk 0", 4, "--risk: Input should be greater than 0"),
    "prior_without_weight": ({}, _WHICH + " --prior T3", 4, "expected NAME=WEIGHT"),
    "prior_of_another_track": ({}, _WHICH + " --prior T3=0.5", 4, "there is no track 'T3' in the network"),
    "moved_back": ({}, _WHICH + " --moved -1", 4, "--moved: Input should be greater than or equal to 0"),
    "moved_from_nowhere": ({}, _WHICH + " --moved 0", 4, "the last position needs --last and --moved"),
    "last_place_of_nothing": ({"s.json": "{}"}, _WHICH + " --moved 0 --last {desk}/s.json", 3, "s.json"),
    "last_place_over_the_log": ({}, _WHICH + " --save-last {desk}/front.obs", 8, "is an input"),
    "base_without_place": ({}, _WHICH + " --base {desk}/rear.obs", 4, "needs both --base and --base-place"),
    "base_without_height": (
        {}, _WHICH + " --base {desk}/rear.obs --base-place 35,139", 4, "expected LAT,LON,HEIGHT",
    ),
    "spacing_negative": ({}, _WHICH + " --spacing -3", 4, "--spacing: Input should be greater than or equal to 0"),
    "spacing_of_one_antenna": ({}, _WHICH + " --spacing 18", 4, "--spacing is given without --rear"),
    # -- simulate, error model, reference
    "scenario_unknown": ({}, "simulate nothing --out {out}", 3, "is neither a scenario file nor a shipped one"),
    "duration_of_nan": ({}, "simulate demo --seconds nan --out {out}", 4, "--seconds: Input should be a finite"),
    "noise_negative": (
        {}, "simulate demo --seconds 1 --set receiver.code_sigma_m=-1 --out {out}", 4, "setting receiver.code_sigma_m",
    ),
    "simulated_over_the_run": ({}, "simulate demo --seconds 1 --out {desk}/results", 8, "the folder is not empty"),
    "recipe_without_that_run": ({}, "simulate {desk}/recipe.toml --out {out} --only two", 4, "has no such run"),
    "model_with_two_references": ({}, _MODEL + " --reference {desk}/truth.csv", 4, "1 runs and 2 references"),
    "bins_backwards": ({}, _MODEL + " --elevations 90,0", 4, "at least two rising edges are needed"),
    "one_edge": ({}, _MODEL + " --cn0 40", 4, "at least two rising edges are needed"),
    "station_off_the_earth": ({}, _MODEL + " --base-position 95,1,1", 4, "--base-position"),
    "station_somewhere": ({}, _MODEL + " --base-position here", 4, "expected LAT,LON,HEIGHT"),
    "model_over_its_reference": ({}, _MODEL.replace("{out}.toml", "{desk}/truth.csv --overwrite"), 8, "is an input"),
    "height_limit_negative": ({}, _REFERENCE + " --height -1", 4, "--height: Input should be greater than 0"),
    "pulses_are_positions": ({}, _REFERENCE + " --pulses {desk}/rtk.csv", 5, "too few fixes while the train runs"),
    "reference_without_vehicle": (
        {}, _REFERENCE.replace("--vehicle {desk}/train.toml ", ""), 7, "without a vehicle file the track itself",
    ),
    "curve_as_table": (
        {}, f"cn0-curve {_LOG.replace('--front ', '')} --plot {{desk}}/s.xls --out {{out}}.toml", 8, "ends in .png",
    ),
    # -- live
    "place_without_station": ({}, _LIVE + " --base-place 35,139,50", 4, "--base-place is given without --base"),
    "state_of_another": ({"s.json": "{}"}, _LIVE + " --state {desk}/s.json", 8, "is no state file of railfix live"),
    "state_over_the_track": ({}, _LIVE + " --state {desk}/line.csv", 8, "is an input, which is never overwritten"),
    "metrics_nowhere": ({}, _LIVE + " --metrics nonsense", 4, "expected HOST:PORT"),
    "form_misspelt": ({}, _LIVE + " --send jsn@-", 4, "expected FORM@TARGET"),
    "messages_over_a_file": ({}, _LIVE + " --send json@{desk}/truth.csv", 8, "the file exists already"),
    "source_without_port": ({}, _LIVE.replace("{desk}/front.obs", "tcp://nowhere"), 4, "expected a file, tcp://HOST"),
    "replayed_at_rest": ({}, _LIVE + " --speed 0", 4, "--speed: Input should be greater than or equal to 0.01"),
    "track_as_tachometer": ({}, _LIVE + " --tachometer {desk}/line.csv", 3, "has no column time_gpst"),
    # -- campaign
    "campaign_of_no_log": ({"s.toml": 'front = "a/{day}.obs"\n' + _REST}, _CAMPAIGN, 3, "check the pattern"),
    "campaign_without_field": ({"s.toml": 'front = "front.obs"\n' + _REST}, _CAMPAIGN, 4, "has no field such as"),
    "campaign_misspelt": ({"s.toml": 'front = "{a}.obs"\nnavi = "a"\n' + _REST}, _CAMPAIGN, 4, "is 'nav' meant?"),
    "campaign_over_its_logs": (
        {"s.toml": 'front = "{a}.obs"\n' + _REST}, "campaign {desk}/s.toml --out {desk}", 8, "nor that of a",
    ),
}  # fmt: skip
