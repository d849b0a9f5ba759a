"""Effect of a position report on the interval of its train, as pure functions.

`CHECKS` detect reports that contradict earlier reports; they cannot prove a report correct. Condition C12 of
``docs/safety.md`` excludes errors that these checks do not detect.

The safe rear end moves to a position that two consecutive reports confirm. Both reports must state that the train is
complete and has the configured length. A report that contradicts the record of its train stops this train and the
nearest trains on either side. After any contradiction, the interval is extended to the reported position, but no
farther than the train can have run.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

from railfix.ground.layout import Layout
from railfix.ground.state import ROUNDING_M, Interlocking, InterlockingLimits, TrainInterval, with_train
from railfix.io.train_message import MessageStatus, TrainMessage, Unknown

#: Largest difference between the reported and the configured train length that is attributed to rounding [m].
LENGTH_ROUNDING_M: Final = 0.02
#: With a higher reported speed, a reported standstill is a contradiction, and motion toward the rear end counts as
#: running backward [m/s].
STANDING_MPS: Final = 0.5
SPEED_ERROR_MPS: Final = 1.0  #: Largest assumed error of a reported speed.
#: A report with a larger sum of the over-reading and under-reading amounts counts as contradictory [m].
WIDEST_M: Final = 1000.0
#: When an interval is extended, a shorter time between two positions is replaced by this time [s], which also covers
#: the largest age of a position at sending.
INSTANT_S: Final = 5.0


def is_placed(message: TrainMessage) -> bool:
    """Return whether a report has a position with both bounds, and states which end of the train is the front."""
    known = None not in (message.chainage_cm, message.over_cm, message.under_cm)
    placed = message.status in (MessageStatus.POSITION, MessageStatus.COASTING)
    return known and placed and message.facing != 0 and Unknown.FRONT_END not in message.unknown


def is_newer(known: TrainInterval, message: TrainMessage) -> bool:
    """Return whether a report is from another session than the newest report, or has a higher sequence number."""
    return (message.session or 0) != known.session or message.sequence > known.sequence


def stands(message: TrainMessage) -> bool:
    """Return whether a report states standstill, with a speed of at most `STANDING_MPS`."""
    return message.standstill and abs(message.speed_cmps or 0) / 100.0 <= STANDING_MPS


def confirms_rear(known: TrainInterval, message: TrainMessage) -> bool:
    """Return whether a report may move the safe rear end, which requires that the train is complete and has its
    configured length.
    """
    return message.complete and abs(message.length_cm / 100.0 - known.length_m) <= LENGTH_ROUNDING_M


@dataclass(frozen=True, kw_only=True)
class PlacedReport:
    """Report with a position, and the centre's data on the train."""

    known: TrainInterval
    message: TrainMessage
    layout: Layout
    limits: InterlockingLimits
    granted: int  #: Number of the newest authority sent so far.
    skipped: tuple[int, int]  #: Authority numbers skipped at the start (`Interlocking.skipped`).
    #: Upper bound of the time from the previous position to this position [s]. It is negative if this position is
    #: older, and None if unknown, as at the first report.
    elapsed_s: float | None

    @property
    def front_m(self) -> float:
        """Reported chainage of the train's front end [m]."""
        return (self.message.chainage_cm or 0) / 100.0

    @property
    def over_m(self) -> float:
        """Over-reading amount: largest distance of the true front end behind the reported front end [m]."""
        return (self.message.over_cm or 0) / 100.0

    @property
    def under_m(self) -> float:
        """Under-reading amount: largest distance of the true front end ahead of the reported front end [m]."""
        return (self.message.under_cm or 0) / 100.0

    @property
    def speed_mps(self) -> float | None:
        """Reported speed [m/s]."""
        return None if self.message.speed_cmps is None else abs(self.message.speed_cmps) / 100.0

    @property
    def rear_m(self) -> float:
        """Safe rear end according to this report alone [m]."""
        return self.front_m - self.message.facing * (self.over_m + self.known.length_m)

    @property
    def ahead_m(self) -> float:
        """Safe front end according to this report alone [m]."""
        return self.front_m + self.message.facing * self.under_m

    @property
    def held_m(self) -> float | None:
        """End of the authority named by the report, limited to the line [m]; None if the report names none."""
        end_cm, stations = self.message.authority_end_cm, self.layout.stations
        return None if end_cm is None else min(max(end_cm / 100.0, stations[0].begin_m), stations[-1].end_m)

    @property
    def turns(self) -> bool:
        """Whether the direction of the train's front end has changed."""
        return self.message.facing != self.known.direction


