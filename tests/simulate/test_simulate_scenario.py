"""Scenario files; the sky of a navigation file; what other programs make of the written files."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from pydantic import BaseModel

from conftest import ROOT
from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.settings import validate
from railfix.core.settings_files import write_toml
from railfix.gnss import concatenate
from railfix.io.rinex import read_navigation, write_navigation, write_observations
from railfix.simulate import (
    Element,
    GeneratedLine,
    LineFile,
    LineSettings,
    ReceiverSettings,
    RunSettings,
    Scenario,
    Simulation,
    SkySettings,
    Station,
    list_scenarios,
    load_recipe,
    load_scenario,
    scenario_table,
    simulate_navigation,
    write_run,
)
from railfix.simulate.environment.settings import ElectrificationSettings, EnvironmentSettings, SectionSettings
from railfix.simulate.settings import (
    ErrorSettings,
    SatelliteErrorSettings,
    SatelliteFault,
    SensorSettings,
    SlipInterval,
    TachometerSettings,
)
from test_simulate_signals import corrected, whole

pytestmark = pytest.mark.requirement("D4")

QUIET = ReceiverSettings(code_sigma_m=0.0, phase_sigma_m=0.0, doppler_sigma_hz=0.0, cn0_sigma_dbhz=0.0)
FULL = Scenario(
    seed=3,
    start=np.datetime64("2024-12-31T23:59:59.123456700", "ns"),
    line=LineSettings(
        kind="elements",
        elements=(
            Element(kind="straight", length_m=400.0),
            Element(kind="transition", length_m=50.0),
            Element(kind="curve", length_m=100.0, radius_m=-400.0, cant_m=0.1),
            Element(kind="transition", length_m=50.0),
        ),
    ),
    run=RunSettings(stations=(Station(at_m=30.0), Station(at_m=500.0, name='say "halt"'))),
    sky=SkySettings(systems="GJEC", unhealthy=(), satellites_at_most=9),
    errors=ErrorSettings(
        satellites={"G": SatelliteErrorSettings(clock_sigma_m=0.5)},
        faults=(SatelliteFault(satellite="G07", start_s=5.0, step_m=20.0),),
    ),
    environment=EnvironmentSettings(
        electrification=ElectrificationSettings(beam_every=2),
        sections=(SectionSettings(from_m=0.0, to_m=50.0, kind="urban"),),
    ),
    sensors=SensorSettings(
        radar=None, tachometer=TachometerSettings(slips=(SlipInterval(start_s=1.0, end_s=2.0, ratio=0.5),))
    ),
)


def write_text(folder: Path, text: str, name: str = "scenario.toml") -> Path:
    (folder / name).write_text(text)
    return folder / name


# ---------------------------------------------------------------- files


@pytest.mark.parametrize("scenario", [Scenario(), FULL], ids=["default", "everything"])
def test_a_scenario_is_the_same_after_its_file(tmp_path: Path, scenario: Scenario) -> None:
    write_toml(tmp_path / "scenario.toml", scenario_table(scenario))
    assert load_scenario(tmp_path / "scenario.toml") == scenario
    names = scenario.describe()
    assert {"seed", "line.length_m", "run.cruise_mps", "environment.antenna_height_m"} <= set(names)
    assert not any(isinstance(value, BaseModel) for value in names.values())


def test_an_empty_file_is_the_default(tmp_path: Path) -> None:
    assert load_scenario(write_text(tmp_path, "")) == Scenario()


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("sede = 1", "unknown setting sede; known are .*, seed,"),
        ("[line]\nlenght_m = 9.0", "unknown setting line.lenght_m; known are .*, length_m,"),
        ("seed = 1.5", "seed: Input should be a valid integer, .* got 1.5"),
        ('duration_s = "long"', "duration_s: .*number"),
        ("rate_hz = 3", "multiple of 100 ns"),
        ("start = 2024-03-05T03:10:00Z", "GPS time without a zone"),
        ('start = "yesterday"', "start: must be a time"),
        ("start = 5", "start: must be a time"),
        ("run = 3", "run: .*valid dictionary"),
        ("[run]\nstations = 3", "run.stations: .*a list"),
        ("[run]\nstations = [{at_m = 30}, {dwell_s = 3}]", "run.stations.1.at_m is missing"),
        ("[run]\nstations = [{at_m = 30}, {at_m = 990}]", "990.0 m lies within"),
        ('[line]\nkind = "wiggly"', "setting line.kind: Input should be 'pattern', 'elements', 'generated' or 'file'"),
        ("[vehicle]\nfront = [1, 2]", "vehicle.front.2 is missing"),
        ('[sky]\nunhealthy = ["G01", 2]', "sky.unhealthy.1: .*string"),
        ("[sensors.ranging]\nsigma_m = 1", "unknown setting sensors.ranging.sigma_m; known are .*noise_sigma_m"),
        ("[errors.satellites.G]\nclock = 1", "unknown setting errors.satellites.G.clock"),
        ("[errors]\nsatellites = {G = 1}", "errors.satellites.G: .*valid dictionary"),
        ('[environment]\nsections = [{from_m = 0, to_m = 9, kind = "moon"}]', "environment.sections.0.kind"),
        ("[sensors.tachometer]\npulses_per_turn = 0", "sensors.tachometer.pulses_per_turn: .*greater than 0"),
        ('sensors = "all"', "sensors: .*valid dictionary"),
    ],
)
def test_wrong_settings_are_refused_by_file_and_key(tmp_path: Path, text: str, told: str) -> None:
    path = write_text(tmp_path, text)
    with pytest.raises(SettingsError, match=told) as refused:
        load_scenario(path)
    assert str(refused.value).startswith(f"{path}: ")


def test_none_is_a_word_and_sensors_come_with_their_table(tmp_path: Path) -> None:
    assert load_scenario(write_text(tmp_path, 'sensors = "none"')).sensors is None
    some = load_scenario(write_text(tmp_path, '[sensors]\nradar = "none"')).sensors
    assert some == SensorSettings(radar=None)


def test_a_duration_can_be_that_of_the_run(tmp_path: Path) -> None:
    stations = "stations = [{at_m = 30.0, dwell_s = 9.0}, {at_m = 530.0, dwell_s = 7.0}]"
    rest = "cruise_mps = 10.0\nacceleration_mps2 = 0.5\ndeceleration_mps2 = 1.0\nfirst_stand_s = 5.0"
    text = f'duration_s = "run"\n[run]\n{rest}\n{stations}\n'
    # 500 m: 100 m in 20 s, 50 m in 10 s, 350 m in 35 s; stands of 5 s and 7 s.
    assert load_scenario(write_text(tmp_path, text)).duration_s == pytest.approx(77.0, abs=1.0)
    back = load_scenario(write_text(tmp_path, text + 'direction = "falling"\n'))
    assert back.duration_s == pytest.approx(79.0, abs=1.0)


def test_paths_are_relative_to_the_file_that_names_them(tmp_path: Path) -> None:
    (tmp_path / "below").mkdir()
    write_navigation(simulate_navigation(Scenario()), tmp_path / "below" / "sky.nav")
    path = write_text(tmp_path / "below", '[sky]\nnav = "sky.nav"\nunhealthy = []')
    assert Simulation(load_scenario(path)).navigation.sources == (str(tmp_path / "below" / "sky.nav"),)
    recipe = '[parts.sky]\nsky.nav = "below/sky.nav"\nsky.unhealthy = []\n[[runs]]\nname = "a"\nparts = ["sky"]\n'
    (scenario,) = (load_recipe(write_text(tmp_path, recipe)).scenario(k) for k in range(1))
    assert scenario.sky.nav == str(tmp_path / "below" / "sky.nav")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('base = "demo"', "lists its runs"),
        ("runs = 3", "lists its runs"),
        ('[[runs]]\nname = "a"\n[[runs]]\nname = "a"', "unique name"),
        ("[[runs]]\nseed = 2", "unique name"),
        ('[[runs]]\nname = "../a"', "unique name"),
        ('seed = 3\n[[runs]]\nname = "a"', "unknown key seed in a recipe"),
        ('base = "p1-commercial"\n[[runs]]\nname = "a"', "recipe itself"),
        ('[[runs]]\nname = "a"\nparts = ["x"]', "has no table 'x'; its tables are"),
        ('[[runs]]\nname = "a"\nsede = 3', "run a: unknown setting sede"),
    ],
)
def test_recipes_that_are_none_are_refused(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(SettingsError, match=told):
        load_recipe(write_text(tmp_path, text)).scenario(0)


def test_files_that_are_no_scenarios(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match="not valid TOML"):
        load_scenario(write_text(tmp_path, "seed = "))
    with pytest.raises(InputFileError, match=r"shipped scenario: .*demo"):
        load_scenario("nothing")
    with pytest.raises(InputFileError, match="cannot be read"):
        load_scenario(tmp_path / "none.toml")
    with pytest.raises(SettingsError, match="use load_recipe"):
        load_scenario("p1-commercial")


# ---------------------------------------------------------------- shipped ones


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if k % 3 else n for k, n in enumerate(list_scenarios())]
)
def test_every_shipped_run_can_be_set_up(name: str) -> None:
    recipe = load_recipe(name)
    for number in {0, len(recipe.names) - 1}:
        scenario = recipe.scenario(number)
        simulation = Simulation(scenario.replaced(duration_s=1.0))
        assert len(simulation.channels) >= 6
        assert simulation.scenario.replaced(duration_s=scenario.duration_s) == scenario


def test_the_test_line_is_that_of_the_paper() -> None:
    """P1, table 1: 756 m, 189 points; table 2: 0.2 s, 12 min 34 s, two round trips."""
    scenario = load_scenario("p1-test-line")
    simulation = Simulation(scenario)
    track = simulation.line.track()
    assert len(track) == 189
    assert track.chainage_m[-1] == pytest.approx(756.0, abs=0.01)
    assert scenario.interval == np.timedelta64(200, "ms")
    assert scenario.duration_s == 12 * 60 + 34
    chainage, speed = simulation.motion.at(np.arange(0.0, scenario.duration_s, 0.2))
    ends = (np.abs(chainage - chainage.max()) < 0.01).astype(int)
    assert (np.diff(ends) == 1).sum() == 2, "twice at the far end"
    assert chainage[-1] == pytest.approx(chainage[0], abs=0.01)
    assert speed[-1] == 0.0


def test_the_commercial_runs_are_as_many_as_the_papers() -> None:
    """P1, chapter 5: 145.2 km and 100 240 positions; table 5: antennas 18.21 m apart, one clock."""
    recipe = load_recipe("p1-commercial")
    scenarios = [recipe.scenario(k) for k in range(len(recipe.names))]
    assert len(scenarios) == 4
    assert sum(s.line.length_m for s in scenarios) == pytest.approx(145_200.0)
    assert sum(2 * s.epochs for s in scenarios) >= 100_240
    for scenario in scenarios:
        assert scenario.vehicle.front[0] - scenario.vehicle.rear[0] == pytest.approx(18.21)
        assert scenario.receiver.clocks == "common"
        assert scenario.rate_hz == 10.0
        assert scenario.environment.electrification is not None
        kinds = {part.kind for part in scenario.environment.sections}
        assert kinds >= {"urban", "suburban", "mountain", "tunnel", "station"}
    assert {s.run.direction for s in scenarios} == {"rising", "falling"}


def test_the_campaign_is_2000_km_long() -> None:
    recipe = load_recipe("campaign-2000km")
    scenarios = [recipe.scenario(k, changes={"duration_s": 1.0}) for k in range(len(recipe.names))]
    lines = {s.line.generated.seed: s.line.length_m for s in scenarios}
    assert len(lines) == 4
    assert sum(lines.values()) == pytest.approx(171_000.0, abs=500.0), "P1, 4.1(1): four lines, 171 km"
    assert sum(s.line.length_m for s in scenarios) == pytest.approx(2_050_000.0, abs=30_000.0)
    assert len({s.seed for s in scenarios}) == len({s.start for s in scenarios}) == len(scenarios)
    assert len({(s.line.generated.seed, s.place_seed) for s in scenarios}) == 4, "a line is one place"


def test_everything_switched_on_is_cut_anyhow() -> None:
    """The same numbers by any cutting: errors, environment, carried noise and tracking included."""
    scenario = load_recipe("commercial-run").scenario(changes={"duration_s": 12.0}).replaced(rate_hz=5.0)
    scenario = scenario.replaced(run=scenario.run.replaced(first_stand_s=0.0))
    simulation = Simulation(scenario)
    expected = whole(scenario).observations
    joined = concatenate([p.observations for p in simulation.pieces("front", chunk_epochs=7)])
    for name in ("time", "satellite", "signal", "code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(expected, name))


def test_the_files_are_the_same_bytes_by_any_cutting(tmp_path: Path) -> None:
    simulation = Simulation(Scenario(duration_s=20.0))
    for size in (7, 64, 200):
        pieces = (piece.observations for piece in simulation.pieces("rear", chunk_epochs=size))
        write_observations(pieces, tmp_path / f"{size}.rnx")
    assert len({(tmp_path / f"{size}.rnx").read_bytes() for size in (7, 64, 200)}) == 1


def test_the_truth_tells_acceleration_and_what_stands_along_the_line(tmp_path: Path) -> None:
    sections = (
        SectionSettings(from_m=60.0, to_m=200.0, kind="urban"),
        SectionSettings(from_m=200.0, to_m=300.0, kind="tunnel"),
    )
    scenario = Scenario(duration_s=60.0, environment=EnvironmentSettings(sections=sections))
    files = write_run(scenario, tmp_path, packing="plain")
    assert pl.read_csv(files["sections"]).rows() == [
        (0.0, pytest.approx(60.0, abs=0.01), "open"),
        (pytest.approx(60.0, abs=0.01), pytest.approx(200.0, abs=0.01), "urban"),
        (pytest.approx(200.0, abs=0.01), pytest.approx(300.0, abs=0.01), "tunnel"),
        (pytest.approx(300.0, abs=0.01), pytest.approx(756.0, abs=0.01), "open"),
    ]
    truth = pl.read_csv(files["truth"]).filter(pl.col("antenna") == "front")
    chainage, kind = truth["chainage_m"].to_numpy(), truth["environment"].to_numpy()
    assert (kind[(chainage > 60.1) & (chainage < 199.9)] == "urban").all()
    assert (kind[(chainage > 200.1) & (chainage < 299.9)] == "tunnel").all()
    assert (kind[(chainage < 59.9) | (chainage > 300.1)] == "open").all()
    assert {"urban", "tunnel", "open"} == set(kind)
    speed, acceleration = truth["speed_mps"].to_numpy(), truth["acceleration_mps2"].to_numpy()
    even = acceleration[1:] == acceleration[:-1]
    assert np.diff(speed)[even] / 0.1 == pytest.approx(acceleration[:-1][even], abs=2e-3)
    assert set(acceleration) >= {0.0, 0.7}
    observed = whole(scenario).observations
    assert np.isnan(observed.code_m[kind == "tunnel"]).all()
    assert np.isfinite(observed.code_m[kind == "open"]).any(axis=1).all()


# ---------------------------------------------------------------- sky of a file


def test_a_made_sky_read_back_from_its_file_is_the_same_sky(tmp_path: Path) -> None:
    scenario = Scenario(duration_s=5.0, rate_hz=1.0, sky=SkySettings(systems="GJEC", unhealthy=()))
    write_navigation(simulate_navigation(scenario), tmp_path / "sky.rnx")
    filed = scenario.replaced(sky=scenario.sky.replaced(nav=str(tmp_path / "sky.rnx")))
    made, read = whole(scenario).observations, whole(filed).observations
    assert made.satellite.tolist() == read.satellite.tolist()
    np.testing.assert_allclose(made.code_m, read.code_m, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("systems", ["GE", "GEC"])
def test_a_real_sky_is_corrected_by_the_product(recordings: Path, systems: str) -> None:
    """A day of a station's navigation file: orbits, clocks and delays of both within a millimetre, over new records."""
    nav = recordings / "static" / "ESBC_2020177" / "ESBC00DNK_R_20201770000_01D_MN.rnx.gz"
    scenario = Scenario(
        start=np.datetime64("2020-06-25T09:50:00", "ns"),
        duration_s=1500.0,
        rate_hz=0.2,
        line=LineSettings(latitude_deg=55.5, longitude_deg=8.5),
        sky=SkySettings(nav=str(nav), systems=systems, unhealthy=()),
        receiver=QUIET.replaced(signals_per_satellite=2),
    )
    simulation = Simulation(scenario)
    residual = corrected(whole(scenario), simulation)
    assert np.isfinite(residual).mean() > 0.7
    assert np.nanmax(np.abs(residual)) < 1e-3
    if "C" in systems:
        assert "C05" in simulation.satellites, "a geostationary one"
    tags = scenario.start + np.timedelta64(1500, "s")
    records = simulation.navigation.kepler
    assert ((records.transmitted > scenario.start) & (records.transmitted < tags)).any()


