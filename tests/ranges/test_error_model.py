"""Bins, pooling, overbounds and the file of the error model."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from railfix.cli.evaluate import priors_text
from railfix.cli.options import Choices, resolve_settings
from railfix.core.errors import InputFileError, SettingsError
from railfix.ranges.error_conditions import Conditions, condition_differences
from railfix.ranges.error_model import (
    POOLED,
    BinStatistics,
    ErrorBins,
    ErrorModel,
    ErrorModelSource,
    read_error_model,
    write_error_model,
)
from railfix.ranges.error_model_fit import (
    ErrorModelFit,
    ErrorSamples,
    fault_rate,
    faulty_stretches,
    fit_bins,
    gaussian_overbound,
    summary,
)

pytestmark = pytest.mark.requirement("C3")


def samples_of(error: np.ndarray, elevation: float, azimuth: float, cn0: float, *, block: int = 0) -> ErrorSamples:
    n = len(error)
    return ErrorSamples(
        error_m=error,
        elevation_deg=np.full(n, elevation),
        relative_azimuth_deg=np.full(n, azimuth),
        cn0_dbhz=np.full(n, cn0),
        block=block + np.arange(n) // 10,
        used=np.ones(n, dtype=bool),
        sigma_m=np.full(n, 2.0),
        chainage_m=np.full(n, np.nan),
    )


def joined(*parts: ErrorSamples) -> ErrorSamples:
    return ErrorSamples(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(ErrorSamples)})


def test_the_bound_of_a_normal_sample_is_the_sample_s_own_distribution() -> None:
    error = np.random.default_rng(1).normal(0.5, 2.0, 200_000)
    bias_m, sigma_m = gaussian_overbound(error)
    assert bias_m == pytest.approx(0.5, abs=0.2)
    assert 2.0 <= sigma_m < 2.25


@pytest.mark.parametrize("seed", range(4))
def test_no_quantile_of_the_sample_lies_beyond_the_bound(seed: int) -> None:
    rng = np.random.default_rng(seed)
    error = np.where(rng.random(5000) < 0.1, rng.exponential(15.0, 5000), rng.normal(0.3, 1.5, 5000))
    bias_m, sigma_m = gaussian_overbound(error)
    for probability in np.linspace(0.5, 1.0 - 1.0 / 5001, 500):
        score = norm.ppf(probability)
        upper = np.quantile(error, probability, method="weibull")
        lower = np.quantile(error, 1.0 - probability, method="weibull")
        assert upper <= bias_m + sigma_m * score + 1e-9
        assert -lower <= bias_m + sigma_m * score + 1e-9


def test_the_bound_is_no_wider_than_its_worst_sample_asks_for() -> None:
    error = np.array([-1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 9.0])
    score = norm.ppf(0.9)
    bias_m, sigma_m = gaussian_overbound(error)
    assert sigma_m == pytest.approx(9.0 / score)
    assert bias_m == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("error", [np.array([1.0, 2.0]), np.array([1.0, np.nan, 2.0])])
def test_a_bound_needs_finite_samples(error: np.ndarray) -> None:
    with pytest.raises(ValueError, match="at least three samples"):
        gaussian_overbound(error)


def test_bins_by_hand() -> None:
    bins = ErrorBins(elevation_deg=(0.0, 30.0, 90.0), sectors=4, cn0_dbhz=(0.0, 40.0, 60.0))
    cases = [
        (10.0, 0.0, 35.0, (0, 0, 0)),
        (10.0, 350.0, 35.0, (0, 0, 0)),
        (10.0, 44.9, 45.0, (0, 0, 1)),
        (30.0, 45.1, 45.0, (1, 1, 1)),
        (89.0, 180.0, 99.0, (1, 2, 1)),
        (5.0, -90.0, np.nan, (0, 3, 0)),
    ]
    for elevation, azimuth, cn0, where in cases:
        assert bins.index(elevation, azimuth, cn0) == np.ravel_multi_index(where, bins.shape)
    assert bins.index(np.nan, 0.0, 40.0) == -1


@pytest.mark.parametrize("edges", [(0.0,), (0.0, 30.0, 30.0), (30.0, 0.0), (-1.0, 90.0), (0.0, 91.0)])
def test_edges_of_bins_rise_within_the_sky(edges: tuple[float, ...]) -> None:
    with pytest.raises(SettingsError, match="elevation_deg"):
        ErrorBins(elevation_deg=edges)
    assert ErrorBins(elevation_deg=(0.0, 90.0), sectors=1).shape == (1, 1, 5)


def test_thin_bins_take_the_next_wider_set() -> None:
    rng = np.random.default_rng(3)
    bins = ErrorBins(elevation_deg=(0.0, 30.0, 90.0), sectors=2, cn0_dbhz=(0.0, 40.0, 60.0))
    fit = ErrorModelFit(bins=bins, least_blocks=20)
    plenty = samples_of(rng.normal(0.0, 1.0, 1000), 10.0, 0.0, 45.0)
    thin = samples_of(rng.normal(0.0, 5.0, 50), 10.0, 180.0, 45.0, block=1000)
    samples = joined(plenty, thin)
    found = fit_bins(samples, samples.used, fit)
    assert found.count[0, 0, 1] == 1000
    assert found.blocks[0, 0, 1] == 100
    assert found.count[0, 1, 1] == 50
    assert POOLED[found.pooled[0, 0, 1]] == "own"
    assert found.sigma_m[0, 0, 1] == pytest.approx(np.std(plenty.error_m, ddof=1))
    assert POOLED[found.pooled[0, 1, 1]] == "all azimuths"
    assert found.sigma_m[0, 1, 1] == pytest.approx(np.std(samples.error_m, ddof=1))
    assert POOLED[found.pooled[0, 1, 0]] == "all azimuths and C/N0"
    assert POOLED[found.pooled[1, 0, 1]] == "all azimuths and elevations"
    assert POOLED[found.pooled[1, 0, 0]] == "all"


def test_samples_that_are_not_asked_for_do_not_count() -> None:
    samples = samples_of(np.random.default_rng(5).normal(size=100), 10.0, 0.0, 45.0)
    found = fit_bins(samples, np.zeros(100, dtype=bool), ErrorModelFit())
    assert found.count.sum() == 0
    assert np.isnan(found.bound_sigma_m).all()


def made_model() -> ErrorModel:
    rng = np.random.default_rng(9)
    n = 20_000
    samples = ErrorSamples(
        error_m=rng.normal(0.2, 2.0, n),
        elevation_deg=rng.uniform(0, 90, n),
        relative_azimuth_deg=rng.uniform(0, 360, n),
        cn0_dbhz=rng.uniform(20, 55, n),
        block=np.arange(n) // 5,
        used=rng.random(n) < 0.7,
        sigma_m=np.full(n, 2.0),
        chainage_m=np.full(n, np.nan),
    )
    fit = ErrorModelFit()
    return ErrorModel(
        bins=fit.bins,
        before=fit_bins(samples, np.ones(n, dtype=bool), fit),
        after=fit_bins(samples, samples.used, fit),
        covers="local",
        conditions=CONDITIONS,
        source=ErrorModelSource(runs=('a "run"',), base="3034", epochs=7, files=(("x.obs", "00ff"),)),
    )


def test_the_file_gives_the_model_back(tmp_path: Path) -> None:
    model = made_model()
    write_error_model(model, tmp_path / "model.toml")
    again = read_error_model(tmp_path / "model.toml")
    assert again.bins == model.bins
    assert again.covers == model.covers
    assert (again.source, again.conditions) == (model.source, CONDITIONS)
    for part in ("before", "after"):
        for item in fields(BinStatistics):
            np.testing.assert_allclose(
                getattr(getattr(again, part), item.name), getattr(getattr(model, part), item.name), atol=5e-4
            )
    sigma, bias = model.at([10.0, np.nan], [0.0, 0.0], [42.0, 42.0])
    assert sigma[0] == model.after.bound_sigma_m[0, 0, 3]
    assert bias[0] == model.after.bound_bias_m[0, 0, 3]
    assert np.isnan(sigma[1])


def test_what_no_bin_knows_is_nan() -> None:
    model = made_model()
    empty = replace(model.after, bound_sigma_m=np.full(model.bins.shape, np.nan))
    assert np.isnan(replace(model, after=empty).at(10.0, 0.0, 42.0)[0])


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "railfix error model 2",
            "something else",
            "is not an error model: format = 'railfix error model 2' was expected",
        ),
        ("railfix error model 2", "railfix error model 1", "of format 'railfix error model 1', .* make it again"),
        ('covers = "local"', 'covers = "all"', "entry covers: Input should be 'local' or"),
        ("sectors = 4", "sectors = 3", "entry before.count: 75 values were expected, one per bin, got 100"),
        ("sectors = 4", "sectors = 0", "entry bins.sectors: Input should be greater"),
        ("15.0,", "95.0,", "entry bins.elevation_deg"),
        ("[before]", "[early]", "unknown entry early; known are after, before"),
        ("[before]\ncount = [", "[before]\nnumber = [", "unknown entry before.number; known are bias_m"),
        ("[before]\ncount = [\n    ", "[before]\ncount = [\n    -", "entry before.count.0: Input should be greater"),
        ("sigma_m = [\n    ", "sigma_m = [\n    -1.0,\n    ", "entry before.sigma_m"),
        ('codes = "raw"', 'codes = "cooked"', "entry conditions.codes: Input should be 'raw' or 'smoothed'"),
    ],
)
def test_a_broken_file_is_refused_with_the_place(tmp_path: Path, old: str, new: str, said: str) -> None:
    path = tmp_path / "model.toml"
    write_error_model(made_model(), path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputFileError, match=said):
        read_error_model(path)


def test_a_negative_bound_is_rejected(tmp_path: Path) -> None:
    model = made_model()
    bad = replace(model, after=replace(model.after, bound_sigma_m=-model.after.bound_sigma_m))
    write_error_model(bad, tmp_path / "model.toml")
    with pytest.raises(InputFileError, match=r"after\.bound_sigma_m: must not be negative, got -"):
        read_error_model(tmp_path / "model.toml")


CONDITIONS = Conditions(
    systems=("G", "E"),
    signals={"G": ("1C",), "E": ("1C", "1X")},
    screens=("elevation", "doppler"),
    elevation_mask_deg=15.0,
    codes="raw",
    ionosphere="klobuchar",
    troposphere="saastamoinen",
)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, ()),
        ({"systems": ("E", "G"), "screens": ("doppler", "elevation")}, ()),
        ({"systems": ("G",)}, ("systems: model G E, run G",)),
        ({"signals": {"G": ("1C",), "E": ("1X", "1C")}}, ("signals: model E:1C/1X G:1C, run E:1X/1C G:1C",)),
        ({"screens": ()}, ("screens: model elevation doppler, run none",)),
        ({"elevation_mask_deg": 10.0}, ("elevation mask: model 15 deg, run 10 deg",)),
        ({"codes": "smoothed"}, ("codes: model raw, run smoothed",)),
        (
            {"ionosphere": "sbas", "troposphere": "sbas"},
            ("ionosphere: model klobuchar, run sbas", "troposphere: model saastamoinen, run sbas"),
        ),
    ],
)
def test_conditions_are_compared_field_by_field(changes: dict[str, object], expected: tuple[str, ...]) -> None:
    assert condition_differences(CONDITIONS, CONDITIONS.replaced(**changes)) == expected


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match=r"no\.toml"):
        read_error_model(tmp_path / "no.toml")


def test_the_summary_pools_mean_and_variance_over_the_bins() -> None:
    """30 samples of +1 +- 2 m and 10 of -3 +- 1 m: mean 0, variance 0.75 (4 + 1) + 0.25 (1 + 9) = 6.25."""
    bins = ErrorBins(elevation_deg=(0.0, 45.0, 90.0), sectors=1, cn0_dbhz=(0.0, 60.0))

    def column(low: float, high: float) -> np.ndarray:
        return np.array([low, high]).reshape(bins.shape)

    counts = column(30, 10).astype(np.int64)
    statistics = BinStatistics(
        count=counts, blocks=counts, bias_m=column(1.0, -3.0), sigma_m=column(2.0, 1.0),
        bound_bias_m=column(0.0, 0.0), bound_sigma_m=column(4.0, 2.5), pooled=counts * 0,
    )  # fmt: skip
    empty = replace(statistics, count=counts * 0)
    model = ErrorModel(bins=bins, before=statistics, after=empty, covers="local")
    rows = {name: tuple(cells) for name, *cells in summary(model)}
    assert rows["C/N0 0-60"] == ("40", "+0.00", "2.50", "2.5-4.0", "0", "-", "-", "-")
    assert rows["elevation 45-90"][:4] == ("10", "-3.00", "1.00", "2.5-2.5")
    assert "all round" in rows


def test_stretches_with_more_faults_than_the_line_are_marked() -> None:
    """Each hundredth block is faulty by chance; in 400 to 600 m half of them, and at 900 m one of few."""
    rng = np.random.default_rng(3)
    n = 20_000
    chainage = rng.uniform(0.0, 2000.0, n)
    bad = rng.random(n) < np.where((chainage >= 400.0) & (chainage < 600.0), 0.5, 0.01)
    samples = replace(samples_of(np.where(bad, 30.0, 1.0), 30.0, 10.0, 40.0), block=np.arange(n), chainage_m=chainage)
    assert faulty_stretches(samples) == ((400.0, 600.0),)
    assert faulty_stretches(replace(samples, used=~bad)) == ()
    assert faulty_stretches(replace(samples, chainage_m=np.full(n, np.nan))) == ()
    # The same errors in one block of time are one fault.
    assert faulty_stretches(replace(samples, block=np.zeros(n, dtype=np.int64))) == ()
    few = replace(samples_of(np.full(3, 30.0), 30.0, 10.0, 40.0), chainage_m=np.full(3, 2950.0))
    assert faulty_stretches(joined(samples, few)) == ((400.0, 600.0),)


def test_the_rate_of_faults_is_counted_by_blocks() -> None:
    """1000 blocks of ten ranges, two satellites a block of time; 12 blocks with one range beyond 5 sigma."""
    n = 10_000
    error = np.zeros(n)
    error[np.arange(12) * 200 + 3] = 11.0
    block = (np.arange(n) // 20) * 1_000_000 + (np.arange(n) // 10) % 2
    samples = replace(samples_of(error, 45.0, 0.0, 45.0), block=block)
    rate = fault_rate(samples)
    assert (rate.ranges, rate.faulty, rate.blocks, rate.faulty_blocks) == (n, 12, 1000, 12)
    assert rate.prior == pytest.approx(1.2e-3)
    # Clopper and Pearson: 12 of 1000 blocks, at most 0.0193 with 95 % confidence; a tenth of their ranges is faulty.
    assert rate.upper == pytest.approx(1.93e-3, rel=0.02)
    assert rate.together == 0.0
    none = fault_rate(replace(samples, error_m=np.zeros(n)))
    assert none.upper == pytest.approx(3.0 / 1000, rel=0.01)  # the rule of three


def test_two_at_a_time_are_counted_against_independence() -> None:
    n = 2000
    block = (np.arange(n) // 2) * 1_000_000 + np.arange(n) % 2
    error = np.zeros(n)
    error[:40] = 50.0  # twenty times both satellites
    rate = fault_rate(replace(samples_of(error, 45.0, 0.0, 45.0), block=block))
    assert rate.together == pytest.approx(20.0 / (1000 * 0.02**2), rel=1e-9)


def test_low_satellites_of_one_side_are_counted_together() -> None:
    """Four satellites a block of time, two on either side; of each pair of faults the place decides what it counts."""
    blocks, each = 1000, 4
    n = blocks * each
    of, satellite = np.arange(n) // each, np.arange(n) % each
    azimuth = np.array([60.0, 120.0, 240.0, 300.0])[satellite]
    error = np.zeros(n)
    for first, pair in ((0, (0, 1)), (10, (2, 3)), (20, (0, 2)), (30, (1,))):
        error[(of >= first) & (of < first + 5) & np.isin(satellite, pair)] = 50.0
    samples = replace(
        samples_of(error, 30.0, 0.0, 45.0), block=of * 1_000_000 + satellite, relative_azimuth_deg=azimuth
    )
    rate = fault_rate(samples)
    # Five blocks on the right, five on the left; faults of either side or of one satellite do not count.
    assert (rate.side_blocks, rate.side_faulty_blocks) == (2 * blocks, 10)
    assert rate.side_upper == pytest.approx(0.00846, rel=0.01)  # Clopper and Pearson: 10 of 2000
    high = fault_rate(replace(samples, elevation_deg=np.full(n, 45.0)))
    assert (high.side_blocks, high.side_faulty_blocks, high.side_upper) == (0, 0, 1.0)
    unused = fault_rate(replace(samples, used=satellite != 0))
    assert (unused.side_blocks, unused.side_faulty_blocks) == (blocks, 5)


def test_measured_priors_are_those_of_a_run_with_the_model(tmp_path: Path) -> None:
    samples = samples_of(np.zeros(4000), 30.0, 0.0, 45.0)
    rate = fault_rate(replace(samples, block=np.arange(4000) // 4 * 1_000_000 + np.arange(4000) % 4))
    rate = rate.replaced(no_level_m=((100.0, 200.0),))
    model, fitted = tmp_path / "line.toml", fit_bins(samples, np.ones(4000, dtype=bool), ErrorModelFit())
    write_error_model(ErrorModel(bins=ErrorBins(), before=fitted, after=fitted, covers="local", faults=rate), model)
    assert f"and risk.side_prior = {rate.side_upper:.2g}, unless" in priors_text(rate)
    config, _ = resolve_settings(Choices(error_model=model))
    assert (config.risk.priors, config.risk.local_prior) == ("measured", rate.upper)
    assert (config.risk.side_prior, config.no_level_m) == (rate.side_upper, rate.no_level_m)
    own, _ = resolve_settings(Choices(error_model=model, setting=("risk.local_prior=2e-5",)))
    assert (own.risk.priors, own.risk.local_prior, own.no_level_m) == ("assumed", 2e-5, ())
    short = fault_rate(samples_of(np.zeros(4000), 60.0, 0.0, 45.0))
    assert short.side_upper == 1.0
    assert "are only indicative" in priors_text(short)
