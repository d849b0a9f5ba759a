"""Results of the filter along the track, its input from single epochs, and its state."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from railfix.core.arrays import Codes, Datetimes, Floats, Masks
from railfix.core.notebook import NotebookTable, median_text, plural, time_span_text
from railfix.core.timescale import seconds
from railfix.integrity.interference import WheelSigns, WheelState
from railfix.kernels.tracking import index as ix
from railfix.pipeline.balises import Passing, PassingState
from railfix.pipeline.coordinates import LineCoordinates
from railfix.pipeline.outage_gate import ReturnState
from railfix.pipeline.sensed_motion import SensedMotion
from railfix.pipeline.sensor_epochs import SensorState
from railfix.positioning.carrier import CycleSlipState
from railfix.screens import FilteredMotion
from railfix.track.trajectory import Trajectory
from railfix.tracking import GnssEpochs, SensorEpochs, Tracked, TrackState
from railfix.tracking.levels import LevelState
from railfix.tracking.result import is_bounded


@dataclass(frozen=True, kw_only=True)
class FilterFix:
    """Filter position at an epoch; dead reckoning by the wheel restarts from such a position every few seconds."""

    time: np.datetime64
    #: Arc length; NaN if the filter has no unique position.
    arc_m: float
    sigma_m: float
    speed_mps: float

    def arc_at(self, time: np.datetime64) -> float:
        """Return the arc length at a nearby time, by extrapolation with the speed [m]."""
        return self.arc_m + self.speed_mps * float(seconds(time - self.time))


@dataclass(frozen=True, kw_only=True)
class SingleEpochs:
    """Results of single epochs that the filter along the track uses, shape (T,) each."""

    noise_scale: Floats  #: Ratio of the receiver's code noise to its range sigmas.
    #: Single-epoch positions. After an outage, codes are used again once these positions agree with dead reckoning.
    arc_m: Floats
    sigma_m: Floats
    near_ecef_m: Floats  #: 3-D position, not constrained to the line, shape (T, 3).
    off_map: Masks  #: True where the train is away from the line (`railfix.pipeline.off_map`).
    map_offset: Masks  #: True where the mean 3-D position of the last minutes is beside, above or below the line.
    suspicion: Codes  #: `railfix.integrity.interference.Suspicion`.
    tilt_scale: Floats | None = None  #: `railfix.tracking.GnssEpochs.tilt_scale`.


@dataclass(frozen=True, kw_only=True)
class FilterState(NotebookTable):
    """Filter state of one antenna after a chunk."""

    slips: CycleSlipState | None = None  #: State of the cycle-slip detection.
    track: TrackState | None = None
    level: LevelState = field(default_factory=LevelState)  #: State of the filter that computes the levels.
    sensors: SensorState = field(default_factory=SensorState.empty)
    fixed: FilterFix | None = None  #: Filter position at the last epoch; None before the first.
    anchor: FilterFix | None = None  #: Filter position before the current block of epochs; None before the first.
    gate: ReturnState = field(default_factory=ReturnState)
    #: State of the comparison of wheel distances with distances between single-epoch positions.
    wheel: WheelState = field(default_factory=WheelState)
    #: State of the comparison of wheel distances with distances between filter positions.
    filter_wheel: WheelState = field(default_factory=WheelState)
    #: Last epoch at which positions or speeds of the two antennas were inconsistent.
    disagreed: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    passings: PassingState | None = None  #: State of the search for passings of balises and virtual balises.

    def __repr__(self) -> str:
        if self.track is None or not self.track.hypotheses:
            return "<FilterState: no position yet>"
        return f"<FilterState: {plural(self.track.hypotheses, 'place')}, the most probable at {self._place()} m>"

    def _place(self) -> str:
        """Return the most probable position with its standard deviation."""
        track = self.track
        if track is None:
            return ""
        best = int(np.argmax(track.hypothesis["log_probability"]))
        place, variance = track.mean[best, ix.ARC], track.covariance[best, ix.ARC, ix.ARC]
        return f"{place:,.1f} ± {np.sqrt(variance):.1f}"


@dataclass(frozen=True, kw_only=True)
class AlongTrack(LineCoordinates, NotebookTable):
    """Filtered positions of one antenna at T epochs."""

    tracked: Tracked  #: Output of the filter, for the channels in `AntennaResult.corrected`.
    trajectory: Trajectory  #: Trajectory of the antenna.
    #: Positions on the trajectory, shape (T,). Positions slightly beyond an end are moved to the end; positions farther
    #: out are NaN.
    arc_m: Floats
    #: Direction: 1 toward rising chainage, -1 toward falling chainage, 0 if the speed is too small; shape (T,).
    direction: Codes
    standstill: Masks  #: True where the speed plus two sigmas is below 1 km/h; shape (T,).
    #: Motion since the previous epoch, and shape of the line under the body, measured by wheel and inertial unit.
    sensed: SensedMotion
    #: Distance between the antennas' positions minus the antenna spacing; NaN if they are not compared; shape (T,).
    spacing_error_m: Floats
    #: Comparison of satellite-derived distances with wheel distances; None without wheel distances.
    wheel: WheelSigns | None = None
    passings: tuple[Passing, ...] = ()  #: Passed balises and virtual balises, and wrong readings.

    @property
    def time(self) -> Datetimes:
        """Time tags, shape (T,)."""
        return self.tracked.time

    @property
    def motion(self) -> FilteredMotion:
        """Positions and speeds, for the comparison with another antenna."""
        found = self.tracked
        return FilteredMotion(self.chainage_m, found.sigma_m, found.speed_mps, found.speed_sigma_mps)

    def __len__(self) -> int:
        return len(self.tracked)

    def __repr__(self) -> str:
        return f"<AlongTrack: {self.status_text()}, {time_span_text(self.time)}>"

    def status_text(self) -> str:
        """Return the number of epochs with a bounded error: ``1,890 of 2,000 epochs tracking or coasting``."""
        return f"{int(is_bounded(self.tracked.status).sum()):,} of {plural(self, 'epoch')} tracking or coasting"

    def summary(self) -> dict[str, str]:
        """Return the medians of sigma and protection level in metres, as strings."""
        tracked = self.tracked
        return {"median sigma [m]": median_text(tracked.sigma_m), "median level [m]": median_text(tracked.level_m)}


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Filter input for consecutive epochs of a run."""

    epochs: GnssEpochs
    sensors: SensorEpochs
    before: TrackState | None  #: Filter state before the epochs; None at the start.


@dataclass(frozen=True, kw_only=True, repr=False)
class SmoothedTrack(NotebookTable):
    """Positions of T epochs, each from all measurements of the run."""

    time: Datetimes  #: Time tags, shape (T,).
    arc_m: Floats  #: Arc length, shape (T,).
    sigma_m: Floats  #: Standard deviation of the arc length, shape (T,).
    speed_mps: Floats  #: Speed along the line, shape (T,).
