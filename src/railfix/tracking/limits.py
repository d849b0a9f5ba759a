"""Settings of the filter along the track, each with the reason of its default."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats
from railfix.core.constants import SUPPORTED_SIDE_PRIOR
from railfix.core.settings import Settings


class Tails(NamedTuple):
    """Degrees of freedom of Student's t, which measurement errors follow."""

    usual: float
    #: Of codes that are longer than expected: a reflected signal comes late, never early, and the way round has no
    #: typical length. The weight of a small error is the same on both sides.
    late: float

    def weight(self, residual: Floats, square: Floats) -> Floats:
        """Return the weights of codes with residuals, and mean squares of them over their variances; any shape."""
        degrees = np.where(residual > 0.0, self.late, self.usual)
        return np.asarray((self.usual + 1.0) / self.usual * degrees / (degrees + square))

    def log_density(self, residual: Floats, square: Floats) -> Floats:
        """Return the logarithm of the density whose weights are `weight`, 0 at its maximum; parameters the same."""
        degrees = np.where(residual > 0.0, self.late, self.usual)
        return np.asarray(-0.5 * (self.usual + 1.0) / self.usual * degrees * np.log1p(square / degrees))


class TrackingLimits(Settings):
    """Noise of the motion and of the measurements, and when branches are kept or sought."""

    #: Standard deviation and correlation time of the acceleration along the track (R. A. Singer, 1970). Trains brake
    #: and accelerate with up to 1.3 m/s2 and hold it for some seconds; cars with more, for shorter.
    acceleration_mps2: float = Field(default=1.0, gt=0)
    acceleration_s: float = Field(default=2.0, gt=0)
    #: Without a sensor the speed by fewer satellites is not used beyond this acceleration: one wall, or a station roof,
    #: can leave reflections alone, and they then agree with each other (`kernels.tracking.model.narrow_speed_range`).
    service_acceleration_mps2: float = Field(default=1.5, gt=0)
    trusted_satellites: int = Field(default=7, ge=0)
    #: Of Student's t that measurement errors follow: 4 is the least integer with a finite kurtosis bound of the score,
    #: and what urban code errors look like.
    degrees_of_freedom: float = Field(default=4.0, gt=2)
    #: The same of codes that are longer than expected: reflections come late, and with one degree of freedom (Cauchy)
    #: their mean delay is not bounded. Chosen on the logs of Hong Kong and California among 0.4, 1 and 4 (the same on
    #: both sides); Berlin, and Hong Kong two years earlier, were not used, and gain alike (docs/filter.md).
    late_degrees_of_freedom: float = Field(default=1.0, gt=0)
    #: White part of a code's error, over its standard deviation; per second, not per epoch.
    code_white_share: float = Field(default=1.0, gt=0)
    #: Codes count once in this time where phases or Dopplers carry on: their errors last for a minute, so the epochs
    #: between tell nothing new. 0 takes those of every epoch.
    code_period_s: float = Field(default=1.0, ge=0)
    #: Displacement by orbits and ionosphere over hours: about 1 m a satellite with a dilution of one; averaging over
    #: epochs does not take it away.
    slow_code_m: float = Field(default=1.0, ge=1e-6)
    #: ``sigma^2 = floor^2 + (zenith 10^((45 - C/N0) / 20))^2`` of a Doppler.
    doppler_floor_mps: float = Field(default=0.03, gt=0)
    doppler_zenith_mps: float = Field(default=0.05, gt=0)
    #: The same of the change of a carrier phase over an epoch.
    phase_floor_m: float = Field(default=0.01, gt=0)
    phase_zenith_m: float = Field(default=0.01, gt=0)
    #: Errors of lengths along the map larger than assumed are shown by a mean innovation of half a minute of so many
    #: sigmas.
    map_misfit_sigmas: float = Field(default=3.0, gt=0)
    most_hypotheses: int = Field(default=24, ge=1)  #: Places at most, the most probable ones.
    start_separation_m: float = Field(default=60.0, gt=0)  #: Two places of the first epoch this close are one.
    #: Whether a bank of sub-filters gives a protection level; it costs as many filters as there are satellites.
    level: Literal["on", "off"] = "on"
    #: Time between the epochs that the bank takes: codes of neighbouring epochs have the same errors.
    level_period_s: float = Field(default=1.0, gt=0)
    #: Largest acceleration between them: emergency braking of trains has up to 3 m/s2 (magnetic track brakes). After an
    #: epoch whose speed was not believed, the next one may differ by it.
    level_acceleration_mps2: float = Field(default=3.0, ge=0)
    #: Probability an hour that the error exceeds the level unnoticed: 1e-7 for the satellite part (P1 2.4).
    level_risk_per_hour: float = Field(default=1e-7, gt=0, lt=1)
    #: Independent errors an hour: those of codes last about a minute.
    level_samples_per_hour: float = Field(default=60.0, gt=0)
    #: Probability that a satellite is faulty at such a sample, two with its square: multipath beyond its weight in a
    #: city. An assumption.
    level_fault_prior: float = Field(default=1e-3, ge=0, lt=1)
    #: Probability that a fault is common to a constellation: 1e-4, that of the ARAIM milestone 3 report for Galileo.
    level_constellation_prior: float = Field(default=1e-4, ge=0, lt=1)
    #: Probability that a sample of a sensor on board is faulty. An assumption.
    level_sensor_prior: float = Field(default=1e-3, ge=0, lt=1)
    #: Probability that a balise is not where the list has it. An assumption; two wrong ones together are not bounded,
    #: so that it must be small.
    level_balise_prior: float = Field(default=1e-6, ge=0, le=3e-6)
    #: Probability that all Dopplers, or all phases, are wrong together. An assumption.
    level_motion_prior: float = Field(default=1e-5, ge=0, lt=1)
    #: Probability that the codes of all satellites ahead, or of all behind, are late together; as for the low ones of a
    #: side in single epochs. An assumption.
    level_side_prior: float = Field(default=SUPPORTED_SIDE_PRIOR, ge=0, lt=1)
    #: Probability that the map is wrong by more than its sigma, and by how much. An assumption.
    level_map_prior: float = Field(default=1e-3, ge=0, lt=1)
    level_map_m: float = Field(default=30.0, gt=0)
    #: Probability that the ionosphere is tilted over the sky by more than `slow_code_m`: a storm, or the equatorial
    #: anomaly (`tracking.line.TILT_M` has the size). An assumption.
    level_tilt_prior: float = Field(default=1e-3, ge=0, lt=1)
