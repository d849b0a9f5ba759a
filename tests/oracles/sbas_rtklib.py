"""SBAS corrections by pyrtklib5 (RTKLIB in C), fed message by message; development only."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pyrtklib_orbits import instant, rtk, satellite_number, week_and_second
from railfix.ranges.sbas import SbasMessages


class RtklibSbas:
    """RTKLIB's tables after the messages fed so far."""

    def __init__(self) -> None:
        self.nav = rtk.nav_t()

    def feed(self, log: SbasMessages, row: int) -> int:
        """Hand over one message; type 9 is left out, as it needs tables of GEO satellites that are not made here."""
        if log.type[row] == 9:
            return 9
        message = rtk.sbsmsg_t()
        week, tow = week_and_second(log.time[row])
        message.week, message.tow, message.prn = week, round(tow), int(log.prn[row])
        for i in range(29):
            byte = int(log.bits[row, i])
            message.msg[i] = byte & 0xC0 if i == 28 else byte
        return int(rtk.sbsupdatecorr(message, self.nav))

    def satellite(self, time: np.datetime64, name: str) -> tuple[np.ndarray, float] | None:
        """Shift of the position [m] and of the clock, fast correction included [s]; None without a correction."""
        place, clock, variance = rtk.Arr1Ddouble(6), rtk.Arr1Ddouble(2), rtk.Arr1Ddouble(1)
        for i in range(6):
            place[i] = 0.0
        clock[0] = clock[1] = variance[0] = 0.0
        if not rtk.sbssatcorr(instant(time), satellite_number(name), self.nav, place, clock, variance):
            return None
        return np.array([place[i] for i in range(3)]), float(clock[0])

    def issue(self, name: str) -> int:
        """Issue of data of the long-term correction in force; -1 without one."""
        number = satellite_number(name)
        for k in range(self.nav.sbssat.nsat):
            if self.nav.sbssat.sat[k].sat == number and self.nav.sbssat.sat[k].lcorr.t0.time:
                return int(self.nav.sbssat.sat[k].lcorr.iode)
        return -1

    def ionosphere(
        self, time: np.datetime64, latitude: float, longitude: float, elevation: float, azimuth: float
    ) -> float | None:
        """Slant delay [m]; angles in degrees; None without a correction."""
        place, sight = rtk.Arr1Ddouble(3), rtk.Arr1Ddouble(2)
        place[0], place[1], place[2] = np.radians(latitude), np.radians(longitude), 0.0
        sight[0], sight[1] = np.radians(azimuth), np.radians(elevation)
        delay, variance = rtk.Arr1Ddouble(1), rtk.Arr1Ddouble(1)
        found = rtk.sbsioncorr(instant(time), self.nav, place, sight, delay, variance)
        return float(delay[0]) if found else None


def troposphere(time: np.datetime64, latitude: float, longitude: float, height: float, elevation: float) -> float:
    """Slant delay of RTKLIB's model of DO-229 [m]."""
    place, sight, variance = rtk.Arr1Ddouble(3), rtk.Arr1Ddouble(2), rtk.Arr1Ddouble(1)
    place[0], place[1], place[2] = np.radians(latitude), np.radians(longitude), height
    sight[0], sight[1] = 0.0, np.radians(elevation)
    return float(rtk.sbstropcorr(instant(time), place, sight, variance))


def replay(log: SbasMessages, times: np.ndarray) -> Iterator[tuple[int, RtklibSbas]]:
    """RTKLIB at each instant, with what had been received by then."""
    program, row = RtklibSbas(), 0
    for number, time in enumerate(times):
        while row < len(log) and log.time[row] <= time:
            program.feed(log, row)
            row += 1
        yield number, program


__all__ = ["RtklibSbas", "replay", "troposphere"]
