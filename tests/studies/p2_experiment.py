"""P2's experiments on simulated sensors: figures 3 to 8, 11 and table 1, which the paper gives without errors.

Run ``python tests/studies/p2_experiment.py`` for what docs/papers.md says of P2 (some seconds). Where the map is not
named, there is none, as in P2: the reference pitch is that by wheel and accelerometer, followed by the gyro.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Final
from unittest import mock

import numpy as np
import polars as pl

import paths  # noqa: F401
from railfix.core.constants import GRAVITY_MPS2
from railfix.core.settings_files import write_toml
from railfix.core.timescale import seconds, timedelta
from railfix.motion.samples import InertialSamples, SensorSamples, TachometerPulses
from railfix.motion.slip import MotionSamples, MotionState, SlipLimits, SlipResult, find_slips
from railfix.motion.tachometer import TachometerLimits, distance_m, pulse_speeds
from railfix.pipeline import sensed_motion as stage
from railfix.run.locate import find_features
from railfix.simulate import Scenario, Simulation
from railfix.simulate.run import vehicle_table
from railfix.simulate.scenario_file import load_recipe
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import antenna_trajectory, read_vehicle
from railfix.tracking import Line
from sensed_ride import sensors_of
from slip_motion import SLIPPING, even_motion

#: Peaks of the wheel's speed over that of the train [m/s], and durations of slips [s].
EXCESS_MPS: Final = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
DURATIONS_S: Final = (0.5, 1.0, 2.0, 4.0, 8.0)
#: P2 table 1: differences of the gaps between features of two runs [m].
P2_TABLE_1_M: Final = (0.04, 0.15, 0.15, 0.00, 0.04)
#: Tachometer, inertial unit and radar of P2's trains, with the errors of `commercial-run`.
SENSORS: Final = {
    "tachometer": {"diameter_error_m": 0.0008, "jitter_s": 2e-6, "lowest_mps": 0.3},
    "inertial": {
        "accel_bias_mps2": [0.02, -0.01, 0.03],
        "gyro_bias_radps": [1e-5, -2e-5, 1e-5],
        "velocity_walk_mps_per_sqrt_s": 0.001,
        "angle_walk_rad_per_sqrt_s": 5e-5,
        "vibration_sigma_mps2": 0.3,
    },
    "radar": {"noise_sigma_mps": 0.05, "sway_ratio_sigma": 0.003, "scale": 0.001, "lowest_mps": 1.0 / 3.6},
}


@dataclass(frozen=True)
class Sensed:
    """Slip detection of a run at 50 samples a second.

    `true_m`, `true_mps` and `wheel_m`: of the train, and by the wheel with its true diameter; forward.
    """

    time_s: np.ndarray
    true_m: np.ndarray
    true_mps: np.ndarray
    wheel_m: np.ndarray
    wheel_mps: np.ndarray
    found: SlipResult
    intervals: stage.SensedMotion


def sense(
    simulation: Simulation, samples: SensorSamples, limits: SlipLimits, *, line: bool = False, gyro: bool = True
) -> Sensed:
    """The slip detection of a run, with or without the line's gradient and the gyro."""
    scenario = simulation.scenario
    trajectory = trajectory_of(simulation)
    course = Line(trajectory)
    kept: list[SlipResult] = []

    def sine_at(arc_m: np.ndarray) -> np.ndarray:
        slope = course.gradient_at(arc_m) if line else np.full(len(arc_m), np.nan)
        return slope / np.sqrt(1.0 + slope**2)

    def keeping(samples: MotionSamples, **words: object) -> object:
        result = find_slips(samples if gyro else samples._replace(body=None), **words)  # type: ignore[arg-type]
        kept.append(result[0])
        return result

    edges = scenario.start + timedelta(np.arange(1.0, scenario.duration_s - 0.5, 0.1))
    assert isinstance(samples.tachometer, TachometerPulses)
    assert isinstance(samples.inertial, InertialSamples)
    diameter = scenario.sensors.tachometer  # type: ignore[union-attr]
    true_diameter = diameter.wheel_diameter_m + diameter.diameter_error_m  # type: ignore[union-attr]
    tachometer = TachometerLimits(wheel_diameter_m=true_diameter)
    begin = float(simulation.motion.at(np.array([1.0]))[0][0])
    start = stage.SensedState(arc_m=float(trajectory.arc_at_chainage(np.array([begin]))[0]))
    with mock.patch.object(stage, "find_slips", keeping):
        intervals, _, _ = stage.sensed_motion(
            samples.tachometer, samples.inertial, edges, trajectory, sine_at, start,
            tachometer=tachometer, limits=limits,
        )  # fmt: skip
    (found,) = kept
    t = seconds(edges[0] - scenario.start) + 0.02 * np.arange(1, len(found.state) + 1)
    chainage, speed = simulation.motion.at(t)
    when = scenario.start + timedelta(t)
    return Sensed(
        time_s=t,
        true_m=np.abs(chainage - chainage[0]),
        true_mps=np.abs(speed),
        wheel_m=distance_m(samples.tachometer, when, limits=tachometer),
        wheel_mps=np.nan_to_num(pulse_speeds(samples.tachometer, when, limits=tachometer).speed_mps),
        found=found,
        intervals=intervals,
    )


