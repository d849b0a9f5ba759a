"""Lists of balises and readings from files, and the balises of the simulator."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from railfix.core.errors import InputFileError, SettingsError
from railfix.pipeline.config import Config
from railfix.run.sensors import load_balises, read_listed_balises, read_sensors
from railfix.simulate import Simulation
from railfix.simulate.scenario_file import load_recipe
from railfix.simulate.sensor_columns import COLUMNS, sensor_tables
from railfix.simulate.settings import Balise, BaliseSettings, SensorSettings
from railfix.track import Track, read_track, write_track_csv

HEADER = "balise,chainage_m\n"


def line(name: str, begin: float, end: float) -> Track:
    north = np.linspace(begin, end, 21)
    return Track.from_geodetic(35.0 + north, np.full(21, 139.0), np.full(21, 50.0), name=name)


@pytest.fixture(scope="module")
def track(tmp_path_factory: pytest.TempPathFactory) -> Track:
    """Two tracks of 555 m, the second against the order of its points."""
    folder = tmp_path_factory.mktemp("tracks")
    files = [folder / "west.csv", folder / "east.csv"]
    write_track_csv(line("west", 0.0, 0.005), files[0])
    write_track_csv(line("east", 0.01, 0.005), files[1])
    return read_track(files)


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "list.csv"
    path.write_text(text)
    return path


@pytest.mark.requirement("E7")
def test_balises_lie_on_the_line_or_on_a_track_of_it(track: Track, tmp_path: Path) -> None:
    half, whole = track.chainage_m[20], track.chainage_m[-1]
    text = "balise,chainage_m,track,sigma_m\nA,100,,\nB,10,west,0.5\nC,10,east,\nD,700,east,\nE,10,north,\nF,5000,,\n"
    found = read_listed_balises(write(tmp_path, text), track)
    assert found.name.tolist() == ["A", "B", "C"]
    assert half == pytest.approx(555.0, abs=1.0)
    np.testing.assert_allclose(found.chainage_m, [100.0, 10.0, whole - 10.0], atol=1e-3)
    np.testing.assert_array_equal(found.sigma_m, [0.0, 0.5, 0.0])
    assert not found.virtual.any()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("balise\nA\n", "has no column chainage_m; a table of the list of balises needs balise, chainage_m"),
        (HEADER + "A,1\nA,2\n", "lists balise A twice; give each once"),
        (HEADER + "A,-5\n", r"lists no balise on the line \(0 to 1109 m\)"),
        (HEADER + ",5\n", "row 2: balise is empty"),
        (HEADER + "A,x\n", "row 2: chainage_m is 'x', a number was expected"),
        (HEADER + "A,\n", "row 2: chainage_m is None, a number was expected"),
    ],
)
def test_a_list_that_is_none_is_refused(track: Track, tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputFileError, match=message):
        read_listed_balises(write(tmp_path, text), track)


def test_readings_need_a_list_and_virtual_balises_levels(track: Track, tmp_path: Path) -> None:
    places = write(tmp_path, HEADER + "A,1\n")
    with pytest.raises(SettingsError, match="--balises is given without --balise-list; give both"):
        load_balises(places, None, None, track, Config())
    with pytest.raises(SettingsError, match="--balise-list is given without --balises; give both"):
        load_balises(None, places, None, track, Config())
    with pytest.raises(SettingsError, match="--virtual-balises needs protection levels of the filter"):
        load_balises(None, None, places, track, Config(filter="off"))
    both = load_balises(places, places, places, track, Config(filter="track"))
    assert both.virtual.tolist() == [False, True]
    assert both.find_index(np.array(["A", "B"])).tolist() == [0, -1]


@pytest.mark.requirement("E7")
def test_the_simulator_writes_what_was_read_missed_and_mistaken(tmp_path: Path) -> None:
    own = (Balise(name="X", chainage_m=75.0),)
    balises = BaliseSettings(
        balises=own, spacing_m=50.0, along_m=3.0, missed=("B002",), wrong={"B001": "B009"}, noise_sigma_m=0.2
    )
    sensors = SensorSettings(tachometer=None, inertial=None, radar=None, balises=balises)
    scenario = load_recipe("demo").scenario().replaced(duration_s=40.0, sensors=sensors)
    tables = sensor_tables(Simulation(scenario))
    assert {name: table.columns for name, table in tables.items()} == {name: [*COLUMNS[name]] for name in tables}
    truth = tables["balise_truth"]
    assert truth["balise"].to_list()[:4] == ["B001", "X", "B002", "B003"]
    assert truth["read"].to_list()[:4] == ["B009", "X", None, "B003"]
    path = tmp_path / "balises.csv"
    tables["balises"].write_csv(path)
    readings = read_sensors(balises=path).balises
    assert readings.balise.tolist()[:3] == ["B009", "X", "B003"]
    late = (readings.time - truth.drop_nulls("read")["time_gpst"].to_numpy()) / np.timedelta64(1, "s")
    assert 0.0 < np.abs(late).max() < 0.5
    chances = BaliseSettings(spacing_m=20.0, missed_chance=0.3, wrong_chance=0.3)
    drawn = sensor_tables(Simulation(scenario.replaced(sensors=sensors.replaced(balises=chances))))["balise_truth"]
    assert 0 < drawn["read"].null_count() < len(drawn) - 2
    assert 0 < drawn.filter(pl.col("read") != pl.col("balise")).height < len(drawn) - 2
