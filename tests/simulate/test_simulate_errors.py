"""Each error of the simulated signals, switched on alone, gives its own statistics back; switched off, nothing."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.errors import SettingsError
from railfix.core.geodesy import geodetic_from_ecef
from railfix.gnss import carrier_frequency_hz, concatenate
from railfix.ranges.atmosphere import thin_shell_obliquity
from railfix.simulate import (
    Disturbance,
    Piece,
    ReceiverSettings,
    RunSettings,
    Scenario,
    SightGeometry,
    Simulation,
    SkySettings,
)
from railfix.simulate.constellation import links
from railfix.simulate.errors import CommonErrors, GaussMarkov
from railfix.simulate.receiver import CarriedNoise, NoiseSettings, TrackingNoise, TrackingSettings
from railfix.simulate.settings import (
    ClockWalkSettings,
    ErrorSettings,
    InterSystemSettings,
    IonosphereErrorSettings,
    SatelliteErrorSettings,
    SatelliteFault,
    TroposphereErrorSettings,
)

pytestmark = pytest.mark.requirement("D4")

QUIET = ReceiverSettings(code_sigma_m=0.0, phase_sigma_m=0.0, doppler_sigma_hz=0.0, cn0_sigma_dbhz=0.0)
STANDING = RunSettings(first_stand_s=1e5)
#: An hour and more at 1 Hz, the train standing.
LONG = {"duration_s": 3600.0, "rate_hz": 1.0, "run": STANDING, "receiver": QUIET}


def whole(scenario: Scenario, antenna: str = "front") -> Piece:
    (piece,) = Simulation(scenario).pieces(antenna, chunk_epochs=scenario.epochs)
    return piece


#: Runs without errors by scenario and antenna, which many tests compare with.
WITHOUT: dict[tuple[str, str], Piece] = {}


def on_and_off(errors: ErrorSettings, antenna: str = "front", **settings: object) -> tuple[Piece, Piece]:
    """The same run with the errors and without."""
    scenario = Scenario(**settings)  # type: ignore[arg-type]
    key = (repr(scenario), antenna)
    if key not in WITHOUT:
        WITHOUT[key] = whole(scenario, antenna)
    return whole(scenario.replaced(errors=errors), antenna), WITHOUT[key]


def added_m(on: Piece, off: Piece) -> tuple[np.ndarray, np.ndarray]:
    """What the errors have added to code and phase, shapes (T, M) [m]."""
    observed = on.observations
    length = SPEED_OF_LIGHT / carrier_frequency_hz(observed.satellite, observed.signal)
    return (observed.code_m - off.observations.code_m, (observed.phase_cycles - off.observations.phase_cycles) * length)


def correlation(series: np.ndarray, lag: int) -> float:
    """Autocorrelation over all columns of zero mean, NaN left out."""
    return float(np.nanmean(series[lag:] * series[:-lag]) / np.nanmean(series**2))


def check_process(series: np.ndarray, sigma: float, time_s: float, *, interval_s: float = 1.0) -> None:
    """Standard deviation and correlation time of a Gauss-Markov process within 5 %."""
    assert np.sqrt(np.nanmean(series**2)) == pytest.approx(sigma, rel=0.05)
    lag = max(1, round(time_s / interval_s / 2.0))
    assert -lag * interval_s / np.log(correlation(series, lag)) == pytest.approx(time_s, rel=0.05)


def axes_of(simulation: Simulation, piece: Piece) -> tuple[np.ndarray, np.ndarray]:
    """Line of sight, shape (T, M, 3), and the axes radial, along, cross, shape (3, T, M, 3), by differences."""
    tag, place = piece.observations.time, piece.geometry.antenna_ecef_m
    late = piece.clock_m / SPEED_OF_LIGHT
    names = piece.observations.satellite.tolist()
    now, after = (
        np.stack([links(simulation.navigation.kepler, n, tag, late - d, place).satellite_ecef_m for n in names], axis=1)
        for d in (0.0, 1.0)
    )
    sight = now - place[:, None]
    sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
    velocity = after - now + np.cross([0.0, 0.0, 7.2921151467e-5], now)
    cross = np.cross(now, velocity)
    along = np.cross(cross, now)
    axes = np.stack([now, along, cross])
    return sight, axes / np.linalg.norm(axes, axis=-1, keepdims=True)


def test_nothing_is_added_by_default() -> None:
    """Every value, bit by bit, whatever the settings' times and shares are while the sigmas are 0."""
    silent = ErrorSettings(
        satellites={"G": SatelliteErrorSettings(clock_time_s=7.0)},
        noise=NoiseSettings(code_correlation_time_s=9.0),
        tracking=TrackingSettings(threshold_dbhz=0.0),
    )
    on, off = on_and_off(silent, duration_s=20.0)
    for name in ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock"):
        np.testing.assert_array_equal(getattr(on.observations, name), getattr(off.observations, name))
    assert (on.error_m == 0.0).all()


