"""A chunk of epochs between the stages of the pipeline."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from railfix.core.arrays import Masks
from railfix.motion.samples import SensorSamples
from railfix.pipeline.results import AntennaResult
from railfix.positioning.carrier import Slips
from railfix.positioning.two_frequencies import Combined
from railfix.ranges.corrected import CorrectedRanges
from railfix.screens import PairedEpochs, Screened


@dataclass(frozen=True, kw_only=True)
class Chunk:
    """Epochs of all antennas, concatenated, and the results of the stages so far."""

    corrected: CorrectedRanges  #: Corrected ranges with the verdicts so far.
    rows: Mapping[str, slice]  #: Rows of each antenna among those of all.
    screens: Mapping[str, Screened]  #: Metric and verdict of each screen of the observations.
    combined: Combined | None  #: How codes of two frequencies were combined.
    slips: Slips | None  #: Wavelength of all channels of the observations, where the carrier phase is used.
    pair: PairedEpochs | None  #: Common epochs of two antennas of one vehicle.
    sensors: SensorSamples | None  #: Samples of the sensors on board since the previous chunk.
    notes: tuple[str, ...]
    results: Mapping[str, AntennaResult] = field(default_factory=dict)  #: Single epochs by antenna, once positioned.
    #: The train is away from the line, epochs of all antennas; empty before they are positioned.
    off_map: Masks = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
