# The names of `railfix.io.rinex`, imported at their first use (lazy-loader).

from .navigation import read_navigation
from .navigation_writer import write_navigation
from .observations import scan_observations
from .write import write_observations

__all__ = ["read_navigation", "scan_observations", "write_navigation", "write_observations"]