@pytest.mark.slow
def test_satellite_clocks_give_their_sigma_and_correlation_time_back() -> None:
    errors = ErrorSettings(
        satellites={
            "G": SatelliteErrorSettings(clock_sigma_m=0.8, clock_time_s=8.0),
            "E": SatelliteErrorSettings(clock_sigma_m=0.3, clock_time_s=4.0),
        }
    )
    on, off = on_and_off(errors, **(LONG | {"duration_s": 7200.0}))
    code, phase = added_m(on, off)
    system = on.observations.satellite.astype("<U1")
    check_process(code[:, system == "G"], 0.8, 8.0)
    check_process(code[:, system == "E"], 0.3, 4.0)
    assert np.nanmax(np.abs(code[:, system == "J"])) == 0.0
    np.testing.assert_allclose(phase, code, atol=1e-6)
    np.testing.assert_allclose(on.error_m[np.isfinite(code)], code[np.isfinite(code)], atol=1e-7)
    # A clock that is ahead shortens the code.
    when = (on.observations.time - Scenario().start) / np.timedelta64(1, "s") - on.clock_m / SPEED_OF_LIGHT
    simulation = Simulation(Scenario(**LONG | {"duration_s": 7200.0}, errors=errors))  # type: ignore[arg-type]
    column = [simulation.satellites.index(name) for name in on.observations.satellite]
    ahead = simulation.common_errors.clock_error_m(when)[:, column]
    np.testing.assert_allclose(code[np.isfinite(code)], -ahead[np.isfinite(code)], atol=1e-6)
    # From satellite to satellite nothing is alike: 450 independent samples.
    table = code[:, np.isfinite(code).all(axis=0) & (system != "J")]
    apart = np.corrcoef(table.T)[np.triu_indices(table.shape[1], 1)]
    assert np.abs(apart).max() < 4.0 / np.sqrt(450.0)


@pytest.mark.parametrize(
    ("axis", "name"),
    [
        pytest.param(0, "radial_sigma_m", marks=pytest.mark.slow),
        (1, "along_sigma_m"),
        pytest.param(2, "cross_sigma_m", marks=pytest.mark.slow),
    ],
)
@pytest.mark.slow
def test_orbit_errors_act_through_the_line_of_sight(axis: int, name: str) -> None:
    table = SatelliteErrorSettings(**{name: 2.0}, orbit_time_s=20.0)
    errors = ErrorSettings(satellites=dict.fromkeys("GJE", table))
    scenario = Scenario(**LONG)  # type: ignore[arg-type]
    on, off = on_and_off(errors, **LONG)
    sight, axes = axes_of(Simulation(scenario), off)
    share = np.einsum("tmi,tmi->tm", sight, axes[axis])
    code, phase = added_m(on, off)
    series = np.where(np.abs(share) > 0.05, code / share, np.nan)
    assert np.isfinite(series).sum() > 40_000
    check_process(series, 2.0, 20.0)
    np.testing.assert_allclose(phase, code, atol=1e-6)


def test_group_delay_errors_are_constants_of_the_codes() -> None:
    sigma = 0.6
    table = SatelliteErrorSettings(group_delay_sigma_m=sigma)
    errors = ErrorSettings(satellites={"G": table, "E": table})
    on, off = on_and_off(errors, duration_s=30.0, receiver=QUIET)
    code, phase = added_m(on, off)
    assert np.nanmax(np.abs(phase)) == 0.0
    assert np.nanmax(np.abs(code - code[:1])) < 1e-7
    names = [f"{letter}{k:02d}" for letter in "GE" for k in range(1, 100)]
    drawn = np.concatenate(
        [
            CommonErrors(
                errors, seed=seed, start=Scenario().start, duration_s=1.0, origin_deg=(35.0, 135.0),
                records=Simulation(Scenario()).navigation.kepler, satellites=names,
            ).group_delay_m(names, ["1C"] * len(names))
            for seed in range(10)
        ]
    )  # fmt: skip
    assert drawn.std() == pytest.approx(sigma, rel=0.05)


