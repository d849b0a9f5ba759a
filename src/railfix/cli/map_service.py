"""``railfix map service``: where satellites can serve on a line."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import polars as pl
import typer
from rich.table import Table

from railfix.cli.console import console_of_tables, metres, percent, show_files, show_verdict
from railfix.cli.options import OverwriteOption, check_outputs
from railfix.core.errors import SettingsError

#: Share of the epochs of a stretch within the alarm limit from which satellites serve there.
_SERVED: Final = 0.95


def service(
    runs: Annotated[list[Path], typer.Argument(metavar="RESULTS...", help="Folders of `railfix run` on one map.")],
    *,
    out: Annotated[Path | None, typer.Option(metavar="FILE.csv", help="Table to write, a row by stretch.")] = None,
    picture: Annotated[Path | None, typer.Option(metavar="FILE", help="Picture to write (.png or .svg).")] = None,
    stretch: Annotated[float, typer.Option(metavar="M", help="Length of a stretch.")] = 100.0,
    limit: Annotated[float, typer.Option(metavar="M", help="Alarm limit of the level.")] = 20.0,
    overwrite: OverwriteOption = False,
) -> None:
    """Show by chainage where satellites can serve on a line: satellites, reflections, share of ok, levels.

    Reflections show in the distance of the 3-D position, which does not use the map, from the line. Several runs, at
    other times of the day, say more than one.

    Example: `railfix map service monday-results tuesday-results --out service.csv --picture service.png`

    Exit codes as `railfix --help` says; 5 where the runs are on different maps.
    """
    from railfix.core.files import write_whole
    from railfix.evaluate.service import compute_service

    if not stretch > 0.0 or not limit > 0.0:
        raise SettingsError("--stretch and --limit must be positive")
    check_outputs((out, "csv"), (picture, "picture"), overwrite=overwrite, inputs=[])
    found = compute_service(runs, stretch_m=stretch, limit_m=limit)
    if out is not None:
        write_whole(out, found.write_csv(float_precision=3))
    if picture is not None:
        from railfix.report.plots.service import plot_service

        plot_service(found, picture, title=", ".join(path.name for path in runs), limit_m=limit)
    served = found.filter(pl.col("within_limit_share") >= _SERVED)
    worst = found.sort("within_limit_share", "tracking_share", "ok_share", nulls_last=True).row(0, named=True)
    console = console_of_tables()
    verdict = [f"{len(found)} stretches of {stretch:g} m passed by {len(runs)} run(s)"]
    if worst["within_limit_share"] is not None:
        verdict.append(
            f"{len(served)} of them have a level within {limit:g} m in {_SERVED:.0%} of the epochs or more; worst from "
            f"{worst['from_m']:.0f} to {worst['to_m']:.0f} m: {worst['within_limit_share']:.0%}"
        )
    else:
        verdict.append("the runs have no filter and no levels; the shares are those of single epochs")
    show_verdict(console, verdict)
    table = Table(
        "chainage m", "epochs", "satellites", "least (5 %)", "rejected %", "3-D off m", "ok %", "filter %", "level m",
        "level 95 % m", "served %", show_edge=False,
    )  # fmt: skip
    for row in found.iter_rows(named=True):
        satellites = [f"{row[n]:.0f}" for n in ("satellites_median", "satellites_p5")]
        table.add_row(
            f"{row['from_m']:.0f}", f"{row['epochs']:,}", *satellites, percent(row["rejected_share"]),
            metres(row["reflection_p95_m"]), percent(row["ok_share"]), percent(row["tracking_share"]),
            metres(row["level_median_m"]), metres(row["level_p95_m"]), percent(row["within_limit_share"]),
        )  # fmt: skip
    console.print(table)
    show_files(console, [path for path in (out, picture) if path is not None])
