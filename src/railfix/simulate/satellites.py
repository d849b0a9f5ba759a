"""Signals of satellites that arrive at a receiver: orbits of `railfix.gnss.orbits`, light time, Earth rotation.

`links` computes every instant; `SatelliteTable` computes nodes once, and interpolates all satellites together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices
from railfix.core.constants import EARTH_ROTATION_RATE, SPEED_OF_LIGHT
from railfix.core.timescale import seconds, timedelta
from railfix.gnss.navigation import KeplerRecords
from railfix.gnss.orbits.kepler import Orbits, kepler_state

#: Longest piece of `SatelliteTable` [s], nodes of a piece, and the flight time it is worked out for [s].
_PIECE_S: Final = 60.0
_NODES: Final = 7
_FLIGHT_S: Final = 0.08


@dataclass(frozen=True, kw_only=True)
class Links:
    """Signals received at T instants: of one satellite, shapes (T,), or of S satellites, shapes (T, S)."""

    #: Geometric distance in the frame of reception, the Earth's rotation included; shape (T,) or (T, S).
    range_m: Floats
    satellite_ecef_m: Floats  #: At transmission, turned into the frame of reception; shape (T, 3) or (T, S, 3).
    clock_s: Floats  #: Satellite clock with relativity, without group delay; shape (T,) or (T, S).


def record_state(
    records: KeplerRecords, row: Indices, since_toe_s: Floats, since_toc_s: Floats
) -> tuple[Floats, Floats]:
    """Position in the Earth-fixed frame of the instant, shape (T, 3) [m], and clock with relativity, shape (T,) [s].

    From one row of the records for each instant, at so many seconds after its times of ephemeris and clock.
    """
    position, _, relativity = kepler_state(Orbits.of_table(Orbits.from_records(records).table[row]), since_toe_s)
    dt = since_toc_s
    clock = records.af0_s[row] + records.af1[row] * dt + records.af2[row] * dt**2 + relativity
    return np.stack(position, axis=-1), clock


def newest_record(records: KeplerRecords, satellite: str, time: Datetimes) -> Indices:
    """Row of the satellite's newest record transmitted by each time (its first where there is none)."""
    rows = np.flatnonzero(records.satellite == satellite)
    rows = rows[np.argsort(records.transmitted[rows], kind="stable")]
    return np.asarray(rows[np.maximum(np.searchsorted(records.transmitted[rows], time, side="right") - 1, 0)])


def links(records: KeplerRecords, satellite: str, tag: Datetimes, late_s: Floats, receiver_ecef_m: Floats) -> Links:
    """Signals of a satellite that arrive at a receiver at T tags, `late_s` (the receiver clock's bias) before each.

    The light-time equation is solved by iteration, in the Earth-fixed frame of reception.
    """
    row = newest_record(records, satellite, tag)
    since_toe = seconds(tag - records.toe[row]) - late_s
    since_toc = seconds(tag - records.toc[row]) - late_s
    flight = np.full(late_s.shape, 0.08)
    for _ in range(3):
        place, clock = record_state(records, row, since_toe - flight, since_toc - flight)
        angle = EARTH_ROTATION_RATE * flight
        cos, sin = np.cos(angle), np.sin(angle)
        turned = np.stack(
            [cos * place[:, 0] + sin * place[:, 1], cos * place[:, 1] - sin * place[:, 0], place[:, 2]], axis=-1
        )
        distance = np.linalg.norm(turned - receiver_ecef_m, axis=-1)
        flight = distance / SPEED_OF_LIGHT
    return Links(range_m=distance, satellite_ecef_m=turned, clock_s=clock)


class SatelliteTable:
    """Satellites over a span of time: computed at nodes once, interpolated by polynomials of degree 6.

    The distance differs from that of `links` by less than 1e-6 m. The pieces are fixed for the whole
    span, so results do not depend on how the instants are cut into chunks.
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
        tag = self._start + timedelta(self._knots)
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
        """Signals of all satellites that arrive at a receiver, as `links`, shapes (T, S).

        ValueError: when a tag is outside of the table's span.
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
            angle = EARTH_ROTATION_RATE * flight
            cos, sin = np.cos(angle), np.sin(angle)
            sky = (cos * place[..., 0] + sin * place[..., 1], cos * place[..., 1] - sin * place[..., 0], place[..., 2])
            distance = np.sqrt((sky[0] - x) ** 2 + (sky[1] - y) ** 2 + (sky[2] - z) ** 2)
            flight = distance / SPEED_OF_LIGHT
        return Links(range_m=distance, satellite_ecef_m=np.stack(sky, axis=-1), clock_s=place[..., 3])
