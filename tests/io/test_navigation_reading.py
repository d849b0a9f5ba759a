"""Navigation files of every version, and the traps that files in the field hold."""

from __future__ import annotations

import gzip
from pathlib import Path

import ncompress
import numpy as np
import pytest

from navigation_text import KEPLER, header, label, number, record, record_2, write
from railfix.gnss.navigation import Navigation, glonass_channels
from railfix.gnss.observations import carrier_frequency_hz
from railfix.io.rinex import read_navigation

pytestmark = pytest.mark.requirement("A7")

TOC = np.datetime64("2020-06-26T08:00:00", "ns")


def read(folder: Path, text: str, **options: str) -> Navigation:
    return read_navigation(write(folder, text), **options)  # type: ignore[arg-type]


def after(seconds: float) -> np.datetime64:
    return TOC + np.timedelta64(round(seconds * 1e9), "ns")


# ---------------------------------------------------------------- fields


def test_every_field_of_a_gps_record_stands_where_it_belongs(tmp_path: Path) -> None:
    names = [n for n in KEPLER if n not in ("week", "flag", "transmitted", "fit", "data_source", "group_delay_2_s")]
    values = {name: 1e-8 * (k + 1) for k, name in enumerate(names)}
    values |= {"sqrt_a": 5153.5, "toe_sow_s": 460784.0, "iode": 17.0, "health": 3.0}
    kepler = read(tmp_path, header() + record("G07", {**values, "group_delay_2_s": 529.0})).kepler
    assert kepler.satellite.tolist() == ["G07"]
    assert kepler.message.tolist() == ["LNAV"]
    for name, value in values.items():
        assert getattr(kepler, name)[0] == pytest.approx(value, rel=1e-12), name
    assert kepler.iodc[0] == 529
    assert np.isnan(kepler.group_delay_2_s[0])
    assert kepler.toc[0] == TOC
    assert kepler.toe[0] == after(-16)
    assert kepler.transmitted[0] == after(-3600)
    assert kepler.fit_interval_h[0] == 4.0
    assert kepler.data_source[0] == 1  # codes on L2


def test_galileo_and_beidou_have_their_own_last_lines(tmp_path: Path) -> None:
    galileo = {"data_source": 517.0, "group_delay_1_s": -2e-9, "group_delay_2_s": -3e-9, "fit": None}
    beidou = {"group_delay_1_s": 6e-9, "group_delay_2_s": 7e-9, "fit": 12.0, "week": 755.0, "iode": 3.0}
    kepler = read(tmp_path, header() + record("E05", galileo) + record("C20", beidou)).kepler
    assert kepler.group_delay_1_s.tolist() == [-2e-9, 6e-9]
    assert kepler.group_delay_2_s.tolist() == [-3e-9, 7e-9]
    assert kepler.data_source.tolist() == [517, 0]
    assert kepler.iodc.tolist() == [45, 12]
    assert np.isnan(kepler.fit_interval_h).all()


def test_beidou_times_are_in_bdt(tmp_path: Path) -> None:
    kepler = read(tmp_path, header() + record("C20", {"week": 755.0})).kepler
    assert kepler.toc[0] == kepler.toe[0] == after(14)
    assert kepler.transmitted[0] == after(14 - 3600)
    assert kepler.toe_sow_s[0] == 460800.0


@pytest.mark.parametrize(
    ("name", "source", "message"),
    [
        ("E01", 0b0000000101, "INAV"),
        ("E01", 0b1000000001, "INAV"),
        ("E01", 0b1000000100, "INAV"),
        ("E01", 0b0100000010, "FNAV"),
        ("E01", 0b0000000111, "INAV"),
        ("G01", 1, "LNAV"),
        ("J02", 1, "LNAV"),
        ("C01", 0, "D2"),
        ("C05", 0, "D2"),
        ("C06", 0, "D1"),
        ("C58", 0, "D1"),
        ("C60", 0, "D2"),
    ],
)
def test_message_before_version_4(tmp_path: Path, name: str, source: int, message: str) -> None:
    kepler = read(tmp_path, header() + record(name, {"data_source": float(source)})).kepler
    assert kepler.message.tolist() == [message]


