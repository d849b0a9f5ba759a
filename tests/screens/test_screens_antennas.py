"""Two antennas: pseudoranges against their spacing, positions against it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from pipeline_cases import clean_files, clean_observations, processor
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.errors import SettingsError
from railfix.core.geodesy import ecef_from_geodetic, elevation_azimuth, enu_axes
from railfix.core.timescale import timedelta
from railfix.gnss.observations import Observations, carrier_frequency_hz
from railfix.gnss.orbits import satellite_states
from railfix.io import read_navigation, read_observations
from railfix.screens import (
    AntennaPairLimits,
    AntennaPairScreened,
    AntennaSpacingLimits,
    Screened,
    ambiguity_m,
    antenna_pair_screen,
    antenna_spacing_screen,
    expected_difference_m,
    pair_channels,
    pair_epochs,
    spacing_direction,
)
from railfix.screens.antenna_pair import Spacing, TagDifference
from railfix.screens.antenna_spacing import SCREEN
from railfix.screens.pairs import FilteredMotion, PairedEpochs, on_pairs
from railfix.tracking import TrackStatus

START = np.datetime64("2021-01-01T00:00:00", "ns")
NAN = np.nan


# -- the ambiguity zone -------------------------------------------------------------------------------------


@pytest.mark.requirement("B3")
def test_the_paper_s_ambiguity_zone() -> None:
    """P1 2.3(3): about 1.1 m at 18.2 m spacing from 3 deg of elevation and 3.5 deg of azimuth."""
    elevation, azimuth = np.meshgrid(np.linspace(0, 90, 181), np.linspace(0, 360, 721))
    zone = ambiguity_m(elevation, azimuth, 18.2)
    assert zone.max() == pytest.approx(1.11, abs=0.03)
    # a low satellite abeam: 18.2 sin 3.5 deg
    assert ambiguity_m(0.0, 90.0, 18.2) == pytest.approx(18.2 * np.sin(np.radians(3.5)))
    # straight ahead at the horizon: 18.2 (1 - cos 3 cos 3.5)
    assert ambiguity_m(0.0, 0.0, 18.2) == pytest.approx(18.2 * (1 - np.cos(np.radians(3)) * np.cos(np.radians(3.5))))


@pytest.mark.requirement("B3")
@settings(max_examples=50)
@given(
    elevation=st.floats(0, 87), azimuth=st.floats(0, 360), by_elevation=st.floats(0, 10), by_azimuth=st.floats(0, 10)
)
def test_the_zone_is_the_largest_change_within_the_errors(
    elevation: float, azimuth: float, by_elevation: float, by_azimuth: float
) -> None:
    zone = float(ambiguity_m(elevation, azimuth, 20.0, elevation_error_deg=by_elevation, azimuth_error_deg=by_azimuth))
    e = np.radians(elevation + np.linspace(-by_elevation, by_elevation, 41))[:, None]
    a = np.radians(azimuth + np.linspace(-by_azimuth, by_azimuth, 41))
    direct = np.abs(20 * np.cos(e) * np.cos(a) - 20 * np.cos(e[20]) * np.cos(a[20])).max()
    assert direct <= zone + 1e-9
    assert zone <= direct + 0.01


# -- the expected difference --------------------------------------------------------------------------------


@pytest.mark.requirement("B3")
@settings(max_examples=40)
@given(heading=st.floats(0, 360), gradient=st.floats(-80, 80), spacing=st.floats(0.5, 40), seed=st.integers(0, 1000))
def test_expected_difference_is_that_of_two_ranges(heading: float, gradient: float, spacing: float, seed: int) -> None:
    """The second formula: two antennas, satellites far away, ranges."""
    rng = np.random.default_rng(seed)
    climb, turn = np.arctan(gradient / 1e3), np.radians(heading)
    forward = np.array([np.cos(climb) * np.sin(turn), np.cos(climb) * np.cos(turn), np.sin(climb)])
    axes, middle = enu_axes(35.0, 135.0), ecef_from_geodetic(35.0, 135.0, 50.0)
    front, rear = middle + spacing / 2 * forward @ axes, middle - spacing / 2 * forward @ axes
    direction = rng.standard_normal((6, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    satellites = middle + 2.4e7 * direction
    elevation, azimuth = elevation_azimuth(satellites[None], middle[None])
    h, g, s = spacing_direction(front[None], rear[None])
    assert s[0] == pytest.approx(spacing, abs=1e-6)
    assert g[0] == pytest.approx(gradient, abs=0.01)
    assert (h[0] - heading + 180) % 360 - 180 == pytest.approx(0, abs=1e-3)
    ranges = [np.linalg.norm(satellites - place, axis=1) for place in (front, rear)]
    expected = expected_difference_m(elevation, azimuth, heading_deg=h, gradient_permille=g, spacing_m=s)
    np.testing.assert_allclose(expected[0], ranges[1] - ranges[0], atol=1e-4)


# -- pairs --------------------------------------------------------------------------------------------------


@pytest.mark.requirement("B3")
@pytest.mark.parametrize(
    ("front", "rear", "pairs"),
    [
        ([0, 1, 2], [0, 1, 2], [(0, 0), (1, 1), (2, 2)]),
        ([0, 1, 2], [1, 2, 3], [(1, 0), (2, 1)]),
        ([0, 1, 2], [0.004, 1.01, 2.011], [(0, 0), (1, 1)]),  # exactly at the tolerance is a pair
        ([0, 0.004, 1], [0.003, 1], [(1, 0), (2, 1)]),  # the nearer of two
        ([0], [5], []),
        ([], [0], []),
        ([3], [], []),
        ([0, 1, 2, 3], [2], [(2, 0)]),
    ],
)
def test_pairs_of_epochs(front: list[float], rear: list[float], pairs: list[tuple[int, int]]) -> None:
    times = [START + timedelta(np.array(values, dtype=float)) for values in (front, rear)]
    a, b = pair_epochs(*times, tolerance_s=0.01)
    assert list(zip(a.tolist(), b.tolist(), strict=True)) == pairs
    b, a = pair_epochs(*times[::-1], tolerance_s=0.01)
    assert list(zip(a.tolist(), b.tolist(), strict=True)) == pairs


@pytest.mark.requirement("B3")
def test_pairs_of_channels_and_verdicts_on_both_antennas() -> None:
    front, rear = ["G01 1C", "G01 5Q", "E05 1C", "C20 2I"], ["C20 2I", "G01 1C", "J02 1C"]
    split = [np.array([name.split() for name in names]).T for names in (front, rear)]
    a, b = pair_channels(*split[0], *split[1])
    assert a.tolist() == [0, 3]
    assert b.tolist() == [1, 0]
    verdict = np.array([[True, False], [False, True]])
    screened = Screened(metric=np.where(verdict, 9.0, 1.0), reject=verdict)
    on_front = on_pairs(screened, (3, 4), np.array([0, 2]), a).reject
    on_rear = on_pairs(screened, (2, 3), np.array([0, 1]), b).reject
    assert np.argwhere(on_front).tolist() == [[0, 0], [2, 3]]
    assert np.argwhere(on_rear).tolist() == [[0, 1], [1, 0]]


# -- the screen ---------------------------------------------------------------------------------------------

SATELLITES = np.array(["G01", "G02", "G03", "G04", "E01"])


def two_antennas(
    epochs: int = 6, *, spacing_m: float = 18.2, clock_m: float = 0.0
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Codes of antennas that head north-east on a climb of 20 per mille, and what the screen is told."""
    rng = np.random.default_rng(8)
    elevation = np.broadcast_to([15.0, 30.0, 45.0, 80.0, 25.0], (epochs, 5)).copy()
    azimuth = np.broadcast_to([45.0, 225.0, 135.0, 0.0, 60.0], (epochs, 5)).copy()
    told = {
        "heading_deg": np.full(epochs, 45.0),
        "gradient_permille": np.full(epochs, 20.0),
        "spacing_m": np.full(epochs, spacing_m),
    }
    front = rng.uniform(2e7, 2.5e7, (epochs, 5))
    rear = front + expected_difference_m(elevation, azimuth, **told) + clock_m
    return front, rear, {"elevation_deg": elevation, "azimuth_deg": azimuth, **told}


