"""Conversion of receiver logs to RINEX, and of the positions of a run to ROS 2 messages and EGNSS MATE tables.

The ROS 2 message definitions are from sensor_msgs and from https://github.com/EGNSS-MATE/emate_ros (MIT, commit 9067868
of 16 April 2024, for ROS 1). A further message, railfix_msgs/Row, contains one row of the table of positions.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import polars as pl
import polars.selectors as cs

from railfix import __version__
from railfix.core.errors import NoPositionError, OutputError
from railfix.core.extras import needs_extra
from railfix.core.staged_files import stage_file
from railfix.core.utc import gpst_to_utc
from railfix.gnss.observations import ObservationHeader
from railfix.io.logs import read_navigation, scan_observations
from railfix.io.mate import WRITTEN, mate_table
from railfix.io.positions_export import COORDINATES
from railfix.io.rinex import write_navigation, write_observations
from railfix.io.rinex.navigation_writer import with_written_messages
from railfix.run.inputs import LogReading
from railfix.run.output import OutputFolder, Overwrite, check_output_file
from railfix.track import Track
from railfix.track.quality import section_spans
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
    """Write the logs of one receiver as RINEX files. Return lines of text on the written files and the skipped items.

    Observations are written to `out`, and ephemerides to `nav_out`; a file whose path is None is not written. `rinex`
    selects version 3.04 or 4.02. Raise InputFileError if a log cannot be read, or if the logs lack the data for one of
    the files. Raise OutputError if `out` and `nav_out` are the same file, or if one of them exists already (with
    "refuse"), is an input, or cannot be written.
    """
    if out is not None and nav_out is not None and out.resolve() == nav_out.resolve():
        raise OutputError(f"{out}: is given by both --out and --nav-out; give another file for one of them")
    for target in (out, nav_out):
        if target is not None:
            check_output_file(target, overwrite=overwrite, inputs=logs)
    reading = reading or LogReading()
    version: Literal["3.04", "4.02"] = "3.04" if rinex == "3" else "4.02"
    lines: list[str] = []
    if out is not None:
        header, epochs, skipped, problems = _scan(logs, reading)
        pieces = (piece for piece in scan_observations(logs, **reading.of_observations) if len(piece))
        observables = {
            system: [kind + signal for signal in signals for kind in "CLDS"]
            for system, signals in header.signals.items()
        }
        write_observations(pieces, out, version=version, observables=observables, header=header)
        lines.append(f"wrote {out}: {epochs:,} epochs, RINEX {version}")
        lines += [f"skipped {count:,} {what}" for what, count in sorted(skipped.items())]
        lines += [f"note: {problem}" for problem in problems]
    if nav_out is not None:
        navigation, left_out = with_written_messages(read_navigation(logs, **reading.arguments), version)
        write_navigation(navigation, nav_out, version=version)
        records = len(navigation.kepler) + len(navigation.glonass)
        lines.append(f"wrote {nav_out}: {records:,} ephemerides, RINEX {version}")
        lines += [f"skipped {count:,} {what}" for what, count in sorted({**navigation.skipped, **left_out}.items())]
    return lines


def _scan(logs: tuple[Path, ...], reading: LogReading) -> tuple[ObservationHeader, int, Counter[str], list[str]]:
    """Return the header with the signals of the whole log, the number of epochs, counts of skipped items, and notes."""
    signals: dict[str, set[str]] = {}
    channels: dict[str, int] = {}
    header, epochs, skipped, problems = ObservationHeader(), 0, Counter[str](), list[str]()
    for piece in scan_observations(logs, **reading.of_observations):
        header = piece.header if not epochs else header
        channels |= piece.header.glonass_channel
        epochs += len(piece)
        skipped.update(piece.skipped)
        problems += piece.problems
        for name, signal in zip(piece.satellite.tolist(), piece.signal.tolist(), strict=True):
            signals.setdefault(name[0], set()).add(signal)
    joined = {system: tuple(sorted(codes)) for system, codes in sorted(signals.items())}
    return replace(header, signals=joined, glonass_channel=channels), epochs, skipped, problems


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
    """Write a table of positions as ROS 2 messages in an MCAP file. Return the number of rows written.

    Only rows with coordinates are written. Each antenna has the topics ``/ANTENNA/fix`` (sensor_msgs/NavSatFix),
    ``/ANTENNA/row`` (all columns) and, for filtered positions, ``/ANTENNA/track`` (emate_msgs/FusionResultTrack). Time
    stamps are UTC. Absent numbers are NaN; absent strings are empty. `description` states the kind of positions and the
    reference frame in the file. Raise NoPositionError if no row has coordinates, and SettingsError if mcap-ros2-support
    is not installed.
    """
    with needs_extra():
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
    with stage_file(path) as staged:
        staged.write_bytes(file.getvalue())
    return len(known)


def _fix(row: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a sensor_msgs/NavSatFix message. The variance along the line is used for all three axes."""
    return {
        "latitude": row["latitude_deg"],
        "longitude": row["longitude_deg"],
        "altitude": row["height_m"],
        "position_covariance": (np.eye(3) * row["along_sigma_m"] ** 2).ravel().tolist(),
        "position_covariance_type": _APPROXIMATED,
    }


def _track(row: dict[str, Any], travelled_m: float) -> dict[str, Any]:
    """Return the values of an emate_msgs/FusionResultTrack message; its x axis points toward rising chainage."""
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


