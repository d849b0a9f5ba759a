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
    #: Degrees of freedom for codes longer than expected. They are fewer, because reflected signals arrive late, by
    #: excess paths of any length. Small errors of both signs have equal weights.
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
    """Process and measurement noise of the filter, and criteria for keeping and finding branches."""

    #: Standard deviation and correlation time of the acceleration along the track (R. A. Singer, 1970). Trains brake
    #: and accelerate at up to 1.3 m/s2 for some seconds; road vehicles reach higher values for shorter times.
    acceleration_mps2: float = Field(default=1.0, gt=0)
    acceleration_s: float = Field(default=2.0, gt=0)
    #: Largest accepted acceleration if the speed is measured by fewer than `trusted_satellites` satellites and by no
    #: sensor. Near a wall or under a station roof, such a speed may come from consistent reflections alone
    #: (`kernels.tracking.model.narrow_speed_range`).
    service_acceleration_mps2: float = Field(default=1.5, gt=0)
    trusted_satellites: int = Field(default=7, ge=0)
    #: Degrees of freedom of the Student t distribution of measurement errors; 4 fits urban code errors.
    degrees_of_freedom: float = Field(default=4.0, gt=2)
    #: Degrees of freedom for codes longer than expected. Reflections arrive late, and with one degree of freedom
    #: (Cauchy) their mean delay is unbounded. The value was chosen from 0.4, 1 and 4 (as for short codes) on logs from
    #: Hong Kong and California. Positions improve as much in logs that were not used for the choice (docs/filter.md).
    late_degrees_of_freedom: float = Field(default=1.0, gt=0)
    #: Standard deviation of the white code error, averaged over one second, as a fraction of the code sigma.
    code_white_share: float = Field(default=1.0, gt=0)
    #: Interval at which codes are used while phases or Dopplers propagate the position; 0 uses the codes of every
    #: epoch. Code errors last about a minute; codes at intermediate epochs therefore add no information.
    code_period_s: float = Field(default=1.0, ge=0)
    #: Standard deviation of the position displacement along the line by orbit and ionospheric errors: errors of about 1
    #: m per satellite, and a dilution of precision of one. The errors last for hours; averaging does not reduce them.
    slow_code_m: float = Field(default=1.0, ge=1e-6)
    #: Doppler noise: ``sigma^2 = floor^2 + (zenith 10^((45 - C/N0) / 20))^2``, with C/N0 of at most 50 dB-Hz; an
    #: unknown C/N0 counts as 45 dB-Hz.
    doppler_floor_mps: float = Field(default=0.03, gt=0)
    doppler_zenith_mps: float = Field(default=0.05, gt=0)
    #: Noise of carrier-phase changes between two epochs: floor and zenith value in the formula of the Doppler noise.
    phase_floor_m: float = Field(default=0.01, gt=0)
    phase_zenith_m: float = Field(default=0.01, gt=0)
    #: The assumed length error of the map increases if the mean code shift of half a minute exceeds this, in sigmas.
    map_misfit_sigmas: float = Field(default=3.0, gt=0)
    most_hypotheses: int = Field(default=24, ge=1)  #: Largest number of hypotheses; the most probable ones are kept.
    start_separation_m: float = Field(default=60.0, gt=0)  #: Smallest distance between positions that a search finds.
    #: "on" to compute a protection level with a bank of sub-filters, about one per satellite.
    level: Literal["on", "off"] = "on"
    #: The sub-filters use epochs that are at least this time apart. Codes of neighbouring epochs have nearly the same
    #: errors.
    level_period_s: float = Field(default=1.0, gt=0)
    #: Largest acceleration assumed between epochs that the sub-filters use. Emergency braking reaches 3 m/s2 (magnetic
    #: track brakes). After a rejected speed, the range of accepted speeds grows at this rate.
    level_acceleration_mps2: float = Field(default=3.0, ge=0)
    #: Probability per hour that the error exceeds the protection level without a warning. P1 2.4 requires 1e-7.
    level_risk_per_hour: float = Field(default=1e-7, gt=0, lt=1)
    #: Number of independent position errors per hour: code errors last about a minute.
    level_samples_per_hour: float = Field(default=60.0, gt=0)
    #: Probability that a satellite is faulty in one independent sample, because city multipath exceeds the assumed
    #: error. Two given satellites are faulty with the square of this probability. The value is an assumption.
    level_fault_prior: float = Field(default=1e-3, ge=0, lt=1)
    #: Probability that a whole constellation is faulty. The ARAIM milestone 3 report assumes 1e-4 for Galileo.
    level_constellation_prior: float = Field(default=1e-4, ge=0, lt=1)
    #: Probability that an on-board sensor is faulty in one independent sample. The value is an assumption.
    level_sensor_prior: float = Field(default=1e-3, ge=0, lt=1)
    #: Probability that a balise is not at its listed position. The value is an assumption. A small value is required,
    #: because the protection level does not cover two balises that are wrong at the same time.
    level_balise_prior: float = Field(default=1e-6, ge=0, le=3e-6)
    #: Probability that all Dopplers, or all phases, are wrong together. The value is an assumption.
    level_motion_prior: float = Field(default=1e-5, ge=0, lt=1)
    #: Probability that the codes of all satellites ahead, or of all satellites behind, are late at the same time, as
    #: the codes of low satellites on one side are in some epochs. The value is an assumption.
    level_side_prior: float = Field(default=SUPPORTED_SIDE_PRIOR, ge=0, lt=1)
    #: Probability that the map is wrong by more than its stated sigma; sigma of the map in this case. Both are assumed.
    level_map_prior: float = Field(default=1e-3, ge=0, lt=1)
    level_map_m: float = Field(default=30.0, gt=0)
    #: Probability that an ionospheric storm or the equatorial anomaly tilts the ionosphere at a given time. The sigma
    #: of slow code errors is then `tracking.line.TILT_M` instead of `slow_code_m`. The value is an assumption.
    level_tilt_prior: float = Field(default=1e-3, ge=0, lt=1)
