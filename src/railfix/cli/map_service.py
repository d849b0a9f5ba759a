"""``railfix map service``: where satellites can serve on a line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

import polars as pl
import typer

from railfix.cli.console import console_of_tables, show_files, show_table, show_verdict
from railfix.cli.options import OverwriteOption, check_outputs
from railfix.core.errors import SettingsError
from railfix.core.tables import Column, count, listing, number, percent

#: Share of the epochs of a stretch within the alarm limit from which satellites serve there.
_SERVED: Final = 0.95
_COLUMNS: Final[Sequence[Column]] = (
    ("chainage m", "from_m", count),
    ("epochs", "epochs", count),
    ("satellites", "satellites_median", count),
    ("least (5 %)", "satellites_p5", count),
    ("rejected %", "rejected_share", percent),
    ("3-D off m", "reflection_p95_m", number),
    ("ok %", "ok_share", percent),
    ("filter %", "tracking_share", percent),
    ("level m", "level_median_m", number),
    ("level 95 % m", "level_p95_m", number),
    ("served %", "within_limit_share", percent),
)


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
        from railfix.report.plots.campaign import plot_service

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
    show_table(
        console, listing("service", found, _COLUMNS, f"By stretch of {stretch:g} m; served: a level within the limit")
    )
    show_files(console, [path for path in (out, picture) if path is not None])
