"""The 3-D track map, its quality checks, vehicles, and antenna trajectories (P1 2.2(1), 3.1(1), 4.2(1))."""

from railfix.track.csv_file import write_track_csv
from railfix.track.from_positions import Thinned, ThinningLimits, from_position_log, from_positions, thin
from railfix.track.quality import Finding, MapLimits, TrackQuality, check_track
from railfix.track.read import read_track
from railfix.track.track import Provenance, Track, interpolate_kilometrage
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import AntennaOffset, Vehicle, antenna_trajectory, read_vehicle

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
