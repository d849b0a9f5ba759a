# The names of `railfix.pipeline`, imported at their first use (lazy-loader).

from .base_station_stage import Stations
from .config import Config, load_config
from .processor import EpochProcessor
from .processor_state import AntennaState, State
from .range_stage import Models
from .result_tables import observations_table, positions_table, to_xarray, train_table
from .results import AntennaResult, Result

__all__ = [
    "AntennaResult",
    "AntennaState",
    "Config",
    "EpochProcessor",
    "Models",
    "Result",
    "State",
    "Stations",
    "load_config",
    "observations_table",
    "positions_table",
    "to_xarray",
    "train_table",
]
