"""Results of the pipeline: stage outputs by antenna, and values for the tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from railfix.core.arrays import Bits, Datetimes, Floats, Indices, Integers, Strings, copy_with
from railfix.core.epoch_rows import take_epochs
from railfix.core.notebook import NotebookTable, html_list, html_table, median_text, plural, time_span_text
from railfix.core.reasons import Reason, Status
from railfix.integrity.interference import Sign, WheelSigns
from railfix.pipeline.chunk import Chunk
from railfix.pipeline.config import Config
from railfix.pipeline.coordinates import LineCoordinates
from railfix.pipeline.filter_result import AlongTrack, Replay
from railfix.pipeline.interference_stage import Interference, with_statuses
from railfix.pipeline.level_stage import apply_verdicts
from railfix.pipeline.solution import Solution, with_coordinates
from railfix.positioning.two_frequencies import Combined
from railfix.ranges.corrected import CorrectedRanges
from railfix.screens import Screened
from railfix.track.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class AntennaResult(Solution, LineCoordinates, NotebookTable):
    """Positions and intermediate results of one antenna at T epochs.

    Arrays of `corrected` have the K channels that the settings allow. Properties of the class have M channels: all
    observed channels of all antennas that were processed together.
    """

    trajectory: Trajectory  #: Trajectory of the antenna.
    corrected: CorrectedRanges  #: Corrected ranges with all rejection reasons.
    combined: Combined | None  #: Combined codes of two frequencies; None with one frequency.
    #: Metric and verdict of each active screen, by name, shape (T, K); "antenna_spacing", a position screen, has shape
    #: (T,).
    screens: Mapping[str, Screened]
    interference: Interference | None  #: Suspected jamming and spoofing; None if the check is off.

    @property
    def time(self) -> Datetimes:
        """Time tags, shape (T,)."""
        return self.corrected.time

    @property
    def satellite(self) -> Strings:
        """Satellite of each channel, shape (M,)."""
        return self.corrected.observations.satellite

    @property
    def signal(self) -> Strings:
        """Signal of each channel, shape (M,)."""
        return self.corrected.observations.signal

    @property
    def columns(self) -> Indices:
        """Indices of the channels that the settings allow, in the order of `corrected`, shape (K,)."""
        return self.corrected.columns

    @property
    def cn0_dbhz(self) -> Floats:
        """Carrier-to-noise density, shape (T, M)."""
        return self.corrected.observations.cn0_dbhz

    @cached_property
    def reason(self) -> Bits:
        """`reasons.Reason` bits, 0 = used, shape (T, M)."""
        corrected, second = self.corrected, self.corrected.second
        not_observed = ~np.isfinite(corrected.observations.code_m) * np.int64(Reason.NOT_OBSERVED)
        reason = np.asarray(not_observed | corrected.channels.left_out)
        reason[:, corrected.columns] = corrected.reason
        if second is not None and self.combined is not None:
            epoch, channel = np.nonzero(np.isfinite(self.combined.share))
            reason[epoch, second.column[epoch, channel]] = corrected.reason[epoch, channel]
        return reason

    @property
    def n_used(self) -> Integers:
        """Number of satellites used, shape (T,)."""
        return np.asarray((self.corrected.reason == 0).sum(axis=1))

    @property
    def n_rejected(self) -> Integers:
        """Number of satellites with a code but no used signal, shape (T,)."""
        of_satellite = self.corrected.channels.member.astype(np.float32)  # floats, as their matrix product is faster
        seen = ((self.reason & Reason.NOT_OBSERVED) == 0).astype(np.float32) @ of_satellite > 0
        used = (self.reason == 0).astype(np.float32) @ of_satellite > 0
        return np.asarray((seen & ~used).sum(axis=1), dtype=np.int64)

    def on_all_channels(self, values: Floats | float) -> Floats:
        """Return `values` of the K allowed channels as an array of all channels, shape (T, M), NaN elsewhere."""
        full = np.full(self.corrected.observations.code_m.shape, np.nan)
        full[:, self.corrected.columns] = values
        return full

    @property
    def elevation_deg(self) -> Floats:
        """Elevation of the satellites, NaN where unknown, shape (T, M)."""
        return self.on_all_channels(self.corrected.elevation_deg)

    @property
    def azimuth_deg(self) -> Floats:
        """Azimuth of the satellites, NaN where unknown, shape (T, M)."""
        return self.on_all_channels(self.corrected.azimuth_deg)

    @property
    def sigma_m(self) -> Floats:
        """Standard deviation of each range, shape (T, M)."""
        return self.on_all_channels(self.corrected.sigma_m)

    @property
    def bound_sigma_m(self) -> Floats:
        """Minimum range sigmas of the protection level, from the error model (0 without one), shape (T, M)."""
        return self.on_all_channels(self.corrected.bound_sigma_m)

    @property
    def corrected_code_m(self) -> Floats:
        """Corrected pseudoranges, NaN where unknown, shape (T, M)."""
        return self.on_all_channels(self.corrected.corrected_code_m)

    @property
    def residual_m(self) -> Floats:
        """Residuals of the ranges at the position on the line, NaN for unused ranges, shape (T, M)."""
        residual = self.fix.constrained.residual_m
        return self.on_all_channels(np.where(self.corrected.reason == 0, residual, np.nan))

    @cached_property
    def _nearest(self) -> tuple[Floats, Floats]:
        return self.trajectory.nearest(self.point.ecef_m)

    @property
    def conventional_arc_m(self) -> Floats:
        """Arc length of the trajectory point nearest to the conventional 3-D position, shape (T,)."""
        return self._nearest[0]

    @property
    def conventional_offset_m(self) -> Floats:
        """Distance of the conventional 3-D position from the trajectory, shape (T,) [m]."""
        return self._nearest[1]

    @property
    def conventional_chainage_m(self) -> Floats:
        """Chainage of the trajectory point nearest to the conventional 3-D position, shape (T,) [m]."""
        return self.trajectory.chainage_at(self.conventional_arc_m)

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        return f"<AntennaResult: {self.status_text()}, {time_span_text(self.time)}>"

    def status_text(self) -> str:
        """Return the number of epochs with the status OK as text: ``1,827 of 2,000 epochs ok``."""
        return f"{int((self.status == Status.OK).sum()):,} of {plural(self, 'epoch')} ok"

    def summary(self) -> dict[str, str]:
        """Return the medians of sigma and protection level in metres, as strings."""
        level = np.empty(0) if self.protection is None else self.protection.level.level_m
        return {"median sigma [m]": median_text(self.along_sigma_m), "median level [m]": median_text(level)}


def antenna_results(chunk: Chunk, fusion: Mapping[str, AlongTrack], config: Config) -> dict[str, AntennaResult]:
    """Return the single-epoch results by antenna; positions are NaN at epochs whose final status requires it.

    If the filter along the track is on, its comparison with wheel distances can add a sign of interference.
    """
    results = {}
    for k, (name, rows) in enumerate(chunk.rows.items()):
        assert chunk.solution is not None, "positions come before results"
        solution, interference = take_epochs(chunk.solution, rows), chunk.interference[k]
        wheel = fusion[name].wheel if name in fusion else None
        if wheel is not None and interference is not None:
            solution, interference = add_wheel_sign(solution, interference, wheel)
        trajectory = chunk.antennas.indices[k].trajectory
        has = with_coordinates(config.failed_checks)[solution.status]
        arc, protection, raim = np.where(has, solution.arc_m, np.nan), solution.protection, solution.raim
        if protection is not None:
            protection = apply_verdicts(protection, solution.status, has, trajectory.chainage_at(arc), config)
        solution = copy_with(
            solution, arc_m=arc, along_sigma_m=np.where(has, solution.along_sigma_m, np.nan), protection=protection,
            raim=copy_with(raim, protection_level_m=np.where(has, raim.protection_level_m, np.nan)),
        )  # fmt: skip
        screens = {key: take_epochs(screened, rows) for key, screened in chunk.screens.items()}
        results[name] = AntennaResult(
            **vars(solution), trajectory=trajectory, corrected=take_epochs(chunk.corrected, rows),
            combined=take_epochs(chunk.combined, rows), screens={**screens, **chunk.judged[name]},
            interference=interference,
        )  # fmt: skip
    return results


def add_wheel_sign(solution: Solution, interference: Interference, wheel: WheelSigns) -> tuple[Solution, Interference]:
    """Return positions and interference, with a sign of interference where GNSS and wheel distances differ."""
    causes = np.where(wheel.parted, interference.causes | int(Sign.WHEEL_PARTS), interference.causes)
    interference = replace(interference, causes=causes)
    status = with_statuses(solution.status, [interference.suspicion])
    return copy_with(solution, status=np.where(wheel.parted, status, solution.status)), interference


@dataclass(frozen=True, kw_only=True)
class Result(NotebookTable):
    """Results of one chunk."""

    antennas: Mapping[str, AntennaResult]
    notes: tuple[str, ...]  #: One sentence on each difference between requested and used data.
    #: Filtered positions by antenna; empty if the filter is off.
    fusion: Mapping[str, AlongTrack] = field(default_factory=dict)
    #: Filter input by antenna, for smoothing (`railfix.pipeline.smoothed_track`).
    replays: Mapping[str, tuple[Replay, ...]] = field(default_factory=dict)

    def __getitem__(self, antenna: str) -> AntennaResult:
        """Return the single-epoch results of an antenna; KeyError for an unknown name."""
        return self.antennas[antenna]

    def doubts(self) -> Iterator[str]:
        """Yield a sentence on each antenna without positions, or with positions that contradict the map."""
        for name, result in self.antennas.items():
            observed = result.status != Status.NO_OBSERVATION
            off = np.isin(result.status, (Status.OFF_MAP, Status.MAP_OFFSET))
            if observed.any() and not np.isfinite(result.point.ecef_m).any():
                lost = (result.reason & (Reason.NO_EPHEMERIS | Reason.EPHEMERIS_TOO_OLD)) != 0
                cause = (
                    "no navigation record is valid at the time of the log; are the records of another day?"
                    if lost.any()
                    else "see its reasons"
                )
                yield f"{name}: no epoch has a position: {cause}"
            elif 2 * np.count_nonzero(off) > np.count_nonzero(observed):
                yield f"{name}: most positions contradict the map; was the log recorded on this track?"

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
