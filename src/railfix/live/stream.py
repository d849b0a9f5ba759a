"""Decoding of a source's data as they arrive: epochs, navigation records, SBAS messages and sensor samples.

Samples of a sensor arrive as lines, which are the rows of a CSV table. The first line contains the names of the
columns, as in the tables of ``railfix run``; this line may be repeated after a break of the connection. A row that
contains only the time reports that nothing was measured up to this time, for example by a tachometer at standstill.

`Lag` measures how far a session is behind the receivers, and selects the epochs to be skipped if the delay is too long.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, TypeVar

import numpy as np

from railfix.core.arrays import Bytes, Indices
from railfix.core.errors import InputFileError
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.io.file_kind import find_kind
from railfix.io.receiver import rtcm, sbf, ubx
from railfix.io.receiver.ephemerides import assemble_navigation
from railfix.io.receiver.framing import SbasFrames, find_frames
from railfix.io.receiver.log import StreamState, at_station, decode
from railfix.io.receiver.measurements import Tracking, join_observations
from railfix.io.rinex import scan_observations
from railfix.io.sensor_tables import COLUMNS
from railfix.live.settings import LiveSettings
from railfix.live.sources import Connected, Lost, Place, is_file, read_source
from railfix.motion.samples import GroundUnits, SensorSamples
from railfix.run.sensors import make_samples


@dataclass(frozen=True, kw_only=True)
class ReceiverState:
    """State of the decoder of a receiver's stream after the bytes received so far."""

    stream: StreamState = field(default_factory=StreamState)
    tracking: Tracking = field(default_factory=Tracking)

    def after_break(self) -> ReceiverState:
        """Return the state after a break of the connection, without the beginning of an incomplete frame."""
        return replace(self, stream=replace(self.stream, rest=b""))


@dataclass(frozen=True, kw_only=True)
class ReceivedData:
    """Epochs, records and messages completed by a chunk of a receiver's bytes, and counts of skipped data."""

    epochs: tuple[Observations, ...]  #: Observations, one object per epoch, with the channels observed in the epoch.
    navigation: Navigation | None = None
    sbas: SbasFrames | None = None
    skipped_bytes: int = 0
    bad_checksums: int = 0
    passed_over: dict[str, int] = field(default_factory=dict)
    after: ReceiverState = field(default_factory=ReceiverState)  #: State of the decoder after these bytes.


def receive_bytes(data: bytes, state: ReceiverState) -> Iterator[ReceivedData]:
    """Yield the data completed by a chunk of a receiver's bytes, in the order of the stream.

    The data do not depend on the boundaries of chunks.

    Each item covers the bytes up to a message that completes an epoch, or up to the end of the chunk. Navigation
    records received before an epoch are thus used for the epoch. At least one item is yielded; the state for the next
    chunk is `ReceivedData.after` of the last item. Epochs with repeated or older time tags are included;
    `LiveEngine.push` drops them.
    """
    kept = len(state.stream.rest)
    ends = epoch_ends(np.frombuffer(state.stream.rest + data, dtype=np.uint8)) - kept
    place = 0
    for end in [*np.unique(ends[(ends > 0) & (ends < len(data))]).tolist(), len(data)]:
        item = _receive(data[place:end], state)
        place, state = end, item.after
        yield item


def epoch_ends(buffer: Bytes) -> Indices:
    """Return the offsets of the ends of messages that complete an epoch: RXM-RAWX, MeasEpoch, last MSM of an epoch."""
    frames = find_frames(buffer, at_end=False)
    raw, msm = frames.of("ubx", ubx.RXM_RAWX), frames.of("rtcm3", *rtcm.MSM_NUMBERS)
    last = msm[rtcm.completes_epoch(frames, msm)]
    return np.sort(
        np.concatenate([frames.end[raw] + 2, frames.end[frames.of("sbf", sbf.MEAS_EPOCH)], frames.end[last] + 3])
    )


def _receive(data: bytes, state: ReceiverState) -> ReceivedData:
    piece, stream = decode(data, state.stream)
    observations, tracking = join_observations(
        piece.measurements, replace(state.tracking, last=np.datetime64("NaT", "ns"))
    )
    records = piece.ephemerides
    return ReceivedData(
        epochs=single_epochs(at_station(observations, piece.station)),
        navigation=assemble_navigation(records) if records.records or records.klobuchar else None,
        sbas=piece.sbas if len(piece.sbas) else None,
        skipped_bytes=piece.skipped_bytes,
        bad_checksums=piece.bad_checksums,
        passed_over={**observations.skipped, **records.skipped},
        after=ReceiverState(stream=stream, tracking=tracking),
    )


