"""Carrier phase beside code (P4's observation model): slips, smoothed codes, float ambiguities.

The phase is as good as a few millimetres but for a constant of each unbroken arc. `find_slips`
tells where the arcs break, `smooth_codes` is the simple use of them (Hatch), `phase_positions` the
full one: code and phase with the same geometry and clocks, an unknown constant an arc.
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
