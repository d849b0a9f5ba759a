"""``railfix live``: positions from receiver streams as they arrive."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from railfix.cli.options import OverwriteOption


def live(
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
    config: Annotated[
        Path | None, typer.Option("--config", metavar="TOML", help="Settings of the positioning.")
    ] = None,
    setting: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One setting over the file's.")
    ] = None,
    live_setting: Annotated[
        list[str] | None,
        typer.Option(
            "--live",
            metavar="KEY=VALUE",
            help="One setting of live operation: period_s=0.1, pair_wait_s, train, line, "
            "facing, front_offset_m, length_m.",
        ),
    ] = None,
    send: Annotated[
        list[str] | None,
        typer.Option(
            "--send",
            metavar="FORM@TARGET",
            help="Where messages go: json, cbor, nmea or tpv at -, a file, udp://HOST:PORT, tcp-server://HOST:PORT or "
            "mqtt://HOST:PORT/TOPIC. Default: json@-.",
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
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Also write the tables of results into this folder.")
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    r"""Position a train from its receivers' streams, one message a period.

    Streams are UBX or RTCM 3 with observations, ephemerides and other messages mixed; ephemerides are used from the
    moment they are complete. The answers are those of `railfix run` on the same epochs. A period without input has
    a message too. The program ends when the sources end, or on SIGINT or SIGTERM.

    Example:

        railfix live --front tcp://127.0.0.1:3001 --rear tcp://127.0.0.1:3002 --track line.csv \
            --vehicle car.toml --send json@- --send cbor@udp://127.0.0.1:4000

    Exit codes as `railfix --help` says; 9 where two channels disagree.
    """
    from railfix.live.command import LiveInputs, run_live

    sources: dict[Literal["front", "rear"], str] = {"front": front}
    if rear is not None:
        sources["rear"] = rear
    inputs = LiveInputs(
        sources=sources,
        track=tuple(track),
        vehicle=vehicle,
        nav=tuple(nav or ()),
        config=config,
        settings=_pairs(setting),
        live=_pairs(live_setting),
        send=tuple(send or ("json@-",)),
        speed=speed,
        channels=2 if channels == "2" else 1,
        metrics=metrics,
        out=out,
        overwrite="replace" if overwrite else "refuse",
    )
    for line in asyncio.run(run_live(inputs)):
        typer.echo(line, err=True)


def _pairs(settings: list[str] | None) -> dict[str, Any]:
    """Nested values of KEY=VALUE settings."""
    from railfix.cli.settings import set_value

    values: dict[str, Any] = {}
    for text in settings or ():
        set_value(values, text)
    return values
