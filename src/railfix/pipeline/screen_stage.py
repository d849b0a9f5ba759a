"""Apply screens, the combination of two frequencies, and carrier smoothing to all antennas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from railfix.core.arrays import Codes, copy_with
from railfix.core.epoch_rows import join_epochs, take_epochs
from railfix.pipeline.carrier_stage import CarrierState, find_antenna_slips, smooth_ranges
from railfix.pipeline.chunk import Chunk
from railfix.pipeline.config import Config
from railfix.pipeline.frequency_stage import combine_frequencies
from railfix.pipeline.observable_checks import check_observables
from railfix.pipeline.processor_state import AntennaState
from railfix.pipeline.range_stage import apply_verdict
from railfix.pipeline.solution import Solution, with_coordinates
from railfix.positioning.antenna_rows import AntennaRows
from railfix.screens import FilteredMotion, PairedEpochs, Screened, ScreenSetup
from railfix.screens.pairs import on_pairs


def screen_antennas(
    chunk: Chunk,
    screens: Sequence[tuple[Any, Any]],
    setup: ScreenSetup,
    config: Config,
    ionosphere_sigma_m: float,
    states: Sequence[AntennaState],
) -> tuple[Chunk, list[AntennaState]]:
    """Apply the screens of single antennas (`screens`, with their limits) to a chunk; return the chunk and new states.

    Dopplers and phases of wrong sign or unit are removed first. Codes of two frequencies are combined here, and
    smoothed by the carrier phase where the settings request it.
    """
    corrected, antennas = chunk.corrected, chunk.antennas
    checked = [
        check_observables(take_epochs(corrected, rows), state.observables)
        for rows, state in zip(antennas.parts, states, strict=True)
    ]
    notes = tuple(note for _, own, _ in checked for note in own)
    if notes:
        corrected = join_epochs([own for own, _, _ in checked])
    states = [copy_with(state, observables=own) for state, (_, _, own) in zip(states, checked, strict=True)]
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
    notes = (*chunk.notes, *notes)
    return copy_with(chunk, corrected=corrected, screens=found, combined=combined, slips=slips, notes=notes), after


def screen_pairs(chunk: Chunk, screens: Sequence[tuple[Any, Any]]) -> Chunk:
    """Apply the screens of two antennas' common observations (`screens`, with their limits) to a chunk."""
    corrected, found, rows = chunk.corrected, dict(chunk.screens), chunk.rows
    for screen, limits in screens if chunk.pair is not None else ():
        front, rear = (take_epochs(corrected, rows[name]) for name in ("front", "rear"))
        judged = screen.judge(front, rear, chunk.pair, limits)
        for verdict in map(join_epochs, zip(*(judged[name] for name in rows), strict=True)):
            corrected = apply_verdict(corrected, verdict)
            found[verdict.name] = verdict.screened
    return copy_with(chunk, corrected=corrected, screens=found)


def screen_positions(
    pair: PairedEpochs | None,
    rows: Mapping[str, slice],
    antennas: AntennaRows,
    solution: Solution,
    screens: Sequence[tuple[Any, Any]],
    config: Config,
) -> tuple[Codes, dict[str, dict[str, Screened]]]:
    """Apply the screens that compare the positions of two antennas; return the statuses (T,), and verdicts by antenna.

    If a screen rejects an epoch, the positions of both antennas get the status of this screen.
    """
    status, judged = solution.status.copy(), {name: dict[str, Screened]() for name in rows}
    if pair is None or not screens:
        return status, judged
    chainage = antennas.chainage_at(solution.arc_m)
    epochs = {"front": pair.front_epoch, "rear": pair.rear_epoch}
    for screen, limits in screens:
        verdict = screen.judge(*(chainage[rows[name]][own] for name, own in epochs.items()), pair, limits)
        for name, own in epochs.items():
            found = on_pairs(verdict, chainage[rows[name]].shape, own, own)
            doubtful = found.reject & with_coordinates(config.failed_checks)[status[rows[name]]]
            status[rows[name]] = np.where(doubtful, int(screen.status), status[rows[name]])
            judged[name][screen.name] = found
    return status, judged


def screen_filtered(
    screens: Sequence[tuple[Any, Any]], pair: PairedEpochs | None, filtered: Mapping[str, FilteredMotion]
) -> dict[str, Screened]:
    """Return the verdicts of the position screens on the filtered positions, by antenna."""
    judged: dict[str, Screened] = {}
    for screen, limits in screens if pair is not None else ():
        assert pair is not None
        epochs = {"front": pair.front_epoch, "rear": pair.rear_epoch}
        verdict = screen.judge_filtered(*(filtered[name].take(own) for name, own in epochs.items()), pair, limits)
        for name, own in epochs.items():
            judged[name] = on_pairs(verdict, filtered[name].chainage_m.shape, own, own)
    return judged
