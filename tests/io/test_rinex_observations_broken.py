"""Broken observation files: what each error says, and what is left when faults are counted."""

from __future__ import annotations

import gzip
import re
from collections.abc import Callable
from pathlib import Path
from typing import Final

import ncompress
import numpy as np
import pytest
from hatanaka import rnx2crx
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.files import BrokenLines
from railfix.io import read_observations, scan_observations
from rinex_observations_text import epoch_2, epoch_3, event_2, field, header_2, header_3, record, text_of, write

pytestmark = pytest.mark.requirement("A7")

Lines = list[str]


def good_3() -> Lines:
    """Header of 5 lines; epochs of 3 lines from line 6 on: 13 s to 18 s."""
    lines = header_3()
    for k in range(6):
        fields = [field(2e7 + k), field(1e8 + k), field(-100.0), field(45.0)]
        lines += epoch_3(f"02 33 {13 + k}.0000000", {"G05": fields, "G12": fields})
    return lines


def good_2() -> Lines:
    """Header of 5 lines; epochs of 3 lines from line 6 on: 0 s to 5 s."""
    lines = header_2()
    for k in range(6):
        fields = [field(1e8 + k), field(2e7 + k), field(1e8 - k), field(2.5e7)]
        lines += epoch_2(f" 0  0  {k}.0000000", {"G05": fields, "G12": fields})
    return lines


def edit(base: Callable[[], Lines], line: int, old: str, new: str) -> Lines:
    """The good file with something else in one line (1-based)."""
    lines = base()
    assert old in lines[line - 1], lines[line - 1]
    lines[line - 1] = lines[line - 1].replace(old, new, 1)
    return lines


def without(base: Callable[[], Lines], line: int) -> Lines:
    lines = base()
    del lines[line - 1]
    return lines


def inserted(base: Callable[[], Lines], line: int, text: str) -> Lines:
    lines = base()
    lines.insert(line - 1, text)
    return lines


