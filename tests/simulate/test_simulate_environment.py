"""Multipath that belongs to the place: each element against hand-worked cases or other computations."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.signal import max_len_seq

from railfix.core.constants import FREQUENCY_L1, SPEED_OF_LIGHT
from railfix.core.errors import SettingsError
from railfix.core.geodesy import ecef_from_geodetic, elevation_azimuth, enu_axes
from railfix.simulate import Disturbance, Scenario, SightGeometry, Simulation
from railfix.simulate.environment import (
    CorrelatorSettings,
    ElectrificationSettings,
    Environment,
    EnvironmentSettings,
    RoofSettings,
    RowSettings,
    SectionSettings,
    draw_sections,
)
from railfix.simulate.environment.correlator import edge_amplitude, strip_field, track_paths
from railfix.simulate.environment.model import Electrification
from railfix.simulate.environment.structures import build_structures
from railfix.simulate.environment.walls import Rays, reflections, shadow

pytestmark = pytest.mark.requirement("D4")

WAVE = SPEED_OF_LIGHT / FREQUENCY_L1
LINE_M = 1000.0
#: No ground, so that only what a test puts there is there.
BARE = EnvironmentSettings(ground_reflection=0.0, receiver=CorrelatorSettings(tracking_cn0_dbhz=0.0))


def decibel(amplitude: np.ndarray) -> np.ndarray:
    return 20.0 * np.log10(np.abs(amplitude))


def seen(
    chainage_m: np.ndarray | float,
    elevation_deg: float | list[float],
    relative_deg: float | list[float],
    *,
    heading_deg: float = 63.0,
    speed_mps: float = 0.0,
) -> SightGeometry:
    """One or more GPS satellites at fixed directions from the train's own, over a line north-east."""
    chainage = np.atleast_1d(np.asarray(chainage_m, dtype=np.float64))
    elevation, relative = (np.atleast_1d(np.asarray(x, dtype=np.float64)) for x in (elevation_deg, relative_deg))
    n, m = len(chainage), len(elevation)
    return SightGeometry(
        antenna="front",
        time=np.datetime64("2024-03-05T00:00:00", "ns") + np.arange(n) * np.timedelta64(100, "ms"),
        satellite=np.array([f"G{k + 1:02d}" for k in range(m)]),
        signal=np.full(m, "1C"),
        chainage_m=chainage,
        speed_mps=np.full(n, speed_mps),
        antenna_ecef_m=np.zeros((n, 3)),
        heading_deg=np.full(n, heading_deg),
        elevation_deg=np.broadcast_to(elevation, (n, m)).copy(),
        azimuth_deg=np.broadcast_to((heading_deg + relative) % 360.0, (n, m)).copy(),
    )


def rays(chainage_m: float, elevation_deg: float, relative_deg: float, height_m: float = 4.0) -> Rays:
    e, r = np.radians(elevation_deg), np.radians(relative_deg)
    direction = (np.cos(e) * np.cos(r), np.cos(e) * np.sin(r), np.sin(e))
    x, y, z = (np.array([float(part)]) for part in direction)
    return Rays(chainage_m=np.array([chainage_m]), height_m=height_m, x=x, y=y, z=z, wavelength_m=np.array([WAVE]))


def wall(
    side: str, distance_m: float, height_m: float, *, yaw_deg: float = 0.0, reflection: float = 0.8
) -> RowSettings:
    """One smooth face all along the section."""
    return RowSettings(
        sides=side,  # type: ignore[arg-type]
        distance_m=(distance_m, distance_m),
        height_m=(height_m, height_m),
        length_m=(1e5, 1e5),
        gap_m=(0.0, 0.0),
        reflection=(reflection, reflection),
        roughness_m=(0.0, 0.0),
        yaw_deg=(yaw_deg, yaw_deg),
    )


def section(*rows: RowSettings, roofs: tuple[RoofSettings, ...] = ()) -> SectionSettings:
    return SectionSettings(from_m=0.0, to_m=LINE_M, kind="urban", rows=rows, roofs=roofs)


def environment(*rows: RowSettings, settings: EnvironmentSettings = BARE, seed: int = 1) -> Environment:
    return Environment(settings.replaced(sections=(section(*rows),)), line_length_m=LINE_M, seed=seed)


# Diffraction ---------------------------------------------------------------------------------------------


def test_the_edge_is_that_of_the_fresnel_integral() -> None:
    """ITU-R P.526's approximation stays within 0.5 dB of |(1 + j)/2 integral from v to infinity of exp(-j pi t2/2)|."""

    def exact(v: float) -> float:
        cosine = quad(lambda t: np.cos(0.5 * np.pi * t * t), 0.0, v, limit=400)[0]
        sine = quad(lambda t: np.sin(0.5 * np.pi * t * t), 0.0, v, limit=400)[0]
        return float(decibel(np.array(np.hypot(0.5 - cosine, 0.5 - sine) / np.sqrt(2.0))))

    for v in (-0.5, 0.0, 0.5, 1.0, 2.4, 5.0):
        assert decibel(edge_amplitude(np.array(v))) == pytest.approx(exact(v), abs=0.5)
    assert decibel(edge_amplitude(np.array(0.0))) == pytest.approx(-6.03, abs=0.02)
    assert edge_amplitude(np.array([-5.0, -0.8])).tolist() == [1.0, 1.0]


