"""Every column of every table, of a log whole and cut, whatever channels each epoch has (requirement A8)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

import recordings_score
import recordings_truth
from live_batch import chunks_of, differences, epochs_of, tables_of, thinned
from pipeline_cases import clean_trajectories, demo_observations
from railfix.core.channel_state import join_channels
from railfix.gnss.observations import Observations
from railfix.integrity.interference.limits import InterferenceLimits, PowerState, power_signs
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import Config
from railfix.pipeline.processor import EpochProcessor
from railfix.run.processor_setup import make_processor
from railfix.simulate.demonstration import demo_files

pytestmark = pytest.mark.requirement("A8")

#: Differences that rounding explains [m].
ROUNDING_M = 1e-6
ODD = (1, 7, 3, 11)


def check(processor: EpochProcessor, logs: dict[str, Observations], *, odd: bool = True) -> dict[str, pl.DataFrame]:
    """Compare the log whole with single epochs of the channels that they have, and with odd chunks of all channels."""
    whole = tables_of(processor, [logs])
    assert {"positions", "observations", "train"} <= whole.keys()
    assert differences(whole, tables_of(processor, epochs_of(logs)), ROUNDING_M) == {}
    if odd:
        assert differences(whole, tables_of(processor, chunks_of(logs, ODD)), ROUNDING_M) == {}
    return whole


def demo_processor(**settings: object) -> EpochProcessor:
    navigation = read_navigation(demo_files()["nav"])
    return EpochProcessor(Config(filter="track", **settings), clean_trajectories(), navigation=navigation)  # type: ignore[arg-type]


def test_epochs_of_10_hz_with_observations_and_epochs_missing() -> None:
    """Codes count once a second: 0.9 s after the last ones, with an epoch missing, they are due by a rounding error."""
    logs = {name: thinned(log[300:400], 0.05, seed=k) for k, (name, log) in enumerate(demo_observations().items(), 1)}
    whole = check(demo_processor(), logs, odd=False)
    assert whole["train"]["chainage_m"].is_not_nan().sum() > 150


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.02, 0.1])
@pytest.mark.parametrize("step", [1, 10])
def test_the_demonstration_in_chunks_of_any_kind(share: float, step: int) -> None:
    logs = {
        name: thinned(log[300 : 300 + 200 * step : step], share, seed=k)
        for k, (name, log) in enumerate(demo_observations().items(), 3)
    }
    check(demo_processor(), logs)


def urbannav(folder: Path, log: str) -> tuple[EpochProcessor, Observations]:
    trajectory = recordings_score.trajectory_of(*recordings_truth.urbannav_truth(folder))
    navigation = read_navigation([folder / "hksc137c.nav"])
    processor = make_processor(Config(filter="track"), navigation, {"front": trajectory})
    return processor, read_observations(folder / f"20210517.light-urban.tste.ublox.{log}.obs")


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.02, 0.1])
@pytest.mark.parametrize("name", ["m8t.GC", "f9p", "japan"])
def test_recordings_in_chunks_of_any_kind(recordings: Path, name: str, share: float) -> None:
    if name == "japan":
        folder = next((recordings / "kinematic").glob("japan_mosaic*"))
        trajectory = recordings_score.trajectory_of(*recordings_truth.japan_truth(recordings))
        navigation = read_navigation([folder / "SEPT2650.21P"])
        processor = make_processor(Config(filter="track"), navigation, {"front": trajectory})
        log = read_observations(folder / "SEPT265G.21O")
    else:
        processor, log = urbannav(recordings / "kinematic" / "urbannav_tst", name)
    check(processor, {"front": thinned(log[100:300], share)})


@pytest.mark.parametrize("missing", [0.0, 0.02, 0.1, 0.2])
def test_a_fall_of_all_signals_is_seen_whatever_channels_an_epoch_has(missing: float) -> None:
    """8 dB less for 150 s, and a share of the observations missing: equal statistics, epoch by epoch."""
    rng, limits = np.random.default_rng(1), InterferenceLimits()
    time = np.datetime64("2024-03-05T00:00:00", "ns") + np.arange(300) * np.timedelta64(1, "s")
    channel = np.array([f"G{k + 1:02d}1C" for k in range(12)])
    cn0 = 40.0 + rng.normal(0.0, 0.5, (300, 12))
    cn0[150:] -= 8.0
    cn0[rng.random(cn0.shape) < missing] = np.nan
    gain = np.full(300, np.nan)
    whole, _ = power_signs(time, channel, cn0, gain, PowerState(), limits)
    state, found = PowerState(), []
    for k in range(300):
        seen = np.flatnonzero(np.isfinite(cn0[k]))[::-1]  # in another order, too
        signs, state = power_signs(time[k : k + 1], channel[seen], cn0[k : k + 1, seen], gain[:1], state, limits)
        found.append([signs.fall_db[0], signs.spread_db[0], signs.difference_db[0]])
    expected = np.array([whole.fall_db, whole.spread_db, whole.difference_db]).T
    np.testing.assert_allclose(np.array(found), expected, rtol=0.0, atol=1e-9)
    jammed = (whole.fall_db >= limits.fall_db) & (whole.spread_db <= limits.spread_db)
    assert jammed[150:].sum() >= (150 if missing <= 0.1 else 145)
    assert not jammed[:150].any()


def test_a_channel_is_forgotten_by_its_age_alone() -> None:
    """A peak that has decayed by 100 dB is below every C/N0: then the channel leaves the state."""
    limits = InterferenceLimits()
    start = np.datetime64("2024-03-05T00:00:00", "ns")
    state = PowerState()
    for minute, names, kept in ((0, ["G01", "G02"], 2), (90, ["G02"], 2), (101, ["G02"], 1)):
        time = np.array([start + np.timedelta64(minute, "m")])
        _, state = power_signs(time, np.array(names), np.full((1, len(names)), 45.0), np.full(1, np.nan), state, limits)
        assert len(state.channel) == kept


def test_channels_of_a_chunk_and_of_states_are_joined() -> None:
    """Two states with other channels in another order, one of which is too old to matter."""
    states = [np.array(["G05", "G01", "G09"]), np.array(["E01", "G05"])]
    joined = join_channels(np.array(["G01", "G02"]), states, [np.array([True, True, False]), None])
    assert joined.channel.tolist() == ["G01", "G02", "G05", "E01"]
    assert joined.present == 2
    assert [place.tolist() for place in joined.places] == [[1, -1, 0, -1], [-1, -1, 1, 0]]
    values = np.array([[5.0, 1.0, 9.0], [50.0, 10.0, 90.0]])
    np.testing.assert_array_equal(joined.arrange(values, -1.0), [[1, -1, 5, -1], [10, -1, 50, -1]])
    np.testing.assert_array_equal(joined.arrange(np.array([7, 8]), 0, 1), [0, 0, 8, 7])
    np.testing.assert_array_equal(joined.widen(np.array([[1, 2]]), 0), [[1, 2, 0, 0]])
    alone = join_channels(np.array(["G01", "G02"]), [np.array(["G02", "G01"])])
    assert alone.channel.tolist() == ["G01", "G02"]
    assert alone.widen(np.ones((3, 2)), 0.0).shape == (3, 2)
