"""``railfix ground``: satellite monitoring with three reference receivers, train supervision by a control centre."""

from __future__ import annotations

import signal
from collections import Counter
from collections.abc import AsyncIterator, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import typer

from railfix.cli.command import SIGNALLED, Command, command_group
from railfix.cli.console import TableConsole, show_files, show_table
from railfix.cli.options import check_outputs, from_models
from railfix.core.errors import OutputError, SettingsError
from railfix.core.notebook import plural
from railfix.core.options import option
from railfix.core.settings import Settings
from railfix.core.tables import plain_table
from railfix.ground.on_board import OnBoardLimits
from railfix.ground.triangle import MonitorLimits, TriangleLimits
from railfix.run.output import Overwrite

if TYPE_CHECKING:
    from railfix.ground.fixes_at_stations import StationFixes
    from railfix.ground.triangle import Order

app = command_group("ground")


@app.callback()
def ground() -> None:
    """Monitor satellite positioning from the ground, and supervise trains.

    A reference triangle of three receivers detects satellite faults, disturbances and failed receivers. A control
    centre supervises trains over two encrypted links, sends a movement authority to each train, and moves points.
    """


class MonitorChoices(Settings):
    """Inputs and output folder of `railfix ground monitor`."""

    nav: tuple[Path, ...] = option(
        "RINEX navigation file; may be repeated. Streams may contain their own navigation records.",
        (),
        metavar="FILE",
    )
    out: Path = option("Folder for monitor.csv and triangle.png.", metavar="DIR")
    point: tuple[str, ...] = option(
        "Known coordinates of a receiver, in the order of the logs; by default read from the headers of the logs.",
        (),
        metavar="LAT,LON,HEIGHT",
    )
    fixes: bool = option("The logs contain positions that another program has computed (RTK, PPP-RTK, CLAS).", False)
    live: bool = option("Evaluate streams as they arrive, once per second.", False)
    for_s: float | None = option("With --live: end after this time.", None, name="--for", metavar="S", ge=0)
    overwrite: Overwrite = option("Replace existing results.", "refuse", name="--overwrite")


@app.command("monitor", cls=Command)
@from_models
def monitor(
    choices: MonitorChoices,
    limits: TriangleLimits,
    times: MonitorLimits,
    *,
    logs: Annotated[
        list[str],
        typer.Argument(
            metavar="OBS OBS OBS",
            help="RINEX observation files of the three receivers; with --fixes logs of positions (.pos, NMEA, "
            "CSV); with --live streams, as for `railfix live`.",
        ),
    ],
) -> None:
    """Monitor satellite positioning with three receivers at points with known coordinates.

    The single-point fixes of the three receivers are computed from the same satellites. Each fix must be within a
    circle around the receiver's known point, and the vectors between the fixes must agree with the vectors between the
    points. The first cause for stopping the trains is latched and printed.

    Example: `railfix ground monitor a.rnx b.rnx c.rnx --nav day.nav --out monitor`

    With --fixes the logs contain positions computed by another program, or by a service such as CLAS.

    Example: `railfix ground monitor --fixes a.pos b.pos c.pos --point ... --point ... --point ... --out monitor`

    With --live the logs are streams, which are evaluated as they arrive until they end; rows are appended to
    monitor.csv.

    Example: `railfix ground monitor --live tcp://10.0.0.1:2101 tcp://10.0.0.2:2101 tcp://10.0.0.3:2101 --point ...`

    Exit codes are listed in `railfix --help`; the code is 5 if the logs have no satellite or no epoch in common.
    """
    if len(logs) != 3:
        raise SettingsError(f"{len(logs)} logs were given; a triangle has three receivers")
    out = choices.out
    if out.exists():
        inputs = [*(Path(log) for log in logs), *choices.nav]
        overwrite = choices.overwrite == "replace"
        check_outputs((out / "monitor.csv", "any"), (out / "triangle.png", "any"), overwrite=overwrite, inputs=inputs)
    if len(choices.point) not in (0, 3):
        raise SettingsError(f"--point was given {len(choices.point)} times; give it once for each receiver")
    if choices.live and choices.fixes:
        raise SettingsError("--fixes is for logs of positions, and cannot be combined with --live")
    if choices.live and not choices.point:
        raise SettingsError("--point is missing: streams contain no known coordinates; give it once for each receiver")
    try:
        _monitor(logs, choices, limits=limits, times=times)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror})") from None