@pytest.mark.slow
def test_residual_ionosphere_is_vertical_delay_times_mapping() -> None:
    """A second apart in correlation: 7200 samples of one process."""
    errors = ErrorSettings(ionosphere=IonosphereErrorSettings(vertical_sigma_m=0.5, vertical_time_s=1.0))
    receiver = QUIET.replaced(signals_per_satellite=2)
    settings = LONG | {"duration_s": 7200.0, "sky": SkySettings(systems="G"), "receiver": receiver}
    on, off = on_and_off(errors, **settings)
    code, phase = added_m(on, off)
    # DO-229D A.4.4.10.4, written as 1 / cos(arcsin(...)).
    mapping = 1.0 / np.cos(np.arcsin(6378.1363 / 6728.1363 * np.cos(np.radians(on.geometry.elevation_deg))))
    scale = (1575.42e6 / carrier_frequency_hz(on.observations.satellite, on.observations.signal)) ** 2
    assert set(np.round(scale, 3)) == {1.0, 1.647}
    vertical = code / mapping / scale
    assert np.nanmax(np.nanmax(vertical, axis=1) - np.nanmin(vertical, axis=1)) < 1e-6
    check_process(np.nanmean(vertical, axis=1)[:, None], 0.5, 1.0)
    np.testing.assert_allclose(phase, -code, atol=1e-6)
    np.testing.assert_allclose(on.error_m[np.isfinite(code)], code[np.isfinite(code)], atol=1e-6)


def test_ionospheric_gradient_grows_with_the_pierce_point() -> None:
    errors = ErrorSettings(ionosphere=IonosphereErrorSettings(gradient_mm_per_km=2.0, gradient_azimuth_deg=30.0))
    on, off = on_and_off(errors, duration_s=2.0, receiver=QUIET)
    vertical = added_m(on, off)[0] / thin_shell_obliquity(on.geometry.elevation_deg)
    rtk = pytest.importorskip("pyrtklib5")
    latitude, longitude, _ = geodetic_from_ecef(Simulation(Scenario()).line.at(np.zeros(1)))
    # On the ellipsoid: RTKLIB puts the height of the place, 162 m, to the Earth's radius.
    place = np.array([np.radians(latitude[0]), np.radians(longitude[0]), 0.0])
    for k in np.flatnonzero(np.isfinite(vertical[0])):
        direction = np.radians([on.geometry.azimuth_deg[0, k], on.geometry.elevation_deg[0, k]])
        pierced = rtk.Arr1Ddouble(3)
        rtk.ionppp(_doubles(rtk, place), _doubles(rtk, direction), 6378.1363, 350.0, pierced)
        north = 6378.1363 * (pierced[0] - place[0])
        east = 6378.1363 * np.cos(place[0]) * (pierced[1] - place[1])
        expected = 2e-3 * (north * np.cos(np.radians(30.0)) + east * np.sin(np.radians(30.0)))
        # The antenna stands within 40 m of where the gradient begins.
        assert vertical[0, k] == pytest.approx(expected, abs=1e-4)
    assert np.nanmax(np.abs(vertical)) > 0.5


def _doubles(rtk: object, values: np.ndarray) -> object:
    array = rtk.Arr1Ddouble(len(values))  # type: ignore[attr-defined]
    for k, value in enumerate(values):
        array[k] = float(value)
    return array


@pytest.mark.slow
def test_residual_troposphere_is_zenith_delay_times_mapping() -> None:
    errors = ErrorSettings(troposphere=TroposphereErrorSettings(zenith_sigma_m=0.05, zenith_time_s=1.0))
    on, off = on_and_off(errors, **(LONG | {"duration_s": 7200.0, "sky": SkySettings(systems="G")}))
    code, phase = added_m(on, off)
    zenith = code * np.sqrt(0.002001 + np.sin(np.radians(on.geometry.elevation_deg)) ** 2) / 1.001
    assert np.nanmax(np.nanmax(zenith, axis=1) - np.nanmin(zenith, axis=1)) < 1e-6
    check_process(np.nanmean(zenith, axis=1)[:, None], 0.05, 1.0)
    np.testing.assert_allclose(phase, code, atol=1e-6)


