# The names of `railfix.ground`, imported at their first use (lazy-loader).

from .centre import CentreLimits, ReferenceCurve, TrainRecord, TrainState, report_received, time_passed
from .interlocking import (
    Interlocking,
    InterlockingLimits,
    PointState,
    TrainInterval,
    extend_authorities,
    release_points,
    route_requested,
)
from .layout import Layout, LoopStation
from .station_fixes import StationFixes, station_fixes
from .supervision import Supervision
from .train import Authority, OnBoard, OnBoardLimits
from .triangle import (
    MonitorLimits,
    MonitorState,
    TriangleLimits,
    TriangleResult,
    TriangleVerdict,
    advance,
    compare_triangle,
    limits_for_false_stops,
    release,
)

__all__ = [
    "Authority",
    "CentreLimits",
    "Interlocking",
    "InterlockingLimits",
    "Layout",
    "LoopStation",
    "MonitorLimits",
    "MonitorState",
    "OnBoard",
    "OnBoardLimits",
    "PointState",
    "ReferenceCurve",
    "StationFixes",
    "Supervision",
    "TrainInterval",
    "TrainRecord",
    "TrainState",
    "TriangleLimits",
    "TriangleResult",
    "TriangleVerdict",
    "advance",
    "compare_triangle",
    "extend_authorities",
    "limits_for_false_stops",
    "release",
    "release_points",
    "report_received",
    "route_requested",
    "station_fixes",
    "time_passed",
]
