"""Simulated runs with ground truth: RINEX logs of two antennas of a train on a given or generated line.

`Scenario` holds all settings, `load_scenario` reads one from TOML, `write_run` writes the files,
`Simulation` gives the arrays in chunks. The same scenario gives the same numbers.
``railfix simulate`` is the same from the command line.

Atmospheric delays and the rigid body are computed here independently of the packages that the estimators
use, by the same published formulas, so that an error in either shows as a position error.
"""

from railfix.simulate.alignment import Alignment, build_alignment
from railfix.simulate.constellation import simulated_navigation
from railfix.simulate.demonstration import DEMO_FILES, demo_files, demo_folder
from railfix.simulate.environment.settings import Disturbance, Disturbances, SightGeometry
from railfix.simulate.line_file import Element, GeneratedLine, Gradient, LineFile, LineSettings, MapError, Terrain
from railfix.simulate.motion import AntennaTruth, Motion, antenna_truth, build_motion, run_curve, shuttle
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
from railfix.simulate.sensor_tables import sensor_tables
from railfix.simulate.settings import ErrorSettings, SensorSettings
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
    "SightGeometry",
    "Simulation",
    "SkySettings",
    "SpeedLimit",
    "Station",
    "Terrain",
    "VehicleSettings",
    "antenna_truth",
    "build_alignment",
    "build_motion",
    "demo_files",
    "demo_folder",
    "load_recipe",
    "load_scenario",
    "run_curve",
    "scenario_table",
    "section_table",
    "sensor_tables",
    "shipped_scenarios",
    "shuttle",
    "simulated_navigation",
    "truth_table",
    "write_run",
]
