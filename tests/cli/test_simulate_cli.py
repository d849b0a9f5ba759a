"""``railfix simulate``: what it writes, what it refuses and how."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from railfix.cli import app
from railfix.io import read_observations
from railfix.simulate import demo_files, list_scenarios, load_scenario
from railfix.track import read_track

pytestmark = pytest.mark.requirement("D4")

RECIPE = """
description = "two short runs"
base = "base.toml"

[parts.falling]
run.direction = "falling"

[[runs]]
name = "one"
seed = 1

[[runs]]
name = "two"
parts = ["falling"]
seed = 2
"""


def call(*words: object) -> tuple[int, str]:
    """Exit code, and what was said."""
    done = CliRunner().invoke(app, ["simulate", *map(str, words)])
    return done.exit_code, done.output


def test_the_command_takes_its_options(tmp_path: Path) -> None:
    settings = {
        "rate_hz": 5, "line.length_m": 2000, "receiver.clocks": "common", "sky.systems": "GC",
        "sky.satellites_at_most": 9, "receiver.signals_per_satellite": 2,
    }  # fmt: skip
    sets = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
    code, said = call("demo", "--out", tmp_path, "--seconds", 2, "--seed", 7, "--plain", *sets)
    assert code == 0, said
    observed = read_observations(tmp_path / "front.rnx")
    assert len(observed) == 10
    seen = np.isfinite(observed.code_m)
    satellites = {s: seen[:, observed.satellite == s].any(axis=1) for s in np.unique(observed.satellite)}
    assert (sum(v.astype(int) for v in satellites.values()) == 9).all()
    assert set(observed.system) == {"G", "C"}
    assert set(observed.signal) == {"1C", "2L", "2I", "6I"}
    assert read_track(tmp_path / "track.csv").chainage_m[-1] == pytest.approx(2000.0, abs=0.05)
    assert load_scenario(tmp_path / "scenario.toml").seed == 7
    assert "20 antenna-epochs" in said
    assert f"`railfix simulate demo --out {tmp_path} --seconds 2.0 --seed 7" in (tmp_path / "README.md").read_text()


def test_the_written_scenario_makes_the_same_run(tmp_path: Path) -> None:
    switched_on = [
        "--set",
        "sensors.tachometer.jitter_s=1e-6",
        "--set",
        'environment.sections=[{from_m=0, to_m=400, kind="urban"}]',
    ]
    assert call("demo", "--out", tmp_path / "a", "--seconds", 3, *switched_on)[0] == 0
    assert call(tmp_path / "a" / "scenario.toml", "--out", tmp_path / "b")[0] == 0
    names = {p.name for p in (tmp_path / "a").iterdir()}
    assert names >= {"front.crx.gz", "sections.csv", "tachometer.parquet", "inertial.parquet", "radar.parquet"}
    for name in names - {"README.md"}:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    assert pl.read_csv(tmp_path / "a" / "sections.csv")["environment"].to_list() == ["urban", "open"]


def test_a_recipe_makes_each_run_in_its_folder(tmp_path: Path) -> None:
    (tmp_path / "base.toml").write_text("duration_s = 2.0\nrun.first_stand_s = 0.0\n")
    (tmp_path / "recipe.toml").write_text(RECIPE)
    out = tmp_path / "out"
    code, said = call(tmp_path / "recipe.toml", "--out", out)
    assert code == 0, said
    assert sorted(p.name for p in out.iterdir()) == ["one", "two"]
    speed = {name: pl.read_csv(out / name / "truth.csv.gz")["speed_mps"][-1] for name in ("one", "two")}
    assert speed["one"] > 0.5
    assert speed["two"] < -0.5
    code, said = call(tmp_path / "recipe.toml", "--out", tmp_path / "only", "--only", 2, "--only", "two")
    assert code == 0, said
    assert [p.name for p in (tmp_path / "only").iterdir()] == ["two"]
    for file in ("front.crx.gz", "truth.csv.gz"):
        assert (tmp_path / "only" / "two" / file).read_bytes() == (out / "two" / file).read_bytes()


def test_shipped_scenarios_are_listed_and_can_be_read() -> None:
    code, said = call("--list")
    assert code == 0
    assert [line.split()[0] for line in said.splitlines()] == list(list_scenarios())
    for name, path in list_scenarios().items():
        assert f"{name} " in said
        assert len(tomllib.loads(path.read_text())["description"]) > 20


def test_exit_codes(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "front.crx.gz").write_text("mine")
    (tmp_path / "broken.toml").write_text("seed = ")
    (tmp_path / "wrong.toml").write_text("sede = 1")
    (tmp_path / "no_nav.toml").write_text('[sky]\nnav = "none.nav"\nunhealthy = []')
    out = tmp_path / "out"
    past = ("--set", "sky.unhealthy=[]", "--set", "start=2024-01-01T00:00:00")
    cases = [
        (8, ("demo", "--out", tmp_path / "file", "--seconds", 1), "file"),
        (8, ("demo", "--out", tmp_path / "full"), "not empty"),
        (4, ("demo", "--out", out, "--seconds", -1), "--seconds: Input should be greater than 0"),
        (4, ("demo", "--out", out, "--set", "sky.systems=Q"), "sky.systems"),
        (4, ("demo", "--out", out, "--set", "sky.sistems=G"), "known are cutoff_deg"),
        (4, (tmp_path / "wrong.toml", "--out", out), "known are duration_s"),
        (4, ("demo", "--out", out, "--only", 1), "single run"),
        (4, ("p1-commercial", "--out", out, "--only", 9), "no such run"),
        (3, (tmp_path / "broken.toml", "--out", out), "TOML"),
        (3, ("nothing", "--out", out), "shipped scenario: "),
        (3, (tmp_path / "no_nav.toml", "--out", out), str(tmp_path / "none.nav")),
        (5, ("demo", "--out", out, "--set", f"sky.nav={demo_files()['nav']}", *past), "no satellite of"),
        (2, ("demo",), "--out"),
        (2, ("--unknown",), "unknown"),
    ]
    for expected, words, told in cases:
        code, said = call(*words)
        assert code == expected, (words, said)
        assert told in said.replace("\n", ""), (words, said)
    assert not out.exists()
    assert (tmp_path / "full" / "front.crx.gz").read_text() == "mine"
    assert call("demo", "--out", tmp_path / "full", "--seconds", 1, "--overwrite")[0] == 0
    assert len(read_observations(tmp_path / "full" / "front.crx.gz")) == 10
