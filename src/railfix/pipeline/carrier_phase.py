"""What the pipeline does with the carrier phase: smoothed codes, or code and phase together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from railfix.core.arrays import Floats
from railfix.gnss.navigation import Navigation, glonass_channels
from railfix.gnss.signals import carrier_frequency_hz
from railfix.pipeline.config import Config
from railfix.pipeline.corrected_ranges import Prepared
from railfix.positioning.carrier import (
    ArcState,
    ContinuityState,
    PhasePositions,
    Phases,
    PhaseState,
    Slips,
    SlipState,
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

#: Phases of satellites lower than this are weighted as if they stood here [deg].
LOWEST_WEIGHTED_DEG = 5.0


@dataclass(frozen=True, kw_only=True)
class CarrierState:
    """What the phases of one antenna leave to the next epochs; None before the first."""

    slips: SlipState | None = None
    smoothing: SmoothingState | None = None
    continuity: ContinuityState | None = None
    arcs: ArcState | None = None
    phase: PhaseState | None = None


def slips_of(one: Prepared, navigation: Navigation, config: Config, state: CarrierState) -> tuple[Slips, CarrierState]:
    """Cycle slips of all channels of an antenna's log."""
    obs = one.observations
    channels = {**glonass_channels(navigation), **obs.header.glonass_channel}
    frequency = carrier_frequency_hz(obs.satellite, obs.signal, channels)
    slips, after = find_slips(obs, state.slips, frequency_hz=frequency, limits=config.slips)
    return slips, replace(state, slips=after)


def smoothed(one: Prepared, slips: Slips, config: Config, state: CarrierState) -> tuple[Prepared, CarrierState]:
    """The same with codes smoothed by their phases; the weights stay those of raw codes.

    What multipath and the floor of the noise leave is not averaged as white noise is.
    """
    obs = one.observations
    found, after = smooth_codes(
        obs.time,
        obs.satellite,
        obs.signal,
        obs.code_m,
        slips.phase_m,
        slips.slip,
        state.smoothing,
        limits=config.smoothing,
    )
    corrected = one.corrected_code_m + (found.code_m - obs.code_m)[:, one.columns]
    return replace(one, corrected_code_m=corrected), replace(state, smoothing=after)


def carried(
    one: Prepared,
    slips: Slips,
    ranges: Ranges,
    trajectory: Trajectory,
    arc_m: Floats,
    config: Config,
    state: CarrierState,
) -> tuple[PhasePositions, CarrierState]:
    """Positions from code and phase, each from its own and earlier epochs (requirement A5; P4).

    Parameters
    ----------
    one : Prepared
    slips : Slips
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
    time, columns = one.observations.time, one.columns
    used = ranges.weight > 0
    phase = corrected_phase_m(slips.phase_m[:, columns], one.satellites.clock_m, one.ionosphere_m, one.troposphere_m)
    phase = np.where(used, phase, np.nan)
    jumps, continuity = track_jumps(
        time, one.satellite, one.signal, phase, one.satellites.position_ecef_m, slips.slip[:, columns],
        trajectory, arc_m, state.continuity, limits=config.continuity,
    )  # fmt: skip
    has = np.isfinite(slips.phase_m[:, columns])
    arcs, numbers = number_arcs(slips.slip[:, columns] | jumps.jump, has, one.satellite, one.signal, state.arcs)
    sine = np.sin(np.radians(np.maximum(one.elevation_deg, LOWEST_WEIGHTED_DEG)))
    known = np.isfinite(phase)
    phases = Phases(
        phase_m=np.where(known, phase, 0.0),
        weight=np.where(known, (sine / config.phase_sigma_m) ** 2, 0.0),
        arc_id=arcs,
    )
    found, after = phase_positions(time, ranges, phases, trajectory, arc_m, state.phase, limits=config.phase)
    return found, replace(state, continuity=continuity, arcs=numbers, phase=after)
