"""Lookups and orbit elements of a `Navigation`, computed once and cached."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Floats, Indices, Integers, Masks, Strings
from railfix.core.timescale import seconds, timedelta
from railfix.gnss.navigation import Navigation
from railfix.gnss.orbits.glonass import GlonassStates
from railfix.gnss.orbits.kepler import Orbits
from railfix.gnss.orbits.record_selection import VALIDITY_S, make_lookup, validity_s
from railfix.gnss.orbits.signal_health import group_delay_s, unhealthy

#: Number of channel sets cached per navigation.
_CACHED_SETS: Final = 64


@dataclass(frozen=True)
class ChannelRecords:
    """Record rows, group delays and health of a set of channels.

    Attributes
    ----------
    kepler, glonass : ndarray of int, shape (K,), (R,)
        Channels of the constellations with Keplerian records, and of GLONASS.
    preferred, other : ndarray of int, shape (K,)
        Numbers in the lookup: the message with the clock and the group delay of the channel's signal, and another
        one; -1 for none.
    any_other : bool
    signal : ndarray of int, shape (K,)
        Row of `group_delay_s` and `unhealthy`.
    group_delay_s : ndarray, shape (signals, records) [s]
    unhealthy : ndarray of bool, shape (signals, records)
    glonass_number : ndarray of int, shape (R,)
    """

    kepler: Indices
    glonass: Indices
    preferred: Integers
    other: Integers
    any_other: bool
    signal: Integers
    group_delay_s: Floats
    unhealthy: Masks
    glonass_number: Integers


class PreparedRecords:
    """Lookups, orbits and clocks of all records of one `Navigation`."""

    def __init__(self, navigation: Navigation) -> None:
        kepler, glonass = navigation.kepler, navigation.glonass
        self.navigation = navigation
        validity = validity_s(kepler)
        self.validity = timedelta(validity)
        named = ~np.isin(kepler.message, ("LNAV", "D1", "D2"))
        label = np.where(named, np.char.add(np.char.add(kepler.satellite, " "), kepler.message), kepler.satellite)
        self.lookup = make_lookup(label, kepler.toe, kepler.transmitted, validity)
        self.orbits = Orbits.from_records(kepler)
        self.clock = np.stack([kepler.af0_s, kepler.af1, kepler.af2])
        self.toe_after_toc_s = seconds(kepler.toe - kepler.toc)
        validity = np.full(len(glonass), VALIDITY_S["R"])
        self.glonass_validity = timedelta(validity)
        self.glonass_lookup = make_lookup(glonass.satellite, glonass.toe, glonass.transmitted, validity)
        self._cache: dict[tuple[bytes, ...], ChannelRecords] = {}

    @cached_property
    def integrated(self) -> GlonassStates:
        """GLONASS states at multiples of the integration step."""
        return GlonassStates.from_records(self.navigation.glonass, VALIDITY_S["R"])

    def channels(self, satellite: Strings, signal: Strings) -> ChannelRecords:
        """Return the records of a set of channels, from the cache where possible."""
        key = (satellite.tobytes(), signal.tobytes(), str(satellite.dtype).encode(), str(signal.dtype).encode())
        channels = self._cache.get(key)
        if channels is None:
            while len(self._cache) >= _CACHED_SETS:
                self._cache.pop(next(iter(self._cache)))
            channels = self._cache[key] = self._channel_records(satellite.tolist(), signal.tolist())
        return channels

    def _channel_records(self, satellite: list[str], signal: list[str]) -> ChannelRecords:
        kepler = np.array([i for i, s in enumerate(satellite) if s[:1] in ("G", "J", "E", "C")], dtype=np.intp)
        glonass = np.array([i for i, s in enumerate(satellite) if s[:1] == "R"], dtype=np.intp)
        names = [(satellite[i], signal[i]) for i in kepler]
        codes = sorted({code for _, code in names})
        number = self.lookup.number
        first, second = zip(*(_labels(name, code) for name, code in names), strict=True) if names else ((), ())
        pairs = [(number.get(a, -1), number.get(b, -1)) for a, b in zip(first, second, strict=True)]
        preferred, other = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        # A satellite that has only the other message uses it as the preferred one.
        preferred, other = np.where(preferred < 0, other, preferred), np.where(preferred < 0, -1, other)
        clock: Literal["broadcast", "ionosphere_free"] = (
            "ionosphere_free" if self.navigation.precise is not None else "broadcast"
        )
        records = self.navigation.kepler
        return ChannelRecords(
            kepler=kepler,
            glonass=glonass,
            preferred=preferred,
            other=other,
            any_other=bool((other >= 0).any()),
            signal=np.array([codes.index(code) for _, code in names], dtype=np.int64),
            group_delay_s=_rows(lambda code: group_delay_s(records, code, clock=clock), codes, len(records)),
            unhealthy=_rows(lambda code: unhealthy(records, code), codes, len(records)).astype(bool),
            glonass_number=np.array(
                [self.glonass_lookup.number.get(satellite[i], -1) for i in glonass], dtype=np.int64
            ),
        )


def _rows(of_signal: Callable[[str], NDArray[np.generic]], codes: list[str], records: int) -> Floats:
    return np.array([of_signal(code) for code in codes], dtype=np.float64).reshape(len(codes), records)


#: Message with the group delay of a signal other than LNAV, D1 and D2, by constellation and signal.
_MESSAGE_OF: Final = {
    **dict.fromkeys(("G2S", "G2L", "G2X", "G5I", "G5Q", "G5X", "J2S", "J2L", "J2X", "J5I", "J5Q", "J5X"), "CNAV"),
    **dict.fromkeys(("G1S", "G1L", "G1X", "J1S", "J1L", "J1X"), "CNV2"),
    **dict.fromkeys(("C1D", "C1P", "C1X", "C5X"), "CNV1"),
    **dict.fromkeys(("C5D", "C5P"), "CNV2"),
    **dict.fromkeys(("C7D", "C7Z"), "CNV3"),
}


def _labels(satellite: str, signal: str) -> tuple[str, str]:
    """Return the names in the lookup, preferred first: F/NAV has the clock of E1 and E5a, I/NAV of E1 and E5b.

    LNAV, D1 and D2 have the name of the satellite alone. They come first unless another message has the group delay of
    the signal; CNAV serves where there is no LNAV.
    """
    if satellite[0] == "E":
        messages = ("FNAV", "INAV") if signal[:1] == "5" else ("INAV", "FNAV")
        return f"{satellite} {messages[0]}", f"{satellite} {messages[1]}"
    message = _MESSAGE_OF.get(satellite[0] + signal)
    if message is not None:
        return f"{satellite} {message}", satellite
    return satellite, f"{satellite} CNAV"


@lru_cache(maxsize=8)
def prepared_records(navigation: Navigation) -> PreparedRecords:
    """Prepare the records of a `Navigation`, once for each object."""
    return PreparedRecords(navigation)
