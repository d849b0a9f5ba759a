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
from railfix.io.nmea import read_any_positions, read_nmea
from railfix.io.position_log import read_positions

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
    found = read_any_positions(path)
    assert found.quality.tolist() == [0, 1]
    assert np.isnan(found.ecef_m[0]).all()
    assert not np.isnan(found.ecef_m[1]).any()


GOOD = [rmc("010000.00", "050324"), gga("010000.00")]


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ([*GOOD, gga("010001.00")[:-2] + "00"], r"line 3: the checksum is 00, \w\w was expected"),
        ([*GOOD, "garbage"], "line 3: this sentence does not begin with"),
        ([*GOOD, "$GNGGA,010001.00"], "line 3: this sentence has no checksum"),
        ([*GOOD, signed("GNGGA,010001.00,3521,N")], "line 3: a field of GGA is invalid"),
        ([*GOOD, gga("010001.00", latitude="9921.0,N")], "line 3: a field of GGA is invalid"),
        ([*GOOD, gga("010001.00", geoid="")], "line 3: height or geoid separation is missing"),
        ([gga("010000.00")], "no RMC or ZDA sentence, the date is unknown"),
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
        logs.append(read_any_positions(out))
    nmea, table = logs
    assert nmea.ratio is None
    assert table.ratio is not None
    assert read_positions(tmp_path / "a.pos").ratio is not None
    np.testing.assert_array_equal(nmea.time, table.time)
    np.testing.assert_array_equal(nmea.quality, table.quality)
    assert (nmea.quality == 1).sum() > 100
    np.testing.assert_allclose(nmea.ecef_m, table.ecef_m, atol=2e-3)
