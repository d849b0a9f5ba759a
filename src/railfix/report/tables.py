"""Tables of the report: inputs and settings, counts of epochs and pseudoranges, figures of merit."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from typing import Any

import polars as pl

from railfix.evaluate import Evaluation
from railfix.evaluate.run_folder import flattened
from railfix.report.content import (
    Absent,
    Block,
    Column,
    Folded,
    Notes,
    ReportedCommand,
    Sentence,
    Table,
    count,
    listing,
    number,
    share,
)
from railfix.report.runs import ReportedRun

_POSITION_NAMES = {"constrained": "on the map", "constrained_ok": "on the map, ok", "conventional": "conventional"}
_NAMED = pl.col("position").replace(_POSITION_NAMES)


def summary(runs: Sequence[ReportedRun], evaluation: Evaluation | None) -> Table:
    """One row per run and antenna: rates and, with a reference, errors."""
    head = ["run", "antenna", "settings", "epochs", "rate", "ok", "sigma p95"]
    judged = ["mean", "std", "p95", "largest", "conventional p95", "largest"] if evaluation else []
    rows = []
    for run in runs:
        asked = flattened(run.record.get("settings_asked") or {})
        chosen = [run.config.preset, *(f"{name} {_word(value)}" for name, value in asked.items() if name != "preset")]
        for antenna, facts in _antennas(run).items():
            sigma = facts.get("along_sigma_m") or {}
            row = [
                run.name,
                antenna,
                "; ".join(chosen),
                count(facts.get("epochs")),
                share(facts.get("positioning_rate")),
                share(facts.get("ok_rate")),
                number(_plain(sigma.get("p95_m"))),
            ]
            if evaluation:
                figures = {p: figures_of(evaluation, run, antenna, p) for p in ("constrained", "conventional")}
                row += [number(figures["constrained"].get(k)) for k in ("mean_m", "std_m", "p95_m", "max_m")]
                row += [number(figures["conventional"].get(k)) for k in ("p95_m", "max_m")]
            rows.append(row)
    caption = (
        "settings: preset and changed settings; rate: share of the epochs with observations that have a position; "
        "sigma p95: stated standard deviation along the line, in metres"
    )
    if evaluation:
        caption += "; errors along the line in metres: mean and std of the signed error, p95 and largest of its size"
    columns = range(3, len(head) + len(judged))
    return Table(name="summary", head=[*head, *judged], rows=rows, caption=caption, numeric=columns)


def figures_of(
    evaluation: Evaluation, run: ReportedRun, antenna: str, position: str, *, epochs_of: str = "own"
) -> dict[str, Any]:
    """Figures of merit of one antenna and kind of position; empty where there are none."""
    rows = evaluation.figures.filter(
        grouping="all", epochs_of=epochs_of, run=run.name_in(evaluation), antenna=antenna, position=position
    )
    return rows.row(0, named=True) if len(rows) == 1 else {}


def _antennas(run: ReportedRun) -> Mapping[str, Mapping[str, Any]]:
    known: Mapping[str, Mapping[str, Any]] = run.record.get("antennas") or {}
    return {name: known.get(name) or {} for name in run.folder.antennas}


def provenance(run: ReportedRun) -> list[Block]:
    """Command, versions, inputs with hashes, line, notes."""
    record = run.record
    written = datetime.fromtimestamp((run.folder.path / "run.json").stat().st_mtime, tz=UTC)
    versions: Mapping[str, Any] = record.get("versions") or {}
    spans = [
        f"{name}: {facts.get('first_epoch_gpst')} to {facts.get('last_epoch_gpst')} GPS time"
        for name, facts in _antennas(run).items()
    ]
    track = run.folder.track_facts
    vehicle = (record.get("line") or {}).get("vehicle") or {}
    rows = [
        ("folder", str(run.folder.path)),
        ("written", written.strftime("%Y-%m-%d %H:%M:%S UTC")),
        ("epochs", "; ".join(spans)),
        ("reference", run.reference or "none given"),
        ("line", f"{run.folder.line_name}, {track.get('length_m', '?')} m, {track.get('points', '?')} points"),
        ("vehicle", str(vehicle.get("name") or "none; the track is the trajectory of the antenna")),
        ("versions", ", ".join(f"{name} {value}" for name, value in versions.items())),
        ("platform", str(record.get("platform", "not recorded"))),
        ("wall time", f"{record.get('wall_s', '?')} s"),
    ]
    inputs = [
        [str(f["input"]), str(f["path"]), count(f.get("bytes")), str(f.get("sha256", ""))]
        for f in record.get("inputs") or []
    ]
    notes = [*(str(note) for note in record.get("notes") or []), *run.notes]
    return [
        Table(name="run", head=["", "run"], rows=rows),
        ReportedCommand(shlex.join(str(word) for word in record.get("command") or [])),
        Table(name="inputs", head=["input", "file", "bytes", "SHA-256"], rows=inputs, numeric=[2], code=[1, 3]),
        Notes("Notes", notes) if notes else Sentence("The run has no notes."),
    ]


def settings(run: ReportedRun) -> list[Block]:
    """Settings asked for beside those used."""
    asked = flattened(run.record.get("settings_asked") or {})
    used = flattened(run.record.get("settings_used") or {})
    names = [*(name for name in used if name in asked), *(name for name in asked if name not in used)]
    names += [name for name in used if name not in asked]
    rows = [[name, _word(asked.get(name, "")), _word(used.get(name, ""))] for name in names]
    return [
        Sentence(f"{len(asked)} of {len(used)} settings were asked for; the others are defaults."),
        Table(name="settings", head=["setting", "asked", "used"], rows=rows, marked=range(len(asked))),
    ]


def budget(run: ReportedRun) -> list[Block]:
    """Epochs by status, and pseudoranges by the first reason for their rejection."""
    antennas = _antennas(run)
    names = list(antennas)
    statuses = dict.fromkeys(s for facts in antennas.values() for s, n in (facts.get("status") or {}).items() if n)
    rows = [
        ["epochs", *(count(antennas[n].get("epochs")) for n in names)],
        ["with observations", *(count(antennas[n].get("epochs_with_observations")) for n in names)],
        ["with position", *(count(antennas[n].get("epochs_with_position")) for n in names)],
        *([f"  {s}", *(count((antennas[n].get("status") or {}).get(s, 0)) for n in names)] for s in statuses),
        ["positioning rate", *(share(antennas[n].get("positioning_rate")) for n in names)],
        ["rate of ok", *(share(antennas[n].get("ok_rate")) for n in names)],
    ]
    few = dict.fromkeys(r for f in antennas.values() for r in f.get("too_few_satellites_by_first_reason") or {})
    rows += [
        [
            f"too few satellites, by {r}",
            *(count((antennas[n].get("too_few_satellites_by_first_reason") or {}).get(r, 0)) for n in names),
        ]
        for r in few
    ]
    first, only = "observations_rejected_by_first_reason", "observations_rejected_by_one_reason_alone"
    reasons = dict.fromkeys(r for facts in antennas.values() for r in facts.get(first) or {})
    head = ["", *(word for n in names for word in (n, "share", "only reason"))]
    observed = {n: antennas[n].get("observations") or 0 for n in names}

    def cells(ranges: Mapping[str, float], alone: Mapping[str, float] | None) -> list[str]:
        return [
            word
            for n in names
            for word in (
                count(ranges[n]),
                share(ranges[n] / observed[n] if observed[n] else None),
                "" if alone is None else count(alone[n]),
            )
        ]

    ranges = [
        ["observed", *cells(observed, None)],
        ["used", *cells({n: antennas[n].get("observations_used") or 0 for n in names}, None)],
    ]
    for reason in reasons:
        counts = {n: (antennas[n].get(first) or {}).get(reason, 0) for n in names}
        alone = {n: (antennas[n].get(only) or {}).get(reason, 0) for n in names}
        ranges.append([f"  {reason}", *cells(counts, alone)])
    caption = "Pseudoranges by the first reason for their rejection, and those with this reason only"
    return [
        Table(name="epochs", head=["", *names], rows=rows, caption="Epochs by status", numeric=range(1, 9)),
        Table(name="pseudoranges", head=head, rows=ranges, caption=caption, numeric=range(1, 9)),
    ]


def merits(run: ReportedRun, evaluation: Evaluation) -> list[Block]:
    """Figures of merit and intervals of one run, on the map beside conventional."""
    figures = evaluation.figures.filter(run=run.name_in(evaluation), epochs_of="own")
    confidence = f"{100 * evaluation.options.confidence:g} %"
    head = "antenna|position|errors|rate|mean|std|p50|p95|p99|largest|over 50 m|rms / sigma|p95 / sigma".split("|")
    numeric = range(2, len(head))
    blocks: list[Block] = [
        Table(
            name="figures-of-merit",
            head=head,
            rows=[_merit(row, "antenna") for row in figures.filter(grouping="all").iter_rows(named=True)],
            caption=f"Errors along the line in metres, + toward its end; [{confidence} limits from blocks of time]",
            numeric=numeric,
        )
    ]
    for grouping, word in (("environment", "environment"), ("speed", "speed"), ("satellites", "satellites used")):
        rows = figures.filter(pl.col("grouping") == grouping, pl.col("position") != "constrained_ok")
        if rows["group"].n_unique() > 1:
            grouped = Table(
                name=f"figures-by-{grouping}",
                head=[word, *head[1:]],
                rows=[_merit(row, "group", antenna=str(row["antenna"])) for row in rows.iter_rows(named=True)],
                numeric=numeric,
            )
            blocks.append(Folded(f"By {word}", [grouped]))
    return [*blocks, _intervals(evaluation, run.name_in(evaluation))]


def filter_tables(run: ReportedRun, evaluation: Evaluation) -> list[Block]:
    """Figures of the filter along the track: all epochs, with and without satellites, outages, probabilities."""
    name = run.name_in(evaluation, "train")
    if not name:
        return [Absent("The run has no filter along the track (railfix run --filter off).")]
    figures = evaluation.figures.filter(pl.col("grouping").is_in(["all", "signals"]), run=name, epochs_of="own")
    rows = figures.filter(pl.col("position") == "constrained").sort("antenna", "grouping", maintain_order=True)
    filtered: list[Column] = [
        ("antenna", "antenna", str),
        ("epochs", "group", str),
        ("epochs", "epochs", count),
        ("rate", "rate_of_run", share),
        *((head, f"{head}_m", number) for head in ("mean", "std", "p50", "p95", "p99")),
        ("largest", "max_m", number),
        ("p95 / sigma", "normalised_p95", number),
    ]
    caption = "Errors along the line of the filter along the track, in metres; rate: share of all epochs"
    blocks: list[Block] = [listing("filter", rows, filtered, caption)]
    if evaluation.outages is not None and len(outages := evaluation.outages.filter(run=name)):
        outages = outages.with_columns(
            pl.col("begin_gpst").dt.strftime("%H:%M:%S"), pl.col("carried_by").fill_null("").replace("", "prediction")
        )
        passed = (
            ("antenna", "antenna", str),
            ("begin", "begin_gpst", str),
            ("environment", "environment", str),
            ("carried by", "carried_by", str),
            ("lasting, s", "duration_s", partial(number, digits=1)),
            ("way", "travelled_m", count),
            ("p95", "outage_p95_m", number),
            ("largest", "outage_max_m", number),
            ("at its end", "end_error_m", number),
            ("sigma there", "end_sigma_m", number),
        )
        blocks.append(listing("outages", outages, passed, "Stretches without satellites, in metres"))
    if evaluation.branches is not None and len(branches := evaluation.branches.filter(run=name)):
        stated = (
            ("antenna", "antenna", str),
            ("stated probability", "probability", str),
            ("positions", "judged", count),
            ("mean of it", "probability_mean", share),
            ("right", "right_share", share),
            ("wrong", "wrong_places", count),
            ("blocks", "blocks", count),
            ("with a wrong one", "wrong_blocks", count),
        )
        caption = "Stated probability of the place against the share of places within 50 m of the reference"
        blocks.append(listing("branches", branches, stated, caption))
    return blocks


def _merit(row: Mapping[str, Any], first: str, antenna: str = "") -> list[str]:
    where = f"{antenna} {_POSITION_NAMES[row['position']]}".strip()
    return [
        str(row[first]),
        where,
        count(row["errors"]),
        share(row["rate"]) + _limits(row["rate_low"], row["rate_high"], per_cent=True),
        number(row["mean_m"]) + _limits(row["mean_low_m"], row["mean_high_m"]),
        number(row["std_m"]),
        number(row["p50_m"]),
        number(row["p95_m"]) + _limits(row["p95_low_m"], row["p95_high_m"]),
        number(row["p99_m"]),
        number(row["max_m"]),
        count(row["wrong_places"]),
        number(row["normalised_rms"]),
        number(row["normalised_p95"]),
    ]


def _limits(low: float | None, high: float | None, *, per_cent: bool = False) -> str:
    if low is None or high is None:
        return ""
    ends = (share(low, 1), share(high, 1)) if per_cent else (number(low), number(high))
    return f"\n[{ends[0]} to {ends[1]}]"


def _intervals(evaluation: Evaluation, name: str) -> Block:
    rows = evaluation.intervals.filter(pl.col("run") == name) if "run" in evaluation.intervals.columns else None
    if rows is None or not len(rows):
        return Absent("There are no two consecutive positions, so there are no intervals.")
    columns: list[Column] = [
        ("antenna", "antenna", str),
        ("position", "position", str),
        ("intervals", "intervals", count),
        *((head, f"interval_{head}_m", number) for head in ("mean", "p50", "p95", "p99")),
        ("largest", "interval_max_m", number),
        ("gap p95, s", "gap_p95_s", number),
        ("largest, s", "gap_max_s", number),
    ]
    caption = "Positioning interval: distance travelled between consecutive positions, in metres"
    return listing("intervals", rows.with_columns(_NAMED), columns, caption)


def level_sizes(evaluation: Evaluation, name: str) -> list[Block]:
    """Percentiles of the protection levels of a run, and counts of errors above them."""
    if evaluation.levels is None:
        return []
    rows = evaluation.levels.filter(pl.col("run") == name) if "run" in evaluation.levels.columns else evaluation.levels
    columns = (
        ("level", "level", str),
        ("antenna", "antenna", str),
        ("position", "position", str),
        ("positions", "positions", count),
        ("finite", "with_level", count),
        ("p50", "level_p50_m", number),
        ("p95", "level_p95_m", number),
        ("errors", "errors", count),
        ("over the level", "over_level", count),
        ("share", "over_level_share", partial(share, digits=3)),
    )
    caption = "Protection levels in metres, and errors above them"
    return [listing("levels", rows.with_columns(_NAMED), columns, caption)]


def _plain(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) else None


def _word(value: Any) -> str:
    if isinstance(value, Iterable) and not isinstance(value, str):
        return " ".join(str(v) for v in value)
    return "none" if value is None else str(value)
