"""The first lines of a command: where, how good, how sure, what is wrong, what to do; at most five."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import polars as pl

from railfix.core.reasons import Status

if TYPE_CHECKING:
    from railfix.evaluate import Evaluation
    from railfix.run import RunSummary

#: Statuses of the filter whose places are vouched for.
_SOUND: Final = ("tracking", "coasting")
#: Most lines of a verdict.
_MOST: Final = 5
#: Errors that are this many stated standard deviations at their 95th percentile (2.0 for normal ones) are no match.
_OVERCONFIDENT: Final = 3.0


def verdict_of_run(summary: RunSummary) -> list[str]:
    """Say where a run was, how good and how sure its positions are, what is wrong, and what to do next."""
    table = "train" if summary.tracks else "positions"
    file = summary.files[f"{table}.parquet"]
    chainage = pl.scan_parquet(file).select("antenna", "chainage_m")
    lines = []
    for name, antenna in summary.tally.antennas.items():
        of_antenna = chainage.filter(antenna=name).select(
            pl.len().alias("epochs"),
            pl.col("chainage_m").count().alias("positions"),
            pl.col("chainage_m").min().alias("first"),
            pl.col("chainage_m").max().alias("last"),
        )
        found = of_antenna.collect().row(0, named=True)
        track = summary.tracks.get(name)
        sigma = summary.sigma.get(name) if track is None else track.along_sigma_m
        level = summary.levels.get(name) if track is None else track.level
        text = f"{name}: a position in {found['positions']:,} of {antenna.epochs:,} epochs"
        if found["positions"]:
            text += f", chainage {found['first']:.0f} to {found['last']:.0f} m"
        if sigma is not None:
            text += f"; standard deviation {sigma.p50_m:.1f} m, largest {sigma.max_m:.1f} m"
        if level is not None and level.p50_m is not None:
            text += f"; {summary.level_basis} level {level.p50_m:.0f} m at the median"
        lines.append(text)
    lines.append(_doubts(summary))
    lines += [f"likely cause: {cause}" for cause in summary.causes.values() if cause][:1]
    lines.append(f"next: railfix report {shlex.quote(str(file.parent))} --out report.html")
    return lines


def _doubts(summary: RunSummary) -> str:
    """Say how many single epochs failed a check, of which kind most are, and how many notes there are."""
    statuses: Counter[str] = Counter()
    for antenna in summary.tally.antennas.values():
        statuses.update(antenna.status)
    lost = statuses.pop(Status.NO_OBSERVATION.text, 0)
    passed = statuses.pop(Status.OK.text, 0)
    failed = statuses.total()
    text = f"in doubt: {failed:,} of {failed + passed:,} single epochs with observations did not pass every check"
    if failed:
        text += f", most of them {statuses.most_common(1)[0][0]}"
    of_filter: Counter[str] = Counter()
    for track in summary.tracks.values():
        of_filter.update({word: count for word, count in track.status.items() if word not in _SOUND})
    if of_filter.total():
        text += "; of the filter " + ", ".join(f"{count:,} {word}" for word, count in of_filter.items() if count)
    if lost:
        text += f"; {lost:,} epochs have no observation"
    return f"{text}; {len(summary.notes)} note(s) below the tables"


def verdict_of_evaluation(evaluation: Evaluation) -> list[str]:
    """Say for each run and antenna how good its positions are and whether what it states is true; the worst first."""
    rows = evaluation.figures.filter(
        pl.col("grouping") == "all", pl.col("epochs_of") == "own", pl.col("position") == "constrained",
        pl.col("run") != "all", pl.col("antenna") != "all",
    ).sort("p95_m", descending=True, nulls_last=False)  # fmt: skip
    room = _MOST - 1
    texts = [_judge(row) for row in rows.iter_rows(named=True)]
    if len(texts) > room:
        texts = [*texts[: room - 1], f"and {len(texts) - room + 1} better ones, in the tables below"]
    paths, references = ({str(getattr(run, what)) for run in evaluation.runs} for what in ("path", "reference"))
    if len(paths) == len(references) == 1:
        run, reference = shlex.quote(paths.pop()), shlex.quote(references.pop())
        return [*texts, f"next: railfix report {run} --reference {reference} --out report.html"]
    return [*texts, "next: railfix report draws runs beside each other, with the same references"]


def _judge(row: Mapping[str, Any]) -> str:
    """One run and antenna in a sentence."""
    from railfix.evaluate.scores import WRONG_PLACE_M

    name = f"{row['run']}, {row['antenna']}"
    if not row["errors"]:
        return f"{name}: no position has a reference"
    text = (
        f"{name}: error {row['p50_m']:.2f} m at the median, {row['p95_m']:.2f} m for 95 % of {row['errors']:,}, "
        f"largest {row['max_m']:.2f} m"
    )
    if row["max_at_chainage_m"] is not None:
        text += f" at chainage {row['max_at_chainage_m']:.0f} m"
    text += f"; {row['wrong_places']:,} at a wrong place (over {WRONG_PLACE_M:g} m)"
    ratio = row["normalised_p95"]
    if ratio is not None:
        true = "fits" if ratio <= _OVERCONFIDENT else "is too small for"
        text += f"; the stated sigma {true} the errors (95 % within {ratio:.1f} of it)"
    return text
