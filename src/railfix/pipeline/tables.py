"""Results as tables: polars for files and analysis, xarray for arrays with names.

Times are GPS time without a time zone, to the nanosecond. Absent values are null in polars and
NaN in xarray.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from railfix.core.reasons import Reason, reason_text
from railfix.pipeline.filter_result import AlongTrack
from railfix.pipeline.result_columns import (
    CHANNEL_COLUMNS,
    OBSERVATION_COLUMNS,
    POSITION_COLUMNS,
    Column,
    Observed,
    decimals,
    table_of,
)
from railfix.pipeline.results import AntennaResult, Result

if TYPE_CHECKING:
    import xarray as xr


def antenna_positions(name: str, result: AntennaResult) -> pl.DataFrame:
    """Return one row an epoch of one antenna, also where there is no position.

    Parameters
    ----------
    name : str
        Goes into the column ``antenna``.

    Returns
    -------
    polars.DataFrame
        Columns of `POSITION_COLUMNS`.
    """
    return table_of(POSITION_COLUMNS, result, len(result.time), antenna=name)


def in_time_order(parts: Sequence[pl.DataFrame]) -> pl.DataFrame:
    """Return the rows of all antennas in order of time, then of the antennas as given."""
    table = pl.concat(parts)
    return table if len(parts) == 1 else table.sort("time_gpst", maintain_order=True)


def positions_table(result: Result) -> pl.DataFrame:
    """Return one row an epoch and antenna, in order of time, then of the antennas as given.

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
    """Return one row an epoch and channel that was observed, of one antenna.

    Parameters
    ----------
    name : str
        Goes into the column ``antenna``.
    tracked : AlongTrack, optional
        Of the filter along the track.

    Returns
    -------
    polars.DataFrame
        Columns of `OBSERVATION_COLUMNS`.
    """
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
        values = column.values(source)
        columns[column.name] = column.series(values[epoch, channel] if isinstance(values, np.ndarray) else values, rows)
    return pl.DataFrame(columns).select(*OBSERVATION_COLUMNS)


def observations_table(result: Result) -> pl.DataFrame:
    """Return one row an epoch, antenna and channel that was observed, in order of time, antenna, satellite.

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
    """Return a table with its floats rounded to what CSV files get: 0.1 mm, 1e-9 deg."""
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
        Of the filter along the track: gives the innovations.
    attributes : mapping, optional
        Put on the dataset (name of the antenna, provenance).

    Returns
    -------
    xarray.Dataset
        Every column of `POSITION_COLUMNS` over ``time`` and of `CHANNEL_COLUMNS` over ``time`` and ``channel``, each
        with its ``units`` and meaning (``long_name``); the positions also as ``ecef_m`` and ``conventional_ecef_m``
        over ``xyz`` and along the trajectory (``arc_m``). ``satellite`` and ``signal`` are coordinates of ``channel``.

    Raises
    ------
    ModuleNotFoundError
        xarray is not installed (``pip install railfix[notebook]``).
    """
    try:
        import xarray as xr
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("xarray is not installed; pip install 'railfix[notebook]'") from error

    def variables(columns: Mapping[str, Column[Any]], source: Any, axes: tuple[str, ...]) -> dict[str, Any]:
        shape = result.reason.shape[: len(axes)]
        return {
            name: (
                axes,
                column.array(column.values(source), shape),
                {"units": column.unit, "long_name": column.meaning},
            )
            for name, column in columns.items()
            if name not in ("time_gpst", "antenna")
        }

    data = variables(POSITION_COLUMNS, result, ("time",))
    data |= variables(CHANNEL_COLUMNS, Observed(result, tracked), ("time", "channel"))
    data["arc_m"] = (("time",), result.arc_m, {"units": "m", "long_name": "distance along the antenna's trajectory"})
    for name, values in (("ecef_m", result.ecef_m), ("conventional_ecef_m", result.conventional_ecef_m)):
        data[name] = (("time", "xyz"), values, {"units": "m"})
    coordinates = {
        "time": result.time,
        "satellite": ("channel", result.satellite),
        "signal": ("channel", result.signal),
        "xyz": ["x", "y", "z"],
    }
    return xr.Dataset(data, coords=coordinates, attrs=dict(attributes or {}))
