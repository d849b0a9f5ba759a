"""Corrected pseudoranges with their sigmas and the reasons for rejection so far: everything before positioning."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from railfix.core.arrays import Bits, Floats, Indices, Masks, Strings, copy_with, kernel_array, patch_rows
from railfix.core.epoch_rows import OnDemand
from railfix.core.reasons import Reason
from railfix.gnss.observations import Observations
from railfix.gnss.orbits import SatelliteStates, satellite_states
from railfix.integrity.protection.araim import IntegritySupport
from railfix.pipeline.channels import Channels, second_codes
from railfix.pipeline.config import Config
from railfix.pipeline.received import Received
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.carrier import Slips
from railfix.positioning.gross_errors import gross_errors
from railfix.positioning.normal_equations import Ranges, SinglePointLimits, single_point
from railfix.positioning.section_search import SearchIndex, search
from railfix.positioning.two_frequencies import Combined, SecondCodes
from railfix.ranges.atmosphere import SeenFrom, model_delays
from railfix.ranges.base_station import BaseDifferences
from railfix.ranges.cn0_curve import Cn0Curve
from railfix.ranges.corrected import (
    PLAUSIBLE_CODE_M,
    SBAS_SIGNAL,
    apply_dfmc,
    apply_long_term,
    code_sigma_m,
    dfmc_delays,
    first_available,
    sbas_delays,
)
from railfix.ranges.error_model import Conditions, ErrorModel
from railfix.ranges.sbas import SatelliteCorrections, SbasCorrections
from railfix.ranges.sbas.dfmc import DfmcCorrections
from railfix.screens import AntennaRanges, Screened, Verdict, suspicion_sigma_m

#: Standard deviation given to raw ranges for the approximate place of the antenna [m].
ANCHOR_SIGMA_M: Final = 10.0
#: A last step of this length leaves 25 m of a range, which turns no satellite by more than 2e-6 rad [m].
ANCHOR_TOLERANCE_M: Final = 1000.0
#: A raw 3-D position further from the line than this is not that of a train on it, however bad the ranges [m].
BESIDE_THE_LINE_M: Final = 1e5
#: Satellite position of ranges without weight: any finite value will do [m].
SOMEWHERE_ABOVE_M: Final = (2.6e7, 0.0, 0.0)


class Models(NamedTuple):
    """Measured models: weights of the ranges in place of `Config.noise`, the screen "cn0", ARAIM levels."""

    error_model: ErrorModel | None = None
    cn0_curve: Cn0Curve | None = None
    support: IntegritySupport | None = None


@dataclass(frozen=True, kw_only=True)
class CorrectedRanges(AntennaRanges, OnDemand):
    """Corrected pseudoranges before positioning: T epochs by the K channels that the settings allow."""

    observations: Observations
    channels: Channels
    satellites: SatelliteStates
    anchor_arc_m: Floats  #: Of the point of the line nearest to the approximate place, shape (T,).
    #: A code is grossly wrong, but not clearly which one: such epochs are no evidence on noise and map; shape (T,).
    unsure: Masks
    #: Delays subtracted from the codes; 0 where the model is off, NaN where SBAS has none; shape (T, K).
    ionosphere_m: Floats
    troposphere_m: Floats
    #: Standard deviation of satellites and atmosphere: by SBAS, otherwise by `Config.nominal`; shape (T, K).
    nominal_m: Floats
    #: What `Config.nominal` assumes at the elevation alone; 0 with SBAS; shape (T, K).
    unmodelled_m: Floats
    #: Overbounding sigma and largest nominal bias of each range by the error model; 0 without one; shape (T, K).
    bound_sigma_m: Floats
    bias_m: Floats
    screens: Mapping[str, Screened] = field(default_factory=dict)  #: Metric and verdict of each screen so far.
    second: SecondCodes | None = None  #: Second codes of the satellites, where two frequencies are used.
    combined: Combined | None = None  #: How the two were combined.
    slips: Slips | None = None  #: Of all channels of the observations, where the carrier phase is used.
    base: BaseDifferences | None = None  #: What a base station has subtracted.

    @property
    def columns(self) -> Indices:
        """Columns of the channels in the observations, shape (K,)."""
        return self.channels.columns

    @property
    def groups(self) -> tuple[slice, ...]:
        """Channels of one receiver clock."""
        return self.channels.groups

    @property
    def clocks(self) -> tuple[str, ...]:
        """Letter of each receiver clock."""
        return self.channels.clocks

    def reject(self, mask: Masks, reason: Reason) -> CorrectedRanges:
        """Return the ranges with a reason added to the observed channels of a mask, shape (T, K)."""
        if not mask.any():
            return self
        hit = mask & ((self.reason & int(Reason.NOT_OBSERVED)) == 0)
        return copy_with(self, reason=np.where(hit, self.reason | int(reason), self.reason))

    def apply(self, verdicts: Iterable[Verdict]) -> CorrectedRanges:
        """Return the ranges with the verdicts of a screen: what fails is rejected, or weighted down."""
        ranges = self
        for verdict in verdicts:
            reject = verdict.screened.reject
            if verdict.error_m is None:
                ranges = ranges.reject(reject, verdict.reason)
            elif reject.any():
                ranges = copy_with(ranges, sigma_m=suspicion_sigma_m(reject, verdict.error_m, ranges.sigma_m))
            ranges = copy_with(ranges, screens={**ranges.screens, verdict.name: verdict.screened})
        return ranges

    def ranges(self) -> Ranges:
        """Return the ranges without a reason against them, ready to be fitted."""
        return usable_ranges(self.satellites, self.corrected_code_m, 1.0 / self.sigma_m**2, self.reason, self.groups)


def correct_ranges(
    obs: Observations,
    channels: Channels,
    config: Config,
    received: Received,
    antennas: AntennaRows,
    *,
    error_model: ErrorModel | None = None,
) -> CorrectedRanges:
    """Correct the codes of the channels, and compute their sigmas: reasons of codes, satellites and corrections.

    Where SBAS is received, its corrections replace the models, and satellites without a valid one are rejected. An
    error model gives the least sigmas of the protection level; the weights are those of ``config.noise``.
    """
    columns, satellite, signal, groups = channels.columns, channels.satellite, channels.signal, channels.groups
    code, cn0 = obs.code_m[:, columns], obs.cn0_dbhz[:, columns]
    reason, sbas = _reasons_of_codes(satellite, code), received.sbas
    observed = (reason & int(Reason.NOT_OBSERVED)) == 0
    fixes = None if sbas is None else sbas.satellites(obs.time, satellite, received.navigation)
    states = satellite_states(
        obs.time, satellite, signal, code, received.navigation, max_age_s=config.max_ephemeris_age_s,
        record=None if fixes is None else fixes.record,
    )  # fmt: skip
    lacking = np.zeros(code.shape, dtype=np.int64)
    if isinstance(fixes, DfmcCorrections):
        states, lacking = apply_dfmc(states, fixes, satellite, signal)
    elif fixes is not None:
        states, lacking = apply_long_term(states, fixes)
        lacking = np.where(signal == SBAS_SIGNAL, lacking, int(Reason.SBAS_NOT_COVERED))
    for mask, bits in (
        (observed, lacking),
        (observed & states.no_record, int(Reason.NO_EPHEMERIS)),
        (observed & states.too_old, int(Reason.EPHEMERIS_TOO_OLD)),
        (observed & states.unhealthy, int(Reason.UNHEALTHY)),
    ):
        reason = np.where(mask, reason | bits, reason)
    clean = code + states.clock_m - states.group_delay_m
    if isinstance(fixes, SatelliteCorrections):
        clean = clean + np.nan_to_num(fixes.fast_m)
    raw = usable_ranges(states, clean, _ANCHOR_WEIGHT, reason, groups)
    anchor, anchor_arc, gross, unsure = _anchor(antennas, config, raw)
    reason = np.where(gross, reason | int(Reason.GROSS_ERROR), reason)
    seen, frequency = SeenFrom.of(anchor, states.position_ecef_m), channels.frequency_hz
    if isinstance(sbas, SbasCorrections) and isinstance(fixes, SatelliteCorrections):
        delays = sbas_delays(sbas, fixes, obs.time, seen, frequency)
        beyond = nominal = delays.sigma_m
        unmodelled = np.zeros(code.shape)
        reason = np.where(observed, reason | delays.reason, reason)
    else:
        delays = model_delays(
            obs.time, seen, frequency, klobuchar=received.klobuchar, ionosphere_sigma_m=received.ionosphere_sigma_m,
            troposphere=config.troposphere,
        )  # fmt: skip
        beyond = np.hypot(delays.sigma_m, config.nominal.unusual_sigma_m(states.accuracy_m))
        unmodelled = config.nominal.sigma_m(seen.elevation_deg)
        nominal = np.hypot(unmodelled, beyond)
        if isinstance(fixes, DfmcCorrections):
            delays = dfmc_delays(fixes, obs.time, seen, delays)
            beyond = nominal = delays.sigma_m
            unmodelled = np.zeros(code.shape)
    second = base = None
    if received.base is not None:
        base = received.base.at(obs.time, satellite, signal, anchor, config.base)
    elif not isinstance(sbas, SbasCorrections):
        air = delays.ionosphere_m, delays.troposphere_m
        second = second_codes(obs, channels, states, received, seen.elevation_deg, *air, config)
    if isinstance(fixes, DfmcCorrections):
        alone = np.isnan(second.code_m) if second is not None else np.ones(code.shape, dtype=bool)
        reason = np.where((reason == 0) & alone, reason | int(Reason.SBAS_NO_IONOSPHERE), reason)
    clean = clean - delays.ionosphere_m - delays.troposphere_m
    if base is not None:
        differenced = np.isfinite(base.code_m)
        clean = np.where(differenced, clean - base.code_m, clean)
        nominal, beyond = (np.where(differenced, base.sigma_m, each) for each in (nominal, beyond))
        beyond = np.where(differenced, beyond, np.hypot(beyond, config.noise.floor_sigma_m))
    noise = config.noise if base is None else config.noise.replaced(floor_sigma_m=0.0)
    sigma = np.hypot(code_sigma_m(cn0, seen.elevation_deg, noise=noise), beyond)
    bound, bias = np.zeros(code.shape), np.zeros(code.shape)
    if error_model is not None:
        bound, bias = _by_error_model(error_model, seen, cn0, antennas, anchor_arc)
        bound = np.hypot(bound, nominal) if error_model.covers == "local" or sbas is not None else bound
    uncorrected = (reason == 0) & ~(np.isfinite(clean) & np.isfinite(sigma) & np.isfinite(bound))
    return CorrectedRanges(
        observations=obs, channels=channels, time=obs.time, break_before=obs.break_before, satellite=satellite,
        signal=signal, frequency_hz=frequency, code_m=code, doppler_hz=obs.doppler_hz[:, columns], cn0_dbhz=cn0,
        satellites=states, anchor_ecef_m=anchor, anchor_arc_m=anchor_arc, unsure=unsure,
        elevation_deg=seen.elevation_deg, azimuth_deg=seen.azimuth_deg,
        ionosphere_m=delays.ionosphere_m, troposphere_m=delays.troposphere_m,
        corrected_code_m=clean, sigma_m=sigma, nominal_m=nominal, unmodelled_m=unmodelled, bound_sigma_m=bound,
        bias_m=bias,
        reason=np.where(uncorrected, int(Reason.NO_CORRECTION), reason), second=second, base=base,
    )  # fmt: skip


def _by_error_model(
    model: ErrorModel, seen: SeenFrom, cn0: Floats, antennas: AntennaRows, arc_m: Floats
) -> tuple[Floats, Floats]:
    """Return overbounding sigma and bias of the ranges by the error model: shapes (T, K) [m]."""

    def front_deg(index: SearchIndex, rows: slice) -> Floats:
        return index.trajectory.body_azimuth_deg(arc_m[rows])

    turned = seen.azimuth_deg - antennas.each(front_deg)[:, None]
    sigma, bias = model.at(seen.elevation_deg, turned, cn0)
    return sigma, np.nan_to_num(bias)


_ANCHOR_WEIGHT: Final = np.array(1.0 / ANCHOR_SIGMA_M**2)


class _Anchor(NamedTuple):
    """Approximate place of the antenna, and raw codes that are wrong, T epochs by K channels."""

    ecef_m: Floats  # (T, 3), good to some hundred metres
    arc_m: Floats  # (T,), of the nearest point of the line
    gross: Masks  # (T, K), codes that are grossly wrong
    unsure: Masks  # (T,), epochs in which nothing tells which codes are wrong


def _anchor(antennas: AntennaRows, config: Config, ranges: Ranges) -> _Anchor:
    """Return an approximate place of the antenna by the raw codes that are not grossly wrong.

    The point of the line nearest to a 3-D position from raw ranges of equal weight, started from
    the middle of the line at every epoch so that no epoch depends on another; the 3-D position
    itself where it is far from the line; the best-fitting point of the line where there is no 3-D position.
    """
    middle = antennas.each(lambda index, rows: index.middle_ecef_m[None].repeat(len(ranges.code_m[rows]), axis=0))
    point = single_point(ranges, middle, limits=_rough(config.single_point))
    found = gross_errors(ranges, antennas, point)
    again = np.flatnonzero(found.gross.any(axis=1))
    if len(again):
        ranges = without(ranges, found.gross)
        point = patch_rows(
            point, again, single_point(ranges.take(again), middle[again], limits=_rough(config.single_point))
        )
    anchor = point.ecef_m.copy()
    arc, solved = np.full(len(anchor), np.nan), np.isfinite(anchor[:, 0])
    for index, rows in antennas.split(solved.nonzero()[0]):
        distance, vertex = index.tree.query(anchor[rows])
        beside = np.asarray(distance) < BESIDE_THE_LINE_M
        own, vertex = rows[beside], np.asarray(vertex)[beside]
        anchor[own], arc[own] = index.trajectory.ecef_m[vertex], index.arc_of_points_m[vertex]
    for index, rest in antennas.split((~solved).nonzero()[0]):
        best = search(ranges.take(rest), index, point.take(rest), limits=config.section).vertex
        anchor[rest] = np.where((best >= 0)[:, None], index.trajectory.ecef_m[best], middle[rest])
    for index, off in antennas.split(np.isnan(arc).nonzero()[0]):
        arc[off], _ = index.trajectory.nearest(anchor[off])
    unsure = np.isfinite(found.unsure_arc_m)
    arc = np.where(unsure, found.unsure_arc_m, arc)
    anchor = np.where(unsure[:, None], antennas.at_arc(arc), anchor)
    return _Anchor(anchor, arc, found.gross, unsure)


@lru_cache
def _rough(limits: SinglePointLimits) -> SinglePointLimits:
    return limits.replaced(tolerance_m=max(ANCHOR_TOLERANCE_M, limits.tolerance_m))


def _reasons_of_codes(satellite: Strings, code: Floats) -> Bits:
    """Return the reasons that follow from the codes alone, shape (T, K)."""
    observed = np.isfinite(code)
    plausible = (code > PLAUSIBLE_CODE_M[0]) & (code < PLAUSIBLE_CODE_M[1])
    taken = first_available(satellite, plausible)
    reason = np.where(taken, int(Reason.USED), int(Reason.OTHER_SIGNAL_TAKEN))
    reason = np.where(plausible, reason, int(Reason.IMPLAUSIBLE_CODE))
    return np.where(observed, reason, int(Reason.NOT_OBSERVED))


def usable_ranges(
    states: SatelliteStates, code: Floats, weight: Floats, reason: Bits, groups: tuple[slice, ...]
) -> Ranges:
    """Return ranges to be fitted: those with a reason, or without a number, have weight 0 and finite values."""
    used = (reason == 0) & np.isfinite(code) & np.isfinite(weight)
    return Ranges(
        sat_ecef_m=kernel_array(np.where(used[..., None], states.position_ecef_m, SOMEWHERE_ABOVE_M)),
        code_m=kernel_array(np.where(used, code, 0.0)),
        weight=kernel_array(np.where(used, weight, 0.0)),
        groups=groups,
    )


def without(ranges: Ranges, dropped: Masks) -> Ranges:
    """Return the ranges with weight 0 where `dropped`, shape (T, M)."""
    return replace(ranges, weight=np.where(dropped, 0.0, ranges.weight))


def collect_conditions(config: Config) -> Conditions:
    """Collect settings that the errors of ranges depend on: the conditions of an error model made from such a run."""
    return Conditions(
        systems=config.systems, signals={letter: config.signals.get(letter, ()) for letter in config.systems},
        screens=config.screens, elevation_mask_deg=config.elevation.mask_deg,
        codes="smoothed" if config.carrier == "smoothed" else "raw",
        ionosphere="sbas" if config.sbas else config.ionosphere,
        troposphere="sbas" if config.sbas else config.troposphere,
    )  # fmt: skip