def trajectory_of(simulation: Simulation) -> Trajectory:
    """Trajectory of the front antenna."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "vehicle.toml"
        write_toml(path, vehicle_table(simulation.scenario.vehicle))
        return antenna_trajectory(simulation.line.track(), read_vehicle(path), "front")


def scenario_with(name: str, duration_s: float, seed: int = 1, **tachometer: object) -> Scenario:
    """A scenario with P2's sensors, in a body that pitches."""
    base = load_recipe(name).scenario()
    sensors = {**SENSORS, "tachometer": {**SENSORS["tachometer"], **tachometer}}
    vehicle = base.vehicle.replaced(pitch_sigma_deg=0.15, pitch_deg_per_mps2=0.3)
    return base.replaced(seed=seed, duration_s=duration_s, vehicle=vehicle, sensors=sensors)


# -- where the rule is blind ---------------------------------------------------------------------------------


def blind_lines() -> Iterator[str]:
    """Share of a slip's time that is not found, by size and duration; P2's rule, its closed form, and railfix's."""
    for name, limits in (
        ("P2's rule, measured", {"rule": "p2"}),
        ("P2's rule, closed form", None),
        ("rule of railfix", {"rule": "map"}),
    ):
        yield f"{name + ': not found [%]':36s}" + "".join(f"{x:>8g}" for x in EXCESS_MPS) + "  m/s at the peak"
        for duration in DURATIONS_S:
            cells = []
            for excess in EXCESS_MPS:
                if limits is None:
                    least = SlipLimits().p2_limit * GRAVITY_MPS2 * duration / np.pi
                    flanks = 0.0 if excess <= least else 2.0 / np.pi * np.arccos(least / excess)
                    share = 1.0 - max(flanks - 2.0 * SlipLimits().confirm_s / duration, 0.0)
                else:
                    case = even_motion(20.0 + duration, 5.0, duration, excess)
                    inside = (case.time_s >= 5.0) & (case.time_s <= 5.0 + duration)
                    share = 1.0 - np.isin(case.run(**limits).state[inside], SLIPPING).mean()
                cells.append(f"{100.0 * share:8.0f}")
            yield f"{duration:33g} s " + "".join(cells)


# -- figures 3 to 5 ------------------------------------------------------------------------------------------


def braking(simulation: Simulation, least_mps: float) -> tuple[float, float]:
    """First braking from a speed to below 3 m/s: its begin and end [s]."""
    t = np.arange(0.0, simulation.scenario.duration_s, 0.1)
    speed = np.abs(simulation.motion.at(t)[1])
    slow = np.flatnonzero(speed < 3.0)
    stops = [k for k in slow if speed[k - 1] >= 3.0]
    for end in stops:
        fast = np.flatnonzero((speed[:end] > least_mps) & (np.gradient(speed)[:end] > -1e-3))
        if len(fast) and t[end] - t[fast[-1]] < 120.0:
            return float(t[fast[-1]]), float(t[end])
    raise ValueError(f"no braking from {least_mps} m/s in {simulation.scenario.duration_s} s")


