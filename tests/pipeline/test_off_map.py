"""Whether the train is on the map at all, by single epochs over some seconds (requirements B6, E5)."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache
from itertools import pairwise
from typing import Any, cast

import numpy as np
import pytest

from pipeline_cases import clean_trajectories, demo_observations
from railfix.core.reasons import Status
from railfix.core.timescale import timedelta
from railfix.io.rinex import read_navigation
from railfix.pipeline.along_track import apply_spacing_verdict
from railfix.pipeline.config import parse_config
from railfix.pipeline.filter_result import AlongTrack, FilterState
from railfix.pipeline.off_map import OffMapState, off_map_epochs
from railfix.pipeline.outage_gate import ReturnState, gated_codes
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.results import AntennaResult
from railfix.pipeline.sensor_epochs import SensorLimits
from railfix.screens import Screened
from railfix.simulate.demonstration import demo_files
from railfix.tracking import Line, Tracked, TrackStatus, track
from test_wrong_map import moved
from tracking_cases import part, ride

START = np.datetime64("2026-03-01T10:00:00", "ns")


def judged(said: str, cuts: tuple[int, ...] = (), least_s: float = 3.0, offset_m: np.ndarray | None = None) -> str:
    """Verdicts of epochs a second apart: positions on the map (+), off it (-), none (.)."""
    time = START + timedelta(np.arange(float(len(said))))
    offset = np.full(len(said), np.nan) if offset_m is None else offset_m
    on, off = np.array([c == "+" for c in said]), np.array([c == "-" for c in said])
    state, parts = OffMapState(), []
    for first, last in zip((0, *cuts), (*cuts, len(said)), strict=True):
        here = slice(first, last)
        found, state = off_map_epochs(time[here], on[here], off[here], offset[here], state, least_s=least_s)
        parts.append(found)
    return "".join("x" if away else "o" for away in np.concatenate(parts))


@pytest.mark.requirement("B6")
@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ("++++--++++", "oooooooooo"),  # one reflected signal is no departure
        ("++------", "oooooxxx"),  # three seconds after the first
        ("---++---", "xxxxxxxx"),  # the first position decides alone; two that fit are no return
        ("---+++++", "xxxxxxoo"),
        ("...---..", "oooxxxxx"),  # nothing is known before a position
        ("++-..-+-", "oooooxxx"),  # without a position time goes on
        ("++-...-+", "ooooooxx"),
    ],
)
def test_departure_and_return_take_their_time(said: str, expected: str) -> None:
    assert judged(said) == expected


@pytest.mark.requirement("B6")
def test_any_cutting_gives_the_same_verdicts() -> None:
    said = "".join(np.random.default_rng(3).choice(list("+-."), size=400, p=[0.4, 0.4, 0.2]).tolist())
    said = said.replace("+-+", "+++").replace("-+-", "---")
    offset = np.random.default_rng(4).normal(np.where(np.array([*said]) == "-", 6.0, 2.8), 1.0)
    whole = judged(said, least_s=2.0, offset_m=offset)
    assert set(whole) == {"o", "x"}
    assert judged(said, least_s=2.0) != whole
    for cuts in (tuple(range(1, 400)), (7, 8, 150)):
        assert judged(said, cuts, 2.0, offset) == whole


@pytest.mark.requirement("B6", "A10")
@pytest.mark.parametrize(("back_m", "returns"), [(5.5, False), (-0.9, True), (3.5, True), (3.7, False)])
def test_a_train_beside_the_line_is_not_back_because_its_ranges_fit_by_chance(back_m: float, returns: bool) -> None:
    """On a track 7.2 m aside that the map lacks: what fits the line is still more than half as far from it."""
    said = "+++" + 6 * "-" + 20 * "+"
    offset = np.array(3 * [0.5] + 6 * [7.2] + 20 * [back_m])
    assert judged(said, offset_m=offset) == "oooooo" + "xxx" + ("xxx" + 17 * "o" if returns else 20 * "x")


@pytest.mark.requirement("E5")
def test_the_filter_begins_anew_when_the_train_comes_back() -> None:
    case = ride(120, noise=1.0)
    away = np.zeros(120, dtype=bool)
    away[40:60] = True
    # Codes of another place: what they would teach must not outlast the departure.
    code = case.epochs.code_m + np.where(away[:, None], 400.0 * np.arange(case.epochs.code_m.shape[1]), 0.0)
    epochs = replace(case.epochs, code_m=code, off_map=away)
    found, _ = track(epochs, case.line)
    assert (found.status[40:60] == TrackStatus.OFF_MAP).all()
    assert np.isnan(found.arc_m[40:60]).all()
    fresh, _ = track(part(case.epochs, slice(60, None)), case.line)
    np.testing.assert_allclose(found.arc_m[60:], fresh.arc_m, atol=0.3)
    np.testing.assert_allclose(found.sigma_m[60:], fresh.sigma_m, rtol=0.05)


@cache
def on_moved_map(across_m: float = 0.0, up_m: float = 0.0, risk: float = 1e-3) -> tuple[AntennaResult, Tracked]:
    """The demonstration, one epoch a second, on a line moved aside or up, with the filter's answer."""
    line = moved(clean_trajectories()["front"], across_m=across_m, up_m=up_m)
    config = parse_config({"filter": "track", "map_offset": {"risk": risk}})
    processor = EpochProcessor(config, {"front": line}, navigation=read_navigation(demo_files()["nav"]))
    result, _ = processor.process({"front": demo_observations()["front"][::10]})
    return result.antennas["front"], result.fusion["front"].tracked


