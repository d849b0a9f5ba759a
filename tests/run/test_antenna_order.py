"""Order of the two antennas by their positions: exchanged logs give a note, everything else does not."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from railfix import antenna_trajectory, read_track, read_vehicle
from railfix.cli import app
from railfix.pipeline.antenna_order import AntennaOrder
from railfix.simulate.demonstration import demo_files
from railfix.track.trajectory import Trajectory

pytestmark = pytest.mark.requirement("B5")
SPACING_M = 18.2


@cache
def paths(facing: str = "rising", reference: Any = "antenna") -> tuple[Trajectory, Trajectory]:
    """Trajectories of the two antennas of the demonstration's car."""
    files = demo_files()
    vehicle = read_vehicle(files["vehicle"]).model_copy(update={"facing": facing})
    track = read_track(files["track"])
    front, rear = (antenna_trajectory(track, vehicle, name, reference=reference) for name in ("front", "rear"))
    return front, rear


def order_of(
    middle_m: np.ndarray[Any, Any],
    *,
    facing: str = "rising",
    reference: str = "antenna",
    exchanged: bool = False,
    sigma_m: float = 2.0,
    extra_m: float = 0.0,
) -> AntennaOrder:
    """Order by noisy positions of a car whose middle is at `middle_m`, ten a second."""
    front, rear = paths(facing, reference)
    random = np.random.default_rng(1)
    time = np.datetime64("2024-03-05T03:10:00", "ns") + np.arange(len(middle_m)) * np.timedelta64(100, "ms")
    half = SPACING_M / 2.0 * (1.0 if facing == "rising" else -1.0)
    ends = {"front": middle_m + half, "rear": middle_m - half}  # where the antennas are
    if exchanged:
        ends = {"front": ends["rear"], "rear": ends["front"]}
    if reference == "centre":
        ends = {"front": ends["front"] - half, "rear": ends["rear"] + half}
    ends["front"] = ends["front"] + extra_m
    order = AntennaOrder(front, rear, tolerance_s=0.01)
    sigma = np.full(len(time), sigma_m)
    samples = [(time, ends[n] + sigma_m * random.standard_normal(len(time)), sigma) for n in ("front", "rear")]
    for first in range(0, len(time), 70):
        order.add(*((t[first : first + 70], x[first : first + 70], s[first : first + 70]) for t, x, s in samples))
    return order


RISING = np.linspace(50.0, 650.0, 600)


@pytest.mark.parametrize("facing", ["rising", "falling"])
@pytest.mark.parametrize("reference", ["antenna", "centre"])
@pytest.mark.parametrize("way", [RISING, RISING[::-1]], ids=["rising", "falling"])
def test_exchanged_logs_are_noted_whichever_way_the_train_faces_and_runs(
    way: np.ndarray[Any, Any], facing: str, reference: str
) -> None:
    right = order_of(way, facing=facing, reference=reference)
    assert right.distance_m == pytest.approx(SPACING_M, abs=0.05)
    assert right.measure()[0] == pytest.approx(SPACING_M, abs=4.0 * right.measure()[1])
    assert right.note is None
    exchanged = order_of(way, facing=facing, reference=reference, exchanged=True)
    assert exchanged.measure()[0] == pytest.approx(-SPACING_M, abs=4.0 * exchanged.measure()[1])
    assert "should be 18.2 m ahead of those of the rear log, but they are" in exchanged.note


def test_what_is_not_certain_is_not_noted() -> None:
    still = order_of(np.full(600, 300.0), exchanged=True)
    assert np.isnan(still.measure()[0])
    assert still.note is None
    noisy = order_of(RISING, exchanged=True, sigma_m=40.0)
    assert noisy.note is None
    assert noisy.measure()[1] > 5.0
    # time tags a leap apart put the front log far behind: not what an exchange does
    assert order_of(RISING, extra_m=-360.0).note is None
    assert order_of(RISING, extra_m=-12.0).note is None


def test_the_sigma_grows_with_the_scatter_of_the_stretches() -> None:
    order = order_of(RISING)
    _, before = order.measure()
    stretches = order._stretches
    for k, (key, (count, distance, variance)) in enumerate(sorted(stretches.items())):
        stretches[key] = (count, distance + (-1.0) ** k * 20.0 * count, variance)
    assert order.measure()[1] > 5.0 * before


def test_there_is_no_order_of_one_antenna_or_without_a_vehicle() -> None:
    front, rear = paths()
    assert AntennaOrder.between({"front": front}, tolerance_s=0.01) is None
    track = Trajectory.from_antenna_path(read_track(demo_files()["track"]))
    assert AntennaOrder.between({"front": track, "rear": track}, tolerance_s=0.01) is None
    assert AntennaOrder.between({"front": front, "rear": rear}, tolerance_s=0.01) is not None


@pytest.mark.parametrize("exchanged", [False, True])
@pytest.mark.every(2)
def test_the_run_says_unasked_that_its_logs_are_exchanged(tmp_path: Path, exchanged: bool) -> None:
    files = demo_files()
    logs = [files["rear"], files["front"]] if exchanged else [files["front"], files["rear"]]
    words = ["run", "--front", logs[0], "--rear", logs[1], "--out", tmp_path / "out", "--filter", "off"]
    words += [word for name in ("nav", "track", "vehicle") for word in (f"--{name}", files[name])]
    words += ["--start", "2024-03-05T03:10:30", "--end", "2024-03-05T03:11:00", "--chunk", "100"]
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    notes = [note for note in json.loads((tmp_path / "out" / "run.json").read_text())["notes"] if "swapped" in note]
    assert len(notes) == exchanged
    assert ("swapped" in result.output) == exchanged
