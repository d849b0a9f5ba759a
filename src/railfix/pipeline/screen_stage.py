"""Screens of the observations, combination of frequencies and carrier smoothing, over the rows of all antennas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from railfix.core.arrays import copy_with
from railfix.core.epoch_rows import join_epochs, take_epochs
from railfix.pipeline.carrier_stage import CarrierState, find_antenna_slips, smooth_ranges
from railfix.pipeline.config import Config
from railfix.pipeline.frequency_stage import combine_frequencies
from railfix.pipeline.observable_checks import check_observables
from railfix.pipeline.range_stage import apply_verdict
from railfix.pipeline.state import AntennaState
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.carrier import Slips
from railfix.positioning.two_frequencies import Combined
from railfix.ranges.corrected import CorrectedRanges
from railfix.screens import PairedEpochs, Screened, ScreenSetup


class Screening(NamedTuple):
    """Ranges of all antennas after the screens of each antenna."""

    corrected: CorrectedRanges
    notes: tuple[str, ...]  #: On Dopplers and phases that are not used.
    screens: Mapping[str, Screened]  #: Metric and verdict of each screen.
    combined: Combined | None
    slips: Slips | None


def screen_antennas(
    corrected: CorrectedRanges,
    antennas: AntennaRows,
    screens: Sequence[tuple[Any, Any]],
    setup: ScreenSetup,
    config: Config,
    ionosphere_sigma_m: float,
    states: Sequence[AntennaState],
) -> tuple[Screening, list[AntennaState]]:
    """Return the ranges after the screens of one antenna alone (`screens`, with their limits), and new states.

    Dopplers and phases of the wrong sign or unit are left out first. Codes of two frequencies are combined here, and
    smoothed by the carrier phase where the settings request it.
    """
    checked = [
        check_observables(take_epochs(corrected, rows), state.observables)
        for rows, state in zip(antennas.parts, states, strict=True)
    ]
    if any(own.notes for own in checked):
        corrected = join_epochs([own.corrected for own in checked])
    states = [copy_with(state, observables=own.state) for state, own in zip(states, checked, strict=True)]
    found: dict[str, Screened] = {}
    kept = [dict(state.screens) for state in states]
    for screen, limits in screens:
        judged = [
            screen.judge(take_epochs(corrected, rows), limits, setup, own.get(screen.name))
            for rows, own in zip(antennas.parts, kept, strict=True)
        ]
        for verdict in map(join_epochs, zip(*(verdicts for verdicts, _ in judged), strict=True)):
            corrected = apply_verdict(corrected, verdict)
            found[verdict.name] = verdict.screened
        for own, (_, state) in zip(kept, judged, strict=True):
            if state is not None:
                own[screen.name] = state
    combined, two = None, [state.two_frequencies for state in states]
    if corrected.second is not None:
        corrected, combined, verdict, two = combine_frequencies(corrected, antennas, config, ionosphere_sigma_m, two)
        corrected = apply_verdict(corrected, verdict)
        found[verdict.name] = verdict.screened
    slips, carriers = None, [state.carrier for state in states]
    if config.carrier != "off":
        begun = [state or CarrierState() for state in carriers]
        slips, begun = find_antenna_slips(corrected, antennas, config, begun)
        if config.carrier == "smoothed":
            corrected, begun = smooth_ranges(corrected, combined, slips, antennas, config, begun)
        carriers = [*begun]
    after = [
        copy_with(state, screens=kept[k], carrier=carriers[k], two_frequencies=two[k]) for k, state in enumerate(states)
    ]
    return Screening(corrected, tuple(note for own in checked for note in own.notes), found, combined, slips), after


def screen_pairs(
    screening: Screening, rows: Mapping[str, slice], screens: Sequence[tuple[Any, Any]], pair: PairedEpochs | None
) -> Screening:
    """Return the ranges after the screens of common observations of two antennas (`screens`, with their limits)."""
    corrected, found = screening.corrected, dict(screening.screens)
    for screen, limits in screens if pair is not None else ():
        front, rear = (take_epochs(corrected, rows[name]) for name in ("front", "rear"))
        judged = screen.judge(front, rear, pair, limits)
        for verdict in map(join_epochs, zip(*(judged[name] for name in rows), strict=True)):
            corrected = apply_verdict(corrected, verdict)
            found[verdict.name] = verdict.screened
    return screening._replace(corrected=corrected, screens=found)
