"""ARAIM with an integrity support message: a case by hand, mode by mode, and sidereon's levels."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sidereon
from scipy.optimize import brentq
from scipy.stats import norm

import pipeline_cases
from railfix.core.errors import InputFileError, SettingsError
from railfix.core.geodesy import enu_axes
from railfix.integrity.protection.araim import AraimBudget, AraimGeometry, AraimLevels, araim_levels
from railfix.integrity.protection.support_message import read_integrity_support
from railfix.pipeline import level_stage
from railfix.pipeline.config import parse_config
from railfix.pipeline.level_stage import with_map
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.range_stage import Models

MESSAGE = """
format = "railfix integrity support 1"
[constellation.G]
sigma_ura_m = 2.0
sigma_ure_m = 1.0
bias_m = 0.75
prior = 1e-5
constellation_prior = 1e-8
[constellation.E]
sigma_ura_m = 3.0
sigma_ure_m = 1.5
bias_m = 1.0
prior = 3e-5
constellation_prior = 1e-4
[satellite.E05]
sigma_ura_m = 6.0
sigma_ure_m = 3.0
bias_m = 1.0
prior = 1e-4
"""
AZIMUTH = np.radians([10, 100, 190, 280, 330, 60, 140, 230, 250, 20, 300, 200])
ELEVATION = np.radians([75, 60, 40, 30, 25, 50, 35, 20, 65, 45, 15, 30])
ENU = np.stack([np.cos(ELEVATION) * np.sin(AZIMUTH), np.cos(ELEVATION) * np.cos(AZIMUTH), np.sin(ELEVATION)], axis=1)
GPS = np.arange(12) < 6


def twelve(*, satellite: float = 1e-5, constellation: float = 1e-4) -> AraimGeometry:
    """Six satellites each of two constellations, east, north, up and two clocks."""
    noise = 0.7 / np.sin(ELEVATION)
    return AraimGeometry(
        design=np.concatenate([-ENU, np.stack([GPS, ~GPS], axis=1)], axis=1)[None],
        sigma_int_m=np.hypot(1.0, noise)[None],
        sigma_acc_m=np.hypot(0.5, noise)[None],
        bias_m=np.full((1, 12), 0.75),
        prior=np.full(12, satellite),
        together=np.stack([GPS, ~GPS]),
        together_prior=np.full(2, constellation),
    )


def in_space(geometry: AraimGeometry, budget: AraimBudget) -> AraimLevels:
    return araim_levels(geometry, [1e-9, 1e-9, 9.8e-8], [4.5e-8, 4.5e-8, 3.9e-6], budget)


def mode_by_mode(geometry: AraimGeometry, q: int, phmi: float, alarm: float, total: float, most: int) -> float:
    """Level of component q of one epoch by pseudo-inverses in a loop over the modes, and Brent's method."""
    design, sigma, accuracy, bias = (
        values[0] for values in (geometry.design, geometry.sigma_int_m, geometry.sigma_acc_m, geometry.bias_m)
    )
    events = [({i}, p) for i, p in enumerate(geometry.prior) if p > 0]
    events += [
        (set(np.flatnonzero(m)), p) for m, p in zip(geometry.together, geometry.together_prior, strict=True) if p > 0
    ]

    def estimate(out: set[int]) -> tuple[np.ndarray, float] | None:
        kept = [i for i in range(len(sigma)) if i not in out]
        root = design[kept] / sigma[kept, None]
        columns = np.abs(root).sum(axis=0) > 0
        if np.linalg.matrix_rank(root[:, columns]) < columns.sum() or not columns[:3].all():
            return None
        inverse = np.linalg.pinv(root[:, columns])
        row = inverse[list(np.flatnonzero(columns)).index(q)]
        gain = np.zeros(len(sigma))
        gain[kept] = row / sigma[kept]
        return gain, float(np.linalg.norm(row))

    gain0, sigma0 = estimate(set())
    modes, unmonitored = [], 0.0
    for size in range(1, most + 1):
        for some in combinations(events, size):
            p = float(np.prod([p for _, p in some]))
            found = estimate(set().union(*(members for members, _ in some)))
            if found is None:
                unmonitored += p
            else:
                modes.append((p, *found))
    unmonitored += sum(float(np.prod([p for _, p in some])) for some in combinations(events, most + 1))
    k = norm.isf(alarm / (2 * len(modes)))

    def excess(level: float) -> float:
        spent = 2.0 * norm.sf((level - np.abs(gain0) @ bias) / sigma0)
        for p, gain, own in modes:
            threshold = k * np.sqrt((((gain - gain0) * accuracy) ** 2).sum())
            spent += p * norm.sf((level - threshold - np.abs(gain) @ bias) / own)
        return spent - phmi * (1.0 - unmonitored / total)

    return float(brentq(excess, 0.0, 1e4, xtol=1e-9))


