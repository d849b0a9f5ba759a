"""Results of the pipeline with every intermediate value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from railfix.core.arrays import Bits, Codes, Datetimes, Floats, Indices, Integers, Strings
from railfix.core.epoch_rows import OnDemand
from railfix.core.reasons import Status
from railfix.core.tables import NotebookTable, html_list, html_table, median_text, plural, time_span_text
from railfix.gnss.orbits import SatelliteStates
from railfix.integrity.fault_exclusion import RaimResult
from railfix.integrity.protection.araim import AraimResult
from railfix.pipeline.filter_result import AlongTrack
from railfix.pipeline.interference_stage import Interference
from railfix.pipeline.level_stage import ProtectionResult
from railfix.positioning.carrier import PhasePositions
from railfix.positioning.map_offset import MapOffset
from railfix.positioning.normal_equations import Constrained, SinglePoint
from railfix.positioning.section_search import Section
from railfix.positioning.two_frequencies import Combined
from railfix.ranges.second_codes import SecondCodes
from railfix.screens import Screened


@dataclass(frozen=True, kw_only=True)
class AntennaResult(NotebookTable, OnDemand):
    """Results of one antenna, T epochs by M channels.

    The channels are those of the given observations, of all antennas where few epochs of several are given together.
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
    #: itself; satellites and atmosphere; the map error; and the distance to another possible position, by its
    #: probability; shape (T,).
    along_sigma_m: Floats
    #: Single-epoch sigma: standard deviation along the line from the codes of the epoch alone, with the larger of the
    #: receiver's noise and the noise of these residuals, widened by Student's t where few ranges are redundant. Also
    #: given where the position is dropped; shape (T,).
    own_sigma_m: Floats
    #: Ratio of this receiver's standard deviation to that of the weights: root mean square of the ranges that RAIM
    #: accepted in earlier epochs, with forgetting; shape (T,).
    noise_scale: Floats
    ecef_m: Floats  #: Antenna; shape (T, 3).
    #: Shape (T,).
    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats
    #: Satellites used; satellites with a code that were not used; shape (T,).
    n_used: Integers
    n_rejected: Integers
    #: `railfix.integrity.PointStatus` of the conventional position, which is kept as it is; shape (T,).
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
    satellites: SatelliteStates  #: Frequencies of the channels in `columns`.
    columns: Indices  #: Channels that settings allow, in the order of the intermediate results below; shape (K,).
    second: SecondCodes | None  #: Second codes of satellites, where two frequencies are used; shape (T, K).
    combined: Combined | None  #: How they were combined with the first.
    #: Metric and verdict of each screen that was on, by name, shape (T, K); "antenna_spacing", which judges positions,
    #: has shape (T,).
    screens: Mapping[str, Screened]
    single_point: SinglePoint  #: The conventional position: every constellation with a separate clock.
    section: Section
    constrained: Constrained  #: Position on the line.
    #: Positions from code and phase, where ``Config.carrier`` is "float"; the coordinates are theirs.
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
    notes: tuple[str, ...]  #: Differences between the requested and the used data, one sentence each.
    #: Positions of the filter along the track, by antenna; empty where it is off.
    fusion: Mapping[str, AlongTrack] = field(default_factory=dict)

    def __getitem__(self, antenna: str) -> AntennaResult:
        """Return the single-epoch results of an antenna; KeyError where no antenna has that name."""
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
