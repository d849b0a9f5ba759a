# The names of `railfix.integrity.protection`, imported at their first use (lazy-loader).

from .risk import K_H_NPA, K_H_PA, K_V, MOST_EXCLUDED, SATELLITE_PRIOR, RiskBudget, k_factor
from .solution_separation import Cause, LevelStatus, ProtectionLevel, availability, protection_level

__all__ = [
    "K_H_NPA",
    "K_H_PA",
    "K_V",
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