def test_a_time_outside_of_the_file_is_refused(tmp_path: Path) -> None:
    write_navigation(simulate_navigation(Scenario()), tmp_path / "sky.rnx")
    sky = SkySettings(nav=str(tmp_path / "sky.rnx"), unhealthy=())
    for start, duration in (("2024-03-05T09:00:00", 10.0), ("2024-03-04T03:10:00", 10.0), ("2024-03-05T03:10:00", 3e4)):
        scenario = Scenario(start=np.datetime64(start, "ns"), duration_s=duration, sky=sky)
        with pytest.raises(MismatchError, match=r"sky\.rnx: no satellite .* reference times in the file"):
            simulate_navigation(scenario)
    navigation = replace(read_navigation(tmp_path / "sky.rnx"), klobuchar={})
    write_navigation(navigation, tmp_path / "bare.rnx")
    with pytest.raises(MismatchError, match="Klobuchar"):
        simulate_navigation(Scenario(sky=sky.replaced(nav=str(tmp_path / "bare.rnx"))))
    with pytest.raises(SettingsError, match="unhealthy"):
        SkySettings(nav="x")


# ---------------------------------------------------------------- other programs


def lines(folder: Path) -> dict[str, LineSettings]:
    """The other kinds of line, one each."""
    write_run(Scenario(duration_s=0.1), folder / "made")
    return {
        "elements": FULL.line,
        "generated": LineSettings(kind="generated", length_m=8_000.0, generated=GeneratedLine(seed=4)),
        "file": LineSettings(kind="file", file=LineFile(path=str(folder / "made" / "track.csv"))),
    }