def _monitor(logs: list[str], choices: MonitorChoices, *, limits: TriangleLimits, times: MonitorLimits) -> None:
    """Monitor logs or (for at most `for_s`) streams; write one row per epoch to monitor.csv, and print each order."""
    import asyncio
    import time

    from railfix.ground.triangle import Monitor, TriangleVerdict, draw_triangle
    from railfix.live.sources import is_file

    monitor, counts, console = Monitor(limits=limits, times=times), Counter[int](), TableConsole()
    path, picture = choices.out / "monitor.csv", choices.out / "triangle.png"
    recorded = not choices.live or all(is_file(log) for log in logs)

    def show(when: str, orders: Iterable[Order]) -> None:
        cause = "" if monitor.state.cause is None else f": {monitor.state.cause.name.lower()}"
        named = "" if monitor.state.receiver < 0 else f", receiver {monitor.state.receiver}"
        for order in orders:
            console.print(f"{when} {order.value}{cause}{named}")

    async def work() -> None:
        async for fixes in _fixes(logs, choices):
            # for recorded streams, the time tags are used instead of a clock
            judged = monitor.judge(fixes, None if recorded else time.monotonic())
            choices.out.mkdir(parents=True, exist_ok=True)
            with path.open("ab" if counts else "wb") as file:
                judged.table().write_csv(file, include_header=not counts)
            counts.update(judged.triangle.verdict.tolist())
            for tag, order, _, _ in judged.orders:
                show(np.datetime_as_string(tag, unit="s"), [order])
            if not choices.live:
                draw_triangle(picture, judged, limits=limits)

    async def watch() -> None:
        while not recorded:
            await asyncio.sleep(0.5)
            show("no fixes for too long:", monitor.silent(time.monotonic()))

    async def session() -> None:
        tasks = [asyncio.create_task(work()), asyncio.create_task(watch())]
        done, _ = await asyncio.wait(tasks[:1], timeout=choices.for_s)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for task in done:
            task.result()

    if not recorded:
        monitor.begin(time.monotonic())
    asyncio.run(session())
    rows = [[TriangleVerdict(verdict).name.lower(), str(count)] for verdict, count in sorted(counts.items())]
    show_table(console, plain_table(["verdict", "epochs"], rows, texts=2, boxed=True))
    if not monitor.state.stopped:
        console.print("no stop")
    show_files(console, [path] * bool(counts) + [picture] * (not choices.live))


async def _fixes(logs: list[str], choices: MonitorChoices) -> AsyncIterator[StationFixes]:
    """Yield the fixes of the three receivers: for logs one object with all epochs, for streams one object per epoch."""
    from railfix.ground.fixes_at_stations import read_fixes, stream_fixes
    from railfix.io import read_navigation
    from railfix.live.sources import check_source
    from railfix.run.processor_setup import parse_position

    if not choices.live:
        yield read_fixes(logs, choices.nav, choices.point, computed=choices.fixes)
        return
    for source in logs:
        check_source(source)
    points = np.stack([parse_position(text, "--point") for text in choices.point])
    navigation = read_navigation(choices.nav) if choices.nav else None
    async for fixes in stream_fixes(logs, points, navigation=navigation):
        yield fixes


class KeyChoices(Settings):
    """Identification numbers of the trains for which keys are made, and period of validity of the certificates."""

    train: tuple[int, ...] = option("Number of a train, from 1; may be repeated.", metavar="N")
    days: int = option("Validity of the certificates.", 365, metavar="DAYS", ge=1, le=36_500)
    renew: Literal["add", "renew"] = option(
        "Make new keys and certificates for the centre and these trains; the previous certificates stay "
        "valid until they expire.",
        "add",
        name="--renew",
    )


