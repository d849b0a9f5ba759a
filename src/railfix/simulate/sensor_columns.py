"""Tables of all on-board sensors of a run, including the list of balises and the positions of ranging units."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
import polars as pl

from railfix.core.arrays import Floats
from railfix.core.timescale import timedelta
from railfix.simulate.body_sensors import inertial_table, pulse_table, slip_table
from railfix.simulate.errors import GaussMarkov
from railfix.simulate.settings import Balise, BaliseSettings, GroundUnit, RadarSettings, RangingSettings

if TYPE_CHECKING:
    from railfix.simulate.alignment import Alignment
    from railfix.simulate.signals import Simulation


_BALISE_NOISE, _MISSED, _WRONG = 44, 45, 46  #: Seeds of random streams: reading error, missed, wrong identity.
_STEP_S = 0.1  #: Spacing of the instants between which the passing of a balise is interpolated [s].


def balises_along(simulation: Simulation, settings: BaliseSettings) -> tuple[Balise, ...]:
    """Return the balises of the settings, and further balises at a spacing of `spacing_m`, in order of chainage."""
    length = float(simulation.line.point_chainage_m()[-1])
    spaced = np.arange(settings.spacing_m, length, settings.spacing_m) if settings.spacing_m else np.empty(0)
    drawn = [Balise(name=f"B{k + 1:03d}", chainage_m=at) for k, at in enumerate(spaced.tolist())]
    return tuple(sorted([*settings.balises, *drawn], key=lambda balise: balise.chainage_m))


def balise_list_table(simulation: Simulation, settings: BaliseSettings) -> pl.DataFrame:
    """Return the list of balises, with the columns `COLUMNS`."""
    balises, line = balises_along(simulation, settings), simulation.line
    at = np.array([balise.chainage_m for balise in balises], dtype=np.float64)
    mapped = np.interp(at, line.point_chainage_m(), line.track().chainage_m)
    return pl.DataFrame(
        {"balise": pl.Series([b.name for b in balises], dtype=pl.String), "chainage_m": mapped.round(3)}
    )


def balise_tables(simulation: Simulation, settings: BaliseSettings) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Return the readings, and the ground truth of all passings, with the columns `COLUMNS`.

    Errors, missed readings and wrong identities are drawn once per balise, so that they are the same at every passing
    of a balise.
    """
    scenario, balises = simulation.scenario, balises_along(simulation, settings)
    time = np.arange(0.0, scenario.duration_s + 1e-9, _STEP_S)
    reader = simulation.body_truth((settings.along_m, 0.0, 0.0), time)[0].chainage_m
    names = [balise.name for balise in balises]
    noise = np.random.default_rng([scenario.seed, _BALISE_NOISE]).standard_normal(len(balises)) * settings.noise_sigma_m
    missed = np.random.default_rng([scenario.seed, _MISSED]).uniform(size=len(balises)) < settings.missed_chance
    draws = np.random.default_rng([scenario.seed, _WRONG])
    chance, other = draws.uniform(size=len(balises)), draws.integers(0, max(len(balises) - 1, 1), len(balises))
    rows: list[tuple[float, float, str, str | None]] = []
    for k, balise in enumerate(balises):
        ahead = balise.chainage_m - reader
        for step in np.flatnonzero((ahead[:-1] > 0.0) != (ahead[1:] > 0.0)).tolist():
            speed = (reader[step + 1] - reader[step]) / _STEP_S
            at = float(time[step] + ahead[step] / speed)
            read: str | None = settings.wrong.get(balise.name, balise.name)
            if chance[k] < settings.wrong_chance and len(balises) > 1:
                read = names[other[k] + (other[k] >= k)]
            if missed[k] or balise.name in settings.missed:
                read = None
            rows.append((at, at + noise[k] / max(abs(speed), 1.0), balise.name, read))
    rows.sort()
    passed, heard = (scenario.start + timedelta(np.array([row[k] for row in rows], dtype=np.float64)) for k in (0, 1))
    truth = pl.DataFrame(
        {
            "time_gpst": pl.Series(passed, dtype=pl.Datetime("ns")),
            "balise": pl.Series([row[2] for row in rows], dtype=pl.String),
            "read": pl.Series([row[3] for row in rows], dtype=pl.String),
        }
    )
    readings = truth.with_columns(time_gpst=pl.Series(heard, dtype=pl.Datetime("ns"))).drop_nulls("read")
    return readings.select("time_gpst", balise="read").sort("time_gpst"), truth