def full(time_s: float = 60.0) -> ErrorSettings:
    """Everything at once."""
    table = SatelliteErrorSettings(
        clock_sigma_m=0.8, clock_time_s=time_s, radial_sigma_m=0.3, along_sigma_m=1.0, cross_sigma_m=0.6,
        orbit_time_s=time_s, group_delay_sigma_m=0.3,
    )  # fmt: skip
    return ErrorSettings(
        satellites=dict.fromkeys("GJE", table),
        ionosphere=IonosphereErrorSettings(vertical_sigma_m=0.5, vertical_time_s=time_s, gradient_mm_per_km=1.0),
        troposphere=TroposphereErrorSettings(zenith_sigma_m=0.05, zenith_time_s=time_s),
        faults=(SatelliteFault(satellite="G06", start_s=2.0, end_s=4.0, step_m=3.0, ramp_mps=0.5),),
        clock=ClockWalkSettings(walk_m_per_sqrt_s=0.05, frequency_walk_mps_per_sqrt_s=0.01),
        intersystem={"E": InterSystemSettings(offset_m=4.0, drift_mps=0.01, rear_difference_m=1.0)},
        noise=NoiseSettings(code_correlated_share=0.6, cn0_wander_sigma_db=2.0, weak_signals="all"),
        tracking=TrackingSettings(threshold_dbhz=36.0, reacquisition_s=0.7, slips="after_loss"),
    )


@pytest.mark.parametrize("size", [pytest.param(1, marks=pytest.mark.slow), 7, 64])
def test_any_cutting_gives_the_same_numbers_with_all_errors(size: int) -> None:
    scenario = Scenario(duration_s=7.0, errors=full())
    simulation = Simulation(scenario)
    expected = whole(scenario).observations
    assert expected.loss_of_lock.any()
    joined = concatenate([p.observations for p in simulation.pieces("front", chunk_epochs=size)])
    for name in ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(expected, name))


def test_the_antennas_and_a_station_beside_the_line_have_the_errors_in_common() -> None:
    common = full().replaced(intersystem={}, faults=())
    scenario = Scenario(duration_s=5.0, receiver=QUIET, errors=common)
    front, rear = whole(scenario, "front"), whole(scenario, "rear")
    assert np.abs(front.error_m).max() > 1.0
    # The gradient's share of 18 m is 0.02 mm in the vertical; the clocks are some 0.2 ms apart.
    np.testing.assert_allclose(front.error_m, rear.error_m, atol=1e-3)
    mine = Simulation(scenario).common_errors
    assert mine.active
    # Another sky and another length of the run change nothing for a satellite that both see.
    station = CommonErrors(
        common, seed=scenario.seed, start=scenario.start, duration_s=500.0, origin_deg=(35.0, 135.0),
        records=Simulation(scenario).navigation.kepler, satellites=("E05", "G06"),
    )  # fmt: skip
    column = Simulation(scenario).satellites.index("G06")
    when = np.linspace(0.0, 5.0, 7)
    np.testing.assert_array_equal(station.clock_error_m(when)[:, 1], mine.clock_error_m(when)[:, column])
    np.testing.assert_allclose(station.orbit_error_m(when)[:, 1], mine.orbit_error_m(when)[:, column], atol=1e-6)


def test_gauss_markov_processes_are_what_they_are_called() -> None:
    """500 columns of 100 correlation times: within 1 % of sigma, 2 % of the autocorrelation at five lags."""
    process = GaussMarkov([(k,) for k in range(500)], sigma=2.0, time_s=10.0, duration_s=1000.0)
    series = process.at(np.arange(0.0, 1000.0, 0.7))
    assert series.std() == pytest.approx(2.0, rel=0.01)
    assert series.std(axis=1).std() < 0.1
    for lag in (1, 4, 8, 14, 28):
        assert correlation(series, lag) == pytest.approx(np.exp(-0.07 * lag), abs=0.02)
    assert np.abs(series[0]).max() > 4.0, "in force from the start on"


def test_a_run_that_lasts_longer_begins_the_same() -> None:
    keys, when = [(1, 2), (1, 3)], np.linspace(0.0, 50.0, 101)
    short, long = (GaussMarkov(keys, sigma=1.0, time_s=30.0, duration_s=d) for d in (50.0, 5000.0))
    np.testing.assert_array_equal(short.at(when), long.at(when))
    with pytest.raises(ValueError, match="outside"):
        short.at(np.array([100.0]))


