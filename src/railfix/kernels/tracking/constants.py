"""Fixed constants of the filter along the track, each with its reason; they are compiled in.

`railfix.tracking.limits` has the settings that a user may change.
"""

from __future__ import annotations

import math
from typing import Final

# Prediction.
#: Time and travel over which the multipath of a satellite's code changes. A reflector in a street or a station is
#: passed within about 100 m; at rest the fringe of a reflector 10 m away lasts about a minute.
CODE_CORRELATION_S: Final = 60.0
CODE_CORRELATION_M: Final = 100.0
#: Correlation time of the displacement by orbits and ionosphere, `TrackingLimits.slow_code_m`.
SLOW_CODE_S: Final = 7200.0
#: Time-correlated error of the Doppler speed: its minimum, its fraction of the speed (the Doppler error of a reflected
#: signal is at most the speed, and zero at rest), and its correlation time.
DOPPLER_ERROR_MPS: Final = 0.01
DOPPLER_ERROR_SHARE: Final = 0.02
DOPPLER_CORRELATION_S: Final = 10.0
#: Random walk of the displacement by slow errors of all phases, per square root of a second: ionosphere, troposphere,
#: orbits and clocks, 0.5 mm/s along the line for half an hour.
PHASE_WALK_M: Final = 0.03
#: Random walk of the receiver clock's drift per square root of a second: 1.7e-9 of the frequency, as quartz oscillators
#: without an oven show under vibration.
CLOCK_WALK_MPS: Final = 0.5
#: Random walk of the offset between two constellations per square root of a second, and its initial standard deviation.
OFFSET_WALK_M: Final = 0.02
OFFSET_PRIOR_M: Final = 30.0
#: Smallest local error of the map across and up, and the length over which it changes. The map's stated accuracy is
#: used where it is larger; for heights, half of it.
MAP_ROUGHNESS_M: Final = 0.3
MAP_CORRELATION_M: Final = 50.0
MAP_SCALE_M: Final = 0.03  #: Random walk of a length along the map [m per square root of m].
MAP_ABSOLUTE_M: Final = 500.0  #: Length over which the absolute map error, of the stated sigma, changes.
CODE_CLOCK_SIGMA_M: Final = 1e3  #: Prior standard deviation of the code clock about the median of an epoch [m].
#: Random walks of the sensors' scale factors and offset, per square root of a second. A car's wheel scale factor
#: changed by 2 % within half a minute in bends; an accelerometer's offset follows its temperature.
WHEEL_WALK: Final = 5e-4
FORCE_WALK_MPS2: Final = 1e-3
RADAR_WALK: Final = 2e-4
#: Fraction of the map's height error that changes over `MAP_CORRELATION_M`; laterally the fraction is 1. Height errors
#: of a survey or a terrain model extend over longer distances.
HEIGHT_ROUGHNESS: Final = 0.5
LEAST_STEP_M2: Final = 1e-6  #: Minimum variance of a step of position and of speed [m2, m2/s2].

# Equations.
#: Ranges to ground units are not used below this speed [m/s], because their error does not change at rest (P2 3.3).
STILL_MPS: Final = 0.3
#: Below this speed the direction is unknown [m/s]: four sigmas of the speed with a wheel sensor at 1 Hz.
DIRECTION_MPS: Final = 1.0
CHORD_M: Final = 0.5  #: For displacements shorter than this the tangent is used as their direction [m].
#: Fraction of their own information below which phases or Dopplers add nothing to the other measurements.
LEAST_PIVOT: Final = 1e-12

# Clocks.
STEPPED: Final = 5.0  #: A clock has stepped if its median innovation exceeds this many standard deviations.
UNKNOWN_CLOCK: Final = 100.0  #: Standard deviation of the phase clock and its drift after a step [m, m/s].
FIRST_OFFSET_M2: Final = 1e-4  #: Variance of the offset of the first constellation from the code clock [m2].

# Reweighting.
PASSES: Final = 4  #: Fits of an epoch, with new weights between them.
LEVEL_PASSES: Final = 3  #: Sets of weights in sub-filters: the first weights, and new weights after each of two fits.
#: Mean weight of codes, or of phases and Dopplers, below which the reweighting is restarted from other weights.
WEAK_FIT: Final = 0.7
#: Variances of position and speed added for a restart of the reweighting [m2, m2/s2].
FREEDOM_PLACE_M2: Final = 30.0**2
FREEDOM_SPEED_M2PS2: Final = 10.0**2
#: The equations are linearised again when the position has moved by more than this [m]. A range of 26 000 km deviates
#: from its tangent by 2 cm over 1 km, the line by 1 m over 20 m in its sharpest curves.
MOVED_M: Final = 2.0
RELINEARISED: Final = 4

