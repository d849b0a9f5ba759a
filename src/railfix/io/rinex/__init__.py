"""Readers of RINEX files, and what they are stored in."""

from railfix.io.rinex.navigation import read_navigation
from railfix.io.rinex.observations import read_observations, scan_observations

__all__ = ["read_navigation", "read_observations", "scan_observations"]
