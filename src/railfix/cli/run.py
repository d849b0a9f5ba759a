"""``railfix run`` computes positions from logs; ``railfix live`` computes positions from streams as they arrive."""

from __future__ import annotations

import signal
import sys
from typing import Annotated, Any, Final

import typer

from railfix.cli.command import SIGNALLED
from railfix.cli.console import prepare_kernels, print_json, progress_bar, show_summary
from railfix.cli.options import (
    Choices,
    JsonOption,
    OutOption,
    VerboseOption,
    Without,
    from_models,
    resolve_settings,
    set_value,
)
from railfix.core.extras import needs_extra
from railfix.core.settings import validate
from railfix.live.settings import LiveInputs, LiveSettings
from railfix.run import RunInputs, RunOptions, run_files

#: Interval after which a thread releases the interpreter to a waiting thread [s]. It is longer than Python's default,
#: because frequent switches cost more time than waiting.
_TURN_S: Final = 0.05


@from_models
def run(
    inputs: Annotated[RunInputs, Without("truth")],
    choices: Choices,
    options: RunOptions,
    *,
    out: OutOption,
    verbose: VerboseOption = False,
    as_json: JsonOption = False,
) -> None:
    r"""Compute positions along the line from receiver logs, navigation files and a track map.

    Logs are RINEX 2, 3 and 4 (plain, .gz, .Z, Hatanaka), UBX, SBF or RTCM 3. The following files are written into DIR:

    - `positions.csv` and `positions.parquet`: chainage with standard deviation, coordinates, and the conventional
      position for comparison; one row per epoch and antenna, also for epochs without a position
    - `train.csv` and `train.parquet` (unless `--filter off`): positions of the filter along the track, each computed
      from all measurements up to the epoch, with speed, direction and the probability of the branch; with `--smooth`,
      also positions computed from earlier and later measurements
    - `tracks.csv` and `tracks.parquet` (if TRACK is a network of tracks in one file): every track near each position,
      with its probability; the route is found from the log, and alternative routes are reported
    - `track.csv`: the track that was used, if it differs from the given map (route of a network, other heights or
      frame)
    - `observations.parquet` (with `--observations`): one row per epoch, satellite and signal
    - `run.json`: versions, hashes of the inputs, settings given and used, counts by status and reason, and
      positioning rate

    Times are the receiver's time tags in GPS time. The results appear in DIR when the run is complete; if the run ends
    with an error, nothing is written.

    Example:

        railfix run --front front.obs --rear rear.obs --nav brdc.nav \
            --track line.csv --vehicle car.toml --out results

    Exit codes are listed in `railfix --help`.
    """
    settings, asked = resolve_settings(choices)
    inputs = inputs.replaced(config=choices.config)
    prepare_kernels()
    sys.setswitchinterval(_TURN_S)
    with progress_bar() as progress:
        summary = run_files(inputs, settings, out=out, options=options, asked=asked, progress=progress)
    if as_json:
        print_json({**summary.verdict.as_dict(), "files": list(summary.files.values())})
    else:
        show_summary(summary, verbose=verbose)


@from_models
def live(
    inputs: Annotated[LiveInputs, Without("reader")],
    choices: Choices,
    *,
    live_setting: Annotated[
        list[str] | None,
        typer.Option(
            "--live",
            metavar="KEY=VALUE",
            rich_help_panel="Choices",
            help="Setting of live operation, such as period_s=0.1; may be repeated. Further keys are pair_wait_s, "
            "reconnect, train, line, facing, front_offset_m and length_m.",
        ),
    ] = None,
) -> None:
    r"""Compute the positions of a train from the streams of its receivers, and send one message per period.

    Streams are UBX, SBF or RTCM 3 with observations, ephemerides and other messages. Ephemerides are used as soon as
    they are complete. SBAS messages are used only with `--sbas stream`. The positions equal those that `railfix run`
    computes from the same epochs and sensor data. A message is sent even for a period without input. Broken connections
    are reopened. The program ends on SIGINT or SIGTERM, or when the inputs of all antennas have ended. On SIGHUP, it
    only prints a message.

    Example:

        railfix live --front tcp://127.0.0.1:3001 --rear tcp://127.0.0.1:3002 --track line.csv \
            --vehicle car.toml --send json@- --send cbor@udp://127.0.0.1:4000

    Exit codes are listed in `railfix --help`; the code is 9 if the two processing channels disagree, 143 after SIGTERM.
    """
    import asyncio

    from railfix.live.command import run_live

    if inputs.channels == "2" or any(text.startswith("cbor@") for text in inputs.send):
        with needs_extra():
            import cbor2  # noqa: F401  so that a missing package is reported before a connection is opened

    settings, _ = resolve_settings(choices)
    values: dict[str, Any] = {}
    for text in live_setting or ():
        set_value(values, text)
    inputs = inputs.replaced(config=settings, live=validate(LiveSettings, values, source="--live"))
    summary, terminated = asyncio.run(run_live(inputs))
    for line in summary:
        typer.echo(line, err=True)
    if terminated:
        raise SystemExit(SIGNALLED + signal.SIGTERM)
