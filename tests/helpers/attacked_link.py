"""Link whose datagrams are damaged, repeated, and followed by foreign ones, beside the losses of the demonstration."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable

from pydantic import Field

from railfix.ground.demo import LinkDisturbance, RelaySettings


class AttackSettings(RelaySettings):
    """Attacks on the datagrams of a link."""

    bit_errors: float = Field(default=0.0, ge=0, le=1)  #: Probability that one bit of a datagram is flipped.
    #: Probability that a datagram is sent a second time, up to `repeat_s` later.
    repeats: float = Field(default=0.0, ge=0, le=1)
    repeat_s: float = Field(default=0.5, ge=0)
    #: Probability that a foreign datagram of random bytes, with the head of the one before, is put after a datagram.
    insertions: float = Field(default=0.0, ge=0, le=1)


class AttackedLink(LinkDisturbance):
    """Disturbance with attacks, counted by their kind."""

    settings: AttackSettings

    def __init__(self, settings: AttackSettings) -> None:
        super().__init__(settings)
        self.counts: Counter[str] = Counter()

    def packet(self, data: bytes, send: Callable[[bytes], None]) -> None:
        """Pass a packet on, attacked, or not."""
        settings, rng = self.settings, self._random
        if not self.up:
            return
        if rng.random() < settings.bit_errors:
            self.counts["bit errors"] += 1
            bit = rng.randrange(8 * len(data))
            data = data[: bit // 8] + bytes([data[bit // 8] ^ 1 << bit % 8]) + data[bit // 8 + 1 :]
        super().packet(data, send)
        loop = asyncio.get_running_loop()
        if rng.random() < settings.repeats:
            self.counts["repeated"] += 1
            loop.call_later(settings.delay_s + rng.uniform(0.0, settings.repeat_s), send, data)
        if rng.random() < settings.insertions:
            self.counts["inserted"] += 1
            loop.call_later(settings.delay_s, send, data[:20] + rng.randbytes(max(len(data) - 20, 1)))
