"""Change of the pseudorange against the Doppler: truth tables, clocks, chunks, recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import ROOT
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.errors import SettingsError
from railfix.core.timescale import timedelta
from railfix.gnss.observations import Observations, carrier_frequency_hz
from railfix.io import read_observations
from railfix.screens import DopplerLimits, DopplerScreened, DopplerState, doppler_limit_m, doppler_screen
from railfix.screens.doppler import DopplerChannels

pytestmark = pytest.mark.requirement("B2")

START = np.datetime64("2021-01-01T00:00:00", "ns")
SATELLITES = np.array(["G01", "G02", "G03", "J01", "J02"])
SIGNALS = np.array(["1C"] * 5)
L1 = 1_575.42e6


def scene(
    epochs: int, *, interval_s: float = 0.1, seed: int = 3, noise_m: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tags, codes and Dopplers of satellites of constant range acceleration."""
    rng = np.random.default_rng(seed)
    t = np.arange(epochs)[:, None] * interval_s
    rate, acceleration = rng.uniform(-800, 800, 5), rng.uniform(-0.2, 0.2, 5)
    code = 2.2e7 + rate * t + acceleration * t**2 / 2 + noise_m * rng.standard_normal((epochs, 5))
    doppler = -(rate + acceleration * t) * L1 / SPEED_OF_LIGHT
    return START + timedelta(t[:, 0]), code, doppler


def screened(
    time: np.ndarray,
    code: np.ndarray,
    doppler: np.ndarray,
    *,
    limits: DopplerLimits | None = None,
    state: DopplerState | None = None,
    satellite: np.ndarray = SATELLITES,
    **more: object,
) -> tuple[DopplerScreened, DopplerState]:
    for array in (time, code, doppler):
        array.flags.writeable = False
    return doppler_screen(
        time, code, doppler, limits=limits or DopplerLimits(mode="fixed"), state=state, **more,
        channels=DopplerChannels(satellite, np.array(["1C"] * len(satellite)), np.full(len(satellite), L1)),
    )  # fmt: skip


#: Error added to the code of the first satellite at 0.1 s epochs, hold 0.3 s; what is refused ("x"). Limit 1.5 m.
TRUTH_TABLE = {
    "nothing": ([0, 0, 0, 0, 0, 0, 0, 0], "........"),
    "below the limit": ([0, 0, 1.4, 1.4, 0, 0, 0, 0], "........"),
    "one epoch": ([0, 0, 9, 0, 0, 0, 0, 0], "..x....."),
    "passing reflection": ([0, 0, 9, 9, 9, 0, 0, 0], "..xxx..."),
    "back to within the limit": ([0, 0, 9, 9, 1.0, 1.0, 1.0, 1.0], "..xx...."),
    "stays: taken as good after the hold": ([0, 0, 9, 9, 9, 9, 9, 9], "..xxxx.."),
    "back after the hold": ([0, 0, 9, 9, 9, 9, 9, 0], "..xxxx.x"),
    "grows in two jumps": ([0, 0, 9, 18, 0, 0, 0, 0], "..xx...."),
    "second jump restarts nothing": ([0, 0, 9, 9, 18, 18, 18, 18], "..xxxx.."),
    "there from the start: the good epochs pay": ([9, 9, 9, 0, 0, 0, 0, 0], "...xxxx."),
    "ramp below the limit each epoch is not seen": ([0, 1, 2, 3, 4, 5, 6, 7], "........"),
    "both signs": ([0, -9, 0, 9, 0, 0, 0, 0], ".x.x...."),
    "lost while suspected": ([0, 0, 9, np.nan, 9, 9, 9, 9], "..x....."),
    "lost, back with an error: cannot be judged": ([0, 0, np.nan, 9, 9, 0, 0, 0], ".....xxx"),
}


@pytest.mark.parametrize(("error", "expected"), TRUTH_TABLE.values(), ids=TRUTH_TABLE.keys())
def test_truth_table(error: list[float], expected: str) -> None:
    time, code, doppler = scene(8)
    code[:, 0] += error
    result, _ = screened(time, code, doppler, limits=DopplerLimits(mode="fixed", hold_s=0.3))
    assert "".join("x" if r else "." for r in result.reject[:, 0]) == expected
    assert not result.reject[:, 1:].any()
    assert not result.reject[np.isnan(result.metric)].any()


def test_exactly_at_the_limit_is_used() -> None:
    # powers of two and a satellite at rest, so that nothing is rounded
    time = START + timedelta(np.arange(4) * 0.125)
    code = np.full((4, 5), 2.0**24)
    code[2, 0] += 1.5
    code[2, 1] += np.nextafter(1.5, 2) - 1.5 + 1.5 + 2.0**-20
    result, _ = screened(time, code, np.zeros((4, 5)))
    assert result.metric[2, 0] == 1.5
    assert not result.reject[:, 0].any()
    assert result.reject[:, 1].tolist() == [False, False, True, False]


