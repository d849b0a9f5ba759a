"""Commands on files: convert, export, examine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from railfix.cli.console import console_of_tables, show_files
from railfix.cli.options import OverwriteOption, check_outputs, from_models, overwriting
from railfix.core.errors import InputFileError, SettingsError
from railfix.evaluate.run_folder import TABLES, read_run, tables_of
from railfix.io.positions_export import style_file, write_positions
from railfix.pipeline.tables import rounded
from railfix.run.doctor import examine_files
from railfix.run.inputs import located
from railfix.run.mcap import write_mcap
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


def export(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `railfix run` wrote.")],
    *,
    out: Annotated[
        Path,
        typer.Option(metavar="FILE", help="File to write; it ends in .kml, .gpx, .geojson, .gpkg, .parquet or .mcap."),
    ],
    filtered: Annotated[
        bool | None,
        typer.Option(
            "--filter/--single",
            help="Positions of the filter along the track, or of single epochs; the filter's unless given, where the "
            "run has them.",
        ),
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Write the positions of a run for maps and ROS 2: KML, GPX, GeoJSON, GeoPackage, GeoParquet or MCAP.

    The ending of FILE chooses the format. Each position has its time, antenna, status, chainage, standard deviation,
    protection level, speed and track, as far as the run has them; an infinite level is left empty. Epochs without a
    position are left out. Coordinates are WGS 84, heights above the ellipsoid.

    Beside GeoJSON, GeoPackage and GeoParquet comes a style of the same name (`.qml`), by which QGIS colours the
    positions by status. MCAP has every column of the run.

    Example: `railfix export results --out positions.gpkg`

    Exit codes: 0 done; 3 RUN is not what it should be; 4 a package is not installed; 7 no epoch has a position;
    8 the file cannot be written.
    """
    tables = tables_of(run)
    if filtered and tables and "train" not in tables:
        raise InputFileError(
            run, "has no positions of the filter; leave --filter out, or repeat the run with the filter"
        )
    table = "train" if filtered or (filtered is None and "train" in tables) else "positions"
    folder = read_run(run, table=table)
    results = [run / f"{name}.parquet" for name in (*TABLES, "observations", "tracks")]
    inputs = [run / "run.json", *results, *(located(entry, run) for entry in folder.entries)]
    style = style_file(out)
    check_outputs((out, "map"), (style, "any"), overwrite=overwrite, inputs=inputs)
    used = folder.track_facts.get("frame", {}).get("used", "")
    frame = "WGS 84" + (f" ({used})" if used else "")
    what = "filter along the track" if table == "train" else "single epochs"
    description = f"Antenna positions of railfix, {what}, {folder.line_name}; {frame}, heights above the ellipsoid"
    write = write_mcap if out.suffix.lower() == ".mcap" else write_positions
    written = write(rounded(folder.positions), out, description=description)
    console = console_of_tables()
    console.print(f"{written:,} positions of {len(folder.positions):,} epochs and antennas, {what}", markup=False)
    console.print(f"{frame}, heights above the ellipsoid", markup=False)
    show_files(console, [path for path in (out, style) if path is not None])


def doctor(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Logs, navigation, track, vehicle, references.")
    ],
) -> None:
    """Examine files before a run: what each is, whether they fit together, and the command to run.

    The kind of a file is found by its content: a log of observations, navigation, a track map, positions, a vehicle or
    settings. First comes what does not fit together or is missing, then the command, ready to copy, then the facts of
    each file (span in GPS time, rate, gaps, satellites, signals, place, frame, heights). Nothing is written.

    Example: `railfix doctor front.obs brdc.nav line.csv car.toml`

    Exit codes: 0 everything fits; 3 a file is missing; 5 something does not fit, is missing or of no known kind.
    """
    diagnosis = examine_files(files)
    console = console_of_tables()
    problems = diagnosis.problems
    verdict = f"{len(problems)} thing(s) to mend" if problems else "the files fit together"
    console.print(f"{len(diagnosis.findings)} files: {verdict}", markup=False)
    for problem in problems:
        console.print(f"- {problem}", markup=False, soft_wrap=True)
    if diagnosis.command:
        console.print(f"run: {diagnosis.command}", markup=False, soft_wrap=True)
    for finding in diagnosis.findings:
        console.print(f"\n{finding.path}: {finding.kind}", markup=False, soft_wrap=True)
        if finding.span is not None:
            first, last = (str(time)[:19].replace("T", " ") for time in finding.span)
            console.print(f"  {first} to {last} GPS time", markup=False)
        for fact in finding.facts:
            console.print(f"  {fact}", markup=False, soft_wrap=True)
    if problems:
        raise typer.Exit(5)
