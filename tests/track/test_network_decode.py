"""Probabilities of tracks with an error that positions have in common."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.special import binom

from network_around import SHAPES
from network_around_recordings import recorded_errors, stated
from network_around_recordings import recordings as recorded
from network_made import log_at, made_network, made_run, segment, to_degrees
from railfix.track import network_decode
from railfix.track.network import Candidates, Network
from railfix.track.network_decode import COMMON_S, Residuals, Transitions, decode
from railfix.track.network_match import match
from railfix.track.network_read import links_of_ends
from railfix.track.route import Segment

pytestmark = pytest.mark.requirement("A10")
#: Every 20 s: positions that count in full.
STEP_S, STEP_M = 20.0, 100.0


def _residuals(rng: np.random.Generator, n: int, *, heights: bool) -> Residuals:
    turn = rng.uniform(0.0, 2.0 * np.pi, (n, 2))
    return Residuals(
        across=np.stack([np.sin(turn), np.cos(turn)], axis=-1),
        offset_m=rng.normal(0.0, 3.0, (n, 2)),
        beyond_m=np.where(rng.random((n, 2)) < 0.3, rng.normal(0.0, 4.0, (n, 2)), 0.0),
        above_m=rng.normal(0.0, 5.0, (n, 2)),
        clear=rng.random((n, 2)) < 0.7,
        moved_m=np.zeros(n),
        turned=rng.random(n) < 0.3,
        sigma_m=rng.uniform(1.0, 3.0, n),
        sigma_up_m=rng.uniform(2.0, 5.0, n),
        weight=rng.uniform(0.1, 1.0, n),
        seconds=rng.choice([1.0, 30.0, 400.0], n),
        common_m=1.5,
        common_up_m=4.0 if heights else 0.0,
    )


def _parallel(n: int) -> tuple[Network, Candidates]:
    x = np.linspace(0.0, 1000.0, 11)
    net = Network(tracks=tuple(segment(f"T{k}", *to_degrees(x, np.full(11, 4.0 * k))) for k in range(2)), links=())
    track = np.tile(np.array([0, 1], dtype=np.intp), (n, 1))
    place = np.tile(np.linspace(400.0, 600.0, n)[:, None], (1, 2))
    return net, Candidates(track=track, chainage_m=place, offset_m=np.zeros((n, 2)))


def _urn(balls: int, seconds: float) -> np.ndarray:
    """Passages of the urn by its generator."""
    rate = np.zeros((balls + 1, balls + 1))
    for inside in range(balls + 1):
        rate[inside, inside] = -0.5 * balls
        if inside:
            rate[inside, inside - 1] = 0.5 * inside
        if inside < balls:
            rate[inside, inside + 1] = 0.5 * (balls - inside)
    return np.asarray(expm(rate * seconds / COMMON_S))


@pytest.mark.parametrize("heights", [False, True])
def test_probabilities_are_those_of_one_chain_of_all_states(heights: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Track and common error as one state of a plain hidden Markov model, its matrices written out."""
    n, balls, above = 5, 4, 2 if heights else 0
    monkeypatch.setattr(network_decode, "_BALLS", balls)
    monkeypatch.setattr(network_decode, "_BALLS_UP", 2)
    monkeypatch.setattr(network_decode, "SHIFTS_M", np.array([-4.0, 4.0]))
    monkeypatch.setattr(network_decode, "_SHARES", np.array([0.5, 0.5]))
    residuals = _residuals(np.random.default_rng(3), n, heights=heights)
    net, candidates = _parallel(n)
    moves = Transitions(net, candidates, np.full(n - 1, STEP_M), residuals)
    axis = (np.arange(balls + 1) - balls / 2) * 1.5 / np.sqrt(balls / 4)
    up = (np.arange(above + 1) - above / 2) * (4.0 / np.sqrt(0.5) if above else 0.0)
    states = [(e, u, h) for e in axis for u in axis for h in up]
    prior = [
        binom(balls, i) * binom(balls, j) * binom(above, k) / 2.0 ** (2 * balls + above)
        for i in range(balls + 1) for j in range(balls + 1) for k in range(above + 1)
    ]  # fmt: skip
    seen = np.zeros((n, 5, len(states)))
    for k in range(n):
        for state in range(4):
            # the last two run beside the first track, and are level with it
            t, shift = (state, 0.0) if state < 2 else (0, (-4.0, 4.0)[state - 2])
            lies_on_another = state >= 2 and not residuals.clear[k, state - 2]
            east, north = residuals.across[k, t]
            for c, (e, u, h) in enumerate(states):
                square = (residuals.offset_m[k, t] - shift - east * e - north * u) ** 2
                beyond = residuals.beyond_m[k, t]
                if beyond and state < 2:
                    ahead = -north * e + east * u
                    square += max(abs(beyond) - np.sign(beyond) * ahead, 0.0) ** 2
                density = (1.0 + square / residuals.sigma_m[k] ** 2 / 8.0) ** -4.5
                if heights:
                    density *= (1.0 + ((residuals.above_m[k, t] - h) / residuals.sigma_up_m[k]) ** 2 / 8.0) ** -4.5
                density *= np.exp(-5.0 * lies_on_another)
                seen[k, state, c] = density ** residuals.weight[k]
        seen[k, 4] = np.exp(-5.0 * residuals.weight[k])
    first = [0.475, 0.475, *(0.025 * residuals.clear[0]), 0.05 * np.exp(-5.0)]
    forward = [np.outer(first, prior).ravel() * seen[0].ravel()]
    whole = []
    for k in range(1, n):
        plan = _urn(balls, residuals.seconds[k])
        common = np.kron(np.kron(plan, plan), _urn(above, residuals.seconds[k]))
        whole.append(np.kron(moves(k - 1), common))
        forward.append(forward[-1] @ whole[-1] * seen[k].ravel())
    backward = [np.ones(seen[0].size)]
    for k in range(n - 1, 0, -1):
        backward.insert(0, whole[k - 1] @ (seen[k].ravel() * backward[0]))
    expected = np.array([(a * b).reshape(5, -1).sum(axis=1) for a, b in zip(forward, backward, strict=True)])
    expected = np.column_stack([expected[:, :2], expected[:, 2:].sum(axis=1)])
    _, probability = decode(residuals, moves)
    assert probability == pytest.approx(expected / expected.sum(axis=1, keepdims=True), abs=1e-9)


