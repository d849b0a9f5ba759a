"""Reference files: written and read back, the simulator's truth, plain logs of positions, broken ones."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from railfix.core.errors import InputFileError
from railfix.io.reference_log import AntennaReference, read_reference, reference_table
from railfix.simulate.demonstration import demo_inputs

pytestmark = pytest.mark.requirement("D1")

START = np.datetime64("2024-03-05T01:00:00", "ns")
PLACE = np.array([-3957000.0, 3310000.0, 3737000.0])


def made(first_s: float, n: int = 3) -> AntennaReference:
    return AntennaReference(
        time=START + ((first_s + np.arange(n)) * 1e9).astype("timedelta64[ns]"),
        ecef_m=PLACE + np.arange(3 * n).reshape(n, 3),
        chainage_m=np.array([100.0, np.nan, 120.25])[:n],
        speed_mps=np.array([-1.5, 2.0, np.nan])[:n],
        sigma_m=np.array([0.02, 0.31, np.nan])[:n],
        source=np.array(["rtk", "bridged", ""])[:n],
        environment=np.array(["open", "", "tunnel"])[:n],
    )


def assert_same(one: AntennaReference, other: AntennaReference) -> None:
    for name in ("time", "ecef_m", "chainage_m", "speed_mps", "sigma_m", "source", "environment"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    references = {"front": made(0.0), "rear": made(0.5)}
    table = reference_table(references)
    table.write_csv(tmp_path / "reference.csv", float_precision=4, datetime_format="%Y-%m-%dT%H:%M:%S%.9f")
    found = read_reference(tmp_path / "reference.csv", ["front", "rear"])
    for name, reference in references.items():
        assert_same(found[name], reference)
    header, first = (tmp_path / "reference.csv").read_text().splitlines()[:2]
    assert header == "time_gpst,antenna,chainage_m,x_m,y_m,z_m,speed_mps,sigma_m,source,environment"
    assert first == (
        "2024-03-05T01:00:00.000000000,front,100.0000,-3957000.0000,3310001.0000,3737002.0000,-1.5000,0.0200,rtk,open"
    )


@pytest.mark.parametrize("packed", ["csv.gz", "csv"])
def test_the_truth_of_the_simulator_is_a_reference(packed: str, tmp_path: Path) -> None:
    path = demo_inputs().track[0].parent / "truth.csv.gz"
    table = pl.read_csv(path, schema_overrides={"time_gpst": pl.Datetime("ns")})
    if packed == "csv":
        (tmp_path / "truth.csv").write_bytes(gzip.decompress(path.read_bytes()))
        path = tmp_path / "truth.csv"
    found = read_reference(path, ["rear"])["rear"]
    rear = table.filter(pl.col("antenna") == "rear")
    np.testing.assert_array_equal(found.time, rear["time_gpst"].to_numpy())
    np.testing.assert_array_equal(found.ecef_m, rear.select("x_m", "y_m", "z_m").to_numpy())
    np.testing.assert_array_equal(found.chainage_m, rear["chainage_m"].to_numpy())
    np.testing.assert_array_equal(found.speed_mps, rear["speed_mps"].to_numpy())
    assert set(found.source.tolist()) == {"truth"}
    np.testing.assert_array_equal(found.environment, rear["environment"].to_numpy())
    assert {"tunnel", "urban"} <= set(found.environment.tolist())
    assert np.isnan(found.sigma_m).all()


@pytest.mark.parametrize(
    ("name", "form"),
    [
        ("time_utc", "2024-03-05T00:59:{0:02.0f}.500Z"),
        ("time_utc", "2024/03/05 00:59:{0:02.0f}.5"),
        ("unix_s", "{1:.1f}"),
        ("time_gpst", "2024/03/05 01:00:{2:04.1f}"),
    ],
)
def test_columns_and_times_of_other_systems(name: str, form: str, tmp_path: Path) -> None:
    """UTC is 18 s behind GPS time in 2024; 2024-03-05 00:59:42 UTC is 1,709,600,382 s after 1970."""
    rows = ["Moment,Antenna,X,Y,Z,s"]
    for k in range(3):
        moment = form.format(42 + k, 1_709_600_382.5 + k, k + 0.5)
        rows += [f"{moment},{antenna},{PLACE[0] + k},{PLACE[1]},{PLACE[2]},{k}.25" for antenna in ("front", "rear")]
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    columns = {name: "Moment", "antenna": "Antenna", "x_m": "X", "y_m": "Y", "z_m": "Z", "chainage_m": "s"}
    read = read_reference(tmp_path / "log.csv", ("front", "rear"), columns=columns)
    expected = START + np.array([500, 1500, 2500], dtype="timedelta64[ms]")
    for part in read.values():
        np.testing.assert_array_equal(part.time, expected)
        np.testing.assert_allclose(part.ecef_m[:, 0], PLACE[0] + np.arange(3))
        np.testing.assert_allclose(part.chainage_m, [0.25, 1.25, 2.25])


def test_of_a_plain_log_the_fixes_count(tmp_path: Path) -> None:
    path = tmp_path / "rtk.pos"
    path.write_text(
        "%  GPST                      latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)\n"
        "2021/09/22 06:30:00.000   35.000000000  139.000000000   50.0000   1  12   0.0100   0.0100   0.0200\n"
        "2021/09/22 06:30:01.000   35.000100000  139.000000000   50.0000   2  12   0.1000   0.1000   0.2000\n"
        "2021/09/22 06:30:02.000   35.000200000  139.000000000   50.0000   1  12   0.0100   0.0100   0.0200\n"
    )
    found = read_reference(path, ["front"])["front"]
    assert found.source.tolist() == ["rtk", "rtk"]
    np.testing.assert_array_equal(np.diff(found.time), np.timedelta64(2, "s"))
    # two seconds of latitude arc of 0.0002 degrees
    assert np.linalg.norm(np.diff(found.ecef_m, axis=0)) == pytest.approx(22.19, abs=0.01)
    assert np.isnan(np.column_stack([found.chainage_m, found.speed_mps, found.sigma_m])).all()
    assert len(read_reference(path, ["front"], quality=(1, 2))["front"]) == 3
    with pytest.raises(InputFileError, match=r"with a time and quality 2, 5 \(the log has 2 of quality 1, 1 of"):
        read_reference(path, ["front"], quality=(2, 5))
    with pytest.raises(InputFileError, match=r"must have a column antenna \(front, rear\)"):
        read_reference(path, ["front", "rear"])


HEADER = "time_gpst,antenna,x_m,y_m,z_m,sigma_m,source"
ROW = "2024-03-05T01:00:0{},front,-3957000,3310000,3737000,0.02,rtk"


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([ROW.format(0), ROW.format(1).replace("rtk", "guess")], "line 3: source is 'guess'"),
        ([ROW.format(0), ROW.format(0)], "the antenna front has fewer than two positions with a time"),
        ([ROW.format(0), ROW.format(1).replace("0.02", "small")], "line 3: column sigma_m: 'small' is not a number"),
        ([ROW.format(0), ROW.format("x")], "line 3: time_gpst '2024-03-05T01:00:0x' is not an ISO 8601 time"),
        ([ROW.format(0).replace("front", "rear"), ROW.format(1)], "fewer than two positions"),
    ],
)
def test_broken_references_are_refused(rows: list[str], said: str, tmp_path: Path) -> None:
    path = tmp_path / "reference.csv"
    path.write_text("\n".join([HEADER, *rows]) + "\n")
    with pytest.raises(InputFileError) as caught:
        read_reference(path, ["front"])
    assert said in str(caught.value)


def test_a_truncated_truth_is_refused(tmp_path: Path) -> None:
    packed = (demo_inputs().track[0].parent / "truth.csv.gz").read_bytes()
    path = tmp_path / "truth.csv.gz"
    path.write_bytes(packed[: len(packed) // 2])
    with pytest.raises(InputFileError, match="the packed data end early"):
        read_reference(path, ["front"])


def test_times_must_rise() -> None:
    with pytest.raises(ValueError, match="time must rise strictly"):
        AntennaReference(**{**vars(made(0.0)), "time": np.repeat(START, 3)})