@pytest.mark.parametrize("bias_s", [9.9e-3, -9.9e-3])
def test_a_clock_that_is_far_off_asks_for_instants_outside_of_the_run(bias_s: float) -> None:
    errors = ErrorSettings(troposphere=TroposphereErrorSettings(zenith_sigma_m=0.1, zenith_time_s=0.05))
    piece = whole(Scenario(duration_s=1.0, receiver=QUIET.replaced(clock_bias_s=bias_s), errors=errors))
    assert np.abs(piece.error_m).max() > 0.1


def test_rates_are_those_of_the_values() -> None:
    process = GaussMarkov([(5,)], sigma=1.0, time_s=30.0, duration_s=100.0)
    when = np.linspace(0.0, 99.0, 1234)
    central = (process.at(when + 1e-4) - process.at(when - 1e-4)) / 2e-4
    np.testing.assert_allclose(process.rate(when), central, atol=1e-4)


def test_doppler_is_the_rate_of_the_phase_with_errors_too() -> None:
    """Simpson's rule over 0.2 s; the train stands."""
    fault = SatelliteFault(satellite="G06", start_s=-1.0, ramp_mps=2.0)
    errors = full(600.0).replaced(tracking=TrackingSettings(), faults=(fault,), clock=ClockWalkSettings())
    even = QUIET.replaced(clock_drift=0.0)
    observed = whole(Scenario(duration_s=30.0, run=STANDING, receiver=even, errors=errors)).observations
    change = -(observed.phase_cycles[2:] - observed.phase_cycles[:-2])
    rate = (observed.doppler_hz[2:] + 4.0 * observed.doppler_hz[1:-1] + observed.doppler_hz[:-2]) / 6.0
    assert np.nanmax(np.abs(change / 0.2 - rate)) < 2e-3


def test_faults_are_steps_and_ramps_of_one_satellite() -> None:
    faults = (
        SatelliteFault(satellite="G06", start_s=2.0, end_s=4.0, step_m=30.0),
        SatelliteFault(satellite="J01", start_s=5.0, ramp_mps=0.5),
    )
    on, off = on_and_off(ErrorSettings(faults=faults), duration_s=10.0, receiver=QUIET)
    code, phase = added_m(on, off)
    time = np.arange(100) * 0.1
    names = on.observations.satellite
    step, ramp = code[:, names == "G06"][:, 0], code[:, names == "J01"][:, 0]
    np.testing.assert_allclose(step, np.where((time > 1.99) & (time < 3.99), 30.0, 0.0), atol=1e-6)
    np.testing.assert_allclose(ramp, np.where(time > 4.99, 0.5 * (time - 5.0), 0.0), atol=1e-6)
    np.testing.assert_allclose(phase, code, atol=1e-6)
    assert np.nanmax(np.abs(code[:, ~np.isin(names, ("G06", "J01"))])) == 0.0
    doppler = (on.observations.doppler_hz - off.observations.doppler_hz)[:, names == "J01"][:, 0]
    np.testing.assert_allclose(doppler, np.where(time > 4.99, -0.5 * 1575.42e6 / SPEED_OF_LIGHT, 0.0), atol=1e-6)


