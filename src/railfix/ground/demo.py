"""Demonstration of the ground side: two trains on a line with a passing loop, disturbed links, a satellite fault.

The demonstration runs the same control centre as ``railfix ground centre`` (`railfix.ground.control`), driven by the
clock of the simulated traffic.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, range_with_rotation
from railfix.core.settings import Settings
from railfix.ground.authority import Authority
from railfix.ground.centre import ReferenceCurve
from railfix.ground.control import ControlCentre, list_orders
from railfix.ground.fixes_at_stations import StationFixes, fixes_of_ranges
from railfix.ground.keys import write_keys
from railfix.ground.links import BEARERS, CentreLinks, LinkLimits, LinkName, TrainLinks, create_bearers, draw_coverage
from railfix.ground.on_board import OnBoard
from railfix.ground.store import Store
from railfix.ground.supervision import Supervision, at_start
from railfix.ground.traffic import SimulatedTrain, Traffic, line_with_loops
from railfix.ground.triangle import MonitorState, TriangleLimits, TriangleVerdict, compare_triangle
from railfix.ground.web import PageServer, Sessions, page_app
from railfix.io.train_message import TrainMessage, encode
from railfix.positioning.range_arrays import Ranges


class RelaySettings(Settings):
    """Settings of a relay's disturbances."""

    loss: float = Field(default=0.0, ge=0, le=1)  #: Probability that a datagram is lost.
    delay_s: float = Field(default=0.0, ge=0)  #: Delay of each datagram.
    #: Largest additional random delay of a datagram; because of this delay, datagrams may overtake each other.
    jitter_s: float = Field(default=0.0, ge=0)
    seed: int = 0


class LinkDisturbance:
    """Seeded disturbance of packets of any kind.

    `settings` may be replaced at any time. While `up` is False (an outage), every packet is lost.
    """

    def __init__(self, settings: RelaySettings) -> None:
        self.settings, self.up = settings, True
        self._random = random.Random(settings.seed)

    def packet(self, data: bytes, send: Callable[[bytes], None]) -> None:
        """Forward a packet by calling `send`, or drop the packet."""
        if not self.up or self._random.random() < self.settings.loss:
            return
        delay_s = self.settings.delay_s + self._random.uniform(0.0, self.settings.jitter_s)
        if delay_s > 0.0:
            asyncio.get_running_loop().call_later(delay_s, send, data)
        else:
            send(data)


class Relay(asyncio.DatagramProtocol):
    """Relay of UDP datagrams between one client and a target, with disturbances in both directions."""

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
        """Forward a datagram from the client."""
        self._client = addr
        self._pass(data, self._there, self._target)

    def back(self, data: bytes) -> None:
        """Forward a datagram from the target to the client."""
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


#: East and north coordinates of the three receivers [m].
PLAN_M: Floats = np.array([[0.0, 0.0], [800.0, 100.0], [300.0, 700.0]])
#: Elevations of the nine simulated satellites [deg].
ELEVATION_DEG = np.array([75.0, 50.0, 48.0, 35.0, 33.0, 25.0, 22.0, 18.0, 60.0])
#: Azimuths of the nine simulated satellites, clockwise from north [deg].
AZIMUTH_DEG = np.array([20.0, 80.0, 150.0, 215.0, 290.0, 340.0, 110.0, 250.0, 310.0])
TIME = np.datetime64("2024-03-05T00:00:00", "ns")


def points_ecef_m() -> Floats:
    """Return the known Earth-fixed positions of the receivers, shape (3, 3) [m]."""
    return ecef_from_geodetic(35.7, 139.7, 100.0) + PLAN_M @ enu_axes(35.7, 139.7)[:2]


def draw_fixes(
    rng: np.random.Generator, *, epochs: int = 60, common_m: Floats | None = None, moved_m: Floats | None = None
) -> StationFixes:
    """Return fixes, one per second, from simulated ranges to satellites that do not move.

    `common_m`, shape (T, 9), are satellite errors common to the receivers. `moved_m`, shape (T, 3, 2), are the east and
    north displacements of each receiver's fix; NaN means that the receiver has no fix, and that its C/N0 has fallen.
    """
    points, axes = points_ecef_m(), enu_axes(35.7, 139.7)
    el, az = np.radians(ELEVATION_DEG), np.radians(AZIMUTH_DEG)
    enu = np.stack([np.cos(el) * np.sin(az), np.cos(el) * np.cos(az), np.sin(el)], axis=1)
    satellites = points[0] + 2.2e7 * enu @ axes
    shape = (epochs, len(el))
    common = rng.normal(0.0, 0.5, (1, len(el))) + (0.0 if common_m is None else common_m)
    ranges = []
    for k in range(3):
        shift = np.zeros((epochs, 2)) if moved_m is None else moved_m[:, k]
        antenna = points[k] + shift @ axes[:2]
        distance, _ = range_with_rotation(satellites, antenna[:, None])
        code = distance + common + rng.normal(0.0, 0.4, shape) + rng.normal(0.0, 1e4)
        absent = ~np.isfinite(code)
        ranges.append(
            Ranges(
                sat_ecef_m=np.broadcast_to(satellites, (*shape, 3)),
                code_m=np.where(absent, 0.0, code),
                weight=np.where(absent, 0.0, 1.0),
                groups=(slice(0, len(el)),),
            )
        )
    fallen = np.isnan(np.zeros((epochs, 3)) if moved_m is None else moved_m[..., 0])
    time = TIME + np.arange(epochs) * np.timedelta64(1, "s")
    return fixes_of_ranges(time, ranges, points, cn0_fallen=fallen)


