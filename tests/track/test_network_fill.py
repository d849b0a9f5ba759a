"""Gaps of a log on a network, against routes that networkx finds over tracks cut at the known places."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import networkx as nx
import numpy as np
import pytest

from network_made import made_network
from network_recordings import COLUMNS
from railfix.track.network import Candidates, Network
from railfix.track.network_match import Matched, PlanLog, match, read_plan_positions
from railfix.track.network_read import read_network
from railfix.track.network_route import fill_gaps
from route_matcher import matched_track

pytestmark = pytest.mark.requirement("A10")


def _rows_filled(*args: object, **options: object) -> np.ndarray:
    return ~np.isnan(fill_gaps(*args, **options).bound_m)


def _matched(track: list[int], chainage: list[float]) -> Matched:
    numbers, place = np.array(track), np.array(chainage)
    probability = np.where(numbers >= 0, 1.0, np.nan)
    near = Candidates(track=numbers[:, None], chainage_m=place[:, None], offset_m=0.0 * place[:, None])
    return Matched(
        track=numbers,
        chainage_m=place,
        offset_m=0.0 * place,
        probability=probability,
        candidates=near,
        probabilities=probability[:, None],
    )


def _without_positions(time: np.ndarray) -> PlanLog:
    none = np.full(len(time), np.nan)
    return PlanLog(path="made", time=time, latitude_deg=none, longitude_deg=none, sigma_m=none)


def _shortest_m(net: Network, first: int, from_m: float, last: int, to_m: float) -> float:
    """Length of the shortest route, by nodes of places that are written out here, with no code of railfix."""
    graph: nx.DiGraph[object] = nx.DiGraph()
    for t, length in enumerate(net.length_m.tolist()):
        graph.add_edge(("in", t, 0), ("out", t, 1), weight=length)
        graph.add_edge(("in", t, 1), ("out", t, 0), weight=length)
    for link in (link for link in net.links if link.navigable):
        a, b = (link.first, link.first_end), (link.second, link.second_end)
        graph.add_edge(("out", *a), ("in", *b), weight=0.0)
        graph.add_edge(("out", *b), ("in", *a), weight=0.0)
    graph.add_edge("start", ("out", first, 0), weight=from_m)
    graph.add_edge("start", ("out", first, 1), weight=net.length_m[first] - from_m)
    graph.add_edge(("in", last, 0), "stop", weight=to_m)
    graph.add_edge(("in", last, 1), "stop", weight=net.length_m[last] - to_m)
    return float(nx.dijkstra_path_length(graph, "start", "stop"))


@pytest.mark.parametrize(("first", "last"), [(0, 3), (3, 0), (0, 2), (2, 0), (1, 3)])
def test_a_gap_is_filled_by_the_shortest_route(first: int, last: int) -> None:
    net = made_network(10.0)
    from_m, to_m = 0.4 * net.length_m[first], 0.7 * net.length_m[last]
    count = 2001
    matched = _matched([first, *[-1] * (count - 2), last], [from_m, *[np.nan] * (count - 2), to_m])
    time = np.datetime64("2024-01-01T00:00:00", "ns") + np.arange(count) * np.timedelta64(1, "s")
    filled = fill_gaps(net, matched, _without_positions(time))
    length = _shortest_m(net, first, from_m, last, to_m)
    assert np.isfinite(filled.bound_m).sum() == count - 2
    steps = np.linalg.norm(np.diff(net.course_on(filled.track, filled.chainage_m)[0], axis=0), axis=1)
    assert steps.sum() == pytest.approx(length, abs=1.0)
    assert steps.max() < 1.5 * length / (count - 1) + 0.5
    assert filled.bound_m[count // 2] == pytest.approx(length / 2.0, abs=1e-3)
    assert filled.bound_m[1] == pytest.approx(length * (1.0 - 1.0 / (count - 1)), abs=1e-3)


def test_no_route_or_positions_off_the_map_leave_the_gap() -> None:
    net = made_network(10.0)
    time = _without_positions(np.full(3, np.datetime64("NaT"), dtype="datetime64[ns]"))
    assert not _rows_filled(net, _matched([1, -1, 2], [1.0, np.nan, 1.0]), time).any()
    matched = _matched([0, -1, 0], [100.0, np.nan, 200.0])
    filled = fill_gaps(net, matched, time)
    assert (filled.track[1], filled.chainage_m[1], filled.bound_m[1]) == (0, 150.0, 50.0)
    off_map = replace(matched, probability=np.array([1.0, 0.0, 1.0]))
    assert not _rows_filled(net, off_map, time).any()
    assert _rows_filled(net, off_map, time, rows_to_fill="off-map").tolist() == [False, True, False]


def test_the_tunnel_of_the_measuring_train_is_filled_as_networkx_finds_it(recordings: Path) -> None:
    """In the tunnel of the airport positions drift by up to 300 m; before and after it the track is known."""
    folder = recordings / "rail" / "infrabel"
    net = read_network([folder / "network_airport.geojson"])
    log = read_plan_positions(folder / "log_28573_L36-A_to_L36C-A_to_L25N-B.csv", columns=COLUMNS)
    matched = match(net, log)
    assert (matched.track < 0).mean() > 0.5
    filled = fill_gaps(net, matched, log, rows_to_fill="off-map")
    assert (filled.track >= 0).all()
    first, *_, last = np.flatnonzero(np.isfinite(filled.bound_m))
    before, after = first - 1, last + 1
    places = (
        int(matched.track[before]),
        matched.chainage_m[before],
        int(matched.track[after]),
        matched.chainage_m[after],
    )
    way = np.linalg.norm(np.diff(net.course_on(filled.track, filled.chainage_m)[0][before : after + 1], axis=0), axis=1)
    assert way.sum() == pytest.approx(_shortest_m(net, *places), rel=0.01)


@pytest.mark.parametrize("cut", [900, *(pytest.param(cut, marks=pytest.mark.slow) for cut in (700, 1100, 1300))])
def test_a_log_that_begins_or_ends_in_the_tunnel(recordings: Path, cut: int) -> None:
    """Against the log of both sides, and the shortest routes between neighbouring positions that drift."""
    folder = recordings / "rail" / "infrabel"
    net = read_network([folder / "network_airport.geojson"])
    log = read_plan_positions(folder / "log_28573_L36-A_to_L36C-A_to_L25N-B.csv", columns=COLUMNS)
    matched = match(net, log)
    both = fill_gaps(net, matched, log, rows_to_fill="off-map")
    right = routes = 0
    for rows in (np.arange(cut, len(log.time)), np.arange(cut + 1)):
        part = log.take(rows)
        begun = match(net, part)
        filled = fill_gaps(net, begun, part, rows_to_fill="off-map")
        assert not _rows_filled(net, begun, part).any()
        assert (filled.track >= 0).all()
        inside = (begun.track < 0) & (matched.track[rows] < 0)
        assert np.isinf(filled.bound_m[inside]).all()
        seen, true = (net.course_on(f.track, f.chainage_m)[0] for f in (filled, both))
        assert np.percentile(np.linalg.norm(seen - true[rows], axis=1), 95) < 210.0
        right += (filled.track == both.track[rows])[inside].sum()
        routes += (matched_track(net, part)[0] == both.track[rows])[inside].sum()
    assert right > routes


def test_a_route_much_longer_than_the_distance_travelled_is_not_taken() -> None:
    net = made_network(10.0)
    matched = _matched([0, -1, 0], [100.0, np.nan, 2100.0])
    matched = replace(matched, probability=np.array([1.0, 0.0, 1.0]))
    latitude, longitude, none = net.tracks[0].latitude_deg[0], net.tracks[0].longitude_deg[0], np.full(3, np.nan)
    still = PlanLog(
        path="made",
        time=np.full(3, np.datetime64("NaT"), dtype="datetime64[ns]"),
        latitude_deg=np.full(3, latitude),
        longitude_deg=np.full(3, longitude),
        sigma_m=none,
    )
    assert not _rows_filled(net, matched, still, rows_to_fill="off-map").any()
    near = replace(matched, chainage_m=np.array([100.0, np.nan, 500.0]))
    assert _rows_filled(net, near, still, rows_to_fill="off-map").tolist() == [False, True, False]
