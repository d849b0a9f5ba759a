"""Positions of the filter along the track as a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
import polars as pl

from railfix.motion.slip import MotionState
from railfix.pipeline.along_track import AlongTrack, on_line_m
from railfix.pipeline.results import Result
from railfix.pipeline.sensed_motion import CARRIED
from railfix.pipeline.smoothing import SmoothedTrack
from railfix.pipeline.tables import float_column, in_time_order
from railfix.track.trajectory import Trajectory
from railfix.tracking import Kind, TrackStatus

#: Words of the column ``status`` of the filter along the track, and of ``direction``.
TRACK_STATUS_TYPE: Final = pl.Enum([s.text for s in TrackStatus])
MOTION_TYPE: Final = pl.Enum([state.name.lower() for state in MotionState])
DIRECTION_TYPE: Final = pl.Enum(["falling", "unknown", "rising"])

#: Columns of the table of the filter along the track, with their unit and meaning.
TRAIN_COLUMNS: Final[dict[str, str]] = {
    "time_gpst": "time tag of the receiver, GPS time",
    "antenna": "`front` or `rear`",
    "status": "`tracking`; `several_branches`, the most probable place of several; `coasting`, predicted, no "
    "measurement used; `lost`, measurements contradict the track and places are sought again; `expired`, predicted too "
    "far; `not_started`; `off_map`, no place, the satellites put the train away from the line; `map_offset`, a place "
    "on a line that 3-D positions of the last minutes lie beside or above; `antennas_disagree`, the places of the two "
    "antennas are not as far apart as the antennas, or their speeds differ, now or within the last 20 s",
    "chainage_m": "distance along the line from the first point of the track",
    "kilometrage_m": "the line's own marking, where the track has one",
    "along_sigma_m": "standard deviation along the line",
    "speed_mps": "along the line, + toward rising chainage",
    "speed_sigma_mps": "its standard deviation",
    "acceleration_mps2": "along the line",
    "direction": "`rising` or `falling` chainage, `unknown` where the speed does not tell",
    "standstill": "slower than 1 km/h with two sigmas",
    "branch_probability": "probability of the place given against other places of the line",
    "hypotheses": "places that are possible",
    "protection_level_m": "the error exceeds it with the stated risk, a fault of one source included; infinite without "
    "a sub-filter and where the weights contradict the track, empty with `tracking.level` off",
    "protection_noise_m": "its part by noise without a fault",
    "protection_separation_m": "largest distance of a sub-filter without one satellite, constellation or sensor",
    "over_reading_m": "how far the train may be behind: the level, at least 2 % of the way since codes were used",
    "under_reading_m": "how far the train may be ahead; counted as the other one",
    "motion": "by tachometer and inertial unit together: `init` (nothing known), `standing`, `low_speed` (below the "
    "tachometer's least), `normal` (the wheel rolls), `inertial_spin`, `inertial_slide` (the wheel is faster or slower "
    "than the train), `rolling` (away, below the tachometer's least), `expired` (carried for too long). In `standing`, "
    "`low_speed`, `inertial_spin`, `inertial_slide`, `rolling` the way of the wheel is not used: inertia carries",
    "sources": "measurements used with a weight of more than a half: `code` (once a second), `phase`, `doppler`, "
    "`wheel` (`carry` where inertia takes its place), `radar`, `force`, `place` (by a feature of the line), `range`",
    "latitude_deg": "antenna, WGS 84",
    "longitude_deg": "antenna, WGS 84",
    "height_m": "antenna, above the ellipsoid",
    "x_m": "antenna, ECEF",
    "y_m": "antenna, ECEF",
    "z_m": "antenna, ECEF",
    "code_weight": "mean weight of codes; 1 is that of an error of one standard deviation",
    "motion_weight": "mean weight of Dopplers and phases",
    "wheel_scale": "share that the wheel's way is too short by, as estimated",
    "radar_scale": "share that the radar's way is too short by, as estimated",
    "force_offset_mps2": "offset of the accelerometer, as estimated",
    "map_scale": "factor on the error of lengths along the map (`tracking.map_scale_m`): above 1 where the "
    "pseudoranges keep moving against the map",
    "measured_chainage_m": "chainage of the vehicle's middle (without a vehicle file of the antenna) to which the next "
    "three belong: means since the epoch before",
    "measured_gradient_permille": "gradient under the body by tachometer and accelerometer, "
    "+ where the line rises with chainage; empty where the wheel slips or is slower than 1 m/s",
    "measured_curvature_1pm": "curvature there by the yaw rate, + to the right in rising chainage",
    "measured_cant_mm": "cant there by the lean of the body, + with the left rail higher (it leans to the right); "
    "needs a vehicle file",
    "metric_antenna_spacing_m": "distance of the two antennas' places less that of the antennas; empty for one antenna",
    "innovation_wheel_m": "way of the wheel since the epoch before less the predicted one",
    "innovation_radar_m": "the same of the radar",
    "innovation_force_mps2": "mean specific force forward less the predicted one",
    "innovation_place_m": "place by a feature of the line less the predicted one",
    "innovation_range_m": "range to a ground unit less the predicted one",
}

#: Columns that smoothing adds (`railfix run --smooth`).
SMOOTHED_COLUMNS: Final[dict[str, str]] = {
    "smoothed_chainage_m": "distance along the line by everything measured before and after the epoch",
    "smoothed_sigma_m": "its standard deviation",
    "smoothed_speed_mps": "speed along the line, in the same way",
}


def train_table(result: Result) -> pl.DataFrame:
    """Return the positions of the filter along the track, one row per epoch and antenna in order of time.

    Parameters
    ----------
    result : Result

    Returns
    -------
    polars.DataFrame
        Columns of `TRAIN_COLUMNS`; without rows where the filter is off.
    """
    parts = [antenna_train(name, tracked) for name, tracked in result.fusion.items()]
    return in_time_order(parts) if parts else pl.DataFrame()


def with_smoothed(table: pl.DataFrame, smoothed: Mapping[str, pl.DataFrame]) -> pl.DataFrame:
    """Return rows of the table with `SMOOTHED_COLUMNS`.

    Parameters
    ----------
    table : polars.DataFrame
        Rows of `train_table`.
    smoothed : mapping of str to polars.DataFrame
        By antenna; its rows in the same order.
    """
    antenna = table["antenna"].to_numpy()
    values = {name: np.full(len(table), np.nan) for name in SMOOTHED_COLUMNS}
    for name, rows in smoothed.items():
        mine = antenna == name
        for column, whole in values.items():
            whole[mine] = rows[column].fill_null(np.nan).to_numpy()
    return table.with_columns(**{name: float_column(column) for name, column in values.items()})


def smoothed_table(result: SmoothedTrack, trajectory: Trajectory) -> pl.DataFrame:
    """Return `SMOOTHED_COLUMNS` of one antenna, one row per epoch."""
    inside = on_line_m(result, trajectory)
    return pl.DataFrame(
        {
            "smoothed_chainage_m": float_column(trajectory.chainage_at(inside)),
            "smoothed_sigma_m": float_column(result.sigma_m),
            "smoothed_speed_mps": float_column(result.speed_mps),
        }
    )


def antenna_train(name: str, result: AlongTrack) -> pl.DataFrame:
    """Return the filtered positions of one antenna, one row per epoch."""
    tracked, epochs = result.tracked, len(result)
    words = pl.Series(values=[s.text for s in TrackStatus], dtype=TRACK_STATUS_TYPE)
    directions = pl.Series(values=DIRECTION_TYPE.categories, dtype=DIRECTION_TYPE)
    states = pl.Series(values=MOTION_TYPE.categories, dtype=MOTION_TYPE)
    kinds = [*(kind.name.lower() for kind in Kind), "carry"]
    with_wheel = tracked.used[:, Kind.WHEEL] > 0
    carried = with_wheel & np.isin(result.sensed.state, CARRIED)
    has = np.column_stack([tracked.used > 0, carried])
    has[:, Kind.WHEEL] &= ~carried
    used, which = np.unique(has, axis=0, return_inverse=True)
    texts = pl.Series(values=["+".join(np.array(kinds)[row]) for row in used], dtype=pl.String)
    return pl.DataFrame(
        {
            "time_gpst": pl.Series(values=np.array(result.time)),
            "antenna": pl.Series(values=[name], dtype=pl.String).new_from_index(0, epochs),
            "status": words.gather(pl.Series(values=tracked.status.astype(np.uint32))),
            "chainage_m": float_column(result.chainage_m),
            "kilometrage_m": float_column(result.kilometrage_m),
            "along_sigma_m": float_column(tracked.sigma_m),
            "speed_mps": float_column(tracked.speed_mps),
            "speed_sigma_mps": float_column(tracked.speed_sigma_mps),
            "acceleration_mps2": float_column(tracked.acceleration_mps2),
            "direction": directions.gather(pl.Series(values=(result.direction + 1).astype(np.uint32))),
            "standstill": pl.Series(values=result.standstill),
            "branch_probability": float_column(tracked.probability),
            "hypotheses": pl.Series(values=tracked.hypotheses.astype(np.int16)),
            "protection_level_m": float_column(tracked.level_m),
            "protection_noise_m": float_column(tracked.level_noise_m),
            "protection_separation_m": float_column(tracked.separation_m),
            "over_reading_m": float_column(tracked.amount_m),
            "under_reading_m": float_column(tracked.amount_m),
            "motion": states.gather(pl.Series(values=result.sensed.state.astype(np.uint32))),
            "sources": texts.gather(pl.Series(values=which.reshape(-1).astype(np.uint32))),
            "latitude_deg": float_column(result.latitude_deg),
            "longitude_deg": float_column(result.longitude_deg),
            "height_m": float_column(result.height_m),
            **{column: float_column(result.ecef_m[:, axis]) for axis, column in enumerate(("x_m", "y_m", "z_m"))},
            "code_weight": float_column(tracked.code_weight),
            "motion_weight": float_column(tracked.motion_weight),
            "wheel_scale": float_column(tracked.wheel_scale),
            "radar_scale": float_column(tracked.radar_scale),
            "force_offset_mps2": float_column(tracked.force_offset_mps2),
            "map_scale": float_column(tracked.map_scale),
            "measured_chainage_m": float_column(result.sensed.under_m),
            "measured_gradient_permille": float_column(1e3 * result.sensed.gradient),
            "measured_curvature_1pm": float_column(result.sensed.curvature_1pm),
            "measured_cant_mm": float_column(1e3 * result.sensed.cant_m),
            "metric_antenna_spacing_m": float_column(result.spacing_error_m),
            **{
                f"innovation_{kind.name.lower()}_{unit}": float_column(tracked.sensed[:, kind - 3])
                for kind in Kind
                if kind >= Kind.WHEEL
                for unit in ("mps2" if kind is Kind.FORCE else "m",)
            },
        }
    )
