"""``railfix map service`` and ``railfix map survey``: positioning quality by chainage, and a map from several runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import polars as pl
import typer

from railfix.cli.console import TableConsole, show_files, show_notes, show_table, show_verdict
from railfix.cli.options import Choices, OverwriteOption, Without, check_outputs, from_models, resolve_settings
from railfix.core.errors import SettingsError
from railfix.core.notebook import plural
from railfix.core.options import option
from railfix.core.settings import INPUTS, Settings
from railfix.core.tables import Column, count, listing, number, percent, plain_table
from railfix.run.inputs import ColumnNames
from railfix.track.survey.runs import SurveyLimits

#: A stretch counts as served if at least this fraction of epochs has a protection level within the alarm limit.
_SERVED: Final = 0.95
_COLUMNS: Final[Sequence[Column]] = (
    ("chainage m", "from_m", count),
    ("epochs", "epochs", count),
    ("satellites", "satellites_median", count),
    ("satellites 5 %", "satellites_p5", count),
    ("rejected %", "rejected_share", percent),
    ("3-D 95 % m", "reflection_p95_m", number),
    ("ok %", "ok_share", percent),
    ("filter %", "tracking_share", percent),
    ("level m", "level_median_m", number),
    ("level 95 % m", "level_p95_m", number),
    ("served %", "within_limit_share", percent),
)


def service(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RESULTS...", help="Folders that `railfix run` wrote with the same map.")
    ],
    *,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.csv", help="Table to write, with one row per stretch.")
    ] = None,
    picture: Annotated[Path | None, typer.Option(metavar="FILE", help="Plot of the table (.png or .svg).")] = None,
    page: Annotated[Path | None, typer.Option(metavar="FILE.html", help="Page to write, with zoomable charts.")] = None,
    stretch: Annotated[float, typer.Option(metavar="M", help="Length of each stretch of the line.")] = 100.0,
    limit: Annotated[float, typer.Option(metavar="M", help="Alarm limit for the protection level.")] = 20.0,
    overwrite: OverwriteOption = False,
) -> None:
    """Report numbers of satellites, indications of reflected signals, and protection levels by chainage.

    The distance of the 3-D position from the line indicates reflected signals, because the 3-D position is computed
    without the map. Several runs at different times of the day are more representative than one run.

    Example: `railfix map service monday-results tuesday-results --out service.csv --page service.html`

    Exit codes are listed in `railfix --help`; the code is 5 if the runs are on different maps.
    """
    from railfix.core.staged_files import write_whole
    from railfix.evaluate.intervals import compute_service

    if not stretch > 0.0 or not limit > 0.0:
        raise SettingsError("--stretch and --limit must be positive")
    check_outputs((out, "csv"), (picture, "picture"), (page, "page"), overwrite=overwrite, inputs=[])
    found = compute_service(runs, stretch_m=stretch, limit_m=limit)
    if out is not None:
        write_whole(out, found.write_csv(float_precision=3))
    if picture is not None:
        from railfix.report.plots.campaign import plot_service

        plot_service(found, picture, title=", ".join(path.name for path in runs), limit_m=limit)
    served = found.filter(pl.col("within_limit_share") >= _SERVED)
    worst = found.sort("within_limit_share", "tracking_share", "ok_share", nulls_last=True).row(0, named=True)
    console = TableConsole()
    verdict = [f"{len(found)} stretches of {stretch:g} m contain epochs of the {plural(runs, 'run')}"]
    if worst["within_limit_share"] is not None:
        verdict.append(
            f"in {len(served)} of them, at least {100 * _SERVED:.0f} % of the epochs have a protection level within "
            f"{limit:g} m; worst stretch {worst['from_m']:.0f} to {worst['to_m']:.0f} m "
            f"({100 * worst['within_limit_share']:.0f} % of its epochs)"
        )
    else:
        verdict.append("the runs have no filter and no protection levels; fractions refer to single-epoch positions")
    show_verdict(console, verdict)
    caption = (
        f"Stretches of {stretch:g} m, with the chainage of their start. Satellites: median and 5th percentile over "
        "the epochs. Level (protection level): median and 95th percentile. 3-D: 95th percentile of the distance of "
        "the 3-D position from the line. Filter: fraction of epochs with a protection level. Served: fraction of "
        "epochs with a protection level within the limit"
    )
    table = listing("service", found, _COLUMNS, caption)
    show_table(console, table)
    if page is not None:
        from railfix.report.charts_page import Sentence, charts_page
        from railfix.report.plots.campaign import service_charts

        title = f"Satellite service: {', '.join(path.name for path in runs)}"
        lead = [Sentence(f"{sentence}.") for sentence in verdict]
        write_whole(page, charts_page(title, service_charts(found, limit), [table], lead=lead), what="page")
    show_files(console, [path for path in (out, picture, page) if path is not None])


class SurveyFiles(Settings):
    """Options of a survey: navigation files, picture, and name of the track."""

    nav: tuple[Path, ...] = option(
        "Navigation file of the logs; repeat the option for several days.", (), metavar="NAV", panel=INPUTS
    )
    picture: Path | None = option(
        "Plot of the map, the runs and the standard deviations (.png or .svg).", None, metavar="FILE"
    )
    name: str | None = option("Name of the track; by default the name of the file.", None, metavar="NAME")


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
    columns: ColumnNames,
    overwrite: OverwriteOption = False,
) -> None:
    """Make one smoothed 3-D track map, with a standard deviation per point, from several runs of ordinary receivers.

    Laps, runs in both directions, standstill and runs over a part of the line are allowed; outliers are down-weighted.
    Logs of observations give a better map than logs of positions, because carrier-phase changes and Dopplers determine
    the shape of the line. The map is the path of the antenna. With runs on several days, the errors that all positions
    of one day have in common are averaged.

    Example: `railfix map survey monday.obs tuesday.obs --nav monday.nav --nav tuesday.nav --out line.csv`

    Exit codes are listed in `railfix --help`; the code is 5 if the runs are not on one line.
    """
    from railfix.run.locate import survey_files
    from railfix.track import write_track_csv

    picture = files.picture
    check_outputs((out, "csv"), (picture, "picture"), overwrite=overwrite, inputs=[*runs, *files.nav])
    settings, _ = resolve_settings(choices)
    surveyed = survey_files(
        runs, files.nav, settings,
        limits=limits, name=files.name or out.stem, reading=columns.logs, columns=columns.names,
    )  # fmt: skip
    result = surveyed.survey
    track = result.track
    write_track_csv(track, out, sigma_m=np.stack([result.sigma_plan_m, result.sigma_height_m], axis=1))
    if picture is not None:
        from railfix.report.plots.network import plot_survey

        plot_survey(surveyed, picture)
    console = TableConsole()
    closed = "closed line" if result.closed else "line"
    weak = result.sigma_plan_m > 2.0 * np.median(result.sigma_plan_m)
    verdict = [
        f"a {closed} of {track.chainage_m[-1]:,.0f} m from {plural(runs, 'run')}, {len(track)} points",
        f"standard deviation across {np.median(result.sigma_plan_m):.1f} m at the median, largest "
        f"{result.sigma_plan_m.max():.1f} m at chainage {track.chainage_m[np.argmax(result.sigma_plan_m)]:.0f} m; in "
        f"height {np.median(result.sigma_height_m):.1f} m, largest {result.sigma_height_m.max():.1f} m",
    ]
    if weak.mean() >= 0.005:
        verdict.append(
            f"{100 * weak.mean():.0f} % of the points have more than twice the median standard deviation; more runs "
            "there, or a dual-frequency receiver, would reduce it"
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
    caption = "Runs, with their cross-track errors as a fraction of the stated standard deviation"
    show_table(console, plain_table(head, rows, caption))
    show_notes(console, [*track.provenance.notes, *surveyed.notes])
    if picture is not None:
        console.print(f"picture: {picture}")
    console.print(f"track map: {out}")
