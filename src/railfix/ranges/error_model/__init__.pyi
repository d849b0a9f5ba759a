# The names of `railfix.ranges.error_model`, imported at their first use (lazy-loader).

from .fit import (
    ErrorModelFit,
    ErrorSamples,
    Overbound,
    SummaryRow,
    fault_rate,
    faulty_stretches,
    fit_bins,
    gaussian_overbound,
    summary,
)
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
    read_error_model,
    write_error_model,
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
