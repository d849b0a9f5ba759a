"""``railfix doctor``: kinds of files, what does not fit, and a command that runs."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from random import Random

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from bad_inputs import Desk
from railfix.cli import app
from railfix.io.receiver.framing import find_frames
from railfix.io.sensor_tables import COLUMNS
from railfix.run.doctor import examine_files

RUNNER = CliRunner(env={"COLUMNS": "80", "TERM": "dumb", "NO_COLOR": "1"})
pytestmark = pytest.mark.requirement("G4")


@pytest.fixture(scope="module")
def desk(good: Desk) -> Path:
    return good.folder


def test_each_file_is_known_by_its_content(desk: Path) -> None:
    names = {
        "rear.obs": "observations", "front.obs": "observations", "brdc.nav": "navigation", "line.csv": "track",
        "train.toml": "vehicle", "settings.toml": "settings", "rtk.csv": "positions",
    }  # fmt: skip
    found = examine_files([desk / name for name in names])
    assert {finding.path.name: finding.kind for finding in found.findings} == names
    assert found.problems == ()
    assert "200 epochs, one every 0.1 s" in found.findings[0].facts[0]
    front, rear = found.command.split().index("--front"), found.command.split().index("--rear")
    assert found.command.split()[front + 1].endswith("front.obs")
    assert found.command.split()[rear + 1].endswith("rear.obs")


#: Content of a table of each kind; a time stands in braces.
TABLES = {
    "tachometer": "time_gpst,pulse,volts\n{},1,0.5\n", "radar": "time_gpst,speed_mps\n{},4\n",
    "ranging": "time_gpst,unit,range_m\n{},A,90\n", "ranging_units": "unit,x_m,y_m,z_m\nA,4279000,643000,4670500\n",
    "balises": "time_gpst,balise\n{},B1\n", "list of balises": "balise,chainage_m\nB1,9\nB2,20\n",
    "inertial": f"time_gpst,{','.join(COLUMNS['inertial'])}\n{{}},0,0,-9.8,0,0,0\n",
    "heights": "kilometrage_m,elevation_m\n0,80\n900,81\n",
    "unknown": "time_gpst,antenna,balise,latest_gpst\n{},a,B1,{}\n",
}  # fmt: skip


@pytest.mark.requirement("A6")
def test_each_table_is_known_by_its_header_and_read_as_its_command_reads_it(desk: Path, tmp_path: Path) -> None:
    time, paths = "2024-03-05T03:10:01.000000000", {name: tmp_path / f"{name}.txt" for name in TABLES}
    for name, path in paths.items():
        path.write_text(TABLES[name].replace("{}", time))
    own = {name: desk / f"{name}.csv" for name in ("pulses", "acceleration", "sections")}
    inputs = [desk / name for name in ("front.obs", "brdc.nav", "line.csv")]
    found = examine_files([*inputs, *paths.values(), *own.values()])
    assert [finding.kind for finding in found.findings[3:]] == [*paths, *own]
    assert all(finding.facts for finding in found.findings if finding.kind != "unknown")
    assert [text for text in found.problems if "unknown.txt" not in text] == []
    words = found.command.split(" --")
    for name in ("tachometer", "radar", "ranging", "ranging_units", "balises", "inertial"):
        assert f"{name.replace('_', '-')} {paths[name]}" in words
    assert f"balise-list '{paths['list of balises']}'" in words
    paths["radar"].write_text(TABLES["radar"].replace("{}", "2024-03-06T03:10:01"))
    paths["tachometer"].write_text("time_gpst,pulse\n,1\n")
    several = examine_files([*inputs, *(paths[name] for name in ("radar", "ranging", "balises", "tachometer"))])
    said = " ".join(several.problems)
    for text in ("no time in common", "needs the ranging units", "needs the list of balises", "time_gpst is empty"):
        assert text in said
    models = [tmp_path / "support.toml", tmp_path / "curve.toml", desk / "scenario.toml", desk / "recipe.toml"]
    support = "sigma_ura_m = 1.0, sigma_ure_m = 1.0, bias_m = 0.0, prior = 1e-5, constellation_prior = 1e-8"
    models[0].write_text(f'format = "railfix integrity support 1"\nconstellation.G = {{ {support} }}\n')
    models[1].write_text('format = "railfix C/N0 curve 0"\n')
    found = examine_files([*inputs, *models])
    assert [f.kind for f in found.findings[3:]] == ["integrity support message", "C/N0 curve", "scenario", "scenario"]
    assert f"--set integrity_support={models[0]} --out" in found.command.replace("'", "")
    assert "railfix cn0-curve" in "".join(found.problems)
    packed = tmp_path / "a.parquet"
    pl.DataFrame({"time_gpst": [np.datetime64(time)], "speed_mps": [1.0]}).write_parquet(packed)
    assert examine_files([packed]).findings[0].facts == ("1 reading (--radar)",)


@pytest.mark.requirement("A6")
def test_the_ground_truth_of_two_antennas_is_known_packed_as_plain(desk: Path, tmp_path: Path) -> None:
    packed = tmp_path / "truth.csv.gz"
    packed.write_bytes(gzip.compress((desk / "truth.csv").read_bytes()))
    for path in (desk / "truth.csv", packed):
        (finding,) = examine_files([path]).findings
        assert finding.kind == "positions"
        assert finding.facts[0] == "400 positions of front and rear"


@pytest.mark.requirement("A6")
def test_a_log_without_a_date_is_a_log_that_needs_one(recordings: Path, tmp_path: Path) -> None:
    """The observations alone of a log in RTCM 3, without its ephemerides."""
    path = tmp_path / "msm.rtcm3"
    content = (recordings / "cases" / "reports" / "three-epochs.rtcm3").read_bytes()
    frames = find_frames(np.frombuffer(content, dtype=np.uint8), at_end=True)
    spans = [(a - 3, b + 3) for a, b in zip(frames.start.tolist(), frames.end.tolist(), strict=True)]
    numbers = [int.from_bytes(content[a + 3 : a + 5], "big") >> 4 for a, _ in spans]
    path.write_bytes(b"".join(content[a:b] for (a, b), n in zip(spans, numbers, strict=True) if 1070 < n < 1140))
    (finding,) = examine_files([path]).findings
    assert finding.kind == "observations"
    assert "its observations (RTCM 3) have no date; give a date (date, --date)" in finding.problems[0]
    result = RUNNER.invoke(app, ["doctor", str(path), "--date", "2024-08-18T12:00", "--json"])
    (found,) = json.loads(result.stdout)["files"]
    assert found["first"].startswith("2024-08-18T21:14:25")
    assert not any("--date" in problem for problem in json.loads(result.stdout)["problems"])


@pytest.mark.requirement("G5")
def test_networks_orbits_and_maps_without_heights_are_no_problem(desk: Path, tmp_path: Path) -> None:
    """Each as a run takes it: a network, of which it finds the route; heights of the log; orbits beside ephemerides."""
    lines = [[[8.0, 47.0], [8.001, 47.0], [8.002, 47.0]], [[8.001, 47.001], [8.002, 47.001]]]
    features = [
        {"type": "Feature", "properties": {}, "geometry": {"type": "LineString", "coordinates": line}} for line in lines
    ]
    net = tmp_path / "net"
    net.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    found = examine_files([desk / "front.obs", desk / "brdc.nav", net])
    assert found.findings[2].facts[:3] == (
        "5 points, 228 m",
        "without heights: the heights of the log's own positions are used (--heights log)",
        "a network of 2 tracks, in which a run finds the route",
    )
    assert all("km from the position in the header" in problem for problem in found.problems)
    assert "--heights log" in found.command


@pytest.mark.requirement("A6")
@pytest.mark.parametrize(("name", "datum"), [("a.kml", "orthometric --geoid egm96"), ("a.geojson", "ellipsoidal")])
def test_heights_are_taken_as_the_format_defines_them(tmp_path: Path, name: str, datum: str) -> None:
    """KML's altitudes are above EGM96 (OGC KML 2.3, 13.9); other formats leave it open."""
    points = [[135.45, 35.05, 120.0], [135.451, 35.05, 120.0], [135.452, 35.05, 120.0]]
    line = {"type": "Feature", "properties": {}, "geometry": {"type": "LineString", "coordinates": points}}
    text = json.dumps({"type": "FeatureCollection", "features": [line]})
    if name.endswith("kml"):
        places = " ".join(",".join(map(str, point)) for point in points)
        text = f"<kml xmlns='http://www.opengis.net/kml/2.2'><Placemark><LineString><coordinates>{places}"
        text += "</coordinates></LineString></Placemark></kml>"
    (tmp_path / name).write_text(text)
    found = examine_files([tmp_path / name])
    assert " ".join(found.findings[0].options) == f"--height-datum {datum}"
    assert f"takes the heights as {datum.split()[0]}" in found.problems[0]