def test_the_strip_is_the_integral_over_its_width() -> None:
    for middle, width in ((0.0, 0.65), (1.3, 0.65), (4.0, 0.2)):
        low, high = middle - width / 2.0, middle + width / 2.0
        cosine = quad(lambda t: np.cos(0.5 * np.pi * t * t), low, high)[0]
        sine = quad(lambda t: np.sin(0.5 * np.pi * t * t), low, high)[0]
        found = strip_field(np.array(middle), np.array(width))
        assert found == pytest.approx(0.5 * (1.0 + 1.0j) * (cosine - 1.0j * sine), abs=1e-9)


# Correlator ----------------------------------------------------------------------------------------------------------


def numerical_correlator(fields: np.ndarray, late_chips: np.ndarray, spacing: float) -> float:
    """Zero of Re(conj(P) (E - L)) nearest to the first path, with the correlation of a real code sequence."""
    code = 1.0 - 2.0 * max_len_seq(10)[0]
    fine = np.repeat(code, 20)
    spectrum = np.fft.fft(fine)
    lag = np.arange(len(fine)) / 20.0
    peak = np.real(np.fft.ifft(spectrum * np.conj(spectrum))) / len(fine)
    lag, peak = np.concatenate([lag - 1023.0, lag]), np.concatenate([peak, peak])

    def correlation(x: np.ndarray) -> np.ndarray:
        return sum(f * np.interp(x - d, lag, peak) for f, d in zip(fields, late_chips, strict=True))

    at = np.linspace(-1.2 * spacing, 1.2 * spacing, 48_001)
    prompt, early, late = (correlation(at + shift) for shift in (0.0, 0.5 * spacing, -0.5 * spacing))
    value = np.real(np.conj(prompt) * (early - late))
    zeros = np.flatnonzero((value[:-1] > 0.0) & (value[1:] <= 0.0))
    return float(at[zeros[np.argmin(np.abs(at[zeros]))]])


def track(amplitude: list[float], extra_m: list[float], turn: list[float], rate: list[float] | None = None, **other):
    """One signal of several paths; `turn` is the phase that is not the extra path's."""
    field = np.array(amplitude)[:, None] * np.exp(1j * np.array(turn))[:, None]
    return track_paths(
        field,
        np.array(extra_m)[:, None],
        np.array(rate or [0.0] * len(amplitude))[:, None],
        wavelength_m=np.array([WAVE]),
        chip_m=np.array([293.05]),
        receiver=CorrelatorSettings(**other),
    )


@pytest.mark.parametrize("spacing", [0.1, 0.5, 1.0])
def test_the_code_error_is_that_of_a_numerical_correlator(spacing: float) -> None:
    rng = np.random.default_rng(5)
    for _ in range(25):
        count = rng.integers(1, 4)
        amplitude = [1.0, *(rng.uniform(0.05, 0.8, count) / count).tolist()]
        extra = [0.0, *rng.uniform(0.0, 400.0, count).tolist()]
        turn = [0.0, *rng.uniform(-np.pi, np.pi, count).tolist()]
        fields = np.array(amplitude) * np.exp(1j * (np.array(turn) - 2.0 * np.pi * np.array(extra) / WAVE))
        expected = 293.05 * numerical_correlator(fields, np.array(extra) / 293.05, spacing)
        # The m-sequence's own floor of 1/1023 is worth some decimetres at wide spacing.
        assert track(amplitude, extra, turn, spacing_chips=spacing).code_m[0] == pytest.approx(expected, abs=0.4)


def test_the_envelope_of_half_the_amplitude_is_the_textbooks() -> None:
    """a d/2 chip: 0.5 * 0.05 * 293.05 m = 7.33 m late in phase, early in counter-phase; short delays a D/(1 + a)."""
    whole = round(60.0 / WAVE) * WAVE
    assert track([1.0, 0.5], [0.0, whole], [0.0, 0.0]).code_m[0] == pytest.approx(7.326, abs=0.01)
    assert track([1.0, 0.5], [0.0, whole], [0.0, np.pi]).code_m[0] == pytest.approx(-7.326, abs=0.01)
    near = round(3.0 / WAVE) * WAVE
    assert track([1.0, 0.5], [0.0, near], [0.0, 0.0]).code_m[0] == pytest.approx(near / 3.0, abs=0.05)
    # Beyond a chip and a half spacing nothing reaches the correlator.
    assert track([1.0, 0.5], [0.0, 320.0], [0.0, 0.0]).code_m[0] == 0.0


