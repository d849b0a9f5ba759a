"""Commands ``railfix locate``, ``which-track``, ``convert``, ``export`` and ``doctor`` on logs and other files."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer

from railfix.cli.console import TableConsole, print_json, show_files, show_notes, show_table
from railfix.cli.options import (
    Choices,
    JsonOption,
    OverwriteOption,
    Without,
    check_outputs,
    from_models,
    overwriting,
    resolve_settings,
)
from railfix.core.errors import InputFileError, SettingsError
from railfix.core.notebook import plural
from railfix.core.tables import plain_table
from railfix.evaluate.evaluation_inputs import TABLES, list_position_tables, read_run
from railfix.io.positions_export import style_file, write_positions
from railfix.pipeline.result_tables import round_floats
from railfix.run.convert import write_mcap
from railfix.run.inputs import LogReading, input_path
from railfix.run.locate import LocateInputs, locate_files
from railfix.run.which_track import WhichTrackInputs, WhichTrackOptions, which_track_files, write_last_place


@from_models
def locate(
    inputs: LocateInputs,
    choices: Annotated[Choices, Without("screens", "without", "filter", "cn0_curve", "error_model", "sbas")],
    reading: LogReading,
    *,
    out: Annotated[Path, typer.Option(metavar="FILE.pos", help="File for the positions, in RTKLIB's solution format.")],
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compute conventional 3-D positions with standard deviations from a log, without a track map.

    Pseudoranges that are inconsistent with the others are excluded. The positions have quality 5 (single); `railfix map
    match` matches them to the tracks of a network. To make a map, use `railfix map survey` with the logs, because a map
    made from these positions would be worse.

    Example: `railfix locate --log front.obs --nav brdc.nav --out front.pos`

    Exit codes are listed in `railfix --help`; the code is 7 if no epoch has a position.
    """
    check_outputs((out, "pos"), overwrite=overwrite, inputs=inputs.paths)
    settings, _ = resolve_settings(choices)
    summary = locate_files(inputs, settings, out=out, reading=reading)
    if as_json:
        print_json({**asdict(summary), "files": [out]})
        return
    console = TableConsole()
    north, east, up = summary.sigma_m
    console.print(
        f"{summary.epochs} epochs, {summary.positions} positions; median sigma {north:.2f} m north, {east:.2f} m east, "
        f"{up:.2f} m up"
    )
    show_notes(console, summary.notes)
    console.print(f"positions: {out}")