@pytest.mark.parametrize(
    ("name", "fit", "hours"),
    [
        *[
            ("G01", fit, hours)
            for fit, hours in ((0.0, 4.0), (None, 4.0), (1.0, 6.0), (4.0, 4.0), (6.0, 6.0), (26.0, 26.0))
        ],
        *[("J01", fit, hours) for fit, hours in ((0.0, 2.0), (None, 2.0), (1.0, 4.0), (2.0, 2.0))],
    ],
)
def test_fit_interval(tmp_path: Path, name: str, fit: float | None, hours: float) -> None:
    assert read(tmp_path, header() + record(name, {"fit": fit})).kepler.fit_interval_h[0] == hours


def test_glonass_is_utc_and_kilometres(tmp_path: Path) -> None:
    glonass = read(tmp_path, header() + record("R05", time="2020 06 26 07 45 00")).glonass
    utc = np.datetime64("2020-06-26T07:45:18", "ns")
    assert glonass.toe[0] == utc
    assert glonass.transmitted[0] == utc + np.timedelta64(459000 - (460800 - 900), "s")
    assert glonass.clock_bias_s[0] == 5e-5
    assert glonass.relative_frequency[0] == 9e-13
    np.testing.assert_allclose(glonass.position_ecef_m[0], [1e7, 1.5e7, 1.8e7])
    np.testing.assert_allclose(glonass.velocity_ecef_mps[0], [1e3, -2e3, 1.1e3])
    np.testing.assert_allclose(glonass.acceleration_ecef_mps2[0], [1.8e-6, 0.0, -9.3e-7])
    assert glonass.health[0] == 0
    assert glonass.frequency_channel[0] == -4


def test_glonass_of_3_05_has_a_fifth_line(tmp_path: Path) -> None:
    five = {"extra": [1.0, 2.0, 3.0, 15.0]}
    text = header(3.05) + record("R05", five) + record("R06", five) + record("R07", {"extra": [None, None]})
    glonass = read(tmp_path, text).glonass
    assert glonass.satellite.tolist() == ["R05", "R06", "R07"]
    assert (glonass.frequency_channel == -4).all()


def test_glonass_channels_of_the_navigation_file(tmp_path: Path) -> None:
    text = header() + record("R05", {"frequency_channel": 1.0}) + record("R10", {"frequency_channel": -7.0})
    navigation = read(tmp_path, text + record("R05", {"frequency_channel": 1.0}, time="2020 06 26 08 15 00"))
    channels = glonass_channels(navigation)
    assert channels == {"R05": 1, "R10": -7}
    frequency = carrier_frequency_hz(np.array(["R05", "R10", "R11"]), np.array(["1C", "2C", "1C"]), channels)
    np.testing.assert_array_equal(frequency, [1602e6 + 562.5e3, 1246e6 - 7 * 437.5e3, np.nan])


# ---------------------------------------------------------------- versions


def test_version_2_gps(tmp_path: Path) -> None:
    text = header(2.11, "N: GPS NAV DATA") + record_2(" 7", time="20  6 26  8  0  0.0")
    text += record_2("23", {"toe_sow_s": 0.0}, time="99 12 26  0  0  0.5")
    kepler = read(tmp_path, text).kepler
    assert kepler.satellite.tolist() == ["G07", "G23"]
    assert kepler.toc.tolist() == [TOC.astype(int), np.datetime64("1999-12-26T00:00:00.5", "ns").astype(int)]
    assert kepler.sqrt_a.tolist() == [5153.7, 5153.7]
    assert kepler.toe[1] == np.datetime64("1999-12-26T00:00:00", "ns")


def test_version_2_with_a_letter_has_its_columns_one_further(tmp_path: Path) -> None:
    """RINEX 2.12 of QZSS as JAXA published it: ``J 1 12 10 31 ...``, further lines indented by four."""
    text = record("J 1", time="20  6 26  8  0  0.0")
    kepler = read(tmp_path, header(2.12) + text).kepler
    assert kepler.satellite.tolist() == ["J01"]
    assert kepler.toe[0] == np.datetime64("2020-06-26T08:00:00", "ns")
    assert kepler.sqrt_a[0] == 5153.7
    assert kepler.af0_s[0] == -1.234567890123e-04


