"""SBAS on L5 from the simulator's files to levels: what is corrected, rejected and stated."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from railfix.cli import app
from railfix.core.errors import SettingsError
from railfix.core.geodesy import range_with_rotation
from railfix.core.reasons import Reason
from railfix.gnss import concatenate
from railfix.gnss.orbits import satellite_states
from railfix.pipeline.base_station_stage import BaseStation
from railfix.pipeline.channel_book import ChannelBook
from railfix.pipeline.config import parse_config
from railfix.ranges.sbas import SbasMessages, SbasState, read_sbas
from railfix.ranges.sbas.decode import read_fields
from railfix.ranges.sbas.dfmc import LAYOUTS, DfmcService, DfmcState
from railfix.ranges.sbas.messages import with_parity
from railfix.ranges.sbas.sbas_sources import DFMC_REASONS
from railfix.run.processor_setup import make_processor
from railfix.simulate import Scenario, Simulation, write_run
from railfix.simulate import sbas_stream as stream
from railfix.simulate.errors import SatelliteFault
from railfix.simulate.sbas_stream import sbas_messages, write_sbas
from railfix.simulate.scenario_file import load_recipe
from railfix.simulate.settings import SbasSettings
from railfix.track.trajectory import Trajectory

pytestmark = pytest.mark.requirement("C5")
FAULT_S, STOP_S, DURATION_S = 90, 130, 150
FAULTY = "G10"
#: BeiDou without a slot; corrected for a record that nobody sent.
NO_SLOT, OTHER_ISSUE = "C38", "C36"


def scenario(**receiver: object) -> Scenario:
    """Errors of a commercial line's run under an open sky, and an ionosphere far from its model."""
    usual, errors = Scenario(), load_recipe("commercial-run").scenario().errors
    return usual.replaced(
        seed=5,  # six satellites of BeiDou with a slot above 20 degrees
        duration_s=float(DURATION_S),
        rate_hz=1.0,
        errors=usual.errors.replaced(
            satellites=errors.satellites,
            ionosphere=errors.ionosphere.replaced(vertical_sigma_m=4.0),
            intersystem=errors.intersystem,
            noise=errors.noise,
            faults=(SatelliteFault(satellite=FAULTY, start_s=float(FAULT_S), step_m=40.0),),
        ),
        sky=usual.sky.replaced(systems="GJEC"),
        receiver=usual.receiver.replaced(signals_per_satellite=2, second="L5", **receiver),
        sbas=SbasSettings(band="L5"),
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated run, positions of its front antenna with SBAS on L5 and without; the service stops before its end."""
    made = tmp_path_factory.mktemp("l5")
    files = write_run(scenario(), made / "sim", packing="plain")
    messages = read_sbas(files["sbas"], band="L5")
    stop = np.flatnonzero(messages.time >= scenario().start + np.timedelta64(STOP_S, "s"))[0]
    bits = messages.bits.copy()
    bits[stop] = stream.message(0, int(stop) - 300)
    own = (messages.type == 32) & (read_fields(bits, LAYOUTS[32])["slot"] == 158 + int(OTHER_ISSUE[1:]))
    assert own.any()
    bits[own, 3] ^= 0x40  # bits 18 to 27 are the issue, 25 is worth 4
    bits = with_parity(bits)
    write_sbas(
        SbasMessages(
            **{**vars(messages), "bits": bits, "type": np.where(np.arange(len(bits)) == stop, 0, messages.type)}
        ),
        files["sbas"],
    )
    given = [word for name in ("front", "nav", "track", "vehicle") for word in (f"--{name}", str(files[name]))]
    l5 = ["--sbas", str(files["sbas"]), "--set", "sbas_band=L5"]
    for name, options in (("plain", []), ("l5", l5), ("beidou", [*l5, "--set", 'systems=["C"]'])):
        done = CliRunner().invoke(app, ["run", *given, *options, "--observations", "--out", str(made / name)])
        assert done.exit_code == 0, done.output
    return made


def errors_m(folder: Path, name: str, table: str) -> tuple[np.ndarray, np.ndarray]:
    """Errors along the line and levels of the epochs before the service stops."""
    found = pl.read_parquet(folder / name / f"{table}.parquet")[:STOP_S]
    truth = pl.read_csv(folder / "sim" / "truth.csv").filter(pl.col("antenna") == "front")[:STOP_S]
    return np.abs((found["chainage_m"] - truth["chainage_m"]).to_numpy()), found["protection_level_m"].to_numpy()


@pytest.mark.slow
@pytest.mark.parametrize(("table", "share"), [("positions", 0.9), ("train", 0.6)])
def test_errors_become_less_and_stay_within_levels(folder: Path, table: str, share: float) -> None:
    error, level = errors_m(folder, "l5", table)
    assert np.isfinite(level).mean() > 0.95
    assert (error <= level)[np.isfinite(level)].all()
    assert np.median(error) < share * np.median(errors_m(folder, "plain", table)[0])


def test_results_say_what_was_asked_and_used(folder: Path) -> None:
    record = json.loads((folder / "l5" / "run.json").read_text())
    assert record["settings_asked"]["sbas_band"] == "L5"
    assert record["protection"]["kind"] == "sbas"
    said = " ".join(record["notes"])
    assert "frequencies: one requested, ionosphere-free codes used instead" in said
    assert "SBAS on L5 requested: corrections of MSAS PRN 137 used" in said
    table = pl.read_parquet(folder / "l5" / "observations.parquet").filter(pl.col("reason") == 0)
    assert set(table["satellite"].str.slice(0, 1)) == {"G", "E", "C"}
    ratio = (154 / 115) ** 2
    np.testing.assert_allclose(table["second_share"].drop_nulls().drop_nans(), -1.0 / (ratio - 1.0), rtol=1e-6)
    counts = dict(table.group_by("signal").len().iter_rows())
    assert (counts["5Q"], counts["5P"]) == (counts["1C"], counts["1P"])


def test_beidou_alone_is_corrected_within_its_levels(folder: Path) -> None:
    """On slots of the mask, each satellite by the record of B-CNAV1 with the issue of its correction."""
    for name, least in (("positions", 0.2), ("train", 0.5)):  # five satellites: pairs of them take the level away
        error, level = errors_m(folder, "beidou", name)
        assert np.isfinite(level).mean() > least
        assert (error <= level)[np.isfinite(level)].all()
    assert np.median(error) < 0.5
    table = pl.read_parquet(folder / "l5" / "observations.parquet").filter(pl.col("signal") == "1P")
    for name, reason in ((NO_SLOT, Reason.SBAS_NOT_COVERED), (OTHER_ISSUE, Reason.SBAS_NO_CORRECTION)):
        own = table.filter(pl.col("satellite") == name)["reason"].to_numpy()[:STOP_S]
        assert len(own) == STOP_S
        assert (own & int(reason)).all(), name


def test_satellites_are_rejected_by_do_not_use_and_all_by_type_0(folder: Path) -> None:
    table = pl.read_parquet(folder / "l5" / "observations.parquet").filter(pl.col("signal") == "1C")
    second = (table["time_gpst"] - table["time_gpst"].min()).dt.total_seconds()
    table = table.with_columns(second=second)

    def reasons(of: pl.DataFrame, *ignored: Reason) -> set[int]:
        return set((of["reason"].to_numpy() & ~sum(int(reason) for reason in ignored)).tolist())

    weak = (Reason.ELEVATION_MASK, Reason.UNHEALTHY)
    of_fault = table.filter((pl.col("satellite") == FAULTY) & (pl.col("second") < STOP_S))
    assert reasons(of_fault.filter(pl.col("second") < FAULT_S)) == {0}
    # alerted after 6 s, and in the message of the next 6 s that ends a second later
    assert reasons(of_fault.filter(pl.col("second") > FAULT_S + 13)) == {int(Reason.SBAS_DO_NOT_USE)}
    stopped = table.filter((pl.col("second") > STOP_S + 1) & ~pl.col("satellite").str.starts_with("J"))
    assert reasons(stopped, *weak) == {int(Reason.SBAS_DO_NOT_USE)}
    japan = table.filter(pl.col("satellite").str.starts_with("J"))
    assert reasons(japan, *weak) == {int(Reason.SBAS_NOT_COVERED)}
    assert set(pl.read_parquet(folder / "l5" / "positions.parquet")["status"][STOP_S + 2 :]) == {"too_few_satellites"}


def test_corrected_codes_are_true_ranges() -> None:
    """Without noise: to the resolution of the messages and the growth of errors between them, group delays included."""
    quiet = scenario(code_sigma_m=0.0, phase_sigma_m=0.0).replaced(duration_s=40.0)
    simulation = Simulation(quiet)
    observations = concatenate(list(simulation.observations("front")))[:30]
    config = parse_config({"filter": "off", "protection": "off", "sbas": "stream", "sbas_prn": 137, "sbas_band": "L5"})
    line = Trajectory.from_antenna_path(simulation.line.track())
    processor = make_processor(config, simulation.navigation, {"front": line})
    messages = sbas_messages(simulation, SbasSettings(band="L5"))
    found = processor.process({"front": observations}, messages=messages)[0].antennas["front"]
    heard = messages.time <= observations.time[12]
    first, state = processor.process({"front": observations[:13]}, messages=messages.take(heard))
    second, _ = processor.process({"front": observations[13:]}, state, messages=messages.take(~heard))
    pieces = [part.antennas["front"] for part in (first, second)]
    for name in ("corrected_code_m", "sigma_m", "reason"):
        whole = np.concatenate([getattr(part, name) for part in pieces])
        np.testing.assert_allclose(whole, getattr(found, name), rtol=0, atol=1e-6, err_msg=name)
    columns = found.columns[np.isfinite(found.corrected_code_m[:, found.columns]).any(axis=0)]
    satellite, code = found.satellite[columns], observations.code_m[:, columns]
    fixes = DfmcService(messages, prn=137).satellites(found.time, satellite, simulation.navigation)
    states = satellite_states(
        found.time, satellite, found.signal[columns], code, simulation.navigation, record=fixes.record
    )
    tag = np.arange(30.0)
    truth = simulation.truth("front", tag - simulation.clocks.bias_s("front", tag))[0].ecef_m
    distance, _ = range_with_rotation(states.position_ecef_m + fixes.position_m, truth[:, None])
    error = found.corrected_code_m[:, columns] - distance
    good = (found.reason[:, columns] == 0) & (found.elevation_deg[:, columns] > 30.0)
    for letter in "GEC":
        own = np.where(good & np.char.startswith(satellite, letter), error, np.nan)
        own = own[:, np.isfinite(own).all(axis=0)]
        assert own.shape[1] >= 3
        assert np.abs(own - own.mean(axis=1, keepdims=True)).max() < 0.35


def test_beidou_is_taken_on_b1c_first() -> None:
    simulation = Simulation(scenario())
    first = next(iter(simulation.observations("front")))
    obs = replace(first, signal=np.char.replace(first.signal, "5P", "2I"))
    config = parse_config({"sbas": "stream", "sbas_prn": 137, "sbas_band": "L5"})
    for chosen, wanted in ((config, "1P"), (parse_config({}), "2I")):
        channels = ChannelBook(chosen).of(obs, simulation.navigation)
        names, best = np.unique(channels.satellite, return_index=True)
        assert set(channels.signal[best[np.char.startswith(names, "C")]]) == {wanted}


def test_every_state_has_a_reason() -> None:
    assert [int(state) for state in DfmcState if DFMC_REASONS[state] == 0] == [DfmcState.OK]


def test_phases_of_one_frequency_are_refused() -> None:
    with pytest.raises(SettingsError, match="carrier = float uses the phase of one frequency: set carrier = off"):
        parse_config({"sbas": "stream", "sbas_prn": 137, "sbas_band": "L5", "carrier": "float"})


def test_a_base_station_of_one_frequency_is_refused() -> None:
    config = parse_config({"sbas": "stream", "sbas_prn": 137, "sbas_band": "L5"})
    with pytest.raises(SettingsError, match="a base station corrects single-frequency codes; leave out SBAS"):
        BaseStation(config, "stream")


def test_messages_kept_give_the_same_corrections() -> None:
    simulation = Simulation(scenario())
    messages = sbas_messages(simulation, SbasSettings(band="L5"))
    satellite, late = np.array(["G10", "G11", "E05", "J01"]), simulation.time(140, 150)
    whole = SbasState(prn=137, band="L5").add_messages(messages)
    kept = whole.drop_before(np.datetime64(late[0] + np.timedelta64(400, "s")))
    assert len(kept.messages) < len(whole.messages)
    for name in ("state", "position_m", "clock_m", "sigma_m", "growth_m"):
        one, other = (
            getattr(state.drop_before(late[0]).corrections.satellites(late, satellite, simulation.navigation), name)
            for state in (whole, SbasState(prn=137, band="L5", messages=messages))
        )
        np.testing.assert_array_equal(one, other)
