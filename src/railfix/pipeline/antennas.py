"""Results of antennas with every intermediate value, and comparison of the two antennas of one vehicle.

Each antenna is positioned on its own trajectory, with its own offset on the vehicle. With exchanged logs, or the
vehicle turned round, both positions fit their ranges, but the front antenna appears as far behind the rear one as it
should be ahead.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Bits, Datetimes, Floats, Masks, copy_with, read_only
from railfix.core.geodesy import geodetic_from_ecef
from railfix.core.reasons import CHECK_FAILED, POSITIONED, Reason, Status
from railfix.integrity.interference import Sign
from railfix.pipeline.chunk import Chunk
from railfix.pipeline.config import Config
from railfix.pipeline.filter_result import COORDINATES, AlongTrack, SingleEpochs
from railfix.pipeline.interference_stage import with_statuses
from railfix.pipeline.level_stage import apply_verdicts
from railfix.pipeline.position_stage import Solution, satellites_rejected
from railfix.pipeline.results import AntennaResult
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.map_offset import MapOffsetLimits, beyond_threshold
from railfix.positioning.two_frequencies import Combined
from railfix.ranges.corrected import CorrectedRanges
from railfix.screens import FilteredMotion, PairedEpochs, Screened
from railfix.screens.base import on_pairs, pair_epochs
from railfix.track.track import interpolate_kilometrage
from railfix.track.trajectory import Trajectory


@lru_cache
def with_coordinates(failed_checks: str) -> Masks:
    """Return the statuses that have coordinates, by number of the status; by `Config.failed_checks`."""
    dropped = CHECK_FAILED if failed_checks == "drop" else ()
    return read_only(np.array([status in POSITIONED and status not in dropped for status in sorted(Status)]))


#: Fields of `AntennaResult` that are computed together.
_NEAREST: Final = ("conventional_arc_m", "conventional_offset_m", "conventional_chainage_m")


def reason_of_all_channels(corrected: CorrectedRanges, combined: Combined | None) -> Bits:
    """Return the reasons of all channels of the observations, shape (T, M)."""
    not_observed = ~np.isfinite(corrected.observations.code_m) * np.int64(Reason.NOT_OBSERVED)
    reason = np.asarray(not_observed | corrected.channels.left_out)
    reason[:, corrected.columns] = corrected.reason
    if corrected.second is not None and combined is not None:
        epoch, channel = np.nonzero(np.isfinite(combined.share))
        reason[epoch, corrected.second.column[epoch, channel]] = corrected.reason[epoch, channel]
    return reason


def antenna_results(
    chunk: Chunk, antennas: AntennaRows, solution: Solution, chainage_m: Floats, config: Config
) -> AntennaResult:
    """Return the result of one antenna, or of the rows of several antennas; `chainage_m` of all positions,
    shape (T,).
    """
    corrected = chunk.corrected
    obs, point, constrained = corrected.observations, solution.point, solution.fix.constrained
    has = with_coordinates(config.failed_checks)[solution.status]
    arc, chainage = np.where(has, solution.arc_m, np.nan), np.where(has, chainage_m, np.nan)
    protection = solution.protection

    def on_all_channels(values: Floats) -> Floats:
        full = np.full(obs.code_m.shape, np.nan)
        full[:, corrected.columns] = values
        return full

    def later(name: str) -> Mapping[str, Any]:
        if name in COORDINATES:
            return dict(zip(COORDINATES, geodetic_from_ecef(result.ecef_m), strict=True))
        if name in _NEAREST:
            found = antennas.each(lambda index, rows: _nearest(index.trajectory, point.ecef_m[rows]))
            return dict(zip(_NEAREST, found, strict=True))
        return {name: alone[name]()}

    alone: dict[str, Callable[[], Any]] = {
        "ecef_m": lambda: antennas.at_arc(arc),
        "kilometrage_m": lambda: antennas.each(lambda index, rows: _kilometrage(index.trajectory, chainage[rows])),
        "reason": lambda: reason_of_all_channels(corrected, chunk.combined),
        "n_rejected": lambda: satellites_rejected(corrected.channels.member, result.reason),
        "n_used": lambda: (corrected.reason == 0).sum(axis=1),
        "elevation_deg": lambda: on_all_channels(corrected.elevation_deg),
        "azimuth_deg": lambda: on_all_channels(corrected.azimuth_deg),
        "sigma_m": lambda: on_all_channels(corrected.sigma_m),
        "bound_sigma_m": lambda: on_all_channels(corrected.bound_sigma_m),
        "corrected_code_m": lambda: on_all_channels(corrected.corrected_code_m),
        "residual_m": lambda: on_all_channels(np.where(corrected.reason == 0, constrained.residual_m, np.nan)),
    }
    raim = copy_with(solution.raim, protection_level_m=np.where(has, solution.raim.protection_level_m, np.nan))
    result = AntennaResult.create(
        later, time=obs.time, satellite=obs.satellite, signal=obs.signal, status=solution.status, chainage_m=chainage,
        arc_m=arc, along_sigma_m=np.where(has, solution.along_sigma_m, np.nan), own_sigma_m=solution.own_sigma_m,
        noise_scale=solution.noise_scale, conventional_status=solution.point_status, conventional_ecef_m=point.ecef_m,
        cn0_dbhz=obs.cn0_dbhz, satellites=corrected.satellites, columns=corrected.columns, second=corrected.second,
        combined=chunk.combined, screens=chunk.screens, single_point=point, section=solution.fix.section,
        constrained=constrained, phase=solution.phase, raim=raim,
        protection=None if protection is None else apply_verdicts(protection, solution.status, has, chainage, config),
        map_offset=solution.map_offset, araim=solution.araim, clocks=corrected.channels.clocks,
        clock_offset_m=solution.ties.offset_m, clock_offset_sigma_m=solution.ties.sigma_m,
        interference=None,  # of each antenna
    )  # fmt: skip
    return result


def _kilometrage(line: Trajectory, chainage_m: Floats) -> Floats:
    """Return the kilometrage of a line at chainages, shape (T,) [m]."""
    return interpolate_kilometrage(chainage_m, line.chainage_m, line.kilometrage_m)


def _nearest(line: Trajectory, ecef_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Return arc length and distance of the nearest point of a line, and its chainage, shape (T,) each [m]."""
    arc, offset = line.nearest(ecef_m)
    return arc, offset, line.chainage_at(arc)