def test_version_2_glonass_counts_the_seconds_of_the_day(tmp_path: Path) -> None:
    times = ["20  6 26  7 45  0.0", "20  6 26  0  0  0.0"]
    text = header(2.11, "GLONASS NAV DATA") + record_2(" 5", {"message_time": 27000.0}, time=times[0], system="R")
    text += record_2("24", {"message_time": 86370.0}, time=times[1], system="R")
    glonass = read(tmp_path, text).glonass
    assert glonass.satellite.tolist() == ["R05", "R24"]
    assert glonass.toe[0] == np.datetime64("2020-06-26T07:45:18", "ns")
    assert glonass.transmitted[0] == np.datetime64("2020-06-26T07:30:18", "ns")
    # sent just before midnight, for midnight
    assert glonass.transmitted[1] == np.datetime64("2020-06-25T23:59:48", "ns")


def test_version_4_reads_the_messages_and_counts_the_rest(tmp_path: Path) -> None:
    def eph(name: str, message: str, lines: int | None = None) -> str:
        text = f"> EPH {name} {message}\n" + record(name)
        return text if lines is None else text + "    0.000000000000D+00\n" * lines

    text = header(4.02) + eph("G01", "LNAV") + eph("E03", "INAV") + eph("E03", "FNAV")
    text += eph("C20", "D1") + eph("C03", "D2") + eph("J02", "LNAV") + eph("R05", "FDMA", 1)
    text += "> STO G01 LNAV\n    2020 06 26 00 00 00 GPUT\n" + "> EOP J02 CNVX\n    2020 06 26 00 00 00\n"
    text += "> STO E   IFNV\n    2020 06 26 00 00 00 GAGP\n" + "> STO R   FDMA\n    2020 06 26 00 00 00 GLGP\n"
    text += eph("S22", "SBAS") + eph("I02", "LNAV")
    navigation = read(tmp_path, text)
    assert list(zip(navigation.kepler.satellite.tolist(), navigation.kepler.message.tolist(), strict=True)) == [
        ("G01", "LNAV"), ("E03", "INAV"), ("E03", "FNAV"), ("C20", "D1"), ("C03", "D2"), ("J02", "LNAV"),
    ]  # fmt: skip
    assert navigation.glonass.satellite.tolist() == ["R05"]
    assert navigation.skipped == {"STO": 3, "EOP": 1, "S SBAS": 1, "I LNAV": 1}


#: Numbers of the newer messages after their orbits: ISC, then accuracy to ISC of CNAV; those of CNV1 after their ISC.
_ISC = [-1e-9, -2e-9, -3e-9, -4e-9]
_CNAV = [2.0, 0.0, -1e-8, 1.0, *_ISC]
_CNV = [5e-9, 6e-9, 1.0, 0.0, 0.0, 20.0, 457200.0, None, None, 21.0]


