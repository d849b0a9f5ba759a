"""Settings: presets, files, single settings, screens on and off; the command line has the last word."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from broken_bench import Bench, bench_in
from railfix.cli import app
from railfix.cli.options import Choices, resolve_settings
from railfix.core.errors import SettingsError
from railfix.pipeline.config import PRESETS, SCREEN_NAMES, Config, load_config, parse_config

pytestmark = pytest.mark.requirement("G4")

RUNNER = CliRunner(env={"COLUMNS": "150", "TERM": "dumb", "NO_COLOR": "1"})


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return bench_in(tmp_path_factory.mktemp("bench"))


def test_p1_is_table_6_of_the_paper() -> None:
    config = Config(preset="p1")
    assert config.elevation.mask_deg == 20.0
    assert (config.cn0.floor_dbhz, config.cn0.deficit_dbhz) == (30.0, 10.0)
    assert (config.doppler.mode, config.doppler.step_m, config.doppler.hold_s) == ("fixed", 1.5, 0.0)
    assert config.antenna_pair.limit_m == config.antenna_spacing.limit_m == 5.0
    assert config.antenna_pair.clocks == "common"
    assert (config.raim.mode, config.raim.fixed_limit_m2, config.raim.max_excluded) == ("fixed", 100.0, 2)
    assert (config.min_satellites, config.failed_checks) == (3, "drop")
    assert config.screens == SCREEN_NAMES


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_survives_the_way_through_json(name: str) -> None:
    config = parse_config({"preset": name})
    again = parse_config(json.loads(json.dumps(config.as_dict())))
    assert again == config
    assert again.as_dict()["preset"] == name


def test_other_keys_stand_over_the_preset(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text('preset = "p1"\nfailed_checks = "keep"\n[doppler]\nstep_m = 3.0\n[noise]\nfloor_sigma_m = 0.2\n')
    config = load_config(path)
    assert (config.failed_checks, config.doppler.step_m, config.noise.floor_sigma_m) == ("keep", 3.0, 0.2)
    # what the file leaves out in a group stays the preset's, and then the model's own
    assert (config.doppler.mode, config.doppler.hold_s) == ("fixed", 0.0)
    assert config.doppler.factor == Config().doppler.factor
    assert config.cn0.floor_dbhz == 30.0


def test_the_command_line_stands_over_the_file(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text('preset = "p1"\nscreens = ["elevation", "doppler", "raim"]\n[elevation]\nmask_deg = 12.0\n')
    config, asked = resolve_settings(Choices(config=path))
    assert (config.preset, config.screens) == ("p1", ("elevation", "doppler", "raim"))
    config, asked = resolve_settings(
        Choices(config=path, preset="default", setting=("elevation.mask_deg=17",), without=("doppler",))
    )
    assert (config.preset, config.raim.mode, config.elevation.mask_deg) == ("default", "chi_square", 17.0)
    assert config.screens == ("elevation", "raim")
    assert asked["screens"] == ["elevation", "raim"]
    assert resolve_settings(Choices(config=path, screens="cn0"))[0].screens == ("cn0",)
    assert resolve_settings(Choices(config=path, screens="none"))[0].screens == ()
    both = Choices(config=path, screens="cn0, raim,elevation", without=("raim", "cn0"))
    assert resolve_settings(both)[0].screens == ("elevation",)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"elevation": {"mask": 5.0}}, "unknown setting elevation.mask; known are mask_deg"),
        ({"mask_deg": 5.0}, "did you mean 'elevation.mask_deg'?"),
        ({"largest_sigma_m": -1}, "setting largest_sigma_m: Input should be greater than 0, got -1"),
        ({"screens": ("rain",)}, "unknown screen 'rain'; known are elevation"),
    ],
)
def test_wrong_settings_in_python_are_named_as_on_the_command_line(values: dict[str, Any], words: str) -> None:
    with pytest.raises(SettingsError) as of_file:
        parse_config(values, source="Config")
    with pytest.raises(SettingsError) as of_class:
        Config(**values)
    assert str(of_class.value) == str(of_file.value)
    assert words in str(of_class.value)


@pytest.mark.parametrize(
    ("choices", "words"),
    [
        (Choices(screens="elevation,rain"), ["--screens elevation,rain", "'rain'", *SCREEN_NAMES]),
        (Choices(screens=""), ["--screens", *SCREEN_NAMES]),
        (Choices(screens="raim,raim"), ["each screen once"]),
        (Choices(without=("dopler",)), ["--without dopler", *SCREEN_NAMES]),
        (Choices(preset="P1"), ["--preset P1", "default", "p1"]),
        (Choices(setting=("preset=p2",)), ["preset", "'p1'"]),
        (Choices(setting=("screens=['rain']",)), ["screens", "unknown screen 'rain'", "raim"]),
    ],
)
def test_what_is_misspelt_is_named_with_what_is_known(choices: Choices, words: list[str]) -> None:
    with pytest.raises(SettingsError) as error:
        resolve_settings(choices)
    assert [word for word in words if word not in str(error.value)] == []


def run(bench: Bench, out: Path, *options: str) -> tuple[int, str]:
    files = ["--front", bench.front, "--rear", bench.rear, "--nav", bench.nav, "--track", bench.track]
    command = ["run", *map(str, files), "--vehicle", str(bench.vehicle), "--out", str(out), *options]
    result = RUNNER.invoke(app, command)
    return result.exit_code, result.output


def record_of(out: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((out / "run.json").read_text())
    return loaded


def test_screens_asked_for_and_used_stand_side_by_side(bench: Bench, tmp_path: Path) -> None:
    code, output = run(bench, tmp_path / "a", "--preset", "p1", "--without", "antenna_pair", "--without", "cn0")
    assert code == 0, output
    record = record_of(tmp_path / "a")
    left = ["elevation", "doppler", "raim", "antenna_spacing"]
    assert record["settings_asked"] == {"preset": "p1", "screens": left}
    assert record["settings_used"]["screens"] == left
    assert record["settings_used"]["raim"]["mode"] == "fixed"
    refused = record["antennas"]["front"]["observations_rejected_by_first_reason"]
    assert "doppler" in refused
    assert "antenna_pair" not in refused


def test_a_screen_that_is_off_refuses_nothing(bench: Bench, tmp_path: Path) -> None:
    code, output = run(bench, tmp_path / "a", "--screens", "none")
    assert code == 0, output
    refused = record_of(tmp_path / "a")["antennas"]["front"]["observations_rejected_by_first_reason"]
    assert set(refused) <= {"unhealthy", "no_ephemeris", "ephemeris_too_old", "no_correction", "other_signal_taken"}


def test_the_curve_is_named_on_the_command_line(bench: Bench, tmp_path: Path) -> None:
    code, output = run(bench, tmp_path / "a", "--cn0-curve", str(tmp_path / "none.toml"))
    assert code == 3
    assert "none.toml" in output
    assert run(bench, tmp_path / "a", "--screens", "rain")[0] == 4
    assert not (tmp_path / "a").exists()
