"""Fixes of three reference receivers from the same satellites, computed from logs or streams."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Final

import numpy as np
import polars as pl

from railfix.core.arrays import Bits, Datetimes, Floats, FrozenArrays, Indices, Integers, Masks, kernel_array
from railfix.core.errors import MismatchError, SettingsError
from railfix.core.geodesy import axes_at
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.gnss.orbits import SatelliteStates, satellite_states
from railfix.io import read_navigation, read_observations, read_positions
from railfix.io.position_log import PositionLog
from railfix.live.settings import LiveSettings
from railfix.live.stream import ReceivedData, arrivals, fresh_state, next_arrival
from railfix.pipeline.channel_book import ChannelBook
from railfix.pipeline.config import Config
from railfix.pipeline.received import Received as Known
from railfix.pipeline.received import known_from_start, receive
from railfix.positioning.normal_equations import point_position
from railfix.positioning.range_arrays import FILLER_SATELLITE_M, Ranges
from railfix.ranges.atmosphere import SeenFrom, model_delays
from railfix.ranges.channels import PLAUSIBLE_CODE_M, clock_groups
from railfix.ranges.range_sigma import code_sigma_m
from railfix.run.processor_setup import parse_position

#: The C/N0 of a receiver has fallen if its mean is more than this below the median over preceding epochs [dB-Hz].
FALLEN_DBHZ = 6.0
#: Largest number of preceding epochs over which the median of the mean C/N0 is computed.
USUAL_EPOCHS: Final = 600
#: Time tags of different receivers that round to the same multiple of this interval belong to one epoch.
SAME_EPOCH = np.timedelta64(100, "ms")


@dataclass(frozen=True, kw_only=True)
class StationFixes(FrozenArrays):
    """Single point positions of N receivers at T epochs.

    If the fixes are computed by this module, all receivers use the same satellites and weights at each epoch.
    """

    time: Datetimes  #: Epochs common to all logs, rounded to 0.1 s; shape (T,).
    points_m: Floats  #: East and north coordinates of the known points relative to the first point [m]; shape (N, 2).
    #: East and north coordinates of the fixes relative to the first known point [m], NaN if too few satellites are
    #: common to the receivers; shape (T, N, 2).
    fixes_m: Floats
    n_satellites: Integers  #: Number of satellites common to all receivers, 0 if unknown; shape (T,).
    cn0_fallen: Masks  #: Whether the mean C/N0 of a receiver has fallen; shape (T, N).


def station_fixes(logs: list[Observations], points_ecef_m: Floats, navigation: Navigation) -> StationFixes:
    """Compute the fixes of a triangle's receivers with the default settings of `railfix run`.

    Parameters
    ----------
    logs : list of Observations, length N
    points_ecef_m : ndarray, shape (N, 3) [m]
        Known positions of the antennas.
    navigation : Navigation

    Raises
    ------
    MismatchError
        The logs have no epoch in common, or no satellite with the same signal.
    """
    config = Config()
    book = ChannelBook(config)
    channels = [book.of(log, navigation) for log in logs]
    names = [list(zip(c.satellite.tolist(), c.signal.tolist(), strict=True)) for c in channels]
    common = [name for name in names[0] if all(name in other for other in names[1:])]
    common = list({satellite: (satellite, signal) for satellite, signal in reversed(common)}.values())[::-1]
    if not common:
        raise MismatchError("no satellite has the same signal in all logs; record the same signals with all receivers")
    time, rows_of = _common_epochs([log.time for log in logs])
    tags = np.stack([log.time[rows] for log, rows in zip(logs, rows_of, strict=True)])
    satellite, signal = (np.array(column) for column in zip(*common, strict=True))
    shape = (len(logs), len(time), len(common))
    code, cn0 = np.empty((2, *shape))
    level = np.stack([mean_cn0(log)[rows] for log, rows in zip(logs, rows_of, strict=True)], axis=1)
    for k, (log, chosen, known) in enumerate(zip(logs, channels, names, strict=True)):
        cells = np.ix_(rows_of[k], chosen.columns[[known.index(name) for name in common]])
        code[k], cn0[k] = log.code_m[cells], log.cn0_dbhz[cells]
    frequency = channels[0].frequency_hz[[names[0].index(name) for name in common]]
    klobuchar = known_from_start(config, navigation=navigation).klobuchar
    corrected, sigma, usable, states_of = np.empty(shape), np.empty(shape), np.empty(shape, bool), []
    for k, point in enumerate(points_ecef_m):
        states = satellite_states(tags[k], satellite, signal, code[k], navigation, max_age_s=config.max_ephemeris_age_s)
        seen = SeenFrom.of(np.broadcast_to(point, (len(time), 3)), states.position_ecef_m)
        delays = model_delays(tags[k], seen, frequency, klobuchar=klobuchar, troposphere=config.troposphere)
        clean = code[k] + states.clock_m - states.group_delay_m - delays.ionosphere_m - delays.troposphere_m
        corrected[k], sigma[k] = clean, code_sigma_m(cn0[k], seen.elevation_deg, noise=config.noise)
        plausible = (code[k] > PLAUSIBLE_CODE_M[0]) & (code[k] < PLAUSIBLE_CODE_M[1])
        bad = states.no_record | states.too_old | states.unhealthy | (seen.elevation_deg < config.elevation.mask_deg)
        usable[k] = plausible & ~bad & np.isfinite(clean) & np.isfinite(sigma[k])
        states_of.append(states)
    shared = usable.all(axis=0)
    # all receivers use the same weights: with different weights, an error common to all would move each fix differently
    square = np.where(usable, sigma**2, 0.0).sum(axis=0) / np.maximum(usable.sum(axis=0), 1)
    common_sigma = np.sqrt(np.where(square > 0.0, square, 1.0))
    groups = clock_groups([name[0] for name in satellite.tolist()])
    ranges = [
        usable_ranges(states, corrected[k], 1.0 / common_sigma**2, np.where(usable[k] & shared, 0, 1), groups)
        for k, states in enumerate(states_of)
    ]
    return fixes_of_ranges(time, ranges, points_ecef_m, cn0_fallen=fallen_cn0(level, level[:0]))


def fixes_of_ranges(time: Datetimes, ranges: list[Ranges], points_ecef_m: Floats, *, cn0_fallen: Masks) -> StationFixes:
    """Compute single point positions from corrected ranges to the same satellites.

    `ranges` contains the ranges of each of N receivers at the T times of `time`. The shape of `points_ecef_m` is (N,
    3), and the shape of `cn0_fallen` is (T, N).
    """
    plane = axes_at(points_ecef_m[0])[:2]
    fixes = [
        point_position(item, np.broadcast_to(point, (len(time), 3))).ecef_m
        for item, point in zip(ranges, points_ecef_m, strict=True)
    ]
    return StationFixes(
        time=time,
        points_m=(points_ecef_m - points_ecef_m[0]) @ plane.T,
        fixes_m=(np.stack(fixes, axis=1) - points_ecef_m[0]) @ plane.T,
        n_satellites=np.stack([item.n_used for item in ranges]).max(axis=0),
        cn0_fallen=cn0_fallen,
    )


def read_fixes(logs: Sequence[str], nav: Sequence[Path], points: Sequence[str], *, computed: bool) -> StationFixes:
    """Return the fixes of three receivers: positions in the logs if `computed`, else computed from observations.

    `points` are the known points as strings, one per log; without `points`, the positions in the headers of the logs
    are used. Raise SettingsError if navigation files or points are required but missing, or if navigation files are
    given with `computed`. Raise MismatchError if a header has no position, or the logs have no satellite or no epoch in
    common.
    """
    known = np.array([parse_position(text, "--point") for text in points])
    if computed:
        if nav:
            raise SettingsError("--nav cannot be used with --fixes: the positions in the logs are used as they are")
        if not len(known):
            raise SettingsError(
                "--point is missing: logs of positions contain no known points; give it for each receiver"
            )
        return fixes_of_positions([read_positions(path) for path in logs], known)
    if not nav:
        raise SettingsError("--nav is missing: logs need navigation files")
    observations = [read_observations(path) for path in logs]
    if not len(known):
        known = np.stack([log.header.approximate_ecef_m for log in observations])
        for log, point in zip(logs, known, strict=True):
            if not np.isfinite(point).all():
                raise MismatchError(f"{log}: the header has no position; give the known points with --point")
    return station_fixes(observations, known, read_navigation(nav))


def fixes_of_positions(logs: Sequence[PositionLog], points_ecef_m: Floats) -> StationFixes:
    """Return the fixes in logs of other programs or services (RTK, PPP-RTK). There is one log for each receiver.

    `n_satellites` is 0, because it is unknown whether the receivers used the same satellites. Raise MismatchError if
    the logs have no epoch in common.
    """
    known = [np.flatnonzero(np.isfinite(log.ecef_m[:, 0]) & ~np.isnat(log.time)) for log in logs]
    time, rows_of = _common_epochs([log.time[rows] for log, rows in zip(logs, known, strict=True)])
    places = [log.ecef_m[rows[common]] for log, rows, common in zip(logs, known, rows_of, strict=True)]
    plane = axes_at(points_ecef_m[0])[:2]
    fixes = (np.stack(places, axis=1) - points_ecef_m[0]) @ plane.T
    return replace(no_fixes(time, points_ecef_m), fixes_m=fixes)


def _common_epochs(times: Sequence[Datetimes]) -> tuple[Datetimes, list[Indices]]:
    """Return the rounded epochs common to all logs, and the rows of these epochs in each log.

    Raise MismatchError if the logs have no epoch in common.
    """
    epochs = [round_tags(time) for time in times]
    common = reduce(np.intersect1d, epochs)
    if not len(common):
        raise MismatchError("the logs have no epoch in common; provide logs of the same time")
    return common, [np.searchsorted(epoch, common) for epoch in epochs]


def no_fixes(time: Datetimes, points_ecef_m: Floats) -> StationFixes:
    """Return `StationFixes` for epochs at which no receiver has a fix."""
    shape = (len(time), len(points_ecef_m))
    return StationFixes(
        time=time,
        points_m=(points_ecef_m - points_ecef_m[0]) @ axes_at(points_ecef_m[0])[:2].T,
        fixes_m=np.full((*shape, 2), np.nan),
        n_satellites=np.zeros(len(time), dtype=np.int64),
        cn0_fallen=np.zeros(shape, dtype=bool),
    )


def round_tags(time: Datetimes) -> Datetimes:
    """Return time tags rounded to `SAME_EPOCH`, shape (T,)."""
    step = SAME_EPOCH.astype("timedelta64[ns]").astype(np.int64)
    rounded = (time.astype("datetime64[ns]").astype(np.int64) + step // 2) // step * step
    return np.asarray(rounded.astype("datetime64[ns]"))


def mean_cn0(log: Observations) -> Floats:
    """Return the mean C/N0 of a receiver's observations at each epoch, shape (T,) [dB-Hz]; 0 without a C/N0."""
    seen = np.isfinite(log.cn0_dbhz)
    return np.asarray(np.where(seen, log.cn0_dbhz, 0.0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1))


