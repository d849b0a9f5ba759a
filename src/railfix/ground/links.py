"""Redundant links between a train and a centre over two bearers: both ends, link quality, and choice of the link."""

from __future__ import annotations

import asyncio
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import AsyncExitStack
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError
from railfix.core.settings import Settings
from railfix.ground.frames import Echo, Frame, FrameKind, FrameReceiver, ReceiverLimits, Threat, draw_session
from railfix.ground.keys import WARNING_DAYS, Revoked, ending_sentence, list_ending, read_revoked
from railfix.ground.quic import WAIT_S, LinkProtocol, configuration, connection, listen

#: Number of stored frame results of a link: one hour at ten frames per second.
KEPT: Final = 36_000


class LinkResult(NamedTuple):
    """Result of a frame: time [s] and position [m] at sending; round-trip time [s], NaN without an answer in time."""

    sent_s: float
    chainage_m: float
    round_trip_s: float


class LinkLimits(Settings):
    """Time-outs and switching rules of the two links between a train and the centre."""

    #: Longest time from the sending of a frame to its echo; a later echo counts as a miss. A centre delays echoes by up
    #: to 0.2 s.
    answer_s: float = Field(default=1.0, gt=0)
    misses: int = Field(default=3, ge=1)  #: Consecutive misses on the normal link after which the spare link is used.
    good: int = Field(default=10, ge=1)  #: Number of consecutive answers on the normal link before it is used again.
    good_s: float = Field(default=30.0, ge=0)  #: Minimum time on the spare link before the normal link is used again.
    window: int = Field(default=60, ge=1)  #: Number of newest frames from which the response rate is computed.
    place_m: float = Field(default=100.0, gt=0)  #: Length of a cell of the coverage map.
    #: The connection is opened again if no packet arrives within this time after a frame was sent, so that trains
    #: reconnect after a centre was killed.
    idle_s: float = Field(default=5.0, gt=0, le=10)