def test_strength_and_phase_are_those_of_the_sum() -> None:
    whole = round(3.0 / WAVE) * WAVE
    assert track([1.0, 0.5], [0.0, whole], [0.0, 0.0]).gain_db[0] == pytest.approx(20.0 * np.log10(1.5), abs=0.1)
    assert track([1.0, 0.5], [0.0, whole], [0.0, np.pi]).gain_db[0] == pytest.approx(20.0 * np.log10(0.5), abs=0.1)
    # A quarter wave later, half as strong: the sum lags by atan(0.5), 26.6 deg, 14 mm.
    quarter = track([1.0, 0.5], [0.0, whole], [0.0, -0.5 * np.pi])
    assert quarter.phase_m[0] == pytest.approx(np.arctan(0.5) / (2.0 * np.pi) * WAVE, abs=2e-4)


def test_a_path_alone_is_measured_whole() -> None:
    got = track([1e-4, 0.3], [0.0, 41.0], [0.0, np.pi], rate=[0.0, 1.7])
    assert got.code_m[0] == pytest.approx(41.0, abs=0.05)
    assert got.rate_mps[0] == pytest.approx(1.7, abs=1e-2)
    assert got.gain_db[0] == pytest.approx(20.0 * np.log10(0.3), abs=0.05)
    assert abs(got.phase_m[0] - 41.0) < WAVE


def test_what_turns_fast_is_averaged() -> None:
    """At 50 turns a second little swing of the code is left, and the mean power: 10 log10(1 + 0.25) = 0.97 dB."""
    whole = round(60.0 / WAVE) * WAVE
    slow, fast = (track([1.0, 0.5], [0.0, whole], [0.0, 0.0], rate=[0.0, r]) for r in (0.0, 50.0 * WAVE))
    mean = np.mean([track([1.0, 0.5], [0.0, whole], [0.0, a]).code_m[0] for a in np.linspace(0, 2 * np.pi, 72)[:-1]])
    assert slow.code_m[0] == pytest.approx(7.33, abs=0.01)
    # In phase less the swing: the reflection's own square stays, 0.25 * (1 - 60/293) * 14.65 m over 1 + 0.4.
    assert 0.0 < fast.code_m[0] < 3.0
    assert abs(mean) < 3.0
    assert fast.gain_db[0] == pytest.approx(10.0 * np.log10(1.0 + (0.5 * (1.0 - 60.0 / 293.05)) ** 2), abs=0.15)


# Faces ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("yaw_deg", [0.0, 3.0, -4.0])
@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(300.0, 40.0), (10.0, 15.0), (255.0, 70.0)])
def test_the_extra_path_is_that_of_the_mirror_image(yaw_deg: float, azimuth_deg: float, elevation_deg: float) -> None:
    """Against the satellite mirrored in the wall's plane, in ECEF, at 20 000 km."""
    heading, s, distance = 63.0, 430.0, 18.0
    place = build_structures((section(wall("right", distance, 500.0, yaw_deg=yaw_deg)),), LINE_M, 1)
    row = place.walls[0]
    ray = rays(s, elevation_deg, azimuth_deg - heading)
    found = reflections(row, ray)
    assert found.amplitude[0] == pytest.approx(0.8)

    antenna = ecef_from_geodetic(35.0, 135.0, 100.0)
    axes = enu_axes(35.0, 135.0)
    e, a = np.radians(elevation_deg), np.radians(azimuth_deg)
    toward = axes.T @ np.array([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)])
    satellite = antenna + 2e7 * toward
    assert elevation_azimuth(satellite[None, None], antenna[None])[0][0, 0] == pytest.approx(elevation_deg, abs=1e-6)
    h = np.radians(heading)
    ahead, right = axes.T @ np.array([np.sin(h), np.cos(h), 0.0]), axes.T @ np.array([np.cos(h), -np.sin(h), 0.0])
    face = 1  # after the placeholder of the right side
    index = int(np.flatnonzero(row.value["height_m"] == 500.0)[face - 1])
    middle = 0.5 * (row.start_m[index] + row.end_m[index])
    point = antenna + (middle - s) * ahead + distance * right
    w = np.radians(yaw_deg)
    normal = np.cos(w) * right - np.sin(w) * ahead
    image = satellite - 2.0 * ((satellite - point) @ normal) * normal
    extra = np.linalg.norm(image - antenna) - np.linalg.norm(satellite - antenna)
    assert found.extra_m[0] == pytest.approx(extra, abs=2e-3)
    # Its growth a metre further along the line.
    further = np.linalg.norm(image - antenna - ahead) - np.linalg.norm(satellite - antenna - ahead)
    assert found.rate[0] == pytest.approx(further - extra, abs=1e-4)


