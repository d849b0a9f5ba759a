"""``railfix ground``: the ground side."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.markup import escape
from rich.table import Table

from railfix.cli.command import Command, Commands
from railfix.cli.console import console_of_tables, show_files
from railfix.cli.options import OverwriteOption, check_outputs
from railfix.core.errors import MismatchError, OutputError, SettingsError

if TYPE_CHECKING:
    from railfix.ground.monitor import MonitorLimits, Order
    from railfix.ground.triangle import TriangleLimits

app = typer.Typer(
    cls=Commands,
    add_completion=False,
    pretty_exceptions_enable=False,
    name="ground",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)


@app.callback()
def ground() -> None:
    """Judge satellite positioning from the ground, and show the ground side at work.

    A reference triangle of three receivers finds satellite faults, disturbances and failed receivers; a control centre
    supervises trains over two encrypted links, gives each the distance it may run and sets points.
    """


@app.command("monitor", cls=Command)
def monitor(
    logs: Annotated[
        list[str],
        typer.Argument(
            metavar="OBS OBS OBS",
            help="RINEX observation files of the three receivers; with --live their streams, as of `railfix live`.",
        ),
    ],
    *,
    nav: Annotated[
        list[Path] | None,
        typer.Option(
            "--nav", metavar="FILE", help="RINEX navigation file; repeat it for several. Streams may bring their own."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for monitor.csv and triangle.png.")],
    point: Annotated[
        list[str] | None,
        typer.Option(
            metavar="LAT,LON,HEIGHT",
            help="Known point of a receiver, in the order of the logs; from the headers of the logs without it.",
        ),
    ] = None,
    radius: Annotated[float, typer.Option(metavar="M", help="Radius of the circle of allowable error.")] = 12.0,
    side: Annotated[float, typer.Option(metavar="M", help="Largest deviation of the vector between two fixes.")] = 6.0,
    late: Annotated[float, typer.Option(metavar="S", help="Time after which three fixes are late.")] = 3.0,
    live: Annotated[bool, typer.Option("--live", help="Judge streams as they arrive, once a second.")] = False,
    for_seconds: Annotated[
        float | None, typer.Option("--for", metavar="S", min=0.0, help="With --live: end after this time.")
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Judge satellite positioning by three receivers at known points.

    Single-point fixes from the same satellites are compared with the points by circles, and the vectors between the
    fixes with those between the points. The first cause that stops the trains is latched and printed.

    Example: `railfix ground monitor a.rnx b.rnx c.rnx --nav day.nav --out monitor`

    With --live the logs are streams, judged as they arrive until they end; monitor.csv grows with them.

    Example: `railfix ground monitor --live tcp://10.0.0.1:2101 tcp://10.0.0.2:2101 tcp://10.0.0.3:2101 --point ...`

    Exit codes as `railfix --help` says; 5 where the logs have no satellite or no epoch in common.
    """
    from railfix.ground.monitor import MonitorLimits
    from railfix.ground.monitor_log import draw_triangle, monitor_log
    from railfix.ground.station_fixes import station_fixes
    from railfix.ground.triangle import TriangleLimits, Verdict
    from railfix.io import read_navigation, read_observations

    if len(logs) != 3:
        raise SettingsError(f"{len(logs)} logs were given; a triangle has three receivers")
    try:
        limits, times = TriangleLimits(radius_m=radius, side_m=side), MonitorLimits(late_s=late)
    except ValueError as error:
        raise SettingsError(f"--radius, --side, --late: {str(error).splitlines()[-2].strip()}") from None
    files = [out / "monitor.csv", out / "triangle.png"]
    if out.exists():
        inputs = [*(Path(log) for log in logs), *(nav or [])]
        check_outputs((files[0], "any"), (files[1], "any"), overwrite=overwrite, inputs=inputs)
    if point is not None and len(point) != 3:
        raise SettingsError(f"--point was given {len(point)} times; give it once for each receiver")
    if live:
        _monitor_live(logs, point, nav, files[0], limits=limits, times=times, for_s=for_seconds)
        return
    if not nav:
        raise SettingsError("--nav is missing: logs need navigation files")
    observations = [read_observations(path) for path in logs]
    if point:
        from railfix.cli.cn0_curve import place_of

        points = np.stack([place_of(text, "--point") for text in point])
    else:
        points = np.stack([log.header.approximate_ecef_m for log in observations])
        for log, known in zip(logs, points, strict=True):
            if not np.isfinite(known).all():
                raise MismatchError(f"{log}: the header has no position; give the known points with --point")
    fixes = station_fixes(observations, points, read_navigation(nav))
    result = monitor_log(fixes, limits=limits, times=times)
    try:
        out.mkdir(parents=True, exist_ok=True)
        result.table().write_csv(files[0])
        draw_triangle(files[1], result, limits=limits)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror})") from None
    console = console_of_tables()
    table = Table("verdict", "epochs")
    for value, count in zip(*np.unique(result.triangle.verdict, return_counts=True), strict=True):
        table.add_row(Verdict(int(value)).name.lower(), str(count))
    console.print(table)
    for time, order, cause, receiver in result.orders:
        named = "" if receiver < 0 else f", receiver {receiver}"
        console.print(f"{np.datetime_as_string(time, unit='s')} {order.value}: {cause.name.lower()}{named}")
    if not result.orders:
        console.print("no stop")
    show_files(console, files)


