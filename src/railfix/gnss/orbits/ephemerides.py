"""Satellite states from broadcast records (Keplerian elements, GLONASS state vectors) and from precise ephemerides.

Precise positions are interpolated by a polynomial, and precise clocks linearly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices, Integers, RowArrays
from railfix.core.constants import (
    EARTH_ROTATION_RATE,
    EARTH_ROTATION_RATE_BEIDOU,
    EARTH_ROTATION_RATE_GLONASS,
    GM_GALILEO,
    GM_GLONASS,
    GM_GPS,
    PZ90_J2,
    PZ90_SEMI_MAJOR_AXIS,
    SPEED_OF_LIGHT,
)
from railfix.core.timescale import seconds
from railfix.gnss.navigation import GlonassRecords, KeplerRecords, PreciseEphemeris

Components = tuple[Floats, Floats, Floats]  #: x, y, z as separate arrays.

#: Inclination of the frame in which BeiDou GEO records are given [rad] (BDS-SIS-ICD-B1I 3.0, 5.2.4.12).
_GEO_TILT: Final = np.radians(-5.0)
#: Geocentric gravitational constant [m^3/s^2] by constellation.
GM: Final[Mapping[str, float]] = {"G": GM_GPS, "J": GM_GPS, "E": GM_GALILEO, "C": GM_GALILEO}
#: Earth rotation rate [rad/s] by constellation.
ROTATION: Final[Mapping[str, float]] = {
    "G": EARTH_ROTATION_RATE,
    "J": EARTH_ROTATION_RATE,
    "E": EARTH_ROTATION_RATE,
    "C": EARTH_ROTATION_RATE_BEIDOU,
}


@dataclass(frozen=True)
class Orbits(RowArrays):
    """Orbit elements and derived quantities, shape (n,); fields without a comment are as in `KeplerRecords`."""

    a: Floats  #: Semi-major axis [m].
    motion: Floats  #: Corrected mean motion [rad/s].
    eccentricity: Floats
    root: Floats  #: sqrt(1 - e^2).
    m0: Floats
    #: Cosine and sine of the argument of perigee, and of the inclination at toe.
    cos_omega: Floats
    sin_omega: Floats
    cos_i0: Floats
    sin_i0: Floats

    i_dot: Floats
    node: Floats  #: Longitude of the ascending node at toe [rad].
    node_rate: Floats  #: Rate of `node` [rad/s].
    #: Earth rotation rate for BeiDou GEO, whose tilted frame does not rotate with the Earth [rad/s]; otherwise 0.
    tilted_rate: Floats

    cuc: Floats
    cus: Floats
    crc: Floats
    crs: Floats
    cic: Floats
    cis: Floats
    relativity: Floats  #: F e sqrt(A), the factor of sin E in the relativistic clock correction [s].
    a_dot: Floats
    delta_n_dot: Floats

    @classmethod
    def from_records(cls, records: KeplerRecords) -> Orbits:
        """Compute the orbits of all records, in the order of the records."""
        system = records.satellite.astype("<U1").tolist()
        gm = np.array([GM.get(s, np.nan) for s in system], dtype=np.float64)
        rotation = np.array([ROTATION.get(s, np.nan) for s in system], dtype=np.float64)
        geo = np.array([is_beidou_geo(s) for s in records.satellite.tolist()], dtype=bool)
        a = records.sqrt_a * records.sqrt_a
        return cls(
            a=a,
            motion=np.sqrt(gm / (a * a * a)) + records.delta_n,
            root=np.sqrt(1.0 - records.eccentricity * records.eccentricity),
            cos_omega=np.cos(records.omega),
            sin_omega=np.sin(records.omega),
            cos_i0=np.cos(records.i0),
            sin_i0=np.sin(records.i0),
            node=records.omega0 - rotation * records.toe_sow_s,
            # GEO states are first computed in an inertial frame; the Earth's rotation is applied at the end.
            node_rate=records.omega_dot - np.where(geo, 0.0, rotation),
            tilted_rate=np.where(geo, rotation, 0.0),
            relativity=-2.0 * np.sqrt(gm) / SPEED_OF_LIGHT**2 * records.eccentricity * records.sqrt_a,
            **{name: getattr(records, name) for name in _AS_BROADCAST},
        )


_AS_BROADCAST: Final = ("eccentricity", "m0", "i_dot", "a_dot", "delta_n_dot", "cuc", "cus", "crc", "crs", "cic", "cis")


def is_beidou_geo(satellite: str) -> bool:
    """Return whether a satellite number belongs to a BeiDou GEO: C01 to C05, C59 to C63 (B1I ICD, table 4-1)."""
    return satellite[:1] == "C" and (int(satellite[1:]) <= 5 or int(satellite[1:]) >= 59)


def eccentric_anomaly(mean_anomaly: Floats, eccentricity: Floats) -> tuple[Floats, Floats, Floats]:
    """Solve M = E - e sin E in three Newton steps; return E, sin E and cos E, exact to rounding for e < 0.2."""
    anomaly = mean_anomaly
    sine, cosine = np.sin(anomaly), np.cos(anomaly)
    for _ in range(2):
        step = (mean_anomaly - anomaly + eccentricity * sine) / (1.0 - eccentricity * cosine)
        anomaly = anomaly + step
        sine, cosine = np.sin(anomaly), np.cos(anomaly)
    step = (mean_anomaly - anomaly + eccentricity * sine) / (1.0 - eccentricity * cosine)
    sine, cosine = _rotate(sine, cosine, step)
    return anomaly + step, sine, cosine


def _rotate(sine: Floats, cosine: Floats, angle: Floats) -> tuple[Floats, Floats]:
    """Add an angle below 1e-3 rad to an angle given by its sine and cosine; exact to rounding."""
    square = angle * angle
    small_sine = angle * (1.0 - square / 6.0)
    small_cosine = 1.0 - square * (0.5 - square / 24.0)
    return sine * small_cosine + cosine * small_sine, cosine * small_cosine - sine * small_sine


def kepler_state(orbits: Orbits, since_toe_s: Floats) -> tuple[Components, Components, Floats]:
    """Compute satellite states at the times `since_toe_s` after toe, shape (n,) (IS-GPS-200, tables 20-IV and 30-II).

    The harmonic corrections of the argument of latitude and the inclination are small angles (at most 1.3e-4 rad).
    Return position [m] and velocity [m/s] in the Earth-fixed frame of the same time, and the relativistic clock
    correction F e sqrt(A) sin E [s], which equals -2 r.v / c^2.
    """
    el, t = orbits, since_toe_s
    motion = el.motion + el.delta_n_dot * t
    _, sin_e, cos_e = eccentric_anomaly(el.m0 + 0.5 * (el.motion + motion) * t, el.eccentricity)
    shrink = 1.0 - el.eccentricity * cos_e
    sin_v, cos_v = el.root * sin_e / shrink, (cos_e - el.eccentricity) / shrink
    sin_p = sin_v * el.cos_omega + cos_v * el.sin_omega
    cos_p = cos_v * el.cos_omega - sin_v * el.sin_omega
    sin_2p, cos_2p = 2.0 * sin_p * cos_p, cos_p * cos_p - sin_p * sin_p
    sin_u, cos_u = _rotate(sin_p, cos_p, el.cus * sin_2p + el.cuc * cos_2p)
    sin_i, cos_i = _rotate(el.sin_i0, el.cos_i0, el.i_dot * t + el.cis * sin_2p + el.cic * cos_2p)
    a = el.a + el.a_dot * t
    r = a * shrink + el.crs * sin_2p + el.crc * cos_2p

    e_rate = motion / shrink
    p_rate = e_rate * el.root / shrink
    u_rate = p_rate * (1.0 + 2.0 * (el.cus * cos_2p - el.cuc * sin_2p))
    r_rate = (
        a * el.eccentricity * sin_e * e_rate + el.a_dot * shrink + 2.0 * p_rate * (el.crs * cos_2p - el.crc * sin_2p)
    )
    i_rate = el.i_dot + 2.0 * p_rate * (el.cis * cos_2p - el.cic * sin_2p)

    node = el.node + el.node_rate * t
    cos_n, sin_n = np.cos(node), np.sin(node)
    x, y = r * cos_u, r * sin_u
    x_rate, y_rate = r_rate * cos_u - y * u_rate, r_rate * sin_u + x * u_rate
    across, lift = y * cos_i, y * sin_i
    across_rate = y_rate * cos_i - lift * i_rate
    px, py = x * cos_n - across * sin_n, x * sin_n + across * cos_n
    position = (px, py, lift)
    velocity = (
        x_rate * cos_n - across_rate * sin_n - py * el.node_rate,
        x_rate * sin_n + across_rate * cos_n + px * el.node_rate,
        y_rate * sin_i + across * i_rate,
    )
    if el.tilted_rate.any():
        position, velocity = _out_of_tilted_frame(position, velocity, el.tilted_rate, t)
    return position, velocity, el.relativity * sin_e


def _out_of_tilted_frame(
    position: Components, velocity: Components, rate: Floats, since_toe_s: Floats
) -> tuple[Components, Components]:
    """Rotate BeiDou GEO states by R_z(omega t) R_x(-5 deg) (B1I ICD 3.0, 5.2.4.12); rows with rate 0 are unchanged."""
    cos_x, sin_x = np.cos(_GEO_TILT), np.sin(_GEO_TILT)
    angle = rate * since_toe_s
    cos_z, sin_z = np.cos(angle), np.sin(angle)

    def rotate(v: Components) -> Components:
        y, z = cos_x * v[1] + sin_x * v[2], cos_x * v[2] - sin_x * v[1]
        return cos_z * v[0] + sin_z * y, cos_z * y - sin_z * v[0], z

    place, speed = rotate(position), rotate(velocity)
    speed = (speed[0] + rate * place[1], speed[1] - rate * place[0], speed[2])
    tilted = rate != 0.0
    x, y, z = (np.where(tilted, new, old) for new, old in zip(place, position, strict=True))
    vx, vy, vz = (np.where(tilted, new, old) for new, old in zip(speed, velocity, strict=True))
    return (x, y, z), (vx, vy, vz)


STEP_S: Final = 60.0  #: Step of the integration [s]; the accuracy in the ICD is for a step of 60 s.
_BLOCK: Final = 8192  #: Largest number of rows integrated at once, so that the arrays stay in the cache.


def acceleration(position: Floats, velocity: Floats, luni_solar: Floats) -> Floats:
    """Compute the Earth-fixed acceleration (3, n) [m/s^2] due to central force, J2, Earth rotation, Moon and Sun."""
    omega = EARTH_ROTATION_RATE_GLONASS
    x, y, z = position
    r2 = x * x + y * y + z * z
    r3 = r2 * np.sqrt(r2)
    flat = 1.5 * PZ90_J2 * GM_GLONASS * PZ90_SEMI_MAJOR_AXIS**2 / (r2 * r3)
    z2 = 5.0 * z * z / r2
    central = -GM_GLONASS / r3
    plane = central - flat * (1.0 - z2) + omega**2
    result = np.empty_like(position)
    result[0] = luni_solar[0] + plane * x + 2.0 * omega * velocity[1]
    result[1] = luni_solar[1] + plane * y - 2.0 * omega * velocity[0]
    result[2] = luni_solar[2] + (central - flat * (3.0 - z2)) * z
    return result


def runge_kutta(position: Floats, velocity: Floats, luni_solar: Floats, step_s: Floats) -> tuple[Floats, Floats]:
    """Integrate one fourth-order step, forward or backward; arrays of shape (3, n), steps of shape (n,)."""
    h = step_s
    a1 = acceleration(position, velocity, luni_solar)
    v1 = velocity + 0.5 * h * a1
    a2 = acceleration(position + 0.5 * h * velocity, v1, luni_solar)
    v2 = velocity + 0.5 * h * a2
    a3 = acceleration(position + 0.5 * h * v1, v2, luni_solar)
    v3 = velocity + h * a3
    a4 = acceleration(position + h * v2, v3, luni_solar)
    new_position = position + h / 6.0 * (velocity + 2.0 * (v1 + v2) + v3)
    return new_position, velocity + h / 6.0 * (a1 + 2.0 * (a2 + a3) + a4)


@dataclass(frozen=True)
class GlonassStates:
    """States of all GLONASS records at multiples of `STEP_S` from the reference time of each record."""

    #: Position [m] and velocity [m/s], shape (3, records, 2 * steps + 1); the middle column is the reference time.
    position: Floats
    velocity: Floats
    luni_solar: Floats  #: Acceleration due to Moon and Sun, shape (3, records) [m/s^2].

    @classmethod
    def from_records(cls, records: GlonassRecords, reach_s: float) -> GlonassStates:
        """Integrate all records forward and backward over `reach_s` and one more step."""
        steps = int(np.ceil(reach_s / STEP_S)) + 1
        luni_solar = np.ascontiguousarray(records.acceleration_ecef_mps2.T)
        position = np.empty((3, len(records), 2 * steps + 1))
        velocity = np.empty_like(position)
        for direction in (1, -1):
            x, v = records.position_ecef_m.T.copy(), records.velocity_ecef_mps.T.copy()
            for i in range(steps + 1):
                position[:, :, steps + direction * i], velocity[:, :, steps + direction * i] = x, v
                x, v = runge_kutta(x, v, luni_solar, np.full(len(records), direction * STEP_S))
        return cls(position, velocity, luni_solar)

    def state(self, row: Integers, since_toe_s: Floats) -> tuple[Floats, Floats]:
        """Compute positions and velocities (3, n) of the records `row` (n,) at the times `since_toe_s` (n,) after toe.

        The times are between -`reach_s` and `reach_s`.
        """
        middle = self.position.shape[2] // 2
        node = np.trunc(since_toe_s / STEP_S)
        rest = since_toe_s - node * STEP_S
        at = row * self.position.shape[2] + node.astype(np.int64) + middle
        position, velocity = np.empty((3, len(row))), np.empty((3, len(row)))
        flat_position, flat_velocity = self.position.reshape(3, -1), self.velocity.reshape(3, -1)
        for begin in range(0, len(row), _BLOCK):
            part = slice(begin, begin + _BLOCK)
            position[:, part], velocity[:, part] = runge_kutta(
                flat_position[:, at[part]], flat_velocity[:, at[part]], self.luni_solar[:, row[part]], rest[part]
            )
        return position, velocity


#: Number of points of the interpolation polynomial (order 12). With positions every 15 minutes, the error is within 3
#: mm for the two Galileo satellites in elliptic orbits, where the usual 11 points cause errors of 17 mm near perigee,
#: and within a micrometre for other satellites. In the first and last interval of a file, the error is up to 0.7 m for
#: these two satellites, and 0.05 mm for others.
POINTS: Final = 13
#: An interval between epochs longer than this multiple of the usual interval is a gap, in which states are NaN.
_GAP: Final = 1.5
_STATES: Final = 4096  #: Largest number of states computed at once, so that the arrays stay in the cache.


def precise_clock_s(ephemeris: PreciseEphemeris, column: Indices, time: Datetimes, offset_s: Floats) -> Floats:
    """Interpolate the clocks of a precise ephemeris linearly at ``time + offset_s``, shape (n,) [s]."""
    left = np.clip(np.searchsorted(ephemeris.time, time, side="right") - 1, 0, len(ephemeris.time) - 2)
    step = seconds(ephemeris.time[left + 1] - ephemeris.time[left])
    part = (seconds(time - ephemeris.time[left]) + offset_s) / step
    before, after = ephemeris.clock_s[left, column], ephemeris.clock_s[left + 1, column]
    return np.asarray(before + part * (after - before))


def precise_state(
    ephemeris: PreciseEphemeris, column: Indices, time: Datetimes, offset_s: Floats
) -> tuple[Floats, Floats, Floats]:
    """Compute positions and velocities (3, n), and clocks (n,) of satellites at ``time + offset_s``.

    `column` is -1 where the ephemeris lacks a satellite; `offset_s` is a fraction of a second. The result is NaN where
    a position for the interpolation is missing, and where the time is outside the file or in a gap. The clock includes
    the relativistic correction -2 r.v / c^2, which SP3 clocks do not contain. Raise ValueError if the ephemeris has
    fewer than `POINTS` epochs.
    """
    if len(ephemeris.time) < POINTS:
        raise ValueError(f"a precise ephemeris needs at least {POINTS} epochs, got {len(ephemeris.time)}")
    position, velocity, clock = np.empty((3, len(time))), np.empty((3, len(time))), np.empty(len(time))
    longest_s = _GAP * float(np.median(seconds(np.diff(ephemeris.time))))
    for begin in range(0, len(time), _STATES):
        part = slice(begin, begin + _STATES)
        block = _state(ephemeris, longest_s, column[part], time[part], offset_s[part])
        position[:, part], velocity[:, part], clock[part] = block
    return position, velocity, clock


def _state(
    ephemeris: PreciseEphemeris, longest_s: float, column: Indices, time: Datetimes, offset_s: Floats
) -> tuple[Floats, Floats, Floats]:
    nodes = ephemeris.time
    right = np.searchsorted(nodes, time, side="right")
    begin = np.clip(right - (POINTS + 1) // 2, 0, len(nodes) - POINTS)
    windows, which = np.unique(begin, return_inverse=True)
    index = windows + np.arange(POINTS)[:, None]
    since = seconds(nodes[index] - nodes[windows])
    # Rotate the nodes into one inertial frame, the Earth-fixed frame at the first node; there, the orbit is smooth.
    place = np.moveaxis(ephemeris.position_ecef_m[index], -1, 0)
    rotated = np.stack(_rotate_axes(EARTH_ROTATION_RATE * since[..., None], place))
    own = seconds(time - nodes[begin]) + offset_s
    difference = since[:, None] - since[None]  # time differences between the nodes of each window
    difference[np.arange(POINTS), np.arange(POINTS)] = 1.0
    weight, slope = _lagrange_at_zero(since[:, which] - own, difference.prod(axis=1)[:, which])
    chosen = rotated[:, :, which, column]
    position = np.stack(_rotate_axes(-EARTH_ROTATION_RATE * own, _sum(weight * chosen)))
    velocity = np.stack(_rotate_axes(-EARTH_ROTATION_RATE * own, _sum(slope * chosen)))
    velocity[0] += EARTH_ROTATION_RATE * position[1]
    velocity[1] -= EARTH_ROTATION_RATE * position[0]

    # r.v is the same for inertial and Earth-fixed velocities, which differ only by a vector perpendicular to r.
    x, y, z = position * velocity
    relativity = -2.0 * (x + y + z) / SPEED_OF_LIGHT**2
    clock = precise_clock_s(ephemeris, column, time, offset_s) + relativity
    left = np.clip(right - 1, 0, len(nodes) - 2)
    outside = (column < 0) | (right == 0) | ((right == len(nodes)) & (time != nodes[-1]))
    outside |= seconds(nodes[left + 1] - nodes[left]) > longest_s
    position[:, outside], velocity[:, outside], clock[outside] = np.nan, np.nan, np.nan
    return position, velocity, clock


def _sum(terms: Floats) -> Floats:
    """Return the sum over the nodes (axis 1), with the terms added in a fixed order, for reproducible rounding."""
    total = terms[:, 0].copy()
    for i in range(1, terms.shape[1]):
        total += terms[:, i]
    return total


def _rotate_axes(angle: Floats, vector: Floats) -> tuple[Floats, Floats, Floats]:
    """Rotate vectors, with components in axis 0, about the Earth's axis by an angle [rad]."""
    cos, sin = np.cos(angle), np.sin(angle)
    return cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1], vector[2]


def _lagrange_at_zero(nodes: Floats, node_products: Floats) -> tuple[Floats, Floats]:
    """Return the Lagrange weights of the nodes for the value at 0 and for the slope at 0, shape (P, n) each."""
    points = len(nodes)
    start = (np.ones(nodes.shape[1]), np.zeros(nodes.shape[1]))
    before, after = [start], [start]
    for i in range(points - 1):
        value, rate = before[-1]
        before.append((-nodes[i] * value, value - nodes[i] * rate))
        value, rate = after[-1]
        j = points - 1 - i
        after.append((-nodes[j] * value, value - nodes[j] * rate))
    weight, slope = np.empty(nodes.shape), np.empty(nodes.shape)
    for i in range(points):
        (p, p_rate), (q, q_rate) = before[i], after[points - 1 - i]
        weight[i], slope[i] = p * q / node_products[i], (p_rate * q + p * q_rate) / node_products[i]
    return weight, slope
