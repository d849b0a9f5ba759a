"""Data of a chunk of epochs, passed from stage to stage of the pipeline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from railfix.core.arrays import Floats
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

    names: tuple[str, ...]  #: Names of the antennas.
    antennas: AntennaRows  #: Trajectories and rows of the antennas.
    corrected: CorrectedRanges  #: Corrected ranges with the rejection reasons so far.
    pair: PairedEpochs | None  #: Common epochs of two antennas of one vehicle; None without two.
    sensors: SensorSamples | None  #: On-board sensor samples since the previous chunk.
    notes: tuple[str, ...]
    #: Ionospheric coefficients in use, shape (8,); None if the ionosphere is uncorrected, or corrected by SBAS.
    klobuchar: Floats | None = None
    screens: Mapping[str, Screened] = field(default_factory=dict)  #: Metrics and verdicts by observation screen.
    combined: Combined | None = None  #: Combined codes of two frequencies; None with one frequency.
    slips: Slips | None = None  #: Cycle slips of all channels of the observations, if the carrier phase is used.
    solution: Solution | None = None  #: Positions of single epochs.
    interference: Sequence[Interference | None] = ()  #: Signs of interference at each antenna; None if unchecked.
    #: Verdicts of the position screens, by antenna and screen.
    judged: Mapping[str, Mapping[str, Screened]] = field(default_factory=dict)

    @property
    def rows(self) -> dict[str, slice]:
        """Rows of each antenna's epochs in the concatenated arrays."""
        return dict(zip(self.names, self.antennas.parts, strict=True))
