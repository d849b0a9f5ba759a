"""``railfix live``: positions from receiver streams as they arrive."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from railfix.cli.command import SIGNALLED
from railfix.cli.options import OverwriteOption, from_models, overwriting
from railfix.cli.settings import Choices, set_value, settings_of
from railfix.run.options import LogReading, TrackReading


@from_models
def live(
    choices: Choices,
    reading: TrackReading,
    logs: LogReading,
    *,
    front: Annotated[
        str,
        typer.Option(
            "--front",
            metavar="SOURCE",
            help="Stream of the front antenna's receiver: a file, tcp://HOST:PORT, serial:DEVICE?baud=115200, "
            "ntrip://[USER:PASSWORD@]HOST:PORT/MOUNT, or - (standard input).",
        ),
    ],
    track: Annotated[list[Path], typer.Option("--track", metavar="TRACK", help="Track map; repeat it for a route.")],
    rear: Annotated[str | None, typer.Option("--rear", metavar="SOURCE", help="The same of the rear antenna.")] = None,
    vehicle: Annotated[Path | None, typer.Option("--vehicle", metavar="TOML", help="Vehicle of the antennas.")] = None,
    nav: Annotated[
        list[Path] | None,
        typer.Option("--nav", metavar="FILE", help="Navigation files known from the start."),
    ] = None,
    tachometer: Annotated[
        str | None,
        typer.Option(
            "--tachometer",
            metavar="SOURCE",
            help="Pulses of a tachometer: the rows of the table of `railfix run` as lines of CSV, header first, from a "
            "source as of --front; or the whole table, a file. A row with the time alone says that no pulse came.",
        ),
    ] = None,
    inertial: Annotated[
        str | None, typer.Option("--inertial", metavar="SOURCE", help="The same of an inertial unit.")
    ] = None,
    radar: Annotated[
        str | None, typer.Option("--radar", metavar="SOURCE", help="The same of the speeds of a Doppler radar.")
    ] = None,
    ranging: Annotated[
        str | None, typer.Option("--ranging", metavar="SOURCE", help="The same of two-way ranges to ground units.")
    ] = None,
    ranging_units: Annotated[
        Path | None,
        typer.Option("--ranging-units", metavar="CSV", help="Surveyed ground units: unit, x_m, y_m, z_m (ECEF)."),
    ] = None,
    live_setting: Annotated[
        list[str] | None,
        typer.Option(
            "--live",
            metavar="KEY=VALUE",
            help="One setting of live operation: period_s=0.1, pair_wait_s, reconnect, train, line, facing, "
            "front_offset_m, length_m and others; may be repeated.",
        ),
    ] = None,
    send: Annotated[
        list[str] | None,
        typer.Option(
            "--send",
            metavar="FORM@TARGET",
            help="Where messages go: json, cbor, nmea, tpv, etcs, positions or train at -, a file, udp://HOST:PORT, "
            "tcp-server://HOST:PORT or mqtt://[USER:PASSWORD@]HOST:PORT/TOPIC. Default: json@-.",
        ),
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option("--speed", min=0.01, help="Replay files this many times as fast as recorded; else without pause."),
    ] = None,
    channels: Annotated[
        Literal["1", "2"],
        typer.Option("--channels", help="2: a second process checks every message; a difference ends the output."),
    ] = "1",
    metrics: Annotated[
        str | None, typer.Option("--metrics", metavar="HOST:PORT", help="Serve Prometheus text at /metrics.")
    ] = None,
    state: Annotated[
        Path | None,
        typer.Option(
            "--state",
            metavar="FILE",
            help="Write what a restarted session needs into this file now and then, and continue from it.",
        ),
    ] = None,
    log: Annotated[
        Path | None, typer.Option("--log", metavar="FILE", help="Also log into this file, which rotates.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Also write the tables of results into this folder.")
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    r"""Position a train from its receivers' streams, one message a period.

    Streams are UBX, SBF or RTCM 3 with observations, ephemerides and other messages mixed; ephemerides are used from
    the moment they are complete, SBAS messages with `--sbas stream`. The answers are those of `railfix run` on the
    same epochs, with sensors on board too. A period without input has a message. Connections that break are opened
    again. The program ends when files end, or on SIGINT or SIGTERM; SIGHUP reloads nothing, and says so.

    Example:

        railfix live --front tcp://127.0.0.1:3001 --rear tcp://127.0.0.1:3002 --track line.csv \
            --vehicle car.toml --send json@- --send cbor@udp://127.0.0.1:4000

    Exit codes as `railfix --help` says; 9 where two channels disagree; 143 at the end by SIGTERM.
    """
    from railfix.live.command import LiveInputs, Sensor, run_live

    if channels == "2" or any(text.startswith("cbor@") for text in send or ()):
        import cbor2  # noqa: F401  a missing one is reported before anything is opened

    sources: dict[Literal["front", "rear"], str] = {"front": front}
    if rear is not None:
        sources["rear"] = rear
    named: dict[Sensor, str | None] = {
        "tachometer": tachometer, "inertial": inertial, "radar": radar, "ranging": ranging,
    }  # fmt: skip
    settings, asked = settings_of(choices)
    if "filter" not in asked:
        settings = settings.replaced(filter="track")
    live_values: dict[str, Any] = {}
    for text in live_setting or ():
        set_value(live_values, text)
    inputs = LiveInputs(
        sources=sources,
        track=tuple(track),
        vehicle=vehicle,
        nav=tuple(nav or ()),
        sensors={name: source for name, source in named.items() if source is not None},
        ranging_units=ranging_units,
        config=settings,
        reading=reading,
        logs=logs,
        live=live_values,
        send=tuple(send or ("json@-",)),
        speed=speed,
        channels=2 if channels == "2" else 1,
        metrics=metrics,
        state=state,
        log=log,
        out=out,
        overwrite=overwriting(overwrite),
    )
    summary, terminated = asyncio.run(run_live(inputs))
    for line in summary:
        typer.echo(line, err=True)
    if terminated:
        raise SystemExit(SIGNALLED + signal.SIGTERM)
