"""Every column of every table, of a log whole and cut, whatever channels each epoch has (requirement A8)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

import recordings_truth
from live_batch import chunks_of, differences, epochs_of, tables_of, thinned
from pipeline_cases import clean_trajectories, demo_observations
from railfix.cli import app
from railfix.core.channel_state import join_channels
from railfix.gnss.observations import Observations
from railfix.integrity.interference.limits import InterferenceLimits, PowerState, power_signs
from railfix.io import read_navigation, read_observations
from railfix.io.rinex.write import write_observations
from railfix.pipeline.config import Config
from railfix.pipeline.processor import EpochProcessor
from railfix.simulate.demonstration import demo_files
from railfix.track import from_positions
from railfix.track.point_files import write_track_csv
from ubx_made import log_of

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
    logs = {name: thinned(log[300:360], 0.05, seed=k) for k, (name, log) in enumerate(demo_observations().items(), 1)}
    whole = check(demo_processor(), logs, odd=False)
    assert whole["train"]["chainage_m"].is_not_nan().sum() > 90


def write_recording(name: str, recordings: Path, folder: Path) -> tuple[dict[str, Observations], list[str]]:
    """Logs of a recording by antenna, and the words of a command that name its navigation, map and vehicle."""
    if name == "demonstration":
        files = demo_files()
        logs = {antenna: read_observations(files[antenna]) for antenna in ("front", "rear")}
        return logs, ["--nav", str(files["nav"]), "--track", str(files["track"]), "--vehicle", str(files["vehicle"])]
    if name == "japan":
        source = next((recordings / "kinematic").glob("japan_mosaic*"))
        log, nav, truth = source / "SEPT265G.21O", source / "SEPT2650.21P", recordings_truth.japan_truth(recordings)
    else:
        source = recordings / "kinematic" / "urbannav_tst"
        log, nav = source / f"20210517.light-urban.tste.ublox.{name}.obs", source / "hksc137c.nav"
        truth = recordings_truth.urbannav_truth(source)
    write_track_csv(from_positions(*truth, spacing_m=5.0), folder / "track.csv")
    return {"front": read_observations(log)}, ["--nav", str(nav), "--track", str(folder / "track.csv")]


def write_log(log: Observations, folder: Path, antenna: str, *, bit_errors: float | None) -> Path:
    """Write a log as RINEX, or as UBX with a share of its bytes changed by a bit."""
    if bit_errors is None:
        write_observations(log, path := folder / f"{antenna}.obs")
        return path
    data, rng = np.frombuffer(log_of(log), dtype=np.uint8).copy(), np.random.default_rng(len(log))
    wrong = np.flatnonzero(rng.random(len(data)) < bit_errors)
    data[wrong] ^= 1 << rng.integers(0, 8, len(wrong)).astype(np.uint8)
    (path := folder / f"{antenna}.ubx").write_bytes(data.tobytes())
    return path


def tables_by_command(folder: Path, name: str, words: list[str]) -> dict[str, pl.DataFrame]:
    """Tables that a command writes."""
    out = folder / name
    done = CliRunner().invoke(app, [*words, "--out", str(out)])
    assert done.exit_code == 0, done.output
    return {path.stem: pl.read_parquet(path) for path in out.glob("*.parquet")}


#: Recording, epochs, share of observations that are missing, bit errors: short stretches, and (slow) the whole; of the
#: demonstration with its 10 Hz three minutes.
SHORT = [
    ("m8t.GC", slice(100, 150), 0.1, None),
    ("f9p", slice(100, 140), 0.02, 1e-4),
    ("japan", slice(100, 140), 0.02, None),
    ("demonstration", slice(300, 340), 0.02, None),
]
WHOLE = [
    (name, slice(300, 2100) if name == "demonstration" else slice(None), share, bit_errors)
    for name in ("m8t.GC", "f9p", "japan", "demonstration")
    for share, bit_errors in ((0.0, None), (0.02, None), (0.1, None), (0.0, 1e-4), (0.02, 1e-4))
]


@pytest.mark.parametrize(
    ("name", "epochs", "share", "bit_errors"),
    [*SHORT, *(pytest.param(*case, marks=pytest.mark.slow) for case in WHOLE)],
)
def test_run_whole_run_epoch_by_epoch_and_live_write_equal_tables(
    recordings: Path, tmp_path: Path, name: str, epochs: slice, share: float, bit_errors: float | None
) -> None:
    """All columns, by the commands, whatever is missing: single observations, epochs, satellites for a while."""
    logs, words = write_recording(name, recordings, tmp_path)
    for k, (antenna, log) in enumerate(logs.items(), 1):
        piece = thinned(log[epochs], share, seed=k)
        words += [f"--{antenna}", str(write_log(piece, tmp_path, antenna, bit_errors=bit_errors))]
    whole = tables_by_command(tmp_path, "whole", ["run", *words, "--observations"])
    assert {"positions", "observations", "train"} <= whole.keys()
    assert whole["train"]["chainage_m"].is_not_nan().sum() > 20
    single = tables_by_command(tmp_path, "single", ["run", *words, "--observations", "--chunk", "1"])
    assert differences(whole, single, ROUNDING_M) == {}
    live = tables_by_command(tmp_path, "live", ["live", *words, "--send", f"json@{tmp_path / 'messages'}"])
    del whole["observations"]  # a live session keeps none
    assert differences(whole, live, ROUNDING_M) == {}


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
