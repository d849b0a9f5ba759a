"""NMEA logs: hand-worked sentences, dates and midnights, RTKLIB's own NMEA of a real log, broken sentences."""

from __future__ import annotations

import shutil
import subprocess
from functools import reduce
from pathlib import Path

import numpy as np
import pytest

from railfix.core.errors import InputFileError
from railfix.core.geodesy import ecef_from_geodetic
from railfix.io.nmea import read_nmea
from railfix.io.positions import read_positions

pytestmark = pytest.mark.requirement("D1")


def signed(body: str) -> str:
    return f"${body}*{reduce(lambda a, b: a ^ b, body.encode()):02X}"


#: The example of the NMEA standard's descriptions, with its published checksum.
PUBLISHED = "$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47"


def gga(clock: str, quality: int = 4, latitude: str = "3521.0000000,N", geoid: str = "38.5000") -> str:
    return signed(f"GNGGA,{clock},{latitude},13930.0000000,E,{quality},12,0.8,10.0000,M,{geoid},M,1.0,0001")


def rmc(clock: str, date: str) -> str:
    return signed(f"GNRMC,{clock},A,3521.0000000,N,13930.0000000,E,0.1,0.0,{date},,,R")


def log(path: Path, *lines: str) -> Path:
    path.write_bytes("\r\n".join([*lines, ""]).encode())
    return path


def test_a_published_sentence(tmp_path: Path) -> None:
    found = read_nmea(log(tmp_path / "a.nmea", PUBLISHED), date=np.datetime64("1994-03-23"))
    # 48 deg 7.038 min N, 11 deg 31.000 min E, 545.4 + 46.9 m; UTC is 9 s behind GPS time in March 1994
    np.testing.assert_allclose(found.ecef_m[0], ecef_from_geodetic(48.1173, 11.0 + 31.0 / 60.0, 592.3), atol=1e-6)
    assert found.time[0] == np.datetime64("1994-03-23T12:35:28")
    assert found.quality.tolist() == [5]


def test_dates_and_midnight(tmp_path: Path) -> None:
    path = log(
        tmp_path / "a.nmea",
        gga("235959.00"),
        rmc("235959.00", "310123"),
        gga("000000.00"),
        rmc("000000.00", "010223"),
        gga("000000.20", 5),
        signed("GNZDA,000001.00,01,02,2023,00,00"),
        gga("000001.00", 2, "3521.0000000,S"),
    )
    found = read_nmea(path)
    expected = [f"2023-02-01T00:00:{s}" for s in ("17", "18", "18.2", "19")]
    np.testing.assert_array_equal(found.time, np.array(expected, dtype="datetime64[ns]"))
    assert found.quality.tolist() == [1, 1, 2, 4]
    assert found.ecef_m[3, 2] == pytest.approx(-found.ecef_m[0, 2])
    chained = read_nmea(log(tmp_path / "b.nmea", gga("235959.00"), gga("000000.00")), date=np.datetime64("2023-01-31"))
    np.testing.assert_array_equal(chained.time, found.time[:2])


def test_an_epoch_without_a_position_stays_a_row(tmp_path: Path) -> None:
    path = log(
        tmp_path / "a.nma", rmc("010000.00", "050324"), signed("GNGGA,010000.00,,,,,0,00,,,M,,M,,"), gga("010001.00")
    )
    found = read_positions(path)
    assert found.quality.tolist() == [0, 1]
    assert np.isnan(found.ecef_m[0]).all()
    assert not np.isnan(found.ecef_m[1]).any()


GOOD = [rmc("010000.00", "050324"), gga("010000.00")]
LAST = gga("010005.00")