def test_a_log_in_blocks_is_the_log_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    net = made_network(10.0)
    log, _ = made_run(net, [0, 2, 3, 4, 5, 7], rng=np.random.default_rng(1), sigma_m=2.0)
    whole = match(net, log)
    monkeypatch.setattr(network_decode, "_BLOCK", 37)
    parts = match(net, log)
    assert parts.probabilities == pytest.approx(whole.probabilities, abs=1e-12)
    assert (parts.track == whole.track).all()


def test_an_error_of_all_positions_is_no_new_evidence_each_second() -> None:
    """Two tracks 4 m apart, each position 1 m off the one toward the other: an hour of them decides nothing."""
    x = np.linspace(0.0, 40_000.0, 401)
    net = Network(tracks=tuple(segment(f"T{k}", *to_degrees(x, np.full(401, 4.0 * k))) for k in range(2)), links=())
    certain = []
    for seconds in (200, 2000):
        east = 10.0 * np.arange(seconds)
        latitude, longitude = to_degrees(east, np.full(seconds, 1.0))
        log = log_at(latitude, longitude, 2.0)
        certain.append(float(match(net, log).probabilities.max(axis=1).mean()))
    assert 0.6 < certain[0] < certain[1] < 0.99


def test_on_a_line_that_parts_the_common_error_is_known() -> None:
    """What was off by 1.8 m where there is one track is not on the other one, 3.6 m aside, where there are two."""
    net = made_network(10.0)
    log, on = made_run(net, [0, 1, 3], rng=np.random.default_rng(5), sigma_m=0.05)
    lat, _ = to_degrees(np.zeros(1), np.full(1, 1.8))
    aside = replace(log, latitude_deg=log.latitude_deg + lat - 50.0)
    matched = match(net, aside, sigma_m=1.0)
    middle = (on == 1) & (np.abs(np.arange(len(on)) - np.flatnonzero(on == 1).mean()) < 40)
    assert (matched.track[middle] == 1).all()
    assert matched.probability[middle].min() > 0.9
    without = match(replace(net, tracks=net.tracks[1:3], links=()), replace(aside, latitude_deg=aside.latitude_deg))
    assert without.probability[middle].max() < 0.7