def result_tables(train: pl.DataFrame, passings: pl.DataFrame | None, track: Track) -> dict[str, pl.DataFrame]:
    """Return the EGNSS MATE tables R_TRACK and R_ETCS_TPR of the first antenna of a run.

    `train` and `passings` are tables of the run. The last relevant balise group (LRBG) of a row is the group that was
    read last according to `passings`; before the first reading, the LRBG is null. Each section of the track is written
    as one track edge.
    """
    rows = train.filter((pl.col("antenna") == pl.col("antenna").first()) & pl.col("chainage_m").is_not_null())
    chainage, speed = rows["chainage_m"].to_numpy(), rows["speed_mps"].to_numpy()
    spans = np.array(section_spans(track))
    edge = np.clip(np.searchsorted(spans.max(axis=1), chainage), 0, len(spans) - 1)
    names = [source.removesuffix(")").partition(" (")[2] or Path(source).stem for source in track.sections]
    statuses = {status.text: int(status) for status in TrackStatus}
    steps = np.abs(np.diff(chainage, prepend=chainage[:1]))
    common = {
        "ALGORITHM_ID": pl.lit(f"railfix {__version__}"),
        "SENSOR_SET": pl.lit([], dtype=pl.List(pl.Int64)),
        "PARAMETER_SET": pl.lit(json.dumps({"Reference_System": track.provenance.crs})),
        "TIMESTAMP_UTC": pl.Series(gpst_to_utc(rows["time_gpst"].to_numpy()), dtype=pl.Datetime("us")),
        "STATUS": rows["status"].cast(pl.String).replace_strict(statuses, return_dtype=pl.Int64),
        "TRAVELLED_DISTANCE": _metres(np.cumsum(steps)),
        "SPEED": _metres(np.abs(speed)),
        "ACCELERATION": rows["acceleration_mps2"].round(3),
    }
    doubt = {"OVER": rows["over_reading_m"].round(3), "UNDER": rows["under_reading_m"].round(3)}
    rising = rows["direction"].cast(pl.String).replace_strict({"rising": True, "falling": False}, default=None)
    on_track = common | {
        "TRACK_ID": pl.Series([[names[k]] for k in edge.tolist()], dtype=pl.List(pl.String)),
        "MOVEMENT_DIRECTION": rising,
        "RELATIVE_DISTANCE": _metres(np.abs(chainage - spans[edge, 0])),
        "OVERESTIMATION_DISTANCE": doubt["OVER"],
        "UNDERESTIMATION_DISTANCE": doubt["UNDER"],
    }
    last = _last_balise(rows, passings)
    beyond = chainage - last["chainage_m"].to_numpy()
    to_etcs = common | {
        "NID_LRBG_C": last["balise"].str.split("-").list.get(0, null_on_oob=True).cast(pl.Int64, strict=False),
        "NID_LRBG_BG": last["balise"].str.split("-").list.get(1, null_on_oob=True).cast(pl.Int64, strict=False),
        "NID_LRBG_PIG": pl.when(last["balise"].is_not_null()).then(0),
        "D_LRBG": _metres(np.abs(beyond)),
        "Q_DLRBG": pl.Series(np.where(np.isnan(beyond), 2, beyond >= 0.0).astype(np.int64)),
        "Q_DIRTRAIN": rising.cast(pl.Int64).fill_null(2),
        "L_DOUBTOVER": doubt["OVER"],
        "L_DOUBTUNDER": doubt["UNDER"],
    }
    return {
        "R_TRACK": _columns_of_schema("R_TRACK", rows, on_track),
        "R_ETCS_TPR": _columns_of_schema("R_ETCS_TPR", rows, to_etcs),
    }


def add_mate_results(folder: OutputFolder, track: Track, log: Path) -> None:
    """Write R_TRACK.parquet and R_ETCS_TPR.parquet if the log is an EGNSS MATE table and the filter was used."""
    train = folder.staging / "train.parquet"
    if not (mate_table(log) and train.exists()):
        return
    passings = folder.staging / "passings.parquet"
    found = result_tables(pl.read_parquet(train), pl.read_parquet(passings) if passings.exists() else None, track)
    for name, table in found.items():
        table.write_parquet(folder.stage(f"{name}.parquet"))


def _metres(values: np.ndarray) -> pl.Series:
    return pl.Series(values=np.round(values, 3), nan_to_null=True)


def _last_balise(rows: pl.DataFrame, passings: pl.DataFrame | None) -> pl.DataFrame:
    """For each row, return the balise that was read last (null if none) and its chainage (NaN if none)."""
    empty = pl.DataFrame(schema={"read_gpst": pl.Datetime("ns"), "balise": pl.String, "chainage_m": pl.Float64})
    read = empty if passings is None else passings.filter(pl.col("verdict") == "read").select(empty.columns)
    times = rows.select(pl.col("time_gpst").cast(pl.Datetime("ns")))
    found = times.join_asof(read.sort("read_gpst"), left_on="time_gpst", right_on="read_gpst", strategy="backward")
    return found.with_columns(pl.col("chainage_m").fill_null(np.nan))


def _columns_of_schema(table: str, rows: pl.DataFrame, values: dict[str, Any]) -> pl.DataFrame:
    """Return a table with the columns of the EGNSS MATE schema, in schema order. Columns without values are null."""
    return rows.select(**{name: values.get(name, pl.lit(None)) for name in WRITTEN[table]})
