# The names of `railfix.positioning.carrier`, imported at their first use (lazy-loader).

from .ambiguities import ArcAmbiguities, Fixed, PhaseLimits, PhasePositions, count_repeats, fix_integers
from .code_smoothing import (
    CycleSlipLimits,
    CycleSlipState,
    SlipReason,
    Slips,
    SmoothingLimits,
    SmoothingState,
    find_slips,
    smooth_codes,
)
from .continuity import (
    ArcState,
    ContinuityLimits,
    ContinuityState,
    TrackedPhases,
    TrackJumps,
    last_arcs,
    number_arcs,
    track_jumps,
)
from .filtered import PhaseState, phase_positions
from .observation_model import IntegerChannels, Phases, corrected_phase_m

__all__ = [
    "ArcAmbiguities",
    "ArcState",
    "ContinuityLimits",
    "ContinuityState",
    "CycleSlipLimits",
    "CycleSlipState",
    "Fixed",
    "IntegerChannels",
    "PhaseLimits",
    "PhasePositions",
    "PhaseState",
    "Phases",
    "SlipReason",
    "Slips",
    "SmoothingLimits",
    "SmoothingState",
    "TrackJumps",
    "TrackedPhases",
    "corrected_phase_m",
    "count_repeats",
    "find_slips",
    "fix_integers",
    "last_arcs",
    "number_arcs",
    "phase_positions",
    "smooth_codes",
    "track_jumps",
]
