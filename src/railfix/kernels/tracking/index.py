"""Indices of unknowns, motion quantities, measurement kinds, sensors and sources in the arrays of the recursion."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

# State unknowns.
#: Arc length, speed, acceleration along the trajectory [m, m/s, m/s2].
ARC, SPEED, ACCELERATION = 0, 1, 2
#: Arc length at the previous epoch [m].
PREVIOUS_ARC: Final = 3
#: Change of the phase clock since the previous epoch [m], and drift of the phase clock [m/s].
PHASE_CLOCK, DRIFT = 4, 5
#: Map error to the right and up [m].
MAP_RIGHT, MAP_UP = 6, 7
#: Code clock at this epoch [m].
CODE_CLOCK: Final = 8
#: Error of the map's displacement between the previous and this epoch: to the right, up, along [m].
STEP_RIGHT, STEP_UP, MAP_LENGTH_ERROR = 9, 10, 11
#: Wheel scale-factor error (no unit), positive if the wheel distance is too short.
WHEEL: Final = 12
#: Offset of the accelerometer [m/s2].
FORCE_OFFSET: Final = 13
#: Radar scale-factor error (no unit), positive if the radar speed is too low.
RADAR: Final = 14
#: Time-correlated error of the Doppler speed [m/s].
DOPPLER_SPEED: Final = 15
#: Displacement of the position along the line by code errors that last for hours (orbits, ionosphere) [m].
SLOW_CODE: Final = 16
#: Speed at the previous epoch [m/s].
PREVIOUS_SPEED: Final = 17
#: System letters of the code clocks, in the order of the clock offsets in the state.
CLOCKS: Final = ("G", "E", "C", "R", "I")
CLOCK_COUNT: Final = len(CLOCKS)
#: Indices of the first clock offset [m] and of the first satellite code error (unit: its standard deviation).
OFFSETS: Final = 18
SATELLITES: Final = OFFSETS + CLOCK_COUNT
#: Unknowns that restart at every epoch: code clock and errors of the map's displacement.
PER_EPOCH: Final = (CODE_CLOCK, STEP_RIGHT, STEP_UP, MAP_LENGTH_ERROR)

#: Motion quantities of phases and Dopplers: distance, change of the phase clock, right and up components of the error
#: of the map's displacement, speed, drift.
M_DISTANCE, M_CLOCK, M_RIGHT, M_UP, M_SPEED, M_DRIFT = 0, 1, 2, 3, 4, 5
MOTION: Final = 6
#: Largest number of unknowns in a quantity, and index of the code clock among these unknowns.
TERMS: Final = 7
CLOCK_TERM: Final = TERMS - 1

#: Kinds of GNSS measurements of a channel.
CODE, PHASE, DOPPLER = 0, 1, 2
#: Columns of sensors: wheel, radar, force, position, balises (two in turn), then one per ranging ground unit.
WHEEL_COLUMN, RADAR_COLUMN, FORCE_COLUMN, PLACE_COLUMN, RANGE_COLUMN = 0, 1, 2, 3, 6
#: Number of sensor kinds: one for each column before the ranges, and one for all ranges.
SENSORS: Final = 7
#: Number of sub-filters that follow the sub-filters of sensors. They exclude all Dopplers, all phases, codes of
#: satellites ahead, codes of satellites behind, the map, or no source (all satellites in view).
OTHERS: Final = 6
ALL_DOPPLERS, ALL_PHASES, CODES_AHEAD, CODES_BEHIND, WRONG_MAP, ALL_IN_VIEW = 0, 1, 2, 3, 4, 5
#: Reasons for a position search before an epoch, as bits: the position is lost, measurements were missing for `GAP_S`,
#: or motion contradicts the position.
LOST_TRACK, GAP, CONTRADICTED = 1, 2, 4
#: State of a call's first epoch: not predicted; predicted, and position search completed; predicted, and position
#: search completed after a loss of the position.
NOT_SOUGHT, SOUGHT, SOUGHT_AS_LOST = 0, 1, 2


class TrackStatus(IntEnum):
    """Status of a filter epoch."""

    #: One position, from measurements of this epoch.
    TRACKING = 0
    #: The probability of other positions on the line exceeds the risk. One of the most probable positions is reported.
    SEVERAL_BRANCHES = 1
    #: Predicted position: the epoch has no accepted measurement.
    COASTING = 2
    #: Measurements contradict the previous position; the whole line is searched for the position.
    LOST = 3
    #: No position: the standard deviation of the predicted position exceeds 200 m.
    EXPIRED = 4
    #: No position: no epoch so far had two redundant codes.
    NOT_STARTED = 5
    #: No position: all positions of the last 10 s contradicted the line.
    OFF_MAP = 6
    #: The position may be on a wrong line: 3-D positions of the last minutes are beside or above the line, or the
    #: probability of other tracks of the network exceeds `track_risk`.
    MAP_OFFSET = 7
    #: One position, but in the last 20 s the distance between both antennas was wrong by more than 5 m and four sigmas,
    #: or their speeds differed by more than 1.5 m/s and four sigmas.
    ANTENNAS_DISAGREE = 8
    #: One position, but measurements, the velocity or a sub-filter contradict it: the error is not bounded.
    DOUBTFUL = 9
    #: One position, but the signals may be spoofed: the error is not bounded.
    SPOOFING_SUSPECTED = 10

    @property
    def text(self) -> str:
        """Status text that is written to files, such as ``several_branches``."""
        return self.name.lower()


(
    TRACKING, SEVERAL_BRANCHES, COASTING, LOST, EXPIRED, NOT_STARTED, OFF_MAP, MAP_OFFSET, ANTENNAS_DISAGREE, DOUBTFUL,
    SPOOFING_SUSPECTED,
) = map(int, TrackStatus)  # fmt: skip
