"""Streams of simulated SBAS messages, one a second, and their file."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from railfix.core.files import write_whole
from railfix.core.timescale import seconds, timedelta, to_week
from railfix.ranges.sbas import SbasMessages
from railfix.ranges.sbas.messages import message_type
from railfix.simulate.sbas.dfmc import SimulatedDfmc
from railfix.simulate.sbas.service import FAST_PERIOD_S, Service
from railfix.simulate.sbas.settings import SbasSettings

if TYPE_CHECKING:
    from railfix.simulate.signals import Simulation

LOST: Final = 53  #: Stream of random numbers of lost messages.


def sbas_messages(simulation: Simulation, settings: SbasSettings) -> SbasMessages:
    """Messages from `lead_s` before the run to its end, one a second.

    Every 6 s the fast corrections of all satellites (types 2 to 5, 24); in the seconds between, in turn, the masks,
    long-term corrections, grid, degradation and integrity. All corrections undo the errors that `Scenario.errors` puts
    into clocks, group delays, orbits and ionosphere, to the messages' resolution (0.125 m); only GPS is corrected.
    On L5: integrity (types 35, 36) every 6 s, between them mask, degradation and corrections of GPS and Galileo.
    """
    service = (SimulatedDfmc if settings.band == "L5" else Service)(simulation, settings)
    scenario = simulation.scenario
    fast, slow = service.fast_messages(), service.slow_messages()
    first = -int(np.ceil(settings.lead_s))
    sent, bits, turn = [], [], 0
    # The preamble goes by the second of the day, the frame of six seconds too.
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
    # A message has been received completely a second after its first bit.
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


def write_sbas(messages: SbasMessages, path: str | PathLike[str]) -> None:
    """Write messages as RTKLIB's .sbs, which `railfix run --sbas` reads; OutputError when it cannot be written."""
    lines, digits = [], 58 if messages.band == "L1" else 63  # RTKLIB cuts the parity
    for time, prn, kind, bits in zip(messages.time, messages.prn, messages.type, messages.bits, strict=True):
        week, tow = to_week(time)
        lines.append(f"{int(week)} {float(tow):.0f} {prn} {kind:2d} : {bits.tobytes().hex().upper()[:digits]}\n")
    write_whole(Path(path), "".join(lines), what="SBAS messages")
