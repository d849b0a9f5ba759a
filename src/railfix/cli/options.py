"""Options that the commands on logs have in common: inputs, track, span of time."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

INPUTS = "Inputs"
CHOICES = "Choices"
TIMES = ["%Y-%m-%dT%H:%M:%S", "%Y-%m-%dT%H:%M:%S.%f", "%Y-%m-%d"]

FrontOption = Annotated[
    list[Path],
    typer.Option(
        "--front",
        metavar="OBS",
        rich_help_panel=INPUTS,
        help="RINEX observation file of the front (or only) antenna; repeat it for a log in several files.",
    ),
]
NavOption = Annotated[
    list[Path],
    typer.Option("--nav", metavar="FILE", rich_help_panel=INPUTS, help="RINEX navigation file; repeat it for several."),
]
TrackOption = Annotated[
    list[Path],
    typer.Option(
        "--track",
        metavar="TRACK",
        rich_help_panel=INPUTS,
        help="Track map, CSV or GeoJSON; several are joined to a route in the order given.",
    ),
]
RearOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--rear", metavar="OBS", rich_help_panel=INPUTS, help="The same of the rear antenna, where there is one."
    ),
]
Sp3Option = Annotated[
    list[Path] | None,
    typer.Option(
        "--sp3",
        metavar="FILE",
        rich_help_panel=INPUTS,
        help="Precise orbits and clocks, used in place of the broadcast ones.",
    ),
]
VehicleOption = Annotated[
    Path | None,
    typer.Option(
        "--vehicle",
        metavar="TOML",
        rich_help_panel=INPUTS,
        help="Vehicle: bogie distance, gauge, places of the antennas. Without it the track is taken as the "
        "antenna's own path.",
    ),
]
CrsOption = Annotated[
    str | None,
    typer.Option(metavar="EPSG", rich_help_panel=CHOICES, help="CRS of the track where its file does not say."),
]
DatumOption = Annotated[
    str | None,
    typer.Option(metavar="DATUM", rich_help_panel=CHOICES, help="Heights of the track: ellipsoidal or orthometric."),
]
GeoidOption = Annotated[
    str | None,
    typer.Option(
        metavar="MODEL",
        rich_help_panel=CHOICES,
        help="Geoid of orthometric heights: japan, gsigeo2011, or a grid or CRS known to PROJ.",
    ),
]
StartOption = Annotated[
    datetime | None,
    typer.Option(metavar="TIME", formats=TIMES, rich_help_panel=CHOICES, help="Epochs from this on, GPS time."),
]
EndOption = Annotated[
    datetime | None,
    typer.Option(metavar="TIME", formats=TIMES, rich_help_panel=CHOICES, help="Epochs before this, GPS time."),
]
LenientOption = Annotated[
    bool,
    typer.Option(
        "--lenient", rich_help_panel=CHOICES, help="Count broken lines of the logs and go on, instead of stopping."
    ),
]
OverwriteOption = Annotated[
    bool,
    typer.Option("--overwrite", rich_help_panel=CHOICES, help="Replace results that are already in DIR."),
]
OutOption = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results; it is made.")]
