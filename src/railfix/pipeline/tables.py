"""Results as tables: polars for files and analysis, xarray for arrays with names.

Times are GPS time without a time zone, to the nanosecond. Absent values are null in polars and
NaN in xarray.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import polars as pl
from numpy.typing import NDArray

from railfix.core.arrays import Floats
from railfix.core.reasons import Reason, Status, reason_text
from railfix.integrity.protection import Cause, LevelStatus
from railfix.integrity.raim import Outcome
from railfix.pipeline.along_track import AlongTrack, innovations
from railfix.pipeline.level_stage import BASES, KINDS
from railfix.pipeline.results import AntennaResult, Result
from railfix.screens import SCREENS

if TYPE_CHECKING:
    import xarray as xr

#: Words of the column ``status``.
STATUS_TYPE: Final = pl.Enum([s.text for s in Status])
#: Words of the column ``raim_outcome``.
OUTCOME_TYPE: Final = pl.Enum([o.name.lower() for o in Outcome])
#: Words of the column ``protection_kind``.
KIND_TYPE: Final = pl.Enum(KINDS)
#: Words of the column ``protection_basis``.
BASIS_TYPE: Final = pl.Enum(BASES)
#: Words of the column ``protection_cause``, and of ``protection_status``.
CAUSE_TYPE: Final = pl.Enum([c.name.lower() for c in Cause])
LEVEL_STATUS_TYPE: Final = pl.Enum([s.name.lower() for s in LevelStatus])
#: Decimals written to CSV: 0.1 mm, and the same in degrees.
CSV_DECIMALS_M: Final = 4
CSV_DECIMALS_DEG: Final = 9


def _screen_columns(table: str) -> dict[str, str]:
    """Return the columns of a table that the screens fill, with their meaning."""
    return {c.name: c.meaning for screen in SCREENS for c in screen.columns if c.table == table}


#: Columns of the table of positions, with their unit and meaning.
POSITION_COLUMNS: Final[dict[str, str]] = {
    "time_gpst": "time tag of the receiver, GPS time",
    "antenna": "`front` or `rear`",
    "status": "see `railfix.core.reasons.Status`",
    "chainage_m": "distance along the line from the first point of the track",
    "kilometrage_m": "the line's own marking, where the track has one",
    "along_sigma_m": "standard deviation along the line; with the other place of an ambiguous epoch by its probability",
    "own_sigma_m": "single-epoch sigma: standard deviation from the codes of the epoch alone; "
    "`uncertain` above its limit",
    "latitude_deg": "antenna, WGS 84",
    "longitude_deg": "antenna, WGS 84",
    "height_m": "antenna, above the ellipsoid",
    "x_m": "antenna, ECEF",
    "y_m": "antenna, ECEF",
    "z_m": "antenna, ECEF",
    "n_used": "satellites used",
    "n_rejected": "satellites with a pseudorange that were not used",
    "noise_scale": "noise of this receiver over that of the weights, estimated so far",
    "raim_outcome": "result of RAIM: "
    "`passed`, `excluded_one`, `excluded_two`, `inseparable`, `unresolved`, `untestable`",
    "raim_statistic": "sum of squared residuals before any exclusion, in noise variances (m^2 with the fixed limit)",
    "raim_threshold": "threshold of the statistic, above which a fault is detected",
    "raim_level_m": "P4's level: error by a fault that RAIM misses, and by noise; infinite where a satellite is "
    "unchecked, empty where a fault is left or `raim_protection` is off",
    "protection_level_m": "along the line: the error exceeds it with the stated risk, all hypotheses together; "
    "infinite where `protection_cause` says why, empty where a fault is left",
    "protection_fault_free_m": "what noise without a fault asks for by itself, of its share of the risk; "
    "`protection_level_m` spends the whole risk on the sum of all and may be smaller than a part",
    "protection_one_fault_m": "the same for a fault of one satellite; 0 where that is less likely than its share",
    "protection_two_faults_m": "the same for faults of two satellites; 0 where that is less likely than its share",
    "protection_k_fault_free": "K of the first part",
    "protection_k_one_fault": "K of the second part, beside its threshold",
    "protection_k_two_faults": "K of the third part, beside its threshold",
    "protection_separation": "largest distance of the position without the satellites of a hypothesis, over its "
    "threshold",
    "protection_kind": "basis: `sbas`, its integrity and hypotheses of local faults; or `separation`, "
    "hypotheses of satellites' own faults as well",
    "protection_basis": "`measured`: the priors of faults were measured on the line; `indicative`: they are assumed, "
    "the one of a side of the track without support by data, and the level carries no risk an hour",
    "protection_cause": "what sets the level: `fault_free`, `one_fault`, `two_faults`, `three_faults` or more; or why "
    "there is none: `unchecked`, `unchecked_constellation`, `unchecked_side`, `unchecked_map`, `unchecked_together` "
    "(faults that nothing checks, by what they share), `budget`, `unbounded`, `no_position`",
    "protection_status": "`available` within the alarm limit; `unavailable`, also where the status has a doubt about "
    "the place; `alarm`: the ranges contradict the level, or a check has failed",
    **_screen_columns("positions"),
    "conventional_chainage_m": "3-D single point, moved to the nearest point of the trajectory",
    "conventional_offset_m": "distance of the 3-D single point from that point",
    "map_offset_across_m": "mean of the 3-D positions of the last minutes, right of the line in the direction of "
    "rising chainage; empty for the first minute",
    "map_offset_up_m": "the same, above the line",
    "map_detectable_across_m": "smallest offset of the map across the line that the status `map_offset` names (99 %)",
    "map_detectable_up_m": "the same, in height",
    "map_offset_statistic": "square of that offset in its own sigmas (noise, satellites, atmosphere, stated error of "
    "the map); status `map_offset` from 13.8 on",
    "conventional_x_m": "3-D single point, ECEF",
    "conventional_y_m": "3-D single point, ECEF",
    "conventional_z_m": "3-D single point, ECEF",
}

#: Columns of the table of observations, with their unit and meaning.
OBSERVATION_COLUMNS: Final[dict[str, str]] = {
    "time_gpst": "time tag of the receiver, GPS time",
    "antenna": "`front` or `rear`",
    "satellite": "`G01`, `J02`",
    "signal": "RINEX 3 code without its type letter, `1C`",
    "reason": "bits of `railfix.core.reasons.Reason`, 0 = used",
    "reason_text": "their names joined by `+`, `used` for 0",
    "residual_m": "corrected pseudorange minus what the position on the line and the clock explain",
    "elevation_deg": "elevation of the satellite",
    "azimuth_deg": "azimuth of the satellite, from north over east",
    "cn0_dbhz": "carrier-to-noise density",
    "sigma_m": "standard deviation that the weights assume",
    "corrected_code_m": "pseudorange, satellite clock, group delay and atmosphere applied",
    **_screen_columns("observations"),
    "raim_own_error_m": "screen `raim`: error against all other ranges, of satellites named as faulty; empty where the "
    "robust fit rejected them",
    "innovation_code_m": "filter along the track: code less what earlier epochs predict, where codes count (once a "
    "second)",
    "innovation_phase_m": "the same of the change of the carrier phase since the epoch before",
    "innovation_doppler_mps": "the same of the Doppler",
    "weight_code": "weight of the code in the filter; 1 is that of an error of one standard deviation",
}

#: Results with one value an epoch, and with one an epoch and channel.
_OF_EPOCH: Final = (
    *(
        "chainage_m",
        "kilometrage_m",
        "arc_m",
        "along_sigma_m",
        "own_sigma_m",
        "latitude_deg",
        "longitude_deg",
        "height_m",
    ),
    *("n_used", "n_rejected", "noise_scale", "conventional_chainage_m", "conventional_offset_m"),
)
_OF_CHANNEL: Final = (
    *("reason", "residual_m", "elevation_deg", "azimuth_deg", "cn0_dbhz", "sigma_m", "corrected_code_m"),
)


def float_column(values: Floats) -> pl.Series:
    """A column of floats, NaN as null."""
    return pl.Series(values=np.ascontiguousarray(values, dtype=np.float64), nan_to_null=True)


def antenna_positions(name: str, result: AntennaResult) -> pl.DataFrame:
    """One row an epoch of one antenna, also where there is no position.

    Parameters
    ----------
    name : str
        Goes into the column ``antenna``.
    result : AntennaResult

    Returns
    -------
    polars.DataFrame
        Columns of `POSITION_COLUMNS`.
    """
    epochs = len(result.time)
    words = pl.Series(values=[s.text for s in Status], dtype=STATUS_TYPE)
    columns: dict[str, pl.Series] = {
        "time_gpst": pl.Series(values=np.array(result.time)),
        "antenna": pl.Series(values=[name], dtype=pl.String).new_from_index(0, epochs),
        "status": words.gather(pl.Series(values=result.status.astype(np.uint32))),
    }
    for column in (
        "chainage_m",
        "kilometrage_m",
        "along_sigma_m",
        "own_sigma_m",
        "latitude_deg",
        "longitude_deg",
        "height_m",
    ):
        columns[column] = float_column(getattr(result, column))
    for axis, column in enumerate(("x_m", "y_m", "z_m")):
        columns[column] = float_column(result.ecef_m[:, axis])
    columns["n_used"] = pl.Series(values=result.n_used.astype(np.int16))
    columns["n_rejected"] = pl.Series(values=result.n_rejected.astype(np.int16))
    columns["noise_scale"] = float_column(result.noise_scale)
    columns |= _raim_columns(result)
    columns["conventional_chainage_m"] = float_column(result.conventional_chainage_m)
    columns["conventional_offset_m"] = float_column(result.conventional_offset_m)
    columns["map_offset_across_m"] = float_column(result.map_offset.across_m)
    columns["map_offset_up_m"] = float_column(result.map_offset.up_m)
    columns["map_detectable_across_m"] = float_column(result.map_offset.detectable_m[:, 0])
    columns["map_detectable_up_m"] = float_column(result.map_offset.detectable_m[:, 1])
    columns["map_offset_statistic"] = float_column(result.map_offset.statistic)
    for axis, column in enumerate(("conventional_x_m", "conventional_y_m", "conventional_z_m")):
        columns[column] = float_column(result.conventional_ecef_m[:, axis])
    return pl.DataFrame(columns)


def _raim_columns(result: AntennaResult) -> dict[str, pl.Series]:
    """Verdicts on the positions: RAIM, and the spacing of the antennas."""
    words = pl.Series(values=[o.name.lower() for o in Outcome], dtype=OUTCOME_TYPE)
    screens = _screen_arrays(result, "positions")
    return {
        "raim_outcome": words.gather(pl.Series(values=result.raim.outcome.astype(np.uint32))),
        "raim_statistic": float_column(result.raim.statistic),
        "raim_threshold": float_column(result.raim.threshold),
        "raim_level_m": float_column(result.raim.protection_level_m),
        **_protection_columns(result),
        **{name: float_column(np.full(len(result), np.nan) if v is None else v) for name, v in screens.items()},
    }


#: Columns of the protection level by its fields.
_OF_LEVEL: Final = {
    "protection_level_m": "level_m",
    "protection_fault_free_m": "fault_free_m",
    "protection_one_fault_m": "one_fault_m",
    "protection_two_faults_m": "two_fault_m",
    "protection_k_fault_free": "k_fault_free",
    "protection_k_one_fault": "k_one_fault",
    "protection_k_two_faults": "k_two_faults",
    "protection_separation": "separation",
}


def _protection_columns(result: AntennaResult) -> dict[str, pl.Series]:
    """The protection level, its parts, and what it means; all null where it is off."""
    protection, epochs = result.protection, len(result)
    words = {
        "protection_cause": (CAUSE_TYPE, None if protection is None else protection.level.cause),
        "protection_status": (LEVEL_STATUS_TYPE, None if protection is None else protection.status),
    }
    columns = {
        name: float_column(np.full(epochs, np.nan) if protection is None else getattr(protection.level, field))
        for name, field in _OF_LEVEL.items()
    }
    named = pl.Series(values=[None if protection is None else protection.kind], dtype=KIND_TYPE)
    columns["protection_kind"] = named.new_from_index(0, epochs)
    basis = pl.Series(values=[None if protection is None else protection.basis], dtype=BASIS_TYPE)
    columns["protection_basis"] = basis.new_from_index(0, epochs)
    for name, (kind, values) in words.items():
        if values is None:
            columns[name] = pl.Series(values=[None], dtype=kind).new_from_index(0, epochs)
        else:
            listed = pl.Series(values=kind.categories, dtype=kind)
            columns[name] = listed.gather(pl.Series(values=values.astype(np.uint32)))
    return columns


def in_time_order(parts: Sequence[pl.DataFrame]) -> pl.DataFrame:
    """Return the rows of all antennas in order of time, then of the antennas as given."""
    table = pl.concat(parts)
    return table if len(parts) == 1 else table.sort("time_gpst", maintain_order=True)


def positions_table(result: Result) -> pl.DataFrame:
    """One row an epoch and antenna, in order of time, then of the antennas as given.

    Parameters
    ----------
    result : Result

    Returns
    -------
    polars.DataFrame
        Columns of `POSITION_COLUMNS`.
    """
    parts = [antenna_positions(name, antenna) for name, antenna in result.antennas.items()]
    return in_time_order(parts)


def antenna_observations(name: str, result: AntennaResult, tracked: AlongTrack | None = None) -> pl.DataFrame:
    """One row an epoch and channel that was observed, of one antenna.

    Parameters
    ----------
    name : str
        Goes into the column ``antenna``.
    result : AntennaResult
    tracked : AlongTrack, optional
        Of the filter along the track.

    Returns
    -------
    polars.DataFrame
        Columns of `OBSERVATION_COLUMNS`.
    """
    epoch, channel = np.nonzero((result.reason & Reason.NOT_OBSERVED) == 0)
    reason = result.reason[epoch, channel]
    values, inverse = np.unique(reason, return_inverse=True)
    texts = pl.Series(values=[reason_text(int(v)) for v in values], dtype=pl.String)
    of_channel = pl.Series(values=channel.astype(np.uint32))
    columns: dict[str, pl.Series] = {
        "time_gpst": pl.Series(values=result.time[epoch]),
        "antenna": pl.Series(values=[name], dtype=pl.String).new_from_index(0, len(epoch)),
        "satellite": pl.Series(values=result.satellite.tolist(), dtype=pl.String).gather(of_channel),
        "signal": pl.Series(values=result.signal.tolist(), dtype=pl.String).gather(of_channel),
        "reason": pl.Series(values=reason.astype(np.int32)),
        "reason_text": texts.gather(pl.Series(values=inverse.astype(np.uint32))),
    }
    for column in ("residual_m", "elevation_deg", "azimuth_deg", "cn0_dbhz", "sigma_m", "corrected_code_m"):
        columns[column] = float_column(getattr(result, column)[epoch, channel])
    for column, measured in screen_metrics(result).items():
        columns[column] = float_column(measured[epoch, channel])
    for column, measured in innovations(tracked, result.columns, result.reason.shape).items():
        columns[column] = float_column(measured[epoch, channel])
    return pl.DataFrame(columns)


def screen_metrics(result: AntennaResult) -> dict[str, Floats]:
    """Return the metrics of the screens for each channel, by column of `OBSERVATION_COLUMNS`.

    Parameters
    ----------
    result : AntennaResult

    Returns
    -------
    dict of str to ndarray, shape (T, M)
        NaN where a screen was off or could not judge. Elevation and C/N0 themselves are columns of the result.
    """
    measured = _screen_arrays(result, "observations") | {"raim_own_error_m": result.raim.own_error_m}
    on_all_channels = {name: np.full(result.reason.shape, np.nan) for name in measured}
    for name, values in measured.items():
        if values is not None:
            on_all_channels[name][:, result.columns] = values
    return on_all_channels


def _screen_arrays(result: AntennaResult, table: str) -> dict[str, Floats | None]:
    """Return the arrays of the columns that the screens fill; None where a screen is off."""
    columns = [c for screen in SCREENS for c in screen.columns if c.table == table]
    return {
        c.name: getattr(result.screens[c.verdict], c.field) if c.verdict in result.screens else None for c in columns
    }


def observations_table(result: Result) -> pl.DataFrame:
    """One row an epoch, antenna and channel that was observed, in order of time, antenna, satellite.

    Parameters
    ----------
    result : Result

    Returns
    -------
    polars.DataFrame
        Columns of `OBSERVATION_COLUMNS`.
    """
    parts = [antenna_observations(name, antenna, result.fusion.get(name)) for name, antenna in result.antennas.items()]
    return in_time_order(parts)


def rounded(table: pl.DataFrame) -> pl.DataFrame:
    """A table with its floats rounded to what CSV files get: 0.1 mm, 1e-9 deg."""
    floats = [name for name, kind in table.schema.items() if kind == pl.Float64]
    return table.with_columns(
        pl.col(name).round(CSV_DECIMALS_DEG if name.endswith("_deg") else CSV_DECIMALS_M) for name in floats
    )


def to_xarray(result: AntennaResult, *, attributes: Mapping[str, Any] | None = None) -> xr.Dataset:
    """Results of one antenna as arrays with named axes.

    Parameters
    ----------
    result : AntennaResult
    attributes : mapping, optional
        Put on the dataset (name of the antenna, provenance).

    Returns
    -------
    xarray.Dataset
        Dimensions ``time``, ``channel`` and ``xyz``; ``satellite`` and ``signal`` are coordinates
        of ``channel``.

    Raises
    ------
    ModuleNotFoundError
        xarray is not installed (``pip install railfix[notebook]``).
    """
    try:
        import xarray as xr
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("xarray is not installed; pip install 'railfix[notebook]'") from error
    words = np.array([s.text for s in Status])
    data: dict[str, tuple[tuple[str, ...], NDArray[Any]]] = {"status": (("time",), words[result.status])}
    data |= {name: (("time",), getattr(result, name)) for name in _OF_EPOCH}
    data |= {name: (("time", "xyz"), getattr(result, name)) for name in ("ecef_m", "conventional_ecef_m")}
    data |= {name: (("time", "channel"), getattr(result, name)) for name in _OF_CHANNEL}
    coordinates = {
        "time": result.time,
        "satellite": ("channel", result.satellite),
        "signal": ("channel", result.signal),
        "xyz": ["x", "y", "z"],
    }
    return xr.Dataset(data, coords=coordinates, attrs=dict(attributes or {}))
