"""Compute conventional 3-D antenna positions, and positions on the line with sigma, protection level and status.

The stages run in this order (P1 figure 1): 3-D position, inter-system biases, section search, constrained fix,
persistent biases and single faults, noise scale, test of the map, protection level, carrier phase, status.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import scipy

from railfix.core.arrays import Bits, Codes, Floats, Integers, Masks, channel_sums, copy_with, patch_rows
from railfix.core.constants import CLOCK_GROUP
from railfix.core.epoch_rows import take_epochs
from railfix.core.reasons import Reason, Status
from railfix.integrity.fault_exclusion import RaimResult
from railfix.integrity.point_validation import validate_point
from railfix.integrity.raim import LinearModel, reliability
from railfix.pipeline.carrier_stage import CarrierState, code_and_phase
from railfix.pipeline.config import OFF_MAP_S, Config
from railfix.pipeline.fault_stage import CheckedPositions, check_ranges, contradict_map
from railfix.pipeline.level_stage import level_stage
from railfix.pipeline.off_map import off_map_epochs
from railfix.pipeline.processor_state import AntennaState
from railfix.pipeline.range_stage import fit_ranges, reject
from railfix.pipeline.solution import Solution
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.carrier import PhasePositions, Slips
from railfix.positioning.inter_system import TieLimits, tie_constellations
from railfix.positioning.line_fix import LineFix, fix_on_line
from railfix.positioning.map_offset import (
    LinePositions,
    OffsetErrors,
    beyond_threshold,
    map_offset,
    offset_from_line,
)
from railfix.positioning.normal_equations import SinglePoint, point_position, position_on_line
from railfix.positioning.range_arrays import UNTIED_M, InterSystemBiases, Ranges, without
from railfix.positioning.receiver_noise import (
    epoch_sigma_m,
    epoch_variance,
)
from railfix.positioning.search_index import SearchIndex
from railfix.ranges.corrected import CorrectedRanges


def position_stage(
    corrected: CorrectedRanges,
    slips: Slips | None,
    antennas: AntennaRows,
    config: Config,
    states: Sequence[AntennaState],
) -> tuple[CorrectedRanges, Solution, list[AntennaState]]:
    """Return the ranges with this stage's rejection reasons, the positions, and the new state of each antenna.

    `corrected` is the output of the observation screens; `states` has one state for each antenna.
    """
    time = corrected.time
    untied = fit_ranges(corrected)
    ranges, points, offsets = tie_constellations(
        time, corrected.channels.clocks, untied, corrected.near_ecef_m,
        [state.offsets for state in states], reference=CLOCK_GROUP[config.systems[0]], parts=antennas.parts,
        limits=TieLimits(config.single_point, config.robust_fit, config.clock_offsets),
    )  # fmt: skip
    corrected, conventional = reject(corrected, points.gross, Reason.GROSS_ERROR), without(untied, points.gross)
    fix = fix_on_line(ranges, antennas, points.tied, config.fix_limits)
    corrected = reject(
        corrected, _alone_on_clock(corrected.reason, corrected.channels.groups, points.ties), Reason.ALONE_ON_ITS_CLOCK
    )
    corrected, ranges, checked, states = check_ranges(corrected, ranges, antennas, fix, config, states)
    fix, scale = checked.fix, checked.scale
    constrained, on_map = fix.constrained, np.isfinite(fix.constrained.arc_m) & ~checked.off_map
    # ranges that fit no 3-D position do not fit a position on the map either
    unresolved = corrected.unsure | _contradict(fix.point, ranges.space_redundancy, scale)
    off_map = checked.off_map & ~unresolved

    excluded = checked.lasting | checked.raim.excluded
    agreeing, free = _consistent(without(untied, points.disagreeing), points.free, excluded, corrected, scale, config)
    right_m = offset_from_line(free.ecef_m, constrained.arc_m, antennas)[:, 0]

    away, off_map_states = antennas.each_with_state(
        lambda _, rows, own: off_map_epochs(
            time[rows], on_map[rows], off_map[rows], right_m[rows], own.off_map, least_s=OFF_MAP_S
        ),
        states,
    )
    offset, map_states = map_offset(
        time, agreeing, free, OffsetErrors(corrected.nominal_m, np.maximum(scale, 1.0) ** 2), antennas,
        LinePositions(constrained.arc_m, away), [state.map_offset for state in states], limits=config.map_offset,
    )  # fmt: skip
    raim = _with_protection_level(checked, config)
    corrected = reject(corrected, raim.excluded, Reason.FAULT_EXCLUDED)
    checked = checked._replace(raim=raim)
    level, open_elsewhere = level_stage(corrected, ranges, checked, antennas, offset, config)
    sigma, carriers = _published(
        corrected, ranges, checked, slips, antennas, config, [state.carrier for state in states]
    )
    solution = Solution(
        point=points.point, consistent_ecef_m=free.ecef_m,
        conventional_status=validate_point(points.point, conventional, scale, limits=config.single_point),
        fix=fix, ties=points.ties, raim=raim, status=np.zeros(len(time), dtype=np.int8), noise_scale=scale,
        epoch_sigma_m=sigma.epoch_m, arc_m=sigma.arc_m, along_sigma_m=sigma.along_m, phase=sigma.phase,
        protection=level, map_offset=offset, off_map=away,
    )  # fmt: skip
    if sigma.phase is not None:
        off_map = contradict_map(ranges, antennas, fix, sigma.arc_m, config) & ~unresolved
    observed = np.asarray(np.isfinite(corrected.code_m).any(axis=1))
    failed = off_map, raim.faulty | unresolved, open_elsewhere
    counts = ranges.n_used, ranges.redundancy
    status = _status(observed, counts, solution, sigma.judged_m, failed, config)
    after = [
        copy_with(
            state, offsets=offsets[k], map_offset=map_states[k], off_map=off_map_states[k], carrier=carriers[k]
        )
        for k, state in enumerate(states)
    ]  # fmt: skip
    return corrected, copy_with(solution, status=status), after


def _with_protection_level(checked: CheckedPositions, config: Config) -> RaimResult:
    """Return the RAIM result, with the protection level of P4 if `Config.raim_protection` is "on"."""
    raim = checked.raim
    if "raim" not in config.screens or config.raim_protection != "on":
        return raim
    of_raim = reliability(checked.model, limits=config.raim, scale=checked.scale).protection_level_m
    return copy_with(raim, protection_level_m=np.where(raim.faulty, np.nan, of_raim))


def _alone_on_clock(reason: Bits, groups: Sequence[slice], ties: InterSystemBiases) -> Masks:
    """Return a mask (T, K) of satellites that are the only used satellite of a clock with unknown bias."""
    alone = np.zeros(reason.shape, dtype=bool)
    for g, group in enumerate(groups):
        used = reason[:, group] == 0
        lone = (used.sum(axis=1) == 1) & (ties.sigma_m[:, g] >= UNTIED_M)
        alone[:, group] = used & lone[:, None]
    return alone


#: Ranges are inconsistent if the residual variance of a 3-D fit is over this number of times the range variance.
_CONTRADICT: Final = 25.0


def _consistent(
    agreeing: Ranges, free: SinglePoint, excluded: Masks, corrected: CorrectedRanges, scale: Floats, config: Config
) -> tuple[Ranges, SinglePoint]:
    """Return ranges and 3-D positions for the map test; at inconsistent epochs, satellites in `excluded` are left out.
    Positions are NaN where the remaining ranges are inconsistent, or the faulty range cannot be identified.
    """
    wrong = excluded & (agreeing.weight > 0) & _contradict(free, agreeing.space_redundancy, scale)[:, None]
    changed = np.flatnonzero(wrong.any(axis=1))
    if len(changed):
        agreeing = without(agreeing, wrong)
        start = np.where(np.isnan(free.ecef_m), corrected.near_ecef_m, free.ecef_m)[changed]
        solved = point_position(agreeing.take(changed), start, limits=config.single_point)
        free = patch_rows(free, changed, solved)
    unusable = corrected.unsure | _contradict(free, agreeing.space_redundancy, scale)
    return agreeing, copy_with(free, ecef_m=np.where(unusable[:, None], np.nan, free.ecef_m))


def _contradict(point: SinglePoint, freedom: Integers, scale: Floats) -> Masks:
    """Return a mask (T,) of epochs whose ranges, with redundancy `freedom`, fit no 3-D position."""
    return np.asarray((freedom >= 1) & (point.wsse > _CONTRADICT * freedom * np.maximum(scale, 1.0) ** 2))


class PublishedPositions(NamedTuple):
    """Published positions of T epochs, from the codes or from code and phase; shape (T,) each."""

    arc_m: Floats
    along_m: Floats  #: Standard deviation along the line.
    epoch_m: Floats  #: Single-epoch sigma.
    judged_m: Floats  #: Sigma that `Config.largest_sigma_m` limits.
    phase: PhasePositions | None


def _published(
    corrected: CorrectedRanges,
    ranges: Ranges,
    checked: CheckedPositions,
    slips: Slips | None,
    antennas: AntennaRows,
    config: Config,
    carriers: Sequence[CarrierState | None],
) -> tuple[PublishedPositions, Sequence[CarrierState | None]]:
    """Return the positions with their standard deviations, and the carrier-phase states."""
    fix, scale = checked.fix, checked.scale
    constrained = fix.constrained
    own = epoch_sigma_m(ranges.redundancy, constrained.wsse, constrained.exact_map_sigma_m, scale)
    arc, exact, total = constrained.arc_m, constrained.exact_map_sigma_m, constrained.sigma_m
    variance = epoch_variance(scale, constrained.wsse, ranges.redundancy, limits=config.noise_scale)
    nominal, phase = _nominal_variance_m2(checked.model, corrected.nominal_elevation_sigma_m), None
    if config.carrier in ("float", "fixed"):
        assert slips is not None, "cycle slips are searched for if phases are used"
        of_all = slips

        def own_phase(
            index: SearchIndex, rows: slice, state: CarrierState | None
        ) -> tuple[PhasePositions, CarrierState]:
            given = take_epochs(corrected, rows), take_epochs(ranges, rows), take_epochs(of_all, rows)
            return code_and_phase(*given, index.trajectory, constrained.arc_m[rows], config, state or CarrierState())

        phase, carriers = antennas.each_with_state(own_phase, carriers)
        arc, exact, total, variance = phase.arc_m, phase.noise_sigma_m, phase.sigma_m, scale**2
        # the integer solution's noise includes satellite and atmospheric errors
        nominal = np.where(phase.n_fixed > 0, 0.0, nominal)
    along = np.sqrt(variance * exact**2 + (total**2 - exact**2) + nominal)
    judged = own if phase is None else along
    along = np.sqrt(along**2 + _ambiguity_variance_m2(ranges, antennas, fix, arc, config))
    return PublishedPositions(arc, along, own, judged, phase), carriers


def _nominal_variance_m2(model: LinearModel, nominal_elevation_sigma_m: Floats) -> Floats:
    """Return the along-line variance of satellite and atmospheric errors that are not in the range sigmas [m^2]."""
    share = (
        model.gain_m[..., 0] * model.root_weight * np.where(model.used, np.fmax(nominal_elevation_sigma_m, 0.0), 0.0)
    )
    return channel_sums(share**2)


def _ambiguity_variance_m2(ranges: Ranges, antennas: AntennaRows, fix: LineFix, arc: Floats, config: Config) -> Floats:
    """Return the squared distance to the best alternative, times the alternative's probability, shape (T,) [m^2].

    The probability is ``1/(1 + exp(x/2))``, where x is `Section.excess` (equal priors, normal noise).
    """
    section, square = fix.section, np.zeros(len(ranges))
    open_ones = (section.other_vertex >= 0) & (section.excess <= config.section.threshold) & np.isfinite(arc)
    for index, rows in antennas.split(open_ones.nonzero()[0]):
        line, vertex = index.trajectory, section.other_vertex[rows]
        other = position_on_line(ranges.take(rows), line, vertex, limits=config.constrained)
        apart = line.at_arc(other.arc_m) - line.at_arc(arc[rows])
        square[rows] = np.nan_to_num((apart**2).sum(axis=1)) * scipy.special.expit(-section.excess[rows] / 2.0)
    return square


def _status(
    observed: Masks,
    counts: tuple[Integers, Integers],
    solution: Solution,
    sigma: Floats,
    failed: tuple[Masks, Masks, Masks],
    config: Config,
) -> Codes:
    """Return the status of each epoch, shape (T,), by the most serious condition that applies.

    `counts` has the numbers of used and of redundant ranges. `failed` has three masks: epochs whose ranges contradict
    the map, epochs whose ranges are inconsistent, and epochs with other possible positions. The shapes are (T,).
    """
    off_map, inconsistent, open_elsewhere = failed
    (n_used, redundancy), constrained, section = counts, solution.fix.constrained, solution.fix.section
    conditions = [
        (~observed, Status.NO_OBSERVATION),
        ((n_used < config.min_satellites) | (redundancy < 0), Status.TOO_FEW_SATELLITES),
        (constrained.dilution > config.dilution_limit, Status.UNOBSERVABLE),
        (~np.isfinite(solution.arc_m), Status.NO_CONVERGENCE),
        (off_map, Status.OFF_MAP),
        (beyond_threshold(solution.map_offset, config.map_offset), Status.MAP_OFFSET),
        (inconsistent, Status.INCONSISTENT),
        (sigma > config.largest_sigma_m, Status.UNCERTAIN),
        (
            (section.excess <= config.section.threshold) | (redundancy < config.section.redundancy) | open_elsewhere,
            Status.AMBIGUOUS,
        ),
        (constrained.overshoot_m > 0.0, Status.MAP_END),
    ]
    status = np.full(len(observed), Status.OK, dtype=np.int8)
    for condition, value in reversed(conditions):
        status[condition] = value
    return status
