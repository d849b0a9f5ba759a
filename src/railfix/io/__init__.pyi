# The names of `railfix.io`, imported at their first use (lazy-loader).

from .georinex_layout import (
    observations_from_xarray,
    observations_to_xarray,
)
from .logs import read_navigation, read_observations, scan_observations
from .nmea import read_nmea
from .position_log import PositionLog
from .positions import read_positions
from .reference_log import AntennaReference, read_reference
from .rinex import write_navigation, write_observations
from .sp3 import read_sp3

__all__ = [
    "AntennaReference",
    "PositionLog",
    "observations_from_xarray",
    "observations_to_xarray",
    "read_navigation",
    "read_nmea",
    "read_observations",
    "read_positions",
    "read_reference",
    "read_sp3",
    "scan_observations",
    "write_navigation",
    "write_observations",
]
