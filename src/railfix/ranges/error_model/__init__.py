"""Errors of corrected pseudoranges along a railway, by direction and C/N0: fit, file, use (P1 7)."""

from railfix.ranges.error_model.conditions import Conditions, condition_differences
from railfix.ranges.error_model.fault_rate import fault_rate, faulty_stretches
from railfix.ranges.error_model.file import read_error_model, write_error_model
from railfix.ranges.error_model.fit import ErrorModelFit, ErrorSamples, fit_bins
from railfix.ranges.error_model.marginal import SummaryRow, summary
from railfix.ranges.error_model.model import POOLED, BinStatistics, ErrorBins, ErrorModel, ErrorModelSource, FaultRate
from railfix.ranges.error_model.overbound import Overbound, gaussian_overbound

__all__ = [
    "POOLED",
    "BinStatistics",
    "Conditions",
    "ErrorBins",
    "ErrorModel",
    "ErrorModelFit",
    "ErrorModelSource",
    "ErrorSamples",
    "FaultRate",
    "Overbound",
    "SummaryRow",
    "condition_differences",
    "fault_rate",
    "faulty_stretches",
    "fit_bins",
    "gaussian_overbound",
    "read_error_model",
    "summary",
    "write_error_model",
]
