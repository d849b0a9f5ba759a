"""Positions, velocities and clocks of Keplerian broadcast records, any number at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from railfix.constants import (
    EARTH_ROTATION_RATE,
    EARTH_ROTATION_RATE_BEIDOU,
    GM_GALILEO,
    GM_GPS,
    SPEED_OF_LIGHT,
)

Floats = NDArray[np.float64]

#: Inclination of the frame in which BeiDou GEO records are given [rad] (BDS-SIS-ICD-B1I 3.0, 5.2.4.12).
_GEO_TILT: Final = np.radians(-5.0)
#: Gravitational constant by constellation.
GM: Final[Mapping[str, float]] = {"G": GM_GPS, "J": GM_GPS, "E": GM_GALILEO, "C": GM_GALILEO}
#: Earth rotation rate by constellation.
ROTATION: Final[Mapping[str, float]] = {
    "G": EARTH_ROTATION_RATE,
    "J": EARTH_ROTATION_RATE,
    "E": EARTH_ROTATION_RATE,
    "C": EARTH_ROTATION_RATE_BEIDOU,
}


@dataclass(frozen=True, kw_only=True)
class Elements:
    """Orbital elements, one row a state asked for; names as `navigation.KeplerRecords`.

    `gm` [m^3/s^2] and `rotation` [rad/s] are those of the constellation, `geo` is True for
    BeiDou satellites whose records are given in the tilted frame.
    """

    sqrt_a: Floats
    eccentricity: Floats
    m0: Floats
    delta_n: Floats
    omega0: Floats
    i0: Floats
    omega: Floats
    omega_dot: Floats
    i_dot: Floats
    cuc: Floats
    cus: Floats
    crc: Floats
    crs: Floats
    cic: Floats
    cis: Floats
    toe_sow_s: Floats
    gm: Floats
    rotation: Floats
    geo: NDArray[np.bool_]


def eccentric_anomaly(mean_anomaly: Floats, eccentricity: Floats) -> Floats:
    """Kepler's equation M = E - e sin E by Newton's method, to the last digit for e < 0.2."""
    anomaly = mean_anomaly + eccentricity * np.sin(mean_anomaly)
    for _ in range(5):
        anomaly = anomaly - (anomaly - eccentricity * np.sin(anomaly) - mean_anomaly) / (
            1.0 - eccentricity * np.cos(anomaly)
        )
    return anomaly


def kepler_state(elements: Elements, since_toe_s: Floats) -> tuple[Floats, Floats, Floats]:
    """State of satellites a time after their records' toe (IS-GPS-200, table 20-IV).

    Parameters
    ----------
    elements : Elements
        n rows.
    since_toe_s : ndarray, shape (n,) [s]

    Returns
    -------
    position_ecef_m, velocity_ecef_mps : ndarray, shape (n, 3)
        Earth-fixed at that very time.
    relativity_s : ndarray, shape (n,) [s]
        -2 sqrt(GM) / c^2 * e sqrt(A) sin E, the same as -2 r.v / c^2.
    """
    el, t = elements, since_toe_s
    a = el.sqrt_a**2
    motion = np.sqrt(el.gm / a**3) + el.delta_n
    big_e = eccentric_anomaly(el.m0 + motion * t, el.eccentricity)
    sin_e, cos_e = np.sin(big_e), np.cos(big_e)
    root = np.sqrt(1.0 - el.eccentricity**2)
    shrink = 1.0 - el.eccentricity * cos_e
    phi = np.arctan2(root * sin_e, cos_e - el.eccentricity) + el.omega
    sin_2p, cos_2p = np.sin(2.0 * phi), np.cos(2.0 * phi)
    u = phi + el.cus * sin_2p + el.cuc * cos_2p
    r = a * shrink + el.crs * sin_2p + el.crc * cos_2p
    i = el.i0 + el.i_dot * t + el.cis * sin_2p + el.cic * cos_2p

    e_dot = motion / shrink
    phi_dot = e_dot * root / shrink
    u_dot = phi_dot * (1.0 + 2.0 * (el.cus * cos_2p - el.cuc * sin_2p))
    r_dot = a * el.eccentricity * sin_e * e_dot + 2.0 * phi_dot * (el.crs * cos_2p - el.crc * sin_2p)
    i_rate = el.i_dot + 2.0 * phi_dot * (el.cis * cos_2p - el.cic * sin_2p)

    # GEO records: the node in the inertial frame of toe; the Earth's turn follows below.
    turn = np.where(el.geo, 0.0, el.rotation)
    node_rate = el.omega_dot - turn
    node = el.omega0 + node_rate * t - el.rotation * el.toe_sow_s
    cos_u, sin_u, cos_i, sin_i = np.cos(u), np.sin(u), np.cos(i), np.sin(i)
    cos_n, sin_n = np.cos(node), np.sin(node)
    x, y = r * cos_u, r * sin_u
    x_dot = r_dot * cos_u - y * u_dot
    y_dot = r_dot * sin_u + x * u_dot
    position = np.stack([x * cos_n - y * cos_i * sin_n, x * sin_n + y * cos_i * cos_n, y * sin_i], axis=-1)
    velocity = np.stack(
        [
            x_dot * cos_n - y_dot * cos_i * sin_n + y * sin_i * sin_n * i_rate - position[..., 1] * node_rate,
            x_dot * sin_n + y_dot * cos_i * cos_n - y * sin_i * cos_n * i_rate + position[..., 0] * node_rate,
            y_dot * sin_i + y * cos_i * i_rate,
        ],
        axis=-1,
    )
    if el.geo.any():
        position[el.geo], velocity[el.geo] = _out_of_tilted_frame(
            position[el.geo], velocity[el.geo], el.rotation[el.geo], t[el.geo]
        )
    relativity = -2.0 * np.sqrt(el.gm) / SPEED_OF_LIGHT**2 * el.eccentricity * el.sqrt_a * sin_e
    return position, velocity, relativity


def _out_of_tilted_frame(
    position: Floats, velocity: Floats, rotation: Floats, since_toe_s: Floats
) -> tuple[Floats, Floats]:
    """BeiDou GEO: R_z(omega t) R_x(-5 deg) (BDS-SIS-ICD-B1I 3.0, 5.2.4.12)."""
    cos_x, sin_x = np.cos(_GEO_TILT), np.sin(_GEO_TILT)
    angle = rotation * since_toe_s
    cos_z, sin_z = np.cos(angle), np.sin(angle)

    def turned(v: Floats) -> Floats:
        y, z = cos_x * v[:, 1] + sin_x * v[:, 2], -sin_x * v[:, 1] + cos_x * v[:, 2]
        return np.stack([cos_z * v[:, 0] + sin_z * y, -sin_z * v[:, 0] + cos_z * y, z], axis=-1)

    place, speed = turned(position), turned(velocity)
    spin = np.stack([place[:, 1] * rotation, -place[:, 0] * rotation, np.zeros(len(place))], axis=-1)
    return place, speed + spin
