"""What the errors of the simulator are set to and what comes back from its observations, and how long it takes.

Run ``python tests/studies/simulator_score.py`` for the statistics and ``python tests/studies/simulator_score.py speed``
for the seconds of one core (two hours at 10 Hz, two antennas, GPS, QZSS and Galileo, one signal).
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import paths  # noqa: F401
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.ranges.atmosphere import thin_shell_obliquity
from railfix.ranges.sbas.troposphere import rtca_mapping
from railfix.simulate import LineSettings, Scenario, SensorSettings, Simulation, SkySettings, sensor_tables, write_run
from railfix.simulate.receiver import NoiseSettings
from railfix.simulate.settings import (
    ClockWalkSettings,
    ErrorSettings,
    InterSystemSettings,
    IonosphereErrorSettings,
    RadarSettings,
    SatelliteErrorSettings,
    TroposphereErrorSettings,
)
from test_simulate_errors import LONG, STANDING, added_m, axes_of, correlation, full, noise_of, on_and_off
from test_simulate_sensors import FORCES, RATES, difference, radar

#: Two hours, satellites of GPS alone.
AIR: dict[str, Any] = LONG | {"duration_s": 7200.0, "sky": SkySettings(systems="G")}
Row = tuple[str, float, float]


def process(name: str, series: np.ndarray, sigma: float, time_s: float, interval_s: float = 1.0) -> Iterator[Row]:
    """Rows of a Gauss-Markov process."""
    lag = max(1, round(time_s / interval_s / 2.0))
    yield f"{name}, sigma [m]", sigma, float(np.sqrt(np.nanmean(series**2)))
    yield f"{name}, correlation time [s]", time_s, -lag * interval_s / float(np.log(correlation(series, lag)))


def satellites() -> Iterator[Row]:
    """Clocks and orbits, in the ranges of an hour or two."""
    table = SatelliteErrorSettings(clock_sigma_m=0.8, clock_time_s=8.0)
    on, off = on_and_off(ErrorSettings(satellites={"G": table}), **(LONG | {"duration_s": 7200.0}))
    code = added_m(on, off)[0][:, on.observations.satellite.astype("<U1") == "G"]
    yield from process("satellite clock", code, 0.8, 8.0)
    for axis, name in enumerate(("radial", "along", "cross")):
        table = SatelliteErrorSettings(**{f"{name}_sigma_m": 2.0}, orbit_time_s=20.0)
        on, off = on_and_off(ErrorSettings(satellites=dict.fromkeys("GJE", table)), **LONG)
        sight, axes = axes_of(Simulation(Scenario(**LONG)), off)
        share = np.einsum("tmi,tmi->tm", sight, axes[axis])
        with np.errstate(divide="ignore", invalid="ignore"):
            series = np.where(np.abs(share) > 0.05, added_m(on, off)[0] / share, np.nan)
        yield from process(f"orbit, {name}", series, 2.0, 20.0)


def air() -> Iterator[Row]:
    """Ionosphere and troposphere."""
    settings = IonosphereErrorSettings(vertical_sigma_m=0.5, vertical_time_s=1.0)
    on, off = on_and_off(ErrorSettings(ionosphere=settings), **AIR)
    vertical = added_m(on, off)[0] / thin_shell_obliquity(on.geometry.elevation_deg)
    yield from process("vertical ionosphere", np.nanmean(vertical, axis=1)[:, None], 0.5, 1.0)
    layer = TroposphereErrorSettings(zenith_sigma_m=0.05, zenith_time_s=1.0)
    on, off = on_and_off(ErrorSettings(troposphere=layer), **AIR)
    zenith = added_m(on, off)[0] / rtca_mapping(on.geometry.elevation_deg)
    yield from process("zenith troposphere", np.nanmean(zenith, axis=1)[:, None], 0.05, 1.0)


def receivers() -> Iterator[Row]:
    """Clocks, offsets, noise."""
    settings = {"duration_s": 7200.0, "rate_hz": 1.0, "run": STANDING}
    walks = ErrorSettings(clock=ClockWalkSettings(walk_m_per_sqrt_s=0.05))
    seconds = np.arange(7200.0)
    on, off = (
        Simulation(Scenario(**settings, errors=e)).clocks.bias_s("front", seconds) for e in (walks, ErrorSettings())
    )  # type: ignore[arg-type]
    steps = np.diff(on - off) * SPEED_OF_LIGHT
    yield "receiver clock, walk [m/sqrt(s)]", 0.05, float(steps.std())
    offset = ErrorSettings(intersystem={"E": InterSystemSettings(offset_m=-4.0, drift_mps=0.02)})
    with_offset, without = on_and_off(offset, duration_s=20.0, receiver=LONG["receiver"])
    code = added_m(with_offset, without)[0][:, with_offset.observations.satellite.astype("<U1") == "E"]
    line = np.polynomial.polynomial.polyfit(np.arange(200) * 0.1, np.nanmean(code, axis=1), 1)
    yield "inter-system offset [m]", -4.0, float(line[0])
    yield "inter-system drift [m/s]", 0.02, float(line[1])
    _, normal = noise_of(NoiseSettings(code_correlated_share=0.7, code_correlation_time_s=1.0), duration_s=600.0)
    yield "code noise over its sigma", 1.0, float(np.nanstd(normal))
    for lag in (1, 10):
        yield f"code noise, autocorrelation at {lag / 10:g} s", 0.7 * float(np.exp(-lag / 10)), correlation(normal, lag)


def sensors() -> Iterator[Row]:
    """Inertial sensor and radar."""
    walk = difference({"velocity_walk_mps_per_sqrt_s": 0.002, "angle_walk_rad_per_sqrt_s": 5e-5})
    count = len(FORCES)
    assert len(RATES) == count
    yield "accelerometer noise [m/s/sqrt(s)]", 0.002, float(walk[:, :count].std() / 10.0)
    yield "gyroscope noise [rad/sqrt(s)]", 5e-5, float(walk[:, count:].std() / 10.0)
    measured, true = radar(RadarSettings(noise_sigma_mps=0.05))
    yield "radar noise [m/s]", 0.05, float((measured - true).std())


def statistics() -> None:
    """Print the table."""
    print("| error, alone | set | estimated | difference |\n|---|---|---|---|")
    for part in (satellites, air, receivers, sensors):
        for name, given, found in part():
            print(f"| {name} | {given:.4g} | {found:.4g} | {100.0 * (found / given - 1.0):+.1f} % |")


def speed() -> None:
    """Print seconds of CPU."""
    scenario = Scenario(duration_s=7200.0, line=LineSettings(length_m=20_000.0))

    def timed(what: str, work: Callable[[], object]) -> None:
        start = time.process_time()
        work()
        print(f"{what}: {time.process_time() - start:.1f} s")

    def observe(run: Scenario) -> int:
        simulation = Simulation(run)
        return sum(len(piece.observations) for name in ("front", "rear") for piece in simulation.pieces(name))

    def write(run: Scenario) -> None:
        with tempfile.TemporaryDirectory() as folder:
            write_run(run, folder)

    print(f"{2 * scenario.epochs} antenna-epochs, {len(Simulation(scenario).channels)} channels; seconds of CPU")
    everything = scenario.replaced(errors=full())
    timed("observations, no errors", lambda: observe(scenario))
    timed("observations, all errors", lambda: observe(everything))
    timed("observations and packed files, all errors", lambda: write(everything))
    sensing = scenario.replaced(sensors=SensorSettings())
    timed("sensors (inertial at 100 Hz)", lambda: sensor_tables(Simulation(sensing)))


if __name__ == "__main__":
    speed() if sys.argv[1:] == ["speed"] else statistics()
