"""Runs that never happened, with their truth: RINEX logs of two antennas on a made line under a made sky.

`Scenario` holds every choice, `load_scenario` reads one from TOML, `write_run` makes the files,
`Simulation` gives the arrays piece by piece. The same scenario gives the same numbers.
``railfix simulate`` is the same from the command line.

The orbits, the delays and the rigid body are computed here apart from the rooms that the estimators
use, by the same published formulas, so that an error in either shows as a position that is off.
"""

from railfix.simulate.alignment import Alignment, made_alignment
from railfix.simulate.body import AntennaTruth, antenna_truth
from railfix.simulate.constellation import made_navigation
from railfix.simulate.demo_data import DEMO_FILES, demo_files, demo_folder
from railfix.simulate.disturbance import Disturbance, Disturbances, Geometry
from railfix.simulate.errors import ErrorSettings
from railfix.simulate.line_settings import (
    Element,
    GeneratedLine,
    Gradient,
    LineFile,
    LineSettings,
    MapError,
    Terrain,
)
from railfix.simulate.motion import Motion, made_motion, run_curve, shuttle
from railfix.simulate.run import section_table, truth_table, write_run
from railfix.simulate.scenario import (
    ANTENNAS,
    ReceiverSettings,
    RunSettings,
    Scenario,
    SkySettings,
    SpeedLimit,
    Station,
    VehicleSettings,
)
from railfix.simulate.scenario_file import Recipe, load_recipe, load_scenario, scenario_table, shipped_scenarios
from railfix.simulate.sensors import SensorSettings
from railfix.simulate.sensors.tables import sensor_tables
from railfix.simulate.signals import Piece, Simulation

__all__ = [
    "ANTENNAS",
    "DEMO_FILES",
    "Alignment",
    "AntennaTruth",
    "Disturbance",
    "Disturbances",
    "Element",
    "ErrorSettings",
    "GeneratedLine",
    "Geometry",
    "Gradient",
    "LineFile",
    "LineSettings",
    "MapError",
    "Motion",
    "Piece",
    "ReceiverSettings",
    "Recipe",
    "RunSettings",
    "Scenario",
    "SensorSettings",
    "Simulation",
    "SkySettings",
    "SpeedLimit",
    "Station",
    "Terrain",
    "VehicleSettings",
    "antenna_truth",
    "demo_files",
    "demo_folder",
    "load_recipe",
    "load_scenario",
    "made_alignment",
    "made_motion",
    "made_navigation",
    "run_curve",
    "scenario_table",
    "section_table",
    "sensor_tables",
    "shipped_scenarios",
    "shuttle",
    "truth_table",
    "write_run",
]
