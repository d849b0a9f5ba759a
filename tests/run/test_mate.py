"""Tables of EGNSS MATE as inputs and results of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from mate_made import write_mate_tables
from railfix.core.errors import InputFileError, SettingsError
from railfix.io.logs import read_observations
from railfix.io.mate import READ, WRITTEN, mate_table, signal_code
from railfix.pipeline.config import Config
from railfix.run import RunInputs, RunOptions, run_files
from railfix.run.inputs import TrackReading
from railfix.run.mate_folder import find_inputs
from railfix.run.sensors import read_listed_balises, read_sensors
from railfix.simulate import Simulation
from railfix.simulate.run import write_run
from railfix.simulate.scenario_file import load_recipe
from railfix.simulate.settings import BaliseSettings, InertialSettings, RadarSettings, SensorSettings
from railfix.track import read_track

SENSORS = SensorSettings(
    tachometer=None, inertial=InertialSettings(), radar=RadarSettings(), balises=BaliseSettings(spacing_m=60.0)
)


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return Simulation(load_recipe("demo").scenario().replaced(duration_s=40.0, rate_hz=1.0, sensors=SENSORS))


@pytest.fixture(scope="module")
def folder(simulation: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("mate")
    write_mate_tables(simulation, out)
    return out


def test_tables_are_found_by_their_names() -> None:
    assert mate_table("s_imu.parquet") == mate_table("/a/b.c/S_IMU.csv.gz") == "S_IMU"
    assert mate_table("S_IMU.txt") == mate_table("front.csv") == ""


def test_the_observations_are_those_of_the_receiver(simulation: Simulation, folder: Path) -> None:
    (piece,) = simulation.pieces("front", chunk_epochs=1000)
    own, table = piece.observations, read_observations(folder / "S_GNSS_SAT.parquet")
    channels = {key: k for k, key in enumerate(zip(own.satellite.tolist(), own.signal.tolist(), strict=True))}
    columns = [channels[key] for key in zip(table.satellite.tolist(), table.signal.tolist(), strict=True)]
    np.testing.assert_array_equal(table.time, own.time.astype("datetime64[us]"))
    for name in ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz"):
        np.testing.assert_allclose(getattr(table, name), getattr(own, name)[:, columns], atol=1e-3)


@pytest.mark.parametrize(
    ("satellite", "signal", "code"),
    [("G05", "GPS_L1CA", "1C"), ("E11", "E5a", "5Q"), ("C12", "B1I", "2I"), ("G05", "2W", "2W"), ("G05", "XY3", "")],
)
def test_signals_have_their_rinex_codes(satellite: str, signal: str, code: str) -> None:
    assert signal_code(satellite, signal) == code


def test_an_unknown_column_is_refused_with_one_sentence(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "S_GNSS_SAT.parquet"
    pl.read_parquet(folder / "S_GNSS_SAT.parquet").with_columns(SNR=1.0).write_parquet(path)
    with pytest.raises(InputFileError, match="has a column SNR that is not in S_GNSS_SAT of EGNSS MATE; remove"):
        read_observations(path)
    pl.read_parquet(folder / "S_GNSS_SAT.parquet").drop("PSEUDORANGE").write_parquet(path)
    with pytest.raises(InputFileError, match="no column PSEUDORANGE; the EGNSS MATE table S_GNSS_SAT needs GPS_WEEK"):
        read_observations(path)


def test_a_lock_shorter_than_the_time_since_the_last_epoch_was_lost(folder: Path, tmp_path: Path) -> None:
    rows = pl.read_parquet(folder / "S_GNSS_SAT.parquet").filter(pl.col("GPS_TOW") % 10 == 0)
    for later_s, lost in ((8.0, True), (15.0, False)):
        lock = pl.when(pl.col("GPS_TOW") == pl.col("GPS_TOW").min()).then(5.0).otherwise(later_s)
        rows.with_columns(LOCK_TIME=lock).write_parquet(tmp_path / "S_GNSS_SAT.parquet")
        assert bool(read_observations(tmp_path / "S_GNSS_SAT.parquet").loss_of_lock[1].any()) == lost


def test_sensors_and_balises_are_those_of_the_simulator(folder: Path) -> None:
    given = find_inputs(folder)
    samples = read_sensors(**{name: given[name] for name in ("inertial", "radar", "balises")})
    assert len(samples.inertial) > 1000
    assert -10.2 < samples.inertial.force_mps2[:, 2].mean() < -9.4
    assert samples.balises.balise[0] == "493-1"
    listed = read_listed_balises(given["balise_list"], read_track(given["track"], crs="EPSG:4979"))
    np.testing.assert_allclose(listed.chainage_m[:3], [60.0, 120.0, 180.0], atol=0.01)


def test_a_folder_without_its_tables_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match="has no table S_GNSS_SAT"):
        find_inputs(tmp_path)
    (tmp_path / "S_GNSS_SAT.parquet").write_bytes((folder / "S_GNSS_SAT.parquet").read_bytes())
    with pytest.raises(InputFileError, match="has no table S_DM_TRACK_SEGMENT_POSITION or S_DM_TRACKPOINT"):
        find_inputs(tmp_path)
    with pytest.raises((SettingsError, ValueError), match=r"front \(--front\) is missing"):
        RunInputs(nav=(tmp_path / "n",), track=(tmp_path / "t",))


def segments(tmp_path: Path, rows: list[dict[str, object]], heights: list[dict[str, object]]) -> Path:
    path = tmp_path / "S_DM_TRACK_SEGMENT_POSITION.csv"
    own = {"TRACK_EDGE_ID": "e1", "TRACK_SEGMENT_DIRECTION": 1, "UTM_CELL": "LV95"}
    pl.DataFrame([own | row for row in rows]).write_csv(path)
    profile = {"TRACK_EDGE_ID": "e1", "TRACK_SEGMENT_TYPE": "line", "TRACK_SEGMENT_DIRECTION": 1}
    pl.DataFrame([profile | row for row in heights]).write_csv(tmp_path / "S_DM_TRACK_SEGMENT_GRADIENT.csv")
    return path


def test_lines_circles_and_clothoids_of_the_digital_map_join(tmp_path: Path) -> None:
    """East on a line, by a clothoid into a circle to the right of 500 m: worked out by the Fresnel integrals."""
    from scipy.special import fresnel

    length, radius, spiral, east, north = 100.0, 500.0, 80.0, 2_600_000.0, 1_200_000.0
    constant, azimuth = np.sqrt(radius * spiral), 0.5 * np.pi + spiral / (2.0 * radius)
    scale = constant * np.sqrt(np.pi)
    sine, cosine = fresnel(spiral / scale)
    end = np.array([east + length + scale * cosine, north - scale * sine])
    centre = end + radius * np.array([np.sin(azimuth + 0.5 * np.pi), np.cos(azimuth + 0.5 * np.pi)])
    bearing = np.arctan2(*(end - centre)) % (2.0 * np.pi)
    of = "TRACK_SEGMENT"
    name = (f"{of}_TYPE", f"{of}_REFERENCE_POSITION", f"{of}_LENGTH", "EAST", "NORTH", "AZIMUTH")
    rows = [
        dict(zip(name, ("line", 0.0, length, east, north, 0.5 * np.pi), strict=True)),
        dict(zip(name, ("clothoid", length, spiral, east + length, north, 0.5 * np.pi), strict=True))
        | {"INITIAL_ARC_LENGTH": 0.0, "CLOTHOID_CONSTANT": float(constant)},
        dict(zip(name, ("circle", length + spiral, 100.0, centre[0], centre[1], None), strict=True))
        | {"INITIAL_ARC_LENGTH": float(bearing * radius), "RADIUS": radius},
    ]
    rows = [{"INITIAL_ARC_LENGTH": None, "CLOTHOID_CONSTANT": None, "RADIUS": None} | row for row in rows]
    height = {"TRACK_SEGMENT_REFERENCE_POSITION": 0.0, "TRACK_SEGMENT_LENGTH": 280.0, "INITIAL_HEIGHT": 500.0}
    track = read_track(segments(tmp_path, rows, [height | {"GRADIENT": 10.0}]))
    assert track.chainage_m[-1] == pytest.approx(280.0 * np.hypot(1.0, 0.01), abs=0.1)
    assert track.height_m[[0, -1]] == pytest.approx([500.0, 502.8], abs=0.01)
    assert not [note for note in track.provenance.notes if "do not meet" in note]
    assert track.radius_m[-1] == pytest.approx(radius, abs=0.5)
    assert track.radius_m[0] == np.inf


@pytest.mark.slow
@pytest.mark.requirement("B1")
def test_a_run_on_the_tables_gives_the_positions_of_its_rinex_and_the_result_tables(
    simulation: Simulation, folder: Path, tmp_path: Path
) -> None:
    files = write_run(simulation.scenario, tmp_path / "rinex", packing="plain")
    config = Config(filter="track", sensors={"radar_step_s": 0.1})
    reading = TrackReading(crs="EPSG:4979")
    common = {"nav": (files["nav"],), "vehicle": files["vehicle"]}
    sensors = {name: files[name] for name in ("inertial", "radar", "balises", "balise_list")}
    inputs = RunInputs(front=(files["front"],), track=(files["track"],), **common, **sensors)
    rinex = run_files(inputs, config, out=tmp_path / "a", options=RunOptions())
    tables = run_files(
        RunInputs(mate=folder, **common), config, out=tmp_path / "b", options=RunOptions(track=reading)
    )  # fmt: skip
    for name, columns in {
        "positions.parquet": ("x_m", "y_m", "z_m", "chainage_m"),
        "train.parquet": ("x_m", "y_m", "z_m", "chainage_m", "protection_level_m"),
    }.items():
        one, other = pl.read_parquet(rinex.files[name]), pl.read_parquet(tables.files[name])
        assert one["time_gpst"].equals(other["time_gpst"])
        for column in columns:
            np.testing.assert_allclose(other[column].to_numpy(), one[column].to_numpy(), atol=0.01, err_msg=column)
    track = pl.read_parquet(tables.files["R_TRACK.parquet"])
    etcs = pl.read_parquet(tables.files["R_ETCS_TPR.parquet"])
    assert track.columns == list(WRITTEN["R_TRACK"])
    assert etcs.columns == list(WRITTEN["R_ETCS_TPR"])
    train = pl.read_parquet(tables.files["train.parquet"]).drop_nulls("chainage_m")
    np.testing.assert_allclose(track["RELATIVE_DISTANCE"].to_numpy(), train["chainage_m"].to_numpy(), atol=1e-3)
    np.testing.assert_allclose(etcs["L_DOUBTOVER"].to_numpy(), train["over_reading_m"].to_numpy(), atol=1e-3)
    last = etcs.tail(1).to_dicts()[0]
    assert last["NID_LRBG_C"] == 493
    assert last["D_LRBG"] < 61.0
    assert (last["Q_DLRBG"], last["Q_DIRTRAIN"]) == (1, 1)  # it has passed the balise, and runs on
    first = etcs.head(1).to_dicts()[0]
    assert (first["NID_LRBG_C"], first["D_LRBG"], first["Q_DLRBG"]) == (None, None, 2)


def test_every_table_that_is_read_has_its_device_or_edge() -> None:
    assert all("DEVICE_ID" in columns or "TRACK_EDGE_ID" in columns for columns in READ.values())
