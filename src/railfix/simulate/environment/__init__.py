"""Multipath and blockage by structures along the line, such as masts, beams, buildings, slopes, roofs and tunnels.

`EnvironmentSettings` describes the structures. `Environment` draws the structures from a seed and computes the
disturbances of the signals. The physical models are described in docs/simulator.md.
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
