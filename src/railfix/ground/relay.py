"""Relay of datagrams on loopback addresses with seeded loss, delay, reordering, outages and bit errors."""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from collections.abc import Callable
from typing import Any

from pydantic import Field

from railfix.core.settings import Settings


class RelaySettings(Settings):
    """Disturbances of a relay."""

    loss: float = Field(default=0.0, ge=0, le=1)  #: Probability that a datagram is lost.
    #: Delay of each datagram, and the largest random one on top of it: datagrams overtake each other.
    delay_s: float = Field(default=0.0, ge=0)
    jitter_s: float = Field(default=0.0, ge=0)
    bit_errors: float = Field(default=0.0, ge=0, le=1)  #: Probability that one bit of a datagram is flipped.
    #: Probability that a datagram is sent a second time, up to `repeat_s` later.
    repeats: float = Field(default=0.0, ge=0, le=1)

    repeat_s: float = Field(default=0.5, ge=0)
    #: Probability that a foreign datagram of random bytes, with the head of the one before, is put after a datagram.
    insertions: float = Field(default=0.0, ge=0, le=1)

    seed: int = 0


class LinkDisturbance:
    """Seeded disturbance of packets of any kind.

    Attributes
    ----------
    settings : RelaySettings
        May be replaced while packets pass.
    up : bool
        False: an outage, every packet is lost.
    counts : Counter of str
    """

    def __init__(self, settings: RelaySettings) -> None:
        self.settings, self.up = settings, True
        self.counts: Counter[str] = Counter()
        self._random = random.Random(settings.seed)

    def packet(self, data: bytes, send: Callable[[bytes], None]) -> None:
        """Pass a packet on, by `send`, or not."""
        settings, rng = self.settings, self._random
        self.counts["datagrams"] += 1
        if not self.up or rng.random() < settings.loss:
            self.counts["lost"] += 1
            return
        if rng.random() < settings.bit_errors:
            self.counts["bit errors"] += 1
            bit = rng.randrange(8 * len(data))
            data = data[: bit // 8] + bytes([data[bit // 8] ^ 1 << bit % 8]) + data[bit // 8 + 1 :]
        delay = settings.delay_s + rng.uniform(0.0, settings.jitter_s)
        self._later(delay, data, send)
        if rng.random() < settings.repeats:
            self.counts["repeated"] += 1
            self._later(delay + rng.uniform(0.0, settings.repeat_s), data, send)
        if rng.random() < settings.insertions:
            self.counts["inserted"] += 1
            self._later(delay, data[:20] + rng.randbytes(max(len(data) - 20, 1)), send)

    @staticmethod
    def _later(delay_s: float, data: bytes, send: Callable[[bytes], None]) -> None:
        if delay_s > 0.0:
            asyncio.get_running_loop().call_later(delay_s, send, data)
        else:
            send(data)


class Relay(asyncio.DatagramProtocol):
    """Relay between one client and a target."""

    def __init__(self, target: tuple[str, int], settings: RelaySettings) -> None:
        self.disturbance = LinkDisturbance(settings)
        self.address: tuple[str, int] = ("", 0)
        self._target = target
        self._here: asyncio.DatagramTransport | None = None
        self._there: asyncio.DatagramTransport | None = None
        self._client: Any = None

    async def open(self, host: str) -> None:
        """Open the relay at a loopback address, at a free port."""
        loop = asyncio.get_running_loop()
        self._here, _ = await loop.create_datagram_endpoint(lambda: self, local_addr=(host, 0))
        self._there, _ = await loop.create_datagram_endpoint(lambda: _Back(self), local_addr=(host, 0))
        self.address = self._here.get_extra_info("sockname")[:2]

    def close(self) -> None:
        """Close the relay."""
        for transport in (self._here, self._there):
            if transport is not None:
                transport.close()

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Pass a datagram of the client on."""
        self._client = addr
        self._pass(data, self._there, self._target)

    def back(self, data: bytes) -> None:
        """Pass a datagram of the target back."""
        if self._client is not None:
            self._pass(data, self._here, self._client)

    def _pass(self, data: bytes, transport: asyncio.DatagramTransport | None, address: Any) -> None:
        def send(datagram: bytes) -> None:
            if transport is not None and not transport.is_closing():
                transport.sendto(datagram, address)

        self.disturbance.packet(data, send)


class _Back(asyncio.DatagramProtocol):
    def __init__(self, relay: Relay) -> None:
        self._relay = relay

    def datagram_received(self, data: bytes, addr: Any) -> None:  # noqa: ARG002
        self._relay.back(data)