_NOISE, _SWAY, _DROPOUTS = 26, 27, 28  #: Seeds of random streams: noise, sway, dropouts.


def radar_table(simulation: Simulation, settings: RadarSettings) -> pl.DataFrame:
    """Return the samples of the radar, with the columns `COLUMNS`."""
    scenario = simulation.scenario
    time = np.arange(int(scenario.duration_s * settings.rate_hz + 1e-9) + 1) / settings.rate_hz
    true = simulation.motion.at(time)[1]
    ratio: Floats | float = settings.scale
    if settings.sway_ratio_sigma > 0.0:
        sway = GaussMarkov(
            [(scenario.seed, _SWAY)],
            sigma=settings.sway_ratio_sigma,
            time_s=settings.sway_time_s,
            duration_s=scenario.duration_s,
        )
        ratio = ratio + sway.at(time)[:, 0]
    noise = np.random.default_rng([scenario.seed, _NOISE]).standard_normal(len(time))
    speed = true * (1.0 + ratio) + settings.bias_mps + settings.noise_sigma_mps * noise
    blind = (np.abs(true) < settings.lowest_mps) | (np.abs(true) > settings.highest_mps)
    for start, end in dropouts(settings, scenario.seed, scenario.duration_s):
        blind |= (time >= start) & (time < end)
    tag = scenario.start + timedelta(time)
    return pl.DataFrame({"time_gpst": tag, "speed_mps": np.where(blind, np.nan, speed)})


def dropouts(settings: RadarSettings, seed: int, duration_s: float) -> list[tuple[float, float]]:
    """Return the start and the end of each dropout [s]: first the dropouts of the settings, then random dropouts."""
    found = [(d.start_s, d.end_s) for d in settings.dropouts]
    if settings.dropouts_per_hour > 0.0:
        rng = np.random.default_rng([seed, _DROPOUTS])
        start = 0.0
        while True:
            gap, lasting = rng.exponential(size=2) * (3600.0 / settings.dropouts_per_hour, settings.dropout_duration_s)
            start += float(gap)
            if start >= duration_s:
                break
            found.append((start, start + float(lasting)))
    return found


#: Seeds of random streams: noise, multipath error, echoes, lost answers.
_RANGING_NOISE, _POSITION, _ECHO, _LOST = 40, 41, 42, 43


def unit_ecef_m(line: Alignment, unit: GroundUnit) -> Floats:
    """Return the position of a ground unit, shape (3,) ECEF [m]."""
    return np.asarray(line.point_beside(np.array([unit.chainage_m]), unit.lateral_m, unit.height_m)[0])


def unit_table(simulation: Simulation, settings: RangingSettings) -> pl.DataFrame:
    """Return the surveyed positions of the ground units, with the columns `COLUMNS`."""
    line = simulation.line
    place = np.array([unit_ecef_m(line, unit) for unit in settings.units]).reshape(-1, 3)
    chainage = np.array([unit.chainage_m for unit in settings.units])
    mapped = np.interp(chainage, line.point_chainage_m(), line.track().chainage_m)
    lateral = np.array([unit.lateral_m for unit in settings.units])
    names = [unit.name for unit in settings.units]
    columns = {"chainage_m": mapped, "lateral_m": lateral, **dict(zip(("x_m", "y_m", "z_m"), place.T, strict=True))}
    return pl.DataFrame({"unit": pl.Series(names, dtype=pl.String), **columns})


def ranging_table(simulation: Simulation, settings: RangingSettings) -> pl.DataFrame:
    """Return the measured ranges in order of time, with the columns `COLUMNS`."""
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
    """Return the errors of ranges at distances `ahead_m` along the line from a unit, shape (n,) [m].

    An error is the sum of white noise, a multipath error that is constant in cells of `multipath_cell_m`, and, in a
    fraction `echo_chance` of the cells, the excess path of an echo that is measured instead of the direct path.
    """
    reach = int(np.ceil(settings.reach_m / settings.multipath_cell_m)) + 1
    cell = np.clip(np.floor(ahead_m / settings.multipath_cell_m).astype(np.intp), -reach, reach) + reach
    position = np.random.default_rng([seed, _POSITION, number]).standard_normal(2 * reach + 1)
    chance, excess = np.random.default_rng([seed, _ECHO, number]).uniform(size=(2, 2 * reach + 1))
    echo = np.where(chance < settings.echo_chance, -settings.echo_delay_m * np.log1p(-excess), 0.0)
    noise = np.random.default_rng([seed, _RANGING_NOISE, number]).standard_normal(len(ahead_m))
    return settings.noise_sigma_m * noise + settings.multipath_sigma_m * position[cell] + echo[cell]