@from_models
def which_track(
    inputs: WhichTrackInputs,
    options: Annotated[WhichTrackOptions, Without("reference", "height_sigma")],
    choices: Annotated[Choices, Without("screens", "without", "filter", "cn0_curve", "error_model", "sbas")],
    *,
    out: Annotated[
        Path | None, typer.Option(metavar="PICTURE", help="Plot of the probabilities over time (.png or .svg).")
    ] = None,
    save_last: Annotated[
        Path | None,
        typer.Option(
            "--save-last",
            metavar="FILE.json",
            help="File for the track probabilities, to be used with --last at the next start.",
        ),
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Determine the track on which a train stands, or report `undecided`.

    Each track of the map within 60 m is a hypothesis; a further hypothesis is that the track is missing from the map
    (`none`). At rest, the code errors of a satellite are nearly constant, so averaging over a longer time reduces them
    little. With a base station, carrier phases are also used. The train is reported to be on a track when the total
    probability of all other hypotheses is below `--risk`; the probabilities are always printed.

    Example: `railfix which-track --front front.obs --rear rear.obs --spacing 18 --nav brdc.nav --map yard.gpkg`

    Exit codes are listed in `railfix --help`; the code is 5 if the train moves or no track is near.
    """
    check_outputs((out, "picture"), (save_last, "any"), overwrite=overwrite, inputs=inputs.paths)
    settings, _ = resolve_settings(choices)
    decision = which_track_files(inputs, options, settings)
    console = TableConsole()
    last = decision.posteriors[-1]
    decided = "" if np.isnan(decision.decided_s) else f", decided after {decision.decided_s:.0f} s"
    console.print(f"track: {decision.track}{decided} (risk {options.risk:g})")
    if not last.fits:
        console.print("the codes do not fit the error model (--code-bias-m, --code-noise-m), so no decision is made")
    rows = []
    facing = np.append(last.with_rising, np.nan)
    for k in np.argsort(-last.probability):
        share = facing[k] / last.probability[k] if last.probability[k] > 0.0 and np.isfinite(facing[k]) else np.nan
        rows.append([last.names[k], f"{last.probability[k]:.6f}", "" if np.isnan(share) else f"{share:.4f}"])
    show_table(console, plain_table(["track", "probability", "facing its direction"], rows, texts=3))
    show_notes(console, decision.notes)
    if save_last is not None:
        write_last_place(last, decision.end, save_last)
        console.print(f"track probabilities: {save_last}")
    if out is not None:
        from railfix.report.plots.network import plot_track_decision

        plot_track_decision(decision, out, risk=options.risk)
        console.print(f"picture: {out}")


@from_models
def convert(
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="Logs of one receiver: UBX, SBF, RTCM 3, or RINEX; plain or compressed."),
    ],
    reading: LogReading,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="OBS",
            help="RINEX observation file to write; it is compressed if the name ends in .gz, .crx or .crx.gz.",
        ),
    ] = None,
    nav_out: Annotated[
        Path | None,
        typer.Option(
            "--nav-out", metavar="NAV", help="RINEX navigation file to write; it is compressed if the name ends in .gz."
        ),
    ] = None,
    rinex: Annotated[
        Literal["3", "4"], typer.Option("--rinex", help="Version of RINEX to write: 3 (3.04) or 4 (4.02).")
    ] = "3",
    overwrite: OverwriteOption = False,
) -> None:
    """Write the observations and the ephemerides of receiver logs as RINEX files.

    The format of a log is detected from its content. Observations are read from the UBX messages RXM-RAWX, the SBF
    blocks MeasEpoch, and the RTCM 3 messages MSM4 to MSM7. Ephemerides are read from the UBX messages RXM-SFRBX, the
    raw navigation pages of SBF, and the RTCM 3 messages 1019, 1020, 1042 and 1044 to 1046. Skipped data (damaged bytes,
    unknown signals, other messages) are counted and reported.

    Example: `railfix convert drive.ubx --out drive.rnx --nav-out drive.nav`

    Exit codes are listed in `railfix --help`; the code is 3 if a log contains nothing that was requested.
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
        Path, typer.Option(metavar="FILE", help="File to write (.kml, .gpx, .geojson, .gpkg, .parquet or .mcap).")
    ],
    filtered: Annotated[
        bool | None,
        typer.Option(
            "--filter/--single",
            help="Whether to write the positions of the filter (--filter) or of single epochs (--single); by default "
            "the filter's positions if the run has them.",
        ),
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Write the positions of a run as KML, GPX, GeoJSON, GeoPackage, GeoParquet or MCAP (ROS 2).

    The extension of FILE selects the format. Each position has the time, antenna, status, chainage, standard deviation,
    protection level, speed and track, as far as the run has them; an infinite protection level is left empty. Epochs
    without a position are omitted. Coordinates are WGS 84 with ellipsoidal heights.

    With GeoJSON, GeoPackage and GeoParquet files, a style file of the same name (`.qml`) is written, with which QGIS
    colours the positions by status. MCAP files have every column of the run.

    Example: `railfix export results --out positions.gpkg`

    Exit codes are listed in `railfix --help`; the code is 4 if a package that the format needs is not installed, 7 if
    no epoch has a position.
    """
    tables = list_position_tables(run)
    if filtered and tables and "train" not in tables:
        raise InputFileError(run, "has no positions of the filter; omit --filter, or repeat the run with the filter")
    table = "train" if filtered or (filtered is None and "train" in tables) else "positions"
    folder = read_run(run, table=table)
    results = [run / f"{name}.parquet" for name in (*TABLES, "observations", "tracks")]
    inputs = [run / "run.json", *results, *(input_path(entry, run) for entry in folder.entries)]
    style = style_file(out)
    check_outputs((out, "map"), (style, "any"), overwrite=overwrite, inputs=inputs)
    used = folder.track_facts.get("frame", {}).get("used", "")
    frame = "WGS 84" + (f" ({used})" if used else "")
    what = "filter along the track" if table == "train" else "single epochs"
    description = f"Antenna positions of railfix, {what}, {folder.line_name}; {frame}, heights above the ellipsoid"
    write = write_mcap if out.suffix.lower() == ".mcap" else write_positions
    written = write(round_floats(folder.positions), out, description=description)
    console = TableConsole()
    console.print(f"{written:,} of {len(folder.positions):,} possible positions, {what}")
    console.print(f"{frame}, heights above the ellipsoid")
    show_files(console, [path for path in (out, style) if path is not None])


@from_models
def doctor(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...", help="Files to identify: logs, navigation, track maps, vehicles, references, settings."
        ),
    ],
    *,
    reading: Annotated[LogReading, Without("broken_lines", "reader")],
    as_json: JsonOption = False,
) -> None:
    """Identify files before a run, check whether they fit together, and print the command to run.

    Each file is identified from its content: observation log, navigation file, track map, log of positions, vehicle
    file or settings. Mismatches and missing files are printed first, then the command, ready to copy. The properties of
    each file follow (span in GPS time, rate, gaps, satellites, signals, position, frame, heights). No file is written.

    Example: `railfix doctor front.obs brdc.nav line.csv car.toml`

    The exit code is 0 if all files fit together, 3 if a given file does not exist, and 5 if files do not
    match, a required file is missing, or the kind of a file is unknown.
    """
    from railfix.run.doctor import examine_files

    diagnosis = examine_files(files, date=reading.instant)
    problems = diagnosis.problems
    if as_json:
        print_json(diagnosis.as_dict())
        raise typer.Exit(5 if problems else 0)
    console = TableConsole()
    verdict = f"{plural(problems, 'problem')} to fix" if problems else "the files fit together"
    console.print(f"{plural(diagnosis.findings, 'file')}: {verdict}")
    for problem in problems:
        console.print(f"- {problem}")
    if diagnosis.command:
        console.print(f"run: {diagnosis.command}")
    for finding in diagnosis.findings:
        console.print(f"\n{finding.path}: {finding.kind}")
        if finding.span is not None:
            first, last = (str(time)[:19].replace("T", " ") for time in finding.span)
            console.print(f"  {first} to {last} GPS time")
        for fact in finding.facts:
            console.print(f"  {fact}")
    if problems:
        raise typer.Exit(5)
