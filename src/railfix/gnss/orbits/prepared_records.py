"""Select the navigation record of a satellite at an epoch; lookups and orbit elements are computed once and cached.

The newest record transmitted before the epoch is selected. A record without a transmission time counts as transmitted
half-way between the previous record's reference time and its own. If the newest record is not valid at the epoch, or if
all records were transmitted later (the file begins after the log), the record with the nearest reference time is
selected if it is valid. A selected record that was not yet transmitted is flagged. Health is taken from the selected
record, even if an older record is healthy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, Floats, Indices, Integers, Masks, Strings
from railfix.core.constants import CARRIER_FREQUENCY, FREQUENCY_L1
from railfix.core.timescale import seconds, timedelta
from railfix.gnss.navigation import KeplerRecords, Navigation
from railfix.gnss.orbits.ephemerides import GlonassStates, Orbits

#: Longest permitted time between an epoch and toe [s]. For GPS and QZSS, half the broadcast fit interval if that is
#: longer (IS-GPS-200, 20.3.4.4; QZSS broadcasts 2 h records every hour). Galileo does not broadcast data older than 4 h
#: (Galileo OS SDD 1.3, 2.4.2). BeiDou (renewed every hour) and GLONASS (renewed every 30 min) do not broadcast a
#: validity; their limits are taken from RTKLIB 2.4.3 (MAXDTOE_CMP, MAXDTOE_GLO of rtklib.h).
VALIDITY_S: Final[Mapping[str, float]] = {"G": 7200.0, "J": 7200.0, "E": 14_400.0, "C": 21_600.0, "R": 1800.0}

#: A transmission time counts as unknown if it differs from toe by more than the validity plus this time [s].
_EARLY_S: Final = 3600.0
#: Number of distinct times in a lookup key, in steps of 1 ms: 34 years. Times outside this range are clipped.
_SPAN: Final = np.int64(2**40)
_MILLISECOND: Final = np.timedelta64(1, "ms")


@dataclass(frozen=True)
class Lookup:
    """Records of all satellites in two lists for bisection, sorted by availability and by reference time."""

    number: Mapping[str, int]  #: Number of each satellite, or satellite and message ("E01 INAV"), in the keys.
    first: Integers  #: Index of each number's first key in `sent_key` and in `toe_key`.
    #: Keys that combine `number` and the time of availability [ms since `origin`], ascending, and the row of each key
    #: in the record table; shape (n,).
    sent_key: Integers
    sent_record: Integers
    #: Keys of `number` and the time from which the record's toe is the nearest, and the row of each key; shape (n,).
    toe_key: Integers
    toe_record: Integers

    origin: np.datetime64
    #: Reference time, and time from which the record is available, by row of the record table; shape (n,).
    toe: Datetimes
    available: Datetimes

    def find(self, number: Integers, time: Datetimes, limit: NDArray[np.timedelta64]) -> tuple[Integers, Masks, Masks]:
        """Return each satellite's record at each time, whether it is valid, and whether it was sent after the time.

        The shapes are (M, T). The record is a row number of the record table, or -1 for a satellite without records.
        The record is valid if its toe differs from the epoch by at most `limit` (one value per row of the table).
        """
        shape = (len(number), len(time))
        if not len(self.sent_key):
            return np.full(shape, -1, dtype=np.int64), np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
        base = np.maximum(number, 0)
        key = base[:, None] * _SPAN + np.clip((time - self.origin) // _MILLISECOND, 0, _SPAN - 1)
        position = np.searchsorted(self.sent_key, key, side="right") - 1
        future = position < self.first[base][:, None]
        record = self.sent_record[np.maximum(position, 0)]
        valid = (np.abs(time - self.toe[record]) <= limit[record]) & ~future
        if not valid.all():
            m, t = np.nonzero(~valid)
            nearest = self.toe_record[np.searchsorted(self.toe_key, key[m, t], side="right") - 1]
            nearest_valid = np.abs(time[t] - self.toe[nearest]) <= limit[nearest]
            replaced = nearest_valid | future[m, t]
            record[m, t] = np.where(replaced, nearest, record[m, t])
            valid[m, t] = nearest_valid
            future[m, t] = replaced & (self.available[nearest] > time[t])
        absent = number < 0
        if absent.any():
            record[absent], valid[absent], future[absent] = -1, False, False
        return record, valid, future


def make_lookup(label: Strings, toe: Datetimes, transmitted: Datetimes, validity_s: Floats) -> Lookup:
    """Sort the records of a table by label (satellite, or satellite and message) for `Lookup.find`."""
    empty = np.empty(0, dtype=np.int64)
    if not len(label):
        return Lookup({}, empty, empty, empty, empty, empty, np.datetime64(0, "ns"), toe, toe)
    names, number = np.unique(label, return_inverse=True)
    number = number.astype(np.int64)
    order = np.lexsort((toe, number))
    toe, transmitted, number = toe[order], transmitted[order], number[order]
    middle = toe.copy()
    middle[1:] = toe[:-1] + (toe[1:] - toe[:-1]) // 2
    known = ~np.isnat(transmitted) & (np.abs(transmitted - toe) <= timedelta(validity_s[order] + _EARLY_S))
    first = np.searchsorted(number, np.arange(len(names)))
    earliest = toe[first] - timedelta(validity_s[order][first] + _EARLY_S)
    middle[first] = earliest
    available = np.where(known, transmitted, middle)
    origin: np.datetime64 = np.minimum(available.min(), earliest.min()) - np.timedelta64(1, "s")
    sent = number * _SPAN + (available - origin) // _MILLISECOND
    resort = np.argsort(sent, kind="stable")
    by_row = np.argsort(order)
    middle[first] = origin
    return Lookup(
        number={str(name): i for i, name in enumerate(names)}, first=first, sent_key=sent[resort],
        sent_record=order[resort].astype(np.int64), toe_key=number * _SPAN + (middle - origin) // _MILLISECOND,
        toe_record=order.astype(np.int64), origin=origin, toe=toe[by_row], available=available[by_row],
    )  # fmt: skip


def validity_s(records: KeplerRecords) -> Floats:
    """Compute the longest permitted time between an epoch and toe for each record, shape (n,) [s]."""
    base = np.array([VALIDITY_S[s[0]] for s in records.satellite.tolist()], dtype=np.float64)
    return np.fmax(base, records.fit_interval_h * 1800.0)


#: Galileo: bits of data validity and signal health by band: E1-B, E5a, E5b (RINEX 3.05, A8; OS SIS ICD 5.1.9.3).
GALILEO_HEALTH: Final[Mapping[str, int]] = {"1": 0b111, "5": 0b111_000, "7": 0b111_000_000}
#: QZSS: bits of the health word that concern each signal (IS-QZSS-PNT-006, 4.1.2.3(4)). From the most significant bit,
#: they are L1, L1C/A, L2C, L5, L1C, L1C/B. Since 2022, satellites with L1C/A send the word 1 (no L1C/B).
QZSS_HEALTH: Final[Mapping[str, int]] = {
    "1C": 0b110_000, "1E": 0b100_001, "1S": 0b10, "1L": 0b10, "1X": 0b10,
    "2S": 0b1000, "2L": 0b1000, "2X": 0b1000, "5I": 0b100, "5Q": 0b100, "5X": 0b100,
}  # fmt: skip
#: A record with a larger URA or SISA counts as unhealthy [m]. URA indices from 8 exceed this limit (15 means no
#: prediction; IS-GPS-200, 20.3.3.3.1.3); the GPS performance standard calls signals with such indices marginal.
LARGEST_ACCURACY_M: Final = 48.0
#: Columns of `KeplerRecords.inter_signal_s` by GPS and QZSS signal; two columns (data and pilot) are averaged.
_ISC: Final[Mapping[str, list[int]]] = {
    "1C": [0], "1E": [0], "2S": [1], "2L": [1], "2X": [1], "5I": [2], "5Q": [3], "5X": [2, 3],
    "1S": [4], "1L": [5], "1X": [4, 5],
}  # fmt: skip
P_CODES: Final = ("2P", "2W", "2Y", "2D", "2N", "2M")  #: Signals of the P code, to which TGD refers.
#: Bit of the CNAV health word by band.
_CNAV_HEALTH: Final[Mapping[str, int]] = {"1": 0b100, "2": 0b010, "5": 0b001}
_ANY: Final = -1  #: Mask for signals without bits of their own: any set bit makes them unhealthy.


def unhealthy(records: KeplerRecords, signal: str) -> Masks:
    """Return whether each record flags a signal as unhealthy, shape (n,).

    A signal is flagged by any of the six health bits in GPS LNAV, by the bits of this signal for QZSS and Galileo, by
    the bit of its band in CNAV, and by SatH1 or HS for BeiDou. A signal is also unhealthy if the URA or SISA exceeds
    `LARGEST_ACCURACY_M`, or if a Galileo SISA is "NAPA" (no prediction, written as -1), which OS SDD 1.3, 2.3.1.4 calls
    marginal.
    """
    system = records.satellite.astype("<U1")
    bits = np.full(len(records), _ANY, dtype=np.int64)
    bits[system == "J"] = QZSS_HEALTH.get(signal, _ANY)
    cnav = np.isin(system, ["G", "J"]) & (records.message == "CNAV")
    bits[cnav] = _CNAV_HEALTH.get(signal[:1], _ANY)
    bits[system == "E"] = GALILEO_HEALTH.get(signal[:1], _ANY)
    no_accuracy = ((system == "E") & (records.accuracy_m < 0.0)) | (records.accuracy_m > LARGEST_ACCURACY_M)
    return np.asarray(((records.health & bits) != 0) | no_accuracy)


ClockReference = Literal["broadcast", "ionosphere_free"]


def group_delay_s(records: KeplerRecords, signal: str, *, clock: ClockReference = "broadcast") -> Floats:
    """Compute the group delay of a signal relative to the satellite clock, shape (n,) [s].

    ======== =====================================================================================
    GPS,     LNAV: TGD on L1, and (f1/f2)^2 TGD on L2 (IS-GPS-200, 20.3.3.3.3.2). On L5, TGD is used with an additional
    QZSS     sigma (`ranges.second_codes.group_delay_sigma_m`), because LNAV has no ISC. CNAV and CNAV-2: TGD - ISC on
             L1 C/A, L2C, L5, L1C (IS-GPS-200, 30.3.3.3.1.1; IS-GPS-705, 20.3.3.3.1.2; IS-GPS-800, 3.5.3.9).
    Galileo  The clock of I/NAV refers to E1 and E5b, and the clock of F/NAV refers to E1 and E5a (OS SIS ICD 5.1.5).
             The delay on E1 is BGD E5b/E1 for I/NAV, and BGD E5a/E1 for F/NAV. The delays on E5a and E5b need both
             BGDs; F/NAV lacks BGD E5b/E1, for which BGD E5a/E1 is used. The delay on E6 is not broadcast (NaN).
    BeiDou   The clock refers to B3I (B1I ICD 3.0, 5.2.4.10), on which the delay is 0. D1 and D2: TGD1 on B1I, TGD2 on
             B2I. CNV1 and CNV2: TGD_B1Cp and TGD_B2ap on the pilots, with ISC on the data signals (B1C and B2a ICD
             1.0, 7.6). CNV3: TGD_B2bI on B2b. On other signals, the delay is NaN.
    ======== =====================================================================================

    `clock` is the source of the satellite clock: the record ("broadcast") or SP3 files ("ionosphere_free"), whose
    clocks refer to the pairs L1/L2, E1/E5a and B1I/B3I.
    """
    delay = np.full(len(records), np.nan)
    system = records.satellite.astype("<U1")
    ionosphere_free = clock == "ionosphere_free"
    for letters, delays in (
        ("GJ", _navstar(records, signal)),
        ("E", _galileo(records, signal[:1], always_fnav=ionosphere_free)),
        ("C", _beidou(records, signal, ionosphere_free=ionosphere_free)),
    ):
        delay = np.where(np.isin(system, [*letters]), delays, delay)
    return delay


def _navstar(records: KeplerRecords, signal: str) -> Floats:
    tgd = records.group_delay_1_s
    frequency = CARRIER_FREQUENCY["G"].get(signal[:1], np.nan)
    scale = (FREQUENCY_L1 / frequency) ** 2
    legacy = tgd * (1.0 if signal[:1] == "5" else scale)
    columns = _ISC.get(signal)
    if columns is None:
        return legacy
    corrected = tgd - records.inter_signal_s[:, columns].mean(axis=1)
    return np.where(records.message == "LNAV", legacy, corrected)


def _galileo(records: KeplerRecords, band: str, *, always_fnav: bool) -> Floats:
    inav = records.message == "INAV"
    e5a = records.group_delay_1_s
    e5b = np.where(inav, records.group_delay_2_s, e5a)
    on_e1 = e5a if always_fnav else np.where(inav, e5b, e5a)
    # BGD(E1, x) = (delay on E1 - delay on x) / (1 - (f1/fx)^2)
    frequency = CARRIER_FREQUENCY["E"]
    on_e5a = on_e1 - e5a * (1.0 - (FREQUENCY_L1 / frequency["5"]) ** 2)
    on_e5b = on_e1 - e5b * (1.0 - (FREQUENCY_L1 / frequency["7"]) ** 2)
    by_band = {"1": on_e1, "5": on_e5a, "7": on_e5b, "8": 0.5 * (on_e5a + on_e5b)}
    return by_band.get(band, np.full(len(records), np.nan))


def _beidou(records: KeplerRecords, signal: str, *, ionosphere_free: bool) -> Floats:
    unknown = np.full(len(records), np.nan)
    first, second = records.group_delay_1_s, records.group_delay_2_s
    if signal[:1] == "6":
        delay = np.zeros(len(records))
    elif signal[:1] == "2":
        delay = np.where(_has_message(records, "D1", "D2"), first, unknown)
    elif signal in ("7I", "7Q", "7X"):  # B2I; 7D, 7P and 7Z are B2b
        delay = np.where(_has_message(records, "D1", "D2"), second, unknown)
    elif signal in ("7D", "7Z"):
        delay = np.where(_has_message(records, "CNV3"), first, unknown)
    elif signal in ("1P", "1X"):
        delay = np.where(_has_message(records, "CNV1", "CNV2"), first, unknown)
    elif signal in ("5P", "5X"):
        delay = np.where(_has_message(records, "CNV1", "CNV2"), second, unknown)
    elif signal == "1D":
        delay = np.where(_has_message(records, "CNV1"), first + records.inter_signal_s[:, 0], unknown)
    elif signal == "5D":
        delay = np.where(_has_message(records, "CNV2"), second + records.inter_signal_s[:, 1], unknown)
    else:
        delay = unknown
    if not ionosphere_free:
        return delay
    f1, f3 = CARRIER_FREQUENCY["C"]["2"] ** 2, CARRIER_FREQUENCY["C"]["6"] ** 2
    return np.where(_has_message(records, "D1", "D2"), delay - f1 / (f1 - f3) * first, unknown)


def _has_message(records: KeplerRecords, *messages: str) -> Masks:
    return np.isin(records.message, messages)


_CACHED_SETS: Final = 64  #: Largest number of channel sets cached per navigation.


@dataclass(frozen=True)
class ChannelRecords:
    """Lookup numbers of a set of channels, and group delay and health by signal and record."""

    #: Indices of the channels with Keplerian records, shape (K,), and of the GLONASS channels, shape (R,).
    kepler: Indices
    glonass: Indices
    #: Lookup numbers of the preferred message and of the alternative message; -1 for an absent message; shape (K,).
    preferred: Integers
    other: Integers

    any_other: bool
    signal: Integers  #: Row of each channel in `group_delay_s` and `unhealthy`, shape (K,).
    group_delay_s: Floats  #: Group delay by signal and record, shape (signals, records).
    unhealthy: Masks  #: Whether a record flags a signal as unhealthy, shape (signals, records).
    glonass_number: Integers  #: Lookup number of GLONASS channels; -1 for satellites without records; (R,).


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
    def step_states(self) -> GlonassStates:
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
        number, glonass_number = self.lookup.number, self.glonass_lookup.number
        first, second = zip(*(_labels(name, code) for name, code in names), strict=True) if names else ((), ())
        pairs = [(number.get(a, -1), number.get(b, -1)) for a, b in zip(first, second, strict=True)]
        preferred, other = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        # A satellite with only the alternative message uses it as the preferred message.
        preferred, other = np.where(preferred < 0, other, preferred), np.where(preferred < 0, -1, other)
        clock: ClockReference = "broadcast" if self.navigation.precise is None else "ionosphere_free"
        records = self.navigation.kepler
        return ChannelRecords(
            kepler=kepler, glonass=glonass, preferred=preferred, other=other, any_other=bool((other >= 0).any()),
            signal=np.array([codes.index(code) for _, code in names], dtype=np.int64),
            group_delay_s=_rows(lambda code: group_delay_s(records, code, clock=clock), codes, len(records)),
            unhealthy=_rows(lambda code: unhealthy(records, code), codes, len(records)).astype(bool),
            glonass_number=np.array([glonass_number.get(satellite[i], -1) for i in glonass], dtype=np.int64),
        )  # fmt: skip


def _rows(of_signal: Callable[[str], NDArray[np.generic]], codes: list[str], records: int) -> Floats:
    return np.array([of_signal(code) for code in codes], dtype=np.float64).reshape(len(codes), records)


#: Message with the group delay of each signal whose delay is not in LNAV, D1, D2, I/NAV or F/NAV.
_MESSAGE_OF: Final = {
    **dict.fromkeys(("G2S", "G2L", "G2X", "G5I", "G5Q", "G5X", "J2S", "J2L", "J2X", "J5I", "J5Q", "J5X"), "CNAV"),
    **dict.fromkeys(("G1S", "G1L", "G1X", "J1S", "J1L", "J1X"), "CNV2"),
    **dict.fromkeys(("C1D", "C1P", "C1X", "C5X"), "CNV1"),
    **dict.fromkeys(("C5D", "C5P"), "CNV2"),
    **dict.fromkeys(("C7D", "C7Z"), "CNV3"),
}


def _labels(satellite: str, signal: str) -> tuple[str, str]:
    """Return the lookup label of the records whose clock and group delay refer to the channel's signal, and the label
    of the records that are used without them.
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
    """Return the prepared records of a `Navigation`, computed once for each object."""
    return PreparedRecords(navigation)
