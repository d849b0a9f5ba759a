"""SBAS messages, one per second, whose corrections cancel the simulated errors (RTCA DO-229D, A.4.4)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from railfix.core.arrays import Bytes, Floats
from railfix.core.constants import FREQUENCY_L1
from railfix.core.timescale import timedelta
from railfix.ranges.atmosphere import klobuchar_delay_m
from railfix.ranges.sbas.ionosphere import BANDS, COLUMNS, POINT_OF_BIT
from railfix.ranges.sbas.messages import DATA_BITS, PREAMBLES, with_parity
from railfix.ranges.sbas.standard import DO_NOT_USE, NOT_MONITORED
from railfix.simulate.constellation import newest_record
from railfix.simulate.errors import fault_m
from railfix.simulate.settings import SbasSettings

if TYPE_CHECKING:
    from railfix.simulate.signals import Simulation

Field = tuple[int, int]
#: Long-term correction without velocity: mask slot, IODE, correction of the position [m], correction of the clock
#: [2^-31 s].
LongTerm = tuple[int, int, tuple[float, float, float], float]

#: Resolution of fast corrections and grid delays [m].
STEP_M: Final = 0.125
NO_DELAY: Final = 15  #: GIVEI of a grid point that is not monitored.
#: Fields of message type 10 in order, with the length of each field in bits.
DEGRADATION: Final = {
    "brrc": 10, "cltc_lsb": 10, "cltc_v1": 10, "iltc_v1": 9, "cltc_v0": 10, "iltc_v0": 9, "cgeo_lsb": 10,
    "cgeo_v": 10, "igeo": 9, "cer": 6, "ciono_step": 10, "iiono": 9, "ciono_ramp": 10, "rss_udre": 1,
    "rss_iono": 1, "ccovariance": 7,
}  # fmt: skip


def message(kind: int, second: int, *fields: Field) -> Bytes:
    """Return a message of type `kind` with its parity, as bytes of shape (32,).

    The fields (value, length in bits) begin at bit 14. Raise ValueError if a value does not fit into its field.
    """
    return pack_message(f"{PREAMBLES['L1'][second % 3]:08b}{kind:06b}", kind, fields)


def pack_message(text: str, kind: int, fields: Sequence[Field]) -> Bytes:
    """Return a message with parity, shape (32,), from the first bits as text and the fields (value, length in bits).

    Raise ValueError if a value does not fit into its field, or the message is too long.
    """
    for value, length in fields:
        if not -(1 << length) < 2 * value + 1 <= (1 << (length + 1)):
            raise ValueError(f"type {kind}: {value} does not fit into {length} bits")
        text += f"{value & ((1 << length) - 1):0{length}b}"
    if len(text) > DATA_BITS:
        raise ValueError(f"type {kind}: {len(text)} bits, expected at most {DATA_BITS}")
    bits = np.array([int(c) for c in text.ljust(256, "0")], dtype=np.uint8)
    return np.asarray(with_parity(np.packbits(bits)[None, :])[0])


def mask(second: int, numbers: Collection[int], iodp: int = 0) -> Bytes:
    """Return a type 1 message, the PRN mask, with the satellites of the given numbers (1 to 210)."""
    return message(1, second, *((int(i in numbers), 1) for i in range(1, 211)), (iodp, 2))


def fast(
    second: int, prc: Sequence[float], udrei: Sequence[int], *, kind: int = 2, iodf: int = 0, iodp: int = 0
) -> Bytes:
    """Return a message of fast corrections [m] with UDREI, of type 0 or 2 to 5; other slots: "not monitored"."""
    values = [round(v / STEP_M) for v in prc] + [0] * (13 - len(prc))
    grades = list(udrei) + [NOT_MONITORED] * (13 - len(udrei))
    return message(kind, second, (iodf, 2), (iodp, 2), *((v, 12) for v in values), *((g, 4) for g in grades))


def integrity(second: int, udrei: Sequence[int], iodf: Sequence[int] = (0, 0, 0, 0)) -> Bytes:
    """Return a type 6 message, integrity, with the UDREI of the first slots; other slots: "not monitored"."""
    grades = list(udrei) + [NOT_MONITORED] * (51 - len(udrei))
    return message(6, second, *((i, 2) for i in iodf), *((g, 4) for g in grades))


def factors(second: int, indicator: Sequence[int], *, latency: int = 0) -> Bytes:
    """Return a type 7 message with the fast-correction degradation indicators of the first slots; the remaining slots
    have 0.
    """
    values = list(indicator) + [0] * (51 - len(indicator))
    return message(7, second, (latency, 4), (0, 4), *((v, 4) for v in values))


def parameters(second: int, **values: int) -> Bytes:
    """Return a type 10 message, degradation parameters, with raw values by name (`DEGRADATION`); other parameters are
    0.
    """
    if unknown := values.keys() - DEGRADATION.keys():
        raise ValueError(f"type 10 has no field {min(unknown)}")
    return message(10, second, *((values.get(name, 0), length) for name, length in DEGRADATION.items()))


def half(satellites: Sequence[LongTerm], iodp: int) -> list[Field]:
    """Return the fields of half a type 25 message without velocity, for up to two satellites."""
    fields: list[Field] = [(0, 1)]
    for i in range(2):
        slot, iode, position, clock = satellites[i] if i < len(satellites) else (0, 0, (0.0, 0.0, 0.0), 0.0)
        fields += [(slot, 6), (iode, 8), *((round(v / STEP_M), 9) for v in position), (round(clock), 10)]
    return [*fields, (iodp, 2), (0, 1)]


def long_term(second: int, satellites: Sequence[LongTerm], iodp: int = 0) -> Bytes:
    """Return a type 25 message, long-term corrections with velocity code 0, for up to four satellites."""
    return message(25, second, *half(satellites[:2], iodp), *half(satellites[2:], iodp))


def mixed(
    second: int,
    prc: Sequence[float],
    udrei: Sequence[int],
    satellites: Sequence[LongTerm],
    *,
    block: int = 0,
    iodf: int = 0,
) -> Bytes:
    """Return a type 24 message, six fast corrections [m] with UDREI and half a type 25 message."""
    values = [round(v / STEP_M) for v in prc] + [0] * (6 - len(prc))
    grades = list(udrei) + [NOT_MONITORED] * (6 - len(udrei))
    head = [*((v, 12) for v in values), *((g, 4) for g in grades), (0, 2), (block, 2), (iodf, 2), (0, 4)]
    return message(24, second, *head, *half(satellites, 0))


def grid_mask(second: int, band: int, bits: Collection[int], iodi: int = 0, bands: int = 1) -> Bytes:
    """Return a type 18 message, the ionospheric grid mask, for one band; `bits` has the set bits, counted from 0."""
    return message(18, second, (bands, 4), (band, 4), (iodi, 2), *((int(i in bits), 1) for i in range(201)))


def grid_delay(
    second: int, band: int, block: int, delay: Sequence[float], givei: Sequence[int], iodi: int = 0
) -> Bytes:
    """Return a type 26 message, vertical grid delays [m] with GIVEI; other points of the block: "not monitored".

    A delay of 63.875 m means "do not use".
    """
    raw = [round(v / STEP_M) for v in delay] + [0] * (15 - len(delay))
    grades = list(givei) + [NO_DELAY] * (15 - len(givei))
    pairs = [field for v, g in zip(raw, grades, strict=True) for field in ((v, 9), (g, 4))]
    return message(26, second, (band, 4), (block, 4), *pairs, (iodi, 2))


#: Largest number of slots in message types 2 to 5, of satellites in type 25, and of grid points in type 26.
_FAST, _LONG_TERM, _DELAYS = 13, 4, 15
#: Number of slots in message type 24. If at most this many slots remain, the last fast corrections are sent in type 24.
_MIXED: Final = 6
#: Fast corrections, orbit corrections and grid delays of larger magnitude are clipped to these values [m].
_LARGEST_FAST_M, _LARGEST_ORBIT_M, _LARGEST_DELAY_M = 255.0, 31.875, 63.75
FAST_PERIOD_S: Final = 6  #: Interval between two fast corrections of a satellite [s].
CLOCK, _ORBIT, _DELAY = 50, 51, 52  #: Seeds of random streams: noise of fast, orbit and delay corrections.


class Service:
    """SBAS corrections of a simulated run at any second, and the messages with these corrections."""

    def __init__(self, simulation: Simulation, settings: SbasSettings) -> None:
        self._simulation, self._settings = simulation, settings
        scenario = simulation.scenario
        names = {str(name) for name in simulation.navigation.kepler.satellite}
        # The mask has all satellites, not only satellites in view of the train. For a satellite in view, the errors
        # computed here equal the errors of the train's signals, because the errors of a satellite do not depend on
        # other satellites.
        self.satellites = sorted((name for name in names if self.slot(name)), key=self.slot)
        self._errors, self._start = simulation.compute_errors(self.satellites), scenario.start
        self._group_delay_m = self._errors.group_delay_m(self.satellites, ["1C"] * len(self.satellites))
        self._rng = {key: np.random.default_rng([scenario.seed, key]) for key in (CLOCK, _ORBIT, _DELAY)}
        self._last_s = scenario.duration_s
        self.bands = self._grid_points()

    @staticmethod
    def slot(name: str) -> int:
        """Return the PRN mask number of a satellite; 0 for satellites that are not corrected (all except GPS)."""
        return int(name[1:]) if name[0] == "G" else 0

    def _instant(self, second: float) -> Floats:
        """Return the time to which corrections sent at a second refer [s], limited to the duration of the run."""
        return np.asarray(np.clip(np.array([second - self._settings.latency_s]), 0.0, self._last_s))

    def fast_m(self, second: float) -> Floats:
        """Return the fast corrections of `satellites` [m]: the clock error minus the group-delay error of L1 C/A, plus
        noise.
        """
        clock = self._errors.clock_error_m(self._instant(second))[0]
        noise = self._settings.clock_sigma_m * self._rng[CLOCK].standard_normal(len(self.satellites))
        return np.asarray(np.clip(clock - self._group_delay_m + noise, -_LARGEST_FAST_M, _LARGEST_FAST_M))

    def indicators(self, second: float) -> list[int]:
        """Return the UDREI (DFREI on L5) of `satellites`: the value of the settings, or "do not use" during a fault."""
        settings = self._settings
        usual = settings.udrei if settings.band == "L1" else settings.dfrei
        at = self._instant(second - settings.alert_s + settings.latency_s)
        fault, _ = fault_m(self._simulation.scenario.errors.faults, at, self.satellites)
        return [DO_NOT_USE if abs(f) > settings.alert_m else usual for f in fault[0].tolist()]

    def orbits(self, second: float) -> list[LongTerm]:
        """Return the long-term corrections of the positions of `satellites`, for the broadcast records in force."""
        at = self._instant(second)
        error = self._errors.orbit_error_m(at)[0]
        error = error + self._settings.orbit_sigma_m * self._rng[_ORBIT].standard_normal(error.shape)
        error = np.clip(error, -_LARGEST_ORBIT_M, _LARGEST_ORBIT_M)
        records = self._simulation.navigation.kepler
        time = self._start + timedelta(at)
        issues = [
            int(records.iode[newest_record(records, name, time)[0]]) % (1024 if name[0] == "E" else 256)
            for name in self.satellites
        ]
        return [
            (slot, issue, (float(x), float(y), float(z)), 0.0)
            for slot, (issue, (x, y, z)) in enumerate(zip(issues, error, strict=True), 1)
        ]

    def _grid_points(self) -> dict[int, list[tuple[int, float, float]]]:
        """Return the bit, latitude and longitude [deg] of the grid points near the line, by band."""
        latitude, longitude = self._simulation.origin_deg
        bands: dict[int, list[tuple[int, float, float]]] = {}
        for band in range(BANDS):
            for bit, point in enumerate(POINT_OF_BIT[band].tolist()):
                if point < 0:
                    continue
                row, column = divmod(point, COLUMNS)
                at = (5.0 * row - 90.0, 5.0 * column - 180.0)
                apart = (at[0] - latitude, (at[1] - longitude + 180.0) % 360.0 - 180.0)
                if max(abs(apart[0]), abs(apart[1])) <= self._settings.grid_radius_deg:
                    bands.setdefault(band, []).append((bit, *at))
        return bands

    def delays_m(self, second: float, points: list[tuple[int, float, float]]) -> list[float]:
        """Return the vertical delays on L1 at grid points [m]: the model delay plus the simulated model error."""
        at = self._instant(second)
        latitude, longitude = (np.array([point[k] for point in points]) for k in (1, 2))
        time = self._start + timedelta(at)
        zenith, north = np.full((len(points), 1), 90.0), np.zeros((len(points), 1))
        coefficients, l1 = self._simulation.navigation.klobuchar["G"], np.array(FREQUENCY_L1)
        model = klobuchar_delay_m(time, latitude, longitude, zenith, north, coefficients, l1)[:, 0]
        places = latitude[:, None], longitude[:, None], zenith, north
        error = self._errors.ionosphere_m(np.repeat(at, len(points)), *places)[:, 0]
        total = self._simulation.scenario.sky.ionosphere_scale * model + error
        total = total + self._settings.delay_sigma_m * self._rng[_DELAY].standard_normal(len(points))
        return [float(delay) for delay in np.clip(total, 0.0, _LARGEST_DELAY_M)]

    def fast_messages(self) -> list[Callable[[int, int], Bytes]]:
        """Return functions that make the messages of types 2 to 5 and 24 for a given second and issue (IODF)."""
        return [partial(self._fast, block=block) for block in range(-(-len(self.satellites) // _FAST))]

    def _fast(self, second: int, issue: int, block: int) -> Bytes:
        first = _FAST * block
        part = slice(first, first + _FAST)
        values, grades = self.fast_m(second)[part].tolist(), self.indicators(second)[part]
        if first > 0 and len(self.satellites) - first <= _MIXED:
            return mixed(second, values, grades, self.orbits(second)[-2:], block=block, iodf=issue)
        return fast(second, values, grades, kind=2 + block, iodf=issue)

    def slow_messages(self) -> list[Callable[[int], Bytes]]:
        """Return functions that make the other messages for a given second, in the order of sending."""
        numbers = {int(name[1:]) for name in self.satellites}
        count = len(self.satellites)
        messages: list[Callable[[int], Bytes]] = [
            lambda second: mask(second, numbers),
            lambda second: factors(second, [0] * count),
            lambda second: parameters(second, iltc_v0=120, iiono=300),
            lambda second: integrity(second, self.indicators(second), iodf=(3, 3, 3, 3)),
        ]
        messages += [partial(self._long_term, first=first) for first in range(0, count, _LONG_TERM)]
        for band, points in self.bands.items():
            bits = [point[0] for point in points]
            messages.append(partial(grid_mask, band=band, bits=bits, bands=len(self.bands)))
            messages += [
                partial(self._grid_delays, band=band, block=block) for block in range(-(-len(points) // _DELAYS))
            ]
        return messages

    def _long_term(self, second: int, first: int) -> Bytes:
        return long_term(second, self.orbits(second)[first : first + _LONG_TERM])

    def _grid_delays(self, second: int, band: int, block: int) -> Bytes:
        points = self.bands[band][_DELAYS * block : _DELAYS * (block + 1)]
        return grid_delay(second, band, block, self.delays_m(second, points), [self._settings.givei] * len(points))
