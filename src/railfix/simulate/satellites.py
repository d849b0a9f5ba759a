"""Positions and clocks of Keplerian records, computed apart from `railfix.gnss.orbits`.

The user algorithm of IS-GPS-200 (table 20-IV), Galileo OS SIS ICD (5.1.1) and BDS-SIS-ICD-B1I
(5.2.4.12), written anew for the simulation, so that an error in either shows. `links` works it out at
every instant; `SatelliteTable` at nodes once, and interpolates all satellites together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.timescale import seconds
from railfix.gnss.navigation import KeplerRecords

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
#: Geostationary satellites of BeiDou, whose frame is tilted by 5 degrees (BDS-SIS-ICD-B1I, 5.2.4.12).
_GEO: Final = frozenset(f"C{n:02d}" for n in (1, 2, 3, 4, 5, *range(59, 64)))
_GEO_TILT: Final = np.radians(-5.0)
#: Longest piece of `SatelliteTable` [s], nodes of a piece, and the flight time it is worked out for [s].
_PIECE_S: Final = 60.0
_NODES: Final = 7
_FLIGHT_S: Final = 0.08


@dataclass(frozen=True, kw_only=True)
class Links:
    """Signals received at T instants: of one satellite, shapes (T,), or of S satellites, shapes (T, S).

    Attributes
    ----------
    range_m : ndarray, shape (T,) or (T, S) [m]
        Geometric distance in the frame of reception, the Earth's rotation included.
    satellite_ecef_m : ndarray, shape (T, 3) or (T, S, 3) [m]
        At transmission, turned into the frame of reception.
    clock_s : ndarray, shape (T,) or (T, S) [s]
        Satellite clock with relativity, without group delay.
    """

    range_m: Floats
    satellite_ecef_m: Floats
    clock_s: Floats


def record_state(
    records: KeplerRecords, row: Indices, since_toe_s: Floats, since_toc_s: Floats
) -> tuple[Floats, Floats]:
    """Position in the Earth-fixed frame of the instant, shape (T, 3) [m], and clock, shape (T,) [s].

    Parameters
    ----------
    records : KeplerRecords
    row : ndarray of int, shape (T,)
        Record of each instant, all of one satellite.
    since_toe_s, since_toc_s : ndarray, shape (T,) [s]
    """
    name = str(records.satellite[row[0]])
    mu, rotation = EARTH[name[0]]
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
    turning = 0.0 if name in _GEO else rotation
    node = r["omega0"] + (r["omega_dot"] - turning) * t - rotation * r["toe_sow_s"]
    x, y = radius * np.cos(u), radius * np.sin(u)
    cos_tilt, cos_node, sin_node = np.cos(tilt), np.cos(node), np.sin(node)
    place = np.stack(
        [x * cos_node - y * cos_tilt * sin_node, x * sin_node + y * cos_tilt * cos_node, y * np.sin(tilt)], axis=-1
    )
    if name in _GEO:
        place = _from_geo_frame(place, rotation * t)
    dt = since_toc_s
    relativity = -2.0 * np.sqrt(mu * a) / SPEED_OF_LIGHT**2 * e * np.sin(ecc)
    return place, r["af0_s"] + r["af1"] * dt + r["af2"] * dt**2 + relativity


def _from_geo_frame(place: Floats, angle: Floats) -> Floats:
    """Tilted about x by 5 degrees, then turned with the Earth about z."""
    y = np.cos(_GEO_TILT) * place[:, 1] + np.sin(_GEO_TILT) * place[:, 2]
    z = np.cos(_GEO_TILT) * place[:, 2] - np.sin(_GEO_TILT) * place[:, 1]
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * place[:, 0] + sin * y, cos * y - sin * place[:, 0], z], axis=-1)


def newest_record(records: KeplerRecords, satellite: str, time: Datetimes) -> Indices:
    """Row of the satellite's newest record transmitted by each time (its first where there is none)."""
    rows = np.flatnonzero(records.satellite == satellite)
    rows = rows[np.argsort(records.transmitted[rows], kind="stable")]
    return np.asarray(rows[np.maximum(np.searchsorted(records.transmitted[rows], time, side="right") - 1, 0)])


def links(records: KeplerRecords, satellite: str, tag: Datetimes, late_s: Floats, receiver_ecef_m: Floats) -> Links:
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


