"""Braking curves: closed form on level track, quadrature on gradients, monotone, and on board with authorities."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from railfix.ground.authority import Authority, BrakeOrder
from railfix.ground.braking import (
    GRAVITY_MPS2,
    BrakeLimits,
    Steps,
    Target,
    braking_speed,
    intervention_mps,
    stopping_m,
    supervise,
)
from railfix.ground.layout import Gradient, Layout, LoopStation
from railfix.ground.on_board import OnBoard, OnBoardLimits

pytestmark = pytest.mark.requirement("F4", "F7")

BRAKES = BrakeLimits()


def driven_m(at_m: float, speed_mps: float, steps: Steps, brakes: BrakeLimits) -> float:
    """Where a train comes to rest that is braked now, by small steps of time."""
    t, step, x, v = 0.0, 1e-3, at_m, speed_mps
    while v > 0.0:
        if t < min(brakes.cut_s, brakes.build_up_s):
            a = brakes.traction_mps2
        elif t < brakes.build_up_s:
            a = 0.0
        else:
            inside = [g for place, g in zip(*steps, strict=True) if place <= x]
            a = -max(brakes.safety * brakes.braking_mps2 + GRAVITY_MPS2 * (inside or [0.0])[-1], brakes.least_mps2)
        x, v, t = x + v * step + 0.5 * a * step**2, v + a * step, t + step
    return x


def test_closed_form_on_level_track() -> None:
    """0.45 m/s2 are counted on; without build-up, v = sqrt(2 a d)."""
    at_once = BrakeLimits(build_up_s=0.0, cut_s=0.0)
    for distance in (1.0, 50.0, 400.0, 3000.0):
        closed = math.sqrt(2.0 * 0.45 * distance)
        assert intervention_mps(-distance, Target(0.0, 0.0), Steps(), at_once) == pytest.approx(closed, rel=1e-12)
        assert braking_speed(-distance, Target(0.0, 10.0), Steps(), BRAKES) == pytest.approx(closed**2 + 100.0)
    # 2 s build-up, 0.5 s of them with 0.5 m/s2: v + 0.25 m/s after 2 v + 0.0625 + 0.375 m
    v = intervention_mps(0.0, Target(500.0, 0.0), Steps(), BRAKES)
    assert (v + 0.25) ** 2 / 0.9 + 2.0 * v + 0.4375 == pytest.approx(500.0, rel=1e-12)
    assert intervention_mps(500.0, Target(500.0, 0.0), Steps(), BRAKES) == 0.0


@pytest.mark.parametrize("seed", range(6))
def test_a_train_at_the_intervention_speed_stops_at_its_end_on_gradients(seed: int) -> None:
    """Against small steps of time: steps of gradient of up to 40 in a thousand, uphill and downhill."""
    rng = random.Random(seed)
    places = sorted(rng.uniform(-100.0, 1500.0) for _ in range(5))
    steps = Steps(places, [rng.uniform(-0.04, 0.04) for _ in places])
    for end in (60.0, 700.0, 1400.0):
        speed = intervention_mps(0.0, Target(end, 0.0), steps, BRAKES)
        assert driven_m(0.0, speed, steps, BRAKES) == pytest.approx(end, abs=0.5)
        assert stopping_m(0.0, speed, steps, BRAKES) == pytest.approx(end, abs=1e-6)


def test_speeds_are_monotone_and_in_order() -> None:
    rng = random.Random(3)
    for _ in range(300):
        end, safety, build_up = rng.uniform(1.0, 3000.0), rng.uniform(0.3, 0.9), rng.uniform(0.5, 5.0)
        brakes = BrakeLimits(safety=safety, build_up_s=build_up)
        steps = Steps([rng.uniform(0.0, 1000.0)], [rng.uniform(-0.05, 0.05)])
        found = supervise(0.0, -80.0, end_m=end, steps=steps, brakes=brakes)
        assert 0.0 <= found.permitted_mps <= found.warning_mps <= found.intervention_mps
        worse = (
            {"end_m": 0.9 * end},
            {"brakes": brakes.replaced(safety=0.9 * safety)},
            {"brakes": brakes.replaced(build_up_s=1.2 * build_up)},
            {"steps": Steps(steps.from_m, [steps.gradient[0] - 0.01])},
        )
        for change in worse:
            changed = supervise(0.0, -80.0, **{"end_m": end, "steps": steps, "brakes": brakes, **change})  # type: ignore[arg-type]
            assert changed.intervention_mps <= found.intervention_mps + 1e-9
            assert changed.permitted_mps <= found.permitted_mps + 1e-9


def test_a_restriction_is_a_further_target_and_holds_for_the_whole_train() -> None:
    """10 m/s from 600 to 800 m, the train is 80 m long."""
    for front, permitted in ((0.0, None), (600.5, 10.0), (879.5, 10.0), (880.5, None)):
        found = supervise(front, front - 80.0, end_m=5000.0, restrictions=[(600.0, 800.0, 10.0)], brakes=BRAKES)
        assert (found.permitted_mps == 10.0) is (permitted is not None), front
        assert found.intervention_mps > 11.0
    ahead = supervise(500.0, 420.0, end_m=5000.0, restrictions=[(600.0, 800.0, 10.0)], brakes=BRAKES)
    alone = intervention_mps(500.0, Target(600.0, 11.5), Steps(), BRAKES)
    assert ahead.intervention_mps == pytest.approx(alone)
    assert ahead.target == Target(600.0, 10.0)


def test_a_release_speed_needs_an_overlap_that_stops_the_train() -> None:
    found = supervise(99.0, 20.0, end_m=100.0, overlap_m=30.0, brakes=BRAKES)
    assert found.permitted_mps == found.release_mps > 3.0
    assert stopping_m(100.0, found.release_mps, Steps(), BRAKES) == pytest.approx(130.0, abs=1e-6)
    assert supervise(101.0, 20.0, end_m=100.0, overlap_m=30.0, brakes=BRAKES).permitted_mps == 0.0
    assert supervise(99.0, 20.0, end_m=100.0, brakes=BRAKES).release_mps == 0.0


def granted(end_m: float, *, direction: int = 1, **changes: object) -> OnBoard:
    train = OnBoard(direction=direction, end_m=0.0)
    train.note_report(1, 0.0)
    values = {"train": 1, "number": 1, "report": 1, "end_cm": round(100 * end_m), "direction": direction}
    assert train.receive(Authority(**{**values, "stopped": False, **changes}))
    return train


def test_a_train_over_its_curve_is_braked_and_says_by_how_much_it_overruns() -> None:
    train = granted(1000.0)
    train.note_position(900.0, 40.0)
    text = "40.0 m/s exceeds 8.4 m/s, the limit for 0.0 m/s at 1000 m; it would stop 1781 m beyond its authority"
    assert train.brake_reason(1.0) == text
    train.note_position(1500.0, 60.0)
    assert "60.0 m/s exceeds 0.0 m/s" in (train.brake_reason(1.0) or "")
    train = granted(1000.0)
    train.note_position(900.0, 8.3)
    assert train.brake_reason(1.0) is None
    # the speed's bound counts, and so does the way since the place
    train.note_position(900.0, 8.3, speed_bound_mps=0.3)
    assert train.brake_reason(1.0) is not None
    train.note_position(900.0, 8.3, now_s=1.0)
    assert [train.brake_reason(at_s) is None for at_s in (1.0, 3.0)] == [True, False]
    standing = granted(1000.0)
    standing.note_position(999.9, 0.0, speed_bound_mps=0.3, now_s=0.0)
    assert standing.brake_reason(3.0) is None


def test_a_train_without_a_place_runs_on_for_a_time_only() -> None:
    train = granted(5000.0)
    train.note_position(100.0, 20.0, now_s=0.0)
    for now_s in (1.0, 4.9, 5.1):
        train.note_position(None, None, now_s=now_s)
        assert train.brake_reason(now_s) == (None if now_s < 5.0 else "no position")


def test_gradients_of_the_line_come_on_board_in_both_directions() -> None:
    """Uphill 20 in a thousand from 1000 to 2000 m: a train stops sooner upward and later downward."""
    stations = tuple(LoopStation(name=n, begin_m=m, end_m=m + 400.0) for n, m in (("A", 0.0), ("B", 4000.0)))
    layout = Layout(
        stations=stations, gradients=(Gradient(from_m=1000.0, permille=20.0), Gradient(from_m=2000.0, permille=0.0))
    )
    assert layout.gradients_between(0.0, 900.0, 1) == ()
    level = granted(1900.0)
    for direction, end, better in ((1, 1900.0, True), (-1, 1100.0, False)):
        parts = layout.gradients_between(0.0, 4400.0, direction)
        assert parts == ((100_000, 20), (200_000, 0))
        train = granted(end, direction=direction, gradients=parts)
        train.note_position(end - 500.0 * direction, 10.0)
        level.note_position(1400.0, 10.0)
        on_slope, flat = train.supervised(), level.supervised()
        assert (on_slope.intervention_mps > flat.intervention_mps + 1.0) is better
        assert (on_slope.intervention_mps < flat.intervention_mps - 1.0) is not better
    many = replace_gradients(layout, 40)
    for direction, worst in ((1, -40), (-1, 1)):
        parts = many.gradients_between(0.0, 4400.0, direction)
        assert len(parts) == 16
        assert {value for _, value in parts} == {worst}


def replace_gradients(layout: Layout, count: int) -> Layout:
    steps = tuple(Gradient(from_m=100.0 * k, permille=-float(k + 1) if k else 1.0) for k in range(count))
    return layout.replaced(gradients=steps)


def test_an_order_to_brake_counts_until_a_later_authority_ends_it() -> None:
    train = granted(1000.0, number=5)
    train.note_position(100.0, 10.0)
    values = train.authority.model_dump() if train.authority else {}
    order = BrakeOrder(**{**values, "number": 5, "stopped": True}, reason="A is closed")
    assert train.receive(order)
    assert train.brake_reason(0.0) == "ordered to stop: A is closed"
    assert train.acknowledgement() == {"authority": 5, "authority_end_cm": 100_000, "brake_order": 5}
    late = Authority(**{**values, "number": 5, "end_cm": 200_000})
    still = Authority(**{**values, "number": 6, "stopped": True, "end_cm": 200_000})
    assert not train.receive(late)
    assert not train.receive(still)
    # once it stands its authority is withdrawn: what the centre has corrected meanwhile counts at its release
    train.note_position(140.0, 0.0)
    assert train.end_m == 140.0
    assert train.receive(Authority(**{**values, "number": 7, "end_cm": 30_000}))
    assert (train.end_m, train.brake_reason(0.0), train.order) == (300.0, None, None)
    # of a centre that knows no number as high, or late: it brakes, until the next authority
    for number in (2, 7):
        assert train.receive(replace_order(order, number))
        assert train.brake_reason(0.0) is not None
    assert not train.receive(Authority(**{**values, "number": 7, "end_cm": 30_000}))
    assert train.receive(Authority(**{**values, "number": 8, "end_cm": 30_000}))
    assert train.brake_reason(0.0) is None


def test_an_order_to_stop_gives_nothing_to_a_train_that_has_started_on_board() -> None:
    """Its interval is corrected meanwhile: at its release it has the end of then, not one that came with an order."""
    train = OnBoard(direction=1, end_m=100.0)
    train.note_report(1, 0.0)
    values: dict[str, Any] = {"train": 1, "report": 1, "direction": 1}
    assert train.receive(Authority(**values, number=1, end_cm=100_000, stopped=True))
    assert (train.end_m, train.brake_reason(0.0)) == (100.0, "ordered to stop")
    assert train.receive(Authority(**values, number=2, end_cm=30_000, stopped=False))
    assert train.end_m == 300.0
    assert train.receive(Authority(**values, number=3, end_cm=50_000, stopped=True))
    assert train.end_m == 300.0


def replace_order(order: BrakeOrder, number: int) -> BrakeOrder:
    return BrakeOrder(**{**order.model_dump(), "number": number})


def test_what_answers_another_start_on_board_counts_for_nothing() -> None:
    train = granted(1000.0, number=5)
    values = train.authority.model_dump() if train.authority else {}
    assert not train.receive(Authority(**{**values, "number": 6, "session": 9}))
    other = OnBoard(direction=1, end_m=0.0, session=9, limits=OnBoardLimits())
    assert other.receive(Authority(**{**values, "number": 6, "session": 9}))
    assert np.isfinite(replace(other).end_m)