@app.command("keys", cls=Command)
@from_models
def keys(
    choices: KeyChoices,
    *,
    out: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder for the keys: new, empty, or with a certificate authority.")
    ],
) -> None:
    """Make keys and certificates for a control centre and trains, add trains, and renew certificates.

    A certificate authority signs the certificates; the key of the authority (authority.key) must stay in DIR. Copy
    authority.pem to the centre and to each train; also copy each key and its certificate to the centre or train that
    they are made for. If DIR already has a certificate authority, trains are added. The serial number of each
    certificate is printed; to revoke a certificate, write its serial number into revoked.txt in the centre's folder.
    Key files are readable only by the user who made them.

    Example: `railfix ground keys keys --train 1 --train 2`

    Exit codes are listed in `railfix --help`; the code is 8 if all certificates exist already.
    """
    from cryptography.x509 import load_pem_x509_certificate

    from railfix.ground.keys import renew_keys, write_keys

    if not all(0 < number < 1 << 32 for number in choices.train):
        raise SettingsError("--train: expected a number from 1 to 4294967295")
    make = renew_keys if choices.renew == "renew" else write_keys
    files = make(out, sorted(set(choices.train)), valid_days=choices.days)
    console = TableConsole()
    show_files(console, files)
    for path in files:
        if path.suffix == ".pem":
            certificate = load_pem_x509_certificate(path.read_bytes())
            ends = certificate.not_valid_after_utc.date().isoformat()
            console.print(f"{path.name}: serial number {certificate.serial_number:#x}, expires on {ends}")


class DemoChoices(Settings):
    """Options of `railfix ground demo`."""

    seed: int = option("Seed of the random losses and noise.", 1, metavar="N", ge=0)
    speed: float = option("Ratio of simulated time to real time.", 6.0, metavar="X", ge=1, le=50)
    port: int = option("Port of the page; 0 for any free port.", 0, metavar="PORT", ge=0, le=65535)
    hold: float = option("Time for which the page stays open after the demonstration.", 0.0, metavar="S", ge=0, le=3600)
    coverage: Path | None = option(
        "Plots of the response rates of the links along the line, and of round-trip times over time and over chainage.",
        None,
        metavar="PNG",
    )
    overwrite: Overwrite = option("Replace existing results.", "refuse", name="--overwrite")


@app.command("demo", cls=Command)
@from_models
def demo(choices: DemoChoices) -> None:
    """Demonstrate a control centre, two trains with two lossy links each, and a satellite fault.

    The trains meet in a passing loop. One bearer fails for both trains; later, both bearers of one train fail. At the
    end, a satellite clock drifts; the reference triangle detects the drift, satellite positioning is suspended, and the
    trains stop. The centre's page shows the trains. All traffic stays on loopback addresses. The program ends after
    about half a minute with a table of events.

    Example: `railfix ground demo --hold 60`

    Exit codes are listed in `railfix --help`.
    """
    import asyncio
    import secrets

    from railfix.ground.demo import run_demo

    check_outputs((choices.coverage, "picture"), overwrite=choices.overwrite == "replace", inputs=[])
    console, password = TableConsole(), secrets.token_urlsafe(12)

    def announce(url: str) -> None:
        console.print(f"the page, to open in a browser: {url}")
        console.print(f"password for orders: {password}")

    async def keep(_: str) -> None:
        await asyncio.sleep(choices.hold)

    try:
        figures = asyncio.run(
            run_demo(
                seed=choices.seed,
                speed=choices.speed,
                port=choices.port,
                password=password,
                announce=announce,
                keep=keep,
                picture=choices.coverage,
            )
        )
    except OSError as error:
        raise OutputError(f"the demonstration cannot use its loopback addresses ({error.strerror})") from None
    _show_figures(figures)


class CentreChoices(Settings):
    """Options of the centre: addresses of its page, file of passwords, and duration of the session."""

    page: str = option("Address of the page; port 0 for any free port.", "127.0.0.1:8000", metavar="HOST:PORT")
    password: Path | None = option(
        "File whose first line is the password for giving orders; each further line has the NAME and PASSWORD of one "
        "person. Without this file, a password is generated and printed.",
        None,
        metavar="FILE",
    )
    orders: str | None = option(
        "Separate address that accepts orders; the address of --page then accepts none.", None, metavar="HOST:PORT"
    )
    for_s: float | None = option("End after this time (by default at a signal).", None, name="--for", metavar="S", ge=0)


