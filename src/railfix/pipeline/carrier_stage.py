"""Smooth codes by the carrier phase, or estimate positions from code and phase."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from railfix.core.arrays import Floats, Masks, copy_with
from railfix.core.constants import CLOCK_GROUP, SPEED_OF_LIGHT
from railfix.core.epoch_rows import take_epochs
from railfix.pipeline.config import Config
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.carrier import (
    ArcState,
    ContinuityState,
    CycleSlipState,
    IntegerChannels,
    PhaseLimits,
    PhasePositions,
    Phases,
    PhaseState,
    Slips,
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
from railfix.positioning.range_arrays import Ranges
from railfix.positioning.search_index import SearchIndex
from railfix.positioning.two_frequencies import Combined
from railfix.ranges.corrected import CorrectedRanges
from railfix.track.trajectory import Trajectory

#: Phases below this elevation have the same weight as phases at this elevation [deg].
LOWEST_WEIGHTED_DEG = 5.0


@dataclass(frozen=True, kw_only=True)
class CarrierState:
    """Carrier-phase state of one antenna; the fields are None before the first epoch.

    `base_arc` has the number of the base station's last phase arc, by satellite and signal.
    """

    slips: CycleSlipState | None = None
    smoothing: SmoothingState | None = None
    continuity: ContinuityState | None = None
    arcs: ArcState | None = None
    phase: PhaseState | None = None
    base_arc: Mapping[tuple[str, str], int] = field(default_factory=dict)


def find_antenna_slips(
    corrected: CorrectedRanges, antennas: AntennaRows, config: Config, states: Sequence[CarrierState]
) -> tuple[Slips, list[CarrierState]]:
    """Return the cycle slips of all channels of the observations, and the new state of each antenna."""
    frequency = corrected.channels.every_frequency_hz

    def own_slips(_: SearchIndex, rows: slice, state: CarrierState) -> tuple[Slips, CarrierState]:
        own = take_epochs(corrected.observations, rows)
        slips, after = find_slips(own, state.slips, frequency_hz=frequency, limits=config.slips)
        return slips, replace(state, slips=after)

    return antennas.each_with_state(own_slips, states)


def smooth_ranges(
    corrected: CorrectedRanges,
    combined: Combined | None,
    slips: Slips,
    antennas: AntennaRows,
    config: Config,
    states: Sequence[CarrierState],
) -> tuple[CorrectedRanges, list[CarrierState]]:
    """Return ranges with smoothed codes, but with the weights of raw codes; also return each antenna's new state.

    Smoothing does not raise the weights, because multipath and the error floor do not average out like white noise.
    """
    obs = corrected.observations

    def own_codes(_: SearchIndex, rows: slice, state: CarrierState) -> tuple[Floats, CarrierState]:
        smoothed, after = smooth_codes(
            obs.time[rows], obs.satellite, obs.signal, obs.code_m[rows], slips.phase_m[rows], slips.slip[rows],
            state.smoothing, limits=config.smoothing,
        )  # fmt: skip
        return smoothed, replace(state, smoothing=after)

    code_m, after = antennas.each_with_state(own_codes, states)
    every = code_m - obs.code_m
    change = every[:, corrected.columns]
    if corrected.second is not None and combined is not None:
        other = np.take_along_axis(every, np.maximum(corrected.second.column, 0), axis=1)
        share = combined.share
        change = np.where(np.isfinite(share), (1.0 - share) * change + share * other, change)
    return copy_with(corrected, corrected_code_m=corrected.corrected_code_m + change), after


def code_and_phase(
    corrected: CorrectedRanges,
    ranges: Ranges,
    slips: Slips,
    trajectory: Trajectory,
    arc_m: Floats,
    config: Config,
    state: CarrierState,
) -> tuple[PhasePositions, CarrierState]:
    """Return each epoch's position from codes and phases up to the epoch, and the new state (requirement A5; P4).

    A phase is used if the code of the same channel is used. `slips` covers all channels of the observations; `arc_m`
    has positions from codes only, shape (T,).
    """
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
    """Return a mask (T, K) of starts of the base station's phase arcs, and the number of each channel's last arc."""
    assert corrected.base is not None
    keys = list(zip(corrected.satellite.tolist(), corrected.signal.tolist(), strict=True))
    before = np.array([state.base_arc.get(key, -1) for key in keys], dtype=np.int64)
    arc = np.concatenate([before[None], corrected.base.arc])
    return arc[1:] != arc[:-1], {**state.base_arc, **dict(zip(keys, arc[-1].tolist(), strict=True))}


def _lasting(
    corrected: CorrectedRanges, ranges: Ranges, phases: Phases, limits: PhaseLimits, state: CarrierState
) -> tuple[Ranges, Phases]:
    """Reduce the weights of ranges and phases, to allow for multipath that persists for `PhaseLimits.correlation_s`.

    The first epoch of an arc has full weight, so that the arc's weight factors sum to its number of independent epochs.
    """
    before = last_arcs(corrected.satellite, corrected.signal, state.arcs)
    latest = np.maximum.accumulate(np.concatenate([before[None], phases.arc_id]))
    ended = np.datetime64("NaT", "ns") if state.phase is None else state.phase.memories[-1].time
    repeats = count_repeats(np.concatenate([np.array([ended]), corrected.time]), limits)[1:]
    share = np.where(phases.arc_id > latest[:-1], 1.0, 1.0 / repeats[:, None])
    return replace(ranges, weight=ranges.weight * share), replace(phases, weight=phases.weight * share)


def _integer_channels(corrected: CorrectedRanges) -> IntegerChannels:
    """Return wavelength and ambiguity group (clock and signal) of each channel; GLONASS, never fixed, has group -1."""
    names = zip(corrected.satellite.tolist(), corrected.signal.tolist(), strict=True)
    labels = ["" if name[0] == "R" else CLOCK_GROUP[name[0]] + signal for name, signal in names]
    _, group = np.unique(labels, return_inverse=True)
    return IntegerChannels(
        wavelength_m=SPEED_OF_LIGHT / corrected.frequency_hz,
        group=np.where(np.array(labels, dtype=np.str_) == "", -1, group),
    )