def _monitor_live(
    sources: list[str],
    point: list[str] | None,
    nav: list[Path] | None,
    path: Path,
    *,
    limits: TriangleLimits,
    times: MonitorLimits,
    for_s: float | None,
) -> None:
    """Judge streams until they end, or for a time; rows go to a file and orders are printed as they come."""
    import asyncio
    import time

    from railfix.cli.cn0_curve import place_of
    from railfix.ground.monitor_log import LiveMonitor
    from railfix.ground.station_streams import stream_fixes
    from railfix.ground.triangle import Verdict
    from railfix.io import read_navigation
    from railfix.live.sources import check_source, is_file

    if point is None:
        raise SettingsError("--point is missing: streams name no known points; give it once for each receiver")
    for source in sources:
        check_source(source)
    points = np.stack([place_of(text, "--point") for text in point])
    navigation = read_navigation(nav) if nav else None
    monitor, counts, console = LiveMonitor(limits=limits, times=times), Counter[str](), console_of_tables()
    recorded = all(is_file(source) for source in sources)

    def show(orders: tuple[Order, ...], when: str) -> None:
        for order in orders:
            cause = "" if monitor.state.cause is None else f": {monitor.state.cause.name.lower()}"
            named = "" if monitor.state.receiver < 0 else f", receiver {monitor.state.receiver}"
            console.print(f"{when} {order.value}{cause}{named}", soft_wrap=True)

    async def work() -> None:
        async for fixes in stream_fixes(sources, points, navigation=navigation):
            # recorded streams have the clock of their tags
            tag_s = float(fixes.time[0].astype(np.int64)) / 1e9
            judged, orders = monitor.judge(fixes, tag_s if recorded else time.monotonic())
            judged.table().write_csv(file, include_header=not counts)
            file.flush()
            counts[Verdict(int(judged.triangle.verdict[0])).name.lower()] += 1
            show(orders, np.datetime_as_string(fixes.time[0], unit="s"))

    async def watch() -> None:
        while not recorded:
            await asyncio.sleep(0.5)
            show(monitor.silent(time.monotonic()), "nothing for too long:")

    async def session() -> None:
        tasks = [asyncio.create_task(work()), asyncio.create_task(watch())]
        done, _ = await asyncio.wait(tasks[:1], timeout=for_s)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for task in done:
            task.result()

    if not recorded:
        monitor.state = replace(monitor.state, complete_s=time.monotonic())
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as file:
            asyncio.run(session())
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
    table = Table("verdict", "epochs")
    for name, count in sorted(counts.items()):
        table.add_row(name, str(count))
    console.print(table)
    if not monitor.state.stopped:
        console.print("no stop")
    show_files(console, [path])