def single_epochs(observations: Observations) -> tuple[Observations, ...]:
    """Return the observations of each epoch separately, with the channels that have a value in the epoch."""
    epochs = []
    for k in range(len(observations)):
        part = observations[k : k + 1]
        seen = np.isfinite(part.code_m[0]) | np.isfinite(part.phase_cycles[0]) | np.isfinite(part.cn0_dbhz[0])
        names = ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock")
        epochs.append(
            replace(
                part,
                satellite=part.satellite[seen],
                signal=part.signal[seen],
                **{name: getattr(part, name)[:, seen] for name in names},
            )
        )
    return tuple(epochs)


Item = TypeVar("Item")


def fresh_state(source: str, date: np.datetime64 | None = None) -> ReceiverState:
    """Return the state of a decoder before the first byte of a source; for `date` see `railfix.live.run_session`."""
    if date is None and not is_file(source):
        date = np.datetime64(time.time_ns(), "ns")  # leap seconds are irrelevant here
    return ReceiverState() if date is None else ReceiverState(stream=StreamState(time=date.astype("datetime64[ns]")))


async def arrivals(
    source: str, state: ReceiverState, settings: LiveSettings, place: Place | None = None
) -> AsyncIterator[ReceivedData | Connected | Lost]:
    """Yield the data decoded from a source, and the events of the connection; for `place` see `read_source`."""
    path = source.removeprefix("file:")
    if source != "-" and is_file(source) and find_kind(path) != "receiver":
        for piece in scan_observations(path, epochs=200):
            for epoch in single_epochs(piece):
                yield ReceivedData(epochs=(epoch,), after=state)
                await asyncio.sleep(0)
        return
    async for part in read_source(source, settings, place):
        if isinstance(part, bytes):
            for item in receive_bytes(part, state):
                state = item.after
                yield item
        else:
            if isinstance(part, Lost):
                state = state.after_break()
            yield part


async def next_arrival(
    queue: asyncio.Queue[Item], pumps: Sequence[asyncio.Task[Any]], *, wait_s: float | None = None
) -> Item | None:
    """Return the next item from the pumps; None after `wait_s`, or when a pump has ended with an error."""
    if not queue.empty():
        await asyncio.sleep(0)  # let the event loop handle signals even if data arrive faster than they are processed
        return queue.get_nowait()
    getting = asyncio.ensure_future(queue.get())
    running = [pump for pump in pumps if not pump.done()]
    await asyncio.wait([getting, *running], timeout=wait_s, return_when=asyncio.FIRST_COMPLETED)
    if getting.done():
        return getting.result()
    getting.cancel()
    return None


FOREVER: Final = np.datetime64("2200-01-01", "ns")  #: Time that is later than any epoch.
_NEEDED: Final = ("pulse", "range_m")  #: Columns that must have a number, except in rows with only a time.
_NAMES: Final = ("unit", "balise")  #: Columns that contain names instead of numbers.
#: Number of last bytes of an incomplete line that are kept; the beginning of a longer line is dropped.
_LINE_BYTES: Final = 4096


@dataclass(frozen=True, kw_only=True)
class Sensed:
    """Samples decoded from a chunk of a sensor's bytes."""

    sensor: str
    samples: SensorSamples = field(default_factory=SensorSamples)
    #: Time up to which the sensor has reported; NaT before the first row, `FOREVER` for a table or an ended stream.
    until: np.datetime64
    skipped: int = 0  #: Number of lines that are not valid rows, or are older than the previous row.

    def count_unsurveyed(self, units: GroundUnits | None) -> int:
        """Count the ranges to ground units without a surveyed position; these ranges are not used."""
        return int(np.count_nonzero(~np.isin(self.samples.ranging.station, () if units is None else units.name)))


