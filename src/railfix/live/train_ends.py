"""Reference point of a train, and positions of the antennas and the ends of the train relative to this point."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, NamedTuple, Self

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import SettingsError
from railfix.live.settings import LiveSettings
from railfix.track.trajectory import Trajectory

#: A train that has run this distance against the direction of its leading end counts as having changed ends [m]. A
#: train is assumed never to roll back this far.
CHANGED_ENDS_M: Final = 50.0


class Ends(NamedTuple):
    """Positions of a train's ends relative to its reference point along the line [m]; NaN if unknown.

    If the running direction is unknown, each end may be on either side of the reference point.
    """

    #: Position of the front end, positive ahead of the reference point; the middle of all possible positions.
    front_m: float
    spread_m: float  #: Largest distance between `front_m` and a possible position of the front end.
    foremost_m: float  #: Largest distance by which the train may extend ahead of the reference point.
    rearmost_m: float  #: Largest distance by which the train may extend behind the reference point.


@dataclass(frozen=True, kw_only=True)
class TrainFrame:
    """Reference point and ends of a train.

    The reference point is the middle between the bogies of the vehicle that carries the antennas. Without a vehicle
    file the reference point is the first antenna, and positions of a second antenna are not used.
    """

    trajectories: Mapping[str, Trajectory]
    facing: int  #: Direction of the vehicle's front: 1 toward rising chainage, -1 toward falling, 0 if unknown.
    running: int  #: Direction of the train's leading end at the start, coded as `facing`.
    front_m: float  #: Distance from the reference point to the train's end at the vehicle's front [m]; NaN if unknown.
    rear_m: float  #: Distance from the reference point to the train's end at the vehicle's rear [m]; NaN if unknown.
    length_m: float  #: Length of the train [m]; NaN if unknown.

    @classmethod
    def of(cls, trajectories: Mapping[str, Trajectory], settings: LiveSettings) -> Self:
        """Return the frame of a train, from the vehicle file and the settings; the settings take precedence.

        Raise SettingsError if the front end is farther ahead of the reference point than the train is long.
        """
        first = next(iter(trajectories.values()))
        on_vehicle = first.body_chainage_m is not None
        running = settings.facing
        facing = int(first.front_sign) if on_vehicle else running or 0
        front = first.front_end_m
        if settings.front_offset_m is not None:
            front = settings.front_offset_m + first.antenna_ahead_m
        length = settings.length_m
        if length is None and first.front_end_m is not None and first.rear_end_m is not None:
            length = first.front_end_m + first.rear_end_m
        rear = None if length is None or front is None else length - front
        if rear is not None and rear < 0.0:
            raise SettingsError(
                f"--live length_m={length:g}: the train's front end is {front:.2f} m ahead of its reference "
                "point (front_offset_m, or the vehicle file), further than the train is long; correct one of them"
            )
        return cls(
            trajectories=trajectories,
            facing=facing,
            running=facing if running is None else running,
            front_m=math.nan if front is None else front,
            rear_m=math.nan if rear is None else rear,
            length_m=math.nan if length is None else length,
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences that name the unknown properties of the train, and the settings by which these can be specified."""
        notes = []
        if not self.running:
            notes.append("the direction of the train's front end is unknown until the train has run 50 m: give a "
                         "vehicle file, or --live facing")  # fmt: skip
        if not math.isfinite(self.front_m):
            notes.append(
                "the position of the train's front end is unknown, so messages have the position of the reference "
                "point: give length_m in the vehicle file, or --live front_offset_m"
            )
        if not math.isfinite(self.length_m):
            notes.append("the train's length is unknown, so messages have no safe rear end: give length_m in the "
                         "vehicle file, or --live length_m")  # fmt: skip
        if len(self.trajectories) > 1 and self.trajectories[self.first].body_chainage_m is None:
            notes.append("there is no vehicle file: positions are computed from the first antenna alone")
        return tuple(notes)

    def reference_m(self, name: str, arc_m: float) -> float:
        """Return the chainage of the reference point, computed from an antenna's position along the line [m]; NaN if
        unknown.
        """
        trajectory = self.trajectories[name]
        if trajectory.body_chainage_m is not None:
            return float(trajectory.body_at(arc_m))
        return float(trajectory.chainage_at(arc_m)) if name == self.first else math.nan

    @property
    def first(self) -> str:
        """Name of the first antenna."""
        return next(iter(self.trajectories))

    def first_antenna_ecef_m(self, name: str, arc_m: float) -> Floats:
        """Return the first antenna's position (ECEF), shape (3,) [m], from the arc length of antenna `name`."""
        first, trajectory = self.trajectories[self.first], self.trajectories[name]
        if name != self.first:
            arc_m = float(first.arc_of_body(trajectory.body_at(arc_m)))
        return first.at_arc(np.float64(arc_m))

    def ends(self, running: int) -> Ends:
        """Return the ends of a train; `running` is the direction of the leading end, 1 or -1, or 0 if unknown."""
        front, rear = self.front_m, self.rear_m
        if running and self.facing:
            front, rear = (front, rear) if running == self.facing else (rear, front)
            return Ends(front, 0.0, front, rear)
        longest, shortest = max(front, rear), min(front, rear)
        if not math.isfinite(front + rear):
            longest = shortest = math.nan
        if running:  # it is unknown which end of the vehicle leads
            return Ends((longest + shortest) / 2.0, (longest - shortest) / 2.0, longest, longest)
        return Ends(0.0 if math.isfinite(longest) else math.nan, longest, longest, longest)


