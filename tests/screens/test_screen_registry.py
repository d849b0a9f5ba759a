"""A screen of one's own is one module and one entry point: those of docs/screens.md, installed beside railfix."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from conftest import ROOT
from pipeline_cases import clean_navigation, clean_observations, clean_trajectories, processor
from railfix.core.errors import NoPositionError
from railfix.core.reason_names import reason_names, reason_text, screen_reason
from railfix.core.reasons import Reason, Status
from railfix.core.settings import Settings
from railfix.io import read_observations, write_observations
from railfix.pipeline.config import SCREEN_NAMES, Config, parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.run import RunInputs, run_files
from railfix.screens import SCREENS, AntennaRanges, ObservationScreen, Screened, ScreenSetup, Verdict

DEMO = ROOT / "data" / "demo"


def test_names_files_and_settings_are_one() -> None:
    assert tuple(screen.name for screen in SCREENS) == SCREEN_NAMES
    for screen in SCREENS:
        assert type(screen).__module__ == f"railfix.screens.{screen.name}"
        assert getattr(Config(), screen.name) == screen.limits


def test_reasons_of_added_screens_have_bits_of_their_own() -> None:
    assert screen_reason("doppler") is Reason.DOPPLER
    added = screen_reason("test_of_reasons")
    assert screen_reason("test_of_reasons") == added
    assert int(added) > max(int(reason) for reason in Reason)
    assert reason_names()[int(added)] == "test_of_reasons"
    assert reason_text(added | Reason.DOPPLER) == "doppler+test_of_reasons"


def example(folder: Path) -> Path:
    """The screen of docs/screens.md as an installed package: its module, and its entry point."""
    text = (ROOT / "docs" / "screens.md").read_text(encoding="utf-8").split("## Adding a screen")[1]
    (project,) = re.findall(r"```toml\n(.*?)```", text, flags=re.DOTALL)
    module = (ROOT / "docs" / "examples" / "large_sigma.py").read_text(encoding="utf-8")
    (group, names), *others = tomllib.loads(project)["project"]["entry-points"].items()
    assert not others
    (folder / "my_package").mkdir(parents=True)
    (folder / "my_package" / "__init__.py").touch()
    (folder / "my_package" / "large_sigma.py").write_text(module, encoding="utf-8")
    info = folder / "my_package-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 1.0\n")
    lines = [f"[{group}]", *(f"{name} = {place}" for name, place in names.items())]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.requirement("B7")
@pytest.mark.slow
def test_a_screen_of_ones_own_is_one_module_and_one_entry_point(tmp_path: Path) -> None:
    path = os.pathsep.join([str(example(tmp_path / "site")), *sys.path])
    environment = {**os.environ, "PYTHONPATH": path, "COLUMNS": "120"}

    def railfix(*words: object) -> None:
        command = [sys.executable, "-m", "railfix", *map(str, words)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=tmp_path)
        assert done.returncode == 0, done.stdout + done.stderr

    railfix(
        "run", "--front", DEMO / "front.crx.gz", "--nav", DEMO / "nav.rnx.gz", "--track", DEMO / "track.csv",
        "--end", "2024-03-05T03:10:10", "--set", "large_sigma.limit_m=3", "--observations", "--out", tmp_path / "out",
    )  # fmt: skip
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["settings_used"]["large_sigma"] == {"limit_m": 3.0}
    assert record["settings_used"]["screens"][2:5] == ["doppler", "large_sigma", "antenna_pair"]
    rows = pl.read_parquet(tmp_path / "out" / "observations.parquet")
    judged = rows.filter(pl.col("metric_large_sigma_m").is_not_null())
    rejected = judged["reason_text"].str.contains("large_sigma")
    assert 0 < rejected.sum() < len(judged)
    assert (rejected == (judged["metric_large_sigma_m"] > 3.0)).all()
    counts = next(v for k, v in record["antennas"]["front"].items() if re.match("observations.*by_one_reason_alone", k))
    assert counts["large_sigma"] > 0
    railfix("plot-screens", tmp_path / "out", "--out", tmp_path / "pictures")
    assert (tmp_path / "pictures" / "front_large_sigma.png").stat().st_size > 1000


@pytest.mark.requirement("B7")
@pytest.mark.slow
def test_a_package_with_a_wrong_screen_is_named(tmp_path: Path) -> None:
    site = example(tmp_path / "site")
    entry = site / "my_package-1.0.dist-info" / "entry_points.txt"
    module = site / "my_package" / "large_sigma.py"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(site), *sys.path])}

    def said() -> str:
        command = [sys.executable, "-c", "import railfix.screens"]
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
        assert done.returncode == 1
        return done.stderr.splitlines()[-1]

    entry.write_text(entry.read_text().replace(":SCREEN", ":REASON"))
    assert "the entry point large_sigma of the package my-package (group railfix.screens) is Reason, expected" in said()
    entry.write_text(entry.read_text().replace(":REASON", ":SCREEN"))
    module.write_text(module.read_text().replace('name = "large_sigma"', 'name = "doppler"'))
    assert "the package my-package has a screen doppler, a name that is taken" in said()


@pytest.mark.requirement("B7")
def test_a_screen_may_be_given_to_the_processor() -> None:
    """Every range of every third epoch is rejected, as if the receiver had named them."""

    class Limits(Settings):
        every: int = 3

    class EveryThird(ObservationScreen[Limits]):
        name = "every_third"
        limits = Limits()
        needs = "epochs"

        def judge(
            self, antenna: AntennaRanges, limits: Limits, setup: ScreenSetup, state: Any
        ) -> tuple[tuple[Verdict, ...], Any]:
            assert setup.antennas == 1
            metric = np.full(antenna.code_m.shape, 1.0)
            hit = (np.arange(len(metric)) % limits.every == 0)[:, None] & np.isfinite(antenna.code_m)
            return (
                Verdict(name=self.name, reason=Reason.DOPPLER, screened=Screened(metric=metric, reject=hit)),
            ), state

    log = clean_observations()["front"][400:412]
    trajectories = {"front": clean_trajectories()["front"]}
    live = EpochProcessor(Config(), trajectories, navigation=clean_navigation(), screens=(EveryThird(),))
    names = [screen.name for screen, _ in live.screens]
    assert names[:5] == ["elevation", "cn0", "doppler", "every_third", "antenna_pair"]
    found = live.process({"front": log})[0].antennas["front"]
    assert (found.n_used == 0).tolist() == [k % 3 == 0 for k in range(12)]
    assert found.screens["every_third"].reject[0].any()
    taken = EveryThird()
    type(taken).name = "raim"
    with pytest.raises(ValueError, match="a screen named raim exists already"):
        EpochProcessor(Config(), trajectories, navigation=clean_navigation(), screens=(taken,))


@pytest.mark.requirement("B7")
def test_a_note_says_where_a_screen_cannot_judge(tmp_path: Path) -> None:
    """One antenna and a log without Doppler: the screens of two antennas and of the Doppler are named in the notes."""
    log = read_observations(DEMO / "front.crx.gz")[:100]
    silent = replace(log, doppler_hz=np.full_like(log.doppler_hz, np.nan))
    write_observations(silent, tmp_path / "front.rnx")
    inputs = RunInputs(front=(tmp_path / "front.rnx",), nav=(DEMO / "nav.rnx.gz",), track=(DEMO / "track.csv",))
    notes = run_files(inputs, out=tmp_path / "out").notes
    assert any("screen doppler tested nothing; it needs the Doppler" in note for note in notes)
    for name in ("antenna_pair", "antenna_spacing"):
        assert any(f"screen {name} was not run: it needs two antennas" in note for note in notes)
    assert not any("screen elevation" in note for note in notes)


@pytest.mark.requirement("B7")
def test_a_log_without_the_systems_asked_for_is_one_sentence(tmp_path: Path) -> None:
    inputs = RunInputs(front=(DEMO / "front.crx.gz",), nav=(DEMO / "nav.rnx.gz",), track=(DEMO / "track.csv",))
    with pytest.raises(NoPositionError, match="system_not_selected") as caught:
        run_files(inputs, parse_config({"systems": ["C"]}), out=tmp_path / "out")
    assert caught.value.exit_code == 7
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("carrier", ["off", "smoothed", "float"])
def test_epochs_without_any_channel_have_a_status(carrier: str) -> None:
    """A receiver that has lost every satellite, then finds them again."""
    log = clean_observations()["front"]
    nothing = np.zeros((5, 0))
    empty = replace(
        log[100:105], satellite=log.satellite[:0], signal=log.signal[:0], code_m=nothing, phase_cycles=nothing,
        doppler_hz=nothing, cn0_dbhz=nothing, loss_of_lock=nothing.astype(np.uint8),
    )  # fmt: skip
    live = processor({"carrier": carrier})
    result, state = live.process({"front": empty})
    assert (result.antennas["front"].status == Status.NO_OBSERVATION).all()
    later, _ = live.process({"front": log[105:110]}, state)
    assert np.isfinite(later.antennas["front"].chainage_m).all()
