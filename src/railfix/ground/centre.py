"""State and displayed position of each train, as the control centre records them; the display is not a safety function.

A pure state machine (P5 3.1): `report_received` and `time_passed` take the record of a train and return the new record.
The displayed position is indicative only; a train occupies the interval from its last safe rear end to the end of the
authority (`railfix.ground.interlocking`).

A reference run curve is a train's position over running time in one direction. With this curve, the centre simulates
the running of a train that has stopped reporting.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, Self

import numpy as np
from pydantic import Field, model_validator

from railfix.core.arrays import Floats, copy_with, freeze_arrays
from railfix.core.settings import Settings
from railfix.io.train_message import MessageStatus, TrainMessage, Unknown

#: `_RUN_MPS2`: acceleration of the reference run curve [m/s^2]. `_AT_STATION_M`: distance from a stopping position
#: within which a train counts as at the station [m].
_RUN_MPS2, _AT_STATION_M = 0.5, 25.0


@dataclass(frozen=True, kw_only=True)
class ReferenceCurve:
    """Reference run curve of one running direction."""

    direction: int  #: Running direction: 1 toward rising chainage, -1 toward falling.
    running_s: Floats  #: Running time without the dwell times at stations, strictly rising; shape (N,).
    chainage_m: Floats  #: Chainage of the front end, strictly rising or, with direction -1, falling; shape (N,).
    stations_m: Floats  #: Stopping positions of the front, in the order of the run; shape (K,).

    def __post_init__(self) -> None:
        freeze_arrays(self)
        ahead = self.direction * np.diff(self.chainage_m)
        if self.direction not in (-1, 1) or len(ahead) < 1 or not (ahead > 0).all():
            raise ValueError("chainage_m must rise strictly in the direction of the run, and direction must be -1 or 1")
        if not (np.diff(self.running_s) > 0).all():
            raise ValueError("running_s must rise strictly")

    @classmethod
    def between_stations(cls, stations_m: Floats, *, speed_mps: float) -> Self:
        """Return the curve of a run that starts and stops at each station with constant acceleration.

        `stations_m`, shape (K,), are in the order of the run. Between stations that are close together, the train does
        not reach `speed_mps`.
        """
        direction = 1 if stations_m[-1] > stations_m[0] else -1
        time, place, start = [np.zeros(1)], [stations_m[:1]], 0.0
        for origin, way in zip(stations_m[:-1], np.abs(np.diff(stations_m)), strict=True):
            peak = min(speed_mps, float(np.sqrt(_RUN_MPS2 * way)))
            ramp = peak / _RUN_MPS2
            total = ramp + way / peak
            t = np.append(np.arange(1.0, total - 0.5), total)
            covered = np.select(
                [t < ramp, t < total - ramp],
                [0.5 * _RUN_MPS2 * t**2, peak * (t - 0.5 * ramp)],
                way - 0.5 * _RUN_MPS2 * (total - t) ** 2,
            )
            time.append(start + t)
            place.append(origin + direction * covered)
            start += total
        return cls(
            direction=direction, running_s=np.concatenate(time), chainage_m=np.concatenate(place), stations_m=stations_m
        )

    def running_m(self, from_m: float, elapsed_s: float) -> float:
        """Return a train's position [m] `elapsed_s` after it was at `from_m`; the train stops at the next station."""
        at = np.interp(self.direction * from_m, self.direction * self.chainage_m, self.running_s)
        place = float(np.interp(at + max(elapsed_s, 0.0), self.running_s, self.chainage_m))
        ahead = self.direction * (self.stations_m - from_m)
        left = ahead[ahead > 1.0]
        limit = float(left.min()) if len(left) else 0.0
        return from_m + self.direction * min(max(self.direction * (place - from_m), 0.0), limit)

    def station_at(self, chainage_m: float) -> int | None:
        """Return the number of the station at a position, None between stations."""
        distance = np.abs(self.stations_m - chainage_m)
        nearest = int(distance.argmin())
        return nearest if distance[nearest] <= _AT_STATION_M else None

    def progress(self, chainage_m: float) -> tuple[int, float]:
        """Return the number of the station at which a section begins, and the progress in this section [%].

        Stations are numbered in running direction.

        In P5 3.1, a train at a station reports the station, and other trains report their section and progress.
        """
        along = self.direction * self.stations_m
        section = int(np.clip(np.searchsorted(along, self.direction * chainage_m, side="right") - 1, 0, len(along) - 2))
        share = (self.direction * chainage_m - along[section]) / (along[section + 1] - along[section])
        return section, float(np.clip(100.0 * share, 0.0, 100.0))


