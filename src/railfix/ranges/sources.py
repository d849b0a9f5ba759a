"""Interface of correction sources, and the source that uses broadcast records or precise orbits.

`base_station` and `sbas.sbas_sources` contain the sources with a base station and with SBAS.

`satellites` of a source returns the satellites at the times of transmission; `delays` returns the delays of their
signals at an approximate position of the antenna.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, NamedTuple, Protocol

import numpy as np

from railfix.core.arrays import Bits, Datetimes, Floats, Integers
from railfix.gnss.navigation import Navigation
from railfix.gnss.orbits import SatelliteStates, satellite_states
from railfix.ranges.atmosphere import TYPICAL_KLOBUCHAR, Delays, SeenFrom, model_delays
from railfix.ranges.channels import Channels
from railfix.ranges.range_sigma import NominalErrors


class SourceSatellites(NamedTuple):
    """Satellites of a source, T epochs by K channels."""

    states: SatelliteStates  #: States at the times of transmission, with the source's corrections.
    fast_m: Floats | None  #: Corrections added to the codes besides satellite clocks, (T, K); None without SBAS.
    reason: Bits  #: Rejection reasons of satellites that the source does not correct, shape (T, K).
    fixes: object = None  #: Corrections of the satellites, passed on to `delays` of the source.


@dataclass(frozen=True, kw_only=True)
class BaseDifferences:
    """Corrections from a base station to the ranges of a train, T epochs by K channels."""

    #: Errors at the station, subtracted from codes and phases, shape (T, K); NaN if the station has no recent value.
    code_m: Floats
    phase_m: Floats
    arc: Integers  #: Arc number of the station's phase, shape (T, K); -1 if the station has no recent phase.
    #: Sigma of the satellite and atmospheric errors that remain after the code correction, shape (T, K).
    sigma_m: Floats


class SourceDelays(NamedTuple):
    """Delays from a correction source and range error sigmas, T epochs by K channels."""

    delays: Delays  #: Delays that are subtracted from the codes.
    sigma_m: Floats  #: Sigma added in quadrature to receiver noise for the weights, shape (T, K).
    #: Sigma of satellite and atmospheric errors, and the part of this sigma computed by `NominalErrors`; shape (T, K).
    nominal_m: Floats
    nominal_elevation_sigma_m: Floats
    base: BaseDifferences | None = None  #: Base-station corrections to be subtracted, or None.
    floor: Literal["added", "included"] = "added"  #: "included": `sigma_m` contains the error floor of codes.


class CorrectionSource(Protocol):
    """Source of satellite positions, clocks and delays of pseudoranges."""

    @property
    def navigation(self) -> Navigation:
        """Navigation records of the satellites."""

    @property
    def second(self) -> Literal["none", "optional", "required"]:
        """Use of second-frequency codes: not used, used where available, or required."""

    def satellites(
        self, time: Datetimes, channels: Channels, code_m: Floats, *, max_age_s: float | None = None
    ) -> SourceSatellites:
        """Return the satellites at the transmission times of the codes `code_m`, shape (T, K)."""

    def delays(self, time: Datetimes, channels: Channels, satellites: SourceSatellites, seen: SeenFrom) -> SourceDelays:
        """Return the signal delays at approximate antenna positions."""


def choose_ionosphere(
    navigation: Navigation, ionosphere: str, nominal: NominalErrors
) -> tuple[Floats | None, float, tuple[str, ...]]:
    """Return Klobuchar coefficients, their additional vertical delay sigma [m], and notes on substituted coefficients.

    The order of preference is GPS coefficients, QZSS coefficients, `TYPICAL_KLOBUCHAR`; the coefficients are None if
    `ionosphere` is "off". BeiDou's coefficients are not used, because they are for a different model.
    """
    if ionosphere == "off":
        return None, 0.0, ()
    known = navigation.klobuchar
    if "G" in known or "J" in known:
        notes = () if "G" in known else ("ionosphere: klobuchar requested; QZSS coefficients are used",)
        return known.get("G", known.get("J")), 0.0, notes
    sigma = nominal.typical_ionosphere_sigma_m
    note = (
        "ionosphere: klobuchar requested, but no coefficients of GPS or QZSS were received; typical coefficients (GPS, "
        f"2004-01-01) are used, with {sigma:g} m added to the sigma of the vertical delay"
    )
    return TYPICAL_KLOBUCHAR, sigma, (note,)


@dataclass(frozen=True, kw_only=True)
class BroadcastSource:
    """Source that uses delay models and precise orbits and clocks; without precise data, broadcast records."""

    navigation: Navigation
    klobuchar: Floats | None  #: Coefficients, shape (8,); if None, ionospheric delays remain uncorrected.
    #: Additional sigma of the vertical delay if typical coefficients are used; 0 if the coefficients were received.
    ionosphere_sigma_m: float = 0.0
    troposphere: Literal["saastamoinen", "off"] = "saastamoinen"
    nominal: NominalErrors = field(default_factory=NominalErrors)  #: Assumed satellite and atmospheric error sigmas.
    notes: tuple[str, ...] = ()  #: Notes on requested data that had to be replaced.
    second: Literal["none", "optional", "required"] = "optional"

    @classmethod
    def of(
        cls,
        navigation: Navigation,
        *,
        ionosphere: Literal["klobuchar", "off"] = "klobuchar",
        troposphere: Literal["saastamoinen", "off"] = "saastamoinen",
        nominal: NominalErrors | None = None,
    ) -> BroadcastSource:
        """Return the source with the best available ionospheric coefficients (`choose_ionosphere`)."""
        nominal = nominal or NominalErrors()
        coefficients, sigma, notes = choose_ionosphere(navigation, ionosphere, nominal)
        return cls(
            navigation=navigation, klobuchar=coefficients, ionosphere_sigma_m=sigma, troposphere=troposphere,
            nominal=nominal, notes=notes,
        )  # fmt: skip

    def satellites(
        self, time: Datetimes, channels: Channels, code_m: Floats, *, max_age_s: float | None = None
    ) -> SourceSatellites:
        """Return the satellites from navigation data; this source adds no rejection reason."""
        states = satellite_states(
            time, channels.satellite, channels.signal, code_m, self.navigation, max_age_s=max_age_s
        )
        return SourceSatellites(states, None, np.zeros(code_m.shape, dtype=np.int64))

    def delays(self, time: Datetimes, channels: Channels, satellites: SourceSatellites, seen: SeenFrom) -> SourceDelays:
        """Return the delays of the Klobuchar and Saastamoinen models."""
        delays = model_delays(
            time, seen, channels.frequency_hz, klobuchar=self.klobuchar, ionosphere_sigma_m=self.ionosphere_sigma_m,
            troposphere=self.troposphere,
        )  # fmt: skip
        beyond = np.hypot(delays.sigma_m, self.nominal.unusual_sigma_m(satellites.states.accuracy_m))
        unmodelled = self.nominal.sigma_m(seen.elevation_deg, delays.ionosphere_m)
        return SourceDelays(delays, beyond, np.hypot(unmodelled, beyond), unmodelled)
