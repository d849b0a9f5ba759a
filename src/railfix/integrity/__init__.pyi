# The names of `railfix.integrity`, imported at their first use (lazy-loader).

from .fault_exclusion import RaimResult, compute_statistic, exclude_faults
from .persistent_biases import (
    BiasLimits,
    LastingErrorLimits,
    LastingErrorState,
    PersistentBiases,
    reject_persistent_biases,
)
from .point_validation import PointStatus, position_dilution, validate_point
from .protection import Cause, LevelStatus, ProtectionLevel, RiskBudget, availability, protection_level
from .protection.solution_separation import MapDeviation, RangeBounds
from .raim import Exclusion, LinearModel, Outcome, RaimLimits, linear_model

__all__ = [
    "BiasLimits",
    "Cause",
    "Exclusion",
    "LastingErrorLimits",
    "LastingErrorState",
    "LevelStatus",
    "LinearModel",
    "MapDeviation",
    "Outcome",
    "PersistentBiases",
    "PointStatus",
    "ProtectionLevel",
    "RaimLimits",
    "RaimResult",
    "RangeBounds",
    "RiskBudget",
    "availability",
    "compute_statistic",
    "exclude_faults",
    "linear_model",
    "position_dilution",
    "protection_level",
    "reject_persistent_biases",
    "validate_point",
]