def test_without_hold_it_is_the_paper_s_test_to_the_letter() -> None:
    time, code, doppler = scene(8)
    code[3:6, 0] += 9.0
    result, _ = screened(time, code, doppler, limits=DopplerLimits(mode="fixed", hold_s=0.0))
    assert np.flatnonzero(result.reject[:, 0]).tolist() == [3, 6]
    np.testing.assert_array_equal(result.reject, np.abs(result.metric) > 1.5)


def test_the_metric_is_the_formula() -> None:
    time, code, doppler = scene(2)
    code[1] += [4.0, 0.1, 0.0, -0.1, 0.0]
    result, _ = screened(time, code, doppler)
    assert np.isnan(result.metric[0]).all()
    # independent: the median of the added errors is 0.0
    np.testing.assert_allclose(result.metric[1], [4.0, 0.1, 0.0, -0.1, 0.0], atol=1e-6)


@pytest.mark.parametrize("where", ["code", "tag and code", "tag only"])
@pytest.mark.parametrize("step_ms", [-4, -1, 1, 3])
def test_steps_of_the_receiver_clock_trip_nothing(where: str, step_ms: int) -> None:
    """A receiver samples when its own clock says so: tag less true time is in every code."""
    rng = np.random.default_rng(1)
    t = np.arange(30) * 0.1
    rate = rng.uniform(-800, 800, 5)
    clock_s = np.where(np.arange(30) >= 12, step_ms * 1e-3, 0.0) if where != "tag only" else np.zeros(30)
    # code: nominal tags, sampling moves; tag and code: sampling stays, tags move; tag only: both move
    if where == "code":
        tag, true = t, t - clock_s
    elif where == "tag and code":
        tag, true = t + clock_s, t
    else:
        tag = true = t + np.where(np.arange(30) >= 12, step_ms * 1e-3, 0.0)
    code = 2.2e7 + rate * true[:, None] + SPEED_OF_LIGHT * clock_s[:, None]
    doppler = np.broadcast_to(-rate * L1 / SPEED_OF_LIGHT, code.shape).copy()
    result, _ = screened(START + timedelta(tag), code, doppler)
    assert np.nanmax(np.abs(result.metric)) < 1e-4
    assert not result.reject.any()


def test_constellations_have_their_own_median_and_gps_and_qzss_share_one() -> None:
    satellite = np.array(["G01", "G02", "J01", "E01", "E02", "E03", "R01", "R02"])
    time = START + timedelta(np.arange(3) * 0.1)
    code = np.full((3, 8), 2.2e7)
    code[1:, 3:6] += 50.0  # the Galileo clock alone steps
    result, _ = screened(time, code, np.zeros((3, 8)), satellite=satellite)
    np.testing.assert_allclose(result.metric[1:, :6], 0.0, atol=1e-6)
    assert np.isnan(result.metric[:, 6:]).all(), "two satellites make no median"


def test_two_signals_of_a_satellite_are_one_satellite() -> None:
    satellite = np.array(["G01", "G01", "G02"])
    time = START + timedelta(np.arange(3) * 0.1)
    code = np.full((3, 3), 2.2e7)
    result, _ = doppler_screen(
        time, code, np.zeros((3, 3)),
        channels=DopplerChannels(satellite, np.array(["1C", "5Q", "1C"]), np.full(3, L1)),
    )  # fmt: skip
    assert np.isnan(result.metric).all()


def test_what_it_cannot_judge_is_nan_and_used() -> None:
    time, code, doppler = scene(8)
    code[1:, 0] += 50.0  # into epoch 1
    gap = time.copy()
    gap[1:] += np.timedelta64(3, "s")
    result, _ = screened(gap, code, doppler)
    assert np.isnan(result.metric[1]).all()
    broken = np.array([False, True, *[False] * 6])
    result, _ = screened(time, code, doppler, break_before=broken)
    assert np.isnan(result.metric[1]).all()
    assert not result.reject.any()
    lost = doppler.copy()
    lost[1, 2] = np.nan
    result, _ = screened(time, code, lost)
    assert np.isnan(result.metric[1:3, 2]).all()
    assert not np.isnan(result.metric[3, 2])
    frequency = np.array([L1, np.nan, L1, L1, L1])
    result, _ = doppler_screen(time, code, doppler, channels=DopplerChannels(SATELLITES, SIGNALS, frequency))
    assert np.isnan(result.metric[:, 1]).all()


