"""Links between the stages of the pipeline: each test fails on one particular mistake in the glue."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from pipeline_cases import clean_navigation, clean_observations, clean_trajectories, front_alone, only, with_code
from railfix.core.arrays import copy_with
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.reasons import Reason, Status
from railfix.core.timescale import timedelta
from railfix.gnss.observations import Observations, carrier_frequency_hz
from railfix.integrity import fault_exclusion
from railfix.integrity.protection import Cause, LevelStatus
from railfix.integrity.raim import Outcome
from railfix.pipeline import level_stage, range_stage
from railfix.pipeline.along_track import compute_tilt_scale, gnss_epochs
from railfix.pipeline.config import parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.range_stage import Models
from railfix.pipeline.results import AntennaResult
from railfix.positioning import igg3_fit, inter_system, line_fix
from railfix.positioning.approximate import ApproximatePosition
from railfix.positioning.igg3_fit import RobustFit
from railfix.positioning.range_arrays import Ranges
from railfix.ranges.corrected import CorrectedRanges
from railfix.ranges.error_model import BinStatistics, ErrorBins, ErrorModel
from railfix.ranges.sources import BaseDifferences
from railfix.tracking import Line

BASE = {"screens": ["elevation", "raim"]}


@cache
def front() -> Observations:
    """Forty epochs in the open."""
    return clean_observations()["front"][400:440]


@cache
def fault_free() -> AntennaResult:
    return front_alone(front(), BASE)


def used_satellite() -> int:
    """Column of a GPS satellite that is used throughout and stands high."""
    good = (fault_free().reason == 0).all(axis=0) & np.char.startswith(front().satellite, "G")
    return int(np.flatnonzero(good)[np.argmax(fault_free().elevation_deg[0, good])])


def with_fault(size_m: float) -> np.ndarray:
    change = np.zeros(front().code_m.shape)
    change[:, used_satellite()] = size_m
    return change


@pytest.mark.requirement("C2")
def test_an_excluded_satellite_counts_in_the_risk() -> None:
    """The level after an exclusion is larger than the level of the same ranges without a fault found among them."""
    excluded = front_alone(with_code(front(), with_fault(80.0)), BASE)
    absent = front_alone(with_code(front(), with_fault(np.nan)), BASE)
    assert (excluded.raim.outcome == Outcome.EXCLUDED_ONE).all()
    assert (excluded.reason[:, used_satellite()] == Reason.FAULT_EXCLUDED).all()
    np.testing.assert_allclose(excluded.chainage_m[0], absent.chainage_m[0], atol=1e-3)
    ratio = excluded.protection.level.fault_free_m[0] / absent.protection.level.fault_free_m[0]
    # a tenth of the risk over the ways to exclude one of a dozen satellites: K from 5.8 to 6.5
    assert 1.05 < ratio < 1.3


def error_model(bias_m: float) -> ErrorModel:
    """One bin with a sigma of 2 m and a nominal bias."""
    bins = ErrorBins(elevation_deg=(0.0, 90.0), sectors=1, cn0_dbhz=(0.0, 60.0))
    shape = bins.shape
    ones, count = np.ones(shape), np.full(shape, 1000)
    statistics = BinStatistics(
        count=count,
        blocks=count,
        bias_m=0.0 * ones,
        sigma_m=2.0 * ones,
        bound_bias_m=bias_m * ones,
        bound_sigma_m=2.0 * ones,
        pooled=np.zeros(shape, dtype=np.int64),
    )
    return ErrorModel(bins=bins, before=statistics, after=statistics, covers="satellite_and_atmosphere")


@pytest.mark.requirement("C2")
def test_the_bias_of_the_error_model_is_in_the_level() -> None:
    """Worst signs of all biases: ``sum |gain| b``, at least b itself times the largest share of a range."""
    config = parse_config({"filter": "off", **BASE, "error_model": "named.toml"})

    def level(bias_m: float) -> AntennaResult:
        model = error_model(bias_m)
        path = {"front": clean_trajectories()["front"]}
        processor = EpochProcessor(config, path, navigation=clean_navigation(), models=Models(error_model=model))
        return processor.process({"front": front()})[0].antennas["front"]

    without, three, six = (level(bias).protection for bias in (0.0, 3.0, 6.0))
    assert np.array_equal(level(3.0).chainage_m, fault_free().chainage_m)
    added = three.level.fault_free_m - without.level.fault_free_m
    assert (added > 1.0).all()
    np.testing.assert_allclose(six.level.fault_free_m - without.level.fault_free_m, 2.0 * added, rtol=1e-9)
    assert (three.level.level_m > without.level.level_m + 0.9 * added).all()


@pytest.mark.requirement("C2")
def test_a_reflection_takes_the_low_satellites_of_a_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """Left and right of the track by the directions to the satellites, up to the elevation of the setting."""
    caught, original = [], level_stage.protection_level

    def spied(*arguments: Any, **options: Any) -> Any:
        caught.append(options["sides"])
        return original(*arguments, **options)

    monkeypatch.setattr(level_stage, "protection_level", spied)
    result = front_alone(front(), BASE)
    (sides,) = caught
    line, columns = clean_trajectories()["front"], result.columns
    section = result.fix.constrained.section
    sight = result.corrected.satellites.position_ecef_m - line.at_arc(result.fix.constrained.arc_m)[:, None]
    level = np.cross(
        line.ecef_m[section] / np.linalg.norm(line.ecef_m[section], axis=1)[:, None], line.tangent[section]
    )
    right = -np.einsum("tki,ti->tk", sight, level) > 0
    low = result.elevation_deg[:, columns] < 45.0
    used = result.reason[:, columns] == 0
    assert (low & used).any()
    assert np.array_equal((sides[:, 1] & used), low & right & used)
    assert np.array_equal((sides[:, 0] & used), low & ~right & used)
    more = front_alone(front(), BASE | {"risk": {"side_prior": 1e-4}}).protection
    assert (more.level.level_m > result.protection.level.level_m).all()


@pytest.mark.requirement("C2")
def test_no_level_reaches_into_a_stretch_without_one() -> None:
    """Positions whose level touches the stretch have none; the verdict is unavailable, positions stay."""
    middle = float(np.median(fault_free().chainage_m))
    before = fault_free().protection.level.level_m
    found = front_alone(front(), BASE | {"no_level_m": [[middle, middle + 5.0]]})
    touched = (fault_free().chainage_m + before > middle) & (fault_free().chainage_m - before < middle + 5.0)
    assert touched.any()
    assert np.array_equal(np.isinf(found.protection.level.level_m), touched)
    assert (found.protection.level.cause[touched] == Cause.UNBOUNDED).all()
    assert (found.protection.status[touched] == LevelStatus.UNAVAILABLE).all()
    assert np.array_equal(found.chainage_m, fault_free().chainage_m)
    far = front_alone(front(), BASE | {"no_level_m": [[middle + 1e4, middle + 2e4]]}).protection
    assert np.array_equal(far.level.level_m, before)


@pytest.mark.requirement("C2")
def test_sigmas_of_the_level_are_the_larger_of_model_and_receiver() -> None:
    """A model below the receiver's own noise changes nothing; above it the level grows, whatever the weights."""
    config = parse_config({"filter": "off", **BASE, "error_model": "named.toml"})

    def level(sigma_m: float) -> np.ndarray:
        model = error_model(0.0)
        wide = replace(model.after, bound_sigma_m=np.full(model.after.bound_sigma_m.shape, sigma_m))
        processor = EpochProcessor(
            config,
            {"front": clean_trajectories()["front"]},
            navigation=clean_navigation(),
            models=Models(error_model=replace(model, after=wide)),
        )
        protection = processor.process({"front": front()})[0].antennas["front"].protection
        return protection.level.fault_free_m

    least, small, two, twenty, forty = (level(sigma) for sigma in (1e-4, 1e-3, 2.0, 20.0, 40.0))
    np.testing.assert_allclose(small, least, rtol=1e-9)
    assert (two > least).all()
    np.testing.assert_allclose(forty / twenty, 2.0, rtol=0.03)


