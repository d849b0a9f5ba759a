"""Screens: one file each, with its limits, metric, verdict, reason, columns and picture.

A screen measures one quantity in physical units and returns which observations fail. It never re-admits an observation
that another screen rejected; it returns verdicts, which the pipeline applies. `SCREENS` lists them.
"""

from __future__ import annotations

from railfix.ranges.corrected import AntennaRanges
from railfix.screens.antenna_pair import (
    AntennaPairLimits,
    AntennaPairScreened,
    Spacing,
    TagDifference,
    ambiguity_m,
    antenna_pair_screen,
    expected_difference_m,
    spacing_direction,
)
from railfix.screens.antenna_spacing import AntennaSpacingLimits, antenna_spacing_screen
from railfix.screens.base import (
    ObservationScreen,
    RunTables,
    Screen,
    ScreenColumn,
    Screened,
    ScreenPicture,
    ScreenSetup,
    Verdict,
    suspicion_sigma_m,
)
from railfix.screens.cn0 import Cn0Limits, Cn0Screened, cn0_screen
from railfix.screens.doppler import (
    DopplerChannels,
    DopplerLimits,
    DopplerScreened,
    DopplerState,
    doppler_limit_m,
    doppler_screen,
)
from railfix.screens.elevation import ElevationLimits, elevation_screen
from railfix.screens.pairs import FilteredMotion, PairedEpochs, PairScreen, PositionScreen, pair_channels, pair_epochs
from railfix.screens.registry import SCREENS, in_order

__all__ = [
    "SCREENS",
    "AntennaPairLimits",
    "AntennaPairScreened",
    "AntennaRanges",
    "AntennaSpacingLimits",
    "Cn0Limits",
    "Cn0Screened",
    "DopplerChannels",
    "DopplerLimits",
    "DopplerScreened",
    "DopplerState",
    "ElevationLimits",
    "FilteredMotion",
    "ObservationScreen",
    "PairScreen",
    "PairedEpochs",
    "PositionScreen",
    "RunTables",
    "Screen",
    "ScreenColumn",
    "ScreenPicture",
    "ScreenSetup",
    "Screened",
    "Spacing",
    "TagDifference",
    "Verdict",
    "ambiguity_m",
    "antenna_pair_screen",
    "antenna_spacing_screen",
    "cn0_screen",
    "doppler_limit_m",
    "doppler_screen",
    "elevation_screen",
    "expected_difference_m",
    "in_order",
    "pair_channels",
    "pair_epochs",
    "spacing_direction",
    "suspicion_sigma_m",
]