@app.command("keys", cls=Command)
def keys(
    out: Annotated[Path, typer.Argument(metavar="DIR", help="Empty folder for the keys; made where absent.")],
    *,
    train: Annotated[list[int], typer.Option(metavar="N", help="Number of a train; repeat it for several.")],
    days: Annotated[int, typer.Option(metavar="DAYS", min=1, help="Validity of the certificates.")] = 365,
) -> None:
    """Make keys and certificates of a centre and its trains.

    They are signed by an authority whose key is not kept: for another train make a new set. Keys can be read by their
    owner alone; each train gets authority.pem and its own two files only.

    Example: `railfix ground keys keys --train 1 --train 2`

    Exit codes as `railfix --help` says; 8 where a file is there already.
    """
    from railfix.ground.keys import write_keys

    if not all(0 < number < 1 << 32 for number in train):
        raise SettingsError("--train: a number from 1 to 4294967295 was expected")
    show_files(console_of_tables(), write_keys(out, sorted(set(train)), valid_days=days))


@app.command("demo", cls=Command)
def demo(
    *,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Seed of losses and noise.")] = 1,
    speed: Annotated[float, typer.Option(metavar="X", min=1.0, max=50.0, help="Simulated seconds a second.")] = 6.0,
    port: Annotated[int, typer.Option(metavar="PORT", min=0, max=65535, help="Of the page; 0 takes a free one.")] = 0,
    hold: Annotated[
        float, typer.Option(metavar="S", min=0.0, max=3600.0, help="Keep the page after the end for this time.")
    ] = 0.0,
    coverage: Annotated[
        Path | None,
        typer.Option(
            metavar="PNG", help="Picture of the links: response rates along the line, round trips over time and place."
        ),
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Show two trains, two lossy links each, a centre with its page, and a satellite fault.

    The trains meet in a passing loop; one bearer fails, then both of one train; at the end a satellite drifts away, the
    reference triangle sees it, satellite positioning is suspended and the trains stop. Everything stays on loopback
    addresses and ends by itself in about half a minute, with a table of what happened.

    Example: `railfix ground demo --hold 60`

    Exit codes as `railfix --help` says.
    """
    import asyncio
    import secrets

    from railfix.ground.demo import run_demo

    check_outputs((coverage, "picture"), overwrite=overwrite, inputs=[])
    console, password = console_of_tables(), secrets.token_urlsafe(12)

    def announce(url: str) -> None:
        console.print(f"the page, to open in a browser: {url}", soft_wrap=True)
        console.print(f"password for orders: {password}", soft_wrap=True)

    async def keep(_: str) -> None:
        await asyncio.sleep(hold)

    try:
        figures = asyncio.run(
            run_demo(
                seed=seed, speed=speed, port=port, password=password, announce=announce, keep=keep, picture=coverage
            )
        )
    except OSError as error:
        raise OutputError(f"the demonstration cannot use its loopback addresses ({error.strerror})") from None
    _show_figures(figures)


@app.command("centre", cls=Command)
def centre(
    path: Annotated[Path, typer.Argument(metavar="CENTRE.toml", help="Line, trains, keys and addresses.")],
    *,
    page: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Of the page; port 0 takes a free one.")
    ] = "127.0.0.1:8000",
    password: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Password for orders in its first line; a new one is printed without it."),
    ] = None,
    for_seconds: Annotated[
        float | None, typer.Option("--for", metavar="S", min=0.0, help="End after this time; else at a signal.")
    ] = None,
) -> None:
    r"""Supervise the trains of a line: reports in, authorities out, points and routes, with a page.

    Trains connect over two QUIC links with certificates of `railfix ground keys`. Every report that is acknowledged
    and every authority is in the database before it is sent, so the centre may be killed and started again at any
    time. Reading the page is open; the release of a stop and routes by hand need a log-in. Points are simulated.

        keys = "keys"
        listen = { A = "127.0.1.1:4433", B = "127.0.2.1:4433" }
        stations = [
            { name = "West", begin_m = 0, end_m = 500 },
            { name = "East", begin_m = 1500, end_m = 2000 },
        ]
        trains = [
            { number = 1, station = "West", track = 1, direction = 1, front_m = 400, length_m = 80 },
        ]

    Example: `railfix ground centre line.toml --password secret.txt`

    Exit codes as `railfix --help` says.
    """
    import asyncio
    import secrets

    from railfix.ground.serve import parse_address, read_password, run_centre

    console = console_of_tables()
    try:
        address = parse_address(page)
    except ValueError as error:
        raise SettingsError(f"--page {page!r}: {error}") from None
    word = secrets.token_urlsafe(12) if password is None else read_password(password)

    def announce(url: str) -> None:
        console.print(f"the page, to open in a browser: {url}", soft_wrap=True)
        if password is None:
            console.print(f"password for orders: {word}", soft_wrap=True)

    figures = asyncio.run(run_centre(path, page=address, password=word, for_s=for_seconds, announce=announce))
    _show_figures(figures)


@app.command("train", cls=Command)
def train(
    number: Annotated[int, typer.Argument(metavar="N", min=1, help="Number of the train.")],
    *,
    keys: Annotated[Path, typer.Option(metavar="DIR", help="authority.pem and the train's own two files.")],
    centre: Annotated[
        list[str], typer.Option("--centre", metavar="HOST:PORT", help="Centre's address: of bearer A, then of B.")
    ],
    local: Annotated[
        list[str] | None,
        typer.Option(metavar="HOST", help="Own address on a bearer: of A, then of B; else the system chooses."),
    ] = None,
    fresh: Annotated[
        float, typer.Option(metavar="S", min=1.0, help="Time limit of authorities: older ones brake the train.")
    ] = 15.0,
    integrity: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help='The train\'s integrity device writes "complete" here at least every 2 s.'),
    ] = None,
    for_seconds: Annotated[
        float | None, typer.Option("--for", metavar="S", min=0.0, help="End after this time.")
    ] = None,
) -> None:
    """Carry the positions of a train to the centre over two links, and its authorities back.

    Reads position messages as lines of JSON from standard input (`railfix live ... --send json@-`), reports the newest
    every second, and writes each authority, and each beginning and end of braking, as a line of JSON.

    Example: `railfix live ... | railfix ground train 1 --keys keys --centre 10.0.1.1:4433 --centre 10.0.2.1:4433`

    Exit codes as `railfix --help` says.
    """
    import asyncio

    from railfix.ground.links import BEARERS
    from railfix.ground.on_board import OnBoardLimits
    from railfix.ground.serve import parse_address
    from railfix.ground.train import run_train

    hosts = local or ["0.0.0.0", "0.0.0.0"]
    if len(centre) != 2 or len(hosts) != 2:
        raise SettingsError("--centre and --local are given twice: for bearer A, then for B")
    try:
        addresses = dict(zip(BEARERS, map(parse_address, centre), strict=True))
    except ValueError as error:
        raise SettingsError(f"--centre: {error}") from None
    work = run_train(
        number,
        keys,
        addresses,
        dict(zip(BEARERS, hosts, strict=True)),
        write=lambda line: print(line, flush=True),
        limits=OnBoardLimits(fresh_s=fresh),
        integrity=integrity,
        for_s=for_seconds,
    )
    asyncio.run(work)


def _show_figures(figures: dict[str, Any]) -> None:
    """Print a table of what happened."""
    table = Table("what happened", "")
    for name, value in figures.items():
        text = ", ".join(f"{k} {v}" for k, v in value.items()) or "none" if isinstance(value, dict) else str(value)
        table.add_row(escape(name), text)
    console_of_tables().print(table)
