# The names of `railfix.track`, imported at their first use (lazy-loader).

from .map_from_positions import Thinned, ThinningLimits, from_position_log, from_positions, thin
from .point_files import write_track_csv
from .quality import Finding, MapLimits, TrackQuality, check_track
from .read import read_track
from .track import Provenance, Track, interpolate_kilometrage
from .trajectory import Trajectory
from .vehicle import AntennaOffset, Vehicle, antenna_trajectory, read_vehicle

__all__ = [
    "AntennaOffset",
    "Finding",
    "MapLimits",
    "Provenance",
    "Thinned",
    "ThinningLimits",
    "Track",
    "TrackQuality",
    "Trajectory",
    "Vehicle",
    "antenna_trajectory",
    "check_track",
    "from_position_log",
    "from_positions",
    "interpolate_kilometrage",
    "read_track",
    "read_vehicle",
    "thin",
    "write_track_csv",
]