class TrainState(Enum):
    """State of a train in the centre."""

    #: No accepted report since the centre was started.
    UNKNOWN = "unknown"
    #: Reports are accepted.
    TRACKED = "tracked"
    #: No accepted report for `lost_s`: the displayed position is simulated on the reference run curve.
    SIMULATED = "simulated"
    #: No accepted report for `error_s`, or the simulated position has reached the end of the authority.
    ERROR = "error"


class CentreLimits(Settings):
    """Limits for the reports of trains."""

    #: Time without an accepted report after which the displayed position is simulated.
    lost_s: float = Field(default=3.0, gt=0)
    error_s: float = Field(default=120.0, gt=0)  #: Time without an accepted report after which a train is in error.
    age_s: float = Field(default=5.0, gt=0)  #: Largest age of a position when it is sent; older positions are rejected.
    #: A position is rejected if its time is ahead of the train's own clock by more than this. As this lead may vary,
    #: the centre adds this value to the time between two positions when it checks the distance run.
    clock_s: float = Field(default=1.0, ge=0)
    #: A report is rejected if its sequence number exceeds the newest number by more than `jump`, plus `rate` for each
    #: second since the newest number arrived.
    jump: int = Field(default=1000, ge=1)
    #: Highest assumed rate at which a train numbers its reports [1/s]; used with `jump`.
    rate: float = Field(default=20.0, gt=0)

    @model_validator(mode="after")
    def _lost_before_error(self) -> Self:
        if self.error_s <= self.lost_s:
            raise ValueError("error_s must be longer than lost_s")
        return self


@dataclass(frozen=True, kw_only=True)
class TrainRecord:
    """The centre's record of a train."""

    train: int
    state: TrainState = TrainState.UNKNOWN
    sequence: int = -1  #: Newest sequence number received, -1 before the first.
    session: int = 0  #: Identifier of the session of `sequence`, drawn by the on-board unit at each start.
    retired: tuple[int, ...] = ()  #: Identifiers of earlier sessions, whose late messages are rejected.
    counted_s: float | None = None  #: Time on the centre's clock when the newest sequence number arrived [s].
    rejected: str | None = None  #: Reason why the newest report was rejected, None if it was accepted.
    message: TrainMessage | None = None  #: Newest accepted report; None before the first.
    heard_s: float = 0.0  #: Time on the centre's clock (monotonic) when `message` arrived [s].
    measured_s: float = 0.0  #: Time on the centre's clock for which the position of `message` is valid [s].
    shown_m: float | None = None  #: Displayed position of the front end [m].
    #: Latest jump of the displayed position from simulated to reported, positive in running direction [m].
    jump_m: float | None = None


class Rejection(Enum):
    """Reason for rejecting a report."""

    UNKNOWN_TRAIN = "of a train that is not supervised"
    OTHER_TRAIN = "of another train"
    REPEATED = "repeated or older than the newest"
    EARLIER_START = "sent before the on-board unit was restarted"
    FAR_AHEAD = "sequence number higher than the train can have reached; restart the on-board unit"
    NO_PLACE = "without a position"
    NO_FACING = "the direction of the front end is unknown"
    NO_FRONT_END = "the position of the front end is unknown"
    TOO_OLD = "position too old when it was sent, or its time is ahead of the train's clock; set the train's clock"