def test_receiver_clocks_walk() -> None:
    base = {"duration_s": 7200.0, "rate_hz": 1.0, "run": STANDING, "receiver": QUIET}
    time = np.arange(7200.0)

    def wander(errors: ClockWalkSettings, antenna: str = "front", clocks: str = "separate") -> np.ndarray:
        scenario = Scenario(**base | {"receiver": QUIET.replaced(clocks=clocks)})  # type: ignore[arg-type]
        on = Simulation(scenario.replaced(errors=ErrorSettings(clock=errors)))
        off = Simulation(scenario)
        return (on.clocks.bias_s(antenna, time) - off.clocks.bias_s(antenna, time)) * SPEED_OF_LIGHT

    walk = wander(ClockWalkSettings(walk_m_per_sqrt_s=0.05))
    assert walk[0] == 0.0
    assert np.diff(walk).std() == pytest.approx(0.05, rel=0.05)
    assert np.diff(walk[::10]).std() == pytest.approx(0.05 * np.sqrt(10.0), rel=0.05)
    assert correlation(np.diff(walk)[:, None], 1) == pytest.approx(0.0, abs=0.05)
    # The second difference of a walk of the drift, by the trapezoid rule: steps / 2 of two neighbours.
    drift = wander(ClockWalkSettings(frequency_walk_mps_per_sqrt_s=0.02))
    assert np.diff(drift, 2).std() == pytest.approx(0.02 / np.sqrt(2.0), rel=0.05)
    other = wander(ClockWalkSettings(walk_m_per_sqrt_s=0.05), "rear")
    assert abs(np.corrcoef(np.diff(walk), np.diff(other))[0, 1]) < 4.0 / np.sqrt(7199)
    shared = [wander(ClockWalkSettings(walk_m_per_sqrt_s=0.05), a, "common") for a in ("front", "rear")]
    np.testing.assert_array_equal(shared[0], shared[1])
    # In code, phase and Doppler.
    errors = ErrorSettings(clock=ClockWalkSettings(frequency_walk_mps_per_sqrt_s=0.02))
    on, off = on_and_off(errors, **(base | {"duration_s": 300.0}))
    code, phase = added_m(on, off)
    for added in (code, phase):
        # A clock that is later tags an instant that is earlier: the range's rate times some nanoseconds.
        np.testing.assert_allclose(np.nanmedian(added, axis=1), drift[:300], atol=1e-3)
    rate = -(on.observations.doppler_hz - off.observations.doppler_hz) * SPEED_OF_LIGHT / 1575.42e6
    np.testing.assert_allclose(np.nanmedian(rate, axis=1)[1:-1], (drift[2:300] - drift[:298]) / 2.0, atol=1e-4)


def test_constellations_are_offset() -> None:
    errors = ErrorSettings(intersystem={"E": InterSystemSettings(offset_m=-4.0, drift_mps=0.02, rear_difference_m=1.5)})
    for antenna, start in (("front", -4.0), ("rear", -2.5)):
        on, off = on_and_off(errors, antenna, duration_s=20.0, receiver=QUIET)
        code, phase = added_m(on, off)
        mine = on.observations.satellite.astype("<U1") == "E"
        expected = np.broadcast_to((start + 0.02 * np.arange(200) * 0.1)[:, None], (200, mine.sum()))
        np.testing.assert_allclose(code[:, mine], expected, atol=1e-6)
        np.testing.assert_allclose(phase[:, mine], expected, atol=1e-6)
        doppler = (on.observations.doppler_hz - off.observations.doppler_hz)[:, mine]
        np.testing.assert_allclose(doppler, -0.02 * 1575.42e6 / SPEED_OF_LIGHT, atol=1e-6)
        assert np.nanmax(np.abs(code[:, ~mine])) == 0.0


def noise_of(noise: NoiseSettings, **settings: object) -> tuple[Piece, np.ndarray]:
    """Code noise in its sigmas."""
    piece = whole(Scenario(errors=ErrorSettings(noise=noise), **settings))  # type: ignore[arg-type]
    return piece, (piece.observations.code_m - piece.clean_code_m) / piece.code_sigma_m


@pytest.mark.slow
def test_code_noise_is_correlated_as_it_is_said() -> None:
    """At 10 Hz: share * exp(-lag / time) at lags of 0.1 s and 1 s; the standard deviation stays."""
    noise = NoiseSettings(code_correlated_share=0.7, code_correlation_time_s=1.0)
    _, normal = noise_of(noise, duration_s=600.0)
    assert np.nanstd(normal) == pytest.approx(1.0, rel=0.02)
    assert correlation(normal, 1) == pytest.approx(0.7 * np.exp(-0.1), rel=0.05)
    assert correlation(normal, 10) == pytest.approx(0.7 * np.exp(-1.0), rel=0.05)
    # A code loop alone, and what P1's Doppler screen sees of it: the change in 0.1 s.
    _, loop = noise_of(noise.replaced(code_correlated_share=1.0), duration_s=600.0)
    assert np.nanstd(np.diff(loop, axis=0)) == pytest.approx(np.sqrt(2.0 * (1.0 - np.exp(-0.1))), rel=0.05)
    # Channels are independent: 300 correlation times.
    table = normal[:, np.isfinite(normal).all(axis=0)]
    apart = np.corrcoef(table.T)[np.triu_indices(table.shape[1], 1)]
    assert np.abs(apart).max() < 4.0 / np.sqrt(300.0)


