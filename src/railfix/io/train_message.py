"""Position message of a train, for live positions, supervision and control.

A message is encoded in about 100 bytes of CBOR with integer keys (RFC 8949, canonical order). Receivers skip unknown
keys. A message can also be written as JSON, or as an ETCS position report (SUBSET-026 v4, 7.4.2, packet 0). CBOR
requires ``railfix[live]``.
"""

from __future__ import annotations

import json
from enum import IntEnum, IntFlag
from functools import cache
from types import ModuleType
from typing import Annotated, Any, Final, Self

from pydantic import Field, ValidationError, model_validator

from railfix.core.errors import InputFileError
from railfix.core.extras import needs_extra
from railfix.core.messages import Message
from railfix.core.settings import Model

VERSION: Final = 1  #: Version of the message schema; messages of other versions are rejected.
LONGEST: Final = 1024  #: Longest encoded message [bytes]; longer data are rejected without decoding.

Unsigned = Annotated[int, Field(ge=0, lt=1 << 63)]
Signed = Annotated[int, Field(ge=-(1 << 62), lt=1 << 62)]


class MessageStatus(IntEnum):
    """Reliability of a message's position."""

    POSITION = 0  #: Position that passed every check.
    COASTING = 1  #: Position of the filter at an epoch at which satellites alone give no position.
    DOUBTFUL = 2  #: Position that failed a check, or that is ambiguous: other positions or tracks are possible.
    NO_POSITION = 3  #: Observations were received, but no position was computed.
    NO_INPUT = 4  #: No input was received in this period.
    #: Satellite positioning is suspended by order of the trackside. railfix itself sends no such message.
    SUSPENDED = 5


class Source(IntFlag):
    """Sensors and other sources from which a position was computed."""

    FRONT_RECEIVER = 1
    REAR_RECEIVER = 2
    DOPPLER = 4
    CARRIER_PHASE = 8
    TACHOMETER = 16
    INERTIAL = 32
    RADAR = 64
    RANGING = 128
    FEATURES = 256
    SBAS = 512
    BALISES = 1024


class SuspectedInterference(IntEnum):
    """Suspected interference with satellite signals."""

    NONE = 0
    JAMMING = 1
    SPOOFING = 2


class Unknown(IntFlag):
    """Unknown properties of the train."""

    #: Direction of the front end. If unknown, `over_cm` and `under_cm` each hold on both sides of `chainage_cm`.
    FACING = 1
    #: Position of the front end. If unknown, `chainage_cm` is the chainage of the train's reference point.
    FRONT_END = 2
    LENGTH = 4  #: Train length.


class TrainMessage(Message):
    """Position message of a train."""

    train: Unsigned  #: Train identity.
    sequence: Unsigned  #: Number of the message, counted by the sender.
    time_ns: Unsigned  #: Time at which the position is valid, GPS time since 1980-01-06.
    sent_ns: Unsigned  #: Time of sending, measured by the sender's clock, GPS time since 1980-01-06.
    line: Unsigned  #: Identity of the line or track.
    chainage_cm: Signed | None = None  #: Chainage of the train's front end; None if there is no position.
    #: The front end is at most `under_cm` ahead of `chainage_cm`, and at most `over_cm` behind it (SUBSET-026 3.6.4).
    over_cm: Unsigned | None = None
    under_cm: Unsigned | None = None
    speed_cmps: Signed | None = None  #: Speed, positive toward rising chainage; None if unknown.
    speed_bound_cmps: Unsigned | None = None  #: Bound of the error of `speed_cmps`; None if the speed is unknown.
    #: Running direction: 1 toward rising chainage, -1 toward falling chainage, 0 if unknown.
    direction: Annotated[int, Field(ge=-1, le=1)] = 0
    facing: Annotated[int, Field(ge=-1, le=1)] = 0  #: Direction to which the front end points, coded as `direction`.
    standstill: bool = False
    status: MessageStatus = MessageStatus.NO_POSITION
    sources: Source = Source(0)
    protection_level_cm: Unsigned | None = None
    #: Probability that the train is on `line`, in thousandths, rounded down.
    track_permille: Annotated[int, Field(ge=0, le=1000)] | None = None
    length_cm: Unsigned = 0  #: Length of the train; 0 if unknown.
    complete: bool = False  #: Whether the train's integrity is confirmed.
    sigma_cm: Unsigned | None = None  #: Along-line standard deviation of the position, rounded up.
    #: Number of the newest movement authority that the train has accepted. The message acknowledges this authority.
    authority: Unsigned | None = None
    #: Chainage of the end of the movement authority, rounded away from the train.
    authority_end_cm: Signed | None = None
    interference: SuspectedInterference | None = None  #: Suspected interference; None if this is not checked.
    #: Chainages of the safe front end and safe rear end: in the direction of `facing`, no part of the train is ahead of
    #: the safe front end or behind the safe rear end. None if the bounds, the front end or its direction are unknown.
    safe_front_cm: Signed | None = None
    safe_rear_cm: Signed | None = None
    unknown: Unknown = Unknown(0)  #: Train properties that the sender does not know.
    #: Random number drawn at each start of the on-board unit; `sequence` restarts at the same time.
    session: Annotated[int, Field(ge=0, lt=1 << 62)] | None = None
    brake_order: Unsigned | None = None  #: Number of the brake order that is being executed; None if there is no order.

    @model_validator(mode="after")
    def _place_with_bounds(self) -> Self:
        placed = self.status in (MessageStatus.POSITION, MessageStatus.COASTING)
        if placed and None in (self.chainage_cm, self.over_cm, self.under_cm):
            raise ValueError("a message with a position must have chainage_cm, over_cm and under_cm")
        if self.chainage_cm is None and (self.over_cm is not None or self.under_cm is not None):
            raise ValueError("over_cm and under_cm need chainage_cm")
        return self


