"""P4's experiment on recordings: a reference station played as a train on a straight line through it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.evaluate import along_track_error
from railfix.integrity.raim import (
    LinearModel,
    Outcome,
    RaimLimits,
    detect,
    exclude,
    linear_model,
    noncentrality,
    reliability,
)
from railfix.integrity.raim.position_model import compact
from railfix.io import read_observations
from railfix.positioning.normal_equations import Constrained, position_on_line
from railfix.positioning.range_arrays import Ranges
from railfix.ranges.channels import clock_groups
from railfix.track.trajectory import Trajectory
from raim_cases import point_model
from recordings_score import geonet

pytestmark = pytest.mark.requirement("B6")


@dataclass(frozen=True)
class Station:
    """One hour of a station, GPS, every 30 s, as a train standing on a line."""

    place_ecef_m: np.ndarray
    trajectory: Trajectory
    ranges: Ranges
    position: Constrained
    point_ecef_m: np.ndarray
    scale: np.ndarray

    def model(self) -> LinearModel:
        return linear_model(self.ranges, self.trajectory, self.position.arc_m, section=self.position.section)

    def with_errors(self, error_m: np.ndarray) -> LinearModel:
        """Solved again with errors added to the ranges."""
        ranges = replace(self.ranges, code_m=self.ranges.code_m + error_m)
        vertex = np.argmin(np.abs(self.trajectory.arc_m - self.position.arc_m[:, None]), axis=1)
        got = position_on_line(ranges, self.trajectory, vertex)
        return linear_model(ranges, self.trajectory, got.arc_m, section=got.section)


@pytest.fixture(scope="module", params=[("0759", 0.0), ("3040", 90.0)], ids=["0759-north", "3040-east"])
def station(request: pytest.FixtureRequest, recordings: Path) -> Station:
    name, azimuth = request.param
    outcome = geonet(recordings, name, azimuth)
    result, trajectory = outcome.result, outcome.trajectory
    assert trajectory is not None
    columns = result.columns
    used = result.reason[:, columns] == 0
    place = read_observations(recordings / "static" / "rtklib_geonet2005" / f"{name}0920.05o").header
    ranges = Ranges(
        sat_ecef_m=np.where(used[..., None], result.corrected.satellites.position_ecef_m, 2.6e7),
        code_m=np.where(used, result.corrected_code_m[:, columns], 0.0),
        weight=np.where(used, 1.0 / result.sigma_m[:, columns] ** 2, 0.0),
        groups=clock_groups([str(s)[0] for s in result.satellite[columns]]),
    )
    return Station(
        place.approximate_ecef_m, trajectory, ranges, result.fix.constrained, result.point.ecef_m, result.noise_scale
    )


def test_no_false_alarm_and_errors_within_the_level(station):
    """P4: T below T_D over the day, the error within the protection level, that below 20 m, one car."""
    model = station.model()
    found = detect(model.wsse, model.residual_m, model.freedom, scale=station.scale)
    level = reliability(model, scale=station.scale)
    assert found.testable.all()
    assert found.detected.mean() <= 0.01
    reference = np.broadcast_to(station.place_ecef_m, (len(model), 3))
    error = along_track_error(station.position.arc_m, reference, station.trajectory)
    assert (np.abs(error) < level.protection_level_m).all()
    assert level.available.all()
    assert level.alarm.mean() < 0.02
    # What P4 plots: east and north of the station, there within 15 m.
    latitude, longitude, _ = geodetic_from_ecef(station.place_ecef_m)
    position = station.trajectory.at_arc(station.position.arc_m)
    enu = (position - station.place_ecef_m) @ enu_axes(latitude, longitude).T
    assert np.abs(enu[:, :2]).max() < 15.0


def test_the_line_protects_better_than_space(station):
    """P4's point: fewer unknowns, more redundancy, smaller level on the same ranges."""
    line = reliability(station.model(), scale=station.scale)
    space = reliability(point_model(station.ranges, station.point_ecef_m), scale=station.scale)
    assert (line.protection_level_m < space.protection_level_m).all()
    assert np.median(line.protection_level_m / space.protection_level_m) < 0.7