def way_error(sensed: Sensed, begin_s: float, end_s: float) -> tuple[float, float]:
    """Error of the distance between two instants, by the wheel and by the slip detection [m]."""
    k, m = np.searchsorted(sensed.time_s, [begin_s, end_s])
    true = sensed.true_m[m] - sensed.true_m[k]
    return abs(sensed.wheel_m[m] - sensed.wheel_m[k]) - true, abs(
        sensed.found.distance_m[m] - sensed.found.distance_m[k]
    ) - true


def slide_lines() -> Iterator[str]:
    """Figure 3: repeated slides while braking from high speed."""
    quiet = Simulation(scenario_with("commercial-run", 400.0))
    begin, end = braking(quiet, 15.0)
    starts = np.arange(begin + 1.0, end - 3.0, 3.5)
    slips = [{"start_s": float(s), "end_s": float(s) + 2.5, "ratio": -0.3} for s in starts]
    simulation = Simulation(scenario_with("commercial-run", 400.0, slips=slips))
    samples, _ = sensors_of(simulation)
    yield f"{len(slips)} slides of 30 % in a braking of {end - begin:.0f} s: largest error of speed and distance"
    rules = (
        ("P2's rule", {"rule": "p2"}, False),
        ("rule of railfix, no map", {}, False),
        ("rule of railfix", {}, True),
    )
    for k, (name, limits, line) in enumerate(rules):
        sensed = sense(simulation, samples, SlipLimits.model_validate(limits), line=line)
        part = (sensed.time_s > begin) & (sensed.time_s < end)
        if k == 0:
            off = np.abs(sensed.wheel_mps - sensed.true_mps)[part].max()
            yield f"  {'the wheel':28s}{off:6.2f} m/s {way_error(sensed, begin, end + 2.0)[0]:+7.2f} m"
        off = np.nanmax(np.abs(np.abs(sensed.found.speed_mps) - sensed.true_mps)[part])
        yield f"  {name:28s}{off:6.2f} m/s {way_error(sensed, begin, end + 2.0)[1]:+7.2f} m"


def rolling_lines() -> Iterator[str]:
    """Figure 4: a train at rest that is freed on a gradient, without pulses below 1 km/h."""
    for permille in (5.0, 20.0):
        t = np.arange(0.0, 12.0, 0.02)
        free = t > 6.0
        force = np.where(free, 0.0, -GRAVITY_MPS2 * permille / 1e3)
        force = force + 0.005 * np.random.default_rng(3).normal(size=len(t))
        wheel = np.where(t < 0.5, 0.0, np.nan)
        found, _ = find_slips(MotionSamples(t, wheel, np.zeros(len(t)), force, np.full(len(t), np.nan)))
        rolling = found.state == MotionState.ROLLING
        true = GRAVITY_MPS2 * permille / 1e3 * (t - 6.0)
        first = int(np.argmax(rolling))
        error = np.abs(np.abs(found.speed_mps) - true)[rolling & (t < 8.0)]
        yield (
            f"  {permille:4.0f} permille: rolling known {t[first] - 6.0:.2f} s after the release at "
            f"{3.6 * true[first]:.2f} km/h; error of its speed in the first two seconds {error.max():.3f} m/s at most"
        )


