# The names of `railfix.pipeline`, imported at their first use (lazy-loader).

from .base_station import Stations
from .config import Config, load_config
from .processor import EpochProcessor
from .range_stage import Models
from .results import AntennaResult, Result
from .state import AntennaState, State
from .tables import observations_table, positions_table, to_xarray, train_table

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
