"""Accuracy and integrity of positions: errors along the line against a reference, and their statistics.

The error is the distance along the map from the reference position's nearest point on the map to the evaluated
position. It is positive toward the end of the line, for both directions of travel (paper P1, sections 3.3 and 5).
"""

from railfix.evaluate.accuracy import FIGURE_COLUMNS, WRONG_PLACE_M, Score, score
from railfix.evaluate.epoch_table import EPOCH_COLUMNS
from railfix.evaluate.evaluation import EvaluatedRun, Evaluation, RunAndReference, evaluate_run, evaluate_runs
from railfix.evaluate.evaluation_inputs import EvaluationOptions
from railfix.evaluate.integrity import BEYOND_COLUMNS, STANFORD_COLUMNS, Integrity
from railfix.evaluate.intervals import INTERVAL_COLUMNS, LEVEL_COLUMNS
from railfix.evaluate.place import TrackFiles, along_track_error, interpolate_reference, straight_distance
from railfix.evaluate.tables import write_evaluation

__all__ = [
    "BEYOND_COLUMNS", "EPOCH_COLUMNS", "FIGURE_COLUMNS", "INTERVAL_COLUMNS", "LEVEL_COLUMNS", "STANFORD_COLUMNS",
    "WRONG_PLACE_M", "EvaluatedRun", "Evaluation", "EvaluationOptions", "Integrity", "RunAndReference", "Score",
    "TrackFiles", "along_track_error", "evaluate_run", "evaluate_runs", "interpolate_reference", "score",
    "straight_distance", "write_evaluation",
]  # fmt: skip
