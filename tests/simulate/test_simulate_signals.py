"""Simulated observations: against other programs, other formulas, and their own statistics."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.errors import SettingsError
from railfix.core.geodesy import geodetic_from_ecef
from railfix.gnss import Observations, carrier_frequency_hz, concatenate
from railfix.gnss.orbits import satellite_states
from railfix.ranges.atmosphere import klobuchar_delay_m, saastamoinen_delay_m
from railfix.simulate import (
    Disturbance,
    Piece,
    ReceiverSettings,
    Scenario,
    SightGeometry,
    Simulation,
    SkySettings,
    write_run,
)
from railfix.simulate.constellation import Links, links
from synthetic import travelled_range

pytestmark = pytest.mark.requirement("D4")

QUIET = ReceiverSettings(
    code_sigma_m=0.0, phase_sigma_m=0.0, doppler_sigma_hz=0.0, cn0_sigma_dbhz=0.0, signals_per_satellite=2
)


def whole(scenario: Scenario, antenna: str = "front") -> Piece:
    (piece,) = Simulation(scenario).pieces(antenna, chunk_epochs=scenario.epochs)
    return piece


@pytest.mark.parametrize(("systems", "number"), [("G", 1), ("GJ", 17), ("E", 8), ("C", 32), ("GJEC", 57)])
def test_rtklib_stands_where_the_antenna_is(tmp_path: Path, systems: str, number: int) -> None:
    """Written without noise, an independent program's single point is the truth, to the files' last digit."""
    program = shutil.which("rnx2rtkp")
    if program is None:
        pytest.skip("rnx2rtkp is not installed")
    scenario = Scenario(duration_s=120.0, rate_hz=1.0, sky=SkySettings(systems=systems, unhealthy=()), receiver=QUIET)
    files = write_run(scenario, tmp_path, packing="plain")
    (tmp_path / "single.conf").write_text(
        f"pos1-posmode=single\npos1-frequency=l1\npos1-elmask=10\npos1-ionoopt=brdc\npos1-tropopt=saas\n"
        f"pos1-navsys={number}\nout-solformat=xyz\nout-timesys=gpst\nout-timeform=tow\n"
    )
    out = tmp_path / "single.pos"
    command = [program, "-k", str(tmp_path / "single.conf"), "-o", str(out), str(files["front"]), str(files["nav"])]
    subprocess.run(command, check=True, capture_output=True)
    rows = np.array([line.split()[:5] for line in out.read_text().splitlines() if line[0] != "%"], dtype=float)
    assert len(rows) == 120
    truth = pl.read_csv(files["truth"]).filter(pl.col("antenna") == "front").select("x_m", "y_m", "z_m").to_numpy()
    assert np.linalg.norm(rows[:, 2:] - truth, axis=1).max() < 0.01


def corrected(piece: Piece, simulation: Simulation) -> np.ndarray:
    """Code less true range, satellite and receiver clocks, group delay and atmosphere, by the product's rooms."""
    observed, geometry = piece.observations, piece.geometry
    states = satellite_states(
        observed.time, observed.satellite, observed.signal, observed.code_m, simulation.navigation
    )
    distance = travelled_range(states.position_ecef_m, geometry.antenna_ecef_m[:, None, :])
    latitude, longitude, height = geodetic_from_ecef(geometry.antenna_ecef_m)
    ionosphere = klobuchar_delay_m(
        observed.time,
        latitude,
        longitude,
        geometry.elevation_deg,
        geometry.azimuth_deg,
        simulation.navigation.klobuchar["G"],
        carrier_frequency_hz(observed.satellite, observed.signal),
    )
    troposphere = saastamoinen_delay_m(latitude, height, geometry.elevation_deg)
    delays = ionosphere + troposphere + states.group_delay_m - states.clock_m + piece.clock_m[:, None]
    return observed.code_m - distance - delays


def test_the_product_corrects_what_was_put_in() -> None:
    """Orbits, clocks, group delays and atmosphere of both, within a millimetre, over the change of records."""
    start = np.datetime64("2024-03-05T03:59:00", "ns")
    scenario = Scenario(start=start, duration_s=120.0, rate_hz=1.0, sky=SkySettings(systems="GJEC"), receiver=QUIET)
    simulation = Simulation(scenario)
    piece = whole(scenario)
    residual = corrected(piece, simulation)
    assert np.isfinite(residual).mean() > 0.8
    assert set(piece.observations.signal) == {"1C", "2L", "7Q", "2I", "6I"}
    assert np.nanmax(np.abs(residual)) < 1e-3