def paired(front: np.ndarray, rear: np.ndarray, told: dict[str, np.ndarray], **more: object) -> AntennaPairScreened:
    for array in (front, rear, *told.values()):
        array.flags.writeable = False
    sight, spacing = [told[n] for n in ("elevation_deg", "azimuth_deg")], [told[n] for n in Spacing._fields]
    return antenna_pair_screen(front, rear, *sight, satellite=SATELLITES, spacing=Spacing(*spacing), **more)


#: Error of the front code, of the rear code -> refused on both.
TRUTH_TABLE = [
    (0.0, 0.0, False),
    (4.9, 0.0, False),
    (5.1, 0.0, True),
    (0.0, -5.1, True),
    (0.0, 80.0, True),
    (7.0, 7.0, False),  # the same error in both is not seen
    (NAN, 30.0, False),
    (30.0, NAN, False),
]


@pytest.mark.requirement("B3")
@pytest.mark.parametrize(("front_m", "rear_m", "refused"), TRUTH_TABLE)
@pytest.mark.parametrize("clocks", ["common", "median"])
def test_truth_table(front_m: float, rear_m: float, refused: bool, clocks: str) -> None:
    clock = 300.0 if clocks == "median" else 0.0
    front, rear, told = two_antennas(clock_m=clock)
    front[2, 1] += front_m
    rear[2, 1] += rear_m
    satellite_rates = np.zeros(front.shape)
    result = paired(
        front,
        rear,
        told,
        limits=AntennaPairLimits(clocks=clocks, least_satellites=3),
        tags=TagDifference(np.zeros(len(front), "m8[ns]"), satellite_rates),
    )
    expected = np.zeros(front.shape, dtype=bool)
    expected[2, 1] = refused
    np.testing.assert_array_equal(result.reject, expected)
    assert np.isnan(result.metric[2, 1]) == np.isnan(front_m + rear_m)
    if clocks == "median":
        assert np.isnan(result.metric[:, 4]).all(), "one Galileo satellite has no clock to be compared with"
        assert "median" in result.clocks
    else:
        assert np.isfinite(result.metric[:, 4]).all()
        assert "common" in result.clocks


