"""The 3-D track map: files in, a `Track` out; its quality; a map made from good positions (P1 2.2(1), 4.2(1))."""

from railfix.track.csv_file import write_track_csv
from railfix.track.from_positions import Thinned, ThinningLimits, from_position_log, from_positions, thin
from railfix.track.quality import Finding, MapLimits, TrackQuality, check_track
from railfix.track.read import read_track
from railfix.track.track import Provenance, Track, interpolate_kilometrage

__all__ = [
    "Finding",
    "MapLimits",
    "Provenance",
    "Thinned",
    "ThinningLimits",
    "Track",
    "TrackQuality",
    "check_track",
    "from_position_log",
    "from_positions",
    "interpolate_kilometrage",
    "read_track",
    "thin",
    "write_track_csv",
]
