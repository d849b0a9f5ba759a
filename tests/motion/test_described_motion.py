"""Slips, pulses, features and merged samples, step by step, against a reviewed text.

Motions are given in closed form, so that the numbers can be checked by hand. After an intended change,
``python tests/motion/test_described_motion.py`` writes the references again; review their difference.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Final

import numpy as np
import pytest

if __name__ == "__main__":
    sys.path[:0] = [str(folder) for folder in sorted(Path(__file__).resolve().parents[1].iterdir()) if folder.is_dir()]

from described import check_described, describe, write_described
from railfix.core.timescale import timedelta
from railfix.motion.features import LineSeries, line_series, locate, map_features
from railfix.motion.samples import RadarSpeeds, SensorSamples, TachometerPulses
from railfix.motion.slip import MotionSamples, MotionState, SlipLimits, find_slips
from railfix.motion.tachometer import TachometerLimits, distance_m, pulse_speeds, tooth_faults
from slip_motion import Motion, even_motion, motion
from tracking_cases import bent_line

START: Final = np.datetime64("2024-03-05T00:00:00", "ns")


def _shown(case: Motion, limits: SlipLimits, body: np.ndarray | None, *, line: bool = True) -> Iterator[str]:
    """Yield the state each second and at every change of it."""
    acceleration = np.gradient(case.wheel, case.time_s)
    sine = case.sine if line else np.full(len(case.time_s), np.nan)
    found, _ = find_slips(
        MotionSamples(case.time_s, case.wheel, acceleration, case.force, sine, body), limits=limits
    )  # fmt: skip
    changed = np.flatnonzero(np.diff(found.state, prepend=-1))
    for k in np.union1d(changed, np.arange(0, len(case.time_s), 50)):
        values = (found.speed_mps, found.distance_m, 1e3 * found.smooth, 1e3 * found.pitch, 1e3 * found.gyro_bias_radps)
        numbers = " ".join(f"{round(float(value[k]), 3) + 0.0:.3f}" for value in values)
        yield f"  {case.time_s[k]:.2f} s {MotionState(found.state[k]).name} {numbers}"


def _slips(_: Path) -> Iterator[Iterable[str]]:
    """Slip and slide, one downhill, noise, a curve with cant and a gyro, a wheel without pulses, each rule."""
    slip = even_motion(16.0, 4.0, 2.0, 3.0)
    slide = Motion(slip.time_s, slip.speed, 40.0 - slip.wheel, slip.force, slip.sine)
    noisy = motion(20.0, [(8.0, 2.0, 0.3)], noise=0.05, pitching=0.003, seed=5)
    silent = Motion(slip.time_s, slip.speed, np.where(slip.time_s > 9.0, np.nan, slip.wheel), slip.force, slip.sine)
    hill = Motion(slip.time_s, slip.speed, slip.wheel, slip.force - 0.3923, slip.sine - 0.04)
    for name, case in (("slip", slip), ("slide", slide), ("noisy", noisy), ("silent", silent), ("hill", hill)):
        for rule in ("map", "p2"):
            yield [f"{name} {rule}", *_shown(case, SlipLimits(rule=rule), None)]
    # body in a curve of 400 m with a cant of 3 degrees less than the speed asks for; then leaning beyond the limit
    for right, yaw in ((0.4, 0.05), (9.0, 0.05)):
        body = np.tile([right, 0.001, yaw], (len(slip.time_s), 1))
        for name, case in (("slip", slip), ("silent", silent)):
            yield [f"{name} in a curve, {right:g} m/s2", *_shown(case, SlipLimits(), body, line=False)]


def _pulses(_: Path) -> Iterator[Iterable[str]]:
    """Speeds and distances of pulses forward, backward, without a direction, lost and doubled."""
    gaps = np.array([0.0, 0.5, 0.25, 0.25, 0.1, 0.1, 0.1, 0.05, 0.05, 0.4, 0.1])
    time, number = START + timedelta(np.cumsum(gaps)), np.array([0, 1, 2, 3, 4, 5, 7, 8, 9, 8, 7])
    at = START + timedelta(np.arange(-0.1, 2.4, 0.1))
    for direction, some in ((np.zeros(11, int), 11), (np.array([1] * 9 + [-1] * 2), 11), (np.ones(1, int), 1)):
        pulses = TachometerPulses(time=time[:some], pulse=number[:some], direction=direction)
        for limits in (TachometerLimits(), TachometerLimits(jitter_s=1e-3, resolution_s=1e-2, window_s=0.3)):
            yield [*describe(pulse_speeds(pulses, at, limits=limits)), *describe(distance_m(pulses, at, limits=limits))]
        lost, doubled = tooth_faults(pulses)
        yield [f"lost {np.flatnonzero(lost).tolist()}, doubled {np.flatnonzero(doubled).tolist()}"]
    speeds = [np.array([1.0, 3.0, 5.0]), np.array([4.0, 6.0])]
    radar = [RadarSpeeds(time=START + timedelta(each), speed_mps=each) for each in speeds]
    for early, late in ((0, 1), (1, 0)):
        merged = SensorSamples(radar=radar[early]).merge(SensorSamples(radar=radar[late])).radar
        yield [f"merged {merged.speed_mps.tolist()}"]


def _features(_: Path) -> Iterator[Iterable[str]]:
    """Places of a change of the gradient by its sharpness and the width of the prediction, also between the steps."""
    arc = np.arange(0.0, 600.0, 1.0)
    for sharp in (3.0, 12.0, 40.0):
        gradient = 0.01 / (1.0 + np.exp(-(arc - 300.0) / sharp))
        line = LineSeries(arc_m=arc, gradient=gradient, curvature_1pm=np.zeros(600))
        for place in (300.0, 300.1, 307.3):
            along = np.arange(-60.0, 60.5, 1.0)
            ripple = 2e-4 * np.cos(along * 1.7)
            own = LineSeries(
                arc_m=along, gradient=np.interp(place + along, arc, gradient) + ripple,
                curvature_1pm=1e-4 * np.sin(along),
            )  # fmt: skip
            for sigma_m, noise in ((8.0, 2e-4), (2.0, 1e-3), (0.375, 2e-4)):
                found = locate(own, line, 300.0, sigma_m, quantity="gradient", noise=(noise, 1e-4))
                case = f"{sharp:g} {place:g} {sigma_m:g} {noise:g}"
                yield [f"{case}: {found.verdict} {found.arc_m:.4f} {found.sigma_m:.4f} {found.reason}"]
    series = line_series(bent_line())
    yield [*describe(series), *(f"{f.quantity} {f.arc_m:.3f} {1e3 * f.change:.4f}" for f in map_features(series))]


CASES: Final[dict[str, Callable[[Path], Iterable[Iterable[str]]]]] = {
    "motion_slips": _slips,
    "motion_pulses": _pulses,
    "motion_features": _features,
}


@pytest.mark.requirement("E1", "E2", "E3")
@pytest.mark.parametrize("name", CASES)
def test_motions_give_what_was_reviewed(name: str, tmp_path: Path) -> None:
    check_described(name, CASES[name](tmp_path))


if __name__ == "__main__":
    write_described(CASES, sys.argv[1:])
