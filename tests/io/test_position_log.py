"""Logs of positions, and the maps made from them."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from railfix.core.arrays import Datetimes, Floats
from railfix.core.errors import InputFileError, NoPositionError, RailfixError, SettingsError
from railfix.core.geodesy import ecef_from_geodetic, enu_axes
from railfix.io.positions import read_positions
from railfix.io.reference_log import read_reference
from railfix.track import ThinningLimits, from_position_log, from_positions, read_track, thin
from railfix.track.map_from_positions import ANTENNA_PATH, usable_rows
from railfix.track.trajectory import Trajectory
from recordings_truth import TRUTHS, write_truth_csv

START = np.datetime64("2021-09-22T06:30:00", "ns")
EXPECTED = ecef_from_geodetic([35.34205801, 35.342057994], [139.521986546, -139.521986524], [47.5764, -47.5750])

HEADS = {
    "deg": "latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)",
    "dms": "latitude(d'\")   longitude(d'\")   height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)",
    "xyz": "x-ecef(m)      y-ecef(m)      z-ecef(m)   Q  ns   sdx(m)   sdy(m)   sdz(m)",
}
PLACES = {
    "deg": ["35.342058010  139.521986546    47.5764", "35.342057994 -139.521986524   -47.5750"],
    "dms": ["35 20 31.4088360  139 31 19.1515656    47.5764", "35 20 31.4087784 -139 31 19.1514864   -47.5750"],
    "xyz": ["  ".join(f"{v:.4f}" for v in point) for point in EXPECTED],
}
TIMES = {
    ("GPST", "week"): ["2176 282600.000", "2176 282601.200"],
    ("GPST", "date"): ["2021/09/22 06:30:00.000", "2021/09/22 06:30:01.200"],
    ("UTC", "week"): ["2176 282582.000", "2176 282583.200"],
    ("UTC", "date"): ["2021/09/22 06:29:42.000", "2021/09/22 06:29:43.200"],
    ("JST", "date"): ["2021/09/22 15:29:42.000", "2021/09/22 15:29:43.200"],
}
TAIL = ["1  12   0.0054   0.0043   0.0175", "2   8   0.1000   0.2000   0.3000"]


def pos(scale: str, form: str, places: str, separator: str = " ") -> str:
    lines = [f"{t}  {p}  {q}" for t, p, q in zip(TIMES[scale, form], PLACES[places], TAIL, strict=True)]
    if separator != " ":
        lines = [separator.join(line.split("  ")).replace(separator * 2, separator) for line in lines]
    head = "% program   : RTKLIB ver.2.4.3\n% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float)\n"
    return f"{head}%  {scale}          {HEADS[places]}\n" + "\n".join(lines) + "\n"


@pytest.mark.parametrize(("scale", "form"), list(TIMES))
@pytest.mark.parametrize("places", list(PLACES))
def test_every_form_of_rtklib_solutions(tmp_path: Path, scale: str, form: str, places: str) -> None:
    path = tmp_path / "run.pos"
    path.write_text(pos(scale, form, places), encoding="utf-8")
    log = read_positions(path)
    np.testing.assert_allclose(log.ecef_m, EXPECTED, atol=2e-4)
    np.testing.assert_array_equal(log.time, START + np.array([0, 1_200_000_000]).astype("timedelta64[ns]"))
    np.testing.assert_array_equal(log.quality, [1, 2])
    np.testing.assert_array_equal(log.line, [4, 5])
    if places == "xyz":
        assert np.isnan(log.sigma_m).all()
    else:
        np.testing.assert_array_equal(log.sigma_m[1], [0.1, 0.2, 0.3])
    assert bool(log.notes) == (scale != "GPST")


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_other_separators(tmp_path: Path, separator: str) -> None:
    path = tmp_path / "run.pos"
    path.write_text(pos("GPST", "date", "deg").replace("  ", separator), encoding="utf-8")
    np.testing.assert_allclose(read_positions(path).ecef_m, EXPECTED, atol=2e-4)


def test_south_and_west_of_zero_degrees(tmp_path: Path) -> None:
    """The sign of -0 degrees 30 minutes is not lost."""
    text = pos("GPST", "week", "dms").replace("35 20 31.4088360", "-0 30 0.0")
    path = tmp_path / "run.pos"
    path.write_text(text, encoding="utf-8")
    np.testing.assert_allclose(
        read_positions(path).ecef_m[0], ecef_from_geodetic(-0.5, 139.521986546, 47.5764), atol=1e-3
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t.replace("%  GPST", "%  ----"), "no RTKLIB header line"),
        (lambda t: "\n".join(t.splitlines()[:3]) + "\n", "no position below"),
        (lambda t: t.replace("35.342057994", "35.34205x994"), "line 5: column latitude_deg: '35.34205x994' is"),
        (lambda t: t.replace("282601.200", "28260l.200"), "line 5: column tow_s: '28260l.200' is not a number"),
        (lambda t: t.replace("35.342057994", "95.342057994"), "line 5: latitude_deg 95.3421 is over 90"),
        (lambda t: t + "2176 282602.000  35.3\n", "line 6: 3 fields"),
        (lambda t: t.replace("WGS84/ellipsoidal", "WGS84/geodetic"), "above the geoid"),
        (
            lambda t: t.replace("latitude(deg) longitude(deg)  height(m)", "e-baseline(m) n-baseline(m) u-baseline(m)"),
            "baselines",
        ),
    ],
)
def test_broken_rtklib_solutions(tmp_path: Path, change: object, said: str) -> None:
    path = tmp_path / "run.pos"
    path.write_text(change(pos("GPST", "week", "deg")), encoding="utf-8")  # type: ignore[operator]
    with pytest.raises(InputFileError) as caught:
        read_positions(path)
    assert said in str(caught.value)
    assert "run.pos" in str(caught.value)


CSV = (
    "time_gpst,latitude_deg,longitude_deg,height_m,quality,note\n"
    "2021-09-22T06:30:00,35.34205801,139.521986546,47.5764,1,a\n"
    "2021-09-22T06:30:01.2,35.342057994,-139.521986524,-47.5750,2,b\n"
    ",,,,,no position\n"
)


def test_csv_with_rows_without_a_position(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text(CSV, encoding="utf-8")
    log = read_positions(path)
    np.testing.assert_allclose(log.ecef_m[:2], EXPECTED, atol=1e-6)
    assert np.isnan(log.ecef_m[2]).all()
    assert np.isnat(log.time[2])
    np.testing.assert_array_equal(log.quality, [1, 2, -1])


def test_csv_with_weeks_seconds_and_sigmas(tmp_path: Path) -> None:
    """The form in which post-processing programs export: the hand-counted time is that of the log by date."""
    path = tmp_path / "run.csv"
    header = "week,tow_s,latitude_deg,longitude_deg,height_m,quality,sigma_north_m,sigma_east_m,sigma_up_m\n"
    first = "2176,282600.000,35.34205801,139.521986546,47.5764,2,0.1,0.2,0.3\n"
    path.write_text(header + first + "2176,282601.2,35.342057994,-139.521986524,-47.5750,5,,,\n", encoding="utf-8")
    log = read_positions(path)
    np.testing.assert_array_equal(log.time, START + np.array([0, 1_200_000_000]).astype("timedelta64[ns]"))
    np.testing.assert_array_equal(log.sigma_m, [[0.1, 0.2, 0.3], [np.nan] * 3])
    with pytest.raises(NoPositionError, match="no position has quality 1; the log has 1 of quality 2, 1 of"):
        usable_rows(log)
    path.write_text(header + first.replace("282600", "700000"), encoding="utf-8")
    with pytest.raises(InputFileError, match="line 2: week 2176 and tow_s 700000 are not a GPS week"):
        read_positions(path)


def test_csv_in_ecef_and_under_other_names(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    rows = "\n".join(",".join(f"{v:.4f}" for v in point) for point in EXPECTED)
    path.write_text("X,Y,Z\n" + rows + "\n", encoding="utf-8")
    log = read_positions(path, columns={"x_m": "X", "y_m": "Y", "z_m": "Z"})
    np.testing.assert_allclose(log.ecef_m, EXPECTED, atol=1e-4)
    assert not log.has_quality
    assert np.isnat(log.time).all()


@pytest.mark.parametrize(
    ("names", "separator", "encoding", "ending"),
    [
        ("lat,lon,height", ",", "utf-8", ".csv"),
        ("Latitude,Longitude,Altitude", ",", "utf-8-sig", ".txt"),
        ("LATITUDE_DEG,LONGITUDE_DEG,Height_m", ";", "utf-16", ".csv"),
        ("Lat,Lng,Ellipsoidal height (m)", "\t", "utf-16", ".txt"),
    ],
)
def test_tables_as_other_programs_write_them(
    tmp_path: Path, names: str, separator: str, encoding: str, ending: str
) -> None:
    """Usual names, separators, decimal commas beside semicolons, UTF-16 of a spreadsheet: the same positions."""
    text = CSV.replace("latitude_deg,longitude_deg,height_m", names).replace(",", separator)
    if separator == ";":
        text = text.replace("35.342", "35,342").replace("47.5764", "47,5764")
    path = tmp_path / f"run{ending}"
    path.write_text(text, encoding=encoding)
    log = read_positions(path)
    np.testing.assert_allclose(log.ecef_m[:2], EXPECTED, atol=1e-6)
    if "deg" not in names.lower():
        assert "is taken as heights above the ellipsoid" in log.notes[0]


def test_rows_out_of_order_are_sorted_or_noted(tmp_path: Path) -> None:
    """Two rows exchanged are sorted, with a note; a clock that goes back by an hour only has a note."""
    path = tmp_path / "run.csv"
    seconds = np.array([0, 1, 3, 2, 4, 5])
    for step, sorted_rows in ((0, True), (3600, False)):
        time = START + (seconds - step * (seconds > 3)).astype("timedelta64[s]")
        rows = [f"{t},35.3,139.5,{40 + k}" for k, t in enumerate(time)]
        path.write_text("time_gpst,latitude_deg,longitude_deg,height_m\n" + "\n".join(rows), encoding="utf-8")
        log = read_positions(path)
        assert log.line.tolist() == ([2, 3, 5, 4, 6, 7] if sorted_rows else [2, 3, 4, 5, 6, 7])
        np.testing.assert_allclose(log.geodetic[2], log.line + 38.0, atol=1e-6)
        assert "line 5: the time goes back" in log.notes[-1]
        assert ("sorted by time" in log.notes[-1]) == sorted_rows


@pytest.mark.parametrize(
    ("text", "columns", "error", "said"),
    [
        (CSV.replace("latitude_deg", "lattitude_deg"), {}, InputFileError, "did you mean 'latitude_deg'"),
        (CSV.replace("height_m", "z"), {}, InputFileError, "have no height"),
        (CSV.replace("longitude_deg", "x"), {}, InputFileError, "no columns latitude_deg"),
        (CSV.replace("height_m", "height_ft"), {}, InputFileError, "line 1: column 'height_ft' is in feet; convert"),
        (CSV.replace("height_m", "Altitude (km)"), {}, InputFileError, "is in kilometres; convert"),
        (CSV.replace("47.5764", "high"), {}, InputFileError, "line 2: column height_m"),
        (CSV.replace("06:30:01.2", "6h30"), {}, InputFileError, "line 3: time_gpst"),
        (CSV.replace("06:30:01.2", "06:30:01.2Z"), {}, InputFileError, "time zone"),
        (CSV.replace("35.34205801", "135.34205801"), {}, InputFileError, "swapped"),
        (CSV.splitlines()[0] + "\n", {}, InputFileError, "no position below"),
        (CSV, {"height_m": "H"}, InputFileError, "no column 'H'"),
        (CSV, {"hight_m": "height_m"}, SettingsError, "'hight_m' is unknown"),
    ],
)
def test_broken_csv_logs(
    tmp_path: Path, text: str, columns: dict[str, str], error: type[RailfixError], said: str
) -> None:
    path = tmp_path / "run.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(error) as caught:
        read_positions(path, columns=columns)
    assert said in str(caught.value)


def test_solutions_written_by_rtklib_itself(tmp_path: Path, recordings: Path) -> None:
    """The same run in three forms of RTKLIB's own output."""
    program = shutil.which("rnx2rtkp")
    if program is None:
        pytest.skip("rnx2rtkp is not installed")
    folder = recordings / "static" / "rtklib_geonet2005"
    logs = []
    for number, options in enumerate([["-g"], ["-e", "-t"], ["-t", "-s", ","]]):
        out = tmp_path / f"{number}.pos"
        inputs = [str(folder / "07590920.05o"), str(folder / "07590920.05n")]
        subprocess.run([program, "-p", "0", *options, "-o", str(out), *inputs], check=True, capture_output=True)
        logs.append(read_positions(out))
    for log in logs[1:]:
        np.testing.assert_array_equal(log.time, logs[0].time)
        np.testing.assert_allclose(log.ecef_m, logs[0].ecef_m, atol=2e-3)
    assert len(logs[0]) > 100