def test_limit_over_the_interval() -> None:
    np.testing.assert_allclose(doppler_limit_m([0.05, 0.1, 0.2]), 1.5)
    # sqrt((1 - e^-1) / (1 - e^-0.2)) = 1.8674, jerk 1 m/s^3 / 12
    assert doppler_limit_m(1.0) == pytest.approx(1.5 * 1.8674 + 1 / 12, abs=1e-3)
    assert (np.diff(doppler_limit_m(np.linspace(0.2, 3.0, 50))) > 0).all()
    assert np.isnan(doppler_limit_m(np.nan))


def test_mode_sigma() -> None:
    time, code, doppler = scene(4, interval_s=1.0)
    code[2:, 0] += 20.0
    code[2:, 1] += 20.0
    sigma = np.full(code.shape, 1.0)
    sigma[:, 1] = 10.0
    sigma[:, 2] = np.nan
    limits = DopplerLimits(mode="sigma", factor=4.0, doppler_sigma_mps=0.0, jerk_mps3=0.0)
    result, _ = screened(time, code, doppler, limits=limits, code_sigma_m=sigma)
    # 4 sqrt(2 (1 - e^-1)) = 4.498
    np.testing.assert_allclose(result.limit[1:, 0], 4.498, atol=1e-3)
    np.testing.assert_allclose(result.limit[1:, 1], 44.98, atol=1e-2)
    assert result.reject[2].tolist() == [True, False, False, False, False]
    assert np.isnan(result.metric[:, 2]).all(), "no sigma, no verdict"
    with pytest.raises(ValueError, match="code_sigma_m"):
        screened(time, code, doppler, limits=limits)


def test_mode_receiver_finds_the_scale_of_the_receiver() -> None:
    rng = np.random.default_rng(5)
    satellite = np.array([f"G{i:02d}" for i in range(1, 13)])
    time = START + timedelta(np.arange(400) * 1.0)
    for noise in (0.05, 3.0):
        code = 2.2e7 + noise * rng.standard_normal((400, 12))
        result, _ = screened(
            time, code, np.zeros(code.shape), satellite=satellite,
            limits=DopplerLimits(mode="receiver", prior_epochs=10.0, factor=5.0, jerk_mps3=0.0),
        )  # fmt: skip
        expected = max(float(doppler_limit_m(1.0)) - 1 / 12, 5.0 * np.sqrt(2.0) * noise)
        # the median of twelve, and the mean of logarithms, come out some tenth too small
        assert 0.8 * expected < result.limit[-1, 0] < 1.05 * expected
    fixed, _ = screened(time, code, np.zeros(code.shape), satellite=satellite)
    assert result.reject[100:].mean() < 0.002 < 0.3 < fixed.reject[100:].mean()


def _pieces(limits: DopplerLimits, size: int, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
    state, parts = None, []
    for i in range(0, len(arrays[0]), size):
        time, code, doppler, sigma, broken = (a[i : i + size] for a in arrays)
        # a channel without an observation in the piece is not there, as readers of pieces leave it out
        there = np.isfinite(code).any(axis=0)
        result, state = screened(
            time, code[:, there], doppler[:, there], satellite=SATELLITES[there], limits=limits, state=state,
            code_sigma_m=sigma[:, there], break_before=broken,
        )  # fmt: skip
        whole = [np.full(code.shape, fill) for fill in (np.nan, False, np.nan, np.nan)]
        values = (result.metric, result.reject, result.limit, result.level_m)
        for target, value in zip(whole, values, strict=True):
            target[:, there] = value
        parts.append(whole)
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))


@settings(max_examples=25)
@given(
    seed=st.integers(0, 10_000),
    size=st.sampled_from([1, 2, 7, 13]),
    mode=st.sampled_from(["fixed", "receiver", "sigma"]),
    hold=st.sampled_from([0.0, 0.3, 1.0, 100.0]),
)
def test_any_cutting_gives_the_same_bits(seed: int, size: int, mode: str, hold: float) -> None:
    rng = np.random.default_rng(seed)
    time, code, doppler = scene(60, seed=seed, noise_m=0.4)
    code += np.where(rng.random(code.shape) < 0.1, rng.uniform(-30, 30, code.shape), 0.0).cumsum(axis=0) % 40
    code[rng.random(code.shape) < 0.03] = np.nan
    code[20:35, 2] = np.nan
    time = time + np.cumsum(np.where(rng.random(60) < 0.02, np.timedelta64(4, "s"), np.timedelta64(0, "s")))
    sigma, broken = rng.uniform(0.3, 2.0, code.shape), rng.random(60) < 0.03
    limits = DopplerLimits(mode=mode, hold_s=hold)
    whole = _pieces(limits, 1000, time, code, doppler, sigma, broken)
    for a, b in zip(whole, _pieces(limits, size, time, code, doppler, sigma, broken), strict=True):
        np.testing.assert_array_equal(a, b)