@pytest.mark.requirement("A11")
@pytest.mark.parametrize(
    ("name", "message", "last", "expected"),
    [
        ("G01", "CNAV", [*_CNAV, 457200.0, 2111.0], {"group_delay_1_s": -1e-8, "inter_signal_s": [*_ISC, None, None]}),
        (
            "J02", "CNV2", [*_CNAV, -5e-9, -6e-9, None, None, 457200.0, 2111.0],
            {"group_delay_1_s": -1e-8, "inter_signal_s": [*_ISC, -5e-9, -6e-9]},
        ),
        (
            "C20", "CNV1", [0.0, 0.0, 0.0, 0.0, 3e-9, None, *_CNV],
            {"group_delay_1_s": 5e-9, "inter_signal_s": [3e-9, *[None] * 5], "iodc": 20, "iode": 21},
        ),
        (
            "C20", "CNV2", [0.0, 0.0, 0.0, 0.0, None, 4e-9, *_CNV],
            {"group_delay_2_s": 6e-9, "inter_signal_s": [None, 4e-9, *[None] * 4], "iodc": 20, "iode": 21},
        ),
        (
            "C20", "CNV3", [0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 5e-9, 457200.0],
            {"group_delay_1_s": 5e-9, "group_delay_2_s": None, "inter_signal_s": [None] * 6, "iodc": 0},
        ),
    ],
)  # fmt: skip
def test_every_field_of_the_messages_of_version_4(
    tmp_path: Path, name: str, message: str, last: list[float | None], expected: dict[str, object]
) -> None:
    """Layouts of RINEX 4.02, tables A10, A11 and A18 to A20; `last` begins after the rate of delta_n."""
    names = list(KEPLER)[:20]  # up to i_dot, with a_dot where the issue of data stands
    cnav = name[0] in "GJ"
    first = {n: (2e-2 if n == "iode" else 400000.0 if cnav and n == "toe_sow_s" else KEPLER[n]) for n in names}
    between = [3e-14, -2.0, 1.0] if cnav else [3e-14, 3.0, 457200.0]
    fields = [*first.values(), *between, *last]
    lines = [f"{name} 2020 06 26 08 00 00" + "".join(number(v) for v in fields[:3])]
    lines += ["    " + "".join(number(v) for v in fields[i : i + 4]) for i in range(3, len(fields), 4)]
    records = read(tmp_path, header(4.02) + f"> EPH {name} {message}\n" + "\n".join(lines) + "\n").kepler
    assert records.message.tolist() == [message]
    assert (records.a_dot[0], records.delta_n_dot[0]) == (2e-2, 3e-14)
    for n in ("crs", "delta_n", "m0", "cuc", "sqrt_a", "cic", "cis", "i0", "omega_dot", "i_dot"):
        assert getattr(records, n)[0] == KEPLER[n], n
    leap = np.timedelta64(0 if cnav else 14, "s")
    assert records.toe[0] == records.toc[0] == TOC + leap
    assert records.transmitted[0] == TOC - np.timedelta64(3600, "s") + leap
    assert records.health[0] == 0
    assert records.accuracy_m[0] == pytest.approx(4.0 if cnav else np.nan, nan_ok=True)  # URA_ED 2: 2^(1 + 2/2)
    for n, value in expected.items():
        wanted = np.array(value, dtype=float)
        np.testing.assert_array_equal(np.asarray(getattr(records, n)[0], dtype=float), wanted, err_msg=n)


def test_version_4_ionosphere(tmp_path: Path) -> None:
    """Layout of RINEX 4.02, tables A32 to A34: time and three numbers, four, then one and a region code."""

    def ion(name: str, message: str, scale: float) -> str:
        v = [f"{scale * k:19.12E}" for k in range(1, 9)]
        lines = ["    2020 06 26 00 15 44" + "".join(v[:3]), "    " + "".join(v[3:7]), "    " + v[7] + f"{1.0:19.12E}"]
        return f"> ION {name} {message}\n" + "\n".join(lines) + "\n"

    text = header(4.0) + ion("G05", "LNAV", 1e-8) + ion("C02", "D1D2", 2e-8) + ion("J02", "LNAV", 3e-8)
    text += ion("G06", "LNAV", 9e-8) + ion("E01", "IFNV", 1.0) + ion("C20", "CNVX", 1.0)
    navigation = read(tmp_path, text + "> EPH G01 LNAV\n" + record("G01"))
    counted = np.arange(1, 9)
    assert {k: v.tolist() for k, v in navigation.klobuchar.items()} == {
        letter: pytest.approx(scale * counted) for letter, scale in (("G", 1e-8), ("C", 2e-8), ("J", 3e-8))
    }
    assert navigation.skipped == {"ION E IFNV": 1, "ION C CNVX": 1}


# ---------------------------------------------------------------- header


