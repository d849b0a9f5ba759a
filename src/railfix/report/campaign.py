"""Report on all runs of a campaign: lines, errors and protection levels by run, and explanations of worst epochs."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl
import polars.selectors as cs

from railfix.core.errors import RailfixError
from railfix.core.notebook import plural
from railfix.core.staged_files import write_whole
from railfix.core.tables import Column, Table, count, listing, number, percent, signed
from railfix.evaluate import RunAndReference, evaluate_runs
from railfix.evaluate.evaluation_inputs import POSITIONS_TABLE, floats, list_position_tables, read_table
from railfix.report.charts_page import Block, Notes, Sentence, charts_page
from railfix.report.explain import explain_epoch, time_text, write_explanation
from railfix.report.plots.campaign import campaign_bars, campaign_plan
from railfix.report.plots.chart import Chart

#: At most this number of worst epochs is listed.
_WORST: Final = 10
#: Of the worst epochs, at most one per run is listed in each interval of this length [s].
_EVENT_S: Final = 60
#: Number of pieces into which the line of each run is divided for the charts.
_PIECES: Final = 400
#: Maximum number of runs in a chart with one bar per run. The runs with the largest values are drawn; the table has all
#: runs.
_BARS: Final = 40
#: Quantities whose largest values determine the worst epochs; the first quantity that has values is used.
_QUANTITIES: Final = ("error_m", "protection_level_m", "along_sigma_m")
_FIGURES: Final[Sequence[Column]] = (
    ("epochs", "epochs", count),
    ("rate %", "positioning_rate", percent),
    ("ok %", "ok_rate", percent),
    ("sigma p95 m", "along_sigma_m_p95", number),
    ("level p50 m", "protection_level_m_p50", number),
    ("level p95 m", "protection_level_m_p95", number),
    ("error p50 m", "error_m_p50", number),
    ("error p95 m", "error_m_p95", number),
    ("largest m", "error_m_max", number),
    ("errors over level", "over_level", count),
)


@dataclass(frozen=True, kw_only=True)
class CampaignReport:
    """Content of the page on a campaign."""

    #: At most five sentences on the number of runs, failed runs, accuracy and the worst run.
    sentences: tuple[str, ...]
    #: Tables: all runs; failed runs, if any; the worst epochs, if there are positions.
    tables: tuple[Table, ...]
    charts: tuple[Chart, ...]
    notes: tuple[str, ...]  #: Notes on runs that could not be compared with their reference.


def report_campaign(runs: pl.DataFrame, out: Path) -> CampaignReport:
    """Summarise the runs of a campaign and write the explanations of the worst epochs into ``out / "explain"``.

    `runs` is the table of `run_campaign`, `out` the folder of the campaign.
    """
    fields = runs.columns[: runs.columns.index("status")]
    rows, epochs, notes = [], [], []
    for row in runs.iter_rows(named=True):
        name = " ".join(str(row[field]) for field in fields)
        found: dict[str, Any] = {}
        if row["status"] == "done":
            table, own_notes = _epochs(out / row["folder"], row["reference"])
            notes += [f"{name}: {note}" for note in own_notes]
            found = _figures(table)
            epochs.append(_worst_of_pieces(table).with_columns(run=pl.lit(name), folder=pl.lit(row["folder"])))
        rows.append({**row, **{name: None for _, name, _ in _FIGURES if name not in row}, **found, "run": name})
    whole = pl.DataFrame(rows, infer_schema_length=None)
    done = whole.filter(status="done")
    pieces = pl.concat(epochs, how="diagonal") if epochs else pl.DataFrame()
    quantity = next((name for name in _QUANTITIES if len(done) and done[f"{name}_p95"].is_not_null().any()), "")
    named: list[Column] = [(field, field, str) for field in fields]
    columns: list[Column] = [*named, ("status", "status", str), *_FIGURES]
    caption = (
        "All runs. The columns rate and ok refer to single epochs with observations; the columns of sigma, level and "
        "error refer to the filter along the track, or to single epochs if the filter was off"
    )
    tables = [listing("runs", whole, columns, caption)]
    if len(failed := whole.filter(status="failed")):
        tables.append(listing("failed", failed, [*named, ("error", "error", str)], f"Failed runs: {len(failed):,}"))
    if quantity:
        tables.append(_worst(pieces, quantity, out))
    return CampaignReport(
        sentences=tuple(_sentences(whole, done, quantity)),
        tables=tuple(tables),
        charts=tuple(_charts(done, pieces, quantity)),
        notes=tuple(notes),
    )


def write_campaign_page(report: CampaignReport, path: Path, *, title: str) -> Path:
    """Write the report on a campaign as one HTML page that opens without a network connection; return its path."""
    runs, *rest = report.tables
    # the table of failed runs comes first
    blocks: list[Block] = [*rest, runs, *([Notes("Notes", report.notes)] if report.notes else [])]
    lead = [Sentence(f"{sentence[0].upper()}{sentence[1:]}.") for sentence in report.sentences]
    write_whole(path, charts_page(title, report.charts, blocks, lead=lead), what="page")
    return path


def _epochs(folder: Path, reference: str | None) -> tuple[pl.DataFrame, tuple[str, ...]]:
    """Return the positions of the filter, or of single epochs if the filter was off, and a note.

    The positions have errors if there is a usable reference. The note is given if the reference cannot be used.

    """
    name = next((table for table in list_position_tables(folder) if table != POSITIONS_TABLE), POSITIONS_TABLE)
    table = read_table(folder, name, columns=cs.by_name("protection_level_m", require_all=False))[1]
    table = table.with_columns(pl.col("antenna", "status").cast(pl.String))
    if reference is None:
        return table, ()
    try:
        evaluation = evaluate_runs([RunAndReference(run=folder, reference=Path(reference), table=name)])
    except RailfixError as error:
        return table, (" ".join(str(error).split()),)
    good = pl.when("in_reference", "reference_good").then("error_m")
    errors = evaluation.epochs.select("time_gpst", pl.col("antenna").cast(pl.String), error_m=good)
    return table.join(errors, on=["time_gpst", "antenna"], how="left", maintain_order="left"), ()


def _figures(table: pl.DataFrame) -> dict[str, float | int | None]:
    """Return percentiles of the magnitude of each quantity, and the number of errors above the protection level."""
    found: dict[str, float | int | None] = {}
    for name in _QUANTITIES:
        size = np.abs(floats(table, name)) if name in table.columns else np.empty(0)
        size = size[np.isfinite(size)]
        for word, share in (("p50", 50.0), ("p95", 95.0), ("max", 100.0)):
            found[f"{name}_{word}"] = float(np.percentile(size, share)) if len(size) else None
    if "error_m" in table.columns and "protection_level_m" in table.columns:
        found["over_level"] = int((np.abs(floats(table, "error_m")) > floats(table, "protection_level_m")).sum())
    return found


def _worst_of_pieces(table: pl.DataFrame) -> pl.DataFrame:
    """Return, for each antenna, the epoch with the largest value in each piece of the line.

    The value is the magnitude of the first of `_QUANTITIES` that the table contains.
    """
    quantity = next(name for name in _QUANTITIES if name in table.columns and table[name].is_not_null().any())
    placed = table.filter(pl.col("chainage_m").is_not_null(), pl.col(quantity).is_not_null())
    length = float(np.ptp(placed["chainage_m"].to_numpy())) if len(placed) else 0.0
    return (
        placed.with_columns(piece=(pl.col("chainage_m") / max(length / _PIECES, 1.0)).floor())
        .sort(pl.col(quantity).abs(), descending=True)
        .unique(["antenna", "piece"], keep="first", maintain_order=True)
    )


def _worst(pieces: pl.DataFrame, quantity: str, out: Path) -> Table:
    """Write the explanations of the worst epochs to files, and return a table of these epochs with links to the files.

    Epochs of runs that did not write observations have no explanation.
    """
    ranked = pieces.filter(pl.col(quantity).is_finite()).sort(pl.col(quantity).abs(), descending=True)
    event = pl.col("time_gpst").dt.truncate(f"{_EVENT_S}s").alias("event")
    worst = ranked.unique(["run", event], keep="first", maintain_order=True).head(_WORST)
    commands, links = [], []
    for number_, row in enumerate(worst.iter_rows(named=True), start=1):
        folder, at = out / row["folder"], time_text(row["time_gpst"])
        words = ["railfix", "explain", str(folder), "--at", at, "--antenna", row["antenna"]]
        commands.append(shlex.join(words))
        links.append("")
        if (folder / "observations.parquet").is_file():
            page = out / "explain" / f"{number_}.html"
            page.parent.mkdir(exist_ok=True)
            write_explanation(explain_epoch(folder, at, antenna=row["antenna"]), page)
            links[-1] = f"explain/{page.name}"
    absent = [pl.lit(None, dtype=pl.Float64).alias(name) for name in _QUANTITIES if name not in worst.columns]
    shown = worst.with_columns(
        pl.col("time_gpst").dt.strftime("%Y-%m-%d %H:%M:%S%.3f"),
        pl.Series("command", commands, dtype=pl.String),
        *absent,
    )
    columns: list[Column] = [
        ("run", "run", str), ("antenna", "antenna", str), ("GPS time", "time_gpst", str), ("status", "status", str),
        ("chainage m", "chainage_m", count), ("error m", "error_m", signed), ("sigma m", "along_sigma_m", number),
        ("level m", "protection_level_m", number), ("command to explain", "command", str),
    ]  # fmt: skip
    caption = f"Worst epochs, at most one per run in {_EVENT_S} s"
    if not all(links):
        caption += '; epochs of runs with observations (option observations = "write") link to an explanation'
    table = listing("worst", shown, columns, caption)
    return replace(table, links=links, code=[len(columns) - 1])


def _charts(done: pl.DataFrame, pieces: pl.DataFrame, quantity: str) -> list[Chart]:
    if not quantity:
        return []
    charts = [campaign_plan(pieces.sort(pl.col(quantity).abs()), quantity)]
    for name in _QUANTITIES:
        known = done.filter(pl.col(f"{name}_p95").is_not_null()).sort(f"{name}_p95", descending=True).head(_BARS)
        if len(known) and (name != "along_sigma_m" or quantity == name):
            middle, wide, largest = (floats(known, f"{name}_{word}") for word in ("p50", "p95", "max"))
            charts.append(campaign_bars(known["run"].to_list(), middle, wide, largest, name))
    return charts


def _sentences(whole: pl.DataFrame, done: pl.DataFrame, quantity: str) -> list[str]:
    failed = len(whole) - len(done)
    lines = [
        f"{len(done):,} of {plural(whole, 'run')} done, with {int(done['epochs'].sum() or 0):,} epochs of all antennas"
    ]
    if failed:
        first = "" if failed == 1 else "; the first"
        lines.append(f"{plural(failed, 'run')} failed{first}: {whole.filter(status='failed')['error'][0]}")
    if quantity:
        worst = done.sort(f"{quantity}_p95", descending=True, nulls_last=True).row(0, named=True)
        word = {"error_m": "error", "protection_level_m": "level", "along_sigma_m": "standard deviation"}[quantity]
        wide, largest = (number(worst[f"{quantity}_{end}"], unit=" m") for end in ("p95", "max"))
        half = number(done[f"{quantity}_p95"].median(), unit=" m")  # type: ignore[arg-type]
        lines.append(f"the 95th percentile of the {word} is at most {half} in half of the runs")
        lines.append(
            f"the worst run is {worst['run']}, with a 95th percentile of {wide} and a largest value of {largest}"
        )
    if quantity == "error_m":
        over = int(done["over_level"].sum())
        lines.append(
            f"{over:,} errors exceed their protection level" if over else "no error exceeds its protection level"
        )
    elif quantity:
        lines.append("no reference was given; errors are computed if the campaign file has the key `reference`")
    return lines
