"""Messages from the centre to a train: movement authority with speed limits, and order to brake.

Each message is a canonical CBOR array. It contains the kind of message, the format version and the fields.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import Field

from railfix.core.messages import Message
from railfix.ground.layout import MOST_PARTS
from railfix.io.train_message import MessageError, cbor, validate_message

#: Version of the message format; a receiver rejects messages of other versions.
VERSION: Final = 3

Number = Annotated[int, Field(ge=0, lt=1 << 63)]
Chainage = Annotated[int, Field(ge=-(1 << 62), lt=1 << 62)]
SpeedPart = tuple[Chainage, Chainage, Annotated[int, Field(ge=0, lt=1 << 31)]]
GradientPart = tuple[Chainage, Annotated[int, Field(ge=-1000, le=1000)]]


class Authority(Message):
    """Movement authority, sent at least every second, after each report, and when the train's stop begins or ends."""

    kind: ClassVar[int] = 1
    train: Annotated[int, Field(ge=0, lt=1 << 32)]
    #: Number of the authority. It rises with every authority sent to the train, also across restarts of the centre.
    number: Number
    #: Sequence number of the newest report that the centre has stored for the train, 0 before the first report. The
    #: authority acknowledges this report. On board, the age of the authority is the time since this report was sent.
    report: Number
    end_cm: Chainage  #: Chainage where the authority ends.
    direction: Literal[-1, 1]
    stopped: bool  #: Whether the train is ordered to stop.
    #: Whether this is a request to shorten the earlier authority to `end_cm`. The train complies if it can stop before
    #: `end_cm`.
    shortens: bool = False
    #: Identifier of the session in which `report` was sent. The on-board unit draws a new identifier at each start.
    session: Annotated[int, Field(ge=0, lt=1 << 62)] = 0
    overlap_cm: Number = 0  #: Distance kept free beyond the end for a train that passes the end at release speed.
    #: Lower chainage [cm], upper chainage [cm] and highest speed [cm/s] of each speed restriction in the train's
    #: interval.
    restrictions: Annotated[tuple[SpeedPart, ...], Field(max_length=MOST_PARTS)] = ()
    #: Chainage [cm] and value [per mille] of each gradient. A gradient applies up to the chainage of the next gradient,
    #: and is positive where the track rises with the chainage.
    gradients: Annotated[tuple[GradientPart, ...], Field(max_length=MOST_PARTS)] = ()

    def encode(self) -> bytes:
        """Return the bytes of the message."""
        data: bytes = cbor().dumps([self.kind, VERSION, *vars(self).values()])
        return data

    @classmethod
    def decode(cls, data: bytes) -> Authority:
        """Decode an authority or a `BrakeOrder`.

        Raises
        ------
        MessageError
            The bytes are not a valid message of this version.
        """
        cbor2 = cbor()
        try:
            kind, version, *values = cbor2.loads(data)
        except (cbor2.CBORDecodeError, ValueError, TypeError, OverflowError, RecursionError, MemoryError):
            raise MessageError("is not an authority: a CBOR array was expected") from None
        found: dict[Any, type[Authority]] = {Authority.kind: Authority, BrakeOrder.kind: BrakeOrder}
        model = found.get(kind) if type(kind) is int else None
        if model is None or version != VERSION:
            raise MessageError(f"is of kind {kind!r} and version {version!r}; version {VERSION} was expected")
        if len(values) != len(model.model_fields):
            raise MessageError(f"has {len(values)} fields, {len(model.model_fields)} were expected")
        message = validate_message(model, dict(zip(model.model_fields, values, strict=True)))
        if message.encode() != data:  # not canonical: trailing bytes, or a boolean instead of a number
            raise MessageError("is not an authority in canonical form")
        return message


class BrakeOrder(Authority):
    """Order to brake to a stop, sent before the centre has stored it, and repeated until a report acknowledges it.

    `number` is the number of the latest authority. A later authority whose `stopped` is false ends the order.
    """

    kind: ClassVar[int] = 2
    reason: Annotated[str, Field(max_length=200)] = ""
