# The names of `railfix.tracking`, imported at their first use (lazy-loader).

from .epochs import BaliseEpochs, GnssEpochs, Kind, RangeEpochs, SensorEpochs
from .filter import Step, track
from .limits import TrackingLimits
from .line import Line
from .result import Tracked, TrackStatus
from .smoother import BackwardInformation, Smoothed, smooth_steps
from .state import TrackState

__all__ = [
    "BackwardInformation",
    "BaliseEpochs",
    "GnssEpochs",
    "Kind",
    "Line",
    "RangeEpochs",
    "SensorEpochs",
    "Smoothed",
    "Step",
    "TrackState",
    "TrackStatus",
    "Tracked",
    "TrackingLimits",
    "smooth_steps",
    "track",
]
