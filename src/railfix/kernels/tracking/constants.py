"""Compiled-in constants of the along-track filter, each with its reason.

Settings that a user may change are in `railfix.tracking.limits`.
"""

from __future__ import annotations

import math
from typing import Final

# Prediction.
#: Correlation time of code multipath at rest: the fringe of a reflector 10 m away lasts about a minute.
CODE_CORRELATION_S: Final = 60.0
#: Correlation length of code multipath: a reflector in a street or station is passed within this distance.
CODE_CORRELATION_M: Final = 100.0
#: Correlation time of the displacement by orbit and ionospheric errors (`TrackingLimits.slow_code_m`).
SLOW_CODE_S: Final = 7200.0
DOPPLER_ERROR_MPS: Final = 0.01  #: Time-correlated error of the Doppler speed at rest.
#: Increase of the Doppler error with speed [m/s per m/s]. The error of a reflected signal is at most the speed.
DOPPLER_ERROR_SHARE: Final = 0.02
DOPPLER_CORRELATION_S: Final = 10.0  #: Correlation time of the Doppler error.
#: Random walk of the displacement by slow phase errors (ionosphere, troposphere, orbits, clocks), per square root of a
#: second. It corresponds to a drift of 0.5 mm/s along the line for half an hour.
PHASE_WALK_M: Final = 0.03
#: Random walk of the receiver clock's drift, per square root of a second. Quartz oscillators without an oven have a
#: random walk of 1.7e-9 of their frequency under vibration.
CLOCK_WALK_MPS: Final = 0.5
OFFSET_WALK_M: Final = 0.02  #: Random walk of the clock offset between two constellations, per square root of a second.
OFFSET_PRIOR_M: Final = 30.0  #: Prior standard deviation of the clock offset between two constellations.
#: Smallest sigma of the local map error, across and up. A larger stated sigma is used instead, in height only a
#: fraction of it.
MAP_ROUGHNESS_M: Final = 0.3
MAP_CORRELATION_M: Final = 50.0  #: Correlation length of the local map error.
MAP_SCALE_M: Final = 0.03  #: Random walk of the length error along the map [m per square root of m].
MAP_ABSOLUTE_M: Final = 500.0  #: Correlation length of the absolute map error, which has the stated sigma.
CODE_CLOCK_SIGMA_M: Final = 1e3  #: Prior standard deviation of the code clock about the median of an epoch [m].
#: Random walk of the wheel scale factor, per square root of a second. A road vehicle had 2 % in half a minute of bends.
WHEEL_WALK: Final = 5e-4
FORCE_WALK_MPS2: Final = 1e-3  #: Random walk of the accelerometer offset with temperature, per square root of a second.
RADAR_WALK: Final = 2e-4  #: Random walk of the radar scale factor, per square root of a second.
#: Fraction of the map's height sigma that is a local error; the lateral fraction is 1. Most of the height error of a
#: survey or a terrain model is correlated over longer distances.
HEIGHT_ROUGHNESS: Final = 0.5
LEAST_STEP_M2: Final = 1e-6  #: Minimum variance of the change of position [m2] and of speed [m2/s2] over an interval.

# Equations.
#: Lowest speed at which ranges to ground units are used [m/s]; their errors are constant at rest (P2 3.3).
STILL_MPS: Final = 0.3
#: Speed above which its sign is known [m/s]: four sigmas of the speed with a wheel sensor at 1 Hz.
DIRECTION_MPS: Final = 1.0
CHORD_M: Final = 0.5  #: Shortest displacement whose direction is used [m]; below it, the tangent is used.
#: Fraction of independent information below which a motion quantity of phases and Dopplers counts as unmeasured.
LEAST_PIVOT: Final = 1e-12

# Clocks.
STEPPED: Final = 5.0  #: Median innovation above which a clock has stepped, in standard deviations.
UNKNOWN_CLOCK: Final = 100.0  #: Standard deviation of the phase clock [m] or its drift [m/s] after a step.
FIRST_OFFSET_M2: Final = 1e-4  #: Variance of the offset of the first constellation from the code clock [m2].