def test_a_hidden_satellite_is_heard_by_its_reflection() -> None:
    """Hand-worked: 45 deg high, square to the line on the left, hidden by a face 5 m off; a wall 20 m off on the right.

    Extra path 2 * 20 * cos 45 = 28.28 m, strength 0.8 or -1.94 dB; nothing of it in the Doppler, as the wall is
    parallel to the line.
    """
    got = environment(wall("left", 5.0, 29.0, reflection=0.0), wall("right", 20.0, 100.0))(
        seen(500.0, 45.0, -90.0, speed_mps=11.0)
    )
    assert got.code_m[0, 0] == pytest.approx(28.28, abs=0.4)
    assert got.cn0_db[0, 0] == pytest.approx(-1.94, abs=0.3)
    assert got.doppler_hz[0, 0] == pytest.approx(0.0, abs=1e-9)
    # The same wall hides what stands behind it, and does not reflect it.
    behind = environment(wall("right", 20.0, 100.0))(seen(500.0, 45.0, 90.0))
    assert behind.cn0_db[0, 0] < -30.0
    # Too low for the reflection, 24 m up the wall: the satellite is heard by its diffraction only.
    low = environment(wall("left", 5.0, 29.0, reflection=0.0), wall("right", 20.0, 15.0))(seen(500.0, 45.0, -90.0))
    assert low.cn0_db[0, 0] < -25.0


def test_the_reflected_doppler_is_that_of_a_turned_wall() -> None:
    """-d(extra)/dt over the wavelength, against extra paths 4 s apart."""
    place = environment(wall("left", 5.0, 40.0, reflection=0.0), wall("right", 20.0, 300.0, yaw_deg=4.0))
    at = place(seen(np.array([400.0, 440.0]), 45.0, -90.0, speed_mps=10.0))
    rate = (at.code_m[1, 0] - at.code_m[0, 0]) / 4.0
    assert at.doppler_hz[0, 0] == pytest.approx(-rate / WAVE, rel=0.1)
    assert abs(at.doppler_hz[0, 0]) > 2.0


def test_a_reflection_does_not_come_over_a_higher_house() -> None:
    """The way in, seen from the mirror image 40 m beyond, passes the face 5 m off at 49 m: over 29 m, not over 80."""
    for height, least, most in ((29.0, -3.0, -1.0), (80.0, -99.0, -25.0)):
        got = environment(wall("left", 5.0, height, reflection=0.0), wall("right", 20.0, 200.0))(
            seen(500.0, 45.0, -90.0)
        )
        assert least < got.cn0_db[0, 0] < most


def test_a_slope_hides_up_to_its_own_horizon() -> None:
    """A face 8 m off, its top 6 m over the antenna: 36.9 deg abeam; 6 dB on the edge; behind the train's beam less."""
    place = build_structures((section(wall("left", 8.0, 10.0, reflection=0.0)),), LINE_M, 1)
    row = place.walls[0]
    abeam = np.degrees(np.arctan2(6.0, 8.0))
    assert shadow(row, rays(500.0, abeam, -90.0))[0] == pytest.approx(0.0, abs=1e-6)
    # 45 deg ahead the face is 8 * sqrt(2) m away.
    assert shadow(row, rays(500.0, np.degrees(np.arctan2(6.0, 8.0 * np.sqrt(2.0))), -45.0))[0] == pytest.approx(
        0, abs=1e-6
    )
    assert shadow(row, rays(500.0, 20.0, 90.0))[0] < -50.0
    # One degree below the edge: 10 m * tan(1 deg) = 0.175 m in the shadow, v = 0.175 sqrt(2 / (0.19 * 10)).
    v = shadow(row, rays(500.0, abeam - 1.0, -90.0))[0]
    assert v == pytest.approx(10.0 * np.tan(np.radians(1.0)) * np.sqrt(2.0 / (WAVE * 10.0)), rel=0.03)
    got = environment(wall("left", 8.0, 10.0, reflection=0.0))(seen(500.0, [abeam, 60.0, 10.0], -90.0))
    assert got.cn0_db[0, :2] == pytest.approx([-6.03, 0.0], abs=0.02)
    assert got.cn0_db[0, 2] < -20.0


def test_a_gap_between_houses_lets_the_satellite_through() -> None:
    """Houses of 30 m with gaps of 20 m at 15 m distance: in the middle of gap and house, straight abeam."""
    row = wall("left", 15.0, 40.0, reflection=0.0).replaced(length_m=(30.0, 30.0), gap_m=(20.0, 20.0))
    place = build_structures((section(row),), LINE_M, 1)
    strips = place.walls[0]
    house = int(np.searchsorted(strips.start_m[: len(strips.start_m) - 1], 300.0))
    middle = strips.start_m[house] + 15.0
    got = environment(row)(seen(np.array([middle, middle + 25.0]), 30.0, -90.0))
    assert got.cn0_db[0, 0] < -25.0
    assert got.cn0_db[1, 0] == pytest.approx(0.0, abs=0.01)
    # Looking 45 deg ahead, the gap abeam of the place 15 m further is meant.
    slant = environment(row)(seen(np.array([middle + 25.0 - 15.0]), 30.0, -45.0))
    assert slant.cn0_db[0, 0] == pytest.approx(0.0, abs=0.01)