@dataclass(kw_only=True)
class LinkMeter:
    """Response rate and round-trip time of one link."""

    limits: LinkLimits = field(default_factory=LinkLimits)
    misses: int = 0  #: Number of misses since the last answer in time.
    good: int = 0  #: Number of answers in time since the last miss.
    #: Numbers of answered frames and of sent frames, by cell of the coverage map and running direction.
    coverage: dict[tuple[int, int], tuple[int, int]] = field(default_factory=dict)
    #: Results of the last `KEPT` frames, in the order in which the results became known.
    results: deque[LinkResult] = field(default_factory=lambda: deque(maxlen=KEPT))

    _open: dict[int, tuple[float, float | None, int]] = field(default_factory=dict)

    def note_sent(self, sequence: int, now_s: float, *, chainage_m: float | None = None, direction: int = 0) -> None:
        """Count a sent frame; a frame without a known position is not counted in the coverage."""
        self._open[sequence] = (now_s, chainage_m, direction)

    def note_answer(self, sequence: int, now_s: float, round_trip_s: float) -> None:
        """Count the echo of a frame; a late or repeated echo is ignored."""
        self.settle(now_s)
        if (waiting := self._open.pop(sequence, None)) is None:
            return
        self.misses, self.good = 0, self.good + 1
        self._note(waiting, round_trip_s)

    def settle(self, now_s: float) -> None:
        """Count frames that were not answered within `LinkLimits.answer_s` as misses."""
        for sequence, waiting in list(self._open.items()):
            if now_s - waiting[0] <= self.limits.answer_s:
                break
            del self._open[sequence]
            self.misses, self.good = self.misses + 1, 0
            self._note(waiting, float("nan"))

    def _note(self, waiting: tuple[float, float | None, int], round_trip_s: float) -> None:
        sent_s, chainage_m, direction = waiting
        if chainage_m is not None:
            place = int(chainage_m // self.limits.place_m), direction
            answered, sent = self.coverage.get(place, (0, 0))
            self.coverage[place] = (answered + (round_trip_s == round_trip_s), sent + 1)
        known = float("nan") if chainage_m is None else chainage_m
        self.results.append(LinkResult(sent_s, known, round_trip_s))

    @property
    def _window_s(self) -> list[float]:
        return [result.round_trip_s for result in islice(reversed(self.results), self.limits.window)]

    @property
    def response_rate(self) -> float:
        """Fraction of the newest `LinkLimits.window` frames that were answered in time; NaN if there are no frames."""
        window = self._window_s
        return float(np.isfinite(window).mean()) if window else float("nan")

    @property
    def round_trip_s(self) -> float:
        """Median round-trip time of the newest `LinkLimits.window` frames [s]; NaN if no frame was answered."""
        answered = [value for value in self._window_s if value == value]
        return float(np.median(answered)) if answered else float("nan")


LinkName = Literal["A", "B"]
LinkMode = Literal["both", "spare"]  #: Whether both links carry the payload, or only the active link.


@dataclass(frozen=True, kw_only=True)
class LinkChoice:
    """Choice between the normal link A and the spare link B."""

    active: LinkName = "A"
    since_s: float = 0.0  #: Time of the last change between the links [s].
    switches: int = 0

    def after(self, now_s: float, normal: LinkMeter, spare: LinkMeter) -> LinkChoice:
        """Return the choice after new results of both links.

        The spare link is used after consecutive misses of the normal link, unless the spare link misses as well. The
        normal link is used again after consecutive answers and a minimum time, or at once if only the spare link
        misses.
        """
        limits = normal.limits
        lost_normal, lost_spare = normal.misses >= limits.misses, spare.misses >= limits.misses
        if self.active == "A" and lost_normal and not lost_spare:
            return replace(self, active="B", since_s=now_s, switches=self.switches + 1)
        steady = normal.good >= limits.good and now_s - self.since_s >= limits.good_s
        if self.active == "B" and (steady or (lost_spare and normal.good > 0)):
            return replace(self, active="A", since_s=now_s, switches=self.switches + 1)
        return self


ANSWERED: Final = "#0b6e99"
MISSED: Final = "#e5989b"


def coverage(meters: Iterable[LinkMeter]) -> dict[int, dict[int, tuple[int, int]]]:
    """Return the numbers of answered and sent frames, by direction and cell, summed over the meters of one bearer."""
    total: dict[int, dict[int, tuple[int, int]]] = defaultdict(dict)
    for meter in meters:
        for (place, direction), (answered, sent) in meter.coverage.items():
            before = total[direction].get(place, (0, 0))
            total[direction][place] = (before[0] + answered, before[1] + sent)
    return dict(total)


def round_trips(meters: Iterable[LinkMeter]) -> tuple[Floats, Floats, Floats]:
    """Return time since the first frame [s], chainage [m] and round trip [s] of each frame; unknown values are NaN."""
    results = sorted(result for meter in meters for result in meter.results)
    table = np.array(results, dtype=np.float64).reshape(-1, 3)
    return table[:, 0] - table[:1, 0].sum(), table[:, 1], table[:, 2]


def draw_coverage(path: Path, bearers: Mapping[LinkName, list[LinkMeter]]) -> None:
    """Draw the response rates and round-trip times of the links, by bearer.

    One chart per bearer and running direction shows the response rate along the line (P5, figure 7). Two charts per
    bearer show the round-trip times over time and position (P5, figures 9 and 10); unanswered frames are at the bottom.
    """
    from matplotlib.figure import Figure

    rows = [
        (f"bearer {name}, {'rising' if direction > 0 else 'falling'}", places, meters[0].limits.place_m)
        for name, meters in bearers.items()
        for direction, places in sorted(coverage(meters).items(), reverse=True)
    ]
    figure = Figure(figsize=(10, 1.2 + 1.1 * len(rows) + 1.8 * len(bearers)), layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=[max(1.1 * len(rows), 1.1), 1.8 * len(bearers)])
    rates, trips = figure.add_subfigure(grid[0]), figure.add_subfigure(grid[1])
    for axes, (label, places, step) in zip(
        rates.subplots(max(len(rows), 1), 1, sharex=True, squeeze=False)[:, 0], rows, strict=False
    ):
        for place, (answered, sent) in places.items():
            rate = answered / sent
            axes.bar((place + 0.5) * step, 100.0 * rate, width=step, color=ANSWERED, linewidth=0)
            axes.bar((place + 0.5) * step, 100.0 * (1.0 - rate), width=step, bottom=100.0 * rate, color=MISSED)
        axes.set(ylabel="%", ylim=(0, 100), title=label)
    rates.supxlabel("chainage of the front [m]")
    rates.suptitle("Response rate along the line: answered (blue), not answered (red)")
    pairs = trips.subplots(len(bearers), 2, sharex="col", sharey=True, squeeze=False)
    for (name, meters), both in zip(bearers.items(), pairs, strict=True):
        sent_s, chainage_m, trip_s = round_trips(meters)
        missed = np.isnan(trip_s)
        for axes, over in zip(both, (sent_s, chainage_m), strict=True):
            axes.plot(over[~missed], 1e3 * trip_s[~missed], ".", color=ANSWERED, markersize=3)
            axes.plot(over[missed], np.zeros(np.count_nonzero(missed)), "|", color=MISSED, markersize=8)
        both[0].set(ylabel=f"bearer {name} [ms]")
    pairs[-1, 0].set(xlabel="time [s]")
    pairs[-1, 1].set(xlabel="chainage of the front [m]")
    trips.suptitle("Round trip over time and position; not answered (red)")
    figure.savefig(path, dpi=110)


#: Number that identifies the centre as a sender of frames.
CENTRE = 0
BEARERS: tuple[LinkName, LinkName] = ("A", "B")
#: Time between attempts to connect [s].
RETRY_S = 1.0


class Bearer(NamedTuple):
    """Bearer of a link: address of the centre on this bearer, and local address of the train."""

    centre: tuple[str, int]
    local: str


def create_bearers(addresses: dict[LinkName, tuple[str, int]], local: dict[LinkName, str]) -> dict[LinkName, Bearer]:
    """Return the bearers from the centre's addresses and the train's local addresses."""
    return {name: Bearer(addresses[name], local[name]) for name in BEARERS}


class TrainLinks:
    """The train's end of the links: one connection on each bearer, with keys from `railfix.ground.keys.write_keys`.

    `received` is called with the payload of each new frame of the centre.
    """

    def __init__(
        self,
        train: int,
        keys: Path,
        bearers: dict[LinkName, Bearer],
        *,
        mode: LinkMode = "both",
        received: Callable[[bytes], None] = lambda _: None,
        limits: LinkLimits | None = None,
    ) -> None:
        self.train, self.mode = train, mode
        self.meters = {name: LinkMeter(limits=limits or LinkLimits()) for name in BEARERS}
        self.choice = LinkChoice()
        self.receiver = FrameReceiver(sender=CENTRE)
        self.protocols: dict[LinkName, LinkProtocol] = {}
        self._keys, self._bearers = keys, bearers
        self._received, self._session, self._sequence = received, draw_session(), 0
        self._newest: bytes | None = None
        self._tasks: list[asyncio.Task[None]] = []

    async def start(self) -> None:
        """Start to open both connections; a connection that ends is reopened."""
        self._tasks = [asyncio.create_task(self._keep(name)) for name in BEARERS]

    async def stop(self) -> None:
        """End both connections."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _keep(self, name: LinkName) -> None:
        idle_s = self.meters[name].limits.idle_s
        while True:
            try:
                # files are read for each connection, so that new certificates are used
                settings = configuration(self._keys, f"train-{self.train}", is_client=True, idle_s=idle_s)
                async with connection(
                    self._bearers[name].centre,
                    settings,
                    local=self._bearers[name].local,
                    received=lambda _, data: self._frame(name, data),
                    timeout_s=3.0,
                ) as protocol:
                    self.protocols[name] = protocol
                    self._resend(name)
                    if protocol.peer is not None:
                        async with asyncio.timeout(protocol.peer.valid_s):
                            await protocol.wait_silent(idle_s)
            except (ConnectionError, TimeoutError, OSError):
                pass  # opened again after `RETRY_S`; the meter counts unanswered frames
            self.protocols.pop(name, None)
            await asyncio.sleep(RETRY_S)

    def send(self, payload: bytes, *, chainage_m: float | None = None, direction: int = 0) -> None:
        """Send a frame on both links; in mode "spare", the frame on the inactive link is an empty probe."""
        now_ns, now_s = time.monotonic_ns(), time.monotonic()
        self._sequence += 1
        self._newest = payload
        for meter in self.meters.values():
            meter.settle(now_s)
        self.choice = self.choice.after(now_s, self.meters["A"], self.meters["B"])
        for name in BEARERS:
            carries = self.mode == "both" or name == self.choice.active
            self.meters[name].note_sent(self._sequence, now_s, chainage_m=chainage_m, direction=direction)
            self._put(name, FrameKind.DATA if carries else FrameKind.PROBE, payload if carries else b"", now_ns)

    def _put(self, name: LinkName, kind: FrameKind, payload: bytes, now_ns: int) -> None:
        if (protocol := self.protocols.get(name)) is None:
            return
        frame = Frame(
            kind=kind, sender=self.train, session=self._session, sequence=self._sequence, time_ns=now_ns,
            payload=payload,
        )  # fmt: skip
        protocol.send(frame.encode())

    def _resend(self, name: LinkName) -> None:
        """Send the newest payload at once if a link is restored and no other link is connected."""
        if self._newest is not None and len(self.protocols) == 1:
            self._sequence += 1
            self._put(name, FrameKind.DATA, self._newest, time.monotonic_ns())

    def _frame(self, name: LinkName, data: bytes) -> None:
        now_ns = time.monotonic_ns()
        answer, use = self.receiver.receive(name, data, now_ns)
        if answer is None:
            return
        if answer.kind is FrameKind.ECHO and (echo := Echo.decode(answer.payload)) is not None:
            self.meters[name].note_answer(echo.sequence, now_ns / 1e9, echo.round_trip_s(now_ns))
        elif use is not None and use.kind is FrameKind.DATA:
            self._received(use.payload)


class CentreLinks:
    """The centre's end of the links, which listens at one address per bearer.

    `received` is called with the train's number and the payload. By default, free ports are used; `addresses` contains
    the addresses in use, by bearer. Answers are delayed by up to `wait_s`, to be sent together with a payload.
    `masquerades` is the number of connections rejected because of the peer's certificate. `heard_s` contains the
    monotonic time of the last received frame, by train and bearer. `alarm` is a sentence if the list of revoked
    certificates cannot be read, otherwise None.
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
        self._session = draw_session()
        self._sequence: dict[tuple[int, FrameKind], int] = {}
        self._stack = AsyncExitStack()
        self.alarm: str | None = None
        self._revoked = Revoked()
        self._ending: list[str] = []  #: Sentences on certificates that expire soon, one for each certificate.

    async def start(self) -> None:
        """Open the server of each bearer.

        Raise InputFileError if the list of revoked certificates cannot be read. Raise OSError if an address is not
        available.
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

    def alarms(self) -> list[str]:
        """Return sentences on an unreadable list of revoked certificates, and on certificates that expire soon."""
        return [*([] if self.alarm is None else [self.alarm]), *self._ending]

    def threats(self) -> Counter[Threat]:
        """Return the number of rejected frames by threat; rejected connections are counted as masquerades."""
        total: Counter[Threat] = Counter({Threat.MASQUERADE: self.masquerades})
        for receiver in self.receivers.values():
            total += receiver.threats
        return total

    def send(self, train: int, payload: bytes) -> None:
        """Send a payload to a train on each of its links."""
        data = self._encode(train, FrameKind.DATA, payload)
        for name in BEARERS:
            if (protocol := self._peers.get((train, name))) is not None:
                protocol.send(data)

    async def _watch(self) -> None:
        """Read the revoked certificates repeatedly, and end connections with revoked or expired certificates."""
        while True:
            try:
                self._revoked, self.alarm = read_revoked(self._keys), None
            except InputFileError as error:
                self.alarm = f"{error}; the certificates in the last readable list are still rejected"
            for protocol in self._peers.values():
                if protocol.peer is not None and (protocol.peer.valid_s < 0.0 or self._revoked.has(protocol.peer)):
                    protocol.reject()
            self._note_ending()
            await asyncio.sleep(RETRY_S)

    def _note_ending(self) -> None:
        """List certificates that expire within `WARNING_DAYS`: of the authority, the centre and connected trains."""
        limit = datetime.now(UTC) + timedelta(days=WARNING_DAYS)
        peers = {protocol.peer: None for protocol in self._peers.values() if protocol.peer is not None}
        soon = [ending_sentence(f"of {peer.name}", peer.ends) for peer in peers if peer.ends <= limit]
        self._ending = [*list_ending(self._keys, "centre"), *soon]

    def _masquerade(self) -> None:
        self.masquerades += 1

    def _encode(self, train: int, kind: FrameKind, payload: bytes) -> bytes:
        sequence = self._sequence[train, kind] = self._sequence.get((train, kind), 0) + 1
        now_ns = time.monotonic_ns()
        frame = Frame(
            kind=kind, sender=CENTRE, session=self._session, sequence=sequence, time_ns=now_ns, payload=payload
        )
        return frame.encode()

    def _echo(self, train: int, answered: Frame, received_ns: int) -> bytes:
        echo = Echo(answered.sequence, answered.time_ns, received_ns, answered_ns=time.monotonic_ns())
        return self._encode(train, FrameKind.ECHO, echo.encode())

    def _frame(self, name: LinkName, protocol: LinkProtocol, data: bytes) -> None:
        peer = protocol.peer
        kind, _, name_of_train = ("" if peer is None else peer.name).partition("-")
        if kind != "train" or not name_of_train.isdigit() or peer is None or self._revoked.has(peer):
            protocol.reject()
            return
        train, now_ns = int(name_of_train), time.monotonic_ns()
        receiver = self.receivers.setdefault(train, FrameReceiver(sender=train, limits=self._limits))
        answer, use = receiver.receive(name, data, now_ns)
        if answer is None:
            return
        self._peers[train, name], self.heard_s[train, name] = protocol, time.monotonic()
        protocol.answer(partial(self._echo, train, answer, now_ns))
        if use is not None:
            self._received(train, use.payload)
