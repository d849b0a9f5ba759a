"""Fixed constants of the filter along the track, each with its reason; they are compiled in.

`railfix.tracking.limits` has the settings that a user may change.
"""

from __future__ import annotations

import math
from typing import Final

# Prediction.
#: Time over which code multipath changes at rest: the fringe of a reflector 10 m away lasts about a minute.
CODE_CORRELATION_S: Final = 60.0
#: Distance travelled over which code multipath changes; a reflector in a street or station is passed within it.
CODE_CORRELATION_M: Final = 100.0
#: Correlation time of the displacement due to orbit and ionosphere errors (`TrackingLimits.slow_code_m`).
SLOW_CODE_S: Final = 7200.0
DOPPLER_ERROR_MPS: Final = 0.01  #: Smallest time-correlated error of the Doppler speed.
#: Fraction of the speed that this error has; the Doppler error of a reflected signal is at most the speed.
DOPPLER_ERROR_SHARE: Final = 0.02
DOPPLER_CORRELATION_S: Final = 10.0  #: Correlation time of this error.
#: Random walk of the displacement due to slow errors of all phases (ionosphere, troposphere, orbits, clocks), per
#: square root of a second. It corresponds to 0.5 mm/s along the line for half an hour.
PHASE_WALK_M: Final = 0.03
#: Random walk of the receiver clock's drift, per square root of a second. Quartz oscillators without an oven have a
#: random walk of 1.7e-9 of their frequency under vibration.
CLOCK_WALK_MPS: Final = 0.5
OFFSET_WALK_M: Final = 0.02  #: Random walk of the clock offset between two constellations, per square root of a second.
OFFSET_PRIOR_M: Final = 30.0  #: Initial standard deviation of this offset.
#: Smallest local error of the map, across and up. A larger sigma stated by the map is used instead; for heights, half
#: of it.
MAP_ROUGHNESS_M: Final = 0.3
MAP_CORRELATION_M: Final = 50.0  #: Length over which the local map error changes.
MAP_SCALE_M: Final = 0.03  #: Random walk of a length along the map [m per square root of m].
MAP_ABSOLUTE_M: Final = 500.0  #: Length over which the absolute map error changes; it has the stated sigma.
CODE_CLOCK_SIGMA_M: Final = 1e3  #: Prior standard deviation of the code clock about the median of an epoch [m].
#: Random walk of the wheel scale factor, per square root of a second: a car's changed by 2 % in half a minute in bends.
WHEEL_WALK: Final = 5e-4
FORCE_WALK_MPS2: Final = 1e-3  #: Random walk of the accelerometer offset, which follows the temperature.
RADAR_WALK: Final = 2e-4  #: Random walk of the radar scale factor.
#: Fraction of the map's height error that changes over `MAP_CORRELATION_M`; laterally the fraction is 1. Height errors
#: of a survey or a terrain model extend over longer distances.
HEIGHT_ROUGHNESS: Final = 0.5
LEAST_STEP_M2: Final = 1e-6  #: Minimum variance of the change of position [m2] and of speed [m2/s2] over an interval.

# Equations.
#: Speed below which ranges to ground units are not used [m/s], because their errors are constant at rest (P2 3.3).
STILL_MPS: Final = 0.3
#: Speed below which the direction is unknown [m/s]: four sigmas of the speed with a wheel sensor at 1 Hz.
DIRECTION_MPS: Final = 1.0
CHORD_M: Final = 0.5  #: Displacement below which the tangent is taken as the direction of the displacement [m].
#: Phases or Dopplers that add less than this fraction of their information to other measurements are not used.
LEAST_PIVOT: Final = 1e-12

# Clocks.
STEPPED: Final = 5.0  #: A clock has stepped if its median innovation exceeds this many standard deviations.
UNKNOWN_CLOCK: Final = 100.0  #: Standard deviation of the phase clock and its drift after a step [m, m/s].
FIRST_OFFSET_M2: Final = 1e-4  #: Variance of the offset of the first constellation from the code clock [m2].

# Reweighting.
PASSES: Final = 4  #: Number of fits of an epoch; after each fit the weights are computed again.
LEVEL_PASSES: Final = 3  #: Number of sets of weights in sub-filters: the initial one, and one after each of two fits.
#: Mean weight of codes, or of phases and Dopplers, below which the reweighting is restarted from other weights.
WEAK_FIT: Final = 0.7
FREEDOM_PLACE_M2: Final = 30.0**2  #: Variance added to the position for a restart of the reweighting [m2].
FREEDOM_SPEED_M2PS2: Final = 10.0**2  #: Variance added to the speed for a restart of the reweighting [m2/s2].
#: Change of the position beyond which the equations are linearised again [m]. Over 1 km, a range of 26 000 km deviates
#: from its tangent by 2 cm; over 20 m, the line deviates from its tangent by 1 m in the sharpest curves.
MOVED_M: Final = 2.0
RELINEARISED: Final = 4  #: Largest number of further linearisations.

