"""Convert observations to and from the xarray layout of georinex."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Strings
from railfix.core.errors import check_type
from railfix.core.timescale import bdt_to_gpst, utc_to_gpst
from railfix.gnss.joined_observations import signals_by_system
from railfix.gnss.observations import ObservationHeader, Observations
from railfix.io.rinex.observations_lines import KINDS, find_signal

if TYPE_CHECKING:
    import xarray as xr

_DIMENSIONS: Final = ("time", "sv")
_TYPE: Final = re.compile(r"[CPLDS][1-9ABCD][A-Z]?")


def observations_to_xarray(observations: Observations) -> xr.Dataset:
    """Return observations as a dataset in the layout of georinex.

    Parameters
    ----------
    observations : Observations

    Returns
    -------
    xarray.Dataset
        One variable over ``time`` and ``sv`` for each observation type, NaN where absent. The variables
        ``break_before`` over ``time`` and ``glonass_channel`` over ``sv`` are additions to the layout of georinex. The
        attributes contain the header.
    """
    import xarray as xr

    check_type(observations, Observations, "observations")
    satellites, row = np.unique(observations.satellite, return_inverse=True)
    shape = (len(observations), len(satellites))
    variables: dict[str, Any] = {}
    for kind, name in KINDS.items():
        values = getattr(observations, name)
        for column in np.flatnonzero(np.isfinite(values).any(axis=0)):
            variable = kind + str(observations.signal[column])
            grid = variables.setdefault(variable, (_DIMENSIONS, np.full(shape, np.nan)))[1]
            grid[:, row[column]] = values[:, column]
    for column in np.flatnonzero(observations.loss_of_lock.any(axis=0)):
        variable = f"L{observations.signal[column]}lli"
        grid = variables.setdefault(variable, (_DIMENSIONS, np.full(shape, np.nan)))[1]
        grid[:, row[column]] = observations.loss_of_lock[:, column]
    header = observations.header
    channels = [header.glonass_channel.get(name, np.nan) for name in satellites.tolist()]
    return xr.Dataset(
        variables
        | {"break_before": ("time", observations.break_before), "glonass_channel": ("sv", np.array(channels, float))},
        coords={"time": observations.time, "sv": satellites},
        attrs={
            "version": header.version,
            "interval": header.interval_s,
            "rinextype": "obs",
            "time_system": "GPS",
            "position": header.approximate_ecef_m.tolist(),
            "antenna_delta_hen_m": header.antenna_delta_hen_m.tolist(),
            "marker": header.marker,
            "receiver": header.receiver,
            "antenna": header.antenna,
            "receiver_clock_offset_applied": int(header.receiver_clock_applied),
        },
    )


def observations_from_xarray(data: xr.Dataset) -> Observations:
    """Return the observations of a dataset in the layout of georinex.

    Parameters
    ----------
    data : xarray.Dataset
        Dataset returned by ``georinex.load``, preferably with ``useindicators=True``. Without indicators, the
        observations have no loss-of-lock flags.

    Returns
    -------
    Observations
        Channels with at least one observation, sorted by satellite, then signal. RINEX 2 types are mapped to signals as
        in `read_observations`. Times are GPS time, truncated to 1 us by georinex.

    Raises
    ------
    ValueError
        The dataset has no observation types over ``time`` and ``sv``, its time system is unknown, or its times do not
        increase strictly.
    """
    import xarray as xr

    check_type(data, xr.Dataset, "data")
    types = [str(name) for name in data.data_vars if _TYPE.fullmatch(str(name))]
    if not types:
        raise ValueError("the dataset has no observation types such as C1C; load an observation file by georinex.load")
    time = _gps_time(data)
    satellites = np.array([str(name) for name in data["sv"].values], dtype="<U3")
    version = float(data.attrs.get("version", 3.0 if any(len(name) == 3 for name in types) else 2.0))
    columns: dict[tuple[str, str], dict[str, Floats]] = {}
    for name in types:
        values = np.asarray(data[name].transpose(*_DIMENSIONS).values, dtype=np.float64)
        flags = data.get(f"{name}lli")
        lock = None if flags is None else np.asarray(flags.transpose(*_DIMENSIONS).values, dtype=np.float64)
        for k in np.flatnonzero(np.isfinite(values).any(axis=0)):
            own = str(satellites[k])
            code = find_signal(name, system=own[0], version=version, declared=types)
            if code is None:
                continue
            channel = columns.setdefault((own, code), {})
            channel.setdefault("C" if name[0] == "P" else name[0], values[:, k])
            if lock is not None:
                channel.setdefault("lock", lock[:, k])
    keys = sorted(columns)
    absent = np.full(len(time), np.nan)

    def grid(kind: str) -> Floats:
        values = np.stack([columns[key].get(kind, absent) for key in keys], axis=1)
        return np.where(values == 0.0, np.nan, values)

    breaks = data.get("break_before")
    satellite, signal = (np.array([key[i] for key in keys], dtype=kind) for i, kind in enumerate(("<U3", "<U2")))
    return Observations(
        time=time,
        satellite=satellite,
        signal=signal,
        code_m=grid("C"),
        phase_cycles=grid("L"),
        doppler_hz=grid("D"),
        cn0_dbhz=grid("S"),
        loss_of_lock=np.nan_to_num(grid("lock")).astype(np.uint8),
        break_before=np.zeros(len(time), dtype=np.bool_) if breaks is None else np.array(breaks.values, dtype=np.bool_),
        header=_observation_header(data, satellite, signal, version),
    )


def _gps_time(data: xr.Dataset) -> Datetimes:
    """Return the times of an observation dataset in GPS time."""
    time: Datetimes = np.asarray(data["time"].values, dtype="datetime64[ns]")
    system = str(data.attrs.get("time_system", "GPS"))
    if system in ("GLO", "UTC"):
        time = utc_to_gpst(time)
    elif system == "BDT":
        time = bdt_to_gpst(time)
    elif system not in ("GPS", "GAL", "QZS"):
        raise ValueError(f"time_system is {system!r}; GPS, GAL, QZS, BDT, GLO or UTC was expected")
    if (np.diff(time) <= np.timedelta64(0, "ns")).any():
        raise ValueError("time must rise strictly; sort the dataset by time and drop repeated epochs")
    return time


def _observation_header(data: xr.Dataset, satellite: Strings, signal: Strings, version: float) -> ObservationHeader:
    attributes = data.attrs
    channels = data.get("glonass_channel")
    position = np.array(attributes.get("position", np.full(3, np.nan)), dtype=np.float64)
    return ObservationHeader(
        version=version,
        marker=str(attributes.get("marker", "")),
        receiver=str(attributes.get("receiver", "")),
        antenna=str(attributes.get("antenna", "")),
        approximate_ecef_m=np.where(np.any(position != 0.0), position, np.nan),
        antenna_delta_hen_m=np.array(attributes.get("antenna_delta_hen_m", np.zeros(3)), dtype=np.float64),
        interval_s=float(attributes.get("interval", np.nan)),
        glonass_channel={}
        if channels is None
        else {str(sv): int(k) for sv, k in zip(data["sv"].values, channels.values, strict=True) if np.isfinite(k)},
        signals=signals_by_system(satellite, signal),
        receiver_clock_applied=bool(attributes.get("receiver_clock_offset_applied", 0)),
    )
