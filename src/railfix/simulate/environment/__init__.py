"""Multipath and blockage by structures along the line: masts, beams, buildings, slopes, roofs, tunnels.

`EnvironmentSettings` describes the structures; `Environment` draws them from a seed and is a source
of disturbances for `Scenario.multipath`. docs/simulator.md has the physics.
"""

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
from railfix.simulate.environment.structures import draw_sections

__all__ = [
    "KINDS", "CorrelatorSettings", "ElectrificationSettings", "Environment", "EnvironmentSettings", "RoofSettings",
    "RowSettings", "SectionSettings", "draw_sections",
]  # fmt: skip
