"""Settings of the filter along the track, each with the reason for its default."""

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
    #: Degrees of freedom for codes longer than expected. A reflected signal arrives late, never early, and the excess
    #: path has no typical length. Small errors have the same weight on both sides.
    late: float

    def weight(self, residual: Floats, square: Floats) -> Floats:
        """Return the weights of codes from their residuals and normalised squared residuals, same shape."""
        degrees = np.where(residual > 0.0, self.late, self.usual)
        return np.asarray((self.usual + 1.0) / self.usual * degrees / (degrees + square))

    def log_density(self, residual: Floats, square: Floats) -> Floats:
        """Return the log density that corresponds to `weight`, with the same parameters; 0 at the maximum."""
        degrees = np.where(residual > 0.0, self.late, self.usual)
        return np.asarray(-0.5 * (self.usual + 1.0) / self.usual * degrees * np.log1p(square / degrees))


class TrackingLimits(Settings):
    """Process and measurement noise of the filter, and criteria for keeping and searching branches."""

    #: Standard deviation and correlation time of the acceleration along the track (R. A. Singer, 1970). Trains brake
    #: and accelerate at up to 1.3 m/s2 for some seconds; cars at higher rates, for shorter times.
    acceleration_mps2: float = Field(default=1.0, gt=0)
    acceleration_s: float = Field(default=2.0, gt=0)
    #: Largest acceleration assumed for a speed from fewer satellites than `trusted_satellites`, without a speed sensor.
    #: Near a wall or under a station roof, only reflections may remain, which are consistent with each other
    #: (`kernels.tracking.model.narrow_speed_range`).
    service_acceleration_mps2: float = Field(default=1.5, gt=0)
    trusted_satellites: int = Field(default=7, ge=0)
    #: Degrees of freedom of the Student t distribution of measurement errors; 4 fits urban code errors.
    degrees_of_freedom: float = Field(default=4.0, gt=2)
    #: Degrees of freedom for codes longer than expected. Reflections arrive late, and with one degree of freedom
    #: (Cauchy) their mean delay is unbounded. The value was chosen from 0.4, 1 and 4 (symmetric) on logs from Hong Kong
    #: and California; logs from Berlin, and from Hong Kong two years earlier, were not used for the choice, and improve
    #: equally (docs/filter.md).
    late_degrees_of_freedom: float = Field(default=1.0, gt=0)
    #: White part of the code error in one second, as a fraction of the code's standard deviation.
    code_white_share: float = Field(default=1.0, gt=0)
    #: Interval at which codes are used while phases or Dopplers propagate the position. Code errors last for a minute,
    #: so that codes at intermediate epochs add no information. With 0, the codes of every epoch are used.
    code_period_s: float = Field(default=1.0, ge=0)
    #: Standard deviation of the displacement by orbit and ionospheric errors, which last for hours. The errors are
    #: about 1 m per satellite, with a dilution of one; averaging over epochs does not reduce them.
    slow_code_m: float = Field(default=1.0, ge=1e-6)
    #: Doppler noise: ``sigma^2 = floor^2 + (zenith 10^((45 - C/N0) / 20))^2``; C/N0 at most 50 dB-Hz, 45 if unknown.
    doppler_floor_mps: float = Field(default=0.03, gt=0)
    doppler_zenith_mps: float = Field(default=0.05, gt=0)
    #: Floor and zenith value of the same formula for the change of a carrier phase over an epoch.
    phase_floor_m: float = Field(default=0.01, gt=0)
    phase_zenith_m: float = Field(default=0.01, gt=0)
    #: Mean innovation over half a minute, in sigmas, above which the map's length error is taken to exceed its sigma.
    map_misfit_sigmas: float = Field(default=3.0, gt=0)
    most_hypotheses: int = Field(default=24, ge=1)  #: Largest number of hypotheses; the most probable are kept.
    start_separation_m: float = Field(default=60.0, gt=0)  #: Distance within which positions of a search are merged.
    #: Whether a bank of sub-filters, about one per satellite, computes a protection level.
    level: Literal["on", "off"] = "on"
    #: Interval of the epochs processed by the bank. Codes of neighbouring epochs have the same errors.
    level_period_s: float = Field(default=1.0, gt=0)
    #: Largest acceleration assumed between the bank's epochs. Emergency braking reaches 3 m/s2 (magnetic track brakes).
    #: The value also limits the next speed after an epoch whose speed was not accepted.
    level_acceleration_mps2: float = Field(default=3.0, ge=0)
    #: Probability per hour that the error exceeds the level without warning. P1 2.4 requires 1e-7.
    level_risk_per_hour: float = Field(default=1e-7, gt=0, lt=1)
    #: Number of independent errors per hour. Code errors last about a minute.
    level_samples_per_hour: float = Field(default=60.0, gt=0)
    #: Probability that a satellite is faulty in one independent sample, because city multipath exceeds the assumed
    #: error. For two satellites, the square of this probability is used. The value is an assumption.
    level_fault_prior: float = Field(default=1e-3, ge=0, lt=1)
    #: Probability of a fault common to a constellation. The ARAIM milestone 3 report has 1e-4 for Galileo.
    level_constellation_prior: float = Field(default=1e-4, ge=0, lt=1)
    #: Probability that an on-board sensor is faulty in one independent sample. The value is an assumption.
    level_sensor_prior: float = Field(default=1e-3, ge=0, lt=1)
    #: Probability that a balise is not at its listed position. The value is an assumption. A small value is required,
    #: because the level does not cover two simultaneously wrong balises.
    level_balise_prior: float = Field(default=1e-6, ge=0, le=3e-6)
    #: Probability that all Dopplers, or all phases, are wrong together. The value is an assumption.
    level_motion_prior: float = Field(default=1e-5, ge=0, lt=1)
    #: Probability that the codes of all satellites ahead, or of all satellites behind, are late together, as for the
    #: low satellites of one side in single epochs. The value is an assumption.
    level_side_prior: float = Field(default=SUPPORTED_SIDE_PRIOR, ge=0, lt=1)
    #: Probability that the map is wrong by more than the stated sigma, and sigma of a wrong map. Both are assumptions.
    level_map_prior: float = Field(default=1e-3, ge=0, lt=1)
    level_map_m: float = Field(default=30.0, gt=0)
    #: Probability that a storm or the equatorial anomaly tilts the ionosphere over the sky by more than `slow_code_m`
    #: (size of the tilt in `tracking.line.TILT_M`). The value is an assumption.
    level_tilt_prior: float = Field(default=1e-3, ge=0, lt=1)