@pytest.mark.parametrize("kind", ["elements", "generated", "file"])
@pytest.mark.every(5)
def test_rtklib_stands_where_the_antenna_is_on_any_line(tmp_path: Path, kind: str) -> None:
    """Everything switched off but the swaying: an independent single point is the truth within a centimetre."""
    program = shutil.which("rnx2rtkp")
    if program is None:
        pytest.skip("rnx2rtkp is not installed")
    scenario = Scenario(
        duration_s=90.0,
        rate_hz=1.0,
        line=lines(tmp_path)[kind],
        run=RunSettings(first_stand_s=3.0, cant_deficiency_m=0.05, direction="falling"),
        vehicle=Scenario().vehicle.replaced(sway_sigma_deg=1.0),
        sky=SkySettings(systems="GJEC", unhealthy=()),
        receiver=QUIET,
    )
    files = write_run(scenario, tmp_path / "run", packing="plain")
    (tmp_path / "single.conf").write_text(
        "pos1-posmode=single\npos1-frequency=l1\npos1-elmask=10\npos1-ionoopt=brdc\npos1-tropopt=saas\n"
        "pos1-navsys=57\nout-solformat=xyz\nout-timesys=gpst\nout-timeform=tow\n"
    )
    truth = pl.read_csv(files["truth"])
    assert (truth["environment"] == "open").all()
    assert truth["speed_mps"].min() < -5.0
    for antenna in ("front", "rear"):
        out = tmp_path / f"{antenna}.pos"
        command = [program, "-k", str(tmp_path / "single.conf"), "-o", str(out), str(files[antenna]), str(files["nav"])]
        subprocess.run(command, check=True, capture_output=True)
        rows = np.array([line.split()[:5] for line in out.read_text().splitlines() if line[0] != "%"], dtype=float)
        assert len(rows) == 90
        mine = truth.filter(pl.col("antenna") == antenna).select("x_m", "y_m", "z_m").to_numpy()
        assert np.linalg.norm(rows[:, 2:] - mine, axis=1).max() < 0.01