HOSTS: Final[dict[LinkName, str]] = {"A": "127.0.1.1", "B": "127.0.2.1"}
#: Start and end of the outage of bearer A, in simulated time [s].
OUTAGE_A_S: Final = (40.0, 80.0)
#: Start and end of the outage of both bearers of train 1, in simulated time [s].
OUTAGE_BOTH_S: Final = (106.0, 118.0)
FAULT_S: Final = 130.0  #: Simulated time at which the satellite fault begins [s].
END_S: Final = 170.0  #: Simulated time at which the demonstration ends [s].
_TIME_NS: Final = 1_400_000_000_000_000_000


@dataclass(kw_only=True)
class LinkedTraffic(Traffic):
    """Traffic whose messages are sent over the links to a `ControlCentre`."""

    links: dict[int, TrainLinks]
    control: ControlCentre
    verdicts: list[tuple[TriangleVerdict, int]]  #: Verdicts of the triangle, one per second.
    rest_s: float | None = None  #: Time at which all trains were at rest after a stop [s]; None before that.

    def step(self) -> None:
        """Run a step, and record the time at which all trains are at rest after a stop."""
        super().step()
        stopped = self.centre.state.stopped and all(t.speed_mps == 0.0 for t in self.trains.values())
        if stopped and self.rest_s is None:
            self.rest_s = self.now_s

    def send_report(self, message: TrainMessage) -> None:
        """Send the report of a train over its links."""
        train = self.trains[message.train]
        self.links[message.train].send(encode(message), chainage_m=train.front_m, direction=train.direction)

    def exchange(self) -> None:
        """Run the centre's monitoring and supervision."""
        if self.now_s == FAULT_S:
            self.control.log("simulated fault: the clock of a satellite drifts away")
        self.control.judge(*self.verdicts[min(int(self.now_s), len(self.verdicts) - 1)])
        self.control.step()


def _verdicts(seed: int) -> list[tuple[TriangleVerdict, int]]:
    """Return the verdicts of the triangle, one per second, with a drift of one satellite's range from `FAULT_S` on."""
    epochs = int(END_S) + 1
    common = np.zeros((epochs, 9))
    common[:, 3] = 8.0 * np.clip(np.arange(epochs) - FAULT_S, 0.0, None)
    fixes = draw_fixes(np.random.default_rng(seed), epochs=epochs, common_m=common)
    result = compare_triangle(PLAN_M, fixes.fixes_m, limits=TriangleLimits())
    return [(TriangleVerdict(int(v)), int(r)) for v, r in zip(result.verdict, result.receiver, strict=True)]


def _traffic(
    seed: int, store: Store, links: dict[int, TrainLinks], send: Callable[[int, bytes], None]
) -> LinkedTraffic:
    """Return the traffic of a line with a train at each end."""
    layout = line_with_loops(3)
    trains, supervised = {}, []
    for number, direction, station, track, front in ((1, 1, 0, 1, 400.0), (2, -1, 2, 2, 3100.0)):
        train = trains[number] = SimulatedTrain(
            number=number, front_m=front, tracks={station: track}, on_board=OnBoard(direction=direction, end_m=front)
        )
        supervised.append(train.at_rest())
    stops = np.array([420.0, 1920.0, 3420.0])
    curves = {
        1: ReferenceCurve.between_stations(stops, speed_mps=22.0),
        -1: ReferenceCurve.between_stations(3500.0 - stops, speed_mps=22.0),
    }
    supervision = Supervision(layout=layout, state=at_start(layout, supervised))
    control = ControlCentre(
        supervision=supervision, store=store, curves=curves, send=send, clock=lambda: run.now_s,
        wall_ns=lambda: _TIME_NS + round(run.now_s * 1e9), monitor=MonitorState(stopped=False),
    )  # fmt: skip
    run = LinkedTraffic(
        trains=trains, centre=supervision, random=random.Random(seed), verdicts=_verdicts(seed), links=links,
        control=control,
    )  # fmt: skip
    return run


