"""Mean offset of the 3-D positions from the line, against the same sums written out epoch by epoch (requirement C4)."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2, ncx2

import raim_cases
import synthetic
from railfix.core.timescale import seconds, timedelta
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.map_offset import (
    LinePositions,
    MapOffset,
    MapOffsetLimits,
    MapOffsetState,
    OffsetErrors,
    beyond_threshold,
    map_offset,
)
from railfix.positioning.normal_equations import SinglePoint, point_position
from railfix.positioning.range_arrays import Ranges
from railfix.positioning.search_index import SearchIndex

pytestmark = pytest.mark.requirement("C4")

EPOCHS = 40
LINE = replace(raim_cases.LINE, sigma_plan_m=0.4, sigma_height_m=0.9)
ALONE = AntennaRows.on(SearchIndex(LINE))
LIMITS = MapOffsetLimits(window_s=70.0, correlation_s=14.0, least_samples=2.5)
SYSTEMS = "GGGGGEEE"
#: Epochs at which the train is away from the line: they have a window of their own.
AWAY = np.isin(np.arange(EPOCHS), [12, *range(26, 33)])


@cache
def case() -> tuple[np.ndarray, Ranges, SinglePoint, np.ndarray, np.ndarray, np.ndarray]:
    """Time, ranges, 3-D positions, nominal sigmas, variances and arcs of a log with a gap, thin and empty epochs."""
    rng = np.random.default_rng(7)
    steps = rng.choice([3.0, 5.0, 9.0, 25.0], EPOCHS)
    steps[20] = 400.0
    time = np.datetime64("2024-03-05T00:00:00", "ns") + timedelta(np.cumsum(steps))
    arc = np.linspace(200.0, 1500.0, EPOCHS)
    ranges = raim_cases.made(arc, SYSTEMS, seed=5)
    weight = ranges.weight.copy()
    weight[6, 2:] = 0.0  # two satellites: no position
    weight[9, [0, 1, 5]] = 0.0  # five of two clocks: no redundancy, not used
    weight[11, 3] = 0.0
    ranges = replace(ranges, weight=weight)
    point = point_position(ranges, np.broadcast_to(LINE.ecef_m[0], (EPOCHS, 3)))
    arc[15] = np.nan
    return time, ranges, point, rng.uniform(0.3, 2.0, (EPOCHS, len(SYSTEMS))), rng.uniform(0.5, 4.0, EPOCHS), arc


def of_case(limits: MapOffsetLimits = LIMITS) -> tuple[MapOffset, MapOffsetState]:
    time, ranges, point, nominal, variance, arc = case()
    start = [MapOffsetState()]
    result, (end,) = map_offset(
        time, ranges, point, OffsetErrors(nominal, variance), ALONE, LinePositions(arc, AWAY), start, limits=limits
    )
    return result, end


def written_out(limits: MapOffsetLimits) -> list[tuple[np.ndarray, np.ndarray] | None]:
    """Mean offset and its covariance at each epoch; None before there are enough samples."""
    time, ranges, point, nominal, variance, arc = case()
    clocks = np.zeros((len(SYSTEMS), 2))
    clocks[np.arange(len(SYSTEMS)), [int(s == "E") for s in SYSTEMS]] = 1.0
    terms: list[tuple[bool, float, float, np.ndarray, np.ndarray, np.ndarray]] = []
    answers: list[tuple[np.ndarray, np.ndarray] | None] = []
    age = 0.0
    for t in range(EPOCHS):
        step = 0.0 if t == 0 else float(seconds(time[t] - time[t - 1]))
        age += min(step / limits.window_s, limits.correlation_s / limits.window_s)
        used = ranges.weight[t] > 0
        if used.sum() - 2 > 3 and np.isfinite(arc[t]):
            section = int(LINE.segment_at(arc[t : t + 1])[0][0])
            axes = np.stack([LINE.across[section], LINE.up[section]])
            place = point.ecef_m[t]
            sat = ranges.sat_ecef_m[t]
            derivative = np.stack(
                [
                    (synthetic.travelled_range(sat, place + d) - synthetic.travelled_range(sat, place - d)) / 2.0
                    for d in np.eye(3)
                ],
                axis=1,
            )
            design = np.concatenate([derivative, clocks], axis=1)[used]
            weight = ranges.weight[t, used]
            covariance = np.linalg.inv(design.T @ (weight[:, None] * design))
            gain = axes @ (covariance @ design.T * weight)[:3]
            noise = variance[t] * axes @ covariance[:3, :3] @ axes.T
            bias = gain @ np.diag(nominal[t, used] ** 2) @ gain.T
            offset = axes @ (place - LINE.at_arc(arc[t : t + 1])[0])
            fresh = min(step / limits.correlation_s, 1.0)
            terms.append((AWAY[t], age, fresh, np.linalg.inv(noise), offset, bias))
        samples, total, weighted, biases = 0.0, np.zeros((2, 2)), np.zeros(2), np.zeros((2, 2))
        for away, then, fresh, information, offset, bias in terms:
            share = fresh * np.exp(then - age) * (away == AWAY[t])
            samples += share
            total += share * information
            weighted += share * information @ offset
            biases += share * bias
        if samples < limits.least_samples:
            answers.append(None)
            continue
        of_noise = np.linalg.inv(total)
        of_map = np.diag([LINE.sigma_plan_m**2, LINE.sigma_height_m**2])
        answers.append((of_noise @ weighted, of_noise + biases / samples + of_map))
    return answers


def test_it_is_what_the_epochs_written_out_give() -> None:
    got, _ = of_case()
    answers = written_out(LIMITS)
    missing = np.array([answer is None for answer in answers])
    assert 3 < missing.sum() < EPOCHS - 15
    assert (~missing & AWAY).sum() > 2
    np.testing.assert_array_equal(np.isnan(got.statistic), missing)
    # The solver's design has unit vectors, the ranges written out the rotation of the Earth too: 1e-5 of either.
    for t in np.flatnonzero(~missing):
        answer = answers[t]
        assert answer is not None
        mean, covariance = answer
        inverse = np.linalg.inv(covariance)
        assert [got.across_m[t], got.up_m[t]] == pytest.approx(mean, abs=1e-4)
        np.testing.assert_allclose(got.covariance_m2[t], covariance, rtol=1e-4, atol=1e-4)
        assert got.statistic[t] == pytest.approx(mean @ inverse @ mean, rel=1e-3)
        detectable = LIMITS.detectable_sigmas / np.sqrt(np.diag(inverse))
        np.testing.assert_allclose(got.detectable_m[t], detectable, rtol=1e-4)
        assert got.across_sigma_m[t] == pytest.approx(np.sqrt(covariance[0, 0]), rel=1e-4)
        assert got.up_sigma_m[t] == pytest.approx(np.sqrt(covariance[1, 1]), rel=1e-4)
        offset, information = got.seen
        np.testing.assert_allclose(offset[t], mean, atol=1e-4)
        np.testing.assert_allclose(information[t], inverse, rtol=1e-4, atol=1e-4)


def test_nothing_is_said_before_there_are_enough_samples() -> None:
    got, _ = of_case()
    before = np.isnan(got.statistic)
    assert np.isnan(got.covariance_m2[before]).all()
    assert np.isnan(got.detectable_m[before]).all()
    for part in (*got.seen, *got.beyond_m):
        assert (part[before] == 0.0).all()
    assert not beyond_threshold(got, LIMITS)[before].any()


@pytest.mark.parametrize("cut", [1, 7, 21, EPOCHS - 1])
def test_chunks_give_the_same(cut: int) -> None:
    time, ranges, point, nominal, variance, arc = case()
    whole, end = of_case()
    state, parts = MapOffsetState(), []
    for part in (np.arange(cut), np.arange(cut, EPOCHS), np.arange(0)):
        some = replace(
            ranges, sat_ecef_m=ranges.sat_ecef_m[part], code_m=ranges.code_m[part], weight=ranges.weight[part]
        )
        result, (state,) = map_offset(
            time[part],
            some,
            point.take(part),
            OffsetErrors(nominal[part], variance[part]),
            ALONE,
            LinePositions(arc[part], AWAY[part]),
            [state],
            limits=LIMITS,
        )
        parts.append(result)
    for name in ("across_m", "up_m", "statistic"):
        joined = np.concatenate([getattr(p, name) for p in parts])
        np.testing.assert_allclose(joined, getattr(whole, name), rtol=1e-12)
    assert (state.time, state.age) == (end.time, end.age)
    np.testing.assert_allclose(state.sums, end.sums, rtol=1e-12)


def offset_of(across_m: float, up_m: float, sigma_m: tuple[float, float]) -> MapOffset:
    """One epoch with an offset of independent components."""
    covariance = np.diag(np.square(sigma_m))[None]
    statistic = np.array([(across_m / sigma_m[0]) ** 2 + (up_m / sigma_m[1]) ** 2])
    return MapOffset(
        across_m=np.array([across_m]),
        up_m=np.array([up_m]),
        covariance_m2=covariance,
        statistic=statistic,
        detectable_m=np.ones((1, 2)),
    )


def test_beyond_is_what_one_sigma_does_not_explain() -> None:
    for across, up, expected in (
        (5.0, -7.0, (3.0, -4.0)),
        (-5.0, 7.0, (-3.0, 4.0)),
        (1.9, 3.1, (0.0, pytest.approx(0.1))),
    ):
        found = tuple(float(part[0]) for part in offset_of(across, up, (2.0, 3.0)).beyond_m)
        assert found == expected


def test_thresholds_are_those_of_the_risks() -> None:
    limits = MapOffsetLimits()
    assert limits.note_threshold == pytest.approx(chi2.isf(limits.note_risk, 2))
    assert limits.threshold == pytest.approx(chi2.isf(limits.risk, 2))
    assert limits.threshold == pytest.approx(13.8, abs=0.02)
    found = ncx2.cdf(limits.threshold, 2, limits.detectable_sigmas**2)
    assert found == pytest.approx(limits.missed, rel=1e-6)
    edge = np.sqrt(limits.threshold)
    assert not beyond_threshold(offset_of(edge * 0.999, 0.0, (1.0, 1.0)), limits)[0]
    assert beyond_threshold(offset_of(edge * 1.001, 0.0, (1.0, 1.0)), limits)[0]
