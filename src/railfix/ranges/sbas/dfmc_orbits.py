"""Orbits of SBAS satellites on L5: ephemerides (types 39 and 40) and almanacs (type 47).

Layouts and scales are those that cssrlib (sbas.py) and MAAST (L5_decodeMT39.m, 40, 47; ED-259A) share. Messages of
SouthPAN of three days (`test_sbas_orbits.py`) settle what they do not: the semi-major axis is counted from 6370 km, and
the node from the meridian of Greenwich at midnight of GPS time. Open: a step of the inclination rate is 7 pi / 6 or 7
pi times 2^-21 1e-6 rad/s; SouthPAN sends 0, and an orbit with another rate has no position here. BDSBAS has a layout of
its own and is left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Integers, Masks
from railfix.core.constants import EARTH_ROTATION_RATE
from railfix.core.geodesy import geodetic_from_ecef
from railfix.core.timescale import seconds
from railfix.gnss.orbits.ephemerides import GM, Orbits, kepler_state
from railfix.ranges.sbas.decode import BitField, Decoded, Layout, covariance_factor, read_fields, time_near
from railfix.ranges.sbas.messages import SbasMessages

_BDSBAS: Final = 5  #: Number of the service.
_ANGLE: Final = np.pi * 2.0**-33
_AXIS_M: Final = 6_370_000.0
_BEFORE_FIRST_PRN: Final = 119

#: Time, covariance and indicator, where types 32 and 40 have them.
COVARIANCE: Final[Layout] = {
    "time_of_day_s": BitField(106, 13, 16.0),
    "exponent": BitField(119, 3, 1.0),
    "diagonal": BitField(122, 9, 1.0, False, 4),
    "upper": BitField(158, 10, 1.0, True, 6),
    "dfrei": BitField(218, 4),
    "rate_share": BitField(222, 4),
}
_LAYOUTS: Final[Mapping[int, Layout]] = {
    39: {
        "number": BitField(10, 6),
        "issue": BitField(16, 2),
        "provider": BitField(18, 5),
        "cuc": BitField(23, 19, np.pi * 2.0**-19 * 1e-4, True),
        "cus": BitField(42, 19, np.pi * 2.0**-19 * 1e-4, True),
        "rate": BitField(61, 22, None, True),
        "omega": BitField(83, 34, _ANGLE, True),
        "node": BitField(117, 34, _ANGLE, True),
        "m0": BitField(151, 34, _ANGLE, True),
        "clock_m": BitField(185, 25, 0.02, True),
        "drift_mps": BitField(210, 16, 4e-5, True),
    },
    40: {
        "issue": BitField(10, 2),
        "i0": BitField(12, 33, _ANGLE),
        "eccentricity": BitField(45, 30, 2.0**-30),
        "a": BitField(75, 31, 0.02, least=_AXIS_M),
        **COVARIANCE,
    },
    47: {
        "number": BitField(0, 6),
        "provider": BitField(6, 5),
        "a": BitField(12, 16, 650.0, least=_AXIS_M),
        "eccentricity": BitField(28, 8, 2.0**-8),
        "i0": BitField(36, 13, np.pi * 2.0**-13),
        "omega": BitField(49, 14, np.pi * 2.0**-13, True),
        "node": BitField(63, 14, np.pi * 2.0**-13, True),
        "node_rate": BitField(77, 8, 1e-9, True),
        "m0": BitField(85, 15, np.pi * 2.0**-14, True),
        "time_of_day_s": BitField(100, 6, 1800.0),
    },
}
_ALMANACS_AT: Final = (10, 116)  #: First bits of the two satellites of type 47.


@dataclass(frozen=True, kw_only=True)
class SbasOrbits:
    """Orbits of SBAS satellites, n rows."""

    row: Integers  #: Of the last message of each, shape (n,).
    prn: Integers  #: Of the satellite, as the message has it; shape (n,).
    provider: Integers  #: Number of the service, 8 for SouthPAN; shape (n,).
    reference: Datetimes  #: Shape (n,).
    orbits: Orbits
    usable: Masks  #: Whether the inclination rate is 0, shape (n,).
    clock_m: Floats  #: Clock at `reference`, NaN in almanacs; shape (n,).
    drift_mps: Floats  #: Shape (n,).
    dfrei: Integers  #: Indicator of the satellite's own ranges, 15 for do not use, -1 in almanacs; shape (n,).
    factor: Floats  #: Of the covariance, as in `DfmcCorrections`; shape (n, 4, 4).

    def position_ecef_m(self, time: Datetimes) -> Floats:
        """Compute the position of each satellite at its own time, shape (n, 3) [m]; NaN where not `usable`."""
        position = np.stack(kepler_state(self.orbits, seconds(time - self.reference))[0], axis=1)
        return np.where(self.usable[:, None], position, np.nan)

    def notes(self) -> tuple[str, ...]:
        """Return a sentence on the last orbit with a position, none without one."""
        last = zip(self.prn[self.usable][-1:], self.position_ecef_m(self.reference)[self.usable][-1:], strict=True)
        return tuple(
            f"PRN {prn} is, by its own messages, at {float(geodetic_from_ecef(place)[1]):.1f} degrees east, "
            f"{np.linalg.norm(place) / 1e3:,.0f} km from the centre of the Earth; its ranges are not used"
            for prn, place in last
        )


def ephemerides(messages: SbasMessages, valid_s: float) -> SbasOrbits:
    """Return the ephemerides that messages of one sender make: types 39 and 40 of one issue within `valid_s`."""
    rows = {kind: np.flatnonzero(messages.type == kind) for kind in (39, 40)}
    sent = {kind: read_fields(messages.bits[at], _LAYOUTS[kind]) for kind, at in rows.items()}
    newest: dict[tuple[int, int], int] = {}
    pairs = []
    for row, kind, k in sorted((int(row), kind, k) for kind, at in rows.items() for k, row in enumerate(at)):
        issue = int(sent[kind]["issue"][k])
        newest[kind, issue] = k
        other = newest.get((79 - kind, issue))
        if other is not None and seconds(messages.time[row] - messages.time[rows[79 - kind][other]]) <= valid_s:
            pairs.append((row, *((k, other) if kind == 39 else (other, k))))
    last, first, second = np.array(pairs, dtype=np.int64).reshape(-1, 3).T
    part = {name: values[first] for name, values in sent[39].items()}
    part |= {name: values[second] for name, values in sent[40].items()}
    return _orbits(messages, last, part)


def almanacs(messages: SbasMessages) -> SbasOrbits:
    """Return the almanacs in messages (type 47)."""
    row = np.flatnonzero(messages.type == 47)
    halves = [read_fields(messages.bits[row], _LAYOUTS[47], first) for first in _ALMANACS_AT]
    part = {name: np.concatenate([half[name] for half in halves]) for name in _LAYOUTS[47]}
    return _orbits(messages, np.concatenate([row, row]), part)


def _orbits(messages: SbasMessages, row: Integers, sent: Decoded) -> SbasOrbits:
    """Return decoded orbits in the order of their messages, without empty ones and those of BDSBAS."""
    order = np.argsort(row, kind="stable")
    order = order[(sent["number"][order] > 0) & (sent["provider"][order] != _BDSBAS)]
    row, sent = row[order], {name: values[order] for name, values in sent.items()}
    none, axis = np.zeros(len(row)), sent["a"]
    motion, root = np.sqrt(GM["G"] / axis**3), np.sqrt(1.0 - sent["eccentricity"] ** 2)
    orbits = Orbits(
        a=axis, motion=motion, eccentricity=sent["eccentricity"], root=root, m0=sent["m0"],
        cos_omega=np.cos(sent["omega"]), sin_omega=np.sin(sent["omega"]),
        cos_i0=np.cos(sent["i0"]), sin_i0=np.sin(sent["i0"]), i_dot=none,
        node=sent["node"] - EARTH_ROTATION_RATE * sent["time_of_day_s"],
        node_rate=sent.get("node_rate", none) - EARTH_ROTATION_RATE, tilted_rate=none,
        cuc=sent.get("cuc", none), cus=sent.get("cus", none), crc=none, crs=none, cic=none, cis=none,
        relativity=none, a_dot=none, delta_n_dot=none,
    )  # fmt: skip
    return SbasOrbits(
        row=row,
        prn=sent["number"] + _BEFORE_FIRST_PRN,
        provider=sent["provider"],
        reference=time_near(sent["time_of_day_s"], messages.time[row]),
        orbits=orbits,
        usable=sent.get("rate", none) == 0,
        clock_m=sent.get("clock_m", none + np.nan),
        drift_mps=sent.get("drift_mps", none + np.nan),
        dfrei=sent.get("dfrei", np.full(len(row), -1)),
        factor=covariance_factor(sent) if "dfrei" in sent else np.zeros((len(row), 4, 4)),
    )