# Reweighting.
PASSES: Final = 4  #: Number of fits of an epoch, with new weights between them.
LEVEL_PASSES: Final = 3  #: Number of sets of weights in sub-filters: the initial weights, and weights after two fits.
#: Mean weight of codes, or of phases and Dopplers, below which fits are repeated with weights for an inflated prior.
WEAK_FIT: Final = 0.7
FREEDOM_PLACE_M2: Final = 30.0**2  #: Increase of the position variance in the inflated prior [m2].
FREEDOM_SPEED_M2PS2: Final = 10.0**2  #: Increase of the speed variance in the inflated prior [m2/s2].
#: Correction of the position beyond which the equations are linearised again [m]. Within 20 m, a sharp curve deviates
#: from its tangent by 1 m. A linearised range is wrong by only 2 cm within 1 km.
MOVED_M: Final = 2.0
RELINEARISED: Final = 4  #: Largest number of repeated linearisations.

# Estimation of the noise.
SCALE_S: Final = 60.0  #: Time constant of the variance scales of Dopplers and phases [s].
LEAST_SCALE: Final = -1.5  #: Lower bound of the log scale of a Doppler or phase variance.
LARGEST_SCALE: Final = 3.0  #: Upper bound of the log scale.
#: Decrease of the timer of low motion weights at an epoch with higher weights, as a fraction of the interval. The timer
#: is not reset, because weights that alternate about the limit also show a contradiction.
MOTION_LEAK: Final = 0.5
CODE_LEAK: Final = 1.0  #: As `MOTION_LEAK`, for the timer of low code weights.

# Satellites with persistent code errors.
BIAS_MEMORY_S: Final = 60.0  #: Time constant of a satellite's mean normalised innovation [s].
BIAS_MOST: Final = 1.0  #: Bound of each innovation in the mean normalised innovation.
BIAS_FAULTY: Final = 0.35  #: Mean innovation above which a satellite's codes are excluded as too long.
#: Mean innovation below which a satellite's codes are excluded as too short. The limit is wider, because late codes of
#: other satellites shift the clock and make correct codes appear short.
BIAS_SHORT: Final = -0.55
#: Smallest mean innovation that may indicate a wrong map [m]. Smaller means come from orbits, clocks and ionosphere.
NOMINAL_M: Final = 0.8
#: Largest number of satellites whose means may exceed `BIAS_FAULTY` and `NOMINAL_M` in magnitude. With more, one of
#: them negative, the protection level is withheld: the map, a constellation or the clock may be wrong.
BIAS_SATELLITES: Final = 2
BIAS_INFLATED: Final = 1e6  #: Factor on the variance of excluded codes. Their innovations show the end of a fault.
#: Position sigma [m] that is added when a satellite is excluded whose codes have affected the position.
INFLATED_M: Final = 15.0
INFLATED_SIGMAS: Final = 3.0  #: Code shift [sigmas] above which `INFLATED_M` is not added: all codes may have stepped.

# Length errors of the map.
#: Time constant of the mean code shift that is compared with `TrackingLimits.map_misfit_sigmas`.
MAP_MISFIT_S: Final = 30.0
MAP_MISFIT_KEPT_S: Final = 300.0  #: Time constant with which an increased length error decays.
MISFIT_CODES: Final = 4  #: Smallest number of codes that separate position and clocks.
#: Bound of the code shift of a single epoch, in standard deviations. A shift beyond `STEP_SIGMAS` is not used at all:
#: it is a step of all codes, and no information on the map.
MISFIT_CLIPPED: Final = 3.0
MISFIT_LEARNT_S: Final = 5.0  #: Time constant with which the length error adapts [s].
#: Upper bound of the log variance of map lengths, 1.6 m per square root of a metre. Larger errors make no difference.
MISFIT_LARGEST: Final = 8.0

