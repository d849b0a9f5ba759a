"""Arrays of the recursion: records, with the shapes and units of the fields, and the tuples that group the arrays.

numpy records name the fields of an epoch, a channel, a sensor and a vertex. The records of settings, of the state's
scalars and of results are defined by `railfix.tracking.limits.TrackingLimits`, `railfix.tracking.state.Monitors` and
`railfix.tracking.result.Tracked`.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks

#: Array of records; their fields are defined below.
Records: TypeAlias = Any
Record: TypeAlias = Any


def record_of(fields: dict[str, Any]) -> np.dtype[Any]:
    """Return a record type with named fields; each field has a type, or a type and an array shape."""
    listed = [(name, *kind) if isinstance(kind, tuple) else (name, kind) for name, kind in fields.items()]
    return np.dtype((np.record, np.dtype(listed, align=True)))


#: One epoch.
EPOCH: Final = record_of({
    "time_s": float,  # since `TrackState.origin` [s]
    "interval_s": float,  # since the previous epoch [s]
    "begins": bool,  # the state restarts before this epoch
    "coded": bool,  # a satellite has codes
    "tilt_scale": float,  # error of the ionospheric model relative to a quiet ionosphere; 0 without this error
    "motion_measured": bool,  # phases or Dopplers of at least four satellites, enough to propagate the position
    "velocity_mps": (float, (3,)),  # ECEF, from phases or Dopplers without the line [m/s]; NaN if unknown
    "velocity_covariance": (float, (3, 3)),  # [m2/s2]
    "velocity_age_s": float,  # age of the velocity at the epoch [s]
    "step": (float, (3, 3)),  # transition of arc length, speed and acceleration (R. A. Singer, 1970)
    "noise": (float, (3, 3)),  # process noise of these three [m, m/s, m/s2 squared]
})  # fmt: skip
#: One channel at one epoch: measurements of one satellite.
CHANNEL: Final = record_of({
    "satellite": np.intp,  # index of the satellite, its code error and its sub-filter; -1 if never measured
    "clock": np.intp,  # index of the satellite's code clock in `CLOCKS`
    "sat_ecef_m": (float, (3,)),  # at the time of transmission [m]
    "sat_velocity_mps": (float, (3,)),  # [m/s]
    "before_ecef_m": (float, (3,)),  # at the previous epoch [m]
    "measured": (float, (3,)),  # corrected code [m], phase change since the previous epoch [m], range rate [m/s]
    "has": (np.int8, (3,)),  # 1 where `measured` is usable
    "variance": (float, (3,)),  # white errors before the adapted scales; codes over one second [m2, m2, m2/s2]
    "code_sigma_m": float,  # standard deviation of the correlated code error; the unknown is in units of it [m]
})  # fmt: skip
#: One sensor at one epoch.
SENSOR: Final = record_of({
    "value": float,  # distance [m], force [m/s2], position [m] or range [m]; NaN without a measurement
    "sigma": float,  # standard deviation of `value`, in the same unit
    "age_s": float,  # age at the epoch [s]; positions, balises, ranges
    "unsigned": bool,  # whether `value` is a distance without a sign, which gets the sign of the speed
    "unit_ecef_m": (float, (3,)),  # ground unit of a range [m]
    "lever_m": (float, (3,)),  # from the trajectory's point to the vehicle's unit: along, right, up [m]
})  # fmt: skip
#: One vertex of the line, and the segment after it.
VERTEX: Final = record_of({
    "arc_m": float,  # [m]
    "ecef_m": (float, (3,)),  # [m]
    "axes": (float, (3, 3)),  # tangent, right, up
    "segment": (float, (3,)),  # unit vector of the segment
    "middle_m": float,  # arc length of the segment's middle [m]
    "gradient": float,  # climb over horizontal length of the segment
})  # fmt: skip
#: The line as a whole.
LINE: Final = record_of({
    "sigma_plan_m": float,  # standard deviation of the map across [m]
    "sigma_height_m": float,  # standard deviation of the map's heights [m]
    "tilt_m": float,  # standard deviation of the displacement along the line by a tilted ionosphere [m]
    "start_m": float,  # open ends; infinite where closed [m]
    "end_m": float,
    "start_turn_m": float,  # lap length beyond the start or the end, 0 where open [m]
    "end_turn_m": float,
})  # fmt: skip
#: One source of faults, with the sub-filter that excludes it.
SOURCE: Final = record_of({
    "running": bool,  # whether the sub-filter exists
    "contradicted_s": float,  # time for which measurements have contradicted the sub-filter [s]
    "prior": float,  # probability of a fault; with 0 there is no sub-filter
    "k": float,  # normal quantile of the risk over that probability
    "k_speed": float,  # the same quantile for the speed
    "clock": np.intp,  # index of a satellite's code clock in `CLOCKS`; 0 for other sources
})  # fmt: skip


class Given(NamedTuple):
    """Inputs of the recursion, for T epochs, K channels, C sensors, S satellites, V vertices and N unknowns."""

    epoch: Records  #: `EPOCH`; shape (T,).
    channel: Records  #: `CHANNEL`; shape (T, K).
    sensor: Records  #: `SENSOR`; shape (T, C).
    fresh: Masks  #: Satellites whose code error begins at an epoch; shape (T, S).
    within_memory: Masks  #: Satellites whose code error continues from before an epoch; shape (T, S).
    vertex: Records  #: `VERTEX`; shape (V,).
    line: Records  #: `LINE`; shape (1,).
    parameters: Records  #: Fields of `TrackingLimits` and the risk budget of the level; shape (1,).
    start_variance: Floats  #: Variance of each unknown before any measurement; shape (N,).


class State(NamedTuple):
    """State of the recursion, changed in place, with the Gaussians of H hypotheses and B sub-filters."""

    x: Floats  #: Means, hypotheses first, in the units of `index.py`; shape (H + B, N).
    P: Floats  #: Covariances, in products of these units; shape (H + B, N, N).
    hypothesis: Records  #: `railfix.tracking.state.HYPOTHESIS`; shape (H,).
    monitors: Records  #: `railfix.tracking.state.Monitors`; shape (1,).
    code_bias: Floats  #: Mean normalised innovation of each satellite's codes, no unit; shape (S,).
    offset_known: Masks  #: Code clocks that have been observed so far; shape (CLOCK_COUNT,).
    source: Records  #: `SOURCE`: satellites, clocks, sensors, others; shape (B,), 0 where levels are off.


class Results(NamedTuple):
    """Results of the recursion, epoch by epoch."""

    epoch: Records  #: `railfix.tracking.result.EPOCH_RESULT`; shape (T,).
    channel: Records  #: `railfix.tracking.result.CHANNEL_RESULT`; shape (T, K).


class Trace(NamedTuple):
    """Record of one epoch for the smoother: H hypotheses, N unknowns, up to M measurements; H is 0 without a record."""

    prior: Floats  #: Covariances before the measurements; shape (H, N, N).
    row: Floats  #: Measurement matrix, 0 for unused measurements; shape (H, M, N).
    value: Floats  #: Innovations, in the units of the measurements; shape (H, M).
    variance: Floats  #: White variances divided by the weights; infinite for unused measurements; shape (H, M).
    restarted: Masks  #: Unknowns that have restarted; shape (H, N).
    kept: Indices  #: For each hypothesis after the epoch, the index that it had before; shape (H,).


class Rows(NamedTuple):
    """Measurements of one epoch in the order of processing: M rows of four kinds."""

    #: Rows of each measurement kind.
    code: slice
    phase: slice
    doppler: slice
    sensor: slice
    channel: Indices  #: Channel of each row, or column of a sensor; shape (M,).
    #: Variance of white errors, including the adapted scales [m2, (m/s)2, squared units of the sensors]; shape (M,).
    variance: Floats
    left_out: Masks  #: True for codes of a satellite that is left out as faulty; shape (M,).
    code_s: float  #: Interval that the codes represent [s]; the epoch's interval without codes, 0 if they are skipped.
    degrees: float  #: Degrees of freedom of the errors' Student t distribution; no unit.
    late_degrees: float  #: Degrees of freedom for codes that are longer than expected.
