"""Braking curves: permitted speed of a train that approaches the end of its authority, on a line with gradients.

This is a simplified form of SUBSET-026 chapter 3.13, with one deceleration, a safety factor, and stepwise gradients.
Rotating mass, adhesion, service brake and display are not modelled. Positions are distances in running direction [m].
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

from pydantic import Field

from railfix.core.settings import Settings

GRAVITY_MPS2: Final = 9.80665
#: `_TOP_MPS`: upper limit of the search for a speed [m/s]. `_HALVINGS`: number of bisections of the search.
_TOP_MPS, _HALVINGS = 150.0, 40


class BrakeLimits(Settings):
    """Brakes of a train, and the delays before the brakes act."""

    braking_mps2: float = Field(default=0.5, gt=0)  #: Deceleration of the braked train on level track.
    safety: float = Field(default=0.9, gt=0, le=1)  #: Fraction of `braking_mps2` that braking curves assume.
    least_mps2: float = Field(default=0.05, gt=0)  #: The deceleration assumed on downhill gradients is at least this.
    build_up_s: float = Field(default=2.0, ge=0)  #: Time from the intervention until the brakes act.
    #: Time from the intervention until traction is cut off, or `build_up_s` if that is shorter.
    cut_s: float = Field(default=0.5, ge=0)
    traction_mps2: float = Field(default=0.5, ge=0)  #: Acceleration until traction is cut off.
    warning_s: float = Field(default=1.0, ge=0)  #: Time from the warning to the intervention.
    #: Driver's reaction time: time from exceeding the permitted speed to the intervention.
    reaction_s: float = Field(default=3.0, ge=0)
    over_mps: float = Field(default=1.5, ge=0)  #: Excess over a speed limit at which the intervention begins.


class Target(NamedTuple):
    """Speed limit that applies from a position on."""

    at_m: float
    speed_mps: float


class Steps(NamedTuple):
    """Gradients, positive uphill. Each applies up to the next position; the line is level before the first position."""

    from_m: Sequence[float] = ()
    gradient: Sequence[float] = ()


def braking_speed(at_m: float, target: Target, steps: Steps, brakes: BrakeLimits) -> float:
    """Return the square of the speed on the braking curve at `at_m` [m2/s2].

    The square is ``v_target^2 + 2 integral of max(safety a + g i, least)`` from `at_m` to the target, with a:
    `braking_mps2`, g: gravity, i: gradient, least: `least_mps2`. Beyond the target, the result is below ``v_target^2``.
    """
    if at_m >= target.at_m:
        return target.speed_mps**2 - (at_m - target.at_m)
    square, low = target.speed_mps**2, at_m
    bounds = [*(place for place in steps.from_m if low < place < target.at_m), target.at_m]
    for high in bounds:
        square += 2.0 * (high - low) * deceleration_mps2(low, steps, brakes)
        low = high
    return square


def deceleration_mps2(at_m: float, steps: Steps, brakes: BrakeLimits) -> float:
    """Return the assumed deceleration at a position [m/s^2]."""
    gradient = 0.0
    for place, value in zip(*steps, strict=True):
        if place > at_m:
            break
        gradient = value
    return max(brakes.safety * brakes.braking_mps2 + GRAVITY_MPS2 * gradient, brakes.least_mps2)


def stopping_m(at_m: float, speed_mps: float, steps: Steps, brakes: BrakeLimits) -> float:
    """Return the position at which a train that begins to brake at `at_m` stops [m].

    The train first runs on for the build-up time of the brakes, with traction until cut-off.
    """
    place, speed = _after_build_up(at_m, speed_mps, brakes)
    square, ahead = speed**2, [step for step in steps.from_m if step > place]
    for step in ahead:
        deceleration = deceleration_mps2(place, steps, brakes)
        if square <= 2.0 * deceleration * (step - place):
            break
        square -= 2.0 * deceleration * (step - place)
        place = step
    return place + square / (2.0 * deceleration_mps2(place, steps, brakes))


def _after_build_up(at_m: float, speed_mps: float, brakes: BrakeLimits) -> tuple[float, float]:
    """Return the position [m] and speed [m/s] at which the brakes act after an intervention at `at_m`."""
    cut = min(brakes.cut_s, brakes.build_up_s)
    faster = speed_mps + brakes.traction_mps2 * cut
    way = speed_mps * cut + 0.5 * brakes.traction_mps2 * cut**2 + faster * (brakes.build_up_s - cut)
    return at_m + way, faster


def intervention_mps(at_m: float, target: Target, steps: Steps, brakes: BrakeLimits, *, before_s: float = 0.0) -> float:
    """Return the highest speed at which the target is met if the intervention begins after `before_s` [m/s].

    At this speed, the train is on the curve of `braking_speed` when the brakes act. Between two changes of gradient,
    the position at which the brakes act is linear in the train's speed, and `braking_speed` is linear in this position.
    This gives one quadratic equation per gradient; the equations are solved from the target backward.
    """
    if at_m >= target.at_m:
        return 0.0
    way, faster = _after_build_up(0.0, 0.0, brakes)
    time = before_s + brakes.build_up_s
    places = [at_m, *(place for place in steps.from_m if at_m < place < target.at_m), target.at_m]
    square = target.speed_mps**2
    for low, high in reversed(list(pairwise(places))):
        deceleration = deceleration_mps2(low, steps, brakes)
        half = faster + deceleration * time
        rest = half**2 - faster**2 + square + 2.0 * deceleration * (high - at_m - way)
        speed = math.sqrt(max(rest, 0.0)) - half
        if low == at_m or (rest >= 0.0 and at_m + speed * time + way >= low):
            return max(speed, 0.0)
        square += 2.0 * deceleration * (high - low)
    return 0.0


def _largest(fits: Callable[[float], bool]) -> float:
    """Return the limit speed [m/s] below which `fits` is true and above which it is false."""
    low, high = 0.0, _TOP_MPS
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def release_mps(overlap_m: float, at_m: float, steps: Steps, brakes: BrakeLimits) -> float:
    """Return the highest speed at which a train may pass the end of its authority and stop within the overlap [m/s]."""
    if overlap_m <= 0.0:
        return 0.0
    return _largest(lambda speed: stopping_m(at_m, speed, steps, brakes) <= at_m + overlap_m)


class Supervised(NamedTuple):
    """Supervised speeds of a train [m/s], and the target with the lowest permitted speed."""

    permitted_mps: float
    warning_mps: float
    intervention_mps: float
    target: Target
    release_mps: float = 0.0


def supervise(
    front_m: float,
    rear_m: float,
    *,
    end_m: float,
    overlap_m: float = 0.0,
    restrictions: Sequence[tuple[float, float, float]] = (),
    steps: Steps | None = None,
    brakes: BrakeLimits,
) -> Supervised:
    """Return the lowest supervised speeds over all targets, for a train with given safe front and rear ends.

    Each restriction consists of start [m], end [m] and speed [m/s], and applies while any part of the train is inside.
    """
    steps = steps or Steps()
    release = release_mps(overlap_m, end_m, steps, brakes)
    found = [_supervised(front_m, Target(end_m, 0.0), steps, brakes, release=release)]
    for low_m, high_m, speed in restrictions:
        if low_m < front_m and rear_m < high_m:
            limits = speed, speed + 0.5 * brakes.over_mps, speed + brakes.over_mps
            found.append(Supervised(*limits, Target(low_m, speed)))
        elif front_m <= low_m < end_m:
            found.append(_supervised(front_m, Target(low_m, speed), steps, brakes))
    lowest = min(found, key=lambda each: each.permitted_mps)
    return lowest._replace(
        warning_mps=min(each.warning_mps for each in found),
        intervention_mps=min(each.intervention_mps for each in found),
    )


def _supervised(
    front_m: float, target: Target, steps: Steps, brakes: BrakeLimits, *, release: float = 0.0
) -> Supervised:
    """Return the supervised speeds for one target.

    No speed is below the target speed. Before the target, no speed is below `release` [m/s].
    """
    aimed = target if target.speed_mps == 0.0 else target._replace(speed_mps=target.speed_mps + brakes.over_mps)
    brake, warn = (intervention_mps(front_m, aimed, steps, brakes, before_s=s) for s in (0.0, brakes.warning_s))
    permitted = intervention_mps(front_m, target, steps, brakes, before_s=brakes.reaction_s)
    floor = max(target.speed_mps, release if front_m <= target.at_m else 0.0)
    return Supervised(max(permitted, floor), max(warn, floor), max(brake, floor), target, release)
