"""``railfix map check`` and ``railfix map from-positions`` as a person calls them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from railfix.cli import app
from railfix.core.geodesy import ecef_from_geodetic, enu_axes
from railfix.track import Track, read_track, write_track_csv

runner = CliRunner()


def call(*arguments: object) -> tuple[int, str]:
    """Exit code and everything printed."""
    result = runner.invoke(app, ["map", *(str(a) for a in arguments)], env={"COLUMNS": "200"})
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.output


def line(folder: Path, name: str = "line.csv", *, kink: float = 0.0, end: float = 200.0) -> Path:
    north = np.arange(0.0, end + 1.0, 5.0)
    enu = np.stack([0 * north, north, 0 * north], axis=1)
    enu[20, 0] = kink
    ecef = ecef_from_geodetic(35.0, 139.0, 50.0) + enu @ enu_axes(35.0, 139.0)
    write_track_csv(Track.from_ecef(ecef, name=name.removesuffix(".csv")), folder / name)
    return folder / name


@pytest.mark.requirement("A1")
def test_a_good_map_ends_with_0_and_a_picture(tmp_path: Path) -> None:
    code, printed = call("check", line(tmp_path), "--out", tmp_path / "report")
    assert code == 0
    assert "0 errors, 0 warnings" in printed
    assert "41 points, 200.0 m" in printed
    picture = tmp_path / "report" / "map_check.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in picture.parent.iterdir()] == ["map_check.png"]


@pytest.mark.requirement("A1")
def test_a_map_with_an_error_ends_with_6_and_says_which(tmp_path: Path) -> None:
    code, printed = call("check", line(tmp_path, kink=2.0), "--out", tmp_path)
    assert code == 6
    assert "kink" in printed
    assert "Traceback" not in printed
    assert "railfix: error: line: the track map has" in printed
    assert (tmp_path / "map_check.png").is_file(), "the picture shows what is wrong"


def test_points_that_repeat_the_one_before_are_read_once_and_shown(tmp_path: Path) -> None:
    path = line(tmp_path)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, lines[-1]]) + "\n")
    code, printed = call("check", path)
    assert code == 0
    assert "duplicate" in printed
    assert any("1 repeated point left out" in note for note in read_track(path).provenance.notes)
    path.write_text("latitude_deg,longitude_deg,height_m\n" + 5 * "50.0,10.0,300\n")
    code, printed = call("check", path)
    assert code == 3
    assert "at least two different points" in printed


def test_the_limit_of_the_mid_chord_deviation_is_an_option(tmp_path: Path) -> None:
    path = line(tmp_path, kink=0.1)
    assert call("check", path)[0] == 0
    assert call("check", path, "--mid-chord", "0.005")[0] == 6


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["check", "none.csv"], 3, "no such file"),
        (["check", "."], 3, "is a folder"),
        (["check", "line.csv", "--geoid", "japan"], 4, "ellipsoidal already"),
        (["check", "line.csv", "--mid-chord", "0"], 4, "must be positive"),
        (["check", "line.csv", "--crs", "EPSG:0"], 4, "unknown"),
        (["check", "line.csv", "--out", "line.csv"], 8, "does not exist"),
        (["check", "line.csv", "far.csv"], 3, "the gap is"),
        (["check"], 2, "Missing argument"),
        (["check", "line.csv", "--wrong"], 2, "No such option"),
        (["from-positions", "none.pos", "--out", "m.csv"], 3, "no such file"),
        (["from-positions", "line.csv", "--out", "none/m.csv"], 8, "does not exist"),
        (["from-positions", "line.csv", "--out", "m.csv", "--quality", "good"], 4, "whole numbers"),
        (["from-positions", "line.csv", "--out", "m.csv", "--quality", "1"], 3, "no column 'quality'"),
        (["from-positions", "line.csv", "--out", "m.csv", "--spacing", "0"], 4, "must be positive"),
        (["from-positions", "line.csv", "--out", "m.csv", "--spacing", "900"], 7, "a track needs two"),
        (["from-positions", "line.csv", "--out", "m.csv", "--column", "lat"], 4, "expected NAME=COLUMN"),
        (["from-positions", "line.csv", "--out", "m.csv", "--column", "lat=x"], 4, "'lat' is unknown"),
    ],
)
def test_misuse_ends_with_one_sentence_and_its_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], code: int, said: str
) -> None:
    line(tmp_path)
    far = Track.from_geodetic([36.0, 36.001], [139.0, 139.0], [50.0, 50.0])
    write_track_csv(far, tmp_path / "far.csv")
    monkeypatch.chdir(tmp_path)
    found, printed = call(*arguments)
    assert found == code, printed
    assert said in " ".join(printed.split())
    assert "Traceback" not in printed
    assert {path.name for path in tmp_path.iterdir()} == {"line.csv", "far.csv"}, "nothing half-written"


@pytest.mark.parametrize(
    ("command", "option"),
    [("features", "--plan-sigma"), ("check", "--no-cache"), ("features", "--no-cache"), ("network", "--no-cache")],
)
def test_options_without_an_effect_are_not_offered(command: str, option: str, tmp_path: Path) -> None:
    code, printed = call(command, line(tmp_path), *((option,) if option == "--no-cache" else (option, "2")))
    assert (code, "No such option" in printed) == (2, True)


def test_map_from_positions_says_what_became_of_them(tmp_path: Path, recordings: Path) -> None:
    log = next((recordings / "kinematic").glob("japan_mosaic*")) / "rtklib_rtk_ref_l1_GE.pos"
    code, printed = call("from-positions", log, "--out", tmp_path / "course.csv", "--name", "course")
    assert code == 0
    for said in (
        "360 positions",
        "dropped: 17 of insufficient quality",
        "standing still",
        "bridged by a straight line",
    ):
        assert said in printed
    assert printed.count("the direction turns by") == 1, "many errors are one line with the first of them"
    assert len(printed.splitlines()) <= 10
    track = read_track(tmp_path / "course.csv")
    assert track.name == "course"
    assert len(track) > 200


def test_help_reads_like_a_manual() -> None:
    for command in ("check", "from-positions"):
        code, printed = call(command, "--help")
        assert code == 0
        assert len(printed.splitlines()) > 20


@pytest.mark.slow
def test_the_commands_do_not_load_matplotlib() -> None:
    import subprocess

    code = "import sys, railfix.cli.map, railfix.track, railfix.track.vehicle; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.requirement("A1")
def test_the_check_refuses_a_point_far_from_the_line(tmp_path: Path) -> None:
    """105 km off, as a wrong digit of the latitude makes it."""
    track = read_track(line(tmp_path))
    far = track.ecef_m.copy()
    far[20] = ecef_from_geodetic(35.95, 139.0, 50.0)
    write_track_csv(Track.from_ecef(far, name="far"), tmp_path / "far.csv")
    code, printed = call("check", tmp_path / "far.csv")
    assert code == 6
    assert "gap" in printed
    assert "a point is wrong" in printed


def positions(folder: Path, *, outlier: bool, quality: int | None) -> Path:
    """A run of 60 s at 10 m/s to the north as CSV."""
    enu = np.stack([np.zeros(61), 10.0 * np.arange(61.0), np.zeros(61)], axis=1)
    ecef = ecef_from_geodetic(35.0, 139.0, 50.0) + enu @ enu_axes(35.0, 139.0)
    if outlier:
        ecef[30] = ecef_from_geodetic(36.5, 139.0, 50.0)
    rows = ["time_gpst,x_m,y_m,z_m" + ("" if quality is None else ",quality")]
    for t, (x, y, z) in enumerate(ecef):
        tail = "" if quality is None else f",{quality}"
        rows.append(f"2024-03-05T03:{10 + t // 60:02d}:{t % 60:02d},{x:.4f},{y:.4f},{z:.4f}{tail}")
    path = folder / "positions.csv"
    path.write_text("\n".join(rows) + "\n")
    return path


@pytest.mark.requirement("A1")
def test_an_outlier_is_dropped_and_its_map_passes_the_check(tmp_path: Path) -> None:
    path = positions(tmp_path, outlier=True, quality=None)
    code, printed = call("from-positions", path, "--out", tmp_path / "made.csv")
    assert code == 0, printed
    assert "dropped: 1 out of reach of the others" in printed
    assert read_track(tmp_path / "made.csv").chainage_m[-1] == pytest.approx(600.0, abs=0.1)
    assert call("check", tmp_path / "made.csv")[0] == 0


@pytest.mark.requirement("A1")
@pytest.mark.parametrize(("quality", "plan_m"), [(1, 0.3), (2, 0.5), (5, 3.0)])
def test_the_map_states_the_accuracy_of_its_positions(tmp_path: Path, quality: int, plan_m: float) -> None:
    path = positions(tmp_path, outlier=False, quality=quality)
    code, printed = call("from-positions", path, "--out", tmp_path / "made.csv", "--quality", quality)
    assert code == 0, printed
    assert read_track(tmp_path / "made.csv").sigma_plan_m == plan_m
    assert "accuracy of the map" in printed


def test_the_check_takes_the_accuracy_that_its_note_asks_for(tmp_path: Path) -> None:
    track, bare = read_track([line(tmp_path)]), tmp_path / "bare.csv"
    columns = zip(track.latitude_deg, track.longitude_deg, track.height_m, strict=True)
    bare.write_text(
        "latitude_deg,longitude_deg,height_m\n" + "".join(f"{a:.9f},{b:.9f},{c:.3f}\n" for a, b, c in columns)
    )
    code, printed = call("check", bare, "--height-datum", "ellipsoidal")
    assert (code, "(--plan-sigma)" in printed) == (0, True)
    code, printed = call("check", bare, "--height-datum", "ellipsoidal", "--plan-sigma", "2")
    assert (code, "(--plan-sigma)" in printed) == (0, False)
