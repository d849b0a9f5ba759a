"""Runs of a survey: positions of one receiver, and the observations from which they were computed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, FrozenArrays, Indices, Masks, freeze_arrays
from railfix.core.options import option
from railfix.core.settings import Settings
from railfix.core.timescale import seconds
from railfix.io.position_log import PositionLog
from railfix.track.map_from_positions import SIGMA_OF_QUALITY

#: For each RTKLIB quality number, standard deviations in plan and height of the error that is common to all positions
#: of a run [m]. Orbits, ionosphere and reference frame cause this error. Averaging over the run does not reduce it.
COMMON_SIGMA_OF_QUALITY: Final[Mapping[int, tuple[float, float]]] = MappingProxyType(
    {1: (0.02, 0.04), 2: (0.2, 0.4), 3: (0.5, 1.0), 4: (0.3, 0.6), 5: (1.0, 2.0)}
)
_UNKNOWN_QUALITY: Final = 5
#: Standard deviation of the change of vertical velocity in one second [m/s]; it is 0.02 to 0.07 m/s for road vehicles.
CLIMB_MPS2: Final = 0.05


class SurveyLimits(Settings):
    """Assumptions of a survey."""

    interval_s: float = Field(default=1.0, gt=0)  #: Minimum time between two positions; denser logs are thinned.
    #: Correlation time of position errors.
    correlation_s: float = Field(default=30.0, ge=0)
    correlation_m: float = Field(default=50.0, ge=0)  #: Correlation length of position errors along the path.
    #: Standard deviation, per horizontal axis, of the change of velocity in one second. For three road vehicles, it was
    #: 1.2 to 1.8 m/s, computed from changes over 5 s, which is about the duration of curves and of braking.
    acceleration_mps2: float = Field(default=1.5, gt=0)
    freedom: float = Field(default=3.0, gt=0)  #: Degrees of freedom of Student's t, which down-weights outliers.
    same_line_m: float = option(
        "Passes closer to each other than this distance, in the same or the opposite direction, count as one line.",
        20.0,
        name="--same-line",
        metavar="M",
        gt=0,
    )
    apart_m: float = option(
        "Standard deviation of the distance of a pass from the line, including the offset between antennas at "
        "different positions on the vehicle.",
        0.5,
        name="--apart",
        metavar="M",
        gt=0,
    )
    spacing_m: float = option(
        "Distance between the points of the map.", 5.0, name="--spacing", metavar="M", gt=0, le=100.0
    )


@dataclass(frozen=True, kw_only=True)
class RunSignals(FrozenArrays):
    """Observations of a run: M pseudoranges, and C range changes between successive rows."""

    row: Indices  #: Row of the run at which each pseudorange was measured, shape (M,).
    sat_ecef_m: Floats  #: Position of the satellite at transmission, shape (M, 3).
    code_m: Floats  #: Corrected pseudorange, shape (M,).
    sigma_m: Floats  #: Standard deviation of the pseudorange, shape (M,).
    clock: Indices  #: Group of constellations with one clock offset, numbered from 0, shape (M,).
    step: Indices  #: Row at which each range change begins; it ends at the next row; shape (C,).
    before_ecef_m: Floats  #: Satellite position at transmission, for the first row of the range change, shape (C, 3).
    after_ecef_m: Floats  #: Satellite position at transmission, for the last row of the range change, shape (C, 3).
    change_m: Floats  #: Change of the range, from carrier phases or Dopplers, shape (C,).
    change_sigma_m: Floats  #: Standard deviation of the range change, shape (C,).
    by_doppler: Masks  #: Whether the range change was computed from Dopplers, shape (C,).


@dataclass(frozen=True, kw_only=True)
class SurveyRun(FrozenArrays):
    """Positions of one antenna in one run, n rows in order of time."""

    name: str
    time: Datetimes  #: Times of the rows, strictly rising, shape (n,).
    ecef_m: Floats  #: Positions, shape (n, 3); NaN without a position.
    sigma_m: Floats  #: Standard deviations of the positions, east, north and up, shape (n, 3).
    #: Observations from which the positions were computed. If given, they are adjusted instead of the positions.
    signals: RunSignals | None = None
    #: Standard deviations in plan and height of the error that is common to all positions of the run.
    common_sigma_m: tuple[float, float] = COMMON_SIGMA_OF_QUALITY[_UNKNOWN_QUALITY]

    def __post_init__(self) -> None:
        shape = (len(self.time), 3)
        for name in ("ecef_m", "sigma_m"):
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has shape {getattr(self, name).shape}, expected {shape}")
        freeze_arrays(self)
        if not (np.diff(self.time) > np.timedelta64(0, "ns")).all():
            raise ValueError("time must rise strictly")

    def __len__(self) -> int:
        return len(self.time)

    @property
    def seconds(self) -> Floats:
        """Time since the first row, shape (n,) [s]."""
        return seconds(self.time - self.time[0])


def run_of_log(log: PositionLog, limits: SurveyLimits) -> SurveyRun:
    """Convert a position log to a run of a survey.

    The positions are sorted and thinned to `limits.interval_s`. Sigmas below a third of `SIGMA_OF_QUALITY` are
    increased to this third. Raise ValueError if fewer than three positions remain.
    """
    rows = np.flatnonzero(np.isfinite(log.ecef_m).all(axis=1) & ~np.isnat(log.time))
    rows = rows[np.argsort(log.time[rows], kind="stable")]
    rows = rows[rows_apart(log.time[rows], limits.interval_s)]
    if len(rows) < 3:
        raise ValueError(f"{len(rows)} positions with a time; a run of a survey needs three")
    quality = np.where(log.quality[rows] >= 1, log.quality[rows], _UNKNOWN_QUALITY)
    usual = np.array([SIGMA_OF_QUALITY.get(int(q), SIGMA_OF_QUALITY[_UNKNOWN_QUALITY]) for q in quality])[:, [0, 0, 1]]
    stated = log.sigma_m[rows][:, [1, 0, 2]]
    common = [COMMON_SIGMA_OF_QUALITY.get(int(q), COMMON_SIGMA_OF_QUALITY[_UNKNOWN_QUALITY]) for q in quality]
    plan, height = np.median(np.array(common), axis=0)
    return SurveyRun(
        name=log.path,
        time=log.time[rows],
        ecef_m=log.ecef_m[rows],
        sigma_m=np.where(np.isfinite(stated), np.maximum(stated, usual / 3.0), usual),
        common_sigma_m=(float(plan), float(height)),
    )


def rows_apart(time: Datetimes, interval_s: float) -> Indices:
    """Return the indices of rows at least an interval apart, with a tolerance of a twentieth of the interval."""
    since = seconds(time - time[0]) if len(time) else np.zeros(0)
    kept: list[int] = []
    for k, at in enumerate(since.tolist()):
        if not kept or at - since[kept[-1]] >= 0.95 * interval_s:
            kept.append(k)
    return np.array(kept, dtype=np.intp)
