"""On-board supervision of a train: age and end of the movement authority, braking curve, and orders to brake."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Final

from pydantic import Field

from railfix.core.options import option
from railfix.ground.authority import Authority, BrakeOrder
from railfix.ground.braking import BrakeLimits, Steps, Supervised, stopping_m, supervise
from railfix.ground.links import LinkMode
from railfix.ground.positions import Clock

#: A train has rolled back if its safe front end moves back by more than this, which exceeds position errors [m].
ROLLED_M: Final = 50.0
#: Number of newest reports for which the time of sending is stored.
REMEMBERED: Final = 600
REPORT_S: Final = 1.0  #: Time between two reports [s].
#: Upper limit of `fresh_s` [s]. An authority is rejected if the report that it answers is older than the newest report
#: by more than this.
LONGEST_FRESH_S: Final = 45.0


class OnBoardLimits(BrakeLimits):
    """Limits of the on-board supervision."""

    #: The train brakes if its newest authority is older than this, counted from the sending of the answered report.
    fresh_s: float = option(
        "Largest age of the newest authority; the train brakes if the authority is older.",
        15.0,
        name="--fresh",
        metavar="S",
        gt=0,
        le=LONGEST_FRESH_S,
    )
    #: The train brakes if its newest position is older than this. Until then, the last position is extrapolated at the
    #: train's highest possible speed.
    placeless_s: float = Field(default=5.0, ge=0)
    clock: Clock = option(
        "Report positions from a recording with the present time, at the recorded pace.", "live", name="--replay"
    )
    mode: LinkMode = option("Send reports over bearer A alone, and over B while A fails.", "both", name="--spare")


@dataclass(kw_only=True)
class Motion:
    """Newest position of a train: safe front and rear ends, highest possible speed, and time if known."""

    front_m: float
    rear_m: float
    speed_mps: float
    at_s: float | None


@dataclass(kw_only=True)
class OnBoard:
    """On-board supervision of a train by its movement authority.

    The age of an authority is the time since the train sent the report that the authority answers, measured with the
    train's monotonic clock. Delays on the links cannot make this age too small, and the clocks of train and centre need
    not be synchronised.
    """

    direction: int
    #: End of the authority, initially the front end. Authorities move this end forward. An authority with which the
    #: centre requests an earlier end moves the end back if the train can stop before the earlier end.
    end_m: float

    limits: OnBoardLimits = field(default_factory=OnBoardLimits)
    #: Session identifier in the reports, drawn at each start. Authorities that answer a report of another session are
    #: rejected.
    session: int = 0
    number: int = -1  #: Number of the newest authority, -1 before the first.
    stopped: bool = False  #: Whether the newest authority contains an order to stop.
    order: BrakeOrder | None = None  #: Order to brake that the train obeys, if any.
    authority: Authority | None = None  #: Newest authority.
    #: Position at which the train's safe front end would stop if the train braked now: the farther of the results for
    #: the last two positions. With None, the train does not accept an earlier end.
    stops_at_m: float | None = None
    answered_s: float | None = None  #: Time at which the newest answered report was sent; None before the first answer.
    #: Number of the newest report sent before the last change of ends, or before the train rolled back. Authorities
    #: that answer this or an older report are rejected.
    before_turn: int = -1

    _newest: int = -1
    _granted: bool = False
    _place_m: float | None = None
    _motion: Motion | None = None
    _sent: OrderedDict[int, float] = field(default_factory=OrderedDict)

    def note_report(self, sequence: int, now_s: float) -> None:
        """Record a report that is sent."""
        self._sent[sequence] = now_s
        self._newest = sequence
        if len(self._sent) > REMEMBERED:
            self._sent.popitem(last=False)

    def note_position(
        self,
        safe_front_m: float | None,
        speed_mps: float | None,
        *,
        speed_bound_mps: float = 0.0,
        safe_rear_m: float | None = None,
        now_s: float | None = None,
    ) -> None:
        """Store the train's safe ends and speed.

        The train accepts an earlier end only if both of its last two stopping positions are before this end, so that a
        single wrong position does not suffice.

        A train that has rolled back brakes until it gets a new authority, because earlier authorities do not cover its
        new position. If position or speed is None, the last position is extrapolated.
        """
        before, self._place_m, self.stops_at_m = self._place_m, None, None
        if safe_front_m is None:
            return
        if self._motion is not None and self.direction * (safe_front_m - self._motion.front_m) < -ROLLED_M:
            self.before_turn, self._granted, self.answered_s = self._newest - 1, False, None
        if speed_mps is None:
            return
        self._motion = Motion(
            front_m=safe_front_m,
            rear_m=safe_front_m if safe_rear_m is None else safe_rear_m,
            speed_mps=speed_mps + speed_bound_mps if speed_mps > 0.0 else 0.0,
            at_s=now_s,
        )
        if self.order is not None and speed_mps == 0.0:
            self._withdraw(safe_front_m)
        d, way = self.direction, self._motion.speed_mps * REPORT_S
        self._place_m = d * stopping_m(d * safe_front_m + way, self._motion.speed_mps, self._steps(), self.limits)
        self.stops_at_m = self._further(before, self._place_m)

    def _further(self, before_m: float | None, now_m: float) -> float | None:
        """Return the farther of two positions in running direction [m], None if `before_m` is None."""
        return None if before_m is None else self.direction * max(self.direction * now_m, self.direction * before_m)

    def _withdraw(self, front_m: float) -> None:
        """End the authority at the front end; a train stopped by order gets a new authority when it is released."""
        self.end_m = self.direction * min(self.direction * self.end_m, self.direction * front_m)
        self._granted = False

    def receive(self, authority: Authority) -> bool:
        """Process an authority; return whether it is accepted.

        An authority must be newer than the last accepted authority, and apply to the train's direction. An authority
        that answers a report sent before the last change of ends is rejected even if its direction is right, because it
        may have been granted two changes of ends ago. An authority that has lapsed in transit is rejected. An order to
        brake is always accepted; a late order applies until the next authority.
        """
        if isinstance(authority, BrakeOrder):
            # an order may have a lower number than the authority if the centre's database is an older copy
            if self.order is None or authority.number >= self.order.number:
                self.order = authority
            return True
        if authority.number <= self.number or authority.direction != self.direction or not self._answers(authority):
            return False
        if self.order is not None and not self._ends_order(authority):
            return False
        end, held = self.direction * authority.end_cm / 100.0, self.direction * self.end_m
        agrees = self.stops_at_m is not None and self.direction * self.stops_at_m <= end
        if not self._may_take(authority, agrees=agrees):
            return False
        if authority.shortens and (self._granted or authority.stopped):
            self.end_m = self.direction * min(end, held) if agrees else self.end_m
        elif not authority.stopped:  # an authority with an order to stop does not extend the end
            self.end_m, self._granted = self.direction * (end if self._begins() else max(end, held)), True
        self.number, self.stopped, self.authority = authority.number, authority.stopped, authority
        self.order = None
        if (sent_s := self._sent.get(authority.report)) is not None:
            self.answered_s = sent_s
        return True

    def _ends_order(self, authority: Authority) -> bool:
        """Return whether an authority ends the order to brake.

        If the order continues, this method only updates the time at which the answered report was sent.
        """
        assert self.order is not None
        if authority.number > self.order.number and not authority.stopped:
            return True
        if authority.number > self.number and (sent_s := self._sent.get(authority.report)) is not None:
            self.answered_s = sent_s
        return False

    def _answers(self, authority: Authority) -> bool:
        """Return whether an authority answers a recent report, sent after the start and the last change of ends."""
        if authority.session != self.session or authority.report <= self.before_turn:
            return False
        if len(self._sent) == REMEMBERED and authority.report < next(iter(self._sent)):
            return False
        sent_s = self._sent.get(authority.report, math.inf)
        return self._sent.get(self._newest, -math.inf) - sent_s <= LONGEST_FRESH_S

    def _begins(self) -> bool:
        """Return whether an authority is the first since the start, a change of ends or an order to brake."""
        return not self._granted

    def _may_take(self, authority: Authority, *, agrees: bool) -> bool:
        """Return whether an authority may be accepted.

        A train without an authority accepts an earlier end only if it can stop before this end (`agrees`), and brakes
        until then. A train with an authority always accepts the message, but moves its end back only with `agrees`.
        """
        return not authority.shortens or agrees or self._granted

    def acknowledgement(self) -> dict[str, int]:
        """Return a report's fields that acknowledge the newest authority and the order to brake, if there are any."""
        order = {} if self.order is None else {"brake_order": self.order.number}
        if self.number < 0:
            return order
        end_cm = self.direction * math.ceil(self.direction * self.end_m * 100.0)
        return {"authority": self.number, "authority_end_cm": end_cm, **order}

    def age_s(self, now_s: float) -> float:
        """Return the largest possible age of the newest authority [s]; infinite before the first authority."""
        return float("inf") if self.answered_s is None else now_s - self.answered_s

    def _steps(self) -> Steps:
        """Return the gradients of the authority in running direction."""
        parts = () if self.authority is None else self.authority.gradients
        if self.direction > 0:
            return Steps([c / 100.0 for c, _ in parts], [p / 1000.0 for _, p in parts])
        # in the direction of falling chainage, a gradient begins at the chainage of the next gradient and ends at its
        # own chainage; the line is level below the first chainage
        ends = [-c / 100.0 for c, _ in parts[::-1]]
        return Steps([-math.inf, *ends], [*(-p / 1000.0 for _, p in parts[::-1]), 0.0])

    def supervised(self, now_s: float | None = None) -> Supervised | None:
        """Return the supervised speeds of the train, None before its first position.

        The front end is extrapolated from the time of the newest position to `now_s`, if both are known.
        """
        if (motion := self._motion) is None:
            return None
        d, restrictions = self.direction, () if self.authority is None else self.authority.restrictions
        parts = [
            (min(d * low, d * high) / 100.0, max(d * low, d * high) / 100.0, cmps / 100.0)
            for low, high, cmps in restrictions
        ]
        return supervise(
            d * motion.front_m + self._carried_m(now_s),
            d * motion.rear_m,
            end_m=d * self.end_m,
            overlap_m=0.0 if self.authority is None else self.authority.overlap_cm / 100.0,
            restrictions=parts,
            steps=self._steps(),
            brakes=self.limits,
        )

    def _carried_m(self, now_s: float | None) -> float:
        """Return the largest distance that the train can have run since its newest position [m]."""
        motion = self._motion
        if motion is None or motion.at_s is None or now_s is None:
            return 0.0
        return motion.speed_mps * max(now_s - motion.at_s, 0.0)

    def brake_reason(self, now_s: float) -> str | None:
        """Return the reason why the train brakes, or None if it need not brake."""
        if self.order is not None:
            return f"ordered to stop: {self.order.reason}" if self.order.reason else "ordered to stop"
        if self.stopped:
            return "ordered to stop"
        return self.stale_reason(now_s) or self.curve_reason(now_s)

    def stale_reason(self, now_s: float) -> str | None:
        """Return the reason why the train brakes if the authority or the position is too old, otherwise None."""
        if self.age_s(now_s) > self.limits.fresh_s:
            return "no fresh authority"
        at_s = None if self._motion is None else self._motion.at_s
        return "no position" if at_s is not None and now_s - at_s > self.limits.placeless_s else None

    def curve_reason(self, now_s: float) -> str | None:
        """Return the reason for braking if the train exceeds its braking curve, otherwise None."""
        found, motion = self.supervised(now_s), self._motion
        if found is None or motion is None or motion.speed_mps <= found.intervention_mps:
            return None
        d = self.direction
        place = d * motion.front_m + self._carried_m(now_s)
        over = stopping_m(place, motion.speed_mps, self._steps(), self.limits) - d * self.end_m
        overruns = f"; it would stop {over:.0f} m beyond its authority" if over > 0.0 else ""
        target = f"{found.target.speed_mps:.1f} m/s at {d * found.target.at_m:.0f} m"
        return f"{motion.speed_mps:.1f} m/s exceeds {found.intervention_mps:.1f} m/s, the limit for {target}{overruns}"

    def turn(self, direction: int, front_m: float) -> None:
        """Change the running direction after the driver has changed ends; the train then has no authority."""
        self.direction, self.end_m, self.before_turn = direction, front_m, self._newest
        self._granted, self.answered_s, self._place_m, self.stops_at_m = False, None, None, None
        self._motion, self.authority = None, None