#: Number of earlier sessions of the on-board unit whose identifiers are stored, to reject late reports.
_RETIRED = 16


def report_received(
    record: TrainRecord, message: TrainMessage, now_s: float, *, limits: CentreLimits
) -> tuple[TrainRecord, Rejection | None]:
    """Return the record after a report, and the reason for rejecting the report, None if it is accepted.

    The time of the measurement is the time of arrival minus the age of the position. The age is computed with the
    train's own clock, so that the clocks of train and centre need not be synchronised. The unknown delay of the link is
    neglected.
    """
    if message.train != record.train:
        return record, Rejection.OTHER_TRAIN
    session, sequence, retired, counted_s = message.session or 0, record.sequence, record.retired, record.counted_s
    if session != record.session:
        if session in retired:
            return record, Rejection.EARLIER_START
        if sequence >= 0:
            retired = *retired[1 - _RETIRED :], record.session
        sequence, counted_s = -1, None
    if message.sequence <= sequence:
        return record, Rejection.REPEATED
    if counted_s is not None and message.sequence > sequence + limits.jump + limits.rate * (now_s - counted_s):
        return replace(record, rejected=Rejection.FAR_AHEAD.value), Rejection.FAR_AHEAD
    counted: dict[str, Any] = {
        "session": session, "sequence": message.sequence, "retired": retired, "counted_s": now_s
    }  # fmt: skip
    age_ns = message.sent_ns - message.time_ns
    reason = None
    if message.status not in (MessageStatus.POSITION, MessageStatus.COASTING):
        reason = Rejection.NO_PLACE
    elif message.facing == 0:
        reason = Rejection.NO_FACING
    elif Unknown.FRONT_END in message.unknown:
        reason = Rejection.NO_FRONT_END
    elif not -limits.clock_s * 1e9 <= age_ns <= limits.age_s * 1e9:
        reason = Rejection.TOO_OLD
    if reason is not None:
        return replace(record, **counted, rejected=reason.value), reason
    assert message.chainage_cm is not None
    place, jump = message.chainage_cm / 100.0, record.jump_m
    if record.state in (TrainState.SIMULATED, TrainState.ERROR) and record.shown_m is not None:
        jump = message.facing * (place - record.shown_m)
    after = copy_with(
        record, **counted, rejected=None, state=TrainState.TRACKED, message=message, heard_s=now_s,
        measured_s=now_s - max(age_ns, 0) / 1e9, shown_m=place, jump_m=jump,
    )  # fmt: skip
    return after, None


def time_passed(
    record: TrainRecord,
    now_s: float,
    *,
    curves: dict[int, ReferenceCurve],
    authority_m: float | None = None,
    limits: CentreLimits,
) -> TrainRecord:
    """Return the record at a later instant; without reports, the record has a new state and a simulated position.

    Parameters
    ----------
    record : TrainRecord
    now_s : float [s]
        Centre's clock.
    curves : dict of int to ReferenceCurve
        Reference run curves by running direction.
    authority_m : float, optional [m]
        End of the train's authority. When the simulated position reaches this end, the train is in error.
    limits : CentreLimits
    """
    if record.message is None or record.state is TrainState.UNKNOWN or record.message.chainage_cm is None:
        return record
    silent = now_s - record.heard_s
    if silent <= limits.lost_s or record.state is TrainState.ERROR:
        return record
    facing, last = record.message.facing, record.message.chainage_cm / 100.0
    place = last
    if (curve := curves.get(facing)) is not None:
        place = curve.running_m(last, now_s - record.measured_s)
    at_end = authority_m is not None and facing * (authority_m - place) <= 0.0
    if at_end and authority_m is not None:
        place = authority_m if facing * (authority_m - last) > 0.0 else last
    error = at_end or silent > limits.error_s
    return replace(record, state=TrainState.ERROR if error else TrainState.SIMULATED, shown_m=place)
