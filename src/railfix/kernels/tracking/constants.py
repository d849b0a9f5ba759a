"""Compiled-in constants of the along-track filter, each with its reason.

Settings that a user may change are in `railfix.tracking.limits`.
"""

from __future__ import annotations

import math
from typing import Final

# Prediction.
#: Correlation time of code multipath for a train at rest: a reflector 10 m away causes fringes of about a minute.
CODE_CORRELATION_S: Final = 60.0
#: Correlation length of code multipath: the train passes a reflector in a street or station within this length.
CODE_CORRELATION_M: Final = 100.0
#: Correlation time of the position displacement caused by orbit and ionospheric errors (`TrackingLimits.slow_code_m`).
SLOW_CODE_S: Final = 7200.0
DOPPLER_ERROR_MPS: Final = 0.01  #: Sigma of the time-correlated Doppler speed error of a train at rest [m/s].
#: Increase of the Doppler speed error's sigma with speed [m/s per m/s]: errors by reflections grow with speed.
DOPPLER_ERROR_SHARE: Final = 0.02
DOPPLER_CORRELATION_S: Final = 10.0  #: Correlation time of the Doppler speed error [s].
#: Random walk of the position along the line by slow phase errors (ionosphere, troposphere, orbits, clocks) [m per
#: square root of s]. It covers a drift of 0.5 mm/s for half an hour.
PHASE_WALK_M: Final = 0.03
#: Random walk of the receiver clock's drift, per square root of a second. Under vibration, the relative frequency of
#: quartz oscillators without an oven has a random walk of 1.7e-9.
CLOCK_WALK_MPS: Final = 0.5
OFFSET_WALK_M: Final = 0.02  #: Random walk of the clock offset between two constellations, per square root of a second.
OFFSET_PRIOR_M: Final = 30.0  #: Prior standard deviation of the clock offset between two constellations.
#: Smallest sigma of the local map error, across and up. A stated sigma that is larger replaces it; for height, the
#: stated sigma is first multiplied by `HEIGHT_ROUGHNESS`.
MAP_ROUGHNESS_M: Final = 0.3
MAP_CORRELATION_M: Final = 50.0  #: Correlation length of the local map error.
MAP_SCALE_M: Final = 0.03  #: Random walk of the map's length error with distance travelled [m per square root of m].
MAP_ABSOLUTE_M: Final = 500.0  #: Correlation length of the absolute map error, which has the map's stated sigma.
CODE_CLOCK_SIGMA_M: Final = 1e3  #: Prior sigma of the code clock at each epoch [m].
#: Random walk of the wheel scale factor per square root of s. A road vehicle's factor changed by 2 % in 30 s of bends.
WHEEL_WALK: Final = 5e-4
FORCE_WALK_MPS2: Final = 1e-3  #: Random walk of the accelerometer offset with temperature, per square root of a second.
RADAR_WALK: Final = 2e-4  #: Random walk of the radar scale factor, per square root of a second.
#: Ratio of the sigma of the local height error to the map's height sigma; across the line, the ratio is 1. Most of the
#: height error of a survey or a terrain model is correlated over longer distances.
HEIGHT_ROUGHNESS: Final = 0.5
LEAST_STEP_M2: Final = 1e-6  #: Variance added to the process noise of position [m2] and of speed [m2/s2] per interval.

# Equations.
#: Lowest speed at which ranges to ground units are used [m/s]: at rest, averaging does not reduce their error (P2 3.3).
STILL_MPS: Final = 0.3
#: Absolute speed above which the direction of travel is known [m/s]: four sigmas of the speed with a wheel at 1 Hz.
DIRECTION_MPS: Final = 1.0
CHORD_M: Final = 0.5  #: Shortest displacement whose direction is used [m]; below it, the tangent is used.
#: A motion quantity counts as not measured by phases and Dopplers if at most this fraction of its information is
#: independent of the other motion quantities.
LEAST_PIVOT: Final = 1e-12

# Clocks.
STEPPED: Final = 5.0  #: A phase clock or drift restarts if its median innovation exceeds this, in standard deviations.
UNKNOWN_CLOCK: Final = 100.0  #: Standard deviation of the phase clock [m] or of its drift [m/s] after a restart.
FIRST_OFFSET_M2: Final = 1e-4  #: Clock offset variance of the constellation that defines the code clock [m2].

