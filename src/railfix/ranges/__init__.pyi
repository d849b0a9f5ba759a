# The names of `railfix.ranges`, imported at their first use (lazy-loader).

from .corrected import CorrectedCodes, corrected_ranges
from .weights import DEFAULT_SIGNALS, CodeNoise, NominalErrors

__all__ = [
    "DEFAULT_SIGNALS",
    "CodeNoise",
    "CorrectedCodes",
    "NominalErrors",
    "corrected_ranges",
]