@pytest.mark.requirement("B3")
def test_one_clock_shows_an_error_common_to_all_satellites_of_one_antenna() -> None:
    """P1 2.3(3): an estimated clock takes the common error for its own; separate clocks are not judged as one."""
    front, rear, told = two_antennas()
    rear = rear + 7.0
    for clocks, rejected in (("common", True), ("median", False)):
        result = paired(front, rear, told, limits=AntennaPairLimits(clocks=clocks))
        np.testing.assert_array_equal(result.reject[:, :4], rejected)
    rear = rear + 93.1
    result = paired(front, rear, told, limits=AntennaPairLimits(clocks="common"))
    assert np.isnan(result.metric).all()
    assert np.isnan(result.clock_m).all()
    assert not result.reject.any()


@pytest.mark.requirement("B3")
def test_one_code_far_off_is_rejected_and_does_not_pass_for_separate_clocks() -> None:
    """The mean of the five differences is 120 m, beyond which clocks are separate; their median is 0."""
    front, rear, told = two_antennas()
    rear[:, 1] += 600.0
    result = paired(front, rear, told, limits=AntennaPairLimits(clocks="common"))
    np.testing.assert_array_equal(result.reject, np.broadcast_to(SATELLITES == "G02", front.shape))
    np.testing.assert_array_equal(result.clock_m, 0.0)


@pytest.mark.requirement("B3")
def test_exactly_at_the_limit_is_used() -> None:
    front = np.full((1, 5), 2.0**24)
    rear = front + np.array([5.0, 5.0 + 2.0**-20, -5.0, 0.0, 0.0])
    told = {"elevation_deg": np.full((1, 5), 90.0), "azimuth_deg": np.zeros((1, 5))}
    result = antenna_pair_screen(
        front, rear, satellite=SATELLITES, spacing=Spacing(0.0, 0.0, np.zeros(1)),
        limits=AntennaPairLimits(clocks="common"), **told,
    )  # fmt: skip
    assert result.reject.tolist() == [[False, True, False, False, False]]


