"""Pulse times of a tachometer on one wheel."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np
import polars as pl

from railfix.core.arrays import Floats
from railfix.core.timescale import timedelta
from railfix.simulate.sensors.settings import DrawnSlips, SlipInterval, TachometerSettings

if TYPE_CHECKING:
    from railfix.simulate.motion import Motion
    from railfix.simulate.signals import Simulation


#: Spacing of the instants between which the wheel's acceleration is constant [s].
_STEP_S: Final = 0.01
#: Spacing of the search for accelerations and brakings [s], and their least size [m/s^2].
_LOOK_S: Final = 0.1
_HARD_MPS2: Final = 0.05
#: Streams of random numbers: phase and jitter, slips, teeth, lost and doubled pulses.
_WHEEL, _SLIPS, _TEETH, _MISCOUNT = 20, 21, 30, 31


def wheel_slips(simulation: Simulation, settings: TachometerSettings) -> list[SlipInterval]:
    """Slips and slides of the run, given and drawn, in order; a drawn one that overlaps another is left out."""
    scenario = simulation.scenario
    rng = np.random.default_rng([scenario.seed, _SLIPS])
    slips = list(settings.slips)
    for new in _draw(simulation.motion, scenario.duration_s, settings.drawn_slips, rng):
        if all(new.start_s >= old.end_s or old.start_s >= new.end_s for old in slips):
            slips.append(new)
    return sorted(slips, key=lambda slip: slip.start_s)


def _draw(motion: Motion, duration_s: float, drawn: DrawnSlips, rng: np.random.Generator) -> list[SlipInterval]:
    edges = np.arange(0.0, duration_s + _LOOK_S, _LOOK_S)
    speed = np.abs(motion.at(edges)[1])
    kind = np.sign(np.where(np.abs(np.diff(speed)) > _HARD_MPS2 * _LOOK_S, np.diff(speed), 0.0))
    change = np.flatnonzero(np.diff(kind, prepend=0.0, append=0.0))
    found = []
    for first, last in pairwise(change.tolist()):
        if kind[first] == 0.0:
            continue
        # Always drawn, so that the slips of one phase do not depend on another's.
        chance, size, lasting, place = rng.uniform(size=4)
        if chance >= (drawn.slip_chance if kind[first] > 0.0 else drawn.slide_chance):
            continue
        room = float(edges[last] - edges[first])
        length = min(drawn.duration_s * (0.2 + 0.8 * float(lasting)), room)
        start = float(edges[first]) + float(place) * (room - length)
        ratio = float(kind[first]) * drawn.ratio * (0.2 + 0.8 * float(size))
        found.append(SlipInterval(start_s=start, end_s=start + length, ratio=ratio))
    return found


def slip_ratio(slips: list[SlipInterval], time_s: Floats) -> Floats:
    """Wheel speed over train speed, less 1, at times [s]."""
    ratio = np.zeros(np.shape(time_s))
    for slip in slips:
        part = (time_s - slip.start_s) / (slip.end_s - slip.start_s)
        ratio += np.where((part > 0.0) & (part < 1.0), slip.ratio * np.sin(np.pi * part), 0.0)
    return ratio


def pulse_times_s(
    motion: Motion,
    settings: TachometerSettings,
    slips: list[SlipInterval],
    duration_s: float,
    phase: float,
    *,
    tooth_errors: Floats | None = None,
) -> Floats:
    """Exact times of the pulses [s after the start], shape (P,).

    `phase`, in [0, 1): part of a pulse's distance that the wheel turns before the first one. `tooth_errors`, shape
    (pulses_per_turn,): displacement of each tooth as a share of their spacing.
    """
    # The motion's own corners are nodes too, so that without slips nothing is approximate.
    corner = motion.time_s[(motion.time_s > 0.0) & (motion.time_s < duration_s)]
    node = np.unique(np.concatenate([np.arange(0.0, duration_s, _STEP_S), corner, [duration_s]]))
    chainage, speed = motion.at(node)
    step = np.diff(node)
    surplus = np.abs(speed) * slip_ratio(slips, node)
    rolled = np.abs(np.diff(chainage)) + (surplus[1:] + surplus[:-1]) / 2.0 * step
    turned = np.concatenate([[0.0], np.cumsum(np.maximum(rolled, 0.0))])
    apart = np.pi * (settings.wheel_diameter_m + settings.diameter_error_m) / settings.pulses_per_turn
    target = apart * np.arange(phase, turned[-1] / apart, 1.0)
    times = _times_at(target, node, turned, np.abs(speed) + surplus)
    if tooth_errors is None:
        return times
    # The same tooth passes again after a turn, in either direction.
    tooth = np.cumsum(np.where(motion.at(times)[1] < 0.0, -1, 1)) % len(tooth_errors)
    moved = np.clip(target + apart * tooth_errors[tooth], 0.0, turned[-1])
    return _times_at(np.sort(moved), node, turned, np.abs(speed) + surplus)


def _times_at(target_m: Floats, node_s: Floats, turned_m: Floats, speed_mps: Floats) -> Floats:
    """Times at which the wheel has turned by given lengths of its rim; constant acceleration between nodes."""
    step = np.diff(node_s)
    cell = np.clip(np.searchsorted(turned_m, target_m, side="left") - 1, 0, len(step) - 1)
    # s = v t + a t^2 / 2 with the distance of the cell kept.
    start = speed_mps[cell]
    bend = 2.0 * (turned_m[cell + 1] - turned_m[cell] - start * step[cell]) / step[cell] ** 2
    ahead = target_m - turned_m[cell]
    root = np.sqrt(np.maximum(start**2 + 2.0 * bend * ahead, 0.0))
    with np.errstate(invalid="ignore", divide="ignore"):
        since = np.where(ahead > 0.0, 2.0 * ahead / (start + root), 0.0)
    return np.asarray(node_s[cell] + np.minimum(since, step[cell]))


def _miscount(time_s: Floats, settings: TachometerSettings, seed: int) -> Floats:
    """Pulse times with pulses lost and doubled at random; a doubled one comes before the next tooth."""
    if not (settings.lost_chance or settings.doubled_chance) or len(time_s) < 2:
        return time_s
    lost, doubled, part = np.random.default_rng([seed, _MISCOUNT]).uniform(size=(3, len(time_s)))
    gap = np.diff(time_s, append=2.0 * time_s[-1] - time_s[-2])
    second = time_s + (0.1 + 0.5 * part) * gap
    kept = lost >= settings.lost_chance
    return np.sort(np.concatenate([time_s[kept], second[kept & (doubled < settings.doubled_chance)]]))


def pulse_table(simulation: Simulation, settings: TachometerSettings) -> pl.DataFrame:
    """Pulses as the tachometer gives them, see `railfix.simulate.sensors.tables.COLUMNS`."""
    scenario = simulation.scenario
    rng = np.random.default_rng([scenario.seed, _WHEEL])
    slips = wheel_slips(simulation, settings)
    teeth = None
    if settings.tooth_sigma > 0.0:
        draw = np.random.default_rng([scenario.seed, _TEETH]).standard_normal(settings.pulses_per_turn)
        teeth = np.clip(settings.tooth_sigma * draw, -0.45, 0.45)
    phase = float(rng.uniform())
    time = pulse_times_s(simulation.motion, settings, slips, scenario.duration_s, phase, tooth_errors=teeth)
    time = _miscount(time, settings, scenario.seed)
    speed = simulation.motion.at(time)[1]
    turning = np.abs(speed) * (1.0 + slip_ratio(slips, time))
    kept = turning >= settings.lowest_mps
    time, direction = time[kept], np.where(speed[kept] < 0.0, -1, 1).astype(np.int8)
    if settings.jitter_s > 0.0:
        time = time + settings.jitter_s * rng.standard_normal(len(time))
        order = np.argsort(time, kind="stable")
        time, direction = time[order], direction[order]
    if settings.resolution_s > 0.0:
        time = np.rint(time / settings.resolution_s) * settings.resolution_s
    tag = scenario.start + timedelta(time)
    return pl.DataFrame(
        {"time_gpst": tag, "pulse": np.arange(1, len(time) + 1, dtype=np.int64), "direction": direction}
    )


def slip_table(simulation: Simulation, settings: TachometerSettings) -> pl.DataFrame:
    """Truth of the wheel's slips and slides, see `railfix.simulate.sensors.tables.COLUMNS`."""
    scenario = simulation.scenario
    slips = wheel_slips(simulation, settings)
    start = scenario.start + timedelta([slip.start_s for slip in slips])
    end = scenario.start + timedelta([slip.end_s for slip in slips])
    ratio = np.array([slip.ratio for slip in slips], dtype=np.float64)
    return pl.DataFrame({"time_gpst": start, "end_gpst": end, "ratio": ratio})
