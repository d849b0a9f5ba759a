"""Satellite states and corrected pseudoranges (P1 2.2(2)): the first two stages of the positioning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Bits, Datetimes, Floats, Indices, Integers, Masks, Strings
from railfix.core.epoch_rows import OnDemand
from railfix.core.notebook import NotebookTable
from railfix.core.reasons import Reason
from railfix.gnss.observations import Observations
from railfix.gnss.orbits import SatelliteStates
from railfix.ranges.atmosphere import SeenFrom, vertical_delay_m
from railfix.ranges.channels import PLAUSIBLE_CODE_M, Channels, first_available
from railfix.ranges.range_sigma import CodeNoise, code_sigma_m
from railfix.ranges.sources import BaseDifferences, CorrectionSource, SourceSatellites

#: Satellites at a smaller or larger distance from the Earth's centre are rejected as implausible [m].
ORBITS_M: Final = (2e7, 6e7)


@dataclass(frozen=True, kw_only=True, repr=False)
class AntennaRanges(NotebookTable):
    """Corrected ranges of one antenna, the input of the screens (tests of single ranges): T epochs by K channels."""

    time: Datetimes  #: Time tags, shape (T,).
    break_before: Masks  #: True where an epoch must not be differenced with the previous epoch, shape (T,).
    #: Properties of each channel, shape (K,).
    satellite: Strings
    signal: Strings
    frequency_hz: Floats
    #: Observations, shape (T, K).
    code_m: Floats
    doppler_hz: Floats
    cn0_dbhz: Floats
    #: Approximate position of the antenna, from which the directions to the satellites are computed; shape (T, 3).
    near_ecef_m: Floats
    #: Direction from the antenna to each satellite, shape (T, K).
    elevation_deg: Floats
    azimuth_deg: Floats
    #: Code corrected for satellite clock, group delay and atmosphere, and sigma of the corrected code; shape (T, K).
    corrected_code_m: Floats
    sigma_m: Floats
    reason: Bits  #: Rejection reasons found so far (`reasons.Reason` bits), 0 if usable; shape (T, K).


@dataclass(frozen=True, kw_only=True)
class SecondCodes:
    """Second-frequency codes of satellites: T epochs by the K channels of the first codes."""

    code_m: Floats  #: Code corrected like the first code; NaN where missing; shape (T, K).
    noise_m: Floats  #: Sigma of noise and multipath used for the weights, shape (T, K).
    cn0_dbhz: Floats  #: C/N0 of the second signal, shape (T, K).
    group_delay_m: Floats  #: Group delay subtracted from the second code, shape (T, K).
    #: Sigma of the part of the group delay that is not broadcast; 0 where the whole group delay is broadcast.
    #: `TwoFrequencyLimits.delay_sigma_m` is added in quadrature; shape (T, K).
    delay_sigma_m: Floats
    ratio: Floats  #: Square of the ratio of the first to the second frequency, shape (T, K).
    pair: Integers  #: Index of the pair of first and second code in `Channels.pair_names`, shape (T, K).
    column: Integers  #: Column of the code in the observations, -1 where missing; shape (T, K).


@dataclass(frozen=True, kw_only=True, repr=False)
class CorrectedRanges(AntennaRanges, OnDemand):
    """Corrected pseudoranges before positioning: T epochs by the K channels of `select_channels`."""

    observations: Observations
    channels: Channels
    satellites: SatelliteStates
    #: Delays subtracted from the codes, shape (T, K); 0 if the model of a delay is off, NaN where SBAS has no delay.
    ionosphere_m: Floats
    troposphere_m: Floats
    #: Standard deviation of satellite and atmospheric errors, from SBAS or from `NominalErrors`; shape (T, K).
    nominal_m: Floats
    #: Sigma computed by `NominalErrors` from elevation and ionospheric delay, shape (T, K); 0 with SBAS.
    nominal_elevation_sigma_m: Floats
    #: By the error model, overbounding sigma and largest nominal bias of each range; 0 without a model; (T, K).
    bound_sigma_m: Floats
    bias_m: Floats
    #: True at epochs with a gross error in an unknown channel, (T,). Noise and map estimates exclude these epochs.
    unsure: Masks
    second: SecondCodes | None = None  #: Second codes of the satellites (`find_second_codes`), or None.
    base: BaseDifferences | None = None  #: Base-station corrections in use, or None.

    @property
    def columns(self) -> Indices:
        """Columns of the channels in the observations, shape (K,)."""
        return self.channels.columns

    @property
    def vertical_ionosphere_m(self) -> Floats:
        """Vertical ionospheric delay on L1 from the model in use, shape (T,); 0 without a model."""
        return vertical_delay_m(self.ionosphere_m, self.elevation_deg, self.frequency_hz)

    @property
    def used_code_m(self) -> Floats:
        """Corrected codes, shape (T, K); NaN where rejected."""
        return np.where(self.reason == 0, self.corrected_code_m, np.nan)


class SatelliteRanges(NamedTuple):
    """Satellite positions and clocks, and the clock corrections of the codes, T epochs by K channels."""

    source: SourceSatellites
    correction_m: Floats  #: Satellite clock minus group delay, to be added to the codes; shape (T, K).
    reason: Bits  #: Rejection reasons (`reasons.Reason` bits), 0 if usable; shape (T, K).

    @property
    def states(self) -> SatelliteStates:
        """Positions and clocks at the times of transmission."""
        return self.source.states


def find_satellites(
    observations: Observations, channels: Channels, source: CorrectionSource, *, max_age_s: float | None = None
) -> SatelliteRanges:
    """Return satellite positions and clocks at the times of transmission ``t - code / c - dt_sv`` (P1 2.2(2)).

    Of each satellite, the first plausible code in the order of `channels` is kept; other codes get a rejection reason.

    Parameters
    ----------
    observations : Observations
        T epochs; codes outside 10,000 to 100,000 km are implausible.
    channels : Channels
        Returned by `select_channels`.
    source : CorrectionSource
        `BroadcastSource`, `SbasSource`, `DfmcSource` or `BaseStationSource`.
    max_age_s : float, optional
        A record is not used at epochs farther than this from the record's reference time; the limit applies only if it
        is shorter than the validity of the record.
    """
    code = observations.code_m[:, channels.columns]
    reason = _reasons_of_codes(channels.satellite, code)
    observed = (reason & int(Reason.NOT_OBSERVED)) == 0
    found = source.satellites(observations.time, channels, code, max_age_s=max_age_s)
    states = found.states
    for mask, bits in (
        (observed, found.reason),
        (observed & states.no_record, int(Reason.NO_EPHEMERIS)),
        (observed & states.too_old, int(Reason.EPHEMERIS_TOO_OLD)),
        (observed & states.unhealthy, int(Reason.UNHEALTHY)),
    ):
        reason = np.where(mask, reason | bits, reason)
    correction = states.clock_m - states.group_delay_m
    if found.fast_m is not None:
        correction = correction + found.fast_m
    # without a broadcast group delay, the satellite is known but the code cannot be corrected
    reason = np.where((reason == 0) & ~np.isfinite(correction), int(Reason.NO_CORRECTION), reason)
    impossible = (reason == 0) & ~(is_orbit(states.position_ecef_m) & is_pseudorange(code + correction))
    return SatelliteRanges(found, correction, np.where(impossible, int(Reason.NO_EPHEMERIS), reason))


def corrected_ranges(
    observations: Observations,
    channels: Channels,
    satellites: SatelliteRanges,
    near_ecef_m: ArrayLike,
    source: CorrectionSource,
    *,
    gross: Masks | None = None,
    noise: CodeNoise | None = None,
) -> CorrectedRanges:
    """Return corrected pseudoranges and their standard deviations (P1 2.2(2), 2.4).

    ``P = code + c (dt_sv - T_GD) - I - T``, with the corrections of the source; ``sigma^2 = sigma_code^2 +
    sigma_source^2`` (`CodeNoise`, `NominalErrors`).

    Parameters
    ----------
    observations, channels, source
        As for `find_satellites`.
    satellites : SatelliteRanges
        Returned by `find_satellites`.
    near_ecef_m : array_like, shape (3,) or (T, 3) [m]
        Approximate positions of the antenna (`positioning.approximate_position`); hundreds of metres suffice.
    gross : ndarray of bool, shape (T, K), optional
        Codes with gross errors (`ApproximatePosition.gross`), which are rejected.
    noise : CodeNoise, optional
        Receiver noise and multipath by C/N0 and elevation.

    Returns
    -------
    CorrectedRanges
        Unusable codes have a rejection reason; the values of these codes are kept, but NaN if a correction is missing.

    Raises
    ------
    ValueError
        `near_ecef_m` has neither shape (3,) nor shape (T, 3).
    """
    noise, time = noise or CodeNoise(), observations.time
    near = _check_near(near_ecef_m, len(time))
    code, cn0 = observations.code_m[:, channels.columns], observations.cn0_dbhz[:, channels.columns]
    states, reason = satellites.states, satellites.reason
    if gross is not None:
        reason = np.where(gross, reason | int(Reason.GROSS_ERROR), reason)
    observed = (reason & int(Reason.NOT_OBSERVED)) == 0
    seen = SeenFrom.of(near, states.position_ecef_m)
    given = source.delays(time, channels, satellites.source, seen)
    delays = given.delays
    reason = np.where(observed, reason | delays.reason, reason)
    clean = code + states.clock_m - states.group_delay_m
    if satellites.source.fast_m is not None:
        clean = clean + satellites.source.fast_m
    clean = clean - delays.ionosphere_m - delays.troposphere_m
    if given.base is not None:
        clean = np.where(np.isfinite(given.base.code_m), clean - given.base.code_m, clean)
    own = noise if given.floor == "added" else noise.replaced(floor_sigma_m=0.0)
    sigma = np.hypot(code_sigma_m(cn0, seen.elevation_deg, noise=own), given.sigma_m)
    lacking = (reason == 0) & ~(is_pseudorange(clean) & np.isfinite(sigma))
    none = np.zeros(code.shape)
    return CorrectedRanges(
        observations=observations, channels=channels, time=time, break_before=observations.break_before,
        satellite=channels.satellite, signal=channels.signal, frequency_hz=channels.frequency_hz, code_m=code,
        doppler_hz=observations.doppler_hz[:, channels.columns], cn0_dbhz=cn0, satellites=states, near_ecef_m=near,
        elevation_deg=seen.elevation_deg, azimuth_deg=seen.azimuth_deg, ionosphere_m=delays.ionosphere_m,
        troposphere_m=delays.troposphere_m, corrected_code_m=clean, sigma_m=sigma, nominal_m=given.nominal_m,
        nominal_elevation_sigma_m=given.nominal_elevation_sigma_m, bound_sigma_m=none, bias_m=none,
        unsure=np.zeros(len(time), dtype=np.bool_), base=given.base,
        reason=np.where(lacking, int(Reason.NO_CORRECTION), reason),
    )  # fmt: skip


def is_pseudorange(code_m: Floats) -> Masks:
    """Return True for plausible pseudoranges, any shape; False for NaN."""
    return np.asarray((code_m > PLAUSIBLE_CODE_M[0]) & (code_m < PLAUSIBLE_CODE_M[1]))


def is_orbit(sat_ecef_m: Floats) -> Masks:
    """Return True for plausible positions (..., 3) of a navigation satellite; False for NaN."""
    radius = np.sqrt(np.einsum("...i,...i->...", sat_ecef_m, sat_ecef_m))
    return np.asarray((radius > ORBITS_M[0]) & (radius < ORBITS_M[1]))


def _check_near(near_ecef_m: ArrayLike, epochs: int) -> Floats:
    """Return approximate positions, shape (T, 3); raise ValueError if the shape is neither (3,) nor (T, 3)."""
    near = np.asarray(near_ecef_m, dtype=np.float64)
    if near.shape not in ((3,), (epochs, 3)):
        raise ValueError(f"near_ecef_m has shape {near.shape}, expected (3,) or ({epochs}, 3)")
    return np.broadcast_to(near, (epochs, 3))


def _reasons_of_codes(satellite: Strings, code: Floats) -> Bits:
    """Return the rejection reasons that follow from the codes alone, shape (T, K)."""
    observed = np.isfinite(code)
    plausible = is_pseudorange(code)
    taken = first_available(satellite, plausible)
    reason = np.where(taken, int(Reason.USED), int(Reason.OTHER_SIGNAL_TAKEN))
    reason = np.where(plausible, reason, int(Reason.IMPLAUSIBLE_CODE))
    return np.where(observed, reason, int(Reason.NOT_OBSERVED))
