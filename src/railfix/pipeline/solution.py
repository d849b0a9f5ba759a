"""Positions of antennas: conventional and on the line, with faults excluded, sigma, level and status."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from scipy.special import chdtri, expit

from railfix.core.arrays import Bits, Codes, Floats, Integers, Masks, copy_with, patch_rows
from railfix.core.constants import CLOCK_GROUP
from railfix.core.epoch_rows import take_epochs
from railfix.core.reasons import Reason, Status
from railfix.integrity.protection.araim import AraimResult
from railfix.integrity.raim import LinearModel
from railfix.pipeline.carrier_stage import CarrierState, code_and_phase
from railfix.pipeline.config import OFF_MAP_S, Config
from railfix.pipeline.corrected_ranges import CorrectedRanges, without
from railfix.pipeline.level_stage import (
    ProtectionResult,
    bounding_model,
    low_sides,
    protection_levels,
    unresolved_alternatives,
)
from railfix.pipeline.off_map import OffMapState, off_map_epochs
from railfix.pipeline.solve import (
    Place,
    RaimResult,
    count_redundancy,
    fault_free,
    lasting_errors,
    model_again,
    place_on_lines,
    validate_point,
    with_p4_level,
)
from railfix.pipeline.state import AntennaState
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.carrier import PhasePositions
from railfix.positioning.gross_errors import gross_alone
from railfix.positioning.map_offset import LinePositions, MapOffset, OffsetErrors, beyond_threshold, map_offset
from railfix.positioning.noise_scale import (
    NoiseState,
    RobustFit,
    compute_information,
    epoch_variance,
    noise_scale,
    own_sigma_m,
    robust_fit,
    tie_clocks,
)
from railfix.positioning.normal_equations import (
    UNTIED_M,
    ClockTies,
    Ranges,
    SinglePoint,
    constrained_position,
    fit,
    single_point,
)
from railfix.positioning.section_search import SearchIndex
from railfix.positioning.windows import Windows


def reason_of_all_channels(corrected: CorrectedRanges) -> Bits:
    """Return the reasons of all channels of the observations, shape (T, M)."""
    not_observed = ~np.isfinite(corrected.observations.code_m) * np.int64(Reason.NOT_OBSERVED)
    reason = np.asarray(not_observed | corrected.channels.left_out)
    reason[:, corrected.columns] = corrected.reason
    second, found = corrected.second, corrected.combined
    if second is not None and found is not None:
        epoch, channel = np.nonzero(np.isfinite(found.share))
        reason[epoch, second.column[epoch, channel]] = corrected.reason[epoch, channel]
    return reason


def alone_on_their_clocks(corrected: CorrectedRanges, ties: ClockTies) -> Masks:
    """Return the satellites that are the only ones of a clock without a known bias, shape (T, K)."""
    alone = np.zeros(corrected.reason.shape, dtype=bool)
    for g, group in enumerate(corrected.groups):
        used = corrected.reason[:, group] == 0
        lone = (used.sum(axis=1) == 1) & (ties.sigma_m[:, g] >= UNTIED_M)
        alone[:, group] = used & lone[:, None]
    return alone


def satellites_rejected(member: Integers, reason: Bits) -> Integers:
    """Return the number of satellites with a code of which no signal was used, shape (T,) (`Channels.member`)."""
    of_satellite = member.astype(np.float32)  # small counts are exact, and floats are multiplied in blocks
    seen = ((reason & Reason.NOT_OBSERVED) == 0).astype(np.float32) @ of_satellite > 0
    used = (reason == 0).astype(np.float32) @ of_satellite > 0
    return np.asarray((seen & ~used).sum(axis=1), dtype=np.int64)


@dataclass(frozen=True, kw_only=True)
class Solution:
    """Positions of one antenna, T epochs, before coordinates are dropped where the status says so."""

    point: SinglePoint  #: Conventional position: every constellation with a clock of its own.
    #: 3-D positions of the ranges that agree, without excluded ones; NaN where they contradict each other; (T, 3).
    consistent_ecef_m: Floats
    point_status: Codes  #: `railfix.pipeline.solve.PointStatus`, shape (T,).
    place: Place  #: Positions from the codes, after exclusions.
    ties: ClockTies  #: Inter-system biases known before each epoch.
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
    #: Of `railfix.pipeline.level_stage`, which comes after; None without an integrity support message.
    araim: AraimResult | None = None


def solve(
    corrected: CorrectedRanges, antennas: AntennaRows, config: Config, states: Sequence[AntennaState]
) -> tuple[CorrectedRanges, Solution, list[AntennaState]]:
    """Return the ranges with the reasons of this stage, the positions, and the new state of each antenna.

    The ranges are those after the screens of the observations, the states by antenna.
    """
    ranges, time = corrected.ranges(), corrected.time
    point = single_point(ranges, corrected.anchor_ecef_m, limits=config.single_point)
    agreeing, free = _agreeing(ranges, point, corrected.anchor_ecef_m, config)
    reference = CLOCK_GROUP[config.systems[0]]
    offset_states = [state.offsets for state in states]
    ties, offsets = tie_clocks(
        time, corrected.clocks, reference, agreeing, free, offset_states,
        parts=antennas.parts, limits=config.clock_offsets,
    )  # fmt: skip
    alone = gross_alone(ranges, point.clock_m, ties)
    if alone.any():
        corrected, ranges = corrected.reject(alone, Reason.GROSS_ERROR), without(ranges, alone)
    tied, untied = point, ranges
    if len(corrected.groups) > 1:
        ranges = replace(ranges, ties=ties)
        tied = _tie(ranges, ties, point, corrected.anchor_ecef_m, config)
    place = place_on_lines(ranges, antennas, tied, config)
    corrected = corrected.reject(alone_on_their_clocks(corrected, ties), Reason.ALONE_ON_ITS_CLOCK)
    learning, noises = config.noise_scale, [state.noise for state in states]
    windows = Windows.of(
        time, antennas.parts, [(noise.time, noise.age) for noise in noises],
        window_s=learning.window_s, least_epochs=learning.least_epochs,
    )  # fmt: skip
    least = 1.0 if config.sbas else 0.0  # SBAS states overbounds, which quiet residuals do not shrink

    def robust_scale(sums: list[Floats]) -> tuple[Floats, Floats]:
        wsse, one = on_line.variance * on_line.freedom, np.ones(len(time))
        return noise_scale(
            windows, wsse, on_line.freedom, usable_for_noise, one, np.array(sums), limits=learning, least=least
        )  # fmt: skip

    on_line, usable_for_noise = _fit_on_line(corrected, ranges, antennas, place, config)
    raised, raised_sums = robust_scale([state.lasting.noise for state in states])
    ranges, place, model, lasting, lasting_states = lasting_errors(
        corrected, ranges, antennas, place, raised, config, [state.lasting for state in states]
    )
    if lasting.any():
        corrected = corrected.reject(lasting, Reason.LASTING_ERROR)
        on_line, usable_for_noise = _fit_on_line(corrected, ranges, antennas, place, config)
    robust, robust_sums = robust_scale([noise.robust for noise in noises])
    ranges, place, raim = fault_free(ranges, antennas, place, model, robust, on_line.kept, config)
    constrained, redundancy = place.constrained, count_redundancy(ranges)
    model = model_again(model, ranges, antennas, constrained, np.flatnonzero(raim.excluded.any(axis=1)))
    off_map = _off_map(ranges, antennas, place, constrained.arc_m, config)
    noisy = constrained.wsse > _LARGEST_VARIANCE * np.maximum(redundancy, 1)
    usable_for_noise = ~(off_map | raim.faulty | corrected.unsure | noisy)
    if "raim" not in config.screens:
        usable_for_noise[:] = False
    scale, stated_sums = noise_scale(
        windows, constrained.wsse, redundancy, usable_for_noise, robust,
        np.array([noise.remaining for noise in noises]), limits=learning, least=least,
    )  # fmt: skip
    on_map = np.isfinite(constrained.arc_m) & ~off_map

    def own_absence(_: SearchIndex, rows: slice, state: AntennaState) -> tuple[Masks, OffMapState]:
        return off_map_epochs(time[rows], on_map[rows], off_map[rows], state.off_map, least_s=OFF_MAP_S)

    away, off_map_states = antennas.each_with_state(own_absence, states)
    agreeing, free = _consistent(agreeing, free, lasting | raim.excluded, corrected, scale, config)
    offset, map_states = map_offset(
        time, agreeing, free, OffsetErrors(corrected.nominal_m, np.maximum(scale, 1.0) ** 2), antennas,
        LinePositions(constrained.arc_m, away), [state.map_offset for state in states], limits=config.map_offset,
    )  # fmt: skip
    if "raim" in config.screens and config.raim_protection == "on":
        raim = with_p4_level(raim, model, scale, config)
    corrected = corrected.reject(raim.excluded, Reason.FAULT_EXCLUDED)
    level, open_elsewhere = None, np.zeros(len(ranges), dtype=bool)
    if config.protection == "on" and config.carrier not in ("float", "fixed"):
        section = np.maximum(constrained.section, 0)
        heading = antennas.each(lambda index, rows: index.trajectory.heading_deg[section[rows]])
        sides = low_sides(corrected, heading, config.risk.side_elevation_deg)
        level = protection_levels(corrected, model, offset, raim, scale, sides, config)
        bounding = (model, scale)
        if config.error_model is not None:
            bounding = bounding_model(corrected, ranges, antennas, place, scale)
        open_elsewhere = unresolved_alternatives(corrected, antennas, place, bounding, level, sides, config)
    own_sigma = own_sigma_m(redundancy, constrained.wsse, constrained.exact_map_sigma_m, scale)
    arc, exact, total = constrained.arc_m, constrained.exact_map_sigma_m, constrained.sigma_m
    variance = epoch_variance(scale, constrained.wsse, redundancy, limits=config.noise_scale)
    nominal = _nominal_variance_m2(model, corrected)
    phase, carriers = None, [state.carrier for state in states]
    if config.carrier in ("float", "fixed"):

        def own_phase(
            index: SearchIndex, rows: slice, state: CarrierState | None
        ) -> tuple[PhasePositions, CarrierState]:
            own = take_epochs(corrected, rows), take_epochs(ranges, rows)
            return code_and_phase(*own, index.trajectory, constrained.arc_m[rows], config, state or CarrierState())

        phase, carriers = antennas.each_with_state(own_phase, carriers)
        arc, exact, total, variance = phase.arc_m, phase.noise_sigma_m, phase.sigma_m, scale**2
        nominal = np.where(phase.n_fixed > 0, 0.0, nominal)  # satellites and atmosphere are in the integers' noise
    along_sigma = np.sqrt(variance * exact**2 + (total**2 - exact**2) + nominal)
    judged = own_sigma if phase is None else along_sigma
    along_sigma = np.sqrt(along_sigma**2 + _ambiguity_variance_m2(ranges, antennas, place, arc, config))
    if phase is not None:
        off_map = _off_map(ranges, antennas, place, arc, config)
    solution = Solution(
        point=point, consistent_ecef_m=free.ecef_m,
        point_status=validate_point(point, untied, scale, limits=config.single_point), place=place,
        ties=ties, raim=raim, status=np.zeros(len(ranges), dtype=np.int8), noise_scale=scale, own_sigma_m=own_sigma,
        arc_m=arc, along_sigma_m=along_sigma, phase=phase, protection=level, map_offset=offset, off_map=away,
    )  # fmt: skip
    solution = copy_with(solution, status=_status(corrected, ranges, solution, judged, off_map, open_elsewhere, config))
    after = []
    for k, (state, (when, age)) in enumerate(zip(states, windows.last, strict=True)):
        noise = NoiseState(time=when, age=age, robust=robust_sums[k], remaining=stated_sums[k])
        after.append(
            copy_with(
                state, offsets=offsets[k], noise=noise, map_offset=map_states[k], off_map=off_map_states[k],
                lasting=copy_with(lasting_states[k], noise=raised_sums[k]), carrier=carriers[k],
            )
        )  # fmt: skip
    return corrected, solution, after


def _tie(ranges: Ranges, ties: ClockTies, point: SinglePoint, anchor_ecef_m: Floats, config: Config) -> SinglePoint:
    """Return the 3-D positions with the clocks tied; those with free clocks where no bias is known yet."""
    rows = ((ties.sigma_m < UNTIED_M).sum(axis=1) > 1).nonzero()[0]
    if not len(rows):
        return point
    start = np.where(np.isnan(point.ecef_m), anchor_ecef_m, point.ecef_m)
    if len(rows) == len(ranges):
        return single_point(ranges, start, limits=config.single_point)
    return patch_rows(point, rows, single_point(ranges.take(rows), start[rows], limits=config.single_point))


def _agreeing(ranges: Ranges, point: SinglePoint, anchor_ecef_m: Floats, config: Config) -> tuple[Ranges, SinglePoint]:
    """Return the ranges that agree with each other in space, and the 3-D positions from these."""
    place = np.where(np.isnan(point.ecef_m), anchor_ecef_m, point.ecef_m)
    fit = robust_fit(ranges, place, limits=config.robust_fit)
    dropped = (ranges.weight > 0) & ~fit.kept
    changed = np.flatnonzero(dropped.any(axis=1))
    if not len(changed):
        return ranges, point
    agreeing = without(ranges, dropped)
    again = single_point(agreeing.take(changed), place[changed], limits=config.single_point)
    return agreeing, patch_rows(point, changed, again)


#: Larger variances of an epoch's ranges against their weights are errors, not noise: 100 sigmas.
_LARGEST_VARIANCE: Final = 1e4
#: Probability that the residuals of consistent ranges fail the test below.
_CONSISTENT: Final = 1e-3


def _consistent(
    agreeing: Ranges, free: SinglePoint, excluded: Masks, corrected: CorrectedRanges, scale: Floats, config: Config
) -> tuple[Ranges, SinglePoint]:
    """Return ranges and 3-D positions that judge the map: without the `excluded` satellites where all ranges together
    contradict each other, NaN where they still do or nothing tells which one is wrong.
    """

    def contradict(point: SinglePoint, ranges: Ranges) -> Masks:
        freedom = np.maximum(ranges.n_used - ranges.n_clocks - 3, 1)
        return np.asarray(point.wsse > chdtri(freedom, _CONSISTENT) * np.maximum(scale, 1.0) ** 2)

    wrong = excluded & (agreeing.weight > 0) & contradict(free, agreeing)[:, None]
    changed = np.flatnonzero(wrong.any(axis=1))
    if len(changed):
        agreeing = without(agreeing, wrong)
        start = np.where(np.isnan(free.ecef_m), corrected.anchor_ecef_m, free.ecef_m)[changed]
        solved = single_point(agreeing.take(changed), start, limits=config.single_point)
        free = patch_rows(free, changed, solved)
    unusable = corrected.unsure | contradict(free, agreeing)
    return agreeing, copy_with(free, ecef_m=np.where(unusable[:, None], np.nan, free.ecef_m))


def _fit_on_line(
    corrected: CorrectedRanges, ranges: Ranges, antennas: AntennaRows, place: Place, config: Config
) -> tuple[RobustFit, Masks]:
    """Return the robust fit on the line, and the epochs whose noise is learnt from."""
    arc, section = place.constrained.arc_m, np.maximum(place.constrained.section, 0)
    known = np.isfinite(arc)
    at = np.where(known[:, None], antennas.at_arc(arc), corrected.anchor_ecef_m)
    information = compute_information(antennas.get_axes(section), antennas.sigma_plan_m, antennas.sigma_height_m)
    fit = robust_fit(ranges, at, information=information, limits=config.robust_fit)
    usable = known & ~corrected.unsure & ~(fit.variance > _LARGEST_VARIANCE)
    return fit, usable & ~_off_map(ranges, antennas, place, arc, config)


def _nominal_variance_m2(model: LinearModel, corrected: CorrectedRanges) -> Floats:
    """Return the variance along the line by satellites and atmosphere, where the ranges' sigmas leave them out."""
    share = model.gain_m[..., 0] * model.root_weight * np.where(model.used, np.fmax(corrected.unmodelled_m, 0.0), 0.0)
    return np.asarray(np.einsum("tk,tk->t", share, share))


