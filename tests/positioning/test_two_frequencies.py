"""Two codes of a satellite combined: against least squares written out, the truth, and pieces of a log."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import recordings_truth
from railfix.core.arrays import Floats
from railfix.core.reasons import Reason
from railfix.core.timescale import seconds, timedelta
from railfix.evaluate import interpolate_reference, straight_distance
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.gnss.orbits.prepared_records import group_delay_s
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import parse_config
from railfix.pipeline.frequency_stage import NAME
from railfix.pipeline.results import AntennaResult
from railfix.positioning.two_frequencies import (
    Combined,
    TwoFrequencyLimits,
    TwoFrequencyState,
    combine_codes,
    share_of_second,
)
from railfix.ranges.corrected import SecondCodes
from railfix.ranges.second_codes import signal_delays
from railfix.run.processor_setup import make_processor
from railfix.track import from_positions
from railfix.track.trajectory import Trajectory

pytestmark = pytest.mark.requirement("A11")

RATIO = (77 / 60) ** 2
NAMES = tuple(f"G{i:02d} 1C 2W" for i in range(1, 9))
START = np.datetime64("2024-03-13T08:00:00", "ns")


def made(
    epochs: int = 900, *, noise_m: float = 0.3, ionosphere_m: Floats | None = None, delay_m: float = 12.0
) -> tuple[np.ndarray, Floats, SecondCodes, Floats]:
    """Codes of eight satellites at 1 Hz: ranges 0, an error of the modelled ionosphere, a delay of the receiver."""
    rng = np.random.default_rng(7)
    satellites = len(NAMES)
    error = np.linspace(-2.0, 2.0, satellites) if ionosphere_m is None else ionosphere_m
    first, second = rng.normal(scale=noise_m, size=(2, epochs, satellites))
    shape = (epochs, satellites)
    codes = SecondCodes(
        code_m=RATIO * error + delay_m + second, noise_m=np.ones(shape), cn0_dbhz=np.full(shape, 45.0),
        group_delay_m=np.zeros(shape), delay_sigma_m=np.zeros(shape), ratio=np.full(shape, RATIO),
        pair=np.broadcast_to(np.arange(satellites), shape), column=np.broadcast_to(np.arange(satellites), shape),
    )  # fmt: skip
    return START + timedelta(np.arange(float(epochs))), error + first, codes, np.broadcast_to(error, shape)


def combine(
    time: np.ndarray,
    code: Floats,
    second: SecondCodes,
    state: TwoFrequencyState | None = None,
    prior_m: float = 1.5,
    sky: Floats | None = None,
) -> tuple[Combined, TwoFrequencyState]:
    ones = np.ones(code.shape)
    pairs = (NAMES, np.zeros(len(NAMES), dtype=np.intp))
    field = np.zeros((*code.shape, 4)) if sky is None else np.broadcast_to(sky, (*code.shape, 4)).copy()
    field[..., 3] = prior_m
    return combine_codes(time, code, ones, second, field, pairs, state or TwoFrequencyState(), TwoFrequencyLimits())


def spread(values: Floats) -> float:
    """Standard deviation between satellites: what is common to all of them is the clock's."""
    return float((values - values.mean(axis=1, keepdims=True)).std())


def test_the_ionosphere_is_measured_and_codes_lose_its_error() -> None:
    time, code, second, error = made()
    found, _ = combine(time, code, second)
    late = slice(600, None)
    assert np.isnan(found.share[:1]).all(), "no epoch before the first"
    measured = found.ionosphere_m[late] - error[late]
    assert spread(measured) < 0.25 * spread(error[late])
    assert spread(found.code_m[late]) < 0.4 * spread(code[late])
    assert (np.abs(measured - measured.mean(axis=1, keepdims=True)) < 4 * found.ionosphere_sigma_m[late]).all()


@pytest.mark.parametrize("ionosphere_m2", [0.0, 0.04, 1.0, 1e6])
def test_share_is_that_of_least_squares_with_the_ionosphere_unknown(ionosphere_m2: float) -> None:
    """The closed form against normal equations with range and ionosphere as unknowns, the prior as a measurement."""
    first, second = 0.09, 0.25
    share, _ = share_of_second(*(np.array(v) for v in (first, second, RATIO, ionosphere_m2)))
    design = np.array([[1.0, 1.0], [1.0, RATIO], [0.0, 1.0]])
    weight = np.diag(1.0 / np.array([first, second, max(ionosphere_m2, 1e-12)]))
    estimator = np.linalg.solve(design.T @ weight @ design, design.T @ weight)
    assert float(share) == pytest.approx(estimator[0, 1], abs=1e-5)


def test_share_at_both_ends() -> None:
    """By hand: equal codes and no ionosphere are averaged; with an unknown one, -f2^2 / (f1^2 - f2^2)."""
    assert share_of_second(*(np.array(v) for v in (1.0, 1.0, RATIO, 0.0)))[0] == 0.5
    assert share_of_second(*(np.array(v) for v in (1.0, 1.0, RATIO, 1e9)))[0] == pytest.approx(-3600 / (5929 - 3600))


