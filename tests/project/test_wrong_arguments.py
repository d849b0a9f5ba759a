"""Arguments of functions in Python: wrong ones are one sentence, paths may be texts."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import railfix
from railfix.cli.ground import app
from railfix.report import plots
from railfix.simulate import Scenario
from railfix.track.trajectory import TRACK_AS_PATH
from railfix.track.vector_file import read_layers

pytestmark = pytest.mark.requirement("G4")
FILES = railfix.demo_files()


def test_another_reader_is_named() -> None:
    with pytest.raises(ValueError, match="reader is 'pandas', 'railfix' or 'georinex' was expected"):
        railfix.read_observations(FILES["front"], reader="pandas")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="GPS time has none"):
        railfix.read_observations(FILES["front"], start="2024-03-05T03:11:00Z")


@pytest.fixture(scope="module")
def made() -> dict[str, Any]:
    """Objects of the demonstration run, and a processor with its result."""
    track, vehicle = railfix.read_track(FILES["track"]), railfix.read_vehicle(FILES["vehicle"])
    navigation, log = railfix.read_navigation(FILES["nav"]), railfix.read_observations(FILES["front"])[:5]
    path, config = railfix.antenna_trajectory(track, vehicle), railfix.Config()
    processor = railfix.EpochProcessor(config, {"front": path}, navigation=navigation)
    result, state = processor.process({"front": log})
    return locals()


#: Calls with a wrong argument, and the sentence that follows.
WRONG: dict[str, tuple[Callable[..., object], str]] = {
    **{
        f"{read}({value!r})": (lambda _, read=read, value=value: getattr(railfix, read)(value), "expected.*, got")
        for read in "read_observations read_navigation read_track read_vehicle read_sbas read_sp3 read_positions "
        "load_config load_scenario scan_observations".split()
        for value in (None, 3)
    },
    "no file": (lambda _: railfix.read_track([]), "no file was given"),
    "no trajectory": (lambda m: railfix.EpochProcessor(m["config"], {}), "pass one or more by name of the antenna"),
    "path alone": (lambda m: railfix.EpochProcessor(m["config"], m["path"]), "pass one or more by name of the antenna"),
    "another antenna": (lambda m: railfix.EpochProcessor(m["config"], {"middle": m["path"]}), "front and rear"),
    "a track": (lambda m: railfix.EpochProcessor(m["config"], {"front": m["track"]}), "; antenna_trajectory returns"),
    "a dictionary": (lambda m: railfix.EpochProcessor({}, {"front": m["path"]}), "config: expected Config, got dict"),
    **{
        f"{name} of another type": (
            lambda m, name=name: railfix.EpochProcessor(m["config"], {"front": m["path"]}, **{name: "file"}),
            f"{name}: expected .*, got str",
        )
        for name in ("navigation", "models", "stations")
    },
    "name of a screen": (
        lambda m: railfix.EpochProcessor(m["config"], {"front": m["path"]}, screens=["cn0"]), "screens: expected Screen"
    ),
    "no navigation": (
        lambda m: railfix.EpochProcessor(m["config"], {"front": m["path"]}).process({"front": m["log"]}),
        r"no navigation records: EpochProcessor\(\.\.\., navigation=read_navigation\(file\)\)$",
    ),
    "no log": (lambda m: m["processor"].process({}), "one log for each antenna, and at least one"),
    "log alone": (lambda m: m["processor"].process(m["log"]), "one log for each antenna, and at least one"),
    "path of a log": (lambda m: m["processor"].process({"front": "a.obs"}), "; read_observations returns one"),
    "log of another antenna": (lambda m: m["processor"].process({"rear": m["log"]}), "no trajectory for antenna rear"),
    "another state": (lambda m: m["processor"].process({"front": m["log"]}, m["result"]), "state: expected State"),
    **{
        f"later {name} of another type": (
            lambda m, name=name: m["processor"].process({"front": m["log"]}, **{name: "file"}),
            f"{name}: expected .*, got str",
        )
        for name in ("navigation", "sensors", "base")
    },
    "vehicle before track": (lambda m: railfix.antenna_trajectory(m["vehicle"], m["track"]), "expected Track, got Veh"),
    "no vehicle": (lambda m: railfix.antenna_trajectory(m["track"], None), "got NoneType; read_vehicle returns one"),
    "path of a track": (lambda _: railfix.Trajectory.from_antenna_path("a.csv"), "; read_track returns one"),
    **{
        f"{table} of one antenna": (lambda m, table=table: getattr(railfix, table)(m["result"]["front"]), "got Ant")
        for table in ("train_table", "positions_table", "observations_table")
    },
    "both antennas": (lambda m: railfix.to_xarray(m["result"]), "expected AntennaResult, got Result"),
    "check of a path": (lambda _: railfix.check_track("a.csv"), "; read_track returns one"),
    "writing a path": (lambda m: railfix.write_track_csv("a.csv", m["track"]), "expected Track, got str"),
    "records of a path": (lambda _: railfix.write_navigation("a.nav", "b.nav"), "; read_navigation returns one"),
    "observations of a path": (lambda _: railfix.write_observations(Path("a"), "b.obs"), "expected Observations"),
    "one part": (lambda m: railfix.concatenate(m["log"]), "expected Sequence, got Observations"),
    "part of another type": (lambda _: railfix.concatenate(["a.obs"]), "; read_observations returns one"),
    "inputs of another type": (lambda _: railfix.run_files({}, out=Path("out")), "expected RunInputs, got dict"),
    "inputs without navigation": (
        lambda _: railfix.RunInputs(front=FILES["front"], track=FILES["track"]), r"nav \(--nav\) is missing"
    ),
    "name of a run": (lambda _: railfix.evaluate_runs(["run"]), "expected RunAndReference, got str"),
    "report on a result": (lambda m: railfix.write_report([m["result"]], "a.html"), "expected a path or several paths"),
    "picture of a result": (lambda m: plots.plot_plan(m["result"]), "expected a polars table, got Result; give p"),
    "picture without errors": (
        lambda m: plots.plot_error_over_time(railfix.positions_table(m["result"])), "the table lacks a column"
    ),
    "scenario by name": (lambda _: railfix.write_run("city", "out"), "; load_scenario returns one"),
    "dataset by name": (lambda _: railfix.observations_from_xarray("a.nc"), "expected Dataset, got str"),
    "setting changed": (lambda m: setattr(m["config"], "min_satellites", 2), r"settings\.replaced\(min_satellites=2\)"),
    "setting removed": (lambda m: delattr(m["config"], "min_satellites"), "cannot be changed"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_wrong_arguments_are_errors_of_railfix_in_one_sentence(case: str, made: dict[str, Any]) -> None:
    call, sentence = WRONG[case]
    with pytest.raises(railfix.SettingsError, match=sentence) as error:
        call(made)
    assert "\n" not in str(error.value)
    assert "pydantic" not in str(error.value)


def warned(call: Callable[[], object]) -> list[str]:
    """Messages of the warnings of a call, by the filters of a program; all are railfix's."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        call()
    assert all(warning.category is railfix.RailfixWarning for warning in caught)
    assert all(warning.filename == __file__ for warning in caught)
    return [str(warning.message) for warning in caught]


