"""``railfix export``: positions of a run in the formats of maps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from railfix.cli.console import console_of_tables, show_files
from railfix.cli.options import OverwriteOption, check_outputs
from railfix.core.errors import InputFileError
from railfix.evaluate.run_folder import TABLES, read_run, tables_of
from railfix.io.positions_export import style_file, write_positions
from railfix.pipeline.tables import rounded
from railfix.run.inputs import located


def export(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `railfix run` wrote.")],
    *,
    out: Annotated[
        Path,
        typer.Option(metavar="FILE", help="File to write; it ends in .kml, .gpx, .geojson, .gpkg or .parquet."),
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
    """Write the positions of a run for maps: KML, GPX, GeoJSON, GeoPackage or GeoParquet.

    The ending of FILE chooses the format. Each position has its time, antenna, status, chainage, standard deviation,
    protection level, speed and track, as far as the run has them; an infinite level is left empty. Epochs without a
    position are left out. Coordinates are WGS 84, heights above the ellipsoid.

    Beside GeoJSON, GeoPackage and GeoParquet comes a style of the same name (`.qml`), by which QGIS colours the
    positions by status.

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
    written = write_positions(rounded(folder.positions), out, description=description)
    console = console_of_tables()
    console.print(f"{written:,} positions of {len(folder.positions):,} epochs and antennas, {what}", markup=False)
    console.print(f"{frame}, heights above the ellipsoid", markup=False)
    show_files(console, [path for path in (out, style) if path is not None])
