"""Explanation of one epoch of a run: position, outcome of each satellite, contributions to sigma and protection level.

Everything is read from the tables of the run. The effect of a satellite is the change of the single-epoch position if
the satellite is omitted. This change is computed from the residuals by weighted least squares, linearised at the
position. The unknowns are the shifts along, across and above the line and one clock per clock group; the map sigmas are
the prior sigmas of the shifts across and above the line (P1 2.2(3)).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl

from railfix.core.arrays import Floats, Strings
from railfix.core.constants import CLOCK_GROUP
from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.geodesy import enu_axes
from railfix.core.staged_files import write_whole
from railfix.core.tables import number, reading_table
from railfix.core.timescale import gps_time
from railfix.evaluate.evaluation_inputs import RunFolder, read_run
from railfix.evaluate.place import read_run_track
from railfix.report.charts_page import page_style, read_template
from railfix.track import Trajectory

#: Explanation of each status of a single epoch.
SINGLE_STATUS: Final[Mapping[str, str]] = {
    "ok": "passed every check",
    "ambiguous": "another position on the line fits the ranges equally well",
    "off_map": "the position is beyond an end of the map, or too far from the position computed without the map",
    "map_end": "the position was moved to an end of the map, because the ranges place it slightly beyond that end",
    "too_few_satellites": "no position: too few usable satellites",
    "unobservable": "no position: the satellite geometry does not determine the position along the line",
    "no_convergence": "no position: the iteration did not converge",
    "no_observation": "no position: the antenna has no observation",
    "inconsistent": "the ranges are inconsistent, and no exclusion resolves the inconsistency",
    "antennas_disagree": "the distance between the positions of both antennas differs too much from their spacing",
    "uncertain": "the standard deviation of the position exceeds the limit",
    "map_offset": "the positions of the last minutes lie off the line: the map is wrong here, or the train is on "
    "another track",
    "jamming_suspected": "the position passed every check, but the signals are jammed (column interference_causes)",
    "spoofing_suspected": "the signals may come from a spoofer (column interference_causes)",
}
#: Explanation of each status of the filter.
FILTER_STATUS: Final[Mapping[str, str]] = {
    "tracking": "one position, from measurements of this epoch",
    "several_branches": "several positions are possible; the most probable one is given",
    "coasting": "predicted: no measurement of this epoch was accepted",
    "lost": "measurements contradict the track, and the line is searched for other positions",
    "expired": "no position: dead reckoning has lasted too long",
    "not_started": "no position yet: no epoch so far had redundant codes",
    "off_map": "no position: the positions from satellites have been off the line for some time",
    "map_offset": "the positions of the last minutes lie off the line: the map is wrong here, or the train is on "
    "another track",
    "antennas_disagree": "the distance between the positions of both antennas differs too much from their spacing",
    "doubtful": "measurements contradict the position or its protection level, and the error is not bounded",
    "spoofing_suspected": "the signals may come from a spoofer, and the error is not bounded",
}
#: Columns of `Explanation.satellites` with the effect of omitting the satellite: shift of the position, and sigma of
#: the position without the satellite.
WITHOUT: Final = ("without_shift_m", "without_sigma_m")
_COLUMNS: Final = (
    "satellite", "signal", "elevation_deg", "azimuth_deg", "cn0_dbhz", "sigma_m", "residual_m", "reason_text",
    "weight_code", "innovation_code_m", "innovation_doppler_mps",
)  # fmt: skip


#: This number of epochs is shown before, and after, the explained epoch.
_AROUND: Final = 5
#: Columns of ``positions`` and ``train`` that are shown for the epochs before and after the explained epoch.
_NEIGHBOURS: Final = ("chainage_m", "along_sigma_m", "protection_level_m", "status")


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """Explanation of one epoch of one antenna."""

    run: Path  #: Folder of the run.
    antenna: str
    time: np.datetime64  #: GPS time of the epoch.
    asked: str  #: Requested time, as the user gave it.
    #: Row of the epoch in ``positions`` (`single`) and in ``train`` (`track`); `track` is empty if the filter was off.
    single: Mapping[str, Any]
    track: Mapping[str, Any]
    #: One row per observation, used observations first: elevation, residual, outcome, and its weight and innovation in
    #: the filter. Columns `WITHOUT` describe the single-epoch position that results if a used observation is omitted:
    #: the shift of this position along the line and its standard deviation [m]; null if there is no such position.
    satellites: pl.DataFrame
    sentences: tuple[str, ...]  #: Sentences on position, sigma, protection level and status.
    #: Epochs before and after the explained epoch: columns `_NEIGHBOURS` of ``positions``, and (with the prefix
    #: ``filter_``) of ``train``.
    neighbours: pl.DataFrame


def explain_epoch(run: Path, at: str, *, antenna: str | None = None) -> Explanation:
    """Explain the epoch of one antenna that is nearest to the GPS time `at`: ``hh:mm:ss``, optionally after a date.

    The default antenna is the first antenna of the run. A time without a date is searched for on all days of the run.
    Raise InputFileError if the run wrote no observations. Raise SettingsError if the antenna or the time is invalid.
    Raise MismatchError if no epoch is within a minute.
    """
    folder = read_run(run)
    if not (run / "observations.parquet").is_file():
        raise InputFileError(run / "observations.parquet", "there is no such file; repeat the run with --observations")
    if antenna is not None and antenna not in folder.antennas:
        raise SettingsError(f"antenna is {antenna!r}, the run has {' and '.join(folder.antennas)}")
    antenna = antenna or folder.antennas[0]
    rows = folder.positions.filter(antenna=antenna)
    row = _nearest(rows["time_gpst"].to_numpy().astype("datetime64[ns]"), at)
    single = rows.row(row, named=True)
    here = (pl.col("time_gpst") == single["time_gpst"]) & (pl.col("antenna") == antenna)
    with reading_table(run / "observations.parquet"):
        seen = pl.scan_parquet(run / "observations.parquet").filter(here).collect()
    track: Mapping[str, Any] = {}
    if (run / "train.parquet").is_file():
        with reading_table(run / "train.parquet"):
            of_filter = pl.scan_parquet(run / "train.parquet").filter(antenna=antenna).collect()
        mine = of_filter.filter(time_gpst=single["time_gpst"])
        track = mine.row(0, named=True) if len(mine) else {}
    around = rows[max(row - _AROUND, 0) : row + _AROUND + 1].select("time_gpst", *_NEIGHBOURS, "n_used")
    if track:
        filtered = of_filter.select("time_gpst", pl.col(_NEIGHBOURS).name.prefix("filter_"))
        around = around.join(filtered, on="time_gpst", how="left")
    satellites = seen.select(name for name in _COLUMNS if name in seen.columns)
    shift, sigma = np.full((2, len(satellites)), np.nan)
    if single["x_m"] is not None and len(satellites):
        shift, sigma = _without_each(satellites, single, _axes(folder, single), _map_sigma_m(folder))
    satellites = satellites.with_columns(
        pl.Series(name, values).fill_nan(None) for name, values in zip(WITHOUT, (shift, sigma), strict=True)
    ).sort(pl.col("reason_text") != "used", "reason_text", -pl.col("elevation_deg"), nulls_last=True)
    return Explanation(
        run=run, antenna=antenna, time=rows["time_gpst"].to_numpy().astype("datetime64[ns]")[row], asked=at,
        single=single, track=track, satellites=satellites, sentences=tuple(_sentences(single, track, satellites)),
        neighbours=around,
    )  # fmt: skip


def _nearest(times: Any, at: str) -> int:
    """Return the index of the time nearest to the requested time; raise the errors of `explain_epoch`."""
    text = at.strip()
    days = np.unique(times.astype("datetime64[D]")) if ":" in text and "-" not in text else [None]
    try:
        asked = [gps_time(text if day is None else f"{day}T{text}") for day in days]
    except ValueError:
        raise SettingsError(f"time is {at!r}, expected hh:mm:ss or 'yyyy-mm-dd hh:mm:ss' in GPS time") from None
    rows = [int(np.argmin(np.abs(times - one))) for one in asked]
    away = [abs(times[row] - one) / np.timedelta64(1, "s") for row, one in zip(rows, asked, strict=True)]
    best = int(np.argmin(away))
    if not away[best] <= 60.0:
        first, last = (str(time)[:19].replace("T", " ") for time in (times[0], times[-1]))
        raise MismatchError(f"the run has no epoch within a minute of {at}; it goes from {first} to {last} GPS time")
    return rows[best]


def _axes(folder: RunFolder, single: Mapping[str, Any]) -> Floats:
    """Return ECEF unit vectors along, across and above the nearest section, as rows of an array of shape (3, 3)."""
    line = Trajectory.from_antenna_path(read_run_track(folder))
    arc, _ = line.nearest(np.array([[single[name] for name in ("x_m", "y_m", "z_m")]]))
    along, across, _ = line.get_axes(line.segment_at(arc)[0])[0]
    return np.stack([along, across, np.cross(across, along)])


def _map_sigma_m(folder: RunFolder) -> tuple[float, float]:
    """Return the standard deviations of the map's lateral and vertical errors [m], from the settings or the map."""
    settings, facts = folder.record.get("settings_used") or {}, folder.track_facts
    return tuple(  # type: ignore[return-value]
        float(settings.get(f"map_{name}_sigma_m") or facts[f"sigma_{name}_m"]) for name in ("plan", "height")
    )


