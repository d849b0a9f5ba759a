"""Settings of live operation."""

from __future__ import annotations

from pathlib import Path
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
    sensor_wait_s : float [s]
        Longest wait for the sensors on board to be heard up to an epoch; what one of them says since the epoch before
        is left out then.
    no_input : {"send", "skip"}
        Whether a period without input has a message.
    restart_epochs : int
        Epochs in a row with tags before the last one after which the receiver counts as restarted.
    reconnect : {"on", "off"}
        Whether a connection that broke is opened again, with waits that double from `reconnect_first_s` to
        `reconnect_longest_s`; off, the session ends with its sources. The first connection must succeed in any case.
    reconnect_first_s, reconnect_longest_s : float [s]
    silence_s : float [s]
        A connection without a byte for so long counts as broken.
    gga_s : float [s]
        How often the caster of the base station is sent the train's position (GGA), for a virtual station; 0: never.
    ntrip_certificates : path or None
        Certificates (PEM) that casters over TLS may have beside those that the system trusts.
    waiting : int
        Messages that may wait for a slow target; further ones are dropped for it and counted.
    behind_s : float [s]
        Delay above the shortest one seen with which epochs are skipped up to the present, said in the log; not where
        the epochs are recorded ones.
    state_every_s : float [s]
        How often the state file is written.
    state_age_s : float [s]
        Longest time from the last epoch of a state file to the first new one; after it only ephemerides and the
        sequence number are taken from the file.
    log_bytes, log_files : int
        Size at which a log file is put aside, and how many of these are kept.
    train, line : int
        Identities for the message.
    facing : {-1, 0, 1}
        Direction in which the train's front end looks against rising chainage; 0 where unknown: then the chainage
        of the message is that of the reference point, not of the front end.
    front_offset_m : float [m]
        Front end of the train ahead of the point whose chainage is computed.
    length_m : float [m]
        Train length.
    reference : int
        Identity of the reference location of ETCS position reports (NID_LRBG).
    reference_m : float [m]
        Its chainage.
    """

    period_s: float = Field(default=0.1, gt=0.0, le=60.0)
    pair_wait_s: float = Field(default=0.03, ge=0.0, le=10.0)
    sensor_wait_s: float = Field(default=0.03, ge=0.0, le=10.0)
    no_input: Literal["send", "skip"] = "send"
    restart_epochs: int = Field(default=3, ge=1)
    reconnect: Literal["on", "off"] = "on"
    reconnect_first_s: float = Field(default=1.0, gt=0.0, le=600.0)
    reconnect_longest_s: float = Field(default=30.0, gt=0.0, le=3600.0)
    silence_s: float = Field(default=30.0, gt=0.0, le=3600.0)
    gga_s: float = Field(default=0.0, ge=0.0, le=3600.0)
    ntrip_certificates: Path | None = None
    waiting: int = Field(default=100, ge=1, le=100_000)
    behind_s: float = Field(default=5.0, ge=0.5, le=3600.0)
    state_every_s: float = Field(default=5.0, gt=0.0, le=3600.0)
    state_age_s: float = Field(default=60.0, gt=0.0, le=3600.0)
    log_bytes: int = Field(default=1_000_000, ge=1000)
    log_files: int = Field(default=5, ge=1, le=1000)
    train: int = Field(default=0, ge=0)
    line: int = Field(default=0, ge=0)
    facing: Literal[-1, 0, 1] = 0
    front_offset_m: float = Field(default=0.0, ge=0.0)
    length_m: float = Field(default=0.0, ge=0.0)
    reference: int = Field(default=0, ge=0, lt=1 << 24)
    reference_m: float = 0.0
