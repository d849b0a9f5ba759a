"""Demonstration of the ground side: two trains on a line with a passing loop, real links, and a satellite fault."""

from __future__ import annotations

import asyncio
import random
import struct
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from railfix.ground.centre import CentreLimits, TrainRecord, TrainState, time_passed
from railfix.ground.centre import report_received as record_received
from railfix.ground.interlocking import Interlocking, PointState, TrainInterval, interval_of
from railfix.ground.interlocking_text import to_json
from railfix.ground.keys import write_keys
from railfix.ground.link_figure import draw_coverage
from railfix.ground.link_quality import LinkName
from railfix.ground.links import BEARERS, CentreLinks, TrainLinks
from railfix.ground.monitor import MonitorLimits, MonitorState, Order, advance, release
from railfix.ground.reference_curve import ReferenceCurve
from railfix.ground.relay import Relay, RelaySettings
from railfix.ground.simulated_triangle import PLAN_M, simulated_fixes
from railfix.ground.store import Store
from railfix.ground.traffic import Conditions, SimulatedTrain, Traffic, line_with_loops
from railfix.ground.triangle import TriangleLimits, Verdict, compare_triangle
from railfix.ground.web import PageServer, page_app
from railfix.io.train_message import MessageError, TrainMessage, decode, encode

_AUTHORITY: Final = struct.Struct("!Qbd?")
HOSTS: Final[dict[LinkName, str]] = {"A": "127.0.1.1", "B": "127.0.2.1"}
#: Simulated seconds: bearer A is out of service, both are, the satellite fault begins, the end.
OUTAGE_A_S: Final = (40.0, 80.0)
OUTAGE_BOTH_S: Final = (106.0, 118.0)
FAULT_S: Final = 130.0
END_S: Final = 170.0


@dataclass(kw_only=True)
class LinkedTraffic(Traffic):
    """Traffic whose messages go over the links, with the records, the monitor and the store of a centre.

    Attributes
    ----------
    send_report, send_authority : callable
        Of the links.
    """

    send_report: Callable[[TrainMessage, SimulatedTrain], None]
    send_authority: Callable[[int, bytes], None]
    store: Store
    curves: dict[int, ReferenceCurve]
    verdicts: list[tuple[Verdict, int]]
    monitor: MonitorState = field(default_factory=lambda: MonitorState(stopped=False))
    records: dict[int, TrainRecord] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)
    figures: dict[str, float] = field(default_factory=dict)
    reports: int = 0

    def log(self, text: str, *, train: int | None = None) -> None:
        """Write a line of the log."""
        self.lines.append(f"{self.now_s:.0f} s: {text}")
        self.store.note(round(self.now_s * 1e9), text, train=train)

    def step(self) -> None:
        """Run a step, then the monitor and the shown places."""
        routes = {n: t.station for n, t in self.state.trains.items()}
        super().step()
        for number, train in self.state.trains.items():
            if train.station != routes[number]:
                name = self.layout.stations[train.station].name
                self.log(f"train {number}: route to {name}, track {train.tracks[train.station]}", train=number)
        if self.now_s == FAULT_S:
            self.log("simulated fault: the clock of a satellite drifts away")
        verdict, receiver = self.verdicts[min(int(self.now_s), len(self.verdicts) - 1)]
        self.monitor, orders = advance(self.monitor, self.now_s, verdict, receiver=receiver, limits=MonitorLimits())
        for order in orders:
            self.log(f"triangle: {order.value}")
            if order is Order.STOP:
                self.figures["stop ordered"] = self.now_s
                self.state = replace(self.state, stopped=True)
        if self.monitor.stopped and all(t.speed_mps == 0.0 for t in self.trains.values()):
            self.figures.setdefault("trains at rest", self.now_s)
        for number, record in self.records.items():
            end = self.state.trains[number].end_m
            after = time_passed(record, self.now_s, curves=self.curves, authority_m=end, limits=CentreLimits())
            if after.state is not record.state:
                self.log(f"train {number}: {after.state.value}", train=number)
            self.records[number] = after
        self.store.save_document("interlocking", to_json(self.state))

    def _send_report(self, message: TrainMessage) -> None:
        self.send_report(message, self.trains[message.train])

    def _send_authority(self, number: int, grant: int, direction: int, end_m: float) -> None:
        self.send_authority(number, _AUTHORITY.pack(grant, direction, end_m, self.state.stopped))

    def report(self, number: int, payload: bytes) -> None:
        """Take a report from the links: stored first, then used."""
        try:
            message = decode(payload)
        except MessageError:
            return
        record = self.records.get(number, TrainRecord(train=number))
        after, reason = record_received(record, message, self.now_s, limits=CentreLimits())
        if reason is not None:
            return
        self.reports += 1
        if record.state in (TrainState.SIMULATED, TrainState.ERROR):
            self.log(f"train {number}: heard again, place jumps by {after.jump_m:.1f} m", train=number)
        self.store.save(after)
        self.records[number] = after
        self._report(message)

    def authority(self, number: int, payload: bytes) -> None:
        """Take an authority from the links on board."""
        if len(payload) == _AUTHORITY.size:
            grant, direction, end, stopped = _AUTHORITY.unpack(payload)
            self._authority(number, grant, direction, end, stopped=stopped)

    def release(self) -> str | None:
        """Release a stop by hand; return the reason of a refusal."""
        self.monitor, orders, reason = release(self.monitor, self.now_s, limits=MonitorLimits())
        if orders:
            self.state = replace(self.state, stopped=False)
            self.log("stop released by hand")
        return reason

    def snapshot(self) -> dict[str, Any]:
        """Return plain values of trains, points and log for the page."""
        verdict = self.verdicts[min(int(self.now_s), len(self.verdicts) - 1)][0]
        trains = []
        for number, train in self.state.trains.items():
            record = self.records.get(number, TrainRecord(train=number))
            rear, front = interval_of(train)
            pieces = self.layout.pieces(rear, front, train.tracks)
            speed = 0 if record.message is None else record.message.speed_cmps or 0
            trains.append({
                "number": number, "state": record.state.value, "shown": record.shown_m, "speed": abs(speed) / 100.0,
                "direction": train.direction, "rear": rear, "front": front, "end": train.end_m, "jump": record.jump_m,
                "pieces": [[0 if lane == 0 else 2 - lane % 2, low, high] for lane, low, high in pieces],
            })  # fmt: skip
        points = [
            {"name": f"{self.layout.stations[k].name} {'lower' if side < 0 else 'upper'}", "wanted": point.wanted,
             "detected": point.detected, "locked": list(point.locked)}
            for (k, side), point in self.state.points.items()
        ]  # fmt: skip
        cause = None if self.monitor.cause is None else self.monitor.cause.name.lower().replace("_", " ")
        return {
            "now": self.now_s, "trains": trains, "points": points, "log": self.lines[:-25:-1],
            "stations": [{"name": s.name, "begin": s.begin_m, "end": s.end_m, "points": s.points_m}
                         for s in self.layout.stations],
            "monitor": {"verdict": verdict.name.lower(), "stopped": self.monitor.stopped, "cause": cause},
        }  # fmt: skip


