"""Indices of the recursion's arrays: unknowns of the state, quantities of the motion, kinds, sensors and sources."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

# Unknowns of the state.
#: Arc length, speed, acceleration along the trajectory [m, m/s, m/s2].
ARC, SPEED, ACCELERATION = 0, 1, 2
#: Arc length at the epoch before [m].
PREVIOUS_ARC: Final = 3
#: Change of the clock of the carrier phases since the epoch before [m], and drift of that clock [m/s].
PHASE_CLOCK, DRIFT = 4, 5
#: Error of the map to the right and up [m].
MAP_RIGHT, MAP_UP = 6, 7
#: Clock of the codes at this epoch [m].
CODE_CLOCK: Final = 8
#: Error of the map's displacement since the epoch before: right, up, along [m].
STEP_RIGHT, STEP_UP, MAP_LENGTH_ERROR = 9, 10, 11
#: Wheel scale-factor error; + where the wheel's distance is too short; no unit.
WHEEL: Final = 12
#: Offset of the accelerometer [m/s2].
FORCE_OFFSET: Final = 13
#: Radar scale-factor error; + where its speed is too low; no unit.
RADAR: Final = 14
#: Time-correlated error of the speed by Dopplers [m/s].
DOPPLER_SPEED: Final = 15
#: Displacement along the line by code errors that last for minutes (orbits, ionosphere) [m].
SLOW_CODE: Final = 16
#: Speed at the epoch before [m/s].
PREVIOUS_SPEED: Final = 17
#: Letters of the receiver clocks of codes, in the order of their offsets in the state.
CLOCKS: Final = ("G", "E", "C", "R", "I")
CLOCK_COUNT: Final = len(CLOCKS)
#: Index of the first offset of the clocks, and of the first error of a satellite's codes, in its standard deviations.
OFFSETS: Final = 18
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
#: Why places have to be sought before an epoch, bits: the track is lost, there were no measurements for long, or motion
#: contradicts the place.
LOST_TRACK, GAP, CONTRADICTED = 1, 2, 4
#: Whether the first epoch of a call is predicted, and its places have been sought; the same where the track was lost.
NOT_SOUGHT, SOUGHT, SOUGHT_AS_LOST = 0, 1, 2


class TrackStatus(IntEnum):
    """What the filter says of an epoch."""

    #: One place, from measurements of this epoch.
    TRACKING = 0
    #: Another place of the line is more probable than the risk; one of the most probable is given.
    SEVERAL_BRANCHES = 1
    #: Predicted: no measurement of this epoch, or none that is believed.
    COASTING = 2
    #: Measurements contradict the track: places are sought over the whole line.
    LOST = 3
    #: No place: predicted with more than 200 m of standard deviation.
    EXPIRED = 4
    #: No place: no epoch so far had two codes more than unknowns.
    NOT_STARTED = 5
    #: No place: every position for 10 s contradicted the line.
    OFF_MAP = 6
    #: One place, but 3-D positions of the last minutes lie beside or above the line, or another track of the network
    #: is more probable than `track_risk`.
    MAP_OFFSET = 7
    #: One place, but within the last 20 s its distance from the other antenna's was off by more than 5 m, or its speed
    #: by more than 1.5 m/s, and four standard deviations.
    ANTENNAS_DISAGREE = 8
    #: One place, but measurements, the velocity or a sub-filter contradict it: nothing bounds its error.
    DOUBTFUL = 9
    #: One place, but the signals may be those of a spoofer: nothing bounds its error.
    SPOOFING_SUSPECTED = 10

    @property
    def text(self) -> str:
        """The word written to files: ``several_branches``."""
        return self.name.lower()


(
    TRACKING, SEVERAL_BRANCHES, COASTING, LOST, EXPIRED, NOT_STARTED, OFF_MAP, MAP_OFFSET, ANTENNAS_DISAGREE, DOUBTFUL,
    SPOOFING_SUSPECTED,
) = map(int, TrackStatus)  # fmt: skip