# Speeds.
SPEED_SIGMAS: Final = 4.0  #: Bound of the error of a measured speed, in standard deviations.

# Branches.
#: Distance of two branches at which half of their evidence is attributed to the map: three map errors of 2 m.
MAP_BRANCH_M: Final = 6.0
#: Standard deviation of the code error that is common to all satellites on one side of a street (reflections).
CODE_COMMON_M: Final = 10.0
CODE_COMMON_S: Final = 120.0  #: Correlation time of the common code error.
CODE_COMMON_TRAVEL_M: Final = 500.0  #: Correlation length of the common code error.
BRANCH_FLOOR: Final = 1e-3  #: Lower bound of the probability, due to codes, of a branch within `BRANCH_FLOOR_M`.
BRANCH_FLOOR_M: Final = 30.0  #: Distance within which `BRANCH_FLOOR` applies.
#: Distance travelled before improbable hypotheses are dropped; motion does not separate branches earlier.
DECIDED_TRAVEL_M: Final = 60.0
#: Probability below which hypotheses are dropped: a hundredth of the integrity risk of an independent error.
LEAST_PROBABILITY: Final = 1e-11
START_SIGMA_M: Final = 30.0  #: Initial standard deviation of a hypothesis's position.
GAP_S: Final = 5.0  #: Time without measurements after which the position search is repeated.
#: Mean weight below which phases and Dopplers contradict the track. An error of one sigma has the weight 1.
LOST_MOTION_WEIGHT: Final = 0.45
#: Time of contradicting phases and Dopplers after which the track is lost (decrease of the timer: `MOTION_LEAK`).
LOST_MOTION_S: Final = 6.0
LOST_CODE_WEIGHT: Final = 0.5  #: Mean weight below which codes contradict the track.
LOST_CODE_S: Final = 20.0  #: The same time for codes.
#: Where motion contradicts the track, positions this far and twice this far ahead and behind are tried.
BEND_M: Final = 20.0
EXPIRED_SIGMA_M: Final = 200.0  #: Largest standard deviation of a reported position.
#: Probability ratio above which another hypothesis is reported. A lower ratio would let similar hypotheses alternate.
SWITCH: Final = 3.0
#: Distance below which two laps cannot be distinguished permanently, in units of `map_branch_m`. Among such laps, the
#: filter reports the lap that recent codes prefer.
ALIKE: Final = 1.5
RECENT_S: Final = 30.0  #: Time constant with which the log odds from recent codes decay [s].
RECENT_MOST: Final = 3.0  #: Bound of the log odds from recent codes.
#: Largest log odds by motion between branches `map_branch_m` apart: 1 / (2 s^2) with s^2 = 2 (1/3)^2.
MOST_ODDS: Final = 2.25
#: Largest log odds from the motion of one second or one epoch. Reflections would cause larger values.
MOST_MOTION: Final = 5.0
#: The position search is repeated if the log probability of the leading hypothesis was recently below this value,
#: because all hypotheses that were more probable have then failed.
TAKEOVER: Final = -6.0
LEAST_RISE: Final = 0.3  #: Rise of the stored minimum of the log probability (`log_least`) per second.
#: Time after a start in which `TAKEOVER` is not applied, because all hypotheses are new.
TAKEOVER_AFTER_S: Final = 15.0
#: Smallest number of satellites whose phases, Dopplers or codes are evidence; fewer fit any speed and position.
MOTION_SATELLITES: Final = 4
MOTION_M: Final = 3.0  #: Travel per unit of log odds from motion [m]; at rest, motion is no evidence.
#: Time of contradicting phases and Dopplers [s] after which neighbouring positions are tried. Beyond an open end of the
#: line, the track is lost after this time. A shorter contradiction is attributed to reflections.
BESIDE_AFTER_S: Final = 0.9