def _verdicts(seed: int) -> list[tuple[Verdict, int]]:
    """Return the verdicts of the triangle, one a second; a satellite drifts away from `FAULT_S` on."""
    epochs = int(END_S) + 1
    common = np.zeros((epochs, 9))
    common[:, 3] = 8.0 * np.clip(np.arange(epochs) - FAULT_S, 0.0, None)
    fixes = simulated_fixes(np.random.default_rng(seed), epochs=epochs, common_m=common)
    result = compare_triangle(PLAN_M, fixes.fixes_m, limits=TriangleLimits())
    return [(Verdict(int(v)), int(r)) for v, r in zip(result.verdict, result.receiver, strict=True)]


def _traffic(seed: int, store: Store, **links: Any) -> LinkedTraffic:
    """Return the line with a train at each end."""
    layout = line_with_loops(3)
    trains, supervised = {}, {}
    for number, direction, station, track, front in ((1, 1, 0, 1, 400.0), (2, -1, 2, 2, 3100.0)):
        trains[number] = SimulatedTrain(
            number=number, direction=direction, front_m=front, tracks={station: track}, end_m=front
        )
        ahead = front + 5.0 * direction
        supervised[number] = TrainInterval(
            train=number, direction=direction, rear_m=trains[number].rear_m - 5.0 * direction, front_m=ahead,
            end_m=ahead, sequence=0, tracks={station: track}, station=station,
        )  # fmt: skip
    stops = np.array([420.0, 1920.0, 3420.0])
    curves = {
        1: ReferenceCurve.between_stations(stops, speed_mps=22.0),
        -1: ReferenceCurve.between_stations(3500.0 - stops, speed_mps=22.0),
    }
    return LinkedTraffic(
        layout=layout, trains=trains, random=random.Random(seed), store=store, curves=curves,
        state=Interlocking(trains=supervised, points={name: PointState() for name in layout.points()}),
        conditions=Conditions(outage=0.0, restart=0.0, blind=0.0), verdicts=_verdicts(seed), **links,
    )  # fmt: skip


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
    """Run the demonstration and return its figures.

    Parameters
    ----------
    seed : int
    speed : float
        Simulated seconds a second.
    port : int
        Of the page, on the loopback address; 0 takes a free one.
    password : str
        For the release of a stop on the page.
    announce : callable
        Called with the address of the page.
    keep : callable, optional
        Awaited with the address at the end, before the page closes.
    picture : Path, optional
        Picture of the response rates along the line.
    """
    with tempfile.TemporaryDirectory() as name:
        folder, done = Path(name), False
        write_keys(folder / "keys", [1, 2])
        trains: dict[int, TrainLinks] = {}
        centre = CentreLinks(folder / "keys", HOSTS, received=lambda n, payload: traffic.report(n, payload))
        store = Store(f"sqlite:///{folder / 'centre.db'}")
        traffic = _traffic(
            seed,
            store,
            send_report=lambda m, t: trains[m.train].send(encode(m), chainage_m=t.front_m, direction=t.direction),
            send_authority=centre.send,
        )

        def snapshot() -> dict[str, Any]:
            links = [
                {"train": n, "bearer": bearer, "rate": _number(meter.response_rate), "misses": meter.misses,
                 "round_trip_ms": _number(1e3 * meter.round_trip_s)}
                for n, train in trains.items()
                for bearer, meter in train.meters.items()
            ]  # fmt: skip
            return {**traffic.snapshot(), "links": links, "done": done}

        page = PageServer(page_app(snapshot, traffic.release, password=password), port=port)
        await centre.start()
        relays: dict[tuple[int, LinkName], Relay] = {}
        for number in (1, 2):
            for k, bearer in enumerate(BEARERS):
                disturbed = RelaySettings(loss=0.1, delay_s=0.02, jitter_s=0.02, seed=seed + 10 * number + k)
                relays[number, bearer] = Relay(centre.addresses[bearer], disturbed)
                await relays[number, bearer].open(HOSTS[bearer])
            local: dict[LinkName, str] = {"A": f"127.0.1.{10 + number}", "B": f"127.0.2.{10 + number}"}
            trains[number] = TrainLinks(
                number,
                folder / "keys",
                {bearer: relays[number, bearer].address for bearer in BEARERS},
                local,
                received=lambda payload, number=number: traffic.authority(number, payload),  # type: ignore[misc]
            )
        try:
            for links in trains.values():
                await links.start()
            await page.start()
            announce(page.url)
            await _connected(trains)
            await _run(traffic, relays, speed)
            done = True
            figures = _figures(traffic, trains, centre)
            if picture is not None:
                draw_coverage(picture, {b: [links.meters[b] for links in trains.values()] for b in BEARERS})
            if keep is not None:
                await keep(page.url)
        finally:
            for links in trains.values():
                await links.stop()
            await centre.stop()
            for relay in relays.values():
                relay.close()
            await page.stop()
            store.close()
        return figures


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None


