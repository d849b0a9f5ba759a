"""Indices of the recursion's arrays: unknowns of the state, quantities of the motion, kinds, sensors and sources."""

from __future__ import annotations

from enum import IntEnum
from typing import Final


class StateIndex(IntEnum):
    """Index of each unknown in the state; offsets of the clocks and satellites' code errors come after."""

    #: Arc length, speed, acceleration along the trajectory [m, m/s, m/s2].
    ARC = 0
    SPEED = 1
    ACCELERATION = 2
    #: Arc length at the epoch before [m].
    PREVIOUS_ARC = 3
    #: Change of the clock of the carrier phases since the epoch before [m].
    PHASE_CLOCK = 4
    #: Drift of that clock [m/s].
    DRIFT = 5
    #: Error of the map to the right and up [m].
    MAP_RIGHT = 6
    MAP_UP = 7
    #: Clock of the codes at this epoch [m].
    CODE_CLOCK = 8
    #: Error of the map's displacement since the epoch before: right, up, along [m].
    STEP_RIGHT = 9
    STEP_UP = 10
    MAP_LENGTH_ERROR = 11
    #: Wheel scale-factor error; + where the wheel's distance is too short; no unit.
    WHEEL = 12
    #: Offset of the accelerometer [m/s2].
    FORCE_OFFSET = 13
    #: Radar scale-factor error; + where its speed is too low; no unit.
    RADAR = 14
    #: Time-correlated error of the speed by Dopplers [m/s].
    DOPPLER_SPEED = 15
    #: Displacement along the line by code errors that last for minutes (orbits, ionosphere) [m].
    SLOW_CODE = 16
    #: Speed at the epoch before [m/s].
    PREVIOUS_SPEED = 17


(
    ARC, SPEED, ACCELERATION, PREVIOUS_ARC, PHASE_CLOCK, DRIFT, MAP_RIGHT, MAP_UP, CODE_CLOCK, STEP_RIGHT, STEP_UP,
    MAP_LENGTH_ERROR, WHEEL, FORCE_OFFSET, RADAR, DOPPLER_SPEED, SLOW_CODE, PREVIOUS_SPEED,
) = map(int, StateIndex)  # fmt: skip
#: Letters of the receiver clocks of codes, in the order of their offsets in the state.
CLOCKS: Final = ("G", "E", "C", "R", "I")
CLOCK_COUNT: Final = len(CLOCKS)
#: Index of the first offset of the clocks, and of the first error of a satellite's codes, in its standard deviations.
OFFSETS: Final = len(StateIndex)
SATELLITES: Final = OFFSETS + CLOCK_COUNT
#: Unknowns that start again at every epoch: clock of the codes, displacements of the map.
PER_EPOCH: Final = (CODE_CLOCK, STEP_RIGHT, STEP_UP, MAP_LENGTH_ERROR)

#: Quantities that phases and Dopplers are sums of: distance, change of the phases' clock, displacement of the map to
#: the right and up, speed, drift.
M_DISTANCE, M_CLOCK, M_RIGHT, M_UP, M_SPEED, M_DRIFT = 0, 1, 2, 3, 4, 5
MOTION: Final = 6
#: Unknowns in a quantity at most; the last is its clock.
TERMS: Final = 7
CLOCK_TERM: Final = TERMS - 1

#: Kinds of GNSS measurements in a channel.
CODE, PHASE, DOPPLER = 0, 1, 2
#: Columns of sensors: wheel, radar, force, place, balises in turn, and one for each range to a ground unit.
WHEEL_COLUMN, RADAR_COLUMN, FORCE_COLUMN, PLACE_COLUMN, RANGE_COLUMN = 0, 1, 2, 3, 6
#: Kinds of sensors: the columns, all ranges together.
SENSORS: Final = 7
#: Sources of sub-filters after the sensors: all Dopplers, all phases, codes of satellites ahead, behind, the map; and
#: none, for all satellites in view.
OTHERS: Final = 6
ALL_DOPPLERS, ALL_PHASES, CODES_AHEAD, CODES_BEHIND, WRONG_MAP, ALL_IN_VIEW = 0, 1, 2, 3, 4, 5
#: Parts of an epoch: all of it; the prediction alone; what follows a prediction, places having been sought in between;
#: the same where the track was lost.
WHOLE, PREDICTION, REST, REST_LOST = 0, 1, 2, 3