# Monitors of the position.
#: Time of contradicting phases and Dopplers (`LOST_MOTION_WEIGHT`) after which the protection level is withheld.
#: Shorter contradictions are noise, which the standard deviation covers.
LEVEL_DOUBT_S: Final = 3.0
LEVEL_DOUBT_CODE_S: Final = 8.0  #: Time of contradicting codes after which the protection level is withheld.
#: Time after a start in which the protection level is withheld while no hypothesis has the probability `YOUNG`. Also
#: the time without a protection level after a loss of track by low weights.
LEVEL_START_S: Final = 15.0
LEVEL_HOLD_S: Final = 5.0  #: Time from the last contradiction to the next protection level.
#: Distance of the points ahead and behind at which the velocity is compared with the line, in sigmas of the position.
REACH_SIGMAS: Final = 2.0
REACH_M: Final = 3.0  #: Smallest distance of the points ahead and behind [m].
VELOCITY_FLOOR_MPS: Final = 0.15  #: Velocity error, added to the velocity's covariance [m/s].
DIRECTION_SHARE: Final = 0.03  #: Smallest assumed error of the line's direction [rad].
LARGEST_SQUARE: Final = 12.0  #: Bound of an epoch's squared contradiction in the cumulative sum (E. S. Page, 1954).
ALLOWED_SQUARE: Final = 4.0  #: Decrease of the cumulative sum per second.
CONTRADICTION_DOUBT: Final = 12.0  #: Cumulative sum above which the protection level is withheld.
CONTRADICTION_LOST: Final = 30.0  #: Cumulative sum at which the track is lost.
#: Sum after a takeover; a velocity across the line gives less.
CONTRADICTION_TAKEN: Final = 60.0
#: Mean code shift above which codes contradict motion, in standard deviations. Possible causes are a step or a slow
#: drift of all codes, or a wrong map.
DRIFT_SIGMAS: Final = 5.0
#: Log variance of map lengths that contradicts motion (6 times the error).
DRIFT_LOG: Final = 2.0 * math.log(6.0)
#: Mean weight of Dopplers and phases over `MOTION_FIT_S` below which they are inconsistent with any speed, as beyond a
#: bend that the estimated position has not reached. The limit applies if no wheel or radar measures the speed.
MOTION_FIT: Final = 0.6
MOTION_FIT_S: Final = 2.0
#: Significant lateral displacement of the map, estimated by the sub-filter with a wrong map, in standard deviations.
BESIDE_SIGMAS: Final = 4.5
BESIDE_M: Final = 8.0  #: Significant lateral displacement of the map [m]; both limits must be exceeded.
#: Smallest probability of the leading hypothesis for a protection level within `LEVEL_START_S` after a start.
YOUNG: Final = 0.99
#: Time without a protection level after a probability below `YOUNG`.
YOUNG_HOLD_S: Final = 1.0
STEP_SIGMAS: Final = 6.0  #: Code shift above which all codes may have stepped, in standard deviations.
STEP_S: Final = 3.0  #: Time of code shifts above `STEP_SIGMAS` that indicates a step [s].
STEP_HOLD_S: Final = 300.0  #: Time without a protection level after a step of all codes.

# Protection levels.
#: Largest assumed error of a distance travelled without codes, as a fraction: a wrong wheel diameter.
SCALE_BOUND: Final = 0.02
#: A sub-filter ends if its source is not measured, and if its position and standard deviation differ from those of the
#: filter by less than this fraction of the standard deviation.
JOINED: Final = 0.05
PRECISION_M: Final = 1e-7  #: Newton step below which the solution for the protection level ends [m].
ROUNDS: Final = 60  #: Largest number of Newton steps.
#: Fraction of the total risk below which an alternative (satellite pair, branch with a fault) has no separate term. Its
#: risk is then subtracted from the total risk.
PAIR_SHARE: Final = 1e-3
PAIR_LEFT: Final = 1e-3  #: Smallest fraction of the position information that must remain without a satellite pair.
AHEAD: Final = 0.3  #: Smallest along-track component of the line of sight of satellites ahead or behind.
