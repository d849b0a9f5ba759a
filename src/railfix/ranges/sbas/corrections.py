"""SBAS corrections for any epochs, computed from the messages of one GEO (DO-229D, A.4.4 and A.4.5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, Literal

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Integers, Masks, Strings
from railfix.core.timescale import seconds
from railfix.gnss.navigation import Navigation
from railfix.ranges.sbas.ionosphere import GridTables, ionosphere
from railfix.ranges.sbas.limits import SbasLimits
from railfix.ranges.sbas.messages import SbasMessages
from railfix.ranges.sbas.satellites import (
    FastInForce,
    Growth,
    LongTermInForce,
    ServiceTable,
    covariance_in_force,
    delta_udre_covariance,
    fast_in_force,
    growth,
    long_term_in_force,
)
from railfix.ranges.sbas.standard import (
    DO_NOT_USE,
    INFLATION_M,
    NOT_MONITORED,
    STOP_S,
    UDRE_VARIANCE_M2,
    IonosphereDelays,
    SatelliteCorrections,
    SatelliteState,
    first_that_holds,
    mask_satellite,
    system_name,
)
from railfix.ranges.sbas.tables import SatelliteTables

_NUMBER_OF: Final = {mask_satellite(number): number for number in range(1, 211) if mask_satellite(number)}
_SIGMA_UDRE: Final = np.sqrt(np.array([*UDRE_VARIANCE_M2, np.nan, np.nan, np.nan]))


def best_prn(messages: SbasMessages, limits: SbasLimits | None = None) -> tuple[int, str]:
    """Return the PRN with the largest number of usable fast corrections (of several, the smallest PRN), and a note.

    The choice depends on all messages of a log, and must be made before positioning begins. For live messages, the PRN
    must therefore be specified.
    """
    limits, scores = limits or SbasLimits(), []
    for number in messages.prns:
        fast = SatelliteTables(messages.of(number), limits).fast
        monitored = np.zeros(0) if fast.empty else fast.series[fast["udrei"] < NOT_MONITORED]
        scores.append((-len(monitored), number, len(np.unique(monitored))))
    ordered = sorted(scores)
    listed = "; ".join(
        f"{system_name(number)} {number}: {-usable} of {satellites} satellites"
        for usable, number, satellites in ordered
    )
    return ordered[0][1], f"best SBAS PRN by usable fast corrections: {ordered[0][1]} ({listed})"


class SbasCorrections:
    """SBAS corrections for any epochs, computed from the messages of one GEO; the tables are built once, then searched.

    A message is used from its time of reception on (`SbasMessages.time`), never before. Results are independent of the
    other epochs and satellites of a call, and of messages received later. Messages of other PRNs than `prn` are left
    out. The attribute `notes` begins with the notes given as argument.
    """

    def __init__(
        self, messages: SbasMessages, *, prn: int, limits: SbasLimits | None = None, notes: Sequence[str] = ()
    ) -> None:
        self.prn, self.limits = prn, limits or SbasLimits()
        of_prn = messages.of(prn)
        never = np.datetime64("NaT", "ns")
        #: Reception times of the GEO's first and last message; NaT without messages.
        self.span: tuple[np.datetime64, np.datetime64] = (
            (of_prn.time.min(), of_prn.time.max()) if len(of_prn) else (never, never)
        )
        self._tables = SatelliteTables(of_prn, self.limits)
        self._grid = GridTables(of_prn, self.limits, self._tables.stops)
        self._service = ServiceTable(of_prn, self.limits)
        #: How many corrections were not used, by kind and reason.
        self.unused: Mapping[str, int] = {
            kind: number for kind, number in sorted((self._tables.unused + self._grid.unused).items()) if number
        }
        #: Notes on the messages and on the corrections; after `from_log`, also on unused corrections.
        self.notes: tuple[str, ...] = (*notes, self._settings_note())

    @classmethod
    def from_log(
        cls, messages: SbasMessages, *, prn: int | Literal["best"] = "best", limits: SbasLimits | None = None
    ) -> SbasCorrections:
        """Return corrections from the requested PRN or `best_prn`; ValueError if the PRN has no messages."""
        prn, choice = best_prn(messages, limits) if prn == "best" else (prn, messages.describe_choice(prn))
        corrections = cls(messages, prn=prn, limits=limits, notes=(*messages.notes, choice))
        corrections.notes += tuple(corrections._leave_out(messages.of(prn)))
        return corrections

    def _settings_note(self) -> str:
        limits = self.limits
        return (
            f"SBAS corrections of {system_name(self.prn)} PRN {self.prn}: mode {limits.mode.replace('_', ' ')}, "
            f"UDREI up to {limits.largest_udrei}, messages of type 0: {limits.type0.replace('_', ' ')}, range rates: "
            f"{limits.range_rate}, satellites without degradation data: {limits.incomplete}"
        )

    def _leave_out(self, messages: SbasMessages) -> list[str]:
        """Return notes on the messages of type 0 and on the unused corrections of a whole log."""
        notes = []
        zeros = int((messages.type == 0).sum())
        if zeros:
            used = "read as type 2" if self.limits.type0 == "as_type2" else "after each, the GEO was not used for 60 s"
            notes.append(f"PRN {self.prn} sent {zeros} messages of type 0 (do not use for safety): {used}")
        notes += [f"PRN {self.prn}: {number} {kind}, not used" for kind, number in self.unused.items()]
        return notes

    def satellites(
        self, time: Datetimes, satellite: Strings, navigation: Navigation | None = None
    ) -> SatelliteCorrections:
        """Return the fast and long-term corrections for T epochs and K satellites.

        The state of satellites outside the mask is NOT_IN_MASK. A long-term correction is applied only if `navigation`
        has a record with the same issue of data; otherwise the latest earlier correction with a different issue is
        tried. Without navigation data, the newest correction is applied unchecked.
        """
        number = np.array([_NUMBER_OF.get(str(name), -1) for name in satellite], dtype=np.int64)
        tables, limits, at = self._tables, self.limits, time[:, None]
        stop = tables.stops.last(time)[:, None]
        fast = fast_in_force(tables, limits, at, number[None, :], stop)
        long = long_term_in_force(tables, limits, time, satellite, number, stop, navigation)
        has_mask, in_mask = tables.masks.holds(number, time)
        grown = growth(tables, limits, at, fast, long.row, stop)
        covariance, lacks_covariance = covariance_in_force(tables, limits, time, number, stop)
        incomplete = fast.no_factor | grown.missing | lacks_covariance
        state = first_that_holds(
            [
                (seconds(at - stop) < STOP_S, SatelliteState.GEO_STOPPED),
                (~has_mask[:, None] & np.ones(len(number), dtype=bool), SatelliteState.NO_MASK),
                (~in_mask, SatelliteState.NOT_IN_MASK),
                (fast.missing, SatelliteState.NO_FAST),
                (fast.udrei == DO_NOT_USE, SatelliteState.DO_NOT_USE),
                (fast.udrei == NOT_MONITORED, SatelliteState.NOT_MONITORED),
                (fast.timed_out | long.timed_out, SatelliteState.TIMED_OUT),
                (fast.udrei > limits.largest_udrei, SatelliteState.UDREI_TOO_LARGE),
                (long.missing, SatelliteState.NO_LONG_TERM),
                (long.mismatch, SatelliteState.IODE_MISMATCH),
                (incomplete & (limits.incomplete == "reject"), SatelliteState.NO_DEGRADATION),
                (fast.no_rate, SatelliteState.NO_RANGE_RATE),
            ],
            SatelliteState.OK,
        )
        return self._assemble(time, state, fast, long, grown, incomplete, covariance)

    def _assemble(
        self,
        time: Datetimes,
        state: Integers,
        fast: FastInForce,
        long: LongTermInForce,
        grown: Growth,
        inflated: Masks,
        covariance: Integers,
    ) -> SatelliteCorrections:
        """Combine the fast, long-term and degradation terms; values are NaN where the state is not OK."""
        used = state == SatelliteState.OK
        table = self._tables.long_term
        has = used & (long.row >= 0)
        position, clock = np.zeros((*state.shape, 3)), np.zeros(state.shape)
        t, k = np.nonzero(has)
        row = long.row[t, k]
        since = np.nan_to_num(seconds(time[t] - table["reference"][row]))
        position[t, k] = table["position_m"][row] + table["velocity_mps"][row] * since[:, None]
        clock[t, k] = table["clock_s"][row] + table["clock_rate"][row] * since
        iode = np.full(state.shape, -1, dtype=np.int64)
        known = long.row >= 0
        iode[known] = table["iode"][long.row[known]]

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

    def delta_udre(
        self,
        time: Datetimes,
        corrections: SatelliteCorrections,
        line_of_sight: Floats,
        latitude_deg: Floats,
        longitude_deg: Floats,
    ) -> Floats:
        """Return the factor on sigma UDRE from service regions (type 27) or covariances (type 28), shape (T, K).

        `corrections` are the corrections at these epochs; `line_of_sight`, shape (T, K, 3), has unit vectors to the
        satellites in the Earth-fixed frame; the receiver coordinates have shape (T,). The factor is 1 where the GEO
        sends neither type 27 nor 28, and NaN where service messages are incomplete and incomplete data are rejected.
        """
        factor, incomplete = self._service.factor(time, latitude_deg, longitude_deg)
        along = delta_udre_covariance(self._tables, time, corrections.covariance, line_of_sight)
        by_place = np.isfinite(factor) | incomplete
        return np.where(by_place[:, None], factor[:, None], along)

    def ionosphere(
        self, time: Datetimes, latitude_deg: Floats, longitude_deg: Floats, elevation_deg: Floats, azimuth_deg: Floats
    ) -> IonosphereDelays:
        """Return slant delays on L1 from the grid, for positions (T,) and directions to satellites (T, K)."""
        return ionosphere(
            self._grid, self._tables, self.limits, time, latitude_deg, longitude_deg, elevation_deg, azimuth_deg
        )
