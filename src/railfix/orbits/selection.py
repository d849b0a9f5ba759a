"""Which record a satellite has at an epoch, and what it says about the signal.

Among records the newest one transmitted before the epoch is taken. Where a file does not tell
when a record was transmitted, the one whose reference time lies nearest is. Health is decided on
the record taken: an older one that calls the satellite healthy does not win.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from railfix.constants import FREQUENCY_L1
from railfix.navigation import GlonassRecords, KeplerRecords
from railfix.signals import carrier_frequency_hz
from railfix.timescale import timedelta

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Longest distance of an epoch from toe [s]: GPS and QZSS half their fit interval (IS-GPS-200,
#: 20.3.4.4), at least this; Galileo 4 h (OS SDD 2.1.1 table 9); BeiDou 6 h and GLONASS 30 min as
#: is the custom of single-point programs (records are renewed every hour, every 30 minutes).
VALIDITY_S: Final[Mapping[str, float]] = {"G": 7200.0, "J": 7200.0, "E": 14_400.0, "C": 21_600.0, "R": 1800.0}

#: Galileo: bits of the health word that concern the signal, by band (RINEX 3.05, table A8).
GALILEO_HEALTH_BITS: Final[Mapping[str, int]] = {"1": 0b111, "5": 0b111_000, "7": 0b111_000_000}
#: QZSS: bits of the six-bit health word that concern the signal, by band (L1 C/A, L2C, L5).
QZSS_HEALTH_BITS: Final[Mapping[str, int]] = {"1": 0b010_000, "2": 0b001_000, "5": 0b000_100}


@dataclass(frozen=True)
class Lookup:
    """Records of some satellites in one sorted list that a single search answers.

    Attributes
    ----------
    record : ndarray of int, shape (n,)
        Rows of the record table, satellite by satellite, each in order of availability.
    first : mapping of str to int
        Where a satellite's records begin.
    key : ndarray of int64, shape (n,)
        Satellite and time of availability since `origin` [ms] as one rising number.
    origin : datetime64[ns]
    """

    record: Indices
    first: Mapping[str, int]
    key: Indices
    origin: np.datetime64


#: Longest time that a lookup tells apart [ms]: 34 years, so that records of another year do no harm.
_SPAN: Final = np.int64(2**40)
_MILLISECOND: Final = np.timedelta64(1, "ms")


def make_lookup(records: KeplerRecords | GlonassRecords, rows: Indices, validity_s: Floats) -> Lookup:
    """Sort rows of a record table for `find_records`.

    Parameters
    ----------
    records : KeplerRecords or GlonassRecords
    rows : ndarray of int, shape (n,)
        Rows to choose from.
    validity_s : ndarray, shape (n,) [s]
        Longest distance from toe.
    """
    satellite, toe = records.satellite[rows], records.toe[rows]
    transmitted = records.transmitted[rows]
    known = ~np.isnat(transmitted) & (np.abs(transmitted - toe) <= timedelta(validity_s))
    order = np.lexsort((toe, satellite))
    available = np.where(known, transmitted, np.datetime64("NaT", "ns"))[order]
    satellite, toe, rows = satellite[order], toe[order], rows[order]
    if not len(rows):
        return Lookup(record=rows, first={}, key=rows, origin=np.datetime64(0, "ns"))
    same = np.r_[False, satellite[1:] == satellite[:-1]]
    middle = toe.copy()
    middle[1:] = toe[:-1] + (toe[1:] - toe[:-1]) // 2
    # A record whose transmission is unknown serves from half-way since the one before it.
    middle[~same] = toe[~same] - timedelta(np.full(int((~same).sum()), 86_400.0))
    available = np.where(np.isnat(available), middle, available)
    origin = available.min() - np.timedelta64(1, "D")
    names, number = np.unique(satellite, return_inverse=True)
    key = number.astype(np.int64) * _SPAN + (available - origin) // _MILLISECOND
    resort = np.argsort(key, kind="stable")
    first = {str(n): int(np.searchsorted(number, i)) for i, n in enumerate(names)}
    return Lookup(record=rows[resort], first=first, key=key[resort], origin=np.datetime64(origin, "ns"))


def find_records(
    lookup: Lookup, satellite: NDArray[np.str_], time: NDArray[np.datetime64]
) -> tuple[Indices, NDArray[np.bool_]]:
    """Newest record available at each epoch.

    Parameters
    ----------
    lookup : Lookup
    satellite : ndarray of str, shape (M,)
    time : ndarray of datetime64[ns], shape (T,)

    Returns
    -------
    record : ndarray of int, shape (T, M)
        Row of the record table; -1 where the satellite has none at all.
    future : ndarray of bool, shape (T, M)
        The satellite's first record was transmitted after the epoch: post-processing only.
    """
    first = np.array([lookup.first.get(s, -1) for s in satellite.tolist()], dtype=np.int64)
    none = np.full((len(time), len(satellite)), -1, dtype=np.int64)
    if not len(lookup.key) or not len(satellite):
        return none, np.zeros(none.shape, dtype=bool)
    start = np.maximum(first, 0)
    number = lookup.key[start] // _SPAN
    since = np.clip((time - lookup.origin) // _MILLISECOND, 0, _SPAN - 1)
    found = np.searchsorted(lookup.key, number * _SPAN + since[:, None], side="right") - 1
    future = (found < start) & (first >= 0)
    row = lookup.record[np.maximum(found, start)]
    return np.where(first >= 0, row, -1), future


def validity_s(records: KeplerRecords) -> Floats:
    """Longest distance of an epoch from toe for each record, shape (n,) [s]."""
    base = np.array([VALIDITY_S[s[0]] for s in records.satellite.tolist()], dtype=np.float64)
    return np.fmax(base, records.fit_interval_h * 1800.0)


def kepler_unhealthy(records: KeplerRecords, signal_band: str) -> NDArray[np.bool_]:
    """Records that call signals of a band unhealthy, shape (n,).

    GPS: any of the six bits. QZSS: the L1 C/A, L2C or L5 bit of the band (IS-QZSS-PNT, 4.1.2.3).
    Galileo: data validity and signal health of the band. BeiDou: SatH1.
    """
    system = records.satellite.astype("<U1")
    bits = np.full(len(records), ~0, dtype=np.int64)
    bits[system == "J"] = QZSS_HEALTH_BITS.get(signal_band, 0b111_110)
    bits[system == "E"] = GALILEO_HEALTH_BITS.get(signal_band, 0b111_111_111)
    return np.asarray((records.health & bits) != 0)


def group_delay_s(records: KeplerRecords, band: str) -> Floats:
    """Group delay of a band against the clock that the record broadcasts, shape (n,) [s].

    GPS, QZSS: TGD on L1, scaled by (f1/f)^2 elsewhere (IS-GPS-200, 20.3.3.3.3.2; L5 would need an
    inter-signal correction that these messages do not hold). Galileo: BGD E5b/E1 with I/NAV, E5a/E1
    with F/NAV clocks, on E1; scaled on E5 (OS SIS ICD 5.1.5). BeiDou: the clock is that of B3I;
    TGD1 on B1I, TGD2 on B2I, 0 on B3I, NaN on signals whose delay D1 and D2 messages do not hold.
    """
    delay = np.full(len(records), np.nan)
    system = records.satellite.astype("<U1")
    for letter in ("G", "J"):
        here = system == letter
        f = carrier_frequency_hz(np.array([letter + "01"]), np.array([band + "C"]))[0]
        delay[here] = records.group_delay_1_s[here] * (FREQUENCY_L1 / f) ** 2
    here = system == "E"
    inav = records.message == "INAV"
    bgd = np.where(inav, records.group_delay_2_s, records.group_delay_1_s)
    f = carrier_frequency_hz(np.array(["E01"]), np.array([band + "C"]))[0]
    delay[here] = bgd[here] * (FREQUENCY_L1 / f) ** 2
    here = system == "C"
    by_band = {"2": records.group_delay_1_s, "7": records.group_delay_2_s, "6": np.zeros(len(records))}
    if band in by_band:
        delay[here] = by_band[band][here]
    return delay