def test_carried_noise_of_two_receivers_is_apart() -> None:
    sizes = {"channels": 20, "interval_s": 0.1}
    settings = NoiseSettings(code_correlated_share=1.0)
    one, other = (
        CarriedNoise(settings, key=(1, k), **sizes).code(np.zeros((5000, 20)))  # type: ignore[arg-type]
        for k in (0, 1)
    )
    assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 4.0 / np.sqrt(5000 * 20 / 20)


def test_carried_noise_is_in_force_from_the_first_epoch_on() -> None:
    settings = NoiseSettings(code_correlated_share=1.0, cn0_wander_sigma_db=2.0)
    carried = CarriedNoise(settings, key=(7,), channels=10_000, interval_s=0.1)
    assert carried.code(np.zeros((1, 10_000))).std() == pytest.approx(1.0, rel=0.03)
    first = carried.cn0_db(1)
    assert np.std(first) == pytest.approx(2.0, rel=0.03)


def weaker(geometry: SightGeometry) -> Disturbance:
    """10 dB less for the second half of the channels."""
    none = np.zeros(geometry.elevation_deg.shape)
    half = np.arange(none.shape[1]) >= none.shape[1] // 2
    return Disturbance(code_m=none, phase_m=none, doppler_hz=none, cn0_db=np.where(half, -10.0, 0.0) + none)


def test_noise_grows_as_cn0_falls() -> None:
    """10 dB less C/N0 by the disturbance: sqrt(10) times the noise of code, phase and Doppler."""
    receiver = ReceiverSettings(cn0_sigma_dbhz=0.0)
    settings = {"duration_s": 300.0, "receiver": receiver, "run": STANDING, "multipath": (weaker,)}
    on = whole(Scenario(errors=ErrorSettings(noise=NoiseSettings(weak_signals="all")), **settings))  # type: ignore[arg-type]
    clean = whole(Scenario(**(settings | {"receiver": QUIET})))  # type: ignore[arg-type]
    observed, truth = on.observations, clean.observations
    weak = 10.0 ** ((45.0 - np.minimum(observed.cn0_dbhz, 50.0)) / 20.0)
    sine = np.sin(np.radians(on.geometry.elevation_deg))
    half = np.arange(weak.shape[1]) >= weak.shape[1] // 2
    length = SPEED_OF_LIGHT / carrier_frequency_hz(observed.satellite, observed.signal)
    normal = {
        "code": (observed.code_m - truth.code_m) / (0.5 * weak / sine),
        "phase": (observed.phase_cycles - truth.phase_cycles) * length / (0.002 * weak),
        "doppler": (observed.doppler_hz - truth.doppler_hz) / (0.05 * weak),
    }
    for series in normal.values():
        for part in (half, ~half):
            assert np.nanstd(series[:, part]) == pytest.approx(1.0, rel=0.05)
    # The weak half is indeed weaker than the curve of its elevation.
    curve = np.round((34.0 + 16.0 * sine) * 4.0) / 4.0
    assert np.nanmax(np.abs(curve - observed.cn0_dbhz - np.where(half, 10.0, 0.0))) < 0.26


def test_cn0_wanders() -> None:
    errors = ErrorSettings(noise=NoiseSettings(cn0_wander_sigma_db=1.5, cn0_wander_time_s=5.0))
    on, off = on_and_off(errors, duration_s=1800.0, rate_hz=2.0, receiver=QUIET, run=STANDING)
    series = on.observations.cn0_dbhz - off.observations.cn0_dbhz
    check_process(series, 1.5, 5.0, interval_s=0.5)