# --- maps from positions -----------------------------------------------------

ORIGIN = (35.0, 139.0, 50.0)


def run_of(speed: Floats, sigma: float, seed: int = 0, drift: float = 0.0) -> tuple[Datetimes, Floats]:
    """A run to the north at 10 Hz with white noise, and drift to the east."""
    random = np.random.default_rng(seed)
    t = 0.1 * np.arange(len(speed))
    north = np.cumsum(0.1 * speed)
    enu = np.stack([drift * t, north, 0 * t], axis=1) + sigma * random.normal(size=(len(t), 3))
    return START + (t * 1e9).astype("timedelta64[ns]"), ecef_from_geodetic(*ORIGIN) + enu @ enu_axes(*ORIGIN[:2])


@pytest.mark.requirement("A2")
@settings(deadline=None, max_examples=12)
@given(
    seed=st.integers(0, 2**32 - 1),
    sigma=st.sampled_from([0.0, 0.01, 0.05]),
    drift=st.sampled_from([0.0, 0.02]),
    stand=st.sampled_from([40, 300, 2000]),
)
def test_standing_draws_no_loops(seed: int, sigma: float, drift: float, stand: int) -> None:
    speed = np.concatenate([np.zeros(stand), np.full(200, 10.0), np.zeros(stand), np.full(200, 10.0), np.zeros(stand)])
    time, ecef = run_of(speed, sigma, seed, drift)
    track = from_positions(time, ecef)
    north = ((track.ecef_m - ecef_from_geodetic(*ORIGIN)) @ enu_axes(*ORIGIN[:2]).T)[:, 1]
    # where the reference itself drifted sideways while standing, the map steps sideways: back by no more than noise,
    # the largest of some stops (five standard deviations of a difference)
    assert (np.diff(north) > -7.0 * sigma - 1e-6).all()
    assert 65 <= len(track) <= 85  # 400 m at 5 m, positions every metre
    assert north[-1] - north[0] > 390.0


