"""Ends of the redundant links: a train with two bearers, and a centre."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Callable
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

from railfix.core.errors import InputFileError
from railfix.ground.frames import Echo, Frame, FrameKind, FrameReceiver, ReceiverLimits, Threat
from railfix.ground.link_quality import LinkChoice, LinkLimits, LinkMeter, LinkName
from railfix.ground.quic import WAIT_S, LinkProtocol, configuration, connected, listen, read_revoked

#: Identity of the centre as a sender of frames.
CENTRE = 0
BEARERS: tuple[LinkName, LinkName] = ("A", "B")
#: Time between attempts to connect [s].
RETRY_S = 1.0


def first_sequence() -> int:
    """Return the number that a sender begins with: above those of its last start at up to 10 frames a second."""
    return int(time.time() * 10)


class Bearer(NamedTuple):
    """A bearer of the links: the centre's address on it, and the train's own."""

    centre: tuple[str, int]
    local: str


def bearers_of(addresses: dict[LinkName, tuple[str, int]], local: dict[LinkName, str]) -> dict[LinkName, Bearer]:
    """Return the bearers by the centre's addresses and the train's own."""
    return {name: Bearer(addresses[name], local[name]) for name in BEARERS}


class TrainLinks:
    """The train's end: two connections, one on each bearer.

    With the keys of `railfix.ground.quic.write_keys`; `received` is called with the payload of each new frame of the
    centre.
    """

    def __init__(
        self,
        train: int,
        keys: Path,
        bearers: dict[LinkName, Bearer],
        *,
        mode: Literal["spare", "both"] = "both",
        received: Callable[[bytes], None] = lambda _: None,
        limits: LinkLimits | None = None,
    ) -> None:
        self.train, self.mode = train, mode
        self.meters = {name: LinkMeter(limits=limits or LinkLimits()) for name in BEARERS}
        self.choice = LinkChoice()
        self.receiver = FrameReceiver(sender=CENTRE)
        self.protocols: dict[LinkName, LinkProtocol] = {}
        self._keys, self._bearers = keys, bearers
        self._received, self._sequence = received, first_sequence()
        self._newest: bytes | None = None
        self._tasks: list[asyncio.Task[None]] = []

    async def start(self) -> None:
        """Begin to connect; connections that end are made again."""
        self._tasks = [asyncio.create_task(self._keep(name)) for name in BEARERS]

    async def stop(self) -> None:
        """End both connections."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _keep(self, name: LinkName) -> None:
        idle_s = self.meters[name].limits.idle_s
        settings = configuration(self._keys, f"train-{self.train}", is_client=True, idle_s=idle_s)
        while True:
            try:
                async with connected(
                    self._bearers[name].centre,
                    settings,
                    local=self._bearers[name].local,
                    received=lambda _, data: self._frame(name, data),
                    timeout_s=3.0,
                ) as protocol:
                    if not self.protocols:
                        self.receiver.clock_restarted()
                    self.protocols[name] = protocol
                    self._resend(name)
                    while not (protocol.ended or protocol.expired):
                        await asyncio.sleep(0.1)
            except (ConnectionError, TimeoutError, OSError):
                pass  # tried again after a time: the meter counts what is not answered
            self.protocols.pop(name, None)
            await asyncio.sleep(RETRY_S)

    def send(self, payload: bytes, *, chainage_m: float | None = None, direction: int = 0) -> None:
        """Send a payload: with its echo on both links; in mode "spare" only the active one carries the payload."""
        now_ns, now_s = time.monotonic_ns(), time.monotonic()
        self._sequence += 1
        self._newest = payload
        for meter in self.meters.values():
            meter.settle(now_s)
        self.choice = self.choice.after(now_s, self.meters["A"], self.meters["B"])
        for name in BEARERS:
            carries = self.mode == "both" or name == self.choice.active
            self.meters[name].sent(self._sequence, now_s, chainage_m=chainage_m, direction=direction)
            self._put(name, FrameKind.DATA if carries else FrameKind.PROBE, payload if carries else b"", now_ns)

    def _put(self, name: LinkName, kind: FrameKind, payload: bytes, now_ns: int) -> None:
        if (protocol := self.protocols.get(name)) is None:
            return
        frame = Frame(kind=kind, sender=self.train, sequence=self._sequence, time_ns=now_ns, payload=payload)
        protocol.send(frame.encode())

    def _resend(self, name: LinkName) -> None:
        """Send the newest payload at once where a link is back and no other one is there."""
        if self._newest is not None and len(self.protocols) == 1:
            self._sequence += 1
            self._put(name, FrameKind.DATA, self._newest, time.monotonic_ns())

    def _frame(self, name: LinkName, data: bytes) -> None:
        now_ns = time.monotonic_ns()
        answer, use = self.receiver.receive(name, data, now_ns)
        if answer is None:
            return
        if answer.kind is FrameKind.ECHO and (echo := Echo.decode(answer.payload)) is not None:
            self.meters[name].answered(echo.sequence, now_ns / 1e9, echo.round_trip_s(now_ns))
        elif use is not None and use.kind is FrameKind.DATA:
            self._received(use.payload)


