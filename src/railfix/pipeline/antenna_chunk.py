"""A chunk of one antenna on its way through the pipeline, and the arrays that short chunks share."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from railfix.core.arrays import Bits, Codes, Floats, changed
from railfix.gnss.observations import Observations, concatenate
from railfix.motion.samples import SensorSamples
from railfix.pipeline.along_track import along_track, checked
from railfix.pipeline.assemble import antenna_results, with_coordinates
from railfix.pipeline.carrier_stage import CarrierState, smoothed, with_slips
from railfix.pipeline.compared import PositionVerdict
from railfix.pipeline.config import Config
from railfix.pipeline.corrected_ranges import CorrectedRanges
from railfix.pipeline.filter_result import AlongTrack, FilterState, SingleEpochs
from railfix.pipeline.results import AntennaResult, AntennaState
from railfix.pipeline.solution import Solution, solve
from railfix.positioning.antenna_rows import EVERY, AntennaRows, joined, rows_of
from railfix.positioning.map_offset import beyond_threshold
from railfix.positioning.section_search import SearchIndex
from railfix.screens import FilteredMotion, ObservationScreen, Screened, Verdict

if TYPE_CHECKING:
    from railfix.pipeline.processor import EpochProcessor

#: Epochs of all antennas up to which they are rows of the same arrays: with more of them, calls cost little.
_FEW: Final = 16


def is_short(observations: Sequence[Observations]) -> bool:
    """Whether chunks of several antennas are so short that their stages are better called once."""
    lengths = [len(part) for part in observations]
    return len(lengths) > 1 and min(lengths) > 0 and sum(lengths) <= _FEW


def one_after_the_other(observations: Sequence[Observations]) -> tuple[Observations, tuple[slice, ...]]:
    """Join observations of several antennas; return them, with all their channels, and the epochs of each."""
    first, *others = observations
    if not others:
        return first, (EVERY,)
    ends = [0, *accumulate(map(len, observations))]
    parts = tuple(slice(a, b) for a, b in pairwise(ends))
    if all(_same_channels(first, other) for other in others):
        return joined(observations), parts
    return concatenate(observations), parts


def _same_channels(one: Observations, other: Observations) -> bool:
    """Whether two receivers have the same channels in the same order, and GLONASS satellites the same frequencies."""
    return (
        one.satellite.tobytes() == other.satellite.tobytes()
        and one.signal.tobytes() == other.signal.tobytes()
        and one.header.glonass_channel == other.header.glonass_channel
    )


class SolvedTogether:
    """Chunks whose epochs are rows of the same arrays from their corrected ranges to their results.

    Parameters
    ----------
    corrected : CorrectedRanges
        Of all of them, before the screens.
    antennas : AntennaRows
    config : Config
    """

    def __init__(self, corrected: CorrectedRanges, antennas: AntennaRows, config: Config) -> None:
        self._corrected, self._antennas, self._config = corrected, antennas, config
        self._chunks: list[AntennaChunk] = []
        self._solution: Solution | None = None
        self._results: list[AntennaResult] = []

    def add(self, chunk: AntennaChunk) -> tuple[int, CorrectedRanges]:
        """Add the chunk of the next antenna; return its number and its corrected ranges."""
        number = len(self._chunks)
        self._chunks.append(chunk)
        return number, rows_of(self._corrected, self._antennas.parts[number])

    def index(self, number: int) -> SearchIndex:
        """Return the search index of the trajectory of a chunk."""
        return self._antennas.indices[number]

    def rows(self, number: int) -> slice:
        """Return the rows of a chunk."""
        return self._antennas.parts[number]

    def solution(self) -> Solution:
        """Return the positions of all chunks, which then have their new states; after the screens of all."""
        if self._solution is None:
            screened = [chunk.screened() for chunk in self._chunks]
            corrected = screened[0]
            if len(screened) > 1:
                parts = {name: np.concatenate([vars(r)[name] for r in screened]) for name in ("reason", "sigma_m")}
                corrected = changed(self._corrected, **parts)
            before = [chunk.state for chunk in self._chunks]
            self._corrected, self._solution, states = solve(corrected, self._antennas, self._config, before)
            for chunk, rows, state in zip(self._chunks, self._antennas.parts, states, strict=True):
                chunk.take(self._corrected.reason[rows], self._solution.status[rows], state)
        return self._solution

    def result(self, number: int) -> AntennaResult:
        """Return the result of a chunk; after the last verdict on the status of any."""
        if not self._results:
            solution = changed(self.solution(), status=joined([chunk.status for chunk in self._chunks]))
            results = antenna_results(self._corrected, self._antennas, solution, self._config)
            of_each = zip(self._chunks, self._antennas.parts, strict=True)
            self._results = [changed(rows_of(results, rows), screens=c.screened().screens) for c, rows in of_each]
            self._chunks.clear()  # each of them has this: arrays are freed as soon as the last one is done
        return self._results[number]


class AntennaChunk:
    """A chunk of one antenna: the steps between which antennas are compared (`ChunkSteps`).

    Parameters
    ----------
    processor : EpochProcessor
    name : str
        The antenna.
    observations : Observations
        Its own.
    together : SolvedTogether
        Has its corrected ranges; the chunks of a `SolvedTogether` are made in the order of its rows.
    state : AntennaState
    filter_state : FilterState
    sensors : SensorSamples or None

    Attributes
    ----------
    status : ndarray of int8, shape (T,)
        Of the positions, once they are solved.
    state : AntennaState
        Before the chunk; after it once `finished` was called.
    filter_state : FilterState
        Likewise.
    tracked : AlongTrack or None
        By the filter along the track, where it is on.
    notes : tuple of str
        On a C/N0 curve of another antenna or receiver.
    """

    def __init__(
        self,
        processor: EpochProcessor,
        name: str,
        observations: Observations,
        together: SolvedTogether,
        state: AntennaState,
        filter_state: FilterState,
        sensors: SensorSamples | None,
    ) -> None:
        self.config = processor.config
        self.filter_state = filter_state
        self.tracked: AlongTrack | None = None
        curve = processor.setup.cn0_curve if "cn0" in self.config.screens else None
        self.notes = () if curve is None else tuple(f"{name}: {n}" for n in curve.notes_for(observations.header))
        self._sensors, self._together = sensors, together
        self._number, corrected = together.add(self)
        self._rows, self._trajectory = together.rows(self._number), together.index(self._number).trajectory
        self._surroundings = processor.line_references(name, sensors)
        self._ranges, self.state = self._screened(corrected, state, processor)
        self.status = np.zeros(0, dtype=np.int8)
        self._result: AntennaResult | None = None

    def _screened(
        self, ranges: CorrectedRanges, state: AntennaState, processor: EpochProcessor
    ) -> tuple[CorrectedRanges, AntennaState]:
        """Return the corrected ranges after the screens of this antenna alone, and its new state."""
        states = dict(state.screens)
        for screen, limits in processor.screens:
            if isinstance(screen, ObservationScreen):
                verdicts, after = screen.judge(ranges, limits, processor.setup, states.get(screen.name))
                ranges = ranges.judged(verdicts)
                if after is not None:
                    states[screen.name] = after
        state = replace(state, screens=states)
        if self.config.carrier != "off":
            before = state.carrier or CarrierState()
            ranges, carrier = with_slips(ranges, self.config, before)
            if self.config.carrier == "smoothed":
                ranges, carrier = smoothed(ranges, self.config, carrier)
            state = replace(state, carrier=carrier)
        return ranges, state

    def screened(self) -> CorrectedRanges:
        """Return the corrected ranges after the screens so far."""
        return self._ranges

    def judge(self, verdicts: Iterable[Verdict]) -> None:
        """Take the verdicts of the screens of common observations."""
        self._ranges = self._ranges.judged(verdicts)

    def take(self, reason: Bits, status: Codes, state: AntennaState) -> None:
        """Take what the solution says of the ranges and epochs, and the state after it."""
        self._ranges, self.status, self.state = changed(self._ranges, reason=reason), status, state

    def solved(self) -> Floats:
        """Solve and return the chainages that are published, NaN where there is none, shape (T,) [m]."""
        return self._trajectory.chainage_at(self._together.solution().arc_m[self._rows])

    def check(self, verdicts: Iterable[PositionVerdict]) -> None:
        """Take the verdicts of the screens of the published positions."""
        for verdict in verdicts:
            doubtful = verdict.screened.reject & with_coordinates(self.config.failed_checks)[self.status]
            self.status = np.where(doubtful, verdict.status, self.status).astype(np.int8)
            screens = {**self._ranges.screens, verdict.name: verdict.screened}
            self._ranges = changed(self._ranges, screens=screens)

    def filtered(self) -> FilteredMotion:
        """Filter along the track and return its places; NaN where the filter is off."""
        result = self._result = self._together.result(self._number)
        if self.config.filter == "off":
            nowhere = np.full(len(result), np.nan)
            return FilteredMotion(nowhere, nowhere, nowhere, nowhere)
        self.tracked, self.filter_state = along_track(
            self._ranges,
            self._single_epochs(result),
            self._trajectory,
            self.config,
            self.filter_state,
            samples=self._sensors,
            surroundings=self._surroundings,
        )
        found = self.tracked.tracked
        return FilteredMotion(self.tracked.chainage_m, found.sigma_m, found.speed_mps, found.speed_sigma_mps)

    def check_filter(self, spacing: Screened | None) -> None:
        """Take the verdict on the distance and speeds of those places; None where they were not looked at."""
        if self.tracked is not None:
            held_s = self.config.antenna_spacing.filter_held_s
            self.tracked, self.filter_state = checked(self.tracked, spacing, self.filter_state, held_s)

    def finished(self) -> AntennaResult:
        """Return the result of the chunk."""
        assert self._result is not None, "filtered() comes first"
        return self._result

    def _single_epochs(self, result: AntennaResult) -> SingleEpochs:
        """Results of single epochs that the filter along the track uses."""
        return SingleEpochs(
            noise_scale=result.noise_scale,
            arc_m=result.arc_m,
            sigma_m=result.own_sigma_m,
            near_ecef_m=result.conventional_ecef_m,
            off_map=self._together.solution().off_map[self._rows],
            map_offset=beyond_threshold(result.map_offset, self.config.map_offset),
        )
