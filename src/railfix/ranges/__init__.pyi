# The names of `railfix.ranges`, imported at their first use (lazy-loader).

from .corrected import DEFAULT_SIGNALS, CodeNoise, CorrectedCodes, NominalErrors, corrected_ranges

__all__ = [
    "DEFAULT_SIGNALS",
    "CodeNoise",
    "CorrectedCodes",
    "NominalErrors",
    "corrected_ranges",
]
