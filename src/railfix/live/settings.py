"""Settings of live operation."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from railfix.core.settings import Settings


class LiveSettings(Settings):
    """Settings of live operation.

    Attributes
    ----------
    period_s : float [s]
        A message is due every period, also without input (P1 2.1: 0.1 s).
    pair_wait_s : float [s]
        Longest wait for the other antenna's epoch after the first one of a pair has arrived.
    no_input : {"send", "skip"}
        Whether a period without input has a message.
    restart_epochs : int
        Epochs in a row with tags before the last one after which the receiver counts as restarted.
    train, line : int
        Identities for the message.
    facing : {-1, 0, 1}
        Direction in which the train's front end looks against rising chainage; 0 where unknown: then the chainage
        of the message is that of the reference point, not of the front end.
    front_offset_m : float [m]
        Front end of the train ahead of the point whose chainage is computed.
    length_m : float [m]
        Train length.
    """

    period_s: float = Field(default=0.1, gt=0.0, le=60.0)
    pair_wait_s: float = Field(default=0.03, ge=0.0, le=10.0)
    no_input: Literal["send", "skip"] = "send"
    restart_epochs: int = Field(default=3, ge=1)
    train: int = Field(default=0, ge=0)
    line: int = Field(default=0, ge=0)
    facing: Literal[-1, 0, 1] = 0
    front_offset_m: float = Field(default=0.0, ge=0.0)
    length_m: float = Field(default=0.0, ge=0.0)
