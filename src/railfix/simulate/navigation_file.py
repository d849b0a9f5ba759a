"""Satellites of a recorded navigation file: the records that a run needs.

The simulated signals follow the newest record transmitted, as receivers use it, so that a change of
records is a small step in the ranges (decimetres), which a receiver that changes with them does not see.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Final

import numpy as np

from railfix.core.arrays import Indices, Masks
from railfix.core.errors import MismatchError
from railfix.core.timescale import gpst_minus_utc, timedelta
from railfix.gnss.navigation import GlonassRecords, KeplerRecords, Navigation
from railfix.io.rinex import read_navigation
from railfix.simulate.scenario import Scenario

#: Validity of a record about its reference time [s]: half of GPS' and QZSS' least fit interval, Galileo's
#: and BeiDou's as `railfix.gnss.orbits`.
_SERVES_S: Final = {"G": 7200.0, "J": 7200.0, "E": 14_400.0, "C": 21_600.0}
#: Time from transmission to reference time, where the transmission time is absent or implausible [s].
_SENT_BEFORE_S: Final = {"G": 7200.0, "J": 3600.0, "E": 600.0, "C": 3600.0}
_SIGNALS_MESSAGE: Final = {"G": ("LNAV",), "J": ("LNAV",), "E": ("INAV",), "C": ("D1", "D2")}


def navigation_of_file(scenario: Scenario, path: str) -> Navigation:
    """Records of the scenario's constellations that serve its time.

    A satellite takes part when at every moment of the run the newest record transmitted is within its
    validity. Galileo's are the I/NAV ones. A transmission time that is absent is set to
    the constellation's usual one. Klobuchar's coefficients are GPS'; they serve all. InputFileError: when it is no
    navigation file. MismatchError: when the scenario's time is not within its records, or it lacks the coefficients.
    """
    navigation = read_navigation(path)
    if "G" not in navigation.klobuchar and scenario.sky.ionosphere_scale > 0.0:
        raise MismatchError(
            f"{path}: has no Klobuchar coefficients of GPS, which the simulated ionosphere needs; take another file, "
            "or set sky.ionosphere_scale to 0 and position with `--set ionosphere=off`"
        )
    records = _select_simulated(navigation.kepler, scenario.sky.systems)
    first = scenario.start
    last = first + np.timedelta64(round(scenario.duration_s * 1e9), "ns")
    kept = [rows for name in np.unique(records.satellite) if len(rows := _serving(records, str(name), first, last))]
    if not kept:
        span = f"{records.toe.min()} to {records.toe.max()}" if len(records) else "none of these constellations"
        raise MismatchError(
            f"{path}: no satellite of {scenario.sky.systems!r} has records for all of {first} to {last} GPS time, "
            f"the scenario's; reference times in the file: {span}"
        )
    return Navigation(
        kepler=_rows(records, np.concatenate(kept)),
        glonass=no_glonass(),
        klobuchar={"G": navigation.klobuchar["G"]} if "G" in navigation.klobuchar else {"G": np.zeros(8)},
        leap_seconds=int(gpst_minus_utc(first)) if navigation.leap_seconds is None else navigation.leap_seconds,
        sources=navigation.sources,
    )


def no_glonass() -> GlonassRecords:
    """Empty GLONASS records; GLONASS is not simulated."""
    none, times = np.empty(0), np.empty(0, dtype="datetime64[ns]")
    vectors = np.empty((0, 3))
    integers = np.empty(0, dtype=np.int64)
    return GlonassRecords(
        satellite=np.empty(0, dtype="<U3"), toe=times, transmitted=times, clock_bias_s=none, relative_frequency=none,
        position_ecef_m=vectors, velocity_ecef_mps=vectors, acceleration_ecef_mps2=vectors, health=integers,
        frequency_channel=integers, age_days=none,
    )  # fmt: skip


def _rows(records: KeplerRecords, rows: Indices | Masks) -> KeplerRecords:
    return replace(records, **{item.name: getattr(records, item.name)[rows] for item in fields(records)})


def _select_simulated(records: KeplerRecords, systems: str) -> KeplerRecords:
    """Records of the simulated signals, with plausible transmission times."""
    letter = records.satellite.astype("<U1")
    usable = np.zeros(len(records), dtype=np.bool_)
    delay = np.where(letter == "E", records.group_delay_2_s, records.group_delay_1_s)
    for system in systems:
        usable |= (letter == system) & np.isin(records.message, _SIGNALS_MESSAGE[system]) & np.isfinite(delay)
    records, letter = _rows(records, usable), letter[usable]
    serves, before = (timedelta([table[str(s)] for s in letter]) for table in (_SERVES_S, _SENT_BEFORE_S))
    early = records.toe - records.transmitted
    plausible = ~np.isnat(records.transmitted) & (np.abs(early) <= serves)
    return replace(records, transmitted=np.where(plausible, records.transmitted, records.toe - before))


def _serving(records: KeplerRecords, satellite: str, first: np.datetime64, last: np.datetime64) -> Indices:
    """Indices of a satellite in force from `first` to `last`, by transmission; none where a moment is not served."""
    rows = np.flatnonzero(records.satellite == satellite)
    rows = rows[np.lexsort((records.toe[rows], records.transmitted[rows]))]
    # Of records sent at one time the one for later.
    rows = rows[np.append(np.diff(records.transmitted[rows]) > np.timedelta64(0, "ns"), True)]
    sent = records.transmitted[rows]
    begin, end = (int(np.searchsorted(sent, time, side="right")) for time in (first, last))
    if begin == 0 or not len(rows):
        return np.empty(0, dtype=np.intp)
    rows = rows[begin - 1 : end]
    limit = timedelta(_SERVES_S[satellite[0]])
    from_time = np.maximum(records.transmitted[rows], first)
    to_time = np.append(records.transmitted[rows][1:], last)
    served = (np.abs(from_time - records.toe[rows]) <= limit) & (np.abs(to_time - records.toe[rows]) <= limit)
    return np.asarray(rows[: len(rows) if served.all() else 0])