# Estimation of the noise.
SCALE_S: Final = 60.0  #: Time over which the scales of Dopplers and phases are adapted [s].
#: Bounds of the log scales of the variances of Dopplers and phases.
LEAST_SCALE: Final = -1.5
LARGEST_SCALE: Final = 3.0
#: Fractions of an interval by which the doubt timers of motion and of codes fall at an epoch without doubt. They are
#: not reset, because weights that alternate about the limit are a contradiction as well.
MOTION_LEAK: Final = 0.5
CODE_LEAK: Final = 1.0

# Satellites with persistent code errors.
#: Time constant of the mean innovation [s], bound of a single innovation, and the means beyond which codes are left
#: out as too long, and as too short. Late codes of other satellites shift the clock: correct codes appear too short.
BIAS_MEMORY_S: Final = 60.0
BIAS_MOST: Final = 1.0
BIAS_FAULTY: Final = 0.35
BIAS_SHORT: Final = -0.55
#: Errors of orbit, clock and ionosphere last for hours: a smaller mean innovation does not indicate a wrong map [m].
NOMINAL_M: Final = 0.8
#: No protection level is given if more satellites than this are beyond `BIAS_FAULTY` and one of them is too short: the
#: map or a constellation is wrong, or reflections shift the clock.
BIAS_SATELLITES: Final = 2
BIAS_INFLATED: Final = 1e6  #: Factor on the variance of codes left out; their innovations show the end of the fault.
#: Standard deviation added to the position when a satellite is left out: its codes have affected it so far [m].
INFLATED_M: Final = 15.0
INFLATED_SIGMAS: Final = 3.0  #: Not added if the codes imply a shift of more sigmas: all may have stepped together.

# Length errors of the map.
#: Time over which codes must contradict the length (`TrackingLimits.map_misfit_sigmas`), and time constant with which
#: the increased length error decays.
MAP_MISFIT_S: Final = 30.0
MAP_MISFIT_KEPT_S: Final = 300.0
MISFIT_CODES: Final = 4  #: With fewer codes in an epoch, a shift cannot be separated from the clocks.
#: The shift of a single epoch is clipped to this many standard deviations. Beyond `STEP_SIGMAS` it is a step of all
#: codes and contains no information on the map.
MISFIT_CLIPPED: Final = 3.0
#: Time constant of the adaptation [s], and upper bound of the logarithm: a length error above 1.6 m per square root of
#: a metre makes no further difference.
MISFIT_LEARNT_S: Final = 5.0
MISFIT_LARGEST: Final = 8.0

# Speeds.
SPEED_SIGMAS: Final = 4.0  #: A measured speed bounds the true speed within this many standard deviations.

# Branches.
#: Smallest distance of two branches at which half of their difference is attributed to the map: three errors of 2 m.
MAP_BRANCH_M: Final = 6.0
#: Standard deviation of the common code error across the line: reflections from one side of a street.
CODE_COMMON_M: Final = 10.0
#: Correlation time and distance of the common code error.
CODE_COMMON_S: Final = 120.0
CODE_COMMON_TRAVEL_M: Final = 500.0
#: Lower bound of the probability of a branch within this distance, if codes alone contradict it.
BRANCH_FLOOR: Final = 1e-3
BRANCH_FLOOR_M: Final = 30.0
#: Hypotheses are dropped only after this travel, because motion does not separate branches earlier.
DECIDED_TRAVEL_M: Final = 60.0
#: Hypotheses with a lower probability are dropped: a hundredth of the risk of an independent error.
LEAST_PROBABILITY: Final = 1e-11
START_SIGMA_M: Final = 30.0  #: Initial position standard deviation of a hypothesis.
GAP_S: Final = 5.0  #: Time without measurements after which the position is searched for again.
#: The track is lost when the mean weight of motion, or of codes, has been below these limits for this long; an error of
#: one standard deviation has the weight 1. The timer runs backward during epochs above the limits.
LOST_MOTION_WEIGHT: Final = 0.45
LOST_MOTION_S: Final = 6.0
LOST_CODE_WEIGHT: Final = 0.5
LOST_CODE_S: Final = 20.0
#: Where motion contradicts the track, positions at this distance (and twice as far) ahead and behind are tried.
BEND_M: Final = 20.0
EXPIRED_SIGMA_M: Final = 200.0  #: Largest standard deviation of a predicted position.
#: Probability ratio for another hypothesis to be reported; nearly equal hypotheses would alternate without it.
SWITCH: Final = 3.0
#: Laps within this many `MAP_BRANCH_M` of each other cannot be distinguished permanently. Among these the filter
#: reports the lap that recent codes prefer: the mean over this time [s] of log odds that are clipped to this value.
ALIKE: Final = 1.5
RECENT_S: Final = 30.0
RECENT_MOST: Final = 3.0
#: Largest log odds from a distance of one `MAP_BRANCH_M`: 1 / (2 s^2) with s^2 = 2 (1/3)^2.
MOST_ODDS: Final = 2.25
#: Largest log odds from the motion of a second, or of an epoch; larger values are caused by reflections.
MOST_MOTION: Final = 5.0
#: If the log probability of the leading hypothesis was recently below this value, all other hypotheses have failed: the
#: position is searched for again, but not in the first seconds, when all hypotheses are new. The minimum log
#: probability recovers by `LEAST_RISE` per second.
TAKEOVER: Final = -6.0
LEAST_RISE: Final = 0.3
TAKEOVER_AFTER_S: Final = 15.0
#: Least numbers of satellites with phase or Doppler, and of codes, for evidence: fewer fit any speed and position.
MOTION_SATELLITES: Final = 4
MOTION_M: Final = 3.0  #: Travel that allows one unit of log odds from motion [m]; at rest the tangents do not differ.
#: Time of contradicted motion [s] after which neighbouring positions are tried, and after which the track is lost
#: beyond an open end. A shorter contradiction is a reflection.
BESIDE_AFTER_S: Final = 0.9