@pytest.mark.requirement("B4")
def test_one_fault_of_three_times_its_detectable_bias_is_excluded(station):
    """Each satellite in turn: found in 95 % where told apart, nobody else blamed."""
    bias = reliability(station.model(), scale=station.scale).minimal_detectable_bias_m
    right, wrong, told = 0, 0, 0
    for channel in range(bias.shape[1]):
        error = np.zeros_like(bias)
        error[:, channel] = 3.0 * np.where(np.isfinite(bias[:, channel]), bias[:, channel], 0.0)
        hit = error[:, channel] > 0
        got = exclude(station.with_errors(error), scale=station.scale)
        assert (got.outcome[hit] != Outcome.PASSED).all()
        alone = (got.outcome == Outcome.EXCLUDED_ONE) & (got.best[:, 0] == channel)
        right += np.count_nonzero(alone & hit)
        wrong += np.count_nonzero(got.excluded.any(axis=1) & ~alone & hit)
        told += np.count_nonzero(hit)
    assert told > 700
    assert right >= 0.95 * told
    assert wrong == 0


def least_lead(model: LinearModel, scale: np.ndarray, pair: tuple[int, int], error_m: np.ndarray) -> np.ndarray:
    """Statistic that the faults of a pair leave, without noise, when the best other pair is left out, shape (T,)."""
    whole = compact(model)
    projector = np.zeros((len(model), model.used.shape[1], model.used.shape[1]))
    epoch = np.arange(len(model))[:, None, None]
    projector[epoch, whole.channel[:, :, None], whole.channel[:, None, :]] = whole.projector
    fault = error_m * model.root_weight
    shown = np.einsum("tij,tj->ti", projector, fault)
    total = np.einsum("ti,ti->t", fault, shown)
    others = [p for p in combinations(range(fault.shape[1]), 2) if p != pair]
    leads = np.full((len(others), len(model)), np.inf)
    for k, other in enumerate(others):
        block = projector[:, other][:, :, other]
        regular = np.linalg.det(block) > 1e-9
        block = np.where(regular[:, None, None], block, np.eye(2))
        part = shown[:, other]
        drop = np.einsum("ti,ti->t", part, np.linalg.solve(block, part[..., None])[..., 0])
        leads[k] = np.where(regular, (total - drop) / scale**2, np.inf)
    return leads.min(axis=0)


@pytest.mark.requirement("B4")
def test_two_faults_are_excluded_where_they_can_be_told(station):
    """Pairs in turn, each error three times its detectable bias: 95 % where theory tells them from any other pair."""
    model, limits = station.model(), RaimLimits()
    bias = reliability(model, scale=station.scale).minimal_detectable_bias_m
    used = np.isfinite(bias)
    # Told apart with a probability of 0.999: noncentrality of one degree of freedom against `separation`.
    enough = noncentrality(1, limits=limits.replaced(false_alarm=limits.separation_risk))
    outcomes, look_alikes = np.zeros((2, len(Outcome)), dtype=int), 0
    for k, pair in enumerate(combinations(np.flatnonzero(used.any(axis=0)), 2)):
        error = np.zeros_like(bias)
        error[:, pair[0]] = 3.0 * bias[:, pair[0]]
        error[:, pair[1]] = 3.0 * bias[:, pair[1]] * (1 if k % 2 else -1)
        error = np.nan_to_num(error)
        both = used[:, pair].all(axis=1) & (model.freedom >= 3)
        got = exclude(station.with_errors(error), limits=limits, scale=station.scale)
        right = (got.best == np.array(pair)).all(axis=1)
        told = least_lead(model, station.scale, pair, error) > enough
        blamed = both & got.excluded.any(axis=1) & ~right
        assert not (blamed & told).any()
        look_alikes += np.count_nonzero(blamed)
        outcomes[0] += np.bincount(got.outcome[both & told], minlength=len(Outcome))
        outcomes[1] += np.bincount(got.outcome[both & ~told], minlength=len(Outcome))
    assert outcomes[0].sum() > 1000
    assert outcomes[0, Outcome.EXCLUDED_TWO] >= 0.95 * outcomes[0].sum()
    assert outcomes[:, Outcome.PASSED].sum() == 0
    # Two errors that together look like the error of a third satellite: one goes before two.
    assert look_alikes < 0.01 * outcomes.sum()


@pytest.mark.requirement("B4")
def test_limit_of_p1_sees_100_m2(station):
    """The fixed limit on a quiet receiver: nothing at rest, a step of 30 m on any checked satellite is seen."""
    limits = RaimLimits(mode="fixed")
    assert (exclude(station.model(), limits=limits).outcome == Outcome.PASSED).all()
    share = station.model().redundancy
    for channel in range(share.shape[1]):
        error = np.zeros_like(share)
        error[:, channel] = 30.0
        got = exclude(station.with_errors(error), limits=limits)
        seen = share[:, channel] > 0.5
        assert got.detection.detected[seen].all()
        blamed = got.excluded.copy()
        blamed[:, channel] = False
        assert not blamed[seen].any()