def test_pieces_of_a_log_give_the_same_bits() -> None:
    time, code, second, _ = made(300)
    whole, last = combine(time, code, second)
    state, parts = None, []
    for rows in (slice(0, 1), slice(1, 80), slice(80, 300)):
        part = SecondCodes(**{f.name: getattr(second, f.name)[rows] for f in fields(SecondCodes)})
        found, state = combine(time[rows], code[rows], part, state)
        parts.append(found)
    for item in fields(Combined):
        pieces = np.concatenate([getattr(part, item.name) for part in parts])
        np.testing.assert_array_equal(pieces, getattr(whole, item.name), err_msg=item.name)
    np.testing.assert_array_equal(state.sums, last.sums)


def test_satellites_may_come_in_another_order() -> None:
    _, state = combine(*made(300)[:3])
    kept, number = state.with_pairs(("G09 1C 2W", *reversed(NAMES)))
    assert kept.names == (*NAMES, "G09 1C 2W")
    assert number.tolist() == [8, *range(7, -1, -1)]
    assert kept.sums[:8].tolist() == state.sums[:8].tolist()
    assert kept.sums[8] == kept.sums[17] == 0.0


def test_reflection_in_one_code_is_suspected() -> None:
    time, code, second, _ = made(300)
    code[250:260, 2] += 20.0
    found, _ = combine(time, code, second)
    assert found.suspected[250:260, 2].all()
    assert found.suspected.sum() == 10


def test_noisy_codes_leave_the_ionosphere_to_the_model() -> None:
    """Differences of 6 m for five minutes: what they take for ionosphere stays within the prior sigma."""
    time, code, second, error = made(300, noise_m=6.0, ionosphere_m=np.zeros(8))
    found, _ = combine(time, code, second)
    assert np.abs(found.ionosphere_m[60:] - error[60:]).max() < 1.5
    assert (found.share[60:] > 0.2).all(), "weighted mean of two codes"


def test_the_ionosphere_of_a_noisy_satellite_is_that_of_its_neighbours() -> None:
    """A field of two gradients: one satellite's codes differ by 4 m more for as long as it stands (multipath)."""
    east = np.linspace(-1.0, 1.0, len(NAMES))
    sky = np.stack([np.full(8, 1.5), 1.5 * east, 1.5 * np.cos(3.0 * east), np.zeros(8)], axis=-1)
    error = sky[:, :3] @ np.array([1.0, -0.8, 0.5])
    time, code, second, _ = made(600, ionosphere_m=error)
    second.code_m[:, 3] += 4.0
    found, _ = combine(time, code, second, prior_m=0.35, sky=sky)
    alone, _ = combine(time, code, second, prior_m=1.5)
    apart = [each.ionosphere_m[-1] - error for each in (found, alone)]
    with_field, without = (float(values[3] - np.median(values)) for values in apart)
    assert with_field < 1.2
    assert without > 2.5


@pytest.mark.parametrize(("epochs", "largest_m"), [(3, 1.25), (10, 1.15), (60, 1.15)])
def test_an_error_that_lasts_a_minute_is_one_sample_from_the_start(epochs: int, largest_m: float) -> None:
    """Half of the variance of a code is white, half stays alike for a minute: the error is as large as is stated.

    Without a measurement it is that of the prior, 1.5 m less the mean of eight satellites: 1.40 m.
    """
    rng, errors, ratios = np.random.default_rng(3), [], []
    for _ in range(100):
        ionosphere = rng.normal(scale=1.5, size=len(NAMES))
        time, code, second, _ = made(epochs, noise_m=0.0, ionosphere_m=ionosphere)
        lasting, white = rng.normal(size=(2, 1, len(NAMES))), rng.normal(size=(2, *code.shape))
        first, other = np.sqrt(0.5) * (lasting + white)
        found, _ = combine(time, code + first, replace(second, code_m=second.code_m + other), prior_m=1.5)
        away = found.ionosphere_m[-1] - ionosphere
        errors.append(away - away.mean())
        ratios.append(errors[-1] / found.ionosphere_sigma_m[-1])
    assert np.sqrt(np.mean(np.square(errors))) < largest_m
    assert 0.8 < np.sqrt(np.mean(np.square(ratios))) < 1.2


def test_the_noise_of_a_code_is_as_large_as_its_stated_change_makes_it() -> None:
    """White noise of a metre in both codes, as is assumed: drawn errors have the variance that is stated."""
    time, code, second, _ = made(2400, noise_m=1.0)
    found, _ = combine(time, code, second)
    late = slice(1500, None)
    drawn = found.code_m[late].var(axis=0).mean()
    assert drawn == pytest.approx(1.0 + float(found.variance_m2[late].mean()), rel=0.05)
    assert drawn < 0.75


