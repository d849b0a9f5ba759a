"""Fault-free levels: DO-229D appendix J against sidereon and against the textbook's matrices."""

from __future__ import annotations

import numpy as np
import pytest

import raim_oracle as oracle
import synthetic
from railfix.core.geodesy import enu_axes, geodetic_from_ecef, range_with_rotation
from railfix.integrity.protection import K_H_NPA, K_H_PA, K_V, RiskBudget
from railfix.integrity.raim import linear_model
from railfix.positioning.range_arrays import Ranges
from railfix.ranges.channels import clock_groups
from sbas_levels import levels_in_space, sbas_level

pytestmark = pytest.mark.requirement("C2")

EPOCHS = 60


def case(systems: str, seed: int) -> tuple[Ranges, np.ndarray, np.ndarray]:
    """Ranges with the four sigmas of appendix J, the positions, and those sigmas (T, M, 4)."""
    rng = np.random.default_rng(seed)
    shape = (EPOCHS, len(systems))
    sigmas = rng.uniform(0.1, 3.0, (*shape, 4))
    variance = (sigmas**2).sum(axis=-1)
    assert variance == pytest.approx((sigmas**2).sum(axis=-1), rel=1e-14)
    sat = synthetic.satellites(rng, EPOCHS, systems)
    ranges = Ranges(
        sat_ecef_m=sat, code_m=np.full(shape, 2.2e7), weight=1.0 / variance, groups=clock_groups(list(systems))
    )
    return ranges, np.broadcast_to(synthetic.enu_to_ecef(np.zeros(3)), (EPOCHS, 3)), sigmas


def textbook(ranges: Ranges, place: np.ndarray, t: int) -> np.ndarray:
    """(G^T W G)^-1 with G = [east, north, up, a column a clock]."""
    latitude, longitude, _ = geodetic_from_ecef(place[t])
    _, los = range_with_rotation(ranges.sat_ecef_m[t], place[t])
    clocks = np.zeros((los.shape[0], len(ranges.groups)))
    for g, group in enumerate(ranges.groups):
        clocks[group, g] = 1.0
    design = np.concatenate([-los @ enu_axes(latitude, longitude).T, clocks], axis=1)
    return np.linalg.inv(design.T @ (design * ranges.weight[t][:, None]))


@pytest.mark.parametrize("systems", ["GGGGG", "GGGGGGGG", "GGGGGEEEE", "GGGGEEECC"])
def test_levels_in_space_are_the_textbooks(systems):
    ranges, place, _ = case(systems, seed=4)
    got = levels_in_space(ranges, place)
    for t in range(EPOCHS):
        d = textbook(ranges, place, t)
        major = np.sqrt(np.linalg.eigvalsh(d[:2, :2])[-1])
        assert got.horizontal_m[t] == pytest.approx(K_H_PA * major, abs=1e-3)
        assert got.vertical_m[t] == pytest.approx(K_V * np.sqrt(d[2, 2]), abs=1e-3)
    npa = levels_in_space(ranges, place, k_horizontal=K_H_NPA)
    assert npa.horizontal_m == pytest.approx(got.horizontal_m * K_H_NPA / K_H_PA, rel=1e-12)


def test_levels_in_space_are_sidereons():
    sidereon = pytest.importorskip("sidereon", reason="the oracle sidereon is not installed")
    systems = "GGGGGGGG"
    ranges, place, sigmas = case(systems, seed=7)
    got = levels_in_space(ranges, place)
    latitude, longitude, height = geodetic_from_ecef(place[0])
    receiver = sidereon.Wgs84Geodetic(np.radians(latitude), np.radians(longitude), height)
    up = enu_axes(latitude, longitude)[2]
    for t in range(EPOCHS):
        _, los = range_with_rotation(ranges.sat_ecef_m[t], place[t])
        names = [f"G{i + 1:02d}" for i in range(len(systems))]
        rows = [
            sidereon.ProtectionRow(name, u, float(np.arcsin(u @ up)), sidereon.GnssSystem.GPS)
            for name, u in zip(names, los, strict=True)
        ]
        geometry = sidereon.ProtectionGeometry(rows, receiver, [sidereon.GnssSystem.GPS])
        flt, uire, tropo, rail = sigmas[t].T
        errors = [
            sidereon.SbasSisError(name, flt[i], sigma_uire_m=uire[i], sigma_air_m=rail[i], sigma_tropo_m=tropo[i])
            for i, name in enumerate(names)
        ]
        theirs = sidereon.sbas_protection_levels(
            geometry, sidereon.SbasErrorModel(errors), sidereon.SbasKMultipliers.precision_approach()
        )
        assert got.horizontal_m[t] == pytest.approx(theirs.hpl_m, abs=1e-3)
        assert got.vertical_m[t] == pytest.approx(theirs.vpl_m, abs=1e-3)
        assert got.major_m[t] == pytest.approx(theirs.d_major_m, abs=1e-3)


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_level_along_the_track_is_the_textbooks(scale):
    arc = np.linspace(100.0, 1900.0, 20)
    ranges = oracle.made(arc, "GGGGGEE", seed=9)
    k = RiskBudget().sample_k
    got = sbas_level(linear_model(ranges, oracle.LINE, arc), k=k, scale=scale)
    for t in range(20):
        rows = oracle.problem_on_line(ranges, t, arc[t])
        along = np.linalg.pinv(rows.design)[0]
        noise = np.full(len(along), scale)
        noise[-2:] = 1.0  # the map error, one row each across and up
        assert got[t] == pytest.approx(k * np.sqrt(((along * noise) ** 2).sum()), abs=1e-9)


def test_no_position_no_level():
    arc = np.array([500.0, np.nan])
    got = sbas_level(linear_model(oracle.made(np.full(2, 500.0), "GGGGG", seed=1), oracle.LINE, arc), k=5.33)
    assert np.isfinite(got[0])
    assert np.isnan(got[1])
    ranges, place, _ = case("GGG", seed=2)
    assert np.isnan(levels_in_space(ranges, place).horizontal_m).all()
