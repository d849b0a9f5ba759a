"""SBAS in live operation: the stream's own messages correct as the log of the same messages does."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

import railfix
from railfix.cli import app
from railfix.core.errors import SettingsError
from railfix.core.geodesy import geodetic_from_ecef
from railfix.live.state_values import decode, encode
from railfix.pipeline.config import parse_config
from railfix.pipeline.level_stage import get_risk_budget
from railfix.ranges.sbas import SbasMessages, SbasState, read_sbas
from railfix.ranges.sbas.messages import with_parity
from railfix.run.processor_setup import make_processor
from ubx_made import log_of

pytestmark = [pytest.mark.requirement("A8"), pytest.mark.requirement("C1")]
RUNNER = CliRunner(env={"COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1"})
EPOCHS = 220


@pytest.fixture(scope="module")
def log(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The recording with MSAS as one UBX stream, and a line through its first place."""
    source, folder = recordings / "sbas" / "msas_20080526_crescent", tmp_path_factory.mktemp("sbas")
    observations = railfix.read_observations(source / "cres_20080526.bin.obs")[:EPOCHS]
    messages = read_sbas(source / "cres_20080526.bin.sbs").of(137)
    path = folder / "log.ubx"
    # Whole messages with their parity, as receivers pass them on.
    same = ("time", "prn", "type", "parity_bits", "source", "line")
    rows = SbasMessages(**{name: getattr(messages, name) for name in same}, bits=with_parity(messages.bits))
    path.write_bytes(log_of(observations, rows))
    latitude, longitude, height = (float(v) for v in geodetic_from_ecef(observations.header.approximate_ecef_m))
    line = folder / "line.csv"
    points = [f"{latitude + 2e-5 * k:.9f},{longitude + 2e-5 * k:.9f},{height:.3f}" for k in range(-100, 101)]
    line.write_text("# crs: EPSG:4979\nlatitude_deg,longitude_deg,height_m\n" + "\n".join(points) + "\n")
    return {"log": path, "line": line, "nav": source / "cres_20080526.bin.nav"}


def results(log: dict[str, Path], out: Path, command: str, *words: str) -> pl.DataFrame:
    common = ["--front", str(log["log"]), "--nav", str(log["nav"]), "--track", str(log["line"]), "--out", str(out)]
    done = RUNNER.invoke(app, [command, *common, "--filter", "off", "--set", "elevation.mask_deg=10", *words])
    assert done.exit_code == 0, done.output
    return pl.read_parquet(out / "positions.parquet").sort("time_gpst")


@pytest.mark.slow
def test_live_with_sbas_is_the_run_with_the_log(log: dict[str, Path], tmp_path: Path) -> None:
    """Positions, statuses and levels of three ways to the same messages, within 1e-9 m."""
    prn = ["--set", "sbas_prn=137"]
    batch = results(log, tmp_path / "run", "run", "--sbas", str(log["log"]), *prn)
    own = results(log, tmp_path / "own", "run", "--sbas", "stream", *prn)
    messages = ["--send", f"json@{tmp_path / 'messages.jsonl'}", "--live", "no_input=skip", "--live", "period_s=1"]
    live = results(log, tmp_path / "live", "live", "--sbas", "stream", *prn, *messages)
    assert live.height == batch.height == own.height == EPOCHS
    for rows in (own, live):
        assert rows["status"].equals(batch["status"])
        for name in ("chainage_m", "along_sigma_m", "protection_level_m", "conventional_chainage_m"):
            if name in batch.columns:
                a, b = rows[name].to_numpy(), batch[name].to_numpy()
                finite = np.isfinite(b)
                assert np.array_equal(np.isfinite(a), finite), name
                assert np.abs(a[finite] - b[finite]).max() < 1e-9, name
    placed = np.isfinite(batch["chainage_m"].to_numpy())
    assert 20 < placed.sum() < EPOCHS - 20  # none before the corrections are complete
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["protection"]["kind"] == "sbas"


def test_what_sbas_in_live_needs(log: dict[str, Path], tmp_path: Path) -> None:
    common = ["--front", str(log["log"]), "--track", str(log["line"])]
    best = RUNNER.invoke(app, ["live", *common, "--sbas", "stream"])
    assert best.exit_code == 4
    assert "give its PRN" in best.output
    recorded = RUNNER.invoke(app, ["live", *common, "--sbas", str(log["log"])])
    assert recorded.exit_code == 4
    assert "--sbas stream" in recorded.output
    rinex = tmp_path / "log.rnx"
    railfix.write_observations(railfix.read_observations(log["log"])[:5], rinex)
    words = ["run", "--front", str(rinex), "--nav", str(log["nav"]), "--track", str(log["line"])]
    words += ["--out", str(tmp_path)]
    nothing = RUNNER.invoke(app, [*words, "--sbas", "stream", "--set", "sbas_prn=137"])
    assert nothing.exit_code == 4
    assert "RINEX logs contain no SBAS" in nothing.output


def test_messages_of_two_receivers_count_once(log: dict[str, Path]) -> None:
    """Both antennas' receivers pass on the same message, some tenths of a second apart."""
    messages = read_sbas(log["log"])
    late = replace(messages, time=messages.time + np.timedelta64(300, "ms"))
    state = SbasState(prn=137)
    for k in range(len(messages)):
        state = state.add_messages(messages.take(np.array([k]))).add_messages(late.take(np.array([k])))
    assert np.array_equal(state.messages.time, messages.time)
    both = read_sbas([log["log"], log["log"]])
    assert len(both) == len(messages)
    assert both.rejected["duplicate"] == len(messages)


def test_without_a_message_every_satellite_is_rejected(log: dict[str, Path]) -> None:
    observations = railfix.read_observations(log["log"])[:3]
    line = {"front": railfix.Trajectory.from_antenna_path(railfix.read_track([log["line"]]))}
    config = railfix.Config(sbas="stream", sbas_prn=137)
    result, _ = make_processor(config, railfix.read_navigation(log["nav"]), line).process({"front": observations})
    assert np.isnan(result.antennas["front"].chainage_m).all()
    with pytest.raises(SettingsError, match="give its PRN"):
        make_processor(railfix.Config(sbas="stream"), railfix.read_navigation(log["nav"]), line)


def test_a_stored_state_has_the_sbas_messages(log: dict[str, Path]) -> None:
    observations, messages = railfix.read_observations(log["log"])[:EPOCHS], read_sbas(log["log"])
    line = {"front": railfix.Trajectory.from_antenna_path(railfix.read_track([log["line"]]))}
    config = parse_config({"sbas": "stream", "sbas_prn": 137, "elevation": {"mask_deg": 10}, "filter": "off"})
    processor = make_processor(config, railfix.read_navigation(log["nav"]), line)
    _, state = processor.process({"front": observations[:150]}, messages=messages)
    (one, _), (other, _) = (processor.process({"front": observations[150:]}, s) for s in (state, decode(encode(state))))
    assert np.array_equal(one.antennas["front"].chainage_m, other.antennas["front"].chainage_m, equal_nan=True)
    assert np.isfinite(one.antennas["front"].chainage_m).sum() > 50


def test_the_budget_beside_sbas_is_one_object_so_that_a_live_epoch_finds_its_allocation_kept() -> None:
    config = parse_config({"filter": "off", "sbas": "stream"})
    assert get_risk_budget(config) is get_risk_budget(config)
    assert set(get_risk_budget(config).satellite_prior.values()) == {0.0}
