"""Position logs and write the results: files in, tables of positions out, and the results read back."""

from railfix.run.driver import RunSummary, run_files
from railfix.run.folder import RunRecord, read_record
from railfix.run.inputs import RunInputs
from railfix.run.options import RunOptions, TrackReading

__all__ = [
    "RunInputs",
    "RunOptions",
    "RunRecord",
    "RunSummary",
    "TrackReading",
    "read_record",
    "run_files",
]
