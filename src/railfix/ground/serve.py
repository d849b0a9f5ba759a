"""Process of the centre: configuration file, links, page, and simulated points."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import ipaddress
import json
import math
import signal
import time
from collections.abc import Callable, Coroutine, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, RailfixError, SettingsError
from railfix.core.geodesy import ecef_from_geodetic
from railfix.core.settings import Settings
from railfix.core.settings_files import load_settings
from railfix.core.timescale import GPS_EPOCH
from railfix.core.utc import gps_now_ns
from railfix.ground.centre import CentreLimits, ReferenceCurve
from railfix.ground.control import ControlCentre, list_orders
from railfix.ground.field import SimulatedPoints
from railfix.ground.fixes_at_stations import stream_fixes
from railfix.ground.keys import check_keys
from railfix.ground.layout import Gradient, Layout, LoopStation, PointName, derive_layout
from railfix.ground.links import BEARERS, CentreLinks, LinkName
from railfix.ground.state import HEAD, InterlockingLimits, TrainInterval, from_documents
from railfix.ground.store import MOST_LINES, Store
from railfix.ground.supervision import Supervision, at_start, standing_train
from railfix.ground.triangle import MonitorLimits, TriangleLimits, TriangleVerdict, judge_fixes
from railfix.ground.web import PageServer, Sessions, page_app
from railfix.ground.writer import ThreadWriter
from railfix.io import read_navigation
from railfix.track.network_read import read_network

#: Period of the centre's steps [s].
STEP_S = 0.1
#: At its end, the process waits at most this long for a commit in progress [s].
ENDING_S = 3.0
#: Thresholds of the garbage collector, chosen so that full collections are rare; a full collection takes 0.3 s with a
#: thousand connections.
COLLECTION = 10_000, 20, 50
#: Name of the stored document that lists the stations and trains of the database.
_BELONGS_TO = "stations and trains"


def parse_address(text: object) -> tuple[str, int]:
    """Return the host and the port of ``HOST:PORT``; raise ValueError if the text has another form."""
    if isinstance(text, tuple):  # already parsed: settings are validated again when they are changed
        text = ":".join(map(str, text))
    host, _, port = str(text).rpartition(":")
    if not host or not port.isdigit() or int(port) > 65_535:
        raise ValueError("HOST:PORT was expected, for example 127.0.0.1:4433")
    return host, int(port)


Place = tuple[float, float, float]
Address = Annotated[tuple[str, int], BeforeValidator(parse_address)]


class TrainPlace(Settings):
    """Train that is at rest at the first start of the centre."""

    number: int = Field(gt=0, lt=1 << 32)
    station: str
    track: Literal[1, 2]
    direction: Literal[-1, 1]  #: Running direction: 1 toward rising chainage, -1 toward falling.
    front_m: float  #: Chainage of the front end [m].
    length_m: float = Field(gt=0)  #: Length of the train [m].
    bound_m: float = Field(default=10.0, ge=0)  #: Largest distance of the true front end from `front_m` [m].


class TriangleInputs(Settings):
    """Streams, points and limits of a reference triangle."""

    sources: tuple[str, str, str]  #: Streams of the three receivers, as in ``railfix live``.
    points: tuple[Place, Place, Place]  #: Latitude [deg], longitude [deg] and height [m] of the three known points.
    nav: tuple[Path, ...] = ()  #: Navigation files; navigation data from the streams are added.
    limits: TriangleLimits = TriangleLimits()

    def points_ecef_m(self) -> Floats:
        """Return the known points in Earth-fixed coordinates, shape (3, 3) [m]."""
        return ecef_from_geodetic(*np.array(self.points).T)


class CentreFile(Settings):
    """Configuration file of a centre; paths in the file are relative to the folder of the file."""

    keys: Path  #: Folder with ``authority.pem``, ``centre.pem`` and ``centre.key``, written by ``railfix ground keys``.
    listen: dict[LinkName, Address]  #: Address at which the centre listens on each bearer.
    stations: tuple[LoopStation, ...] = ()  #: Stations of the line, unless `network` is given.
    #: Map files of the tracks, which must be a single line with passing loops (`railfix.ground.layout`).
    network: tuple[Path, ...] = ()
    gradients: tuple[Gradient, ...] = ()  #: Gradients of the line, in order of chainage.
    #: Sections (stations, ``NAME track 1``, ``NAME to NAME``) with a detection system. This system must send the order
    #: ``detect-section`` at least every `InterlockingLimits.detection_s`; otherwise, the state of the section is
    #: unknown.
    detected_sections: tuple[str, ...] = ()
    drive: Literal["left", "right"] = "left"  #: Side on which trains run through stations derived from `network`.
    #: Trains, with their positions at the first start; at later starts, positions are read from the database.
    trains: Annotated[tuple[TrainPlace, ...], Field(min_length=1)]
    database: str = "centre.db"  #: SQLite file, or the address of an SQL database (``postgresql+psycopg://...``).
    log_lines: int = Field(default=MOST_LINES, ge=1000)  #: Number of newest log lines that the database keeps.
    #: Whether a train that approaches the end of its track is given the route to the next station automatically.
    routes: Literal["automatic", "by hand"] = "automatic"
    speed_mps: float = Field(default=20.0, gt=0)  #: Highest speed of the reference run curve, for simulated running.
    #: Time that simulated points take to move; railfix has no interface to real points.
    points_s: float = Field(default=5.0, ge=0)
    #: Reference triangle that monitors satellite positioning. With a triangle, all trains are stopped from the first
    #: start until a release by hand. Without a triangle, satellite positioning is not monitored.
    triangle: TriangleInputs | None = None
    centre: CentreLimits = CentreLimits()  #: Limits for the reports of trains.
    interlocking: InterlockingLimits = InterlockingLimits()  #: Limits of the interlocking.
    monitor: MonitorLimits = MonitorLimits()  #: Limits of the monitor of satellite positioning.

    @model_validator(mode="after")
    def _both_bearers_and_known_places(self) -> Self:
        if set(self.listen) != set(BEARERS):
            raise ValueError("listen must have an address for each of A and B")
        if bool(self.stations) == bool(self.network):
            raise ValueError("specify the line either by stations or by network")
        if self.network:
            return self  # the settings are checked again once the stations are known
        layout, numbers = self.layout, [train.number for train in self.trains]
        for name in self.detected_sections:
            if name not in layout.sections:
                raise ValueError(f"no such section: {name}; the sections are {', '.join(layout.sections)}")
        if len(set(numbers)) < len(numbers):
            raise ValueError("two trains have the same number")
        for train in self.trains:
            low, high = sorted((train.front_m, train.front_m - train.direction * train.length_m))
            found = layout.station_at(low - train.bound_m, high + train.bound_m)
            if found is None or layout.stations[found].name != train.station:
                tracks = {station.name: "{:.0f} to {:.0f} m".format(*station.inner_m) for station in layout.stations}
                where = tracks.get(train.station, f"none, the stations are {', '.join(tracks)}")
                raise ValueError(
                    f"train {train.number} is not between the points of {train.station} ({where}): within its "
                    f"bounds, it extends from {low - train.bound_m:.0f} to {high + train.bound_m:.0f} m"
                )
        places = [(train.station, train.track) for train in self.trains]
        if len(set(places)) < len(places):
            raise ValueError("two trains are on the same track")
        return self

    def with_stations(self, folder: Path) -> Self:
        """Return the settings with the stations derived from the map files of `network` in a folder.

        Raise InputFileError or MismatchError if a map file cannot be read, or the network is not a single line with
        passing loops. Raise SettingsError if a train is outside all stations.
        """
        if not self.network:
            return self
        stations = derive_layout(read_network([folder / name for name in self.network]), drive=self.drive).stations
        try:
            return self.replaced(stations=stations, network=())
        except SettingsError as error:
            raise SettingsError(f"trains: {str(error).partition(': ')[2]}") from None

    @property
    def layout(self) -> Layout:
        """Layout of the line."""
        return Layout(stations=self.stations, gradients=self.gradients)

    def intervals(self) -> list[TrainInterval]:
        """Return the intervals of the trains at the first start."""
        names = [station.name for station in self.stations]
        return [
            standing_train(**train.model_dump(exclude={"station"}), station=names.index(train.station))
            for train in self.trains
        ]

    def curves(self) -> dict[int, ReferenceCurve]:
        """Return the reference run curves by direction, with stops in the middle of each station."""
        stops = np.array([0.5 * (station.begin_m + station.end_m) for station in self.stations])
        return {
            1: ReferenceCurve.between_stations(stops, speed_mps=self.speed_mps),
            -1: ReferenceCurve.between_stations(stops[::-1], speed_mps=self.speed_mps),
        }


async def run_centre(
    path: Path,
    *,
    page: tuple[str, int] = ("127.0.0.1", 0),
    password: str,
    people: Mapping[str, str] | None = None,
    orders: tuple[str, int] | None = None,
    for_s: float | None = None,
    announce: Callable[[str], None] = lambda _: None,
) -> tuple[bool, dict[str, Any]]:
    """Run the centre configured by a file (`CentreFile`) until SIGINT or SIGTERM, or until `for_s` has passed.

    Return whether SIGTERM ended the centre, and counts of reports, routes and rejected frames.

    `page` is the host and port of the page, where port 0 selects a free port. At addresses other than loopback, the
    page is served over TLS with the centre's certificate. Orders require `password`, or a personal password from
    `people` (by name of the person). `orders` is a separate address for orders, by default the page's address.
    `announce` is called with each address of the page as soon as trains can connect. Raise InputFileError if the file,
    a key or the database cannot be read. Raise SettingsError if a setting is wrong, or an address is not available.
    """
    settings = load_settings(CentreFile, path, what="a file of a centre").with_stations(path.parent)
    keys = path.parent / settings.keys
    check_keys(keys, "centre")
    database = settings.database if "://" in settings.database else f"sqlite:///{path.parent / settings.database}"
    gc.set_threshold(*COLLECTION)
    end, terminated = asyncio.Event(), asyncio.Event()
    loop = asyncio.get_running_loop()

    def terminate() -> None:
        terminated.set()
        end.set()

    loop.add_signal_handler(signal.SIGINT, end.set)
    loop.add_signal_handler(signal.SIGTERM, terminate)
    with Store(database, most_lines=settings.log_lines) as store:
        store.take_charge()
        _check_line(settings, store, path)
        field_points = SimulatedPoints(move_s=settings.points_s, clock=time.monotonic, lie=_stored_points(store))
        control, links = _centre(settings, keys, store, field_points)
        writer = ThreadWriter(lambda: _call_in(loop, control.settle))
        control.commits.writer = writer
        done = False

        def snapshot() -> dict[str, Any]:
            alarms = [*(text for text in (control.database, *links.alarms()) if text is not None), *control.alarms]
            return {**control.snapshot(), "links": _heard(control, links), "alarms": alarms, "done": done}

        sessions = Sessions(password=password, others=people or {})
        given = list_orders(control)
        apps = {page: page_app(snapshot, {} if orders else given, sessions=sessions)}
        if orders is not None:
            apps[orders] = page_app(snapshot, given, sessions=sessions)
        servers: list[PageServer] = []
        try:
            await links.start()
            for address, app in apps.items():
                loopback = address[0] == "localhost" or _is_loopback(address[0])
                certificate = None if loopback else (keys / "centre.pem", keys / "centre.key")
                servers.append(PageServer(app, host=address[0], port=address[1], certificate=certificate))
        except OSError as error:
            await links.stop()
            raise SettingsError(f"{path}: {error.strerror}") from None
        for server in servers:
            await server.start()
            announce(server.url)
        try:
            await _run_until(end, _work(control, field_points), _judge(control, settings, path), for_s=for_s)
        finally:
            done = True
            await links.stop()
            for server in servers:
                await server.stop()
            store.abandoned = not _save_and_stop(control, writer)
        return terminated.is_set(), {
            "reports used": control.reports,
            "routes set": control.supervision.routes_set,
            "reports rejected": dict(control.rejected),
            "frames rejected": {threat.value: n for threat, n in sorted(links.threats().items(), key=str) if n},
        }


def _save_and_stop(control: ControlCentre, writer: ThreadWriter) -> bool:
    """Commit the last state and stop the writer; return whether the writer has stopped in time. Raise DatabaseError."""
    last = control.save_last(writer)
    stopped = writer.stop(ENDING_S)
    if last.done():
        last.result()
    return stopped


async def _run_until(
    end: asyncio.Event, work: Coroutine[Any, Any, None], judge: Coroutine[Any, Any, None], *, for_s: float | None
) -> None:
    """Run the centre's tasks until `end` is set, `work` ends or `for_s` has passed; raise an error of `work`."""
    working, ending, judging = (asyncio.create_task(each) for each in (work, end.wait(), judge))
    await asyncio.wait([working, ending], timeout=for_s, return_when=asyncio.FIRST_COMPLETED)
    if working.done():
        working.result()
    for task in (working, ending, judging):
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def _centre(
    settings: CentreFile, keys: Path, store: Store, points: SimulatedPoints
) -> tuple[ControlCentre, CentreLinks]:
    """Return the centre with its stored state, and the links that pass reports to the centre."""
    supervision = Supervision(
        layout=settings.layout,
        state=at_start(settings.layout, settings.intervals()),
        command=points.command,
        routes=settings.routes,
        limits=settings.interlocking,
        centre=settings.centre,
    )
    links = CentreLinks(
        keys,
        {name: settings.listen[name][0] for name in BEARERS},
        ports={name: settings.listen[name][1] for name in BEARERS},
        received=lambda number, payload: control.report(number, payload),
    )
    control = ControlCentre.restore(
        supervision,
        store,
        judged=settings.triangle is not None,
        curves=settings.curves(),
        send=links.send,
        clock=time.monotonic,
        wall_ns=time.time_ns,
        times=settings.monitor,
        ask=points.ask,
    )
    for section in settings.detected_sections:
        supervision.answered_s[section] = -math.inf
        supervision.set_section_detected(section, None)
    return control, links


