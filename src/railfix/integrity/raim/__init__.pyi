# The names of `railfix.integrity.raim`, imported at their first use (lazy-loader).

from .exclusion import Detection, Exclusion, Outcome, RaimLimits, detect, exclude, threshold, worst_channel
from .position_model import LinearModel, linear_model
from .reliability import Reliability, noncentrality, reliability

__all__ = [
    "Detection",
    "Exclusion",
    "LinearModel",
    "Outcome",
    "RaimLimits",
    "Reliability",
    "detect",
    "exclude",
    "linear_model",
    "noncentrality",
    "reliability",
    "threshold",
    "worst_channel",
]