def fallen_cn0(level_dbhz: Floats, earlier_dbhz: Floats) -> Masks:
    """Return whether the mean C/N0 of each receiver has fallen by more than `FALLEN_DBHZ`, shape (T, N).

    The mean C/N0 `level_dbhz`, shape (T, N), is compared with the median over the `USUAL_EPOCHS` preceding epochs.
    `earlier_dbhz`, shape (M, N), precedes `level_dbhz`.
    """
    table = pl.DataFrame(np.vstack([earlier_dbhz, level_dbhz])).fill_nan(None)
    usual = table.select(pl.all().rolling_median(USUAL_EPOCHS, min_samples=1).shift(1)).to_numpy()
    return np.asarray(level_dbhz < usual[len(earlier_dbhz) :] - FALLEN_DBHZ)


#: Largest number of epochs that wait until every receiver has sent them; if more wait, the oldest is dropped.
_LONGEST_QUEUE: Final = 1000


class StationStreams:
    """Fixes of receivers at known points, computed from epochs as they arrive.

    An epoch is used once every receiver has sent it; older epochs that still wait are then dropped. If a receiver is
    silent, no fixes are computed, and the monitor detects that fixes are late. Navigation data from the streams are
    added to `navigation`. Only epochs at whole seconds are used. `counts` contains the number of epochs by outcome:
    "used", "incomplete" or "without common satellites".
    """

    def __init__(self, points_ecef_m: Floats, *, navigation: Navigation | None = None) -> None:
        self.counts: Counter[str] = Counter()
        self._points, self._config = points_ecef_m, Config()
        self._known: Known = known_from_start(self._config, navigation=navigation)
        self._waiting: dict[np.datetime64, dict[int, Observations]] = {}
        self._done = np.datetime64("1980-01-06", "ns")
        self._levels = np.empty((0, len(points_ecef_m)))

    def add_navigation(self, navigation: Navigation) -> None:
        """Add navigation records."""
        self._known = receive(self._known, self._config, np.datetime64("NaT", "ns"), navigation=navigation)

    def push(self, receiver: int, epoch: Observations) -> StationFixes | None:
        """Process one epoch of a receiver; return the fixes if all receivers have sent this epoch, otherwise None."""
        tag = round_tags(epoch.time)[0]
        tag_ns = int(tag.astype(np.int64))
        if tag_ns % 1_000_000_000 or tag <= self._done:
            return None
        for later, epochs in list(self._waiting.items()):
            # drop the receiver's later epochs; if their tags are wrong, they crowd other epochs out of the queue
            if later > tag and epochs.pop(receiver, None) is not None and not epochs:
                del self._waiting[later]
        together = self._waiting.setdefault(tag, {})
        together[receiver] = epoch
        if len(together) < len(self._points):
            if len(self._waiting) > _LONGEST_QUEUE:
                del self._waiting[min(self._waiting)]
                self.counts["incomplete"] += 1
            return None
        self.counts["incomplete"] += sum(older < tag for older in self._waiting)
        self._waiting = {later: epochs for later, epochs in self._waiting.items() if later > tag}
        self._done = tag
        return self._fixes(tag, [together[k] for k in range(len(self._points))])

    def _fixes(self, tag: np.datetime64, epochs: list[Observations]) -> StationFixes:
        level = np.stack([mean_cn0(epoch) for epoch in epochs], axis=1)
        fallen = fallen_cn0(level, self._levels)
        self._levels = np.vstack([self._levels, level])[-USUAL_EPOCHS:]
        try:
            fixes = station_fixes(epochs, self._points, self._known.navigation)
            self.counts["used"] += 1
        except MismatchError:
            self.counts["without common satellites"] += 1
            fixes = no_fixes(np.array([tag]), self._points)
        return replace(fixes, cn0_fallen=fallen)


