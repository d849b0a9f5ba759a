"""``railfix convert``: receiver logs to RINEX."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from railfix.cli.options import OverwriteOption, from_models, overwriting
from railfix.core.errors import SettingsError
from railfix.run.options import LogReading


@from_models
def convert(
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="Logs of one receiver: UBX, SBF, RTCM 3, or RINEX; plain or packed."),
    ],
    reading: LogReading,
    *,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="OBS", help="RINEX observation file to write; .gz, .crx and .crx.gz pack it."),
    ] = None,
    nav_out: Annotated[
        Path | None, typer.Option("--nav-out", metavar="NAV", help="RINEX navigation file to write; .gz packs it.")
    ] = None,
    rinex: Annotated[
        Literal["3", "4"], typer.Option("--rinex", help="Version of RINEX to write: 3 (3.04) or 4 (4.02).")
    ] = "3",
    overwrite: OverwriteOption = False,
) -> None:
    """Write the observations and the ephemerides of receiver logs as RINEX files.

    The kind of a log is detected from its content. UBX needs RXM-RAWX for observations and RXM-SFRBX for
    ephemerides; SBF MeasEpoch and raw navigation pages; RTCM 3 MSM4 to MSM7 and 1019, 1020, 1042,
    1044 to 1046. Skipped items (damaged bytes, unknown signals, messages of other kinds) are
    counted and printed.

    Example: `railfix convert drive.ubx --out drive.rnx --nav-out drive.nav`

    Exit codes as `railfix --help` says; 3 where a log holds nothing of what was asked for.
    """
    if out is None and nav_out is None:
        raise SettingsError("nothing to write: give --out for observations, --nav-out for ephemerides, or both")
    from railfix.run.convert import convert_logs

    lines = convert_logs(
        tuple(logs), out=out, nav_out=nav_out, rinex=rinex, reading=reading, overwrite=overwriting(overwrite)
    )
    for line in lines:
        typer.echo(line)