def _ambiguity_variance_m2(ranges: Ranges, antennas: AntennaRows, place: Place, arc: Floats, config: Config) -> Floats:
    """Return the mean square distance to the best other place of ambiguous epochs, shape (T,).

    The other place fits worse by the excess x, so that it is the true one with the probability ``1/(1 + exp(x/2))``
    (normal likelihoods, neither place likelier beforehand).
    """
    section, square = place.section, np.zeros(len(ranges))
    open_ones = (section.other_vertex >= 0) & (section.excess <= config.section.threshold) & np.isfinite(arc)
    for index, rows in antennas.split(open_ones.nonzero()[0]):
        line, vertex = index.trajectory, section.other_vertex[rows]
        other = constrained_position(ranges.take(rows), line, vertex, limits=config.constrained)
        apart = line.at_arc(other.arc_m) - line.at_arc(arc[rows])
        square[rows] = np.nan_to_num((apart**2).sum(axis=1)) * expit(-section.excess[rows] / 2.0)
    return square


@lru_cache
def _chi_square_limit(risk: float, freedom: int) -> float:
    """Return the chi-square value that noise exceeds with a probability of `risk`."""
    return float(chdtri(freedom, risk))


def _off_map(ranges: Ranges, antennas: AntennaRows, place: Place, arc: Floats, config: Config) -> Masks:
    """Return the epochs whose ranges contradict the map at the position, or pull it beyond an end, shape (T,).

    The line fits worse than the 3-D position, in variances that the 3-D fit itself shows (1 at least): the misfit of
    the line must not be measured by itself.
    """
    point, constrained = place.point, place.constrained
    wsse = constrained.wsse
    if arc is not constrained.arc_m:
        known = np.isfinite(arc)
        position = np.where(known[:, None], antennas.at_arc(arc), 0.0)
        wsse = np.where(known, fit(ranges, position), np.nan)
    freedom = ranges.n_used - ranges.n_clocks - 3
    shown = np.maximum(1.0, point.wsse / np.maximum(freedom, 1))
    lost = (freedom >= 1) & ((wsse - point.wsse) / shown > _chi_square_limit(config.off_map_risk, 2))
    beyond = constrained.overshoot_m > np.maximum(4.0 * constrained.sigma_m, antennas.sigma_plan_m)
    return np.asarray(lost | beyond)


