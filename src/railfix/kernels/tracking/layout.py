"""Arrays of the recursion: the state's unknowns, records with their shapes and units, and what is handed on together.

Records of numpy name the fields of an epoch, a channel, a sensor and a vertex. Those of the settings, of the state's
scalars and of the results have the fields of `railfix.tracking.limits.TrackingLimits`,
`railfix.tracking.state.Monitors` and `railfix.tracking.result.Tracked`, which define them.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks

#: Array of records; the fields are in the definitions below.
Records: TypeAlias = Any
Record: TypeAlias = Any


def record_of(fields: dict[str, Any]) -> np.dtype[Any]:
    """Return the type of records with named fields: a type, or a type and the shape of an array."""
    listed = [(name, *kind) if isinstance(kind, tuple) else (name, kind) for name, kind in fields.items()]
    return np.dtype((np.record, np.dtype(listed, align=True)))


#: One epoch.
EPOCH: Final = record_of({
    "time_s": float,  # since `TrackState.origin` [s]
    "interval_s": float,  # since the epoch before [s]
    "begins": bool,  # the state restarts before it
    "coded": bool,  # codes of a satellite
    "motion_measured": bool,  # phases or Dopplers of at least four satellites: they carry the place on without codes
    "velocity_mps": (float, (3,)),  # ECEF, by phases or Dopplers without the line [m/s]; NaN without
    "velocity_covariance": (float, (3, 3)),  # [m2/s2]
    "velocity_age_s": float,  # how long before the epoch it holds [s]
    "step": (float, (3, 3)),  # transition of arc length, speed and acceleration (R. A. Singer, 1970)
    "noise": (float, (3, 3)),  # their process noise [m, m/s, m/s2 squared]
})  # fmt: skip
#: One channel at one epoch: measurements of one satellite.
CHANNEL: Final = record_of({
    "satellite": np.intp,  # of its code error among those of the state; -1 for one that is never measured
    "clock": np.intp,  # of its codes in `CLOCKS`
    "sat_ecef_m": (float, (3,)),  # at transmission [m]
    "sat_velocity_mps": (float, (3,)),  # [m/s]
    "before_ecef_m": (float, (3,)),  # at the epoch before [m]
    "measured": (float, (3,)),  # corrected code [m], change of the phase since the epoch before [m], range rate [m/s]
    "has": (np.int8, (3,)),  # 1 where `measured` is a number that may be used
    "variance": (float, (3,)),  # of white errors before the learnt scales, of codes over a second [m2, m2, m2/s2]
    "code_sigma_m": float,  # standard deviation of the correlated code error; the unknown is in units of it [m]
})  # fmt: skip
#: One sensor at one epoch.
SENSOR: Final = record_of({
    "value": float,  # distance [m], force [m/s2], place [m] or range [m]; NaN without
    "sigma": float,  # its standard deviation, in the same unit
    "age_s": float,  # how long before the epoch it was measured [s]; places, balises, ranges
    "unsigned": bool,  # a distance without a sign, which takes that of the speed
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
    "sigma_plan_m": float,  # of the map across [m]
    "sigma_height_m": float,  # of the map's heights [m]
    "tilt_m": float,  # sigma of a displacement along the line by a tilted ionosphere [m]
    "start_m": float,  # open ends; infinite where closed [m]
    "end_m": float,
    "start_turn_m": float,  # length of the turn that goes on before the start or after the end, 0 where open [m]
    "end_turn_m": float,
})  # fmt: skip
#: One source of faults, with the sub-filter without it.
SOURCE: Final = record_of({
    "running": bool,  # whether there is a sub-filter
    "contradicted_s": float,  # how long its measurements have contradicted it [s]
    "prior": float,  # probability of a fault; 0 needs no sub-filter
    "k": float,  # sigmas that noise exceeds with the risk over that probability
    "k_speed": float,  # the same for the speed
    "clock": np.intp,  # of a satellite's codes in `CLOCKS`; 0 for other sources
})  # fmt: skip


class Given(NamedTuple):
    """Inputs of the recursion: T epochs, K channels, C sensors, S satellites, V vertices, N unknowns."""

    epoch: Records  #: `EPOCH`; shape (T,).
    channel: Records  #: `CHANNEL`; shape (T, K).
    sensor: Records  #: `SENSOR`; shape (T, C).
    fresh: Masks  #: Satellites whose code error begins at an epoch; shape (T, S).
    within_memory: Masks  #: Satellites whose code error lasts from before an epoch; shape (T, S).
    vertex: Records  #: `VERTEX`; shape (V,).
    line: Records  #: `LINE`; shape (1,).
    parameters: Records  #: `TrackingLimits` and the budget of the level; shape (1,).
    start_variance: Floats  #: Of each unknown where nothing is known of it; shape (N,).


class State(NamedTuple):
    """State of the recursion, changed in place: H hypotheses and B sub-filters, Gaussians side by side."""

    x: Floats  #: Means, hypotheses first, units as in `index.py`; shape (H + B, N).
    P: Floats  #: Covariances, products of these units; shape (H + B, N, N).
    hypothesis: Records  #: `railfix.tracking.state.HYPOTHESIS`; shape (H,).
    monitors: Records  #: `railfix.tracking.state.Monitors`; shape (1,).
    code_bias: Floats  #: Mean innovation of each satellite's codes over its standard deviation, no unit; shape (S,).
    offset_known: Masks  #: Clocks that have had an observation; shape (CLOCK_COUNT,).
    source: Records  #: `SOURCE`: satellites, clocks, sensors, others; shape (B,), 0 where levels are off.


class Results(NamedTuple):
    """Results of the recursion, epoch by epoch."""

    epoch: Records  #: `railfix.tracking.result.EPOCH_RESULT`; shape (T,).
    channel: Records  #: `railfix.tracking.result.CHANNEL_RESULT`; shape (T, K).


class Trace(NamedTuple):
    """Record of one epoch for the smoother: H hypotheses, N unknowns, M measurements at most; H is 0 without."""

    prior: Floats  #: Covariances before the measurements; shape (H, N, N).
    row: Floats  #: Measurement matrix, 0 for what was not used; shape (H, M, N).
    value: Floats  #: Innovations, units of the measurements; shape (H, M).
    variance: Floats  #: Their white variances over the weights; infinite for what was not used; shape (H, M).
    restarted: Masks  #: Unknowns that have restarted; shape (H, N).
    kept: Indices  #: Earlier index of each hypothesis after the epoch; shape (H,).


class Rows(NamedTuple):
    """Measurements of one epoch in their order: M rows of four kinds."""

    #: Rows of each kind.
    code: slice
    phase: slice
    doppler: slice
    sensor: slice
    channel: Indices  #: Channel of each row, of a sensor its column; shape (M,).
    #: Of white errors, the learnt scales included [m2, (m/s)2, squared units of the sensors]; shape (M,).
    variance: Floats
    left_out: Masks  #: Codes of a satellite that is left out as faulty; shape (M,).
    code_s: float  #: Time that the codes stand for [s]; 0 where they are not used.
    degrees: float  #: Degrees of freedom of Student's t that the errors follow; no unit.
    late_degrees: float  #: The same of codes that are longer than expected.
