"""One file a screen: its limits, its function, what it says.

A screen measures something in physical units and says which observations fail. It never puts an
observation back that another one refused, and it never acts: the pipeline does.
"""

from __future__ import annotations

from railfix.screens.antenna_pair import (
    AntennaPairLimits,
    AntennaPairScreened,
    ambiguity_m,
    antenna_pair_screen,
    expected_difference_m,
    on_channels,
    pair_channels,
    pair_epochs,
    spacing_direction,
)
from railfix.screens.antenna_spacing import AntennaSpacingLimits, antenna_spacing_screen
from railfix.screens.cn0 import Cn0Limits, Cn0Screened, cn0_screen
from railfix.screens.doppler import DopplerScreened, DopplerState, doppler_screen
from railfix.screens.doppler_limits import DopplerLimits, doppler_limit_m
from railfix.screens.elevation import ElevationLimits, elevation_screen
from railfix.screens.result import Screened, suspicion_sigma_m

__all__ = [
    "AntennaPairLimits",
    "AntennaPairScreened",
    "AntennaSpacingLimits",
    "Cn0Limits",
    "Cn0Screened",
    "DopplerLimits",
    "DopplerScreened",
    "DopplerState",
    "ElevationLimits",
    "Screened",
    "ambiguity_m",
    "antenna_pair_screen",
    "antenna_spacing_screen",
    "cn0_screen",
    "doppler_limit_m",
    "doppler_screen",
    "elevation_screen",
    "expected_difference_m",
    "on_channels",
    "pair_channels",
    "pair_epochs",
    "spacing_direction",
    "suspicion_sigma_m",
]
