"""Positions of antennas: conventional and on the line, with faults excluded, sigma, level and status.

The stages in their order (P1 figure 1): 3-D position, inter-system biases, section search, constrained fix, persistent
biases and single faults, noise scale, test of the map, protection level, carrier phase, status.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
import scipy

from railfix.core.arrays import Bits, Codes, Floats, Integers, Masks, copy_with, patch_rows
from railfix.core.constants import CLOCK_GROUP
from railfix.core.epoch_rows import take_epochs
from railfix.core.reasons import Reason, Status
from railfix.integrity.fault_exclusion import RaimResult, add_p4_level, compute_statistic, exclude_faults
from railfix.integrity.persistent_biases import BiasLimits, reject_persistent_biases
from railfix.integrity.point_validation import validate_point
from railfix.integrity.protection.araim import AraimResult
from railfix.integrity.raim import LinearModel
from railfix.integrity.raim.model import update_model
from railfix.pipeline.carrier_stage import CarrierState, code_and_phase
from railfix.pipeline.config import OFF_MAP_S, Config
from railfix.pipeline.level_stage import ProtectionResult, RaimPositions, level_stage
from railfix.pipeline.off_map import OffMapState, off_map_epochs
from railfix.pipeline.range_stage import fit_ranges, reject
from railfix.pipeline.state import AntennaState
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.carrier import PhasePositions, Slips
from railfix.positioning.inter_system import TieLimits, tie_constellations
from railfix.positioning.line_fix import LineFix, fix_on_line
from railfix.positioning.map_offset import (
    LinePositions,
    MapOffset,
    OffsetErrors,
    beyond_threshold,
    map_offset,
    offset_from_line,
)
from railfix.positioning.normal_equations import SinglePoint, misfit, point_position, position_on_line
from railfix.positioning.range_arrays import UNTIED_M, InterSystemBiases, Ranges, without
from railfix.positioning.receiver_noise import (
    LastingErrorState,
    NoiseState,
    RobustFit,
    epoch_sigma_m,
    epoch_variance,
    noise_scale,
    robust_on_line,
)
from railfix.positioning.search_index import SearchIndex
from railfix.positioning.windows import Windows
from railfix.ranges.corrected import CorrectedRanges


def satellites_rejected(member: Integers, reason: Bits) -> Integers:
    """Return the number of satellites with a code of which no signal was used, shape (T,) (`Channels.member`)."""
    of_satellite = member.astype(np.float32)  # small counts are exact, and floats are multiplied in blocks
    seen = ((reason & Reason.NOT_OBSERVED) == 0).astype(np.float32) @ of_satellite > 0
    used = (reason == 0).astype(np.float32) @ of_satellite > 0
    return np.asarray((seen & ~used).sum(axis=1), dtype=np.int64)


@dataclass(frozen=True, kw_only=True)
class Solution:
    """Positions of one antenna, T epochs, before coordinates are dropped because of their status."""

    point: SinglePoint  #: Conventional position: every constellation with a separate clock.
    #: 3-D positions of the ranges that agree, without excluded ones; NaN where they contradict each other; (T, 3).
    consistent_ecef_m: Floats
    point_status: Codes  #: `railfix.integrity.PointStatus`, shape (T,).
    fix: LineFix  #: Positions from the codes, after exclusions.
    ties: InterSystemBiases  #: Inter-system biases known before each epoch.
    raim: RaimResult
    status: Codes  #: `reasons.Status`, shape (T,).
    #: Shape (T,).
    noise_scale: Floats
    own_sigma_m: Floats
    #: Position that is published: from the codes, or from code and phase; shape (T,).
    arc_m: Floats
    along_sigma_m: Floats

    phase: PhasePositions | None
    protection: ProtectionResult | None
    map_offset: MapOffset
    off_map: Masks  #: The train is away from the line: `railfix.pipeline.off_map`; shape (T,).
    #: Result of `railfix.pipeline.level_stage`, which follows; None without an integrity support message.
    araim: AraimResult | None = None


def position_stage(
    corrected: CorrectedRanges,
    slips: Slips | None,
    antennas: AntennaRows,
    config: Config,
    states: Sequence[AntennaState],
) -> tuple[CorrectedRanges, Solution, list[AntennaState]]:
    """Return the ranges with the reasons of this stage, the positions, and the new state of each antenna.

    The ranges are those after the screens of the observations, the states by antenna.
    """
    time = corrected.time
    points, offsets = tie_constellations(
        time, corrected.channels.clocks, fit_ranges(corrected), corrected.near_ecef_m,
        [state.offsets for state in states], reference=CLOCK_GROUP[config.systems[0]], parts=antennas.parts,
        limits=TieLimits(config.single_point, config.robust_fit, config.clock_offsets),
    )  # fmt: skip
    corrected = reject(corrected, points.gross, Reason.GROSS_ERROR)
    fix = fix_on_line(points.ranges, antennas, points.tied, config.fix_limits)
    corrected = reject(corrected, _alone_on_clock(corrected, points.ties), Reason.ALONE_ON_ITS_CLOCK)
    checked, noise = check_ranges(corrected, points.ranges, antennas, fix, config, states)
    corrected, fix, model, scale = checked.corrected, checked.fix, checked.model, checked.scale
    constrained = fix.constrained
    # ranges that contradict each other in space contradict every map
    unresolved = corrected.unsure | _contradict(fix.point, checked.ranges, scale)
    on_map, off_map = np.isfinite(constrained.arc_m) & ~checked.off_map, checked.off_map & ~unresolved
    excluded = checked.lasting | checked.raim.excluded
    agreeing, free = _consistent(points.agreeing, points.free, excluded, corrected, scale, config)
    away, off_map_states = _find_absence(corrected, antennas, constrained.arc_m, (on_map, off_map), free.ecef_m, states)
    offset, map_states = map_offset(
        time, agreeing, free, OffsetErrors(corrected.nominal_m, np.maximum(scale, 1.0) ** 2), antennas,
        LinePositions(constrained.arc_m, away), [state.map_offset for state in states], limits=config.map_offset,
    )  # fmt: skip
    raim = checked.raim
    if "raim" in config.screens and config.raim_protection == "on":
        raim = add_p4_level(raim, model, scale, limits=config.raim)
    corrected = reject(corrected, raim.excluded, Reason.FAULT_EXCLUDED)
    checked = checked._replace(corrected=corrected, raim=raim)
    positions = RaimPositions(checked.ranges, fix, model, raim, scale)
    level, open_elsewhere = level_stage(corrected, positions, antennas, offset, config)
    sigma, carriers = _published(checked, slips, antennas, config, [state.carrier for state in states])
    solution = Solution(
        point=points.point, consistent_ecef_m=free.ecef_m,
        point_status=validate_point(points.point, points.untied, scale, limits=config.single_point),
        fix=fix, ties=points.ties, raim=raim, status=np.zeros(len(time), dtype=np.int8), noise_scale=scale,
        own_sigma_m=sigma.own_m, arc_m=sigma.arc_m, along_sigma_m=sigma.along_m, phase=sigma.phase, protection=level,
        map_offset=offset, off_map=away,
    )  # fmt: skip
    if sigma.phase is not None:
        off_map = _off_map(checked.ranges, antennas, fix, sigma.arc_m, config) & ~unresolved
    observed = np.asarray(np.isfinite(corrected.code_m).any(axis=1))
    inconsistent = raim.faulty | unresolved
    solution = copy_with(
        solution,
        status=_status(
            observed, checked.ranges, solution, sigma.judged_m, (off_map, inconsistent, open_elsewhere), config
        ),
    )
    after = [
        copy_with(
            state, offsets=offsets[k], noise=noise.stated[k], lasting=noise.lasting[k], map_offset=map_states[k],
            off_map=off_map_states[k], carrier=carriers[k],
        )
        for k, state in enumerate(states)
    ]  # fmt: skip
    return corrected, solution, after


def _find_absence(
    corrected: CorrectedRanges, antennas: AntennaRows, arc_m: Floats, verdicts: tuple[Masks, Masks], ecef_m: Floats,
    states: Sequence[AntennaState],
) -> tuple[Masks, list[OffMapState]]:  # fmt: skip
    """Return the epochs at which the train is away from the line, shape (T,), and the states of `off_map_epochs`.

    `verdicts`: positions that the ranges fit, and that they contradict, shape (T,); 3-D positions of shape (T, 3).
    """
    (on_map, off_map), right_m = verdicts, offset_from_line(ecef_m, arc_m, antennas)[:, 0]
    time = corrected.time

    def of_antenna(_: SearchIndex, rows: slice, state: AntennaState) -> tuple[Masks, OffMapState]:
        return off_map_epochs(
            time[rows], on_map[rows], off_map[rows], right_m[rows], state.off_map, least_s=OFF_MAP_S
        )  # fmt: skip

    return antennas.each_with_state(of_antenna, states)


def _alone_on_clock(corrected: CorrectedRanges, ties: InterSystemBiases) -> Masks:
    """Return the satellites that are the only ones of a clock without a known bias, shape (T, K)."""
    alone = np.zeros(corrected.reason.shape, dtype=bool)
    for g, group in enumerate(corrected.channels.groups):
        used = corrected.reason[:, group] == 0
        lone = (used.sum(axis=1) == 1) & (ties.sigma_m[:, g] >= UNTIED_M)
        alone[:, group] = used & lone[:, None]
    return alone


class CheckedRanges(NamedTuple):
    """Positions after the exclusion of faults, T epochs."""

    corrected: CorrectedRanges
    ranges: Ranges
    fix: LineFix
    model: LinearModel  #: Of the positions.
    raim: RaimResult
    scale: Floats  #: Noise scale of the receiver, shape (T,).
    off_map: Masks  #: Epochs whose ranges contradict the map, shape (T,).
    lasting: Masks  #: Satellites that are wrong for long, shape (T, K).


class NoiseStates(NamedTuple):
    """New states of the noise scales and of the persistent biases, by antenna."""

    stated: list[NoiseState]
    lasting: list[LastingErrorState]


def check_ranges(
    corrected: CorrectedRanges,
    ranges: Ranges,
    antennas: AntennaRows,
    fix: LineFix,
    config: Config,
    states: Sequence[AntennaState],
) -> tuple[CheckedRanges, NoiseStates]:
    """Return positions without satellites that are wrong for long, then without single faults, and noise scales.

    The robust scale, which RAIM tests with, is estimated from ranges that agree with each other; the stated one from
    those that RAIM accepted.
    """
    time, near = corrected.time, corrected.near_ecef_m
    on, noises = "raim" in config.screens, [state.noise for state in states]
    learning, least = config.noise_scale, 1.0 if config.sbas else 0.0  # SBAS states overbounds
    windows = Windows.of(
        time, antennas.parts, [(noise.time, noise.age) for noise in noises],
        window_s=learning.window_s, least_epochs=learning.least_epochs,
    )  # fmt: skip

    def robust_scale(fitted: RobustFit, usable: Masks, sums: list[Floats]) -> tuple[Floats, Floats]:
        wsse, one = fitted.variance * fitted.freedom, np.ones(len(time))
        return noise_scale(
            windows, wsse, fitted.freedom, usable, one, np.array(sums), limits=learning, least=least
        )  # fmt: skip

    def fit_on_line() -> tuple[RobustFit, Masks]:
        found = robust_on_line(ranges, antennas, fix.constrained, near_ecef_m=near, limits=config.robust_fit)
        arc = fix.constrained.arc_m
        usable = np.isfinite(arc) & ~corrected.unsure & ~(found.variance > _LARGEST_VARIANCE)
        return found, usable & ~_off_map(ranges, antennas, fix, arc, config)

    on_line, usable = fit_on_line()
    raised, raised_sums = robust_scale(on_line, usable, [state.lasting.noise for state in states])
    limits = config.lasting_errors if on else config.lasting_errors.replaced(most_satellites=0)
    (ranges, fix, model, lasting), lasting_states = reject_persistent_biases(
        time, corrected.channels.names, ranges, antennas, fix, raised, [state.lasting for state in states],
        BiasLimits(limits, config.fix_limits),
    )  # fmt: skip
    if lasting.any():
        corrected = reject(corrected, lasting, Reason.LASTING_ERROR)
        on_line, usable = fit_on_line()
    robust, robust_sums = robust_scale(on_line, usable, [noise.robust for noise in noises])
    if on:
        ranges, fix, raim = exclude_faults(
            ranges, antennas, fix, scale=robust, agreeing=on_line.kept, model=model, limits=config.raim,
            fix_limits=config.fix_limits,
        )  # fmt: skip
        model = update_model(model, ranges, antennas, fix.constrained, np.flatnonzero(raim.excluded.any(axis=1)))
    else:
        raim = compute_statistic(ranges, fix, robust, limits=config.raim)
    off_map = _off_map(ranges, antennas, fix, fix.constrained.arc_m, config)
    noisy = fix.constrained.wsse > _LARGEST_VARIANCE * np.maximum(ranges.redundancy, 1)
    usable = ~(off_map | raim.faulty | corrected.unsure | noisy) & on
    scale, stated_sums = noise_scale(
        windows, fix.constrained.wsse, ranges.redundancy, usable, robust,
        np.array([noise.remaining for noise in noises]), limits=learning, least=least,
    )  # fmt: skip
    stated = [
        NoiseState(time=when, age=age, robust=robust_sums[k], remaining=stated_sums[k])
        for k, (when, age) in enumerate(windows.last)
    ]
    lasting_states = [copy_with(state, noise=raised_sums[k]) for k, state in enumerate(lasting_states)]
    return CheckedRanges(corrected, ranges, fix, model, raim, scale, off_map, lasting), NoiseStates(
        stated, lasting_states
    )


#: Larger variances of an epoch's ranges against their weights are errors, not noise: 100 sigmas.
_LARGEST_VARIANCE: Final = 1e4
#: Ratio of the variance of an epoch's ranges in 3-D to that of the receiver from which on they contradict each other.
_CONTRADICT: Final = 25.0


def _consistent(
    agreeing: Ranges, free: SinglePoint, excluded: Masks, corrected: CorrectedRanges, scale: Floats, config: Config
) -> tuple[Ranges, SinglePoint]:
    """Return ranges and 3-D positions for the test of the map: without the `excluded` satellites where all ranges
    together contradict each other, NaN where they still do or the wrong one cannot be identified.
    """
    wrong = excluded & (agreeing.weight > 0) & _contradict(free, agreeing, scale)[:, None]
    changed = np.flatnonzero(wrong.any(axis=1))
    if len(changed):
        agreeing = without(agreeing, wrong)
        start = np.where(np.isnan(free.ecef_m), corrected.near_ecef_m, free.ecef_m)[changed]
        solved = point_position(agreeing.take(changed), start, limits=config.single_point)
        free = patch_rows(free, changed, solved)
    unusable = corrected.unsure | _contradict(free, agreeing, scale)
    return agreeing, copy_with(free, ecef_m=np.where(unusable[:, None], np.nan, free.ecef_m))


def _contradict(point: SinglePoint, ranges: Ranges, scale: Floats) -> Masks:
    """Return the epochs whose ranges contradict each other in space, shape (T,)."""
    freedom = np.maximum(ranges.n_used - ranges.n_clocks - 3, 1)
    return np.asarray(point.wsse > _CONTRADICT * freedom * np.maximum(scale, 1.0) ** 2)


class PublishedPositions(NamedTuple):
    """Positions that are published, T epochs: from the codes, or from code and phase; shape (T,) each."""

    arc_m: Floats
    along_m: Floats  #: Standard deviation along the line.
    own_m: Floats  #: Single-epoch sigma.
    judged_m: Floats  #: Sigma that is compared with `Config.largest_sigma_m`.
    phase: PhasePositions | None


def _published(
    checked: CheckedRanges,
    slips: Slips | None,
    antennas: AntennaRows,
    config: Config,
    carriers: Sequence[CarrierState | None],
) -> tuple[PublishedPositions, Sequence[CarrierState | None]]:
    """Return the positions with their standard deviations, and the states of the carrier phases."""
    corrected, ranges, fix, scale = checked.corrected, checked.ranges, checked.fix, checked.scale
    constrained = fix.constrained
    own = epoch_sigma_m(ranges.redundancy, constrained.wsse, constrained.exact_map_sigma_m, scale)
    arc, exact, total = constrained.arc_m, constrained.exact_map_sigma_m, constrained.sigma_m
    variance = epoch_variance(scale, constrained.wsse, ranges.redundancy, limits=config.noise_scale)
    nominal, phase = _nominal_variance_m2(checked.model, corrected.nominal_elevation_sigma_m), None
    if config.carrier in ("float", "fixed"):
        assert slips is not None, "found where the carrier phase is used"
        of_all = slips

        def own_phase(
            index: SearchIndex, rows: slice, state: CarrierState | None
        ) -> tuple[PhasePositions, CarrierState]:
            given = take_epochs(corrected, rows), take_epochs(ranges, rows), take_epochs(of_all, rows)
            return code_and_phase(*given, index.trajectory, constrained.arc_m[rows], config, state or CarrierState())

        phase, carriers = antennas.each_with_state(own_phase, carriers)
        arc, exact, total, variance = phase.arc_m, phase.noise_sigma_m, phase.sigma_m, scale**2
        nominal = np.where(phase.n_fixed > 0, 0.0, nominal)  # satellites and atmosphere are in the integers' noise
    along = np.sqrt(variance * exact**2 + (total**2 - exact**2) + nominal)
    judged = own if phase is None else along
    along = np.sqrt(along**2 + _ambiguity_variance_m2(ranges, antennas, fix, arc, config))
    return PublishedPositions(arc, along, own, judged, phase), carriers


def _nominal_variance_m2(model: LinearModel, nominal_elevation_sigma_m: Floats) -> Floats:
    """Return the variance along the line by satellites and atmosphere, where the ranges' sigmas leave them out."""
    share = (
        model.gain_m[..., 0] * model.root_weight * np.where(model.used, np.fmax(nominal_elevation_sigma_m, 0.0), 0.0)
    )
    return np.asarray(np.einsum("tk,tk->t", share, share))


