"""What two antennas of one vehicle show each other: screens of common observations, of positions, of the filter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from railfix.core.arrays import Floats, changed
from railfix.pipeline.corrected_ranges import CorrectedRanges
from railfix.positioning.antenna_rows import joined
from railfix.screens import FilteredMotion, PairedEpochs, PairScreen, PositionScreen, Screened
from railfix.screens.pairs import on_pairs


class PositionVerdict(NamedTuple):
    """Verdict of a screen on the positions of one antenna: doubtful ones get the status."""

    name: str
    screened: Screened
    status: int


def judge_pairs(
    screens: Sequence[tuple[Any, Any]], pair: PairedEpochs | None, ranges: Mapping[str, CorrectedRanges]
) -> dict[str, CorrectedRanges]:
    """Return the ranges after the screens of common observations, by antenna; `screens` are with their limits."""
    judged = dict(ranges)
    for screen, limits in screens:
        if pair is not None and isinstance(screen, PairScreen):
            for name, verdicts in screen.judge(ranges["front"], ranges["rear"], pair, limits).items():
                judged[name] = judged[name].judged(verdicts)
    return judged


def with_screens(corrected: CorrectedRanges, ranges: Mapping[str, CorrectedRanges]) -> CorrectedRanges:
    """Return the ranges of all antennas with what the screens and the carrier phases of each have changed."""
    names = ("reason", "sigma_m", "corrected_code_m", "bound_sigma_m", "bias_m", "combined", "slips")
    return changed(corrected, **{name: joined([getattr(own, name) for own in ranges.values()]) for name in names})


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
