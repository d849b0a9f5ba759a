"""Readers and writers: files and bytes to arrays, and back."""

from railfix.io.georinex_layout import (
    navigation_from_xarray,
    navigation_to_xarray,
    observations_from_xarray,
    observations_to_xarray,
)
from railfix.io.logs import read_navigation, read_observations, scan_observations
from railfix.io.nmea import read_any_positions, read_nmea
from railfix.io.position_log import PositionLog, read_positions
from railfix.io.reference_log import AntennaReference, read_reference, write_reference
from railfix.io.rinex import write_navigation, write_observations
from railfix.io.sp3 import read_sp3

__all__ = [
    "AntennaReference",
    "PositionLog",
    "navigation_from_xarray",
    "navigation_to_xarray",
    "observations_from_xarray",
    "observations_to_xarray",
    "read_any_positions",
    "read_navigation",
    "read_nmea",
    "read_observations",
    "read_positions",
    "read_reference",
    "read_sp3",
    "scan_observations",
    "write_navigation",
    "write_observations",
    "write_reference",
]
