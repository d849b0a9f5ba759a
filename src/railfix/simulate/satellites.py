"""Positions and clocks of Keplerian records, computed apart from `railfix.orbits`.

The user algorithm of IS-GPS-200 (table 20-IV), Galileo OS SIS ICD (5.1.1) and BDS-SIS-ICD-B1I
(5.2.4.12, MEO and IGSO), written anew for the simulation, so that an error in either shows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from railfix.constants import SPEED_OF_LIGHT
from railfix.navigation import KeplerRecords
from railfix.timescale import seconds

Floats = NDArray[np.float64]
Times = NDArray[np.datetime64]
Rows = NDArray[np.intp]

_PARAMETERS: Final = (
    "af0_s", "af1", "af2", "sqrt_a", "eccentricity", "m0", "delta_n", "omega0", "i0", "omega", "omega_dot", "i_dot",
    "cuc", "cus", "crc", "crs", "cic", "cis", "toe_sow_s",
)  # fmt: skip

#: Gravitational constant [m^3/s^2] and Earth rotation [rad/s] by constellation letter.
EARTH: Final[dict[str, tuple[float, float]]] = {
    "G": (3.986_005e14, 7.292_115_146_7e-5),
    "J": (3.986_005e14, 7.292_115_146_7e-5),
    "E": (3.986_004_418e14, 7.292_115_146_7e-5),
    "C": (3.986_004_418e14, 7.292_115_0e-5),
}
#: Rotation of the frame during the signal's flight [rad/s] (WGS 84).
FRAME_ROTATION: Final = 7.292_115_146_7e-5


@dataclass(frozen=True, kw_only=True)
class Links:
    """Signals of one satellite received at T instants.

    Attributes
    ----------
    range_m : ndarray, shape (T,) [m]
        Geometric distance in the frame of reception, the Earth's rotation included.
    satellite_ecef_m : ndarray, shape (T, 3) [m]
        At transmission, turned into the frame of reception.
    clock_s : ndarray, shape (T,) [s]
        Satellite clock with relativity, without group delay.
    """

    range_m: Floats
    satellite_ecef_m: Floats
    clock_s: Floats


def record_state(records: KeplerRecords, row: Rows, since_toe_s: Floats, since_toc_s: Floats) -> tuple[Floats, Floats]:
    """Position in the Earth-fixed frame of the instant, shape (T, 3) [m], and clock, shape (T,) [s].

    Parameters
    ----------
    records : KeplerRecords
    row : ndarray of int, shape (T,)
        Record of each instant, all of one satellite.
    since_toe_s, since_toc_s : ndarray, shape (T,) [s]
    """
    mu, rotation = EARTH[str(records.satellite[row[0]])[0]]
    r = {name: getattr(records, name)[row] for name in _PARAMETERS}
    t, e, a = since_toe_s, r["eccentricity"], r["sqrt_a"] ** 2
    mean = r["m0"] + (np.sqrt(mu / a**3) + r["delta_n"]) * t
    ecc = mean + e * np.sin(mean)
    for _ in range(4):
        ecc = ecc - (ecc - e * np.sin(ecc) - mean) / (1.0 - e * np.cos(ecc))
    phi = 2.0 * np.arctan(np.sqrt((1.0 + e) / (1.0 - e)) * np.tan(ecc / 2.0)) + r["omega"]
    sin2, cos2 = np.sin(2.0 * phi), np.cos(2.0 * phi)
    u = phi + r["cus"] * sin2 + r["cuc"] * cos2
    radius = a * (1.0 - e * np.cos(ecc)) + r["crs"] * sin2 + r["crc"] * cos2
    tilt = r["i0"] + r["i_dot"] * t + r["cis"] * sin2 + r["cic"] * cos2
    node = r["omega0"] + (r["omega_dot"] - rotation) * t - rotation * r["toe_sow_s"]
    x, y = radius * np.cos(u), radius * np.sin(u)
    cos_tilt, cos_node, sin_node = np.cos(tilt), np.cos(node), np.sin(node)
    place = np.stack(
        [x * cos_node - y * cos_tilt * sin_node, x * sin_node + y * cos_tilt * cos_node, y * np.sin(tilt)], axis=-1
    )
    dt = since_toc_s
    relativity = -2.0 * np.sqrt(mu * a) / SPEED_OF_LIGHT**2 * e * np.sin(ecc)
    return place, r["af0_s"] + r["af1"] * dt + r["af2"] * dt**2 + relativity


def newest_record(records: KeplerRecords, satellite: str, time: Times) -> Rows:
    """Row of the satellite's newest record transmitted by each time (its first where there is none)."""
    rows = np.flatnonzero(records.satellite == satellite)
    rows = rows[np.argsort(records.transmitted[rows], kind="stable")]
    return np.asarray(rows[np.maximum(np.searchsorted(records.transmitted[rows], time, side="right") - 1, 0)])


def links(records: KeplerRecords, satellite: str, tag: Times, late_s: Floats, receiver_ecef_m: Floats) -> Links:
    """Signals of a satellite that arrive at a receiver.

    The equation of the transmit time is solved by iteration: the flight lasts as long as the distance
    from where the satellite was, in the frame of reception.

    Parameters
    ----------
    records : KeplerRecords
    satellite : str
    tag : ndarray of datetime64[ns], shape (T,)
    late_s : ndarray, shape (T,) [s]
        The signal arrives so much before the tag says: the receiver clock's bias.
    receiver_ecef_m : ndarray, shape (T, 3) [m]

    Returns
    -------
    Links
    """
    row = newest_record(records, satellite, tag)
    since_toe = seconds(tag - records.toe[row]) - late_s
    since_toc = seconds(tag - records.toc[row]) - late_s
    flight = np.full(late_s.shape, 0.08)
    for _ in range(3):
        place, clock = record_state(records, row, since_toe - flight, since_toc - flight)
        angle = FRAME_ROTATION * flight
        cos, sin = np.cos(angle), np.sin(angle)
        turned = np.stack(
            [cos * place[:, 0] + sin * place[:, 1], cos * place[:, 1] - sin * place[:, 0], place[:, 2]], axis=-1
        )
        distance = np.linalg.norm(turned - receiver_ecef_m, axis=-1)
        flight = distance / SPEED_OF_LIGHT
    return Links(range_m=distance, satellite_ecef_m=turned, clock_s=clock)
