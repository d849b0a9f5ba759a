"""``railfix ground centre`` and ``railfix ground train``: killed and started again, routes by hand, wrong files."""

from __future__ import annotations

import asyncio
import json
import random
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import AsyncIterator, Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from postgresql_server import Server
from railfix.cli.ground import app
from railfix.ground.authority import Authority, BrakeOrder
from railfix.ground.centre import ReferenceCurve
from railfix.ground.control import ControlCentre, list_orders
from railfix.ground.field import SimulatedPoints
from railfix.ground.keys import write_keys
from railfix.ground.links import BEARERS, LinkLimits, TrainLinks, create_bearers
from railfix.ground.on_board import OnBoard, OnBoardLimits
from railfix.ground.serve import STEP_S, _work, run_centre
from railfix.ground.state import HEAD, Interlocking, TrainInterval, from_documents
from railfix.ground.store import Store
from railfix.ground.supervision import Supervision, at_start, standing_train
from railfix.ground.traffic import SimulatedTrain, line_with_loops
from railfix.ground.train import run_train
from railfix.ground.triangle import MonitorLimits, TriangleVerdict
from railfix.io.train_message import MessageStatus, SuspectedInterference, encode, to_json
from test_ground_demo import Browser

pytestmark = pytest.mark.requirement("F2")

HOSTS = {"A": "127.0.1.1", "B": "127.0.2.1"}
LOCAL = {"A": "127.0.1.31", "B": "127.0.2.31"}


def free_port(host: str) -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((host, 0))
        return int(probe.getsockname()[1])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keys and the file of a centre: a line of three stations, train 1 in the first."""
    folder = tmp_path_factory.mktemp("centre")
    write_keys(folder / "keys", [1])
    ports = {name: free_port(host) for name, host in HOSTS.items()}
    stations = ", ".join(
        f'{{ name = "{s.name}", begin_m = {s.begin_m}, end_m = {s.end_m} }}' for s in line_with_loops(3).stations
    )
    (folder / "line.toml").write_text(f"""
