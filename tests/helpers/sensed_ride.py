"""A simulated ride with sensors on board through the filter, in memory: what tests and tables of the sensors share."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from railfix.core.settings_files import write_toml
from railfix.core.timescale import seconds
from railfix.gnss.observations import Observations
from railfix.motion.samples import GroundUnits, ListedBalises, SensorSamples
from railfix.pipeline.config import parse_config
from railfix.pipeline.filter_result import AlongTrack
from railfix.pipeline.processor_state import State
from railfix.run.processor_setup import make_processor
from railfix.run.sensors import read_listed_balises, read_sensors, read_units
from railfix.simulate import Scenario, Simulation
from railfix.simulate.run import vehicle_table
from railfix.simulate.scenario_file import load_recipe
from railfix.simulate.sensor_columns import sensor_tables
from railfix.track import Track
from railfix.track.vehicle import antenna_trajectory, read_vehicle

#: The inertial unit of `commercial-run`.
UNIT: dict[str, Any] = {
    "accel_bias_mps2": [0.02, -0.01, 0.03],
    "gyro_bias_radps": [1e-5, -2e-5, 1e-5],
    "accel_drift_sigma_mps2": 0.002,
    "gyro_drift_sigma_radps": 1e-5,
    "velocity_walk_mps_per_sqrt_s": 0.001,
    "angle_walk_rad_per_sqrt_s": 5e-5,
}


#: Tables of the simulator that are no samples.
_NO_SAMPLES = ("wheel_slips", "balise_truth", "balise_list")


@dataclass(frozen=True)
class Ride:
    """One antenna's log with the samples of the sensors and the ground truth.

    `along` is the cosine of the angle between each satellite and the track toward its end.
    """

    simulation: Simulation
    observations: Observations
    samples: SensorSamples
    units: GroundUnits | None
    balises: ListedBalises | None
    chainage_m: np.ndarray
    speed_mps: np.ndarray
    along: np.ndarray

    @property
    def time_s(self) -> np.ndarray:
        """Seconds since the start."""
        return seconds(self.observations.time - self.observations.time[0])

    def run(
        self,
        *,
        observations: Observations | None = None,
        samples: SensorSamples | None = None,
        cuts: Sequence[int] = (),
        track: Track | None = None,
        balises: ListedBalises | None = None,
        **settings: object,
    ) -> AlongTrack:
        """Through the filter on a map (of the whole line without one), in chunks that end at `cuts`."""
        track = track or self.simulation.line.track()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "vehicle.toml"
            write_toml(path, vehicle_table(self.simulation.scenario.vehicle))
            trajectories = {"front": antenna_trajectory(track, read_vehicle(path), "front")}
        config = parse_config({"filter": "track", "protection": "off", **settings})
        processor = make_processor(
            config,
            self.simulation.navigation,
            trajectories,
            track=track,
            units=self.units,
            balises=balises or self.balises,
        )
        whole = self.observations if observations is None else observations
        samples = self.samples if samples is None else samples
        state, received = State(), np.datetime64("NaT", "ns")
        parts: list[AlongTrack] = []
        for first, last in zip([0, *cuts], [*cuts, len(whole)], strict=True):
            chunk = whole[first:last]
            end = chunk.time[-1]
            result, state = processor.process({"front": chunk}, state, sensors=samples.between(received, end))
            received = end
            parts.append(result.fusion["front"])
        return replace(joined(parts), passings=tuple(p for part in parts for p in part.passings))

    def jumped(self, begin_s: float, end_s: float, metres: float) -> Observations:
        """The observations with codes as of a place further along the line for some time."""
        shift = np.where((self.time_s >= begin_s) & (self.time_s < end_s), metres, 0.0)
        return replace(self.observations, code_m=self.observations.code_m - shift[:, None] * self.along)

    def error_m(self, found: AlongTrack) -> np.ndarray:
        """Along the line."""
        return found.chainage_m - self.chainage_m


def joined(parts: Iterable[Any]) -> Any:
    """Chunks of one result one after the other."""
    parts = list(parts)
    values = {}
    for name in (f.name for f in fields(parts[0])):  # not what is computed from them
        value = getattr(parts[0], name)
        if isinstance(value, np.ndarray):
            values[name] = np.concatenate([getattr(p, name) for p in parts])
        elif name in ("tracked", "sensed"):
            values[name] = joined(getattr(p, name) for p in parts)
    return replace(parts[0], **values)


@cache
def ride(text: str = "{}", name: str = "demo") -> Ride:
    """The ride of a scenario with changes, written as a dict literal so that rides are made once."""
    changes = eval(text, {"UNIT": UNIT})
    return made(load_recipe(name).scenario().replaced(**changes))


def sensors_of(simulation: Simulation) -> tuple[SensorSamples, GroundUnits | None]:
    """Samples of the sensors of a run, and its ground units."""
    tables = sensor_tables(simulation)
    with tempfile.TemporaryDirectory() as folder:
        paths = {n: Path(folder) / f"{n}.parquet" for n in tables if n not in _NO_SAMPLES}
        for n, path in paths.items():
            tables[n].write_parquet(path)
        units = read_units(paths.pop("ranging_units")) if "ranging_units" in paths else None
        return read_sensors(**paths), units


def balises_of(simulation: Simulation) -> ListedBalises | None:
    """The list of balises of a run."""
    table = sensor_tables(simulation).get("balise_list")
    if table is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "list.csv"
        table.write_csv(path)
        return read_listed_balises(path, simulation.line.track())


def made(scenario: Scenario) -> Ride:
    """The ride of a scenario: its front antenna."""
    simulation = Simulation(scenario)
    pieces = list(simulation.pieces("front", chunk_epochs=100_000))
    assert len(pieces) == 1
    samples, units = sensors_of(simulation)
    line, geometry = simulation.line, pieces[0].geometry
    return Ride(
        simulation=simulation,
        observations=pieces[0].observations,
        samples=samples,
        units=units,
        balises=balises_of(simulation),
        chainage_m=np.interp(geometry.chainage_m, line.point_chainage_m(), line.track().chainage_m),
        speed_mps=geometry.speed_mps,
        along=np.cos(np.radians(geometry.elevation_deg))
        * np.cos(np.radians(geometry.azimuth_deg - geometry.heading_deg[:, None])),
    )
