# The names of `railfix.integrity`, imported at their first use (lazy-loader).

from .protection import Cause, LevelStatus, ProtectionLevel, RiskBudget, availability
from .protection.level import protection_level
from .raim import Exclusion, Outcome, RaimLimits
from .raim.exclusion import exclude_faults

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
