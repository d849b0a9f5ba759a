"""Tables of a run from its record, for terminal and page: epochs by status, pseudoranges by reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

from railfix.core.reasons import Status
from railfix.core.tables import Table, count, number, share

Facts = Mapping[str, Any]
#: Names of percentiles in the record, by their names in the tables.
_OF_SIGMA: Final = {"p50": "p50_m", "p95": "p95_m", "largest": "max_m"}
_OF_LEVEL: Final = {"p50": "p50_m", "p95": "p95_m"}


def level_basis(record: Facts) -> str:
    """Return what the levels of a run are called: their priors are measured, or assumed."""
    risk = (record.get("settings_used") or {}).get("risk") or {}
    return "protection" if risk.get("priors") == "measured" else "indicative protection"


def budget_tables(antennas: Mapping[str, Facts], basis: str) -> list[Table]:
    """Return the filter by status, where it is on, single epochs by status, and pseudoranges by reason.

    `antennas` are those of ``run.json``; what a record of an earlier version lacks is shown as a dash.
    """
    filtered = {name: facts["filter"] for name, facts in antennas.items() if facts.get("filter")}
    caption = "Each epoch by itself (positions.csv)" if filtered else "Epochs by status"
    tables = [_filter_table(filtered)] if filtered else []
    return [*tables, _epochs_table(antennas, basis, caption), _ranges_table(antennas)]


def _filter_table(filtered: Mapping[str, Facts]) -> Table:
    found = list(filtered.values())
    rows = [
        [status, *(count(each["status"][status]) for each in found)]
        for status in dict.fromkeys(word for each in found for word, epochs in each["status"].items() if epochs)
    ]
    rows += _metres("sigma along the line", [each.get("along_sigma_m") for each in found], _OF_SIGMA)
    levels = [each.get("level") for each in found]
    if any(levels):
        rows += _metres("indicative protection level", levels, _OF_LEVEL)
        rows.append(["  with a level", *(count(None if level is None else level["finite"]) for level in levels)])
    return _table("filter", filtered, rows, "Filter along the track (train.csv)")


def _epochs_table(antennas: Mapping[str, Facts], basis: str, caption: str) -> Table:
    every = list(antennas.values())
    rows = [
        ["epochs", *(count(facts.get("epochs")) for facts in every)],
        ["with observations", *(count(facts.get("epochs_with_observations")) for facts in every)],
    ]
    for way in ("with", "without"):
        statuses = [Counter(facts.get(f"epochs_{way}_position_by_status") or {}) for facts in every]
        for epochs in statuses:
            del epochs[Status.NO_OBSERVATION.text]
        if any(statuses):
            rows.append([f"{way} coordinates", *(count(epochs.total()) for epochs in statuses)])
        for status in Status:
            if any(epochs[status.text] for epochs in statuses):
                rows.append([f"  {status.text}", *(count(epochs[status.text]) for epochs in statuses)])
                if status is Status.TOO_FEW_SATELLITES:
                    rows += _rows_of_few(every)
    rows.append(["positioning rate", *(share(facts.get("positioning_rate")) for facts in every)])
    rows.append(["rate of ok", *(share(facts.get("ok_rate")) for facts in every)])
    rows += _metres("sigma along the line", [facts.get("along_sigma_m") for facts in every], _OF_SIGMA)
    levels = [facts.get("protection_level") for facts in every]
    if any(levels):
        rows += _metres(f"{basis} level", levels, _OF_LEVEL)
        for word in ("available", "alarm"):
            shares = [
                share(None if level is None else _ratio(level[word], facts["epochs_with_observations"]))
                for level, facts in zip(levels, every, strict=True)
            ]
            rows.append([f"  {word}", *shares])
    return _table("epochs", antennas, rows, caption)


def _rows_of_few(antennas: Sequence[Facts]) -> Iterator[list[str]]:
    """Yield epochs with too few satellites: the reason that left too few, and those that it alone did."""
    first = [Counter(facts.get("too_few_satellites_by_first_reason") or {}) for facts in antennas]
    alone = [Counter(facts.get("too_few_satellites_by_one_reason_alone") or {}) for facts in antennas]
    for reason in dict.fromkeys(name for counts in first for name, _ in counts.most_common()):
        both = zip(first, alone, strict=True)
        yield [f"    by {reason}", *(f"{count(mine[reason])} ({count(only[reason])} alone)" for mine, only in both)]


def _ranges_table(antennas: Mapping[str, Facts]) -> Table:
    observed = [facts.get("observations") or 0 for facts in antennas.values()]

    def row(name: str, counts: Sequence[int], alone: Sequence[int] | None = None) -> list[str]:
        cells = [name]
        for k, ranges in enumerate(counts):
            cells += [count(ranges), share(_ratio(ranges, observed[k])), "" if alone is None else count(alone[k])]
        return cells

    rows = [
        row("observed", observed),
        row("used", [facts.get("observations_used") or 0 for facts in antennas.values()]),
    ]
    first, only = (
        [Counter(facts.get(f"observations_rejected_by_{which}") or {}) for facts in antennas.values()]
        for which in ("first_reason", "one_reason_alone")
    )
    for reason in dict.fromkeys(name for counts in first for name, _ in counts.most_common()):
        rows.append(row(f"  {reason}", [counts[reason] for counts in first], [counts[reason] for counts in only]))
    heads = [head for name in antennas for head in (name, "share", "alone")]
    return _table("pseudoranges", heads, rows, "Rejected pseudoranges by their first reason, and by that reason alone")


def _ratio(part: float, whole: float) -> float | None:
    return part / whole if whole else None


def _metres(what: str, found: Sequence[Facts | None], fields: Mapping[str, str]) -> Iterator[list[str]]:
    """Yield a row for each field of what was found of the antennas, None where nothing was."""
    for label, field in fields.items():
        yield [f"{what}, {label}", *(number(None if each is None else each[field], 2, " m") for each in found)]


def _table(name: str, heads: Iterable[str], rows: Sequence[Sequence[str]], caption: str) -> Table:
    head = ["", *heads]
    return Table(name=name, head=head, rows=rows, caption=caption, numeric=range(1, len(head)), boxed=True)
