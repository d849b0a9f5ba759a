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

    def degrees(self, residual: Floats, codes: int) -> Floats:
        """Return the degrees of freedom of each row, by the sign of its residual; shapes as for `weight`."""
        degrees = np.full(residual.shape, self.usual)
        degrees[:, :codes][residual[:, :codes] > 0.0] = self.late
        return degrees

    def weight(self, residual: Floats, square: Floats, codes: int) -> Floats:
        """Return the weights of rows, shape (H, M).

        Parameters
        ----------
        residual : ndarray, shape (H, M)
            Only its sign is used; positive: longer than expected.
        square : ndarray, shape (H, M)
            Its mean square over the variance.
        codes : int
            How many rows are of codes; they come first.
        """
        degrees = self.degrees(residual, codes)
        return np.asarray((self.usual + 1.0) / self.usual * degrees / (degrees + square))

    def log_density(self, residual: Floats, square: Floats, codes: int) -> Floats:
        """Return the logarithm of the density whose weights are `weight`, 0 at its maximum; parameters the same."""
        degrees = self.degrees(residual, codes)
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
    passes: int = Field(default=4, ge=1)  #: Rounds of reweighting an epoch.
    #: Time and travel over which the multipath of a satellite's code changes: a reflector of a street or a station is
    #: passed within about 100 m; at rest the fringe of one 10 m away lasts about a minute.
    code_correlation_s: float = Field(default=60.0, gt=0)
    code_correlation_m: float = Field(default=100.0, gt=0)
    #: White part of a code's error, over its standard deviation; per second, not per epoch.
    code_white_share: float = Field(default=1.0, gt=0)
    #: Codes count once in this time where phases or Dopplers carry on: their errors last for a minute, so the epochs
    #: between tell nothing new. 0 takes those of every epoch.
    code_period_s: float = Field(default=1.0, ge=0)
    #: Displacement by orbits and ionosphere, and how long it lasts: about 1 m a satellite with a dilution of one;
    #: averaging over epochs does not take it away.
    slow_code_m: float = Field(default=1.0, ge=1e-6)
    slow_code_s: float = Field(default=7200.0, gt=0)
    #: ``sigma^2 = floor^2 + (zenith 10^((45 - C/N0) / 20))^2`` of a Doppler.
    doppler_floor_mps: float = Field(default=0.03, gt=0)
    doppler_zenith_mps: float = Field(default=0.05, gt=0)
    #: Time-correlated error of the speed by Dopplers: its least size, its share of the speed (a reflected signal is
    #: shifted by up to the speed, at rest not at all) and its correlation time.
    doppler_error_mps: float = Field(default=0.01, gt=0)
    doppler_error_share: float = Field(default=0.02, ge=0)
    doppler_correlation_s: float = Field(default=10.0, gt=0)
    #: The same of the change of a carrier phase over an epoch.
    phase_floor_m: float = Field(default=0.01, gt=0)
    phase_zenith_m: float = Field(default=0.01, gt=0)
    #: Displacement in the square root of a second by slow errors of all phases: ionosphere, troposphere, orbits and
    #: clocks, 0.5 mm/s along the line for half an hour.
    phase_walk_m: float = Field(default=0.03, ge=0)
    #: Change of the drift of the receiver's clock in the square root of a second: 1.7e-9 of the frequency, what quartz
    #: oscillators without an oven show when shaken.
    clock_walk_mps: float = Field(default=0.5, gt=0)
    #: Change of the offset between two constellations in the square root of a second.
    offset_walk_m: float = Field(default=0.02, gt=0)
    offset_prior_m: float = Field(default=30.0, gt=0)  #: Standard deviation of such an offset at first.
    #: Least local error of the map across and up, and the length over which it changes. The map's stated accuracy
    #: counts where it is more, of heights the half.
    map_roughness_m: float = Field(default=0.3, gt=0)
    map_correlation_m: float = Field(default=50.0, gt=0)
    map_scale_m: float = Field(default=0.03, gt=0)  #: Error of a length along the map [m per square root of m].
    #: A larger one is shown by a mean innovation over `map_misfit_s` of so many sigmas; what was learnt is forgotten
    #: within `map_misfit_kept_s`.
    map_misfit_sigmas: float = Field(default=3.0, gt=0)
    map_misfit_s: float = Field(default=30.0, gt=0)
    map_misfit_kept_s: float = Field(default=300.0, gt=0)
    #: Length over which the absolute error of the map changes (sigmas are those of the trajectory).
    map_absolute_m: float = Field(default=500.0, gt=0)
    #: Least distance of two branches at which half of their difference is the map's: three times an error of 2 m.
    map_branch_m: float = Field(default=6.0, gt=0)
    #: Standard deviation of an error that the codes have in common across the line: reflections off one side of a
    #: street.
    code_common_m: float = Field(default=10.0, gt=0)
    #: Time and distance over which that error lasts.
    code_common_s: float = Field(default=120.0, gt=0)
    code_common_travel_m: float = Field(default=500.0, gt=0)
    #: Codes alone leave a branch this near at least this probability.
    branch_floor: float = Field(default=1e-3, gt=0, lt=0.5)
    branch_floor_m: float = Field(default=30.0, gt=0)
    #: Hypotheses are dropped only after this much travel: before, motion does not separate branches.
    decided_travel_m: float = Field(default=60.0, ge=0)
    #: Hypotheses below it are dropped: a hundredth of the risk of an independent error.
    least_probability: float = Field(default=1e-11, gt=0, lt=0.5)
    most_hypotheses: int = Field(default=24, ge=1)  #: Places at most, the most probable ones.
    start_sigma_m: float = Field(default=30.0, gt=0)  #: Standard deviation of a hypothesis when it begins.
    start_separation_m: float = Field(default=60.0, gt=0)  #: Two places of the first epoch this close are one.
    gap_s: float = Field(default=5.0, gt=0)  #: Time without measurements after which places are sought again.
    #: The track is lost when the mean weight of motion, or of codes, was below these for so long; 1 is the weight of an
    #: error of one standard deviation. Epochs above them count down.
    lost_motion_weight: float = Field(default=0.45, ge=0)
    lost_motion_s: float = Field(default=6.0, gt=0)
    lost_code_weight: float = Field(default=0.5, ge=0)
    lost_code_s: float = Field(default=20.0, gt=0)
    #: Where motion contradicts the track, places so far (and twice) before and behind are tried.
    bend_m: float = Field(default=20.0, gt=0)
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
    #: Probability that a sensor on board is faulty at such a sample. An assumption.
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
    level_passes: int = Field(default=3, ge=1)  #: Rounds of reweighting of the sub-filters.
    #: A filter contradicted by its motion, or codes, for longer bounds nothing; mean weights are those of a lost track.
    #: A contradiction of single epochs is noise, which is in the standard deviation.
    level_doubt_s: float = Field(default=3.0, ge=0)
    level_doubt_code_s: float = Field(default=8.0, ge=0)
    #: After a start no level before a place has a probability of 0.99, at most so long; none for so long after the
    #: track was lost.
    level_start_s: float = Field(default=15.0, ge=0)
    level_hold_s: float = Field(default=5.0, ge=0)  #: A level comes back so long after the last contradiction.
    #: Beyond an open end with motion in doubt for so long, the track is lost.
    end_doubt_s: float = Field(default=0.9, ge=0)
    expired_sigma_m: float = Field(default=200.0, gt=0)  #: Largest standard deviation of a predicted position.

    @property
    def tails(self) -> Tails:
        """Degrees of freedom on both sides."""
        return Tails(self.degrees_of_freedom, self.late_degrees_of_freedom)