# Reweighting.
PASSES: Final = 4  #: Number of fits of an epoch, with new weights between them.
LEVEL_PASSES: Final = 3  #: Weight sets per epoch in sub-filters: the initial weights, and new weights after two fits.
#: The fit is repeated with an inflated prior if the mean weight of codes, or of phases and Dopplers, is below this.
WEAK_FIT: Final = 0.7
FREEDOM_PLACE_M2: Final = 30.0**2  #: Increase of the position variance in the inflated prior [m2].
FREEDOM_SPEED_M2PS2: Final = 10.0**2  #: Increase of the speed variance in the inflated prior [m2/s2].
#: Correction of the position beyond which the equations are linearised again [m]. Within 20 m, a sharp curve deviates
#: from its tangent by 1 m. Ranges are less critical: within 1 km, their linearisation error is at most 2 cm.
MOVED_M: Final = 2.0
RELINEARISED: Final = 4  #: Largest number of repeated linearisations of an epoch.

# Estimation of the noise.
SCALE_S: Final = 60.0  #: Time constant of the variance scales of Dopplers and phases [s].
LEAST_SCALE: Final = -1.5  #: Lower bound of the logarithm of a variance scale of Dopplers or phases.
LARGEST_SCALE: Final = 3.0  #: Upper bound of the logarithm of a variance scale of Dopplers or phases.
#: While the mean weight of phases and Dopplers is not low, the timer of low weights decreases by this fraction of the
#: time. It is not reset, because weights that are low in every second epoch also show a contradiction.
MOTION_LEAK: Final = 0.5
#: Factor on the elapsed time by which the timer of low code weights decreases while the weights are not low.
CODE_LEAK: Final = 1.0

# Satellites with persistent code errors.
BIAS_MEMORY_S: Final = 60.0  #: Time constant of the mean normalised innovation of a satellite's codes [s].
BIAS_MOST: Final = 1.0  #: Normalised innovations are clipped to +-this value before they are averaged.
BIAS_FAULTY: Final = 0.35  #: Mean normalised innovation above which a satellite's codes are excluded as too long.
#: Mean normalised innovation below which codes are excluded as too short. It differs from `-BIAS_FAULTY`, because
#: delayed codes of other satellites shift the clock, so that correct codes appear short.
BIAS_SHORT: Final = -0.55
#: Mean innovation of a satellite above which the map may be wrong [m]; orbits, clocks and ionosphere cause less.
NOMINAL_M: Final = 0.8
#: The protection level is withheld if the mean innovations of more satellites than this exceed both `BIAS_FAULTY` and
#: `NOMINAL_M` in magnitude, and one of them is negative: the map, a constellation or the clock may be wrong.
BIAS_SATELLITES: Final = 2
BIAS_INFLATED: Final = 1e6  #: Factor of the variance of excluded codes; their innovations show when the fault ends.
#: Sigma [m] added to the position in quadrature when a satellite is excluded, because its codes affected the position.
INFLATED_M: Final = 15.0
INFLATED_SIGMAS: Final = 3.0  #: Code shift [sigmas] above which `INFLATED_M` is not added: all codes may have stepped.

# Length errors of the map.
#: Time constant of the mean code shift that is compared with `TrackingLimits.map_misfit_sigmas`.
MAP_MISFIT_S: Final = 30.0
MAP_MISFIT_KEPT_S: Final = 300.0  #: Time constant with which an increased length error of the map decays [s].
MISFIT_CODES: Final = 4  #: With fewer codes, the code shift is 0: position and clocks cannot be separated.
#: The code shift of an epoch is clipped to +-this value, in standard deviations. Shifts beyond `STEP_SIGMAS` are
#: ignored: they are steps of all codes and contain no information on the map.
MISFIT_CLIPPED: Final = 3.0
MISFIT_LEARNT_S: Final = 5.0  #: Time constant with which the assumed length error of the map increases [s].
#: Upper bound of `map_log_variance`: length errors of 1.6 m per square root of m. Larger errors change no results.
MISFIT_LARGEST: Final = 8.0