class CentreLinks:
    """The centre's end: listens at one address a bearer, answers every frame, passes each payload on once.

    `received` is called with the train's number and the payload; ports are free ones where none are given.
    Answers wait up to `wait_s` for a payload to go with.

    Attributes
    ----------
    addresses : dict of {"A", "B"} to (str, int)
    masquerades : int
        Connections that were rejected for their certificate.
    heard_s : dict of (int, {"A", "B"}) to float
        Monotonic clock when a train's last frame came over a bearer.
    alarm : str or None
        What is wrong with the list of revoked certificates.
    """

    def __init__(
        self,
        keys: Path,
        hosts: dict[LinkName, str],
        *,
        received: Callable[[int, bytes], None],
        ports: dict[LinkName, int] | None = None,
        limits: ReceiverLimits | None = None,
        wait_s: float = WAIT_S,
    ) -> None:
        self.addresses: dict[LinkName, tuple[str, int]] = {}
        self.receivers: dict[int, FrameReceiver] = {}
        self.masquerades = 0
        self.heard_s: dict[tuple[int, LinkName], float] = {}
        self._keys, self._hosts, self._ports, self._received = keys, hosts, ports or {}, received
        self._limits, self._wait_s = limits or ReceiverLimits(), wait_s
        self._peers: dict[tuple[int, LinkName], LinkProtocol] = {}
        # of each train alone: `first_sequence` allows 10 frames a second
        self._sequence: dict[tuple[int, FrameKind], int] = {}
        self._stack = AsyncExitStack()
        self.alarm: str | None = None
        self._revoked: frozenset[str] = frozenset()

    async def start(self) -> None:
        """Listen.

        InputFileError: when the list of revoked certificates cannot be read.
        """
        self._revoked = read_revoked(self._keys)
        watch = asyncio.create_task(self._watch())
        self._stack.callback(watch.cancel)
        settings = configuration(self._keys, "centre", is_client=False)
        for name in BEARERS:
            server, self.addresses[name] = await listen(
                (self._hosts[name], self._ports.get(name, 0)),
                settings,
                received=lambda protocol, data, name=name: self._frame(name, protocol, data),  # type: ignore[misc]
                rejected=self._masquerade,
                wait_s=self._wait_s,
            )
            self._stack.callback(server.close)

    async def stop(self) -> None:
        """End all connections."""
        await self._stack.aclose()

    def threats(self) -> Counter[Threat]:
        """Return what was rejected from all trains."""
        total: Counter[Threat] = Counter({Threat.MASQUERADE: self.masquerades})
        for receiver in self.receivers.values():
            total += receiver.threats
        return total

    def send(self, train: int, payload: bytes) -> None:
        """Send a payload to a train on every link it has."""
        data = self._encode(train, FrameKind.DATA, payload)
        for name in BEARERS:
            if (protocol := self._peers.get((train, name))) is not None:
                protocol.send(data)

    async def _watch(self) -> None:
        """End connections whose certificate has expired or is revoked meanwhile."""
        while True:
            try:
                self._revoked, self.alarm = read_revoked(self._keys), None
            except InputFileError as error:
                self.alarm = f"{error}; the certificates revoked before are still rejected"
            for protocol in self._peers.values():
                if protocol.peer is not None and (protocol.expired or protocol.peer in self._revoked):
                    protocol.reject()
            await asyncio.sleep(RETRY_S)

    def _masquerade(self) -> None:
        self.masquerades += 1

    def _encode(self, train: int, kind: FrameKind, payload: bytes) -> bytes:
        sequence = self._sequence[train, kind] = self._sequence.get((train, kind), first_sequence()) + 1
        frame = Frame(kind=kind, sender=CENTRE, sequence=sequence, time_ns=time.monotonic_ns(), payload=payload)
        return frame.encode()

    def _echo(self, train: int, answered: Frame, received_ns: int) -> bytes:
        echo = Echo(
            sequence=answered.sequence, sent_ns=answered.time_ns, received_ns=received_ns,
            answered_ns=time.monotonic_ns(),
        )  # fmt: skip
        return self._encode(train, FrameKind.ECHO, echo.encode())

    def _frame(self, name: LinkName, protocol: LinkProtocol, data: bytes) -> None:
        kind, _, name_of_train = (protocol.peer or "").partition("-")
        if kind != "train" or not name_of_train.isdigit() or protocol.peer in self._revoked:
            protocol.reject()
            return
        train, now_ns = int(name_of_train), time.monotonic_ns()
        receiver = self.receivers.setdefault(train, FrameReceiver(sender=train, limits=self._limits))
        if self._peers.get((train, name)) is not protocol and all(
            known.ended for (number, _), known in self._peers.items() if number == train
        ):
            receiver.clock_restarted()
        answer, use = receiver.receive(name, data, now_ns)
        if answer is None:
            return
        self._peers[train, name], self.heard_s[train, name] = protocol, time.monotonic()
        protocol.answer(partial(self._echo, train, answer, now_ns))
        if use is not None:
            self._received(train, use.payload)
