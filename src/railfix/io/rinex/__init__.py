"""Readers and writers of RINEX observation and navigation files."""

from railfix.io.rinex.navigation import read_navigation
from railfix.io.rinex.observations import read_observations, scan_observations
from railfix.io.rinex.write import write_observations
from railfix.io.rinex.write_navigation import write_navigation

__all__ = ["read_navigation", "read_observations", "scan_observations", "write_navigation", "write_observations"]
