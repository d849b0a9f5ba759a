"""Interpolated satellites of the simulation against their own formulas at every instant, and the product's orbits."""

from __future__ import annotations

import numpy as np
import pytest

from railfix.simulate import Scenario, SkySettings, build_alignment, simulate_navigation
from railfix.simulate.constellation import SatelliteTable, links

pytestmark = pytest.mark.requirement("D4")

SCENARIO = Scenario(duration_s=7200.0, sky=SkySettings(systems="GJEC"))
NAVIGATION = simulate_navigation(SCENARIO)
NAMES = sorted({str(s) for s in NAVIGATION.kepler.satellite})
LAST = SCENARIO.start + np.timedelta64(7200, "s")
PLACE = build_alignment(SCENARIO.line).at(np.zeros(1))[0]


def test_the_table_is_the_formulas_within_a_micrometre() -> None:
    """Over two hours with changes of records, at the changes and at the ends of pieces too."""
    table = SatelliteTable(NAVIGATION.kepler, NAMES, SCENARIO.start, LAST)
    sent = NAVIGATION.kepler.transmitted
    changes = np.unique(sent[(sent > SCENARIO.start) & (sent < LAST)])
    tick = np.timedelta64(100_000_000, "ns")
    tags = np.unique(
        np.concatenate([SCENARIO.start + np.arange(0, 72_001, 97) * tick, changes, changes - tick, [LAST]])
    )
    late = np.linspace(-1e-3, 1e-3, len(tags))
    place = np.broadcast_to(PLACE, (len(tags), 3))
    found = table.links(tags, late, place)
    for k, name in enumerate(NAMES):
        exact = links(NAVIGATION.kepler, name, tags, late, place)
        assert np.abs(found.range_m[:, k] - exact.range_m).max() < 1e-6
        assert np.abs(found.satellite_ecef_m[:, k] - exact.satellite_ecef_m).max() < 1e-6
        assert np.abs(found.clock_s[:, k] - exact.clock_s).max() * 299_792_458.0 < 1e-6


def test_any_cutting_gives_the_same_numbers() -> None:
    table = SatelliteTable(NAVIGATION.kepler, NAMES, SCENARIO.start, LAST)
    tags = SCENARIO.start + np.arange(0, 7_200, 7) * np.timedelta64(1, "s")
    late, place = np.zeros(len(tags)), np.broadcast_to(PLACE, (len(tags), 3))
    whole = table.links(tags, late, place)
    for size in (1, 13):
        part = table.links(tags[size : 2 * size], late[size : 2 * size], place[size : 2 * size])
        np.testing.assert_array_equal(part.range_m, whole.range_m[size : 2 * size])
        np.testing.assert_array_equal(part.clock_s, whole.clock_s[size : 2 * size])


def test_a_tag_outside_of_the_span_is_refused() -> None:
    table = SatelliteTable(NAVIGATION.kepler, NAMES[:2], SCENARIO.start, LAST)
    with pytest.raises(ValueError, match="span"):
        table.links(np.array([LAST + np.timedelta64(1, "s")]), np.zeros(1), PLACE[None])
