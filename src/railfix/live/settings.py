"""Settings of live operation."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from railfix.core.settings import Settings


class LiveSettings(Settings):
    """Settings of live operation."""

    #: A message is due every period, also without input (P1 2.1: 0.1 s).
    period_s: float = Field(default=0.1, gt=0.0, le=60.0)
    #: Longest wait for the other antenna's epoch after the first one of a pair has arrived.
    pair_wait_s: float = Field(default=0.03, ge=0.0, le=10.0)
    #: Longest wait for the sensors on board to be heard up to an epoch; what one of them says since the epoch before is
    #: left out then.
    sensor_wait_s: float = Field(default=0.03, ge=0.0, le=10.0)
    no_input: Literal["send", "skip"] = "send"  #: Whether a period without input has a message.
    #: Epochs in a row with tags before the last one after which the receiver counts as restarted.
    restart_epochs: int = Field(default=3, ge=1)
    #: Whether a connection that broke is opened again, with waits that double from `reconnect_first_s` to
    #: `reconnect_longest_s`; off, the session ends with its sources. The first connection must succeed in any case.
    reconnect: Literal["on", "off"] = "on"

    reconnect_first_s: float = Field(default=1.0, gt=0.0, le=600.0)
    reconnect_longest_s: float = Field(default=30.0, gt=0.0, le=3600.0)
    #: A connection without a byte for so long counts as broken.
    silence_s: float = Field(default=30.0, gt=0.0, le=3600.0)
    #: How often the caster of the base station is sent the train's position (GGA), for a virtual station; 0: never.
    gga_s: float = Field(default=0.0, ge=0.0, le=3600.0)
    #: Certificates (PEM) that casters over TLS may have beside those that the system trusts.
    ntrip_certificates: Path | None = None
    #: Messages that may wait for a slow target; further ones are dropped for it and counted.
    waiting: int = Field(default=100, ge=1, le=100_000)
    #: Delay above the shortest one seen with which epochs are skipped up to the present, said in the log; not where the
    #: epochs are recorded ones.
    behind_s: float = Field(default=5.0, ge=0.5, le=3600.0)
    state_every_s: float = Field(default=5.0, gt=0.0, le=3600.0)  #: How often the state file is written.
    #: Longest time from the last epoch of a state file to the first new one; after it only ephemerides and the sequence
    #: number are taken from the file.
    state_age_s: float = Field(default=60.0, gt=0.0, le=3600.0)
    #: Size at which a log file is put aside, and how many of these are kept.
    log_bytes: int = Field(default=1_000_000, ge=1000)
    log_files: int = Field(default=5, ge=1, le=1000)
    #: Identities for the message.
    train: int = Field(default=0, ge=0)
    line: int = Field(default=0, ge=0)
    #: Direction in which the train's front end looks against rising chainage; 0 where unknown: then the chainage of the
    #: message is that of the reference point, not of the front end.
    facing: Literal[-1, 0, 1] = 0
    #: Front end of the train ahead of the point whose chainage is computed.
    front_offset_m: float = Field(default=0.0, ge=0.0)
    length_m: float = Field(default=0.0, ge=0.0)  #: Train length.
    #: Identity of the reference location of ETCS position reports (NID_LRBG).
    reference: int = Field(default=0, ge=0, lt=1 << 24)
    reference_m: float = 0.0  #: Its chainage.
