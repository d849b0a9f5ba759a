"""Constants of the filter along the track that nobody tunes, each with its reason: compiled in.

`railfix.tracking.limits` has what a user may set.
"""

from __future__ import annotations

import math
from typing import Final

# Prediction.
#: Time and travel over which the multipath of a satellite's code changes: a reflector of a street or a station is
#: passed within about 100 m; at rest the fringe of one 10 m away lasts about a minute.
CODE_CORRELATION_S: Final = 60.0
CODE_CORRELATION_M: Final = 100.0
#: Correlation time of the displacement by orbits and ionosphere, `TrackingLimits.slow_code_m`.
SLOW_CODE_S: Final = 7200.0
#: Time-correlated error of the speed by Dopplers: its least size, its share of the speed (a reflected signal is
#: shifted by up to the speed, at rest not at all) and its correlation time.
DOPPLER_ERROR_MPS: Final = 0.01
DOPPLER_ERROR_SHARE: Final = 0.02
DOPPLER_CORRELATION_S: Final = 10.0
#: Displacement in the square root of a second by slow errors of all phases: ionosphere, troposphere, orbits and
#: clocks, 0.5 mm/s along the line for half an hour.
PHASE_WALK_M: Final = 0.03
#: Change of the drift of the receiver's clock in the square root of a second: 1.7e-9 of the frequency, what quartz
#: oscillators without an oven show when shaken.
CLOCK_WALK_MPS: Final = 0.5
#: Change of the offset between two constellations in the square root of a second, and its first standard deviation.
OFFSET_WALK_M: Final = 0.02
OFFSET_PRIOR_M: Final = 30.0
#: Least local error of the map across and up, and the length over which it changes. The map's stated accuracy
#: counts where it is more, of heights the half.
MAP_ROUGHNESS_M: Final = 0.3
MAP_CORRELATION_M: Final = 50.0
MAP_SCALE_M: Final = 0.03  #: Error of a length along the map [m per square root of m].
MAP_ABSOLUTE_M: Final = 500.0  #: Length over which the absolute error of the map changes; its sigma is the map's.
CODE_CLOCK_SIGMA_M: Final = 1e3  #: Standard deviation of the clock of the codes about the median of an epoch [m].
#: Random walks of the sensors' scales and offset in the square root of a second. A wheel of a car wandered over 2 %
#: within half a minute at bends; an accelerometer's offset follows its temperature.
WHEEL_WALK: Final = 5e-4
FORCE_WALK_MPS2: Final = 1e-3
RADAR_WALK: Final = 2e-4
#: Share of the map's error of height that changes over `MAP_CORRELATION_M`; across it is the whole: heights of a survey
#: or a terrain model are wrong over longer distances.
HEIGHT_ROUGHNESS: Final = 0.5
LEAST_STEP_M2: Final = 1e-6  #: Least variance of a step of the place [m2]; it keeps matrices regular.

# Equations.
#: Slower than this ranges to ground units are not used [m/s]: the error of a standing range stays (P2 3.3).
STILL_MPS: Final = 0.3
#: Slower than this a speed does not tell the direction [m/s]: four sigmas of what a wheel of one hertz leaves of it.
DIRECTION_MPS: Final = 1.0
CHORD_M: Final = 0.5  #: Shorter than this the tangent is the direction of a displacement [m].
#: Share of their own information below which phases or Dopplers say nothing that others do not.
LEAST_PIVOT: Final = 1e-12

# Clocks.
STEPPED: Final = 5.0  #: A clock whose median innovation is beyond this many standard deviations has stepped.
UNKNOWN_CLOCK: Final = 100.0  #: Standard deviation of the clock of phases and its drift after a step [m, m/s].
FIRST_OFFSET_M2: Final = 1e-4  #: Variance of the offset of the first constellation from the clock of the codes [m2].

# Reweighting.
PASSES: Final = 4  #: Rounds of reweighting an epoch.
LEVEL_PASSES: Final = 3  #: Rounds of reweighting of the sub-filters.
#: Mean weight of codes, or of phases and Dopplers, under which another start of the reweighting is tried.
WEAK_FIT: Final = 0.7
#: Variances of place and speed added for that start [m2, m2/s2].
FREEDOM_PLACE_M2: Final = 30.0**2
FREEDOM_SPEED_M2PS2: Final = 10.0**2
#: The equations are made again when a place has moved by more than this [m]: 26 000 km away a range bends by 2 cm
#: over 1 km, the line by 1 m over 20 m in its sharpest curves.
MOVED_M: Final = 2.0
RELINEARISED: Final = 4

