"""Live positioning of a train: a result for each epoch of one or two antennas, and a message for each period.

`LiveEngine` processes single epochs with the `EpochProcessor` that also processes logs. It keeps the state and reads no
files. Memory is bounded: the number of waiting epochs is limited, and expired records and SBAS messages are dropped.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Final, Literal

import numpy as np

from railfix.core.timescale import GPS_EPOCH
from railfix.gnss.joined_observations import concatenate
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.io.train_message import TrainMessage
from railfix.kernels import load
from railfix.live.message import TrainPlace, create_message, locate_train, no_input_message
from railfix.live.settings import LiveSettings
from railfix.live.stream import FOREVER, Lag, Sensed
from railfix.live.train_ends import RunningEnd, TrainFrame
from railfix.motion.samples import SensorSamples
from railfix.pipeline.antenna_order import AntennaOrder
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.processor_state import State
from railfix.pipeline.received import merge_navigation
from railfix.pipeline.results import Result
from railfix.ranges.sbas import SbasMessages

END_NS: Final = 1 << 62  #: Time later than any epoch [ns].
#: If more than this number of epochs of one antenna wait, because the receivers' clocks differ, the oldest is dropped.
_LONGEST_QUEUE = 100
_ORDER_STEP_M = 10.0  #: The order of the antennas is checked again each time the train has run this distance [m].


@dataclass(frozen=True, kw_only=True)
class LiveOutput:
    """Message, and the result of the epoch that it reports; the result is None in a period without input."""

    message: TrainMessage
    result: Result | None
    place: TrainPlace | None = None  #: Position that the message reports; None in a period without input.
    #: Parts to be sent: the message and the rows of the result ("both"), only the rows because the message is delayed
    #: or omitted ("rows"), or only a delayed message ("message").
    part: Literal["both", "rows", "message"] = "both"


@dataclass(frozen=True, kw_only=True)
class EngineState:
    """State from which a restarted session continues."""

    state: State
    done_ns: int  #: Time tag of the last epoch, GPS time since 1980 [ns]; 0 before the first epoch.
    last_tag: Mapping[str, int]  #: Last time tag of each antenna, GPS time since 1980 [ns].
    #: Sequence number from which a restarted session continues: at least the number of every message sent so far.
    sequence: int
    #: Direction of the train's leading end, and the state from which its changes are detected.
    running: RunningEnd = field(default_factory=lambda: RunningEnd(direction=0))


@dataclass(frozen=True, kw_only=True)
class _FromSatellites:
    """Navigation records, SBAS messages and base-station epochs; `heard` is the serial number of the last item."""

    heard: int
    navigation: Navigation | None = None
    messages: SbasMessages | None = None
    base: Observations | None = None

    def with_later(self, later: _FromSatellites) -> _FromSatellites:
        """Return the data merged with data that arrived later."""
        navigation, messages = self.navigation, self.messages
        if later.navigation is not None:
            navigation = later.navigation if navigation is None else merge_navigation(navigation, later.navigation)
        if later.messages is not None:
            messages = later.messages if messages is None else messages.merge(later.messages)
        base = [part for part in (self.base, later.base) if part is not None]
        return _FromSatellites(
            heard=later.heard, navigation=navigation, messages=messages, base=concatenate(base) if base else None
        )


@dataclass(frozen=True)
class _Waiting:
    """Waiting epoch; `heard` is the serial number of the last satellite item that arrived before the epoch."""

    epoch: Observations
    arrived_ns: int
    heard: int

    @property
    def tag_ns(self) -> int:
        """Time tag, GPS time since 1980 [ns]."""
        return int((self.epoch.time[0] - GPS_EPOCH).astype(np.int64))


class LiveEngine:
    """Positioning of a train from epochs as they arrive; the constructor loads the compiled kernels.

    Attributes
    ----------
    counts : Counter of str
        Epochs by outcome: "paired", "front alone", "rear alone", "duplicate", "late", "out of order", "tag step",
        "restart", "no input", "superseded" (processed, but the period's message reports a newer epoch), "skipped,
        behind the receivers", "dropped, too many waiting", "base station out of order". An epoch for which the samples
        of a sensor came too late is also counted by sensor, for example as "tachometer silent".
    frame : TrainFrame
        Reference point and ends of the train.
    reports : deque of str
        Sentences for the log, about replacements of missing data, restarts, skipped epochs, the train's direction and
        the use of a saved state. The caller removes the sentences that it has logged.
    """

    def __init__(self, processor: EpochProcessor, settings: LiveSettings, sensors: Sequence[str] = ()) -> None:
        load()
        self.processor = processor
        self.settings = settings
        self.counts: Counter[str] = Counter()
        self.reports: deque[str] = deque(processor.notes, maxlen=100)
        self._notes = processor.received.notes
        self._own, self._reported = list[str](), set(processor.notes)
        tolerance_s = processor.config.antenna_pair.tag_tolerance_s
        self._order = AntennaOrder.between(processor.trajectories, tolerance_s=tolerance_s)
        self._ordered_at_m = float("-inf")
        self._antennas = tuple(processor.trajectories)
        self._waiting: dict[str, deque[_Waiting]] = {name: deque() for name in self._antennas}
        self._last_tag: dict[str, int] = {}
        self._backward: dict[str, list[int]] = {name: [] for name in self._antennas}
        self.lag = Lag(behind_s=settings.behind_s)
        self._done_ns = -1
        self._state: State | None = None
        self._saved: EngineState | None = None
        self._from_satellites: deque[_FromSatellites] = deque()
        self._heard = self._heard_at_push = 0
        self._based_to: np.datetime64 | None = None
        self._samples = self._tables = SensorSamples()
        self._heard_to = dict.fromkeys(sensors, np.datetime64("NaT", "ns"))
        self._sequence = 0
        self.frame = TrainFrame.of(processor.trajectories, settings)
        self._running = RunningEnd(direction=self.frame.running)
        self._due_ns: int | None = None
        self._pending: LiveOutput | None = None
        self._silent = False
        self._period_ns = round(settings.period_s * 1e9)
        self._tolerance_ns = round(tolerance_s * 1e9)

    def add_navigation(self, navigation: Navigation) -> None:
        """Add navigation records, which are used from the next epoch on."""
        self._hear(_FromSatellites(heard=self._heard + 1, navigation=navigation))

    def add_sbas(self, messages: SbasMessages) -> None:
        """Add SBAS messages, which are used from the next epoch on."""
        self._hear(_FromSatellites(heard=self._heard + 1, messages=messages))

    def add_base(self, epoch: Observations) -> None:
        """Add a base-station epoch, to be used for later epochs; an epoch out of order is counted and dropped."""
        if self._based_to is not None and epoch.time[0] <= self._based_to:
            self.counts["base station out of order"] += 1
            return
        self._based_to = epoch.time[-1]
        self._hear(_FromSatellites(heard=self._heard + 1, base=epoch))

    def add_samples(self, sensed: Sensed) -> None:
        """Add samples of an on-board sensor that was named at construction."""
        self._heard_to[sensed.sensor] = np.fmax(self._heard_to[sensed.sensor], sensed.until)
        if sensed.samples:
            self._samples = self._samples.merge(sensed.samples)
            if sensed.until == FOREVER:
                self._tables = self._tables.merge(sensed.samples)

    def _late_sensors(self, tag_ns: int) -> frozenset[str]:
        """Return the sensors whose samples do not yet reach an epoch's time tag."""
        time = GPS_EPOCH + np.timedelta64(tag_ns, "ns")
        return frozenset(name for name, heard in self._heard_to.items() if not heard >= time)

    def _hear(self, item: _FromSatellites) -> None:
        self._heard = item.heard
        last = self._from_satellites[-1] if self._from_satellites else None
        if last is not None and last.heard > self._heard_at_push:  # no epoch has arrived since the last item
            self._from_satellites[-1] = last.with_later(item)
        else:
            self._from_satellites.append(item)

    def start(self, *, now_ns: int) -> None:
        """Start the periods at `now_ns`; then a message is due in each period, even before the first epoch."""
        self._due_ns = now_ns if self._due_ns is None else self._due_ns

    def export_state(self, *, reserved: int = 0) -> EngineState:
        """Return the state for a restarted session.

        `reserved` is added to the sequence number, so that after a crash no number is sent twice.
        """
        sequence = self._sequence + reserved
        if self._saved is not None:  # no epoch has been received yet
            return replace(self._saved, sequence=sequence)
        return EngineState(
            state=State() if self._state is None else self._state, done_ns=self._done_ns if self._state else 0,
            last_tag=dict(self._last_tag), sequence=sequence, running=self._running,
        )  # fmt: skip

    def resume(self, saved: EngineState) -> None:
        """Continue from a saved state, if it is at most `LiveSettings.state_age_s` older than the first new epoch.

        Otherwise, only the saved navigation records, SBAS messages and sequence number are used. In both cases, a note
        is added to `reports`.
        """
        self._sequence = max(self._sequence, saved.sequence)
        self._saved = saved if saved.done_ns else None

    def push(self, antenna: str, epoch: Observations, *, now_ns: int) -> None:
        """Add an antenna's epoch, received at `now_ns` (clock of `poll`); raise ValueError for an unknown antenna."""
        if antenna not in self._waiting:
            raise ValueError(f"antenna {antenna} has no trajectory; the antennas are {', '.join(self._antennas)}")
        waiting = _Waiting(epoch, now_ns, self._heard)
        self._heard_at_push = self._heard
        if self._saved is not None:
            self._resume_at(waiting.tag_ns, self._saved)
        if self._due_ns is None:
            self._due_ns = now_ns
        if not self._in_order(antenna, waiting.tag_ns):
            return
        skips = self.lag.skips(waiting.tag_ns, now_ns)
        self.reports += self.lag.reports
        self.lag.reports.clear()
        if skips:
            self.counts["skipped, behind the receivers"] += 1
            return
        queue = self._waiting[antenna]
        if len(queue) >= _LONGEST_QUEUE:
            queue.popleft()
            self.counts["dropped, too many waiting"] += 1
        queue.append(waiting)

    def _resume_at(self, tag_ns: int, saved: EngineState) -> None:
        """Use a saved state if an epoch is at most `state_age_s` later than the state, else only its satellite data."""
        self._saved = None
        age_s = (tag_ns - saved.done_ns) / 1e9
        if 0.0 < age_s <= self.settings.state_age_s:
            self._state, self._done_ns, self._last_tag = saved.state, saved.done_ns, dict(saved.last_tag)
            self._running = saved.running
            self._samples = self._samples.between(GPS_EPOCH + np.timedelta64(saved.done_ns, "ns"), FOREVER)
            self.reports.append(f"state file: positioning continues {age_s:.1f} s after the last epoch of the file")
        else:
            self._state = State(received=saved.state.received)
            side = "before" if age_s > 0.0 else "after"
            allowed = f"it may be at most {self.settings.state_age_s:g} s before the first new epoch (state_age_s)"
            self.reports.append(
                f"state file: only the ephemerides and the sequence number of the file are used, because the file's "
                f"last epoch is {abs(age_s):.1f} s {side} the first new epoch; {allowed}"
            )
        # Navigation files of this session are merged with the data of the state file.
        known = self.processor.received.navigation
        self._from_satellites.appendleft(_FromSatellites(heard=0, navigation=known))

    def _in_order(self, antenna: str, tag_ns: int) -> bool:
        """Return whether to process an epoch; restart positioning after `restart_epochs` older epochs in sequence."""
        last = self._last_tag.get(antenna)
        if last is not None and tag_ns <= last:
            self.counts["duplicate" if tag_ns == last else "out of order"] += 1
            backward = self._backward[antenna]
            backward.append(tag_ns)
            rising = all(a < b for a, b in pairwise(backward))
            if not rising:
                self._backward[antenna] = [tag_ns]
            if not rising or len(backward) < self.settings.restart_epochs:
                return False
            self._restart()
        elif last is not None:
            step = (tag_ns - last) % self._period_ns
            if min(step, self._period_ns - step) > 500_000:
                self.counts["tag step"] += 1
        self._backward[antenna] = []
        self._last_tag[antenna] = tag_ns
        if tag_ns <= self._done_ns:
            self.counts["late"] += 1
            return False
        return True

    def _restart(self) -> None:
        """Restart positioning after a receiver has restarted; keep only navigation, SBAS messages and sensor tables."""
        self.counts["restart"] += 1
        self.lag.reset()
        self.reports.append("a receiver has restarted with older time tags; positioning restarts")
        self._state = None if self._state is None else State(received=self._state.received)
        self._done_ns = -1
        self._samples = self._tables  # drop samples from streams, which preceded the restart, but keep tables
        for name in self._antennas:
            self._waiting[name].clear()

    def poll(self, *, now_ns: int, sent_ns: int | None = None) -> list[LiveOutput]:
        """Return the outputs that are due: one for each pair or long-waiting epoch, or one for a period without input.

        `now_ns` is read from the same clock as for `push`. If `sent_ns`, the GPS time of sending [ns], is given, one
        message is sent per period, for the newest epoch. Without `sent_ns`, as in a replay, every epoch has a message.
        If `now_ns` is `END_NS`, all waiting epochs are due, and no message without input is added.
        """
        outputs = [self._process_epochs(epochs) for epochs in self._pairs(now_ns)]
        if sent_ns is None:
            numbered = [self._send(output, self._get_tag(output)) for output in outputs]
            if outputs:
                self._due_ns, self._silent = now_ns, False
        else:
            numbered = self._one_a_period(outputs, now_ns, sent_ns)
        if numbered or self._due_ns is None or self.settings.no_input == "skip" or now_ns >= END_NS:
            return numbered
        if now_ns - self._due_ns >= self._patience_ns():
            self.counts["no input"] += 1
            self._due_ns += self._patience_ns()
            self._silent = True
            last = max(self._last_tag.values(), default=sent_ns or 0)
            message = no_input_message(self.settings, self.frame, self._running.direction, last)
            numbered.append(self._send(LiveOutput(message=message, result=None), last if sent_ns is None else sent_ns))
        return numbered

    def _patience_ns(self) -> int:
        """Return the longest time without a message [ns]: 1.5 periods, or one period after a message without input."""
        return self._period_ns if self._silent else self._period_ns + self._period_ns // 2

    def _one_a_period(self, outputs: list[LiveOutput], now_ns: int, sent_ns: int) -> list[LiveOutput]:
        """Return the outputs; the newest output has a message if the previous message is at least half a period old.

        Otherwise, the message waits until one period after the previous message, unless a newer message replaces it.
        """
        if self._due_ns is None:
            self._due_ns = now_ns - self._period_ns
        elapsed_ns = now_ns - self._due_ns
        rows = [replace(output, part="rows") for output in outputs]
        if not outputs and (self._pending is None or elapsed_ns < self._period_ns):
            return rows
        newest = outputs[-1] if outputs else self._pending
        self.counts["superseded"] += len(outputs) - 1 + (self._pending is not None) if outputs else 0
        self._pending = None
        if newest is None or elapsed_ns < self._period_ns // 2:
            self._pending = newest
            return rows
        self._due_ns, self._silent = now_ns, False
        if outputs:
            return [*rows[:-1], self._send(newest, sent_ns)]
        return [replace(self._send(newest, sent_ns), part="message")]

    def _send(self, output: LiveOutput, sent_ns: int) -> LiveOutput:
        """Return an output with the next sequence number and the time of sending."""
        self._sequence += 1
        return replace(output, message=output.message.replaced(sequence=self._sequence, sent_ns=sent_ns))

    @staticmethod
    def _get_tag(output: LiveOutput) -> int:
        """Return the latest time tag among the epochs of an output [ns]."""
        assert output.result is not None
        return max(int((a.time[-1] - GPS_EPOCH).astype(np.int64)) for a in output.result.antennas.values())

    def wait_s(self, *, now_ns: int) -> float:
        """Return the time [s] after which `poll` must be called if nothing arrives earlier."""
        times = [self.settings.period_s]
        if self._due_ns is not None:
            longest = self._patience_ns() if self._pending is None else self._period_ns
            times.append((self._due_ns - now_ns + longest) * 1e-9)
        for queue in self._waiting.values():
            if queue:
                since_s = (now_ns - queue[0].arrived_ns) * 1e-9
                waits = (self.settings.pair_wait_s, self.settings.sensor_wait_s if self._heard_to else 0.0)
                times += [wait_s - since_s for wait_s in waits if wait_s > since_s]
        return max(0.0, min(times))

    def _pairs(self, now_ns: int) -> Iterator[dict[str, _Waiting]]:
        """Yield the epochs that are to be processed together, by antenna, in the order of time tags."""
        while True:
            heads = {name: queue[0] for name, queue in self._waiting.items() if queue}
            if not heads:
                return
            first = min(heads.values(), key=lambda head: head.tag_ns)
            together = {n: h for n, h in heads.items() if h.tag_ns - first.tag_ns <= self._tolerance_ns}
            complete = len(together) == len(self._antennas) or len(heads) == len(self._antennas)
            waited_s = (now_ns - first.arrived_ns) * 1e-9
            if not complete and waited_s < self.settings.pair_wait_s:
                return
            if waited_s < self.settings.sensor_wait_s and self._late_sensors(first.tag_ns):
                return
            for name in together:
                self._waiting[name].popleft()
            if len(self._antennas) > 1:
                self.counts["paired" if len(together) > 1 else f"{next(iter(together))} alone"] += 1
            yield together

    def _process_epochs(self, heads: dict[str, _Waiting]) -> LiveOutput:
        heard, news = max(head.heard for head in heads.values()), _FromSatellites(heard=0)
        while self._from_satellites and self._from_satellites[0].heard <= heard:
            news = news.with_later(self._from_satellites.popleft())
        epochs = {name: head.epoch for name, head in heads.items()}
        self._done_ns = max(head.tag_ns for head in heads.values())
        screened = self.processor.screen(
            epochs, self._state, navigation=news.navigation, messages=news.messages, base=news.base,
            sensors=self._samples_until(self._done_ns) if self._heard_to else None,
        )  # fmt: skip
        result, self._state = self.processor.along_track(*self.processor.position(*screened))
        self._tell_changes(self._state, result.notes)
        self._check_order(result)
        return self._locate(result)

    def _locate(self, result: Result) -> LiveOutput:
        """Update the direction of the train's leading end, and return the output of a result."""
        place = locate_train(result, self.frame)
        before = self._running
        self._running = before.after(place.chainage_m, place.bound_m, place.moving)
        if (sentence := self._running.sentence(before)) is not None:
            self.reports.append(sentence)
        message = create_message(result, place, self.settings, self.frame, self._running.direction)
        return LiveOutput(message=message, result=result, place=place)

    def _samples_until(self, tag_ns: int) -> SensorSamples:
        """Return the samples from the previous epoch up to a time tag; later samples are kept for the next epoch."""
        time, silent = GPS_EPOCH + np.timedelta64(tag_ns, "ns"), self._late_sensors(tag_ns)
        self.counts.update(f"{name} silent" for name in silent)
        samples = self._samples.between(np.datetime64("NaT", "ns"), time)
        self._samples = self._samples.between(time, FOREVER)
        return replace(samples, silent=silent)

    def _tell_changes(self, state: State, of_epoch: tuple[str, ...]) -> None:
        """Report each time that a replacement of missing data begins or ends; report other notes only once."""
        received = state.received or self.processor.received
        notes = (received if state.base is None else state.base.beside(received)).notes
        self.reports.extend(note for note in notes if note not in self._notes)
        self.reports.extend(f"no longer valid: {note}" for note in self._notes if note not in notes)
        own = [note for note in dict.fromkeys(of_epoch) if note not in notes]
        ended = [f"no longer valid: {note}" for note in self._own if note not in own]
        new = [text for text in (*own, *ended) if text not in self._reported]
        self._reported.update(new)
        self.reports.extend(new)
        self._notes, self._own = notes, own

    def _check_order(self, result: Result) -> None:
        """Report once if the positions of the two antennas are in the wrong order along the line."""
        if self._order is None or len(result.antennas) < 2:
            return
        front, rear = (result.antennas[name] for name in ("front", "rear"))
        place = float(front.chainage_m[-1])
        if not abs(place - self._ordered_at_m) >= _ORDER_STEP_M:
            return
        self._ordered_at_m = place
        new = self._order.add(
            (front.time, front.chainage_m, front.along_sigma_m), (rear.time, rear.chainage_m, rear.along_sigma_m)
        )
        if new and (note := self._order.note) is not None:
            self.reports.append(note)
            self._order = None