def test_a_platform_roof_covers_a_band_of_elevations() -> None:
    """From 1.8 to 9 m off, 2 m over the antenna: atan(2/9) = 12.5 to atan(2/1.8) = 48.0 deg on that side only."""
    roof = RoofSettings(sides="right", length_m=(1e5, 1e5), gap_m=(0.0, 0.0), loss_db=20.0)
    place = Environment(BARE.replaced(sections=(section(roofs=(roof,)),)), line_length_m=LINE_M, seed=1)
    got = place(seen(500.0, [25.0, 48.01, 70.0, 6.0, 25.0], [90.0, 90.0, 90.0, 90.0, -90.0]))
    assert got.cn0_db[0, 0] == pytest.approx(-20.0, abs=3.0)
    assert got.cn0_db[0, 1] == pytest.approx(-6.0, abs=0.1)
    assert got.cn0_db[0, [2, 3, 4]] == pytest.approx([0.0, 0.0, 0.0], abs=0.05)


def test_a_bridge_covers_what_is_overhead() -> None:
    """8 m over the rails, 20 m long from 490 m: straight up it hides for its own length."""
    bridge = RoofSettings(
        inner_m=0.0, outer_m=50.0, height_m=8.0, length_m=(20.0, 20.0), gap_m=(0.0, 0.0), loss_db=60.0
    )
    bridged = SectionSettings(from_m=490.0, to_m=510.0, kind="urban", rows=(), roofs=(bridge,))
    around = [SectionSettings(from_m=x, to_m=x + 100.0, kind="open") for x in (300.0, 600.0)]
    settings = BARE.replaced(sections=(around[0], bridged, around[1]))
    place = Environment(settings, line_length_m=LINE_M, seed=1)
    got = place(seen(np.array([500.0, 515.0]), 88.0, 10.0))
    assert got.cn0_db[0, 0] < -15.0
    assert got.cn0_db[1, 0] == pytest.approx(0.0, abs=0.01)


def test_a_shadowed_signal_comes_round_the_edge() -> None:
    """1 m in the shadow at 20 m: the way over the edge is 1 / (2 * 20) m = 25 mm longer, v = 0.725, 12 dB weaker."""
    elevation = 30.0
    height = 4.0 + 20.0 * np.sin(np.radians(elevation)) + 1.0 / np.cos(np.radians(elevation))
    row = wall("right", 20.0 * np.cos(np.radians(elevation)), height, reflection=0.0)
    got = environment(row)(seen(500.0, elevation, 90.0))
    assert got.code_m[0, 0] == pytest.approx(0.025, abs=0.002)
    assert got.cn0_db[0, 0] == pytest.approx(float(decibel(edge_amplitude(np.array(0.725)))), abs=0.1)
    assert -13.0 < got.cn0_db[0, 0] < -11.0


def test_too_weak_a_signal_is_lost() -> None:
    """Clear 34 + 16 sin 20 = 39.5 dB-Hz; 20 dB less through a roof is tracked at 15 dB-Hz, not at 25."""
    roof = RoofSettings(sides="right", length_m=(1e5, 1e5), gap_m=(0.0, 0.0), loss_db=20.0)
    for threshold, lost in ((15.0, False), (25.0, True)):
        settings = BARE.replaced(
            sections=(section(roofs=(roof,)),), receiver=CorrelatorSettings(tracking_cn0_dbhz=threshold)
        )
        got = Environment(settings, line_length_m=LINE_M, seed=1)(seen(500.0, [20.0, 20.0], [90.0, -90.0]))
        assert np.isnan(got.code_m[0]).tolist() == [lost, False]


def test_a_house_in_front_hides_the_reflection_of_a_tower_behind() -> None:
    """A tower 40 m off reflects at 40 m up (45 deg); a house 10 m off stands in the way if it is over 14 m high."""
    tower = wall("right", 40.0, 100.0, reflection=0.5)
    for height, heard in ((10.0, True), (30.0, False)):
        house = wall("right", 10.0, height).replaced(reflection=(0.0, 0.0))
        got = environment(house, tower)(seen(500.0, 45.0, -90.0))
        assert (abs(got.cn0_db[0, 0]) > 0.3) == heard


