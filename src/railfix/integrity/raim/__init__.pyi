# The names of `railfix.integrity.raim`, imported at their first use (lazy-loader).

from .detectable_bias import Reliability, noncentrality, reliability
from .exclusion import Detection, Exclusion, Outcome, RaimLimits, detect, exclude, threshold, worst_channel
from .position_model import LinearModel, linear_model

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
