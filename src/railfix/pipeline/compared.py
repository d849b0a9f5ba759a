"""Steps of a chunk of one antenna, and what two antennas show each other between them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from railfix.core.arrays import Floats
from railfix.screens import AntennaRanges, FilteredMotion, PairedEpochs, PairScreen, PositionScreen, Screened, Verdict
from railfix.screens.pairs import on_pairs


class PositionVerdict(NamedTuple):
    """Verdict of a screen on the positions of one antenna: doubtful ones get the status."""

    name: str
    screened: Screened
    status: int


class ChunkSteps(Protocol):
    """A chunk of one antenna, in this process or another one; the steps are called in this order."""

    def screened(self) -> AntennaRanges:
        """Return the corrected ranges after the screens of this antenna alone."""

    def judge(self, verdicts: Iterable[Verdict]) -> None:
        """Take the verdicts of the screens of common observations."""

    def solved(self) -> Floats:
        """Solve and return the chainages that are published, NaN where there is none, shape (T,) [m]."""

    def check(self, verdicts: Iterable[PositionVerdict]) -> None:
        """Take the verdicts of the screens of the published positions."""

    def filtered(self) -> FilteredMotion:
        """Filter along the track and return its places; NaN where the filter is off."""

    def check_filter(self, spacing: Screened | None) -> None:
        """Take the verdict on the distance and speeds of those places; None where they were not looked at."""


def pair_verdicts(
    screens: Sequence[tuple[Any, Any]], pair: PairedEpochs | None, ranges: Mapping[str, AntennaRanges]
) -> dict[str, tuple[Verdict, ...]]:
    """Return the verdicts of the screens of common observations, by antenna; `screens` are with their limits."""
    verdicts: dict[str, tuple[Verdict, ...]] = {}
    for screen, limits in screens:
        if pair is not None and isinstance(screen, PairScreen):
            for name, more in screen.judge(ranges["front"], ranges["rear"], pair, limits).items():
                verdicts[name] = (*verdicts.get(name, ()), *more)
    return verdicts


def position_verdicts(
    screens: Sequence[tuple[Any, Any]], pair: PairedEpochs | None, chainage_m: Mapping[str, Floats]
) -> dict[str, tuple[PositionVerdict, ...]]:
    """Return the verdicts of the screens of the published positions, by antenna; both antennas get the status."""
    checks: dict[str, tuple[PositionVerdict, ...]] = {}
    for screen, limits in screens:
        if pair is None or not isinstance(screen, PositionScreen):
            continue
        front, rear = chainage_m["front"][pair.front_epoch], chainage_m["rear"][pair.rear_epoch]
        verdict = screen.judge(front, rear, pair, limits)
        for name, epochs in (("front", pair.front_epoch), ("rear", pair.rear_epoch)):
            screened = on_pairs(verdict, chainage_m[name].shape, epochs, epochs)
            checks[name] = (*checks.get(name, ()), PositionVerdict(screen.name, screened, int(screen.status)))
    return checks


def filter_verdicts(
    screens: Sequence[tuple[Any, Any]], pair: PairedEpochs | None, filtered: Mapping[str, FilteredMotion]
) -> dict[str, Screened]:
    """Return the verdicts of the screens of positions on the places by the filter, by antenna."""
    checks: dict[str, Screened] = {}
    for screen, limits in screens:
        if pair is None or not isinstance(screen, PositionScreen):
            continue
        epochs = {"front": pair.front_epoch, "rear": pair.rear_epoch}
        front, rear = (filtered[name].take(rows) for name, rows in epochs.items())
        verdict = screen.judge_filtered(front, rear, pair, limits)
        for name, rows in epochs.items():
            checks[name] = on_pairs(verdict, filtered[name].chainage_m.shape, rows, rows)
    return checks
