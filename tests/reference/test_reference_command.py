"""``railfix reference`` on a made run with all its sensors, its files, its messages; tables of sensors."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from railfix.cli import app
from railfix.core.errors import InputFileError
from railfix.core.timescale import seconds
from railfix.io.reference_log import AntennaReference, read_reference
from railfix.reference import read_acceleration, read_pulses
from railfix.simulate import Scenario, write_run
from railfix.simulate.settings import InertialSettings, SensorSettings, TachometerSettings

pytestmark = pytest.mark.requirement("D1")

RUNNER = CliRunner(env={"COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1"})
GAPS = ((30.0, 50.0), (70.0, 110.0))


@dataclass(frozen=True)
class Bench:
    """A made run as files: `options` are those of the command."""

    folder: Path
    truth: dict[str, AntennaReference]
    options: dict[str, Path]

    def run(self, out: Path, **changed: object) -> Any:
        """The command with some options changed; None leaves one out."""
        arguments = ["reference", "--out", str(out)]
        for name, value in {**self.options, **changed}.items():
            if value is not None:
                arguments += [f"--{name.replace('_', '-')}", str(value)]
        return RUNNER.invoke(app, arguments)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    folder = tmp_path_factory.mktemp("run")
    scenario = Scenario(
        duration_s=130.0,
        rate_hz=5.0,
        sensors=SensorSettings(
            tachometer=TachometerSettings(diameter_error_m=0.004), inertial=InertialSettings(rate_hz=50.0), radar=None
        ),
    )
    files = write_run(scenario, folder, packing="plain")
    truth = read_reference(files["truth"], ["front", "rear"])
    random = np.random.default_rng(1)
    for name, reference in truth.items():
        t = seconds(reference.time - reference.time[0])
        fixed = ~np.any([(t > begin) & (t < end) for begin, end in GAPS], axis=0)
        place = reference.ecef_m + random.normal(size=reference.ecef_m.shape) * np.where(fixed, 0.008, 0.4)[:, None]
        rows = pl.DataFrame(
            {
                "time_gpst": reference.time,
                **{axis: place[:, i] for i, axis in enumerate(("x_m", "y_m", "z_m"))},
                "quality": np.where(fixed, 1, 2),
                "ratio": np.where(fixed, 30.0, 1.2),
            }
        )
        rows.write_csv(folder / f"rtk_{name}.csv", datetime_format="%Y-%m-%dT%H:%M:%S%.9f", float_precision=4)
    options = {
        "rtk": folder / "rtk_front.csv",
        "rtk_rear": folder / "rtk_rear.csv",
        "track": files["track"],
        "vehicle": files["vehicle"],
        "front": files["front"],
        "rear": files["rear"],
        "nav": files["nav"],
        "pulses": files["tachometer"],
        "acceleration": files["inertial"],
    }
    return Bench(folder, truth, options)


def errors(bench: Bench, out: Path, antenna: str) -> tuple[np.ndarray, AntennaReference]:
    found = read_reference(out / "reference.csv", ["front", "rear"])[antenna]
    true = bench.truth[antenna]
    at = np.searchsorted(true.time, found.time)
    np.testing.assert_array_equal(true.time[at], found.time)
    return found.chainage_m - true.chainage_m[at], found


def test_all_sensors_together(bench: Bench, tmp_path: Path) -> None:
    result = bench.run(tmp_path / "out")
    assert result.exit_code == 0, result.output
    for antenna in ("front", "rear"):
        error, found = errors(bench, tmp_path / "out", antenna)
        bridged = found.source == "bridged"
        assert bridged.sum() == 2 * 0 + int(sum((end - begin) * 5 - 1 for begin, end in GAPS))
        assert np.abs(error[~bridged]).max() < 0.06
        assert np.abs(error[bridged]).max() < 0.10
        assert np.sqrt(np.mean((error / found.sigma_m)[bridged] ** 2)) < 1.2
        true_speed = bench.truth[antenna].speed_mps[np.searchsorted(bench.truth[antenna].time, found.time)]
        assert np.percentile(np.abs(found.speed_mps - true_speed), 95) < 0.10
    record = json.loads((tmp_path / "out" / "reference.json").read_text())
    front = record["antennas"]["front"]
    assert front["verdicts"]["good"] + front["verdicts"]["not_fixed"] == front["positions"] == 650
    assert front["bridged_by"] == {"doppler and pulses and acceleration": 298}
    assert front["pulses"]["direction"] == "from the table"
    assert front["pulses"]["pulse_m_from"] == "estimated from the fixes"
    assert front["pulses"]["pulse_m"] == pytest.approx(np.pi * 0.856 / 60.0, rel=0.01)
    assert set(front["doppler"]["receivers"]) == {"front", "rear"}
    digests = {item["input"]: item["sha256"] for item in record["inputs"]}
    assert set(digests) == set(bench.options)
    assert digests["rtk"] == hashlib.sha256(bench.options["rtk"].read_bytes()).hexdigest()
    assert record["settings_asked"] == {}
    assert record["settings_used"]["spacing_m"] == 0.05
    verdicts = pl.read_csv(tmp_path / "out" / "fixes.csv")
    assert len(verdicts) == 1300
    assert verdicts.filter(pl.col("verdict") == "good")["spacing_m"].abs().max() < 0.05
    counted = verdicts.filter(pl.col("antenna") == "front")["verdict"].value_counts()
    assert dict(counted.iter_rows()) == {"good": front["verdicts"]["good"], "not_fixed": 298}


@pytest.mark.parametrize(
    ("sensor", "largest_m"), [("dopplers", 0.10), ("pulses", 0.10), ("acceleration", 2.0), ("none", 40.0)]
)
def test_each_sensor_alone(sensor: str, largest_m: float, bench: Bench, tmp_path: Path) -> None:
    left_out: dict[str, object] = {"rtk_rear": None, "rear": None}
    if sensor != "dopplers":
        left_out |= {"front": None, "nav": None}
    left_out |= {name: None for name in ("pulses", "acceleration") if name != sensor}
    result = bench.run(tmp_path / "out", max_sigma=100.0, **left_out)
    assert result.exit_code == 0, result.output
    found = read_reference(tmp_path / "out" / "reference.csv", ["front"])["front"]
    true = bench.truth["front"]
    error = found.chainage_m - true.chainage_m[np.searchsorted(true.time, found.time)]
    bridged = found.source == "bridged"
    assert bridged.sum() == 298
    assert 0.05 * largest_m < np.abs(error[bridged]).max() < largest_m
    assert ("bridged by the motion model alone" in result.output) == (sensor == "none")
    record = json.loads((tmp_path / "out" / "reference.json").read_text())
    assert record["settings_asked"] == {"max_sigma_m": 100.0}


def test_what_is_left_out_is_said(bench: Bench, tmp_path: Path) -> None:
    result = bench.run(tmp_path / "out", max_gap=30.0)
    assert result.exit_code == 0, result.output
    assert "1 gaps of over 30 s are left out, 40 s in total: 2024-03-05T03:11:10 (40 s)" in result.output
    assert "199 long gap" in result.output


@pytest.mark.parametrize(
    ("changed", "code", "said"),
    [
        ({"rtk": None, "rtk_rear": None}, 4, "no positions are given"),
        ({"nav": None}, 4, "Doppler speeds need both observations"),
        ({"vehicle": None}, 4, "name its file with --vehicle"),
        ({"pulses": "nowhere.csv"}, 3, "nowhere.csv: there is no such file; check the path given by --pulses"),
        ({"spacing": -1.0}, 4, "--spacing: Input should be greater than 0"),
        ({"pulse": 0.0}, 4, "--pulse: Input should be greater than 0"),
        ({"ratio": 50.0}, 7, "fewer than two good fixes"),
        ({"pulse": 500.0}, 5, "does the counter wrap, or is the distance per pulse wrong?"),
    ],
)
def test_what_is_wrong_is_said_and_leaves_nothing(
    changed: dict[str, object], code: int, said: str, bench: Bench, tmp_path: Path
) -> None:
    result = bench.run(tmp_path / "out", **changed)
    assert result.exit_code == code
    assert said in " ".join(result.output.split())
    assert not (tmp_path / "out").exists()


# --- tables of sensors ---------------------------------------------------------


def table(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


T = "2024-03-05T01:00:0"


def test_forms_of_a_tachometer_table(tmp_path: Path) -> None:
    counter = read_pulses(table(tmp_path / "a.csv", "time_gpst,count", f"{T}0,10", f"{T}0.5,14", f"{T}1,12"))
    assert (counter.kind, counter.signed) == ("count", True)
    at = np.array([f"{T}0.25", f"{T}0.75", f"{T}2"], dtype="datetime64[ns]")
    np.testing.assert_array_equal(counter.at(at), [12.0, 13.0, np.nan])
    single = read_pulses(table(tmp_path / "b.csv", "time_gpst,direction", f"{T}0,1", f"{T}1,1", f"{T}2,-1"))
    assert (single.kind, single.signed) == ("pulse", True)
    np.testing.assert_array_equal(single.count, [0.0, 1.0, 0.0])
    metres = read_pulses(table(tmp_path / "c.csv", "time_gpst,distance_m", f"{T}0,0", f"{T}1,5.5"))
    assert (metres.kind, metres.signed) == ("distance", False)
    # 3 s without a row while the wheel turned: what lies between is not known
    holed = read_pulses(table(tmp_path / "d.csv", "time_gpst,count", f"{T}0,0", f"{T}1,5", f"{T}4,50", f"{T}5,50"))
    np.testing.assert_array_equal(
        holed.at(np.array([f"{T}{s}" for s in ("0.5", "2", "4", "4.5")], dtype="datetime64[ns]")),
        [2.5, np.nan, 50.0, 50.0],
    )


def test_mean_acceleration_between_instants(tmp_path: Path) -> None:
    path = table(
        tmp_path / "a.csv", "time_gpst,specific_force_mps2", *(f"{T}{0.1 * k:.1f},{0.1 * k:.1f}" for k in range(11))
    )
    found = read_acceleration(path)
    assert found.kind == "specific_force"
    at = np.array([f"{T}{s}" for s in ("0", "0.4", "1.0", "3")], dtype="datetime64[ns]")
    np.testing.assert_allclose(found.mean_over(at), [0.2, 0.7, np.nan])


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (["time,count", f"{T}0,1", f"{T}1,2"], "has no column time_gpst"),
        (["time_gpst,count", f"{T}1,1", f"{T}0,2"], "row 3: time_gpst falls"),
        (["time_gpst,count", f"{T}0,1", ",2"], "row 3: time_gpst is empty"),
        (["time_gpst,count", f"{T}0,1", f"{T}1,x"], "row 3: count is 'x', a number was expected"),
        (["time_gpst,direction", f"{T}0,1", f"{T}1,0"], "row 3: direction is 0"),
        (["time_gpst,count", f"{T}0,1"], "fewer than two rows"),
    ],
)
def test_broken_tachometer_tables(lines: list[str], said: str, tmp_path: Path) -> None:
    with pytest.raises(InputFileError) as caught:
        read_pulses(table(tmp_path / "a.csv", *lines))
    assert said in str(caught.value)


def test_an_acceleration_says_whether_gravity_is_in_it(tmp_path: Path) -> None:
    with pytest.raises(
        InputFileError, match="one column of specific_force_mps2, force_forward_mps2, acceleration_mps2"
    ):
        read_acceleration(table(tmp_path / "a.csv", "time_gpst,a", f"{T}0,1", f"{T}1,1"))
