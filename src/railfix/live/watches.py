"""Checks of a live session: sensors on board against the satellites, the track against the positions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
import polars as pl

from railfix.core.arrays import Datetimes
from railfix.core.errors import MismatchError
from railfix.core.reasons import Status
from railfix.core.timescale import GPS_EPOCH
from railfix.live.engine import LiveOutput
from railfix.live.stream import FOREVER, Sensed
from railfix.motion.samples import RadarWatch, SensorSamples
from railfix.pipeline.processor import EpochProcessor
from railfix.run.checks import ENOUGH_TO_STOP, check_same_place
from railfix.run.sensor_checks import SensorChecks
from railfix.run.tally import AntennaTally, Tally
from railfix.tracking import Kind

#: The sensors are judged after so long, by places at least so far apart; the radar every so often [ns].
WATCHED_NS: Final = 600_000_000_000
_RADAR_NS: Final = 60_000_000_000
_EVERY_NS: Final = 500_000_000
#: Pieces of samples that are joined to one.
_PIECES: Final = 256
_NEVER: Final = np.datetime64("NaT", "ns")


class SensorWatch:
    """Places and speeds of the first antenna and the samples of the sensors, until they have been judged.

    `say` takes a sentence on each sensor that contradicts the satellites (`railfix.run.sensor_checks.SensorChecks`).
    """

    def __init__(self, processor: EpochProcessor, say: Callable[[str], None]) -> None:
        self._name, self._trajectory = next(iter(processor.trajectories.items()))
        self._processor, self._say = processor, say
        self._place_ns: list[int] = []
        self._places_m: list[float] = []
        self._speed_ns: list[int] = []
        self._speeds: list[float] = []
        self._shown = 0
        self._samples: list[SensorSamples] = []
        self._blocks: list[SensorSamples] = []
        self._begin = _NEVER
        self._judged = self._has_radar = False
        self._watch, self._radar = RadarWatch(), SensorSamples()

    def take(self, item: LiveOutput | Sensed) -> None:
        """Take an output of the engine, or what a sensor's source has completed."""
        if isinstance(item, Sensed):
            self._hear(item)
        elif item.result is not None and self._name in item.result.antennas:
            antenna, track = item.result.antennas[self._name], item.result.fusion.get(self._name)
            time_ns = int((antenna.time[-1] - GPS_EPOCH).astype(np.int64))
            speed = float("nan") if track is None else float(track.tracked.speed_mps[-1])
            measured = track is not None and track.tracked.used[-1, Kind.DOPPLER] and np.isfinite(speed)
            if measured and time_ns > _last(self._speed_ns):
                self._speed_ns.append(time_ns)
                self._speeds.append(speed)
                if time_ns - self._speed_ns[self._shown] >= _RADAR_NS:
                    self._look_at_radar()
            if self._judged:
                return
            if antenna.status[-1] == Status.OK and time_ns >= _last(self._place_ns) + _EVERY_NS:
                self._place_ns.append(time_ns)
                self._places_m.append(float(antenna.chainage_m[-1]))
            if self._place_ns and time_ns - self._place_ns[0] >= WATCHED_NS:
                self.judge()

    def _hear(self, sensed: Sensed) -> None:
        """Keep samples, of streams no longer than they can be needed: there may be no place for hours."""
        table = bool(sensed.until == FOREVER)
        if sensed.samples and not self._judged:
            self._samples.append(sensed.samples)
            if len(self._samples) == _PIECES:  # a stream gives row by row, and each takes the room of a hundred
                self._blocks.append(_join(self._samples))
                self._samples = []
            self._begin = np.fmin(self._begin, sensed.until)
            if not table and sensed.until - self._begin > 2 * np.timedelta64(WATCHED_NS, "ns"):
                if self._place_ns:
                    self.judge()
                self._samples, self._blocks, self._begin = [], [], _NEVER
        self._has_radar = self._has_radar or len(sensed.samples.radar) > 0
        if len(sensed.samples.radar):
            self._radar = self._radar.joined(SensorSamples(radar=sensed.samples.radar))
            if not table:
                self._radar = self._radar.between(sensed.until - 2 * np.timedelta64(_RADAR_NS, "ns"), FOREVER)

    def _look_at_radar(self) -> None:
        """Compare the radar with the speeds by satellites since the last look."""
        time, speeds = _times(self._speed_ns[self._shown :]), np.array(self._speeds[self._shown :])
        now, self._radar = self._radar.between(_NEVER, time[-1]), self._radar.between(time[-1], FOREVER)
        for alarm in self._watch.take_samples(now.radar, time, speeds) if self._has_radar else ():
            self._say(alarm.sentence)
        self._shown = len(self._speeds)
        if self._judged:
            self._forget_speeds()

    def _forget_speeds(self) -> None:
        """Drop the speeds that the radar has been compared with, except the last."""
        kept = slice(max(self._shown - 1, 0), None)
        self._speed_ns, self._speeds, self._shown = self._speed_ns[kept], self._speeds[kept], min(self._shown, 1)

    def judge(self) -> None:
        """Compare the sensors with the satellites so far, once."""
        if self._judged:
            return
        self._judged = True
        if self._place_ns and self._speeds and (parts := [*self._blocks, *self._samples]):
            speeds = pl.DataFrame({"time_gpst": _times(self._speed_ns), "speed_mps": self._speeds})
            places = pl.DataFrame({"time_gpst": _times(self._place_ns), "chainage_m": self._places_m})
            samples = _join(parts).between(_NEVER, _times(self._speed_ns)[-1])
            checks, processor = SensorChecks(places=[places], speeds=[speeds]), self._processor
            for note in checks.notes(samples, processor.units, self._trajectory, processor.config.sensors):
                self._say(note)
        self._place_ns, self._places_m, self._samples, self._blocks = [], [], [], []
        self._forget_speeds()


def _last(time_ns: list[int]) -> int:
    return time_ns[-1] if time_ns else -_EVERY_NS


def _times(time_ns: list[int]) -> Datetimes:
    return GPS_EPOCH + np.array(time_ns).astype("timedelta64[ns]")


def _join(parts: list[SensorSamples]) -> SensorSamples:
    """All parts as one, neighbours first: each sample is copied a few times, not once a part."""
    while len(parts) > 1:
        pairs = zip(parts[::2], parts[1::2], strict=False)
        parts = [early.joined(late) for early, late in pairs] + parts[len(parts) // 2 * 2 :]
    return parts[0]


class PlaceWatch:
    """Compare 3-D positions with the line until enough were seen, and report once that it lies elsewhere.

    `say` takes the sentence with which `railfix run` ends there.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._tally = Tally(min_satellites=3)
        self._done = False

    def take(self, output: LiveOutput) -> None:
        """Take an output of the engine."""
        if self._done or output.result is None:
            return
        for name, antenna in output.result.antennas.items():
            counts = self._tally.antennas.setdefault(name, AntennaTally())
            offset_m = antenna.conventional_offset_m[-1]
            if np.isfinite(offset_m):
                counts.conventional += 1
                counts.conventional_nearest_m = float(np.fmin(counts.conventional_nearest_m, offset_m))
        if any(counts.conventional >= ENOUGH_TO_STOP for counts in self._tally.antennas.values()):
            self._done = True
            try:
                check_same_place(self._tally)
            except MismatchError as error:
                self._say(str(error))
