"""Results of the pipeline with every intermediate value, and the state carried from one chunk to the next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from railfix.core.arrays import Bits, Codes, Datetimes, Floats, Indices, Integers, Masks, Strings, copy_with
from railfix.core.reasons import Status
from railfix.core.tables import NotebookTable, html_list, html_table, median_text, plural, time_span_text
from railfix.gnss.orbits import SatelliteStates
from railfix.integrity.protection import ProtectionLevel
from railfix.integrity.protection.araim import AraimResult
from railfix.integrity.raim import Outcome
from railfix.pipeline.base_station import BaseState
from railfix.pipeline.carrier_stage import CarrierState
from railfix.pipeline.filter_result import AlongTrack, FilterState, OffMapState
from railfix.pipeline.interference_stage import Interference, InterferenceState
from railfix.pipeline.received import Received
from railfix.positioning.antenna_rows import OnDemand
from railfix.positioning.carrier import PhasePositions
from railfix.positioning.map_offset import MapOffset, MapOffsetState
from railfix.positioning.noise_scale import LastingErrorState, NoiseState, OffsetState
from railfix.positioning.normal_equations import Constrained, SinglePoint
from railfix.positioning.section_search import Section
from railfix.positioning.two_frequencies import Combined, SecondCodes, TwoFrequencyState
from railfix.screens import Screened

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Rows = TypeVar("Rows", bound="DataclassInstance")


@dataclass(frozen=True, kw_only=True)
class RaimResult:
    """Detection and exclusion of T epochs."""

    outcome: Codes  #: `raim.Outcome`, shape (T,).
    #: Before any exclusion; in noise variances, or in m^2 with the fixed limit; shape (T,).
    statistic: Floats
    threshold: Floats
    excluded: Masks  #: Shape (T, K).
    own_error_m: Floats  #: Error of the channels named as faulty against all others; NaN elsewhere; shape (T, K).
    #: `raim.reliability` of the remaining ranges; infinite where a fault of one of them cannot be detected, NaN where
    #: there is no position, where a fault is left in it, or where the level or RAIM is off; shape (T,).
    protection_level_m: Floats

    @property
    def faulty(self) -> Masks:
        """Epochs with a fault left in the position, shape (T,)."""
        return np.asarray((self.outcome == int(Outcome.INSEPARABLE)) | (self.outcome == int(Outcome.UNRESOLVED)))


@dataclass(frozen=True, kw_only=True)
class ProtectionResult:
    """Protection levels of T epochs."""

    #: NaN without a position, and where RAIM has left a fault in it. Channels count as `AntennaResult.columns` do.
    level: ProtectionLevel
    status: Codes  #: `protection.LevelStatus` against `Config.alarm_limit_m`, shape (T,).
    kind: str  #: Hypotheses of the levels: "sbas" or "separation" (`level_stage.KINDS`).
    basis: str  #: "measured" or "indicative": whether the priors were measured on the line (`level_stage.BASES`).


@dataclass(frozen=True, kw_only=True)
class AntennaState(NotebookTable):
    """State of one antenna after a chunk."""

    noise: NoiseState = field(default_factory=NoiseState)  #: Sums behind the noise scales.
    map_offset: MapOffsetState = field(default_factory=MapOffsetState)  #: Sums behind the test of the map.
    lasting: LastingErrorState = field(default_factory=LastingErrorState)  #: Means of the residuals of each satellite.
    off_map: OffMapState = field(default_factory=OffMapState)  #: Whether the train was away from the line.
    offsets: OffsetState = field(default_factory=OffsetState)  #: Inter-system biases estimated so far.
    screens: Mapping[str, Any] = field(default_factory=dict)  #: State of each screen that has one, by its name.
    carrier: CarrierState | None = None  #: State of the carrier-phase stages, where they are used.
    #: Last epoch; NaT before the first.
    ended: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    #: Mean differences of the two codes of satellites.
    two_frequencies: TwoFrequencyState = field(default_factory=TwoFrequencyState)

    interference: InterferenceState = field(default_factory=InterferenceState)

    def __repr__(self) -> str:
        screens = ", ".join(sorted(self.screens)) or "none"
        return f"<AntennaState: screens with a state: {screens}>"


@dataclass(frozen=True, kw_only=True)
class State(NotebookTable):
    """State after a chunk: everything that the next one needs."""

    antennas: Mapping[str, AntennaState] = field(default_factory=dict)
    #: Navigation records and SBAS messages so far; None: those that the processor was made with.
    received: Received | None = None
    base: BaseState | None = None  #: State of the base station.
    fusion: Mapping[str, FilterState] = field(default_factory=dict)  #: State of the filter along the track, by antenna.

    def __repr__(self) -> str:
        antennas = ", ".join(self.antennas) or "before the first epoch"
        return f"<State: {antennas}{'; with the filter' if self.fusion else ''}>"


@dataclass(frozen=True, kw_only=True)
class AntennaResult(NotebookTable, OnDemand):
    """Results of one antenna, T epochs by M channels.

    The channels are those of the observations given, of all antennas where few epochs of several are given together.
    """

    time: Datetimes  #: Shape (T,).
    #: Shape (M,).
    satellite: Strings
    signal: Strings
    status: Codes  #: `reasons.Status`; shape (T,).
    #: Along the line (reference point named by the trajectory), its own marking, and along the antenna's trajectory.
    #: NaN where the status has no position; shape (T,).
    chainage_m: Floats
    kilometrage_m: Floats
    arc_m: Floats
    #: Standard deviation along the line: noise by the weights, the residuals of the window and those of the epoch
    #: itself; satellites and atmosphere; the map error; and the distance to an open other place, by its probability;
    #: shape (T,).
    along_sigma_m: Floats
    #: Single-epoch sigma: standard deviation along the line from the codes of the epoch alone, with the larger of the
    #: receiver's noise and the noise of these residuals, widened by Student's t where few ranges are redundant. Also
    #: given where the position is dropped; shape (T,).
    own_sigma_m: Floats
    #: Standard deviation of this receiver's ranges against the one the weights assume: root mean square of what RAIM
    #: left in the epochs before, with forgetting; shape (T,).
    noise_scale: Floats
    ecef_m: Floats  #: Antenna; shape (T, 3).
    #: Shape (T,).
    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats
    #: Satellites used; satellites with a code that were not used; shape (T,).
    n_used: Integers
    n_rejected: Integers
    #: `railfix.pipeline.solve.PointStatus` of the conventional position, which is kept as it is; shape (T,).
    conventional_status: Codes
    conventional_ecef_m: Floats  #: 3-D single point from the same ranges; shape (T, 3).
    #: Nearest point of the trajectory to it, and how far that is; shape (T,).
    conventional_arc_m: Floats
    conventional_chainage_m: Floats
    conventional_offset_m: Floats
    reason: Bits  #: `reasons.Reason` bits, 0 = used; shape (T, M).
    #: NaN where unknown; shape (T, M).
    elevation_deg: Floats
    azimuth_deg: Floats
    cn0_dbhz: Floats
    sigma_m: Floats
    bound_sigma_m: Floats  #: Least sigma of each range in the level, by the error model; 0 without one; shape (T, M).
    #: NaN where unknown; residuals of the position on the line; shape (T, M).
    corrected_code_m: Floats
    residual_m: Floats
    satellites: SatelliteStates  #: Of the channels in `columns`.
    columns: Indices  #: Channels that settings allow, in the order of the intermediate results below; shape (K,).
    second: SecondCodes | None  #: Second codes of satellites, where two frequencies are used; shape (T, K).
    combined: Combined | None  #: How they were combined with the first.
    #: Metric and verdict of each screen that was on, by name, shape (T, K); "antenna_spacing", which judges positions,
    #: has shape (T,).
    screens: Mapping[str, Screened]
    single_point: SinglePoint  #: The conventional position: every constellation with a clock of its own.
    section: Section
    constrained: Constrained  #: Position on the line.
    #: Positions from code and phase, where ``Config.carrier`` is "float"; they are what the coordinates are.
    phase: PhasePositions | None
    raim: RaimResult  #: Detection and exclusion; `outcome` is UNTESTABLE throughout where the screen is off.
    protection: ProtectionResult | None  #: Protection levels along the line; None where they are off.
    map_offset: MapOffset  #: Mean offset of the 3-D positions of the last minutes from the line.
    interference: Interference | None  #: Jamming and spoofing suspected; None where that is off.
    araim: AraimResult | None  #: ARAIM levels; None without an integrity support message.
    clocks: tuple[str, ...]  #: Letter of each receiver clock of the results above; length G.
    #: Inter-system bias known before each epoch (that clock less the reference clock), and its sigma; shape (T, G).
    clock_offset_m: Floats
    clock_offset_sigma_m: Floats

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        return f"<AntennaResult: {self.status_text()}, {time_span_text(self.time)}>"

    def status_text(self) -> str:
        """Return how many epochs have the status OK: ``1,827 of 2,000 epochs ok``."""
        return f"{int((self.status == Status.OK).sum()):,} of {plural(self, 'epoch')} ok"

    def summary(self) -> dict[str, str]:
        """Return the medians of sigma and level in metres, as texts."""
        level = np.empty(0) if self.protection is None else self.protection.level.level_m
        return {"median sigma [m]": median_text(self.along_sigma_m), "median level [m]": median_text(level)}


@dataclass(frozen=True, kw_only=True)
class Result(NotebookTable):
    """Results of one chunk."""

    antennas: Mapping[str, AntennaResult]
    notes: tuple[str, ...]  #: Differences between what was requested and what was used, one sentence each.
    #: Positions of the filter along the track, by antenna; empty where it is off.
    fusion: Mapping[str, AlongTrack] = field(default_factory=dict)

    def __getitem__(self, antenna: str) -> AntennaResult:
        """Return the single-epoch results of an antenna; KeyError where there is none of that name."""
        return self.antennas[antenna]

    def __repr__(self) -> str:
        parts = (
            f"{name} {self.fusion[name].status_text()} (single epochs: {result.status_text()})"
            if name in self.fusion
            else f"{name} {result.status_text()}"
            for name, result in self.antennas.items()
        )
        return f"<Result: {'; '.join(parts)}>"

    def _repr_html_(self) -> str:
        rows = [
            {"antenna": name, "positions": which, "epochs": shown.status_text(), **shown.summary()}
            for name, result in self.antennas.items()
            for which, shown in (("filter along the track", self.fusion.get(name)), ("single epochs", result))
            if shown is not None
        ]
        return html_table(rows, caption=time_span_text(next(iter(self.antennas.values())).time)) + html_list(self.notes)


def patch(result: Rows, epochs: Indices, part: Rows) -> Rows:
    """Return a result with some epochs replaced, by index; every field has the epochs on axis 0."""
    values = {}
    for item in fields(result):
        values[item.name] = array = np.array(getattr(result, item.name))
        array[epochs] = getattr(part, item.name)
    return copy_with(result, **values)
