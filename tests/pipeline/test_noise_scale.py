"""What the noise scale and the clock offsets learn from: agreeing ranges, with forgetting (requirements B4, C3)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import raim_cases
import raim_oracle
from pipeline_cases import clean_trajectories, demo_observations, with_code
from railfix.core.geodesy import range_with_rotation
from railfix.core.reasons import Status
from railfix.core.timescale import timedelta
from railfix.io.rinex import read_navigation
from railfix.pipeline.config import parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.result_tables import antenna_positions
from railfix.pipeline.results import AntennaResult
from railfix.positioning.igg3_fit import robust_fit
from railfix.positioning.noise_windows import Windows
from railfix.positioning.range_arrays import Ranges
from railfix.positioning.receiver_noise import NoiseScaleLimits, epoch_variance, noise_scale
from railfix.simulate.demonstration import demo_files


def with_fault(satellite: str, size_m: float, *, since: int = 0) -> AntennaResult:
    """The front antenna of the demonstration, one satellite too long by a constant from an epoch on."""
    observations = demo_observations()["front"]
    change = np.zeros(observations.code_m.shape)
    change[since:, observations.satellite == satellite] = size_m
    lines = {"front": clean_trajectories()["front"]}
    processor = EpochProcessor(parse_config({"filter": "off"}), lines, navigation=read_navigation(demo_files()["nav"]))
    return processor.process({"front": with_code(observations, change)})[0].antennas["front"]


@pytest.fixture(scope="module")
def clean() -> AntennaResult:
    return with_fault("G06", 0.0)


@pytest.mark.requirement("B4")
@pytest.mark.parametrize(("satellite", "size_m"), [("G06", 10.0), ("G06", 20.0), ("G06", 100.0), ("E05", 20.0)])
@pytest.mark.every(3)
def test_a_fault_from_the_first_epoch_on_teaches_nothing(clean: AntennaResult, satellite: str, size_m: float) -> None:
    found = with_fault(satellite, size_m)
    ok = (found.status == Status.OK) & (clean.status == Status.OK)
    assert np.median(np.abs(found.chainage_m - clean.chainage_m)[ok]) < 1.0
    assert found.noise_scale[-1] == pytest.approx(clean.noise_scale[-1], rel=0.15)
    known = found.ties.sigma_m[-1] < 100.0
    assert np.abs(found.ties.offset_m[-1] - clean.ties.offset_m[-1])[known].max() < 1.0
    assert (found.protection.status == 0).mean() > 0.8


def test_sums_decay_as_one_by_one() -> None:
    """The recursion by hand, over uneven steps, several spans and a gap."""
    generator = np.random.default_rng(3)
    step = generator.uniform(0.1, 400.0, 300)
    time = np.datetime64("2024-03-05T00:00:00", "ns") + timedelta(np.cumsum(step))
    values = generator.normal(size=(300, 2))
    limits = {"window_s": 100.0, "least_epochs": 4.0}
    nothing = np.datetime64("NaT", "ns")
    whole = Windows.of(time, (slice(None),), [(nothing, 0.0)], **limits)
    before, after = whole.sums(values, np.zeros((1, 2)))
    total = np.zeros(2)
    for t in range(300):
        if t:
            total = total * np.exp(-min(step[t] / 100.0, 0.25))
        assert before[t] == pytest.approx(total, abs=1e-9)
        total = total + values[t]
    begun = Windows.of(time[:150], (slice(None),), [(nothing, 0.0)], **limits)
    half = begun.sums(values[:150], np.zeros((1, 2)))
    gone_on = Windows.of(time[150:], (slice(None),), begun.last, **limits)
    rest = gone_on.sums(values[150:], half[1])
    assert gone_on.last == whole.last
    assert np.array_equal(np.concatenate([half[0], rest[0]]), before)
    assert np.array_equal(rest[1], after)


def test_the_robust_fit_finds_one_and_two_outliers() -> None:
    """Twelve satellites of one clock around the zenith, noise of half their sigma."""
    generator = np.random.default_rng(8)
    epochs, channels = 200, 12
    place = np.broadcast_to([6.37e6, 0.0, 0.0], (epochs, 3))
    elevation, azimuth = generator.uniform(0.2, 1.5, channels), np.linspace(0.0, 2.0 * np.pi, channels, endpoint=False)
    level = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1) * np.cos(elevation)[:, None]
    unit = np.concatenate([np.sin(elevation)[:, None], level], axis=1)
    satellites = np.broadcast_to(place[0] + 2.2e7 * unit, (epochs, channels, 3))
    plain = Ranges(
        sat_ecef_m=satellites,
        code_m=np.zeros((epochs, channels)),
        weight=np.full((epochs, channels), 0.25),
        groups=(slice(0, channels),),
    )
    distance, _ = range_with_rotation(satellites, place[:, None, :])
    noise = generator.normal(size=(epochs, channels))
    clean_fit = robust_fit(replace(plain, code_m=distance + noise), place)
    assert np.mean(clean_fit.kept) > 0.97
    assert np.nanmean(clean_fit.variance) == pytest.approx(0.25, rel=0.15)
    faulty = noise.copy()
    faulty[:, 3] += 30.0
    faulty[:, 7] -= 20.0
    found = robust_fit(replace(plain, code_m=distance + faulty), place)
    assert not found.kept[:, [3, 7]].any()
    assert np.nanmean(found.variance) == pytest.approx(0.25, rel=0.2)


def test_the_variance_of_an_epoch_lies_between_window_and_residuals() -> None:
    limits = NoiseScaleLimits(spread=4.0)
    scale, wsse, redundancy = np.array([1.0, 1.0, 0.5]), np.array([40.0, np.nan, 1.0]), np.array([10, 3, 4])
    found = epoch_variance(scale, wsse, redundancy, limits=limits)
    assert found == pytest.approx([(4.0 + 40.0) / 14.0, 1.0, (1.0 + 1.0) / 8.0])


@pytest.mark.requirement("B4")
def test_the_statistic_of_raim_is_recomputed_from_the_tables_by_its_scale() -> None:
    found = with_fault("G05", 0.0)
    table = antenna_positions("front", found)
    kept = (table["raim_outcome"] == "passed").to_numpy()
    statistic = table["raim_statistic"].to_numpy() * table["raim_scale"].to_numpy() ** 2
    assert kept.sum() > 100
    np.testing.assert_allclose(statistic[kept], found.fix.constrained.wsse[kept], rtol=1e-5)


@pytest.mark.requirement("C3")
@pytest.mark.parametrize("true_scale", [0.6, 1.0, 2.5])
def test_the_scale_of_a_window_lies_within_a_bootstrap_of_its_epochs(true_scale: float) -> None:
    """Each epoch solved by dense least squares; epochs drawn again a thousand times give the interval."""
    epochs, rng = 400, np.random.default_rng(11)
    arc = rng.uniform(100.0, 1900.0, epochs)
    ranges = raim_cases.made(arc, "GGGGGEEEE", seed=5, noise=true_scale)
    cases = [raim_oracle.problem_on_line(ranges, t, arc[t], raim_cases.LINE) for t in range(epochs)]
    wsse = np.array([case.statistic((), "chi_square", 1.0) for case in cases])
    freedom = np.array([case.freedom for case in cases])
    drawn = rng.integers(0, epochs, (1000, epochs))
    low, high = np.quantile(np.sqrt(wsse[drawn].sum(axis=1) / freedom[drawn].sum(axis=1)), [0.0005, 0.9995])

    solved, _ = raim_cases.solved(ranges, arc)
    time = np.datetime64("2024-03-05T00:00:00", "ns") + timedelta(np.arange(epochs))
    windows = Windows.of(time, (slice(None),), [(np.datetime64("NaT", "ns"), 0.0)], window_s=1e6, least_epochs=4.0)
    scale, _ = noise_scale(
        windows, solved.wsse, freedom, np.ones(epochs, dtype=bool), np.ones(epochs), np.zeros((1, 2)),
        limits=NoiseScaleLimits(window_s=1e6, prior=1e-9),
    )  # fmt: skip
    assert low < scale[-1] < high
    assert low < true_scale < high
    assert high - low < 0.15 * true_scale