def test_the_ground_reflects_from_below() -> None:
    """2 h sin el: 8 m sin 10 = 1.389 m from ballast, 2 * 2.9 sin 10 = 1.007 m from a platform; 0.5 by 6 dB."""
    receiver = CorrelatorSettings(backward_db=6.0206)
    for kind, extra in (("open", 1.389), ("station", 1.007)):
        only = SectionSettings(from_m=0.0, to_m=LINE_M, kind=kind, rows=(), roofs=())  # type: ignore[arg-type]
        settings = EnvironmentSettings(
            sections=(only,), ground_reflection=0.5, ground_roughness_m=0.0, receiver=receiver
        )
        got = Environment(settings, line_length_m=LINE_M, seed=1)(seen(500.0, 10.0, 90.0))
        field = 1.0 - 0.25 * np.exp(-2j * np.pi * extra / WAVE)
        # 1 mm of the extra path is 0.07 dB at most.
        assert got.cn0_db[0, 0] == pytest.approx(float(decibel(field)), abs=0.1)
        # Shorter than half the spacing: c D / (1 + c), c in phase with the sum.
        phase = np.real(np.conj(field) * (field - 1.0)) / np.real(np.conj(field))
        assert got.code_m[0, 0] == pytest.approx(phase * extra, abs=0.02)


def test_faster_codes_suffer_less() -> None:
    """A reflection 57 m late lies beyond a chip of 29.3 m (BeiDou B3I), not beyond one of 293 m (GPS C/A)."""
    geometry = seen(500.0, [45.0, 45.0], [-90.0, -90.0])
    named = replace(geometry, satellite=np.array(["G01", "C21"]), signal=np.array(["1C", "6I"]))
    got = environment(wall("right", 40.0, 100.0, reflection=0.6))(named)
    assert abs(got.code_m[0, 0]) > 0.5
    assert got.code_m[0, 1] == pytest.approx(0.0, abs=1e-6)


def test_a_rough_face_reflects_less() -> None:
    """2 cm uneven, hit at 45 deg: g = 4 pi 0.02 cos 45 / 0.1903 = 0.934, amplitude exp(-0.436) = 0.647."""
    rough = wall("right", 20.0, 100.0).replaced(roughness_m=(0.02, 0.02))
    row = build_structures((section(rough),), LINE_M, 1).walls[0]
    assert reflections(row, rays(500.0, 45.0, -90.0)).amplitude[0] == pytest.approx(0.8 * 0.647, abs=1e-3)


# Masts, beams, wires -------------------------------------------------------------------------------------------------


MASTS = ElectrificationSettings(beam_every=0, wire_height_m=400.0, messenger_height_m=400.0, first_m=0.0)


def test_passing_a_mast_takes_its_metres() -> None:
    """A strip of 0.35 m, 3.19 m away (20 deg high, abeam), against the integral, and the metres it lasts."""
    place = Environment(BARE.replaced(electrification=MASTS.replaced(sides="left")), line_length_m=LINE_M, seed=1)
    s = np.arange(485.0, 515.0, 0.05)
    got = place(seen(s, 20.0, -90.0)).cn0_db[:, 0]
    far = 3.0 / np.cos(np.radians(20.0))
    scale = np.sqrt(2.0 / (WAVE * far))
    low, high = (scale * (500.0 - s[300] + side * 0.175) for side in (-1.0, 1.0))
    cosine = quad(lambda t: np.cos(0.5 * np.pi * t * t), low, high)[0]
    sine = quad(lambda t: np.sin(0.5 * np.pi * t * t), low, high)[0]
    expected = decibel(np.array(1.0 - 0.5 * (1.0 + 1.0j) * (cosine - 1.0j * sine)))
    # Its ends, above and below, let a little round.
    assert got[300] == pytest.approx(float(expected), abs=0.1)
    assert expected < -2.5
    below = s[got < -2.0]
    # The first zone, v within about 0.9 of the middle: 0.9 / scale = 0.5 m either way.
    assert 0.6 < np.ptp(below) < 1.4
    assert below.mean() == pytest.approx(500.0, abs=0.1)


def test_a_mast_is_passed_under_where_the_satellite_stands_above_it() -> None:
    """The top is 5 m over the antenna and 3 m away: 59 deg."""
    bars = Electrification(MASTS)
    for elevation, least, most in ((30.0, 0.5, 0.85), (75.0, 0.97, 1.03)):
        assert least < abs(bars.transmit(rays(500.0, elevation, 90.0))[0]) < most


def test_a_beam_is_passed_when_it_is_in_the_line_of_sight() -> None:
    """3.5 m over the antenna, satellite 45 deg ahead: the beam of mast 500 stands in its way from 496.5 m."""
    settings = MASTS.replaced(beam_every=1, sides="right", lateral_m=4.0)
    bars = Electrification(settings)
    there, before, after = (abs(bars.transmit(rays(s, 45.0, 0.0))[0]) for s in (496.5, 493.0, 500.5))
    assert there < 0.85
    assert before == pytest.approx(1.0, abs=0.15)
    assert after == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize(("relative_deg", "elevation_deg"), [(90.0, 20.0), (60.0, 40.0), (-100.0, 10.0)])