@pytest.mark.requirement("B3")
def test_a_limit_below_the_zone_is_the_zone() -> None:
    front, rear, told = two_antennas()
    rear += 0.7
    result = paired(front, rear, told, limits=AntennaPairLimits(limit_m=0.1, clocks="common"))
    np.testing.assert_allclose(result.metric, 0.7, atol=1e-6)
    np.testing.assert_array_equal(result.reject, result.ambiguity_m < 0.7)
    assert 0 < result.reject.sum() < result.reject.size


@pytest.mark.requirement("B3")
def test_instants_of_separate_clocks() -> None:
    """Tags alike, clocks 0.5 ms apart: the satellites moved meanwhile, by up to 0.4 m."""
    rate = np.broadcast_to([-790.0, 610.0, -300.0, 250.0, 5.0], (6, 5)).copy()
    for tag_s, clock_s in ((0.0, 5e-4), (2e-3, 0.0), (-1e-3, -1e-3)):
        front, rear, told = two_antennas(clock_m=SPEED_OF_LIGHT * clock_s)
        rear += rate * (tag_s - clock_s)
        tags = timedelta(np.full(6, tag_s))
        limits = AntennaPairLimits(least_satellites=4)
        result = paired(front, rear, told, limits=limits, tags=TagDifference(tags, rate))
        np.testing.assert_allclose(result.metric[:, :4], 0.0, atol=2e-3)
        np.testing.assert_allclose(result.clock_m[:, 0], SPEED_OF_LIGHT * clock_s, atol=2e-3)


@pytest.mark.requirement("B3")
@settings(max_examples=20)
@given(seed=st.integers(0, 1000))
def test_order_and_cutting_do_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    front, rear, told = two_antennas(clock_m=1e5)
    rear += rng.normal(0, 4, rear.shape)
    rear[rng.random(rear.shape) < 0.1] = np.nan
    limits = AntennaPairLimits(least_satellites=3)
    whole = paired(front, rear, told, limits=limits)
    single = [paired(front[[i]], rear[[i]], {k: v[[i]] for k, v in told.items()}, limits=limits) for i in range(6)]
    np.testing.assert_array_equal(whole.metric, np.concatenate([r.metric for r in single]))
    order = rng.permutation(5)
    other = antenna_pair_screen(
        front[:, order], rear[:, order], told["elevation_deg"][:, order], told["azimuth_deg"][:, order],
        satellite=SATELLITES[order], spacing=Spacing(*(told[name] for name in Spacing._fields)), limits=limits,
    )  # fmt: skip
    np.testing.assert_array_equal(whole.metric[:, order], other.metric)


@pytest.mark.requirement("B3")
@pytest.mark.parametrize(
    "wrong", [{"limit_m": 0.0}, {"clocks": "rubidium"}, {"least_satellites": 2}, {"azimuth_error_deg": -1.0}]
)
def test_pair_limits_are_checked(wrong: dict[str, object]) -> None:
    with pytest.raises(SettingsError, match=next(iter(wrong))):
        AntennaPairLimits(**wrong)  # type: ignore[arg-type]


# -- real antennas ------------------------------------------------------------------------------------------


def _two_logs(
    front: Observations,
    rear: Observations,
    navigation: Path,
    heading: tuple[ArrayLike, ArrayLike, ArrayLike],
    **limits: object,
) -> AntennaPairScreened:
    """The screen on the first-band codes above 15 deg of two logs."""
    epochs = pair_epochs(front.time, rear.time, tolerance_s=0.01)
    channels = pair_channels(front.satellite, front.signal, rear.satellite, rear.signal)
    keep = np.isin(front.signal[channels[0]], ("1C", "2I")) & np.isin(front.system[channels[0]], list("GJEC"))
    a, b = (c[keep] for c in channels)
    satellite, signal = front.satellite[a], front.signal[a]
    code = front.code_m[np.ix_(epochs[0], a)], rear.code_m[np.ix_(epochs[1], b)]
    states = satellite_states(front.time[epochs[0]], satellite, signal, code[0], read_navigation(navigation))
    place = np.broadcast_to(front.header.approximate_ecef_m, (len(epochs[0]), 3))
    elevation, azimuth = elevation_azimuth(states.position_ecef_m, place)
    rate = -SPEED_OF_LIGHT / carrier_frequency_hz(satellite, signal) * front.doppler_hz[np.ix_(epochs[0], a)]
    return antenna_pair_screen(
        np.where(elevation > 15, code[0], np.nan), code[1], elevation, azimuth, satellite=satellite,
        spacing=Spacing(heading[0], heading[1], np.broadcast_to(heading[2], len(place))),
        tags=TagDifference(rear.time[epochs[1]] - front.time[epochs[0]], rate),
        limits=AntennaPairLimits(**limits),  # type: ignore[arg-type]
    )  # fmt: skip


