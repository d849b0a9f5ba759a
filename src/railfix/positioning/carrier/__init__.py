"""Carrier phase beside code (P4's observation model): slips, smoothed codes, float ambiguities.

The phase is precise to a few millimetres, but for an unknown constant per arc. `find_slips`
detects where arcs end, `smooth_codes` is the Hatch filter, and `phase_positions` estimates positions
from code and phase with the same geometry and clocks and one ambiguity per arc.
"""

from __future__ import annotations

from railfix.positioning.carrier.ambiguities import ArcAmbiguities, PhaseLimits, PhasePositions
from railfix.positioning.carrier.arcs import ArcState, number_arcs
from railfix.positioning.carrier.continuity import ContinuityLimits, ContinuityState, TrackJumps, track_jumps
from railfix.positioning.carrier.filtered import PhaseState, phase_positions
from railfix.positioning.carrier.observation_model import Phases, corrected_phase_m
from railfix.positioning.carrier.slips import SlipLimits, SlipReason, Slips, SlipState, find_slips
from railfix.positioning.carrier.smoothing import Smoothed, SmoothingLimits, SmoothingState, smooth_codes

__all__ = [
    "ArcAmbiguities",
    "ArcState",
    "ContinuityLimits",
    "ContinuityState",
    "PhaseLimits",
    "PhasePositions",
    "PhaseState",
    "Phases",
    "SlipLimits",
    "SlipReason",
    "SlipState",
    "Slips",
    "Smoothed",
    "SmoothingLimits",
    "SmoothingState",
    "TrackJumps",
    "corrected_phase_m",
    "find_slips",
    "number_arcs",
    "phase_positions",
    "smooth_codes",
    "track_jumps",
]
