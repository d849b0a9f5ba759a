"""State passed from one chunk to the next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from railfix.core.notebook import NotebookTable
from railfix.integrity.persistent_biases import LastingErrorState
from railfix.pipeline.base_station_stage import BaseState
from railfix.pipeline.carrier_stage import CarrierState
from railfix.pipeline.filter_result import FilterState
from railfix.pipeline.interference_stage import InterferenceState
from railfix.pipeline.observable_checks import ObservableState
from railfix.pipeline.off_map import OffMapState
from railfix.pipeline.received import Received
from railfix.positioning.inter_system import OffsetState
from railfix.positioning.map_offset import MapOffsetState
from railfix.positioning.receiver_noise import NoiseState
from railfix.positioning.two_frequencies import TwoFrequencyState


@dataclass(frozen=True, kw_only=True)
class AntennaState(NotebookTable):
    """State of one antenna after a chunk."""

    noise: NoiseState = field(default_factory=NoiseState)  #: State of the noise scales.
    map_offset: MapOffsetState = field(default_factory=MapOffsetState)  #: State of the test of the map.
    lasting: LastingErrorState = field(default_factory=LastingErrorState)  #: State of the test for persistent errors.
    off_map: OffMapState = field(default_factory=OffMapState)  #: State of the off-map test.
    offsets: OffsetState = field(default_factory=OffsetState)  #: Inter-system biases estimated so far.
    screens: Mapping[str, Any] = field(default_factory=dict)  #: States of the screens that have one, by name.
    carrier: CarrierState | None = None  #: State of the carrier-phase stages; None if unused.
    #: Time tag of the last epoch; NaT before the first epoch.
    ended: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    #: Mean differences between the two codes of each satellite.
    two_frequencies: TwoFrequencyState = field(default_factory=TwoFrequencyState)

    interference: InterferenceState = field(default_factory=InterferenceState)
    #: State of the checks of Doppler and phase signs and units.
    observables: ObservableState = field(default_factory=ObservableState)

    def __repr__(self) -> str:
        screens = ", ".join(sorted(self.screens)) or "none"
        return f"<AntennaState: screens with a state: {screens}>"


@dataclass(frozen=True, kw_only=True)
class State(NotebookTable):
    """State after a chunk: everything that the next chunk needs."""

    antennas: Mapping[str, AntennaState] = field(default_factory=dict)
    #: Navigation records and SBAS messages received so far; None stands for the processor's initial data.
    received: Received | None = None
    base: BaseState | None = None  #: State of the base station; None without one.
    fusion: Mapping[str, FilterState] = field(default_factory=dict)  #: State of the filter along the track, by antenna.

    def __repr__(self) -> str:
        antennas = ", ".join(self.antennas) or "before the first epoch"
        return f"<State: {antennas}{'; with the filter' if self.fusion else ''}>"