def _stored_points(store: Store) -> dict[PointName, int]:
    """Return the track for which each set of simulated points lies: the detected track in the store or, without a
    detection, the commanded track.
    """
    texts = store.documents(HEAD)
    points = from_documents(texts).points if texts else {}
    return {name: point.detected or point.wanted for name, point in points.items()}


def _call_in(loop: asyncio.AbstractEventLoop, work: Callable[[], None]) -> None:
    """Call a function in the event loop from another thread, unless the loop has ended."""
    with contextlib.suppress(RuntimeError):
        loop.call_soon_threadsafe(work)


def _heard(control: ControlCentre, links: CentreLinks) -> list[dict[str, Any]]:
    """Return the time since each train's last frame over each bearer, as shown on the page."""
    now = time.monotonic()
    return [
        {"train": n, "bearer": bearer, "rate": None, "misses": None, "round_trip_ms": None,
         "silent_s": None if (at := links.heard_s.get((n, bearer))) is None else now - at}
        for n in control.supervision.state.trains
        for bearer in BEARERS
    ]  # fmt: skip


async def _work(control: ControlCentre, points: SimulatedPoints) -> None:
    """Run a step of the centre every `STEP_S`.

    The pause after a step is at least as long as the step, so that the links receive frames in the same event loop.
    """
    loop = asyncio.get_running_loop()
    due = loop.time()
    while True:
        begin = loop.time()
        for point, track in points.take_detected().items():
            control.supervision.set_detected(point, track)
        control.step()
        now = loop.time()
        due = max(due + STEP_S, 2.0 * now - begin)
        await asyncio.sleep(due - now)


