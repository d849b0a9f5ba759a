# Names of `railfix.simulate`, which lazy-loader imports at their first use.

from .alignment import Alignment, build_alignment
from .constellation import simulate_navigation
from .demonstration import DEMO_FILES, demo, demo_files, demo_folder
from .environment.settings import Disturbance, Disturbances, SightGeometry
from .line_file import Element, GeneratedLine, Gradient, LineFile, LineSettings, MapError, Terrain
from .motion import AntennaTruth, Motion, antenna_truth, build_motion, run_curve, shuttle
from .run import section_table, truth_table, write_run
from .scenario import (
    ANTENNAS,
    ReceiverSettings,
    RunSettings,
    Scenario,
    SkySettings,
    SpeedLimit,
    Station,
    VehicleSettings,
)
from .scenario_file import Recipe, list_scenarios, load_recipe, load_scenario, scenario_table
from .sensor_columns import sensor_tables
from .settings import ErrorSettings, SensorSettings
from .signals import Piece, Simulation

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
    "demo",
    "demo_files",
    "demo_folder",
    "list_scenarios",
    "load_recipe",
    "load_scenario",
    "run_curve",
    "scenario_table",
    "section_table",
    "sensor_tables",
    "shuttle",
    "simulate_navigation",
    "truth_table",
    "write_run",
]
