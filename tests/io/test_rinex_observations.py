"""Observation files made in the test: every version, and what real files do to a reader."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from railfix.gnss.observations import Observations
from railfix.io import read_observations
from rinex_observations_text import epoch_2, epoch_3, event_2, field, header_2, header_3, record, write

pytestmark = pytest.mark.requirement("A7")


def channel(observations: Observations, satellite: str, signal: str) -> int:
    found = np.flatnonzero((observations.satellite == satellite) & (observations.signal == signal))
    assert len(found) == 1, f"{satellite} {signal} is {len(found)} channels"
    return int(found[0])


def four(code: float, *, tail: str = "  ") -> list[str]:
    return [field(code), field(code * 5.0, tail), field(-12.5), field(45.0)]


@pytest.mark.parametrize("version", ["3.00", "3.01", "3.02", "3.03", "3.04", "3.05", "4.00", "4.01", "4.02"])
def test_version_3_and_4(tmp_path: Path, version: str) -> None:
    lines = header_3({"G": ("C1C", "L1C", "D1C", "S1C"), "J": ("C1C", "L1C", "D1C", "S1C")}, version=version)
    lines += epoch_3("02 33 13.0050000", {"G05": four(21e6, tail="17"), "J02": four(38e6)})
    observations = read_observations(write(tmp_path / "log.obs", lines))
    assert observations.time == np.array(["2021-05-17T02:33:13.005"], dtype="M8[ns]")
    assert observations.satellite.tolist() == ["G05", "J02"]
    assert observations.signal.tolist() == ["1C", "1C"]
    np.testing.assert_array_equal(observations.code_m, [[21e6, 38e6]])
    np.testing.assert_array_equal(observations.phase_cycles, [[105e6, 190e6]])
    np.testing.assert_array_equal(observations.doppler_hz, [[-12.5, -12.5]])
    np.testing.assert_array_equal(observations.cn0_dbhz, [[45.0, 45.0]])
    np.testing.assert_array_equal(observations.loss_of_lock, [[1, 0]])
    assert observations.header.version == float(version)
    assert not observations.problems


@pytest.mark.parametrize("version", ["2", "2.00", "2.10", "2.11", "2.12"])
def test_version_2(tmp_path: Path, version: str) -> None:
    lines = header_2(version=version)
    satellites = {"G 3": [field(1.5, " 6"), field(2e7), field(3.5, "4 "), field(2.5e7)], "  5": [field(7.0)]}
    lines += epoch_2(" 0  0  0.0000000", satellites) + epoch_2(" 0  0 30.0050000", satellites)
    observations = read_observations(write(tmp_path / "log.05o", lines))
    assert observations.time.tolist() == np.array(["2005-04-02T00:00:00", "2005-04-02T00:00:30.005"], "M8[ns]").tolist()
    assert observations.satellite.tolist() == ["G03", "G03", "G05"]  # a blank letter is the file's system
    assert observations.signal.tolist() == ["1C", "2W", "1C"]
    np.testing.assert_array_equal(observations.code_m[0], [2e7, 2.5e7, np.nan])
    np.testing.assert_array_equal(observations.phase_cycles[1], [1.5, 3.5, 7.0])
    np.testing.assert_array_equal(observations.loss_of_lock[0], [0, 4, 0])


def test_a_number_of_satellites_may_be_left_aligned(tmp_path: Path) -> None:
    """As some converters write it, blanks up to the end of its columns."""
    epochs = [epoch_3("02 33 13.0", {"G05": four(2e7), "G12": four(3e7)}), epoch_3("02 33 14.0", {"G05": four(2e7)})]
    for lines, count in zip(epochs, ("2  ", " 1 "), strict=True):
        lines[0] = lines[0][:32] + count
    observations = read_observations(write(tmp_path / "log", header_3() + epochs[0] + epochs[1], strip=False))
    np.testing.assert_array_equal(observations.code_m, [[2e7, 3e7], [2e7, np.nan]])
    assert not observations.problems


def test_arrays_handed_out_are_read_only(tmp_path: Path) -> None:
    observations = read_observations(write(tmp_path / "a", header_3() + epoch_3("02 33 13.0", {"G05": four(2e7)})))
    for array in (observations.time, observations.code_m, observations.loss_of_lock, observations.satellite):
        assert not array.flags.writeable


def test_years_of_two_digits_turn_at_80(tmp_path: Path) -> None:
    first = header_2() + epoch_2(" 0  0  0.0000000", {"G01": [field(1.0)]}, date="99 12 31")
    second = header_2() + epoch_2(" 0  0  0.0000000", {"G01": [field(1.0)]}, date="79  1  1")
    assert read_observations(write(tmp_path / "a", first)).time[0] == np.datetime64("1999-12-31")
    assert read_observations(write(tmp_path / "b", second)).time[0] == np.datetime64("2079-01-01")


def test_time_tags_are_kept_to_their_last_digit(tmp_path: Path) -> None:
    seconds = ["13.0049999", "13.0050000", "22.4299102", "59.9999999"]
    lines = header_3()
    for text in seconds:
        lines += epoch_3(f"02 33 {text}", {"G05": four(2e7)})
    time = read_observations(write(tmp_path / "a", lines)).time
    digits = (time - np.datetime64("2021-05-17T02:33", "ns")).astype(np.int64)
    assert digits.tolist() == [13004999900, 13005000000, 22429910200, 59999999900]


def test_types_and_satellites_go_on_in_further_lines(tmp_path: Path) -> None:
    types = ("L1", "L2", "C1", "P2", "P1", "D1", "D2", "S1", "S2", "C2", "C5", "L5")
    satellites = {f"G{n:2d}": [field(1000.0 * n + k) for k in range(12)] for n in range(1, 27)}
    lines = header_2(types) + epoch_2(" 0  0  0.0000000", satellites) + epoch_2(" 0  0  1.0000000", satellites)
    observations = read_observations(write(tmp_path / "log", lines))
    assert len(set(observations.satellite.tolist())) == 26
    at = channel(observations, "G26", "5X")
    np.testing.assert_array_equal(observations.code_m[:, at], 26010.0)
    np.testing.assert_array_equal(observations.phase_cycles[:, at], 26011.0)
    names = {g: channel(observations, "G13", g) for g in ("1C", "1W", "2W", "2X")}
    row = observations.code_m[0]
    assert [row[names[g]] for g in ("1C", "1W", "2W", "2X")] == [13002.0, 13004.0, 13003.0, 13009.0]
    assert observations.phase_cycles[0, names["1C"]] == 13000.0  # L1 with C1, L2 with P2
    assert observations.phase_cycles[0, names["2W"]] == 13001.0
    assert np.isnan(observations.phase_cycles[0, names["1W"]])


@pytest.mark.parametrize(
    ("types", "system", "expected"),
    [
        (("C1", "L1", "D1", "S1"), "G", {"1C": "CLDS"}),
        (("P1", "L1"), "G", {"1W": "CL"}),
        (("P1", "C1", "L1", "S1"), "R", {"1C": "CLS", "1P": "C"}),
        (("C2", "L2"), "G", {"2X": "CL"}),
        (("C2", "P2", "L2"), "R", {"2C": "C", "2P": "CL"}),
        (("C1", "L1", "C5", "L5", "C7", "S7", "C6"), "E", {"1X": "CL", "5X": "CL", "7X": "CS", "6X": "C"}),
        (("C2", "L2", "C7", "C6"), "C", {"2I": "CL", "7I": "C", "6I": "C"}),
        (("CA", "CC"), "G", {"1C": "C", "2X": "C"}),
        (("L1",), "G", {"1C": "L"}),
    ],
)  # fmt: skip
def test_rinex_2_types_as_signals(
    tmp_path: Path, types: tuple[str, ...], system: str, expected: dict[str, str]
) -> None:
    lines = header_2(types, version="2.12", system=system)
    lines += epoch_2(" 0  0  0.0000000", {f"{system} 7": [field(40.0 + k) for k in range(len(types))]})
    observations = read_observations(write(tmp_path / "log", lines))
    arrays = {
        "C": observations.code_m,
        "L": observations.phase_cycles,
        "D": observations.doppler_hz,
        "S": observations.cn0_dbhz,
    }
    found = {
        str(g): "".join(k for k, a in arrays.items() if np.isfinite(a[0, i])) for i, g in enumerate(observations.signal)
    }
    assert found == expected


@pytest.mark.parametrize(
    ("version", "written", "signal"),
    [("3.02", "1I", "2I"), ("3.02", "1X", "2X"), ("3.03", "2I", "2I"), ("3.04", "1I", "2I"), ("3.04", "1X", "1X")],
)
def test_first_band_of_beidou(tmp_path: Path, version: str, written: str, signal: str) -> None:
    lines = header_3({"C": (f"C{written}",)}, version=version) + epoch_3("02 33 13.0", {"C06": [field(4e7)]})
    assert read_observations(write(tmp_path / "log", lines)).signal.tolist() == [signal]


def test_names_with_a_space_short_lines_and_pseudo_types(tmp_path: Path) -> None:
    types = ("X1", "C1C", "L1C", "C5Q", "L5Q")
    lines = header_3({"G": types, "E": types[:3]})
    lines += epoch_3("02 33 13.0000000", {"G 1": [field(9.0), field(2e7), field(1.0)], "E 7": [field(9.0)], "G12": []})
    observations = read_observations(write(tmp_path / "log", lines))
    assert observations.satellite.tolist() == ["G01"]
    assert observations.signal.tolist() == ["1C"]
    assert observations.header.signals == {"E": ("1C",), "G": ("1C", "5Q")}


def test_line_ends_and_trailing_blanks_do_not_matter(tmp_path: Path) -> None:
    lines = header_3() + epoch_3("02 33 13.0000000", {"G05": four(2e7), "G12": [field(2.1e7)]})
    lines += epoch_3("02 33 14.0000000", {"G05": [field(None), field(7.0, "3 ")]})
    first = read_observations(write(tmp_path / "a", lines))
    for name, options in {"b": {"end": "\r\n"}, "c": {"strip": False}, "d": {"end": "\r\n", "strip": False}}.items():
        other = read_observations(write(tmp_path / name, lines, **options))
        for array in ("time", "satellite", "code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock"):
            np.testing.assert_array_equal(getattr(first, array), getattr(other, array))
    cut = (tmp_path / "a").read_bytes().rstrip(b"\n")
    (tmp_path / "e").write_bytes(cut)  # no line end at the end of the file
    np.testing.assert_array_equal(read_observations(tmp_path / "e").phase_cycles, first.phase_cycles)


def test_zero_and_blank_are_absent(tmp_path: Path) -> None:
    lines = header_3() + epoch_3(
        "02 33 13.0", {"G05": [field(0.0), field("        -0.000", "1 "), field(None), field(30.0)]}
    )
    lines += epoch_3("02 33 14.0", {"G05": [field("          .548"), field("         -.548"), field("-123456789.012")]})
    observations = read_observations(write(tmp_path / "log", lines))
    assert np.isnan(observations.code_m[0, 0])
    assert np.isnan(observations.phase_cycles[0, 0])
    assert np.isnan(observations.doppler_hz[0, 0])
    assert observations.loss_of_lock[0, 0] == 1
    assert observations.code_m[1, 0] == 0.548
    assert observations.phase_cycles[1, 0] == -0.548
    assert observations.doppler_hz[1, 0] == -123456789.012


def test_other_decimals_are_read_as_they_stand(tmp_path: Path) -> None:
    texts = ["    20000000.5", "  2.0000001D+7", "           +45", "-12345678.9012"]
    lines = header_3() + epoch_3("02 33 13.0", {"G05": [field(text) for text in texts]})
    observations = read_observations(write(tmp_path / "log", lines))
    found = [
        a[0, 0]
        for a in (observations.code_m, observations.phase_cycles, observations.doppler_hz, observations.cn0_dbhz)
    ]
    assert found == [20000000.5, 20000001.0, 45.0, -12345678.9012]


@pytest.mark.parametrize("column", ["", " "], ids=["in its columns", "a column off"])
def test_scale_factor_is_applied_and_rounded_once(tmp_path: Path, column: str) -> None:
    words = (f"{column}G  100   2 L1C D1C", f"{column}E   10")
    extra = [record(text, "SYS / SCALE FACTOR") for text in words]
    types = ("C1C", "L1C", "D1C", "S1C")
    lines = header_3({"G": types, "E": types}, extra=extra)
    values = [field(20000000.123), field(123456789.123), field(12345.678), field(45.125)]
    observations = read_observations(
        write(tmp_path / "log", lines + epoch_3("02 33 13.0", {"G05": values, "E11": values}))
    )
    e, g = channel(observations, "E11", "1C"), channel(observations, "G05", "1C")
    assert observations.code_m[0, g] == 20000000.123
    assert observations.phase_cycles[0, g] == 1234567.89123
    assert observations.doppler_hz[0, g] == 123.45678
    assert observations.cn0_dbhz[0, e] == 4.5125
    assert len(observations.problems) == 2 * len(column)


@pytest.mark.parametrize(
    ("name", "system", "shift_s"),
    [("GPS", "M", 0), ("GAL", "M", 0), ("QZS", "M", 0), ("IRN", "M", 0), ("BDT", "M", 14), ("GLO", "M", 18),
     ("   ", "R", 18), ("   ", "C", 14), ("   ", "M", 0)],
)  # fmt: skip
def test_time_systems_become_gps_time(tmp_path: Path, name: str, system: str, shift_s: int) -> None:
    letter = "G" if system == "M" else system
    lines = header_3({letter: ("C1C",)}, system=system, time_system=name)
    lines += epoch_3("02 33 13.0050000", {f"{letter}05": [field(2e7)]})
    time = read_observations(write(tmp_path / "log", lines)).time[0]
    assert time - np.datetime64("2021-05-17T02:33:13.005", "ns") == np.timedelta64(shift_s, "s")


def test_header_is_handed_on(tmp_path: Path) -> None:
    extra = [
        record(f"{'3605054':20}{'SEPT MOSAIC-X5':20}4.14.4", "REC # / TYPE / VERS"),
        record(f"{'':20}{'TRM29659.00     NONE':20}", "ANT # / TYPE"),
        record(" -3817680.7270  3562839.5216  3650159.2407", "APPROX POSITION XYZ"),
        record("        1.2500        0.0000       -0.0010", "ANTENNA: DELTA H/E/N"),
        record("     0.100", "INTERVAL"),
        record("    18", "LEAP SECONDS"),
        record("     1", "RCV CLOCK OFFS APPL"),
        record("  9 R01  1 R02 -4 R03  5 R11  0 R12 -1 R13 -2 R17  4 R 8 -3", "GLONASS SLOT / FRQ #"),
        record("    R24  2", "GLONASS SLOT / FRQ #"),
        record("DBHZ", "SIGNAL STRENGTH UNIT"),
    ]
    lines = header_3(extra=extra) + epoch_3("02 33 13.0", {"G05": four(2e7)})
    header = read_observations(write(tmp_path / "log", lines)).header
    assert (header.marker, header.receiver, header.antenna) == ("TRAIN", "SEPT MOSAIC-X5", "TRM29659.00     NONE")
    np.testing.assert_array_equal(header.approximate_ecef_m, [-3817680.7270, 3562839.5216, 3650159.2407])
    np.testing.assert_array_equal(header.antenna_delta_hen_m, [1.25, 0.0, -0.001])
    assert (header.interval_s, header.leap_seconds, header.receiver_clock_applied) == (0.1, 18, True)
    assert header.glonass_channel["R02"] == -4
    assert (header.glonass_channel["R08"], header.glonass_channel["R24"], len(header.glonass_channel)) == (-3, 2, 9)
    zero = header_3(extra=[record("        0.0000        0.0000        0.0000", "APPROX POSITION XYZ")])
    other = read_observations(write(tmp_path / "zero", zero + epoch_3("02 33 13.0", {"G05": four(2e7)})))
    assert np.isnan(other.header.approximate_ecef_m).all()


def test_power_failure_new_site_and_cycle_slips(tmp_path: Path) -> None:
    one = {"G05": four(2e7)}
    lines = header_3() + epoch_3("02 33 13.0", one) + epoch_3("02 33 14.0", one, flag=1) + epoch_3("02 33 15.0", one)
    lines += [*epoch_3("", flag=3, count=1), record("NEW SITE", "MARKER NAME"), *epoch_3("02 33 16.0", one)]
    lines += epoch_3("02 33 16.5", one, flag=6) + epoch_3("02 33 16.7", flag=5) + epoch_3("02 33 17.0", one)
    lines += epoch_3("", flag=2, count=0) + epoch_3("02 33 18.0", one)
    observations = read_observations(write(tmp_path / "log", lines))
    assert observations.break_before.tolist() == [False, True, False, True, False, True]
    assert observations.skipped == {"cycle-slip records": 1, "external events": 1}
    assert observations.header.marker == "TRAIN"


@pytest.mark.parametrize("flag", [2, 3, 4])
def test_types_change_in_the_middle(tmp_path: Path, flag: int) -> None:
    lines = header_3() + epoch_3("02 33 13.0", {"G05": four(2e7)})
    lines += epoch_3("", flag=flag, count=3)
    lines += [record("G    2 S5Q C5Q", "SYS / # / OBS TYPES"), record("E    1 C1C", "SYS / # / OBS TYPES")]
    lines += [record("G05 is no satellite's line, it is a comment", "COMMENT")]
    lines += epoch_3("02 33 14.0", {"G05": [field(44.0), field(2.2e7)], "E11": [field(2.5e7)]})
    observations = read_observations(write(tmp_path / "log", lines))
    assert observations.satellite.tolist() == ["E11", "G05", "G05"]
    assert observations.signal.tolist() == ["1C", "1C", "5Q"]
    np.testing.assert_array_equal(observations.code_m, [[np.nan, 2e7, np.nan], [2.5e7, np.nan, 2.2e7]])
    assert observations.header.signals == {"E": ("1C",), "G": ("1C", "5Q")}


def test_events_of_rinex_2(tmp_path: Path) -> None:
    one = {"G05": [field(1.0), field(2e7), field(3.0), field(2.2e7)]}
    lines = header_2() + event_2(4, [record("before the first epoch at 12.5 18.5", "COMMENT")])
    lines += epoch_2(" 0  0  0.0000000", one) + epoch_2(" 0  0  1.0000000", one, flag=1)
    lines += event_2(3, [record("NEW SITE 99  1  1 12.0", "MARKER NAME")]) + epoch_2(" 0  0  2.0000000", one)
    lines += event_2(4, [record("     6    L1    C1    P1    S1    D1    S2", "# / TYPES OF OBSERV")])
    lines += epoch_2(" 0  0  3.0000000", {"G05": [field(float(k)) for k in range(1, 7)]})
    lines += epoch_2(" 0  0  3.5000000", {"G05": [field(float(k)) for k in range(1, 7)]}, flag=6)
    lines += [
        " 05  4  2  0  0  3.7000000  5  1",
        record("a door opens", "COMMENT"),
        *epoch_2(" 0  0  4.0000000", {"G05": [field(9.0)] * 6}),
    ]
    observations = read_observations(write(tmp_path / "log", lines))
    assert observations.break_before.tolist() == [False, True, True, False, False]
    assert observations.skipped == {"cycle-slip records": 1, "external events": 1}
    assert observations.code_m[:, channel(observations, "G05", "1W")].tolist()[3:] == [3.0, 9.0]
    assert observations.cn0_dbhz[:, channel(observations, "G05", "2W")].tolist()[3:] == [6.0, 9.0]


def test_false_epoch_lines_inside_an_event_are_stepped_over(tmp_path: Path) -> None:
    one = {"G05": [field(1.0), field(2e7), field(3.0), field(2.2e7)]}
    trap = epoch_2(" 0  0  7.0000000", {"G09": [field(1.0)]})[0]
    lines = header_2() + epoch_2(" 0  0  0.0000000", one) + event_2(4, [record(trap, "COMMENT")])
    lines += epoch_2(" 0  0  1.0000000", one)
    observations = read_observations(write(tmp_path / "log", lines))
    assert len(observations) == 2
    assert set(observations.satellite.tolist()) == {"G05"}


def test_empty_epochs_and_blank_observation_lines(tmp_path: Path) -> None:
    lines = (
        header_2()
        + epoch_2(" 0  0  0.0000000")
        + epoch_2(" 0  0  1.0000000", {"G05": [field(None)], "G07": [field(2.0)]})
    )
    observations = read_observations(write(tmp_path / "log", lines))
    assert len(observations) == 2
    assert observations.satellite.tolist() == ["G07"]
    three = header_3() + epoch_3("02 33 13.0") + [""] + epoch_3("02 33 14.0", {"G05": four(2e7)}) + ["", ""]
    assert len(read_observations(write(tmp_path / "three", three))) == 2


def test_selection_of_systems_and_time(tmp_path: Path) -> None:
    types = ("C1C", "L1C", "D1C", "S1C")
    lines = header_3({"G": types, "E": types})
    for second in range(10, 16):
        lines += epoch_3(f"02 33 {second}.0000000", {"G05": four(2e7), "E11": four(2.5e7), "Z01": four(1.0)})
    path = write(tmp_path / "log", lines)
    observations = read_observations(path, systems="E", start="2021-05-17T02:33:11", end="2021-05-17T02:33:14")
    assert observations.satellite.tolist() == ["E11"]
    assert (observations.time - np.datetime64("2021-05-17T02:33")).astype("m8[s]").astype(int).tolist() == [11, 12, 13]
    assert observations.skipped == {
        "satellites of unknown constellations": 3,
        "satellites of constellations not selected": 3,
    }
