"""Control centre: state and shown place of each train from its reports; a display, not a safety function.

A pure state machine (P5 3.1): `report_received` and `time_passed` take the record of a train and return the new one.
The shown place is for the eye alone; occupied is the interval from the last safe rear end to the end of the authority
(`railfix.ground.interlocking`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Self

from pydantic import Field, model_validator

from railfix.core.settings import Settings
from railfix.ground.reference_curve import ReferenceCurve
from railfix.io.train_message import MessageStatus, TrainMessage


class TrainState(Enum):
    """State of a train as the centre knows it."""

    #: No report with a place since the centre was started.
    UNKNOWN = "unknown"
    #: Reports come in.
    TRACKED = "tracked"
    #: No report: shown by simulated running on the reference run curve.
    SIMULATED = "simulated"
    #: No report for too long, or the simulated place has reached the end of the authority.
    ERROR = "error"


class CentreLimits(Settings):
    """Times of the centre."""

    #: After this time without a report the train is shown by simulated running.
    lost_s: float = Field(default=3.0, gt=0)
    error_s: float = Field(default=120.0, gt=0)  #: After this time without a report the train is in error.
    age_s: float = Field(default=5.0, gt=0)  #: Largest age of a position when it was sent; older reports are rejected.
    #: A sequence number further ahead of the newest counts once the next report goes on from there: one wrong number
    #: does not make all later ones old.
    jump: int = Field(default=1000, ge=1)

    @model_validator(mode="after")
    def _lost_before_error(self) -> Self:
        if self.error_s <= self.lost_s:
            raise ValueError("error_s is longer than lost_s")
        return self


@dataclass(frozen=True, kw_only=True)
class TrainRecord:
    """What the centre knows of a train."""

    train: int
    state: TrainState = TrainState.UNKNOWN
    sequence: int = -1  #: Newest sequence number received, -1 without one.
    ahead: int = -1  #: Number far ahead of it that the next report has to confirm, -1 without one.
    message: TrainMessage | None = None  #: Newest report with a place.
    heard_s: float = 0.0  #: Centre's clock (monotonic) when that report came in.
    measured_s: float = 0.0  #: Centre's clock at the instant its place is valid at.
    shown_m: float | None = None  #: Place of the front that is shown.
    #: Reported less simulated place at the last resynchronisation, positive in running direction.
    jump_m: float | None = None
    departure_s: float | None = None  #: Booked departure from the station, centre's clock.


class Rejection(Enum):
    """Reason of a report that changes nothing."""

    UNKNOWN_TRAIN = "of a train that is not supervised"
    OTHER_TRAIN = "of another train"
    REPEATED = "repeated or older than the newest"
    FAR_AHEAD = "number far ahead of the newest, to be confirmed by the next"
    NO_PLACE = "without a place"
    TOO_OLD = "place too old when it was sent, or the train's clock was stepped"


def rejection(record: TrainRecord, message: TrainMessage, *, limits: CentreLimits) -> Rejection | None:
    """Return why a report does not count, None where it does."""
    if message.train != record.train:
        return Rejection.OTHER_TRAIN
    if message.sequence <= record.sequence:
        return Rejection.REPEATED
    far = record.sequence >= 0 and message.sequence > record.sequence + limits.jump
    if far and not 0 <= record.ahead < message.sequence <= record.ahead + limits.jump:
        return Rejection.FAR_AHEAD
    if message.status not in (MessageStatus.POSITION, MessageStatus.COASTING) or message.facing == 0:
        return Rejection.NO_PLACE
    if not 0 <= message.sent_ns - message.time_ns <= limits.age_s * 1e9:
        return Rejection.TOO_OLD
    return None


def report_received(
    record: TrainRecord, message: TrainMessage, now_s: float, *, limits: CentreLimits
) -> tuple[TrainRecord, Rejection | None]:
    """Return the record after a report, and the reason where the report does not count.

    The instant of the measurement follows from the age that the train gives (both times by its own clock), so that
    clocks of train and centre need not agree; the delay of the link, which is unknown, is neglected.
    """
    reason = rejection(record, message, limits=limits)
    if reason in (Rejection.OTHER_TRAIN, Rejection.REPEATED):
        return record, reason
    if reason is Rejection.FAR_AHEAD:
        return replace(record, ahead=message.sequence), reason
    record = replace(record, ahead=-1)
    if reason is not None:
        return replace(record, sequence=message.sequence), reason
    assert message.chainage_cm is not None
    place = message.chainage_cm / 100.0
    simulated = record.state in (TrainState.SIMULATED, TrainState.ERROR) and record.shown_m is not None
    jump = message.facing * (place - record.shown_m) if simulated and record.shown_m is not None else record.jump_m
    after = replace(
        record,
        state=TrainState.TRACKED,
        sequence=message.sequence,
        message=message,
        heard_s=now_s,
        measured_s=now_s - (message.sent_ns - message.time_ns) / 1e9,
        shown_m=place,
        jump_m=jump,
    )
    return after, None


def time_passed(
    record: TrainRecord,
    now_s: float,
    *,
    curves: dict[int, ReferenceCurve],
    authority_m: float | None = None,
    limits: CentreLimits,
) -> TrainRecord:
    """Return the record at a later instant.

    Parameters
    ----------
    record : TrainRecord
    now_s : float [s]
        Centre's clock.
    curves : dict of int to ReferenceCurve
        By direction.
    authority_m : float, optional [m]
        End of the train's authority: the simulated place ends there.
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
        start = record.measured_s
        if record.departure_s is not None and curve.station_at(last) is not None:
            start = max(start, record.departure_s)
        place = curve.simulated_m(last, now_s - start)
    at_end = authority_m is not None and facing * (authority_m - place) <= 0.0
    if at_end and authority_m is not None:
        place = authority_m if facing * (authority_m - last) > 0.0 else last
    error = at_end or silent > limits.error_s
    return replace(record, state=TrainState.ERROR if error else TrainState.SIMULATED, shown_m=place)


def after_restart(record: TrainRecord) -> TrainRecord:
    """Return a stored record after a restart of the centre: unknown until the train is heard; its last place is kept.

    The clock of the process before says nothing about the time that has passed.
    """
    return replace(record, state=TrainState.UNKNOWN, heard_s=0.0, measured_s=0.0, departure_s=None)