def test_ionosphere_of_versions_2_and_3(tmp_path: Path) -> None:
    alpha, beta = "  0.1118D-07  0.1490D-07 -0.5960D-07 -0.1192D-06", "  0.1106D+06  0.9830D+05 -0.1311D+06 -0.6554D+05"
    old = [label("  " + alpha, "ION ALPHA"), label("  " + beta, "ION BETA"), label("    13", "LEAP SECONDS")]
    two = read(tmp_path, header(2.1, lines=old) + record_2(" 1", time="20  6 26  8  0  0.0"))
    new = [
        label(f"{s}{h} {v}", "IONOSPHERIC CORR") for s in ("GPS", "BDS", "QZS") for h, v in (("A", alpha), ("B", beta))
    ]
    new += [label("GAL   4.0000E+01  0.0000E+00  0.0000E+00  0.0000E+00", "IONOSPHERIC CORR")]
    three = read(tmp_path, header(lines=new) + record("G01"))
    expected = [1.118e-8, 1.49e-8, -5.96e-8, -1.192e-7, 110600.0, 98300.0, -131100.0, -65540.0]
    assert two.klobuchar["G"].tolist() == expected
    assert two.leap_seconds == 13
    assert sorted(three.klobuchar) == ["C", "G", "J"]
    assert all(v.tolist() == expected for v in three.klobuchar.values())
    assert three.leap_seconds is None
    assert three.skipped == {"ionosphere GAL": 1}


def test_zero_ionosphere_means_not_received(tmp_path: Path) -> None:
    zero = "  0.0000D+00" * 4
    lines = [label(f"GPS{h} {zero}", "IONOSPHERIC CORR") for h in "AB"]
    navigation = read(tmp_path, header(lines=lines) + record("G01"))
    assert dict(navigation.klobuchar) == {}
    assert any("ionosphere" in note and "not received" in note for note in navigation.notes)


# ---------------------------------------------------------------- traps


def test_names_with_a_space(tmp_path: Path) -> None:
    navigation = read(tmp_path, header() + record("G 1") + record("R 5") + record("E 3"))
    assert navigation.kepler.satellite.tolist() == ["G01", "E03"]
    assert navigation.glonass.satellite.tolist() == ["R05"]
    four = read(tmp_path, header(4.0) + "> EPH G 1 LNAV\n" + record("G 1"))
    assert four.kepler.satellite.tolist() == ["G01"]


@pytest.mark.parametrize("exponent", ["D", "d", "E", "e"])
def test_exponents(tmp_path: Path, exponent: str) -> None:
    assert read(tmp_path, header() + record("G01", exponent=exponent)).kepler.m0[0] == KEPLER["m0"]


def test_line_ends_of_windows(tmp_path: Path) -> None:
    text = header() + record("G01") + record("R05")
    unix, windows = read(tmp_path, text), read(tmp_path, text.replace("\n", "\r\n"))
    assert unix.kepler.fit_interval_h.tolist() == windows.kepler.fit_interval_h.tolist()
    assert unix.glonass.age_days.tolist() == windows.glonass.age_days.tolist()


def test_blank_fields_and_short_lines(tmp_path: Path) -> None:
    blank = dict.fromkeys(("group_delay_1_s", "accuracy_m", "transmitted", "fit", "af2", "cis"))
    kepler = read(tmp_path, header() + record("G01", blank)).kepler
    assert np.isnan(kepler.accuracy_m[0])
    assert np.isnat(kepler.transmitted[0])
    assert np.isnan(kepler.group_delay_1_s[0]), "what is not known is not nought"
    assert (kepler.af2[0], kepler.cis[0]) == (0.0, 0.0)


def test_group_delay_that_is_unknown(tmp_path: Path) -> None:
    text = header() + record("E05", {"data_source": 517.0, "group_delay_1_s": 0.9999e9, "group_delay_2_s": None})
    kepler = read(tmp_path, text).kepler
    assert np.isnan(kepler.group_delay_1_s[0])
    assert np.isnan(kepler.group_delay_2_s[0])


