"""Standard deviations of corrected pseudoranges: receiver noise, multipath, satellite and atmospheric errors."""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats
from railfix.core.settings import Settings
from railfix.ranges.atmosphere import thin_shell_obliquity

_CN0_REFERENCE_DBHZ: Final = 45.0  #: C/N0 to which `zenith_sigma_m` refers.
_CN0_CAP_DBHZ: Final = 50.0  #: Above this C/N0, sigma does not decrease further.


class CodeNoise(Settings):
    """Standard deviation of a corrected pseudorange from C/N0 and elevation.

    ``sigma^2 = floor_sigma_m^2 + (zenith_sigma_m * 10^((cn0_reference - min(C/N0, cn0_cap)) / 20) / sin(el))^2``
    """

    model: Literal["cn0_elevation", "elevation"] = "cn0_elevation"  #: "elevation" omits the C/N0 factor.
    #: Standard deviation of codes of a satellite at the zenith with 45 dB-Hz, without the floor. Only ratios of sigmas
    #: affect the position, because the receiver's noise scale is estimated from residuals (`pipeline.AntennaState`).
    zenith_sigma_m: float = Field(default=1.0, gt=0)
    #: Error floor: sigma of residual errors of satellite clock and orbit, ionosphere and troposphere.
    floor_sigma_m: float = Field(default=1.0, ge=0)


def code_sigma_m(cn0_dbhz: Floats, elevation_deg: Floats, *, noise: CodeNoise | None = None) -> Floats:
    """Return the sigma of corrected pseudoranges, shape (T, M) [m]; NaN at elevations up to 0.1 deg.

    The reference C/N0 is assumed where the C/N0 is NaN.
    """
    noise = noise or CodeNoise()
    sine = np.sin(np.radians(np.where(elevation_deg > 0.1, elevation_deg, np.nan)))
    sigma = noise.zenith_sigma_m / sine
    if noise.model == "cn0_elevation":
        cn0 = np.where(np.isnan(cn0_dbhz), _CN0_REFERENCE_DBHZ, np.minimum(cn0_dbhz, _CN0_CAP_DBHZ))
        sigma = sigma * np.exp((_CN0_REFERENCE_DBHZ - cn0) * (np.log(10.0) / 20.0))
    return np.asarray(np.hypot(sigma, noise.floor_sigma_m))


#: `satellite_sigma_m` covers accuracies stated in records (URA, SISA) up to this value [m]; 2 to 4.85 m are usual. If a
#: record states more, the stated value is added in quadrature to the sigma of the satellite's ranges.
_USUAL_ACCURACY_M: Final = 5.0


class NominalErrors(Settings):
    """For ranges without SBAS: assumed standard deviations of the errors that a local error model does not cover.

    ``sigma^2 = satellite^2 + max(ionosphere F(el), share I)^2 + (troposphere m(el))^2`` with the mappings of DO-229D
    (A.4.4.10.4 and A.4.2.4) and the modelled slant delay I.
    """

    #: Sigma of the range error due to orbit and clock. The error is about half a metre for GPS and Galileo; their
    #: service definitions state 2 m as the 95 % bound.
    satellite_sigma_m: float = Field(default=0.8, ge=0)
    #: Sigma of the vertical delay of the Klobuchar model. The error is mostly common to all satellites, but treated as
    #: independent.
    ionosphere_sigma_m: float = Field(default=1.0, ge=0)
    #: Minimum ionospheric sigma as a fraction of the modelled slant delay; DO-229D J.2.3 uses one fifth. If this
    #: fraction of the vertical delay exceeds 1 m, the filter's sigma and the protection level also increase. They do
    #: not increase if SBAS or a base station corrects the ionosphere. 0 disables the minimum.
    ionosphere_share: float = Field(default=0.2, ge=0)
    #: Additional sigma of the vertical delay if typical Klobuchar coefficients are used because none were received.
    typical_ionosphere_sigma_m: float = Field(default=2.0, ge=0)
    #: Sigma of the vertical delay of the standard atmosphere (DO-229D A.4.2.4).
    troposphere_sigma_m: float = Field(default=0.12, ge=0)

    def sigma_m(self, elevation_deg: Floats, ionosphere_m: Floats) -> Floats:
        """Return the range error sigma, any shape [m]; NaN at elevations up to 0.1 deg.

        `ionosphere_m` has the modelled slant delays, of the same shape; NaN or 0 without a model.
        """
        sine = np.sin(np.radians(np.where(elevation_deg > 0.1, elevation_deg, np.nan)))
        wet = 1.001 / np.sqrt(0.002001 + sine**2)
        constant = self.ionosphere_sigma_m * thin_shell_obliquity(elevation_deg)
        ionosphere = np.where(
            self.ionosphere_share * ionosphere_m > constant, self.ionosphere_share * ionosphere_m, constant
        )
        parts = (self.satellite_sigma_m**2, ionosphere**2)
        return np.asarray(np.sqrt(sum(parts) + (self.troposphere_sigma_m * wet) ** 2))

    def vertical_ionosphere_m(self, vertical_m: Floats) -> Floats:
        """Return the sigma of modelled vertical delays, any shape [m]."""
        return np.maximum(self.ionosphere_sigma_m, self.ionosphere_share * vertical_m)

    def unusual_sigma_m(self, accuracy_m: Floats) -> Floats:
        """Return broadcast accuracies that are worse than usual [m], any shape; 0 for usual and unknown accuracies."""
        return np.where(accuracy_m > _USUAL_ACCURACY_M, accuracy_m, 0.0)
