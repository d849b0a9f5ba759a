"""Reading of on-board sensor samples, surveyed ground units, and lists of balises."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, join_rows
from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.io.sensor_tables import COLUMNS, get_column, get_times, names_of_columns, read_sensor_table
from railfix.motion.samples import GroundUnits, ListedBalises, Samples, SensorSamples
from railfix.pipeline.config import Config
from railfix.track import Track
from railfix.track.quality import section_spans

#: Class of samples by sensor name.
_CLASSES: Final = {name: type(samples) for name, samples in SensorSamples().tables.items()}


def read_sensors(
    *,
    tachometer: Path | None = None,
    inertial: Path | None = None,
    radar: Path | None = None,
    ranging: Path | None = None,
    balises: Path | None = None,
) -> SensorSamples:
    """Read the tables of on-board sensors (.csv, .csv.gz, .parquet). A sensor without a file has no samples.

    Raise InputFileError if a file is not a table of the sensor, or if its times are not in order.
    """
    paths = {
        "tachometer": tachometer, "inertial": inertial, "radar": radar, "ranging": ranging, "balises": balises
    }  # fmt: skip
    samples: dict[str, Any] = {}
    for sensor, path in paths.items():
        if path is not None:
            table = read_sensor_table(path, sensor)
            columns = {name: get_column(table, name) for name in names_of_columns(sensor)}
            samples[sensor] = make_samples(sensor, get_times(table), columns)
    return SensorSamples(**samples)


def make_samples(sensor: str, time: Datetimes, columns: Mapping[str, NDArray[Any]]) -> Samples:
    """Return the samples of a sensor, given the times and the other columns of its table; absent numbers are NaN."""
    values = dict(columns)
    if sensor == "tachometer":
        values = {name: np.nan_to_num(column).astype(np.int64) for name, column in columns.items()}
    elif sensor == "inertial":
        six = np.stack([columns[name] for name in COLUMNS["inertial"]], axis=1)
        values = {"force_mps2": six[:, :3], "rate_radps": six[:, 3:]}
    elif sensor == "ranging":
        values["station"] = values.pop("unit")
    return _CLASSES[sensor](time=time, **values)


def units_of_ranges(samples: SensorSamples, units: Path | None, *, ranging: Path | str | None) -> GroundUnits | None:
    """Read the surveyed ground units of two-way ranging. Return None if there are no ranges.

    `ranging` is the table or the stream of ranges. Raise InputFileError if `units` is not a table of ground units.
    Raise MismatchError if `units` lacks the unit of a range. Raise SettingsError if only one of `units` and `ranging`
    is specified.
    """
    if ranging is None and units is not None:
        raise SettingsError("--ranging-units is given without --ranging; give the ranges, or leave the units out")
    if ranging is not None and units is None:
        raise SettingsError("--ranging needs --ranging-units, the surveyed positions of the ground units")
    surveyed = None if units is None else read_units(units)
    if surveyed is not None:
        missing = sorted(set(samples.ranging.station.tolist()) - set(surveyed.name.tolist()))
        if missing:
            raise MismatchError(f"ranges name the ground unit {missing[0]}, and {units} has no such unit; add it")
    return surveyed


def read_units(path: Path) -> GroundUnits:
    """Read a table ``unit,x_m,y_m,z_m`` of surveyed ground units. ECEF positions are in the line's reference frame.

    Raise InputFileError if the file is not such a table, or if it has a unit twice.
    """
    table = read_sensor_table(path, "ranging_units")
    names = table["unit"]
    if names.n_unique() < len(names):
        raise InputFileError(path, f"names unit {names.filter(names.is_duplicated())[0]} twice; give each once")
    return GroundUnits(name=names.to_numpy().astype(np.str_), ecef_m=table.select("x_m", "y_m", "z_m").to_numpy())


def read_listed_balises(path: Path, track: Track, *, virtual: bool = False) -> ListedBalises:
    """Read a table of balises or virtual balises with columns ``balise,chainage_m`` and, if known, ``track,sigma_m``.

    If a row names a track, its chainage is measured from the beginning of that track. Balises that are beyond the ends
    of the line, or on tracks that are not part of the line, are omitted.

    Raise InputFileError if the file is not such a table, names a balise twice, or has no balise on the line.
    """
    table = read_sensor_table(path, "list of balises")
    names = get_column(table, "balise")
    if len(twice := table["balise"].filter(table["balise"].is_duplicated())):
        raise InputFileError(path, f"lists balise {twice[0]} twice; give each once")
    chainage = table["chainage_m"].to_numpy()
    if "track" in table.columns:
        spans = _spans(track)
        begin, end = np.array([spans.get(name, (np.nan, np.nan)) for name in table["track"]]).T
        inside = chainage <= np.abs(end - begin)
        chainage = np.where(inside, begin + np.sign(end - begin) * chainage, np.nan)
    inside = (chainage >= 0.0) & (chainage <= track.chainage_m[-1])
    if not inside.any():
        raise InputFileError(
            path, f"lists no balise on the line (0 to {track.chainage_m[-1]:.0f} m); give chainages of this line"
        )
    sigma = table.get_column("sigma_m", default=pl.zeros(len(table), eager=True))
    return ListedBalises(
        name=names[inside],
        chainage_m=chainage[inside],
        sigma_m=sigma.fill_null(0.0).to_numpy()[inside],
        virtual=np.full(int(inside.sum()), virtual),
    )


def _spans(track: Track) -> dict[str | None, tuple[float, float]]:
    """Return start and end chainage [m] of each track by its source and name, and of the whole line (key None)."""
    spans: dict[str | None, tuple[float, float]] = {None: (0.0, float(track.chainage_m[-1]))}
    for source, (begin, end) in zip(track.sections, section_spans(track), strict=True):
        file, _, name = source.removesuffix(")").partition(" (")
        spans |= dict.fromkeys([source, name or Path(file).stem], (begin, end))
    return spans


def load_balises(
    readings: Path | str | None, places: Path | None, virtual: Path | None, track: Track, config: Config
) -> ListedBalises | None:
    """Read the lists of balises (`places`) and of virtual balises (`virtual`). Return None if there is neither.

    `readings` is the table or the stream of balise readings. Raise InputFileError as `read_listed_balises` does. Raise
    SettingsError if only one of readings and list is specified, or if there are virtual balises, but no protection
    levels of the filter.
    """
    if virtual is not None and (config.filter == "off" or config.tracking.level == "off"):
        raise SettingsError(
            "--virtual-balises needs protection levels of the filter; leave out --filter off, tracking.level=off"
        )
    if (readings is None) != (places is None):
        given, lacking = ("--balises", "--balise-list") if places is None else ("--balise-list", "--balises")
        raise SettingsError(f"{given} is given without {lacking}; give both, or leave it out")
    lists = [
        read_listed_balises(path, track, virtual=is_virtual)
        for path, is_virtual in ((places, False), (virtual, True))
        if path is not None
    ]
    return join_rows(lists) if lists else None


def check_filter(config: Config, options: Iterable[str]) -> None:
    """Raise SettingsError if the along-track filter is off, but `options` has options that require it."""
    for name in options:
        if config.filter == "off":
            raise SettingsError(f"--{name} needs the filter along the track; leave out --filter off")