def test_height_tells_a_viaduct_from_the_line_below() -> None:
    x = np.linspace(0.0, 4000.0, 81)
    ramp = 8.0 * np.clip((x - 1000.0) / 500.0, 0.0, 1.0)
    plan = to_degrees(x, 0.0 * x)
    tracks = [replace(segment(name, *plan), height_m=h) for name, h in (("below", 0.0 * x), ("viaduct", ramp))]
    net = Network(tracks=tuple(tracks), links=())
    latitude, longitude = to_degrees(np.arange(0.0, 4000.0, 10.0), np.zeros(400))
    log = log_at(latitude, longitude, 2.0, height_m=np.full(400, 3.0), sigma_up_m=np.full(400, 4.0))
    for above, name in ((3.0, "below"), (11.0, "viaduct")):
        height = np.where(np.arange(0.0, 4000.0, 10.0) < 1000.0, 3.0, above)
        matched = match(net, replace(log, height_m=height))
        assert {net.names[t] for t in matched.track[200:]} == {name}
        assert matched.probability[200:].min() > 0.9
    blind = match(net, replace(log, height_m=None, sigma_up_m=None))
    assert np.abs(blind.probability - 0.5).max() < 0.01


@pytest.mark.parametrize(
    ("missing_m", "unmapped"), [(0.0, (0.0, 0.01)), (3.6, (0.01, 1.0)), (7.2, (0.99, 1.0)), (15.0, (0.99, 1.0))]
)
def test_a_track_that_the_map_lacks_is_possible(missing_m: float, unmapped: tuple[float, float]) -> None:
    """The train runs beside the only track, for ten minutes, with an error of 0.8 m toward it."""
    x = np.linspace(0.0, 8000.0, 161)
    net = Network(tracks=(segment("M", *to_degrees(x, 0.0 * x)),), links=())
    latitude, longitude = to_degrees(np.arange(1000.0, 7000.0, 10.0), np.full(600, max(missing_m - 0.8, 0.0)))
    log = log_at(latitude, longitude, 1.5)
    for reverse in (False, True):
        turned = replace(net, tracks=(net.tracks[0].reverse(),)) if reverse else net
        matched = match(turned, log)
        share = 1.0 - matched.probabilities.sum(axis=1)
        assert (share >= unmapped[0]).all()
        assert (share <= unmapped[1]).all()
        assert (matched.track == (0 if missing_m < 5.0 else -1)).all()


def test_a_track_that_the_map_lacks_stays_where_the_nearest_track_changes() -> None:
    """7.2 m right of T0 and 6.8 m left of T1, which is nearer now and then and is drawn in the other direction."""
    x = np.linspace(0.0, 8000.0, 161)
    tracks = (segment("T0", *to_degrees(x, 0.0 * x)), segment("T1", *to_degrees(x[::-1], np.full(161, -14.0))))
    net = Network(tracks=tracks, links=())
    north = -7.2 + np.random.default_rng(2).normal(0.0, 1.0, 600)
    latitude, longitude = to_degrees(np.arange(1000.0, 7000.0, 10.0), north)
    log = log_at(latitude, longitude, 1.5)
    matched = match(net, log)
    assert set(matched.candidates.track[:, 0].tolist()) == {0, 1}
    assert (1.0 - matched.probabilities.sum(axis=1)).min() > 0.99


