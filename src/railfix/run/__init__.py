"""The batch: logs, navigation and a track map in, tables of positions out."""

from railfix.run.ablation import Ablation, Effect, ablate_files
from railfix.run.driver import RunOptions, RunSummary, run_files
from railfix.run.inputs import RunInputs
from railfix.run.past import PastRun, past_run
from railfix.run.sources import TrackReading

__all__ = [
    "Ablation",
    "Effect",
    "PastRun",
    "RunInputs",
    "RunOptions",
    "RunSummary",
    "TrackReading",
    "ablate_files",
    "past_run",
    "run_files",
]
