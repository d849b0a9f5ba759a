"""Indices of the recursion's arrays: state unknowns, motion quantities, kinds, sensors and sources."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

# State unknowns.
#: Arc length, speed, acceleration along the trajectory [m, m/s, m/s2].
ARC, SPEED, ACCELERATION = 0, 1, 2
#: Arc length at the previous epoch [m].
PREVIOUS_ARC: Final = 3
#: Change of the phase clock since the previous epoch [m], and drift of that clock [m/s].
PHASE_CLOCK, DRIFT = 4, 5
#: Map error to the right and up [m].
MAP_RIGHT, MAP_UP = 6, 7
#: Code clock at this epoch [m].
CODE_CLOCK: Final = 8
#: Error of the map's displacement since the previous epoch: right, up, along [m].
STEP_RIGHT, STEP_UP, MAP_LENGTH_ERROR = 9, 10, 11
#: Wheel scale-factor error, positive if the wheel's distance is too short; no unit.
WHEEL: Final = 12
#: Offset of the accelerometer [m/s2].
FORCE_OFFSET: Final = 13
#: Radar scale-factor error, positive if the radar's speed is too low; no unit.
RADAR: Final = 14
#: Time-correlated error of the Doppler speed [m/s].
DOPPLER_SPEED: Final = 15
#: Displacement along the line by code errors that last for hours (orbits, ionosphere) [m].
SLOW_CODE: Final = 16
#: Speed at the previous epoch [m/s].
PREVIOUS_SPEED: Final = 17
#: System letters of the code clocks, in the order of the clock offsets in the state.
CLOCKS: Final = ("G", "E", "C", "R", "I")
CLOCK_COUNT: Final = len(CLOCKS)
#: Index of the first clock offset, and of the first satellite code error. A code error is in units of its sigma.
OFFSETS: Final = 18
SATELLITES: Final = OFFSETS + CLOCK_COUNT
#: Unknowns that are restarted at every epoch: code clock and map displacements.
PER_EPOCH: Final = (CODE_CLOCK, STEP_RIGHT, STEP_UP, MAP_LENGTH_ERROR)

#: Motion quantities, from which phases and Dopplers are computed: distance, change of the phase clock, map displacement
#: to the right and up, speed, drift.
M_DISTANCE, M_CLOCK, M_RIGHT, M_UP, M_SPEED, M_DRIFT = 0, 1, 2, 3, 4, 5
MOTION: Final = 6
#: Largest number of unknowns in a quantity; the last is the clock of the quantity.
TERMS: Final = 7
CLOCK_TERM: Final = TERMS - 1

#: Kinds of GNSS measurements of a channel.
CODE, PHASE, DOPPLER = 0, 1, 2
#: Columns of the sensors: wheel, radar, force, position, two for alternate balises, one per range to a ground unit.
WHEEL_COLUMN, RADAR_COLUMN, FORCE_COLUMN, PLACE_COLUMN, RANGE_COLUMN = 0, 1, 2, 3, 6
#: Number of kinds of sensors: one per column, but one for all ranges.
SENSORS: Final = 7
#: Sources of sub-filters after the sensors: all Dopplers, all phases, codes of satellites ahead, codes of satellites
#: behind, the map. The last excludes no source (all satellites in view).
OTHERS: Final = 6
ALL_DOPPLERS, ALL_PHASES, CODES_AHEAD, CODES_BEHIND, WRONG_MAP, ALL_IN_VIEW = 0, 1, 2, 3, 4, 5
#: Reasons for a position search before an epoch, as bits: the track is lost, there were no measurements for a long
#: time, or motion contradicts the position.
LOST_TRACK, GAP, CONTRADICTED = 1, 2, 4
#: Flags of the first epoch of a call: not predicted; predicted, with the position search done; the same with the track
#: lost.
NOT_SOUGHT, SOUGHT, SOUGHT_AS_LOST = 0, 1, 2


class TrackStatus(IntEnum):
    """Status of a filter epoch."""

    #: One position, from measurements of this epoch.
    TRACKING = 0
    #: Another position on the line is more probable than the risk; one of the most probable positions is given.
    SEVERAL_BRANCHES = 1
    #: Predicted: the epoch has no measurement, or none that is accepted.
    COASTING = 2
    #: Measurements contradict the track: the whole line is searched for the position.
    LOST = 3
    #: No position: the predicted standard deviation exceeds 200 m.
    EXPIRED = 4
    #: No position: no epoch so far had two codes more than unknowns.
    NOT_STARTED = 5
    #: No position: all positions of the last 10 s contradicted the line.
    OFF_MAP = 6
    #: One position, but 3-D positions of the last minutes are beside or above the line, or another track of the network
    #: is more probable than `track_risk`.
    MAP_OFFSET = 7
    #: One position, but within the last 20 s its distance from the other antenna was wrong by more than 5 m, or their
    #: speeds differed by more than 1.5 m/s, and by more than four standard deviations.
    ANTENNAS_DISAGREE = 8
    #: One position, but measurements, the velocity or a sub-filter contradict it: its error is not bounded.
    DOUBTFUL = 9
    #: One position, but the signals may be spoofed: its error is not bounded.
    SPOOFING_SUSPECTED = 10

    @property
    def text(self) -> str:
        """Status text that is written to files, such as ``several_branches``."""
        return self.name.lower()


(
    TRACKING, SEVERAL_BRANCHES, COASTING, LOST, EXPIRED, NOT_STARTED, OFF_MAP, MAP_OFFSET, ANTENNAS_DISAGREE, DOUBTFUL,
    SPOOFING_SUSPECTED,
) = map(int, TrackStatus)  # fmt: skip
