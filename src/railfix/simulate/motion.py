"""Chainage and speed of the train over time: pieces of constant acceleration.

A shuttle between two points, or a run curve: as fast as the line, its curves and the train allow,
stopping at stations.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.simulate.alignment import Alignment
from railfix.simulate.kinematics import Motion, limit_jerk
from railfix.simulate.scenario import RunSettings, Scenario, Station

#: Spacing of the places at which a run curve looks at the limits [m].
_STEP_M: Final = 2.0
_GRAVITY: Final = 9.806_65
#: Contact points of the wheels lie further apart than the gauge [m].
_RAIL_HEAD_M: Final = 0.070


def build_motion(line: Alignment, scenario: Scenario, *, duration_s: float | None = None) -> Motion:
    """Motion of the vehicle's middle: a shuttle, or a run curve where stations, limits or the like are given.

    Its duration is the scenario's unless given; 0: one way, to the last stop and its stand. SettingsError: when the
    train has no room on the line.
    """
    settings = scenario.run
    scenario.check_room(line.length_m)
    lasting = scenario.duration_s if duration_s is None else duration_s
    margin = settings.end_margin_m
    usual = RunSettings()
    plain = ("stations", "limits", "cant_deficiency_m", "direction", "at_end")
    if all(getattr(settings, name) == getattr(usual, name) for name in plain):
        motion = shuttle(margin, line.length_m - margin, lasting, settings)
    else:
        motion = run_curve(line, settings, lasting, contact_m=scenario.vehicle.gauge_m + _RAIL_HEAD_M)
    return motion if settings.jerk_mps3 is None else limit_jerk(motion, settings.jerk_mps3)


def shuttle(first_m: float, last_m: float, duration_s: float, settings: RunSettings) -> Motion:
    """Motion between two chainages, standing at each, for at least a duration."""
    length = last_m - first_m
    up, down = settings.acceleration_mps2, settings.deceleration_mps2
    top = min(settings.cruise_mps, float(np.sqrt(2.0 * length * up * down / (up + down))))
    cruise_s = max(0.0, (length - top**2 / (2.0 * up) - top**2 / (2.0 * down)) / top)
    # One leg: accelerate, cruise, brake, stand; in the units of its own direction.
    steps = np.array([top / up, cruise_s, top / down, settings.stand_s])
    offsets = np.array([0.0, top**2 / (2.0 * up), length - top**2 / (2.0 * down), length])
    speeds, accelerations = np.array([0.0, top, top, 0.0]), np.array([up, 0.0, -down, 0.0])
    legs = max(1, int(np.ceil((duration_s - settings.first_stand_s) / steps.sum())))
    outward = (np.arange(legs) % 2 == 0)[:, None]
    sign = np.where(outward, 1.0, -1.0)
    chainage = np.where(outward, first_m + offsets, last_m - offsets).ravel()
    ends = settings.first_stand_s + np.cumsum(np.tile(steps, legs))
    return Motion(
        time_s=np.concatenate([[0.0, settings.first_stand_s], ends[:-1]]),
        chainage_m=np.concatenate([[first_m], chainage]),
        speed_mps=np.concatenate([[0.0], (sign * speeds).ravel()]),
        acceleration_mps2=np.concatenate([[0.0], (sign * accelerations).ravel()]),
    )


def run_curve(line: Alignment, settings: RunSettings, duration_s: float, *, contact_m: float) -> Motion:
    """Motion from stop to stop at the highest allowed speed, for at least a duration and to the last stop at least.

    The distance of the wheels' contact points gives the speed in canted curves.
    """
    margin = settings.end_margin_m
    ends = (
        Station(at_m=margin, dwell_s=settings.stand_s),
        Station(at_m=line.length_m - margin, dwell_s=settings.stand_s),
    )
    stops = settings.stations or ends
    if settings.direction == "falling":
        stops = stops[::-1]
    time, pieces = settings.first_stand_s, [np.array([[0.0], [stops[0].at_m], [0.0], [0.0]])]
    while True:
        for start, stop in pairwise(stops):
            leg = _leg(line, settings, start.at_m, stop.at_m, contact_m)
            leg[0] += time
            time = float(leg[0, -1]) + stop.dwell_s
            pieces.append(leg)
        if time >= duration_s or settings.at_end == "stand":
            break
        stops = stops[::-1]
    table = np.concatenate(pieces, axis=1)
    return Motion(time_s=table[0], chainage_m=table[1], speed_mps=table[2], acceleration_mps2=table[3])


def _leg(line: Alignment, settings: RunSettings, first_m: float, last_m: float, contact_m: float) -> Floats:
    """From standing to standing: rows of time from the start, chainage, speed and acceleration, shape (4, P).

    The square of the speed that can be reached from the limits behind is the least of their squares
    plus ``2 a`` times the distance to each; from the limits ahead likewise.
    """
    cells = max(2, int(np.ceil(abs(last_m - first_m) / _STEP_M)))
    way = np.linspace(0.0, abs(last_m - first_m), cells + 1)
    sign = 1.0 if last_m > first_m else -1.0
    square = _limits(line, settings, first_m + sign * way, contact_m) ** 2
    # A limit holds in the cells on both sides of its place.
    square = np.minimum(square, np.minimum(np.append(square[1:], np.inf), np.append(np.inf, square[:-1])))
    square[[0, -1]] = 0.0
    up, down = 2.0 * settings.acceleration_mps2 * way, 2.0 * settings.deceleration_mps2 * way
    square = np.minimum(square, np.minimum.accumulate(square - up) + up)
    square = np.maximum(np.minimum(square, np.minimum.accumulate((square + down)[::-1])[::-1] - down), 0.0)
    square[[0, -1]] = 0.0
    # Cells of one acceleration are one piece.
    acceleration = np.diff(square) / (2.0 * np.diff(way))
    change = np.flatnonzero(np.abs(np.diff(acceleration)) > 1e-6) + 1
    corner = np.concatenate([[0], change, [cells]])
    way, speed = way[corner], np.sqrt(square[corner])
    acceleration = np.diff(square[corner]) / (2.0 * np.diff(way))
    lasting = 2.0 * np.diff(way) / (speed[:-1] + speed[1:])
    return np.stack(
        [
            np.concatenate([[0.0], np.cumsum(lasting)]),
            np.append(first_m + sign * way[:-1], last_m),
            sign * speed,
            np.append(sign * acceleration, 0.0),
        ]
    )


def _limits(line: Alignment, settings: RunSettings, chainage_m: Floats, contact_m: float) -> Floats:
    """Highest speed at places [m/s]: cruising, limits of the line, and curves."""
    limit = np.full(chainage_m.shape, settings.cruise_mps)
    for part in settings.limits:
        inside = (chainage_m >= part.from_m) & (chainage_m <= part.to_m)
        limit[inside] = np.minimum(limit[inside], part.limit_mps)
    if settings.cant_deficiency_m is not None:
        bend = np.abs(line.curvature_at(chainage_m))
        cant = np.abs(line.lean_at(chainage_m)) + settings.cant_deficiency_m
        # Equilibrium: v^2 curvature / g = cant / distance of the contact points.
        limit = np.minimum(limit, np.sqrt(_GRAVITY * cant / (contact_m * np.maximum(bend, 1e-9))))
    return limit
