# The names of `railfix.screens`, imported at their first use (lazy-loader).

from .antenna_pair import (
    AntennaPairLimits,
    AntennaPairScreened,
    Spacing,
    TagDifference,
    ambiguity_m,
    antenna_pair_screen,
    expected_difference_m,
    spacing_direction,
)
from .antenna_spacing import AntennaSpacingLimits, antenna_spacing_screen
from .base import (
    AntennaRanges,
    ObservationScreen,
    OpenSkyCn0,
    RunTables,
    Screen,
    ScreenColumn,
    Screened,
    ScreenPicture,
    ScreenSetup,
    Verdict,
)
from .cn0 import Cn0Limits, Cn0Screened, cn0_screen
from .doppler import (
    DopplerChannels,
    DopplerLimits,
    DopplerScreened,
    DopplerState,
    doppler_limit_m,
    doppler_screen,
)
from .elevation import ElevationLimits, elevation_screen
from .pairs import FilteredMotion, PairedEpochs, PairScreen, PositionScreen, pair_channels, pair_epochs
from .registry import SCREENS, in_order
from .suspicion import suspicion_sigma_m

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
    "OpenSkyCn0",
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