keys = "keys"
listen = {{ A = "{HOSTS["A"]}:{ports["A"]}", B = "{HOSTS["B"]}:{ports["B"]}" }}
stations = [{stations}]
trains = [{{ number = 1, station = "A", track = 1, direction = 1, front_m = 300, length_m = 80, bound_m = 5 }}]
""")
    (folder / "password").write_text("secret\n")
    (folder / "password").chmod(0o600)
    return folder


def addresses(folder: Path) -> dict[str, tuple[str, int]]:
    line = next(line for line in (folder / "line.toml").read_text().splitlines() if line.startswith("listen"))
    texts = [part.split('"')[1] for part in line.split("=", 1)[1].split(",")]
    return {name: (text.split(":")[0], int(text.split(":")[1])) for name, text in zip(BEARERS, texts, strict=True)}


def started(folder: Path, *options: str) -> subprocess.Popen[str]:
    """A centre that has printed the address of its page."""
    words = [sys.executable, "-m", "railfix", "ground", "centre", str(folder / "line.toml"), "--page", "127.0.0.1:0"]
    words += ["--password", str(folder / "password"), "--for", "60", *options]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    line = process.stdout.readline()
    assert "http://127.0.0.1:" in line, line + process.stdout.read()
    return process


@pytest.mark.parametrize("kills", [pytest.param(100, marks=pytest.mark.slow)])
def test_a_killed_centre_keeps_what_its_trains_know(folder: Path, tmp_path: Path, kills: int) -> None:
    """Reports that an authority has acknowledged, the authority itself, and its number are in the store."""
    rng = random.Random(kills)
    database = tmp_path / "centre.db"
    source = (folder / "line.toml").read_text().replace('"keys"', f'"{folder / "keys"}"')
    (tmp_path / "line.toml").write_text(f'database = "{database}"\n{source}')
    (tmp_path / "password").write_bytes((folder / "password").read_bytes())
    (tmp_path / "password").chmod(0o600)

    async def work() -> None:
        train = SimulatedTrain(
            number=1, front_m=300.0, tracks={0: 1}, on_board=OnBoard(direction=1, end_m=300.0), length_m=80.0,

        )  # fmt: skip
        newest: list[Authority] = []
        sent: set[int] = set()

        def received(payload: bytes) -> None:
            authority = Authority.decode(payload)
            assert authority.report in sent | {0}
            assert train.on_board.receive(authority)
            newest.append(authority)

        limits = LinkLimits(idle_s=2.0)
        links = TrainLinks(
            1, folder / "keys", create_bearers(addresses(folder), LOCAL), received=received, limits=limits
        )
        await links.start()
        process = await asyncio.to_thread(started, tmp_path)
        running.append(process)
        for kill in range(kills):
            end = asyncio.get_running_loop().time() + rng.uniform(0.0, 2.0)
            before = len(newest)
            while asyncio.get_running_loop().time() < end or len(newest) < before + 1:
                message = train.message(time.monotonic())
                train.front_m = max(train.front_m, min(train.front_m + 4.0, train.on_board.end_m - 10.0))
                sent.add(message.sequence)
                links.send(encode(message))
                await asyncio.sleep(rng.uniform(0.1, 0.3))
                assert asyncio.get_running_loop().time() < end + 40.0, "the centre does not answer"
            process.send_signal(signal.SIGKILL)
            process.communicate()
            with Store(f"sqlite:///{database}") as store:
                stored, state = store.records()[1], from_documents(store.documents(HEAD))
                last = store.log(last=10_000)
            known = [authority for authority in newest if not isinstance(authority, BrakeOrder)][-1]
            assert stored.sequence >= known.report
            assert stored.sequence in sent
            assert state.granted >= known.number
            assert state.trains[1].end_m >= known.end_cm / 100.0
            assert state.trains[1].rear_m <= train.rear_m
            assert sum(text.startswith("centre started") for _, _, text in last) == kill + 1
            process = await asyncio.to_thread(started, tmp_path)
            running[0] = process
        before = len(newest)
        for _ in range(400):
            if len(newest) > before:
                break
            message = train.message(time.monotonic())
            sent.add(message.sequence)
            links.send(encode(message))
            await asyncio.sleep(0.1)
        assert len(newest) > before
        assert [a.number for a in newest] == sorted({a.number for a in newest})
        # end of the track in B, less the margin; of that in C where there is time to get to B
        assert max(a.end_cm for a in newest) in (192_000, 342_000)[: 1 if kills == 1 else 2]
        await links.stop()
        process.terminate()
        output, _ = await asyncio.to_thread(process.communicate)
        assert process.returncode == 143, output
        assert "reports used" in output

    running: list[subprocess.Popen[str]] = []
    try:
        asyncio.run(asyncio.wait_for(work(), 60.0 + 40.0 * kills))
    finally:
        for process in running:
            if process.poll() is None:
                process.kill()
                process.communicate()


def test_positions_go_to_the_centre_and_authorities_come_back(folder: Path, tmp_path: Path) -> None:
    """``railfix ground train``: it brakes until it has a fresh authority, and again without one."""
    simulated = SimulatedTrain(number=9, front_m=300.0, tracks={0: 1}, on_board=OnBoard(direction=1, end_m=300.0))
    source = (folder / "line.toml").read_text().replace('"keys"', f'"{folder / "keys"}"')
    (tmp_path / "line.toml").write_text(source)
    lines: list[dict[str, Any]] = []

    async def positions() -> AsyncIterator[str]:
        while True:
            yield to_json(simulated.message(0.0)) + "\n"
            await asyncio.sleep(0.1)

    async def work() -> None:
        begun = asyncio.Event()
        centre = asyncio.create_task(
            run_centre(tmp_path / "line.toml", password="secret", announce=lambda _: begun.set())
        )
        await begun.wait()
        train = asyncio.create_task(
            run_train(
                1, folder / "keys", create_bearers(addresses(folder), LOCAL), lines=positions(),
                limits=OnBoardLimits(fresh_s=4.0), write=lambda line: lines.append(json.loads(line)),
            )
        )  # fmt: skip
        for task, done in (
            (centre, lambda: {"brake": False, "reason": None} in lines and len(lines) > 3),
            (train, lambda: lines[-1].get("brake")),
        ):
            while not done():
                await asyncio.sleep(0.02)
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task

    asyncio.run(asyncio.wait_for(work(), 60.0))
    assert lines[0] == {"brake": True, "reason": "no fresh authority"}
    authority = next(line for line in lines if "end_cm" in line)
    assert (authority["train"], authority["direction"], authority["stopped"]) == (1, 1, False)
    assert authority["age_s"] < 4.0
    assert {"brake": False, "reason": None} in lines
    assert lines[-1] == {"brake": True, "reason": "no fresh authority"}


def test_a_train_whose_positions_end_waits_for_its_last_answer(folder: Path, tmp_path: Path) -> None:
    simulated = SimulatedTrain(number=1, front_m=300.0, tracks={0: 1}, on_board=OnBoard(direction=1, end_m=300.0))
    (tmp_path / "line.toml").write_text((folder / "line.toml").read_text().replace('"keys"', f'"{folder / "keys"}"'))
    lines: list[dict[str, Any]] = []

    async def positions() -> AsyncIterator[str]:
        yield to_json(simulated.message(0.0)) + "\n"

    async def work() -> tuple[int, int]:
        begun = asyncio.Event()
        centre = asyncio.create_task(
            run_centre(tmp_path / "line.toml", password="secret", announce=lambda _: begun.set())
        )
        await begun.wait()
        counts = await run_train(
            1, folder / "keys", create_bearers(addresses(folder), LOCAL), lines=positions(),
            limits=OnBoardLimits(mode="spare"), write=lambda line: lines.append(json.loads(line)),
        )  # fmt: skip
        centre.cancel()
        with suppress(asyncio.CancelledError):
            await centre
        return counts

    reports, authorities = asyncio.run(asyncio.wait_for(work(), 60.0))
    assert reports == 1
    assert authorities > 0
    assert any(line.get("report") == 1 for line in lines)


@pytest.mark.parametrize("taken", ["page", "bearer B"])
def test_an_address_that_is_in_use_is_named(folder: Path, tmp_path: Path, taken: str) -> None:
    (tmp_path / "line.toml").write_text((folder / "line.toml").read_text().replace('"keys"', f'"{folder / "keys"}"'))
    host, port = addresses(folder)["B"]
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM if taken == "page" else socket.SOCK_DGRAM) as other:
        other.bind((host, port))
        page = f"{host}:{port}" if taken == "page" else "127.0.0.1:0"
        done = CliRunner().invoke(app, ["centre", str(tmp_path / "line.toml"), "--page", page, "--for", "1"])
    assert done.exit_code == 4
    named = f"cannot listen at {host}:{port} (Address already in use); end the program that listens there"
    assert named in " ".join(done.output.split())


@pytest.mark.slow
def test_a_centre_ends_within_a_second(folder: Path) -> None:
    """With a page that is open, whose events have no end."""
    process = started(folder)
    try:
        begin = time.monotonic()
        process.send_signal(signal.SIGTERM)
        assert process.wait(10.0) == 128 + signal.SIGTERM
        assert time.monotonic() - begin < 1.0
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_a_train_ends_within_a_second(folder: Path, number: signal.Signals) -> None:
    """With its input open and silent, and no centre there."""
    words = [sys.executable, "-m", "railfix", "ground", "train", "1", "--keys", str(folder / "keys")]
    for host, port in addresses(folder).values():
        words += ["--centre", f"{host}:{port}"]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    placed = SimulatedTrain(number=1, front_m=300.0, tracks={0: 1}, on_board=OnBoard(direction=1, end_m=300.0))
    process.stdin.write(to_json(placed.message(0.0)) + "\n")
    process.stdin.flush()
    assert json.loads(process.stdout.readline()) == {"brake": True, "reason": "no fresh authority"}
    begin = time.monotonic()
    process.send_signal(number)
    try:
        assert process.wait(10.0) == 128 + number
    finally:
        process.kill()
        process.communicate()
    assert time.monotonic() - begin < 1.0


def test_steps_that_are_too_long_leave_half_of_the_time_to_the_links() -> None:
    """Each turn of the event loop takes in one frame; with a step a turn, a busy centre hears nothing any more."""
    steps, turns, long_s = [], [], 1.5 * STEP_S

    class Slow:
        def step(self) -> None:
            steps.append(len(turns))
            time.sleep(long_s)

    async def frames() -> None:
        while True:
            turns.append(1)
            await asyncio.sleep(0.001)

    async def session() -> None:
        control: Any = Slow()
        working = asyncio.create_task(_work(control, SimulatedPoints(move_s=5.0, clock=time.monotonic)))
        coming = asyncio.create_task(frames())
        await asyncio.sleep(7.0 * long_s)
        for task in (working, coming):
            task.cancel()

    asyncio.run(session())
    assert 2 <= len(steps) <= 5
    assert all(later - before > 5 for before, later in pairwise(steps))


@pytest.fixture
def centre(tmp_path: Path) -> Iterator[tuple[ControlCentre, list[Authority], list[float]]]:
    """A centre by hand: train 1 up in A, train 2 down in C, routes by hand; what it sends, and its clock."""
    layout, sent, now = line_with_loops(3), [], [100.0]
    with Store(f"sqlite:///{tmp_path / 'centre.db'}") as store:
        yield restored(store, layout_state(), sent, now), sent, now
    assert layout == line_with_loops(3)


def layout_state() -> Interlocking:
    def standing(train: int, direction: int, front: float, station: int) -> TrainInterval:
        return standing_train(
            train, direction=direction, front_m=front, length_m=80.0, bound_m=5.0, station=station, track=train
        )

    return at_start(line_with_loops(3), [standing(1, 1, 400.0, 0), standing(2, -1, 3100.0, 2)])


def restored(store: Store, state: Interlocking, sent: list[Authority], now: list[float]) -> ControlCentre:
    moved: list[Any] = []
    asked: list[Any] = []
    supervision = Supervision(
        layout=line_with_loops(3), state=state, command=lambda point, _: moved.append(point), routes="by hand"
    )
    control = ControlCentre.restore(
        supervision, store, judged=True, curves={}, send=lambda _, data: sent.append(Authority.decode(data)),
        clock=lambda: now[0], wall_ns=lambda: 0, times=MonitorLimits(healthy_s=5.0), ask=asked.append,
    )  # fmt: skip
    control.asked = asked  # type: ignore[attr-defined]
    control.moved = moved  # type: ignore[attr-defined]
    return control


@pytest.mark.requirement("F5")
def test_routes_and_the_release_by_hand(centre: tuple[ControlCentre, list[Authority], list[float]]) -> None:
    control, sent, now = centre
    orders = list_orders(control)

    def seconds(count: int, verdict: TriangleVerdict | None) -> None:
        for _ in range(count):
            now[0] += 1.0
            if verdict is not None:
                control.judge(verdict)
            control.step()

    seconds(1, TriangleVerdict.HEALTHY)
    assert sent[-1].stopped  # a first start has to be released
    assert orders["route"]({"train": 1}) == "satellite positioning is suspended"
    assert (orders["release"]({}) or "").startswith("fixes are healthy for 0 s")
    seconds(6, TriangleVerdict.HEALTHY)
    assert orders["release"]({}) is None
    seconds(1, TriangleVerdict.HEALTHY)
    assert not sent[-1].stopped
    assert {a.train: a.end_cm for a in sent[-2:]} == {1: 42_000, 2: 308_000}  # no route without an order
    assert orders["route"]({"train": "1"}) == "train: a number was expected"
    assert orders["route"]({"train": 5}) == "no such train: 5"
    assert orders["route"]({"train": 1}) is None
    seconds(1, TriangleVerdict.HEALTHY)
    assert sent[-2].end_cm == 192_000
    assert "A" in control.point_name((0, 1))
    for line in (
        "stop released by hand",
        'order of the page: route {"train": 1}: done',
        "train 1: route to B, track 1",
    ):
        assert any(line in text for text in control.lines)

    seconds(4, None)  # nothing judges any more
    assert sent[-1].stopped
    assert control.snapshot()["monitor"] == {"verdict": "no verdict", "stopped": True, "cause": "monitor lost"}
    control.supervision.state = replace(
        control.supervision.state,
        points={
            **control.supervision.state.points,
            (1, -1): replace(control.supervision.state.points[1, -1], detected=None),
        },
    )
    seconds(1, None)
    again = restored(control.store, layout_state(), sent, now)  # as after a kill
    assert (again.monitor.stopped, again.monitor.cause) == (True, TriangleVerdict.MONITOR_LOST)
    assert again.supervision.state.trains[1].end_m == 1920.0
    numbers = [a.number for a in sent]
    again.step()
    assert sent[-1].number > max(numbers)
    assert sent[-1].stopped
    # what was detected before is not believed: the field is asked; nothing is commanded under an interval
    assert set(again.asked) == set(again.supervision.layout.points())  # type: ignore[attr-defined]
    assert {point.detected for point in again.supervision.state.points.values()} == {None}
    for name in again.asked:  # type: ignore[attr-defined]
        again.supervision.set_detected(name, 2 if name == (1, -1) else 1)
    again.step()
    assert again.moved == []  # type: ignore[attr-defined]
    assert again.supervision.state.trains[1].stop == "points of its route are detected in another position"
    assert again.supervision.state.trains[2].stop is None


def test_an_order_to_stop_is_acknowledged_and_timed(centre: tuple[ControlCentre, list[Authority], list[float]]) -> None:
    """A section is closed from the page: the train in it has the order, says so, and comes to rest; then it is lost."""
    control, sent, now = centre
    control.supervision.state, control.monitor = replace(control.supervision.state, stopped=False), None
    train = SimulatedTrain(number=1, front_m=400.0, tracks={0: 1}, on_board=OnBoard(direction=1, end_m=400.0))
    train.speed_mps = 5.0

    def second(*, delivered: bool) -> dict[str, Any]:
        now[0] += 1.0
        control.report(1, encode(train.message(now[0])))
        control.step()
        if delivered:
            for authority in [a for a in sent if a.train == 1][-3:]:  # an order to brake is a message of its own
                train.on_board.receive(authority)
        found = control.snapshot()
        return {**found["trains"][0], "sections": found["sections"]}

    second(delivered=True)
    orders = list_orders(control)
    assert orders["close-section"]({"section": "Q"}) == "no such section: 'Q'"
    assert orders["open-section"]({"section": "A"}) == "'A' is not closed"
    assert orders["close-section"]({"section": "A"}) is None
    assert second(delivered=False)["stop"] == "A is closed; not acknowledged"
    assert second(delivered=True)["stop"] == "A is closed; not acknowledged"
    assert second(delivered=True)["stop"] == "A is closed; acknowledged after 2.0 s"
    train.speed_mps = 0.0
    shown = second(delivered=True)
    assert shown["stop"] == "A is closed; acknowledged after 2.0 s, at rest after 3.0 s"
    assert [section["name"] for section in shown["sections"] if section["closed"]] == ["A"]
    assert any("order to stop acknowledged after 2.0 s, at rest after 3.0 s" in line for line in control.lines)
    control.curves = {1: ReferenceCurve.between_stations(np.array([250.0, 1750.0, 3250.0]), speed_mps=20.0)}
    now[0] += 60.0
    control.step()
    lost = control.snapshot()["trains"][0]
    assert (lost["state"], lost["shown"]) == ("simulated", shown["shown"])
    assert shown["place"] == ""  # without a reference run
    assert lost["place"] == "A to B, 10 %"  # P5 3.1: 400 m, the stations stop at 250 and 1750 m
    assert orders["release-train"]({"train": 1}) == "section A, where train 1 is or may run, is closed"
    assert orders["open-section"]({"section": "A"}) is None
    assert (orders["release-train"]({"train": 1}) or "").startswith("train 1 does not report")
    second(delivered=True)
    assert orders["release-train"]({"train": 1}) is None  # it has reported
    assert second(delivered=True)["stop"] is None
    assert control.stops == {}


def test_a_database_that_fails_is_an_alarm(
    centre: tuple[ControlCentre, list[Authority], list[float]], tmp_path: Path
) -> None:
    """Another program holds the file: nothing is granted, said once, and all is stored once it can be."""
    control, sent, now = centre
    control.supervision.state = replace(control.supervision.state, stopped=False)
    control.monitor = None
    control.step()
    assert len(sent) == 2
    placed = SimulatedTrain(number=1, front_m=400.0, tracks={0: 1}, on_board=OnBoard(direction=1, end_m=400.0))
    other = sqlite3.connect(tmp_path / "centre.db", isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    control.report(1, encode(placed.message(0.0)))
    for _ in range(8):
        now[0] += 0.3
        control.step()
    assert len(sent) == 2
    assert "database is locked" in control.database
    assert sum("ALARM" in line for line in control.lines) == 1
    other.execute("ROLLBACK")
    other.close()
    now[0] += 1.0
    control.step()
    assert control.database is None
    assert {authority.train: authority.report for authority in sent[2:]} == {1: 1, 2: 0}
    assert control.store.records()[1].sequence == 1
    told = [text for _, _, text in control.store.log()]
    assert "train 1: first report" in told
    assert "the database can be written again" in control.lines[-1]


@pytest.mark.slow
def test_postgresql_that_hangs_is_an_alarm_and_holds_up_no_order(folder: Path, tmp_path: Path) -> None:
    """Its processes are stopped (SIGSTOP): the page has the alarm within 2 s, and goes on; an order to stop leaves."""
    pytest.importorskip("psycopg")
    if not list(Path("/usr/lib/postgresql").glob("*/bin")):
        pytest.skip("no PostgreSQL is installed in /usr/lib/postgresql")
    place = Path(tempfile.mkdtemp())
    server = Server(place)
    text = (folder / "line.toml").read_text().replace('"keys"', f'"{folder / "keys"}"')
    (tmp_path / "line.toml").write_text(f'database = "{Server.ADDRESS}"\n{text}')
    (tmp_path / "password").write_text("secret\n")
    (tmp_path / "password").chmod(0o600)
    process = subprocess.Popen(
        [sys.executable, "-m", "railfix", "ground", "centre", str(tmp_path / "line.toml"), "--page", "127.0.0.1:0",
         "--password", str(tmp_path / "password"), "--for", "60"], stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    browser = Browser(process.stdout.readline().split()[-1])

    def state() -> tuple[dict[str, Any], float]:
        """The values of the page, and how long they took."""
        begin = time.monotonic()
        with urllib.request.urlopen(browser.url + "state", timeout=5.0) as answer:
            return json.load(answer), time.monotonic() - begin

    def wait(alarm: bool, most_s: float) -> float:
        """How long it takes until the page has the alarm of the database, or has it no more."""
        begin, longest_s = time.monotonic(), 0.0
        while time.monotonic() - begin < most_s:
            values, took_s = state()
            longest_s = max(longest_s, took_s)
            if any("the database has not answered" in text for text in values["alarms"]) == alarm:
                assert longest_s < 0.5
                return time.monotonic() - begin
            time.sleep(0.05)
        raise AssertionError(values["alarms"])

    async def order_to_stop() -> str:
        """What reaches the train, which had an authority, once the database hangs."""
        came: asyncio.Queue[Authority] = asyncio.Queue()
        links = TrainLinks(
            1, folder / "keys", create_bearers(addresses(folder), LOCAL),
            received=lambda payload: came.put_nowait(Authority.decode(payload)),
        )  # fmt: skip
        await links.start()
        try:
            placed = SimulatedTrain(number=1, front_m=300.0, tracks={0: 1}, on_board=OnBoard(direction=1, end_m=300.0))
            links.send(encode(placed.message(0.0)))
            assert not (await asyncio.wait_for(came.get(), 20.0)).stopped
            server.hang()
            assert await asyncio.to_thread(wait, alarm=True, most_s=5.0) < 2.0
            begin = time.monotonic()
            assert await asyncio.to_thread(browser.post, "orders/stop-all") == (200, None)
            assert time.monotonic() - begin < 0.5
            while not isinstance(order := await asyncio.wait_for(came.get(), 2.0), BrakeOrder):
                pass
            return order.reason
        finally:
            await links.stop()

    try:
        assert browser.post("login", {"password": "secret"}) == (200, None)
        assert asyncio.run(order_to_stop()) == "stopped by hand"
        server.go_on()
        wait(alarm=False, most_s=15.0)
        assert "the database can be written again" in " ".join(state()[0]["log"])
        process.terminate()
        process.communicate()
        with Store(Server.ADDRESS) as store:
            assert store.records()[1].sequence == 1
            assert from_documents(store.documents(HEAD)).trains[1].stop == "stopped by hand"
            texts = [text for _, _, text in store.log()]
        assert any(text.startswith("order of operator: stop-all") for text in texts)
    finally:
        server.go_on()
        process.kill()
        server.kill()
        shutil.rmtree(place)


def test_a_centre_counts_what_does_not_count(centre: tuple[ControlCentre, list[Authority], list[float]]) -> None:
    control, _, _ = centre
    train = SimulatedTrain(number=1, front_m=400.0, tracks={0: 1}, on_board=OnBoard(direction=1, end_m=400.0))
    good = train.message(0.0)
    control.report(1, encode(good))
    control.report(1, encode(good))
    control.report(2, encode(good))
    control.report(1, b"no message")
    control.report(9, encode(good.replaced(train=9)))
    assert control.reports == 1
    assert sorted(control.rejected.values()) == [1, 1, 1, 1]


def test_a_train_that_nobody_answers_says_so(folder: Path) -> None:
    train = SimulatedTrain(number=1, front_m=400.0, tracks={0: 1}, on_board=OnBoard(direction=1, end_m=400.0))
    command = [sys.executable, "-m", "railfix", "ground", "train", "1", "--keys", str(folder / "keys"), "--for", "2"]
    command += ["--centre", "127.0.0.1:9", "--centre", "127.0.0.1:9"]
    line = to_json(train.message(0.0)) + "\n"
    done = subprocess.run(command, input=line, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0
    assert done.stderr.startswith(
        ("railfix ground train: no authority was received", "railfix ground train: no position was reported")
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("track = 1", "track = 3"), "trains.0.track"),
        (("front_m = 300", "front_m = 90"), "is not between the points of A (60 to 440 m): within its"),
        (('station = "A"', 'station = "X"'), "points of X (none, the stations are A, B, C)"),
        (("listen", "lisen"), "unknown setting lisen"),
        ((":", ";"), "HOST:PORT was expected"),
        (('keys = "keys"', 'keys = "none"'), "create it with railfix ground keys"),
    ],
)
def test_a_wrong_file_of_a_centre_is_one_sentence(
    folder: Path, tmp_path: Path, change: tuple[str, str], words: str
) -> None:
    (tmp_path / "line.toml").write_text((folder / "line.toml").read_text().replace(*change))
    if change[0] != 'keys = "keys"':
        (tmp_path / "keys").symlink_to(folder / "keys")
    done = CliRunner().invoke(app, ["centre", str(tmp_path / "line.toml"), "--for", "1"])
    assert words in " ".join(done.output.split())
    open_to_all = tmp_path / "password"
    open_to_all.write_text("secret")
    done = CliRunner().invoke(app, ["centre", str(tmp_path / "line.toml"), "--password", str(open_to_all)])
    assert "can be read by others" in " ".join(done.output.split())


def test_interference_that_a_train_suspects_is_an_alarm_until_it_ends(
    centre: tuple[ControlCentre, list[Authority], list[float]],
) -> None:
    """Also in reports without a place, which change nothing else."""
    control, _, _ = centre
    train = SimulatedTrain(number=1, front_m=400.0, tracks={0: 1}, on_board=OnBoard(direction=1, end_m=400.0))
    good = train.message(0.0)
    kinds = (SuspectedInterference.NONE, SuspectedInterference.SPOOFING, SuspectedInterference.NONE, None)
    shown = []
    for number, kind in enumerate(kinds):
        status = MessageStatus.DOUBTFUL if kind else MessageStatus.POSITION
        control.report(1, encode(good.replaced(sequence=10 + number, interference=kind, status=status)))
        shown.append((control.alarms, control.snapshot()["trains"][0]["interference"]))
    clear = ([], "none")
    assert shown == [clear, (["train 1 suspects spoofing"], "spoofing"), clear, clear]
    assert [line.split(": ", 2)[2] for line in control.lines if "suspected" in line] == [
        "spoofing suspected", "spoofing no longer suspected",
    ]  # fmt: skip