# What is learnt of noise.
SCALE_S: Final = 60.0  #: Time over which the scales of Dopplers and phases are adapted [s].
#: Logarithms that the scales of their variances stay within.
LEAST_SCALE: Final = -1.5
LARGEST_SCALE: Final = 3.0
#: Shares of an interval by which the counters of doubt in motion and in codes fall at an epoch without doubt: weights
#: that alternate about the limit are a contradiction as well.
MOTION_LEAK: Final = 0.5
CODE_LEAK: Final = 1.0

# Satellites whose codes are wrong for long.
#: Time constant of the mean innovation [s], what one innovation counts at most, and the means beyond which codes are
#: left out: too long, and too short. Late codes of other satellites pull the clock, so that right ones seem too short.
BIAS_MEMORY_S: Final = 60.0
BIAS_MOST: Final = 1.0
BIAS_FAULTY: Final = 0.35
BIAS_SHORT: Final = -0.55
#: Errors of a satellite's orbit, clock and ionosphere last for hours: a mean below this is no sign of a wrong map [m].
NOMINAL_M: Final = 0.8
#: With more satellites beyond `BIAS_FAULTY`, too long or too short, and one of them too short, there is no level: the
#: map or a constellation is wrong, or reflections pull the clock.
BIAS_SATELLITES: Final = 2
BIAS_INFLATED: Final = 1e6  #: Factor on the variance of codes that are left out: innovations show when the fault ends.
#: Standard deviation added to the place when a satellite is left out from here on: its codes have led it so far [m].
INFLATED_M: Final = 15.0
INFLATED_SIGMAS: Final = 3.0  #: Not where all codes are off by more sigmas: they may have stepped together.

# Lengths of the map.
#: Time over which codes are to contradict the length (`TrackingLimits.map_misfit_sigmas`), and within which a larger
#: error of it is forgotten.
MAP_MISFIT_S: Final = 30.0
MAP_MISFIT_KEPT_S: Final = 300.0
MISFIT_CODES: Final = 4  #: Fewer codes of an epoch do not tell a shift from clocks.
#: A single epoch counts with at most so many standard deviations; beyond `STEP_SIGMAS` it is a step of all codes and
#: shows nothing of the map.
MISFIT_CLIPPED: Final = 3.0
#: Time constant of learning [s], and the largest logarithm: beyond 1.6 m in the square root of a metre nothing changes.
MISFIT_LEARNT_S: Final = 5.0
MISFIT_LARGEST: Final = 8.0

# Speeds.
SPEED_SIGMAS: Final = 4.0  #: A measured speed is known to this many standard deviations.

# Branches.
#: Least distance of two branches at which half of their difference is the map's: three times an error of 2 m.
MAP_BRANCH_M: Final = 6.0
#: Standard deviation of an error that the codes have in common across the line: reflections off one side of a
#: street.
CODE_COMMON_M: Final = 10.0
#: Time and distance over which that error lasts.
CODE_COMMON_S: Final = 120.0
CODE_COMMON_TRAVEL_M: Final = 500.0
#: Codes alone leave a branch this near at least this probability.
BRANCH_FLOOR: Final = 1e-3
BRANCH_FLOOR_M: Final = 30.0
#: Hypotheses are dropped only after this much travel: before, motion does not separate branches.
DECIDED_TRAVEL_M: Final = 60.0
#: Hypotheses below it are dropped: a hundredth of the risk of an independent error.
LEAST_PROBABILITY: Final = 1e-11
START_SIGMA_M: Final = 30.0  #: Standard deviation of a hypothesis when it begins.
GAP_S: Final = 5.0  #: Time without measurements after which places are sought again.
#: The track is lost when the mean weight of motion, or of codes, was below these for so long; 1 is the weight of an
#: error of one standard deviation. Epochs above them count down.
LOST_MOTION_WEIGHT: Final = 0.45
LOST_MOTION_S: Final = 6.0
LOST_CODE_WEIGHT: Final = 0.5
LOST_CODE_S: Final = 20.0
#: Where motion contradicts the track, places so far (and twice) before and behind are tried.
BEND_M: Final = 20.0
EXPIRED_SIGMA_M: Final = 200.0  #: Largest standard deviation of a predicted position.
#: How much more probable another place must be to be gone by: near-equal ones would take turns.
SWITCH: Final = 3.0
#: Among laps within so many `MAP_BRANCH_M` of each other, which nothing distinguishes for good, the filter goes by the
#: one that codes have preferred lately: a mean of so many seconds, of odds whose logarithm is no larger than this.
ALIKE: Final = 1.5
RECENT_S: Final = 30.0
RECENT_MOST: Final = 3.0
#: Logarithm of the odds that a difference of one `MAP_BRANCH_M` can give: 1 / (2 s^2) with s^2 = 2 (1/3)^2.
MOST_ODDS: Final = 2.25
#: Largest logarithm of the odds that motion gives in a second, or in an epoch: more is a reflection.
MOST_MOTION: Final = 5.0
#: A hypothesis that leads although its probability was below this within the last seconds (its least logarithm rises
#: by `LEAST_RISE` a second) has taken over from others that all failed: places are sought again. Not within the first
#: seconds, when all are young.
TAKEOVER: Final = -6.0
LEAST_RISE: Final = 0.3
TAKEOVER_AFTER_S: Final = 15.0
#: Satellites with a phase or a Doppler, or codes, that an epoch's evidence needs: fewer fit any speed and place.
MOTION_SATELLITES: Final = 4
MOTION_M: Final = 3.0  #: Travel worth one of the logarithm of the odds by motion [m]: at rest tangents do not differ.
#: Places beside are tried, and beyond an open end the track is lost, once motion has been contradicted for so long [s]:
#: shorter it is a reflection, at any rate.
BESIDE_AFTER_S: Final = 0.9

