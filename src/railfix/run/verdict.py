"""Verdict on a run: figures that have the same names on the terminal, in the report, in JSON and in Python.

`judge_run` reads all figures from the record of the run (``run.json``), so that the same values appear everywhere.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from railfix.core.reasons import Status
from railfix.core.tables import count, number
from railfix.run.record import level_basis

#: Names of the figures on the terminal, in the report and in JSON.
POSITIONS: Final = "epochs with a position"
PASSED: Final = "epochs that passed every check"
SIGMA: Final = "sigma along the line, median"
#: Filter statuses of positions that have passed every check.
_PROMISED: Final = ("tracking", "coasting")


@dataclass(frozen=True, kw_only=True)
class PositionFigures:
    """Figures of an antenna's filtered or single-epoch positions. A figure that does not exist is None."""

    epochs: int  #: Number of epochs; for single epochs, only those with observations.
    positions: int  #: Number of epochs with a position.
    passed: int  #: Number of epochs with the status `ok` (filter: `tracking` or `coasting`).
    statuses: Mapping[str, int]  #: Number of epochs by status, most frequent first.
    chainage_first_m: float | None  #: Smallest chainage of a position [m].
    chainage_last_m: float | None  #: Largest chainage of a position [m].
    sigma_p50_m: float | None  #: Median standard deviation along the line [m].
    sigma_p95_m: float | None  #: 95th percentile of the standard deviation along the line [m].
    sigma_max_m: float | None  #: Largest standard deviation along the line [m].
    level_p50_m: float | None  #: Median of the finite protection levels [m].
    level_p95_m: float | None  #: 95th percentile of the finite protection levels [m].


@dataclass(frozen=True, kw_only=True)
class AntennaVerdict:
    """Verdict on one antenna."""

    antenna: str
    level_name: str  #: "protection level", or "indicative protection level" if the fault priors are assumed.
    filter: PositionFigures | None  #: Figures of the along-track filter; None if the filter was off.
    single_epochs: PositionFigures

    @property
    def leading(self) -> PositionFigures:
        """Figures of the filter, or of single epochs if the filter was off."""
        return self.filter or self.single_epochs

    @property
    def is_usable(self) -> bool:
        """Whether there is a filtered position, or, without the filter, a position that is not off the map."""
        off_map = 0 if self.filter is not None else self.leading.statuses.get(Status.OFF_MAP.text, 0)
        return self.leading.positions > off_map

    def figures(self) -> Iterator[tuple[str, str, str]]:
        """Yield the name of each figure, its `leading` value, and its single-epoch value ("" if the filter was off)."""
        texts: dict[str, Callable[[PositionFigures], str]] = {
            POSITIONS: lambda of: f"{count(of.positions)} of {count(of.epochs)}",
            PASSED: lambda of: f"{count(of.passed)} of {count(of.epochs)}",
            SIGMA: lambda of: number(of.sigma_p50_m, 1, " m"),
            f"{self.level_name}, median": lambda of: number(of.level_p50_m, 1, " m"),
        }
        for name, text in texts.items():
            yield name, text(self.leading), "" if self.filter is None else text(self.single_epochs)


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Verdict on a run."""

    antennas: tuple[AntennaVerdict, ...]
    causes: tuple[str, ...]  #: Likely causes of positions off the line.
    notes: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the verdict as plain values for JSON."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Return sentences: one per antenna, one on the checks, one on the filter, and one on the likely cause."""
        return [*self._figure_lines(), *self._cause_lines()]

    def failure(self) -> str:
        """Return the message on a run without usable positions: likely cause or notes on the map, then the figures."""
        of_map = [note for note in self.notes if ": the map " in note]
        return "; ".join(["no position can be used", *(self._cause_lines() or of_map), *self._figure_lines()])

    def _cause_lines(self) -> list[str]:
        return [f"likely cause: {cause}" for cause in self.causes[:1]]

    def _figure_lines(self) -> list[str]:
        lines = [_describe(antenna) for antenna in self.antennas]
        lines.append(_describe_checks([antenna.single_epochs for antenna in self.antennas]))
        filtered = [antenna.filter for antenna in self.antennas if antenna.filter is not None]
        if filtered:
            lines.append(_describe_filter(filtered))
        return lines


def judge_run(record: Mapping[str, Any]) -> Verdict:
    """Return the verdict on a run, given its record. Figures that a record of an earlier version lacks are None."""
    level_name = f"{level_basis(record)} level"
    antennas = []
    for name, facts in (record.get("antennas") or {}).items():
        filtered = facts.get("filter")
        single = {**facts, "level": facts.get("protection_level")}
        single["status"] = {word: n for word, n in facts["status"].items() if word != Status.NO_OBSERVATION.text}
        antennas.append(
            AntennaVerdict(
                antenna=name,
                level_name=level_name,
                filter=None if filtered is None else _figures(filtered, _PROMISED),
                single_epochs=_figures(single, (Status.OK.text,)),
            )
        )
    causes, notes = (tuple(record.get(name) or ()) for name in ("likely_causes", "notes"))
    return Verdict(antennas=tuple(antennas), causes=causes, notes=notes)


def _figures(facts: Mapping[str, Any], promised: Sequence[str]) -> PositionFigures:
    """Return the figures of an antenna or its filter. `promised` are the statuses that mean "passed every check"."""
    statuses = Counter({word: epochs for word, epochs in facts["status"].items() if epochs})
    chainage, sigma, level = (facts.get(name) or {} for name in ("chainage_m", "along_sigma_m", "level"))
    return PositionFigures(
        epochs=statuses.total(),
        positions=chainage.get("positions", 0),
        passed=sum(statuses[word] for word in promised),
        statuses=dict(statuses.most_common()),
        chainage_first_m=chainage.get("first"),
        chainage_last_m=chainage.get("last"),
        sigma_p50_m=sigma.get("p50_m"),
        sigma_p95_m=sigma.get("p95_m"),
        sigma_max_m=sigma.get("max_m"),
        level_p50_m=level.get("p50_m"),
        level_p95_m=level.get("p95_m"),
    )


def _describe(antenna: AntennaVerdict) -> str:
    of = antenna.leading
    by = "filter along the track" if antenna.filter is not None else "single epochs"
    text = f"{antenna.antenna}: a position in {of.positions:,} of {of.epochs:,} epochs ({by})"
    if of.positions:
        text += f", chainage {of.chainage_first_m:.0f} to {of.chainage_last_m:.0f} m"
    if of.sigma_p50_m is not None:
        text += f"; sigma {of.sigma_p50_m:.1f} m at the median, {of.sigma_max_m:.1f} m at most"
    if of.level_p50_m is not None:
        text += f"; {antenna.level_name} {of.level_p50_m:.1f} m at the median"
    return text


def _describe_checks(figures: Sequence[PositionFigures]) -> str:
    """Return a sentence on the number of single epochs that passed every check, and on the most frequent failure."""
    passed, epochs = sum(of.passed for of in figures), sum(of.epochs for of in figures)
    failed = _count_statuses(figures)
    del failed[Status.OK.text]
    text = f"single epochs: {passed:,} of {epochs:,} with observations passed every check"
    return f"{text}; the most frequent other status is {failed.most_common(1)[0][0]}" if failed else text


def _describe_filter(figures: Sequence[PositionFigures]) -> str:
    counts = _count_statuses(figures).most_common()
    return "filter along the track: " + ", ".join(f"{epochs:,} epochs {word}" for word, epochs in counts)


def _count_statuses(figures: Sequence[PositionFigures]) -> Counter[str]:
    statuses = Counter[str]()
    for of in figures:
        statuses.update(of.statuses)
    return statuses
