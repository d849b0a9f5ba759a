"""One file a screen: its limits, its function, what it says.

A screen measures something in physical units and says which observations fail. It never puts an
observation back that another one refused, and it never acts: the pipeline does.
"""

from __future__ import annotations

from railfix.screens.elevation import ElevationLimits, elevation_screen
from railfix.screens.result import Screened

__all__ = ["ElevationLimits", "Screened", "elevation_screen"]
