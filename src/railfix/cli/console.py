"""Output of the commands: progress bars, tables, verdicts, notes, and paths of written files."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import polars as pl
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column as TableColumn
from rich.table import Table as RichTable
from rich.text import Text
from typer import echo

from railfix import kernels
from railfix.core.notebook import plural
from railfix.core.tables import Table
from railfix.run.output import finite_values
from railfix.run.record import budget_tables, level_basis

if TYPE_CHECKING:
    from railfix.evaluate import Evaluation
    from railfix.run import RunSummary
    from railfix.run.driver import Progress as ProgressCall


#: Maximum number of lines in the verdict of an evaluation.
_MOST: Final = 5
#: Maximum number of lines in the summary of a run without ``--verbose``.
_MOST_LINES: Final = 12
_ANTENNAS: Final = ("front", "rear")
#: If the 95th percentile of |error| / stated sigma exceeds this limit, the stated sigma is reported as too small. For
#: normally distributed errors the percentile is 2.0.
_OVERCONFIDENT: Final = 3.0


def print_json(values: Mapping[str, Any]) -> None:
    """Print values as one line of JSON; NaN, infinities and paths become strings."""
    echo(json.dumps(finite_values(values), default=str, allow_nan=False))


def list_antenna_errors(evaluation: Evaluation) -> list[dict[str, Any]]:
    """Return the error statistics of the positions computed with the map, over all epochs, one row per run and antenna.

    Rows of the filter come before rows of single epochs. In both groups, rows for which no error could be computed come
    first; the other rows are in descending order of the 95th percentile of the error.
    """
    rows = evaluation.figures.filter(
        pl.col("grouping") == "all", pl.col("epochs_of") == "own", pl.col("position") == "constrained",
        pl.col("run") != "all", pl.col("antenna") != "all",
    )  # fmt: skip
    by_filter = pl.col("run").str.ends_with("(train)")
    return rows.sort(by_filter, "p95_m", descending=True, nulls_last=False).to_dicts()


def verdict_of_evaluation(evaluation: Evaluation) -> list[str]:
    """Return at most `_MOST` lines: accuracy of each run and antenna, largest errors first, then a command to use next.

    Each line on accuracy also reports whether the stated sigma fits the errors.
    """
    room = _MOST - 1
    texts = [_judge(row) for row in list_antenna_errors(evaluation)]
    if len(texts) > room:
        texts = [*texts[: room - 1], f"and {len(texts) - room + 1} more: see the tables below"]
    paths, references = ({str(getattr(run, what)) for run in evaluation.runs} for what in ("path", "reference"))
    if len(paths) == len(references) == 1:
        run, reference = shlex.quote(paths.pop()), shlex.quote(references.pop())
        return [*texts, f"next: railfix report {run} --reference {reference} --out report.html"]
    return [*texts, "next: compare the runs on one page with railfix report and the same references"]


def describe_errors(evaluation: Evaluation) -> str:
    """Return one sentence on the errors of a run's positions against its ground truth.

    The sentence states the errors of the filter's positions, or of the single-epoch positions if the run has no filter.
    It also states the number of errors above the protection level, and the errors of the conventional positions.
    """
    rows = evaluation.figures.filter(
        pl.col("grouping") == "all", pl.col("epochs_of") == "own", pl.col("run") != "all", pl.col("antenna") == "all"
    )
    on_map = rows.filter(pl.col("position") == "constrained")
    filtered = on_map.filter(pl.col("run").str.ends_with("(train)"))
    row = (filtered if len(filtered) else on_map).row(0, named=True)
    kind = "train" if len(filtered) else next(iter(evaluation.integrity), "")
    errors = "errors of {p50_m:.1f} m at the median, {p95_m:.1f} m for 95 %, {max_m:.1f} m at most"
    text = f"against the ground truth: {errors.format(**row)} over {row['errors']:,} epochs"
    if kind in evaluation.integrity:
        beyond = evaluation.integrity[kind].beyond["usable"].sum()
        text += f", {beyond or 'none'} above {'their' if beyond != 1 else 'its'} protection level"
    other = rows.filter(pl.col("position") == "conventional", pl.col("run") == row["run"])
    if len(other):
        text += "; conventional positions {p50_m:.1f} m, {p95_m:.1f} m, {max_m:.1f} m".format(
            **other.row(0, named=True)
        )
    return text


def _judge(row: Mapping[str, Any]) -> str:
    """Return a sentence on the errors of one run and antenna, from one row of `list_antenna_errors`."""
    from railfix.evaluate.accuracy import WRONG_PLACE_M

    run, train, _ = str(row["run"]).partition(" (train)")
    name = f"{run}, {row['antenna']}, {'filter along the track' if train else 'single epochs'}"
    if not row["errors"]:
        return f"{name}: no position has a reference"
    text = (
        f"{name}: error {row['p50_m']:.2f} m at the median, {row['p95_m']:.2f} m for 95 % of {row['errors']:,} "
        f"epochs, largest {row['max_m']:.2f} m"
    )
    if row["max_at_chainage_m"] is not None:
        text += f" at chainage {row['max_at_chainage_m']:.0f} m"
    text += f"; {plural(row['wrong_places'], 'wrong position')} (error over {WRONG_PLACE_M:g} m)"
    ratio = row["normalised_p95"]
    if ratio is not None:
        true = "fits" if ratio <= _OVERCONFIDENT else "is too small for"
        text += f"; the stated sigma {true} the errors (95 % within {ratio:.1f} times sigma)"
    return text


def prepare_kernels() -> None:
    """Compile the kernels unless this machine already has their compiled code."""
    if not kernels.is_compiled():
        import_module("railfix.live.warm_up").prepare_kernels()


#: Width of tables in characters if the output is not a terminal; no cell is cut or folded at this width.
_FILE_WIDTH: Final = 500
#: Maximum number of printed map findings; further findings are only counted.
MOST_FINDINGS: Final = 40
#: Replacements for characters that some terminals cannot show.
_PLAIN: Final = str.maketrans("−–", "--")


class TableConsole(Console):
    """Console for standard output that prints text unchanged, and splits a table that is wider than the console.

    Numbers are never cut or folded.
    """

    def __init__(self) -> None:
        super().__init__(highlight=False, markup=False)
        if not self.is_terminal:
            self.width = max(self.width, _FILE_WIDTH)

    def print(self, *objects: Any, **options: Any) -> None:
        """Print objects as `rich.console.Console.print` does, but split wide tables into parts that fit the console."""
        for item in objects or ("",):
            if isinstance(item, RichTable):
                for part in split_table(item, self):
                    super().print(part, crop=False, soft_wrap=False, **options)
            else:
                super().print(item, **options)


def split_table(table: RichTable, console: Console) -> list[RichTable]:
    """Split a table by columns into parts that fit the console; every part begins with the table's leading text
    columns.

    Cells with text may be folded, but numbers are not. A part with only one column of numbers may therefore be wider
    than the console.
    """
    options = console.options.update(width=_FILE_WIDTH)
    if console.measure(table, options=options).maximum <= console.width:
        return [table]
    count_text = next((k for k, column in enumerate(table.columns) if column.justify == "right"), 1)
    text, numbers = table.columns[:count_text], table.columns[count_text:]
    text = [replace(column, no_wrap=False, overflow="fold") for column in text]
    numbers = [replace(column, no_wrap=column.justify == "right") for column in numbers]
    fitting: list[TableColumn] = []
    parts: list[list[TableColumn]] = []
    for column in numbers:
        trial = _with_columns(table, [*text, *fitting, column])
        if fitting and console.measure(trial, options=options).maximum > console.width:
            parts.append(fitting)
            fitting = []
        fitting = [*fitting, column]
    return [_with_columns(table, [*text, *part]) for part in [*parts, fitting]]


def _with_columns(table: RichTable, columns: Sequence[TableColumn]) -> RichTable:
    """Return a copy of a table that has only the given columns."""
    part = RichTable(*(column.copy() for column in columns), box=table.box, show_edge=table.show_edge)
    part.padding, part.pad_edge = table.padding, table.pad_edge
    for cells in zip(*(column.cells for column in columns), strict=True):
        part.add_row(*cells)
    return part


def show_table(console: Console, table: Table, *, most: int | None = None) -> None:
    """Print the caption, the first `most` rows of a table (by default all), and the number of omitted rows."""
    if table.caption:
        console.print(table.caption)
    if not table.rows:
        return
    plain = RichTable(box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    shown = RichTable() if table.boxed else plain
    for number, head in enumerate(table.head):
        justify: Literal["left", "right"] = "right" if number in table.numeric else "left"
        shown.add_column(head, justify=justify, no_wrap=True, overflow="fold")
    for row in table.rows[:most]:
        shown.add_row(*(Text(cell.translate(_PLAIN)) for cell in row))
    console.print(shown)
    if most is not None and len(table.rows) > most:
        console.print(f"... and {len(table.rows) - most} more")


def show_verdict(console: Console, lines: Iterable[str]) -> None:
    """Print the lines of a verdict, followed by a blank line."""
    for line in lines:
        console.print(line)
    console.print()


def show_notes(console: Console, notes: Iterable[str]) -> None:
    """Print each note on a line that begins with "note: "."""
    for note in notes:
        console.print(f"note: {note}")


def show_files(console: Console, paths: Iterable[Path]) -> None:
    """Print the path of each written file on a separate line."""
    for path in paths:
        console.print(f"wrote {path}")


@contextmanager
def progress_bar(work: str = "positions") -> Iterator[ProgressCall]:
    """Yield the function that updates a progress bar on standard error.

    The bar is shown only if standard error is a terminal. It shows the number of epochs, the rate in epochs/s and the
    remaining time.
    """
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[epochs]:,} epochs"),
        TextColumn("{task.fields[rate]:,.0f} epochs/s"),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
    task = bar.add_task(work, total=1.0, epochs=0, rate=0.0)

    def show(*, epochs: int, fraction: float) -> None:
        # The bar is started only here, because it starts a thread, and a run must fork its processes before it has
        # threads.
        bar.start()
        elapsed = bar.tasks[task].elapsed or 0.0
        bar.update(task, completed=fraction, epochs=epochs, rate=epochs / elapsed if elapsed > 0 else 0.0)

    try:
        yield show
    finally:
        bar.stop()


def show_summary(summary: RunSummary, *, verbose: bool) -> None:
    """Print the verdict on a run, the notes, the path of the results and the command to use next.

    At most `_MOST_LINES` lines are printed. With `verbose`, all notes and the tables of statuses and reasons are
    printed.
    """
    console = TableConsole()
    lines = summary.verdict.lines()
    folder = summary.files["run.json"].parent
    rate = summary.tally.epochs / summary.wall_s
    names = ", ".join(sorted(path.name for path in summary.files.values()))
    end = [
        f"results: {folder} ({names}); {summary.tally.epochs:,} epochs in {summary.wall_s:.2f} s "
        f"({rate:,.0f} epochs/s, reading included)",
        f"next: railfix report {shlex.quote(str(folder))} --out report.html",
    ]
    notes = [f"note: {note}" for note in join_antennas(summary.notes)]
    room = _MOST_LINES - len(lines) - len(end)
    if not verbose and len(notes) > room:
        notes = [
            *notes[: room - 1],
            f"{plural(notes[room - 1 :], 'more note')} in {folder / 'run.json'}; --verbose shows all",
        ]
    for line in [*lines, *notes, *end]:
        console.print(line)
    if verbose:
        console.print()
        show_budget(console, summary)


def show_budget(console: Console, summary: RunSummary) -> None:
    """Print two tables: the number of epochs by status, and the number of pseudoranges by reason of rejection."""
    for table in budget_tables(summary.record["antennas"], level_basis(summary.record)):
        show_table(console, table)


def join_antennas(notes: Iterable[str]) -> list[str]:
    """Return the notes in order, with "front: TEXT" and "rear: TEXT" joined to "front and rear: TEXT"."""
    texts: dict[str, list[str]] = {}
    for note in notes:
        antenna, colon, text = note.partition(": ")
        if colon and antenna in _ANTENNAS:
            texts.setdefault(text, []).append(antenna)
        else:
            texts.setdefault(note, [])
    return [f"{' and '.join(names)}: {text}" if names else text for text, names in texts.items()]