# Estimation of the noise.
SCALE_S: Final = 60.0  #: Time over which the scales of Dopplers and phases are adapted [s].
LEAST_SCALE: Final = -1.5  #: Lower bound of the logarithm of the factor on a Doppler or phase variance.
LARGEST_SCALE: Final = 3.0  #: Upper bound of this logarithm.
#: Fraction of an epoch's interval by which the timer of low motion weights falls at an epoch with higher weights. The
#: timer is not reset, because weights that alternate about the limit also show a contradiction.
MOTION_LEAK: Final = 0.5
CODE_LEAK: Final = 1.0  #: The same fraction for the timer of low code weights.

# Satellites with persistent code errors.
BIAS_MEMORY_S: Final = 60.0  #: Time constant of a satellite's mean normalised innovation [s].
BIAS_MOST: Final = 1.0  #: Bound of a single normalised innovation in this mean.
BIAS_FAULTY: Final = 0.35  #: Mean above which codes are left out as too long.
#: Mean below which codes are left out as too short. Long codes of other satellites shift the clock, so that correct
#: codes appear too short.
BIAS_SHORT: Final = -0.55
#: Smallest mean innovation that may indicate a wrong map [m]; orbit, clock and ionosphere errors last for hours.
NOMINAL_M: Final = 0.8
#: If the means of more satellites than this exceed `BIAS_FAULTY` in magnitude and one mean is negative, no protection
#: level is given: the map or a constellation is wrong, or reflections shift the clock.
BIAS_SATELLITES: Final = 2
BIAS_INFLATED: Final = 1e6  #: Factor on the variance of codes left out; their innovations show the end of the fault.
INFLATED_M: Final = 15.0  #: Sigma added to the position [m] when a satellite is left out that has affected it so far.
INFLATED_SIGMAS: Final = 3.0  #: Shift implied by codes above which this is not added: all codes may have stepped.

# Length errors of the map.
#: Time over which codes must contradict lengths of the map (`TrackingLimits.map_misfit_sigmas`).
MAP_MISFIT_S: Final = 30.0
MAP_MISFIT_KEPT_S: Final = 300.0  #: Time constant with which an increased length error decays.
MISFIT_CODES: Final = 4  #: Smallest number of codes of an epoch that separate a shift of the position from the clocks.
#: Number of standard deviations to which the shift of a single epoch is clipped. A shift beyond `STEP_SIGMAS` is a step
#: of all codes, and contains no information on the map.
MISFIT_CLIPPED: Final = 3.0
MISFIT_LEARNT_S: Final = 5.0  #: Time constant of the adaptation [s].
#: Upper bound of the log variance; a length error above 1.6 m per square root of a metre makes no further difference.
MISFIT_LARGEST: Final = 8.0

# Speeds.
SPEED_SIGMAS: Final = 4.0  #: Number of standard deviations within which a measured speed bounds the true speed.

# Branches.
#: Smallest distance of two branches at which half of their difference is attributed to the map: three errors of 2 m.
MAP_BRANCH_M: Final = 6.0
#: Standard deviation of the common code error across the line, which is due to reflections from one side of a street.
CODE_COMMON_M: Final = 10.0
CODE_COMMON_S: Final = 120.0  #: Correlation time of the common code error.
CODE_COMMON_TRAVEL_M: Final = 500.0  #: Distance travelled over which the common code error is correlated.
BRANCH_FLOOR: Final = 1e-3  #: Lower bound of the probability of a near branch that only codes contradict.
BRANCH_FLOOR_M: Final = 30.0  #: Distance within which a branch is near in this sense.
#: Distance travelled before hypotheses are dropped; motion does not separate branches earlier.
DECIDED_TRAVEL_M: Final = 60.0
#: Probability below which hypotheses are dropped: a hundredth of the risk of an independent error.
LEAST_PROBABILITY: Final = 1e-11
START_SIGMA_M: Final = 30.0  #: Initial position standard deviation of a hypothesis.
GAP_S: Final = 5.0  #: Time without measurements after which the position is searched for again.
#: Mean weight of phases and Dopplers below which they contradict the track; an error of one sigma has the weight 1.
LOST_MOTION_WEIGHT: Final = 0.45
#: Time of this contradiction after which the track is lost; the timer runs backward during epochs above the limit.
LOST_MOTION_S: Final = 6.0
LOST_CODE_WEIGHT: Final = 0.5  #: The same limit for the mean weight of codes.
LOST_CODE_S: Final = 20.0  #: The same time for codes.
#: Where motion contradicts the track, positions at this distance (and twice as far) ahead and behind are tried.
BEND_M: Final = 20.0
EXPIRED_SIGMA_M: Final = 200.0  #: Largest standard deviation of a predicted position.
#: Probability ratio from which another hypothesis is reported; with a lower ratio, similar hypotheses would alternate.
SWITCH: Final = 3.0
#: Distance of two laps, in `MAP_BRANCH_M`, within which they cannot be distinguished permanently. Among such laps, the
#: filter reports the lap that recent codes prefer.
ALIKE: Final = 1.5
RECENT_S: Final = 30.0  #: Time constant with which the log odds from recent codes decay [s].
RECENT_MOST: Final = 3.0  #: Bound of the log odds from recent codes.
#: Largest log odds from a distance of one `MAP_BRANCH_M`: 1 / (2 s^2) with s^2 = 2 (1/3)^2.
MOST_ODDS: Final = 2.25
#: Largest log odds from the motion of one second, or of one epoch; larger values are caused by reflections.
MOST_MOTION: Final = 5.0
#: Log probability below which the leading hypothesis must recently have been for all others to have failed. Then the
#: position is searched for again.
TAKEOVER: Final = -6.0
LEAST_RISE: Final = 0.3  #: Rise of the stored minimum of the log probability, per second.
TAKEOVER_AFTER_S: Final = 15.0  #: Time without this search after a start, when all hypotheses are new.
#: Least number of satellites with phase or Doppler, or with codes, for evidence; fewer fit any speed and position.
MOTION_SATELLITES: Final = 4
MOTION_M: Final = 3.0  #: Travel that allows one unit of log odds from motion [m]; at rest the tangents do not differ.
#: Time of contradicted motion [s] after which neighbouring positions are tried. Beyond an open end of the line, the
#: track is lost after this time. A shorter contradiction is a reflection.
BESIDE_AFTER_S: Final = 0.9