# Monitors of the position.
#: A filter contradicted by motion or codes for longer than this gives no bound; the limits of the mean weights are
#: those of a lost track. Contradictions of single epochs are noise, which the standard deviation covers.
LEVEL_DOUBT_S: Final = 3.0
LEVEL_DOUBT_CODE_S: Final = 8.0
#: After a start there is no protection level until a position has a probability of 0.99, or this time has passed; after
#: a loss of track there is none for this time.
LEVEL_START_S: Final = 15.0
LEVEL_HOLD_S: Final = 5.0  #: Time from the last contradiction until the protection level is available again.
#: The velocity is compared with the line at the position, and this many sigmas, or metres, ahead and behind.
REACH_SIGMAS: Final = 2.0
REACH_M: Final = 3.0
#: Velocity error in addition to its covariance [m/s]; least error of the line's direction as a fraction of the speed.
VELOCITY_FLOOR_MPS: Final = 0.15
DIRECTION_SHARE: Final = 0.03
#: Cumulative sum of squared contradictions (E. S. Page, 1954): bound of one square, and decrement per second.
LARGEST_SQUARE: Final = 12.0
ALLOWED_SQUARE: Final = 4.0
#: Sums at which the protection level is withheld, and at which the track is lost.
CONTRADICTION_DOUBT: Final = 12.0
CONTRADICTION_LOST: Final = 30.0
CONTRADICTION_TAKEN: Final = 60.0  #: Sum that is set after a takeover: larger than a velocity across the line can give.
#: Limits beyond which codes contradict motion, because of a step or slow drift of all codes or a wrong map: normalised
#: mean of the position shifts that codes imply, and log variance of the map's lengths (6 times the assumed error).
DRIFT_SIGMAS: Final = 5.0
DRIFT_LOG: Final = 2.0 * math.log(6.0)
#: Least mean weight of Dopplers and phases over `MOTION_FIT_S` while no sensor on board measures the speed. With a
#: smaller mean weight they agree on no speed, as beyond a bend that the estimated position has not reached.
MOTION_FIT: Final = 0.6
MOTION_FIT_S: Final = 2.0
#: A lateral map displacement, estimated by the sub-filter for a wrong map, is significant beyond this many of its
#: standard deviations and metres.
BESIDE_SIGMAS: Final = 4.5
BESIDE_M: Final = 8.0
#: New hypotheses give no bound until one has this probability: the true position may not be among them yet.
YOUNG: Final = 0.99
YOUNG_HOLD_S: Final = 1.0
#: All codes have stepped together if they imply a shift of more than this many standard deviations for this long [s].
STEP_SIGMAS: Final = 6.0
STEP_S: Final = 3.0
STEP_HOLD_S: Final = 300.0  #: No protection level for this long after a step of all codes: they determine the position.

# Protection levels.
SCALE_BOUND: Final = 0.02  #: Largest error of a distance without codes, as a fraction: a wrong wheel diameter.
#: A source that is not measured requires no sub-filter once its effect on the filter has decayed: position and standard
#: deviation differ by less than this fraction of the standard deviation.
JOINED: Final = 0.05
#: The Newton iteration of the level ends at a step below this [m], or after this many steps.
PRECISION_M: Final = 1e-7
ROUNDS: Final = 60
#: The risk of a satellite pair below this fraction of the total is subtracted instead of adding a term for it.
PAIR_SHARE: Final = 1e-3
PAIR_LEFT: Final = 1e-3  #: Least part of the position information without a pair that bounds the position.
AHEAD: Final = 0.3  #: Smallest component of the line of sight along the track for a satellite ahead or behind.
