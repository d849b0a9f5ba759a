"""Receiver logs as RINEX files, and positions of a run as messages of ROS 2 in an MCAP file.

Definitions are those of sensor_msgs, and of https://github.com/EGNSS-MATE/emate_ros (MIT), commit 9067868 of
16 April 2024, written for ROS 1; the third holds the row of the table.
"""

from __future__ import annotations

import json
from collections import Counter
from io import BytesIO
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import polars as pl
import polars.selectors as cs

from railfix import __version__
from railfix.core.errors import NoPositionError, OutputError
from railfix.core.files import staged_file
from railfix.core.timescale import gpst_to_utc
from railfix.gnss.observations import ObservationHeader
from railfix.io.logs import read_navigation, scan_observations
from railfix.io.positions_export import COORDINATES
from railfix.io.rinex import write_navigation, write_observations
from railfix.io.rinex.write_navigation import with_written_messages
from railfix.run.inputs import LogReading
from railfix.run.output import Overwrite, check_output_file
from railfix.tracking import TrackStatus


def convert_logs(
    logs: tuple[Path, ...],
    *,
    out: Path | None,
    nav_out: Path | None,
    rinex: Literal["3", "4"] = "3",
    reading: LogReading | None = None,
    overwrite: Overwrite = "refuse",
) -> list[str]:
    """Write RINEX files (version 3.04 or 4.02) of the logs of one receiver; return what was written and passed over.

    InputFileError: a log cannot be read or holds nothing of what is asked for. OutputError: a file exists already, is
    an input, or cannot be written.
    """
    if out is not None and nav_out is not None and out.resolve() == nav_out.resolve():
        raise OutputError(f"{out}: is named by --out and by --nav-out; name another file for one of them")
    for target in (out, nav_out):
        if target is not None:
            check_output_file(target, overwrite=overwrite, inputs=logs)
    date = (reading or LogReading()).instant
    version: Literal["3.04", "4.02"] = "3.04" if rinex == "3" else "4.02"
    lines: list[str] = []
    if out is not None:
        header, epochs, skipped = _scan(logs, date)
        pieces = (piece for piece in scan_observations(logs, date=date) if len(piece))
        observables = {
            system: [kind + signal for signal in signals for kind in "CLDS"]
            for system, signals in header.signals.items()
        }
        write_observations(pieces, out, version=version, observables=observables, header=header)
        lines.append(f"wrote {out}: {epochs:,} epochs, RINEX {version}")
        lines += [f"passed over: {count:,} {what}" for what, count in sorted(skipped.items())]
    if nav_out is not None:
        navigation, left_out = with_written_messages(read_navigation(logs, date=date))
        write_navigation(navigation, nav_out, version=version)
        records = len(navigation.kepler) + len(navigation.glonass)
        lines.append(f"wrote {nav_out}: {records:,} ephemerides, RINEX {version}")
        lines += [
            f"passed over: {count:,} {what}" for what, count in sorted({**navigation.skipped, **left_out}.items())
        ]
    return lines


def _scan(logs: tuple[Path, ...], date: np.datetime64 | None) -> tuple[ObservationHeader, int, Counter[str]]:
    """Header with the signals of the whole log, number of epochs, and what is passed over."""
    signals: dict[str, set[str]] = {}
    channels: dict[str, int] = {}
    header, epochs, skipped = ObservationHeader(), 0, Counter[str]()
    for piece in scan_observations(logs, date=date):
        header = piece.header if not epochs else header
        channels |= piece.header.glonass_channel
        epochs += len(piece)
        skipped.update(piece.skipped)
        for name, signal in zip(piece.satellite.tolist(), piece.signal.tolist(), strict=True):
            signals.setdefault(name[0], set()).add(signal)
    joined = {system: tuple(sorted(codes)) for system, codes in sorted(signals.items())}
    values = {name: getattr(header, name) for name in ObservationHeader.__dataclass_fields__}
    return ObservationHeader(**{**values, "signals": joined, "glonass_channel": channels}), epochs, skipped


_RULE: Final = "\n" + "=" * 80 + "\n"
_HEADER: Final = (
    f"{_RULE}MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id"
    f"{_RULE}MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec"
)
_FIX: Final = (
    "std_msgs/Header header\nsensor_msgs/NavSatStatus status\nfloat64 latitude\nfloat64 longitude\nfloat64 altitude\n"
    "float64[9] position_covariance\nuint8 position_covariance_type"
    f"{_HEADER}{_RULE}MSG: sensor_msgs/NavSatStatus\nint8 status\nuint16 service"
)
_TRACK: Final = (
    "std_msgs/Header header\nstring algo_id\nuint16[10] sensor_set\nstring para_set\nint16 status\nstring[] track_id\n"
    "bool movement_direction\nbool orientation\nfloat64 travelled_dist\nfloat64 relative_dist\nfloat64 speed\n"
    "float64 acc\nemate_msgs/CI dist_ci\nemate_msgs/CI speed_ci\nfloat64 cross_track_dist"
    f"{_HEADER}{_RULE}MSG: emate_msgs/CI\nfloat64 overestimation\nfloat64 underestimation"
)
#: `COVARIANCE_TYPE_APPROXIMATED` of sensor_msgs/NavSatFix.
_APPROXIMATED: Final = 1