def test_a_weak_signal_is_lost_and_comes_back_later_with_another_ambiguity() -> None:
    """Two shadows of G06, of 2 s and 1 s, 40 dB deep; half a second until it is tracked again."""

    def shadow(geometry: SightGeometry) -> Disturbance:
        none = np.zeros(geometry.elevation_deg.shape)
        since = (geometry.time - Scenario().start) / np.timedelta64(1, "s")
        dark = ((since > 1.99) & (since < 3.99)) | ((since > 5.99) & (since < 6.99))
        deep = np.where(dark[:, None] & (geometry.satellite == "G06"), -40.0, 0.0)
        return Disturbance(code_m=none, phase_m=none, doppler_hz=none, cn0_db=deep)

    tracking = TrackingSettings(threshold_dbhz=20.0, reacquisition_s=0.5, slips="after_loss")
    on, off = on_and_off(ErrorSettings(tracking=tracking), duration_s=10.0, receiver=QUIET, multipath=(shadow,))
    mine = on.observations.satellite == "G06"
    epoch = np.arange(100)
    gone = ((epoch >= 20) & (epoch < 45)) | ((epoch >= 60) & (epoch < 75))
    for name in ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz"):
        np.testing.assert_array_equal(np.isnan(getattr(on.observations, name)[:, mine][:, 0]), gone)
        np.testing.assert_array_equal(
            getattr(on.observations, name)[:, ~mine], getattr(off.observations, name)[:, ~mine]
        )
    assert np.argwhere(on.observations.loss_of_lock).tolist() == [[k, int(np.flatnonzero(mine)[0])] for k in (45, 75)]
    slip = (on.observations.phase_cycles - off.observations.phase_cycles)[:, mine][:, 0]
    np.testing.assert_allclose(slip, np.round(slip), atol=1e-6)
    pieces = [np.round(slip[part]) for part in (slice(0, 20), slice(45, 60), slice(75, 100))]
    assert [len(set(p)) for p in pieces] == [1, 1, 1]
    assert pieces[0][0] == 0.0
    assert len({p[0] for p in pieces}) == 3


def test_a_satellite_that_rises_has_slipped_nothing() -> None:
    bad = np.array([[1, 0], [1, 0], [0, 1], [0, 0], [0, 0]], dtype=bool)
    made = TrackingNoise(TrackingSettings(slips="after_loss"), key=(1,), channels=2, interval_s=1.0).follow(bad)
    np.testing.assert_array_equal(made.lost, bad)
    assert np.argwhere(made.loss_of_lock).tolist() == [[3, 1]]
    delayed = TrackingNoise(TrackingSettings(reacquisition_s=1.0), key=(1,), channels=2, interval_s=1.0).follow(bad)
    assert (~delayed.lost).astype(int).T.tolist() == [[0, 0, 0, 1, 1], [1, 1, 0, 0, 1]]


def test_settings_are_read_from_plain_tables() -> None:
    text = """
    faults = [{satellite = "G07", start_s = 10, ramp_mps = 0.5}]
    [satellites.G]
    clock_sigma_m = 0.8
    [intersystem.E]
    offset_m = 3
    [noise]
    weak_signals = "all"
    [tracking]
    threshold_dbhz = 25
    """
    read = TypeAdapter(ErrorSettings).validate_python(tomllib.loads(text))
    assert read == ErrorSettings(
        faults=(SatelliteFault(satellite="G07", start_s=10.0, ramp_mps=0.5),),
        satellites={"G": SatelliteErrorSettings(clock_sigma_m=0.8)},
        intersystem={"E": InterSystemSettings(offset_m=3.0)},
        noise=NoiseSettings(weak_signals="all"),
        tracking=TrackingSettings(threshold_dbhz=25.0),
    )
    with pytest.raises(ValidationError):
        TypeAdapter(ErrorSettings).validate_python({"noise": {"weak_signals": "some"}})


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        (lambda: SatelliteErrorSettings(clock_sigma_m=-1.0), "clock_sigma_m"),
        (lambda: SatelliteErrorSettings(orbit_time_s=0.0), "orbit_time_s"),
        (lambda: IonosphereErrorSettings(vertical_sigma_m=float("nan")), "vertical_sigma_m"),
        (lambda: SatelliteFault(satellite="7", start_s=0.0), "satellite"),
        (lambda: SatelliteFault(satellite="G07", start_s=5.0, end_s=5.0), "end_s"),
        (lambda: InterSystemSettings(offset_m=float("inf")), "offset_m"),
        (lambda: ErrorSettings(satellites={"R": SatelliteErrorSettings()}), "satellites"),
        (lambda: NoiseSettings(code_correlated_share=1.1), "code_correlated_share"),
        (lambda: NoiseSettings(weak_signals="some"), "weak_signals"),
        (lambda: TrackingSettings(reacquisition_s=-1.0), "reacquisition_s"),
        (lambda: TrackingSettings(slips="always"), "slips"),
    ],
)
def test_settings_out_of_range_are_refused(settings: object, names: str) -> None:
    with pytest.raises(SettingsError, match=names):
        settings()  # type: ignore[operator]
