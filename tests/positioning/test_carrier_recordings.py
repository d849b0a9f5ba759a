"""What carrier phase buys on a made run with noise alone and on the recordings."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import carrier_forms
import level_cases
from pipeline_cases import clean_files
from railfix.evaluate import Score, score


@cache
def clean() -> carrier_forms.Carried:
    return carrier_forms.carried(level_cases.of_files(clean_files()))


@cache
def recorded(name: str) -> carrier_forms.Carried:
    return carrier_forms.carried(level_cases.cases()[name])


def scores(found: carrier_forms.Carried) -> dict[str, Score]:
    """On the epochs that all forms have."""
    errors = found.errors()
    both = np.all([np.isfinite(e) for e in errors.values()], axis=0)
    assert both.sum() >= 0.98 * np.isfinite(errors["code"]).sum()
    return {name: score(error, both) for name, error in errors.items()}


@pytest.mark.requirement("A5")
def test_noise_of_the_simulated_run_falls():
    """Codes 0.43 m; smoothed below a fifth, with float ambiguities below a tenth of that."""
    got = scores(clean())
    assert got["code"].std_m > 0.35
    assert got["hatch"].std_m < 0.2 * got["code"].std_m
    assert got["live"].std_m < 0.1 * got["code"].std_m
    assert got["runs"].std_m < 0.05 * got["code"].std_m


@pytest.mark.requirement("A5")
def test_slips_put_into_the_simulated_run_are_all_found():
    found = clean()
    assert not (found.slips.slip[1:] & np.isfinite(found.slips.phase_m[:-1])).any()
    assert not found.jumps.jump.any()
    for one in carrier_forms.detections(found, count=60):
        assert one.by_receiver_tests == 1.0
        assert one.by_either == 1.0


@pytest.mark.requirement("A5")
@pytest.mark.slow
@pytest.mark.usefixtures("recordings")
def test_a_mosaic_in_the_open():
    """No Dopplers: the line finds every slip of one cycle; the median error falls below half."""
    found = recorded("Japan")
    got = scores(found)
    assert got["live"].p50_m < 0.5 * got["code"].p50_m
    assert got["live"].p95_m < 0.55 * got["code"].p95_m
    for one in carrier_forms.detections(found, sizes=(1, 10), count=60):
        assert one.by_receiver_tests == 0.0
        assert one.by_either > 0.97
    assert found.jumps.jump.sum() < 0.003 * found.jumps.judged.sum()


@pytest.mark.requirement("A5")
@pytest.mark.parametrize(("name", "p50"), [("F9P", 0.95), ("M8T", 0.75), ("Pixel", 0.9)])
@pytest.mark.slow
@pytest.mark.usefixtures("recordings")
def test_in_towns_it_does_no_harm(name: str, p50: float):
    """Arcs of seconds, codes wrong by tens of metres: the median gains, the 95 % little."""
    got = scores(recorded(name))
    assert got["live"].p50_m < p50 * got["code"].p50_m
    assert got["live"].p95_m < 1.05 * got["code"].p95_m
    assert got["hatch"].p50_m < 1.0 * got["code"].p50_m
    assert got["hatch"].p95_m < 1.05 * got["code"].p95_m


@pytest.mark.requirement("A5")
@pytest.mark.slow
@pytest.mark.usefixtures("recordings")
def test_a_static_station_every_30_s():
    """P4's experiment has 30 s: Dopplers absent, ambiguities that walk 0.05 m between epochs."""
    code, live = [], []
    for station, azimuth_deg in (("0759", 0.0), ("3040", 90.0)):
        errors = carrier_forms.carried(level_cases.station(station, azimuth_deg)).errors()
        code.append(errors["code"])
        live.append(errors["live"])
    assert np.percentile(np.abs(live), 95) < 1.05 * np.percentile(np.abs(code), 95)
    assert np.std(live) < np.std(code)