def test_what_a_mast_throws_goes_the_shortest_way(relative_deg: float, elevation_deg: float) -> None:
    """Fermat: the extra path is the least of |P| - P . u over the points P of the mast."""
    ray = rays(501.0, elevation_deg, relative_deg)
    amplitude, extra, growth = Electrification(MASTS).scatter(ray)[0]
    u = np.array([ray.x[0], ray.y[0], ray.z[0]])
    foot = np.array([-1.0, -3.0 if relative_deg > 0.0 else 3.0, 0.0])

    def way(height: float, along: float = 0.0) -> float:
        point = foot + np.array([-along, 0.0, height])
        return float(np.linalg.norm(point) - point @ u)

    best = minimize_scalar(way)
    assert extra[0] == pytest.approx(best.fun, abs=1e-6)
    assert growth[0] == pytest.approx((way(best.x, 1e-4) - way(best.x, -1e-4)) / 2e-4, abs=1e-3)
    assert 0.05 < amplitude[0] < 0.25


# Place ---------------------------------------------------------------------------------------------------------------

CITY = EnvironmentSettings(
    electrification=ElectrificationSettings(),
    sections=(
        SectionSettings(from_m=0.0, to_m=400.0, kind="urban"),
        SectionSettings(from_m=400.0, to_m=500.0, kind="tunnel"),
        SectionSettings(from_m=500.0, to_m=700.0, kind="station"),
    ),
)


def town(seed: int = 1) -> Environment:
    return Environment(CITY, line_length_m=LINE_M, seed=seed)


def everywhere(n: int = 400) -> SightGeometry:
    rng = np.random.default_rng(3)
    return seen(
        np.linspace(20.0, 980.0, n),
        rng.uniform(5.0, 90.0, 12).tolist(),
        rng.uniform(0, 360, 12).tolist(),
        speed_mps=9.0,
    )


def same(one: Disturbance, other: Disturbance) -> bool:
    return all(
        np.array_equal(getattr(one, n), getattr(other, n), equal_nan=True)
        for n in ("code_m", "phase_m", "doppler_hz", "cn0_db")
    )


def test_a_tunnel_empties_the_sky() -> None:
    place = town()
    got = place(everywhere())
    inside = place.label_at(everywhere().chainage_m) == "tunnel"
    assert inside.sum() > 30
    assert np.isnan(got.code_m[inside]).all()
    assert np.isfinite(got.code_m[~inside]).mean() > 0.7
    assert all(np.isfinite(part).all() for part in (got.phase_m, got.doppler_hz, got.cn0_db))


def test_labels_are_those_of_the_sections() -> None:
    labels = town().label_at([-5.0, 0.0, 399.9, 400.0, 499.9, 500.0, 700.0, 990.0])
    assert labels.tolist() == ["open", "urban", "urban", "tunnel", "tunnel", "station", "open", "open"]


def test_pieces_equal_the_whole_and_satellites_may_be_permuted() -> None:
    geometry, place = everywhere(), town()
    whole = place(geometry)
    assert np.nanmax(np.abs(whole.code_m)) > 5.0
    for cut in (slice(0, 1), slice(1, 137), slice(137, 400)):
        part = replace(
            geometry,
            **{n: getattr(geometry, n)[cut] for n in ("time", "chainage_m", "speed_mps", "antenna_ecef_m")},
            **{n: getattr(geometry, n)[cut] for n in ("heading_deg", "elevation_deg", "azimuth_deg")},
        )
        expected = Disturbance(
            code_m=whole.code_m[cut],
            phase_m=whole.phase_m[cut],
            doppler_hz=whole.doppler_hz[cut],
            cn0_db=whole.cn0_db[cut],
        )
        assert same(place(part), expected)
    order = np.random.default_rng(8).permutation(12)
    mixed = place(
        replace(
            geometry,
            satellite=geometry.satellite[order],
            elevation_deg=geometry.elevation_deg[:, order],
            azimuth_deg=geometry.azimuth_deg[:, order],
        )
    )
    assert np.array_equal(mixed.code_m, whole.code_m[:, order], equal_nan=True)
    assert np.array_equal(mixed.cn0_db, whole.cn0_db[:, order])


def test_a_second_pass_finds_the_same_place() -> None:
    """BackwardInformation, the other way, another antenna: the same numbers, only the Doppler turns about."""
    geometry, place = everywhere(), town()
    back = replace(geometry, antenna="rear", time=geometry.time + np.timedelta64(3, "h"), speed_mps=-geometry.speed_mps)
    one, other = place(geometry), place(back)
    assert np.array_equal(one.code_m, other.code_m, equal_nan=True)
    assert np.array_equal(one.phase_m, other.phase_m)
    assert np.array_equal(one.doppler_hz, -other.doppler_hz)
    assert same(town()(geometry), one)
    assert not np.array_equal(town(seed=2)(geometry).cn0_db, one.cn0_db)


