"""Pulls along the track against a wheel: when they are suspected, and false alarms without one.

``python tests/studies/wheel_trials.py`` prints tests/references/results/wheel_trials.txt: pulls of 0.5 m/s with C/N0
and Dopplers as before, which nothing but a wheel shows, on the demonstration's line at 1 Hz with a tachometer; clean
simulated rides with slip and slide; and, with the recordings beside the checkout, the drive with a wheel. Last, what
an inertial unit would leave unseen in the wheel's place.
"""

from __future__ import annotations

import sys
from typing import Final

import numpy as np

import paths
import filter_score
import recordings_score
import recordings_truth
import sensed_ride
import signal_attacks
from railfix.core.geodesy import geodetic_from_ecef
from railfix.core.timescale import seconds
from railfix.evaluate import interpolate_reference
from railfix.integrity.interference import InterferenceLimits, WheelState, wheel_signs
from railfix.pipeline.filter_result import AlongTrack
from railfix.simulate import Scenario
from railfix.simulate.scenario_file import load_recipe
from railfix.tracking.result import is_bounded
from sensed_ride import Ride
from signal_attacks import Scene

#: Scenarios of the pulls, and pulls of each.
_SEEDS: Final = (1, 2, 3, 4)
_PULLS: Final = 10
#: The attack begins within these epochs.
_FIRST, _LAST = 60, 80
#: Seeds of the clean rides with drawn slips and slides.
_RIDES: Final = (1,)
#: Seconds before a window in which speed and bias of an inertial unit are fitted.
_FIT_S: Final = 120
_GRAVITY_MPS2: Final = 9.8
#: A tachometer on a wheel whose diameter is wrong by 0.2 %.
_WHEEL: Final = {"tachometer": {"diameter_error_m": 0.002, "jitter_s": 2e-6}, "inertial": None, "radar": None}


def scene_of(ride: Ride) -> Scene:
    simulation = ride.simulation
    place = simulation.truth("front", ride.time_s)[0].ecef_m
    return Scene.of(ride.observations, simulation.navigation, place)


def exceeded(ride: Ride, found: AlongTrack) -> int:
    """Epochs whose error exceeds a level of the filter."""
    tracked = found.tracked
    bounded = is_bounded(tracked.status) & np.isfinite(tracked.level_m)
    return int((bounded & (np.abs(ride.error_m(found)) > tracked.level_m)).sum())


def pulls() -> str:
    rng, delays, errors, early, unseen = np.random.default_rng(7), [], [], 0, 0
    over, covered, levels = 0, 0, []
    for seed in _SEEDS:
        ride = sensed_ride.made(load_recipe("demo").scenario().replaced(seed=seed, rate_hz=1.0, sensors=_WHEEL))
        scene = scene_of(ride)
        for at in rng.integers(_FIRST, _LAST, _PULLS).tolist():
            attacked = signal_attacks.pulled(scene, at, rng.choice([-0.5, 0.5]), rng=rng)
            found = ride.run(observations=attacked)
            assert found.wheel is not None
            after = np.flatnonzero(found.wheel.parted)
            early += int((after < at).sum())
            over += exceeded(ride, found) > 0
            bounded = ride.run(observations=attacked, interference={"wheel_level": "on"})
            covered += exceeded(ride, bounded) > 0
            levels.append([np.median(f.tracked.level_m[:at]) for f in (found, bounded)])
            after = after[after >= at]
            unseen += not len(after)
            if len(after):
                delays.append(ride.time_s[after[0]] - ride.time_s[at])
                errors.append(abs(ride.error_m(found)[after[0]]))
    delay, error = np.array(delays), np.array(errors)
    times = f"{np.median(delay):.0f} s, at most {delay.max():.0f} s" if len(delay) else "-"
    return (
        f"pull of 0.5 m/s, C/N0 as before: {len(delays)} of {len(delays) + unseen} seen after {times} "
        f"(p50 of the error then {np.median(error) if len(error) else np.nan:.0f} m); early epochs {early}; "
        f"rides over a level {over}; with wheel_level on {covered}, median level before the pull "
        f"{np.median(levels, axis=0)[0]:.1f} m, then {np.median(levels, axis=0)[1]:.1f} m"
    )


