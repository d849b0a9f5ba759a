"""Protection level along the track (P1 2.4): the largest error at a stated risk.

From the model of `railfix.integrity.raim`::

    risk = RiskBudget()
    model = constrained_model(ranges, trajectory, arc_m)
    got = along_track_level(model, systems, risk=risk, n_excluded=n_excluded)
    status = availability(got.level_m, 20.0, consistent=got.consistent)
"""

from railfix.integrity.protection.level import Cause, ProtectionLevel, along_track_level
from railfix.integrity.protection.risk import K_H_NPA, K_H_PA, K_V, MOST_EXCLUDED, SATELLITE_PRIOR, RiskBudget, k_factor
from railfix.integrity.protection.status import LevelStatus, availability

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
    "along_track_level",
    "availability",
    "k_factor",
]
