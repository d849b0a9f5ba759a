# The names of `railfix.ranges.error_model`, imported at their first use (lazy-loader).

from .fault_rate import fault_rate, faulty_stretches
from .file import read_error_model, write_error_model
from .fit import ErrorModelFit, ErrorSamples, Overbound, SummaryRow, fit_bins, gaussian_overbound, summary
from .model import (
    LARGEST_PRIOR,
    POOLED,
    BinStatistics,
    Conditions,
    ErrorBins,
    ErrorModel,
    ErrorModelSource,
    FaultRate,
    condition_differences,
)

__all__ = [
    "LARGEST_PRIOR",
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