@pytest.mark.slow
def test_georinex_reads_the_files(tmp_path: Path) -> None:
    georinex = pytest.importorskip("georinex")
    scenario = Scenario(duration_s=3.0, rate_hz=1.0, sky=SkySettings(systems="GJE"))
    files = write_run(scenario, tmp_path, packing="plain")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of xarray, on how georinex calls it
        read, navigation = georinex.load(files["front"]), georinex.load(files["nav"])
    observed = whole(scenario).observations
    for k in np.flatnonzero(observed.signal == "1C"):
        name = str(observed.satellite[k])
        theirs = read["C1C"].sel(sv=name).to_numpy() if name in read["sv"].to_numpy() else np.full(3, np.nan)
        np.testing.assert_allclose(theirs, observed.code_m[:, k], atol=6e-4, equal_nan=True)
    assert {name[0] for name in navigation["sv"].to_numpy().tolist()} == {"G", "J", "E"}


def test_tables_of_settings_tell_what_is_known() -> None:
    with pytest.raises(SettingsError, match=r"known are .*bogie_distance_m"):
        validate(Scenario, tomllib.loads("[vehicle]\nbogie = 3"), source="here")


def test_the_files_of_the_document_are_scenarios(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "simulator.md").read_text(encoding="utf-8")
    one, many, *_ = re.findall(r"```toml\n(.*?)```", text, flags=re.DOTALL)
    scenario = load_scenario(write_text(tmp_path, one))
    assert scenario.duration_s > 60.0
    assert Simulation(scenario).line.length_m == pytest.approx(1000.0)
    assert [load_recipe(write_text(tmp_path, many)).scenario(k).run.direction for k in range(2)] == [
        "rising",
        "falling",
    ]
    for name in list_scenarios():
        assert f"\n- `{name}`: " in text
