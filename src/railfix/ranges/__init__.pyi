# The names of `railfix.ranges`, imported at their first use (lazy-loader).

from .base_station import BaseErrors, BaseLimits, BaseStationSource
from .channels import DEFAULT_SIGNALS, SECOND_SIGNALS, Channels, select_channels
from .cn0_curve import Cn0Curve
from .corrected import (
    AntennaRanges,
    CorrectedRanges,
    SatelliteRanges,
    SecondCodes,
    corrected_ranges,
    find_satellites,
)
from .range_sigma import CodeNoise, NominalErrors, code_sigma_m
from .sbas.sbas_sources import DfmcSource, SbasSource
from .second_codes import find_second_codes
from .sources import BroadcastSource, CorrectionSource, SourceDelays, SourceSatellites

__all__ = [
    "DEFAULT_SIGNALS",
    "SECOND_SIGNALS",
    "AntennaRanges",
    "BaseErrors",
    "BaseLimits",
    "BaseStationSource",
    "BroadcastSource",
    "Channels",
    "Cn0Curve",
    "CodeNoise",
    "CorrectedRanges",
    "CorrectionSource",
    "DfmcSource",
    "NominalErrors",
    "SatelliteRanges",
    "SbasSource",
    "SecondCodes",
    "SourceDelays",
    "SourceSatellites",
    "code_sigma_m",
    "corrected_ranges",
    "find_satellites",
    "find_second_codes",
    "select_channels",
]