@app.command("centre", cls=Command)
@from_models
def centre(
    choices: CentreChoices,
    *,
    path: Annotated[Path, typer.Argument(metavar="CENTRE.toml", help="File with line, trains, keys and addresses.")],
) -> None:
    r"""Supervise the trains of a line: receive reports, send authorities, move points, set routes, show a page.

    Trains connect over two QUIC links with the certificates of `railfix ground keys`. Position reports are written into
    a database before they are acknowledged, and movement authorities before they are sent. Therefore, the centre may be
    killed and restarted at any time. The page can be read without a log-in; releasing a stop and setting a route by
    hand require a log-in. The movement of points (switches) is simulated.

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

    Exit codes are listed in `railfix --help`; the code is 143 after SIGTERM.
    """
    import asyncio
    import secrets

    from railfix.ground.serve import parse_address, read_passwords, run_centre

    console, password = TableConsole(), choices.password
    try:
        address = parse_address(choices.page)
        desk = None if choices.orders is None else parse_address(choices.orders)
    except ValueError as error:
        raise SettingsError(f"--page {choices.page!r}, --orders {choices.orders!r}: {error}") from None
    word, people = (secrets.token_urlsafe(12), {}) if password is None else read_passwords(password)
    words = iter(("the page, to open in a browser", "the page for orders, to open in a browser"))

    def announce(url: str) -> None:
        console.print(f"{next(words)}: {url}")
        if password is None:
            console.print(f"password for orders: {word}")

    work = run_centre(
        path, page=address, orders=desk, password=word, people=people, for_s=choices.for_s, announce=announce
    )
    terminated, figures = asyncio.run(work)
    _show_figures(figures)
    if terminated:
        raise SystemExit(SIGNALLED + signal.SIGTERM)


class TrainChoices(Settings):
    """Options of the on-board end of the links."""

    keys: Path = option("Folder with authority.pem and the train's key and certificate.", metavar="DIR")
    centre: tuple[str, ...] = option(
        "Address of the centre on bearer A, then the centre's address on bearer B.", metavar="HOST:PORT"
    )
    local: tuple[str, ...] = option(
        "Local address on bearer A, then on bearer B; by default, the system chooses the addresses.", (), metavar="HOST"
    )
    integrity: Path | None = option(
        'File to which the train integrity device writes "complete" at least every 2 s.', None, metavar="FILE"
    )
    for_s: float | None = option("End after this time.", None, name="--for", metavar="S", ge=0)


@app.command("train", cls=Command)
@from_models
def train(
    choices: TrainChoices,
    limits: OnBoardLimits,
    *,
    number: Annotated[int, typer.Argument(metavar="N", min=1, help="Number of the train.")],
) -> None:
    """Send the positions of a train to the centre over two links, and receive the train's movement authorities.

    The command reads position messages as JSON lines from standard input (`railfix live ... --send json@-`) and reports
    the newest message every second. It writes a JSON line for each authority, for each beginning and end of braking,
    and for each input line that is not a position message. At the end of the input, the command waits at most 5 s for
    the answer to the last report, then ends.

    Example: `railfix live ... | railfix ground train 1 --keys keys --centre 10.0.1.1:4433 --centre 10.0.2.1:4433`

    Exit codes are listed in `railfix --help`; if no authority was received, this is reported on standard error, and the
    code is 0.
    """
    import asyncio

    from railfix.ground.links import BEARERS, create_bearers
    from railfix.ground.serve import parse_address
    from railfix.ground.train import run_train

    hosts = choices.local or ("0.0.0.0", "0.0.0.0")
    if len(choices.centre) != 2 or len(hosts) != 2:
        raise SettingsError("give --centre, and --local if it is used, twice: for bearer A, then for bearer B")
    try:
        addresses = dict(zip(BEARERS, map(parse_address, choices.centre), strict=True))
    except ValueError as error:
        raise SettingsError(f"--centre: {error}") from None
    work = run_train(
        number,
        choices.keys,
        create_bearers(addresses, dict(zip(BEARERS, hosts, strict=True))),
        write=lambda line: print(line, flush=True),
        limits=limits,
        integrity=choices.integrity,
        for_s=choices.for_s,
    )
    reports, authorities = asyncio.run(work)
    if not reports:
        typer.echo(
            "railfix ground train: no position was reported, because the input ended before the first report", err=True
        )
    elif not authorities:
        typer.echo(
            f"railfix ground train: no authority was received in answer to {plural(reports, 'report')}; the "
            "page of the centre shows why a report is rejected",
            err=True,
        )


def _show_figures(figures: dict[str, Any]) -> None:
    rows = [
        [name, (", ".join(f"{k} {v}" for k, v in value.items()) or "none") if isinstance(value, dict) else str(value)]
        for name, value in figures.items()
    ]
    show_table(TableConsole(), plain_table(["result", ""], rows, texts=2, boxed=True))