def test_code_noise_has_the_sigma_that_is_stated() -> None:
    scenario = Scenario(duration_s=60.0)
    residual = corrected(piece := whole(scenario), Simulation(scenario))
    tracked = np.isfinite(residual)
    cn0 = piece.observations.cn0_dbhz
    sigma = 0.5 * 10 ** (-(np.minimum(cn0, 50.0) - 45.0) / 20.0) / np.sin(np.radians(piece.geometry.elevation_deg))
    normal = residual[tracked] / sigma[tracked]
    assert normal.size > 10_000
    assert normal.mean() == pytest.approx(0.0, abs=4.0 / np.sqrt(normal.size))
    assert normal.std() == pytest.approx(1.0, abs=0.02)
    # White in time and from channel to channel.
    table = np.where(tracked, residual / sigma, np.nan)[:, tracked.all(axis=0)]
    limit = 4.0 / np.sqrt(len(table))
    assert abs(np.corrcoef(table[1:].ravel(), table[:-1].ravel())[0, 1]) < 4.0 / np.sqrt(table.size)
    correlation = np.corrcoef(table.T)
    assert np.abs(correlation[np.triu_indices(len(correlation), 1)]).max() < limit * 1.3


def test_double_differences_of_the_phase_have_twice_its_sigma() -> None:
    """Between antennas and satellites: clocks, orbits and atmosphere are gone, noise and geometry are left."""
    scenario = Scenario(duration_s=15.0)  # standing: the geometry is a slow polynomial
    pieces = {name: whole(scenario, name) for name in ("front", "rear")}
    single = pieces["front"].observations.phase_cycles - pieces["rear"].observations.phase_cycles
    single = single[:, np.isfinite(single).all(axis=0)]
    double = single[:, 1:] - single[:, :1]
    time = np.linspace(-1.0, 1.0, len(double))
    smooth = np.polynomial.polynomial.polyval(time, np.polynomial.polynomial.polyfit(time, double, 2)).T
    sigma = (double - smooth).std(axis=0, ddof=3) * SPEED_OF_LIGHT / 1575.42e6
    assert sigma == pytest.approx(2.0 * 0.002, rel=0.25)
    assert np.sqrt((sigma**2).mean()) == pytest.approx(0.004, rel=0.06)


def test_doppler_is_the_rate_of_the_phase() -> None:
    scenario = Scenario(duration_s=60.0, receiver=QUIET)
    observed = whole(scenario).observations
    # Simpson's rule over 0.2 s; where an acceleration begins or ends it is off by some hundredths.
    change = -(observed.phase_cycles[2:] - observed.phase_cycles[:-2])
    rate = (observed.doppler_hz[2:] + 4.0 * observed.doppler_hz[1:-1] + observed.doppler_hz[:-2]) / 6.0
    difference = change / 0.2 - rate
    assert np.nanmax(np.abs(difference)) < 0.06
    assert np.nanmedian(np.abs(difference)) < 0.003
    noisy = whole(Scenario(duration_s=60.0, receiver=ReceiverSettings(phase_sigma_m=0.0))).observations
    channels = [
        i for i, key in enumerate(zip(observed.satellite, observed.signal, strict=True))
        if key in set(zip(noisy.satellite, noisy.signal, strict=True))
    ]  # fmt: skip
    assert np.nanstd(noisy.doppler_hz - observed.doppler_hz[:, channels]) == pytest.approx(0.05, rel=0.02)