@pytest.mark.requirement("A6")
def test_a_map_with_errors_is_named_as_map_check_names_it(desk: Path, tmp_path: Path) -> None:
    head, *rows = (line for line in (desk / "line.csv").read_text().splitlines() if not line.startswith("#"))
    Random(1).shuffle(rows)
    (tmp_path / "shuffled.csv").write_text("\n".join([head, *rows]) + "\n")
    result = RUNNER.invoke(app, ["doctor", str(tmp_path / "shuffled.csv")])
    assert result.exit_code == 5
    assert "shuffled.csv: map check: " in " ".join(result.output.split())


def test_what_is_missing_or_does_not_fit_is_named(desk: Path, tmp_path: Path) -> None:
    notes = tmp_path / "notes[maps].md"
    notes.write_text("notes\n")
    far = tmp_path / "far.csv"
    far.write_text("latitude_deg,longitude_deg,height_m\n47,8,400\n47.001,8,400\n")
    result = RUNNER.invoke(app, ["doctor", *(str(path) for path in (desk / "front.obs", far, notes))])
    assert result.exit_code == 5, result.output
    for words in ("notes[maps].md: not recognised", "no navigation file", "km from the position in the header"):
        assert words in result.output
    assert "run: railfix" not in result.output
    assert RUNNER.invoke(app, ["doctor", str(tmp_path / "none.obs")]).exit_code == 3