# Monitors of the position.
#: Time for which phases and Dopplers must contradict the filter, with the limit of a lost track, for the protection
#: level to be withheld. Contradictions of single epochs are noise, which the standard deviation covers.
LEVEL_DOUBT_S: Final = 3.0
LEVEL_DOUBT_CODE_S: Final = 8.0  #: The same time for codes.
#: Longest time after a start without a protection level because no position has the probability `YOUNG`; time without
#: one after a loss of track.
LEVEL_START_S: Final = 15.0
LEVEL_HOLD_S: Final = 5.0  #: Time from the last contradiction until the protection level is available again.
#: The velocity is compared with the line at the position and at two points, this many sigmas ahead and behind.
REACH_SIGMAS: Final = 2.0
REACH_M: Final = 3.0  #: Smallest distance of these points [m].
VELOCITY_FLOOR_MPS: Final = 0.15  #: Velocity error in addition to the velocity's covariance [m/s].
DIRECTION_SHARE: Final = 0.03  #: Least error of the line's direction, as a fraction of the speed.
LARGEST_SQUARE: Final = 12.0  #: Bound of a term in the cumulative sum of squared contradictions (E. S. Page, 1954).
ALLOWED_SQUARE: Final = 4.0  #: Decrement of this sum per second.
CONTRADICTION_DOUBT: Final = 12.0  #: Sum at which the protection level is withheld.
CONTRADICTION_LOST: Final = 30.0  #: Sum at which the track is lost.
CONTRADICTION_TAKEN: Final = 60.0  #: Sum that is set after a takeover: larger than a velocity across the line can give.
#: Normalised mean of the position shifts implied by codes, beyond which codes contradict motion. The reason is a step
#: or slow drift of all codes, or a wrong map.
DRIFT_SIGMAS: Final = 5.0
DRIFT_LOG: Final = 2.0 * math.log(6.0)  #: The same limit for the log variance of the map's lengths (6 times the error).
#: Least mean weight of Dopplers and phases over `MOTION_FIT_S` while no sensor on board measures the speed. With a
#: smaller mean weight they agree on no speed, as beyond a bend that the estimated position has not reached.
MOTION_FIT: Final = 0.6
MOTION_FIT_S: Final = 2.0
#: Lateral map displacement that is significant, in standard deviations; the sub-filter for a wrong map estimates it.
BESIDE_SIGMAS: Final = 4.5
BESIDE_M: Final = 8.0  #: Lateral map displacement that is significant, in metres; both limits must be exceeded.
#: Probability that one of several new hypotheses must have for a bound; the true position may not be among them yet.
YOUNG: Final = 0.99
YOUNG_HOLD_S: Final = 1.0  #: Time without a protection level after an epoch at which no hypothesis has it.
STEP_SIGMAS: Final = 6.0  #: Shift implied by codes, in standard deviations, above which all codes may have stepped.
STEP_S: Final = 3.0  #: Time for which the shift must be so large [s].
STEP_HOLD_S: Final = 300.0  #: Time without a protection level after a step of all codes, which determine the position.

# Protection levels.
#: Largest error of a distance travelled without codes, as a fraction of the distance: a wrong wheel diameter.
SCALE_BOUND: Final = 0.02
#: A sub-filter equals the filter if position and standard deviation differ by less than this fraction of the standard
#: deviation. The sub-filter of a source that is not measured then ends.
JOINED: Final = 0.05
PRECISION_M: Final = 1e-7  #: Step at which the Newton iteration of the level ends [m].
ROUNDS: Final = 60  #: Largest number of Newton steps.
#: Fraction of the total risk below which the risk of a satellite pair is subtracted, instead of adding a term for it.
PAIR_SHARE: Final = 1e-3
PAIR_LEFT: Final = 1e-3  #: Fraction of the position information that must remain without a pair for a bound.
AHEAD: Final = 0.3  #: Smallest component of the line of sight along the track for a satellite ahead or behind.
