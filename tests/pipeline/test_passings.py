"""Passing of balises and virtual ones, on places by hand."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from railfix.motion.samples import BaliseReadings, ListedBalises
from railfix.pipeline.balises import (
    VERDICTS,
    BaliseLimits,
    BaliseState,
    Passing,
    PassingState,
    arcs_of_balises,
    balise_epochs,
    balise_notes,
    find_passings,
)
from railfix.track import Track
from railfix.track.trajectory import Trajectory
from railfix.tracking import Tracked, TrackStatus

START = np.datetime64("2026-05-12T03:00:00", "ns")
LIMITS = BaliseLimits()
SECOND = np.timedelta64(1, "s")


def line(length_m: float = 2000.0) -> Trajectory:
    """Straight north along a meridian."""
    north = np.linspace(0.0, length_m / 111_000.0, 41)
    return Trajectory.from_antenna_path(Track.from_geodetic(35.0 + north, np.full(41, 139.0), np.full(41, 50.0)))


def at(seconds: float) -> np.datetime64:
    return START + np.timedelta64(round(seconds * 1e9), "ns")


def places(arc_m: list[float] | np.ndarray, level_m: float | np.ndarray = 10.0, *, step_s: float = 1.0) -> Tracked:
    arc = np.asarray(arc_m, dtype=np.float64)
    size = len(arc)
    empty = Tracked.empty(START + (1e9 * step_s * np.arange(size)).astype("timedelta64[ns]"), 0)
    return replace(
        empty,
        status=np.full(size, TrackStatus.TRACKING, dtype=np.int8),
        arc_m=arc,
        sigma_m=np.full(size, 2.0),
        speed_mps=np.gradient(arc, step_s),
        level_m=np.broadcast_to(level_m, size).astype(np.float64),
        amount_m=np.broadcast_to(level_m, size).astype(np.float64),
    )


def listed(*chainage_m: float, virtual: bool = True) -> ListedBalises:
    names = np.array([f"B{k + 1}" for k in range(len(chainage_m))])
    size = len(names)
    return ListedBalises(
        name=names, chainage_m=np.array(chainage_m), sigma_m=np.zeros(size), virtual=np.full(size, virtual)
    )


def read(*readings: tuple[float, str]) -> BaliseReadings:
    times = np.array([at(t) for t, _ in readings], dtype="datetime64[ns]")
    return BaliseReadings(time=times, balise=np.array([n for _, n in readings]), sigma_m=np.full(len(readings), np.nan))


def test_a_reading_has_the_errors_of_its_antenna_and_of_its_place_in_the_list() -> None:
    """3 m of the list and 4 m of the reader are 5 m; a reader without a figure has that of the settings."""
    marks = replace(listed(100.0, 200.0, virtual=False), sigma_m=np.array([3.0, 3.0]))
    readings = replace(read((1.0, "B1"), (2.0, "B2")), sigma_m=np.array([4.0, np.nan]))
    edges = np.array([at(float(t)) for t in range(4)], dtype="datetime64[ns]")
    epochs, _ = balise_epochs(readings, edges, marks, line(), BaliseState(), BaliseLimits(sigma_m=1.25))
    sigma = epochs.sigma_m[np.isfinite(epochs.sigma_m)]
    np.testing.assert_allclose(sigma, [5.0, 3.25])


def found(tracked: Tracked, marks: ListedBalises, readings: BaliseReadings | None = None, cuts: tuple[int, ...] = ()):
    state: PassingState | None = None
    passings: list[Passing] = []
    readings = readings or BaliseReadings()
    before = at(-1e6)
    for first, last in zip((0, *cuts), (*cuts, len(tracked)), strict=True):
        part = Tracked(**{f.name: getattr(tracked, f.name)[first:last] for f in fields(Tracked)})
        mine = (readings.time > before) & (readings.time <= part.time[-1])
        before = part.time[-1]
        given = BaliseReadings(**{f.name: getattr(readings, f.name)[mine] for f in fields(BaliseReadings)})
        new, state = find_passings(part, marks, line(), given, state, LIMITS)
        passings += new
    return passings


def named(passings: list[Passing]) -> list[tuple[str, str]]:
    return sorted((p.balise, VERDICTS[p.verdict]) for p in passings)


def seconds(time: np.datetime64) -> float:
    return float((time - START) / np.timedelta64(1, "s"))


@pytest.mark.requirement("E7")
def test_the_interval_of_a_passing_is_that_of_the_level() -> None:
    (passing,) = found(places(20.0 * np.arange(60)), listed(505.0))
    assert VERDICTS[passing.verdict] == "virtual"
    assert seconds(passing.time) == pytest.approx(505.0 / 20.0, abs=1e-6)
    assert seconds(passing.earliest) == pytest.approx(495.0 / 20.0, abs=1e-6)
    assert seconds(passing.latest) == pytest.approx(515.0 / 20.0, abs=1e-6)
    assert passing.level_m == passing.amount_m == 10.0
    assert np.isnat(passing.read)


@pytest.mark.requirement("E7")
@pytest.mark.parametrize("cuts", [(24,), (25,), (26,), (1, 2, 23, 24, 25, 26, 27), tuple(range(1, 60))])
def test_any_cutting_gives_the_same_passings(cuts: tuple[int, ...]) -> None:
    tracked, marks = places(20.0 * np.arange(60)), listed(505.0, 333.0, 700.0, virtual=False)
    readings = read((16.6, "B2"), (25.2, "B1"), (30.0, "B7"), (31.0, "B2"))
    whole = found(tracked, marks, readings)
    assert named(whole) == [
        ("B1", "read"), ("B2", "contradicts"), ("B2", "read"), ("B3", "missing"), ("B7", "not_listed"),
    ]  # fmt: skip
    cut = found(tracked, marks, readings, cuts)
    instants = [
        sorted((p.balise, p.time, str(p.earliest), str(p.latest), str(p.odometer_m)) for p in each)
        for each in (cut, whole)
    ]
    assert named(cut) == named(whole)
    assert instants[0] == instants[1]


def test_a_train_that_turns_back_before_it_is_sure_to_be_beyond_has_not_passed() -> None:
    way = np.concatenate([20.0 * np.arange(26), 508.0 - 20.0 * np.arange(20)])
    assert found(places(way), listed(505.0)) == []
    back = np.concatenate([20.0 * np.arange(31), 600.0 - 20.0 * np.arange(20)])
    there, again = found(places(back), listed(505.0))
    assert there.speed_mps > 0.0 > again.speed_mps


def test_without_a_level_there_is_no_passing_and_a_gap_widens_the_interval() -> None:
    tracked = places(20.0 * np.arange(60), np.inf)
    assert found(tracked, listed(505.0)) == []
    level = np.where((np.arange(60) > 20) & (np.arange(60) < 30), np.inf, 10.0)
    (passing,) = found(places(20.0 * np.arange(60), level), listed(505.0))
    assert seconds(passing.earliest) == 20.0
    assert seconds(passing.latest) == 30.0


@pytest.mark.requirement("E7")
def test_wrong_and_missing_balises_are_named_with_their_time() -> None:
    marks = listed(200.0, 505.0, 900.0, virtual=False)
    passings = found(places(20.0 * np.arange(60)), marks, read((10.05, "B1"), (25.2, "B3"), (45.0, "X9")))
    assert named(passings) == [
        ("B1", "read"), ("B2", "missing"), ("B3", "contradicts"), ("B3", "missing"), ("X9", "not_listed"),
    ]  # fmt: skip
    notes = balise_notes("front", passings)
    assert any("balise B3, read at 2026-05-12T03:00:25.2" in note and "next to B2" in note for note in notes)
    assert any("balise B2 at chainage 505.0 m was passed between 2026-05-12T03:00:24.7" in note for note in notes)
    assert any("balise X9" in note and "not listed" in note for note in notes)


def test_the_odometer_has_five_metres_and_a_twentieth_of_the_way_since_the_last_balise() -> None:
    marks = listed(200.0, 700.0, virtual=False)
    passings = found(places(20.0 * np.arange(60)), marks, read((10.0, "B1"), (35.0, "B2")))
    assert np.isnan(passings[0].odometer_m)
    assert passings[-1].odometer_m == pytest.approx(5.0 + 0.05 * 500.0, abs=0.1)
    late = listed(200.0, 705.0, virtual=False)  # its passing is in the chunk after its reading
    for cuts in ((), (36,)):
        passings = found(places(20.0 * np.arange(60)), late, read((10.0, "B1"), (34.9, "B2")), cuts)
        assert passings[-1].odometer_m == pytest.approx(5.0 + 0.05 * 500.0, abs=0.5)
    virtual = replace(marks, virtual=np.array([False, True]))
    passings = found(places(20.0 * np.arange(60)), virtual, read((10.0, "B1")))
    assert passings[-1].odometer_m == pytest.approx(5.0 + 0.05 * 500.0, abs=0.1)


@pytest.mark.requirement("E7")
@pytest.mark.parametrize("cuts", [(), (30,), (31, 41), tuple(range(1, 110))])
def test_an_identity_read_again_is_the_same_passing_and_balises_take_turns_however_the_log_is_cut(
    cuts: tuple[int, ...],
) -> None:
    readings = read((10.2, "B1"), (30.2, "B1"), (40.2, "B2"), (99.7, "B2"), (101.3, "B2"), (103.1, "X9"), (104.5, "B1"))
    marks, epochs, state, parts = listed(205.0, 805.0, virtual=False), at(0.0) + np.arange(110) * SECOND, None, []
    for rows in np.split(np.arange(1, 110), [cut - 1 for cut in cuts]):
        if len(rows):
            edges = epochs[rows[0] - 1 : rows[-1] + 1]
            mine = (readings.time > edges[0]) & (readings.time <= edges[-1])
            given = BaliseReadings(**{f.name: getattr(readings, f.name)[mine] for f in fields(BaliseReadings)})
            found_ones, state = balise_epochs(given, edges, marks, line(), state or BaliseState(), LIMITS)
            parts.append(found_ones)
    place = np.concatenate([part.place_m for part in parts])
    epoch, column = np.nonzero(np.isfinite(place))
    assert (epoch + 1).tolist() == [11, 41, 102, 105]
    assert column.tolist() == [0, 1, 0, 1]
    np.testing.assert_allclose(place[epoch, column], [205.0, 805.0, 805.0, 205.0], atol=0.01)


@pytest.mark.requirement("E7")
def test_the_reader_is_ahead_of_the_antenna_where_the_front_looks() -> None:
    for facing, expected in (("rising", 493.0), ("falling", 517.0)):
        path = replace(line(), facing=facing)  # type: ignore[arg-type]
        found_at = arcs_of_balises(listed(505.0), path, BaliseLimits(ahead_m=12.0))
        assert found_at == pytest.approx(expected, abs=0.01)
