"""README of a simulated run: its files, its signals, its settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from railfix.simulate.scenario import Scenario
from railfix.simulate.sensors.tables import COLUMNS
from railfix.simulate.signals import Simulation

#: Groups of settings of which the README names only what is not at its default.
_SHORT = ("errors.", "environment.", "sensors.", "line.generated.", "line.map_error.")


def run_readme(simulation: Simulation, files: dict[str, Path], command: str) -> str:
    """Text of a run's README, for the files that `railfix.simulate.write_run` gives and the command that made them."""
    scenario = simulation.scenario
    made = f"Made by `{command}`.\n" if command else "Made by `railfix.simulate.write_run`.\n"
    satellites = {name for name, _ in simulation.channels}
    rows = "\n".join(f"| {name} | {what} |" for name, what in _files(simulation, files).items())
    settings = "\n".join(f"| {name} | {value} |" for name, value in _settings(scenario).items())
    return f"""# A simulated run

{_list_inventions(scenario)}
It is not a recording.

{made}
| file | what |
|---|---|
{rows}

{scenario.epochs} epochs at {scenario.rate_hz:g} Hz from {scenario.start} GPS time, {len(satellites)} satellites.
The ranges hold the light time, the Earth's rotation, satellite and receiver clocks, group delays, Klobuchar's
ionosphere, Saastamoinen's troposphere (standard atmosphere, 70 % humidity) and white noise; the delays are those
that a receiver corrects, unless a scale below says otherwise.

{_list_effects(scenario)}

| setting | value |
|---|---|
{settings}
"""


def _list_inventions(scenario: Scenario) -> str:
    if scenario.line.kind != "file" and not scenario.sky.nav:
        return "Everything in this folder is invented: no such line, train or satellite exists."
    line = "the line is that of a track file" if scenario.line.kind == "file" else "no such line exists"
    sky = "the satellites are those of a navigation file" if scenario.sky.nav else "no such satellites exist"
    return f"The train and all measurements in this folder are invented; {line}, {sky}."


def _files(simulation: Simulation, files: dict[str, Path]) -> dict[str, str]:
    error = simulation.scenario.line.map_error
    off = ", with an error (line.map_error)" if error.plan_sigma_m or error.height_sigma_m else ""
    what = {
        "front": "RINEX 3.04 observations of the front roof antenna",
        "rear": "the same of the rear antenna",
        "nav": "RINEX 3.04 broadcast records",
        "track": f"track map, {len(simulation.line.track())} points; ellipsoidal heights{off}",
        "vehicle": "bogie distance, gauge, antennas",
        "truth": "ground truth: chainage of the centreline point abeam each antenna, its position (ECEF), speed, "
        "acceleration, kind of section",
        **{
            station.name: "the same of a reference station; its position is in the header"
            for station in simulation.scenario.stations
        },
        "sbas": "SBAS messages as RTKLIB logs them: time of week of the complete reception, PRN, type, message",
        "sections": "ground truth: sections of the line",
        "scenario": "all settings, a scenario file for `railfix simulate`",
        "readme": "this file",
    }
    sensors = {name: "; ".join(f"`{c}`: {t}" for c, t in columns.items()) for name, columns in COLUMNS.items()}
    return {path.name: (what | sensors)[name] for name, path in files.items()}


def _list_effects(scenario: Scenario) -> str:
    """One sentence a group of errors: on, or none."""
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
        "No sensors besides the receivers." if scenario.sensors is None else "Sensors besides the receivers.",
    ]
    if scenario.sbas is not None:
        parts.append("SBAS messages that correct GPS and the ionosphere.")
    if scenario.vehicle.sway_sigma_deg:
        parts.append("The body sways.")
    ranging = None if scenario.sensors is None else scenario.sensors.ranging
    if ranging is not None:
        right, above = (unit - antenna for unit, antenna in zip(
            (ranging.across_m, ranging.up_m), scenario.vehicle.front[1:], strict=True
        ))  # fmt: skip
        place = {"ahead": ranging.along_m, "right": right, "above": above}
        given = " ".join(f"--set sensors.range_{name}_m={metres:g}" for name, metres in place.items() if metres)
        parts.append(f"The place of the vehicle's ranging unit, for `railfix run`: `{given}`.")
    balises = None if scenario.sensors is None else scenario.sensors.balises
    if balises is not None and balises.along_m:
        parts.append(f"The balises' reader, for `railfix run`: `--set sensors.balise.ahead_m={balises.along_m:g}`.")
    if scenario.multipath:
        parts.append("Disturbances from Python, which no setting below describes.")
    return " ".join(parts)


def _settings(scenario: Scenario) -> dict[str, Any]:
    """Settings by their names; of the longer groups what is not at its default."""
    usual = Scenario(sensors=None).describe()
    table = {}
    for name, value in scenario.describe().items():
        same = name in usual and (value == usual[name] or (isinstance(value, float) and np.isnan(value)))
        if not (name.startswith(_SHORT) and same):
            table[name] = value
    return table