def test_what_the_command_line_notes_is_a_warning_in_python_once(made: dict[str, Any]) -> None:
    def run(path: Any = made["path"], navigation: Any = made["navigation"], log: Any = made["log"]) -> None:
        processor, state = railfix.EpochProcessor(made["config"], {"front": path}, navigation=navigation), None
        for epoch in range(3):
            _, state = processor.process({"front": log[epoch : epoch + 1]}, state)

    assert warned(run) == []
    on_track = railfix.Trajectory.from_antenna_path(made["track"])
    assert warned(lambda: run(on_track)) == [TRACK_AS_PATH]
    no_ionosphere = replace(made["navigation"], klobuchar={})
    (ionosphere,) = warned(lambda: run(navigation=no_ionosphere))
    assert ionosphere.startswith("ionosphere: klobuchar requested")
    late = replace(made["log"], time=made["log"].time + np.timedelta64(3, "D"))
    cause = "no navigation record is valid at the time of the log; are the records of another day?"
    assert f"front: no epoch has a position: {cause}" in warned(lambda: run(log=late))
    moved = made["track"].latitude_deg + 0.002
    elsewhere = railfix.Track.from_geodetic(moved, made["track"].longitude_deg, made["track"].height_m)
    path = railfix.antenna_trajectory(elsewhere, made["vehicle"])
    assert "front: most positions contradict the map; was the log recorded on this track?" in warned(lambda: run(path))


@pytest.mark.slow
def test_a_run_without_a_vehicle_file_warns_in_python(tmp_path: Path) -> None:
    given = {name: FILES[name] for name in ("front", "nav", "track")}
    messages = warned(lambda: railfix.run_files(railfix.RunInputs(**given), out=tmp_path / "run"))
    assert TRACK_AS_PATH in messages
    assert len(messages) == len(set(messages))


@pytest.mark.parametrize(
    ("package", "module", "extra"),
    [("pyogrio", "", "maps"), ("sqlalchemy", "ground.store", "ground"), ("cryptography", "ground.keys", "ground")],
)
def test_a_package_of_an_extra_that_is_missing_is_named_in_python(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, package: str, module: str, extra: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, f"railfix.{module}", raising=False)
    (line := tmp_path / "line.kml").write_text("<kml/>")
    needed = rf"needs {package}, which is not installed; pip install 'railfix\[{extra}\]'"
    with pytest.raises(railfix.SettingsError, match=needed):
        import_module(f"railfix.{module}") if module else read_layers(line, geometry="none")


#: Results, by their path from the objects of `made`.
SHOWN = "result result.fusion[front] result.antennas[front] state track vehicle config path log navigation".split()
SHOWN += [f"result.antennas[front].{name}" for name in "point fix ties raim protection map_offset corrected".split()]
SHOWN += ["result.fusion[front].tracked"]


@pytest.mark.parametrize("name", SHOWN)
def test_results_are_short_as_text_and_a_table_in_a_notebook(name: str, made: dict[str, Any]) -> None:
    shown: Any = made
    for part in re.findall(r"\w+", name):
        shown = shown[part] if isinstance(shown, Mapping) else getattr(shown, part)
    text = repr(shown)
    assert len(text) < 250
    assert "\n" not in text
    assert "array(" not in text
    html = shown._repr_html_()
    assert html.startswith("<table>")
    assert len(html) < 20_000


def test_a_track_off_the_earth_is_no_track() -> None:
    track = railfix.read_track(FILES["track"])
    with pytest.raises(ValueError, match="not a position on the Earth"):
        railfix.Track.from_geodetic(track.longitude_deg, track.latitude_deg, track.height_m)
    for places in (track.ecef_m / 1e3, np.zeros((5, 3))):
        with pytest.raises(ValueError, match="not a position on the Earth"):
            railfix.Track.from_ecef(places)


def test_keys_of_a_million_days_are_refused(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["keys", str(tmp_path / "keys"), "--train", "1", "--days", "9999999"])
    assert "less than or equal to 36500" in " ".join(str(done.output).split())


def test_settings_show_what_differs_from_the_defaults() -> None:
    assert repr(Scenario()) == "Scenario()"  # with defaults that are computed from other settings
    assert repr(railfix.Config(min_satellites=2)) == "Config(min_satellites=2)"