#: CBOR key of each field. A key never gets another meaning in later versions.
KEYS: Final[dict[str, int]] = {name: k for k, name in enumerate(TrainMessage.model_fields, start=1)}
_NAMES: Final = {key: name for name, key in KEYS.items()}
_VERSION_KEY: Final = 0
_TRUTHS: Final = ("standstill", "complete")


class MessageError(InputFileError):
    """Error for bytes or text that are not a valid position message."""

    def __init__(self, what: str) -> None:
        super().__init__("position message", what)


@cache
def cbor() -> ModuleType:
    """Return the module ``cbor2``, which is installed with ``railfix[live]``."""
    with needs_extra():
        import cbor2
    return cbor2


def encode(message: TrainMessage) -> bytes:
    """Encode a message in CBOR. Equal messages give equal bytes. Fields that are None are omitted."""
    # keys increase in the order of the fields, which is the canonical order
    values = {KEYS[name]: value for name, value in vars(message).items() if value is not None}
    data: bytes = cbor().dumps({_VERSION_KEY: VERSION, **values})
    return data


def decode(data: bytes) -> TrainMessage:
    """Decode CBOR; unknown keys are skipped. Raise MessageError if `data` is not a valid message of `VERSION`."""
    cbor2 = cbor()
    if len(data) > LONGEST:
        raise MessageError(f"has {len(data)} bytes, at most {LONGEST} were expected")
    try:
        values = cbor2.loads(data)
    except (cbor2.CBORDecodeError, ValueError, TypeError, OverflowError, RecursionError, MemoryError) as error:
        raise MessageError(f"is not CBOR ({type(error).__name__})") from None
    if not isinstance(values, dict) or not all(type(key) is int for key in values):
        raise MessageError("is not a map with integer keys")
    if len(values) != _entries(data):
        raise MessageError("has a key twice, or is a map of indefinite length")
    version = values.get(_VERSION_KEY)
    if type(version) is not int or version != VERSION:
        raise MessageError(f"is of version {version!r}, {VERSION} was expected")
    named = {_NAMES[key]: value for key, value in values.items() if key in _NAMES}
    for name, value in named.items():  # bool and float are not accepted as integers
        expected = bool if name in _TRUTHS else int
        if type(value) is not expected:
            raise MessageError(f"{name}: {type(value).__name__} instead of {expected.__name__}")
    return validate_message(TrainMessage, named)


def _entries(data: bytes) -> int:
    """Return the number of entries that a CBOR map declares (RFC 8949, 3.1), -1 for a map of indefinite length."""
    size = data[0] & 0x1F
    return size if size < 24 else int.from_bytes(data[1 : 1 + (1 << (size - 24))], "big") if size < 28 else -1


def validate_message(kind: type[Model], values: dict[str, Any]) -> Model:
    """Return a validated message; raise MessageError if a value is missing, out of range or inconsistent."""
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "message"
        raise MessageError(f"{where}: {first['msg'].removeprefix('Value error, ')}") from None