@pytest.mark.parametrize(("aside_m", "error_m"), [(3.6, 0.9), (3.6, 1.2), (7.2, 1.2)])
def test_a_train_that_passes_an_open_end_was_on_its_track_until_there(aside_m: float, error_m: float) -> None:
    """The map ends at 4 km, and has another track beside from there on: the train is on none of it, and was on M."""
    x = np.linspace(0.0, 4000.0, 81)
    tracks = (segment("M", *to_degrees(x, 0.0 * x)), segment("R", *to_degrees(x + 4000.0, np.full(81, -aside_m))))
    net = Network(tracks=tracks, links=())
    for along in (np.arange(1000.0, 5000.0, 10.0), np.arange(1000.0, 5000.0, 10.0)[::-1]):
        matched = match(net, log_at(*to_degrees(along, np.full(400, -error_m)), 1.7))
        assert (matched.track[along < 4000.0] == 0).mean() > 0.98
        # at the first position past the end, 10 m at a sigma of 1.7 m, too
        assert (matched.track[along > 4000.0] == -1).all()
        assert matched.probability[along < 3900.0].min() > 0.6


def test_a_few_positions_far_off_move_no_train_to_the_track_beside() -> None:
    net = made_network(10.0)
    log, on = made_run(net, [0, 1, 3], rng=np.random.default_rng(5), sigma_m=0.3)
    right = match(net, log, sigma_m=1.0)
    far, _ = to_degrees(np.zeros(3), np.array([45.0, 90.0, 900.0]))
    latitude = log.latitude_deg.copy()
    latitude[100:103] += far - 50.0
    matched = match(net, replace(log, latitude_deg=latitude), sigma_m=1.0)
    rows = np.setdiff1d(np.arange(len(on)), np.arange(100, 103))
    assert (matched.track[rows] == right.track[rows]).all()
    assert matched.probability[rows] == pytest.approx(right.probability[rows], abs=0.1)
    assert np.isnan(matched.probability[102])
    assert np.isfinite(matched.probability[100:102]).all()


@pytest.mark.usefixtures("recordings")
@pytest.mark.parametrize("name", ["Japan", pytest.param("towers M8T", marks=pytest.mark.slow)])
def test_of_recorded_errors_on_networks_what_is_stated_at_99_percent_is_right(name: str) -> None:
    """With a constant error of 1.4 m in Japan, and errors of up to 100 m between towers."""
    errors = recorded_errors(recorded()[name])
    certain = 0
    for shape in SHAPES:
        share, right = stated(errors, shape, 0)
        assert right[share >= 0.99].all()
        certain += int((share >= 0.99).sum())
    assert certain > len(errors.time)


@pytest.mark.parametrize("begin", [100.0, 101.7])
def test_a_short_track_of_a_switch_is_not_passed_over(begin: float) -> None:
    """Of 21 m, with two positions on it: the tracks before and after it do not reach there."""

    def track(name: str, first: float, last: float) -> Segment:
        x = np.linspace(first, last, 1 + int((last - first) / 10.0))
        return segment(name, *to_degrees(x, np.zeros(len(x))))

    net = Network(tracks=(track("W", 0.0, 500.0), track("S", 500.0, 521.0), track("E", 521.0, 1000.0)), links=())
    net = replace(net, links=links_of_ends(net))
    x = np.arange(begin, 900.0, 12.2)
    latitude, longitude = to_degrees(x, np.full(len(x), 1.7))
    log = log_at(latitude, longitude, 2.0, step_s=0.4)
    matched = match(net, log)
    on_it = (x > 500.0) & (x < 521.0)
    assert on_it.sum() == 2
    assert (matched.track == 1).tolist() == on_it.tolist()
    assert np.abs(matched.offset_m) == pytest.approx(1.7, abs=0.01)