def no_length(report: PlacedReport) -> str | None:
    """Return the reason for rejecting a report without a train length, None for other reports."""
    return "the report has no train length" if report.message.length_cm == 0 else None


def other_line(report: PlacedReport) -> str | None:
    """Return a contradiction if a report is from another line, otherwise None."""
    line, known = report.message.line, report.known.line
    return None if known in (None, line) else f"the report names line {line}, but the train is on line {known}"


def wide_bounds(report: PlacedReport) -> str | None:
    """Return a contradiction if the bounds of a position are too wide, otherwise None."""
    wide = report.over_m + report.under_m > WIDEST_M
    return f"the bounds of the position are wider than {WIDEST_M:g} m" if wide else None


def off_line(report: PlacedReport) -> str | None:
    """Return a contradiction if a position is off the line, otherwise None."""
    first, last = report.layout.stations[0].begin_m, report.layout.stations[-1].end_m
    on_line = first - report.over_m <= report.front_m <= last + report.under_m
    return None if on_line else f"the position is not on the line: {report.front_m:.0f} m"


def moving_standstill(report: PlacedReport) -> str | None:
    """Return a contradiction if a standstill is reported with a speed above `STANDING_MPS`, otherwise None."""
    moving = report.message.standstill and not stands(report.message)
    return f"the report states standstill and a speed of {report.speed_mps:.1f} m/s" if moving else None


def unknown_authority(report: PlacedReport) -> str | None:
    """Return a contradiction if the report names an authority that is not in the centre's database, otherwise None."""
    held, (last, first) = report.message.authority or 0, report.skipped
    if held <= report.granted and not last < held < first:
        return None
    newest = f"at the last start was {last}" if held < first else f"is {report.granted}"
    return f"the train has authority {held}, but the newest in the centre's database {newest}"


def wrong_turn(report: PlacedReport) -> str | None:
    """Return a contradiction if a train has changed ends while running or outside its interval, otherwise None."""
    if not report.turns:
        return None
    if not report.message.standstill:
        return "the train has changed ends while running"
    known, facing = report.known, report.message.facing
    if facing * report.front_m - report.over_m > facing * known.rear_m:
        return "the train has changed ends and is behind its interval"
    if facing * report.front_m + report.under_m - known.length_m < facing * known.interval_m[1]:
        return "the train has changed ends and is beyond its interval"
    return None


def holds_more(report: PlacedReport) -> str | None:
    """Return a contradiction if the train's authority ends beyond the train's interval, otherwise None.

    After a change of ends, the authority must not end beyond the reported position.
    """
    held, facing = report.held_m, report.message.facing
    if held is None:
        return None
    known_m, allowed_m = report.known.end_m, ROUNDING_M
    if report.turns:
        known_m, allowed_m = report.ahead_m, report.over_m + report.under_m
    beyond = facing * (held - known_m) > allowed_m
    return f"the train has an authority that ends beyond its interval, at {held:.0f} m" if beyond else None


def too_fast(report: PlacedReport) -> str | None:
    """Return a contradiction if the reported speed exceeds the highest speed of trains, otherwise None."""
    fast = report.speed_mps is not None and report.speed_mps > report.limits.speed_mps
    return f"the speed {report.speed_mps:.0f} m/s is above {report.limits.speed_mps:g} m/s" if fast else None


def older_place(report: PlacedReport) -> str | None:
    """Return a contradiction if the reported position is older than the previous one, otherwise None."""
    older = report.elapsed_s is not None and report.elapsed_s < 0.0
    return "the position is older than in the previous report" if older else None


def longest_way_m(before: float | None, now: float | None, elapsed_s: float, limits: InterlockingLimits) -> float:
    """Return the longest distance [m] that a train can have run in `elapsed_s`, given its speeds before and after."""
    top = limits.speed_mps
    if before is not None and now is not None:
        # highest speed between the two reports: the higher reported speed, plus the largest error of a reported speed,
        # plus the acceleration over half of the time
        top = min(top, max(before, now) + SPEED_ERROR_MPS + 0.5 * limits.acceleration_mps2 * elapsed_s)
    return top * elapsed_s


