"""Files of a simulated run: observations, navigation, track map, vehicle, sensors and ground truth."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import polars as pl

from railfix.core.errors import OutputError, check_type
from railfix.core.files import FilePath
from railfix.core.settings_files import write_toml
from railfix.core.timescale import seconds
from railfix.gnss.observations import Observations
from railfix.io.rinex import write_navigation, write_observations
from railfix.run.output import CSV_TIME, OutputFolder, Overwrite
from railfix.simulate.sbas_stream import sbas_messages, write_sbas
from railfix.simulate.scenario import ANTENNAS, Scenario, VehicleSettings
from railfix.simulate.scenario_file import scenario_table
from railfix.simulate.sensor_columns import COLUMNS, sensor_tables
from railfix.simulate.signals import Simulation
from railfix.track import write_track_csv

#: The README lists settings with these prefixes only if their values differ from the defaults.
_SHORT = ("errors.", "environment.", "sensors.", "line.generated.", "line.map_error.")


def run_readme(simulation: Simulation, files: dict[str, Path], command: str) -> str:
    """Return the text of the README of a run.

    `files` has the paths that `write_run` returns, by name. `command` is the command that created the files; it may be
    empty.
    """
    scenario = simulation.scenario
    made = f"Made by `{command}`.\n" if command else "Made by `railfix.simulate.write_run`.\n"
    satellites = {name for name, _ in simulation.channels}
    rows = "\n".join(f"| {name} | {what} |" for name, what in _files(simulation, files).items())
    settings = "\n".join(f"| {name} | {value} |" for name, value in _settings(scenario).items())
    return f"""# A simulated run

{_list_inventions(scenario)}
The run is not a recording.

{made}
| file | what |
|---|---|
{rows}

{scenario.epochs} epochs at {scenario.rate_hz:g} Hz from {scenario.start} GPS time, {len(satellites)} satellites.
The pseudoranges include light time, Earth rotation, satellite and receiver clocks, group delays, Klobuchar's
ionospheric delay, Saastamoinen's tropospheric delay (standard atmosphere, 70 % humidity) and white noise. A receiver
that applies the same models corrects the delays exactly if the scales in the table below are 1.

{_list_effects(scenario)}