def clean(scenario: Scenario, name: str) -> str:
    ride = sensed_ride.made(scenario)
    found = ride.run()
    assert found.wheel is not None
    difference = np.abs(found.wheel.difference_m)
    largest = np.nanmax(difference) if np.isfinite(difference).any() else np.nan
    compared = int(np.isfinite(difference).sum())
    return f"{name:34} {len(found):6} {compared:9} {int(found.wheel.parted.sum()):7} {largest:12.1f}"


def inertial(scenario: Scenario) -> str:
    """Distance by an inertial unit on a clean ride less the true one, at best: by its forward force less the map's
    gradient, with speed and bias fitted to the true distances of two minutes before."""
    ride = sensed_ride.made(scenario)
    unit, track = ride.samples.inertial, ride.simulation.line.track()
    assert unit is not None
    at = seconds(unit.time - ride.observations.time[0])
    chainage = np.interp(at, ride.time_s, ride.chainage_m)
    height = geodetic_from_ecef(track.ecef_m)[2]
    gradient = np.interp(chainage, track.chainage_m, np.gradient(height, track.chainage_m))
    force = unit.force_mps2[:, 0] - _GRAVITY_MPS2 * gradient
    speed = np.concatenate([[0.0], np.cumsum(0.5 * (force[1:] + force[:-1]) * np.diff(at))])
    way = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(at))])
    error = np.interp(ride.time_s, at, way) - ride.chainage_m
    found = {}
    for window in (10, 30, 60):
        left = []
        for first in range(60, len(error) - _FIT_S - window, 10):
            fitted = slice(first, first + _FIT_S)
            line = np.polynomial.Polynomial.fit(ride.time_s[fitted], error[fitted], 2)
            end = first + _FIT_S + window - 1
            left.append(abs(error[end] - line(ride.time_s[end])))
        found[window] = np.array(left)
    each = "; ".join(
        f"after {window} s {np.median(left):.1f}, {np.percentile(left, 95):.1f}, {left.max():.1f} (pull {window / 2:g})"
        for window, left in found.items()
    )
    return f"inertial unit alone, error of the distance [m], p50, p95, largest of {len(found[60])}: {each}"


def smartloc() -> str:
    """Codes of a deep city with the car's wheel; it brakes as no train does, its positions are off by tens of m."""
    case = filter_score.smartloc_case(paths.DATA)
    folder = paths.DATA / "kinematic" / "smartloc_berlin"
    error = recordings_score.smartloc(paths.DATA, filter_score.CONFIG).error_m
    reference = interpolate_reference(case.epochs.time, *recordings_truth.smartloc_truth(folder))
    arc = case.trajectory.nearest(np.nan_to_num(reference))[0] + error
    limits = InterferenceLimits(wheel_acceleration_mps2=6.0)
    assert case.wheel is not None
    rolled = case.wheel.wheel_m
    assert rolled is not None
    rows = []
    for sigma in (5.0, 10.0):
        given = np.full(len(arc), sigma)
        signs, _ = wheel_signs(case.epochs.time, arc, given, rolled, WheelState(), limits, signed=True)
        difference = np.abs(signs.difference_m)
        rows.append(
            f"{f'smartloc, sigma taken as {sigma:g} m':34} {len(arc):6} {int(np.isfinite(difference).sum()):9} "
            f"{int(signs.parted.sum()):7} {np.nanmax(difference):12.1f}"
        )
    span = seconds(case.epochs.time[-1:] - case.epochs.time[0])[0]
    return "\n".join([*rows, f"{'':34} {span:.0f} s"])


def main() -> int:
    print(f"{'without an attack':34} {'epochs':>6} {'compared':>9} {'alarms':>7} {'largest [m]':>12}", flush=True)
    for seed in _SEEDS:
        demo = load_recipe("demo").scenario().replaced(seed=seed, rate_hz=1.0, sensors=_WHEEL)
        print(clean(demo, f"demonstration, seed {seed}"), flush=True)
    if paths.DATA.is_dir():
        print(smartloc(), flush=True)
    print(pulls(), flush=True)
    for seed in _RIDES:
        run = load_recipe("commercial-run").scenario().replaced(seed=seed, rate_hz=1.0)
        print(clean(run, f"36 km with slip and slide, seed {seed}"), flush=True)
        print(inertial(run), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