#: Columns of each table, with descriptions.
COLUMNS: Final[dict[str, dict[str, str]]] = {
    "tachometer": {
        "time_gpst": "instant of a pulse, GPS time",
        "pulse": "number of the pulse, from 1",
        "direction": "1 where the vehicle moves forward (rising chainage), -1 where it moves backward",
    },
    "wheel_slips": {
        "time_gpst": "ground truth: start of the slip or slide, GPS time",
        "end_gpst": "ground truth: end of the slip or slide, GPS time",
        "ratio": "ground truth: (wheel speed - train speed) / train speed in the middle of the interval, where its "
        "magnitude is largest; negative for a slide",
    },
    "inertial": {
        "time_gpst": "instant of the sample, GPS time",
        "force_forward_mps2": "specific force along the longitudinal axis of the body [m/s^2], positive forward",
        "force_right_mps2": "specific force along the lateral axis of the body [m/s^2], positive to the right",
        "force_down_mps2": "specific force along the vertical axis of the body [m/s^2], positive down; about -9.8 at "
        "rest",
        "roll_rate_radps": "angular rate about the forward axis [rad/s], positive when the body rolls to the right",
        "pitch_rate_radps": "angular rate about the right axis [rad/s], positive when the front rises",
        "yaw_rate_radps": "angular rate about the down axis [rad/s], positive when the front turns to the right",
    },
    "radar": {
        "time_gpst": "instant of the sample, GPS time",
        "speed_mps": "speed [m/s], positive forward; NaN where nothing was measured",
    },
    "ranging": {
        "time_gpst": "instant of the measurement, GPS time",
        "unit": "name of the ground unit",
        "range_m": "measured distance between the vehicle's unit and the ground unit [m]",
    },
    "ranging_units": {
        "unit": "name of the ground unit",
        "chainage_m": "surveyed chainage [m]",
        "lateral_m": "distance to the right of the track axis [m]",
        "x_m": "surveyed position, ECEF [m]",
        "y_m": "surveyed position, ECEF [m]",
        "z_m": "surveyed position, ECEF [m]",
    },
    "balises": {
        "time_gpst": "measured instant at which the reader was over a balise, GPS time",
        "balise": "identity that was read",
    },
    "balise_list": {"balise": "identity of the balise", "chainage_m": "surveyed chainage [m]"},
    "balise_truth": {
        "time_gpst": "ground truth: instant at which the reader was over a balise, GPS time",
        "balise": "ground truth: identity of the balise",
        "read": "identity that was read; empty where the balise was not read",
    },
}


def sensor_tables(simulation: Simulation) -> dict[str, pl.DataFrame]:
    """Return the tables of the simulated sensors by name; empty if `Scenario.sensors` is None.

    The tables are ``tachometer``, ``inertial``, ``radar``, ``ranging``, ``ranging_units``, ``balises`` and
    ``balise_list``, and two tables of ground truth, ``wheel_slips`` and ``balise_truth``. All tables have the columns
    `COLUMNS`; tables with times are in order of `time_gpst`.
    """
    settings = simulation.scenario.sensors
    tables: dict[str, pl.DataFrame] = {}
    if settings is None:
        return tables
    if settings.tachometer is not None:
        tables["tachometer"] = pulse_table(simulation, settings.tachometer)
        tables["wheel_slips"] = slip_table(simulation, settings.tachometer)
    if settings.inertial is not None:
        tables["inertial"] = inertial_table(simulation, settings.inertial)
    if settings.radar is not None:
        tables["radar"] = radar_table(simulation, settings.radar)
    if settings.ranging is not None:
        tables["ranging"] = ranging_table(simulation, settings.ranging)
        tables["ranging_units"] = unit_table(simulation, settings.ranging)
    if settings.balises is not None:
        tables["balises"], tables["balise_truth"] = balise_tables(simulation, settings.balises)
        tables["balise_list"] = balise_list_table(simulation, settings.balises)
    return tables