#: Name: lines, words of the message, line number, epochs and values of G05 left with "count" (of 6).
BROKEN: dict[str, tuple[Lines, str, int, int, int]] = {
    "letter in a code": (edit(good_3, 10, "20000001.000", "2000O001.000"), "C1C of G05 is '  2000O001.000", 10, 6, 5),
    "two points": (edit(good_3, 10, "20000001.000", "20000.01.000"), "C1C of G05", 10, 6, 5),
    "minus inside": (edit(good_3, 10, "20000001.000", "2-000001.000"), "C1C of G05", 10, 6, 5),
    "blank inside": (edit(good_3, 10, "20000001.000", "20 00001.000"), "C1C of G05", 10, 6, 5),
    "field not in its columns": (edit(good_3, 10, "G05  ", "G05 "), "C1C of G05", 10, 6, 5),
    "letter for loss of lock": (edit(good_3, 10, "100000001.000 ", "100000001.000x"), "L1C of G05", 10, 6, 5),
    "line cut in a number": (edit(good_3, 10, good_3()[9][24:], ""), "L1C of G05", 10, 6, 5),
    "line too long": (edit(good_3, 10, "45.000  ", "45.000  7"), "continues after its 4 declared", 10, 6, 5),
    "no satellite name": (edit(good_3, 10, "G05", "G-5"), "no satellite name can be read", 10, 6, 5),
    "satellite zero": (edit(good_3, 10, "G05", "G00"), "no satellite name can be read", 10, 6, 5),
    "satellite twice": (edit(good_3, 11, "G12", "G05"), "satellite G05 occurs twice", 11, 6, 6),
    "types not declared": (edit(good_3, 10, "G05", "E05"), "E05: the header has no observation types", 10, 6, 5),
    "line missing": (without(good_3, 10), "declares 2 lines, but 1 follow", 9, 5, 5),
    "line too many": (inserted(good_3, 10, "G07      20000000.000"), "declares 2 lines, but 3 follow", 9, 5, 5),
    "line before the first epoch": (inserted(good_3, 6, "G07"), "an epoch line was expected, found 'G07'", 6, 6, 6),
    "month 13": (edit(good_3, 9, "2021 05", "2021 13"), "the month is not in 1 to 12", 9, 5, 5),
    "30 February": (edit(good_3, 9, "05 17", "02 30"), "the day does not exist in its month", 9, 5, 5),
    "hour 24": (edit(good_3, 9, "02 33", "24 33"), "the hour is not in 0 to 23", 9, 5, 5),
    "minute 60": (edit(good_3, 9, "02 33", "02 60"), "the minute is not in 0 to 59", 9, 5, 5),
    "second 60": (edit(good_3, 9, "14.0000000", "60.0000000"), "the seconds are not at least 0 and below 60", 9, 5, 5),
    "letter in the seconds": (edit(good_3, 9, "14.0000000", "14.00o0000"), "the seconds are not", 9, 5, 5),
    "letter in the year": (edit(good_3, 9, "2021", "2O21"), "the year is not a number", 9, 5, 5),
    "time one column off": (edit(good_3, 9, "14.0000000  0", " 14.0000000 0"), "not in their columns", 9, 5, 5),
    "flag 7": (edit(good_3, 9, "14.0000000  0", "14.0000000  7"), "the epoch flag '7' is not in 0 to 6", 9, 5, 5),
    "count no number": (edit(good_3, 9, "0  2", "0  x"), "satellites '  x' is not a number", 9, 5, 5),
    "count of two parts": (edit(good_3, 9, "0  2", "02 2"), "satellites '2 2' is not a number", 9, 5, 5),
    "epoch line short": (edit(good_3, 9, "  0  2", ""), "shorter than 35 characters", 9, 5, 5),
    "time runs ahead": (edit(good_3, 12, "2021", "2051"), "out of order by more than 20 epochs or one hour", 12, 5, 5),
    "INTERVAL no number": (inserted(good_3, 4, record("     o.1", "INTERVAL")), "'o.1' cannot be read", 4, 6, 6),
    "position no number": (
        inserted(good_3, 4, record("  1.0  2.0  x.0 *", "APPROX POSITION XYZ")),
        "APPROX POSITION XYZ",
        4,
        6,
        6,
    ),
    "RINEX 2: letter in a phase": (edit(good_2, 10, "100000001.000", "1O0000001.000"), "L1 of G05", 10, 6, 5),
    "RINEX 2: line missing": (without(good_2, 10), "needs 2 lines, but 1 follow", 9, 5, 5),
    "RINEX 2: line too many": (inserted(good_2, 12, " " * 20 + "1.000"), "an epoch line was expected", 12, 6, 6),
    "RINEX 2: month 13": (edit(good_2, 9, "05  4", "05 13"), "the month is not in 1 to 12", 9, 5, 5),
    "RINEX 2: epoch line broken": (edit(good_2, 9, " 0  0  1.0", " 0  0  1,0"), "an epoch line was expected", 9, 5, 5),
    "RINEX 2: no name": (edit(good_2, 9, "G05", "G?5"), "no satellite name can be read", 10, 6, 5),
    "RINEX 2: names missing": (edit(good_2, 9, "G05G12", "G05"), "no satellite name can be read", 11, 6, 6),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_broken_line(tmp_path: Path, name: str) -> None:
    lines, words, number, epochs, left = BROKEN[name]
    path = write(tmp_path / "log.obs", lines)
    with pytest.raises(InputFileError, match=re.escape(words)) as caught:
        read_observations(path)
    assert caught.value.line == number
    assert str(caught.value).startswith(f"{path}, line {number}: ")
    counted = read_observations(path, broken_lines="count")
    assert len(counted) == epochs
    five = (counted.satellite == "G05") & (counted.signal == "1C")
    assert np.isfinite(counted.code_m[:, five]).sum() == left
    assert counted.problem_count >= 1
    assert f"line {number}: " in counted.problems[0]
    assert words in counted.problems[0]
    assert sum(counted.skipped.values()) == counted.problem_count


#: Lines, words of the note, epochs that are read, seconds of their tags.
READ_WITH_A_NOTE: Final = {
    "two epochs exchanged": (
        [*good_3()[:8], *good_3()[11:14], *good_3()[8:11], *good_3()[14:]], "1 epoch out of order, sorted", 6,
    ),
    "a tag once more": (edit(good_3, 12, "15.0000000", "14.0000000"), "1 epoch with a repeated time tag", 5),
    "end in the middle": (good_3()[:-1], "line 22: the file ends in the middle of an epoch", 5),
    "end in an event": ([*good_3(), *epoch_3("", flag=4, count=3)], "line 24: the file ends in the middle", 6),
    "end in an epoch line": ([*good_3(), "> 2021 05 17 02 3"], "line 24: the file ends in the middle", 6),
    "position by words": (
        inserted(good_3, 4, record("  1.0  2.0  3.0 *", "APPROX POSITION XYZ")), "line 4: APPROX POSITION XYZ is", 6,
    ),
    "RINEX 2: tag once more": (edit(good_2, 12, "2.0000000", "1.0000000"), "with a repeated time tag", 5),
    "RINEX 2: end in the middle": (good_2()[:-1], "line 22: the file ends in the middle of an epoch", 5),
    "RINEX 2: end in an epoch line": ([*good_2(), " 05  4  2  0"], "line 24: the file ends in the middle", 6),
    "RINEX 2: end in an event": ([*good_2(), event_2(4, [""] * 3)[0]], "line 24: the file ends in the middle", 6),
}  # fmt: skip


@pytest.mark.requirement("G5")
@pytest.mark.parametrize("broken_lines", ["stop", "count"])
@pytest.mark.parametrize("name", READ_WITH_A_NOTE)
def test_what_loses_nothing_is_read_with_a_note(tmp_path: Path, name: str, broken_lines: BrokenLines) -> None:
    lines, words, epochs = READ_WITH_A_NOTE[name]
    found = read_observations(write(tmp_path / "log.obs", lines), broken_lines=broken_lines)
    assert len(found) == epochs
    assert (np.diff(found.time) > np.timedelta64(0, "ns")).all()
    assert any(words in problem for problem in found.problems), found.problems
    good = read_observations(write(tmp_path / "good.obs", good_2() if name.startswith("RINEX 2") else good_3()))
    for time, code in zip(found.time, found.code_m, strict=True):
        if "once more" not in name:  # the same epochs as in the good file, whatever their place
            np.testing.assert_array_equal(code, good.code_m[good.time == time][0])


@pytest.mark.requirement("G5")
@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("what", ["comment", "header", "other types"])
def test_header_records_among_the_epochs(tmp_path: Path, version: int, what: str) -> None:
    """Files joined by cat, and edited: comments are passed over, a further header is applied from there on."""
    lines = good_2() if version == 2 else good_3()
    head = next(k for k, line in enumerate(lines) if "END OF HEADER" in line) + 1
    size = (len(lines) - head) // 6
    middle = head + 3 * size
    added = [record("joined by hand", "COMMENT")] * 2
    if what != "comment":
        added = lines[:head]
    path = write(tmp_path / "log.obs", [*lines[:middle], *added, *lines[middle:]])
    good = read_observations(write(tmp_path / "good.obs", lines))
    if what == "other types":  # code and phase change places in the header and in the lines after it
        swapped = {"C1C L1C": "L1C C1C", "    C1    L1": "    L1    C1", "    L1    C1": "    C1    L1"}
        old, new = next((o, n) for o, n in swapped.items() if any(o in line for line in lines[:head]))
        text = "\n".join([*lines[:middle], *(line.replace(old, new) for line in added), *lines[middle:]])
        found = read_observations(write(tmp_path / "log.obs", text.splitlines()))
        np.testing.assert_array_equal(found.code_m[:3], good.code_m[:3])
        assert not np.array_equal(found.code_m[3:], good.code_m[3:])
        assert any(f"line {middle + 1}: another header begins here" in problem for problem in found.problems)
        return
    found = read_observations(path)
    np.testing.assert_array_equal(found.code_m, good.code_m)
    assert not found.problems


def test_strict_names_the_first_of_several(tmp_path: Path) -> None:
    lines = good_3()
    lines[11] = lines[11].replace("0  2", "0  x")
    lines[9] = lines[9].replace("20000001", "2000000I")
    lines[14] = lines[14].replace("15", "99")
    with pytest.raises(InputFileError) as caught:
        read_observations(write(tmp_path / "log", lines))
    assert caught.value.line == 10


def test_many_problems_are_told_of_in_few_sentences(tmp_path: Path) -> None:
    lines = header_3()
    for k in range(90):
        lines += epoch_3(f"02 {k // 60:02d} {k % 60:02d}.0000000", {"G05": [field("x")], "G12": [field(2e7)]})
    path = write(tmp_path / "log", lines)
    whole = read_observations(path, broken_lines="count")
    assert (len(whole), whole.problem_count, len(whole.problems)) == (90, 90, 51)
    assert whole.problems[-1] == "and 40 more problems"
    assert whole.skipped == {"broken satellite lines": 90}
    assert "the satellite was skipped in this epoch" in whole.problems[0]


def _sp3() -> bytes:
    return b"#cP2021  5 17  0  0  0.00000000      96 ORBIT IGS14 HLM  IGS\n## 2158  86400.00000000\n"


def _navigation() -> bytes:
    return text_of(
        [
            record("     3.04           N: GNSS NAV DATA    M: MIXED", "RINEX VERSION / TYPE"),
            record("", "END OF HEADER"),
        ]
    )


WRONG_FILE: dict[str, tuple[bytes, str]] = {
    "navigation file": (_navigation(), "is a RINEX navigation file (--nav); a RINEX observation file was expected"),
    "SP3 file": (_sp3(), "is an SP3 file of precise orbits"),
    "NMEA log": (b"$GNGGA,023313.00,2218.0,N,11410.0,E,1,12,0.6,5.0,M,,M,,*7F\n" * 9, "is an NMEA log"),
    "log of a phone": (b"# \n# Header Description:\n# \n# Version: 1.4.0.0, Platform: N\n", "Android's GnssLogger"),
    "position log": (b"% program   : RTKPOST ver.2.4.3\n" * 9, "is an RTKLIB solution"),
    "other text": (b"latitude,longitude\n35.0,139.0\n", "is a table; a RINEX observation file was expected"),
    "clock file": (text_of([record("     3.00           C", "RINEX VERSION / TYPE")]), "is a RINEX clock or"),
    "empty": (b"", "is empty"),
    "blank": (b" \n\n", "is empty"),
    "empty gzip": (gzip.compress(b""), "is empty"),
    "binary": (bytes(range(256)) * 20, "is binary"),
    "zip": (b"PK\x03\x04" + bytes(99), "the zip archive is damaged"),
    "version 1": (text_of(header_2(version="1.00")), "version 1.00 is not supported"),
    "version 5": (text_of(header_3(version="5.00")), "version 5.00 is not supported"),
    "version no number": (text_of(header_3(version="3.x")), "version '3.x' is not a number"),
    "system of the file": (text_of(header_3(system="Q")), "satellite system 'Q'"),
    "no END OF HEADER": (text_of(good_3()[:4] + good_3()[5:]), "has no END OF HEADER"),
    "only the first line": (text_of(good_3()[:1]), "has no END OF HEADER"),
    "no types": (text_of(header_3({})), "has no SYS / # / OBS TYPES"),
    "no types, RINEX 2": (text_of(without(good_2, 3)), "has no # / TYPES OF OBSERV"),
    "types miscounted": (text_of(edit(good_3, 3, "G    4", "G    5")), "5 observation types of G are declared, but 4"),
    "types uncounted": (text_of(edit(good_3, 3, "G    4", "G    x")), "number of types 'x' is not a whole number"),
    "type unknown": (text_of(edit(good_3, 3, "L1C", "Y1C")), "'Y1C' is not an observation type"),
    "types of nothing": (text_of(edit(good_3, 3, "G    4", "      ")), "the constellation letter is missing"),
    "time system": (text_of(edit(good_3, 4, "GPS", "TAI")), "time system 'TAI' is none of"),
    "scale factor": (text_of(inserted(good_3, 4, record("G   7", "SYS / SCALE FACTOR"))), "'7' is none of 1, 10"),
    "scale factor's types": (
        text_of(inserted(good_3, 4, record("G   10   3 C1C", "SYS / SCALE FACTOR"))),
        "3 observation types were expected, but 1 are listed",
    ),
    "strength unit": (text_of(inserted(good_3, 4, record("SNR", "SIGNAL STRENGTH UNIT"))), "DBHZ was expected"),
    "header only": (text_of(header_3()), "has a header but no epochs"),
    "gzip cut short": (gzip.compress(text_of(good_3()))[:-40], "the packed data end early"),
    "gzip damaged": (b"\x1f\x8b" + bytes(200), "the packed data are damaged"),
    "compress damaged": (b"\x1f\x9d\x90" + b"\xff" * 200, "compress (.Z) data are damaged"),
    "Hatanaka cut short": (rnx2crx(text_of(good_3()))[:-60], "Hatanaka (CRX) data are cut short or damaged at line"),
    "Hatanaka header only": (rnx2crx(text_of(good_3()))[:200], "Hatanaka (CRX) data are cut short"),
    "very long line": (text_of(header_3()) + b"> " * (9 << 19), "longer than 8388608 characters"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG_FILE)
def test_wrong_file(tmp_path: Path, name: str) -> None:
    content, words = WRONG_FILE[name]
    path = tmp_path / "log.obs"
    path.write_bytes(content)
    with pytest.raises(InputFileError, match=re.escape(words)) as caught:
        read_observations(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_missing_and_unreadable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputFileError, match="no such file"):
        read_observations(tmp_path / "nowhere.obs")
    with pytest.raises(InputFileError, match="is a folder"):
        read_observations(tmp_path)
    path = write(tmp_path / "log", good_3())

    def refuse(*_args: object, **_options: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(InputFileError, match=r"cannot be opened \(Permission denied\)"):
        read_observations(path)


@pytest.mark.parametrize(
    ("old", "words"), [("  20000000.000  ", "C1C of G05 is"), ("G05  20000000.000  ", "no satellite name")]
)
def test_zeros_left_by_a_failing_recorder(tmp_path: Path, old: str, words: str) -> None:
    lines = header_3()
    for k in range(60):
        lines += epoch_3(f"02 33 {k:02d}.0000000", {"G05": [field(2e7), field(1e8), field(None), field(45.0)]})
    assert len(text_of(lines[:105])) > 5000  # zeros in the first block say that the whole file is binary
    lines[106] = lines[106].replace(old, "\0" * (16 if old[0] == " " else 90_000))
    path = write(tmp_path / "log", lines)
    with pytest.raises(InputFileError, match=words) as caught:
        read_observations(path)
    assert caught.value.line == 107
    assert str(caught.value).isprintable()
    assert np.isfinite(read_observations(path, broken_lines="count").code_m).sum() == 59


@pytest.mark.parametrize("pack", ["gzip", "hatanaka"])
def test_data_before_damage_are_read(tmp_path: Path, pack: str) -> None:
    lines = header_3()
    rng = np.random.default_rng(3)
    for k in range(3600):
        lines += epoch_3(f"02 {k // 60:02d} {k % 60:02d}.0000000", {"G05": [field(2e7 + rng.normal(0.0, 1e5))]})
    packed = gzip.compress(text_of(lines)) if pack == "gzip" else rnx2crx(text_of(lines))
    path = tmp_path / "log"
    path.write_bytes(packed[: len(packed) * 2 // 3])
    with pytest.raises(InputFileError, match=r"end early|cut short"):
        read_observations(path)
    counted = read_observations(path, broken_lines="count")
    assert len(counted) > 1000 or pack == "gzip"
    assert "the data before this place were read" in counted.problems[0]


def test_compress_cut_short_ends_in_the_middle(tmp_path: Path) -> None:
    path = tmp_path / "log.Z"
    path.write_bytes(ncompress.compress(text_of(good_3()))[:-30])
    found = read_observations(path)
    assert 0 < len(found) < 6
    assert "ends in the middle of an epoch" in found.problems[0]


def test_nothing_in_the_span_asked_for(tmp_path: Path) -> None:
    path = write(tmp_path / "log", good_3())
    with pytest.raises(MismatchError, match="no epoch lies in the time span"):
        read_observations(path, start="2022-01-01")


@pytest.mark.parametrize("options", [{"broken_lines": "ignore"}, {"systems": "GX"}, {"systems": ""}])
def test_options_are_checked(tmp_path: Path, options: dict[str, str]) -> None:
    with pytest.raises(ValueError, match=r"was expected|were expected"):
        read_observations(write(tmp_path / "log", good_3()), **options)
    with pytest.raises(ValueError, match="at least 1 was expected"):
        scan_observations(tmp_path / "log", epochs=0)
    with pytest.raises(SettingsError, match="no file"):
        read_observations([])


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    old=st.booleans(),
    edits=st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 3), st.binary(min_size=1, max_size=4)), min_size=1),
)
@example(old=False, edits=[(1549, 0, b"\xb2")])  # a digit, but of no number
def test_whatever_is_broken_ends_in_one_sentence(
    tmp_path: Path, old: bool, edits: list[tuple[int, int, bytes]]
) -> None:
    """Bytes overwritten, inserted and cut out anywhere, the header included."""
    text = bytearray(text_of(good_2() if old else good_3()))
    for place, cut, new in edits:
        at = place % len(text)
        text[at : at + cut] = new
    path = tmp_path / "log"
    path.write_bytes(text)
    try:
        strict = read_observations(path)
    except InputFileError as error:
        assert str(error).startswith(str(path))  # noqa: PT017
    else:
        assert all(problem.startswith(str(path)) for problem in strict.problems)
    try:
        counted = read_observations(path, broken_lines="count")
    except InputFileError:
        return
    assert len(counted) > 0
    assert (np.diff(counted.time) > np.timedelta64(0, "ns")).all()