def _status(
    corrected: CorrectedRanges,
    ranges: Ranges,
    solution: Solution,
    sigma: Floats,
    off_map: Masks,
    open_elsewhere: Masks,
    config: Config,
) -> Codes:
    """Return the status of each epoch, shape (T,): the first condition that holds, the most serious first."""
    redundancy, constrained, section = count_redundancy(ranges), solution.place.constrained, solution.place.section
    conditions = [
        (~np.isfinite(corrected.code_m).any(axis=1), Status.NO_OBSERVATION),
        ((ranges.n_used < config.min_satellites) | (redundancy < 0), Status.TOO_FEW_SATELLITES),
        (constrained.dilution > config.dilution_limit, Status.UNOBSERVABLE),
        (~np.isfinite(solution.arc_m), Status.NO_CONVERGENCE),
        (off_map, Status.OFF_MAP),
        (beyond_threshold(solution.map_offset, config.map_offset), Status.MAP_OFFSET),
        (solution.raim.faulty, Status.INCONSISTENT),
        (sigma > config.largest_sigma_m, Status.UNCERTAIN),
        (
            (section.excess <= config.section.threshold) | (redundancy < config.section.redundancy) | open_elsewhere,
            Status.AMBIGUOUS,
        ),
    ]
    status = np.full(len(ranges), Status.OK, dtype=np.int8)
    for condition, value in reversed(conditions):
        status[condition] = value
    return status
