"""SBAS on L1 and on L5 as sources of corrections.

The variances are summed as in DO-229D (J.2.2), but without the noise of airborne receivers: ``sigma_flt^2 +
sigma_UIRE^2 + sigma_tropo^2``; the variance of multipath and receiver noise on a railway is added (P1 2.4).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from railfix.core.arrays import Bits, Datetimes, Floats, Strings
from railfix.core.constants import FREQUENCY_L1, SPEED_OF_LIGHT
from railfix.core.reasons import Reason
from railfix.gnss.navigation import Navigation
from railfix.gnss.orbits import SatelliteStates, satellite_states
from railfix.ranges.atmosphere import Delays, SeenFrom
from railfix.ranges.channels import DFMC_SIGNALS, Channels
from railfix.ranges.sbas.corrections import SbasCorrections
from railfix.ranges.sbas.dfmc import DfmcCorrections, DfmcService, DfmcState, residual_ionosphere_m
from railfix.ranges.sbas.standard import IonosphereState, SatelliteCorrections, SatelliteState
from railfix.ranges.sbas.troposphere import rtca_troposphere_m, rtca_troposphere_sigma_m
from railfix.ranges.sources import BroadcastSource, SourceDelays, SourceSatellites


@dataclass(frozen=True, kw_only=True)
class SbasSource:
    """SBAS on L1 (RTCA DO-229D): fast and long-term corrections, ionospheric grid, integrity."""

    navigation: Navigation
    corrections: SbasCorrections
    second: Literal["none", "optional", "required"] = "none"

    def satellites(
        self, time: Datetimes, channels: Channels, code_m: Floats, *, max_age_s: float | None = None
    ) -> SourceSatellites:
        """Return corrected satellites, computed from the records to which the long-term corrections refer."""
        fixes = self.corrections.satellites(time, channels.satellite, self.navigation)
        states = satellite_states(
            time, channels.satellite, channels.signal, code_m, self.navigation, max_age_s=max_age_s,
            record=fixes.record,
        )  # fmt: skip
        states, lacking = apply_long_term(states, fixes)
        lacking = np.where(channels.signal == SBAS_SIGNAL, lacking, int(Reason.SBAS_NOT_COVERED))
        return SourceSatellites(states, np.nan_to_num(fixes.fast_m), lacking, fixes)

    def delays(self, time: Datetimes, channels: Channels, satellites: SourceSatellites, seen: SeenFrom) -> SourceDelays:
        """Return the delays of the ionospheric grid and of the troposphere model of DO-229D."""
        fixes = satellites.fixes
        assert isinstance(fixes, SatelliteCorrections)
        delays = sbas_delays(self.corrections, fixes, time, seen, channels.frequency_hz)
        return SourceDelays(delays, delays.sigma_m, delays.sigma_m, np.zeros(delays.sigma_m.shape))


@dataclass(frozen=True, kw_only=True)
class DfmcSource:
    """SBAS on L5 (EUROCAE ED-259A), for ionosphere-free codes; the ionosphere is modelled for the screens only."""

    models: BroadcastSource
    service: DfmcService
    second: Literal["none", "optional", "required"] = "required"

    @property
    def navigation(self) -> Navigation:
        """Navigation records of the satellites."""
        return self.models.navigation

    def satellites(
        self, time: Datetimes, channels: Channels, code_m: Floats, *, max_age_s: float | None = None
    ) -> SourceSatellites:
        """Return corrected satellites, computed from the records to which the corrections refer."""
        fixes = self.service.satellites(time, channels.satellite, self.navigation)
        states = satellite_states(
            time, channels.satellite, channels.signal, code_m, self.navigation, max_age_s=max_age_s,
            record=fixes.record,
        )  # fmt: skip
        states, lacking = apply_dfmc(states, fixes, channels.satellite, channels.signal)
        return SourceSatellites(states, None, lacking, fixes)

    def delays(self, time: Datetimes, channels: Channels, satellites: SourceSatellites, seen: SeenFrom) -> SourceDelays:
        """Return modelled ionospheric delays and DO-229D tropospheric delays, with the sigmas of the corrections."""
        fixes = satellites.fixes
        assert isinstance(fixes, DfmcCorrections)
        delays = dfmc_delays(fixes, time, seen, self.models.delays(time, channels, satellites, seen).delays)
        return SourceDelays(delays, delays.sigma_m, delays.sigma_m, np.zeros(delays.sigma_m.shape))


SBAS_SIGNAL: Final = "1C"  #: RINEX 3 code of the signal that is corrected: GPS L1 C/A.

_REASON_OF: Final = {
    **dict.fromkeys(SatelliteState, Reason.SBAS_NO_CORRECTION),
    SatelliteState.OK: Reason.USED,
    SatelliteState.NOT_IN_MASK: Reason.SBAS_NOT_COVERED,
    SatelliteState.TIMED_OUT: Reason.SBAS_TIMED_OUT,
    SatelliteState.GEO_STOPPED: Reason.SBAS_DO_NOT_USE,
    SatelliteState.DO_NOT_USE: Reason.SBAS_DO_NOT_USE,
    SatelliteState.NOT_MONITORED: Reason.SBAS_DO_NOT_USE,
    SatelliteState.UDREI_TOO_LARGE: Reason.SBAS_DO_NOT_USE,
}
#: Rejection reason of each `SatelliteState`, by the number of the state.
REASONS: Final = np.array([int(_REASON_OF[state]) for state in sorted(SatelliteState)], dtype=np.int64)


_DFMC_REASON_OF: Final = {
    **dict.fromkeys(DfmcState, Reason.SBAS_NO_CORRECTION),
    DfmcState.OK: Reason.USED,
    DfmcState.NOT_IN_MASK: Reason.SBAS_NOT_COVERED,
    DfmcState.TIMED_OUT: Reason.SBAS_TIMED_OUT,
    DfmcState.STOPPED: Reason.SBAS_DO_NOT_USE,
    DfmcState.DO_NOT_USE: Reason.SBAS_DO_NOT_USE,
}
#: Rejection reason of each `DfmcState`, by the number of the state.
DFMC_REASONS: Final = np.array([int(_DFMC_REASON_OF[state]) for state in sorted(DfmcState)], dtype=np.int64)


def apply_dfmc(
    states: SatelliteStates, fixes: DfmcCorrections, satellite: Strings, signal: Strings
) -> tuple[SatelliteStates, Bits]:
    """Return satellites with the corrections of SBAS on L5 applied, and rejection reasons, shape (T, K)."""
    covered = [code in DFMC_SIGNALS.get(name[0], ((),))[0] for name, code in zip(satellite, signal, strict=True)]
    moved, clock = states.position_ecef_m + fixes.position_m, states.clock_m + fixes.clock_m
    reason = np.where(covered, DFMC_REASONS[fixes.state], int(Reason.SBAS_NOT_COVERED))
    return replace(states, position_ecef_m=moved, clock_m=clock), reason


def dfmc_delays(fixes: DfmcCorrections, time: Datetimes, seen: SeenFrom, modelled: Delays) -> Delays:
    """Return tropospheric (DO-229D) and modelled ionospheric delays, and the sigma of corrected ionosphere-free codes.

    ``sigma^2 = sigma_corrections^2 + sigma_ionosphere^2 + sigma_troposphere^2`` (ED-259A), without receiver noise. The
    modelled ionospheric delay cancels in ionosphere-free codes.
    """
    sight = seen.satellite_ecef_m - seen.receiver_ecef_m[:, None, :]
    along = fixes.sigma_along_m(sight / np.linalg.norm(sight, axis=-1, keepdims=True))
    elevation = seen.elevation_deg
    variance = along**2 + residual_ionosphere_m(elevation) ** 2 + rtca_troposphere_sigma_m(elevation) ** 2
    return Delays(
        ionosphere_m=modelled.ionosphere_m,
        troposphere_m=rtca_troposphere_m(time, seen.latitude_deg, seen.height_m, elevation),
        sigma_m=np.where(fixes.state == DfmcState.OK, np.sqrt(variance), np.nan),
        reason=np.zeros(fixes.state.shape, dtype=np.int64),
    )


def apply_long_term(states: SatelliteStates, fixes: SatelliteCorrections) -> tuple[SatelliteStates, Bits]:
    """Return satellites with long-term corrections applied, and rejection reasons, shape (T, K)."""
    moved = states.position_ecef_m + np.nan_to_num(fixes.position_m)
    clock = states.clock_m + SPEED_OF_LIGHT * np.nan_to_num(fixes.clock_s)
    return replace(states, position_ecef_m=moved, clock_m=clock), REASONS[fixes.state]


def sbas_delays(
    sbas: SbasCorrections, fixes: SatelliteCorrections, time: Datetimes, seen: SeenFrom, frequency_hz: Floats
) -> Delays:
    """Return delays from the ionospheric grid and DO-229D's troposphere, and range sigmas; NaN if uncorrected."""
    shape = fixes.state.shape
    ionosphere, troposphere, sigma = np.full((3, *shape), np.nan)
    reason = np.zeros(shape, dtype=np.int64)
    some = np.flatnonzero((fixes.state == SatelliteState.OK).any(axis=0))
    if len(some):
        part = fixes.take_satellites(some)
        latitude, longitude, height = seen.latitude_deg, seen.longitude_deg, seen.height_m
        elevation, azimuth = seen.elevation_deg[:, some], seen.azimuth_deg[:, some]
        grid = sbas.ionosphere(time, latitude, longitude, elevation, azimuth)
        sight = seen.satellite_ecef_m[:, some] - seen.receiver_ecef_m[:, None, :]
        sight = sight / np.linalg.norm(sight, axis=-1, keepdims=True)
        flt = part.sigma_flt_m(sbas.delta_udre(time, part, sight, latitude, longitude))
        scale = (FREQUENCY_L1 / frequency_hz[some]) ** 2
        known = (grid.state == IonosphereState.OK) & np.isfinite(grid.sigma_uire_m)
        variance = flt**2 + (scale * grid.sigma_uire_m) ** 2 + rtca_troposphere_sigma_m(elevation) ** 2
        unknown = np.where(known, 0, int(Reason.SBAS_NO_IONOSPHERE))
        corrected = part.state == SatelliteState.OK
        ionosphere[:, some] = scale * np.where(known & corrected, grid.delay_m, np.nan)
        troposphere[:, some] = np.where(corrected, rtca_troposphere_m(time, latitude, height, elevation), np.nan)
        sigma[:, some] = np.where(corrected, np.sqrt(variance), np.nan)
        reason[:, some] = np.where(corrected, unknown, 0)
    return Delays(ionosphere_m=ionosphere, troposphere_m=troposphere, sigma_m=sigma, reason=reason)
