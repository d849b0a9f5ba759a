"""Multipath and blockage that belong to the place: masts, beams, buildings, slopes, roofs, tunnels.

`EnvironmentSettings` says what stands along the line; `Environment` makes one fixed place of it, a source
of disturbances for `Scenario.multipath`. docs/simulator-multipath.md has the physics.
"""

from railfix.simulate.environment.kinds import drawn_sections
from railfix.simulate.environment.model import Environment
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
    "Environment",
    "EnvironmentSettings",
    "RoofSettings",
    "RowSettings",
    "SectionSettings",
    "drawn_sections",
]