def to_json(message: TrainMessage) -> str:
    """Return a message as one line of JSON. Keys are the field names; statuses and sources are written as names."""
    values = message.model_dump()
    values["status"] = message.status.name.lower()
    values["sources"] = [source.name.lower() for source in Source if source in message.sources and source.name]
    values["unknown"] = [what.name.lower() for what in Unknown if what in message.unknown and what.name]
    if message.interference is not None:
        values["interference"] = message.interference.name.lower()
    return json.dumps({"version": VERSION, **values}, separators=(",", ":"))


def from_json(line: str) -> TrainMessage:
    """Parse a message written by `to_json`. Raise MessageError if the text is not a valid message of this version."""
    try:
        values = json.loads(line)
    except (ValueError, RecursionError):
        raise MessageError("is not JSON") from None
    if not isinstance(values, dict) or values.pop("version", None) != VERSION:
        raise MessageError(f"is not a JSON object of version {VERSION}")
    try:
        values["status"] = MessageStatus[str(values["status"]).upper()]
        sources = Source(0)
        for name in values["sources"]:
            sources |= Source[str(name).upper()]
        values["sources"] = sources
        unknown = Unknown(0)
        for name in values.get("unknown", ()):
            unknown |= Unknown[str(name).upper()]
        values["unknown"] = unknown
        if values.get("interference") is not None:
            values["interference"] = SuspectedInterference[str(values["interference"]).upper()]
    except (KeyError, TypeError):
        raise MessageError("has a status, source, interference or item of `unknown` that is not defined") from None
    return validate_message(TrainMessage, values)


_LARGEST_LENGTH: Final = 32_766  #: Largest value of a length in packet 0; the next value means an unknown length.


def etcs_report(message: TrainMessage, *, reference_cm: int, reference: int) -> dict[str, int]:
    """Return the fields of packet 0 (SUBSET-026 v4, 7.4.2.1), with the position relative to a balise group.

    `reference_cm` is the chainage of the balise group, and `reference` its identity (NID_LRBG). Raise ValueError if the
    message has no position of the front end, or if the front end is too far from the group.
    """
    if message.chainage_cm is None or message.over_cm is None or message.under_cm is None:
        raise ValueError("a message without a position has no packet 0")
    if Unknown.FRONT_END in message.unknown:
        raise ValueError("a message without the position of the front end has no packet 0")
    distance = message.chainage_cm - reference_cm
    metres = {"D_LRBG": abs(distance), "L_DOUBTOVER": message.over_cm, "L_DOUBTUNDER": message.under_cm}
    # Lengths are in metres (Q_SCALE 1), or in tens of metres (Q_SCALE 2) if too large for metres. The rounding error of
    # the distance is added to the confidence bounds, which are then rounded up, so that they remain valid.
    largest = max(metres.values())
    scale, unit = (1, 100) if largest <= 100 * _LARGEST_LENGTH - 200 else (2, 1000)
    rounded = {"D_LRBG": round(metres["D_LRBG"] / unit)}
    rest = metres["D_LRBG"] - unit * rounded["D_LRBG"]
    rounded["L_DOUBTOVER"] = -(-(metres["L_DOUBTOVER"] + abs(rest)) // unit)
    rounded["L_DOUBTUNDER"] = -(-(metres["L_DOUBTUNDER"] + abs(rest)) // unit)
    for name, value in rounded.items():
        if value > _LARGEST_LENGTH:
            raise ValueError(
                f"{name} is {value * unit / 100:.0f} m, at most 327660 m can be reported; use a nearer reference"
            )
    side = {1: 1, -1: 0, 0: 2}
    along = 0 if distance == 0 else (1 if distance > 0 else -1)
    speed = abs(message.speed_cmps or 0) * 36 // 1000 // 5  # V_TRAIN counts steps of 5 km/h
    return {
        "NID_PACKET": 0,
        "Q_SCALE": scale,
        "NID_LRBG": reference,
        "D_LRBG": rounded["D_LRBG"],
        "Q_DIRLRBG": side[message.facing],
        "Q_DLRBG": side[along],
        "L_DOUBTOVER": rounded["L_DOUBTOVER"],
        "L_DOUBTUNDER": rounded["L_DOUBTUNDER"],
        "Q_LENGTH": 1 if message.complete else 0,
        "L_TRAININT": message.length_cm // 100 if message.complete else 0,
        "V_TRAIN": min(speed, 127),
        "Q_DIRTRAIN": side[message.direction],
    }