def _without_each(
    satellites: pl.DataFrame, single: Mapping[str, Any], axes: Floats, map_sigma_m: tuple[float, float]
) -> tuple[Floats, Floats]:
    """Return shift and sigma along the line [m] of the position without each satellite, two arrays of shape (rows,).

    The values are NaN for unused satellites, and where the other satellites do not determine the position.
    """
    used = (satellites["reason_text"] == "used").to_numpy() & satellites["residual_m"].is_not_null().to_numpy()
    elevation, azimuth = (np.radians(satellites[name].to_numpy()) for name in ("elevation_deg", "azimuth_deg"))
    local = np.stack([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], 1)
    design = -local @ enu_axes(single["latitude_deg"], single["longitude_deg"]) @ axes.T
    scale = single["noise_scale"] or 1.0
    sigma, residual = satellites["sigma_m"].to_numpy() * scale, satellites["residual_m"].to_numpy()
    clocks: Strings = np.array([CLOCK_GROUP[name[0]] for name in satellites["satellite"]])
    whole = _solve(design[used], sigma[used], residual[used], clocks[used], map_sigma_m)
    shift, after = np.full((2, len(satellites)), np.nan)
    for row in np.flatnonzero(used):
        rest = used & (np.arange(len(used)) != row)
        moved = _solve(design[rest], sigma[rest], residual[rest], clocks[rest], map_sigma_m)
        if moved is not None and whole is not None:
            shift[row], after[row] = moved[0] - whole[0], moved[1]
    return shift, after


