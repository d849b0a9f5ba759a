"""Stream of SBAS messages, one a second, whose corrections undo the simulated errors (RTCA DO-229D, A.4.4)."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from railfix.core.arrays import Bytes, Floats
from railfix.core.constants import FREQUENCY_L1
from railfix.core.files import write_whole
from railfix.core.timescale import seconds, timedelta, to_week
from railfix.ranges.sbas import SbasMessages
from railfix.ranges.sbas.grid import BANDS, COLUMNS, POINT_OF_BIT
from railfix.simulate.delays import ionosphere_m
from railfix.simulate.satellites import newest_record
from railfix.simulate.sbas import encode
from railfix.simulate.sbas.settings import SbasSettings

if TYPE_CHECKING:
    from railfix.simulate.signals import Simulation

#: Slots of one message of types 2 to 5; satellites of one of type 25; points of one of type 26.
_FAST, _LONG_TERM, _DELAYS = 13, 4, 15
#: Slots of type 24, which takes the place of the last fast message where no more are left.
_MIXED: Final = 6
#: Largest correction, orbit correction and delay that the fields hold [m].
_LARGEST_FAST_M, _LARGEST_ORBIT_M, _LARGEST_DELAY_M = 255.0, 31.875, 63.75
_DO_NOT_USE: Final = 15
#: Seconds from one fast correction of a satellite to the next.
_FAST_PERIOD_S: Final = 6
#: Streams of random numbers: fast corrections, orbits, delays, lost messages.
_CLOCK, _ORBIT, _DELAY, _LOST = 50, 51, 52, 53


class _Service:
    """Corrections of a simulated run at any second, and the messages that carry them."""

    def __init__(self, simulation: Simulation, settings: SbasSettings) -> None:
        self._simulation, self._settings = simulation, settings
        scenario = simulation.scenario
        self.satellites = sorted({str(n) for n in simulation.navigation.kepler.satellite if str(n).startswith("G")})
        # All of GPS, not only what the train sees; each satellite's errors are its own, so they are the same.
        self._errors, self._start = simulation.errors_of(self.satellites), scenario.start
        self._group_delay_m = self._errors.group_delay_m(self.satellites, ["1C"] * len(self.satellites))
        self._rng = {key: np.random.default_rng([scenario.seed, key]) for key in (_CLOCK, _ORBIT, _DELAY)}
        self._last_s = scenario.duration_s
        self.bands = self._grid_points()

    def _instant(self, second: float) -> Floats:
        """Time of the corrections sent at a second; before the start of the run its errors are those of the start."""
        return np.asarray(np.clip(np.array([second - self._settings.latency_s]), 0.0, self._last_s))

    def fast_m(self, second: float) -> Floats:
        """Fast corrections of `satellites` [m]: their clocks, and the group delay of their code."""
        clock = self._errors.clock_error_m(self._instant(second))[0]
        noise = self._settings.clock_sigma_m * self._rng[_CLOCK].standard_normal(len(self.satellites))
        return np.asarray(np.clip(clock - self._group_delay_m + noise, -_LARGEST_FAST_M, _LARGEST_FAST_M))

    def udrei(self, second: float) -> list[int]:
        """UDREI of `satellites`: as set, do not use during a fault."""
        settings = self._settings
        fault, _ = self._errors.fault_m(self._instant(second - settings.alert_s + settings.latency_s), self.satellites)
        return [_DO_NOT_USE if abs(f) > settings.alert_m else settings.udrei for f in fault[0].tolist()]

    def orbits(self, second: float) -> list[encode.LongTerm]:
        """Long-term corrections of `satellites`: positions, to the issue of data in force."""
        at = self._instant(second)
        error = self._errors.orbit_error_m(at)[0]
        error = error + self._settings.orbit_sigma_m * self._rng[_ORBIT].standard_normal(error.shape)
        error = np.clip(error, -_LARGEST_ORBIT_M, _LARGEST_ORBIT_M)
        records = self._simulation.navigation.kepler
        time = self._start + timedelta(at)
        issues = [int(records.iode[newest_record(records, name, time)[0]]) % 256 for name in self.satellites]
        return [
            (slot, issue, (float(x), float(y), float(z)), 0.0)
            for slot, (issue, (x, y, z)) in enumerate(zip(issues, error, strict=True), 1)
        ]

    def _grid_points(self) -> dict[int, list[tuple[int, float, float]]]:
        """Bit, latitude and longitude of the grid points near the line, by band."""
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
        """Vertical delays of grid points [m], model and error of the simulated ionosphere."""
        at = self._instant(second)
        latitude, longitude = (np.array([point[k] for point in points]) for k in (1, 2))
        time = self._start + timedelta(at)
        day_s = float(seconds(time - time.astype("datetime64[D]"))[0])
        zenith = np.full(len(points), 90.0)
        model = ionosphere_m(
            self._simulation.navigation.klobuchar["G"], np.full(len(points), day_s), latitude, longitude, zenith,
            np.zeros(len(points)), frequency_hz=FREQUENCY_L1,
        )  # fmt: skip
        places = latitude[:, None], longitude[:, None], zenith[:, None], np.zeros((len(points), 1))
        error = self._errors.ionosphere_m(np.repeat(at, len(points)), *places)[:, 0]
        total = self._simulation.scenario.sky.ionosphere_scale * model + error
        total = total + self._settings.delay_sigma_m * self._rng[_DELAY].standard_normal(len(points))
        return [float(delay) for delay in np.clip(total, 0.0, _LARGEST_DELAY_M)]

    def fast_messages(self) -> list[Callable[[int, int], Bytes]]:
        """Messages of types 2 to 5 and 24, each a function of the second and of the issue (IODF)."""
        count = len(self.satellites)

        def of_block(block: int) -> Callable[[int, int], Bytes]:
            first = _FAST * block
            part = slice(first, first + _FAST)

            def made(second: int, issue: int) -> Bytes:
                values, grades = self.fast_m(second)[part].tolist(), self.udrei(second)[part]
                if first > 0 and count - first <= _MIXED:
                    pair = self.orbits(second)[-2:]
                    return encode.mixed(second, values, grades, pair, block=block, iodf=issue)
                return encode.fast(second, values, grades, kind=2 + block, iodf=issue)

            return made

        return [of_block(block) for block in range(-(-count // _FAST))]

    def slow_messages(self) -> list[Callable[[int], Bytes]]:
        """All other messages in the order in which they are sent in turn, each a function of the second."""
        numbers = {int(name[1:]) for name in self.satellites}
        count = len(self.satellites)
        messages: list[Callable[[int], Bytes]] = [
            lambda second: encode.mask(second, numbers),
            lambda second: encode.factors(second, [0] * count),
            lambda second: encode.parameters(second, iltc_v0=120, iiono=300),
            lambda second: encode.integrity(second, self.udrei(second), iodf=(3, 3, 3, 3)),
        ]
        messages += [self._long_term(first) for first in range(0, count, _LONG_TERM)]
        for band, points in self.bands.items():
            messages.append(self._grid_mask(band))
            messages += [self._grid_delays(band, block) for block in range(-(-len(points) // _DELAYS))]
        return messages

    def _long_term(self, first: int) -> Callable[[int], Bytes]:
        return lambda second: encode.long_term(second, self.orbits(second)[first : first + _LONG_TERM])

    def _grid_mask(self, band: int) -> Callable[[int], Bytes]:
        bits = [point[0] for point in self.bands[band]]
        return lambda second: encode.grid_mask(second, band, bits, bands=len(self.bands))

    def _grid_delays(self, band: int, block: int) -> Callable[[int], Bytes]:
        points = self.bands[band][_DELAYS * block : _DELAYS * (block + 1)]
        grades = [self._settings.givei] * len(points)
        return lambda second: encode.grid_delay(second, band, block, self.delays_m(second, points), grades)


def sbas_messages(simulation: Simulation, settings: SbasSettings) -> SbasMessages:
    """Messages from `lead_s` before the run to its end, one a second.

    Every 6 s the fast corrections of all satellites (types 2 to 5, 24); in the seconds between, in turn, the masks,
    long-term corrections, grid, degradation and integrity. All corrections undo the errors that `Scenario.errors` puts
    into clocks, group delays, orbits and ionosphere, to the messages' resolution (0.125 m); only GPS is corrected.
    """
    service, scenario = _Service(simulation, settings), simulation.scenario
    fast, slow = service.fast_messages(), service.slow_messages()
    first = -int(np.ceil(settings.lead_s))
    sent, bits, turn = [], [], 0
    # The preamble goes by the second of the day, the frame of six seconds too.
    day = int(seconds(scenario.start - scenario.start.astype("datetime64[D]")))
    for second in range(first, int(np.ceil(scenario.duration_s))):
        place = (day + second) % _FAST_PERIOD_S
        if place < len(fast):
            message = fast[place](second, ((day + second) // _FAST_PERIOD_S) % 3)
        else:
            message = slow[turn % len(slow)](second)
            turn += 1
        sent.append(second)
        bits.append(message)
    kept = np.random.default_rng([scenario.seed, _LOST]).uniform(size=len(sent)) >= settings.lost_chance
    table = np.array(bits, dtype=np.uint8).reshape(-1, 32)[kept]
    # A message has been received completely a second after its first bit.
    time = scenario.start + timedelta(np.array(sent, dtype=np.float64)[kept] + 1.0)
    count = len(table)
    return SbasMessages(
        time=time.astype("datetime64[ns]"),
        prn=np.full(count, settings.prn),
        type=(table[:, 1] >> 2).astype(np.int64),
        bits=table,
        parity_bits=np.full(count, 24),
        source=np.zeros(count, dtype=np.int64),
        line=np.arange(1, count + 1),
        sources=("simulated",),
    )


def write_sbas(messages: SbasMessages, path: str | PathLike[str]) -> None:
    """Write messages as RTKLIB's .sbs, which `railfix run --sbas` reads; OutputError when it cannot be written."""
    lines = []
    for time, prn, kind, bits in zip(messages.time, messages.prn, messages.type, messages.bits, strict=True):
        week, tow = to_week(time)
        lines.append(f"{int(week)} {float(tow):.0f} {prn} {kind:2d} : {bits[:29].tobytes().hex().upper()}\n")
    write_whole(Path(path), "".join(lines), what="SBAS messages")