async def _connected(trains: dict[int, TrainLinks]) -> None:
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
            relay.up = not (alone or (both and number == 1))
        traffic.step()
        await asyncio.sleep(max(0.0, start + traffic.now_s / speed - loop.time()))


def _figures(traffic: LinkedTraffic, trains: dict[int, TrainLinks], centre: CentreLinks) -> dict[str, Any]:
    """Return what happened, by name."""
    stop, rest = traffic.figures.get("stop ordered"), traffic.figures.get("trains at rest")
    return {
        "simulated time [s]": traffic.now_s,
        "routes set": traffic.arrivals,
        "reports used": traffic.reports,
        "reports sent": sum(train.sequence for train in traffic.trains.values()),
        **{
            f"train {n}, bearer {bearer}: response rate": round(meter.response_rate, 2)
            for n, links in trains.items()
            for bearer, meter in links.meters.items()
        },
        "times shown by simulated running": sum("simulated" in line for line in traffic.lines),
        "satellite fault begins [s]": FAULT_S,
        "cause": None if traffic.monitor.cause is None else traffic.monitor.cause.name.lower(),
        "suspended and stop ordered [s]": stop,
        "both trains at rest [s]": rest,
        "frames rejected": {threat.value: n for threat, n in sorted(centre.threats().items(), key=str) if n},
        "invariants broken": dict(traffic.violations),
    }
