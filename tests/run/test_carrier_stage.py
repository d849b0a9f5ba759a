"""The carrier phase in the pipeline: how epochs are cut does not matter, and the noise goes down."""

from __future__ import annotations

from functools import cache

import numpy as np
import polars as pl
import pytest

from railfix.evaluate import along_track_error
from railfix.io import read_navigation, read_observations
from railfix.pipeline import carrier_stage
from railfix.pipeline.config import parse_config
from railfix.run.processor_setup import make_processor
from railfix.simulate import demo_files
from railfix.track import read_track
from railfix.track.vehicle import antenna_trajectory, read_vehicle

EPOCHS = 150


@cache
def demo():
    files = demo_files()
    track, vehicle = read_track(files["track"]), read_vehicle(files["vehicle"])
    truth = pl.read_csv(files["truth"]).filter(pl.col("antenna") == "front").select("x_m", "y_m", "z_m").to_numpy()
    return (
        read_observations(files["front"])[:EPOCHS],
        read_navigation(files["nav"]),
        antenna_trajectory(track, vehicle, "front"),
        truth[:EPOCHS],
    )


def run(carrier: str, cuts: int, epochs: int = EPOCHS):
    observations, navigation, trajectory, _ = demo()
    processor = make_processor(parse_config({"filter": "off", "carrier": carrier}), navigation, {"front": trajectory})
    state, parts = None, []
    for first in range(0, epochs, cuts):
        result, state = processor.process({"front": observations[first : min(first + cuts, epochs)]}, state)
        parts.append(result.antennas["front"])
    return parts


@pytest.mark.requirement("A5")
@pytest.mark.parametrize("carrier", ["smoothed", "float"])
@pytest.mark.parametrize(("cuts", "epochs"), [(1, 40), (7, EPOCHS), pytest.param(1, EPOCHS, marks=pytest.mark.slow)])
@pytest.mark.every(2)
def test_cutting_changes_nothing(carrier: str, cuts: int, epochs: int):
    (whole,), parts = run(carrier, epochs, epochs), run(carrier, cuts, epochs)
    arc = np.concatenate([part.arc_m for part in parts])
    sigma = np.concatenate([part.along_sigma_m for part in parts])
    assert np.abs(arc - whole.arc_m).max() < 1e-6
    assert np.abs(sigma - whole.along_sigma_m).max() < 1e-6


@pytest.mark.requirement("A5")
def test_phase_takes_the_noise_off():
    """Standing and running, 10 Hz: after five seconds the phases carry the position."""
    *_, trajectory, truth = demo()
    spread = {}
    for carrier in ("off", "smoothed", "float"):
        error = along_track_error(run(carrier, EPOCHS)[0].arc_m, truth, trajectory)
        spread[carrier] = float(np.std(error[50:]))
    assert spread["smoothed"] < 0.4 * spread["off"]
    assert spread["float"] < 0.4 * spread["off"]


def test_off_leaves_the_phase_alone():
    whole = run("off", EPOCHS)[0]
    assert whole.phase is None
    assert run("float", EPOCHS)[0].phase is not None


@pytest.mark.requirement("A5")
def test_a_phase_counts_by_the_sine_of_its_elevation(monkeypatch: pytest.MonkeyPatch):
    given = []
    positions = carrier_stage.phase_positions
    monkeypatch.setattr(carrier_stage, "phase_positions", lambda *a, **k: given.append(a[2]) or positions(*a, **k))
    (found,) = run("float", 5, 5)
    weight, elevation = given[0].weight, found.corrected.elevation_deg
    used = weight > 0.0
    assert used.sum() > 50
    sigma = parse_config({}).phase_sigma_m / np.sin(np.radians(elevation[used]))
    np.testing.assert_allclose(weight[used], sigma**-2.0, rtol=1e-9)
