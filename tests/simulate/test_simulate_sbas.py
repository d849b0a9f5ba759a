"""Simulated SBAS messages undo the simulated errors, decoded by railfix and by RTKLIB; the reference station."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from railfix.core.constants import FREQUENCY_L1, SPEED_OF_LIGHT
from railfix.core.geodesy import geodetic_from_ecef
from railfix.io import read_observations
from railfix.ranges.atmosphere import klobuchar_delay_m
from railfix.ranges.sbas import SatelliteState, SbasCorrections, SbasLimits, SbasMessages, read_sbas
from railfix.simulate import Scenario, Simulation, write_run
from railfix.simulate import sbas_service as service
from railfix.simulate.errors import SatelliteFault
from railfix.simulate.sbas_stream import sbas_messages, write_sbas
from railfix.simulate.scenario import ReferenceStation
from railfix.simulate.scenario_file import load_recipe
from railfix.simulate.settings import SbasSettings
from test_simulate_signals import whole

pytestmark = pytest.mark.requirement("D4")

#: As RTKLIB uses messages: as sent, at the second of their tag.
AS_RTKLIB = SbasLimits(range_rate="off", incomplete="inflate", message_s=0.0, max_udrei=13, type0="as_type2")


def scenario(duration_s: float = 240.0, **settings: object) -> Scenario:
    """The commercial run's errors at 1 Hz."""
    base = load_recipe("commercial-run").scenario(changes={"duration_s": duration_s})
    return base.replaced(rate_hz=1.0, sensors=None, sbas=SbasSettings(), **settings)


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return Simulation(scenario())


@pytest.fixture(scope="module")
def messages(simulation: Simulation) -> SbasMessages:
    return sbas_messages(simulation, SbasSettings())


def test_all_types_are_sent_one_message_a_second(messages: SbasMessages) -> None:
    assert set(messages.type.tolist()) == {1, 2, 3, 6, 7, 10, 18, 24, 25, 26}
    assert (np.diff(messages.time) == np.timedelta64(1, "s")).all()
    fast = messages.time[messages.type == 2]
    assert (np.diff(fast) == np.timedelta64(6, "s")).all()


def test_corrections_undo_clocks_delays_and_orbits(simulation: Simulation, messages: SbasMessages) -> None:
    """Along the line of sight, to half a step of clock and position and what they change until the next message."""
    corrections = SbasCorrections.from_log(messages)
    piece = whole(simulation.scenario)
    gps = np.array([name for name in simulation.satellites if name.startswith("G")])
    time = simulation.time()
    got = corrections.satellites(time, gps, simulation.navigation)
    assert (got.state == SatelliteState.OK).all()
    errors = simulation.compute_errors(gps.tolist())
    at = np.arange(len(time)) * 1.0
    clock = errors.clock_error_m(at) - errors.group_delay_m(gps.tolist(), ["1C"] * len(gps))
    assert np.abs(clock).max() > 0.8, "there is something to correct"
    assert np.abs(got.fast_m + SPEED_OF_LIGHT * got.clock_s - clock).max() < 0.0625 + 0.1
    orbit = errors.orbit_error_m(at)
    assert np.abs(orbit).max() > 1.0
    assert np.abs(got.position_m - orbit).max() < 0.0625 + 0.25
    assert len(piece.observations.satellite)


