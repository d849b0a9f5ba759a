"""Records and tuples of arrays that the recursion uses, with shapes and units.

Further records are defined elsewhere: settings by `railfix.tracking.limits.TrackingLimits`, scalars of the state by
`railfix.tracking.state.Monitors`, and results by `railfix.tracking.result.Tracked`.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks

#: Array of records with named fields.
Records: TypeAlias = Any
Record: TypeAlias = Any


def record_of(fields: dict[str, Any]) -> np.dtype[Any]:
    """Return a record type with named fields, each with a type, or with a type and an array shape."""
    listed = [(name, *kind) if isinstance(kind, tuple) else (name, kind) for name, kind in fields.items()]
    return np.dtype((np.record, np.dtype(listed, align=True)))


#: One epoch.
EPOCH: Final = record_of({
    "time_s": float,  # time since `TrackState.origin` [s]
    "interval_s": float,  # time since the previous epoch [s]
    "begins": bool,  # True if the state restarts before this epoch
    "coded": bool,  # True if the epoch has codes
    # ratio of the error of the ionospheric model to the error in a quiet ionosphere; 0 if there is no such error
    "tilt_scale": float,
    "motion_measured": bool,  # True if at least four phases or Dopplers propagate the position
    "velocity_mps": (float, (3,)),  # ECEF velocity from phases or Dopplers alone [m/s]; NaN if unknown
    "velocity_covariance": (float, (3, 3)),  # [m2/s2]
    "velocity_age_s": float,  # age of the velocity at the epoch [s]
    "step": (float, (3, 3)),  # transition matrix of arc length, speed, acceleration (R. A. Singer, 1970)
    "noise": (float, (3, 3)),  # process noise covariance of arc length [m], speed [m/s], acceleration [m/s2]
})  # fmt: skip
#: Measurements of one channel, which belongs to one satellite, at one epoch.
CHANNEL: Final = record_of({
    "satellite": np.intp,  # index of the satellite, its code error and its sub-filter; -1 if it is not measured
    "clock": np.intp,  # index in `CLOCKS` of the satellite's code clock
    "sat_ecef_m": (float, (3,)),  # satellite position at transmission [m]
    "sat_velocity_mps": (float, (3,)),  # [m/s]
    "before_ecef_m": (float, (3,)),  # satellite position at the previous epoch [m]
    "measured": (float, (3,)),  # corrected code [m], phase change since the previous epoch [m], range rate [m/s]
    "has": (np.int8, (3,)),  # 1 where `measured` is usable
    "variance": (float, (3,)),  # white variances before adaptation [m2, m2, m2/s2], for codes averaged over 1 s
    "code_sigma_m": float,  # standard deviation of the correlated code error [m]; this error's unknown has this unit
})  # fmt: skip
#: One sensor at one epoch.
SENSOR: Final = record_of({
    "value": float,  # distance [m], force [m/s2], position [m] or range [m]; NaN without a measurement
    "sigma": float,  # standard deviation of `value`, in the same unit
    "age_s": float,  # age of positions, balises and ranges at the epoch [s]
    "unsigned": bool,  # True for an unsigned distance, which gets the sign of the speed
    "unit_ecef_m": (float, (3,)),  # ECEF position of a range's ground unit [m]
    "lever_m": (float, (3,)),  # lever arm from the trajectory to the vehicle's ranging unit: along, right, up [m]
})  # fmt: skip
#: One vertex of the line, and the segment after it.
VERTEX: Final = record_of({
    "arc_m": float,  # [m]
    "ecef_m": (float, (3,)),  # [m]
    "axes": (float, (3, 3)),  # tangent, right, up
    "segment": (float, (3,)),  # unit vector of the segment
    "middle_m": float,  # arc length of the segment's middle [m]
    "gradient": float,  # climb divided by horizontal length
})  # fmt: skip
#: The line as a whole.
LINE: Final = record_of({
    "sigma_plan_m": float,  # standard deviation of the map error across the line [m]
    "sigma_height_m": float,  # standard deviation of the height error of the map [m]
    "tilt_m": float,  # sigma of the position displacement along the line by a horizontal ionospheric gradient [m]
    "start_m": float,  # arc lengths of the line's ends [m]; infinite for ends that close a lap
    "end_m": float,
    # length of the lap that leads back to the start or to the end of the line [m]; 0 if no lap does
    "start_turn_m": float,
    "end_turn_m": float,
})  # fmt: skip
#: One source of faults, with the sub-filter that excludes it.
SOURCE: Final = record_of({
    "running": bool,  # True if the sub-filter exists
    "contradicted_s": float,  # time for which measurements have contradicted the sub-filter [s]
    "prior": float,  # probability of a fault; 0 for sources without a sub-filter
    "k": float,  # factor K: normal quantile of the ratio risk / `prior`
    "k_speed": float,  # factor K for the speed
    "clock": np.intp,  # index in `CLOCKS` of a satellite's code clock; unused (0) for other sources
})  # fmt: skip


class Given(NamedTuple):
    """Inputs of the recursion, for T epochs, K channels, C sensors, S satellites, V vertices and N unknowns."""

    epoch: Records  #: `EPOCH`; shape (T,).
    channel: Records  #: `CHANNEL`; shape (T, K).
    sensor: Records  #: `SENSOR`; shape (T, C).
    fresh: Masks  #: True where a satellite's code error begins anew at the epoch; shape (T, S).
    within_memory: Masks  #: True where a satellite's code error continues from an earlier epoch; shape (T, S).
    vertex: Records  #: `VERTEX`; shape (V,).
    line: Records  #: `LINE`; shape (1,).
    parameters: Records  #: Fields of `TrackingLimits`, and the risk budget of the protection level; shape (1,).
    start_variance: Floats  #: Variance of each unknown before any measurement; shape (N,).


class State(NamedTuple):
    """State of the recursion, changed in place, with the Gaussians of H hypotheses and B sub-filters."""

    x: Floats  #: Means, hypotheses first, in the units of `index.py`; shape (H + B, N).
    P: Floats  #: Covariances, in products of the units of `x`; shape (H + B, N, N).
    hypothesis: Records  #: `railfix.tracking.state.HYPOTHESIS`; shape (H,).
    monitors: Records  #: `railfix.tracking.state.Monitors`; shape (1,).
    code_bias: Floats  #: Mean normalised innovation of each satellite's codes; shape (S,).
    offset_known: Masks  #: True for code clocks that have been observed so far; shape (CLOCK_COUNT,).
    source: Records  #: `SOURCE` of satellites, clocks, sensors and others; shape (B,), with B = 0 if levels are off.


class Results(NamedTuple):
    """Results of the recursion."""

    epoch: Records  #: `railfix.tracking.result.EPOCH_RESULT`; shape (T,).
    channel: Records  #: `railfix.tracking.result.CHANNEL_RESULT`; shape (T, K).


class Trace(NamedTuple):
    """Record of one epoch for the smoother: H hypotheses (H = 0: no record), N unknowns, at most M measurements."""

    prior: Floats  #: Covariances before the measurements; shape (H, N, N).
    row: Floats  #: Measurement matrix; shape (H, M, N). Rows of unused measurements are 0.
    value: Floats  #: Innovations, in the units of the measurements; shape (H, M).
    variance: Floats  #: Variances of white errors divided by weights, infinite for unused measurements; shape (H, M).
    restarted: Masks  #: True for unknowns that restarted at the epoch; shape (H, N).
    kept: Indices  #: For each hypothesis after the epoch, its index before the epoch; shape (H,).


class Rows(NamedTuple):
    """M measurements of one epoch in the order of processing, as rows of four kinds."""

    #: Rows of each measurement kind.
    code: slice
    phase: slice
    doppler: slice
    sensor: slice
    channel: Indices  #: Index of each row's channel, or of its column for sensors; shape (M,).
    #: Variances of white errors, with adapted scales [m2, (m/s)2, squared units of sensors]; shape (M,).
    variance: Floats
    left_out: Masks  #: True for codes of satellites excluded as faulty; shape (M,).
    code_s: float  #: Interval that the codes represent [s]: 0 if codes are not used, `interval_s` if there are none.
    degrees: float  #: Degrees of freedom of Student's t distribution of the errors.
    late_degrees: float  #: Degrees of freedom for codes that are longer than expected.
