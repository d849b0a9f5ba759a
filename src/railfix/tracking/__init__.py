"""One filter along the track: codes, Dopplers, carrier phases and sensors, hypotheses over branches.

Plain functions over arrays: `track` takes epochs and the state left by earlier ones and returns places along the
trajectory and the new state.
"""

from __future__ import annotations

from railfix.tracking.epochs import GnssEpochs, RangeEpochs, SensorEpochs
from railfix.tracking.filter import track
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.result import Tracked, TrackStatus
from railfix.tracking.rows import Kind
from railfix.tracking.smoother import Later, Smoothed, Step, smoothed
from railfix.tracking.state import TrackState

__all__ = [
    "GnssEpochs",
    "Kind",
    "Later",
    "Line",
    "RangeEpochs",
    "SensorEpochs",
    "Smoothed",
    "Step",
    "TrackState",
    "TrackStatus",
    "Tracked",
    "TrackingLimits",
    "smoothed",
    "track",
]