@pytest.mark.requirement("C5")
def test_a_case_by_hand_on_the_line_to_a_millimetre() -> None:
    """Three satellites ahead and three behind, low, 1 m (accuracy 0.5 m), nominal bias 0.4 m, priors 1e-4.

    All: S = +-1/6, sigma 1/sqrt(6), bias 0.4. Without one of them: 1/4 of the two beside it and 1/6 of the others,
    variance (1/2 + 1/3)/4 = 5/24, separation 0.5 sqrt(2/144 + 1/36) = 0.5/sqrt(24), bias 0.4.
    """
    design = np.zeros((1, 6, 4))
    design[0, :, 0], design[0, :, 3] = [1, 1, 1, -1, -1, -1], 1.0
    ranges = AraimGeometry(
        design=design,
        sigma_int_m=np.ones((1, 6)),
        sigma_acc_m=np.full((1, 6), 0.5),
        bias_m=np.full((1, 6), 0.4),
        prior=np.full(6, 1e-4),
        together=np.zeros((0, 6), dtype=bool),
        together_prior=np.zeros(0),
    )
    budget = AraimBudget(phmi_along=1e-6, false_alarm_along=1e-3, unmonitored=1e-6, most_faults=1)
    got = araim_levels(with_map(ranges, 0.3, 0.6, 0.0), [1e-6], [1e-3], budget)
    k, unmonitored = norm.isf(1e-3 / 12), 15 * 1e-8

    def spent(level: float) -> float:
        one = norm.sf((level - k * 0.5 / np.sqrt(24.0) - 0.4) / np.sqrt(5.0 / 24.0))
        return 2.0 * norm.sf((level - 0.4) * np.sqrt(6.0)) + 6e-4 * one - 1e-6 * (1.0 - unmonitored / 1e-6)

    expected = brentq(spent, 0.0, 100.0, xtol=1e-9)
    assert got.level_m[0, 0] == pytest.approx(expected, abs=1e-3)
    assert got.sigma_int_m[0, 0] == pytest.approx(6.0**-0.5, abs=1e-9)
    assert got.sigma_acc_m[0, 0] == pytest.approx(0.5 * 6.0**-0.5, abs=1e-9)
    assert (got.modes[0], got.unmonitored[0]) == (6, pytest.approx(unmonitored))


@pytest.mark.requirement("C5")
@pytest.mark.parametrize(("satellite", "constellation", "faults"), [(1e-5, 1e-4, 1), (3e-4, 1e-7, 2)])
def test_levels_are_those_of_a_loop_over_the_modes_to_a_millimetre(
    satellite: float, constellation: float, faults: int
) -> None:
    given = twelve(satellite=satellite, constellation=constellation)
    found = in_space(given, AraimBudget())
    for q, (phmi, alarm) in enumerate(((1e-9, 4.5e-8), (1e-9, 4.5e-8), (9.8e-8, 3.9e-6))):
        expected = mode_by_mode(given, q, phmi, alarm, 1e-7, faults)
        assert found.level_m[0, q] == pytest.approx(expected, abs=1e-3)


@pytest.mark.requirement("C5")
def test_an_observation_that_is_not_used_may_have_any_design() -> None:
    """A satellite without a record has no direction: the levels are those of the others."""
    whole, last = twelve(), np.arange(12) == 11
    unused = replace(
        whole,
        design=np.where(last[:, None], np.nan, whole.design),
        sigma_int_m=np.where(last, np.nan, whole.sigma_int_m),
        sigma_acc_m=np.where(last, np.nan, whole.sigma_acc_m),
    )
    names = ("design", "sigma_int_m", "sigma_acc_m", "bias_m", "together")
    others = {name: getattr(whole, name)[:, :11] for name in names}
    rest = replace(whole, **others, prior=whole.prior[:11])
    np.testing.assert_allclose(
        in_space(unused, AraimBudget()).level_m, in_space(rest, AraimBudget()).level_m, atol=1e-9
    )


@pytest.mark.requirement("C5")
def test_a_map_is_one_more_constraint_that_can_be_wrong() -> None:
    budget = AraimBudget(phmi_along=1e-7)
    right = araim_levels(with_map(twelve(), 0.3, 0.6, 0.0), [1e-7], [4e-6], budget).level_m[0, 0]
    doubted = araim_levels(with_map(twelve(), 0.3, 0.6, 1e-4), [1e-7], [4e-6], budget).level_m[0, 0]
    alone = araim_levels(twelve(), [1e-7], [4e-6], budget).level_m[0, 0]
    assert right < doubted
    assert right < alone
    expected = mode_by_mode(with_map(twelve(), 0.3, 0.6, 1e-4), 0, 1e-7, 4e-6, 1e-7, 1)
    assert doubted == pytest.approx(expected, abs=1e-3)