async def _judge(control: ControlCentre, settings: CentreFile, path: Path) -> None:
    """Monitor satellite positioning with the triangle's streams; trains are stopped after the streams end."""
    if (triangle := settings.triangle) is None:
        return
    try:
        navigation = read_navigation([path.parent / name for name in triangle.nav]) if triangle.nav else None
        points = triangle.points_ecef_m()
        async for fixes in stream_fixes(triangle.sources, points, navigation=navigation):
            result = judge_fixes(fixes, triangle.limits)
            tag_ns = int((fixes.time[0] - GPS_EPOCH).astype("timedelta64[ns]").astype(np.int64))
            age_s = (gps_now_ns() - tag_ns) / 1e9
            control.judge(TriangleVerdict(int(result.verdict[0])), int(result.receiver[0]), age_s=age_s)
        control.log("triangle: every stream has ended")
    except (RailfixError, ValueError) as error:
        control.log(f"triangle: {' '.join(str(error).split())}")


def _check_line(settings: CentreFile, store: Store, path: Path) -> None:
    """Store the stations and trains of the file at the first start.

    Raise InputFileError if the stations or trains differ at a later start.
    """
    under = {f"station {s.name}": s.model_dump_json() for s in settings.stations}
    under |= {f"train {t.number}": f"{t.length_m:g} m" for t in settings.trains}
    under |= {"order of the stations": ", ".join(s.name for s in settings.stations)}
    text = store.document(_BELONGS_TO)
    if text is None and store.document(HEAD) is not None:
        raise InputFileError(path, "the database was written by an older version of railfix; choose another database")
    before: dict[str, str] = under if text is None else json.loads(text)
    for name in sorted(before.keys() | under.keys()):
        if before.get(name) != under.get(name):
            was, is_now = before.get(name, "absent"), under.get(name, "absent")
            raise InputFileError(
                path, f"{name} is {is_now}, but was {was} in the database; restore the file, or choose another database"
            )
    if text is None:
        store.save(documents={_BELONGS_TO: json.dumps(under)})


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def read_passwords(path: Path) -> tuple[str, dict[str, str]]:
    """Return the password in the first line of a file, and personal passwords in the other lines, ``NAME PASSWORD``.

    Raise InputFileError if the file cannot be read, is empty, has another form, or can be read by users other than its
    owner.
    """
    try:
        shared = path.stat().st_mode & 0o077
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputFileError(path, f"cannot be read as a password ({error})") from None
    if shared:
        raise InputFileError(path, "can be read by others; restrict it to its owner (chmod 600)")
    if not lines or not lines[0]:
        raise InputFileError(path, "is empty; a password in its first line was expected")
    people: dict[str, str] = {}
    for number, line in enumerate(lines[1:], start=2):
        name, _, word = line.strip().partition(" ")
        if line.strip() and not word.strip():
            raise InputFileError(path, f"line {number}: a name and its password were expected")
        people |= {name: word.strip()} if line.strip() else {}
    return lines[0], people
