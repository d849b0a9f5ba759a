"""Positions of one antenna: conventional and on the line, with faults excluded, sigma, level and status."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.stats import chi2

from railfix.core.arrays import Codes, Floats, Masks
from railfix.core.constants import CLOCK_GROUP
from railfix.core.reasons import Reason, Status
from railfix.integrity.raim import Outcome
from railfix.pipeline.carrier_phase import CarrierState, code_and_phase
from railfix.pipeline.config import Config
from railfix.pipeline.corrected_ranges import CorrectedRanges
from railfix.pipeline.fault_exclusion import fault_free, with_p4_level
from railfix.pipeline.protection_levels import protection_levels
from railfix.pipeline.reason_table import alone_on_their_clocks
from railfix.pipeline.results import AntennaState, ProtectionResult, RaimResult
from railfix.pipeline.solve import Place, place_on_line, redundancy_of
from railfix.positioning.carrier import PhasePositions
from railfix.positioning.intersystem_bias import tie_clocks
from railfix.positioning.noise_scale import noise_scale, own_sigma_m
from railfix.positioning.normal_equations import ClockTies, Ranges, fit
from railfix.positioning.section_search import PredictedPlace, SearchIndex
from railfix.positioning.single_point import SinglePoint, single_point
from railfix.track.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class Solution:
    """Positions of one antenna, T epochs, before coordinates are dropped where the status says so.

    Attributes
    ----------
    point : SinglePoint
        Conventional position: every constellation with a clock of its own.
    place : Place
        Positions from the codes, after exclusions.
    ties : ClockTies
        Inter-system biases known before each epoch.
    raim : RaimResult
    status : ndarray of int8, shape (T,)
        `reasons.Status`.
    noise_scale, own_sigma_m : ndarray, shape (T,)
    arc_m, along_sigma_m : ndarray, shape (T,) [m]
        Position that is published: from the codes, or from code and phase.
    phase : PhasePositions or None
    protection : ProtectionResult or None
    """

    point: SinglePoint
    place: Place
    ties: ClockTies
    raim: RaimResult
    status: Codes
    noise_scale: Floats
    own_sigma_m: Floats
    arc_m: Floats
    along_sigma_m: Floats
    phase: PhasePositions | None
    protection: ProtectionResult | None


def solve(
    corrected: CorrectedRanges,
    index: SearchIndex,
    config: Config,
    state: AntennaState,
    *,
    predicted: PredictedPlace | None = None,
) -> tuple[CorrectedRanges, Solution, AntennaState]:
    """Return the positions of one antenna, its ranges with the reasons of this stage, and its new state.

    Parameters
    ----------
    corrected : CorrectedRanges
        After the screens of the observations.
    index : SearchIndex
    config : Config
    state : AntennaState
    predicted : PredictedPlace, optional
        Limits the section search.
    """
    trajectory, ranges = index.trajectory, corrected.ranges()
    point = single_point(ranges, corrected.anchor_ecef_m, limits=config.single_point)
    reference = CLOCK_GROUP[config.systems[0]]
    ties, offsets = tie_clocks(
        corrected.time, corrected.clocks, reference, ranges, point, state.offsets, limits=config.clock_offsets
    )
    tied = point
    if len(corrected.groups) > 1:
        ranges = replace(ranges, ties=ties)
        start = np.where(np.isnan(point.ecef_m), corrected.anchor_ecef_m, point.ecef_m)
        tied = single_point(ranges, start, limits=config.single_point)
    place = place_on_line(ranges, index, tied, config, predicted=predicted)
    corrected = corrected.rejected(alone_on_their_clocks(corrected, ties), Reason.ALONE_ON_ITS_CLOCK)
    sums = (state.log_variance_sum, state.log_variance_weight)
    scale, sums = noise_scale(redundancy_of(ranges), place.constrained.wsse, sums, prior=config.noise_prior)
    ranges, place, raim = fault_free(ranges, index, place, scale, config, predicted=predicted)
    constrained = place.constrained
    if "raim" in config.screens and config.raim_protection == "on":
        raim = with_p4_level(raim, ranges, trajectory, constrained, scale, config)
    corrected = corrected.rejected(raim.excluded, Reason.FAULT_EXCLUDED)
    level = None
    if config.protection == "on" and config.carrier != "float":
        level = protection_levels(corrected, ranges, trajectory, constrained, raim, scale, config)
    own_sigma = own_sigma_m(redundancy_of(ranges), constrained.wsse, constrained.exact_map_sigma_m, scale)
    arc, exact, total = constrained.arc_m, constrained.exact_map_sigma_m, constrained.sigma_m
    phase, carrier = None, state.carrier
    if config.carrier == "float" and corrected.slips is not None:
        phase, carrier = code_and_phase(
            corrected, corrected.slips, ranges, trajectory, arc, config, carrier or CarrierState()
        )
        arc, exact, total = phase.arc_m, phase.noise_sigma_m, phase.sigma_m
    along_sigma = np.sqrt((scale * exact) ** 2 + (total**2 - exact**2))
    judged = own_sigma if phase is None else along_sigma
    solution = Solution(
        point=point,
        place=place,
        ties=ties,
        raim=raim,
        status=_status(corrected, ranges, trajectory, place, raim, judged, arc, config),
        noise_scale=scale,
        own_sigma_m=own_sigma,
        arc_m=arc,
        along_sigma_m=along_sigma,
        phase=phase,
        protection=level,
    )
    after = replace(state, offsets=offsets, log_variance_sum=sums[0], log_variance_weight=sums[1], carrier=carrier)
    return corrected, solution, after


@lru_cache
def _chi_square_limit(risk: float, freedom: int) -> float:
    """Return the chi-square value that noise exceeds with a probability of `risk`."""
    return float(chi2.isf(risk, freedom))


def _off_map(ranges: Ranges, trajectory: Trajectory, place: Place, arc: Floats, config: Config) -> Masks:
    """Return the epochs whose ranges contradict the map at the position, or pull it beyond an end, shape (T,)."""
    point, constrained, redundancy = place.point, place.constrained, redundancy_of(ranges)
    position = trajectory.at_arc(arc)
    wsse = constrained.wsse
    if arc is not constrained.arc_m:
        known = np.isfinite(arc)
        wsse = np.where(known, fit(ranges, np.where(known[:, None], position, 0.0)), np.nan)
    away = np.linalg.norm(position - point.ecef_m, axis=1)
    misfit = (wsse - point.wsse) / np.maximum(1.0, wsse / np.maximum(redundancy, 1))
    lost = (away > config.off_map_m) & (misfit > _chi_square_limit(config.off_map_risk, 2))
    beyond = constrained.overshoot_m > np.maximum(4.0 * constrained.sigma_m, trajectory.sigma_plan_m)
    return np.asarray(lost | beyond)


def _status(
    corrected: CorrectedRanges,
    ranges: Ranges,
    trajectory: Trajectory,
    place: Place,
    raim: RaimResult,
    sigma: Floats,
    arc: Floats,
    config: Config,
) -> Codes:
    """Return the status of each epoch, shape (T,): the first condition that holds, the most serious first."""
    redundancy, constrained, section = redundancy_of(ranges), place.constrained, place.section
    conditions = [
        (~np.isfinite(corrected.code_m).any(axis=1), Status.NO_OBSERVATION),
        ((ranges.n_used < config.min_satellites) | (redundancy < 0), Status.TOO_FEW_SATELLITES),
        (constrained.dilution > config.dilution_limit, Status.UNOBSERVABLE),
        (~np.isfinite(arc), Status.NO_CONVERGENCE),
        (_off_map(ranges, trajectory, place, arc, config), Status.OFF_MAP),
        (np.isin(raim.outcome, [Outcome.UNRESOLVED, Outcome.INSEPARABLE]), Status.INCONSISTENT),
        (sigma > config.largest_sigma_m, Status.UNCERTAIN),
        ((section.excess <= config.section.threshold) | (redundancy < config.section.redundancy), Status.AMBIGUOUS),
    ]
    return np.select([c for c, _ in conditions], [s.value for _, s in conditions], Status.OK).astype(np.int8)
