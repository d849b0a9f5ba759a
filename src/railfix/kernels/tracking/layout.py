"""Arrays of the recursion: unknowns in use and their order, epochs, settings, state, work space, outputs."""

from __future__ import annotations

from typing import NamedTuple

from railfix.core.arrays import Codes, Floats, Indices, Integers, Masks

#: Compact unknowns that are always there: place, speed, acceleration, drift, error of the map to the right and up,
#: error of the speed by Dopplers, displacement of the codes.
ARC, SPEED, ACCELERATION, DRIFT, RIGHT, UP, DOPPLER_SPEED, CODE_PLACE = 0, 1, 2, 3, 4, 5, 6, 7
#: Unknowns of one epoch, after the compact ones: place and speed before, clock of the phases, displacement of the map
#: to the right, up and along, clock of the codes.
PREVIOUS_ARC, PREVIOUS_SPEED, PHASE_CLOCK, STEP_RIGHT, STEP_UP, MAP_LENGTH_ERROR, CODE_CLOCK = 0, 1, 2, 3, 4, 5, 6
OF_EPOCH = 7
#: Combinations of phases and Dopplers after the clock of the codes.
C_WAY, C_CLOCK, C_RIGHT, C_UP, C_SPEED, C_DRIFT = 1, 2, 3, 4, 5, 6
COMBINED = 7
#: Those of phases and Dopplers, and their order with clock and drift first, from `C_WAY` on.
MOTION = 6
CLOCKS_FIRST = 1, 5, 0, 4, 2, 3
#: Numbers in a vector of the processor: rows of the matrices in the work space are whole vectors.
LANES = 8
#: Kinds of sensors, and their columns: wheel, radar, force, place, balises in turn, and one for each range to a unit.
SENSORS = 7
#: Sources of sub-filters after the sensors: all Dopplers, all phases, codes of satellites ahead, behind, the map; and
#: none, for all satellites in view.
OTHERS = 6
ALL_DOPPLERS, ALL_PHASES, CODES_AHEAD, CODES_BEHIND, WRONG_MAP, ALL_IN_VIEW = 0, 1, 2, 3, 4, 5
WHEEL_ROW, RADAR_ROW, FORCE_ROW, PLACE_ROW, RANGE_ROW = 0, 1, 2, 3, 6
#: Parts of an epoch: all of it; the prediction alone; what follows a prediction that is in the work space already,
#: places sought in between; the same where the track was lost.
WHOLE, PREDICTION, REST, REST_LOST = 0, 1, 2, 3


class Epochs(NamedTuple):
    """T prepared epochs of K channels (`railfix.tracking.chunk.Chunk`) and sensors.

    `begins` marks epochs before which the state restarts; `singer` is the row of `step` and `noise` of each
    interval; columns of `sensor` and `sensor_sigma`: wheel, radar, force, place, two of balises, and R ranges to ground
    units by a unit at `lever_m` along the line, to the right and up; NaN without a measurement. Those from the place on
    were measured `sensor_age_s` before, shape (T, 3 + R).
    """

    time_s: Floats
    interval_s: Floats
    begins: Masks
    singer: Indices
    step: Floats
    noise: Floats
    slot: Indices
    offset: Indices
    sat_ecef_m: Floats
    sat_velocity_mps: Floats
    before_ecef_m: Floats
    measured: Floats
    has: Masks
    variance: Floats
    motion_measured: Masks
    code_sigma_m: Floats
    fresh: Masks
    remembered: Masks
    velocity_mps: Floats
    velocity_covariance: Floats
    velocity_age_s: Floats
    sensor: Floats
    sensor_sigma: Floats
    range_unit_ecef_m: Floats
    sensor_age_s: Floats
    lever_m: Floats
    unsigned: bool


class LineArrays(NamedTuple):
    """`railfix.tracking.line.Line`, with the arc lengths of the middles of segments."""

    arc_m: Floats
    ecef_m: Floats
    axes: Floats
    segment: Floats
    middle_m: Floats
    gradient: Floats
    sigma_plan_m: float
    sigma_height_m: float
    start_m: float
    end_m: float
    start_turn_m: float
    end_turn_m: float


class Parameters(NamedTuple):
    """Settings (`railfix.tracking.limits.TrackingLimits`), degrees of freedom, and the budget of the level."""

    degrees: tuple[float, float]
    passes: int
    code_correlation_s: float
    code_correlation_m: float
    slow_code_m: float
    slow_code_s: float
    doppler_error_mps: float
    doppler_error_share: float
    doppler_correlation_s: float
    phase_walk_m: float
    clock_walk_mps: float
    offset_walk_m: float
    map_roughness_m: float
    map_correlation_m: float
    map_scale_m: float
    code_period_s: float
    map_misfit_sigmas: float
    map_misfit_s: float
    map_misfit_kept_s: float
    map_absolute_m: float
    map_branch_m: float
    code_common_m: float
    code_common_s: float
    code_common_travel_m: float
    branch_floor: float
    branch_floor_m: float
    decided_travel_m: float
    least_probability: float
    most_hypotheses: int
    start_sigma_m: float
    service_acceleration_mps2: float
    level_acceleration_mps2: float
    trusted_satellites: int
    gap_s: float
    lost_motion_weight: float
    lost_motion_s: float
    lost_code_weight: float
    lost_code_s: float
    level_doubt_s: float
    expired_sigma_m: float
    level_passes: int
    level_map_m: float
    level_risk: float
    level_k: float
    level_k_speed: float
    code_white_share: float
    level_doubt_code_s: float
    level_hold_s: float
    end_doubt_s: float
    start_separation_m: float
    level_start_s: float