@dataclass(frozen=True, kw_only=True)
class RunningEnd:
    """Direction of the train's leading end along the chainage, from the vehicle file and the train's motion.

    The direction is set, or changed, when the train moves away from the farthest position that it has reached in the
    opposite direction. The distance from this position must exceed `CHANGED_ENDS_M` plus the bounds of both positions.
    """

    direction: int  #: Direction: 1 toward rising chainage, -1 toward falling, 0 if unknown.
    #: Upper bound of the lowest chainage that the reference point has had since the last change of direction [m];
    #: infinite before the first position.
    low_m: float = math.inf
    #: Lower bound of the highest chainage that the reference point has had since the last change of direction [m];
    #: minus infinity before the first position.
    high_m: float = -math.inf
    last_m: float = math.inf  #: Last chainage of the reference point [m]; infinite before the first position.

    def after(self, reference_m: float, bound_m: float, moving: int) -> RunningEnd:
        """Return the state after an epoch; without a finite bound, the state is unchanged. `moving` is the direction of
        motion.
        """
        if not (math.isfinite(reference_m) and math.isfinite(bound_m)):
            return self
        low, high = min(self.low_m, reference_m + bound_m), max(self.high_m, reference_m - bound_m)
        # The bounds are reset after a jump of the chainage: after a gap, or where a closed line begins again at 0.
        if not abs(reference_m - self.last_m) < CHANGED_ENDS_M:
            low, high = reference_m + bound_m, reference_m - bound_m
        direction = self.direction
        if moving > 0 and direction != 1 and reference_m - bound_m - low > CHANGED_ENDS_M:
            direction = 1
        if moving < 0 and direction != -1 and high - reference_m - bound_m > CHANGED_ENDS_M:
            direction = -1
        if direction != self.direction:
            low, high = reference_m + bound_m, reference_m - bound_m
        return replace(self, direction=direction, low_m=low, high_m=high, last_m=reference_m)

    def sentence(self, before: RunningEnd) -> str | None:
        """Return a sentence for the log if the direction differs from the earlier state `before`, otherwise None."""
        if self.direction == before.direction:
            return None
        side = "rising" if self.direction > 0 else "falling"
        if not before.direction:
            return f"the train runs toward {side} chainage; its front end is assumed to point in this direction"
        return f"the train has changed ends: it has run {CHANGED_ENDS_M:g} m toward {side} chainage"