def _solve(
    design: Floats, sigma_m: Floats, residual_m: Floats, clocks: Strings, map_sigma_m: tuple[float, float]
) -> tuple[float, float] | None:
    """Return the least-squares step along the line and the step's sigma [m]; None if the ranges do not determine the
    step.
    """
    groups = np.unique(clocks)
    if len(residual_m) < len(groups) + 1:
        return None
    matrix = np.concatenate([design, (clocks[:, None] == groups).astype(np.float64)], axis=1) / sigma_m[:, None]
    normal = matrix.T @ matrix
    normal[[1, 2], [1, 2]] += np.array(map_sigma_m) ** -2.0
    if np.linalg.cond(normal) > 1e14:
        return None
    covariance = np.linalg.inv(normal)
    return float(covariance[0] @ matrix.T @ (residual_m / sigma_m)), float(np.sqrt(covariance[0, 0]))


def _sentences(single: Mapping[str, Any], track: Mapping[str, Any], satellites: pl.DataFrame) -> list[str]:
    """Return sentences on position, sigma, protection level, status and satellites."""
    lines = []
    if track:
        text = f"filter: {_place(track)}; {track['status']}: {FILTER_STATUS.get(track['status'], 'see the reference')}"
        lines.append(f"{text}; from {track['sources'] or 'dead reckoning'}")
        if track["hypotheses"]:
            count = track["hypotheses"]
            positions = "one position is possible" if count == 1 else f"{count} positions are possible"
            lines.append(f"filter: {positions}; the given position has probability {track['branch_probability']:.3f}")
        lines.append(f"filter's level: {_level_of_filter(track)}")
    status = single["status"]
    lines.append(f"single epoch: {_place(single)}; {status}: {SINGLE_STATUS.get(status, 'see the reference')}")
    if single["along_sigma_m"] is not None and single["noise_scale"] is not None:
        own, whole = single["own_sigma_m"], single["along_sigma_m"]
        lines.append(
            f"sigma: {own:.2f} m from code noise alone (observed noise: {single['noise_scale']:.2f} times the assumed "
            f"noise); {whole:.2f} m if satellite, atmospheric and map errors and other possible positions are included"
        )
    if "protection_level_m" in single:
        lines.append(f"single epoch's level: {_level_of_single(single)}")
    if single.get("raim_outcome"):
        text = f"RAIM: {single['raim_outcome']}"
        if single["raim_statistic"] is not None:
            text += f", statistic {single['raim_statistic']:.1f} against a threshold of {single['raim_threshold']:.1f}"
        lines.append(text)
    outcomes = satellites.group_by("reason_text").len().sort("len", "reason_text", descending=[True, False])
    lines.append("satellites: " + ", ".join(f"{count} {outcome}" for outcome, count in outcomes.iter_rows()))
    weighty = satellites.filter(pl.col(WITHOUT[0]).is_not_null()).sort(pl.col(WITHOUT[0]).abs(), descending=True)
    if len(weighty) and abs(weighty[WITHOUT[0]][0]) >= 0.005:
        name, shift, sigma = (weighty[column][0] for column in ("satellite", *WITHOUT))
        moved = number(shift, 2, " m", sign="+")
        lines.append(
            f"largest effect: without {name} the single-epoch position moves by {moved}, with sigma {sigma:.2f} m"
        )
    return lines


