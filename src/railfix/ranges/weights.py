"""Signal choice and standard deviations of corrected pseudoranges.

A corrected pseudorange is ``P = code + c dt_sv - c TGD - I - T`` (P1 2.2(2): satellite clock, ionosphere and
troposphere are predicted, the receiver clock is estimated).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, Literal

import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats, Indices, Masks, Strings
from railfix.core.constants import CLOCK_GROUP
from railfix.core.settings import Settings
from railfix.ranges.atmosphere import thin_shell_obliquity

#: A pseudorange lies between these [m]: nearest satellite less a receiver clock 33 ms off, GEO plus the same.
PLAUSIBLE_CODE_M: Final = (1e7, 1e8)


#: Signals near L1 in order of preference, RINEX 3 codes without the type letter.
DEFAULT_SIGNALS: Final[Mapping[str, tuple[str, ...]]] = {
    "G": ("1C", "1W", "1P", "1X", "1L", "1S"),
    "J": ("1C", "1X", "1L", "1S", "1Z"),
    "E": ("1C", "1X", "1B", "1Z", "1A"),
    "C": ("2I", "2X", "2Q"),
    "R": ("1C", "1P"),
}

#: Second signals in order of preference. L2 comes before L5 for GPS and QZSS: LNAV lacks the delay of L5
#: (`signal_health.group_delay_sigma_m`).
SECOND_SIGNALS: Final[Mapping[str, tuple[str, ...]]] = {
    "G": ("2L", "2X", "2S", "2W", "5Q", "5X", "5I"),
    "J": ("2L", "2X", "2S", "5Q", "5X", "5I"),
    "E": ("5Q", "5X", "5I", "7Q", "7X", "7I"),
    "C": ("7I", "7Q", "7X", "6I", "6Q", "6X", "5P", "5X", "5D"),
}

#: Signals that SBAS on L5 corrects, first and second, by constellation.
DFMC_SIGNALS: Final[Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]]] = {
    "G": (("1C",), ("5Q", "5X", "5I")),
    "E": (("1C", "1X", "1B"), ("5Q", "5X", "5I")),
}


class CodeNoise(Settings):
    """Standard deviation of a corrected pseudorange from C/N0 and elevation.

    ``sigma^2 = floor_sigma_m^2 + (zenith_sigma_m * 10^((cn0_reference - min(C/N0, cn0_cap)) / 20) / sin(el))^2``
    """

    model: Literal["cn0_elevation", "elevation"] = "cn0_elevation"  #: "elevation" leaves the C/N0 factor out.
    #: At the zenith and the reference C/N0. Only ratios matter to the position: its value for a receiver is estimated
    #: from the residuals (`pipeline.AntennaState`).
    zenith_sigma_m: float = Field(default=1.0, gt=0)
    #: Error floor: residual errors of satellite clock and orbit, ionosphere and troposphere.
    floor_sigma_m: float = Field(default=1.0, ge=0)
    #: A C/N0 above the cap counts as the cap.
    cn0_reference_dbhz: float = 45.0
    cn0_cap_dbhz: float = 50.0


def code_sigma_m(cn0_dbhz: Floats, elevation_deg: Floats, *, noise: CodeNoise | None = None) -> Floats:
    """Standard deviation of corrected pseudoranges, shape (T, M) [m].

    Where C/N0 is NaN (a log without it) the reference C/N0 is taken. NaN at or below the horizon.
    """
    noise = noise or CodeNoise()
    sine = np.sin(np.radians(np.where(elevation_deg > 0.1, elevation_deg, np.nan)))
    sigma = noise.zenith_sigma_m / sine
    if noise.model == "cn0_elevation":
        cn0 = np.where(np.isnan(cn0_dbhz), noise.cn0_reference_dbhz, np.minimum(cn0_dbhz, noise.cn0_cap_dbhz))
        sigma = sigma * np.exp((noise.cn0_reference_dbhz - cn0) * (np.log(10.0) / 20.0))
    return np.asarray(np.hypot(sigma, noise.floor_sigma_m))


class NominalErrors(Settings):
    """Assumed standard deviations of the errors that a local error model does not cover, where SBAS gives none.

    ``sigma^2 = satellite^2 + (ionosphere F(el))^2 + (troposphere m(el))^2`` with the mappings of DO-229D
    (A.4.4.10.4 and A.4.2.4).
    """

    #: Orbit and clock in the range; GPS and Galileo stay near half a metre, their service definitions promise 2 m and
    #: 95 % of the time less.
    satellite_sigma_m: float = Field(default=0.8, ge=0)
    #: Accuracies of records (URA, SISA) up to this stand for `satellite_sigma_m`: 2 to 4.85 m are usual. A worse one is
    #: believed: it is added to the sigma of the satellite's ranges.
    usual_accuracy_m: float = Field(default=5.0, gt=0)
    #: Vertical delay that Klobuchar's model leaves. Mostly common to all satellites, taken as independent.
    ionosphere_sigma_m: float = Field(default=1.0, ge=0)
    #: Added to it, and to the ranges, with typical coefficients: what the two models differ by.
    typical_ionosphere_sigma_m: float = Field(default=2.0, ge=0)
    #: Vertical delay that the standard atmosphere leaves (DO-229D A.4.2.4).
    troposphere_sigma_m: float = Field(default=0.12, ge=0)

    def sigma_m(self, elevation_deg: Floats) -> Floats:
        """Standard deviation at elevations, any shape [m]; NaN below the horizon."""
        sine = np.sin(np.radians(np.where(elevation_deg > 0.1, elevation_deg, np.nan)))
        wet = 1.001 / np.sqrt(0.002001 + sine**2)
        parts = (self.satellite_sigma_m**2, (self.ionosphere_sigma_m * thin_shell_obliquity(elevation_deg)) ** 2)
        return np.asarray(np.sqrt(sum(parts) + (self.troposphere_sigma_m * wet) ** 2))

    def stated_m(self, accuracy_m: Floats) -> Floats:
        """Accuracies of records, any shape, where they are worse than usual; 0 for the others and for unknown ones."""
        return np.where(accuracy_m > self.usual_accuracy_m, accuracy_m, 0.0)


def channel_order(
    satellite: Strings,
    signal: Strings,
    *,
    systems: Sequence[str],
    signals: Mapping[str, Sequence[str]],
) -> Indices:
    """Channels that may be used, those of one clock side by side, a satellite's best signal first.

    Parameters
    ----------
    satellite, signal : ndarray of str, shape (M,)
    systems : sequence of str
        Constellations asked for.
    signals : mapping of str to sequence of str
        Signals of each constellation in order of preference.

    Returns
    -------
    ndarray of int, shape (K,)
        Indices into the channels.
    """
    keys = []
    for i, (name, code) in enumerate(zip(satellite.tolist(), signal.tolist(), strict=True)):
        letter = name[0]
        preference = signals.get(letter, ())
        if letter in systems and code in preference:
            keys.append((CLOCK_GROUP[letter], name, preference.index(code), i))
    return np.array([key[-1] for key in sorted(keys)], dtype=np.intp)


def first_available(satellite: Strings, available: Masks) -> Masks:
    """One channel a satellite and epoch: the first available one.

    Parameters
    ----------
    satellite : ndarray of str, shape (K,)
        Channels of one satellite side by side, best first (`channel_order`).
    available : ndarray of bool, shape (T, K)

    Returns
    -------
    ndarray of bool, shape (T, K)
    """
    starts = np.flatnonzero(np.append(True, satellite[1:] != satellite[:-1])) if len(satellite) else np.empty(0, int)
    if len(starts) == len(satellite):
        return available.copy()
    count = np.cumsum(available, axis=1)
    before = np.where(starts > 0, count[:, starts - 1], 0)
    offset = np.repeat(before, np.diff(np.append(starts, len(satellite))), axis=1)
    return np.asarray(available & (count - offset == 1))
