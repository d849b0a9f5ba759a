"""Errors of single pseudoranges against a reference position, with or without a reference station (P1 7, fig. 14)."""

from railfix.evaluate.range_errors.base_station import CommonErrors, base_station, base_station_from_files
from railfix.evaluate.range_errors.gather import (
    GatherLimits,
    ModelInputs,
    RangeErrors,
    StationBeside,
    error_model_from_runs,
    range_errors,
)
from railfix.positioning.noise_scale import RobustClock, robust_clock

__all__ = [
    "CommonErrors",
    "GatherLimits",
    "ModelInputs",
    "RangeErrors",
    "RobustClock",
    "StationBeside",
    "base_station",
    "base_station_from_files",
    "error_model_from_runs",
    "range_errors",
    "robust_clock",
]
