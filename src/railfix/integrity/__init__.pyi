# The names of `railfix.integrity`, imported at their first use (lazy-loader).

from .protection import Cause, LevelStatus, ProtectionLevel, RiskBudget, availability
from .raim import Exclusion, Outcome, RaimLimits
from .stages import exclude_faults, protection_level

__all__ = [
    "Cause",
    "Exclusion",
    "LevelStatus",
    "Outcome",
    "ProtectionLevel",
    "RaimLimits",
    "RiskBudget",
    "availability",
    "exclude_faults",
    "protection_level",
]
