"""Settings of the along-track filter, each with the reason for its default."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats
from railfix.core.constants import SUPPORTED_SIDE_PRIOR
from railfix.core.settings import Settings


class Tails(NamedTuple):
    """Degrees of freedom of the Student t distribution of measurement errors."""

    usual: float
    #: Degrees of freedom for codes longer than expected: a reflected signal arrives late, and its excess path has no
    #: typical length. Small errors of either sign have the same weight.
    late: float

    def weight(self, residual: Floats, square: Floats) -> Floats:
        """Return the weights of codes, same shape as their residuals and normalised squared residuals."""
        degrees = np.where(residual > 0.0, self.late, self.usual)
        return np.asarray((self.usual + 1.0) / self.usual * degrees / (degrees + square))

    def log_density(self, residual: Floats, square: Floats) -> Floats:
        """Return the log density from which `weight` follows; the maximum is 0."""
        degrees = np.where(residual > 0.0, self.late, self.usual)
        return np.asarray(-0.5 * (self.usual + 1.0) / self.usual * degrees * np.log1p(square / degrees))


class TrackingLimits(Settings):
    """Process and measurement noise of the filter, and criteria for keeping and searching branches."""

    #: Standard deviation and correlation time of the acceleration along the track (R. A. Singer, 1970). Trains brake
    #: and accelerate at up to 1.3 m/s2 for some seconds; road vehicles reach higher rates for shorter times.
    acceleration_mps2: float = Field(default=1.0, gt=0)
    acceleration_s: float = Field(default=2.0, gt=0)
    #: Largest acceleration that is accepted if fewer than `trusted_satellites` satellites and no speed sensor measure
    #: the speed. Near a wall or under a station roof, such a speed may come from consistent reflections alone
    #: (`kernels.tracking.model.narrow_speed_range`).
    service_acceleration_mps2: float = Field(default=1.5, gt=0)
    trusted_satellites: int = Field(default=7, ge=0)
    #: Degrees of freedom of the Student t distribution of measurement errors; 4 fits urban code errors.
    degrees_of_freedom: float = Field(default=4.0, gt=2)
    #: Degrees of freedom for codes longer than expected. Reflections arrive late, and with one degree of freedom
    #: (Cauchy) their mean delay is unbounded. The value was chosen from 0.4, 1 and 4 (symmetric) on logs from Hong Kong
    #: and California. Positions improve equally in logs that were not used for the choice (docs/filter.md).
    late_degrees_of_freedom: float = Field(default=1.0, gt=0)
    #: Standard deviation of the white part of the code error in one second, as a fraction of the code sigma.
    code_white_share: float = Field(default=1.0, gt=0)
    #: Interval at which codes are used while phases or Dopplers propagate the position; 0 for every epoch. Code errors
    #: last about a minute, so that codes at intermediate epochs add no information.
    code_period_s: float = Field(default=1.0, ge=0)
    #: Standard deviation of the displacement along the line by orbit and ionospheric errors: about 1 m per satellite,
    #: with a dilution of precision of one. The errors last for hours, so that averaging does not reduce them.
    slow_code_m: float = Field(default=1.0, ge=1e-6)
    #: Doppler noise: ``sigma^2 = floor^2 + (zenith 10^((45 - C/N0) / 20))^2``, with C/N0 limited to 50 dB-Hz, or 45
    #: dB-Hz if C/N0 is unknown.
    doppler_floor_mps: float = Field(default=0.03, gt=0)
    doppler_zenith_mps: float = Field(default=0.05, gt=0)
    #: Floor and zenith value of the noise formula of Dopplers, for the change of a carrier phase between two epochs.
    phase_floor_m: float = Field(default=0.01, gt=0)
    phase_zenith_m: float = Field(default=0.01, gt=0)
    #: Largest mean innovation over half a minute that the assumed length error of the map explains, in sigmas.
    map_misfit_sigmas: float = Field(default=3.0, gt=0)
    most_hypotheses: int = Field(default=24, ge=1)  #: Largest number of hypotheses; the most probable ones are kept.
    start_separation_m: float = Field(default=60.0, gt=0)  #: Smallest distance between the positions of a search.
    #: "on" to compute a protection level with a bank of sub-filters, about one per satellite.
    level: Literal["on", "off"] = "on"
    #: Interval of the epochs that the bank processes. Codes of neighbouring epochs have nearly the same errors.
    level_period_s: float = Field(default=1.0, gt=0)
    #: Largest acceleration assumed between the bank's epochs. Emergency braking reaches 3 m/s2 (magnetic track brakes).
    #: After a rejected speed, the range of accepted speeds grows at this rate.
    level_acceleration_mps2: float = Field(default=3.0, ge=0)
    #: Probability per hour that the error exceeds the protection level without a warning. P1 2.4 requires 1e-7.
    level_risk_per_hour: float = Field(default=1e-7, gt=0, lt=1)
    #: Number of independent errors per hour. Code errors last about a minute.
    level_samples_per_hour: float = Field(default=60.0, gt=0)
    #: Probability that a satellite is faulty in one independent sample, because city multipath exceeds the assumed
    #: error. The probability of two faulty satellites is its square. The value is an assumption.
    level_fault_prior: float = Field(default=1e-3, ge=0, lt=1)
    #: Probability of a fault common to a constellation. The ARAIM milestone 3 report assumes 1e-4 for Galileo.
    level_constellation_prior: float = Field(default=1e-4, ge=0, lt=1)
    #: Probability that an on-board sensor is faulty in one independent sample. The value is an assumption.
    level_sensor_prior: float = Field(default=1e-3, ge=0, lt=1)
    #: Probability that a balise is not at its listed position. The value is an assumption. A small value is required,
    #: because the protection level does not cover two balises wrong at the same time.
    level_balise_prior: float = Field(default=1e-6, ge=0, le=3e-6)
    #: Probability that all Dopplers, or all phases, are wrong together. The value is an assumption.
    level_motion_prior: float = Field(default=1e-5, ge=0, lt=1)
    #: Probability that the codes of all satellites ahead, or of all satellites behind, are late at the same time. In
    #: single epochs, this occurs with low satellites on one side. The value is an assumption.
    level_side_prior: float = Field(default=SUPPORTED_SIDE_PRIOR, ge=0, lt=1)
    #: Probability that the map is wrong by more than its stated sigma, and sigma of this wrong map. Both are assumed.
    level_map_prior: float = Field(default=1e-3, ge=0, lt=1)
    level_map_m: float = Field(default=30.0, gt=0)
    #: Probability of an ionospheric storm or the equatorial anomaly, which displace positions along the line with the
    #: sigma `tracking.line.TILT_M` instead of `slow_code_m`. The value is an assumption.
    level_tilt_prior: float = Field(default=1e-3, ge=0, lt=1)
