"""All sensors of a run as tables, from the same motion, line and body as the antennas."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import polars as pl

from railfix.simulate.sensors.balises import balise_list_table, balise_tables
from railfix.simulate.sensors.inertial import inertial_table
from railfix.simulate.sensors.radar import radar_table
from railfix.simulate.sensors.ranging import ranging_table, unit_table
from railfix.simulate.sensors.wheel import pulse_table, slip_table

if TYPE_CHECKING:
    from railfix.simulate.signals import Simulation

#: Columns of each table.
COLUMNS: Final[dict[str, dict[str, str]]] = {
    "tachometer": {
        "time_gpst": "instant of a pulse, GPS time",
        "pulse": "number of the pulse, from 1",
        "direction": "1 when the vehicle moves forward (rising chainage), -1 back",
    },
    "wheel_slips": {
        "time_gpst": "ground truth: when the wheel begins to slip or slide, GPS time",
        "end_gpst": "ground truth: when it rolls again",
        "ratio": "ground truth: most of (wheel speed - train speed) / train speed, in the middle; negative slides",
    },
    "inertial": {
        "time_gpst": "instant of the sample, GPS time",
        "force_forward_mps2": "specific force along the body's long axis [m/s^2], forward positive",
        "force_right_mps2": "specific force across the body [m/s^2], to the right positive",
        "force_down_mps2": "specific force square to the body's floor [m/s^2], down positive: about -9.8 at rest",
        "roll_rate_radps": "angular rate about forward [rad/s], positive when the body leans more to the right",
        "pitch_rate_radps": "angular rate about right [rad/s], positive when the nose rises",
        "yaw_rate_radps": "angular rate about down [rad/s], positive when the nose turns to the right",
    },
    "radar": {
        "time_gpst": "instant of the sample, GPS time",
        "speed_mps": "speed [m/s], forward positive; NaN where nothing was measured",
    },
    "ranging": {
        "time_gpst": "instant of the measurement, GPS time",
        "unit": "ground unit",
        "range_m": "measured distance between the vehicle's unit and the ground unit [m]",
    },
    "ranging_units": {
        "unit": "ground unit",
        "chainage_m": "surveyed chainage [m]",
        "lateral_m": "to the right of the track's axis [m]",
        "x_m": "surveyed position, ECEF [m]",
        "y_m": "surveyed position, ECEF [m]",
        "z_m": "surveyed position, ECEF [m]",
    },
    "balises": {"time_gpst": "instant at which the reader was over a balise, GPS time", "balise": "identity read"},
    "balise_list": {"balise": "identity", "chainage_m": "surveyed chainage [m]"},
    "balise_truth": {
        "time_gpst": "ground truth: instant at which the reader was over a balise, GPS time",
        "balise": "ground truth: the balise there",
        "read": "identity that was read; empty where none was",
    },
}


def sensor_tables(simulation: Simulation) -> dict[str, pl.DataFrame]:
    """Tables of the sensors that `Scenario.sensors` names; none where it is None.

    ``tachometer`` and ``wheel_slips`` (ground truth of its wheel), ``inertial``, ``radar``, ``ranging``
    and ``ranging_units``, ``balises``, ``balise_list`` and ``balise_truth`` (ground truth); the columns are those of
    `COLUMNS`, all rows in order of `time_gpst`.
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
