"""Notes on ranges to ground units, on a hand-made straight line."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import polars as pl
import pytest

from railfix.core.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.motion.samples import GroundUnits, StationRanges
from railfix.pipeline.sensor_epochs import SensorLimits
from railfix.run.sensor_checks import range_notes
from railfix.track import Track
from railfix.track.trajectory import Trajectory

pytestmark = pytest.mark.requirement("E4")
START = np.datetime64("2024-03-05T03:10:00", "ns")
ORIGIN = ecef_from_geodetic(35.0, 139.0, 60.0)
EAST, _, UP = enu_axes(35.0, 139.0)
SOUTH = np.cross(EAST, UP)
AT = np.arange(0.0, 900.0, 10.0)
LINE = Trajectory.from_track(Track.from_ecef(ORIGIN + AT[:, None] * EAST, name="east"))
#: Units 3 m to the right of the line, 1 m above the antenna.
UNITS = GroundUnits(
    name=np.array(["A", "B"]), ecef_m=np.stack([ORIGIN + x * EAST + 3.0 * SOUTH + UP for x in (300.0, 600.0)])
)


def places(speed_mps: float) -> pl.DataFrame:
    """The antenna once a second; the line runs east, the train at this speed."""
    chainage = AT[:: 1 if speed_mps > 0 else -1]
    ecef = ORIGIN + chainage[:, None] * EAST
    latitude, longitude, _ = geodetic_from_ecef(ecef)
    columns = {"chainage_m": chainage, "latitude_deg": latitude, "longitude_deg": longitude}
    time = START + (np.arange(len(AT)) * 1e9).astype("timedelta64[ns]")
    return pl.DataFrame({"time_gpst": time, **columns, **dict(zip(("x_m", "y_m", "z_m"), ecef.T, strict=True))})


def ranges(table: pl.DataFrame, ahead_m: float, excess_m: float) -> StationRanges:
    """Half a second after each place, within 150 m, by a device so far ahead of the antenna and 1 m above it."""
    at = table["chainage_m"].to_numpy()
    device = ORIGIN + (0.5 * (at[1:] + at[:-1]) + ahead_m)[:, None] * EAST + UP
    time = table["time_gpst"].to_numpy().astype("datetime64[ns]")[:-1] + np.timedelta64(500, "ms")
    distance = np.linalg.norm(device[:, None] - UNITS.ecef_m, axis=2)
    row, unit = np.nonzero(distance < 150.0)
    values = distance[row, unit] + excess_m
    return StationRanges(time=time[row], station=UNITS.name[unit], range_m=values, sigma_m=np.full(len(values), np.nan))


@pytest.mark.parametrize("facing", ["rising", "falling"])
@pytest.mark.parametrize("speed", [10.0, -10.0])
def test_the_place_of_the_device_is_found_whichever_way_the_train_runs_and_faces(
    facing: Literal["rising", "falling"], speed: float
) -> None:
    trajectory, sign = replace(LINE, facing=facing), 1.0 if facing == "rising" else -1.0
    table = places(speed)
    made = ranges(table, 8.0 * sign, 0.0)
    right = SensorLimits(range_ahead_m=8.0, range_above_m=1.0)
    assert list(range_notes(made, UNITS, table, trajectory, right)) == []
    (note,) = range_notes(made, UNITS, table, trajectory, SensorLimits(range_above_m=1.0))
    assert f"8.0 m {'ahead of' if sign > 0 else 'behind'} those by satellites" in note
    assert "sensors.range_ahead_m = 8.0 would fit" in note


def test_ranges_that_are_too_long_are_told_apart_from_a_displaced_device() -> None:
    table, limits = places(10.0), SensorLimits(range_above_m=1.0)
    (note,) = range_notes(ranges(table, 0.0, 5.0), UNITS, table, LINE, limits)
    assert "the ranges are 5.0 m too long against the satellites" in note
    both = list(range_notes(ranges(table, -6.0, -4.0), UNITS, table, LINE, limits))
    assert "6.0 m behind" in both[0]
    assert "4.0 m too short" in both[1]
    (note,) = range_notes(ranges(table, 0.0, 0.0), UNITS, table[:3], LINE, limits)
    assert "too few ranges" in note
