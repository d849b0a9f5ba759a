"""Registry of the screens: one line each, in the order in which they judge."""

from __future__ import annotations

from typing import Any, Final

from railfix.screens.antenna_pair import AntennaPairScreen
from railfix.screens.antenna_spacing import AntennaSpacingScreen
from railfix.screens.base import Screen
from railfix.screens.cn0 import Cn0Screen
from railfix.screens.doppler import DopplerScreen
from railfix.screens.elevation import ElevationScreen
from railfix.screens.raim import RaimScreen

#: All screens. First those of single antennas, in this order, then those of two, RAIM, and those of positions.
SCREENS: Final[tuple[Screen[Any], ...]] = (
    ElevationScreen(),
    Cn0Screen(),
    DopplerScreen(),
    AntennaPairScreen(),
    RaimScreen(),
    AntennaSpacingScreen(),
)