def _place(row: Mapping[str, Any]) -> str:
    if row["chainage_m"] is None:
        return "no position"
    return f"chainage {row['chainage_m']:.2f} m, standard deviation {row['along_sigma_m']:.2f} m"


def _level_of_filter(track: Mapping[str, Any]) -> str:
    level, noise, apart = (track[f"protection_{name}_m"] for name in ("level", "noise", "separation"))
    if noise is None:
        return "none"
    parts = f"{noise:.1f} m covers noise"
    if apart is not None:
        parts += f"; omitting any one source moves the position by at most {apart:.1f} m"
    if level is None or not np.isfinite(level):
        ground = track["protection_level_ground_m"]
        held = "" if ground is None or not np.isfinite(ground) else f"; on the ground {ground:.1f} m"
        return f"no finite level along the line{held} ({parts})"
    return f"{level:.1f} m: {parts}"


def _level_of_single(single: Mapping[str, Any]) -> str:
    level, cause = single["protection_level_m"], single["protection_cause"]
    if level is None or not np.isfinite(level):
        return f"none ({cause or 'a fault remains'})"
    parts = ", ".join(
        f"{name.replace('_', ' ')} {single[f'protection_{name}_m']:.1f} m"
        for name in ("fault_free", "one_fault", "two_faults")
        if single[f"protection_{name}_m"] is not None
    )
    return f"{level:.1f} m, set by {cause.replace('_', ' ')} (the level for each part alone: {parts})"


def write_explanation(explanation: Explanation, path: Path) -> Path:
    """Write an explanation as one HTML page with a sky plot; return its path.

    Raise OutputError if the page cannot be written.
    """
    sky = []
    for row in explanation.satellites.drop_nulls(("elevation_deg", "azimuth_deg")).iter_rows(named=True):
        radius, azimuth = max(90.0 - row["elevation_deg"], 0.0), np.radians(row["azimuth_deg"])
        sky.append({"x": radius * np.sin(azimuth), "y": -radius * np.cos(azimuth), **row})
    sky = [{**point, "label": label} for point, label in zip(sky, _label_points(sky), strict=True)]
    page = read_template("explain.html.j2").render(
        title=f"{explanation.antenna} antenna, {time_text(explanation.time)} GPS time",
        explanation=explanation, sky=sky, rows=explanation.satellites.to_dicts(), style=page_style(),
    )  # fmt: skip
    write_whole(path, page, what="page")
    return path


def _label_points(sky: Sequence[Mapping[str, Any]]) -> list[tuple[float, float]]:
    """Return the start position of each satellite's label in a sky plot, at which the label covers the fewest points
    and labels.
    """
    wide, taken, labels = 9.5, [(point["x"] - 2.4, point["y"] + 1.8, 4.8) for point in sky], []
    for point in sky:
        x, y = point["x"], point["y"] + 1.8
        sides = [(x + 3.4, y), (x - 3.4 - wide, y), (x - wide / 2, y - 5.0), (x - wide / 2, y + 6.5)]
        covered = [
            sum(a < left + across and a + wide > left and abs(b - low) < 4.5 for left, low, across in taken)
            for a, b in sides
        ]
        labels.append(sides[int(np.argmin(covered))])
        taken.append((*labels[-1], wide))
    return labels


def time_text(time: np.datetime64) -> str:
    """Return a time as text to the millisecond, with a space between date and time of day."""
    return str(time)[:23].replace("T", " ")
