"""Positions of a log or stream, epoch by epoch: settings, processor, results."""

from railfix.pipeline.config import Config, load_config
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.results import AntennaResult, AntennaState, Result, State
from railfix.pipeline.tables import observations_table, positions_table, to_xarray

__all__ = [
    "AntennaResult",
    "AntennaState",
    "Config",
    "EpochProcessor",
    "Result",
    "State",
    "load_config",
    "observations_table",
    "positions_table",
    "to_xarray",
]