@pytest.mark.requirement("B4")
def test_the_ranges_left_by_an_exclusion_are_tested_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """An exclusion whose remaining ranges fit badly at their own section leaves the epoch unresolved."""
    original, solved = line_fix.fix_on_line, []

    def worse(*arguments: Any, **options: Any) -> Any:
        place = original(*arguments, **options)
        wsse = place.constrained.wsse.copy()
        if len(wsse) == len(front()):
            wsse[::2] = 1e4
            solved.append(len(wsse))
        return replace(place, constrained=replace(place.constrained, wsse=wsse))

    monkeypatch.setattr(line_fix, "fix_on_line", worse)
    found = front_alone(with_code(front(), with_fault(80.0)), BASE)
    assert solved
    assert (found.raim.outcome[::2] == Outcome.UNRESOLVED).all()
    assert (found.raim.outcome[1::2] == Outcome.EXCLUDED_ONE).all()


def faults(*sizes_m: float) -> np.ndarray:
    """Errors of as many satellites as sizes, the one of `used_satellite` first."""
    good = np.flatnonzero((fault_free().reason == 0).all(axis=0)).tolist()
    channels = [used_satellite(), *(c for c in good if c != used_satellite())]
    change = np.zeros(front().code_m.shape)
    for channel, size in zip(channels, sizes_m, strict=False):
        change[:, channel] = size
    return change


