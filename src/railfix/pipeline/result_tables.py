"""Results as tables: polars for files and analysis, xarray for arrays with named axes.

Times are in GPS time without a time zone, to the nanosecond. Absent values are null in polars and NaN in xarray.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import polars as pl

from railfix.core.arrays import Floats, Strings
from railfix.core.errors import check_type
from railfix.core.reason_names import reason_text
from railfix.core.reasons import Reason
from railfix.motion.slip import MotionState
from railfix.pipeline.along_track import on_line_m
from railfix.pipeline.balises import VERDICTS, Passing
from railfix.pipeline.filter_result import AlongTrack, SmoothedTrack
from railfix.pipeline.result_columns import (
    CHANNEL_COLUMNS,
    EPOCH,
    IN_SPACE,
    OBSERVATION_COLUMNS,
    ON_LINE,
    POSITION_COLUMNS,
    Column,
    Observed,
    by_name,
    decimals,
    float_column,
    make_table,
)
from railfix.pipeline.results import AntennaResult, Result
from railfix.pipeline.sensed_motion import CARRIED
from railfix.track.trajectory import Trajectory
from railfix.tracking import Kind, TrackStatus

if TYPE_CHECKING:
    import xarray as xr


def antenna_positions(name: str, result: AntennaResult) -> pl.DataFrame:
    """Return `POSITION_COLUMNS` of one antenna, one row per epoch, including epochs without a position."""
    return make_table(POSITION_COLUMNS, result, len(result.time), antenna=name)


def in_time_order(parts: Sequence[pl.DataFrame]) -> pl.DataFrame:
    """Return the rows of all antennas in order of time; rows of the same time are in the order of `parts`."""
    table = pl.concat(parts)
    return table if len(parts) == 1 else table.sort("time_gpst", maintain_order=True)


def positions_table(result: Result) -> pl.DataFrame:
    """Return `POSITION_COLUMNS`, one row per epoch and antenna, sorted by time, then as in `result.antennas`."""
    check_type(result, Result, "result")
    parts = [antenna_positions(name, antenna) for name, antenna in result.antennas.items()]
    return in_time_order(parts)


def antenna_observations(name: str, result: AntennaResult, tracked: AlongTrack | None = None) -> pl.DataFrame:
    """Return `OBSERVATION_COLUMNS` of one antenna, one row per epoch and observed channel."""
    source = Observed(result, tracked)
    epoch, channel = np.nonzero((result.reason & Reason.NOT_OBSERVED) == 0)
    reasons, inverse = np.unique(result.reason[epoch, channel], return_inverse=True)
    texts = pl.Series(values=[reason_text(int(reason)) for reason in reasons], dtype=pl.String)
    of_channel, rows = pl.Series(values=channel.astype(np.uint32)), len(epoch)
    columns: dict[str, pl.Series] = {
        "time_gpst": pl.Series(values=result.time[epoch]),
        "antenna": pl.Series(values=[name], dtype=pl.String).new_from_index(0, rows),
        "satellite": pl.Series(values=result.satellite.tolist(), dtype=pl.String).gather(of_channel),
        "signal": pl.Series(values=result.signal.tolist(), dtype=pl.String).gather(of_channel),
        "reason_text": texts.gather(pl.Series(values=inverse.astype(np.uint32))),
    }
    for column in CHANNEL_COLUMNS.values():
        values = column.of(source)
        columns[column.name] = column.series(values[epoch, channel] if isinstance(values, np.ndarray) else values, rows)
    return pl.DataFrame(columns).select(*OBSERVATION_COLUMNS)


def observations_table(result: Result) -> pl.DataFrame:
    """Return `OBSERVATION_COLUMNS`, one row per epoch, antenna and observed channel, sorted in this order."""
    check_type(result, Result, "result")
    parts = [antenna_observations(name, antenna, result.fusion.get(name)) for name, antenna in result.antennas.items()]
    return in_time_order(parts)


def round_floats(table: pl.DataFrame) -> pl.DataFrame:
    """Return a table with its floats rounded as in CSV files: 0.1 mm, 1e-9 deg."""
    floats = [name for name, kind in table.schema.items() if kind == pl.Float64]
    return table.with_columns(pl.col(name).round(decimals(name)) for name in floats)


def to_xarray(
    result: AntennaResult, tracked: AlongTrack | None = None, *, attributes: Mapping[str, Any] | None = None
) -> xr.Dataset:
    """Return the results of one antenna as arrays with named axes.

    Parameters
    ----------
    result : AntennaResult
    tracked : AlongTrack, optional
        Filtered positions (`Result.fusion`).
    attributes : mapping, optional
        Attributes of the dataset (name of the antenna, provenance).

    Returns
    -------
    xarray.Dataset
        Variables over ``time`` for `POSITION_COLUMNS` and, with `tracked`, for `TRAIN_COLUMNS` (``filter_...``);
        variables over ``time`` and ``channel`` for `CHANNEL_COLUMNS`. Each variable has ``units`` and a ``long_name``.
        Positions are also given as ECEF coordinates ``ecef_m`` and ``conventional_ecef_m`` (axis ``xyz``), and as arc
        length ``arc_m`` along the trajectory. ``satellite`` and ``signal`` are coordinates of ``channel``.
    """
    import xarray as xr

    check_type(result, AntennaResult, "result")

    def variables(columns: Mapping[str, Column[Any]], source: Any, axes: tuple[str, ...]) -> dict[str, Any]:
        shape = result.reason.shape[: len(axes)]
        return {
            name: (axes, column.array(column.of(source), shape), {"units": column.unit, "long_name": column.meaning})
            for name, column in columns.items()
            if name not in ("time_gpst", "antenna")
        }

    data = variables(POSITION_COLUMNS, result, ("time",))
    if tracked is not None:
        data |= {f"filter_{name}": values for name, values in variables(TRAIN_COLUMNS, tracked, ("time",)).items()}
    data |= variables(CHANNEL_COLUMNS, Observed(result, tracked), ("time", "channel"))
    data["arc_m"] = (("time",), result.arc_m, {"units": "m", "long_name": "distance along the antenna's trajectory"})
    for name, values in (("ecef_m", result.ecef_m), ("conventional_ecef_m", result.point.ecef_m)):
        data[name] = (("time", "xyz"), values, {"units": "m"})
    coordinates = {
        "time": result.time,
        "satellite": ("channel", result.satellite),
        "signal": ("channel", result.signal),
        "xyz": ["x", "y", "z"],
    }
    return xr.Dataset(data, coords=coordinates, attrs=dict(attributes or {}))


def _sources(result: AlongTrack) -> Strings:
    """Return the kinds of measurements used at each epoch, joined by ``+``, shape (T,)."""
    used = result.tracked.used
    kinds = np.array([*(kind.name.lower() for kind in Kind), "carry"])
    carried = (used[:, Kind.WHEEL] > 0) & np.isin(result.sensed.state, CARRIED)
    has = np.column_stack([used > 0, carried])
    has[:, Kind.WHEEL] &= ~carried
    has[:, Kind.BALISE] |= has[:, Kind.NEXT_BALISE]
    has[:, Kind.NEXT_BALISE] = False
    combinations, which = np.unique(has, axis=0, return_inverse=True)
    return np.array(["+".join(kinds[row]) for row in combinations], dtype=np.str_)[which.reshape(-1)]


def _innovation(result: AlongTrack, kind: Kind) -> Floats:
    kinds = [Kind.BALISE, Kind.NEXT_BALISE] if kind == Kind.BALISE else [kind]
    return np.asarray(np.fmax.reduce([result.tracked.sensed[:, each - Kind.WHEEL] for each in kinds]))


#: Columns of the filter's table.
TRAIN_COLUMNS: Final[Mapping[str, Column[AlongTrack]]] = by_name(
    (
        *EPOCH,
        Column(
            "status",
            "see `railfix.tracking.TrackStatus`; only `tracking` and `coasting` have a finite level along the line",
            "tracked.status",
            words=tuple(s.text for s in TrackStatus),
        ),
        *ON_LINE,
        Column(
            "along_sigma_m",
            "standard deviation of the position; larger if positions on other branches are possible",
            "tracked.sigma_m",
        ),
        Column("speed_mps", "speed along the line, + toward rising chainage", "tracked.speed_mps"),
        Column("speed_sigma_mps", "standard deviation of the speed", "tracked.speed_sigma_mps"),
        Column("acceleration_mps2", "acceleration along the line", "tracked.acceleration_mps2"),
        Column(
            "direction",
            "`rising` or `falling` chainage, `unknown` where the speed is too small to decide",
            lambda r: r.direction + 1,
            words=("falling", "unknown", "rising"),
        ),
        Column("standstill", "true if the speed plus two sigmas is below 1 km/h", dtype=pl.Boolean()),
        Column(
            "branch_probability",
            "probability of the published position, as opposed to other positions on the line",
            "tracked.probability",
        ),
        Column("hypotheses", "number of possible positions", "tracked.hypotheses", dtype=pl.Int16()),
        Column(
            "protection_level_m",
            "bound that the error along the line exceeds at most with the stated risk; infinite if the probability of "
            "other positions exceeds this risk, or if measurements contradict the position",
            "tracked.level_m",
        ),
        Column(
            "protection_level_ground_m",
            "protection level of the straight distance from position to train; also valid on other laps or off the map",
            "tracked.ground_level_m",
        ),
        Column("protection_noise_m", "part of the protection level due to noise alone", "tracked.level_noise_m"),
        Column("protection_separation_m", "largest difference of a sub-filter from the filter", "tracked.separation_m"),
        Column(
            "protection_unchecked",
            "probability of faults that the level does not bound: a fault of the only constellation in view",
            "tracked.unchecked_prior",
        ),
        Column(
            "over_reading_m",
            "largest distance of the train behind the position: the larger of the protection level and 2 % of the "
            "distance since codes were last used (`L_DOUBTOVER` minus `Q_LOCACC`)",
            "tracked.amount_m",
        ),
        Column("under_reading_m", "largest distance from position to train ahead (`L_DOUBTUNDER`)", "tracked.amount_m"),
        Column(
            "motion",
            "state of motion from tachometer and inertial unit together, see `docs/sensors.md`",
            "sensed.state",
            words=tuple(state.name.lower() for state in MotionState),
        ),
        Column(
            "sources",
            "measurements used with a weight above 0.5: `code` (once per second), `phase`, `doppler`, `wheel` (`carry` "
            "where inertia replaces it), `radar`, `force`, `place` (from a feature of the line), `balise`, `range`",
            _sources,
            dtype=pl.String(),
        ),
        *IN_SPACE,
        Column(
            "code_weight",
            "mean weight of codes; a code has the weight 1 if its error is one standard deviation",
            "tracked.code_weight",
        ),
        Column("motion_weight", "mean weight of Dopplers and phases", "tracked.motion_weight"),
        Column("wheel_scale", "scale-factor error, positive if wheel distances are too short", "tracked.wheel_scale"),
        Column("radar_scale", "scale-factor error, positive if radar distances are too short", "tracked.radar_scale"),
        Column("force_offset_mps2", "estimated offset of the accelerometer", "tracked.force_offset_mps2"),
        Column(
            "map_scale",
            "factor on the map's assumed length error (0.03 m per root metre); above 1 if pseudoranges indicate more",
            "tracked.map_scale",
        ),
        Column(
            "measured_chainage_m",
            "chainage, of the vehicle's middle or (without vehicle file) of the antenna, for the next three columns",
            "sensed.under_m",
        ),
        Column(
            "measured_gradient_permille",
            "gradient from tachometer and accelerometer, positive if the line rises with chainage; empty "
            "during slips and below 1 m/s",
            lambda r: 1e3 * r.sensed.gradient,
        ),
        Column(
            "measured_curvature_1pm",
            "curvature at `measured_chainage_m` from yaw rate, positive if the line turns right toward rising chainage",
            "sensed.curvature_1pm",
        ),
        Column(
            "measured_cant_mm",
            "cant at `measured_chainage_m` from the roll of the body, positive if the left rail is higher; empty "
            "without a vehicle file",
            lambda r: 1e3 * r.sensed.cant_m,
        ),
        Column(
            "metric_antenna_spacing_m",
            "distance between the positions of the two antennas minus the antenna spacing; empty for one antenna",
            "spacing_error_m",
        ),
        Column(
            "wheel_difference_m",
            "satellite-derived distance over the last two minutes minus the wheel distance",
            "wheel.difference_m",
        ),
        *(
            Column(
                f"innovation_{kind.name.lower()}_{unit}",
                f"measured minus predicted: {what}",
                partial(_innovation, kind=kind),
            )
            for kind, unit, what in (
                (Kind.WHEEL, "m", "distance since the previous epoch"),
                (Kind.RADAR, "m", "distance since the previous epoch"),
                (Kind.FORCE, "mps2", "mean forward specific force"),
                (Kind.PLACE, "m", "position from a feature of the line"),
                (Kind.BALISE, "m", "position of a balise"),
                (Kind.RANGE, "m", "range to a ground unit"),
            )
        ),
    )
)


@dataclass(frozen=True)
class SmoothedAntenna:
    """Smoothed positions of one antenna, with its trajectory."""

    track: SmoothedTrack
    trajectory: Trajectory


#: Columns that smoothing adds to the filter's table (`railfix run --smooth`).
SMOOTHED_COLUMNS: Final[Mapping[str, Column[SmoothedAntenna]]] = by_name(
    (
        Column(
            "smoothed_chainage_m",
            "smoothed chainage, computed from all measurements before and after the epoch",
            lambda s: s.trajectory.chainage_at(on_line_m(s.track, s.trajectory)),
        ),
        Column("smoothed_sigma_m", "standard deviation of the smoothed chainage", "track.sigma_m"),
        Column("smoothed_speed_mps", "speed along the line, from earlier and later measurements", "track.speed_mps"),
    )
)


def train_table(result: Result) -> pl.DataFrame:
    """Return the positions of the filter along the track, one row per epoch and antenna in order of time.

    The table has `TRAIN_COLUMNS`, or neither columns nor rows if the filter is off.
    """
    check_type(result, Result, "result")
    parts = [antenna_train(name, tracked) for name, tracked in result.fusion.items()]
    return in_time_order(parts) if parts else pl.DataFrame()


def with_smoothed(table: pl.DataFrame, smoothed: Mapping[str, pl.DataFrame]) -> pl.DataFrame:
    """Add `SMOOTHED_COLUMNS` to rows of `train_table`; `smoothed` has them for each antenna, in order of time."""
    antenna = table["antenna"].to_numpy()
    values = {name: np.full(len(table), np.nan) for name in SMOOTHED_COLUMNS}
    for name, rows in smoothed.items():
        mine = antenna == name
        for column, whole in values.items():
            whole[mine] = rows[column].fill_null(np.nan).to_numpy()
    return table.with_columns(**{name: float_column(column) for name, column in values.items()})


def smoothed_table(result: SmoothedTrack, trajectory: Trajectory) -> pl.DataFrame:
    """Return `SMOOTHED_COLUMNS` of one antenna, one row per epoch."""
    return make_table(SMOOTHED_COLUMNS, SmoothedAntenna(result, trajectory), len(result.time))


def antenna_train(name: str, result: AlongTrack) -> pl.DataFrame:
    """Return the filtered positions of one antenna, one row per epoch."""
    return make_table(TRAIN_COLUMNS, result, len(result), antenna=name)


_TIME: Final = pl.Datetime("ns")


def _getter(name: str) -> Any:
    """Return a function that collects one field of all passings in an array."""
    return lambda passings: np.array([getattr(passing, name) for passing in passings])


#: Columns of the table of passed balises and virtual balises, and of wrong readings.
PASSING_COLUMNS: Final[Mapping[str, Column[Sequence[Passing]]]] = by_name(
    (
        Column("time_gpst", "time of the passing from the filter, or time of a contradicting reading", _getter("time"),
               dtype=_TIME),
        Column("earliest_gpst", "earliest time, within the protection level, of the passing",
               _getter("earliest"), dtype=_TIME),
        Column("latest_gpst", "latest time, within the protection level, of the passing",
               _getter("latest"), dtype=_TIME),
        EPOCH[1],
        Column("balise", "name in the list, or identity that was read", _getter("balise"), dtype=pl.String()),
        Column(
            "verdict",
            "`virtual`: virtual balise passed; `read`: balise passed with a reading; `missing`: passed unread; "
            "`contradicts`: read at a place that the filter excludes; `not_listed`: read, but not in the list",
            _getter("verdict"), words=VERDICTS,
        ),
        Column("chainage_m", "chainage in the list", _getter("chainage_m")),
        Column("read_gpst", "time of the reading", _getter("read"), dtype=_TIME),
        Column("read_error_m", "for a contradicting reading, listed position minus the filter's position",
               _getter("read_error_m")),
        Column("speed_mps", "speed at the passing, + toward rising chainage", _getter("speed_mps")),
        Column("protection_level_m", "protection level of the position at the passing", _getter("level_m")),
        Column("doubt_over_m", "largest distance by which the train may be behind: `L_DOUBTOVER` minus `Q_LOCACC`",
               _getter("amount_m")),
        Column("doubt_under_m", "largest distance by which the train may be ahead: `L_DOUBTUNDER` minus `Q_LOCACC`",
               _getter("amount_m")),
        Column("odometer_m", "for comparison: 5 m plus 5 % of the distance since the last balise read (SUBSET-041)",
               _getter("odometer_m")),
    )
)  # fmt: skip


def passing_table(result: Result) -> pl.DataFrame:
    """Return the passings of a chunk, with `PASSING_COLUMNS`."""
    parts = [make_table(PASSING_COLUMNS, own.passings, len(own.passings), antenna=name)
             for name, own in result.fusion.items()]  # fmt: skip
    return pl.concat(parts).sort("time_gpst", maintain_order=True) if parts else make_table(PASSING_COLUMNS, (), 0)
