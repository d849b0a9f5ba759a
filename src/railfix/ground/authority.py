"""Authority message of the centre: how far a train may run, and which of its reports the centre has used."""

from __future__ import annotations

import struct
from typing import Annotated, Final, Literal

from pydantic import Field, ValidationError

from railfix.core.settings import Settings
from railfix.io.train_message import MessageError

#: Version of the message; a receiver rejects others.
VERSION: Final = 2
_FORM: Final = struct.Struct("!BIQQqb??")


class Authority(Settings):
    """One authority message, sent after each report of the train, at a stop, and at least every second.

    Attributes
    ----------
    train : int
    number : int
        Rises with every message of the centre, also over its restarts.
    report : int
        Sequence number of the train's newest report that the centre has stored, 0 without one: an acknowledgement,
        and the train's measure of the age of this message on its own clock.
    end_cm : int [cm]
        Chainage where the authority ends.
    direction : {-1, 1}
    stopped : bool
        Satellite positioning is suspended, the train stops.
    shortens : bool
        The end is one that the train is asked to take in place of a further one, where it can stop before it.
    """

    train: Annotated[int, Field(ge=0, lt=1 << 32)]
    number: Annotated[int, Field(ge=0, lt=1 << 63)]
    report: Annotated[int, Field(ge=0, lt=1 << 63)]
    end_cm: Annotated[int, Field(ge=-(1 << 62), lt=1 << 62)]
    direction: Literal[-1, 1]
    stopped: bool
    shortens: bool = False

    def encode(self) -> bytes:
        """Return the bytes of the message."""
        return _FORM.pack(
            VERSION, self.train, self.number, self.report, self.end_cm, self.direction, self.stopped, self.shortens
        )  # fmt: skip

    @classmethod
    def decode(cls, data: bytes) -> Authority:
        """Return the message of some bytes.

        Raises
        ------
        MessageError
            The bytes are no authority message of this version.
        """
        if len(data) != _FORM.size:
            raise MessageError(f"has {len(data)} bytes, an authority has {_FORM.size}")
        version, *values = _FORM.unpack(data)
        if version != VERSION:
            raise MessageError(f"is an authority of version {version}, {VERSION} was expected")
        try:
            return cls(**dict(zip(cls.model_fields, values, strict=True)))
        except ValidationError as error:
            first = error.errors()[0]
            raise MessageError(f"{first['loc'][0]}: {first['msg']}") from None