def write_mcap(rows: pl.DataFrame, path: Path, *, description: str) -> int:
    """Write the rows of a table of positions that have coordinates, three topics an antenna; return their number.

    ``/ANTENNA/fix`` is sensor_msgs/NavSatFix, ``/ANTENNA/row`` has every column, and ``/ANTENNA/track``, of the filter
    alone, is emate_msgs/FusionResultTrack. Stamps are UTC. Absent numbers are NaN, absent texts empty. The file has the
    `description`: what the positions are, and the frame of the coordinates. NoPositionError: no row has coordinates.
    ModuleNotFoundError: mcap-ros2-support is not installed.
    """
    from mcap_ros2.writer import Writer

    known = rows.drop_nulls(COORDINATES)
    if known.is_empty():
        raise NoPositionError(f"{path}: no epoch has a position; nothing was written")
    stamps = gpst_to_utc(known["time_gpst"].to_numpy()).astype(np.int64).tolist()
    table = known.select(
        cs.temporal().dt.to_string("iso:strict"),
        (cs.string() | cs.categorical() | cs.enum()).cast(pl.String).fill_null(""),
        cs.boolean().fill_null(value=False),
        cs.numeric().cast(pl.Float64).fill_null(float("nan")),
    ).select(known.columns)
    steps = pl.col("chainage_m").diff().fill_nan(0.0).fill_null(0.0).abs().cum_sum().over("antenna")
    travelled = table.select(steps).to_series().to_list()
    kinds = {pl.String: "string", pl.Boolean: "bool"}
    fields = [f"{kinds.get(kind.base_type(), 'float64')} {name}" for name, kind in table.schema.items()]
    filtered = "over_reading_m" in table.columns
    file = BytesIO()
    with Writer(file) as writer:
        fix = writer.register_msgdef("sensor_msgs/msg/NavSatFix", _FIX)
        every = writer.register_msgdef("railfix_msgs/msg/Row", "std_msgs/Header header\n" + "\n".join(fields) + _HEADER)
        track = writer.register_msgdef("emate_msgs/msg/FusionResultTrack", _TRACK)
        for stamp, way, row in zip(stamps, travelled, table.iter_rows(named=True), strict=True):
            seconds, nanoseconds = divmod(stamp, 1_000_000_000)
            header = {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": row["antenna"]}
            writer.write_message(f"/{row['antenna']}/fix", fix, {"header": header} | _fix(row), stamp)
            writer.write_message(f"/{row['antenna']}/row", every, {"header": header} | row, stamp)
            if filtered:
                message = {"header": header, "para_set": json.dumps({"description": description})} | _track(row, way)
                writer.write_message(f"/{row['antenna']}/track", track, message, stamp)
        writer.add_metadata("railfix", {"version": __version__, "description": description})
    with staged_file(path) as staged:
        staged.write_bytes(file.getvalue())
    return len(known)


def _fix(row: dict[str, Any]) -> dict[str, Any]:
    """Return the values of sensor_msgs/NavSatFix, with the variance along the line on each axis."""
    return {
        "latitude": row["latitude_deg"],
        "longitude": row["longitude_deg"],
        "altitude": row["height_m"],
        "position_covariance": (np.eye(3) * row["along_sigma_m"] ** 2).ravel().tolist(),
        "position_covariance_type": _APPROXIMATED,
    }


def _track(row: dict[str, Any], travelled_m: float) -> dict[str, Any]:
    """Return the values of emate_msgs/FusionResultTrack: its x axis points to rising chainage."""
    nan = float("nan")
    on_network = bool(row.get("track"))
    return {
        "algo_id": f"railfix {__version__}",
        "status": next(int(status) for status in TrackStatus if status.text == row["status"]),
        "track_id": [row["track"]] if on_network else [],
        "movement_direction": row["direction"] != "falling",
        "orientation": True,
        "travelled_dist": travelled_m,
        "relative_dist": row["track_chainage_m"] if on_network else row["chainage_m"],
        "speed": abs(row["speed_mps"]),
        "acc": row["acceleration_mps2"],
        "dist_ci": {"overestimation": row["over_reading_m"], "underestimation": row["under_reading_m"]},
        "speed_ci": {"overestimation": nan, "underestimation": nan},
        "cross_track_dist": nan,
    }