# Monitors of the place.
#: A filter contradicted by its motion, or codes, for longer bounds nothing; mean weights are those of a lost track.
#: A contradiction of single epochs is noise, which is in the standard deviation.
LEVEL_DOUBT_S: Final = 3.0
LEVEL_DOUBT_CODE_S: Final = 8.0
#: After a start no level before a place has a probability of 0.99, at most so long; none for so long after the
#: track was lost.
LEVEL_START_S: Final = 15.0
LEVEL_HOLD_S: Final = 5.0  #: A level comes back so long after the last contradiction.
#: The velocity is compared with the line at the place and so many of its standard deviations, or metres, beside it.
REACH_SIGMAS: Final = 2.0
REACH_M: Final = 3.0
#: Errors of the velocity beside its covariance [m/s], and least of the line's direction as a share of the speed.
VELOCITY_FLOOR_MPS: Final = 0.15
DIRECTION_SHARE: Final = 0.03
#: A squared contradiction counts up to this, less this a second (cumulative sum, E. S. Page, 1954).
LARGEST_SQUARE: Final = 12.0
ALLOWED_SQUARE: Final = 4.0
#: Sums from which on the level is withheld, and the track is lost.
ACROSS_DOUBT: Final = 12.0
ACROSS_LOST: Final = 30.0
ACROSS_TAKEN: Final = 60.0  #: The sum after a takeover: more than a velocity across the line gives.
#: Mean of the places that codes imply, over its standard deviation, and logarithm of the variance of lengths of the
#: map, 6 times their error: beyond them codes contradict motion, by a step of all codes, a pull, or a wrong map.
DRIFT_SIGMAS: Final = 5.0
DRIFT_LOG: Final = 2.0 * math.log(6.0)
#: Dopplers and phases that do not agree with each other on a speed: their mean weight over `MOTION_FIT_S`, while no
#: sensor on board measures the speed. A train beyond a bend that its place has not reached seems to stand.
MOTION_FIT: Final = 0.6
MOTION_FIT_S: Final = 2.0
#: A displacement of the map across, by the sub-filter that lets it be wrong, is real beyond so many of its standard
#: deviations and metres.
BESIDE_SIGMAS: Final = 4.5
BESIDE_M: Final = 8.0
#: Young hypotheses bound nothing before one of them is this probable: the right place may not be among them yet.
YOUNG: Final = 0.99
YOUNG_HOLD_S: Final = 1.0
#: Codes that imply another place by more than so many standard deviations for so long [s] have stepped together.
STEP_SIGMAS: Final = 6.0
STEP_S: Final = 3.0
STEP_HOLD_S: Final = 300.0  #: No level for this long after a step of all codes [s]: the place is the codes' own.

# Levels.
SCALE_BOUND: Final = 0.02  #: Share of a distance without codes that may be wrong: a worn or wrongly entered wheel.
#: A source that is not measured needs no sub-filter once it has left the filter: place and standard deviation differ
#: by less than this share of the standard deviation.
JOINED: Final = 0.05
#: Newton's steps for the level end when one is smaller than this [m], or after this many.
PRECISION_M: Final = 1e-7
ROUNDS: Final = 60
#: A pair of satellites that requires less than this share of the risk has it taken off, in place of a term of its own.
PAIR_SHARE: Final = 1e-3
PAIR_LEFT: Final = 1e-3  #: Less than this share of what is known of the place, without both of a pair, is nothing.
AHEAD: Final = 0.3  #: Satellites whose line of sight has at least this component along the track are ahead, or behind.
