"""Properties of the epoch processor: cutting, order, clocks, its own sigma, offsets, noise scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

import recordings_score
import recordings_truth
import synthetic
from pipeline_cases import (
    ANTENNAS,
    channel,
    clean_observations,
    clean_trajectories,
    demo_observations,
    flat,
    front_alone,
    in_pieces,
    only,
    processor,
    same,
    true_chainage,
    with_code,
)
from railfix.core.constants import FREQUENCY_L1, SPEED_OF_LIGHT
from railfix.core.errors import SettingsError
from railfix.core.reasons import POSITIONED, Reason, Status
from railfix.core.timescale import timedelta
from railfix.gnss.observations import Observations
from railfix.io import read_navigation, read_observations
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.received import no_navigation
from railfix.ranges.range_sigma import NominalErrors
from railfix.run.processor_setup import make_processor

#: Epochs a chunk, and epochs of the log.
CHUNKS = {1: 60, 7: 200, 1000: 1200}


def chunked(size: int, length: int) -> list[int]:
    return list(range(size, length, size))


@pytest.mark.requirement("A8")
@pytest.mark.parametrize(("size", "epochs"), CHUNKS.items())
@pytest.mark.every(5)
def test_chunks_give_the_whole(size: int, epochs: int):
    """Two antennas, every screen on, every array of the result."""
    one = processor({"filter": "track"})
    parts = {name: whole[:epochs] for name, whole in demo_observations().items()}
    whole, state = in_pieces(one, parts, [])
    pieces, state_of_pieces = in_pieces(one, parts, chunked(size, epochs))
    for name in ANTENNAS:
        same(whole[name], pieces[name], atol=1e-9)
        assert state.antennas[name].offsets == state_of_pieces.antennas[name].offsets
        assert np.array_equal(state.antennas[name].noise.robust, state_of_pieces.antennas[name].noise.robust)
        assert np.array_equal(state.antennas[name].noise.remaining, state_of_pieces.antennas[name].noise.remaining)
        assert np.array_equal(state.antennas[name].map_offset.sums, state_of_pieces.antennas[name].map_offset.sums)


@pytest.fixture(scope="module")
def m8t(recordings) -> tuple[EpochProcessor, Observations]:
    """An urban log with clock steps and gaps."""
    folder = recordings / "kinematic" / "urbannav_tst"
    trajectory = recordings_score.trajectory_of(*recordings_truth.urbannav_truth(folder))
    navigation = read_navigation([folder / "hksc137c.nav"])
    observations = read_observations(folder / "20210517.light-urban.tste.ublox.m8t.GC.obs")
    return make_processor(recordings_score.SETTINGS, navigation, {"front": trajectory}), observations


@pytest.mark.requirement("A4")
@pytest.mark.parametrize("seed", [1, 2])
def test_order_of_channels_changes_nothing(seed: int):
    observations = clean_observations()["front"][400:600]
    order = np.random.default_rng(seed).permutation(len(observations.satellite))
    names = ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock")
    shuffled = replace(
        observations,
        satellite=observations.satellite[order],
        signal=observations.signal[order],
        **{name: getattr(observations, name)[:, order] for name in names},
    )
    one, other = front_alone(observations), front_alone(shuffled)
    assert np.array_equal(one.status, other.status)
    assert np.array_equal(one.reason[:, order], other.reason)
    assert one.arc_m == pytest.approx(other.arc_m, abs=1e-6)
    assert one.residual_m[:, order] == pytest.approx(other.residual_m, abs=1e-6, nan_ok=True)


@pytest.mark.requirement("A4")
@pytest.mark.parametrize("told", ["by the tags", "by nothing"])
def test_receiver_clock_steps_change_nothing(told: str):
    """Clocks put back or on by a millisecond: tag and code of the same instants, or codes of other instants."""
    observations = clean_observations()["front"][300:700]
    rng = np.random.default_rng(5)
    at = rng.choice(np.arange(20, 390), 9, replace=False)
    jump = np.zeros(len(observations))
    jump[at] = rng.choice([-1.0, 1.0], len(at))
    clock_s = 1e-3 * np.cumsum(jump)
    if told == "by the tags":
        moved = with_code(observations, (clock_s * SPEED_OF_LIGHT)[:, None])
        moved = replace(moved, time=observations.time + timedelta(clock_s))
    else:
        rate = -SPEED_OF_LIGHT / FREQUENCY_L1 * observations.doppler_hz
        moved = with_code(observations, clock_s[:, None] * (SPEED_OF_LIGHT - rate))
    one, other = front_alone(observations), front_alone(moved)
    assert np.array_equal(one.status, other.status)
    # A satellite is held off for a time told by the tags: its last epoch may come a millisecond too late.
    assert np.count_nonzero(one.reason != other.reason) <= 2
    speed = np.abs(np.gradient(true_chainage("front"), 0.1))[300:700]
    travelled = speed * np.abs(clock_s) if told == "by nothing" else 0.0
    assert np.all(np.abs(one.arc_m - other.arc_m) < 0.002 + 1.1 * travelled)


@pytest.mark.requirement("A4")
def test_error_over_its_own_sigma():
    """The run has noise alone: no satellite or atmospheric errors are to be stated."""
    exact = dict.fromkeys(NominalErrors.model_fields, 0.0)
    result, _ = processor({"nominal": exact}).process(clean_observations())
    for name, found in result.antennas.items():
        settled = np.arange(len(found)) > 100
        error = found.chainage_m - true_chainage(name)
        ratio = (error / found.along_sigma_m)[settled & np.isfinite(error)]
        rms = float(np.sqrt(np.mean(ratio**2)))
        print(f"{name}: error over its own sigma, rms {rms:.3f} over {len(ratio)} epochs")
        assert 0.8 < rms < 1.2
        assert np.mean(np.isfinite(error)) > 0.99


@pytest.mark.requirement("A4")
def test_noise_scale_finds_the_receivers_noise():
    """The weights are made those of the simulator: noise of half a metre, so 0.5; and codes twice as noisy, so 1."""
    weights = {"zenith_sigma_m": 1.0, "floor_sigma_m": 0.0}
    settings_ = {"noise": weights, "screens": ["elevation"], "clock_offsets": {"stability_m": float("inf")}}
    observations = clean_observations()["front"]
    found = front_alone(observations, settings_)
    assert found.noise_scale[0] == 1.0
    assert found.noise_scale[-1] == pytest.approx(0.5, rel=0.05)
    sigma = found.sigma_m * found.noise_scale[-1]
    extra = np.random.default_rng(1).normal(size=sigma.shape) * np.where(np.isfinite(sigma), sigma, 0.0) * np.sqrt(3.0)
    louder = front_alone(with_code(observations, extra), settings_)
    assert louder.noise_scale[-1] == pytest.approx(1.0, rel=0.05)


OFFSET_M = {"E": -4.0, "G": 0.0, "J": 0.0}


def with_offsets(observations: Observations) -> Observations:
    return with_code(observations, np.array([OFFSET_M[s] for s in observations.system]))


@pytest.mark.requirement("A4")
def test_offset_between_clocks_is_found():
    found = front_alone(with_offsets(clean_observations()["front"]), {"screens": ["elevation"]})
    galileo, gps = found.corrected.channels.clocks.index("E"), found.corrected.channels.clocks.index("G")
    assert found.ties.offset_m[-1, gps] == 0.0
    assert found.ties.offset_m[-1, galileo] == pytest.approx(-4.0, abs=0.4)
    assert found.ties.sigma_m[0, galileo] > 1e5
    assert 1.0 <= found.ties.sigma_m[-1, galileo] < 1.5
    # What is known of an offset is from the epochs before.
    assert np.all(np.diff(found.ties.sigma_m[:, galileo]) <= 1e-12)


@pytest.mark.requirement("A4")
def test_known_offset_makes_one_satellite_count():
    """After a minute with all, one Galileo satellite beside three of GPS is used; without ties it is alone."""
    observations = with_offsets(clean_observations()["front"])
    whole = front_alone(observations, {"screens": ["elevation"]})
    high = whole.satellite[np.argsort(-whole.elevation_deg[650])]
    few = only(observations, [*[s for s in high.tolist() if s[0] == "G"][:3], "E12"])
    before = np.where(np.arange(len(observations))[:, None] < 600, observations.code_m, few.code_m)
    mixed = replace(observations, code_m=before)[:700]
    tied = front_alone(mixed, {"screens": ["elevation"]})
    free = front_alone(mixed, {"screens": ["elevation"], "clock_offsets": {"stability_m": float("inf")}})
    at = channel(mixed, "E12")
    assert np.all(tied.reason[600:, at] == Reason.USED)
    assert np.all(free.reason[600:, at] == Reason.ALONE_ON_ITS_CLOCK)
    assert np.all(tied.n_used[600:] == 4)
    assert np.all(free.n_used[600:] == 3)


@pytest.mark.requirement("A4")
def test_separate_clocks_equal_an_independent_solution():
    """`stability_m` infinite: one column a constellation, by a general optimiser in space."""
    settings_ = {"screens": ["elevation"], "clock_offsets": {"stability_m": float("inf")}}
    found = front_alone(with_offsets(clean_observations()["front"])[::200], settings_)
    k = found.columns
    for t in range(len(found)):
        used = found.reason[t, k] == 0
        sat, code = found.corrected.satellites.position_ecef_m[t, used], found.corrected_code_m[t, k][used]
        letters = found.satellite[k][used].astype("<U1")
        clocks = np.stack([letters == "E", letters != "E"], axis=1).astype(float)
        root = 1.0 / found.sigma_m[t, k][used]

        def residual(x: np.ndarray, sat=sat, code=code, clocks=clocks, root=root) -> np.ndarray:
            return (code - synthetic.travelled_range(sat, x[:3]) - clocks @ x[3:]) * root

        def jacobian(x: np.ndarray, residual=residual) -> np.ndarray:
            return np.stack([residual(x + e) - residual(x - e) for e in 0.5 * np.eye(5)], axis=1)

        start = np.r_[clean_trajectories()["front"].ecef_m[0], 0.0, 0.0]
        place = least_squares(residual, start, jac=jacobian, x_scale="jac", xtol=1e-14, ftol=1e-14).x
        assert found.point.ecef_m[t] == pytest.approx(place[:3], abs=1e-3)


@pytest.mark.requirement("B7")
def test_reasons_and_statuses_add_up():
    result, _ = processor().process(clean_observations())
    for name, found in result.antennas.items():
        observed = (found.reason & Reason.NOT_OBSERVED) == 0
        assert np.array_equal(observed, np.isfinite(clean_observations()[name].code_m))
        assert np.all(found.reason[~observed] == Reason.NOT_OBSERVED)
        names, which = np.unique(found.satellite, return_inverse=True)
        for t in range(0, len(found), 97):
            with_code_ = {int(s) for s in which[observed[t]]}
            used = {int(s) for s in which[found.reason[t] == 0]}
            assert found.n_used[t] == len(used)
            assert found.n_used[t] + found.n_rejected[t] == len(with_code_) <= len(names)
        positioned = np.isfinite(found.chainage_m)
        assert np.array_equal(positioned, np.isin(found.status, POSITIONED))


@pytest.mark.requirement("B7")
def test_reasons_of_a_recording_add_up(m8t):
    one, observations = m8t
    found = one.process({"front": observations})[0].antennas["front"]
    observed = np.isfinite(observations.code_m)
    assert np.all(((found.reason & Reason.NOT_OBSERVED) == 0) == observed)
    names = np.unique(found.satellite)
    member = found.satellite[:, None] == names
    seen = (observed[:, :, None] & member).any(axis=1).sum(axis=1)
    assert np.array_equal(found.n_used + found.n_rejected, seen)
    assert np.isin(found.status, [s.value for s in Status]).all()
    flat(found)


@pytest.mark.parametrize("step", [0, -1], ids=["repeated", "back"])
def test_epochs_out_of_order_are_refused(step: int) -> None:
    front = clean_observations()["front"]
    time = front.time.copy()
    time[2] = time[1] + step * np.timedelta64(1, "ms")
    with pytest.raises(ValueError, match=r"front: epoch 2 \(.*\) is not after .*; pass epochs in order of time"):
        processor().process({"front": replace(front, time=time)})


@pytest.mark.requirement("G4")
def test_a_chunk_before_the_last_one_and_a_processor_without_navigation_are_named():
    one, parts = processor(), {name: whole[:20] for name, whole in demo_observations().items()}
    _, state = one.process({name: part[10:] for name, part in parts.items()})
    with pytest.raises(ValueError, match=r"front: the chunk begins at .*, not after .*, the last epoch of"):
        one.process({name: part[:10] for name, part in parts.items()}, state)
    with pytest.raises(SettingsError, match="no navigation records: EpochProcessor"):
        EpochProcessor(one.config, one.trajectories).process(parts)
    result, _ = EpochProcessor(one.config, one.trajectories, navigation=no_navigation()).process(parts)
    assert result.notes[0].startswith("no navigation record is known; pass navigation to EpochProcessor")
    assert not any("no navigation" in note for note in one.process(parts)[0].notes)