@pytest.mark.requirement("B3")
def test_two_receivers_on_one_roof(recordings: Path) -> None:
    folder = recordings / "dual" / "mosaic_x2_99cm"
    front, rear = (read_observations(folder / name) for name in ("rover.obs", "base.obs"))
    # rover less base: east -0.223, north -0.965, up 0.010
    heading = np.degrees(np.arctan2(-0.223, -0.965)) % 360
    gradient, spacing = 1e3 * 0.010 / np.hypot(0.223, 0.965), np.sqrt(0.223**2 + 0.965**2 + 0.010**2)
    result = _two_logs(front, rear, folder / "base.nav", (heading, gradient, spacing))
    judged = np.isfinite(result.metric)
    rms = float(np.sqrt(np.mean(result.metric[judged] ** 2)))
    share = float(result.reject.sum() / judged.sum())
    wrong = _two_logs(front, rear, folder / "base.nav", ((heading + 180) % 360, -gradient, spacing))
    rms_wrong = float(np.sqrt(np.nanmean(wrong.metric**2)))
    print(f"two mosaic-X5 0.990 m apart: rms {rms:.3f} m (turned round {rms_wrong:.3f}), refused {share:.4f}")
    assert judged.sum() > 3000
    assert rms < 1.0
    assert rms_wrong > 1.1 * rms, "the spacing is seen"
    assert share < 0.01


@pytest.mark.requirement("B3")
def test_steps_on_one_of_two_real_receivers_are_found(recordings: Path) -> None:
    folder = recordings / "dual" / "mosaic_x2_99cm"
    front, rear = (read_observations(folder / name) for name in ("rover.obs", "base.obs"))
    told = (193.0, 10.0, 0.990)
    clean = _two_logs(front, rear, folder / "base.nav", told)
    found, wrong = {}, 0
    for step in (3.0, 10.0, 30.0):
        hits = 0
        for m in range(clean.metric.shape[1]):
            if not np.isfinite(clean.metric[:, m]).any():
                continue
            biased = np.where(np.arange(clean.metric.shape[1]) == m, step, 0.0)
            verdict = np.abs(clean.metric + biased) > 5.0
            hits += int(verdict[:, m].sum())
            wrong += int((verdict & ~clean.reject)[:, np.arange(clean.metric.shape[1]) != m].sum())
        found[step] = hits / np.isfinite(clean.metric).sum()
    print(f"found of steps on one receiver: {found}")
    assert found[10.0] > 0.99
    assert found[30.0] == 1.0
    assert wrong == 0


@pytest.mark.requirement("B3")
@pytest.mark.requirement("B5")
def test_two_antennas_of_a_clean_run() -> None:
    """18.2 m apart on a line with a curve, moving, no multipath: what is left is noise, from the zenith down."""
    front, rear = (clean_observations()[name] for name in ("front", "rear"))
    truth = pl.read_csv(clean_files()["truth"])
    places = [truth.filter(pl.col("antenna") == name) for name in ("front", "rear")]
    ecef = [place.select("x_m", "y_m", "z_m").to_numpy() for place in places]
    assert places[0]["time_gpst"].to_list()[-1] == str(front.time[-1])
    direction = spacing_direction(*ecef)
    result = _two_logs(front, rear, clean_files()["nav"], direction)
    turned = _two_logs(front, rear, clean_files()["nav"], ((direction[0] + 180) % 360, -direction[1], direction[2]))
    strong = np.nanmedian(front.cn0_dbhz, axis=0)[np.isfinite(result.expected_m).any(axis=0)] > 47.0
    rms, other = (float(np.sqrt(np.nanmean(r.metric[:, strong] ** 2))) for r in (result, turned))
    share = float(result.reject.sum() / np.isfinite(result.metric).sum())
    high = float(result.reject[:, strong].sum() / np.isfinite(result.metric[:, strong]).sum())
    print(
        f"clean run: rms of strong satellites {rms:.2f} m, turned {other:.2f}; refused {share:.4f}, strong {high:.5f}"
    )
    assert rms < 1.0 < 4.0 * rms < other
    assert high < 1e-3
    chainage = [place["chainage_m"].to_numpy() for place in places]
    positions = antenna_spacing_screen(*chainage, 18.2)
    # on the curve the chord of the car body is shorter than the track by a centimetre
    assert np.abs(positions.metric).max() < 0.02
    assert antenna_spacing_screen(*chainage, 18.2, facing=-1).reject.all()


