"""Readers of RINEX files, and what they are stored in."""

from railfix.rinex.observations import read_observations, scan_observations

__all__ = ["read_observations", "scan_observations"]
