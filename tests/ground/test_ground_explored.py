"""All sequences of a few events on a line of four sections: no authority into a train, none held beyond an interval."""

from __future__ import annotations

import pytest

from explored_line import World, explore, small_world
from ground_rules import RULES, take_out

pytestmark = [pytest.mark.requirement("F4"), pytest.mark.requirement("F6")]

#: Direction, station and track of the trains: one after the other, toward each other, three of them.
PLACES = {
    "following": ((1, 1, 1), (1, 0, 1)),
    "meeting": ((1, 0, 1), (-1, 2, 2)),
    "three": ((1, 1, 1), (1, 0, 1), (-1, 3, 2)),
}


def running(name: str) -> World:
    """The trains after three rounds of undisturbed running: some between stations, with authorities ahead."""
    world = small_world(*PLACES[name])
    for number in [*world.trains] * 3:
        for event in ("stays", "runs"):
            world = world.after(number, event) or world
    assert world.violation is None
    return world


@pytest.mark.parametrize(
    ("name", "length", "least"),
    [
        ("following", 2, 300),
        pytest.param("following", 3, 7_000, marks=pytest.mark.slow),
        ("meeting", 2, 150),
        pytest.param("meeting", 3, 3_000, marks=pytest.mark.slow),
        ("three", 2, 500),
        pytest.param("following", 4, 100_000, marks=pytest.mark.slow),
        pytest.param("meeting", 4, 30_000, marks=pytest.mark.slow),
        pytest.param("three", 4, 200_000, marks=pytest.mark.slow),
    ],
)
def test_no_sequence_of_events_leads_into_a_train(name: str, length: int, least: int) -> None:
    worlds, sequence = explore(running(name), length)
    assert sequence is None, sequence
    assert worlds > least


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rule", "name", "sequence"),
    [
        ("train ahead", "following", ["1 stays"]),
        ("safe rear", "following", ["1 rolls back"]),
        ("integrity", "following", ["1 splits", "1 runs", "1 runs"]),
        ("length", "following", ["1 place ahead", "1 length 0"]),
        ("two reports", "following", ["1 place ahead"]),
        ("roll-back", "three", ["1 rolls back", "3 asked back", "3 stays"]),
        ("agreed", "following", ["1 asked back"]),
    ],
)
def test_without_a_rule_a_sequence_of_events_leads_into_a_train(
    rule: str, name: str, sequence: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The shortest sequence, as the exploration finds it."""
    world = running(name)
    assert rule in RULES
    take_out(monkeypatch, rule)
    _, found = explore(world, len(sequence))
    assert found == [*sequence, "train beyond its authority" if rule == "agreed" else "authority into another train"]
