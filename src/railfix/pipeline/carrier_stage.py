"""Apply carrier-phase smoothing or float ambiguities."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from railfix.core.arrays import Floats, Masks
from railfix.core.constants import CLOCK_GROUP, SPEED_OF_LIGHT
from railfix.pipeline.config import Config
from railfix.pipeline.corrected_ranges import CorrectedRanges
from railfix.positioning.carrier import (
    ArcState,
    ContinuityState,
    CycleSlipState,
    IntegerChannels,
    PhaseLimits,
    PhasePositions,
    Phases,
    PhaseState,
    SmoothingState,
    TrackedPhases,
    corrected_phase_m,
    count_repeats,
    find_slips,
    last_arcs,
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
    """State of the carrier-phase stages of one antenna; None before the first epoch.

    `base_arc`: last arc of a base station's phase, by satellite and signal.
    """

    slips: CycleSlipState | None = None
    smoothing: SmoothingState | None = None
    continuity: ContinuityState | None = None
    arcs: ArcState | None = None
    phase: PhaseState | None = None
    base_arc: Mapping[tuple[str, str], int] = field(default_factory=dict)


def with_slips(ranges: CorrectedRanges, config: Config, state: CarrierState) -> tuple[CorrectedRanges, CarrierState]:
    """Return the ranges with the cycle slips of all channels of their log."""
    frequency = ranges.channels.every_frequency_hz
    slips, after = find_slips(ranges.observations, state.slips, frequency_hz=frequency, limits=config.slips)
    return replace(ranges, slips=slips), replace(state, slips=after)


def smooth_ranges(ranges: CorrectedRanges, config: Config, state: CarrierState) -> tuple[CorrectedRanges, CarrierState]:
    """Return the ranges with their codes smoothed by their phases; the weights stay those of raw codes.

    Multipath and the error floor are not averaged out as white noise is. The ranges need their slips
    (`with_slips`); without them nothing is smoothed.
    """
    obs, slips = ranges.observations, ranges.slips
    if slips is None:
        return ranges, state
    code_m, after = smooth_codes(
        obs.time, obs.satellite, obs.signal, obs.code_m, slips.phase_m, slips.slip, state.smoothing,
        limits=config.smoothing,
    )  # fmt: skip
    change = code_m - obs.code_m
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
    """Return positions from code and phase, each from its own and earlier epochs, and the state (requirement A5; P4).

    The ranges have their slips (`with_slips`); a phase is used where its code is. `arc_m`: positions from the codes
    alone, shape (T,).
    """
    slips = corrected.slips
    assert slips is not None, "with_slips() comes first"
    time, columns, satellites = corrected.time, corrected.columns, corrected.satellites
    satellite, signal = corrected.satellite, corrected.signal
    used, limits, slip = ranges.weight > 0, config.phase, slips.slip[:, columns]
    phase = corrected_phase_m(
        slips.phase_m[:, columns], corrected.satellites.clock_m, corrected.ionosphere_m, corrected.troposphere_m
    )
    integers = None
    if corrected.base is not None:
        phase = phase - corrected.base.phase_m
        begun, base_arc = _base_slips(corrected, state)
        slip, state = slip | begun, replace(state, base_arc=base_arc)
        limits = limits.replaced(drift_m=config.base.drift_m)
        if config.carrier == "fixed":
            limits = limits.replaced(correlation_s=0.0)
            integers = _integer_channels(corrected)
    phase = np.where(used, phase, np.nan)
    jumps, continuity = track_jumps(
        time, satellite, signal, TrackedPhases(phase, satellites.position_ecef_m, slip),
        trajectory, arc_m, state.continuity, limits=config.continuity,
    )  # fmt: skip
    has = np.isfinite(slips.phase_m[:, columns])
    arcs, numbers = number_arcs(slip | jumps.jump, has, corrected.satellite, corrected.signal, state.arcs)
    sine = np.sin(np.radians(np.maximum(corrected.elevation_deg, LOWEST_WEIGHTED_DEG)))
    known = np.isfinite(phase)
    phases = Phases(
        phase_m=np.where(known, phase, 0.0), weight=np.where(known, (sine / config.phase_sigma_m) ** 2, 0.0),
        arc_id=arcs, integers=integers,
    )  # fmt: skip
    if integers is not None:
        ranges, phases = _lasting(corrected, ranges, phases, config.phase, state)
    positions, after = phase_positions(time, ranges, phases, trajectory, arc_m, state.phase, limits=limits)
    return replace(positions, arcs=None), replace(state, continuity=continuity, arcs=numbers, phase=after)


def _base_slips(corrected: CorrectedRanges, state: CarrierState) -> tuple[Masks, dict[tuple[str, str], int]]:
    """Return where an arc of the base station's phase has ended, shape (T, K), and its last arcs."""
    assert corrected.base is not None
    keys = list(zip(corrected.satellite.tolist(), corrected.signal.tolist(), strict=True))
    before = np.array([state.base_arc.get(key, -1) for key in keys], dtype=np.int64)
    arc = np.concatenate([before[None], corrected.base.arc])
    return arc[1:] != arc[:-1], {**state.base_arc, **dict(zip(keys, arc[-1].tolist(), strict=True))}


def _lasting(
    corrected: CorrectedRanges, ranges: Ranges, phases: Phases, limits: PhaseLimits, state: CarrierState
) -> tuple[Ranges, Phases]:
    """Return ranges and phases whose multipath lasts `PhaseLimits.correlation_s`: weights fall to their share of it.

    The first epoch of an arc counts in full, so that the weights of an arc add up to its independent epochs.
    """
    before = last_arcs(corrected.satellite, corrected.signal, state.arcs)
    latest = np.maximum.accumulate(np.concatenate([before[None], phases.arc_id]))
    ended = np.datetime64("NaT", "ns") if state.phase is None else state.phase.memories[-1].time
    repeats = count_repeats(np.concatenate([np.array([ended]), corrected.time]), limits)[1:]
    share = np.where(phases.arc_id > latest[:-1], 1.0, 1.0 / repeats[:, None])
    return replace(ranges, weight=ranges.weight * share), replace(phases, weight=phases.weight * share)


def _integer_channels(corrected: CorrectedRanges) -> IntegerChannels:
    """Return wavelengths, and which channels share a clock and a signal; GLONASS has a frequency each: no integers."""
    names = zip(corrected.satellite.tolist(), corrected.signal.tolist(), strict=True)
    labels = ["" if name[0] == "R" else CLOCK_GROUP[name[0]] + signal for name, signal in names]
    _, group = np.unique(labels, return_inverse=True)
    return IntegerChannels(
        wavelength_m=SPEED_OF_LIGHT / corrected.frequency_hz,
        group=np.where(np.array(labels, dtype=np.str_) == "", -1, group),
    )
