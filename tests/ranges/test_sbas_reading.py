"""SBAS files: parity, formats, and that every message is accounted for."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import sbas_cases as cases
from railfix.core.errors import InputFileError
from railfix.core.timescale import from_week, to_week
from railfix.ranges.sbas import SbasMessages, read_sbas
from railfix.ranges.sbas.messages import carried_parity, message_parity
from railfix.ranges.sbas.standard import system_name
from sbas_account import DECODED, account, type_name

pytestmark = pytest.mark.requirement("C1")

LOGS = {"2008": "msas_20080526_crescent/cres_20080526.bin.sbs", "2025": "msas_20250215/046r_sbas_prn137.txt"}


def parity_by_division(bits: np.ndarray) -> int:
    """Remainder of the 226 data bits by the generator, bit by bit."""
    remainder = 0
    for bit in [*np.unpackbits(bits)[:226].tolist(), *[0] * 24]:
        remainder = (remainder << 1) | bit
        if remainder >> 24:
            remainder ^= 0x1864CFB
    return remainder


def some_messages() -> np.ndarray:
    return np.array(
        [
            cases.mask(0, [1, 5, 32, 129]),
            cases.fast(1, [1.5, -2.0], [3, 4]),
            cases.moving(2, 1, 48, (1.0, -2.0, 3.0), (1, -2, 3), 4, -5, 43_200),
            cases.grid_mask(3, 8, [1, 2, 200]),
            cases.message(63, 4),
        ]
    )


def digits(bits: np.ndarray, count: int) -> str:
    return bits.tobytes().hex().upper()[:count]


def as_rtklib(log: SbasMessages, *, count: int) -> str:
    rows = []
    for i in range(len(log)):
        week, tow = to_week(log.time[i])
        rows.append(f"{week} {tow:6.0f} {log.prn[i]} {log.type[i]:2d} : {digits(log.bits[i], count)}")
    return "\n".join(rows) + "\n"


def as_ems(log: SbasMessages) -> str:
    rows = []
    for i in range(len(log)):
        t = log.time[i].astype("datetime64[s]").item()
        rows.append(f"{log.prn[i]} {t:%y %m %d %H %M %S} {log.type[i]} {digits(log.bits[i], 64)}")
    return "\n".join(rows) + "\n"


def as_rinex(log: SbasMessages) -> str:
    """Type B: the time is that of the first bit, a second before the message is there."""
    rows = [f"{2.10:9.2f}           {'B: SBAS BROADCAST':40s}RINEX VERSION / TYPE", f"{'':60s}END OF HEADER"]
    for i in range(len(log)):
        t = (log.time[i] - np.timedelta64(1, "s")).astype("datetime64[s]").item()
        octets = [f"{octet:02X}" for octet in log.bits[i].tolist()]
        rows.append(f"{log.prn[i]:3d} {t:%y %m %d %H %M} {t.second:4.1f}  L1   32     1    NOV")
        rows.append(f" {log.type[i]:2d}    {' '.join(octets[:18])}")
        rows.append(f"       {' '.join(octets[18:])}")
    return "\n".join(rows) + "\n"


def a_log() -> SbasMessages:
    messages = [
        cases.mask(0, [1, 5, 32]),
        cases.fast(1, [1.5, -2.0], [3, 4]),
        cases.message(63, 2),
        cases.message(62, 3),
        cases.parameters(4, brrc=7),
    ]
    return cases.message_log([(second, 0, bits) for second, bits in enumerate(messages)], prn=124)


def test_the_parity_is_the_remainder_of_the_division() -> None:
    bits = some_messages()
    assert message_parity(bits).tolist() == [parity_by_division(row) for row in bits]
    assert (carried_parity(bits) == message_parity(bits)).all()


def test_the_recorded_six_bits_are_the_first_of_the_parity(recordings: Path) -> None:
    log = read_sbas(recordings / "sbas" / LOGS["2025"])
    assert set(log.parity_bits.tolist()) == {6}
    for row in range(0, len(log), 400):
        assert parity_by_division(log.bits[row]) >> 18 == log.bits[row, 28] & 0x3F
    assert any("6 of 24 bits of parity" in note for note in log.notes)


def test_a_bit_flipped_anywhere_is_refused(tmp_path: Path) -> None:
    """All 250 positions of five messages: none gets through."""
    for number, bits in enumerate(some_messages()):
        text = []
        for position in range(250):
            flipped = bits.copy()
            flipped[position // 8] ^= 0x80 >> (position % 8)
            kind = int(flipped[1] >> 2)
            text.append(f"2353 {position + 1000} 137 {kind} : {digits(flipped, 64)}")
        good = f"2353 100 137 {bits[1] >> 2} : {digits(bits, 64)}"
        path = tmp_path / f"{number}.sbs"
        path.write_text("\n".join([good, *text]))
        log = read_sbas(path)
        assert len(log) == 1
        assert log.rejected["parity"] == 250


@pytest.mark.parametrize("write", [lambda log: as_rtklib(log, count=64), as_ems, as_rinex])
def test_formats_say_the_same(tmp_path: Path, write: Callable[[SbasMessages], str]) -> None:
    log = a_log()
    path = tmp_path / "messages.gz"
    path.write_bytes(gzip.compress(write(log).replace("\n", "\r\n").encode()))
    read = read_sbas(path)
    assert (read.time == log.time).all()
    assert (read.prn == 124).all()
    assert (read.bits == log.bits).all()
    assert read.type.tolist() == [1, 2, 63, 62, 10]
    assert set(read.parity_bits.tolist()) == {24}
    assert read.notes == ()


def test_old_rinex_writes_less(tmp_path: Path) -> None:
    """No band and length, and the satellite as PRN less 100, as before 2004."""
    text = as_rinex(a_log()).replace("  L1   32     1    NOV", "").replace("\n124 ", "\n 24 ")
    path = tmp_path / "old.05b"
    path.write_text(text)
    read = read_sbas(path)
    assert (read.prn == 124).all()
    assert (read.bits == a_log().bits).all()


def test_a_broken_record_of_rinex_takes_no_other_with_it(tmp_path: Path) -> None:
    lines = as_rinex(a_log()).splitlines()
    lines[3] = lines[3].replace("  1 ", " XY ", 1)
    path = tmp_path / "broken.b"
    path.write_text("\n".join([*lines[:8], "what is this", *lines[8:]]))
    read = read_sbas(path, broken_lines="count")
    assert read.rejected["line"] == 2
    assert read.type.tolist() == [2, 63, 62, 10]


def test_a_cut_message_says_that_it_has_no_parity(tmp_path: Path) -> None:
    log = a_log()
    path = tmp_path / "cut.sbs"
    zeroed = log.bits.copy()
    zeroed[:, 28] &= 0xC0
    path.write_text("".join(f"2353 {i} 124 {log.type[i]} : {digits(zeroed[i], 58)}\n" for i in range(len(log))))
    read = read_sbas(path)
    assert set(read.parity_bits.tolist()) == {0}
    assert (read.bits[:, :28] == log.bits[:, :28]).all()
    assert read.notes == (f"{path}: 5 messages have no parity; reception errors cannot be detected",)


def test_six_bits_that_are_no_parity_are_not_taken_for_one(tmp_path: Path) -> None:
    log = a_log()
    path = tmp_path / "filled.sbs"
    filled = log.bits.copy()
    filled[:, 28] ^= 0x15
    path.write_text("".join(f"2353 {i} 124 {log.type[i]} : {digits(filled[i], 58)}\n" for i in range(len(log))))
    assert set(read_sbas(path).parity_bits.tolist()) == {0}


def test_a_damaged_message_among_cut_ones_is_refused(tmp_path: Path) -> None:
    log = a_log()
    path = tmp_path / "six.sbs"
    damaged = log.bits.copy()
    damaged[1, 10] ^= 0x10
    path.write_text("".join(f"2353 {i} 124 {log.type[i]} : {digits(damaged[i], 58)}\n" for i in range(len(log))))
    read = read_sbas(path)
    assert set(read.parity_bits.tolist()) == {6}
    assert read.rejected["parity"] == 1
    assert read.type.tolist() == [1, 63, 62, 10]


def test_a_wrong_preamble_is_counted(tmp_path: Path) -> None:
    bits = np.array([cases.message(63, 0), cases.message(63, 1)])
    bits[0, 0] = 0x00
    bits[:, 28] &= 0xC0
    path = tmp_path / "preamble.sbs"
    path.write_text("".join(f"2353 {i} 137 63 : {digits(bits[i], 58)}\n" for i in range(2)))
    log = read_sbas(path)
    assert log.rejected == {"line": 0, "parity": 0, "preamble": 1, "duplicate": 0}


def test_preambles_out_of_turn_are_told(tmp_path: Path) -> None:
    rows = [f"2353 {s} 137 63 : {digits(cases.message(63, s + (s > 7)), 64)}" for s in range(10)]
    path = tmp_path / "turn.sbs"
    path.write_text("\n".join(rows))
    assert "2 of 10 messages do not match" in " ".join(read_sbas(path).notes)


def test_the_same_message_from_two_files_counts_once(tmp_path: Path) -> None:
    (tmp_path / "a.sbs").write_text(as_rtklib(a_log(), count=64))
    (tmp_path / "b.ems").write_text(as_ems(a_log()))
    log = read_sbas([tmp_path / "a.sbs", tmp_path / "b.ems"])
    assert len(log) == 5
    assert log.rejected["duplicate"] == 5
    assert sum(account(log).values()) == 10


BROKEN = {
    "letters": ("2353 3 137 63 : 53FCxx", "not of the form 'week tow prn type"),
    "length": ("2353 3 137 63 : 53FC00", "6 hexadecimal digits"),
    "prn": (f"2353 3 12 63 : {digits(cases.message(63, 0), 64)}", "PRN 12 is not an SBAS PRN"),
    "type": (f"2353 3 137 62 : {digits(cases.message(63, 0), 64)}", "stated message type is 62, but the"),
    "time": (f"2353 604800 137 63 : {digits(cases.message(63, 0), 64)}", "not a GPS time"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_line_is_named(tmp_path: Path, fault: str) -> None:
    line, words = BROKEN[fault]
    path = tmp_path / "broken.sbs"
    path.write_text(as_rtklib(a_log(), count=64) + line + "\n")
    with pytest.raises(InputFileError, match=words) as caught:
        read_sbas(path)
    assert caught.value.line == 6
    log = read_sbas(path, broken_lines="count")
    assert len(log) == 5
    assert log.rejected["line"] == 1
    assert words in " ".join(log.notes)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("nothing of the kind\n", "is not the first line of an SBAS file"),
        ("# only a comment\n", "contains no SBAS message"),
        (f"{2.10:9.2f}           {'N: GPS NAV DATA':40s}RINEX VERSION / TYPE\n", "is a RINEX navigation file"),
        (as_rinex(a_log()).replace("END OF HEADER", "COMMENT"), "no END OF HEADER"),
        (as_rinex(a_log()).rsplit("\n", 2)[0], "not have 32 bytes"),
        (as_rinex(a_log()).replace("L1", "L5", 1), "band L5"),
        (as_ems(a_log()).replace("25 02 15", "25 02 31", 1), "not a date and time"),
    ],
)
def test_a_file_of_another_kind_is_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "other"
    path.write_text(text)
    with pytest.raises(InputFileError, match=words):
        read_sbas(path)


@pytest.mark.parametrize(("name", "messages", "decoded"), [("2008", 622, 508), ("2025", 3600, 2949)])
def test_every_recorded_message_is_accounted_for(recordings: Path, name: str, messages: int, decoded: int) -> None:
    path = recordings / "sbas" / LOGS[name]
    log = read_sbas(path)
    counts = account(log)
    assert sum(counts.values()) == messages == len(path.read_text().splitlines())
    assert sum(n for what, n in counts.items() if "type" in what and "not decoded" not in what) == decoded
    assert np.isin(log.type, DECODED["L1"]).sum() == decoded
    assert not any("rejected" in what and n for what, n in counts.items())
    assert (log.time[1:] >= log.time[:-1]).all()


def test_recorded_times_are_of_their_weeks(recordings: Path) -> None:
    assert read_sbas(recordings / "sbas" / LOGS["2025"]).time[0] == from_week(2353, 579_600.0)
    assert read_sbas(recordings / "sbas" / LOGS["2008"]).time[0] == np.datetime64("2008-05-26T06:01:33")


def test_names_tell_qzss_from_sbas() -> None:
    assert (system_name(137), system_name(186), system_name(124)) == ("MSAS", "QZSS L1S", "EGNOS")
    assert type_name(43, 186).startswith("L1S disaster report")
    assert type_name(43, 137) == "reserved"
    assert type_name(26, 186) == type_name(26, 137) == "ionospheric delays"
    rows = [(0, 186, cases.message(43, 0)), (1, 186, cases.message(1, 1))]
    assert list(account(cases.message_log(rows))) == [
        "QZSS L1S 186 type 1 PRN mask",
        "QZSS L1S 186 type 43 L1S disaster report of the Japan Meteorological Agency, not decoded",
    ]


@pytest.mark.parametrize(
    ("year", "expected"), [("80", 1980), ("99", 1999), ("00", 2000), ("79", 2079), ("2025", 2025), ("1999", 1999)]
)
def test_years_of_two_digits_are_those_of_1980_to_2079(tmp_path: Path, year: str, expected: int) -> None:
    log = a_log()
    prn, _, rest = as_ems(log).splitlines()[0].split(" ", 2)
    (tmp_path / "a.ems").write_text(f"{prn} {year} {rest}\n")
    assert read_sbas(tmp_path / "a.ems").time[0].astype("datetime64[Y]") == np.datetime64(str(expected), "Y")


def test_a_message_of_250_binary_digits_is_that_of_the_hexadecimal_ones(tmp_path: Path) -> None:
    """Some receivers write the bits themselves; 249 of them are no message."""
    log = a_log()
    head, digits = as_ems(log).splitlines()[0].rsplit(" ", 1)
    binary = f"{int(digits.ljust(64, '0'), 16):0256b}"[:250]
    (tmp_path / "a.ems").write_text(f"{head} {binary}\n")
    found = read_sbas(tmp_path / "a.ems")
    assert found.bits[0].tolist() == log.bits[0].tolist()
    assert found.parity_bits[0] == 24
    (tmp_path / "b.ems").write_text(f"{head} {binary[:-1]}\n")
    with pytest.raises(InputFileError, match="249 hexadecimal digits"):
        read_sbas(tmp_path / "b.ems")