def test_without_times_the_spacing_alone_holds_against_jitter() -> None:
    speed = np.concatenate([np.zeros(2000), np.full(300, 10.0), np.zeros(2000)])
    time, ecef = run_of(speed, 0.3)
    track = from_positions(np.full_like(time, np.datetime64("NaT", "ns")), ecef)
    north = ((track.ecef_m - ecef_from_geodetic(*ORIGIN)) @ enu_axes(*ORIGIN[:2]).T)[:, 1]
    assert (np.diff(north) > 0).all()
    assert np.diff(track.chainage_m).min() > 0.9


def test_every_row_is_accounted_for() -> None:
    time, ecef = run_of(np.concatenate([np.zeros(100), np.full(200, 10.0)]), 0.01)
    ecef[50] = np.nan
    usable = np.ones(300, dtype=np.bool_)
    usable[200:210] = False
    ecef.flags.writeable = False
    thinned = thin(time, ecef, usable=usable)
    assert len(thinned.kept) + sum(thinned.dropped.values()) == 300
    assert thinned.dropped["without a position"] == 1
    assert thinned.dropped["of insufficient quality"] == 10


def test_gaps_and_reversals_are_reported_and_a_slow_train_is_kept() -> None:
    time, ecef = run_of(np.full(400, 10.0), 0.0)
    keep = np.ones(400, dtype=np.bool_)
    keep[100:200] = False
    thinned = thin(time, ecef, usable=keep)
    assert len(thinned.jumps) == 1
    assert thinned.jump_m[0] == pytest.approx(101.0, abs=5.0)
    there_and_back = np.concatenate([ecef[:200], ecef[199::-1]])
    assert len(thin(time, there_and_back).turns) == 1
    track = from_positions(time, there_and_back)
    assert any("turns back" in note for note in track.provenance.notes)
    slow_time, slow = run_of(np.full(600, 0.5), 0.01)
    assert from_positions(slow_time, slow).chainage_m[-1] > 25.0


