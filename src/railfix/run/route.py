"""Route of a log through a network of tracks, found from the log itself, and probabilities of other tracks.

One conventional position per second is matched to the network (`railfix.track.network_match`). Positions are computed
on the most probable sequence of tracks, the route. The probabilities of other tracks near the positions are reported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, Protocol

import numpy as np
import polars as pl

from railfix.core.arrays import Datetimes, Floats, Indices, Masks, Strings, join_rows, take_rows
from railfix.core.errors import MismatchError, NoPositionError
from railfix.core.geodesy import geodetic_from_ecef
from railfix.core.nearest_times import nearest_rows
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.io.position_log import PositionLog
from railfix.pipeline.base_station_stage import BaseState, BaseStation
from railfix.pipeline.channel_book import ChannelBook
from railfix.pipeline.config import Config
from railfix.pipeline.received import known_from_start
from railfix.pipeline.without_map import locate
from railfix.run.inputs import TrackReading
from railfix.track import Track
from railfix.track.frames import in_map_frame
from railfix.track.network import UNMAPPED_PRIOR, Network
from railfix.track.network_match import Matched, PlanLog, match, plan_log
from railfix.track.network_route import find_route, left_out_note

#: Interval of the matched positions [s].
_INTERVAL_S: Final = 1.0
#: A track of the route is near a position that is on the track, or beyond an end of the track by less than this [m].
_REACH_M: Final = 50.0
#: Assumed bound on the relative difference between lengths in plan and lengths along the line. `_REACH_M` is increased
#: by this fraction of the route length.
_LENGTHS_DIFFER: Final = 1e-3
#: Minimum probability at which a track outside the route is written to the table.
_LEAST_WRITTEN: Final = 1e-4
#: Minimum probability at which a track outside the route is reported in the notes.
_LEAST_NAMED: Final = 0.01
#: Maximum number of alternatives reported in the notes; all alternatives are in ``run.json``.
_NAMED: Final = 8
#: A gap between positions that is longer than this ends an `Alternative` [s].
_TOGETHER_S: Final = 60.0
#: The log is taken to indicate an unmapped track if the track's probability exceeds this: twice the prior.
_UNMAPPED_LIMIT: Final = 2.0 * UNMAPPED_PRIOR
#: Name that results use for an unmapped track.
NONE: Final = "none"

#: Columns that position tables of a run on a network have in addition.
ON_TRACK_COLUMNS: Final[dict[str, str]] = {
    "track": "track of the network on which the position lies; the track is part of the route found from the log",
    "track_chainage_m": "distance in plan along `track` from the first point of the track to the antenna",
    "track_probability": "probability, given the whole log, that the train is on the route at this position; "
    "`tracks.csv` has the alternatives",
    "unmapped_probability": "probability, given the whole log, that the train is on a track that is not in the map",
    "unconstrained_offset_m": "offset in plan, from `track`, of the 3-D position that was computed without the map for "
    "the nearest second; positive to the right",
    "unconstrained_up_m": "height above `track` of the 3-D position computed without the map, minus the antenna height "
    "if the vehicle is known",
}
#: Columns of the table of tracks near each position.
TRACK_COLUMNS: Final[dict[str, str]] = {
    "time_gpst": "time tag of the receiver, GPS time",
    "antenna": "`front` or `rear`",
    "track": "track of the network; `none` is a track that the map does not have",
    "on_route": "whether the track belongs to the route on which the positions are computed",
    "probability": "probability of `track` given the whole log; the rows of an epoch and antenna sum to 1",
    "chainage_m": "distance in plan along the track from its first point to the point nearest to the position",
    "kilometrage_m": "kilometrage as marked on the line, at the point of `chainage_m`; null if the map has none",
    "offset_m": "distance in plan from the position, which lies on the route, to the track",
    "unconstrained_offset_m": "offset in plan, from the track, of the 3-D position computed without the map; positive "
    "to the right",
}


@dataclass(frozen=True, kw_only=True)
class Alternative:
    """Part of a log in which the train may have been on a track outside the route."""

    track: str  #: Name of the alternative track.
    instead_of: str  #: Name of the route's track in this part.
    first: np.datetime64  #: First epoch of the part, GPS time.
    last: np.datetime64
    probability: float  #: Largest probability of the alternative track in this part.

    @property
    def facts(self) -> dict[str, Any]:
        """Plain values of the alternative for JSON."""
        return {
            "track": self.track,
            "instead_of": self.instead_of,
            "first_epoch_gpst": str(self.first),
            "last_epoch_gpst": str(self.last),
            "largest_probability": round(self.probability, 6),
        }

    @property
    def sentence(self) -> str:
        """Sentence on the alternative for the notes of a run."""
        span = f"{str(self.first)[:19]} to {str(self.last)[11:19]}"
        return f"route: from {span} the train may be on {self.track} instead of {self.instead_of} " + (
            f"(probability up to {self.probability:.2f})"
        )


@dataclass(frozen=True, kw_only=True)
class RouteOfLog:
    """Route of a log through a network, with the probabilities of all tracks near the log's positions."""

    network: Network
    tracks: tuple[int, ...]  #: Indices of the route's tracks, in order.
    #: Indices of tracks of the most probable sequence that the route omits, because the train reversed on them.
    left_out: tuple[int, ...]
    log: PlanLog  #: Matched positions in the frame of the network.
    matched: Matched  #: Tracks near each matched position, with their probabilities.
    time: np.datetime64  #: Epoch at which positions are transformed to the frame of the network.
    reading: TrackReading  #: Options with which the network was read.

    @cached_property
    def probability(self) -> Floats:
        """Probability of the route at each matched position, shape (n,)."""
        return np.asarray((self.matched.probabilities * self._on_route).sum(axis=1))

    def is_uncertain(self, time: Datetimes, chainage_m: Floats, *, risk: float) -> Masks:
        """Return whether the probability that the train is not on the route exceeds `risk` at each time, shape (T,).

        The probability of the route is the sum over its tracks within `_REACH_M` of the chainage. More distant tracks
        of the route may be parallel to the train's track; they are wrong tracks at this chainage. The probability is
        computed at the matched positions before and after the time. The smaller value is used, because the train may
        change tracks between these positions. Up to `_UNMAPPED_LIMIT`, the probability of an unmapped track is no
        reason for uncertainty, because protection levels include it (`with_unmapped`).
        """
        after = np.searchsorted(self.log.time, time)
        last = len(self.log.time) - 1
        known = (
            self._share_at(k, chainage_m) + np.minimum(self.unmapped[k], _UNMAPPED_LIMIT)
            for k in (np.clip(after - 1, 0, last), np.clip(after, 0, last))
        )
        return np.asarray(np.fmin(*known) < 1.0 - risk)

    def _share_at(self, epoch: Indices, chainage_m: Floats) -> Floats:
        """Return the total probability of the route's tracks near each chainage [m], shape (T,).

        `epoch` is the index of the matched position for each chainage. If a chainage is NaN, all tracks of the route
        are included.
        """
        lengths = self.network.length_m[list(self.tracks)]
        end = np.cumsum(lengths)
        reach = _REACH_M + _LENGTHS_DIFFER * end[-1]
        along = chainage_m[:, None]
        near = ((along > end - lengths - reach) & (along < end + reach)) | np.isnan(along)
        track, share = self.matched.candidates.track[epoch], self.matched.probabilities[epoch]
        own = [np.where(track == t, share, 0.0).sum(axis=1) for t in self.tracks]
        return np.asarray((np.stack(own, axis=-1) * near).sum(axis=1))

    @cached_property
    def unmapped(self) -> Floats:
        """Probability of an unmapped track at each matched position, shape (n,)."""
        return np.asarray(np.clip(1.0 - self.matched.probabilities.sum(axis=1), 0.0, 1.0))

    def with_unmapped(self, config: Config) -> Config:
        """Return the settings with the priors of a wrong map raised to at least the probability of an unmapped track.

        The largest probability in the log is used, but at most `_UNMAPPED_LIMIT`. Above this limit, protection levels
        are infinite (`is_uncertain`).
        """
        share = float(np.clip(self.unmapped.max(), 0.0, _UNMAPPED_LIMIT))
        limits, risk, araim = config.tracking, config.risk, config.araim
        return config.replaced(
            tracking=limits.replaced(level_map_prior=max(limits.level_map_prior, share)),
            risk=risk.replaced(map_prior=max(risk.map_prior, share)),
            araim=araim.replaced(map_prior=max(araim.map_prior, share)),
        )

    @cached_property
    def _on_route(self) -> Floats:
        return np.isin(self.matched.candidates.track, self.tracks).astype(np.float64)

    @cached_property
    def alternatives(self) -> tuple[Alternative, ...]:
        """Parts of the log in which a track outside the route has at least 1 % probability, most probable first."""
        names = (*self.network.names, NONE)
        beside = np.where(self._on_route > 0.0, -1, self.matched.candidates.track)
        known, found = np.flatnonzero(np.isin(self.matched.track, self.tracks)), []
        for track in (*np.unique(beside[beside >= 0]).tolist(), -1):
            share = self.unmapped
            if track >= 0:
                share = np.where(beside == track, self.matched.probabilities, 0.0).sum(axis=1)
            rows = np.flatnonzero(share >= _LEAST_NAMED)
            apart = np.diff(self.log.time[rows]) > np.timedelta64(round(_TOGETHER_S * 1e9), "ns")
            for part in np.split(rows, np.flatnonzero(apart) + 1):
                if len(part):
                    top = int(part[np.argmax(share[part])])
                    found.append(
                        Alternative(
                            track=names[track],
                            instead_of=names[self.matched.track[known[np.argmin(np.abs(known - top))]]],
                            first=self.log.time[part[0]],
                            last=self.log.time[part[-1]],
                            probability=float(share[top]),
                        )
                    )
        return tuple(sorted(found, key=lambda item: -item.probability))

    @property
    def names(self) -> list[str]:
        """Names of the route's tracks, in order."""
        return [self.network.names[k] for k in self.tracks]

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the route and its alternatives, one sentence each."""
        low = float(self.probability.min())
        first = (
            f"route found from the log: {', '.join(self.names)}; chainage rises in this order; the probability of the "
            f"route is {self.probability.mean():.3f} on average and at least {low:.3f} (tracks.csv: all nearby tracks)"
        )
        if self.left_out:
            first += f"; {left_out_note(self.network, self.left_out)}"
        more = len(self.alternatives) - _NAMED
        rest = (f"route: {more} more stretches with alternatives are in run.json",) if more > 0 else ()
        return (*self.network.notes, first, *(a.sentence for a in self.alternatives[:_NAMED]), *rest)

    @property
    def facts(self) -> dict[str, Any]:
        """Plain values of the route for JSON."""
        return {
            "found_from": self.log.path,
            "tracks": self.names,
            "left_out": [self.network.names[k] for k in self.left_out],
            "mean_probability": round(float(self.probability.mean()), 6),
            "least_probability": round(float(self.probability.min()), 6),
            "alternatives": [alternative.facts for alternative in self.alternatives],
        }

    def on_tracks(self, table: pl.DataFrame, line: Track) -> tuple[pl.DataFrame, pl.DataFrame]:
        """Return a table of positions with `ON_TRACK_COLUMNS` added, and a table with `TRACK_COLUMNS`.

        The second table has one row for each position and each track near the position. Epochs without a position have
        no rows. `line` is the track map of the route; its sections are the tracks of the route.
        """
        chainage = table["chainage_m"].to_numpy()
        ecef = table.select("x_m", "y_m", "z_m").to_numpy()
        latitude, longitude = np.full(len(table), np.nan), np.full(len(table), np.nan)
        known = np.isfinite(chainage) & np.isfinite(ecef[:, 0])
        if known.any():
            place, _ = in_map_frame(ecef[known], self.network.frame, self.time, **self.reading.motion)
            latitude[known], longitude[known], _ = geodetic_from_ecef(place)
        ends = line.chainage_m[np.flatnonzero(np.diff(line.section))]
        number = np.where(known, np.array(self.tracks)[np.searchsorted(ends, np.nan_to_num(chainage))], -1)
        along, _ = self.network.place_on(number, latitude, longitude)
        epoch = nearest_rows(self.log.time, table["time_gpst"].to_numpy(), within_ns=np.iinfo(np.int64).max)
        share = np.where(known, self.probability[epoch], np.nan)
        names: Strings = np.array([*self.network.names, None], dtype=object)
        positions = table.with_columns(
            pl.Series("track", names[number].tolist(), dtype=pl.String),
            pl.Series("track_chainage_m", along, nan_to_null=True),
            pl.Series("track_probability", share, nan_to_null=True),
            pl.Series("unmapped_probability", np.where(known, self.unmapped[epoch], np.nan), nan_to_null=True),
            *self._unconstrained(epoch, number),
        )
        candidates, probability = self.matched.candidates.track[epoch], self.matched.probabilities[epoch]
        beside = np.where(self._on_route[epoch] > 0.0, -1, candidates)
        rows, column = np.nonzero(known[:, None] & (beside >= 0) & (probability >= _LEAST_WRITTEN))
        own, off = np.flatnonzero(known), np.flatnonzero(known & (self.unmapped[epoch] >= _LEAST_WRITTEN))
        row = np.concatenate([own, rows, off])
        track = np.concatenate([number[own], beside[rows, column], np.full(len(off), -1)])
        at, offset = self.network.place_on(track, latitude[row], longitude[row])
        long = (
            table[row]
            .select("time_gpst", "antenna")
            .with_columns(
                pl.Series("track", np.where(track < 0, NONE, names[track]).tolist(), dtype=pl.String),
                pl.Series("on_route", np.arange(len(row)) < len(own)),
                pl.Series(
                    "probability", np.concatenate([share[own], probability[rows, column], self.unmapped[epoch][off]])
                ),
                pl.Series("chainage_m", at, nan_to_null=True),
                pl.Series("kilometrage_m", self.network.kilometrage_on(track, at), nan_to_null=True),
                pl.Series("offset_m", offset, nan_to_null=True),
                self._unconstrained(epoch[row], track)[0],
            )
        )
        order = np.lexsort((-long["probability"].to_numpy(), row))
        return positions, long[order]

    def _unconstrained(self, epoch: Indices, track: Indices) -> tuple[pl.Series, pl.Series]:
        """Return the offsets and heights [m] of matched positions relative to tracks, shape (n,) each.

        `epoch` and `track` are indices. A value is null if the track is not among the position's candidate tracks.
        """
        near = self.matched.candidates
        same = (near.track[epoch] == track[:, None]) & (track >= 0)[:, None]
        column = same.argmax(axis=1)
        offset, up = (np.full(len(track), np.nan) for _ in range(2))
        rows = np.flatnonzero(same.any(axis=1))
        offset[rows] = near.offset_m[epoch[rows], column[rows]]
        _, _, height = self.network.course_on(track[rows], near.chainage_m[epoch[rows], column[rows]])
        if self.log.height_m is not None:
            up[rows] = self.log.height_m[epoch[rows]] - height - (self.log.antenna_up_m or 0.0)
        return (
            pl.Series("unconstrained_offset_m", offset, nan_to_null=True),
            pl.Series("unconstrained_up_m", up, nan_to_null=True),
        )


class BaseObservations(Protocol):
    """Observations of a base station in order of time (`railfix.run.processor_setup.BaseLog`)."""

    ecef_m: Floats  #: Station position, ECEF, shape (3,) [m].

    def until(self, time: np.datetime64) -> Observations | None:
        """Return the epochs up to `time` that have not been returned before, or None if there are none."""


@dataclass(frozen=True, kw_only=True)
class LogPositions:
    """Conventional positions of a log, one per second, from which the route through a network is found."""

    path: str  #: Name of the log in messages.
    parts: Callable[[], Iterable[Observations]]  #: Function that returns the log in pieces, in order of time.
    navigation: Navigation
    config: Config
    time: np.datetime64 | None  #: Epoch at which positions are transformed to the map frame, or None if unknown.
    reading: TrackReading
    antenna_up_m: float | None = None  #: Antenna height above the rails [m]; None without a vehicle file.
    #: Function that opens the base-station log; it returns None if there is no base station.
    open_base: Callable[[], BaseObservations | None] = lambda: None

    @cached_property
    def positions(self) -> PositionLog:
        """Positions of the log, with quality 5 (single), or with quality 4 (DGPS) if there is a base station.

        Raise NoPositionError if the log has no position.
        """
        received, book = known_from_start(self.config, navigation=self.navigation), ChannelBook(self.config)
        base, state, located = self.open_base(), BaseState(), []
        station = None if base is None else BaseStation(self.config, base.ecef_m)
        for part in self.parts():
            if base is not None and station is not None:
                state = station.add_observations(base.until(part.time[-1]), received, state, part.time[0])
                received = state.beside(received)
            seconds = np.diff(part.time) / np.timedelta64(1, "s")
            step = max(1, round(_INTERVAL_S / float(np.median(seconds)))) if len(seconds) else 1
            located.append(locate(part[::step], received, self.config, book))
        known = [take_rows(part, np.isfinite(part.ecef_m[:, 0])) for part in located]
        if not (count := sum(len(part.time) for part in known)):
            raise NoPositionError(f"{self.path}: the log has no position, so that its line cannot be found")
        placed = join_rows(known)
        return PositionLog(
            path=self.path, time=placed.time, ecef_m=placed.ecef_m, quality=np.full(count, 5 if base is None else 4),
            sigma_m=placed.sigma_m,
            line=np.arange(count),
        )  # fmt: skip

    def route(self, network: Network) -> RouteOfLog:
        """Find the route of the log through a network.

        Raise MismatchError if there is no route or no navigation record.
        """
        if self.time is None:
            raise MismatchError("there is no navigation record, so that no route through the network can be found")
        of_antenna = plan_log(self.positions, antenna_up_m=self.antenna_up_m)
        positions, _ = of_antenna.transform_to(network, **self.reading.motion)
        matched = match(network, positions)
        used = np.flatnonzero(np.isfinite(matched.probability))
        positions, matched = positions.take(used), matched.take(used)
        tracks, left_out = find_route(network, matched, self.path)
        return RouteOfLog(
            network=network,
            tracks=tuple(tracks),
            left_out=tuple(left_out),
            log=positions,
            matched=matched,
            time=self.time,
            reading=self.reading,
        )
