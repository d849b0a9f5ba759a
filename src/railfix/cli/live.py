"""``railfix live``: positions from receiver streams as they arrive."""

from __future__ import annotations

import asyncio
import signal
from typing import Annotated, Any

import typer

from railfix.cli.command import SIGNALLED
from railfix.cli.options import Choices, from_models, set_value, settings_of
from railfix.core.settings import validated
from railfix.live.settings import LiveInputs, LiveSettings


@from_models
def live(
    inputs: LiveInputs,
    choices: Choices,
    *,
    live_setting: Annotated[
        list[str] | None,
        typer.Option(
            "--live",
            metavar="KEY=VALUE",
            rich_help_panel="Choices",
            help="One setting of live operation: period_s=0.1, pair_wait_s, reconnect, train, line, facing, "
            "front_offset_m, length_m and others; may be repeated.",
        ),
    ] = None,
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
    from railfix.live.command import run_live

    if inputs.channels == "2" or any(text.startswith("cbor@") for text in inputs.send):
        import cbor2  # noqa: F401  a missing one is reported before anything is opened

    settings, _ = settings_of(choices)
    values: dict[str, Any] = {}
    for text in live_setting or ():
        set_value(values, text)
    inputs = inputs.replaced(config=settings, live=validated(LiveSettings, values, source="--live"))
    summary, terminated = asyncio.run(run_live(inputs))
    for line in summary:
        typer.echo(line, err=True)
    if terminated:
        raise SystemExit(SIGNALLED + signal.SIGTERM)
