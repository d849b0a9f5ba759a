# The names of `railfix.ground`, imported at their first use (lazy-loader).

from .authority import Authority, BrakeOrder
from .braking import BrakeLimits, Supervised, supervise
from .centre import CentreLimits, ReferenceCurve, TrainRecord, TrainState, report_received, time_passed
from .fixes_at_stations import StationFixes, station_fixes
from .interlocking import extend_authorities, release_points, route_requested
from .layout import Gradient, Layout, LoopStation
from .on_board import OnBoard, OnBoardLimits
from .state import Interlocking, InterlockingLimits, PointState, Restriction, TrainInterval
from .supervision import Supervision
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
    "BrakeLimits",
    "BrakeOrder",
    "CentreLimits",
    "Gradient",
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
    "Restriction",
    "StationFixes",
    "Supervised",
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
    "supervise",
    "time_passed",
]