def test_a_standing_train_has_constant_multipath_and_a_running_one_fades() -> None:
    stands = town()(seen(np.full(50, 123.4), [20.0, 35.0, 50.0], [80.0, -70.0, -110.0]))
    assert np.ptp(stands.cn0_db, axis=0) == pytest.approx(0.0, abs=1e-12)
    assert np.ptp(np.nan_to_num(stands.code_m), axis=0) == pytest.approx(0.0, abs=1e-12)
    runs = town()(seen(np.linspace(100.0, 150.0, 50), [20.0, 35.0, 50.0], [80.0, -70.0, -110.0], speed_mps=10.0))
    assert np.ptp(runs.cn0_db, axis=0).min() > 1.0


def test_without_surroundings_nothing_changes() -> None:
    nothing = Environment(EnvironmentSettings(), line_length_m=LINE_M, seed=1)
    assert EnvironmentSettings().empty
    assert not CITY.empty
    got = nothing(everywhere())
    assert not any(part.any() for part in (got.code_m, got.phase_m, got.doppler_hz, got.cn0_db))
    scenario = Scenario(duration_s=20.0, rate_hz=1.0)
    (clean,) = Simulation(scenario).pieces("front")
    (other,) = Simulation(scenario.replaced(multipath=(nothing,))).pieces("front")
    assert np.array_equal(clean.observations.code_m, other.observations.code_m, equal_nan=True)
    assert np.array_equal(clean.observations.cn0_dbhz, other.observations.cn0_dbhz, equal_nan=True)


def test_the_simulator_takes_it_at_its_seam() -> None:
    """Any cutting of a run gives the same codes; the tunnel is a hole in them."""
    scenario = Scenario(duration_s=100.0, rate_hz=1.0, multipath=(town(),))
    (whole,) = Simulation(scenario).pieces("front", chunk_epochs=100)
    parts = [p.observations.code_m for p in Simulation(scenario).pieces("front", chunk_epochs=17)]
    assert np.array_equal(np.concatenate(parts), whole.observations.code_m, equal_nan=True)
    tunnel = town().label_at(whole.geometry.chainage_m) == "tunnel"
    assert tunnel.any()
    assert np.isnan(whole.observations.code_m[tunnel]).all()
    assert np.isfinite(whole.observations.code_m[~tunnel]).mean() > 0.3


def test_shares_become_sections_of_that_length() -> None:
    shares = {"open": 0.25, "suburban": 0.4, "urban": 0.25, "tunnel": 0.1}
    sections = draw_sections(shares, 20_000.0, section_length_m=(150.0, 800.0), seed=4)  # type: ignore[arg-type]
    assert sections[0].from_m == 0.0
    assert sections[-1].to_m == pytest.approx(20_000.0)
    for kind, share in shares.items():
        length = sum(s.to_m - s.from_m for s in sections if s.kind == kind)
        assert length == pytest.approx(share * 20_000.0, abs=1e-3)
    assert all(a.to_m == b.from_m for a, b in pairwise(sections))
    assert len(sections) > 30
    place = Environment(EnvironmentSettings(shares=shares), line_length_m=20_000.0, seed=4)  # type: ignore[arg-type]
    assert place.sections == sections
    labels = place.label_at(np.arange(0.5, 20_000.0, 1.0))
    assert (labels == "tunnel").mean() == pytest.approx(0.1, abs=0.005)


def test_settings_come_from_plain_values_and_misspelt_ones_are_refused() -> None:
    adapter = TypeAdapter(EnvironmentSettings)
    plain = {
        "electrification": {"sides": "left", "beam_every": 2},
        "sections": [{"from_m": 0.0, "to_m": 90.0, "kind": "urban", "rows": [{"height_m": [9.0, 12.0]}]}],
    }
    got = adapter.validate_python(plain)
    assert got.sections[0].rows == (RowSettings(height_m=(9.0, 12.0)),)
    with pytest.raises(ValidationError, match="electrificaton"):
        adapter.validate_python({"electrificaton": {}})


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: SectionSettings(from_m=5.0, to_m=5.0, kind="urban"), "to_m"),
        (lambda: SectionSettings(from_m=5.0, to_m=9.0, kind="town"), "kind"),
        (lambda: RowSettings(height_m=(9.0, 3.0)), "height_m"),
        (lambda: RowSettings(reflection=(0.5, 1.5)), "reflection"),
        (lambda: RoofSettings(inner_m=9.0), "outer_m"),
        (lambda: ElectrificationSettings(spacing_m=0.0), "spacing_m"),
        (lambda: EnvironmentSettings(shares={"urban": 0.5}), "add up to 1"),
        (
            lambda: EnvironmentSettings(
                sections=(
                    SectionSettings(from_m=0.0, to_m=9.0, kind="open"),
                    SectionSettings(from_m=8.0, to_m=12.0, kind="urban"),
                )
            ),
            "without overlap",
        ),
    ],
)
def test_what_cannot_stand_there_is_refused(make, said: str) -> None:
    with pytest.raises(SettingsError, match=said):
        make()
