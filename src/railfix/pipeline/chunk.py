"""A chunk of epochs between the stages of the pipeline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from railfix.motion.samples import SensorSamples
from railfix.pipeline.interference_stage import Interference
from railfix.pipeline.solution import Solution
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.carrier import Slips
from railfix.positioning.two_frequencies import Combined
from railfix.ranges.corrected import CorrectedRanges
from railfix.screens import PairedEpochs, Screened


@dataclass(frozen=True, kw_only=True)
class Chunk:
    """Epochs of all antennas, concatenated, and the outputs of the stages so far."""

    names: tuple[str, ...]  #: Of the antennas.
    antennas: AntennaRows  #: Their trajectories and rows.
    corrected: CorrectedRanges  #: Corrected ranges with the verdicts so far.
    pair: PairedEpochs | None  #: Common epochs of two antennas of one vehicle.
    sensors: SensorSamples | None  #: Samples of the sensors on board since the previous chunk.
    notes: tuple[str, ...]
    screens: Mapping[str, Screened] = field(default_factory=dict)  #: Metric and verdict of each screen of observations.
    combined: Combined | None = None  #: How codes of two frequencies were combined.
    slips: Slips | None = None  #: Of all channels of the observations, where the carrier phase is used.
    solution: Solution | None = None  #: Positions of single epochs.
    interference: Sequence[Interference | None] = ()  #: Of each antenna.
    #: Verdicts of the screens of positions, by antenna and screen.
    judged: Mapping[str, Mapping[str, Screened]] = field(default_factory=dict)

    @property
    def rows(self) -> dict[str, slice]:
        """Epochs of each antenna among those of all."""
        return dict(zip(self.names, self.antennas.parts, strict=True))