def start_lines() -> Iterator[str]:
    """Figure 5: a start from rest, by inertia until the tachometer speaks."""
    simulation = Simulation(scenario_with("p1-test-line", 330.0, lowest_mps=1.5))
    samples, _ = sensors_of(simulation)
    for name, gyro in (("accelerometer alone, as P2's prototype", False), ("with the gyro", True)):
        sensed = sense(simulation, samples, SlipLimits(), gyro=gyro)
        still = np.flatnonzero((sensed.true_mps < 1e-3) & (sensed.time_s > 120.0))
        after = np.arange(still[-1], still[-1] + 500)
        silent = after[(sensed.wheel_mps[after] == 0.0) & (np.cumsum(sensed.wheel_mps[after]) == 0.0)]
        error = np.abs(np.abs(sensed.found.speed_mps) - sensed.true_mps)[silent]
        known = np.isfinite(error)
        yield (
            f"  {name:40s} {0.02 * len(silent):.1f} s without pulses, up to {sensed.true_mps[silent].max():.2f} m/s: "
            f"speed at {100 * known.mean():.0f} %, error {error[known].max(initial=0.0):.2f} m/s at most"
        )


# -- figures 6 to 8, table 1 ---------------------------------------------------------------------------------


def measured(seed: int) -> tuple[pl.DataFrame, stage.SensedMotion]:
    """What a run over the test line measures of it, by the distance of its wheel alone."""
    simulation = Simulation(scenario_with("p1-test-line", 180.0, seed))
    samples, _ = sensors_of(simulation)
    whole = sense(simulation, samples, SlipLimits())
    sensed = whole.intervals
    middle = 1.0 + 0.1 * np.arange(len(sensed.state)) + 0.05
    sine = np.interp(middle, whole.time_s - 0.1, whole.found.pitch)
    gyro = sine / np.sqrt(1.0 - sine**2)
    rolls = np.isfinite(sensed.curvature_1pm) & (sensed.state == MotionState.NORMAL)
    table = pl.DataFrame(
        {
            "measured_chainage_m": sensed.under_m[rolls],
            "measured_gradient_permille": 1e3 * gyro[rolls],
            "measured_curvature_1pm": sensed.curvature_1pm[rolls],
            "cant_mm": 1e3 * sensed.cant_m[rolls],
        }
    )
    return table.sort("measured_chainage_m"), sensed


def feature_lines(seeds: Sequence[int] = (1, 2)) -> Iterator[str]:
    """Table 1: gaps between the features that two runs show, by the wheel; figures 7 and 8: cant and curvature."""
    runs = [measured(seed)[0] for seed in seeds]
    found = find_features(runs)
    for quantity in ("gradient", "curvature"):
        places = [f.places_m for f in found if f.feature.quantity == quantity and len(f.places_m) == len(seeds)]
        gaps = [(b - a) @ [1.0, -1.0] for a, b in combinations(places, 2)]
        size = np.abs(gaps)
        yield (
            f"  {quantity:10s} {len(places)} features in both runs, {len(gaps)} gaps: differences rms "
            f"{np.sqrt(np.mean(size**2)):.2f} m, p95 {np.quantile(size, 0.95):.2f}, largest {size.max():.2f} m"
        )
    yield f"  P2 table 1: 5 gaps of the gradient, rms {np.sqrt(np.mean(np.square(P2_TABLE_1_M))):.2f} m, largest 0.15 m"
    grid = np.arange(60.0, 690.0, 5.0)
    for name, column, unit, scale in (
        ("cant", "cant_mm", "mm", 1.0),
        ("curvature", "measured_curvature_1pm", "1/km", 1e3),
        ("gradient", "measured_gradient_permille", "permille", 1.0),
    ):
        one, two = (
            scale * np.interp(grid, run["measured_chainage_m"].to_numpy(), run[column].to_numpy()) for run in runs
        )
        apart = np.abs(one - two)
        yield (
            f"  {name:10s} range {one.min():+.2f} .. {one.max():+.2f} {unit}, difference of the two runs "
            f"p50 {np.median(apart):.2f}, p95 {np.quantile(apart, 0.95):.2f}"
        )


# -- figure 11, radar in place of the tachometer ---------------------------------------------------------------


