"""Slips and slides by wheel and inertial unit over hours of simulated running: ``python tests/studies/slip_score.py
[HOURS]``.

The runs are those of the scenario `commercial-run` with other seeds, a body that pitches (0.15 degrees at random, 0.3
degrees a m/s2) and vibration (0.3 m/s2), and slips and slides at 60 % of the accelerations and brakings. The place for
the line's gradient begins from the ground truth with an error of 2 m every 5 s, as from the filter. Three rules: P2's
own, the line's gradient, and the same with the pitch gyro. "Distance" is its error from 1 s before a slip to 3 s
after it, against what a wheel that rolls counts there: its diameter, off by 0.09 % in this scenario, is the filter's.
The table of the runs so far goes to stderr after each run, a minute's work or less.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from typing import TextIO
from unittest import mock

import numpy as np

import paths  # noqa: F401
from railfix.core.timescale import seconds, timedelta
from railfix.motion.slip import MotionSamples, MotionState, SlipLimits, SlipResult, find_slips
from railfix.motion.tachometer import distance_m
from railfix.pipeline import sensed_motion as stage
from railfix.pipeline.sensor_epochs import SensorLimits, SensorState, sensor_epochs
from railfix.simulate import Simulation
from railfix.simulate.body_sensors import wheel_slips
from railfix.simulate.scenario_file import load_recipe
from railfix.track.trajectory import Trajectory
from railfix.tracking import Line
from sensed_ride import sensors_of

INERTIAL = (MotionState.INERTIAL_SPIN, MotionState.INERTIAL_SLIDE)
STRETCH_S = 5.0
PLACE_SIGMA_M = 2.0
#: A slip that must be found: its duration and the largest acceleration of the wheel against the train.
LEAST_S, LEAST_MPS2 = 0.5, 0.3
RULES: dict[str, tuple[str, bool]] = {"p2": ("p2", False), "map": ("map", False), "map, gyro": ("map", True)}


@dataclass
class Score:
    """Counts of one rule over all runs."""

    slips: int = 0
    missed: list[tuple[float, float]] = field(default_factory=list)
    late_s: list[float] = field(default_factory=list)
    flagged: list[float] = field(default_factory=list)
    distance_m: list[float] = field(default_factory=list)
    alarms: int = 0
    #: Of these, carries that the end of a slip has not released within 5 s.
    held: int = 0
    hours: float = 0.0


def shaken(seed: int) -> Simulation:
    """A run with pitching, vibration and slips."""
    scenario = load_recipe("commercial-run").scenario()
    sensors = scenario.sensors
    assert sensors is not None
    assert sensors.tachometer is not None
    assert sensors.inertial is not None
    drawn = sensors.tachometer.drawn_slips.replaced(slip_chance=0.6, slide_chance=0.6)
    return Simulation(
        scenario.replaced(
            seed=seed,
            vehicle=scenario.vehicle.replaced(pitch_sigma_deg=0.15, pitch_deg_per_mps2=0.3),
            sensors=sensors.replaced(
                tachometer=sensors.tachometer.replaced(drawn_slips=drawn),
                inertial=sensors.inertial.replaced(vibration_sigma_mps2=0.3),
                radar=None,
            ),
        )
    )


def scored(simulation: Simulation, scores: dict[str, Score]) -> None:
    """Add one run to the scores."""
    scenario, line = simulation.scenario, simulation.line
    samples, _ = sensors_of(simulation)
    begin = scenario.start
    trajectory = Trajectory.from_antenna_path(line.track())
    course = Line(trajectory)

    def sine_at(arc: np.ndarray) -> np.ndarray:
        slope = course.gradient_at(arc)
        return slope / np.sqrt(1.0 + slope**2)

    edges_s = np.arange(1.0, scenario.duration_s, STRETCH_S)
    true = np.interp(simulation.motion.at(edges_s)[0], line.point_chainage_m(), line.track().chainage_m)
    noise = np.random.default_rng(scenario.seed).normal(size=len(edges_s)) * PLACE_SIGMA_M
    place = trajectory.arc_at_chainage(np.clip(true, *trajectory.chainage_m[[0, -1]])) + noise
    slips = wheel_slips(simulation, scenario.sensors.tachometer)  # type: ignore[union-attr, arg-type]
    for name, (rule, gyro) in RULES.items():
        limits = SlipLimits.model_validate({"rule": rule})
        kept: list[SlipResult] = []

        def keeping(
            samples: MotionSamples, gyro: bool = gyro, kept: list[SlipResult] = kept, **words: object
        ) -> object:
            found = find_slips(samples if gyro else samples._replace(body=None), **words)  # type: ignore[arg-type]
            kept.append(found[0])
            return found

        state = SensorState.empty()
        given = SensorLimits(slip=limits)
        with mock.patch.object(stage, "find_slips", keeping):
            for k, time in enumerate(begin + timedelta(edges_s)):
                if state.motion.tick:
                    state = replace(state, motion=replace(state.motion, arc_m=float(place[k - 1])))
                heard = samples.between(state.time, time)
                _, _, state = sensor_epochs(
                    heard, np.array([time]), trajectory, state,
                    limits=given, sine_at=sine_at, sources=("wheel", "force"),
                )  # fmt: skip
        found_state, distance = (np.concatenate([getattr(r, n) for r in kept]) for n in ("state", "distance_m"))
        t = float(edges_s[0]) + 0.02 * np.arange(1, len(found_state) + 1)
        count(scores[name], t, found_state, distance, simulation, slips)
    rolled = distance_m(samples.tachometer, begin + timedelta(t))
    count(scores["wheel itself"], t, np.zeros(len(t)), np.asarray(rolled), simulation, slips)
    assert abs(float(seconds(begin - scenario.start))) < 1e-9


def count(
    score: Score, t: np.ndarray, state: np.ndarray, distance: np.ndarray, simulation: Simulation, slips: list
) -> None:
    """Add one rule's answer on one run."""
    wheel = simulation.scenario.sensors.tachometer  # type: ignore[union-attr]
    rolling = wheel.wheel_diameter_m / (wheel.wheel_diameter_m + wheel.diameter_error_m)  # type: ignore[union-attr]
    flagged = np.isin(state, INERTIAL)
    covered = np.zeros(len(t), dtype=bool)
    for slip in slips:
        inside = (t >= slip.start_s) & (t <= slip.end_s)
        near = (t >= slip.start_s) & (t <= slip.end_s + 0.5)
        covered |= (t >= slip.start_s - 0.2) & (t <= slip.end_s + 5.0)
        duration = slip.end_s - slip.start_s
        speed = float(np.abs(simulation.motion.at(np.array([0.5 * (slip.start_s + slip.end_s)]))[1][0]))
        size = speed * abs(slip.ratio) * np.pi / duration
        if duration < LEAST_S or size < LEAST_MPS2 or not inside.any() or slip.end_s + 3.0 > t[-1]:
            continue
        score.slips += 1
        hit = np.flatnonzero(flagged & near)
        if len(hit):
            score.late_s.append(float(t[hit[0]] - slip.start_s))
        else:
            score.missed.append((duration, size))
        score.flagged.append(float(flagged[inside].mean()))
        k, m = np.searchsorted(t, [slip.start_s - 1.0, slip.end_s + 3.0])
        chainage = simulation.motion.at(t[[k, m]])[0]
        score.distance_m.append(float(abs(distance[m] - distance[k]) - rolling * abs(chainage[1] - chainage[0])))
    raised = np.flatnonzero(np.diff((flagged & ~covered).astype(int)) == 1)
    score.alarms += len(raised)
    score.held += int(np.count_nonzero(flagged[raised]))
    score.hours += (t[-1] - t[0]) / 3600.0


