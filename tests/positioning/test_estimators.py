"""Normal equations, single point, section search, constrained position: against second formulas."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

import synthetic
from exhaustive_search import exhaustive_search
from railfix.core.geodesy import range_with_rotation
from railfix.positioning.normal_equations import misfit, normal_equations, point_position, position_on_line
from railfix.positioning.range_arrays import Ranges
from railfix.positioning.search_index import SearchIndex
from railfix.positioning.section_search import SectionLimits, find_section
from railfix.ranges.channels import clock_groups
from railfix.track import Track
from railfix.track.trajectory import Trajectory

LINE = synthetic.line()
MIDDLE = LINE.ecef_m.mean(axis=0)


def arcs(count: int, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).uniform(5.0, LINE.arc_m[-1] - 5.0, count)


def start(ranges: Ranges) -> np.ndarray:
    return np.broadcast_to(MIDDLE, (len(ranges), 3))


def with_weight(ranges: Ranges, weight: np.ndarray) -> Ranges:
    return Ranges(sat_ecef_m=ranges.sat_ecef_m, code_m=ranges.code_m, weight=weight, groups=ranges.groups)


def keep(ranges: Ranges, channels: list[int]) -> Ranges:
    weight = np.zeros_like(ranges.weight)
    weight[:, channels] = ranges.weight[:, channels]
    return with_weight(ranges, weight)


def found_places(ranges: Ranges, line: Trajectory = LINE) -> tuple[np.ndarray, np.ndarray]:
    point = point_position(ranges, np.broadcast_to(line.ecef_m.mean(axis=0), (len(ranges), 3)))
    return find_section(ranges, SearchIndex(line), point).vertex, point.ecef_m


def test_range_agrees_with_the_rotated_satellite():
    ranges = synthetic.ranges(LINE, arcs(50))
    place = LINE.at_arc(arcs(50))
    distance, los = range_with_rotation(ranges.sat_ecef_m, place[:, None, :])
    assert np.abs(distance - synthetic.travelled_range(ranges.sat_ecef_m, place[:, None, :])).max() < 2e-4
    nudged, _ = range_with_rotation(ranges.sat_ecef_m, place[:, None, :] + np.array([10.0, 0, 0]))
    assert nudged - distance == pytest.approx(-10.0 * los[..., 0], abs=1e-3)


def test_clocks_eliminated_is_clocks_solved_for():
    """Schur complement against the full design matrix with one column a clock."""
    ranges = synthetic.ranges(LINE, arcs(5))
    place = LINE.at_arc(arcs(5)) + 7.0
    equations = normal_equations(ranges, place)
    for t in range(5):
        distance, los = range_with_rotation(ranges.sat_ecef_m[t], place[t])
        design = np.zeros((8, 5))
        design[:, :3] = -los
        for g, group in enumerate(ranges.groups):
            design[group, 3 + g] = 1.0
        root = np.sqrt(ranges.weight[t])
        x, *_ = np.linalg.lstsq(design * root[:, None], (ranges.code_m[t] - distance) * root, rcond=None)
        step = np.linalg.solve(equations.matrix[t], equations.vector[t])
        assert step == pytest.approx(x[:3], abs=1e-5)
        covariance = np.linalg.inv(design.T @ (design * ranges.weight[t][:, None]))
        assert np.linalg.inv(equations.matrix[t]) == pytest.approx(covariance[:3, :3], rel=1e-6)
    assert equations.wsse == pytest.approx(misfit(ranges, place), rel=1e-9)


def test_channels_of_one_clock_stand_side_by_side():
    assert clock_groups(list("GGJEE")) == (slice(0, 3), slice(3, 5))
    with pytest.raises(ValueError, match="must be adjacent"):
        clock_groups(list("GEG"))


@pytest.mark.requirement("A6")
def test_single_point_of_exact_ranges_is_the_place():
    ranges = synthetic.ranges(LINE, arcs(40), sigma_m=0.0)
    point = point_position(ranges, start(ranges))
    assert np.linalg.norm(point.ecef_m - LINE.at_arc(arcs(40)), axis=1).max() < 2e-3
    assert point.clock_m[:, 0] == pytest.approx(3.0e5, abs=2e-3)


@pytest.mark.requirement("A6")
def test_single_point_needs_three_ranges_beyond_the_clocks():
    ranges = keep(synthetic.ranges(LINE, arcs(3)), [0, 1, 2, 5, 6])
    assert np.isfinite(point_position(ranges, start(ranges)).ecef_m).all()
    ranges = keep(ranges, [0, 1, 2, 5])
    assert np.isnan(point_position(ranges, start(ranges)).ecef_m).all()


@pytest.mark.requirement("A3")
@pytest.mark.parametrize("used", [[0, 1, 2, 3, 4, 5, 6, 7], [0, 1, 2, 3], [0, 1, 2], [0, 1], [0, 5, 6], [1, 2, 5, 6]])
@pytest.mark.parametrize("sigma_m", [0.3, 8.0])
@pytest.mark.every(3)
def test_search_equals_exhaustive_search(used, sigma_m):
    ranges = keep(synthetic.ranges(LINE, arcs(60), sigma_m=sigma_m), used)
    vertex, q = exhaustive_search(ranges, LINE)
    point = point_position(ranges, start(ranges))
    section = find_section(ranges, SearchIndex(LINE), point)
    assert section.vertex.tolist() == vertex.tolist()
    assert section.q == pytest.approx(q.min(axis=1), rel=1e-3, abs=1e-3)


@pytest.mark.requirement("A3")
def test_search_looks_at_no_more_of_a_longer_line():
    long_line = synthetic.line(200_000.0)
    for used in ([0, 1, 2, 3, 4, 5, 6, 7], [0, 1, 2]):
        looked = []
        for line in (LINE, long_line):
            ranges = keep(synthetic.ranges(line, arcs(40), sigma_m=1.0), used)
            point = point_position(ranges, start(ranges))
            section = find_section(ranges, SearchIndex(line), point)
            looked.append(section.evaluations.mean())
        assert looked[1] < looked[0] * (1.5 if len(used) > 3 else 4.0) + 1


@pytest.mark.requirement("A3")
def test_two_branches_side_by_side_are_ambiguous():
    """A hairpin: out and back at 6 m; 12 m of noise cannot tell, 0.3 m can."""
    s = np.arange(0.0, 300.0, 5.0)
    out = np.stack([s, np.zeros_like(s), np.zeros_like(s)], axis=1)
    back = np.stack([s[::-1], np.full_like(s, 6.0), np.zeros_like(s)], axis=1)
    hairpin = Trajectory.from_antenna_path(Track.from_ecef(synthetic.enu_to_ecef(np.concatenate([out, back]))))
    where = np.linspace(40.0, 200.0, 30)
    threshold = SectionLimits().threshold
    for sigma_m, ambiguous in ((12.0, True), (0.05, False)):
        ranges = synthetic.ranges(hairpin, where, sigma_m=sigma_m)
        point = point_position(ranges, np.broadcast_to(hairpin.ecef_m[0], (30, 3)))
        section = find_section(ranges, SearchIndex(hairpin), point)
        assert np.all((section.excess <= threshold) == ambiguous)


def oracle(ranges: Ranges, t: int, line: Trajectory, arc: float) -> float:
    """Distance, clocks and map offsets by a general optimiser, the map error as a prior."""
    used = ranges.weight[t] > 0
    root = np.sqrt(ranges.weight[t][used])
    clocks = np.zeros((len(used), len(ranges.groups)))
    for g, group in enumerate(ranges.groups):
        clocks[group, g] = 1.0
    clocks = clocks[used]
    clocks = clocks[:, clocks.any(axis=0)]
    section, _ = (np.atleast_1d(v) for v in line.segment_at(np.array([arc])))
    across, up = line.across[section[0]], line.up[section[0]]

    def residual(x: np.ndarray) -> np.ndarray:
        place = line.at_arc(np.array([x[0]]))[0] + x[1] * across + x[2] * up
        distance = synthetic.travelled_range(ranges.sat_ecef_m[t][used], place)
        fitted = (ranges.code_m[t][used] - distance - clocks @ x[3:]) * root
        return np.concatenate([fitted, [x[1] / line.sigma_plan_m, x[2] / line.sigma_height_m]])

    def jacobian(x: np.ndarray) -> np.ndarray:
        """Central differences over a metre: ranges of 2e7 m leave 4e-9 m to a difference."""
        return np.stack([residual(x + e) - residual(x - e) for e in 0.5 * np.eye(len(x))], axis=1)

    first = np.zeros(3 + clocks.shape[1])
    first[0] = arc + 0.7
    first[3:] = 3.0e5
    return float(least_squares(residual, first, jac=jacobian, x_scale="jac", xtol=1e-14, ftol=1e-14).x[0])


@pytest.mark.requirement("A4")
@pytest.mark.parametrize("used", [list(range(8)), [0, 1, 2, 3], [0, 1, 2], [0, 1]])
@pytest.mark.every(2)
def test_constrained_position_equals_a_general_optimiser(used):
    """On a straight line, where the optimum is smooth: within 1 mm."""
    s = np.arange(0.0, 1001.0, 20.0)
    straight = Trajectory.from_antenna_path(
        Track.from_ecef(synthetic.enu_to_ecef(np.stack([0.6 * s, 0.8 * s, 0.005 * s], axis=1)))
    )
    where = np.linspace(150.0, 850.0, 12)
    ranges = keep(synthetic.ranges(straight, where, sigma_m=1.0), used)
    vertex, _ = found_places(ranges, straight)
    got = position_on_line(ranges, straight, vertex)
    good = np.flatnonzero((got.dilution < 20) & (got.overshoot_m == 0))
    assert len(good) >= 8
    expected = np.array([oracle(ranges, t, straight, got.arc_m[t]) for t in good])
    assert np.abs(got.arc_m[good] - expected).max() < 1e-3


@pytest.mark.requirement("A4")
def test_exact_ranges_of_two_satellites_give_the_place():
    where = arcs(40)
    ranges = keep(synthetic.ranges(LINE, where, sigma_m=0.0), [0, 1])
    truth = np.argmin(np.abs(LINE.arc_m - where[:, None]), axis=1)
    got = position_on_line(ranges, LINE, truth)
    fine = got.dilution < 10
    assert fine.sum() > 20
    assert np.abs(got.arc_m - where)[fine].max() < 5e-3


@pytest.mark.requirement("A4")
@pytest.mark.slow
def test_error_over_its_own_sigma_is_one():
    where = arcs(3000)
    ranges = synthetic.ranges(LINE, where, sigma_m=2.0)
    # The weights of `synthetic` are lower than 1/sigma^2 by a known factor: give the noise that they state.
    rng = np.random.default_rng(9)
    code = synthetic.travelled_range(ranges.sat_ecef_m, LINE.at_arc(where)[:, None, :])
    code = code + rng.normal(size=code.shape) / np.sqrt(ranges.weight)
    ranges = Ranges(sat_ecef_m=ranges.sat_ecef_m, code_m=code, weight=ranges.weight, groups=ranges.groups)
    got = position_on_line(ranges, LINE, found_places(ranges)[0])
    inside = got.overshoot_m == 0
    ratio = ((got.arc_m - where) / got.exact_map_sigma_m)[inside]
    assert 0.9 < np.sqrt(np.mean(ratio**2)) < 1.1
    freedom = ranges.n_used - ranges.n_clocks - 1
    assert 0.9 < np.mean(got.wsse / freedom) < 1.1


@pytest.mark.requirement("A4")
@pytest.mark.slow
def test_convex_vertex_ends_the_walk():
    """Both neighbours of a sharp point send the step back to it: the point is the answer."""
    s = np.arange(0.0, 201.0, 20.0)
    bent = np.concatenate(
        [np.stack([s, np.zeros_like(s), 0 * s], axis=1), np.stack([np.full(10, 200.0), -s[1:], 0 * s[1:]], axis=1)]
    )
    line = Trajectory.from_antenna_path(Track.from_ecef(synthetic.enu_to_ecef(bent)))
    outside = synthetic.enu_to_ecef(np.array([[215.0, 15.0, 0.0]]))
    made = synthetic.ranges(line, np.array([10.0]))
    code = synthetic.travelled_range(made.sat_ecef_m, outside[:, None, :])
    ranges = Ranges(sat_ecef_m=made.sat_ecef_m, code_m=code, weight=np.ones_like(code), groups=made.groups)
    got = position_on_line(ranges, line, np.array([9]))
    assert got.arc_m == pytest.approx(200.0, abs=1e-9)


@pytest.mark.requirement("A4")
def test_beyond_the_end_is_clamped_and_told():
    made = synthetic.ranges(LINE, np.array([10.0]))
    place = LINE.ecef_m[0] - 80.0 * LINE.tangent[0]
    code = synthetic.travelled_range(made.sat_ecef_m, place)
    ranges = Ranges(sat_ecef_m=made.sat_ecef_m, code_m=code, weight=made.weight, groups=made.groups)
    got = position_on_line(ranges, LINE, np.array([3]))
    assert got.arc_m[0] == 0.0
    assert got.overshoot_m[0] == pytest.approx(80.0, rel=0.05)
