"""Values of receiver formats that mean something of their own: one message for each, written by another program."""

from __future__ import annotations

import numpy as np
import pytest

from railfix.io.receiver.framing import Subframes, find_frames
from railfix.io.receiver.nav_messages import decode_pages
from railfix.io.receiver.ubx import positions

pyubx2 = pytest.importorskip("pyubx2")
pytestmark = pytest.mark.requirement("A7")


def test_the_accuracy_of_a_u_blox_position_is_of_both_horizontal_directions_together() -> None:
    """hAcc is the radius: 5 m are 3.54 m in each direction; vAcc is of the one vertical direction."""
    message = pyubx2.UBXMessage(
        "NAV", "NAV-PVT", pyubx2.GET, iTOW=100_000, year=2024, month=3, day=5, hour=0, min=1, second=22, validDate=1,
        validTime=1, fixType=3, gnssFixOk=1, lat=35.0, lon=135.0, height=50_000, hMSL=20_000, hAcc=5_000, vAcc=7_000,
    )  # fmt: skip
    frames = find_frames(np.frombuffer(message.serialize(), dtype=np.uint8))
    found = positions(frames, np.datetime64("2024-03-05T00:00:00", "ns"))
    np.testing.assert_allclose(found["sigma_m"], [[5.0 / np.sqrt(2.0), 5.0 / np.sqrt(2.0), 7.0]], atol=1e-9)


def test_beidou_geostationary_satellites_send_d2() -> None:
    """ICD B1I: C01 to C05 and C59 to C63 are geostationary; the others send D1."""
    names = ["C01", "C05", "C06", "C58", "C59", "C63"]
    words = np.zeros((len(names), 10), dtype=np.uint32)
    words[:, 0] = 0x712 << 19 | 1 << 12  # preamble, subframe 1
    words[:, 1] = 3 << 14  # the third page of ten, as D2 numbers them
    part = Subframes(
        satellite=np.array(names), signal=np.zeros(len(names), dtype=np.int64), words=words,
        glonass_channel=np.zeros(len(names), dtype=np.int64), order=np.arange(len(names)),
    )  # fmt: skip
    pages, _ = decode_pages(part)
    numbers = {name: number for _, name, number, _ in pages}
    assert {name for name, number in numbers.items() if number >= 100} == {"C01", "C05", "C59", "C63"}
    assert {name for name, number in numbers.items() if number == 1} == {"C06", "C58"}
