"""Other places of the line that the level must reach or the status must name (requirement C2)."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

import level_cases
import raim_cases
from integrity_recordings import ranges_of
from plain_kernels import plain
from railfix import kernels
from railfix.core.geodesy import elevation_azimuth, range_with_rotation
from railfix.core.reasons import Status
from railfix.integrity.protection import SATELLITE_PRIOR, RiskBudget, open_places
from railfix.integrity.protection.open_places import places_beyond_the_level
from railfix.integrity.raim import linear_model
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import Config
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.search_index import SearchIndex
from railfix.run.processor_setup import make_processor
from railfix.simulate.demonstration import demo_inputs
from railfix.track import read_track
from railfix.track.vehicle import antenna_trajectory, read_vehicle


@pytest.fixture(scope="module")
def pixel(recordings: Path) -> level_cases.Case:
    """Four to seven GPS satellites on a course whose passes lie some 16 m beside each other."""
    assert recordings.is_dir()
    return level_cases.cases()["Pixel"]


@pytest.mark.requirement("C2")
@pytest.mark.slow
def test_no_ok_position_is_over_its_level_with_a_large_fault(pixel: level_cases.Case) -> None:
    """Every second satellite in turn 100 m too long from the middle on, some at a time when another one is off, too."""
    clean = pixel.solved()
    start, judged = len(clean) // 2, 0
    for channel in np.flatnonzero((clean.reason == 0).mean(axis=0) > 0.2)[::2].tolist():
        bias = np.zeros(pixel.observations.code_m.shape)
        bias[start:, pixel.observations.satellite == pixel.observations.satellite[channel]] = 100.0
        result = pixel.solved(bias_m=bias)
        error = pixel.errors_m(result)
        level, calm = level_cases.bounds(result)
        ok = (result.status == Status.OK) & calm & np.isfinite(error)
        judged += int(ok[start:].sum())
        assert not (ok & (error > level))[start:].any()
    assert judged > 200


def risk_beyond(
    y: np.ndarray,
    beyond: np.ndarray,
    noise: np.ndarray,
    prior: np.ndarray,
    sides: list[tuple[int, ...]],
    of_side: float,
) -> float:
    """Sum over the hypotheses by generalised least squares at every point: one clock, map error in the noise.

    y: misfit (points, n); beyond: points that count; noise: covariance (n, n).
    """
    total, n = 0.0, y.shape[1]
    sets = [((), 2.0), *((out, float(np.prod(prior[list(out)]))) for k in (1, 2) for out in combinations(range(n), k))]
    for out, p in [*sets, *((side, of_side) for side in sides if len(side) > 1)]:
        left = np.setdiff1d(np.arange(n), out)
        inverse = np.linalg.inv(noise[np.ix_(left, left)])
        ones = np.ones(len(left))
        inverse -= np.outer(inverse @ ones, inverse @ ones) / (ones @ inverse @ ones)
        q = np.einsum("pi,ij,pj->p", y[:, left], inverse, y[:, left])
        excess = q[beyond].min() - q.min()
        tail = norm.sf(np.sqrt(excess)) if excess > 0 else 1.0
        total += p * tail
    return total


@pytest.mark.slow
@pytest.mark.requirement("C2")
@pytest.mark.parametrize(
    ("local_prior", "side_prior"),
    [(0.0, 0.0), (1e-5, 0.0), (2e-4, 0.0), (0.0, 1.3e-5)],
    ids=["noise", "one fault", "two faults", "a side"],
)
def test_open_places_are_those_that_solving_every_subset_leaves_open(
    pixel: level_cases.Case, local_prior: float, side_prior: float
) -> None:
    """None, each satellite, each pair and each side left out, at points of the whole course half a metre apart.

    Without priors noise alone leaves places open beyond too small a level; with large ones mostly two faults do.
    """
    settings = level_cases.SETTINGS.model_copy(update={"risk": RiskBudget(side_prior=1e-8)})  # smaller levels
    result, line = pixel.solved(settings), pixel.trajectory
    own = SATELLITE_PRIOR if local_prior else dict.fromkeys(SATELLITE_PRIOR, 0.0)
    risk = RiskBudget(local_prior=local_prior, satellite_prior=dict(own), side_prior=side_prior)
    level = result.protection.level.level_m * (1.0 if local_prior else 0.3)
    ranges = ranges_of(result)
    rows = np.flatnonzero(np.isfinite(level) & np.isfinite(result.arc_m) & (result.fix.section.excess > 10.83))[::15]
    ranges, level, arc = ranges.take(rows), level[rows], result.fix.constrained.arc_m[rows]
    section = result.fix.constrained.section[rows]
    systems = [name[0] for name in result.satellite[result.columns].tolist()]
    model = linear_model(ranges, line, arc, section=section)
    scale = np.maximum(result.noise_scale[rows], 1.0)
    index = SearchIndex(line)
    elevation, azimuth = elevation_azimuth(ranges.sat_ecef_m, line.at_arc(arc))
    right = np.sin(np.radians(azimuth - line.heading_deg[section][:, None])) > 0
    sides = np.stack([(elevation < 45.0) & ~right, (elevation < 45.0) & right], axis=1)
    found = places_beyond_the_level(AntennaRows.on(index), arc, model, level, scale, systems, risk, sides)
    points = line.at_arc(np.arange(0.0, line.arc_m[-1], 0.5))
    open_ones = 0
    for t in range(len(rows)):
        use = np.flatnonzero(ranges.weight[t] > 0)
        distance, _ = range_with_rotation(ranges.sat_ecef_m[t, use], points[:, None, :])
        place = line.at_arc(arc[t : t + 1])[0]
        _, los = range_with_rotation(ranges.sat_ecef_m[t, use], place)
        axes = np.stack([line.tangent[section[t]], line.across[section[t]], line.up[section[t]]])
        map_error = (los @ axes.T) * [line.sigma_plan_m, line.sigma_plan_m, line.sigma_height_m]
        noise = scale[t] ** 2 * np.diag(1.0 / ranges.weight[t, use]) + map_error @ map_error.T
        away = points - place
        off = np.abs(away @ line.tangent[section[t]]) < 0.9945 * np.linalg.norm(away, axis=1)
        beyond = off & (np.linalg.norm(away, axis=1) > level[t])
        of_sides = [tuple(np.flatnonzero(side[use]).tolist()) for side in sides[t]]
        y = ranges.code_m[t, use] - distance
        expected = risk_beyond(y, beyond, noise, risk.prior(systems)[use], of_sides, side_prior)
        open_ones += expected > 1.1 * risk.risk_per_sample
        if not 0.9 < expected / risk.risk_per_sample < 1.1:
            assert found[t] == (expected > risk.risk_per_sample), (rows[t], expected)
    assert 0 < open_ones < len(rows)


@pytest.mark.requirement("C2")
@pytest.mark.parametrize("share", [1.0, 0.2])
def test_what_is_passed_over_by_its_bound_is_closed(monkeypatch: pytest.MonkeyPatch, share: float) -> None:
    """A bound of the risk decides most epochs of the demonstration; without it the same epochs are open."""
    inputs = demo_inputs()
    assert inputs.vehicle is not None
    path = antenna_trajectory(read_track(inputs.track), read_vehicle(inputs.vehicle), "front")
    log = {"front": read_observations(inputs.front)[::4]}
    result = (
        make_processor(Config(filter="off"), read_navigation(inputs.nav), {"front": path})
        .process(log)[0]
        .antennas["front"]
    )
    level, arc = share * result.protection.level.level_m, result.fix.constrained.arc_m
    model = linear_model(ranges_of(result), path, arc, section=np.maximum(result.fix.constrained.section, 0))
    systems = [name[0] for name in result.satellite[result.columns].tolist()]
    scale, rows = np.maximum(result.noise_scale, 1.0), np.flatnonzero(np.isfinite(level))
    columns = result.columns
    right = (
        np.sin(np.radians(result.azimuth_deg[:, columns] - path.heading_deg[result.fix.constrained.section][:, None]))
        > 0
    )
    low = result.elevation_deg[:, columns] < 45.0
    sides = np.stack([low & ~right, low & right], axis=1)
    looked_at: list[int] = []
    exact = open_places._risk_of_block

    def counted(index: SearchIndex, arc_m: np.ndarray, *rest: object) -> np.ndarray:
        looked_at.append(len(arc_m))
        return exact(index, arc_m, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(open_places, "_risk_of_block", counted)
    bounded = places_beyond_the_level(
        AntennaRows.on(SearchIndex(path)), arc, model, level, scale, systems, RiskBudget(), sides
    )
    assert 0 < sum(looked_at) < 0.3 * len(rows)
    monkeypatch.setattr(kernels.off_tangent, "risk_off_tangent", lambda _, scale, *__: np.full(len(scale), 1.0))
    every = places_beyond_the_level(
        AntennaRows.on(SearchIndex(path)), arc, model, level, scale, systems, RiskBudget(), sides
    )
    np.testing.assert_array_equal(bounded, every)
    assert every.any() == (share < 1.0)


@pytest.mark.requirement("C2")
@pytest.mark.parametrize("enough", [0.0, 1.0], ids=["each hypothesis", "loose bound"])
def test_bounds_are_the_same_compiled(pixel: level_cases.Case, monkeypatch: pytest.MonkeyPatch, enough: float) -> None:
    """Probabilities are far below the metres that kernels are compared to: to a millionth of themselves."""
    calls: list[tuple[Any, ...]] = []

    def recorded(*arrays: Any) -> np.ndarray:
        calls.append(arrays)
        return np.zeros(len(arrays[1]))

    compiled = kernels.off_tangent.risk_off_tangent
    monkeypatch.setattr(kernels.off_tangent, "risk_off_tangent", recorded)
    pixel.solved(level_cases.SETTINGS.model_copy(update={"risk": RiskBudget(side_prior=1e-2)}))
    assert calls
    for *arrays, clear_m, sigma_m, _ in calls:
        clear_m = np.linspace(20.0, 200.0, len(clear_m))
        one, other = (
            function(*arrays, clear_m, sigma_m, enough)
            for function in (plain("off_tangent").risk_off_tangent, compiled)
        )
        assert 0.1 * len(one) < np.count_nonzero((one > 1e-12) & (one < 1e-2))
        np.testing.assert_allclose(other, one, rtol=1e-5, atol=1e-15)


@pytest.mark.requirement("C2")
@pytest.mark.parametrize("systems", ["GGGGGGG", "GGGGEEE"])
def test_forms_are_those_of_least_squares_without_the_channels(systems: str) -> None:
    """None, each channel, each pair and each side left out: generalised least squares with the map error as noise."""
    arc, scale, sigma_m, n = np.array([731.0, 1420.0]), np.array([1.0, 2.5]), (0.7, 4.0), len(systems)
    ranges = raim_cases.made(arc, systems, seed=6, noise=2.0)
    model = linear_model(ranges, raim_cases.LINE, arc)
    likely, of_side = np.linspace(1e-5, 7e-5, n), 3e-6
    sides = np.zeros((2, 3, n), dtype=bool)
    sides[:, 0, [0, 2, 3]] = sides[:, 1, [1, 4]] = sides[:, 2, 5] = True
    prior, form, lowest, depth, widest = kernels.off_tangent.forms_of_hypotheses(
        model.arrays, scale, likely, sides, of_side, sigma_m
    )
    left_out = [(), *(pair[: 1 + (pair[1] >= 0)] for i in range(n) for pair in ((i, j) for j in range(-1, i)))]
    left_out += [(0, 2, 3), (1, 4), (5,)]
    expected = [2.0, *(float(np.prod(likely[list(out)])) for out in left_out[1:-3]), of_side, of_side, 0.0]
    np.testing.assert_allclose(prior, [expected] * 2, rtol=1e-12)
    clocks = np.array([[letter == other for other in dict.fromkeys(systems)] for letter in systems], dtype=float)
    for t, place in enumerate(raim_cases.LINE.at_arc(arc)):
        axes = raim_cases.LINE.get_axes(raim_cases.LINE.segment_at(arc[t : t + 1])[0])[0]
        distance, sight = range_with_rotation(ranges.sat_ecef_m[t], place)
        y, rows = ranges.code_m[t] - distance, -sight @ axes.T
        errors = rows * [sigma_m[0], sigma_m[0], sigma_m[1]]
        noise = scale[t] ** 2 * np.diag(1.0 / ranges.weight[t]) + errors @ errors.T
        for k, out in enumerate(left_out[:-1]):
            left = np.setdiff1d(np.arange(n), out)
            inverse, own = np.linalg.inv(noise[np.ix_(left, left)]), clocks[left]
            own = own[:, own.any(axis=0)]
            inverse -= inverse @ own @ np.linalg.inv(own.T @ inverse @ own) @ own.T @ inverse
            slope, matrix = rows[left].T @ inverse @ y[left], rows[left].T @ inverse @ rows[left]
            found = np.concatenate([[y[left] @ inverse @ y[left]], slope, matrix[np.triu_indices(3)]])
            np.testing.assert_allclose(form[t, k], found, rtol=1e-6, atol=1e-9, err_msg=str(out))
            if np.linalg.matrix_rank(matrix, rtol=1e-9) < 3:
                assert np.isnan(lowest[t, k])
                continue
            at = np.linalg.solve(matrix, slope)
            assert lowest[t, k] == pytest.approx(np.linalg.norm(at), rel=1e-5)
            assert depth[t, k] == pytest.approx(at @ slope, rel=1e-5)
            assert widest[t, k] == pytest.approx(np.trace(np.linalg.inv(matrix)), rel=1e-5)
