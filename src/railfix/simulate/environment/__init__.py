"""Multipath and blockage that belong to the place: masts, beams, buildings, slopes, roofs, tunnels.

`EnvironmentSettings` says what stands along the line; with a seed it becomes one fixed place.
"""

from railfix.simulate.environment.settings import (
    KINDS,
    CorrelatorSettings,
    ElectrificationSettings,
    EnvironmentSettings,
    RoofSettings,
    RowSettings,
    SectionSettings,
)

__all__ = [
    "KINDS",
    "CorrelatorSettings",
    "ElectrificationSettings",
    "EnvironmentSettings",
    "RoofSettings",
    "RowSettings",
    "SectionSettings",
]