@pytest.mark.parametrize(
    ("line", "note"),
    [
        ("!AIVDM,1,1,,A,13u?etPv2;0n:dDPwUM1U1Cb069D,0*24", "1 skipped lines that are not NMEA"),
        ("garbage", "1 skipped lines that are not NMEA"),
        ("NMEA," + gga("010001.00") + ",1709600401000", ""),
        (gga("010001.00").partition("*")[0], "1 sentences without checksum"),
        (gga("010001.00", geoid=""), "1 of 3 fixes have no height or no geoid separation"),
    ],
)
def test_logs_as_recorders_write_them_are_read(line: str, note: str, tmp_path: Path) -> None:
    """Sentences of AIS, other lines, a word before the sentence, no checksum, a fix in two dimensions."""
    found = read_nmea(log(tmp_path / "a.nmea", *GOOD, line, LAST))
    a_fix = "GGA" in line
    assert len(found) == (3 if a_fix else 2)
    assert any(note in text for text in found.notes)
    latitude, longitude, height = found.geodetic
    np.testing.assert_allclose(latitude, latitude[0], atol=1e-9)
    np.testing.assert_allclose(longitude, longitude[0], atol=1e-9)
    assert np.isnan(height).tolist() == ([False, "fixes" in note, False] if a_fix else [False, False])
    assert read_positions(tmp_path / "a.nmea").line.tolist() == found.line.tolist()


@pytest.mark.parametrize("last", [gga("010005.00")[:20], gga("010005.00")[:-1]])
def test_a_cut_last_sentence_is_dropped_with_a_note(last: str, tmp_path: Path) -> None:
    found = read_nmea(log(tmp_path / "a.nmea", *GOOD, last))
    assert len(found) == 1
    assert "line 3" in found.notes[-1]
    assert "skipped" in found.notes[-1]


def test_a_separation_of_zero_is_doubted_where_the_geoid_is_elsewhere(tmp_path: Path) -> None:
    found = read_nmea(log(tmp_path / "a.nmea", rmc("010000.00", "050324"), gga("010000.00", geoid="0.0")))
    (note,) = (text for text in found.notes if "separation is 0" in text)
    assert "38 m (EGM96)" in note  # at 35.35 N, 139.5 E


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ([*GOOD, gga("010001.00")[:-2] + "00", LAST], r"line 3: the checksum is 00, \w\w was expected; --lenient"),
        ([*GOOD, signed("GNGGA,010001.00,3521,N"), LAST], "line 3: a field of GGA is invalid; --lenient"),
        ([*GOOD, gga("010001.00", latitude="9921.0,N"), LAST], "line 3: a field of GGA is invalid"),
        ([gga("010000.00")], "no RMC or ZDA sentence, so the date is unknown"),
        (GOOD[:1], "there is no GGA sentence"),
    ],
)
def test_broken_logs_are_refused(lines: list[str], said: str, tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match=said):
        read_nmea(log(tmp_path / "a.nmea", *lines))


def test_skipped_sentences_are_named(tmp_path: Path) -> None:
    found = read_nmea(
        log(tmp_path / "a.nmea", *GOOD, gga("010001.00")[:-2] + "00", gga("010002.00")), broken_lines="count"
    )
    assert len(found) == 2
    assert "line 3: the checksum is 00" in found.notes[1]


def test_nmea_written_by_rtklib_is_its_own_solution(tmp_path: Path, recordings: Path) -> None:
    """The same kinematic run as NMEA and as RTKLIB's table: 0.1 mm of minutes, 1 mm of height."""
    program = shutil.which("rnx2rtkp")
    if program is None:
        pytest.skip("rnx2rtkp is not installed")
    folder = recordings / "kinematic" / "japan_mosaic_2021265_with_GEONET3034"
    inputs = [str(folder / name) for name in ("SEPT265G.21O", "3034265G.21O", "SEPT2650.21P")]
    logs = []
    for name, options in (("a.nmea", ["-n"]), ("a.pos", ["-e"])):
        out = tmp_path / name
        subprocess.run([program, "-p", "2", *options, "-o", str(out), *inputs], check=True, capture_output=True)
        logs.append(read_positions(out))
    nmea, table = logs
    assert nmea.ratio is None
    assert table.ratio is not None
    assert read_positions(tmp_path / "a.pos").ratio is not None
    np.testing.assert_array_equal(nmea.time, table.time)
    np.testing.assert_array_equal(nmea.quality, table.quality)
    assert (nmea.quality == 1).sum() > 100
    np.testing.assert_allclose(nmea.ecef_m, table.ecef_m, atol=2e-3)