def test_the_grid_is_the_simulated_ionosphere(simulation: Simulation, messages: SbasMessages) -> None:
    """Slant delays above 15 deg: the grid's interpolation and the two mapping functions differ by decimetres."""
    corrections = SbasCorrections.from_log(messages)
    piece = whole(simulation.scenario)
    time = simulation.time()
    latitude, longitude, _ = geodetic_from_ecef(piece.geometry.antenna_ecef_m)
    elevation, azimuth = piece.geometry.elevation_deg, piece.geometry.azimuth_deg
    slant = corrections.ionosphere(time, latitude, longitude, elevation, azimuth)
    coefficients, l1 = simulation.navigation.klobuchar["G"], np.array(FREQUENCY_L1)
    simulated = klobuchar_delay_m(time, latitude, longitude, elevation, azimuth, coefficients, l1)
    places = latitude[:, None], longitude[:, None], elevation, azimuth
    simulated = simulated + simulation.common_errors.ionosphere_m(np.arange(len(time)) * 1.0, *places)
    high = elevation > 15.0
    difference = (slant.delay_m - simulated)[high]
    assert np.isfinite(difference).all()
    assert np.abs(difference).max() < 0.10 * simulated[high].max() + 0.3
    assert simulated[high].max() > 3.0


def test_rtklib_decodes_the_same(simulation: Simulation, messages: SbasMessages) -> None:
    from sbas_rtklib import replay

    engine = SbasCorrections.from_log(messages, limits=AS_RTKLIB)
    gps = np.array([f"G{number:02d}" for number in range(1, 31)])
    time = simulation.time()[::10]
    ours = engine.satellites(time, gps)
    compared = delays = 0
    for t, program in replay(messages, time):
        for k, name in enumerate(gps):
            theirs = program.satellite(time[t], name)
            assert (theirs is None) == (ours.state[t, k] != SatelliteState.OK)
            if theirs is not None:
                compared += 1
                assert np.abs(theirs[0] - ours.position_m[t, k]).max() < 1e-3
                clock_m = SPEED_OF_LIGHT * ours.clock_s[t, k] + ours.fast_m[t, k]
                assert abs(SPEED_OF_LIGHT * theirs[1] - clock_m) < 1e-3
        for azimuth in (0.0, 100.0, 200.0, 300.0):
            place = (np.array([35.0]), np.array([135.4]), np.array([[30.0]]), np.array([[azimuth]]))
            mine = engine.ionosphere(time[t : t + 1], *place).delay_m[0, 0]
            theirs_m = program.ionosphere(time[t], 35.0, 135.4, 30.0, azimuth)
            assert theirs_m is not None
            delays += 1
            assert abs(mine - theirs_m) < 1e-4
    assert compared > 600
    assert delays > 90


def test_a_fault_is_alerted_after_its_time() -> None:
    errors = scenario().errors.replaced(faults=(SatelliteFault(satellite="G07", start_s=60.0, step_m=50.0),))
    faulty = Simulation(scenario(150.0, errors=errors))
    corrections = SbasCorrections.from_log(sbas_messages(faulty, SbasSettings(alert_s=6.0)))
    state = corrections.satellites(faulty.time(), np.array(["G07", "G08"])).state
    assert (state[:60] == SatelliteState.OK).all()
    first = int(np.argmax(state[:, 0] == SatelliteState.DO_NOT_USE))
    # 6 s, up to 6 s until the satellite's message, 1 s on the air.
    assert 66 <= first <= 74
    assert (state[first:, 0] == SatelliteState.DO_NOT_USE).all()
    assert (state[:, 1] == SatelliteState.OK).all()


def test_messages_are_lost_and_come_back_from_their_file(simulation: Simulation, tmp_path: Path) -> None:
    full = sbas_messages(simulation, SbasSettings())
    lossy = sbas_messages(simulation, SbasSettings(lost_chance=0.2))
    assert len(lossy) / len(full) == pytest.approx(0.8, abs=0.07)
    write_sbas(lossy, tmp_path / "messages.sbs")
    read = read_sbas(tmp_path / "messages.sbs")
    assert (read.time == lossy.time).all()
    assert (read.bits[:, :29] == lossy.bits[:, :29]).all()
    assert not sum(read.rejected.values())


def test_a_value_that_does_not_fit_its_field_is_an_error() -> None:
    with pytest.raises(ValueError, match="type 2: 4800 does not fit into 12 bits"):
        service.fast(0, [600.0], [5])
    with pytest.raises(ValueError, match="no field brr"):
        service.parameters(0, brr=1)