@pytest.mark.requirement("B4")
def test_a_pair_that_the_robust_fit_keeps_is_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two that disagree with the rest the rest can be faulty: nothing is excluded, and a check has failed."""
    observations, original = with_code(front(), faults(60.0, 90.0)), igg3_fit.robust_fit
    believed = front_alone(observations, BASE)
    assert (believed.raim.outcome == Outcome.EXCLUDED_TWO).all()

    def keeps_all(ranges: Ranges, *args: Any, **options: Any) -> RobustFit:
        return replace(original(ranges, *args, **options), kept=ranges.weight > 0)

    for module in (inter_system, igg3_fit):
        monkeypatch.setattr(module, "robust_fit", keeps_all)
    doubted = front_alone(observations, BASE)
    assert (doubted.raim.outcome == Outcome.UNRESOLVED).all()
    assert (doubted.status == Status.INCONSISTENT).all()
    assert not doubted.raim.excluded.any()
    fixed = front_alone(observations, BASE | {"raim": {"mode": "fixed", "fixed_limit_m2": 100.0}})
    assert (fixed.raim.outcome == Outcome.EXCLUDED_TWO).all()


@pytest.mark.requirement("B4")
def test_an_unresolved_fault_leaves_the_ranges_of_the_robust_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three faults are more than RAIM excludes: the position is that of the rest, and its status a failed check."""
    change, original = faults(60.0, 90.0, 80.0), igg3_fit.robust_fit
    faulty = (change != 0)[:, fault_free().columns]

    def rejects_them(ranges: Ranges, *args: Any, **options: Any) -> RobustFit:
        return replace(original(ranges, *args, **options), kept=(ranges.weight > 0) & ~faulty)

    for module in (inter_system, igg3_fit):
        monkeypatch.setattr(module, "robust_fit", rejects_them)
    found = front_alone(with_code(front(), change), BASE | {"noise_scale": {"prior": 1e6}})
    assert (found.raim.outcome == Outcome.UNRESOLVED).all()
    assert (found.status == Status.INCONSISTENT).all()
    assert np.array_equal(found.raim.excluded[:, fault_free().columns], faulty)
    assert np.abs(found.chainage_m - fault_free().chainage_m).max() < 3.0


