# The names of `railfix.motion`, imported at their first use (lazy-loader).

from .features import Feature, LineSeries, LocatedFeature, line_series, locate, map_features
from .samples import (
    InertialSamples,
    RadarSpeeds,
    SensorSamples,
    StationRanges,
    TachometerPulses,
    radar_speed_mps,
    two_way_range_m,
)
from .slip import MotionState, SlipLimits, SlipResult, find_slips
from .tachometer import (
    PulseSpeeds,
    SpeedCheck,
    TachometerLimits,
    check_speeds,
    distance_m,
    pulse_acceleration,
    pulse_speeds,
    tooth_faults,
)

__all__ = [
    "Feature",
    "InertialSamples",
    "LineSeries",
    "LocatedFeature",
    "MotionState",
    "PulseSpeeds",
    "RadarSpeeds",
    "SensorSamples",
    "SlipLimits",
    "SlipResult",
    "SpeedCheck",
    "StationRanges",
    "TachometerLimits",
    "TachometerPulses",
    "check_speeds",
    "distance_m",
    "find_slips",
    "line_series",
    "locate",
    "map_features",
    "pulse_acceleration",
    "pulse_speeds",
    "radar_speed_mps",
    "tooth_faults",
    "two_way_range_m",
]