def radar_lines() -> Iterator[str]:
    """The distance through slips: tachometer, tachometer and inertial unit, a radar in the tachometer's place."""
    slips = {"slip_chance": 0.6, "slide_chance": 0.6}
    simulation = Simulation(scenario_with("commercial-run", 900.0, drawn_slips=slips))
    samples, _ = sensors_of(simulation)
    sensed = sense(simulation, samples, SlipLimits(), line=True)
    assert samples.radar is not None
    t = seconds(samples.radar.time - simulation.scenario.start)
    speed = np.nan_to_num(samples.radar.speed_mps)
    distance = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(t))])
    radar_m = np.interp(sensed.time_s, t, distance)
    true = np.abs(simulation.motion.at(t)[1])
    heard, moves = np.isfinite(samples.radar.speed_mps), true > 1.0
    yield (
        f"  radar: a speed at {100 * heard[moves].mean():.1f} % of the instants faster than 1 m/s, "
        f"error {np.std((speed - true)[heard & moves]):.3f} m/s"
    )
    yield "  error of the distance over 60 s [m]      p50    p95    largest"
    step = 3000
    for name, distance in (
        ("tachometer", sensed.wheel_m),
        ("tachometer, inertial unit, map", sensed.found.distance_m),
        ("radar in the tachometer's place", radar_m),
    ):
        error = np.abs(
            np.abs(distance[step::250] - distance[:-step:250]) - (sensed.true_m[step::250] - sensed.true_m[:-step:250])
        )
        yield f"  {name:33s}{np.median(error):6.2f} {np.quantile(error, 0.95):6.2f} {error.max():10.2f}"


# -- the notch -------------------------------------------------------------------------------------------------


def notch_lines() -> Iterator[str]:
    """P2 2.2: false slips by pulses counted and averaged, and by intervals, where no wheel slips."""
    simulation = Simulation(scenario_with("commercial-run", 900.0))
    samples, _ = sensors_of(simulation)
    sensed = sense(simulation, samples, SlipLimits(rule="p2"), line=True, gyro=False)
    intervals = np.isin(sensed.found.state, SLIPPING)
    assert isinstance(samples.tachometer, TachometerPulses)
    number = np.searchsorted(samples.tachometer.time, simulation.scenario.start + timedelta(sensed.time_s))
    pulse_m = np.pi * 0.86 / 60.0
    for name, width in (("counted, mean of 1 s", 50), ("counted, mean of 0.1 s", 5)):
        counted = np.zeros(len(number))
        counted[width:] = (number[width:] - number[:-width]) * pulse_m / (0.02 * width)
        change = np.zeros(len(number))
        change[width:] = (counted[width:] - counted[:-width]) / (0.02 * width)
        force = np.gradient(sensed.true_mps, 0.02)
        over = (np.abs(force - change) > SlipLimits().p2_limit * GRAVITY_MPS2) & (sensed.true_mps > 1.0)
        yield false_slips(name, over)
    yield false_slips("intervals, not smoothed", intervals)


def false_slips(name: str, over: np.ndarray) -> str:
    """How often and how long a rule that has nothing to find found something."""
    events = int(np.count_nonzero(np.diff(np.concatenate([[False], over]).astype(np.int8)) == 1))
    minutes = len(over) * 0.02 / 60.0
    return f"  {name:26s}{events:5d} false slips in {minutes:.0f} min, {100 * over.mean():.1f} % of the time"


def report() -> Iterator[str]:
    """All of it."""
    yield "where the slip rule is blind: 20 m/s on the level, no noise"
    yield from blind_lines()
    yield "\nfigure 3: slides while braking"
    yield from slide_lines()
    yield "\nfigure 4: rolling away"
    yield from rolling_lines()
    yield "\nfigure 5: starting"
    yield from start_lines()
    yield "\ntable 1, figures 6 to 8: two runs over the test line, by tachometer and inertial unit alone"
    yield from feature_lines()
    yield "\nfigure 11, P2 4: a radar in the tachometer's place"
    yield from radar_lines()
    yield "\nP2 2.2: the notch"
    yield from notch_lines()


def main() -> int:
    for line in report():
        print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