def _ambiguity_variance_m2(ranges: Ranges, antennas: AntennaRows, fix: LineFix, arc: Floats, config: Config) -> Floats:
    """Return the mean square distance to the best other position of ambiguous epochs, shape (T,).

    The other position fits worse by the excess x, so that it is the true one with the probability ``1/(1 + exp(x/2))``
    (normal likelihoods, equal priors).
    """
    section, square = fix.section, np.zeros(len(ranges))
    open_ones = (section.other_vertex >= 0) & (section.excess <= config.section.threshold) & np.isfinite(arc)
    for index, rows in antennas.split(open_ones.nonzero()[0]):
        line, vertex = index.trajectory, section.other_vertex[rows]
        other = position_on_line(ranges.take(rows), line, vertex, limits=config.constrained)
        apart = line.at_arc(other.arc_m) - line.at_arc(arc[rows])
        square[rows] = np.nan_to_num((apart**2).sum(axis=1)) * scipy.special.expit(-section.excess[rows] / 2.0)
    return square


@lru_cache
def _chi_square_limit(risk: float, freedom: int) -> float:
    """Return the chi-square value that noise exceeds with a probability of `risk`."""
    return float(scipy.special.chdtri(freedom, risk))


def _off_map(ranges: Ranges, antennas: AntennaRows, fix: LineFix, arc: Floats, config: Config) -> Masks:
    """Return the epochs whose ranges contradict the map at the position, or pull it beyond an end, shape (T,).

    The line fits worse than the 3-D position, in variances that the 3-D fit itself shows (1 at least): the misfit of
    the line must not be measured by itself.
    """
    point, constrained = fix.point, fix.constrained
    wsse = constrained.wsse
    if arc is not constrained.arc_m:
        known = np.isfinite(arc)
        position = np.where(known[:, None], antennas.at_arc(arc), 0.0)
        wsse = np.where(known, misfit(ranges, position), np.nan)
    freedom = ranges.n_used - ranges.n_clocks - 3
    shown = np.maximum(1.0, point.wsse / np.maximum(freedom, 1))
    lost = (freedom >= 1) & ((wsse - point.wsse) / shown > _chi_square_limit(config.off_map_risk, 2))
    beyond = constrained.overshoot_m > np.maximum(4.0 * constrained.sigma_m, antennas.sigma_plan_m)
    return np.asarray(lost | beyond)


def _status(
    observed: Masks,
    ranges: Ranges,
    solution: Solution,
    sigma: Floats,
    failed: tuple[Masks, Masks, Masks],
    config: Config,
) -> Codes:
    """Return the status of each epoch, shape (T,): the first condition that is true, the most serious first.

    `failed`: ranges that contradict the map, or each other, and other possible positions; shape (T,) each.
    """
    off_map, inconsistent, open_elsewhere = failed
    redundancy, constrained, section = ranges.redundancy, solution.fix.constrained, solution.fix.section
    conditions = [
        (~observed, Status.NO_OBSERVATION),
        ((ranges.n_used < config.min_satellites) | (redundancy < 0), Status.TOO_FEW_SATELLITES),
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
    status = np.full(len(ranges), Status.OK, dtype=np.int8)
    for condition, value in reversed(conditions):
        status[condition] = value
    return status