class SatelliteTable:
    """Satellites over a span of time: worked out at nodes once, interpolated by polynomials of degree 6.

    Of the distance of `links` it differs by less than 1e-6 m. The pieces are laid once for the whole
    span, so any cutting of the instants gives the same numbers.

    Parameters
    ----------
    records : KeplerRecords
    satellites : sequence of str, length S
    first, last : datetime64
        Tags that will be asked for; others are refused.

    Attributes
    ----------
    satellites : tuple of str
    """

    def __init__(
        self, records: KeplerRecords, satellites: Sequence[str], first: np.datetime64, last: np.datetime64
    ) -> None:
        self.satellites = tuple(satellites)
        self._start = first.astype("datetime64[ns]")
        span = float(seconds(last.astype("datetime64[ns]") - self._start))
        sent = records.transmitted[np.isin(records.satellite, self.satellites)]
        changes = seconds(sent[~np.isnat(sent)] - self._start)
        grid = np.arange(0.0, span, _PIECE_S)
        # A piece ends where any satellite changes its record.
        self._knots = np.unique(np.concatenate([[0.0], grid, changes[(changes > 0.0) & (changes <= span)]]))
        self._end = span
        ends = np.append(self._knots[1:], max(span, self._knots[-1]) + 1e-9)
        self._middle = (self._knots + ends) / 2.0
        self._half = _PIECE_S / 2.0 + 1.0
        tag = self._start + np.round(self._knots * 1e9).astype("timedelta64[ns]")
        nodes = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
        at = self._middle[:, None] + self._half * nodes
        values = np.empty((len(tag), _NODES, len(self.satellites), 4))
        for k, name in enumerate(self.satellites):
            row = np.repeat(newest_record(records, name, tag), _NODES)
            since_toe = at.ravel() + seconds(self._start - records.toe[row])
            since_toc = at.ravel() + seconds(self._start - records.toc[row])
            place, clock = record_state(records, row, since_toe, since_toc)
            values[:, :, k, :3] = place.reshape(len(tag), _NODES, 3)
            values[:, :, k, 3] = clock.reshape(len(tag), _NODES)
        to_powers = np.linalg.inv(np.vander(nodes, increasing=True))
        # Power k of each piece, shape (_NODES, pieces, S, 4).
        self._powers = np.einsum("kn,pnsc->kpsc", to_powers, values)

    def links(self, tag: Datetimes, late_s: Floats, receiver_ecef_m: Floats) -> Links:
        """Signals of all satellites that arrive at a receiver, as `links`.

        Parameters
        ----------
        tag : ndarray of datetime64[ns], shape (T,)
        late_s : ndarray, shape (T,) [s]
            The signal arrives so much before the tag says: the receiver clock's bias.
        receiver_ecef_m : ndarray, shape (T, 3) [m]

        Returns
        -------
        Links
            Shapes (T, S).

        Raises
        ------
        ValueError
            A tag is outside of the table's span.
        """
        when = seconds(tag - self._start)
        if when.size and (when.min() < 0.0 or when.max() > self._end):
            raise ValueError("tag is outside of the span that the satellite table was made for")
        piece = np.searchsorted(self._knots, when, side="right") - 1
        u = ((when - self._middle[piece] - late_s - _FLIGHT_S) / self._half)[:, None, None]
        # Horner's rule for value, slope and half the bend.
        value = self._powers[-1][piece]
        slope, bend = np.zeros_like(value), np.zeros_like(value)
        for k in range(_NODES - 2, -1, -1):
            bend = bend * u + slope
            slope = slope * u + value
            value = value * u + self._powers[k][piece]
        slope /= self._half
        bend /= self._half**2
        flight = np.full(value.shape[:2], _FLIGHT_S)
        x, y, z = receiver_ecef_m[:, 0, None], receiver_ecef_m[:, 1, None], receiver_ecef_m[:, 2, None]
        for _ in range(3):
            dt = (_FLIGHT_S - flight)[..., None]
            place = value + dt * (slope + dt * bend)
            angle = FRAME_ROTATION * flight
            cos, sin = np.cos(angle), np.sin(angle)
            sky = (cos * place[..., 0] + sin * place[..., 1], cos * place[..., 1] - sin * place[..., 0], place[..., 2])
            distance = np.sqrt((sky[0] - x) ** 2 + (sky[1] - y) ** 2 + (sky[2] - z) ** 2)
            flight = distance / SPEED_OF_LIGHT
        return Links(range_m=distance, satellite_ecef_m=np.stack(sky, axis=-1), clock_s=place[..., 3])
