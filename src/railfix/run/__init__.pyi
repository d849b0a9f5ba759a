# The names of `railfix.run`, imported at their first use (lazy-loader).

from .driver import RunSummary, run_files
from .inputs import RunInputs, RunOptions, TrackReading
from .record import RunRecord, read_record

__all__ = ["RunInputs", "RunOptions", "RunRecord", "RunSummary", "TrackReading", "read_record", "run_files"]