@dataclass(kw_only=True)
class SensorLines:
    """Decoder of the rows of one sensor's stream."""

    sensor: str  #: Sensor, one of `railfix.motion.samples.SENSORS`.
    source: str  #: Name of the sensor's source in error messages.
    columns: tuple[str, ...] = ()  #: Names of the columns in the header line; empty until this line is received.
    until: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))  #: Time of the last valid row.
    rest: bytes = b""  #: Bytes of the last line, which is still incomplete.

    def after_break(self) -> None:
        """Drop the incomplete line after a break of the connection."""
        self.rest = b""

    def take(self, data: bytes) -> Sensed:
        """Return the samples completed by a chunk of bytes; a chunk may begin and end anywhere.

        Raise InputFileError if the first line is not the header of this sensor's table.
        """
        *lines, self.rest = (self.rest + data).split(b"\n")
        self.rest = self.rest[-_LINE_BYTES:]
        rows, times, skipped = [], [], 0
        for line in lines:
            cells = [cell.strip() for cell in line.decode("utf-8", "replace").split(",")]
            if cells == [""] or cells[0].startswith("#"):
                continue
            if not self.columns:
                self.columns = self._header(cells)
                continue
            if cells == [*self.columns]:
                continue
            row = self._row(cells)
            if row is None or row[0] < self.until:
                skipped += 1
                continue
            self.until = row[0]
            if row[1]:
                times.append(row[0])
                rows.append(row[1])
        return Sensed(sensor=self.sensor, samples=self._samples(times, rows), until=self.until, skipped=skipped)

    def _header(self, cells: list[str]) -> tuple[str, ...]:
        needed = ("time_gpst", *(name for name in COLUMNS[self.sensor] if not name.startswith("[")))
        missing = [name for name in needed if name not in cells]
        if missing:
            raise InputFileError(
                self.source,
                f"the first line has no column {missing[0]}; expected a header with the columns "
                f"{', '.join(needed)} of the {self.sensor} table, then the rows",
            )
        return tuple(cells)

    def _row(self, cells: list[str]) -> tuple[np.datetime64, Mapping[str, float | str]] | None:
        """Return the time and the values of a row; None for an invalid line. A row with only a time has no values."""
        if len(cells) != len(self.columns):
            return None
        given = dict(zip(self.columns, cells, strict=True))
        try:
            time = np.datetime64(given.pop("time_gpst"), "ns")
            texts = {name.strip("[]"): given.get(name.strip("[]"), "") for name in COLUMNS[self.sensor]}
            if not any(texts.values()):
                return None if np.isnat(time) else (time, {})
            unit: dict[str, float | str] = {name: texts.pop(name) for name in _NAMES if name in texts}
            values = {name: float(text) if text else np.nan for name, text in texts.items()}
        except ValueError:
            return None
        lacking = any(np.isnan(values.get(name, 0.0)) for name in _NEEDED) or "" in unit.values()
        if np.isnat(time) or np.isinf([*values.values()]).any() or lacking:
            return None
        return time, {**unit, **values}

    def _samples(self, times: list[np.datetime64], rows: list[Mapping[str, float | str]]) -> SensorSamples:
        if not rows:
            return SensorSamples()
        columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        samples: dict[str, Any] = {
            self.sensor: make_samples(self.sensor, np.array(times, dtype="datetime64[ns]"), columns)
        }
        return SensorSamples(**samples)


#: Assumed drift of the computer's clock relative to GPS time [s/s]; the shortest delay in `Lag` grows at this rate.
DRIFT: Final = 1e-4
#: A delay that is constant for longer than this counts as an offset of the time tags [s]. A delay of processing would
#: not be constant: it decreases while epochs are skipped, or increases if the computer is too busy even to skip them.
ADMITTED_S: Final = 2.0
STEADY_S: Final = 0.2  #: A delay counts as constant if it changes by at most this [s].
#: Least number of epochs that are skipped with a constant delay before the delay counts as an offset of the time tags.
STEADY_EPOCHS: Final = 5


@dataclass(kw_only=True)
class Lag:
    """Delay of epochs beyond the shortest delay so far, so that the clocks of receiver and computer need not agree."""

    #: If the delay exceeds this, epochs are skipped until it has fallen to a quarter of this [s]; may be infinite.
    behind_s: float
    skipped: int = 0  #: Number of epochs skipped since the delay exceeded `behind_s`; 0 while none are skipped.
    reports: list[str] = field(default_factory=list)  #: Sentences that are still to be logged.
    _shortest_ns: float | None = None
    _at_ns: int = 0
    _since_ns: int = 0
    _steady_s: float = 0.0
    _steady: int = 0

    def reset(self) -> None:
        """Drop the shortest delay after a jump of the time tags."""
        self._shortest_ns, self.skipped = None, 0

    def skips(self, tag_ns: int, now_ns: int) -> bool:
        """Update the delay with an epoch's tag and arrival [ns], and return whether the epoch is to be skipped."""
        delay_ns = now_ns - tag_ns
        shortest = float(delay_ns) if self._shortest_ns is None else self._shortest_ns
        shortest = min(float(delay_ns), shortest + DRIFT * (now_ns - self._at_ns))
        self._shortest_ns, self._at_ns = shortest, now_ns
        lag_s = (delay_ns - shortest) * 1e-9
        if self.skipped == 0:
            if lag_s <= self.behind_s:
                return False
            self.reports.append(
                f"processing is {lag_s:.1f} s behind the receivers: epochs are skipped until it is up to date"
            )
            self._steady = 0
        elif lag_s <= 0.25 * self.behind_s:
            self.reports.append(f"processing is up to date again; {self.skipped} epochs were skipped")
            self.skipped = 0
            return False
        if self._steady == 0 or abs(lag_s - self._steady_s) > STEADY_S:
            self._since_ns, self._steady_s, self._steady = now_ns, lag_s, 0
        elif self._steady >= STEADY_EPOCHS and (now_ns - self._since_ns) * 1e-9 > ADMITTED_S:
            self.reports.append(
                f"the receivers' time tags are {lag_s:.1f} s older than before; {self.skipped} epochs were skipped"
            )
            self.reset()
            return False
        self._steady += 1
        self.skipped += 1
        return True
