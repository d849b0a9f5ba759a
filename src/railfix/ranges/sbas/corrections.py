"""Corrections of satellites at any epochs from the messages of one GEO (DO-229D, A.4.4 and A.4.5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Integers, Masks, Strings
from railfix.core.timescale import seconds
from railfix.gnss.navigation import Navigation
from railfix.gnss.orbits.issues import issue_records
from railfix.ranges.sbas.choose import best_prn
from railfix.ranges.sbas.degrade import Growth, delta_udre_covariance, growth
from railfix.ranges.sbas.fast import FastCorrected, fast_corrected
from railfix.ranges.sbas.grid import GridTables
from railfix.ranges.sbas.ionosphere import ionosphere
from railfix.ranges.sbas.limits import DO_NOT_USE, INFLATION_M, NOT_MONITORED, STOP_S, UDRE_VARIANCE_M2, SbasLimits
from railfix.ranges.sbas.log import SbasLog
from railfix.ranges.sbas.names import mask_satellite, system_name
from railfix.ranges.sbas.results import IonosphereDelays, SatelliteCorrections, SatelliteState
from railfix.ranges.sbas.service import ServiceTable
from railfix.ranges.sbas.tables import LONG_AGO, SatelliteTables

_NUMBER_OF = {mask_satellite(number): number for number in range(1, 211) if mask_satellite(number)}
_SIGMA_UDRE = np.sqrt(np.array([*UDRE_VARIANCE_M2, np.nan, np.nan, np.nan]))


@dataclass(frozen=True, kw_only=True)
class _LongTerm:
    """Long-term correction in force, all (T, K)."""

    row: Integers
    record: Integers
    missing: Masks
    timed_out: Masks
    mismatch: Masks


class SbasCorrections:
    """What one GEO's messages say at any epochs; the tables are made once, then searched.

    A message counts from the moment it had been received (`SbasLog.time`), never before. Nothing
    depends on the other epochs or satellites of a call.

    Parameters
    ----------
    log : SbasLog
    prn : int or "best"
        Whose messages; "best" takes the GEO with the most usable fast corrections, of equal ones the
        smallest PRN.
    limits : SbasLimits, optional

    Attributes
    ----------
    prn : int
    limits : SbasLimits
    notes : tuple of str
        What was asked and what was used.
    span : tuple of datetime64[ns]
        Reception of the first and the last message of that GEO.

    Raises
    ------
    ValueError
        The log has no message of that PRN.
    """

    def __init__(self, log: SbasLog, *, prn: int | Literal["best"] = "best", limits: SbasLimits | None = None) -> None:
        self.limits = limits or SbasLimits()
        self.prn, why = best_prn(log, prn, self.limits)
        of_prn = log.of(self.prn)
        self.span: tuple[np.datetime64, np.datetime64] = (of_prn.time.min(), of_prn.time.max())
        self._tables = SatelliteTables(of_prn, self.limits)
        self._grid = GridTables(of_prn, self.limits, self._tables.stops)
        self._service = ServiceTable(of_prn, self.limits)
        self.unused: Mapping[str, int] = {
            what: number for what, number in sorted((self._tables.unused + self._grid.unused).items()) if number
        }
        self.notes = (*log.notes, why, *self._notes(of_prn))

    def _notes(self, log: SbasLog) -> list[str]:
        limits = self.limits
        notes = [
            f"SBAS corrections of {system_name(self.prn)} PRN {self.prn}: time-outs of "
            f"{limits.mode.replace('_', ' ')}, UDREI up to {limits.largest_udrei}, type 0 "
            f"{limits.type0.replace('_', ' ')}, range rate {limits.range_rate}, incomplete degradation data "
            f"{limits.incomplete}"
        ]
        zeros = int((log.type == 0).sum())
        if zeros:
            used = "read as type 2" if limits.type0 == "as_type2" else "each stopped the GEO for 60 s"
            notes.append(f"PRN {self.prn} sent {zeros} messages of type 0 (do not use for safety): {used}")
        notes += [f"PRN {self.prn}: {number} {what}, not used" for what, number in self.unused.items()]
        return notes

    def satellites(
        self, time: Datetimes, satellite: Strings, navigation: Navigation | None = None
    ) -> SatelliteCorrections:
        """Fast and long-term corrections.

        Parameters
        ----------
        time : ndarray of datetime64[ns], shape (T,)
        satellite : ndarray of str, shape (K,)
            "G05"; GLONASS and others that the mask does not know are NOT_IN_MASK.
        navigation : Navigation, optional
            A long-term correction is taken only if a record has its issue of data; the one before
            it, of another issue, is tried next. Without it, the newest is taken as it is.

        Returns
        -------
        SatelliteCorrections
        """
        number = np.array([_NUMBER_OF.get(str(name), -1) for name in satellite], dtype=np.int64)
        tables, limits, at = self._tables, self.limits, time[:, None]
        stop = tables.stops.last(time)[:, None]
        fast = fast_corrected(tables, limits, at, number[None, :], stop)
        long = self._long_term(time, satellite, number, stop, navigation)
        has_mask, in_mask = tables.masks.holds(number, time)
        grown = growth(tables, limits, at, fast, long.row, stop)
        covariance, lacks_covariance = self._covariance(time, number, stop)
        incomplete = fast.no_factor | grown.missing | lacks_covariance
        state = np.select(
            [
                seconds(at - stop) < STOP_S,
                ~has_mask[:, None] & np.ones(len(number), dtype=bool),
                ~in_mask,
                fast.missing,
                fast.udrei == DO_NOT_USE,
                fast.udrei == NOT_MONITORED,
                fast.timed_out | long.timed_out,
                fast.udrei > limits.largest_udrei,
                long.missing,
                long.mismatch,
                incomplete & (limits.incomplete == "refuse"),
                fast.no_rate,
            ],
            [
                SatelliteState.GEO_STOPPED,
                SatelliteState.NO_MASK,
                SatelliteState.NOT_IN_MASK,
                SatelliteState.NO_FAST,
                SatelliteState.DO_NOT_USE,
                SatelliteState.NOT_MONITORED,
                SatelliteState.TIMED_OUT,
                SatelliteState.UDREI_TOO_LARGE,
                SatelliteState.NO_LONG_TERM,
                SatelliteState.IODE_MISMATCH,
                SatelliteState.NO_DEGRADATION,
                SatelliteState.NO_RANGE_RATE,
            ],
            SatelliteState.OK,
        ).astype(np.int64)
        return self._assemble(time, state, fast, long, grown, incomplete, covariance)

    def _assemble(
        self,
        time: Datetimes,
        state: Integers,
        fast: FastCorrected,
        long: _LongTerm,
        grown: Growth,
        inflated: Masks,
        covariance: Integers,
    ) -> SatelliteCorrections:
        """Put the parts together; nothing but states where they are not OK."""
        used = state == SatelliteState.OK
        table = self._tables.long_term
        has = used & (long.row >= 0)
        position, clock = np.zeros((*state.shape, 3)), np.zeros(state.shape)
        t, k = np.nonzero(has)
        row = long.row[t, k]
        since = np.nan_to_num(seconds(time[t] - table.reference[row]))
        position[t, k] = table.position_m[row] + table.velocity_mps[row] * since[:, None]
        clock[t, k] = table.clock_s[row] + table.clock_rate[row] * since
        iode = np.full(state.shape, -1, dtype=np.int64)
        known = long.row >= 0
        iode[known] = table.iode[long.row[known]]

        def kept(values: Floats) -> Floats:
            return np.where(used, values, np.nan)

        def term(values: Floats) -> Floats:
            return np.where(used, np.where(inflated, 0.0, values), np.nan)

        return SatelliteCorrections(
            state=state,
            fast_m=kept(fast.correction_m),
            rate_mps=kept(fast.rate_mps),
            position_m=np.where(used[..., None], position, np.nan),
            clock_s=kept(clock),
            iode=iode,
            record=np.where(used, long.record, -1),
            udrei=fast.udrei,
            sigma_udre_m=kept(_SIGMA_UDRE[fast.udrei]),
            fast_growth_m=np.where(used & inflated, INFLATION_M, term(grown.fast_m)),
            rate_growth_m=term(grown.rate_m),
            long_term_growth_m=term(grown.long_term_m),
            en_route_m=term(grown.en_route_m),
            inflated=inflated & used,
            rss=grown.rss,
            covariance=covariance,
        )

    def _long_term(
        self,
        time: Datetimes,
        satellite: Strings,
        number: Integers,
        stop: Datetimes,
        navigation: Navigation | None,
    ) -> _LongTerm:
        """Newest long-term correction that a record goes with; satellites of SBAS itself need none."""
        table, limit = self._tables.long_term, self.limits.timeout_s("long_term")
        newest = table.newest.newest(number[None, :], time[:, None])
        other = table.other[newest] if len(table.other) else newest
        other = np.where(newest >= 0, other, -1)

        def judged(row: Integers) -> tuple[Masks, Masks, Integers]:
            received = table.time[row] if len(table.time) else np.full(row.shape, LONG_AGO)
            known = (row >= 0) & (received > stop)
            iodp = table.iodp[row] if len(table.iodp) else row
            late = (seconds(time[:, None] - received) > limit) | ~self._tables.masks.active(iodp, time[:, None])
            issue = np.where(known, table.iode[row] if len(table.iode) else -1, -1)
            record = np.full(row.shape, -1, dtype=np.int64)
            if navigation is not None:
                record = issue_records(navigation, satellite, time, issue)
            return known, known & late, record

        known, late, record = judged(newest)
        taken = newest
        if navigation is not None:
            other_known, other_late, other_record = judged(other)
            swap = known & (late | (record < 0)) & other_known & ~other_late & (other_record >= 0)
            taken, record, late = (
                np.where(swap, other, newest),
                np.where(swap, other_record, record),
                late & ~swap,
            )
        needless = np.char.startswith(satellite, "S")[None, :]
        mismatch = known & (record < 0) & (navigation is not None)
        return _LongTerm(
            row=np.where(known, taken, -1),
            record=record,
            missing=~known & ~needless,
            timed_out=late & ~needless,
            mismatch=mismatch & ~needless,
        )

    def _covariance(self, time: Datetimes, number: Integers, stop: Datetimes) -> tuple[Integers, Masks]:
        """Row of the covariance in force, and where the GEO sends some and this satellite has none."""
        table, limit = self._tables.covariance, self.limits.timeout_s("covariance")
        row = table.newest.newest(number[None, :], time[:, None])
        if not len(table.time):
            return row, np.zeros(row.shape, dtype=bool)
        active = (row >= 0) & (seconds(time[:, None] - table.time[row]) <= limit) & (table.time[row] > stop)
        last = np.searchsorted(table.all_times, time, side="right") - 1
        newest = table.all_times[np.maximum(last, 0)]
        sent = (last >= 0) & (seconds(time - newest) <= limit) & (newest > stop[:, 0])
        return np.where(active, row, -1), sent[:, None] & ~active

    def delta_udre(
        self,
        time: Datetimes,
        corrections: SatelliteCorrections,
        line_of_sight: Floats,
        latitude_deg: Floats,
        longitude_deg: Floats,
    ) -> Floats:
        """Factor on sigma UDRE at a place, from the service region (type 27) or the covariance (type 28).

        Parameters
        ----------
        time : ndarray of datetime64[ns], shape (T,)
        corrections : SatelliteCorrections
            Of these epochs.
        line_of_sight : ndarray, shape (T, K, 3)
            Unit vectors from the receiver to the satellites, in the Earth-fixed frame.
        latitude_deg, longitude_deg : ndarray, shape (T,) [deg]
            Of the receiver.

        Returns
        -------
        ndarray, shape (T, K)
            1 where the GEO sends neither; NaN where the service messages are incomplete and
            incomplete data are refused.
        """
        place = self._service.factor(self.limits, time, latitude_deg, longitude_deg)
        along = delta_udre_covariance(self._tables, time, corrections.covariance, line_of_sight)
        by_place = np.isfinite(place.factor) | place.incomplete
        return np.where(by_place[:, None], place.factor[:, None], along)

    def ionosphere(
        self,
        time: Datetimes,
        latitude_deg: Floats,
        longitude_deg: Floats,
        elevation_deg: Floats,
        azimuth_deg: Floats,
    ) -> IonosphereDelays:
        """Slant delays on L1 from the grid.

        Parameters
        ----------
        time : ndarray of datetime64[ns], shape (T,)
        latitude_deg, longitude_deg : ndarray, shape (T,) [deg]
        elevation_deg, azimuth_deg : ndarray, shape (T, K) [deg]

        Returns
        -------
        IonosphereDelays
        """
        return ionosphere(
            self._grid, self._tables, self.limits, time, latitude_deg, longitude_deg, elevation_deg, azimuth_deg
        )