def test_what_the_means_have_told_is_not_told_again() -> None:
    """Codes of equal noise are averaged once the ionosphere is known; before, less of the second."""
    time, code, second, _ = made(1800, noise_m=0.05)
    share = combine(time, code, second)[0].share
    assert (share[60] < 0.0).all()
    assert (share[-1] > 0.3).all()


def japan(recordings: Path) -> tuple[Observations, Navigation, Trajectory, Floats]:
    """Four minutes of open sky in Japan: log, navigation, line, and the reference positions."""
    folder = recordings / "kinematic" / "japan_mosaic_2021265_with_GEONET3034"
    time, ecef = recordings_truth.japan_truth(folder)
    line = Trajectory.from_antenna_path(from_positions(time, ecef, spacing_m=5.0))
    log, navigation = read_observations(folder / "SEPT265G.21O")[:240], read_navigation(folder / "SEPT2650.21P")
    return log, navigation, line, interpolate_reference(log.time, time, ecef)


def solved(log: Observations, navigation: Navigation, line: Trajectory, frequencies: str) -> AntennaResult:
    config = parse_config({"frequencies": frequencies, "filter": "off"})
    return make_processor(config, navigation, {"front": line}).process({"front": log})[0].antennas["front"]


@pytest.fixture(scope="module")
def open_sky(recordings: Path) -> dict[str, tuple[AntennaResult, Floats]]:
    """Open sky by one and two frequencies, with the reference positions; nothing is observed for ten seconds."""
    log, navigation, line, reference = japan(recordings)
    log = replace(log, code_m=np.where((np.arange(240) // 10 == 10)[:, None], np.nan, log.code_m))
    found = {name: (solved(log, navigation, line, name), reference) for name in ("one", "two")}
    processor = make_processor(parse_config({"frequencies": "two", "filter": "off"}), navigation, {"front": line})
    state = None
    for piece in (log[:1], log[1:100], log[100:110, ()], log[110:]):
        part, state = processor.process({"front": piece}, state)
    np.testing.assert_array_equal(part.antennas["front"].arc_m, found["two"][0].arc_m[110:])
    return found


def test_open_sky_is_better_by_half(open_sky: dict[str, tuple[AntennaResult, Floats]]) -> None:
    """Under open sky the horizontal error of 3-D positions is nearly all ionosphere: two frequencies halve it."""
    error = {}
    for name, (result, reference) in open_sky.items():
        up = reference / np.linalg.norm(reference, axis=1, keepdims=True)
        apart = result.point.ecef_m - reference
        across = apart - np.einsum("ti,ti->t", apart, up)[:, None] * up
        error[name] = np.nanmedian(np.linalg.norm(across, axis=1)[60:])
    assert error["two"] < 0.5 * error["one"]


def test_fault_of_a_second_code_alone_is_weighed_down(recordings: Path) -> None:
    """20 m on one satellite's second code for a minute: suspected at once, and the position hardly moves."""
    log, navigation, line, reference = japan(recordings)
    times = seconds(log.time - log.time[0])
    wrong = (times >= 60.0) & (times < 120.0)
    column = int(np.flatnonzero((log.satellite == "E26") & (log.signal == "5Q"))[0])
    code = log.code_m.copy()
    code[wrong, column] += 20.0
    clean, faulty = (solved(each, navigation, line, "two") for each in (log, replace(log, code_m=code)))
    at = faulty.satellite[faulty.columns].tolist().index("E26")
    assert faulty.screens[NAME].reject[wrong, at].all()
    error, before = (straight_distance(each.arc_m, reference, line) for each in (faulty, clean))
    assert np.nanmax(np.abs(error - before)) < 1.0
    assert not (error > faulty.protection.level.level_m).any()


def test_second_signals_are_used_and_counted_so(open_sky: dict[str, tuple[AntennaResult, Floats]]) -> None:
    two, one = open_sky["two"][0], open_sky["one"][0]
    assert NAME in two.screens
    taken = int(Reason.OTHER_SIGNAL_TAKEN)
    assert (two.reason == 0).sum() > 1.8 * (one.reason == 0).sum()
    assert ((two.reason & taken) > 0).sum() < ((one.reason & taken) > 0).sum()
    assert (two.n_used == one.n_used).mean() > 0.95, "satellites are counted, not signals"


def test_delay_that_lnav_lacks_is_that_of_cnav(recordings: Path) -> None:
    navigation = read_navigation(recordings / "sbas" / "msas_20250215" / "046r_rnx.nav")
    records, (delay, sigma, _) = navigation.kepler, signal_delays(navigation, "5Q")
    for i in np.flatnonzero((records.satellite == "G11") & (records.message == "LNAV")):
        cnav = np.flatnonzero((records.satellite == "G11") & (records.message == "CNAV"))
        assert delay[i] == pytest.approx(group_delay_s(records, "5Q")[cnav[0]] * 299_792_458.0, abs=0.01)
        assert sigma[i] == 0.0
