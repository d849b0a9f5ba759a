# The names of `railfix.ranges.error_model`, imported at their first use (lazy-loader).

from .conditions import Conditions, condition_differences
from .fault_rate import fault_rate, faulty_stretches
from .file import read_error_model, write_error_model
from .fit import ErrorModelFit, ErrorSamples, fit_bins
from .marginal import SummaryRow, summary
from .model import LARGEST_PRIOR, POOLED, BinStatistics, ErrorBins, ErrorModel, ErrorModelSource, FaultRate
from .overbound import Overbound, gaussian_overbound

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