@pytest.mark.parametrize("said", [0.9999e9, -0.9999e9, None])
def test_transmission_time_that_is_none(tmp_path: Path, said: float | None) -> None:
    assert np.isnat(read(tmp_path, header() + record("G01", {"transmitted": said})).kepler.transmitted[0])
    assert np.isnat(read(tmp_path, header() + record("R01", {"message_time": said})).glonass.transmitted[0])


@pytest.mark.parametrize("week", [63.0, 1087.0, 2111.0, 2110.0, 0.0, None])
def test_the_clock_time_tells_the_week(tmp_path: Path, week: float | None) -> None:
    """Converters write weeks modulo 1024, of another roll-over, or one off at the week's ends."""
    assert read(tmp_path, header() + record("G01", {"week": week})).kepler.toe[0] == TOC


def test_reference_times_across_the_week(tmp_path: Path) -> None:
    sunday, saturday = "2020 06 28 00 00 00", "2020 06 27 23 59 44"
    text = header() + record("G01", {"toe_sow_s": 604784.0, "transmitted": 604000.0}, time=sunday)
    text += record("G02", {"toe_sow_s": 0.0, "transmitted": 597600.0}, time=saturday)
    # Some files count the transmission in the week of toe, below zero.
    text += record("G03", {"toe_sow_s": 0.0, "transmitted": -7200.0}, time=sunday)
    kepler = read(tmp_path, text).kepler
    midnight = np.datetime64("2020-06-28T00:00:00", "ns")
    expected = midnight - np.array([16, 0, 0]) * np.timedelta64(1, "s")
    assert (kepler.toe == expected).all()
    assert (kepler.transmitted == midnight - np.array([800, 7200, 7200]) * np.timedelta64(1, "s")).all()


def test_duplicates_are_counted_and_corrections_kept(tmp_path: Path) -> None:
    changed = {"transmitted": 457230.0}
    text = header() + record("G01") + record("G01", changed) + record("G01") + record("E01", {"fit": None})
    navigation = read_navigation([write(tmp_path, text), write(tmp_path, text, "again.nav")])
    assert navigation.kepler.satellite.tolist() == ["G01", "G01", "E01"]
    assert navigation.skipped == {"duplicate": 5}


def test_records_of_another_year_are_kept_as_they_are(tmp_path: Path) -> None:
    text = header() + record("G01", time="2019 02 12 08 00 00", changes={"toe_sow_s": 201600.0}) + record("G01")
    kepler = read(tmp_path, text).kepler
    assert kepler.toe[0] == np.datetime64("2019-02-12T08:00:00", "ns")
    assert kepler.toe[1] == TOC


def test_other_constellations_are_counted(tmp_path: Path) -> None:
    sbas = "".join(record(f"S{n}").split("\n", 4)[i] + "\n" for n in (20, 37) for i in range(4))
    navigation = read(tmp_path, header() + sbas + record("I02") + record("G01"))
    assert navigation.skipped == {"S": 2, "I": 1}
    assert navigation.kepler.satellite.tolist() == ["G01"]


def test_packed_files(tmp_path: Path) -> None:
    text = (header() + record("G01")).encode()
    for name, content in (("a.rnx.gz", gzip.compress(text)), ("a.rnx.Z", ncompress.compress(text))):
        (tmp_path / name).write_bytes(content)
        assert read_navigation(tmp_path / name).kepler.satellite.tolist() == ["G01"]


def test_broken_records_are_skipped_counted_and_named(tmp_path: Path) -> None:
    broken = record("G02", {"sqrt_a": None}) + record("X03") + record("G04", time="2020 13 26 08 00 00")
    text = header() + record("G01") + broken + record("G05")
    navigation = read(tmp_path, text, broken_lines="count")
    assert navigation.kepler.satellite.tolist() == ["G01", "G05"]
    assert navigation.skipped == {"broken": 3}
    assert [note.split(":")[1].split(",")[1] for note in navigation.notes] == [" line 13", " line 19", " line 27"]


def test_tables_cannot_be_written_to(tmp_path: Path) -> None:
    kepler = read(tmp_path, header() + record("G01")).kepler
    with pytest.raises(ValueError, match="read-only"):
        kepler.m0[0] = 0.0