@pytest.mark.requirement("C5")
def test_levels_are_those_of_sidereon_within_its_own_5_cm() -> None:
    axes = enu_axes(np.array(35.0), np.array(139.0))
    names = [f"G{k + 1:02d}" for k in range(6)] + [f"E{k + 1:02d}" for k in range(6)]
    rows = [
        sidereon.AraimRow(name, tuple(sight), float(elevation))
        for name, sight, elevation in zip(names, ENU @ axes, ELEVATION, strict=True)
    ]
    systems = [sidereon.GnssSystem.GPS, sidereon.GnssSystem.GALILEO]
    geometry = sidereon.AraimGeometry(rows, sidereon.Wgs84Geodetic(np.radians(35.0), np.radians(139.0), 50.0), systems)
    own = twelve()
    satellites = [
        sidereon.SatelliteIsm(
            name, 1.0, 0.5, 0.75, 1e-5, effective_sigma_int_m=float(a), effective_sigma_acc_m=float(b)
        )
        for name, a, b in zip(names, own.sigma_int_m[0], own.sigma_acc_m[0], strict=True)
    ]
    model = sidereon.SatelliteIsmModel(1.0, 0.5, 0.75, 1e-5)
    message = sidereon.Ism([sidereon.ConstellationIsm(system, 1e-4, model) for system in systems], satellites)
    allocation = sidereon.IntegrityAllocation(1e-7, 9.8e-8, 2e-9, 3.9e-6, 9e-8, 8e-8, 2)
    expected = sidereon.araim(geometry, message, allocation)
    found = in_space(own, AraimBudget())
    assert found.level_m[0, 2] == pytest.approx(expected.vpl_m, abs=0.05)
    assert np.hypot(*found.level_m[0, :2]) == pytest.approx(expected.hpl_m, abs=0.07)
    assert found.sigma_acc_m[0, 2] == pytest.approx(expected.sigma_acc_v_m, abs=1e-6)
    assert found.unmonitored[0] == pytest.approx(expected.p_unmonitored, rel=1e-3)


@pytest.mark.requirement("C5")
def test_a_message_states_satellites_and_says_what_is_wrong_with_it(tmp_path: Path) -> None:
    path = tmp_path / "ism.toml"
    path.write_text(MESSAGE, encoding="utf-8")
    stated = read_integrity_support(path).arrays(["G01", "E05", "C30"])
    np.testing.assert_array_equal(stated.sigma_ura_m, [2.0, 6.0, np.nan])
    np.testing.assert_array_equal(stated.prior, [1e-5, 1e-4, np.nan])
    assert stated.constellation_prior == {"G": 1e-8, "E": 1e-4}
    path.write_text("format = 'something else 1'", encoding="utf-8")
    with pytest.raises(InputFileError, match="format = 'railfix integrity support 1' was expected"):
        read_integrity_support(path)
    path.write_text(MESSAGE.replace("bias_m = 0.75", "bias_m = -1"), encoding="utf-8")
    with pytest.raises(SettingsError, match=r"constellation\.G\.bias_m"):
        read_integrity_support(path)
    with pytest.raises(SettingsError, match="use only one of them"):
        parse_config({"integrity_support": str(path), "sbas": "stream"})


@pytest.mark.requirement("C5")
def test_positions_of_a_run_have_levels_along_the_track_and_in_space_whatever_the_chunks(tmp_path: Path) -> None:
    path = tmp_path / "ism.toml"
    path.write_text(MESSAGE, encoding="utf-8")
    given: dict[str, Any] = {"filter": "off", "systems": ("G", "E")}
    processor = EpochProcessor(
        parse_config(given),
        {"front": pipeline_cases.clean_trajectories()["front"]},
        navigation=pipeline_cases.clean_navigation(),
        models=Models(support=read_integrity_support(path)),
    )
    log = pipeline_cases.clean_observations()["front"][::100]
    found = processor.process({"front": log})[0]["front"]
    first, state = processor.process({"front": log[:7]})
    second, _ = processor.process({"front": log[7:]}, state)
    along, space = found.araim.along.level_m[:, 0], found.araim.horizontal_m
    cut = [part["front"].araim.along.level_m[:, 0] for part in (first, second)]
    np.testing.assert_allclose(np.concatenate(cut), along, rtol=1e-9)
    located = np.isfinite(found.chainage_m)
    assert np.isfinite(along[located]).all()
    error = np.abs(found.chainage_m - pipeline_cases.true_chainage("front")[::100])
    assert (error < along)[located].all()
    assert np.median(along[located]) < np.median(space[located])


