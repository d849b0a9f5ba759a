# The names of `railfix.run`, imported at their first use (lazy-loader).

from .driver import RunSummary, run_files
from .folder import RunRecord, read_record
from .inputs import RunInputs
from .options import RunOptions, TrackReading

__all__ = [
    "RunInputs",
    "RunOptions",
    "RunRecord",
    "RunSummary",
    "TrackReading",
    "read_record",
    "run_files",
]
