"""A simulated run as files: what receivers and a surveyor would hand over, and the truth."""

from __future__ import annotations

import gzip
import os
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Final, Literal

import numpy as np
import polars as pl

from railfix.epochs import Observations
from railfix.errors import OutputError
from railfix.rinex.write import write_navigation, write_observations
from railfix.simulate.scenario import ANTENNAS, Scenario, VehicleSettings
from railfix.simulate.signals import Simulation
from railfix.timescale import seconds
from railfix.track_map import write_track_csv

#: Decimals of metres and metres a second in the truth.
TRUTH_DECIMALS: Final = 4
_TIME_FORMAT: Final = "%Y-%m-%dT%H:%M:%S%.9f"
_COMMENTS: Final = ("SIMULATED: NO SATELLITE, TRAIN OR LINE OF THIS FILE EXISTS",)


def truth_table(simulation: Simulation) -> pl.DataFrame:
    """Where the antennas truly are when their receivers tag an epoch.

    Returns
    -------
    polars.DataFrame
        One row an epoch and antenna: `time_gpst` (the tag), `antenna`, `chainage_m` (centreline point
        abeam the antenna, as the track map counts), `kilometrage_m`, `x_m`, `y_m`, `z_m`, `speed_mps`
        (negative toward falling chainage). The place is that of the true instant, which is the tag
        less the receiver clock's bias.
    """
    line, time = simulation.line, simulation.time()
    tags = seconds(time - simulation.scenario.start)
    sampled = line.sampled_chainage_m()
    mapped = line.track().chainage_m
    tables = []
    for antenna in ANTENNAS:
        truth, speed = simulation.truth(antenna, tags - simulation.clock_s(antenna, tags))
        tables.append(
            pl.DataFrame(
                {
                    "time_gpst": time,
                    "antenna": np.full(len(time), antenna),
                    "chainage_m": np.interp(truth.chainage_m, sampled, mapped),
                    "kilometrage_m": line.kilometrage_at(truth.chainage_m),
                    "x_m": truth.ecef_m[:, 0],
                    "y_m": truth.ecef_m[:, 1],
                    "z_m": truth.ecef_m[:, 2],
                    "speed_mps": speed,
                }
            )
        )
    return pl.concat(tables).sort("time_gpst", maintain_order=True)


def write_run(
    scenario: Scenario,
    folder: str | os.PathLike[str],
    *,
    packing: Literal["packed", "plain"] = "packed",
    command: str = "",
    progress: Callable[[str, int], None] | None = None,
) -> dict[str, Path]:
    """Simulate a run and write its files; those of the same names are replaced.

    ============================ ===================================================
    front.crx.gz, rear.crx.gz    observations (front.rnx, rear.rnx when plain)
    nav.rnx.gz                   broadcast records (nav.rnx)
    track.csv                    track map
    vehicle.toml                 vehicle
    truth.csv.gz                 `truth_table` (truth.csv)
    README.md                    what this is and how it was made
    ============================ ===================================================

    Parameters
    ----------
    scenario : Scenario
    folder : path-like
        Made where it does not exist.
    packing : {"packed", "plain"}
    command : str
        The command that made it, for the README.
    progress : callable, optional
        Called with the antenna and the number of epochs written since the last call.

    Returns
    -------
    dict of str to Path
        The files, by ``front``, ``rear``, ``nav``, ``track``, ``vehicle``, ``truth``, ``readme``.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    out = Path(folder)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: the folder cannot be made ({error.strerror or error})") from error
    observation, packed = ("crx.gz", ".gz") if packing == "packed" else ("rnx", "")
    files = {name: out / f"{name}.{observation}" for name in ANTENNAS}
    files |= {"nav": out / f"nav.rnx{packed}", "track": out / "track.csv", "vehicle": out / "vehicle.toml"}
    files |= {"truth": out / f"truth.csv{packed}", "readme": out / "README.md"}
    simulation = Simulation(scenario)
    for antenna in ANTENNAS:

        def watched(antenna: str = antenna) -> Iterator[Observations]:
            for part in simulation.observations(antenna):
                yield part
                if progress is not None:
                    progress(antenna, len(part))

        write_observations(watched(), files[antenna], comments=_COMMENTS)
    write_navigation(simulation.navigation, files["nav"], comments=_COMMENTS)
    write_track_csv(simulation.line.track(), files["track"])
    _write(files["vehicle"], vehicle_toml(scenario.vehicle).encode())
    text = BytesIO()
    truth_table(simulation).write_csv(text, float_precision=TRUTH_DECIMALS, datetime_format=_TIME_FORMAT)
    content = text.getvalue()
    _write(files["truth"], gzip.compress(content, compresslevel=9, mtime=0) if packed else content)
    _write(files["readme"], _readme(simulation, files, command).encode())
    return files


def vehicle_toml(vehicle: VehicleSettings) -> str:
    """The vehicle as `railfix.vehicle.read_vehicle` reads it."""
    lines = [
        f'name = "{vehicle.name}"',
        f"bogie_distance_m = {vehicle.bogie_distance_m}",
        f"gauge_m = {vehicle.gauge_m}",
        'facing = "rising"',
    ]
    for antenna in ANTENNAS:
        along, across, up = getattr(vehicle, antenna)
        lines += ["", f"[antennas.{antenna}]", f"along_m = {along}", f"across_m = {across}", f"up_m = {up}"]
    return "\n".join(lines) + "\n"


def _readme(simulation: Simulation, files: dict[str, Path], command: str) -> str:
    scenario = simulation.scenario
    satellites = {name for name, _ in simulation.channels}
    made = f"Made by `{command}`.\n" if command else "Made by `railfix.simulate.write_run`.\n"
    settings = "\n".join(f"| {name} | {value} |" for name, value in scenario.describe().items())
    return f"""# A simulated run

Everything in this folder is invented: no such line, train or satellite exists, and the place is only
somewhere in Japan. It is not a recording.

{made}
| file | what |
|---|---|
| {files["front"].name}, {files["rear"].name} | RINEX 3.04 observations of the two roof antennas |
| {files["nav"].name} | RINEX 3.04 broadcast records |
| {files["track"].name} | track map, {len(simulation.line.track())} points; ellipsoidal heights |
| {files["vehicle"].name} | bogie distance, gauge, antennas |
| {files["truth"].name} | truth: chainage of the centreline point abeam each antenna, its place (ECEF), speed |

{scenario.epochs} epochs at {scenario.rate_hz:g} Hz from {scenario.start} GPS time, {len(satellites)} satellites.
The ranges hold the light time, the Earth's rotation, satellite and receiver clocks, group delays, Klobuchar's
ionosphere, Saastamoinen's troposphere (standard atmosphere, 70 % humidity) and white noise; no multipath.
The delays are those that a receiver corrects, so no error of the atmosphere is left unless a scale below says so.

| setting | value |
|---|---|
{settings}
"""


def _write(path: Path, content: bytes) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        temporary.write_bytes(content)
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise OutputError(f"{path}: the file cannot be written ({error.strerror or error})") from error