@pytest.mark.requirement("C5")
def test_a_run_takes_ura_for_integrity_ure_for_accuracy_and_half_of_the_risk_east_and_north(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, given = tmp_path / "ism.toml", list[tuple[AraimGeometry, list[float], list[float]]]()
    path.write_text(MESSAGE, encoding="utf-8")
    levels = level_stage.araim_levels

    def seen(geometry: AraimGeometry, phmi: list[float], false_alarm: list[float], budget: AraimBudget) -> AraimLevels:
        given.append((geometry, phmi, false_alarm))
        return levels(geometry, phmi, false_alarm, budget)

    monkeypatch.setattr(level_stage, "araim_levels", seen)
    support = read_integrity_support(path)
    processor = EpochProcessor(
        parse_config({"filter": "off", "systems": ("G", "E")}),
        {"front": pipeline_cases.clean_trajectories()["front"]},
        navigation=pipeline_cases.clean_navigation(),
        models=Models(support=support),
    )
    found = processor.process({"front": pipeline_cases.clean_observations()["front"][:1]})[0]["front"]
    used = (found.reason[:, found.columns] == 0).any(axis=0)
    names = found.satellite[found.columns][used].tolist()
    stated = support.arrays(names)
    apart = stated.sigma_ura_m**2 - stated.sigma_ure_m**2
    assert (apart > 0.1).all()
    (on_line, *along), (in_air, *space) = given
    for geometry, count in ((on_line, len(names)), (in_air, len(names))):
        squares = geometry.sigma_int_m[0, :count] ** 2 - geometry.sigma_acc_m[0, :count] ** 2
        np.testing.assert_allclose(squares, apart, rtol=1e-9)
    assert along == [[9.8e-8], [3.9e-6]]
    np.testing.assert_allclose(space, [[1e-9, 1e-9, 9.8e-8], [4.5e-8, 4.5e-8, 3.9e-6]])


@pytest.mark.requirement("C5")
@pytest.mark.parametrize(("first", "last"), [(None, 3), (4, 8), (-9, -5), (50, 60)])
def test_epochs_outside_the_period_of_a_message_have_no_level(tmp_path: Path, first: int | None, last: int) -> None:
    """In it, expired within the log, before the log, after the log: what is outside is named."""
    log = pipeline_cases.clean_observations()["front"][::100][:10]
    second = np.timedelta64(1, "s")
    since = (log.time - log.time[0]) / second
    text = "" if first is None else f"valid_from = {(log.time[0] + first * 10 * second).astype('datetime64[s]')}\n"
    text += f"valid_until = {(log.time[0] + last * 10 * second).astype('datetime64[s]')}\n"
    path = tmp_path / "ism.toml"
    path.write_text(text + MESSAGE, encoding="utf-8")
    processor = EpochProcessor(
        parse_config({"filter": "off", "systems": ("G", "E")}),
        {"front": pipeline_cases.clean_trajectories()["front"]},
        navigation=pipeline_cases.clean_navigation(),
        models=Models(support=read_integrity_support(path)),
    )
    result = processor.process({"front": log})[0]
    inside = (since >= -np.inf if first is None else since >= first * 10) & (since <= last * 10)
    assert since[-1] == 90.0
    for levels in (result["front"].araim.along.level_m, result["front"].araim.space.level_m):
        np.testing.assert_array_equal(np.isfinite(levels[:, 0]), inside & np.isfinite(result["front"].chainage_m))
    assert any("Epochs outside this period have no ARAIM level" in note for note in result.notes)


@pytest.mark.requirement("C5")
def test_a_period_is_in_gps_time_and_its_absence_is_told(tmp_path: Path) -> None:
    path = tmp_path / "ism.toml"
    path.write_text(MESSAGE, encoding="utf-8")
    assert "not known whether it has expired" in read_integrity_support(path).notes(np.empty(0, "datetime64[ns]"))[0]
    path.write_text("valid_until = 2026-01-01T00:00:00Z\n" + MESSAGE, encoding="utf-8")
    with pytest.raises(SettingsError, match="GPS time: write them without a time zone"):
        read_integrity_support(path)
    path.write_text("valid_from = 2026-01-02T00:00:00\nvalid_until = 2026-01-01T00:00:00\n" + MESSAGE, encoding="utf-8")
    with pytest.raises(SettingsError, match="must be before valid_until"):
        read_integrity_support(path)