@pytest.mark.requirement("B3")
def test_antennas_sampled_at_other_instants_are_compared_at_one() -> None:
    """The rear receiver samples 8 ms later: its codes are moved there by their own range rates, and nothing changes."""
    parts = {name: log[400:420] for name, log in clean_observations().items()}
    rear, later = parts["rear"], 8_000_000
    rate = -SPEED_OF_LIGHT / carrier_frequency_hz(rear.satellite, rear.signal) * rear.doppler_hz
    moved = replace(rear, time=rear.time + np.timedelta64(later, "ns"), code_m=rear.code_m + rate * later * 1e-9)
    config = parse_config({"filter": "off", "screens": ["antenna_pair"]})
    processor = EpochProcessor(config, clean_trajectories(), navigation=clean_navigation())
    together, _ = processor.process(parts)
    apart, _ = processor.process({"front": parts["front"], "rear": moved})
    first, second = (r.antennas["front"].screens["antenna_pair"].metric for r in (together, apart))
    assert np.isfinite(first).sum() > 100
    assert np.nanmax(np.abs(rate)) * later * 1e-9 > 4.0
    np.testing.assert_allclose(second, first, atol=0.1)


@pytest.mark.requirement("A4")
def test_the_error_of_the_map_does_not_grow_with_the_noise() -> None:
    """The variance less that of the map is the one of the ranges, which the single-epoch sigma gives by itself."""
    rng = np.random.default_rng(4)
    log = clean_observations()["front"][300:700]
    noisy = with_code(log, rng.normal(0.0, 6.0, log.code_m.shape))
    found = front_alone(noisy, {"screens": ["elevation", "raim"], "map_plan_sigma_m": 30.0, "map_height_sigma_m": 30.0})
    late = slice(200, None)
    by_map = (found.fix.constrained.sigma_m**2 - found.fix.constrained.exact_map_sigma_m**2)[late]
    ratio = (found.along_sigma_m[late] ** 2 - by_map) / found.epoch_sigma_m[late] ** 2
    assert np.median(found.noise_scale[late]) > 2.5
    assert np.median(by_map / found.fix.constrained.exact_map_sigma_m[late] ** 2) > 0.3
    assert 0.5 < np.median(ratio) < 1.05


@pytest.mark.requirement("B7")
def test_a_noisy_receiver_on_the_map_is_not_off_it() -> None:
    """Errors five times the weights: the misfit of the line exceeds the limit, but not in the noise of the 3-D fit."""
    rng = np.random.default_rng(11)
    log = clean_observations()["front"][300:500]
    found = front_alone(with_code(log, rng.normal(0.0, 12.0, log.code_m.shape)), {"screens": ["elevation"]})
    plain = found.fix.constrained.wsse - found.point.wsse
    assert (plain > 27.6).mean() > 0.05
    assert (found.status == Status.OFF_MAP).mean() < 0.01


def test_the_noise_of_a_3d_fit_is_that_of_its_redundant_ranges() -> None:
    """Six satellites of one clock leave two redundant ranges, over which the misfit of the 3-D fit is divided."""
    rng = np.random.default_rng(5)
    log = clean_observations()["front"][300:500]
    order = np.argsort(-fault_free().elevation_deg[0])
    gps = [s for s in fault_free().satellite[order].tolist() if s[0] == "G"][:6]
    noisy = with_code(only(log, gps), rng.normal(0.0, 15.0, (len(log), only(log, gps).code_m.shape[1])))
    found = front_alone(noisy, {"screens": ["elevation"], "interference": {"use": "off"}})
    shown = np.maximum(1.0, found.point.wsse / (found.n_used - 4))
    lost = (found.fix.constrained.wsse - found.point.wsse) / shown > chi2.isf(1e-6, 2)
    inside = found.fix.constrained.overshoot_m == 0
    assert 0.01 < lost[inside].mean() < 0.5
    np.testing.assert_array_equal((found.status == Status.OFF_MAP)[inside], lost[inside])


