"""``railfix convert``: what is written reads back as what was logged; RTKLIB reads it too."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import railfix
from railfix.cli import app
from railfix.core.geodesy import geodetic_from_ecef
from railfix.io import read_positions, rinex

pytestmark = pytest.mark.requirement("A8")
RUNNER = CliRunner(env={"COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1"})
COLD_START = "16dBatt_no_interference_coldstart.ubx.gz"


@pytest.mark.parametrize("version", ["3", "4"])
@pytest.mark.every(3)
def test_a_log_comes_back_from_rinex(recordings: Path, tmp_path: Path, version: str) -> None:
    log = recordings / "live" / COLD_START
    out, nav = tmp_path / "log.crx.gz", tmp_path / "log.nav.gz"
    done = RUNNER.invoke(app, ["convert", str(log), "--out", str(out), "--nav-out", str(nav), "--rinex", version])
    assert done.exit_code == 0, done.output
    assert "562 epochs" in done.output
    assert "28 ephemerides" in done.output
    logged, written = railfix.read_observations(log), railfix.read_observations(out)
    assert written.header.version == (3.04 if version == "3" else 4.02)
    assert np.array_equal(logged.time, written.time)
    assert logged.satellite.tolist() == written.satellite.tolist()
    for name in ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz"):
        assert np.allclose(getattr(logged, name), getattr(written, name), rtol=0.0, atol=0.00051, equal_nan=True)
    ours, theirs = railfix.read_navigation(log).kepler, rinex.read_navigation(nav).kepler
    order = np.lexsort((ours.satellite, ours.toc))
    assert ours.satellite[order].tolist() == theirs.satellite.tolist()
    assert ours.message[order].tolist() == theirs.message.tolist()
    for name in ("m0", "sqrt_a", "af0_s", "toe_sow_s", "group_delay_1_s"):
        assert np.allclose(getattr(ours, name)[order], getattr(theirs, name), rtol=1e-11, atol=0.0)
    assert ours.toe[order].tolist() == theirs.toe.tolist()


def test_refusals(recordings: Path, tmp_path: Path) -> None:
    log, out = recordings / "live" / COLD_START, tmp_path / "log.rnx"
    assert RUNNER.invoke(app, ["convert", str(log)]).exit_code == 4
    out.write_text("mine")
    refused = RUNNER.invoke(app, ["convert", str(log), "--out", str(out)])
    assert refused.exit_code == 8
    assert out.read_text() == "mine"


@pytest.mark.slow
def test_a_run_on_a_receiver_log(recordings: Path, tmp_path: Path) -> None:
    """A log in UBX gives the positions of the RINEX file converted from it."""
    log = recordings / "live" / COLD_START
    place = railfix.read_observations(log)
    assert len(place) == 562
    line = tmp_path / "line.csv"
    fixes = read_positions(log)
    assert (len(fixes), fixes.quality.tolist()) == (552, [5] * 552)  # from the first fix on
    latitude, longitude, height = (np.median(v) for v in geodetic_from_ecef(fixes.ecef_m))
    rows = [f"{latitude + 2e-5 * k:.9f},{longitude + 3e-5 * k:.9f},{height:.3f}" for k in range(-100, 101)]
    line.write_text("latitude_deg,longitude_deg,height_m\n" + "\n".join(rows) + "\n")
    converted, nav = tmp_path / "log.rnx", tmp_path / "log.nav"
    RUNNER.invoke(app, ["convert", str(log), "--out", str(converted), "--nav-out", str(nav)])
    results = {}
    for name, front, records in (("ubx", log, log), ("rinex", converted, nav)):
        words = ["run", "--front", str(front), "--nav", str(records), "--track", str(line)]
        done = RUNNER.invoke(app, [*words, "--out", str(tmp_path / name)])
        assert done.exit_code == 0, done.output
        import polars as pl

        results[name] = pl.read_parquet(tmp_path / name / "positions.parquet")
    a, b = (results[name]["chainage_m"].to_numpy() for name in ("ubx", "rinex"))
    assert np.isfinite(a).mean() > 0.9
    assert np.nanmax(np.abs(a - b)) < 0.002
    # The receiver's own position lies on the line at its middle.
    middle = float(results["ubx"]["chainage_m"].drop_nans().median())
    assert abs(middle - 100 * np.hypot(2e-5 * 111_200, 3e-5 * 111_320 * np.cos(np.radians(latitude)))) < 5.0
