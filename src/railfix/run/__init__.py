"""The batch: logs, navigation and a track map in, tables of positions out."""

from railfix.run.driver import RunOptions, RunSummary, run_files
from railfix.run.inputs import RunInputs
from railfix.run.past import PastRun, past_run
from railfix.run.sources import TrackReading

__all__ = [
    "PastRun",
    "RunInputs",
    "RunOptions",
    "RunSummary",
    "TrackReading",
    "past_run",
    "run_files",
]