# -- positions ----------------------------------------------------------------------------------------------

#: Front, rear, spacing, facing -> metric, refused.
POSITIONS = [
    (118.2, 100.0, 18.2, 1, 0.0, False),
    (100.0, 118.2, 18.2, -1, 0.0, False),
    (100.0, 118.2, 18.2, 1, -36.4, True),  # the order is wrong
    (100.0, 118.2, 18.2, 0, 0.0, False),  # the order is not known
    (123.0, 100.0, 18.0, 1, 5.0, False),  # exactly at the limit
    (113.0, 100.0, 18.0, 1, -5.0, False),
    (123.1, 100.0, 18.0, 1, 5.1, True),
    (100.0, 123.1, 18.0, -1, 5.1, True),
    (112.9, 100.0, 18.0, 1, -5.1, True),
    (100.0, 100.0, 0.0, 1, 0.0, False),  # both chainages of one reference point
    (106.0, 100.0, 0.0, 1, 6.0, True),
    (106.0, 100.0, 0.0, -1, -6.0, True),
    (NAN, 100.0, 18.0, 1, NAN, False),
    (100.0, NAN, 18.0, 1, NAN, False),
    (100.0, 90.0, NAN, 1, NAN, False),
]


@pytest.mark.requirement("B5")
def test_positions_truth_table() -> None:
    front, rear, spacing, facing, metric, refused = (np.array(column) for column in zip(*POSITIONS, strict=True))
    for array in (front, rear, spacing):
        array.flags.writeable = False
    result = antenna_spacing_screen(front, rear, spacing, facing=facing)
    np.testing.assert_allclose(result.metric, metric, atol=1e-9)
    assert result.reject.tolist() == refused.tolist()
    for i in range(len(front)):
        single = antenna_spacing_screen(front[i : i + 1], rear[i : i + 1], spacing[i], facing=int(facing[i]))
        np.testing.assert_array_equal(single.metric, result.metric[i : i + 1])
        assert single.reject.tolist() == [refused[i]]


@pytest.mark.requirement("B5")
@given(
    front=st.floats(-1e5, 1e5), rear=st.floats(-1e5, 1e5), spacing=st.floats(0, 200), facing=st.sampled_from([-1, 0, 1])
)
def test_turning_the_line_round_changes_nothing(front: float, rear: float, spacing: float, facing: int) -> None:
    one = antenna_spacing_screen(np.array([front]), np.array([rear]), spacing, facing=facing)
    other = antenna_spacing_screen(np.array([-front]), np.array([-rear]), spacing, facing=-facing)
    np.testing.assert_array_equal(one.metric, other.metric)
    wide = antenna_spacing_screen(
        np.array([front]), np.array([rear]), spacing, facing=facing, limits=AntennaSpacingLimits(limit_m=6.0)
    )
    assert not (wide.reject & ~one.reject).any()


@pytest.mark.requirement("B5")
def test_positions_are_checked() -> None:
    with pytest.raises(SettingsError, match="limit_m"):
        AntennaSpacingLimits(limit_m=-1.0)
    with pytest.raises(ValueError, match="facing"):
        antenna_spacing_screen([1.0], [2.0], 3.0, facing=2)
    with pytest.raises(ValueError, match="spacing_m"):
        antenna_spacing_screen([1.0], [2.0], -3.0)