async def stream_fixes(
    sources: Sequence[str], points_ecef_m: Floats, *, navigation: Navigation | None = None
) -> AsyncIterator[StationFixes]:
    """Yield the fixes epoch by epoch; end when all sources have ended.

    Sources are written as for ``railfix live`` (``tcp://HOST:PORT``, ``ntrip://``, ``serial:``, receiver files and
    RINEX files). Raise InputFileError if a source cannot be opened, or fails and cannot be opened again.
    """
    stations = StationStreams(points_ecef_m, navigation=navigation)
    queue: asyncio.Queue[tuple[int, ReceivedData | None]] = asyncio.Queue(2 * len(sources))

    async def pump(receiver: int, source: str) -> None:
        async for item in arrivals(source, fresh_state(source), LiveSettings()):
            if isinstance(item, ReceivedData):
                await queue.put((receiver, item))
        await queue.put((receiver, None))

    pumps = [asyncio.create_task(pump(k, source)) for k, source in enumerate(sources)]
    running = len(pumps)
    try:
        while running:
            arrived = await next_arrival(queue, pumps)
            for task in pumps:
                if task.done():
                    task.result()  # an error of a source ends the session
            if arrived is None:
                continue
            receiver, received = arrived
            if received is None:
                running -= 1
                continue
            if received.navigation is not None:
                stations.add_navigation(received.navigation)
            for epoch in received.epochs:
                if (fixes := stations.push(receiver, epoch)) is not None:
                    yield fixes
    finally:
        for task in pumps:
            task.cancel()
        await asyncio.gather(*pumps, return_exceptions=True)


def usable_ranges(
    states: SatelliteStates, code: Floats, weight: Floats, reason: Bits, groups: tuple[slice, ...]
) -> Ranges:
    """Return the ranges for the fit; rejected ranges and ranges that are NaN have weight 0 and finite filler values."""
    used = (reason == 0) & np.isfinite(code) & np.isfinite(weight)
    return Ranges(
        sat_ecef_m=kernel_array(np.where(used[..., None], states.position_ecef_m, FILLER_SATELLITE_M)),
        code_m=kernel_array(np.where(used, code, 0.0)),
        weight=kernel_array(np.where(used, weight, 0.0)),
        groups=groups,
    )