def test_bends_between_two_points_are_kept() -> None:
    angle = np.arange(0.0, 3.0, 0.05)
    enu = np.stack([6.0 * (1.0 - np.cos(angle)), 6.0 * np.sin(angle), 0 * angle], axis=1)
    ecef = ecef_from_geodetic(*ORIGIN) + enu @ enu_axes(*ORIGIN[:2])
    time = START + (np.arange(len(angle)) * 1e8).astype("timedelta64[ns]")
    _, offset = Trajectory.from_antenna_path(from_positions(time, ecef)).nearest(ecef)
    _, coarse = Trajectory.from_antenna_path(from_positions(time, ecef, limits=ThinningLimits(chord_m=9.0))).nearest(
        ecef
    )
    assert offset.max() < 0.30 < coarse.max()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"quality": (4,)}, "has quality 4; the log has 1 of quality 1"),
        ({"max_sigma_m": 0.001}, "left, but a track needs two"),
    ],
)
def test_a_log_without_enough_good_positions(tmp_path: Path, options: dict[str, object], said: str) -> None:
    path = tmp_path / "run.pos"
    path.write_text(pos("GPST", "week", "deg"), encoding="utf-8")
    with pytest.raises(NoPositionError, match=said):
        from_position_log(read_positions(path), **options)  # type: ignore[arg-type]


