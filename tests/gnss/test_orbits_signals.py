"""Carrier frequencies of channels."""

from __future__ import annotations

import numpy as np
import pytest

from railfix.gnss.observations import carrier_frequency_hz


@pytest.mark.requirement("A7")
@pytest.mark.parametrize(
    ("satellite", "signal", "mhz"),
    [
        ("G01", "1C", 1575.42), ("G01", "2W", 1227.60), ("G01", "5Q", 1176.45), ("J02", "6L", 1278.75),
        ("E11", "1X", 1575.42), ("E11", "7Q", 1207.14), ("E11", "8X", 1191.795), ("E11", "6C", 1278.75),
        ("C20", "2I", 1561.098), ("C20", "1P", 1575.42), ("C20", "6I", 1268.52), ("C20", "7I", 1207.14),
        ("R05", "1C", 1602.5625), ("R05", "2C", 1246.4375), ("R10", "1C", 1602.0 - 7 * 0.5625), ("R05", "3Q", 1202.025),
    ],
)  # fmt: skip
def test_frequencies_of_the_interface_documents(satellite: str, signal: str, mhz: float) -> None:
    found = carrier_frequency_hz(np.array([satellite]), np.array([signal]), {"R05": 1, "R10": -7})
    assert found[0] == pytest.approx(mhz * 1e6, abs=1e-3)


def test_what_is_unknown_is_nan() -> None:
    satellite, signal = np.array(["R06", "G01", "X01", "R05"]), np.array(["1C", "9C", "1C", "3Q"])
    assert np.isnan(carrier_frequency_hz(satellite, signal)).tolist() == [True, True, True, False]