def test_clocks_are_common_or_separate_and_step_by_milliseconds() -> None:
    drifting = ReceiverSettings(
        clocks="common", clock_bias_s=4.99e-4, clock_drift=1e-6, clock_steps="millisecond", code_sigma_m=0.0
    )
    scenario = Scenario(duration_s=4.0, receiver=drifting)
    pieces = {name: whole(scenario, name) for name in ("front", "rear")}
    assert (pieces["front"].clock_m == pieces["rear"].clock_m).all()
    step = np.diff(pieces["front"].clock_m) / SPEED_OF_LIGHT
    assert (step < -0.99e-3).sum() == 1
    # The step is in code and phase of every satellite alike, not in the Doppler.
    k = int(step.argmin())
    observed = pieces["front"].observations
    assert np.nanmedian(np.diff(observed.code_m, axis=0)[k]) == pytest.approx(-1e-3 * SPEED_OF_LIGHT, abs=500.0)
    length = SPEED_OF_LIGHT / carrier_frequency_hz(observed.satellite, observed.signal)
    both = np.diff(observed.code_m, axis=0)[k] - length * np.diff(observed.phase_cycles, axis=0)[k]
    assert np.nanmax(np.abs(both)) < 0.02
    assert np.nanmax(np.abs(np.diff(observed.doppler_hz, axis=0))) < 1.0
    apart = {name: whole(Scenario(duration_s=1.0), name).clock_m for name in ("front", "rear")}
    assert np.abs(apart["front"] - apart["rear"]).min() > 1e4


def test_satellites_follow_the_mask_and_the_limit() -> None:
    piece = whole(Scenario(duration_s=2.0, sky=SkySettings(satellites_at_most=10)))
    seen = np.isfinite(piece.observations.code_m)
    assert (seen.sum(axis=1) == 10).all()
    assert piece.geometry.elevation_deg[seen].min() > np.nanmax(np.where(seen, np.nan, piece.geometry.elevation_deg))
    piece = whole(Scenario(duration_s=2.0))
    seen = np.isfinite(piece.observations.code_m)
    assert piece.geometry.elevation_deg[seen].min() >= 5.0
    assert (piece.geometry.elevation_deg[seen] < 20.0).any(), "some below the mask of the screens"
    quasi_zenith = piece.observations.satellite.astype("<U1") == "J"
    assert piece.geometry.elevation_deg[:, quasi_zenith].max() > 80.0


def test_the_newer_record_calls_the_satellite_unhealthy() -> None:
    scenario = Scenario()
    records = Simulation(scenario).navigation.kepler
    mine = np.flatnonzero(records.satellite == "G02")
    order = mine[np.argsort(records.transmitted[mine])]
    assert records.transmitted[order[1]] < scenario.start < records.toe[order[1]]
    assert (records.health[order] == [0, 63]).all()
    assert (records.health[records.satellite != "G02"] == 0).all()


def test_residual_atmosphere_is_what_the_scale_leaves() -> None:
    base = {"duration_s": 1.0, "receiver": QUIET}
    plain = whole(Scenario(**base))
    more = whole(Scenario(**base, sky=SkySettings(troposphere_scale=1.1, ionosphere_scale=0.0)))
    latitude, longitude, height = geodetic_from_ecef(plain.geometry.antenna_ecef_m)
    elevation, azimuth = plain.geometry.elevation_deg, plain.geometry.azimuth_deg
    frequency = carrier_frequency_hz(plain.observations.satellite, plain.observations.signal)
    coefficients = Simulation(Scenario(**base)).navigation.klobuchar["G"]
    expected = 0.1 * saastamoinen_delay_m(latitude, height, elevation) - klobuchar_delay_m(
        plain.observations.time, latitude, longitude, elevation, azimuth, coefficients, frequency
    )
    seen = np.isfinite(plain.observations.code_m)
    np.testing.assert_allclose((more.clean_code_m - plain.clean_code_m)[seen], expected[seen], atol=1e-3)


