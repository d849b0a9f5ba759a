"""Apply carrier-phase smoothing or float ambiguities."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from railfix.core.arrays import Floats
from railfix.pipeline.config import Config
from railfix.pipeline.corrected_ranges import CorrectedRanges
from railfix.positioning.carrier import (
    ArcState,
    ContinuityState,
    CycleSlipState,
    PhasePositions,
    Phases,
    PhaseState,
    SmoothingState,
    corrected_phase_m,
    find_slips,
    number_arcs,
    phase_positions,
    smooth_codes,
    track_jumps,
)
from railfix.positioning.normal_equations import Ranges
from railfix.track.trajectory import Trajectory

#: Phases of satellites below this elevation are weighted as if at it [deg].
LOWEST_WEIGHTED_DEG = 5.0


@dataclass(frozen=True, kw_only=True)
class CarrierState:
    """State of the carrier-phase stages of one antenna; None before the first epoch."""

    slips: CycleSlipState | None = None
    smoothing: SmoothingState | None = None
    continuity: ContinuityState | None = None
    arcs: ArcState | None = None
    phase: PhaseState | None = None


def with_slips(ranges: CorrectedRanges, config: Config, state: CarrierState) -> tuple[CorrectedRanges, CarrierState]:
    """Return the ranges with the cycle slips of all channels of their log."""
    frequency = ranges.channels.every_frequency_hz
    slips, after = find_slips(ranges.observations, state.slips, frequency_hz=frequency, limits=config.slips)
    return replace(ranges, slips=slips), replace(state, slips=after)


def smoothed(ranges: CorrectedRanges, config: Config, state: CarrierState) -> tuple[CorrectedRanges, CarrierState]:
    """Return the ranges with their codes smoothed by their phases; the weights stay those of raw codes.

    Multipath and the error floor are not averaged out as white noise is. The ranges need their slips
    (`with_slips`); without them nothing is smoothed.
    """
    obs, slips = ranges.observations, ranges.slips
    if slips is None:
        return ranges, state
    result, after = smooth_codes(
        obs.time,
        obs.satellite,
        obs.signal,
        obs.code_m,
        slips.phase_m,
        slips.slip,
        state.smoothing,
        limits=config.smoothing,
    )
    change = result.code_m - obs.code_m
    corrected = change[:, ranges.columns]
    if ranges.second is not None and ranges.combined is not None:
        other = np.take_along_axis(change, np.maximum(ranges.second.column, 0), axis=1)
        share = ranges.combined.share
        corrected = np.where(np.isfinite(share), (1.0 - share) * corrected + share * other, corrected)
    corrected = ranges.corrected_code_m + corrected
    return replace(ranges, corrected_code_m=corrected), replace(state, smoothing=after)


def code_and_phase(
    corrected: CorrectedRanges,
    ranges: Ranges,
    trajectory: Trajectory,
    arc_m: Floats,
    config: Config,
    state: CarrierState,
) -> tuple[PhasePositions, CarrierState]:
    """Return positions from code and phase, each from its own and earlier epochs (requirement A5; P4).

    Parameters
    ----------
    corrected : CorrectedRanges
        With their slips (`with_slips`).
    ranges : Ranges
        Codes that the position was solved with; a phase is used where its code is.
    trajectory : Trajectory
    arc_m : ndarray, shape (T,) [m]
        Positions from the codes alone.
    config : Config
    state : CarrierState

    Returns
    -------
    PhasePositions
    CarrierState
    """
    slips = corrected.slips
    assert slips is not None, "with_slips() comes first"
    time, columns, satellites = corrected.time, corrected.columns, corrected.satellites
    satellite, signal = corrected.satellite, corrected.signal
    used = ranges.weight > 0
    phase = corrected_phase_m(
        slips.phase_m[:, columns], corrected.satellites.clock_m, corrected.ionosphere_m, corrected.troposphere_m
    )
    phase = np.where(used, phase, np.nan)
    jumps, continuity = track_jumps(
        time, satellite, signal, phase, satellites.position_ecef_m, slips.slip[:, columns],
        trajectory, arc_m, state.continuity, limits=config.continuity,
    )  # fmt: skip
    has = np.isfinite(slips.phase_m[:, columns])
    arcs, numbers = number_arcs(
        slips.slip[:, columns] | jumps.jump, has, corrected.satellite, corrected.signal, state.arcs
    )
    sine = np.sin(np.radians(np.maximum(corrected.elevation_deg, LOWEST_WEIGHTED_DEG)))
    known = np.isfinite(phase)
    phases = Phases(
        phase_m=np.where(known, phase, 0.0),
        weight=np.where(known, (sine / config.phase_sigma_m) ** 2, 0.0),
        arc_id=arcs,
    )
    positions, after = phase_positions(time, ranges, phases, trajectory, arc_m, state.phase, limits=config.phase)
    return replace(positions, arcs=None), replace(state, continuity=continuity, arcs=numbers, phase=after)
