"""Relay of datagrams on loopback addresses with seeded loss, delay, reordering, outages and bit errors."""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from typing import Any

from pydantic import Field

from railfix.core.settings import Settings


class RelaySettings(Settings):
    """Disturbances of a relay.

    Attributes
    ----------
    loss : float
        Probability that a datagram is lost.
    delay_s, jitter_s : float [s]
        Delay of each datagram, and the largest random one on top of it: datagrams overtake each other.
    bit_errors : float
        Probability that one bit of a datagram is flipped.
    seed : int
    """

    loss: float = Field(default=0.0, ge=0, le=1)
    delay_s: float = Field(default=0.0, ge=0)
    jitter_s: float = Field(default=0.0, ge=0)
    bit_errors: float = Field(default=0.0, ge=0, le=1)
    seed: int = 0


class Relay(asyncio.DatagramProtocol):
    """Relay between one client and a target.

    Parameters
    ----------
    target : (str, int)
    settings : RelaySettings

    Attributes
    ----------
    up : bool
        False: an outage, every datagram is lost.
    counts : Counter of str
    """

    def __init__(self, target: tuple[str, int], settings: RelaySettings) -> None:
        self.up = True
        self.counts: Counter[str] = Counter()
        self.address: tuple[str, int] = ("", 0)
        self._target, self._settings, self._random = target, settings, random.Random(settings.seed)
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
        settings, rng = self._settings, self._random
        self.counts["datagrams"] += 1
        if not self.up or rng.random() < settings.loss:
            self.counts["lost"] += 1
            return
        if rng.random() < settings.bit_errors:
            self.counts["bit errors"] += 1
            bit = rng.randrange(8 * len(data))
            data = data[: bit // 8] + bytes([data[bit // 8] ^ 1 << bit % 8]) + data[bit // 8 + 1 :]
        delay = settings.delay_s + rng.uniform(0.0, settings.jitter_s)

        def send() -> None:
            if transport is not None and not transport.is_closing():
                transport.sendto(data, address)

        asyncio.get_running_loop().call_later(delay, send) if delay > 0.0 else send()


class _Back(asyncio.DatagramProtocol):
    def __init__(self, relay: Relay) -> None:
        self._relay = relay

    def datagram_received(self, data: bytes, addr: Any) -> None:  # noqa: ARG002
        self._relay.back(data)