class _Exact:
    """In place of the table: every satellite by its formulas at every instant."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation

    def links(self, tag: np.ndarray, late_s: np.ndarray, receiver_ecef_m: np.ndarray) -> Links:
        records = self._simulation.navigation.kepler
        found = [links(records, name, tag, late_s, receiver_ecef_m) for name in self._simulation.satellites]
        return Links(
            range_m=np.stack([one.range_m for one in found], axis=1),
            satellite_ecef_m=np.stack([one.satellite_ecef_m for one in found], axis=1),
            clock_s=np.stack([one.clock_s for one in found], axis=1),
        )


def test_satellites_from_the_table_change_no_digit_that_is_written() -> None:
    """Against every satellite worked out at every instant, over a change of records: 1e-6 m, 1e-4 Hz."""
    start = np.datetime64("2024-03-05T03:59:00", "ns")
    scenario = Scenario(start=start, duration_s=120.0, sky=SkySettings(systems="GJEC"), receiver=QUIET)
    table = whole(scenario)
    simulation = Simulation(scenario)
    simulation.__dict__["satellite_table"] = _Exact(simulation)
    (exact,) = simulation.pieces("front", chunk_epochs=scenario.epochs)
    assert np.abs(table.clean_code_m - exact.clean_code_m).max() < 1e-6
    a, b = table.observations, exact.observations
    length = SPEED_OF_LIGHT / carrier_frequency_hz(a.satellite, a.signal)
    assert np.nanmax(np.abs((a.phase_cycles - b.phase_cycles) * length)) < 1e-6
    assert np.nanmax(np.abs(a.doppler_hz - b.doppler_hz)) < 1e-4
    np.testing.assert_array_equal(a.cn0_dbhz, b.cn0_dbhz)


@pytest.mark.parametrize("size", [1, 7, 64])
@pytest.mark.every(5)
def test_any_cutting_gives_the_same_numbers(size: int) -> None:
    scenario = Scenario(duration_s=10.0, receiver=ReceiverSettings(clock_steps="millisecond", clock_drift=1e-6))
    simulation = Simulation(scenario)
    expected = whole(scenario).observations
    joined = concatenate([p.observations for p in simulation.pieces("front", chunk_epochs=size)])
    for name in ("time", "satellite", "signal", "code_m", "phase_cycles", "doppler_hz", "cn0_dbhz"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(expected, name))


def test_the_seed_decides() -> None:
    def codes(seed: int) -> Observations:
        return whole(Scenario(duration_s=1.0, seed=seed)).observations

    np.testing.assert_array_equal(codes(1).code_m, codes(1).code_m)
    assert not np.array_equal(codes(1).satellite, codes(2).satellite) or not np.array_equal(
        codes(1).code_m, codes(2).code_m
    )


def test_disturbances_are_added_and_can_take_a_signal_away() -> None:
    def mast(geometry: SightGeometry) -> Disturbance:
        shape = geometry.elevation_deg.shape
        low = geometry.elevation_deg < 30.0
        code = np.where(low, 7.0, 0.0)
        code[:, geometry.satellite == "G06"] = np.nan
        return Disturbance(
            code_m=code, phase_m=np.zeros(shape), doppler_hz=np.zeros(shape), cn0_db=np.where(low, -6.0, 0.0)
        )

    clean, dirty = (
        whole(Scenario(duration_s=1.0, receiver=QUIET)),
        whole(Scenario(duration_s=1.0, receiver=QUIET, multipath=(mast,))),
    )
    gone = clean.observations.satellite == "G06"
    assert np.isfinite(clean.observations.code_m[:, gone]).all()
    for name in ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz"):
        assert np.isnan(getattr(dirty.observations, name)[:, gone]).all()
    low = (clean.geometry.elevation_deg < 30.0) & np.isfinite(dirty.observations.code_m)
    difference = dirty.observations.code_m - clean.observations.code_m
    assert difference[low] == pytest.approx(7.0)
    assert (dirty.observations.cn0_dbhz - clean.observations.cn0_dbhz)[low] == pytest.approx(-6.0)
    assert np.nanmax(np.abs(difference[~low])) == 0.0


@pytest.mark.parametrize(
    "settings",
    [
        lambda: SkySettings(systems=""),
        lambda: SkySettings(systems="GX"),
        lambda: SkySettings(systems="GG"),
        lambda: SkySettings(cutoff_deg=95.0),
        lambda: SkySettings(satellites_at_most=0),
        lambda: ReceiverSettings(code_sigma_m=-1.0),
        lambda: ReceiverSettings(clocks="shared"),
        lambda: ReceiverSettings(signals_per_satellite=3),
        lambda: ReceiverSettings(clock_bias_s=1.0),
        lambda: Scenario(seed=-1),
    ],
)
def test_settings_out_of_range_are_refused(settings: object) -> None:
    with pytest.raises(SettingsError):
        settings()  # type: ignore[operator]
