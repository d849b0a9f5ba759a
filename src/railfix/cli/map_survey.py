"""``railfix map survey``: several runs of ordinary receivers to one track map."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from railfix.cli.console import console_of_tables, show_notes, show_table, show_verdict
from railfix.cli.options import OverwriteOption, Without, check_outputs, from_models
from railfix.cli.settings import Choices, settings_of
from railfix.core.files import BrokenLines
from railfix.core.settings import INPUTS, Settings, option
from railfix.core.tables import Table, count, number
from railfix.run.options import ColumnNames, LogReading
from railfix.track.survey.runs import SurveyLimits


class SurveyFiles(Settings):
    """Files beside the runs, and how they are read."""

    nav: tuple[Path, ...] = option(
        "Navigation file of the logs; repeat it for several days.", (), metavar="NAV", panel=INPUTS
    )
    picture: Path | None = option("Picture of map, runs and standard deviations (.png or .svg).", None, metavar="FILE")
    name: str | None = option("Name of the track; else that of the file.", None, metavar="NAME")
    broken_lines: BrokenLines = option(
        "Count broken lines of the input files and continue, instead of stopping.", "stop", name="--lenient"
    )


@from_models
def survey(
    runs: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN...",
            help="Runs over one line: logs of observations (RINEX, UBX, SBF, RTCM 3) or positions (`.pos`, NMEA, GPX, "
            "NovAtel ASCII, CSV with named columns).",
        ),
    ],
    *,
    out: Annotated[Path, typer.Option(metavar="TRACK.csv", help="Track map to write.")],
    files: SurveyFiles,
    limits: SurveyLimits,
    choices: Annotated[Choices, Without("screens", "without", "filter", "cn0_curve", "error_model", "sbas")],
    reading: LogReading,
    columns: ColumnNames,
    overwrite: OverwriteOption = False,
) -> None:
    """Make one smoothed 3-D track map of several runs of ordinary receivers, with its standard deviation by point.

    Laps, both directions, standstill and runs over a part of the line are allowed; outliers lose their weight. Logs of
    observations make a better map than their positions: changes of the carrier phase and Dopplers give the shape.
    The map is the path of the antenna. Runs of other days average what all positions of one day share.

    Example: `railfix map survey monday.obs tuesday.obs --nav monday.nav --nav tuesday.nav --out line.csv`

    Exit codes as `railfix --help` says; 5 where the runs lie apart.
    """
    from railfix.run.survey import survey_files
    from railfix.track import write_track_csv

    picture = files.picture
    check_outputs((out, "csv"), (picture, "picture"), overwrite=overwrite, inputs=[*runs, *files.nav])
    settings, _ = settings_of(choices)
    surveyed = survey_files(
        runs, files.nav, settings,
        limits=limits, name=files.name or out.stem, reading=reading, columns=columns.names,
        broken_lines=files.broken_lines,
    )  # fmt: skip
    result = surveyed.survey
    track = result.track
    write_track_csv(track, out, sigma_m=np.stack([result.sigma_plan_m, result.sigma_height_m], axis=1))
    if picture is not None:
        from railfix.report.plots.network import plot_survey

        plot_survey(surveyed, picture)
    console = console_of_tables()
    closed = "closed line" if result.closed else "line"
    weak = result.sigma_plan_m > 2.0 * np.median(result.sigma_plan_m)
    verdict = [
        f"a {closed} of {track.chainage_m[-1]:,.0f} m from {len(runs)} run(s), {len(track)} points",
        f"standard deviation across {np.median(result.sigma_plan_m):.1f} m at the median, largest "
        f"{result.sigma_plan_m.max():.1f} m at chainage {track.chainage_m[np.argmax(result.sigma_plan_m)]:.0f} m; in "
        f"height {np.median(result.sigma_height_m):.1f} m, largest {result.sigma_height_m.max():.1f} m",
    ]
    if weak.any():
        verdict.append(
            f"{weak.mean():.0%} of it is worse than twice the median: more runs there, or a receiver of two bands, help"
        )
    show_verdict(console, verdict)
    rows = [
        [
            Path(run.name).name,
            count(int(np.isfinite(run.ecef_m[:, 0]).sum())),
            count(float(np.linalg.norm(np.diff(ecef, axis=0), axis=1).sum())),
            number(scale),
        ]
        for run, ecef, scale in zip(surveyed.runs, result.runs_ecef_m, result.scale, strict=True)
    ]
    head = ["run", "positions", "run m", "sigma / stated"]
    show_table(
        console,
        Table(
            name="survey",
            head=head,
            rows=rows,
            caption="Runs, with their errors across as a share of the standard deviation that they state",
            numeric=range(1, 4),
        ),
    )
    show_notes(console, [*track.provenance.notes, *surveyed.notes])
    if picture is not None:
        console.print(f"picture: {picture}", markup=False, soft_wrap=True)
    console.print(f"track map: {out}", markup=False, soft_wrap=True)
