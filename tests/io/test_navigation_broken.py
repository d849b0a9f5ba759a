"""Broken navigation files: one sentence that names the file, the line and what is wrong, and nothing half-read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from navigation_text import header, label, record, record_2, write
from railfix.core.errors import InputFileError, SettingsError
from railfix.gnss.navigation import Navigation
from railfix.io.rinex import read_navigation

pytestmark = pytest.mark.requirement("A7")

GOOD = record("G01")
LINES = GOOD.splitlines(keepends=True)


def _damaged(line: int, old: str, new: str) -> str:
    lines = LINES.copy()
    assert old in lines[line], "the damage must hit"
    lines[line] = lines[line].replace(old, new, 1)
    return header() + GOOD.replace("G01", "G02") + "".join(lines)


#: Content, line that the error must name (None: the whole file), words that it must say.
CASES: dict[str, tuple[str, int | None, str]] = {
    "observation file": (header(kind="OBSERVATION DATA") + GOOD, None, "observation file"),
    "meteorological file": (header(kind="METEOROLOGICAL DATA") + GOOD, None, "a RINEX navigation file was expected"),
    "no RINEX": ("$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\n", None, "is an NMEA log"),
    "version no number": (header().replace("     3.04", "    three", 1) + GOOD, 1, "version .* is not a number"),
    "version 1": (header(1.0) + GOOD, 1, "version 1.00 is not supported"),
    "version 5": (header(5.0) + GOOD, 1, "version 5.00 is not supported"),
    "header without end": (header(end="COMMENT"), None, "END OF HEADER"),
    "header alone": (header(), None, "no record"),
    "header and blank lines": (header() + "\n\n  \n", None, "no record"),
    "leap seconds in words": (header(lines=[label("   ten", "LEAP SECONDS")]) + GOOD, 2, "LEAP SECONDS"),
    "ionosphere in words": (header(lines=[label("GPSA   0.11oops", "IONOSPHERIC CORR")]) + GOOD, 2, "IONOSPHERIC CORR"),
    "only SBAS": (header() + "".join(record("S22").splitlines(keepends=True)[:4]), None, "no usable"),
    "cut in the middle of a record": (
        header() + "".join(LINES[:5]) + GOOD, 3, "G01 has 5 lines, but 8 were expected.*; --lenient"),
    "cut in its only record": (header() + "".join(LINES[:5]), None, "no usable .* G01 has 5 lines, but 8 were"),
    "a line of a record lost": (header() + "".join(LINES[:3] + LINES[4:]) + GOOD, 3, "G01 has 7 lines, but 8 were"),
    "name of the next record lost": (
        header() + GOOD + GOOD.replace("G01", "   ") + GOOD, 3, "G01 has 16 lines, but 8 were"),
    "record before any name": (header() + "".join(LINES[1:]) + GOOD, 3, "before the first record"),
    "unknown constellation": (header() + GOOD.replace("G01", "X01"), 3, "'X01' is not a satellite name"),
    "satellite zero": (header() + GOOD.replace("G01", "G00"), 3, "'G00' is not a satellite name"),
    "satellite in letters": (header() + GOOD.replace("G01", "Gxx"), 3, "'Gxx' is not a satellite name"),
    "month 13": (_damaged(0, "2020 06", "2020 13"), 11, "epoch .* of G01 is not a date"),
    "year 9020": (_damaged(0, "2020 06", "9020 06"), 11, "epoch .* of G01 is not a date"),
    "endless second": (_damaged(0, "08 00 00", "08 00inf"), 11, "epoch .* of G01 is not a date"),
    "31 June": (_damaged(0, "06 26", "06 31"), 11, "epoch .* of G01 is not a date"),
    "blank time": (_damaged(0, "08 00 00", "        "), 11, "epoch .* of G01 is not a date"),
    "letters in a clock": (_damaged(0, "1.234567890123D-04", "1.2345oooo0123D-04"), 11, "G01: af0_s '-1.2345oooo"),
    "letters in an orbit": (_damaged(2, "5.153700000000D+03", "5.1537OO000000D+03"), 13, "G01: sqrt_a '5.1537OO"),
    "not a number": (_damaged(3, "4.608000000000D+05", "               nan"), 14, "G01: toe_sow_s 'nan' is not"),
    "infinite": (_damaged(1, "1.234500000000D+00", "               inf"), 12, "G01: m0 'inf' is not a number"),
    "root of the axis zero": (_damaged(2, "5.153700000000D+03", "0.000000000000D+00"), 13, "G01: sqrt_a is 0"),
    "root of the axis blank": (_damaged(2, "5.153700000000D+03", " " * 18), 13, "G01: sqrt_a is blank"),
    "hyperbola": (_damaged(2, "1.230000000000D-02", "1.230000000000D+00"), 13, "G01: eccentricity is 1.23"),
    "time outside the week": (_damaged(3, "4.608000000000D+05", "6.608000000000D+05"), 14, "G01: toe_sow_s is 660800"),
    "clock of hours": (_damaged(0, "1.234567890123D-04", "1.234567890123D+04"), 11, "G01: af0_s is -12345.7"),
    "exponent too long": (_damaged(1, "4.600000000000D-09", "4.60000000000D+109"), 12, "G01: delta_n is 4.6e.109"),
    "angle of many turns": (_damaged(1, "1.234500000000D+00", "1.234500000000D+02"), 12, "G01: m0 is 123.45"),
    "columns shifted": (_damaged(4, "    ", "     "), 15, "G01: "),
    "GLONASS without velocity": (header() + record("R05", {"y_velocity": None}), 5, "R05: y_velocity is blank"),
    "GLONASS with six lines": (header() + record("R05", {"extra": [1.0] * 8}) + GOOD, 3, "R05 has 6 lines, but 4 were"),
    "version 2 cut": (header(2.1) + record_2(" 1", time="20  6 26  8  0  0.0")[:-80], None, "G01 has 7 lines"),
    "version 2 without a number": (header(2.1) + record_2(" x", time="20  6 26  8  0  0.0"), 3, "'G x' is no"),
    "version 4 title": (header(4.0) + "> EPH\n" + GOOD, 3, "'> EPH' is no"),
    "version 4 ionosphere cut": (header(4.0) + "> ION G01 LNAV\n    2020 06 26 00 00 00\n", 4, "record has 1 line"),
    "version 4 without titles": (header(4.0) + GOOD, 3, "before the first record"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_error_names_file_line_and_cause(tmp_path: Path, case: str) -> None:
    text, line, words = CASES[case]
    path = write(tmp_path, text)
    with pytest.raises(InputFileError, match=words) as caught:
        read_navigation(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert caught.value.line == line
    assert "\n" not in message
    assert caught.value.exit_code == 3


@pytest.mark.requirement("G5")
def test_a_cut_last_record_is_left_out_with_a_note(tmp_path: Path) -> None:
    found = read_navigation(write(tmp_path, header() + GOOD + "".join(LINES[:5])))
    assert found.skipped == {"records cut short by the end of the file": 1}
    assert len(found.kepler) == len(found.notes) == 1


@pytest.mark.requirement("G5")
@pytest.mark.parametrize(("kind", "satellite"), [("E", "E"), ("L", "E"), ("J", "J"), ("N", "G")])
@pytest.mark.parametrize("version", [2.11, 2.12, 3.0])
def test_files_of_one_constellation(tmp_path: Path, kind: str, satellite: str, version: float) -> None:
    """RINEX 2.11, 2.12 and 3.00 have files of Galileo (E, L) and QZSS (J) beside those of GPS."""
    first = header(version).replace("N: GNSS NAV DATA", f"{kind:<16}", 1)
    first = first[:20] + kind + first[21:]
    body = record(f"{satellite}03") if version >= 3.0 else record_2(" 3", time="20  6 26  8  0  0.0")
    found = read_navigation(write(tmp_path, first + body))
    assert found.kepler.satellite.tolist() == [f"{satellite}03"]


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match="no such file"):
        read_navigation(tmp_path / "none.nav")
    with pytest.raises(InputFileError, match="folder"):
        read_navigation(tmp_path)
    with pytest.raises(SettingsError, match="no file"):
        read_navigation([])


def test_one_broken_file_of_several_is_named(tmp_path: Path) -> None:
    good = write(tmp_path, header() + GOOD, "good.nav")
    bad = write(tmp_path, header() + "".join(LINES[:4]) + GOOD, "bad.nav")
    with pytest.raises(InputFileError, match=r"bad\.nav, line 3"):
        read_navigation([good, bad])


@given(data=st.data())
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damage_anywhere_is_an_error_or_a_table(tmp_path: Path, data: st.DataObject) -> None:
    """A changed, lost or added character never ends in anything but a sentence, or numbers that are finite."""
    text = header() + GOOD + record("E03") + record("R05") + record("C03")
    at = data.draw(st.integers(0, len(text) - 1))
    length = data.draw(st.sampled_from([0, 1, 1, 30]))
    put = data.draw(st.text(alphabet="0123456789 .-+DEGRx\n", max_size=3))
    path = write(tmp_path, text[:at] + put + text[at + length :])
    try:
        navigation = read_navigation(path)
    except InputFileError as error:
        named = str(error)
        navigation = None
    if navigation is None:
        assert str(path) in named
        return
    assert isinstance(navigation, Navigation)
    assert np.isfinite(navigation.kepler.sqrt_a).all()
    assert np.isfinite(navigation.glonass.position_ecef_m).all()
    counted = read_navigation(path, broken_lines="count")
    assert len(counted.kepler) == len(navigation.kepler)