async def run_demo(
    *,
    seed: int = 1,
    speed: float = 8.0,
    port: int = 0,
    password: str,
    announce: Callable[[str], None] = lambda _: None,
    keep: Callable[[str], Any] | None = None,
    picture: Path | None = None,
) -> dict[str, Any]:
    """Run the demonstration and return its results by name.

    `speed` is in simulated seconds per second. The page is served on the loopback address at `port` (0 selects a free
    port), and `password` permits the release of a stop. `announce` and, before the page closes, the coroutine function
    `keep` are called with the page's address. `picture` is the path at which the picture of response rates along the
    line is written.
    """
    async with contextlib.AsyncExitStack() as held:
        folder, done = Path(held.enter_context(tempfile.TemporaryDirectory())), False
        write_keys(folder / "keys", [1, 2])
        trains: dict[int, TrainLinks] = {}
        centre = CentreLinks(folder / "keys", HOSTS, received=lambda n, payload: control.report(n, payload))
        store = held.enter_context(Store(f"sqlite:///{folder / 'centre.db'}"))
        traffic = _traffic(seed, store, trains, centre.send)
        control = traffic.control

        def snapshot() -> dict[str, Any]:
            links = [
                {"train": n, "bearer": bearer, "rate": _number(meter.response_rate), "misses": meter.misses,
                 "round_trip_ms": _number(1e3 * meter.round_trip_s)}
                for n, train in trains.items()
                for bearer, meter in train.meters.items()
            ]  # fmt: skip
            return {**control.snapshot(), "links": links, "alarms": control.alarms, "done": done}

        page = PageServer(page_app(snapshot, list_orders(control), sessions=Sessions(password=password)), port=port)
        await page.start()
        held.push_async_callback(page.stop)
        await centre.start()
        held.push_async_callback(centre.stop)
        relays = await _relays(centre, seed)
        for relay in relays.values():
            held.callback(relay.close)
        for number in (1, 2):
            links = trains[number] = TrainLinks(
                number,
                folder / "keys",
                create_bearers(
                    {bearer: relays[number, bearer].address for bearer in BEARERS},
                    {"A": f"127.0.1.{10 + number}", "B": f"127.0.2.{10 + number}"},
                ),
                received=lambda payload: traffic.authority(Authority.decode(payload)),
                limits=LinkLimits(idle_s=10.0),  # longer than the outages in real time
            )
            await links.start()
            held.push_async_callback(links.stop)
        announce(page.url)
        await _connect(trains)
        await _run(traffic, relays, speed)
        done = True
        figures = _figures(traffic, trains, centre)
        if picture is not None:
            draw_coverage(picture, {b: [links.meters[b] for links in trains.values()] for b in BEARERS})
        if keep is not None:
            await keep(page.url)
        return figures


async def _relays(centre: CentreLinks, seed: int) -> dict[tuple[int, LinkName], Relay]:
    """Open relays that disturb the links to the centre; return them by train and bearer."""
    relays = {}
    for number in (1, 2):
        for k, bearer in enumerate(BEARERS):
            disturbed = RelaySettings(loss=0.1, delay_s=0.02, jitter_s=0.02, seed=seed + 10 * number + k)
            relays[number, bearer] = Relay(centre.addresses[bearer], disturbed)
            await relays[number, bearer].open(HOSTS[bearer])
    return relays


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None


async def _connect(trains: dict[int, TrainLinks]) -> None:
    for _ in range(500):
        if all(len(links.protocols) == len(BEARERS) for links in trains.values()):
            return
        await asyncio.sleep(0.01)


async def _run(traffic: LinkedTraffic, relays: dict[tuple[int, LinkName], Relay], speed: float) -> None:
    loop = asyncio.get_running_loop()
    start = loop.time()
    while traffic.now_s < END_S:
        now = traffic.now_s
        both = OUTAGE_BOTH_S[0] <= now < OUTAGE_BOTH_S[1]
        for (number, bearer), relay in relays.items():
            alone = OUTAGE_A_S[0] <= now < OUTAGE_A_S[1] and bearer == "A"
            relay.disturbance.up = not (alone or (both and number == 1))
        traffic.step()
        # Time lost on a busy machine is not caught up, because the links cannot follow a faster simulated time.
        start = max(start, loop.time() - traffic.now_s / speed)
        await asyncio.sleep(start + traffic.now_s / speed - loop.time())


def _figures(traffic: LinkedTraffic, trains: dict[int, TrainLinks], centre: CentreLinks) -> dict[str, Any]:
    control, monitor = traffic.control, traffic.control.monitor
    return {
        "simulated time [s]": traffic.now_s,
        "routes set": traffic.centre.routes_set,
        "reports used": control.reports,
        "reports sent": sum(train.sequence for train in traffic.trains.values()),
        **{
            f"train {n}, bearer {bearer}: response rate": round(meter.response_rate, 2)
            for n, links in trains.items()
            for bearer, meter in links.meters.items()
        },
        "times that a position was simulated": sum(line.endswith(": simulated") for line in control.lines),
        "satellite fault begins [s]": FAULT_S,
        "cause": None if monitor is None or monitor.cause is None else monitor.cause.name.lower(),
        "suspended and stop ordered [s]": control.stop_s,
        "both trains at rest [s]": traffic.rest_s,
        "frames rejected": {threat.value: n for threat, n in sorted(centre.threats().items(), key=str) if n},
        "invariants broken": dict(traffic.violations),
    }