def impossible_way(report: PlacedReport) -> str | None:
    """Return a contradiction if no train can have run the distance since the previous position, otherwise None."""
    known, elapsed = report.known, report.elapsed_s
    if report.turns:
        return None
    # Before the first report, the train is at rest; after a restart on board, it may be anywhere in its interval.
    if elapsed is None:
        end = known.front_m if known.reported_m is None else known.interval_m[1]
        way = known.direction * (report.front_m - end) - report.over_m
        return f"the train is {way:.0f} m or more ahead of its recorded position or interval" if way > 0.0 else None
    way = known.direction * (report.front_m - known.front_m) - report.over_m
    if way > longest_way_m(known.speed_mps, report.speed_mps, max(elapsed, 0.0), report.limits):
        return f"the train has moved {way:.0f} m or more in {elapsed:.1f} s"
    return None


def beyond_authority(report: PlacedReport) -> str | None:
    """Return a contradiction if a position is beyond the authority, otherwise None."""
    beyond = report.known.direction * (report.front_m - report.known.end_m) - report.over_m
    return "the train is beyond its authority" if not report.turns and beyond > 0.0 else None


def rolled_back(report: PlacedReport) -> str | None:
    """Return a contradiction if a position is behind the interval, otherwise None."""
    ahead = report.known.direction * (report.front_m - report.known.rear_m) + report.under_m
    return "the train has rolled back" if not report.turns and ahead < report.known.length_m else None


def runs_backward(report: PlacedReport) -> str | None:
    """Return a contradiction if a train runs in the direction of its rear end, otherwise None."""
    message, speed = report.message, report.speed_mps
    backward = message.direction == -report.known.direction and (speed is None or speed > STANDING_MPS)
    return "the train runs backward" if backward and not message.standstill and not report.turns else None


Check = Callable[[PlacedReport], str | None]
#: Checks of a report for contradictions, in the order in which they are made.
CHECKS: tuple[Check, ...] = (
    no_length, other_line, wide_bounds, off_line, moving_standstill, unknown_authority, wrong_turn, holds_more,
    too_fast, older_place, impossible_way, beyond_authority, rolled_back, runs_backward,
)  # fmt: skip


def compute_contradiction(report: PlacedReport) -> str | None:
    """Return the first contradiction of a report with a position, None if there is none."""
    return next((reason for check in CHECKS if (reason := check(report)) is not None), None)


def covered_m(report: PlacedReport) -> tuple[float, float]:
    """Return the rear end and the front end of a train's interval, extended to the reported position [m].

    The extension is limited by the distance that the train can have run, and by the line.
    """
    known, d = report.known, report.known.direction
    reach = math.inf if report.elapsed_s is None else max(report.elapsed_s, INSTANT_S) * report.limits.speed_mps
    over, under = min(report.over_m, WIDEST_M), min(report.under_m, WIDEST_M)
    facing = report.message.facing
    ends = d * (report.front_m - facing * (over + known.length_m)), d * (report.front_m + facing * under)
    first, last = sorted(d * end for end in (report.layout.stations[0].begin_m, report.layout.stations[-1].end_m))
    back = max(min(ends), d * known.rear_m - reach, first)
    front = min(max(ends), d * known.interval_m[1] + reach, last)
    return d * min(back, d * known.rear_m), d * max(front, d * known.front_m)


def _noted(report: PlacedReport, **interval: Any) -> TrainInterval:
    """Return the train's record with the data of a report, even if contradictory, and the fields in `interval`."""
    message = report.message
    low, high = sorted((report.rear_m, report.ahead_m))
    noted: dict[str, Any] = {
        "session": message.session or 0,
        "sequence": message.sequence,
        "standstill": stands(message),
        "measured_ns": message.time_ns,
        "speed_mps": report.speed_mps,
        "reported_m": (low, high),
        "claimed_m": None,
        "contradiction": None,
        "held_end_m": report.held_m,
        "runs_by": _runs_by(report),
    }
    return report.known.changed(**{**noted, **interval})


def _runs_by(report: PlacedReport) -> int | None:
    """Return the new value of `TrainInterval.runs_by` after a report."""
    newest = max((n for n in (report.known.runs_by, report.message.authority) if n is not None), default=None)
    order = report.message.brake_order
    return None if newest is None or (order is not None and order >= newest) else newest


