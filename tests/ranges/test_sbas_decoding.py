"""Decoded SBAS messages against another decoder, over the whole recorded hour."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import sbas_cases as cases
from railfix.ranges.sbas import SbasMessages, decode, read_sbas

pytestmark = pytest.mark.requirement("C1")


@pytest.fixture(scope="module")
def log(recordings: Path) -> SbasMessages:
    return read_sbas(recordings / "sbas" / "msas_20250215" / "046r_sbas_prn137.txt")


def named(decoded: dict[str, np.ndarray]) -> SimpleNamespace:
    return SimpleNamespace(**decoded)


def sidereon_message(log: SbasMessages, row: int) -> Any:
    sidereon = pytest.importorskip("sidereon", reason="sidereon (the oracle) is not installed")
    body = bytes([*log.bits[row, :28].tolist(), int(log.bits[row, 28]) & 0xC0])
    return sidereon.decode_sbas_block(body, sidereon.SbasWireForm.BODY226).message


def test_degradation_factors_and_masks_are_those_of_sidereon(log: SbasMessages) -> None:
    factors, masks = named(decode.decode(log, 7)), named(decode.decode(log, 18))
    for i, row in enumerate(factors.row.tolist()):
        theirs = sidereon_message(log, row).fast_degradation
        assert factors.indicator[i].tolist() == list(theirs.ai)[:51]
        assert (factors.latency_s[i], factors.iodp[i]) == (theirs.system_latency_s, theirs.iodp)
    for i, row in enumerate(masks.row.tolist()):
        theirs = sidereon_message(log, row).igp_mask
        assert (masks.band[i], masks.iodi[i]) == (theirs.band_number, theirs.iodi)


def test_network_time_by_hand() -> None:
    fields = [(-5, 24), (123_456, 32), (30, 8), (49, 8), (18, 8), (137, 8), (7, 8), (18, 8), (3, 3), (302_400, 20),
              (305, 10)]  # fmt: skip
    decoded = decode.decode(cases.message_log([(0, 0, cases.message(12, 0, *fields))]), 12)
    shown = SimpleNamespace(**{name: value[0] for name, value in decoded.items()})
    assert (shown.drift, shown.offset_s) == (-5 * 2.0**-50, 123_456 * 2.0**-30)
    assert (shown.reference_s, shown.reference_week, shown.leap_s) == (30 * 4096.0, 49, 18)
    assert (shown.leap_week, shown.leap_day, shown.next_leap_s) == (137, 7, 18)
    assert (shown.utc_standard, shown.time_of_week_s, shown.week) == (3, 302_400.0, 305)


def test_reference_times_cross_midnight() -> None:
    """A time of day of the other side of midnight is of the day that lies nearer."""
    bits = cases.moving(0, 1, 48, (0.0, 0.0, 0.0), (0, 0, 0), 0, 0, 86_384)
    midnight = np.datetime64("2025-02-16T00:00:10", "ns")
    base = cases.message_log([(0, 0, bits)])
    log = SbasMessages(**{**vars(base), "time": np.array([midnight])})
    assert decode.long_term(log)["reference"][0] == np.datetime64("2025-02-15T23:59:44")
