"""Balises as a source of the filter and of its level, on a simulated ride through a tunnel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from railfix.motion.samples import BaliseReadings
from railfix.pipeline.balises import VERDICTS
from railfix.pipeline.filter_result import AlongTrack
from railfix.simulate.sensor_columns import sensor_tables
from railfix.tracking import Kind
from sensed_ride import Ride, ride

#: A tunnel between 61 and 68 s; balises 40 m apart, of which B012 and B013 are in it.
RIDE = """{
    "duration_s": 84.0, "rate_hz": 2.0,
    "sensors": {
        "tachometer": {"jitter_s": 2e-6, "lowest_mps": 0.3}, "inertial": UNIT,
        "balises": {"spacing_m": 40.0, "along_m": 2.0, "noise_sigma_m": 0.3},
    },
}"""
READER = {"balise": {"ahead_m": 2.0}}
SOURCES = ("code", "phase", "doppler", "wheel", "balise")


@pytest.fixture(scope="module")
def case() -> Ride:
    return ride(RIDE)


@pytest.fixture(scope="module")
def found(case: Ride) -> AlongTrack:
    return case.run(filter_sources=SOURCES, sensors=READER)


def tunnel(case: Ride) -> np.ndarray:
    return ~np.isfinite(case.observations.code_m).any(axis=1) & (case.time_s > 50.0)


def with_readings(case: Ride, balise: dict[str, str | None], **settings: object) -> AlongTrack:
    """The ride with other identities read, or none."""
    own = case.samples.balises
    kept = np.array([balise.get(name, name) is not None for name in own.balise.tolist()])
    names = np.array([balise.get(name, name) for name in own.balise[kept].tolist()])
    readings = BaliseReadings(time=own.time[kept], balise=names, sigma_m=own.sigma_m[kept])
    samples = replace(case.samples, balises=readings)
    return case.run(filter_sources=SOURCES, sensors=READER, samples=samples, **settings)


def verdicts(result: AlongTrack) -> set[tuple[str, str]]:
    return {(p.balise, VERDICTS[p.verdict]) for p in result.passings} - {
        (p.balise, "read") for p in result.passings
    }  # fmt: skip


@pytest.mark.requirement("E7")
def test_balises_sharpen_place_and_level_and_hold_them_in_a_tunnel(case: Ride, found: AlongTrack) -> None:
    without = case.run(filter_sources=SOURCES[:-1], sensors=READER)
    inside = tunnel(case)
    both = [result.tracked for result in (found, without)]
    assert (both[0].used[:, [Kind.BALISE, Kind.NEXT_BALISE]].sum(axis=0) >= 8).all()
    assert not both[1].used[:, [Kind.BALISE, Kind.NEXT_BALISE]].any()
    assert np.abs(case.error_m(found)[inside]).max() < 0.5
    assert (np.abs(case.error_m(found)) <= both[0].level_m)[np.isfinite(both[0].level_m)].all()
    assert np.nanmedian(both[0].level_m) < 0.6 * np.nanmedian(both[1].level_m)
    assert both[0].level_m[inside][-1] < 0.6 * both[1].level_m[inside][-1]
    assert verdicts(found) == set()


@pytest.mark.requirement("E7")
@pytest.mark.parametrize("wrong", ["B006", "B012", "B013"])
@pytest.mark.parametrize("shift", [1, -2])
@pytest.mark.every(3)
def test_a_wrong_identity_is_named_and_makes_no_level_wrong(case: Ride, wrong: str, shift: int) -> None:
    read = f"B{int(wrong[1:]) + shift:03d}"
    result = with_readings(case, {wrong: read})
    level = result.tracked.level_m
    known = np.isfinite(level)
    assert (np.abs(case.error_m(result))[known] <= level[known]).all()
    assert np.abs(case.error_m(result)).max() < 3.0
    assert verdicts(result) == {(read, "contradicts"), (wrong, "missing")}


@pytest.mark.requirement("E7")
def test_a_balise_that_is_not_read_is_named_with_the_interval_of_its_passing(case: Ride) -> None:
    result = with_readings(case, {"B006": None, "B013": None})
    assert verdicts(result) == {("B006", "missing"), ("B013", "missing")}
    (passing,) = (p for p in result.passings if p.balise == "B006")
    ((time, balise, _),) = sensor_tables(case.simulation)["balise_truth"].filter(pl.col("balise") == "B006").iter_rows()
    passed = np.datetime64(time, "ns")
    assert balise == "B006"
    assert passing.earliest < passed < passing.latest
    assert abs(passing.time - passed) < np.timedelta64(200, "ms")
    assert passing.latest - passing.earliest < np.timedelta64(2, "s")


@pytest.mark.requirement("E7")
def test_without_its_fault_hypothesis_a_wrong_balise_would_make_the_level_wrong(case: Ride) -> None:
    """The wheel silent in the tunnel, the place is loose enough for a wrong place in the list to be believed."""
    pulses = case.samples.tachometer
    start = case.observations.time[0]
    kept = pulses.time < start + np.timedelta64(55, "s")
    rolled = replace(pulses, time=pulses.time[kept], pulse=pulses.pulse[kept], direction=pulses.direction[kept])
    silent = replace(case, samples=replace(case.samples, tachometer=rolled))
    listed = case.balises
    moved = replace(listed, chainage_m=listed.chainage_m + np.where(listed.name == "B012", 10.0, 0.0))
    outcomes = {}
    for prior in (1e-6, 0.0):
        result = with_readings(silent, {}, balises=moved, tracking={"level_balise_prior": prior})
        level = result.tracked.level_m
        known = np.isfinite(level)
        outcomes[prior] = bool((np.abs(case.error_m(result))[known] <= level[known]).all())
        assert np.abs(case.error_m(result))[tunnel(case)].max() > 7.0
    assert outcomes == {1e-6: True, 0.0: False}