class Active(NamedTuple):
    """Compact unknowns that are in use: `full` is the place of each in the state, the others where to find them.

    -1 where there is none; `satellite` and `offset` are by slot and by clock.
    """

    full: Indices
    wheel: int
    force: int
    radar: int
    offset: Indices
    satellite: Indices


class Inputs(NamedTuple):
    """What the recursion is given and leaves as it is."""

    epochs: Epochs
    line: LineArrays
    parameters: Parameters
    active: Active


class KernelState(NamedTuple):
    """State that is read and written: compact means and covariances, and `scalars` (`HYPOTHESES` and following)."""

    mean: Floats
    covariance: Floats
    log_probability: Floats
    log_code: Floats
    log_least: Floats
    log_recent: Floats
    code_bias: Floats
    origin_m: Floats
    offset_known: Masks
    scalars: Floats


class Subfilters(NamedTuple):
    """Sub-filters of the level by their source (`railfix.tracking.bank`): satellites by slot, clocks, sensors, others.

    None of them where levels are off. `running` marks those that there are; `prior` is the probability of a fault of
    each source, 0 where it needs no sub-filter, `k` and `k_speed` the sigmas that follow from it; `begun` has the
    variances of the compact unknowns and those of an epoch that one begins with; `clock` is that of each satellite.
    """

    running: Masks
    mean: Floats
    covariance: Floats
    weak_s: Floats
    prior: Floats
    k: Floats
    k_speed: Floats
    begun: Floats
    clock: Indices


class Rows(NamedTuple):
    """Channels of the codes, phases and Dopplers of an epoch and columns of its sensors, and how many of each."""

    codes: Indices
    phases: Indices
    dopplers: Indices
    sensors: Indices
    counts: Indices


class Work(NamedTuple):
    """Work space of an epoch of K channels, H hypotheses, N compact unknowns (`railfix.tracking.compiled`).

    The first axis of most arrays is the hypothesis; its last row belongs to sub-filters and second starts.
    """

    mean: Floats
    spread: Floats
    now: Floats
    before: Floats
    design: Floats
    value: Floats
    innovation: Floats
    sensed: Floats
    cross: Floats
    root: Floats
    own: Floats
    information: Floats
    after: Floats
    change: Floats
    weight: Floats
    residual: Floats
    fitted: Floats
    new_mean: Floats
    new_covariance: Floats
    log_before: Floats
    log_after: Floats
    evidence: Floats
    code_evidence: Floats
    branch: Floats
    beyond: Floats
    restarted: Masks
    ranked: Indices
    kept: Indices
    joined: Floats
    variance: Floats
    masked: Floats
    system: Floats
    factor: Floats
    lower: Floats
    pivots: Floats
    right: Floats
    diagonal: Floats
    with_clock: Floats
    ordered: Floats
    part: Floats
    source: Masks
    met: Masks
    scaled: Floats
    normal: Floats
    motion: Floats
    joint: Floats
    found: Floats
    stepped: Floats
    faded: Floats
    unknown: Indices
    share: Floats
    sight: Floats
    bend: Floats
    point: Floats
    axes: Floats
    places: Floats
    place_axes: Floats


#: Places of `KernelState.scalars`.
HYPOTHESES, WEAK_MOTION, WEAK_CODE, SCALE_DOPPLER, SCALE_PHASE, DISTANCE_SINCE_CODE, DIRECTION, MEASURED = range(8)
SHIFT, SHIFT_VARIANCE, MAP_LOG_VARIANCE, LEAST_SPEED, MOST_SPEED, CODED, BRANCH_S, BRANCH_M = (
    8,
    9,
    10,
    11,
    12,
    13,
    14,
    15,
)
ACROSS, STEP_TIME, WITHHELD, OPEN, MOTION_MISFIT = 16, 17, 18, 19, 20


class Outputs(NamedTuple):
    """Arrays of `railfix.tracking.result.Tracked` that are written."""

    status: Codes
    arc_m: Floats
    sigma_m: Floats
    speed_mps: Floats
    speed_sigma_mps: Floats
    acceleration_mps2: Floats
    probability: Floats
    hypotheses: Integers
    code_weight: Floats
    motion_weight: Floats
    wheel_scale: Floats
    force_offset_mps2: Floats
    radar_scale: Floats
    map_scale: Floats
    level_m: Floats
    ground_level_m: Floats
    level_noise_m: Floats
    level_speed_mps: Floats
    separation_m: Floats
    amount_m: Floats
    used: Integers
    innovation: Floats
    sensed: Floats
    weight: Floats
    faulty: Masks