# Speeds.
SPEED_SIGMAS: Final = 4.0  #: A measured speed is assumed to be wrong by at most this many standard deviations.

# Branches.
#: Least `map_branch_m`, the distance between two branches at which their evidence counts half: 3 map errors of 2 m.
MAP_BRANCH_M: Final = 6.0
#: Standard deviation of the code error that all satellites on one side of a street share, due to reflections.
CODE_COMMON_M: Final = 10.0
CODE_COMMON_S: Final = 120.0  #: Correlation time of the code error shared by one side of a street [s].
CODE_COMMON_TRAVEL_M: Final = 500.0  #: Correlation length of the code error shared by one side of a street [m].
#: Codes do not reduce the odds of a branch below this value if the branch is within `BRANCH_FLOOR_M` of the best
#: branch.
BRANCH_FLOOR: Final = 1e-3
BRANCH_FLOOR_M: Final = 30.0  #: Distance from the best branch below which `BRANCH_FLOOR` applies [m].
#: Improbable hypotheses are dropped only after this travel [m]; before, motion does not distinguish branches.
DECIDED_TRAVEL_M: Final = 60.0
#: Probability below which hypotheses are dropped: a hundredth of the integrity risk per independent code error.
LEAST_PROBABILITY: Final = 1e-11
START_SIGMA_M: Final = 30.0  #: Initial standard deviation of a hypothesis's position.
GAP_S: Final = 5.0  #: The position search is repeated after this time without measurements [s].
#: Phases and Dopplers contradict the position if their mean weight is below this. Errors of one sigma have weight 1.
LOST_MOTION_WEIGHT: Final = 0.45
LOST_MOTION_S: Final = 6.0  #: The position counts as lost if phases and Dopplers contradict it for this time [s].
LOST_CODE_WEIGHT: Final = 0.5  #: Codes contradict the position if their mean weight is below this.
LOST_CODE_S: Final = 20.0  #: The position counts as lost if codes contradict it for this time [s].
#: If motion contradicts the position, others this far and twice as far ahead of it and behind it are tried [m].
BEND_M: Final = 20.0
EXPIRED_SIGMA_M: Final = 200.0  #: Positions with a larger standard deviation are not reported [m].
#: Another hypothesis is reported only if it is this many times as probable; similar hypotheses then do not alternate.
SWITCH: Final = 3.0
#: If two laps are nearer than this, in units of `map_branch_m`, no evidence distinguishes them permanently. The filter
#: then reports the lap that recent codes prefer.
ALIKE: Final = 1.5
RECENT_S: Final = 30.0  #: Time constant with which the log odds from recent codes decay [s].
RECENT_MOST: Final = 3.0  #: Log odds from recent codes are limited to +-this value.
#: Largest log odds, from motion, of branches `map_branch_m` apart: 1 / (2 s^2), with a map error s of sqrt(2) / 3.
MOST_ODDS: Final = 2.25
#: Largest log odds from the motion of one second (less for shorter intervals). Reflections would cause larger values.
MOST_MOTION: Final = 5.0
#: The position search is repeated if the log probability of the leading hypothesis was recently below this value,
#: because all hypotheses that were more probable at that time have failed.
TAKEOVER: Final = -6.0
LEAST_RISE: Final = 0.3  #: Rise per second of a hypothesis's stored least log probability (`log_least`).
#: `TAKEOVER` is not applied for this time after a start [s], because all hypotheses are new.
TAKEOVER_AFTER_S: Final = 15.0
#: Smallest number of satellites whose phases, Dopplers or codes count as evidence; fewer fit any speed and position.
MOTION_SATELLITES: Final = 4
MOTION_M: Final = 3.0  #: Log odds from motion are limited to the distance travelled divided by this distance [m].
#: Neighbouring positions are tried if phases and Dopplers contradict the position for this time [s]. A position beyond
#: an open end of the line counts as lost instead. A shorter contradiction is attributed to reflections.
BESIDE_AFTER_S: Final = 0.9