def main() -> int:
    hours = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    scores = {name: Score() for name in (*RULES, "wheel itself")}
    seed = 100
    while scores["p2"].hours < hours:
        scored(shaken(seed), scores)
        seed += 1
        table(scores, sys.stderr)
    table(scores, sys.stdout)
    return 0


def table(scores: dict[str, Score], file: TextIO) -> None:
    """Print one line a rule for the hours so far, and its first five misses."""
    for name, score in scores.items():
        distance = np.abs(score.distance_m)
        late = f"{np.median(score.late_s):.2f}" if score.late_s else "-"
        print(
            f"{name:13s} {score.slips} slips in {score.hours:.1f} h: missed {len(score.missed)}, found after {late} s, "
            f"instants flagged {100 * np.mean(score.flagged):3.0f} %, false alarms {score.alarms} "
            f"({score.alarms / score.hours:.2f} an hour; {score.held} are carries not released), "
            f"distance p50 {np.median(distance):.2f} p95 {np.percentile(distance, 95):.2f} "
            f"largest {distance.max():.2f} m, "
            f"within 0.15 m {100 * np.mean(distance <= 0.15):.0f} %",
            file=file,
            flush=True,
        )
        for duration, size in score.missed[:5]:
            print(f"    missed: {duration:.1f} s, {size:.2f} m/s2", file=file, flush=True)


if __name__ == "__main__":
    sys.exit(main())