def test_places_by_the_filter_differ_by_more_than_the_limit_and_noise() -> None:
    pair = PairedEpochs(
        front_epoch=np.arange(5),
        rear_epoch=np.arange(5),
        front_ecef_m=np.zeros((5, 3)),
        rear_ecef_m=np.zeros((5, 3)),
        along_m=np.array([-18.0, -18.0, -18.0, -18.0, np.nan]),
    )
    place, sigma = np.array([100.0, 100.0, 100.0, np.nan, 100.0]), np.array([1.0, 1.0, 5.0, 1.0, 1.0]) / np.sqrt(2.0)
    front = FilteredMotion(place, sigma, speed_mps=np.full(5, 10.0), speed_sigma_mps=np.full(5, 0.1))
    rear = front._replace(chainage_m=np.array([118.0, 130.0, 130.0, 118.0, 130.0]))
    found = SCREEN.judge_filtered(front, rear, pair, AntennaSpacingLimits())
    np.testing.assert_allclose(found.metric, [0.0, 12.0, 12.0, np.nan, np.nan])
    np.testing.assert_array_equal(found.reject, [False, True, False, False, False])
    # speeds: beyond 1.5 m/s and four standard deviations of the difference
    rear = front._replace(chainage_m=place + 18.0, speed_mps=np.array([11.4, 11.6, 11.6, np.nan, 10.0]))
    rear = rear._replace(speed_sigma_mps=np.array([0.01, 0.1, 0.5, 0.1, 0.1]))
    found = SCREEN.judge_filtered(front, rear, pair, AntennaSpacingLimits())
    np.testing.assert_array_equal(found.reject, [False, True, False, False, False])


@pytest.mark.requirement("B5")
@pytest.mark.parametrize("cuts", [[30], [10, 30, 33]])
def test_places_are_doubtful_for_a_while_after_the_antennas_have_disagreed(cuts: list[int]) -> None:
    """All speeds are unequal to such limits; after 3 s the rear antenna is silent, a second later the doubt ends."""
    limits = {"filter_speed_mps": 1e-9, "filter_sigmas": 1e-9, "filter_held_s": 1.0}
    one = processor({"filter": "track", "antenna_spacing": limits})
    logs, state, status = clean_observations(), None, []
    for first, end in zip([0, *cuts], [*cuts, 60], strict=True):
        parts = {"front": logs["front"][first:end]} | ({"rear": logs["rear"][first:end]} if first < 30 else {})
        result, state = one.process(parts, state)
        status.append(result.fusion["front"].tracked.status)
    found = np.concatenate(status)
    assert (found[15:40] == TrackStatus.ANTENNAS_DISAGREE).all()
    assert (found[40:] == TrackStatus.TRACKING).all()


@pytest.mark.requirement("B5")
@pytest.mark.parametrize("screens", [["elevation", "antenna_spacing"], ["elevation"]])
def test_filtered_places_that_are_not_apart_as_the_antennas_are_doubtful(screens: list[str]) -> None:
    """The log of the front antenna is given for both; with the rear one's own there is no doubt."""
    parts = {name: log[:60] for name, log in clean_observations().items()}
    one = processor({"screens": screens, "filter": "track"})
    good, _ = one.process(parts)
    wrong, _ = one.process({"front": parts["front"], "rear": parts["front"]})
    judged = "antenna_spacing" in screens
    for name in ("front", "rear"):
        clear, doubtful = good.fusion[name], wrong.fusion[name]
        assert (clear.tracked.status[15:] == TrackStatus.TRACKING).all()
        assert np.isfinite(clear.tracked.level_m[15:]).all()
        expected = TrackStatus.ANTENNAS_DISAGREE if judged else TrackStatus.TRACKING
        assert (doubtful.tracked.status[15:] == expected).all()
        assert (np.isinf(doubtful.tracked.level_m[15:]) == judged).all()
        if judged:
            assert np.abs(clear.spacing_error_m[15:]).max() < 3.0
            np.testing.assert_allclose(doubtful.spacing_error_m[15:], -18.0, atol=1.0)