| setting | value |
|---|---|
{settings}
"""


def _list_inventions(scenario: Scenario) -> str:
    if scenario.line.kind != "file" and not scenario.sky.nav:
        return "Everything in this folder is simulated: no such line, train or satellite exists."
    line = "the line is from a track file" if scenario.line.kind == "file" else "no such line exists"
    sky = "the satellites are from a navigation file" if scenario.sky.nav else "no such satellites exist"
    return f"The train and all measurements in this folder are simulated; {line}, {sky}."


def _files(simulation: Simulation, files: dict[str, Path]) -> dict[str, str]:
    error = simulation.scenario.line.map_error
    off = ", with map errors (line.map_error)" if error.plan_sigma_m or error.height_sigma_m else ""
    what = {
        "front": "RINEX 3.04 observations of the front roof antenna",
        "rear": "observations of the rear antenna",
        "nav": "RINEX broadcast records",
        "track": f"track map, {len(simulation.line.track())} points; ellipsoidal heights{off}",
        "vehicle": "bogie distance, gauge, antennas",
        "truth": "ground truth of each antenna: its ECEF position, chainage of the centreline point abeam, speed, "
        "acceleration, kind of section",
        **{
            station.name: "observations of a reference station; its position is in the header"
            for station in simulation.scenario.stations
        },
        "sbas": "SBAS messages in RTKLIB's format: week, time of week of complete reception, PRN, type, message",
        "sections": "ground truth: sections of the line",
        "scenario": "all settings, a scenario file for `railfix simulate`",
        "readme": "this file",
    }
    sensors = {name: "; ".join(f"`{c}`: {t}" for c, t in columns.items()) for name, columns in COLUMNS.items()}
    return {path.name: (what | sensors)[name] for name, path in files.items()}


def _list_effects(scenario: Scenario) -> str:
    """Return README sentences on the simulated errors, multipath, sensors and SBAS messages."""
    usual = Scenario().errors
    names = list(type(usual).model_fields)
    errors = [name for name in names if getattr(scenario.errors, name) != getattr(usual, name)]
    parts = [
        f"Errors of satellites, atmosphere and receivers: {', '.join(errors)}."
        if errors
        else "No errors of satellites or atmosphere.",
        "No multipath and no blockage."
        if scenario.environment.empty and not scenario.multipath
        else "Multipath and blockage by structures along the line (see the sections).",
        "No on-board sensors except the receivers." if scenario.sensors is None else "On-board sensors.",
    ]
    if scenario.sbas is not None:
        what = (
            "GPS and the ionosphere" if scenario.sbas.band == "L1" else "codes of GPS, Galileo and BeiDou on L1 and L5"
        )
        parts.append(f"SBAS messages that correct {what}.")
    if scenario.vehicle.sway_sigma_deg:
        parts.append("The body of the vehicle sways.")
    ranging = None if scenario.sensors is None else scenario.sensors.ranging
    if ranging is not None:
        right, above = (unit - antenna for unit, antenna in zip(
            (ranging.across_m, ranging.up_m), scenario.vehicle.front[1:], strict=True
        ))  # fmt: skip
        place = {"ahead": ranging.along_m, "right": right, "above": above}
        given = " ".join(f"--set sensors.range_{name}_m={metres:g}" for name, metres in place.items() if metres)
        parts.append(f"Give `railfix run` the position of the vehicle's ranging unit with `{given}`.")
    balises = None if scenario.sensors is None else scenario.sensors.balises
    if balises is not None and balises.along_m:
        parts.append(
            f"Give `railfix run` the balise reader's position with `--set sensors.balise.ahead_m={balises.along_m:g}`."
        )
    if scenario.multipath:
        parts.append("Further disturbances, computed by Python functions that are not in the settings below.")
    return " ".join(parts)


def _settings(scenario: Scenario) -> dict[str, Any]:
    """Return the settings of a scenario by dotted name; groups in `_SHORT` include only non-default settings."""
    usual = Scenario(sensors=None).describe()
    table = {}
    for name, value in scenario.describe().items():
        same = name in usual and (value == usual[name] or (isinstance(value, float) and np.isnan(value)))
        if not (name.startswith(_SHORT) and same):
            table[name] = value
    return table


#: Number of decimals of all quantities in the ground truth.
TRUTH_DECIMALS: Final = 4
_COMMENTS: Final = ("SIMULATED: NO RECEIVER HAS MEASURED ANYTHING OF THIS FILE",)


def truth_table(simulation: Simulation) -> pl.DataFrame:
    """Return the ground truth of the antennas at the epochs of their receivers, one row per epoch and antenna.

    The columns are `time_gpst` (time tag), `antenna`, `chainage_m` (centreline point abeam the antenna, in the chainage
    of the track map), `kilometrage_m`, `x_m`, `y_m`, `z_m`, `speed_mps` (negative toward falling chainage),
    `acceleration_mps2` (along the line, positive toward rising chainage) and `environment` (kind of section, "open"
    outside all sections). The values refer to the true instant, which is the time tag minus the receiver clock bias.
    """
    line, time = simulation.line, simulation.time()
    tags = seconds(time - simulation.scenario.start)
    sampled = line.point_chainage_m()
    mapped = line.track().chainage_m
    tables = []
    for antenna in ANTENNAS:
        instant = tags - simulation.clocks.bias_s(antenna, tags)
        truth, speed = simulation.truth(antenna, instant)
        tables.append(
            pl.DataFrame(
                {
                    "time_gpst": time,
                    "antenna": np.full(len(time), antenna),
                    "chainage_m": np.interp(truth.chainage_m, sampled, mapped),
                    "kilometrage_m": line.kilometrage_at(truth.chainage_m),
                    **dict(zip(("x_m", "y_m", "z_m"), truth.ecef_m.T, strict=True)),
                    "speed_mps": speed,
                    "acceleration_mps2": simulation.motion.acceleration_at(instant),
                    "environment": simulation.environment.label_at(truth.chainage_m),
                }
            )
        )
    return pl.concat(tables).sort("time_gpst", maintain_order=True)


def section_table(simulation: Simulation) -> pl.DataFrame:
    """Return the sections that cover the line: `from_m`, `to_m` (chainage of the track map) and `environment`."""
    line = simulation.line
    ends = [m for part in simulation.environment.sections for m in (part.from_m, part.to_m)]
    edges = np.unique(np.clip([0.0, *ends, line.length_m], 0.0, line.length_m))
    kinds = simulation.environment.label_at((edges[:-1] + edges[1:]) / 2.0)
    first = np.append(True, kinds[1:] != kinds[:-1])
    begins = edges[:-1][first]
    mapped = np.interp([*begins, line.length_m], line.point_chainage_m(), line.track().chainage_m)
    return pl.DataFrame({"from_m": mapped[:-1], "to_m": mapped[1:], "environment": kinds[first]})


def write_run(
    scenario: Scenario,
    folder: FilePath,
    *,
    packing: Literal["packed", "plain"] = "packed",
    command: str = "",
    overwrite: Overwrite = "refuse",
    progress: Callable[[str, int], None] | None = None,
) -> dict[str, Path]:
    """Simulate a run, write its files, and return their paths by name.

    ============================ ===================================================
    front.crx.gz, rear.crx.gz    observations (front.rnx, rear.rnx if plain)
    station.crx.gz, ...          observations of reference stations, if the scenario has any
    nav.rnx.gz                   broadcast records (nav.rnx if plain)
    track.csv                    track map
    vehicle.toml                 vehicle
    truth.csv.gz                 `truth_table` (truth.csv if plain)
    sections.csv                 `section_table`
    messages.sbs                 SBAS messages, if the scenario has SBAS
    tachometer.parquet, ...      `sensor_tables`, if the scenario has sensors
    scenario.toml                scenario, which `load_scenario` reads
    README.md                    contents and settings of the run
    ============================ ===================================================

    The files appear in the folder together, after all files are complete. With `packing` "plain", no file is
    compressed, and the tables of sensors are CSV files. `command` is the command that the README names. `progress` is
    called with the name of the receiver and the number of epochs written since the last call. The names of the paths
    are ``front``, ``rear``, ``nav``, ``track``, ``vehicle``, ``truth``, ``sections``, ``sbas``, the names of reference
    stations and sensor tables, ``scenario`` and ``readme``. Raise SettingsError if the scenario is invalid, and
    OutputError if a file cannot be written.
    """
    check_type(scenario, Scenario, "scenario")
    simulation = Simulation(scenario)
    tables = sensor_tables(simulation)
    with OutputFolder(Path(folder), overwrite=overwrite) as out:
        staged = _write_files(simulation, tables, out, packing, command, progress)
        written = out.commit()
    return {name: written[path.name] for name, path in staged.items()}


def _write_files(
    simulation: Simulation,
    tables: dict[str, pl.DataFrame],
    out: OutputFolder,
    packing: Literal["packed", "plain"],
    command: str,
    progress: Callable[[str, int], None] | None,
) -> dict[str, Path]:
    scenario = simulation.scenario
    observation, packed = ("crx.gz", ".gz") if packing == "packed" else ("rnx", "")
    names = {name: f"{name}.{observation}" for name in scenario.receivers}
    names |= {"nav": f"nav.rnx{packed}", "track": "track.csv", "vehicle": "vehicle.toml"}
    names |= {"truth": f"truth.csv{packed}", "sections": "sections.csv"}
    if scenario.sbas is not None:
        names["sbas"] = "messages.sbs"
    names |= {name: f"{name}.{'parquet' if packed else 'csv'}" for name in tables}
    names |= {"scenario": "scenario.toml", "readme": "README.md"}
    files = {key: out.stage(name) for key, name in names.items()}
    for antenna in scenario.receivers:

        def chunks(antenna: str = antenna) -> Iterator[Observations]:
            for part in simulation.observations(antenna):
                yield part
                if progress is not None:
                    progress(antenna, len(part))

        write_observations(chunks(), files[antenna], comments=_COMMENTS)
    write_navigation(
        simulation.navigation,
        files["nav"],
        version="4.02" if "CNV1" in simulation.navigation.kepler.message else "3.04",
        comments=_COMMENTS,
    )
    write_track_csv(simulation.line.track(), files["track"])
    write_toml(files["vehicle"], vehicle_table(scenario.vehicle))
    truth, sections = (_csv(make(simulation), TRUTH_DECIMALS) for make in (truth_table, section_table))
    _write(files["truth"], gzip.compress(truth, compresslevel=6, mtime=0) if packed else truth)
    _write(files["sections"], sections)
    if scenario.sbas is not None:
        write_sbas(sbas_messages(simulation, scenario.sbas), files["sbas"])
    for name, table in tables.items():
        _write(files[name], _parquet(table) if packed else _csv(table, None))
    write_toml(files["scenario"], scenario_table(scenario))
    _write(files["readme"], run_readme(simulation, files, command).encode())
    return files


def _csv(table: pl.DataFrame, decimals: int | None) -> bytes:
    return table.write_csv(float_precision=decimals, datetime_format=CSV_TIME).encode()


def _parquet(table: pl.DataFrame) -> bytes:
    content = BytesIO()
    table.write_parquet(content)
    return content.getvalue()


def vehicle_table(vehicle: VehicleSettings) -> dict[str, Any]:
    """Return the content of the vehicle file, see `railfix.track.vehicle.read_vehicle`."""
    antennas = {
        name: dict(zip(("along_m", "across_m", "up_m"), getattr(vehicle, name), strict=True)) for name in ANTENNAS
    }
    known = {name: getattr(vehicle, name) for name in ("name", "bogie_distance_m", "gauge_m", "length_m")}
    return {**known, "facing": "rising", "antennas": antennas}


def _write(path: Path, content: bytes) -> None:
    try:
        path.write_bytes(content)
    except OSError as error:
        raise OutputError(f"{path.parent}: {path.name} cannot be written ({error.strerror or error})") from error