@pytest.mark.requirement("B6")
def test_the_filter_has_no_place_far_from_the_line() -> None:
    _, tracked = on_moved_map(across_m=200.0)
    assert (tracked.status == TrackStatus.OFF_MAP).all()


@pytest.mark.requirement("B6")
def test_the_filter_says_that_the_map_lies_aside() -> None:
    """16 m too low no epoch by itself finds anything; at a risk of 0.2 the mean of minutes does."""
    antenna, tracked = on_moved_map(up_m=16.0, risk=0.2)
    beside = antenna.status == Status.MAP_OFFSET
    assert beside.sum() > 50
    assert (tracked.status[beside] == TrackStatus.MAP_OFFSET).all()
    assert np.isinf(tracked.level_m[beside]).all()
    assert np.isinf(tracked.amount_m[beside]).all()
    _, right = on_moved_map()
    assert np.isfinite(right.level_m).mean() > 0.9
    assert not np.isin(right.status, [TrackStatus.MAP_OFFSET, TrackStatus.OFF_MAP]).any()


@pytest.mark.requirement("B6")
def test_what_was_seen_off_the_map_says_nothing_of_the_map() -> None:
    """Minutes away from the line, then on it: after the 10 s that a return takes no offset of the map is left."""
    navigation, config = read_navigation(demo_files()["nav"]), parse_config({"filter": "off"})
    right = clean_trajectories()["front"]
    log = demo_observations()["front"]
    away = EpochProcessor(config, {"front": moved(right, across_m=200.0)}, navigation=navigation)
    _, state = away.process({"front": log[0:1000:10]})
    back = EpochProcessor(config, {"front": right}, navigation=navigation)
    result, _ = back.process({"front": log[1000:2000:10]}, state)
    status = result.antennas["front"].status
    assert (status[:10] == Status.MAP_OFFSET).all()
    assert not np.isin(status[11:], [Status.OFF_MAP, Status.MAP_OFFSET]).any()


CUTS = [(), (16,), (17, 19), (3, 15, 18, 21), tuple(range(1, 30))]


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("cuts", CUTS)
def test_codes_after_an_outage_count_from_the_third_that_agrees_however_the_log_is_cut(cuts: tuple[int, ...]) -> None:
    """Ten seconds without codes; of those after it, the first and the fourth are 100 m aside."""
    k = np.arange(30)
    time, line = START + timedelta(k.astype(np.float64)), Line(clean_trajectories()["front"])
    observed, place = (k < 5) | (k > 14), 10.0 * k + np.where((k == 15) | (k == 18), 100.0, 0.0)
    state, parts = ReturnState(place_m=-10.0, sigma_m=1.0), []
    for first, last in pairwise((0, *cuts, 30)):
        rows, n = slice(first, last), last - first
        refused, state = gated_codes(
            time[rows], observed[rows], np.full(n, 10.0), place[rows], np.full(n, 1.0), state, line, SensorLimits()
        )
        parts.append(refused)
    assert np.flatnonzero(np.concatenate(parts)).tolist() == [15, 16, 17, 18, 19, 20]


@pytest.mark.requirement("B3", "E5")
@pytest.mark.parametrize("cuts", CUTS)
def test_antennas_that_disagree_are_doubted_for_a_time_however_the_log_is_cut(cuts: tuple[int, ...]) -> None:
    """At the 16th epoch, for 3 s; a chunk without pairs of epochs has no verdict of its own."""
    time = START + timedelta(np.arange(30.0))
    empty = Tracked.empty(time, 0)
    whole = replace(empty, status=np.full(30, TrackStatus.TRACKING, dtype=np.int8), level_m=np.full(30, 5.0))
    disagree, state, parts = np.arange(30) == 15, FilterState(), []
    for first, last in pairwise((0, *cuts, 30)):
        rows = slice(first, last)
        tracked = Tracked(**{f.name: getattr(whole, f.name)[rows] for f in fields(Tracked)})
        spacing = None
        if disagree[rows].any():
            spacing = Screened(metric=np.where(disagree, 9.0, 0.5)[rows], reject=disagree[rows])
        nothing, nobody = np.full(last - first, np.nan), cast(Any, None)
        result = AlongTrack(
            tracked=tracked, trajectory=nobody, arc_m=nothing, direction=np.zeros(last - first, dtype=np.int8),
            standstill=np.zeros(last - first, dtype=np.bool_), sensed=nobody, spacing_error_m=nothing,
        )  # fmt: skip
        found, state = apply_spacing_verdict(result, spacing, state, 3.0)
        parts.append(found.tracked)
    status, level = (np.concatenate([getattr(part, name) for part in parts]) for name in ("status", "level_m"))
    assert np.flatnonzero(status == TrackStatus.ANTENNAS_DISAGREE).tolist() == [15, 16, 17, 18]
    assert np.flatnonzero(np.isinf(level)).tolist() == [15, 16, 17, 18]