def ranges_of_the_filter() -> CorrectedRanges:
    """Corrected ranges of ten epochs before any screen."""
    config = parse_config({"filter": "off", "screens": []})
    processor = EpochProcessor(config, {"front": clean_trajectories()["front"]}, navigation=clean_navigation())
    return processor.screen({"front": front()[:10]})[0].corrected


#: Reasons that the filter weighs itself; any other keeps code, phase and Doppler out of it.
DOUBTED = (
    Reason.FAULT_EXCLUDED, Reason.ALONE_ON_ITS_CLOCK, Reason.DOPPLER, Reason.CN0_FLOOR, Reason.CN0_CURVE,
    Reason.ANTENNA_PAIR,
)  # fmt: skip


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("reason", [reason for reason in Reason if reason])
def test_the_filter_has_what_a_screen_doubts_and_nothing_that_is_known_to_be_wrong(reason: Reason) -> None:
    ranges = ranges_of_the_filter()
    column = int(np.flatnonzero((ranges.reason == 0).all(axis=0))[0])
    flagged = np.zeros_like(ranges.reason)
    flagged[5, column] = reason
    epochs, _ = gnss_epochs(copy_with(ranges, reason=flagged), np.ones(10), parse_config({}), None)
    for values in (epochs.code_m, epochs.phase_m, epochs.rate_mps):
        kept = (*DOUBTED, Reason.GROSS_ERROR) if values is not epochs.code_m else DOUBTED
        assert np.isfinite(values[[4, 6], column]).all()
        assert np.isfinite(values[5, column]) == (reason in kept)


@pytest.mark.requirement("E5")
def test_phases_of_the_filter_are_without_troposphere_and_satellite_clocks() -> None:
    ranges, scale, config = ranges_of_the_filter(), np.ones(10), parse_config({})
    rising = 3.0 * np.arange(10.0)[:, None]
    used = ranges.reason == 0
    phase = gnss_epochs(ranges, scale, config, None)[0].phase_m
    delayed = copy_with(ranges, troposphere_m=ranges.troposphere_m + rising)
    later = replace(ranges.satellites, clock_m=ranges.satellites.clock_m + rising)
    for other, sign in ((delayed, -1.0), (copy_with(ranges, satellites=later), 1.0)):
        change = gnss_epochs(other, scale, config, None)[0].phase_m - phase
        np.testing.assert_allclose(change[used], (sign * rising + 0.0 * change)[used], atol=1e-6)


@pytest.mark.requirement("C6")
def test_an_active_ionosphere_widens_the_filter_unless_it_is_corrected() -> None:
    """A fifth of the vertical delay over 1 m, by the hour of the day and without satellites."""
    ranges, line = ranges_of_the_filter(), Line(clean_trajectories()["front"])
    longitude = np.degrees(np.arctan2(line.ecef_m[0, 1], line.ecef_m[0, 0]))
    local_s = 3600.0 * np.array([0.0, 6.0, 10.0, 13.0, 14.0, 15.0, 18.0, 22.0, 24.0, 26.0])
    time = np.datetime64("2024-03-05", "ns") + timedelta(local_s - 240.0 * longitude)
    ranges = copy_with(ranges, time=time, ionosphere_m=np.full(ranges.ionosphere_m.shape, np.nan))
    coefficients = np.array([6e-8, 0.0, 0.0, 0.0, 1e5, 0.0, 0.0, 0.0])
    phase = 2.0 * np.pi * (local_s % 86400.0 - 50_400.0) / 1e5
    day = np.where(np.abs(phase) < 1.57, 6e-8 * (1.0 - phase**2 / 2.0 + phase**4 / 24.0), 0.0)
    # the standard's obliquity factor at 90 degrees is 1 + 16 (0.53 - 0.5)^3
    vertical = SPEED_OF_LIGHT * (5e-9 + day) * (1.0 + 16.0 * 0.03**3)

    def tilt(of: CorrectedRanges, klobuchar: np.ndarray | None = coefficients, **settings: Any) -> np.ndarray:
        return compute_tilt_scale(of, line, klobuchar, parse_config(settings))

    assert np.ptp(vertical) > 17.0
    np.testing.assert_allclose(tilt(ranges), np.maximum(vertical / 5.0, 1.0), rtol=1e-3)
    np.testing.assert_allclose(
        tilt(ranges, nominal={"ionosphere_share": 0.5}), np.maximum(vertical / 2.0, 1.0), rtol=1e-3
    )
    assert (tilt(ranges, nominal={"ionosphere_share": 0.0}) == 1.0).all()
    assert (tilt(ranges, None) == 1.0).all()
    free = {"sbas": "stream", "sbas_prn": 137, "sbas_band": "L5", "frequencies": "two"}
    assert (tilt(ranges, **free) == 0.0).all()
    unknown = np.full(ranges.code_m.shape, np.nan)
    code = np.where(np.arange(10)[:, None] < 5, 0.0, unknown)
    base = BaseDifferences(code_m=code, phase_m=unknown, arc=np.zeros(code.shape, dtype=np.int64), sigma_m=unknown)
    np.testing.assert_array_equal(tilt(copy_with(ranges, base=base)), np.r_[np.ones(5), tilt(ranges)[5:]])