class PositionVerdict(NamedTuple):
    """Verdict of a screen on the positions of one antenna: suspected positions get the status."""

    name: str
    screened: Screened
    status: int


def position_verdicts(
    screens: Sequence[tuple[Any, Any]], pair: PairedEpochs | None, chainage_m: Mapping[str, Floats]
) -> dict[str, tuple[PositionVerdict, ...]]:
    """Return the verdicts of the screens of the published positions, by antenna; both antennas get the status."""
    checks: dict[str, tuple[PositionVerdict, ...]] = {}
    for screen, limits in screens:
        if pair is None:
            continue
        front, rear = chainage_m["front"][pair.front_epoch], chainage_m["rear"][pair.rear_epoch]
        verdict = screen.judge(front, rear, pair, limits)
        for name, epochs in (("front", pair.front_epoch), ("rear", pair.rear_epoch)):
            screened = on_pairs(verdict, chainage_m[name].shape, epochs, epochs)
            checks[name] = (*checks.get(name, ()), PositionVerdict(screen.name, screened, int(screen.status)))
    return checks


def filter_verdicts(
    screens: Sequence[tuple[Any, Any]], pair: PairedEpochs | None, filtered: Mapping[str, FilteredMotion]
) -> dict[str, Screened]:
    """Return the verdicts of the position screens on the filter's positions, by antenna."""
    checks: dict[str, Screened] = {}
    for screen, limits in screens:
        if pair is None:
            continue
        epochs = {"front": pair.front_epoch, "rear": pair.rear_epoch}
        front, rear = (filtered[name].take(rows) for name, rows in epochs.items())
        verdict = screen.judge_filtered(front, rear, pair, limits)
        for name, rows in epochs.items():
            checks[name] = on_pairs(verdict, filtered[name].chainage_m.shape, rows, rows)
    return checks


def filter_inputs(result: AntennaResult, off_map: Masks, limits: MapOffsetLimits) -> SingleEpochs:
    """Return the results of single epochs that the filter uses; `off_map` as in `SingleEpochs`."""
    return SingleEpochs(
        noise_scale=result.noise_scale,
        arc_m=result.arc_m,
        sigma_m=result.own_sigma_m,
        near_ecef_m=result.conventional_ecef_m,
        off_map=off_map,
        map_offset=beyond_threshold(result.map_offset, limits),
        suspicion=np.zeros(len(result), dtype=np.int8)
        if result.interference is None
        else result.interference.suspicion,
    )


def apply_wheel_sign(
    results: Mapping[str, AntennaResult], fusion: Mapping[str, AlongTrack]
) -> dict[str, AntennaResult]:
    """Return the results of single epochs with the sign of the wheel, which the filter along the track gives."""
    after = dict(results)
    for name, tracked in fusion.items():
        result, wheel = results[name], tracked.wheel
        found = result.interference
        if wheel is None or found is None or not wheel.parted.any():
            continue
        found = replace(found, causes=np.where(wheel.parted, found.causes | int(Sign.WHEEL_PARTS), found.causes))
        status = with_statuses(result.status, [found.suspicion])
        after[name] = copy_with(result, interference=found, status=status)
    return after


