"""Reference trajectory of the antennas, from RTK fixes and from sensors that bridge the gaps (P1 3.1(2), 4.2(2)).

The inputs of `build_references` are arrays, and those of `reference_files` are files.
"""

from railfix.io.reference_log import Acceleration, Pulses, read_acceleration, read_pulses
from railfix.reference.build import ReferenceData, build_references
from railfix.reference.driver import ReferenceInputs, ReferenceOptions, ReferenceSummary, reference_files
from railfix.reference.fixes import Fixes, FixRejection, ReferenceSettings
from railfix.reference.smoother import Built, Gap

__all__ = [
    "Acceleration",
    "Built",
    "FixRejection",
    "Fixes",
    "Gap",
    "Pulses",
    "ReferenceData",
    "ReferenceInputs",
    "ReferenceOptions",
    "ReferenceSettings",
    "ReferenceSummary",
    "build_references",
    "read_acceleration",
    "read_pulses",
    "reference_files",
]
