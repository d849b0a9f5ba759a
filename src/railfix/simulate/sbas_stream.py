"""Simulated SBAS messages, one per second, and the file with these messages; contents of L5 messages."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from railfix.core.arrays import Bytes, Floats
from railfix.core.constants import CARRIER_FREQUENCY, SPEED_OF_LIGHT
from railfix.core.files import FilePath
from railfix.core.staged_files import write_whole
from railfix.core.timescale import SECONDS_PER_DAY, seconds, timedelta, to_week
from railfix.gnss.orbits.prepared_records import group_delay_s
from railfix.ranges.sbas import SbasMessages
from railfix.ranges.sbas.dfmc import AUGMENTED, FIRST, SLOT_OF
from railfix.ranges.sbas.messages import PREAMBLES, message_type
from railfix.simulate.constellation import newest_record
from railfix.simulate.receiver import list_signals
from railfix.simulate.sbas_service import CLOCK, FAST_PERIOD_S, Field, Service, pack_message
from railfix.simulate.settings import SbasSettings

if TYPE_CHECKING:
    from railfix.simulate.signals import Simulation


def message(kind: int, second: int, *fields: Field) -> Bytes:
    """Return an L5 message of type `kind` with its parity, as bytes of shape (32,).

    The fields (value, length in bits) begin at bit 10. Raise ValueError if a value does not fit into its field.
    """
    return pack_message(f"{PREAMBLES['L5'][second % 6]:04b}{kind:06b}", kind, fields)


def mask(second: int, slots: Collection[int], iodm: int = 0) -> Bytes:
    """Return a type 31 message, the satellite mask, with the satellites of the given slots."""
    return message(31, second, *((int(slot in slots), 1) for slot in range(1, 215)), (iodm, 2))


def correction(
    second: int,
    slot: int,
    issue: int,
    moved: Sequence[float],
    rates: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
    *,
    time_of_day_s: float,
    covariance: tuple[int, Floats] = (5, np.eye(4)),
    dfrei: int = 3,
) -> Bytes:
    """Return a type 32 message with the correction of one satellite.

    `moved` has the corrections of position and clock [m], `rates` their rates [m/s]. `covariance` has the scale
    exponent and the upper triangular factor in units of 2^(exponent - 5).
    """
    exponent, factor = covariance
    values = [(round(v / 0.0625), 11) for v in moved[:3]] + [(round(moved[3] / 0.03125), 12)]
    values += [(round(v * 2**11), 8) for v in rates[:3]] + [(round(rates[3] * 2**12), 9)]
    upper = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    return message(
        32, second, (slot, 8), (issue, 10), *values, (round(time_of_day_s / 16.0), 13), (exponent, 3),
        *((round(float(factor[k, k])), 9) for k in range(4)), *((round(float(factor[i, j])), 10) for i, j in upper),
        (dfrei, 4), (15, 4),
    )  # fmt: skip


def changes(second: int, change: Sequence[int], dfrei: Sequence[int] = (), iodm: int = 0) -> Bytes:
    """Return a type 34 message with changes of the DFREI of the satellites in the mask.

    `change` has one value per satellite: 0 for no change, 1 for a new DFREI (taken from `dfrei` in order), 2 for an
    increase of the DFREI by one, 3 for "do not use".
    """
    every = [*change, *([0] * (AUGMENTED - len(change)))]
    grades = [*dfrei, *([0] * (7 - len(dfrei)))]
    return message(34, second, *((c, 2) for c in every), *((g, 4) for g in grades), (0, 2), (iodm, 2))


def integrity(second: int, dfrei: Sequence[int], *, kind: int = 35, iodm: int = 0) -> Bytes:
    """Return a message of type 35 with the DFREI of the first 53 satellites in the mask, or of type 36 with the DFREI
    of the other satellites.
    """
    count = 53 if kind == 35 else 39
    fields = [(grade, 4) for grade in [*dfrei, *([15] * (count - len(dfrei)))]]
    return message(kind, second, *fields, (0, 2 if kind == 35 else 58), (iodm, 2))


def parameters(
    second: int,
    *,
    valid_s: float = 120.0,
    covariance: float = 0.0,
    degradation: tuple[float, float, float] = (30.0, 0.0, 0.0),
    scale: int = 0,
) -> Bytes:
    """Return a type 37 message, degradation parameters that are equal for all constellations.

    `valid_s` is the time for which corrections are valid, `covariance` the covariance parameter, `degradation` the
    interval [s], step [m] and rate [m/s] of the degradation, and `scale` the code of the DFREI scale.
    """
    interval, step, rate = degradation
    each = [(round(interval / 6.0) - 5, 5), (round(step / 0.01), 8), (round(rate / 0.0002), 8)]
    valid = (round(valid_s / 6.0) - 5, 6)
    return message(
        37, second, valid, valid, (0, 6), (round(covariance / 0.1), 7), *(each * 6), *([(scale, 4)] * 15), (0, 3)
    )


#: Covariance that is sent: exponent and factor. Along a line of sight, its sigma is 1.03 to 1.06 times the sigma of the
#: DFREI.
_COVARIANCE: Final = (3, np.diag([1.0, 1.0, 1.0, 4.0]))
_LARGEST_M: Final = 63.9  #: Larger clock corrections are clipped to this, the range of the field [m].
_GROWTH_MPS: Final = 0.002  #: Degradation rate that is sent for the corrections [m/s].


class SimulatedDfmc(Service):
    """Dual-frequency corrections of a simulated run: GPS L1 C/A and L5, Galileo E1 and E5a, BeiDou B1C and B2a."""

    @staticmethod
    def slot(name: str) -> int:
        """Return the slot of a satellite in the mask; 0 for a satellite without a slot."""
        return SLOT_OF.get(name, 0)

    def clocks_m(self, second: float) -> Floats:
        """Return the clock corrections for ionosphere-free codes [m].

        The corrections refer to GPS codes without group-delay correction, and to the clocks of Galileo F/NAV and BeiDou
        B-CNAV1.
        """
        names, at = self.satellites, self._instant(second)
        first, other = (
            [list_signals(name[0], self._simulation.scenario.receiver)[k] for name in names] for k in (0, 1)
        )
        ratio = np.array([(CARRIER_FREQUENCY[name[0]]["1"] / CARRIER_FREQUENCY[name[0]]["5"]) ** 2 for name in names])
        delay_m = [self._errors.group_delay_m(names, signals) for signals in (first, other)]
        time, kepler = self._start + timedelta(at), self._simulation.navigation.kepler
        for signals, added in zip((first, other), delay_m, strict=True):
            for k, (name, signal) in enumerate(zip(names, signals, strict=True)):
                if name[0] == "G":
                    added[k] += SPEED_OF_LIGHT * group_delay_s(kepler, signal)[newest_record(kepler, name, time)[0]]
        clock = self._errors.clock_error_m(at)[0] - (ratio * delay_m[0] - delay_m[1]) / (ratio - 1.0)
        clock = clock + self._settings.clock_sigma_m * self._rng[CLOCK].standard_normal(len(names))
        return np.asarray(np.clip(clock, -_LARGEST_M, _LARGEST_M))

    def fast_messages(self) -> list[Callable[[int, int], Bytes]]:
        """Return functions that make the messages of types 35 and 36 from the second and an unused issue."""

        def of_kind(kind: int, part: slice) -> Callable[[int, int], Bytes]:
            return lambda second, _: integrity(second, self.indicators(second)[part], kind=kind)

        later = [of_kind(36, slice(FIRST, AUGMENTED))] if len(self.satellites) > FIRST else []
        return [of_kind(35, slice(0, FIRST)), *later]

    def slow_messages(self) -> list[Callable[[int], Bytes]]:
        """Return functions that make a message from its time [s]: for type 31, for type 37, and for type 32 of each
        satellite.
        """
        slots = [self.slot(name) for name in self.satellites]
        messages: list[Callable[[int], Bytes]] = [
            lambda second: mask(second, slots),
            lambda second: parameters(second, valid_s=240.0, degradation=(30.0, 0.0, _GROWTH_MPS)),
        ]
        return messages + [partial(self._correction, k=k, slot=slot) for k, slot in enumerate(slots)]

    def _correction(self, second: int, k: int, slot: int) -> Bytes:
        day_s = float(seconds(self._start - self._start.astype("datetime64[D]")))
        _, issue, place, _ = self.orbits(second)[k]
        moved = (*place, float(self.clocks_m(second)[k]))
        return correction(
            second, slot, issue, moved, time_of_day_s=(day_s + second) % SECONDS_PER_DAY,
            covariance=_COVARIANCE, dfrei=self.indicators(second)[k],
        )  # fmt: skip


LOST: Final = 53  #: Seed of the random stream for lost messages.


def sbas_messages(simulation: Simulation, settings: SbasSettings) -> SbasMessages:
    """Return the SBAS messages of a run, one per second, from `lead_s` before the start to the end of the run.

    On L1, the fast corrections of all satellites (types 2 to 5, 24) are sent every 6 s. Between these messages, the
    masks, long-term corrections, grid delays, degradation and integrity are sent in turn. The corrections cancel the
    errors that `Scenario.errors` adds to clocks, group delays, orbits and ionosphere of GPS, within the resolution of
    the messages (0.125 m). On L5, integrity (types 35, 36) is sent every 6 s. Between these messages, mask, degradation
    and the corrections of GPS, Galileo and BeiDou are sent in turn. Messages are lost with the probability
    `lost_chance`.
    """
    service = (SimulatedDfmc if settings.band == "L5" else Service)(simulation, settings)
    scenario = simulation.scenario
    fast, slow = service.fast_messages(), service.slow_messages()
    first = -int(np.ceil(settings.lead_s))
    sent, bits, turn = [], [], 0
    # The six-second frame is aligned with the second of the day.
    day = int(seconds(scenario.start - scenario.start.astype("datetime64[D]")))
    for second in range(first, int(np.ceil(scenario.duration_s))):
        place = (day + second) % FAST_PERIOD_S
        if place < len(fast):
            message = fast[place](second, ((day + second) // FAST_PERIOD_S) % 3)
        else:
            message = slow[turn % len(slow)](second)
            turn += 1
        sent.append(second)
        bits.append(message)
    kept = np.random.default_rng([scenario.seed, LOST]).uniform(size=len(sent)) >= settings.lost_chance
    table = np.array(bits, dtype=np.uint8).reshape(-1, 32)[kept]
    # A message is complete one second after its first bit.
    time = scenario.start + timedelta(np.array(sent, dtype=np.float64)[kept] + 1.0)
    count = len(table)
    return SbasMessages(
        time=time.astype("datetime64[ns]"),
        prn=np.full(count, settings.prn),
        type=message_type(table, settings.band),
        bits=table,
        parity_bits=np.full(count, 24),
        source=np.zeros(count, dtype=np.int64),
        line=np.arange(1, count + 1),
        sources=("simulated",),
        band=settings.band,
    )


def write_sbas(messages: SbasMessages, path: FilePath) -> None:
    """Write messages in RTKLIB's .sbs format, which `railfix run --sbas` reads.

    Raise OutputError if the file cannot be written.
    """
    lines, digits = [], 58 if messages.band == "L1" else 63  # RTKLIB's format for L1 has no parity
    for time, prn, kind, bits in zip(messages.time, messages.prn, messages.type, messages.bits, strict=True):
        week, tow = to_week(time)
        lines.append(f"{int(week)} {float(tow):.0f} {prn} {kind:2d} : {bits.tobytes().hex().upper()[:digits]}\n")
    write_whole(Path(path), "".join(lines), what="SBAS messages")
