"""The ionospheric grid of SBAS: cells, states, variances, time-outs, the troposphere's sigma."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

import sbas_cases as cases
from railfix.ranges.sbas import IonosphereDelays, IonosphereState, SbasCorrections, SbasLimits
from railfix.ranges.sbas.ionosphere import (
    BANDS,
    CELLS_OF_POINT,
    EARTH_RADIUS_KM,
    LAYER_HEIGHT_KM,
    POINT_OF_BIT,
    pierce_point,
    point_number,
)
from railfix.ranges.sbas.troposphere import rtca_troposphere_m, rtca_troposphere_sigma_m

pytestmark = pytest.mark.requirement("C1")

Rows = list[tuple[float, int, np.ndarray]]
OK = IonosphereState.OK
ZENITH = np.array([[90.0]])
#: Delay that says do not use [m].
DO_NOT_USE_M = 63.875


def bits_of(band: int, points: list[tuple[int, int]]) -> list[int]:
    numbers = [int(point_number(np.array(a), np.array(o))) for a, o in points]
    return [POINT_OF_BIT[band].tolist().index(n) for n in numbers]


def grid(
    cells: dict[int, dict[tuple[int, int], tuple[float, int]]], *, iodi: int = 0, sent: int = 0, **ten: int
) -> Rows:
    """Masks and delays: band -> point -> (delay [m], GIVEI); degradation of type 10 in raw numbers."""
    rows: Rows = [(sent, 0, cases.parameters(sent, **ten))]
    second = sent + 1
    for band, points in cells.items():
        bits = bits_of(band, list(points))
        rows.append((second, 0, cases.grid_mask(second, band, bits, iodi, bands=len(cells))))
        ordered = [value for _, value in sorted(zip(bits, points.values(), strict=True))]
        for block in range(-(-len(ordered) // 15)):
            second += 1
            part = ordered[15 * block : 15 * block + 15]
            delays = cases.grid_delay(second, band, block, [d for d, _ in part], [g for _, g in part], iodi)
            rows.append((second, 0, delays))
        second += 1
    return rows


def overhead(rows: Rows, latitude: float, longitude: float, second: float = 30.0) -> IonosphereDelays:
    """Delay straight up: the pierce point is the place."""
    engine = SbasCorrections.from_log(cases.message_log(rows))
    time = np.array([cases.START + np.timedelta64(round(second * 1000), "ms")])
    return engine.ionosphere(time, np.array([latitude]), np.array([longitude]), ZENITH, np.zeros((1, 1)))


def square(*values: tuple[float, int]) -> dict[int, dict[tuple[int, int], tuple[float, int]]]:
    """The cell of 35 to 40 north, 135 to 140 east in the order SW, NW, SE, NE, as far as values are given."""
    corners = [(35, 135), (40, 135), (35, 140), (40, 140)]
    band_7 = {c: v for c, v in zip(corners, values, strict=False) if v and c[1] < 140}
    band_8 = {c: v for c, v in zip(corners, values, strict=False) if v and c[1] >= 140}
    return {band: points for band, points in ((7, band_7), (8, band_8)) if points}


FOUR = ((1.0, 0), (2.0, 1), (3.0, 2), (5.0, 3))
VARIANCE = (0.0084, 0.0333, 0.0749, 0.1331)


def test_latitudes_of_the_bands_are_those_of_table_a_14() -> None:
    """Every meridian up to 55 degrees, every other one at 65 and 75, few at 85; bands 9 and 10 around the poles."""
    for band in range(BANDS):
        number = POINT_OF_BIT[band][POINT_OF_BIT[band] >= 0]
        found = Counter((5 * (number // 72) - 90).tolist())
        if band < 9:
            expected = Counter(dict.fromkeys(range(-55, 60, 5), 8))
            expected.update(dict.fromkeys((-75, -65, 65, 75), 4))
            # One at 85 north on every 90th meridian (bands 1, 3, ...), one south 40 degrees further (bands 0, 2, ...).
            longitudes = range(-180 + 40 * band, -140 + 40 * band, 5)
            expected[85] = sum(longitude % 90 == 0 for longitude in longitudes)
            expected[-85] = sum((longitude - 40) % 90 == 0 for longitude in longitudes)
        else:
            sign = 1 if band == 9 else -1
            expected = Counter({60 * sign: 72, 65 * sign: 36, 70 * sign: 36, 75 * sign: 36, 85 * sign: 12})
        assert found == +expected, band
        assert len(set(number.tolist())) == len(number)


def test_every_point_of_the_bands_has_its_place() -> None:
    """Table A-14: 201 points in bands 0 to 7, 200 in 8, 192 in 9 and 10; a few by hand."""
    assert [int((row >= 0).sum()) for row in POINT_OF_BIT] == [201] * 8 + [200] + [192] * 2
    known = {(0, 1): (-75, -180), (0, 28): (85, -180), (0, 29): (-55, -175), (1, 1): (-85, -140), (4, 128): (85, 0),
             (7, 151): (-85, 130), (8, 200): (55, 175), (9, 73): (65, -180), (9, 181): (85, -180),
             (10, 192): (-85, 160)}  # fmt: skip
    for (band, bit), place in known.items():
        assert POINT_OF_BIT[band, bit - 1] == point_number(np.array(place[0]), np.array(place[1])), (band, bit)
    for band in range(BANDS):
        for bit, point in enumerate(POINT_OF_BIT[band].tolist()):
            assert point < 0 or band * 201 + bit in CELLS_OF_POINT[point]


def test_four_points_are_weighed_by_the_place() -> None:
    """A quarter east and three fifths north."""
    found = overhead(grid(square(*FOUR)), 38.0, 136.25)
    weights = np.array([0.75 * 0.4, 0.75 * 0.6, 0.25 * 0.4, 0.25 * 0.6])
    assert found.state.item() == OK
    assert found.points.item() == 4
    assert found.delay_m.item() == pytest.approx(weights @ [1.0, 2.0, 3.0, 5.0], abs=1e-9)
    assert found.sigma_uire_m.item() == pytest.approx(np.sqrt(weights @ VARIANCE), abs=1e-9)


@pytest.mark.parametrize(
    ("missing", "inside", "weights", "outside"),
    [
        (0, (39.0, 139.0), (0.0, 0.2, 0.2, 0.6), (36.0, 136.0)),
        (1, (36.0, 139.0), (0.2, 0.0, 0.6, 0.2), (39.0, 136.0)),
        (2, (39.0, 136.0), (0.2, 0.6, 0.0, 0.2), (36.0, 139.0)),
        (3, (36.0, 136.0), (0.6, 0.2, 0.2, 0.0), (39.0, 139.0)),
    ],
)
def test_three_points_do_if_they_are_around_the_place(
    missing: int, inside: tuple[float, float], weights: tuple[float, ...], outside: tuple[float, float]
) -> None:
    """The fourth not in the mask, or not monitored; outside the triangle there is no delay."""
    absent = [None if i == missing else v for i, v in enumerate(FOUR)]
    blind = [(v[0], 15) if i == missing else v for i, v in enumerate(FOUR)]
    forbidden = [(DO_NOT_USE_M, 3) if i == missing else v for i, v in enumerate(FOUR)]
    for values, otherwise in ((absent, IonosphereState.NO_GRID), (blind, IonosphereState.NOT_MONITORED)):
        rows = grid(square(*values))  # type: ignore[arg-type]
        found = overhead(rows, *inside)
        assert (found.state.item(), found.points.item()) == (OK, 3)
        assert found.delay_m.item() == pytest.approx(np.dot(weights, [1.0, 2.0, 3.0, 5.0]), abs=1e-9)
        assert found.sigma_uire_m.item() == pytest.approx(np.sqrt(np.dot(weights, VARIANCE)), abs=1e-9)
        assert (overhead(rows, *outside).state.item(), overhead(rows, *outside).points.item()) == (otherwise, 0)
    for place in (inside, outside):
        found = overhead(grid(square(*forbidden)), *place)
        assert found.state.item() == IonosphereState.DO_NOT_USE
        assert np.isnan(found.delay_m.item())


@pytest.mark.parametrize(
    ("band", "places", "at", "east", "north"),
    [
        (7, [(35, 125), (45, 125), (35, 135), (45, 135)], (41.0, 127.0), 0.2, 0.6),
        (9, [(65, 0), (70, 0), (65, 10), (70, 10)], (67.0, 4.0), 0.4, 0.4),
        (9, [(60, 0), (65, 0), (60, 10), (65, 10)], (60.5, 4.0), 0.4, 0.1),
    ],
    ids=["large, beginning anywhere", "wider north of 60 degrees", "wider from 60 degrees on"],
)
def test_cells_of_other_sizes(
    band: int, places: list[tuple[int, int]], at: tuple[float, float], east: float, north: float
) -> None:
    found = overhead(grid({band: dict(zip(places, FOUR, strict=True))}), *at)
    weights = np.outer([1.0 - east, east], [1.0 - north, north]).ravel()
    assert found.delay_m.item() == pytest.approx(weights @ [1.0, 2.0, 3.0, 5.0], abs=1e-9)


def test_a_large_cell_serves_where_the_mask_has_no_small_one() -> None:
    points = dict(zip([(30, 120), (40, 120), (30, 130), (40, 130)], FOUR, strict=True))
    found = overhead(grid({7: points}), 36.0, 122.0)
    assert found.delay_m.item() == pytest.approx([0.32, 0.48, 0.08, 0.12] @ np.array([1.0, 2.0, 3.0, 5.0]), abs=1e-9)
    # As soon as the mask has the small cell it is that one, monitored or not.
    small = {(35, 120): (0.0, 15), (40, 125): (0.0, 15), (35, 125): (0.0, 15)}
    assert overhead(grid({7: points | small}), 36.0, 122.0).state.item() == IonosphereState.NOT_MONITORED


def test_points_near_the_pole_are_interpolated_along_it_first() -> None:
    """75 to 85 degrees: the upper corners lie between points 30 degrees apart; worked by hand."""
    points = {(75, 40): (1.0, 0), (75, 50): (2.0, 0), (85, 30): (3.0, 0), (85, 60): (6.0, 0)}
    found = overhead(grid({9: points}), 79.0, 46.0)
    upper = 3.0 + 3.0 * 16.0 / 30.0
    assert found.delay_m.item() == pytest.approx(0.6 * (0.4 * 1.0 + 0.6 * 2.0) + 0.4 * upper, abs=1e-9)
    # Without the polar band the points at 85 degrees are 90 apart.
    wide = {5: {(75, 40): (1.0, 0), (75, 50): (2.0, 0)}, 4: {(85, 0): (3.0, 0)}, 6: {(85, 90): (6.0, 0)}}
    found = overhead(grid(wide), 79.0, 46.0)
    assert found.delay_m.item() == pytest.approx(0.6 * 1.6 + 0.4 * (3.0 + 3.0 * 46.0 / 90.0), abs=1e-9)
    south = {(-75, 40): (1.0, 0), (-75, 50): (2.0, 0), (-85, 40): (3.0, 0), (-85, 70): (6.0, 0)}
    found = overhead(grid({10: south}), -79.0, 46.0)
    assert found.delay_m.item() == pytest.approx(0.6 * (0.4 * 1.0 + 0.6 * 2.0) + 0.4 * (3.0 + 0.6), abs=1e-9)


def test_around_the_pole_four_points_do() -> None:
    """Every point gives its own value above it, and the pole the mean of the four."""
    points = {(85, -180): (1.0, 0), (85, -90): (2.0, 0), (85, 0): (4.0, 0), (85, 90): (9.0, 0)}
    rows = grid({9: points})
    assert overhead(rows, 89.999999, 12.0).delay_m.item() == pytest.approx(4.0, abs=1e-4)
    for (_, longitude), (value, _) in points.items():
        assert overhead(rows, 85.000001, longitude + 1e-6).delay_m.item() == pytest.approx(value, abs=1e-4)


def test_the_pierce_point_lies_on_the_layer_in_the_direction_of_the_satellite() -> None:
    """By vectors on a sphere, all over the globe."""
    random = np.random.default_rng(3)
    count = 400
    latitude, longitude = random.uniform(-89.0, 89.0, count), random.uniform(-180.0, 180.0, count)
    elevation, azimuth = random.uniform(5.0, 89.0, count), random.uniform(0.0, 360.0, count)
    a, o, e, z = (np.radians(v) for v in (latitude, longitude, elevation, azimuth))
    up = np.stack([np.cos(a) * np.cos(o), np.cos(a) * np.sin(o), np.sin(a)], axis=1)
    east = np.stack([-np.sin(o), np.cos(o), np.zeros(count)], axis=1)
    north = np.cross(up, east)
    toward = np.cos(e)[:, None] * (np.sin(z)[:, None] * east + np.cos(z)[:, None] * north) + np.sin(e)[:, None] * up
    radius = EARTH_RADIUS_KM + LAYER_HEIGHT_KM
    along = -EARTH_RADIUS_KM * np.sin(e) + np.sqrt(radius**2 - (EARTH_RADIUS_KM * np.cos(e)) ** 2)
    place = EARTH_RADIUS_KM * up + along[:, None] * toward
    found = pierce_point(latitude, longitude, elevation[:, None], azimuth[:, None])
    assert np.abs(found[0][:, 0] - np.degrees(np.arcsin(place[:, 2] / radius))).max() < 1e-6
    turn = found[1][:, 0] - np.degrees(np.arctan2(place[:, 1], place[:, 0]))
    assert np.abs((turn + 180.0) % 360.0 - 180.0).max() < 1e-5
    steepness = (place * toward).sum(axis=1) / radius
    assert np.abs(found[2][:, 0] - 1.0 / steepness).max() < 1e-9


def test_a_slant_delay_is_longer_by_the_obliquity() -> None:
    rows = grid(square((2.0, 0), (2.0, 0), (2.0, 0), (2.0, 0)))
    engine = SbasCorrections.from_log(cases.message_log(rows))
    time = np.array([cases.START + np.timedelta64(30, "s")])
    found = engine.ionosphere(
        time, np.array([37.5]), np.array([137.5]), np.array([[60.0, 0.0, -5.0]]), np.zeros((1, 3))
    )
    ratio = 1.0 / np.sqrt(1.0 - (EARTH_RADIUS_KM * 0.5 / (EARTH_RADIUS_KM + LAYER_HEIGHT_KM)) ** 2)
    assert found.delay_m[0, 0] == pytest.approx(2.0 * ratio)
    assert found.sigma_uire_m[0, 0] == pytest.approx(np.sqrt(0.0084) * ratio)
    assert np.isnan(found.delay_m[0, 1:]).all()


@pytest.mark.parametrize("squares", [0, 1])
def test_variances_grow_with_age(squares: int) -> None:
    """A.4.5.2 by hand: steps of 0.01 m every 20 s and 0.001 m/s, 45 s after the first bit."""
    ten = {"ciono_step": 10, "iiono": 20, "ciono_ramp": 200, "rss_iono": squares}
    found = overhead(grid(square(*[(2.0, 2)] * 4), **ten), 35.0, 135.0, second=2.0 + 44.0)
    grown = 2 * 0.01 + 0.001 * 45.0
    sigma = np.sqrt(0.0749 + grown**2) if squares else np.sqrt(0.0749) + grown
    assert found.sigma_uire_m.item() == pytest.approx(sigma)


def again(rows: Rows, kind: int, until: int, every: int = 50) -> Rows:
    """The same, with messages of other types than `kind` said again and again."""
    more = [(s + d, p, b) for s, p, b in rows for d in range(0, until, every) if d == 0 or b[1] >> 2 != kind]
    return more


@pytest.mark.parametrize(
    ("kind", "last", "then"),
    [
        # Mask and delays of the cell come at 1 and 2 s (west), 3 and 4 s (east).
        (18, 1 + 1200, IonosphereState.NO_GRID),
        (26, 2 + 600, IonosphereState.TIMED_OUT),
        (10, 0 + 240, IonosphereState.NO_DEGRADATION),
    ],
)
def test_time_outs_are_exact(kind: int, last: int, then: IonosphereState) -> None:
    rows = again(grid(square(*[(2.0, 2)] * 4)), kind, 1300)
    assert overhead(rows, 37.5, 137.5, last).state.item() == OK
    found = overhead(rows, 37.5, 137.5, last + 0.001)
    assert found.state.item() == then
    assert np.isnan(found.sigma_uire_m.item())
    assert np.isnan(found.delay_m.item()) == (then != IonosphereState.NO_DEGRADATION)


def test_delays_of_another_mask_are_not_used() -> None:
    """IODI: a block for a mask that was not sent is counted and left."""
    rows = grid(square(*FOUR))
    rows.append((20, 0, cases.grid_delay(20, 7, 0, [9.0] * 15, [0] * 15, iodi=1)))
    assert overhead(rows, 35.0, 135.0).delay_m.item() == 1.0
    engine = SbasCorrections.from_log(cases.message_log(rows))
    assert engine.unused["grid delays without a mask of their IODI"] == 15
    # With its mask it is: the first point of the new mask is another.
    rows.append((19, 0, cases.grid_mask(19, 7, bits_of(7, [(40, 135)]), 1)))
    assert overhead(rows, 40.0, 135.0).state.item() == IonosphereState.NO_GRID
    rows += [(21, 0, cases.grid_mask(21, 7, bits_of(7, [(35, 135), (40, 135)]), 1)),
             (22, 0, cases.grid_delay(22, 7, 0, [7.0, 8.0], [0, 0], iodi=1))]  # fmt: skip
    assert overhead(rows, 35.0, 135.0).delay_m.item() == 7.0


def test_a_delay_goes_with_its_mask() -> None:
    """The points are in the new mask already, the delays still of the old, which times out first."""
    rows = grid(square(*[(2.0, 2)] * 4))
    rows += [(1100 + s, p, b) for s, p, b in rows if b[1] >> 2 in (10, 26)]
    rows += [
        (1110, 0, cases.grid_mask(1110, band, bits_of(band, [(35, o), (40, o)]), 1)) for band, o in ((7, 135), (8, 140))
    ]
    assert overhead(rows, 37.5, 137.5, 1201.0).state.item() == OK
    assert overhead(rows, 37.5, 137.5, 1201.001).state.item() == IonosphereState.TIMED_OUT


def test_type_0_stops_the_grid_too() -> None:
    rows = [*grid(square(*FOUR)), (20, 0, cases.message(0, 20))]
    assert overhead(rows, 38.0, 136.0, 19.0).state.item() == OK
    assert overhead(rows, 38.0, 136.0, 79.0).state.item() == IonosphereState.GEO_STOPPED
    assert overhead(rows, 38.0, 136.0, 81.0).state.item() == IonosphereState.NO_GRID


def test_without_a_grid_there_is_no_delay() -> None:
    found = overhead([(0, 0, cases.message(63, 0))], 38.0, 136.0)
    assert found.state.item() == IonosphereState.NO_GRID
    assert np.isnan(found.delay_m.item())


def test_the_troposphere_by_hand() -> None:
    """Mid-latitude, sea level, day 28: 1015.75 + 2.25 mbar give 2.32 m of dry delay; sigma is 0.12 m upward."""
    time = np.array(["2025-01-28T00:00:00"], dtype="datetime64[ns]")
    found = rtca_troposphere_m(time, np.array([45.0]), np.array([0.0]), np.array([[90.0, 30.0, 3.0, 1.0]]))
    pressure, temperature, vapour, lapse, power = 1018.0, 272.15, 4.42, 5.26e-3, 2.11
    dry = 1e-6 * 77.604 * 287.054 * pressure / 9.784
    wet = 1e-6 * 382_000.0 * 287.054 / (9.784 * (power + 1.0) - lapse * 287.054) * vapour / temperature
    upward = 1.001 / np.sqrt(1.002001)
    assert found[0, 0] == pytest.approx((dry + wet) * upward, abs=1e-9)
    assert found[0, 1] == pytest.approx((dry + wet) * 1.001 / np.sqrt(0.252001), abs=1e-9)
    low = 1.001 / np.sqrt(0.002001 + np.sin(np.radians(3.0)) ** 2) * 1.015
    assert found[0, 2] == pytest.approx((dry + wet) * low, abs=1e-9)
    assert np.isnan(found[0, 3])
    assert rtca_troposphere_sigma_m(np.array([90.0, 3.0])) == pytest.approx([0.12 * upward, 0.12 * low])


def test_limits_of_the_height_are_kept() -> None:
    time = np.array(["2025-01-28"] * 3, dtype="datetime64[ns]")
    found = rtca_troposphere_m(time, np.full(3, 35.0), np.array([-200.0, 100.0, 2e4]), np.full((3, 1), 45.0))
    assert np.isnan(found[:, 0]).tolist() == [True, False, True]


def test_precision_of_the_mode_does_not_touch_the_grid() -> None:
    rows = again(grid(square(*[(2.0, 2)] * 4)), 10, 400)
    engine = SbasCorrections.from_log(cases.message_log(rows), limits=SbasLimits(mode="en_route"))
    time = np.array([cases.START + np.timedelta64(360, "s"), cases.START + np.timedelta64(361, "s")])
    place = np.full(2, 37.5), np.full(2, 137.5), np.full((2, 1), 90.0), np.zeros((2, 1))
    assert engine.ionosphere(time, *place).state[:, 0].tolist() == [OK, IonosphereState.NO_DEGRADATION]
