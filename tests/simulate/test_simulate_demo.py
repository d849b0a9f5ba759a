"""The shipped run: what its command makes again, and found where it is installed."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from conftest import ROOT
from railfix.cli import app
from railfix.core.errors import InputFileError
from railfix.io import read_navigation, read_observations
from railfix.simulate import DEMO_FILES, Scenario, demo_files, demo_folder, demonstration, write_run
from railfix.track import read_track
from railfix.track.vehicle import antenna_trajectory, read_vehicle

pytestmark = pytest.mark.requirement("D4")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made") / "data" / "demo"
    done = CliRunner().invoke(app, ["simulate", "demo", "--out", str(folder)])
    assert done.exit_code == 0, done.output
    return folder


def test_the_data_are_small_and_stand_where_they_are_looked_for() -> None:
    files = [p for p in (ROOT / "data").rglob("*") if p.is_file()]
    assert sum(p.stat().st_size for p in files) < 3_000_000
    assert demo_folder() == ROOT / "data" / "demo"
    assert all(path.is_file() for path in demo_files().values())
    names = {p.name for p in demo_folder().iterdir()}
    assert set(DEMO_FILES.values()) <= names <= {*DEMO_FILES.values(), "sections.csv", "scenario.toml"}


def test_the_command_makes_the_shipped_run_again(made: Path) -> None:
    """Value for value: another build of numpy may differ in the last bit, and zlib in the packed bytes."""
    shipped = demo_files()
    for name in ("front", "rear"):
        a, b = read_observations(shipped[name]), read_observations(made / DEMO_FILES[name])
        assert (a.time == b.time).all()
        assert (a.satellite == b.satellite).all()
        for field in ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz"):
            np.testing.assert_allclose(getattr(a, field), getattr(b, field), rtol=0, atol=2.1e-3)
    a, b = (read_navigation(p).kepler for p in (shipped["nav"], made / DEMO_FILES["nav"]))
    np.testing.assert_allclose(a.m0, b.m0, rtol=1e-11)
    truth = [pl.read_csv(p) for p in (shipped["truth"], made / DEMO_FILES["truth"])]
    assert truth[0]["time_gpst"].equals(truth[1]["time_gpst"])
    assert (truth[0]["chainage_m"] - truth[1]["chainage_m"]).abs().max() < 1e-3
    for name in ("track", "vehicle"):
        assert shipped[name].read_text() == (made / DEMO_FILES[name]).read_text()
    settings = [p.read_text().split("| setting |")[1] for p in (shipped["readme"], made / DEMO_FILES["readme"])]
    assert set(settings[0].splitlines()) <= set(settings[1].splitlines()), "a setting has another default now"


def test_the_same_scenario_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_run(Scenario(duration_s=3.0), tmp_path / name)
    for file in DEMO_FILES.values():
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    write_run(Scenario(duration_s=3.0), tmp_path / "c", packing="plain")
    for name in ("nav.rnx", "truth.csv"):
        assert gzip.decompress((tmp_path / "a" / f"{name}.gz").read_bytes()) == (tmp_path / "c" / name).read_bytes()


def test_the_truth_lies_on_the_trajectory_of_the_map() -> None:
    """Chainage means the same in the truth and in what railfix computes from map and vehicle."""
    files = demo_files()
    track, vehicle = read_track(files["track"]), read_vehicle(files["vehicle"])
    truth = pl.read_csv(files["truth"])
    for name in ("front", "rear"):
        path = antenna_trajectory(track, vehicle, name)  # type: ignore[arg-type]
        mine = truth.filter(pl.col("antenna") == name)
        arc, apart = path.nearest(mine.select("x_m", "y_m", "z_m").to_numpy())
        assert apart.max() < 0.03
        assert np.abs(path.chainage_at(arc) - mine["chainage_m"].to_numpy()).max() < 0.01
        assert np.abs(path.kilometrage_at(arc) - mine["kilometrage_m"].to_numpy()).max() < 0.01
    both = truth.pivot(on="antenna", index="time_gpst", values=["x_m", "y_m", "z_m"])
    apart = sum((both[f"{a}_front"] - both[f"{a}_rear"]) ** 2 for a in ("x_m", "y_m", "z_m")) ** 0.5
    # The clocks tag instants a fraction of a millisecond apart.
    assert (apart - 18.2).abs().max() < 0.005


def test_a_missing_demonstration_is_one_clear_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demonstration, "__file__", str(tmp_path / "src" / "railfix" / "simulate" / "demonstration.py"))
    with pytest.raises(InputFileError, match="install railfix again"):
        demo_folder()
    installed = tmp_path / "src" / "railfix" / "_demo"
    installed.mkdir(parents=True)
    with pytest.raises(InputFileError, match=r"front\.crx\.gz.*incomplete"):
        demo_folder()
    for name in DEMO_FILES.values():
        (installed / name).touch()
    assert demo_folder() == installed