@pytest.mark.requirement("B4")
def test_exclusions_in_the_middle_of_a_chunk_are_those_of_their_epochs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise scale, place and level of the epochs with a fault, as in a chunk that begins with them."""
    change, original, scales = with_fault(80.0), fault_exclusion.exclude, []
    change[:20] = 0.0

    def spied(model: Any, *, limits: Any, scale: np.ndarray) -> Any:
        scales.append(scale)
        return original(model, limits=limits, scale=scale)

    monkeypatch.setattr(fault_exclusion, "exclude", spied)
    observations, config = with_code(front(), change), parse_config({"filter": "off", **BASE})
    processor = EpochProcessor(config, {"front": clean_trajectories()["front"]}, navigation=clean_navigation())
    whole = processor.process({"front": observations})[0].antennas["front"]
    assert (whole.raim.outcome == Outcome.PASSED).tolist() == [True] * 20 + [False] * 20
    _, state = processor.process({"front": observations[:20]})
    part = processor.process({"front": observations[20:]}, state)[0].antennas["front"]
    of_whole, of_part = (scale for scale in scales if len(scale) == 20)  # others are second attempts
    assert len(set(of_whole.tolist())) > 10
    np.testing.assert_allclose(of_whole, of_part, rtol=1e-12)
    for found, expected in (
        (whole.along_sigma_m, part.along_sigma_m), (whole.chainage_m, part.chainage_m),
        (whole.protection.level.level_m, part.protection.level.level_m),
    ):  # fmt: skip
        np.testing.assert_allclose(found[20:], expected, rtol=1e-9)


@pytest.mark.requirement("A4")
def test_far_from_the_line_the_approximate_position_is_the_point_and_its_arc_the_nearest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A map of another region, 300 km away: the arc length is that of the nearest point of the line."""
    trajectory = clean_trajectories()["front"]
    middle = trajectory.ecef_m[len(trajectory.ecef_m) // 2]
    along = trajectory.ecef_m - middle
    far = replace(trajectory, ecef_m=middle + 3e5 * np.array([0.0, 0.6, 0.8]) + along)
    processor = EpochProcessor(parse_config(BASE), {"front": far}, navigation=clean_navigation())
    notes: list[ApproximatePosition] = []
    original = range_stage.approximate_position
    monkeypatch.setattr(
        range_stage, "approximate_position", lambda *a, **b: notes.append(original(*a, **b)) or notes[-1]
    )
    ranges = processor.screen({"front": front()})[0].corrected
    nearest, _ = far.nearest(ranges.near_ecef_m)
    assert (np.linalg.norm(ranges.near_ecef_m - far.at_arc(nearest), axis=1) > 2e5).all()
    np.testing.assert_allclose(notes[0].arc_m, nearest, atol=1e-6)
    assert (nearest > 100.0).all()