def test_no_epochs_leave_the_state() -> None:
    time, code, doppler = scene(4)
    _, state = screened(time, code, doppler)
    result, after = screened(time[:0], code[:0], doppler[:0], state=state)
    assert result.metric.shape == result.reject.shape == (0, 5)
    assert after is state


@pytest.mark.parametrize(
    "wrong",
    [
        {"step_m": 0.0},
        {"hold_s": -1.0},
        {"least_satellites": 2},
        {"mode": "p1"},
        {"factor": np.nan},
        {"step_m": np.inf},
    ],
)
def test_limits_are_checked(wrong: dict[str, object]) -> None:
    with pytest.raises(SettingsError, match=next(iter(wrong))):
        DopplerLimits(**wrong)  # type: ignore[arg-type]


def rates(log: Observations, limits: DopplerLimits) -> tuple[float, DopplerScreened]:
    """Share of the judged first-band codes that is refused."""
    first = np.flatnonzero(np.isin(log.signal, ("1C", "2I", "1X")) & np.isin(log.system, list("GJEC")))
    result, _ = doppler_screen(
        log.time, log.code_m[:, first], log.doppler_hz[:, first],
        channels=DopplerChannels(
            log.satellite[first], log.signal[first], carrier_frequency_hz(log.satellite[first], log.signal[first])
        ),
        break_before=log.break_before, limits=limits,
    )  # fmt: skip
    return float(result.reject.sum() / np.isfinite(result.metric).sum()), result


#: Log, and the largest share refused: with P1's limit at its interval, and with the receiver's own scale.
RECORDINGS = {
    "dual/mosaic_x2_99cm/rover.obs": (0.002, 0.002),
    "dual/mosaic_x2_99cm/base.obs": (0.002, 0.002),
    "kinematic/japan_mosaic_2021265_with_GEONET3034/3034265G.21O": (0.0, 0.0),
    "sbas/msas_20080526_crescent/cres_20080526.bin.obs": (0.01, 0.005),
    "kinematic/urbannav_tst/20210517.light-urban.tste.ublox.f9p.obs": (0.25, 0.25),
    "kinematic/urbannav_tst/20210517.light-urban.tste.ublox.m8t.GC.obs": (0.35, 0.15),
    "kinematic/gsdc_pixel5_a/Pixel5_a.21o": (0.70, 0.10),
}


@pytest.mark.parametrize("name", RECORDINGS)
def test_recordings(recordings: Path, name: str) -> None:
    log = read_observations(recordings / name)
    fixed, _ = rates(log, DopplerLimits(mode="fixed"))
    letter, _ = rates(log, DopplerLimits(mode="fixed", hold_s=0.0))
    own, result = rates(log, DopplerLimits(mode="receiver", prior_epochs=10.0))
    limit = float(np.nanmedian(result.limit))
    print(f"{name}: fixed {fixed:.4f}, without hold {letter:.4f}, receiver {own:.4f} at {limit:.2f} m")
    assert fixed <= RECORDINGS[name][0]
    assert own <= RECORDINGS[name][1]
    assert letter <= fixed


def test_clock_steps_of_a_real_log_trip_nothing_more_than_its_other_epochs(recordings: Path) -> None:
    log = read_observations(recordings / "kinematic/urbannav_tst/20210517.light-urban.tste.ublox.m8t.GC.obs")
    with np.errstate(invalid="ignore"):
        change = np.diff(log.code_m, axis=0)
    steps = 1 + np.flatnonzero(np.array([np.median(row[np.isfinite(row)]) for row in change]).__abs__() > 1e5)
    assert len(steps) == 2, "two steps of 4 ms, of tag and code alike"
    _, result = rates(log, DopplerLimits(mode="fixed"))
    at_steps = np.abs(result.metric[steps])
    assert np.nanmedian(at_steps) < 2.0 * np.nanmedian(np.abs(result.metric))


def test_the_demonstration_s_white_noise_is_the_receiver_s_scale() -> None:
    """The made log has noise that is white from epoch to epoch: more than P1's receivers, and no multipath."""
    log = read_observations(ROOT / "data" / "demo" / "front.crx.gz")[:1000]
    own, _ = rates(log, DopplerLimits(mode="receiver", prior_epochs=10.0, hold_s=0.0))
    strong = np.nanmedian(log.cn0_dbhz, axis=0) > 47.0
    _, result = rates(log, DopplerLimits(mode="fixed", hold_s=0.0))
    high = float(result.reject[:, strong].sum() / np.isfinite(result.metric[:, strong]).sum())
    print(f"demo: receiver {own:.4f}; fixed, satellites above 47 dB-Hz {high:.4f}")
    assert high < 0.05
    assert own < 0.25
