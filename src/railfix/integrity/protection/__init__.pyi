# The names of `railfix.integrity.protection`, imported at their first use (lazy-loader).

from .alarm_limit import availability
from .risk import MOST_EXCLUDED, SATELLITE_PRIOR, RiskBudget, k_factor
from .solution_separation import Cause, LevelStatus, ProtectionLevel, protection_level

__all__ = [
    "MOST_EXCLUDED",
    "SATELLITE_PRIOR",
    "Cause",
    "LevelStatus",
    "ProtectionLevel",
    "RiskBudget",
    "availability",
    "k_factor",
    "protection_level",
]
