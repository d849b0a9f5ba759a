"""Two-way ranges between a unit on the vehicle and units beside the track (P2, 3.3 and table 3)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from railfix.core.arrays import Floats
from railfix.core.timescale import timedelta
from railfix.simulate.sensors.settings import GroundUnit, RangingSettings

if TYPE_CHECKING:
    from railfix.simulate.alignment import Alignment
    from railfix.simulate.signals import Simulation

#: Streams of random numbers: noise, error by position, echoes, lost answers.
_NOISE, _POSITION, _ECHO, _LOST = 40, 41, 42, 43


def unit_ecef_m(line: Alignment, unit: GroundUnit) -> Floats:
    """Position of a ground unit, shape (3,) ECEF [m]."""
    return np.asarray(line.point_beside(np.array([unit.chainage_m]), unit.lateral_m, unit.height_m)[0])


def unit_table(simulation: Simulation, settings: RangingSettings) -> pl.DataFrame:
    """Surveyed positions of the ground units, see `railfix.simulate.sensors.tables.COLUMNS`."""
    line = simulation.line
    place = np.array([unit_ecef_m(line, unit) for unit in settings.units]).reshape(-1, 3)
    chainage = np.array([unit.chainage_m for unit in settings.units])
    mapped = np.interp(chainage, line.sampled_chainage_m(), line.track().chainage_m)
    lateral = np.array([unit.lateral_m for unit in settings.units])
    names = [unit.name for unit in settings.units]
    columns = {"chainage_m": mapped, "lateral_m": lateral, "x_m": place[:, 0], "y_m": place[:, 1], "z_m": place[:, 2]}
    return pl.DataFrame({"unit": pl.Series(names, dtype=pl.String), **columns})


def ranging_table(simulation: Simulation, settings: RangingSettings) -> pl.DataFrame:
    """Measured ranges in order of time, see `railfix.simulate.sensors.tables.COLUMNS`."""
    scenario = simulation.scenario
    time = np.arange(0.0, scenario.duration_s + 1e-9, settings.interval_s)
    offset = (settings.along_m, settings.across_m, settings.up_m)
    vehicle, _ = simulation.body_truth(offset, time)
    tag = scenario.start + timedelta(time)
    schema = pl.Schema({"time_gpst": pl.Datetime("ns"), "unit": pl.String(), "range_m": pl.Float64()})
    tables = [pl.DataFrame(schema=schema)]
    for number, unit in enumerate(settings.units):
        distance = np.linalg.norm(vehicle.ecef_m - unit_ecef_m(simulation.line, unit), axis=1)
        error = _range_errors_m(settings, scenario.seed, number, vehicle.chainage_m - unit.chainage_m)
        lost = np.random.default_rng([scenario.seed, _LOST, number]).uniform(size=len(time)) < settings.lost_chance
        answered = np.flatnonzero((distance <= settings.reach_m) & ~lost)
        measured = distance + unit.delay_bias_m + error
        columns = {"time_gpst": tag[answered], "unit": [unit.name] * len(answered), "range_m": measured[answered]}
        tables.append(pl.DataFrame(columns, schema=schema))
    return pl.concat(tables).sort("time_gpst", "unit")


def _range_errors_m(settings: RangingSettings, seed: int, number: int, ahead_m: Floats) -> Floats:
    """Noise, and multipath that depends on the position alone: it stays while the train stands.

    Positions are cells of `multipath_cell_m` along the line; each has its own error and, with the probability
    `echo_chance`, a stronger echo that hides the direct path and is later by an exponential excess.
    """
    reach = int(np.ceil(settings.reach_m / settings.multipath_cell_m)) + 1
    cell = np.clip(np.floor(ahead_m / settings.multipath_cell_m).astype(np.intp), -reach, reach) + reach
    position = np.random.default_rng([seed, _POSITION, number]).standard_normal(2 * reach + 1)
    chance, excess = np.random.default_rng([seed, _ECHO, number]).uniform(size=(2, 2 * reach + 1))
    echo = np.where(chance < settings.echo_chance, -settings.echo_delay_m * np.log1p(-excess), 0.0)
    noise = np.random.default_rng([seed, _NOISE, number]).standard_normal(len(ahead_m))
    return settings.noise_sigma_m * noise + settings.multipath_sigma_m * position[cell] + echo[cell]