#: Pairs of positions within this distance along the line share their reflections, and count as one sample [m].
_STRETCH_M: Final = 50.0
#: Stretches before there is a verdict: a train at rest has too few.
_LEAST_STRETCHES: Final = 4
#: Sigmas by which the distance must be below zero.
_CERTAIN: Final = 5.0
#: Antennas nearer to each other than this have no order [m].
_LEAST_DISTANCE_M: Final = 0.5


class AntennaOrder:
    """Mean distance of the front antenna ahead of the rear one of a vehicle on one track, as the positions have it.

    `distance_m` is that by the vehicle file [m], in the direction that the vehicle faces; tags of a pair of epochs
    differ by `tolerance_s` at most.
    """

    def __init__(self, front: Trajectory, rear: Trajectory, *, tolerance_s: float) -> None:
        paths = front, rear
        begin, end = (float(of([float(t.body_at(t.arc_m[k])) for t in paths])) for of, k in ((max, 0), (min, -1)))
        arcs = [t.arc_of_body(np.linspace(begin, end, 21)[1:-1]) for t in paths]
        along = front.at_arc(arcs[0]) - rear.at_arc(arcs[1])
        ahead = front.at_arc(arcs[0] + 1.0) - front.at_arc(arcs[0])
        rising = float(np.median(np.einsum("ni,ni->n", along, ahead)))
        apart = float(np.median(front.chainage_at(arcs[0]) - rear.chainage_at(arcs[1])))
        self._facing = front.front_sign
        self.distance_m = self._facing * rising
        self._reference_m = apart - rising  # chainages may refer to a point of the vehicle
        self._tolerance_s = tolerance_s
        #: Per stretch of line: pairs, sum of their distances [m], sum of their variances [m^2].
        self._stretches: dict[int, tuple[float, float, float]] = {}

    def add(self, front: tuple[Datetimes, ArrayLike, ArrayLike], rear: tuple[Datetimes, ArrayLike, ArrayLike]) -> bool:
        """Add the positions of more epochs; return whether the train is on a new stretch.

        For each antenna time tags, chainage [m] and its sigma [m], shape (F,) and (R,); NaN without a position.
        """
        at_front, at_rear = pair_epochs(front[0], rear[0], tolerance_s=self._tolerance_s)
        (place, other), (sigma, other_sigma) = (
            (np.asarray(front[k], dtype=np.float64)[at_front], np.asarray(rear[k], dtype=np.float64)[at_rear])
            for k in (1, 2)
        )
        measured = self._facing * (place - other - self._reference_m)
        variance = sigma**2 + other_sigma**2
        known = np.isfinite(measured) & np.isfinite(variance)
        # a gross error counts as no more than the distance of logs that are neither right nor exchanged
        bound = 3.0 * abs(self.distance_m)
        measured, variance = np.clip(measured[known], -bound, bound), variance[known]
        stretch, which = np.unique(np.floor(place[known] / _STRETCH_M).astype(np.int64), return_inverse=True)
        seen = len(self._stretches)
        sums = (np.bincount(which, weights=part) for part in (np.ones(len(which)), measured, variance))
        for key, *more in zip(stretch.tolist(), *(part.tolist() for part in sums), strict=True):
            before = self._stretches.get(key, (0.0, 0.0, 0.0))
            self._stretches[key] = (before[0] + more[0], before[1] + more[1], before[2] + more[2])
        return len(self._stretches) > seen

    def measure(self) -> tuple[float, float]:
        """Return the mean distance of the front antenna ahead of the rear one, and its sigma [m]; NaN before a verdict.

        The mean distance of a stretch has the variance of a single pair, as its disturbances do not average out; where
        the stretches scatter more than that, the sigma grows.
        """
        if len(self._stretches) < _LEAST_STRETCHES:
            return float("nan"), float("nan")
        count, distance, variance = np.array(list(self._stretches.values())).T
        mean, weight = distance / count, count / variance
        overall = float(np.average(mean, weights=weight))
        scatter = float(np.sum(weight * (mean - overall) ** 2)) / (len(mean) - 1)
        return overall, float(np.sqrt(max(1.0, scatter) / weight.sum()))

    @property
    def note(self) -> str | None:
        """Sentence on antennas in the wrong order; None where their order is right, or not certain."""
        mean, sigma = self.measure()
        right = abs(self.distance_m)
        ahead = float(np.sign(self.distance_m)) * mean
        exchanged = right >= _LEAST_DISTANCE_M and -2.0 * right < ahead < -_CERTAIN * sigma
        if not exchanged:
            return None
        first, second = ("front", "rear") if self.distance_m > 0.0 else ("rear", "front")
        return (
            f"the positions of the {first} log are {-ahead:.1f} m (sigma {sigma:.1f} m) behind those of the {second} "
            f"log, and the vehicle file has them {right:.1f} m ahead: the logs are exchanged (--front, --rear), or the "
            "vehicle faces the other way (facing)"
        )