# Monitors of the position.
#: The protection level is withheld if phases and Dopplers contradict the position (`LOST_MOTION_WEIGHT`) for this time.
#: Shorter contradictions are caused by noise, which the standard deviation includes.
LEVEL_DOUBT_S: Final = 3.0
LEVEL_DOUBT_CODE_S: Final = 8.0  #: The protection level is withheld if codes contradict the position for this time [s].
#: For this time after a start, the protection level is withheld unless a hypothesis reaches the probability `YOUNG`.
#: After a loss of the position by low weights, it is withheld for this time.
LEVEL_START_S: Final = 15.0
LEVEL_HOLD_S: Final = 5.0  #: Time without a protection level after the last contradiction [s].
#: The velocity is also compared with the line at points this many position sigmas ahead of and behind the position.
REACH_SIGMAS: Final = 2.0
REACH_M: Final = 3.0  #: Least distance of the points ahead and behind at which velocity and line are compared [m].
VELOCITY_FLOOR_MPS: Final = 0.15  #: Standard deviation of an additional error of the measured velocity [m/s].
DIRECTION_SHARE: Final = 0.03  #: Smallest assumed error of the line's direction [rad].
LARGEST_SQUARE: Final = 12.0  #: Largest squared contradiction of an epoch in the cumulative sum (E. S. Page, 1954).
ALLOWED_SQUARE: Final = 4.0  #: Decrease per second of the cumulative sum of squared contradictions.
CONTRADICTION_DOUBT: Final = 12.0  #: Cumulative sum of contradictions above which the protection level is withheld.
CONTRADICTION_LOST: Final = 30.0  #: Cumulative sum of contradictions at which the position counts as lost.
#: Cumulative sum of contradictions after a takeover; a velocity across the line leads to smaller sums.
CONTRADICTION_TAKEN: Final = 60.0
#: Mean code shift above which codes contradict motion, in standard deviations. Possible causes are a step or a slow
#: drift of all codes, or a wrong map.
DRIFT_SIGMAS: Final = 5.0
#: Value of `map_log_variance` above which the map contradicts motion: 6 times the assumed length error.
DRIFT_LOG: Final = 2.0 * math.log(6.0)
#: Mean weight, over `MOTION_FIT_S`, below which Dopplers and phases fit no speed. This occurs if the train has passed a
#: bend that the estimated position has not reached. The limit applies if no wheel or radar measures the speed.
MOTION_FIT: Final = 0.6
MOTION_FIT_S: Final = 2.0
#: Lateral displacement in sigmas, from the sub-filter for a wrong map, above which the map counts as displaced.
BESIDE_SIGMAS: Final = 4.5
BESIDE_M: Final = 8.0  #: Displacement above which the map counts as displaced [m], if `BESIDE_SIGMAS` is exceeded, too.
#: Within `LEVEL_START_S` after a start, the protection level requires this probability of the leading hypothesis.
YOUNG: Final = 0.99
YOUNG_HOLD_S: Final = 1.0  #: Time without a protection level after the probability was below `YOUNG`.
STEP_SIGMAS: Final = 6.0  #: Code shift above which all codes may have stepped, in standard deviations.
STEP_S: Final = 3.0  #: Code shifts above `STEP_SIGMAS` for this time indicate a step [s].
STEP_HOLD_S: Final = 300.0  #: Time without a protection level after a step of all codes.

# Protection levels.
#: Largest assumed relative error of the distance travelled without codes, for example by a wrong wheel diameter.
SCALE_BOUND: Final = 0.02
#: A sub-filter ends if its source is not measured, and if its position and sigma differ from the filter's by less than
#: this fraction of sigma.
JOINED: Final = 0.05
PRECISION_M: Final = 1e-7  #: The iteration for the protection level ends at a Newton step below this [m].
ROUNDS: Final = 60  #: Largest number of Newton steps for the protection level.
#: An alternative (satellite pair, branch with a fault) whose risk is below this fraction of the total risk has no term
#: of its own; its risk is subtracted from the total risk.
PAIR_SHARE: Final = 1e-3
#: Without a satellite pair, the position counts as unbounded if at most this fraction of its information remains.
PAIR_LEFT: Final = 1e-3
AHEAD: Final = 0.3  #: Along-track component of the line of sight beyond which a satellite is ahead or behind.