# Reference station ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_station_stands_still_shares_the_errors_and_changes_no_train() -> None:
    plain, with_station = (scenario(60.0, stations=s) for s in ((), (ReferenceStation(chainage_m=200.0),)))
    train, base = Simulation(with_station), Simulation(with_station)
    front, station = next(train.pieces("front")), next(base.pieces("station"))
    before = whole(plain)
    np.testing.assert_array_equal(front.observations.code_m, before.observations.code_m)
    assert np.ptp(station.geometry.antenna_ecef_m, axis=0).max() == 0.0
    height = geodetic_from_ecef(station.geometry.antenna_ecef_m[:1])[2] - geodetic_from_ecef(train.line.at([200.0]))[2]
    assert height[0] == pytest.approx(10.0, abs=0.01)
    place = train.line.at([200.0])[0]
    assert np.linalg.norm(station.geometry.antenna_ecef_m[0] - place) == pytest.approx(np.hypot(50.0, 10.0), abs=1e-6)
    # Satellites and atmosphere in common; inter-system biases, which are the receivers', are in both.
    both = np.isfinite(station.error_m) & np.isfinite(front.error_m)
    assert np.abs(station.error_m - front.error_m)[both].max() < 0.02
    assert np.abs(station.error_m[both]).max() > 1.0
    # Nothing is in its way: the codes are the clean ones and noise.
    noise = (station.observations.code_m - station.clean_code_m) / station.code_sigma_m
    assert np.nanstd(noise) == pytest.approx(1.0, rel=0.15)
    assert np.nanmax(np.abs(noise)) < 6.0


def test_messages_and_station_are_written(tmp_path: Path) -> None:
    files = write_run(scenario(3.0, stations=(ReferenceStation(),)), tmp_path, packing="plain")
    assert files["sbas"].name == "messages.sbs"
    assert len(read_sbas(files["sbas"])) == 303
    station = read_observations(files["station"])
    assert len(station) == 3
    simulation = Simulation(scenario(3.0, stations=(ReferenceStation(),)))
    true = simulation.truth("station", np.zeros(1))[0].ecef_m[0]
    assert station.header.approximate_ecef_m == pytest.approx(true, abs=1e-3)


@pytest.mark.slow
def test_a_fault_of_one_station_is_its_own() -> None:
    """Three stations (P3, 3): a receiver fault shows in one of them, a satellite fault in all."""
    seen = [name for name in Simulation(scenario(5.0)).satellites if name.startswith("G")]
    own = SatelliteFault(satellite=seen[0], start_s=10.0, ramp_mps=2.0)
    common = SatelliteFault(satellite=seen[1], start_s=10.0, step_m=30.0)
    stations = tuple(
        ReferenceStation(name=name, chainage_m=at, faults=(own,) if name == "b" else ())
        for name, at in (("a", 100.0), ("b", 600.0), ("c", 1100.0))
    )
    errors = scenario().errors.replaced(faults=(common,))
    simulation = Simulation(scenario(30.0, stations=stations, errors=errors))
    without_common = Simulation(scenario(30.0, stations=stations))
    for station in stations:
        piece = next(simulation.pieces(station.name))
        without = next(without_common.pieces(station.name))
        added = dict(zip(piece.observations.satellite.tolist(), (piece.error_m - without.error_m).T, strict=True))
        time = np.arange(30.0)
        assert added[seen[1]] == pytest.approx(np.where(time >= 10.0, 30.0, 0.0), abs=1e-6)
        healthy = (ReferenceStation(chainage_m=station.chainage_m),)
        other = next(Simulation(scenario(30.0, stations=healthy)).pieces("station"))
        ramp = (without.error_m - other.error_m)[:, piece.observations.satellite == seen[0]][:, 0]
        expected = 2.0 * np.maximum(time - 10.0, 0.0) if station.name == "b" else 0.0 * time
        assert ramp == pytest.approx(expected, abs=1e-6)
