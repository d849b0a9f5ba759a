"""CNAV, F/NAV and B-CNAV pages of receivers: from broadcast records, against cssrlib's reading, whole and cut streams.

`tests/references/nav_pages.json` was written by ``python tests/references/make_nav_page_references.py`` with
cssrlib 1.2.1, which reads the same pages.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from conftest import ROOT
from nav_pages import TOW_S, WEEK, bcnav1_frame, bcnav2_messages, cnav_pages, fnav_pages, sbf_block, sbf_page, ubx_page
from railfix.core.timescale import from_week
from railfix.gnss.navigation import Navigation
from railfix.io import read_navigation
from railfix.io.receiver.ephemerides import assemble_navigation, merge_records
from railfix.io.receiver.log import StreamState, decode
from railfix.run.convert import convert_logs

pytestmark = pytest.mark.requirement("A11")

REFERENCE: Final = json.loads((ROOT / "tests" / "references" / "nav_pages.json").read_text(encoding="utf-8"))
#: Records that pages are made of; numbers as a receiver of 2025 had them, not whole units of the last place.
CNAV: Final[dict[str, float]] = REFERENCE["cnav"]["given"]
FNAV: Final[dict[str, float]] = REFERENCE["fnav"]["given"]
BCNAV2: Final[dict[str, float]] = REFERENCE["bcnav2"]["given"]


def navigation(data: bytes, *, step: int | None = None) -> Navigation:
    """Records of a stream, whole or in blocks of so many bytes."""
    state, parts = StreamState(), []
    step = step or len(data)
    for first in range(0, len(data), step):
        piece, state = decode(data[first : first + step], state, at_end=first + step >= len(data))
        parts.append(piece.ephemerides)
    return assemble_navigation(merge_records(parts))


def stream(pages: list[np.ndarray], system: str, number: int, *, protocol: str) -> bytes:
    make = ubx_page if protocol == "ubx" else sbf_page
    return b"".join(make(page, system, number) for page in pages)


@pytest.mark.parametrize("protocol", ["ubx", "sbf"])
def test_cnav_pages_give_the_record_they_are_made_of_and_cssrlibs(protocol: str) -> None:
    found = navigation(stream(cnav_pages(CNAV, 30), "G", 30, protocol=protocol))
    record, expected = found.kepler, REFERENCE["cnav"]["cssrlib"]
    assert (record.satellite.tolist(), record.message.tolist()) == (["G30"], ["CNAV"])
    for name, value in expected.items():
        got = (
            float(getattr(record, name)[0])
            if not name.startswith("isc_")
            else float(record.inter_signal_s[0, int(name[4:])])
        )
        assert got == pytest.approx(value, rel=1e-12, abs=1e-22), name
    given = {"af0_s": 2.0**-36, "m0": 1e-9, "i0": 1e-9, "omega_dot": 2.0**-44, "crs": 2.0**-9}
    for name, half in given.items():
        assert getattr(record, name)[0] == pytest.approx(CNAV[name], abs=half * np.pi), name
    assert record.health[0] == CNAV["health"]
    assert record.toc[0] == record.toe[0] == np.datetime64("2025-02-15T17:30:00", "ns")
    assert record.transmitted[0] == from_week(WEEK, TOW_S)
    assert set(found.klobuchar) == {"G"}


@pytest.mark.parametrize("protocol", ["ubx", "sbf"])
def test_fnav_pages_give_the_record_they_are_made_of_and_cssrlibs(protocol: str) -> None:
    found = navigation(stream(fnav_pages(FNAV, 5), "E", 5, protocol=protocol))
    record, expected = found.kepler, REFERENCE["fnav"]["cssrlib"]
    assert (record.satellite.tolist(), record.message.tolist()) == (["E05"], ["FNAV"])
    for name, value in expected.items():
        assert float(getattr(record, name)[0]) == pytest.approx(value, rel=1e-12, abs=1e-22), name
    assert record.data_source[0] == 0b1_0000_0010, "E5a, clock of E5a and E1"
    assert (record.accuracy_m[0], record.transmitted[0]) == (pytest.approx(3.12), from_week(WEEK, TOW_S))
    assert record.health[0] == 1 << 4 | 0 << 3


def b1c_block(frame: np.ndarray, number: int = 27, checks: tuple[int, int] = (1, 1)) -> bytes:
    return sbf_block(4218, frame, number + 140, (*checks, 13))


BCNAV: Final = {
    "ubx": ("bcnav2", stream(bcnav2_messages(BCNAV2, 27), "C", 27, protocol="ubx")),
    "sbf": ("bcnav2", stream(bcnav2_messages(BCNAV2, 27), "C", 27, protocol="sbf")),
    "sbf, B1C": ("bcnav1", b1c_block(bcnav1_frame(BCNAV2, 27))),
}


@pytest.mark.parametrize("made", list(BCNAV))
def test_bcnav_messages_give_the_record_they_are_made_of_and_cssrlibs(made: str) -> None:
    message, data = BCNAV[made]
    found = navigation(data)
    record, expected = found.kepler, REFERENCE[message]["cssrlib"]
    assert (record.satellite.tolist(), record.message.tolist()) == (["C27"], [message.upper().replace("BCNAV", "CNV")])
    assert not found.skipped
    for name, value in expected.items():
        got = getattr(record, name)[0] if name[:4] != "isc_" else record.inter_signal_s[0, int(name[4:])]
        assert float(got) == pytest.approx(value, rel=1e-12, abs=1e-22), name
    for name, half in {"af0_s": 2.0**-35, "m0": 1e-9, "omega_dot": 2.0**-44, "crs": 2.0**-9, "cuc": 2.0**-31}.items():
        assert getattr(record, name)[0] == pytest.approx(BCNAV2[name], abs=half * np.pi), name
    assert (record.health[0], record.iode[0], record.iodc[0]) == (1, 117, 629)
    # GPS time is 14 s ahead of BeiDou's, and week 997 of that is week 2353
    assert record.toc[0] == record.toe[0] == from_week(2353, 576_000.0) + np.timedelta64(14, "s")
    sent_s = 576_012.0 if message == "bcnav2" else 576_072.0
    assert record.transmitted[0] == from_week(2353, sent_s) + np.timedelta64(14, "s")


def test_bcnav1_frames_damaged_or_of_another_satellite_make_no_record_and_are_read_once() -> None:
    frame = bcnav1_frame(BCNAV2, 27)
    assert not len(navigation(b1c_block(frame, 28)).kepler)
    for place in (100, 660, 1280, 1530):
        broken = frame.copy()
        broken[place] ^= 1
        found = navigation(b1c_block(broken))
        assert (len(found.kepler), found.skipped) == (0, {"C B-CNAV1 without valid CRC": 1})
    for checks in ((0, 1), (1, 0)):
        assert not len(navigation(b1c_block(frame, checks=checks)).kepler)
    assert not len(navigation(b1c_block(bcnav1_frame(BCNAV2, 27, page=25))).kepler)
    frame[700] ^= 1  # a symbol that corrects others
    assert len(navigation(b1c_block(frame) * 2, step=37).kepler) == 1


def test_bcnav2_messages_of_two_issues_damaged_or_of_another_satellite_make_no_record() -> None:
    pages = bcnav2_messages(BCNAV2, 27)
    other = bcnav2_messages({**BCNAV2, "iodc": 630.0, "iode": 118.0}, 27)
    broken = [page.copy() for page in pages]
    broken[1][77] ^= 1
    for sent in ([pages[0], pages[1], other[2]], broken, [pages[0], pages[2]]):
        assert not len(navigation(stream(sent, "C", 27, protocol="sbf")).kepler)
    assert not len(navigation(stream(pages, "C", 28, protocol="sbf")).kepler)
    skipped = navigation(stream(broken, "C", 27, protocol="ubx")).skipped
    assert skipped == {"C B-CNAV2 without valid CRC": 1}


def test_a_stream_cut_anywhere_and_with_repeated_pages_gives_the_same_record_once() -> None:
    data = b"".join(
        stream(cnav_pages(CNAV, 30) * 2, "G", 30, protocol=protocol)
        + stream(fnav_pages(FNAV, 5) * 2, "E", 5, protocol=protocol)
        for protocol in ("ubx", "sbf")
    )
    for step in (37, 100, len(data)):
        found = navigation(data, step=step)
        assert sorted(zip(found.kepler.satellite.tolist(), found.kepler.message.tolist(), strict=True)) == [
            ("E05", "FNAV"),
            ("G30", "CNAV"),
        ]


def test_an_unavailable_group_delay_is_unknown_and_qzss_has_its_own_axis() -> None:
    absent: dict[str, Any] = {**CNAV, "inter_signal_1": -4096 * 2.0**-35, "sqrt_a": 6493.5}
    pages = cnav_pages(absent, 2, system="J")
    found = navigation(stream(pages, "J", 2, protocol="ubx")).kepler
    assert np.isnan(found.inter_signal_s[0, 1])
    assert np.isfinite(found.inter_signal_s[0, [0, 2, 3]]).all()
    assert found.sqrt_a[0] == pytest.approx(6493.5, abs=1e-6)


def test_convert_leaves_cnav_out_and_says_so(tmp_path: Path) -> None:
    log, out = tmp_path / "a.ubx", tmp_path / "a.rnx"
    log.write_bytes(
        stream(cnav_pages(CNAV, 30), "G", 30, protocol="ubx") + stream(fnav_pages(FNAV, 5), "E", 5, protocol="ubx")
    )
    lines = convert_logs((log,), out=None, nav_out=out, rinex="4")
    assert "skipped 1 G CNAV ephemerides, which are not written" in lines
    again = read_navigation([out]).kepler
    assert (again.satellite.tolist(), again.message.tolist()) == (["E05"], ["FNAV"])


def test_damaged_mixed_and_foreign_pages_make_no_record() -> None:
    pages = cnav_pages(CNAV, 30)
    broken = [page.copy() for page in pages]
    broken[1][100] ^= 1
    assert not len(navigation(stream(broken, "G", 30, protocol="ubx")).kepler)
    other = cnav_pages({**CNAV, "toe_sow_s": CNAV["toe_sow_s"] + 7200.0}, 30)
    assert not len(navigation(stream([pages[0], other[1], pages[2]], "G", 30, protocol="ubx")).kepler)
    assert not len(navigation(stream(pages, "G", 29, protocol="ubx")).kepler)
    later = fnav_pages({**FNAV, "iod": 90.0}, 5)
    assert not len(navigation(stream([*fnav_pages(FNAV, 5)[:3], later[3]], "E", 5, protocol="ubx")).kepler)
