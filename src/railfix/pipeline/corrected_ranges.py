"""From observations to corrected ranges with the reasons so far: everything before a position is sought."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from railfix.core.arrays import Bits, Floats, Indices, Masks, Strings
from railfix.core.reasons import Reason
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.gnss.orbits import SatelliteStates, satellite_states
from railfix.pipeline.channels import Channels
from railfix.pipeline.config import Config
from railfix.positioning.carrier import Slips
from railfix.positioning.normal_equations import Ranges
from railfix.positioning.section_search import SearchIndex, search
from railfix.positioning.single_point import single_point
from railfix.ranges.atmospheric_delays import SeenFrom, modelled_delays
from railfix.ranges.error_model import ErrorModel
from railfix.ranges.sbas import SbasCorrections
from railfix.ranges.sbas_delays import SBAS_SIGNAL, corrected_satellites, sbas_delays
from railfix.ranges.weights import PLAUSIBLE_CODE_M, code_sigma_m, first_available
from railfix.screens import Screened

#: Standard deviation given to raw ranges when looking for a place to see the satellites from [m].
ANCHOR_SIGMA_M: Final = 10.0
#: A last step of this length leaves 25 m of a range, which turns no satellite by more than 2e-6 rad [m].
ANCHOR_TOLERANCE_M: Final = 1000.0
#: Further from the line than this a raw 3-D position is no train on it, however bad the ranges [m].
BESIDE_THE_LINE_M: Final = 1e5
#: Stands for the satellite of a range without weight [m].
SOMEWHERE_ABOVE_M: Final = (2.6e7, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """One antenna's chunk before any position: T epochs by the K channels that settings allow.

    Attributes
    ----------
    observations : Observations
    channels : Channels
    code_m, doppler_hz, cn0_dbhz : ndarray, shape (T, K)
    satellites : SatelliteStates
    anchor_ecef_m : ndarray, shape (T, 3) [m]
        Where the satellites are seen from.
    elevation_deg, azimuth_deg : ndarray, shape (T, K)
    ionosphere_m, troposphere_m : ndarray, shape (T, K) [m]
        Delays taken off the codes; 0 where the model is off, NaN where SBAS has none.
    corrected_code_m, sigma_m : ndarray, shape (T, K) [m]
    bias_m : ndarray, shape (T, K) [m]
        Largest nominal bias of each range by the error model; 0 without one.
    reason : ndarray of int64, shape (T, K)
        Written to by `refuse` alone.
    screens : dict of str to Screened
        What each screen measured and said.
    slips : Slips or None
        Of all channels of the observations, where the carrier phase is used.
    """

    observations: Observations
    channels: Channels
    code_m: Floats
    doppler_hz: Floats
    cn0_dbhz: Floats
    satellites: SatelliteStates
    anchor_ecef_m: Floats
    elevation_deg: Floats
    azimuth_deg: Floats
    ionosphere_m: Floats
    troposphere_m: Floats
    corrected_code_m: Floats
    sigma_m: Floats
    bias_m: Floats
    reason: Bits
    screens: dict[str, Screened] = field(default_factory=dict)
    slips: Slips | None = None

    @property
    def columns(self) -> Indices:
        """Where the channels stand in the observations, shape (K,)."""
        return self.channels.columns

    @property
    def satellite(self) -> Strings:
        """Satellite of each channel, shape (K,)."""
        return self.channels.satellite

    @property
    def signal(self) -> Strings:
        """Signal of each channel, shape (K,)."""
        return self.channels.signal

    @property
    def groups(self) -> tuple[slice, ...]:
        """Channels of one receiver clock."""
        return self.channels.groups

    @property
    def clocks(self) -> tuple[str, ...]:
        """Letter of each receiver clock."""
        return self.channels.clocks

    @property
    def frequency_hz(self) -> Floats:
        """Carrier of each channel, shape (K,) [Hz]."""
        return self.channels.frequency_hz

    def refuse(self, mask: Masks, reason: Reason) -> None:
        """Add a reason to observed channels; nothing ever takes one away."""
        self.reason[mask & ((self.reason & Reason.NOT_OBSERVED) == 0)] |= reason

    def screened(self, name: str, verdict: Screened, reason: Reason) -> None:
        """Keep what a screen said, and act on it."""
        self.screens[name] = verdict
        self.refuse(verdict.reject, reason)

    def ranges(self) -> Ranges:
        """What may be fitted now."""
        return usable_ranges(self.satellites, self.corrected_code_m, 1.0 / self.sigma_m**2, self.reason, self.groups)


def prepare(
    obs: Observations,
    channels: Channels,
    config: Config,
    navigation: Navigation,
    index: SearchIndex,
    klobuchar: Floats | None,
    *,
    error_model: ErrorModel | None = None,
    sbas: SbasCorrections | None = None,
) -> Prepared:
    """Find the satellites of the channels, correct their codes, weigh them.

    Parameters
    ----------
    obs : Observations
    channels : Channels
        Of these observations.
    config : Config
    navigation : Navigation
    index : SearchIndex
        Of the antenna's trajectory.
    klobuchar : ndarray, shape (8,), or None
        Ionospheric coefficients; None leaves the ionosphere uncorrected.
    error_model : ErrorModel, optional
        Gives the weights in place of ``config.noise``.
    sbas : SbasCorrections, optional
        Corrects satellites, ionosphere and troposphere in place of the models; what it has no valid
        correction for is refused.

    Returns
    -------
    Prepared
        With the reasons of codes, satellites and corrections; the screens come after.
    """
    columns, satellite, signal, groups = channels.columns, channels.satellite, channels.signal, channels.groups
    code, cn0 = obs.code_m[:, columns], obs.cn0_dbhz[:, columns]
    reason = _reasons_of_codes(satellite, code)
    fixes = None if sbas is None else sbas.satellites(obs.time, satellite, navigation)
    states = satellite_states(
        obs.time,
        satellite,
        signal,
        code,
        navigation,
        max_age_s=config.max_ephemeris_age_s,
        record=None if fixes is None else fixes.record,
    )
    if fixes is not None:
        states, refused = corrected_satellites(states, fixes)
        refused = np.where(signal == SBAS_SIGNAL, refused, int(Reason.SBAS_NOT_COVERED))
        reason |= np.where(reason & Reason.NOT_OBSERVED, 0, refused)
    observed = (reason & Reason.NOT_OBSERVED) == 0
    for mask, bit in (
        (states.no_record, Reason.NO_EPHEMERIS),
        (states.too_old, Reason.EPHEMERIS_TOO_OLD),
        (states.unhealthy, Reason.UNHEALTHY),
    ):
        reason[observed & mask] |= bit
    clean = code + states.clock_m - states.group_delay_m
    if fixes is not None:
        clean = clean + np.nan_to_num(fixes.fast_m)
    anchor = _anchor(index, config, usable_ranges(states, clean, _ANCHOR_WEIGHT, reason, groups))
    seen, frequency = SeenFrom.of(anchor, states.position_ecef_m), channels.frequency_hz
    if sbas is None or fixes is None:
        air = modelled_delays(obs.time, seen, frequency, klobuchar=klobuchar, troposphere=config.troposphere)
    else:
        air = sbas_delays(sbas, fixes, obs.time, seen, frequency)
        reason |= np.where(reason & Reason.NOT_OBSERVED, 0, air.reason)
    clean = clean - air.ionosphere_m - air.troposphere_m
    local, bias = _local_errors(seen, cn0, index, config, error_model)
    if error_model is not None and error_model.covers == "local" and sbas is None:
        local = np.hypot(local, config.nominal.sigma_m(seen.elevation_deg))
    sigma = np.hypot(local, air.sigma_m)
    reason[(reason == 0) & ~(np.isfinite(clean) & np.isfinite(sigma))] |= Reason.NO_CORRECTION
    return Prepared(
        observations=obs,
        channels=channels,
        code_m=code,
        doppler_hz=obs.doppler_hz[:, columns],
        cn0_dbhz=cn0,
        satellites=states,
        anchor_ecef_m=anchor,
        elevation_deg=seen.elevation_deg,
        azimuth_deg=seen.azimuth_deg,
        ionosphere_m=air.ionosphere_m,
        troposphere_m=air.troposphere_m,
        corrected_code_m=clean,
        sigma_m=sigma,
        bias_m=bias,
        reason=reason,
    )


def _local_errors(
    seen: SeenFrom, cn0: Floats, index: SearchIndex, config: Config, model: ErrorModel | None
) -> tuple[Floats, Floats]:
    """Sigma and bias of the ranges by the error model, or by the noise settings: shapes (T, K)."""
    if model is None:
        return code_sigma_m(cn0, seen.elevation_deg, noise=config.noise), np.zeros(cn0.shape)
    arc, _ = index.trajectory.nearest(seen.receiver_ecef_m)
    turned = seen.azimuth_deg - index.trajectory.body_azimuth_deg(arc)[:, None]
    sigma, bias = model.at(seen.elevation_deg, turned, cn0)
    return sigma, np.nan_to_num(bias)


_ANCHOR_WEIGHT: Final = np.array(1.0 / ANCHOR_SIGMA_M**2)


def _anchor(index: SearchIndex, config: Config, ranges: Ranges) -> Floats:
    """A place near the antenna to see the satellites from, shape (T, 3): good to some hundred metres.

    The point of the line nearest to a 3-D position from raw ranges of equal weight, started from
    the middle of the line at every epoch so that no epoch depends on another; the 3-D position
    itself where it is nowhere near the line; where there is none, the point of the line that fits
    best.
    """
    trajectory = index.trajectory
    middle = np.broadcast_to(trajectory.ecef_m.mean(axis=0), (len(ranges), 3))
    rough = replace(config.single_point, tolerance_m=max(ANCHOR_TOLERANCE_M, config.single_point.tolerance_m))
    point = single_point(ranges, middle, limits=rough)
    anchor = point.ecef_m.copy()
    found = np.flatnonzero(np.isfinite(anchor[:, 0]))
    distance, vertex = index.tree.query(anchor[found])
    beside = np.asarray(distance) < BESIDE_THE_LINE_M
    anchor[found[beside]] = trajectory.ecef_m[np.asarray(vertex)[beside]]
    rest = np.flatnonzero(np.isnan(anchor[:, 0]))
    if len(rest):
        best = search(ranges.take(rest), index, point.take(rest), limits=config.section).vertex
        anchor[rest] = np.where((best >= 0)[:, None], trajectory.ecef_m[best], middle[rest])
    return anchor


def _reasons_of_codes(satellite: Strings, code: Floats) -> Bits:
    """Reasons that the codes alone give, shape (T, K)."""
    observed = np.isfinite(code)
    plausible = (code > PLAUSIBLE_CODE_M[0]) & (code < PLAUSIBLE_CODE_M[1])
    taken = first_available(satellite, plausible)
    reason = np.zeros(code.shape, dtype=np.int64)
    reason[~observed] |= Reason.NOT_OBSERVED
    reason[observed & ~plausible] |= Reason.IMPLAUSIBLE_CODE
    reason[plausible & ~taken] |= Reason.OTHER_SIGNAL_TAKEN
    return reason


def usable_ranges(
    states: SatelliteStates, code: Floats, weight: Floats, reason: Bits, groups: tuple[slice, ...]
) -> Ranges:
    """Ranges to be fitted: what has a reason, or no number, gets no weight and harmless numbers."""
    used = (reason == 0) & np.isfinite(code) & np.isfinite(weight)
    return Ranges(
        sat_ecef_m=np.where(used[..., None], states.position_ecef_m, SOMEWHERE_ABOVE_M),
        code_m=np.where(used, code, 0.0),
        weight=np.where(used, weight, 0.0),
        groups=groups,
    )


def without(ranges: Ranges, dropped: Masks) -> Ranges:
    """The same ranges, some of them without weight."""
    return replace(ranges, weight=np.where(dropped, 0.0, ranges.weight))