def test_filters_that_the_log_cannot_serve(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("latitude_deg,longitude_deg,height_m\n35,139,1\n35.0001,139,1\n", encoding="utf-8")
    log = read_positions(path)
    with pytest.raises(InputFileError, match="no column 'quality'"):
        from_position_log(log, quality=(1,))
    with pytest.raises(InputFileError, match="no standard deviations"):
        from_position_log(log, max_sigma_m=0.1)
    assert len(from_position_log(log)[0]) == 2


@pytest.mark.parametrize("name", list(TRUTHS))
def test_maps_of_the_recordings(name: str, tmp_path: Path, recordings: Path) -> None:
    """The reference, written as CSV and thinned: the map stays within its own accuracy of it."""
    time, ecef = TRUTHS[name](recordings)
    log = read_positions(write_truth_csv((time, ecef), tmp_path / "truth.csv"))
    np.testing.assert_array_equal(log.time, time)
    np.testing.assert_allclose(log.ecef_m, ecef, atol=1e-4)
    track, thinned = from_position_log(log)
    assert ANTENNA_PATH in track.provenance.notes
    _, offset = Trajectory.from_antenna_path(track).nearest(ecef)
    assert np.percentile(offset, 50) < 0.05
    assert np.percentile(offset, 99) < 1.1
    assert len(thinned.turns) == (name == "gsdc")  # that car backs out of a parking place once


def test_rtk_log_of_the_recordings_is_thinned_by_quality(recordings: Path) -> None:
    path = next((recordings / "kinematic").glob("japan_mosaic*")) / "rtklib_rtk_ref_l1_GE.pos"
    log = read_positions(path)
    track, thinned = from_position_log(log)
    assert thinned.dropped["of insufficient quality"] == 17
    assert len(log) == 360
    assert 1400.0 < track.chainage_m[-1] < 1500.0
    everything, _ = from_position_log(log, quality=(1, 2))
    assert len(everything) > len(track)


def test_notes_survive_the_file(tmp_path: Path) -> None:
    from railfix.track import write_track_csv

    time, ecef = run_of(np.full(100, 10.0), 0.0)
    write_track_csv(from_positions(time, ecef), tmp_path / "map.csv")
    assert ANTENNA_PATH in read_track(tmp_path / "map.csv").provenance.notes


# -- broken lines --------------------------------------------------------------------------------------------

_CSV = "time_gpst,latitude_deg,longitude_deg,height_m\n" + "".join(
    f"2024-01-01T10:00:0{k},48.0,11.00{k},500.0\n" for k in range(5)
)
_POS = "%  GPST  latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m)\n" + "".join(
    f"2024/01/01 10:00:0{k}.000 48.0 11.00{k} 500.0 1 9 0.01 0.01 0.02\n" for k in range(5)
)


@pytest.mark.requirement("A6")
@pytest.mark.parametrize("text", [_CSV, _POS], ids=["csv", "rtklib"])
def test_a_cut_last_line_costs_itself_and_a_broken_one_needs_leave(tmp_path: Path, text: str) -> None:
    path = tmp_path / ("log.pos" if text.startswith("%") else "log.csv")
    path.write_text(text)
    whole = read_positions(path)
    path.write_text(text[:-17])
    cut = read_positions(path)
    assert len(cut) == len(whole) - 1 == 4
    np.testing.assert_array_equal(cut.sigma_m, whole.sigma_m[:4])
    assert any("line 6" in note and note.endswith("the line was skipped") for note in cut.notes)
    lines = text.splitlines(keepends=True)
    path.write_text("".join([*lines[:3], lines[3].replace("48.0", "4x.0"), *lines[4:]]))
    with pytest.raises(InputFileError, match=r"line 4: .*--lenient"):
        read_positions(path)
    lenient = read_positions(path, broken_lines="count")
    assert lenient.line.tolist() == [2, 3, 5, 6]


@pytest.mark.requirement("A6")
def test_a_reference_is_read_with_the_same_leave(tmp_path: Path) -> None:
    path = tmp_path / "reference.csv"
    path.write_text(_CSV.replace("02,48.0", "02,?"))
    with pytest.raises(InputFileError, match="--lenient"):
        read_reference(path, ["front"])
    assert len(read_reference(path, ["front"], broken_lines="count")["front"]) == 4
