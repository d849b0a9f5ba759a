"""Positions from a log alone, and logs of positions of other kinds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from bad_inputs import Desk
from helpers.pipeline_cases import clean_navigation, clean_observations
from railfix.cli import app
from railfix.core.errors import InputFileError
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.io.positions import read_positions
from railfix.pipeline.channel_book import ChannelBook
from railfix.pipeline.config import Config
from railfix.pipeline.received import known_from_start
from railfix.pipeline.without_map import locate
from railfix.run.locate import reasons_text, solution_text

pytestmark = pytest.mark.requirement("A6")


def test_positions_of_a_car_agree_with_rtk_within_their_sigma(recordings: Path, tmp_path: Path) -> None:
    folder = recordings / "kinematic" / "japan_mosaic_2021265_with_GEONET3034"
    out = tmp_path / "car.pos"
    words = ["locate", "--log", str(folder / "SEPT265G.21O"), "--nav", str(folder / "SEPT2650.21P"), "--out", str(out)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    log, reference = read_positions(out), read_positions(folder / "rtklib_rtk_ref_l1_GE.pos")
    _, mine, theirs = np.intersect1d(log.time, reference.time, return_indices=True)
    assert len(mine) > 330
    latitude, longitude, _ = geodetic_from_ecef(log.ecef_m[0])
    error = (log.ecef_m[mine] - reference.ecef_m[theirs]) @ enu_axes(latitude, longitude).T
    assert np.hypot(error[:, 0], error[:, 1]).max() < 5.0
    ratio = np.abs(error[:, [1, 0, 2]]) / log.sigma_m[mine]
    assert (ratio < 3.0).mean() > 0.97
    assert np.median(log.sigma_m[:, 0]) < 3.0
    assert (log.quality == 5).all()


def test_log_without_navigation_of_its_day_is_a_sentence(recordings: Path, tmp_path: Path) -> None:
    car = recordings / "kinematic" / "japan_mosaic_2021265_with_GEONET3034" / "SEPT265G.21O"
    other = recordings / "dual" / "mosaic_x2_99cm" / "base.nav"
    result = CliRunner().invoke(
        app, ["locate", "--log", str(car), "--nav", str(other), "--out", str(tmp_path / "x.pos")]
    )
    assert result.exit_code != 0
    assert not (tmp_path / "x.pos").exists()


def test_epochs_without_position_are_comments_with_their_reason(tmp_path: Path) -> None:
    """The second of three epochs has two satellites."""
    whole = clean_observations()["front"][:3]
    few = np.zeros(whole.code_m.shape, dtype=np.bool_)
    few[1, np.isin(whole.satellite, ["G10", "G15"], invert=True)] = True
    observed = replace(whole, code_m=np.where(few, np.nan, whole.code_m))
    config = Config()
    found = locate(observed, known_from_start(config, navigation=clean_navigation()), config, ChannelBook(config))
    assert reasons_text(found) == "1 too few usable satellites"
    path = tmp_path / "made.pos"
    path.write_text(solution_text(found))
    (comment,) = [line for line in path.read_text().splitlines() if " no position" in line]
    assert comment == "% 2024/03/05 03:10:00.100 no position: too few usable satellites"
    assert np.array_equal(read_positions(path).time, whole.time[[0, 2]])


def test_gpx_points_have_times_and_geoid_heights(tmp_path: Path) -> None:
    path = tmp_path / "run.gpx"
    path.write_text(
        '<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
        '<trkpt lat="48.0" lon="11.0"><ele>500</ele><time>2024-01-01T10:00:00Z</time><geoidheight>46</geoidheight>'
        "</trkpt>"
        '<trkpt lat="48.1" lon="11.0"><ele>501.5</ele><time>2024-01-01T10:00:01Z</time><geoidheight>46</geoidheight>'
        "</trkpt></trkseg></trk></gpx>"
    )
    log = read_positions(path)
    latitude, _, height = geodetic_from_ecef(log.ecef_m)
    assert latitude == pytest.approx([48.0, 48.1])
    assert height == pytest.approx([546.0, 547.5])
    assert log.time[0] == np.datetime64("2024-01-01T10:00:18")  # 18 leap seconds
    assert log.notes == ()
    path.write_text("<gpx></gpx>")
    with pytest.raises(InputFileError, match="has no point of a track"):
        read_positions(path)


def test_novatel_logs_are_those_of_their_manual(tmp_path: Path) -> None:
    """Lines in the layout of the OEM7 manual: BESTPOS in 3.21, INSPVAX in 5.30, INSPVAS in 5.29."""
    path = tmp_path / "span.asc"
    path.write_text(
        "#BESTPOSA,COM1,0,90.5,FINESTEERING,1949,403742.000,02000000,b1f6,32768;SOL_COMPUTED,NARROW_INT,51.15043711386,"
        '-114.03067767000,1097.2099,-17.0000,WGS84,0.0090,0.0080,0.0170,"AAAA",1.000,0.000,35,30,30,30,00,06,39,33*42\n'
        "%INSPVASA,1949,403743.000;1949,403743.000,51.15,-114.03,1080.21,0.1,0.2,0.3,1.0,2.0,3.0,INS_SOLUTION_GOOD*00\n"
        "#BESTPOSA,COM1,0,90.5,FINESTEERING,1949,403744.000,02000000,b1f6,32768;INSUFFICIENT_OBS,NONE,0,0,0,0,WGS84,0,0,0"
        ',"",0,0,0,0,0,0,00,00,00,00*42\n'
    )
    log = read_positions(path)
    assert len(log) == 2
    _, _, height = geodetic_from_ecef(log.ecef_m)
    assert height[0] == pytest.approx(1097.2099 - 17.0)
    assert log.quality.tolist() == [1, -1]
    assert log.sigma_m[0] == pytest.approx([0.009, 0.008, 0.017])
    path.write_text("nothing\n")
    with pytest.raises(InputFileError, match="a position log"):
        read_positions(path)


def test_each_file_of_a_joined_log_needs_navigation(good: Desk, tmp_path: Path) -> None:
    """The second file is of six days later; `brdc.nav` reaches the first alone."""
    text = (good.folder / "front.obs").read_text()
    (tmp_path / "later.obs").write_text(text.replace("> 2024 03 05", "> 2024 03 11"))
    words = ["--nav", str(good.folder / "brdc.nav"), "--out"]
    logs = [str(good.folder / "front.obs"), str(tmp_path / "later.obs")]
    for command in (
        ["locate", "--log", logs[0], "--log", logs[1], *words, str(tmp_path / "a.pos")],
        [
            "run",
            "--front",
            logs[0],
            "--front",
            logs[1],
            "--track",
            str(good.folder / "line.csv"),
            *words,
            f"{tmp_path}/r",
        ],
    ):
        result = CliRunner().invoke(app, command)
        assert result.exit_code == 5, result.output
        assert "later.obs: begins at 2024-03-11T03:10 (GPS time), more than a day from all" in result.stderr


def test_a_receiver_log_needs_no_navigation_file_where_it_has_ephemerides(good: Desk, tmp_path: Path) -> None:
    words = ["locate", "--log", str(good.folder / "front.obs"), "--out", str(tmp_path / "a.pos")]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 4
    assert "nav (--nav) is missing; give the navigation file, which RINEX observations need" in result.stderr
