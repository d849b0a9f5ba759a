"""The linear model of RAIM: against the solvers, and against a design with one column a clock and one row a prior."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import raim_cases
import raim_oracle as oracle
import synthetic
from railfix import kernels
from railfix.integrity.raim import linear_model
from railfix.integrity.raim.position_model import _model, compact
from railfix.positioning.normal_equations import point_position, position_on_line
from railfix.positioning.range_arrays import UNTIED_M, InterSystemBiases
from raim_cases import point_model

pytestmark = pytest.mark.requirement("B6")

#: Systems of a case and what is known of their clocks.
CASES = [
    ("GGGGGGG", None),
    ("GGGGEEEE", None),
    ("GGGJEECCC", None),
    ("GGGGEECR", None),
    ("GGGGEEEE", (0.0, 1.0)),
    ("GGGGEC", (0.0, 1.0, 2.0)),
    ("GGGGECC", (0.0, 0.5, UNTIED_M)),
    ("GGGEEE", (0.0, 0.0)),
]


@pytest.mark.parametrize(("systems", "ties"), CASES)
def test_model_is_the_solvers_own(systems, ties):
    """WSSE and sigma of the constrained position and of the 3-D one."""
    arc = np.linspace(100.0, 1900.0, 30)
    ranges = raim_cases.made(arc, systems, seed=4, tie_sigma_m=ties)
    got, model = raim_cases.solved(ranges, arc)
    assert model.wsse == pytest.approx(got.wsse, rel=1e-4, abs=1e-4)
    assert np.sqrt(model.covariance_m2[:, 0, 0]) == pytest.approx(got.sigma_m, rel=1e-6)
    assert np.sqrt(model.position_covariance_m2(np.ones(30))[:, 0, 0]) == pytest.approx(got.sigma_m, rel=1e-6)
    assert (model.freedom == ranges.n_used - ranges.n_clocks - 1).all()

    point = point_position(ranges, np.broadcast_to(raim_cases.LINE.ecef_m[0], (30, 3)))
    model = point_model(ranges, point.ecef_m)
    solved = np.isfinite(point.wsse)
    assert solved.all() == (len(systems) > 3 + ranges.n_clocks[0] - 1)
    assert model.wsse[solved] == pytest.approx(point.wsse[solved], rel=1e-4, abs=1e-4)
    trace = np.einsum("tii->t", point.covariance_m2)
    assert np.einsum("tii->t", model.covariance_m2)[solved] == pytest.approx(trace[solved], rel=1e-5)


@given(seed=st.integers(0, 2**32 - 1), case=st.sampled_from(CASES), space=st.booleans())
@settings(max_examples=80)
def test_model_is_least_squares_with_all_columns(seed, case, space):
    systems, ties = case
    arc = np.array([731.0])
    ranges = raim_cases.made(arc, systems, seed=seed, tie_sigma_m=ties)
    if space:
        place = raim_cases.LINE.at_arc(arc) + 0.3
        model, full = point_model(ranges, place), oracle.problem_in_space(ranges, 0, place[0])
        if full.freedom < 0:
            return
    else:
        model, full = (
            linear_model(ranges, raim_cases.LINE, arc),
            oracle.problem_on_line(ranges, 0, arc[0], raim_cases.LINE),
        )
    step, cofactors, residual = full.solve()
    covariance = cofactors[:3, :3] * np.outer(full.scale_of[:3], full.scale_of[:3])
    size = float(np.sqrt(np.trace(covariance)))
    assert model.freedom[0] == full.freedom
    assert model.step_m[0] == pytest.approx(step[:3], abs=1e-5 * (1 + size))
    assert model.covariance_m2[0] == pytest.approx(covariance, rel=1e-5, abs=1e-6 * size**2)
    assert model.residual[0] == pytest.approx(residual[: len(systems)], abs=1e-5 * (1 + size))
    assert model.wsse[0] == pytest.approx((residual**2).sum(), rel=1e-6, abs=1e-5)


def test_map_error_is_carried_once_and_not_scaled():
    """Position variance = scale^2 of the ranges' part + the map's part; both by simulation."""
    arc = np.full(20_000, 731.0)
    sat = np.broadcast_to(synthetic.satellites(np.random.default_rng(2), 1, "GGGGG"), (20_000, 5, 3))
    sigma = np.array([0.4, 0.5, 0.3, 0.6, 0.5])
    ranges = raim_cases.made(arc, "GGGGG", seed=2, noise=3.0, sat_ecef_m=sat.copy(), sigma_m=sigma)
    got, model = raim_cases.solved(ranges, arc)
    expected = model.position_covariance_m2(np.full(len(arc), 3.0))[0, 0, 0] ** 0.5
    assert np.std(got.arc_m - arc) == pytest.approx(expected, rel=0.02)
    assert expected < 2.95 * got.sigma_m[0]


def test_unused_channels_leave_no_trace():
    arc = np.linspace(100.0, 1900.0, 10)
    whole = raim_cases.made(arc, "GGGGGEEEE", seed=5)
    part = raim_cases.only(whole, [0, 1, 3, 4, 6, 8])
    code = part.code_m.copy()
    code[:, [2, 5, 7]] = 0.0
    model, other = (linear_model(r, raim_cases.LINE, arc) for r in (part, replace(part, code_m=code)))
    assert np.array_equal(model.residual, other.residual)
    assert (model.residual[:, [2, 5, 7]] == 0).all()
    assert (model.redundancy[:, [2, 5, 7]] == 0).all()
    assert np.isnan(model.sigma_m[:, [2, 5, 7]]).all()
    _, _, rows, _ = kernels.ranges.reduced_equations(part.arrays, raim_cases.LINE.at_arc(arc))
    assert (rows[:, :, [2, 5, 7]] == 0).all()
    parts = compact(model)
    assert parts.projector.shape == (10, 6, 6)
    assert parts.channel[0].tolist() == [0, 1, 3, 4, 6, 8]


def test_epochs_without_a_position_are_nan():
    arc = np.array([500.0, np.nan, 700.0])
    ranges = raim_cases.made(np.full(3, 500.0), "GGGGGG", seed=5)
    for model in (
        linear_model(ranges, raim_cases.LINE, arc, section=np.array([25, -1, 35])),
        point_model(ranges, raim_cases.LINE.at_arc(arc)),
    ):
        assert np.isnan(model.wsse).tolist() == [False, True, False]
        assert np.isnan(model.covariance_m2[1]).all()


def test_section_of_a_shared_point():
    """At a point of a curved line the two sections have different tangents."""
    line = synthetic.line(spacing_m=20.0)
    vertex = np.array([10])
    ranges = synthetic.ranges(line, line.arc_m[vertex])
    before, after = (linear_model(ranges, line, line.arc_m[vertex], section=vertex + k) for k in (-1, 0))
    default = linear_model(ranges, line, line.arc_m[vertex])
    assert np.array_equal(default.design, after.design)
    assert not np.array_equal(default.design, before.design)


def test_ties_of_some_epochs_go_with_them():
    arc = np.linspace(100.0, 1900.0, 6)
    ranges = raim_cases.made(arc, "GGGEEE", seed=1)
    sigma = np.tile([0.0, 1.0], (6, 1))
    sigma[3:, 1] = UNTIED_M
    tied = replace(ranges, ties=InterSystemBiases(offset_m=np.zeros((6, 2)), sigma_m=sigma))
    got = position_on_line(tied, raim_cases.LINE, np.argmin(np.abs(raim_cases.LINE.arc_m - arc[:, None]), axis=1))
    model = linear_model(tied, raim_cases.LINE, got.arc_m)
    assert model.freedom.tolist() == [4, 4, 4, 3, 3, 3]
    assert np.array_equal(model.take(np.array([4, 1])).wsse, model.wsse[[4, 1]])
    for t in range(6):
        own = tied.take(np.array([t]))
        alone = linear_model(own, raim_cases.LINE, got.arc_m[t : t + 1])
        for name in ("clock_covariance_m2", "covariance_m2", "misfit", "residual", "redundancy"):
            np.testing.assert_allclose(getattr(model, name)[t], getattr(alone, name)[0], atol=1e-12, err_msg=name)


def test_a_map_of_a_millimetre_beside_a_place_known_to_kilometres():
    """The inverse does not depend on the unit of an axis; two axes that are one are singular."""
    arc = np.array([731.0])
    ranges = raim_cases.made(arc, "GGGGGG", seed=3, sigma_m=np.full(6, 1e4))
    place, axes = raim_cases.LINE.at_arc(arc), raim_cases.LINE.get_axes(raim_cases.LINE.segment_at(arc)[0])
    exact = _model(ranges, place, axes, np.diag([0.0, 1e8, 1e8]), unknowns=1)
    assert exact.covariance_m2[0, 1, 1] == pytest.approx(1e-8, rel=1e-6)
    information = (exact.design[0, :, 0] ** 2).sum()
    assert exact.covariance_m2[0, 0, 0] == pytest.approx(1.0 / information, rel=1e-9)
    alike = np.repeat(axes[:, :1], 3, axis=1)
    assert np.isnan(_model(ranges, place, alike, np.diag([0.0, 1e-24, 1e-24]), unknowns=1).covariance_m2).all()


def test_epochs_of_another_model_are_put_in_whole():
    """Ranges without one satellite of each system at some epochs: every field is that of the epoch's own ranges."""
    arc = np.linspace(100.0, 1900.0, 8)
    ranges = raim_cases.made(arc, "GGGGEEEE", seed=5, tie_sigma_m=(0.0, 1.0))
    weight = ranges.weight.copy()
    weight[[2, 5], 1] = weight[[2, 5], 6] = 0.0
    fewer, rows = replace(ranges, weight=weight), np.array([2, 5])
    whole = linear_model(fewer, raim_cases.LINE, arc)
    before = linear_model(ranges, raim_cases.LINE, arc)
    patched = before.patch(rows, linear_model(fewer.take(rows), raim_cases.LINE, arc[rows]))
    for item in fields(whole):
        found, expected = getattr(patched, item.name), getattr(whole, item.name)
        if isinstance(expected, np.ndarray):
            assert np.array_equal(found, expected), item.name
    assert patched.residual == pytest.approx(whole.residual, abs=1e-12)
    assert not np.array_equal(before.freedom, whole.freedom)