def stop_contradicted(report: PlacedReport, reason: str) -> TrainInterval:
    """Return the record with the train stopped, and the interval extended to the reported position and authority."""
    (rear, front), d, noted = covered_m(report), report.known.direction, _noted(report)
    held = noted.end_m if report.held_m is None else report.held_m
    end, rear = d * max(d * noted.end_m, d * held), d * min(d * rear, d * held) if report.turns else rear
    return replace(noted, stop=noted.stop or reason, contradiction=reason, end_m=end, rear_m=rear, front_m=front)


def report_received(
    state: Interlocking,
    message: TrainMessage,
    layout: Layout,
    *,
    limits: InterlockingLimits | None = None,
    elapsed_s: float | None = None,
) -> Interlocking:
    """Return the state after a position report.

    A change of ends is accepted only at standstill inside the train's station; afterwards the interval still includes
    the earlier position. A report that contradicts the train's record stops the train, and can only extend the
    interval. Reports without a position, and reports older than the newest, have no effect. `elapsed_s` is an upper
    bound of the time since the previous position by the centre's clock, None if unknown.
    """
    before = state.trains.get(message.train)
    if before is None or not is_placed(message) or not is_newer(before, message):
        return state
    report = PlacedReport(
        known=before,
        message=message,
        layout=layout,
        limits=limits or InterlockingLimits(),
        granted=state.granted,
        skipped=state.skipped,
        elapsed_s=_elapsed_s(before, message, elapsed_s),
    )
    contradiction = compute_contradiction(report)
    if contradiction is not None:
        return _with_granted(with_train(state, stop_contradicted(report, contradiction)), message)
    confirmed, facing = confirms_rear(before, message), message.facing
    rear, ahead = report.rear_m, report.ahead_m
    if report.turns and not (confirmed and layout.station_at(*sorted((rear, ahead))) == before.station):
        return with_train(state, _noted(report))
    known: dict[str, Any] = {"line": message.line, "claimed_m": rear if confirmed else None}
    if report.turns:
        return with_train(state, _turn(_noted(report, **known), facing, rear, ahead, layout))
    if confirmed and before.claimed_m is not None and before.stop is None:
        agreed = agreed_rear(facing, rear, before.claimed_m)
        known["rear_m"] = facing * furthest(facing, agreed, before.rear_m)
    # the interval of a stopped train only grows
    known["front_m"] = ahead if before.stop is None else facing * max(facing * ahead, facing * before.front_m)
    return with_train(state, _noted(report, **known))


def agreed_rear(facing: int, rear_m: float, claimed_m: float) -> float:
    """Return the rear end that two consecutive reports confirm, as a distance in running direction [m]."""
    return min(facing * rear_m, facing * claimed_m)


def furthest(facing: int, agreed_m: float, known_m: float) -> float:
    """Return the foremost of two rear ends as a distance in running direction [m]; the rear end never moves back."""
    return max(agreed_m, facing * known_m)


def _elapsed_s(known: TrainInterval, message: TrainMessage, by_centre_s: float | None) -> float | None:
    """Return an upper bound of the time since the previous position, by the clocks of train and centre [s]."""
    if known.measured_ns is None or (message.session or 0) != known.session:
        return by_centre_s
    by_train_s = (message.time_ns - known.measured_ns) / 1e9
    # the centre's clock limits the time, so that a train's clock that was set forward does not permit a longer distance
    return by_train_s if by_centre_s is None or by_train_s < 0.0 else max(min(by_train_s, by_centre_s), 0.0)


#: The numbers of later authorities do not continue from a reported number that is this value or higher.
_MOST_NUMBERS: Final = 1 << 62


def _with_granted(state: Interlocking, message: TrainMessage) -> Interlocking:
    """Return a state in which the next authorities have higher numbers than the authority named by a report."""
    held = message.authority or 0
    return replace(state, granted=held) if state.granted < held < _MOST_NUMBERS else state


def _turn(known: TrainInterval, facing: int, rear: float, ahead: float, layout: Layout) -> TrainInterval:
    """Return a train's record after a change of ends; the interval covers the earlier position and authority."""
    held = ahead if known.held_end_m is None else known.held_end_m
    covered = facing * max(facing * ahead, facing * known.rear_m)
    back = facing * min(facing * rear, facing * known.front_m, facing * held)
    under = {known.station, *layout.stations_between(*sorted((back, covered)))}
    return replace(
        known,
        direction=facing,
        rear_m=back,
        front_m=covered,
        end_m=facing * max(facing * ahead, facing * held),
        tracks={station: track for station, track in known.tracks.items() if station in under},
        asked_m=None,
    )
